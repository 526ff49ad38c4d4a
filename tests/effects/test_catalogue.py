"""The contract of an effect's file, over every file of the folder; and that what breaks it is refused with a reason."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

import vinetrack.effects as effects
from vinetrack.effects import BASE_EFFECTS, State, catalogue, find_effect, load_effect
from vinetrack.effects._catalogue import _RIG, _STATE

FOLDER = Path(effects.__file__).parent
FILES = sorted(path for path in FOLDER.glob("*.py") if not path.stem.startswith("_"))
ALL = [load_effect(path) for path in FILES]
PARAMETERS = [(effect, parameter) for effect in ALL for parameter in effect.parameters]

each_effect = pytest.mark.parametrize("effect", ALL, ids=lambda effect: effect.name)


def test_the_folder_is_the_catalogue_with_the_base_first():
    assert set(catalogue()) == {path.stem for path in FILES}
    assert tuple(catalogue())[:4] == BASE_EFFECTS


@each_effect
def test_a_file_names_describes_and_works_out_its_effect(effect):
    assert effect.name == effect.path.stem
    assert getattr(effects, effect.name) == effect == find_effect(effect.name)
    assert all((effect.summary, effect.formula, "Source:" in effect.text))
    assert {worked.hook for worked in effect.worked} == set(effect.functions)
    assert all(worked.rel <= 1e-2 for worked in effect.worked)
    assert set(effect.replaces) <= set(catalogue()) - {effect.name}
    assert (effect.kind == "base") == (effect.name in BASE_EFFECTS)
    if effect.kind == "measurement":
        read_off = {"true_time", "trace_time", "observed_position", "row_delay", "gauge", "yield_gauge", "area"}
        read_off |= {"film_gain", "averaged_over"}
        # They turn, and add to, a weight and a mass that are there.
        weight = {"growth_angle": {"tail_force"}, "payload_mass": {"tail_force", "added_mass"}}
        assert set(effect.functions) <= read_off | weight.get(effect.name, set())


@pytest.mark.parametrize(("effect", "parameter"), PARAMETERS, ids=[f"{e.name}-{p.name}" for e, p in PARAMETERS])
def test_parameters_have_symbol_unit_meaning_and_bounds_that_hold_the_default(effect, parameter):
    assert effect.parameters.count(parameter) == 1
    assert all((parameter.symbol, parameter.unit, parameter.meaning))
    low, high = parameter.bounds
    assert -math.inf < low < high < math.inf
    assert low <= parameter.default <= high
    assert parameter.shared in ("all", "vine", "day")
    assert low <= parameter.plausible[0] < parameter.plausible[1] <= high


@each_effect
def test_hooks_take_arrays_as_they_take_numbers_and_are_finite_at_rest(effect):
    sizes = [parameter.default for parameter in effect.parameters]
    factors = np.array([0.5, 1.0, 1.7])
    rows = State(*(np.asarray(value * factors) for value in _STATE))
    rest = _STATE._replace(time=0.0, lead_position=0.0, lead_velocity=0.0, tail_position=0.0, tail_velocity=0.0)
    for hook in effect.functions.values():
        found = np.broadcast_to(np.asarray(hook(rows, _RIG, *sizes)), factors.shape)
        singly = [float(hook(State(*(float(value * f) for value in _STATE)), _RIG, *sizes)) for f in factors]
        np.testing.assert_allclose(found, singly, rtol=1e-13)
        assert np.isfinite(float(hook(rest, _RIG, *sizes)))


def test_effects_are_told_apart_by_name_and_file(tmp_path):
    twin = tmp_path / "gravity.py"
    twin.write_text((FOLDER / "gravity.py").read_text())
    assert {load_effect(FOLDER / "gravity.py")} == {effects.gravity}
    assert load_effect(twin) != effects.gravity
