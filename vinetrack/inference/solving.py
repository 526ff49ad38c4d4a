"""Solutions of a fit from several starts, and what is tried where one is far off the tracks.

A fit estimates the noise along with its numbers. Where a start is far off, what it misses may pass for slow noise, so
that the likelihood is high and the numbers wrong. Such a solution is recognised by what it misses of the growth
(`is_poor_fit`), and begun again with the noise held to that of the tracks.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.inference.fit_data import FitError
from vinetrack.inference.fit_problem import first_state, make_problem, track_correlation
from vinetrack.inference.marginal_likelihood import deviance, marginal
from vinetrack.inference.mixed_effects import FitState, MixedProblem
from vinetrack.inference.optimiser import (
    MOST_ITERATIONS,
    POOR_FIT,
    FixedTerms,
    Shortfall,
    Solution,
    Watch,
    chi2_per_dof,
    cost,
    is_poor_fit,
    solve,
)
from vinetrack.inference.sensitivity import Predictor
from vinetrack.inference.starts import align, candidates, initial_trial_effects
from vinetrack.inference.trial_effects import trial_costs

MOST_STARTS = 3
"""Starts and iterations at most. Chosen for time: fits that need more are taken up again by the search for a better
minimum."""

ITERATIONS_ONCE_MORE, GUIDED_ITERATIONS = 25, 40
"""Steps of a solution that is taken up again, and of one that is guided. Chosen for time: most settle in half of them;
at half some stay unsettled and say so, at twice hopeless starts cost twice the time."""

BAD_START = 1.5
"""χ² per point from which a start misses by more than the noise of the fit it came from. Chosen: below it the
likelihood is nearly quadratic and one descent suffices; it decides time, not results."""

SLOW_NOISE = 0.99
"""Noise correlation above which a fit has taken misfit for noise. Chosen: a correlation time of a hundred frames."""

STRICT_ITERATIONS, HOPELESS = 8, 30.0
"""After so many steps led by the noise of the tracks alone, χ² per degree of freedom above which none will help.
Chosen for time; a fit given up here is begun from other starts."""

GUIDING_SPREADS, STRICT_SPREADS = (5e-4, 1e-3), (0.01, 0.03)
"""Between-trial standard deviations of pressure and ln B while a fit is guided, first nearly none, then those of a
usual batch of vines (about 1 % of pressure, a few per cent of B). Chosen: they only lead the descent and are estimated
afterwards."""


def solve_from_scratch(predictor: Predictor, held: FixedTerms, watch: Watch | None, *, thorough: bool) -> Solution:
    """The best of the solutions from the likeliest starts; the first will do where it explains the data.

    Parameters
    ----------
    predictor : of the trials to fit.
    held : spreads and noise that are not estimated.
    watch : callable or None
        Called with each step.
    thorough : bool
        Whether a poor solution is begun from other starts.

    Returns
    -------
    Solution

    Raises
    ------
    FitError
        If the model cannot be followed from any start.
    """
    solutions: list[Solution] = []
    reason = ""
    starts = candidates(predictor.layout, predictor.data, predictor)[:MOST_STARTS]
    for _, theta, trial_effects in starts:
        try:
            most = MOST_ITERATIONS if thorough else ITERATIONS_ONCE_MORE
            solutions.append(solve_from(predictor, theta, trial_effects, held, most_iterations=most, watch=watch))
        except SimulationError as error:
            reason = str(error)
            continue
        if solutions[-1].converged or not thorough:
            break
    if not solutions:
        raise FitError(f"The model cannot be followed from any start: {reason or 'no trajectory could be simulated'}")
    best = min(solutions, key=_deviance)
    if not is_poor_fit(predictor, best):
        return _with_noise_anew(predictor, best, held, watch)
    guided = [
        _guided(predictor, theta, trial_effects, held, watch)
        for _, theta, trial_effects in (starts if thorough else starts[:1])
    ]
    return _sane(predictor, best, [solution for solution in guided if solution is not None])


def _with_noise_anew(predictor: Predictor, best: Solution, held: FixedTerms, watch: Watch | None) -> Solution:
    """The better of a solution whose noise wanders slowly and of the one led from it by the noise of the tracks.

    While numbers are still off by a little, all trials miss by a smooth part of a per cent, which passes for slow noise
    and lets none of the numbers move on. The likelihood tells: it is far higher where nothing is missed.
    """
    if best.state.rho < SLOW_NOISE:
        return best
    other = _strictly(predictor, best.state.theta, best.state.trial_effects, held, watch)
    return best if other is None else min((best, other), key=_deviance)


def _sane(predictor: Predictor, free: Solution, guided: list[Solution]) -> Solution:
    """The best of solutions of which the first may have taken for slow noise what the others had to fit.

    Noise of correlation 1 wanders as it likes, and makes anything likely. So where a solution is lost, likelihood only
    chooses among those whose noise is as correlated as that of the tracks.
    """
    sound = [solution for solution in guided if not is_poor_fit(predictor, solution)]
    return min(sound or guided or [free], key=_deviance)


def _guided(
    predictor: Predictor,
    theta: Floats,
    trial_effects: Floats,
    held: FixedTerms,
    watch: Watch | None,
    *,
    freed: bool = True,
    goal: float = -math.inf,
) -> Solution | None:
    """A solution led by what is missed: the noise is as correlated as in the tracks until the numbers have settled.

    All trials share their B and pressure as good as exactly: what is missed by much more than noise would else bend
    each trial's own until n means nothing. So it stays where the model turns out to be far off all the same. `goal` is
    the ln L that it must be able to reach.
    """
    if held.noise is not None:
        return None
    guide = FixedTerms(spread=held.spread or GUIDING_SPREADS, correlation=track_correlation(predictor.data))
    state, problem = first_state(predictor.data, theta, trial_effects), make_problem(predictor, trial_effects)
    try:
        first = solve(
            predictor,
            problem,
            state,
            guide,
            warm=True,
            most_iterations=GUIDED_ITERATIONS,
            watch=watch,
            search=not freed,
            behind=_behind(goal) if math.isfinite(goal) else None,
        )
        if not freed:
            return first
        trial_effects, _ = align(predictor.data, predictor, first.state.theta, initial_trial_effects(predictor.data))
        free = solve_from(
            predictor, first.state.theta, trial_effects, held, most_iterations=ITERATIONS_ONCE_MORE, watch=watch
        )
        return first if is_poor_fit(predictor, free) else free
    except SimulationError:
        return None


def _behind(goal: float) -> Shortfall:
    """How far the −2 ln L of a solution, its shared numbers at their best, lies above that of `goal`."""

    def lacking(cross_products: Floats, problem: MixedProblem, state: FitState, _: float) -> float:
        reached = deviance(marginal(cross_products, problem, state), problem, state, state.spread, restricted=False)
        return reached + 2 * goal

    return lacking


def _above_hopeless(_: Floats, problem: MixedProblem, __: FitState, now: float) -> float:
    """By how much −2 ln L has to fall until χ² per point is no longer HOPELESS; its noise is what is missed."""
    points = float(np.sum(problem.points))
    return points * math.log(max(now, 1e-300) / (HOPELESS * points))


def _strictly(
    predictor: Predictor,
    theta: Floats,
    trial_effects: Floats,
    held: FixedTerms,
    watch: Watch | None,
    *,
    search: bool = False,
) -> Solution | None:
    """A solution led by the noise of the tracks, which nothing missed can enlarge, from numbers that are nearly right.

    Trials whose own pressure or B is far from what was set would else be taken for noise altogether. A `search` gives
    up what its steps can no longer bring near.
    """
    if held.noise is not None:
        return None
    state, problem = first_state(predictor.data, theta, trial_effects), make_problem(predictor, trial_effects)
    noise = FixedTerms(spread=held.spread or STRICT_SPREADS, noise=(state.rho, state.variance))
    try:
        first = solve(
            predictor,
            problem,
            state,
            noise,
            warm=True,
            most_iterations=STRICT_ITERATIONS,
            watch=watch,
            search=search,
            behind=_above_hopeless if search else None,
        )
        if chi2_per_dof(predictor, first) > HOPELESS:
            return None
        if not first.converged:
            first = solve(
                predictor, problem, first.state, noise, warm=True, most_iterations=ITERATIONS_ONCE_MORE, watch=watch
            )
        if chi2_per_dof(predictor, first) > POOR_FIT:
            return None
        return solve(
            predictor, problem, first.state, held, warm=True, most_iterations=ITERATIONS_ONCE_MORE, watch=watch
        )
    except SimulationError:
        return None


def solve_from(
    predictor: Predictor,
    theta: Floats,
    trial_effects: Floats,
    held: FixedTerms,
    *,
    most_iterations: int = MOST_ITERATIONS,
    watch: Watch | None = None,
    search: bool = False,
) -> Solution:
    """Solve with the noise and the spreads that are assumed before anything is fitted.

    Parameters
    ----------
    predictor : of the trials to fit.
    theta : array, shape (n_free,)
        Numbers to begin from, scaled.
    trial_effects : array, shape (n_trials, 4)
        Trial effects to begin from.
    held : spreads and noise that are not estimated.
    most_iterations : int
        Steps at most.
    watch : callable, optional
        Called with each step.
    search : bool
        Whether the fit is one of many, see `solve`.

    Returns
    -------
    Solution
    """
    state = first_state(predictor.data, theta, trial_effects)
    problem = make_problem(predictor, trial_effects)
    return solve(predictor, problem, state, held, most_iterations=most_iterations, watch=watch, search=search)


def solve_onward(
    predictor: Predictor,
    before: Solution,
    theta: Floats,
    held: FixedTerms,
    *,
    most_iterations: int = MOST_ITERATIONS,
    watch: Watch | None = None,
    search: bool = False,
) -> Solution:
    """Solve from other numbers with the trial effects, spreads and noise of a solution.

    Parameters
    ----------
    predictor : of the same trials.
    before : the solution, of the same model or of another.
    theta : array, shape (n_free,)
        Numbers to begin from, scaled.
    held : spreads and noise that are not estimated.
    most_iterations : int
        Steps at most.
    watch : callable, optional
        Called with each step.
    search : bool
        Whether the fit is one of many, see `solve`.

    Returns
    -------
    Solution

    Raises
    ------
    SimulationError
        If the model cannot be followed.
    """
    problem = replace(
        make_problem(predictor, before.state.trial_effects), release_origin_mean=before.problem.release_origin_mean
    )
    state = start_at_held_noise(predictor, problem, replace(before.state, theta=theta), held, search=search)
    return solve(
        predictor, problem, state, held, warm=True, most_iterations=most_iterations, watch=watch, search=search
    )


def solve_again(
    predictor: Predictor,
    solution: Solution,
    held: FixedTerms,
    watch: Watch | None,
    *,
    thorough: bool,
    goal: float = -math.inf,
) -> Solution:
    """A solution, or, where it is lost, the one led from its numbers by what is missed.

    Parameters
    ----------
    predictor : of the trials to fit.
    solution : where the iterations ended.
    held : spreads and noise that are not estimated.
    watch : callable or None
        Called with each step.
    thorough : bool
        Whether a guided solution is freed again.
    goal : float
        ln L that a guided solution must be able to reach, or it ends early.

    Returns
    -------
    Solution
    """
    if not is_poor_fit(predictor, solution):
        return solution
    theta = solution.state.theta
    try:
        trial_effects, _ = align(predictor.data, predictor, theta, initial_trial_effects(predictor.data))
    except SimulationError:
        return solution
    strict = _strictly(predictor, theta, trial_effects, held, watch, search=not thorough)
    if strict is not None and not is_poor_fit(predictor, strict):
        return strict
    guided = _guided(predictor, theta, trial_effects, held, watch, freed=thorough, goal=goal)
    return solution if guided is None else _sane(predictor, solution, [guided])


def _deviance(solution: Solution) -> float:
    part = marginal(solution.cross_products, solution.problem, solution.state)
    return deviance(part, solution.problem, solution.state, solution.state.spread)


def start_at_held_noise(
    predictor: Predictor, problem: MixedProblem, state: FitState, held: FixedTerms, *, search: bool = False
) -> FitState:
    """The state, or, where its numbers miss by far more than its noise, the one that this noise leads to.

    With the noise to be found as well, all that a bad start misses would pass for noise, and hold the fit there.

    Parameters
    ----------
    predictor : of the trials to fit.
    problem : what does not change during the fit.
    state : where a warm start would begin.
    held : spreads and noise that are not estimated.
    search : bool
        Whether the fit is one of many, see `solve`.

    Returns
    -------
    FitState
    """
    if held.noise is not None or cost(predictor, problem, state) < BAD_START * float(np.sum(problem.points)):
        return state
    # What was taken for a late release may be what the new effect holds back: every trial begins where it fits best.
    aligned, _ = align(predictor.data, predictor, state.theta, state.trial_effects)
    ways = [state, replace(state, trial_effects=aligned)]
    best = np.argmin([trial_costs(predictor, problem, way) for way in ways], axis=0)
    state = replace(state, trial_effects=np.array([ways[way].trial_effects[i] for i, way in enumerate(best)]))
    noise = FixedTerms(held.spread or state.spread, (state.rho, state.variance))
    return solve(predictor, problem, state, noise, warm=True, most_iterations=GUIDED_ITERATIONS, search=search).state
