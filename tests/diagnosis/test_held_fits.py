"""Of many trials a search lets go of curves; what it says does not depend on it."""

from __future__ import annotations

import numpy as np
import pytest
from hidden_truth import Pairs, grown

import vinetrack as vt
from vinetrack.diagnosis import held_fits
from vinetrack.diagnosis.held_fits import with_curves, without_curves
from vinetrack.diagnosis.initial_fit import candidates_of, initial_fit
from vinetrack.inference.fit_result import Fit
from vinetrack.inference.solving import missed_fraction

CANDIDATES = ("reservoir_depletion", "tail_friction", "latch_release", "leak", "pressure_gain")


@pytest.fixture(scope="module")
def rubbing() -> Pairs:
    """Trials whose tail rubs beside a chamber that is drained."""
    return grown({"reservoir_depletion.gamma": 1.3, "tail_friction.mu_w": 1.0}, seed=7270)


def test_a_fit_is_the_same_once_its_curves_are_made_again(rubbing: Pairs) -> None:
    fit = initial_fit(vt.base_model(), rubbing, candidates_of(vt.base_model(), CANDIDATES), profile=False)
    light = without_curves(fit)
    assert not light.trials
    assert missed_fraction(light.predictor, light.solution) == missed_fraction(fit.predictor, fit.solution)
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


def test_a_diagnosis_that_lets_go_of_curves_says_the_same(rubbing: Pairs, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = vt.diagnose(rubbing, candidates=CANDIDATES, ladder=False, advice=False)
    let_go: list[Fit] = []

    def counted(fit: Fit) -> Fit:
        let_go.append(fit)
        return without_curves(fit)

    monkeypatch.setattr(held_fits, "MANY_POINTS", 0)
    monkeypatch.setattr(held_fits, "FITS_HELD", 1)
    monkeypatch.setattr("vinetrack.diagnosis.candidate_fits.TESTS_HELD", 1)
    monkeypatch.setattr(held_fits, "without_curves", counted)
    light = vt.diagnose(rubbing, candidates=CANDIDATES, ladder=False, advice=False)
    assert let_go
    assert len(light.effects) == 2
    assert (light.verdict, light.answer_set, light.effects) == (whole.verdict, whole.answer_set, whole.effects)
    for number, before in zip(light.fits[-1].numbers, whole.fits[-1].numbers, strict=True):
        assert abs(number.value - before.value) < 1e-2 * before.sigma
