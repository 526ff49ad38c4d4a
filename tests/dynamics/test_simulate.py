"""Trajectories against closed forms and against SciPy in other formulations, tail taut or free to go slack."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from by_hand import LOADED as HANGING
from by_hand import N, followed
from scipy.integrate import solve_ivp
from vine_reference import G, masses, reference

from vinetrack import effects
from vinetrack.core.records import Trial
from vinetrack.dynamics.model import Model, base_model, make_model
from vinetrack.dynamics.simulate import SimulationError, simulate, simulate_many
from vinetrack.effects import catalogue
from vinetrack.experiment.folder import read_experiment
from vinetrack.laboratory.tracks import CAPTURE_FPS, PAPER_B, PAPER_N

LOADED = HANGING.trial(pressure_Pa=14e3)
VINE = replace(LOADED, payload_kg=0.0)
WEIGHTLESS = {"thickness_m": 1e-9, "film_density_kg_m3": 1e-9}
"""A film so light that a payload is all that moves; what gas is in the body still counts as a floor, below 0.1 g."""

PROTOCOL = Path(__file__).parents[2] / "data" / "paper"


def with_damping(B: float, n: float = PAPER_N, model: Model | None = None) -> Model:
    return (model or base_model()).with_values({"eversion_damping.B": B, "eversion_damping.n": n})


def frames(end_s: float) -> np.ndarray:
    """Every frame up to the end and one just before it."""
    return np.append(np.arange(1, int(end_s * CAPTURE_FPS) + 1) / CAPTURE_FPS, end_s * (1 - 1e-6))


def check_against(trial: Trial, B: float, *, n: float = PAPER_N, rel: float = 1e-6, **how) -> None:
    truth = reference(trial, B, n, 1e6, **how)
    times_s = frames(truth.end_s)
    found = simulate(with_damping(B, n), trial, np.append(times_s, 2 * truth.end_s))
    tail_m, tail_m_s = truth.state(times_s)
    assert found.status == "ended"
    assert np.abs(found.lead_position_m[:-1] - tail_m / 2).max() <= rel * trial.length_m
    assert found.end_time_s == pytest.approx(truth.end_s, rel=rel)
    inside = times_s < 0.98 * truth.end_s
    worst = np.abs(found.lead_velocity_m_s[:-1] - tail_m_s / 2)[inside].max()
    assert worst <= 1e-4 * tail_m_s[inside].max()


# ---- closed forms ----


def test_a_dropped_ball_falls_half_g_t_squared() -> None:
    ball = Trial(name="ball", diameter_m=0.02, payload_kg=0.1, travel_ratio=1.0)
    times_s = np.linspace(0, 2, 41)
    found = simulate(make_model(["gravity"]), ball, times_s)
    np.testing.assert_allclose(found.lead_position_m, 0.5 * G * times_s**2, rtol=1e-10, atol=1e-14)
    np.testing.assert_allclose(found.lead_velocity_m_s, G * times_s, rtol=1e-8, atol=1e-12)
    assert found.status == "running"
    assert math.isnan(found.end_time_s)


def test_linear_damping_relaxes_exponentially() -> None:
    """n = 1 and a mass that does not change: x = v∞ (t − τ (1 − e^(−t/τ))), τ = 2m/B, v∞ = F/(B/2)."""
    trial = replace(VINE, payload_kg=0.5, length_m=2.0, **WEIGHTLESS)
    B, moving_kg = 6.0, 0.5 + masses(trial).floor
    tau = 2 * moving_kg / B
    final = (0.5 * 11e3 * trial.area_m2 + moving_kg * G) / (B / 2)
    times_s = np.linspace(0, 0.8, 60)
    found = simulate(with_damping(B, 1.0), trial, times_s)
    truth = final * (times_s - tau * -np.expm1(-times_s / tau))
    assert found.status == "running"
    assert np.abs(2 * found.lead_position_m - truth).max() <= 1e-6 * truth[-1]
    np.testing.assert_allclose(2 * found.lead_velocity_m_s, final * -np.expm1(-times_s / tau), atol=1e-5 * final)


# ---- SciPy, another formulation ----


@pytest.mark.slow
@pytest.mark.parametrize("name", [*(f"R{scale}_" for scale in PAPER_B), "fig4_", "fig5_"])
def test_the_protocol_from_rest_to_a_millionth(name: str) -> None:
    conditions = [trial for trial in read_experiment(PROTOCOL).trials if re.fullmatch(f"{name}.*_1", trial.name)]
    for trial in conditions[::5]:
        check_against(trial, PAPER_B[round(trial.diameter_m / 6e-3)])


@pytest.mark.parametrize("n", [0.2, 0.6, 1.0])
def test_other_exponents(n: float) -> None:
    check_against(LOADED, 6.44, n=n, rel=2e-6)


def test_an_exponent_above_one_where_the_start_is_smooth() -> None:
    drive, mass = 0.5 * 11e3 * LOADED.area_m2, masses(LOADED)
    travel = followed(lambda _t, x, v: (drive - 6.44 / 2 * v**1.7) / float(mass.moving(x)) + G, 2 * LOADED.length_m)
    times_s = np.linspace(0, 0.25, 40)
    truth = travel(times_s)
    found = simulate(with_damping(6.44, 1.7), LOADED, times_s)
    assert truth[-1] < 2 * LOADED.length_m
    assert np.abs(2 * found.lead_position_m - truth).max() <= 1e-6 * truth[-1]


def test_upward_with_a_drive_that_is_strong_enough() -> None:
    check_against(replace(LOADED, growth_angle_rad=math.pi), 6.44)


def test_near_the_yield_pressure_growth_takes_minutes_and_few_steps() -> None:
    slow = replace(VINE, pressure_Pa=3050.0, growth_angle_rad=math.pi / 2)
    truth = reference(slow, 3.0, PAPER_N, 1e6, stiff=True)
    assert truth.end_s > 120
    times_s = np.linspace(0.01, 1, 50) * truth.end_s
    times_s[-1] *= 1 - 1e-9
    model = with_damping(3.0)
    found = simulate(model, slow, times_s)
    assert found.n_steps < 500
    assert np.abs(found.lead_position_m - truth.state(times_s)[0] / 2).max() <= 1e-6 * slow.length_m


# ---- end of growth, many at once ----


def test_after_the_end_of_growth_it_stays_at_its_length() -> None:
    found = simulate(with_damping(6.44), VINE, np.linspace(0, 5, 300))
    after = found.time_s > found.end_time_s
    assert after.sum() > 100
    np.testing.assert_array_equal(found.lead_position_m[after], VINE.length_m)
    np.testing.assert_array_equal(found.lead_velocity_m_s[after], 0.0)
    assert found.end_lead_velocity_m_s > 0


def test_the_result_does_not_depend_on_the_requested_times() -> None:
    model = with_damping(6.44)
    many = simulate(model, VINE, np.linspace(0, 0.5, 501))
    few = simulate(model, VINE, np.array([0.1, 0.25, 0.5]))
    np.testing.assert_allclose(few.lead_position_m, many.lead_position_m[[100, 250, 500]], rtol=0, atol=1e-9)


def test_many_at_once_agree_with_each_alone() -> None:
    model = with_damping(6.44)
    trials = [VINE, LOADED, replace(VINE, pressure_Pa=3.1e3)]
    times = [np.linspace(0, t, 20) for t in (0.3, 0.5, 2.0)]
    traces = [None, (np.array([0.0, 1.0]), np.array([14e3, 10e3])), None]
    together = simulate_many(model, trials, times, traces=traces)
    for trial, times_s, trace, found in zip(trials, times, traces, together, strict=True):
        alone = simulate(model, trial, times_s, trace=trace)
        np.testing.assert_array_equal(found.lead_position_m, alone.lead_position_m)


# ---- breakpoints ----


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


def test_a_body_without_an_end_steps_onto_the_breakpoints_of_its_forces(tmp_path: Path) -> None:
    """A ball that falls by g, and beyond 0.1 m is drawn on by k (y − 0.1 m): m z̈ = m g + k z."""
    (tmp_path / "band.py").write_text(BAND)
    model = make_model(["gravity"]) + effects.load_effect(tmp_path / "band.py")
    ball = Trial(name="ball", diameter_m=0.02, payload_kg=0.1, travel_ratio=1.0)
    times_s = np.linspace(0, 0.2, 41)
    found = simulate(model, ball, times_s)
    root = math.sqrt(500.0 / 0.1)
    beyond = root * np.maximum(times_s - math.sqrt(0.2 / G), 0.0)
    drawn = 0.1 + math.sqrt(0.2 * G) / root * np.sinh(beyond) + G / root**2 * (np.cosh(beyond) - 1)
    truth = np.where(beyond > 0, drawn, 0.5 * G * times_s**2)
    # Steps across the breakpoint err by 1.3e-5, those that end there by 2.7e-6: the tolerance of a step and no more.
    np.testing.assert_allclose(found.lead_position_m, truth, rtol=5e-6)


# ---- a tail that cannot push ----

A, LAMBDA, L, PAYLOAD, P_Y, B = HANGING.A, HANGING.lam, HANGING.L, HANGING.payload, HANGING.P_y, HANGING.B
MU = 0.5

MODEL = base_model().with_values({"eversion_damping.B": B, "eversion_damping.n": N})
WITH_MORE = (MODEL + catalogue()["payload_friction"] + catalogue()["supply_refill"]).with_values(
    {"payload_friction.mu_p": 0.0, "supply_refill.tau": 0.0, "supply_refill.gamma": 0.0}
)
"""Both at no size: one compiled model for the tests that use either."""

RUBBING = WITH_MORE.with_values({"payload_friction.mu_p": MU})
REFILLED = WITH_MORE.with_values({"supply_refill.tau": 0.5, "supply_refill.gamma": 1.4})


def trial(P: float, **others: object) -> Trial:
    return HANGING.trial(**{"pressure_Pa": P, "tail_slack": "free", **others})


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


@pytest.mark.parametrize("P", [7e3, 14e3, 28e3])
def test_the_tip_follows_its_own_law_while_the_payload_falls(P: float) -> None:
    times = np.linspace(0, 0.3, 121)
    truth = by_hand(times, lambda _t: P)
    got = simulate(MODEL, trial(P), times)
    assert len(truth.switches) == 1
    assert got.slack_from_s == pytest.approx(truth.switches[0], abs=2e-6)
    np.testing.assert_allclose(got.lead_position_m, truth.y, rtol=0, atol=1e-5 * truth.y[-1])


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


def test_a_slack_phase_that_fails_states_the_time() -> None:
    """No step meets a tolerance of nothing: the tail goes slack at release and gets no further."""
    with pytest.raises(SimulationError):
        simulate(MODEL, trial(7e3), np.linspace(0, 0.2, 20), relative_tolerance=0.0)
