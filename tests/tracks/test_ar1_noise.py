"""Simulated noise has the requested standard deviation and correlation, from the first position on."""

from __future__ import annotations

import numpy as np
import pytest

from vinetrack.tracks.position_noise import ar1_noise


@pytest.mark.parametrize("correlation", [-0.4, 0.0, 0.6, 0.9])
def test_variance_and_lag_one_correlation_are_those_of_the_process(correlation: float) -> None:
    noise = ar1_noise(200_000, 2e-4, correlation, np.random.default_rng(5))
    # Standard error of a variance of correlated normal noise: √(2/n · (1+ρ²)/(1−ρ²)); four of them.
    allowed = 4 * np.sqrt(2 / noise.size * (1 + correlation**2) / (1 - correlation**2))
    assert np.var(noise) == pytest.approx(4e-8, rel=allowed)
    lag_one = np.mean(noise[1:] * noise[:-1]) / np.var(noise)
    assert lag_one == pytest.approx(correlation, abs=4 * np.sqrt((1 - correlation**2) / noise.size))


def test_the_first_position_errs_as_much_as_any_other() -> None:
    draw = np.random.default_rng(6)
    first = np.array([ar1_noise(3, 1.0, 0.9, draw)[0] for _ in range(4000)])
    assert np.std(first) == pytest.approx(1.0, rel=4 / np.sqrt(2 * first.size))


def test_without_correlation_it_is_the_deviates_themselves() -> None:
    deviates = np.random.default_rng(7).standard_normal(50)
    assert np.array_equal(ar1_noise(50, 3e-4, 0.0, np.random.default_rng(7)), 3e-4 * deviates)
