"""Terminal output: aligned tables with units, progress bars, colour; and tables and figures in a notebook.

Progress is drawn by rich on standard error, and only on a terminal; piped or logged output stays plain. Colour is used
on a terminal unless NO_COLOR is set (https://no-color.org).
"""

from __future__ import annotations

import html
import os
import re
import sys
from collections.abc import Iterable, Iterator, Sequence
from importlib import import_module
from itertools import zip_longest
from typing import TYPE_CHECKING, Any, Generic, TextIO, TypeVar

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Item = TypeVar("Item")


def severity_first(line: str, stream: TextIO) -> str:
    """Return a line of `format_problems` with its first word in the colour of its severity."""
    word, colon, message = line.partition(":")
    colours = {"error": "31", "warning": "33"}  # Red and yellow, as codes of a terminal
    plain = os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb" or not stream.isatty()
    if plain or word not in colours:
        return line
    return f"\x1b[{colours[word]};1m{word}\x1b[0m{colon}{message}"


def table(
    rows: Iterable[Sequence[object]],
    header: Sequence[str] = (),
    units: Sequence[str] = (),
    *,
    indent: str = "",
    align: str = "",
) -> list[str]:
    """Format rows as lines of aligned columns: numbers right-aligned, words left-aligned."""
    from rich.cells import cell_len

    above = [line for line in (header, units) if line]
    columns = list(zip_longest(*above, *(map(str, row) for row in rows), fillvalue=""))
    for i, column in enumerate(columns):
        side = align[i] if align else ">" if _is_numeric(column[len(above) :]) else "<"
        width = max(map(cell_len, column))
        rooms = [" " * (width - cell_len(cell)) for cell in column]
        columns[i] = tuple(
            room + cell if side == ">" else cell + room for room, cell in zip(rooms, column, strict=True)
        )
    return [(indent + "  ".join(line)).rstrip() for line in zip(*columns, strict=True)]


def _is_numeric(cells: Sequence[str]) -> bool:
    """Whether all cells of a column are numbers or placeholders for a missing one, and at least one is a number."""
    values = [cell for cell in map(str.strip, cells) if cell not in ("", "–", "-", "—", "nan", "open")]
    number = r"[<>~≤≥≈]?\s*[+\-−±×]?\s*\d[\d.,]*(?:[eE][+\-−]?\d+)?\s*[%×]?(?:\s*±\s*[\d.,]+(?:[eE][+\-]?\d+)?)?"
    return bool(values) and all(re.fullmatch(number, cell) for cell in values)


class Progress(Generic[Item]):
    """A bar with the time left, or a spinner for work of unknown length; on standard error, if that is a terminal."""

    def __init__(self, work: Sequence[Item] | int | None, description: str, unit: str = "trial") -> None:
        from rich import progress as rich
        from rich.console import Console

        self._items: Sequence[Item] = () if isinstance(work, int | None) else work
        total = work if isinstance(work, int | None) else len(work)
        self._spinner = (rich.SpinnerColumn(), "{task.description} … {task.elapsed:.0f} s")
        amount = (rich.BarColumn(), rich.MofNCompleteColumn(), unit, rich.TimeRemainingColumn(compact=True), "left")
        self._count = ("{task.description}:", *amount)
        screen = Console(stderr=True, markup=False, emoji=False, highlight=False)
        columns = self._spinner if total is None else self._count
        self._bar = rich.Progress(*columns, console=screen, transient=True, disable=not sys.stderr.isatty())
        self._task = self._bar.add_task(description, total=total)

    def advance(self, count: int = 1) -> None:
        """Advance by a number of steps."""
        self._bar.advance(self._task, count)

    def begin(self, description: str) -> None:
        """Show other work, of unknown length until `reach` says more."""
        self._bar.remove_task(self._task)
        self._bar.columns = self._spinner
        self._task = self._bar.add_task(description, total=None)

    def reach(self, done: int, total: int, what: str) -> None:
        """Set the number of completed steps, of how many, and of what."""
        self._bar.columns = self._count
        self._bar.update(self._task, completed=done, total=total, description=what)

    def __iter__(self) -> Iterator[Item]:
        with self:
            for element in self._items:
                yield element
                self.advance()

    def __enter__(self) -> Progress[Item]:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()


progress = Progress


def waiting(description: str) -> Progress[None]:
    """Return a spinner with the elapsed time, for work of unknown length."""
    return Progress(None, description, unit="")


def html_table(head: Sequence[str], rows: Sequence[Sequence[str]], title: str = "", notes: Sequence[str] = ()) -> str:
    """Return a table as HTML with all text escaped."""
    above = f"<p><b>{html.escape(title)}</b></p>" if title else ""
    names = "".join(f"<th>{html.escape(name)}</th>" for name in head)
    body = "".join("<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    table = f"<table><thead><tr>{names}</tr></thead><tbody>{body}</tbody></table>" if rows else ""
    return above + table + "".join(f"<p>{html.escape(note)}</p>" for note in notes)


def plot(shown: Any, name: str = "", **options: Any) -> Figure:
    """Draw an object as in the report; figures are made in a room above, imported when one is requested."""
    figure: Figure = import_module("vinetrack.interface.loaded").figure_of(shown, name, **options)
    return figure
