"""A force learned as a smooth function: its algebra against closed forms, and a hidden force with its variables."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from grown import grown, hidden_force, pairs_of, sheet
from scipy.interpolate import BSpline

import vinetrack as vt
from vinetrack.diagnosis.force_inversion import splines, uniform_splines
from vinetrack.diagnosis.force_surface import (
    CONSTANT_AT_START,
    FREE_AT_START,
    ZERO_AT_START,
    Domain,
    SmoothForce,
    covariance_modes,
)
from vinetrack.diagnosis.learned_force import LEARNED_COLUMNS, dependent_variables
from vinetrack.diagnosis.missing_force import missing_force
from vinetrack.diagnosis.propose import Proposal, propose
from vinetrack.effects import State

GROWTH = Domain(("growth",), (0.0,), (0.25,), (12,), (math.inf,))
BOTH = Domain(("growth", "speed"), (0.0, 0.0), (0.25, 8.0), (12, 8), (math.inf, math.inf))


FAR = math.sqrt(5) / 0.4
ALIKE = (1 + FAR + FAR**2 / 3) * math.exp(-FAR)
"""Covariance of the ends of a variable at a length of 0.4: Rasmussen & Williams 2006, eq. 4.17."""


def test_the_process_has_the_matern_covariance() -> None:
    directions, variances = covariance_modes(12, 0.4)
    covariance = (directions * variances) @ directions.T
    assert np.diag(covariance) == pytest.approx(np.ones(12))
    # First and last splines lie at the ends: one whole apart.
    assert covariance[0, -1] == pytest.approx(ALIKE)


def test_a_process_that_is_zero_at_the_start_is_conditioned_on_its_first_value() -> None:
    directions, variances = covariance_modes(12, 0.4, zero_at_start=True)
    covariance = (directions * variances) @ directions.T
    assert covariance[0] == pytest.approx(np.zeros(12), abs=1e-12)
    assert covariance[-1, -1] == pytest.approx(1 - ALIKE**2)


def test_a_surface_meets_its_start_condition() -> None:
    """Where growth begins: zero, a constant, or any function of the speed."""
    speeds = np.linspace(0, 8, 9)
    begins = BOTH.basis([np.zeros(9), speeds])
    draw = np.random.default_rng(5)
    for name, spread in ((ZERO_AT_START, False), (CONSTANT_AT_START, False), (FREE_AT_START, True)):
        mix = BOTH.prior_modes((0.25, 0.25), name)
        at_start = begins @ mix @ draw.standard_normal(mix.shape[1])
        assert (np.ptp(at_start) > 0.1) == spread
        assert (np.abs(at_start).max() < 1e-9) == (name == ZERO_AT_START)


def test_growth_or_else_time_marks_the_start_of_growth() -> None:
    assert [replace(BOTH, variables=names).start_axis for names in (("growth", "time"), ("speed", "time"))] == [0, 1]
    assert replace(BOTH, variables=("speed", "pressure")).start_conditions == (FREE_AT_START,)
    assert GROWTH.start_conditions == (ZERO_AT_START, CONSTANT_AT_START)


@pytest.mark.parametrize("domain", [GROWTH, BOTH])
def test_splines_sum_to_one_and_are_constant_outside_the_visited_range(domain: Domain) -> None:
    inside = [np.linspace(low, high, 7) for low, high in zip(domain.low, domain.high, strict=True)]
    assert domain.basis(inside).sum(axis=1) == pytest.approx(np.ones(7))
    beyond = [np.array([high, 2 * high]) for high in domain.high]
    at_end, further = domain.basis(beyond)
    assert at_end == pytest.approx(further)


@pytest.mark.parametrize("knots", [np.linspace(0, 1, 18), np.array([0, 0.01, 0.05, 0.3, 0.5, 1.0])])
def test_splines_equal_those_of_scipy(knots: np.ndarray) -> None:
    at = np.concatenate([np.random.default_rng(6).uniform(-0.2, 1.2, 300), knots])
    ends = np.concatenate([[0.0] * 3, knots, [1.0] * 3])
    expected = BSpline.design_matrix(np.clip(at, 0, 1), ends, 3).toarray()
    assert splines(at, knots) == pytest.approx(expected, abs=1e-14)


def test_the_sparse_sum_of_spline_products_equals_the_full_one() -> None:
    draw = np.random.default_rng(7)
    at = [draw.uniform(0, 0.3, 50), draw.uniform(0, 9, 50)]
    coefficients = draw.standard_normal(BOTH.size)
    assert BOTH.evaluate(at, coefficients) == pytest.approx(BOTH.basis(at) @ coefficients, abs=1e-13)
    alone = [uniform_splines(part, count) for part, count in zip(BOTH.normalised(at), BOTH.counts, strict=True)]
    expected = np.einsum("na,nb->nab", *alone).reshape(50, -1)
    assert BOTH.basis(at) == pytest.approx(expected, abs=1e-15)


def test_speeds_are_on_a_logarithmic_scale_above_their_median() -> None:
    (parts,) = replace(GROWTH, log_scale=(0.01,)).normalised([np.array([0.0, 0.01 * (math.sqrt(26) - 1), 0.25])])
    assert parts == pytest.approx([0.0, 0.5, 1.0])


def test_a_surface_reproduces_a_function_linear_in_both_variables() -> None:
    """With its values at the centres of the splines as coefficients, the function is reproduced exactly."""
    u, v = (np.linspace(0, 1, count) for count in (101, 101))
    places = [np.linalg.lstsq(uniform_splines(u, count), u, rcond=None)[0] for count in BOTH.counts]
    coefficients = (2 * places[0][:, None] - 3 * places[1]).ravel()
    motion = SimpleNamespace(lead_position_m=0.25 * u, tail_velocity_m_s=8.0 * v[::-1])
    force = SmoothForce(BOTH, coefficients[:, None]).unit_force(motion)[:, 0]  # type: ignore[arg-type]
    assert force == pytest.approx(2 * u - 3 * v[::-1])


def test_a_variable_that_is_a_function_of_others_is_recognised() -> None:
    """Trials at constant but different speeds: time is growth over speed, but speed is not a function of growth."""
    duration_s = np.linspace(0, 1, 80)
    motions = [
        SimpleNamespace(
            time_s=(0.25 / speed) * duration_s,
            counts_until_s=math.inf,
            lead_position_m=0.25 * duration_s,
            tail_velocity_m_s=np.full(80, speed),
        )
        for speed in (2.0, 3.0, 4.5, 6.0, 7.5)
    ]
    time, speed = (replace(GROWTH, variables=(name,), high=(high,)) for name, high in (("time", 0.125), ("speed", 8.0)))
    assert dependent_variables(BOTH, [GROWTH, time, speed], motions) == ["time"]  # type: ignore[arg-type]
    assert dependent_variables(GROWTH, [GROWTH, speed], motions) == []  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def proposal(tmp_path_factory: pytest.TempPathFactory) -> Proposal:
    """For vines with a force in waves of decreasing length along the growth, which no formula reproduces."""
    pairs = hidden_force(sheet((4,), replicates=2), 131, "waves", -0.3, tmp_path_factory.mktemp("waves"))
    return propose(vt.base_model(), pairs, lambda _: None)


def test_a_force_without_a_formula_is_proposed_as_a_table_that_explains_the_misfit(proposal: Proposal) -> None:
    table = proposal.table
    assert table is not None
    assert table.effect.name == "learned_growth"
    size = next(number for number in table.ratio.fit.numbers if number.key == "learned_growth.a")
    assert size.value == pytest.approx(1.0, abs=0.1)
    assert table.ratio.fit.chi2_per_dof < 1.5 < proposal.before.chi2_per_dof
    assert "No formula in the list reproduces the learned force." in proposal.sentences()[-1]
    zero = State(*(0.0,) * len(State._fields))
    assert math.isfinite(table.effect.functions["tail_force"](zero, None, 1.0))


def test_waves_along_the_growth_are_learned_with_their_variable_and_their_size(proposal: Proposal) -> None:
    assert proposal.table is not None
    learned = proposal.table.learned
    assert learned.domain.variables == ("growth",)
    assert sum(learned.weights.values()) == pytest.approx(1.0)
    assert tuple(learned.table.columns) == LEARNED_COLUMNS
    grid = learned.table[(learned.table["condition"] == "") & (learned.table["trials"] > 0)]
    y = grid["lead_position_m"].to_numpy(float)
    middle = (y > np.quantile(y, 0.05)) & (y < np.quantile(y, 0.95))
    true_N = -0.3 * np.sin(2 * math.pi * (y / 0.12) ** 1.5)
    # A constant is taken over by the yield pressure.
    off = grid["force_N"].to_numpy(float) - true_N
    assert np.mean(np.abs(off - np.median(off))[middle] < 0.06) > 0.8
    assert np.isnan(grid["pressure_Pa"]).all()


def test_the_learned_force_states_its_variables_and_is_written_to_json(proposal: Proposal) -> None:
    assert proposal.table is not None
    force = missing_force(proposal.before, learn=False)
    content = json.loads(json.dumps(replace(force, learned=proposal.table.learned).to_json()))["learned"]
    assert content["variables"] == ["growth"]
    assert "is described by the growth" in content["sentence"]
    assert set(content["length_scales"]) == {"growth"}
    assert force.to_json()["learned"] is None


def test_no_force_is_learned_where_nothing_is_missing() -> None:
    fit = vt.fit(vt.base_model(), pairs_of(grown(sheet((4,)), 132)), profile=False)
    assert missing_force(fit).learned is None
