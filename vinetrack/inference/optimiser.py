"""The iterations of a fit: new trajectories, new spreads and noise, one damped Newton step, until nothing moves."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.inference.fit_problem import estimable, floor, track_correlation
from vinetrack.inference.marginal_likelihood import estimate_between_trial_sd, estimate_noise, marginal
from vinetrack.inference.mixed_effects import FitState, MixedProblem, levenberg_marquardt_step, shared_penalty
from vinetrack.inference.sensitivity import Predictor
from vinetrack.inference.trial_effects import (
    ReleaseSearch,
    limited,
    optimise_trial_effects,
    residuals_in,
    trial_costs,
)
from vinetrack.inference.whitening import at_correlation

MOST_ITERATIONS = 60
"""Chosen as a safeguard against creeping; a fit that reaches it says that it has not settled."""

SETTLED_DECREASE = 1e-2
"""A step that promises less than this of −2 ln L moves every number by under a twentieth of its error. Derived: −2 ln
L of 0.01 is 0.1 standard errors for all numbers together."""

SETTLED_SPREAD = 0.02
"""Relative change of spreads and noise that counts as settled. Chosen: errors follow to 2 %; half costs one or two
iterations, twice moves intervals by 4 %."""

NEARLY_SETTLED, PATIENCE, MOST_LOOKS = 3.0, 4, 8
"""Where a step promises less, or after so many steps, releases that no frame at rest shows are looked for elsewhere: a
step only creeps along such a valley. So often at most. Chosen for time: the search of releases costs as much as four
steps."""

EARLY_ITERATIONS, MOST_EARLY, FAR_OFF = 3, 9, 1e3
"""Spreads and the correlation of the noise stay those first assumed for three steps, and on while a step still
promises more than this of −2 ln L: what is only not yet fitted must not pass for noise or scatter. Chosen: a start
misses by less than that after three steps, or needs more; at half the spreads soak up what the first steps have not
fitted yet."""

PROGRESS_STEPS = 4
"""Steps in which a fit that may end early has to come forward. Chosen: as many as lie between two searches of
releases, after which −2 ln L may rise for a step or two; at half such a rise would end it, at twice a third of the
steps is saved instead of more than half. The likelihood of a vine that sticks has corners where more steps stand still,
so a fit that is asked for by itself is not ended."""

CREEPING = 2e-3
"""Fall of −2 ln L per point in PROGRESS_STEPS steps below which a fit far off, one of a search, ends. Derived: −2 ln L
of n points with noise s is n ln s², so what the model misses then changes by less than a thousandth: such a candidate
is far off, and which of those far off is a little less so decides nothing. At half and at twice it ends a step or two
later or earlier."""

LOST = 3e-3
"""Part of its growth by which the median trial is missed where a model is far off. Chosen: several times what a
tracker errs by slowly along the way; it decides whether further starts are tried, so half costs time and twice may
keep a local minimum."""

POOR_FIT = 3.0
"""χ² per degree of freedom above which a fit may be a local minimum, and other starts are tried. Chosen: half would
try further starts for most fits (time), twice would keep local minima."""

SHORTER, MOST_DAMPED = (1.0, 0.4, 0.15), 11
"""Parts of a step that are tried, and how often it is damped further if none of them helps. Chosen: a line search in
factors of about 0.4, then damping in factors of ten."""


@dataclass(frozen=True)
class FixedTerms:
    """What a fit is told instead of finding it: spreads of pressure and B, correlation and variances of the noise.

    `correlation` alone leaves the size of the noise to be found: what a model misses then counts as noise, but not as
    slow noise, which could explain anything.
    """

    spread: tuple[float, float] | None = None
    noise: tuple[float, Floats] | None = None
    correlation: float | None = None


@dataclass(frozen=True)
class Solution:
    """Where the iterations ended.

    `columns` are the sensitivities and residuals of each trial at `state` (`Predictor.linearise`), `cross_products`
    their sums of products (`whitening.products`).
    """

    state: FitState
    problem: MixedProblem
    cross_products: Floats
    columns: tuple[Floats, ...]
    estimable: tuple[bool, bool]
    converged: bool
    iterations: int


@dataclass(frozen=True)
class Step:
    """Where the iterations are: the numbers, SI, by name, and by how much the step just found lowers −2 ln L.

    Smooth errors of position (`vinetrack.inference.position_errors`) are fitted after the last step, and move the
    numbers that the fit reports.
    """

    iteration: int
    values: Mapping[str, float]
    predicted_decrease: float


Watch = Callable[[Step], None]
"""Told of every step; what it raises ends the fit."""

Shortfall = Callable[[Floats, MixedProblem, FitState, float], float]
"""How far −2 ln L of a fit is behind where it has to get, from its products, problem, state and sum of squares."""


def solve(
    predictor: Predictor,
    problem: MixedProblem,
    state: FitState,
    held: FixedTerms | None = None,
    *,
    warm: bool = False,
    most_iterations: int = MOST_ITERATIONS,
    watch: Watch | None = None,
    columns: Sequence[Floats] | None = None,
    least_decrease: float = SETTLED_DECREASE,
    search: bool = False,
    behind: Shortfall | None = None,
) -> Solution:
    """Iterate to the end. `warm` says that the state is near it already.

    Method: Lindstrom & Bates, Biometrics 46, 673 (1990), Gauss–Newton steps of the linear mixed model in turns with
    estimates of noise and spreads, damped after Levenberg and Marquardt.

    Parameters
    ----------
    predictor : of the trials to fit.
    problem : what does not change during the fit.
    state : where to begin.
    held : FixedTerms, optional
        Spreads and noise that are not estimated.
    warm : bool
        Whether the state is near the end already.
    most_iterations : int
        Steps at most.
    watch : callable, optional
        Called with each step.
    columns : sequence of arrays, shape (n_points, 4 + n_keys + 1), optional
        Sensitivities at the state, as `Predictor.linearise` has them, where they are known.
    least_decrease : float
        Predicted decrease of −2 ln L per step below which the fit has converged.
    search : bool
        Whether the fit is one of many that are held against each other: far off, it ends where it only creeps.
    behind : callable, optional
        A fit ends, unsettled, where it would stay behind even if this step brought all that it promises, and each that
        is left as much as the last ones.

    Returns
    -------
    Solution

    Raises
    ------
    SimulationError
        If the trajectories of the start cannot be followed.
    """
    held = held or FixedTerms()
    can = (False, False) if held.spread is not None else estimable(problem)
    if held.spread is not None:
        state = replace(state, spread=held.spread)
    if held.noise is not None:
        state = replace(state, rho=held.noise[0], variance=held.noise[1])
    if held.correlation is not None:
        state = replace(state, rho=held.correlation)
    damping, converged, iteration, predicted_decrease = (0.0 if warm else 1e-3), False, 0, math.inf
    early = not warm
    columns, cross_products = _about(predictor, state) if columns is None else (columns, predictor.products(columns))
    looks, looked, in_vain = MOST_LOOKS, 0, False
    levels: list[float] = []
    releases = ReleaseSearch(predictor, problem)
    for iteration in range(1, most_iterations + 1):
        near = predicted_decrease < FAR_OFF or iteration > MOST_EARLY
        early = early and not (iteration > EARLY_ITERATIONS and near)
        before = state
        state = _update_variances(predictor, problem, cross_products, state, can, held, early=early)
        moved = variances_moved(before, state)
        step, own_change, predicted_decrease = levenberg_marquardt_step(cross_products, problem, state, damping)
        if watch is not None:
            watch(_step_report(predictor, state, iteration, predicted_decrease))
        settled = predicted_decrease < least_decrease
        if looks and (
            settled or (predicted_decrease < NEARLY_SETTLED and not in_vain) or iteration >= looked + PATIENCE
        ):
            looked, in_vain = iteration, True
            jumped = releases.look(state, residuals_in(columns))
            if jumped is not None:
                state, (columns, cross_products) = jumped, _about(predictor, jumped)
                looks, in_vain = looks - 1, False
                continue
            looks = 0 if settled else looks
        if settled and moved < SETTLED_SPREAD and not early:
            converged = True
            break
        now = cost(predictor, problem, state, residuals_in(columns))
        levels.append(_level(problem, state, now, held))
        if search and _creeps(levels, CREEPING * float(np.sum(problem.points))):
            there = Solution(state, problem, cross_products, tuple(columns), can, converged, iteration)
            if is_poor_fit(predictor, there):
                break
        if behind is not None and iteration > EARLY_ITERATIONS:
            further = (most_iterations - iteration) * _fall_per_step(levels)
            if behind(cross_products, problem, state, now) > _most_gained(problem, now, predicted_decrease) + further:
                break
        taken, damping = _take_step(predictor, problem, cross_products, state, step, own_change, damping, now)
        if taken is None:
            # No step helps: a corner of the cost, where a frame meets the end of growth. It is as low as it gets.
            converged = moved < SETTLED_SPREAD
            if converged:
                break
            continue
        try:
            columns, cross_products = _about(predictor, taken)
        except SimulationError:
            # A neighbour of the new place cannot be followed: what was reached before is worth more than nothing.
            break
        state = taken
    return Solution(state, problem, cross_products, tuple(columns), can, converged, iteration)


def _level(problem: MixedProblem, state: FitState, now: float, held: FixedTerms) -> float:
    """−2 ln L but for a constant: where the noise is held, as if it were as large as what is missed."""
    if held.noise is not None:
        return float(np.sum(problem.points)) * math.log(max(now, 1e-300))
    return now + float(np.sum(problem.points * np.log(state.variance)))


def _most_gained(problem: MixedProblem, now: float, predicted_decrease: float) -> float:
    """Fall of −2 ln L if a step keeps its promise and the noise is taken for as much less.

    Of n points with noise s it is n ln s²; a step near the end promises all but the noise itself.
    """
    left = 1 - predicted_decrease / max(now, 1e-300)
    return -float(np.sum(problem.points)) * math.log(left) if left > 0 else math.inf


def _fall_per_step(levels: Sequence[float]) -> float:
    """By how much each of the last steps lowered the least −2 ln L; infinite where there are too few of them to tell.

    Its levels may go up and down in turns, noise and numbers being found in turns.
    """
    before = levels[:-PROGRESS_STEPS]
    return (min(before) - min(levels)) / PROGRESS_STEPS if before else math.inf


def _creeps(levels: Sequence[float], least: float) -> bool:
    """Whether the last steps lowered −2 ln L by less than `least`; never just after a jump that raised it."""
    before, last = levels[:-PROGRESS_STEPS], levels[-PROGRESS_STEPS:]
    return bool(before) and last[-1] == min(last) > min(before) - least


def _about(predictor: Predictor, state: FitState) -> tuple[list[Floats], Floats]:
    """Sensitivities at a state, and their sums of products."""
    columns = predictor.linearise(state.theta, state.trial_effects)
    return columns, predictor.products(columns)


def _step_report(predictor: Predictor, state: FitState, iteration: int, predicted_decrease: float) -> Step:
    values = predictor.layout.values(state.theta).tolist()
    return Step(
        iteration, dict(zip([number.name for number in predictor.layout.free], values, strict=True)), predicted_decrease
    )


def chi2_per_dof(predictor: Predictor, solution: Solution) -> float:
    """What the model leaves against the noise that the tracks show alone, of their correlation.

    Noise below what the integrator can answer for counts as that much, see `fit_problem.floor`.

    Parameters
    ----------
    predictor : of the trials that were fitted.
    solution : where the iterations ended.

    Returns
    -------
    float
    """
    data = predictor.data
    rho = track_correlation(data)
    noise = np.maximum(np.array([trial_data.noise_m**2 for trial_data in data]) * (1 - rho**2), floor(data))
    left = at_correlation(solution.cross_products, rho)[:, -1, -1]
    taken = np.count_nonzero(solution.problem.free) / left.size + 2 + solution.problem.feels.any(axis=1)
    return float(np.sum(left / noise) / np.sum(np.maximum(solution.problem.points - taken, 1.0)))


def is_poor_fit(predictor: Predictor, solution: Solution) -> bool:
    """Whether a solution is far from the tracks: beyond their noise, and by a visible part of the growth.

    A tracker whose frames agree to a hundredth of a millimetre may err by a few tenths along the way: far beyond their
    noise, and no reason to begin elsewhere.

    Parameters
    ----------
    predictor : of the trials that were fitted.
    solution : where the iterations ended.

    Returns
    -------
    bool
    """
    return bool(chi2_per_dof(predictor, solution) > POOR_FIT and missed_fraction(predictor, solution) > LOST)


def missed_fraction(predictor: Predictor, solution: Solution) -> float:
    """Root mean square of what is missed, as part of the growth that was seen; of the median trial.

    Parameters
    ----------
    predictor : of the trials that were fitted.
    solution : where the iterations ended.

    Returns
    -------
    float
    """
    parts = [
        math.sqrt(float(np.mean(columns[:, -1] ** 2))) / max(float(np.ptp(trial_data.lead_position_m)), 1e-9)
        for columns, trial_data in zip(solution.columns, predictor.data, strict=True)
    ]
    return float(np.median(parts))


def _update_variances(
    predictor: Predictor,
    problem: MixedProblem,
    cross_products: Floats,
    state: FitState,
    can: tuple[bool, bool],
    held: FixedTerms,
    *,
    early: bool,
) -> FitState:
    """Noise and spreads anew; while the trajectories are still far off only the size of what is left."""
    if held.noise is None:
        known = state.rho if early or held.correlation is not None else None
        rho, variance = estimate_noise(cross_products, problem, state, known)
        state = replace(state, rho=rho, variance=np.maximum(variance, floor(predictor.data)))
    if not early and any(can):
        spread = estimate_between_trial_sd(marginal(cross_products, problem, state), problem, state, can)
        state = replace(state, spread=spread)
    return state


def variances_moved(before: FitState, after: FitState) -> float:
    """Largest relative change among spreads and noise; spreads below a thousandth count as none.

    Parameters
    ----------
    before, after : states.

    Returns
    -------
    float
    """
    spreads = [abs(np.log((b + 1e-3) / (a + 1e-3))) for a, b in zip(before.spread, after.spread, strict=True)]
    noise = np.max(np.abs(np.log(after.variance / before.variance)))
    return float(max(*spreads, noise, abs(after.rho - before.rho)))


def _take_step(
    predictor: Predictor,
    problem: MixedProblem,
    cross_products: Floats,
    state: FitState,
    step: Floats,
    own_change: Floats,
    damping: float,
    now: float,
) -> tuple[FitState | None, float]:
    """The first of ever shorter, then ever more damped steps that lowers the sum of squares, and the damping to go on.

    A step too long for a curved valley is right in its direction, which damping would turn across the valley. `now` is
    the sum of squares with what the priors add where the state stands.
    """
    for part in SHORTER:
        tried = _tried(predictor, problem, state, part * step, part * own_change, now, at_once=True)
        if tried is not None:
            return tried, damping * 0.1 if damping > 1e-6 else 0.0
    for _ in range(MOST_DAMPED):
        damping = max(10 * damping, 1e-4)
        step, own_change, _ = levenberg_marquardt_step(cross_products, problem, state, damping)
        tried = _tried(predictor, problem, state, step, own_change, now)
        if tried is not None:
            return tried, damping * 0.1
    return None, 0.0


def _tried(
    predictor: Predictor,
    problem: MixedProblem,
    state: FitState,
    step: Floats,
    own_change: Floats,
    now: float,
    *,
    at_once: bool = False,
) -> FitState | None:
    """The state after a step, if that lowers the sum of squares.

    One is refused `at_once` where the trials' own numbers cannot make up for it by their linear answer, which is wrong
    where a release meets a frame: so never the last that are tried.
    """
    theta = np.clip(state.theta + step, problem.lower, problem.upper)
    try:
        there = replace(state, theta=theta, trial_effects=limited(predictor, state.trial_effects, own_change))
        most = now - shared_penalty(problem, there)
        there, costs = optimise_trial_effects(predictor, problem, there, most if at_once else math.inf)
    except SimulationError:
        return None
    return there if float(np.sum(costs)) < most else None


def cost(
    predictor: Predictor, problem: MixedProblem, state: FitState, residuals: Sequence[Floats] | None = None
) -> float:
    """Whitened sum of squares of all trials with what the priors add.

    Parameters
    ----------
    predictor : of the trials to fit.
    problem : what does not change during the fit.
    state : where the fit stands.
    residuals : sequence of arrays, shape (n_points,), m, optional
        What is left of each trial there, where it is known.

    Returns
    -------
    float
    """
    return float(np.sum(trial_costs(predictor, problem, state, residuals))) + shared_penalty(problem, state)
