"""The two simulators against each other: the same trial, the same effect, no noise."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import pandas as pd

import vinetrack as vt
from hidden.designs import FILM_KG_M3
from hidden.motion import Floats, Physics, Tube, follow
from vinetrack.core.records import Bend, Trial

SIZES: dict[str, tuple[Mapping[str, float], Mapping[str, float]]] = {
    "": ({}, {}),
    "reservoir_depletion": ({"gamma": 1.3}, {"gamma": 1.3}),
    "supply_refill": ({"gamma": 1.3, "refill_s": 0.1}, {"gamma": 1.3, "tau": 0.1}),
    "leak": ({"leak_rate": 1.0}, {"rate": 1.0}),
    "inlet_loss": ({"K": 2.0}, {"K": 2.0}),
    "gas_inertia": ({"gas": 1.0}, {"factor": 1.0}),
    "air_drag": ({"C_D": 2.0}, {"C_D": 2.0}),
    "fold_inertia": ({"eta": 0.7}, {"eta": 0.7}),
    "linear_damping": ({"b": 0.05}, {"b": 0.05}),
    "pressure_damping": ({"beta": 5e-6}, {"beta": 5e-6}),
    "tail_friction": ({"mu_w": 0.3}, {"mu_w": 0.3}),
    "capstan_friction": ({"capstan_C": 0.01, "capstan_mu": 0.8, "capstan_k": 6.0}, {"C": 0.01, "mu_c": 0.8, "k": 6.0}),
    "payload_friction": ({"mu_p": 0.3}, {"mu_p": 0.3}),
    "payload_drag": ({"drag_area": 1e-3}, {"drag_area": 1e-3}),
    "wall_stretch": ({"kappa": 3e-6}, {"kappa": 3e-6}),
    "tail_stretch": ({"compliance": 6e-8}, {"compliance": 6e-8}),
    "latch_release": ({"latch_F": 0.1, "latch_reach": 8e-3}, {"F": 0.1, "reach": 8e-3}),
    "reel_inertia": ({"reel_kg": 0.01}, {"M": 0.01}),
    "falling_friction": (
        {"stribeck_F": 0.5, "stribeck_speed": 1.5, "stribeck_power": 2.0},
        {"F_s": 0.5, "v_s": 1.5, "k": 2.0},
    ),
    "supply_pulsation": ({"ringing": 0.1, "ringing_hz": 22.0, "ringing_phase": 0.7}, {"a": 0.1, "f": 22.0, "phi": 0.7}),
    "end_stop": ({"stop_k": 8.0, "stop_y": 0.1}, {"k": 8.0, "y_0": 0.1}),
    "quadratic_length_friction": ({"square_q": 3.0}, {"q": 3.0}),
    "length_scale": ({}, {"eps": 0.03}),
    "time_base": ({}, {"eps": -0.04}),
    "pressure_gain": ({}, {"eps": 0.05}),
    "pressure_gauge": ({}, {"delta": 900.0}),
    "area_scale": ({}, {"eps": -0.03}),
    "film_mass": ({}, {"eps": 0.08}),
    "payload_mass": ({}, {"delta": -12e-3}),
    "perspective": ({}, {"k": 0.2}),
}
"""Sizes by effect: as the generator names them, and as the catalogue does."""

FRAME_S, FRAMES = 5e-4, 1200


def trials() -> dict[str, Trial]:
    """Rigs that differ in all that matters."""
    plain = {
        "vine": "v",
        "diameter_m": 0.024,
        "thickness_m": 2e-4,
        "length_m": 0.28,
        "pressure_Pa": 28e3,
        "yield_pressure_Pa": 3e3,
        "chamber_m3": 2e-3,
        "inlet_m": 0.01,
    }
    small = {"diameter_m": 0.006, "thickness_m": 5e-5, "length_m": 0.07, "pressure_Pa": 20e3, "inlet_m": 0.003}
    bends = (Bend(0.05, 0.04, 0.03), Bend(0.15, 0.05, 0.06))
    given = {
        "bare, down": {},
        "payload, down": {"payload_kg": 0.0356},
        "payload, up": {"payload_kg": 0.0356, "growth_angle_rad": math.pi},
        "horizontal, slow": {"pressure_Pa": 14e3, "growth_angle_rad": math.pi / 2},
        "small": small,
        "bent": {"bends": bends},
        "reel": {"tail_store": "reel"},
    }
    return {name: Trial(name=f"t{i}", **{**plain, **own}) for i, (name, own) in enumerate(given.items())}


def ours(effect: str, trial: Trial, times: Floats, B: float, n: float) -> Floats:
    """What the generator says that the camera reports."""
    physics, values = SIZES[effect]
    eps = values.get("eps", 0.0) if effect in ("length_scale", "time_base", "pressure_gain", "area_scale") else 0.0
    gain = 1 + eps if effect == "pressure_gain" else 1.0
    tube = Tube(
        pressure=trial.pressure_Pa * gain + (values["delta"] if effect == "pressure_gauge" else 0.0),
        yield_pressure=trial.yield_pressure_Pa * gain,
        diameter=trial.diameter_m * (1 + eps if effect == "area_scale" else 1.0),
        thickness=trial.thickness_m,
        length=trial.length_m,
        payload=trial.payload_kg + (values["delta"] if effect == "payload_mass" and trial.payload_kg else 0.0),
        cosine=math.cos(trial.growth_angle_rad),
        chamber=trial.chamber_m3,
        inlet_area=math.pi * trial.inlet_m**2 / 4,
        reel=float(trial.tail_store == "reel"),
        has_bends=float(bool(trial.bends)),
        film_density=FILM_KG_M3 * (1 + values["eps"] if effect == "film_mass" else 1.0),
    )
    bends = np.array([(bend.start_m, bend.arc_m, bend.radius_m) for bend in trial.bends]).reshape(-1, 3)
    clock = 1 + eps if effect == "time_base" else 1.0
    out, _ = follow(times / clock, tube, Physics(B=B, n=n, **physics), bends)
    y = out[:, 0] - out[0, 0]  # since rest
    if effect == "perspective":
        y = y + values["k"] * y**2
    return np.where(out[:, 1] < 0.95 * trial.length_m, y * (1 + eps if effect == "length_scale" else 1.0), np.nan)


def differences() -> pd.DataFrame:
    """Largest difference of the reported position, as a part of the length, by effect and rig, up to 95 % of it."""
    times = FRAME_S * np.arange(-3, FRAMES)
    lines = []
    for effect, (_, values) in SIZES.items():
        line: dict[str, object] = {"effect": effect or "(base)"}
        for rig, trial in trials().items():
            B, n = (0.57 if trial.diameter_m < 0.01 else 6.44), 0.37
            model = vt.base_model() + getattr(vt.effects, effect) if effect else vt.base_model()
            own = {f"{effect}.{name}": value for name, value in values.items()}
            model = model.with_values({"eversion_damping.B": B, "eversion_damping.n": n, **own})
            theirs = vt.simulate(model, trial, times, relative_tolerance=1e-7).observed_position_m
            line[rig] = float(np.nanmax(np.abs(theirs - ours(effect, trial, times, B, n)))) / trial.length_m
        lines.append(line)
    return pd.DataFrame(lines)
