"""Recordings made by others, read from the folder that VINETRACK_REAL_DATA names; skipped where it is unset."""

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from vinetrack.core.records import Track, Trial, with_flag
from vinetrack.video.axis import Axis
from vinetrack.video.frames import RecordingError, read_frames
from vinetrack.video.track import track_frames, track_recording

pytestmark = pytest.mark.real


GIVEN = [Axis((161.0, 40.0), (151.0, 799.0), width_px) for width_px in (math.nan, 30.0, 160.0)]


@pytest.mark.parametrize("axis", [None, *GIVEN, Axis((176.0, 20.0), (136.0, 790.0), 60.0)])
def test_free_fall_gives_g(real, axis):
    scale_m = 0.27307e-3
    film = real / "freefall_1000fps" / "freefall.mp4"
    trial = Trial(name="ball", video=film, capture_fps=1000.0, m_per_px=scale_m, travel_ratio=1)
    track = track_recording(trial, axis).track
    falling = track.usable & ~with_flag(track.flag, "before_release")
    assert falling.sum() > 150
    time, position = track.time_s[falling], track.lead_position_m[falling]
    fall = np.polyfit(time, position, 2)
    assert 9.5 < 2 * fall[0] < 9.7
    assert np.std(position - np.polyval(fall, time)) < 0.15 * scale_m


@pytest.mark.parametrize("given", ["found", "drawn", 1, 2, 6, (10, 0), (12, 0)])
def test_growing_vine_is_followed_to_the_wall(real, given):
    """Along an axis found or drawn, and whatever a processor rounds: one pixel in twenty brighter or darker by one."""
    axis = Axis((20.0, 95.0), (250.0, 95.0), 22.0) if given == "drawn" else None
    trial = Trial(name="vine", video=real / "vine_growth", capture_fps=30.0, m_per_px=1.0)
    frames = read_frames(trial.video)
    if not isinstance(given, str):
        rng, shape = np.random.default_rng(given), frames.luma.shape
        luma = frames.luma + rng.integers(-1, 2, shape) * (rng.random(shape) < 0.05)
        frames = replace(frames, luma=np.clip(luma, 0, 255).astype(np.uint8))
    tracking = track_frames(frames, trial, 30.0, axis)
    x = tracking.axis.points(tracking.track.edge_px)[:, 0]
    free = tracking.track.usable & (x > 55) & (x < 200)
    assert free.sum() > 80
    assert 1.3 < np.polyfit(np.flatnonzero(free), x[free], 1)[0] < 1.6
    if isinstance(given, str):
        assert np.nanmin(x) < 55
        assert np.nanmax(x) > 210
        stops = re.search(r"stops at (\d+) px after frame (\d+)", " ".join(tracking.track.notes))
        assert abs(int(stops[1]) - np.nanmax(tracking.track.edge_px)) < 5
        assert 140 < int(stops[2]) < 170


def cup(real: Path, number: int, width_px: float) -> Track:
    trial = Trial(name="cup", video=real / "falling_cups" / "frames", capture_fps=10.101, m_per_px=1.0, travel_ratio=1)
    # Where in the picture cups of 6 px fall side by side
    column = {1: 180.0, 2: 191.0, 3: 204.0, 5: 228.0, 6: 240.0, 7: 251.0, 8: 263.0}[number]
    return track_recording(trial, Axis((column, 15.0), (column, 238.0), width_px)).track


@pytest.mark.parametrize("number", [2, 5, 6, 7, 8])
def test_a_cup_among_others_is_followed_until_it_leaves_the_picture(real, number):
    measured = np.loadtxt(real / "falling_cups" / f"cup{number}.csv", delimiter=",", skiprows=1)[:, 1] / 0.0114988
    track = cup(real, number, 10.0)
    assert not track.usable[len(measured) :].any()
    used = np.flatnonzero(track.usable)
    assert len(used) >= 6  # of cup 8, 6 px wide, in 9 frames: 6 or 7, as a processor rounds
    off = track.edge_px[used] - measured[used]
    assert np.abs(off - np.median(off)).max() < 1.5


@pytest.mark.parametrize("number", [1, 3])
def test_an_axis_so_wide_that_no_cup_can_be_told_from_others_is_refused(real, number):
    with pytest.raises(RecordingError):
        cup(real, number, 60.0)
