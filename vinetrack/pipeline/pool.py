"""The same function over many trials in a few processes, with a bar a person can follow."""

from __future__ import annotations

import multiprocessing
import os
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from typing import TypeVar

from vinetrack.core.terminal import progress

Item = TypeVar("Item")
Answer = TypeVar("Answer")

MIN_ITEMS_FOR_POOL = 8
"""Below this many items a second process costs more to start than it saves. Chosen: starting a process takes as long as
a few trials. At half small experiments take longer, at twice larger ones are not shared out."""


def map_trials(
    function: Callable[[Item], Answer], items: Sequence[Item], n_workers: int, label: str
) -> Iterator[Answer]:
    """Yield `function(item)` for every item, in order; the bar shows on a terminal only.

    `function` and items travel to other processes, so both must be picklable.

    Parameters
    ----------
    function : callable
        Applied to each item.
    items : sequence
        Arguments.
    n_workers : int
        Number of processes; below 2 all is done in this one.
    label : str
        Shown with the bar.

    Yields
    ------
    Answer
        In the order of `items`.
    """
    if n_workers < 2 or len(items) < MIN_ITEMS_FOR_POOL:
        yield from progress(map(function, items), label, total=len(items))
        return
    chunk = max(len(items) // (8 * n_workers), 1)
    with _pool(n_workers) as pool:
        yield from progress(pool.map(function, items, chunksize=chunk), label, total=len(items))


def map_unordered(function: Callable[[Item], Answer], items: Sequence[Item], n_workers: int) -> Iterator[Answer]:
    """Yield `function(item)` of every item as soon as it is there, in any order.

    `function` and items travel to other processes, so both must be picklable.

    Parameters
    ----------
    function : callable
        Applied to each item.
    items : sequence
        Arguments.
    n_workers : int
        Number of processes; below 2 all is done in this one.

    Yields
    ------
    Answer
    """
    if n_workers < 2 or len(items) < 2:
        yield from map(function, items)
        return
    with _pool(n_workers) as pool:
        futures = [pool.submit(function, argument) for argument in items]
        try:
            yield from (future.result() for future in as_completed(futures))
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def _pool(n_workers: int) -> ProcessPoolExecutor:
    """Processes that start as copies are ready at once; where the system cannot copy, they import what they need."""
    method = "fork" if "fork" in multiprocessing.get_all_start_methods() and sys.platform == "linux" else "spawn"
    context = multiprocessing.get_context(method)
    return ProcessPoolExecutor(n_workers, mp_context=context, initializer=_end_with_parent)


def _end_with_parent() -> None:
    """End this process when the one that started it ends, however it ends.

    A worker waits for its next argument on a pipe that the workers beside it hold open too: where a run is killed they
    would wait for ever, each with the memory of what it did last.
    """
    parent = multiprocessing.parent_process()
    assert parent is not None

    def wait() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, name="end with the parent", daemon=True).start()
