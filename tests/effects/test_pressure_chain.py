"""What happens to the gas between gauge and tip: each effect by hand, and their order."""

from __future__ import annotations

import math

import numpy as np
import pytest
from by_hand import ATM, BARE, LOADED, RT_AIR, N, Vine, assert_same_motion, simulated, whole_catalogue

from vinetrack.dynamics.audit import evaluate
from vinetrack.dynamics.model import base_model, make_model
from vinetrack.dynamics.simulate import simulate
from vinetrack.effects import EffectError, catalogue

V0 = 3.7e-3
A_IN = math.pi * 6e-3**2 / 4
BOTH = pytest.mark.parametrize("vine", [BARE, LOADED], ids=["bare", "loaded"])


def depleted(P: float, A: float, y: float, gamma: float) -> float:
    return (P + ATM) * (V0 / (V0 + A * y)) ** gamma - ATM


@BOTH
@pytest.mark.parametrize("gamma", [1.0, 1.4])
def test_reservoir_depletion(vine: Vine, gamma: float) -> None:
    assert_same_motion(
        vine,
        {"reservoir_depletion.gamma": gamma},
        lambda _t, x, v: vine.base(x, v, P=depleted(vine.P, vine.A, x / 2, gamma)) / vine.m(x),
    )


@BOTH
def test_leak(vine: Vine) -> None:
    assert_same_motion(
        vine, {"leak.rate": 3.0}, lambda t, x, v: vine.base(x, v, P=vine.P * math.exp(-3.0 * t)) / vine.m(x)
    )


@BOTH
def test_inlet_loss(vine: Vine) -> None:
    rho = (vine.P + ATM) / RT_AIR

    def acceleration(_t: float, x: float, v: float) -> float:
        loss = 1.5 * 0.5 * rho * (v / 2) ** 2 * (vine.A / A_IN) ** 2
        return vine.base(x, v, P=vine.P - loss) / vine.m(x)

    assert_same_motion(vine, {"inlet_loss.K": 1.5}, acceleration)


def filling(vine: Vine, tau: float, gamma: float) -> tuple[float, object]:
    def rate(_t: float, x: float, v: float, P: float) -> float:
        return -gamma * (P + ATM) * vine.A * (v / 2) / (V0 + vine.A * x / 2) + (vine.P - P) / tau

    return vine.P, rate


@BOTH
@pytest.mark.parametrize("tau", [0.01, 0.1, 10.0])
def test_supply_refill(vine: Vine, tau: float) -> None:
    assert_same_motion(
        vine,
        {"supply_refill.tau": tau, "supply_refill.gamma": 1.4},
        lambda _t, x, v, P: vine.base(x, v, P=P) / vine.m(x),
        chamber=filling(vine, tau, 1.4),  # type: ignore[arg-type]
    )


def test_a_supply_that_never_comes_is_adiabatic_depletion() -> None:
    times = np.linspace(0, 0.15, 50)
    shut = simulated(LOADED, {"supply_refill.tau": 1e9, "supply_refill.gamma": 1.4}, times)
    closed = simulated(LOADED, {"reservoir_depletion.gamma": 1.4}, times)
    np.testing.assert_allclose(shut.lead_position_m, closed.lead_position_m, rtol=0, atol=2e-6 * 0.28)


def test_a_supply_that_comes_at_once_is_nothing() -> None:
    times = np.linspace(0, 0.15, 50)
    quick = simulated(LOADED, {"supply_refill.tau": 1e-7, "supply_refill.gamma": 1.4}, times)
    nothing = simulated(LOADED, {}, times)
    np.testing.assert_allclose(quick.lead_position_m, nothing.lead_position_m, rtol=0, atol=1e-5 * 0.28)


def test_refill_contains_depletion_which_rests_beside_it() -> None:
    times = np.linspace(0, 0.15, 50)
    refill = {"supply_refill.tau": 0.1, "supply_refill.gamma": 1.4}
    alone = simulated(LOADED, refill, times).lead_position_m
    both = simulated(LOADED, {**refill, "reservoir_depletion.gamma": 1.4}, times).lead_position_m
    np.testing.assert_array_equal(alone, both)


def test_gauge_then_chamber_then_leak_then_inlet_then_stretch() -> None:
    vine = LOADED
    sizes = {
        "pressure_gain.eps": 0.02,
        "pressure_gauge.delta": 700.0,
        "leak.rate": 2.0,
        "inlet_loss.K": 1.5,
        "wall_stretch.kappa": 4e-6,
        "supply_refill.tau": 0.05,
        "supply_refill.gamma": 1.4,
    }
    P_0 = 1.02 * vine.P + 700.0
    P_y = 1.02 * vine.P_y

    def at_the_tip(t: float, v: float, P: float) -> tuple[float, float]:
        leaked = P * math.exp(-2.0 * t)
        area = vine.A
        for _ in range(60):
            rho = (leaked + ATM) / RT_AIR
            tip = leaked - 1.5 * 0.5 * rho * (v / 2) ** 2 * (area / A_IN) ** 2
            area = vine.A * (1 + 4e-6 * tip) ** 2
        return tip, area

    def acceleration(t: float, x: float, v: float, P: float) -> float:
        tip, area = at_the_tip(t, v, P)
        return (0.5 * (tip - P_y) * area - 0.5 * vine.B * v**N + vine.m(x) * 9.81) / vine.m(x)

    def rate(t: float, x: float, v: float, P: float) -> float:
        area = at_the_tip(t, v, P)[1]
        return -1.4 * (P + ATM) * area * (v / 2) / (V0 + area * x / 2) + (P_0 - P) / 0.05

    assert_same_motion(vine, sizes, acceleration, chamber=(P_0, rate))


def test_the_order_in_which_a_model_is_put_together_does_not_matter() -> None:
    names = ["inlet_loss", "leak", "wall_stretch", "reservoir_depletion", "pressure_gauge", "pressure_gain"]
    base = ["pressure_drive", "gravity", "eversion_damping", "yield_pressure"]
    motion = (np.linspace(0, 0.1, 30), np.linspace(0, 0.25, 30), np.linspace(0, 3, 30))
    forwards = evaluate(make_model([*base, *names]), LOADED.trial(), *motion)
    backwards = evaluate(make_model([*names[::-1], *base]), LOADED.trial(), *motion)
    np.testing.assert_array_equal(forwards.pressure_Pa, backwards.pressure_Pa)
    np.testing.assert_array_equal(forwards.area_m2, backwards.area_m2)


@pytest.mark.parametrize("name", ["reservoir_depletion.gamma", "leak.rate", "supply_refill.tau"])
def test_a_measured_pressure_already_holds_what_happens_in_the_chamber(name: str) -> None:
    times = np.linspace(0, 0.15, 50)
    trace = (np.array([0.0, 0.1, 0.2]), np.array([28e3, 24e3, 25e3]))
    plain = simulated(LOADED, {}, times, trace).lead_position_m
    np.testing.assert_array_equal(simulated(LOADED, {name: 1.2}, times, trace).lead_position_m, plain)
    assert np.max(np.abs(simulated(LOADED, {name: 1.2}, times).lead_position_m - plain)) > 1e-4


def test_a_measured_pressure_is_corrected_by_the_gauge_and_lost_in_the_inlet() -> None:
    vine = LOADED
    trace = (np.array([0.0, 0.1, 0.2]), np.array([28e3, 24e3, 25e3]))

    def acceleration(t: float, x: float, v: float) -> float:
        read = float(np.interp(t, *trace)) + 500.0
        loss = 0.5 * (read + ATM) / RT_AIR * (v / 2) ** 2 * (vine.A / A_IN) ** 2
        return vine.base(x, v, P=read - loss) / vine.m(x)

    assert_same_motion(vine, {"pressure_gauge.delta": 500.0, "inlet_loss.K": 1.0}, acceleration, trace=trace)


@pytest.mark.parametrize(("name", "column"), [("reservoir_depletion", "chamber_l"), ("inlet_loss", "inlet_mm")])
def test_a_trial_without_what_an_effect_needs_is_refused_by_name(name: str, column: str) -> None:
    trial = LOADED.trial(chamber_m3=math.nan, inlet_m=math.nan)
    with pytest.raises(EffectError, match=f"Trial t: the effect {name} needs `{column}`"):
        simulate(base_model() + catalogue()[name], trial, np.linspace(0, 0.1, 5))


def test_the_papers_reservoir_falls_as_worked_out_by_hand() -> None:
    # 3.7 L, 24 mm × 280 mm: adiabatic 21, 38, 71 % of gauge at 28, 14, 7 kPa; isothermal 15, 27, 51 %.
    for gamma, shares in ((1.4, (0.21, 0.38, 0.71)), (1.0, (0.15, 0.27, 0.51))):
        model = whole_catalogue({"reservoir_depletion.gamma": gamma})
        for P, share in zip((28e3, 14e3, 7e3), shares, strict=True):
            terms = evaluate(model, LOADED.trial(pressure_Pa=P), np.ones(1), np.array([0.28]), np.zeros(1))
            assert 1 - terms.pressure_Pa[0] / P == pytest.approx(share, abs=0.006)
