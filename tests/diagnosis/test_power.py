"""Power of trials: detectable sizes, confusion of effects, rates of simulated campaigns."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

import vinetrack as vt
from vinetrack.core.records import Trial
from vinetrack.diagnosis import linear_power
from vinetrack.diagnosis.campaign_power import (
    CampaignDesign,
    SimulatedDiagnosis,
    design_of_fit,
    planned_tests,
    rates_of,
    simulated_diagnosis,
)
from vinetrack.diagnosis.linear_power import (
    NoiselessStart,
    effect_power,
    error_inflation,
    fitted_without,
    half_power_below,
    noiseless_start,
    power_of,
    residual_displacements,
    score_ratio,
)
from vinetrack.diagnosis.misfit_tests import FALSE_ALARM_LEVEL_FIRST_ROUND, MisfitTests
from vinetrack.diagnosis.power import PROBABILITIES, EffectPower, Power, Rate
from vinetrack.diagnosis.remarks import remark
from vinetrack.diagnosis.result import Diagnosis, Round
from vinetrack.diagnosis.score_test import fit_columns, informations_at, scores_of
from vinetrack.inference import sensitivity
from vinetrack.narrative.power_text import effect_sentence, unseen
from vinetrack.planning.simulated_campaigns import FilmingPlan

CAMERA = FilmingPlan(500.0, 1e-4)
CANDIDATES = ("air_drag", "area_scale", "leak", "length_scale", "pressure_gain", "tail_friction", "static_yield")


def planned(replicates: int, spreads: tuple[float, float] = (0.01, 0.03)) -> CampaignDesign:
    """Three pressures of one vine, with so many replicates each."""
    trials: list[Trial] = []
    for pressure in ("14", "24", "34"):
        texts = {"diameter_mm": "24", "thickness_um": "200", "length_mm": "200", "pressure_kPa": pressure}
        trial = vt.planned_trial({**texts, "yield_pressure_kPa": "3"}).trials[0]
        trials += [replace(trial, name=f"P{pressure}_{k}", position_systematic_m=0.0) for k in range(replicates)]
    count = len(trials)
    model = vt.predictive_inputs(trials[0]).model
    return CampaignDesign(
        model, tuple(trials), (CAMERA,) * count, spreads, (math.nan,) * count, (False,) * count, CANDIDATES
    )


@pytest.fixture(scope="module")
def six() -> MisfitTests:
    return planned_tests(planned(2))[0]


@pytest.fixture(scope="module")
def power(six: MisfitTests) -> Power:
    return power_of(six, {"payload_drag": remark("column_blank", column="payload_g")})


def place_of(questions: MisfitTests, name: str) -> int:
    return questions.sensitivities.effects.index(name)


def test_a_noise_free_campaign_raises_no_alarm(six: MisfitTests) -> None:
    assert six.one_sided_z.max() < 0.3 * six.family.single_shape_threshold


def test_detectable_sizes_follow_the_normal_distribution(six: MisfitTests, power: Power) -> None:
    # Fewer trials than a scatter can be told from: only the noise model decides.
    sigma = six.scores.plain_sigma[place_of(six, "tail_friction")]
    entry = power["tail_friction"]
    assert (entry.size_at(0.9) - entry.size_at(0.5)) / sigma == pytest.approx(norm.ppf(0.9), abs=0.06)
    assert entry.size_at(0.5) / sigma >= six.family.threshold("tail_friction") - 0.1


def test_estimated_scatter_absorbs_part_of_an_effect(six: MisfitTests) -> None:
    held = error_inflation(six)
    assert held[0] == pytest.approx(np.ones(held.shape[1]))
    many = planned_tests(planned(4))[0]
    widening = error_inflation(many)
    assert widening.max() > 1.2
    assert np.all(np.diff(widening, axis=0) > -1e-9)


def test_information_at_other_standard_deviations_is_that_of_the_scores_there() -> None:
    many = planned_tests(planned(4))[0]
    ways = [(0.002, 0.01), (0.01, 0.03), (0.03, 0.09)]
    direct = [scores_of(many.fit, many.products, replace(many.fit.state, spread=way)).information for way in ways]
    assert informations_at(many.fit, many.products, ways) == pytest.approx(np.array([np.diag(one) for one in direct]))


def test_four_times_the_trials_halve_the_detectable_size(power: Power) -> None:
    # Where scatter of trials alone is in the way, and positions are known as good as exactly.
    few = power_of(planned_tests(planned(4))[0])["leak"].size_at(0.5)
    many = power_of(planned_tests(planned(16))[0])["leak"].size_at(0.5)
    assert few / many == pytest.approx(2.0, rel=0.25)
    assert power["leak"].size_at(0.5) > few


def test_more_scatter_raises_detectable_sizes() -> None:
    calm = power_of(planned_tests(planned(3, (0.002, 0.006)))[0])
    usual = power_of(planned_tests(planned(3))[0])
    assert usual["pressure_gain"].size_at(0.9) > 1.5 * calm["pressure_gain"].size_at(0.9)


def test_two_equivalent_effects_are_confused_with_each_other() -> None:
    # A diameter and a pressure that are off by a part act alike but for the film's mass.
    power = power_of(planned_tests(replace(planned(2), candidates=("area_scale", "pressure_gain")))[0])
    assert "pressure_gain" in power["area_scale"].taken_for
    assert "area_scale" in power["pressure_gain"].taken_for


def test_an_effect_too_weak_for_these_trials_is_not_visible(power: Power) -> None:
    assert not power["air_drag"].is_visible
    assert power["leak"].is_visible


def test_untestable_effects_are_listed_with_a_reason(power: Power) -> None:
    assert set(power.not_testable) == {"payload_drag", "static_yield"}


def test_false_alarms_add_up_over_the_tests(power: Power) -> None:
    assert FALSE_ALARM_LEVEL_FIRST_ROUND < power.false_alarm_rate < 2 * FALSE_ALARM_LEVEL_FIRST_ROUND


def test_a_sheet_with_days_has_one_more_test() -> None:
    design = planned(2)
    dated = replace(design, trials=tuple(replace(trial, day=trial.name[-1]) for trial in design.trials))
    rates = power_of(planned_tests(dated)[0]).false_alarms
    assert rates["specimens, days or the order of trials"] == FALSE_ALARM_LEVEL_FIRST_ROUND


def test_a_small_effect_has_the_score_of_linear_theory(six: MisfitTests, power: Power) -> None:
    k = place_of(six, "leak")
    assert score_ratio(six, k, 0.3 * power["leak"].size_at(0.5), noiseless_start(six.fit)) == pytest.approx(
        1.0, abs=0.03
    )


def test_residual_displacements_equal_those_of_a_refit_without_the_effect(six: MisfitTests, power: Power) -> None:
    k, size = place_of(six, "leak"), 0.5 * power["leak"].size_at(0.5)
    moved_m = size * residual_displacements(six.fit, six.products)[k]
    after = fitted_without(six.fit, six.sensitivities.shapes[k], size, noiseless_start(six.fit))
    left = [block[:, -1] for block in after.solution.columns]
    assert moved_m == pytest.approx(np.sqrt(np.mean([np.max(np.abs(r)) ** 2 for r in left])), rel=0.1)


@pytest.mark.parametrize("name", ["air_drag", "leak", "tail_friction"])
def test_a_fit_without_an_effect_ends_with_the_columns_for_its_scores(
    six: MisfitTests, power: Power, name: str
) -> None:
    # No point lies near the end of growth, where `fit_columns` takes derivatives otherwise.
    start, k = noiseless_start(six.fit), place_of(six, name)
    after = fitted_without(six.fit, six.sensitivities.shapes[k], power[name].size_at(0.5), start)
    for mine, other in zip(after.solution.columns, fit_columns(after), strict=True):
        scale = np.max(np.abs(other[:, :-1]), axis=0)
        assert mine[:, :-1] / scale == pytest.approx(other[:, :-1] / scale, abs=2e-3)
        assert mine[:, -1] == pytest.approx(other[:, -1], abs=1e-9)


def test_a_fit_without_an_effect_that_does_not_converge_is_not_used(
    six: MisfitTests, power: Power, monkeypatch: pytest.MonkeyPatch
) -> None:
    start, k = noiseless_start(six.fit), place_of(six, "leak")
    size = 2 * power["leak"].size_at(0.5)
    assert score_ratio(six, k, size, start) != 1.0
    monkeypatch.setattr(linear_power, "MAX_ITERATIONS", 1)
    assert score_ratio(six, k, size, start) == 1.0


def test_noise_free_replicates_are_simulated_once(six: MisfitTests, monkeypatch: pytest.MonkeyPatch) -> None:
    predictor, state = six.fit.predictor, six.fit.solution.state
    assert predictor.identical_trials.tolist() == [0, 0, 2, 2, 4, 4]
    counted: list[int] = []
    laid_out = sensitivity.lay_out
    monkeypatch.setattr(
        sensitivity,
        "lay_out",
        lambda model, rigs, *of, **how: counted.append(len(rigs)) or laid_out(model, rigs, *of, **how),
    )
    jobs = predictor.jobs(state.theta, state.trial_effects)
    once = predictor.run(jobs)
    predictor.run([job._replace(release_s=job.release_s + 1e-6 * k) for k, job in enumerate(jobs)])
    assert counted == [3, 6]
    for job, shared in zip(jobs, once, strict=True):
        alone = predictor.run([job])[0]
        assert np.array_equal(shared.observed_position_m, alone.observed_position_m)


def test_a_fit_without_an_effect_starts_with_the_columns_of_its_own_trajectories(
    six: MisfitTests, power: Power
) -> None:
    start, k = noiseless_start(six.fit), place_of(six, "leak")
    after = fitted_without(six.fit, six.sensitivities.shapes[k], power["leak"].size_at(0.5), start)
    begun = after.predictor.linearise(start.state.theta, start.state.trial_effects)
    kept = [
        np.isin(old.time_s, new.time_s) for old, new in zip(six.fit.predictor.data, after.predictor.data, strict=True)
    ]
    for mine, other, keep in zip(start.columns, begun, kept, strict=True):
        scale = np.max(np.abs(other[:, :-1]), axis=0)
        assert mine[keep, :-1] / scale == pytest.approx(other[:, :-1] / scale, abs=2e-3)


def test_a_detection_within_the_systematic_errors_counts_half() -> None:
    sizes = 1 + 0.1 * norm.ppf(PROBABILITIES)
    found = half_power_below(1.12, sizes)
    assert found[PROBABILITIES.index(0.9)] == pytest.approx(sizes[PROBABILITIES.index(0.9)])
    assert found[PROBABILITIES.index(0.4)] == pytest.approx(sizes[PROBABILITIES.index(0.8)])
    assert found[PROBABILITIES.index(0.6)] == pytest.approx(1.12)
    assert half_power_below(0.0, sizes) == pytest.approx(sizes)
    assert half_power_below(1.12, -sizes) == pytest.approx(-found)


def test_further_sizes_are_computed_only_where_the_score_is_nonlinear(
    six: MisfitTests, monkeypatch: pytest.MonkeyPatch
) -> None:
    def followed(ratio_at_7: float, ratio_at_4: float, larger: float = math.nan) -> tuple[int, EffectPower]:
        asked: list[float] = []

        def ratio(_: MisfitTests, __: int, size: float, ___: NoiselessStart) -> float:
            asked.append(abs(size))
            return ratio_at_7 if len(asked) == 1 else ratio_at_4 if len(asked) == 2 else larger

        monkeypatch.setattr(linear_power, "score_ratio", ratio)
        power = effect_power(six, "leak")
        assert power is not None
        assert [7 * size / asked[0] for size in asked] == pytest.approx([7.0, 4.0, 14.0, 28.0, 56.0][: len(asked)])
        return len(asked), power

    calls, straight = followed(1.01, math.nan)
    assert calls == 1
    calls, bent = followed(1.2, 1.1)
    assert calls == 2
    assert 1.01 / 1.2 < bent.size_at(0.5) / straight.size_at(0.5) < 1.01 / 1.1
    calls, wild = followed(5.0, 0.8)
    assert calls == 2
    assert wild.size_at(0.5) == pytest.approx(1.01 * straight.size_at(0.5))
    assert followed(1.0, 1.1)[0] == 2
    # What other numbers fit away is followed until it is seen, or no longer.
    calls, hidden = followed(0.3, 0.2, 0.6)
    assert calls == 3
    assert 7 / 5 < hidden.size_at(0.9) / straight.size_at(0.9) < 14 / 4
    assert followed(0.1, 0.2, 0.05)[0] == 5
    calls, halted = followed(0.3, 0.2, -1.0)
    assert calls == 3
    assert halted.size_at(0.9) == pytest.approx(1.01 / 0.3 * straight.size_at(0.9))


def test_power_is_unchanged_by_writing_and_reading(power: Power) -> None:
    again = Power.from_json(json.loads(json.dumps(power.to_json())))
    assert again == power
    assert again.to_json() == power.to_json()


def test_intervals_of_n_are_those_of_the_fit(six: MisfitTests, power: Power) -> None:
    number = six.fit["n"]
    widths = {width.name: width.half_width for width in power.numbers}
    assert widths["n"] == pytest.approx((number.high - number.low) / 2)
    B = six.fit["B"]
    assert widths["B"] == pytest.approx((B.high - B.low) / 2 / B.value)


def test_a_verdict_comes_with_its_power(power: Power) -> None:
    step = Round(("gravity",), "adequate", (), (), "Nothing is missing.")
    diagnosis = Diagnosis((step,), (), "Nothing is missing.", power=power)
    assert "air_drag" in unseen(power)
    assert power.false_alarm_rate == pytest.approx(0.0042)
    again = Diagnosis.from_json(json.loads(json.dumps(diagnosis.to_json())))
    assert again.power == power


def entry(**changes: object) -> EffectPower:
    sizes = tuple(1 + 0.1 * norm.ppf(PROBABILITIES))
    given = EffectPower("air_drag", "physical", "air_drag.C_D", "C_D", "1", 0.0, 0.0, 3.0, sizes, {"inlet_loss": 0.26})
    return replace(given, **changes)  # type: ignore[arg-type]


def test_probabilities_invert_sizes() -> None:
    for probability in (0.1, 0.5, 0.9):
        assert entry().probability_at(entry().size_at(probability)) == pytest.approx(probability)
    assert (entry().probability_at(0.1), entry().probability_at(3.0)) == (0.0, 1.0)


def test_an_undetectable_size_is_infinite() -> None:
    blind = entry(sizes=(math.inf,) * len(PROBABILITIES))
    assert (blind.size_at(0.5), blind.probability_at(3.0), blind.is_visible) == (math.inf, 0.0, False)


def test_the_sentence_of_an_effect() -> None:
    assert effect_sentence(entry(), 24) == (
        "These 24 trials detect air drag with at least 90 % power above C_D = 1.1, and with less than 10 % below 0.87; "
        "it would be mistaken for inlet loss in 26 % of campaigns."
    )


def test_the_sentence_of_an_effect_that_is_too_weak() -> None:
    text = effect_sentence(entry(largest=0.5), 24)
    assert text == (
        "These 24 trials detect air drag with less than 10 % power even at its largest plausible size, C_D = 0.50."
    )


def test_the_exact_interval_of_a_rate() -> None:
    # Clopper and Pearson's for nine of ten, from the quantiles of the beta distribution.
    assert Rate(9, 10).interval == pytest.approx((0.5550, 0.9975), abs=1e-4)
    assert Rate(0, 0).interval == (0.0, 1.0)


def answer(seed: int, verdict: str, answer_set: tuple[str, ...] = (), **more: object) -> SimulatedDiagnosis:
    return SimulatedDiagnosis("leak", 0.5, seed, verdict, answer_set, **more)  # type: ignore[arg-type]


def test_simulated_diagnoses_are_counted() -> None:
    answers = [
        answer(0, "missing", ("leak",)),
        answer(1, "ambiguous", ("supply_refill", "leak")),
        answer(2, "missing", ("supply_refill",)),
        answer(3, "adequate"),
        answer(4, "", failed="FitError: none"),
    ]
    rates = rates_of(answers, 0.9)
    assert (rates.detections, rates.alarms, rates.failed) == (Rate(2, 4), Rate(3, 4), 1)
    assert rates.to_json()["rate"] == 0.5


def test_a_simulated_campaign_is_diagnosed_with_its_effect() -> None:
    found = simulated_diagnosis(planned(2, (0.002, 0.006)), "leak", 0.02, 3)
    assert found.failed == ""
    assert found.is_found


def test_the_design_of_a_fit_records_as_long_as_its_trials() -> None:
    questions, _ = planned_tests(planned(1))
    design = design_of_fit(questions.fit)
    for camera, trial in zip(design.cameras, questions.fit.trials, strict=True):
        assert camera.stops_s == pytest.approx(trial.time_s[-1] - trial.release_s)
        assert camera.capture_fps == pytest.approx(500.0)
    assert design.spreads == (0.01, 0.03)
