"""Bars and colour on a terminal alone, what is said of compilation, and threads of linear algebra."""

import io
import tempfile

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from vinetrack.core.terminal import progress, severity_first, waiting
from vinetrack.core.threads import in_one_blas_thread, njit
from vinetrack.dynamics.kernel import _cache_folder
from vinetrack.pipeline.stages import COMPILING, compilation_told


class Screen(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_colour_is_for_terminals_that_want_it(monkeypatch):
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.delenv("NO_COLOR", raising=False)
    assert severity_first("error: a", Screen()) == "\x1b[31;1merror\x1b[0m: a"
    assert severity_first("error: a", io.StringIO()) == "error: a"
    for name, value, wanted in (("NO_COLOR", "1", False), ("NO_COLOR", "", True), ("TERM", "dumb", False)):
        monkeypatch.setenv(name, value)
        assert ("\x1b" in severity_first("error: a", Screen())) == wanted


def test_nothing_is_shown_where_nobody_looks(capfd):
    assert list(progress(["a", "b"], "trials")) == ["a", "b"]
    with progress(2, "steps", unit="step") as bar, waiting("fitting"):
        bar.advance()
        bar.reach(2, 2, "trials")
        bar.begin("fitting the model")
        bar.reach(1, 3, "clips")
    assert capfd.readouterr() == ("", "")


def test_compilation_is_told_once_and_code_is_compiled_where_no_folder_can_be_written(monkeypatch):
    import numba

    def unwritable(cache: bool = False, **flags):
        if cache:
            raise RuntimeError("cannot cache function: no locator available")
        return plain(**flags)

    plain = numba.njit
    said: list[str] = []
    with monkeypatch.context() as folders:
        folders.setattr(numba, "njit", unwritable)
        doubled, halved = njit(nogil=True)(lambda x: 2 * x), njit()(lambda x: x / 2)
    with compilation_told(said.append):
        assert halved(doubled(3)) == 3
        assert said == [COMPILING]
    with compilation_told(said.append):
        assert doubled(4) == 8
    assert said == [COMPILING]


def test_a_model_is_kept_in_a_folder_of_ones_own_where_no_other_can_be_written(monkeypatch, tmp_path):
    (tmp_path / "file").touch()
    for name in ("VINETRACK_CACHE", "XDG_CACHE_HOME", "HOME"):
        monkeypatch.setenv(name, str(tmp_path / "file"))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    folder = _cache_folder.__wrapped__()
    assert folder.parent == tmp_path
    assert folder.stat().st_mode & 0o777 == 0o700
    monkeypatch.setenv("VINETRACK_CACHE", str(tmp_path))
    assert _cache_folder.__wrapped__() == tmp_path / "vinetrack" / "kernels"


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
