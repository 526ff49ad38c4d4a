"""Quality of each point of a track: release, end, lost and doubtful points.

Works on positions alone, in pixels by frame, from any tracker.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Bools, Floats, Indices, join_flags
from vinetrack.tracks.position_noise import FOURTH_DIFFERENCE, rest_points

LOST_SIGMA_PX = 4.0  # A point with a larger standard error counts as lost (chosen)

REST_SIGMAS, REST_PX, END_REST_PX = 3.0, 0.4, 0.25  # An edge is at rest while it stays this near to its level (chosen)


@dataclass(frozen=True)
class PointQuality:
    """Flag of every frame, and sentences for a person. `flag` and `without_edge` have shape (n_frames,)."""

    flag: NDArray[np.str_]
    notes: tuple[str, ...]
    first_moving: int
    last_moving: int
    left_picture: int | None
    without_edge: Bools


def calibrated_sigma(edge_px: Floats, sigma_px: Floats) -> Floats:
    """Scale the stated errors to the roughness of the track in motion. Fourth differences cancel any cubic motion and
    have the variance Σ c² σ², c = (1, −4, 6, −4, 1). The factor is their median size in units of that standard
    deviation; it stays 1 where there are fewer than eight. Shapes: edge_px, sigma_px (n_frames,) → (n_frames,).
    """
    windows = np.lib.stride_tricks.sliding_window_view
    difference = windows(edge_px, 5) @ FOURTH_DIFFERENCE
    expected = np.sqrt(windows(sigma_px**2, 5) @ FOURTH_DIFFERENCE**2)
    # 0.3: step of a frame from which the frame counts for the roughness of the track (chosen)
    use = (np.gradient(edge_px) > 0.3) & np.isfinite(edge_px)
    inside = windows(use, 5).all(axis=1) & np.isfinite(difference) & (expected > 0)
    if inside.sum() < 8:
        return sigma_px
    factor = 1.4826 * float(np.median(np.abs(difference[inside] / expected[inside])))
    return sigma_px * float(np.clip(factor, 0.5, 6.0))  # 0.5, 6.0: least and largest factor (chosen)


def moving_range(edge_px: Floats, sigma_px: Floats) -> tuple[int, int]:
    """First and last moving frame; (0, n − 1) if the edge never rests, (n, −1) if it never moves. At rest means: over
    three frames or more, within three standard errors of the resting level (REST_PX at least; END_REST_PX at the end,
    where a creeping stop must still show).
    """
    good = np.flatnonzero(np.isfinite(edge_px))
    n = len(edge_px)
    if len(good) < 3:
        return n, -1
    y, noise = edge_px[good], float(np.nanmedian(sigma_px[good]))
    low, high = float(np.median(y[:3])), float(np.median(y[-3:]))
    # 2.0: least travel that counts as motion (chosen)
    if high - low < max(2 * REST_SIGMAS * noise, 2.0):
        return n, -1
    first = _first_moving_point(y, max(REST_SIGMAS * noise, REST_PX))
    tolerance = max(REST_SIGMAS * noise, END_REST_PX)
    last = len(y) - 1 - _first_moving_point(-y[::-1], tolerance)
    steps = np.diff(y[-7:])
    # 5.0: ratio of the steps to the tolerance above which a fast edge that stands still in the last two frames stops,
    # though elsewhere two equal positions are no rest (chosen); the step before may be shorter than a whole one
    if last == len(y) - 1 and len(steps) == 6 and abs(steps[-1]) <= tolerance < steps[:-2].min() / 5.0:
        last -= 2
    return int(good[first]), int(good[max(last, first)])


def _first_moving_point(y: Floats, tolerance: float) -> int:
    """First of two points in a row above the resting level, which has three; 0 where the track starts in motion."""
    above = y - np.median(y[: max(rest_points(y), 3)]) > tolerance
    first = int(np.argmax(np.append(above & np.append(above[1:], True), True)))
    return first if first > 2 else 0


def assess_points(edge_px: Floats, sigma_px: Floats, number: Indices, *, unsure: Bools, end_px: float) -> PointQuality:
    """Flag every frame. Arrays have shape (n_frames,)."""
    n = len(edge_px)
    no_edge = ~np.isfinite(edge_px) | ~(sigma_px < LOST_SIGMA_PX)
    outside = np.flatnonzero(np.isfinite(edge_px) & (edge_px >= end_px))
    first_outside = int(outside[0]) if len(outside) else n
    y = np.where(no_edge | (np.arange(n) >= first_outside), np.nan, edge_px)
    first, last = moving_range(y, sigma_px)
    notes = []
    if first_outside < n:
        notes.append(f"the leading edge leaves the picture at frame {number[first_outside]}; later frames are not used")
    without_edge = no_edge & (np.arange(n) < first_outside)
    flags = [
        join_flags(
            "before_release" if i < first else "",
            "after_end" if i > last >= 0 or i >= first_outside else "",
            "lost" if without_edge[i] else "",
            "doubtful" if unsure[i] and not no_edge[i] else "",
        )
        for i in range(n)
    ]
    lost_in_motion = no_edge & (np.arange(n) >= first) & (np.arange(n) <= last)
    if lost_in_motion.any():
        count, first_lost = int(lost_in_motion.sum()), number[lost_in_motion][0]
        notes.append(f"the leading edge is lost in {count} moving frames, first frame {first_lost}")
    return PointQuality(
        np.array(flags, dtype=np.str_), tuple(notes), first, last,
        first_outside if first_outside < n else None, without_edge,
    )  # fmt: skip


# ------------------------------------------------------------------------------
# Where growth ends though something flies on, and why a motion ended, in words.
#
# A payload in free flight leaves background behind it; film stays. A motion ends when the whole vine has grown, when
# an obstacle stops it, or when the recording ends.


@dataclass(frozen=True)
class Ending:
    """How an edge ends: its way from standstill to standstill, and until the last frame where it still moves there, px
    (NaN otherwise); and a `remark` on where it stopped.
    """

    grown_px: float = math.nan
    truncated_px: float = math.nan
    remark: str = ""
    name: str = ""

    def notes(self, length_px: float) -> list[str]:
        """What a track is told about its end; nothing where most of the vine has grown."""
        # 0.9: most of the length in the sheet, which may count what is clamped; 1.03: more than the vine has (chosen)
        if 0.9 < np.fmax(self.grown_px, self.truncated_px) / length_px < 1.03:
            return []
        share = f", after {self.truncated_px / length_px:.0%} of the vine's length" if np.isfinite(length_px) else ""
        moves = f"{self.name}: the recording ends while the leading edge moves{share}"
        return [note for note in (self.remark, moves if np.isfinite(self.truncated_px) else "") if note]


def ending_of(quality: PointQuality, edge_px: Floats, name: str, number: Indices, whole: bool) -> Ending:
    """How an edge that moved ends; only a `whole` recording can be truncated. Shapes: edge_px, number (n_frames,)."""
    start, end = edge_px[: quality.first_moving], edge_px[quality.last_moving + 1 :]
    both = np.isfinite(start).any() and np.isfinite(end).any()
    grown_px, truncated_px = float(np.nanmedian(end) - np.nanmedian(start)) if both else math.nan, math.nan
    followed = np.flatnonzero(np.isfinite(edge_px))
    if whole and quality.last_moving >= followed[-1] and quality.left_picture is None:
        at_first = np.median(edge_px[followed][: max(quality.first_moving, 1)])
        truncated_px = float(edge_px[followed[-1]]) - float(at_first)
    remark, n, last = "", len(edge_px), quality.last_moving
    # 4: fewest frames of standstill at the end that are reported (chosen)
    if 0 <= last < n - 4 and quality.left_picture is None:
        resting = edge_px[last + 1 :][np.isfinite(edge_px[last + 1 :])]
        where = f"stops at {np.median(resting):.0f} px" if resting.size else "is not seen"
        why = f"{n - 1 - last} frames before the recording ends: grown to its end, held, or off the axis"
        remark = f"{name}: the leading edge {where} after frame {number[last]}, {why}"
    return Ending(grown_px, truncated_px, remark, name)
