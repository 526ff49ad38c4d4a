"""Linear algebra of fits uses one thread, and gives the others back."""

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from vinetrack.core.threads import in_one_blas_thread


def threads() -> set[int]:
    """Numbers of threads of the loaded libraries of linear algebra."""
    return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}


def test_threads_are_limited_within_a_function_only():
    np.ones((2, 2)) @ np.ones((2, 2))

    @in_one_blas_thread
    def asked(text: str, *, fails: bool = False) -> tuple[str, set[int]]:
        if fails:
            raise ValueError(text)
        return text, threads()

    with threadpool_limits(2, user_api="blas"):
        before = threads()
        assert asked("kept") == ("kept", {1})
        with pytest.raises(ValueError, match="kept"):
            asked("kept", fails=True)
        assert threads() == before
    assert asked.__name__ == "asked"
