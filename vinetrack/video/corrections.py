"""Frames that a camera repeated or dropped: found from the motion itself, flagged, and the times put right.

A repeated frame shows as a step of nothing in steady motion. Is the next step double, the copy replaced a frame (a
*stale* copy: the times are right); is it single, the copy was *inserted* and everything after it is one frame late. A
dropped frame shows as one step of double length, and everything after it is one frame early.

A jump is judged against the jump that a smooth motion with the track's own noise could show: by least squares of a
parabola with a step on the nearest points on both sides. Nothing is called where the motion is slow beside the noise,
where it speeds up so fast that a long step may be the motion itself (release), or where the times are irregular.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vinetrack.records import Floats, Track, join_flags

CLEAR_STEP_SIGMAS = 8.0
"""Motion is well above noise where one frame's step exceeds this many standard deviations of a position."""

DROP_RATIO = 1.6
"""A step above this many times its neighbours is a dropped frame."""

JUMP_SIGMAS = 5.5
"""Least significance of a jump: 4e-8 by chance, 1e-4 over a long campaign's frames."""

SIDE_POINTS = 8
UNEVEN = 0.05
"""Spacings within this fraction of a whole number of frames count as even: printed times are rounded."""


@dataclass(frozen=True)
class _Event:
    """A fault on the way to row `row`: a frame repeated (stale or inserted) or `missing` frames dropped."""

    kind: str
    row: int
    missing: int = 0


def correct_frames(track: Track) -> Track:
    """A copy of the track with repeated frames flagged, gaps flagged, and times put right.

    Parameters
    ----------
    track
        A row for every frame; positions may be NaN.

    Returns
    -------
    Track
        `duplicate` on repeated frames; `gap` on the first row after a gap in the times; `gap;corrected` on the first
        row after dropped frames that the times did not show. Each is told in `notes`. A repeated frame that was
        inserted is set half a frame after the frame it repeats, so that times still increase.
    """
    spacing = np.diff(track.time_s)
    if track.time_s.size < 6 or not np.all(spacing > 0):
        return track
    step_s = float(np.median(spacing))
    frames = spacing / step_s
    if np.any(np.abs(frames - np.rint(frames)) > UNEVEN * np.maximum(np.rint(frames), 1.0)):
        return track
    out = _flag_visible_gaps(track, np.rint(frames).astype(int), step_s)
    noise_m, rho = _noise(out)
    tried = 0
    while (event := _next_event(out, tried, step_s, noise_m, rho)) is not None:
        out = _apply(out, event, step_s)
        tried = event.row
    return out


def _noise(track: Track) -> tuple[float, float]:
    """Noise of the track. Motion reads video and not the reverse, except for this one statistic of raw positions."""
    from vinetrack.motion.noise import estimate_noise

    return estimate_noise(track)


def _flag_visible_gaps(track: Track, frames: NDArray[np.int_], step_s: float) -> Track:
    """`gap` on the first row after each spacing of two frames or more."""
    out = track
    for before in np.flatnonzero(frames > 1):
        missing = int(frames[before]) - 1
        note = f"{_count(missing)} missing before {track.time_s[before + 1]:.5g} s, as the times say"
        out = _mark(out, int(before) + 1, "gap", note)
    return out


def _count(frames: int) -> str:
    return "1 frame is" if frames == 1 else f"{frames} frames are"


def _next_event(track: Track, after: int, step_s: float, noise_m: float, rho: float) -> _Event | None:
    """The first fault on a row beyond `after`."""
    rows = np.flatnonzero(track.usable)
    if rows.size < 6:
        return None
    frame = np.rint((track.time_s[rows] - track.time_s[rows[0]]) / step_s)
    y = track.lead_position_m[rows]
    speed = np.diff(y) / np.diff(frame)
    for i in _suspects(speed, noise_m):
        if rows[i + 1] <= after:
            continue
        event = _judge_drop(frame, y, i, noise_m, rho, rows) or _judge_repeat(frame, y, i, noise_m, rho, rows)
        if event is not None:
            return event
    return None


def _suspects(speed: Floats, noise_m: float) -> NDArray[np.int_]:
    """Steps that stand out from the smaller or larger of their neighbours: a cheap first sieve."""
    before, after = _neighbours(speed)
    usual = np.fmin(np.abs(before), np.abs(after))
    clear = np.fmax(before, after) > CLEAR_STEP_SIGMAS * noise_m
    return np.flatnonzero(clear & ((speed > DROP_RATIO * usual) | (speed < 0.4 * np.fmax(before, after))))


def _neighbours(speed: Floats) -> tuple[Floats, Floats]:
    """Medians of the three steps before and the three after each step, NaN where there are none."""
    padded = np.concatenate([np.full(3, np.nan), speed, np.full(3, np.nan)])
    view = np.lib.stride_tricks.sliding_window_view(padded, 3)
    return _row_median(view[: speed.size]), _row_median(view[4 : 4 + speed.size])


def _row_median(view: Floats) -> Floats:
    """Median of each row of three, ignoring NaN; NaN where all are."""
    ordered = np.sort(view, axis=1)
    count = np.isfinite(ordered).sum(axis=1)
    pick = np.where(count == 3, ordered[:, 1], np.where(count == 2, (ordered[:, 0] + ordered[:, 1]) / 2, ordered[:, 0]))
    return np.where(count == 0, np.nan, pick)


def _judge_drop(frame: Floats, y: Floats, i: int, noise_m: float, rho: float, rows: NDArray[np.int_]) -> _Event | None:
    """Whether frames are missing between points i and i + 1."""
    jump = _jump(frame, y, slice(0, i + 1), slice(i + 1, None), noise_m, rho)
    if jump is None or frame[i + 1] - frame[i] != 1:
        return None
    size, sigma, step = jump
    missing = round(size / step)
    if missing < 1 or y[i + 1] - y[i] <= DROP_RATIO * step or size < JUMP_SIGMAS * sigma:
        return None
    if abs(size - missing * step) > max(4 * sigma, 0.3 * step):
        return None
    return _Event("dropped", int(rows[i + 1]), missing)


def _judge_repeat(
    frame: Floats, y: Floats, i: int, noise_m: float, rho: float, rows: NDArray[np.int_]
) -> _Event | None:
    """Whether point i + 1 repeats point i, and if so, whether the copy replaced a frame or was inserted."""
    jump = _jump(frame, y, slice(0, i + 1), slice(i + 2, None), noise_m, rho)
    if jump is None or frame[i + 1] - frame[i] != 1:
        return None
    size, sigma, step = jump
    step_sigma = noise_m * math.sqrt(2 * (1 - rho))
    if abs(y[i + 1] - y[i]) > min(0.4 * step, 4 * step_sigma + 0.02 * step):
        return None
    behind = step - (y[i + 1] - y[i])
    if behind < JUMP_SIGMAS * step_sigma * 0.8 or i + 2 >= y.size:
        return None
    if abs(size) <= max(3 * sigma, 0.3 * step) and abs(size) < 0.5 * step:
        return _Event("stale", int(rows[i + 1]))
    if abs(size + step) <= max(3 * sigma, 0.3 * step) and -size > JUMP_SIGMAS * sigma:
        return _Event("inserted", int(rows[i + 1]))
    return None


def _jump(
    frame: Floats, y: Floats, left: slice, right: slice, noise_m: float, rho: float
) -> tuple[float, float, float] | None:
    """Jump of position between two sides of a smooth motion, its standard error, and the step of one frame there.

    None where either side has fewer than two points, moves less than `CLEAR_STEP_SIGMAS` a frame, or where the two
    sides move so differently that a jump cannot be told from acceleration.
    """
    t_left, y_left = frame[left][-SIDE_POINTS:], y[left][-SIDE_POINTS:]
    t_right, y_right = frame[right][:SIDE_POINTS], y[right][:SIDE_POINTS]
    if t_left.size < 3 or t_right.size < 3:
        return None
    speed_left, speed_right = (np.diff(v).mean() / np.diff(t).mean() for t, v in ((t_left, y_left), (t_right, y_right)))
    near_left, near_right = (
        (v[-1] - v[0]) / (t[-1] - t[0]) for t, v in ((t_left[-3:], y_left[-3:]), (t_right[:3], y_right[:3]))
    )
    slowest = min(speed_left, speed_right, near_left, near_right)
    if slowest < max(CLEAR_STEP_SIGMAS * noise_m * 0.75, 1e-12) or max(near_left, near_right) > 1.5 * min(
        near_left, near_right
    ):
        return None
    t = np.concatenate([t_left, t_right])
    t = t - (t_left[-1] + t_right[0]) / 2
    after = np.concatenate([np.zeros(t_left.size), np.ones(t_right.size)])
    basis = np.column_stack([np.ones(t.size), t, t**2, after])
    weights = np.linalg.pinv(basis)
    fit = weights @ np.concatenate([y_left, y_right])
    lag = np.abs(np.subtract.outer(t, t))
    covariance = weights @ (noise_m**2 * rho**lag) @ weights.T
    residual = np.concatenate([y_left, y_right]) - basis @ fit
    misfit = math.sqrt(float(np.sum(residual**2)) / max(t.size - 4, 1))
    sigma = math.sqrt(max(covariance[3, 3], 0.0)) * max(1.0, misfit / noise_m if noise_m > 0 else 1.0)
    step = float(fit[1])
    if step < CLEAR_STEP_SIGMAS * noise_m or step <= 0 or misfit > 0.15 * step + 2 * noise_m:
        return None
    return float(fit[3]), sigma, step


def _apply(track: Track, event: _Event, step_s: float) -> Track:
    """The track with one fault flagged, told, and its times put right."""
    at_s = float(track.time_s[event.row])
    if event.kind == "stale":
        return _mark(
            track, event.row, "duplicate", f"the frame at {at_s:.5g} s repeats the one before it and is left out"
        )
    time_s = track.time_s.copy()
    if event.kind == "inserted":
        time_s[event.row] -= step_s / 2
        time_s[event.row + 1 :] -= step_s
        note = f"the frame at {at_s:.5g} s is an inserted copy of the one before it: left out, later times moved back by one frame"
        return _mark(replace(track, time_s=time_s), event.row, "duplicate", note)
    time_s[event.row :] += event.missing * step_s
    note = f"{_count(event.missing)} missing before {at_s:.5g} s (the step there is too long): later times moved on"
    return _mark(replace(track, time_s=time_s), event.row, "gap;corrected", note)


def _mark(track: Track, row: int, flags: str, note: str) -> Track:
    """The track with flags added to one row and a sentence to its notes."""
    flag = track.flag.astype("<U80")
    flag[row] = join_flags(str(flag[row]), flags)
    return replace(track, flag=flag, notes=(*track.notes, note))
