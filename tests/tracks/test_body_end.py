"""Imported tracks of bodies end with a bounce or an abrupt stop, and nowhere else. Seeds 620 and up."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from vine_truth import make_track

from vinetrack.core.records import Trial, with_flag
from vinetrack.tracks.importers import flag_end_of_body, load_track

CLOCK_S = np.arange(120) / 200
NOISE_M = 2e-4


def ended(position_m: np.ndarray, seed: int = 620):
    noise = np.random.default_rng(seed).normal(0, NOISE_M, position_m.size)
    track = flag_end_of_body(make_track(CLOCK_S[: position_m.size], position_m + noise))
    return np.flatnonzero(with_flag(track.flag, "after_end")), track.notes


def fall(floor_m: float = 1e3, restitution: float = 0.0) -> np.ndarray:
    """Falling from rest, and once thrown back by a floor."""
    free = 0.5 * 9.81 * CLOCK_S**2
    hit_s = np.sqrt(2 * floor_m / 9.81)
    later = np.clip(CLOCK_S - hit_s, 0, None)
    back = restitution * 9.81 * hit_s * later - 0.5 * 9.81 * later**2
    return np.where(hit_s > CLOCK_S, free, floor_m - np.maximum(back, 0.0))


@pytest.mark.parametrize("restitution", [0.2, 0.6])
def test_a_bounce_ends_the_motion(restitution):
    after, notes = ended(fall(0.7, restitution))
    impact = int(np.argmax(np.sqrt(2 * 0.7 / 9.81) < CLOCK_S))
    assert after[-1] == 119
    assert abs(after[0] - impact) <= 2
    assert "turns back" in notes[-1]


def test_an_abrupt_stop_ends_the_motion():
    after, notes = ended(fall(0.7))
    impact = int(np.argmax(np.sqrt(2 * 0.7 / 9.81) < CLOCK_S))
    assert abs(after[0] - impact) <= 2
    assert "stops" in notes[-1]


@pytest.mark.parametrize("seed", range(621, 631))
@pytest.mark.parametrize(
    "position_m",
    [fall(), np.maximum(CLOCK_S - 0.2, 0.0), 0.3 * (1 - np.exp(-CLOCK_S / 0.1)), np.zeros(120)],
    ids=["fall", "starts late", "slides to rest", "stands"],
)
def test_a_motion_without_an_end_keeps_its_points(position_m, seed):
    after, notes = ended(position_m, seed)
    assert after.size == 0
    assert notes == ()


@pytest.mark.parametrize(
    ("travel_ratio", "frames_used", "ends"), [(1.0, None, True), (2.0, None, False), (1.0, (0, 119), False)]
)
def test_only_bodies_without_chosen_frames_are_cut(tmp_path: Path, travel_ratio, frames_used, ends):
    path = tmp_path / "ball.csv"
    rows = "\n".join(f"{t:.4f},{y:.6f}" for t, y in zip(CLOCK_S, fall(0.7, 0.6), strict=True))
    path.write_text(f"time_s,position_m\n{rows}\n", encoding="utf-8")
    track = load_track(Trial(name="ball", track=path, travel_ratio=travel_ratio, frames_used=frames_used))
    assert with_flag(track.flag, "after_end").any() == ends
