"""What commands share: their arguments, errors as sentences, the spinner, the log, and settings given as JSON."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from vinetrack.experiment.settings import RunSettings


# ------------------------------------------------------------------------------
# Output of commands: lines for the user, or with `--json` the same content for a program.

START, MORE = "Start here", "More"  # Panels of the help; the first lists the commands that a new user needs

JsonFile = Annotated[
    Path | None,
    typer.Option("--json", metavar="FILE", help="Write it as JSON to this file, - for the terminal.",
                 show_default=False),
]  # fmt: skip


def json_to_terminal(json_file: Path | None) -> bool:
    """Whether JSON is printed to the terminal instead of lines."""
    from vinetrack.core.tables import STANDARD_OUTPUT

    return json_file == STANDARD_OUTPUT


def print_result(lines: Iterable[str], content: Any, json_file: Path | None) -> None:
    """Print lines, and write `content` as JSON to a file; or print it instead of the lines."""
    from vinetrack.core.tables import write_json
    from vinetrack.core.terminal import severity_first

    for line in () if json_to_terminal(json_file) else lines:
        typer.echo(severity_first(line))
    if json_file is not None:
        write_json(json_file, content)


ExperimentPath = Annotated[Path, typer.Argument(help="The experiment's folder.", metavar="EXPERIMENT")]
ResultsPath = Annotated[Path, typer.Argument(help="The results folder.", metavar="RESULTS")]
SettingsText = Annotated[str, typer.Option("--settings", help="Settings that differ from the defaults, as JSON.")]
LogPath = Annotated[Path | None, typer.Option("--log", help="File for messages and tracebacks.", show_default=False)]


def activity_sign(what: str, log: Path | None) -> AbstractContextManager[object]:
    """Show a spinner while a stage runs by hand; not in the workflow, where it has a log."""
    from vinetrack.core.terminal import waiting

    return waiting(what) if log is None else nullcontext()


def settings_from_json(text: str) -> RunSettings:
    """Settings of a run from the option `--settings`."""
    import json

    from vinetrack.experiment.settings import run_settings

    try:
        values = json.loads(text)
    except ValueError as error:
        raise typer.BadParameter(f"is not JSON ({error})", param_hint="--settings") from None
    if not isinstance(values, dict):
        raise typer.BadParameter('is not a JSON object such as {"damping": {"seed": 7}}', param_hint="--settings")
    return run_settings(values)


@contextmanager
def errors_as_sentences(log: Path | None) -> Iterator[None]:
    """Report every exception in a sentence and exit with status 1; messages and tracebacks go to the log."""
    from vinetrack.core.problems import ExperimentError, UserError, format_problems
    from vinetrack.core.tables import is_disk_full

    try:
        _log_to(log)
        yield
    except (typer.Exit, typer.BadParameter, typer.Abort):
        raise
    except ExperimentError as error:
        _exit_with("\n".join(format_problems(error.problems)))
    except KeyboardInterrupt:
        _exit_with("Stopped; finished results are kept.")
    except BrokenPipeError:
        # The reader (such as `| head`) has closed the pipe; redirect it, or Python reports the error again at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise typer.Exit(1) from None
    except Exception as error:
        if is_disk_full(error):
            _exit_with("The disk is full: free some space and run the same command again; finished results are kept.")
        logging.getLogger(__name__).exception("stopped by %s", type(error).__name__)
        if isinstance(error, UserError):
            _exit_with(str(error))
        place = f"; the traceback is in {log}" if log else "; run it again with --log FILE for the traceback"
        _exit_with(
            f"An internal error of the program, not a fault of your data ({type(error).__name__}: {error}){place}."
        )


def _exit_with(message: str) -> None:
    from vinetrack.core.terminal import severity_first

    typer.echo("\n".join(severity_first(line, sys.stderr) for line in message.splitlines()), err=True)
    raise typer.Exit(1)


def _log_to(path: Path | None) -> None:
    """Send log messages of all modules to a file only, never to the terminal."""
    handler: logging.Handler = logging.NullHandler()
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        handler = logging.FileHandler(path, mode="w", encoding="utf-8")
    logging.basicConfig(
        handlers=[handler], level=logging.INFO, format="%(asctime)s %(levelname)s %(name)s: %(message)s", force=True
    )
