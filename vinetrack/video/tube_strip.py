"""Cut the strip about a tube, centred on what its front left behind; decide whether a tube lies along the axis."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from vinetrack.video.axis import LEAST_FRONT_SHARE, Axis, FrontShare
from vinetrack.video.curved_axis import CurvedAxis
from vinetrack.video.curved_strip import CENTRED_PX, cut_along, outline_stretches, recentred_curve
from vinetrack.video.edge import Outline, outline
from vinetrack.video.frames import RecordingError
from vinetrack.video.strip import Strip, recut, snap_to_grid

MOST_RECUTS = 3  # Most times that the strip is cut anew: what lay outside the first shows only in the second (chosen)
# Part of its width by which an axis may slope over its length for the first strip to be cut along whole rows or columns
# (chosen)
FIRST_SLOPE = 0.08
OFF_CENTRE_PX = 0.8  # Tilt of the axis over its length, or shift, that is left uncorrected (chosen)


def tube_strip(luma: NDArray[Any], axis: Axis, front_share_of: FrontShare) -> tuple[Strip, Outline] | None:
    """Cut the strip about the tube that grows along an axis. An outline is found for anything that changes in order.
    Where that is no tube, the outline is arbitrary and no front passes along its middle, which the front share along
    the middle shows. Returns the strip, centred on the tube, and the tube's outline in it; None where no single front
    passes along the axis, or, none along the middle of what it leaves behind.. Shapes: luma (n_frames, height, width).
    """
    if front_share_of(axis) < LEAST_FRONT_SHARE:
        return None
    strip = first = cut_along(luma, snap_to_grid(axis, FIRST_SLOPE * axis.width_px), 0.65 * axis.width_px + 3)
    tube = outline(strip, outline_stretches(axis))
    try:
        for _ in range(2 * MOST_RECUTS if axis.bends else MOST_RECUTS):
            before, strip = strip, recentred_strip(luma, strip, tube)
            if strip is before:
                break
            tube = outline(strip, outline_stretches(axis))
        off_tube = strip is not first and front_share_of(strip.axis) < LEAST_FRONT_SHARE
    except (RecordingError, ValueError):
        return None
    return None if off_tube else (strip, tube)


def recentred_strip(luma: NDArray[Any], strip: Strip, tube: Outline) -> Strip:
    """Cut the strip anew about the tube's centreline; the same strip where it is centred already. The ends of a given
    axis keep their places along it: only the position across is corrected. Shapes: luma (n_frames, height, width).
    """
    shift, slope, half = tube.shift_px, tube.slope, tube.half_px
    room = (strip.values.shape[1] - 1) / 2 - half - 3
    if isinstance(strip.axis, CurvedAxis):
        curve, distance = recentred_curve(strip.axis, tube)
        if distance < CENTRED_PX and 0 <= room < 0.3 * half + 6:
            return strip
        return cut_along(luma, curve, half * 1.15 + 5, strip)
    tilt = slope * strip.axis.length_px
    middle = shift + tilt / 2
    if abs(middle) + abs(tilt) / 2 < OFF_CENTRE_PX and 0 <= room < 0.3 * half + 6:
        return strip
    start = strip.axis.points(np.array(0.0), shift)
    stop = strip.axis.points(np.array(strip.axis.length_px), shift + tilt)
    turned = Axis((float(start[0]), float(start[1])), (float(stop[0]), float(stop[1])), 2 * half)
    return recut(strip, luma, snap_to_grid(turned), half * 1.15 + 5)
