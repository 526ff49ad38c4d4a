"""Compiled loops over frames, rows or pixels in several threads; no result depends on their number."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable
from typing import TypeVar

from vinetrack.core.thread_pool import available_cores, thread_pool

Part = TypeVar("Part")

MOST_THREADS = 4  # Most threads of one recording (chosen)
FEWEST_PICTURES = 16  # Fewest pictures for which another thread is used (chosen)


def n_threads() -> int:
    """Number of threads that the tracking of a recording may use. It is 1 in a worker process, beside which others
    track other recordings, and at most OMP_NUM_THREADS where that is set: the workflow sets it to 1 for every
    recording, since it tracks as many at a time as there are cores.
    """
    if multiprocessing.parent_process() is not None:
        return 1
    stated = os.environ.get("OMP_NUM_THREADS", "")
    limit = int(stated) if stated.isdigit() and int(stated) > 0 else MOST_THREADS
    return min(available_cores(), limit, MOST_THREADS)


def in_parts(work: Callable[[int, int], Part], count: int, least: int) -> list[Part]:
    """Call `work(first, one behind the last)` for consecutive parts of a range, side by side."""
    threads = 1 if count < 2 * least else min(n_threads(), count // least)
    if threads == 1:
        return [work(0, count)]
    cuts = [count * k // threads for k in range(threads + 1)]
    others = [thread_pool(MOST_THREADS - 1).submit(work, cuts[k], cuts[k + 1]) for k in range(1, threads)]
    return [work(0, cuts[1]), *(other.result() for other in others)]
