"""Trajectories against closed forms and against SciPy in another formulation, tail taut or free to go slack."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from by_hand import ATM, RT_AIR, G, N, followed
from by_hand import LOADED as HANGING
from scipy.integrate import solve_ivp

import vinetrack as vt
from vinetrack import effects
from vinetrack.core.records import Trial
from vinetrack.dynamics.simulate import SimulationError, simulate_many
from vinetrack.effects import catalogue

LOADED = HANGING.trial(pressure_Pa=14e3)
VINE = replace(LOADED, payload_kg=0.0)
BALL = Trial(name="ball", diameter_m=0.02, payload_kg=0.1, travel_ratio=1.0)
MODEL = vt.base_model().with_values({"eversion_damping.B": HANGING.B, "eversion_damping.n": N})


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
        *((LOADED, 6.44, n, rel) for n, rel in ((0.2, 2e-6), (0.6, 2e-6), (1.0, 2e-6), (1.7, 1e-6))),
        (replace(LOADED, growth_angle_rad=math.pi), 6.44, N, 1e-6),
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
    trials = [VINE, LOADED, replace(VINE, pressure_Pa=3.1e3)]
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


A, LAMBDA, L, PAYLOAD, P_Y, B = HANGING.A, HANGING.lam, HANGING.L, HANGING.payload, HANGING.P_y, HANGING.B
MU = 0.5
FALL_AND_RISE = (np.array([0.0, 0.05, 0.06, 0.10, 0.11, 1.0]), np.array([28e3, 28e3, 12e3, 12e3, 28e3, 28e3]))


def by_hand(
    times: np.ndarray, pressure, first_Pa: float, tau: float, down: float, mu: float
) -> tuple[np.ndarray, list[float]]:
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
    trial = HANGING.trial(pressure_Pa=P, tail_slack="free", growth_angle_rad=math.acos(down))
    # A coasting tail carries an error of its speed on for a tenth of a second: a tighter tolerance than usual.
    got = vt.simulate(model, trial, times, trace=trace, **({"relative_tolerance": 1e-6} if case == "rubs" else {}))
    assert len(switches) == expected
    assert got.slack_from_s == pytest.approx(switches[0], abs=1e-5 if trace else 2e-6)
    np.testing.assert_allclose(got.lead_position_m, np.minimum(truth, L), rtol=0, atol=1e-5 * min(truth[-1], L))


def test_below_the_yield_pressure_the_payload_falls_and_the_tip_stays_and_a_slack_phase_may_fail():
    trial = HANGING.trial(pressure_Pa=2e3, tail_slack="free")
    got = vt.simulate(MODEL, trial, np.linspace(0, 0.2, 20))
    assert got.slack_from_s == 0.0
    assert np.all(got.lead_position_m == 0)
    # Eq. (2) as written lets the weight of the payload pull the tip along.
    taut = replace(trial, tail_slack="taut")
    assert vt.simulate(MODEL, taut, np.linspace(0, 0.2, 20)).lead_position_m[-1] > 1e-5
    # No step meets a tolerance of nothing: the tail goes slack at release and gets no further.
    trial = HANGING.trial(pressure_Pa=7e3, tail_slack="free")
    with pytest.raises(SimulationError):
        vt.simulate(MODEL, trial, np.linspace(0, 0.2, 20), relative_tolerance=0.0)
