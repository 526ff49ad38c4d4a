"""Slow errors against known ones; seeds 1811 and up, which tuned nothing."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from vinetrack.video.edge_repair import BANDS, SLOW_GREY, SLOW_PX, noise_and_slow, shared_disagreement, slow_error_px

FRAMES = 60


def lasting(rng: np.random.Generator, sd_px: float, frames: int = FRAMES) -> np.ndarray:
    """Errors of bands with a correlation time of about ten frames, shape (frames, BANDS)."""
    smooth = gaussian_filter1d(rng.standard_normal((frames + 80, BANDS)), 8.0, axis=0)[40:-40]
    return sd_px * smooth / np.sqrt(1 / (2 * np.sqrt(np.pi) * 8.0))


def test_the_slow_error_of_the_mean_follows_from_the_bands() -> None:
    rng = np.random.default_rng(1811)
    told = [shared_disagreement(lasting(rng, 0.2, 400) + rng.normal(0, 0.1, (400, BANDS))) for _ in range(200)]
    assert np.sqrt(np.mean(np.square(told))) == pytest.approx(0.2 / np.sqrt(BANDS), rel=0.2)


def test_noise_of_bands_is_not_a_slow_error() -> None:
    rng = np.random.default_rng(1812)
    told = [shared_disagreement(rng.normal(0, 0.2, (FRAMES, BANDS))) for _ in range(200)]
    assert np.median(told) < 0.2 * 0.2 / np.sqrt(BANDS)


def test_a_tilting_tip_leaves_the_mean_unchanged() -> None:
    tilt = np.outer(lasting(np.random.default_rng(1813), 1.0)[:, 0], np.linspace(-1, 1, BANDS))
    assert shared_disagreement(tilt) < 1e-12


def test_the_shape_of_the_tip_is_not_an_error() -> None:
    assert shared_disagreement(np.tile([0.0, 1.5, 1.0, 0.2], (FRAMES, 1))) == 0.0


@pytest.mark.parametrize("shape", [(FRAMES, 1), (FRAMES, 3), (4, BANDS), (0, BANDS)])
def test_too_few_bands_or_frames_give_zero(shape: tuple[int, int]) -> None:
    assert shared_disagreement(np.random.default_rng(1814).normal(size=shape)) == 0.0


def test_the_slow_error_grows_with_falling_contrast_up_to_a_bound() -> None:
    contrast = np.concatenate([np.full(20, np.nan), np.full(200, 60.0), np.full(200, -8.0), np.full(100, 0.01)])
    place = np.array([np.nan, 120.0, 320.0, 490.0])
    errors = slow_error_px(place, contrast, 0.05)
    certain = np.hypot(SLOW_PX, 0.05)
    assert errors[1:] == pytest.approx(np.hypot(certain, [SLOW_GREY / 60, SLOW_GREY / 8, SLOW_GREY]))
    assert errors[0] == errors[1]
    assert slow_error_px(place, np.full(500, np.nan), 0.05) == pytest.approx(certain)


def test_random_and_slow_parts_add_up_in_quadrature() -> None:
    bands, seen, apart = np.array([0.05, 0.05, 0.05]), np.array([0.05, 0.5, 0.5]), np.array([0.05, 0.5, 5.0])
    noise, slow = noise_and_slow(bands, seen, apart)
    assert np.hypot(noise, slow) == pytest.approx(apart)
    assert slow[0] == 0
    assert slow[1] > 2 * noise[1]
