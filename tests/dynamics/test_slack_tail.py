"""A tail that cannot push: against an integration that switches, at events of its own, between taut and slack.

24 mm × 200 µm, 0.28 m, downwards with 35.6 g, as published; written out by hand.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from vinetrack.core.records import Trial
from vinetrack.dynamics.audit import evaluate
from vinetrack.dynamics.model import base_model
from vinetrack.dynamics.simulate import SimulationError, simulate
from vinetrack.effects import catalogue

A = math.pi * 24e-3**2 / 4
LAMBDA = 1200 * math.pi * 24e-3 * 200e-6
L, PAYLOAD, P_Y, B, N, G = 0.28, 35.6e-3, 3e3, 6.44, 0.37, 9.81
MU = 0.5

MODEL = base_model().with_values({"eversion_damping.B": B, "eversion_damping.n": N})
WITH_MORE = (MODEL + catalogue()["payload_friction"] + catalogue()["supply_refill"]).with_values(
    {"payload_friction.mu_p": 0.0, "supply_refill.tau": 0.0, "supply_refill.gamma": 0.0}
)
"""Both at no size: one compiled model for the tests that use either."""

RUBBING = WITH_MORE.with_values({"payload_friction.mu_p": MU})
REFILLED = WITH_MORE.with_values({"supply_refill.tau": 0.5, "supply_refill.gamma": 1.4})


def trial(P: float, **others: object) -> Trial:
    fields: dict[str, object] = {
        "name": "t",
        "vine": "v",
        "diameter_m": 24e-3,
        "thickness_m": 200e-6,
        "length_m": L,
        "pressure_Pa": P,
        "yield_pressure_Pa": P_Y,
        "payload_kg": PAYLOAD,
        "tail_slack": "free",
    }
    return Trial(**{**fields, **others})  # type: ignore[arg-type]


@dataclass
class ByHand:
    """Lead positions at the times asked for; when the tail went slack and taut, in turn."""

    y: np.ndarray
    switches: list[float]


def tip_speed(P: float) -> float:
    """ẏ at which (P − P_y)A = B(2ẏ)ⁿ."""
    return 0.5 * (max(P - P_Y, 0.0) * A / B) ** (1 / N)


def by_hand(
    times: np.ndarray, pressure: Callable[[float], float], down: float = 1.0, mu: float = 0.0, max_step: float = np.inf
) -> ByHand:
    """State (x, ẋ, y): taut while T₁ = ½(P − P_y)A − ½Bẋⁿ ≥ 0, slack until x = 2y."""

    def tension(t: float, s: np.ndarray) -> float:
        return 0.5 * (pressure(t) - P_Y) * A - 0.5 * B * max(s[1], 0.0) ** N

    def taut(t: float, s: np.ndarray) -> list[float]:
        m = LAMBDA * L - LAMBDA / 2 * s[0] + PAYLOAD
        return [s[1], (tension(t, s) + m * G * down - mu * PAYLOAD * G) / m, s[1] / 2]

    def slack(t: float, s: np.ndarray) -> list[float]:
        m = LAMBDA * (L - s[2]) + PAYLOAD
        return [s[1], (m * G * down - mu * PAYLOAD * G) / m, tip_speed(pressure(t))]

    def goes_slack(t: float, s: np.ndarray) -> float:
        return tension(t, s)

    def taken_up(_t: float, s: np.ndarray) -> float:
        return s[0] - 2 * s[2]

    def everted(_t: float, s: np.ndarray) -> float:
        return s[2] - L

    goes_slack.terminal = taken_up.terminal = everted.terminal = True  # type: ignore[attr-defined]
    goes_slack.direction = taken_up.direction = -1  # type: ignore[attr-defined]
    y, switches = np.full_like(times, L), []
    start, state, is_taut = 0.0, np.zeros(3), True
    while start < times[-1]:
        law, switch = (taut, goes_slack) if is_taut else (slack, taken_up)
        done = solve_ivp(
            law,
            (start, times[-1]),
            state,
            "LSODA",
            rtol=1e-10,
            atol=1e-13,
            dense_output=True,
            events=(switch, everted),
            max_step=max_step,
        )
        start, state = float(done.t[-1]), done.y[:, -1].copy()
        inside = (times >= done.t[0]) & (times <= start)
        y[inside] = done.sol(times[inside])[2]
        if done.t_events[1].size or not done.t_events[0].size:
            break
        switches.append(start)
        is_taut = not is_taut
        if is_taut:
            state[0] = 2 * state[2]
    return ByHand(y, switches)


@pytest.mark.parametrize(("P", "onset", "within"), [(7e3, 0.0, 3e-3), (14e3, 24e-3, 1e-3), (28e3, 145e-3, 2e-3)])
def test_slack_begins_at_the_predicted_time(P: float, onset: float, within: float) -> None:
    got = simulate(MODEL, trial(P), np.linspace(0, 0.3, 100))
    assert abs(got.slack_from_s - onset) < within


@pytest.mark.parametrize("P", [7e3, 14e3, 28e3])
def test_the_tip_follows_its_own_law_while_the_payload_falls(P: float) -> None:
    times = np.linspace(0, 0.3, 121)
    truth = by_hand(times, lambda _t: P)
    got = simulate(MODEL, trial(P), times)
    assert len(truth.switches) == 1
    assert got.slack_from_s == pytest.approx(truth.switches[0], abs=2e-6)
    np.testing.assert_allclose(got.lead_position_m, truth.y, rtol=0, atol=1e-5 * truth.y[-1])


def test_a_falling_tail_no_longer_drives_the_tip() -> None:
    times = np.linspace(0, 0.15, 30)
    free = simulate(MODEL, trial(14e3), times).lead_position_m
    as_written = simulate(MODEL, trial(14e3, tail_slack="taut"), times).lead_position_m
    assert as_written[-1] > 1.3 * free[-1]


def test_speed_of_the_tip_is_continuous_where_the_tail_goes_slack() -> None:
    got = simulate(MODEL, trial(14e3), np.linspace(0.0230, 0.0242, 200))
    assert np.max(np.abs(np.diff(got.lead_velocity_m_s))) < 0.02 * got.lead_velocity_m_s[-1]
    assert got.lead_velocity_m_s[-1] == pytest.approx(tip_speed(14e3), rel=1e-9)


FALL_AND_RISE = (np.array([0.0, 0.05, 0.06, 0.10, 0.11, 1.0]), np.array([28e3, 28e3, 12e3, 12e3, 28e3, 28e3]))


def test_the_tip_takes_up_the_slack_of_a_payload_that_rubs() -> None:
    times = np.linspace(0, 0.2, 201)
    truth = by_hand(times, lambda t: float(np.interp(t, *FALL_AND_RISE)), down=0.0, mu=MU, max_step=1e-3)
    level = trial(28e3, growth_angle_rad=math.pi / 2, chamber_m3=3.7e-3)
    # The coasting tail carries an error of its speed on for a tenth of a second: a tighter tolerance than usual.
    got = simulate(RUBBING, level, times, trace=FALL_AND_RISE, relative_tolerance=1e-6)
    assert len(truth.switches) == 2  # slack, and taut again
    assert truth.switches[1] < times[-1]
    assert got.slack_from_s == pytest.approx(truth.switches[0], abs=1e-5)
    np.testing.assert_allclose(got.lead_position_m, truth.y, rtol=0, atol=1e-5 * truth.y[-1])


def test_the_chamber_continues_to_fill_while_the_tail_is_slack() -> None:
    def rate(ydot: float, y: float, P: float) -> float:
        return -1.4 * (P + 101_325) * A * ydot / (3.7e-3 + A * y) + (20e3 - P) / 0.5

    def taut(_t: float, s: np.ndarray) -> list[float]:
        x, v, P = s
        m = LAMBDA * L - LAMBDA / 2 * x + PAYLOAD
        return [v, (0.5 * (P - P_Y) * A + m * G - 0.5 * B * max(v, 0.0) ** N) / m, rate(v / 2, x / 2, P)]

    def tension(_t: float, s: np.ndarray) -> float:
        return (s[2] - P_Y) * A - B * max(s[1], 0.0) ** N

    def slack(_t: float, s: np.ndarray) -> list[float]:
        return [tip_speed(s[1]), rate(tip_speed(s[1]), s[0], s[1])]

    tension.terminal, tension.direction = True, -1  # type: ignore[attr-defined]
    how = {"rtol": 1e-10, "atol": 1e-12, "dense_output": True}
    first = solve_ivp(taut, (0.0, 0.2), [0.0, 0.0, 20e3], "LSODA", events=tension, **how)
    onset = float(first.t[-1])
    second = solve_ivp(slack, (onset, 0.2), [first.y[0, -1] / 2, first.y[2, -1]], "LSODA", **how)
    times = np.linspace(0, 0.2, 101)
    truth = np.where(times < onset, first.sol(np.minimum(times, onset))[0] / 2, second.sol(np.maximum(times, onset))[0])
    got = simulate(REFILLED, trial(20e3, chamber_m3=3.7e-3), times)
    assert 0.01 < onset < 0.15
    assert got.slack_from_s == pytest.approx(onset, abs=1e-5)
    np.testing.assert_allclose(got.lead_position_m, truth, rtol=0, atol=1e-5 * truth[-1])


def test_below_the_yield_pressure_the_payload_falls_and_the_tip_stays() -> None:
    got = simulate(MODEL, trial(2e3), np.linspace(0, 0.2, 20))
    assert got.slack_from_s == 0.0
    assert np.all(got.lead_position_m == 0)
    # Eq. (2) as written lets the weight of the payload pull the tip along.
    assert simulate(MODEL, trial(2e3, tail_slack="taut"), np.linspace(0, 0.2, 20)).lead_position_m[-1] > 1e-5


def test_upward_growth_at_steady_pressure_never_goes_slack() -> None:
    times = np.linspace(0, 0.3, 60)
    up = trial(28e3, growth_angle_rad=math.pi)
    got = simulate(MODEL, up, times)
    assert math.isnan(got.slack_from_s)
    taut = simulate(MODEL, trial(28e3, growth_angle_rad=math.pi, tail_slack="taut"), times)
    np.testing.assert_allclose(got.lead_position_m, taut.lead_position_m, rtol=0, atol=1e-6 * L)


@pytest.mark.parametrize("P", [14e3, 28e3])
def test_plain_python_terms_give_the_same_onset(P: float) -> None:
    times = np.linspace(1e-4, 0.16, 1600)
    taut = simulate(MODEL, trial(P, tail_slack="taut"), times)
    tension = evaluate(MODEL, trial(P), times, taut.lead_position_m, taut.lead_velocity_m_s).tension_N
    onset = times[np.argmax(tension < 0)]
    assert onset == pytest.approx(simulate(MODEL, trial(P), times).slack_from_s, abs=2e-4)


def test_a_slack_phase_that_fails_states_the_time() -> None:
    """No step meets a tolerance of nothing: the tail goes slack at release and gets no further."""
    with pytest.raises(SimulationError, match=r"could not be integrated beyond \d[\d.e-]* s"):
        simulate(MODEL, trial(7e3), np.linspace(0, 0.2, 20), relative_tolerance=0.0)
