"""What commands print: lines for a person, or with `--json` the same for a program."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import typer

START, MORE = "Start here", "More"
"""Panels of the help: the commands that one needs stand first."""

JsonFile = Annotated[
    Path | None,
    typer.Option("--json", metavar="FILE", help="Write it as JSON to this file, - for the terminal.",
                 show_default=False),
]  # fmt: skip


def json_to_terminal(json_file: Path | None) -> bool:
    """Whether JSON goes to the terminal in place of lines.

    Parameters
    ----------
    json_file : of the option `--json`.

    Returns
    -------
    bool
    """
    from vinetrack.core.tables import STANDARD_OUTPUT

    return json_file == STANDARD_OUTPUT


def print_result(lines: Iterable[str], content: Any, json_file: Path | None) -> None:
    """Print lines, or `content` as JSON; into a file beside the lines, or in their place on the terminal.

    Parameters
    ----------
    lines : for a person.
    content : the same for a program: mappings, lists, numbers, text and paths.
    json_file : of the option `--json`; None for lines alone.
    """
    from vinetrack.core.tables import write_json
    from vinetrack.core.terminal import severity_first

    for line in () if json_to_terminal(json_file) else lines:
        typer.echo(severity_first(line))
    if json_file is not None:
        write_json(json_file, content)
