"""The command line, which starts quickly and prints no tracebacks.

A problem of the input is reported in one sentence; an internal error in one sentence that names the log with the
traceback.
"""

from __future__ import annotations

import gc
import logging
import os
import sys
import threading
from contextlib import suppress
from typing import Annotated

import typer

from vinetrack.cli.commands import new_app, register

app = new_app(
    "vinetrack",
    "From recordings of everting vine robots to the physics that a model of them lacks.\n\n"
    "Three commands do most: vinetrack setup FOLDER, vinetrack run FOLDER, vinetrack explore RESULTS.",
)


def main() -> None:
    """Entry of the `vinetrack` command."""
    gc.set_threshold(100_000, 50, 50)  # the usual 700, 10, 10 cost a twentieth of the processor time (measured)
    try:
        app()
    except SystemExit as ending:
        _exit_despite_threads(ending.code)
        raise


def _exit_despite_threads(status: str | int | None) -> None:
    """Exit immediately if a thread of a page is still fitting or tracking. At a normal exit the interpreter may stop
    such a thread within compiled code, which sometimes aborts the process (status -6). Files are written atomically, so
    nothing is lost by not waiting.
    """
    from vinetrack.core.threads import THREAD_PREFIX

    if isinstance(status, str) or not any(thread.name.startswith(THREAD_PREFIX) for thread in threading.enumerate()):
        return
    logging.shutdown()
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):
            stream.flush()
    os._exit(status or 0)


def _show_version(wanted: bool) -> None:
    if wanted:
        import vinetrack

        typer.echo(f"vinetrack {vinetrack.__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """See the commands below."""


register(app)


if __name__ == "__main__":
    main()
