"""How well a solution describes the tracks: χ² per degree of freedom, relative residual, and what counts as poor."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from vinetrack.inference.fit_problem import track_correlation, variance_floor
from vinetrack.inference.whitening import at_correlation

if TYPE_CHECKING:
    from vinetrack.inference.optimiser import Solution
    from vinetrack.inference.sensitivity import Predictor

# χ² per degree of freedom above which a fit may be at a local minimum, and other starts are tried (chosen)
POOR_FIT = 3.0

# Residual of the median trial, relative to its growth, above which a fit is poor (chosen)
POOR_RELATIVE_RESIDUAL = 3e-3


def chi2_per_dof(predictor: Predictor, solution: Solution) -> float:
    """χ² per degree of freedom, relative to the noise (variance and correlation) estimated from the tracks alone. Noise
    below the accuracy of the integrator is replaced by that accuracy, see `fit_problem.variance_floor`.
    """
    data = predictor.data
    rho = track_correlation(data)
    noise = np.maximum(np.array([trial_data.noise_m**2 for trial_data in data]) * (1 - rho**2), variance_floor(data))
    residual_squares = at_correlation(solution.cross_products, rho)[:, -1, -1]
    fitted_degrees = (
        np.count_nonzero(solution.problem.free) / residual_squares.size + 2 + solution.problem.has_deviation.any(axis=1)
    )
    return float(np.sum(residual_squares / noise) / np.sum(np.maximum(solution.problem.points - fitted_degrees, 1.0)))


def is_poor_fit(predictor: Predictor, solution: Solution) -> bool:
    """Whether a solution misses the tracks by far more than their noise and by a visible fraction of the growth. Both
    are needed: a tracker whose frames agree to a hundredth of a millimetre may have slow errors of a few tenths. That
    is far above its noise, but no reason to try other starts.
    """
    return bool(
        chi2_per_dof(predictor, solution) > POOR_FIT and relative_residual(predictor, solution) > POOR_RELATIVE_RESIDUAL
    )


def relative_residual(predictor: Predictor, solution: Solution) -> float:
    """Root mean square residual of the median trial, relative to its observed growth."""
    relative = [
        math.sqrt(float(np.mean(columns[:, -1] ** 2))) / max(float(np.ptp(trial_data.lead_position_m)), 1e-9)
        for columns, trial_data in zip(solution.columns, predictor.data, strict=True)
    ]
    return float(np.median(relative))
