"""What no data of a kind can tell apart: the ties of the physics, reproduced by simulation.

Each test finds, by closed form, the one set of values that imitates another, and asks that both move alike.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest
from by_hand import BARE, LEVEL, LOADED, Vine, simulated, whole_catalogue
from scipy.optimize import least_squares

from vinetrack.dynamics.audit import evaluate

TIMES = np.linspace(0, 0.12, 60)
SAME = 2e-6
"""Of the length: twice what the integration is good to."""


def gap(vine: Vine, a: Mapping[str, float], b: Mapping[str, float], other: Vine | None = None) -> float:
    """Largest difference of what the camera reports, in lengths of the vine."""
    first = simulated(vine, a, TIMES).observed_position_m
    second = simulated(other or vine, b, TIMES).observed_position_m
    return float(np.max(np.abs(first - second))) / vine.L


@pytest.mark.parametrize("vine", [BARE, LOADED], ids=["bare", "loaded"])
def test_an_offset_of_the_gauge_is_an_error_of_the_yield_pressure(vine: Vine) -> None:
    shifted = Vine(**{**vine.__dict__, "P_y": vine.P_y - 800.0})
    assert gap(vine, {"pressure_gauge.delta": 800.0}, {}, shifted) < SAME
    assert gap(vine, {"pressure_gauge.delta": 800.0}, {}) > 1e-3


@pytest.mark.parametrize("scale", [1, 2, 3, 4])
@pytest.mark.parametrize("pressure", [20e3, 60e3])
@pytest.mark.parametrize("payload", [0.0, 35.6e-3])
def test_fold_inertia_cancels_drag_on_every_vine_of_one_t_over_d(scale: int, pressure: float, payload: float) -> None:
    # η¼λ·4 = ¼ρ_air A C_D with λ = 1200 π D t and A = πD²/4: C_D = 16 η (1200/1.2)(t/D) = 16000/120 η.
    vine = Vine(D=6e-3 * scale, t=50e-6 * scale, L=0.3, P=pressure, P_y=3e3, B=0.6 * scale, payload=payload)
    both = {"fold_inertia.eta": 0.8, "air_drag.C_D": 0.8 * 16000 / 120}
    assert gap(vine, both, {}) < SAME
    assert gap(vine, {"fold_inertia.eta": 0.8}, {}) > 5 * SAME


def test_another_t_over_d_breaks_the_tie_of_drag_and_fold() -> None:
    vine = Vine(D=24e-3, t=50e-6, L=0.3, P=40e3, P_y=3e3, B=2.0)
    assert gap(vine, {"fold_inertia.eta": 0.8, "air_drag.C_D": 0.8 * 16000 / 120}, {}) > 1e-3


def test_drag_is_inlet_loss_at_one_pressure() -> None:
    # ¼ρ_air A C_D ẏ² = ½A K ½ρ_gas ẏ² (A/A_in)²: C_D = K (ρ_gas/ρ_air)(A/A_in)².
    vine = BARE
    ratio = (vine.P + 101_325) / (287 * 293) / 1.2 * (vine.D / 6e-3) ** 4
    # ρ_gas follows what the loss leaves of the pressure in the chamber only, so the tie is exact.
    assert gap(vine, {"inlet_loss.K": 2.0}, {"air_drag.C_D": 2.0 * ratio}) < SAME
    other = Vine(**{**vine.__dict__, "P": 15e3, "P_y": 1e3})
    whole = gap(other, {"inlet_loss.K": 2.0}, {})
    assert gap(other, {"inlet_loss.K": 2.0}, {"air_drag.C_D": 2.0 * ratio}) > 0.1 * whole > SAME


def test_an_exponent_of_one_is_linear_damping() -> None:
    split = {"eversion_damping.B": 0.7, "eversion_damping.n": 1.0, "linear_damping.b": 0.3}
    assert gap(LOADED, split, {"eversion_damping.B": 1.0, "eversion_damping.n": 1.0}) < SAME


def test_an_exponent_of_nothing_is_a_yield_pressure() -> None:
    more = Vine(**{**LOADED.__dict__, "P_y": LOADED.P_y + 2000.0})
    B = 2000.0 * LOADED.A
    one = {"eversion_damping.B": B, "eversion_damping.n": 0.0}
    assert gap(LOADED, one, {"eversion_damping.B": 0.0}, more) < SAME


def test_a_clock_is_a_gain_of_pressure_and_damping_on_the_level() -> None:
    # t → (1 + ε)t: forces of (1 + ε)² in true time, B of (1 + ε)^(2 − n)... read the other way round.
    s = 1.03
    slow = {"time_base.eps": s - 1}
    other = {"pressure_gain.eps": 1 / s**2 - 1, "eversion_damping.B": LEVEL.B * s ** (0.37 - 2)}
    assert gap(LEVEL, slow, other) < SAME
    assert gap(LOADED, slow, other) > 1e-4  # gravity does not follow the clock


def test_heavy_film_is_a_slow_clock_on_the_level_without_payload() -> None:
    # (1 + ε) m ẍ = F − B ẋⁿ is the motion of m in the time t/s, s² = 1 + ε, with B s⁻ⁿ.
    s = 1.03
    bare = Vine(**{**LEVEL.__dict__, "payload": 0.0})
    heavy = {"film_mass.eps": s**2 - 1}
    slow = {"time_base.eps": s - 1, "eversion_damping.B": bare.B * s**-0.37}
    assert gap(bare, heavy, slow) < SAME
    assert gap(LEVEL, heavy, slow) > 1e-4  # a payload is weighed for itself


def test_a_payload_that_was_not_weighed_is_a_reel_on_the_level() -> None:
    assert gap(LEVEL, {"payload_mass.delta": 6e-3}, {"reel_inertia.M": 6e-3}) < SAME
    assert gap(LOADED, {"payload_mass.delta": 6e-3}, {"reel_inertia.M": 6e-3}) > 1e-4  # a payload has weight


def test_area_is_a_gain_of_pressure_with_heavy_payload_and_exactly_with_weighed_film() -> None:
    # Film as weighed: what area_scale adds to λ is taken out of the thickness.
    weighed = Vine(**{**LOADED.__dict__, "t": LOADED.t / 1.03})
    assert gap(weighed, {"area_scale.eps": 0.03}, {"pressure_gain.eps": 1.03**2 - 1}, LOADED) < SAME


def test_wall_stretch_is_area_scale_at_one_pressure_and_weighed_film() -> None:
    widening = 3e-6 * LOADED.P
    weighed = Vine(**{**LOADED.__dict__, "t": LOADED.t / (1 + widening)})
    assert gap(LOADED, {"wall_stretch.kappa": 3e-6}, {"area_scale.eps": widening}, weighed) < SAME
    low = Vine(**{**LOADED.__dict__, "P": 12e3})
    weighed_low = Vine(**{**weighed.__dict__, "P": 12e3})
    assert gap(low, {"wall_stretch.kappa": 3e-6}, {"area_scale.eps": widening}, weighed_low) > 1e-3


def test_payload_friction_is_an_error_of_the_angle() -> None:
    # On the level μ_p m_pay g; an angle takes film and gas along, so the tie is that of a payload that outweighs them.
    bob = Vine(**{**LEVEL.__dict__, "P": 60e3, "t": 1e-9, "payload": 2.0})
    tilted = Vine(**{**bob.__dict__, "down": -0.2})
    assert gap(bob, {"payload_friction.mu_p": 0.2}, {}, tilted) < SAME
    assert gap(bob, {"payload_friction.mu_p": 0.2}, {}) > 1e-2


def test_payload_friction_is_a_slip_of_the_growth_angle_but_for_the_film() -> None:
    bob = Vine(**{**LOADED.__dict__, "P": 60e3, "t": 1e-9, "payload": 2.0})
    assert gap(bob, {"payload_friction.mu_p": 0.2}, {"growth_angle.f": 0.2}) < SAME
    assert gap(LOADED, {"payload_friction.mu_p": 1.0}, {"growth_angle.f": 1.0}) > 1e-3


def test_a_scale_is_length_payload_gain_and_damping_on_the_level() -> None:
    # y' = s·y with L' = sL and m' = s·m: forces of s², so P' = s²P and B' = s^(2 − n) B.
    s = 1.03
    other = Vine(**{**LEVEL.__dict__, "L": s * LEVEL.L, "payload": s * LEVEL.payload})
    imitation = {"pressure_gain.eps": s**2 - 1, "eversion_damping.B": LEVEL.B * s ** (2 - 0.37)}
    assert gap(LEVEL, {"length_scale.eps": s - 1}, imitation, other) < SAME
    assert gap(LEVEL, {"length_scale.eps": s - 1}, {}) > 1e-2


def test_depletion_on_one_vine_at_one_pressure_is_nearly_tail_friction_on_a_reel() -> None:
    vine = Vine(D=24e-3, t=200e-6, L=0.28, P=28e3, P_y=3e3, B=6.44)
    times = np.linspace(0, 0.12, 60)
    truth = simulated(vine, {"reservoir_depletion.gamma": 1.4}, times).observed_position_m

    def left(free: np.ndarray) -> np.ndarray:
        sizes = {"tail_friction.mu_w": free[0], "eversion_damping.B": free[1], "eversion_damping.n": free[2]}
        return simulated(vine, sizes, times, tail_store="reel").observed_position_m - truth

    found = least_squares(left, [1.0, 6.44, 0.37], x_scale=[1.0, 1.0, 0.1], diff_step=1e-4)
    whole = np.max(np.abs(left(np.array([0.0, 6.44, 0.37]))))
    assert whole > 15e-3
    assert np.max(np.abs(found.fun)) < 0.5e-3


def test_leak_and_isothermal_depletion_are_one_line_at_constant_speed() -> None:
    times = np.linspace(0.0, 0.1, 60)
    motion = (times, 1.5 * times, np.full(60, 1.5))
    trial = LOADED.trial()

    def fall(sizes: Mapping[str, float]) -> np.ndarray:
        return evaluate(whole_catalogue(sizes), trial, *motion).pressure_Pa - LOADED.P

    leak, depletion = fall({"leak.rate": 1.0}), fall({"reservoir_depletion.gamma": 1.0})
    cosine = leak @ depletion / np.linalg.norm(leak) / np.linalg.norm(depletion)
    assert cosine > 0.9995
