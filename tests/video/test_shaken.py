"""A camera that shakes: positions are free of it, and it is known where the edge lies in each picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from plain_scene import Plan, plain_scene

from vinetrack.core.records import Trial
from vinetrack.video.frames import Frames, Recording, Region
from vinetrack.video.track import Tracking, track_frames


def tracked(plan: Plan) -> tuple[Tracking, np.ndarray]:
    """Tracking of a scene, and its pictures."""
    luma = plain_scene(plan).frames
    n, height, width = luma.shape
    recording = Recording(Path("scene.mp4"), "container", width, height, 8, n)
    frames = Frames(recording, Region(0, 0, width, height), luma, np.arange(n), np.zeros(n, dtype=bool))
    trial = Trial(name="t", capture_fps=1000.0, exposure_s=plan.exposure / 1000.0, m_per_px=1e-3)
    return track_frames(frames, trial, 1000.0), luma


def test_shake_added_to_a_position_is_where_the_edge_is_seen():
    """At rest the edge is where each picture has it: seen there, less the tracked one, is the shake, of rms 0.8 px."""
    found, luma = tracked(Plan(seed=41, shake=1.2, rest_frames=40))
    resting = slice(0, 38)
    rows = luma[resting, 115:126, 60:160].astype(float).mean(axis=1)
    half = (rows[:, :20].mean() + rows[:, -40:].mean()) / 2
    seen_px = 60 + np.argmax(rows < half, axis=1) - 1
    before, after = (rows[np.arange(38), seen_px - 60 + k] for k in (0, 1))
    seen_px = seen_px + (before - half) / (before - after)
    off_px = seen_px - found.axis.points(found.track.edge_px[resting])[:, 0]
    off_px -= np.nanmean(off_px)
    shake_px = found.shake_px[resting] - found.shake_px[resting].mean()
    assert np.std(off_px) > 0.6
    assert np.nanstd(off_px - shake_px) < 0.15


def test_a_camera_that_stands_still_has_no_shake():
    found, luma = tracked(Plan(seed=13, end_px=300, width=420, rest_frames=6, end_frames=4))
    assert found.shake_px.shape == (len(luma),)
    assert not found.shake_px.any()
