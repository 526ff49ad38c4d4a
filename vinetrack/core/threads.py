"""Compiled loops over frames, rows or pixels in several threads; no result depends on their number."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import lru_cache
from typing import Any, TypeVar

Part = TypeVar("Part")


def available_cores() -> int:
    """Number of cores that this process may use; all where that cannot be asked (macOS, Windows)."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def thread_pool(threads: int) -> ThreadPoolExecutor:
    """Thread pool of this process, for compiled code that releases Python's lock; a forked process gets its own."""
    return _pool(os.getpid(), threads)


@lru_cache
def _pool(process: int, threads: int) -> ThreadPoolExecutor:  # noqa: ARG001
    return ThreadPoolExecutor(threads)


def njit(**flags: Any) -> Callable[[Callable[..., Any]], Any]:
    """Compile a function by numba; the compiled form is kept, unless no folder for it can be written."""
    import numba

    def compiled(function: Callable[..., Any]) -> Any:
        try:
            return numba.njit(cache=True, **flags)(function)
        except RuntimeError:
            return numba.njit(**flags)(function)

    return compiled


@contextmanager
def _one_blas_thread() -> Iterator[None]:
    from threadpoolctl import threadpool_limits

    with threadpool_limits(1, user_api="blas"):
        yield


# Decorates a function so that linear algebra in it uses one thread; afterwards as many as before. The matrices of a
# fit are too small to be shared out: threads that wait for each other cost processor time.
in_one_blas_thread = _one_blas_thread()

MOST_THREADS = 4  # Most threads of one recording (chosen)
FEWEST_PICTURES = 16  # Fewest pictures for which another thread is used (chosen)


def n_threads() -> int:
    """Number of threads that the tracking of a recording may use: 1 in a worker process, beside which others track, and
    at most OMP_NUM_THREADS, which the workflow sets to 1, since it tracks as many at a time as there are cores.
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
