"""Wear, tubes and exponents that differ between trials are named as such, and physics keeps its name beside them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from grown import Pairs, pairs_of, sheet

import vinetrack as vt
from vinetrack.core.records import Trial
from vinetrack.diagnosis.between_trials import between_fits, confounded, differences, significant
from vinetrack.diagnosis.likelihood_ratio import MAX_INFLATION, Difference, LikelihoodRatio, robust_ratio
from vinetrack.diagnosis.result import ADEQUATE, AMBIGUOUS, ARTEFACT, MISSING, Diagnosis
from vinetrack.diagnosis.selection import verdict_of
from vinetrack.effects import find_effect
from vinetrack.inference.fit import fit, refit
from vinetrack.inference.fit_result import EXPONENT, Fit
from vinetrack.laboratory.tracks import BASE, GroundTruth, damping_values, grow

B = "eversion_damping.B"
Change = Callable[[Trial, int], float]


def made(trials: Sequence[Trial], order: Sequence[int], factor: Change, seed: int, **more: float) -> Pairs:
    """Trials made in this order, B of each multiplied by `factor(trial, uses of its vine before)`."""
    pairs: dict[int, tuple] = {}
    uses: dict[str, int] = {}
    values = damping_values(trials)
    for place, i in enumerate(order):
        trial, seen = trials[i], uses.get(trials[i].vine, 0)
        uses[trial.vine] = seen + 1
        change = factor(trial, seen)
        held = {**values, B: {vine: change * size for vine, size in values[B].items()}}
        nature = GroundTruth(
            effects=BASE, values=held, seed=1000 * seed + place,
            **{"damping_scatter": 0.005, "pressure_scatter": 0.003, "yield_error_kPa": 0.0, **more},
        )  # fmt: skip
        (one,) = pairs_of(grow([trial], nature))
        pairs[i] = (replace(one[0], order=float(place + 1)), one[1])
    return [pairs[i] for i in range(len(trials))]


def misread(trials: Sequence[Trial], true: Sequence[Trial], seed: int) -> Pairs:
    """Trials made in the order of the sheet at their true pressures, which the sheet does not state."""
    pairs = made(true, range(len(true)), lambda _, __: 1.0, seed=seed)
    return [
        (replace(trial, pressure_Pa=known.pressure_Pa), track)
        for known, (trial, track) in zip(trials, pairs, strict=True)
    ]


def shuffled(count: int, seed: int) -> list[int]:
    return [int(i) for i in np.random.default_rng(seed).permutation(count)]


PHYSICS = ("reservoir_depletion", "tail_friction", "air_drag", "length_scale")
"""Where one effect beside the differences is the point; what the catalogue does to a verdict, others ask."""


def diagnosed(pairs: Pairs, candidates: Sequence[str] | None = None) -> Diagnosis:
    return vt.diagnose(pairs, candidates=candidates, ladder=False, advice=False)


@pytest.fixture(scope="module")
def trials() -> list[Trial]:
    return sheet((2, 4), replicates=3)


@pytest.fixture(scope="module")
def worn(trials: list[Trial]) -> Pairs:
    """B rises by 2 % with every use of a tube, pressures in rising order."""
    return made(trials, range(len(trials)), lambda _, seen: 1 + 0.02 * seen, seed=1)


@pytest.mark.slow
def test_a_supply_that_empties_while_pressures_rise_is_named_with_its_rate(trials: list[Trial]) -> None:
    """Each trial has 0.15 % less than the one before of what the sheet says."""
    true = [replace(trial, pressure_Pa=trial.pressure_Pa * (1 - 0.0015 * i)) for i, trial in enumerate(trials)]
    result = diagnosed(misread(trials, true, seed=7), (*PHYSICS, "pressure_gain", "film_mass"))
    assert result.verdict in (ARTEFACT, AMBIGUOUS)
    assert "order_drift" in result.answer_set
    (drift,) = next(row for row in result.rounds[0].ranking if row.effect == "order_drift").numbers
    assert drift.key == "order_drift.P"
    assert abs(drift.value + 0.0015) < 3 * drift.sigma < 0.001


@pytest.mark.slow
def test_a_regulator_set_anew_in_mid_campaign_is_named_with_its_step_and_its_trial(trials: list[Trial]) -> None:
    """From the eleventh trial on the tube gets 4 % less than the sheet says, pressures rising."""
    true = [replace(trial, pressure_Pa=trial.pressure_Pa * (0.96 if i >= 10 else 1)) for i, trial in enumerate(trials)]
    result = diagnosed(misread(trials, true, seed=8), (*PHYSICS, "pressure_gain", "film_mass"))
    assert result.verdict in (ARTEFACT, AMBIGUOUS)
    assert "order_drift" in result.answer_set
    (step,) = next(row for row in result.rounds[0].ranking if row.effect == "order_drift").numbers
    assert step.key == "order_drift.step"
    assert abs(step.value - np.log(0.96)) < 3 * step.sigma < 0.02
    assert step.vine == f"from {trials[10].name} on"


@pytest.mark.slow
def test_a_regulator_set_anew_every_day_is_named_by_its_gains(trials: list[Trial]) -> None:
    """Three days, pressures rising; the tube gets 5 % more on the second and 4 % less on the third."""
    count = len(trials)
    known = [replace(trial, day=str(1 + 3 * i // count)) for i, trial in enumerate(trials)]
    gains = {"1": 1.0, "2": 1.05, "3": 0.96}
    true = [replace(trial, pressure_Pa=trial.pressure_Pa * gains[trial.day]) for trial in known]
    result = diagnosed(misread(known, true, seed=10), (*PHYSICS, "pressure_gain", "film_mass"))
    assert result.verdict in (ARTEFACT, AMBIGUOUS)
    assert "day" in result.answer_set
    numbers = next(row for row in result.rounds[0].ranking if row.effect == "day").numbers
    assert {number.key for number in numbers} == {"day.gain"}
    size = {number.vine: number.value for number in numbers}
    assert size["day 2"] - size["day 3"] == pytest.approx(np.log(1.05 / 0.96), abs=0.025)


@pytest.mark.slow
def test_the_best_of_many_places_is_no_more_than_chance(trials: list[Trial]) -> None:
    """Where nothing differs, a change may begin anywhere: what is worth as much as one chance in a thousand is rare."""
    pairs = made(trials, range(len(trials)), lambda _, __: 1.0, seed=9)
    among = {difference.name: difference for difference in differences(fit(vt.base_model(), pairs, profile=False))}
    drift = among["order_drift"]
    assert drift.n_forms >= 3
    assert drift.penalised_gain == pytest.approx(drift.gain - 2 * np.log(drift.n_forms))
    assert drift.p > 0.003


@pytest.mark.slow
def test_wear_that_only_the_order_of_the_rows_shows_is_told_beside_an_adequate_model(trials: list[Trial]) -> None:
    """It decides nothing where the sheet states no order; but B and n hold it, and a reader must know."""
    pairs = made(trials, range(len(trials)), lambda _, seen: 1 + 0.01 * seen, seed=11)
    unstated = [(replace(trial, order=np.nan), track) for trial, track in pairs]
    questioned = fit(vt.base_model(), unstated, profile=False)
    among = differences(questioned)
    apart = significant(among, 0.003)
    assert "order_drift" in {difference.name for difference in apart}
    assert not any(difference.stated for difference in apart)
    result = diagnosed(unstated, ("air_drag",))
    assert result.verdict == ADEQUATE
    assert "order" in result.explanation  # what is unstated is told beside the verdict


def other_tube(trial: Trial) -> bool:
    return trial.pressure_Pa >= (38e3 if trial.diameter_m > 0.02 else 50e3)


@pytest.mark.slow
def test_another_tube_for_high_pressures_is_named(trials: list[Trial]) -> None:
    pairs = made(trials, range(len(trials)), lambda trial, _: 1.1 if other_tube(trial) else 1.0, seed=3)
    known = [(replace(trial, specimen="b" if other_tube(trial) else "a"), track) for trial, track in pairs]
    result = diagnosed(known, PHYSICS)
    assert result.verdict in (ARTEFACT, AMBIGUOUS)
    assert "specimen" in result.answer_set


@pytest.mark.slow
def test_exponents_that_differ_by_vine_are_named(trials: list[Trial]) -> None:
    values = damping_values(trials)
    n = "eversion_damping.n"
    pairs: Pairs = []
    for vine, exponent in zip(dict.fromkeys(trial.vine for trial in trials), (0.40, 0.46), strict=True):
        nature = GroundTruth(effects=BASE, values={**values, n: exponent}, seed=4, damping_scatter=0.01)
        pairs += pairs_of(grow([trial for trial in trials if trial.vine == vine], nature))
    result = diagnosed(pairs, PHYSICS)
    assert (result.verdict, result.answer_set) == (ARTEFACT, ("n_by_vine",))
    row = next(row for row in result.rounds[0].ranking if row.effect == "n_by_vine")
    for number, exponent in zip(row.numbers, (0.40, 0.46), strict=True):
        assert abs(number.value - exponent) < 4 * number.sigma


@pytest.mark.slow
def test_depletion_keeps_its_name_in_random_order(trials: list[Trial]) -> None:
    nature = GroundTruth(effects=(*BASE, "reservoir_depletion"), values=damping_values(trials), seed=5)
    pairs = pairs_of(grow(trials, nature))
    order = shuffled(len(trials), 5)
    ordered = [(replace(trial, order=1.0 + order[i]), track) for i, (trial, track) in enumerate(pairs)]
    result = diagnosed(ordered, PHYSICS)
    assert result.verdict in (MISSING, AMBIGUOUS)
    assert "reservoir_depletion" in result.answer_set
    assert not {"order_drift", "specimen", "n_by_vine", "day"} & set(result.answer_set)


@pytest.fixture(scope="module")
def questioned(worn: Pairs) -> Fit:
    return fit(vt.base_model(), worn, profile=False)


def test_the_linear_estimate_is_what_the_refit_gains(questioned: Fit) -> None:
    drift = next(one for one in differences(questioned) if one.name == "order_drift")
    after = refit(questioned, between=drift.terms)
    assert 2 * (after.log_likelihood - questioned.log_likelihood) == pytest.approx(drift.gain, rel=0.1)
    slope = after["order_drift.B"]
    assert abs(slope.value - 0.02 / 1.1) < 0.003  # 2 % of the first B is 1.8 % of the mean
    assert drift.p < 1e-6


def test_exponents_that_scatter_more_than_the_noise_tells_are_worth_less(
    questioned: Fit, monkeypatch: pytest.MonkeyPatch
) -> None:
    by_vine = Difference("n_by_vine", shared={EXPONENT: "vine"}, gain=5.0)
    (plain,) = between_fits(questioned, [by_vine], 0.0, str)
    robust = robust_ratio(plain.fit, (EXPONENT,))
    assert robust_ratio(plain.fit, ("n_by_vine",)) == 1.0  # no number is called that
    assert abs(plain.sigma) == pytest.approx(np.sqrt(abs(plain.delta_chi2)) / robust)
    monkeypatch.setattr("vinetrack.diagnosis.likelihood_ratio.robust_ratio", lambda _, names: 3.0 * (EXPONENT in names))
    (wider,) = between_fits(questioned, [by_vine], 0.0, str)
    assert abs(wider.sigma) == pytest.approx(np.sqrt(abs(wider.delta_chi2)) / 3)
    assert wider.inflation == MAX_INFLATION


def test_only_differences_that_follow_the_conditions_are_confounded(trials: list[Trial]) -> None:
    rising = np.arange(len(trials), dtype=float)[:, None]
    assert confounded(rising, trials)
    assert not confounded(rising[shuffled(len(trials), 0)], trials)
    assert not confounded(rising % 3, trials)  # a tube for each replicate


def ratio(kind: str) -> LikelihoodRatio:
    effect = replace(find_effect("air_drag"), kind=kind)
    return LikelihoodRatio((effect,), None, 30.0, 5.0, True, "")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("kinds", "verdict"),
    [
        (("between_trials",), ARTEFACT),
        (("between_trials", "measurement"), ARTEFACT),
        (("between_trials", "physical"), AMBIGUOUS),
        (("physical",), MISSING),
    ],
)
def test_a_verdict_says_whether_any_physics_may_be_missing(kinds: tuple[str, ...], verdict: str) -> None:
    assert verdict_of([ratio(kind) for kind in kinds]) == verdict
