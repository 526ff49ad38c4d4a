"""Points far off the motion around them: a reflection, a lost edge, a slip of the hand.

Every point is compared with a cubic through its neighbours, itself left out. The cubic is fitted by iteratively
reweighted least squares, first for least absolute residuals, then with Tukey's biweight (Beaton & Tukey, Technometrics
16, 147, 1974), so that a second wild point near by does not bend it. No model of the motion enters: what a model misses
is no reason to drop a point.

A wild point is alone: the motion goes on through its neighbours as if it were not there. After a dropped frame all
later points are displaced together, at a corner of the motion one side leaves the cubic; both leave too few neighbours
on one cubic, and nothing is rejected there.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats, Track, hand_corrected, join_flags
from vinetrack.tracks.position_noise import robust_position_noise

HALF_WIDTH = 6
"""Neighbours on either side. Chosen: twelve leave eight degrees of freedom beside a cubic. With three on either side
two wild points among them outvote the rest; with twelve on either side a cubic no longer follows a release."""

SCALE_HALF_WIDTH = 20
"""Points on either side from whose residuals the local noise is taken. Chosen: 41 points tell it to 18 % (the median
of absolute values has 0.37 of the efficiency of the mean square), and noise that depends on speed changes little over
them."""

SCALE_FREEDOM = 15.0
"""Degrees of freedom of that local noise: 0.37 × 41. Derived."""

FALSE_ALARM = 1e-3
"""Chance that normal noise costs a track a single point. Chosen: one campaign of 24 trials in forty loses one, which
widens no interval; at a hundred times less the limit rises from 7.5 to 10.7 standard deviations for 500
points."""

LEAST_SHARE = 0.75
"""Part of the neighbours that must lie on the cubic. Chosen: nine of twelve, so that three of them may be wild too; at
a corner of the motion more than three lie on the other side of a point that is off the cubic."""

NEAREST, LEAST_NEAR = 4, 3
"""Of so many nearest neighbours so many must lie on the cubic too: just behind the end of growth nine points of the
motion can outvote the standstill that the point belongs to (measured: 5 of 160 tracks lost a point without this)."""

BIWEIGHT = 6.0
"""Residual, in standard deviations of the noise, from which a neighbour has no weight; 4.685 is Tukey's for 95 %
efficiency, wider since only points far off matter here."""

END_POINTS, END_STEPS = 2, 1.5
"""Within so many points of an end the motion may have stopped or begun between the frames: so many frames' steps for
each point from the end are then no sign of a wild one, behind the motion at the end of a track and ahead of it at the
beginning. Chosen: growth ends or begins within a frame, which displaces the last points by up to a step each. By
reasoning: without it the last point before a stop is rejected; at twice, wild points of three steps at the ends
stay."""

COPY_STEPS = 0.3
"""A point this close to the one before, in steps of the motion, may be a repeated frame: `frame_timing` judges it
first, and what it does not take for a copy is looked at again. Chosen as `STILL` there, a little wider. By reasoning:
at half, copies are rejected as wild before they are judged; at twice, wild points that happen to lie near the one
before are in the way while frames are judged."""

MOST_ROUNDS = 4
"""Rounds of rejection. Measured on three campaigns with 2 % of wild points: three rounds leave nothing to reject."""

FEWEST_POINTS = 2 * HALF_WIDTH + 1
"""The point and its neighbours."""

MOST_NAMED = 8
"""Points named in the sentence about a campaign; a track's notes name all of its own. Chosen: what fits on two
lines."""

MOST_REJECTED = 0.1
"""Where more of the points than this would be rejected the test does not describe the track, and none is. Chosen: five
times the densest that was tried."""


@dataclass(frozen=True)
class LocalFit:
    """Every point against the cubic through its neighbours. Arrays have shape (n_points,).

    `residual_m` is the point minus the cubic, `gain` its standard deviation for white noise of standard deviation 1;
    `spread_m` the root mean square of the neighbours about the cubic, `share` the part of them that lie on it,
    `near` how many of the nearest four do; `speed_m_s` is its slope.
    """

    residual_m: Floats
    gain: Floats
    spread_m: Floats
    share: Floats
    near: NDArray[np.int_]
    speed_m_s: Floats


def local_fit(time_s: Floats, position_m: Floats, noise_m: float) -> LocalFit:
    """Compare every point with a robust cubic through its twelve nearest neighbours.

    Parameters
    ----------
    time_s, position_m : shape (n_points,), s and m, finite, in order of time; at least `FEWEST_POINTS`.
    noise_m : standard deviation of a position; neighbours are never judged more strictly than by this.

    Returns
    -------
    residuals and what they are judged by, a value a point.
    """
    n = time_s.size
    begin = np.clip(np.arange(n) - HALF_WIDTH, 0, n - FEWEST_POINTS)
    places = begin[:, None] + np.arange(FEWEST_POINTS)
    # Each row holds the twelve others: the point itself is dropped.
    places = places[places != np.arange(n)[:, None]].reshape(n, -1)
    since = time_s[places] - time_s[:, None]
    width = np.abs(since).max(axis=1)
    away = since / width[:, None]
    powers = np.ones((*away.shape, 7))
    for power in range(1, 7):
        powers[..., power] = powers[..., power - 1] * away
    y = position_m[places] - position_m[:, None]
    least = np.maximum(noise_m, 1e-9 * np.ptp(position_m))
    weight = np.ones_like(y)
    for turn in range(10):
        coefficients = _solved(_sums(powers, weight), _sums(powers[..., :4], weight * y))
        left = np.abs(y - _cubic(away, coefficients))
        if turn < 6:
            weight = 1 / np.maximum(left, 0.1 * least)
        else:
            # The scale of a window is that of its better half; of 12 residuals about 4 numbers the median is 0.55 sd.
            scale = np.maximum(np.sort(left, axis=1)[:, HALF_WIDTH - 1 : HALF_WIDTH + 1].mean(axis=1) / 0.55, least)
            weight = np.maximum(1 - (left / (BIWEIGHT * scale[:, None])) ** 2, 0.0) ** 2 + 1e-9
    on = weight > 0.1
    used = np.maximum(on.sum(axis=1), 5)
    # The point itself lies at 0, where the cubic is its first coefficient.
    levers = weight * _cubic(away, _solved(_sums(powers, weight), np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))))
    nearest = np.argsort(np.abs(since), axis=1, kind="stable")[:, :NEAREST]
    return LocalFit(
        residual_m=-coefficients[:, 0],
        gain=np.sqrt(1 + np.sum(levers**2, axis=1)),
        spread_m=np.sqrt(np.sum(np.where(on, left, 0.0) ** 2, axis=1) / (used - 4)),
        share=on.mean(axis=1),
        near=np.take_along_axis(on, nearest, axis=1).sum(axis=1),
        speed_m_s=coefficients[:, 1] / width,
    )


def local_noise(distance_m: Floats, half_width: int = SCALE_HALF_WIDTH) -> Floats:
    """Estimate the standard deviation around each point by a running median, 0.6745 of it for normal noise.

    Parameters
    ----------
    distance_m : absolute residuals, shape (n_points,), m.
    half_width : points on either side.

    Returns
    -------
    standard deviation around each point, shape (n_points,), m.
    """
    width = min(2 * half_width + 1, distance_m.size)
    view = np.median(np.lib.stride_tricks.sliding_window_view(distance_m, width), axis=1) / 0.6745
    middle = np.clip(np.arange(distance_m.size) - width // 2, 0, view.size - 1)
    return np.asarray(view[middle])


def wild_points(time_s: Floats, position_m: Floats, *, spare_copies: bool = False) -> NDArray[np.bool_]:
    """Which points lie far off the motion around them, shape (n_points,).

    Parameters
    ----------
    time_s, position_m : arrays, shape (n_points,), s and m, finite, in order of time.
    spare_copies : leave points that lie where the one before does, as repeated frames do.

    Returns
    -------
    array
        The largest deviations first, and others only as they remain without those: a wild point spoils its neighbours.
    """
    from scipy.stats import t

    n = time_s.size
    wild = np.zeros(n, dtype=bool)
    if n < FEWEST_POINTS + MOST_ROUNDS or not np.all(np.diff(time_s) > 0):
        return wild
    limit = float(t.isf(FALSE_ALARM / (2 * n), SCALE_FREEDOM))
    for _ in range(MOST_ROUNDS):
        kept = np.flatnonzero(~wild)
        if kept.size < FEWEST_POINTS:
            break
        off = _far_off(time_s[kept], position_m[kept], limit, spare_copies)
        if not off.any():
            break
        wild[kept[off]] = True
    return wild if np.mean(wild) <= MOST_REJECTED else np.zeros(n, dtype=bool)


def reject_wild_points(track: Track, *, spare_copies: bool = False) -> Track:
    """Flag wild points of a track `rejected`, and name them in its notes; those corrected by hand stay.

    Parameters
    ----------
    track : a row for every frame; positions may be NaN.
    spare_copies : leave points that may be repeated frames, until these were judged.

    Returns
    -------
    a copy, or the track itself where no point is wild.
    """
    rows = np.flatnonzero(track.usable)
    is_wild = wild_points(track.time_s[rows], track.lead_position_m[rows], spare_copies=spare_copies)
    wild = rows[is_wild]
    # Where a person has looked, the person is right.
    wild = wild[~hand_corrected(track.flag[wild])] if wild.size else wild
    if not wild.size:
        return track
    flag = track.flag.astype("<U80")
    for row in wild:
        flag[row] = join_flags(str(flag[row]), "rejected")
    rejected = replace(track, flag=flag)
    note = f"{_count(wild.size)} far off the motion around and left out: {', '.join(_places(rejected, wild))}"
    return replace(rejected, notes=(*track.notes, note))


def rejected_points_note(tracks: Mapping[str, Track]) -> str:
    """A sentence that names the rejected points of tracks by trial; blank where there are none.

    Parameters
    ----------
    tracks : by name of trial, as `reject_wild_points` returns them.

    Returns
    -------
    the sentence, or blank.
    """
    places = [
        f"{name} at {place}"
        for name, track in tracks.items()
        for place in _places(track, np.flatnonzero(["rejected" in str(flag) for flag in track.flag]))
    ]
    if not places:
        return ""
    more = f" and {len(places) - MOST_NAMED} more" if len(places) > MOST_NAMED else ""
    return f"{_count(len(places))} far off the motion around and left out: {', '.join(places[:MOST_NAMED])}{more}."


def _count(points: int) -> str:
    return "1 point lies" if points == 1 else f"{points} points lie"


def _places(track: Track, wild: NDArray[np.int_]) -> list[str]:
    """Instant of every rejected point and its distance from the line between its usable neighbours, in words."""
    others = np.flatnonzero(track.usable)
    off_m = track.lead_position_m[wild] - np.interp(
        track.time_s[wild], track.time_s[others], track.lead_position_m[others]
    )
    return [
        f"{track.time_s[row]:.5g} s ({1e3 * off:+.2g} mm)"
        for row, off in zip(wild, off_m, strict=True)
        if math.isfinite(off)
    ]


def _far_off(time_s: Floats, position_m: Floats, limit: float, spare_copies: bool) -> NDArray[np.bool_]:
    """Points beyond the limit that are the worst among their neighbours."""
    noise_m, _ = robust_position_noise(time_s, position_m)
    fit = local_fit(time_s, position_m, noise_m)
    sigma_m = np.maximum(np.maximum(local_noise(np.abs(fit.residual_m) / fit.gain), noise_m), fit.spread_m)
    size = np.abs(fit.residual_m)
    step_m = np.abs(fit.speed_m_s) * float(np.median(np.diff(time_s)))
    behind = fit.residual_m * fit.speed_m_s < 0
    from_end = np.where(behind, np.arange(size.size)[::-1], np.arange(size.size))
    room_m = np.where(from_end < END_POINTS, END_STEPS * (from_end + 1) * step_m, 0.0)
    alone = (fit.share >= LEAST_SHARE) & (fit.near >= LEAST_NEAR)
    if spare_copies:
        alone[1:] &= np.abs(np.diff(position_m)) >= COPY_STEPS * step_m[1:]
    return np.asarray((size > limit * fit.gain * sigma_m + room_m) & alone & (sigma_m > 0))


def _sums(powers: Floats, weight: Floats) -> Floats:
    """Sums over each window of a weight times powers, shape (n_windows, n_powers)."""
    return np.asarray(np.matmul(weight[:, None, :], powers)[:, 0])


def _cubic(away: Floats, coefficients: Floats) -> Floats:
    """The cubic of each window at its places, shape (n_windows, n_places)."""
    c0, c1, c2, c3 = (coefficients[:, k, None] for k in range(4))
    return np.asarray(c0 + away * (c1 + away * (c2 + away * c3)))


def _solved(sums: Floats, right: Floats) -> Floats:
    """Coefficients, shape (n_windows, 4), whose normal equations have these sums of powers 0 to 6 and right sides.

    The system is brought to a unit diagonal, a ridge of 1e-10 put on it, and factored as L D Lᵀ in all windows at once.
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
