"""The nonlinear mixed-effects model of a fit, and its linearisation about the current trajectories.

Point j of trial i, of vine v(i), is measured at time t_ij and lies at

    y_ij = o_i + f(t_ij − r_i; θ, ln B_v(i) + b_i + z_iᵀγ, P_i (1 + p_i + z_iᵀγ)) + e_ij

About the current θ and u_i the residuals are linear in both, r_i = X_i Δθ + Z_i Δu_i + e_i, with the sensitivities of
`vinetrack.inference.sensitivity`. The estimates, repeated in turn until they converge (Lindstrom & Bates, Biometrics
46, 673, 1990; Pinheiro & Bates, Mixed-Effects Models in S and S-PLUS, Springer 2000, chapter 7):
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.inference.sensitivity import DAMPING_DEVIATION, N_TRIAL_EFFECTS, PRESSURE
from vinetrack.inference.variance_kernels import RIDGE
from vinetrack.inference.whitening import at_correlation

LEAST_BETWEEN_TRIAL_SD = 1e-5  # Least between-trial standard deviation (chosen)

DEVIATION_COLUMNS = (PRESSURE, DAMPING_DEVIATION)


@dataclass(frozen=True)
class FitState:
    """Current estimates of a fit."""

    theta: Floats
    trial_effects: Floats
    spread: tuple[float, float]
    rho: float
    variance: Floats


@dataclass(frozen=True)
class MixedProblem:
    """The constant part of a fit: design, priors and bounds. `index`, shape (n_trials, n_keys), maps each trial's
    sensitivity columns to the free parameters, -1 where a trial does not depend on one.
    """

    index: NDArray[np.int_]
    has_deviation: NDArray[np.bool_]
    gauge_error: Floats
    release_origin_mean: Floats
    release_origin_precision: Floats
    prior_mean: Floats
    prior_precision: Floats
    lower: Floats
    upper: Floats
    free: NDArray[np.bool_]
    points: Floats
    stretches: Floats
    random: NDArray[np.bool_] | None = None

    @cached_property
    def places(self) -> NDArray[np.int_]:
        """`index` with -1 replaced by n_free, one past the last parameter."""
        return np.where(self.index < 0, self.prior_mean.size, self.index)


def trial_effect_prior(problem: MixedProblem, state: FitState) -> tuple[Floats, Floats]:
    """Prior mean and precision of the trial effects. Returns centre, precision : arrays, shape (n_trials, 4)."""
    n = problem.index.shape[0]
    centre, precision = np.zeros((n, N_TRIAL_EFFECTS)), np.ones((n, N_TRIAL_EFFECTS))
    centre[:, :2], precision[:, :2] = problem.release_origin_mean, problem.release_origin_precision
    precision[:, DEVIATION_COLUMNS] = (
        1 / np.maximum(trial_deviation_sd(problem, state.spread), LEAST_BETWEEN_TRIAL_SD) ** 2
    )
    return centre, precision


def trial_deviation_sd(problem: MixedProblem, spread: tuple[float, float]) -> Floats:
    """Standard deviations of the deviations of pressure and ln B of each trial. Returns the gauge's error in place of
    the first for a measured pressure. Shape (n_trials, 2).
    """
    sd = np.empty((problem.gauge_error.size, 2))
    sd[:, 0] = np.where(problem.gauge_error > 0, problem.gauge_error, spread[0])
    sd[:, 1] = spread[1]
    return sd


def shared_penalty(problem: MixedProblem, state: FitState) -> float:
    """Contribution of the priors of the free parameters to the penalised sum of squares."""
    return float(np.sum(problem.prior_precision * (state.theta - problem.prior_mean) ** 2))


def trial_effect_penalty(problem: MixedProblem, state: FitState) -> Floats:
    """Contribution of the priors of each trial's effects to the penalised sum of squares. Shape (n_trials,)."""
    centre, precision = trial_effect_prior(problem, state)
    return np.asarray(np.sum(precision * (state.trial_effects - centre) ** 2, axis=1))


def sum_matrix_blocks(blocks: Floats, problem: MixedProblem) -> Floats:
    """Add the matrix block of each trial to the rows and columns of its free parameters, over all trials. Shapes:
    blocks (n_trials, n_keys, n_keys) → (n_free, n_free).
    """
    p = problem.prior_mean.size
    columns = problem.places
    flat_index = columns[:, :, None] * (p + 1) + columns[:, None, :]
    total = np.bincount(flat_index.ravel(), weights=blocks.ravel(), minlength=(p + 1) ** 2)
    return np.asarray(total.reshape(p + 1, p + 1)[:p, :p])


def sum_vector_blocks(blocks: Floats, problem: MixedProblem) -> Floats:
    """Add the vector block of each trial to the entries of its free parameters, over all trials. Shapes: blocks
    (n_trials, n_keys) → (n_free,).
    """
    p = problem.prior_mean.size
    return np.asarray(np.bincount(problem.places.ravel(), weights=blocks.ravel(), minlength=p + 1)[:p])


def inverse_of_block(square: Floats, places: NDArray[np.int_]) -> Floats:
    """Pseudo-inverse of the block of a symmetric matrix at these places, 0 elsewhere. Shapes: square (n, n)
    → (n, n).
    """
    scale = 1 / np.sqrt(np.diag(square)[places])
    scaled = square[np.ix_(places, places)] * scale[:, None] * scale
    inverse = np.zeros_like(square)
    inverse[np.ix_(places, places)] = np.linalg.pinv(scaled, rcond=1e-11, hermitian=True) * scale[:, None] * scale
    return inverse


def solve_per_trial(square: Floats, right: Floats) -> Floats:
    """Solve one small symmetric system per trial, each scaled to a unit diagonal. Shapes: square (n_trials, k, k);
    right (n_trials, k, m) → (n_trials, k, m).
    """
    scale = 1 / np.sqrt(np.einsum("nkk->nk", square))
    scaled = square * scale[:, :, None] * scale[:, None, :] + RIDGE * np.eye(square.shape[1])
    return np.asarray(scale[:, :, None] * np.linalg.solve(scaled, scale[:, :, None] * right))


def trial_effects_eliminated(cross_products: Floats, n_keys: int, problem: MixedProblem, state: FitState) -> Floats:
    """Whitened cross products of keys, residual and further columns with the trial effects integrated out. Shapes:
    cross_products (n_trials, 3, k, k) → (n_trials, k − 4, k − 4).
    """
    white = at_correlation(cross_products, state.rho) / state.variance[:, None, None]
    white = at_zero_deviations(white, state, N_TRIAL_EFFECTS + n_keys)
    within_trial = white[:, :N_TRIAL_EFFECTS, :N_TRIAL_EFFECTS] + trial_effect_prior(problem, state)[1][
        :, :, None
    ] * np.eye(N_TRIAL_EFFECTS)
    cross = white[:, :N_TRIAL_EFFECTS, N_TRIAL_EFFECTS:]
    return np.asarray(
        white[:, N_TRIAL_EFFECTS:, N_TRIAL_EFFECTS:] - np.swapaxes(cross, 1, 2) @ solve_per_trial(within_trial, cross)
    )


def at_zero_deviations(white: Floats, state: FitState, residual: int) -> Floats:
    """Cross products with the residual taken at zero deviations of pressure and ln B instead of the current ones.
    Shapes: white (n_trials, k, k) → (n_trials, k, k).
    """
    columns = list(DEVIATION_COLUMNS)
    effects = state.trial_effects[:, columns, None]
    explained = (white[:, :, columns] @ effects)[:, :, 0]
    restored = white.copy()
    restored[:, :, residual] += explained
    restored[:, residual, :] = restored[:, :, residual]
    # With r' = r + Z d, the product r'ᵀr' has the cross term rᵀZd twice, and dᵀZᵀZd.
    restored[:, residual, residual] += explained[:, residual] + np.sum(explained[:, columns] * effects[:, :, 0], axis=1)
    return np.asarray(restored)
