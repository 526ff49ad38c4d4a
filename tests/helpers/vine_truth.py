"""Truth for the tests of `motion`: the vines of `by_hand`, followed by SciPy, as recordings with noise of known
statistics.
"""

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from by_hand import N, Vine, followed
from scipy.signal import lfilter

from vinetrack.core.records import Floats, Track, plain_track

B_PRINTED = {1: 0.57, 2: 1.83, 3: 4.54, 4: 6.44}
CAPTURE_FPS = 1069.0


def scaled(scale: int, tail_speed_m_s: float, payload: float = 0.0) -> Vine:
    """A vine of the paper's scales, at a pressure whose (P − P_y)A holds a weightless tail at this speed."""
    vine = Vine(0.006 * scale, 50e-6 * scale, 0.070 * scale, 3e3, 3e3, B_PRINTED[scale], payload)
    return replace(vine, P=vine.P_y + vine.B * tail_speed_m_s**N / vine.A)


@lru_cache(maxsize=512)
def motion(vine: Vine):
    """Dense solution (x, ẋ)(t) of one vine from rest, and the time at which it is fully grown (99.9 % of L)."""
    travel = followed(lambda _t, x, v: vine.base(x, v) / vine.m(x), 2 * 0.999 * vine.L)
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
