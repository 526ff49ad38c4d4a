"""What follows from the paper's own numbers, each worked out by hand."""

from __future__ import annotations

import math

import pandas as pd
import pytest

from vinetrack.paper.arithmetic import (
    as_table,
    computed_rows,
    p_value,
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


def test_p_of_four_points() -> None:
    """With two degrees of freedom p = 1 − t/√(2 + t²), t² = 2R²/(1 − R²): p = 1 − R."""
    assert p_value(0.935, 4) == pytest.approx(1 - math.sqrt(0.935), rel=1e-9)
    assert p_value(0.935, 4) == pytest.approx(0.033, abs=5e-4)


def test_b_against_scale(table: pd.DataFrame) -> None:
    assert table.loc["B_power_of_scale", "ours"] == pytest.approx(1.80, abs=0.005)
    assert table.loc["B_line_R2", "ours"] == pytest.approx(0.983, abs=5e-4)
    assert table.loc["B_line_intercept", "ours"] == pytest.approx(-1.7, abs=0.05)


def test_the_weight_of_the_payload_beside_the_gas() -> None:
    assert weight_over_gas(12.0) == pytest.approx(0.18, abs=0.005)
    assert weight_over_gas(18.0) == pytest.approx(0.08, abs=0.005)


def test_the_injector(table: pd.DataFrame) -> None:
    """2.5² × 12.5 over 15² × 20: 1/57.6 = 1.736 %; 149.325 × (1 − 1/1.017361) = 2.5482 kPa of 48."""
    assert table.loc["injector_volume_change", "ours"] == pytest.approx(100 / 57.6)
    assert table.loc["injector_gauge_drop", "ours"] == pytest.approx(100 * 2.5482 / 48, rel=1e-4)


def test_pressures_are_rounded_pounds(table: pd.DataFrame) -> None:
    """14 for 13.790 (and 7 for 6.895, the same ratio): 1.526 %."""
    assert table.loc["pressure_rounding", "ours"] == pytest.approx(100 * (14 / 13.78951 - 1), abs=1e-3)
