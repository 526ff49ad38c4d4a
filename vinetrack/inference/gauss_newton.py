"""Steps towards the minimum of the penalised sum of squares: Gauss–Newton, damped, and within bounds."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.inference.mixed_effects import (
    FitState,
    MixedProblem,
    solve_per_trial,
    sum_matrix_blocks,
    sum_vector_blocks,
    trial_effect_prior,
)
from vinetrack.inference.sensitivity import N_TRIAL_EFFECTS, RELEASE
from vinetrack.inference.variance_kernels import ACTIVE_SET_CHANGES, LEAST_RELEASE_DECREASE
from vinetrack.inference.whitening import at_correlation


def levenberg_marquardt_step(
    cross_products: Floats, problem: MixedProblem, state: FitState, damping: float
) -> tuple[Floats, Floats, float]:
    """Damped Gauss–Newton step of parameters and trial effects, and the decrease that it predicts. The trial effects
    are eliminated from the normal equations (Schur complement), the reduced system is solved within the bounds, and the
    trial effects follow by back-substitution. Returns step, trial_effect_step, predicted_decrease (of the penalised sum
    of squares along this step, by the linear model without the damping). Shapes: cross_products (n_trials, 3, k, k) →
    (n_free,).
    """
    white = at_correlation(cross_products, state.rho) / state.variance[:, None, None]
    effect_information, effect_gradient = _trial_effect_equations(white, problem, state)
    damped = effect_information * (1 + damping * np.eye(N_TRIAL_EFFECTS))
    cross = white[:, :N_TRIAL_EFFECTS, N_TRIAL_EFFECTS:-1]
    solved = solve_per_trial(damped, np.concatenate([cross, effect_gradient[:, :, None]], axis=2))
    square = sum_matrix_blocks(white[:, N_TRIAL_EFFECTS:-1, N_TRIAL_EFFECTS:-1], problem) + np.diag(
        problem.prior_precision
    )
    slope = sum_vector_blocks(white[:, N_TRIAL_EFFECTS:-1, -1], problem) - problem.prior_precision * (
        state.theta - problem.prior_mean
    )
    reduced = square * (1 + damping * np.eye(square.shape[0]))
    reduced = reduced - sum_matrix_blocks(np.swapaxes(cross, 1, 2) @ solved[:, :, :-1], problem)
    reduced_slope = slope - sum_vector_blocks(np.einsum("nuk,nu->nk", cross, solved[:, :, -1]), problem)
    step, _ = bounded_solve(reduced, reduced_slope, problem, state.theta)
    step_of_keys = np.append(step, 0.0)[problem.index]
    trial_effect_step = solved[:, :, -1] - np.einsum("nuk,nk->nu", solved[:, :, :-1], step_of_keys)
    # 2 sᵀg − sᵀHs with the undamped H. Only for a full Gauss–Newton step, where Hs = g, is that sᵀg.
    curvature = (
        step @ square @ step
        + 2 * np.einsum("nu,nuk,nk->", trial_effect_step, cross, step_of_keys)
        + np.einsum("nu,nuv,nv->", trial_effect_step, effect_information, trial_effect_step)
    )
    predicted_decrease = float(2 * (step @ slope + np.sum(trial_effect_step * effect_gradient)) - curvature)
    return step, trial_effect_step, predicted_decrease


def trial_effect_step(
    cross_products: Floats, problem: MixedProblem, state: FitState, *, fixed_release: bool = False
) -> Floats:
    """Gauss–Newton step of the trial effects at fixed parameters. Shapes: cross_products (n_trials, 3, k, k) →
    (n_trials, 4).
    """
    white = at_correlation(cross_products, state.rho) / state.variance[:, None, None]
    square, slope = _trial_effect_equations(white, problem, state)
    if fixed_release:
        square[:, RELEASE, :] = square[:, :, RELEASE] = slope[:, RELEASE] = 0.0
        square[:, RELEASE, RELEASE] = 1.0
    return np.asarray(solve_per_trial(square, slope[:, :, None])[:, :, 0])


def _trial_effect_equations(white: Floats, problem: MixedProblem, state: FitState) -> tuple[Floats, Floats]:
    """Information of the trial effects, and half the negative gradient of the sum of squares, their priors included."""
    centre, precision = trial_effect_prior(problem, state)
    information = white[:, :N_TRIAL_EFFECTS, :N_TRIAL_EFFECTS] + precision[:, :, None] * np.eye(N_TRIAL_EFFECTS)
    return information, white[:, :N_TRIAL_EFFECTS, -1] - precision * (state.trial_effects - centre)


def bounded_solve(
    square: Floats, slope: Floats, problem: MixedProblem, theta: Floats
) -> tuple[Floats, NDArray[np.bool_]]:
    """Step to the minimum of a quadratic form within bounds. Primal active-set method (Nocedal & Wright, Numerical
    Optimization, 2nd ed., Springer 2006, algorithm 16.3): a parameter that meets its bound is held there while the
    others go on. Returns step, moving (parameters that do not end at a bound). Shapes: square (n_free, n_free); slope,
    theta (n_free,) → (n_free,).
    """
    moving = problem.free & (np.diag(square) > 0)
    if moving.all():
        # In most calls no bound is active, and a single solve suffices. A fit calls this some hundred times.
        full_step = solve_scaled(square, slope)
        distance_to_bound = np.where(full_step > 0, problem.upper - theta, theta - problem.lower)
        if (np.abs(full_step) <= distance_to_bound).all():
            return full_step, moving
    step, outward = np.zeros_like(slope), np.zeros_like(slope)
    for _ in range(ACTIVE_SET_CHANGES * slope.size + 1):
        k = np.flatnonzero(moving)
        if k.size:
            at_bound = np.flatnonzero(~moving)
            remaining_step = (
                solve_scaled(square[np.ix_(k, k)], slope[k] - square[np.ix_(k, at_bound)] @ step[at_bound]) - step[k]
            )
            # Go as far as the first bound, which lowers the sum of squares; fix those parameters, go on with the rest.
            current = theta[k] + step[k]
            distance_to_bound = np.where(remaining_step > 0, problem.upper[k] - current, problem.lower[k] - current)
            with np.errstate(divide="ignore", invalid="ignore"):
                part = np.where(remaining_step == 0, np.inf, np.maximum(distance_to_bound / remaining_step, 0.0))
            first = float(np.min(part))
            step[k] += min(first, 1.0) * remaining_step
            if first < 1:
                met = part <= first
                outward[k[met]], moving[k[met]] = np.sign(remaining_step[met]), False
                continue
        # Decrease of the form if a parameter alone left its bound.
        inward = np.where(moving, 0.0, np.maximum(-outward * (slope - square @ step), 0.0))
        decrease = inward**2 / np.where(outward != 0, np.diag(square), 1.0)
        if not decrease.max(initial=0.0) > LEAST_RELEASE_DECREASE:
            break
        moving[np.argmax(decrease)] = True
    return step, moving


def solve_scaled(square: Floats, slope: Floats) -> Floats:
    """Solve a symmetric system scaled to a unit diagonal, by least squares where it is singular. Shapes: square (n, n);
    slope (n,) → (n,).
    """
    scale = 1 / np.sqrt(np.maximum(np.diag(square), 1e-300))
    scaled = square * scale[:, None] * scale
    return np.asarray(scale * np.linalg.lstsq(scaled, scale * slope, rcond=1e-12)[0])
