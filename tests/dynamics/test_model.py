"""A model as a sum of effects, its compiled form, its terms along a motion, and those that it neglects."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from by_hand import BARE, LOADED, N
from own_effect import NAME, write_effect

import vinetrack as vt
from vinetrack import effects
from vinetrack.core.records import Bend, Kinematics, Trial
from vinetrack.dynamics import kernel as batch
from vinetrack.dynamics.audit import Audit, AuditedMotion, audit, evaluate, measured_motion
from vinetrack.dynamics.kernel import kernel
from vinetrack.dynamics.model import effects_on, host_for, shared_host
from vinetrack.dynamics.simulate import prepare, simulate_many
from vinetrack.effects import BASE_EFFECTS, Effect, EffectError, catalogue, load_effect, own_effects


def test_removing_by_effect_or_by_name_removes_its_values():
    values = {"reservoir_depletion.gamma": 1.2, "eversion_damping.B": 2.0}
    larger = (vt.base_model() + effects.reservoir_depletion).with_values(values)
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

    def noted(effects: tuple[Effect, ...], tail_free: bool):
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


A = math.pi * 24e-3**2 / 4
BASE = vt.base_model().with_values({"eversion_damping.B": 6.44})


def trial(**others: object) -> Trial:
    return LOADED.trial(condition="c", **others)


def steady(of: Trial, speed_m_s: float = 2.0, share: float = 0.95, pressure: np.ndarray | None = None) -> AuditedMotion:
    y = np.linspace(0.0, share * of.length_m, 101)
    return AuditedMotion(of, y / speed_m_s, y, np.full(101, speed_m_s), pressure)


def row(found: Audit, term: str):
    (at,) = found.table.index[found.table["term"] == term]
    return found.table.loc[at]


def test_terms_by_hand():
    motion = steady(trial())
    found = audit(BASE, [motion])
    # ¼ × 1.2 × A × 1 × 2² over ½ × 28000 × A = 1.2/14000
    drag = row(found, "air_drag")
    assert drag["share_of_drive"] == pytest.approx(-1.2 / 14000, rel=1e-9)
    assert drag["force_N"] == pytest.approx(-1.2 * A, rel=1e-9)
    # Adiabatic, largest at the end, 0.95 of 0.28 m: V₀/(V₀ + A y).
    y = 0.95 * 0.28
    P = (28e3 + 101_325) * (3.7e-3 / (3.7e-3 + A * y)) ** 1.4 - 101_325
    depletion = row(found, "reservoir_depletion")
    assert depletion["share_of_drive"] == pytest.approx((P - 28e3) / 28e3, rel=1e-9)
    assert (depletion["y_over_L"], depletion["time_s"]) == pytest.approx((0.95, y / 2.0))
    # The gas adds a mass times the acceleration, and what it takes along.
    rho = (28e3 + 101_325) / (287 * 293)
    m = 18.0956e-3 * (0.28 - motion.lead_position_m) + 35.6e-3
    a = (0.5 * 25e3 * A - 0.5 * 6.44 * 4.0**0.37 + m * 9.81) / m
    force = -0.5 * rho * A * 0.5 * 4 - 0.25 * rho * A * motion.lead_position_m * a
    assert row(found, "gas_inertia")["force_N"] == pytest.approx(force[np.argmax(np.abs(force))], rel=1e-5)
    # A displacement: ½ (L T₁ + y (PA − 2 T₁))/(EπDt) at the last point, T₁ = ½ × 25000 A − ½ × 6.44 × 4^0.37.
    tension = 0.5 * 25e3 * A - 0.5 * 6.44 * 4.0**0.37
    stretch = row(found, "tail_stretch")
    expected = 0.5 * 4e-8 / (math.pi * 24e-3 * 200e-6) * (0.28 * tension + y * (28e3 * A - 2 * tension))
    assert stretch["shift_m"] == pytest.approx(expected, rel=1e-9)
    assert math.isnan(stretch["force_N"])


@pytest.mark.parametrize(
    ("model", "pressure", "absent"),
    [
        (BASE + "supply_refill" + "air_drag", None, {"air_drag", "supply_refill", "reservoir_depletion", "gravity"}),
        (BASE, np.linspace(28e3, 20e3, 101), {"supply_refill", "reservoir_depletion", "leak"}),
    ],
)
def test_what_is_in_the_model_or_the_measured_pressure_is_not_audited(model, pressure, absent):
    found = audit(model, [steady(trial(), pressure=pressure)])
    assert not absent & set(found.table["term"])
    assert "reservoir" not in {each.rule for each in found.violations}


def bent(degrees: float) -> tuple[Bend, Bend]:
    half_m = math.radians(degrees / 2) * 0.1
    return Bend(0.05, half_m, 0.1), Bend(0.15, half_m, 0.1)


@pytest.mark.parametrize(
    ("rule", "kept", "broken"),
    [
        ("drag", steady(trial(), 40.0), steady(trial(), 60.0)),  # C_D = 1: ½ × 1.2 × v²/P = 5 % of 28 kPa at 48 m/s
        ("length", steady(trial(length_m=0.29)), steady(trial(length_m=0.30))),
        ("bends", steady(trial(bends=bent(29.0))), steady(trial(bends=bent(31.0)))),
        ("reservoir", steady(trial(chamber_m3=0.1)), steady(trial())),
    ],
)
def test_each_rule_is_violated_beyond_its_limit(rule, kept, broken):
    assert rule not in {each.rule for each in audit(BASE, [kept]).violations}
    assert rule in {each.rule for each in audit(BASE, [broken]).violations}


@pytest.mark.parametrize(("P", "onset_s", "within_s"), [(7e3, 0.0, 4e-3), (14e3, 24e-3, 1e-3), (28e3, 145e-3, 2e-3)])
def test_compression_in_the_tail_is_found(P, onset_s, within_s):
    of = trial(pressure_Pa=P)
    spread = np.linspace(0.0, 1.0, 200) ** 2
    times = vt.simulate(BASE, of, 30.0 * spread).end_time_s * spread[:-1]
    grown = vt.simulate(BASE, of, times)
    found = audit(BASE, [AuditedMotion(of, times, grown.lead_position_m, grown.lead_velocity_m_s)])
    tension = row(found, "tail_tension")
    assert abs(tension["slack_from_s"] - onset_s) < within_s
    assert tension["force_N"] < 0
    assert [each.rule for each in found.violations].count("tension") == 1
    free = audit(BASE, [steady(trial(tail_slack="free"), 5.0)])
    assert row(free, "tail_tension")["force_N"] < 0
    assert not any(violation.rule == "tension" for violation in free.violations)


def test_a_measured_motion_starts_at_release_and_at_zero():
    t = np.arange(10) * 0.01
    y, v = 0.5 + np.maximum(t - 0.03, 0.0), (t >= 0.03).astype(float)
    kinematics = Kinematics(t, y, v, v, v, np.ones(10, int), 1e-4, 0.0, 2.0)
    motion = measured_motion(trial(), kinematics, 0.03, (np.array([0.0, 1.0]), np.array([28e3, 18e3])))
    np.testing.assert_allclose(motion.time_s, np.arange(7) * 0.01, atol=1e-12)
    np.testing.assert_allclose(motion.lead_position_m, np.arange(7) * 0.01, atol=1e-12)
    np.testing.assert_allclose(motion.pressure_Pa, 28e3 - 100 * np.arange(7), rtol=1e-12)
