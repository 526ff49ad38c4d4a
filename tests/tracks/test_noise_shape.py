"""Noise of known size and shape on known motions; seeds 20000 and up."""

from __future__ import annotations

import numpy as np
import pytest
from vine_truth import Vine, ar1, record

from vinetrack.tracks.position_noise import NoiseShape, ar1_difference_gain, noise_shape

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


def test_the_gain_of_correlated_noise_is_that_of_long_series():
    for rho in (0.3, 0.7):
        noise = ar1(200_000, 1.0, rho, np.random.default_rng(20400))
        fourth = np.diff(noise, 4) / np.sqrt(70)
        assert fourth.std() == pytest.approx(ar1_difference_gain(rho), rel=0.02)
