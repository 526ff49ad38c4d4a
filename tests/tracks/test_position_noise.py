"""Noise, outliers, smoothing, repeated and dropped frames of tracks against known ones; seeds that tuned nothing."""

from dataclasses import replace

import numpy as np
import pytest
from hidden.laboratory_folder import write_experiment
from hidden.laboratory_rows import campaign
from lsoda_vine import as_track
from scipy.ndimage import uniform_filter1d
from scipy.signal import butter, filtfilt, lfilter, savgol_filter
from vine_truth import CAPTURE_FPS, ar1, record, scaled

import vinetrack as vt
from vinetrack.core.records import Track, Trial, plain_track, with_flag
from vinetrack.tracks import position_noise as module
from vinetrack.tracks.frame_timing import correct_frames, frames_surely_missing
from vinetrack.tracks.position_noise import detect_smoothing, low_passed, noise_shape, position_noise, reject_outliers

FRAMES = np.arange(300) / 1069
NOISE_M = 6e-5
UNSTATED = [None] * 8
FRAME_S = 1 / CAPTURE_FPS
TIME_S = np.arange(150) / 1000.0
TRIAL = Trial(name="t", capture_fps=1000.0)
CLEAR = [  # speeds at which one frame's step is at least 8 standard deviations of a position
    *((scaled(1, 1.0), 3e-5, 0.0), (scaled(2, 5.0), 1e-4, 0.0), (scaled(2, 5.0), 1e-4, 0.6)),
    *((scaled(3, 10.0), 1e-4, 0.6), (scaled(4, 3.0), 1e-4, 0.0), (scaled(4, 10.0), 3e-4, 0.3)),
]


@pytest.mark.parametrize("rho", [0.0, 0.3, 0.6, 0.8])
def test_still_frames_and_motion_give_deviation_and_correlation(rho):
    still, moving = np.zeros(300), 0.4 * FRAMES + 0.02 * np.sin(12 * FRAMES)
    for smooth, rel, tolerance in ((still, 0.10, 0.07), (moving, 0.12, 0.1))[: 2 if rho < 0.7 else 1]:
        noisy = [smooth + ar1(300, 1e-4, rho, np.random.default_rng(seed)) for seed in range(1000, 1040)]
        noise_m, correlation = np.median([position_noise(FRAMES, y) for y in noisy], axis=0)
        assert noise_m == pytest.approx(1e-4, rel=rel)
        assert correlation == pytest.approx(rho, abs=tolerance)


@pytest.mark.parametrize("vine", [scaled(1, 0.2), scaled(1, 10.0), scaled(4, 10.0)], ids=str)
def test_release_does_not_pass_for_noise(vine):
    found = []
    for seed in range(1000, 1030):
        trial = record(vine, np.random.default_rng(seed), noise_m=5e-5, rest_frames=60, end_frames=20)
        found.append(position_noise(trial.track.time_s, trial.track.lead_position_m)[0])
    assert np.median(found) == pytest.approx(5e-5, rel=0.1)


def test_an_oscillation_that_no_cubic_follows_does_not_pass_for_noise():
    rows = np.arange(200)
    y = 3.0 * rows / CAPTURE_FPS + 2e-4 * np.sin(2 * np.pi * rows / 18)
    noisy = [y + ar1(200, 1e-5, 0.0, np.random.default_rng(seed)) for seed in range(1000, 1010)]
    assert np.median([position_noise(rows / CAPTURE_FPS, one)[0] for one in noisy]) == pytest.approx(1e-5, rel=0.2)


@pytest.mark.parametrize("speed_m_s", [0.05, 0.15, 0.4, 1.0])
def test_rounding_to_whole_pixels_is_noise_even_at_rest(speed_m_s):
    pixel = 4e-4
    y = np.where(FRAMES > 0.2, speed_m_s * (FRAMES - 0.2), 0.0)
    noise_m, _ = position_noise(FRAMES, np.round(y / pixel) * pixel)
    assert noise_m == pytest.approx(pixel / np.sqrt(12), rel=0.35)


def rounded(seed: int, step_m: float = 1e-3) -> np.ndarray:
    """A growth at rising speed, clicked to whole steps."""
    time_s = np.arange(60) / 267
    smooth = 0.01 + 0.3 * np.maximum(time_s - 0.03, 0) + 2 * np.maximum(time_s - 0.03, 0) ** 2
    return np.round((smooth + 5e-5 * np.random.default_rng(seed).standard_normal(60)) / step_m) * step_m


def test_rounding_of_most_tracks_is_that_of_all_and_of_few_is_not():
    """A track at one speed shows none of it: 5 mm from frame to frame are multiples of any millimetre."""
    even = 5e-3 * np.arange(20.0)
    assert module.rounding_noise(even) == 0
    assert module.common_rounding_noise([even, *map(rounded, range(3))]) == pytest.approx(1e-3 / np.sqrt(12))
    fine = [ar1(60, 1e-4, 0.0, np.random.default_rng(seed)) + rounded(seed, 1e-9) for seed in range(3)]
    assert module.common_rounding_noise([*fine, rounded(1)]) == 0
    assert module.common_rounding_noise([rounded(1), rounded(2, 2e-3), rounded(3, 5e-4), *fine[:1]]) == 0
    assert module.common_rounding_noise([]) == 0


def experiment(rho: float = 0.0, seed: int = 20000) -> list[list[np.ndarray]]:
    """Times and positions of fast vines."""
    made = [record(scaled(2, 10.0), np.random.default_rng(seed + i), noise_m=NOISE_M, rho=rho) for i in range(8)]
    return [[one.track.time_s for one in made], [one.track.lead_position_m for one in made]]


@pytest.mark.parametrize("rho", [0.0, 0.4, 0.7])
def test_equal_noise_is_left_equal_however_fast_the_vine_and_heavy_its_tails(rho):
    for seed in range(20100, 20160, 10):
        times, positions = experiment(rho, seed)
        assert noise_shape(times, positions, UNSTATED) is None
    draw = np.random.default_rng(20200)
    times, positions = experiment()
    heavy = [y + NOISE_M * draw.standard_t(4, y.size) for y in positions]
    assert noise_shape(times, heavy, UNSTATED) is None


def test_standard_deviations_that_a_file_states_are_used_where_they_hold_and_only_there():
    draw = np.random.default_rng(20300)
    times, positions = experiment()
    stated = [np.where(draw.uniform(size=t.size) < 0.3, 3e-4, 1e-4) for t in times]
    noisier = [y + 2 * sd * draw.standard_normal(y.size) for y, sd in zip(positions, stated, strict=True)]
    shape = noise_shape(times, noisier, stated)
    assert shape.blur_s == 0
    # In proportion to those stated: their size is the data's, twice what the file says beside the noise of before.
    ratio = shape.sd_m[0] / stated[0]
    np.testing.assert_allclose(ratio, ratio[0])
    assert ratio[0] == pytest.approx(2.0, rel=0.2)
    assert noise_shape(times, positions, stated) is None


def recorded(seed: int, end_frames: int = 0) -> list[Track]:
    vines = [
        (scaled(1, 1.0), 3e-5, 0.0),
        (scaled(2, 5.0), 1e-4, 0.6),
        (scaled(3, 10.0), 1e-4, 0.6),
        (scaled(4, 3.0), 1e-4, 0),
    ]
    return [
        record(vine, np.random.default_rng(seed), noise_m=noise_m, rho=rho, end_frames=end_frames).track
        for vine, noise_m, rho in vines
    ]


def steady_track(rows: np.ndarray, by_m: np.ndarray | float, seed: int = 20001, noise_m: float = 6e-5) -> Track:
    """Even growth after a rest, with these points displaced."""
    time_s = np.arange(300) * FRAME_S
    y = 0.6 * np.maximum(time_s - time_s[30], 0) + ar1(300, noise_m, 0.0, np.random.default_rng(seed))
    y[rows] += by_m
    return plain_track(time_s, y)


def rejected(track: Track) -> list[int]:
    return np.flatnonzero(track.flag == "rejected").tolist()


def test_an_undisturbed_motion_has_no_outlier():
    """A release, growth and correlated noise, 24 tracks: 2.4 % probability of a single point with normal noise."""
    tracks = [track for seed in range(20000, 20006) for track in recorded(seed, 5 if seed % 2 else 0)]
    assert not any(module.find_outliers(track.time_s, track.lead_position_m).any() for track in tracks)
    time_s = np.arange(300) * FRAME_S
    noise_m = np.hypot(5e-5, 6e-5 * 40.0 * time_s)  # that grows with speed
    y = 20.0 * time_s**2 + noise_m * np.random.default_rng(20002).standard_normal(time_s.size)
    assert not module.find_outliers(time_s, y).any()


def test_one_in_a_hundred_points_is_named_and_one_in_eight_describes_no_motion():
    draw = np.random.default_rng(20001)
    wild = 20 + 40 * np.arange(7) + draw.integers(-5, 6, 7)
    by_m = draw.choice([-1, 1], 7) * draw.uniform(1e-3, 1e-2, 7)
    assert rejected(reject_outliers(steady_track(wild, by_m))) == wild.tolist()
    many = np.arange(10, 290, 8)
    assert rejected(reject_outliers(steady_track(many, draw.choice([-1, 1], many.size) * 5e-3))) == []
    # A point one step ahead, the size of a dropped frame's jump, is none.
    ahead = steady_track(np.array([150]), 0.6 * FRAME_S, 20000, 2e-5)
    out = correct_frames(ahead)
    np.testing.assert_array_equal(out.time_s, ahead.time_s)
    assert not any("gap" in str(flag) for flag in out.flag)


@pytest.mark.parametrize("row", [150, 290])
@pytest.mark.parametrize("unevenness", [0.0, 0.2])
def test_an_outlier_near_the_point_before_is_rejected_and_not_a_copy(row, unevenness):
    """A quarter of a step from the point before, and four times the noise of their difference."""
    time_s = np.arange(300) * FRAME_S
    time_s = time_s + unevenness * FRAME_S * np.sin(700 * time_s)
    y = 6.0 * time_s + ar1(300, 3e-5, 0.0, np.random.default_rng(20003))
    y[row] = y[row - 1] + 0.2 * (y[row + 1] - y[row - 1]) / 2
    track = plain_track(time_s, y)
    out = correct_frames(track)
    assert rejected(out) == [row]
    np.testing.assert_array_equal(out.time_s, time_s)


@pytest.mark.parametrize("row", [0, 1, 298, 299])
@pytest.mark.parametrize("steps", [-0.9, 0.9])
def test_at_the_ends_a_motion_may_have_stopped_or_begun_and_not_the_other_way(row, steps):
    """Growth of 5.6 mm a frame all along: what stops falls behind it, what has not begun is ahead of it."""
    time_s = np.arange(300) * FRAME_S
    y = 6.0 * time_s + ar1(300, 3e-5, 0.0, np.random.default_rng(20004))
    y[row] += steps * 6.0 * FRAME_S
    assert rejected(reject_outliers(plain_track(time_s, y))) == ([row] if (steps > 0) == (row > 1) else [])


def test_a_point_placed_by_hand_is_not_an_outlier():
    track = steady_track(np.array([150]), 5e-3)
    assert rejected(reject_outliers(track)) == [150]
    by_hand = replace(track, flag=np.where(np.arange(300) == 150, "corrected", track.flag))
    assert reject_outliers(by_hand).flag[150] == "corrected"


@pytest.mark.parametrize("step_m", [5e-4, 1e-3, 2e-3])
@pytest.mark.parametrize("every", [1, 4])
def test_rounded_positions_have_no_outliers_or_missing_frames(step_m, every):
    """Clicked to the millimetre, or written with few decimals, and at rest mostly: the noise is that of rounding."""
    for track in (track for seed in range(20020, 20026) for track in recorded(seed)):
        position_m = np.round(track.lead_position_m[::every] / step_m) * step_m
        assert not correct_frames(reject_outliers(plain_track(track.time_s[::every], position_m))).notes


def smooth_tracks(seed: int, rho=0.0, smooth=lambda y: y, rest_s=0.02, noise_m=1e-4) -> list[tuple[Trial, Track]]:
    """Eight, from rest until then, at up to 3 m/s."""
    draw, since = np.random.default_rng(seed), np.clip(TIME_S - rest_s, 0.0, None)
    grown_m = 3.0 * (since - 0.01 * (1 - np.exp(-since / 0.01)))
    noisy = [grown_m + module.ar1_noise(TIME_S.size, noise_m, rho, draw) for _ in range(8)]
    return [(TRIAL, as_track(TIME_S, smooth(y))) for y in noisy]


@pytest.mark.slow
@pytest.mark.parametrize("rho", [0.0, 0.3, 0.6, 0.85])
def test_noise_of_a_camera_is_not_smoothed(rho):
    assert all(detect_smoothing(smooth_tracks(seed, rho)) is None for seed in range(351, 371))


@pytest.mark.parametrize(("degree", "frames"), [(0, 3), (0, 5), (0, 9), (2, 7), (2, 11)])
def test_a_moving_average_and_a_polynomial_are_found_with_their_lengths(degree, frames):
    average, polynomial = (lambda y: uniform_filter1d(y, frames)), (lambda y: savgol_filter(y, frames, 3))
    found = detect_smoothing(smooth_tracks(352 + degree // 2, smooth=polynomial if degree else average))
    assert (found.window, found.degree) == (frames, degree)
    assert 1 < found.decimation < frames if degree else found.decimation == frames


@pytest.mark.parametrize(("order", "cutoff", "decimals"), [(2, 0.2, 5), (4, 0.1, 12), (2, 0.1, 5)])
def test_a_low_pass_is_found_with_its_cutoff_from_positions_at_rest(order, cutoff, decimals):
    filtered = smooth_tracks(356, 0.0, lambda y: np.round(filtfilt(*butter(order, 2 * cutoff), y), decimals), 0.06)
    assert low_passed(filtered).facts["cutoff"] == pytest.approx(cutoff, rel=0.35)
    for rho, noise_m in ((0.0, 1e-4), (0.6, 1e-5), (0.9, 1e-4), (0.0, 1e-7)):
        assert not low_passed(smooth_tracks(357, rho, lambda y: np.round(y, decimals), 0.06, noise_m))


def test_uneven_frames_and_recordings_are_not_smoothed(tmp_path):
    smoothed = smooth_tracks(355, smooth=lambda y: uniform_filter1d(y, 5))
    uneven_s = TIME_S + 3e-4 * np.sin(np.arange(TIME_S.size))
    assert detect_smoothing([(trial, as_track(uneven_s, track.lead_position_m)) for trial, track in smoothed]) is None
    filmed = Trial(name="t", video=tmp_path / "t.mp4", capture_fps=1000.0)
    assert detect_smoothing([(filmed, track) for _, track in smoothed]) is None
    assert detect_smoothing([]) is None


@pytest.mark.slow
def test_a_model_is_smoothed_as_its_positions_were(tmp_path):
    shot = campaign("smoothed", 20616, (8, 8), weighed=False)
    write_experiment(shot, tmp_path / "laboratory")
    fit = vt.fit(vt.base_model(), tmp_path / "laboratory")
    assert fit.chi2_per_dof < 1.2
    (n,) = (number for number in fit.numbers if number.key == "eversion_damping.n")
    truth = shot.truth["truths"]["eversion_damping.n"]  # type: ignore[index]
    assert n.low < truth < n.high


def stale(track: Track, row: int) -> Track:
    """The frame at `row` shows the one before it again."""
    y = track.lead_position_m.copy()
    y[row] = y[row - 1]
    return replace(track, lead_position_m=y)


def inserted(track: Track, row: int) -> Track:
    """A copy of the frame before `row` stands at `row`, and all later ones are a frame late."""
    y = np.insert(track.lead_position_m, row, track.lead_position_m[row - 1])
    return plain_track(np.append(track.time_s, track.time_s[-1] + FRAME_S), y)


def dropped(track: Track, row: int, count: int = 1) -> Track:
    """`count` frames from `row` on are missing, and all later ones are as many frames early."""
    y = np.delete(track.lead_position_m, range(row, row + count))
    return plain_track(track.time_s[: y.size], y)


def flags(track: Track) -> dict[int, str]:
    return {int(row): str(track.flag[row]) for row in np.flatnonzero(track.flag != "")}


def still_then_even(noise_m: float = 2e-5, n: int = 120) -> Track:
    time_s = np.arange(n) * FRAME_S
    y = 1.0 * np.maximum(time_s - time_s[30], 0) + ar1(n, noise_m, 0.0, np.random.default_rng(1000))
    return plain_track(time_s, y)


@pytest.mark.parametrize(("row", "noise_m", "sure"), [(70, 1e-4, True), (110, 1e-4, False), (110, 1e-5, True)])
def test_a_jump_of_only_the_nearest_points_is_sure_where_noise_is_far_below_it(row, noise_m, sure):
    out = correct_frames(dropped(still_then_even(noise_m), row))
    assert flags(out) == {row: "gap;retimed"}
    assert frames_surely_missing(out) is sure


@pytest.mark.parametrize("count", [1, 3])
def test_after_dropped_frames_times_go_on_by_as_many(count):
    clean = still_then_even()
    rows = np.delete(np.arange(120), range(70, 70 + count))
    out = correct_frames(dropped(clean, 70, count))
    assert flags(out) == {70: "gap;retimed"}
    np.testing.assert_allclose(out.time_s, clean.time_s[rows], atol=1e-12)
    gapped = plain_track(clean.time_s[rows], clean.lead_position_m[rows])
    for timed, flag in ((out, "gap;retimed"), (gapped, "gap")):
        again = correct_frames(timed)
        assert flags(again) == {70: flag}
        np.testing.assert_array_equal(again.time_s, timed.time_s)


@pytest.mark.parametrize(("stated_m", "told"), [(2e-5, True), (np.nan, True), (5e-4, False)])
def test_a_long_step_between_points_that_are_stated_to_be_unsure_is_no_dropped_frame(stated_m, told):
    track = dropped(still_then_even(), 60)
    sigma_m = track.lead_position_sigma_m.copy()
    sigma_m[58:62] = stated_m
    assert bool(flags(correct_frames(replace(track, lead_position_sigma_m=sigma_m)))) is told


@pytest.mark.parametrize("rows", [(70, 72), (70, 72, 74), range(60, 125, 5)], ids=["two", "three", "every fifth"])
def test_copies_close_together_are_all_found(rows):
    """As a film exported at 30 frames a second from one of 24 has them."""
    clean = track = still_then_even()
    for row in rows:
        track = inserted(track, row)
    out = correct_frames(track)
    assert flags(out) == dict.fromkeys(rows, "duplicate")
    np.testing.assert_allclose(np.delete(out.time_s, rows), clean.time_s, atol=1e-12)


@pytest.mark.parametrize(("vine", "noise_m", "rho"), CLEAR)
@pytest.mark.parametrize("fault", [stale, inserted, dropped])
def test_faults_in_clear_motion_are_found(vine, noise_m, rho, fault):
    right = 0
    for seed in range(1000, 1025):
        rng = np.random.default_rng(seed)
        trial = record(vine, rng, noise_m=noise_m, rho=rho, rest_frames=int(rng.integers(0, 80)))
        clear = np.flatnonzero(trial.lead_velocity_m_s * FRAME_S > 8 * noise_m)[4:-5]
        row = int(rng.choice(clear))
        expected = "gap;retimed" if fault is dropped else "duplicate"
        right += flags(correct_frames(fault(trial.track, row))) == {row: expected}
    assert right >= 0.9 * 25


@pytest.mark.slow
@pytest.mark.parametrize("noise_m", [3e-5, 1e-4, 3e-4])
@pytest.mark.parametrize("rho", [0.0, 0.6])
def test_nothing_is_found_in_clean_trials(noise_m, rho):
    alarms = []
    for scale, speed in ((1, 0.2), (1, 3.0), (1, 10.0), (2, 5.0), (3, 10.0), (4, 10.0)):
        for seed in range(1000, 1020):
            rng = np.random.default_rng(seed)
            rest, end = int(rng.integers(0, 80)), int(rng.integers(0, 2)) * 30
            vine = scaled(scale, speed)
            trial = record(vine, rng, noise_m=noise_m, rho=rho, rest_frames=rest, end_frames=end)
            alarms += correct_frames(trial.track).notes
    assert alarms == []


@pytest.mark.slow
@pytest.mark.parametrize("rho", [0.0, 0.5])
def test_outliers_of_heavy_tails_change_no_times(rho):
    """Student's t with 3 degrees of freedom puts a point a whole step ahead or behind now and then."""
    moved = 0
    for seed in range(1000, 1150):
        rng = np.random.default_rng(seed)
        trial = record(scaled(4, 2.0), rng, noise_m=1e-9, rho=0.0, rest_frames=int(rng.integers(0, 60)))
        kicks = rng.standard_t(3, trial.track.time_s.size) / np.sqrt(3)
        wild = lfilter([np.sqrt(1 - rho**2)], [1.0, -rho], kicks)
        track = replace(trial.track, lead_position_m=trial.track.lead_position_m + 1e-4 * wild)
        moved += any("later times" in note for note in correct_frames(track).notes)
    assert moved <= 1


def test_noise_that_grows_along_the_way_is_told_from_a_dropped_frame():
    """Steady growth of 5 mm a frame after a rest, with noise that grows with the distance from the lamp."""
    found = 0
    for seed in range(40):
        position_m = np.concatenate([np.zeros(40), 5e-3 * np.arange(1, 141)])
        noise_m = 2e-5 + 8e-4 * position_m / position_m[-1]
        noisy_m = position_m + noise_m * np.random.default_rng(seed).standard_normal(180)
        track = plain_track(np.arange(180) * FRAME_S, noisy_m)
        assert not with_flag(correct_frames(track).flag, "retimed").any()
        found += "retimed" in flags(correct_frames(dropped(track, 80))).get(80, "")
    assert found >= 36


@pytest.mark.parametrize("rounding_m", [3e-4, 1e-6])
def test_a_slow_track_that_begins_in_motion_is_not_at_rest_in_its_first_frames(rounding_m):
    draws = np.random.default_rng(5)
    steady = [2e-4 * np.arange(400) + 1e-4 * draws.standard_normal(400) for _ in range(200)]
    begun = [np.append(1e-4 * draws.standard_normal(20), y) for y in steady]
    found = [[module.rest_points(np.round(y / rounding_m) * rounding_m) for y in tracks] for tracks in (steady, begun)]
    assert np.count_nonzero(found[0]) <= 4
    assert np.count_nonzero(found[1]) >= 196
