"""Compiled functions, and the threads of a process that run them; no result depends on their number."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import lru_cache
from typing import Any


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
