"""Scores and their thresholds: linear campaigns whose scores have a known distribution, against regressions."""

import math
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from lsoda_vine import small_campaign
from scipy.stats import norm

import vinetrack as vt
from vinetrack.core.problems import Remark
from vinetrack.core.records import Trial
from vinetrack.diagnosis import hypotheses as ratios
from vinetrack.diagnosis import misfit_tests, selection
from vinetrack.diagnosis.misfit_tests import MisfitTests, Scores
from vinetrack.effects import catalogue
from vinetrack.inference import fit_result, marginal_likelihood

FIRST, LATER = misfit_tests.FALSE_ALARM_LEVEL_FIRST_ROUND, misfit_tests.FALSE_ALARM_LEVEL_LATER_ROUNDS


def summed(single: np.ndarray, informations: np.ndarray, groups=()) -> Scores:
    named = list(groups) or [str(i) for i in range(len(single))]
    of_trials = np.einsum("njj->nj", informations)
    return Scores(
        single.sum(axis=0), informations.sum(axis=0), single, of_trials, 1, named, np.zeros((0, len(of_trials.T)))
    )


def scores(draw: np.random.Generator, trials: int, shapes: int, scatter: float = 1.0, sizes=0.0) -> Scores:
    """What a linear campaign says of shapes of true `sizes`."""
    root = draw.standard_normal((trials, 3 * shapes, shapes)) / math.sqrt(3 * shapes)
    informations = np.einsum("nkj,nkl->njl", root, root)
    noise = scatter * np.einsum("nkj,nk->nj", root, draw.standard_normal((trials, 3 * shapes)))
    return summed(noise + informations @ np.broadcast_to(sizes, (shapes,)), informations)


def questioned(of: Scores, level: float = FIRST, effects=()) -> MisfitTests:
    shape = SimpleNamespace(effect=SimpleNamespace(parameters=(1,)), size=SimpleNamespace(sign=0))
    named = tuple(effects) or tuple(f"effect_{k}" for k in range(of.score.size))
    answers = SimpleNamespace(shapes=[shape] * of.score.size, effects=named)
    return MisfitTests(None, (), answers, of, level)


@pytest.mark.parametrize("scatter", [1.0, 3.0])
def test_scores_are_as_large_as_they_say_however_much_trials_scatter(scatter):
    draw = np.random.default_rng(20600)
    campaigns = [scores(draw, 20, 4, scatter) for _ in range(300)]
    z = np.concatenate([one.size / one.sigma for one in campaigns])
    assert 0.8 < np.std(z) < 1.15


def test_a_size_explains_its_own_part_of_how_trials_scatter():
    draw = np.random.default_rng(20601)
    campaigns = [scores(draw, 24, 3, sizes=[8.0, 0.0, 0.0]) for _ in range(100)]
    assert np.median([one.robust_sigma[0] / one.plain_sigma[0] for one in campaigns]) < 1.3
    assert np.median([one.size[0] for one in campaigns]) == pytest.approx(8.0, rel=0.05)


@pytest.mark.parametrize(
    ("seed", "trials", "scatter", "named", "level", "campaigns", "most"),
    [
        (20602, 12, 1.0, "abcd", FIRST, 2000, 20),
        (20602, 12, 3.0, "abcd", FIRST, 2000, 20),
        (20604, 24, 1.0, "m" * 20 + "o", 0.02, 500, 18),  # at 2 %, more once in 100
    ],
)
def test_candidates_are_false_alarms_as_seldom_as_they_say(seed, trials, scatter, named, level, campaigns, most):
    draw = np.random.default_rng(seed)
    asked = [questioned(scores(draw, trials, len(named), scatter), level, named) for _ in range(campaigns)]
    assert sum(each.any_exceeds(level) for each in asked) <= most
    assert [*map(misfit_tests.level_of, (vt.base_model(), vt.base_model() + "leak"))] == [FIRST, LATER]


def test_a_size_at_its_bound_takes_nothing_from_an_effect():
    """Drag is 0 in these tracks, where a fit with it is a fit without it."""
    pairs, candidate = small_campaign(seed=8, replicates=1)[0], catalogue()["leak"]
    fits = [vt.fit(model, pairs) for model in (vt.base_model(), vt.base_model() + "air_drag")]
    assert [number.bound for number in fits[1].numbers if number.key == "air_drag.C_D"] == [0]
    without, at_bound = (misfit_tests.misfit_tests(fit, [candidate], FIRST).scores for fit in fits)
    np.testing.assert_allclose(at_bound.plain_sigma, without.plain_sigma, rtol=3e-3)


def any_probe_exceeds(of: Scores, level: float) -> bool:
    return questioned(of, level, ["probe"] * of.score.size).any_exceeds(level)


@pytest.mark.parametrize(("trials", "probes", "scatter"), [(24, 8, 1.0), (24, 8, 3.0), (6, 12, 1.0)])
def test_probes_of_nothing_are_heard_as_seldom_as_they_say(trials, probes, scatter):
    draw = np.random.default_rng(20604)
    heard = [any_probe_exceeds(scores(draw, trials, probes, scatter), 0.05) for _ in range(400)]
    assert np.mean(heard) < 0.08
    if (trials, scatter) == (24, 1.0):
        assert np.mean(heard) > 0.01


def test_six_trials_hear_a_force_of_thirty_standard_errors_that_one_probe_feels():
    draw, sizes = np.random.default_rng(9), [30 / math.sqrt(6), *[0] * 11]
    assert all(any_probe_exceeds(scores(draw, 6, 12, sizes=sizes), 0.1 * LATER) for _ in range(40))


def test_what_one_of_many_probes_feels_alone_is_heard():
    draw, sizes = np.random.default_rng(20606), np.array([6.0, *[0] * 23]) / math.sqrt(60)
    heard = [any_probe_exceeds(scores(draw, 60, 24, sizes=sizes), misfit_tests.PROBE_LEVEL) for _ in range(60)]
    assert np.mean(heard) > 0.6


def test_what_is_left_counts_by_its_shape_and_by_what_trials_take_upon_themselves(monkeypatch):
    of = scores(np.random.default_rng(20607), 12, 2)
    answers = questioned(of, effects=["probe"] * 2).products
    shaped = scores(np.random.default_rng(20607), 12, 2, sizes=9.0)
    for name in ("_probe_shapes", "products_of"):
        monkeypatch.setattr(misfit_tests, name, lambda *_: answers)
    for left, p, rejects in ((of, 1.0, False), (shaped, 1.0, True), (of, 1e-5, True)):
        monkeypatch.setattr(misfit_tests, "scores_of", lambda *_, left=left: left)
        monkeypatch.setattr(misfit_tests, "between_conditions_p", lambda _, p=p: p)
        assert questioned(of).omnibus_rejects == rejects
    assert not questioned(of, level=0.1 * LATER).omnibus_rejects


@pytest.mark.parametrize(
    ("chi2", "residual_m", "systematic_m", "exceeds"),
    [(6.6, 5e-5, 0.0, False), (6.6, 8e-5, 0.0, True), (6.6, 8e-5, 9e-5, False), (3.9, 8e-5, 0.0, False)],
    ids=["slow errors of a film", "more than these", "an unknown lens", "within the noise"],
)
def test_a_misfit_no_larger_than_slow_errors_of_tracks_is_not_far_off(chi2, residual_m, systematic_m, exceeds):
    """Of 100 mm of growth. Nothing is then sought beyond a model that passes: 14 s instead of 71 for 24 films."""
    trial = SimpleNamespace(condition="all")
    track = SimpleNamespace(position_systematic_m=systematic_m, lead_position_m=np.array([0.0, 0.1]), trial=trial)
    predictor = SimpleNamespace(data=[track] * 3)
    solution = SimpleNamespace(columns=[np.full((4, 1), residual_m)] * 3, predictor=predictor)
    fit = SimpleNamespace(chi2_per_dof=chi2, predictor=predictor, solution=solution)
    assert misfit_tests.exceeds_slow_errors(fit) == exceeds


@pytest.mark.parametrize("replicates_missed", [1, 2])
def test_a_condition_that_is_missed_in_every_replicate_is_far_off_though_most_trials_are_not(replicates_missed):
    names, missed = ["low", "low", "a", "a", "b", "b", "b"], [True] * replicates_missed + [False] * 6
    trials, grown_m = [SimpleNamespace(condition=name) for name in names], np.array([0.0, 0.1])
    data = [SimpleNamespace(position_systematic_m=0.0, lead_position_m=grown_m, trial=trial) for trial in trials]
    columns = [np.full((4, 1), 2e-3 if far else 1e-6) for far in missed[:7]]
    predictor = SimpleNamespace(data=data)
    solution = SimpleNamespace(columns=columns, predictor=predictor)
    fit = SimpleNamespace(chi2_per_dof=900.0, predictor=predictor, solution=solution)
    assert misfit_tests.exceeds_slow_errors(fit) == (replicates_missed == 2)


@pytest.mark.parametrize(("trials", "scatter"), [(12, 0.0), (8, 5.0)])
def test_limits_of_what_could_hide_hold_the_truth_19_times_of_20(trials, scatter):
    """Also where few trials scatter five times as widely as their noise: the normal quantile held it 9 times of 10."""
    draw = np.random.default_rng(20608)
    friction, true, unit = vt.effects.tail_friction, 0.05, 300.0
    answers = misfit_tests.Products(None, None, (misfit_tests.CandidateShape(friction, (), 1e-3),))
    held = []
    for _ in range(2000):
        one = scores(draw, trials, 1, sizes=true * unit)
        more = scatter * np.sqrt(one.trial_informations) * draw.standard_normal((trials, 1))
        of = summed((one.trial_scores + more) * unit, one.trial_informations[:, :, None] * unit**2)
        limits = MisfitTests(None, (friction,), answers, of, FIRST).upper_limits(friction)
        held.append(limits["tail_friction.mu_w"] > true)
    assert 0.92 < np.mean(held) < 0.99


def test_systematic_errors_that_imitate_a_shape_are_integrated_out():
    """With prior N(0, 1) of the errors what is left of A is A − B(C + 1)⁻¹Bᵀ, and of its score s − B(C + 1)⁻¹t."""
    columns = np.random.default_rng(20609).standard_normal((12, 40, 6))  # two errors, three shapes, the residual
    blocks = np.swapaxes(columns, 1, 2) @ columns
    places = np.tile([0, 1], (12, 1))
    arrays = {"prior_mean": np.zeros(2), "prior_precision": np.ones(2), "free": np.ones(2, dtype=bool)}
    problem = SimpleNamespace(index=places, **arrays)
    problem.summed = partial(marginal_likelihood.MixedProblem.summed, problem)
    products = SimpleNamespace(problem=problem, n_unknowns=2, without_trial_effects=lambda _: blocks)
    state = marginal_likelihood.FitState(np.zeros(0), np.zeros((12, 4)), (1e-5, 1e-5), 0.0, np.ones(12))
    found = misfit_tests.scores_of(SimpleNamespace(numbers=(), trials=()), products, state)
    total = blocks.sum(axis=0)
    A, B, C, inner = total[2:5, 2:5], total[2:5, :2], total[:2, :2], np.linalg.inv(total[:2, :2] + np.eye(2))
    assert np.linalg.eigvalsh(C).min() > 1
    assert found.information == pytest.approx(A - B @ inner @ B.T)
    assert found.score == pytest.approx(total[2:5, 5] - B @ inner @ total[:2, 5])
    assert found.fitted == 0


def number_of(key: str, value: float, sigma: float) -> fit_result.Number:
    return fit_result.Number(key, "", "s", "1", value, sigma, value - 2 * sigma, value + 2 * sigma, math.inf, "linear")


def known_fit(log_likelihood: float, *numbers: fit_result.Number):
    """What a likelihood ratio asks of a fit of few trials, whose film is free already."""
    known = {"covariance": np.diag([number.sigma**2 for number in numbers]), "trials": (), "model": ("film_mass",)}
    return SimpleNamespace(log_likelihood=log_likelihood, numbers=numbers, predictor=SimpleNamespace(data=()), **known)


def hypothesis(name: str, log_likelihood: float, inflation: float = 1.0) -> ratios.LikelihoodRatio:
    known = (catalogue()[name],), known_fit(log_likelihood), 50.0, 7.0, True, ""
    return ratios.LikelihoodRatio(*known, inflation=inflation)


@pytest.mark.parametrize(("inflation", "names"), [(1.0, ["air_drag"]), (4.0, ["air_drag", "inlet_loss"])])
def test_hypotheses_are_excluded_by_less_where_trials_scatter_more(inflation, names):
    both = [hypothesis("air_drag", -100.0, inflation), hypothesis("inlet_loss", -110.0)]
    assert [one.label for one in ratios.answer_set(both)[0]] == names


@pytest.mark.parametrize(("ratio", "inflation"), [(0.5, 1.0), (2.0, 4.0), (3.0, 9.0)])
def test_what_a_refit_is_worth_is_told_in_errors_as_large_as_trials_scatter(ratio, inflation, monkeypatch):
    """What trials scatter more than the noise says is taken off; as a variance it counts six times at most."""
    after = known_fit(-100.0, number_of("air_drag.C_D", 1.0, 0.1))
    after.predictor, after.solution = SimpleNamespace(data=(None,) * 12), None
    scattered = (np.diag([0.01]), np.array([0.01 * ratio**2]), np.array([5.0]))
    monkeypatch.setattr("vinetrack.diagnosis.hypotheses.robust_variances", lambda *_: scattered)
    found = ratios.likelihood_ratio(known_fit(-150.0), [vt.effects.air_drag], after)
    assert found.delta_chi2 == pytest.approx(100.0)
    assert found.sigma == pytest.approx(10.0 / max(ratio, 1.0))
    assert found.inflation == pytest.approx(inflation)


@pytest.mark.parametrize(
    ("cosines", "names", "level", "sign", "share"),
    [
        (np.eye(1), "a", 0.02, 0, 0.02 / 2),
        (np.eye(1), "a", 1e-4, 1, 1e-4),
        (np.eye(20), "abcdefghijklmnopqrst", 3e-3, 0, (1 - (1 - 3e-3) ** (1 / 20)) / 2),
        (np.ones((30, 30)), "a" * 30, 3e-3, 0, 3e-3 / 2),
        (np.diag([1.0, 1.0, 0.0]), "abs", 3e-3, 0, 3e-3 / 4),
    ],
    ids=["of either sign", "of one sign", "equal shares", "the same curve counts once", "the silent take no share"],
)
def test_thresholds_are_quantiles_of_the_normal(cosines, names, level, sign, share):
    family = misfit_tests.family_test(cosines, [sign] * len(names), list(names), level)
    assert family["a"] == pytest.approx(norm.isf(share), abs=0.01)


def test_an_implausible_size_is_believed_where_no_other_is_plausible():
    best, other = hypothesis("air_drag", -100.0), hypothesis("inlet_loss", -104.0)
    far = replace(best, plausible=False, reason="far")
    assert [one.label for one in ratios.answer_set([best, other])[0]] == ["air_drag", "inlet_loss"]
    assert ratios.answer_set([far, other]) == ([other], {"air_drag": "far"})
    assert ratios.answer_set([far, replace(other, credible=False, reason="none")]) == ([far], {"inlet_loss": "none"})


def test_an_implausible_size_is_not_believed_where_one_beyond_belief_fits_better():
    far, tests = replace(hypothesis("air_drag", -100.0), plausible=False), SimpleNamespace(rejects_model=False, fit=1)
    for log_likelihood, code, named in ((-99.0, "", []), (-101.0, "", ["air_drag"]), (-101.0, "implausible_size", [])):
        search = SimpleNamespace(tests_after=lambda _: tests, implausible=lambda _, code=code: Remark(code))
        further = replace(hypothesis("inlet_loss", log_likelihood), plausible=False, credible=False)
        found, *_ = selection.adequate_hypotheses([far, further], search)
        assert [one.label for one in found] == named


def test_an_effect_is_fitted_from_its_usual_values_too_and_never_twice_from_the_same(monkeypatch):
    """Without bends in the sheet nothing depends on μ_c; from a fifth of its size capstan friction ended at none."""
    effect, starts = catalogue()["capstan_friction"], []
    others = [(mu, k) for k in (10.0, 3.0, 17.0) for mu in (0.3, 1.0, 1.7)]
    products = SimpleNamespace(shapes=[misfit_tests.CandidateShape(effect, other, 1e-3) for other in others])
    known = {"predicted_gains": np.repeat([9.0, 8.0, 7.0], 3), "scores": SimpleNamespace(size=np.full(9, 0.01))}
    told = {"ranked_shapes": lambda _: range(9), "predicted_gain": lambda _: 9.0}
    fit = SimpleNamespace(model=vt.base_model(), log_likelihood=-100.0)
    monkeypatch.setattr(selection, "full_fit", lambda *_, start, **__: starts.append(start.get("capstan_friction.k")))
    search = selection.Search(SimpleNamespace(fit=fit), str)
    search._fit_from_prediction(SimpleNamespace(products=products, fit=fit, **known, **told), (), "capstan_friction")
    assert starts == [10.0, 3.0, None]


@pytest.mark.parametrize(("within", "code"), [(-103.0, ""), (-106.0, "implausible_size"), (None, "implausible_size")])
def test_a_wide_error_makes_no_size_plausible_that_fits_far_worse_within_its_range(monkeypatch, within, code):
    far = replace(hypothesis("air_drag", -100.0), fit=known_fit(-100.0, number_of("air_drag.C_D", 6.0, 4.0)))
    bounds = []

    def refitted(_, model):
        bounds.append(model[0].parameters[0].bounds)
        return within and known_fit(within)

    monkeypatch.setattr(selection, "full_fit", refitted)
    monkeypatch.setattr(selection, "reduce", lambda _, effects, __: effects)
    found = selection.Search(SimpleNamespace(fit=known_fit(-200.0)), str).implausible(far)
    assert found.code == code
    assert bounds == [vt.effects.air_drag.parameters[0].plausible]


@pytest.mark.parametrize(("correlation", "code"), [(0.0, "noise_is_not_averaged"), (0.7, None)])
def test_positions_with_independent_noise_are_no_averages(correlation, code):
    time_s, trial = 1e-3 * np.arange(200), Trial(name="t", vine="v", travel_ratio=2.0)
    position_m = np.cumsum(time_s) + 1e-4 * np.random.default_rng(7).standard_normal(200)
    known = {"noise_m": 1e-4, "smoothing": None, "correlation": correlation, "trial": trial, "trace": None}
    data = (SimpleNamespace(time_s=time_s, lead_position_m=position_m, **known),)
    reasons = misfit_tests.testable([catalogue()["moving_average"]], data)[1]
    assert getattr(reasons.get("moving_average"), "code", None) == code
    # A measured pressure holds what happens in the chamber.
    data[0].trace = (time_s, np.full(200, 2e4))
    assert misfit_tests.testable([catalogue()["reservoir_depletion"]], data)[1]["reservoir_depletion"].code == (
        "in_measured_pressure"
    )


def test_a_set_is_worth_what_it_has_more_than_the_best_one_within_it(monkeypatch):
    search = selection.Search(SimpleNamespace(fit=known_fit(-200.0)), str)
    monkeypatch.setattr(search, "tests_after", lambda _: SimpleNamespace(family=dict.fromkeys(catalogue(), 4.9)))
    for gained, *names in ((100.2, "supply_refill"), (100.0, "reservoir_depletion"), (60.0, "air_drag")):
        search.fitted[frozenset(names)] = hypothesis(names[0], -200.0 + gained)
    for gained, better in ((112.0, False), (113.7, True)):
        both = tuple(catalogue()[name] for name in ("reservoir_depletion", "air_drag"))
        assert search.is_better(replace(hypothesis("air_drag", -200.0 + gained), effects=both)) == better


def test_any_phase_of_a_swing_is_plausible():
    of = {parameter.name: parameter for parameter in catalogue()["supply_pulsation"].parameters}
    assert all(misfit_tests.is_plausible(of["phi"], phase_rad, 0.0) for phase_rad in (-3.67, 6.9, 3.0))
    assert not misfit_tests.is_plausible(of["f"], 480.0, 0.0)
