"""Points corrected by hand are marked in the figures that show points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from plain_scene import Plan, plain_scene

from vinetrack.core.records import Correction, Trial, hand_corrected, join_flags, with_flag
from vinetrack.figures.overlay import draw_strip
from vinetrack.video.frames import Frames, Recording
from vinetrack.video.track import Tracking, track_frames


@pytest.fixture(scope="module")
def tracking() -> Tracking:
    from pathlib import Path

    luma = plain_scene(
        Plan(width=480, height=160, from_px=(20, 80), start_px=40, end_px=400, speed=14, radius=20)
    ).frames
    recording = Recording(Path("a.mp4"), "container", 480, 160, 8, len(luma))
    frames = Frames(recording, recording.whole, luma, np.arange(len(luma)), np.zeros(len(luma), dtype=bool))
    given = (Correction(20, "move", 150.0), Correction(22, "confirm"))
    return track_frames(frames, Trial(name="a", capture_fps=1000.0, corrections=given), 1000.0, m_per_px=2.5e-4)


def words(tracking: Tracking) -> str:
    figure = draw_strip("a", tracking, 2.5e-4)
    return " ".join(text.get_text() for text in figure.findobj(lambda artist: hasattr(artist, "get_text")))


def test_the_strip_says_how_many_points_were_corrected(tracking: Tracking) -> None:
    assert "corrected by hand, N = 2" in words(tracking)


def test_a_strip_without_corrections_says_nothing_of_them(tracking: Tracking) -> None:
    track = tracking.track
    plain = replace(track, flag=np.where(hand_corrected(track.flag), "", track.flag), tracked_px=None)
    assert "corrected" not in words(replace(tracking, track=plain))


def test_a_corrected_time_does_not_count_as_a_point_corrected_by_hand() -> None:
    flags = ["corrected", "gap;retimed", "", "rejected;corrected", "corrected;gap;retimed"]
    assert list(hand_corrected(flags)) == [True, False, False, True, True]


def test_the_flags_of_earlier_releases_are_read_as_corrected_times() -> None:
    assert list(hand_corrected(["gap;corrected", "doubtful;gap;corrected"])) == [False, False]
    assert list(with_flag(["gap;corrected", "corrected;gap"], "retimed")) == [True, False]
    assert join_flags("gap;corrected", "doubtful") == "doubtful;gap;retimed"
