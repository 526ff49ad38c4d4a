"""Least squares over windows of raw positions with AR(1) noise: speed, drift and their standard errors."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from vinetrack.core.records import Floats, Indices, Kinematics, Window
from vinetrack.kinematics.windows import correlated

Bounds = Callable[[Indices, Indices], tuple[Floats, Floats]]


class WindowMoments:
    """Quadratic fits to the raw positions of any window in constant time. A window consists of two stretches that meet
    at a middle. Level k has a middle every 2^(k + 1) points and the sums outwards from it, of moments about its own
    time and position (a disjoint sparse table).
    """

    def __init__(self, time_s: Floats, position_m: Floats, noise_m: float, correlation: float) -> None:
        n = time_s.size
        self.noise_m, self.correlation = noise_m, correlation
        self.unit_s = max(float(time_s[-1] - time_s[0]), np.finfo(float).tiny) / 2
        self.u = (time_s - (time_s[0] + time_s[-1]) / 2) / self.unit_s
        size = 1 << max(n - 1, 1).bit_length()
        inside = np.arange(size) < n
        u, y = np.zeros(size), np.zeros(size)
        u[:n], y[:n] = self.u, position_m
        self.sums = np.empty((size.bit_length() - 1, 8, size))
        for level, sums in enumerate(self.sums):
            middle = np.repeat(np.arange(1 << level, size, 2 << level), 2 << level)
            w, v = np.where(inside, u - u[middle], 0.0), np.where(inside, y - y[middle], 0.0)
            terms = np.array([inside, w, w * w, w * w * w, (w * w) ** 2, v, v * w, v * w * w])
            blocks, into = terms.reshape(8, -1, 2 << level), sums.reshape(8, -1, 2 << level)
            into[..., : 1 << level] = np.cumsum(blocks[..., (1 << level) - 1 :: -1], axis=2)[..., ::-1]
            into[..., 1 << level :] = np.cumsum(blocks[..., 1 << level :], axis=2)
        self.gain = _GainTable(n, correlation)

    def drift(self, first: Indices, last: Indices) -> tuple[Floats, Floats, Floats]:
        """Fit a parabola to the positions in many windows at once: mean speed, relative change of speed, and its error.
        Returns mean lead speed, m/s; relative change of speed from end to end; standard error of that. Each of shape:
        (n_windows,). Shapes: first, last (n_windows,).
        """
        # The level of a window is the highest bit in which its ends differ, and its middle is there.
        level = np.frexp((first ^ last).astype(float))[1] - 1
        s = (self.sums[level, :, first] + self.sums[level, :, last]).T
        half = (self.u[last] - self.u[first]) / 2
        middle = (self.u[first] + self.u[last]) / 2 - self.u[last >> level << level]
        # Moments about the middle of each window: Σ(u − m)ᵏ by repeated shifts, then in units of its half-width.
        shifted = []
        for row in (s[:5], s[5:]):
            terms = list(row)
            for order in range(1, len(terms)):
                for k in range(len(terms) - 1, order - 1, -1):
                    terms[k] = terms[k] - middle * terms[k - 1]
            shifted.append(terms)
        (count, s1, s2, s3, s4), (y0, y1, y2) = shifted
        s1, s2, s3, s4 = s1 / half, s2 / half**2, s3 / half**3, s4 / half**4
        y1, y2 = y1 / half, y2 / half**2
        # Normal equations of 1, w, w² with the constant eliminated.
        a11, a12, a22 = s2 - s1 * s1 / count, s3 - s1 * s2 / count, s4 - s2 * s2 / count
        b1, b2 = y1 - s1 * y0 / count, y2 - s2 * y0 / count
        determinant = a11 * a22 - a12**2
        slope = (a22 * b1 - a12 * b2) / determinant
        curve = (a11 * b2 - a12 * b1) / determinant
        mean = slope / (half * self.unit_s)
        with np.errstate(divide="ignore", invalid="ignore"):
            # Speed goes from (slope − 2 curve) to (slope + 2 curve).
            drift = 4 * curve / slope
            curve_sigma = self.noise_m * np.sqrt(a11 / determinant) * self.gain(last - first + 1)
            sigma = 4 * curve_sigma / np.abs(slope)
        return mean, drift, sigma


class _GainTable:
    """Ratio of the error of a window's curvature under AR(1) noise to that under white noise, by window length."""

    def __init__(self, n_longest: int, correlation: float) -> None:
        lengths = np.unique(np.rint(np.geomspace(3, max(n_longest, 4), 24)).astype(int))
        self.log_length = np.log(lengths)
        self.gain = np.array([self._gain(int(length), correlation) for length in lengths])

    @staticmethod
    def _gain(length: int, rho: float) -> float:
        u = np.linspace(-1, 1, length)
        weights = u**2 - np.mean(u**2)
        return _ar1_sd(weights, rho) / float(np.sqrt(np.sum(weights**2)))

    def __call__(self, length: Indices) -> Floats:
        return np.interp(np.log(length), self.log_length, self.gain)


def _ar1_sd(weights: Floats, rho: float) -> float:
    """Standard deviation of Σ w_i e_i for AR(1) noise e of unit variance."""
    return math.sqrt(max(float(weights @ correlated(weights, rho)), 0.0))


class RangeExtremes:
    """Largest value in any stretch of an array in constant time (sparse table: Bender and Farach-Colton 2000)."""

    def __init__(self, values: Floats) -> None:
        rows = [np.asarray(values, dtype=float)]
        span = 1
        while 2 * span <= rows[0].size:
            previous = rows[-1]
            row = np.full_like(previous, -np.inf)
            row[: previous.size - span] = np.maximum(previous[: previous.size - span], previous[span:])
            rows.append(row)
            span *= 2
        self.table = np.array(rows)

    def maximum(self, first: Indices, last: Indices) -> Floats:
        """Return the maximum over ranges of points. Shapes: first, last (n_ranges,) → (n_ranges,)."""
        level = np.frexp((last - first + 1).astype(float))[1] - 1
        return np.maximum(self.table[level, first], self.table[level, last - (1 << level) + 1])


def chord_bounds(time_s: Floats, position_m: Floats, noise_m: float, rho: float, sigmas: float) -> list[Bounds]:
    """Return functions for the highest lower and lowest upper limit of chord speeds in a window, by length of chord.
    Chords span 1, 2, 4 … frames of the raw positions; the speed of one has the error σ√(2(1 − ρ^k))/Δt. Nothing is
    smoothed, so a window may extend right up to the start-up or the end of growth without being affected by them.
    Shapes: time_s, position_m (n,).
    """
    bounds: list[Bounds] = []
    span = 1
    while span <= max(1, (time_s.size - 1) // 2):
        gap_s = time_s[span:] - time_s[:-span]
        speed = (position_m[span:] - position_m[:-span]) / gap_s
        error = sigmas * noise_m * math.sqrt(2 * (1 - rho**span)) / gap_s
        bounds.append(_bounds_of(RangeExtremes(speed - error), RangeExtremes(-(speed + error)), span))
        span *= 2
    return bounds


def _bounds_of(low: RangeExtremes, high: RangeExtremes, span: int) -> Bounds:
    def bounds(first: Indices, last: Indices) -> tuple[Floats, Floats]:
        fits = last - first >= span
        stop = np.where(fits, last - span, first)
        stop = np.minimum(stop, low.table.shape[1] - 1)
        start = np.minimum(first, stop)
        return (
            np.where(fits, low.maximum(start, stop), -np.inf),
            np.where(fits, -high.maximum(start, stop), np.inf),
        )

    return bounds


@dataclass(frozen=True)
class LineFit:
    """Legendre polynomials fitted to the raw positions of one window: speed, its change, and the cubic term. Lead
    speeds, m/s. `drift` is the relative change of speed across the window; `bend_m_s` is the mean speed of the cubic
    minus that of the straight line, `bend_sigma_m_s` its standard error.
    """

    speed_m_s: float
    speed_sigma_m_s: float
    drift: float
    drift_sigma: float
    bend_m_s: float
    bend_sigma_m_s: float

    @property
    def drift_95(self) -> tuple[float, float]:
        """95 % interval of the drift."""
        return self.drift - 1.96 * self.drift_sigma, self.drift + 1.96 * self.drift_sigma


def fit_window(time_s: Floats, position_m: Floats, noise_m: float, rho: float) -> LineFit:
    """Fit the raw positions of one window of at least three points by least squares, with errors for AR(1) noise. Where
    the points scatter about their cubic significantly more than `noise_m`, the errors are those of the scatter. Shapes:
    time_s, position_m (n,).
    """
    n = time_s.size
    half = float(time_s[-1] - time_s[0]) / 2
    u = (time_s - (time_s[0] + time_s[-1]) / 2) / half
    order = min(3, n - 1)
    y = position_m - position_m.mean()
    # Row k has the weights of the highest coefficient of a fit of order k: line, parabola, cubic.
    rows = [np.linalg.pinv(np.polynomial.legendre.legvander(u, k))[k] for k in range(1, order + 1)]
    residual = y - np.polynomial.legendre.legval(u, np.polynomial.legendre.legfit(u, y, order))
    noise_m = _local_noise(residual, noise_m, rho, order + 1)
    slope, curve = float(rows[0] @ y), float(rows[1] @ y)
    errors = [noise_m * _ar1_sd(row, rho) for row in rows]
    bend, bend_sigma = (float(rows[2] @ y), errors[2]) if order == 3 else (0.0, 0.0)
    is_moving = slope != 0
    return LineFit(
        speed_m_s=slope / half,
        speed_sigma_m_s=errors[0] / half,
        drift=6 * curve / slope if is_moving else math.nan,  # d(c₂P₂)/du runs from −3c₂ to 3c₂
        drift_sigma=6 * errors[1] / abs(slope) if is_moving else math.nan,
        bend_m_s=bend / half,
        bend_sigma_m_s=bend_sigma / half,
    )


def _local_noise(residual: Floats, noise_m: float, rho: float, terms: int) -> float:
    """The track's noise, or the scatter in this window where it is larger by more than three standard errors."""
    n = residual.size
    effective = n * (1 - rho**2) / (1 + rho**2) - terms
    if effective < 2:
        return noise_m
    scatter = float(np.sum(residual**2)) / (n - terms)
    return math.sqrt(scatter) if scatter > noise_m**2 * (1 + 3 * math.sqrt(2 / effective)) else noise_m


def judge(time_s: Floats, position_m: Floats, kinematics: Kinematics, first: int, last: int, rule: str) -> Window:
    """Measure speed, its standard error, drift and variation in a window; the rule decides about acceptance. The
    standard error of x_ss includes the noise and, where the speed is curved within the window, the difference of the
    mean speeds of a cubic and of the line. Shapes: time_s, position_m (n,).
    """
    inside = slice(first, last + 1)
    t = time_s[inside]
    fit = fit_window(t, position_m[inside], kinematics.noise_m, kinematics.noise_correlation)
    bend = math.sqrt(max(fit.bend_m_s**2 - fit.bend_sigma_m_s**2, 0.0))
    velocity = kinematics.lead_velocity_m_s[inside]
    return Window(
        rule=rule,
        accepted=False,
        reason="",
        from_s=float(t[0]),
        to_s=float(t[-1]),
        n_points=t.size,
        x_ss_m_s=kinematics.travel_ratio * fit.speed_m_s,
        x_ss_sigma_m_s=kinematics.travel_ratio * math.hypot(fit.speed_sigma_m_s, bend),
        drift=fit.drift,
        drift_95=fit.drift_95,
        cv=float(velocity.std(ddof=1) / abs(velocity.mean())) if velocity.mean() != 0 else math.nan,
    )


def trim(
    time_s: Floats, position_m: Floats, kinematics: Kinematics, window: tuple[int, int], band: float, drift_limit: float
) -> tuple[int, int]:
    """Trim the ends of a steady window that deviate from its speed line. The first and last 1, 2, 4 … frames must move
    within `band` (a fraction of the mean speed) plus `TRIM_SIGMAS` standard errors of the speed that the window's
    parabola has there. Returns first and last point of the trimmed window, both included. Shapes: time_s, position_m
    (n,).
    """
    first, last = window
    while last - first >= 4:
        move_first, move_last = _points_to_trim(time_s, position_m, kinematics, first, last, band)
        if not (move_first or move_last):
            break
        first_now, last_now = first + move_first, last - move_last
        if last_now - first_now < 3:
            break
        fit = fit_window(
            time_s[first_now : last_now + 1],
            position_m[first_now : last_now + 1],
            kinematics.noise_m,
            kinematics.noise_correlation,
        )
        if max(abs(bound) for bound in fit.drift_95) > drift_limit:
            break
        first, last = first_now, last_now
    return first, last


TRIM_SIGMAS = 2.5  # Standard errors by which an end of a window must deviate from its speed line to be trimmed


def _points_to_trim(
    time_s: Floats, position_m: Floats, kinematics: Kinematics, first: int, last: int, band: float
) -> tuple[int, int]:
    """Number of points to trim from the beginning and the end: none where the ends follow the parabola."""
    t, y = time_s[first : last + 1], position_m[first : last + 1]
    noise_m, rho = kinematics.noise_m, kinematics.noise_correlation
    fit = fit_window(t, y, noise_m, rho)
    middle, length = (t[0] + t[-1]) / 2, t[-1] - t[0]
    cuts = [0, 0]
    span = 1
    while span <= max(1, (t.size - 1) // 4):
        for end, (i, j) in enumerate(((0, span), (t.size - 1 - span, t.size - 1))):
            gap_s = t[j] - t[i]
            expected = fit.speed_m_s * (1 + fit.drift * ((t[i] + t[j]) / 2 - middle) / length)
            error = noise_m * math.sqrt(2 * (1 - rho**span)) / gap_s
            if abs((y[j] - y[i]) / gap_s - expected) > band * abs(fit.speed_m_s) + TRIM_SIGMAS * error:
                cuts[end] = max(cuts[end], (span + 1) // 2)
        span *= 2
    return cuts[0], cuts[1]
