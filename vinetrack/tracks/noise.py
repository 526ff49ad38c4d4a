"""The noise of a track: what one position errs by, and how far the error remembers itself."""

from __future__ import annotations

import math

import numpy as np

from vinetrack.core.records import Floats, Track
from vinetrack.tracks.position_noise import position_noise, rest_points

__all__ = ["ar1_noise", "rest_points", "track_noise"]


def track_noise(track: Track) -> tuple[float, float]:
    """Standard deviation and lag-one correlation of the random error of a single position.

    Parameters
    ----------
    track
        A track; only its usable points are read.

    Returns
    -------
    noise_m
        Standard deviation, m. 0 where the positions are exact or too few (under 5) to tell.
    correlation
        Lag-one correlation, 0 to 0.95; pulled to 0 where the track is too short to tell.
    """
    usable = track.usable
    return position_noise(track.time_s[usable], track.lead_position_m[usable])


def ar1_noise(count: int, sd: float, correlation: float, draw: np.random.Generator) -> Floats:
    """Draw stationary autoregressive noise of first order, as simulated tracks have it.

    Parameters
    ----------
    count : number of positions.
    sd : standard deviation of each, m.
    correlation : lag-one correlation, above -1 and below 1.
    draw : random numbers; `count` normal deviates are taken.

    Returns
    -------
    array, shape (count,), m: the first is a draw from the stationary distribution, every other one is `correlation`
    times its predecessor plus an innovation of variance (1 − correlation²)·sd².
    """
    from scipy.signal import lfilter

    white = draw.standard_normal(count)
    white[1:] *= math.sqrt(1 - correlation**2)
    return sd * np.asarray(lfilter([1.0], [1.0, -correlation], white))
