"""Noise and outliers of a track against known ones; seeds 1000 and 20000 and up, which tuned nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from vine_truth import CAPTURE_FPS, Vine, ar1, make_track, record

from vinetrack.core.records import Track
from vinetrack.tracks.frame_timing import correct_frames
from vinetrack.tracks.position_noise import (
    NoiseShape,
    ar1_noise,
    common_rounding_noise,
    find_outliers,
    noise_shape,
    position_noise,
    reject_outliers,
    rest_points,
    rounding_noise,
)

FRAMES = np.arange(300) / 1069


def median_estimate(positions: list[np.ndarray]) -> tuple[float, float]:
    found = np.array([position_noise(np.arange(y.size) / 1069, y) for y in positions])
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
        found.append(position_noise(trial.track.time_s, trial.track.lead_position_m)[0])
    assert np.median(found) == pytest.approx(5e-5, rel=0.1)


@pytest.mark.parametrize("speed_m_s", [0.05, 0.15, 0.4, 1.0])
def test_rounding_to_whole_pixels_is_noise_even_at_rest(speed_m_s):
    pixel = 4e-4
    y = np.where(FRAMES > 0.2, speed_m_s * (FRAMES - 0.2), 0.0)
    noise_m, _ = position_noise(FRAMES, np.round(y / pixel) * pixel)
    assert noise_m == pytest.approx(pixel / np.sqrt(12), rel=0.35)


def test_rest_ends_where_motion_begins():
    rng = np.random.default_rng(1000)
    y = np.where(np.arange(200) < 80, 0.0, 5e-4 * (np.arange(200) - 80)) + ar1(200, 1e-4, 0.3, rng)
    assert abs(rest_points(y) - 81) <= 3


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
    assert position_noise(np.arange(y.size) / 267, y, robust=True)[0] == pytest.approx(1e-3 / np.sqrt(12), rel=0.05)


# ---- noise of known size and shape on known motions ----

BLUR_S = 60e-6
NOISE_M = 6e-5
Arrays = list[np.ndarray]


def experiment(blur_s: float, rho: float = 0.0, seed: int = 20000, trials: int = 8) -> tuple[Arrays, Arrays, Arrays]:
    """Times, positions and true standard deviations of fast vines, with the noise of a blurred edge."""
    times, positions, true_sd = [], [], []
    for i in range(trials):
        draw = np.random.default_rng(seed + i)
        made = record(Vine(2, 10.0), draw, noise_m=NOISE_M, rho=rho)
        blurred = blur_s * made.lead_velocity_m_s
        times.append(made.track.time_s)
        positions.append(made.track.lead_position_m + blurred * draw.standard_normal(blurred.size))
        true_sd.append(np.hypot(NOISE_M, blurred))
    return times, positions, true_sd


def shape_of(times: Arrays, positions: Arrays, stated: Arrays | None = None) -> NoiseShape | None:
    return noise_shape(times, positions, stated or [None] * len(times))


def test_blur_is_found_and_so_is_the_noise_of_every_point():
    times, positions, true_sd = experiment(BLUR_S)
    shape = shape_of(times, positions)
    assert shape is not None
    assert shape.blur_s == pytest.approx(BLUR_S, rel=0.15)
    ratio = np.concatenate([np.log(sd / true) for sd, true in zip(shape.sd_m, true_sd, strict=True)])
    assert abs(np.mean(ratio)) < 0.1
    assert np.sqrt(np.mean(ratio**2)) < 0.25


@pytest.mark.parametrize("rho", [0.0, 0.4, 0.7])
def test_equal_noise_is_left_equal_however_fast_the_vine(rho):
    for seed in range(20100, 20160, 10):
        times, positions, _ = experiment(0.0, rho, seed)
        assert shape_of(times, positions) is None


def test_heavy_tails_are_not_noise_that_varies():
    draw = np.random.default_rng(20200)
    times, positions, _ = experiment(0.0)
    heavy = [y + NOISE_M * draw.standard_t(4, y.size) for y in positions]
    assert shape_of(times, heavy) is None


def test_standard_deviations_that_a_file_states_are_used_where_they_hold_and_only_there():
    draw = np.random.default_rng(20300)
    times, positions, _ = experiment(0.0)
    stated = [np.where(draw.uniform(size=t.size) < 0.3, 3e-4, 1e-4) for t in times]
    noisier = [y + 2 * sd * draw.standard_normal(y.size) for y, sd in zip(positions, stated, strict=True)]
    shape = shape_of(times, noisier, stated)
    assert shape is not None
    assert shape.blur_s == 0
    # In proportion to those stated: their size is the data's, twice what the file says beside the noise of before.
    np.testing.assert_allclose(shape.sd_m[0] / stated[0], shape.sd_m[0][0] / stated[0][0])
    assert float(np.median(shape.sd_m[0] / stated[0])) == pytest.approx(2.0, rel=0.2)
    assert shape_of(times, positions, stated) is None


# ---- simulated noise has the requested standard deviation and correlation, from the first position on ----


@pytest.mark.parametrize("correlation", [-0.4, 0.0, 0.6, 0.9])
def test_variance_and_lag_one_correlation_are_those_of_the_process(correlation: float) -> None:
    noise = ar1_noise(200_000, 2e-4, correlation, np.random.default_rng(5))
    # Standard error of a variance of correlated normal noise: √(2/n · (1+ρ²)/(1−ρ²)); four of them.
    allowed = 4 * np.sqrt(2 / noise.size * (1 + correlation**2) / (1 - correlation**2))
    assert np.var(noise) == pytest.approx(4e-8, rel=allowed)
    lag_one = np.mean(noise[1:] * noise[:-1]) / np.var(noise)
    assert lag_one == pytest.approx(correlation, abs=4 * np.sqrt((1 - correlation**2) / noise.size))


# ---- single points displaced by known amounts on known motions ----

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
