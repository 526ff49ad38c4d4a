"""A recorded pressure with the noise of its gauge taken out, corners kept.

The speed of a light vine follows the pressure at once, so that 0.1 kPa of noise would throw it about by millimetres
that it never moved; and a noisy pressure passes a threshold early, in every trial by another time.

Where one smooth curve explains a trace, it is taken: the polynomial of least degree that leaves nothing slow. Else
around every sample straight lines are laid through ever more neighbours, for as long as what is left beside them looks
like noise and each agrees with all narrower ones: wide where the pressure runs straight, narrow at a corner (the
intersection of confidence intervals: Goldenshluger & Nemirovski, Math. Methods Stat. 6, 135, 1997).
"""

from __future__ import annotations

import numpy as np

from vinetrack.core.records import Floats

HALF_WIDTHS = (2, 3, 5, 8, 12, 18, 27, 40, 60, 90, 135, 200, 300, 450, 680, 1000)
"""Half widths of the smoothing lines, samples. Chosen: each half as wide again as the one before, so that the best
width is met within a quarter."""

AGREE_SIGMAS = 4.0
"""Half of the interval about each line's value that must share a point with those of all narrower lines. Chosen
(Lepski's rule with κ of 3 to 4): at half corners are found in noise, at twice corners are rounded."""

CHANCE = 1e-5
"""At which noise leaves more beside a line than is let pass. Chosen: one false alarm in 1e5 traces; its square root at
half the number of standard deviations."""

QUIET = 1e-4
"""Noise below this part of the median pressure is rounding, and left as it is. Chosen: a tenth of the last digit that
pressure gauges print."""

FEWEST = 9
"""Samples below which a trace is left as it is. Derived: twice the degrees of freedom of a cubic and one more."""

MOST_BENT, LOOKED_BEYOND, SLOW_SIGMAS = 6, 12, 3.3
"""Degree of a curve at most; of so many degrees beyond its own none may show by so many standard deviations. Chosen:
sixth degree follows any filling and draining seen; 3.3 standard deviations are a chance of 1e-3."""


def without_noise(pressure_Pa: Floats) -> Floats:
    """Pressure, shape (n,), of samples about evenly spaced, with white noise taken out.

    Returns the same values where there is no noise to speak of, or too few samples (under 9) to tell.

    Parameters
    ----------
    pressure_Pa : array, shape (n,), Pa
        Samples of a trace.

    Returns
    -------
    array, shape (n,), Pa
    """
    if pressure_Pa.size < FEWEST:
        return pressure_Pa
    sigma = noise_of(pressure_Pa)
    if not sigma > QUIET * abs(float(np.median(pressure_Pa))):
        return pressure_Pa
    curve = _one_curve(pressure_Pa, sigma)
    return _lines(pressure_Pa, sigma) if curve is None else curve


def _one_curve(pressure_Pa: Floats, sigma: float) -> Floats | None:
    """The polynomial of least degree beside which only noise is left; None where there is none."""
    from numpy.polynomial.legendre import legvander
    from scipy.stats import chi2

    most = min(MOST_BENT + LOOKED_BEYOND, pressure_Pa.size // 3)
    basis, _ = np.linalg.qr(legvander(np.linspace(-1, 1, pressure_Pa.size), most))
    parts = basis.T @ pressure_Pa
    shows = np.flatnonzero(np.abs(parts) > SLOW_SIGMAS * sigma)
    degree = int(shows[-1]) if shows.size else 0
    if degree > min(MOST_BENT, most - 1):
        return None
    curve = basis[:, : degree + 1] @ parts[: degree + 1]
    left = float(np.sum((pressure_Pa - curve) ** 2))
    return None if left > sigma**2 * chi2.isf(CHANCE, pressure_Pa.size - degree - 1) else np.asarray(curve)


def _lines(pressure_Pa: Floats, sigma: float) -> Floats:
    """A line through as many neighbours of every sample as agree with it."""
    from scipy.stats import chi2

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
    """Standard deviation of white noise on a smooth course, from third differences; their variance is 20 σ².

    Parameters
    ----------
    pressure_Pa : array, shape (n,), Pa
        Samples of a trace.

    Returns
    -------
    float
        Pa
    """
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
    sums = [np.concatenate([[0.0], np.cumsum(values)]) for values in (x, x * x, y, x * y, y * y)]
    count = (last - first).astype(float)
    mean_x, mean_xx, mean_y, mean_xy, mean_yy = ((values[last] - values[first]) / count for values in sums)
    spread = mean_xx - mean_x**2
    away = x - mean_x
    joint = mean_xy - mean_x * mean_y
    beside = np.maximum(mean_yy - mean_y**2 - joint**2 / spread, 0.0) * count
    part = np.sqrt((1 + away**2 / spread) / count)
    return y_mean + mean_y + joint / spread * away, part, beside, count - 2
