"""Points moved, dropped and confirmed by hand reach the track, next to the tracker's own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from plain_scene import Plan, plain_scene, write_video

from vinetrack.core.records import Correction, Track, Trial
from vinetrack.video.calibration import corrected_by_hand
from vinetrack.video.track import track_recording


def px_track(n: int = 6) -> Track:
    flag = np.array(["", "doubtful", "lost", "gap", "", "after_end"], dtype="<U64")[:n]
    edge = np.arange(n, dtype=float) * 10
    edge[2] = np.nan
    return Track(np.arange(n) / 1000, np.full(n, np.nan), np.full(n, 0.1), flag, edge)


def test_a_moved_point_is_usable_again_and_has_the_error_of_a_click() -> None:
    out = corrected_by_hand(px_track(), [Correction(2, "move", 21.5)])
    assert out.edge_px[2] == 21.5
    assert out.flag[2] == "corrected"
    assert out.lead_position_sigma_m[2] == 0.5
    assert out.tracked_px is not None
    assert np.isnan(out.tracked_px[2])


def test_a_dropped_point_is_rejected_and_a_confirmed_one_no_longer_doubtful() -> None:
    out = corrected_by_hand(px_track(), [Correction(0, "drop"), Correction(1, "confirm"), Correction(3, "move", 29.0)])
    assert list(out.flag[[0, 1, 3]]) == ["rejected;corrected", "corrected", "corrected;gap"]
    assert np.isnan(out.edge_px[0])
    assert out.tracked_px is not None
    assert out.tracked_px[0] == 0.0
    assert "1 dropped, 1 confirmed, 1 moved" in out.notes[-1]


def test_impossible_corrections_are_reported_and_change_nothing() -> None:
    out = corrected_by_hand(px_track(), [Correction(99, "drop"), Correction(2, "confirm")])
    assert list(out.flag) == list(px_track().flag)
    assert len(out.notes) == 2


def test_the_given_track_is_unchanged() -> None:
    track = px_track()
    corrected_by_hand(track, [Correction(0, "drop")])
    assert track.edge_px[0] == 0.0


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> Path:
    plan = Plan(width=480, height=160, from_px=(20, 80), start_px=40, end_px=400, speed=14, radius=20)
    return write_video(tmp_path_factory.mktemp("film") / "a.mp4", plain_scene(plan).frames)


def test_a_recording_is_tracked_with_its_corrections(film: Path) -> None:
    plain = Trial(name="a", video=film, capture_fps=1000.0, m_per_px=2.5e-4)
    before = track_recording(plain).track
    given = (Correction(20, "move", float(before.edge_px[20]) + 4), Correction(25, "drop"))
    after = track_recording(Trial(**{**vars(plain), "corrections": given})).track
    assert after.lead_position_m[20] - before.lead_position_m[20] == pytest.approx(4 * 2.5e-4)
    assert not after.usable[25]
    others = np.setdiff1d(np.arange(len(before.edge_px)), [20, 25])
    np.testing.assert_array_equal(after.edge_px[others], before.edge_px[others])
    np.testing.assert_array_equal(after.tracked_px, before.edge_px)
    assert [i for i, flag in enumerate(after.flag) if "corrected" in flag] == [20, 25]
