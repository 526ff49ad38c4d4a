"""Compiled functions, and the threads of linear algebra; no result depends on their number."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from threadpoolctl import threadpool_limits

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
