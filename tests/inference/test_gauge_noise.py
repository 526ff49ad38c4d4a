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


def emptied(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A chamber that a tube empties from 0.06 s on: pressure, the same with 50 Pa of noise, and the growth."""
    rng = np.random.default_rng(seed)
    growth_m = 0.3 * -np.expm1(-np.maximum(TIMES_S - 0.06, 0.0) / 0.3)
    pressure_Pa = 127e3 * (1 + 0.1 * growth_m) ** -1.4 - 101e3
    noise_Pa, noise_m = 50.0 * rng.standard_normal(TIMES_S.size), 4e-5 * rng.standard_normal(TIMES_S.size)
    return pressure_Pa, pressure_Pa + noise_Pa, growth_m + noise_m


@pytest.mark.parametrize("late_frames", [0, 12, -12])
def test_the_growth_tells_where_a_chamber_begins_to_empty_whatever_the_gauges_clock(late_frames: int):
    # What moves a vine is the time integral of the pressure. That of the noise wanders by σ √n = 1.2 kPa samples
    # before the best curve is taken out; a corner rounded by 70 Pa over 40 samples is worth more than twice that.
    wanders, at_corner = [], []
    for seed in range(20):
        pressure_Pa, noisy_Pa, growth_m = emptied(seed)
        place = np.clip(np.arange(TIMES_S.size) + late_frames, 0, TIMES_S.size - 1)
        left = without_noise(noisy_Pa, growth_m[place]) - pressure_Pa
        wanders.append(np.ptp(np.cumsum(left)))
        at_corner.append(left[60])
    assert np.mean(wanders) < 1.5 * 50.0 * np.sqrt(TIMES_S.size)
    assert abs(np.mean(at_corner)) < 15.0


def test_without_the_growth_such_a_corner_is_rounded():
    left = [without_noise(noisy_Pa)[60] - pressure_Pa[60] for pressure_Pa, noisy_Pa, _ in map(emptied, range(20))]
    assert np.mean(left) < -25.0
