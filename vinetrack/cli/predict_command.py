"""The command `vinetrack predict`."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

from vinetrack.cli.design_options import (
    GUESSED_YIELD,
    OUT,
    RIG,
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
    meanings={"yield_pressure_kPa": GUESSED_YIELD},
)
def predict(
    sheet: Annotated[
        Path | None,
        typer.Argument(help="An experiment's folder or a sheet; else the options below.", metavar="SHEET",
                       show_default=False),
    ] = None,
    *,
    cells: dict[str, str],
    tail_slack: Annotated[
        str | None,
        typer.Option("--tail-slack", metavar="taut|free", help="Whether a tail that would push goes slack.",
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
        typer.Option("--csv", help="Write the curves, to this file.", rich_help_panel=OUT, show_default=False),
    ] = None,
    json: Annotated[
        Path | None,
        typer.Option("--json", help="Write everything said, to this file.", rich_help_panel=OUT, show_default=False),
    ] = None,
    log: LogPath = None,
) -> None:  # fmt: skip
    """What a vine not yet built will do: position, speed, tension, ejection speed, with their uncertainty."""
    from vinetrack.cli.main import _sentences

    with _sentences(log):
        from vinetrack.pipeline.predict_stage import foretell
        from vinetrack.pipeline.prediction_inputs import Asked

        if tail_slack not in (None, "taut", "free"):
            raise typer.BadParameter(f"{tail_slack!r} is neither taut nor free", param_hint="--tail-slack")
        asked = Asked(
            cells=cells,
            sheet=sheet,
            results=results,
            effects=tuple(effects or ()),
            tail_slack=tail_slack,
            B=math.nan if B is None else B,
            B_error=B_error / 100,
            n=math.nan if n is None else n,
            n_error=n_error,
        )
        say(foretell(asked, samples=samples, seed=seed, at_fraction=at_fraction, figure=figure, csv=csv, json=json))
