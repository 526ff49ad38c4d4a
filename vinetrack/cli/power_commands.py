"""The command `vinetrack power`: statistical power of trials, planned or measured."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

from vinetrack.cli.command_frame import MORE, errors_as_sentences, print_result
from vinetrack.cli.design_options import INPUTS, OUT, FigurePath, LogPath

SIMULATION, FURTHER = "Simulation", "What to add"


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    app.command("power", rich_help_panel=MORE)(_power)


def _power(
    target: Annotated[
        Path,
        typer.Argument(help="A results folder, an experiment, or a sheet without recordings.", metavar="TARGET"),
    ],
    effects: Annotated[
        list[str] | None,
        typer.Option("--effect", metavar="NAME[=SIZE]", show_default=False,
                     help="Only this effect; with --simulate, at this size. May be repeated."),
    ] = None,
    noise: Annotated[
        float | None,
        typer.Option("--noise-mm", min=1e-5, max=50, rich_help_panel=INPUTS, show_default=False,
                     help="Noise of a position; default: from the fit, or 0.1 without one."),
    ] = None,
    correlation: Annotated[
        float | None,
        typer.Option("--noise-correlation", min=-0.5, max=0.98, rich_help_panel=INPUTS, show_default=False,
                     help="Correlation of the noise of successive frames."),
    ] = None,
    scatter_B: Annotated[
        float | None,
        typer.Option("--scatter-B", min=0, max=50, rich_help_panel=INPUTS, show_default=False,
                     help="Between-trial sd of B, per cent; default: from the fit, or 3 without one."),
    ] = None,
    scatter_P: Annotated[
        float | None,
        typer.Option("--scatter-P", min=0, max=20, rich_help_panel=INPUTS, show_default=False,
                     help="Between-trial sd of pressure, per cent; default: from the fit, or 1 without one."),
    ] = None,
    capture_fps: Annotated[
        float | None,
        typer.Option("--capture-fps", min=1, max=1e6, rich_help_panel=INPUTS, show_default=False,
                     help="Frames per second, for a sheet without recordings."),
    ] = None,
    systematic: Annotated[
        float | None,
        typer.Option("--systematic-mm", min=0, max=50, rich_help_panel=INPUTS, show_default=False,
                     help="Smooth error of positions that trials share, for a sheet without recordings; default 0.1, "
                          "or 0 with a calibration target."),
    ] = None,
    B: Annotated[
        float | None,
        typer.Option("--B", min=1e-9, rich_help_panel=INPUTS, show_default=False,
                     help="Damping coefficient for a sheet without recordings, N·(s/m)ⁿ; default: scaling prior."),
    ] = None,
    n: Annotated[
        float | None,
        typer.Option("--n", min=0, max=2, rich_help_panel=INPUTS, show_default=False, help="Damping exponent."),
    ] = None,
    simulate: Annotated[
        int,
        typer.Option("--simulate", min=0, max=1000, rich_help_panel=SIMULATION,
                     help="Campaigns to simulate and diagnose: without any effect, and with each --effect."),
    ] = 0,
    jobs: Annotated[int, typer.Option("--jobs", min=1, rich_help_panel=SIMULATION, help="Processes.")] = 2,
    seed: Annotated[
        int, typer.Option("--seed", min=0, rich_help_panel=SIMULATION, help="Seed of the first simulated campaign.")
    ] = 1,
    reach: Annotated[
        float | None,
        typer.Option("--reach", min=0.5, max=0.98, metavar="PROBABILITY", rich_help_panel=FURTHER, show_default=False,
                     help="Find the fewest further trials that detect each --effect NAME=SIZE with this probability."),
    ] = None,
    recommend: Annotated[
        bool,
        typer.Option("--next", rich_help_panel=FURTHER,
                     help="Recommend the further trials that would reveal most of what could be missing."),
    ] = False,
    sheet: Annotated[
        Path | None,
        typer.Option("--sheet", metavar="FILE", rich_help_panel=FURTHER, show_default=False,
                     help="With --reach, write the rows of these trials to this file."),
    ] = None,
    experiment: Annotated[
        Path | None, typer.Option("--experiment", help="The experiment, if it has moved.", show_default=False)
    ] = None,
    figure: FigurePath = None,
    json_file: Annotated[
        Path | None,
        typer.Option("--json", metavar="FILE", help="Write it as JSON to this file, - for the terminal.",
                     rich_help_panel=OUT, show_default=False),
    ] = None,
    log: LogPath = None,
) -> None:  # fmt: skip
    """Calculate the power of trials: detectable sizes of all effects, confusions between them, false-alarm rate."""
    with errors_as_sentences(log):
        import pandas as pd

        from vinetrack.core.tables import write_csv
        from vinetrack.pipeline.power_stage import PowerRequest, power_of_target, sheet_rows
        from vinetrack.pipeline.predict_stage import check_figure, write_figure

        check_figure(figure)
        power = power_of_target(
            PowerRequest(
                target=target,
                effects=tuple(effects or ()),
                noise_mm=_or_nan(noise),
                noise_correlation=_or_nan(correlation),
                spread_P=_or_nan(scatter_P) / 100,
                spread_B=_or_nan(scatter_B) / 100,
                capture_fps=_or_nan(capture_fps),
                systematic_mm=_or_nan(systematic),
                B=_or_nan(B),
                n=_or_nan(n),
                simulate=simulate,
                recommend=recommend,
                jobs=jobs,
                first_seed=seed,
                reach=_or_nan(reach),
                experiment=experiment,
            )
        )
        lines = str(power).splitlines()
        if figure is not None:
            write_figure(power.plot(), figure)
            lines.append(f"Figure: {figure}")
        if sheet is not None and power.further:
            write_csv(sheet, pd.DataFrame(sheet_rows(power)))
            lines.append(f"Rows of the sheet: {sheet}")
        print_result(lines, power.to_json(), json_file)


def _or_nan(value: float | None) -> float:
    return math.nan if value is None else value
