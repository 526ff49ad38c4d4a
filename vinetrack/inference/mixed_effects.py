"""The nonlinear mixed-effects model of a fit, and its linear form about the current trajectories.

Point j of trial i, of vine v(i), is measured at time t_ij and lies at

    y_ij = o_i + f(t_ij − r_i; θ, ln B_v(i) + b_i + z_iᵀγ, P_i (1 + p_i + z_iᵀγ)) + e_ij

f : position of the leading edge that the equation of motion predicts, m, by time since release.
θ : shared numbers: ln B of each vine, n and what else the model leaves free, yield pressures where the sheet gives
    them an error, and γ, the coefficients of differences between trials (`parameters.BetweenTerm`: z_i is 0 without
    them, and γ acts on ln B or on the pressure). Priors: N(stated value, stated error²) where the sheet states one, and
    for coefficients of groups that are random; flat between the bounds of a number otherwise.
u_i = (r_i, o_i, p_i, b_i) : random effects of the trial: release, s; origin, m; relative deviation of the pressure;
    deviation of ln B. Independent from trial to trial and of each other, normal, with the standard deviations
    r_i : RELEASE_ROOM_FRAMES frames about the first guess where the rest is seen, three durations of the track where
          it is not, `fit_problem.KNOWN_RELEASE_S` where the pressure was let in during the recording;
    o_i : ORIGIN_ROOM_SIGMAS of the noise where the rest is seen, else three spans of the track;
    p_i : σ_P, one for all trials; the gauge's error where the pressure was measured; 0 where no pressure drives;
    b_i : σ_B, one for all trials; 0 for bodies without B.
e_ij : s_ij times stationary AR(1) noise with the correlation ρ of all trials and an innovation variance of each, v_i;
    independent on either side of a gap. s_ij is the stated noise of a point relative to that of its trial, 1 without.

About the current θ and u_i the residuals are linear in both, r_i = X_i Δθ + Z_i Δu_i + e_i, with the sensitivities of
`vinetrack.inference.sensitivity`. What is estimated by which likelihood, in turns until nothing moves:

1. θ and u_i by Gauss–Newton steps at given σ_P, σ_B, ρ, v_i: the mode of the penalised sum of squares, u_i eliminated
   analytically so that the cost is linear in the number of trials; then new trajectories (Lindstrom & Bates, Biometrics
   46, 673, 1990).
2. σ_P and σ_B by the restricted likelihood of the linear model, u_i and θ integrated out
   (`marginal_likelihood.estimate_between_trial_sd`; Patterson & Thompson, Biometrika 58, 545, 1971). One that applies
   to too few trials stays as stated.
3. ρ and v_i by the restricted likelihood of what is left once u_i has been fitted, v_i drawn to the common variance as
   far as trials differ by chance (`marginal_likelihood.estimate_noise`).
4. Models are compared by the marginal likelihood, u_i (and random γ) integrated out, θ at its best and σ_P, σ_B at
   theirs for it: the restricted one cannot compare models with other θ (`assemble.log_likelihood`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.inference.sensitivity import DAMPING_DEVIATION, N_TRIAL_EFFECTS, PRESSURE, RELEASE
from vinetrack.inference.variance_kernels import RIDGE
from vinetrack.inference.whitening import at_correlation

LEAST_BETWEEN_TRIAL_SD = 1e-5
"""Least between-trial standard deviation. Chosen far below what any rig repeats, so that its logarithm stays
finite."""

DEVIATION_COLUMNS = (PRESSURE, DAMPING_DEVIATION)


@dataclass(frozen=True)
class FitState:
    """Where a fit stands.

    `theta`, shape (n_free,), scaled; `trial_effects`, shape (n_trials, 4), see `vinetrack.inference.sensitivity`;
    `spread` the relative standard deviations of pressure and B from trial to trial; `rho` the lag-one correlation of
    the noise and `variance`, shape (n_trials,), that of its innovations, m².
    """

    theta: Floats
    trial_effects: Floats
    spread: tuple[float, float]
    rho: float
    variance: Floats


@dataclass(frozen=True)
class MixedProblem:
    """What does not change during a fit.

    `index`, shape (n_trials, n_keys), maps each trial's sensitivity columns to the free parameters, -1 where a trial
    does not depend on one. `feels`, shape (n_trials, 2), tells which trials have a deviation of pressure and of B.
    `gauge_error`, shape (n_trials,), is the relative error of a measured pressure, 0 for a set pressure.
    `release_origin_mean` and `release_origin_precision`, shape (n_trials, 2), are the prior of release and origin, so
    wide that it matters only where a track leaves them undetermined. `free` marks the parameters that are estimated;
    `points` and `stretches` count those of each trial. `random` marks parameters that are random effects of a group of
    trials; their prior is the distribution of the groups.
    """

    index: NDArray[np.int_]
    feels: NDArray[np.bool_]
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
        """`index` with the place behind all numbers for keys that a trial does not feel."""
        return np.where(self.index < 0, self.prior_mean.size, self.index)


def trial_effect_prior(problem: MixedProblem, state: FitState) -> tuple[Floats, Floats]:
    """Centre and precision of each trial's own numbers, shape (n_trials, 4) each.

    Parameters
    ----------
    problem : what does not change during the fit.
    state : where the fit stands.

    Returns
    -------
    centre, precision : arrays, shape (n_trials, 4)
    """
    n = problem.index.shape[0]
    centre, precision = np.zeros((n, N_TRIAL_EFFECTS)), np.ones((n, N_TRIAL_EFFECTS))
    centre[:, :2], precision[:, :2] = problem.release_origin_mean, problem.release_origin_precision
    precision[:, DEVIATION_COLUMNS] = 1 / np.maximum(spreads(problem, state.spread), LEAST_BETWEEN_TRIAL_SD) ** 2
    return centre, precision


def spreads(problem: MixedProblem, spread: tuple[float, float]) -> Floats:
    """Standard deviations of each trial's pressure and B, shape (n_trials, 2): a measured pressure has its own.

    Parameters
    ----------
    problem : what does not change during the fit.
    spread : (float, float)
        Between-trial standard deviations of pressure, relative, and of ln B.

    Returns
    -------
    array, shape (n_trials, 2)
    """
    each = np.empty((problem.gauge_error.size, 2))
    each[:, 0] = np.where(problem.gauge_error > 0, problem.gauge_error, spread[0])
    each[:, 1] = spread[1]
    return each


def shared_penalty(problem: MixedProblem, state: FitState) -> float:
    """What the priors of the free numbers add to the sum of squares.

    Parameters
    ----------
    problem : what does not change during the fit.
    state : where the fit stands.

    Returns
    -------
    float
    """
    return float(np.sum(problem.prior_precision * (state.theta - problem.prior_mean) ** 2))


def trial_effect_penalty(problem: MixedProblem, state: FitState) -> Floats:
    """What the priors of the trials' own numbers add, shape (n_trials,).

    Parameters
    ----------
    problem : what does not change during the fit.
    state : where the fit stands.

    Returns
    -------
    array, shape (n_trials,)
    """
    centre, precision = trial_effect_prior(problem, state)
    return np.asarray(np.sum(precision * (state.trial_effects - centre) ** 2, axis=1))


def sum_matrix_blocks(blocks: Floats, problem: MixedProblem) -> Floats:
    """Sum blocks of the trials' columns, shape (n_trials, n_keys, n_keys), into those of all free numbers.

    Parameters
    ----------
    blocks : array, shape (n_trials, n_keys, n_keys)
    problem : its `index` places the keys of each trial among the free numbers.

    Returns
    -------
    array, shape (n_free, n_free)
    """
    p = problem.prior_mean.size
    among = problem.places
    flat = among[:, :, None] * (p + 1) + among[:, None, :]
    total = np.bincount(flat.ravel(), weights=blocks.ravel(), minlength=(p + 1) ** 2)
    return np.asarray(total.reshape(p + 1, p + 1)[:p, :p])


def sum_vector_blocks(blocks: Floats, problem: MixedProblem) -> Floats:
    """As `sum_matrix_blocks`, for vectors, shape (n_trials, n_keys).

    Parameters
    ----------
    blocks : array, shape (n_trials, n_keys)
    problem : its `index` places the keys of each trial among the free numbers.

    Returns
    -------
    array, shape (n_free,)
    """
    p = problem.prior_mean.size
    return np.asarray(np.bincount(problem.places.ravel(), weights=blocks.ravel(), minlength=p + 1)[:p])


def levenberg_marquardt_step(
    cross_products: Floats, problem: MixedProblem, state: FitState, damping: float
) -> tuple[Floats, Floats, float]:
    """Step of all unknowns towards the minimum of the penalised sum of squares, and the decrease it promises.

    Numbers at a bound that want to go beyond it stay. `damping` is that of Levenberg and Marquardt.

    Parameters
    ----------
    cross_products : array, shape (n_trials, 3, k, k)
        Products of [trial effects, keys, residual], see `whitening`.
    problem : what does not change during the fit.
    state : where the fit stands.
    damping : float
        Of Levenberg and Marquardt; 0 for a Gauss–Newton step.

    Returns
    -------
    step : array, shape (n_free,)
    trial_effect_step : array, shape (n_trials, 4)
    predicted_decrease : float
        Decrease of the sum of squares by the linear model.
    """
    white = at_correlation(cross_products, state.rho) / state.variance[:, None, None]
    centre, precision = trial_effect_prior(problem, state)
    own_square = white[:, :N_TRIAL_EFFECTS, :N_TRIAL_EFFECTS] + precision[:, :, None] * np.eye(N_TRIAL_EFFECTS)
    own_slope = white[:, :N_TRIAL_EFFECTS, -1] - precision * (state.trial_effects - centre)
    damped = own_square * (1 + damping * np.eye(N_TRIAL_EFFECTS))
    mixed = white[:, :N_TRIAL_EFFECTS, N_TRIAL_EFFECTS:-1]
    solved = solve_per_trial(damped, np.concatenate([mixed, own_slope[:, :, None]], axis=2))
    square = sum_matrix_blocks(white[:, N_TRIAL_EFFECTS:-1, N_TRIAL_EFFECTS:-1], problem) + np.diag(
        problem.prior_precision
    )
    slope = sum_vector_blocks(white[:, N_TRIAL_EFFECTS:-1, -1], problem) - problem.prior_precision * (
        state.theta - problem.prior_mean
    )
    reduced = square * (1 + damping * np.eye(square.shape[0]))
    reduced = reduced - sum_matrix_blocks(np.swapaxes(mixed, 1, 2) @ solved[:, :, :-1], problem)
    reduced_slope = slope - sum_vector_blocks(np.einsum("nuk,nu->nk", mixed, solved[:, :, -1]), problem)
    step, _ = bounded_solve(reduced, reduced_slope, problem, state.theta)
    spread_out = np.append(step, 0.0)[problem.index]
    trial_effect_step = solved[:, :, -1] - np.einsum("nuk,nk->nu", solved[:, :, :-1], spread_out)
    predicted_decrease = float(step @ slope + np.sum(trial_effect_step * own_slope))
    return step, trial_effect_step, predicted_decrease


def trial_effect_step(
    cross_products: Floats, problem: MixedProblem, state: FitState, *, pinned: bool = False
) -> Floats:
    """Step of the trials' own numbers alone, shape (n_trials, 4); `pinned` leaves the release where it is.

    Parameters
    ----------
    cross_products : array, shape (n_trials, 3, k, k)
        Products of [trial effects, keys, residual], see `whitening`.
    problem : what does not change during the fit.
    state : where the fit stands.
    pinned : bool
        Whether the release stays.

    Returns
    -------
    array, shape (n_trials, 4)
    """
    white = at_correlation(cross_products, state.rho) / state.variance[:, None, None]
    centre, precision = trial_effect_prior(problem, state)
    square = white[:, :N_TRIAL_EFFECTS, :N_TRIAL_EFFECTS] + precision[:, :, None] * np.eye(N_TRIAL_EFFECTS)
    slope = white[:, :N_TRIAL_EFFECTS, -1] - precision * (state.trial_effects - centre)
    if pinned:
        square[:, RELEASE, :] = square[:, :, RELEASE] = slope[:, RELEASE] = 0.0
        square[:, RELEASE, RELEASE] = 1.0
    return np.asarray(solve_per_trial(square, slope[:, :, None])[:, :, 0])


def bounded_solve(
    square: Floats, slope: Floats, problem: MixedProblem, theta: Floats
) -> tuple[Floats, NDArray[np.bool_]]:
    """Solve for the numbers that may move; one that would pass a bound is held there and the rest solved again.

    Parameters
    ----------
    square : array, shape (n_free, n_free)
        Information of the free numbers.
    slope : array, shape (n_free,)
        Half the negative gradient of the sum of squares.
    problem : bounds, and which numbers may move.
    theta : array, shape (n_free,)
        Where they stand, scaled.

    Returns
    -------
    step : array, shape (n_free,)
    moving : array of bool, shape (n_free,)
        Numbers that are not held: those that end at a bound are.
    """
    moving = problem.free & (np.diag(square) > 0)
    if moving.all():
        # Mostly no bound is met: then one solve is all, and this is asked some hundred times a fit.
        whole = solve_scaled(square, slope)
        room = np.where(whole > 0, problem.upper - theta, theta - problem.lower)
        if (np.abs(whole) <= room).all():
            return whole, moving
    step = np.zeros_like(slope)
    for _ in range(slope.size + 1):
        k = np.flatnonzero(moving)
        if not k.size:
            break
        held = np.flatnonzero(~moving)
        way = solve_scaled(square[np.ix_(k, k)], slope[k] - square[np.ix_(k, held)] @ step[held]) - step[k]
        # Only as far as the first bound: every part of the way lowers the sum of squares.
        here = theta[k] + step[k]
        room = np.where(way > 0, problem.upper[k] - here, problem.lower[k] - here)
        with np.errstate(divide="ignore", invalid="ignore"):
            part = np.where(way == 0, np.inf, np.maximum(room / way, 0.0))
        first = float(np.min(part))
        if first >= 1:
            step[k] += way
            break
        step[k] += first * way
        moving[k[part <= first]] = False
    return step, moving


def solve_scaled(square: Floats, slope: Floats) -> Floats:
    """Solve a symmetric system brought to a unit diagonal, by least squares where it is singular.

    Parameters
    ----------
    square : array, shape (n, n)
        Symmetric.
    slope : array, shape (n,)

    Returns
    -------
    array, shape (n,)
    """
    scale = 1 / np.sqrt(np.maximum(np.diag(square), 1e-300))
    even = square * scale[:, None] * scale
    return np.asarray(scale * np.linalg.lstsq(even, scale * slope, rcond=1e-12)[0])


def inverse_of_block(square: Floats, places: NDArray[np.int_]) -> Floats:
    """Inverse of a symmetric matrix among these places, 0 elsewhere; directions that nothing fixes are left out.

    Parameters
    ----------
    square : array, shape (n, n)
        Symmetric, with a positive diagonal at `places`.
    places : array of int
        Rows and columns that are inverted.

    Returns
    -------
    array, shape (n, n)
    """
    scale = 1 / np.sqrt(np.diag(square)[places])
    even = square[np.ix_(places, places)] * scale[:, None] * scale
    inverse = np.zeros_like(square)
    inverse[np.ix_(places, places)] = np.linalg.pinv(even, rcond=1e-11, hermitian=True) * scale[:, None] * scale
    return inverse


def solve_per_trial(square: Floats, right: Floats) -> Floats:
    """Solve the small system of every trial, shape (n_trials, k, k), brought to unit diagonals.

    Parameters
    ----------
    square : array, shape (n_trials, k, k)
        Symmetric, with positive diagonals.
    right : array, shape (n_trials, k, m)

    Returns
    -------
    array, shape (n_trials, k, m)
    """
    scale = 1 / np.sqrt(np.einsum("nkk->nk", square))
    even = square * scale[:, :, None] * scale[:, None, :] + RIDGE * np.eye(square.shape[1])
    return np.asarray(scale[:, :, None] * np.linalg.solve(even, scale[:, :, None] * right))


def trial_effects_eliminated(cross_products: Floats, n_keys: int, problem: MixedProblem, state: FitState) -> Floats:
    """Products of keys, residual and what follows in units of the noise, each trial's own numbers integrated out.

    `cross_products` are those of [own numbers, keys, residual, more].

    Parameters
    ----------
    cross_products : array, shape (n_trials, 3, k, k)
        Products of [trial effects, keys, residual, more].
    n_keys : int
        Number of keys.
    problem : what does not change during the fit.
    state : where the fit stands.

    Returns
    -------
    array, shape (n_trials, k − 4, k − 4)
    """
    white = at_correlation(cross_products, state.rho) / state.variance[:, None, None]
    white = at_zero_deviations(white, state, N_TRIAL_EFFECTS + n_keys)
    within_trial = white[:, :N_TRIAL_EFFECTS, :N_TRIAL_EFFECTS] + trial_effect_prior(problem, state)[1][
        :, :, None
    ] * np.eye(N_TRIAL_EFFECTS)
    side = white[:, :N_TRIAL_EFFECTS, N_TRIAL_EFFECTS:]
    return np.asarray(
        white[:, N_TRIAL_EFFECTS:, N_TRIAL_EFFECTS:] - np.swapaxes(side, 1, 2) @ solve_per_trial(within_trial, side)
    )


def at_zero_deviations(white: Floats, state: FitState, residual: int) -> Floats:
    """The products with what the deviations explain so far put back into the column of the residual.

    Parameters
    ----------
    white : array, shape (n_trials, k, k)
        Whitened products, trial effects first.
    state : holds the deviations.
    residual : int
        Place of the column of the residual.

    Returns
    -------
    array, shape (n_trials, k, k)
    """
    columns = list(DEVIATION_COLUMNS)
    effects = state.trial_effects[:, columns, None]
    explained = (white[:, :, columns] @ effects)[:, :, 0]
    back = white.copy()
    back[:, :, residual] += explained
    back[:, residual, :] = back[:, :, residual]
    # The product of the new column with itself: what it explains of itself counts twice, and its own square.
    back[:, residual, residual] += explained[:, residual] + np.sum(explained[:, columns] * effects[:, :, 0], axis=1)
    return np.asarray(back)
