"""Fit a model to the measured trajectories of an experiment.

    fit = vinetrack.fit(model, experiment)
    print(fit)

The fit compares positions, not derivatives. By default it estimates B of each vine, n, the yield pressure within the
error that the sheet states, and every parameter of further effects. Each trial also has random effects: release,
origin, and deviations of pressure and of ln B, whose between-trial standard deviations are estimated. Without them,
differences between trials would look like missing physics. The statistical model is stated in
`vinetrack.inference.mixed_effects`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vinetrack.core.blas_threads import in_one_blas_thread
from vinetrack.core.records import Track
from vinetrack.dynamics.model import Model, Value
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.inference.assemble import assemble
from vinetrack.inference.fit_data import FitError, FitTrial, Pairs, pairs_of
from vinetrack.inference.fit_result import Fit, TrialFit
from vinetrack.inference.goodness_of_fit import POOR_FIT
from vinetrack.inference.left_out import predict_trials, prepared_pairs
from vinetrack.inference.optimiser import MOST_ITERATIONS, FixedTerms, Solution, Watch
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

STANDSTILL_M = 1e-9  # Travel below which a simulated trial counts as standing still (derived)


@in_one_blas_thread
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
    """Fit a model to all trials of an experiment."""
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
    fixed_terms = _fixed_terms(spreads, noise, data)
    solution = solve_from_scratch(predictor, fixed_terms, watch, thorough=thorough)
    _refuse_a_standstill(predictor, solution)
    predictor, solution = with_fitted_trace_errors(predictor, solution, fixed_terms, watch=watch)
    fitted = assemble(predictor, solution, left_out, {**options, "held": fixed_terms}, profile=profile)
    return replace(fitted, pairs=tuple(pairs))


def _refuse_a_standstill(predictor: Predictor, solution: Solution) -> None:
    """Refuse a model in which no trial is driven: it has no trajectories to compare with the tracks."""
    trajectories = predictor.run(predictor.jobs(solution.state.theta, solution.state.trial_effects))
    if any(float(np.ptp(trajectory.observed_position_m)) > STANDSTILL_M for trajectory in trajectories):
        return
    model = " + ".join(predictor.layout.model.names)
    angles = sorted({round(math.degrees(trial_data.trial.growth_angle_rad)) for trial_data in predictor.data})
    pressures = sorted({round(trial_data.trial.pressure_Pa / 1e3, 1) for trial_data in predictor.data})
    angle, pressure = (_range_in_words(values) for values in (angles, pressures))
    raise FitError(
        f"The model {model} moves no trial: at a growth angle of {angle}° and {pressure} kPa nothing in it drives"
        " them. Check growth_angle_deg (0 is straight down), pressure_kPa and yield_pressure_kPa, or add the effect"
        " that drives them to `model:`."
    )


def _range_in_words(values: Sequence[float]) -> str:
    return f"{values[0]:g}" if values[0] == values[-1] else f"{values[0]:g} to {values[-1]:g}"


def _fixed_terms(
    spreads: tuple[float, float] | None, noise: tuple[float, float] | None, data: list[FitTrial]
) -> FixedTerms:
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
    """Fit another model, or other parameters of the same model, to the same data, starting from a previous fit.

    Parameters
    ----------
    before : the previous fit: its data, and its estimates as starting values.
    model : Model, optional
        The other model; parameters that it has in common with the fit start at the fitted values.
    fixed, free : iterable of str, optional
        As of `fit`, in place of the options of the previous fit.
    shared : mapping, optional
        `"all"`, `"vine"` or `"day"` by name of parameter, in addition to the options of the previous fit.
    between : sequence of BetweenTerm, optional
        Differences between trials to estimate, in place of those of the previous fit.
    start : mapping, optional
        Starting values of parameters, mainly of a new effect: a time constant that starts at zero stays there.
    yields_Pa : mapping, optional
        Starting values of yield pressures, Pa, by `Number.name`, in place of the fitted ones.
    hold_spreads, hold_noise : bool
        Keep the between-trial standard deviations, or the noise, of the previous fit instead of estimating them again.
    profile : bool
        Whether intervals near a bound are profile-likelihood intervals.
    most_iterations : int
        Maximum number of steps; a model that only has to be ruled out need not converge.
    thorough : bool
        Whether a poor fit, which has absorbed its misfit as slow noise, is repeated at fixed noise correlation and then
        iterated to convergence with free noise; otherwise only as far as a comparison with other models needs.
    afresh : bool
        Whether release, deviations and noise start from the tracks alone instead of the previous fit.
    led : bool
        Whether a poor fit is repeated at fixed noise at all; not needed where another model already explains the tracks
        and a poor fit is rejected anyway.
    goal : float
        A poor fit is abandoned as soon as it can no longer reach this ln L.
    watch : callable, optional
        Called with every `Step` of the iterations; an exception that it raises ends the fit.

    Returns
    -------
    Fit

    Raises
    ------
    FitError
        If a name is not that of a parameter, or the model cannot be simulated.

    Examples
    --------
    >>> import vinetrack as vt
    >>> fit = vt.fit(vt.base_model(), vt.example_tracks(), profile=False)
    >>> later = vt.refit(fit, fit.model + "reservoir_depletion")
    >>> later.log_likelihood > fit.log_likelihood
    True
    """
    model = model or before.model
    fitted_values = {key: value for key, value in before.model.values.items() if key in model.parameter_names}
    model = model.with_values({**fitted_values, **(start or {})})
    # Corrections of recorded pressures that belong to another model would bias this one towards it.
    data = before.predictor.data if model.names == before.model.names else list(map(as_recorded, before.predictor.data))
    names = {*model.parameter_names, "yield_pressure.P_y"}
    options_used = {
        key: tuple(name for name in before.options[key] if _names_parameter(name, names))
        if given is None
        else tuple(given)
        for key, given in (("fixed", fixed), ("free", free))
    }
    all_shared = {**before.options["shared"], **(shared or {})}
    shared_used = {name: how for name, how in all_shared.items() if _names_parameter(name, names)}
    between = before.predictor.layout.between if between is None else tuple(between)
    layout = make_layout(
        model, data, fixed=options_used["fixed"], free=options_used["free"], shared=shared_used, between=between
    )
    host = before.predictor.host
    predictor = Predictor(layout, data, host if host is not None and set(model.names) <= set(host.names) else None)
    theta = layout.start
    values = {number.name: number.value for number in before.numbers} | dict(yields_Pa or {})
    for k, number in enumerate(layout.free):
        if number.name in values and number.key not in (start or {}):
            theta[k] = number.to_scaled(float(np.clip(values[number.name], number.lower, number.upper)))
    previous_state = before.state
    fixed_terms = FixedTerms(
        previous_state.spread if hold_spreads else None,
        (previous_state.rho, previous_state.variance) if hold_noise else None,
    )
    try:
        if afresh or before.chi2_per_dof > POOR_FIT:
            trial_effects, _ = align(data, predictor, theta, initial_trial_effects(data))
            solution = solve_from(
                predictor,
                theta,
                trial_effects,
                fixed_terms,
                most_iterations=most_iterations,
                watch=watch,
                search=not thorough,
            )
        else:
            solution = solve_onward(
                predictor,
                before.solution,
                theta,
                fixed_terms,
                most_iterations=most_iterations,
                watch=watch,
                search=not thorough,
            )
    except SimulationError as error:
        raise FitError(f"The model cannot be simulated from these starting values: {error}") from error
    if led:
        solution = solve_again(predictor, solution, fixed_terms, watch, thorough=thorough, goal=goal)
    predictor, solution = with_fitted_trace_errors(
        predictor, solution, fixed_terms, most_iterations=most_iterations, watch=watch, search=not thorough
    )
    fitted = assemble(
        predictor,
        solution,
        before.left_out,
        {**options_used, "shared": shared_used, "held": fixed_terms},
        profile=profile,
    )
    return replace(fitted, pairs=before.pairs)


def _names_parameter(name: str, names: Iterable[str]) -> bool:
    return any(name in (full, full.split(".")[1]) for full in names)


def predict(fitted: Fit, pairs: Pairs) -> list[TrialFit]:
    """Predict trials that were not in the fit.

    Only release and origin are fitted to each trial; its deviations of pressure and B are zero. `band_m` is the half
    width of the 95 % prediction band, see `vinetrack.inference.prediction_band`; after a fit to a single trial it
    assumes typical between-trial standard deviations.

    Parameters
    ----------
    fitted : the fit to predict from.
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
