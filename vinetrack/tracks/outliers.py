"""Outliers of a track: points far off the motion around them (a reflection, a lost edge, a slip of the hand).

Every point is compared with a cubic through its neighbours, itself left out. The cubic is fitted by iteratively
reweighted least squares, first for least absolute residuals, then with Tukey's biweight (Beaton & Tukey, Technometrics
16, 147, 1974), so that a second outlier nearby does not bend it. No model of the motion enters: what a model misses is
no reason to drop a point.

An outlier is isolated: the motion goes on through its neighbours as if it were not there. After a dropped frame all
later points are displaced together, and at a corner of the motion one side leaves the cubic; both leave too few
neighbours on one cubic, and nothing is rejected there.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats, Track, hand_corrected, join_flags
from vinetrack.tracks.position_noise import robust_position_noise

HALF_WIDTH = 6  # Neighbours on either side (chosen)

NOISE_HALF_WIDTH = 20  # Points on either side from whose residuals the local noise is estimated (chosen)

NOISE_DEGREES_OF_FREEDOM = 15.0  # Degrees of freedom of that local noise: 0.37 × 41 (derived)

FALSE_ALARM_RATE = 1e-3  # Probability that normal noise costs a track a single point (chosen)

LEAST_SHARE = 0.75  # Least share of the neighbours that must lie on the cubic (chosen)

NEAREST, FEWEST_NEAR = 4, 3  # Of this many nearest neighbours, so many must lie on the cubic too

BIWEIGHT_CUTOFF = 6.0  # Residual, in standard deviations of the noise, from which a neighbour has no weight (chosen)

# Within this many points of an end the motion may have stopped or begun between two frames (chosen)
END_POINTS, END_STEPS = 2, 1.5

# Distance to the point before, in steps of the motion, below which a point may be a repeated frame (chosen)
COPY_STEPS = 0.3

MOST_ROUNDS = 4  # Most rounds of rejection (measured)

FEWEST_POINTS = 2 * HALF_WIDTH + 1  # Fewest points of a window: the point and its neighbours (derived)

MOST_NAMED = 8  # Most points named in the sentence about a campaign; a track's notes name all of its own (chosen)

MOST_REJECTED = 0.1  # Largest share of points that may be rejected (chosen)


@dataclass(frozen=True)
class LocalFit:
    """Comparison of every point with the cubic through its neighbours; arrays of shape (n_points,)."""

    residual_m: Floats
    gain: Floats
    spread_m: Floats
    share: Floats
    near: NDArray[np.int_]
    speed_m_s: Floats


def local_fit(time_s: Floats, position_m: Floats, noise_m: float) -> LocalFit:
    """Compare every point with a robust cubic through its twelve nearest neighbours. Shapes: time_s, position_m
    (n_points,).
    """
    n = time_s.size
    begin = np.clip(np.arange(n) - HALF_WIDTH, 0, n - FEWEST_POINTS)
    places = begin[:, None] + np.arange(FEWEST_POINTS)
    # Each row holds the twelve others: the point itself is dropped.
    places = places[places != np.arange(n)[:, None]].reshape(n, -1)
    time_from_point = time_s[places] - time_s[:, None]
    width = np.abs(time_from_point).max(axis=1)
    relative_time = time_from_point / width[:, None]
    powers = np.ones((*relative_time.shape, 7))
    for power in range(1, 7):
        powers[..., power] = powers[..., power - 1] * relative_time
    y = position_m[places] - position_m[:, None]
    smallest_scale = np.maximum(noise_m, 1e-9 * np.ptp(position_m))
    weight = np.ones_like(y)
    for turn in range(10):
        coefficients = _normal_solution(_moments(powers, weight), _moments(powers[..., :4], weight * y))
        residuals = np.abs(y - _cubic(relative_time, coefficients))
        if turn < 6:  # least absolute residuals
            weight = 1 / np.maximum(residuals, 0.1 * smallest_scale)
        else:  # Tukey's biweight; the median of 12 residuals about 4 fitted numbers is 0.55 of their sd
            median = np.sort(residuals, axis=1)[:, HALF_WIDTH - 1 : HALF_WIDTH + 1].mean(axis=1)
            scale = np.maximum(median / 0.55, smallest_scale)
            weight = np.maximum(1 - (residuals / (BIWEIGHT_CUTOFF * scale[:, None])) ** 2, 0.0) ** 2 + 1e-9
    on_cubic = weight > 0.1
    used = np.maximum(on_cubic.sum(axis=1), 5)
    # The point itself lies at 0, where the cubic is its first coefficient.
    first_coefficient = np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
    leverage = weight * _cubic(relative_time, _normal_solution(_moments(powers, weight), first_coefficient))
    nearest = np.argsort(np.abs(time_from_point), axis=1, kind="stable")[:, :NEAREST]
    return LocalFit(
        residual_m=-coefficients[:, 0],
        gain=np.sqrt(1 + np.sum(leverage**2, axis=1)),
        spread_m=np.sqrt(np.sum(np.where(on_cubic, residuals, 0.0) ** 2, axis=1) / (used - 4)),
        share=on_cubic.mean(axis=1),
        near=np.take_along_axis(on_cubic, nearest, axis=1).sum(axis=1),
        speed_m_s=coefficients[:, 1] / width,
    )


def local_noise(distance_m: Floats, half_width: int = NOISE_HALF_WIDTH) -> Floats:
    """Estimate the standard deviation around each point by a running median, which is 0.6745 of it for normal noise.
    Shapes: distance_m (n_points,) → (n_points,).
    """
    width = min(2 * half_width + 1, distance_m.size)
    view = np.median(np.lib.stride_tricks.sliding_window_view(distance_m, width), axis=1) / 0.6745
    middle = np.clip(np.arange(distance_m.size) - width // 2, 0, view.size - 1)
    return np.asarray(view[middle])


def find_outliers(time_s: Floats, position_m: Floats, *, spare_copies: bool = False) -> NDArray[np.bool_]:
    """Mark the points that lie far off the motion around them. The largest deviations are rejected first, others only
    if they remain without those: an outlier spoils its neighbours. Shapes: time_s, position_m (n_points,) →
    (n_points,).
    """
    from scipy.stats import t

    n = time_s.size
    is_outlier = np.zeros(n, dtype=bool)
    if n < FEWEST_POINTS + MOST_ROUNDS or not np.all(np.diff(time_s) > 0):
        return is_outlier
    limit = float(t.isf(FALSE_ALARM_RATE / (2 * n), NOISE_DEGREES_OF_FREEDOM))
    for _ in range(MOST_ROUNDS):
        candidates = np.flatnonzero(~is_outlier)
        if candidates.size < FEWEST_POINTS:
            break
        outlying_kept = _outlying(time_s[candidates], position_m[candidates], limit, spare_copies)
        if not outlying_kept.any():
            break
        is_outlier[candidates[outlying_kept]] = True
    return is_outlier if np.mean(is_outlier) <= MOST_REJECTED else np.zeros(n, dtype=bool)


def reject_outliers(track: Track, *, spare_copies: bool = False) -> Track:
    """Flag the outliers of a track `rejected`, and name them in its notes; points corrected by hand stay."""
    rows = np.flatnonzero(track.usable)
    is_wild = find_outliers(track.time_s[rows], track.lead_position_m[rows], spare_copies=spare_copies)
    outlying = rows[is_wild]
    # A point that a person has placed or confirmed is right.
    outlying = outlying[~hand_corrected(track.flag[outlying])] if outlying.size else outlying
    if not outlying.size:
        return track
    flag = track.flag.astype("<U80")
    for row in outlying:
        flag[row] = join_flags(str(flag[row]), "rejected")
    rejected = replace(track, flag=flag)
    note = f"{_outliers_are_left_out(outlying.size)}: {', '.join(_places(rejected, outlying))}"
    return replace(rejected, notes=(*track.notes, note))


def rejected_points_note(tracks: Mapping[str, Track]) -> str:
    """Name the rejected points of tracks by trial in one sentence; blank where there are none."""
    places = [
        f"{name} at {place}"
        for name, track in tracks.items()
        for place in _places(track, np.flatnonzero(["rejected" in str(flag) for flag in track.flag]))
    ]
    if not places:
        return ""
    more = f" and {len(places) - MOST_NAMED} more" if len(places) > MOST_NAMED else ""
    return f"{_outliers_are_left_out(len(places))}: {', '.join(places[:MOST_NAMED])}{more}."


def _outliers_are_left_out(points: int) -> str:
    """The beginning of a sentence about rejected points."""
    if points == 1:
        return "1 point lies far off the motion around it and is left out"
    return f"{points} points lie far off the motion around them and are left out"


def _places(track: Track, outlying: NDArray[np.int_]) -> list[str]:
    """Time of every rejected point and its distance from the line between its usable neighbours, in words."""
    usable_rows = np.flatnonzero(track.usable)
    distance_m = track.lead_position_m[outlying] - np.interp(
        track.time_s[outlying], track.time_s[usable_rows], track.lead_position_m[usable_rows]
    )
    return [
        f"{track.time_s[row]:.5g} s ({1e3 * off:+.2g} mm)"
        for row, off in zip(outlying, distance_m, strict=True)
        if math.isfinite(off)
    ]


def _outlying(time_s: Floats, position_m: Floats, limit: float, spare_copies: bool) -> NDArray[np.bool_]:
    """Points beyond the limit whose neighbours follow one cubic without them."""
    noise_m, _ = robust_position_noise(time_s, position_m)
    fit = local_fit(time_s, position_m, noise_m)
    sigma_m = np.maximum(np.maximum(local_noise(np.abs(fit.residual_m) / fit.gain), noise_m), fit.spread_m)
    distance_m = np.abs(fit.residual_m)
    step_m = np.abs(fit.speed_m_s) * float(np.median(np.diff(time_s)))
    lags = fit.residual_m * fit.speed_m_s < 0
    from_end = np.where(lags, np.arange(distance_m.size)[::-1], np.arange(distance_m.size))
    allowance_m = np.where(from_end < END_POINTS, END_STEPS * (from_end + 1) * step_m, 0.0)
    isolated = (fit.share >= LEAST_SHARE) & (fit.near >= FEWEST_NEAR)
    if spare_copies:
        isolated[1:] &= np.abs(np.diff(position_m)) >= COPY_STEPS * step_m[1:]
    return np.asarray((distance_m > limit * fit.gain * sigma_m + allowance_m) & isolated & (sigma_m > 0))


def _moments(powers: Floats, weight: Floats) -> Floats:
    """Weighted sums of powers over each window, shape (n_windows, n_powers)."""
    return np.asarray(np.matmul(weight[:, None, :], powers)[:, 0])


def _cubic(away: Floats, coefficients: Floats) -> Floats:
    """The cubic of each window at its places, shape (n_windows, n_places)."""
    c0, c1, c2, c3 = (coefficients[:, k, None] for k in range(4))
    return np.asarray(c0 + away * (c1 + away * (c2 + away * c3)))


def _normal_solution(sums: Floats, right: Floats) -> Floats:
    """Coefficients, (n_windows, 4), of the normal equations with these sums of powers 0 to 6 and right sides. The
    system is scaled to a unit diagonal, with a ridge of 1e-10, and factored as L D Lᵀ in all windows at once.
    """
    scale = 1 / np.sqrt(sums[:, ::2])
    lower, pivots = np.empty((4, 4, len(sums))), np.empty((4, len(sums)))
    solution = (right * scale).T.copy()
    for u in range(4):
        for v in range(u):
            left = sums[:, u + v] * scale[:, u] * scale[:, v]
            for w in range(v):
                left = left - lower[u, w] * lower[v, w] * pivots[w]
            lower[u, v] = left / pivots[v]
        pivots[u] = 1 + 1e-10
        for v in range(u):
            pivots[u] -= lower[u, v] ** 2 * pivots[v]
            solution[u] -= lower[u, v] * solution[v]
    solution /= pivots
    for u in range(2, -1, -1):
        for v in range(u + 1, 4):
            solution[u] -= lower[v, u] * solution[v]
    return np.asarray(solution.T * scale)
