"""Frames that a camera repeated or dropped: found from the motion itself, flagged, and the times put right.

A repeated frame shows as a step of nothing in steady motion. Is the next step double, the copy replaced a frame (a
*stale* copy: the times are right); is it single, the copy was *inserted* and everything after it is one frame late. A
dropped frame shows as one step of double length, and everything after it is one frame early.

A jump is judged against the jump that a smooth motion with the track's own noise could show: by least squares of a
parabola with a step on the nearest points on both sides. Times are moved only where one wild point would not explain
it as well and points farther away agree: noise may have heavy tails. Points far off the motion around them are rejected
first (`wild_points`): a dropped frame displaces all later points, a wild point comes back. One that comes to lie where
the point before does is a copy's double, and waits until copies were judged. Nothing is called where the
motion is slow beside the noise, where it speeds up so fast that a long step may be the motion itself (release), or
where the times are irregular.

The tracker of recordings looks at single steps with `step_gaps`, before positions are in metres; what that has marked
as a gap is not told again by `correct_frames`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats, Track, join_flags, with_flag
from vinetrack.tracks.position_noise import THIRD_DIFFERENCE, robust_position_noise
from vinetrack.tracks.wild_points import local_noise, reject_wild_points

CLEAR_STEP_SIGMAS = 8.0
"""Motion is well above noise where one frame's step exceeds this many standard deviations of a position."""

DROP_RATIO = 1.6
"""A step above this many times its neighbours is a dropped frame. Chosen between 1, a steady step, and 2, a step over
one dropped frame, nearer to 2 since speed rises from frame to frame at release. By reasoning: at half every step is a
suspect, at twice (3.2) only two dropped frames in a row are found."""

JUMP_SIGMAS = 5.5
"""Least significance of a jump: 4e-8 by chance, 1e-4 over a long campaign's frames. Derived from the normal
distribution, two-sided. By reasoning: at half (2.8) one step in 170 passes; at twice, steps below eleven standard
errors of a jump are left in."""

STILL, STILL_SIGMAS = 0.25, 5.0
"""A copy stands still to within this part of a step, which must be this significant; a copy is nearly exact. Chosen.
By reasoning: at half, positions rounded to a tenth of a step hide copies; at twice, slow frames of a motion that stops
and goes pass for copies."""

LONG_BEFORE_COPY = 1.4
"""A step so many times those around it, just before what looks like an inserted copy, is one point seen ahead. Chosen
between a usual step, 1, and a step ahead, 2. By reasoning: near 1 real copies in motion that speeds up are kept as
points ahead; beyond 2 no point ahead is recognised."""

COPY_SIGMAS = 3.5
"""Least significance of the step back after an inserted copy. Chosen: 2e-4 by chance, for steps that already stand
still. By reasoning: at half one in 25 such steps moves the times; at twice copies in noisy tracks stay."""

SIDE_POINTS = (8, 5, 3)
"""Points taken on either side, fewer where release or the end of growth is near. Chosen: a parabola with a step has
four numbers, so that 2 × 3 points are the fewest that show scatter, and over 2 × 8 the speed changes little. By
reasoning: half as many find fewer jumps in noise; twice as many leave no parabola near release."""

SLOWEST_SIDE = 0.75
"""Each side alone moves at least this part of a clear step. Chosen. By reasoning: at half, jumps are looked for where
one step hardly stands out of the noise; at twice (1.5), only where motion is 12 standard deviations a frame."""

SIMILAR_SIDES = 1.8
"""Largest ratio of the speeds just before and just after: beyond it a long step may be the motion itself. Chosen just
below 2, the ratio of a double step. By reasoning: at half nothing passes; at twice a release passes for a dropped
frame."""

LARGEST_MISFIT = 0.1
"""Scatter about the parabola, in steps, beyond which the motion is not smooth enough to show a jump. Chosen: a jump of
one step is then ten times the scatter. By reasoning: at half, tracks with noise of 5 % of a step are not corrected; at
twice, stop-and-go motion is."""

WILD_RATIO, WILD_SIGMAS = 3.0, 4.0
"""A single wild point must leave so many times the squares of a jump, and so many squared deviations more. Chosen. By
reasoning: at half, wild points move times; at twice, dropped frames in noisy tracks stay."""

WIDE_SIDE_POINTS, LEAST_SHARE = 24, 0.6
"""Points on either side that must see at least this part of the jump too, where they can tell. Chosen: 48 points know
a step three times better than 16, and one cubic still follows them away from release. By reasoning: at half they
repeat the nearest points; at twice few motions follow one cubic, and the test says nothing."""

ALONE = 2.0
"""Where points farther away cannot tell, as near release, a jump must be so many times as significant to be sure of it:
a few points with heavy tails make up what the normal distribution never does. Measured: in 100 campaigns with
heavy-tailed noise and all their frames (null:heavy_tails of `benchmarks/hidden_effects.py`, tuning seeds 20600 to
20699) times were moved for four jumps of 5.9 to 9.8 standard errors, none of them sure by this. Each of 38 campaigns
with dropped frames (frames:dropped, 20600 to 20639) has a jump that is. At half all are sure, at twice those near
release never."""

UNEVEN = 0.05
"""Spacings within this fraction of a whole number of frames count as even: printed times are rounded. Chosen: times
printed to 0.1 ms at 500 frames a second err by 0.025 of a frame. By reasoning: at half such times count as uneven and
are left alone; at twice irregular times are corrected as if even."""


_Sides = tuple[tuple[Floats, Floats], tuple[Floats, Floats]]
"""Frame numbers and positions before and after."""


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
    track : A row for every frame; positions may be NaN.

    Returns
    -------
    Track
        `rejected` on wild points; `duplicate` on repeated frames; `gap` on the first row after a gap in the times;
        `gap;retimed` on the first row after dropped frames that the times did not show. Each is told in `notes`, but
        for gaps in the times that were marked before. A repeated frame that was inserted is set half a frame after
        the frame it repeats, so that times still increase.
    """
    return reject_wild_points(_corrected(reject_wild_points(track, spare_copies=True)))


def _corrected(track: Track) -> Track:
    """The same of a track without wild points, but for those that may be copies."""
    spacing = np.diff(track.time_s)
    if track.time_s.size < 6 or not np.all(spacing > 0):
        return track
    step_s = float(np.median(spacing))
    frames = spacing / step_s
    if np.any(np.abs(frames - np.rint(frames)) > UNEVEN * np.maximum(np.rint(frames), 1.0)):
        return track
    out = _flag_visible_gaps(track, np.rint(frames).astype(int))
    noise_m, rho = _noise(out)
    out = _retime_known_copies(out, step_s, noise_m, rho)
    tried = 0
    while (event := _next_event(out, tried, step_s, noise_m, rho)) is not None:
        out = _apply(out, event, step_s)
        tried = event.row
    return out


def frames_surely_missing(track: Track) -> bool:
    """Whether frames are missing from a track beyond doubt: one jump at least that more than the nearest points tell.

    Parameters
    ----------
    track : Track
        With its times put right, as by `correct_frames`; or by the tracker, which has grounds of its own.

    Returns
    -------
    bool
    """
    rows = np.flatnonzero(track.usable)
    frame = np.rint((track.time_s[rows] - track.time_s[rows[0]]) / float(np.median(np.diff(track.time_s))))
    noise_m, rho = _noise(track)
    for i in (np.flatnonzero(with_flag(track.flag[rows], "retimed")) - 1).tolist():
        missing = frame[i + 1] - frame[i] - 1
        as_filmed = np.where(np.arange(frame.size) > i, frame - missing, frame)
        around = as_filmed, track.lead_position_m[rows]
        jump = _jump(*around, slice(0, i + 1), slice(i + 1, None), noise_m[rows[i]], rho) if i >= 0 else None
        if jump is None or math.isfinite(_jump_far_around(*around, i, noise_m[rows[i]])):
            return True
        if jump[0] > ALONE * JUMP_SIGMAS * jump[1]:
            return True
    return False


def _noise(track: Track) -> tuple[Floats, float]:
    """Standard deviation of a position at each row of a track, m, and the correlation of the noise from row to row.

    Of the whole track, or, where that is more, of the points around: an edge far from the lamp is noisier than at rest,
    and its noise makes jumps there.
    """
    usable = track.usable
    y = track.lead_position_m[usable]
    whole_m, rho = robust_position_noise(track.time_s[usable], y)
    noise_m = np.full(usable.size, whole_m)
    if y.size > 2 * WIDE_SIDE_POINTS:
        around_m = local_noise(np.abs(np.diff(y, 3)) / THIRD_DIFFERENCE, WIDE_SIDE_POINTS)
        noise_m[usable] = np.fmax(whole_m, np.pad(around_m, (1, 2), mode="edge"))
    return noise_m, rho


def _retime_known_copies(track: Track, step_s: float, noise_m: Floats, rho: float) -> Track:
    """Later times moved back behind repeated frames that the picture showed, where the motion says they were inserted.

    A repeated picture tells that a frame is a copy, not whether it took the place of another.
    """
    for row in np.flatnonzero(with_flag(track.flag, "duplicate")):
        with_copy = track.usable
        with_copy[row] = bool(np.isfinite(track.lead_position_m[row]))
        rows = np.flatnonzero(with_copy)
        i = int(np.searchsorted(rows, row)) - 1
        if not with_copy[row] or i < 0:
            continue
        frame = np.rint((track.time_s[rows] - track.time_s[rows[0]]) / step_s)
        event = _judge_repeat(frame, track.lead_position_m[rows], i, noise_m[rows[i]], rho, rows)
        if event is not None and event.kind == "inserted":
            track = _apply(track, event, step_s)
    return track


def _flag_visible_gaps(track: Track, frames: NDArray[np.int_]) -> Track:
    """`gap` on the first row after each spacing of two frames or more, where nothing has marked it yet."""
    out = track
    for before in np.flatnonzero((frames > 1) & ~with_flag(track.flag[1:], "gap")):
        missing = int(frames[before]) - 1
        note = f"{frames_are(missing)} missing before {track.time_s[before + 1]:.5g} s, as the times say"
        out = _mark(out, int(before) + 1, "gap", note)
    return out


def frames_are(frames: int) -> str:
    """A number of frames as the beginning of a sentence.

    Parameters
    ----------
    frames : how many.

    Returns
    -------
    str : with its verb.
    """
    return "1 frame is" if frames == 1 else f"{frames} frames are"


def _next_event(track: Track, after: int, step_s: float, noise_m: Floats, rho: float) -> _Event | None:
    """The first fault on a row beyond `after`."""
    rows = np.flatnonzero(track.usable)
    if rows.size < 6:
        return None
    frame = np.rint((track.time_s[rows] - track.time_s[rows[0]]) / step_s)
    y = track.lead_position_m[rows]
    speed = np.diff(y) / np.diff(frame)
    stated = track.lead_position_sigma_m[rows]
    noise_m = noise_m[rows]
    for i in _suspects(speed, np.fmax(noise_m[:-1], np.fmax(stated[:-1], stated[1:]))):
        if rows[i + 1] <= after:
            continue
        event = _judge_drop(frame, y, i, noise_m[i], rho, rows) or _judge_repeat(frame, y, i, noise_m[i], rho, rows)
        if event is not None:
            return event
    return None


def _suspects(speed: Floats, noise_m: Floats) -> NDArray[np.int_]:
    """Steps that stand out from the smaller or larger of their neighbours, and from their own noise: a first sieve.

    A point that is stated to be unsure, such as one that a door half hides, makes no step that tells of frames.
    """
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
    size, sigma, step, sides = jump
    missing = round(size / step)
    long = y[i + 1] - y[i]
    if missing < 1 or long <= DROP_RATIO * step or size < JUMP_SIGMAS * sigma:
        return None
    # Both single neighbours count too, to within a standard error: speeding up, the one after is nearly as long.
    nearest = max((y[i] - y[i - 1]) / (frame[i] - frame[i - 1]), (y[i + 2] - y[i + 1]) / (frame[i + 2] - frame[i + 1]))
    if long <= DROP_RATIO * nearest - noise_m * math.sqrt(2 * (1 - rho)):
        return None
    if abs(size - missing * step) > max(4 * sigma, 0.3 * step) or _one_wild_point(sides, noise_m):
        return None
    if _jump_far_around(frame, y, i, noise_m) < LEAST_SHARE * missing * step:
        return None
    return _Event("dropped", int(rows[i + 1]), missing)


def _judge_repeat(
    frame: Floats, y: Floats, i: int, noise_m: float, rho: float, rows: NDArray[np.int_]
) -> _Event | None:
    """Whether point i + 1 repeats point i, and if so, whether the copy replaced a frame or was inserted."""
    jump = _jump(frame, y, slice(0, i + 1), slice(i + 2, None), noise_m, rho)
    if jump is None or frame[i + 1] - frame[i] != 1:
        return None
    size, sigma, step, _ = jump
    step_sigma = noise_m * math.sqrt(2 * (1 - rho))
    still = y[i + 1] - y[i]
    if abs(still) > min(STILL * step, 4 * step_sigma + 0.02 * step) or step - still < STILL_SIGMAS * step_sigma:
        return None
    if 0 < i < y.size - 3 and 2 * step_sigma < sigma:
        # Where the motion bends, what the two steps bring against their two neighbours is the better measure.
        size, sigma = float(y[i + 2] - y[i] - (y[i] - y[i - 1]) - (y[i + 3] - y[i + 2])), 2 * step_sigma
    if abs(size) <= max(3 * sigma, 0.3 * step) and abs(size) < 0.5 * step:
        return _Event("stale", int(rows[i + 1]))
    if abs(size + step) <= max(3 * sigma, 0.3 * step) and -size > COPY_SIGMAS * sigma:
        # Seen a step ahead of its time, a frame leaves its follower where a copy would be.
        ahead = i >= 2 and y[i] - y[i - 1] > LONG_BEFORE_COPY * max(y[i - 1] - y[i - 2], step)
        without = np.delete(frame, i + 1), np.delete(y, i + 1)
        if ahead or -_jump_far_around(*without, i, noise_m, sign=-1) < LEAST_SHARE * step:
            return None
        return _Event("inserted", int(rows[i + 1]))
    return None


def _jump(
    frame: Floats, y: Floats, left: slice, right: slice, noise_m: float, rho: float
) -> tuple[float, float, float, _Sides] | None:
    """Jump of position between two sides of a smooth motion, its standard error, the step of one frame, the sides.

    The widest sides that follow one parabola are used. None where there are no such sides, where either moves slowly
    beside the noise, or where they move so differently that a jump cannot be told from acceleration.
    """
    for points in SIDE_POINTS:
        sides = (frame[left][-points:], y[left][-points:]), (frame[right][:points], y[right][:points])
        if min(t.size for t, _ in sides) < SIDE_POINTS[-1]:
            return None
        fit = _parabola_with_step(sides, noise_m, rho)
        if fit is not None:
            return *fit, sides
    return None


def _one_wild_point(sides: _Sides, noise_m: float) -> bool:
    """Whether one point far off explains these points about as well as a jump between the sides does.

    Both bring one number more than a plain parabola, so what they leave can be compared. Errors with heavy tails put a
    point one step ahead or behind now and then; the points behind a jump all go along.
    """
    (t_left, y_left), (t_right, y_right) = sides
    t, y = np.concatenate([t_left, t_right]), np.concatenate([y_left, y_right])
    t = t - (t_left[-1] + t_right[0]) / 2
    smooth = np.column_stack([np.ones(t.size), t, t**2])
    with_jump = _left(np.column_stack([smooth, t > 0]), y)
    with_wild = min(_left(np.delete(smooth, k, axis=0), np.delete(y, k)) for k in range(t.size))
    return with_wild < max(WILD_RATIO * with_jump, with_jump + (WILD_SIGMAS * noise_m) ** 2)


def _jump_far_around(frame: Floats, y: Floats, i: int, noise_m: float, sign: int = 1) -> float:
    """Jump between points i and i + 1 against many more points on either side, ±∞ where those cannot tell.

    They can where one cubic and a step follow all of them to within the noise: then what a few wild points near by made
    up is gone.
    """
    first = max(i + 1 - WIDE_SIDE_POINTS, 0)
    near = slice(first, i + 1 + WIDE_SIDE_POINTS)
    t, points = (frame[near] - frame[i]) / WIDE_SIDE_POINTS, y[near]
    before = i + 1 - first
    if min(before, t.size - before) < 2 * SIDE_POINTS[0]:
        return sign * math.inf
    basis = np.column_stack([np.ones(t.size), t, t**2, t**3, np.arange(t.size) >= before])
    fit = np.linalg.pinv(basis) @ points
    misfit_m = math.sqrt(float(np.sum((points - basis @ fit) ** 2)) / (t.size - 5))
    return float(fit[4]) if misfit_m < 2.5 * noise_m else sign * math.inf


def _left(basis: Floats, y: Floats) -> float:
    """Sum of squares that least squares leave."""
    return float(np.sum((y - basis @ (np.linalg.pinv(basis) @ y)) ** 2))


def _parabola_with_step(sides: _Sides, noise_m: float, rho: float) -> tuple[float, float, float] | None:
    """Jump, its error and the step of one frame, if both sides follow a parabola at a clear and similar speed."""
    (t_left, y_left), (t_right, y_right) = sides
    near_left = (y_left[-1] - y_left[-3]) / (t_left[-1] - t_left[-3])
    near_right = (y_right[2] - y_right[0]) / (t_right[2] - t_right[0])
    if min(near_left, near_right) < SLOWEST_SIDE * CLEAR_STEP_SIGMAS * noise_m or min(near_left, near_right) <= 0:
        return None
    if max(near_left, near_right) > SIMILAR_SIDES * min(near_left, near_right):
        return None
    t, y = np.concatenate([t_left, t_right]), np.concatenate([y_left, y_right])
    t = t - (t_left[-1] + t_right[0]) / 2
    basis = np.column_stack([np.ones(t.size), t, t**2, t > 0])
    weights = np.linalg.pinv(basis)
    fit = weights @ y
    misfit_m = math.sqrt(float(np.sum((y - basis @ fit) ** 2)) / (t.size - 4))
    step = float(fit[1])
    if step < CLEAR_STEP_SIGMAS * noise_m or step <= 0 or misfit_m > LARGEST_MISFIT * step + 2 * noise_m:
        return None
    lag = np.abs(np.subtract.outer(t, t))
    correlation = np.where(lag == 0, 1.0, rho ** np.maximum(lag, 0.5))
    sigma = max(noise_m, misfit_m) * math.sqrt(float(weights[3] @ correlation @ weights[3]))
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
        note = f"the frame at {at_s:.5g} s is an inserted copy: left out, later times moved back by one frame"
        return _mark(replace(track, time_s=time_s), event.row, "duplicate", note)
    time_s[event.row :] += event.missing * step_s
    note = f"{frames_are(event.missing)} missing before {at_s:.5g} s (the step there is too long): later times moved on"
    return _mark(replace(track, time_s=time_s), event.row, "gap;retimed", note)


def _mark(track: Track, row: int, flags: str, note: str) -> Track:
    """The track with flags added to one row and a sentence to its notes."""
    flag = track.flag.astype("<U80")
    flag[row] = join_flags(str(flag[row]), flags)
    return replace(track, flag=flag, notes=(*track.notes, note))
