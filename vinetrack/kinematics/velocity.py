"""Velocity of the leading edge by Savitzky–Golay smoothing with a window chosen for each point.

Around every point a cubic is fitted to windows of increasing width, centred or to one side. Windows in which the cubic
does not fit the points (release, end of growth) are excluded. Of the centred windows the widest is kept whose velocity
agrees with all narrower ones (Lepski 1991, Theory Probab. Appl. 35:454); of all windows that agree with it, the one
with the smallest standard error is used: wide windows on plateaus, narrow or one-sided ones at the release. Position,
velocity and acceleration always come from the same fit.
"""

from __future__ import annotations

import numpy as np

from vinetrack.core.records import Bools, Floats, Indices, Kinematics, Track
from vinetrack.kinematics.windows import WindowFits, fit_all_windows
from vinetrack.tracks.position_noise import track_noise

WINDOWS = (5, 7, 9, 13, 19, 27, 39, 57, 83, 119, 171, 247)  # Widths of windows, in points (chosen)

SIDES = (0.0, -0.5, 0.5, -1.0, 1.0)  # Positions of the point in its window (chosen)

# Largest misfit of a window that fits its points, by number of terms (derived)
MISFIT_LIMITS = {0: np.inf, 1: 12.0, 2: 15.3, 3: 18.0, 4: 20.5}

KINK_GAIN = 2.5  # Factor on the misfit, taken as noise, for the error of the velocity where no window fits (derived)

TRUSTED_GAIN = 0.5  # Least standard error of a one-sided window, relative to that of the centred ones (chosen)


# Window, velocity and error for unit noise at every point, of centred windows of one width
Centred = tuple[Indices, Floats, Floats]


def estimate_kinematics(track: Track, *, travel_ratio: float, order: int = 3, kappa: float = 3.0) -> Kinematics:
    """Estimate position, velocity and acceleration of the leading edge at the usable points of a track."""
    usable = track.usable
    time_s, position_m = track.time_s[usable], track.lead_position_m[usable]
    if time_s.size < 2:
        raise ValueError(f"the track has {time_s.size} usable points; a velocity needs at least 2")
    if np.any(np.diff(time_s) <= 0):
        raise ValueError("the times of the track do not increase; sort its rows or drop repeated ones")
    noise_m, rho = track_noise(track)
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
    acceleration, shape (3, n), SI; standard error of the velocity, shape (n,), m/s; points in: the window used, shape
    (n,). Shapes: time_s, position_m (n,).
    """
    n = time_s.size
    least = min(n, max(WINDOWS[0], order + 2))
    widths = [least, *(width for width in WINDOWS if least < width <= n)]
    fits = [fit_all_windows(time_s, position_m, width, min(order, width - 1), rho) for width in widths]
    fits_points = [fit.misfit <= noise_m**2 * MISFIT_LIMITS[fit.misfit_terms] for fit in fits]
    centred = [fit.velocities(time_s, 0.0) for fit in fits]
    low, high, centred_error = _agreement(centred, fits_points, noise_m, kappa)
    best, window_used, sigma = _narrowest(fits[0], centred[0], fits_points[0], noise_m)
    fit_used = np.zeros(n, dtype=int)
    for side in SIDES:
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
    return values, np.maximum(sigma, TRUSTED_GAIN * centred_error), np.array(widths)[fit_used]


def _narrowest(fit: WindowFits, centred: Centred, fits_points: Bools, noise_m: float) -> tuple[Floats, Indices, Floats]:
    """The narrowest window, used where no wider one is; its error is that of the noise, or of its misfit if larger."""
    window, _, gain = centred
    good = fits_points[window]
    sigma = np.where(good, noise_m, np.maximum(noise_m, KINK_GAIN * np.sqrt(fit.misfit[window]))) * gain
    return np.where(good, sigma, np.inf), window.copy(), sigma


def _agreement(
    centred: list[Centred], fits_points: list[Bools], noise_m: float, kappa: float
) -> tuple[Floats, Floats, Floats]:
    """Range of velocities on which the centred windows agree, from the narrowest up, and the least error; (n,) each.
    Unbounded where not even the narrowest window fits its points: then one-sided windows decide.
    """
    n = centred[0][0].size
    low, high = np.full(n, -np.inf), np.full(n, np.inf)
    least_error = np.zeros(n)
    all_agree = np.ones(n, dtype=bool)
    for (window, velocity, gain), good in zip(centred, fits_points, strict=True):
        half_width = kappa * noise_m * gain
        lower, upper = np.maximum(low, velocity - half_width), np.minimum(high, velocity + half_width)
        all_agree &= good[window] & (lower <= upper)
        low, high = np.where(all_agree, lower, low), np.where(all_agree, upper, high)
        least_error = np.where(all_agree, noise_m * gain, least_error)
    return low, high, least_error
