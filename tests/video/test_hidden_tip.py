"""A tip behind a door or in the mouth of a launcher is doubtful or lost, never ok; a visible one keeps its points."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from plain_scene import Plan, Scene, plain_scene
from tracking_accuracy import along_axis, film

from vinetrack.core.records import Track, Trial, with_flag
from vinetrack.laboratory.filming import render_recording
from vinetrack.laboratory.scene import Camera, Door, preset
from vinetrack.video.frames import Frames, Recording, inspect_recording, read_frames
from vinetrack.video.track import track_frames, track_recording

FPS = 1000.0
SHORT = Plan(seed=520, width=640, height=200, from_px=(20.0, 100.0), end_px=520.0, rest_frames=15)


def tracked(scene: Scene) -> Track:
    frames, plan = scene.frames, scene.plan
    recording = Recording(Path("scene.mp4"), "container", frames.shape[2], frames.shape[1], 8, len(frames))
    nothing = np.zeros(len(frames), dtype=bool)
    trial = Trial(name="t", capture_fps=FPS, exposure_s=plan.exposure / FPS, m_per_px=1.0)
    return track_frames(Frames(recording, recording.whole, frames, np.arange(len(frames)), nothing), trial, FPS).track


def ok(track: Track) -> np.ndarray:
    """Points without any flag."""
    return track.usable & ~with_flag(track.flag, "doubtful")


@pytest.mark.parametrize("grey", [20.0, 110.0, 200.0])
@pytest.mark.parametrize(("speed", "rise"), [(20.0, 8.0), (6.0, 20.0)], ids=["fast", "slow"])
def test_a_tip_in_the_mouth_of_a_launcher_is_never_ok(speed, rise, grey):
    scene = plain_scene(replace(SHORT, speed=speed, rise_frames=rise, mouth=30.0, mouth_grey=grey))
    track = tracked(scene)
    hidden = scene.edge_px < scene.plan.start_px + 30
    assert hidden.sum() > 15
    assert not ok(track)[hidden].any()
    seen = scene.moving & (scene.edge_px > scene.plan.start_px + 45)
    assert ok(track)[seen].mean() > 0.9
    off = (track.edge_px - scene.edge_px)[seen & ok(track)]
    assert np.std(off) < 0.5


def test_a_tip_flush_with_the_mouth_is_doubtful_and_stays():
    """One pixel of it is covered: where the tip rests is seen, though not that it is the tip."""
    scene = plain_scene(replace(SHORT, mouth=1.0))
    track = tracked(scene)
    rest = np.arange(SHORT.rest_frames)
    assert with_flag(track.flag, "doubtful")[rest].all()
    assert track.usable[rest].all()


@pytest.mark.parametrize("film", [175.0, 20.0])
def test_a_tip_at_rest_in_sight_stays_ok(film):
    scene = plain_scene(replace(SHORT, film=film))
    assert ok(tracked(scene))[: SHORT.rest_frames].all()


@pytest.mark.parametrize("door", [Door(), None], ids=["door", "no door"])
def test_points_about_a_door_that_swings_are_doubtful(door, tmp_path):
    scene = replace(preset("demo"), door=door, camera=Camera(width_px=640, height_px=240))
    fps, release_s, length_m = 1069.0, 0.015, 0.14

    def motion(time_s):
        t = np.clip(np.asarray(time_s, float) - release_s, 0, None)
        return np.minimum(5.0 * (t - 0.008 * (1 - np.exp(-t / 0.008))), length_m)

    path = tmp_path / "a.mp4"
    truth = render_recording(scene, motion, n_frames=66, capture_fps=fps, out_path=path, seed=20521)
    trial = Trial(name="a", video=path, capture_fps=fps, exposure_s=truth.exposure_s, m_per_px=1.0)
    track = track_recording(trial).track
    begin = float(truth.lead_px[0])
    behind = (truth.lead_px > begin + 2) & (truth.lead_px < begin + 12)
    if door is None:
        assert ok(track)[behind].all()
    else:
        assert not ok(track)[behind].any()
    beyond = (truth.lead_px > begin + 80) & (truth.lead_px < truth.lead_px.max() - 5)
    assert ok(track)[beyond].all()


def test_the_errors_near_a_start_that_a_door_leaves_are_stated(tmp_path: Path) -> None:
    """Rendered; what the door misplaces is the same in all bands of rows, so that they do not show it."""
    errors, stated = [], []
    for seed in (901, 903):
        path, truth = film(preset("downward"), "downward", seed, tmp_path, 6.0)
        trial = Trial(name="t", video=path, capture_fps=FPS, exposure_s=truth.exposure_s, m_per_px=1.0)
        tracking = track_frames(read_frames(inspect_recording(path)), trial, FPS)
        track = tracking.track
        use = track.usable & (np.gradient(truth.lead_px) > 0.05) & np.isfinite(truth.lead_px)
        error = (track.edge_px - along_axis(truth, tracking))[use]
        errors.append(error - error.mean())
        assert track.lead_position_systematic_m is not None
        stated.append(np.hypot(track.lead_position_sigma_m, track.lead_position_systematic_m)[use])
    ratio = np.sqrt(np.mean(np.concatenate(errors) ** 2) / np.mean(np.concatenate(stated) ** 2))
    assert 0.6 < ratio < 1.3
