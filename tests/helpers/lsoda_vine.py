"""Vines grown by scipy, for tests: Eq. (2) of the physics written out once more, nothing of the package's own model."""

import math
from dataclasses import replace
from functools import lru_cache

import numpy as np
from by_hand import followed

from vinetrack.core.records import Track, Trial, plain_track
from vinetrack.experiment.schema import with_names
from vinetrack.laboratory.campaigns import Vine
from vinetrack.tracks.position_noise import ar1_noise

FPS = 1000.0
B_TRUE = {24.0: 6.4, 18.0: 4.5}
N_TRUE = 0.4
NOISE_M = 1e-4


def vine_trial(name: str, pressure_kPa: float, diameter_mm: float = 24.0, **more: object) -> Trial:
    """A trial of an everting vine straight down, P_y 3 kPa, wall D/120, length 11.67 D."""
    vine = Vine(diameter_mm, diameter_mm / 0.12, 280 * diameter_mm / 24)
    return replace(vine.trial(name, pressure_kPa, capture_fps=FPS), **more)  # type: ignore[arg-type]


def grown_position(trial: Trial, time_s, B: float, n=N_TRUE, pressure_gain=1.0, pressure_along=None) -> np.ndarray:
    """Lead position at times since release, NaN beyond 96 % of the length; `pressure_along` is a pressure by it."""
    area = math.pi * trial.diameter_m**2 / 4
    film = trial.film_density_kg_m3 * math.pi * trial.diameter_m * trial.thickness_m
    gravity = 9.81 * math.cos(trial.growth_angle_rad)

    def acceleration(_t: float, x: float, v: float) -> float:
        pressure_Pa = pressure_gain * (trial.pressure_Pa if pressure_along is None else pressure_along(x / 2))
        mass = film * trial.length_m - 0.5 * film * x + trial.payload_kg
        return (0.5 * (pressure_Pa - trial.yield_pressure_Pa) * area - 0.5 * B * v**n) / mass + gravity

    travel = followed(acceleration, 2 * 0.96 * trial.length_m, until=float(time_s[-1]))
    return np.where(time_s <= travel.end, travel(np.clip(time_s, 0, travel.end)) / 2, np.nan)


def as_track(time_s: np.ndarray, position_m: np.ndarray, pressure_Pa: np.ndarray | None = None) -> Track:
    return plain_track(time_s, position_m, pressure_Pa=pressure_Pa)


def filmed(trial: Trial, draw, *, damping=1.0, pressure=1.0, rho=0.0) -> tuple[Track, float, float]:
    """A track of a trial whose B and P are off by these factors, its release, s, and its origin, m."""
    release_s = (20 - draw.uniform()) / FPS
    origin_m = float(draw.uniform(-0.05, 0.05))
    time_s = np.arange(4000) / FPS
    B = B_TRUE[round(trial.diameter_m * 1e3, 3)] * damping
    position = grown_position(trial, time_s - release_s, B, N_TRUE, pressure)
    seen = np.isfinite(position)
    noise = NOISE_M * ar1_noise(int(seen.sum()), 1.0, rho, draw)
    return as_track(time_s[seen], origin_m + position[seen] + noise), release_s, origin_m


@lru_cache(maxsize=32)
def small_campaign(seed: int, damping=0.03, pressure=0.01, rho=0.0, replicates=2) -> tuple[tuple, tuple]:
    """Two vines, four pressures; sheet and tracks, and the truth of every trial."""
    draw = np.random.default_rng(seed)
    settings = [(24.0, P) for P in (12, 16, 22, 30)] + [(18.0, P) for P in (16, 22, 30, 42)]
    trials = [vine_trial(f"D{D:g}_{P:g}_{k}", P, D) for D, P in settings for k in range(replicates)]
    pairs, truth = [], []
    for trial in with_names(trials):
        B_off = math.exp(damping * draw.standard_normal())
        P_off = 1 + pressure * draw.standard_normal()
        track, release_s, origin_m = filmed(trial, draw, damping=B_off, pressure=P_off, rho=rho)
        pairs.append((trial, track))
        truth.append({"damping": B_off, "pressure": P_off, "release_s": release_s, "origin_m": origin_m})
    return tuple(pairs), tuple(truth)
