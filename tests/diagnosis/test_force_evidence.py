"""Marginal likelihood and posterior of a smooth force, against closed forms of the normal distribution."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from vinetrack.core.records import Floats
from vinetrack.diagnosis.force_inversion import uniform_splines
from vinetrack.diagnosis.force_laws import NormalEquations, SearchPoint
from vinetrack.diagnosis.force_surface import (
    CONSTANT_AT_START,
    FREE_AT_START,
    KEPT_VARIANCE,
    LENGTH_SCALES,
    RELATIVE_AMPLITUDES,
    ZERO_AT_START,
    Domain,
    SmoothForce,
    covariance_modes,
)
from vinetrack.diagnosis.learned_force import (
    NEGLIGIBLE_LOG_RATIO,
    CoefficientLikelihood,
    coefficient_likelihood,
    marginal_likelihood,
    variable_weights,
)

GROWTH = Domain(("growth",), (0.0,), (0.25,), (12,), (math.inf,))
BOTH = Domain(("growth", "speed"), (0.0, 0.0), (0.25, 8.0), (10, 7), (math.inf, math.inf))
SPEED_POWER, HELD_N, NOISE_N = 0.4, 0.5, 0.05


def seen(design: Floats, positions: Floats) -> CoefficientLikelihood:
    """Likelihood of the coefficients from positions with unit noise."""
    return CoefficientLikelihood(design.T @ design, design.T @ positions, float(positions @ positions), 0.0, 0.0)


def test_marginal_likelihood_equals_that_of_the_normal_distribution() -> None:
    draw = np.random.default_rng(3)
    design = uniform_splines(draw.uniform(0, 1, 60), 12)
    positions = design @ draw.standard_normal(12) + draw.standard_normal(60)
    logs: dict[str, list[float]] = {ZERO_AT_START: [], CONSTANT_AT_START: []}
    for length in LENGTH_SCALES:
        directions, variances = covariance_modes(12, length, zero_at_start=True)
        variances = np.where(variances > KEPT_VARIANCE * variances.max(), variances, 0.0)
        process = (directions * variances) @ directions.T
        for begins, covariance in ((ZERO_AT_START, process), (CONSTANT_AT_START, process + 1.0)):
            unit = design @ covariance @ design.T
            logs[begins] += [
                multivariate_normal(cov=np.eye(60) + a**2 * unit).logpdf(positions) for a in 2 * RELATIVE_AMPLITUDES
            ]
    choice = marginal_likelihood(GROWTH, seen(design, positions), 1.0, 2.0)
    normal = -30 * math.log(2 * math.pi)
    for posterior in choice.posteriors:
        expected = logs[posterior.at_start]
        assert posterior.log_evidence + normal == pytest.approx(float(np.log(np.mean(np.exp(expected)))), abs=1e-6)
        assert posterior.length_scales == (LENGTH_SCALES[int(np.argmax(expected)) // RELATIVE_AMPLITUDES.size],)
        assert np.all(np.linalg.eigvalsh(posterior.covariance) > -1e-12)
    both = np.mean([np.mean(np.exp(each)) for each in logs.values()])
    assert choice.log_evidence + normal == pytest.approx(float(np.log(both)), abs=1e-6)


def test_inflated_noise_widens_the_band() -> None:
    design = uniform_splines(np.linspace(0, 1, 60), 12)
    told, at = seen(design, 9 * np.sin(np.linspace(0, 6, 60))), [np.linspace(0.05, 0.2, 9)]
    bands = [marginal_likelihood(GROWTH, told, inflation, 40.0).posteriors[0].force(at)[1] for inflation in (1.0, 4.0)]
    assert np.all(bands[0] < bands[1])


def beside_damping(force: Floats, speed: Floats, growth: Floats) -> tuple[SearchPoint, NormalEquations]:
    """A force on `BOTH` with errors of NOISE_N, together with a parameter that acts as a power of the speed."""
    surface = SmoothForce(BOTH, np.eye(BOTH.size))
    force = force + NOISE_N * np.random.default_rng(9).standard_normal(force.size)
    design = np.column_stack([speed**SPEED_POWER, BOTH.basis([growth, speed])]) / NOISE_N
    place = SearchPoint(np.zeros(1), np.zeros((0, 4)), surface, np.zeros(BOTH.size), [])
    square = design.T @ design
    square[0, 0] += HELD_N**-2
    return place, NormalEquations(float(force @ force) / NOISE_N**2, square, design.T @ force / NOISE_N)


@pytest.fixture(scope="module")
def visited() -> tuple[Floats, Floats]:
    draw = np.random.default_rng(7)
    return draw.uniform(0.3, 8.0, 4000), draw.uniform(0.0, 0.25, 4000)


def test_a_force_along_the_growth_is_recovered_with_a_competing_damping_error(
    visited: tuple[Floats, Floats],
) -> None:
    """A force that is zero where growth begins, with an error of the damping: both are recovered."""
    speed, growth = visited
    true = -0.8 * (growth / 0.25) ** 1.5 * speed / (speed + 8)
    place, normal = beside_damping(true + 0.3 * speed**SPEED_POWER, speed, growth)
    choice = marginal_likelihood(BOTH, coefficient_likelihood(place, normal), 1.0, 4.0)
    best = choice.best()
    assert best.at_start in (ZERO_AT_START, CONSTANT_AT_START)
    force, sigma = best.force([growth, speed])
    assert np.abs(force - true).max() < 0.02
    assert np.mean(np.abs(force - true) < 1.96 * sigma) > 0.9


def test_a_force_at_the_start_of_growth_that_damping_cannot_reproduce_is_detected(
    visited: tuple[Floats, Floats],
) -> None:
    speed, growth = visited
    true = -0.8 * np.exp(-(((speed - 3) / 4) ** 2)) - 0.5 * growth / 0.25
    place, normal = beside_damping(true, speed, growth)
    best = marginal_likelihood(BOTH, coefficient_likelihood(place, normal), 1.0, 4.0).best()
    assert best.at_start == FREE_AT_START
    # But for what damping holds, it is right; and the band knows what that could be.
    force, sigma = best.force([growth, speed])
    held = speed**SPEED_POWER
    off = force - true
    assert np.abs(off - held * (held @ off) / (held @ held)).max() < 0.06
    assert np.mean(np.abs(off) < 1.96 * sigma) > 0.9


def test_one_variable_and_two_have_equal_prior_odds() -> None:
    design = uniform_splines(np.linspace(0, 1, 60), 12)
    choice = marginal_likelihood(GROWTH, seen(design, np.zeros(60)), 1.0, 2.0)
    single = replace(choice, log_evidence=0.0)
    pairs = [
        replace(single, domain=replace(BOTH, variables=names)) for names in (("growth", "speed"), ("growth", "time"))
    ]
    weights = variable_weights([single, *pairs], 1.0)
    assert weights["growth"] == pytest.approx(0.5)
    assert weights["growth+speed"] == pytest.approx(0.25)


def test_mean_and_covariance_are_those_of_the_mixture_over_hyperparameters() -> None:
    """Each length scale and amplitude by the closed form for a normal prior, weighted by its likelihood."""
    draw = np.random.default_rng(11)
    design = uniform_splines(draw.uniform(0, 1, 40), 12)
    told = seen(design, design @ draw.standard_normal(12) + draw.standard_normal(40))
    parts = []
    for length in LENGTH_SCALES:
        mix = GROWTH.prior_modes((length,), CONSTANT_AT_START)
        for sd_N in 2 * RELATIVE_AMPLITUDES:
            prior = np.eye(mix.shape[1]) / sd_N**2
            covariance = mix @ np.linalg.inv(mix.T @ told.information @ mix + prior) @ mix.T
            shrunk = np.linalg.slogdet(np.eye(mix.shape[1]) + sd_N**2 * mix.T @ told.information @ mix)[1]
            parts.append((0.5 * float(told.score @ covariance @ told.score - shrunk), covariance))
    logs = np.array([log for log, _ in parts])
    weights = np.where(logs > logs.max() - NEGLIGIBLE_LOG_RATIO, np.exp(logs - logs.max()), 0.0)
    weights /= weights.sum()
    means = np.array([covariance @ told.score for _, covariance in parts])
    mean = weights @ means
    spread = np.tensordot(weights, np.array([covariance for _, covariance in parts]), 1)
    spread += ((means - mean).T * weights) @ (means - mean)
    posterior = next(
        each for each in marginal_likelihood(GROWTH, told, 1.0, 2.0).posteriors if each.at_start == CONSTANT_AT_START
    )
    assert posterior.mean == pytest.approx(mean, abs=1e-9)
    assert posterior.covariance == pytest.approx(spread, abs=1e-9)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_likelihood_that_overflows_is_not_finite(value: float) -> None:
    told = seen(np.eye(3), np.ones(3))
    assert told.is_finite
    assert not replace(told, chi2_at_zero=value).is_finite
    assert not replace(told, score=np.array([0.0, value, 0.0])).is_finite
