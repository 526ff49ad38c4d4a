"""The commands about new vines: `vinetrack predict` and `vinetrack design …`."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

from vinetrack.cli.command_frame import MORE, JsonFile, errors_as_sentences, print_result
from vinetrack.cli.design_options import (
    INPUTS,
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
    RenamedOptions,
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
        lines = fit_heading(request) + design_vine(
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
        print_result(lines, {"lines": lines}, json_file)


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
        lines = fit_heading(request)
        lines += design_reservoir(
            request, within_percent=within, supply_s=supply, at_fraction=at_fraction, figure=figure
        )
        print_result(lines, {"lines": lines}, json_file)


@column_options(
    "yield_pressure_kPa",
    "yield_pressure_sigma_kPa",
    "growth_angle_deg",
    "chamber_l",
    "inlet_mm",
    meanings={"yield_pressure_kPa": YIELD_MEANING},
)
def _campaign(
    vines: Annotated[
        list[str] | None,
        typer.Option("--vine", metavar="MMxUMxMM", help="Diameter, wall, length of a vine. May be repeated.",
                     rich_help_panel=VINE, show_default=False),
    ] = None,
    n_se: Annotated[
        float, typer.Option("--n-se", min=1e-5, max=1, help="Wanted standard error of n.")
    ] = 0.01,
    B_se_percent: Annotated[
        float, typer.Option("--B-se-percent", min=1e-3, max=100, help="Wanted standard error of every B, per cent.")
    ] = 3.0,
    pressure: Annotated[
        str | None,
        typer.Option("--pressure-kPa", metavar="LOW:HIGH", help="Range of pressures; default: all that can be filmed.",
                     rich_help_panel=RIG, show_default=False),
    ] = None,
    payloads: Annotated[
        str, typer.Option("--payload-g", metavar="GRAMS,…", help="Payloads to choose from.", rich_help_panel=RIG)
    ] = "0",
    pressures: Annotated[
        str, typer.Option("--pressures", metavar="LEAST:MOST", help="Pressures per vine.", rich_help_panel=RIG)
    ] = "4:8",
    replicates: Annotated[
        str, typer.Option("--replicates", metavar="LEAST:MOST", help="Trials per condition.", rich_help_panel=RIG)
    ] = "2:12",
    most_trials: Annotated[int, typer.Option("--most-trials", min=2, max=2000, help="Trials in total.")] = 200,
    capture_fps: Annotated[
        float, typer.Option("--capture-fps", min=1, max=1e6, help="Frames per second.", rich_help_panel=RIG)
    ] = 1069.0,
    noise: Annotated[
        float, typer.Option("--noise-mm", min=1e-5, max=50, help="Noise of a position.", rich_help_panel=RIG)
    ] = 0.1,
    correlation: Annotated[
        float, typer.Option("--noise-correlation", min=-0.5, max=0.98, help="Of the noise.", rich_help_panel=RIG)
    ] = 0.0,
    longest: Annotated[
        float, typer.Option("--longest-s", min=0.01, max=60, help="Longest recording.", rich_help_panel=RIG)
    ] = 4.0,
    *,
    cells: dict[str, str],
    burst_share: Annotated[
        float, typer.Option("--burst-fraction", min=0.05, max=1, help="Allowed fraction of the burst stress.")
    ] = 0.9,
    pressure_spread: Annotated[
        float | None,
        typer.Option("--P-spread", min=0, max=4, help="Between-trial sd of pressure, per cent (1).",
                     rich_help_panel=INPUTS, show_default=False),
    ] = None,
    damping_spread: Annotated[
        float | None,
        typer.Option("--B-spread", min=0, max=15, help="Between-trial sd of B, per cent (3).",
                     rich_help_panel=INPUTS, show_default=False),
    ] = None,
    results: Results = None,
    n: Exponent = None,
    effects: Effects = None,
    check: Annotated[int, typer.Option("--check", min=0, max=1000, help="Simulated campaigns that test it.")] = 20,
    seed: Seed = 1,
    power: Annotated[
        bool, typer.Option("--power", help="Also give the power of the campaign for other effects.")
    ] = False,
    sheet: Annotated[
        Path | None,
        typer.Option("--sheet", help="Write the trial sheet of the campaign to this file.", rich_help_panel=OUT,
                     show_default=False),
    ] = None,
    figure: FigurePath = None,
    json_file: JsonFile = None,
    anyway: Anyway = False,
    log: LogPath = None,
) -> None:  # fmt: skip
    """Choose pressures, payloads and replicates that reach wanted standard errors of n and B, and simulate them."""
    with errors_as_sentences(log):
        from vinetrack.pipeline.campaign_stage import CampaignRequest, design_campaign
        from vinetrack.pipeline.predict_stage import PredictionRequest, fit_heading

        request = PredictionRequest(
            cells=cells,
            results=results,
            anyway=anyway,
            effects=tuple(effects or ()),
            n=math.nan if n is None else n,
            spreads=_relative_spreads(pressure_spread, damping_spread),
        )
        wanted = CampaignRequest(
            vines=tuple(vines or ()),
            pressure=pressure,
            payloads=payloads,
            n_error=n_se,
            B_error=B_se_percent / 100,
            capture_fps=capture_fps,
            noise_mm=noise,
            correlation=correlation,
            longest_s=longest,
            pressures=_count_range(pressures, "--pressures", 2, 13),
            replicates=_count_range(replicates, "--replicates", 1, 50),
            most_trials=most_trials,
            burst_share=burst_share,
            check=check,
            seed=seed,
            power=power,
        )
        lines = fit_heading(request) + design_campaign(request, wanted, sheet=sheet, figure=figure)
        print_result(lines, {"lines": lines}, json_file)


def _relative_spreads(pressure: float | None, damping: float | None) -> tuple[float, float] | None:
    """Return the relative between-trial standard deviations if either is given; the other has its default."""
    if pressure is None and damping is None:
        return None
    return (1.0 if pressure is None else pressure) / 100, (3.0 if damping is None else damping) / 100


def _count_range(text: str, name: str, least: int, most: int) -> tuple[int, int]:
    """Read a range of counts from `low:high` or one number."""
    try:
        values = [int(part) for part in text.split(":")]
    except ValueError:
        values = []
    if len(values) not in (1, 2) or not least <= values[0] <= values[-1] <= most:
        raise typer.BadParameter(f"{text!r} is not a range within {least}:{most}, such as 4:8", param_hint=name)
    return values[0], values[-1]


design_app = typer.Typer(
    name="design",
    help="Design the fastest vine, the reservoir it needs, or a campaign that measures n and B.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
design_app.command("vine", cls=RenamedOptions)(_vine)
design_app.command("reservoir", cls=RenamedOptions)(_reservoir)
design_app.command("campaign", cls=RenamedOptions)(_campaign)


def register(app: typer.Typer) -> None:
    """Add the commands to the command line."""
    app.command("predict", cls=RenamedOptions, rich_help_panel=MORE)(_predict)
    app.add_typer(design_app, rich_help_panel=MORE)
