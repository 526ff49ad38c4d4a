"""Uncertainty of the parameters of a fit: covariance, degrees of freedom, intervals, profile likelihood.

The covariance is the inverse information of the linearised mixed model. As between-trial standard deviations are
estimated from a few trials, 95 % intervals use Student's t with Satterthwaite degrees of freedom (Giesbrecht & Burns,
Biometrics 41, 477, 1985). Near a bound, where a linear interval is invalid, the interval is that of the profile
likelihood: the values that a constrained fit does not reject.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.inference.marginal_likelihood import Marginal, deviance, marginal, normal_equations
from vinetrack.inference.mixed_effects import FitState, MixedProblem
from vinetrack.inference.optimiser import FixedTerms, Solution, solve
from vinetrack.inference.sensitivity import Predictor

# Smallest eigenvalue of an information matrix of unit diagonal at which a direction still counts as determined
SINGULAR_EIGENVALUE = 1e-10

LEAST_INFORMATION = 1e-6  # Information below which a parameter has no influence on the trajectories (chosen)

NEAR_BOUND_SIGMAS = 3.5  # Standard errors from a bound within which the interval is a profile interval

LOG_STEP = 0.1  # Step of derivatives in the logarithm of a positive number (chosen)


@dataclass(frozen=True)
class Precision:
    """Covariance of the free parameters, scaled, shape (n_free, n_free), infinite for undetermined ones. `degrees`,
    shape (n_free,), are the degrees of freedom of the errors. `insensitive` marks parameters without influence on the
    trajectories, `collinear` those of which only a combination with others is determined.
    """

    covariance: Floats
    degrees: Floats
    insensitive: np.ndarray
    collinear: np.ndarray


def first_parameters(precision_of_all: Precision, count: int) -> Precision:
    """The precision of the first `count` parameters, the others integrated out."""
    return Precision(
        precision_of_all.covariance[:count, :count],
        precision_of_all.degrees[:count],
        precision_of_all.insensitive[:count],
        precision_of_all.collinear[:count],
    )


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
        singular = values < SINGULAR_EIGENVALUE
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
        (_variances(part, problem, state, spread_at(step)) - _variances(part, problem, state, spread_at(-step)))
        / (2 * LOG_STEP)
        for step in steps
    ]
    curvature = _curvature(lambda shifts: 0.5 * deviance(part, problem, state, spread_at(shifts)), len(active))
    values, vectors = np.linalg.eigh(curvature)
    determined = values > 1e-3
    spread_covariance = (vectors[:, determined] / values[determined]) @ vectors[:, determined].T
    gradient = np.column_stack(slopes)
    uncertainty = np.einsum("pi,ij,pj->p", gradient, spread_covariance, gradient)
    variances = _variances(part, problem, state, state.spread)
    with np.errstate(divide="ignore", invalid="ignore"):
        degrees = 2 * variances**2 / uncertainty
    return np.where(uncertainty > 0, np.maximum(degrees, 2.0), math.inf)


def _variances(part: Marginal, problem: MixedProblem, state: FitState, spread: tuple[float, float]) -> Floats:
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
    from scipy.stats import t

    return np.asarray(t.ppf(0.975, np.minimum(dof, 1e6)))


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
    interval ± `reach` · `sigma`. A side that meets a bound first ends there. Returns low, high : float: Scaled.
    """
    problem, state = solution.problem, solution.state
    held = FixedTerms(state.spread, (state.rho, state.variance))
    best = _deviance(solution)
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


def _deviance(solution: Solution) -> float:
    part = marginal(solution.cross_products, solution.problem, solution.state)
    return deviance(part, solution.problem, solution.state, solution.state.spread, restricted=False)


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
    return _deviance(constrained) - best


def _next_distance(evaluated: list[tuple[float, float]], reach: float) -> float:
    """Distance at which the root of the increase reaches its target, by a chord through the two nearest points."""
    below = max((point for point in evaluated if point[1] <= reach), key=lambda point: point[0])
    above = min((point for point in evaluated if point[1] > reach), key=lambda point: point[0], default=None)
    if above is None:
        return below[0] * float(np.clip(reach / max(below[1], 0.2), 1.2, 3.0))
    return below[0] + (above[0] - below[0]) * (reach - below[1]) / (above[1] - below[1])
