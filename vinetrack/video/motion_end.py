"""Say why a motion ended: the whole vine has grown, an obstacle stopped it, or the recording ended first."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.video.point_quality import PointQuality

if TYPE_CHECKING:
    from vinetrack.video.body import BodyEnd

GROWN_TOLERANCE = 0.03
"""Relative difference of travel and length within which the whole vine has grown. Chosen: lengths are cut to a few
millimetres in 20 cm, and scales err by a per cent. At half, complete growths go unrecognised; at twice, a stop just
before the end counts as one."""
FEWEST_STILL_FRAMES = 4
"""Fewest frames of standstill at the end that are reported. Chosen; at half, two equal frames are reported."""
CHANGING_PART = 0.3
"""Change of the pictures after the stop, as a part of that in motion, above which the picture goes on changing. Chosen
between noise, 0, and motion, 1. At half, a hand that lets go counts; at twice, only film that goes on sliding does."""


def is_grown(edge_px: Floats, quality: PointQuality, length_px: float) -> bool:
    """Whether the edge stops where the whole vine has grown; False where its length or its rest is unknown.

    Parameters
    ----------
    edge_px : along the axis, shape (n_frames,), px.
    quality : which frames it moves in.
    length_px : of the vine; NaN where unknown.

    Returns
    -------
    whether it has.
    """
    if quality.last_moving < 0 or not np.isfinite(length_px):
        return False
    start, end = edge_px[: quality.first_moving], edge_px[quality.last_moving + 1 :]
    if not (np.isfinite(start).any() and np.isfinite(end).any()):
        return False
    return bool(abs((np.nanmedian(end) - np.nanmedian(start)) / length_px - 1) < GROWN_TOLERANCE)


def body_end_note(end: BodyEnd, number: NDArray[np.int_]) -> str:
    """Say why a body is not followed to the end of the recording.

    Parameters
    ----------
    end : what ends it, and its last frame.
    number : of each frame in the recording, shape (n_frames,).

    Returns
    -------
    the sentence.
    """
    frame = number[end.last_frame]
    if end.turns_back:
        return f"the body turns back after frame {frame}: a bounce, or the end of its motion; later frames are not used"
    return f"the body is not recognised after frame {frame}: it is gone, hidden or turned over"


def growth_end_notes(
    luma: NDArray[Any], quality: PointQuality, edge_px: Floats, name: str, number: NDArray[np.int_]
) -> list[str]:
    """Say why the edge stops before the recording does.

    Parameters
    ----------
    luma : brightness, shape (n_frames, height, width).
    quality : which frames the edge moves in.
    edge_px : along the axis, shape (n_frames,), px.
    name : of the recording.
    number : of each frame in the recording, shape (n_frames,).

    Returns
    -------
    a sentence, or none.
    """
    n, last = len(edge_px), quality.last_moving
    if last < 0 or last >= n - FEWEST_STILL_FRAMES or quality.left_picture is not None:
        return []
    import cv2

    pairs = itertools.pairwise(np.ascontiguousarray(luma[:, ::3, ::3]))
    change = np.array([cv2.absdiff(a, b).mean() for a, b in pairs])
    before = float(np.median(change[quality.first_moving : last])) if last > quality.first_moving else 0.0
    least = float(np.min(change)) if len(change) else 0.0
    later = float(np.median(change[last + 1 :]))
    resting = edge_px[last + 1 :][np.isfinite(edge_px[last + 1 :])]
    if not resting.size:
        return [f"{name}: the leading edge is not seen after frame {number[last]}"]
    where = f"{name}: the leading edge stops at {np.median(resting):.0f} px after frame {number[last]}"
    if later - least > CHANGING_PART * (before - least):
        return [f"{where} while the picture goes on changing: it met a wall or another obstacle, or left the axis"]
    return [f"{where}, {n - 1 - last} frames before the recording ends: grown to its end, or held"]


def truncation_notes(edge_px: Floats, quality: PointQuality, length_px: float, name: str) -> list[str]:
    """Say that the recording ends while the edge is moving.

    Parameters
    ----------
    edge_px : along the axis, shape (n_frames,), px.
    quality : which frames it moves in.
    length_px : of the vine; NaN where unknown.
    name : of the recording.

    Returns
    -------
    a sentence, or none.
    """
    followed = np.flatnonzero(np.isfinite(edge_px))
    if quality.last_moving < followed[-1] or quality.left_picture is not None:
        return []
    travel_px = edge_px[followed[-1]] - float(np.median(edge_px[followed][: max(quality.first_moving, 1)]))
    share = f", after {travel_px / length_px:.0%} of the vine's length" if np.isfinite(length_px) else ""
    return [f"{name}: the recording ends while the leading edge moves{share}"]
