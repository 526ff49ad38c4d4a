"""The learned force as a curve or a map, with units, and blank outside the range of the trials."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd
import pytest

from vinetrack.figures.diagnosis_figures import draw_learned_force

NOTHING = dict.fromkeys(("lead_position_m", "tail_velocity_m_s", "time_s", "pressure_Pa"), math.nan)


def curve() -> pd.DataFrame:
    rows = [
        NOTHING | {"lead_position_m": y, "force_N": -y, "sigma_N": 0.02, "trials": int(y < 0.2), "condition": name}
        for name in ("", "a", "b")
        for y in np.linspace(0, 0.25, 26)
    ]
    return pd.DataFrame(rows)


def surface() -> pd.DataFrame:
    point = NOTHING | {"sigma_N": 0.02}
    grid = [
        point | {"lead_position_m": y, "tail_velocity_m_s": v, "force_N": -y * v, "trials": int(v < 6), "condition": ""}
        for y in np.linspace(0, 0.25, 20)
        for v in np.linspace(0, 8, 20)
    ]
    along = [
        point | {"lead_position_m": y, "tail_velocity_m_s": 4.0, "force_N": -4 * y, "trials": 1, "condition": "a"}
        for y in np.linspace(0, 0.25, 20)
    ]
    return pd.DataFrame([*grid, *along])


def test_a_force_of_one_variable_is_a_curve_with_its_band_where_trials_have_been() -> None:
    (ax,) = draw_learned_force(curve()).axes
    assert ax.get_xlabel() == "growth y (mm)"
    assert ax.get_ylabel() == "missing force (N)"
    line = next(line for line in ax.lines if line.get_label() == "learned force")
    assert line.get_xdata().max() == pytest.approx(190.0)
    band = ax.collections[0].get_paths()[0].vertices
    assert band[:, 1].max() == pytest.approx(1.96 * 0.02)


def test_a_force_of_two_variables_is_a_map_beside_its_error() -> None:
    force, error, *bars = draw_learned_force(surface()).axes
    assert (force.get_xlabel(), force.get_ylabel()) == ("growth y (mm)", "tail speed ẋ (m/s)")
    assert [bar.get_ylabel() for bar in bars] == ["missing force (N)", "its standard error (N)"]
    # The one condition's motion, over either map.
    assert [len(ax.lines) for ax in (force, error)] == [1, 1]
