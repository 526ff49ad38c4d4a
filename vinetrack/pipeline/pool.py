"""Applying a function to many trials in several processes, with a progress bar."""

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

MIN_ITEMS_FOR_POOL = 8  # Fewest items for which a second process is started (chosen)


def map_trials(
    function: Callable[[Item], Answer], items: Sequence[Item], n_workers: int, label: str
) -> Iterator[Answer]:
    """Yield `function(item)` for every item, in order, with a progress bar on a terminal. `function` and items are sent
    to other processes and must be picklable.
    """
    if n_workers < 2 or len(items) < MIN_ITEMS_FOR_POOL:
        yield from progress(map(function, items), label, total=len(items))
        return
    chunk = max(len(items) // (8 * n_workers), 1)
    with _pool(n_workers) as pool:
        yield from progress(pool.map(function, items, chunksize=chunk), label, total=len(items))


def map_unordered(function: Callable[[Item], Answer], items: Sequence[Item], n_workers: int) -> Iterator[Answer]:
    """Yield `function(item)` of every item as soon as it is ready, in any order. `function` and items are sent to other
    processes and must be picklable.
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
    """Return a pool of processes, forked on Linux, where they are ready at once, and spawned elsewhere."""
    method = "fork" if "fork" in multiprocessing.get_all_start_methods() and sys.platform == "linux" else "spawn"
    context = multiprocessing.get_context(method)
    return ProcessPoolExecutor(n_workers, mp_context=context, initializer=_end_with_parent)


def _end_with_parent() -> None:
    """End this worker when its parent process ends, even if the parent is killed. A worker waits for its next argument
    on a pipe that the other workers hold open as well: after a killed run all of them would wait forever and keep their
    memory.
    """
    parent = multiprocessing.parent_process()
    assert parent is not None

    def wait() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, name="end with the parent", daemon=True).start()
