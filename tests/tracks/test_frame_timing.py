"""Repeated and dropped frames put into vines integrated by SciPy. Scored on seeds 1000 and up (tuned on 0–99)."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter
from vine_truth import CAPTURE_FPS, Vine, ar1, make_track, record

from vinetrack.core.records import Track, with_flag
from vinetrack.tracks.frame_timing import correct_frames, count_missing, frames_surely_missing

FRAME_S = 1 / CAPTURE_FPS
CLEAR = [  # speeds at which one frame's step is at least 8 standard deviations of a position
    (Vine(1, 1.0), 3e-5, 0.0),
    (Vine(2, 5.0), 1e-4, 0.0),
    (Vine(2, 5.0), 1e-4, 0.6),
    (Vine(3, 10.0), 1e-4, 0.6),
    (Vine(4, 3.0), 1e-4, 0.0),
    (Vine(4, 10.0), 3e-4, 0.3),
]


def stale(track: Track, row: int) -> Track:
    """The frame at `row` shows the one before it again."""
    y = track.lead_position_m.copy()
    y[row] = y[row - 1]
    return replace(track, lead_position_m=y)


def inserted(track: Track, row: int) -> Track:
    """A copy of the frame before `row` stands at `row`, and all later ones are a frame late."""
    y = np.insert(track.lead_position_m, row, track.lead_position_m[row - 1])
    return make_track(np.append(track.time_s, track.time_s[-1] + FRAME_S), y)


def dropped(track: Track, row: int, count: int = 1) -> Track:
    """`count` frames from `row` on are missing, and all later ones are as many frames early."""
    y = np.delete(track.lead_position_m, range(row, row + count))
    return make_track(track.time_s[: y.size], y)


def flags(track: Track) -> dict[int, str]:
    return {int(row): str(track.flag[row]) for row in np.flatnonzero(track.flag != "")}


def steady_track(noise_m: float = 2e-5, n: int = 120) -> Track:
    time_s = np.arange(n) * FRAME_S
    y = 1.0 * np.maximum(time_s - time_s[30], 0) + ar1(n, noise_m, 0.0, np.random.default_rng(1000))
    return make_track(time_s, y)


@pytest.mark.parametrize(("row", "noise_m", "sure"), [(70, 1e-4, True), (110, 1e-4, False), (110, 1e-5, True)])
def test_a_jump_of_only_the_nearest_points_is_sure_where_noise_is_far_below_it(row, noise_m, sure):
    out = correct_frames(dropped(steady_track(noise_m), row))
    assert flags(out) == {row: "gap;retimed"}
    assert frames_surely_missing(out) is sure


@pytest.mark.parametrize("count", [1, 3])
def test_after_dropped_frames_times_go_on_by_as_many(count):
    """And where the times show the gap already it is flagged, and they stay."""
    clean = steady_track()
    rows = np.delete(np.arange(120), range(70, 70 + count))
    out = correct_frames(dropped(clean, 70, count))
    assert flags(out) == {70: "gap;retimed"}
    np.testing.assert_allclose(out.time_s, clean.time_s[rows], atol=1e-12)
    gapped = make_track(clean.time_s[rows], clean.lead_position_m[rows])
    for timed, flag in ((out, "gap;retimed"), (gapped, "gap")):
        again = correct_frames(timed)
        assert flags(again) == {70: flag}
        np.testing.assert_array_equal(again.time_s, timed.time_s)


@pytest.mark.parametrize(("stated_m", "told"), [(2e-5, True), (np.nan, True), (5e-4, False)])
def test_a_long_step_between_points_that_are_stated_to_be_unsure_is_no_dropped_frame(stated_m, told):
    """Where a door half hides the tip its points leap, and say so."""
    track = dropped(steady_track(), 60)
    sigma_m = track.lead_position_sigma_m.copy()
    sigma_m[58:62] = stated_m
    assert bool(flags(correct_frames(replace(track, lead_position_sigma_m=sigma_m)))) is told


@pytest.mark.parametrize("seen", [False, True])
def test_a_copy_changes_times_only_where_it_was_inserted(seen):
    """Whether or not the tracker has seen that the picture is the one before it."""
    clean = steady_track()
    for fault in (stale, inserted):
        track = fault(clean, 70)
        if seen:
            track = replace(track, flag=np.where(np.arange(track.flag.size) == 70, "duplicate", track.flag))
        out = correct_frames(track)
        assert flags(out) == {70: "duplicate"}
        others = np.delete(out.time_s, 70) if fault is inserted else out.time_s
        np.testing.assert_allclose(others, clean.time_s, atol=1e-12)
        assert np.all(np.diff(out.time_s) > 0)


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
            vine = Vine(scale, speed)
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
        trial = record(Vine(4, 2.0), rng, noise_m=1e-9, rho=0.0, rest_frames=int(rng.integers(0, 60)))
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
        track = make_track(np.arange(180) * FRAME_S, noisy_m)
        assert not with_flag(correct_frames(track).flag, "retimed").any()
        found += "retimed" in flags(correct_frames(dropped(track, 80))).get(80, "")
    assert found >= 36


def test_a_step_of_no_whole_number_is_reported_and_changes_nothing():
    """Twenty frames that move 10 px each, but for one step of 17 px before the tenth."""
    number, steps = np.arange(20), np.where(np.arange(20) == 10, 17.0, 10.0)
    out = count_missing(np.cumsum(steps), np.full(20, 0.1), number, number, np.zeros(20, dtype=bool), (0, 19))
    assert list(np.flatnonzero(out.gap)) == [10]
    assert not out.retimed.any()
    np.testing.assert_array_equal(out.slot, np.arange(20))
