"""What follows from the paper's own numbers, each worked out by hand."""

from __future__ import annotations

import math

import pandas as pd
import pytest

from vinetrack.paper.arithmetic import (
    COMPUTED,
    as_table,
    computed_rows,
    gauge_left,
    p_value,
    printed_steady_speed_m_s,
    volume_change,
    weight_over_gas,
)


@pytest.fixture(scope="module")
def table() -> pd.DataFrame:
    return as_table(computed_rows()).set_index("row")


def test_the_largest_vine_is_three_and_a_half_per_cent_of_the_chamber(table: pd.DataFrame) -> None:
    """π × 12² mm² × 280 mm = 126.67 mL of 3700 mL."""
    assert volume_change(3.7e-3, 24.0, 280.0) == pytest.approx(0.126669 / 3.7, rel=1e-5)
    assert table.loc["chamber_volume_change", "ours"] == pytest.approx(3.42, abs=0.005)


@pytest.mark.parametrize(
    ("pressure_kPa", "slow", "fast"), [(28, 15, 21), (14, 27, 38), (7, 51, 71)], ids=["28 kPa", "14 kPa", "7 kPa"]
)
def test_the_gas_law_holds_for_absolute_pressure(table: pd.DataFrame, pressure_kPa: int, slow: int, fast: int) -> None:
    assert table.loc[f"gauge_drop_{pressure_kPa}kPa_slow", "ours"] == pytest.approx(slow, abs=0.5)
    assert table.loc[f"gauge_drop_{pressure_kPa}kPa_fast", "ours"] == pytest.approx(fast, abs=0.5)


def test_pressure_left_by_hand() -> None:
    """Twice the volume at 101.325 kPa gauge: absolute 202.65 becomes 101.325, and nothing is left above the ambient."""
    assert gauge_left(101_325.0, 1.0) == pytest.approx(0.0, abs=1e-12)
    assert gauge_left(50e3, 0.0) == pytest.approx(1.0)
    # Adiabatic, volume up by a tenth: 151.325 × 1.1^−1.4 = 151.325 × 0.875094 = 132.4236 kPa, 31.0986 above ambient.
    assert gauge_left(50e3, 0.1, 1.4) == pytest.approx(31.0986 / 50, rel=1e-4)


def test_p_of_four_points() -> None:
    """With two degrees of freedom p = 1 − t/√(2 + t²), t² = 2R²/(1 − R²): p = 1 − R."""
    assert p_value(0.935, 4) == pytest.approx(1 - math.sqrt(0.935), rel=1e-9)
    assert p_value(0.935, 4) == pytest.approx(0.033, abs=5e-4)


def test_b_against_scale(table: pd.DataFrame) -> None:
    assert table.loc["B_power_of_scale", "ours"] == pytest.approx(1.80, abs=0.005)
    assert table.loc["B_line_R2", "ours"] == pytest.approx(0.983, abs=5e-4)
    assert table.loc["B_line_intercept", "ours"] == pytest.approx(-1.7, abs=0.05)


@pytest.mark.parametrize(("scale", "speed"), [(1, 1.6), (2, 2.9), (3, 2.2), (4, 4.1)])
def test_the_printed_coefficients_do_not_rise_evenly_in_speed(table: pd.DataFrame, scale: int, speed: float) -> None:
    assert table.loc[f"steady_speed_of_printed_B_R{scale}", "ours"] == pytest.approx(speed, abs=0.05)


def test_a_yield_pressure_slows_all_scales(table: pd.DataFrame) -> None:
    """R = 4: 21 kPa × 452.39 mm² = 9.5002 N; 9.5002/6.44 = 1.47519, to the power 1/0.37."""
    speed = math.exp(math.log(1.47519) / 0.37)
    assert printed_steady_speed_m_s(4, 24e3, 3e3) == pytest.approx(speed, rel=1e-4)
    assert "2.86 m/s" in table.loc["steady_speed_of_printed_B_R4", "beside"]


def test_the_weight_of_the_payload_beside_the_gas() -> None:
    assert weight_over_gas(12.0) == pytest.approx(0.18, abs=0.005)
    assert weight_over_gas(18.0) == pytest.approx(0.08, abs=0.005)


def test_the_injector(table: pd.DataFrame) -> None:
    """2.5² × 12.5 over 15² × 20: 1/57.6 = 1.736 %; 149.325 × (1 − 1/1.017361) = 2.5482 kPa of 48."""
    assert table.loc["injector_volume_change", "ours"] == pytest.approx(100 / 57.6)
    assert table.loc["injector_gauge_drop", "ours"] == pytest.approx(100 * 2.5482 / 48, rel=1e-4)


def test_the_guess_stands_beside_every_printed_coefficient(table: pd.DataFrame) -> None:
    """6.44 × R/4 × (R/4)^0.75."""
    for scale, B in enumerate((0.57, 1.83, 4.54, 6.44), start=1):
        row = table.loc[f"guessed_B_R{scale}"]
        assert row["ours"] == pytest.approx(6.44 * (scale / 4) ** 1.75)
        assert row["published"] == B
        assert abs(row["ours"] / B - 1) < 0.15


def test_the_hoop_stress_of_the_fast_vine(table: pd.DataFrame) -> None:
    """62 kPa × 25 mm / (2 × 100 µm)."""
    assert table.loc["fast_vine_hoop_stress", "ours"] == pytest.approx(7.75)


def test_pressures_are_rounded_pounds(table: pd.DataFrame) -> None:
    """14 for 13.790 (and 7 for 6.895, the same ratio): 1.526 %."""
    assert table.loc["pressure_rounding", "ours"] == pytest.approx(100 * (14 / 13.78951 - 1), abs=1e-3)


def test_all_of_it_is_marked_as_computed(table: pd.DataFrame) -> None:
    assert set(table["mark"]) == {COMPUTED}
