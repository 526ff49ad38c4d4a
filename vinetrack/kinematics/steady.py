"""Steady windows of a trial, by an equivalence test (gated rule), by the paper's rule, or chosen by hand.

Speeds in a `Window` are **tail** speeds. The gated rule finds the longest stretch, well above rest, whose change of
speed is shown to be small (an equivalence test), rather than merely not shown to be large.

The paper's rule is a coefficient of variation below 3 % over at least three points: Alvarez et al., "High-Velocity,
Pressure-Driven Eversion for Rapid Vine Robots", IEEE RA-L 2025. It also accepts frames at rest, drifting speeds and
chance agreement; it is computed too, for comparison.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats, Kinematics, Track, Window, with_flag
from vinetrack.kinematics.plateau import RangeExtremes, WindowMoments, chord_bounds, judge, trim

__all__ = ["gated_window", "paper_window", "user_window"]

GRID_POINTS = 56  # Starts and ends tried in the first pass; the best is then refined point by point (chosen)

BAND = 0.5  # Half width of the band that contains every velocity, in drift limits (derived)

SHORTEST_SHARE = 0.1  # Shortest steady window, as a fraction of the motion (derived)

SHORTEST_FALL, FALLING = 0.02, 1 / 3  # Shortest window where the speed falls by more than a third of the limit (chosen)

# Deviation of the ends of a window from its speed line, in drift limits, above which they are trimmed (derived)
TRIM_BAND = 1 / 6

# Fraction of the growth after which no window lies, if the end was recorded or follows from the length of the vine: the
# moving mass vanishes there, or the vine is stopped (chosen)
END_FRACTION = 0.95

# A vine counts as moving where its speed exceeds this fraction of the highest, and this many standard errors (chosen)
START_FRACTION, START_SIGMAS = 0.2, 5.0

BAND_SIGMAS = 4.0  # Standard errors by which a single velocity may lie outside the band


def gated_window(
    track: Track,
    kinematics: Kinematics,
    *,
    length_m: float = math.nan,
    drift_limit: float = 0.03,
    start_fraction: float = START_FRACTION,
    start_sigmas: float = START_SIGMAS,
) -> Window:
    """Find the longest window in which the speed is shown to be constant within the drift limit."""
    time_s, position_m = _points(track, kinematics)
    first, last, why = _gate(kinematics, start_fraction, start_sigmas)
    if why:
        return Window("gated", False, why)
    inside = slice(first, last + 1)
    search = _Search(time_s[inside], position_m[inside], kinematics, inside, drift_limit)
    search.latest = _before_the_end(track, position_m, first, last, length_m) - first
    steady, nearest = search.longest()
    if steady is None:
        return Window("gated", False, nearest)
    untrimmed = (first + steady[0], first + steady[1])
    trimmed = trim(time_s, position_m, kinematics, untrimmed, TRIM_BAND * drift_limit, drift_limit)
    window = judge(time_s, position_m, kinematics, *trimmed, "gated")
    moving = last - first + 1
    reason = (
        f"steady over {window.n_points} of {moving} moving points: speed changes by {_percent(window)},"
        f" within ±{100 * drift_limit:g} %"
    )
    return _with(window, True, reason)


def user_window(
    track: Track, kinematics: Kinematics, window_s: tuple[float, float], length_m: float = math.nan
) -> Window:
    """Evaluate a window chosen by hand, which is always used; `reason` warns where it is not steady."""
    time_s, position_m = _points(track, kinematics)
    inside = np.flatnonzero((time_s >= window_s[0]) & (time_s <= window_s[1]))
    if inside.size < 3:
        raise ValueError(
            f"the chosen window {window_s[0]:g}:{window_s[1]:g} s contains {inside.size} usable points, at least 3 are"
            f" needed; the track runs from {time_s[0]:g} to {time_s[-1]:g} s"
        )
    window = judge(time_s, position_m, kinematics, int(inside[0]), int(inside[-1]), "user")
    if not window.x_ss_m_s > 0:
        return _with(window, True, f"chosen by hand; warning: the mean tail speed is {window.x_ss_m_s:.3g} m/s")
    steady = max(abs(window.drift_95[0]), abs(window.drift_95[1])) <= 0.03
    warnings = [] if steady else ["not shown to be steady"]
    first, last, why = _gate(kinematics, START_FRACTION, START_SIGMAS)
    if not why and inside[-1] > _before_the_end(track, position_m, first, last, length_m):
        warnings.append("runs into the end of growth")
    verdict = "; warning: ".join(["chosen by hand", *warnings])
    return _with(window, True, f"{verdict}: speed changes by {_percent(window)} over {window.n_points} points")


def _points(track: Track, kinematics: Kinematics) -> tuple[Floats, Floats]:
    """Times and raw positions at the points of the kinematics."""
    usable = track.usable
    time_s, position_m = track.time_s[usable], track.lead_position_m[usable]
    if not np.array_equal(time_s, kinematics.time_s):
        raise ValueError("the kinematics were not made from this track; call estimate_kinematics on it again")
    return time_s, position_m


def _gate(kinematics: Kinematics, start_fraction: float, start_sigmas: float) -> tuple[int, int, str]:
    """First and last point between which a window may lie, or the reason why there is none."""
    velocity, sigma = kinematics.lead_velocity_m_s, kinematics.lead_velocity_sigma_m_s
    top_speed = float(np.max(velocity - 3 * sigma))  # a lower limit, so that noise does not raise the gate
    if velocity.size < 3 or top_speed <= 0:
        return 0, 0, "nothing moves faster than three standard errors of its velocity"
    moving = velocity > np.maximum(start_fraction * top_speed, start_sigmas * sigma)
    points = np.flatnonzero(moving)
    if points.size < 3:
        return (
            0,
            0,
            (
                f"only {points.size} points move faster than {start_fraction:g} of the top speed and"
                f" {start_sigmas:g} standard errors"
            ),
        )
    return int(points[0]), int(points[-1]), ""


def _before_the_end(track: Track, position_m: Floats, first: int, last: int, length_m: float) -> int:
    """Last point that a window may contain: not in the last part of the growth, where that ends or is about to end."""
    grown_m = float(np.max(position_m[first : last + 1])) - float(position_m[0])
    # Growth has ended where the track is flagged so, or where a vine that moved is at rest again. A recording that
    # stops during the motion shows neither, but the length of the vine may show that growth is nearly complete.
    ended = last < position_m.size - 1 or with_flag(track.flag, "after_end").any()
    if grown_m > END_FRACTION * length_m:
        grown_m, ended = max(grown_m, length_m), True
    if not ended:
        return last
    reach_m = position_m[0] + END_FRACTION * grown_m
    beyond = np.flatnonzero(position_m[first : last + 1] > reach_m)
    return max(first + int(beyond[0]) - 1, first + 2) if beyond.size else last


class _Search:
    """Search over all windows between two points, each evaluated in constant time from cumulative sums."""

    def __init__(
        self, time_s: Floats, position_m: Floats, kinematics: Kinematics, inside: slice, drift_limit: float
    ) -> None:
        self.n = time_s.size
        self.latest = self.n - 1  #: the last point that a window may contain
        self.limit = drift_limit
        self.moments = WindowMoments(time_s, position_m, kinematics.noise_m, kinematics.noise_correlation)
        self.width = kinematics.window_points[inside]
        self.velocity, sigma = kinematics.lead_velocity_m_s[inside], kinematics.lead_velocity_sigma_m_s[inside]
        velocity = self.velocity
        self.smooth_low = RangeExtremes(velocity - BAND_SIGMAS * sigma)
        self.smooth_high = RangeExtremes(-(velocity + BAND_SIGMAS * sigma))
        self.chords = chord_bounds(time_s, position_m, kinematics.noise_m, kinematics.noise_correlation, BAND_SIGMAS)

    def longest(self) -> tuple[tuple[int, int] | None, str]:
        """First and last point of the longest steady window, or the reason why there is none."""
        stride = max(1, math.ceil(self.n / GRID_POINTS))
        edges = np.arange(0, self.n, stride)
        best, score = self._best(edges, np.union1d(edges, [self.n - 1]))
        if best is None:
            return None, score
        while stride > 1:
            reach, stride = stride, max(1, stride // 6)
            near = np.unique(np.append(np.arange(-reach, reach + 1, stride), 0))
            starts = np.unique(np.clip(best[0] + near, 0, self.n - 1))
            ends = np.unique(np.clip(best[1] + near, 0, self.n - 1))
            better, _ = self._best(starts, ends)
            best = better or best
        return best, ""

    def _best(self, starts: NDArray[np.int_], ends: NDArray[np.int_]) -> tuple[tuple[int, int] | None, str]:
        first, last = (grid.ravel() for grid in np.meshgrid(starts, ends, indexing="ij"))
        long_enough = (last - first + 1 >= 3) & (last <= self.latest)
        first, last = first[long_enough], last[long_enough]
        points = last - first + 1
        keep = points >= np.maximum(3, self.width[(first + last) // 2] / 2 + 2)
        first, last, points = first[keep], last[keep], points[keep]
        if first.size == 0:
            return None, "fewer points move than one smoothing window holds"
        mean, drift, drift_sigma = self.moments.drift(first, last)
        worst = np.abs(drift) + 1.96 * drift_sigma
        share = np.where(drift < -FALLING * self.limit, SHORTEST_FALL, SHORTEST_SHARE)
        steady = (mean > 0) & (worst <= self.limit) & (points >= share * self.n)
        for bounds in (self._smooth, *self.chords):
            index = np.flatnonzero(steady)
            if index.size == 0:
                break
            low, high = bounds(first[index], last[index])
            inside = (low <= (1 + BAND * self.limit) * mean[index]) & (high >= (1 - BAND * self.limit) * mean[index])
            steady[index[~inside]] = False
        if not steady.any():
            return None, self._nearest(first, last, mean, drift, drift_sigma)
        index = np.flatnonzero(steady)
        winner = index[np.lexsort((worst[index], -points[index]))[0]]
        return (int(first[winner]), int(last[winner])), ""

    def _smooth(self, first: NDArray[np.int_], last: NDArray[np.int_]) -> tuple[Floats, Floats]:
        return self.smooth_low.maximum(first, last), -self.smooth_high.maximum(first, last)

    def _nearest(
        self, first: NDArray[np.int_], last: NDArray[np.int_], mean: Floats, drift: Floats, sigma: Floats
    ) -> str:
        worst = np.where(mean > 0, np.abs(drift) + 1.96 * sigma, np.inf)
        near = int(np.argmin(worst))
        count, change, error = last[near] - first[near] + 1, 100 * drift[near], 196 * sigma[near]
        if worst[near] > self.limit:
            why = f"changes by {change:.2g} ± {error:.2g} % across it"
        elif count < SHORTEST_SHARE * self.n:
            why = f"is less than {100 * SHORTEST_SHARE:g} % of the motion"
        else:
            band = self.velocity[first[near] : last[near] + 1] / mean[near]
            why = f"contains speeds from {100 * band.min():.0f} to {100 * band.max():.0f} % of its mean"
        return (
            f"no window is shown to be steady within ±{100 * self.limit:g} %: the nearest,"
            f" {count} of {self.n} moving points, {why}"
        )


def _percent(window: Window) -> str:
    low, high = window.drift_95
    return f"{100 * window.drift:.2g} % (95 %: {100 * low:.2g} to {100 * high:.2g} %)"


def _with(window: Window, accepted: bool, reason: str) -> Window:
    return replace(window, accepted=accepted, reason=reason)


def paper_window(track: Track, *, travel_ratio: float, cv_limit: float = 0.03, min_points: int = 3) -> Window:
    """Find the window of the published rule: the longest run whose velocities vary by less than 3 %, wherever it is.
    Velocities are central differences of the raw positions, as Physics Tracker computes them.
    """
    usable = track.usable
    time_s, position_m = track.time_s[usable], track.lead_position_m[usable]
    if time_s.size < min_points + 2:
        return Window("paper", False, f"{time_s.size} points are too few for {min_points} central differences")
    velocity = (position_m[2:] - position_m[:-2]) / (time_s[2:] - time_s[:-2])
    run = _longest_run(velocity, cv_limit, min_points)
    if run is None:
        return Window("paper", False, f"no {min_points} consecutive velocities vary by less than {cv_limit:.0%}")
    start, stop = run
    chosen = velocity[start : stop + 1] * travel_ratio
    mean, sd = float(chosen.mean()), float(chosen.std(ddof=1))
    drift = float(np.polyfit(np.linspace(-0.5, 0.5, chosen.size), chosen, 1)[0]) / mean
    cv = sd / abs(mean)
    return Window(
        rule="paper",
        accepted=True,
        reason=f"longest run with a coefficient of variation below {cv_limit:.0%}: {chosen.size} velocities, {cv:.2%}",
        from_s=float(time_s[start + 1]),
        to_s=float(time_s[stop + 1]),
        n_points=chosen.size,
        x_ss_m_s=mean,
        x_ss_sigma_m_s=sd / math.sqrt(chosen.size),
        drift=drift,
        cv=cv,
    )


def _longest_run(velocity: Floats, cv_limit: float, min_points: int) -> tuple[int, int] | None:
    """First and last index of the longest run with coefficient of variation below the limit; the lowest of ties.
    Lengths are tried in descending order, octave by octave. A run of 2b to 4b values contains an aligned block of b
    values whose squared deviations cannot exceed those of the run, so only runs around quiet blocks are evaluated.
    """
    n = velocity.size
    level = float(np.median(velocity))
    zero = 1e-9 * float(np.max(np.abs(velocity)))  # a mean below this is a rounding error of 0
    total = np.concatenate([[0.0], np.cumsum(velocity - level)])
    square = np.concatenate([[0.0], np.cumsum((velocity - level) ** 2)])
    longest = n
    while longest >= min_points:
        block = max(1, 2 ** (int(math.log2(longest)) - 1))
        shortest = max(min_points, 2 * block if block > 1 else 1)
        starts = _near_quiet_blocks(velocity, block, cv_limit)
        for length in range(longest, shortest - 1, -1):
            first = starts[starts + length <= n]
            if first.size == 0:
                continue
            sums = total[first + length] - total[first]
            spread = np.maximum(square[first + length] - square[first] - sums**2 / length, 0.0) / (length - 1)
            mean = sums / length + level
            good = np.flatnonzero((spread < (cv_limit * mean) ** 2) & (np.abs(mean) > zero))
            if good.size:
                start = int(first[good[np.argmin(spread[good] / mean[good] ** 2)]])
                return start, start + length - 1
        longest = shortest - 1
    return None


def _near_quiet_blocks(velocity: Floats, block: int, cv_limit: float) -> NDArray[np.int_]:
    """Starts from which a run of 2 to 4 blocks can contain a block that is quiet enough for the run. The run's mean m
    lies within 2·cv·|m| of the block's, and the block's squares sum to no more than 4·block·(cv·m)².
    """
    n = velocity.size
    if 2 * cv_limit >= 1 or block < 2:
        return np.arange(n)
    rows = velocity[: n // block * block].reshape(-1, block)
    mean = rows.mean(axis=1)
    squares = np.sum((rows - mean[:, None]) ** 2, axis=1)
    quiet = np.flatnonzero(squares <= 4 * block * (cv_limit * mean / (1 - 2 * cv_limit)) ** 2) * block
    edge = np.zeros(n + 1, dtype=int)
    np.add.at(edge, np.maximum(quiet - 3 * block, 0), 1)
    np.add.at(edge, quiet + 1, -1)
    return np.flatnonzero(np.cumsum(edge[:n]) > 0)
