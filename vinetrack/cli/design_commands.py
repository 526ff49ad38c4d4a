"""The commands about new vines: `vinetrack predict` and `vinetrack design …`."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

from vinetrack.cli.command_frame import MORE, JsonFile, errors_as_sentences, print_result
from vinetrack.cli.design_options import (
    OUT,
    RIG,
    VINE,
    YIELD_MEANING,
    Anyway,
    AtFraction,
    Damping,
    DampingError,
    Effects,
    Exponent,
    ExponentError,
    FigurePath,
    LogPath,
    Results,
    Samples,
    Seed,
    column_options,
    say,
)


@column_options(
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
    meanings={"yield_pressure_kPa": YIELD_MEANING},
)
def _predict(
    sheet: Annotated[
        Path | None,
        typer.Argument(help="An experiment's folder or a sheet, instead of the options below.", metavar="SHEET",
                       show_default=False),
    ] = None,
    *,
    cells: dict[str, str],
    tail_slack: Annotated[
        str | None,
        typer.Option("--tail-slack", metavar="taut|free", help="Whether a tail under compression goes slack.",
                     rich_help_panel=RIG, show_default=False),
    ] = None,
    results: Results = None,
    B: Damping = None,
    B_error: DampingError = 0.0,
    n: Exponent = None,
    n_error: ExponentError = 0.0,
    effects: Effects = None,
    samples: Samples = 1000,
    seed: Seed = 1,
    at_fraction: AtFraction = 0.95,
    figure: FigurePath = None,
    csv: Annotated[
        Path | None,
        typer.Option("--csv", help="Write the curves to this file.", rich_help_panel=OUT, show_default=False),
    ] = None,
    json: Annotated[
        Path | None,
        typer.Option("--json", help="Write all numbers to this file, - for the terminal.",
                     rich_help_panel=OUT, show_default=False),
    ] = None,
    anyway: Anyway = False,
    log: LogPath = None,
) -> None:  # fmt: skip
    """Predict a new vine: position, speed, tension, ejection speed, with their uncertainty."""
    with errors_as_sentences(log):
        from vinetrack.pipeline.predict_stage import PredictionRequest, fit_heading, predict_conditions

        if tail_slack not in (None, "taut", "free"):
            raise typer.BadParameter(f"{tail_slack!r} is neither taut nor free", param_hint="--tail-slack")
        request = PredictionRequest(
            cells=cells,
            sheet=sheet,
            results=results,
            anyway=anyway,
            effects=tuple(effects or ()),
            tail_slack=tail_slack,
            B=math.nan if B is None else B,
            B_error=B_error / 100,
            n=math.nan if n is None else n,
            n_error=n_error,
        )
        heading = fit_heading(request)
        lines = predict_conditions(
            request, samples=samples, seed=seed, at_fraction=at_fraction, figure=figure, csv=csv, json=json
        )
        say([*heading, *lines] if lines else [])


@column_options(
    "pressure_kPa",
    "film_density_kg_m3",
    "yield_pressure_kPa",
    "payload_g",
    "growth_angle_deg",
    "chamber_l",
    "inlet_mm",
    meanings={"pressure_kPa": "Highest gauge pressure of the supply.", "yield_pressure_kPa": YIELD_MEANING},
)
def _vine(
    films: Annotated[
        str, typer.Option("--films-um", metavar="UM,…", help="Films to choose from.", rich_help_panel=VINE)
    ] = "50,100,150,200",
    diameter: Annotated[
        str, typer.Option("--diameter-mm", metavar="LOW:HIGH", help="Range of diameters.", rich_help_panel=VINE)
    ] = "5:25",
    length: Annotated[
        str, typer.Option("--length-mm", metavar="LOW:HIGH", help="Range of lengths.", rich_help_panel=VINE)
    ] = "100:400",
    burst_share: Annotated[
        float,
        typer.Option("--burst-fraction", min=0.05, max=1, help="Allowed fraction of the burst stress.",
                     rich_help_panel=VINE),
    ] = 0.9,
    burst_stress: Annotated[
        float,
        typer.Option("--burst-MPa", min=0.01, max=1000, help="Burst stress of the film; default from one vine.",
                     rich_help_panel=VINE),
    ] = 7.8,
    *,
    cells: dict[str, str],
    results: Results = None,
    n: Exponent = None,
    n_error: ExponentError = 0.0,
    effects: Effects = None,
    samples: Samples = 400,
    seed: Seed = 1,
    at_fraction: AtFraction = 0.95,
    figure: FigurePath = None,
    json_file: JsonFile = None,
    anyway: Anyway = False,
    log: LogPath = None,
) -> None:  # fmt: skip
    """Find the fastest vine within limits of burst stress, diameter and length, for a choice of films."""
    with errors_as_sentences(log):
        from vinetrack.pipeline.design_stage import design_vine
        from vinetrack.pipeline.predict_stage import PredictionRequest, fit_heading

        request = PredictionRequest(
            cells=cells,
            results=results,
            anyway=anyway,
            effects=tuple(effects or ()),
            n=math.nan if n is None else n,
            n_error=n_error,
        )
        heading = fit_heading(request)
        lines, films_content = design_vine(
            request,
            films=films,
            diameter=diameter,
            length=length,
            burst_share=burst_share,
            burst_stress_MPa=burst_stress,
            samples=samples,
            seed=seed,
            at_fraction=at_fraction,
            figure=figure,
        )
        print_result([*heading, *lines], {"warnings": heading, "films": films_content}, json_file)


@column_options(
    "diameter_mm",
    "length_mm",
    "pressure_kPa",
    "chamber_l",
    "thickness_um",
    "film_density_kg_m3",
    "yield_pressure_kPa",
    "payload_g",
    "growth_angle_deg",
    "inlet_mm",
    meanings={
        "chamber_l": "A chamber to evaluate as well.",
        "thickness_um": "Thickness of the wall; with it, speeds are predicted as well.",
        "yield_pressure_kPa": YIELD_MEANING,
    },
)
def _reservoir(
    *,
    cells: dict[str, str],
    within: Annotated[
        float,
        typer.Option("--within", min=0.01, max=90, help="Allowed loss of gauge pressure, per cent.",
                     rich_help_panel=RIG),
    ] = 5.0,
    supply: Annotated[
        float | None,
        typer.Option("--supply-s", min=1e-6, max=1e4, help="Time constant of a supply that refills it.",
                     rich_help_panel=RIG, show_default=False),
    ] = None,
    results: Results = None,
    B: Damping = None,
    n: Exponent = None,
    effects: Effects = None,
    at_fraction: AtFraction = 0.95,
    figure: FigurePath = None,
    json_file: JsonFile = None,
    anyway: Anyway = False,
    log: LogPath = None,
) -> None:  # fmt: skip
    """Find the chamber that limits the loss of gauge pressure, by the gas law in absolute pressure."""
    with errors_as_sentences(log):
        from vinetrack.pipeline.design_stage import design_reservoir
        from vinetrack.pipeline.predict_stage import PredictionRequest, fit_heading

        request = PredictionRequest(
            cells=cells,
            results=results,
            anyway=anyway,
            effects=tuple(effects or ()),
            B=math.nan if B is None else B,
            n=math.nan if n is None else n,
        )
        heading = fit_heading(request)
        lines, chambers = design_reservoir(
            request, within_percent=within, supply_s=supply, at_fraction=at_fraction, figure=figure
        )
        print_result([*heading, *lines], {"warnings": heading, "chambers": chambers}, json_file)


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
    app.command("predict", rich_help_panel=MORE)(_predict)
    app.add_typer(design_app, rich_help_panel=MORE)
