"""How far the data pin the numbers of a fit: covariance, degrees of freedom, intervals, profiles.

Errors follow from the information of the linear mixed model. As spreads are estimated from a handful of trials, 95 %
intervals take Student's t with Satterthwaite's degrees of freedom (Giesbrecht & Burns, Biometrics 41, 477, 1985).
Where a bound is near, a straight line says little: there the interval is that of the profile, the values that a
constrained fit cannot reject.
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

SINGULAR = 1e-10
"""Smallest eigenvalue of an information matrix of unit diagonal at which two numbers can still be told apart."""

LEAST_INFORMATION = 1e-6
"""Information below which a number moves no trajectory: χ² would change by this for the whole scale of the number.
Chosen far below anything of weight: a Δχ² of 1e-6 is an interval of a thousand scales."""

NEAR_A_BOUND = 3.5
"""Standard errors within which a bound makes the interval a profile. Derived: beyond 3.5 the normal interval of 95 %
and the profile agree to a thousandth."""

LOG_STEP = 0.1
"""Step of a profile in the logarithm of a positive number. Chosen: 10 % a step; only time depends on it, the end of
the interval is interpolated."""


@dataclass(frozen=True)
class Precision:
    """Covariance of the free numbers as the fit holds them, shape (n_free, n_free), infinite where nothing is known.

    `degrees`, shape (n_free,), are those of freedom of the errors. `insensitive` marks numbers that move no trajectory,
    `collinear` those that only a sum or product with others fixes.
    """

    covariance: Floats
    degrees: Floats
    insensitive: np.ndarray
    collinear: np.ndarray


def first_parameters(known: Precision, count: int) -> Precision:
    """What is known of the first `count` numbers, the others being integrated out.

    Parameters
    ----------
    known : covariance of all numbers.
    count : int
        How many are kept.

    Returns
    -------
    Precision
    """
    return Precision(
        known.covariance[:count, :count], known.degrees[:count], known.insensitive[:count], known.collinear[:count]
    )


def precision(solution: Solution) -> Precision:
    """Covariance at the end of a fit, by the model of the noise and the scatter.

    Parameters
    ----------
    solution : where the iterations ended.

    Returns
    -------
    Precision
    """
    part = marginal(solution.cross_products, solution.problem, solution.state)
    covariance, insensitive, collinear = _covariance(part, solution.problem, solution.state, solution.state.spread)
    return Precision(covariance, degrees_of_freedom(solution), insensitive, collinear)


def _covariance(
    part: Marginal, problem: MixedProblem, state: FitState, spread: tuple[float, float]
) -> tuple[Floats, np.ndarray, np.ndarray]:
    """Covariance of the free numbers, which of them are insensitive, and which are collinear."""
    information = normal_equations(part, problem, state, spread)[0]
    diagonal = np.diag(information)
    insensitive = problem.free & ~(diagonal > LEAST_INFORMATION)
    k = np.flatnonzero(problem.free & ~insensitive)
    covariance = np.zeros_like(information)
    collinear = np.zeros(diagonal.size, dtype=bool)
    if k.size:
        scale = 1 / np.sqrt(diagonal[k])
        values, vectors = np.linalg.eigh(information[np.ix_(k, k)] * scale[:, None] * scale)
        singular = values < SINGULAR
        for column in np.flatnonzero(singular):
            collinear[k] |= np.abs(vectors[:, column]) > 0.1
        inverse = (vectors[:, ~singular] / values[~singular]) @ vectors[:, ~singular].T
        covariance[np.ix_(k, k)] = inverse * scale[:, None] * scale
    unknown = np.flatnonzero(insensitive | collinear)
    covariance[unknown, unknown] = math.inf
    return covariance, insensitive, collinear


def degrees_of_freedom(solution: Solution) -> Floats:
    """Satterthwaite's degrees of freedom of every free number, shape (n_free,); infinite where no spread matters.

    Source: Giesbrecht & Burns, Biometrics 41, 477 (1985): 2V²/var(V), var(V) from the curvature of the restricted
    likelihood in the logarithms of the between-trial standard deviations.

    Parameters
    ----------
    solution : where the iterations ended.

    Returns
    -------
    array, shape (n_free,)
    """
    problem, state = solution.problem, solution.state
    active = [k for k in range(2) if solution.estimable[k] and state.spread[k] > 1e-4]
    size = problem.prior_mean.size
    if not active:
        return np.full(size, math.inf)
    part = marginal(solution.cross_products, problem, state)

    def moved(shifts: Floats) -> tuple[float, float]:
        spread = list(state.spread)
        for k, shift in zip(active, shifts, strict=True):
            spread[k] *= math.exp(shift)
        return spread[0], spread[1]

    steps = LOG_STEP * np.eye(len(active))
    slopes = [
        (_variances(part, problem, state, moved(step)) - _variances(part, problem, state, moved(-step)))
        / (2 * LOG_STEP)
        for step in steps
    ]
    curvature = _curvature(lambda shifts: 0.5 * deviance(part, problem, state, moved(shifts)), len(active))
    values, vectors = np.linalg.eigh(curvature)
    seen = values > 1e-3
    spread_covariance = (vectors[:, seen] / values[seen]) @ vectors[:, seen].T
    gradient = np.column_stack(slopes)
    uncertainty = np.einsum("pi,ij,pj->p", gradient, spread_covariance, gradient)
    variances = _variances(part, problem, state, state.spread)
    with np.errstate(divide="ignore", invalid="ignore"):
        degrees = 2 * variances**2 / uncertainty
    return np.where(uncertainty > 0, np.maximum(degrees, 2.0), math.inf)


def _variances(part: Marginal, problem: MixedProblem, state: FitState, spread: tuple[float, float]) -> Floats:
    return np.nan_to_num(np.diag(_covariance(part, problem, state, spread)[0]), posinf=0.0)


def _curvature(function: Callable[[Floats], float], size: int) -> Floats:
    """Second derivatives of a function of `size` numbers at zero."""
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
    """Half width of 95 % in standard errors.

    Parameters
    ----------
    dof : array
        Degrees of freedom, infinite for a normal distribution.

    Returns
    -------
    array
    """
    from scipy.stats import t

    return np.asarray(t.ppf(0.975, np.minimum(dof, 1e6)))


def near_bound(solution: Solution, sigma: Floats) -> np.ndarray:
    """Which numbers have a bound within reach of their error, shape (n_free,).

    Parameters
    ----------
    solution : where the iterations ended.
    sigma : array, shape (n_free,)
        Standard errors, scaled.

    Returns
    -------
    array of bool, shape (n_free,)
    """
    problem, theta = solution.problem, solution.state.theta
    room = np.minimum(theta - problem.lower, problem.upper - theta)
    return np.isfinite(sigma) & (room < NEAR_A_BOUND * sigma)


def profile_interval(
    predictor: Predictor, solution: Solution, place: int, sigma: float, reach: float
) -> tuple[float, float]:
    """Interval of one number as the fit holds it: where a fit constrained to a value lies `reach`² above the best.

    Spreads and noise stay those of the best fit, so that for a straight line this is the interval ± `reach` · `sigma`.
    A side that meets a bound first ends there.

    Parameters
    ----------
    predictor : of the trials that were fitted.
    solution : where the iterations ended.
    place : int
        Place of the number among the free ones.
    sigma : float
        Its standard error, scaled.
    reach : float
        Half width of the interval in standard errors.

    Returns
    -------
    low, high : float
        Scaled.
    """
    problem, state = solution.problem, solution.state
    held = FixedTerms(state.spread, (state.rho, state.variance))
    best = _lowest(solution)
    ends = []
    for side, bound in ((-1, problem.lower[place]), (1, problem.upper[place])):
        value, tried = float(state.theta[place]), [(0.0, 0.0)]
        away = reach * sigma
        for _ in range(6):
            away = min(away, abs(bound - value))
            if away <= 1e-12:
                break
            rise = _rise(predictor, solution, held, place, value + side * away, best)
            tried.append((away, math.copysign(math.sqrt(abs(rise)), rise)))
            if abs(tried[-1][1] - reach) < 0.03 * reach or (away >= abs(bound - value) and tried[-1][1] < reach):
                break
            away = _next_guess(tried, reach)
        ends.append(value + side * min(away, abs(bound - value)))
    return ends[0], ends[1]


def _lowest(solution: Solution) -> float:
    part = marginal(solution.cross_products, solution.problem, solution.state)
    return deviance(part, solution.problem, solution.state, solution.state.spread, restricted=False)


def _rise(predictor: Predictor, solution: Solution, held: FixedTerms, place: int, value: float, best: float) -> float:
    """By how much −2 ln L rises when one number is held at `value` and all others are fitted again."""
    free = solution.problem.free.copy()
    free[place] = False
    theta = solution.state.theta.copy()
    step = value - theta[place]
    part = marginal(solution.cross_products, solution.problem, solution.state)
    covariance = _covariance(part, solution.problem, solution.state, solution.state.spread)[0]
    if math.isfinite(covariance[place, place]) and covariance[place, place] > 0:
        along = np.nan_to_num(covariance[:, place] / covariance[place, place], posinf=0.0)
        theta = np.clip(theta + along * step, solution.problem.lower, solution.problem.upper)
    theta[place] = value
    problem = replace(solution.problem, free=free)
    try:
        constrained = solve(
            predictor, problem, replace(solution.state, theta=theta), held, warm=True, most_iterations=8
        )
    except SimulationError:
        return 1e6
    return _lowest(constrained) - best


def _next_guess(tried: list[tuple[float, float]], reach: float) -> float:
    """Where the root of the rise reaches its aim, by the chord through the two points nearest to it."""
    below = max((hypothesis for hypothesis in tried if hypothesis[1] <= reach), key=lambda point: point[0])
    above = min((hypothesis for hypothesis in tried if hypothesis[1] > reach), key=lambda point: point[0], default=None)
    if above is None:
        return below[0] * float(np.clip(reach / max(below[1], 0.2), 1.2, 3.0))
    return below[0] + (above[0] - below[0]) * (reach - below[1]) / (above[1] - below[1])
