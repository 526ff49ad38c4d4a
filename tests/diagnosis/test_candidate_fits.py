"""A refit finds an effect from a start that misses by far more than noise; rules and thresholds are fitted too."""

from dataclasses import replace
from unittest.mock import Mock

import grown as campaigns
import numpy as np
import pytest
from grown import Pairs, pairs_of
from hidden_truth import grown, sheet

import vinetrack as vt
from vinetrack.core.records import Track, Trial, plain_track
from vinetrack.diagnosis import candidate_fits, ladder
from vinetrack.diagnosis import score_test as hypotheses
from vinetrack.diagnosis.likelihood_ratio import likelihood_ratio
from vinetrack.diagnosis.misfit_tests import FALSE_ALARM_LEVEL_FIRST_ROUND, MisfitTests, misfit_tests
from vinetrack.diagnosis.selection import TAIL_SLACK, SelectionStep, select_effects, slack_fit
from vinetrack.inference.fit_result import YIELD_PRESSURE
from vinetrack.inference.optimiser import relative_residual
from vinetrack.inference.solving import solve_onward

LATCH, OFF = ({"latch_release.F": F, "latch_release.reach": reach} for F, reach in ((0.6, 0.015), (0.3, 0.01)))
HIDDEN = {"pressure_damping": ({"pressure_damping.beta": 1.5e-5}, {}), "latch_release": (LATCH, OFF)}


@pytest.mark.slow
@pytest.mark.parametrize("name", HIDDEN)
def test_a_hidden_effect_is_found_from_where_the_model_without_it_ended(name):
    values, start = HIDDEN[name]
    base = vt.fit(vt.base_model(), grown(values, seed=31), profile=False)
    found = vt.refit(base, base.model + getattr(vt.effects, name), start=start)
    assert found.log_likelihood > base.log_likelihood + 10
    assert found.chi2_per_dof < 1.3
    for key, size in values.items():
        assert abs(found[key].value - size) < 4 * found[key].sigma


@pytest.mark.slow
def test_a_full_fit_begins_at_the_yield_pressures_that_a_part_of_the_trials_found(monkeypatch):
    """A friction at rest beside the yield pressure that was found without it would hold the vine back altogether."""
    base = vt.fit(vt.base_model(), grown({"pressure_damping.beta": 1.5e-5}, seed=33), profile=False)
    start = {"pressure_damping.beta": 1e-5}
    climb = candidate_fits.SubsetFitter(base).fit_hypothesis((vt.effects.pressure_damping,), start, iterations=9)
    yields_Pa = {number.name: number.value for number in base.numbers if number.key == YIELD_PRESSURE}
    assert climb.yields_Pa.keys() == yields_Pa.keys()
    assert any(abs(climb.yields_Pa[name] - value) > 1.0 for name, value in yields_Pa.items())
    watched = Mock(wraps=solve_onward)
    monkeypatch.setattr("vinetrack.inference.fit.solve_onward", watched)
    assert candidate_fits.full_fit(base, climb) is not None
    layout, theta = watched.call_args_list[0].args[0].layout, watched.call_args_list[0].args[2]
    begun = dict(zip((number.name for number in layout.free), layout.values(theta), strict=True))
    assert climb.yields_Pa == pytest.approx({name: begun[name] for name in climb.yields_Pa})


P_S_TRUE = 11e3


def interrupted(k: int, pressure_Pa: float) -> tuple[Trial, Track]:
    """Released at full pressure, which is let down after some growth and comes back slowly."""
    trial = Trial(
        name=f"stop{k}", capture_fps=200.0, diameter_m=0.024, thickness_m=2e-4, length_m=0.9, pressure_Pa=pressure_Pa,
        pressure_sigma_Pa=1e-2 * pressure_Pa, yield_pressure_Pa=6e3, yield_pressure_sigma_Pa=200.0,
        growth_angle_rad=np.pi / 2,
    )  # fmt: skip
    time_s, stop_s = np.linspace(-0.05, 0.9, 191), 0.12 + 0.02 * k
    let_down = [pressure_Pa, 2e3, 2e3, pressure_Pa]
    trace = np.interp(time_s, [stop_s, stop_s + 0.02, stop_s + 0.1, stop_s + 0.5], let_down)
    values = {"eversion_damping.B": 6.0, "eversion_damping.n": 0.4, "static_yield.P_s": P_S_TRUE}
    truth = (vt.base_model() + vt.effects.static_yield).with_values(values)
    y = vt.simulate(truth, trial, time_s, trace=(time_s, trace)).lead_position_m
    noise_m = 1e-4 * np.random.default_rng(70 + k).standard_normal(time_s.size)
    return trial, plain_track(time_s, y + noise_m, pressure_Pa=trace)


@pytest.mark.slow
def test_a_static_yield_far_above_the_yield_pressure_is_found():
    pairs = [interrupted(k, pressure_Pa) for k, pressure_Pa in enumerate((14e3, 14e3, 18e3, 18e3, 22e3, 22e3))]
    asked = ("static_yield", "tail_friction", "air_drag")
    said = vt.diagnose(pairs, candidates=asked, ladder=False, advice=False)
    assert said.verdict == "missing"
    assert said.effects == ("static_yield",)
    assert abs(said.fits[-1]["P_s"].value - P_S_TRUE) < 100.0


def test_a_fit_is_the_same_once_its_curves_are_made_again():
    """Of trials whose tail rubs. Of many trials a search lets go of curves."""
    model, pairs = vt.base_model(), grown({"tail_friction.mu_w": 1.0}, seed=7270)
    fit = ladder.initial_fit(model, pairs, ladder.candidates_of(model, ["tail_friction"]), profile=False)
    light = candidate_fits.without_curves(fit)
    assert not light.trials
    assert relative_residual(light.predictor, light.solution) == relative_residual(fit.predictor, fit.solution)
    steps = fit.predictor.steps.copy()
    again = candidate_fits.with_curves(light)
    assert np.array_equal(fit.predictor.steps, steps)
    assert (again.numbers, again.log_likelihood) == (fit.numbers, fit.log_likelihood)
    for trial, before_trial in zip(again.trials, fit.trials, strict=True):
        assert np.array_equal(trial.residual_m, before_trial.residual_m)
        assert np.array_equal(trial.predicted_velocity_m_s, before_trial.predicted_velocity_m_s)
    # Steps of differences differ, and with them the one frame in which growth ends.
    for columns, before_columns in zip(again.solution.columns, fit.solution.columns, strict=True):
        apart, whole = (np.linalg.norm(each, axis=0) for each in (columns - before_columns, before_columns))
        assert np.all(apart <= 0.02 * whole)


def grown_with_tail(payload_g: float, tail_slack: str, angle_rad: float = 0.0) -> Pairs:
    """Trials of two vines, grown with a tail that may go slack or not, stated as taut."""
    told = {"growth_angle_rad": angle_rad, "tail_slack": tail_slack, "payload_kg": 1e-3 * payload_g}
    trials = [replace(one, **told) for one in sheet()]
    pairs = pairs_of(campaigns.grown(trials, 4, noise_m=5e-5))
    return [(replace(trial, tail_slack="taut"), track) for trial, track in pairs]


@pytest.mark.slow
def test_a_slack_tail_is_found_where_the_model_has_it_push_or_has_bent_its_trials_until_none_pushes():
    found = vt.fit(vt.base_model(), grown_with_tail(60.0, "free"), profile=False)
    slack = slack_fit(found)
    assert slack.names == ("tail_slack",)
    assert slack.sigma > 5
    assert all(trial.trial.tail_slack == "free" for trial in slack.fit.trials)
    assert all(trial.trial.tail_slack == "taut" for trial in found.trials)
    # As a fit looks that has taken the slack for scatter: no tail pushes, and pressures deviate by their most.
    state = replace(found.solution.state, spread=(0.04, 0.15))
    assert slack_fit(replace(found, solution=replace(found.solution, state=state))).sigma > 5


def test_a_bare_vine_on_the_level_pulls_its_tail():
    assert slack_fit(vt.fit(vt.base_model(), grown_with_tail(0.0, "taut", np.pi / 2), profile=False)) is None


@pytest.mark.slow
@pytest.mark.parametrize("suspect", [False, True])
def test_a_rule_that_leaves_a_suspect_fit_stands_only_where_no_effect_does_better(monkeypatch, *, suspect):
    trials = [replace(one, growth_angle_rad=np.pi / 2) for one in sheet()]
    virtual = campaigns.grown(trials, 6, ["tail_friction"], {"tail_friction.mu_w": 0.04}, noise_m=5e-5)
    found = vt.fit(vt.base_model(), pairs_of(virtual), profile=False)
    effects, _ = hypotheses.testable(ladder.candidates_of(found.model, ["tail_friction"], None), found.predictor.data)
    questions = misfit_tests(found, effects, FALSE_ALARM_LEVEL_FIRST_ROUND)
    assert questions.rejects_model
    assert not questions.far_off
    slack = likelihood_ratio(found, (TAIL_SLACK,), found)
    monkeypatch.setattr(MisfitTests, "needs_search", suspect)
    said = SelectionStep("missing", questions, (slack,), (slack,), (), slack.names)
    steps = [said, SelectionStep("adequate", questions)]
    monkeypatch.setattr("vinetrack.diagnosis.selection._slack_rounds", lambda *_: steps)
    named = select_effects(found, effects, lambda _: None)[0].answer_names
    assert named == (("tail_friction",) if suspect else ("tail_slack",))
