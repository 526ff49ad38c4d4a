"""A model as a sum of effects: adding, removing, values, text; and its terms along a motion."""

from __future__ import annotations

import math

import numpy as np
import pytest

from vinetrack import effects
from vinetrack.core.records import Trial
from vinetrack.dynamics.audit import evaluate
from vinetrack.dynamics.model import Model, base_model, effects_on, make_model
from vinetrack.dynamics.simulate import simulate
from vinetrack.effects import BASE_EFFECTS, EffectError


def test_the_base_model_is_the_four_base_effects() -> None:
    model = base_model()
    assert model.names == BASE_EFFECTS
    assert [effect.name for effect in model] == list(BASE_EFFECTS)
    assert "gravity" in model
    assert "leak" not in model


def test_adding_gives_a_new_model_and_leaves_the_old_one() -> None:
    model = base_model()
    larger = model + effects.reservoir_depletion
    assert larger.names == (*BASE_EFFECTS, "reservoir_depletion")
    assert model.names == BASE_EFFECTS
    assert "reservoir_depletion.gamma" in larger.parameter_names


def test_removing_by_effect_or_by_name_removes_its_values() -> None:
    larger = (base_model() + effects.reservoir_depletion).with_values(
        {"reservoir_depletion.gamma": 1.2, "eversion_damping.B": 2.0}
    )
    for smaller in (larger - effects.reservoir_depletion, larger - "reservoir_depletion"):
        assert smaller.names == BASE_EFFECTS
        assert dict(smaller.values) == {"eversion_damping.B": 2.0}


def test_removing_an_effect_that_is_not_there_is_an_error() -> None:
    with pytest.raises(EffectError, match="has no effect 'leak'; it has pressure_drive, gravity"):
        base_model() - "leak"


def test_an_effect_occurs_once() -> None:
    with pytest.raises(EffectError, match=r"An effect stands twice in the model: .*gravity, .*gravity"):
        base_model() + effects.gravity
    with pytest.raises(EffectError, match="twice"):
        make_model(["gravity", "gravity"])


def test_an_unknown_effect_suggests_the_nearest() -> None:
    with pytest.raises(EffectError, match="Did you mean 'reservoir_depletion'"):
        make_model(["pressure_drive", "reservoir_depletoin"])


def test_an_unknown_value_is_named_with_the_known_ones() -> None:
    with pytest.raises(EffectError, match=r"parameter eversion_damping\.b; it has .*eversion_damping\.B"):
        base_model().with_values({"eversion_damping.b": 1.0})
    with pytest.raises(EffectError, match="it has none"):
        Model((effects.pressure_drive,), {"gravity.g": 9.0})


def test_values_have_their_defaults_until_given() -> None:
    model = base_model()
    named = dict(zip(model.parameter_names, model.parameters_for("any"), strict=True))
    assert named == {"gravity.g": 9.81, "eversion_damping.B": 3.0, "eversion_damping.n": 0.37}
    changed = model.with_values({"eversion_damping.n": 0.5}).with_values({"eversion_damping.B": 7.0})
    named = dict(zip(changed.parameter_names, changed.parameters_for("any"), strict=True))
    assert named == {"gravity.g": 9.81, "eversion_damping.B": 7.0, "eversion_damping.n": 0.5}


def test_a_value_may_belong_to_each_vine() -> None:
    model = base_model().with_values({"eversion_damping.B": {"thin": 1.0, "thick": 4.0}})
    at = model.parameter_names.index("eversion_damping.B")
    assert model.parameters_for("thin")[at] == 1.0
    assert model.parameters_for("thick")[at] == 4.0
    with pytest.raises(EffectError, match=r"eversion_damping\.B has no value for the vine 'other'"):
        model.parameters_for("other")


def test_it_prints_as_an_equation_with_its_numbers() -> None:
    text = str(
        base_model().with_values({"eversion_damping.B": {"thin": 1.0, "thick": 4.5}}) + effects.reservoir_depletion
    )
    for words in ("m(x) ẍ =", "+½PA", "+m(x) g cosθ", "−½B ẋⁿ", "−½P_y A", "B (thick) = 4.5 N·(s/m)ⁿ", "B (thin) = 1"):
        assert words in text
    assert "n = 0.37\n" in text
    assert text.endswith("γ = 1.4")


def test_models_are_values() -> None:
    assert base_model() == base_model()
    assert base_model() != base_model().with_values({"eversion_damping.B": 2.0})
    assert base_model() + effects.leak - effects.leak == base_model()


def test_effects_of_size_zero_and_replaced_ones_do_not_act() -> None:
    model = base_model() + effects.reservoir_depletion + effects.supply_refill + effects.air_drag
    rows = np.array([model.parameters_for(""), model.with_values({"air_drag.C_D": 0.0}).parameters_for("")])
    acting = effects_on(model, rows)
    by_name = dict(zip(model.names, acting.T.tolist(), strict=True))
    assert by_name["air_drag"] == [True, False]
    assert by_name["reservoir_depletion"] == [False, False]
    assert by_name["supply_refill"] == [True, True]
    assert by_name["pressure_drive"] == [True, True]


TRIAL = Trial(
    name="t",
    diameter_m=0.024,
    thickness_m=200e-6,
    length_m=0.28,
    pressure_Pa=28e3,
    yield_pressure_Pa=3e3,
    payload_kg=0.0356,
    chamber_m3=1.5e-3,
)


def test_terms_along_a_motion_by_hand() -> None:
    """At y = 0.1 m and ẏ = 2 m/s, with B 6.44 and n 0.37, everything worked out on paper."""
    model = base_model().with_values({"eversion_damping.B": 6.44})
    terms = evaluate(model, TRIAL, np.array([0.05]), np.array([0.1]), np.array([2.0]))
    film = 1200 * math.pi * 0.024 * 200e-6
    mass = film * (0.28 - 0.1) + 0.0356
    area = math.pi * 0.012**2
    tip = {"pressure_drive": 28e3 * area, "eversion_damping": -6.44 * 4**0.37, "yield_pressure": -3e3 * area}
    assert terms.mass_kg[0] == pytest.approx(mass, rel=1e-12)
    assert terms.tail_N["gravity"][0] == pytest.approx(mass * 9.81, rel=1e-12)
    for name, force in tip.items():
        assert terms.tip_N[name][0] == pytest.approx(force, rel=1e-12)
    assert terms.tension_N[0] == pytest.approx(sum(tip.values()) / 2, rel=1e-12)
    assert terms.acceleration_m_s2[0] == pytest.approx((sum(tip.values()) / 2 + mass * 9.81) / mass, rel=1e-12)


@pytest.mark.parametrize("more", [(), ("reservoir_depletion",)], ids=["base", "depletion"])
def test_terms_in_plain_python_and_the_compiled_sum_agree(more: tuple[str, ...]) -> None:
    model = make_model([*BASE_EFFECTS, *more]).with_values({"eversion_damping.B": 6.44})
    times_s = np.linspace(0.005, 0.12, 60)
    moved = simulate(model, TRIAL, times_s, relative_tolerance=1e-7)
    terms = evaluate(model, TRIAL, times_s, moved.lead_position_m, moved.lead_velocity_m_s)
    np.testing.assert_allclose(terms.acceleration_m_s2, 2 * moved.lead_acceleration_m_s2, rtol=2e-4, atol=2e-3)
    fallen = terms.pressure_Pa[0] - terms.pressure_Pa[-1]
    assert fallen > 1e3 if more else fallen == 0
