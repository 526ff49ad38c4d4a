"""The growth axis: a line in the picture, given by the user or found from the motion.

A pixel that a growing vine covers changes once, and the times of change increase along one line. Nothing is assumed
about where the vine enters, how bright it is, or whether it rests at first. For each line of a coarse fan, the change
collected by a monotone path along it is computed by dynamic programming; the best line is refined on the pixels that
change when the path passes them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from vinetrack.core.records import Bools, Floats, Trial
from vinetrack.experiment.schema import SHORTEST_AXIS_PX
from vinetrack.video.frames import RecordingError
from vinetrack.video.kymograph import collecting_path, monotone_path_sums
from vinetrack.video.small_pictures import MIN_GROWN_PART, Pixels, SmallPictures, changed_pixels, order_tolerance

# Least share of all change that one front explains where nothing else of weight moves (chosen)
LEAST_FRONT_SHARE = 0.45
MOST_TURN_DEG = 8.0  # Largest angle by which a given axis is turned onto the motion (chosen)


@dataclass(frozen=True)
class Axis:
    """A line in the picture along which a vine grows: `from_px` and `to_px` are (x, y), pixel centres at integers.
    `width_px` is the width of what moves along it, NaN where unknown.
    """

    from_px: tuple[float, float]
    to_px: tuple[float, float]
    width_px: float = float("nan")

    def __post_init__(self) -> None:
        if self.length_px < SHORTEST_AXIS_PX:
            raise RecordingError(
                f"the growth axis is shorter than {SHORTEST_AXIS_PX} pixels", "move from_px and to_px apart"
            )

    @property
    def length_px(self) -> float:
        """Distance between the ends."""
        return float(np.hypot(self.to_px[0] - self.from_px[0], self.to_px[1] - self.from_px[1]))

    @property
    def bends(self) -> bool:
        """Whether it is a curve; see `curved_axis`."""
        return False

    @property
    def direction(self) -> Floats:
        """Unit vector of growth (x, y), shape (2,)."""
        return np.subtract(self.to_px, self.from_px) / self.length_px

    @property
    def normal(self) -> Floats:
        """Unit vector across, a quarter turn from x towards y, shape (2,)."""
        along = self.direction
        return np.array([-along[1], along[0]])

    @property
    def largest_half_px(self) -> float:
        """Half the width of the widest strip along the axis whose normals do not cross."""
        return math.inf

    def direction_at(self, along_px: Floats) -> Floats:
        """Unit vectors of growth at places along the axis. Shape (..., 2)."""
        return np.broadcast_to(self.direction, (*np.shape(along_px), 2))

    def along_and_across(self, picture_px: Floats) -> tuple[Floats, Floats]:
        """Find where points of the picture lie along and across the axis, px. Shapes: picture_px (n, 2) → (n,) each."""
        from_start = np.asarray(picture_px, dtype=float) - self.from_px
        return from_start @ self.direction, from_start @ self.normal

    def points(self, along_px: Floats, across_px: Floats | float = 0.0) -> Floats:
        """Return picture coordinates of points given along and across the axis. Shape (..., 2)."""
        along, across = np.broadcast_arrays(np.asarray(along_px, float), np.asarray(across_px, float))
        start = np.asarray(self.from_px, dtype=float)
        return start + along[..., None] * self.direction + across[..., None] * self.normal


def find_axis(small: SmallPictures, grows: bool = True) -> Axis:
    """Find the growth axis from the motion."""
    if len(small.frames) < 3:
        raise RecordingError("fewer than 3 frames: no motion can be seen")
    best = _line_through(small, small.grown) if grows else _NO_LINE
    if best.collected <= 0:
        best = _line_through(small, small.changed, insist=True)
    if best.front_share < LEAST_FRONT_SHARE:
        # The vine meets a wall, bends or sweeps: the axis is that of the longest orderly beginning.
        best = _line_of_beginning(small, best, grows)
    if best.collected <= 0:
        raise RecordingError("nothing moves in the picture")
    # In full pixels, with a margin behind the line, and extended ahead to the border of the picture
    along, factor, (height, width) = np.array([np.cos(best.angle), np.sin(best.angle)]), small.factor, small.shape
    centre = (best.middle + 0.5) * factor - 0.5
    low, high = (best.ends[0] - (6.0 * best.half + 12.0)) * factor, np.inf
    for origin, unit, size in ((centre[0], along[0], width), (centre[1], along[1], height)):
        if abs(unit) > 1e-6:
            a, b = sorted([(0.0 - origin) / unit, (size - 1.0 - origin) / unit])
            low, high = max(low, a), min(high, b)
    first, last = centre + low * along, centre + high * along
    return Axis((float(first[0]), float(first[1])), (float(last[0]), float(last[1])), 2 * best.half * factor)


def _line_of_beginning(small: SmallPictures, whole: _Line, grows: bool) -> _Line:
    """The line of the beginning of a recording that collects most change in order; else that of the whole."""
    best = whole
    use_lasting = grows and small.grown is not small.changed
    # Fractions of a recording, from its start, that may be orderly where the whole is not (chosen)
    for fraction in (0.12, 0.18, 0.25, 0.32, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9):
        count = max(3, int(fraction * len(small.frames)))
        if use_lasting:  # those that change within this fraction
            pixels = small.grown.where(small.grown.time < fraction * small.grown.n_times)
        else:
            pixels = changed_pixels(small.frames[:count])
        line = _line_through(small, pixels, early_first=True)
        in_order = line.front_share * line.collected
        if line.front_share >= LEAST_FRONT_SHARE and (
            best.front_share < LEAST_FRONT_SHARE or in_order > best.front_share * best.collected
        ):
            best = line
    return best


def front_share(small: SmallPictures, axis: Axis) -> float:
    """Share of the change along an axis that is one front passing once. Only pixels whose change lasts count
    (`SmallPictures.grown`); if hardly any of it lasts (MIN_GROWN_PART), all that change count.
    """
    band = float(np.clip(0.6 * axis.width_px / small.factor, 2.0, 0.2 * np.hypot(*small.frames.shape[1:])))
    along = (along_axis(small, pixels, axis) for pixels in (small.changed, small.grown))
    near, near_lasting = (pixels.where(np.abs(pixels.y) < band) for pixels in along)
    if len(near.x) < 12:
        raise RecordingError("nothing moves along the axis")
    lasts = len(near_lasting.x) >= max(12, MIN_GROWN_PART * len(near.x))
    return share_on_front(near_lasting if lasts else near, band)


def along_axis(small: SmallPictures, pixels: Pixels, axis: Axis) -> Pixels:
    """The pixels by their places along and across an axis, all of the small pictures."""
    along, across = axis.along_and_across((np.column_stack([pixels.x, pixels.y]) + 0.5) * small.factor - 0.5)
    return pixels._replace(x=along / small.factor, y=across / small.factor)


def share_on_front(along: Pixels, band: float) -> float:
    """Share of their change that is on a front passing once along a line, of pixels by their places along it."""
    return float(along.weight[_on_front(along, band)].sum() / along.weight.sum())


def centred_on_motion(small: SmallPictures, given: Axis) -> Axis:
    """Move and turn a given axis onto the line of what moves within its width, and make it as wide as that. The ends
    keep their places along the axis: only the position across is corrected, by up to half of `given.width_px` and
    MOST_TURN_DEG. Of several bodies within the width, the one that collects more change and lies nearer is taken.
    """
    factor = small.factor
    start, stop = (((x + 0.5) / factor - 0.5, (y + 0.5) / factor - 0.5) for x, y in (given.from_px, given.to_px))
    scaled = Axis(start, stop, given.width_px / factor)
    reach = max(0.5 * scaled.width_px, 3.0)
    from_start = np.column_stack([small.changed.x, small.changed.y]) - scaled.from_px
    across = from_start @ scaled.normal
    from_middle = from_start @ scaled.direction - scaled.length_px / 2
    inside = (np.abs(across) < reach) & (np.abs(from_middle) < 0.6 * scaled.length_px)
    if inside.sum() < 12:
        raise RecordingError("nothing moves along the axis")
    # The line near the given one along which most change is collected in order; those off its middle count less.
    pixels, band = small.changed.where(inside), float(np.clip(0.25 * reach, 2.0, 6.0))
    start_rad = float(np.arctan2(scaled.direction[1], scaled.direction[0]))
    angles = start_rad + np.radians(np.arange(-MOST_TURN_DEG, MOST_TURN_DEG + 0.5, 2.0))
    half_length, middle = (int(2 * scaled.length_px) + 4) / 2, np.asarray(scaled.points(np.array(scaled.length_px / 2)))
    angle, point, value = _best_line(pixels, angles, middle, (half_length, reach), band, centred=True)
    if value <= 0:
        return given
    try:
        line = _refined_line(pixels, angle, point, 2 * band, reach)
    except RecordingError:
        return given
    turned = np.array([np.cos(line.angle), np.sin(line.angle)])
    slope = float(turned @ scaled.normal) / max(float(turned @ scaled.direction), 0.5)
    middle = line.middle - scaled.from_px
    shift = float(middle @ scaled.normal - slope * (middle @ scaled.direction)) * factor
    along = np.array([0.0, given.length_px])
    start, stop = ((float(x), float(y)) for x, y in given.points(along, shift + slope * along))
    return Axis(start, stop, 2 * line.half * factor)


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


def _line_through(small: SmallPictures, changed: Pixels, early_first: bool = False, insist: bool = False) -> _Line:
    """The best line through pixels that change; without one an empty line, or an error where `insist`."""
    if len(changed.x) < 12:
        return _NO_LINE
    diagonal = float(np.hypot(*small.frames.shape[1:]))
    band = max(3.0, 0.03 * diagonal)
    # Of a vine that bends and sweeps, early change counts most; elsewhere a door, which swings first, would too.
    discount = 1 - 0.8 * changed.time / changed.n_times if early_first else 1.0
    middle = np.array([changed.x.mean(), changed.y.mean()])
    try:
        angles, reach = np.radians(np.arange(0, 360, 6.0)), (diagonal, diagonal)
        angle, middle, _ = _best_line(changed._replace(weight=changed.weight * discount), angles, middle, reach, band)
        return _refined_line(changed, angle, middle, band, 0.2 * diagonal)
    except RecordingError:
        if insist:
            raise
        return _NO_LINE


def _best_line(
    pixels: Pixels, angles: Floats, middle: Floats, reach: tuple[float, float], band: float, centred: bool = False
) -> tuple[float, Floats, float]:
    """Direction (rad, from x towards y) and a point of the line along which most change is collected in order, and how
    much. Lines are tried in some directions, within a `reach` along and across them from `middle`; where `centred` they
    count less the further from it, a half at its border.
    """
    half_length, half_width = reach
    length, bins = math.ceil(2 * half_length) + 2 * (not centred), int(np.ceil(2 * half_width / band)) + 3
    best_value, best_angle, best_point = 0.0, float(angles[0]), middle
    from_middle = np.column_stack([pixels.x, pixels.y]) - middle
    for angle in angles.tolist():
        unit = np.array([np.cos(angle), np.sin(angle)])
        side = np.array([-unit[1], unit[0]])
        along, across = from_middle @ unit + half_length, (from_middle @ side + half_width) / band
        inside = (across >= 0) & (across < bins) & (along >= 0) & (along < length)
        near = pixels.where(inside)
        value = monotone_path_sums(along[inside], across[inside], near.time, near.weight, bins, length, near.n_times)
        offset = (np.arange(value.size) + 1) * band - half_width
        if centred:
            value = value * (1 - 0.5 * np.clip(offset / half_width, -1, 1) ** 2)
        i = int(np.argmax(value))
        if value[i] > best_value:
            best_value, best_angle, best_point = float(value[i]), angle, middle + offset[i] * side
    return best_angle, best_point, best_value


def _on_front(along: Pixels, band: float) -> Bools:
    """Mark the pixels that change when the best monotone path along a line passes them, by their places along and
    across it, px. Shape (n_pixels,).
    """
    bin_index = ((along.x - float(along.x.min())) / 2).astype(int)
    inside = np.abs(along.y) < band
    table = np.zeros((along.n_times, int(bin_index.max()) + 1))
    np.add.at(table, (along.time[inside].astype(int), bin_index[inside]), along.weight[inside])
    path = collecting_path(table)
    passing_time = np.searchsorted(path, np.arange(table.shape[1]) + 0.5)
    passed = (passing_time > 0) & (passing_time < along.n_times)
    on_time = np.abs(along.time - passing_time[bin_index]) <= order_tolerance(along.n_times)
    return inside & passed[bin_index] & on_time


def _refined_line(pixels: Pixels, angle: float, middle: Floats, band: float, most_band: float) -> _Line:
    """Refine a line until its band no longer widens; the band reaches at most `most_band` to either side."""
    # 3, 20: fewest and most times that a line is refined on the pixels that agree with it (chosen)
    for round_ in range(1, 20 + 1):
        angle, middle, half, ends, collected = _refine_once(pixels, angle, middle, band)
        narrower, band = band, float(np.clip(1.2 * half, 2.0, most_band))
        # 1.05: growth of that band in one refinement above which another follows (chosen)
        if round_ >= 3 and band < 1.05 * narrower:
            break
    return _Line(angle, middle, half, ends, collected, collected / float(pixels.weight.sum()))


def _refine_once(
    pixels: Pixels, angle: float, middle: Floats, band: float
) -> tuple[float, Floats, float, tuple[float, float], float]:
    """Principal axis of the pixels on the front: direction, point, half width, ends along it, their total weight."""
    along_unit = np.array([np.cos(angle), np.sin(angle)])
    places = np.column_stack([pixels.x, pixels.y])
    along, across = (places - middle) @ along_unit, (places - middle) @ np.array([-along_unit[1], along_unit[0]])
    on_front = _on_front(pixels._replace(x=along, y=across), band)
    if on_front.sum() < 8:
        raise RecordingError("what moves in the picture follows no line", "give the axis in the settings")
    on_front_weight, points = pixels.weight[on_front], places[on_front]
    centre = np.average(points, axis=0, weights=on_front_weight)
    covariance = np.cov((points - centre).T, aweights=on_front_weight)
    values, vectors = np.linalg.eigh(covariance)
    principal = vectors[:, 1] * np.sign(vectors[:, 1] @ along_unit)
    if values[1] < 2.0 * values[0] or principal @ along_unit < 0.8:
        principal = along_unit
    side = np.array([-principal[1], principal[0]])
    lateral = (points - centre) @ side
    shift = float(np.median(np.repeat(lateral, np.maximum(1, on_front_weight.astype(int)))))
    half = float(np.quantile(np.abs(lateral - shift), 0.95)) + 0.5
    along = (points - centre) @ principal
    ends = float(np.quantile(along, 0.002)), float(np.quantile(along, 0.998))
    direction = float(np.arctan2(principal[1], principal[0]))
    return direction, centre + shift * side, half, ends, float(on_front_weight.sum())


# ------------------------------------------------------------------------------
# Whether the growth axes of recordings agree: vines filmed by one camera grow along one line of its picture.


def slope_deg(from_px: Sequence[float], to_px: Sequence[float], *, bends: bool) -> float:
    """Direction of an axis in the picture, degrees from +x towards +y; NaN for a curve, which agrees with no line."""
    return math.nan if bends else math.degrees(math.atan2(to_px[1] - from_px[1], to_px[0] - from_px[0]))


def askew(slopes_deg: Mapping[str, float]) -> tuple[list[str], int]:
    """Recordings whose axis differs from that of most others, where most agree. Returns their names, and how many
    recordings agree; no names where fewer than three agree, or not most.
    """
    # Angle between a recording's axis and that of most others above which the recording is named (chosen)
    askew_deg = 10.0
    straight = [slope for slope in slopes_deg.values() if math.isfinite(slope)]
    agreeing = [sum(_apart_deg(slope, other) < askew_deg for other in straight) for slope in straight]
    common = straight[int(np.argmax(agreeing))] if straight else 0.0
    names = [name for name, slope in slopes_deg.items() if not _apart_deg(slope, common) < askew_deg]
    agreed = len(slopes_deg) - len(names)
    # 3: fewest recordings whose axes agree from which the others are judged (chosen)
    return (names, agreed) if 3 <= agreed > len(names) else ([], agreed)


def askew_trials(slopes_deg: Mapping[str, float], trials: Iterable[Trial]) -> list[tuple[list[str], int]]:
    """Trials whose axis was found askew to that of most others that grow at the same angle. Bodies that fly free and
    trials with a given axis are not compared.
    """
    by_angle: dict[float, dict[str, float]] = {}
    for trial in trials:
        if trial.name in slopes_deg and trial.axis is None and trial.travel_ratio != 1:
            by_angle.setdefault(trial.growth_angle_rad, {})[trial.name] = slopes_deg[trial.name]
    return [named for slopes in by_angle.values() if (named := askew(slopes))[0]]


def _apart_deg(slope: float, other: float) -> float:
    """Angle between two lines, whichever way they run, 0 to 90 degrees."""
    return abs((slope - other + 90.0) % 180.0 - 90.0)
