"""Compiled functions, and the threads of linear algebra; no result depends on their number."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from threadpoolctl import threadpool_limits


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
    with threadpool_limits(1, user_api="blas"):
        yield


# Decorates a function so that linear algebra in it uses one thread; afterwards as many as before. The matrices of a
# fit are too small to be shared out: threads that wait for each other cost processor time.
in_one_blas_thread = _one_blas_thread()
