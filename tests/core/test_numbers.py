"""Numbers as people read them."""

from __future__ import annotations

import math

import pytest

from vinetrack.core.units import decimals, display_unit, interval, number, with_error, with_interval


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.37, "0.370"),
        (1069.0, "1069"),
        (0.0, "0"),
        (-2.345, "-2.35"),
        (1.5e-7, "1.50e-07"),
        (math.nan, "–"),
        (None, "–"),
    ],
)
def test_a_number_has_three_digits_and_an_exponent_only_where_needed(value: float | None, text: str) -> None:
    assert number(value) == text


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
def test_a_value_ends_where_its_error_does(value: float, sigma: float, text: str) -> None:
    assert with_error(value, sigma) == text


def test_an_unknown_value_is_a_dash_whatever_its_error() -> None:
    assert with_error(math.nan, 0.1) == "–"


def test_an_interval_shows_both_ends_to_the_same_digit() -> None:
    assert interval([0.36512, 0.37449]) == "0.3651 to 0.3745"


@pytest.mark.parametrize("bounds", [None, [None, None], [math.nan, 1.0]])
def test_an_unknown_interval_is_a_dash(bounds: list | None) -> None:
    assert interval(bounds) == "–"


def test_half_an_interval() -> None:
    assert with_interval(0.4001, [0.359, 0.4412]) == "0.400 (95 %: 0.359 to 0.441)"
    assert with_interval(0.4001, [None, None]) == "0.400"


@pytest.mark.parametrize(("sigma", "count"), [(0.0123, 3), (31.0, 0), (1e-20, 12), (0.0, 0), (math.nan, 0)])
def test_decimals_show_two_digits_of_an_error(sigma: float, count: int) -> None:
    assert decimals(sigma) == count


def test_a_unit_that_nothing_stands_for_is_shown_as_it_is() -> None:
    assert display_unit("1/Pa") == ("1/kPa", 1e3)
    assert display_unit("m") == ("m", 1.0)
