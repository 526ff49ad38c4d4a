"""The nonlinear mixed-effects model of a fit, and its linearisation about the current trajectories.

Point j of trial i, of vine v(i), is measured at time t_ij and lies at

    y_ij = o_i + f(t_ij − r_i; θ, ln B_v(i) + b_i + z_iᵀγ, P_i (1 + p_i + z_iᵀγ)) + e_ij

About the current θ and u_i the residuals are linear in both, r_i = X_i Δθ + Z_i Δu_i + e_i, with the sensitivities of
`vinetrack.inference.sensitivity`. The estimates, repeated in turn until they converge (Lindstrom & Bates, Biometrics
46, 673, 1990; Pinheiro & Bates, Mixed-Effects Models in S and S-PLUS, Springer 2000, chapter 7):
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numba import njit
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.inference.sensitivity import DAMPING_DEVIATION, N_TRIAL_EFFECTS, PRESSURE
from vinetrack.inference.whitening import at_correlation

# ------------------------------------------------------------------------------
# Compiled loops over trials for the likelihood of the variance components, which a fit evaluates some thousand times.
#
# Each trial has only a handful of columns, so that with array operations most of the time would go into calling them.

RIDGE = 1e-13  # Added to the diagonal of systems with a unit diagonal before they are solved (derived)


LEAST_RELEASE_DECREASE = 1e-6  # Decrease of −2 ln L, by leaving its bound, from which a parameter is released (derived)

# Bounds met or released per parameter, at most, in the search for the minimum within bounds (chosen)
ACTIVE_SET_CHANGES = 10


@njit(cache=True, nogil=True, error_model="numpy")
def decrease_within_bounds(
    matrix: Floats, slope: Floats, below: Floats, above: Floats, free: NDArray[np.bool_]
) -> tuple[bool, float, float]:
    """Decrease of a quadratic form by the step to its minimum within bounds, found as in `gauss_newton.bounded_solve`.
    Returns solved (whether every pivot is large enough; if not, the other two values are meaningless), decrease,
    log_det (of the information of the parameters that are not at a bound). Shapes: matrix (n, n); slope, below, above,
    free (n,).
    """
    size = len(slope)
    moving, step, outward = np.empty(size, np.bool_), np.zeros(size), np.zeros(size)
    for u in range(size):
        moving[u] = free[u] and matrix[u, u] > 0
    places, scale = np.empty(size, np.int64), np.empty(size)
    log_det = 0.0
    for _ in range(ACTIVE_SET_CHANGES * size + 1):
        count = 0
        for u in range(size):
            if moving[u]:
                places[count] = u
                scale[count] = 1 / math.sqrt(matrix[u, u])
                count += 1
        scaled, lower, remaining = np.empty((count, count)), np.empty((count, count)), np.empty(count)
        log_det, fraction_to_bound = 0.0, np.inf
        for i in range(count):
            u = places[i]
            for j in range(i + 1):
                scaled[i, j] = scale[i] * matrix[u, places[j]] * scale[j]
            remaining_slope = slope[u]
            for v in range(size):
                if not moving[v]:
                    remaining_slope -= matrix[u, v] * step[v]
            remaining[i] = scale[i] * remaining_slope
        _factor(scaled, 0.0, lower)
        for i in range(count):
            # 1e-9: least pivot of a factorised system of unit diagonal, the part of its information that
            # a parameter keeps once the previous ones are eliminated; below it the system is left to
            # least squares, which drop what is singular (derived)
            if not lower[i, i] > 1e-9:
                return False, 0.0, 0.0
            log_det += math.log(lower[i, i]) - 2 * math.log(scale[i])
        _solve(lower, remaining)
        for i in range(count):
            u = places[i]
            remaining[i] = scale[i] * remaining[i] - step[u]
            distance_to_bound = above[u] - step[u] if remaining[i] > 0 else -below[u] - step[u]
            if remaining[i] != 0:
                fraction_to_bound = min(fraction_to_bound, max(distance_to_bound / remaining[i], 0.0))
        bound_met = fraction_to_bound < 1
        for i in range(count):
            u = places[i]
            distance_to_bound = above[u] - step[u] if remaining[i] > 0 else -below[u] - step[u]
            if bound_met and remaining[i] != 0 and max(distance_to_bound / remaining[i], 0.0) <= fraction_to_bound:
                moving[u], outward[u] = False, 1.0 if remaining[i] > 0 else -1.0
            step[u] += min(fraction_to_bound, 1.0) * remaining[i]
        if bound_met:
            continue
        released, largest = -1, LEAST_RELEASE_DECREASE
        for u in range(size):
            if moving[u] or outward[u] == 0.0:
                continue
            pull = slope[u]
            for v in range(size):
                pull -= matrix[u, v] * step[v]
            if -outward[u] * pull > 0.0 and pull * pull / matrix[u, u] > largest:
                released, largest = u, pull * pull / matrix[u, u]
        if released < 0:
            break
        moving[released] = True
    decrease = 0.0
    for u in range(size):
        product = 0.0
        for v in range(size):
            product += matrix[u, v] * step[v]
        decrease += step[u] * (2 * slope[u] - product)
    return True, decrease, log_det


@njit(cache=True, nogil=True, error_model="numpy")
def normal_equations_without_deviations(
    blocks: Floats, places: NDArray[np.int_], deviation_sd: Floats, size: int
) -> tuple[Floats, Floats, float, float]:
    """Normal equations of the free parameters with the two deviations of each trial integrated out, summed over trials.
    Returns information, slope, square (residual sum of squares), log_det (sum over trials of ln det(I + S Z S), S the
    standard deviations and Z the cross products of deviations). Shapes: blocks (n_trials, 2 + n_keys + 1, 2 + n_keys +
    1); places (n_trials, n_keys); deviation_sd (n_trials, 2) → (size, size).
    """
    last = blocks.shape[1] - 1
    information, slope = np.zeros((size + 1, size + 1)), np.zeros(size + 1)
    square, log_det = 0.0, 0.0
    of_pressure, of_damping = np.empty(last + 1), np.empty(last + 1)
    for i in range(len(blocks)):
        block, places_of_trial = blocks[i], places[i]
        sd_pressure, sd_damping = deviation_sd[i, 0], deviation_sd[i, 1]
        # Eliminated one after the other, by the Cholesky factor of I + S Z S. At steady speed its two columns are
        # nearly collinear, and the explicit inverse would lose the residual of precise positions to cancellation.
        pivot_pressure = 1.0 + sd_pressure * sd_pressure * block[0, 0]
        for u in range(1, last + 1):
            of_pressure[u] = sd_pressure * block[0, u] / math.sqrt(pivot_pressure)
        pivot_damping = 1.0 + sd_damping * sd_damping * (block[1, 1] - of_pressure[1] * of_pressure[1])
        for u in range(2, last + 1):
            of_damping[u] = sd_damping * (block[1, u] - of_pressure[1] * of_pressure[u]) / math.sqrt(pivot_damping)
        log_det += math.log(pivot_pressure) + math.log(pivot_damping)
        for u in range(2, last + 1):
            for v in range(2, u + 1):
                left = block[u, v] - of_pressure[u] * of_pressure[v] - of_damping[u] * of_damping[v]
                if u < last:
                    information[places_of_trial[u - 2], places_of_trial[v - 2]] += left
                    if v < u:
                        information[places_of_trial[v - 2], places_of_trial[u - 2]] += left
                elif v < last:
                    slope[places_of_trial[v - 2]] += left
                else:
                    square += left
    return information[:size, :size].copy(), slope[:size].copy(), square, log_det


@njit(cache=True, nogil=True, error_model="numpy")
def noise_at_correlations(
    cross_products: Floats,
    prior_precision: Floats,
    prior_gradient: Floats,
    points: Floats,
    rhos: Floats,
    shared: float,
    least_residual_part: float,
) -> tuple[Floats, Floats, Floats]:
    """Restricted likelihood and residual sums of squares of all trials at each noise correlation, trial effects fitted.
    Returns scores (−2 ln of the restricted likelihood, profiled over the variances, without the term of the gaps),
    squares, degrees (residual sums of squares and their degrees of freedom). Shapes: cross_products (n_trials, 3, m +
    1, m + 1); prior_precision, prior_gradient (n_trials, m); points (n_trials,); rhos (n_rhos,) → (n_rhos,).
    """
    trials, m = prior_precision.shape
    scores = np.zeros(len(rhos))
    squares, degrees = np.empty((len(rhos), trials)), np.empty((len(rhos), trials))
    white, scaled, lower = np.empty((m + 1, m + 1)), np.empty((m, m)), np.empty((m, m))
    scale, solution = np.empty(m), np.empty(m)
    for k in range(len(rhos)):
        rho = rhos[k]
        for i in range(trials):
            lag_zero, lag_one, inner = cross_products[i, 0], cross_products[i, 1], cross_products[i, 2]
            for u in range(m + 1):
                for v in range(m + 1):
                    white[u, v] = lag_zero[u, v] - rho * lag_one[u, v] + rho * rho * inner[u, v]
            log_det = 0.0
            for u in range(m):
                scale[u] = 1 / math.sqrt(white[u, u] + prior_precision[i, u])
                log_det -= 2 * math.log(scale[u])
            for u in range(m):
                for v in range(m):
                    scaled[u, v] = scale[u] * white[u, v] * scale[v]
                scaled[u, u] += scale[u] * prior_precision[i, u] * scale[u]
            _factor(scaled, 0.0, lower)
            for u in range(m):
                log_det += math.log(abs(lower[u, u]))
            _factor(scaled, RIDGE, lower)
            dof_taken, explained = shared, 0.0
            for v in range(m):
                for u in range(m):
                    solution[u] = scale[u] * white[u, v] * scale[v]
                _solve(lower, solution)
                dof_taken += solution[v]
            for u in range(m):
                solution[u] = scale[u] * (white[u, m] - prior_gradient[i, u])
            _solve(lower, solution)
            for u in range(m):
                explained += scale[u] * (white[u, m] - prior_gradient[i, u]) * solution[u]
            dof = max(points[i] - dof_taken, 1.0)
            residual_square = max(white[m, m] - explained, least_residual_part * white[m, m])
            scores[k] += dof * math.log(residual_square / dof) + log_det
            squares[k, i], degrees[k, i] = residual_square, dof
    return scores, squares, degrees


@njit(cache=True, nogil=True, error_model="numpy")
def _factor(matrix: Floats, ridge: float, lower: Floats) -> None:
    """LDLᵀ factorisation of a symmetric matrix with `ridge` added to its diagonal; D is the diagonal of `lower`."""
    size = len(matrix)
    for u in range(size):
        for v in range(u + 1):
            left = matrix[u, v] + (ridge if u == v else 0.0)
            for w in range(v):
                left -= lower[u, w] * lower[v, w] * lower[w, w]
            lower[u, v] = left if u == v else left / lower[v, v]


@njit(cache=True, nogil=True, error_model="numpy")
def _solve(lower: Floats, right: Floats) -> None:
    """Solve with the factors of `_factor`, in place."""
    size = len(right)
    for u in range(size):
        for v in range(u):
            right[u] -= lower[u, v] * right[v]
    for u in range(size):
        right[u] /= lower[u, u]
    for u in range(size - 1, -1, -1):
        for v in range(u + 1, size):
            right[u] -= lower[v, u] * right[v]


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
