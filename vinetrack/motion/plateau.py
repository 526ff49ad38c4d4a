"""Arithmetic of steady windows: least squares over any stretch of raw positions, with noise that remembers itself."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from vinetrack.records import Floats, Kinematics, Window

Indices = NDArray[np.int_]
Bounds = Callable[[Indices, Indices], tuple[Floats, Floats]]


class WindowMoments:
    """Quadratic fits to the raw positions of any window in constant time, from cumulative sums.

    Sums are kept in extended precision: those of short windows late in a long track are small differences of large
    numbers.
    """

    def __init__(self, time_s: Floats, position_m: Floats, noise_m: float, correlation: float) -> None:
        n = time_s.size
        self.noise_m, self.correlation = noise_m, correlation
        self.unit_s = max(float(time_s[-1] - time_s[0]), np.finfo(float).tiny) / 2
        self.u = ((time_s - (time_s[0] + time_s[-1]) / 2) / self.unit_s).astype(np.longdouble)
        y = (position_m - position_m.mean()).astype(np.longdouble)
        powers = np.array([self.u**k for k in range(5)] + [y * self.u**k for k in range(3)])
        self.sums = np.concatenate([np.zeros((8, 1), dtype=np.longdouble), np.cumsum(powers, axis=1)], axis=1)
        self.gain = _GainTable(n, correlation)

    def drift(self, first: Indices, last: Indices) -> tuple[Floats, Floats, Floats]:
        """Mean lead speed, relative change of speed across, and standard error of that, for windows [first, last]."""
        s = self.sums[:, last + 1] - self.sums[:, first]
        middle = (self.u[first] + self.u[last]) / 2
        half = (self.u[last] - self.u[first]) / 2
        count = s[0]
        # Shift the moments to the middle of each window, in units of its half-width.
        s1 = (s[1] - middle * s[0]) / half
        s2 = (s[2] - 2 * middle * s[1] + middle**2 * s[0]) / half**2
        s3 = (s[3] - 3 * middle * s[2] + 3 * middle**2 * s[1] - middle**3 * s[0]) / half**3
        s4 = (
            s[4] - 4 * middle * s[3] + 6 * middle**2 * s[2] - 4 * middle**3 * s[1] + middle**4 * s[0]
        ) / half**4
        y0 = s[5]
        y1 = (s[6] - middle * s[5]) / half
        y2 = (s[7] - 2 * middle * s[6] + middle**2 * s[5]) / half**2
        # Normal equations of 1, w, w² with the constant eliminated.
        a11, a12, a22 = s2 - s1 * s1 / count, s3 - s1 * s2 / count, s4 - s2 * s2 / count
        b1, b2 = y1 - s1 * y0 / count, y2 - s2 * y0 / count
        determinant = a11 * a22 - a12**2
        slope = (a22 * b1 - a12 * b2) / determinant
        curve = (a11 * b2 - a12 * b1) / determinant
        unit = (half * self.unit_s).astype(float)
        mean = slope.astype(float) / unit
        with np.errstate(divide="ignore", invalid="ignore"):
            # Speed goes from (slope − 2 curve) to (slope + 2 curve).
            drift = (4 * curve / slope).astype(float)
            curve_sigma = self.noise_m * np.sqrt((a11 / determinant).astype(float)) * self.gain(last - first + 1)
            sigma = 4 * curve_sigma / np.abs(slope.astype(float))
        return mean, drift, sigma


class _GainTable:
    """How much AR(1) noise enlarges the error of a window's curvature over white noise, by window length."""

    def __init__(self, n_longest: int, correlation: float) -> None:
        lengths = np.unique(np.rint(np.geomspace(3, max(n_longest, 4), 24)).astype(int))
        self.log_length = np.log(lengths)
        self.gain = np.array([self._one(int(length), correlation) for length in lengths])

    @staticmethod
    def _one(length: int, rho: float) -> float:
        u = np.linspace(-1, 1, length)
        weights = u**2 - np.mean(u**2)
        return ar1_sd(weights, rho) / float(np.sqrt(np.sum(weights**2)))

    def __call__(self, length: Indices) -> Floats:
        return np.interp(np.log(length), self.log_length, self.gain)


def ar1_sd(weights: Floats, rho: float) -> float:
    """Standard deviation of Σ w_i e_i for AR(1) noise e of unit variance: Σw² + 2 Σ_i w_i Σ_{j<i} ρ^{i−j} w_j."""
    from scipy.signal import lfilter

    if rho == 0:
        return float(np.sqrt(np.sum(weights**2)))
    before = lfilter([0.0, rho], [1.0, -rho], weights)
    return math.sqrt(max(float(np.sum(weights**2) + 2 * np.sum(weights * before)), 0.0))


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
        """Maximum over [first, last], both included."""
        level = np.frexp((last - first + 1).astype(float))[1] - 1
        return np.maximum(self.table[level, first], self.table[level, last - (1 << level) + 1])


def chord_bounds(time_s: Floats, position_m: Floats, noise_m: float, rho: float, sigmas: float) -> list[Bounds]:
    """For chords of 1, 2, 4 … frames of the raw positions: the highest lower and lowest upper limit in a window.

    A chord's speed has the error σ√(2(1 − ρ^k))/Δt. Nothing is smoothed, so that a window may reach right up to the
    start-up or the end of growth without either leaking into it.
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


def judge(time_s: Floats, position_m: Floats, kinematics: Kinematics, first: int, last: int, rule: str) -> Window:
    """Speed, error, drift and variation of one window, by least squares on its raw positions.

    The error of x_ss is that of a straight line's slope under AR(1) noise; where the points scatter about their
    parabola clearly more than the track's noise says, by that scatter.
    """
    t, y = time_s[first : last + 1], position_m[first : last + 1]
    n = t.size
    middle, half = (t[0] + t[-1]) / 2, (t[-1] - t[0]) / 2
    u = (t - middle) / half
    centred = u - u.mean()
    slope_weights = centred / np.sum(centred**2)
    square = u**2 - np.mean(u**2)
    square = square - centred * (square @ centred) / np.sum(centred**2)
    curve_weights = square / np.sum(square**2)
    y = y - y.mean()
    slope, curve = float(slope_weights @ y), float(curve_weights @ y)
    rho = kinematics.noise_correlation
    noise_m = _local_noise(y - slope * centred - curve * square, kinematics.noise_m, rho)
    lead_speed = slope / half
    sigma = noise_m * ar1_sd(slope_weights, rho) / half
    drift, drift_sigma = math.nan, math.nan
    if slope != 0:
        drift = 4 * curve / slope
        drift_sigma = 4 * noise_m * ar1_sd(curve_weights, rho) / abs(slope)
    velocity = kinematics.lead_velocity_m_s[first : last + 1]
    return Window(
        rule=rule,
        accepted=False,
        reason="",
        from_s=float(t[0]),
        to_s=float(t[-1]),
        n_points=n,
        x_ss_m_s=kinematics.travel_ratio * lead_speed,
        x_ss_sigma_m_s=kinematics.travel_ratio * sigma,
        drift=drift,
        drift_95=(drift - 1.96 * drift_sigma, drift + 1.96 * drift_sigma),
        cv=float(velocity.std(ddof=1) / abs(velocity.mean())) if velocity.mean() != 0 else math.nan,
    )


def _local_noise(residual: Floats, noise_m: float, rho: float) -> float:
    """The track's noise, or the scatter in this window where that is clearly larger (three standard errors)."""
    n = residual.size
    effective = n * (1 - rho**2) / (1 + rho**2) - 3
    if effective < 2:
        return noise_m
    scatter = float(np.sum(residual**2)) / (n - 3)
    return math.sqrt(scatter) if scatter > noise_m**2 * (1 + 3 * math.sqrt(2 / effective)) else noise_m
