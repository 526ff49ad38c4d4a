"""Units, exact by definition and read from the ending of a name; numbers as people read them."""

import math

import pytest

from vinetrack.core.units import UNITS, convert, interval, number, split_unit, with_error, with_interval


def test_inches_pounds_and_psi_are_exact_by_definition():
    assert convert(1, "in", "mm") == 25.4
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


def test_the_longest_ending_that_is_a_unit_is_the_unit():
    assert split_unit("film_density_g_cm3") == ("film_density", "g_cm3")
    assert split_unit("kPa") == ("kPa", "")


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
