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

from vinetrack.core.records import Track
from vinetrack.dynamics.model import Model, Value
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.inference.assemble import assemble
from vinetrack.inference.fit_data import FitError, FitTrial, Pairs, pairs_of
from vinetrack.inference.fit_result import Fit, TrialFit
from vinetrack.inference.left_out import predict_trials, prepared_pairs
from vinetrack.inference.optimiser import MOST_ITERATIONS, POOR_FIT, FixedTerms, Solution, Watch
from vinetrack.inference.parameters import BetweenTerm, make_layout
from vinetrack.inference.prediction_band import with_bands
from vinetrack.inference.prepared_trials import prepare
from vinetrack.inference.sensitivity import Predictor
from vinetrack.inference.solving import solve_again, solve_from, solve_from_scratch, solve_onward
from vinetrack.inference.starts import align, initial_trial_effects
from vinetrack.inference.trace_errors import as_recorded, with_fitted_trace_errors

if TYPE_CHECKING:
    from vinetrack.experiment.folder import Experiment

__all__ = ["FitError", "fit", "predict", "refit"]

STANDSTILL_M = 1e-9
"""Derived: no camera sees a nanometre; a trajectory that spans less is one of a model that nothing drives."""


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
    model : sum of effects; its values are those of numbers that are held.
    experiment : an experiment or its folder, or pairs of trial and track.
    tracks : mapping, optional
        Tracks by name of trial, where the experiment brings recordings.
    fixed, free : iterable of str
        Parameters to hold at the model's values, or to fit although known beforehand (g). `n` will do for
        `eversion_damping.n` where no other effect has an n; the yield pressure is `P_y`.
    shared : mapping, optional
        `"all"`, `"vine"` or `"day"` by name of parameter, in place of what the effect says.
    start : mapping, optional
        Values of further parameters to begin from, SI; B and n are always looked for.
    spreads : (float, float), optional
        Relative between-trial standard deviations of pressure and of B, in place of their estimates.
    noise : (float, float), optional
        Standard deviation of a position, m, and its lag-one correlation, in place of their estimates; all points then
        count alike.
    profile : bool
        Whether intervals near a bound are found by profile, which costs a few refits each.
    host : Model, optional
        A larger model whose compiled form serves this one and every `refit` that follows: nothing is compiled anew.
    thorough : bool
        Whether a poor fit is begun from other starts too. One that will only be questioned for what it lacks need not.
    watch : callable, optional
        Called with each step of the iterations; what it raises ends the fit.

    Returns
    -------
    Fit

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
    data, unusable = prepare(pairs, weighted=noise is None)
    left_out = {**left_out, **unusable}
    if not data:
        reasons = "; ".join(f"{name}: {why}" for name, why in left_out.items())
        raise FitError(f"No trial can be fitted: {reasons or 'there is none'}.")
    fixed, free = tuple(fixed), tuple(free)
    options = {"fixed": fixed, "free": free, "shared": dict(shared or {})}
    layout = make_layout(model.with_values(start or {}), data, fixed=fixed, free=free, shared=shared)
    predictor = Predictor(layout, data, host)
    held = _held(spreads, noise, data)
    solution = solve_from_scratch(predictor, held, watch, thorough=thorough)
    _refuse_a_standstill(predictor, solution)
    predictor, solution = with_fitted_trace_errors(predictor, solution, held, watch=watch)
    fitted = assemble(predictor, solution, left_out, {**options, "held": held}, profile=profile)
    return replace(fitted, pairs=tuple(pairs))


def _refuse_a_standstill(predictor: Predictor, solution: Solution) -> None:
    """A model in which nothing drives any trial has no trajectories, and so nothing to compare or to add to.

    Raises
    ------
    FitError
        If no trial moves.
    """
    moved = predictor.run(predictor.jobs(solution.state.theta, solution.state.trial_effects))
    if any(float(np.ptp(trajectory.observed_position_m)) > STANDSTILL_M for trajectory in moved):
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


def refit(
    before: Fit,
    model: Model | None = None,
    *,
    fixed: Iterable[str] | None = None,
    free: Iterable[str] | None = None,
    shared: Mapping[str, str] | None = None,
    between: Sequence[BetweenTerm] | None = None,
    start: Mapping[str, Value] | None = None,
    yields_Pa: Mapping[str, float] | None = None,
    hold_spreads: bool = False,
    hold_noise: bool = False,
    profile: bool = False,
    most_iterations: int = MOST_ITERATIONS,
    thorough: bool = True,
    afresh: bool = False,
    led: bool = True,
    goal: float = -math.inf,
    watch: Watch | None = None,
) -> Fit:
    """Fit another model, or other numbers of the same, to the same data, from where a fit ended.

    Parameters
    ----------
    before : the fit whose data, numbers and trial effects are taken over.
    model : Model, optional
        The other model; its values are those of the fit where it has the same parameters.
    fixed, free : iterable of str, optional
        In place of what the fit was told.
    shared : mapping, optional
        `"all"`, `"vine"` or `"day"` by name of parameter, beside what the fit was told.
    between : sequence of BetweenTerm, optional
        Differences between trials to fit along, in place of those of the fit.
    start : mapping, optional
        Values of parameters to begin from, of a new effect above all: a time constant begun at zero stays there.
    yields_Pa : mapping, optional
        Yield pressures to begin from, Pa, by the name of their number, in place of those that the fit found.
    hold_spreads, hold_noise : bool
        Keep spreads and noise of the fit instead of estimating them again.
    profile : bool
        Whether intervals near a bound are found by profile.
    most_iterations : int
        How long to go on: what is only to be ruled out need not settle.
    thorough : bool
        Whether a fit far off that takes what it misses for slow noise is led on by what it misses until nothing moves;
        else it is only led so far that it can be held against others.
    afresh : bool
        Whether releases, deviations and noise begin as the tracks show them, and not as the fit left them.
    led : bool
        Whether a fit that ends far off is begun again, led by what it misses; where another model explains the tracks
        already, what stays far off is out of the running.
    goal : float
        ln L that a fit far off must be able to reach to be led on to the end.
    watch : callable, optional
        Called with each step of the iterations; what it raises ends the fit.

    Returns
    -------
    Fit

    Raises
    ------
    FitError
        If a name is that of no parameter, or the model cannot be followed.

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
    # What another model found of the errors of recorded pressures would hold this one to it.
    data = before.predictor.data if model.names == before.model.names else list(map(as_recorded, before.predictor.data))
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
    values = {number.name: number.value for number in before.numbers} | dict(yields_Pa or {})
    for k, number in enumerate(layout.free):
        if number.name in values and number.key not in (start or {}):
            theta[k] = number.to_scaled(float(np.clip(values[number.name], number.lower, number.upper)))
    beside = before.state
    held = FixedTerms(beside.spread if hold_spreads else None, (beside.rho, beside.variance) if hold_noise else None)
    try:
        if afresh or before.chi2_per_dof > POOR_FIT:
            trial_effects, _ = align(data, predictor, theta, initial_trial_effects(data))
            solution = solve_from(
                predictor,
                theta,
                trial_effects,
                held,
                most_iterations=most_iterations,
                watch=watch,
                search=not thorough,
            )
        else:
            solution = solve_onward(
                predictor,
                before.solution,
                theta,
                held,
                most_iterations=most_iterations,
                watch=watch,
                search=not thorough,
            )
    except SimulationError as error:
        raise FitError(f"The model cannot be followed from this start: {error}") from error
    if led:
        solution = solve_again(predictor, solution, held, watch, thorough=thorough, goal=goal)
    predictor, solution = with_fitted_trace_errors(
        predictor, solution, held, most_iterations=most_iterations, watch=watch, search=not thorough
    )
    fitted = assemble(predictor, solution, before.left_out, {**kept, "shared": sharing, "held": held}, profile=profile)
    return replace(fitted, pairs=before.pairs)


def _belongs(name: str, names: Iterable[str]) -> bool:
    return any(name in (full, full.split(".")[1]) for full in names)


def predict(fitted: Fit, pairs: Pairs) -> list[TrialFit]:
    """What a fitted model says of trials that were not in the fit.

    Each gets its own release and origin, nothing else: its deviations of pressure and B are zero. `band_m` is by how
    much it may lie beside that, see `vinetrack.inference.prediction_band`; of a fit to one trial it knows of no scatter
    between trials but the usual.

    Parameters
    ----------
    fitted : a fit.
    pairs : iterable of (Trial, Track)
        Trials to predict.

    Returns
    -------
    list of TrialFit

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
    pairs = list(pairs)
    return with_bands(fitted, prepared_pairs(pairs), predict_trials(fitted, pairs))
