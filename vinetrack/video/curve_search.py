"""Find the curve along which a vine grew, from the region of pixels that changed.

A pixel that the vine covers changes once. The region of such pixels is a band; its smoothed middle, from the end that
changed first to the end that changed last, is the path. The curve is used only where its front share is far larger than
that of the best straight line.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.video.axis import LEAST_FRONT_SHARE, Axis, find_axis, pixels_on_front
from vinetrack.video.curved_axis import CurvedAxis, axis_through, curve_problem
from vinetrack.video.curved_strip import front_share_on_curve
from vinetrack.video.frames import RecordingError
from vinetrack.video.small_pictures import SmallPictures

# Ratio of the front share of a curve to that of the straight line from which the curve is used (measured)
CURVE_GAIN = 1.35
# A curve is also used where the straight line needs a band this many times wider and the curve explains at least
# EQUAL_SHARE of what the line does (measured)
BAND_RATIO, EQUAL_SHARE = 1.25, 0.98
LEAST_LENGTH = 3.0  # Least length of the band, in its widths, that has a path (chosen)
CENTRING_POWER = 3.0  # How strongly the path through the band keeps to its middle: a step costs 1 / depth³ (chosen)
KNOT_WIDTHS = 1.5  # Distance of the curve's knots in widths of the band (chosen)


def find_growth_axis(small: SmallPictures, luma: NDArray[Any]) -> Axis:
    """Find the growth axis from the motion: a straight line, or a curve where that explains far more of the change.
    Shapes: luma (n_frames, height, width).
    """
    try:
        straight: Axis | None = find_axis(small)
        line_error = None
    except RecordingError as error:
        straight, line_error = None, error
    band = _changed_band(small)
    line_share = 0.0 if straight is None else front_share_of_picture(small, straight)
    line_too_wide = (
        straight is not None and band is not None and straight.width_px > BAND_RATIO * band.width * small.factor
    )
    # No curve can explain more than all of the change: along a straight vine none is searched.
    curve = find_curve(small, band) if line_too_wide or line_share * CURVE_GAIN < 1 else None
    if curve is not None:
        needed = max(LEAST_FRONT_SHARE, line_share * (EQUAL_SHARE if line_too_wide else CURVE_GAIN))
        if front_share_of_picture(small, curve) >= needed and _front_follows(luma, curve):
            return curve
    if straight is None:
        assert line_error is not None
        raise line_error
    return straight


def front_share_of_picture(small: SmallPictures, axis: Axis) -> float:
    """Share of all growth in the picture that is a front passing once along an axis, straight or curved."""
    x, y, time, weight, n_times = small.grown
    if len(x) < 12:
        return 0.0
    places = (np.column_stack([x, y]) + 0.5) * small.factor - 0.5
    if isinstance(axis, CurvedAxis):
        along, across = axis.along_and_across(places)
    else:
        along, across = (places - axis.from_px) @ axis.direction, (places - axis.from_px) @ axis.normal
    band = max(0.6 * axis.width_px / small.factor, 2.0)
    if not (np.abs(across) < band * small.factor).any():
        return 0.0
    in_small_px = along / small.factor, across / small.factor, time, weight
    on_front, _, _ = pixels_on_front(*in_small_px, n_times, 0.0, np.zeros(2), band)
    return float(weight[on_front].sum() / weight.sum())


def find_curve(small: SmallPictures, band: Band | None = None) -> CurvedAxis | None:
    """Find the smoothed middle of the band that changed, from its first change to its last."""
    band = band or _changed_band(small)
    path = None if band is None else _centreline(band)
    if band is None or path is None or len(path) < LEAST_LENGTH * band.width:
        return None
    middle = _smoothed_knots(_in_order_of_time(path, band), max(KNOT_WIDTHS * band.width, 6.0))
    if middle is None:
        return None
    size = small.shape[1], small.shape[0]
    try:
        axis = axis_through((middle + 0.5) * small.factor - 0.5, band.width * small.factor)
        axis = _extended(axis, (3 * band.width + 12) * small.factor, size)
    except RecordingError:
        return None
    if not isinstance(axis, CurvedAxis) or curve_problem(axis, axis.width_px / 2, size):
        return None
    return axis


@dataclass(frozen=True)
class Band:
    """What changed in the small pictures, in their pixels; arrays of shape (height, width). `region` is its largest
    connected part, `depth` the distance from the border of that, `when` the time of change, NaN where nothing changed;
    `width` is the width along most of its length.
    """

    region: NDArray[np.bool_]
    depth: Floats
    when: Floats
    width: float


def _changed_band(small: SmallPictures) -> Band | None:
    """The largest connected region that changed; None where hardly anything does."""
    from scipy.ndimage import distance_transform_edt

    x, y, time, _, _ = small.grown
    if len(x) < 12:
        return None
    when = np.full(small.frames.shape[1:], np.nan)
    when[y.astype(int), x.astype(int)] = time
    region = _largest_region(np.isfinite(when))
    depth = np.asarray(distance_transform_edt(np.pad(region, 1))[1:-1, 1:-1])
    half = float(np.quantile(depth[region], 0.9))
    return Band(region, depth, when, 2 * half + 1)


def _front_follows(luma: NDArray[Any], curve: CurvedAxis) -> bool:
    """Whether one front passes along a curve in the full picture."""
    try:
        return front_share_on_curve(luma, curve) >= LEAST_FRONT_SHARE
    except RecordingError:
        return False


def _largest_region(changed: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The largest connected region, with gaps closed and threads removed."""
    from scipy.ndimage import binary_closing, binary_fill_holes, binary_opening, label

    closed = binary_closing(np.pad(changed, 3), iterations=2)[3:-3, 3:-3]
    opened = binary_opening(binary_fill_holes(closed), iterations=1)
    parts, count = label(opened, np.ones((3, 3)))
    if count == 0:
        return changed
    return np.asarray(parts == 1 + int(np.argmax(np.bincount(parts.ravel())[1:])))


def _centreline(band: Band) -> Floats | None:
    """Pixels (x, y) of the cheapest path along the middle of a band between its two most distant ends, shape (n, 2)."""
    from skimage.graph import MCP_Geometric

    rows, columns = np.nonzero(band.region)
    if not rows.size:
        return None
    blocked = np.full(band.region.shape, -1.0)
    unit_costs = np.where(band.region, 1.0, blocked)
    start = end = int(rows[0]), int(columns[0])
    for _ in range(2):
        costs = np.where(band.region, MCP_Geometric(unit_costs).find_costs([end])[0], -1.0)
        row, column = np.unravel_index(int(np.argmax(np.where(np.isfinite(costs), costs, -1.0))), costs.shape)
        start, end = end, (int(row), int(column))
    paths = MCP_Geometric(np.where(band.region, 1 / np.maximum(band.depth, 0.5) ** CENTRING_POWER, blocked))
    paths.find_costs([start], [end])
    return np.array(paths.traceback(end), dtype=float)[:, ::-1]


def _in_order_of_time(path: Floats, band: Band) -> Floats:
    """The path, turned round where its pixels changed from its end to its beginning."""
    times = band.when[path[:, 1].astype(int), path[:, 0].astype(int)]
    finite = np.flatnonzero(np.isfinite(times))
    trend = np.sum((finite - finite.mean()) * (times[finite] - times[finite].mean())) if finite.size else 0.0
    return path if trend >= 0 else path[::-1]


def _smoothed_knots(path: Floats, spacing: float) -> Floats | None:
    """Knots `spacing` from each other of a penalised spline through a path of whole pixels, shape (n, 2), n ≥ 4. The
    ends of the path run into the corners of the band: half a knot distance at each is left out. None where fewer than
    five pixels remain between them, the fewest that a cubic spline goes through.
    """
    from scipy.interpolate import make_smoothing_spline

    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))])
    inner = (along >= spacing / 2) & (along <= along[-1] - spacing / 2)
    if inner.sum() < 5:
        return None
    # A wave of the length of two knot distances is damped to a half: penalty λ k⁴ = 1 at k = π / spacing.
    penalty = (spacing / np.pi) ** 4
    splines = [make_smoothing_spline(along[inner], path[inner, k], lam=penalty) for k in (0, 1)]
    count = max(4, round(np.ptp(along[inner]) / spacing) + 1)
    knots = np.linspace(along[inner][0], along[inner][-1], count)
    return np.stack([spline(knots) for spline in splines], axis=1)


def _extended(axis: Axis, margin: float, size_px: tuple[int, int]) -> Axis:
    """The curve continued straight at both ends by `margin`, as far as the picture goes."""
    if not isinstance(axis, CurvedAxis):
        return axis
    knots = list(axis.through_px)
    for end, sign in ((0.0, -1.0), (axis.length_px, 1.0)):
        extension = axis.points(end + sign * np.arange(1.0, margin + 1))
        inside = ((extension >= 0) & (extension <= np.array(size_px) - 1)).all(axis=1)
        count = len(extension) if inside.all() else int(np.argmin(inside))
        if count > 6:
            place = (float(extension[count - 1][0]), float(extension[count - 1][1]))
            knots = [place, *knots] if sign < 0 else [*knots, place]
    return axis_through(knots, axis.width_px)
