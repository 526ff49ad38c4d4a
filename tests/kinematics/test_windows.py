"""Local polynomials against polynomials, SciPy and Monte Carlo."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import savgol_filter
from vine_truth import ar1

from vinetrack.kinematics.velocity import correlated, fit_all_windows

EVEN = np.arange(60) / 1000
GAPPED = np.delete(np.arange(64) / 1000, [20, 21, 22, 40])
UNEVEN = np.cumsum(np.random.default_rng(1000).uniform(0.5, 1.5, 60)) / 1000


@pytest.mark.parametrize("time_s", [EVEN, GAPPED, UNEVEN], ids=["even", "gapped", "uneven"])
@pytest.mark.parametrize("side", [-1.0, -0.5, 0.0, 0.5, 1.0])
def test_a_cubic_is_returned_exactly(time_s, side):
    cubic = np.polynomial.Polynomial([0.1, 0.5, -8.0, 90.0])
    fits = fit_all_windows(time_s, cubic(time_s), 9, 3, 0.0)
    window, velocity, _ = fits.velocities(time_s, side)
    values, _ = fits.at(time_s, window)
    np.testing.assert_allclose(velocity, cubic.deriv()(time_s), rtol=1e-9)
    np.testing.assert_allclose(values[0], cubic(time_s), rtol=1e-9)
    np.testing.assert_allclose(values[2], cubic.deriv(2)(time_s), rtol=1e-6)
    assert np.all(fits.misfit < 1e-24)


def test_even_spacing_is_savitzky_golay():
    y = 0.3 * EVEN + ar1(60, 1e-4, 0.0, np.random.default_rng(1000))
    _, velocity, _ = fit_all_windows(EVEN, y, 11, 3, 0.0).velocities(EVEN, 0.0)
    expected = savgol_filter(y, 11, 3, deriv=1, delta=1e-3, mode="interp")
    np.testing.assert_allclose(velocity, expected, rtol=1e-9)


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


def test_a_corner_is_a_misfit():
    corner = np.maximum(EVEN - 0.03, 0.0) * 2.0
    fits = fit_all_windows(EVEN, corner, 15, 3, 0.0)
    across, beside = fits.misfit[23], fits.misfit[40]
    assert across > 1e-7
    assert beside < 1e-20


def test_correlated_is_multiplication_by_the_correlation_matrix():
    weights = np.random.default_rng(1000).standard_normal((3, 12))
    lag = np.abs(np.subtract.outer(np.arange(12), np.arange(12)))
    np.testing.assert_allclose(correlated(weights, 0.6), weights @ 0.6**lag, rtol=1e-12)
