"""Several effects together: what a member of a set is worth, and steps that mend only a part."""

import json
import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
from grown import hidden, tubes
from scipy.stats import chi2, norm

import vinetrack as vt
from vinetrack.core.problems import Remark
from vinetrack.diagnosis import result, selection
from vinetrack.diagnosis.hypotheses import LikelihoodRatio, in_sigmas, sizes_of
from vinetrack.diagnosis.ladder import LADDER_COLUMNS
from vinetrack.diagnosis.selection import Search
from vinetrack.effects import find_effect

NAMES = ("air_drag", "leak", "tail_friction")
TRIPLE = -1000.0
CANDIDATES = ("reservoir_depletion", "tail_friction", "latch_release", "leak")
TRUTH = {"reservoir_depletion.gamma": 1.3, "tail_friction.mu_w": 1.0}
LATCH = {"latch_release.F": 1.0, "latch_release.reach": 0.01}


def of(names, log_likelihood: float, inflation: float = 1.0, numbers=()) -> LikelihoodRatio:
    known = {"numbers": numbers, "trials": NAMES, "predictor": SimpleNamespace(data=())}
    fit = SimpleNamespace(log_likelihood=log_likelihood, model=(), **known)
    return LikelihoodRatio(tuple(map(find_effect, names)), fit, 0.0, 0.0, True, Remark(), inflation=inflation)


def sets_of(known: list[LikelihoodRatio], thresholds=None) -> Search:
    family = dict.fromkeys(NAMES, 4.0) | dict(thresholds or {})
    tests, after = SimpleNamespace(fit=SimpleNamespace(model=()), effects=()), SimpleNamespace(family=family)
    search = Search(tests, lambda _line: None)
    search.tests_after, search.of_one_force = (lambda _fit: after), -math.inf
    for hypothesis in known:
        search._keep_best(hypothesis)
    return search


def pairs(worth: float) -> list[LikelihoodRatio]:
    """The three pairs of a triple, one of which is worse than it by so many standard deviations, the others by 30."""
    falls = zip(NAMES, (30.0, 30.0, worth), strict=True)
    return [of([name for name in NAMES if name != out], TRIPLE - fall**2 / 2) for out, fall in falls]


def worth_of_the_last(triple: LikelihoodRatio, sets: Search) -> float:
    return selection._worth(triple, sets.subset(triple, triple.effects[:2], again=True), triple.effects[2:])


@pytest.fixture(autouse=True)
def no_refit_succeeds(monkeypatch):
    """Likelihoods and scatter are given; some tests replace this, and campaigns, made once, come before it."""
    monkeypatch.setattr(Search, "_refit", lambda *_, **_how: None)
    monkeypatch.setattr(selection, "robust_ratio", lambda *_: 1.0)


@pytest.mark.parametrize(("worth", "enough"), [(3.0, False), (3.9, False), (4.1, True)])
def test_each_member_of_three_is_worth_its_threshold_beside_the_others(worth, enough):
    triple, sets = of(NAMES, TRIPLE), sets_of(pairs(worth))
    assert worth_of_the_last(triple, sets) == pytest.approx(worth)
    told = sets.superfluous(triple)
    assert bool(told) != enough
    if not enough:
        assert (told.code, told.facts["effect"]) == ("too_weak_in_set", "tail_friction")
        assert (told.facts["sigmas"], told.facts["required"]) == (pytest.approx(worth), 4.0)
    # One that is tried in many shapes is asked for its own threshold.
    assert not sets_of(pairs(6.5), {"tail_friction": 6.4}).superfluous(triple)
    assert sets_of(pairs(6.5), {"tail_friction": 6.6}).superfluous(triple).facts["required"] == 6.6
    sets = sets_of(pairs(30.0))
    for sets.of_one_force, code in ((TRIPLE - 4.6, ""), (TRIPLE - 4.4, "one_force_is_as_likely")):
        assert sets.superfluous(triple).code == code


@pytest.mark.parametrize(("scattered", "worth"), [(2, 5.5), (0, 11.0)])
def test_a_member_is_worth_half_where_trials_scatter_twice_as_widely_in_its_own_size(scattered, worth, monkeypatch):
    monkeypatch.setattr(selection, "robust_ratio", lambda _, names: 2.0 if NAMES[scattered] in names else 1.0)
    triple, sets = of(NAMES, TRIPLE, inflation=4.0), sets_of(pairs(11.0))
    assert worth_of_the_last(triple, sets) == pytest.approx(worth)
    assert not sets.superfluous(triple)
    assert bool(sets_of(pairs(11.0), dict.fromkeys(NAMES, 6.0)).superfluous(triple)) == (worth < 6)


@pytest.mark.parametrize(
    ("gain", "scattered", "better"),
    [(4.9, "", False), (5.1, "", True), (9.9, "leak", False), (10.1, "leak", True), (5.1, "air_drag", True)],
)
def test_a_larger_set_is_better_by_more_than_chance_gives_its_further_effect(gain, scattered, better, monkeypatch):
    """And by twice as much where the size that it adds scatters twice as widely, not another."""
    monkeypatch.setattr(selection, "robust_ratio", lambda _, names: 2.0 if scattered in names else 1.0)
    sets = sets_of([of(NAMES[:1], TRIPLE - 50), of(NAMES[1:2], TRIPLE - 60)], {NAMES[1]: 5.0})
    inflation = 4.0 if scattered else 1.0
    assert sets.is_better(of(NAMES[:2], TRIPLE - 50 + gain**2 / 2, inflation=inflation)) == better


def test_a_set_that_ends_higher_from_a_larger_one_is_tested_again(monkeypatch):
    search = sets_of([of(NAMES[:1], -100.0)])
    search.grow = lambda _: search._keep_best(of(NAMES[1:2], -50.0)) or [of(NAMES[:2], -49.0)]
    told = {"adequate_hypotheses": lambda known, _: (known[:1], {}, "after"), "_rounds": lambda *told: told[2]}
    for name, function in told.items():
        monkeypatch.setattr(selection, name, function)
    assert [one.names for one in selection._effect_set_rounds(search, [])] == [NAMES[1:2]]


def test_sizes_of_several_vines_are_as_many_degrees_of_freedom():
    names = (*NAMES[:2], "film_mass")
    numbers = tuple(SimpleNamespace(key=key) for key in ("film_mass.eps",) * 3 + ("leak.rate", "air_drag.C_D"))
    triple = of(names, TRIPLE, numbers=numbers)
    sets = sets_of([of(NAMES[:2], TRIPLE - 36.5 / 2)], dict.fromkeys(names, 4.0))
    expected = -norm.ppf(chi2.sf(36.5, 3) / 2)
    assert worth_of_the_last(triple, sets) == pytest.approx(expected)
    assert expected < 6 < math.sqrt(36.5)
    assert sizes_of(triple.effects, triple.fit) == 5
    assert sets.is_better(triple, sets.of_size(2)[0]) == (expected >= 4.0)


@pytest.mark.parametrize("delta_chi2", [30.0, 600.0, 1420.0, 1500.0, 4e4])
@pytest.mark.parametrize("degrees", [1, 2, 5])
def test_significance_is_that_of_the_tail_however_far_out(delta_chi2, degrees):
    sigmas = in_sigmas(delta_chi2, degrees)
    if degrees == 1:
        assert sigmas == pytest.approx(math.sqrt(delta_chi2))
        return
    assert sigmas < in_sigmas(delta_chi2, degrees - 1)
    if degrees == 2:  # P(χ²₂ > x) = exp(−x/2), so the logarithms of both tails agree
        assert math.log(2) + norm.logsf(sigmas) == pytest.approx(-delta_chi2 / 2, rel=1e-9)


@pytest.mark.parametrize(("end", "needed"), [(TRIPLE - 450.0, True), (TRIPLE - 2.0, False)])
def test_a_known_pair_in_a_local_minimum_does_not_make_the_third_look_needed(monkeypatch, end, needed):
    """All pairs are known, 30 σ below the triple; the last one ends higher when it is fitted from the triple."""

    def refit(sets: Search, _fit, effects, **_how) -> None:
        names = tuple(effect.name for effect in effects)
        sets._keep_best(of(names, end if {*names} == {*NAMES[:2]} else TRIPLE - 450.0))

    monkeypatch.setattr(Search, "_refit", refit)
    assert bool(sets_of(pairs(30.0)).superfluous(of(NAMES, TRIPLE))) != needed


@pytest.mark.parametrize(("size", "end", "higher"), [(0.1, -900.0, True), (0.1, -999.5, False), (2.1, -900.0, False)])
def test_where_effects_of_no_size_gain_the_model_itself_is_fitted_again_from_there(monkeypatch, size, end, higher):
    sizes = {"air_drag.C_D": size, "supply_refill.tau": size, "reservoir_depletion.gamma": 700.0}
    numbers = [SimpleNamespace(key=key, value=value, sigma=1.0) for key, value in sizes.items()]
    search, fit = sets_of([]), SimpleNamespace(log_likelihood=end)
    search.before = of((), -1000.0).fit
    search.before.predictor.layout = SimpleNamespace(between=())
    monkeypatch.setattr(selection, "full_fit", lambda *_, **_how: fit)
    drag, *chamber = (replace(of([key.split(".")[0]], -890.0, numbers=numbers), delta_chi2=220.0) for key in sizes)
    # A supply that never refills the chamber, by chance no less likely than none, is there all the same.
    assert [search.higher_base(those) is fit for those in ([drag], chamber)] == [higher, False]


def test_the_limit_of_an_effect_is_fitted_from_where_that_ended(monkeypatch):
    """A chamber whose supply never refills it is one that empties."""
    refill, limit, begun = of(["supply_refill"], -900.0), find_effect("reservoir_depletion"), []
    refill.fit.model = SimpleNamespace(values={"supply_refill.gamma": 1.25, "supply_refill.tau": 3500.0})
    search = sets_of([refill])
    search.tests.effects = (limit, find_effect("leak"))
    monkeypatch.setattr(Search, "_refit", lambda *given, start: begun.append((given[2], start)))
    search._fit_contained(refill)
    assert begun == [([limit], {"reservoir_depletion.gamma": 1.25})]


def asked(*names: str, **how: bool) -> result.Diagnosis:
    return vt.diagnose(hidden(TRUTH | LATCH, seed=7200, trials=tubes()[::2]), candidates=names, **how)


@pytest.fixture(scope="module")
def three_missing():
    return asked(*CANDIDATES, ladder=False, advice=False)


@pytest.fixture(scope="module")
def one_not_asked():
    return asked(*(name for name in CANDIDATES if name != "latch_release"))


def stored(said: result.Diagnosis) -> result.Diagnosis:
    return result.Diagnosis.from_json(json.loads(json.dumps(said.to_json(), default=str)))


@pytest.mark.slow
def test_three_effects_are_found_one_after_the_other(three_missing):
    assert three_missing.verdict == "missing"
    assert set(three_missing.effects) == {"reservoir_depletion", "tail_friction", "latch_release"}
    assert three_missing.final_verdict == "adequate"
    assert [len(step.model) for step in three_missing.rounds] == [4, 5, 6, 7]
    assert set(three_missing.rounds[0].sets[0]) == set(three_missing.effects)
    assert [step.sets for step in stored(three_missing).rounds] == [step.sets for step in three_missing.rounds]
    numbers = {number.key: number for number in three_missing.parameters}
    for key, size in TRUTH.items():
        assert abs(numbers[key].value - size) < 4 * numbers[key].sigma


@pytest.mark.parametrize(
    ("gained", "named"),
    [(970.0, [("artefact", "lens")]), (930.0, [("missing", "latch_release"), ("artefact", "lens")])],
)
def test_a_lens_that_mends_nearly_all_comes_before_what_its_next_term_looks_like(monkeypatch, gained, named):
    latch, lens = SimpleNamespace(name="latch_release", kind=""), SimpleNamespace(name="lens", kind="measurement")
    singles = [SimpleNamespace(names=(e.name,), delta_chi2=gain) for e, gain in ((latch, 900.0), (lens, gained))]
    pair = SimpleNamespace(names=("latch_release", "lens"), effects=(latch, lens), delta_chi2=1000.0, fit=None)
    after = SimpleNamespace(fit=None)
    search = SimpleNamespace(tests=after, subset=lambda *_: None, tests_after=lambda _: after)

    def ratio(_before, effects, fit):
        return SimpleNamespace(names=tuple(effect.name for effect in effects), effects=tuple(effects), fit=fit)

    monkeypatch.setattr(selection, "likelihood_ratio", ratio)
    monkeypatch.setattr(selection, "SelectionStep", lambda verdict, *parts, **_: (verdict, *parts[4]))
    assert selection._rounds(search, singles, [pair], {}, after) == named  # type: ignore[arg-type]


@pytest.mark.slow
def test_what_lacks_an_effect_that_is_not_asked_stays_unexplained_and_shows_partial_steps(one_not_asked):
    assert one_not_asked.verdict == "unexplained"
    assert one_not_asked.effects == one_not_asked.answer_set == ()
    assert one_not_asked.missing_force is not None
    steps, ladder = [step.effect for step in one_not_asked.rounds[0].partial], one_not_asked.ladder
    assert len(one_not_asked.force.learned.table)
    assert steps
    assert tuple(ladder.columns) == LADDER_COLUMNS
    assert ladder["partial"].tolist() == [False, *[True] * len(steps)]
    assert ladder["added"].tolist() == ["", *steps]
    assert ladder["rms_in_sample_m"].iloc[-1] < ladder["rms_in_sample_m"].iloc[0]
    assert [one.effect for one in stored(one_not_asked).rounds[0].partial] == steps
