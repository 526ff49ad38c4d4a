"""How far replicates alone carry the mean of a condition off the model.

Positions of one trial err together from frame to frame: a trial with 3 % more B is late everywhere. So frames are not
counted. Every trial is cut into a few stretches, and how the means of stretches vary between replicates is described
by three numbers for all conditions: the scatter of pressure and of B, through the sensitivities of the trajectories,
and a rest that stretches do not share. They are found from differences between replicates alone, so a model that fails
does not make them larger.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.diagnosis.per_trial_estimates import AlignedTrial, without
from vinetrack.inference.fit_result import Fit
from vinetrack.inference.left_out import rest_is_seen
from vinetrack.inference.sensitivity import DAMPING_DEVIATION, ORIGIN, PRESSURE, RELEASE

START_VALUES = (0.01, 0.03, 0.2)
"""Start, least and largest values of the search: pressure, ln B, rest. Chosen."""

LOWER_BOUNDS, UPPER_BOUNDS = (1e-5, 1e-5, 1e-3), (0.2, 0.5, 3.0)
"""Chosen: from exact to worse than any rig; the search never ends there where replicates tell anything."""

LEAST_BETWEEN_TRIAL_SD = (0.005, 0.015)
"""Of pressure and B, for whoever needs both: replicates tell their sum much better than either. Chosen: half of a
usual scatter."""

POSITION_FLOOR_M = 1e-6
"""Stretches are no better known than this, m. Chosen: a hundredth of a good tracker's error."""


@dataclass(frozen=True)
class Stretches:
    """Parts of the motion of replicates, all filmed in each.

    `means_m`, shape (n_trials, n), are the mean residuals; `answers`, shape (n, 2), what a unit of pressure and of B
    does to them; `noise_m2`, shape (n, n), their covariance from the noise of the tracks alone.
    """

    means_m: Floats
    answers: Floats
    noise_m2: Floats


@dataclass(frozen=True)
class Scatter:
    """Relative standard deviations of pressure and B, and the rest as part of what these two make of the stretches.

    `dof` counts replicates beyond the first of each condition; 0 where there are none: then pressure and B scatter as
    the fit says.
    """

    pressure: float
    damping: float
    residual: float
    dof: int

    @property
    def variances(self) -> Floats:
        """Their squares, shape (3,)."""
        return np.array([self.pressure, self.damping, self.residual]) ** 2


def scatter_sensitivities(laid: AlignedTrial) -> list[Floats]:
    """What a unit of pressure and of B does to every trial beside its release, shape (n_points, 2).

    Where growth has ended in the model nothing answers any more, but the vine may still grow: there the answers stay
    what they were.

    Parameters
    ----------
    laid : the model aligned with its trials.

    Returns
    -------
    list of arrays, shape (n_points, 2), m
    """
    held = rest_is_seen(laid.predictor.data)
    answers = []
    for i, columns in enumerate(laid.columns):
        moving = np.flatnonzero(columns[:, RELEASE] != 0)
        kept = columns.copy()
        if moving.size:
            kept[moving[-1] + 1 :, [RELEASE, PRESSURE, DAMPING_DEVIATION]] = columns[
                moving[-1], [RELEASE, PRESSURE, DAMPING_DEVIATION]
            ]
        others = kept[:, [RELEASE]] if held[i] else kept[:, [RELEASE, ORIGIN]]
        answers.append(np.column_stack([without(kept[:, k], others) for k in (PRESSURE, DAMPING_DEVIATION)]))
    return answers


def find_scatter(fit: Fit, groups: Sequence[Stretches]) -> Scatter:
    """The three numbers that make the differences between replicates most likely; a group is a condition.

    Parameters
    ----------
    fit : its between-trial standard deviations stand in where there are no replicates.
    groups : sequence of Stretches
        One a condition.

    Returns
    -------
    Scatter
    """
    from scipy.optimize import minimize

    dof = sum(len(group.means_m) - 1 for group in groups)
    if dof < 1:
        spreads = [fit.spreads[name].value if name in fit.spreads else 0.0 for name in ("pressure", "B")]
        return Scatter(spreads[0], spreads[1], START_VALUES[2], 0)
    parts = []
    for group in groups:
        if len(group.means_m) > 1:
            away = group.means_m - group.means_m.mean(axis=0)
            parts.append((len(away) - 1, away.T @ away, group))

    def cost(logs: Floats) -> float:
        variances = np.exp(2 * np.clip(logs, np.log(LOWER_BOUNDS), np.log(UPPER_BOUNDS)))
        total = 0.0
        for count, square, group in parts:
            covariance = _covariance(group, variances)
            total += count * float(np.linalg.slogdet(covariance)[1])
            total += float(np.trace(np.linalg.solve(covariance, square)))
        return total

    best = minimize(cost, np.log(START_VALUES), method="Nelder-Mead", options={"xatol": 0.02, "fatol": 0.01})
    pressure, damping, residual = np.exp(np.clip(best.x, np.log(LOWER_BOUNDS), np.log(UPPER_BOUNDS))).tolist()
    return Scatter(pressure, damping, residual, dof)


def stretch_covariance(scatter: Scatter, group: Stretches) -> Floats:
    """Covariance of the means of one trial's stretches, shape (n_stretches, n_stretches), m².

    Parameters
    ----------
    scatter
        What replicates differ by.
    group
        Stretches of one condition.

    Returns
    -------
    array, shape (n_stretches, n_stretches), m²
    """
    return _covariance(group, scatter.variances)


def _covariance(group: Stretches, variances: Floats) -> Floats:
    shared = (group.answers * variances[:2]) @ group.answers.T
    residual = variances[2] * float(np.trace(shared)) / len(shared)
    return np.asarray(shared + group.noise_m2 + (residual + POSITION_FLOOR_M**2) * np.eye(len(shared)))


def unlikely(mean: Floats, covariance: Floats, trials: int, scatter: Scatter) -> float:
    """How unlikely replicates alone make means of stretches so large, as a normal deviate.

    The sum of squares of the means in their own errors, for what Satterthwaite's approximation leaves of degrees of
    freedom: stretches err together. The scatter is itself known from `dof` replicates.

    Parameters
    ----------
    mean : array, shape (n_stretches,), m
        Means over the trials of a condition.
    covariance : array, shape (n_stretches, n_stretches), m²
        Of one trial.
    trials : int
        Number of trials.
    scatter : its degrees of freedom count.

    Returns
    -------
    float
    """
    from scipy.stats import chi2, norm
    from scipy.stats import f as fisher

    sigma = np.sqrt(np.diag(covariance))
    degrees = mean.size**2 / float(np.sum((covariance / sigma[:, None] / sigma) ** 2))
    square = trials * float(np.mean((mean / sigma) ** 2))
    p = float(fisher.sf(square, degrees, scatter.dof) if scatter.dof else chi2.sf(square * degrees, degrees))
    return float(norm.isf(max(p, 1e-300)))
