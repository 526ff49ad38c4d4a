"""Trends with size against exact power laws and against textbook regressions worked out by hand."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd
import pytest

from vinetrack.kinematics.damping import alike, fit_trends, planes, regress
from vinetrack.kinematics.summary import CONDITION_COLUMNS

PER_STEP_95 = 12.706204736  # Student's t with one degree of freedom
PER_TWO_95 = 4.302652730  # and with two


def conditions(rows: list[dict]) -> pd.DataFrame:
    defaults = {
        "payload_g": 0.0,
        "growth_angle_deg": 0.0,
        "length_mm": 200.0,
        "n_steady": 4,
        "n_efficiency": 4,
        "efficiency_at_mm": 150.0,
        "efficiency": math.nan,
        "x_ss_m_s": math.nan,
    }
    table = pd.DataFrame([{**defaults, **row} for row in rows]).reindex(columns=list(CONDITION_COLUMNS))
    names = [f"c{i}" for i in range(len(table))]
    speed = table["x_ss_m_s"] / (table["diameter_mm"] / 1e3)
    return table.assign(condition=names, vine=names, x_ss_over_diameter_1_s=speed)


def speeds(values: list[float], pressure_kPa: float = 24.0) -> list[dict]:
    return [
        {"diameter_mm": 6.0 * r, "thickness_um": 50.0 * r, "pressure_kPa": pressure_kPa, "x_ss_m_s": value}
        for r, value in enumerate(values, start=1)
    ]


def loaded(diameter_mm: float, thickness_um: float, efficiency: float, **changes: float) -> dict:
    sizes = {"diameter_mm": diameter_mm, "thickness_um": thickness_um, "pressure_kPa": 34.0, "payload_g": 35.6}
    return {**sizes, "efficiency": efficiency, "efficiency_payload": 0.9 * efficiency, **changes}


def test_a_power_law_of_speed_comes_back_and_divided_by_diameter_it_is_one_less() -> None:
    (family,) = fit_trends(conditions(speeds([2.0 * r**0.7 for r in (1, 2, 3, 4)])))["steady_speed"]
    assert family["sizes"] == [6.0, 12.0, 18.0, 24.0]
    assert family["power"]["slope"] == pytest.approx(0.7)
    assert family["over_diameter"]["power"]["slope"] == pytest.approx(-0.3)
    assert family["monotonic"]


def test_the_published_r_squared_of_four_points_has_p_0_033() -> None:
    """t = √(R²·dof/(1 − R²)) = √(0.935 × 2/0.065) = 5.3637; with two degrees of freedom p = 1 − t/√(2 + t²) = 0.0330.

    Values with that R² exactly: a line, and a residual that is orthogonal to it.
    """
    x = np.array([1.0, 2.0, 3.0, 4.0])
    along, across = x - 2.5, np.array([1.0, -1.0, -1.0, 1.0])
    y = 10 + along * math.sqrt(0.935 / 5) + across * math.sqrt(0.065 / 4)
    found = regress(x, y)
    t = math.sqrt(0.935 * 2 / 0.065)
    assert found["R2"] == pytest.approx(0.935)
    assert found["p"] == pytest.approx(1 - t / math.sqrt(2 + t**2), rel=1e-9)
    assert found["p"] == pytest.approx(0.033, abs=5e-4)
    slope = math.sqrt(0.935 / 5)
    assert found["slope_95"] == pytest.approx([slope - PER_TWO_95 * slope / t, slope + PER_TWO_95 * slope / t])


def test_speeds_that_rise_and_fall_are_not_monotonic() -> None:
    (family,) = fit_trends(conditions(speeds([1.6, 2.9, 2.2, 4.1])))["steady_speed"]
    assert not family["monotonic"]
    assert family["line"]["p"] > 0.05


def test_speeds_at_other_pressures_or_walls_are_other_families() -> None:
    thin = {"diameter_mm": 12.0, "thickness_um": 50.0, "pressure_kPa": 24.0, "x_ss_m_s": 9.0}
    loaded_one = {**thin, "thickness_um": 100.0, "payload_g": 10.0}
    rows = [*speeds([1.0, 2.0, 3.0]), *speeds([4.0, 5.0], pressure_kPa=25.0), thin, loaded_one]
    families = fit_trends(conditions(rows))["steady_speed"]
    assert [(f["pressure_kPa"], len(f["sizes"])) for f in families] == [(24.0, 3), (25.0, 2)]
    assert families[1]["power"] is None
    assert "2 sizes" in families[1]["refused"]


def test_powers_of_wall_and_diameter_stand_apart() -> None:
    rows = [loaded(D, t, 0.4 * (t / 100) ** -0.6 * (D / 12) ** 0.2) for D in (12.0, 18.0) for t in (50.0, 100.0, 200.0)]
    (family,) = fit_trends(conditions(rows))["efficiency"]
    trend = family["trend"]["efficiency"]
    assert trend["thickness_um"]["power"] == pytest.approx(-0.6)
    assert trend["diameter_mm"]["power"] == pytest.approx(0.2)
    assert trend["R2"] == pytest.approx(1.0)
    assert family["trend"]["efficiency_payload"]["thickness_um"]["power"] == pytest.approx(-0.6)
    assert family["trend"]["efficiency_with_weight"]["refused"]


def test_one_power_is_the_straight_line_of_the_textbook() -> None:
    """ln values 0, 1, 1 at ln sizes 0, 1, 2: slope ½, residuals −1/6, 1/3, −1/6, s² = 1/6, error √(s²/2)."""
    found = planes({"thickness_um": np.exp([0.0, 1.0, 2.0]), "diameter_mm": np.full(3, 12.0)}, np.exp([0.0, 1.0, 1.0]))
    error = math.sqrt(1 / 12)
    power = found["thickness_um"]
    assert power["power"] == pytest.approx(0.5)
    assert power["power_95"] == pytest.approx([0.5 - PER_STEP_95 * error, 0.5 + PER_STEP_95 * error])
    # With one degree of freedom p = 1 − (2/π) arctan t; here t = √3, an angle of 60°.
    assert power["p"] == pytest.approx(1 / 3)
    assert found["R2"] == pytest.approx(0.75)
    assert "diameter_mm" not in found


def test_scaled_copies_have_no_power_of_their_own() -> None:
    sizes = {"thickness_um": np.array([50.0, 100.0, 150.0, 200.0]), "diameter_mm": np.array([6.0, 12.0, 18.0, 24.0])}
    assert "vary together" in planes(sizes, np.array([1.0, 2.0, 3.0, 4.0]))["refused"]


def test_too_few_conditions_for_a_trend_are_refused() -> None:
    rows = [loaded(12.0, 50.0, 0.5), loaded(12.0, 100.0, 0.4)]
    (family,) = fit_trends(conditions(rows))["efficiency"]
    assert family["trend"]["efficiency"]["refused"] == "2 conditions; a power of wall with an error takes 3"


def test_a_payload_that_was_not_there_has_no_trend() -> None:
    """Without a payload its own part of the efficiency is 0 of all: nothing that a logarithm could be taken of."""
    sizes = {"thickness_um": np.array([50.0, 100.0, 200.0]), "diameter_mm": np.full(3, 12.0)}
    assert planes(sizes, np.zeros(3))["refused"] == "no condition has such a value above 0"


def test_efficiencies_at_other_lengths_are_not_mixed() -> None:
    rows = [loaded(12.0, 50.0, 0.5), loaded(12.0, 100.0, 0.4, length_mm=160.0), loaded(12.0, 200.0, 0.3)]
    (family,) = fit_trends(conditions(rows))["efficiency"]
    assert family["thickness_um"] == [50.0, 200.0]


def test_without_conditions_there_are_no_families() -> None:
    assert fit_trends(conditions(speeds([1.0]))) == {"steady_speed": [], "efficiency": []}


def test_groups_agree_in_every_column() -> None:
    table = pd.DataFrame({"a": [1.0, 1.005, 1.0, 2.0], "b": [0.0, 0.0, 1.0, 0.0]})
    assert [group.index.tolist() for group in alike(table, {"a": 0.01, "b": 0.01})] == [[0, 1], [2], [3]]
