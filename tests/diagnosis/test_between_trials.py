"""Wear, tubes and exponents that differ between trials are named as such, and physics keeps its name beside them."""

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from grown import Pairs, grown, pairs_of, sheet

import vinetrack as vt
from vinetrack.core.records import Trial
from vinetrack.diagnosis.between_trials import between_fits, confounded, differences, significant
from vinetrack.diagnosis.likelihood_ratio import Difference, robust_ratio
from vinetrack.diagnosis.result import ADEQUATE, AMBIGUOUS, ARTEFACT, MISSING, Diagnosis
from vinetrack.diagnosis.selection import verdict_of
from vinetrack.inference.fit import fit, refit
from vinetrack.inference.fit_result import EXPONENT, Number
from vinetrack.laboratory.tracks import damping_values

B = "eversion_damping.B"
Numbers = dict[str, Number]


def made(trials: Sequence[Trial], factors: Sequence[float], seed: int) -> Pairs:
    """Trials made in the order of the sheet, B of each multiplied by its factor."""
    pairs: Pairs = []
    sizes = damping_values(trials)[B]
    for place, (trial, factor) in enumerate(zip(trials, factors, strict=True)):
        held = {B: {vine: factor * size for vine, size in sizes.items()}}
        (one,) = pairs_of(grown([trial], 1000 * seed + place, (), held, damping_scatter=5e-3, pressure_scatter=3e-3))
        pairs.append((replace(one[0], order=float(place + 1)), one[1]))
    return pairs


def uses(trials: Sequence[Trial]) -> list[int]:
    return [sum(other.vine == trial.vine for other in trials[:i]) for i, trial in enumerate(trials)]


PHYSICS = ("reservoir_depletion", "tail_friction", "air_drag", "length_scale")
"""Where one effect beside the differences is the point; what the catalogue does to a verdict, others ask."""


def diagnosed(pairs: Pairs, candidates: Sequence[str] = PHYSICS) -> tuple[Diagnosis, dict[str, Numbers]]:
    said = vt.diagnose(pairs, candidates=candidates, ladder=False, advice=False)
    return said, {row.effect: {n.vine: n for n in row.numbers} for row in said.rounds[0].ranking}


@pytest.fixture(scope="module")
def trials():
    return sheet((2, 4), replicates=3)


def misread(trials: Sequence[Trial], gains: Sequence[float], seed: int) -> tuple[Diagnosis, dict[str, Numbers]]:
    """What is said where the tube gets these parts of the pressures that the sheet states."""
    true = [replace(trial, pressure_Pa=trial.pressure_Pa * gain) for trial, gain in zip(trials, gains, strict=True)]
    pairs = made(true, [1.0] * len(trials), seed)
    stated = [(replace(t, pressure_Pa=s.pressure_Pa), track) for s, (t, track) in zip(trials, pairs, strict=True)]
    return diagnosed(stated, (*PHYSICS, "pressure_gain", "film_mass"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("gain", "seed", "key", "size", "most"),
    [(lambda i: 1 - 0.0015 * i, 7, "P", -0.0015, 0.001), (lambda i: 0.96 if i >= 10 else 1, 8, "step", -0.0408, 0.02)],
    ids=["a supply that empties", "a regulator set anew"],
)
def test_what_changes_in_the_course_of_a_campaign_is_named_with_its_size(trials, gain, seed, key, size, most):
    """While pressures rise; a step with the trial from which on it holds."""
    result, sizes = misread(trials, [gain(i) for i in range(len(trials))], seed)
    assert result.verdict in (ARTEFACT, AMBIGUOUS)
    assert "order_drift" in result.answer_set
    ((begins, number),) = sizes["order_drift"].items()
    assert number.key == f"order_drift.{key}"
    assert abs(number.value - size) < 3 * number.sigma < most
    assert key == "P" or begins == f"from {trials[10].name} on"


@pytest.mark.slow
def test_a_regulator_set_anew_every_day_is_named_by_its_gains(trials):
    known = [replace(trial, day=str(1 + 3 * i // len(trials))) for i, trial in enumerate(trials)]
    result, sizes = misread(known, [{"1": 1.0, "2": 1.05, "3": 0.96}[trial.day] for trial in known], seed=10)
    assert result.verdict in (ARTEFACT, AMBIGUOUS)
    assert "day" in result.answer_set
    size = {vine: number.value for vine, number in sizes["day"].items() if number.key == "day.gain"}
    assert size["day 2"] - size["day 3"] == pytest.approx(np.log(1.05 / 0.96), abs=0.025)


@pytest.mark.slow
def test_the_best_of_many_places_is_no_more_than_chance(trials):
    """Where nothing differs, a change may begin anywhere: what is worth as much as one chance in a thousand is rare."""
    pairs = made(trials, [1.0] * len(trials), seed=9)
    among = {difference.name: difference for difference in differences(fit(vt.base_model(), pairs, profile=False))}
    drift = among["order_drift"]
    assert drift.n_forms >= 3
    assert drift.penalised_gain == pytest.approx(drift.gain - 2 * np.log(drift.n_forms))
    assert drift.p > 0.003


@pytest.mark.slow
def test_wear_that_only_the_order_of_the_rows_shows_is_told_beside_an_adequate_model(trials):
    """It decides nothing where the sheet states no order; but B and n hold it, and a reader must know."""
    pairs = made(trials, [1 + 0.01 * seen for seen in uses(trials)], seed=11)
    unstated = [(replace(trial, order=np.nan), track) for trial, track in pairs]
    apart = significant(differences(fit(vt.base_model(), unstated, profile=False)), 0.003)
    assert "order_drift" in {difference.name for difference in apart}
    assert not any(difference.stated for difference in apart)
    result, _ = diagnosed(unstated, ("air_drag",))
    assert result.verdict == ADEQUATE
    assert "order" in result.explanation  # what is unstated is told beside the verdict


@pytest.mark.slow
def test_another_tube_for_high_pressures_is_named(trials):
    other = [trial.pressure_Pa >= (38e3 if trial.diameter_m > 0.02 else 50e3) for trial in trials]
    pairs = made(trials, [1.1 if each else 1.0 for each in other], seed=3)
    known = [(replace(t, specimen="ab"[each]), track) for (t, track), each in zip(pairs, other, strict=True)]
    result, _ = diagnosed(known)
    assert result.verdict in (ARTEFACT, AMBIGUOUS)
    assert "specimen" in result.answer_set


@pytest.mark.slow
def test_exponents_that_differ_by_vine_are_named(trials):
    pairs: Pairs = []
    for vine, exponent in zip(dict.fromkeys(trial.vine for trial in trials), (0.40, 0.46), strict=True):
        of_vine, values = [trial for trial in trials if trial.vine == vine], {"eversion_damping.n": exponent}
        pairs += pairs_of(grown(of_vine, 4, (), values, damping_scatter=0.01))
    result, sizes = diagnosed(pairs)
    assert (result.verdict, result.answer_set) == (ARTEFACT, ("n_by_vine",))
    for number, exponent in zip(sizes["n_by_vine"].values(), (0.40, 0.46), strict=True):
        assert abs(number.value - exponent) < 4 * number.sigma


@pytest.mark.slow
def test_depletion_keeps_its_name_in_random_order(trials):
    pairs = pairs_of(grown(trials, 5, ["reservoir_depletion"]))
    order = np.random.default_rng(5).permutation(len(trials))
    ordered = [(replace(t, order=1.0 + float(i)), track) for i, (t, track) in zip(order, pairs, strict=True)]
    result, _ = diagnosed(ordered)
    assert result.verdict in (MISSING, AMBIGUOUS)
    assert "reservoir_depletion" in result.answer_set
    assert not {"order_drift", "specimen", "n_by_vine", "day"} & set(result.answer_set)


@pytest.fixture(scope="module")
def questioned(trials):
    """B rises by 2 % with every use of a tube, pressures in rising order."""
    return fit(vt.base_model(), made(trials, [1 + 0.02 * seen for seen in uses(trials)], seed=1), profile=False)


def test_the_linear_estimate_is_what_the_refit_gains(questioned):
    drift = next(one for one in differences(questioned) if one.name == "order_drift")
    after = refit(questioned, between=drift.terms)
    assert 2 * (after.log_likelihood - questioned.log_likelihood) == pytest.approx(drift.gain, rel=0.1)
    slope = after["order_drift.B"]
    assert abs(slope.value - 0.02 / 1.1) < 0.003  # 2 % of the first B is 1.8 % of the mean
    assert drift.p < 1e-6


def test_exponents_that_scatter_more_than_the_noise_tells_are_worth_less(questioned, monkeypatch):
    by_vine = Difference("n_by_vine", shared={EXPONENT: "vine"}, gain=5.0)
    (plain,) = between_fits(questioned, [by_vine], 0.0, str)
    robust = robust_ratio(plain.fit, (EXPONENT,))
    assert robust_ratio(plain.fit, ("n_by_vine",)) == 1.0  # no number is called that
    assert abs(plain.sigma) == pytest.approx(np.sqrt(abs(plain.delta_chi2)) / robust)
    monkeypatch.setattr("vinetrack.diagnosis.likelihood_ratio.robust_ratio", lambda _, names: 3.0 * (EXPONENT in names))
    (wider,) = between_fits(questioned, [by_vine], 0.0, str)
    assert abs(wider.sigma) == pytest.approx(np.sqrt(abs(wider.delta_chi2)) / 3)
    assert wider.inflation == pytest.approx(9.0)  # the same for significance, evidence and answer set


def test_only_differences_that_follow_the_conditions_are_confounded(trials):
    rising = np.arange(len(trials), dtype=float)[:, None]
    assert confounded(rising, trials)
    assert not confounded(rising[np.random.default_rng(0).permutation(len(trials))], trials)
    assert not confounded(rising % 3, trials)  # a tube for each replicate


@pytest.mark.parametrize(
    ("kinds", "verdict"),
    [
        (("between_trials",), ARTEFACT),
        (("between_trials", "measurement"), ARTEFACT),
        (("between_trials", "physical"), AMBIGUOUS),
        (("physical",), MISSING),
    ],
)
def test_a_verdict_says_whether_any_physics_may_be_missing(kinds, verdict):
    rivals: list[Any] = [SimpleNamespace(effects=(SimpleNamespace(kind=kind),)) for kind in kinds]
    assert verdict_of(rivals) == verdict
