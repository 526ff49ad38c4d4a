"""Output of commands: lines for the user, or with `--json` the same content for a program."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import typer

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
