"""Noise, doubts and misfit are told from missing effects; refits find an effect from a start that misses by far."""

import math
from dataclasses import replace
from pathlib import Path

import grown as campaigns
import numpy as np
import pytest
from grown import Pairs, hidden, pairs_of, tubes

import vinetrack as vt
from vinetrack.core.records import Track, Trial, plain_track
from vinetrack.diagnosis import ladder, selection
from vinetrack.diagnosis import misfit_tests as questions
from vinetrack.diagnosis.selection import slack_fit
from vinetrack.effects import Parameter
from vinetrack.experiment.schema import with_names
from vinetrack.inference import systematics
from vinetrack.inference.fit_result import EXPONENT
from vinetrack.inference.optimiser import relative_residuals
from vinetrack.laboratory.campaigns import campaign, damping_values, isometric_vine

FIRST, LATER = questions.FALSE_ALARM_LEVEL_FIRST_ROUND, questions.FALSE_ALARM_LEVEL_LATER_ROUNDS
DRAG, INLET = "air_drag.C_D", "inlet_loss.K"
TRUE_INLET = 1.0
B = "eversion_damping.B"
LATCH, OFF = ({"latch_release.F": F, "latch_release.reach": reach} for F, reach in ((0.6, 0.015), (0.3, 0.01)))
HIDDEN = {"pressure_damping": ({"pressure_damping.beta": 1.5e-5}, {}), "latch_release": (LATCH, OFF)}
P_S_TRUE = 11e3


def careful(payload_g: float, seed: int) -> Pairs:
    """Twenty-four trials of two vines that scatter by a tenth of a per cent, half of them with a payload."""
    loads = [(f"{trial.name}_{load:g}g", load, trial) for load in (0.0, payload_g) for trial in tubes()]
    trials = [replace(trial, name=name, payload_kg=1e-3 * load) for name, load, trial in loads]
    care = {"damping_scatter": 1e-3, "pressure_scatter": 1e-3, "yield_error_kPa": 0.05, "noise_m": 2e-5}
    return pairs_of(campaigns.grown(trials, seed, **care))


def questioned(pairs: Pairs, model: vt.Model, level: float = FIRST):
    candidates = ladder.candidates_of(model, None, None)
    found = vt.fit(model, pairs, host=ladder.host_for(model, candidates))
    return questions.misfit_tests(found, questions.testable(candidates, found.predictor.data)[0], level)


def misweighed() -> Pairs:
    return [(replace(trial, payload_kg=trial.payload_kg / 1.01), track) for trial, track in careful(60.0, 8)]


def seen_crookedly() -> Pairs:
    made = []
    for trial, track in careful(0.0, 9):
        y = track.lead_position_m
        bent_m, sigma_m = y + 2e-5 * np.cos(2 * np.pi * (y - y[0]) / 0.28), np.full(y.size, 2e-5)
        stated = replace(track, lead_position_m=bent_m, lead_position_sigma_m=sigma_m)
        made.append((replace(trial, video=Path("filmed.mp4")), stated))
    return made


@pytest.mark.slow
@pytest.mark.parametrize("make", [misweighed, seen_crookedly])
def test_a_doubt_shared_by_trials_is_no_missing_effect_unless_it_is_left_out(make, monkeypatch):
    def none(solution) -> systematics.Systematics:
        return systematics.systematics_of(solution, ())

    asked = questioned(make(), vt.base_model())
    assert not asked.rejects_model
    monkeypatch.setattr(questions, "systematics_of", none)
    assert questions.misfit_tests(asked.fit, asked.effects, FIRST).rejects_model


def test_levers_say_how_far_a_refit_with_the_other_effect_moves_the_size_and_what_nobody_can_exclude_is_named():
    """Of the model with the inlet loss alone, held against all other effects, fitted to trials that have drag too: of
    two tubes through connectors a third as wide, where air slows down as drag would slow the vine.
    """
    trials = [replace(trial, inlet_m=0.33 * trial.diameter_m) for trial in tubes()]
    care = {"damping_scatter": 5e-3, "pressure_scatter": 1e-3, "yield_error_kPa": 0.05, "noise_m": 3e-5}
    both_act = campaigns.grown(trials, 31, ["inlet_loss", "air_drag"], {INLET: TRUE_INLET, DRAG: 1.2}, **care)
    after = questioned(pairs_of(both_act), vt.base_model() + vt.effects.inlet_loss, LATER)
    place = after.ranked_shapes("air_drag")[0]
    k = next(k for k, number in enumerate(after.fit.numbers) if number.key == INLET)
    lever = float(after.scores.levers[k, place]) * after.fit.predictor.layout.free[k].derivative(after.fit[INLET].value)
    drag = 0.2
    model = (after.fit.model + vt.effects.air_drag).with_values({DRAG: drag})
    with_drag = vt.fit(model, after.fit.pairs, fixed=[DRAG])
    fell = after.fit[INLET].value - with_drag[INLET].value
    # First order in C_D; spreads and noise are estimated anew in the refit.
    assert fell == pytest.approx(lever * drag, rel=0.1)
    # The wider interval holds the truth.
    found = selection.confounders_of(after)
    by_effect, of_n = ({one.effect: one for one in found if one.parameter == key} for key in (INLET, EXPONENT))
    # Linear damping takes the same sign of the force, fold inertia the other: found in refits with either held.
    linear, fold = by_effect["linear_damping"], by_effect["fold_inertia"]
    number = after.fit[INLET]
    assert linear.low_95 < number.low
    assert fold.high_95 > number.high
    for one in by_effect.values():
        assert one.low_95 <= number.low < TRUE_INLET < number.high <= one.high_95
    assert {one.parameter for one in found} == {INLET, EXPONENT, "eversion_damping.B"}
    # Of the base model n and B, which a gauge that is off would move too.
    n, by_gauge = after.fit[EXPONENT], of_n["pressure_gauge"]
    assert by_gauge.low_95 < n.low < n.high < by_gauge.high_95


@pytest.mark.parametrize(
    ("estimate", "plausible", "ends"),
    [
        (0.3, (0.0, 2.0), (0.0, 0.7)),
        (1.9, (0.0, 2.0), (1.5, 2.0)),
        (-0.9, (0.0, 2.0), (0.0, 0.0)),
        (-0.3, (-1.0, 1.0), (-0.7, 0.1)),
    ],
    ids=["near none", "near the end of its range", "of a sign that it cannot have", "of either sign"],
)
def test_a_size_is_not_excluded_within_two_errors_its_plausible_range_and_its_sign(estimate, plausible, ends):
    bounds = (-math.inf if plausible[0] < 0 else 0.0, math.inf)
    parameter = Parameter("C", "C", "1", 0.0, bounds=bounds, plausible=plausible)
    assert selection.sizes_not_excluded(estimate, 0.2, parameter) == pytest.approx(ends)


def fitted(pairs: Pairs):
    return vt.fit(vt.base_model(), pairs)


def of_another_film(factors: dict[float, float], scatter: float = 0.02, trials=()) -> Pairs:
    """Trials whose B is another at some of the pressures, kPa, alike in replicates but for some scatter."""
    pairs: Pairs = []
    for k, trial in enumerate(trials or tubes()):
        factor = factors.get(round(trial.pressure_Pa / 1e3), 1.0)
        sizes = {B: {vine: factor * size for vine, size in damping_values([trial])[B].items()}}
        more = {"damping_scatter": scatter, "pressure_scatter": 5e-3, "yield_error_kPa": 0.1, "noise_correlation": 0.3}
        pairs += pairs_of(campaigns.grown([trial], 40 + k, (), sizes, **more))
    return pairs


def test_replicates_that_deviate_together_are_seen():
    assert questions.between_conditions_p(fitted(of_another_film({20: 1.5, 22: 0.6}))) < 1e-5


def test_a_scatter_that_replicates_have_too_is_none_of_the_model():
    """Tubes of which no two are alike scatter as a model does that bends each trial, but not by condition."""
    trials = with_names(campaign(isometric_vine(4), (14, 17, 20, 24, 28, 33), 2, prefix="a"))
    loose = fitted(of_another_film({}, 0.08, trials))
    bent = fitted(of_another_film({17: 0.6, 24: 1.5}, 0.02, trials))
    assert min(loose.state.spread[1], bent.state.spread[1]) > questions.CAREFUL_DAMPING_SCATTER
    assert not questions.has_excess_scatter(loose)
    assert questions.has_excess_scatter(bent)


@pytest.mark.parametrize("replicate", [0, 1])
def test_without_replicates_a_scatter_may_be_that_of_the_model(replicate):
    fit = fitted(of_another_film({}, 0.08)[replicate::2])
    assert len({trial.trial.condition for trial in fit.trials}) == len(fit.trials)
    assert fit.state.spread[1] > questions.CAREFUL_DAMPING_SCATTER
    assert questions.has_excess_scatter(fit)


def test_of_many_replicates_a_difference_that_care_allows_is_none_of_the_model():
    """Two in a hundred between conditions are significant among fifty replicates each, and no reason to search."""
    fit = fitted(of_another_film({}, 0.08, with_names(campaign(isometric_vine(4), (14, 17, 20, 24, 28, 33), 2))))
    draw = np.random.default_rng(20750)
    trials = [
        replace(trial, damping_deviation=float(np.expm1(0.05 * draw.standard_normal() + 0.02 * (-1) ** (k % 12 // 2))))
        for k, trial in enumerate(50 * fit.trials)
    ]
    assert not questions.has_excess_scatter(replace(fit, trials=tuple(trials)))


@pytest.mark.slow
@pytest.mark.parametrize("name", HIDDEN)
def test_a_hidden_effect_is_found_from_where_the_model_without_it_ended(name):
    values, start = HIDDEN[name]
    base = vt.fit(vt.base_model(), hidden(values, seed=31))
    found = vt.refit(base, base.model + getattr(vt.effects, name), start=start)
    assert found.log_likelihood > base.log_likelihood + 10
    assert found.chi2_per_dof < 1.3
    for key, size in values.items():
        assert abs(found[key].value - size) < 4 * found[key].sigma


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
    fit = vt.fit(vt.base_model(), hidden({"tail_friction.mu_w": 1.0}, seed=7270))
    light = selection.without_curves(fit)
    of_light, of_fit = (relative_residuals(one.solution) for one in (light, fit))
    again = selection.with_curves(light)
    assert (of_light.tolist(), light.trials) == (of_fit.tolist(), ())
    assert (again.numbers, again.log_likelihood) == (fit.numbers, fit.log_likelihood)
    for trial, before in zip(again.trials, fit.trials, strict=True):
        assert np.array_equal(trial.residual_m, before.residual_m)
        assert np.array_equal(trial.predicted_velocity_m_s, before.predicted_velocity_m_s)


def grown_with_tail(payload_g: float, tail_slack: str, angle_rad: float = 0.0) -> Pairs:
    """Trials of two vines, grown with a tail that may go slack or not, stated as taut."""
    told = {"growth_angle_rad": angle_rad, "tail_slack": tail_slack, "payload_kg": 1e-3 * payload_g}
    trials = [replace(one, **told) for one in tubes()]
    pairs = pairs_of(campaigns.grown(trials, 4, noise_m=5e-5))
    return [(replace(trial, tail_slack="taut"), track) for trial, track in pairs]


@pytest.mark.slow
def test_a_slack_tail_is_found_where_the_model_has_it_push_or_has_bent_its_trials_until_none_pushes():
    found = vt.fit(vt.base_model(), grown_with_tail(60.0, "free"))
    slack = slack_fit(found, print)
    assert slack.names == ("tail_slack",)
    assert slack.sigma > 5
    assert all(trial.trial.tail_slack == "free" for trial in slack.fit.trials)
    assert all(trial.trial.tail_slack == "taut" for trial in found.trials)
    # As a fit looks that has taken the slack for scatter: no tail pushes, and pressures deviate by their most.
    state = replace(found.solution.state, spread=(0.04, 0.15))
    assert slack_fit(replace(found, solution=replace(found.solution, state=state)), print).sigma > 5


def test_a_bare_vine_on_the_level_pulls_its_tail():
    assert slack_fit(vt.fit(vt.base_model(), grown_with_tail(0.0, "taut", np.pi / 2)), print) is None


@pytest.mark.slow
def test_a_model_that_misses_one_trial_by_far_is_not_adequate():
    """One of six tracks has its times in milliseconds; the median trial is near the model."""
    trials = campaign(isometric_vine(4), (24, 36, 48), 2)
    pairs = pairs_of(campaigns.grown(trials, 3, values=damping_values(trials)))
    trial, track = pairs[0]
    pairs[0] = (trial, replace(track, time_s=1e3 * track.time_s))
    diagnosis = vt.diagnose(vt.fit(vt.base_model(), pairs), advice=False)
    assert diagnosis.verdict != "adequate"
    assert [note.facts["names"] for note in diagnosis.notes if note.code == "far_off"] == [[trial.name]]


def test_a_diagnosis_names_the_trials_of_the_sheet_that_it_could_not_use(monkeypatch):
    pairs, why = pairs_of(campaigns.grown(campaigns.sheet(), 301)), "its trace has another clock"
    monkeypatch.setattr("vinetrack.diagnosis.diagnose.pairs_of", lambda *_: (pairs, {"gone": why}))
    said = vt.diagnose(pairs, candidates=("tail_friction",), ladder=False, advice=False)
    assert [(note.facts["names"], note.facts["reason"]) for note in said.notes] == [(["gone"], why)]
