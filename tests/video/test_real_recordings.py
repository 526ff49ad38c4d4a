"""Recordings made by others, read from the folder that VINETRACK_REAL_DATA names; skipped where it is unset."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from vinetrack.core.records import Track, Trial
from vinetrack.video.axis import Axis
from vinetrack.video.frames import RecordingError, read_frames
from vinetrack.video.track import track_frames, track_recording

FOLDER = os.environ.get("VINETRACK_REAL_DATA", "")
pytestmark = [
    pytest.mark.real,
    pytest.mark.skipif(not FOLDER, reason="VINETRACK_REAL_DATA is unset: no real recordings to try"),
]
REAL = Path(FOLDER)
RULER_M_PER_PX = 0.27307e-3


GIVEN = {
    "axis found": None,
    "axis given": Axis((161.0, 40.0), (151.0, 799.0)),
    "axis given, narrow": Axis((161.0, 40.0), (151.0, 799.0), 30.0),
    "axis given, wide": Axis((161.0, 40.0), (151.0, 799.0), 160.0),
    "axis 3 degrees off": Axis((176.0, 20.0), (136.0, 790.0), 60.0),
}


@pytest.mark.parametrize("axis", GIVEN.values(), ids=GIVEN)
def test_free_fall_gives_g(axis):
    trial = Trial(
        name="ball", video=REAL / "freefall_1000fps" / "freefall.mp4", capture_fps=1000.0, m_per_px=RULER_M_PER_PX,
        travel_ratio=1,
    )  # fmt: skip
    track = track_recording(trial, axis).track
    falling = track.usable & np.array(["before_release" not in flag for flag in track.flag])
    assert falling.sum() > 150
    time, position = track.time_s[falling], track.lead_position_m[falling]
    fall = np.polyfit(time, position, 2)
    assert 9.5 < 2 * fall[0] < 9.7
    assert np.std(position - np.polyval(fall, time)) < 0.15 * RULER_M_PER_PX


@pytest.mark.parametrize("axis", [None, Axis((20.0, 95.0), (250.0, 95.0), 22.0)], ids=["axis found", "axis given"])
def test_growing_vine_is_followed_to_the_wall(axis):
    trial = Trial(name="vine", video=REAL / "vine_growth", capture_fps=30.0, m_per_px=1.0)
    tracking = track_recording(trial, axis)
    track = tracking.track
    x = tracking.axis.points(track.edge_px)[:, 0]
    free = track.usable & (x > 55) & (x < 200)
    assert free.sum() > 80
    slope = np.polyfit(np.flatnonzero(free), x[free], 1)[0]
    assert 1.3 < slope < 1.6
    assert np.nanmin(x) < 55
    assert np.nanmax(x) > 210
    assert any("it met a wall" in note for note in track.notes)


@pytest.mark.parametrize("seed", [1, 2, 6, (10, 0), (12, 0)])
def test_a_growing_vine_is_followed_whatever_a_processor_rounds(seed):
    """One pixel in twenty is a grey level brighter or darker."""
    trial = Trial(name="vine", video=REAL / "vine_growth", capture_fps=30.0, m_per_px=1.0)
    frames = read_frames(trial.video)
    rng = np.random.default_rng(seed)
    shape = frames.luma.shape
    luma = np.clip(frames.luma + rng.integers(-1, 2, shape) * (rng.random(shape) < 0.05), 0, 255).astype(np.uint8)
    tracking = track_frames(replace(frames, luma=luma), trial, 30.0)
    x = tracking.axis.points(tracking.track.edge_px)[:, 0]
    free = tracking.track.usable & (x > 55) & (x < 200)
    assert free.sum() > 80
    assert 1.3 < np.polyfit(np.flatnonzero(free), x[free], 1)[0] < 1.6


CUP_COLUMN = {1: 180.0, 2: 191.0, 3: 204.0, 5: 228.0, 6: 240.0, 7: 251.0, 8: 263.0}
"""Where in the picture cups of 6 px fall side by side, px."""


def cup(number: int, width_px: float) -> Track:
    trial = Trial(name="cup", video=REAL / "falling_cups" / "frames", capture_fps=10.101, m_per_px=1.0, travel_ratio=1)
    column = CUP_COLUMN[number]
    return track_recording(trial, Axis((column, 15.0), (column, 238.0), width_px)).track


@pytest.mark.parametrize("number", [2, 5, 6, 7, 8])
def test_a_cup_among_others_is_followed_until_it_leaves_the_picture(number):
    measured = np.loadtxt(REAL / "falling_cups" / f"cup{number}.csv", delimiter=",", skiprows=1)[:, 1] / 0.0114988
    track = cup(number, 10.0)
    assert not track.usable[len(measured) :].any()
    used = np.flatnonzero(track.usable)
    assert len(used) >= 7
    off = track.edge_px[used] - measured[used]
    assert np.abs(off - np.median(off)).max() < 1.5


@pytest.mark.parametrize("number", [1, 3])
def test_an_axis_so_wide_that_no_cup_can_be_told_from_others_is_refused(number):
    with pytest.raises(RecordingError):
        cup(number, 60.0)


def test_the_picture_that_is_not_a_frame_is_left_out():
    frames = read_frames(REAL / "vine_growth")
    assert len(frames) == 212
    assert any("frame_ref.jpg" in note for note in frames.notes)


def test_tossed_ball_is_read_whole():
    frames = read_frames(REAL / "balltoss" / "balltoss.mp4")
    assert frames.luma.shape == (13, 480, 640)
    assert frames.notes == ()
