"""Forces on tip and tail: each against its equation written out by hand and integrated by SciPy."""

from __future__ import annotations

import math

import numpy as np
import pytest
from by_hand import ATM, BARE, LEVEL, LOADED, RT_AIR, G, Vine, assert_same_motion, simulated

from vinetrack.core.records import Bend

BOTH = pytest.mark.parametrize("vine", [BARE, LOADED], ids=["bare", "loaded"])


@BOTH
def test_base_model(vine: Vine) -> None:
    light = {"eversion_damping.B": 0.9 * vine.B}  # so that the model without it differs
    base = vine.__class__(**{**vine.__dict__, "B": 0.9 * vine.B}).base
    assert_same_motion(vine, light, lambda _t, x, v: base(x, v) / vine.m(x))


@BOTH
def test_air_drag_meets_the_head_at_the_lead_speed_and_is_halved(vine: Vine) -> None:
    def acceleration(_t: float, x: float, v: float) -> float:
        ydot = v / 2
        return (vine.base(x, v) - 0.25 * 1.2 * vine.A * 2.0 * ydot**2) / vine.m(x)

    assert_same_motion(vine, {"air_drag.C_D": 2.0}, acceleration)


@BOTH
def test_gas_inertia_is_half_of_rho_a_and_a_quarter_as_mass(vine: Vine) -> None:
    rho = (vine.P + ATM) / RT_AIR

    def acceleration(_t: float, x: float, v: float) -> float:
        y, ydot = x / 2, v / 2
        return (vine.base(x, v) - 0.5 * rho * vine.A * 0.5 * ydot**2) / (vine.m(x) + 0.25 * rho * vine.A * y)

    assert_same_motion(vine, {"gas_inertia.factor": 1.0}, acceleration)


@BOTH
def test_fold_inertia_is_a_quarter_of_lambda(vine: Vine) -> None:
    def acceleration(_t: float, x: float, v: float) -> float:
        return (vine.base(x, v) + 0.5 * 0.25 * vine.lam * v**2) / vine.m(x)

    assert_same_motion(vine, {"fold_inertia.eta": 0.5}, acceleration)


@BOTH
def test_linear_damping(vine: Vine) -> None:
    assert_same_motion(vine, {"linear_damping.b": 0.1}, lambda _t, x, v: (vine.base(x, v) - 0.5 * 0.1 * v) / vine.m(x))


@BOTH
def test_tail_friction_in_the_body_falls_in_the_second_half(vine: Vine) -> None:
    def acceleration(_t: float, x: float, v: float) -> float:
        y = x / 2
        return (vine.base(x, v) - 1.5 * min(y, vine.L - y)) / vine.m(x)

    assert_same_motion(vine, {"tail_friction.mu_w": 1.5}, acceleration)


def test_tail_friction_off_a_reel_grows_all_along() -> None:
    vine = LOADED
    assert_same_motion(
        vine,
        {"tail_friction.mu_w": 1.5},
        lambda _t, x, v: (vine.base(x, v) - 1.5 * x / 2) / vine.m(x),
        tail_store="reel",
    )


def test_capstan_friction_grows_along_a_path_without_bends() -> None:
    vine = LOADED
    assert_same_motion(
        vine,
        {"capstan_friction.C": 0.1, "capstan_friction.k": 6.0},
        lambda _t, x, v: (vine.base(x, v) - 0.1 * (math.exp(6.0 * x / 2) - 1)) / vine.m(x),
    )


def test_capstan_friction_counts_the_bends_that_the_tip_has_passed() -> None:
    vine = LOADED
    bends = (Bend(0.05, 0.06, 0.05), Bend(0.18, 0.04, 0.08))

    def acceleration(_t: float, x: float, v: float) -> float:
        y = x / 2
        angle = min(max(y - 0.05, 0.0), 0.06) / 0.05 + min(max(y - 0.18, 0.0), 0.04) / 0.08
        return (vine.base(x, v) - 0.1 * (math.exp(0.7 * angle) - 1)) / vine.m(x)

    assert_same_motion(vine, {"capstan_friction.C": 0.1, "capstan_friction.mu_c": 0.7}, acceleration, bends=bends)


def test_capstan_friction_as_printed_is_a_constant() -> None:
    vine = LOADED

    def acceleration(_t: float, x: float, v: float) -> float:
        # As printed: c = λ and the whole of the bend from the start.
        m = vine.lam * vine.L - vine.lam * x + vine.payload
        force = 0.5 * (vine.P - vine.P_y) * vine.A + m * G - 0.5 * vine.B * v**0.37
        return (force - 0.1 * math.exp(0.7 * 0.06 / 0.05)) / m

    assert_same_motion(
        vine,
        {"capstan_friction.C": 0.1, "capstan_friction.mu_c": 0.7},
        acceleration,
        share=0.45,
        bends=(Bend(0.05, 0.06, 0.05),),
        mass_loss="as_printed",
    )


@pytest.mark.parametrize("vine", [LOADED, LEVEL], ids=["down", "horizontal"])
def test_payload_friction_is_constant(vine: Vine) -> None:
    assert_same_motion(
        vine,
        {"payload_friction.mu_p": 0.4},
        lambda _t, x, v: (vine.base(x, v) - 0.4 * vine.payload * G) / vine.m(x),
    )


def test_payload_drag_is_in_the_speed_through_the_gas() -> None:
    vine = LOADED
    rho = (vine.P + ATM) / RT_AIR
    assert_same_motion(
        vine,
        {"payload_drag.drag_area": 5e-3},
        lambda _t, x, v: (vine.base(x, v) - 0.5 * rho * 5e-3 * (v / 2) ** 2) / vine.m(x),
    )


@pytest.mark.parametrize("effect", ["payload_friction.mu_p", "payload_drag.drag_area"])
def test_without_a_payload_nothing_rubs_or_drags_on_it(effect: str) -> None:
    times = np.linspace(0, 0.05, 40)
    with_it = simulated(BARE, {effect: 0.9}, times).lead_position_m
    np.testing.assert_allclose(with_it, simulated(BARE, {}, times).lead_position_m, rtol=0, atol=1e-8)


@BOTH
def test_latch_release_lets_go_along_the_way(vine: Vine) -> None:
    grip = 0.6 * 0.5 * (vine.P - vine.P_y) * vine.A
    assert_same_motion(
        vine,
        {"latch_release.F": grip, "latch_release.reach": 8e-3},
        lambda _t, x, v: (vine.base(x, v) - grip * math.exp(-x / 2 / 8e-3)) / vine.m(x),
    )


def test_a_latch_stronger_than_the_drive_holds_for_good() -> None:
    grip = 1.01 * (0.5 * (LEVEL.P - LEVEL.P_y) * LEVEL.A)
    got = simulated(LEVEL, {"latch_release.F": grip}, np.linspace(0, 1, 20))
    assert got.status == "stalled"
    assert np.all(got.lead_position_m == 0)


def gas_work_not_found_again(eta: float) -> tuple[float, float]:
    """Work of the gas less kinetic energy, damping and yield; and what a fold that keeps nothing would have lost."""
    vine = Vine(D=24e-3, t=100e-6, L=0.4, P=50e3, P_y=5e3, B=3.0, down=0.0)
    times = np.linspace(0, 0.05, 40_001)
    got = simulated(vine, {"fold_inertia.eta": eta}, times)
    inside = got.lead_position_m < 0.9 * vine.L
    y, v = got.lead_position_m[inside], 2 * got.lead_velocity_m_s[inside]
    t = times[inside]
    work = vine.P * vine.A * y[-1]
    damped = np.trapezoid(vine.B * v**0.37 * v / 2, t) + vine.P_y * vine.A * y[-1]
    kinetic = 0.5 * vine.m(2 * y[-1]) * v[-1] ** 2
    # Film arrives at ẋ, ½λ a metre of tail travel, and stops: ½(½λẋ)ẋ² a second.
    stopped = np.trapezoid(0.25 * vine.lam * v**3, t)
    return (work - kinetic - damped) / work, stopped / work


def test_a_lossless_fold_loses_nothing() -> None:
    missing, stopped = gas_work_not_found_again(1.0)
    assert stopped > 0.05
    assert abs(missing) < 1e-5


def test_a_fold_that_keeps_nothing_loses_the_energy_of_the_film_it_stops() -> None:
    missing, stopped = gas_work_not_found_again(0.0)
    assert stopped > 0.05
    assert missing == pytest.approx(stopped, rel=1e-4)


LOSSES = {
    "air_drag.C_D": 2.0,
    "gas_inertia.factor": 1.0,
    "linear_damping.b": 0.1,
    "tail_friction.mu_w": 1.0,
    "capstan_friction.C": 0.05,
    "payload_friction.mu_p": 0.3,
    "payload_drag.drag_area": 1e-3,
    "latch_release.F": 0.3,
    "inlet_loss.K": 1.5,
}


@pytest.mark.parametrize("name", LOSSES)
def test_friction_and_drag_only_take(name: str) -> None:
    times = np.linspace(0, 0.12, 60)
    base = simulated(LOADED, {}, times).lead_position_m
    assert np.all(simulated(LOADED, {name: LOSSES[name]}, times).lead_position_m[1:] < base[1:])
