"""Truth for the tests of `motion`: everting vines integrated by SciPy, and noise of known statistics.

m(x) ẍ = ½(P − P_y)A + m g − ½B ẋⁿ with m = λL + m_pay − (λ/2)x, integrated by Radau (rtol 1e-10): none of the
package's own integrators or effects take part.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from vinetrack.core.records import Track, plain_track

G = 9.81
N_EXPONENT = 0.37
B_PRINTED = {1: 0.57, 2: 1.83, 3: 4.54, 4: 6.44}
CAPTURE_FPS = 1069.0

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Vine:
    """One trial from rest: tail position and speed at any time after release, and the quasi-steady tail speed."""

    scale: int
    tail_speed_m_s: float
    payload_kg: float = 0.0

    @property
    def diameter_m(self) -> float:
        return 0.006 * self.scale

    @property
    def length_m(self) -> float:
        return 0.070 * self.scale

    @property
    def linear_density_kg_m(self) -> float:
        return 1200 * math.pi * self.diameter_m * 50e-6 * self.scale

    @property
    def drive_N(self) -> float:
        """(P − P_y)A that holds a weightless tail at `tail_speed_m_s`."""
        return B_PRINTED[self.scale] * self.tail_speed_m_s**N_EXPONENT

    def mass_kg(self, tail_position_m: Floats | float) -> Floats:
        c = self.linear_density_kg_m / 2
        return self.linear_density_kg_m * self.length_m + self.payload_kg - c * np.asarray(tail_position_m)

    def quasi_steady_speed(self, tail_position_m: Floats) -> Floats:
        """Tail speed at which all forces balance at this position: B ẋⁿ = (P − P_y)A + 2 m g."""
        force = self.drive_N + 2 * self.mass_kg(tail_position_m) * G
        return (force / B_PRINTED[self.scale]) ** (1 / N_EXPONENT)


@lru_cache(maxsize=512)
def motion(vine: Vine):
    """Dense solution (x, ẋ)(t) of one vine from rest, and the time at which it is fully grown (99.9 % of L)."""
    b, length = B_PRINTED[vine.scale], vine.length_m

    def slope(_t: float, state: Floats) -> list[float]:
        x, v = state
        mass = max(float(vine.mass_kg(x)), 1e-9)
        force = 0.5 * vine.drive_N + mass * G - 0.5 * b * max(v, 0.0) ** N_EXPONENT
        return [v, force / mass]

    def grown(_t: float, state: Floats) -> float:
        return state[0] - 2 * 0.999 * length

    grown.terminal = True
    limit_s = 20 * 2 * length / vine.tail_speed_m_s
    solution = solve_ivp(
        slope, (0, limit_s), [0.0, 0.0], "Radau", rtol=1e-10, atol=1e-13, dense_output=True, events=grown
    )
    return solution.sol, float(solution.t[-1])


@dataclass(frozen=True)
class Recording:
    """A sampled trial: the track that an analysis sees, and the truth that it does not."""

    track: Track
    lead_position_m: Floats
    lead_velocity_m_s: Floats
    release_s: float
    grown_s: float


def make_track(time_s: Floats, lead_position_m: Floats) -> Track:
    """A plain track without flags."""
    return plain_track(np.asarray(time_s, dtype=float), np.asarray(lead_position_m, dtype=float))


def ar1(n: int, sd: float, rho: float, rng: np.random.Generator) -> Floats:
    """Stationary AR(1) noise of marginal standard deviation `sd`."""
    from scipy.signal import lfilter

    burn = 60
    innovations = rng.standard_normal(n + burn) * sd * math.sqrt(1 - rho**2)
    return lfilter([1.0], [1.0, -rho], innovations)[burn:]


def record(
    vine: Vine,
    rng: np.random.Generator,
    *,
    noise_m: float,
    rho: float = 0.0,
    rest_frames: int = 40,
    end_frames: int = 0,
    capture_fps: float = CAPTURE_FPS,
) -> Recording:
    """Sample a vine: still frames before release, `end_frames` flat ones once it is grown, arbitrary zeros."""
    solution, duration_s = motion(vine)
    release_s = (rest_frames + rng.uniform()) / capture_fps
    n = int(np.floor((release_s + duration_s) * capture_fps)) + 1 + end_frames
    time_s = np.arange(n) / capture_fps
    since = np.clip(time_s - release_s, 0, duration_s)
    tail, tail_speed = solution(since)
    lead, lead_speed = tail / 2, tail_speed / 2
    lead_speed = np.where((time_s <= release_s) | (time_s > release_s + duration_s), 0.0, lead_speed)
    offset_s, origin_m = rng.uniform(-3, 3), rng.uniform(-0.1, 0.1)
    noisy = lead + origin_m + ar1(n, noise_m, rho, rng)
    return Recording(
        make_track(time_s + offset_s, noisy),
        lead + origin_m,
        lead_speed,
        release_s + offset_s,
        release_s + duration_s + offset_s,
    )
