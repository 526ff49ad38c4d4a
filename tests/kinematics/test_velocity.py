"""Velocity against vines integrated by SciPy and against formulas. Scored on seeds 1000 and up (tuned on 0–99)."""

from dataclasses import replace

import numpy as np
import pytest
from vine_truth import CAPTURE_FPS, Vine, ar1, make_track, record

from vinetrack.kinematics.velocity import estimate_kinematics, fit_all_windows

SINGLE_WINDOWS = (5, 7, 9, 11, 15, 21, 29, 39, 53, 71, 95, 127, 171)
TRIALS = [
    (vine, noise_m, rho)
    for vine in (Vine(1, 0.2), Vine(2, 1.0), Vine(3, 5.0), Vine(4, 3.0), Vine(4, 10.0))
    for noise_m, rho in ((3e-5, 0.0), (1e-4, 0.6), (3e-4, 0.3))
]


@pytest.mark.parametrize(("vine", "noise_m", "rho"), TRIALS)
def test_as_good_as_the_best_single_window_with_the_truth_in_hand_and_its_error_is_stated(vine, noise_m, rho):
    """The stated error holds within a factor of two from four frames after release on."""
    ours, single, pulls = [], {width: [] for width in SINGLE_WINDOWS}, []
    for seed in range(1000, 1008):
        trial = record(vine, np.random.default_rng(seed), noise_m=noise_m, rho=rho, rest_frames=60)
        track, since_s = trial.track, trial.track.time_s - trial.release_s
        kinematics, scored = estimate_kinematics(track, travel_ratio=2), since_s > -0.01
        error = kinematics.lead_velocity_m_s - trial.lead_velocity_m_s
        pulls.append((error / kinematics.lead_velocity_sigma_m_s)[since_s > 4 / CAPTURE_FPS])
        ours.append(np.mean(error[scored] ** 2))
        for width in [width for width in SINGLE_WINDOWS if width <= scored.size]:
            fits = fit_all_windows(track.time_s, track.lead_position_m, width, 3, 0.0)
            error = fits.velocities(track.time_s, 0.0)[1] - trial.lead_velocity_m_s
            single[width].append(np.mean(error[scored] ** 2))
    best = min(np.mean(values) for values in single.values() if len(values) == 8)
    assert np.sqrt(np.mean(ours) / best) < 1.2
    pull = np.concatenate(pulls)
    assert 0.6 < np.sqrt(np.mean(pull**2)) < 2.0
    assert np.mean(np.abs(pull) > 3) < 0.1


def test_exact_cubic_is_returned_exactly_and_points_without_position_or_with_a_flag_are_left_out():
    time_s = np.arange(100) / 1000
    cubic = np.polynomial.Polynomial([0.2, 0.4, 3.0, -11.0])
    y = cubic(time_s)
    y[50], y[[0, 40, 41, 99]] = 7.0, np.nan
    track = make_track(time_s, y)
    flagged = replace(track, flag=np.where(np.arange(100) == 50, "rejected", track.flag))
    kinematics = estimate_kinematics(flagged, travel_ratio=2)
    kept_s = np.delete(time_s, [0, 40, 41, 50, 99])
    np.testing.assert_array_equal(kinematics.time_s, kept_s)
    np.testing.assert_allclose(kinematics.lead_position_m, cubic(kept_s), rtol=1e-9)
    np.testing.assert_allclose(kinematics.lead_velocity_m_s, cubic.deriv()(kept_s), rtol=1e-6)
    assert np.all(np.isfinite(kinematics.lead_velocity_sigma_m_s))


def test_where_points_jump_about_the_velocity_is_known_as_badly_as_they_say():
    """Twelve points off by a millimetre in a track of micrometres: no window follows them, and noise says nothing."""
    pulls = []
    for seed in range(20661, 20665):
        draw = np.random.default_rng(seed)
        time_s = np.arange(300) / 1000
        y = 0.2 * time_s + 1e-6 * draw.standard_normal(300)
        y[150:162] += 1e-3 * draw.standard_normal(12)
        kinematics = estimate_kinematics(make_track(time_s, y), travel_ratio=2)
        off = kinematics.lead_velocity_m_s[150:162] - 0.2
        pulls.append(off / kinematics.lead_velocity_sigma_m_s[150:162])
    assert 0.2 < np.median(np.abs(pulls)) < 2


EVEN = np.arange(60) / 1000
GAPPED = np.delete(np.arange(64) / 1000, [20, 21, 22, 40])
UNEVEN = np.cumsum(np.random.default_rng(1000).uniform(0.5, 1.5, 60)) / 1000


@pytest.mark.parametrize("time_s", [EVEN, GAPPED, UNEVEN], ids=["even", "gapped", "uneven"])
@pytest.mark.parametrize("side", [-1.0, 0.0, 0.5])
def test_a_cubic_is_returned_exactly(time_s, side):
    cubic = np.polynomial.Polynomial([0.1, 0.5, -8.0, 90.0])
    fits = fit_all_windows(time_s, cubic(time_s), 9, 3, 0.0)
    window, velocity, _ = fits.velocities(time_s, side)
    values, _ = fits.at(time_s, window)
    np.testing.assert_allclose(velocity, cubic.deriv()(time_s), rtol=1e-9)
    np.testing.assert_allclose(values[0], cubic(time_s), rtol=1e-9)
    np.testing.assert_allclose(values[2], cubic.deriv(2)(time_s), rtol=1e-6)
    assert np.all(fits.misfit < 1e-24)


@pytest.mark.slow
@pytest.mark.parametrize("rho", [0.0, 0.6])
@pytest.mark.parametrize("time_s", [EVEN, GAPPED], ids=["even", "gapped"])
def test_stated_error_is_that_of_many_draws(time_s, rho):
    rng = np.random.default_rng(1000)
    draws, point = [], 24
    for _ in range(1500):
        fits = fit_all_windows(time_s, ar1(time_s.size, 1.0, rho, rng), 15, 3, rho)
        _, velocity, gain = fits.velocities(time_s, 0.0)
        draws.append(velocity[point])
    assert np.std(draws) == pytest.approx(gain[point], rel=0.06)


@pytest.mark.parametrize("rho", [0.0, 0.6])
def test_misfit_of_noise_averages_its_number_of_terms(rho):
    rng = np.random.default_rng(1000)
    misfits = [fit_all_windows(EVEN, ar1(60, 1.0, rho, rng), 21, 3, rho).misfit[::20] for _ in range(500)]
    assert np.mean(misfits) == pytest.approx(4.0, rel=0.08)
