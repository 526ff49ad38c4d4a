"""Steady windows against vines integrated by SciPy and against formulas. Scored on seeds 1000 up (tuned on 0–99)."""

from __future__ import annotations

import math

import numpy as np
import pytest
from vine_truth import Vine, ar1, make_track, record

from vinetrack.kinematics.steady import WindowMoments, gated_window, user_window
from vinetrack.kinematics.velocity import estimate_kinematics

SEEDS = range(1000, 1010)
STEADY = [
    pytest.param(Vine(scale, speed), noise_m, rho, id=f"R{scale}-{speed}m_s-{noise_m * 1e3}mm-{rho}")
    for scale, speed in ((1, 0.2), (1, 3.0), (2, 1.0), (3, 5.0), (4, 0.3), (4, 3.0))
    for noise_m, rho in ((3e-5, 0.0), (1e-4, 0.6))
]


def gated(track, travel_ratio=2.0, length_m=math.nan):
    return gated_window(track, estimate_kinematics(track, travel_ratio=travel_ratio), length_m=length_m)


def ramp(drop: float, noise_m: float, seed: int = 1000, n: int = 300):
    """Lead speed falling evenly from 0.5 m/s by the fraction `drop` over n frames."""
    time_s = np.arange(n) / 1000
    y = 0.5 * time_s * (1 - drop / 2 * time_s / time_s[-1])
    return make_track(time_s, y + ar1(n, noise_m, 0.0, np.random.default_rng(seed)))


def inside(trial, window) -> np.ndarray:
    return np.flatnonzero((trial.track.time_s >= window.from_s - 1e-9) & (trial.track.time_s <= window.to_s + 1e-9))


@pytest.mark.parametrize(("vine", "noise_m", "rho"), STEADY)
def test_speed_is_the_true_mean_and_the_speed_of_balance(vine, noise_m, rho):
    from_mean, from_balance = [], []
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        trial = record(vine, rng, noise_m=noise_m, rho=rho, rest_frames=60, end_frames=30 * (seed % 2))
        window = gated(trial.track)
        if window.accepted:
            lead = trial.lead_position_m[inside(trial, window)]
            from_mean.append(window.x_ss_m_s / (2 * np.ptp(lead) / (window.to_s - window.from_s)) - 1)
            balance = vine.quasi_steady_speed(2 * (lead - trial.lead_position_m[0]).mean())
            from_balance.append(window.x_ss_m_s / float(balance) - 1)
    assert len(from_mean) >= 8
    assert abs(np.mean(from_mean)) < 2e-3
    assert abs(np.mean(from_balance)) < 1e-3


@pytest.mark.parametrize("scale", [3, 4])
def test_a_vine_too_fast_to_settle_is_less_than_one_per_cent_off_balance(scale):
    off, vine = [], Vine(scale, 10.0)
    for seed in SEEDS:
        trial = record(vine, np.random.default_rng(seed), noise_m=3e-5, rest_frames=60)
        window = gated(trial.track)
        assert window.accepted
        tail = 2 * (trial.lead_position_m[inside(trial, window)] - trial.lead_position_m[0])
        off.append(window.x_ss_m_s / float(vine.quasi_steady_speed(tail.mean())) - 1)
    assert abs(np.mean(off)) < 0.01


@pytest.mark.parametrize("vine", [Vine(1, 3.0), Vine(2, 5.0), Vine(1, 10.0)], ids=str)
def test_short_plateaus_are_found(vine):
    windows = [gated(record(vine, np.random.default_rng(seed), noise_m=2e-5).track) for seed in SEEDS]
    assert sum(window.accepted for window in windows) >= 9


@pytest.mark.parametrize("vine", [Vine(1, 1.0), Vine(2, 5.0), Vine(4, 3.0)], ids=str)
def test_the_end_of_growth_is_not_in_the_window(vine):
    for seed in SEEDS:
        trial = record(vine, np.random.default_rng(seed), noise_m=3e-5, rest_frames=40, end_frames=60)
        window = gated(trial.track)
        assert window.accepted
        assert window.to_s < trial.grown_s + 0.5 / 1069
        grown_m = trial.lead_position_m - trial.lead_position_m[0]
        assert grown_m[inside(trial, window)].max() <= 0.95 * grown_m.max() + 1e-4


@pytest.mark.parametrize("end_frames", [0, 1])
@pytest.mark.parametrize("vine", [Vine(1, 1.0), Vine(2, 5.0), Vine(4, 3.0)], ids=str)
def test_a_recording_that_stops_with_the_growth_keeps_its_end_out_of_the_window(vine, end_frames):
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        trial = record(vine, rng, noise_m=3e-5, rest_frames=40, end_frames=end_frames)
        window = gated(trial.track, length_m=vine.length_m)
        assert window.accepted
        grown_m = trial.lead_position_m - trial.lead_position_m[0]
        assert grown_m[inside(trial, window)].max() <= 0.95 * vine.length_m + 1e-4


def test_growth_that_stops_short_of_the_length_keeps_its_window():
    vine = Vine(2, 1.0)
    trial = record(vine, np.random.default_rng(1000), noise_m=3e-5, rest_frames=40)
    assert gated(trial.track, length_m=2 * vine.length_m) == gated(trial.track)


def test_a_window_chosen_by_hand_that_runs_into_the_end_is_used_with_a_warning():
    vine = Vine(2, 1.0)
    trial = record(vine, np.random.default_rng(1000), noise_m=3e-5, rest_frames=40)
    kinematics = estimate_kinematics(trial.track, travel_ratio=2)
    last_s = float(trial.track.time_s[-1])
    late = user_window(trial.track, kinematics, (last_s - 0.1, last_s), vine.length_m)
    assert late.accepted
    assert "warning: runs into the end of growth" in late.reason
    early = user_window(trial.track, kinematics, (last_s - 0.2, last_s - 0.1), vine.length_m)
    assert "end of growth" not in early.reason


@pytest.mark.parametrize("noise_m", [0.0, 3e-5, 3e-4])
@pytest.mark.parametrize("rho", [0.0, 0.6])
def test_still_frames_are_never_steady_motion(noise_m, rho):
    for seed in range(1000, 1030):
        y = ar1(400, noise_m, rho, np.random.default_rng(seed))
        assert not gated(make_track(np.arange(400) / 1069, y)).accepted


def test_still_frames_of_whole_pixels_are_never_steady_motion():
    for seed in range(1000, 1030):
        y = np.round(ar1(400, 1e-4, 0.3, np.random.default_rng(seed)) / 3e-4) * 3e-4
        assert not gated(make_track(np.arange(400) / 1069, y)).accepted


@pytest.mark.parametrize("noise_m", [0.0, 1e-6, 3e-5, 1e-4, 3e-4])
@pytest.mark.parametrize("rest", [0, 60])
def test_uniform_acceleration_is_never_steady(noise_m, rest):
    time_s = np.arange(200) / 1069
    for seed in range(1000, 1020):
        y = 0.5 * 50 * np.maximum(time_s - time_s[rest], 0) ** 2 + ar1(200, noise_m, 0.0, np.random.default_rng(seed))
        assert not gated(make_track(time_s, y)).accepted


def test_free_fall_is_never_steady():
    time_s = np.arange(300) / 1000
    y = 0.5 * 9.81 * np.maximum(time_s - 0.05, 0) ** 2 + ar1(300, 1e-4, 0.0, np.random.default_rng(1000))
    window = gated(make_track(time_s, y), travel_ratio=1)
    assert not window.accepted
    assert math.isnan(window.x_ss_m_s)
    assert "no window is shown to be steady" in window.reason


def test_a_speed_that_goes_up_and_down_is_rejected_for_it():
    time_s = np.arange(300) / 1000
    y = 0.5 * time_s + 5e-4 * np.sin(150 * time_s) + ar1(300, 2e-5, 0.0, np.random.default_rng(1000))
    window = gated(make_track(time_s, y))
    assert not window.accepted
    assert "contains speeds from" in window.reason


def test_an_exact_acceleration_is_rejected_as_too_short_a_part():
    time_s = np.arange(600) / 1000
    window = gated(make_track(time_s, 0.5 * 9.81 * time_s**2))
    assert not window.accepted
    assert "is less than 10 % of the motion" in window.reason


def test_a_plateau_declining_by_two_per_cent_is_accepted_and_its_drift_reported():
    window = gated(ramp(0.02, 3e-5))
    assert window.accepted
    assert window.n_points > 250
    assert window.drift == pytest.approx(-0.02 * window.n_points / 300, abs=1.5e-3)
    assert window.drift_95[0] < window.drift < window.drift_95[1]
    assert "speed changes by" in window.reason


def test_a_decline_of_ten_per_cent_is_shortened_and_said():
    window = gated(ramp(0.10, 3e-5))
    assert window.accepted
    assert window.n_points < 100
    assert max(abs(bound) for bound in window.drift_95) <= 0.03
    assert f"{window.n_points} of 300 moving points" in window.reason


def test_a_decline_of_ten_per_cent_in_few_points_is_rejected_with_numbers():
    window = gated(ramp(0.10, 3e-5, n=40))
    assert not window.accepted
    assert "changes by" in window.reason
    assert "of 40 moving points" in window.reason


def test_drift_interval_covers_the_truth():
    covered = 0
    for seed in range(1000, 1100):
        window = gated(ramp(0.01, 1e-4, seed))
        truth = -0.01 * (window.to_s - window.from_s) / 0.299
        covered += window.drift_95[0] <= truth * 1.0 <= window.drift_95[1]
    assert 88 <= covered <= 100


@pytest.mark.parametrize("rho", [0.0, 0.6])
def test_error_of_the_speed_is_honest_at_constant_speed(rho):
    time_s, pulls = np.arange(200) / 1069, []
    for seed in range(1000, 1080):
        y = 0.5 * time_s + ar1(200, 1e-4, rho, np.random.default_rng(seed))
        window = gated(make_track(time_s, y))
        assert window.accepted
        pulls.append((window.x_ss_m_s - 1.0) / window.x_ss_sigma_m_s)
    assert 0.7 < np.sqrt(np.mean(np.square(pulls))) < 1.4


def test_constant_speed_from_the_first_frame_is_steady_throughout():
    time_s = np.arange(100) / 1069
    window = gated(make_track(time_s, 0.5 * time_s))
    assert window.accepted
    assert (window.from_s, window.to_s) == (0.0, time_s[-1])
    assert window.x_ss_m_s == pytest.approx(1.0, rel=1e-12)


def test_points_without_position_do_not_matter():
    trial = record(Vine(2, 1.0), np.random.default_rng(1000), noise_m=3e-5)
    whole = gated(trial.track)
    trial.track.lead_position_m[::17] = np.nan
    holed = gated(trial.track)
    assert holed.accepted
    assert holed.x_ss_m_s == pytest.approx(whole.x_ss_m_s, rel=1e-3)


def test_five_points_can_be_judged():
    time_s = np.arange(5) / 1000
    assert gated(make_track(time_s, 0.5 * time_s)).accepted
    noisy = make_track(time_s, 0.5 * time_s + 2e-5 * np.array([1.0, -1.0, 1.0, -1.0, 1.0]))
    assert not gated(noisy).accepted


def test_a_long_plateau_does_not_swallow_its_start_up():
    time_s = np.arange(600) / 1000
    moving = np.maximum(time_s - 0.05, 0)
    y = 0.5 * (moving - 0.02 * (1 - np.exp(-moving / 0.02)))
    window = gated(make_track(time_s, y + ar1(600, 3e-5, 0.0, np.random.default_rng(1000))))
    assert window.accepted
    assert window.from_s > 0.05 + 3 * 0.02
    assert window.x_ss_m_s == pytest.approx(1.0, rel=1e-3)


def test_a_tighter_limit_gives_a_shorter_window():
    track = ramp(0.05, 2e-5)
    kinematics = estimate_kinematics(track, travel_ratio=2)
    tight = gated_window(track, kinematics, drift_limit=0.015)
    assert tight.accepted
    assert tight.n_points < gated_window(track, kinematics).n_points


def test_a_window_chosen_by_hand_is_used_and_judged():
    track = ramp(0.0, 3e-5)
    window = user_window(track, estimate_kinematics(track, travel_ratio=2), (0.05, 0.25))
    assert window.accepted
    assert window.rule == "user"
    assert (window.from_s, window.to_s) == (0.05, 0.25)
    assert window.x_ss_m_s == pytest.approx(1.0, abs=4 * window.x_ss_sigma_m_s)
    assert "warning" not in window.reason


def test_a_window_chosen_by_hand_that_drifts_is_used_with_a_warning():
    track = ramp(0.3, 3e-5)
    window = user_window(track, estimate_kinematics(track, travel_ratio=2), (0.0, 0.299))
    assert window.accepted
    assert window.drift == pytest.approx(-0.3 / 0.85, rel=0.02)
    assert "warning: not shown to be steady" in window.reason


def test_a_window_chosen_by_hand_in_still_frames_is_used_with_a_warning():
    track = make_track(np.arange(100) / 1000, np.zeros(100))
    window = user_window(track, estimate_kinematics(track, travel_ratio=2), (0.02, 0.06))
    assert window.accepted
    assert "warning: the mean tail speed is 0 m/s" in window.reason


def test_a_window_chosen_by_hand_outside_the_track_is_refused_in_words():
    track = ramp(0.0, 3e-5)
    with pytest.raises(ValueError, match=r"5:6 s contains 0 usable points, at least 3 .* runs from 0 to 0.299 s"):
        user_window(track, estimate_kinematics(track, travel_ratio=2), (5.0, 6.0))


def test_kinematics_of_another_track_are_refused_in_words():
    track = ramp(0.0, 3e-5)
    with pytest.raises(ValueError, match="were not made from this track"):
        gated_window(ramp(0.0, 3e-5, n=50), estimate_kinematics(track, travel_ratio=2))


def test_a_thousand_frames_take_no_more_windows_than_fifty(monkeypatch):
    """All pairs of 56 starts and ends are 1600 windows, and the steps of the second pass a few hundred more."""
    tried = []
    drift = WindowMoments.drift

    def counted(self, first, last):
        tried.append(first.size)
        return drift(self, first, last)

    monkeypatch.setattr(WindowMoments, "drift", counted)
    for n in (50, 1000, 4000):
        gated(ramp(0.0, 3e-5, n=n))
        assert sum(tried) < 2500
        tried.clear()


@pytest.mark.parametrize("first", [0, 63, 64, 3000, 4990])
@pytest.mark.parametrize("points", [3, 4, 9, 127, 900])
def test_short_windows_late_in_a_long_track_are_fitted_as_well_as_any(first, points):
    rng = np.random.default_rng([1000, first, points])
    time_s = 1000 + np.cumsum(rng.uniform(0.5, 1.5, 5900)) / 1000
    position_m = 0.4 * (time_s - 1000) ** 1.5 + 1e-4 * rng.standard_normal(time_s.size)
    last = first + points - 1
    mean, drift, _ = WindowMoments(time_s, position_m, 1e-4, 0.3).drift(np.array([first]), np.array([last]))
    t, y = time_s[first : last + 1], position_m[first : last + 1]
    half_s = (t[-1] - t[0]) / 2
    _, slope, curve = np.polynomial.polynomial.polyfit((t - (t[0] + t[-1]) / 2) / half_s, y - y.mean(), 2)
    assert mean[0] == pytest.approx(slope / half_s, rel=1e-9)
    assert drift[0] == pytest.approx(4 * curve / slope, rel=1e-8, abs=1e-9)


def test_a_speed_that_bends_within_the_window_is_known_no_better_than_the_bend():
    """P₃ of the window's own time moves its ends by 2c: the mean speed of the cubic is c/half more than the line's."""
    time_s = np.arange(200) / 1000
    u = 2 * time_s / time_s[-1] - 1
    bend_m_s = 4e-3
    y = 0.5 * time_s + bend_m_s * time_s[-1] / 2 * np.polynomial.legendre.legval(u, [0, 0, 0, 1])
    track = make_track(time_s, y + ar1(200, 1e-6, 0.0, np.random.default_rng(1000)))
    window = user_window(track, estimate_kinematics(track, travel_ratio=2), (0.0, 1.0))
    assert window.x_ss_m_s == pytest.approx(1.0, abs=5e-4)
    assert window.x_ss_sigma_m_s == pytest.approx(2 * bend_m_s, rel=0.05)
