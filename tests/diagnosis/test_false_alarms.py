"""How often scores cry wolf, and what they hear: linear campaigns whose scores have a known distribution.

Each trial tells of every shape by an information matrix of its own, and its score is normal with that covariance, times
the square of `scatter`: what the model of the noise knows nothing of. Seeds 20600 and up, which tuned nothing.
"""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import vinetrack as vt
from vinetrack.core.records import Floats
from vinetrack.diagnosis import misfit_tests
from vinetrack.diagnosis.candidates import CandidateShape, EffectSensitivities
from vinetrack.diagnosis.likelihood_ratio import LikelihoodRatio, answer_set, likelihood_ratio, weights_of
from vinetrack.diagnosis.misfit_tests import (
    FALSE_ALARM_LEVEL_FIRST_ROUND,
    FALSE_ALARM_LEVEL_LATER_ROUNDS,
    SINGLE_PROBE_LEVEL,
    MisfitTests,
    Structure,
    structure_from_scores,
)
from vinetrack.diagnosis.score_test import Scores, _marginalisation, _marginalised
from vinetrack.inference.fit_result import Number

QUIET = Structure(0.0, 0, 1.0, 0.0)


def scores(draw: np.random.Generator, trials: int, shapes: int, scatter: float = 1.0, sizes: Any = 0.0) -> Scores:
    """What a linear campaign says of shapes of true `sizes`."""
    root = draw.standard_normal((trials, 3 * shapes, shapes)) / math.sqrt(3 * shapes)
    informations = np.einsum("nkj,nkl->njl", root, root)
    noise = scatter * np.einsum("nkj,nk->nj", root, draw.standard_normal((trials, 3 * shapes)))
    single = noise + informations @ np.broadcast_to(sizes, (shapes,))
    return Scores(single.sum(axis=0), informations.sum(axis=0), single, informations, float(trials - 1))


def questioned(
    of: Scores,
    signs: Any = 0,
    structure: Structure = QUIET,
    level: float = FALSE_ALARM_LEVEL_FIRST_ROUND,
    effects: tuple[str, ...] | None = None,
) -> MisfitTests:
    """The tests of candidates with these scores, each shape another effect where these are not named."""
    signs = np.broadcast_to(signs, of.score.shape).tolist()
    shapes = [SimpleNamespace(effect=SimpleNamespace(parameters=(1,)), size=SimpleNamespace(sign=s)) for s in signs]
    named = effects or tuple(f"effect_{k}" for k in range(len(shapes)))
    answers: Any = SimpleNamespace(shapes=shapes, effects=named)
    fit: Any = None
    return MisfitTests(fit, (), answers, fit, of, structure, level)


@pytest.mark.parametrize("scatter", [1.0, 3.0])
def test_scores_are_as_large_as_they_say_however_much_trials_scatter(scatter: float) -> None:
    draw = np.random.default_rng(20600)
    z = np.concatenate([scores(draw, 20, 4, scatter).z for _ in range(300)])
    assert 0.8 < np.std(z) < 1.15


def test_a_size_explains_its_own_part_of_how_trials_scatter() -> None:
    draw = np.random.default_rng(20601)
    campaigns = [scores(draw, 24, 3, sizes=[8.0, 0.0, 0.0]) for _ in range(100)]
    assert np.median([one.robust_sigma[0] / one.plain_sigma[0] for one in campaigns]) < 1.3
    assert np.median([one.size[0] for one in campaigns]) == pytest.approx(8.0, rel=0.05)


@pytest.mark.parametrize("scatter", [1.0, 3.0])
def test_the_best_of_all_candidates_is_a_false_alarm_in_one_campaign_of_a_hundred_at_most(scatter: float) -> None:
    draw = np.random.default_rng(20602)
    campaigns = [questioned(scores(draw, 12, 4, scatter)) for _ in range(2000)]
    # Their cosines are all near 0: one family of thresholds serves them all.
    alarms = sum(asked.largest_excess(campaigns[0].family) > 0 for asked in campaigns)
    assert alarms <= 20


def test_a_candidate_of_many_shapes_is_no_more_often_a_false_alarm_than_all_should_be_together() -> None:
    draw = np.random.default_rng(20604)
    named = ("of_many",) * 20 + ("of_one",)
    campaigns = [questioned(scores(draw, 24, 21), level=0.02, effects=named) for _ in range(500)]
    alarms = sum(asked.largest_excess(campaigns[0].family) > 0 for asked in campaigns)
    assert alarms <= 18  # of 500 at 2 %, more once in 100


def test_a_candidate_of_seven_standard_errors_is_found() -> None:
    draw = np.random.default_rng(20603)
    found = 0
    for _ in range(40):
        asked = questioned(scores(draw, 24, 4, sizes=[7 / math.sqrt(24), 0, 0, 0]))
        found += bool(asked.one_sided_z[0] > asked.family.threshold("effect_0"))
    assert found >= 36


@pytest.mark.parametrize("scatter", [1.0, 3.0])
def test_probes_of_nothing_find_structure_as_often_as_they_say(scatter: float) -> None:
    draw = np.random.default_rng(20604)
    found = [structure_from_scores(scores(draw, 24, 8, scatter)) for _ in range(400)]
    assert np.mean([one.p < 0.05 for one in found]) < 0.09
    assert np.mean([one.smallest_probe_p < 0.05 for one in found]) < 0.08
    if scatter == 1:
        assert np.mean([one.p < 0.2 for one in found]) > 0.05


def test_what_all_probes_feel_a_little_shows_in_their_sum_and_in_none_alone() -> None:
    draw = np.random.default_rng(20605)
    heard = []
    for _ in range(40):
        structure = structure_from_scores(scores(draw, 60, 24, sizes=3.0 / math.sqrt(60) * np.resize([1, -1], 24)))
        if structure.smallest_probe_p > SINGLE_PROBE_LEVEL:
            heard.append(questioned(scores(draw, 12, 2), structure=structure).probes_reject)
    assert len(heard) >= 10
    assert np.mean(heard) > 0.7


def test_what_one_probe_alone_feels_drowns_in_the_sum_and_is_heard_as_the_loudest() -> None:
    """At six standard errors in one of 24 the sum hears one campaign in eight, the smallest_probe_p six of seven."""
    draw = np.random.default_rng(20606)
    drowned = []
    for _ in range(60):
        structure = structure_from_scores(scores(draw, 60, 24, sizes=[6.0 / math.sqrt(60), *[0] * 23]))
        if structure.p > 0.1 * FALSE_ALARM_LEVEL_FIRST_ROUND:
            drowned.append(questioned(scores(draw, 12, 2), structure=structure).probes_reject)
    assert len(drowned) >= 15
    assert np.mean(drowned) > 0.6


def test_what_is_left_counts_by_its_shape_and_by_what_trials_take_upon_themselves(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    of = scores(np.random.default_rng(20607), 12, 2)
    chance = {"between_conditions_p": 1.0, "noise_in_motion_p": 1.0}
    for name in chance:
        monkeypatch.setattr(misfit_tests, name, lambda _, name=name: chance[name])
    shaped = Structure(80.0, 8, 1e-9, 6.0)
    assert not questioned(of).omnibus_rejects
    assert questioned(of, structure=shaped).omnibus_rejects
    for name in chance:
        chance[name] = 1e-5
        assert questioned(of).omnibus_rejects
        assert not questioned(of, level=0.1 * FALSE_ALARM_LEVEL_LATER_ROUNDS).omnibus_rejects
        chance[name] = 1.0


def test_limits_of_what_could_hide_hold_the_truth_19_times_of_20() -> None:
    draw = np.random.default_rng(20608)
    friction = vt.effects.tail_friction
    shape = CandidateShape(friction, (), 1e-3)
    held = []
    for _ in range(300):
        true = 0.05
        unit = scores(draw, 12, 1, sizes=true * 300)
        scale = np.array([[300.0]])
        of = Scores(
            unit.score * 300,
            unit.information * scale**2,
            unit.trial_scores * 300,
            unit.trial_informations * scale**2,
            11.0,
        )
        answers = EffectSensitivities((shape,), [], ())
        fit: Any = None
        limits, testable = MisfitTests(
            fit, (friction,), answers, fit, of, QUIET, FALSE_ALARM_LEVEL_FIRST_ROUND
        ).upper_limits(friction)
        assert testable
        held.append(limits["tail_friction.mu_w"] > true)
    assert 0.92 < np.mean(held) < 0.99


def test_systematic_errors_that_imitate_a_shape_are_integrated_out() -> None:
    """With prior N(0, 1) of the errors what is left of A is A − B(C + 1)⁻¹Bᵀ, and of its score s − B(C + 1)⁻¹t."""
    together = scores(np.random.default_rng(20609), 12, 5)
    turn = _marginalisation(together.information, 3)
    score, information = _marginalised(together.score, together.information, turn)
    A, B, C = together.information[:3, :3], together.information[:3, 3:], together.information[3:, 3:]
    inner = np.linalg.inv(C + np.eye(2))
    assert information == pytest.approx(A - B @ inner @ B.T)
    assert score == pytest.approx(together.score[:3] - B @ inner @ together.score[3:])
    assert (together.trial_scores @ turn).sum(axis=0) == pytest.approx(score)


def known_fit(log_likelihood: float, numbers: tuple[Number, ...] = (), covariance: Floats | None = None) -> Any:
    """What a likelihood ratio asks of a fit of few trials, whose film is free already."""
    matrix = np.diag([number.sigma**2 for number in numbers]) if covariance is None else covariance
    return SimpleNamespace(
        log_likelihood=log_likelihood, numbers=numbers, covariance=matrix, trials=(), model=("film_mass",)
    )


def hypothesis(name: str, log_likelihood: float, inflation: float = 1.0) -> LikelihoodRatio:
    effect = getattr(vt.effects, name)
    return LikelihoodRatio(
        (effect,), known_fit(log_likelihood), 50.0, 7.0, True, "", inflation=inflation, log_evidence=log_likelihood - 2
    )


@pytest.mark.parametrize(("inflation", "names"), [(1.0, ["air_drag"]), (4.0, ["air_drag", "inlet_loss"])])
def test_hypotheses_are_excluded_by_less_where_trials_scatter_more(inflation: float, names: list[str]) -> None:
    both = [hypothesis("air_drag", -100.0, inflation), hypothesis("inlet_loss", -110.0)]
    assert [one.label for one in answer_set(both)[0]] == names
    weights = weights_of(both)
    assert weights["inlet_loss"] / weights["air_drag"] == pytest.approx(math.exp(-10 / inflation))


@pytest.mark.parametrize(("value", "named"), [(0.5, True), (2.0, False)])
def test_a_size_smaller_than_its_error_is_compatible_with_none(value: float, named: bool) -> None:
    drag = Number("air_drag.C_D", "", "C_D", "1", value, 0.8, value - 1.6, value + 1.6, math.inf, "linear")
    found = likelihood_ratio(known_fit(-120.0), [vt.effects.air_drag], known_fit(-100.0, (drag,)))
    assert (found.reason.code == "size_may_be_zero") == named
    assert found.credible != named


@pytest.mark.parametrize(("ratio", "inflation"), [(0.5, 1.0), (2.0, 4.0), (3.0, 6.0)])
def test_what_a_refit_is_worth_is_told_in_errors_as_large_as_trials_scatter(
    ratio: float, inflation: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What trials scatter more than the noise says is taken off; as a variance it counts six times at most."""
    drag = Number("air_drag.C_D", "", "C_D", "1", 1.0, 0.1, 0.8, 1.2, math.inf, "linear")
    after = known_fit(-100.0, (drag,))
    after.trials, after.predictor, after.solution = (None,) * 12, None, None
    scattered = (np.diag([0.01]), np.diag([0.01 * ratio**2]))
    monkeypatch.setattr("vinetrack.diagnosis.likelihood_ratio.robust_covariance", lambda *_: scattered)
    found = likelihood_ratio(known_fit(-150.0), [vt.effects.air_drag], after)
    assert found.delta_chi2 == pytest.approx(100.0)
    assert found.sigma == pytest.approx(10.0 / max(ratio, 1.0))
    assert found.inflation == pytest.approx(inflation)
