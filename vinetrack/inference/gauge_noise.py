"""A recorded pressure with the noise of its gauge taken out, corners kept.

The speed of a light vine follows the pressure at once, so that 0.1 kPa of noise would throw it about by millimetres
that it never moved; and a noisy pressure passes a threshold early, in every trial by another time.

Where a few numbers explain a trace, they are fitted: a polynomial in time, or, since the pressure falls as the tube
fills and has its corner where the growth begins, a polynomial in time and in the growth that is seen. Gauge and camera
may differ in their clocks, so the growth may be shifted. Of the curves that leave only noise that with the least AIC
(Akaike, IEEE Trans. Autom. Control 19, 716, 1974) is taken. Where there is none,
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

LOCAL_SIGMAS = 5.0
"""Standard deviations by which a sum of neighbouring residuals may stand out. Chosen: of a thousand samples in sixteen
widths one does by chance in two hundred traces; at 4 one in five, and the lines are taken where a curve would do."""

MOST_SHIFTED, COARSE = 60, 4
"""Samples by which the clocks of gauge and camera may differ here, and the step in which that is looked for first.
Chosen: 60 frames are 40 ms at 1500 frames/s, beyond which a clock is mended and not doubted; a step of four samples is
refined to one."""

ENOUGH = 400
"""Samples from which the shift is found. Chosen: a few hundred tell it to a frame, more only cost time."""

ALONG_GROWTH = ((0, 1), (0, 2), (1, 1), (1, 2), (1, 3), (2, 2), (2, 3), (3, 4))
"""Degrees in time and in growth that are tried. Chosen: a chamber that empties without heat is of second degree in the
growth to 1e-4 of its pressure, a supply that refills it is slow in time."""


def without_noise(pressure_Pa: Floats, growth_m: Floats | None = None) -> Floats:
    """Pressure, shape (n,), of samples about evenly spaced, with white noise taken out.

    Returns the same values where there is no noise to speak of, or too few samples (under 9) to tell.

    Parameters
    ----------
    pressure_Pa : array, shape (n,), Pa
        Samples of a trace.
    growth_m : array, shape (n,), m, optional
        Position of the leading edge at the same instants.

    Returns
    -------
    array, shape (n,), Pa
    """
    if pressure_Pa.size < FEWEST:
        return pressure_Pa
    sigma = noise_of(pressure_Pa)
    if not sigma > QUIET * abs(float(np.median(pressure_Pa))):
        return pressure_Pa
    curve = _curve(pressure_Pa, growth_m, sigma)
    return _lines(pressure_Pa, sigma) if curve is None else curve


def _curve(pressure_Pa: Floats, growth_m: Floats | None, sigma: float) -> Floats | None:
    """The curve of least AIC beside which only noise is left; None where there is none."""
    slow = _polynomials(pressure_Pa.size, min(MOST_BENT + LOOKED_BEYOND, pressure_Pa.size // 3))
    bases = [slow[:, : degree + 1] for degree in range(min(MOST_BENT, slow.shape[1] - 2) + 1)]
    if growth_m is not None and np.ptp(growth_m) > 0:
        bases += _growth_bases(pressure_Pa, growth_m)
    best, least = None, np.inf
    for basis in bases:
        curve = basis @ (basis.T @ pressure_Pa)
        numbers = basis.shape[1]
        criterion = float(np.sum((pressure_Pa - curve) ** 2)) / sigma**2 + 2 * numbers
        if criterion < least and _is_noise(pressure_Pa - curve, sigma, numbers, slow):
            best, least = curve, criterion
    return best


def _polynomials(count: int, degree: int) -> Floats:
    """Orthonormal polynomials in time, shape (count, degree + 1)."""
    from numpy.polynomial.legendre import legvander

    return np.asarray(np.linalg.qr(legvander(np.linspace(-1, 1, count), degree))[0])


def _growth_bases(pressure_Pa: Floats, growth_m: Floats) -> list[Floats]:
    """Orthonormal bases of polynomials in time and growth, each with the growth shifted to where it fits best."""
    reach = min(pressure_Pa.size // 4, MOST_SHIFTED)
    coarse = range(-reach, reach + 1, COARSE)

    every = max(growth_m.size // ENOUGH, 1)

    def columns(shift: int, bent: int, along: int) -> Floats:
        place = np.clip(np.arange(growth_m.size) + shift, 0, growth_m.size - 1)
        t, g = np.linspace(-1, 1, growth_m.size), (growth_m[place] - growth_m[0]) / np.ptp(growth_m)
        return np.column_stack([t**k for k in range(bent + 1)] + [g**k for k in range(1, along + 1)])

    def explained(shift: int) -> float:
        few = np.linalg.qr(columns(shift, 1, 2)[::every])[0]
        return float(np.sum((few.T @ pressure_Pa[::every]) ** 2))

    best = max(coarse, key=explained)
    best = max(range(best - COARSE, best + COARSE + 1), key=explained)
    return [np.linalg.qr(columns(best, bent, along))[0] for bent, along in ALONG_GROWTH]


def _is_noise(residual_Pa: Floats, sigma: float, fitted: int, slow: Floats) -> bool:
    """Whether what a curve of so many fitted numbers leaves has neither a slow part nor more than the noise."""
    from scipy.stats import chi2

    if np.any(np.abs(slow.T @ residual_Pa) > SLOW_SIGMAS * sigma):
        return False
    # A corner that is cut stands out over the samples about it and nowhere else.
    total = np.concatenate([[0.0], np.cumsum(residual_Pa)])
    for width in (2 * half + 1 for half in HALF_WIDTHS if 2 * half < residual_Pa.size):
        if np.max(np.abs(total[width:] - total[:-width])) > LOCAL_SIGMAS * sigma * np.sqrt(width):
            return False
    return bool(residual_Pa @ residual_Pa <= sigma**2 * chi2.isf(CHANCE, residual_Pa.size - fitted))


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
