"""Options that the commands about vines not yet built share."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated

import typer

VINE, RIG, BELIEF, OUT = "The vine", "The rig", "What is believed", "What is written"


def column_option(column: str, words: str, panel: str) -> typer.models.OptionInfo:
    """An option that is a column of the trial sheet; its text is judged as a cell is."""
    unit = {"kPa": "KPA", "mm": "MM", "um": "UM", "g": "GRAMS", "l": "LITRES", "deg": "DEGREES"}.get(
        column.rsplit("_", 1)[-1], "NUMBER"
    )
    info: typer.models.OptionInfo = typer.Option(
        "--" + column.replace("_", "-"), help=words, metavar=unit, rich_help_panel=panel, show_default=False
    )
    return info


Diameter = Annotated[str | None, column_option("diameter_mm", "Diameter.", VINE)]
Thickness = Annotated[str | None, column_option("thickness_um", "Thickness of the wall.", VINE)]
Length = Annotated[str | None, column_option("length_mm", "Length.", VINE)]
Density = Annotated[str | None, column_option("film_density_kg_m3", "Density of the film, kg/m³ (1200).", VINE)]
Pressure = Annotated[str | None, column_option("pressure_kPa", "Gauge pressure.", RIG)]
PressureSigma = Annotated[
    str | None, column_option("pressure_sigma_kPa", "Its scatter from trial to trial (1 %).", RIG)
]
Yield = Annotated[str | None, column_option("yield_pressure_kPa", "Yield pressure; guessed if not given.", VINE)]
YieldSigma = Annotated[str | None, column_option("yield_pressure_sigma_kPa", "Its error (0.2 kPa).", VINE)]
Payload = Annotated[str | None, column_option("payload_g", "Payload (0).", RIG)]
Angle = Annotated[str | None, column_option("growth_angle_deg", "Way of growth: 0 down, 90 level, 180 up.", RIG)]
Chamber = Annotated[str | None, column_option("chamber_l", "Volume of the chamber.", RIG)]
Inlet = Annotated[str | None, column_option("inlet_mm", "Diameter of the inlet.", RIG)]

Results = Annotated[
    Path | None,
    typer.Option(
        "--from", help="Results folder whose fit is believed.", metavar="RESULTS", rich_help_panel=BELIEF,
        show_default=False,
    ),
]  # fmt: skip
Damping = Annotated[
    float | None,
    typer.Option("--B", min=1e-9, help="Damping coefficient, N·(s/m)ⁿ; guessed if not given.", rich_help_panel=BELIEF,
                 show_default=False),
]  # fmt: skip
DampingError = Annotated[
    float, typer.Option("--B-error", min=0, max=200, help="Its error, per cent.", rich_help_panel=BELIEF)
]
Exponent = Annotated[
    float | None,
    typer.Option("--n", min=0, max=2, help="Damping exponent.", rich_help_panel=BELIEF, show_default=False),
]
ExponentError = Annotated[float, typer.Option("--n-error", min=0, max=1, help="Its error.", rich_help_panel=BELIEF)]
Effects = Annotated[
    list[str] | None,
    typer.Option(
        "--effect", metavar="NAME[=SIZE]", rich_help_panel=BELIEF, show_default=False,
        help="A further effect; its size as a number, or a range such as 1:1.4. May be repeated.",
    ),
]  # fmt: skip
Samples = Annotated[int, typer.Option("--samples", min=50, max=100_000, help="Draws.", rich_help_panel=BELIEF)]
Seed = Annotated[int, typer.Option("--seed", min=0, help="Of the random numbers.", rich_help_panel=BELIEF)]
AtFraction = Annotated[
    float,
    typer.Option("--at", min=0.05, max=0.99, help="y/L at which final speeds are taken.", rich_help_panel=BELIEF),
]
FigurePath = Annotated[
    Path | None, typer.Option("--figure", help="Draw it, to this file.", rich_help_panel=OUT, show_default=False)
]
LogPath = Annotated[Path | None, typer.Option("--log", help="File for messages and tracebacks.", rich_help_panel=OUT)]


def given(values: Mapping[str, str | None]) -> dict[str, str]:
    """Options that were given."""
    return {name: text for name, text in values.items() if text is not None}


def say(lines: Iterable[str]) -> None:
    """Print lines."""
    for line in lines:
        typer.echo(line)
