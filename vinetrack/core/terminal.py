"""What a person sees on the terminal: aligned tables with units, bars with the time left, colour where it is wanted.

Bars go to standard error and show on a terminal only; what is piped, logged or run by a workflow stays plain. Colour
is for a terminal that has not declined it (https://no-color.org).
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

PROGRESS_DELAY_S = 0.5
"""Chosen: work done within half a second needs no bar; work of two seconds shows one for most of its time."""

COLUMN_GAP = "  "
STYLE_CODES = {"bold": "1", "dim": "2", "red": "31", "green": "32", "yellow": "33", "blue": "34", "cyan": "36"}
SEVERITY_COLOURS = {"error": "red", "warning": "yellow"}

_ESCAPE_CODE = re.compile(r"\x1b\[[0-9;]*m")
_NUMBER = re.compile(
    r"[<>~≤≥≈]?\s*[+\-−±×]?\s*\d[\d.,]*(?:[eE][+\-−]?\d+)?\s*[%×]?(?:\s*±\s*[\d.,]+(?:[eE][+\-]?\d+)?)?"
)
_NO_VALUE = frozenset({"", "–", "-", "—", "nan", "open"})


def colour_wanted(stream: TextIO | None = None) -> bool:
    """Whether a stream is a terminal that wants colour.

    Parameters
    ----------
    stream : standard output if None.

    Returns
    -------
    False where NO_COLOR is set, the terminal is "dumb", or the stream is no terminal.
    """
    stream = stream or sys.stdout
    if os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb":
        return False
    return stream.isatty()


def styled(text: str, *styles: str, stream: TextIO | None = None) -> str:
    """The text in these styles (see `STYLE_CODES`) where the stream wants colour, else as it is.

    Parameters
    ----------
    text : what is printed.
    *styles : keys of `STYLE_CODES`.
    stream : where it is printed; standard output if None.

    Returns
    -------
    the text between the escape codes of the styles, or unchanged.
    """
    if not styles or not text or not colour_wanted(stream):
        return text
    return f"\x1b[{';'.join(STYLE_CODES[style] for style in styles)}m{text}\x1b[0m"


def severity_first(line: str, stream: TextIO | None = None) -> str:
    """Return a line of `format_problems` with its first word in the colour of its severity.

    Parameters
    ----------
    line : "error: …" or "warning: …"; any other line stays as it is.
    stream : where it is printed; standard output if None.

    Returns
    -------
    the line.
    """
    word, colon, message = line.partition(":")
    return (
        styled(word, SEVERITY_COLOURS[word], "bold", stream=stream) + colon + message
        if word in SEVERITY_COLOURS
        else line
    )


def width(text: str) -> int:
    """Count the columns that a text takes on a terminal: styles and combining marks none, wide characters two.

    Parameters
    ----------
    text : one line, styles included.

    Returns
    -------
    columns.
    """
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
    """Rows as lines of aligned columns: numbers to the right, words to the left.

    Parameters
    ----------
    rows : cells of each row, as many in each; what is no text is written by `str`.
    header, units : names of the columns and, on a line of their own, their units; no line where empty.
    indent : text before every line.
    align : a letter a column, `<` or `>`; by default numbers go to the right.

    Returns
    -------
    lines, without line ends.

    >>> table([("a", "1.5"), ("b", "12.0")], header=("trial", "rms"), units=("", "mm"))
    ['trial   rms', '         mm', 'a       1.5', 'b      12.0']
    """
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
    return [(indent + COLUMN_GAP.join(map(_padded, line, widths, sides))).rstrip() for line in lines]


def _padded(cell: str, columns: int, side: str) -> str:
    room = " " * (columns - width(cell))
    return room + cell if side == ">" else cell + room


def _is_numeric(cells: Sequence[str]) -> bool:
    """Whether a column holds numbers, or marks where there is none."""
    known = [cell for cell in (_ESCAPE_CODE.sub("", cell).strip() for cell in cells) if cell not in _NO_VALUE]
    return bool(known) and all(_NUMBER.fullmatch(cell) for cell in known)


class Progress(Generic[Item]):
    """A bar with the time left, or where the end is unknown the time that has gone: see `progress`."""

    def __init__(self, items: Iterable[Item] | None, total: int | None, description: str, unit: str) -> None:
        from tqdm import tqdm

        self._items = items
        known = {"bar_format": None if total is not None else "{desc}: {n_fmt} {unit} [{elapsed}{postfix}]"}
        self._bar: Any = tqdm(
            total=total,
            desc=description,
            unit=unit,
            delay=PROGRESS_DELAY_S,
            disable=not sys.stderr.isatty(),
            dynamic_ncols=True,
            leave=False,
            file=sys.stderr,
            **known,
        )

    def advance(self, count: int = 1) -> None:
        """Count steps as done.

        Parameters
        ----------
        count : steps since the last call.
        """
        self._bar.update(count)

    def reach(self, done: int) -> None:
        """Set how many steps are done in all.

        Parameters
        ----------
        done : steps since the beginning.
        """
        self._bar.update(done - self._bar.n)

    def say(self, words: str) -> None:
        """Show what is being done right now behind the bar.

        Parameters
        ----------
        words : a few words; the next call replaces them.
        """
        self._bar.set_postfix_str(words, refresh=False)

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
    """A bar on standard error, on a terminal only, for what takes longer than half a second.

    Parameters
    ----------
    work : what to go through, or how many steps there will be; where nobody knows, see `waiting`.
    description : what is being done, a word or two.
    total : how many there will be, for an iterable without a length.
    unit : what is counted, in the singular.

    Returns
    -------
    a bar: iterate over it, or use it as a context and call `advance` or `reach`.

    >>> [item for item in progress(["a", "b"], "trials")]
    ['a', 'b']
    >>> with progress(3, "effects", unit="effect") as bar:
    ...     bar.advance()
    """
    if isinstance(work, int):
        return Progress(None, work, description, unit)
    known = len(work) if total is None and isinstance(work, Sized) else total
    return Progress(work, known, description, unit)


class waiting:  # noqa: N801 - used as a context, like a function
    """Show that something goes on whose length nobody knows: a sign of life and the time that has gone.

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
            self._thread = threading.Thread(target=self._turn, daemon=True)
            self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._done.set()
        if self._thread is not None:
            self._thread.join()

    def _turn(self) -> None:
        turns = 0
        while not self._done.wait(self.STEP_S):
            turns += 1
            gone_s = turns * self.STEP_S
            if gone_s >= PROGRESS_DELAY_S:
                sign = self.SIGNS[turns % len(self.SIGNS)]
                print(f"\r{sign} {self.description} … {gone_s:.0f} s", end="", file=sys.stderr, flush=True)
        if turns * self.STEP_S >= PROGRESS_DELAY_S:
            print("\r\x1b[2K", end="", file=sys.stderr, flush=True)
