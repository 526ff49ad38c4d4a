"""The commands about vines and trials that do not exist yet: `predict`, `design vine`, `design reservoir`, `power`."""

from __future__ import annotations

import math
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from vinetrack.cli.command_frame import MORE, print_result
from vinetrack.cli.options import with_options

if TYPE_CHECKING:
    from vinetrack.pipeline.predict_stage import PredictionRequest

YIELD_MEANING = "Yield pressure; a scaling prior if not given."

# Columns of the sheet that are options of each command
PREDICTED = (
    "diameter_mm",
    "thickness_um",
    "length_mm",
    "film_density_kg_m3",
    "yield_pressure_kPa",
    "yield_pressure_sigma_kPa",
    "pressure_kPa",
    "pressure_sigma_kPa",
    "payload_g",
    "growth_angle_deg",
    "chamber_l",
    "inlet_mm",
)
OF_A_RIG = ("film_density_kg_m3", "yield_pressure_kPa", "pressure_kPa", "payload_g", "growth_angle_deg", "inlet_mm")


def _request(options: dict[str, Any], **more: Any) -> PredictionRequest:
    """Take what a prediction is asked with out of the options of a command."""
    from vinetrack.pipeline.predict_stage import PredictionRequest

    names = [field.name for field in fields(PredictionRequest) if field.name in options]
    return PredictionRequest(**{name: options.pop(name) for name in names}, **more)


@with_options("predict", PREDICTED, yield_pressure_kPa=YIELD_MEANING)
def _predict(
    sheet: Annotated[
        Path | None,
        typer.Argument(
            help="An experiment's folder or a sheet, instead of the options below.", metavar="SHEET", show_default=False
        ),
    ] = None,
    *,
    options: dict[str, Any],
) -> None:
    """Predict a new vine: position, speed, tension, ejection speed, with their uncertainty."""
    from vinetrack.pipeline.predict_stage import fit_heading, predict_conditions

    request = _request(options, sheet=sheet)
    heading = fit_heading(request)
    lines = predict_conditions(request, **options)
    print_result([*heading, *lines] if lines else [], None, None)


@with_options(
    "vine",
    (*OF_A_RIG, "chamber_l"),
    pressure_kPa="Highest gauge pressure of the supply.",
    yield_pressure_kPa=YIELD_MEANING,
)
def _vine(options: dict[str, Any]) -> None:
    """Find the fastest vine within limits of burst stress, diameter and length, for a choice of films."""
    from vinetrack.pipeline.design_stage import design_vine
    from vinetrack.pipeline.predict_stage import fit_heading

    json_file = options.pop("json")
    request = _request(options)
    heading = fit_heading(request)
    lines, films = design_vine(request, **options)
    print_result([*heading, *lines], {"warnings": heading, "films": films}, json_file)


@with_options(
    "reservoir",
    ("diameter_mm", "length_mm", "thickness_um", *OF_A_RIG, "chamber_l"),
    chamber_l="A chamber to evaluate as well.",
    thickness_um="Thickness of the wall; with it, speeds are predicted as well.",
    yield_pressure_kPa=YIELD_MEANING,
)
def _reservoir(options: dict[str, Any]) -> None:
    """Find the chamber that limits the loss of gauge pressure, by the gas law in absolute pressure."""
    from vinetrack.pipeline.design_stage import design_reservoir
    from vinetrack.pipeline.predict_stage import fit_heading

    json_file = options.pop("json")
    request = _request(options)
    heading = fit_heading(request)
    supply_s = None if math.isnan(options["supply_s"]) else options["supply_s"]
    lines, chambers = design_reservoir(request, **{**options, "supply_s": supply_s})
    print_result([*heading, *lines], {"warnings": heading, "chambers": chambers}, json_file)


@with_options("power")
def _power(
    target: Annotated[
        Path, typer.Argument(help="A results folder, an experiment, or a sheet without recordings.", metavar="TARGET")
    ],
    options: dict[str, Any],
) -> None:
    """Calculate the power of trials: detectable sizes of all effects, confusions between them, false-alarm rate."""
    import pandas as pd

    from vinetrack.core.tables import write_csv
    from vinetrack.pipeline.power_stage import PowerRequest, power_of_target, sheet_rows
    from vinetrack.pipeline.predict_stage import check_figure, write_figure

    figure, rows_file, json_file = (options.pop(name) for name in ("figure", "rows_file", "json"))
    check_figure(figure)
    power = power_of_target(PowerRequest(target=target, **options))
    lines = str(power).splitlines()
    if figure is not None:
        write_figure(power.plot(), figure)
        lines.append(f"Figure: {figure}")
    if rows_file is not None and power.further:
        write_csv(rows_file, pd.DataFrame(sheet_rows(power)))
        lines.append(f"Rows of the sheet: {rows_file}")
    print_result(lines, power.to_json(), json_file)


design_app = typer.Typer(
    name="design",
    help="Design the fastest vine, or the reservoir it needs.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
design_app.command("vine")(_vine)
design_app.command("reservoir")(_reservoir)


def register(app: typer.Typer) -> None:
    """Add the commands to the command line."""
    app.command("power", rich_help_panel=MORE)(_power)
    app.command("predict", rich_help_panel=MORE)(_predict)
    app.add_typer(design_app, rich_help_panel=MORE)
