"""Balls that fall in still air, from the closed formula: y = (v²/g) ln cosh(g t/v), v² = 2 m g / (ρ A C_D)."""

from __future__ import annotations

import math

import numpy as np

from hidden.motion import AIR, Floats, G
from hidden.shots import Draw, Recording


def fallen(since: Floats, mass_kg: float, diameter_m: float, C_D: float) -> Floats:
    """Way fallen, m, at times since release, s; 0 before."""
    t = np.maximum(since, 0.0)
    final2 = 2 * mass_kg * G / (AIR * math.pi * diameter_m**2 / 4 * C_D)
    # ln cosh u = u + ln(1 + e^(−2u)) − ln 2, which does not overflow.
    u = G * t / math.sqrt(final2)
    return final2 / G * (u + np.log1p(np.exp(-2 * u)) - math.log(2))


BALLS = ((40.0, 2.7), (65.0, 58.0), (63.0, 12.0), (100.0, 20.0), (38.0, 24.0), (90.0, 60.0))
"""Diameter in mm and mass in g: table tennis, tennis, hollow, foam, squash, soft."""


def drops(draw: Draw, trials: tuple[int, int], C_D: float, noise_m: float) -> tuple[Recording, ...]:
    """Drops of one to three balls, of which the light ones show the air.

    Parameters
    ----------
    trials : fewest and most drops
    C_D : drag coefficient of all of them
    noise_m : white noise of the positions
    """
    hz = float(draw.choice([120.0, 240.0, 480.0]))
    chosen = [BALLS[0], *(BALLS[i] for i in draw.permutation(np.arange(1, len(BALLS)))[: int(draw.integers(0, 3))])]
    count = min(max(trials[0], 4 * len(chosen)), trials[1])
    out = []
    for k in range(count):
        diameter_mm, mass_g = chosen[k % len(chosen)]
        height_m = float(draw.uniform(1.4, 2.4))
        release_s = (int(draw.integers(6, 20)) + float(draw.uniform())) / hz
        times = np.arange(int((release_s + 2.0) * hz)) / hz
        y = fallen(times - release_s, mass_g / 1e3, diameter_mm / 1e3, C_D)
        stop = int(np.searchsorted(y, height_m))
        position = y[:stop] + float(draw.uniform(-0.1, 0.1)) + noise_m * draw.standard_normal(stop)
        cells: dict[str, str | float] = {
            "trial": f"t{k + 1:02d}",
            "track": f"tracks/t{k + 1:02d}.csv",
            "capture_fps": hz,
            "diameter_mm": diameter_mm,
            "pressure_kPa": 0.0,
            "yield_pressure_kPa": 0.0,
            "payload_g": mass_g,
            "growth_angle_deg": 0.0,
            "travel_ratio": 1,
        }
        out.append(Recording(cells, times[:stop], position))
    return tuple(out)
