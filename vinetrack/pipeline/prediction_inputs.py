"""Inputs of the commands about new vines: options or a sheet, a fit, effects; and formatting of their output."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from vinetrack.core.numbers import number
from vinetrack.core.problems import ExperimentError, Problem
from vinetrack.core.tables import write_bytes
from vinetrack.core.units import PREDICTION_UNITS, display_unit
from vinetrack.experiment.planned import PlannedTrials, planned_sheet, planned_trial
from vinetrack.experiment.schema import option
from vinetrack.pipeline.fit_for_prediction import choose_fit
from vinetrack.results.folder_layout import Results, ResultsError, read_json

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from vinetrack.core.records import Trial
    from vinetrack.effects import Effect
    from vinetrack.planning.fit_inputs import FitNumbers
    from vinetrack.planning.input_sources import StatedValues
    from vinetrack.planning.predictive_inputs import Input, PredictiveInputs

FIGURE_FORMATS = (".png", ".svg", ".pdf")

NEVER = "never"


@dataclass(frozen=True)
class PredictionRequest:
    """Options of a command about new vines; NaN and None for those not given. `cells` are texts by column of the sheet,
    for the columns that were given. `B_error` and the between-trial standard deviations `spreads` are relative.
    `anyway` allows a fit whose model was refuted.
    """

    cells: Mapping[str, str] = field(default_factory=dict)
    sheet: Path | None = None
    results: Path | None = None
    anyway: bool = False
    effects: tuple[str, ...] = ()
    tail_slack: str | None = None
    B: float = math.nan
    B_error: float = 0.0
    n: float = math.nan
    n_error: float = 0.0
    spreads: tuple[float, float] | None = None


@dataclass(frozen=True)
class PredictionBasis:
    """What predictive inputs are made from: planned trials, stated values, and a fit if there is one."""

    planned: PlannedTrials
    stated: StatedValues
    fit: FitNumbers | None


def read_basis(request: PredictionRequest, needed: Sequence[str] | None = None) -> PredictionBasis:
    """Read the sheet or the options, the fit, and the requested effects."""
    from vinetrack.experiment.planned import REQUIRED_FOR_PREDICTION
    from vinetrack.experiment.settings import ExperimentSettings
    from vinetrack.planning.input_sources import StatedValues
    from vinetrack.planning.predictive_inputs import read_sizes

    if request.sheet is not None:
        planned = planned_sheet(request.sheet)
        _refuse_options_with_sheet(request)
    else:
        planned = planned_trial(
            request.cells, ExperimentSettings(), REQUIRED_FOR_PREDICTION if needed is None else needed
        )
    if request.tail_slack is not None:
        planned = replace(
            planned, trials=tuple(replace(trial, tail_slack=request.tail_slack) for trial in planned.trials)
        )
    fit, user_effects = (
        (None, _effects_of_sheet(planned)) if request.results is None else _read_fit(request.results, request.anyway)
    )
    sizes = [read_sizes(text, user_effects) for text in request.effects]
    stated = StatedValues(
        B=request.B,
        B_error=request.B_error,
        n=request.n,
        n_error=request.n_error,
        model=planned.settings.model,
        effects=tuple(name for name, _ in sizes),
        sizes={name: size for _, of_effect in sizes for name, size in of_effect.items()},
        user_effects=user_effects,
        spreads=request.spreads,
    )
    return PredictionBasis(planned, stated, fit)


def _refuse_options_with_sheet(request: PredictionRequest) -> None:
    problems = [
        Problem(
            message="is given in addition to a sheet", column=option(name), value=text, remedy="write it in the sheet"
        )
        for name, text in request.cells.items()
    ]
    if problems:
        raise ExperimentError(problems)


def _effects_of_sheet(planned: PlannedTrials) -> Mapping[str, Effect]:
    """Return the user's own effects of the experiment to which the sheet belongs."""
    from vinetrack.pipeline.effects_stage import effects_of

    return effects_of(planned.folder) if planned.folder is not None and planned.settings.effects else {}


def fit_heading(request: PredictionRequest) -> list[str]:
    """Return the heading for everything predicted from a fit: the verdict on its model."""
    return [] if request.results is None else list(choose_fit(request.results, request.anyway).heading)


def _read_fit(results: Path, anyway: bool) -> tuple[FitNumbers, Mapping[str, Effect]]:
    """Read the fit of a results folder, and the user's own effects if its model contains any."""
    from vinetrack.effects import catalogue
    from vinetrack.inference.fit_data import FitError
    from vinetrack.pipeline.effects_stage import effects_of
    from vinetrack.planning.fit_inputs import fit_numbers

    paths = Results(results)
    try:
        fit = fit_numbers(choose_fit(results, anyway).content, results.as_posix())
    except FitError as error:
        raise ResultsError(str(error)) from None
    own_names = [name for name in fit.model if name not in catalogue()]
    if not own_names:
        return fit, {}
    experiment = Path(str(read_json(paths.provenance).get("experiment", "")))
    user_effects = effects_of(experiment) if experiment.is_dir() else {}
    if not set(own_names) <= set(user_effects):
        raise ResultsError(
            f"{results} was fitted with {', '.join(own_names)}, an effect of its experiment, which is no longer "
            f"in {experiment}: put the folder back, or fit again"
        )
    return fit, user_effects


def inputs_of(basis: PredictionBasis) -> list[PredictiveInputs]:
    """Return the predictive inputs of every trial."""
    from vinetrack.inference.fit_data import FitError
    from vinetrack.planning.input_sources import predictive_inputs

    try:
        return [predictive_inputs(trial, basis.stated, basis.fit) for trial in basis.planned.trials]
    except FitError as error:
        raise ResultsError(str(error)) from None


def name_missing_option(error: Exception) -> Exception:
    """Convert an error about a missing input of an effect to one that names the option; return others unchanged."""
    match = re.search(r"the effect (\w+) needs `(\w+)`", str(error))
    if match is None:
        return error
    message = f"is blank, and the effect {match[1]} needs it"
    return ExperimentError(
        [Problem(message=message, column=match[2], remedy=f"give it as {option(match[2])} or in the sheet")]
    )


def warnings_of(basis: PredictionBasis) -> list[str]:
    """Return warnings about values of the sheet or the options that are allowed but implausible."""
    return [str(problem) for problem in basis.planned.problems]


def format_volume(volume_m3: float) -> str:
    """Return a volume in litres, or in millilitres below 0.1 L."""
    return f"{1e3 * volume_m3:.3g} L" if volume_m3 >= 1e-4 else f"{1e6 * volume_m3:.3g} mL"


def describe_trial(trial: Trial) -> str:
    """Describe a trial in one line."""
    size = f"{1e3 * trial.diameter_m:.4g} mm × {1e6 * trial.thickness_m:.4g} µm × {1e3 * trial.length_m:.4g} mm"
    payload = f"payload {1e3 * trial.payload_kg:.4g} g" if trial.payload_kg > 0 else "no payload"
    degrees = math.degrees(trial.growth_angle_rad)
    names = {0: "straight down", 90: "horizontally", 180: "straight up"}
    direction = names.get(round(degrees, 6), f"{degrees:.4g}° from straight down")  # type: ignore[call-overload]
    rig = "" if math.isnan(trial.chamber_m3) else f", chamber {format_volume(trial.chamber_m3)}"
    rig += "" if math.isnan(trial.inlet_m) else f", inlet {1e3 * trial.inlet_m:.4g} mm"
    return f"{size} at {trial.pressure_Pa / 1e3:.4g} kPa, {payload}, growing {direction}{rig}"


def display_value(value: float, unit: str, digits: int = 3) -> str:
    """Format an SI value in its display unit; infinity, a time that is never reached, is `never`."""
    if math.isinf(value):
        return NEVER
    return number(value * display_unit(unit, PREDICTION_UNITS)[1], digits)


def display_unit_name(unit: str) -> str:
    """Return the unit that `display_value` uses."""
    return display_unit(unit, PREDICTION_UNITS)[0]


def input_rows(inputs: Sequence[Input]) -> list[tuple[str, str, str, str, str]]:
    """Return rows of a table of inputs: symbol, median, 90 % band, unit, origin; constants of nature are left out."""
    rows = []
    for entry in inputs:
        if entry.origin == "constant":
            continue
        exact = entry.low == entry.high
        band = "–" if exact else f"{display_value(entry.low, entry.unit)} to {display_value(entry.high, entry.unit)}"
        rows.append(
            (entry.symbol, display_value(entry.median, entry.unit), band, display_unit_name(entry.unit), entry.origin)
        )
    return rows


def write_figure(fig: Figure, path: Path, dpi: float = 150) -> None:
    """Write a figure in the format that the suffix names."""
    from vinetrack.figures.style import render

    check_figure(path)
    form = path.suffix.lower().removeprefix(".")
    write_bytes(path, render(fig, [form], dpi)[form])


def check_figure(path: Path | None) -> None:
    """Check the suffix of an output figure before anything is computed."""
    if path is not None and path.suffix.lower() not in FIGURE_FORMATS:
        remedy = f"end it in one of {', '.join(FIGURE_FORMATS)}"
        raise ExperimentError([Problem(message="is not the name of a picture", file=str(path), remedy=remedy)])
