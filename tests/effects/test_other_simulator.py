"""Another simulator, written from the equations alone, says the same of every effect; its campaigns are what they say.

It lives in `benchmarks/hidden` and shares no code with the model; what it makes is diagnosed in
`tests/diagnosis/test_campaign_verdicts.py` and scored by `benchmarks/hidden_effects.py`. Below, the compiled kernel and
the terms along a known motion say the same, for every effect, all together, and mixtures.
"""

import math
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from by_hand import BARE, LOADED, N, Vine, whole_catalogue
from hidden import EFFECTS, OUTSIDERS, make
from hidden.motion import Physics, Tube, follow
from hidden.questions import outsider_values, true_effects
from hidden.verify import FRAME_S, SIZES, ours, trials
from numba import njit
from own_effect import NAME, write_effect

import vinetrack as vt
from vinetrack.core.records import Bend, Trial
from vinetrack.dynamics import audit, equations
from vinetrack.dynamics.kernel import kernel
from vinetrack.dynamics.model import effects_on, host_for
from vinetrack.dynamics.simulate import simulate_many
from vinetrack.effects import Effect, TrialInputs, catalogue

B = 6.44
DAMPING = {"eversion_damping.B": B, "eversion_damping.n": N}
WRITTEN_OUT = ("growth_angle", "lens", "moving_average", "rolling_shutter", "supply_rise", "trace_clock")
"""Effects that are held against a vine written out by hand instead (`test_by_hand`)."""

TIMES = FRAME_S * np.arange(-3, 1200)


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


OUTSIDE = {
    "rough_patch": {"patch_F": 0.8, "patch_y": 0.1, "patch_width": 0.01},
    "ripple": {"ripple_F": 0.4, "ripple_length": 0.05, "ripple_phase": 1.0},
    "cubic": {"cubic": 1e-3},
    "beyond_a_speed": {"beyond": 0.02, "beyond_speed": 2.0},
    "growing_friction": {"growing_F": 0.8, "growing_s": 0.2},
    "changed_film": {"step_B": 0.1, "step_y": 0.12},
    "slip": {"slip_F": 0.8, "slip_x": 0.5, "slip_speed": 1.5},
    "chirp": {"chirp_F": 0.4, "chirp_length": 0.12, "chirp_phase": 1.0},
    "squeeze": {"squeeze_F": 0.5, "squeeze_Pa": 2e4, "squeeze_y": 0.1, "squeeze_width": 0.03},
}


@pytest.mark.parametrize("name", OUTSIDERS)
def test_a_force_of_no_catalogue_is_the_one_that_scoring_knows(name):
    trial = trials()["bare, down"]
    physics = Physics(B=B, n=N, **OUTSIDE[name])
    rig = ("pressure_Pa", "yield_pressure_Pa", "diameter_m", "thickness_m", "length_m")
    tube = Tube(*(getattr(trial, name) for name in rig), 0.0, 1.0)
    other, _ = follow(TIMES, tube, physics, np.empty((0, 3)))
    truth = replace(make("null:few_trials", 900).truth, outsider=name, physics=physics)
    model = (vt.base_model() + true_effects((), name)[0]).with_values(DAMPING | outsider_values(truth))
    # In one compiled model for all of them.
    host = vt.Model((*vt.base_model(), *(true_effects((), outsider)[0] for outsider in OUTSIDERS)))
    theirs = simulate_many(model, [trial], [TIMES], host=host, relative_tolerance=1e-7)[0].lead_position_m
    seen = other[:, 1] < 0.95 * trial.length_m
    plain, _ = follow(TIMES, tube, Physics(B=B, n=N), np.empty((0, 3)))
    assert np.max(np.abs(other[seen, 1] - plain[seen, 1])) > 1e-3
    # A film that changes from one millimetre to the next is a corner to one integrator and a step to the other.
    np.testing.assert_allclose(other[seen, 1], theirs[seen], atol=2e-6 if name == "changed_film" else 1e-7)


PACKAGE = Path(vt.__file__).parent
BENDS = (Bend(0.05, 0.06, 0.05), Bend(0.18, 0.04, 0.08))


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


FALL = f"""
import numpy as np
import vinetrack as vt
from vinetrack.core.records import Trial
trial = Trial(name="ball", travel_ratio=1.0, payload_kg=1.0)
model = vt.base_model() - "pressure_drive" - "eversion_damping" - "yield_pressure"
model += vt.effects.own_effects(["{NAME}.py"])["{NAME}"]
print(vt.simulate(model, trial, np.linspace(0, 0.2, 5)).lead_position_m.tolist())
"""


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


def test_the_gas_in_the_floor_of_the_mass_is_not_counted_twice():
    # At the end a bare vine's moving mass is its fold, λπt, and a quarter of the gas ρ_gas A L; nothing on top of it.
    vine, model = BARE, whole_catalogue({"gas_inertia.factor": 1.0})
    at_end = model, vine.trial(), np.zeros(1), np.array([vine.L]), np.zeros(1)
    terms, compiled = audit.evaluate(*at_end), accelerations(*at_end)
    gas, fold = (vine.P + 101_325) / (287 * 293) * vine.A * vine.L / 4, vine.lam * math.pi * vine.t
    assert terms.inertia_kg[0] == pytest.approx(fold + gas, rel=1e-9)
    np.testing.assert_allclose(compiled, terms.acceleration_m_s2, rtol=1e-9)


MIXTURE_TIMES = np.linspace(0.0, 0.3, 200)
DRAWN_LAST = ("film_mass", "payload_mass")
"""Effects that came after the seeds: the others keep the sizes that these seeds always gave them."""


def mixture(seed: int) -> tuple[Vine, dict[str, float]]:
    rng = np.random.default_rng(seed)
    D, L, P, B = (rng.uniform(*ends) for ends in ((5e-3, 30e-3), (0.15, 0.6), (8e3, 60e3), (0.5, 6.0)))
    payload, down = float(rng.choice([0.0, 35.6e-3])), float(rng.choice([1.0, 0.0, -1.0]))
    vine = Vine(D=D, t=1e-4, L=L, P=P, P_y=3e3, B=B, payload=payload, down=down)
    sizes = {"eversion_damping.B": vine.B, "eversion_damping.n": N}
    for effect in sorted(catalogue().values(), key=lambda effect: effect.name in DRAWN_LAST):
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
