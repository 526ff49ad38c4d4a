"""Of many trials a search lets go of curves; what it says does not depend on it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hidden_truth import grown

import vinetrack as vt
from vinetrack.diagnosis import candidate_fits
from vinetrack.diagnosis.candidate_fits import drop_curves, with_curves, without_curves
from vinetrack.diagnosis.ladder import candidates_of, initial_fit
from vinetrack.diagnosis.likelihood_ratio import ANSWER_SET_DELTA_CHI2, MAX_INFLATION, likelihood_ratio
from vinetrack.effects import find_effect
from vinetrack.inference.fit_result import Fit
from vinetrack.inference.optimiser import relative_residual


@pytest.fixture(scope="module")
def whole() -> Fit:
    """The base model fitted to trials whose tail rubs."""
    pairs = grown({"tail_friction.mu_w": 1.0}, seed=7270)
    return initial_fit(vt.base_model(), pairs, candidates_of(vt.base_model(), ["tail_friction"]), profile=False)


def test_a_fit_is_the_same_once_its_curves_are_made_again(whole: Fit) -> None:
    fit = whole
    light = without_curves(fit)
    assert not light.trials
    assert relative_residual(light.predictor, light.solution) == relative_residual(fit.predictor, fit.solution)
    steps = fit.predictor.steps.copy()
    again = with_curves(light)
    assert np.array_equal(fit.predictor.steps, steps)
    assert (again.numbers, again.log_likelihood) == (fit.numbers, fit.log_likelihood)
    for trial, before_trial in zip(again.trials, fit.trials, strict=True):
        assert np.array_equal(trial.residual_m, before_trial.residual_m)
        assert np.array_equal(trial.predicted_velocity_m_s, before_trial.predicted_velocity_m_s)
    # Steps of differences differ, and with them the one frame in which growth ends.
    for columns, before_columns in zip(again.solution.columns, fit.solution.columns, strict=True):
        apart, whole = (np.linalg.norm(each, axis=0) for each in (columns - before_columns, before_columns))
        assert np.all(apart <= 0.02 * whole)


@pytest.mark.parametrize("points", [0, 10**9])
def test_of_many_trials_only_hypotheses_that_may_still_be_kept_hold_their_curves(
    whole: Fit, points: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(candidate_fits, "MANY_POINTS", points)
    monkeypatch.setattr(candidate_fits, "MAX_WHOLE_FITS", 2)
    effect = find_effect("tail_friction")
    behind = {"best": 0.0, "second": 500.0, "third": 600.0, "may be kept": 0.4 * ANSWER_SET_DELTA_CHI2 * MAX_INFLATION}
    hypotheses = {
        name: likelihood_ratio(whole, (effect,), replace(whole, log_likelihood=whole.log_likelihood - fall))
        for name, fall in behind.items()
    }
    drop_curves(hypotheses)
    light = {name for name, hypothesis in hypotheses.items() if not hypothesis.fit.trials}
    assert light == (set() if points else {"second", "third"})
    assert hypotheses["third"].delta_chi2 == pytest.approx(-1200.0)
