"""A tail that goes slack under a model whose tail pushes is named."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hidden_truth import Pairs, sheet

import vinetrack as vt
from vinetrack.diagnosis import candidates as hypotheses
from vinetrack.diagnosis.ladder import candidates_of
from vinetrack.diagnosis.likelihood_ratio import likelihood_ratio
from vinetrack.diagnosis.misfit_tests import FALSE_ALARM_LEVEL_FIRST_ROUND, MisfitTests, misfit_tests
from vinetrack.diagnosis.selection import TAIL_SLACK, SelectionStep, pushes, select_effects, slack_fit
from vinetrack.inference.fit import fit
from vinetrack.laboratory.tracks import BASE, GroundTruth, damping_values, grow


def grown(payload_g: float, tail_slack: str, angle_rad: float = 0.0) -> Pairs:
    """Trials of two vines, grown with a tail that may go slack or not, stated as taut."""
    sheets = [replace(one, growth_angle_rad=angle_rad, tail_slack=tail_slack) for one in sheet()]
    trials = [replace(one, payload_kg=1e-3 * payload_g) for one in sheets]
    nature = GroundTruth(effects=BASE, values=damping_values(trials), noise_m=5e-5, seed=4)
    return [(replace(one.stated, tail_slack="taut"), one.track) for one in grow(trials, nature)]


def test_a_slack_tail_is_found_where_the_model_has_it_push():
    found = fit(vt.base_model(), grown(60.0, "free"), profile=False)
    assert pushes(found)
    slack = slack_fit(found)
    assert slack is not None
    assert slack.names == ("tail_slack",)
    assert slack.sigma > 5
    assert all(trial.trial.tail_slack == "free" for trial in slack.fit.trials)
    assert all(trial.trial.tail_slack == "taut" for trial in found.trials)


def test_a_bare_vine_on_the_level_pulls_its_tail():
    found = fit(vt.base_model(), grown(0.0, "taut", np.pi / 2), profile=False)
    assert not pushes(found)
    assert slack_fit(found) is None


def test_a_slack_tail_is_found_where_the_fit_has_bent_its_trials_until_none_pushes(monkeypatch):
    found = fit(vt.base_model(), grown(60.0, "free"), profile=False)
    # As a fit looks that has taken the slack for scatter: no tail pushes, and pressures deviate by their most.
    bent = replace(found, solution=replace(found.solution, state=replace(found.solution.state, spread=(0.04, 0.15))))
    monkeypatch.setattr("vinetrack.diagnosis.selection.pushes", lambda _: False)
    slack = slack_fit(bent)
    assert slack is not None
    assert slack.sigma > 5


def test_where_the_rule_makes_scattering_trials_far_worse_none_is_fitted_in_full(monkeypatch: pytest.MonkeyPatch):
    """A payload that the true tail pushes, which a tail that cannot push never does."""
    taut = fit(vt.base_model(), grown(60.0, "taut"), profile=False)
    asked: list[object] = []
    monkeypatch.setattr("vinetrack.diagnosis.selection.has_excess_scatter", lambda _: True)
    for name in ("refit", "full_fit"):
        monkeypatch.setattr(f"vinetrack.diagnosis.selection.{name}", lambda *given, **_: asked.append(given))
    assert pushes(taut)
    assert slack_fit(taut) is None
    assert not asked


@pytest.mark.parametrize("suspect", [False, True])
def test_a_rule_that_leaves_a_suspect_fit_stands_only_where_no_effect_does_better(
    monkeypatch: pytest.MonkeyPatch, *, suspect: bool
) -> None:
    truth = {"tail_friction.mu_w": 0.04}
    trials = [replace(one, growth_angle_rad=np.pi / 2) for one in sheet()]
    nature = GroundTruth(effects=[*BASE, "tail_friction"], values=damping_values(trials) | truth, noise_m=5e-5, seed=6)
    found = fit(vt.base_model(), [(one.stated, one.track) for one in grow(trials, nature)], profile=False)
    effects, _ = hypotheses.testable(candidates_of(found.model, ["tail_friction"], None), found.predictor.data)
    questions = misfit_tests(found, effects, FALSE_ALARM_LEVEL_FIRST_ROUND)
    assert questions.rejects_model
    assert not questions.far_off
    slack = likelihood_ratio(found, (TAIL_SLACK,), found)
    monkeypatch.setattr(MisfitTests, "needs_search", suspect)
    steps = [
        SelectionStep("missing", questions, (slack,), (slack,), (), slack.names),
        SelectionStep("adequate", questions),
    ]
    monkeypatch.setattr("vinetrack.diagnosis.selection._slack_rounds", lambda *_: steps)
    named = select_effects(found, effects, lambda _: None)[0].answer_names
    assert named == (("tail_friction",) if suspect else ("tail_slack",))
