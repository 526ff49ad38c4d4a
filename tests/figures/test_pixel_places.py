"""Pixel locking is distinguished from a uniform distribution of edges within a pixel."""

from __future__ import annotations

import math

import numpy as np
import pandas as pd
import pytest
from matplotlib.text import Text

from vinetrack.figures.overlay import draw_pixel_places, periodic_error, subpixel_positions


def places(amplitude_px: float, count: int = 4000, seed: int = 971) -> np.ndarray:
    """Edges anywhere, estimated with an error that repeats with every pixel."""
    edge = np.random.default_rng(seed).uniform(0, 500, count)
    return np.mod(edge - amplitude_px * np.sin(2 * np.pi * edge), 1.0)


@pytest.mark.parametrize("amplitude_px", [0.02, 0.05, 0.1])
def test_the_amplitude_of_a_periodic_error_is_found(amplitude_px: float) -> None:
    found, chance = periodic_error(places(amplitude_px))
    assert found == pytest.approx(amplitude_px, abs=1.5 * chance)
    assert chance == pytest.approx(math.sqrt(math.log(20) / 4000) / math.pi)


def test_edges_that_fall_anywhere_exceed_chance_once_in_twenty() -> None:
    above = [np.greater(*periodic_error(places(0.0, 500, seed))) for seed in range(3000, 3400)]
    assert 8 <= sum(above) <= 34  # 20 expected, binomial to three standard deviations


def test_only_sound_moving_frames_of_recordings_count() -> None:
    filmed = pd.DataFrame(
        {"edge_px": [10.25, 11.5, 12.75, np.nan, 14.0], "flag": ["", np.nan, "doubtful", "lost", "after_end"]}
    )
    elsewhere = pd.DataFrame({"edge_px": [np.nan, np.nan], "flag": [np.nan, np.nan]})
    assert subpixel_positions({"a": filmed, "b": elsewhere}).tolist() == [0.25, 0.5]
    assert len(subpixel_positions({})) == 0


@pytest.mark.parametrize(("amplitude_px", "words"), [(0.1, "more than chance"), (0.0, "no more than chance")])
def test_the_histogram_holds_every_edge_and_says_what_it_shows(amplitude_px: float, words: str) -> None:
    figure = draw_pixel_places(places(amplitude_px, 600, seed=972))
    (ax,) = figure.axes
    assert sum(bar.get_height() for bar in ax.patches[:10]) == 600
    said = " ".join(text.get_text() for text in figure.findobj(Text)).replace("\n", " ")
    assert f"px, {words}" in said
    assert "N = 600 frames" in said
