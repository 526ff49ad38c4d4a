"""Options of the commands that have many: `options.csv` beside this file declares them, a line each.

A line holds the name of the value that the command gets, the option, its commands, kind, default, bounds and help. A
number that is not given is NaN; `per` is what it is divided by (100 for per cent). An option named after a column of
the trial sheet comes from the columns' own table and is checked like a cell of a sheet.
"""

from __future__ import annotations

import csv
import inspect
import json
import logging
import math
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from vinetrack.experiment.schema import COLUMNS, CellError, Column, option, read_cell

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


# Columns about the vine itself; all others are about the rig
_VINE_COLUMNS = frozenset(
    {"diameter_mm", "thickness_um", "length_mm", "film_density_kg_m3", "yield_pressure_kPa", "yield_pressure_sigma_kPa"}
)

# Type of an option by its kind; text for all other kinds
_TYPES: dict[str, Any] = {"number": float | None, "count": int, "path": Path | None, "flag": bool, "texts": list[str]}

_Command = Callable[..., None]


def with_options(command_name: str, columns: tuple[str, ...] = (), **meanings: str) -> Callable[[_Command], _Command]:
    """Give a command the options of the table in place of its argument `options`, a mapping of values by field. With
    `columns`, options for these columns of the trial sheet come first, and `options["cells"]` holds the given texts;
    `meanings` replaces the help of some of them. Errors are reported in sentences; `--log` holds tracebacks.
    """
    with Path(__file__).with_name("options.csv").open(encoding="utf-8", newline="") as file:
        lines = [line for line in csv.DictReader(file) if command_name in line["commands"].split()]
    parameters = [_column_parameter(COLUMNS[name], meanings.get(name, "")) for name in columns]
    parameters += [_parameter(line) for line in lines]

    def decorate(command: _Command) -> _Command:
        def called(**given: Any) -> None:
            cells = {name: text for name in columns if (text := given.pop(name)) is not None}
            options = {line["field"]: _value(line, given.pop(line["field"])) for line in lines}
            with errors_as_sentences(options.pop("log")):
                command(**given, options={**options, "cells": cells} if columns else options)

        own = [one for one in inspect.signature(command, eval_str=True).parameters.values() if one.name != "options"]
        keywords = [one.replace(kind=inspect.Parameter.KEYWORD_ONLY) for one in (*own, *parameters)]
        called.__signature__ = inspect.Signature(keywords)  # type: ignore[attr-defined]
        called.__annotations__ = {one.name: one.annotation for one in keywords}
        called.__name__, called.__doc__ = command.__name__, command.__doc__
        return called

    return decorate


def _parameter(line: Mapping[str, str]) -> inspect.Parameter:
    """Return the parameter from which Typer makes the option of a line."""
    kind, default = line["kind"], line["default"]
    bounds = {end: json.loads(line[name]) for end, name in (("min", "low"), ("max", "high")) if line[name]}
    value = json.loads(default) if default and kind in ("number", "count") else default or None
    info = typer.Option(
        line["option"],
        help=line["help"],
        metavar=line["metavar"] or None,
        rich_help_panel=line["panel"] or None,
        show_default=bool(default),
        **bounds,
    )
    return _keyword(line["field"], _TYPES.get(kind, str) | None, info, False if kind == "flag" else value)


def _column_parameter(column: Column, meaning: str) -> inspect.Parameter:
    """Return the parameter from which Typer makes the option of a column."""
    unset = "" if column.default in ("", "unknown") or column.default.startswith("required") else f" ({column.default})"
    info = typer.Option(
        option(column.name),
        help=meaning or f"{column.meaning.rstrip('.')}{unset}.",
        metavar=column.scale.metavar if column.scale else "NUMBER",
        rich_help_panel="The vine" if column.name in _VINE_COLUMNS else "The rig",
        show_default=False,
    )
    return _keyword(column.name, str | None, info, None)


def _keyword(name: str, kind: Any, info: Any, default: Any) -> inspect.Parameter:
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[kind, info])


def _value(line: Mapping[str, str], given: Any) -> Any:
    """Return the value of an option for the command."""
    if line["kind"] == "number":
        return math.nan if given is None else given / float(line["per"] or 1)
    if line["kind"] == "texts":
        return tuple(given or ())
    if line["kind"] == "choice" and given not in (None, *line["metavar"].split("|")):
        words = line["metavar"].replace("|", " nor ")
        raise typer.BadParameter(f"{given!r} is neither {words}", param_hint=line["option"])
    if line["kind"] == "column" and given is not None:
        try:
            return read_cell(COLUMNS[line["field"]], given)
        except CellError as error:
            message = f"{given!r} {error.message}: {error.allowed or error.remedy}"
            raise typer.BadParameter(message, param_hint=line["option"]) from None
    return given
