"""Cut the strip along an axis, straight or curved; along a curve the picture is straightened by the curve's normals.

A straightened picture is a picture like any other: its middle is a level axis, its columns are one pixel of arc length
apart, and everything that works on straight strips works on it. The curve is then moved onto the middle of the tube
that grew.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.experiment.cells import SMALLEST_POINT_SPACING_PX
from vinetrack.video.axis import Axis, FrontShare, front_share
from vinetrack.video.curved_axis import CurvedAxis, axis_through, curve_problem
from vinetrack.video.frames import RecordingError
from vinetrack.video.small_pictures import SmallPictures
from vinetrack.video.still_ground import picture_shake
from vinetrack.video.strip import BAND_GAP_PX, BAND_HEIGHT_PX, Strip, cut_strip

if TYPE_CHECKING:
    from vinetrack.video.edge import Outline

KNOT_PX = 40.0  # Distance of the knots of a curve that is moved onto the middle of a tube (chosen)
STRETCH_PX = 30.0  # Length of the stretches in which the tube's middle is found along a curve (chosen)
AVERAGING_STRETCHES = 1.0  # Standard deviation, in stretches, of the Gaussian over which the tube's middle is averaged
CENTRED_PX = 0.3  # Largest distance from the tube's middle at which a curve is left unchanged (measured)
SLOW_PX_PER_RAD = 0.04  # Slow error of a position along a curve, for each radian by which the curve turns (measured)


@dataclass(frozen=True)
class StraightenedPictures:
    """Pictures along a curve: `luma`, shape (n_frames, n_across, n_along), and the level `axis` along its middle."""

    luma: NDArray[Any]
    axis: Axis


def straightened(
    luma: NDArray[Any], axis: CurvedAxis, half_px: float, shake_px: Floats | None = None
) -> StraightenedPictures:
    """Straighten pictures along a curve by bicubic interpolation. Shapes: luma (n_frames, height, width); shake_px
    (n_frames, 2).
    """
    import cv2

    above, below = (_rows_on_side(axis, half_px, side, luma.shape[1:]) for side in (-1, 1))
    n_along = int(np.floor(axis.length_px)) + 1
    rows = np.arange(-above, below + 1, dtype=float)
    source = axis.points(np.arange(n_along, dtype=float)[None, :], rows[:, None]).astype(np.float32)
    x, y = np.ascontiguousarray(source[..., 0]), np.ascontiguousarray(source[..., 1])
    out = np.empty((len(luma), len(rows), n_along), luma.dtype)
    shake = np.zeros((len(luma), 2)) if shake_px is None else shake_px
    for frame, straight, (dx, dy) in zip(luma, out, shake.astype(np.float32), strict=True):
        cv2.remap(frame, x + dx, y + dy, cv2.INTER_CUBIC, dst=straight, borderMode=cv2.BORDER_REPLICATE)
    return StraightenedPictures(out, Axis((0.0, float(above)), (n_along - 1.0, float(above)), axis.width_px))


def cut_along(luma: NDArray[Any], axis: Axis, half_px: float, before: Strip | None = None) -> Strip:
    """Cut, level and stabilise the strip about an axis, straight or curved; see `strip.cut_strip`. Shapes: luma
    (n_frames, height, width).
    """
    if not isinstance(axis, CurvedAxis):
        return cut_strip(luma, axis, half_px)
    half = min(half_px, max(axis.largest_half_px - 1, 2.0))
    shake_px = picture_shake(luma, axis, half) if before is None else before.shake_px
    straight = straightened(luma, axis, half, shake_px)
    strip = replace(cut_strip(straight.luma, straight.axis, half, still=True), axis=axis)
    return strip if shake_px is None else replace(strip, shift_px=shake_px, stabilised=True)


def path_error_px(axis: Axis) -> float:
    """Return the slow error of positions along an axis that comes from its curvature."""
    return SLOW_PX_PER_RAD * axis.total_turn_rad if isinstance(axis, CurvedAxis) else 0.0


def curve_note(axis: CurvedAxis) -> str:
    """Say that the growth axis was found to be a curve."""
    return (
        f"the vine bends by {np.degrees(axis.total_turn_rad):.0f}° in all, and positions are those along a curve that"
        " was found: look at its overlay, and draw the curve (column `axis`) if the edge is not on it"
    )


def shake_along(strip: Strip, edge_px: Floats) -> Floats:
    """Return how far a shaken camera moved each picture along the axis, at the edge. Shapes: edge_px (n_frames,) →
    (n_frames,).
    """
    if not isinstance(strip.axis, CurvedAxis):
        return strip.shift_px[:, 0]
    place_px = np.where(np.isfinite(edge_px), edge_px, 0.5 * strip.axis.length_px)
    return np.asarray(np.sum(strip.shift_px * strip.axis.direction_at(place_px), axis=1))


def front_share_on_curve(luma: NDArray[Any], axis: CurvedAxis) -> float:
    """Share of the change along a curve that is one front passing once; see `axis.front_share`. Shapes: luma (n_frames,
    height, width).
    """
    straight = straightened(luma, axis, min(axis.width_px, max(axis.largest_half_px - 1, 2.0)))
    return front_share(SmallPictures(straight.luma), straight.axis)


def front_share_function(small: SmallPictures, luma: NDArray[Any]) -> FrontShare:
    """Return the function from an axis to its front share, for straight and curved axes. Shapes: luma (n_frames,
    height, width).
    """
    return lambda axis: front_share_on_curve(luma, axis) if isinstance(axis, CurvedAxis) else front_share(small, axis)


def check_curve(axis: Axis, half_px: float, shape: tuple[int, ...]) -> None:
    """Refuse a curve that leaves the picture or bends more sharply than its strip is wide."""
    complaint = curve_problem(axis, half_px, (shape[1], shape[0]))
    if complaint is not None:
        raise RecordingError(f"the growth axis {complaint[0]}; {complaint[1]}")


def outline_stretches(axis: Axis) -> int:
    """Number of stretches in which the sides of a tube are found."""
    return max(12, round(axis.length_px / STRETCH_PX)) if isinstance(axis, CurvedAxis) else 12


def recentred_curve(axis: CurvedAxis, sides: Outline) -> tuple[CurvedAxis, float]:
    """Move a curve onto the middle of the tube, and measure how far that lies from it. Returns curve, with the tube's
    width; the given one where the tube's middle makes none that a strip can be cut along., distance.
    """
    knots = np.linspace(0.0, axis.length_px, max(4, round(axis.length_px / KNOT_PX) + 1))
    offsets = _local_lines(sides.places_px, sides.middles_px, knots)
    through = axis.points(knots, offsets)
    separate = [
        0,
        *(k for k in range(1, len(through)) if np.hypot(*(through[k] - through[k - 1])) > SMALLEST_POINT_SPACING_PX),
    ]
    try:
        curve = axis_through(through[separate], 2 * sides.half_px)
    except RecordingError:
        return axis, 0.0
    if not isinstance(curve, CurvedAxis) or sides.half_px > curve.largest_half_px:
        return axis, 0.0
    return curve, float(np.abs(offsets).max())


def _local_lines(places: Floats, middles: Floats, queries: Floats) -> Floats:
    """Middle of the tube at places along it, by Gaussian-weighted local lines; level beyond the outermost stretches."""
    spacing = float(np.median(np.diff(places))) if len(places) > 1 else STRETCH_PX
    queries = np.clip(queries, places[0], places[-1])
    out = np.empty(len(queries))
    for k, place in enumerate(queries):
        offset = (places - place) / (AVERAGING_STRETCHES * spacing)
        weight = np.exp(-0.5 * offset**2)
        design = np.column_stack([np.ones(len(places)), offset])
        moments = (design.T * weight) @ design + np.diag([0.0, 1e-3 * weight.sum()])
        out[k] = np.linalg.solve(moments, (design.T * weight) @ middles)[0]
    return out


def _rows_on_side(axis: CurvedAxis, half_px: float, side: int, shape: tuple[int, ...]) -> int:
    """Rows on one side: those wanted, and as many more as stay in the picture along the whole curve, uncrossed."""
    wanted = int(np.ceil(half_px))
    most = min(wanted + BAND_GAP_PX + BAND_HEIGHT_PX[1], int(axis.largest_half_px))
    along = np.linspace(0.0, axis.length_px, int(axis.length_px) + 2)
    for reach in range(most, wanted, -1):
        place = axis.points(along, side * float(reach))
        if ((place > -0.5) & (place < [shape[1] - 0.5, shape[0] - 0.5])).all():
            return reach
    return wanted
