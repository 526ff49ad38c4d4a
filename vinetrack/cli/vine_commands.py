"""The commands `vinetrack design vine` and `vinetrack design reservoir`."""

from __future__ import annotations

import math
from typing import Annotated

import typer

from vinetrack.cli.design_options import (
    GUESSED_YIELD,
    RIG,
    VINE,
    AtFraction,
    Damping,
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
    "pressure_kPa",
    "film_density_kg_m3",
    "yield_pressure_kPa",
    "payload_g",
    "growth_angle_deg",
    "chamber_l",
    "inlet_mm",
    meanings={"pressure_kPa": "Highest gauge pressure of the supply.", "yield_pressure_kPa": GUESSED_YIELD},
)
def vine(
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
        typer.Option("--of-burst", min=0.05, max=1, help="Share of the burst stress that is dared.",
                     rich_help_panel=VINE),
    ] = 0.9,
    burst_stress: Annotated[
        float,
        typer.Option("--burst-MPa", min=0.01, max=1000, help="Hoop stress at which the film bursts; a guess.",
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
    log: LogPath = None,
) -> None:  # fmt: skip
    """The fastest vine within burst pressure, diameter, length, and films to choose from."""
    from vinetrack.cli.main import _sentences

    with _sentences(log):
        from vinetrack.pipeline.prediction_inputs import Asked
        from vinetrack.pipeline.vine_stage import design_vine

        asked = Asked(
            cells=cells,
            results=results,
            effects=tuple(effects or ()),
            n=math.nan if n is None else n,
            n_error=n_error,
        )
        say(
            design_vine(
                asked,
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
        )


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
        "chamber_l": "A chamber to look at as well.",
        "thickness_um": "Thickness of the wall: speeds are then told as well.",
        "yield_pressure_kPa": GUESSED_YIELD,
    },
)
def reservoir(
    *,
    cells: dict[str, str],
    within: Annotated[
        float,
        typer.Option("--within", min=0.01, max=90, help="Per cent of the gauge pressure that may be lost.",
                     rich_help_panel=RIG),
    ] = 5.0,
    supply: Annotated[
        float | None,
        typer.Option("--supply-s", min=1e-6, max=1e4, help="Time in which a supply closes the gap.",
                     rich_help_panel=RIG, show_default=False),
    ] = None,
    results: Results = None,
    B: Damping = None,
    n: Exponent = None,
    effects: Effects = None,
    at_fraction: AtFraction = 0.95,
    figure: FigurePath = None,
    log: LogPath = None,
) -> None:  # fmt: skip
    """The chamber that keeps the gauge pressure within so many per cent, by the gas law in absolute pressure."""
    from vinetrack.cli.main import _sentences

    with _sentences(log):
        from vinetrack.pipeline.prediction_inputs import Asked
        from vinetrack.pipeline.reservoir_stage import design_reservoir

        asked = Asked(
            cells=cells,
            results=results,
            effects=tuple(effects or ()),
            B=math.nan if B is None else B,
            n=math.nan if n is None else n,
        )
        say(design_reservoir(asked, within_percent=within, supply_s=supply, at_fraction=at_fraction, figure=figure))
