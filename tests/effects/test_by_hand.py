"""What the other simulator does not cover: effects together, faults of the camera, rest; written out by hand."""

import math
from dataclasses import replace

import numpy as np
import pytest
from by_hand import ATM, LEVEL, LOADED, RT_AIR, G, N, Vine, assert_same_motion, followed, simulated
from scipy.integrate import cumulative_trapezoid, solve_ivp

from vinetrack.core.records import Bend


def test_capstan_friction_as_printed_is_a_constant():
    vine = LOADED

    def acceleration(_t: float, x: float, v: float) -> float:
        # As printed: c = λ and the whole of the bend from the start.
        m = vine.lam * vine.L - vine.lam * x + vine.payload
        force = 0.5 * (vine.P - vine.P_y) * vine.A + m * G - 0.5 * vine.B * v**0.37
        return (force - 0.1 * math.exp(0.7 * 0.06 / 0.05)) / m

    sizes = {"capstan_friction.C": 0.1, "capstan_friction.mu_c": 0.7}
    bends = (Bend(0.05, 0.06, 0.05),)
    assert_same_motion(vine, sizes, acceleration, share=0.45, bends=bends, mass_loss="as_printed")


def test_gauge_then_chamber_then_leak_then_inlet_then_stretch():
    vine = LOADED
    sizes = {"pressure_gain.eps": 0.02, "pressure_gauge.delta": 700.0, "leak.rate": 2.0, "inlet_loss.K": 1.5}
    sizes |= {"wall_stretch.kappa": 4e-6, "supply_refill.tau": 0.05, "supply_refill.gamma": 1.4}
    V0, A_in = 3.7e-3, math.pi * 6e-3**2 / 4
    P_0, P_y = 1.02 * vine.P + 700.0, 1.02 * vine.P_y

    def at_the_tip(t: float, v: float, P: float) -> tuple[float, float]:
        leaked = P * math.exp(-2.0 * t)
        area = vine.A
        for _ in range(60):
            rho = (leaked + ATM) / RT_AIR
            tip = leaked - 1.5 * 0.5 * rho * (v / 2) ** 2 * (area / A_in) ** 2
            area = vine.A * (1 + 4e-6 * tip) ** 2
        return tip, area

    def acceleration(t: float, x: float, v: float, P: float) -> float:
        tip, area = at_the_tip(t, v, P)
        return (0.5 * (tip - P_y) * area - 0.5 * vine.B * v**N + vine.m(x) * 9.81) / vine.m(x)

    def rate(t: float, x: float, v: float, P: float) -> float:
        area = at_the_tip(t, v, P)[1]
        return -1.4 * (P + ATM) * area * (v / 2) / (V0 + area * x / 2) + (P_0 - P) / 0.05

    assert_same_motion(vine, sizes, acceleration, chamber=(P_0, rate))


@pytest.mark.parametrize("name", ["reservoir_depletion.gamma", "leak.rate", "supply_refill.tau"])
def test_a_measured_pressure_already_holds_what_happens_in_the_chamber(name):
    trace = (np.array([0.0, 0.1, 0.2]), np.array([28e3, 24e3, 25e3]))
    plain = simulated(LOADED, {}, TIMES, trace).lead_position_m
    np.testing.assert_array_equal(simulated(LOADED, {name: 1.2}, TIMES, trace).lead_position_m, plain)
    assert np.max(np.abs(simulated(LOADED, {name: 1.2}, TIMES).lead_position_m - plain)) > 1e-4


FAST = Vine(D=30e-3, t=100e-6, L=0.36, P=61e3, P_y=4.5e3, B=3.6)
TIMES = np.linspace(0, 0.15, 50)
P_S = 8e3
UP_AND_DOWN = (np.array([0.0, 0.2, 0.4, 0.6, 0.8, 1.0]), np.array([2e3, 12e3, 1e3, 1e3, 11e3, 11e3]))


def by_hand(times: np.ndarray) -> tuple[np.ndarray, list[tuple[float, float]]]:
    """Lead position, and the stretches of motion: start where P rises through P_s, stop where the speed comes to 0."""
    vine, y, x, moving = LEVEL, np.zeros_like(times), 0.0, []
    # P crosses 8 kPa upwards at 0.2·(8 − 2)/10 = 0.12 s, and at 0.6 + 0.2·7/10 = 0.74 s.
    for start, until in ((0.12, 0.74), (0.74, 1.0)):

        def slope(t: float, s: np.ndarray) -> list[float]:
            force = 0.5 * (np.interp(t, *UP_AND_DOWN) - vine.P_y) * vine.A - 0.5 * vine.B * max(s[1], 0.0) ** N
            return [max(s[1], 0.0), force / vine.m(s[0])]

        def stops(t: float, s: np.ndarray, start: float = start) -> float:
            return s[1] if t > start + 1e-3 else 1.0

        stops.terminal, stops.direction = True, -1
        how = {"rtol": 1e-10, "atol": 1e-13, "dense_output": True, "max_step": 2e-3}
        done = solve_ivp(slope, (start, until), [x, 0.0], "LSODA", events=stops, **how)
        end = float(done.t[-1])
        inside = (times > start) & (times <= end)
        y[inside] = done.sol(times[inside])[0] / 2
        x = float(done.y[0, -1])
        y[times > end] = x / 2
        moving.append((start, end))
    return y, moving


def test_it_sticks_and_slips_never_starts_below_p_s_and_released_above_it_leaves_no_trace():
    times = np.linspace(0, 1.0, 501)
    truth, moving = by_hand(times)
    got = simulated(LEVEL, {"static_yield.P_s": P_S}, times, UP_AND_DOWN)
    assert 0.2 < moving[0][1] < 0.4  # it stops on the way down, and starts again
    assert truth[-1] > truth[300] + 0.005
    np.testing.assert_allclose(got.lead_position_m, truth, rtol=0, atol=1e-5 * truth[-1])
    resting = ((times < 0.12) | (times > moving[0][1] + 1e-3)) & (times < 0.74)
    assert np.all(got.lead_velocity_m_s[resting] == 0)
    never = simulated(LEVEL, {"static_yield.P_s": 30e3}, TIMES)
    assert never.status == "stalled"
    assert np.all(never.lead_position_m == 0)
    free = simulated(LEVEL, {}, TIMES).lead_position_m
    for P_s in (3e3, 20e3):
        np.testing.assert_array_equal(simulated(LEVEL, {"static_yield.P_s": P_s}, TIMES).lead_position_m, free)


@pytest.mark.parametrize("first", [{"perspective.k": 0.2}, {"tail_stretch.compliance": 5e-8}], ids=["lens", "stretch"])
def test_the_scale_stretches_last(first):
    seen = simulated(LOADED, first, TIMES).observed_position_m
    got = simulated(LOADED, {**first, "length_scale.eps": 0.05}, TIMES).observed_position_m
    np.testing.assert_allclose(got, 1.05 * seen, rtol=1e-12)


@pytest.mark.parametrize(
    ("stated", "true", "sizes"),
    [
        (LEVEL, LOADED, {"growth_angle.f": 1.0}),
        (LOADED, LEVEL, {"growth_angle.f": 1.0}),
        *((v, replace(v, payload=v.payload + 6e-3), {"payload_mass.delta": 6e-3}) for v in (LOADED, LEVEL)),
        *((v, replace(v, payload=v.payload - 20e-3), {"payload_mass.delta": -20e-3}) for v in (LOADED, LEVEL)),
    ],
)
def test_an_angle_counted_from_the_level_and_a_payload_of_another_mass_are_those_of_the_true_vine(stated, true, sizes):
    """Such as a mount that was not weighed; less by far more than all of the film weighs, too."""
    assert_same_motion(stated, sizes, lambda _t, x, v: true.base(x, v) / true.m(x))


def test_a_lens_bends_about_the_middle_of_the_picture():
    plain = simulated(LOADED, {}, TIMES).lead_position_m
    got = simulated(LOADED, {"lens.k3": -0.7, "lens.y_c": 0.1}, TIMES).observed_position_m
    np.testing.assert_allclose(got, plain - 0.7 * ((plain - 0.1) ** 3 + 0.1**3), rtol=1e-12)


@pytest.mark.parametrize("phase_s", [0.0, 2.1e-4, 4.9e-4])
@pytest.mark.parametrize("delay", [1.5e-3, -1.5e-3, 1e-6])
@pytest.mark.parametrize("vine", [LOADED, FAST], ids=["2 m/s", "60 m/s"])
def test_a_rolling_shutter_sees_the_edge_where_it_is_when_its_row_is_read(vine, delay, phase_s):
    fine = np.linspace(-0.01, 0.3, 400_001)
    ended = simulated(vine, {}, fine)
    y = ended.lead_position_m
    stamped = fine - delay * y  # the row at y is read delay · y after the stamp of its picture
    times = np.arange(-0.005, ended.end_time_s + 0.003, 5e-4) + phase_s  # release lies on a frame or between two
    got = simulated(vine, {"rolling_shutter.delay": delay}, times).observed_position_m
    np.testing.assert_allclose(got, np.interp(times, stamped, y), rtol=0, atol=5e-6)
    assert np.max(np.abs(got - np.interp(times, fine, y))) > 0.6 * abs(delay)


@pytest.mark.parametrize("delay", [1.5e-3, -1.5e-3])
def test_a_rolling_shutter_reads_what_the_lens_bends(delay):
    lens = {"lens.k3": -0.7, "lens.y_c": 0.1}
    fine = np.linspace(-0.01, 0.1, 200_001)
    bent = simulated(LOADED, lens, fine).observed_position_m
    times = np.arange(-0.005, 0.08, 2e-3)
    got = simulated(LOADED, {"rolling_shutter.delay": delay, **lens}, times).observed_position_m
    # Between frames the lens is followed by straight lines: f'' (Δy)² / 8 = 4.2 · 0.1 m⁻¹ · (4 mm)² / 8.
    np.testing.assert_allclose(got, np.interp(times, fine - delay * bent, bent), rtol=0, atol=1.5e-6)


@pytest.mark.parametrize("phase_s", [0.0, 2.1e-4])
@pytest.mark.parametrize("over_s", [5e-4, 4.8e-3])
@pytest.mark.parametrize("vine", [LOADED, FAST], ids=["2 m/s", "60 m/s"])
def test_a_moving_average_reports_the_mean_about_every_instant(vine, over_s, phase_s):
    fine = np.linspace(-0.02, 0.3, 640_001)
    ended = simulated(vine, {}, fine)
    y = ended.lead_position_m
    area = cumulative_trapezoid(y, fine, initial=0.0)
    times = np.arange(-0.005, ended.end_time_s + 0.005, 5e-4) + phase_s
    got = simulated(vine, {"moving_average.T2": over_s**2}, times).observed_position_m
    after, before = (np.interp(times + side * over_s / 2, fine, area) for side in (1, -1))
    np.testing.assert_allclose(got, (after - before) / over_s, rtol=0, atol=1e-5)
    assert np.max(np.abs(got - np.interp(times, fine, y))) > 20 * over_s**2  # a ÿ of 500 m/s², or the release


def test_a_supply_that_rises_starts_the_vine_once_it_overcomes_the_yield_pressure():
    vine, tau = LEVEL, 8e-3

    def acceleration(t: float, x: float, v: float) -> float:
        drive = 0.5 * (vine.P * (1 - math.exp(-t / tau)) - vine.P_y) * vine.A
        held = drive - 0.5 * vine.B * max(v, 0.0) ** N
        return held / vine.m(x) if v > 0 or held > 0 else 0.0

    travel = followed(acceleration, 1.8 * vine.L, max_step=1e-4)
    times = np.linspace(0.0, travel.end, 61)
    got = simulated(vine, {"supply_rise.tau": tau}, times).lead_position_m
    np.testing.assert_allclose(got, travel(times) / 2, rtol=0, atol=1e-5 * vine.L)
    assert simulated(vine, {}, times).lead_position_m[20] > got[20] + 5e-3


def test_the_clock_of_a_trace_shifts_the_pressure_that_drives():
    delay, clock, pressure = 4e-3, np.array([0.0, 5e-3, 0.02, 0.3]), np.array([0.0, 0.0, 28e3, 28e3])
    late = simulated(LOADED, {}, TIMES, (clock + delay, pressure)).lead_position_m
    got = simulated(LOADED, {"trace_clock.delta": delay}, TIMES, (clock, pressure)).observed_position_m
    np.testing.assert_allclose(got, late, rtol=0, atol=1e-12)
    assert np.max(np.abs(simulated(LOADED, {}, TIMES, (clock, pressure)).lead_position_m - late)) > 9e-4
