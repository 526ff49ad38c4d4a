"""Find the curve along which a vine grew, from the region of pixels that changed.

A pixel that the vine covers changes once. The region of such pixels is a band; its smoothed middle, from the end that
changed first to the end that changed last, is the path. The curve is used only where its front share is far larger than
that of the best straight line.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from vinetrack.core.records import Bools, Floats
from vinetrack.video.axis import (
    LEAST_FRONT_SHARE,
    Axis,
    along_axis,
    axis_through,
    find_axis,
    front_share,
    length_along,
    share_on_front,
)
from vinetrack.video.frames import RecordingError
from vinetrack.video.small_pictures import SmallPictures


def axis_entry(axis: Axis) -> dict[str, Any]:
    """Convert an axis to a JSON mapping, without its width: `from_px`, `to_px`, and of a curve `via_px`. Returns
    mapping of JSON types.
    """
    entry: dict[str, Any] = {"from_px": axis.from_px, "to_px": axis.to_px}
    return entry | ({"via_px": axis.via_px} if axis.bends else {})


def axis_from_entry(entry: Mapping[str, Any]) -> Axis:
    """Read an axis that `axis_entry` wrote."""
    width = entry.get("width_px")
    through = (entry["from_px"], *entry.get("via_px", ()), entry["to_px"])
    return axis_through(through, float("nan") if width is None else float(width))


def curve_problem(axis: Axis, half_px: float, size_px: tuple[int, int]) -> tuple[str, str] | None:
    """Say why a curve cannot be used in a picture, and the remedy; None where it can, or where it is a straight line.
    Returns the end of a sentence that begins with "the axis", and the remedy; or None.
    """
    if not axis.bends:
        return None
    places = axis.points(np.linspace(0.0, axis.length_px, int(axis.length_px) + 2))
    if (places < -0.5).any() or (places > np.array(size_px) - 0.5).any():
        return f"leaves the picture, {size_px[0]} × {size_px[1]} pixels", "give points inside it"
    if half_px > axis.largest_half_px:
        return (
            f"bends with a radius of {axis.least_radius_px:.0f} px, too sharply for a strip of {half_px:.0f} px on "
            "either side",
            "give fewer points or a smaller width",
        )
    return None


def find_growth_axis(small: SmallPictures) -> Axis:
    """Find the growth axis from the motion: a straight line, or a curve where that explains far more of the change."""
    straight: Axis | RecordingError
    try:
        straight = find_axis(small)
    except RecordingError as error:
        straight = error
    band = _changed_band(small)
    line_share = front_share_of_picture(small, straight) if isinstance(straight, Axis) else 0.0
    # 1.25, 0.98, 1.35: a curve is used where the straight line needs a band this many times wider and the curve
    # explains at least this part of what the line does, else where it explains this many times as much (measured)
    line_too_wide = isinstance(straight, Axis) and band and straight.width_px > 1.25 * band.width * small.factor
    gain = 0.98 if line_too_wide else 1.35
    # No curve can explain more than all of the change: along a straight vine none is searched.
    curve = find_curve(small, band) if line_too_wide or line_share * gain < 1 else None
    if curve is not None:
        needed = max(LEAST_FRONT_SHARE, line_share * gain)
        if front_share_of_picture(small, curve) >= needed and front_share(small, curve) >= LEAST_FRONT_SHARE:
            return curve
    if isinstance(straight, RecordingError):
        raise straight
    return straight


def front_share_of_picture(small: SmallPictures, axis: Axis) -> float:
    """Share of all growth in the picture that is a front passing once along an axis, straight or curved."""
    if len(small.grown.x) < 12:
        return 0.0
    along, band = along_axis(small, small.grown, axis), max(0.6 * axis.width_px / small.factor, 2.0)
    return share_on_front(along, band) if (np.abs(along.y) < band).any() else 0.0


def find_curve(small: SmallPictures, band: Band | None = None) -> Axis | None:
    """Find the smoothed middle of the band that changed, from its first change to its last."""
    band = band or _changed_band(small)
    # 3.0: least length of the band, in its widths, that has a path (chosen)
    if band is None or len(path := _centreline(band)) < 3.0 * band.width:
        return None
    # Turned round where its pixels changed from its end to its beginning
    times = band.when[path[:, 1].astype(int), path[:, 0].astype(int)]
    finite = np.flatnonzero(np.isfinite(times))
    trend = np.sum((finite - finite.mean()) * (times[finite] - times[finite].mean())) if finite.size else 0.0
    # 1.5: distance of the curve's knots in widths of the band (chosen)
    middle = _smoothed_knots(path if trend >= 0 else path[::-1], max(1.5 * band.width, 6.0))
    if middle is None:
        return None
    size = small.shape[1], small.shape[0]
    try:
        middle_px = (middle + 0.5) * small.factor - 0.5
        axis = axis_through(middle_px, band.width * small.factor)
        # Continued straight at both ends, as far as the picture goes
        knots, margin = [*middle_px], (3 * band.width + 12) * small.factor
        for end, sign in ((0.0, -1.0), (axis.length_px, 1.0)):
            extension = axis.points(end + sign * np.arange(1.0, margin + 1))
            inside = ((extension >= 0) & (extension <= np.array(size) - 1)).all(axis=1)
            count = len(extension) if inside.all() else int(np.argmin(inside))
            if count > 6:
                knots.insert(0 if sign < 0 else len(knots), extension[count - 1])
        axis = axis_through(knots, axis.width_px)
    except RecordingError:
        return None
    if not axis.bends or curve_problem(axis, axis.width_px / 2, size):
        return None
    return axis


@dataclass(frozen=True)
class Band:
    """What changed in the small pictures, in their pixels; arrays of shape (height, width). `region` is its largest
    connected part, `depth` the distance from the border of that, `when` the time of change, NaN where nothing changed;
    `width` is the width along most of its length.
    """

    region: Bools
    depth: Floats
    when: Floats
    width: float


def _changed_band(small: SmallPictures) -> Band | None:
    """The largest connected region that changed; None where hardly anything does."""
    from scipy.ndimage import binary_closing, binary_fill_holes, binary_opening, distance_transform_edt, label

    if len(small.grown.x) < 12:
        return None
    when = np.full(small.frames.shape[1:], np.nan)
    when[small.grown.y.astype(int), small.grown.x.astype(int)] = small.grown.time
    # With gaps closed and threads removed
    region = np.isfinite(when)
    closed = binary_closing(np.pad(region, 3), iterations=2)[3:-3, 3:-3]
    parts, count = label(binary_opening(binary_fill_holes(closed), iterations=1), np.ones((3, 3)))
    if count:
        region = np.asarray(parts == 1 + int(np.argmax(np.bincount(parts.ravel())[1:])))
    depth = np.asarray(distance_transform_edt(np.pad(region, 1))[1:-1, 1:-1])
    half = float(np.quantile(depth[region], 0.9))
    return Band(region, depth, when, 2 * half + 1)


def _centreline(band: Band) -> Floats:
    """Pixels (x, y) of the cheapest path along the middle of a band between its two most distant ends, shape (n, 2)."""
    from skimage.graph import MCP_Geometric

    rows, columns = np.nonzero(band.region)
    blocked = np.full(band.region.shape, -1.0)
    unit_costs = np.where(band.region, 1.0, blocked)
    start = end = int(rows[0]), int(columns[0])
    for _ in range(2):
        costs = np.where(band.region, MCP_Geometric(unit_costs).find_costs([end])[0], -1.0)
        row, column = np.unravel_index(int(np.argmax(np.where(np.isfinite(costs), costs, -1.0))), costs.shape)
        start, end = end, (int(row), int(column))
    # 3.0: how strongly the path through the band keeps to its middle: a step costs 1 / depth³ (chosen)
    paths = MCP_Geometric(np.where(band.region, 1 / np.maximum(band.depth, 0.5) ** 3.0, blocked))
    paths.find_costs([start], [end])
    return np.array(paths.traceback(end), dtype=float)[:, ::-1]


def _smoothed_knots(path: Floats, spacing: float) -> Floats | None:
    """Knots `spacing` from each other of a penalised spline through a path of whole pixels, shape (n, 2), n ≥ 4. The
    ends of the path run into the corners of the band: half a knot distance at each is left out. None where fewer than
    five pixels remain between them, the fewest that a cubic spline goes through.
    """
    from scipy.interpolate import make_smoothing_spline

    along = length_along(path)
    inner = (along >= spacing / 2) & (along <= along[-1] - spacing / 2)
    if inner.sum() < 5:
        return None
    # A wave of the length of two knot distances is damped to a half: penalty λ k⁴ = 1 at k = π / spacing.
    penalty = (spacing / np.pi) ** 4
    splines = [make_smoothing_spline(along[inner], path[inner, k], lam=penalty) for k in (0, 1)]
    count = max(4, round(np.ptp(along[inner]) / spacing) + 1)
    knots = np.linspace(along[inner][0], along[inner][-1], count)
    return np.stack([spline(knots) for spline in splines], axis=1)
