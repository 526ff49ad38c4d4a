"""Options shared by the commands about new vines."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from vinetrack.experiment.schema import COLUMNS, Column, option

VINE, RIG, INPUTS, OUT = "The vine", "The rig", "Inputs of the model", "Output files"


# Columns about the vine itself; all others are about the rig
_VINE_COLUMNS = frozenset(
    {"diameter_mm", "thickness_um", "length_mm", "film_density_kg_m3", "yield_pressure_kPa", "yield_pressure_sigma_kPa"}
)

YIELD_MEANING = "Yield pressure; a scaling prior if not given."

_Command = Callable[..., None]


def column_options(*columns: str, meanings: Mapping[str, str] | None = None) -> Callable[[_Command], _Command]:
    """Give a command an option for each of these columns of the trial sheet, in place of its argument `cells`. The
    command is called with `cells`, the given texts by column, which are checked like cells of a sheet. Returns
    decorator.
    """
    help_texts = meanings or {}
    options = [_column_option(COLUMNS[name], help_texts.get(name)) for name in columns]

    def decorate(command: _Command) -> _Command:
        @functools.wraps(command)
        def with_cells(**arguments: Any) -> None:
            texts = {name: arguments.pop(name) for name in columns}
            command(cells={name: text for name, text in texts.items() if text is not None}, **arguments)

        signature = inspect.signature(command, eval_str=True)
        parameters = []
        for parameter in signature.parameters.values():
            parameters += options if parameter.name == "cells" else [parameter]
        keywords = [parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY) for parameter in parameters]
        with_cells.__signature__ = signature.replace(parameters=keywords)  # type: ignore[attr-defined]
        with_cells.__annotations__ = {parameter.name: parameter.annotation for parameter in keywords}
        del with_cells.__wrapped__
        return with_cells

    return decorate


def _column_option(column: Column, meaning: str | None) -> inspect.Parameter:
    """Return the parameter of a command from which Typer makes the option of a column."""
    unset = "" if column.default in ("", "unknown") or column.default.startswith("required") else f" ({column.default})"
    info = typer.Option(
        option(column.name),
        help=meaning or f"{column.meaning.rstrip('.')}{unset}.",
        metavar=column.scale.metavar if column.scale else "NUMBER",
        rich_help_panel=VINE if column.name in _VINE_COLUMNS else RIG,
        show_default=False,
    )
    return inspect.Parameter(
        column.name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=Annotated[str | None, info]
    )


Results = Annotated[
    Path | None,
    typer.Option(
        "--fit", help="Results folder whose fit gives the inputs.", metavar="RESULTS", rich_help_panel=INPUTS,
        show_default=False,
    ),
]  # fmt: skip
Damping = Annotated[
    float | None,
    typer.Option("--B", min=1e-9, help="Damping coefficient, N·(s/m)ⁿ; a prior if not given.", rich_help_panel=INPUTS,
                 show_default=False),
]  # fmt: skip
DampingError = Annotated[
    float, typer.Option("--B-error", min=0, max=200, help="Standard error of B, per cent.", rich_help_panel=INPUTS)
]
Exponent = Annotated[
    float | None,
    typer.Option("--n", min=0, max=2, help="Damping exponent.", rich_help_panel=INPUTS, show_default=False),
]
ExponentError = Annotated[
    float, typer.Option("--n-error", min=0, max=1, help="Standard error of n.", rich_help_panel=INPUTS)
]
Effects = Annotated[
    list[str] | None,
    typer.Option(
        "--effect", metavar="NAME[=SIZE]", rich_help_panel=INPUTS, show_default=False,
        help="A further effect; its size as a number, or a range such as 1:1.4. May be repeated.",
    ),
]  # fmt: skip
Samples = Annotated[
    int, typer.Option("--samples", min=50, max=100_000, help="Number of draws.", rich_help_panel=INPUTS)
]
Seed = Annotated[int, typer.Option("--seed", min=0, help="Seed of the random numbers.", rich_help_panel=INPUTS)]
AtFraction = Annotated[
    float,
    typer.Option(
        "--final-at-fraction",
        min=0.05,
        max=0.99,
        help="y/L at which final speeds are evaluated.",
        rich_help_panel=INPUTS,
    ),
]
Anyway = Annotated[
    bool,
    typer.Option(
        "--anyway", help="Predict from a fit whose model the diagnosis refuted, too; the output states it.",
        rich_help_panel=INPUTS,
    ),
]  # fmt: skip
FigurePath = Annotated[
    Path | None, typer.Option("--figure", help="Draw a figure to this file.", rich_help_panel=OUT, show_default=False)
]
LogPath = Annotated[Path | None, typer.Option("--log", help="File for messages and tracebacks.", rich_help_panel=OUT)]


def say(lines: Iterable[str]) -> None:
    """Print lines."""
    for line in lines:
        typer.echo(line)
