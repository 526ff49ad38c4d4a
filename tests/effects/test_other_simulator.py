"""Another simulator, written from the equations alone, says the same of every effect, and what it does not cover is
written out by hand."""

import math
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import by_hand
import numpy as np
import pytest
from by_hand import BARE, LEVEL, LOADED, G, N, Vine, assert_same_motion, followed, simulated, whole_catalogue
from hidden import EFFECTS
from hidden.verify import FRAME_S, SIZES, ours, trials
from numba import njit
from own_effect import NAME, write_effect
from scipy.integrate import cumulative_trapezoid, solve_ivp

import vinetrack as vt
from vinetrack.core.records import Bend, Trial
from vinetrack.dynamics import audit, equations
from vinetrack.dynamics.model import effects_on, host_for
from vinetrack.dynamics.simulate import kernel, simulate_many
from vinetrack.effects import Effect, TrialInputs, catalogue

B = 6.44
DAMPING = {"eversion_damping.B": B, "eversion_damping.n": N}
WRITTEN_OUT = ("gauge_lag", "growth_angle", "lens", "moving_average", "rolling_shutter", "supply_rise", "trace_clock")
"""Effects that are held against a vine written out by hand instead, below."""

TIMES = FRAME_S * np.arange(-3, 1200)
PACKAGE = Path(vt.__file__).parent
BENDS = (Bend(0.05, 0.06, 0.05), Bend(0.18, 0.04, 0.08))
MIXTURE_TIMES = np.linspace(0.0, 0.3, 200)
DRAWN_LAST = ("film_mass", "payload_mass", "gauge_lag")
"""Effects that came after the seeds, in the order in which they came: the others keep their sizes."""
FAST = Vine(D=30e-3, t=100e-6, L=0.36, P=61e3, P_y=4.5e3, B=3.6)
FINE = np.linspace(0, 0.15, 50)
P_S = 8e3
UP_AND_DOWN = (np.array([0.0, 0.2, 0.4, 0.6, 0.8, 1.0]), np.array([2e3, 12e3, 1e3, 1e3, 11e3, 11e3]))
FALL = f"""
import numpy as np
import vinetrack as vt
from vinetrack.core.records import Trial
trial = Trial(name="ball", travel_ratio=1.0, payload_kg=1.0)
model = vt.base_model() - "pressure_drive" - "eversion_damping" - "yield_pressure"
model += vt.effects.own_effects(["{NAME}.py"])["{NAME}"]
print(vt.simulate(model, trial, np.linspace(0, 0.2, 5)).lead_position_m.tolist())
"""


def test_every_candidate_that_a_release_can_show_is_hidden_in_some_campaign():
    candidates = {name for name, effect in catalogue().items() if effect.kind != "base"}
    assert candidates - set(EFFECTS) == {"static_yield", *WRITTEN_OUT}
    assert set(SIZES) == {"", *EFFECTS}


@pytest.mark.parametrize("effect", SIZES, ids=lambda effect: effect or "base")
def test_two_simulators_agree(effect):
    size = {f"{effect}.{name}": value for name, value in SIZES[effect][1].items()}
    model = (vt.base_model() + effect if effect else vt.base_model()).with_values(DAMPING | size)
    host = host_for(model)  # the compiled model of the diagnoses, all its other effects at rest
    for rig in ("payload, down", "horizontal, slow", "bent", "reel"):
        trial = trials()[rig]
        theirs = simulate_many(model, [trial], [TIMES], host=host, relative_tolerance=1e-7)[0].observed_position_m
        other = ours(effect, trial, TIMES, B, N)
        seen = np.isfinite(other)
        assert np.nanmax(other) > 0.2 * trial.length_m
        np.testing.assert_allclose(other[seen], theirs[seen], atol=1e-8)


@lru_cache
def callable_parts(effects: tuple[Effect, ...]) -> tuple:
    """Pressure of the chamber at release and acceleration of the tail; a model's own functions Python cannot call."""
    rates, first_chamber = kernel(effects).rates, kernel(effects).first_chamber
    acceleration = njit(lambda t, x, v, p, arrays: rates(t, x, v, p, arrays)[0])
    return njit(lambda arrays: first_chamber(arrays)), acceleration


def accelerations(model: vt.Model, trial: Trial, time, y, v, chamber=None) -> list[float]:
    chamber_at_release, acceleration = callable_parts(model.effects)
    theta = model.parameters_for(trial.vine)
    on, rig = effects_on(model, theta[None])[0], np.array(TrialInputs.of(trial))
    bends = np.array([(b.start_m, b.arc_m, b.radius_m) for b in trial.bends]).reshape(-1, 3)
    arrays = equations.TrialArrays(on, rig, theta, np.empty(0), np.empty(0), bends)
    pressures = np.full(time.size, chamber_at_release(arrays)) if chamber is None else chamber
    return [acceleration(t, 2 * a, 2 * b, p, arrays) for t, a, b, p in zip(time, y, v, pressures, strict=True)]


@pytest.mark.slow
@pytest.mark.parametrize("vine", [BARE, LOADED], ids=["bare", "loaded"])
@pytest.mark.parametrize("name", [*catalogue(), "all"])
def test_each_effect_and_all_together(name, vine):
    every = [other for other, effect in catalogue().items() if effect.kind != "base" and other != "supply_refill"]
    names = every if name == "all" else [name]
    # A payload that weighs far less than stated: nothing is taken from the film.
    less = {"payload_mass.delta": -20e-3} if name == "payload_mass" else {}
    sizes = {f"{one}.{p.name}": p.default for one in names for p in catalogue()[one].parameters}
    model, trial = whole_catalogue(sizes | less), vine.trial(bends=BENDS)
    time, y, v = (np.linspace(*ends, 25) for ends in ((0.01, 0.1), (0.01, 0.95 * vine.L), (0.2, 12.0)))
    terms = audit.evaluate(model, trial, time, y, v)
    chamber = terms.pressure_Pa if name == "supply_refill" else None
    np.testing.assert_allclose(accelerations(model, trial, time, y, v, chamber), terms.acceleration_m_s2, rtol=1e-9)


@pytest.mark.slow
def test_copies_of_the_package_and_of_an_own_effect_share_what_is_compiled(tmp_path):
    copy, cache = tmp_path / "elsewhere", tmp_path / "cache"
    shutil.copytree(PACKAGE, copy / "vinetrack", ignore=shutil.ignore_patterns("__pycache__"))
    said, compiled = [], []
    for place in (PACKAGE.parent, copy):
        folder = tmp_path / f"with_{place.name}"
        folder.mkdir()
        write_effect(folder)
        environment = {**os.environ, "PYTHONPATH": str(place), "VINETRACK_CACHE": str(cache), "NUMBA_CACHE_DIR": ""}
        said.append(subprocess.check_output([sys.executable, "-c", FALL], env=environment, cwd=folder))
        compiled.append(sorted((path.name, path.stat().st_mtime_ns) for path in cache.rglob("kernel_*")))
    assert said[0] == said[1]
    assert compiled[0] == compiled[1]
    assert any(name.endswith(".nbc") for name, _ in compiled[0])


@pytest.mark.parametrize("tau", [1e-4, 0.02, 1.0])
def test_the_chambers_pressure_along_a_motion_is_that_of_the_simulation(tau):
    model = whole_catalogue({"supply_refill.tau": tau, "supply_refill.gamma": 1.4, "eversion_damping.B": LOADED.B})
    times = np.linspace(0, 0.15, 1501)
    got = vt.simulate(model, LOADED.trial(), times)
    terms = audit.evaluate(model, LOADED.trial(), times, got.lead_position_m, got.lead_velocity_m_s)
    # Ṗ by hand, at points of the motion: what the table of pressures says changes as its equation asks.
    P, y, ydot, A = terms.pressure_Pa, got.lead_position_m, got.lead_velocity_m_s, LOADED.A
    rate = -1.4 * (P + 101_325) * A * ydot / (3.7e-3 + A * y) + (LOADED.P - P) / tau
    slope = np.gradient(P, times)
    assert np.max(np.abs((slope - rate)[5:-5])) < 2e-3 * np.max(np.abs(1.4 * 129e3 * A * ydot / 3.7e-3))


@pytest.mark.slow
def test_the_gas_in_the_floor_of_the_mass_is_not_counted_twice():
    # At the end a bare vine's moving mass is its fold, λπt, and a quarter of the gas ρ_gas A L; nothing on top of it.
    vine, model = BARE, whole_catalogue({"gas_inertia.factor": 1.0})
    at_end = model, vine.trial(), np.zeros(1), np.array([vine.L]), np.zeros(1)
    terms, compiled = audit.evaluate(*at_end), accelerations(*at_end)
    gas, fold = (vine.P + 101_325) / (287 * 293) * vine.A * vine.L / 4, vine.lam * math.pi * vine.t
    assert terms.inertia_kg[0] == pytest.approx(fold + gas, rel=1e-9)
    np.testing.assert_allclose(compiled, terms.acceleration_m_s2, rtol=1e-9)


def mixture(seed: int) -> tuple[Vine, dict[str, float]]:
    rng = np.random.default_rng(seed)
    D, L, P, B = (rng.uniform(*ends) for ends in ((5e-3, 30e-3), (0.15, 0.6), (8e3, 60e3), (0.5, 6.0)))
    payload, down = float(rng.choice([0.0, 35.6e-3])), float(rng.choice([1.0, 0.0, -1.0]))
    vine = Vine(D=D, t=1e-4, L=L, P=P, P_y=3e3, B=B, payload=payload, down=down)
    sizes = {"eversion_damping.B": vine.B, "eversion_damping.n": N}
    came = {name: place for place, name in enumerate(DRAWN_LAST, 1)}
    for effect in sorted(catalogue().values(), key=lambda effect: came.get(effect.name, 0)):
        if effect.kind != "base" and rng.random() < 0.4:
            sizes |= {f"{effect.name}.{p.name}": rng.uniform(*p.plausible) for p in effect.parameters}
    return vine, sizes


def test_the_usual_tolerance_gives_what_a_thousandth_of_it_gives():
    for seed in range(60):
        vine, sizes = mixture(seed)
        model = whole_catalogue(sizes)
        usual = vt.simulate(model, vine.trial(), MIXTURE_TIMES).lead_position_m
        exact = vt.simulate(model, vine.trial(), MIXTURE_TIMES, relative_tolerance=1e-7).lead_position_m
        # Of the distance; where it hardly moves, and sets off by a hair (a latch as strong as the drive), of L/10.
        assert np.max(np.abs(usual - exact)) <= 1e-5 * max(exact[-1], 0.1 * vine.L), seed


def test_a_vine_that_stops_and_creeps_on_is_nowhere_else_meanwhile():
    # Seed 1025: friction brings it to rest between two frames while the drive exceeds what holds it by a hair.
    vine, sizes = mixture(1025)
    found = vt.simulate(whole_catalogue(sizes), vine.trial(), MIXTURE_TIMES).lead_position_m
    assert np.all(np.diff(found) >= -1e-9)
    assert found.max() < vine.L


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
            rho = (leaked + by_hand.ATM) / by_hand.RT_AIR
            tip = leaked - 1.5 * 0.5 * rho * (v / 2) ** 2 * (area / A_in) ** 2
            area = vine.A * (1 + 4e-6 * tip) ** 2
        return tip, area

    def acceleration(t: float, x: float, v: float, P: float) -> float:
        tip, area = at_the_tip(t, v, P)
        return (0.5 * (tip - P_y) * area - 0.5 * vine.B * v**N + vine.m(x) * 9.81) / vine.m(x)

    def rate(t: float, x: float, v: float, P: float) -> float:
        area = at_the_tip(t, v, P)[1]
        return -1.4 * (P + by_hand.ATM) * area * (v / 2) / (V0 + area * x / 2) + (P_0 - P) / 0.05

    assert_same_motion(vine, sizes, acceleration, chamber=(P_0, rate))


@pytest.mark.parametrize("name", ["reservoir_depletion.gamma", "leak.rate", "supply_refill.tau"])
def test_a_measured_pressure_already_holds_what_happens_in_the_chamber(name):
    trace = (np.array([0.0, 0.1, 0.2]), np.array([28e3, 24e3, 25e3]))
    plain = simulated(LOADED, {}, FINE, trace).lead_position_m
    np.testing.assert_array_equal(simulated(LOADED, {name: 1.2}, FINE, trace).lead_position_m, plain)
    assert np.max(np.abs(simulated(LOADED, {name: 1.2}, FINE).lead_position_m - plain)) > 1e-4


def held_by_hand(times: np.ndarray) -> tuple[np.ndarray, list[tuple[float, float]]]:
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
    truth, moving = held_by_hand(times)
    got = simulated(LEVEL, {"static_yield.P_s": P_S}, times, UP_AND_DOWN)
    assert 0.2 < moving[0][1] < 0.4  # it stops on the way down, and starts again
    assert truth[-1] > truth[300] + 0.005
    np.testing.assert_allclose(got.lead_position_m, truth, rtol=0, atol=1e-5 * truth[-1])
    resting = ((times < 0.12) | (times > moving[0][1] + 1e-3)) & (times < 0.74)
    assert np.all(got.lead_velocity_m_s[resting] == 0)
    never = simulated(LEVEL, {"static_yield.P_s": 30e3}, FINE)
    assert never.status == "stalled"
    assert np.all(never.lead_position_m == 0)
    free = simulated(LEVEL, {}, FINE).lead_position_m
    for P_s in (3e3, 20e3):
        np.testing.assert_array_equal(simulated(LEVEL, {"static_yield.P_s": P_s}, FINE).lead_position_m, free)


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
    plain = simulated(LOADED, {}, FINE).lead_position_m
    got = simulated(LOADED, {"lens.k3": -0.7, "lens.y_c": 0.1}, FINE).observed_position_m
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
    late = simulated(LOADED, {}, FINE, (clock + delay, pressure)).lead_position_m
    got = simulated(LOADED, {"trace_clock.delta": delay}, FINE, (clock, pressure)).observed_position_m
    np.testing.assert_allclose(got, late, rtol=0, atol=1e-12)


def test_a_pressure_is_what_a_gauge_that_lags_should_have_shown():
    """A ramp a t, of which it shows a (t − τ (1 − e^(−t/τ)))."""
    lag, clock = 4e-3, np.linspace(0.0, 0.3, 3001)
    shown, true = 2e5 * (clock + lag * np.expm1(-clock / lag)), 2e5 * clock
    got = simulated(LOADED, {"gauge_lag.tau": lag}, FINE, (clock, shown)).lead_position_m
    expected = simulated(LOADED, {}, FINE, (clock, true)).lead_position_m
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-5)
