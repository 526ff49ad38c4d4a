"""The figure of predictions: complete and labelled, whether vines reach their end or not."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from vinetrack.figures.prediction_figures import MAX_CURVES, PredictionPicture, draw_predictions
from vinetrack.figures.style import render
from vinetrack.planning.prediction import CURVE_COLUMNS


def picture(until_s: float = 0.02, arrives: bool = True, least_N: float = 1.0) -> PredictionPicture:
    along = np.linspace(0.0, 0.99, 50)
    table = pd.DataFrame(dict.fromkeys(CURVE_COLUMNS, along))
    table["condition"] = "a"
    table["lead_position_m"] = 0.4 * along
    for name, factor in (("time_s", 1.0), ("time_low_90_s", 0.9), ("time_high_90_s", 1.2)):
        table[name] = until_s * factor * along
    table["tension_low_90_N"] = least_N
    if not arrives:
        table.loc[30:, ["time_s", "time_high_90_s"]] = np.inf
    return PredictionPicture(
        "a vine", table, "speed of the leading edge", [("guess of B", 30.0, 55.0)], (29.0, 46.0, 56.0)
    )


def words(pictures: list[PredictionPicture]) -> str:
    fig = draw_predictions(pictures, 0.95)
    texts = [text.get_text() for ax in fig.axes for text in (ax.xaxis.label, ax.yaxis.label, *ax.texts)]
    texts += [ax.get_title(loc="left") for ax in fig.axes]
    ticks = [label.get_text() for ax in fig.axes for label in ax.get_yticklabels()]
    return " | ".join([*texts, *ticks, *(text.get_text() for text in fig.texts)])


def test_one_condition_shows_its_uncertainty_budget() -> None:
    said = words([picture()])
    for expected in ("leading edge y (mm)", "ẏ (m/s)", "tension of the tail (N)", "growth y/L", "y/L = 0.95"):
        assert expected in said
    assert "guess of B" in said
    assert "all inputs" in said
    assert "compression" not in said


def test_several_conditions_are_told_apart_by_name() -> None:
    assert words([picture(), picture(0.03)]).count("a vine") == 2


def test_conditions_that_have_no_colour_left_are_counted() -> None:
    assert "and 2 more, not drawn" in words([picture() for _ in range(MAX_CURVES + 2)])


def test_a_tail_that_pushes_is_marked() -> None:
    assert "below 0 the model predicts compression in the tail" in words([picture(least_N=-0.5)])


def test_times_far_apart_have_a_logarithmic_axis() -> None:
    assert draw_predictions([picture(), picture(1.0)], 0.95).axes[0].get_xscale() == "log"
    assert draw_predictions([picture(), picture(0.03)], 0.95).axes[0].get_xscale() == "linear"


@pytest.mark.parametrize("arrives", [True, False])
def test_it_can_be_saved_whether_the_vine_gets_there_or_not(arrives: bool) -> None:
    assert render(draw_predictions([picture(arrives=arrives)], 0.95), ("svg",))["svg"].startswith(b"<?xml")
