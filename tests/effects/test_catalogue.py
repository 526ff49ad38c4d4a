"""The contract of an effect's file, over every file of the folder; and that what breaks it is refused with a reason."""

from __future__ import annotations

import inspect
import math
from pathlib import Path

import numpy as np
import pytest

import vinetrack.effects as effects
from vinetrack.core.records import Trial
from vinetrack.dynamics.model import base_model, make_model
from vinetrack.dynamics.simulate import simulate
from vinetrack.effects import (
    BASE_EFFECTS,
    HOOKS,
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


@each_hook
def test_hooks_are_in_the_list_and_take_state_rig_and_parameters(effect: Effect, hook: str) -> None:
    assert hook in HOOKS
    given = list(inspect.signature(effect.functions[hook]).parameters)
    assert given == ["s", "rig", *(parameter.name for parameter in effect.parameters)]


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


# ---- what breaks the contract is refused: the tester, tested ----

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


BROKEN = {
    "no docstring": (GOOD.split('"""\n', 1)[1], "docstring must say what it is"),
    "no formula": (GOOD.replace("    tip force −S ẏ\n\n", ""), "formula on an indented line"),
    "no function": (GOOD.replace("def tip_force", "def push"), "defines none of the functions true_time"),
    "wrong arguments": (
        GOOD.replace("(s, rig, S)", "(s, rig)").replace("-S *", "-"),
        r"must be tip_force\(s, rig, S\)",
    ),
    "another order": (GOOD.replace("(s, rig, S)", "(s, S, rig)"), r"tip_force\(s, S, rig\) must be"),
    "unknown kind": (GOOD + 'KIND = "guess"\n', "KIND is 'guess', must be one of base, physical, measurement"),
    "default outside": (GOOD.replace('"N·s/m", 0.2', '"N·s/m", 20.0'), "default of S lies outside its bounds"),
    "parameters are plain": (GOOD + 'PARAMETERS = ("S",)\n', r"PARAMETERS must hold Parameter\(\.\.\.\) entries"),
    "worked is plain": (GOOD + "WORKED = (1.0,)\n", r"WORKED must hold Worked\(\.\.\.\) entries"),
    "does not run": (GOOD + "1 / 0\n", "cannot be read .ZeroDivisionError"),
    "is not Python": (GOOD + "def :\n", "cannot be read .SyntaxError"),
}


@pytest.mark.parametrize("fault", BROKEN)
def test_a_broken_file_is_refused_with_its_name_and_what_is_wrong(fault: str, tmp_path: Path) -> None:
    text, sentence = BROKEN[fault]
    assert text != GOOD
    path = written(tmp_path, text)
    with pytest.raises(EffectError, match=sentence) as refused:
        load_effect(path)
    assert str(path) in str(refused.value)


def test_several_faults_are_named_at_once(tmp_path: Path) -> None:
    text = GOOD.replace('"N·s/m", 0.2', '"N·s/m", 20.0') + 'KIND = "guess"\n'
    with pytest.raises(EffectError, match=r"KIND is .*; the default of S"):
        load_effect(written(tmp_path, text))


def test_a_name_that_is_not_lower_case_is_refused(tmp_path: Path) -> None:
    with pytest.raises(EffectError, match="must be lower_case"):
        load_effect(written(tmp_path, GOOD, "Sail-2.py"))


def test_a_file_that_is_not_there_and_one_that_is_not_python(tmp_path: Path) -> None:
    with pytest.raises(EffectError, match="there is no such effect file"):
        load_effect(tmp_path / "none.py")
    with pytest.raises(EffectError, match=r"ends in \.py"):
        load_effect(written(tmp_path, GOOD, "sail.txt"))


def test_a_worked_number_that_is_wrong_would_be_caught(tmp_path: Path) -> None:
    wrong = load_effect(written(tmp_path, GOOD.replace("-0.4, ", "-0.41, ")))
    with pytest.raises(AssertionError):
        test_worked_numbers_agree(wrong, wrong.worked[0])


# ---- a user's own effect ----


def test_an_own_effect_is_loaded_and_simulated_like_any_other(tmp_path: Path) -> None:
    """A sail of size S on the tip, alone against the drive of a heavy payload: m ẍ = ½PA − ½S ẏ, ẏ = ẋ/2."""
    own = load_effect(written(tmp_path, GOOD))
    assert own.summary == "Sail: a small sail slows the tip."
    model = make_model(["pressure_drive", "sail"], {"sail": own}).with_values({"sail.S": 8.0})
    trial = Trial(
        name="t",
        diameter_m=0.02,
        thickness_m=1e-9,
        film_density_kg_m3=1e-9,
        length_m=2.0,
        payload_kg=2.0,
        pressure_Pa=20e3,
        yield_pressure_Pa=0.0,
    )
    moving_kg = 2.0 + (20e3 + 101_325) / (287 * 293) * trial.area_m2 * 2.0 / 4
    force, rate = 0.5 * 20e3 * trial.area_m2, 0.25 * 8.0
    times_s = np.linspace(0, 1.2, 30)
    tau = moving_kg / rate
    truth = force / rate * (times_s + tau * np.expm1(-times_s / tau))
    found = simulate(model, trial, times_s)
    assert found.status == "running"
    np.testing.assert_allclose(2 * found.lead_position_m, truth, rtol=0, atol=1e-6 * truth[-1])


def test_an_own_effect_stands_before_one_of_the_same_name(tmp_path: Path) -> None:
    own = load_effect(written(tmp_path, GOOD, "gravity.py"))
    assert find_effect("gravity", {"gravity": own}) is own
    assert make_model(user_effects={"gravity": own}) != base_model()


def test_an_edited_file_is_read_anew(tmp_path: Path) -> None:
    before = load_effect(written(tmp_path, GOOD))
    after = load_effect(written(tmp_path, GOOD.replace("-S * s", "-2.0 * S * s")))
    assert ask(after, "tip_force") == 2 * ask(before, "tip_force")
