"""The growth axis: a line in the picture, given by the user or found from the motion.

A pixel that a growing vine covers changes once, and the times of change increase along one line. Nothing is assumed
about where the vine enters, how bright it is, or whether it rests at first. For lines through pairs of pixels that
change, the change collected by a monotone path along each is computed by dynamic programming; the best line is refined
on the pixels that change when the path passes them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.core.records import Bools, Floats, Trial
from vinetrack.experiment.schema import SHORTEST_AXIS_PX, SMALLEST_POINT_SPACING_PX
from vinetrack.video.frames import RecordingError
from vinetrack.video.small_pictures import (
    Pixels,
    SmallPictures,
    busy_pictures,
    changed_pixels,
    collecting_path,
    order_tolerance,
)

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline

Point = tuple[float, float]

# Least share of all change that one front explains where nothing else of weight moves (chosen)
LEAST_FRONT_SHARE = 0.45
MOST_TURN_DEG = 8.0  # Largest angle by which a given axis is turned onto the motion (chosen)


@dataclass(frozen=True)
class Axis:
    """A path in the picture along which a vine grows, from `from_px` through `via_px` to `to_px`: (x, y), pixel centres
    at integers. It is straight where `via_px` is empty, else a natural cubic spline over the centripetal parameter
    (steps of the square root of the distance between neighbours; Lee 1989), which neither overshoots nor loops between
    unevenly spaced points; beyond its ends it continues straight. `width_px` is the width of what moves along it, NaN
    where unknown; `direction` and `normal` are those of the chord.
    """

    from_px: Point
    to_px: Point
    width_px: float = float("nan")
    via_px: tuple[Point, ...] = ()

    def __post_init__(self) -> None:
        if self.bends and np.min(np.hypot(*np.diff(self.through_px, axis=0).T)) < SMALLEST_POINT_SPACING_PX:
            raise RecordingError(
                f"two neighbouring points of the growth axis are less than {SMALLEST_POINT_SPACING_PX} pixels apart",
                "leave out one",
            )
        if self.length_px < SHORTEST_AXIS_PX:
            raise RecordingError(
                f"the growth axis is shorter than {SHORTEST_AXIS_PX} pixels", "move from_px and to_px apart"
            )

    @property
    def bends(self) -> bool:
        """Whether it is a curve."""
        return bool(self.via_px)

    @property
    def through_px(self) -> tuple[Point, ...]:
        """All points that it passes through, in order."""
        return (self.from_px, *self.via_px, self.to_px)

    @cached_property
    def _table(self) -> tuple[CubicSpline, Floats, Floats]:
        """The spline of a curve, and its parameter and arc length at the samples."""
        from scipy.interpolate import CubicSpline

        points = np.array(self.through_px)
        spacing = np.hypot(*np.diff(points, axis=0).T)
        knots = np.concatenate([[0.0], np.cumsum(np.sqrt(spacing))])
        spline = CubicSpline(knots, points, bc_type="natural")
        # 8: samples per pixel over which the arc length is summed (derived)
        counts = np.ceil(8 * spacing).astype(int) + 1
        parts = [np.linspace(a, b, n, endpoint=False) for a, b, n in zip(knots[:-1], knots[1:], counts, strict=True)]
        parameter = np.concatenate([*parts, knots[-1:]])
        return spline, parameter, length_along(spline(parameter))

    @property
    def length_px(self) -> float:
        """Arc length between the ends."""
        return float(self._table[2][-1]) if self.bends else math.dist(self.from_px, self.to_px)

    @property
    def direction(self) -> Floats:
        """Unit vector of growth (x, y) from end to end, shape (2,)."""
        chord = np.subtract(self.to_px, self.from_px)
        return chord / np.hypot(*chord)

    @property
    def normal(self) -> Floats:
        """Unit vector across, a quarter turn from x towards y, shape (2,)."""
        along = self.direction
        return np.array([-along[1], along[0]])

    @cached_property
    def least_radius_px(self) -> float:
        """Radius where it bends most sharply; infinite for a straight line."""
        if not self.bends:
            return math.inf
        spline, parameter, _ = self._table
        first, second = spline(parameter, 1), spline(parameter, 2)
        speed = np.hypot(*first.T)
        bend = np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]) / speed**3
        return float(1 / max(float(bend.max()), 1e-12))

    @property
    def largest_half_px(self) -> float:
        """Half the width of the widest strip along it whose normals do not cross."""
        # 0.9: largest half width of a strip, as a part of the least radius (derived)
        return 0.9 * self.least_radius_px

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
        """Unit vectors of growth at places along the axis. Shape (..., 2)."""
        if not self.bends:
            return np.broadcast_to(self.direction, (*np.shape(along_px), 2))
        spline, parameter, arc = self._table
        slope = spline(np.interp(np.asarray(along_px, float), arc, parameter), 1)
        return np.asarray(slope / np.linalg.norm(slope, axis=-1, keepdims=True))

    def points(self, along_px: Floats, across_px: Floats | float = 0.0) -> Floats:
        """Return picture coordinates of points given along the axis and across it, on its normal. Shape (..., 2)."""
        along, across = np.broadcast_arrays(np.asarray(along_px, float), np.asarray(across_px, float))
        unit = self.direction_at(along)
        normal = np.stack([-unit[..., 1], unit[..., 0]], axis=-1)
        if self.bends:
            spline, parameter, arc = self._table
            on_axis, past = spline(np.interp(along, arc, parameter)), along - np.clip(along, 0.0, arc[-1])
        else:
            on_axis, past = np.asarray(self.from_px, dtype=float), along
        return np.asarray(on_axis + past[..., None] * unit + across[..., None] * normal)

    def along_and_across(self, picture_px: Floats) -> tuple[Floats, Floats]:
        """Find where points of the picture lie along and across the axis, px, by their nearest place on it. Shapes:
        picture_px (n, 2) → (n,) each.
        """
        points = np.asarray(picture_px, dtype=float)
        if not self.bends:
            return (points - self.from_px) @ self.direction, (points - self.from_px) @ self.normal
        from scipy.spatial import KDTree

        spline, parameter, arc = self._table
        _, nearest = KDTree(spline(parameter)).query(np.where(np.isfinite(points), points, 0.0))
        # Between the samples of the table, and beyond the ends, along the tangent
        offset = points - spline(parameter[nearest])
        along = arc[nearest] + np.sum(offset * self.direction_at(arc[nearest]), axis=-1)
        unit, offset = self.direction_at(along), points - self.points(along)
        return along, unit[:, 0] * offset[:, 1] - unit[:, 1] * offset[:, 0]


def axis_through(through_px: Sequence[Sequence[float]] | Floats, width_px: float = float("nan")) -> Axis:
    """Lay the growth axis through points: a straight line through two, a smooth curve through more."""
    points = [(float(x), float(y)) for x, y in through_px]
    return Axis(points[0], points[-1], width_px, tuple(points[1:-1]))


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


def length_along(path: Floats) -> Floats:
    """Cumulative length along a path from its first point. Shapes: path (n, 2) → (n,)."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])


def find_axis(small: SmallPictures, grows: bool = True) -> Axis:
    """Find the growth axis from the motion."""
    if len(small.frames) < 3:
        raise RecordingError("fewer than 3 frames: no motion can be seen")
    pixels = small.grown if grows else small.changed
    best = _line_through_pairs(small, pixels, pixels.weight)
    if best.front_share < LEAST_FRONT_SHARE and pixels is small.changed:
        # Hardly any change lasts, as of a vine that sweeps: the axis is that of the longest orderly beginning.
        best = _line_of_beginning(small, best)
    if best.collected <= 0 and len(small.changed.x) < 12:
        raise RecordingError("nothing moves in the picture")
    if best.collected <= 0:
        raise RecordingError("what moves in the picture follows no line", "draw its axis on the set-up page")
    # In full pixels, with a margin behind the line, and extended ahead to the border of the picture
    along, factor, (height, width) = _along_and_side(best.angle)[0], small.factor, small.shape
    centre = (best.middle + 0.5) * factor - 0.5
    low, high = (best.ends[0] - (6.0 * best.half + 12.0)) * factor, np.inf
    for origin, unit, size in ((centre[0], along[0], width), (centre[1], along[1], height)):
        if abs(unit) > 1e-6:
            a, b = sorted([(0.0 - origin) / unit, (size - 1.0 - origin) / unit])
            low, high = max(low, a), min(high, b)
    return axis_through([centre + low * along, centre + high * along], 2 * best.half * factor)


def _line_of_beginning(small: SmallPictures, whole: _Line) -> _Line:
    """The line of the beginning of a recording that collects most change in order; else that of the whole."""
    orderly = []
    # Fractions of a recording, from its start, that may be orderly where the whole is not (chosen)
    for fraction in (0.12, 0.18, 0.25, 0.32, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9):
        pixels = changed_pixels(*busy_pictures(small.frames[: max(3, int(fraction * len(small.frames)))]))
        # Of a vine that bends and sweeps, early change counts most; elsewhere a door, which swings first, would too.
        line = _line_through_pairs(small, pixels, pixels.weight * (1 - 0.8 * pixels.time / pixels.n_times))
        orderly += [line] if line.front_share >= LEAST_FRONT_SHARE else []
    return max(orderly, key=lambda line: line.front_share * line.collected, default=whole)


def front_share(small: SmallPictures, axis: Axis, of_picture: bool = False) -> float:
    """Share of the growth along an axis, or of all growth in the picture, that is one front passing once; 0 where
    hardly any pixel grows there.
    """
    band = float(np.clip(0.6 * axis.width_px / small.factor, 2.0, 0.2 * np.hypot(*small.frames.shape[1:])))
    along = along_axis(small, small.grown, axis)
    near = along.where(np.abs(along.y) < band)
    if len(near.x) < 12:
        return 0.0
    on_front = _on_front(near, band, order_tolerance(near.n_times))
    return float(near.weight[on_front].sum() / (along if of_picture else near).weight.sum())


def along_axis(small: SmallPictures, pixels: Pixels, axis: Axis) -> Pixels:
    """The pixels by their places along and across an axis, all of the small pictures."""
    along, across = axis.along_and_across((np.column_stack([pixels.x, pixels.y]) + 0.5) * small.factor - 0.5)
    return pixels._replace(x=along / small.factor, y=across / small.factor)


def centred_on_motion(small: SmallPictures, given: Axis) -> Axis:
    """Move and turn a given straight axis onto the line of what moves within its width, and make it as wide as that.
    The ends keep their places along the axis: only the position across is corrected, by up to half of `given.width_px`
    and MOST_TURN_DEG. Of several bodies within the width, the one that moves nearer to the axis is preferred.
    """
    reach, length = max(0.5 * given.width_px / small.factor, 3.0), given.length_px / small.factor
    changed = along_axis(small, small.changed, given)
    pixels = changed.where((np.abs(changed.y) < reach) & (np.abs(changed.x - length / 2) < 0.6 * length))
    if len(pixels.x) < 12:
        raise RecordingError("nothing moves along the axis")
    band = float(np.clip(0.25 * reach, 2.0, 6.0))
    angles = np.radians(np.arange(-MOST_TURN_DEG, MOST_TURN_DEG + 0.5, 2.0)).tolist()
    tried = [(a, np.array([length / 2, off])) for a in angles for off in np.arange(-reach, reach + band, band)]
    nearness = 1 - 0.5 * (pixels.y / reach) ** 2
    line = _line_through(pixels, pixels.weight * nearness, tried, band, 2 * band, reach)
    if line.collected <= 0:
        return given
    slope = np.tan(line.angle)
    ends_px = np.array([0.0, given.length_px])
    across_px = (line.middle[1] - slope * line.middle[0]) * small.factor + slope * ends_px
    return axis_through(given.points(ends_px, across_px), 2 * line.half * small.factor)


@dataclass(frozen=True)
class _Line:
    """A line in the small pictures and how much change it collects; `front_share` is its share of all change."""

    angle: float
    middle: Floats
    half: float
    ends: tuple[float, float]
    collected: float
    front_share: float


_NO_LINE = _Line(0.0, np.zeros(2), 1.0, (0.0, 0.0), 0.0, 0.0)


def _along_and_side(angle: float) -> Floats:
    """Unit vectors along a direction (rad, from x towards y) and across it, shape (2, 2)."""
    return np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])


def _line_through_pairs(small: SmallPictures, pixels: Pixels, likely: Floats) -> _Line:
    """The best line through pixels anywhere in the picture, tried through pairs that are drawn as they are `likely`."""
    if len(pixels.x) < 12:
        return _NO_LINE
    diagonal, places = float(np.hypot(*small.frames.shape[1:])), np.column_stack([pixels.x, pixels.y])
    band, tried = max(3.0, 0.03 * diagonal), []
    # 100: lines that are tried (chosen)
    for pair in np.random.default_rng(0).choice(len(places), (100, 2), p=likely / likely.sum()).tolist():
        first, last = places[sorted(pair, key=pixels.time.__getitem__)]
        if math.dist(first, last) > 2 * band:
            tried.append((float(np.arctan2(*(last - first)[::-1])), first))
    return _line_through(pixels, likely, tried, band, band, 0.2 * diagonal)


def _line_through(
    pixels: Pixels, likely: Floats, tried: list[tuple[float, Floats]], band: float, first_band: float, most_band: float
) -> _Line:
    """The line along which most change is collected in order; an empty one where there is none. The best of those that
    are `tried` (direction and point), by what is `likely` within `band`, is refined until its band no longer widens,
    which reaches at most `most_band` to either side.
    """
    places, collected = np.column_stack([pixels.x, pixels.y]), []
    for angle, middle in tried:
        x, y = _along_and_side(angle) @ (places - middle).T
        collected.append(float(likely[_on_front(pixels._replace(x=x, y=y), band, 0.0)].sum()))
    if max(collected, default=0.0) <= 0:
        return _NO_LINE
    (angle, middle), band = tried[int(np.argmax(collected))], first_band
    # 3, 20: fewest and most times that a line is refined on the pixels that agree with it (chosen)
    for round_ in range(1, 20 + 1):
        turned = _along_and_side(angle) @ (places - middle).T
        on_front = _on_front(pixels._replace(x=turned[0], y=turned[1]), band, order_tolerance(pixels.n_times))
        if on_front.sum() < 8:
            return _NO_LINE
        weight, points = pixels.weight[on_front], turned[:, on_front]
        centre = np.average(points, axis=1, weights=weight)
        values, vectors = np.linalg.eigh(np.cov(points, aweights=weight))
        principal = vectors[:, 1] * np.sign(vectors[0, 1])
        turn = 0.0 if values[1] < 2.0 * values[0] or principal[0] < 0.8 else float(np.arctan2(*principal[::-1]))
        along, lateral = _along_and_side(turn) @ (points - centre[:, None])
        shift = float(np.median(np.repeat(lateral, np.maximum(1, weight.astype(int)))))
        half = float(np.quantile(np.abs(lateral - shift), 0.95)) + 0.5
        middle, angle = middle + centre @ _along_and_side(angle), angle + turn
        middle = middle + shift * _along_and_side(angle)[1]
        narrower, band = band, float(np.clip(1.2 * half, 2.0, most_band))
        # 1.05: growth of that band in one refinement above which another follows (chosen)
        if round_ >= 3 and band < 1.05 * narrower:
            break
    low, high = np.quantile(along, (0.002, 0.998)).tolist()
    return _Line(angle, middle, half, (low, high), float(weight.sum()), float(weight.sum() / pixels.weight.sum()))


def _on_front(along: Pixels, band: float, slack: float) -> Bools:
    """Mark the pixels that change when the best monotone path along a line passes them, by their places along and
    across it, px. Shape (n_pixels,).
    """
    bin_index = ((along.x - float(along.x.min())) / 2).astype(int)
    inside = np.abs(along.y) < band
    size = along.n_times, int(bin_index.max()) + 1
    at = along.time[inside].astype(int) * size[1] + bin_index[inside]
    table = np.bincount(at, along.weight[inside], size[0] * size[1]).reshape(size)
    path = collecting_path(table)
    passing_time = np.searchsorted(path, np.arange(table.shape[1]) + 0.5)
    passed = (passing_time > 0) & (passing_time < along.n_times)
    on_time = np.abs(along.time - passing_time[bin_index]) <= slack
    return inside & passed[bin_index] & on_time


# ------------------------------------------------------------------------------
# The curve along which a vine grew, from the pixels that changed, in the order in which they did.
#
# Those that change at about the same time lie across the vine at its tip: the smoothed line through their middles is
# the path. It is used only where its front share, over its width, is larger than that of the best straight line.


def find_growth_axis(small: SmallPictures) -> Axis:
    """Find the growth axis from the motion: a straight line, or a curve where that explains more in less width."""
    curve = find_curve(small)
    if curve is None or front_share(small, curve, of_picture=True) < LEAST_FRONT_SHARE:
        return find_axis(small)
    try:
        straight = find_axis(small)
    except RecordingError:
        return curve
    of_curve, of_line = (front_share(small, axis, of_picture=True) / axis.width_px for axis in (curve, straight))
    # 1.3: least ratio of what curve and line explain in a band of one width (measured)
    return curve if of_curve > 1.3 * of_line else straight


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


# ------------------------------------------------------------------------------
# Whether the growth axes of recordings agree: vines filmed by one camera grow along one line of its picture.


def slope_deg(from_px: Sequence[float], to_px: Sequence[float], *, bends: bool) -> float:
    """Direction of an axis in the picture, degrees from +x towards +y; NaN for a curve, which agrees with no line."""
    return math.nan if bends else math.degrees(math.atan2(to_px[1] - from_px[1], to_px[0] - from_px[0]))


def askew_trials(slopes_deg: Mapping[str, float], trials: Iterable[Trial]) -> list[tuple[list[str], int]]:
    """Trials whose axis was found askew to that of most others that grow at the same angle, and how many agree; none
    where fewer than three agree, or not most. Bodies that fly free and trials with a given axis are not compared.
    """
    by_angle: dict[float, dict[str, float]] = {}
    for trial in trials:
        if trial.name in slopes_deg and trial.axis is None and trial.travel_ratio != 1:
            by_angle.setdefault(trial.growth_angle_rad, {})[trial.name] = slopes_deg[trial.name]
    # Angle between a recording's axis and that of most others above which the recording is named (chosen)
    askew_deg, found = 10.0, []
    for slopes in by_angle.values():
        straight = [slope for slope in slopes.values() if math.isfinite(slope)]
        agreeing = [sum(_apart_deg(slope, other) < askew_deg for other in straight) for slope in straight]
        common = straight[int(np.argmax(agreeing))] if straight else 0.0
        names = [name for name, slope in slopes.items() if not _apart_deg(slope, common) < askew_deg]
        # 3: fewest recordings whose axes agree from which the others are judged (chosen)
        if names and 3 <= (agreed := len(slopes) - len(names)) > len(names):
            found.append((names, agreed))
    return found


def _apart_deg(slope: float, other: float) -> float:
    """Angle between two lines, whichever way they run, 0 to 90 degrees."""
    return abs((slope - other + 90.0) % 180.0 - 90.0)
