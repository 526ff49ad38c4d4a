"""Find frames that a camera repeated or dropped from the motion itself, flag them, and correct the times.

A repeated frame shows as a zero step in steady motion. If the next step is double, the copy replaced a frame (a *stale*
copy: the times are right); if it is single, the copy was *inserted* and everything after it is one frame late. A
dropped frame shows as one step of double length, and everything after it is one frame early.

A jump is tested against the jump that a smooth motion with the track's own noise could show: by least squares of a
parabola with a step on the nearest points on both sides. An inserted copy counts only where points farther away agree:
noise may have heavy tails. Outliers are rejected afterwards.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from vinetrack.core.problems import Remark, confirmed, remark
from vinetrack.core.records import Floats, Track, Trial, with_flag
from vinetrack.tracks.position_noise import (
    THIRD_DIFFERENCE_SD,
    local_noise,
    position_noise,
    reject_outliers,
    rounding_noise,
)

# Step of a frame, in standard deviations of a position, above which motion is well above the noise (chosen)
CLEAR_STEP_SIGMAS = 8.0
# Ratios of a step to its neighbours below which it may repeat a frame, and above which frames were dropped (chosen)
SHORT_STEP, DROP_RATIO = 0.4, 1.6
JUMP_SIGMAS = 5.5  # Least significance of a jump, in standard errors (derived)
SIDE_POINTS = (8, 5, 3)  # Points used on either side, fewer where release or the end of growth is near (chosen)
# Points on either side that must show at least this part of the jump too, where they are conclusive (chosen)
WIDE_SIDE_POINTS, LEAST_SHARE = 24, 0.6


class _Jump(NamedTuple):
    """Jump of position between two sides of a smooth motion, its standard error and the step of one frame, m."""

    size: float
    sigma: float
    step: float


def correct_frames(track: Track) -> Track:
    """Flag repeated frames and gaps of a track, correct its times, and reject its outliers."""
    spacing = np.diff(track.time_s)
    if track.time_s.size < 6 or not np.all(spacing > 0):
        return reject_outliers(track)
    step_s = float(np.median(spacing))
    frames = spacing / step_s
    # Spacings must be whole numbers of frames to within 5 %.
    if np.any(np.abs(frames - np.rint(frames)) > 0.05 * np.maximum(np.rint(frames), 1.0)):
        return reject_outliers(track)
    out = track
    # `gap` on the first row after each spacing of two frames or more that nothing has marked yet
    for before in np.flatnonzero((np.rint(frames) > 1) & ~with_flag(track.flag[1:], "gap")):
        missing = _frames_are(int(np.rint(frames[before])) - 1)
        note = f"{missing} missing before {track.time_s[before + 1]:.5g} s, as the times say"
        out = out.flagged([int(before) + 1], "gap", note)
    noise_m, rho = _noise(out)
    row = 0
    while (fault := _next_fault(out, row, step_s, noise_m, rho)) is not None:
        row, frames_late, is_copy = fault
        at_s, time_s = float(out.time_s[row]), out.time_s.copy()
        time_s[row] += (frames_late / 2 if is_copy else frames_late) * step_s
        time_s[row + 1 :] += frames_late * step_s
        if is_copy:
            note = f"the frame at {at_s:.5g} s repeats the one before it and is left out"
            note += ", later times moved back by one frame" if frames_late else ""
        else:
            note = f"{_frames_are(frames_late)} missing before {at_s:.5g} s (the step there is too long): later times "
            note += "moved on"
        out = replace(out, time_s=time_s).flagged([row], "duplicate" if is_copy else "gap;retimed", note)
    return reject_outliers(out)


def frames_surely_missing(track: Track) -> bool:
    """Whether frames are missing beyond doubt: at least one jump is confirmed by more than the nearest points."""
    rows = np.flatnonzero(track.usable)
    frame = np.rint((track.time_s[rows] - track.time_s[rows[0]]) / float(np.median(np.diff(track.time_s))))
    noise_m, rho = _noise(track)
    for i in (np.flatnonzero(with_flag(track.flag[rows], "retimed")) - 1).tolist():
        missing = frame[i + 1] - frame[i] - 1
        as_filmed = np.where(np.arange(frame.size) > i, frame - missing, frame)
        near = as_filmed, track.lead_position_m[rows]
        jump = _jump(*near, slice(0, i + 1), slice(i + 1, None), noise_m[rows[i]], rho) if i >= 0 else None
        if jump is None or math.isfinite(_wide_jump(*near, i, noise_m[rows[i]])):
            return True
        # 2.0: factor for a jump that points farther away cannot confirm, as near release (measured)
        if jump.size > 2.0 * JUMP_SIGMAS * jump.sigma:
            return True
    return False


def _noise(track: Track) -> tuple[Floats, float]:
    """Standard deviation of a position at each row of a track, m, and the lag-one correlation of the noise. It is that
    of the whole track, or of the points around where that is larger: an edge far from the lamp is noisier than at rest,
    and its noise makes jumps there. Rows that seem to repeat the one before are no noise.
    """
    rows = np.flatnonzero(track.usable)
    y = track.lead_position_m[rows]
    speed, _, larger = _steps(np.arange(float(y.size)), y)
    # 0.1: part of the highest speed from which a step is one of a motion (chosen)
    moves = larger > 0.1 * np.nanmax(larger, initial=0.0)
    single = np.append(True, (speed >= SHORT_STEP * larger) | ~moves)[: y.size]
    rounding_m, kept, y = rounding_noise(y), rows[single], y[single]
    whole_m, rho = position_noise(track.time_s[kept], y, robust=True)
    whole_m = max(whole_m, rounding_m)
    noise_m = np.full(track.time_s.size, whole_m)
    if y.size > 2 * WIDE_SIDE_POINTS:
        around_m = np.pad(local_noise(np.abs(np.diff(y, 3)) / THIRD_DIFFERENCE_SD, WIDE_SIDE_POINTS), (1, 2), "edge")
        noise_m[rows] = np.fmax(whole_m, np.interp(rows, kept, around_m))
    return noise_m, rho


def _steps(frame: Floats, y: Floats) -> tuple[Floats, Floats, Floats]:
    """Speed of each step, m a frame, and the smaller and larger of the medians of the three before and after it."""
    import pandas as pd

    speed = np.diff(y) / np.diff(frame)
    earlier, later = (
        pd.Series(one_way).shift(1).rolling(3, min_periods=1).median().to_numpy() for one_way in (speed, speed[::-1])
    )
    return speed, np.fmin(np.abs(earlier), np.abs(later[::-1])), np.fmax(earlier, later[::-1])


def _frames_are(frames: int) -> str:
    """A number of frames as the beginning of a sentence, with its verb."""
    return "1 frame is" if frames == 1 else f"{frames} frames are"


def _next_fault(track: Track, after: int, step_s: float, noise_m: Floats, rho: float) -> tuple[int, int, bool] | None:
    """The first fault beyond a row: its row, how many frames early times are from there on, whether it is a copy."""
    rows = np.flatnonzero(track.usable)
    if rows.size < 6:
        return None
    frame = np.rint((track.time_s[rows] - track.time_s[rows[0]]) / step_s)
    y, stated, noise_m = (each[rows] for each in (track.lead_position_m, track.lead_position_sigma_m, noise_m))
    # Steps that differ clearly from the smaller or larger of their neighbours, and from the noise: a first screening. A
    # point with a large stated error, such as one that a door half hides, makes no step conclusive about frames.
    speed, smaller, larger = _steps(frame, y)
    clear = larger > CLEAR_STEP_SIGMAS * np.fmax(noise_m[:-1], np.fmax(stated[:-1], stated[1:]))
    is_odd = clear & ((speed > DROP_RATIO * smaller) | (speed < SHORT_STEP * larger))
    suspects = np.flatnonzero(is_odd & (rows[1:] > after))
    # 0.1: part of a step within which a copy that is judged later seems to stand still (chosen). Each is judged without
    # those, since they may lie close together: but for those beside a long step, which may be stale, or outliers.
    frames, is_long = np.diff(frame), np.pad(speed > DROP_RATIO * larger, 1)
    seems_copy = is_odd & (np.abs(speed) < 0.1 * larger) & ~(is_long[:-2] | is_long[2:]) & (rows[1:] > after)
    seem = np.where(seems_copy & (frames == 1), 0.0, frames)
    for i in suspects.tolist():
        seem[i : i + 2] = frames[i : i + 2]  # A long step before what seems a copy is that of one outlier.
        kept = np.append(True, seem > 0)
        others_corrected = np.append(0.0, np.cumsum(seem))[kept], y[kept]
        if (fault := _fault_at(*others_corrected, int(np.count_nonzero(kept[:i])), noise_m[i], rho)) is not None:
            return int(rows[i + 1]), *fault
    return None


def _fault_at(frame: Floats, y: Floats, i: int, noise_m: float, rho: float) -> tuple[int, bool] | None:
    """What happened between points i and i + 1: so many frames are missing, or the second repeats the first, and
    replaced a frame (0) or was inserted (−1); None where nothing is sure.
    """
    jump = _jump(frame, y, slice(0, i + 1), slice(i + 1, None), noise_m, rho)
    if jump is not None and frame[i + 1] - frame[i] == 1:
        missing, is_long = round(jump.size / jump.step), y[i + 1] - y[i] > DROP_RATIO * jump.step
        if missing >= 1 and is_long and jump.size >= JUMP_SIGMAS * jump.sigma:
            return missing, False
    jump = _jump(frame, y, slice(0, i + 1), slice(i + 2, None), noise_m, rho)
    if jump is None:
        return None
    size, sigma, step = jump
    step_sigma = noise_m * math.sqrt(2 * (1 - rho))
    short_step = y[i + 1] - y[i]
    # A copy stands still to within this part of a step, and the step must be this significant.
    if abs(short_step) > min(0.25 * step, 4 * step_sigma + 0.02 * step) or step - short_step < 5.0 * step_sigma:
        return None
    if 0 < i < y.size - 3 and 2 * step_sigma < sigma:
        # Where the motion is curved, the two steps minus their two neighbours are the better measure.
        size, sigma = float(y[i + 2] - y[i] - (y[i] - y[i - 1]) - (y[i + 3] - y[i + 2])), 2 * step_sigma
    allowed = max(3 * sigma, 0.3 * step)
    if abs(size) <= allowed:
        return 0, True
    without = np.delete(frame, i + 1), np.delete(y, i + 1)
    # The step back after an inserted copy must be significant, and points farther away must not deny it.
    is_back = abs(size + step) <= allowed and -size > 3.5 * sigma
    if is_back and not -_wide_jump(*without, i, noise_m) < LEAST_SHARE * step:
        return -1, True
    return None


def _jump(frame: Floats, y: Floats, left: slice, right: slice, noise_m: float, rho: float) -> _Jump | None:
    """Jump of position between two sides of a smooth motion, the widest that follow one parabola. None without such
    sides, and where either is slow beside the noise, or so much faster that the jump may be acceleration.
    """
    for points in SIDE_POINTS:
        sides = (frame[left][-points:], y[left][-points:]), (frame[right][:points], y[right][:points])
        if min(t.size for t, _ in sides) < SIDE_POINTS[-1]:
            return None
        (t_left, y_left), (t_right, y_right) = sides
        near_left = (y_left[-1] - y_left[-3]) / (t_left[-1] - t_left[-3])
        near_right = (y_right[2] - y_right[0]) / (t_right[2] - t_right[0])
        slower, faster = min(near_left, near_right), max(near_left, near_right)
        # A larger ratio of speeds may be acceleration.
        if slower <= 0 or faster > 1.8 * slower:
            continue
        both, t = np.concatenate([y_left, y_right]), np.concatenate([t_left, t_right]) - (t_left[-1] + t_right[0]) / 2
        basis = np.column_stack([np.ones(t.size), t, t**2, t > 0])
        weights = np.linalg.pinv(basis)
        fit = weights @ both
        misfit_m = math.sqrt(float(np.sum((both - basis @ fit) ** 2)) / (t.size - 4))
        step = float(fit[1])
        # A motion that scatters by a tenth of a step is not smooth enough to show a jump.
        if step < CLEAR_STEP_SIGMAS * noise_m or step <= 0 or misfit_m > 0.1 * step + 2 * noise_m:
            continue
        correlation = rho ** np.abs(np.subtract.outer(t, t))
        sigma = max(noise_m, misfit_m) * math.sqrt(float(weights[3] @ correlation @ weights[3]))
        return _Jump(float(fit[3]), sigma, step)
    return None


def _wide_jump(frame: Floats, y: Floats, i: int, noise_m: float) -> float:
    """Jump between points i and i + 1 from many more points on either side, where an apparent one that a few outliers
    made up is gone; NaN where these are inconclusive, as no cubic with a step follows them to within the noise.
    """
    first = max(i + 1 - WIDE_SIDE_POINTS, 0)
    near = slice(first, i + 1 + WIDE_SIDE_POINTS)
    t, points = (frame[near] - frame[i]) / WIDE_SIDE_POINTS, y[near]
    before = i + 1 - first
    if min(before, t.size - before) < 2 * SIDE_POINTS[0]:
        return math.nan
    basis = np.column_stack([np.ones(t.size), t, t**2, t**3, np.arange(t.size) >= before])
    fit = np.linalg.pinv(basis) @ points
    misfit_m = math.sqrt(float(np.sum((points - basis @ fit) ** 2)) / (t.size - 5))
    return float(fit[4]) if misfit_m < 2.5 * noise_m else math.nan


def mean_speed(track: Track) -> float:
    """Mean speed of the leading edge over the middle of its travel, m/s; NaN without travel."""
    time_s, position_m = track.time_s[track.usable], track.lead_position_m[track.usable]
    travel_m = np.maximum.accumulate(position_m - position_m[0]) if position_m.size else position_m
    if travel_m.size < 5 or not travel_m[-1] > 0:
        return np.nan
    early, late = (int(np.searchsorted(travel_m, part * travel_m[-1])) for part in (0.2, 0.9))
    duration_s = float(time_s[late] - time_s[early])
    return float(travel_m[late] - travel_m[early]) / duration_s if duration_s > 0 else np.nan


def longer_than_stated(pairs: Iterable[tuple[Trial, Track]]) -> Remark:
    """Say which tracks are longer than their vine, beyond which no bare tip can run; blank where none is for sure."""
    travels: list[tuple[Trial, float]] = []
    for trial, track in pairs:
        position_m = track.lead_position_m[track.usable]
        bare = trial.travel_ratio != 1 and trial.payload_kg == 0
        if bare and math.isfinite(trial.length_m) and position_m.size >= 5:
            travels.append((trial, float(np.quantile(position_m, 0.99) - np.median(position_m[:3]))))
    # 1.05: travel, in lengths of the vine, that an error of length or scale of a few per cent leaves (chosen)
    longer = [(travel_m / one.length_m, one, travel_m) for one, travel_m in travels if travel_m > 1.05 * one.length_m]
    sure = confirmed([(one.vine, "length_mm") for _, one, _ in longer], [one.vine for one, _ in travels])
    longer = [entry for entry in longer if (entry[1].vine, "length_mm") in sure]
    if not longer:
        return Remark()
    _, trial, travel_m = max(longer, key=lambda one: one[0])
    facts = {"count": len(longer), "name": trial.name, "travel_m": travel_m, "length_m": trial.length_m}
    return remark("longer_than_stated", **facts)


def ends_short(pairs: Iterable[tuple[Trial, Track]]) -> Remark:
    """Say of which vine all imported tracks come to rest at one place short of its length; blank where none do. A film
    tells its end itself, and what follows that may lie at the border of the picture.
    """
    rests: dict[tuple[str, float], list[float]] = {}
    for trial, track in pairs:
        ended = with_flag(track.flag, "after_end") & np.isfinite(track.lead_position_m)
        imported = trial.video is None and trial.frames_used is None and trial.travel_ratio != 1
        if imported and ended.any() and track.usable.any():
            travel_m = np.median(track.lead_position_m[ended]) - np.median(track.lead_position_m[track.usable][:3])
            rests.setdefault((trial.vine, trial.length_m), []).append(float(travel_m))
    for (vine, length_m), travels in rests.items():
        # 3, 0.02, 0.97: tracks that tell a place, and parts of the length by which they agree and up to which (chosen)
        if len(travels) >= 3 and np.ptp(travels) < 0.02 * length_m and max(travels) < 0.97 * length_m:
            facts = {"count": len(travels), "vine": vine, "travel_m": float(np.median(travels)), "length_m": length_m}
            return remark("ends_short", **facts)
    return Remark()
