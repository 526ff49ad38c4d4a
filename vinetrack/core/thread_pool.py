"""Cores of a process, and its pool of threads for compiled code that releases Python's lock."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache


@lru_cache
def available_cores() -> int:
    """Number of cores that this process may use, determined once."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # no affinity on macOS and Windows
        return os.cpu_count() or 1


def thread_pool(threads: int) -> ThreadPoolExecutor:
    """Thread pool of this process; a forked process gets its own."""
    return _pool(os.getpid(), threads)


@lru_cache
def _pool(process: int, threads: int) -> ThreadPoolExecutor:  # noqa: ARG001
    return ThreadPoolExecutor(threads)
