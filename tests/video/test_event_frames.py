"""Long recordings: only the frames about the event are decoded, and the track is the one of the whole recording."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from camera_files import write_cine
from plain_scene import Plan, Scene, plain_scene, write_video

from vinetrack.core.records import Track, Trial
from vinetrack.video import small_pictures
from vinetrack.video.frames import inspect_recording, read_frames
from vinetrack.video.small_pictures import MARGIN_FRAMES, event_range, read_event
from vinetrack.video.track import track_recording

BEFORE, AFTER = 300, 180
"""Frames of rest beyond those of the scene."""


Filmed = tuple[Scene, np.ndarray]


@pytest.fixture(scope="module")
def filmed():
    """A scene, and its frames with rest before and after it, each frame of rest with grain of its own."""
    scene = plain_scene(
        Plan(seed=20942, width=384, height=96, from_px=(24.0, 48.0), end_px=320.0, radius=14.0, speed=9.0)
    )
    first, last = np.repeat(scene.frames[:1], BEFORE, 0), np.repeat(scene.frames[-1:], AFTER, 0)
    frames, rng = np.concatenate([first, scene.frames, last]), np.random.default_rng(20943)
    for rest in (slice(None, BEFORE), slice(-AFTER, None)):
        grain = np.rint(rng.normal(0, 2.0, frames[rest].shape))
        frames[rest] = np.clip(frames[rest] + grain, 0, 255).astype(np.uint8)
    return scene, frames


def track(path: Path, **stated: object) -> Track:
    return track_recording(replace(Trial(name="t", video=path, capture_fps=1000.0, exposure_s=2e-4), **stated)).track


@pytest.mark.slow
@pytest.mark.parametrize("key_frames", ["30", "5000", "1"])
def test_of_a_long_film_the_event_is_decoded_and_no_more(filmed, tmp_path, monkeypatch, key_frames):
    """With a key frame every 30, with one, and with key frames alone; tracked as the whole film is."""
    scene, long_frames = filmed
    film = write_video(tmp_path / "long.mp4", long_frames, options={"crf": "14", "g": key_frames})
    whole, whole_track = read_frames(film), track(film)
    monkeypatch.setattr(small_pictures, "MAX_BYTES_WHOLE", 0)
    frames, part = read_event(inspect_recording(film)), track(film)
    moving = np.flatnonzero(scene.moving) + BEFORE
    assert frames.first <= moving[0] - 40
    assert frames.first + len(frames) > moving[-1] + 40
    assert len(frames) < len(moving) + 2 * (MARGIN_FRAMES + 60)
    assert frames.n_recorded == len(long_frames)
    same = slice(frames.first, frames.first + len(frames))
    assert np.array_equal(frames.luma, whole.luma[same])
    assert np.array_equal(frames.slot, whole.slot[same])
    assert len(part.time_s) == len(whole_track.time_s)
    assert part.time_s == pytest.approx(whole_track.time_s)
    known = np.isfinite(part.edge_px[moving]) & np.isfinite(whole_track.edge_px[moving])
    assert known.mean() > 0.95
    assert np.std((part.edge_px - whole_track.edge_px)[moving][known]) < 0.05
    assert set(part.flag[: BEFORE - 150]) == {"before_release"}
    assert set(part.flag[-100:]) == {"after_end"}
    assert np.std(part.edge_px[moving][known] - scene.edge_px[moving - BEFORE][known]) < 0.3
    # Frames that the sheet names are those that are decoded.
    wanted = (BEFORE - 20, BEFORE + len(scene.frames) - 1)
    frames = read_event(inspect_recording(film), wanted)
    assert (frames.first, frames.first + len(frames) - 1) == wanted
    made = track(film, frames_used=wanted)
    assert np.isfinite(made.edge_px).sum() > 0.9 * scene.moving.sum()
    assert not np.isfinite(made.edge_px[: wanted[0]]).any()


@pytest.mark.slow
def test_of_a_long_cine_the_event_is_read_and_no_more(filmed, tmp_path, monkeypatch):
    scene, long_frames = filmed
    monkeypatch.setattr(small_pictures, "MAX_BYTES_WHOLE", 0)
    missing = np.delete(np.arange(len(long_frames) + 1), BEFORE + 30) / 1000 + 0.2
    deep = long_frames.astype(np.uint16) * 16
    path = write_cine(tmp_path / "long.cine", deep, rate=1000, exposure_ns=200_000, times_s=missing)
    frames = read_event(inspect_recording(path))
    same = slice(frames.first, frames.first + len(frames))
    assert len(frames) < len(scene.frames) + 2 * (MARGIN_FRAMES + 20)
    assert np.array_equal(frames.luma, deep[same])
    assert np.array_equal(frames.slot, np.rint((missing - 0.2) * 1000)[same])
    made = track(path, capture_fps=np.nan, exposure_s=np.nan)
    assert len(made.time_s) == len(long_frames)
    assert made.time_s[-1] == pytest.approx(len(long_frames) / 1000 + 1e-4)


def test_the_event_lies_between_the_pictures_that_differ_from_either_end():
    rng = np.random.default_rng(8)
    pictures = [rng.normal(80, 1.5, (48, 64)).clip(0, 255).astype(np.uint8) for _ in range(60)]
    for i in range(20, 60):
        pictures[i][20:30, : min(60, 4 * (i - 19))] = 170
    numbers = np.arange(60) * 50
    # From picture 19, the last at rest, to 34, the first at the end, and a margin of MARGIN_PART of that.
    assert event_range(pictures, numbers, 3000) == (19 * 50 - 112, 34 * 50 + 112)
    assert event_range(pictures[:20], numbers[:20], 1000) is None
