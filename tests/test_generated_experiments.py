"""Experiments that `check` lets through reach the end of their run, however odd their motion and their clips."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from generated_experiments import is_let_through, run_through, write_experiment
from plain_scene import write_video

from vinetrack.core.records import Trial
from vinetrack.video.frames import RecordingError
from vinetrack.video.track import track_recording


@pytest.mark.slow
@pytest.mark.parametrize("seed", [21402, 21403, 31114, 31207])
def test_a_drawn_experiment_meets_no_fault_of_the_program(tmp_path: Path, seed: int) -> None:
    write_experiment(tmp_path / "drawn", seed)
    assert not is_let_through(tmp_path / "drawn") or run_through(tmp_path / "drawn", tmp_path / "out", False) == []


@pytest.mark.slow
def test_a_single_trial_of_a_falling_ball_reaches_the_end(tmp_path: Path) -> None:
    folder = tmp_path / "ball"
    folder.mkdir()
    time_s = np.arange(30) / 240
    position_m = 0.5 * 9.81 * np.clip(time_s - 0.02, 0, None) ** 2 + np.random.default_rng(1).normal(0, 2e-4, 30)
    lines = [f"{t:.5f},{y:.6f}" for t, y in zip(time_s, position_m, strict=True)]
    (folder / "b.csv").write_text("\n".join(["time_s,position_m", *lines, ""]))
    (folder / "trials.csv").write_text("trial,track,diameter_mm,payload_g,travel_ratio\nb,b.csv,20,30,1\n")
    (folder / "experiment.yaml").write_text("model: [gravity]\n")
    assert is_let_through(folder)
    assert run_through(folder, tmp_path / "out") == []


X, Y = np.meshgrid(np.arange(160), np.arange(64))
WALL = np.random.default_rng(0).integers(60, 120, X.shape)
TUBE = (Y > 20) & (Y < 40)
BAD_CLIPS = {
    "black": [0 * X] * 20,
    "still": [WALL] * 20,
    "flash": [np.full(X.shape, 255) if i == 10 else WALL for i in range(20)],
    "step of light": [WALL if i < 10 else WALL + 90 for i in range(20)],
    "blinking": [np.where((X > 60) & (X < 100) & TUBE & (i % 2 == 0), 200, WALL) for i in range(20)],
    "all at once": [np.where(i >= 5, 200, WALL) for i in range(20)],
    "teleport": [np.where((abs(X - (30 if i < 10 else 130)) < 10) & TUBE, 220, WALL) for i in range(20)],
    "cut off": [np.where((5 * i > X) & TUBE, 200, WALL) if i < 9 else 0 * X for i in range(19)],
}


@pytest.mark.parametrize("name", BAD_CLIPS)
def test_a_bad_clip_is_refused_in_a_sentence(tmp_path: Path, name: str) -> None:
    """Warnings are errors in tests: nothing is computed from an empty stretch on the way."""
    frames = np.clip(BAD_CLIPS[name], 0, 255).astype(np.uint8)
    path = write_video(tmp_path / "a.mkv", frames, "ffv1", "gray", playback_fps=30)
    trial = Trial(name="a", video=path, capture_fps=1000.0, m_per_px=2e-4, diameter_m=0.004, length_m=0.03)
    with pytest.raises(RecordingError):
        track_recording(trial)
