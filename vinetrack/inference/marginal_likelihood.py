"""Likelihood of spreads and noise: everything that a trial has of its own, and the shared numbers, integrated out.

Spreads maximise the restricted likelihood (Patterson & Thompson, Biometrika 58, 545, 1971); so does the noise, once the
trial effects have been fitted. See `vinetrack.inference.mixed_effects` for the model.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.inference.mixed_effects import (
    LEAST_BETWEEN_TRIAL_SD,
    FitState,
    MixedProblem,
    at_zero_deviations,
    bounded_solve,
    solve_per_trial,
    spreads,
    trial_effect_prior,
)
from vinetrack.inference.sensitivity import N_TRIAL_EFFECTS
from vinetrack.inference.variance_kernels import decrease_within_bounds, noise_at_correlations, sums_without_deviations
from vinetrack.inference.whitening import at_correlation

LARGEST_SPREAD = (0.04, 0.15)
"""Of pressure and B: four times what a batch of vines shows. Beyond, a trial would bend its own pressure and B until
they pass for whatever the model lacks. Chosen: a batch of vines scatters by a few per cent of B and one per cent of
pressure; at half real batches are cut short, at twice spreads soak up missing effects."""

SPREAD_GRID = (0.001, 0.004, 0.01, 0.025, 0.06)
"""Spreads from which the largest likelihood is looked for. Chosen: steps of about 2.5, less than the width of a
maximum, from below what any batch shows to beyond the largest of pressure."""

LARGEST_CORRELATION = 0.9998
"""Nearly 1: what a wrong model leaves is slow and large, and must not count as thousands of independent points.
Derived: a correlation time of 5000 frames, longer than any recording."""

CORRELATIONS = np.concatenate(
    [np.linspace(-0.5, 0.9, 29), [0.93, 0.95, 0.97, 0.985, 0.993, 0.997, 0.999, LARGEST_CORRELATION]]
)

LOOSE, WITHIN_LEAST = 1e-9, 1e-6
"""Precision of a shared number freed in one trial, in units of what that trial tells of it at white noise; least part
of the residual that stays. Derived: 1e-9 is far below any information at the correlations of the grid, far above
rounding; a residual of which a millionth stays is a thousand times its noise, all of it disagreement."""


@dataclass(frozen=True)
class Marginal:
    """The trials with release and origin eliminated, shape (n_trials, 2 + n_keys + 1) squared: deviations, keys, rest.

    The last column is what the deviations and a change of the numbers have to explain. `log_constant` is the part of
    −2 ln L that no spread changes.
    """

    blocks: Floats
    log_constant: float


def marginal(cross_products: Floats, problem: MixedProblem, state: FitState) -> Marginal:
    """Eliminate release and origin, and put back what the deviations explain so far.

    Parameters
    ----------
    cross_products : array, shape (n_trials, 3, k, k)
        Products of [trial effects, keys, residual], see `whitening`.
    problem : what does not change during the fit.
    state : where the fit stands.

    Returns
    -------
    Marginal
    """
    white = at_correlation(cross_products, state.rho) / state.variance[:, None, None]
    white = at_zero_deviations(white, state, -1)
    flat = white[:, :2, :2] + problem.release_origin_precision[:, :, None] * np.eye(2)
    left = white[:, 2:, 2:] - white[:, 2:, :2] @ solve_per_trial(flat, white[:, :2, 2:])
    log_noise = np.sum(problem.points * np.log(state.variance)) - np.sum(problem.stretches) * math.log(1 - state.rho**2)
    log_flat = np.sum(np.linalg.slogdet(flat)[1] - np.log(problem.release_origin_precision).sum(axis=1))
    return Marginal(left, float(log_noise + log_flat + np.sum(problem.points) * math.log(2 * math.pi)))


def deviations_eliminated(part: Marginal, problem: MixedProblem, spread: tuple[float, float]) -> tuple[Floats, Floats]:
    """What every trial says of its keys once all it has of its own is integrated out, and what that took.

    Shapes (n_trials, n_keys + 1, n_keys + 1), the last row and column the rest, and (n_trials, 2, 2).

    Parameters
    ----------
    part : release and origin eliminated.
    problem : what does not change during the fit.
    spread : (float, float)
        Between-trial standard deviations of pressure and ln B.

    Returns
    -------
    blocks : array, shape (n_trials, n_keys + 1, n_keys + 1)
    inner : array, shape (n_trials, 2, 2)
        I + S Z S of the deviations, whose determinant enters ln L.
    """
    root = spreads(problem, spread) * problem.feels
    inner = np.eye(2) + root[:, :, None] * part.blocks[:, :2, :2] * root[:, None, :]
    side = root[:, :, None] * part.blocks[:, :2, 2:]
    return part.blocks[:, 2:, 2:] - np.swapaxes(side, 1, 2) @ np.linalg.solve(inner, side), inner


def normal_equations(
    part: Marginal, problem: MixedProblem, state: FitState, spread: tuple[float, float]
) -> tuple[Floats, Floats, float, float]:
    """Information of the free numbers, its slope, the sum of squares and the log-determinant at these spreads.

    Parameters
    ----------
    part : release and origin eliminated.
    problem : what does not change during the fit.
    state : where the fit stands.
    spread : (float, float)
        Between-trial standard deviations of pressure and ln B.

    Returns
    -------
    information : array, shape (n_free, n_free)
    slope : array, shape (n_free,)
    square : float
        Sum of squares at the current numbers.
    log_det : float
    """
    root = spreads(problem, spread) * problem.feels
    size = problem.prior_mean.size
    information, slope, square, log_det = sums_without_deviations(part.blocks, problem.places, root, size)
    away = state.theta - problem.prior_mean
    information.flat[:: size + 1] += problem.prior_precision
    slope -= problem.prior_precision * away
    return information, slope, square + float(np.sum(problem.prior_precision * away**2)), log_det


def deviance(
    part: Marginal, problem: MixedProblem, state: FitState, spread: tuple[float, float], *, restricted: bool = True
) -> float:
    """−2 ln of the (restricted) likelihood of the spreads, the free numbers at their best for them.

    Parameters
    ----------
    part : release and origin eliminated.
    problem : what does not change during the fit.
    state : where the fit stands.
    spread : (float, float)
        Between-trial standard deviations of pressure and ln B.
    restricted : bool
        Whether the fitted numbers are counted (REML).

    Returns
    -------
    float
    """
    information, slope, square, log_det = normal_equations(part, problem, state, spread)
    constant = square + log_det + part.log_constant
    return profiled_deviance(information, slope, constant, problem, state, restricted=restricted)


def profiled_deviance(
    information: Floats, slope: Floats, constant: float, problem: MixedProblem, state: FitState, *, restricted: bool
) -> float:
    """The end of `deviance`: what is left once the free numbers are at their best.

    Parameters
    ----------
    information : array, shape (n_free, n_free)
    slope : array, shape (n_free,)
    constant : float
        −2 ln L at the current numbers.
    problem : what does not change during the fit.
    state : where the fit stands.
    restricted : bool
        Whether the fitted numbers are counted (REML).

    Returns
    -------
    float
    """
    if restricted or problem.random is None:
        below, above = state.theta - problem.lower, problem.upper - state.theta
        solved, decrease, log_information = decrease_within_bounds(information, slope, below, above, problem.free)
        if solved:
            return constant - decrease + (log_information if restricted else 0.0)
    # What would rather lie beyond its bound must not be credited with what it would explain there.
    step, moving = bounded_solve(information, slope, problem, state.theta)
    total = constant - float(step @ (2 * slope - information @ step))
    k = np.flatnonzero(moving)
    if k.size:
        inside = information if moving.all() else information[np.ix_(k, k)]
        if restricted:
            total += float(np.linalg.slogdet(inside)[1])
        elif problem.random is not None and problem.random[k].any():
            total += _groups_integrated(inside, problem.prior_precision[k], problem.random[k])
    return total


def _groups_integrated(information: Floats, prior_precision: Floats, random: NDArray[np.bool_]) -> float:
    """What −2 ln L gains when the random effects w of groups of trials are integrated out: ln det(I + D M D).

    With w ~ N(0, D²) and M the data's information of w, the Gaussian integral of exp(−½ wᵀ(M + D⁻²)w) / det D is
    det(D (M + D⁻²) D)^(−½). So a hypothesis with many groups pays for each of them.
    """
    sd = 1 / np.sqrt(prior_precision[random])
    return float(np.linalg.slogdet(sd[:, None] * information[np.ix_(random, random)] * sd)[1])


def estimate_between_trial_sd(
    part: Marginal,
    problem: MixedProblem,
    state: FitState,
    estimable: tuple[bool, bool],
    *,
    restricted: bool = True,
) -> tuple[float, float]:
    """Spreads of pressure and B that maximise the restricted (or plain) likelihood; those not estimable stay.

    The likelihood may have two maxima: what pressure takes upon itself, B need not. So the best of a grid and of where
    the state stands is followed.

    Parameters
    ----------
    part : release and origin eliminated.
    problem : what does not change during the fit.
    state : where the fit stands.
    estimable : (bool, bool)
        Which of the two are estimated.
    restricted : bool
        Whether the likelihood is the restricted one.

    Returns
    -------
    (float, float)
        Of pressure, relative, and of ln B.
    """
    from scipy.optimize import minimize

    which = [k for k in range(2) if estimable[k]]
    if not which:
        return state.spread
    least, largest = math.log(LEAST_BETWEEN_TRIAL_SD), [math.log(most) for most in LARGEST_SPREAD]

    def at(logs: Floats) -> tuple[float, float]:
        spread = list(state.spread)
        for k, value in zip(which, logs.tolist(), strict=True):
            # Clipped before the exponential: on a flat likelihood the simplex walks as far as it likes.
            spread[k] = math.exp(min(max(value, least), largest[k]))
        return spread[0], spread[1]

    def cost(logs: Floats) -> float:
        return deviance(part, problem, state, at(logs), restricted=restricted)

    here = np.log(np.maximum([state.spread[k] for k in which], 1e-3))
    axes = np.meshgrid(*[np.log(SPREAD_GRID)] * len(which), indexing="ij")
    points = [here, *np.column_stack([axis.ravel() for axis in axes])]
    start = points[int(np.argmin([cost(point) for point in points]))]
    # Steps towards smaller spreads: at the largest, a step up would be clipped, and the simplex flat.
    simplex = np.vstack([start, start - 0.4 * np.eye(len(which))])
    minimum = minimize(
        cost, start, method="Nelder-Mead", options={"initial_simplex": simplex, "xatol": 5e-3, "fatol": 1e-3}
    )
    return at(minimum.x)


def estimate_noise(
    cross_products: Floats, problem: MixedProblem, state: FitState, rho: float | None = None, *, within: bool = False
) -> tuple[float, Floats]:
    """Correlation of the noise, the same for all trials, and the variance of its innovations in each, m².

    Restricted likelihood of what is left once each trial's own numbers have been fitted. A trial's variance is drawn to
    that of all as far as trials do not differ by more than chance. The correlation is `rho` where given. `within` frees
    the shared numbers in every trial too, so that what trials disagree by does not pass for noise.

    Parameters
    ----------
    cross_products : array, shape (n_trials, 3, k, k)
        Products of [trial effects, keys, residual], see `whitening`.
    problem : what does not change during the fit.
    state : where the fit stands.
    rho : float, optional
        Correlation, where it is known.
    within : bool
        Whether the shared numbers are free in every trial.

    Returns
    -------
    rho : float
    variance : array, shape (n_trials,), m²
    """
    grid = CORRELATIONS if rho is None else np.array([rho])
    centre, precision = trial_effect_prior(problem, state)
    stiff = precision * state.variance[:, None]
    pull_back = stiff * (state.trial_effects - centre)
    freed = N_TRIAL_EFFECTS + problem.index.shape[1] if within else N_TRIAL_EFFECTS
    shared = 0.0 if within else np.count_nonzero(problem.free) / problem.index.shape[0]
    if within:
        stiff = np.concatenate([stiff, _loose(cross_products, freed)], axis=1)
        pull_back = np.pad(pull_back, ((0, 0), (0, freed - N_TRIAL_EFFECTS)))
    columns = [*range(freed), cross_products.shape[-1] - 1]
    scores, squares, degrees = noise_at_correlations(
        np.ascontiguousarray(cross_products[:, :, columns][:, :, :, columns]),
        stiff,
        pull_back,
        problem.points,
        grid,
        shared,
        WITHIN_LEAST if within else 0.2,
    )
    scores -= np.sum(problem.stretches) * np.log(1 - grid**2)
    best = int(np.argmin(scores))
    if rho is None:
        return estimate_noise(cross_products, problem, state, _lowest(grid, scores, best), within=within)
    return rho, _draw_together(squares[0], degrees[0])


def _loose(cross_products: Floats, freed: int) -> Floats:
    """Precision that leaves the shared numbers free in every trial, shape (n_trials, n_keys): tiny beside its own."""
    told = np.einsum("nkk->nk", cross_products[:, 0])[:, N_TRIAL_EFFECTS:freed]
    return np.asarray(np.where(told > 0, LOOSE * told, 1.0))


def _lowest(grid: Floats, scores: Floats, best: int) -> float:
    """Where the parabola through the best point and its neighbours is lowest."""
    if best in (0, grid.size - 1):
        return float(grid[best])
    curve = np.polyfit(grid[best - 1 : best + 2] - grid[best], scores[best - 1 : best + 2], 2)
    return float(grid[best] - curve[1] / (2 * curve[0]))


def _draw_together(square: Floats, dof: Floats) -> Floats:
    """Variances of the trials, drawn to the common one by as much as their differences can be chance."""
    common = float(np.sum(square) / np.sum(dof))
    if square.size < 2:
        return np.full(square.size, common)
    logs = np.log(square / dof / common)
    beyond = float(np.average((logs - np.average(logs, weights=dof)) ** 2 - 2 / dof, weights=dof))
    strength = 2 / beyond if beyond > 1e-6 else 1e6
    return np.asarray((square + strength * common) / (dof + strength))
