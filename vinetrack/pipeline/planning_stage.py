"""The commands about vines not yet built and trials not yet made: `vinetrack predict`, `design` and `power`."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import vinetrack.results as layout
from vinetrack.core.problems import ExperimentError, InputError, Problem, Remark, format_problems, remark
from vinetrack.core.process import in_one_blas_thread, progress, table, waiting
from vinetrack.core.records import Trial
from vinetrack.core.tables import PROVENANCE, write_csv
from vinetrack.core.units import PREDICTION_UNITS, display_unit, number, pressure_text
from vinetrack.diagnosis import linear_power
from vinetrack.diagnosis.further_trials import further_trials
from vinetrack.diagnosis.ladder import candidates_of
from vinetrack.diagnosis.misfit_tests import MisfitTests
from vinetrack.diagnosis.result import ADEQUATE, Power, PowerInput, SimulatedRates
from vinetrack.dynamics.model import Model, host_for, make_model
from vinetrack.effects import BASE_EFFECTS, catalogue
from vinetrack.experiment import folder as experiments
from vinetrack.experiment.folder import YIELD_SIGMA_KPA, systematic_of_travel
from vinetrack.experiment.schema import COLUMNS, option, read_range
from vinetrack.experiment.settings import Limits, read_experiment_settings
from vinetrack.figures.model_figures import draw_choice, draw_predictions, draw_reservoir
from vinetrack.figures.style import write_figure
from vinetrack.inference.fit import fit
from vinetrack.inference.fit_data import Pairs, pairs_of
from vinetrack.inference.fit_result import DAMPING, EXPONENT, Fit, FitSummary
from vinetrack.narrative.diagnosis_text import trial_text, value_in_unit, volume_text
from vinetrack.pipeline.workflow import map_unordered
from vinetrack.planning import prediction as vines
from vinetrack.planning.predictive_inputs import (
    YIELD,
    Band,
    FitNumbers,
    StatedValues,
    hoop_stress_Pa,
    predictive_inputs,
    read_sizes,
)

# ------------------------------------------------------------------------------
# Inputs of the commands: options or a sheet, a fit, effects.


def choose_fit(folder: Path, anyway: bool = False) -> tuple[FitSummary, tuple[str, ...]]:
    """Choose the fit of a results folder to predict from: of the model that the diagnosis ended with as `adequate`,
    after any other verdict only `anyway`. Returns it, and the heading over all that is predicted from it.
    """
    results = layout.Results(folder)
    in_use, diagnosis = layout.read_fit(results), layout.read_diagnosis(results)
    if diagnosis is None or not diagnosis.verdict:
        return in_use, (f"! {remark('fit_not_diagnosed', folder=folder)}",)
    if diagnosis.verdict == ADEQUATE:
        return in_use, ()
    final = FitSummary.from_json(layout.read_json(results.final_fit)) if results.final_fit.exists() else None
    added = " + ".join(diagnosis.effects)
    if diagnosis.final_verdict == ADEQUATE and final is not None:
        return final, (str(remark("from_final_model", added=added)),)
    verdict = f"{diagnosis.final_verdict or diagnosis.verdict}: {diagnosis.explanation}"
    if not anyway:
        reason = "because the diagnosis refuted the model, and no fit of one that describes the trials is there"
        raise layout.ResultsError(f"{folder}: no prediction, {reason}; or predict from it with --anyway. {verdict}")
    caution = remark("from_refuted_model", model=f"the model with {added} added" if final else "the model in use")
    return final or in_use, (f"! {verdict}", f"! {caution}")


def read_basis(
    needed: Sequence[str] = experiments.REQUIRED_FOR_PREDICTION, *, cells: Mapping[str, str], sheet: Path | None = None,
    results: Path | None = None, anyway: bool = False, effects: Sequence[str] = (), **numbers: Any,
) -> tuple[experiments.Experiment, StatedValues, FitNumbers | None, tuple[str, ...]]:  # fmt: skip
    """Read the sheet or the options, the fit, and the effects: planned trials, stated values, a fit if any, and the
    heading over all predicted from them. `cells` are texts by column of the sheet, for the columns that were given;
    `anyway` allows a fit whose model was refuted; `numbers` are those of `StatedValues`.
    """
    fit: FitNumbers | None = None
    heading: tuple[str, ...] = ()
    if results is not None:
        summary, heading = choose_fit(results, anyway)
        fit = FitNumbers(summary, results.as_posix())
    if sheet is not None and (sheet / PROVENANCE).exists():
        raise layout.ResultsError(
            f"{sheet} holds results: predict from their fit with --fit {sheet}, and the vine by options"
        )
    if sheet is None:
        planned = experiments.planned_trial(cells, needed=needed)
    else:
        planned = experiments.planned_sheet(sheet)
        said: dict[str, Any] = {"message": "is given in addition to a sheet", "remedy": "write it in the sheet"}
        if cells:
            raise ExperimentError([Problem(column=option(name), value=text, **said) for name, text in cells.items()])
    user_effects = planned.user_effects
    if fit is not None and not set(fit.fit.names) <= set(catalogue()):
        folder = Path(str(layout.read_json(layout.Results(Path(fit.source)).provenance).get("experiment", "")))
        settings = read_experiment_settings(folder / "experiment.yaml")
        user_effects = replace(planned, folder=folder, settings=settings).user_effects
    read = [read_sizes(text, user_effects) for text in effects]
    names, sizes = tuple(name for name, _ in read), {key: size for _, of_one in read for key, size in of_one.items()}
    model = planned.settings.model
    stated = StatedValues(**numbers, model=model, effects=names, sizes=sizes, user_effects=user_effects)
    return planned, stated, fit, heading


def refusal(name: str, text: str, message: str, remedy: str, allowed: str = "") -> ExperimentError:
    """The error that refuses the value of an option."""
    return ExperimentError([Problem(message=message, column=name, value=text, allowed=allowed, remedy=remedy)])


# ------------------------------------------------------------------------------
# The command `vinetrack predict`.


def predict_conditions(
    *, samples: int, seed: int, at_fraction: float, figure: Path | None = None, csv: Path | None = None, **given: Any
) -> tuple[list[str], list[dict[str, Any]]]:
    """Predict all conditions, see `read_basis`; write figure and curves if requested. Returns lines, JSON content."""
    planned, stated, fit, heading = read_basis(**given)
    all_inputs = progress([predictive_inputs(trial, stated, fit) for trial in planned.trials], "predicting")
    predictions = [vines.predict_vine(one, samples=samples, seed=seed, at_fraction=at_fraction) for one in all_inputs]
    content = [
        {
            "condition": one.inputs.trial.condition,
            "model": list(one.inputs.model.names),
            "samples": one.samples,
            "inputs": [_band(of_input) | {"from": str(of_input.why)} for of_input in one.inputs.bands()],
            "quantities": [_band(quantity) | {"y_over_L": quantity.y_over_L} for quantity in one.quantities],
            "uncertainties": [
                {"name": s.name, "words": str(s.why), "alone_low_90_m_s": s.low, "alone_high_90_m_s": s.high}
                for s in one.shares
            ],
            "left_out": [asdict(omitted) for omitted in one.neglected],
            "arrives": one.arrives,
            "slack": one.slack,
            "warnings": list(map(str, one.hazards)),
        }
        for one in predictions
    ]
    shown = _table_lines(predictions) if len(predictions) > 1 else _condition_lines(predictions[0])
    lines = [*heading, *shown]
    lines += [f"! {warning}" for warning in format_problems(planned.problems)]
    titles = [trial_text(prediction.inputs.trial) for prediction in predictions]
    lines += write_figure(figure, partial(draw_predictions, predictions, titles, at_fraction))
    if csv is not None:
        write_csv(csv, pd.concat([prediction.curve for prediction in predictions], ignore_index=True))
        lines.append(f"Curves: {csv}")
    return lines, content


def _condition_lines(prediction: vines.VinePrediction) -> Iterator[str]:
    """Yield all lines about a single condition."""
    inputs = prediction.inputs
    yield f"{trial_text(inputs.trial)}; {' + '.join(inputs.model.names)}"
    yield ""
    bands, unit = inputs.bands(), inputs.trial.pressure_unit
    # Constants of nature are left out.
    rows = [(one.symbol, *_cells(one, unit), str(one.why)) for one in bands if one.why.code != "constant"]
    yield from table(rows, ("input", "median", "90 % band", "unit", "from"), align="<><<<")
    yield ""
    columns = ("prediction", "at y/L", "median", "90 % band", "unit")
    yield from table(map(_quantity_row, prediction.quantities), columns, align="<<><<")
    yield ""
    head = (f"uncertainties included ({prediction.samples} draws)", "final speed by it alone", "why")
    shares = [(one.name, f"{number(one.low)} to {number(one.high)} m/s", str(one.why)) for one in prediction.shares]
    yield from table(shares, head)
    # 0.005: smallest relative change of the final speed for which a neglected effect is listed (chosen)
    changes = [
        (one.effect, one.size, f"{number(one.without_m_s)} → {number(one.final_m_s)} m/s", f"{one.change:+.1%}")
        for one in prediction.neglected
        if abs(one.change) >= 0.005
    ]
    if changes:
        left_out = ("not in the model", "at its usual size", "final speed at the medians", "")
        yield from ("", *table(changes, left_out, align="<<<>"))
        if any(one.name == DAMPING and one.why.code == "fitted" for one in bands):
            yield f"! {remark('left_out_of_fit')}"
    yield ""
    yield from (f"! {warning}" for warning in prediction.hazards)


def _cells(one: Band, pressure_unit: str) -> tuple[str, str, str]:
    """Return median, band and unit."""
    low, median, high = (value_in_unit(value, one.unit, pressure_unit) for value in (one.low, one.median, one.high))
    has_band = one.low != one.high and not math.isnan(one.median)
    return median, f"{low} to {high}" if has_band else "–", display_unit(one.unit, pressure_unit, PREDICTION_UNITS)[0]


def _quantity_row(quantity: Band) -> tuple[str, str, str, str, str]:
    """Return name, place, median, band and unit; stresses are in MPa."""
    place = "" if math.isnan(quantity.y_over_L) else f"{quantity.y_over_L:g}"
    return quantity.name, place, *_cells(quantity, "MPa")


def _table_lines(predictions: Sequence[vines.VinePrediction]) -> Iterator[str]:
    """Yield a table with one row per condition."""
    yield str(remark("medians_and_bands", model=predictions[0].inputs.model.names, samples=predictions[0].samples))
    rows = []
    for prediction in predictions:
        speed, time = _quantity_row(prediction.final)[1:4], _quantity_row(prediction["time to get there"])[2:4]
        rows.append((prediction.inputs.trial.condition, *speed, *time, f"{prediction.slack:.0%}"))
    head = ("condition", "at y/L", "final speed", "90 % band", "time", "90 % band", "slack tail")
    yield from table(rows, head, ("", "", "m/s", "m/s", "ms", "ms", "of draws"), align="<<><><>")
    if any(prediction.inputs.trial.payload_kg > 0 for prediction in predictions):
        yield str(remark("final_speed"))
    yield ""
    yield "uncertainties included:"
    sources = dict.fromkeys((share.name, str(share.why)) for prediction in predictions for share in prediction.shares)
    yield from (f"  {name}: {text}" for name, text in sources)
    for one in predictions[0].inputs.bands():
        if one.why.code == "typical_size":
            size, _, unit = _cells(one, predictions[0].inputs.trial.pressure_unit)
            yield f"  {one.symbol}: {size} {unit}, {one.why}"
    yield ""
    conditions_of: dict[str, list[str]] = {}
    for prediction in predictions:
        for text in dict.fromkeys(map(str, prediction.hazards)):
            conditions_of.setdefault(text, []).append(prediction.inputs.trial.condition)
    for text, conditions in conditions_of.items():
        yield f"! {'all conditions' if len(conditions) == len(predictions) else ', '.join(conditions)}: {text}"


def _band(one: Band) -> dict[str, Any]:
    return {"name": one.name, "unit": one.unit, "median": one.median, "low_90": one.low, "high_90": one.high}


# ------------------------------------------------------------------------------
# Designs: the fastest vine within limits, and the chamber that it needs.


def read_si_range(column: str, text: str, name: str = "") -> tuple[float, float]:
    """Read `low:high` or one number, each checked like a cell of the column; return both in SI."""
    try:
        low, high = read_range(COLUMNS[column], text if ":" in text else (text, text))
    except InputError as error:
        raise refusal(name or option(column), text, error.message, error.remedy, error.allowed) from None
    return COLUMNS[column].scale.to_si(low), COLUMNS[column].scale.to_si(high)


def design_vine(
    *, films: str, diameter: str, length: str, burst_share: float, burst_stress_MPa: float, samples: int, seed: int,
    at_fraction: float, figure: Path | None = None, **given: Any,
) -> tuple[list[str], dict[str, Any]]:  # fmt: skip
    """Find the fastest vine of every film; draw the choice if requested. Returns lines, and JSON content."""
    planned, stated, fit, heading = read_basis(("pressure_kPa",), **given)
    films_m = [read_si_range("thickness_um", part, "--films-um")[0] for part in films.split(",")]
    room = vines.Room(
        films_m=tuple(dict.fromkeys(films_m)),
        diameter_m=read_si_range("diameter_mm", diameter),
        length_m=read_si_range("length_mm", length),
        pressure_Pa=planned.trials[0].pressure_Pa,
        rig=planned.trials[0],
        burst_share=burst_share,
        burst_stress_Pa=1e6 * burst_stress_MPa,
    )
    thickest_m = max(room.films_m)
    if thickest_m > room.diameter_m[0] / 4:
        message = f"begins below four times the thickest film, {1e6 * thickest_m:g} µm"
        raise refusal("--diameter-mm", diameter, message, f"begin at {4e3 * thickest_m:g} mm or more")
    with waiting("looking for the fastest vine"):
        choices = vines.fastest(room, stated, fit, samples=samples, seed=seed, at_fraction=at_fraction)
    lines = [*heading, *_vine_lines(room, choices), *write_figure(figure, partial(draw_choice, choices))]
    entries = []
    for choice in choices:
        trial, final = choice.prediction.inputs.trial, choice.prediction.final
        speed = {"y_over_L": final.y_over_L, "median": final.median, "low_90": final.low, "high_90": final.high}
        entry: dict[str, Any] = {name: COLUMNS[name].of_trial(trial) for name in experiments.REQUIRED_FOR_PREDICTION}
        entry |= {"final_speed_m_s": speed}
        entries.append({**entry, "fastest_in_share_of_draws": choice.odds, "limited_by": list(choice.limits)})
    return lines, {"warnings": heading, "films": entries}


def _vine_lines(room: vines.Room, choices: Sequence[vines.Choice]) -> Iterator[str]:
    best = choices[0].prediction
    limits = {"share": room.burst_share, "burst_MPa": room.burst_stress_Pa / 1e6, "kPa": room.pressure_Pa / 1e3}
    yield str(remark("fastest_by", quantity=best.final.name, y_over_L=best.final.y_over_L, **limits))
    yield ""
    rows = []
    for choice in choices:
        trial, final = choice.prediction.inputs.trial, choice.prediction.final
        sizes = f"{1e6 * trial.thickness_m:g}", f"{1e3 * trial.diameter_m:.3g}", f"{1e3 * trial.length_m:.3g}"
        stress_MPa = hoop_stress_Pa(trial.pressure_Pa, trial.diameter_m, trial.thickness_m) / 1e6
        low, median, high = (value_in_unit(value, "m/s") for value in (final.low, final.median, final.high))
        speed = median, f"{low} to {high}", f"{choice.odds:.0%}"
        rows.append((*sizes, f"{trial.pressure_Pa / 1e3:.3g}", f"{stress_MPa:.2f}", *speed, ", ".join(choice.limits)))
    head = ("film", "diameter", "length", "pressure", "PD/2t", "speed", "90 % band", "fastest", "limited by")
    yield from table(rows, head, ("µm", "mm", "mm", "kPa", "MPa", "m/s", "m/s", "of draws", ""), align=">>>>>><><")
    yield ""
    if choices[0].odds < 0.8 and len(choices) > 1:
        yield str(remark("film_uncertain", um=1e6 * best.inputs.trial.thickness_m, odds=choices[0].odds))
    yield from (f"! {warning}" for warning in best.hazards)


def design_reservoir(
    *, within_percent: float, supply_s: float, at_fraction: float, figure: Path | None = None, **given: Any
) -> tuple[list[str], dict[str, Any]]:
    """Find the chamber that limits the loss of gauge pressure; with a wall, speeds too. Returns lines, JSON."""
    planned, stated, fit, heading = read_basis(("diameter_mm", "length_mm", "pressure_kPa"), **given)
    trial, loss, swept = planned.trials[0], within_percent / 100, vines.swept_m3(planned.trials[0])
    inputs = predictive_inputs(trial, stated, fit) if math.isfinite(trial.thickness_m) else None
    laws = [law.split(",")[0] for law in vines.GAMMAS]
    speeds = [] if inputs is None else [f"speed, {law}" for law in laws]
    lines = [
        *heading,
        str(remark("sweeps", trial=trial, swept_m3=swept, in_full=inputs is not None)),
        str(remark("keeps_pressure", percent=within_percent)),
        "",
    ]
    rows, entries = [], []
    with waiting("simulating"):
        for name, volume_m3 in vines.chambers(trial, loss).items():
            lost, finals = _losses(trial, volume_m3), list[float]()
            if inputs is not None:
                finals = [vines.final_with(inputs, volume_m3, gamma, at_fraction) for gamma in vines.GAMMAS.values()]
            cells = [f"{100 * share:.1f}" for share in lost.values()]
            rows.append([name, volume_text(volume_m3), *cells, *(value_in_unit(final, "m/s") for final in finals)])
            entries.append({"chamber": name, "volume_l": 1e3 * volume_m3, "loss_of_gauge_pressure": lost})
        head = ("chamber", "volume", *(f"loses, {law}" for law in laws), *speeds)
        lines += table(rows, head, ("", "", "% of gauge", "% of gauge", *["m/s"] * len(speeds)), align="<>" + ">" * 4)
        if inputs is not None:
            host = host_for(inputs.model)
            (steady,) = vines.final_speeds(inputs.model, [inputs.trial], at_fraction, host=host).tolist()
            place = 1.0 if trial.payload_kg > 0 else at_fraction
            lines.append(str(remark("speeds_at_medians", y_over_L=place, m_s=steady)))
        lines.append(str(remark("slow_and_fast")))
        if math.isfinite(supply_s) and inputs is not None:
            laws_and_gammas = vines.GAMMAS.items()
            volumes = {law: vines.supplied_chamber(inputs, loss, supply_s, gamma) for law, gamma in laws_and_gammas}
            lines.append(str(remark("supplied_chambers", ms=1e3 * supply_s, volumes=volumes)))
        elif math.isfinite(supply_s):
            lines.append(f"! {remark('supply_needs_wall')}")
    drawn_m3 = swept * np.geomspace(3.0, 300.0, 200)
    drawn = partial(draw_reservoir, drawn_m3, _losses(trial, drawn_m3), loss, swept, trial.chamber_m3)
    lines += write_figure(figure, drawn)
    return lines, {"warnings": heading, "chambers": entries}


def _losses(trial: Trial, volume_m3: Any) -> dict[str, Any]:
    """Fraction of the gauge pressure that a chamber, or each of several, loses, by the gas law."""
    return {law: vines.gauge_loss(trial, volume_m3, gamma) for law, gamma in vines.GAMMAS.items()}


# ------------------------------------------------------------------------------
# The command `vinetrack power`: statistical power of the trials of a sheet, an experiment or a results folder.


@dataclass(frozen=True)
class PowerRequest:
    """Options of the command, NaN and None where not given; standard deviations between trials are relative. `effects`
    are names, or `name=size` in the parameter's unit; `simulate` campaigns are simulated with each.
    """

    target: Path
    effects: tuple[str, ...] = ()
    noise_mm: float = math.nan
    noise_correlation: float = math.nan
    spread_P: float = math.nan
    spread_B: float = math.nan
    capture_fps: float = math.nan
    systematic_mm: float = math.nan
    B: float = math.nan
    n: float = math.nan
    simulate: int = 0
    jobs: int = 1
    first_seed: int = 1
    reach: float = math.nan
    experiment: Path | None = None

    def scatter(
        self, noise: Sequence[float], of_noise: str, spreads: Sequence[float], of_spreads: str
    ) -> tuple[tuple[float, float], tuple[float, float], list[PowerInput]]:
        """Noise of a position, m, with its correlation, and standard deviations of pressure and B between trials: each
        as stated, else as given here; and both in words with where they come from.
        """
        stated = np.array([[self.noise_mm / 1e3, self.noise_correlation], [self.spread_P, self.spread_B]])
        (sigma_m, correlation), (of_P, of_B) = np.where(np.isnan(stated), [noise, spreads], stated).tolist()
        origins = np.where(np.isnan(stated).all(axis=1), [of_noise, of_spreads], "stated").tolist()
        inputs = [
            PowerInput("noise of a position", f"{1e3 * sigma_m:.3g} mm, correlation {correlation:.2f}", origins[0]),
            PowerInput("spread of pressure from trial to trial", f"{100 * of_P:.2g} %", origins[1]),
            PowerInput("spread of B from trial to trial", f"{100 * of_B:.2g} %", origins[1]),
        ]
        return (sigma_m, correlation), (of_P, of_B), inputs


# Tests, what cannot be tested and why, the quantities assumed, and constraints on further trials
Campaign = tuple[MisfitTests, Mapping[str, Remark], list[PowerInput], Limits]


def _campaign_of_target(request: PowerRequest) -> Campaign:
    """Return the campaign of the measured trials of a results folder or an experiment; without any, of the planned."""
    target, added = request.target, tuple[str, ...]()
    experiment: experiments.Experiment | None = None
    if (target / PROVENANCE).exists():
        results, experiment = layout.Results(target), layout.read_source_experiment(target, request.experiment)
        diagnosis, pairs = layout.read_diagnosis(results), layout.measured_trials(experiment, results)
        if diagnosis is not None and diagnosis.final_verdict == ADEQUATE:
            added, pairs = diagnosis.added, diagnosis.settled(pairs)
    else:
        with suppress(ExperimentError):  # recordings that do not exist yet: a plan
            experiment = experiments.read_experiment(target) if target.is_dir() else None
        if experiment is None or all(trial.track is None for trial in experiment.trials):
            return _planned_campaign(request, experiments.planned_sheet(target, every_row=True))
        pairs = pairs_of(experiment)[0]
    settings = experiment.settings
    names = dict.fromkeys((*settings.model, *added))
    model = make_model(names, experiment.user_effects)
    return _measured_campaign(request, model, pairs, settings.candidates, settings.limits)


def _measured_campaign(
    request: PowerRequest, model: Model, pairs: Pairs, candidates: Sequence[str] | None = None,
    limits: Limits | None = None,
) -> Campaign:  # fmt: skip
    """Return the campaign of measured trials, with noise and scatter from the options, else from a fit."""
    host = host_for(model, candidates_of(model, candidates, model.user_effects))
    fitted = fit(model, pairs, host=host)
    noise, spreads, inputs = request.scatter(
        (fitted.noise_m, fitted.noise_correlation), "fit", fitted.state.spread, "fit"
    )
    of_points = noise if inputs[0].origin == "stated" else None
    of_trials = spreads if inputs[1].origin == "stated" else None
    if of_points or of_trials:
        fitted = fit(model, pairs, spreads=of_trials, noise=of_points, host=host)
    else:
        inputs = []
    return *linear_power.fitted_tests(fitted, candidates), inputs, limits or Limits()


def _planned_campaign(request: PowerRequest, planned: experiments.Experiment) -> Campaign:
    """Return the campaign of planned trials; B, n and yield pressure are stated, published, or from scaling laws."""
    settings = planned.settings
    stated = StatedValues(B=request.B, n=request.n, model=settings.model, user_effects=planned.user_effects)
    of_vines = {trial.vine: trial for trial in reversed(planned.trials)}
    by_vine = {trial.vine: predictive_inputs(of_vines[trial.vine], stated) for trial in planned.trials}
    first = next(iter(by_vine.values()))
    # 1e-4: noise of a position, m (chosen)
    usual = "guess: a usual batch of vines"
    noise, spreads, inputs = request.scatter((1e-4, 0.0), "guess", first.spreads, usual)
    systematic_m, systematic_origin = request.systematic_mm / 1e3, "stated"
    if math.isnan(systematic_m) and settings.position_systematic_mm is not None:
        systematic_m, systematic_origin = settings.position_systematic_mm / 1e3, "experiment.yaml"
    elif math.isnan(systematic_m):
        longest_m = max((trial.length_m for trial in planned.trials if math.isfinite(trial.length_m)), default=0.0)
        systematic_m = systematic_of_travel(settings) * longest_m
        is_known = systematic_of_travel(settings) < Trial.systematic_of_travel
        systematic_origin = f"guess: {'lens by a target' if is_known else 'positions by a scale, lens uncorrected'}"
    trials, rates = [], []
    for trial in planned.trials:
        if not math.isfinite(trial.yield_pressure_Pa):
            assumed_Pa = by_vine[trial.vine].trial.yield_pressure_Pa
            trial = replace(trial, yield_pressure_Pa=assumed_Pa, yield_pressure_sigma_Pa=1e3 * YIELD_SIGMA_KPA)
        trials.append(replace(trial, position_systematic_m=systematic_m))
        known = (request.capture_fps, trial.capture_fps, 1069.0)  # the last: chosen
        rates.append(next(filter(math.isfinite, known)))
    is_in_sheet = all(math.isfinite(trial.capture_fps) for trial in trials)
    fps_origin = "stated" if math.isfinite(request.capture_fps) else "sheet" if is_in_sheet else "guess"
    inputs += [
        PowerInput("systematic error of positions", f"{1e3 * systematic_m:.3g} mm", systematic_origin),
        PowerInput("frame rate", f"{' to '.join(map(number, sorted({min(rates), max(rates)})))} /s", fps_origin),
        *(
            PowerInput(f"{symbol} of {vine}", f"{of_vine.medians[key]:.3g}", str(of_vine.origins[key]))
            for vine, of_vine in by_vine.items()
            for symbol, key in (("B", DAMPING), ("n", EXPONENT))
        ),
        *(
            PowerInput(f"P_y of {vine}", pressure_text(one.medians[YIELD], one.trial.pressure_unit), str(why))
            for vine, one in by_vine.items()
            if (why := one.origins[YIELD]).code != "given"
        ),
    ]
    model = first.model.with_values({DAMPING: {vine: of_vine.medians[DAMPING] for vine, of_vine in by_vine.items()}})
    tests = linear_power.planned_tests(model, trials, rates, spreads, noise, settings.candidates)
    return *tests, inputs, settings.limits


@in_one_blas_thread
def power_of_target(request: PowerRequest, given: Fit | Pairs | None = None) -> Power:
    """Power of the trials by linear theory, and by simulated campaigns if asked; of `given` trials or fit if any."""
    with waiting("calculating the power of the trials"):
        if given is None:
            campaign = _campaign_of_target(request)
        elif isinstance(given, Fit):
            campaign = (*linear_power.fitted_tests(given), [], Limits())
        else:
            campaign = _measured_campaign(request, make_model(BASE_EFFECTS), list(given))
        tests, not_testable, inputs, limits = campaign
        now = linear_power.power_of(tests, not_testable, inputs)
    power, asked = now, [_asked(text, now) for text in request.effects]
    if request.simulate:
        power = replace(power, simulated=tuple(_simulated_rates(request, tests, now, asked)))
    if math.isfinite(request.reach):
        for text, (name, value) in zip(request.effects, asked, strict=True):
            if name in power.not_testable:
                why = str(power.not_testable[name])
                raise refusal("effect", text, "cannot be tested with the columns of these trials", why)
            if not math.isfinite(value):
                raise refusal("effect", text, "needs a size", "write the size to detect, such as leak=0.5")
            with waiting(f"searching for trials that detect {name}"):
                plan = further_trials(tests, power[name], value, request.reach, limits)
            power = replace(power, further=(*power.further, plan))
    return power.of_effects([name for name, _ in asked])


def _asked(text: str, power: Power) -> tuple[str, float]:
    """Read `name` or `name=size`: the effect, and its size in SI, NaN where none is given."""
    name, _, size = text.partition("=")
    if name in power.not_testable:
        return name, math.nan
    known = {entry.effect: display_unit(entry.unit, entry.pressure_unit) for entry in power.effects}
    if name not in known:
        close = difflib.get_close_matches(name, [*known, *power.not_testable], 1)
        remedy = f"did you mean {close[0]}?" if close else "without a name, vinetrack power lists the candidates"
        message = "is in the model already" if name in power.model else "is not a candidate for these trials"
        raise refusal("effect", name, message, remedy)
    unit, factor = known[name]
    sizes = catalogue()[name].parameters[:1] if name in catalogue() else ()
    with suppress(ValueError):
        value = float(size) / factor if size else math.nan
        away = value - power[name].zero
        if not size or (math.isfinite(away) and away != 0 and all(away * one.sign >= 0 for one in sizes)):
            return name, value
    remedy = f"write a number in {unit or 'the unit of the parameter'}, of the sign that the effect has"
    raise refusal("effect", text, "is not a size", remedy)


def _simulated_rates(
    request: PowerRequest, tests: MisfitTests, power: Power, asked: Sequence[tuple[str, float]]
) -> Iterator[SimulatedRates]:
    """Simulate campaigns like that of the tests, diagnose each in full; yield the rate of each kind, the null first."""
    wanted: list[tuple[str, tuple[float, ...], float]] = [("", (math.nan,), power.false_alarm_rate)]
    for entry, size in ((power[name], size) for name, size in asked if name not in power.not_testable):
        sizes = [size] if math.isfinite(size) else [entry.size_at(0.5), entry.size_at(0.9)]
        known = filter(math.isfinite, sizes)
        wanted += [(entry.effect, (value, *entry.other_values), entry.probability_at(value)) for value in known]
    seeds = range(request.first_seed, request.first_seed + request.simulate)
    for effect, values, predicted_rate in wanted:
        done = map_unordered(partial(linear_power.simulated_diagnosis, tests, effect, values), seeds, request.jobs)
        diagnoses = list(progress(done, f"campaigns with {effect or 'nothing missing'}", len(seeds)))
        yield linear_power.rates_of(effect, diagnoses, values[0], predicted_rate)
