"""Terminal output: aligned tables with units, progress bars, colour.

Progress bars go to standard error and appear only on a terminal; piped or logged output stays plain. Colour is used on
a terminal unless NO_COLOR is set (https://no-color.org).
"""

from __future__ import annotations

import os
import re
import sys
import threading
import unicodedata
from collections.abc import Iterable, Iterator, Sequence, Sized
from types import TracebackType
from typing import Any, Generic, TextIO, TypeVar

Item = TypeVar("Item")

PROGRESS_DELAY_S = 0.5  # Delay before a progress bar appears (chosen)

STYLE_CODES = {"bold": "1", "dim": "2", "red": "31", "green": "32", "yellow": "33", "blue": "34", "cyan": "36"}
SEVERITY_COLOURS = {"error": "red", "warning": "yellow"}

_ESCAPE_CODE = re.compile(r"\x1b\[[0-9;]*m")
_NUMBER = re.compile(
    r"[<>~≤≥≈]?\s*[+\-−±×]?\s*\d[\d.,]*(?:[eE][+\-−]?\d+)?\s*[%×]?(?:\s*±\s*[\d.,]+(?:[eE][+\-]?\d+)?)?"
)
_NO_VALUE = frozenset({"", "–", "-", "—", "nan", "open"})


def colour_wanted(stream: TextIO | None = None) -> bool:
    """Whether to use colour on a stream."""
    stream = stream or sys.stdout
    if os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb":
        return False
    return stream.isatty()


def styled(text: str, *styles: str, stream: TextIO | None = None) -> str:
    """Apply styles to a text, if the stream uses colour."""
    if not styles or not text or not colour_wanted(stream):
        return text
    return f"\x1b[{';'.join(STYLE_CODES[style] for style in styles)}m{text}\x1b[0m"


def severity_first(line: str, stream: TextIO | None = None) -> str:
    """Return a line of `format_problems` with its first word in the colour of its severity."""
    word, colon, message = line.partition(":")
    return (
        styled(word, SEVERITY_COLOURS[word], "bold", stream=stream) + colon + message
        if word in SEVERITY_COLOURS
        else line
    )


def width(text: str) -> int:
    """Return the width of a text on a terminal: 0 for styles and combining marks, 2 for wide characters."""
    plain = _ESCAPE_CODE.sub("", text)
    return sum(
        0 if unicodedata.combining(char) else 2 if unicodedata.east_asian_width(char) in "WF" else 1 for char in plain
    )


def table(
    rows: Iterable[Sequence[object]],
    header: Sequence[str] = (),
    units: Sequence[str] = (),
    *,
    indent: str = "",
    align: str = "",
) -> list[str]:
    """Format rows as lines of aligned columns: numbers right-aligned, words left-aligned."""
    body = [[str(cell) for cell in row] for row in rows]
    above = [list(line) for line in (header, units) if line]
    lines = [*above, *body]
    if not lines:
        return []
    count = max(map(len, lines))
    lines = [line + [""] * (count - len(line)) for line in lines]
    sides = align or "".join(
        ">" if _is_numeric([line[k] for line in lines[len(above) :]]) else "<" for k in range(count)
    )
    widths = [max(width(line[k]) for line in lines) for k in range(count)]
    return [(indent + "  ".join(map(_padded, line, widths, sides))).rstrip() for line in lines]


def _padded(cell: str, columns: int, side: str) -> str:
    room = " " * (columns - width(cell))
    return room + cell if side == ">" else cell + room


def _is_numeric(cells: Sequence[str]) -> bool:
    """Whether all cells of a column are numbers or placeholders for a missing one, and at least one is a number."""
    values = [cell for cell in (_ESCAPE_CODE.sub("", cell).strip() for cell in cells) if cell not in _NO_VALUE]
    return bool(values) and all(_NUMBER.fullmatch(cell) for cell in values)


class Progress(Generic[Item]):
    """A progress bar with the remaining time, or with the elapsed time if the total is unknown; see `progress`."""

    def __init__(self, items: Iterable[Item] | None, total: int | None, description: str, unit: str) -> None:
        from tqdm import tqdm

        self._items = items
        self._bar: Any = tqdm(
            total=total,
            desc=description,
            unit=unit,
            delay=PROGRESS_DELAY_S,
            disable=not sys.stderr.isatty(),
            dynamic_ncols=True,
            leave=False,
            file=sys.stderr,
            bar_format=None if total is not None else "{desc}: {n_fmt} {unit} [{elapsed}{postfix}]",
        )

    def advance(self, count: int = 1) -> None:
        """Advance by a number of steps."""
        self._bar.update(count)

    def reach(self, done: int, total: int) -> None:
        """Set the number of completed steps, and of how many."""
        self._bar.total = total
        self._bar.update(done - self._bar.n)

    def __iter__(self) -> Iterator[Item]:
        with self:
            for element in self._items or ():
                yield element
                self.advance()

    def __enter__(self) -> Progress[Item]:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.close()


def progress(
    work: Iterable[Item] | int, description: str, *, total: int | None = None, unit: str = "trial"
) -> Progress[Item]:
    """Return a progress bar, which appears on standard error after half a second if that is a terminal."""
    if isinstance(work, int):
        return Progress(None, work, description, unit)
    count = len(work) if total is None and isinstance(work, Sized) else total
    return Progress(work, count, description, unit)


class waiting:  # noqa: N801 - used as a context, like a function
    """Context manager that shows a spinner and the elapsed time, for work of unknown length.

    >>> with waiting("compiling the model"):
    ...     pass
    """

    SIGNS = "⠋⠙⠹⠸⠼⠴⠦⠧⠇⠏"
    STEP_S = 0.1

    def __init__(self, description: str) -> None:
        self.description = description
        self._done = threading.Event()
        self._thread: threading.Thread | None = None

    def __enter__(self) -> waiting:
        if sys.stderr.isatty():
            self._thread = threading.Thread(target=self._spin, daemon=True)
            self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._done.set()
        if self._thread is not None:
            self._thread.join()

    def _spin(self) -> None:
        steps = 0
        while not self._done.wait(self.STEP_S):
            steps += 1
            elapsed_s = steps * self.STEP_S
            if elapsed_s >= PROGRESS_DELAY_S:
                sign = self.SIGNS[steps % len(self.SIGNS)]
                print(f"\r{sign} {self.description} … {elapsed_s:.0f} s", end="", file=sys.stderr, flush=True)
        if steps * self.STEP_S >= PROGRESS_DELAY_S:
            print("\r\x1b[2K", end="", file=sys.stderr, flush=True)
