"""The figure of one effect: its table and its drawing."""

from __future__ import annotations

import matplotlib.colors as mcolors
import numpy as np
import pandas as pd
import pytest

from vinetrack.dynamics.simulate import effect_motion, reference_words, size_words
from vinetrack.effects import catalogue
from vinetrack.figures.prediction_figures import draw_effect
from vinetrack.figures.style import BLUE, render

FASTER = {"fold_inertia", "wall_stretch", "gravity"}


def table() -> pd.DataFrame:
    t = np.linspace(0, 0.2, 50)
    return pd.DataFrame(
        {
            "time_s": t,
            "without_position_m": t,
            "with_position_m": 0.9 * t,
            "without_velocity_m_s": np.ones(50),
            "with_velocity_m_s": np.full(50, 0.9),
            "difference_m": -0.1 * t,
        }
    )


def test_both_curves_are_drawn_in_millimetres_and_milliseconds() -> None:
    fig = draw_effect("drag", "C = 1", "a vine", table())
    position, speed, gap = fig.axes
    drawn = {mcolors.to_hex(line.get_color()).upper(): line for line in position.lines}
    np.testing.assert_allclose(drawn[BLUE.upper()].get_ydata(), 900 * table()["time_s"])
    np.testing.assert_allclose(drawn[BLUE.upper()].get_xdata(), 1e3 * table()["time_s"])
    assert gap.lines[-1].get_ydata()[-1] == pytest.approx(-20.0)
    assert "m/s" in speed.get_ylabel()
    assert [text.get_text() for text in position.get_legend().get_texts()] == ["without", "with"]
    assert "drag: C = 1" in [text.get_text() for text in fig.texts]
    assert render(fig, ["png"])["png"].startswith(b"\x89PNG")


@pytest.mark.parametrize("name", [name for name, effect in catalogue().items() if effect.parameters])
def test_every_effect_shows_on_the_reference_vine(name: str) -> None:
    found = effect_motion(catalogue()[name])
    assert np.isfinite(found.to_numpy()).all()
    assert np.max(np.abs(found["difference_m"])) > 1e-6
    if catalogue()[name].kind == "physical" and name not in ("tail_stretch", "supply_pulsation", *FASTER):
        assert found["difference_m"].iloc[-1] < 0
    if name in FASTER:
        assert found["difference_m"].iloc[-1] > 0


def test_the_size_is_the_one_that_was_simulated() -> None:
    assert size_words(catalogue()["eversion_damping"]) == "B = 6.44 N·(s/m)ⁿ, n = 0.37"
    assert size_words(catalogue()["air_drag"]) == "C_D = 1"
    assert size_words(catalogue()["pressure_drive"]) == ""


def test_the_caption_says_what_is_simulated() -> None:
    assert "28 kPa" in reference_words(catalogue()["leak"])
    assert "horizontal" in reference_words(catalogue()["static_yield"])
    assert "bend" in reference_words(catalogue()["capstan_friction"])
