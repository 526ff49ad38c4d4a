"""Figures of model and measurement: one condition, forty, and none."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from vinetrack.figures.motion_figures import (
    MODEL_COMPARISON_MAX_PANELS as MAX_PANELS,
)
from vinetrack.figures.motion_figures import (
    draw_model_comparison,
    draw_model_residuals,
)
from vinetrack.figures.style import render

DRAWINGS = [draw_model_comparison, draw_model_residuals]


def trajectory(n_trials: int, off_m: float = 5e-3) -> pd.DataFrame:
    time_s = np.arange(-20, 100) * 1e-3
    model_m = 2 * np.maximum(time_s, 0)
    sigma_m = np.full(time_s.size, 1e-3 if n_trials > 1 else np.nan)
    parts = []
    for i in range(n_trials):
        position_m = model_m + off_m * (time_s > 0)
        columns = {"time_s": time_s, "lead_position_m": position_m, "model_position_m": model_m}
        columns |= {"replicates_mean_m": position_m, "replicates_sigma_m": sigma_m}
        parts.append(pd.DataFrame({"trial": f"t{i}", **columns}))
    return pd.concat(parts, ignore_index=True)


def campaign(n_conditions: int, n_trials: int = 2) -> tuple[pd.DataFrame, dict[str, pd.DataFrame]]:
    names = [f"c{i}" for i in range(n_conditions)]
    table = pd.DataFrame(
        {
            "model": "gravity+yield_pressure",
            "condition": names,
            "condition_label": [f"12 mm, {i} kPa, 35.6 g" for i in range(n_conditions)],
            "vine": "v",
            "rms_position_m": 5e-3,
            "ratio": 5.0 if n_trials > 1 else np.nan,
        }
    )
    return table, {name: trajectory(n_trials) for name in names}


@pytest.mark.parametrize("draw", DRAWINGS)
@pytest.mark.parametrize("n_conditions", [1, 12, 40])
def test_every_condition_has_a_panel_with_its_numbers(draw, n_conditions: int) -> None:  # type: ignore[no-untyped-def]
    fig = draw(*campaign(n_conditions))
    shown = [ax for ax in fig.axes if ax.get_visible()]
    assert [ax.get_title(loc="left") for ax in shown] == [f"12 mm, {i} kPa, 35.6 g" for i in range(n_conditions)]
    assert {ax.texts[0].get_text() for ax in shown} == {"rms 5 mm (5×)\nN = 2"}
    assert len(render(fig, ["svg"])["svg"]) < 1_500_000


def test_replicates_are_thin_and_the_model_is_dashed() -> None:
    (ax,) = draw_model_comparison(*campaign(1, n_trials=3)).axes
    assert len(ax.lines) == 4
    assert ax.lines[-1].is_dashed()
    assert ax.lines[0].get_ydata()[-1] == pytest.approx(1e3 * (2 * 0.099 + 5e-3))
    assert ax.lines[-1].get_ydata()[-1] == pytest.approx(1e3 * 2 * 0.099)


def test_residuals_are_measurement_minus_model() -> None:
    (ax,) = draw_model_residuals(*campaign(1, n_trials=1)).axes
    assert ax.lines[-1].get_ydata()[-1] == pytest.approx(5.0)


def test_without_replicates_no_ratio_is_claimed() -> None:
    (ax,) = draw_model_comparison(*campaign(1, n_trials=1)).axes
    assert ax.texts[0].get_text() == "rms 5 mm\nN = 1"


@pytest.mark.parametrize("draw", DRAWINGS)
def test_without_a_fit_there_is_no_figure(draw) -> None:  # type: ignore[no-untyped-def]
    table, _ = campaign(1)
    assert draw(table.iloc[:0], {}) is None


def test_of_many_conditions_those_with_the_largest_error_are_drawn() -> None:
    table, trajectories = campaign(MAX_PANELS + 5, n_trials=1)
    table["rms_position_m"] = np.linspace(1e-3, 2e-3, len(table))
    fig = draw_model_comparison(table, trajectories)
    shown = [ax for ax in fig.axes if ax.get_visible()]
    expected = table["condition_label"].iloc[5:].tolist()
    assert [ax.get_title(loc="left") for ax in shown] == expected
    assert f"the {MAX_PANELS} of {MAX_PANELS + 5} conditions" in fig.get_suptitle().replace("\n", " ")


@pytest.mark.parametrize("draw", DRAWINGS)
def test_a_trial_that_ends_before_its_origin_is_drawn_too(draw) -> None:  # type: ignore[no-untyped-def]
    """A model that fails badly may put the origin anywhere where no rest was filmed."""
    table, trajectories = campaign(1)
    behind = {name: frame.assign(lead_position_m=frame["lead_position_m"] - 1) for name, frame in trajectories.items()}
    (ax,) = draw(table, behind).axes
    assert len(ax.lines) == 3
