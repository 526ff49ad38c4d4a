"""How the noise of positions varies from point to point: with the speed of the edge, or as a file states it.

A picture is exposed for a while, so a moving edge is blurred over speed × exposure, and its measured place scatters by
a part of that: sd² = s² + (τ v)², with s of each trial and τ of the experiment. Or the file has a column of standard
deviations, which need not have the right size but show which points are better: sd = s σ.

Both are compared with equal noise by the likelihood of the fourth differences of the positions: the distance of a point
from the cubic through the four around it, a stretch so short that fast motion leaves nothing in it. No model of the
motion enters, so what a model misses cannot pass for noise.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.tracks.outliers import FEWEST_POINTS, LEAST_SHARE, local_fit, local_noise
from vinetrack.tracks.position_noise import robust_position_noise

FOURTH_DIFFERENCE = np.array([1.0, -4.0, 6.0, -4.0, 1.0])  # Weights of a fourth difference

DEVIANCE_DROP = 28.0  # Fall of −2 ln L above which noise that varies is used (derived)

LEAST_SD_RATIO = 1.25  # Least ratio of the largest to the smallest standard deviation of the points (chosen)

WINSORISING_SIGMAS = 4.0  # Standard deviations of their surroundings to which residuals are winsorised

FEWEST_DIFFERENCES = 20  # Fewest fourth differences of a trial from which its noise is estimated (chosen)

# Grid points of τ, by factors of 1.19 from a thirtieth to thirty times what makes both parts equal at the higher
# speeds, and of s, by factors of 1.12; the best τ is then refined by a parabola (derived)
BLUR_GRID_SIZE, SCALE_GRID_SIZE = 41, 61

COARSE_STEP = 5  # Every fifth value of s is tried before those between (chosen)

_SCALE_GRID = np.geomspace(1 / 30, 2.0, SCALE_GRID_SIZE)

UNEVEN_PART = 0.05  # Part of a frame by which spacings may differ in a fourth difference (chosen)

STATED_PART = 0.9  # Least part of a trial's points whose standard deviation must be stated (chosen)


@dataclass(frozen=True)
class NoiseShape:
    """Standard deviations `sd_m` of every point, one array, shape (n_points,), for each trial. `blur_s` is τ, 0 where
    the standard deviations follow those stated.
    """

    sd_m: tuple[Floats, ...]
    blur_s: float


@dataclass(frozen=True)
class _Differences:
    """Fourth differences of a trial, scaled to the noise of one position, m; which are used; speeds, m/s. All arrays
    have shape (n_points,).
    """

    distance_m: Floats
    use: np.ndarray
    speed_m_s: Floats


def noise_shape(
    time_s: Sequence[Floats], position_m: Sequence[Floats], stated_m: Sequence[Floats | None]
) -> NoiseShape | None:
    """Find how the noise of an experiment's tracks varies; None where equal noise describes them as well. Shapes:
    time_s, position_m (n_points,).
    """
    if not time_s or min(times.size for times in time_s) < FEWEST_POINTS:
        return None
    differences = [_differences(t, y) for t, y in zip(time_s, position_m, strict=True)]
    if min(int(part.use.sum()) for part in differences) < FEWEST_DIFFERENCES:
        return None
    equal_noise = sum(_best_scale(part, np.zeros_like(part.speed_m_s))[0] for part in differences)
    shapes = [result for result in (_by_speed(differences), _as_stated(differences, stated_m)) if result is not None]
    if not shapes:
        return None
    deviance, shape = min(shapes, key=lambda result: result[0])
    if equal_noise - deviance < DEVIANCE_DROP or _sd_ratio(shape) < LEAST_SD_RATIO:
        return None
    return shape


def ar1_difference_gain(rho: float) -> float:
    """Ratio of the standard deviation of a fourth difference for AR(1) noise to that for white noise of the same size.
    Var(aᵀe) = aᵀ C a with a the weights of the five points and C_jk = ρ^|j−k|.
    """
    steps = np.arange(FOURTH_DIFFERENCE.size)
    covariance = rho ** np.abs(np.subtract.outer(steps, steps))
    correlated, white = FOURTH_DIFFERENCE @ covariance @ FOURTH_DIFFERENCE, FOURTH_DIFFERENCE @ FOURTH_DIFFERENCE
    return math.sqrt(float(correlated) / float(white))


def _differences(time_s: Floats, position_m: Floats) -> _Differences:
    """Fourth differences of a trial, winsorised, without those over uneven spacings or at corners of the motion."""
    noise_m, _ = robust_position_noise(time_s, position_m)
    fit = local_fit(time_s, position_m, noise_m)
    distance_m = np.zeros(time_s.size)
    distance_m[2:-2] = np.abs(np.convolve(position_m, FOURTH_DIFFERENCE, "valid")) / np.linalg.norm(FOURTH_DIFFERENCE)
    spacing = np.diff(time_s) / np.median(np.diff(time_s))
    even = np.zeros(time_s.size, dtype=bool)
    even[2:-2] = np.lib.stride_tricks.sliding_window_view(np.abs(spacing - 1) < UNEVEN_PART, 4).all(axis=1)
    around_m = local_noise(distance_m)
    use = even & (fit.share >= LEAST_SHARE) & (around_m > 0)
    winsorised_m = np.minimum(distance_m, WINSORISING_SIGMAS * around_m)
    return _Differences(winsorised_m, use, _running_median(np.abs(fit.speed_m_s)))


def _running_median(values: Floats) -> Floats:
    """Running median of five: the slope in one window is unreliable at a corner."""
    view = np.lib.stride_tricks.sliding_window_view(np.pad(values, 2, mode="edge"), 5)
    return np.median(view, axis=1)


def _best_scale(differences: _Differences, extra_m: Floats) -> tuple[float, float]:
    """−2 ln L of a trial's differences with sd² = s² + extra², minimised over s, and that s. Every fifth s is tried,
    then those about the best of them: −2 ln L has one valley.
    """
    square, extra_square = differences.distance_m[differences.use] ** 2, extra_m[differences.use] ** 2
    typical = math.sqrt(float(np.mean(square))) + 1e-300
    s = typical * _SCALE_GRID
    indices = np.arange(0, SCALE_GRID_SIZE, COARSE_STEP)
    for _ in range(2):
        variance = s[indices, None] ** 2 + extra_square
        deviances = np.sum(np.log(variance) + square / variance, axis=1)
        best = int(np.argmin(deviances))
        deviance, k = float(deviances[best]), int(indices[best])
        indices = np.arange(max(k - COARSE_STEP + 1, 0), min(k + COARSE_STEP, SCALE_GRID_SIZE))
    return deviance, float(s[k])


def _by_speed(differences: Sequence[_Differences]) -> tuple[float, NoiseShape] | None:
    """−2 ln L at the most likely τ of all trials together, and the standard deviations."""
    speed = float(np.median([np.quantile(part.speed_m_s[part.use], 0.9) for part in differences]))
    noise = float(np.median([np.median(part.distance_m[part.use]) for part in differences])) / 0.6745
    if not (speed > 0 and noise > 0):
        return None
    grid = noise / speed * np.geomspace(1 / 30, 30.0, BLUR_GRID_SIZE)
    deviances = np.array([sum(_best_scale(part, blur * part.speed_m_s)[0] for part in differences) for blur in grid])
    k = int(np.argmin(deviances))
    blur = float(grid[k])
    if 0 < k < BLUR_GRID_SIZE - 1:
        low, mid, high = deviances[k - 1 : k + 2]
        blur *= float((grid[1] / grid[0]) ** (0.5 * (low - high) / (low - 2 * mid + high)))
    fits = [_best_scale(part, blur * part.speed_m_s) for part in differences]
    sd_m = tuple(np.hypot(s, blur * part.speed_m_s) for (_, s), part in zip(fits, differences, strict=True))
    return sum(level for level, _ in fits), NoiseShape(sd_m, blur)


def _as_stated(
    differences: Sequence[_Differences], stated_m: Sequence[Floats | None]
) -> tuple[float, NoiseShape] | None:
    """−2 ln L of noise in proportion to the stated standard deviations; None where a trial states none."""
    deviance, sd_m = 0.0, []
    for part, stated in zip(differences, stated_m, strict=True):
        if stated is None:
            return None
        is_stated = np.isfinite(stated) & (stated > 0)
        if np.mean(is_stated) < STATED_PART:
            return None
        sigma = np.where(is_stated, stated, np.median(stated[is_stated]))
        # Expected size of a fourth difference, from the noise of its five points.
        weights = FOURTH_DIFFERENCE**2
        variance = np.convolve(np.pad(sigma**2, 2, mode="edge"), weights, "valid") / np.sum(weights)
        expected_m = np.sqrt(variance)[part.use]
        scale = math.sqrt(float(np.mean((part.distance_m[part.use] / expected_m) ** 2)))
        if not scale > 0:
            return None
        deviance += float(np.sum(2 * np.log(scale * expected_m) + 1))
        sd_m.append(scale * sigma)
    return deviance, NoiseShape(tuple(sd_m), 0.0)


def _sd_ratio(shape: NoiseShape) -> float:
    """Ratio of the standard deviations of the noisiest and the quietest points, in the trial where it is largest."""
    return max(float(np.quantile(sd, 0.95) / np.quantile(sd, 0.05)) for sd in shape.sd_m)
