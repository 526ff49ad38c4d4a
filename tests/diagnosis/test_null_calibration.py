"""Calibration of the tests of a verdict on null campaigns of the same design."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

import vinetrack as vt
from vinetrack.core.records import Trial
from vinetrack.diagnosis.campaign_power import CampaignDesign
from vinetrack.diagnosis.null_calibration import TESTS, CalibratedTest, CampaignPValues, calibrate, null_p_values
from vinetrack.diagnosis.score_test import family_p_value, family_test
from vinetrack.narrative.power_text import calibration_lines
from vinetrack.planning.campaign_information import FilmingPlan


def test_the_p_value_of_one_score_is_its_tail_probability() -> None:
    assert family_p_value(np.eye(1), [0], ["leak"], np.array([2.5])) == pytest.approx(2 * norm.sf(2.5))
    assert family_p_value(np.eye(1), [1], ["leak"], np.array([2.5])) == pytest.approx(norm.sf(2.5))


def test_p_values_of_independent_candidates_multiply() -> None:
    count, scores = 12, np.zeros(12)
    scores[3] = 3.0
    chance = family_p_value(np.eye(count), [0] * count, [f"e{k}" for k in range(count)], scores)
    assert chance == pytest.approx(1 - (1 - 2 * norm.sf(3.0)) ** count, rel=0.03)


def test_a_score_at_its_threshold_has_the_family_level() -> None:
    draw = np.random.default_rng(1)
    factor = draw.standard_normal((9, 4))
    cosines = factor @ factor.T + 3 * np.eye(9)
    root = np.sqrt(np.diag(cosines))
    cosines = cosines / root[:, None] / root
    effects, signs = ["a"] * 4 + ["b"] * 3 + ["c", "d"], [0, 0, 0, 0, 1, 1, 1, 0, -1]
    limits = family_test(cosines, signs, effects, 0.003)
    scores = np.array([limits.threshold("a"), 0, 0, 0, 0, 0, 0, 0, 0.0])
    assert family_p_value(cosines, signs, effects, scores) == pytest.approx(0.003, rel=0.1)


def nulls(rate: float, count: int = 400) -> tuple[float, ...]:
    """p-values whose −ln is exponential with this rate, evenly spread over it."""
    even = (np.arange(count) + 0.5) / count
    return tuple((even ** (1 / rate)).tolist())


def test_correct_levels_have_rate_one() -> None:
    test = CalibratedTest("scores", 0.003, 0.001, nulls(1.0))
    rate, low, high = test.rate
    assert rate == pytest.approx(1.0, abs=0.02)
    assert low < 1 < high
    assert test.is_exponential
    assert test.by_tail[0] == pytest.approx(0.001, rel=0.15)


def test_the_monte_carlo_p_value_counts_the_observed_campaign() -> None:
    test = CalibratedTest("scores", 0.003, 0.1, (0.05, 0.2, 0.3, 0.4))
    assert (test.exceeding.count, test.monte_carlo) == (1, 2 / 5)


def test_a_rejection_is_withdrawn_where_null_campaigns_are_as_extreme() -> None:
    test = CalibratedTest("scores", 0.003, 1e-4, nulls(0.3))
    assert test.is_called
    assert test.still_called is False


def test_a_rejection_far_beyond_all_null_campaigns_stands() -> None:
    assert CalibratedTest("scores", 0.003, 1e-9, nulls(1.0)).still_called is True


def test_few_campaigns_without_an_exponential_tail_are_inconclusive() -> None:
    test = CalibratedTest("scores", 0.003, 1e-9, (0.5,) * 30)
    assert not test.is_exponential
    assert not test.resolves
    assert test.still_called is None


def test_the_text_states_what_changes() -> None:
    observed = dict.fromkeys(TESTS, 0.5) | {"scores of all candidates": 1e-4}
    null = [CampaignPValues(k, dict.fromkeys(TESTS, chance)) for k, chance in enumerate(nulls(0.3))]
    null.append(CampaignPValues(999, {}, "FitError: none"))
    calibration = calibrate(observed, null, ("gravity",))
    assert (calibration.campaigns, calibration.failed) == (400, 1)
    assert calibration.was_called
    assert calibration.still_called is False
    lines = "\n".join(calibration_lines(calibration))
    assert "it no longer would be" in lines
    assert "1 campaigns could not be fitted" in lines
    assert calibration.to_json()["still_called"] is False


def test_a_null_campaign_of_a_design_raises_no_alarm() -> None:
    trials: list[Trial] = []
    for k, pressure in enumerate(("14", "14", "24", "24", "34", "34")):
        texts = {"diameter_mm": "24", "thickness_um": "200", "length_mm": "200", "pressure_kPa": pressure}
        trial = vt.planned_trial({**texts, "yield_pressure_kPa": "3"}).trials[0]
        trials.append(replace(trial, name=f"t{k}", position_systematic_m=0.0))
    count = len(trials)
    design = CampaignDesign(
        vt.predictive_inputs(trials[0]).model, tuple(trials), (FilmingPlan(500.0, 1e-4),) * count, (0.005, 0.01),
        (math.nan,) * count, (False,) * count, ("leak", "tail_friction", "air_drag"),
    )  # fmt: skip
    answer = null_p_values(design, 4)
    assert answer.failed == ""
    assert set(answer.p_values) == set(TESTS)
    assert all(TESTS[name] < chance <= 1 for name, chance in answer.p_values.items())
