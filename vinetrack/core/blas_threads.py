"""Linear algebra in one thread.

The matrices of a fit have ten to a few hundred rows: too few to be shared out. A library that does so nevertheless
keeps threads waiting for each other, which costs processor time, and far more of it where other work runs beside.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")


def in_one_blas_thread(function: Callable[P, R]) -> Callable[P, R]:
    """Decorate a function so that linear algebra in it uses one thread; afterwards as many as before."""

    @functools.wraps(function)
    def limited(*args: P.args, **kwargs: P.kwargs) -> R:
        from threadpoolctl import threadpool_limits

        with threadpool_limits(1, user_api="blas"):
            return function(*args, **kwargs)

    return limited
