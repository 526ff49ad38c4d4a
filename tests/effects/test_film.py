"""What pressure and tension do to the film: stretch of wall and tail, and damping that grows with pressure."""

from __future__ import annotations

import math

import numpy as np
import pytest
from by_hand import ATM, BARE, LOADED, N, Vine, assert_same_motion, followed, simulated
from scipy.optimize import brentq

BOTH = pytest.mark.parametrize("vine", [BARE, LOADED], ids=["bare", "loaded"])
KAPPA = 3e-6


@BOTH
def test_wall_stretch_widens_drive_and_yield_but_not_the_film(vine: Vine) -> None:
    wide = vine.A * (1 + KAPPA * vine.P) ** 2
    assert_same_motion(vine, {"wall_stretch.kappa": KAPPA}, lambda _t, x, v: vine.base(x, v, A=wide) / vine.m(x))


def test_wall_stretch_widens_what_the_air_meets() -> None:
    vine = BARE
    wide = vine.A * (1 + KAPPA * vine.P) ** 2

    def acceleration(_t: float, x: float, v: float) -> float:
        return (vine.base(x, v, A=wide) - 0.25 * 1.2 * wide * 30.0 * (v / 2) ** 2) / vine.m(x)

    assert_same_motion(vine, {"wall_stretch.kappa": KAPPA, "air_drag.C_D": 30.0}, acceleration)


def test_wall_stretch_sweeps_more_of_the_chamber() -> None:
    vine, V0 = LOADED, 3.7e-3

    def agreed(x: float) -> tuple[float, float]:
        def gap(P: float) -> float:
            area = vine.A * (1 + 8e-6 * P) ** 2
            return (vine.P + ATM) * (V0 / (V0 + area * x / 2)) ** 1.4 - ATM - P

        P = brentq(gap, -5e4, 1e5, xtol=1e-9)
        return P, vine.A * (1 + 8e-6 * P) ** 2

    def acceleration(_t: float, x: float, v: float) -> float:
        P, A = agreed(x)
        return vine.base(x, v, P=P, A=A) / vine.m(x)

    assert_same_motion(vine, {"wall_stretch.kappa": 8e-6, "reservoir_depletion.gamma": 1.4}, acceleration)


@BOTH
@pytest.mark.parametrize("beta", [-5e-6, 5e-6])
def test_pressure_damping_changes_the_damping_alone(vine: Vine, beta: float) -> None:
    def acceleration(_t: float, x: float, v: float) -> float:
        return (vine.base(x, v) - 0.5 * vine.B * beta * vine.P * v**N) / vine.m(x)

    assert_same_motion(vine, {"pressure_damping.beta": beta}, acceleration)


@BOTH
def test_tail_stretch_puts_the_edge_ahead_by_the_strain_of_tail_and_wall(vine: Vine) -> None:
    E = 20e6
    travel = followed(lambda _t, x, v: vine.base(x, v) / vine.m(x), 1.8 * vine.L)
    times = np.linspace(0, 0.98 * travel.end, 400)  # type: ignore[attr-defined]
    got = simulated(vine, {"tail_stretch.compliance": 1 / E}, times)
    v = 2 * got.lead_velocity_m_s
    tension = 0.5 * (vine.P - vine.P_y) * vine.A - 0.5 * vine.B * v**N
    taut, y = np.maximum(tension, 0.0), travel(times) / 2
    ahead = (0.5 * vine.L * taut + 0.5 * y * (vine.P * vine.A - 2 * taut)) / (E * math.pi * vine.D * vine.t)
    np.testing.assert_allclose(got.observed_position_m, travel(times) / 2 + ahead, rtol=0, atol=1e-5 * vine.L)
    assert ahead.max() > 1e-3


def test_tail_stretch_does_not_change_the_motion() -> None:
    times = np.linspace(0, 0.15, 50)
    stretched = simulated(LOADED, {"tail_stretch.compliance": 1e-7}, times)
    np.testing.assert_array_equal(stretched.lead_position_m, simulated(LOADED, {}, times).lead_position_m)
