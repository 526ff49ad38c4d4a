"""Trajectories against closed forms and against SciPy in another formulation."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from vine_reference import AIR, G, masses, reference

from vinetrack import effects
from vinetrack.core.records import Trial
from vinetrack.dynamics.model import Model, base_model, make_model
from vinetrack.dynamics.simulate import simulate, simulate_many
from vinetrack.effects import EffectError
from vinetrack.laboratory.tracks import CAPTURE_FPS, PAPER_B, PAPER_N, paper_damping, paper_payload

VINE = Trial(
    name="vine",
    diameter_m=0.024,
    thickness_m=200e-6,
    length_m=0.28,
    pressure_Pa=14e3,
    yield_pressure_Pa=3e3,
)
LOADED = replace(VINE, name="loaded", payload_kg=0.0356)
WEIGHTLESS = {"thickness_m": 1e-9, "film_density_kg_m3": 1e-9}
"""A film so light that a payload is all that moves; what gas is in the body still counts as a floor, below 0.1 g."""

PROTOCOL = [*paper_damping(1), *paper_payload(1)]


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


def test_a_dropped_ball_under_the_whole_base_model_and_no_diameter() -> None:
    ball = Trial(name="ball", payload_kg=0.1, travel_ratio=1.0)
    model = with_damping(0.0)
    times_s = np.linspace(0, 1, 11)
    np.testing.assert_allclose(simulate(model, ball, times_s).lead_position_m, 0.5 * G * times_s**2, rtol=1e-8)


def test_the_tail_of_a_payload_under_constant_force_gains_speed_evenly() -> None:
    """½(P − P_y)A + m g on a mass that does not change: x = ½ a t²."""
    trial = replace(VINE, payload_kg=5.0, **WEIGHTLESS)
    mass = masses(trial)
    assert mass.film < mass.floor
    moving_kg = 5.0 + mass.floor
    a = 0.5 * 11e3 * trial.area_m2 / moving_kg + G
    times_s = np.linspace(0, 0.9 * math.sqrt(4 * trial.length_m / a), 30)
    found = simulate(with_damping(0.0), trial, times_s)
    np.testing.assert_allclose(2 * found.lead_position_m, 0.5 * a * times_s**2, rtol=1e-7, atol=1e-13)
    np.testing.assert_allclose(2 * found.lead_acceleration_m_s2[1:], a, rtol=1e-6)


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


@pytest.mark.parametrize("trial", PROTOCOL[::5], ids=lambda trial: trial.name)
def test_the_protocol_from_rest_to_a_millionth(trial: Trial) -> None:
    check_against(trial, PAPER_B[round(trial.diameter_m / 6e-3)])


def test_the_fast_vine_to_a_millionth() -> None:
    fast = replace(VINE, diameter_m=0.025, thickness_m=100e-6, length_m=0.4, pressure_Pa=62e3)
    check_against(fast, 3.3)


@pytest.mark.parametrize("n", [0.2, 0.6, 1.0])
def test_other_exponents(n: float) -> None:
    check_against(LOADED, 6.44, n=n, rel=2e-6)


def test_an_exponent_above_one_where_the_start_is_smooth() -> None:
    mass, k = masses(LOADED), 6.44 / 2

    def slope(_t: float, state: np.ndarray) -> tuple[float, float]:
        moving = float(mass.moving(state[0]))
        return state[1], (0.5 * 11e3 * LOADED.area_m2 - k * max(state[1], 0.0) ** 1.7) / moving + G

    times_s = np.linspace(0, 0.25, 40)
    truth = solve_ivp(slope, (0, 0.25), [0.0, 0.0], "DOP853", rtol=1e-12, atol=1e-14, t_eval=times_s).y[0]
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


def test_a_reservoir_running_down() -> None:
    trial = replace(VINE, chamber_m3=1.5e-3, pressure_Pa=28e3)
    model = with_damping(6.44, model=base_model() + effects.reservoir_depletion)

    def pressure(_t: float, y: float) -> float:
        swept = math.pi * 0.012**2 * y
        return (28e3 + 101_325) * (1.5e-3 / (1.5e-3 + swept)) ** 1.4 - 101_325

    truth = reference(trial, 6.44, PAPER_N, 100.0, pressure=pressure)
    times_s = frames(truth.end_s)
    found = simulate(model, trial, times_s)
    assert np.abs(found.lead_position_m - truth.state(times_s)[0] / 2).max() <= 1e-6 * trial.length_m
    undepleted = simulate(with_damping(6.44), trial, times_s)
    assert np.abs(undepleted.lead_position_m - found.lead_position_m).max() > 1e-2


# ---- rest, stalls, traces ----


def test_upward_growth_without_enough_drive_stays_at_rest() -> None:
    trial = replace(LOADED, growth_angle_rad=math.pi, pressure_Pa=3.2e3)
    found = simulate(with_damping(6.44), trial, np.linspace(-0.1, 2, 50))
    assert found.status == "stalled"
    for values in (found.lead_position_m, found.lead_velocity_m_s, found.lead_acceleration_m_s2):
        np.testing.assert_array_equal(values, 0.0)


def test_a_reservoir_that_runs_down_to_the_yield_pressure_creeps_towards_it() -> None:
    """Isothermal, horizontal: P falls to P_y where V₀/(V₀ + A y) = (P_y + P_atm)/(P₀ + P_atm), never quite reached."""
    trial = replace(VINE, chamber_m3=0.7e-3, growth_angle_rad=math.pi / 2)
    model = with_damping(6.44, model=base_model() + effects.reservoir_depletion).with_values(
        {"reservoir_depletion.gamma": 1.0}
    )
    area = math.pi * 0.012**2
    times_s = np.linspace(0.5, 60, 100)
    truth = reference(
        trial,
        6.44,
        PAPER_N,
        60.001,
        pressure=lambda _t, y: (14e3 + 101_325) * 0.7e-3 / (0.7e-3 + area * y) - 101_325,
        stiff=True,
    )
    found = simulate(model, trial, times_s)
    tight = simulate(model, trial, times_s, relative_tolerance=1e-6)
    balance_m = 0.7e-3 / area * ((14e3 + 101_325) / (3e3 + 101_325) - 1)
    assert 0.9 * balance_m < found.lead_position_m[-1] < balance_m < trial.length_m
    # The tolerance is on the speed, as a share of its highest: a creep of a minute adds up what a second does not.
    assert np.abs(found.lead_position_m - truth.state(times_s)[0] / 2).max() <= 1e-5 * balance_m
    assert np.abs(tight.lead_position_m - truth.state(times_s)[0] / 2).max() <= 1e-6 * balance_m


RISING_AGAIN = (np.array([0.0, 0.1, 0.14, 0.25, 0.4, 3.0]), np.array([14e3, 14e3, 2e3, 2e3, 12e3, 12e3]))
"""A trace, Pa, that falls below the yield pressure of 3 kPa and rises again."""


def stalled_and_restarted() -> tuple[np.ndarray, float, float]:
    """(t, x) knots of a horizontal vine under RISING_AGAIN by Radau with events, and the times of stall and restart."""
    trial = replace(LOADED, growth_angle_rad=math.pi / 2)
    mass, k = masses(trial), 6.44 / 2
    drive = lambda t: 0.5 * (np.interp(t, *RISING_AGAIN) - 3e3) * trial.area_m2  # noqa: E731

    def slope(t: float, state: np.ndarray) -> tuple[float, float]:
        return state[1], float((drive(t) - k * max(state[1], 0.0) ** PAPER_N) / mass.moving(state[0]))

    def stops(_t: float, state: np.ndarray) -> float:
        return state[1] - 1e-7

    stops.terminal, stops.direction = True, -1
    pieces, start, state = [], 0.0, np.zeros(2)
    for knot in RISING_AGAIN[0][1:4]:
        how = {"rtol": 1e-11, "atol": 1e-13, "dense_output": True, "events": stops}
        done = solve_ivp(slope, (start, knot), state, "Radau", first_step=1e-9, **how)
        pieces.append(done.sol)
        start, state = done.t[-1], done.y[:, -1]
        if done.t_events[0].size:
            break
    stall_s = float(start)
    restart_s = 0.25 + 0.15 * (3e3 - 2e3) / (12e3 - 2e3)
    pieces.append(lambda t, x=state[0]: np.array([np.full(np.shape(t), x), np.zeros(np.shape(t))]))
    # At the very restart drive and speed are both zero; 10 µs later the speed follows the drive, at some 10⁻¹² m/s.
    begin_s = restart_s + 1e-5
    first = [state[0], (drive(begin_s) / k) ** (1 / PAPER_N)]
    done = solve_ivp(slope, (begin_s, 0.4), first, "Radau", rtol=1e-11, atol=1e-15, dense_output=True)
    assert done.status == 0
    times_s = np.linspace(0.01, 0.4, 118)
    x = np.empty_like(times_s)
    for i, t in enumerate(times_s):
        if t > begin_s:
            x[i] = done.sol(t)[0]
        elif t > stall_s:
            x[i] = state[0]
        else:
            x[i] = next(piece(t)[0] for piece in pieces if t <= piece.t_max)
    return np.array([times_s, x]), stall_s, restart_s


def test_a_trace_that_falls_below_the_yield_pressure_stalls_the_vine_and_restarts_it() -> None:
    (times_s, tail_m), stall_s, restart_s = stalled_and_restarted()
    assert 0.1 < stall_s < restart_s
    trial = replace(LOADED, growth_angle_rad=math.pi / 2)
    found = simulate(with_damping(6.44), trial, times_s, trace=RISING_AGAIN)
    assert np.abs(found.lead_position_m - tail_m / 2).max() <= 2e-6 * found.lead_position_m[-1]
    resting = (times_s > stall_s) & (times_s < restart_s)
    assert resting.sum() > 3
    np.testing.assert_array_equal(found.lead_velocity_m_s[resting], 0.0)
    assert (found.lead_velocity_m_s[times_s > restart_s + 0.01] > 0).all()
    assert found.status == "running"


def test_a_trace_that_never_changes_is_the_set_pressure() -> None:
    times_s = np.linspace(0, 0.5, 40)
    set_only = simulate(with_damping(6.44), LOADED, times_s)
    traced = simulate(with_damping(6.44), LOADED, times_s, trace=(np.array([0.0, 0.3, 1.0]), np.full(3, 14e3)))
    np.testing.assert_allclose(traced.lead_position_m, set_only.lead_position_m, rtol=0, atol=1e-9)


def test_a_trace_replaces_set_pressure_and_reservoir() -> None:
    times_s = np.linspace(0, 0.5, 40)
    trial = replace(LOADED, chamber_m3=1e-3)
    trace = (np.array([0.0, 1.0]), np.full(2, 9e3))
    plain = simulate(with_damping(6.44), LOADED, times_s, trace=trace)
    depleting = with_damping(6.44, model=base_model() + effects.reservoir_depletion)
    np.testing.assert_array_equal(
        simulate(depleting, trial, times_s, trace=trace).lead_position_m, plain.lead_position_m
    )


def test_after_the_end_of_growth_it_stays_at_its_length() -> None:
    found = simulate(with_damping(6.44), VINE, np.linspace(0, 5, 300))
    after = found.time_s > found.end_time_s
    assert after.sum() > 100
    np.testing.assert_array_equal(found.lead_position_m[after], VINE.length_m)
    np.testing.assert_array_equal(found.lead_velocity_m_s[after], 0.0)
    assert found.end_lead_velocity_m_s > 0


def test_before_release_it_rests() -> None:
    found = simulate(with_damping(6.44), VINE, np.array([-1.0, -1e-9, 0.0, 0.01]))
    np.testing.assert_array_equal(found.lead_position_m[:3], 0.0)
    np.testing.assert_array_equal(found.lead_velocity_m_s[:3], 0.0)
    assert found.lead_position_m[3] > 0


def test_no_times_no_rows() -> None:
    found = simulate(with_damping(6.44), VINE, np.array([]))
    assert found.lead_position_m.shape == (0,)
    assert simulate_many(with_damping(6.44), [], []) == []


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


def test_parameters_of_each_trial_replace_those_of_the_model() -> None:
    times = [np.linspace(0, 0.3, 10)] * 2
    model = with_damping(6.44)
    rows = np.array([model.parameters_for(""), with_damping(3.0).parameters_for("")])
    given = simulate_many(model, [VINE, VINE], times, parameters=rows)
    np.testing.assert_array_equal(given[1].lead_position_m, simulate(with_damping(3.0), VINE, times[0]).lead_position_m)


def test_arguments_are_unchanged() -> None:
    times_s, trace = np.linspace(0, 0.3, 10), (np.array([0.0, 1.0]), np.array([14e3, 13e3]))
    before = times_s.copy(), trace[0].copy(), trace[1].copy()
    simulate(with_damping(6.44), VINE, times_s, trace=trace)
    for now, then in zip((times_s, *trace), before, strict=True):
        np.testing.assert_array_equal(now, then)


# ---- energy ----


def test_work_of_the_gas_and_weight_is_motion_damping_and_the_folds_loss() -> None:
    """With c = λ/2 the film laid down at the fold loses its energy there: no term in ẋ dm/dt.

    Work of ½(P − P_y)A and of the weight, less ½Bẋⁿ along x, is ½mẋ² at the end plus ∫½cẋ²dx of film come to rest.
    """
    trial, B = replace(VINE, pressure_Pa=40e3), 6.44
    model = with_damping(B)
    end_s = simulate(model, trial, np.array([0.0, 9.0])).end_time_s
    # Graded, because power near rest is not smooth: the trapezium's error falls with the square of the spacing.
    times_s = 0.9 * end_s * np.linspace(0, 1, 20_001) ** 3
    found = simulate(model, trial, times_s)
    x, v = 2 * found.lead_position_m, 2 * found.lead_velocity_m_s
    mass = masses(trial)
    moving = mass.moving(x)
    inward = 0.5 * 37e3 * trial.area_m2 + moving * G
    work = np.trapezoid(inward * v, times_s)
    damped = np.trapezoid(0.5 * B * v ** (PAPER_N + 1), times_s)
    stopped = np.trapezoid(0.5 * mass.lost_per_m * v**3, times_s)
    kinetic = 0.5 * moving[-1] * v[-1] ** 2
    assert work == pytest.approx(damped + stopped + kinetic, rel=2e-6)
    assert stopped > 1e-2 * work


# ---- what a user gets wrong ----


def test_an_effect_that_needs_a_column_names_it() -> None:
    model = base_model() + effects.reservoir_depletion
    with pytest.raises(EffectError, match=r"Trial vine.*reservoir_depletion needs `chamber_l`"):
        simulate(model, VINE, np.linspace(0, 1, 5))


def test_a_blank_yield_pressure_is_named() -> None:
    with pytest.raises(EffectError, match=r"yield_pressure needs `yield_pressure_kPa`"):
        simulate(base_model(), replace(VINE, yield_pressure_Pa=math.nan), np.linspace(0, 1, 5))


def test_the_floor_of_the_mass_is_fold_and_gas() -> None:
    """A bare vine's film reaches the floor before y = L; both sides of it are followed."""
    mass = masses(VINE)
    gas_kg = (14e3 + 101_325) / AIR * VINE.area_m2 * VINE.length_m
    assert mass.floor > gas_kg / 4
    assert mass.break_m < 2 * VINE.length_m


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
