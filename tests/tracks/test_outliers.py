"""Single points displaced by known amounts on known motions; seeds 20000 and up."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from vine_truth import CAPTURE_FPS, Vine, ar1, make_track, record

from vinetrack.core.records import Track
from vinetrack.tracks.frame_timing import correct_frames
from vinetrack.tracks.position_noise import find_outliers, reject_outliers

FRAME_S = 1 / CAPTURE_FPS
VINES = [(Vine(1, 1.0), 3e-5, 0.0), (Vine(2, 5.0), 1e-4, 0.6), (Vine(3, 10.0), 1e-4, 0.6), (Vine(4, 3.0), 1e-4, 0.0)]


def steady_track(noise_m: float = 6e-5, n: int = 300, seed: int = 20000) -> Track:
    time_s = np.arange(n) * FRAME_S
    y = 0.6 * np.maximum(time_s - time_s[30], 0) + ar1(n, noise_m, 0.0, np.random.default_rng(seed))
    return make_track(time_s, y)


def displaced(track: Track, rows: np.ndarray, by_m: np.ndarray | float) -> Track:
    y = track.lead_position_m.copy()
    y[rows] += by_m
    return replace(track, lead_position_m=y)


def test_an_undisturbed_motion_has_no_outlier():
    """A release, growth and correlated noise, 24 tracks: 2.4 % probability of a single point with normal noise."""
    flagged = 0
    for seed in range(20000, 20006):
        for vine, noise_m, rho in VINES:
            end_frames = 5 if seed % 2 else 0
            draw = np.random.default_rng(seed)
            track = record(vine, draw, noise_m=noise_m, rho=rho, end_frames=end_frames).track
            flagged += np.count_nonzero(find_outliers(track.time_s, track.lead_position_m))
    assert flagged == 0


def test_one_in_a_hundred_points_is_named_and_no_other():
    draw = np.random.default_rng(20001)
    track = steady_track(seed=20001)
    wild = 20 + 40 * np.arange(7) + draw.integers(-5, 6, 7)
    out = reject_outliers(displaced(track, wild, draw.choice([-1, 1], 7) * draw.uniform(1e-3, 1e-2, 7)))
    assert np.flatnonzero(out.flag == "rejected").tolist() == wild.tolist()
    assert len(out.notes) == 1
    assert out.notes[0].startswith("7 points lie far off")
    assert f"{track.time_s[wild[0]]:.5g} s" in out.notes[0]


def test_two_adjacent_outliers_are_both_rejected():
    out = reject_outliers(displaced(steady_track(), np.array([150, 151]), np.array([3e-3, -3e-3])))
    assert np.flatnonzero(out.flag == "rejected").tolist() == [150, 151]


@pytest.mark.parametrize("row", [0, 299])
def test_an_outlier_at_an_end_is_rejected(row):
    out = reject_outliers(displaced(steady_track(), np.array([row]), 5e-3))
    assert np.flatnonzero(out.flag == "rejected").tolist() == [row]


@pytest.mark.parametrize("row", [150, 290])
@pytest.mark.parametrize(
    "time_of", [lambda t: t, lambda t: t + 0.2 * FRAME_S * np.sin(700 * t)], ids=["even", "uneven"]
)
def test_an_outlier_near_the_point_before_is_rejected_and_not_a_copy(row, time_of):
    """A quarter of a step from the point before, and four times the noise of their difference."""
    time_s = time_of(np.arange(300) * FRAME_S)
    speed_m_s, noise_m = 6.0, 3e-5
    y = speed_m_s * time_s + ar1(300, noise_m, 0.0, np.random.default_rng(20003))
    y[row] = y[row - 1] + 0.2 * (y[row + 1] - y[row - 1]) / 2
    track = make_track(time_s, y)
    assert not find_outliers(track.time_s, y, spare_copies=True)[row]
    out = correct_frames(track)
    assert np.flatnonzero(out.flag == "rejected").tolist() == [row]
    np.testing.assert_array_equal(out.time_s, time_s)


@pytest.mark.parametrize("row", [0, 1, 298, 299])
@pytest.mark.parametrize("steps", [-0.9, 0.9])
def test_at_the_ends_a_motion_may_have_stopped_or_begun_and_not_the_other_way(row, steps):
    """Growth of 5.6 mm a frame all along: what stops falls behind it, what has not begun is ahead of it."""
    time_s = np.arange(300) * FRAME_S
    y = 6.0 * time_s + ar1(300, 3e-5, 0.0, np.random.default_rng(20004))
    track = displaced(make_track(time_s, y), np.array([row]), steps * 6.0 * FRAME_S)
    assert np.flatnonzero(reject_outliers(track).flag == "rejected").tolist() == (
        [row] if (steps > 0) == (row > 1) else []
    )


def test_an_outlier_is_not_a_dropped_frame():
    """A point one step ahead, the size of a dropped frame's jump: the times stay as they are."""
    track = steady_track(noise_m=2e-5)
    step_m = 0.6 * FRAME_S
    out = correct_frames(displaced(track, np.array([150]), 1.0 * step_m))
    np.testing.assert_array_equal(out.time_s, track.time_s)
    assert not any("gap" in str(flag) for flag in out.flag)


def test_points_behind_a_dropped_frame_are_not_outliers():
    track = steady_track(noise_m=2e-5)
    y = np.delete(track.lead_position_m, [150, 151])
    out = correct_frames(make_track(track.time_s[:-2], y))
    assert np.flatnonzero(out.flag != "").tolist() == [150]
    assert out.flag[150] == "gap;retimed"


def test_a_motion_that_starts_at_full_speed_keeps_its_points():
    """Ten standard deviations a frame from one frame to the next, as a latch lets go."""
    for seed in range(20010, 20030):
        track = steady_track(seed=seed)
        assert not find_outliers(track.time_s, track.lead_position_m).any()


def test_noise_that_grows_with_speed_has_no_outliers():
    time_s = np.arange(300) * FRAME_S
    speed = 40.0 * time_s
    draw = np.random.default_rng(20002)
    y = 20.0 * time_s**2 + np.hypot(5e-5, 6e-5 * speed) * draw.standard_normal(time_s.size)
    assert not find_outliers(time_s, y).any()


def test_a_point_placed_by_hand_is_not_an_outlier() -> None:
    time_s = np.arange(60) / 1000
    position_m = 0.2 * time_s + 1e-6 * np.random.default_rng(20100).standard_normal(60)
    position_m[30] += 2e-3
    flag = np.full(60, "", dtype="<U80")
    track = Track(time_s, position_m, np.full(60, 1e-6), flag, np.full(60, np.nan))
    assert reject_outliers(track).flag[30] == "rejected"
    flag = flag.copy()
    flag[30] = "corrected"
    assert (
        reject_outliers(Track(time_s, position_m, np.full(60, 1e-6), flag, np.full(60, np.nan))).flag[30] == "corrected"
    )


def test_where_one_point_in_eight_is_an_outlier_none_is_rejected() -> None:
    """The test then does not describe the track: what remained would be no measurement of that motion."""
    rows = np.arange(10, 290, 8)
    draw = np.random.default_rng(20002)
    track = displaced(steady_track(seed=20002), rows, draw.choice([-1, 1], rows.size) * 5e-3)
    assert not find_outliers(track.time_s, track.lead_position_m).any()


@pytest.mark.parametrize("step_m", [5e-4, 1e-3, 2e-3])
@pytest.mark.parametrize("every", [1, 4])
def test_rounded_positions_have_no_outliers_or_missing_frames(step_m, every):
    """Clicked to the millimetre, or written with few decimals, and at rest mostly: the noise is that of rounding."""
    for seed in range(20020, 20026):
        for vine, noise_m, rho in VINES:
            track = record(vine, np.random.default_rng(seed), noise_m=noise_m, rho=rho).track
            position_m = np.round(track.lead_position_m[::every] / step_m) * step_m
            rounded = correct_frames(reject_outliers(make_track(track.time_s[::every], position_m)))
            assert not rounded.notes


def test_an_outlier_among_rounded_positions_is_rejected():
    track = steady_track(n=600)
    rounded = replace(track, lead_position_m=np.round(track.lead_position_m, 3))
    out = reject_outliers(displaced(rounded, np.array([20, 300]), np.array([5e-3, -6e-3])))
    assert np.flatnonzero(out.flag == "rejected").tolist() == [20, 300]
