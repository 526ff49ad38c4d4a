"""What every command has in common: arguments and options from a table, errors as sentences, output as lines or JSON.

A line of `options.csv` beside this file holds the name of the value that the command gets, the option (blank for an
argument), its commands, kind, default, bounds and help. A number that is not given is NaN; `per` is what it is divided
by (100 for per cent). An option named after a column of the trial sheet comes from the columns' own table and is
checked like a cell of a sheet.
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
from contextlib import contextmanager, nullcontext
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Any

import typer

from vinetrack.core.problems import ExperimentError, InputError, UserError, format_problems
from vinetrack.core.tables import STANDARD_OUTPUT, is_disk_full, write_json
from vinetrack.core.terminal import waiting
from vinetrack.experiment.schema import COLUMNS, Column, option

# ------------------------------------------------------------------------------
# Output of commands: lines for the user, or with `--json` the same content for a program.

START, MORE = "Start here", "More"  # Panels of the help; the first lists the commands that a new user needs


@contextmanager
def errors_as_sentences(log: Path | None) -> Iterator[None]:
    """Report every exception in a sentence and exit with status 1; messages and tracebacks go to the log."""
    try:
        _log_to(log)
        yield
    except (typer.Exit, typer.BadParameter, typer.Abort):
        raise
    except ExperimentError as error:
        _exit_with("\n".join(format_problems(error.problems)), "")
    except KeyboardInterrupt:
        _exit_with("Stopped; finished results are kept.", "")
    except BrokenPipeError:
        # The reader (such as `| head`) has closed the pipe; redirect it, or Python reports the error again at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise typer.Exit(1) from None
    except Exception as error:
        if is_disk_full(error):
            _exit_with("the disk is full: free some space and run the same command again; finished results are kept.")
        logging.getLogger(__name__).exception("stopped by %s", type(error).__name__)
        if isinstance(error, OSError) and error.strerror and (place := error.filename2 or error.filename):
            _exit_with(f"{place}: {error.strerror[:1].lower()}{error.strerror[1:]}: name another file or folder.")
        if isinstance(error, UserError):
            _exit_with(str(error))
        place = f"; the traceback is in {log}" if log else "; run it again with --log FILE for the traceback"
        _exit_with(f"internal error of the program, not a fault of your data ({type(error).__name__}: {error}){place}")


def _print_line(line: str, err: bool = False) -> None:
    """Print a line; on a terminal that wants colours, errors and warnings have theirs."""
    colour = {"error": "red", "warning": "yellow"}.get(line.partition(":")[0])
    typer.secho(line, fg=None if os.environ.get("NO_COLOR") else colour, err=err)


def _exit_with(message: str, severity: str = "error: ") -> None:
    for line in f"{severity}{message}".splitlines():
        _print_line(line, err=True)
    raise typer.Exit(1)


def _log_to(path: Path | None) -> None:
    """Send log messages of all modules to a file only, never to the terminal."""
    logging.basicConfig(handlers=[logging.NullHandler()], level=logging.INFO, force=True)
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = logging.FileHandler(path, mode="w", encoding="utf-8")
        file.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
        logging.getLogger().addHandler(file)


# Type of an option by its kind; text for all other kinds
_TYPES: dict[str, Any] = {"number": float, "count": int, "flag": bool, "texts": list[str]}
_TYPES |= dict.fromkeys(("path", "picture"), Path)

# What a command returns: lines, the same content for a program, and whether it found a fault, by default not
Answer = tuple[Iterable[str], Any] | tuple[Iterable[str], Any, bool]
_Command = Callable[..., Answer | None]


def command(
    lines_of: str = "", columns: tuple[str, ...] = (), **meanings: str
) -> Callable[[_Command], Callable[..., None]]:
    """Give a function the arguments and options that the table states for its name (or `lines_of`), report its errors
    in sentences, and print the lines that it returns, or the content beside them as JSON.

    The function gets by name what it has parameters for, and the rest as a mapping `options` if it has that; `report`
    shows a step on a terminal, and `say` prints a line while it works. With `columns`, options for these columns of the
    trial sheet come first, and `options["cells"]` holds the given texts; `meanings` replaces the help of some of them.
    """

    def decorate(function: _Command) -> Callable[..., None]:
        wanted = inspect.signature(function).parameters
        table = _table(lines_of or function.__name__.strip("_"))

        def called(**given: Any) -> None:
            cells = {name: text for name in columns if (text := given.pop(name)) is not None}
            values = {line["field"]: _value(line, given[line["field"]]) for line in table}
            log, json_file = values.pop("log", None), values.get("json")
            with errors_as_sentences(log):
                tools: dict[str, Any] = {"say": partial(_print_line, err=json_file == STANDARD_OUTPUT)}
                on_terminal: Any = waiting("starting") if "report" in wanted and sys.stderr.isatty() else nullcontext()
                with on_terminal as bar:
                    tools["report"] = lambda step: bar and bar.update(bar.task_ids[0], description=step)
                    named = {name: value for name, value in {**values, **tools}.items() if name in wanted}
                    if "options" in wanted:
                        options = {name: value for name, value in values.items() if name not in {*wanted, "json"}}
                        named["options"] = {**options, "cells": cells} if columns else options
                    answer = function(**named)
                if answer is not None:
                    lines, content, *failed = answer
                    for text in () if json_file == STANDARD_OUTPUT else lines:
                        _print_line(text)
                    if json_file is not None and content is not None:
                        write_json(json_file, content)
                    if any(failed):
                        raise typer.Exit(1)

        parameters = [_column_parameter(COLUMNS[name], meanings.get(name, "")) for name in columns]
        parameters += [_parameter(line) for line in table]
        called.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        called.__annotations__ = {one.name: one.annotation for one in parameters}
        called.__name__, called.__doc__ = function.__name__, function.__doc__
        return called

    return decorate


@cache
def _table(command_name: str) -> list[dict[str, str]]:
    """The lines of `options.csv` for a command."""
    with Path(__file__).with_name("options.csv").open(encoding="utf-8", newline="") as file:
        return [line for line in csv.DictReader(file) if command_name in line["commands"].split()]


def _parameter(line: Mapping[str, str]) -> inspect.Parameter:
    """Return the parameter from which Typer makes the argument or option of a line."""
    kind, default = line["kind"], line["default"]
    bounds = {end: json.loads(line[name]) for end, name in (("min", "low"), ("max", "high")) if line[name]}
    value = json.loads(default) if kind in ("number", "count", "flag") and default else default or None
    value = False if kind == "flag" and not default else None if value == "null" else value
    said: dict[str, Any] = {"help": line["help"], "metavar": line["metavar"] or None}
    said["show_default"] = value is not None and value is not False
    required = not line["option"] and not default and kind != "texts"
    if line["option"]:
        info = typer.Option(line["option"], rich_help_panel=line["panel"] or None, **said, **bounds)
    else:
        info = typer.Argument(**said)
    type_ = _TYPES.get(kind, str)
    return _keyword(
        line["field"], type_ if required else type_ | None, info, inspect.Parameter.empty if required else value
    )


def _column_parameter(column: Column, meaning: str) -> inspect.Parameter:
    """Return the parameter from which Typer makes the option of a column."""
    unset = "" if column.default in ("", "unknown") or column.default.startswith("required") else f" ({column.default})"
    of_vine = ("diameter_", "thickness_", "length_", "film_density_", "yield_pressure_")
    info = typer.Option(
        option(column.name),
        help=meaning or f"{column.meaning.rstrip('.')}{unset}.",
        metavar=(column.unit_key or "number").upper(),
        rich_help_panel="The vine" if column.name.startswith(of_vine) else "The rig",
        show_default=False,
    )
    return _keyword(column.name, str | None, info, None)


def _keyword(name: str, kind: Any, info: Any, default: Any) -> inspect.Parameter:
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[kind, info])


def _value(line: Mapping[str, str], given: Any) -> Any:
    """Return the value of an option for the command."""
    kind = line["kind"]
    if kind == "number":
        return math.nan if given is None else given / float(line["per"] or 1)
    if kind == "texts":
        return tuple(given or ())
    if kind == "picture" and given is not None and given.suffix.lower() not in (".png", ".svg", ".pdf"):
        raise _refused(line, f"'{given}' is not the name of a picture: end it in .png, .svg or .pdf")
    if kind == "column" and given is not None:
        try:
            return COLUMNS[line["field"]].read(given)
        except InputError as error:
            raise _refused(line, f"{given!r} {error.message}: {error.allowed or error.remedy}") from None
    if kind in ("list", "object") and given is not None:
        try:
            content = json.loads(given)
        except ValueError as error:
            raise _refused(line, f"is not JSON ({error})") from None
        type_, example = (list, '["t1", "t2"]') if kind == "list" else (dict, '{"damping": {"seed": 7}}')
        if not isinstance(content, type_):
            raise _refused(line, f"is not a JSON {kind} such as {example}")
        return content
    return given


def _refused(line: Mapping[str, str], message: str) -> typer.BadParameter:
    return typer.BadParameter(message, param_hint=line["option"])
