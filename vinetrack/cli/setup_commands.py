"""The command `vinetrack setup`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vinetrack.cli.output import START


def register(app: typer.Typer) -> None:
    """Add the command to the command line.

    Parameters
    ----------
    app : the command line.
    """
    app.command(name="setup", rich_help_panel=START)(setup)


def setup(
    folder: Annotated[Path, typer.Argument(help="A folder of recordings.", metavar="FOLDER")],
    log: Annotated[Path | None, typer.Option("--log", help="File for messages and tracebacks.")] = None,
) -> None:
    """Make trials.csv and experiment.yaml of a folder of recordings, with blanks to fill.

    Parameters
    ----------
    folder : of recordings.
    log : file for messages and tracebacks; none if None.
    """
    from vinetrack.cli.main import _sentences

    with _sentences(log):
        from vinetrack.setup_page.setup_command import write_blanks

        write_blanks(folder, typer.echo)
