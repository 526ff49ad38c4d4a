"""A measurement error just below its threshold is listed as worth a check; an effect is not."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from vinetrack.diagnosis.result import ADEQUATE
from vinetrack.narrative.verdict_text import explain


def round_of(effect: str, kind: str, sigma: float, level: float = 1e-4) -> SimpleNamespace:
    """A round without a finding, in which one candidate is closest to its threshold."""
    effects = [SimpleNamespace(name=effect, kind=kind), SimpleNamespace(name="leak", kind="physical")]
    tests = SimpleNamespace(
        fit=SimpleNamespace(model=SimpleNamespace(names=("gravity",)), trials=[None] * 6),
        effects=effects,
        one_sided_z=np.array([sigma, 0.5]),
        sensitivities=SimpleNamespace(effects=(effect, "leak"), silent=()),
        family=SimpleNamespace(threshold=lambda _name: 4.5),
        level=level,
        upper_limits=lambda _effect: ({}, True),
        best_z=lambda _name: (0.0, 0),
    )
    return SimpleNamespace(tests=tests, verdict=ADEQUATE, note="", unstated_differences=())


@pytest.mark.parametrize(
    ("effect", "kind", "sigma", "worth"),
    [("growth_angle", "measurement", 3.3, True), ("growth_angle", "measurement", 2.9, False),
     ("tail_friction", "physical", 4.2, False)],
)  # fmt: skip
def test_only_a_likely_slip_is_named(effect: str, kind: str, sigma: float, worth: bool) -> None:
    words = explain(round_of(effect, kind, sigma))  # type: ignore[arg-type]
    assert f"{effect}, reaches {sigma:.1f} σ" in words
    assert (f"soon checked: see `vinetrack effects {effect}`" in words) is worth


@pytest.mark.parametrize(
    ("level", "ending"),
    [(3e-3, "in one of 333 campaigns."), (1e-4, "in one of 10000 campaigns (the level once an effect was added).")],
)
def test_the_level_of_later_rounds_is_said_to_be_theirs(level: float, ending: str) -> None:
    assert explain(round_of("leak", "physical", 2.0, level)).endswith(ending)  # type: ignore[arg-type]
