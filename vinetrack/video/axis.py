"""The growth axis: a line in the picture, given by the user or found from the motion.

A pixel that a growing vine covers changes once, and the times of change increase along one line. Nothing is assumed
about where the vine enters, how bright it is, or whether it rests at first. It is sought in shrunk frames. Not every
change is growth: a door, a hand or a payload passes over many pixels, while what an everting tube covers stays covered.
For lines through pairs of pixels that change, the change collected by a monotone path along each is computed by dynamic
programming; the best line is refined on the pixels that change when the path passes them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.process import njit
from vinetrack.core.records import Bools, Floats, Indices, Trial
from vinetrack.experiment.schema import SHORTEST_AXIS_PX, SMALLEST_POINT_SPACING_PX
from vinetrack.video.frames import (
    Frames,
    PacketIndex,
    Recording,
    RecordingError,
    film_shots,
    packet_index,
    quiet_log,
    read_frames,
)

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline


# ------------------------------------------------------------------------------
# Shrunk frames of a recording and the time at which each pixel changes.


MAX_FRAMES = 150  # Maximum number of frames in which the axis is sought, spread evenly over the changes (chosen)
MIN_GROWN_PART = 0.18  # Part of all change that must be growth (measured)


class Pixels(NamedTuple):
    """Pixels that change: their places, time of change and weight, shape (n_pixels,) each; and the number of times."""

    x: Floats
    y: Floats
    time: Floats
    weight: Floats
    n_times: int

    def where(self, kept: Bools) -> Pixels:
        """Return some of the pixels. Shapes: kept (n_pixels,)."""
        return Pixels(self.x[kept], self.y[kept], self.time[kept], self.weight[kept], self.n_times)


def _shrinkage(picture: NDArray[Any]) -> float:
    """Factor by which a picture is shrunk to at most 240 px (chosen)."""
    return max(1.0, max(picture.shape) / 240)


def _shrunk(picture: NDArray[Any]) -> NDArray[Any]:
    """The picture, shrunk."""
    import cv2

    width, height = (max(8, round(side / _shrinkage(picture))) for side in picture.shape[::-1])
    return np.asarray(cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA))


class SmallPictures:
    """The frames of a recording, shrunk once by a `factor` for all that looks for its axis. `frames`, (n_frames,
    height, width), are in grey levels of 255, without flicker; `shape` is their original height and width, px.
    """

    def __init__(self, luma: NDArray[Any]) -> None:
        self.shape, self.factor = luma.shape[1:], _shrinkage(luma[0])
        small = np.stack([_shrunk(frame) for frame in luma]).astype(np.float32)
        sampled = small[:, ::4, ::4] + np.float32(1.0)
        gain = np.median(sampled / sampled[len(luma) // 2], axis=(1, 2))
        small /= np.clip(gain, 0.2, 5.0)[:, None, None]
        small *= np.float32(255.0 / max(float(small.max()), 1.0))
        self.frames, self._busy = small, busy_pictures(small)

    @cached_property
    def changed(self) -> Pixels:
        """All pixels that change."""
        return changed_pixels(*self._busy)

    @cached_property
    def grown(self) -> Pixels:
        """Pixels that change as in growth, by a step that lasts. Their weight is reduced where many change at once, as
        where a door comes to rest. If too little of all change lasts (MIN_GROWN_PART), this is `changed`.
        """
        if not len(self.changed.x):
            return self.changed
        frames, noise = self._busy
        rows, columns = self.changed.y.astype(int), self.changed.x.astype(int)
        lasting = _step_fraction(frames[:, rows, columns].astype(float), self.changed.time.astype(int), noise)
        kept = self.changed.where(lasting > 0.8)  # 0.8: part of a pixel's change that the step explains (measured)
        if kept.weight.sum() < MIN_GROWN_PART * self.changed.weight.sum():
            return self.changed
        # The information of a pixel changing just when a front passes it, in nats, is minus the logarithm of the part
        # of all change that occurs at that time: where much changes at once, the order of changes says little.
        time, span = kept.time.astype(int), int(order_tolerance(kept.n_times))
        by_time = np.bincount(time, kept.weight, kept.n_times)
        share = np.convolve(by_time, np.ones(2 * span + 1))[span : span + kept.n_times] / by_time.sum()
        # 0.05: minimum information of a change, in nats (chosen)
        return kept._replace(weight=kept.weight * (0.05 - np.log(np.minimum(share[time], 1.0))))


@njit(nogil=True)
def largest_steps(pictures: np.ndarray, window: int) -> tuple[np.ndarray, np.ndarray]:
    """Find the first picture after the largest step of each pixel's brightness, and its power: (n, n_pixels) → each."""
    n, pixels = pictures.shape
    best, step_frame = np.zeros(pixels, np.float32), np.zeros(pixels, np.int_)
    block = 512
    sums = np.zeros((n + 1, block), np.float32)
    for start in range(0, pixels, block):
        stop = min(start + block, pixels)
        for t in range(n):
            for k in range(stop - start):
                sums[t + 1, k] = sums[t, k] + pictures[t, start + k]
        for t in range(1, n):
            a, b = min(n, t + window), max(0, t - window)
            after, before = np.float32(a - t), np.float32(t - b)
            factor = np.float32((a - t) * (t - b) / (a - b))
            sum_after, sum_here, sum_before = sums[a], sums[t], sums[b]
            top, place = best[start:stop], step_frame[start:stop]
            for k in range(stop - start):
                step = (sum_after[k] - sum_here[k]) / after - (sum_here[k] - sum_before[k]) / before
                score = factor * step * step
                place[k] = t if score > top[k] else place[k]
                top[k] = max(score, top[k])
    return step_frame, best


def changed_pixels(frames: NDArray[np.float32], noise_power: float) -> Pixels:
    """Find the pixels that change for good, by their largest step, in the `busy_pictures` of a recording."""
    n = len(frames)
    window = int(np.clip(n // 6, 2, 8))
    frame, best = (x.reshape(frames.shape[1:]) for x in largest_steps(frames.reshape(n, -1), window))
    floor = max(30.0 * noise_power, 0.02 * float(np.quantile(best, 0.995)))
    weight = np.where(best > floor, np.log(np.maximum(best, noise_power) / noise_power), 0.0).astype(np.float32)
    rows, columns = np.nonzero(weight > 0)
    time = frame[rows, columns].astype(float)
    return Pixels(columns.astype(float), rows.astype(float), time, weight[rows, columns].astype(float), n)


def busy_pictures(small: NDArray[np.float32]) -> tuple[NDArray[np.float32], float]:
    """At most MAX_FRAMES busy frames, and the variance of a pixel's noise in them, at least that of quantisation."""
    small = busy_frames(small, MAX_FRAMES)
    changes = np.abs(np.diff(small[:: max(1, len(small) // 30), ::2, ::2], axis=0)).ravel()
    return small, max(1.4826 * float(np.median(changes)) / np.sqrt(2), 0.7) ** 2


def busy_frames(pictures: NDArray[np.float32], most: int) -> NDArray[np.float32]:
    """At most so many frames, spread evenly over the changes rather than over time."""
    if (n := len(pictures)) <= most:
        return pictures
    # Squares: a few pixels that change much are activity, many that change a little are noise.
    activity = np.array([np.sqrt(np.mean((after - before) ** 2)) for before, after in pairwise(pictures)])
    floor = float(np.quantile(activity, 0.2))
    busy = np.clip(activity - 1.5 * floor, 0, None) + 0.02 * floor + 1e-6
    total = np.concatenate([[0.0], np.cumsum(np.minimum(busy, 4 * np.quantile(busy, 0.9)))])
    return pictures[np.unique(np.searchsorted(total, np.linspace(0, total[-1], most)).clip(0, n - 1))]


def _step_fraction(values: Floats, frame: Indices, noise_power: float) -> Floats:
    """Fraction of each pixel's variance, beyond noise, that a step at `frame` explains, (n_pixels,): hardly any where
    an object passes. Shapes: values (n_frames, n_pixels).
    """
    n, sums = len(values), np.cumsum(values, axis=0)
    before = np.take_along_axis(sums, np.maximum(frame - 1, 0)[None], axis=0)[0]
    step = before / np.maximum(frame, 1) - (sums[-1] - before) / np.maximum(n - frame, 1)
    explained = frame * (n - frame) / n * step**2
    unexplained = np.maximum(n * values.var(axis=0) - explained - n * noise_power, 0.0)
    return explained / np.maximum(explained + unexplained, 1e-9)


def order_tolerance(n_times: int) -> float:
    """Return by how many pictures a pixel may change before or after the front passes it."""
    # 0.03, 2.0: time by which the change of a pixel may differ from the passage of the front (chosen)
    return max(2.0, 0.03 * n_times)


# ------------------------------------------------------------------------------
# Monotone paths through what changes in order.

# Number of frames at either end of the recording whose median shows the scene before and after growth (chosen)
END_FRAMES = 5


@njit()
def dividing_path(evidence: np.ndarray) -> np.ndarray:
    """Find the monotone path that best separates film from background, by dynamic programming. The sum of `evidence`
    behind the edge is minimised; the edge never retreats. Shapes: evidence (n_frames, n_along) → (n_frames,).
    """
    n, columns = evidence.shape
    best = np.zeros((n, columns + 1), np.float64)
    predecessor = np.zeros((n, columns + 1), np.int32)
    for t in range(n):
        cost, best_cost, best_column = 0.0, np.inf, 0
        for s in range(columns + 1):
            if s > 0:
                cost += evidence[t, s - 1]
            if t == 0:
                best[t, s] = cost
                continue
            if best[t - 1, s] < best_cost:
                best_cost, best_column = best[t - 1, s], s
            best[t, s] = best_cost + cost
            predecessor[t, s] = best_column
    path = np.zeros(n)
    s = int(np.argmin(best[n - 1]))
    for t in range(n - 1, -1, -1):
        path[t] = s
        s = predecessor[t, s]
    return path


def collecting_path(score: NDArray[Any]) -> Floats:
    """Find the monotone path that collects the greatest sum of scores, each column counted once, when the path passes
    it; nothing where it is passed at once. Shapes: score (n_frames, n_along) → (n_frames,).
    """
    gains = np.zeros((len(score) + 1, score.shape[1]))
    gains[1:-1] = score[1:]
    return np.asarray(dividing_path(np.diff(gains, axis=0)))


def column_after_leap(path: Floats) -> int:
    """Return the column at which growth begins if the path leaps at its start: at release the tail jerks inside the
    film that stands there, and no front is three times as fast in its first frames as later. Shapes: path (n_frames,).
    """
    steps = np.diff(path)
    if not np.any(steps > 0):
        return 0
    onset = int(np.argmax(steps > 0))
    begin = 0
    for t in range(onset, min(onset + 4, len(steps) - 4)):
        # 3.0, 2.0: A first step more than so many times the median of the four that follow is not growth (chosen)
        if steps[t] > 3.0 * max(float(np.median(steps[t + 1 : t + 5])), 2.0):
            begin = int(path[t + 1])
    return begin


# ------------------------------------------------------------------------------
# Selection of the frames that show the event, so that the rest of a long recording is neither decoded nor held.
#
# A recording stopped by hand may hold thousands of frames of which tens or hundreds show the growth. A recording too
# large for memory is sampled first: the key frames of a film, which can be decoded on their own, or every n-th frame
# of other files. The event lasts from the last sample before pixels change for good to the first after it.

MAX_BYTES_WHOLE = 400_000_000  # Size of the pictures up to which a recording is read whole (chosen)
MAX_SAMPLE_INTERVAL = 120  # Maximum number of frames from one sample to the next (chosen)
MARGIN_FRAMES = 40  # Frames added at either end of the event (chosen)


def read_event(recording: Recording, frame_range: tuple[int, int] | None = None) -> Frames:
    """Decode the frames of the event, or of a range; all if it is small, not read one by one or no event stands out."""
    pixel_bytes = 1 if recording.bit_depth <= 8 else 2
    if (recording.declared_frames or 0) * recording.width * recording.height * pixel_bytes <= MAX_BYTES_WHOLE:
        return read_frames(recording)
    raw, index = recording.raw, packet_index(recording.path) if recording.kind == "container" else None
    count = len(raw.offsets) if raw else len(index.ticks) if index else 0
    if count < MAX_SAMPLE_INTERVAL:
        return read_frames(recording)
    frame_range = frame_range or event_range(*_samples(recording, index), count)
    if frame_range is None or frame_range[0] >= count:
        return read_frames(recording)
    return read_frames(recording, (frame_range[0], min(frame_range[1], count - 1)), index)


def event_range(pictures: list[NDArray[Any]], numbers: Indices, count: int) -> tuple[int, int] | None:
    """First and last frame of the event, with a margin, from samples of a recording; None if nothing changes."""
    fewest = 8  # Samples, and pixels that must have changed (chosen)
    time = SmallPictures(np.stack(pictures)).changed.time.astype(int) if len(pictures) >= fewest else np.zeros(0, int)
    if len(time) < fewest:
        return None
    time.sort()
    start, stop = int(numbers[time[fewest - 1] - 1]), int(numbers[time[-fewest]])
    return max(start - MARGIN_FRAMES, 0), min(stop + MARGIN_FRAMES, count - 1)


def _samples(recording: Recording, index: PacketIndex | None) -> tuple[list[NDArray[Any]], Indices]:
    """Every n-th frame, shrunk, and their numbers; of a film the key frames, unless these are too rare."""
    if (raw := recording.raw) is not None:
        every = -(-len(raw.offsets) // MAX_FRAMES)
        pictures = [_shrunk(picture) for picture in replace(raw, offsets=raw.offsets[::every]).pictures()]
        return pictures, every * np.arange(len(pictures))
    assert index is not None
    count, keys = len(index.ticks), np.flatnonzero(index.key)
    # Key frames so close to each other that no event fits between two of them
    keys_only = len(keys) > 1 and np.diff(keys, append=count).max() <= MAX_SAMPLE_INTERVAL
    candidates = keys if keys_only else np.arange(count)
    chosen: dict[float, int] = {int(index.ticks[i]): int(i) for i in candidates[:: -(-len(candidates) // MAX_FRAMES)]}
    with quiet_log() as said:
        shots = film_shots(recording, said, chosen=chosen if keys_only else None)
        sampled = {chosen[shot.tick]: _shrunk(picture) for picture, shot in shots if shot.tick in chosen}
    return list(sampled.values()), np.array(list(sampled), dtype=int)


# ------------------------------------------------------------------------------
# The axis.


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
    where unknown; `direction` is that of the chord.
    """

    from_px: Point
    to_px: Point
    width_px: float = float("nan")
    via_px: tuple[Point, ...] = ()

    def __post_init__(self) -> None:
        if self.bends and np.min(np.hypot(*np.diff(self.through_px, axis=0).T)) < SMALLEST_POINT_SPACING_PX:
            what = f"two neighbouring points of the growth axis are less than {SMALLEST_POINT_SPACING_PX} pixels apart"
            raise RecordingError(what, "leave out one")
        if self.length_px < SHORTEST_AXIS_PX:
            what = f"the growth axis is shorter than {SHORTEST_AXIS_PX} pixels"
            raise RecordingError(what, "move from_px and to_px apart")

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
        """Where points of a picture lie along and across the axis, px, by their nearest place on it: (n, 2) → (n,)."""
        points = np.asarray(picture_px, dtype=float)
        if not self.bends:
            offset, (x, y) = points - self.from_px, self.direction
            return offset @ self.direction, offset @ np.array([-y, x])
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
    """An axis as a JSON mapping, without its width: `from_px`, `to_px`, and of a curve `via_px`."""
    entry: dict[str, Any] = {"from_px": axis.from_px, "to_px": axis.to_px}
    return entry | ({"via_px": axis.via_px} if axis.bends else {})


def axis_from_entry(entry: Mapping[str, Any]) -> Axis:
    """Read an axis that `axis_entry` wrote."""
    width = entry.get("width_px")
    through = (entry["from_px"], *entry.get("via_px", ()), entry["to_px"])
    return axis_through(through, float("nan") if width is None else float(width))


def axis_problem(axis: Axis, half_px: float, size_px: tuple[int, int]) -> tuple[str, str] | None:
    """Why an axis cannot be used in a picture, as what follows "the axis", and the remedy; None where it can."""
    places = axis.points(np.linspace(0.0, axis.length_px, int(axis.length_px) + 2))
    if (places < -0.5).any() or (places > np.array(size_px) - 0.5).any():
        return f"leaves the picture, {size_px[0]} × {size_px[1]} pixels", "give points inside it"
    if half_px > axis.largest_half_px:
        strip = f"a strip of {half_px:.0f} px on either side"
        what = f"bends with a radius of {axis.least_radius_px:.0f} px, too sharply for {strip}"
        return what, "give fewer points or a smaller width"
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
    """Share of the growth along an axis, or in the whole picture, that is one front passing once; 0 if hardly any."""
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
    """Move and turn a given straight axis onto the line of what moves within its width, by at most half of that and
    MOST_TURN_DEG, and make it as wide as that; of several bodies the one nearer to the axis is preferred.
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
    """The line along which most change is collected in order, or an empty one. The best of those `tried` (direction and
    point), by what is `likely` within `band`, is refined until its band, at most `most_band`, no longer widens.
    """
    places, collected = np.column_stack([pixels.x, pixels.y]), [0.0]
    for angle, middle in tried:
        x, y = _along_and_side(angle) @ (places - middle).T
        may_be_best = likely[np.abs(y) < band].sum() > max(collected)  # of all change within reach
        of_line = pixels._replace(x=x, y=y)
        collected.append(float(likely[_on_front(of_line, band, 0.0)].sum()) if may_be_best else 0.0)
    if max(collected) <= 0:
        return _NO_LINE
    (angle, middle), band = tried[int(np.argmax(collected)) - 1], first_band
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
    """Mark the pixels that change when the best monotone path passes them, by their places along and across a line."""
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
    if curve is None or (of_curve := front_share(small, curve, of_picture=True)) < LEAST_FRONT_SHARE:
        return find_axis(small)
    try:
        straight = find_axis(small)
    except RecordingError:
        return curve
    of_line = front_share(small, straight, of_picture=True) / straight.width_px
    # 1.3: least ratio of what curve and line explain in a band of one width (measured)
    return curve if of_curve / curve.width_px > 1.3 * of_line else straight


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
    return None if axis_problem(axis, axis.width_px / 2, size) else axis


# ------------------------------------------------------------------------------
# Whether the growth axes of recordings agree: vines filmed by one camera grow along one line of its picture.


def askew_trials(axes: Mapping[str, Mapping[str, Any]], trials: Iterable[Trial]) -> dict[str, int]:
    """Trials whose axis (as `axis_entry` writes it) was found askew to that of most others that grow at the same angle,
    and how many agree; none where fewer than three agree, or not most. A curve agrees with no line. Bodies that fly
    free and trials with a given axis are not compared.
    """
    by_angle: dict[float, dict[str, float]] = {}
    for trial in trials:
        if trial.name in axes and trial.axis is None and trial.travel_ratio != 1:
            (x0, y0), (x1, y1) = (axes[trial.name][end] for end in ("from_px", "to_px"))
            slope = math.nan if "via_px" in axes[trial.name] else math.degrees(math.atan2(y1 - y0, x1 - x0))
            by_angle.setdefault(trial.growth_angle_rad, {})[trial.name] = slope
    # Angle between a recording's axis and that of most others above which the recording is named (chosen)
    askew_deg, found = 10.0, dict[str, int]()
    for slopes in by_angle.values():
        straight = [slope for slope in slopes.values() if math.isfinite(slope)]
        agreeing = [sum(_apart_deg(slope, other) < askew_deg for other in straight) for slope in straight]
        common = straight[int(np.argmax(agreeing))] if straight else 0.0
        names = [name for name, slope in slopes.items() if not _apart_deg(slope, common) < askew_deg]
        # 3: fewest recordings whose axes agree from which the others are judged (chosen)
        if 3 <= (agreed := len(slopes) - len(names)) > len(names):
            found |= dict.fromkeys(names, agreed)
    return found


def _apart_deg(slope: float, other: float) -> float:
    """Angle between two lines, whichever way they run, 0 to 90 degrees."""
    return abs((slope - other + 90.0) % 180.0 - 90.0)
