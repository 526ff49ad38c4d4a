"""A model as a sum of effects, its terms along a motion, and the compiled form that models share."""

from __future__ import annotations

import math
from dataclasses import replace
from types import ModuleType

import numpy as np
import pytest
from by_hand import BARE, LOADED, N
from own_effect import NAME, write_effect

import vinetrack as vt
from vinetrack import effects
from vinetrack.dynamics import kernel as batch
from vinetrack.dynamics.audit import evaluate
from vinetrack.dynamics.kernel import kernel
from vinetrack.dynamics.model import effects_on, host_for, shared_host
from vinetrack.dynamics.simulate import prepare, simulate_many
from vinetrack.effects import BASE_EFFECTS, Effect, EffectError, catalogue, load_effect, own_effects


def test_removing_by_effect_or_by_name_removes_its_values():
    larger = (vt.base_model() + effects.reservoir_depletion).with_values(
        {"reservoir_depletion.gamma": 1.2, "eversion_damping.B": 2.0}
    )
    for smaller in (larger - effects.reservoir_depletion, larger - "reservoir_depletion"):
        assert smaller.names == BASE_EFFECTS
        assert dict(smaller.values) == {"eversion_damping.B": 2.0}
    assert (
        vt.base_model() + effects.leak - effects.leak
        == vt.base_model()
        != vt.base_model().with_values({"gravity.g": 2.0})
    )
    for twice in (lambda: vt.base_model() + effects.gravity, lambda: vt.make_model(["gravity", "gravity"])):
        with pytest.raises(EffectError):
            twice()


def test_values_have_their_defaults_until_given_and_may_belong_to_each_vine():
    assert vt.base_model().parameter_names == ("gravity.g", "eversion_damping.B", "eversion_damping.n")
    assert vt.base_model().parameters_for("any").tolist() == [9.81, 3.0, 0.37]
    model = vt.base_model().with_values({"eversion_damping.n": 0.5})
    model = model.with_values({"eversion_damping.B": {"thin": 1.0, "thick": 4.0}})
    assert model.parameters_for("thick").tolist() == [9.81, 4.0, 0.5]
    with pytest.raises(EffectError):
        model.parameters_for("other")


def test_effects_of_size_zero_and_replaced_ones_do_not_act():
    model = vt.base_model() + effects.reservoir_depletion + effects.supply_refill + effects.air_drag
    rows = np.array([model.parameters_for(""), model.with_values({"air_drag.C_D": 0.0}).parameters_for("")])
    acting = dict(zip(model.names, effects_on(model, rows).T.tolist(), strict=True))
    always = {name: [True, True] for name in (*BASE_EFFECTS, "supply_refill")}
    assert acting == {**always, "air_drag": [True, False], "reservoir_depletion": [False, False]}


def test_terms_along_a_motion_by_hand():
    """At y = 0.1 m and ẏ = 2 m/s, with B 6.44 and n 0.37, everything worked out on paper."""
    model = vt.base_model().with_values({"eversion_damping.B": 6.44})
    terms = evaluate(model, LOADED.trial(), np.array([0.05]), np.array([0.1]), np.array([2.0]))
    mass = 1200 * math.pi * 0.024 * 200e-6 * (0.28 - 0.1) + 0.0356
    area = math.pi * 0.012**2
    tip = {"pressure_drive": 28e3 * area, "eversion_damping": -6.44 * 4**0.37, "yield_pressure": -3e3 * area}
    assert terms.state.moving_mass[0] == pytest.approx(mass, rel=1e-12)
    assert {name: force[0] for name, force in terms.tip_N.items()} == pytest.approx(tip, rel=1e-12)
    assert terms.tension_N[0] == pytest.approx(sum(tip.values()) / 2, rel=1e-12)
    assert terms.acceleration_m_s2[0] == pytest.approx((sum(tip.values()) / 2 + mass * 9.81) / mass, rel=1e-12)


def test_base_models_and_those_with_an_own_effect_are_compiled_by_themselves(tmp_path):
    own = own_effects([write_effect(tmp_path)])
    named_as_another = load_effect(write_effect(tmp_path).rename(tmp_path / "air_drag.py"))
    assert named_as_another.name in catalogue()
    models = (vt.base_model(), vt.make_model(["gravity"]), vt.base_model() + "air_drag" + own[NAME])
    for several in (*(model.effects for model in models), (*vt.base_model().effects, named_as_another)):
        assert shared_host(several) is None


def test_a_tail_that_may_go_slack_is_not_compiled_with_the_whole_catalogue(monkeypatch):
    asked: list[tuple[int, bool]] = []

    def noted(effects: tuple[Effect, ...], tail_free: bool) -> ModuleType:
        asked.append((len(effects), tail_free))
        return kernel(vt.base_model().effects)

    monkeypatch.setattr(batch, "kernel", noted)
    model = vt.base_model().with_values({"eversion_damping.B": BARE.B}) + "air_drag"
    for slack in ("taut", "free"):
        prepare(model, [replace(BARE.trial(), tail_slack=slack)], [np.linspace(0.0, 0.1, 5)])
    assert asked == [(len(catalogue()) + 1, False), (len(model.effects), True)]


def test_by_the_host_it_is_the_same_to_the_last_bit(monkeypatch):
    sizes = {"eversion_damping.B": 6.44, "eversion_damping.n": N, "reservoir_depletion.gamma": 1.3, "air_drag.C_D": 1.1}
    model: vt.Model = (vt.base_model() + "reservoir_depletion" + "air_drag").with_values(sizes)
    trials = [LOADED.trial(chamber_m3=3.7e-3), BARE.trial(chamber_m3=3.7e-3, growth_angle_rad=1.0)]
    times = [np.linspace(0.0, 0.3, 200)] * 2
    by_host = simulate_many(model, trials, times)
    monkeypatch.setattr(batch, "shared_host", lambda _: None)
    for others in (simulate_many(model, trials, times), simulate_many(model, trials, times, host=host_for(model))):
        for one, other in zip(by_host, others, strict=True):
            assert one.status == other.status
            for name in ("lead_position_m", "tail_velocity_m_s", "observed_position_m"):
                np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
