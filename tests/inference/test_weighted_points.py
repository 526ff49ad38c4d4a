"""Points of unequal noise in a fit: the same estimates as from data divided by their noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from vine_truth import Vine, record

from vinetrack.core.records import Track, Trial
from vinetrack.inference.fit_data import prepare
from vinetrack.inference.whitening import all_products, at_correlation, products, whiten

RHO = 0.4


def columns_and_gaps() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    draw = np.random.default_rng(20000)
    first = np.isin(np.arange(60), [0, 25])
    return draw.standard_normal((60, 3)), first, np.exp(draw.uniform(-1, 1, 60))


def test_weighted_products_are_those_of_columns_divided_by_their_noise():
    columns, first, relative_sd = columns_and_gaps()
    np.testing.assert_array_equal(
        products(columns, first, relative_sd), products(columns / relative_sd[:, None], first)
    )
    white = whiten(columns, first, RHO, relative_sd)
    np.testing.assert_allclose(
        at_correlation(products(columns, first, relative_sd)[None], RHO)[0], white.T @ white, rtol=1e-12
    )


def test_whitening_weights_arrays_of_any_dimension_alike():
    columns, first, relative_sd = columns_and_gaps()
    flat = whiten(columns, first, RHO, relative_sd)
    deep = whiten(np.stack([columns, 2 * columns]), first, RHO, relative_sd)
    np.testing.assert_allclose(deep[1], 2 * flat)
    np.testing.assert_allclose(whiten(columns[:, 0], first, RHO, relative_sd), flat[:, 0])


def test_without_weights_nothing_changes_by_a_bit():
    columns, first, _ = columns_and_gaps()
    plain = all_products([columns, columns], [first, first])
    np.testing.assert_array_equal(plain, all_products([columns, columns], [first, first], [None, None]))


def test_weighting_recovers_a_slope_with_the_error_it_states():
    """Whitened least squares on noise that grows tenfold along the way: 200 draws, z-scores of variance 1 ± 0.2."""
    time_s, first = np.linspace(0, 1, 200), np.arange(200) == 0
    sd = 0.01 * (1 + 9 * time_s)
    relative_sd = sd / np.exp(np.mean(np.log(sd)))
    draw = np.random.default_rng(20001)
    scores = []
    for _ in range(200):
        residual = 0.3 * time_s + sd * draw.standard_normal(200)
        white = whiten(np.column_stack([np.ones(200), time_s, residual]), first, 0.0, relative_sd)
        square = white[:, :2].T @ white[:, :2]
        estimate = np.linalg.solve(square, white[:, :2].T @ white[:, 2])
        left = white[:, 2] - white[:, :2] @ estimate
        sigma = np.sqrt(left @ left / 198 * np.linalg.inv(square)[1, 1])
        scores.append((estimate[1] - 0.3) / sigma)
    assert np.var(scores) == pytest.approx(1.0, abs=0.25)


def fast_trials(blur_s: float) -> tuple[list[tuple[Trial, Track]], list[np.ndarray]]:
    """Sixteen fast vines filmed with 0.06 mm of noise and a blur, and the true standard deviation of every point."""
    pairs, true_sd = [], []
    for i in range(16):
        draw = np.random.default_rng(20100 + i)
        vine = Vine(2, 10.0)
        made = record(vine, draw, noise_m=6e-5)
        blurred = blur_s * made.lead_velocity_m_s
        positions = made.track.lead_position_m + blurred * draw.standard_normal(blurred.size)
        trial = Trial(
            name=f"t{i}", diameter_m=vine.diameter_m, thickness_m=1e-4, pressure_Pa=3e4, yield_pressure_Pa=1e3
        )
        pairs.append((trial, replace(made.track, lead_position_m=positions)))
        true_sd.append(np.hypot(6e-5, blurred))
    return pairs, true_sd


def test_trials_are_weighted_where_noise_grows_with_speed():
    pairs, true_sd = fast_trials(6e-5)
    data, left_out = prepare(pairs)
    assert not left_out
    for item, true in zip(data, true_sd, strict=True):
        assert item.relative_sd is not None
        assert np.mean(np.log(item.relative_sd)) == pytest.approx(0.0, abs=1e-12)
        # Thirty moving frames a trial, differences as good as 185 points in all: 5 % is its standard error.
        assert item.blur_s == pytest.approx(6e-5, rel=0.15)
        ratio = np.log(item.noise_m * item.relative_sd / true)
        assert np.sqrt(np.mean(ratio**2)) < 0.4
        assert item.mean_noise_m == pytest.approx(np.sqrt(np.mean(true**2)), rel=0.3)


def test_trials_of_equal_noise_are_not_weighted():
    data, _ = prepare(fast_trials(0.0)[0])
    assert all(item.relative_sd is None and item.mean_noise_m == item.noise_m for item in data)


def test_points_have_equal_weights_if_the_noise_is_given():
    pairs, _ = fast_trials(6e-5)
    assert all(trial_data.relative_sd is None for trial_data in prepare(pairs, weighted=False)[0])
