"""A vine that stops where its length ends has grown completely; one that stops elsewhere is reported."""

from __future__ import annotations

import numpy as np
import pytest

from vinetrack.video.point_quality import PointQuality, is_grown

EDGE_PX = np.concatenate([np.full(10, 100.0), np.linspace(100, 500, 40), np.full(6, 500.0)])


def quality(first_moving: int = 10, last_moving: int = 49) -> PointQuality:
    slot = np.arange(EDGE_PX.size)
    without_edge = np.zeros(slot.size, dtype=bool)
    flag = np.full(slot.size, "", dtype="<U64")
    return PointQuality(flag, slot, (), first_moving, last_moving, None, without_edge, np.zeros(slot.size))


@pytest.mark.parametrize(("length_px", "grown"), [(400, True), (405, True), (395, True), (430, False), (370, False)])
def test_travel_is_compared_with_the_length(length_px: float, grown: bool) -> None:
    assert is_grown(EDGE_PX, quality(), length_px) is grown


@pytest.mark.parametrize("judged", [quality(first_moving=0), quality(last_moving=EDGE_PX.size - 1), quality(-1, -1)])
def test_without_rest_or_end_full_growth_is_unknown(judged: PointQuality) -> None:
    assert not is_grown(EDGE_PX, judged, 400.0)


def test_without_a_length_or_scale_full_growth_is_unknown() -> None:
    assert not is_grown(EDGE_PX, quality(), np.nan)
