"""What a member of a set of effects is worth, from likelihoods that are given."""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import pytest

from vinetrack.diagnosis import effect_sets
from vinetrack.diagnosis.effect_sets import EffectSets
from vinetrack.diagnosis.family_test import FamilyTest
from vinetrack.diagnosis.likelihood_ratio import LikelihoodRatio
from vinetrack.effects import find_effect

NAMES = ("air_drag", "leak", "tail_friction")
TRIPLE = -1000.0


def of(names: tuple[str, ...], log_likelihood: float, inflation: float = 1.0) -> LikelihoodRatio:
    fit: Any = SimpleNamespace(log_likelihood=log_likelihood, model=())
    effects = tuple(find_effect(name) for name in names)
    return LikelihoodRatio(effects, fit, 0.0, 0.0, plausible=True, reason="", inflation=inflation)


def sets_of(known: list[LikelihoodRatio], thresholds: Mapping[str, float] | None = None) -> EffectSets:
    family = FamilyTest(3e-3, 1e-4, dict.fromkeys(NAMES, 4.0) | dict(thresholds or {}))
    search: Any = SimpleNamespace(
        tests=SimpleNamespace(fit=SimpleNamespace(model=()), effects=()),
        tests_after=lambda _fit: SimpleNamespace(family=family),
    )
    return EffectSets(search, known, lambda _line: None)


def pairs(worth: float) -> list[LikelihoodRatio]:
    """The three pairs of a triple, one of which is worse than it by so many standard deviations, the others by 30."""
    falls = {NAMES[0]: 30.0, NAMES[1]: 30.0, NAMES[2]: worth}
    return [of(tuple(n for n in NAMES if n != out), TRIPLE - falls[out] ** 2 / 2) for out in NAMES]


@pytest.fixture(autouse=True)
def no_refit_succeeds(monkeypatch: pytest.MonkeyPatch) -> None:
    """The likelihoods are given; tests of refits replace this."""
    monkeypatch.setattr(EffectSets, "_refitted", lambda *_: None)


@pytest.mark.parametrize(("worth", "enough"), [(3.0, False), (5.9, False), (6.1, True)])
def test_each_member_of_three_is_worth_six_standard_deviations_beside_the_others(worth: float, enough: bool) -> None:
    triple, sets = of(NAMES, TRIPLE), sets_of(pairs(worth))
    assert sets.member_sigmas(triple, triple.effects[2]) == pytest.approx(worth)
    assert bool(sets.superfluous(triple)) != enough
    if not enough:
        assert f"tail_friction reaches {worth:.1f} σ given the others, and 6.0 σ are required" in sets.superfluous(
            triple
        )


def test_a_member_is_worth_half_where_trials_scatter_twice_as_widely() -> None:
    triple, sets = of(NAMES, TRIPLE, inflation=4.0), sets_of(pairs(11.0))
    assert sets.member_sigmas(triple, triple.effects[2]) == pytest.approx(5.5)
    assert sets.superfluous(triple)


def test_a_member_that_is_tried_in_many_shapes_is_asked_for_its_own_threshold() -> None:
    triple = of(NAMES, TRIPLE)
    assert not sets_of(pairs(6.5), {"tail_friction": 6.4}).superfluous(triple)
    assert "6.6 σ are required" in sets_of(pairs(6.5), {"tail_friction": 6.6}).superfluous(triple)


@pytest.mark.parametrize(("gain", "better"), [(0.0, False), (4.9, False), (5.1, True)])
def test_a_larger_set_is_better_by_more_than_chance_gives_its_further_effect(gain: float, better: bool) -> None:
    sets = sets_of([of(NAMES[:1], TRIPLE - 50), of(NAMES[1:2], TRIPLE - 60)], {NAMES[1]: 5.0})
    assert sets.is_better(of(NAMES[:2], TRIPLE - 50 + gain**2 / 2)) == better


def test_a_smaller_set_that_is_better_than_all_of_its_size_is_followed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the pairs one was known; the best comes of taking the first effect out of the three."""
    fits = {NAMES[1:]: TRIPLE - 2.0, (NAMES[0], NAMES[2]): TRIPLE - 90.0, NAMES[:2]: TRIPLE - 45.0}
    found = {frozenset(names): log_likelihood for names, log_likelihood in fits.items()}

    def refitted(_sets: EffectSets, _fit: Any, effects: tuple[Any, ...]) -> Any:
        return SimpleNamespace(log_likelihood=found[frozenset(effect.name for effect in effects)], model=())

    def ratio(_before: Any, effects: tuple[Any, ...], fit: Any) -> LikelihoodRatio:
        return of(tuple(effect.name for effect in effects), fit.log_likelihood)

    monkeypatch.setattr(EffectSets, "_refitted", refitted)
    monkeypatch.setattr(effect_sets, "likelihood_ratio", ratio)
    sets = sets_of([of(NAMES[:2], TRIPLE - 40.0)])
    assert sets.prune(of(NAMES, TRIPLE))
    assert set(sets.of_size(2)[0].names) == set(NAMES[1:])
    assert not sets.prune(of(NAMES, TRIPLE))
    assert math.isclose(sets.of_size(2)[0].fit.log_likelihood, TRIPLE - 2.0)


@pytest.mark.parametrize(("refit", "needed"), [(TRIPLE - 450.0, True), (TRIPLE - 2.0, False)])
def test_a_known_pair_in_a_local_minimum_does_not_make_the_third_look_needed(
    monkeypatch: pytest.MonkeyPatch, refit: float, needed: bool
) -> None:
    """All pairs are known, 30 σ below the triple; the last one ends higher when it is fitted from the triple."""

    def refitted(_sets: EffectSets, _fit: Any, effects: tuple[Any, ...]) -> Any:
        last = {effect.name for effect in effects} == set(NAMES[:2])
        return SimpleNamespace(log_likelihood=refit if last else TRIPLE - 450.0, model=())

    def ratio(_before: Any, effects: tuple[Any, ...], fit: Any) -> LikelihoodRatio:
        return of(tuple(effect.name for effect in effects), fit.log_likelihood)

    monkeypatch.setattr(EffectSets, "_refitted", refitted)
    monkeypatch.setattr(effect_sets, "likelihood_ratio", ratio)
    assert bool(sets_of(pairs(30.0)).superfluous(of(NAMES, TRIPLE))) != needed
