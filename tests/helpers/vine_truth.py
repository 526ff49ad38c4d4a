"""Truth for the tests of `motion`: everting vines integrated by SciPy, and noise of known statistics.

m(x) ẍ = ½(P − P_y)A + m g − ½B ẋⁿ with m = λL + m_pay − (λ/2)x, integrated to 1e-10: none of the package's own
integrators or effects take part.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from by_hand import followed
from scipy.signal import lfilter

from vinetrack.core.records import Floats, Track, plain_track

G = 9.81
N_EXPONENT = 0.37
B_PRINTED = {1: 0.57, 2: 1.83, 3: 4.54, 4: 6.44}
CAPTURE_FPS = 1069.0


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
    b = B_PRINTED[vine.scale]

    def acceleration(_t: float, x: float, v: float) -> float:
        return (0.5 * vine.drive_N - 0.5 * b * v**N_EXPONENT) / float(vine.mass_kg(x)) + G

    travel = followed(acceleration, 2 * 0.999 * vine.length_m, until=40 * vine.length_m / vine.tail_speed_m_s)
    return travel.state, travel.end


@dataclass(frozen=True)
class Recording:
    """A sampled trial: the track that an analysis sees, and the truth that it does not."""

    track: Track
    lead_position_m: Floats
    lead_velocity_m_s: Floats
    release_s: float
    grown_s: float


def ar1(n: int, sd: float, rho: float, rng: np.random.Generator) -> Floats:
    """Stationary AR(1) noise of marginal standard deviation `sd`."""
    innovations = rng.standard_normal(n + 60) * sd * math.sqrt(1 - rho**2)
    return lfilter([1.0], [1.0, -rho], innovations)[60:]


def record(vine: Vine, rng, *, noise_m: float, rho=0.0, rest_frames=40, end_frames=0) -> Recording:
    """Sample a vine: still frames before release, `end_frames` flat ones once it is grown, arbitrary zeros."""
    solution, duration_s = motion(vine)
    release_s = (rest_frames + rng.uniform()) / CAPTURE_FPS
    n = int(np.floor((release_s + duration_s) * CAPTURE_FPS)) + 1 + end_frames
    time_s = np.arange(n) / CAPTURE_FPS
    since = np.clip(time_s - release_s, 0, duration_s)
    tail, tail_speed = solution(since)
    lead, lead_speed = tail / 2, tail_speed / 2
    lead_speed = np.where((time_s <= release_s) | (time_s > release_s + duration_s), 0.0, lead_speed)
    offset_s, origin_m = rng.uniform(-3, 3), rng.uniform(-0.1, 0.1)
    noisy = lead + origin_m + ar1(n, noise_m, rho, rng)
    track = plain_track(time_s + offset_s, noisy)
    return Recording(track, lead + origin_m, lead_speed, release_s + offset_s, release_s + duration_s + offset_s)
