"""A front leaves a tube where one front passes along its middle; elsewhere only the arrival is followed."""

from __future__ import annotations

import numpy as np
import pytest

from vinetrack.core.records import Trial
from vinetrack.video.axis import LEAST_FRONT_SHARE, Axis
from vinetrack.video.curved_axis import front_share_function
from vinetrack.video.small_pictures import SmallPictures
from vinetrack.video.track import follow, tube_strip

AXIS = Axis((0.0, 66.0), (299.0, 66.0), 70.0)
"""Six rows beside the middle of the tube."""
TRIAL = Trial(name="t", capture_fps=1000.0, m_per_px=1.0)


def tube() -> np.ndarray:
    """A bright front that passes 5 columns a frame over noise and leaves 41 rows changed behind it."""
    n, rows, columns = 72, 121, 300
    luma = np.random.default_rng(81).normal(60, 2, (n, rows, columns))
    across = np.abs(np.arange(rows) - rows // 2)[:, None]
    for i in range(n):
        luma[i] += 90 * ((np.arange(columns) < 5 * (i - 8)) & (across <= 20))
    return np.clip(luma, 0, 255).astype(np.uint8)


def front_share_is(share_beside: float, share_on_axis: float = 1.0):
    """A front share along the axis given, and another along any other axis."""
    return lambda axis: share_on_axis if axis is AXIS else share_beside


def test_the_strip_is_centred_on_the_tube():
    luma = tube()
    order = front_share_function(SmallPictures(luma), luma)
    strip, sides = tube_strip(luma, AXIS, order)
    assert sides.width_px == pytest.approx(41, abs=2)
    assert strip.axis.from_px[1] == pytest.approx(60, abs=0.8)
    assert order(strip.axis) > 0.9


def test_a_front_share_at_the_limit_is_a_tube():
    assert tube_strip(tube(), AXIS, front_share_is(LEAST_FRONT_SHARE, LEAST_FRONT_SHARE)) is not None


@pytest.mark.parametrize(
    "order",
    [front_share_is(1.0, LEAST_FRONT_SHARE - 0.01), front_share_is(LEAST_FRONT_SHARE - 0.01)],
    ids=["along the axis", "along the middle"],
)
def test_without_a_front_only_the_arrival_is_followed(order):
    luma = tube()
    assert tube_strip(luma, AXIS, order) is None
    _, positions = follow(luma, TRIAL, AXIS, 0.1, order)
    assert not positions.is_edge
    moving = slice(14, 60)
    assert np.abs(positions.edge_px - 5.0 * (np.arange(len(luma)) - 8))[moving].max() < 3


def test_the_edge_of_a_tube_is_followed():
    luma = tube()
    _, positions = follow(luma, TRIAL, AXIS, 0.1, front_share_is(1.0))
    assert positions.is_edge
    assert np.abs(positions.edge_px - 5.0 * (np.arange(len(luma)) - 8))[14:60].max() < 3
