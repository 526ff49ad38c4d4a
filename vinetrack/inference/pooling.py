"""Pooling of few trials that disagree: a between-trial variance of the shared parameters sets the weights of trials.

A fit gives every trial a noise of its own, and some trials a deviation of B and pressure. Where trials differ in a
parameter that they share (the drag of two bodies, the yield pressure of a tube from day to day), the trial with the
smaller noise determines it, and the misfit of the others passes for their noise, which reduces their weights further.
So:

1. The noise of a trial is that of its residuals after its own B, n, C_D ... have been fitted too. 2. The parameters θ_i
of trial i scatter about the shared θ: θ_i ~ N(θ, τ² M).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.inference.fit_problem import variance_floor
from vinetrack.inference.gauss_newton import trial_effect_step
from vinetrack.inference.marginal_likelihood import estimate_noise
from vinetrack.inference.mixed_effects import (
    DEVIATION_COLUMNS,
    FitState,
    MixedProblem,
    inverse_of_block,
    trial_effects_eliminated,
)
from vinetrack.inference.optimiser import Solution
from vinetrack.inference.position_errors import position_shapes, with_shapes
from vinetrack.inference.sensitivity import N_TRIAL_EFFECTS, ORIGIN, Predictor

# Maximum number of steps, and the length of a step in standard errors at which they have converged (chosen)
MOST_STEPS, CONVERGED_STEP_SIGMAS = 12, 0.05

LARGEST_TAU2 = 1e6  # Largest τ², in variances of one trial by its noise (chosen)

LONGEST_STEP = 3.0  # Longest step of a parameter, in units of √(its variance + the variance between trials) (chosen)

# Least information of a trial on a direction that counts, relative to its largest (derived)
LEAST_RELATIVE_INFORMATION = 1e-12


@dataclass(frozen=True)
class Pooled:
    """Shared parameters with trials weighted by noise and disagreement, scaled. `solution` is the state at these
    parameters, with the smooth errors of position as further ones.
    """

    solution: Solution
    information: Floats
    scores: Floats
    covariance: Floats
    between: Floats


# Deviation of a trial's ln B, or relative one of its pressure, at which a step has left the region in which the model
# is nearly linear (chosen)
FARTHEST_DEVIATION = 3.0


def pool(predictor: Predictor, solution: Solution, shared: int) -> Pooled | None:
    """Estimate the shared parameters with trials weighted by noise and disagreement."""
    if len(predictor.data) < 2:
        return None
    shapes = _shapes(predictor, solution)
    count = shapes[0].shape[1]
    problem = with_shapes(solution.problem, count) if count else solution.problem
    state = replace(solution.state, theta=np.append(solution.state.theta, np.zeros(count)))
    columns: Sequence[Floats] = solution.columns
    for _ in range(MOST_STEPS):
        extended = _with_shapes(columns, shapes, state.theta[shared:])
        cross_products = predictor.products(extended)
        rho, variance = estimate_noise(cross_products, problem, state, within=True)
        state = replace(state, rho=rho, variance=np.maximum(variance, variance_floor(predictor.data)))
        pooled = _with_weights(
            replace(solution, state=state, problem=problem, cross_products=cross_products, columns=tuple(extended)),
            shared,
        )
        step = pooled.covariance @ _gradient(pooled, problem, state)
        scatter = np.sqrt(np.diag(pooled.covariance) + np.diag(pooled.between))
        longest = float(np.max(np.abs(step) / np.maximum(scatter, 1e-300), initial=0.0))
        errors = np.sqrt(np.maximum(np.diag(pooled.covariance), 1e-300))
        if float(np.max(np.abs(step) / errors, initial=0.0)) < CONVERGED_STEP_SIGMAS:
            return pooled
        step = step * min(1.0, LONGEST_STEP / longest)
        state = _state_after_step(pooled.solution, state, step)
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


def _gradient(pooled: Pooled, problem: MixedProblem, state: FitState) -> Floats:
    return np.asarray(pooled.scores.sum(axis=0) - problem.prior_precision * (state.theta - problem.prior_mean))


def _state_after_step(solution: Solution, state: FitState, step: Floats) -> FitState:
    """The state after a step, with the effects of the trials following to first order."""
    problem = solution.problem
    theta = np.clip(state.theta + step, problem.lower, problem.upper)
    change = np.append(theta - state.theta, 0.0)[problem.index]
    moved_products = solution.cross_products.copy()
    # The residual after the step: r − X δ.
    moved_products[..., -1] -= np.einsum("nsik,nk->nsi", solution.cross_products[..., N_TRIAL_EFFECTS:-1], change)
    trial_effects = state.trial_effects + trial_effect_step(moved_products, problem, state)
    return replace(state, theta=theta, trial_effects=trial_effects)


def _with_weights(solution: Solution, shared: int) -> Pooled:
    """The pooled fit at a state, with τ² at the maximum of its restricted likelihood."""
    problem, state = solution.problem, solution.state
    size = problem.prior_mean.size
    information, scores = trial_information(solution)
    total = information.sum(axis=0) + np.diag(problem.prior_precision)
    inside = (state.theta > problem.lower) & (state.theta < problem.upper)
    estimated = np.flatnonzero(problem.free & inside & (np.diag(total) > 0))
    root = _typical_root(inverse_of_block(total, estimated), information, shared)
    values, vectors = np.linalg.eigh(information)
    information_roots = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    # With J = H Hᵀ and Hᵀ R = U S Vᵀ, R the root of M, (J⁻¹ + τ²M)⁻¹ = H U (1 + τ²S²)⁻¹ Uᵀ Hᵀ for any τ²: J − J(…)J
    # would lose all digits of a parameter on which trials disagree to cancellation.
    rotation, singular_values, _ = np.linalg.svd(np.swapaxes(information_roots, 1, 2) @ root)
    rotated_roots = information_roots @ rotation
    determined = values > LEAST_RELATIVE_INFORMATION * values[:, -1:]
    score_parts = np.where(determined, 1 / np.sqrt(np.where(determined, values, 1.0)), 0.0) * np.einsum(
        "nij,ni->nj", vectors, scores
    )
    score_rest = scores - np.einsum("nij,nj->ni", information_roots, score_parts)
    score_parts = np.einsum("nij,ni->nj", rotation, score_parts)
    stacked = np.swapaxes(rotated_roots, 1, 2).reshape(-1, size)
    prior = np.diag(problem.prior_precision)
    offset = problem.prior_precision * (state.theta - problem.prior_mean) - score_rest.sum(axis=0)

    def deviance(tau2: float) -> float:
        shrinkage = 1 / (1 + tau2 * singular_values**2)
        total_information = ((stacked * shrinkage.reshape(-1, 1)).T @ stacked + prior)[np.ix_(estimated, estimated)]
        slope = ((shrinkage * score_parts).ravel() @ stacked - offset)[estimated]
        scale = 1 / np.sqrt(np.diag(total_information))
        scaled = total_information * scale[:, None] * scale
        decrease = float((scale * slope) @ np.linalg.lstsq(scaled, scale * slope, rcond=1e-11)[0])
        log_det = float(np.linalg.slogdet(total_information)[1]) - float(np.sum(np.log(shrinkage)))
        return log_det - float(np.sum((1 - shrinkage) * score_parts**2)) - decrease

    tau2 = _maximise_likelihood(deviance) if estimated.size else 0.0
    shrinkage = 1 / (1 + tau2 * singular_values**2)
    weight = (rotated_roots * shrinkage[:, None, :]) @ np.swapaxes(rotated_roots, 1, 2)
    score = np.einsum("nij,nj->ni", rotated_roots, shrinkage * score_parts) + score_rest
    covariance = inverse_of_block(weight.sum(axis=0) + prior, estimated)
    return Pooled(solution, weight, score, covariance, tau2 * root @ root.T)


def trial_information(solution: Solution) -> tuple[Floats, Floats]:
    """Information and scores of each trial on the free parameters, its trial effects integrated out. Returns
    information, scores. Shape (n_trials, n_free, n_free).
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
    """A root of M: the covariance of all trials times the number of trials that depend on a parameter."""
    informative_trials = np.count_nonzero(np.einsum("nkk->nk", information) > 0, axis=0).astype(float)
    informative_trials[shared:] = 0.0
    factor = np.sqrt(informative_trials)
    values, vectors = np.linalg.eigh(covariance * factor[:, None] * factor)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def _maximise_likelihood(deviance: Callable[[float], float]) -> float:
    """The τ² of lowest deviance: 0, or the lowest of a grid, refined."""
    from scipy.optimize import minimize_scalar

    logs = np.linspace(math.log(1e-2), math.log(LARGEST_TAU2), 24)
    levels = [deviance(math.exp(log)) for log in logs]
    best = int(np.argmin(levels))
    low, high = logs[max(best - 1, 0)], logs[min(best + 1, logs.size - 1)]
    minimum = minimize_scalar(lambda log_tau2: deviance(math.exp(log_tau2)), bounds=(low, high), method="bounded")
    return float(math.exp(minimum.x)) if minimum.fun < deviance(0.0) else 0.0
