"""Score tests: what every candidate could explain of what a fit leaves, by linear algebra alone.

About a fitted model, measured minus predicted positions of trial i are r_i = X_i Δθ + C_i a + Z_i u_i + e_i, with C_i
the answers to the candidates' sizes a (`vinetrack.diagnosis.effect_sensitivities`). Release, origin and the
deviations of pressure and B of every trial are integrated out, the free numbers projected off. What remains of a
candidate has a score, an information, and a cosine with every other.

The information is taken twice: from the noise and spreads of the fit, and from how much the scores of single trials
scatter (White, Econometrica 48, 817, 1980, with trials as clusters), which holds whatever the noise within a trial is
like. Tests go by the larger error of the two.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.diagnosis.shape_products import Products, blocks_of
from vinetrack.inference.fit_result import Fit
from vinetrack.inference.mixed_effects import (
    LEAST_BETWEEN_TRIAL_SD,
    FitState,
    inverse_of_block,
    solve_per_trial,
    sum_matrix_blocks,
    sum_vector_blocks,
)
from vinetrack.inference.mixed_effects import trial_deviation_sd as spreads_of_trials
from vinetrack.inference.position_errors import with_shapes
from vinetrack.inference.robust_covariance import cluster_variance
from vinetrack.inference.sensitivity import N_TRIAL_EFFECTS
from vinetrack.inference.whitening import at_correlation

ROUNDING_SHARE = 1e-9
"""Part of its information that rounding leaves of a shape that others imitate exactly. Derived: products of some
hundred points agree to 1e-13, and to 1e-10 once what others explain is taken off."""


@dataclass(frozen=True)
class Scores:
    """What is left of each shape beside the fit, shape (n_shapes,) or squared, per unit of its size.

    `score` and `information` are sums of those of single trials, `scores`, shape (n_trials, n_shapes), and
    `informations`, shape (n_trials, n_shapes, n_shapes). `sigma` is the error of a size, the larger of the two kinds.
    """

    score: Floats
    information: Floats
    scores: Floats
    informations: Floats
    degrees: float

    @property
    def size(self) -> Floats:
        """One-step estimate of every size, alone; 0 where the data say nothing."""
        diagonal = np.diag(self.information)
        return np.where(diagonal > 0, self.score / np.maximum(diagonal, 1e-300), 0.0)

    @property
    def sigma(self) -> Floats:
        """Its standard error; infinite where the data say nothing."""
        return np.maximum(self.plain_sigma, self.robust_sigma)

    @property
    def plain_sigma(self) -> Floats:
        """Its error by the noise and spreads of the fit."""
        diagonal = np.diag(self.information)
        return np.where(diagonal > 0, 1 / np.sqrt(np.maximum(diagonal, 1e-300)), math.inf)

    @property
    def robust_sigma(self) -> Floats:
        """Its error by how much the scores of single trials scatter, once the size has explained its part of them."""
        diagonal = np.diag(self.information)
        left = self.scores - np.einsum("njj->nj", self.informations) * self.size
        scatter = np.sqrt(cluster_variance(left, self.degrees))
        return np.where(diagonal > 0, scatter / np.maximum(diagonal, 1e-300), math.inf)

    @property
    def z(self) -> Floats:
        """Sizes in standard errors."""
        return self.size / self.sigma

    @property
    def cosines(self) -> Floats:
        """How alike the shapes are, −1 to 1, shape (n_shapes, n_shapes)."""
        root = np.sqrt(np.maximum(np.diag(self.information), 1e-300))
        return np.asarray(np.clip(self.information / root[:, None] / root, -1, 1))


@dataclass(frozen=True)
class _Projected:
    """Shapes and residual, trial effects eliminated, and what the free numbers of a fit explain of them.

    `blocks`, shape (n_trials, q, q), are cross products of keys, residual, shapes, and the systematic errors that each
    trial feels; `lever`, shape (n_free, n_asked), is I_θθ⁻¹ I_θs; `step`, shape (n_free,), is the Newton step of the
    free numbers; `moving` are places of those that can give way. `score`, shape (n_asked,), and `information`, squared,
    are what is left of shapes and systematic errors; `gone` marks those of which that is nothing.
    """

    blocks: Floats
    lever: Floats
    step: Floats
    moving: NDArray[np.intp]
    score: Floats
    information: Floats
    gone: NDArray[np.bool_]


def projected(fit: Fit, sums: Products, state: FitState) -> _Projected:
    """Project shapes and residual on the free numbers of a fit, trial effects eliminated.

    Parameters
    ----------
    fit, sums, state
        As of `scores_of`.

    Returns
    -------
    _Projected
    """
    problem = fit.solution.problem
    p, size, asked = sums.n_keys, problem.prior_mean.size, sums.n_asked
    X, r, C = slice(0, p), p, slice(p + 1, None)
    blocks, places = blocks_of(fit, sums, state), sums.asked
    square = sum_matrix_blocks(blocks[:, X, X], problem) + np.diag(problem.prior_precision)
    slope = sum_vector_blocks(blocks[:, X, r], problem) - problem.prior_precision * (state.theta - problem.prior_mean)
    # What a trial does not feel, number or error, is counted in a last row and column, and left out.
    cross, total, score = np.zeros((size + 1, asked + 1)), np.zeros((asked + 1, asked + 1)), np.zeros(asked + 1)
    np.add.at(cross, (problem.index[:, :, None], places[:, None, :]), blocks[:, X, C])
    for part in sums.parts:
        total += _among(blocks[part, C, C], places[part], asked + 1)
    np.add.at(score, places, blocks[:, C, r])
    cross, total, score = cross[:size, :asked], total[:asked, :asked], score[:asked]
    moving = np.flatnonzero(problem.free & (np.diag(square) > 0) & ~_pressed(fit))
    inverse = inverse_of_block(square, moving)
    lever, step = inverse @ cross, inverse @ slope
    information, gone = _emptied(total - cross.T @ lever, total)
    score = score - cross.T @ step
    score[gone] = 0.0
    return _Projected(blocks, lever, step, moving, score, information, gone)


def _among(blocks: Floats, places: NDArray[np.int_], size: int) -> Floats:
    """Sum of the trials' blocks, each row and column put in its place, shape (size, size)."""
    flat = places[:, :, None] * size + places[:, None, :]
    total = np.bincount(flat.ravel(), weights=blocks.ravel(), minlength=size**2)
    return np.asarray(total.reshape(size, size), dtype=float)


def levers_of(fit: Fit, sums: Products) -> Floats:
    """How far each number of a fit falls for each unit of another effect's size, by linear algebra.

    Parameters
    ----------
    fit : the fit.
    sums : its products with the shapes.

    Returns
    -------
    ndarray, shape (n_numbers, n_shapes)
        I_θθ⁻¹ I_θs with systematic errors integrated out, in units of the number over those of the size.
    """
    projection = projected(fit, sums, fit.state)
    lever = projection.lever @ _systematics_turn(projection.information, sums.n_shapes)
    free = fit.predictor.layout.free
    slopes = [
        number.value if parameter.logarithmic else parameter.scale
        for parameter, number in zip(free, fit.numbers, strict=True)
    ]
    return np.asarray(lever[: len(free)] * np.array(slopes)[:, None])


def scores_of(fit: Fit, sums: Products, state: FitState | None = None) -> Scores:
    """Scores at a fit, or with the noise and spreads of another `state`.

    Parameters
    ----------
    fit : the fit that is questioned.
    sums : from `products_of`.
    state : FitState, optional
        Noise and spreads in place of the fit's.

    Returns
    -------
    Scores
    """
    projection = projected(fit, sums, state or fit.state)
    blocks, index, asked = projection.blocks, fit.solution.problem.index, sums.asked
    p, n_shapes = sums.n_keys, sums.n_shapes
    X, r, C, S = slice(0, p), p, slice(p + 1, None), slice(p + 1, p + 1 + n_shapes)
    turn = _systematics_turn(projection.information, n_shapes)
    score, information = _beside_systematics(projection.score, projection.information, turn)
    counted = np.where(projection.gone[:, None], 0.0, turn)
    # Numbers and errors that a trial does not feel stand in a last row, of zeros.
    turned, counted_turned, lever, turn, counted = (
        np.vstack([rows, np.zeros((1, rows.shape[1]))])
        for rows in (projection.lever @ turn, projection.lever @ counted, projection.lever[:, :n_shapes], turn, counted)
    )
    step = np.append(projection.step, 0.0)
    single, informations = np.empty((len(blocks), n_shapes)), np.empty((len(blocks), n_shapes, n_shapes))
    for part in sums.parts:
        of_part, keys, felt = blocks[part], index[part], asked[part]
        left = of_part[:, :, r] - np.einsum("nqk,nk->nq", of_part[:, :, X], step[keys])
        single[part] = np.einsum("nc,ncs->ns", left[:, C], counted[felt]) - np.einsum(
            "nk,nks->ns", left[:, X], counted_turned[keys]
        )
        of_shapes, of_numbers = np.swapaxes(turn[felt], 1, 2), np.swapaxes(turned[keys], 1, 2)
        informations[part] = of_shapes @ (of_part[:, C, S] - of_part[:, C, X] @ lever[keys]) - of_numbers @ (
            of_part[:, X, S] - of_part[:, X, X] @ lever[keys]
        )
    degrees = max(len(single) - projection.moving.size, 1)
    return Scores(score, information, single, informations, float(degrees))


def informations_at(fit: Fit, sums: Products, spreads: Sequence[tuple[float, float]]) -> Floats:
    """Information of the size of every shape, alone, at other between-trial standard deviations.

    That of `scores_of`, with the sum over trials taken first: between-trial standard deviations only change what the
    two deviations of each trial explain, of rank two, so that no block of all shapes is made for any trial.

    Parameters
    ----------
    fit : the fit that is questioned.
    sums : from `products_of`.
    spreads : sequence of (float, float)
        Of pressure, relative, and of ln B.

    Returns
    -------
    array, shape (n_spreads, n_shapes)
    """
    state, size, p = fit.state, fit.solution.problem.prior_mean.size, sums.n_keys
    problem = with_shapes(fit.solution.problem, sums.n_asked)
    total = problem.prior_mean.size
    keys = fit.solution.problem.index
    index = np.concatenate([np.where(keys < 0, total, keys), size + sums.asked], axis=1)
    problem = replace(problem, index=index)
    whole, squares, levers = np.zeros((total, total)), [], []
    for part in sums.parts:
        # The residual tells nothing of the information.
        cross_products = np.delete(
            np.delete(sums.cross_products(part), N_TRIAL_EFFECTS + p, axis=2), N_TRIAL_EFFECTS + p, axis=3
        )
        white = at_correlation(cross_products, state.rho) / state.variance[part, None, None]
        flat = white[:, :2, :2] + problem.release_origin_precision[part, :, None] * np.eye(2)
        left = white[:, 2:, 2:] - white[:, 2:, :2] @ solve_per_trial(flat, white[:, :2, 2:])
        whole += sum_matrix_blocks(left[:, 2:, 2:], replace(problem, index=problem.index[part]))
        lever = np.zeros((len(left), 2, total + 1))
        for k in range(index.shape[1]):
            lever[np.arange(len(left)), :, index[part, k]] += left[:, :2, 2 + k]
        squares.append(left[:, :2, :2])
        levers.append(lever[:, :, :total])
    square, lever = np.concatenate(squares), np.concatenate(levers)
    alone = []
    for spread in spreads:
        precision = 1 / np.maximum(spreads_of_trials(problem, spread), LEAST_BETWEEN_TRIAL_SD) ** 2
        explained = solve_per_trial(square + precision[:, :, None] * np.eye(2), lever)
        information = whole - lever.reshape(-1, total).T @ explained.reshape(-1, total)
        alone.append(np.diag(_alone(fit, information, sums.n_shapes)))
    return np.array(alone)


def _alone(fit: Fit, information: Floats, n_shapes: int) -> Floats:
    """Information of the shapes, the free numbers projected off and systematic errors integrated out.

    `information` is that of the free numbers, shapes and systematic errors together, without the priors of the numbers.
    """
    problem = fit.solution.problem
    size = problem.prior_mean.size
    square = information[:size, :size] + np.diag(problem.prior_precision)
    moving = np.flatnonzero(problem.free & (np.diag(square) > 0) & ~_pressed(fit))
    cross = information[:size, size:]
    known = information[size:, size:]
    left, _ = _emptied(known - cross.T @ inverse_of_block(square, moving) @ cross, known)
    return _beside_systematics(np.zeros(len(left)), left, _systematics_turn(left, n_shapes))[1]


def _emptied(information: Floats, before: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Information, and which shapes have none: what rounding leaves of one that others imitate exactly is nothing.

    `before` is the information before the others were taken off.
    """
    gone = np.diag(information) < ROUNDING_SHARE * np.maximum(np.diag(before)[: len(information)], 1e-300)
    left = information.copy()
    left[gone, :] = left[:, gone] = 0.0
    return left, gone


def _systematics_turn(information: Floats, n_shapes: int) -> Floats:
    """What turns shapes and systematic errors into what is left of the shapes, shape (n_asked, n_shapes).

    Systematic errors have standard deviation 1 and are integrated out.
    """
    asked = len(information)
    turn = np.zeros((asked, n_shapes))
    turn[:n_shapes] = np.eye(n_shapes)
    if asked > n_shapes:
        inner = information[n_shapes:, n_shapes:] + np.eye(asked - n_shapes)
        turn[n_shapes:] = -np.linalg.solve(inner, information[n_shapes:, :n_shapes])
    return turn


def _beside_systematics(score: Floats, information: Floats, turn: Floats) -> tuple[Floats, Floats]:
    """Score and information of the shapes once systematic errors are integrated out, see `_systematics_turn`."""
    left, gone = _emptied(information[: turn.shape[1]] @ turn, information)
    alone = turn.T @ score
    alone[gone] = 0.0
    return alone, left


def _pressed(fit: Fit) -> NDArray[np.bool_]:
    """Numbers at a bound, which cannot give way."""
    return np.array([math.isfinite(number.bound) for number in fit.numbers], dtype=bool)


def linear_gains(fit: Fit, sums: Products, rho: float) -> tuple[Floats, Floats]:
    """How far −2 ln L would fall with each shape, and at which size, if everything were linear.

    The noise is as correlated as in the tracks, of whatever size is left: where a model is far off, the noise of its
    fit has taken in what it misses, and says nothing of what is missing.

    Parameters
    ----------
    fit : the fit that is questioned.
    sums : from `products_of`.
    rho : float
        Lag-one correlation of the tracks' noise.

    Returns
    -------
    fall, size : arrays, shape (n_shapes,)
    """
    state = fit.solution.state
    points = fit.solution.problem.points
    total = points.sum()
    variance = state.variance
    for _ in range(4):
        trial_state = FitState(state.theta, state.trial_effects, (0.01, 0.03), rho, variance)
        projection = projected(fit, sums, trial_state)
        turn = _systematics_turn(projection.information, sums.n_shapes)
        score, information = _beside_systematics(projection.score, projection.information, turn)
        left_over = _rest(fit, projection.blocks, sums.n_keys, trial_state)
        variance = np.full_like(variance, float(np.mean(variance)) * max(left_over / total, 1e-6))
    diagonal = np.maximum(np.diag(information), 1e-300)
    size = np.where(np.diag(information) > 0, score / diagonal, 0.0)
    left = np.maximum(left_over - score * size, 1e-3 * left_over)
    return np.asarray(total * np.log(left_over / left)), size


def _rest(fit: Fit, blocks: Floats, p: int, state: FitState) -> float:
    """Sum of squares that the fit's own numbers leave, with the priors' part."""
    problem = fit.solution.problem
    square = sum_matrix_blocks(blocks[:, :p, :p], problem) + np.diag(problem.prior_precision)
    away = state.theta - problem.prior_mean
    slope = sum_vector_blocks(blocks[:, :p, p], problem) - problem.prior_precision * away
    step = np.linalg.lstsq(square, slope, rcond=1e-11)[0]
    whole = blocks[:, p, p].sum() + float(np.sum(problem.prior_precision * away**2))
    return max(float(whole - step @ slope), 1e-9 * float(whole))
