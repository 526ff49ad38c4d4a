"""Terminal output: aligned tables with units, progress bars, colour.

Progress is drawn by rich on standard error, and only on a terminal; piped or logged output stays plain. Colour is used
on a terminal unless NO_COLOR is set (https://no-color.org).
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Generic, TextIO, TypeVar

if TYPE_CHECKING:
    from rich.progress import ProgressColumn

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

    body = [[str(cell) for cell in row] for row in rows]
    above = [list(line) for line in (header, units) if line]
    lines = [*above, *body]
    count = max(map(len, lines), default=0)
    lines = [line + [""] * (count - len(line)) for line in lines]
    columns = list(zip(*lines, strict=True))
    sides = align or "".join(">" if _is_numeric(column[len(above) :]) else "<" for column in columns)
    widths = [max(map(cell_len, column)) for column in columns]

    def padded(cell: str, width: int, side: str) -> str:
        room = " " * (width - cell_len(cell))
        return room + cell if side == ">" else cell + room

    return [(indent + "  ".join(map(padded, line, widths, sides))).rstrip() for line in lines]


def _is_numeric(cells: Sequence[str]) -> bool:
    """Whether all cells of a column are numbers or placeholders for a missing one, and at least one is a number."""
    values = [cell for cell in map(str.strip, cells) if cell not in ("", "–", "-", "—", "nan", "open")]
    number = r"[<>~≤≥≈]?\s*[+\-−±×]?\s*\d[\d.,]*(?:[eE][+\-−]?\d+)?\s*[%×]?(?:\s*±\s*[\d.,]+(?:[eE][+\-]?\d+)?)?"
    return bool(values) and all(re.fullmatch(number, cell) for cell in values)


class Progress(Generic[Item]):
    """A bar with the time left, or a spinner; on standard error, if that is a terminal."""

    def __init__(self, items: Iterable[Item], total: int | None, description: str, unit: str = "") -> None:
        from rich import progress as rich
        from rich.console import Console

        def text(content: str) -> ProgressColumn:
            return rich.TextColumn(content, markup=False)

        def where(is_known: bool, column: ProgressColumn) -> ProgressColumn:
            """Show a column only where the number of steps is known, or only where it is not."""
            shown = column.render
            column.render = lambda task: shown(task) if (task.total is not None) == is_known else ""  # type: ignore[method-assign]
            return column

        amount = [text("{task.description}:"), rich.BarColumn(), rich.MofNCompleteColumn(), text(unit)]
        amount += [rich.TimeRemainingColumn(compact=True), text("left")]
        columns = [where(False, rich.SpinnerColumn()), where(False, text("{task.description} … {task.elapsed:.0f} s"))]
        columns += [where(True, column) for column in amount]
        self._items = items
        screen = Console(stderr=True)
        self._bar = rich.Progress(*columns, console=screen, transient=True, disable=not sys.stderr.isatty())
        self._task = self._bar.add_task(description, total=total)

    def advance(self, count: int = 1) -> None:
        """Advance by a number of steps."""
        self._bar.advance(self._task, count)

    def begin(self, description: str) -> None:
        """Show other work, of unknown length until `reach` says more."""
        self._bar.remove_task(self._task)
        self._task = self._bar.add_task(description, total=None)

    def reach(self, done: int, total: int, what: str) -> None:
        """Set the number of completed steps, of how many, and of what."""
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


def progress(work: Sequence[Item] | int, description: str, unit: str = "trial") -> Progress[Item]:
    """Return a progress bar over the elements of `work`, or over a number of steps."""
    if isinstance(work, int):
        return Progress((), work, description, unit)
    return Progress(work, len(work), description, unit)


def waiting(description: str) -> Progress[None]:
    """Return a spinner with the elapsed time, for work of unknown length."""
    return Progress((), None, description)
