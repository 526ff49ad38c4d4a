"""Trajectories against closed forms and SciPy; a model as a sum of effects, its terms, and those that it neglects."""

import math
from dataclasses import replace

import numpy as np
import pytest
from by_hand import ATM, BARE, LOADED, RT_AIR, G, N, followed
from scipy.integrate import solve_ivp

import vinetrack as vt
from vinetrack import effects
from vinetrack.core.records import Bend, Trial
from vinetrack.dynamics import simulate as batch
from vinetrack.dynamics.audit import Audit, AuditedMotion, audit, motion_since
from vinetrack.dynamics.model import host_for
from vinetrack.dynamics.simulate import SimulationError, simulate_many
from vinetrack.effects import BASE_EFFECTS, EffectError, catalogue

SLOWER = LOADED.trial(pressure_Pa=14e3)
VINE = replace(SLOWER, payload_kg=0.0)
BALL = Trial(name="ball", diameter_m=0.02, payload_kg=0.1, travel_ratio=1.0)
MODEL = vt.base_model().with_values({"eversion_damping.B": LOADED.B, "eversion_damping.n": N})
A, LAMBDA, L, PAYLOAD, P_Y, B = LOADED.A, LOADED.lam, LOADED.L, LOADED.payload, LOADED.P_y, LOADED.B
MU = 0.5
FALL_AND_RISE = (np.array([0.0, 0.05, 0.06, 0.10, 0.11, 1.0]), np.array([28e3, 28e3, 12e3, 12e3, 28e3, 28e3]))
BASE = vt.base_model().with_values({"eversion_damping.B": 6.44})


def test_a_dropped_ball_falls_half_g_t_squared():
    times_s = np.linspace(0, 2, 41)
    found = vt.simulate(vt.make_model(["gravity"]), BALL, times_s)
    np.testing.assert_allclose(found.lead_position_m, 0.5 * G * times_s**2, rtol=1e-10, atol=1e-14)
    np.testing.assert_allclose(found.lead_velocity_m_s, G * times_s, rtol=1e-8, atol=1e-12)
    assert found.status == "running"
    assert math.isnan(found.end_time_s)


@pytest.mark.parametrize(
    ("trial", "B", "n", "rel"),
    [
        *((SLOWER, 6.44, n, rel) for n, rel in ((0.2, 2e-6), (0.6, 2e-6), (1.0, 2e-6), (1.7, 1e-6))),
        (replace(SLOWER, growth_angle_rad=math.pi), 6.44, N, 1e-6),
        (replace(VINE, diameter_m=6e-3, thickness_m=50e-6, length_m=0.07, pressure_Pa=30e3), 0.57, N, 1e-6),
        (replace(VINE, pressure_Pa=3050.0, growth_angle_rad=math.pi / 2), 3.0, N, 1e-6),  # it takes days
    ],
    ids=["n 0.2", "n 0.6", "n 1", "n 1.7", "upward", "small", "near yield"],
)
def test_a_vine_grows_from_rest_to_its_end_as_the_equation_says(trial, B, n, rel):
    area, film = math.pi * trial.diameter_m**2 / 4, 1200 * math.pi * trial.diameter_m * trial.thickness_m
    gas = (trial.pressure_Pa + ATM) / RT_AIR * area * trial.length_m
    floor = film * math.pi * trial.thickness_m + gas / 4

    def acceleration(_t: float, x: float, v: float) -> float:
        mass = max(film * (trial.length_m - x / 2), floor) + trial.payload_kg
        pull = 0.5 * (trial.pressure_Pa - trial.yield_pressure_Pa) * area - 0.5 * B * v**n
        return pull / mass + G * math.cos(trial.growth_angle_rad)

    truth = followed(acceleration, 2 * trial.length_m, until=1e6)
    end = truth.end
    times = np.linspace(0.01, 1, 60) * end * (1 - 1e-6)
    model = vt.base_model().with_values({"eversion_damping.B": B, "eversion_damping.n": n})
    found = vt.simulate(model, trial, np.append(times, 2 * end))
    assert found.status == "ended"
    assert found.n_steps < 500
    assert found.end_time_s == pytest.approx(end, rel=rel)
    np.testing.assert_allclose(found.lead_position_m[:-1], truth(times) / 2, rtol=0, atol=rel * trial.length_m)
    assert (found.lead_position_m[-1], found.lead_velocity_m_s[-1]) == (trial.length_m, 0.0)
    assert found.end_lead_velocity_m_s == pytest.approx(truth.state(end)[1] / 2, rel=1e-3)


def test_a_motion_depends_neither_on_others_at_once_nor_on_the_requested_times():
    trials = [VINE, SLOWER, replace(VINE, pressure_Pa=3.1e3)]
    times = [np.linspace(0, t, 20) for t in (0.3, 0.5, 2.0)]
    traces = [None, (np.array([0.0, 1.0]), np.array([14e3, 10e3])), None]
    together = simulate_many(MODEL, trials, times, traces=traces)
    for trial, times_s, trace, found in zip(trials, times, traces, together, strict=True):
        alone = vt.simulate(MODEL, trial, times_s, trace=trace)
        np.testing.assert_array_equal(found.lead_position_m, alone.lead_position_m)
    many = vt.simulate(MODEL, VINE, np.linspace(0, 0.5, 501))
    few = vt.simulate(MODEL, VINE, np.array([0.1, 0.25, 0.5]))
    np.testing.assert_allclose(few.lead_position_m, many.lead_position_m[[100, 250, 500]], rtol=0, atol=1e-9)


BAND = '''"""Band: a force that grows from a place along the way.

    tail force k (y − 0.1 m) from 0.1 m on
"""
from vinetrack.effects import Parameter
PARAMETERS = (Parameter("k", "k", "N/m", 500.0, bounds=(0.0, 1e4)),)
def tail_force(s, rig, k):
    return k * max(s.lead_position - 0.1, 0.0)
def breakpoints(rig):
    return (0.1,)
'''


def test_a_body_without_an_end_steps_onto_the_breakpoints_of_its_forces(tmp_path):
    """A ball that falls by g, and beyond 0.1 m is drawn on by k (y − 0.1 m): m z̈ = m g + k z."""
    (tmp_path / "band.py").write_text(BAND)
    model = vt.make_model(["gravity"]) + effects.load_effect(tmp_path / "band.py")
    times_s = np.linspace(0, 0.2, 41)
    found = vt.simulate(model, BALL, times_s)
    root = math.sqrt(500.0 / 0.1)
    beyond = root * np.maximum(times_s - math.sqrt(0.2 / G), 0.0)
    drawn = 0.1 + math.sqrt(0.2 * G) / root * np.sinh(beyond) + G / root**2 * (np.cosh(beyond) - 1)
    truth = np.where(beyond > 0, drawn, 0.5 * G * times_s**2)
    # Steps across the breakpoint err by 1.3e-5, those that end there by 2.7e-6: the tolerance of a step and no more.
    np.testing.assert_allclose(found.lead_position_m, truth, rtol=5e-6)


def by_hand(times, pressure, first_Pa: float, tau: float, down: float, mu: float) -> tuple[np.ndarray, list[float]]:
    """Lead positions, and when the tail went slack and taut in turn.
    State (x, ẋ, y, P of a chamber of 3.7 L filled within τ): taut while T₁ = ½(P − P_y)A − ½Bẋⁿ ≥ 0, slack until
    x = 2y; the slack tip has (P − P_y)A = B(2ẏ)ⁿ. `pressure(t, P)` is what drives.
    """

    def tension(t: float, s: np.ndarray) -> float:
        return 0.5 * (pressure(t, s[3]) - P_Y) * A - 0.5 * B * max(s[1], 0.0) ** N

    def slope(t: float, s: np.ndarray) -> list[float]:
        x, v, y, P = s
        tip = v / 2 if is_taut else 0.5 * (max(pressure(t, P) - P_Y, 0.0) * A / B) ** (1 / N)
        m = LAMBDA * (L - (x / 2 if is_taut else y)) + PAYLOAD
        force = (tension(t, s) if is_taut else 0.0) + m * G * down - mu * PAYLOAD * G
        filled = -1.4 * (P + ATM) * A * tip / (3.7e-3 + A * y) + (first_Pa - P) / tau
        return [v, force / m, tip, filled]

    def taken_up(_t: float, s: np.ndarray) -> float:
        return s[0] - 2 * s[2]

    for event in (tension, taken_up):
        event.terminal, event.direction = True, -1
    y, switches = np.zeros_like(times), []
    start, state, is_taut = 0.0, np.array([0.0, 0.0, 0.0, first_Pa]), True
    how = {"rtol": 1e-10, "atol": [1e-13, 1e-13, 1e-13, 1e-8], "dense_output": True, "max_step": 1e-3}
    while start < times[-1]:
        switch = tension if is_taut else taken_up
        done = solve_ivp(slope, (start, times[-1]), state, "LSODA", events=switch, **how)
        start, state = float(done.t[-1]), done.y[:, -1].copy()
        inside = (times >= done.t[0]) & (times <= start)
        y[inside] = done.sol(times[inside])[2]
        if done.t_events[0].size:
            switches.append(start)
            is_taut = not is_taut
            state[0] = 2 * state[2] if is_taut else state[0]
    return y, switches


@pytest.mark.parametrize("case", [7e3, 14e3, 28e3, "rubs", "chamber"])
def test_the_tip_follows_its_own_law_while_the_payload_falls(case):
    # Effects at no size: one compiled model for all cases.
    sizes = {"payload_friction.mu_p": 0.0, "supply_refill.tau": 0.0, "supply_refill.gamma": 0.0}
    P, trace, tau, down, mu, last_s, expected = 20e3, None, 0.5, 1.0, 0.0, 0.15, 1
    pressure = lambda _t, P: P  # noqa: E731
    if case == "rubs":  # the tail coasts, and its slack is taken up again
        P, trace, down, mu, last_s, expected = 28e3, FALL_AND_RISE, 0.0, MU, 0.2, 2
        sizes["payload_friction.mu_p"], pressure = MU, lambda t, _P: float(np.interp(t, *FALL_AND_RISE))
    elif case == "chamber":
        sizes |= {"supply_refill.tau": tau, "supply_refill.gamma": 1.4}
    else:
        P, pressure = float(case), lambda _t, _P: P
        last_s = 0.2 if P > 20e3 else 0.3
    times = np.linspace(0, last_s, 121)
    truth, switches = by_hand(times, pressure, P, tau, down, mu)
    model = (MODEL + catalogue()["payload_friction"] + catalogue()["supply_refill"]).with_values(sizes)
    trial = LOADED.trial(pressure_Pa=P, tail_slack="free", growth_angle_rad=math.acos(down))
    # A coasting tail carries an error of its speed on for a tenth of a second: a tighter tolerance than usual.
    got = vt.simulate(model, trial, times, trace=trace, **({"relative_tolerance": 1e-6} if case == "rubs" else {}))
    assert len(switches) == expected
    assert got.slack_from_s == pytest.approx(switches[0], abs=1e-5 if trace else 2e-6)
    np.testing.assert_allclose(got.lead_position_m, np.minimum(truth, L), rtol=0, atol=1e-5 * min(truth[-1], L))


def test_below_the_yield_pressure_the_payload_falls_and_the_tip_stays_and_a_slack_phase_may_fail():
    trial = LOADED.trial(pressure_Pa=2e3, tail_slack="free")
    got = vt.simulate(MODEL, trial, np.linspace(0, 0.2, 20))
    assert got.slack_from_s == 0.0
    assert np.all(got.lead_position_m == 0)
    # Eq. (2) as written lets the weight of the payload pull the tip along.
    taut = replace(trial, tail_slack="taut")
    assert vt.simulate(MODEL, taut, np.linspace(0, 0.2, 20)).lead_position_m[-1] > 1e-5
    # At an exponent near 0 what is left of a falling drive moves nothing: the vine stops once.
    creeping = MODEL.with_values({"eversion_damping.B": 2.15, "eversion_damping.n": 0.0077}) + "leak"
    level = replace(VINE, diameter_m=0.012, length_m=0.36, pressure_Pa=21e3, yield_pressure_Pa=0, growth_angle_rad=1.57)
    assert vt.simulate(creeping, level, np.linspace(0, 3, 40)).status == "stalled"
    # No step meets a tolerance of nothing: the tail goes slack at release and gets no further.
    trial = LOADED.trial(pressure_Pa=7e3, tail_slack="free")
    with pytest.raises(SimulationError):
        vt.simulate(MODEL, trial, np.linspace(0, 0.2, 20), relative_tolerance=0.0)


def test_removing_by_effect_or_by_name_removes_its_values():
    values = {"reservoir_depletion.gamma": 1.2, "eversion_damping.B": 2.0}
    larger = (vt.base_model() + effects.reservoir_depletion).with_values(values)
    for smaller in (larger - effects.reservoir_depletion, larger - "reservoir_depletion"):
        assert smaller.names == BASE_EFFECTS
        assert dict(smaller.values) == {"eversion_damping.B": 2.0}
    base = vt.base_model()
    assert base + effects.leak - effects.leak == base != base.with_values({"gravity.g": 2.0})
    for twice in (lambda: vt.base_model() + effects.gravity, lambda: vt.make_model(["gravity", "gravity"])):
        with pytest.raises(EffectError):
            twice()


def test_by_the_host_it_is_the_same_to_the_last_bit(monkeypatch):
    sizes = {"eversion_damping.B": 6.44, "eversion_damping.n": N, "reservoir_depletion.gamma": 1.3, "air_drag.C_D": 1.1}
    model: vt.Model = (vt.base_model() + "reservoir_depletion" + "air_drag").with_values(sizes)
    trials = [LOADED.trial(chamber_m3=3.7e-3), BARE.trial(chamber_m3=3.7e-3, growth_angle_rad=1.0)]
    times = [np.linspace(0.0, 0.3, 200)] * 2
    assert (batch.shared_host(vt.base_model().effects), batch.shared_host(model.effects) is None) == (None, False)
    by_host = simulate_many(model, trials, times)
    monkeypatch.setattr(batch, "shared_host", lambda _: None)
    for others in (simulate_many(model, trials, times), simulate_many(model, trials, times, host=host_for(model))):
        for one, other in zip(by_host, others, strict=True):
            assert one.status == other.status
            for name in ("lead_position_m", "tail_velocity_m_s", "observed_position_m"):
                np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


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


def test_a_trial_that_scatter_makes_faster_than_its_model_does_not_push_its_tail():
    """Level and bare, no motion of the model compresses the tail; a measured one, 8 % faster, would by 3 %."""
    of = trial(payload_kg=0.0, growth_angle_rad=0.5 * math.pi)
    steady_m_s = 0.5 * (25e3 * A / 6.44) ** (1 / 0.37)
    measured = steady(of, 1.08 * steady_m_s)
    assert [each.rule for each in audit(BASE, [measured]).violations].count("tension") == 1
    found = audit(BASE, [replace(measured, by_model=steady(of, steady_m_s))])
    assert not any(each.rule == "tension" for each in found.violations)
    assert row(found, "tail_tension")["share_of_drive"] == pytest.approx(0.0, abs=1e-9)


def test_a_measured_motion_starts_at_release_and_at_zero():
    t = np.arange(10) * 0.01
    y, v = 0.5 + np.maximum(t - 0.03, 0.0), (t >= 0.03).astype(float)
    motion = motion_since(0.03, trial(), t, y, v, (np.array([0.0, 1.0]), np.array([28e3, 18e3])))
    np.testing.assert_allclose(motion.time_s, np.arange(7) * 0.01, atol=1e-12)
    np.testing.assert_allclose(motion.lead_position_m, np.arange(7) * 0.01, atol=1e-12)
    np.testing.assert_allclose(motion.pressure_Pa, 28e3 - 100 * np.arange(7), rtol=1e-12)
