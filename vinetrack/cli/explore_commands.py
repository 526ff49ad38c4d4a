"""The command `vinetrack explore`."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Annotated

import typer

from vinetrack.cli.command_frame import START, errors_as_sentences
from vinetrack.core.problems import UserError

ResultsPath = Annotated[Path, typer.Argument(help="The results folder.", metavar="RESULTS")]


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    app.command("explore", rich_help_panel=START)(_explore)


def _explore(
    results: ResultsPath,
    experiment: Annotated[
        Path | None, typer.Option("--experiment", help="Where the experiment is, if it has moved.")
    ] = None,
    port: Annotated[
        int | None, typer.Option("--port", min=0, max=65535, help="Port to serve on; 0 for any that is free.")
    ] = None,
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Whether to open a browser.")] = True,
    log: Annotated[Path | None, typer.Option("--log", help="File for messages and tracebacks.")] = None,
) -> None:
    """Open a local page that shows where the model fails, to try effects, refit, and compare errors."""
    with errors_as_sentences(log):
        if importlib.util.find_spec("bokeh") is None:
            raise UserError("The page needs bokeh, which is not installed: pip install 'vinetrack[explorer]'.")
        from vinetrack.pages.explorer_server import explore

        explore(results, experiment, typer.echo, port, browser=browser)
