"""Replicates put together, against means and standard errors worked out by hand."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from vinetrack.core.records import Trial
from vinetrack.experiment.schema import with_names
from vinetrack.kinematics.summary import CONDITION_COLUMNS, condition_table, mean_with_error

nan = math.nan
BARE = Trial(
    name="", diameter_m=0.012, thickness_m=100e-6, length_m=0.2, pressure_Pa=24e3, yield_pressure_Pa=3e3, payload_kg=0.0
)
LOADED = replace(BARE, pressure_Pa=34e3, payload_kg=0.0356)
KNOWN = with_names(
    [
        *(replace(BARE, name=f"bare{i}") for i in range(4)),
        *(replace(LOADED, name=f"loaded{i}") for i in range(3)),
        replace(BARE, name="alone", pressure_Pa=30e3),
    ]
)


def row(name: str, x_ss: float = nan, final: float = nan, efficiency: float = nan, **changes: object) -> dict:
    condition = next(trial.condition for trial in KNOWN if trial.name == name)
    numbers = {"x_ss_m_s": x_ss, "x_ss_sigma_m_s": 0.05, "final_lead_velocity_m_s": final, "efficiency": efficiency}
    return {"trial": name, "condition": condition, "status": "ok", **numbers, **changes}


ROWS = [
    row("bare0", 2.0, 1.1),
    row("bare1", 2.4, 1.3),
    row("bare2", 2.2, 1.2),
    row("bare3", nan, 1.4, status="warning"),
    row("loaded0", efficiency=0.50),
    row("loaded1", efficiency=0.54),
    row("loaded2", efficiency=9.0, status="failed"),
    row("alone", 3.0),
]


def table(rows: list[dict] = ROWS) -> pd.DataFrame:
    found = condition_table(pd.DataFrame(rows), KNOWN, final_at_fraction=0.95, efficiency_at_mm=150.0)
    return found.set_index(found["condition"].str.split("_").str[1:].str.join("_"))


def test_a_row_a_condition_with_its_sizes() -> None:
    found = table()
    assert list(found.columns) == list(CONDITION_COLUMNS)
    assert list(found.index) == ["24kPa_0g", "34kPa_35.6g", "30kPa_0g"]
    sizes = found.loc["34kPa_35.6g", ["diameter_mm", "thickness_um", "length_mm", "pressure_kPa", "payload_g"]]
    assert sizes.tolist() == pytest.approx([12.0, 100.0, 200.0, 34.0, 35.6])


def test_speed_is_a_mean_with_its_standard_error() -> None:
    """2.0, 2.4, 2.2: mean 2.2, standard deviation 0.2, over √3."""
    bare = table().loc["24kPa_0g"]
    assert bare["x_ss_m_s"] == pytest.approx(2.2)
    assert bare["x_ss_sigma_m_s"] == pytest.approx(0.2 / math.sqrt(3))
    assert (bare["n_trials"], bare["n_steady"]) == (4, 3)
    assert bare["x_ss_over_diameter_1_s"] == pytest.approx(2.2 / 0.012)
    assert bare["x_ss_over_diameter_sigma_1_s"] == pytest.approx(0.2 / math.sqrt(3) / 0.012)


def test_a_single_trial_has_its_own_error() -> None:
    assert table().loc["30kPa_0g", ["x_ss_m_s", "x_ss_sigma_m_s"]].tolist() == [3.0, 0.05]


def test_a_minority_of_steady_trials_stands_for_nobody() -> None:
    few = [*ROWS[:1], *(row(f"bare{i}", nan, 1.2) for i in (1, 2, 3))]
    bare = table(few).loc["24kPa_0g"]
    assert bare["n_steady"] == 1
    assert math.isnan(bare["x_ss_m_s"])
    assert math.isnan(bare["x_ss_over_diameter_1_s"])


def test_final_speeds_count_wherever_growth_got_there() -> None:
    bare = table().loc["24kPa_0g"]
    assert bare["final_lead_velocity_m_s"] == pytest.approx(1.25)
    assert (bare["n_final"], bare["final_at_mm"]) == (4, pytest.approx(190.0))


def test_failed_trials_count_for_nothing_and_efficiency_has_its_variants() -> None:
    """Film 4.5239 g/m × 0.2 m: 0.22619 g are left at 0.15 m beside 35.6 g; the mean moving mass is 36.1655 g."""
    loaded = table().loc["34kPa_35.6g"]
    assert (loaded["n_trials"], loaded["n_efficiency"]) == (2, 2)
    assert loaded["efficiency"] == pytest.approx(0.52)
    assert loaded["efficiency_sigma"] == pytest.approx(0.02)  # standard deviation 0.0283 over √2
    payload = 35.6 / (35.6 + 0.226195)
    assert loaded["efficiency_payload"] == pytest.approx(0.52 * payload, rel=1e-5)
    share = 36.165487e-3 * 9.81 * 0.3 / (34e3 * math.pi * 0.006**2 * 0.15)
    assert loaded["weight_share"] == pytest.approx(share, rel=1e-6)
    assert loaded["efficiency_with_weight"] == pytest.approx(0.52 / (1 + share), rel=1e-6)
    assert loaded["efficiency_with_weight_sigma"] == pytest.approx(0.02 / (1 + share), rel=1e-6)


def test_what_was_not_measured_is_blank() -> None:
    bare = table().loc["24kPa_0g"]
    assert math.isnan(bare["efficiency"])
    assert math.isnan(bare["weight_share"])
    assert bare["n_efficiency"] == 0


def test_without_trials_the_table_has_its_columns() -> None:
    nothing = [dict(one, status="left_out") for one in ROWS]
    empty = condition_table(pd.DataFrame(nothing), KNOWN, final_at_fraction=0.95, efficiency_at_mm=150.0)
    assert list(empty.columns) == list(CONDITION_COLUMNS)
    assert len(empty) == 0


def test_the_error_of_a_mean() -> None:
    assert mean_with_error(np.array([1.0, nan, 3.0])) == (2.0, pytest.approx(1.0), 2)
    mean, sigma, count = mean_with_error(np.array([nan, 5.0]))
    assert (mean, count) == (5.0, 1)
    assert math.isnan(sigma)
