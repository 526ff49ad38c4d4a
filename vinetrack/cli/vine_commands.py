"""The commands `vinetrack design vine` and `vinetrack design reservoir`."""

from __future__ import annotations

import math
from typing import Annotated

import typer

from vinetrack.cli.design_options import (
    RIG,
    VINE,
    Angle,
    AtFraction,
    Chamber,
    Damping,
    Density,
    Diameter,
    Effects,
    Exponent,
    ExponentError,
    FigurePath,
    Inlet,
    Length,
    LogPath,
    Payload,
    Pressure,
    Results,
    Samples,
    Seed,
    Yield,
    column_option,
    given,
    say,
)


def vine(
    pressure: Annotated[str | None, column_option("pressure_kPa", "Highest gauge pressure of the supply.", RIG)] = None,
    films: Annotated[
        str, typer.Option("--films-um", metavar="UM,…", help="Films to choose from.", rich_help_panel=VINE)
    ] = "50,100,150,200",
    diameter: Annotated[
        str, typer.Option("--diameter-mm", metavar="LOW:HIGH", help="Range of diameters.", rich_help_panel=VINE)
    ] = "5:25",
    length: Annotated[
        str, typer.Option("--length-mm", metavar="LOW:HIGH", help="Range of lengths.", rich_help_panel=VINE)
    ] = "100:400",
    density: Density = None,
    yields: Yield = None,
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
    payload: Payload = None,
    angle: Angle = None,
    chamber: Chamber = None,
    inlet: Inlet = None,
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

        values = {
            "pressure_kPa": pressure,
            "film_density_kg_m3": density,
            "yield_pressure_kPa": yields,
            "payload_g": payload,
            "growth_angle_deg": angle,
            "chamber_l": chamber,
            "inlet_mm": inlet,
        }
        asked = Asked(
            cells=given(values),
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


def reservoir(
    diameter: Diameter = None,
    length: Length = None,
    pressure: Pressure = None,
    within: Annotated[
        float,
        typer.Option("--within", min=0.01, max=90, help="Per cent of the gauge pressure that may be lost.",
                     rich_help_panel=RIG),
    ] = 5.0,
    chamber: Annotated[str | None, column_option("chamber_l", "A chamber to look at as well.", RIG)] = None,
    supply: Annotated[
        float | None,
        typer.Option("--supply-s", min=1e-6, max=1e4, help="Time in which a supply closes the gap.",
                     rich_help_panel=RIG, show_default=False),
    ] = None,
    thickness: Annotated[
        str | None, column_option("thickness_um", "Thickness of the wall: speeds are then told as well.", VINE)
    ] = None,
    density: Density = None,
    yields: Yield = None,
    payload: Payload = None,
    angle: Angle = None,
    inlet: Inlet = None,
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

        values = {
            "diameter_mm": diameter,
            "thickness_um": thickness,
            "length_mm": length,
            "pressure_kPa": pressure,
            "film_density_kg_m3": density,
            "yield_pressure_kPa": yields,
            "payload_g": payload,
            "growth_angle_deg": angle,
            "chamber_l": chamber,
            "inlet_mm": inlet,
        }
        asked = Asked(
            cells=given(values),
            results=results,
            effects=tuple(effects or ()),
            B=math.nan if B is None else B,
            n=math.nan if n is None else n,
        )
        say(design_reservoir(asked, within_percent=within, supply_s=supply, at_fraction=at_fraction, figure=figure))
