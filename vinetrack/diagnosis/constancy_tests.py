"""Tests of whether per-trial estimates of a parameter vary with a condition: linear trend and differences."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats, Trial
from vinetrack.diagnosis.per_trial_estimates import PerTrialEstimates

FEWEST_DEGREES = 2  # Degrees of freedom of replicates from which they determine the scatter of estimates (chosen)


LEAST_SCATTER = 0.1  # Least scatter of replicates, as part of the expected scatter of pressure and B (chosen)


@dataclass(frozen=True)
class Covariate:
    """A condition on which a parameter should not depend: the attribute of a trial, and how it is displayed."""

    column: str
    label: str
    unit: str
    factor: float
    logarithmic: bool

    def level(self, trial: Trial) -> float:
        """The nominal value for a trial, SI."""
        return float(getattr(trial, self.column))

    def coordinate(self, levels: Floats) -> Floats:
        """The coordinate in which a trend is linear. Shapes: levels (n_trials,) → (n_trials,)."""
        return np.log(levels) if self.logarithmic and np.all(levels > 0) else levels

    def formatted(self, level: float) -> str:
        """A level with its unit."""
        return f"{level * self.factor:.3g} {self.unit}"


COVARIATES = (
    Covariate("pressure_Pa", "pressure", "kPa", 1e-3, True),
    Covariate("payload_kg", "payload", "g", 1e3, False),
    Covariate("growth_angle_rad", "growth angle", "°", 180 / math.pi, False),
    Covariate("chamber_m3", "chamber volume", "l", 1e3, True),
    Covariate("inlet_m", "inlet", "mm", 1e3, True),
)


@dataclass(frozen=True)
class BlockedDeviations:
    """Deviations of coordinate x and estimate d from the weighted means of their block, and the scatter of replicates.
    `variance` is that scatter relative to the estimates' own variances, with `dof` degrees of freedom; `chi2` is the
    sum of squares between groups, with `groups` degrees of freedom.
    """

    x: Floats
    d: Floats
    weight: Floats
    variance: float
    dof: int
    chi2: float
    groups: int


def blocked_deviations(
    estimates: PerTrialEstimates, x: Floats, levels: Floats, chosen: NDArray[np.bool_]
) -> BlockedDeviations | None:
    """Deviations from the mean of each vine (or of all), and the scatter of replicates; None without enough trials.
    Shapes: x, levels, chosen (n_trials,).
    """
    conditions = np.array([trial.condition for trial in estimates.trials])
    blocks = (
        np.array([trial.vine for trial in estimates.trials])
        if estimates.per_vine
        else np.full(len(estimates.trials), "")
    )
    weight = 1 / estimates.variance
    from_replicates = np.zeros(len(estimates.trials))
    for condition in dict.fromkeys(conditions[np.isfinite(estimates.deviation)]):
        k = np.flatnonzero((conditions == condition) & np.isfinite(estimates.deviation))
        from_replicates[k] = estimates.deviation[k] - np.average(estimates.deviation[k], weights=weight[k])
    known = np.isfinite(estimates.deviation)
    dof = int(known.sum()) - len(set(conditions[known]))
    xs, ds = x[chosen].copy(), estimates.deviation[chosen].copy()
    w, block = weight[chosen], blocks[chosen]
    for name in dict.fromkeys(block):
        k = block == name
        xs[k] -= np.average(xs[k], weights=w[k])
        ds[k] -= np.average(ds[k], weights=w[k])
    if not np.sum(w * xs**2) > 0:
        return None
    if dof >= FEWEST_DEGREES:
        variance = float(np.sum(weight[known] * from_replicates[known] ** 2)) / dof
    else:
        dof = ds.size - len(set(block)) - 1
        if dof < FEWEST_DEGREES:
            return None
        residual = ds - xs * np.sum(w * xs * ds) / np.sum(w * xs**2)
        variance = float(np.sum(w * residual**2)) / dof
    pairs = list(dict.fromkeys(zip(block, levels[chosen], strict=True)))
    chi2 = 0.0
    for name, level in pairs:
        k = (block == name) & (levels[chosen] == level)
        chi2 += float(np.sum(w[k]) * np.average(ds[k], weights=w[k]) ** 2)
    return BlockedDeviations(xs, ds, w, max(variance, LEAST_SCATTER**2), dof, chi2, len(pairs) - len(set(block)))


def constancy_p_value(deviations: BlockedDeviations) -> tuple[float, float]:
    """F test of whether the groups have the same mean: its p-value, and that as a normal deviate. Returns
    p, z : float.
    """
    from scipy.stats import f as fisher

    if deviations.groups < 1:
        return 1.0, 0.0
    p = float(fisher.sf(deviations.chi2 / deviations.groups / deviations.variance, deviations.groups, deviations.dof))
    return p, normal_deviate(p)


def normal_deviate(p: float) -> float:
    """The normal deviate with this two-sided p-value."""
    from scipy.stats import norm

    return float(norm.isf(max(p, 1e-300) / 2))


@dataclass(frozen=True)
class ConstancyTest:
    """A row of the table of drifts with its p-value, and the rows of its groups."""

    row: dict[str, object]
    p: float
    groups: list[dict[str, object]]
