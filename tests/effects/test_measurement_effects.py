"""What is wrong with the measurement, not with the vine: scale, clock, gauge, diameter, lens."""

from __future__ import annotations

import math

import numpy as np
import pytest
from by_hand import BARE, LOADED, G, N, Vine, assert_same_motion, simulated

TIMES = np.linspace(0, 0.15, 50)


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
