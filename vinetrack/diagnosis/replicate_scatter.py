"""Between-trial scatter from replicates alone, and the standard error of a condition's mean residual that follows.

Residuals of one trial are correlated from frame to frame: a trial with 3 % more B is late everywhere. Frames are
therefore not counted as independent. Every trial is cut into a few stretches, and the covariance of the stretch means
between replicates has three parameters for all conditions: the scatter of pressure and of B, propagated by the
sensitivities of the trajectories, and a residual scatter that is independent between stretches. They are estimated from
differences between replicates alone, so that a model that fails does not inflate them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.diagnosis.per_trial_estimates import AlignedTrials, orthogonal_part
from vinetrack.inference.fit_result import Fit
from vinetrack.inference.left_out import rest_is_seen
from vinetrack.inference.sensitivity import DAMPING_DEVIATION, ORIGIN, PRESSURE, RELEASE

START_VALUES = (0.01, 0.03, 0.2)  # Starting values of the search: pressure, ln B, residual scatter (chosen)

LOWER_BOUNDS, UPPER_BOUNDS = (1e-5, 1e-5, 1e-3), (0.2, 0.5, 3.0)  # Bounds of the search (chosen)

# Lower limits of the standard deviations of pressure and B where both are needed (chosen)
LEAST_BETWEEN_TRIAL_SD = (0.005, 0.015)

POSITION_FLOOR_M = 1e-6  # Lower limit of the error of a stretch mean, m (chosen)


@dataclass(frozen=True)
class Stretches:
    """Stretches of the motion that all replicates of a condition cover. `means_m`, shape (n_trials, n), are the mean
    residuals; `sensitivities`, shape (n, 2), their derivatives by pressure and ln B; `noise_m2`, shape (n, n), their
    covariance from the noise of the tracks alone.
    """

    means_m: Floats
    sensitivities: Floats
    noise_m2: Floats


@dataclass(frozen=True)
class Scatter:
    """Between-trial standard deviations of pressure (relative) and ln B, and of a residual, relative to their effect.
    `dof` counts replicates beyond the first of each condition. Where it is 0, the standard deviations of pressure and B
    are those of the fit.
    """

    pressure: float
    damping: float
    residual: float
    dof: int

    @property
    def variances(self) -> Floats:
        """Squares of the three, shape (3,)."""
        return np.array([self.pressure, self.damping, self.residual]) ** 2


def scatter_sensitivities(aligned: AlignedTrials) -> list[Floats]:
    """Sensitivities of positions to pressure and ln B, orthogonal to those to release and origin, of every trial. Where
    growth has ended in the model they would be zero, but the vine may still grow: the last values are kept. Shape
    (n_points, 2).
    """
    origin_fixed = rest_is_seen(aligned.predictor.data)
    sensitivities = []
    for i, columns in enumerate(aligned.columns):
        moving = np.flatnonzero(columns[:, RELEASE] != 0)
        extended = columns.copy()
        if moving.size:
            extended[moving[-1] + 1 :, [RELEASE, PRESSURE, DAMPING_DEVIATION]] = columns[
                moving[-1], [RELEASE, PRESSURE, DAMPING_DEVIATION]
            ]
        others = extended[:, [RELEASE]] if origin_fixed[i] else extended[:, [RELEASE, ORIGIN]]
        sensitivities.append(
            np.column_stack([orthogonal_part(extended[:, k], others) for k in (PRESSURE, DAMPING_DEVIATION)])
        )
    return sensitivities


def find_scatter(fit: Fit, groups: Sequence[Stretches]) -> Scatter:
    """Maximum-likelihood estimate of the between-trial scatter from the differences between replicates."""
    from scipy.optimize import minimize

    dof = sum(len(group.means_m) - 1 for group in groups)
    if dof < 1:
        spreads = [fit.spreads[name].value if name in fit.spreads else 0.0 for name in ("pressure", "B")]
        return Scatter(spreads[0], spreads[1], START_VALUES[2], 0)
    parts = []
    for group in groups:
        if len(group.means_m) > 1:
            deviations = group.means_m - group.means_m.mean(axis=0)
            parts.append((len(deviations) - 1, deviations.T @ deviations, group))

    def minus_two_log_likelihood(logs: Floats) -> float:
        variances = np.exp(2 * np.clip(logs, np.log(LOWER_BOUNDS), np.log(UPPER_BOUNDS)))
        total = 0.0
        for count, square, group in parts:
            covariance = _covariance(group, variances)
            total += count * float(np.linalg.slogdet(covariance)[1])
            total += float(np.trace(np.linalg.solve(covariance, square)))
        return total

    best = minimize(
        minus_two_log_likelihood, np.log(START_VALUES), method="Nelder-Mead", options={"xatol": 0.02, "fatol": 0.01}
    )
    pressure, damping, residual = np.exp(np.clip(best.x, np.log(LOWER_BOUNDS), np.log(UPPER_BOUNDS))).tolist()
    return Scatter(pressure, damping, residual, dof)


def stretch_covariance(scatter: Scatter, group: Stretches) -> Floats:
    """Covariance of the means of one trial's stretches, shape (n_stretches, n_stretches), m². Shape (n_stretches,
    n_stretches).
    """
    return _covariance(group, scatter.variances)


def _covariance(group: Stretches, variances: Floats) -> Floats:
    shared = (group.sensitivities * variances[:2]) @ group.sensitivities.T
    residual = variances[2] * float(np.trace(shared)) / len(shared)
    return np.asarray(shared + group.noise_m2 + (residual + POSITION_FLOOR_M**2) * np.eye(len(shared)))


def replicate_z(mean: Floats, covariance: Floats, trials: int, scatter: Scatter) -> float:
    """Test whether between-trial scatter explains stretch means as large as observed; the p-value as a normal deviate.
    The test statistic is the mean square of the means in units of their standard errors, with the effective degrees of
    freedom of Satterthwaite's approximation, because stretches are correlated. Shapes: mean (n_stretches,); covariance
    (n_stretches, n_stretches).
    """
    from scipy.stats import chi2, norm
    from scipy.stats import f as fisher

    sigma = np.sqrt(np.diag(covariance))
    degrees = mean.size**2 / float(np.sum((covariance / sigma[:, None] / sigma) ** 2))
    square = trials * float(np.mean((mean / sigma) ** 2))
    p = float(fisher.sf(square, degrees, scatter.dof) if scatter.dof else chi2.sf(square * degrees, degrees))
    return float(norm.isf(max(p, 1e-300)))
