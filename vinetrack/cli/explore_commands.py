"""The command `vinetrack explore`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vinetrack.cli.command_frame import START, errors_as_sentences

ResultsPath = Annotated[Path, typer.Argument(help="The results folder.", metavar="RESULTS")]
Names = Annotated[list[str] | None, typer.Option("--add", help="Add this effect (may be repeated).")]
Drops = Annotated[list[str] | None, typer.Option("--drop", help="Remove this effect (may be repeated).")]
Sizes = Annotated[
    list[str] | None,
    typer.Option("--set", help="A size, NAME=VALUE in SI units, such as air_drag.C_D=0.8 (may be repeated)."),
]
Exports = Annotated[
    list[Path] | None,
    typer.Option("--export", help="Write curves (.csv) or figure (.svg, .png, .pdf) without opening a page."),
]


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    app.command("explore", rich_help_panel=START)(_explore)


def _explore(
    results: ResultsPath,
    add: Names = None,
    drop: Drops = None,
    sizes: Sizes = None,
    refit: Annotated[bool, typer.Option("--refit", help="Fit, print the result, and open no page.")] = False,
    export: Exports = None,
    save: Annotated[bool, typer.Option("--save", help="Write the model to experiment.yaml; opens no page.")] = False,
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
        from vinetrack.explorer.server import ExploreOptions, explore

        options = ExploreOptions(add or (), drop or (), sizes or (), refit, export or (), save, port, browser)
        explore(results, experiment, options, typer.echo)
