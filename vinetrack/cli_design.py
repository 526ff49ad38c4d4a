"""The commands about vines not yet built: `vinetrack predict` and `vinetrack design …`."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated

import typer

design_app = typer.Typer(
    name="design",
    help="The fastest vine, the reservoir it needs, the campaign that pins n and B.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

VINE, RIG, BELIEF, OUT = "The vine", "The rig", "What is believed", "What is written"


def _column(column: str, words: str, panel: str) -> typer.models.OptionInfo:
    """An option that is a column of the trial sheet; its text is judged as a cell is."""
    unit = {"kPa": "KPA", "mm": "MM", "um": "UM", "g": "GRAMS", "l": "LITRES", "deg": "DEGREES"}.get(
        column.rsplit("_", 1)[-1], "NUMBER"
    )
    info: typer.models.OptionInfo = typer.Option(
        "--" + column.replace("_", "-"), help=words, metavar=unit, rich_help_panel=panel, show_default=False
    )
    return info


Diameter = Annotated[str | None, _column("diameter_mm", "Diameter.", VINE)]
Thickness = Annotated[str | None, _column("thickness_um", "Thickness of the wall.", VINE)]
Length = Annotated[str | None, _column("length_mm", "Length.", VINE)]
Density = Annotated[str | None, _column("film_density_kg_m3", "Density of the film, kg/m³ (1200).", VINE)]
Pressure = Annotated[str | None, _column("pressure_kPa", "Gauge pressure.", RIG)]
PressureSigma = Annotated[str | None, _column("pressure_sigma_kPa", "Its scatter from trial to trial (1 %).", RIG)]
Yield = Annotated[str | None, _column("yield_pressure_kPa", "Yield pressure; guessed if not given.", VINE)]
YieldSigma = Annotated[str | None, _column("yield_pressure_sigma_kPa", "Its error (0.2 kPa).", VINE)]
Payload = Annotated[str | None, _column("payload_g", "Payload (0).", RIG)]
Angle = Annotated[str | None, _column("growth_angle_deg", "Way of growth: 0 down, 90 level, 180 up.", RIG)]
Chamber = Annotated[str | None, _column("chamber_l", "Volume of the chamber.", RIG)]
Inlet = Annotated[str | None, _column("inlet_mm", "Diameter of the inlet.", RIG)]

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


def register(app: typer.Typer) -> None:
    """Add the commands to the command line."""
    app.command(name="predict")(predict)


def predict(
    sheet: Annotated[
        Path | None,
        typer.Argument(help="An experiment's folder or a sheet; else the options below.", metavar="SHEET",
                       show_default=False),
    ] = None,
    diameter: Diameter = None,
    thickness: Thickness = None,
    length: Length = None,
    density: Density = None,
    yields: Yield = None,
    yield_sigma: YieldSigma = None,
    pressure: Pressure = None,
    pressure_sigma: PressureSigma = None,
    payload: Payload = None,
    angle: Angle = None,
    chamber: Chamber = None,
    inlet: Inlet = None,
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
    from vinetrack.cli import _sentences

    with _sentences(log):
        from vinetrack.stages.beliefs import Asked
        from vinetrack.stages.foresee import foretell

        if tail_slack not in (None, "taut", "free"):
            raise typer.BadParameter(f"{tail_slack!r} is neither taut nor free", param_hint="--tail-slack")
        values = {
            "diameter_mm": diameter,
            "thickness_um": thickness,
            "length_mm": length,
            "film_density_kg_m3": density,
            "yield_pressure_kPa": yields,
            "yield_pressure_sigma_kPa": yield_sigma,
            "pressure_kPa": pressure,
            "pressure_sigma_kPa": pressure_sigma,
            "payload_g": payload,
            "growth_angle_deg": angle,
            "chamber_l": chamber,
            "inlet_mm": inlet,
        }
        asked = Asked(
            values=_given(values),
            sheet=sheet,
            results=results,
            effects=tuple(effects or ()),
            tail_slack=tail_slack,
            B=math.nan if B is None else B,
            B_error=B_error / 100,
            n=math.nan if n is None else n,
            n_error=n_error,
        )
        _say(foretell(asked, samples=samples, seed=seed, at_fraction=at_fraction, figure=figure, csv=csv, json=json))


def _given(values: Mapping[str, str | None]) -> dict[str, str]:
    return {name: text for name, text in values.items() if text is not None}


def _say(lines: Iterable[str]) -> None:
    for line in lines:
        typer.echo(line)
