"""Units: exact by definition, and read from the ending of a name."""

from __future__ import annotations

import math

import pytest

from vinetrack.core.units import PREDICTION_UNITS, SLIDER_UNITS, UNITS, convert, display_unit, split_unit


def test_inches_pounds_and_psi_are_exact_by_definition() -> None:
    assert convert(1, "in", "mm") == 25.4
    assert convert(1, "ft", "in") == pytest.approx(12, rel=1e-15)
    assert convert(1, "lb", "oz") == pytest.approx(16, rel=1e-15)
    assert convert(1, "psi", "Pa") == pytest.approx(0.45359237 * 9.80665 / 0.0254**2, rel=1e-15)
    assert convert(1, "bar", "kPa") == 100
    assert convert(180, "deg", "rad") == math.pi


def test_a_number_goes_to_si_as_division_rounds_it() -> None:
    """28.7 · 0.001 is 0.028700000000000003; the double next to 0.0287 is wanted."""
    assert UNITS["mm"].to_si(28.7) == 28.7 / 1000
    assert UNITS["um"].to_si(207) == 207 / 1e6
    assert UNITS["deg"].to_si(33.3) == math.radians(33.3)


@pytest.mark.parametrize("name", UNITS)
def test_from_si_undoes_to_si(name: str) -> None:
    assert UNITS[name].from_si(UNITS[name].to_si(0.37)) == pytest.approx(0.37, rel=1e-15)


def test_quantities_do_not_mix() -> None:
    with pytest.raises(ValueError, match="psi cannot be turned into mm"):
        convert(1, "psi", "mm")


def test_the_longest_ending_that_is_a_unit_is_the_unit() -> None:
    assert split_unit("film_density_g_cm3") == ("film_density", "g_cm3")
    assert split_unit("thickness_um") == ("thickness", "um")
    assert split_unit("mm_per_px") == ("mm_per_px", "")
    assert split_unit("kPa") == ("kPa", "")


def test_what_a_table_does_not_show_otherwise_stays_si() -> None:
    assert display_unit("m") == ("m", 1.0)
    assert display_unit("m", SLIDER_UNITS) == ("mm", 1e3)
    assert display_unit("s", PREDICTION_UNITS) == ("ms", 1e3)
