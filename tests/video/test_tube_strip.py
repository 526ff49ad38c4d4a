"""What a front leaves behind is a tube where it is of one width along one line; else only its arrival is followed."""

from __future__ import annotations

import numpy as np
import pytest

from vinetrack.core.records import Trial
from vinetrack.video.axis import Axis
from vinetrack.video.follow import follow
from vinetrack.video.tube_strip import LIKE_A_TUBE, tube_strip

AXIS = Axis((0.0, 60.0), (299.0, 60.0), 70.0)


def pictures(half_px: np.ndarray, seed: int) -> np.ndarray:
    """A bright front that passes 5 columns a frame over noise, and half the width of what stays, by column, px."""
    n, rows, columns = 72, 121, len(half_px)
    luma = np.random.default_rng(seed).normal(60, 2, (n, rows, columns))
    across = np.abs(np.arange(rows) - rows // 2)[:, None]
    for i in range(n):
        luma[i] += 90 * ((np.arange(columns) < 5 * (i - 8)) & (across <= half_px))
    return np.clip(luma, 0, 255).astype(np.uint8)


def tube() -> np.ndarray:
    return pictures(np.full(300, 20), 81)


def blots() -> np.ndarray:
    """Widths from 8 to 60 px, hardly two of twelve stretches alike."""
    return pictures(np.repeat([4, 30, 9, 24, 15, 6, 28, 12, 21, 5, 26, 17], 25), 82)


def test_a_tube_is_one_even_where_little_of_the_change_is_its_front():
    about = tube_strip(tube(), AXIS, LIKE_A_TUBE)
    assert about is not None
    assert about[1].alike == 1.0
    assert about[1].width_px == pytest.approx(41, abs=2)


def test_what_is_of_no_width_is_no_tube_unless_all_its_change_is_in_order():
    assert tube_strip(blots(), AXIS, 0.5) is None


@pytest.mark.parametrize(("luma", "is_edge"), [(tube(), True), (blots(), False)], ids=["tube", "blots"])
def test_of_what_is_no_tube_the_arrival_is_followed(luma, is_edge):
    trial = Trial(name="t", capture_fps=1000.0, m_per_px=1.0)
    _, positions = follow(luma, trial, AXIS, 0.1, 0.5)
    assert positions.is_edge == is_edge
    moving = slice(14, 60)
    expected = 5.0 * (np.arange(len(luma)) - 8)
    assert np.abs(positions.edge_px - expected)[moving].max() < (3 if is_edge else 12)


def test_a_front_that_hardly_any_change_belongs_to_is_not_asked_for_its_sides():
    _, positions = follow(tube(), Trial(name="t", capture_fps=1000.0, m_per_px=1.0), AXIS, 0.1, 0.3)
    assert not positions.is_edge
