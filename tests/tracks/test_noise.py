"""Noise of a track against noise of known standard deviation and correlation. Scored on seeds 1000 and up."""

from __future__ import annotations

import numpy as np
import pytest
from vine_truth import Vine, ar1, make_track, record

from vinetrack.tracks.position_noise import (
    common_rounding_noise,
    rest_points,
    robust_position_noise,
    rounding_noise,
    track_noise,
)

FRAMES = np.arange(300) / 1069


def median_estimate(positions: list[np.ndarray]) -> tuple[float, float]:
    found = np.array([track_noise(make_track(np.arange(y.size) / 1069, y)) for y in positions])
    return float(np.median(found[:, 0])), float(np.median(found[:, 1]))


@pytest.mark.parametrize("rho", [0.0, 0.3, 0.6, 0.8])
def test_still_frames_give_deviation_and_correlation(rho):
    still = [ar1(300, 1e-4, rho, np.random.default_rng(seed)) for seed in range(1000, 1040)]
    noise_m, correlation = median_estimate(still)
    assert noise_m == pytest.approx(1e-4, rel=0.10)
    assert correlation == pytest.approx(rho, abs=0.07)


@pytest.mark.parametrize("rho", [0.0, 0.6])
def test_motion_without_rest_gives_deviation_and_correlation(rho):
    smooth = 0.4 * FRAMES + 0.02 * np.sin(12 * FRAMES)
    moving = [smooth + ar1(300, 1e-4, rho, np.random.default_rng(seed)) for seed in range(1000, 1040)]
    noise_m, correlation = median_estimate(moving)
    assert noise_m == pytest.approx(1e-4, rel=0.12)
    assert correlation == pytest.approx(rho, abs=0.1)


@pytest.mark.parametrize("vine", [Vine(1, 0.2), Vine(1, 10.0), Vine(4, 10.0)], ids=str)
def test_release_does_not_pass_for_noise(vine):
    found = []
    for seed in range(1000, 1030):
        trial = record(vine, np.random.default_rng(seed), noise_m=5e-5, rest_frames=60, end_frames=20)
        found.append(track_noise(trial.track)[0])
    assert np.median(found) == pytest.approx(5e-5, rel=0.1)


@pytest.mark.parametrize("speed_m_s", [0.05, 0.15, 0.4, 1.0])
def test_rounding_to_whole_pixels_is_noise_even_at_rest(speed_m_s):
    pixel = 4e-4
    y = np.where(FRAMES > 0.2, speed_m_s * (FRAMES - 0.2), 0.0)
    noise_m, _ = track_noise(make_track(FRAMES, np.round(y / pixel) * pixel))
    assert noise_m == pytest.approx(pixel / np.sqrt(12), rel=0.35)


def test_exact_rest_and_exact_motion_are_noise_free():
    y = 0.5 * np.maximum(FRAMES - FRAMES[200], 0.0)
    assert track_noise(make_track(FRAMES, y)) == (0.0, 0.0)


def test_exact_motion_at_constant_speed_is_noise_free():
    assert track_noise(make_track(FRAMES, 0.5 * FRAMES)) == (0.0, 0.0)


def test_exact_stillness_is_noise_free():
    assert track_noise(make_track(FRAMES, np.zeros(300))) == (0.0, 0.0)


def test_exact_curve_leaves_next_to_nothing():
    noise_m, correlation = track_noise(make_track(FRAMES, 0.01 * np.sin(20 * FRAMES)))
    assert noise_m < 1e-6
    assert 0 <= correlation <= 0.95


def test_eight_points_estimate_the_noise_within_a_factor_of_two():
    short = [2 * FRAMES[:8] + ar1(8, 1e-4, 0.0, np.random.default_rng(seed)) for seed in range(1000, 1200)]
    noise_m, correlation = median_estimate(short)
    assert 0.5e-4 < noise_m < 2e-4
    assert correlation < 0.3


def test_four_points_are_too_few():
    assert track_noise(make_track(FRAMES[:4], np.array([0.0, 1.0, 2.0, 4.0]))) == (0.0, 0.0)


def test_unusable_points_are_not_read():
    y = ar1(300, 1e-4, 0.0, np.random.default_rng(1000))
    y[::7] = np.nan
    assert track_noise(make_track(FRAMES, y))[0] == pytest.approx(1e-4, rel=0.15)


def test_irregular_times_do_not_pass_for_noise():
    rng = np.random.default_rng(1000)
    time_s = np.cumsum(rng.uniform(0.3, 1.7, 300)) / 1069
    y = 0.5 * time_s + ar1(300, 1e-4, 0.0, rng)
    assert track_noise(make_track(time_s, y))[0] == pytest.approx(1e-4, rel=0.2)


def test_rest_ends_where_motion_begins():
    rng = np.random.default_rng(1000)
    y = np.where(np.arange(200) < 80, 0.0, 5e-4 * (np.arange(200) - 80)) + ar1(200, 1e-4, 0.3, rng)
    assert abs(rest_points(y) - 81) <= 3


def test_motion_from_the_first_frame_has_no_rest():
    y = 5e-4 * np.arange(200) + ar1(200, 1e-4, 0.0, np.random.default_rng(1000))
    assert rest_points(y) < 3


def test_rest_without_end_is_all_rest():
    assert rest_points(ar1(200, 1e-4, 0.6, np.random.default_rng(1000))) == 200


def rounded(seed: int, step_m: float = 1e-3) -> np.ndarray:
    """A growth at rising speed, clicked to whole steps."""
    time_s = np.arange(60) / 267
    smooth = 0.01 + 0.3 * np.maximum(time_s - 0.03, 0) + 2 * np.maximum(time_s - 0.03, 0) ** 2
    return np.round((smooth + 5e-5 * np.random.default_rng(seed).standard_normal(60)) / step_m) * step_m


def test_rounding_of_most_tracks_is_that_of_all():
    """A track at one speed shows none of it: 5 mm from frame to frame are multiples of any millimetre."""
    even = 5e-3 * np.arange(20.0)
    assert rounding_noise(even) == 0
    assert common_rounding_noise([even, *map(rounded, range(3))]) == pytest.approx(1e-3 / np.sqrt(12))


def test_rounding_that_few_tracks_share_is_not_that_of_all():
    fine = [ar1(60, 1e-4, 0.0, np.random.default_rng(seed)) + rounded(seed, 1e-9) for seed in range(3)]
    assert common_rounding_noise([*fine, rounded(1)]) == 0
    assert common_rounding_noise([rounded(1), rounded(2, 2e-3), rounded(3, 5e-4), *fine[:1]]) == 0
    assert common_rounding_noise([]) == 0


def test_noise_of_rounded_positions_is_not_kept_below_rounding():
    """Most points are at rest: the median third difference is zero, and hides that the others are rounded."""
    y = np.concatenate([np.full(200, 0.01), rounded(1)])
    assert robust_position_noise(np.arange(y.size) / 267, y)[0] == pytest.approx(1e-3 / np.sqrt(12), rel=0.05)
