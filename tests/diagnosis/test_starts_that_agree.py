"""A hypothesis worse than the smaller model in it is begun elsewhere, until two starts end in the same place."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import pytest

from vinetrack.diagnosis.candidate_fits import CandidateFits
from vinetrack.diagnosis.multi_start import SubsetFit
from vinetrack.effects import catalogue

LEAK = SubsetFit((catalogue()["leak"],), math.nan, {"leak.rate": 1.0})
"""From what its linear promise says."""


def search(monkeypatch: pytest.MonkeyPatch, ends: list[float]) -> tuple[CandidateFits, list[float]]:
    """A search whose fits end at these Δχ² in turn, and the sizes of the leak that they begin from."""
    tried = object.__new__(CandidateFits)
    tried.same_end, begun = set(), []

    def from_climb(_: Any, climb: SubsetFit, *best: float, afresh: bool = False, **led: bool) -> Any:  # noqa: ARG001
        begun.append(math.inf if afresh else climb.values["leak.rate"])
        return SimpleNamespace(delta_chi2=ends[len(begun) - 1])

    monkeypatch.setattr(CandidateFits, "_from_climb", from_climb)
    monkeypatch.setattr(CandidateFits, "_smallest", lambda *_: {"leak.rate": 1e-3})
    return tried, begun


def test_two_starts_that_end_in_the_same_place_are_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    tried, begun = search(monkeypatch, [-6.2])
    first: Any = SimpleNamespace(delta_chi2=-6.5)
    assert tried._begun_again(LEAK, first, 0.0, led=True).delta_chi2 == -6.2
    assert begun == [1e-3]
    # From its other shapes it is fitted once each, and not begun again.
    assert tried._begun_again(LEAK, first, 0.0, led=True) is first
    assert begun == [1e-3]


def test_a_start_where_it_hardly_acts_is_not_made_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    tried, begun = search(monkeypatch, [12.0])
    small = SubsetFit(LEAK.effects, math.nan, {"leak.rate": 1e-3})
    first: Any = SimpleNamespace(delta_chi2=-6.5)
    assert tried._begun_again(small, first, 0.0, led=True).delta_chi2 == 12.0
    assert begun == [math.inf]


def test_starts_that_end_apart_are_followed_by_one_with_nothing_taken_over(monkeypatch: pytest.MonkeyPatch) -> None:
    tried, begun = search(monkeypatch, [3.0, 40.0])
    first: Any = SimpleNamespace(delta_chi2=-6.5)
    assert tried._begun_again(LEAK, first, 0.0, led=True).delta_chi2 == 40.0
    assert begun == [1e-3, math.inf]
    assert not tried.same_end
