"""Lines that an experiment answers, from results written by hand; and that no published number is without its line."""

from __future__ import annotations

import math

import pandas as pd
import pytest

from vinetrack.inference.fit_result import Number
from vinetrack.inference.fit_summary import FitSummary
from vinetrack.kinematics.summary import CONDITION_COLUMNS
from vinetrack.paper.arithmetic import (
    COMPUTED,
    DEPARTURE_COLUMNS,
    DEPARTURES,
    NOT_CHECKABLE,
    PAPER_COLUMNS,
    SIMULATED,
    PaperRow,
    as_table,
    computed_rows,
)
from vinetrack.paper.protocol import POSITION_COLUMNS, SPEED_COLUMNS, protocol_rows
from vinetrack.paper.result_rows import ExperimentResults, result_rows, theory_rows

nan = math.nan


def vine(scale: int, B: float) -> dict:
    return {
        "B": B,
        "B_95_total": [0.9 * B, 1.1 * B],
        "R2": 0.99,
        "diameter_mm": 6.0 * scale,
        "thickness_um": 50.0 * scale,
        "n_trials": 40,
    }


def law(n: float, factor: float = 1.0) -> dict:
    B = {1: 0.6, 2: 1.8, 3: 4.5, 4: 6.4}
    return {"n": n, "n_95_total": [n - 0.01, n + 0.01], "vines": {f"v{k}": vine(k, factor * B[k]) for k in B}}


LINE = {"slope": 1.8, "slope_95": [1.4, 2.2], "intercept": -1.7, "R2": 0.98, "p": 0.003, "n": 4}
DAMPING = {"log_log": law(0.371), "both_axes": law(0.372), "paper": law(0.38, 0.95)}
SCALING = {
    "isometric": [{"vines": ["v1", "v2", "v3", "v4"], "power": LINE, "line": LINE}],
    "thickness": [{"vines": ["w", "v2"], "sizes": [50.0, 100.0], "power": LINE | {"slope": 1.0}, "line": LINE}],
    "steady_speed": [
        {
            "pressure_kPa": 24.0,
            "sizes": [6.0, 12.0, 18.0, 24.0],
            "n_steady": [4, 4, 3, 4],
            "monotonic": False,
            "power": LINE | {"slope": 0.6},
            "line": LINE | {"R2": 0.7},
            "over_diameter": {"power": LINE | {"slope": -0.4}},
        }
    ],
    "efficiency": [
        {
            "pressure_kPa": 34.0,
            "payload_g": 35.6,
            "trend": {
                key: {
                    "thickness_um": {"power": -1.5, "power_95": [-2, -1], "p": 0.002},
                    "diameter_mm": {"power": 0.2, "power_95": [-1, 1.4], "p": 0.7},
                    "n": 8,
                }
                for key in ("efficiency", "efficiency_payload", "efficiency_with_weight")
            },
        }
    ],
}
FIT = FitSummary(
    names=("yield_pressure",),
    numbers=(
        Number(
            "yield_pressure.P_y", "24mm-200um-280mm", "P_y", "Pa", 2950.0, nan, 2900.0, nan, dof=nan, method="linear"
        ),
    ),
)


def found(mark: str = SIMULATED, **changes: object) -> ExperimentResults:
    positions = pd.DataFrame([("c", 7.0, 4, 0.0031, 0.0042)], columns=list(POSITION_COLUMNS))
    speeds = pd.DataFrame(
        [("a", "v", 14.0, 10.0, 4, 120.0, 1.1, 0.1, 1.0), ("b", "v", 14.0, 20.0, 4, 120.0, 1.3, 0.1, 1.6)],
        columns=list(SPEED_COLUMNS),
    )
    sizes = dict(zip((one.name for one in DEPARTURES), (0.057, 0.069, 0.095, 0.110, 0.114), strict=True))
    departures = pd.DataFrame(
        [("Fig. 4", 7.0, name, size, nan, nan) for name, size in sizes.items()], columns=list(DEPARTURE_COLUMNS)
    )
    fast = {"diameter_mm": 25.0, "thickness_um": 100.0, "pressure_kPa": 62.0, "payload_g": 0.0}
    fast |= {"final_at_mm": 380.0, "final_lead_velocity_m_s": 46.0, "n_final": 1}
    conditions = pd.DataFrame([fast]).reindex(columns=list(CONDITION_COLUMNS))
    given: dict = {"damping": DAMPING, "scaling": SCALING, "conditions": conditions, "fit": FIT}
    return ExperimentResults(
        **({"mark": mark, "positions": positions, "speeds": speeds, "departures": departures} | given | changes)
    )


def nothing() -> ExperimentResults:
    empty = {name: pd.DataFrame(columns=list(columns), dtype=float) for name, columns in EMPTY.items()}
    return found(damping={}, scaling={}, fit=FitSummary(()), **empty)


EMPTY = {
    "positions": POSITION_COLUMNS,
    "speeds": SPEED_COLUMNS,
    "departures": DEPARTURE_COLUMNS,
    "conditions": CONDITION_COLUMNS,
}


def table(of: ExperimentResults) -> pd.DataFrame:
    return as_table(result_rows(of)).set_index("row")


def test_the_law_stands_beside_the_printed_one() -> None:
    rows = table(found())
    assert rows.loc["n_both_axes", ["published", "ours", "ours_low_95", "ours_high_95"]].tolist() == pytest.approx(
        [0.37, 0.372, 0.362, 0.382]
    )
    assert rows.loc["n_literal", "ours"] == 0.38
    assert rows.loc["B_R3", ["published", "ours"]].tolist() == [4.54, 4.5]
    assert rows.loc["B_R3", "mark"] == SIMULATED
    assert rows.loc["B_R4", "beside"].startswith("6.08 ")  # 0.95 × 6.4 by the published rule


def test_final_speeds_are_put_together_over_payloads() -> None:
    """Off by 0.1 and −0.3 m/s: √((0.01 + 0.09)/2)."""
    row = table(found()).loc["final_speed_rms_14kPa"]
    assert (row["published"], row["ours"]) == (0.27, pytest.approx(math.sqrt(0.05)))
    assert row["mark"] == NOT_CHECKABLE


def test_sizes_come_with_their_p_values() -> None:
    rows = table(found())
    assert rows.loc["steady_speed_R2", ["published", "ours"]].tolist() == [0.935, 0.7]
    assert "monotonic: no" in rows.loc["steady_speed_R2", "beside"]
    assert rows.loc["steady_speed_over_diameter_power", "ours"] == -0.4
    assert rows.loc["B_power_of_wall", "ours"] == 1.0
    assert rows.loc["efficiency_power_of_wall", ["ours", "ours_low_95", "ours_high_95"]].tolist() == [-1.5, -2, -1]
    assert rows.loc["efficiency_with_weight_power_of_diameter", "beside"] == "p = 0.7"


def test_the_yield_pressure_and_the_fast_vine() -> None:
    rows = table(found())
    assert rows.loc["yield_pressure", ["ours", "ours_low_95"]].tolist() == [2.95, 2.9]
    assert math.isnan(rows.loc["yield_pressure", "ours_high_95"])
    assert rows.loc["fast_vine_measured", ["published", "ours"]].tolist() == [60.0, 46.0]
    assert rows.loc["fast_vine_measured", "mark"] == NOT_CHECKABLE


def test_an_experiment_without_any_of_it_leaves_ours_blank() -> None:
    rows = table(nothing())
    assert set(rows.index) == set(table(found()).index)
    assert rows["ours"].isna().all()


EVERY_NUMBER = {
    "thickness_R1": 50, "thickness_R2": 100, "thickness_R3": 150, "thickness_R4": 200,
    "diameter_R1": 6, "diameter_R2": 12, "diameter_R3": 18, "diameter_R4": 24,
    "n_log_log": 0.37,
    "B_R1": 0.57, "B_R2": 1.83, "B_R3": 4.54, "B_R4": 6.44,
    "R2_R1": 0.964, "R2_R2": 0.981, "R2_R3": 0.896, "R2_R4": 0.971,
    "capture_fps": 1069,
    "window_largest_cv": 3,
    "position_rms_7kPa": 1.90, "position_rms_14kPa": 0.29, "position_rms_28kPa": 0.31,
    "yield_pressure": 3,
    "final_speed_rms_14kPa": 0.27, "final_speed_rms_28kPa": 0.56, "final_speed_rms_41kPa": 1.35,
    "steady_speed_trials": 4, "steady_speed_R2": 0.935, "steady_speed_p_value": 0.32,
    "fast_vine_measured": 60, "fast_vine_predicted_99": 56,
    "chamber_volume_change": 3.5, "injector_volume_change": 1.7, "injector_gauge_drop": 1.7,
    "press_R1": 110, "press_R2": 82, "press_R3": 96, "press_R4": 96,
    "laser_R1": 60, "laser_R2": 76, "laser_R3": 81, "laser_R4": 86,
    "drag_share_95": 5,
}  # fmt: skip
"""Every published number, as it is printed."""

EVERY_STATEMENT = {
    "pressures_R1": "8 to 11", "trials_R1": "4 to 5", "window_fewest_points": "at least 3",
    "B_power_of_scale": "near-linear", "B_power_of_wall": "rises linearly",
    "steady_speed_power": "rises monotonically", "steady_speed_over_diameter_power": "no trend",
    "efficiency_power_of_wall": "higher for thinner walls", "efficiency_power_of_diameter": "no clear trend",
    "gauge_drop_7kPa_slow": "3.5, within 5",
}  # fmt: skip


def test_no_published_number_is_without_its_line() -> None:
    steady = pd.DataFrame(columns=["trial", "rule", "accepted", "points", "cv", "drift"]).astype({"accepted": bool})
    rows = [*protocol_rows([], steady, SIMULATED), *result_rows(nothing()), *computed_rows(), *theory_rows([])]
    whole = as_table(rows)
    assert list(whole.columns) == list(PAPER_COLUMNS)
    by_row = whole.set_index("row")
    for row, value in EVERY_NUMBER.items():
        assert by_row.loc[row, "published"] == pytest.approx(value), row
    for row, words in EVERY_STATEMENT.items():
        assert by_row.loc[row, "as_printed"] == words, row
    assert set(whole["mark"]) == {SIMULATED, COMPUTED, NOT_CHECKABLE}
    assert (whole["how"] != "").all()


def test_a_row_stands_once_and_has_a_mark() -> None:
    row = PaperRow(row="a", where="", quantity="", mark=COMPUTED, how="", published=0.5)
    assert as_table([row])["as_printed"].tolist() == ["0.5"]
    with pytest.raises(ValueError, match="stand twice: a"):
        as_table([row, row])
    with pytest.raises(ValueError, match="has the mark"):
        as_table([PaperRow(row="a", where="", quantity="", mark="perhaps", how="")])
