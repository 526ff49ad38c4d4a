"""How likely forces are, and what of them positions decide: against closed forms of the normal distribution."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from vinetrack.core.records import Floats
from vinetrack.diagnosis.force_evidence import UNLIKELY, Posterior, posterior, posterior_weights, weighed
from vinetrack.diagnosis.force_refinement import Normal, Place
from vinetrack.diagnosis.force_surface import (
    AMPLITUDES,
    ANY,
    CONSTANT,
    KEPT,
    LENGTHS,
    NOTHING,
    Domain,
    Surface,
    covariance_root,
    curves,
)

GROWTH = Domain(("growth",), (0.0,), (0.25,), (12,), (math.inf,))
BOTH = Domain(("growth", "speed"), (0.0, 0.0), (0.25, 8.0), (10, 7), (math.inf, math.inf))
SPEED_POWER, HELD_N, NOISE_N = 0.4, 0.5, 0.05


def seen(design: Floats, positions: Floats) -> Posterior:
    """What unit noise on positions says of the coefficients."""
    return Posterior(design.T @ design, design.T @ positions, float(positions @ positions), 0.0, 0.0)


def test_the_marginal_likelihood_is_that_of_the_normal_distribution() -> None:
    draw = np.random.default_rng(3)
    design = curves(draw.uniform(0, 1, 60), 12)
    positions = design @ draw.standard_normal(12) + draw.standard_normal(60)
    logs: dict[str, list[float]] = {NOTHING: [], CONSTANT: []}
    for length in LENGTHS:
        directions, variances = covariance_root(12, length, from_nothing=True)
        variances = np.where(variances > KEPT * variances.max(), variances, 0.0)
        process = (directions * variances) @ directions.T
        for begins, covariance in ((NOTHING, process), (CONSTANT, process + 1.0)):
            unit = design @ covariance @ design.T
            logs[begins] += [
                multivariate_normal(cov=np.eye(60) + a**2 * unit).logpdf(positions) for a in 2 * AMPLITUDES
            ]
    choice = weighed(GROWTH, seen(design, positions), 1.0, 2.0)
    normal = -30 * math.log(2 * math.pi)
    for beginning in choice.beginnings:
        expected = logs[beginning.begins]
        assert beginning.log_evidence + normal == pytest.approx(float(np.log(np.mean(np.exp(expected)))), abs=1e-6)
        assert beginning.lengths == (LENGTHS[int(np.argmax(expected)) // AMPLITUDES.size],)
        assert np.all(np.linalg.eigvalsh(beginning.covariance) > -1e-12)
    both = np.mean([np.mean(np.exp(each)) for each in logs.values()])
    assert choice.log_evidence + normal == pytest.approx(float(np.log(both)), abs=1e-6)


def test_noise_that_is_wider_than_thought_widens_the_band() -> None:
    design = curves(np.linspace(0, 1, 60), 12)
    told, at = seen(design, 9 * np.sin(np.linspace(0, 6, 60))), [np.linspace(0.05, 0.2, 9)]
    bands = [weighed(GROWTH, told, inflation, 40.0).beginnings[0].force(at)[1] for inflation in (1.0, 4.0)]
    assert np.all(bands[0] < bands[1])


def beside_damping(force: Floats, speed: Floats, growth: Floats) -> tuple[Place, Normal]:
    """Normal equations of a force on `BOTH`, seen within NOISE_N, beside a number that acts as a power of the speed."""
    surface = Surface(BOTH, np.eye(BOTH.size))
    force = force + NOISE_N * np.random.default_rng(9).standard_normal(force.size)
    design = np.column_stack([speed**SPEED_POWER, BOTH.basis([growth, speed])]) / NOISE_N
    place = Place(np.zeros(1), np.zeros((0, 4)), surface, np.zeros(BOTH.size), [])
    square = design.T @ design
    square[0, 0] += HELD_N**-2
    return place, Normal(float(force @ force) / NOISE_N**2, square, design.T @ force / NOISE_N)


@pytest.fixture(scope="module")
def visited() -> tuple[Floats, Floats]:
    draw = np.random.default_rng(7)
    return draw.uniform(0.3, 8.0, 4000), draw.uniform(0.0, 0.25, 4000)


def test_what_damping_could_hold_as_well_is_left_to_it_and_the_growth_is_learned(
    visited: tuple[Floats, Floats],
) -> None:
    """A force that is nothing where growth begins, beside damping that is wrong: both come out."""
    speed, growth = visited
    true = -0.8 * (growth / 0.25) ** 1.5 * speed / (speed + 8)
    place, normal = beside_damping(true + 0.3 * speed**SPEED_POWER, speed, growth)
    choice = weighed(BOTH, posterior(place, normal), 1.0, 4.0)
    best = choice.best()
    assert best.begins in (NOTHING, CONSTANT)
    force, sigma = best.force([growth, speed])
    assert np.abs(force - true).max() < 0.02
    assert np.mean(np.abs(force - true) < 1.96 * sigma) > 0.9


def test_a_force_that_damping_cannot_hold_where_growth_begins_is_not_taken_for_nothing(
    visited: tuple[Floats, Floats],
) -> None:
    speed, growth = visited
    true = -0.8 * np.exp(-(((speed - 3) / 4) ** 2)) - 0.5 * growth / 0.25
    place, normal = beside_damping(true, speed, growth)
    best = weighed(BOTH, posterior(place, normal), 1.0, 4.0).best()
    assert best.begins == ANY
    # But for what damping holds, it is right; and the band knows what that could be.
    force, sigma = best.force([growth, speed])
    held = speed**SPEED_POWER
    off = force - true
    assert np.abs(off - held * (held @ off) / (held @ held)).max() < 0.06
    assert np.mean(np.abs(off) < 1.96 * sigma) > 0.9


def test_one_variable_and_two_have_the_same_odds_beforehand() -> None:
    design = curves(np.linspace(0, 1, 60), 12)
    choice = weighed(GROWTH, seen(design, np.zeros(60)), 1.0, 2.0)
    single = replace(choice, log_evidence=0.0)
    pairs = [
        replace(single, domain=replace(BOTH, variables=names)) for names in (("growth", "speed"), ("growth", "time"))
    ]
    weights = posterior_weights([single, *pairs], 1.0)
    assert weights["growth"] == pytest.approx(0.5)
    assert weights["growth+speed"] == pytest.approx(0.25)


def test_the_mean_and_the_band_are_those_of_the_mixture_over_lengths_and_amplitudes() -> None:
    """Each length and amplitude by the closed form of a normal prior, with the weight of its likelihood."""
    draw = np.random.default_rng(11)
    design = curves(draw.uniform(0, 1, 40), 12)
    told = seen(design, design @ draw.standard_normal(12) + draw.standard_normal(40))
    parts = []
    for length in LENGTHS:
        mix = GROWTH.mix((length,), CONSTANT)
        for sd_N in 2 * AMPLITUDES:
            prior = np.eye(mix.shape[1]) / sd_N**2
            covariance = mix @ np.linalg.inv(mix.T @ told.information @ mix + prior) @ mix.T
            shrunk = np.linalg.slogdet(np.eye(mix.shape[1]) + sd_N**2 * mix.T @ told.information @ mix)[1]
            parts.append((0.5 * float(told.score @ covariance @ told.score - shrunk), covariance))
    logs = np.array([log for log, _ in parts])
    weights = np.where(logs > logs.max() - UNLIKELY, np.exp(logs - logs.max()), 0.0)
    weights /= weights.sum()
    means = np.array([covariance @ told.score for _, covariance in parts])
    mean = weights @ means
    spread = np.tensordot(weights, np.array([covariance for _, covariance in parts]), 1)
    spread += ((means - mean).T * weights) @ (means - mean)
    beginning = next(each for each in weighed(GROWTH, told, 1.0, 2.0).beginnings if each.begins == CONSTANT)
    assert beginning.mean == pytest.approx(mean, abs=1e-9)
    assert beginning.covariance == pytest.approx(spread, abs=1e-9)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_what_overflows_says_nothing(value: float) -> None:
    told = seen(np.eye(3), np.ones(3))
    assert told.finite
    assert not replace(told, cost=value).finite
    assert not replace(told, score=np.array([0.0, value, 0.0])).finite
