"""The command `vinetrack campaign`: sequential looks at a growing set of trials, with a stopping rule."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vinetrack.cli.command_frame import MORE, JsonFile, errors_as_sentences, print_result


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    app.command("campaign", rich_help_panel=MORE)(_campaign)


def _campaign(
    target: Annotated[
        Path, typer.Argument(help="A results folder, or an experiment of measured tracks.", metavar="TARGET")
    ],
    risk: Annotated[
        float | None,
        typer.Option("--risk", min=1e-6, max=0.5, show_default=False,
                     help="Risk of stopping with a wrong effect, stated at the first look; default 0.03."),
    ] = None,
    experiment: Annotated[
        Path | None, typer.Option("--experiment", help="The experiment, if it has moved.", show_default=False)
    ] = None,
    json_file: JsonFile = None,
    log: Annotated[Path | None, typer.Option("--log", help="File for messages and tracebacks.",
                                             show_default=False)] = None,
) -> None:  # fmt: skip
    """Look at a running campaign: verdict, next trials, and whether it may stop at the stated risk."""
    with errors_as_sentences(log):
        from vinetrack.pipeline.sequence_stage import ledger_lines, look_at_folder

        ledger = look_at_folder(target, risk, experiment)
        print_result(ledger_lines(ledger), ledger.to_json(), json_file)
