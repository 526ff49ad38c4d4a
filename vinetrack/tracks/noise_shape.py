"""How the noise of positions varies from point to point: with the speed of the edge, or as a file states it.

A picture is exposed for a while, so an edge in motion is blurred over speed × exposure, and where in the blur it is
found varies by a part of that: sd² = s² + (τ v)², s of every trial, τ of the experiment. Or the file has a column of
standard deviations, which need not be right in size but say which points are better: sd = s σ.

Both are compared with equal noise by the likelihood of the fourth differences of the positions: the distance of a point
from the cubic through the four around it, so near that a fast motion leaves nothing in it. No model of the motion
enters, so what a model misses cannot pass for noise.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.tracks.position_noise import robust_position_noise
from vinetrack.tracks.wild_points import FEWEST_POINTS, LEAST_SHARE, local_fit, local_noise

FOURTH = np.array([1.0, -4.0, 6.0, -4.0, 1.0])
"""Weights of a fourth difference; for white noise of variance 1 it has the variance 70."""

EVIDENCE = 28.0
"""Fall of −2 ln L from which points count by a noise that varies. Derived: χ² with one degree of freedom exceeds 10.8
once in a thousand experiments; times 2.6, since differences share points: they are correlated by −0.8, 0.4, −0.11 and
0.01 from one to the next ones, and 1 + 2 Σ ρ² = 2.6."""

LEAST_RATIO = 1.25
"""Ratio of the largest to the smallest standard deviation of the points (95 and 5 %) from which it is worth while.
Chosen: weights that ignore a ratio of 1.25 lose 1 % of the information."""

WINSORISED = 4.0
"""Residuals count up to so many standard deviations of their surroundings: tails are no noise that varies."""

FEWEST_USED = 20
"""Points of a trial from which its noise is told. Chosen: twenty differences tell a standard deviation to 16 %
(1/√40). By reasoning: at half, shapes come from scatter; at twice, short tracks get none."""

BLURS, SCALES = 41, 61
"""Values that are tried of τ, by factors of 1.19 from a thirtieth to thirty times what makes both parts equal at the
higher speeds, and of s, by factors of 1.12; the best τ is then refined by a parabola. Derived: 60^(1/60) and
900^(1/40) a step."""

EVERY = 5
"""Of the values of s every fifth is tried before those between. Chosen: near the root of half their number, where both
turns try as few; on tracks of every kind of noise the answer is that of all values."""

_SCALES_TRIED = np.geomspace(1 / 30, 2.0, SCALES)

UNEVEN = 0.05
"""Part of a frame by which spacings may differ for a fourth difference to be one: printed times are rounded. Chosen as
in `frame_timing`."""

KNOWN_PART = 0.9
"""Part of a trial's points whose standard deviation must be stated."""


@dataclass(frozen=True)
class NoiseShape:
    """`sd_m` has the standard deviation of every point, one array, shape (n_points,), a trial.

    `blur_s` is τ, 0 where the standard deviations follow those stated.
    """

    sd_m: tuple[Floats, ...]
    blur_s: float


@dataclass(frozen=True)
class _Local:
    """Fourth differences of a trial for the noise of one position, m; which of them count; speeds, m/s; (n_points,)."""

    distance_m: Floats
    use: np.ndarray
    speed_m_s: Floats


def noise_shape(
    time_s: Sequence[Floats], position_m: Sequence[Floats], stated_m: Sequence[Floats | None]
) -> NoiseShape | None:
    """The shape that the noise of an experiment's tracks has, None where equal noise does as well.

    Parameters
    ----------
    time_s, position_m : one array, shape (n_points,), a trial; s and m, finite, in order of time.
    stated_m : standard deviations that the files state, NaN where unknown; None where a trial has none.

    Returns
    -------
    the shape, or None where equal noise describes the positions as well.
    """
    if not time_s or min(times.size for times in time_s) < FEWEST_POINTS:
        return None
    parts = [_local(t, y) for t, y in zip(time_s, position_m, strict=True)]
    if min(int(part.use.sum()) for part in parts) < FEWEST_USED:
        return None
    plain = sum(_best(part, np.zeros_like(part.speed_m_s))[0] for part in parts)
    shapes = [result for result in (_by_speed(parts), _as_stated(parts, stated_m)) if result is not None]
    if not shapes:
        return None
    level, shape = min(shapes, key=lambda result: result[0])
    if plain - level < EVIDENCE or _ratio(shape) < LEAST_RATIO:
        return None
    return shape


def correlated_gain(rho: float) -> float:
    """By what a fourth difference is smaller for AR(1) noise than for white.

    Var(aᵀe) = aᵀ C a with a the weights of the five points and C_jk = ρ^|j−k|.

    Parameters
    ----------
    rho : lag-one correlation of the noise, 0 to below 1.

    Returns
    -------
    standard deviation of a fourth difference over that for white noise of the same size; 1 for ρ = 0.
    """
    steps = np.arange(FOURTH.size)
    covariance = rho ** np.abs(np.subtract.outer(steps, steps))
    return math.sqrt(float(FOURTH @ covariance @ FOURTH) / float(FOURTH @ FOURTH))


def _local(time_s: Floats, position_m: Floats) -> _Local:
    noise_m, _ = robust_position_noise(time_s, position_m)
    fit = local_fit(time_s, position_m, noise_m)
    distance_m = np.zeros(time_s.size)
    distance_m[2:-2] = np.abs(np.convolve(position_m, FOURTH, "valid")) / np.linalg.norm(FOURTH)
    spacing = np.diff(time_s) / np.median(np.diff(time_s))
    even = np.zeros(time_s.size, dtype=bool)
    even[2:-2] = np.lib.stride_tricks.sliding_window_view(np.abs(spacing - 1) < UNEVEN, 4).all(axis=1)
    around_m = local_noise(distance_m)
    # At a corner of the motion the difference is no noise.
    use = even & (fit.share >= LEAST_SHARE) & (around_m > 0)
    return _Local(np.minimum(distance_m, WINSORISED * around_m), use, _smooth(np.abs(fit.speed_m_s)))


def _smooth(values: Floats) -> Floats:
    """Running median of five: one window's slope is not to be trusted at a corner."""
    view = np.lib.stride_tricks.sliding_window_view(np.pad(values, 2, mode="edge"), 5)
    return np.median(view, axis=1)


def _best(part: _Local, extra_m: Floats) -> tuple[float, float]:
    """−2 ln L of a trial's distances with sd² = s² + extra², least over s, and that s.

    Every fifth s is tried, then those about the best of them: −2 ln L has one valley.
    """
    square, more = part.distance_m[part.use] ** 2, extra_m[part.use] ** 2
    typical = math.sqrt(float(np.mean(square))) + 1e-300
    s = typical * _SCALES_TRIED
    tried = np.arange(0, SCALES, EVERY)
    for _ in range(2):
        variance = s[tried, None] ** 2 + more
        levels = np.sum(np.log(variance) + square / variance, axis=1)
        least = int(np.argmin(levels))
        level, k = float(levels[least]), int(tried[least])
        tried = np.arange(max(k - EVERY + 1, 0), min(k + EVERY, SCALES))
    return level, float(s[k])


def _by_speed(parts: Sequence[_Local]) -> tuple[float, NoiseShape] | None:
    """The likeliest τ of all trials together, −2 ln L there and the standard deviations."""
    speed = float(np.median([np.quantile(part.speed_m_s[part.use], 0.9) for part in parts]))
    noise = float(np.median([np.median(part.distance_m[part.use]) for part in parts])) / 0.6745
    if not (speed > 0 and noise > 0):
        return None
    tried = noise / speed * np.geomspace(1 / 30, 30.0, BLURS)
    levels = np.array([sum(_best(part, blur * part.speed_m_s)[0] for part in parts) for blur in tried])
    k = int(np.argmin(levels))
    blur = float(tried[k])
    if 0 < k < BLURS - 1:
        low, mid, high = levels[k - 1 : k + 2]
        blur *= float((tried[1] / tried[0]) ** (0.5 * (low - high) / (low - 2 * mid + high)))
    fits = [_best(part, blur * part.speed_m_s) for part in parts]
    sd_m = tuple(np.hypot(s, blur * part.speed_m_s) for (_, s), part in zip(fits, parts, strict=True))
    return sum(level for level, _ in fits), NoiseShape(sd_m, blur)


def _as_stated(parts: Sequence[_Local], stated_m: Sequence[Floats | None]) -> tuple[float, NoiseShape] | None:
    """−2 ln L of noise in proportion to the stated standard deviations; None where a trial states none."""
    level, sd_m = 0.0, []
    for part, stated in zip(parts, stated_m, strict=True):
        if stated is None:
            return None
        known = np.isfinite(stated) & (stated > 0)
        if np.mean(known) < KNOWN_PART:
            return None
        sigma = np.where(known, stated, np.median(stated[known]))
        # A fourth difference has its share of the noise of five points.
        among = np.sqrt(np.convolve(np.pad(sigma**2, 2, mode="edge"), FOURTH**2, "valid") / np.sum(FOURTH**2))[part.use]
        scale = math.sqrt(float(np.mean((part.distance_m[part.use] / among) ** 2)))
        if not scale > 0:
            return None
        level += float(np.sum(2 * np.log(scale * among) + 1))
        sd_m.append(scale * sigma)
    return level, NoiseShape(tuple(sd_m), 0.0)


def _ratio(shape: NoiseShape) -> float:
    """How much noisier the noisiest points are than the quietest, by the trial where that is most."""
    return max(float(np.quantile(sd, 0.95) / np.quantile(sd, 0.05)) for sd in shape.sd_m)
