"""How the program runs: what it shows, its compiled functions, and the threads of linear algebra.

Tables are aligned, with units; progress is drawn by rich on standard error, and only on a terminal: piped or logged
output stays plain. A notebook shows tables and figures. No result depends on the number of threads.
"""

from __future__ import annotations

import html
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from itertools import repeat, zip_longest
from typing import TYPE_CHECKING, Any, TypeVar, cast

from threadpoolctl import threadpool_limits

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from rich.progress import Progress


Item = TypeVar("Item")


def table(
    rows: Iterable[Sequence[object]],
    header: Sequence[str] = (),
    units: Sequence[str] = (),
    *,
    indent: str = "",
    align: str = "",
) -> list[str]:
    """Format rows as lines of aligned columns; `align` is `<` or `>` for each, by default all are left-aligned."""
    from rich.cells import cell_len

    lines = [*(line for line in (header, units) if line), *(map(str, row) for row in rows)]
    columns = []
    for side, column in zip(align or repeat("<"), zip_longest(*lines, fillvalue=""), strict=False):
        width = max(map(cell_len, column))
        rooms = [" " * (width - cell_len(cell)) for cell in column]
        columns.append([room + cell if side == ">" else cell + room for room, cell in zip(rooms, column, strict=True)])
    return [(indent + "  ".join(line)).rstrip() for line in zip(*columns, strict=True)]


@contextmanager
def waiting(description: str) -> Iterator[Progress]:
    """A bar for work of unknown length, with the elapsed time."""
    from rich import progress as rich
    from rich.console import Console

    columns = (rich.SpinnerColumn(), "{task.description}", rich.BarColumn(), rich.MofNCompleteColumn())
    screen = Console(stderr=True, markup=False, emoji=False, highlight=False)
    times = rich.TimeElapsedColumn(), rich.TimeRemainingColumn(compact=True)
    with rich.Progress(*columns, *times, console=screen, transient=True, disable=not sys.stderr.isatty()) as bar:
        bar.add_task(description, total=None)
        yield bar


def progress(items: Sequence[Item] | Iterator[Item], description: str, total: int | None = None) -> Iterator[Item]:
    """Yield items, and show how many are done; `total` is their number if they are no sequence."""
    with waiting(description) as bar:
        yield from bar.track(items, total, task_id=bar.task_ids[0])


class Printed:
    """What a notebook shows as it is printed."""

    def _repr_html_(self) -> str:
        return f"<pre>{html.escape(str(self))}</pre>"


class Drawn:
    """What the report has figures of; they are made in a room above, imported when one is requested."""

    def plot(self, name: str = "", **options: Any) -> Figure:
        """Return a figure of the report by its name; blank for the main one."""
        return cast("Figure", import_module("vinetrack.interface").figure_of(self, name, **options))


THREAD_PREFIX = "vinetrack-"  # Prefix of the names of a page's threads that need not finish before the process exits


def njit(**flags: Any) -> Callable[[Callable[..., Any]], Any]:
    """Compile a function by numba; the compiled form is kept, unless no folder for it can be written."""
    import numba

    def compiled(function: Callable[..., Any]) -> Any:
        try:
            return numba.njit(cache=True, **flags)(function)
        except RuntimeError:
            return numba.njit(**flags)(function)

    return compiled


# Decorates a function so that linear algebra in it uses one thread; afterwards as many as before. The matrices of a
# fit are too small to be shared out: threads that wait for each other cost processor time.
in_one_blas_thread = threadpool_limits.wrap(1, user_api="blas")
