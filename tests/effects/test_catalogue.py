"""The contract of an effect's file, over every file of the folder; and that what breaks it is refused with a reason."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

import vinetrack.effects as effects
from vinetrack.dynamics.model import base_model, make_model
from vinetrack.effects import (
    BASE_EFFECTS,
    Effect,
    EffectError,
    State,
    TrialInputs,
    catalogue,
    find_effect,
    load_effect,
)

FOLDER = Path(effects.__file__).parent
FILES = sorted(path for path in FOLDER.glob("*.py") if not path.stem.startswith("_"))
ALL = [load_effect(path) for path in FILES]
WORKED = [(effect, worked) for effect in ALL for worked in effect.worked]
PARAMETERS = [(effect, parameter) for effect in ALL for parameter in effect.parameters]
HOOKED = [(effect, hook) for effect in ALL for hook in effect.functions]

each_effect = pytest.mark.parametrize("effect", ALL, ids=lambda effect: effect.name)
each_hook = pytest.mark.parametrize(("effect", "hook"), HOOKED, ids=[f"{e.name}-{h}" for e, h in HOOKED])

STATE = State(
    time=0.03,
    lead_position=0.11,
    lead_velocity=2.5,
    tail_position=0.22,
    tail_velocity=5.0,
    set_pressure=28e3,
    pressure=26e3,
    yield_pressure=3e3,
    area=4.5e-4,
    linear_density=0.018,
    moving_mass=0.04,
    damping_gain=1.1,
    bend_angle=0.7,
    tail_tension=1.3,
    observed=0.108,
)
RIG = TrialInputs(
    **{
        **dict.fromkeys(TrialInputs._fields, 0.0),
        "set_pressure": 28e3,
        "yield_pressure": 3e3,
        "diameter": 0.024,
        "thickness": 2e-4,
        "length": 0.28,
        "area": 4.5e-4,
        "linear_density": 0.018,
        "mass_loss": 0.009,
        "payload_mass": 0.0356,
        "cos_angle": 1.0,
        "travel_ratio": 2.0,
        "ambient_pressure": 101_325.0,
        "chamber_volume": 1.5e-3,
        "inlet_area": 1e-4,
        "least_mass": 1e-4,
    }
)

NEUTRAL = {
    "true_time": STATE.time,
    "film_gain": 1.0,
    "gauge": STATE.pressure,
    "yield_gauge": STATE.yield_pressure,
    "area": STATE.area,
    "pressure": STATE.pressure,
    "damping_gain": STATE.damping_gain,
    "added_mass": 0.0,
    "tip_force": 0.0,
    "tail_force": 0.0,
    "rest_force": 0.0,
    "observed_position": STATE.observed,
    "row_delay": 0.0,
    "averaged_over": 0.0,
}
"""What a hook returns that changes nothing. A chamber's rate has no such number: it takes the place of another law."""


def defaults(effect: Effect) -> list[float]:
    return [parameter.default for parameter in effect.parameters]


def ask(effect: Effect, hook: str, state: State = STATE, values: list[float] | None = None):
    return effect.functions[hook](state, RIG, *(defaults(effect) if values is None else values))


# ---- the contract ----


def test_the_folder_is_the_catalogue_with_the_base_first() -> None:
    assert set(catalogue()) == {path.stem for path in FILES}
    assert tuple(catalogue())[:4] == BASE_EFFECTS
    assert "reservoir_depletion" in catalogue()


@each_effect
def test_the_name_is_that_of_the_file_and_of_the_attribute(effect: Effect) -> None:
    assert effect.name == effect.path.stem
    assert getattr(effects, effect.name) == effect == find_effect(effect.name)
    assert effect.name in dir(effects)


@each_effect
def test_the_docstring_has_a_summary_a_formula_and_a_source(effect: Effect) -> None:
    assert effect.summary.endswith(".")
    assert ":" in effect.summary
    assert effect.formula
    assert effect.formula in repr(effect)
    assert "Source:" in effect.text
    assert "Matters" in effect.text


@each_effect
def test_the_kind_agrees_with_the_hooks_and_with_being_base(effect: Effect) -> None:
    assert (effect.kind == "base") == (effect.name in BASE_EFFECTS)
    if effect.kind == "measurement":
        read_off = {"true_time", "trace_time", "observed_position", "row_delay", "gauge", "yield_gauge", "area"}
        read_off |= {"film_gain", "averaged_over"}
        # They turn, and add to, a weight and a mass that are there.
        weight = {"growth_angle": {"tail_force"}, "payload_mass": {"tail_force", "added_mass"}}
        assert set(effect.functions) <= read_off | weight.get(effect.name, set())


@each_effect
def test_every_hook_is_worked_out_by_hand(effect: Effect) -> None:
    assert {worked.hook for worked in effect.worked} == set(effect.functions)


@each_effect
def test_what_it_is_taken_for_is_an_effect_or_a_quantity_named_in_the_text(effect: Effect) -> None:
    assert all(name in catalogue() for name in effect.easily_taken_for)
    assert effect.name not in effect.easily_taken_for
    assert all(name in catalogue() for name in effect.replaces)


@pytest.mark.parametrize(("effect", "worked"), WORKED, ids=[f"{e.name}-{w.hook}-{w.how}" for e, w in WORKED])
def test_worked_numbers_agree(effect: Effect, worked) -> None:
    """What the example does not name is NaN, so that an effect cannot use what the hand-worked number left out."""
    state = State(**{**dict.fromkeys(State._fields, math.nan), **worked.state})
    rig = TrialInputs(**{**dict.fromkeys(TrialInputs._fields, math.nan), **worked.rig})
    assert set(worked.parameters) == {parameter.name for parameter in effect.parameters}
    assert worked.how
    got = effect.functions[worked.hook](state, rig, *(worked.parameters[p.name] for p in effect.parameters))
    assert worked.rel <= 1e-2
    assert got == pytest.approx(worked.expected, rel=worked.rel, abs=1e-12)


@pytest.mark.parametrize(("effect", "parameter"), PARAMETERS, ids=[f"{e.name}-{p.name}" for e, p in PARAMETERS])
def test_parameters_have_symbol_unit_meaning_and_bounds_that_hold_the_default(effect: Effect, parameter) -> None:
    assert effect.parameters.count(parameter) == 1
    assert parameter.symbol
    assert parameter.unit
    assert parameter.meaning
    low, high = parameter.bounds
    assert math.isfinite(low)
    assert math.isfinite(high)
    assert low < high
    assert low <= parameter.default <= high
    assert parameter.shared in ("all", "vine", "day")
    assert parameter.plausible is not None
    assert low <= parameter.plausible[0] < parameter.plausible[1] <= high


@each_effect
def test_of_no_size_it_changes_nothing(effect: Effect) -> None:
    """Parameters at their `zero`; and at their defaults it does change something, or this test would prove nothing."""
    if not effect.parameters:
        pytest.skip("has no size")
    for hook in set(effect.functions) & set(NEUTRAL):
        assert ask(effect, hook, values=list(effect.zero)) == pytest.approx(NEUTRAL[hook], rel=1e-12, abs=1e-15)
    assert any(ask(effect, hook) != pytest.approx(NEUTRAL.get(hook, 0.0), rel=1e-9) for hook in effect.functions)


@each_hook
def test_hooks_take_arrays_as_they_take_numbers(effect: Effect, hook: str) -> None:
    factors = np.array([0.5, 1.0, 1.7])
    rows = State(*(np.asarray(value * factors) for value in STATE))
    found = np.broadcast_to(np.asarray(ask(effect, hook, rows)), factors.shape)
    singly = [float(ask(effect, hook, State(*(float(value * f) for value in STATE)))) for f in factors]
    np.testing.assert_allclose(found, singly, rtol=1e-13)


@each_hook
def test_hooks_leave_their_arguments_alone(effect: Effect, hook: str) -> None:
    rows = State(*(np.full(3, value) for value in STATE))
    ask(effect, hook, rows)
    for values, value in zip(rows, STATE, strict=True):
        np.testing.assert_array_equal(values, value)


@each_hook
def test_hooks_are_finite_at_rest(effect: Effect, hook: str) -> None:
    rest = STATE._replace(time=0.0, lead_position=0.0, lead_velocity=0.0, tail_position=0.0, tail_velocity=0.0)
    assert np.isfinite(float(ask(effect, hook, rest)))


def test_an_unknown_name_suggests_the_nearest() -> None:
    with pytest.raises(EffectError, match=r"no effect named 'gravitty'\. Did you mean 'gravity'"):
        find_effect("gravitty")
    with pytest.raises(AttributeError, match="no effect named 'gravitty'"):
        effects.gravitty  # noqa: B018


def test_effects_are_told_apart_by_name_and_file(tmp_path: Path) -> None:
    twin = tmp_path / "gravity.py"
    twin.write_text((FOLDER / "gravity.py").read_text())
    assert load_effect(FOLDER / "gravity.py") == effects.gravity
    assert hash(load_effect(FOLDER / "gravity.py")) == hash(effects.gravity)
    assert load_effect(twin) != effects.gravity


# ---- the tester, tested; what breaks the contract is in test_own_effects ----

GOOD = '''"""Sail: a small sail slows the tip.

    tip force −S ẏ

Source: made up.
"""

from vinetrack.effects import Parameter, Worked

PARAMETERS = (Parameter("S", "S", "N·s/m", 0.2, bounds=(0.0, 10.0), plausible=(0.0, 1.0), meaning="size of the sail"),)


def tip_force(s, rig, S):
    return -S * s.lead_velocity


WORKED = (Worked("tip_force", -0.4, "0.2 × 2", state={"lead_velocity": 2.0}, parameters={"S": 0.2}),)
'''


def written(folder: Path, text: str, name: str = "sail.py") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def test_a_worked_number_that_is_wrong_would_be_caught(tmp_path: Path) -> None:
    wrong = load_effect(written(tmp_path, GOOD.replace("-0.4, ", "-0.41, ")))
    with pytest.raises(AssertionError):
        test_worked_numbers_agree(wrong, wrong.worked[0])


# ---- a user's own effect ----


def test_an_own_effect_stands_before_one_of_the_same_name(tmp_path: Path) -> None:
    own = load_effect(written(tmp_path, GOOD, "gravity.py"))
    assert find_effect("gravity", {"gravity": own}) is own
    assert make_model(user_effects={"gravity": own}) != base_model()
