"""Find the curve along which a vine grew, from the pixels that changed, in the order in which they did.

A pixel that the vine covers changes once. Those that change at about the same time lie across the vine at its tip: the
smoothed line through their middles is the path. The curve is used only where its front share is larger than that of the
best straight line, or as large in a narrower band.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

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


def axis_problem(axis: Axis, half_px: float, size_px: tuple[int, int]) -> tuple[str, str] | None:
    """Say why an axis cannot be used in a picture, and the remedy; None where it can. Returns the end of a sentence
    that begins with "the axis", and the remedy; or None.
    """
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
    """Find the growth axis from the motion: a straight line, or a curve where that explains more of the change."""
    straight: Axis | RecordingError
    try:
        straight = find_axis(small)
    except RecordingError as error:
        straight = error
    if (curve := find_curve(small)) is not None:
        # 1.25, 0.98, 1.35: a curve is used where the straight line needs a band this many times wider and the curve
        # explains at least this part of what the line does, else where it explains this many times as much (measured)
        needed = LEAST_FRONT_SHARE
        if isinstance(straight, Axis):
            gain = 0.98 if straight.width_px > 1.25 * curve.width_px else 1.35
            needed = max(needed, gain * front_share_of_picture(small, straight))
        if front_share_of_picture(small, curve) >= needed and front_share(small, curve) >= LEAST_FRONT_SHARE:
            return curve
    if isinstance(straight, RecordingError):
        raise straight
    return straight


def front_share_of_picture(small: SmallPictures, axis: Axis) -> float:
    """Share of all growth in the picture that is a front passing once along an axis, straight or curved."""
    along, band = along_axis(small, small.grown, axis), max(0.6 * axis.width_px / small.factor, 2.0)
    return share_on_front(along, band) if (np.abs(along.y) < band).any() else 0.0


def find_curve(small: SmallPictures) -> Axis | None:
    """Find the smoothed line through the middles of what grew in turn, from the first change to the last."""
    from scipy.interpolate import make_smoothing_spline
    from scipy.spatial import KDTree

    # 25, 4: parts of the growth, of as many pixels each, and fewest pixels of a part (chosen)
    n_parts = 25
    if len(small.grown.x) < 4 * n_parts:
        return None
    grown, part = np.column_stack([small.grown.x, small.grown.y]), np.arange(n_parts)
    order = np.argsort(small.grown.time, kind="stable")
    change = np.cumsum(small.grown.weight[order])
    in_turn = np.split(grown[order], np.searchsorted(change, part[1:] / n_parts * change[-1]))
    # 8: length in parts of a wave that is damped to a half (chosen): penalty λ k⁴ = 1 at k = 2π / 8.
    splines = [
        make_smoothing_spline(part, middles, lam=(8 / (2 * np.pi)) ** 4)
        for middles in np.transpose([np.median(places, axis=0) for places in in_turn])
    ]
    path = np.column_stack([spline(np.linspace(0, n_parts - 1, 20 * n_parts)) for spline in splines])
    # 0.9: part of the pixels that lie within the width (chosen)
    along, width = length_along(path), 2 * float(np.quantile(KDTree(path).query(grown)[0], 0.9)) + 1
    # 3.0: least length of a curve, in its widths (chosen)
    if along[-1] < 3.0 * width:
        return None
    # 1.5: distance of the curve's knots in widths (chosen)
    knots = np.linspace(0.0, along[-1], max(4, round(along[-1] / max(1.5 * width, 6.0)) + 1))
    middle = np.column_stack([np.interp(knots, along, places) for places in path.T])
    size = small.shape[1], small.shape[0]
    try:
        middle_px = (middle + 0.5) * small.factor - 0.5
        axis = axis_through(middle_px, width * small.factor)
        # Continued straight at both ends, as far as the picture goes
        through, margin = [*middle_px], (3 * width + 12) * small.factor
        for end, sign in ((0.0, -1.0), (axis.length_px, 1.0)):
            extension = axis.points(end + sign * np.arange(1.0, margin + 1))
            inside = ((extension >= 0) & (extension <= np.array(size) - 1)).all(axis=1)
            count = len(extension) if inside.all() else int(np.argmin(inside))
            if count > 6:
                through.insert(0 if sign < 0 else len(through), extension[count - 1])
        axis = axis_through(through, axis.width_px)
    except RecordingError:
        return None
    if not axis.bends or axis_problem(axis, axis.width_px / 2, size):
        return None
    return axis
