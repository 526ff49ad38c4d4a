"""Errors of fitted parameters: precision with systematic errors, profile intervals, few trials, scatter of trials.

The systematic errors (`vinetrack.inference.systematics`) are parameters of the linearised fit, each with its prior. Its
likelihood compares hypotheses without crediting any of them with what such an error could explain.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from vinetrack.core.records import Floats, Trial
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.experiment.schema import GROUPINGS
from vinetrack.inference.gaussian_processes import whiten
from vinetrack.inference.marginal_likelihood import (
    DEVIATION_COLUMNS,
    FitState,
    Marginal,
    MixedProblem,
    at_unknowns,
    deviance,
    estimate_noise,
    inverse_of_block,
    levenberg_marquardt_step,
    log_likelihood,
    marginal,
    matrix_root,
    normal_equations,
    trial_effect_step,
    trial_effects_eliminated,
)
from vinetrack.inference.optimiser import (
    CONVERGED_VARIANCES,
    FixedTerms,
    Solution,
    solve,
    update_variances,
    variance_change,
    variance_floor,
)
from vinetrack.inference.sensitivity import N_TRIAL_EFFECTS, Predictor
from vinetrack.inference.systematics import systematics_of

# ------------------------------------------------------------------------------
# Uncertainty of the parameters of a fit: covariance, degrees of freedom, intervals, profile likelihood.
#
# The covariance is the inverse information of the linearised mixed model. As between-trial standard deviations are
# estimated from a few trials, 95 % intervals use Student's t with Satterthwaite degrees of freedom (Giesbrecht &
# Burns, Biometrics 41, 477, 1985). Near a bound, where a linear interval is invalid, the interval is that of the
# profile likelihood: the values that a constrained fit does not reject.


LEAST_INFORMATION = 1e-6  # Information below which a parameter has no influence on the trajectories (chosen)

NEAR_BOUND_SIGMAS = 3.5  # Standard errors from a bound within which the interval is a profile interval

LOG_STEP = 0.1  # Step of derivatives in the logarithm of a positive number (chosen)


@dataclass(frozen=True)
class Precision:
    """Covariance of the free parameters, scaled, shape (n_free, n_free), infinite for undetermined ones. `degrees`,
    shape (n_free,), are the degrees of freedom of the errors. `insensitive` marks parameters without influence on the
    trajectories, `collinear` those of which only a combination with others is determined. `shared` is the part of the
    variance that all trials share, by its source.
    """

    covariance: Floats
    degrees: Floats
    insensitive: np.ndarray
    collinear: np.ndarray
    shared: Mapping[str, Floats] = field(default_factory=dict)

    def first(self, count: int) -> Precision:
        """The same of the first `count` parameters, the others integrated out."""
        arrays = {name: getattr(self, name)[:count] for name in ("degrees", "insensitive", "collinear")}
        shared = {name: variance[:count] for name, variance in self.shared.items()}
        return Precision(self.covariance[:count, :count], shared=shared, **arrays)


def precision(solution: Solution) -> Precision:
    """Covariance at the end of a fit, from the model of noise and between-trial variation."""
    part = marginal(solution.cross_products, solution.problem, solution.state)
    covariance, insensitive, collinear = _covariance(part, solution.problem, solution.state, solution.state.spread)
    return Precision(covariance, degrees_of_freedom(solution), insensitive, collinear)


def _covariance(
    part: Marginal, problem: MixedProblem, state: FitState, spread: tuple[float, float]
) -> tuple[Floats, np.ndarray, np.ndarray]:
    """Covariance of the free parameters, which of them are insensitive, and which are collinear."""
    information = normal_equations(part, problem, state, spread)[0]
    diagonal = np.diag(information)
    insensitive = problem.free & ~(diagonal > LEAST_INFORMATION)
    k = np.flatnonzero(problem.free & ~insensitive)
    covariance = np.zeros_like(information)
    collinear = np.zeros(diagonal.size, dtype=bool)
    if k.size:
        scale = 1 / np.sqrt(diagonal[k])
        values, vectors = np.linalg.eigh(information[np.ix_(k, k)] * scale[:, None] * scale)
        # 1e-10: smallest eigenvalue of an information matrix of unit diagonal at which a direction still
        # counts as determined
        singular = values < 1e-10
        for column in np.flatnonzero(singular):
            collinear[k] |= np.abs(vectors[:, column]) > 0.1
        inverse = (vectors[:, ~singular] / values[~singular]) @ vectors[:, ~singular].T
        covariance[np.ix_(k, k)] = inverse * scale[:, None] * scale
    unknown = np.flatnonzero(insensitive | collinear)
    covariance[unknown, unknown] = math.inf
    return covariance, insensitive, collinear


def degrees_of_freedom(solution: Solution) -> Floats:
    """Satterthwaite degrees of freedom of every free parameter; infinite if no between-trial variance matters. Source:
    Giesbrecht & Burns, Biometrics 41, 477 (1985): 2V²/var(V), var(V) from the curvature of the restricted likelihood in
    the logarithms of the between-trial standard deviations. Shape (n_free,).
    """
    problem, state = solution.problem, solution.state
    active = [k for k in range(2) if solution.estimable[k] and state.spread[k] > 1e-4]
    size = problem.prior_mean.size
    if not active:
        return np.full(size, math.inf)
    part = marginal(solution.cross_products, problem, state)

    def spread_at(shifts: Floats) -> tuple[float, float]:
        spread = list(state.spread)
        for k, shift in zip(active, shifts, strict=True):
            spread[k] *= math.exp(shift)
        return spread[0], spread[1]

    steps = LOG_STEP * np.eye(len(active))
    slopes = [
        (
            _intervals_variances(part, problem, state, spread_at(step))
            - _intervals_variances(part, problem, state, spread_at(-step))
        )
        / (2 * LOG_STEP)
        for step in steps
    ]
    curvature = _curvature(lambda shifts: 0.5 * deviance(part, problem, state, spread_at(shifts)), len(active))
    values, vectors = np.linalg.eigh(curvature)
    determined = values > 1e-3
    spread_covariance = (vectors[:, determined] / values[determined]) @ vectors[:, determined].T
    gradient = np.column_stack(slopes)
    uncertainty = np.einsum("pi,ij,pj->p", gradient, spread_covariance, gradient)
    variances = _intervals_variances(part, problem, state, state.spread)
    with np.errstate(divide="ignore", invalid="ignore"):
        degrees = 2 * variances**2 / uncertainty
    return np.where(uncertainty > 0, np.maximum(degrees, 2.0), math.inf)


def _intervals_variances(part: Marginal, problem: MixedProblem, state: FitState, spread: tuple[float, float]) -> Floats:
    return np.nan_to_num(np.diag(_covariance(part, problem, state, spread)[0]), posinf=0.0)


def _curvature(function: Callable[[Floats], float], size: int) -> Floats:
    """Second derivatives of a function of `size` variables at zero, by central differences."""
    step, unit = LOG_STEP, LOG_STEP * np.eye(size)
    centre = function(np.zeros(size))
    matrix = np.empty((size, size))
    for i in range(size):
        matrix[i, i] = (function(unit[i]) - 2 * centre + function(-unit[i])) / step**2
        for j in range(i):
            both = function(unit[i] + unit[j]) + function(-unit[i] - unit[j])
            across = function(unit[i] - unit[j]) + function(unit[j] - unit[i])
            matrix[i, j] = matrix[j, i] = (both - across) / (4 * step**2)
    return matrix


def student(dof: Floats) -> Floats:
    """Half width of a 95 % interval in standard errors."""
    return np.asarray(stdtrit(np.minimum(dof, 1e6), 0.975))


def near_bound(solution: Solution, sigma: Floats) -> np.ndarray:
    """Parameters with a bound within `NEAR_BOUND_SIGMAS` standard errors. Shapes: sigma (n_free,) → (n_free,)."""
    problem, theta = solution.problem, solution.state.theta
    room = np.minimum(theta - problem.lower, problem.upper - theta)
    return np.isfinite(sigma) & (room < NEAR_BOUND_SIGMAS * sigma)


def profile_interval(
    predictor: Predictor, solution: Solution, place: int, sigma: float, reach: float
) -> tuple[float, float]:
    """Profile-likelihood interval of one parameter: constrained fits whose −2 ln L lies within `reach`² of the best.
    Between-trial standard deviations and noise stay those of the best fit, so that for a linear model this is the
    interval ± `reach` · `sigma`. A side that meets a bound first ends there. Returns low, high, scaled.
    """
    problem, state = solution.problem, solution.state
    held = FixedTerms(state.spread, (state.rho, state.variance))
    best = solution.deviance(restricted=False)
    ends = []
    for side, bound in ((-1, problem.lower[place]), (1, problem.upper[place])):
        value, evaluated = float(state.theta[place]), [(0.0, 0.0)]
        distance = reach * sigma
        for _ in range(6):
            distance = min(distance, abs(bound - value))
            if distance <= 1e-12:
                break
            rise = _deviance_increase(predictor, solution, held, place, value + side * distance, best)
            evaluated.append((distance, math.copysign(math.sqrt(abs(rise)), rise)))
            if abs(evaluated[-1][1] - reach) < 0.03 * reach or (
                distance >= abs(bound - value) and evaluated[-1][1] < reach
            ):
                break
            distance = _next_distance(evaluated, reach)
        ends.append(value + side * min(distance, abs(bound - value)))
    return ends[0], ends[1]


def _deviance_increase(
    predictor: Predictor, solution: Solution, held: FixedTerms, place: int, value: float, best: float
) -> float:
    """Increase of −2 ln L if one parameter is fixed at `value` and all others are fitted again."""
    free = solution.problem.free.copy()
    free[place] = False
    theta = solution.state.theta.copy()
    step = value - theta[place]
    part = marginal(solution.cross_products, solution.problem, solution.state)
    covariance = _covariance(part, solution.problem, solution.state, solution.state.spread)[0]
    if math.isfinite(covariance[place, place]) and covariance[place, place] > 0:
        direction = np.nan_to_num(covariance[:, place] / covariance[place, place], posinf=0.0)
        theta = np.clip(theta + direction * step, solution.problem.lower, solution.problem.upper)
    theta[place] = value
    problem = replace(solution.problem, free=free)
    try:
        constrained = solve(
            predictor, problem, replace(solution.state, theta=theta), held, warm=True, most_iterations=8
        )
    except SimulationError:
        return 1e6
    return constrained.deviance(restricted=False) - best


def _next_distance(evaluated: list[tuple[float, float]], reach: float) -> float:
    """Distance at which the root of the increase reaches its target, by a chord through the two nearest points."""
    below = max((point for point in evaluated if point[1] <= reach), key=lambda point: point[0])
    above = min((point for point in evaluated if point[1] > reach), key=lambda point: point[0], default=None)
    if above is None:
        return below[0] * float(np.clip(reach / max(below[1], 0.2), 1.2, 3.0))
    return below[0] + (above[0] - below[0]) * (reach - below[1]) / (above[1] - below[1])


@dataclass(frozen=True)
class WithSystematics:
    """A fit with its systematic errors included. `solution` holds the free parameters of the fit and after them the
    sizes of the errors in prior standard deviations, and `sources` where each of these comes from. `gain` of ln L is
    that over the fit as it is.
    """

    solution: Solution
    sources: Sequence[str]
    gain: float
    whitened: tuple[Floats, ...]


def with_systematics(predictor: Predictor, solution: Solution, held: FixedTerms | None = None) -> WithSystematics:
    """Fit the systematic errors along with the parameters of a fit, to first order."""
    errors = systematics_of(predictor, solution)
    extended = errors.beside(solution.columns)
    held = held or FixedTerms()
    fixed_insensitive = replace(solution.problem, free=solution.problem.free & _sensitive(solution))
    problem = errors.among(fixed_insensitive)
    start = replace(solution.state, theta=np.append(solution.state.theta, np.zeros(errors.count)))
    state, cross_products, moved, level = _newton_on_fixed_columns(predictor, solution, extended, problem, start, held)
    # A poor fit is not at its minimum, and the linear model overestimates the gain. That part is the same without the
    # errors, so it is subtracted.
    without_errors = _newton_on_fixed_columns(
        predictor, solution, solution.columns, fixed_insensitive, solution.state, held
    )[3]
    residuals = [values[:, -1] - values[:, :-1] @ change for values, change in zip(extended, moved, strict=True)]
    return WithSystematics(
        solution=replace(
            solution,
            state=state,
            problem=errors.among(solution.problem),
            cross_products=cross_products,
            columns=tuple(
                np.column_stack([block[:, :-1], left]) for block, left in zip(extended, residuals, strict=True)
            ),
        ),
        sources=errors.sources,
        gain=level - without_errors,
        whitened=tuple(
            whiten(values, trial_data.first, state.rho, trial_data.relative_sd) / np.sqrt(variance)
            for values, trial_data, variance in zip(residuals, predictor.data, state.variance, strict=True)
        ),
    )


def _sensitive(solution: Solution) -> NDArray[np.bool_]:
    """Free parameters that influence some trajectory. The column of a parameter without influence is rounding error.
    With fixed columns, a step along it would be millions of scales long and predict a likelihood that no trajectory
    confirms.
    """
    part = marginal(solution.cross_products, solution.problem, solution.state)
    information = normal_equations(part, solution.problem, solution.state, solution.state.spread)[0]
    return np.asarray(np.diag(information) > LEAST_INFORMATION)


def _newton_on_fixed_columns(
    predictor: Predictor,
    solution: Solution,
    columns: Sequence[Floats],
    problem: MixedProblem,
    state: FitState,
    held: FixedTerms,
) -> tuple[FitState, Floats, Floats, float]:
    """Newton steps at fixed sensitivities: state, cross products there, total change of each trial's unknowns, ln L.
    Steps are taken as long as they raise ln L. Two parameters that only rounding separates may get a step of any length
    along the direction in which they cancel; no trajectory is simulated here that would reject it.
    """
    # Decrease of −2 ln L of a step at which the linear iteration has converged, a hundredth of what matters in a
    # comparison, where differences count from 1; and the maximum number of steps (measured)
    converged_decrease_smooth, most_steps = 1e-2, 15
    cross_products = predictor.products(columns)
    total_change = np.zeros((len(cross_products), cross_products.shape[-1] - 1))

    def with_variances(products: Floats, state: FitState) -> FitState:
        return update_variances(predictor, problem, products, state, solution.estimable, held)

    state = with_variances(cross_products, state)
    level = log_likelihood(cross_products, problem, state, solution.estimable)
    for _ in range(most_steps):
        step, own_step, predicted_decrease = levenberg_marquardt_step(cross_products, problem, state, 0.0)
        change = np.column_stack([own_step, np.append(step, 0.0)[problem.index]])
        products = _products_after_step(cross_products, change)
        before = replace(state, theta=state.theta + step, trial_effects=state.trial_effects + own_step)
        after = with_variances(products, before)
        new_level = log_likelihood(products, problem, after, solution.estimable)
        if new_level < level - converged_decrease_smooth:
            break
        cross_products, total_change, state, level = products, total_change + change, after, new_level
        if predicted_decrease < converged_decrease_smooth and variance_change(before, state) < CONVERGED_VARIANCES:
            break
    return state, cross_products, total_change, level


def _products_after_step(cross_products: Floats, change: Floats) -> Floats:
    """Cross products after a change of the unknowns of each trial, shape (n_trials, n_columns − 1). The residual
    becomes r − C·change, the other columns stay.
    """
    transformation = np.tile(np.eye(cross_products.shape[-1]), (len(cross_products), 1, 1))
    transformation[:, :-1, -1] = -change
    return np.asarray(np.swapaxes(transformation, 1, 2)[:, None] @ cross_products @ transformation[:, None])


# ------------------------------------------------------------------------------
# Pooling of few trials that disagree: a between-trial variance of the shared parameters sets the weights of trials.
#
# A fit gives every trial a noise of its own, and some trials a deviation of B and pressure. Where trials differ in a
# parameter that they share (the drag of two bodies, the yield pressure of a tube from day to day), the trial with the
# smaller noise determines it, and the misfit of the others passes for their noise, which reduces their weights
# further. So:
#
# 1. The noise of a trial is that of its residuals after its own B, n, C_D ... have been fitted too.
# 2. The parameters θ_i of trial i scatter about the shared θ, θ_i ~ N(θ, τ² M), with M the covariance of a typical
#    trial alone, by its noise, and τ² at the maximum of the restricted likelihood.


@dataclass(frozen=True)
class Pooled:
    """Shared parameters with trials weighted by noise and disagreement, scaled. `solution` is the state at these
    parameters, with the systematic errors as further ones.
    """

    solution: Solution
    information: Floats
    scores: Floats
    covariance: Floats
    between: Floats


def pool(predictor: Predictor, solution: Solution, shared: int) -> Pooled | None:
    """Estimate the shared parameters with trials weighted by noise and disagreement."""
    if len(predictor.data) < 2:
        return None
    errors = systematics_of(predictor, solution)
    problem = errors.among(solution.problem)
    state = replace(solution.state, theta=np.append(solution.state.theta, np.zeros(errors.count)))
    columns: Sequence[Floats] = solution.columns
    # 12, 0.05: maximum number of steps, and the length of a step in standard errors at which they have converged
    # (chosen)
    for _ in range(12):
        extended = errors.beside(columns, state.theta[shared:])
        cross_products = predictor.products(extended)
        rho, variance = estimate_noise(cross_products, problem, state, within=True)
        state = replace(state, rho=rho, variance=np.maximum(variance, variance_floor(predictor.data)))
        pooled = _with_weights(
            replace(solution, state=state, problem=problem, cross_products=cross_products, columns=tuple(extended)),
            shared,
        )
        pull = problem.prior_precision * (state.theta - problem.prior_mean)
        step = pooled.covariance @ (pooled.scores.sum(axis=0) - pull)
        scatter = np.sqrt(np.diag(pooled.covariance) + np.diag(pooled.between))
        longest = float(np.max(np.abs(step) / np.maximum(scatter, 1e-300), initial=0.0))
        sigma = np.sqrt(np.maximum(np.diag(pooled.covariance), 1e-300))
        if float(np.max(np.abs(step) / sigma, initial=0.0)) < 0.05:
            return pooled
        # 3.0: longest step of a parameter, in units of √(its variance + the variance between trials) (chosen)
        step = step * min(1.0, 3.0 / longest)
        state = _state_after_step(pooled.solution, state, step)
        # 3.0: deviation of a trial's ln B, or relative one of its pressure, at which a step has left the
        # region in which the model is nearly linear (chosen)
        if np.max(np.abs(state.trial_effects[:, DEVIATION_COLUMNS])) > 3.0:
            return None
        try:
            columns = predictor.linearise(state.theta[:shared], state.trial_effects)
        except SimulationError:
            return None
    return None


def _state_after_step(solution: Solution, state: FitState, step: Floats) -> FitState:
    """The state after a step, with the effects of the trials following to first order."""
    problem = solution.problem
    theta = np.clip(state.theta + step, problem.lower, problem.upper)
    change = np.append(theta - state.theta, 0.0)[problem.index]
    moved_products = _products_after_step(solution.cross_products, np.pad(change, ((0, 0), (N_TRIAL_EFFECTS, 0))))
    trial_effects = state.trial_effects + trial_effect_step(moved_products, problem, state)[0]
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
    # 1e-12: least information of a trial on a direction that counts, relative to its largest (derived)
    determined = values > 1e-12 * values[:, -1:]
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
    placed = at_unknowns(blocks, np.pad(problem.index, ((0, 0), (0, 1)), constant_values=size), size + 1)
    return placed[:, :-1, :-1], placed[:, :-1, -1]


def _typical_root(covariance: Floats, information: Floats, shared: int) -> Floats:
    """A root of M: the covariance of all trials times the number of trials that depend on a parameter."""
    informative_trials = np.count_nonzero(np.einsum("nkk->nk", information) > 0, axis=0).astype(float)
    informative_trials[shared:] = 0.0
    factor = np.sqrt(informative_trials)
    return matrix_root(covariance * factor[:, None] * factor)


def _maximise_likelihood(deviance: Callable[[float], float]) -> float:
    """The τ² of lowest deviance: 0, or the lowest of a grid, refined."""
    from scipy.optimize import minimize_scalar

    # 1e6: largest τ², in variances of one trial by its noise (chosen)
    logs = np.linspace(math.log(1e-2), math.log(1e6), 24)
    levels = [deviance(math.exp(log)) for log in logs]
    best = int(np.argmin(levels))
    low, high = logs[max(best - 1, 0)], logs[min(best + 1, logs.size - 1)]
    minimum = minimize_scalar(lambda log_tau2: deviance(math.exp(log_tau2)), bounds=(low, high), method="bounded")
    return float(math.exp(minimum.x)) if minimum.fun < deviance(0.0) else 0.0


# ------------------------------------------------------------------------------
# Robust covariance of the parameters of a fit, from the scatter of trials.
#
# The inverse information is the covariance only if noise and between-trial variation are as modelled. The scatter of
# the scores of single trials gives a cluster-robust (sandwich) covariance (White, Econometrica 48, 817, 1980, with
# trials as clusters), which only ever widens an error.

FEWEST_CLUSTERS = 8  # Trials from which the sandwich is better than the model of the noise (chosen)

FEWEST_DEGREES = 4  # Trials beyond the number of parameters that a sandwich needs (chosen)


def cluster_variance(single: Floats, fitted: int, groups: Sequence[str]) -> Floats:
    """Variance of sums over trials, from the scatter of single trials or, where that is larger, of their clusters
    (`coarsest_groups`); 0 where trials are too few. Shapes: single (n_trials, n) → (n,).
    """
    trials = len(single)
    if trials < FEWEST_CLUSTERS:
        return np.zeros(single.shape[1])
    single = single - single.mean(axis=0)
    return np.max([np.diag(group_scatter(single, each, fitted)) for each in (range(trials), groups)], axis=0)


def too_few_clusters(predictor: Predictor, solution: Solution) -> bool:
    """Whether there are too few trials for a sandwich covariance."""
    spare = len(predictor.data) - np.count_nonzero(solution.problem.free)
    return len(predictor.data) < FEWEST_CLUSTERS or bool(spare < FEWEST_DEGREES)


def widened_covariance(
    predictor: Predictor,
    solution: Solution,
    model_precision: Precision,
    sources: Sequence[str],
    pooled: Pooled | None = None,
) -> Precision:
    """Covariance and degrees of freedom at the end of a fit with its systematic errors, the last unknowns, widened by
    the scatter of trials. `sources` are where each of these errors comes from.
    """
    plain, robust = robust_covariance(predictor, solution)
    at_most, trials = model_precision.degrees, len(predictor.data)
    spare = trials - estimated_unknowns(solution, plain)
    if pooled is None and trials >= FEWEST_CLUSTERS and spare >= FEWEST_DEGREES:
        variance = np.diag(robust)
        clusters = len(set(coarsest_groups([trial_data.trial for trial_data in predictor.data])))
        few = np.full(variance.size, min(spare, clusters - 1.0))
    elif pooled is None:
        variance, few = _few_trial_variances(*trial_information(solution), solution, plain)
    else:
        plain = pooled.covariance
        variance, few = _few_trial_variances(pooled.information, pooled.scores, solution, plain)
        at_most = np.where(np.diag(pooled.between) > 0, np.minimum(at_most, few), at_most)
    diagonal = np.diag(plain)
    ratio = np.sqrt(np.maximum(np.divide(variance, diagonal, out=np.ones_like(diagonal), where=diagonal > 0), 1.0))
    degrees = np.where(ratio > 1, np.minimum(at_most, few), at_most)
    covariance = (
        np.where(np.isfinite(model_precision.covariance), model_precision.covariance, 0.0) * ratio[:, None] * ratio
    )
    unknown = np.flatnonzero(~np.isfinite(np.diag(model_precision.covariance)))
    covariance[unknown, unknown] = np.inf
    # What the parameters would be known better by if the errors from a source were known.
    source_of, shared = np.array([""] * (len(plain) - len(sources)) + list(sources)), {}
    for source in dict.fromkeys(sources):
        across = plain[:, source_of == source]
        known = np.linalg.pinv(plain[np.ix_(source_of == source, source_of == source)], hermitian=True)
        shared[source] = np.sum((across @ known) * across, axis=1) * ratio**2
    return replace(model_precision, covariance=covariance, degrees=degrees, shared=shared)


def estimated_unknowns(solution: Solution, covariance: Floats) -> float:
    """How many unknowns the trials determine: each counts by the part of its information that is not its prior's."""
    by_prior = solution.problem.prior_precision * np.diag(covariance)
    return float(np.sum(np.where(np.diag(covariance) > 0, 1 - by_prior, 0.0)))


def _few_trial_variances(
    information: Floats, scores: Floats, solution: Solution, plain: Floats
) -> tuple[Floats, Floats]:
    """Variances of the free parameters from the disagreement of few trials, without bias, and their degrees of freedom.
    Each trial pulls the fit towards itself, by its share K_i of the information, and so shows less than its error: in
    units of the errors of the model its score has the variance K_i(1 − K_i), and is divided by √(1 − K_i) (CR2: Bell &
    McCaffrey, Survey Methodology 28, 169, 2002). Returns variance, degrees : arrays, shape (n_free,), of scaled
    parameters. Shapes: plain (n_free, n_free).
    """
    variance, degrees = np.diag(plain).copy(), np.full(len(plain), np.inf)
    estimated = np.flatnonzero(np.diag(plain) > 0)
    if not estimated.size or len(scores) < 2:
        return variance, degrees
    root = matrix_root(plain[np.ix_(estimated, estimated)])
    score = (scores - scores.mean(axis=0))[:, estimated] @ root
    shares, adjustments = [], []
    constant = root.T @ np.diag(solution.problem.prior_precision[estimated]) @ root
    for single in information:
        share = root.T @ single[np.ix_(estimated, estimated)] @ root
        values, vectors = np.linalg.eigh(share)
        # 0.99: share of the information on a direction from which one trial is practically the only one to
        # determine it (chosen)
        below_limit = values < 0.99
        adjustments.append(
            (vectors[:, below_limit] / np.sqrt(1 - np.maximum(values[below_limit], 0.0))) @ vectors[:, below_limit].T
        )
        constant = constant + (vectors[:, ~below_limit] * values[~below_limit]) @ vectors[:, ~below_limit].T
        shares.append(share)
    for k, place in enumerate(estimated.tolist()):
        weights_of_score = np.array([adjustment @ root[k] for adjustment in adjustments])
        scatter = float(np.sum(np.einsum("nk,nk->n", weights_of_score, score) ** 2))
        moved = np.einsum("nij,nj->ni", np.array(shares), weights_of_score)
        expected = np.diag(np.einsum("ni,ni->n", weights_of_score, moved)) - moved @ moved.T
        squares = float(np.sum(expected**2))
        variance[place] = scatter + float(root[k] @ constant @ root[k])
        if squares > 0 and scatter > 0:
            degrees[place] = max(np.trace(expected) ** 2 / squares * (variance[place] / scatter) ** 2, 1.0)
    return variance, degrees


def robust_covariance(predictor: Predictor, solution: Solution) -> tuple[Floats, Floats]:
    """Covariance of the free parameters by the noise model, and cluster-robust, from the scatter of trials, shape
    (n_free, n_free) each. Parameters at a bound are fixed there.
    """
    problem, theta = solution.problem, solution.state.theta
    information, scores = trial_information(solution)
    square = information.sum(axis=0) + np.diag(problem.prior_precision)
    inside = (theta > problem.lower) & (theta < problem.upper)
    estimated = np.flatnonzero(problem.free & inside & (np.diag(square) > 0))
    plain = inverse_of_block(square, estimated)
    # Scores of a parameter add up to the pull of its prior, in equal parts from each trial that depends on it.
    depend = (problem.index[:, :, None] == np.arange(len(theta))).any(axis=1)
    scores -= depend * (scores.sum(axis=0) / np.maximum(depend.sum(axis=0), 1))
    # The prior does not scatter from trial to trial, but its uncertainty contributes as well.
    prior = np.diag(problem.prior_precision)
    groups = coarsest_groups([trial_data.trial for trial_data in predictor.data])
    fitted = estimated_unknowns(solution, plain)
    meats = [group_scatter(scores, each, fitted) + prior for each in (range(len(scores)), groups)]
    robust, by_group = (plain @ meat @ plain for meat in meats)
    np.fill_diagonal(robust, np.maximum(np.diag(robust), np.diag(by_group)))
    return plain, robust


def coarsest_groups(trials: Sequence[Trial]) -> list[str]:
    """The clusters of trials whose errors may be correlated: specimens, else days, else single trials."""
    for column in GROUPINGS:
        names = [trial.group(column) for trial in trials]
        if all(getattr(trial, column) for trial in trials) and len(set(names)) >= FEWEST_CLUSTERS:
            return names
    return [str(i) for i in range(len(trials))]  # Not their names: a planned trial may be there several times


def group_scatter(single: Floats, groups: Sequence[Hashable], fitted: float) -> Floats:
    """Variance of the sum of scores from the scatter of sums over groups, corrected for few groups. The correction is
    G/(G − 1) · (N − 1)/(N − p), CR1 of Cameron & Miller, Journal of Human Resources 50, 317 (2015). Shapes: single
    (n_trials, n_free) → (n_free, n_free).
    """
    of_trial = np.unique(np.asarray(groups), return_inverse=True)[1]
    count, trials = of_trial.max() + 1, len(single)
    sums = np.zeros((count, single.shape[1]))
    np.add.at(sums, of_trial, single)
    factor = count / max(count - 1, 1) * (trials - 1) / max(trials - fitted, 1)
    return np.asarray(sums.T @ sums * factor)
