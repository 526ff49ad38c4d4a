"""The noise of a gauge is taken out of a recorded pressure, its corners are not."""

from __future__ import annotations

import numpy as np
import pytest

from vinetrack.inference.gauge_noise import noise_of, without_noise

TIMES_S = np.arange(0.0, 0.6, 1e-3)
PASSED_PA = 9.5e3 + 22.0  # half-way between two samples
LET_DOWN = np.interp(TIMES_S, [0.1, 0.12, 0.2, 0.5], [16e3, 3e3, 3e3, 16e3])


@pytest.mark.parametrize("sigma_Pa", [30.0, 100.0, 300.0])
def test_most_of_the_noise_goes(sigma_Pa: float):
    # A line through 33 samples leaves 1/√33 = 0.17 of the noise in its middle; corners keep more.
    noisy = LET_DOWN + sigma_Pa * np.random.default_rng(4).standard_normal(TIMES_S.size)
    assert noise_of(noisy) == pytest.approx(sigma_Pa, rel=0.15)
    left = without_noise(noisy) - LET_DOWN
    assert np.sqrt(np.mean(left**2)) < 0.5 * sigma_Pa
    assert np.max(np.abs(left)) < 5 * sigma_Pa


def test_a_threshold_is_passed_where_the_pressure_passes_it():
    # On 43 Pa a sample noise of 100 Pa shows the first passage a sample early or more.
    early, kept = [], []
    rise = TIMES_S > 0.25
    true_s = TIMES_S[rise][np.argmax(LET_DOWN[rise] > PASSED_PA)]
    for seed in range(40):
        noisy = LET_DOWN + 100.0 * np.random.default_rng(seed).standard_normal(TIMES_S.size)
        early.append(TIMES_S[rise][np.argmax(noisy[rise] > PASSED_PA)] - true_s)
        kept.append(TIMES_S[rise][np.argmax(without_noise(noisy)[rise] > PASSED_PA)] - true_s)
    assert np.mean(early) < -1e-3
    assert abs(np.mean(kept)) < 0.5e-3


def test_a_pressure_that_hardly_changes_is_known_far_better_than_a_sample():
    falls = 20e3 * (1 + TIMES_S / 0.4) ** -0.3
    left = [
        without_noise(falls + 100.0 * np.random.default_rng(seed).standard_normal(TIMES_S.size)) - falls
        for seed in range(10)
    ]
    assert np.sqrt(np.mean(np.square(left))) < 40.0


def test_exact_pressures_stay_as_they_are():
    assert without_noise(LET_DOWN) is LET_DOWN
    fills = 16e3 * -np.expm1(-TIMES_S / 0.2)
    np.testing.assert_array_equal(without_noise(fills), fills)
    np.testing.assert_array_equal(without_noise(np.full(5, 3.0)), np.full(5, 3.0))
