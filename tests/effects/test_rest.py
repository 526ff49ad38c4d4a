"""Stick and slip: a vine at rest starts only above P_s, and then goes on down to P_y."""

from __future__ import annotations

import numpy as np
import pytest
from by_hand import LEVEL, N, simulated
from scipy.integrate import solve_ivp

P_S = 8e3
UP_AND_DOWN = (np.array([0.0, 0.2, 0.4, 0.6, 0.8, 1.0]), np.array([2e3, 12e3, 1e3, 1e3, 11e3, 11e3]))


def pressure(t: float) -> float:
    return float(np.interp(t, *UP_AND_DOWN))


def by_hand(times: np.ndarray) -> tuple[np.ndarray, list[tuple[float, float]]]:
    """Lead position, and the stretches of motion: start where P rises through P_s, stop where the speed comes to 0."""
    vine, y, x, moving = LEVEL, np.zeros_like(times), 0.0, []
    # P crosses 8 kPa upwards at 0.2·(8 − 2)/10 = 0.12 s, and at 0.6 + 0.2·7/10 = 0.74 s.
    for start, until in ((0.12, 0.74), (0.74, 1.0)):

        def slope(t: float, s: np.ndarray) -> list[float]:
            force = 0.5 * (pressure(t) - vine.P_y) * vine.A - 0.5 * vine.B * max(s[1], 0.0) ** N
            return [max(s[1], 0.0), force / vine.m(s[0])]

        def stops(t: float, s: np.ndarray, start: float = start) -> float:
            return s[1] if t > start + 1e-3 else 1.0

        stops.terminal = True  # type: ignore[attr-defined]
        stops.direction = -1  # type: ignore[attr-defined]
        done = solve_ivp(
            slope,
            (start, until),
            [x, 0.0],
            "LSODA",
            rtol=1e-10,
            atol=1e-13,
            events=stops,
            dense_output=True,
            max_step=2e-3,
        )
        end = float(done.t[-1])
        inside = (times > start) & (times <= end)
        y[inside] = done.sol(times[inside])[0] / 2
        x = float(done.y[0, -1])
        y[times > end] = x / 2
        moving.append((start, end))
    return y, moving


def test_stick_and_slip_under_a_pressure_that_rises_and_falls() -> None:
    times = np.linspace(0, 1.0, 501)
    truth, moving = by_hand(times)
    got = simulated(LEVEL, {"static_yield.P_s": P_S}, times, UP_AND_DOWN)
    assert 0.2 < moving[0][1] < 0.4  # it stops on the way down, and starts again
    assert truth[-1] > truth[300] + 0.005
    np.testing.assert_allclose(got.lead_position_m, truth, rtol=0, atol=1e-5 * truth[-1])
    resting = ((times < 0.12) | (times > moving[0][1] + 1e-3)) & (times < 0.74)
    assert np.all(got.lead_velocity_m_s[resting] == 0)


def test_without_it_growth_starts_at_the_yield_pressure() -> None:
    # P crosses 3 kPa at 0.02 s.
    got = simulated(LEVEL, {}, np.array([0.019, 0.03]), UP_AND_DOWN)
    assert got.lead_position_m[0] == 0
    assert got.lead_position_m[1] > 0


def test_below_p_s_it_never_starts() -> None:
    got = simulated(LEVEL, {"static_yield.P_s": 30e3}, np.linspace(0, 1, 11))
    assert got.status == "stalled"
    assert np.all(got.lead_position_m == 0)


@pytest.mark.parametrize("P_s", [0.0, 3e3, 20e3])
def test_released_above_p_s_it_leaves_no_trace(P_s: float) -> None:
    times = np.linspace(0, 0.15, 40)
    got = simulated(LEVEL, {"static_yield.P_s": P_s}, times).lead_position_m
    np.testing.assert_array_equal(got, simulated(LEVEL, {}, times).lead_position_m)
