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
    page: Annotated[
        bool, typer.Option("--page/--no-page", help="Open a page, or write both files with blanks to fill.")
    ] = True,
    port: Annotated[
        int | None, typer.Option("--port", min=0, max=65535, help="Port to serve on; 0 for any that is free.")
    ] = None,
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Whether to open a browser.")] = True,
    log: Annotated[Path | None, typer.Option("--log", help="File for messages and tracebacks.")] = None,
) -> None:
    """A local page that makes trials.csv and experiment.yaml of a folder of recordings, or both with blanks to fill.

    Parameters
    ----------
    folder : of recordings.
    page : whether the page is opened, or both files are written with blanks to fill.
    port : to serve on, 0 for any that is free; None looks for one.
    browser : whether a browser is opened.
    log : file for messages and tracebacks; none if None.
    """
    from vinetrack.cli.main import _sentences

    with _sentences(log):
        if page:
            from vinetrack.setup_page.page_server import serve

            serve(folder, typer.echo, port, browser=browser)
        else:
            from vinetrack.setup_page.setup_command import write_blanks

            write_blanks(folder, typer.echo)
