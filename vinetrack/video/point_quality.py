"""What each point of a track is worth: release, end, lost and doubtful points, frames repeated or missing.

Works on positions alone, in pixels by frame; who measured them does not matter.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Bools, Floats, Indices, join_flags
from vinetrack.tracks.step_gaps import count_missing

LOST_SIGMA_PX = 4.0
"""A point known no better than this is no point. Chosen: about a millimetre at the usual 3 px/mm. At half blurred
frames are lost; at twice they stay and hardly weigh."""
FLOOR_PX = 0.04
"""Errors that all rows share (blur, exposure, level) show neither as roughness nor between bands. Chosen between 0.03
and 0.06 px, which they came to. At half good frames state errors that are too small, at twice too large."""

FEWEST_DIFFERENCES, SMALLEST_FACTOR, LARGEST_FACTOR = 8, 0.5, 6.0
"""Fourth differences that tell of the roughness, and the factor of errors at least and at most. Chosen: the median of
eight is known to a third, and beyond six the motion is no smooth one. By reasoning: half or twice changes stated errors
of short and of rough tracks alone."""
LARGEST_BODY_FACTOR = 20.0
"""The same of a body that is matched with itself, whose likelihood knows nothing of pixels between pixels. Measured: 5
to 14 on rendered balls (tuning seeds 1 and 2). By reasoning: at half errors of bright balls are a third too small."""
REST_SIGMAS, REST_PX, END_REST_PX = 3.0, 0.4, 0.25
"""An edge stands that stays this near to its level, in standard errors and in px at the start and at the end. Chosen:
one point of 370 by chance; ringing of coders moves an edge by some tenths of a pixel. By reasoning: at half coders'
ringing releases the vine; at twice slow starts are cut by as much."""
STOPS_DEAD = 5.0
"""Steps so many times the tolerance of rest after which a last frame without a step shows a stop, though two places
alike are no rest elsewhere. Chosen: growth that slows down takes frames for it. By reasoning: at half slow growth that
pauses in the last frame is cut by two points, at twice an edge that stopped from 1 to 2 px a frame keeps them."""
LEAST_TRAVEL_PX = 2.0
"""Travel from which something moves at all. Chosen: five times REST_PX. By reasoning: at half drift of a camera counts
as growth, at twice hardly any recording is refused more."""
OFF_SIGMAS, OFF_PX = 6.0, 1.0
"""Distance from the curve of its neighbours, in standard errors and px, from which a point has another cause. Chosen:
far beyond chance, and a pixel is 25 times FLOOR_PX. By reasoning: at half film's texture makes points doubtful, at
twice an edge at the far side of a door does not."""
OFF_SPREAD = 1.4
"""Standard deviation of a point against a parabola through its four neighbours. Derived: √(1 + 34/36) for equal errors,
the weights being −1, 4, 4, −1 sixths."""
LEAPS, LEAP_PX = 1.2, 0.5
"""A first step so many times the mean of the next two, and so much more, shows that the tip was not where it seemed to
rest. Chosen: from rest the first step is the shortest. By reasoning: near 1 noise decides; at twice the tip may have
come from a step further back unseen."""
AHEAD_PART, AHEAD_ROUGH = 0.5, 4.0
"""A last step longer than the line through the two before it by this part of a step, and so many times the roughness
there, is something that flies on. Chosen: a payload leaves at twice the speed of the edge, one step more. By reasoning:
at half a kick at the stop counts, at twice payloads pass."""


@dataclass(frozen=True)
class PointQuality:
    """Flags (n_frames,), time slots (n_frames,) with missing frames counted in, and sentences for a person.

    `departure_px`, shape (n_frames,), is how far a point lies off its neighbours' curve where no error explains it;
    `unseen` marks frames without an edge, and from frame `left_picture` on the edge is outside, None where it stays.
    Frames count among those that were followed; in `notes` they are those of the recording.
    """

    flag: NDArray[np.str_]
    slot: Indices
    notes: tuple[str, ...]
    first_moving: int
    last_moving: int
    left_picture: int | None
    unseen: Bools
    departure_px: Floats


def calibrated_sigma(edge_px: Floats, sigma_px: Floats, use: Bools, *, largest: float = LARGEST_FACTOR) -> Floats:
    """Stated errors scaled to the roughness of the track itself, shape (n_frames,).

    Fourth differences cancel any cubic motion and have variance Σ c² σ², c = (1, −4, 6, −4, 1). Their median size in
    units of the stated errors is the factor, left at 1 where fewer than FEWEST_DIFFERENCES exist.

    Parameters
    ----------
    edge_px, sigma_px : positions and stated errors, shape (n_frames,), px; NaN where the edge was not found.
    use : mask of the frames that count, shape (n_frames,).
    largest : factor at most; SMALLEST_FACTOR at least.

    Returns
    -------
    standard errors, shape (n_frames,), px.
    """
    weights = np.array([1.0, -4.0, 6.0, -4.0, 1.0])
    if len(edge_px) < 5:
        return sigma_px
    windows = np.lib.stride_tricks.sliding_window_view
    difference = windows(edge_px, 5) @ weights
    expected = np.sqrt(windows(sigma_px**2, 5) @ weights**2)
    inside = windows(use, 5).all(axis=1) & np.isfinite(difference) & (expected > 0)
    if inside.sum() < FEWEST_DIFFERENCES:
        return sigma_px
    factor = 1.4826 * float(np.median(np.abs(difference[inside] / expected[inside])))
    return sigma_px * float(np.clip(factor, SMALLEST_FACTOR, largest))


def moving_range(edge_px: Floats, sigma_px: Floats) -> tuple[int, int]:
    """First and last frame in which the edge is on its way; (0, n − 1) if it never rests, (n, −1) if it only rests.

    At rest means: within three sigma, at least REST_PX (END_REST_PX at the end, where a creeping stop still tells), of
    the level that it keeps up to, or from, there, over three frames; over two where a recording ends upon a dead
    stop.

    Parameters
    ----------
    edge_px, sigma_px : positions and their errors, shape (n_frames,), px; NaN where the edge was not found.

    Returns
    -------
    first and last frame.
    """
    good = np.flatnonzero(np.isfinite(edge_px))
    n = len(edge_px)
    if len(good) < 3:
        return n, -1
    y, noise = edge_px[good], float(np.nanmedian(sigma_px[good]))
    low, high = float(np.median(y[:3])), float(np.median(y[-3:]))
    if high - low < max(2 * REST_SIGMAS * noise, LEAST_TRAVEL_PX):
        return n, -1
    first = _leaves_level(y, max(REST_SIGMAS * noise, REST_PX))
    stands = max(REST_SIGMAS * noise, END_REST_PX)
    last = len(y) - 1 - _leaves_level(-y[::-1], stands)
    if last == len(y) - 1 and _stops_dead(y, stands):
        last -= 2
    return int(good[first]), int(good[max(last, first)])


def _leaves_level(y: Floats, tolerance: float) -> int:
    """Index of the first point from which on `y` stays above the level of those before it; 0 where none rest."""
    level = float(y[0])
    last_at_rest = 0
    for i in range(1, len(y)):
        if y[i] - level <= tolerance:
            last_at_rest = i
            level = float(np.median(y[: last_at_rest + 1]))
        elif i + 1 >= len(y) or y[i + 1] - level > tolerance:
            break
    # Two frames alike may be a slow start; a rest has three.
    return last_at_rest + 1 if last_at_rest >= 2 else 0


def _stops_dead(y: Floats, tolerance: float) -> bool:
    """Whether a fast edge stands in the last two frames; the step onto its place may be a part of one."""
    steps = np.diff(y[-7:])
    return len(steps) == 6 and abs(steps[-1]) <= tolerance and float(steps[:-2].min()) > STOPS_DEAD * tolerance


def assess_points(
    edge_px: Floats,
    sigma_px: Floats,
    slot: Indices,
    number: Indices,
    *,
    unsure: Bools,
    repeated: Bools,
    end_px: float,
) -> PointQuality:
    """Flag every frame and mend the times.

    Parameters
    ----------
    edge_px, sigma_px : shape (n_frames,), px; NaN where the edge was not found.
    slot : capture periods from the first frame, shape (n_frames,).
    number : of each frame in the recording, shape (n_frames,).
    unsure, repeated : masks (n_frames,): a poor fit, a picture like the one before it.
    end_px : where the strip ends: an edge beyond it has left the picture.

    Returns
    -------
    PointQuality
    """
    n = len(edge_px)
    no_edge = ~np.isfinite(edge_px) | ~(sigma_px < LOST_SIGMA_PX)
    gone = np.flatnonzero(np.isfinite(edge_px) & (edge_px >= end_px))
    left = int(gone[0]) if len(gone) else n
    y = np.where(no_edge | (np.arange(n) >= left), np.nan, edge_px)
    first, last = moving_range(y, sigma_px)
    missing = count_missing(y, sigma_px, slot, number, repeated, (first, last))
    notes = list(missing.notes)
    if left < n:
        notes.append(f"the leading edge leaves the picture at frame {number[left]}; later frames are not used")
    copies = repeated & (np.arange(n) > first) & (np.arange(n) <= last)
    if copies.any():
        which = number[copies][0]
        notes.append(f"{int(copies.sum())} frames repeat the one before them and are dropped, first frame {which}")
    departure = _departures(y, sigma_px, first, last)
    outlying = departure > 0
    unseen = no_edge & (np.arange(n) < left)
    flags = [
        join_flags(
            "before_release" if i < first else "",
            "after_end" if i > last >= 0 or i >= left else "",
            "lost" if unseen[i] else "",
            "duplicate" if copies[i] else "",
            "gap" if missing.gap[i] else "",
            "retimed" if missing.retimed[i] else "",
            "doubtful" if (unsure[i] or outlying[i]) and not no_edge[i] else "",
        )
        for i in range(n)
    ]
    astray = no_edge & (np.arange(n) >= first) & (np.arange(n) <= last)
    if astray.any():
        notes.append(f"the leading edge is lost in {int(astray.sum())} moving frames, first frame {number[astray][0]}")
    return PointQuality(
        np.array(flags, dtype=np.str_), missing.slot, tuple(notes), first, last, left if left < n else None, unseen,
        departure,
    )  # fmt: skip


def _departures(y: Floats, sigma_px: Floats, first: int, last: int) -> Floats:
    """Distance of moving points from a parabola through their two neighbours on each side, shape (n_frames,), px.

    Zero where it is less than OFF_SIGMAS or OFF_PX. At the start, where a door may hide the tip at rest: by how much
    the first step is longer than those that follow. At the end, where something may fly on: from the line through the
    two points before.
    """
    out = np.zeros(len(y))
    for i in range(max(first, 2), min(last, len(y) - 1) - 1):  # a dead stop is no departure
        around = y[[i - 2, i - 1, i + 1, i + 2]]
        if not np.all(np.isfinite(around)) or not np.isfinite(y[i]):
            continue
        expected = (-around[0] + 4 * around[1] + 4 * around[2] - around[3]) / 6
        bend = abs(around[0] - 2 * around[1] + 2 * around[2] - around[3])
        spread = OFF_SPREAD * float(np.max(sigma_px[i - 2 : i + 3]))
        far = abs(y[i] - expected)
        out[i] = far if far > max(OFF_SIGMAS * spread, OFF_PX, bend) else 0.0
    for i in range(max(first - 1, 1), min(first + 2, len(y) - 2)):
        leap, later = y[i] - y[i - 1], 0.5 * (y[i + 2] - y[i])
        if np.isfinite(leap - later) and leap > LEAPS * later + max(sigma_px[i], LEAP_PX):
            out[:i] = np.maximum(out[:i], leap - 0.5 * later)
    for i in range(max(first + 4, last - 2), last + 1):
        before = y[i - 4 : i]
        ahead = y[i] - 2 * before[-1] + before[-2]
        roughness = float(np.max(np.abs(np.diff(before, 2))))
        if np.isfinite(ahead) and ahead > max(
            OFF_SIGMAS * sigma_px[i], 2 * OFF_PX, AHEAD_PART * (before[-1] - before[-2]), AHEAD_ROUGH * roughness
        ):
            out[i : last + 1] = np.maximum(out[i : last + 1], ahead)
    return out
