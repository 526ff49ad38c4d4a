"""What is wrong with the measurement, not with the vine: scale, clock, gauge, diameter, lens."""

from __future__ import annotations

import math

import numpy as np
import pytest
from by_hand import BARE, LEVEL, LOADED, G, N, Vine, assert_same_motion, followed, simulated
from scipy.integrate import cumulative_trapezoid

TIMES = np.linspace(0, 0.15, 50)
FAST = Vine(D=30e-3, t=100e-6, L=0.36, P=61e3, P_y=4.5e3, B=3.6)


def test_length_scale_stretches_what_is_reported() -> None:
    plain = simulated(LOADED, {}, TIMES)
    got = simulated(LOADED, {"length_scale.eps": 0.03}, TIMES)
    np.testing.assert_allclose(got.observed_position_m, 1.03 * plain.lead_position_m, rtol=1e-12)
    np.testing.assert_array_equal(got.lead_position_m, plain.lead_position_m)


def test_time_base_stretches_the_clock() -> None:
    plain = simulated(LOADED, {}, TIMES)
    got = simulated(LOADED, {"time_base.eps": 0.03}, 1.03 * TIMES)
    np.testing.assert_allclose(got.observed_position_m, plain.observed_position_m, rtol=0, atol=1e-12)


def test_perspective_bends_what_is_reported() -> None:
    plain = simulated(LOADED, {}, TIMES).lead_position_m
    got = simulated(LOADED, {"perspective.k": -0.2}, TIMES).observed_position_m
    np.testing.assert_allclose(got, plain - 0.2 * plain**2, rtol=1e-12)


def test_the_lens_bends_before_the_scale_stretches() -> None:
    plain = simulated(LOADED, {}, TIMES).lead_position_m
    got = simulated(LOADED, {"perspective.k": 0.2, "length_scale.eps": 0.05}, TIMES).observed_position_m
    np.testing.assert_allclose(got, 1.05 * (plain + 0.2 * plain**2), rtol=1e-12)


def test_the_camera_sees_the_stretched_tail_through_its_own_faults() -> None:
    stretched = simulated(LOADED, {"tail_stretch.compliance": 5e-8}, TIMES).observed_position_m
    got = simulated(LOADED, {"tail_stretch.compliance": 5e-8, "length_scale.eps": 0.05}, TIMES).observed_position_m
    np.testing.assert_allclose(got, 1.05 * stretched, rtol=1e-12)


@pytest.mark.parametrize("vine", [BARE, LOADED], ids=["bare", "loaded"])
def test_pressure_gain_holds_for_p_and_yield_pressure(vine: Vine) -> None:
    def acceleration(_t: float, x: float, v: float) -> float:
        drive = 0.5 * 1.04 * (vine.P - vine.P_y) * vine.A
        return (drive + vine.m(x) * G - 0.5 * vine.B * v**N) / vine.m(x)

    assert_same_motion(vine, {"pressure_gain.eps": 0.04}, acceleration)


def test_pressure_gauge_shifts_p_alone() -> None:
    vine = LOADED
    assert_same_motion(
        vine, {"pressure_gauge.delta": -900.0}, lambda _t, x, v: vine.base(x, v, P=vine.P - 900.0) / vine.m(x)
    )


def test_gain_acts_before_the_offset_of_the_gauge() -> None:
    vine = LOADED

    def acceleration(_t: float, x: float, v: float) -> float:
        drive = 0.5 * (1.05 * vine.P + 2000.0 - 1.05 * vine.P_y) * vine.A
        return (drive + vine.m(x) * G - 0.5 * vine.B * v**N) / vine.m(x)

    assert_same_motion(vine, {"pressure_gain.eps": 0.05, "pressure_gauge.delta": 2000.0}, acceleration)


@pytest.mark.parametrize("vine", [BARE, LOADED], ids=["bare", "loaded"])
def test_area_scale_changes_area_and_film(vine: Vine) -> None:
    area, lam = math.pi * (1.03 * vine.D) ** 2 / 4, 1200 * math.pi * 1.03 * vine.D * vine.t

    def acceleration(_t: float, x: float, v: float) -> float:
        m = lam * vine.L - lam / 2 * x + vine.payload
        return (0.5 * (vine.P - vine.P_y) * area + m * G - 0.5 * vine.B * v**N) / m

    assert_same_motion(vine, {"area_scale.eps": 0.03}, acceleration)


@pytest.mark.parametrize("vine", [BARE, LOADED], ids=["bare", "loaded"])
def test_heavier_film_leaves_forces_and_payload(vine: Vine) -> None:
    lam = 1.05 * 1200 * math.pi * vine.D * vine.t

    def acceleration(_t: float, x: float, v: float) -> float:
        m = lam * (vine.L - x / 2) + vine.payload
        return (0.5 * (vine.P - vine.P_y) * vine.A + m * G - 0.5 * vine.B * v**N) / m

    assert_same_motion(vine, {"film_mass.eps": 0.05}, acceleration)


@pytest.mark.parametrize("delta", [6e-3, -20e-3], ids=["more", "less"])
@pytest.mark.parametrize("vine", [LOADED, LEVEL], ids=["hangs", "level"])
def test_a_payload_that_weighs_other_than_stated(vine: Vine, delta: float) -> None:
    """Such as a mount that was not weighed; less by far more than all of the film weighs, too."""
    true = Vine(**{**vine.__dict__, "payload": vine.payload + delta})
    assert_same_motion(vine, {"payload_mass.delta": delta}, lambda _t, x, v: true.base(x, v) / true.m(x))


@pytest.mark.parametrize(("stated", "true"), [(LEVEL, LOADED), (LOADED, LEVEL)], ids=["hangs", "level"])
def test_a_growth_angle_counted_from_the_level_has_the_weight_of_the_other_direction(stated: Vine, true: Vine) -> None:
    assert_same_motion(stated, {"growth_angle.f": 1.0}, lambda _t, x, v: true.base(x, v) / true.m(x))


def test_a_growth_angle_stated_down_for_up_is_twice_the_slip() -> None:
    up = Vine(**{**LOADED.__dict__, "down": -1.0})
    assert_same_motion(LOADED, {"growth_angle.f": 2.0}, lambda _t, x, v: up.base(x, v) / up.m(x))


def test_a_lens_bends_about_the_middle_of_the_picture() -> None:
    plain = simulated(LOADED, {}, TIMES).lead_position_m
    got = simulated(LOADED, {"lens.k3": -0.7, "lens.y_c": 0.1}, TIMES).observed_position_m
    np.testing.assert_allclose(got, plain - 0.7 * ((plain - 0.1) ** 3 + 0.1**3), rtol=1e-12)


@pytest.mark.parametrize("phase_s", [0.0, 2.1e-4, 4.9e-4])
@pytest.mark.parametrize("delay", [1.5e-3, -1.5e-3, 1e-6])
@pytest.mark.parametrize("vine", [LOADED, FAST], ids=["2 m/s", "60 m/s"])
def test_a_rolling_shutter_sees_the_edge_where_it_is_when_its_row_is_read(
    vine: Vine, delay: float, phase_s: float
) -> None:
    fine = np.linspace(-0.01, 0.3, 400_001)
    y = simulated(vine, {}, fine).lead_position_m
    stamped = fine - delay * y  # the row at y is read delay · y after the stamp of its picture
    ended = simulated(vine, {}, fine)
    assert ended.status == "ended"
    times = np.arange(-0.005, ended.end_time_s + 0.003, 5e-4) + phase_s  # release lies on a frame or between two
    got = simulated(vine, {"rolling_shutter.delay": delay}, times).observed_position_m
    np.testing.assert_allclose(got, np.interp(times, stamped, y), rtol=0, atol=5e-6)
    assert np.max(np.abs(got - np.interp(times, fine, y))) > 0.6 * abs(delay)


@pytest.mark.parametrize("delay", [1.5e-3, -1.5e-3])
def test_a_rolling_shutter_reads_what_the_lens_bends(delay: float) -> None:
    lens = {"lens.k3": -0.7, "lens.y_c": 0.1}
    fine = np.linspace(-0.01, 0.1, 200_001)
    bent = simulated(LOADED, lens, fine).observed_position_m
    times = np.arange(-0.005, 0.08, 2e-3)
    got = simulated(LOADED, {"rolling_shutter.delay": delay, **lens}, times).observed_position_m
    # Between frames the lens is followed by straight lines: f'' (Δy)² / 8 = 4.2 · 0.1 m⁻¹ · (4 mm)² / 8.
    np.testing.assert_allclose(got, np.interp(times, fine - delay * bent, bent), rtol=0, atol=1.5e-6)


def test_a_rolling_shutter_of_no_size_does_nothing_where_the_vine_sets_off() -> None:
    times = np.arange(-0.005, 0.02, 5e-4) + 2.1e-4
    at_rest = times < 0
    got = simulated(FAST, {"rolling_shutter.delay": 1e-6}, times).observed_position_m
    np.testing.assert_array_equal(got[at_rest], simulated(FAST, {}, times).observed_position_m[at_rest])


@pytest.mark.parametrize("phase_s", [0.0, 2.1e-4])
@pytest.mark.parametrize("over_s", [5e-4, 4.8e-3])
@pytest.mark.parametrize("vine", [LOADED, FAST], ids=["2 m/s", "60 m/s"])
def test_a_moving_average_reports_the_mean_about_every_instant(vine: Vine, over_s: float, phase_s: float) -> None:
    fine = np.linspace(-0.02, 0.3, 640_001)
    y = simulated(vine, {}, fine).lead_position_m
    area = cumulative_trapezoid(y, fine, initial=0.0)
    ended = simulated(vine, {}, fine)
    times = np.arange(-0.005, ended.end_time_s + 0.005, 5e-4) + phase_s
    got = simulated(vine, {"moving_average.T2": over_s**2}, times).observed_position_m
    after, before = (np.interp(times + side * over_s / 2, fine, area) for side in (1, -1))
    np.testing.assert_allclose(got, (after - before) / over_s, rtol=0, atol=1e-5)
    assert np.max(np.abs(got - np.interp(times, fine, y))) > 20 * over_s**2  # a ÿ of 500 m/s², or the release


def test_a_moving_average_of_no_length_does_nothing() -> None:
    np.testing.assert_array_equal(
        simulated(FAST, {"moving_average.T2": 0.0}, TIMES).observed_position_m,
        simulated(FAST, {}, TIMES).lead_position_m,
    )


def test_a_supply_that_rises_starts_the_vine_once_it_overcomes_the_yield_pressure() -> None:
    vine, tau = LEVEL, 8e-3

    def acceleration(t: float, x: float, v: float) -> float:
        drive = 0.5 * (vine.P * (1 - math.exp(-t / tau)) - vine.P_y) * vine.A
        held = drive - 0.5 * vine.B * max(v, 0.0) ** N
        return held / vine.m(x) if v > 0 or held > 0 else 0.0

    travel = followed(acceleration, 1.8 * vine.L, max_step=1e-4)
    times = np.linspace(0.0, travel.end, 61)  # type: ignore[attr-defined]
    got = simulated(vine, {"supply_rise.tau": tau}, times).lead_position_m
    np.testing.assert_allclose(got, travel(times) / 2, rtol=0, atol=1e-5 * vine.L)
    assert simulated(vine, {}, times).lead_position_m[20] > got[20] + 5e-3


def test_the_clock_of_a_trace_shifts_the_pressure_that_drives() -> None:
    delay, clock, pressure = 4e-3, np.array([0.0, 5e-3, 0.02, 0.3]), np.array([0.0, 0.0, 28e3, 28e3])
    late = simulated(LOADED, {}, TIMES, (clock + delay, pressure)).lead_position_m
    got = simulated(LOADED, {"trace_clock.delta": delay}, TIMES, (clock, pressure)).observed_position_m
    np.testing.assert_allclose(got, late, rtol=0, atol=1e-12)
    assert np.max(np.abs(simulated(LOADED, {}, TIMES, (clock, pressure)).lead_position_m - late)) > 9e-4
