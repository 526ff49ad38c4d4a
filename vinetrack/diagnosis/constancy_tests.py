"""Values of single trials held against a condition: a straight line, groups, and the scatter of replicates."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats, Trial
from vinetrack.diagnosis.per_trial_estimates import PerTrialEstimates

FEWEST_DEGREES = 2
"""Replicates beyond the first of their condition that can say how values scatter; else the line's own residuals do.
Chosen: two degrees of freedom know a scatter to a factor of two, which Student's t allows for."""


LEAST_SCATTER = 0.1
"""Of the likely scatter of pressure and B: that replicates agree better is taken for chance. Chosen: a tenth of a
usual scatter; with few replicates chance agreement would make any trend significant."""


@dataclass(frozen=True)
class Against:
    """A condition that a parameter should not know: attribute of a trial, and how it is shown."""

    column: str
    words: str
    unit: str
    factor: float
    logarithmic: bool

    def level(self, trial: Trial) -> float:
        """The nominal value of a trial, SI.

        Parameters
        ----------
        trial
            Row of the sheet.

        Returns
        -------
        float, SI
        """
        return float(getattr(trial, self.column))

    def along(self, levels: Floats) -> Floats:
        """The coordinate a drift is a straight line in.

        Parameters
        ----------
        levels : array, shape (n_trials,), SI

        Returns
        -------
        array, shape (n_trials,)
        """
        return np.log(levels) if self.logarithmic and np.all(levels > 0) else levels

    def shown(self, level: float) -> str:
        """A level with its unit.

        Parameters
        ----------
        level : float, SI

        Returns
        -------
        str
        """
        return f"{level * self.factor:.3g} {self.unit}"


CONDITIONS = (
    Against("pressure_Pa", "pressure", "kPa", 1e-3, True),
    Against("payload_kg", "payload", "g", 1e3, False),
    Against("growth_angle_rad", "growth angle", "°", 180 / math.pi, False),
    Against("chamber_m3", "chamber volume", "l", 1e3, True),
    Against("inlet_m", "inlet", "mm", 1e3, True),
)


@dataclass(frozen=True)
class Sums:
    """Weighted deviations about the means of their blocks, and the scatter they are judged by."""

    x: Floats
    d: Floats
    weight: Floats
    variance: float
    dof: int
    chi2: float
    groups: int


def sums_of(estimates: PerTrialEstimates, x: Floats, levels: Floats, chosen: NDArray[np.bool_]) -> Sums | None:
    """Deviations about the mean of each vine (or of all), and the scatter of replicates; None without any to tell.

    Parameters
    ----------
    estimates : values of one parameter by trial.
    x : array, shape (n_trials,)
        Coordinate of a drift.
    levels : array, shape (n_trials,)
        Values that make the groups.
    chosen : array of bool, shape (n_trials,)
        Trials that are tested.

    Returns
    -------
    Sums or None
    """
    conditions = np.array([trial.condition for trial in estimates.trials])
    blocks = (
        np.array([trial.vine for trial in estimates.trials])
        if estimates.per_vine
        else np.full(len(estimates.trials), "")
    )
    weight = 1 / estimates.variance
    spread = np.zeros(len(estimates.trials))
    for condition in dict.fromkeys(conditions[np.isfinite(estimates.deviation)]):
        k = np.flatnonzero((conditions == condition) & np.isfinite(estimates.deviation))
        spread[k] = estimates.deviation[k] - np.average(estimates.deviation[k], weights=weight[k])
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
        variance = float(np.sum(weight[known] * spread[known] ** 2)) / dof
    else:
        dof = ds.size - len(set(block)) - 1
        if dof < FEWEST_DEGREES:
            return None
        left = ds - xs * np.sum(w * xs * ds) / np.sum(w * xs**2)
        variance = float(np.sum(w * left**2)) / dof
    pairs = list(dict.fromkeys(zip(block, levels[chosen], strict=True)))
    chi2 = 0.0
    for name, level in pairs:
        k = (block == name) & (levels[chosen] == level)
        chi2 += float(np.sum(w[k]) * np.average(ds[k], weights=w[k]) ** 2)
    return Sums(xs, ds, w, max(variance, LEAST_SCATTER**2), dof, chi2, len(pairs) - len(set(block)))


def constancy(sums: Sums) -> tuple[float, float]:
    """How likely chance is to make groups differ so much, and that as a normal deviate.

    Parameters
    ----------
    sums : from `sums_of`.

    Returns
    -------
    p, z : float
    """
    from scipy.stats import f as fisher

    if sums.groups < 1:
        return 1.0, 0.0
    p = float(fisher.sf(sums.chi2 / sums.groups / sums.variance, sums.groups, sums.dof))
    return p, as_deviate(p)


def as_deviate(p: float) -> float:
    """The normal deviate that is two-sided as unlikely as `p`.

    Parameters
    ----------
    p : float
        Two-sided p-value.

    Returns
    -------
    float
    """
    from scipy.stats import norm

    return float(norm.isf(max(p, 1e-300) / 2))


@dataclass(frozen=True)
class ConstancyTest:
    """A row of the table of drifts and how likely chance alone makes it, with the rows of its groups."""

    row: dict[str, object]
    p: float
    groups: list[dict[str, object]]
