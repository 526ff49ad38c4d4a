"""Threads of the tracker: how many, and that no result depends on them."""

from __future__ import annotations

import multiprocessing
import os
from pathlib import Path

import numpy as np
import pytest
from plain_scene import Plan, plain_scene

from vinetrack.core import threads
from vinetrack.core.records import Trial
from vinetrack.video.frames import Frames, Recording, Region
from vinetrack.video.kymograph import mean_changes
from vinetrack.video.track import Tracking, track_frames


@pytest.mark.parametrize(("count", "least", "expected"), [(10, 3, [(0, 3), (3, 6), (6, 10)]), (5, 3, [(0, 5)])])
def test_a_range_is_divided_in_order(
    monkeypatch: pytest.MonkeyPatch, count: int, least: int, expected: list[tuple[int, int]]
) -> None:
    monkeypatch.setattr(threads, "n_threads", lambda: 3)
    assert threads.in_parts(lambda first, last: (first, last), count, least) == expected


@pytest.mark.parametrize(("stated", "expected"), [("1", 1), ("2", 2), ("64", 4), ("", 4), ("0", 4), ("many", 4)])
def test_the_usual_variable_limits_the_threads(monkeypatch: pytest.MonkeyPatch, stated: str, expected: int) -> None:
    monkeypatch.setattr(threads, "available_cores", lambda: 8)
    monkeypatch.setenv("OMP_NUM_THREADS", stated)
    assert threads.n_threads() == expected


def test_a_worker_process_uses_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threads, "available_cores", lambda: 8)
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setattr(multiprocessing, "parent_process", lambda: os.getpid())
    assert threads.n_threads() == 1


def tracked(luma: np.ndarray) -> Tracking:
    """Tracking of some pictures."""
    n, height, width = luma.shape
    recording = Recording(Path("scene.mp4"), "container", width, height, 8, n)
    frames = Frames(recording, Region(0, 0, width, height), luma, np.arange(n), np.zeros(n, dtype=bool))
    return track_frames(frames, Trial(name="t", capture_fps=1000.0, exposure_s=5e-4, m_per_px=1e-3), 1000.0)


def test_a_track_is_the_same_to_the_last_digit_whatever_the_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    luma = plain_scene(Plan(seed=13, end_px=300, width=420, rest_frames=20, end_frames=20)).frames
    found = []
    for number in (1, 3):
        monkeypatch.setattr(threads, "n_threads", lambda number=number: number)
        found.append(tracked(luma))
    one, three = found
    assert np.isfinite(one.track.edge_px).sum() > 20
    np.testing.assert_array_equal(one.track.edge_px, three.track.edge_px)
    np.testing.assert_array_equal(one.track.lead_position_sigma_m, three.track.lead_position_sigma_m)
    np.testing.assert_array_equal(one.track.lead_position_systematic_m, three.track.lead_position_systematic_m)
    assert one.track.flag.tolist() == three.track.flag.tolist()


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("step", [2, 5])
def test_the_change_of_pictures_is_that_of_every_nth_pixel(dtype: type, step: int) -> None:
    pictures = np.random.default_rng(965).integers(0, np.iinfo(dtype).max, (40, 13, 31)).astype(dtype)
    expected = np.abs(np.diff(pictures[:, ::step, ::step].astype(float), axis=0)).mean(axis=(1, 2))
    np.testing.assert_allclose(mean_changes(pictures, step), expected, rtol=1e-14)
    assert mean_changes(pictures[:1], step).shape == (0,)
