"""Fit a model to the measured trajectories of an experiment.

    fit = vinetrack.fit(model, experiment)
    print(fit)

Positions are compared, not derivatives. Free are B of each vine, n, the yield pressure within the error the sheet gives
it, and every parameter of further effects. Each trial has a release, an origin, and deviations of pressure and of B of
its own, whose spreads are estimated: left out, they would be taken for missing physics.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vinetrack.core.records import Floats, Track
from vinetrack.dynamics.model import Model, Value
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.inference.assemble import assemble
from vinetrack.inference.fit_data import FitError, FitTrial, Pairs, pairs_of, prepare
from vinetrack.inference.fit_result import Fit, TrialFit
from vinetrack.inference.left_out import predict_trials
from vinetrack.inference.mixed_effects import FitState, MixedProblem, deviance, marginal
from vinetrack.inference.optimiser import (
    MOST_ITERATIONS,
    FixedTerms,
    Solution,
    Watch,
    chi2_per_dof,
    cost,
    first_state,
    make_problem,
    solve,
    track_correlation,
)
from vinetrack.inference.parameters import BetweenTerm, make_layout
from vinetrack.inference.sensitivity import Predictor
from vinetrack.inference.starts import align, candidates, initial_trial_effects
from vinetrack.inference.trial_effects import trial_costs

if TYPE_CHECKING:
    from vinetrack.experiment.folder import Experiment

__all__ = ["FitError", "fit", "predict", "refit"]

LOST = 3e-3
"""Part of its growth by which the median trial is missed where a model is far off. Chosen: several times what a
tracker errs by slowly along the way; it decides whether further starts are tried, so half costs time and twice may
keep a local minimum."""

POOR_FIT = 3.0
"""χ² per degree of freedom above which a fit may be a local minimum, and other starts are tried. Chosen: half would
try further starts for most fits (time), twice would keep local minima."""

STANDSTILL_M = 1e-9
"""Derived: no camera sees a nanometre; a trajectory that spans less is one of a model that nothing drives."""

MOST_STARTS = 3
"""Starts and iterations at most. Chosen for time: fits that need more are taken up again by the search for a better
minimum."""

ITERATIONS_ONCE_MORE, GUIDED_ITERATIONS = 25, 40
BAD_START = 1.5
"""χ² per point from which a start misses by more than the noise of the fit it came from. Chosen: below it the
likelihood is nearly quadratic and one descent suffices; it decides time, not results."""

STRICT_ITERATIONS, HOPELESS = 8, 30.0
"""After so many steps led by the noise of the tracks alone, χ² per degree of freedom above which none will help.
Chosen for time; a fit given up here is begun from other starts."""

GUIDING_SPREADS, STRICT_SPREADS = (5e-4, 1e-3), (0.01, 0.03)
"""Between-trial standard deviations of pressure and ln B while a fit is guided, first nearly none, then those of a
usual batch of vines (about 1 % of pressure, a few per cent of B). Chosen: they only lead the descent and are estimated
afterwards."""


def fit(
    model: Model,
    experiment: Experiment | Path | str | Pairs,
    *,
    tracks: Mapping[str, Track] | None = None,
    fixed: Iterable[str] = (),
    free: Iterable[str] = (),
    shared: Mapping[str, str] | None = None,
    start: Mapping[str, Value] | None = None,
    spreads: tuple[float, float] | None = None,
    noise: tuple[float, float] | None = None,
    profile: bool = True,
    host: Model | None = None,
    thorough: bool = True,
    watch: Watch | None = None,
) -> Fit:
    """Fit a model to all trials of an experiment.

    Parameters
    ----------
    experiment
        An experiment or its folder, or pairs of trial and track.
    tracks
        Tracks by name of trial, where the experiment brings recordings.
    fixed, free
        Parameters to hold at the model's values, or to fit although known beforehand (g). `n` will do for
        `eversion_damping.n` where no other effect has an n; the yield pressure is `P_y`.
    shared
        `"all"` or `"vine"` by name of parameter, in place of what the effect says.
    start
        Values of further parameters to begin from; B and n are always looked for.
    spreads
        Relative spread of pressure and of B from trial to trial, in place of their estimates.
    noise
        Standard deviation of a position, m, and its lag-one correlation, in place of their estimates.
    profile
        Whether intervals near a bound are found by profile, which costs a few refits each.
    host
        A larger model whose compiled form serves this one and every `refit` that follows: nothing is compiled anew.
    thorough
        Whether a poor fit is begun from other starts too. One that will only be questioned for what it lacks need not.
    watch
        Told of every step of the iterations; what it raises ends the fit.

    Raises
    ------
    FitError
        If there is nothing to fit, or the fit does not begin; the message is one sentence.
    EffectError
        If a trial lacks what an effect of the model needs.
    ExperimentError
        If the experiment cannot be read.
    """
    pairs, left_out = pairs_of(experiment, tracks)
    data, unusable = prepare(pairs)
    left_out = {**left_out, **unusable}
    if not data:
        reasons = "; ".join(f"{name}: {why}" for name, why in left_out.items())
        raise FitError(f"No trial can be fitted: {reasons or 'there is none'}.")
    fixed, free = tuple(fixed), tuple(free)
    options = {"fixed": fixed, "free": free, "shared": dict(shared or {})}
    layout = make_layout(model.with_values(start or {}), data, fixed=fixed, free=free, shared=shared)
    predictor = Predictor(layout, data, host)
    held = _held(spreads, noise, data)
    solution = _solve_from_scratch(predictor, held, watch, thorough=thorough)
    _refuse_a_standstill(predictor, solution)
    found = assemble(predictor, solution, left_out, {**options, "held": held}, profile=profile)
    return replace(found, pairs=tuple(pairs))


def _refuse_a_standstill(predictor: Predictor, solution: Solution) -> None:
    """A model in which nothing drives any trial has no trajectories, and so nothing to compare or to add to.

    Raises
    ------
    FitError
        If no trial moves.
    """
    moved = predictor.run(predictor.jobs(solution.state.theta, solution.state.trial_effects))
    if any(float(np.ptp(one.observed_position_m)) > STANDSTILL_M for one in moved):
        return
    model = " + ".join(predictor.layout.model.names)
    angles = sorted({round(math.degrees(trial_data.trial.growth_angle_rad)) for trial_data in predictor.data})
    pressures = sorted({round(trial_data.trial.pressure_Pa / 1e3, 1) for trial_data in predictor.data})
    angle, pressure = (_range_in_words(values) for values in (angles, pressures))
    raise FitError(
        f"The model {model} moves no trial: at a growth angle of {angle}° and {pressure} kPa nothing in it drives"
        " them. Check growth_angle_deg (0 is straight down), pressure_kPa and yield_pressure_kPa, or put the effect"
        " that drives them in `model:`."
    )


def _range_in_words(values: Sequence[float]) -> str:
    return f"{values[0]:g}" if values[0] == values[-1] else f"{values[0]:g} to {values[-1]:g}"


def _held(spreads: tuple[float, float] | None, noise: tuple[float, float] | None, data: list[FitTrial]) -> FixedTerms:
    if noise is None:
        return FixedTerms(spreads)
    sigma_m, rho = noise
    return FixedTerms(spreads, (rho, np.full(len(data), sigma_m**2 * (1 - rho**2))))


def _solve_from_scratch(predictor: Predictor, held: FixedTerms, watch: Watch | None, *, thorough: bool) -> Solution:
    """The best of the solutions from the likeliest starts; the first will do where it explains the data."""
    found: list[Solution] = []
    reason = ""
    starts = candidates(predictor.layout, predictor.data, predictor)[:MOST_STARTS]
    for _, theta, trial_effects in starts:
        try:
            most = MOST_ITERATIONS if thorough else ITERATIONS_ONCE_MORE
            found.append(_solve_from(predictor, theta, trial_effects, held, most_iterations=most, watch=watch))
        except SimulationError as error:
            reason = str(error)
            continue
        if found[-1].converged or not thorough:
            break
    if not found:
        raise FitError(f"The model cannot be followed from any start: {reason or 'no trajectory could be simulated'}")
    best = min(found, key=_deviance)
    if not is_poor_fit(predictor, best):
        return best
    guided = [
        _guided(predictor, theta, trial_effects, held, watch)
        for _, theta, trial_effects in (starts if thorough else starts[:1])
    ]
    return _sane(predictor, best, [one for one in guided if one is not None])


def is_poor_fit(predictor: Predictor, solution: Solution) -> bool:
    """Whether a solution is far from the tracks: beyond their noise, and by a visible part of the growth.

    A tracker whose frames agree to a hundredth of a millimetre may err by a few tenths along the way: far beyond their
    noise, and no reason to begin elsewhere.
    """
    return bool(chi2_per_dof(predictor, solution) > POOR_FIT and missed_fraction(predictor, solution) > LOST)


def missed_fraction(predictor: Predictor, solution: Solution) -> float:
    """Root mean square of what is missed, as part of the growth that was seen; of the median trial."""
    parts = [
        math.sqrt(float(np.mean(columns[:, -1] ** 2))) / max(float(np.ptp(trial_data.lead_position_m)), 1e-9)
        for columns, trial_data in zip(solution.columns, predictor.data, strict=True)
    ]
    return float(np.median(parts))


def _sane(predictor: Predictor, free: Solution, guided: list[Solution]) -> Solution:
    """The best of solutions of which the first may have taken for slow noise what the others had to fit.

    Noise of correlation 1 wanders as it likes, and makes anything likely. So where a solution is lost, likelihood only
    chooses among those whose noise is as correlated as that of the tracks.
    """
    found = [one for one in guided if not is_poor_fit(predictor, one)]
    return min(found or guided or [free], key=_deviance)


def _guided(
    predictor: Predictor,
    theta: Floats,
    trial_effects: Floats,
    held: FixedTerms,
    watch: Watch | None,
    *,
    freed: bool = True,
) -> Solution | None:
    """A solution led by what is missed: the noise is as correlated as in the tracks until the numbers have settled.

    All trials share their B and pressure as good as exactly: what is missed by much more than noise would else bend
    each trial's own until n means nothing. So it stays where the model turns out to be far off all the same.
    """
    if held.noise is not None:
        return None
    guide = FixedTerms(spread=held.spread or GUIDING_SPREADS, correlation=track_correlation(predictor.data))
    state, problem = first_state(predictor.data, theta, trial_effects), make_problem(predictor, trial_effects)
    try:
        first = solve(predictor, problem, state, guide, warm=True, most_iterations=GUIDED_ITERATIONS, watch=watch)
        if not freed:
            return first
        trial_effects, _ = align(predictor.data, predictor, first.state.theta, initial_trial_effects(predictor.data))
        free = _solve_from(
            predictor, first.state.theta, trial_effects, held, most_iterations=ITERATIONS_ONCE_MORE, watch=watch
        )
        return first if is_poor_fit(predictor, free) else free
    except SimulationError:
        return None


def _strictly(
    predictor: Predictor, theta: Floats, trial_effects: Floats, held: FixedTerms, watch: Watch | None
) -> Solution | None:
    """A solution led by the noise of the tracks, which nothing missed can enlarge, from numbers that are nearly right.

    Trials whose own pressure or B is far from what was set would else be taken for noise altogether.
    """
    if held.noise is not None:
        return None
    state, problem = first_state(predictor.data, theta, trial_effects), make_problem(predictor, trial_effects)
    noise = FixedTerms(spread=held.spread or STRICT_SPREADS, noise=(state.rho, state.variance))
    try:
        first = solve(predictor, problem, state, noise, warm=True, most_iterations=STRICT_ITERATIONS, watch=watch)
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


def _solve_from(
    predictor: Predictor,
    theta: Floats,
    trial_effects: Floats,
    held: FixedTerms,
    *,
    most_iterations: int = MOST_ITERATIONS,
    watch: Watch | None = None,
) -> Solution:
    """Solve with the noise and the spreads that are assumed before anything is fitted."""
    state = first_state(predictor.data, theta, trial_effects)
    return solve(
        predictor, make_problem(predictor, trial_effects), state, held, most_iterations=most_iterations, watch=watch
    )


def _found_again(
    predictor: Predictor, solution: Solution, held: FixedTerms, watch: Watch | None, *, thorough: bool
) -> Solution:
    """A solution, or, where it is lost, the one led from its numbers by what is missed."""
    if not is_poor_fit(predictor, solution):
        return solution
    theta = solution.state.theta
    try:
        trial_effects, _ = align(predictor.data, predictor, theta, initial_trial_effects(predictor.data))
    except SimulationError:
        return solution
    strict = _strictly(predictor, theta, trial_effects, held, watch)
    if strict is not None and not is_poor_fit(predictor, strict):
        return strict
    guided = _guided(predictor, theta, trial_effects, held, watch, freed=thorough)
    return solution if guided is None else _sane(predictor, solution, [guided])


def _deviance(solution: Solution) -> float:
    part = marginal(solution.grams, solution.problem, solution.state)
    return deviance(part, solution.problem, solution.state, solution.state.spread)


def refit(
    before: Fit,
    model: Model | None = None,
    *,
    fixed: Iterable[str] | None = None,
    free: Iterable[str] | None = None,
    shared: Mapping[str, str] | None = None,
    between: Sequence[BetweenTerm] | None = None,
    start: Mapping[str, Value] | None = None,
    hold_spreads: bool = False,
    hold_noise: bool = False,
    profile: bool = False,
    most_iterations: int = MOST_ITERATIONS,
    thorough: bool = True,
    afresh: bool = False,
    watch: Watch | None = None,
) -> Fit:
    """Fit another model, or other numbers of the same, to the same data, from where a fit ended.

    Parameters
    ----------
    model
        The other model; its values are those of the fit where it has the same parameters.
    shared
        `"all"` or `"vine"` by name of parameter, beside what the fit was told.
    between
        Differences between trials to fit along, in place of those of the fit.
    start
        Values of parameters to begin from, of a new effect above all: a time constant begun at zero stays there.
    hold_spreads, hold_noise
        Keep spreads and noise of the fit instead of estimating them again.
    most_iterations
        How long to go on: what is only to be ruled out need not settle.
    thorough
        Whether a fit far off that takes what it misses for slow noise is led on by what it misses until nothing moves;
        else it is only led so far that it can be held against others.
    afresh
        Whether releases, deviations and noise begin as the tracks show them, and not as the fit left them.
    watch
        Told of every step of the iterations; what it raises ends the fit.

    Examples
    --------
    >>> import vinetrack as vt
    >>> fit = vt.fit(vt.base_model(), vt.example_tracks(), profile=False)
    >>> later = vt.refit(fit, fit.model + "reservoir_depletion")
    >>> later.log_likelihood > fit.log_likelihood
    True
    """
    model = model or before.model
    known = {key: value for key, value in before.model.values.items() if key in model.parameter_names}
    model = model.with_values({**known, **(start or {})})
    data, old = before.predictor.data, before.solution.state
    names = {*model.parameter_names, "yield_pressure.P_y"}
    kept = {
        key: tuple(name for name in before.options[key] if _belongs(name, names)) if given is None else tuple(given)
        for key, given in (("fixed", fixed), ("free", free))
    }
    told = {**before.options["shared"], **(shared or {})}
    sharing = {name: how for name, how in told.items() if _belongs(name, names)}
    between = before.predictor.layout.between if between is None else tuple(between)
    layout = make_layout(model, data, fixed=kept["fixed"], free=kept["free"], shared=sharing, between=between)
    host = before.predictor.host
    predictor = Predictor(layout, data, host if host is not None and set(model.names) <= set(host.names) else None)
    theta = layout.start
    values = {number.name: number.value for number in before.numbers}
    for k, number in enumerate(layout.free):
        if number.name in values and number.key not in (start or {}):
            theta[k] = number.inside(float(np.clip(values[number.name], number.lower, number.upper)))
    held = FixedTerms(old.spread if hold_spreads else None, (old.rho, old.variance) if hold_noise else None)
    try:
        if afresh or before.chi2_per_dof > POOR_FIT:
            trial_effects, _ = align(data, predictor, theta, initial_trial_effects(data))
            solution = _solve_from(predictor, theta, trial_effects, held, most_iterations=most_iterations, watch=watch)
        else:
            problem = replace(make_problem(predictor, old.trial_effects), own_centre=before.solution.problem.own_centre)
            state = _led_back(predictor, problem, replace(old, theta=theta), held)
            solution = solve(predictor, problem, state, held, warm=True, most_iterations=most_iterations, watch=watch)
    except SimulationError as error:
        raise FitError(f"The model cannot be followed from this start: {error}") from error
    solution = _found_again(predictor, solution, held, watch, thorough=thorough)
    found = assemble(predictor, solution, before.left_out, {**kept, "shared": sharing, "held": held}, profile=profile)
    return replace(found, pairs=before.pairs)


def _led_back(predictor: Predictor, problem: MixedProblem, state: FitState, held: FixedTerms) -> FitState:
    """The state, or, where its numbers miss by far more than its noise, the one that this noise leads to.

    With the noise to be found as well, all that a bad start misses would pass for noise, and hold the fit there.
    """
    if held.noise is not None or cost(predictor, problem, state) < BAD_START * float(np.sum(problem.points)):
        return state
    # What was taken for a late release may be what the new effect holds back: every trial begins where it fits best.
    aligned, _ = align(predictor.data, predictor, state.theta, state.trial_effects)
    ways = [state, replace(state, trial_effects=aligned)]
    best = np.argmin([trial_costs(predictor, problem, way) for way in ways], axis=0)
    state = replace(state, trial_effects=np.array([ways[way].trial_effects[i] for i, way in enumerate(best)]))
    noise = FixedTerms(held.spread or state.spread, (state.rho, state.variance))
    return solve(predictor, problem, state, noise, warm=True, most_iterations=GUIDED_ITERATIONS).state


def _belongs(name: str, names: Iterable[str]) -> bool:
    return any(name in (full, full.split(".")[1]) for full in names)


def predict(found: Fit, pairs: Pairs) -> list[TrialFit]:
    """What a fitted model says of trials that were not in the fit.

    Each gets its own release and origin, nothing else: its deviations of pressure and B are zero.

    Raises
    ------
    FitError
        If a trial cannot be used, or its vine was not in the fit and B is one per vine.

    Examples
    --------
    >>> import vinetrack as vt
    >>> pairs = vt.tracks_from_frame(vt.example_tracks())
    >>> fit = vt.fit(vt.base_model(), pairs[:6], profile=False)
    >>> [trial.name for trial in vt.predict(fit, pairs[6:])]
    ['P48_1', 'P48_2']
    """
    return predict_trials(found, pairs)
