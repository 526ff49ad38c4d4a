"""Velocity of the leading edge by Savitzky–Golay smoothing with a window chosen for each point.

Around every point a cubic is fitted to windows of increasing width, centred or to one side. Windows in which the cubic
does not fit the points (release, end of growth) are excluded. Of the centred windows the widest is kept whose velocity
agrees with all narrower ones (Lepski 1991, Theory Probab. Appl. 35:454); of all windows that agree with it, the one
with the smallest standard error is used: wide windows on plateaus, narrow or one-sided ones at the release. Position,
velocity and acceleration always come from the same fit.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from vinetrack.core.records import Floats, Indices, Kinematics, Track
from vinetrack.tracks.position_noise import correlated, position_noise

# ------------------------------------------------------------------------------
# Local polynomials fitted to all windows of one width along a track at once.
#
# For even spacing the fit is a convolution (Savitzky and Golay 1964, Anal. Chem. 36:1627); windows with a gap or
# uneven spacing are fitted individually by least squares of the same order.


@dataclass(frozen=True)
class WindowFits:
    """Polynomials fitted to all m = n − width + 1 windows of `width` points, in powers of u = (t − middle)/half.
    `coefficients` (order + 1, m), their `covariance` (order + 1, order + 1, m) for noise of 1 m; `middle_s`, `half_s`
    (m,).
    """

    width: int
    coefficients: Floats
    middle_s: Floats
    half_s: Floats
    covariance: Floats
    misfit: Floats
    misfit_terms: int

    def at(self, time_s: Floats, window: Indices) -> tuple[Floats, Floats]:
        """Evaluate the polynomials of given windows at given times. Returns position, velocity, acceleration, shape (3,
        k), SI; standard error of the velocity for noise of 1 m, shape (k,),: 1/s. Shapes: time_s, window (k,).
        """
        half = self.half_s[window]
        u = (time_s - self.middle_s[window]) / half
        # Powers of u and their first and second derivatives, each (terms, k)
        k = np.arange(self.coefficients.shape[0])[:, None]
        value = u**k
        slope, curve = np.zeros_like(value), np.zeros_like(value)
        slope[1:] = k[1:] * value[:-1]
        curve[2:] = k[2:] * (k[2:] - 1) * value[:-2]
        c = self.coefficients[:, window]
        values = np.array([(c * value).sum(axis=0), (c * slope).sum(axis=0) / half, (c * curve).sum(axis=0) / half**2])
        variance = np.einsum("ik,ijk,jk->k", slope, self.covariance[:, :, window], slope)
        return values, np.sqrt(np.maximum(variance, 0.0)) / half

    def velocities(self, time_s: Floats, side: float) -> tuple[Indices, Floats, Floats]:
        """Evaluate the velocity at every point, from the window in which the point has a given position. Returns number
        of the window, velocity, m/s, and its standard error for noise of 1 m, 1/s; each of shape (n,).
        """
        offset = round((1 + side) / 2 * (self.width - 1))
        window = np.clip(np.arange(time_s.size) - offset, 0, self.coefficients.shape[1] - 1)
        values, gain = self.at(time_s, window)
        return window, values[1], gain


def fit_all_windows(time_s: Floats, position_m: Floats, width: int, order: int, rho: float) -> WindowFits:
    """Fit a polynomial to every window of `width` consecutive points. Shapes: time_s, position_m (n,)."""
    m = time_s.size - width + 1
    last = np.arange(m) + width - 1
    middle, half = (time_s[:m] + time_s[last]) / 2, (time_s[last] - time_s[:m]) / 2
    weights, even_covariance, terms = _scaled(*_even_design(width, order), order, rho)
    covariance = np.repeat(even_covariance[0][:, :, None], m, axis=2)
    results = np.array([np.convolve(position_m, row[::-1], mode="valid") for row in weights[0]])
    # Odd windows contain a spacing different from the median, by more than 1 % (chosen).
    spacing = np.diff(time_s)
    uneven = np.concatenate([[0], np.cumsum(np.abs(spacing / np.median(spacing) - 1) > 0.01)])
    odd = uneven[width - 1 :] > uneven[: uneven.size - width + 1]
    if odd.any():
        take = np.flatnonzero(odd)[:, None] + np.arange(width)
        u = (time_s[take] - middle[odd, None]) / half[odd, None]
        uneven_weights, uneven_covariance, _ = _scaled(*_solve_design(u, order), order, rho)
        results[:, odd] = np.einsum("mkw,mw->km", uneven_weights, position_m[take])
        covariance[:, :, odd] = uneven_covariance.transpose(1, 2, 0)
    misfit = np.sum(results[order + 1 :] ** 2, axis=0)
    return WindowFits(width, results[: order + 1], middle, half, covariance, misfit, terms)


def _scaled(weights: Floats, terms: int, order: int, rho: float) -> tuple[Floats, Floats, int]:
    """Weights with the misfits scaled to unit variance, and the covariance of the coefficients, under AR(1) noise."""
    coefficients, extra = weights[:, : order + 1], weights[:, order + 1 :]
    covariance = correlated(coefficients, rho) @ coefficients.transpose(0, 2, 1)
    spread = np.sqrt(np.sum(correlated(extra, rho) * extra, axis=2, keepdims=True))
    return np.concatenate([coefficients, extra / np.maximum(spread, 1e-12)], axis=1), covariance, terms


@lru_cache(maxsize=64)
def _even_design(width: int, order: int) -> tuple[Floats, int]:
    """The design shared by all evenly spaced windows of a width."""
    return _solve_design(np.linspace(-1, 1, width)[None, :], order)


def _solve_design(u: Floats, order: int) -> tuple[Floats, int]:
    """Weights of the coefficients and of the next orthonormal polynomials, (s, order + 1 + terms, w), and terms."""
    # 4: orthogonal polynomials of the next higher orders that are tested in the residuals (chosen)
    terms = min(4, u.shape[1] - order - 1)
    q, _ = np.linalg.qr(np.polynomial.legendre.legvander(u, order + terms))
    q = q.transpose(0, 2, 1)
    inside = q[:, : order + 1]
    coefficients = np.linalg.solve(inside @ (u[:, :, None] ** np.arange(order + 1)), inside)
    return np.concatenate([coefficients, q[:, order + 1 :]], axis=1), terms


WINDOWS = (5, 7, 9, 13, 19, 27, 39, 57, 83, 119, 171, 247)  # Widths of windows, in points (chosen)


def estimate_kinematics(track: Track, *, travel_ratio: float, order: int = 3, kappa: float = 3.0) -> Kinematics:
    """Estimate position, velocity and acceleration of the leading edge at the usable points of a track, two or more,
    whose times increase.
    """
    usable = track.usable
    time_s, position_m = track.time_s[usable], track.lead_position_m[usable]
    noise_m, rho = position_noise(time_s, position_m)
    origin_m = float(position_m[0])
    values, sigma, widths = smooth(time_s, position_m - origin_m, noise_m, rho, order=order, kappa=kappa)
    return Kinematics(
        time_s=time_s,
        lead_position_m=values[0] + origin_m,
        lead_velocity_m_s=values[1],
        lead_velocity_sigma_m_s=sigma,
        lead_acceleration_m_s2=values[2],
        window_points=widths,
        noise_m=noise_m,
        noise_correlation=rho,
        travel_ratio=travel_ratio,
    )


def smooth(
    time_s: Floats, position_m: Floats, noise_m: float, rho: float, *, order: int = 3, kappa: float = 3.0
) -> tuple[Floats, Floats, Indices]:
    """Estimate position, velocity and acceleration at every point for known noise. A window is used only if the next
    wider one at the same position agrees too: the widest that agrees is about to disagree, and its bias may be several
    times its error. Each step in width changes their ratio by 1.45^5.5 = 8. Returns position, velocity and
    acceleration, (3, n), SI; standard error of the velocity, m/s, and points in the window used, (n,) each.
    """
    n = time_s.size
    least = min(n, max(WINDOWS[0], order + 2))
    widths = [least, *(width for width in WINDOWS if least < width <= n)]
    fits = [fit_all_windows(time_s, position_m, width, min(order, width - 1), rho) for width in widths]
    # Largest misfit of a window that fits its points, by number of terms (derived)
    limits = (np.inf, 12.0, 15.3, 18.0, 20.5)
    fits_points = [fit.misfit <= noise_m**2 * limits[fit.misfit_terms] for fit in fits]
    centred = [fit.velocities(time_s, 0.0) for fit in fits]
    # Range of velocities on which the centred windows agree, from the narrowest up, and the least error; unbounded
    # where not even the narrowest window fits its points: then one-sided windows decide.
    low, high, centred_error = np.full(n, -np.inf), np.full(n, np.inf), np.zeros(n)
    all_agree = np.ones(n, dtype=bool)
    for (window, velocity, gain), good in zip(centred, fits_points, strict=True):
        half_width = kappa * noise_m * gain
        lower, upper = np.maximum(low, velocity - half_width), np.minimum(high, velocity + half_width)
        all_agree &= good[window] & (lower <= upper)
        low, high = np.where(all_agree, lower, low), np.where(all_agree, upper, high)
        centred_error = np.where(all_agree, noise_m * gain, centred_error)
    # The narrowest window is used where no wider one is; its error is that of the noise, or of its misfit if larger.
    window_used, _, gain = centred[0]
    window_used, good = window_used.copy(), fits_points[0][window_used]
    # 2.5: factor on the misfit, taken as noise, for the error of the velocity where no window fits (derived)
    sigma = np.where(good, noise_m, np.maximum(noise_m, 2.5 * np.sqrt(fits[0].misfit[window_used]))) * gain
    best = np.where(good, sigma, np.inf)
    fit_used = np.zeros(n, dtype=int)
    for side in (0.0, -0.5, 0.5, -1.0, 1.0):  # positions of the point in its window (chosen)
        wider_agrees = np.full(n, len(fits) == 1)
        for k in reversed(range(len(fits))):
            window, velocity, gain = centred[k] if side == 0 else fits[k].velocities(time_s, side)
            error = noise_m * gain
            tolerance = kappa * error
            agrees = fits_points[k][window] & (velocity >= low - tolerance) & (velocity <= high + tolerance)
            better = agrees & wider_agrees & (error < (1 - 1e-6) * best)  # rounding must not decide between sides
            wider_agrees = agrees
            fit_used[better], window_used[better] = k, window[better]
            sigma[better] = best[better] = error[better]
    values = np.empty((3, n))
    for k, fit in enumerate(fits):
        points = np.flatnonzero(fit_used == k)
        values[:, points] = fit.at(time_s[points], window_used[points])[0]
    # 0.5: least standard error of a one-sided window, relative to that of the centred ones (chosen)
    return values, np.maximum(sigma, 0.5 * centred_error), np.array(widths)[fit_used]
