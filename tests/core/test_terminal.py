"""What people read: units and numbers, bars on a terminal, compilation; and threads of linear algebra."""

import math
import tempfile

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from vinetrack.core.terminal import progress, waiting
from vinetrack.core.threads import in_one_blas_thread, njit
from vinetrack.core.units import UNITS, convert, interval, number, split_unit, with_error, with_interval
from vinetrack.dynamics.kernel import _cache_folder
from vinetrack.pipeline.stages import COMPILING, compilation_told


def test_nothing_is_shown_where_nobody_looks(capfd):
    assert list(progress(["a", "b"], "trials")) == ["a", "b"]
    with waiting("fitting") as bar:
        bar.update(bar.task_ids[0], completed=1, total=3, description="clips")
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


def test_inches_pounds_and_psi_are_exact_by_definition():
    assert convert(1, "in", "mm") == convert(1000, "mil", "mm") == 25.4
    assert split_unit("film_density_g_cm3") == ("film_density", "g_cm3")
    assert convert(1, "ft", "in") == pytest.approx(12, rel=1e-15)
    assert convert(1, "lb", "oz") == pytest.approx(16, rel=1e-15)
    assert convert(1, "psi", "Pa") == pytest.approx(0.45359237 * 9.80665 / 0.0254**2, rel=1e-15)
    assert convert(1, "bar", "kPa") == 100
    assert convert(180, "deg", "rad") == math.pi


def test_a_number_goes_to_si_as_division_rounds_it_and_back():
    """28.7 · 0.001 is 0.028700000000000003; the double next to 0.0287 is wanted."""
    assert UNITS["mm"].to_si(28.7) == 28.7 / 1000
    assert UNITS["um"].to_si(207) == 207 / 1e6
    assert UNITS["deg"].to_si(33.3) == math.radians(33.3)
    for unit in UNITS.values():
        assert unit.from_si(unit.to_si(0.37)) == pytest.approx(0.37, rel=1e-15)


@pytest.mark.parametrize(
    ("value", "sigma", "text"),
    [
        (0.36981, 0.0123, "0.370 ± 0.012"),
        (0.3712, 0.00999999, "0.371 ± 0.010"),
        (152.7, 31.0, "153 ± 31"),
        (-3.464e-9, 2.3e-6, "(0.0 ± 2.3)·10⁻⁶"),
        (1.2341e-5, 2.3e-7, "(12.34 ± 0.23)·10⁻⁶"),
        (2.5, 0.0, "2.50"),
        (2.5, math.nan, "2.50"),
    ],
)
def test_a_value_ends_where_its_error_does(value, sigma, text):
    assert with_error(value, sigma) == text


def test_a_number_has_three_digits_and_an_interval_shows_both_ends_to_the_same():
    values = (0.37, 1069.0, 0.0, -2.345, 1.5e-7, math.nan, None)
    assert [number(value) for value in values] == ["0.370", "1069", "0", "-2.35", "1.50e-07", "–", "–"]
    assert interval([0.36512, 0.37449]) == "0.3651 to 0.3745"
    assert with_interval(0.4001, [0.359, 0.4412]) == "0.400 (95 %: 0.359 to 0.441)"
    assert with_interval(0.4001, [None, None]) == "0.400"
