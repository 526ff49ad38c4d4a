"""The command `vinetrack design campaign`."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

from vinetrack.cli.design_options import (
    BELIEF,
    GUESSED_YIELD,
    OUT,
    RIG,
    VINE,
    Effects,
    Exponent,
    FigurePath,
    LogPath,
    Results,
    Seed,
    column_options,
    say,
)


@column_options(
    "yield_pressure_kPa",
    "yield_pressure_sigma_kPa",
    "growth_angle_deg",
    "chamber_l",
    "inlet_mm",
    meanings={"yield_pressure_kPa": GUESSED_YIELD},
)
def campaign(
    vines: Annotated[
        list[str] | None,
        typer.Option("--vine", metavar="MMxUMxMM", help="Diameter, wall, length of a vine. May be repeated.",
                     rich_help_panel=VINE, show_default=False),
    ] = None,
    n_within: Annotated[
        float, typer.Option("--n-within", min=1e-5, max=1, help="Standard error of n that is wanted.")
    ] = 0.01,
    B_within: Annotated[
        float, typer.Option("--B-within", min=1e-3, max=100, help="Standard error of every B, per cent.")
    ] = 3.0,
    pressure: Annotated[
        str | None,
        typer.Option("--pressure-kPa", metavar="LOW:HIGH", help="Range of pressures; else all that can be filmed.",
                     rich_help_panel=RIG, show_default=False),
    ] = None,
    payloads: Annotated[
        str, typer.Option("--payload-g", metavar="GRAMS,…", help="Payloads to choose from.", rich_help_panel=RIG)
    ] = "0",
    pressures: Annotated[
        str, typer.Option("--pressures", metavar="LEAST:MOST", help="Pressures a vine.", rich_help_panel=RIG)
    ] = "4:8",
    replicates: Annotated[
        str, typer.Option("--replicates", metavar="LEAST:MOST", help="Trials of each condition.", rich_help_panel=RIG)
    ] = "2:12",
    most_trials: Annotated[int, typer.Option("--most-trials", min=2, max=2000, help="In all.")] = 200,
    fps: Annotated[float, typer.Option("--fps", min=1, max=1e6, help="Frames a second.", rich_help_panel=RIG)] = 1069.0,
    noise: Annotated[
        float, typer.Option("--noise-mm", min=1e-5, max=50, help="Noise of a position.", rich_help_panel=RIG)
    ] = 0.1,
    correlation: Annotated[
        float, typer.Option("--noise-correlation", min=-0.5, max=0.98, help="From frame to frame.", rich_help_panel=RIG)
    ] = 0.0,
    longest: Annotated[
        float, typer.Option("--longest-s", min=0.01, max=60, help="Longest recording.", rich_help_panel=RIG)
    ] = 4.0,
    *,
    cells: dict[str, str],
    burst_share: Annotated[
        float, typer.Option("--of-burst", min=0.05, max=1, help="Share of the burst stress that is dared.")
    ] = 0.9,
    pressure_spread: Annotated[
        float | None,
        typer.Option("--P-spread", min=0, max=4, help="Of pressure from trial to trial, per cent (1).",
                     rich_help_panel=BELIEF, show_default=False),
    ] = None,
    damping_spread: Annotated[
        float | None,
        typer.Option("--B-spread", min=0, max=15, help="Of B from trial to trial, per cent (3).",
                     rich_help_panel=BELIEF, show_default=False),
    ] = None,
    results: Results = None,
    n: Exponent = None,
    effects: Effects = None,
    check: Annotated[int, typer.Option("--check", min=0, max=1000, help="Campaigns to rehearse.")] = 20,
    seed: Seed = 1,
    sheet: Annotated[
        Path | None,
        typer.Option("--sheet", help="Write a sheet to film by, to this file.", rich_help_panel=OUT,
                     show_default=False),
    ] = None,
    figure: FigurePath = None,
    log: LogPath = None,
) -> None:  # fmt: skip
    """Pressures, payloads and replicates that pin n and B to a wanted error, rehearsed before they are made."""
    from vinetrack.cli.main import _sentences

    with _sentences(log):
        from vinetrack.pipeline.campaign_stage import Wanted, design_campaign
        from vinetrack.pipeline.prediction_inputs import Asked

        asked = Asked(
            cells=cells,
            results=results,
            effects=tuple(effects or ()),
            n=math.nan if n is None else n,
            spreads=spreads(pressure_spread, damping_spread),
        )
        wanted = Wanted(
            vines=tuple(vines or ()),
            pressure=pressure,
            payloads=payloads,
            n_error=n_within,
            B_error=B_within / 100,
            capture_fps=fps,
            noise_mm=noise,
            correlation=correlation,
            longest_s=longest,
            pressures=counts(pressures, "--pressures", 2, 13),
            replicates=counts(replicates, "--replicates", 1, 50),
            most_trials=most_trials,
            burst_share=burst_share,
            check=check,
            seed=seed,
        )
        say(design_campaign(asked, wanted, sheet=sheet, figure=figure))


def spreads(pressure: float | None, damping: float | None) -> tuple[float, float] | None:
    """Relative spreads from trial to trial, where either is given; the other as a batch of vines shows it."""
    if pressure is None and damping is None:
        return None
    return (1.0 if pressure is None else pressure) / 100, (3.0 if damping is None else damping) / 100


def counts(text: str, name: str, least: int, most: int) -> tuple[int, int]:
    """Two numbers of things from `low:high` or one number."""
    try:
        values = [int(part) for part in text.split(":")]
    except ValueError:
        values = []
    if len(values) not in (1, 2) or not least <= values[0] <= values[-1] <= most:
        raise typer.BadParameter(f"{text!r} is no range within {least}:{most}, such as 4:8", param_hint=name)
    return values[0], values[-1]
