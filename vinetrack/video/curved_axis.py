"""A growth axis that bends: a smooth curve through points of the picture, with positions as arc length along it.

The curve is a natural cubic spline over the centripetal parameter (steps of the square root of the distance between
neighbours; Lee 1989), which neither overshoots nor loops between unevenly spaced points. Beyond its ends it continues
straight.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.experiment.cells import SMALLEST_POINT_SPACING_PX
from vinetrack.video.axis import Axis
from vinetrack.video.frames import RecordingError

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline

Point = tuple[float, float]

SAMPLES_PER_PX = 8  # Samples per pixel over which the arc length is summed (derived)
LARGEST_HALF_PER_RADIUS = 0.9  # Largest half width of a strip, as a part of the least radius (derived)


@dataclass(frozen=True)
class CurvedAxis(Axis):
    """A curve in the picture along which a vine grows, from `from_px` through `via_px` to `to_px`: (x, y), px.
    `direction` and `normal` are those of its chord; `points` follows the curve.
    """

    via_px: tuple[Point, ...] = ()

    def __post_init__(self) -> None:
        points = np.array(self.through_px)
        if np.min(np.hypot(*np.diff(points, axis=0).T)) < SMALLEST_POINT_SPACING_PX:
            raise RecordingError(
                f"two neighbouring points of the growth axis are less than {SMALLEST_POINT_SPACING_PX} pixels apart; "
                "leave out one"
            )
        super().__post_init__()

    @property
    def bends(self) -> bool:
        """Whether it is a curve."""
        return True

    @property
    def through_px(self) -> tuple[Point, ...]:
        """All points that the curve passes through, in order."""
        return (self.from_px, *self.via_px, self.to_px)

    @cached_property
    def _table(self) -> tuple[CubicSpline, Floats, Floats]:
        """The spline, and its parameter and arc length at the samples."""
        from scipy.interpolate import CubicSpline

        points = np.array(self.through_px)
        spacing = np.hypot(*np.diff(points, axis=0).T)
        knots = np.concatenate([[0.0], np.cumsum(np.sqrt(spacing))])
        spline = CubicSpline(knots, points, bc_type="natural")
        counts = np.ceil(SAMPLES_PER_PX * spacing).astype(int) + 1
        parts = [np.linspace(a, b, n, endpoint=False) for a, b, n in zip(knots[:-1], knots[1:], counts, strict=True)]
        parameter = np.concatenate([*parts, knots[-1:]])
        steps = np.hypot(*np.diff(spline(parameter), axis=0).T)
        return spline, parameter, np.concatenate([[0.0], np.cumsum(steps)])

    @property
    def length_px(self) -> float:
        """Arc length between its ends."""
        return float(self._table[2][-1])

    @cached_property
    def least_radius_px(self) -> float:
        """Radius where the curve bends most sharply; infinite for a straight line."""
        spline, parameter, _ = self._table
        first, second = spline(parameter, 1), spline(parameter, 2)
        speed = np.hypot(*first.T)
        bend = np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]) / speed**3
        return float(1 / max(float(bend.max()), 1e-12))

    @property
    def largest_half_px(self) -> float:
        """Half the width of the widest strip along the curve whose normals do not cross."""
        return LARGEST_HALF_PER_RADIUS * self.least_radius_px

    @cached_property
    def _angles_rad(self) -> Floats:
        """Direction at many equal steps, unwrapped, positive from x towards y."""
        direction = self.direction_at(np.linspace(0.0, self.length_px, 400))
        return np.unwrap(np.arctan2(*direction.T[::-1]))

    @property
    def turn_rad(self) -> float:
        """Angle by which the direction turns between the ends, positive from x towards y."""
        return float(self._angles_rad[-1] - self._angles_rad[0])

    @property
    def total_turn_rad(self) -> float:
        """Angle by which the direction turns in all, to either side."""
        return float(np.abs(np.diff(self._angles_rad)).sum())

    def direction_at(self, along_px: Floats) -> Floats:
        """Unit vectors of growth at places along the curve. Shape (..., 2)."""
        spline, parameter, arc = self._table
        slope = spline(np.interp(np.asarray(along_px, float), arc, parameter), 1)
        return np.asarray(slope / np.linalg.norm(slope, axis=-1, keepdims=True))

    def points(self, along_px: Floats, across_px: Floats | float = 0.0) -> Floats:
        """Return picture coordinates of points given along the curve and across it, on its normal. Shape (..., 2)."""
        along, across = np.broadcast_arrays(np.asarray(along_px, float), np.asarray(across_px, float))
        spline, parameter, arc = self._table
        unit = self.direction_at(along)
        past_end = along - np.clip(along, 0.0, self.length_px)
        normal = np.stack([-unit[..., 1], unit[..., 0]], axis=-1)
        on_curve = spline(np.interp(along, arc, parameter))
        return np.asarray(on_curve + past_end[..., None] * unit + across[..., None] * normal)

    def nearest_px(self, picture_px: Floats) -> Floats:
        """Find the arc length of the places on the curve nearest to points of the picture. Shapes: picture_px (n, 2) →
        (n,).
        """
        from scipy.spatial import KDTree

        spline, parameter, arc = self._table
        points = np.asarray(picture_px, dtype=float)
        _, nearest = KDTree(spline(parameter)).query(np.where(np.isfinite(points), points, 0.0))
        # Between the samples of the table, and beyond the ends, along the tangent.
        along = arc[nearest]
        offset = points - spline(parameter[nearest])
        return np.asarray(along + np.sum(offset * self.direction_at(along), axis=-1))

    def along_and_across(self, picture_px: Floats) -> tuple[Floats, Floats]:
        """Find where points of the picture lie along and across the curve, by their nearest place on it. Returns arc
        length from `from_px` and distance on the normal, shape (n,) each, px. Shapes: picture_px (n, 2).
        """
        points = np.asarray(picture_px, dtype=float)
        along = self.nearest_px(points)
        unit, offset = self.direction_at(along), points - self.points(along)
        return along, unit[:, 0] * offset[:, 1] - unit[:, 1] * offset[:, 0]

    def moved(self, dx_px: float, dy_px: float) -> CurvedAxis:
        """Shift the curve into a picture whose origin is elsewhere."""
        through = [(x + dx_px, y + dy_px) for x, y in self.through_px]
        return CurvedAxis(through[0], through[-1], self.width_px, tuple(through[1:-1]))


def axis_through(through_px: Sequence[Sequence[float]] | Floats, width_px: float = float("nan")) -> Axis:
    """Lay the growth axis through points: a straight line through two, a smooth curve through more."""
    points = [(float(x), float(y)) for x, y in through_px]
    if len(points) == 2:
        return Axis(points[0], points[1], width_px)
    return CurvedAxis(points[0], points[-1], width_px, tuple(points[1:-1]))


def length_along(path: Floats) -> Floats:
    """Cumulative length along a path from its first point. Shapes: path (n, 2) → (n,)."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])


def axis_entry(axis: Axis) -> dict[str, Any]:
    """Convert an axis to a JSON mapping, without its width: `from_px`, `to_px`, and of a curve `via_px`. Returns
    mapping of JSON types.
    """
    entry: dict[str, Any] = {"from_px": axis.from_px, "to_px": axis.to_px}
    return entry | ({"via_px": axis.via_px} if isinstance(axis, CurvedAxis) else {})


def axis_from_entry(entry: Mapping[str, Any]) -> Axis:
    """Read an axis that `axis_entry` wrote."""
    width = entry.get("width_px")
    through = (entry["from_px"], *entry.get("via_px", ()), entry["to_px"])
    return axis_through(through, float("nan") if width is None else float(width))


def curve_problem(axis: Axis, half_px: float, size_px: tuple[int, int]) -> tuple[str, str] | None:
    """Say why a curve cannot be used in a picture, and the remedy; None where it can, or where it is a straight line.
    Returns the end of a sentence that begins with "the axis", and the remedy; or None.
    """
    if not isinstance(axis, CurvedAxis):
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
