"""The curve along which a vine grew, found from what its motion leaves behind.

A pixel that the vine covers changes once. The region of such pixels is a band; its middle, from the end that changed
first to the end that changed last, smoothed, is the path. It is taken only where far more of all change is a front that
passes once along it than along the best straight line.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.video.axis import LEAST_FRONT_SHARE, Axis, find_axis, pixels_on_front
from vinetrack.video.curved_axis import CurvedAxis, axis_through, curve_complaint
from vinetrack.video.curved_strip import front_share_on_curve
from vinetrack.video.frames import RecordingError
from vinetrack.video.small_pictures import SmallPictures

BETTER = 1.35
"""A curve that explains so many times the change that the straight line explains is taken. Measured on the clips
below: 1.7 to 1.8 along a sharp bend, 1.2 to 1.7 along a quarter of a circle (WIDER takes those below), at most 1.04
along straight vines with doors and payloads. By reasoning: at 1.1 such as have longer doors are bent, at 2 a bend
half-way is missed."""
WIDER, AS_MUCH = 1.25, 0.98
"""So is one that explains hardly less, where the straight line needs a band so many times wider. Measured, clips of
seeds 3 and 4 (straight) and 1 to 4 (bent) of `benchmarks/tracking_accuracy.py`: 1.29 to 1.37 along bends of 25 degrees,
2 and more along an S, and the curve explains at least 0.999 of what the line does; at most 1.11 along straight vines,
but for a contrast that reverses (1.20, and 0.97). At 1.1 some would be taken for bent, at 1.5 bends for straight; with
half the lack they are taken as now, with twice it a reversal of contrast is near."""
LEAST_LENGTH = 3.0
"""Length of the band in its widths from which it has a path. Chosen: a shorter one is a blot; half or twice changes
only what is hardly grown."""
MIDDLE_POWER = 3.0
"""How strongly the way through the band keeps to its middle: a step costs 1 / depth³. Chosen: at half the way cuts the
inner side of bends, at twice nothing changes."""
KNOT_WIDTHS = 1.5
"""Distance of the curve's knots in widths of the band. Chosen: shorter waves of its middle are noise of its sides; at
half they pass, at twice sharp bends are cut."""


def find_growth_axis(small: SmallPictures, luma: NDArray[Any]) -> Axis:
    """Find the axis of growth from the motion itself: a straight line, or a curve where that explains far more.

    Parameters
    ----------
    small : the pictures, shrunk.
    luma : grey levels, shape (n_frames, height, width).

    Returns
    -------
    the axis, px.

    Raises
    ------
    RecordingError
        Where nothing moves, or what moves follows neither line nor curve.
    """
    try:
        straight: Axis | None = find_axis(small)
        complaint = None
    except RecordingError as error:
        straight, complaint = None, error
    band = _band(small)
    explained = 0.0 if straight is None else front_share_of_picture(small, straight)
    wide = straight is not None and band is not None and straight.width_px > WIDER * band.width * small.factor
    # No curve can explain more than all: along a straight vine none is sought.
    curve = find_curve(small, band) if wide or explained * BETTER < 1 else None
    if curve is not None:
        enough = max(LEAST_FRONT_SHARE, explained * (AS_MUCH if wide else BETTER))
        if front_share_of_picture(small, curve) >= enough and _orderly(luma, curve):
            return curve
    if straight is None:
        assert complaint is not None
        raise complaint
    return straight


def front_share_of_picture(seen: SmallPictures, axis: Axis) -> float:
    """Share of all growth in the picture that is a front passing once along an axis, straight or curved.

    Parameters
    ----------
    seen : the small pictures.
    axis : in the picture, with its width, px.

    Returns
    -------
    0 to 1.
    """
    x, y, time, weight, n_times = seen.grown
    if len(x) < 12:
        return 0.0
    places = (np.column_stack([x, y]) + 0.5) * seen.factor - 0.5
    if isinstance(axis, CurvedAxis):
        along, across = axis.along_and_across(places)
    else:
        along, across = (places - axis.from_px) @ axis.direction, (places - axis.from_px) @ axis.normal
    band = max(0.6 * axis.width_px / seen.factor, 2.0)
    if not (np.abs(across) < band * seen.factor).any():
        return 0.0
    line = along / seen.factor, across / seen.factor, time, weight
    agree, _, _ = pixels_on_front(*line, n_times, 0.0, np.zeros(2), band)
    return float(weight[agree].sum() / weight.sum())


def find_curve(small: SmallPictures, band: Band | None = None) -> CurvedAxis | None:
    """The middle of the band that changed, from where it changed first to where it changed last.

    Parameters
    ----------
    small : the pictures, shrunk.
    band : what changed in them, where that is known already.

    Returns
    -------
    the curve with the band's width, px; None where no band is long enough.
    """
    band = band or _band(small)
    path = None if band is None else _way_through(band)
    if band is None or path is None or len(path) < LEAST_LENGTH * band.width:
        return None
    middle = _smoothed(_in_time(path, band), max(KNOT_WIDTHS * band.width, 6.0))
    if middle is None:
        return None
    size = small.shape[1], small.shape[0]
    try:
        axis = axis_through((middle + 0.5) * small.factor - 0.5, band.width * small.factor)
        axis = _with_room(axis, (3 * band.width + 12) * small.factor, size)
    except RecordingError:
        return None
    if not isinstance(axis, CurvedAxis) or curve_complaint(axis, axis.width_px / 2, size):
        return None
    return axis


@dataclass(frozen=True)
class Band:
    """What changed in the small pictures, shape (height, width) each, px of those.

    `region` is its largest part, `depth` the distance from its border, `when` the time of change, NaN where none is;
    `width` that of most of its length.
    """

    region: NDArray[np.bool_]
    depth: Floats
    when: Floats
    width: float


def _band(small: SmallPictures) -> Band | None:
    """The largest connected region that changed; None where hardly anything does."""
    from scipy.ndimage import distance_transform_edt

    x, y, time, _, _ = small.grown
    if len(x) < 12:
        return None
    when = np.full(small.frames.shape[1:], np.nan)
    when[y.astype(int), x.astype(int)] = time
    region = _largest(np.isfinite(when))
    depth = np.asarray(distance_transform_edt(np.pad(region, 1))[1:-1, 1:-1])
    half = float(np.quantile(depth[region], 0.9))
    return Band(region, depth, when, 2 * half + 1)


def _orderly(luma: NDArray[Any], curve: CurvedAxis) -> bool:
    try:
        return front_share_on_curve(luma, curve) >= LEAST_FRONT_SHARE
    except RecordingError:
        return False


def _largest(changed: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The largest connected region, its gaps closed and its threads taken off."""
    from scipy.ndimage import binary_closing, binary_fill_holes, binary_opening, label

    closed = binary_closing(np.pad(changed, 3), iterations=2)[3:-3, 3:-3]
    opened = binary_opening(binary_fill_holes(closed), iterations=1)
    parts, count = label(opened, np.ones((3, 3)))
    if count == 0:
        return changed
    return np.asarray(parts == 1 + int(np.argmax(np.bincount(parts.ravel())[1:])))


def _way_through(band: Band) -> Floats | None:
    """Pixels (x, y) of the way along the middle of a band between its two ends furthest apart, shape (n, 2)."""
    from skimage.graph import MCP_Geometric

    rows, columns = np.nonzero(band.region)
    if not rows.size:
        return None
    outside = np.full(band.region.shape, -1.0)
    even = np.where(band.region, 1.0, outside)
    start = end = int(rows[0]), int(columns[0])
    for _ in range(2):
        reached = np.where(band.region, MCP_Geometric(even).find_costs([end])[0], -1.0)
        row, column = np.unravel_index(int(np.argmax(np.where(np.isfinite(reached), reached, -1.0))), reached.shape)
        start, end = end, (int(row), int(column))
    ways = MCP_Geometric(np.where(band.region, 1 / np.maximum(band.depth, 0.5) ** MIDDLE_POWER, outside))
    ways.find_costs([start], [end])
    return np.array(ways.traceback(end), dtype=float)[:, ::-1]


def _in_time(path: Floats, band: Band) -> Floats:
    """A way turned so that what lies on it changed from its beginning to its end."""
    when = band.when[path[:, 1].astype(int), path[:, 0].astype(int)]
    seen = np.flatnonzero(np.isfinite(when))
    later = np.sum((seen - seen.mean()) * (when[seen] - when[seen].mean())) if seen.size else 0.0
    return path if later >= 0 else path[::-1]


def _smoothed(path: Floats, apart: float) -> Floats | None:
    """Knots of a penalised spline through a way of whole pixels, `apart` from each other, shape (n, 2), n ≥ 4.

    The ends of the way run into the corners of the band and are left out: half a distance of knots each. None where
    fewer than five pixels are left between them, the fewest that a cubic spline goes through.
    """
    from scipy.interpolate import make_smoothing_spline

    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))])
    inner = (along >= apart / 2) & (along <= along[-1] - apart / 2)
    if inner.sum() < 5:
        return None
    # A wave of the length of two knots' distances is damped to a half: penalty λ k⁴ = 1 at k = π / apart.
    penalty = (apart / np.pi) ** 4
    splines = [make_smoothing_spline(along[inner], path[inner, k], lam=penalty) for k in (0, 1)]
    count = max(4, round(np.ptp(along[inner]) / apart) + 1)
    at = np.linspace(along[inner][0], along[inner][-1], count)
    return np.stack([spline(at) for spline in splines], axis=1)


def _with_room(axis: Axis, room: float, size_px: tuple[int, int]) -> Axis:
    """The curve drawn out straight at both ends by `room`, as far as the picture goes."""
    if not isinstance(axis, CurvedAxis):
        return axis
    knots = list(axis.through_px)
    for end, sign in ((0.0, -1.0), (axis.length_px, 1.0)):
        ahead = axis.points(end + sign * np.arange(1.0, room + 1))
        inside = ((ahead >= 0) & (ahead <= np.array(size_px) - 1)).all(axis=1)
        count = len(ahead) if inside.all() else int(np.argmin(inside))
        if count > 6:
            place = (float(ahead[count - 1][0]), float(ahead[count - 1][1]))
            knots = [place, *knots] if sign < 0 else [*knots, place]
    return axis_through(knots, axis.width_px)
