"""The linear mixed model behind a fit: what the sensitivities of the trials say about numbers, spreads and noise.

About the current trajectories, measured minus predicted position of trial i is

    r_i = X_i Δθ + Z_i u_i + e_i,   u_i ~ N(0, diag(σ_P², σ_B²)),   e_i ~ AR(1)

with the release and the origin of every trial free. All unknowns of a trial are integrated out analytically, so the
cost is linear in the number of trials. Alternated with new trajectories this is the method of Lindstrom & Bates,
Biometrics 46, 673 (1990). Spreads maximise the restricted likelihood, which unlike the plain one counts the numbers
that were fitted (Patterson & Thompson, Biometrika 58, 545, 1971).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.inference.sensitivity import DAMPING_DEVIATION, OWN, PRESSURE, RELEASE
from vinetrack.inference.whitening import at_correlation

LEAST_SPREAD = 1e-5
"""Least between-trial standard deviation. Chosen far below what any rig repeats, so that its logarithm stays
finite."""

LARGEST_SPREAD = (0.04, 0.15)
"""Of pressure and B: four times what a batch of vines shows. Beyond, a trial would bend its own pressure and B until
they pass for whatever the model lacks. Chosen: a batch of vines scatters by a few per cent of B and one per cent of
pressure; at half real batches are cut short, at twice spreads soak up missing effects."""

LARGEST_CORRELATION = 0.9998
"""Nearly 1: what a wrong model leaves is slow and large, and must not count as thousands of independent points.
Derived: a correlation time of 5000 frames, longer than any recording."""

CORRELATIONS = np.concatenate(
    [np.linspace(-0.5, 0.9, 29), [0.93, 0.95, 0.97, 0.985, 0.993, 0.997, 0.999, LARGEST_CORRELATION]]
)
SPREAD_COLUMNS = (PRESSURE, DAMPING_DEVIATION)

LOOSE, WITHIN_LEAST = 1e-9, 1e-6
"""Precision of a shared number freed in one trial, in units of what that trial tells of it at white noise; least part
of the residual that stays. Derived: 1e-9 is far below any information at the correlations of the grid, far above
rounding; a residual of which a millionth stays is a thousand times its noise, all of it disagreement."""


@dataclass(frozen=True)
class FitState:
    """Where a fit stands.

    `theta`, shape (n_free,), scaled; `own`, shape (n_trials, 4), see `vinetrack.inference.sensitivity`; `spread` the
    relative standard deviations of pressure and B from trial to trial; `rho` the lag-one correlation of the noise and
    `variance`, shape (n_trials,), that of its innovations, m².
    """

    theta: Floats
    trial_effects: Floats
    spread: tuple[float, float]
    rho: float
    variance: Floats


@dataclass(frozen=True)
class MixedProblem:
    """What does not change during a fit.

    `index`, shape (n_trials, n_keys), places each trial's columns among the free numbers; `feels`, shape (n_trials, 2),
    tells which trials have a deviation of pressure and of B; `gauge_error`, shape (n_trials,), the relative error of a
    pressure that was measured, 0 of one that was set; `own_centre` and `own_precision`, shape (n_trials, 2),
    belong to release and origin: so wide a prior that it only matters where a track leaves them open.
    `free` marks the numbers that may move; `points` and `stretches` count those of each trial. `random` marks numbers
    that are random effects of a group of trials, their priors being the distribution of the groups.
    """

    index: NDArray[np.int_]
    feels: NDArray[np.bool_]
    gauge_error: Floats
    own_centre: Floats
    own_precision: Floats
    prior_mean: Floats
    prior_precision: Floats
    lower: Floats
    upper: Floats
    free: NDArray[np.bool_]
    points: Floats
    stretches: Floats
    random: NDArray[np.bool_] | None = None


def trial_effect_prior(problem: MixedProblem, state: FitState) -> tuple[Floats, Floats]:
    """Centre and precision of each trial's own numbers, shape (n_trials, 4) each."""
    n = problem.index.shape[0]
    centre, precision = np.zeros((n, OWN)), np.ones((n, OWN))
    centre[:, :2], precision[:, :2] = problem.own_centre, problem.own_precision
    precision[:, SPREAD_COLUMNS] = 1 / np.maximum(spreads(problem, state.spread), LEAST_SPREAD) ** 2
    return centre, precision


def spreads(problem: MixedProblem, spread: tuple[float, float]) -> Floats:
    """Standard deviations of each trial's pressure and B, shape (n_trials, 2): a measured pressure has its own."""
    each = np.tile(spread, (problem.gauge_error.size, 1))
    each[:, 0] = np.where(problem.gauge_error > 0, problem.gauge_error, each[:, 0])
    return each


def shared_penalty(problem: MixedProblem, state: FitState) -> float:
    """What the priors of the free numbers add to the sum of squares."""
    return float(np.sum(problem.prior_precision * (state.theta - problem.prior_mean) ** 2))


def trial_effect_penalty(problem: MixedProblem, state: FitState) -> Floats:
    """What the priors of the trials' own numbers add, shape (n_trials,)."""
    centre, precision = trial_effect_prior(problem, state)
    return np.asarray(np.sum(precision * (state.trial_effects - centre) ** 2, axis=1))


def cross_products(blocks: Floats, problem: MixedProblem) -> Floats:
    """Sum blocks of the trials' columns, shape (n_trials, n_keys, n_keys), into those of all free numbers."""
    p = problem.prior_mean.size
    total = np.zeros((p + 1, p + 1))
    np.add.at(total, (problem.index[:, :, None], problem.index[:, None, :]), blocks)
    return total[:p, :p]


def cross_products_vector(blocks: Floats, problem: MixedProblem) -> Floats:
    """As `cross_products`, for vectors, shape (n_trials, n_keys)."""
    total = np.zeros(problem.prior_mean.size + 1)
    np.add.at(total, problem.index, blocks)
    return total[:-1]


def newton_step(grams: Floats, problem: MixedProblem, state: FitState, damping: float) -> tuple[Floats, Floats, float]:
    """Step of all unknowns towards the minimum of the penalised sum of squares, and the decrease it promises.

    Numbers at a bound that want to go beyond it stay. `damping` is that of Levenberg and Marquardt.
    """
    white = at_correlation(grams, state.rho) / state.variance[:, None, None]
    centre, precision = trial_effect_prior(problem, state)
    own_square = white[:, :OWN, :OWN] + precision[:, :, None] * np.eye(OWN)
    own_slope = white[:, :OWN, -1] - precision * (state.trial_effects - centre)
    damped = own_square * (1 + damping * np.eye(OWN))
    mixed = white[:, :OWN, OWN:-1]
    solved = solve_each(damped, np.concatenate([mixed, own_slope[:, :, None]], axis=2))
    square = cross_products(white[:, OWN:-1, OWN:-1], problem) + np.diag(problem.prior_precision)
    slope = cross_products_vector(white[:, OWN:-1, -1], problem) - problem.prior_precision * (
        state.theta - problem.prior_mean
    )
    reduced = square * (1 + damping * np.eye(square.shape[0]))
    reduced = reduced - cross_products(np.swapaxes(mixed, 1, 2) @ solved[:, :, :-1], problem)
    reduced_slope = slope - cross_products_vector(np.einsum("nuk,nu->nk", mixed, solved[:, :, -1]), problem)
    step = _bounded_solve(reduced, reduced_slope, problem, state.theta)
    spread_out = np.append(step, 0.0)[problem.index]
    trial_effect_step = solved[:, :, -1] - np.einsum("nuk,nk->nu", solved[:, :, :-1], spread_out)
    promised = float(step @ slope + np.sum(trial_effect_step * own_slope))
    return step, trial_effect_step, promised


def trial_effect_step(grams: Floats, problem: MixedProblem, state: FitState, *, pinned: bool = False) -> Floats:
    """Step of the trials' own numbers alone, shape (n_trials, 4); `pinned` leaves the release where it is."""
    white = at_correlation(grams, state.rho) / state.variance[:, None, None]
    centre, precision = trial_effect_prior(problem, state)
    square = white[:, :OWN, :OWN] + precision[:, :, None] * np.eye(OWN)
    slope = white[:, :OWN, -1] - precision * (state.trial_effects - centre)
    if pinned:
        square[:, RELEASE, :] = square[:, :, RELEASE] = slope[:, RELEASE] = 0.0
        square[:, RELEASE, RELEASE] = 1.0
    return np.asarray(solve_each(square, slope[:, :, None])[:, :, 0])


def _bounded_solve(square: Floats, slope: Floats, problem: MixedProblem, theta: Floats) -> Floats:
    """Solve for the numbers that may move; one at its bound that would leave it is held and the rest solved again."""
    moving = problem.free & (np.diag(square) > 0)
    step = np.zeros_like(slope)
    for _ in range(slope.size + 1):
        step[:] = 0.0
        k = np.flatnonzero(moving)
        if k.size:
            step[k] = solve_scaled(square[np.ix_(k, k)], slope[k])
        out = moving & (((theta <= problem.lower) & (step < 0)) | ((theta >= problem.upper) & (step > 0)))
        if not out.any():
            break
        moving &= ~out
    return step


def solve_scaled(square: Floats, slope: Floats) -> Floats:
    """Solve a symmetric system brought to a unit diagonal, by least squares where it is singular."""
    scale = 1 / np.sqrt(np.maximum(np.diag(square), 1e-300))
    even = square * scale[:, None] * scale
    return np.asarray(scale * np.linalg.lstsq(even, scale * slope, rcond=1e-12)[0])


def inverse_among(square: Floats, places: NDArray[np.int_]) -> Floats:
    """Inverse of a symmetric matrix among these places, 0 elsewhere; directions that nothing fixes are left out."""
    scale = 1 / np.sqrt(np.diag(square)[places])
    even = square[np.ix_(places, places)] * scale[:, None] * scale
    inverse = np.zeros_like(square)
    inverse[np.ix_(places, places)] = np.linalg.pinv(even, rcond=1e-11, hermitian=True) * scale[:, None] * scale
    return inverse


def solve_each(square: Floats, right: Floats) -> Floats:
    """Solve the small system of every trial, shape (n_trials, k, k), brought to unit diagonals."""
    scale = 1 / np.sqrt(np.einsum("nkk->nk", square))
    even = square * scale[:, :, None] * scale[:, None, :] + 1e-13 * np.eye(square.shape[1])
    return np.asarray(scale[:, :, None] * np.linalg.solve(even, scale[:, :, None] * right))


def trial_effects_eliminated(grams: Floats, n_keys: int, problem: MixedProblem, state: FitState) -> Floats:
    """Products of keys, residual and what follows in units of the noise, each trial's own numbers integrated out.

    `grams` are those of [own numbers, keys, residual, more].
    """
    white = at_correlation(grams, state.rho) / state.variance[:, None, None]
    white = _put_back(white, state, OWN + n_keys)
    within_trial = white[:, :OWN, :OWN] + trial_effect_prior(problem, state)[1][:, :, None] * np.eye(OWN)
    side = white[:, :OWN, OWN:]
    return np.asarray(white[:, OWN:, OWN:] - np.swapaxes(side, 1, 2) @ solve_each(within_trial, side))


def _put_back(white: Floats, state: FitState, residual: int) -> Floats:
    """The products with what the deviations explain so far put back into the column of the residual."""
    turn = np.broadcast_to(np.eye(white.shape[1]), white.shape).copy()
    for column in SPREAD_COLUMNS:
        turn[:, column, residual] = state.trial_effects[:, column]
    return np.asarray(np.swapaxes(turn, 1, 2) @ white @ turn)


@dataclass(frozen=True)
class Marginal:
    """The trials with release and origin eliminated, shape (n_trials, 2 + n_keys + 1) squared: deviations, keys, rest.

    The last column is what the deviations and a change of the numbers have to explain. `log_constant` is the part of
    −2 ln L that no spread changes.
    """

    blocks: Floats
    log_constant: float


def marginal(grams: Floats, problem: MixedProblem, state: FitState) -> Marginal:
    """Eliminate release and origin, and put back what the deviations explain so far."""
    white = at_correlation(grams, state.rho) / state.variance[:, None, None]
    white = _put_back(white, state, -1)
    flat = white[:, :2, :2] + problem.own_precision[:, :, None] * np.eye(2)
    rest = white[:, 2:, 2:] - white[:, 2:, :2] @ solve_each(flat, white[:, :2, 2:])
    log_noise = np.sum(problem.points * np.log(state.variance)) - np.sum(problem.stretches) * math.log(1 - state.rho**2)
    log_flat = np.sum(np.linalg.slogdet(flat)[1] - np.log(problem.own_precision).sum(axis=1))
    return Marginal(rest, float(log_noise + log_flat + np.sum(problem.points) * math.log(2 * math.pi)))


def left_to_keys(part: Marginal, problem: MixedProblem, spread: tuple[float, float]) -> tuple[Floats, Floats]:
    """What every trial says of its keys once all it has of its own is integrated out, and what that took.

    Shapes (n_trials, n_keys + 1, n_keys + 1), the last row and column the rest, and (n_trials, 2, 2).
    """
    root = spreads(problem, spread) * problem.feels
    inner = np.eye(2) + root[:, :, None] * part.blocks[:, :2, :2] * root[:, None, :]
    side = root[:, :, None] * part.blocks[:, :2, 2:]
    return part.blocks[:, 2:, 2:] - np.swapaxes(side, 1, 2) @ np.linalg.solve(inner, side), inner


def normal_equations(
    part: Marginal, problem: MixedProblem, state: FitState, spread: tuple[float, float]
) -> tuple[Floats, Floats, float, float]:
    """Information of the free numbers, its slope, the sum of squares and the log-determinant at these spreads."""
    left, inner = left_to_keys(part, problem, spread)
    information = cross_products(left[:, :-1, :-1], problem) + np.diag(problem.prior_precision)
    away = state.theta - problem.prior_mean
    slope = cross_products_vector(left[:, :-1, -1], problem) - problem.prior_precision * away
    square = float(np.sum(left[:, -1, -1]) + np.sum(problem.prior_precision * away**2))
    return information, slope, square, float(np.sum(np.linalg.slogdet(inner)[1]))


def deviance(
    part: Marginal, problem: MixedProblem, state: FitState, spread: tuple[float, float], *, restricted: bool = True
) -> float:
    """−2 ln of the (restricted) likelihood of the spreads, the free numbers at their best for them."""
    information, slope, square, log_det = normal_equations(part, problem, state, spread)
    moves = problem.free & (np.diag(information) > 0)
    if ((state.theta <= problem.lower) | (state.theta >= problem.upper)).any():
        # What would rather lie beyond its bound must not be credited with what it would explain there.
        step = _bounded_solve(information, slope, problem, state.theta)
        moves &= (step != 0) | ((state.theta > problem.lower) & (state.theta < problem.upper))
    k = np.flatnonzero(moves)
    total = square + log_det + part.log_constant
    if k.size:
        inside = information[np.ix_(k, k)]
        total -= float(slope[k] @ solve_scaled(inside, slope[k]))
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


def estimate_spreads(
    part: Marginal,
    problem: MixedProblem,
    state: FitState,
    estimable: tuple[bool, bool],
    *,
    restricted: bool = True,
    search: bool = False,
) -> tuple[float, float]:
    """Spreads of pressure and B that maximise the restricted (or plain) likelihood; those not estimable stay.

    `search` begins from a grid, else from where the state stands.
    """
    from scipy.optimize import minimize

    which = [k for k in range(2) if estimable[k]]
    if not which:
        return state.spread

    def at(logs: Floats) -> tuple[float, float]:
        spread = list(state.spread)
        for k, value in zip(which, logs, strict=True):
            spread[k] = float(np.clip(math.exp(value), LEAST_SPREAD, LARGEST_SPREAD[k]))
        return spread[0], spread[1]

    def cost(logs: Floats) -> float:
        return deviance(part, problem, state, at(logs), restricted=restricted)

    start = np.log(np.maximum([state.spread[k] for k in which], 1e-3))
    if search:
        axes = np.meshgrid(*[np.log([0.001, 0.004, 0.01, 0.025, 0.06])] * len(which), indexing="ij")
        points = np.column_stack([axis.ravel() for axis in axes])
        start = points[int(np.argmin([cost(point) for point in points]))]
    simplex = np.vstack([start, start + 0.4 * np.eye(len(which))])
    found = minimize(
        cost, start, method="Nelder-Mead", options={"initial_simplex": simplex, "xatol": 5e-3, "fatol": 1e-3}
    )
    return at(found.x)


def estimate_noise(
    grams: Floats, problem: MixedProblem, state: FitState, rho: float | None = None, *, within: bool = False
) -> tuple[float, Floats]:
    """Correlation of the noise, the same for all trials, and the variance of its innovations in each, m².

    Restricted likelihood of what is left once each trial's own numbers have been fitted. A trial's variance is drawn to
    that of all as far as trials do not differ by more than chance. The correlation is `rho` where given. `within` frees
    the shared numbers in every trial too, so that what trials disagree by does not pass for noise.
    """
    grid = CORRELATIONS if rho is None else np.array([rho])
    centre, precision = trial_effect_prior(problem, state)
    stiff = precision * state.variance[:, None]
    pull_back = stiff * (state.trial_effects - centre)
    freed = OWN + problem.index.shape[1] if within else OWN
    shared = 0.0 if within else np.count_nonzero(problem.free) / problem.index.shape[0]
    if within:
        stiff = np.concatenate([stiff, _loose(grams, freed)], axis=1)
        pull_back = np.pad(pull_back, ((0, 0), (0, freed - OWN)))
    scores, squares = [], []
    for value in grid:
        white = at_correlation(grams, float(value))
        inner = white[:, :freed, :freed] + stiff[:, :, None] * np.eye(freed)
        taken = np.einsum("nkk->n", solve_each(inner, white[:, :freed, :freed])) + shared
        dof = np.maximum(problem.points - taken, 1.0)
        pull = white[:, :freed, -1] - pull_back
        gain = np.sum(pull * solve_each(inner, pull[:, :, None])[:, :, 0], axis=1)
        least = WITHIN_LEAST if within else 0.2
        square = np.maximum(white[:, -1, -1] - gain, least * white[:, -1, -1])
        score = np.sum(dof * np.log(square / dof)) - np.sum(problem.stretches) * math.log(1 - value**2)
        scores.append(score + np.sum(np.linalg.slogdet(inner)[1]))
        squares.append((square, dof))
    best = int(np.argmin(scores))
    if rho is None:
        return estimate_noise(grams, problem, state, _lowest(grid, np.array(scores), best), within=within)
    return rho, _draw_together(*squares[0])


def _loose(grams: Floats, freed: int) -> Floats:
    """Precision that leaves the shared numbers free in every trial, shape (n_trials, n_keys): tiny beside its own."""
    told = np.einsum("nkk->nk", grams[:, 0])[:, OWN:freed]
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
