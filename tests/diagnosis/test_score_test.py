"""Scores and their thresholds: linear campaigns whose scores have a known distribution, against regressions."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

import vinetrack as vt
from vinetrack.core.records import Floats
from vinetrack.diagnosis import misfit_tests, score_test
from vinetrack.diagnosis.likelihood_ratio import (
    LikelihoodRatio,
    answer_set,
    likelihood_ratio,
    log_evidence,
    posterior_weights,
    prior_penalty,
    weights_of,
)
from vinetrack.diagnosis.misfit_tests import (
    FALSE_ALARM_LEVEL_FIRST_ROUND,
    FALSE_ALARM_LEVEL_LATER_ROUNDS,
    SINGLE_PROBE_LEVEL,
    MisfitTests,
    Structure,
    structure_from_scores,
)
from vinetrack.diagnosis.score_test import (
    CandidateShape,
    EffectSensitivities,
    Scores,
    _marginalisation,
    _marginalised,
    family_test,
    is_plausible,
)
from vinetrack.effects import Parameter, catalogue
from vinetrack.inference.fit_result import Number
from vinetrack.inference.marginal_likelihood import FitState

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


def test_six_trials_hear_a_force_that_one_probe_feels_and_seldom_one_that_is_not_there() -> None:
    """Of noise alone one campaign in twenty at that level; thirty standard errors in one of 12 always."""
    draw = np.random.default_rng(9)
    nothing = [structure_from_scores(scores(draw, 6, 12)) for _ in range(200)]
    assert np.mean([one.p < 0.05 for one in nothing]) < 0.09
    assert np.mean([one.smallest_probe_p < 0.05 for one in nothing]) < 0.09
    loud = [structure_from_scores(scores(draw, 6, 12, sizes=[30 / math.sqrt(6), *[0] * 11])) for _ in range(40)]
    level = 0.1 * FALSE_ALARM_LEVEL_LATER_ROUNDS
    assert all(one.p < level and one.smallest_probe_p < level for one in loud)


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


@pytest.mark.parametrize(
    ("chi2", "residual_m", "slow", "systematic_m", "exceeds"),
    [
        (6.6, 5e-5, True, 0.0, False),
        (6.6, 5e-5, False, 0.0, True),
        (6.6, 5e-5, False, 6e-5, False),
        (6.6, 8e-5, True, 6e-5, True),
        (3.9, 8e-5, True, 0.0, False),
    ],
    ids=["slow errors of a film", "noise alone", "an unknown lens", "more than either", "within the noise"],
)
def test_a_misfit_no_larger_than_the_slow_errors_of_tracks_is_not_far_off(
    chi2: float, residual_m: float, slow: bool, systematic_m: float, exceeds: bool
) -> None:
    """Of 100 mm of growth. Nothing is then sought beyond a model that passes: 14 s instead of 71 for 24 films."""
    track: Any = SimpleNamespace(
        position_systematic_m=systematic_m,
        lead_position_m=np.array([0.0, 0.1]),
        slow_m=0.0 if slow else None,
        trace=None,
    )
    fit: Any = SimpleNamespace(
        chi2_per_dof=chi2,
        predictor=SimpleNamespace(data=[track] * 3),
        solution=SimpleNamespace(columns=[np.full((4, 1), residual_m)] * 3),
    )
    assert misfit_tests.exceeds_slow_errors(fit) == exceeds


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


# Equal shares of the false alarms: thresholds of candidates that are tried in one shape, or in many.

SIZES = (1,) * 12 + (30, 6)
NAMES = [f"effect_{k}" for k, size in enumerate(SIZES) for _ in range(size)]
SIGNS = [(-1, 0, 1)[k % 3] for k, size in enumerate(SIZES) for _ in range(size)]


def alike_within() -> np.ndarray:
    """Correlations of shapes, those of one effect alike."""
    draw = np.random.default_rng(20620)
    own = draw.standard_normal((len(SIZES), 40))[np.repeat(range(len(SIZES)), SIZES)]
    shapes = own + draw.standard_normal((len(NAMES), 40))
    shapes /= np.linalg.norm(shapes, axis=1)[:, None]
    return np.asarray(shapes @ shapes.T)


@pytest.mark.parametrize(("sign", "tails"), [(0, 2.0), (1, 1.0)])
@pytest.mark.parametrize("level", [0.02, 1e-4])
def test_the_threshold_of_one_candidate_is_the_quantile_of_the_normal(sign: int, tails: float, level: float) -> None:
    family = family_test(np.eye(1), [sign], ["only"], level)
    assert family.threshold("only") == pytest.approx(norm.isf(level / tails), abs=0.01)


def test_independent_candidates_share_as_sidak_says() -> None:
    family = family_test(np.eye(20), [0] * 20, [str(k) for k in range(20)], 3e-3)
    assert family.candidate_level == pytest.approx(1 - (1 - 3e-3) ** (1 / 20), rel=0.02)


@pytest.mark.parametrize("shapes", [2, 30])
def test_shapes_that_are_the_same_curve_count_once(shapes: int) -> None:
    family = family_test(np.ones((shapes, shapes)), [0] * shapes, ["only"] * shapes, 3e-3)
    assert family.threshold("only") == pytest.approx(norm.isf(3e-3 / 2), abs=0.02)


@pytest.mark.slow
def test_any_candidate_exceeds_its_threshold_at_the_level_and_each_at_its_share() -> None:
    """Against two million draws from another generator."""
    cosines, level = alike_within(), 3e-3
    family = family_test(cosines, SIGNS, NAMES, level)
    limits, signs = np.array([family.threshold(name) for name in NAMES]), np.array(SIGNS)
    draw, root = np.random.default_rng(20621), np.linalg.cholesky(cosines + 1e-9 * np.eye(len(NAMES)))
    alarms, total, by_many = 0, 0, 0
    for _ in range(40):
        z = draw.standard_normal((50_000, len(NAMES))) @ root.T
        beyond = np.where(signs == 0, np.abs(z), z * signs) > limits
        alarms, total = alarms + int(beyond.any(axis=1).sum()), total + len(z)
        by_many += int(beyond[:, [name == "effect_12" for name in NAMES]].any(axis=1).sum())
    assert alarms / total == pytest.approx(level, rel=0.05)
    assert by_many / total == pytest.approx(family.candidate_level, rel=0.25)
    assert family.threshold("effect_12") > family.threshold("effect_1") + 0.4


def test_shapes_that_the_data_say_nothing_of_take_no_share() -> None:
    cosines = np.eye(3)
    cosines[2, 2] = 0.0
    family = family_test(cosines, [0, 0, 0], ["a", "b", "silent"], 3e-3)
    assert family.threshold("a") == pytest.approx(norm.isf(3e-3 / 4), abs=0.01)


# Predicted gains of effects, compared with regressions.


@pytest.mark.parametrize(("bound", "adapting"), [(math.nan, [0, 1]), (0.0, [0])])
def test_a_gain_is_that_of_regressions_in_which_parameters_at_a_bound_do_not_adapt(
    monkeypatch: pytest.MonkeyPatch, bound: float, adapting: list[int]
) -> None:
    draw = np.random.default_rng(5)
    n = 60
    columns = draw.standard_normal((n, 4))  # two parameters, the residual, one effect
    columns[:, 2] += 3 * columns[:, 1] + 0.5 * columns[:, 3]
    blocks = (columns.T @ columns)[None]
    monkeypatch.setattr(
        score_test, "products_without_trial_effects", lambda _fit, _products, state: blocks / state.variance[0]
    )
    problem = SimpleNamespace(
        index=np.array([[0, 1]]),
        places=np.array([[0, 1]]),
        prior_mean=np.zeros(2),
        prior_precision=np.zeros(2),
        free=np.ones(2, bool),
        points=np.array([float(n)]),
    )
    state = FitState(np.zeros(2), np.zeros((1, 4)), (1e-5, 1e-5), 0.0, np.ones(1))
    fit: Any = SimpleNamespace(
        solution=SimpleNamespace(state=state, problem=problem),
        numbers=[SimpleNamespace(bound=math.nan), SimpleNamespace(bound=bound)],
    )
    products: Any = SimpleNamespace(
        n_keys=2, n_shapes=1, n_tested=1, parts=[np.array([0])], tested_indices=np.array([[0]])
    )
    gain, size = score_test.linear_gains(fit, products, 0.0)

    def squares(of: list[int]) -> tuple[float, float]:
        found = np.linalg.lstsq(columns[:, of], columns[:, 2], rcond=None)
        return float(found[1][0]), float(found[0][-1])

    without, (with_effect, expected_size) = squares(adapting)[0], squares([*adapting, 3])
    assert gain[0] == pytest.approx(n * math.log(without / with_effect), rel=1e-6)
    assert size[0] == pytest.approx(expected_size, rel=1e-6)


# Plausible ranges weigh hypotheses: against integrals done by quadrature.

GAUGE = Parameter("delta", "δ", "Pa", 500.0, plausible=(-2e3, 2e3))


@dataclass
class KnownFit:
    """What these functions read of a fit."""

    numbers: tuple[Number, ...]
    log_likelihood: float = -10.0
    covariance: Any = field(default_factory=lambda: np.eye(1))


def fitted(value: float, sigma: float) -> Any:
    number = Number("g.delta", "", "δ", "Pa", value, sigma, value - 2 * sigma, value + 2 * sigma, math.inf, "linear")
    return KnownFit((number,), covariance=np.array([[sigma**2]]))


@pytest.mark.parametrize(("value", "sigma"), [(300.0, 200.0), (7.1e3, 1.7e3), (-1.5e3, 30.0)])
def test_the_marginal_likelihood_is_the_integral_over_the_prior(value: float, sigma: float) -> None:
    def inside(delta: float) -> float:
        return math.exp(-10 - 0.5 * ((delta - value) / sigma) ** 2) * norm.pdf(delta, 0.0, 1e3)

    whole, _ = quad(inside, -2e4, 2e4, points=[value - 3 * sigma, value, value + 3 * sigma, 0.0], epsabs=0, limit=300)
    assert log_evidence(fitted(value, sigma), {"g.delta": GAUGE}) == pytest.approx(math.log(whole), abs=1e-6)


def test_a_gauge_seven_kilopascals_off_is_a_surprise_and_one_within_two_is_none() -> None:
    # z² = 7.1² / (1.7² + 1²) = 12.96 with a prior of 1 kPa; less 4 at the edge of the plausible range.
    assert prior_penalty(fitted(7.1e3, 1.7e3), {"g.delta": GAUGE}) == pytest.approx(12.96 - 4, abs=0.01)
    assert prior_penalty(fitted(1.9e3, 100.0), {"g.delta": GAUGE}) == 0
    assert prior_penalty(fitted(7.1e3, 5e3), {"g.delta": GAUGE}) == 0


def test_a_number_of_which_the_data_say_nothing_costs_nothing() -> None:
    assert log_evidence(fitted(0.0, 1e7), {"g.delta": GAUGE}) == pytest.approx(-10, abs=1e-6)


def test_weights_add_up_and_follow_the_evidence() -> None:
    weights = posterior_weights([-10.0, -10.0 - math.log(3), -800.0])
    assert weights == pytest.approx([0.75, 0.25, 0.0])
    assert posterior_weights([]) == []


@pytest.mark.parametrize("phase_rad", [-3.67, 6.9, 3.0])
def test_any_phase_of_a_swing_is_plausible(phase_rad: float) -> None:
    """A phase of −3.67 rad is one of 2.61."""
    phase = next(parameter for parameter in catalogue()["supply_pulsation"].parameters if parameter.name == "phi")
    assert is_plausible(phase, phase_rad, 0.0)
    frequency = next(parameter for parameter in catalogue()["supply_pulsation"].parameters if parameter.name == "f")
    assert not is_plausible(frequency, 480.0, 0.0)
