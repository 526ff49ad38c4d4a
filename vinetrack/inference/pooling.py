"""Few trials that disagree: a between-trial variance of the shared numbers, which decides how much each trial weighs.

A fit gives every trial a noise of its own, and some a deviation of B and pressure. Where trials differ in a number that
they share (the drag of two bodies, the yield pressure of a tube from day to day), the trial with the smaller noise
decides the number, and what it misses in the others passes for their noise, which makes them weigh still less. So:

1. The noise of a trial is what is left once its own B, n, C_D ... have been fitted too.
2. The numbers θ_i of trial i scatter about the shared θ: θ_i ~ N(θ, τ² M). Assumed: the between-trial covariance is
   proportional to M, the covariance of all numbers that one typical trial leaves by its noise (that of all trials
   together times the number of trials that tell of a number). So there is one unknown, τ², instead of k(k + 1)/2, which
   a handful of trials could not tell: numbers scatter in the directions in which a trial says little, and by the same
   multiple of their errors. Where trials differ in one well-known number alone, M is wrong, and τ² too large for the
   others. With A_i the information and g_i the score of a trial at the current numbers, its estimate has the
   covariance A_i⁻¹ + τ² M. τ² maximises the restricted likelihood of several numbers at once (multivariate
   random-effects meta-analysis by REML: van Houwelingen, Arends & Stijnen, Statistics in Medicine 21, 589, 2002, and
   White, Stata Journal 9, 40, 2009, who leave the between-study covariance free; of one number: DerSimonian & Laird,
   Controlled Clinical Trials 7, 177, 1986, and Viechtbauer, J. Educ. Behav. Stat. 30, 261, 2005).
3. A step in θ with these weights, trajectories anew, until nothing moves.

With τ² = 0 the weights are those of the noise; with a large τ² all trials count alike.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.inference.fit_problem import variance_floor
from vinetrack.inference.marginal_likelihood import estimate_noise
from vinetrack.inference.mixed_effects import (
    DEVIATION_COLUMNS,
    FitState,
    MixedProblem,
    inverse_of_block,
    trial_effect_step,
    trial_effects_eliminated,
)
from vinetrack.inference.optimiser import Solution
from vinetrack.inference.position_errors import position_shapes, with_shapes
from vinetrack.inference.sensitivity import N_TRIAL_EFFECTS, ORIGIN, Predictor

MOST_STEPS, SETTLED = 12, 0.05
"""Steps at most, and the length of a step in standard errors at which they end. Chosen: a twentieth of an error; the
two drops of the tests take four steps."""

LARGEST_TAU2 = 1e6
"""Largest τ², in variances of one trial by its noise. Chosen: trials a thousand of their errors apart weigh alike."""

LONGEST_STEP = 3.0
"""Longest step of a number in standard deviations of what trials scatter by. Chosen: beyond it a straight line says
little; half takes a few more steps."""

KNOWN = 1e-12
"""Part of the information of a trial that what it tells in a direction must have to count. Derived: ten thousand
roundings of a double."""


@dataclass(frozen=True)
class Pooled:
    """Shared numbers with trials weighed by noise and by how much they disagree, as the fit holds them.

    `solution` stands at these numbers, smooth errors of position behind them. `information`, shape (n_trials, n_free,
    n_free), and `scores`, shape (n_trials, n_free), are those of the trials with τ² in them; `between`, shape (n_free,
    n_free), is τ² M, the covariance of a trial's numbers about the shared ones.
    """

    solution: Solution
    information: Floats
    scores: Floats
    covariance: Floats
    between: Floats


FARTHEST_DEVIATION = 3.0
"""Deviation of a trial's ln B, or relative one of its pressure, at which a step has left where the model is nearly
linear. Chosen: twenty times B; at half as at twice the steps that end there are the same, those that diverge."""


def pool(predictor: Predictor, solution: Solution, shared: int) -> Pooled | None:
    """Weigh the trials of a fit by noise and disagreement.

    Parameters
    ----------
    predictor : of the trials that were fitted.
    solution : where the fit ended.
    shared : int
        How many of its free numbers may scatter between trials: the first ones.

    Returns
    -------
    Pooled or None
        None for a single trial, or where the trajectories cannot be followed.
    """
    if len(predictor.data) < 2:
        return None
    shapes = _shapes(predictor, solution)
    count = shapes[0].shape[1]
    problem = with_shapes(solution.problem, count) if count else solution.problem
    state = replace(solution.state, theta=np.append(solution.state.theta, np.zeros(count)))
    columns: Sequence[Floats] = solution.columns
    for _ in range(MOST_STEPS):
        wide = _with_shapes(columns, shapes, state.theta[shared:])
        cross_products = predictor.products(wide)
        rho, variance = estimate_noise(cross_products, problem, state, within=True)
        state = replace(state, rho=rho, variance=np.maximum(variance, variance_floor(predictor.data)))
        pooled = _weighed(
            replace(solution, state=state, problem=problem, cross_products=cross_products, columns=tuple(wide)), shared
        )
        step = pooled.covariance @ _slope(pooled, problem, state)
        scatter = np.sqrt(np.diag(pooled.covariance) + np.diag(pooled.between))
        longest = float(np.max(np.abs(step) / np.maximum(scatter, 1e-300), initial=0.0))
        errors = np.sqrt(np.maximum(np.diag(pooled.covariance), 1e-300))
        if float(np.max(np.abs(step) / errors, initial=0.0)) < SETTLED:
            return pooled
        step = step * min(1.0, LONGEST_STEP / longest)
        state = _moved(pooled.solution, state, step)
        if np.max(np.abs(state.trial_effects[:, DEVIATION_COLUMNS])) > FARTHEST_DEVIATION:
            return None
        try:
            columns = predictor.linearise(state.theta[:shared], state.trial_effects)
        except SimulationError:
            return None
    return None


def _shapes(predictor: Predictor, solution: Solution) -> list[Floats]:
    grown = [
        trial_data.lead_position_m - trial_effects[ORIGIN] - columns[:, -1]
        for trial_data, trial_effects, columns in zip(
            predictor.data, solution.state.trial_effects, solution.columns, strict=True
        )
    ]
    return position_shapes(predictor, grown)


def _with_shapes(columns: Sequence[Floats], shapes: Sequence[Floats], sizes: Floats) -> list[Floats]:
    return [
        np.column_stack([block[:, :-1], shape, block[:, -1] - shape @ sizes])
        for block, shape in zip(columns, shapes, strict=True)
    ]


def _slope(pooled: Pooled, problem: MixedProblem, state: FitState) -> Floats:
    return np.asarray(pooled.scores.sum(axis=0) - problem.prior_precision * (state.theta - problem.prior_mean))


def _moved(solution: Solution, state: FitState, step: Floats) -> FitState:
    """The state a step further, releases, origins and deviations of the trials following to first order."""
    problem = solution.problem
    theta = np.clip(state.theta + step, problem.lower, problem.upper)
    change = np.append(theta - state.theta, 0.0)[problem.index]
    turned = solution.cross_products.copy()
    # The residual once the numbers have moved: r − X δ.
    turned[..., -1] -= np.einsum("nsik,nk->nsi", solution.cross_products[..., N_TRIAL_EFFECTS:-1], change)
    trial_effects = state.trial_effects + trial_effect_step(turned, problem, state)
    return replace(state, theta=theta, trial_effects=trial_effects)


def _weighed(solution: Solution, shared: int) -> Pooled:
    """Weights of the trials at a state, τ² at its most likely value."""
    problem, state = solution.problem, solution.state
    size = problem.prior_mean.size
    information, scores = trial_information(solution)
    total = information.sum(axis=0) + np.diag(problem.prior_precision)
    inside = (state.theta > problem.lower) & (state.theta < problem.upper)
    live = np.flatnonzero(problem.free & inside & (np.diag(total) > 0))
    root = _typical_root(inverse_of_block(total, live), information, shared)
    values, vectors = np.linalg.eigh(information)
    half = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    # With J = H Hᵀ and Hᵀ R = U S Vᵀ, R the root of M, (J⁻¹ + τ²M)⁻¹ = H U (1 + τ²S²)⁻¹ Uᵀ Hᵀ for any τ²: J − J(…)J
    # would lose every digit of a number that trials disagree on.
    turn, stretch, _ = np.linalg.svd(np.swapaxes(half, 1, 2) @ root)
    ways = half @ turn
    known = values > KNOWN * values[:, -1:]
    along = np.where(known, 1 / np.sqrt(np.where(known, values, 1.0)), 0.0) * np.einsum("nij,ni->nj", vectors, scores)
    beside = scores - np.einsum("nij,nj->ni", half, along)
    along = np.einsum("nij,ni->nj", turn, along)
    flat = np.swapaxes(ways, 1, 2).reshape(-1, size)
    prior = np.diag(problem.prior_precision)
    offset = problem.prior_precision * (state.theta - problem.prior_mean) - beside.sum(axis=0)

    def deviance(tau2: float) -> float:
        less = 1 / (1 + tau2 * stretch**2)
        inside_all = ((flat * less.reshape(-1, 1)).T @ flat + prior)[np.ix_(live, live)]
        slope = ((less * along).ravel() @ flat - offset)[live]
        scale = 1 / np.sqrt(np.diag(inside_all))
        even = inside_all * scale[:, None] * scale
        gained = float((scale * slope) @ np.linalg.lstsq(even, scale * slope, rcond=1e-11)[0])
        log_det = float(np.linalg.slogdet(inside_all)[1]) - float(np.sum(np.log(less)))
        return log_det - float(np.sum((1 - less) * along**2)) - gained

    tau2 = _most_likely(deviance) if live.size else 0.0
    less = 1 / (1 + tau2 * stretch**2)
    weight = (ways * less[:, None, :]) @ np.swapaxes(ways, 1, 2)
    score = np.einsum("nij,nj->ni", ways, less * along) + beside
    covariance = inverse_of_block(weight.sum(axis=0) + prior, live)
    return Pooled(solution, weight, score, covariance, tau2 * root @ root.T)


def trial_information(solution: Solution) -> tuple[Floats, Floats]:
    """What each trial tells of the free numbers, as the fit holds them, all it has of its own integrated out.

    Parameters
    ----------
    solution : where they stand

    Returns
    -------
    information : array, shape (n_trials, n_free, n_free)
    scores : array, shape (n_trials, n_free), the slopes of ln L
    """
    problem = solution.problem
    size, p = problem.prior_mean.size, problem.index.shape[1]
    blocks = trial_effects_eliminated(solution.cross_products, p, problem, solution.state)
    information = np.zeros((len(blocks), size + 1, size + 1))
    scores = np.zeros((len(blocks), size + 1))
    for i, (block, places) in enumerate(zip(blocks, problem.index, strict=True)):
        np.add.at(information[i], (places[:, None], places[None, :]), block[:p, :p])
        np.add.at(scores[i], places, block[:p, p])
    return information[:, :size, :size], scores[:, :size]


def _typical_root(covariance: Floats, information: Floats, shared: int) -> Floats:
    """A root of M: the covariance of all trials times the number of trials that tell of a number."""
    telling = np.count_nonzero(np.einsum("nkk->nk", information) > 0, axis=0).astype(float)
    telling[shared:] = 0.0
    factor = np.sqrt(telling)
    values, vectors = np.linalg.eigh(covariance * factor[:, None] * factor)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def _most_likely(deviance: Callable[[float], float]) -> float:
    """The τ² of lowest deviance: 0, or the lowest of a grid, refined."""
    from scipy.optimize import minimize_scalar

    logs = np.linspace(math.log(1e-2), math.log(LARGEST_TAU2), 24)
    levels = [deviance(math.exp(log)) for log in logs]
    best = int(np.argmin(levels))
    low, high = logs[max(best - 1, 0)], logs[min(best + 1, logs.size - 1)]
    minimum = minimize_scalar(lambda log_tau2: deviance(math.exp(log_tau2)), bounds=(low, high), method="bounded")
    return float(math.exp(minimum.x)) if minimum.fun < deviance(0.0) else 0.0
