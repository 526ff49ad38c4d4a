"""A hypothesis worse than the smaller model in it is begun elsewhere, until two starts end in the same place."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from vinetrack.diagnosis import candidate_fits
from vinetrack.diagnosis.candidate_fits import CandidateFits, SubsetFit
from vinetrack.effects import catalogue

LEAK = SubsetFit((catalogue()["leak"],), math.nan, {"leak.rate": 1.0})
"""From what its linear promise says."""


POINTS = 3600
"""Of all trials together."""


def ended(delta_chi2: float) -> Any:
    """A hypothesis fitted, so much better than the model without it."""
    data = [SimpleNamespace(time_s=np.zeros(POINTS))]
    return SimpleNamespace(
        delta_chi2=delta_chi2, fit=SimpleNamespace(predictor=SimpleNamespace(data=data), solution=None)
    )


def search(
    monkeypatch: pytest.MonkeyPatch, ends: list[float], *, far_off: bool = False
) -> tuple[CandidateFits, list[float]]:
    """A search whose fits end at these Δχ² in turn, and the sizes of the leak that they begin from."""
    tried = object.__new__(CandidateFits)
    tried.same_minimum, tried.started, begun = set(), {}, []
    tried.tests = cast("Any", SimpleNamespace(fit=SimpleNamespace(chi2_per_dof=100.0 if far_off else 1.0)))

    def from_climb(_: Any, climb: SubsetFit, *best: float, reset: bool = False, **rescue: bool) -> Any:  # noqa: ARG001
        begun.append(math.inf if reset else climb.values["leak.rate"])
        return ended(ends[len(begun) - 1])

    monkeypatch.setattr(candidate_fits, "is_poor_fit", lambda *_: far_off)
    monkeypatch.setattr(CandidateFits, "_fit_from", from_climb)
    monkeypatch.setattr(CandidateFits, "_negligible_sizes", lambda *_: {"leak.rate": 1e-3})
    return tried, begun


def test_two_starts_that_end_in_the_same_place_are_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    tried, begun = search(monkeypatch, [-6.2])
    first = ended(-6.5)
    assert tried._restarted(LEAK, first, 0.0, rescue=True).delta_chi2 == -6.2
    assert begun == [1e-3]
    # From its other shapes it is fitted once each, and not begun again.
    assert tried._restarted(LEAK, first, 0.0, rescue=True) is first
    assert begun == [1e-3]


def test_a_start_where_it_hardly_acts_is_not_made_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    tried, begun = search(monkeypatch, [12.0])
    small = SubsetFit(LEAK.effects, math.nan, {"leak.rate": 1e-3})
    first = ended(-6.5)
    assert tried._restarted(small, first, 0.0, rescue=True).delta_chi2 == 12.0
    assert begun == [math.inf]


def test_starts_that_end_apart_are_followed_by_one_with_nothing_taken_over(monkeypatch: pytest.MonkeyPatch) -> None:
    tried, begun = search(monkeypatch, [3.0, 40.0])
    first = ended(-6.5)
    assert tried._restarted(LEAK, first, 0.0, rescue=True).delta_chi2 == 40.0
    assert begun == [1e-3, math.inf]
    assert not tried.same_minimum


@pytest.mark.parametrize(("second", "same"), [(25.0, True), (40.0, False)])
def test_far_off_the_tracks_fits_that_miss_by_as_much_are_in_the_same_place(
    monkeypatch: pytest.MonkeyPatch, second: float, same: bool
) -> None:
    """Half a per cent of what is missed, of 3600 points: −2 ln L of 36."""
    tried, begun = search(monkeypatch, [second, 1000.0], far_off=True)
    assert tried._restarted(LEAK, ended(-6.5), 0.0, rescue=True).delta_chi2 == (second if same else 1000.0)
    assert len(begun) == (1 if same else 2)
    assert bool(tried.same_minimum) == same


def test_of_a_model_far_off_which_takes_nothing_over_a_start_is_not_made_afresh_once_more(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    tried, begun = search(monkeypatch, [40.0], far_off=True)
    assert tried._is_new_start(LEAK, rescue=True)
    assert tried._restarted(LEAK, ended(-6.5), 0.0, rescue=True).delta_chi2 == 40.0
    assert begun == [1e-3]
    assert tried.same_minimum == {"leak"}


def test_a_start_is_made_again_only_to_be_led_on(monkeypatch: pytest.MonkeyPatch) -> None:
    tried, _ = search(monkeypatch, [])
    assert tried._is_new_start(LEAK, rescue=False)
    assert not tried._is_new_start(LEAK, rescue=False)
    assert tried._is_new_start(LEAK, rescue=True)
    assert not tried._is_new_start(LEAK, rescue=True)
    assert not tried._is_new_start(LEAK, rescue=False)
    assert tried._is_new_start(LEAK, rescue=True, reset=True)
