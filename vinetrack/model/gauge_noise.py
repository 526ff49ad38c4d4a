"""A recorded pressure with the noise of its gauge taken out, corners kept.

The speed of a light vine follows the pressure at once, so that 0.1 kPa of noise would throw it about by millimetres
that it never moved; and a noisy pressure passes a threshold early, in every trial by another time.

Around every sample straight lines are laid through ever more neighbours, for as long as what is left beside them looks
like noise and each agrees with all narrower ones: wide where the pressure runs straight, narrow at a corner (the
intersection of confidence intervals: Goldenshluger & Nemirovski, Math. Methods Stat. 6, 135, 1997).
"""

from __future__ import annotations

import numpy as np

from vinetrack.records import Floats

HALF_WIDTHS = (2, 3, 5, 8, 12, 18, 27, 40, 60, 90, 135, 200)
AGREE_SIGMAS = 3.0
"""Half of the interval about each line's value that must share a point with those of all narrower lines."""

CHANCE = 2e-3
"""At which noise leaves more beside a line than is let pass."""

QUIET = 1e-4
"""Noise below this part of the median pressure is rounding, and left as it is."""

FEWEST = 9


def without_noise(pressure_Pa: Floats) -> Floats:
    """Pressure, shape (n,), of samples about evenly spaced, with white noise taken out.

    Returns the same values where there is no noise to speak of, or too few samples (under 9) to tell.
    """
    from scipy.stats import chi2

    if pressure_Pa.size < FEWEST:
        return pressure_Pa
    sigma = noise_of(pressure_Pa)
    if not sigma > QUIET * abs(float(np.median(pressure_Pa))):
        return pressure_Pa
    smooth = pressure_Pa.copy()
    low, high = np.full(smooth.size, -np.inf), np.full(smooth.size, np.inf)
    agrees = np.ones(smooth.size, dtype=bool)
    for half in HALF_WIDTHS:
        value, part, left, degrees = _line(pressure_Pa, half)
        reach = AGREE_SIGMAS * sigma * part
        low, high = np.maximum(low, value - reach), np.minimum(high, value + reach)
        agrees &= (low <= high) & (left < sigma**2 * chi2.isf(CHANCE, degrees))
        if not agrees.any():
            break
        smooth[agrees] = value[agrees]
    return smooth


def noise_of(pressure_Pa: Floats) -> float:
    """Standard deviation of white noise on a smooth course, from third differences; their variance is 20 σ²."""
    third = np.diff(pressure_Pa, 3)
    return float(1.4826 * np.median(np.abs(third)) / np.sqrt(20))


def _line(y: Floats, half: int) -> tuple[Floats, Floats, Floats, Floats]:
    """Value at every sample of a line through its neighbours, `half` to each side where there are so many.

    With it the standard deviation of that value, as part of a sample's, and the sum of squares beside the line with its
    degrees of freedom. Shapes (n,).
    """
    y_mean = float(np.mean(y))
    y = y - y_mean
    place = np.arange(y.size)
    first, last = np.maximum(place - half, 0), np.minimum(place + half, y.size - 1) + 1
    x = place - 0.5 * (y.size - 1)
    sums = [np.concatenate([[0.0], np.cumsum(one)]) for one in (x, x * x, y, x * y, y * y)]
    count = (last - first).astype(float)
    mean_x, mean_xx, mean_y, mean_xy, mean_yy = ((one[last] - one[first]) / count for one in sums)
    spread = mean_xx - mean_x**2
    away = x - mean_x
    joint = mean_xy - mean_x * mean_y
    beside = np.maximum(mean_yy - mean_y**2 - joint**2 / spread, 0.0) * count
    part = np.sqrt((1 + away**2 / spread) / count)
    return y_mean + mean_y + joint / spread * away, part, beside, count - 2
