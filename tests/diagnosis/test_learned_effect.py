"""A learned force as a table in an effect file, and the variables that it may depend on."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from vinetrack.diagnosis.force_surface import ZERO_AT_START, Domain, SmoothForce
from vinetrack.diagnosis.learned_force import ForcePosterior, LearnedForce, dependence, not_excluded
from vinetrack.diagnosis.propose import table_name, table_text, uniform_table
from vinetrack.effects import own_effects

DOMAINS = [
    Domain(("growth",), (0.0,), (0.25,), (24,), (math.inf,)),
    Domain(("growth", "speed"), (0.0, 0.0), (0.25, 8.0), (12, 8), (math.inf, 1.3)),
    Domain(("time", "pressure"), (0.0, 1e4), (0.4, 3e4), (8, 5), (0.1, math.inf)),
]


def learned(domain: Domain, seed: int) -> LearnedForce:
    """A force with arbitrary coefficients over a domain."""
    coefficients = np.random.default_rng(seed).standard_normal(domain.size)
    places = {
        "lead_position_m": [0.1, 0.2],
        "tail_velocity_m_s": [2.0, 3.0],
        "time_s": [0.1, 0.2],
        "pressure_Pa": [2e4, 2.5e4],
    }
    table = pd.DataFrame({**places, "force_N": [-0.1, -0.3], "sigma_N": 0.01, "trials": [2, 3], "condition": ["", ""]})
    surface, lengths = SmoothForce(domain, np.eye(domain.size)), (1.0,) * len(domain.variables)
    best = ForcePosterior(ZERO_AT_START, 50.0, surface, lengths, coefficients, np.eye(domain.size) * 1e-4, 1.0)
    return LearnedForce(best, (), {domain.name: 1.0}, (), 50.0, 0.99, table, "It depends.")


def test_a_learned_force_can_be_evaluated_with_its_error_anywhere() -> None:
    force = learned(DOMAINS[0], 3)
    at = [np.full(1, value) for value in DOMAINS[0].low]
    (value,), (sigma,) = force.best.force(at)
    # At the edge the first spline alone is not nothing, and it is 1.
    assert value == pytest.approx(force.best.mean[0])
    assert sigma == pytest.approx(0.01)


@pytest.mark.parametrize("domain", DOMAINS, ids=lambda domain: domain.name)
def test_the_effect_file_reproduces_the_learned_force_over_the_visited_range(domain: Domain, tmp_path: Path) -> None:
    force = learned(domain, 4)
    path = tmp_path / f"{table_name(force)}.py"
    path.write_text(table_text(force, "From 24 trials of a bench."), encoding="utf-8")
    effect = own_effects([path])[path.stem]
    assert "From 24 trials of a bench." in effect.text
    assert "no law" in effect.summary
    draw = np.random.default_rng(5)
    at = [
        draw.uniform(low - 0.1 * (high - low), high * 1.2, 40)
        for low, high in zip(domain.low, domain.high, strict=True)
    ]
    names = {"growth": "lead_position", "speed": "tail_velocity", "time": "time", "pressure": "pressure"}
    state = SimpleNamespace(**{names[name]: value for name, value in zip(domain.variables, at, strict=True)})
    expected = domain.basis(at) @ force.best.mean
    shown = effect.functions["tail_force"](state, None, 1.0)
    assert shown == pytest.approx(expected, abs=1e-4 * np.abs(expected).max())
    assert effect.functions["tail_force"](state, None, 0.0) == pytest.approx(0.0 * expected)


def test_even_splines_reproduce_a_constant() -> None:
    assert uniform_table(DOMAINS[1], np.full(DOMAINS[1].size, 0.7)) == pytest.approx(0.7)


def test_choices_are_excluded_by_their_misfit_and_not_by_their_smoothness() -> None:
    """Trials of constant speed: a force over growth and time is a force over growth and speed."""
    growth = replace(DOMAINS[0], counts=(12,))
    time, speed = (replace(growth, variables=(name,), high=(high,)) for name, high in (("time", 0.125), ("speed", 8.0)))
    pairs = [
        replace(
            growth, variables=pair, low=(0.0, 0.0), high=(0.25, high), counts=(12, 8), log_scale=(math.inf, math.inf)
        )
        for pair, high in ((("growth", "speed"), 8.0), (("growth", "time"), 0.125))
    ]
    part = np.linspace(0, 1, 80)
    motions = [
        SimpleNamespace(
            time_s=0.25 / v * part,
            counts_until_s=math.inf,
            lead_position_m=0.25 * part,
            tail_velocity_m_s=np.full(80, v),
        )
        for v in (2.0, 3.0, 4.5, 6.0, 7.5)
    ]
    every = [growth, time, speed, *pairs]

    def kept(weights: dict[str, float], losses: dict[str, float], best: Domain = pairs[1]) -> list[str]:
        return not_excluded(best, weights, losses, 9.0, every, motions)  # type: ignore[arg-type]

    followed = {"growth+time": 0.999, "growth+speed": 0.001, "growth": 0.0}
    assert kept(followed, {"growth+time": 0.0, "growth+speed": 4.0, "growth": 400.0}) == ["growth+speed"]
    assert kept(followed, {"growth+time": 0.0, "growth+speed": 90.0, "growth": 400.0}) == []
    assert kept({"growth+time": 1.0, "growth": 0.0}, {"growth+time": 0.0, "growth": 400.0}) == ["growth+speed"]
    assert kept({"growth": 0.99, "growth+time": 0.01}, {"growth": 0.0, "growth+time": -3.0}, growth) == []


def test_the_sentence_lists_the_variables_that_trials_cannot_distinguish() -> None:
    weights = {"growth+time": 0.74, "growth+speed": 0.26}
    both = dependence("growth+time", weights, ["growth+speed"])
    assert both.endswith(
        "is described by the growth, and by the time since release (74%) or the speed of the tail (26%):"
        " these trials do not tell which"
    )
    assert dependence("growth", {"growth": 0.97}, []).endswith("is described by the growth (posterior weight 97%)")
    assert "is most likely described by the time" in dependence("time", {"time": 0.9}, [])
    unlike = dependence("growth", {"growth": 0.6}, ["speed+time"])
    assert "by the growth (60%) or by the speed of the tail and the time since release:" in unlike
