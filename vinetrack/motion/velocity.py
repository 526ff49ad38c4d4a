"""Velocity of the leading edge by Savitzky–Golay smoothing with a window chosen for each point.

At every point a cubic is fitted by least squares to windows of growing width (Savitzky and Golay 1964, Anal. Chem.
36:1627), and the widest window is kept whose velocity agrees with those of all narrower ones (Lepski 1991, Theory
Probab. Appl. 35:454; as intersecting confidence intervals: Goldenshluger and Nemirovski 1997, Math. Methods Stat. 6:135). Wide windows serve plateaus, narrow ones the
release. Position, velocity and acceleration always come from the same fit.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vinetrack.motion.noise import estimate_noise
from vinetrack.records import Floats, Kinematics, Track

WINDOWS = (5, 7, 9, 11, 15, 21, 29, 39, 53, 71, 95, 127, 171)
"""Widths tried, in points; each about 1.35 times the one before."""

EVEN_TOLERANCE = 0.01
"""Spacings within this fraction of their median count as even: printed times are rounded."""


def estimate_kinematics(track: Track, *, travel_ratio: float, order: int = 3, kappa: float = 3.0) -> Kinematics:
    """Position, velocity and acceleration of the leading edge at the usable points of a track.

    Parameters
    ----------
    track
        At least two usable points, in order of time.
    travel_ratio
        How many times faster the tail moves than the lead.
    order
        Order of the polynomial.
    kappa
        How many standard errors two windows may differ by and still agree.

    Returns
    -------
    Kinematics
        `lead_velocity_sigma_m_s` is the standard error that the noise of position, with its correlation, gives the
        velocity of the window chosen.

    Raises
    ------
    ValueError
        Fewer than two usable points, or times that do not increase.
    """
    usable = track.usable
    time_s, position_m = track.time_s[usable], track.lead_position_m[usable]
    if time_s.size < 2:
        raise ValueError(f"the track has {time_s.size} usable points; a velocity needs at least 2")
    if np.any(np.diff(time_s) <= 0):
        raise ValueError("the times of the track do not increase; sort its rows or drop repeated ones")
    noise_m, correlation = estimate_noise(track)
    origin_m = float(position_m[0])
    fits = fit_windows(time_s, position_m - origin_m, noise_m, correlation, order=order)
    widths = np.array([fit.width for fit in fits])
    chosen = choose_windows(
        np.array([fit.values[1] for fit in fits]), np.array([fit.velocity_sigma for fit in fits]), widths, kappa
    )
    points = np.arange(time_s.size)
    values = np.array([fit.values for fit in fits])[chosen, :, points]
    sigma = np.array([fit.velocity_sigma for fit in fits])[chosen, points]
    return Kinematics(
        time_s=time_s,
        lead_position_m=values[:, 0] + origin_m,
        lead_velocity_m_s=values[:, 1],
        lead_velocity_sigma_m_s=sigma,
        lead_acceleration_m_s2=values[:, 2],
        window_points=widths[chosen],
        noise_m=noise_m,
        noise_correlation=correlation,
        travel_ratio=travel_ratio,
    )


class WindowFit:
    """One width of window at every point: position, velocity and acceleration, and the error of velocity."""

    __slots__ = ("values", "velocity_sigma", "width")

    def __init__(self, width: int, values: Floats, velocity_sigma: Floats) -> None:
        self.width = width
        self.values = values
        self.velocity_sigma = velocity_sigma


def fit_windows(
    time_s: Floats, position_m: Floats, noise_m: float, correlation: float, *, order: int = 3
) -> list[WindowFit]:
    """Fit a polynomial of `order` around every point with every width that the track can hold, narrowest first."""
    n = time_s.size
    least = min(n, max(WINDOWS[0], order + 2))
    widths = [least] + [width for width in WINDOWS if least < width <= n]
    return [_fit_width(time_s, position_m, width, noise_m, correlation, min(order, width - 1)) for width in widths]


def choose_windows(velocity: Floats, sigma: Floats, widths: NDArray[np.int_], kappa: float) -> NDArray[np.int_]:
    """Index of the width to use at each point, shape (n,), from the velocities and errors of all, shape (k, n).

    The widest window whose interval v ± κσ shares a value with those of all narrower ones. A window may reach no
    further than its neighbours' do (half-widths change by at most one from point to point), for what stopped the
    neighbour lies within reach.
    """
    low = np.maximum.accumulate(velocity - kappa * sigma, axis=0)
    high = np.minimum.accumulate(velocity + kappa * sigma, axis=0)
    agrees = np.logical_and.accumulate(low <= high, axis=0)
    agrees[0] = True
    return agrees.sum(axis=0) - 1


def _fit_width(
    time_s: Floats, position_m: Floats, width: int, noise_m: float, correlation: float, order: int
) -> WindowFit:
    """Convolution where the spacing is even, least squares over the nearest points at ends and around gaps."""
    n = time_s.size
    half = width // 2
    values = np.empty((3, n))
    sigma = np.empty(n)
    spacing = np.diff(time_s)
    step_s = float(np.median(spacing))
    uneven = np.abs(spacing / step_s - 1) > EVEN_TOLERANCE
    first = np.clip(np.arange(n) - half, 0, n - width)
    crossed = np.concatenate([[0], np.cumsum(uneven)])
    special = (crossed[first + width - 1] > crossed[first]) | (np.arange(n) - half != first)
    if width % 2 == 1 and not special.all():
        values[:, half : n - half], sigma_even = _convolve(position_m, width, order, step_s, correlation)
        sigma[half : n - half] = noise_m * sigma_even
    else:
        special[:] = True
    if special.any():
        values[:, special], gain = _least_squares(time_s, position_m, special, first[special], width, order, correlation)
        sigma[special] = noise_m * gain
    return WindowFit(width, values, sigma)


def _convolve(
    position_m: Floats, width: int, order: int, step_s: float, correlation: float
) -> tuple[Floats, float]:
    """Savitzky–Golay at all points with a whole window: values, shape (3, n − width + 1), and velocity gain, 1/s."""
    from scipy.signal import savgol_coeffs

    weights = [savgol_coeffs(width, order, deriv=d, delta=step_s) if d <= order else np.zeros(width) for d in range(3)]
    values = np.array([np.convolve(position_m, w, mode="valid") for w in weights])
    return values, float(noise_gain(weights[1][None, :], correlation)[0])


def _least_squares(
    time_s: Floats,
    position_m: Floats,
    special: NDArray[np.bool_],
    first: NDArray[np.int_],
    width: int,
    order: int,
    correlation: float,
) -> tuple[Floats, Floats]:
    """Polynomials through `width` points from `first`, taken at the special points: values (3, m), gain (m,)."""
    take = first[:, None] + np.arange(width)
    offset = time_s[take] - time_s[special][:, None]
    scale = np.maximum(np.abs(offset).max(axis=1), np.finfo(float).tiny)
    u = offset / scale[:, None]
    middle = u.mean(axis=1, keepdims=True)
    # Powers of a centred time keep the normal equations well conditioned; the point itself is then at u = −middle.
    basis = (u - middle)[:, :, None] ** np.arange(order + 1)
    pseudo_inverse = np.linalg.solve(basis.transpose(0, 2, 1) @ basis, basis.transpose(0, 2, 1))
    at = -middle[:, 0]
    weights = np.zeros((3, *u.shape))
    for derivative in range(min(order, 2) + 1):
        for power in range(derivative, order + 1):
            factor = float(np.prod(np.arange(power - derivative + 1, power + 1)))
            row = (factor * at ** (power - derivative) / scale**derivative)[:, None]
            weights[derivative] += row * pseudo_inverse[:, power, :]
    values = np.einsum("dmw,mw->dm", weights, position_m[take])
    return values, noise_gain(weights[1], correlation)


def noise_gain(weights: Floats, correlation: float) -> Floats:
    """Standard deviation of Σ w_i e_i for unit AR(1) noise e: √(wᵀRw) with R_ij = ρ^|i−j|; `weights` (m, w)."""
    if correlation == 0:
        return np.sqrt(np.sum(weights**2, axis=1))
    lag = np.abs(np.subtract.outer(np.arange(weights.shape[1]), np.arange(weights.shape[1])))
    return np.sqrt(np.maximum(np.sum((weights @ correlation**lag) * weights, axis=1), 0.0))
