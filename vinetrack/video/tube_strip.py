"""The strip about the tube: centred on what the front left behind, and whether that is a tube along the axis at all."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from vinetrack.video.axis import LEAST_FRONT_SHARE, Axis, FrontShare
from vinetrack.video.curved_axis import CurvedAxis
from vinetrack.video.curved_strip import SETTLED_PX, cut_along, outline_stretches, recentred_curve
from vinetrack.video.edge import Outline, outline
from vinetrack.video.frames import RecordingError
from vinetrack.video.strip import Strip, recut, squared

CENTRINGS = 3
"""Times the strip may be cut anew: what lay outside the first shows only in the second. Chosen; it is cut anew only
while the axis moves by more than OFF_CENTRE_PX, so that more cost little."""
OFF_CENTRE_PX = 0.8
"""Tilt of the axis, over its length, or shift that is left alone: the tip's rows then lag by under a tenth of it.
Chosen; at half the strip is cut once more, at twice rows lag by up to 0.16 px."""


def tube_strip(luma: NDArray[Any], axis: Axis, order: FrontShare) -> tuple[Strip, Outline] | None:
    """Cut the strip about the tube that grows along an axis.

    Sides of what a front left behind are found for anything that changes in order. Where it is no tube, they lie
    nowhere in particular, and the strip is centred on nothing: no front passes along its axis.

    Parameters
    ----------
    luma : brightness, shape (n_frames, height, width).
    axis : roughly along the tube, with a width that holds it, px.
    order : share of what changes along an axis that is a front passing once, see `axis.front_share`.

    Returns
    -------
    the strip, centred on the tube, and the tube's outline in it; None where no one front passes along the axis, or none
    along the middle of what it leaves behind.

    Raises
    ------
    ValueError
        Where nothing in the strip changes as a passing front does.
    """
    if order(axis) < LEAST_FRONT_SHARE:
        return None
    strip = first = cut_along(luma, squared(axis), 0.65 * axis.width_px + 3)
    sides = outline(strip, outline_stretches(axis))
    try:
        for _ in range(2 * CENTRINGS if axis.bends else CENTRINGS):
            before, strip = strip, centred(luma, strip, sides)
            if strip is before:
                break
            sides = outline(strip, outline_stretches(axis))
        astray = strip is not first and order(strip.axis) < LEAST_FRONT_SHARE
    except (RecordingError, ValueError):
        return None
    return None if astray else (strip, sides)


def centred(luma: NDArray[Any], strip: Strip, sides: Outline) -> Strip:
    """The strip about the tube's own centreline; the same one where it is centred already.

    A given axis keeps its ends' places along itself: only what lies across is corrected.

    Parameters
    ----------
    luma : brightness, shape (n_frames, height, width).
    strip : cut from it.
    sides : of the tube in that strip.

    Returns
    -------
    the strip.
    """
    shift, slope, half = sides.shift_px, sides.slope, sides.half_px
    room = (strip.values.shape[1] - 1) / 2 - half - 3
    if isinstance(strip.axis, CurvedAxis):
        curve, away = recentred_curve(strip.axis, sides)
        if away < SETTLED_PX and 0 <= room < 0.3 * half + 6:
            return strip
        return cut_along(luma, curve, half * 1.15 + 5, strip)
    tilt = slope * strip.axis.length_px
    middle = shift + tilt / 2
    if abs(middle) + abs(tilt) / 2 < OFF_CENTRE_PX and 0 <= room < 0.3 * half + 6:
        return strip
    start = strip.axis.points(np.array(0.0), shift)
    stop = strip.axis.points(np.array(strip.axis.length_px), shift + tilt)
    turned = Axis((float(start[0]), float(start[1])), (float(stop[0]), float(stop[1])), 2 * half)
    return recut(strip, luma, squared(turned), half * 1.15 + 5)
