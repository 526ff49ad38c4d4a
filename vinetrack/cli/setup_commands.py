"""The commands that start from recordings: `vinetrack setup` and `vinetrack track`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from vinetrack.cli.command_frame import (
    START,
    JsonFile,
    activity_sign,
    errors_as_sentences,
    json_to_terminal,
    print_result,
)


def register(app: typer.Typer) -> None:
    """Add the commands to the command line."""
    app.command(name="setup", rich_help_panel=START)(_setup)
    app.command(name="track", rich_help_panel=START)(_track)


def _setup(
    folder: Annotated[Path, typer.Argument(help="A folder of recordings.", metavar="FOLDER")],
    page: Annotated[
        bool, typer.Option("--page/--no-page", help="Open a page, or write both files with blanks to fill in.")
    ] = True,
    port: Annotated[
        int | None, typer.Option("--port", min=0, max=65535, help="Port to serve on; 0 for any that is free.")
    ] = None,
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Whether to open a browser.")] = True,
    log: Annotated[Path | None, typer.Option("--log", help="File for messages and tracebacks.")] = None,
) -> None:
    """Create trials.csv and experiment.yaml from a folder of recordings, on a local page or with blanks to fill in."""
    with errors_as_sentences(log):
        if page:
            from vinetrack.pages.setup_server import serve

            serve(folder, typer.echo, port, browser=browser)
        else:
            from vinetrack.pages.setup_server import write_templates

            write_templates(folder, typer.echo)


def _track(
    recording: Annotated[Path, typer.Argument(help="A film, a stack, or a folder of pictures.", metavar="RECORDING")],
    capture_fps: Annotated[
        float | None, typer.Option("--capture-fps", min=1e-6, help="Frames per second at capture.", show_default=False)
    ] = None,
    exposure_us: Annotated[
        float | None, typer.Option("--exposure-us", min=0, help="Exposure of a frame, µs.", show_default=False)
    ] = None,
    mm_per_px: Annotated[
        float | None, typer.Option("--mm-per-px", min=1e-9, help="Scale, for positions in metres.", show_default=False)
    ] = None,
    calibration: Annotated[
        Path | None,
        typer.Option("--calibration", metavar="FILE", help="An experiment.yaml whose `calibration:` is the scale."),
    ] = None,
    axis: Annotated[
        str | None,
        typer.Option(
            "--axis", metavar="x,y:x,y", help="Points of the growth axis, px; more than two for a curved one."
        ),
    ] = None,
    frames: Annotated[
        str | None, typer.Option("--frames", metavar="FROM:TO", help="First and last frame to use, from 0.")
    ] = None,
    body: Annotated[bool, typer.Option("--body", help="The object moves as a whole, such as a ball.")] = False,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Output folder; default RECORDING_track.")
    ] = None,
    json_file: JsonFile = None,
    log: Annotated[Path | None, typer.Option("--log", help="File for messages and tracebacks.")] = None,
) -> None:
    """Track the leading edge of one recording, without an experiment: a table, a strip figure and a clip."""
    with errors_as_sentences(log):
        from vinetrack.core.units import or_nan
        from vinetrack.pipeline.overlays_stage import TrackOptions, track_file

        options = TrackOptions(
            capture_fps=or_nan(capture_fps), exposure_us=or_nan(exposure_us), mm_per_px=or_nan(mm_per_px),
            calibration=calibration,
            axis=_cell("axis", axis, "--axis"), frames_used=_cell("frames_used", frames, "--frames"),
            body=body, out=out,
        )  # fmt: skip
        lines: list[str] = []
        say = lines.append if json_to_terminal(json_file) else _say
        with activity_sign(f"tracking {recording.name}", log):
            content = track_file(recording, options, say)
        print_result((), content, json_file)


def _say(line: str) -> None:
    from vinetrack.core.terminal import severity_first

    typer.echo(severity_first(line))


def _cell(column: str, text: str | None, option: str) -> Any:
    """Read an option that is written like a cell of a column; None if it is not given."""
    from vinetrack.experiment.schema import COLUMNS, CellError, read_cell

    if text is None:
        return None
    try:
        return read_cell(COLUMNS[column], text)
    except CellError as error:
        raise typer.BadParameter(
            f"{text!r} {error.message}: {error.allowed or error.remedy}", param_hint=option
        ) from None
