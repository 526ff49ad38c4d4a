"""Hidden frames that do not lead up to the motion after them: something else was followed in place of the tip."""

from __future__ import annotations

import numpy as np
import pytest

from vinetrack.video.edge_repair import leap_error_px

FRAMES = np.arange(40.0)


def released(frame: float, acceleration: float = 3.0) -> np.ndarray:
    """At rest at 100 px until a moment between frames, then at an even acceleration."""
    return 100.0 + 0.5 * acceleration * np.clip(FRAMES - frame, 0.0, None) ** 2


@pytest.mark.parametrize("frame", [8.0, 8.3, 8.7, 8.99])
@pytest.mark.parametrize("seed", [351, 352])
def test_a_tip_followed_from_rest_has_no_leap(frame: float, seed: int) -> None:
    edge = released(frame) + np.random.default_rng(seed).normal(0, 0.1, FRAMES.size)
    assert leap_error_px(edge, FRAMES < 14).max() == 0.0


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_a_vine_whose_speed_settles_within_a_frame_has_no_leap(share: float) -> None:
    edge = 100.0 + 20.0 * np.clip(FRAMES - 8.0 - share, 0.0, None)
    assert leap_error_px(edge, FRAMES < 14).max() == 0.0


def test_a_followed_door_is_off_by_its_distance_from_the_extrapolated_motion() -> None:
    true = released(8.3)
    edge = true.copy()
    edge[:14] = 130.0 + 0.8 * FRAMES[:14]  # the tip comes out at frame 14, at 149 px
    error = leap_error_px(edge, FRAMES < 16)
    assert error[14:].max() == 0.0
    assert error[:14] == pytest.approx(np.abs(edge - true)[:14], abs=6.0)
    assert error[:10].min() > 20.0


def test_visible_frames_have_no_leap_error() -> None:
    edge = released(8.3)
    edge[:14] = 130.0
    assert leap_error_px(edge, np.zeros(40, dtype=bool)).max() == 0.0
