"""The growth axis: a line in the picture, given by the user or found from the motion itself.

Nothing is assumed about where the vine enters, how bright it is, or whether it rests at first: a pixel that a
growing vine covers changes once, and the moments of change grow along one line. Every line of a coarse fan is asked
how much change a monotone path along it collects; the best is refined by the pixels that agree with it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.experiment.cells import SHORTEST_AXIS_PX
from vinetrack.video.frames import RecordingError
from vinetrack.video.kymograph import fan_gains, passing_times
from vinetrack.video.small_pictures import LEAST_GROWN, Pixels, SmallPictures, changed_pixels, order_tolerance

LEAST_FRONT_SHARE = 0.45
"""Share of all change that one front explains where nothing else of weight goes on. Chosen: a swinging door takes a
fifth; by reasoning, at half it is taken for the axis, at twice payloads make a recording disorderly."""
MOST_TURN_DEG = 8.0
"""Chosen: how far a given axis is turned onto the motion. One drawn by hand over some hundred pixels errs by a degree
or two; with half of it an axis 5 degrees off stays off, with twice of it a wide strip lets in what crosses it."""
PREFIXES = (0.12, 0.18, 0.25, 0.32, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
"""Parts of a recording, from its beginning, that may be orderly. Chosen: steps of a quarter; more cost time alone."""
LEAST_ROUNDS, MOST_ROUNDS = 3, 20
"""Rounds in which a line is refined by the pixels that agree with it. Chosen: a line moves less than a pixel after the
third; the band widens by a seventh each, from 3 % of the picture's diagonal to the fifth that it may be in 15. With at
most half of them wide tubes are seen in part, with twice nothing changes."""
WIDENS = 1.05
"""Growth of that band in a round, from which another follows. Chosen: between none and the seventh by which it widens
within a tube. By reasoning: at twice the growth wide tubes are seen in part, at half rounds are spent on noise."""


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
                f"the growth axis is shorter than {SHORTEST_AXIS_PX} pixels; move from_px and to_px apart"
            )

    @property
    def length_px(self) -> float:
        """Distance between its ends."""
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

    def points(self, along_px: Floats, across_px: Floats | float = 0.0) -> Floats:
        """Return picture coordinates of points given along and across the axis.

        Parameters
        ----------
        along_px : distance from `from_px`, any shape, px.
        across_px : distance beside the axis, px; a number or of a shape that broadcasts.

        Returns
        -------
        (x, y), shape (..., 2), px.
        """
        along, across = np.broadcast_arrays(np.asarray(along_px, float), np.asarray(across_px, float))
        start = np.asarray(self.from_px, dtype=float)
        return start + along[..., None] * self.direction + across[..., None] * self.normal

    def moved(self, dx_px: float, dy_px: float) -> Axis:
        """Return the same axis in a picture whose origin is elsewhere.

        Parameters
        ----------
        dx_px, dy_px : what is added to both ends, px.

        Returns
        -------
        the axis.
        """
        a, b = self.from_px, self.to_px
        return Axis((a[0] + dx_px, a[1] + dy_px), (b[0] + dx_px, b[1] + dy_px), self.width_px)


FrontShare = Callable[[Axis], float]
"""How much of what changes along an axis is a front that passes once; see `front_share`."""


def find_axis(luma: NDArray[Any] | SmallPictures, grows: bool = True) -> Axis:
    """Find the axis of growth from the motion itself.

    Parameters
    ----------
    luma : brightness, shape (n_frames, height, width), or the small pictures made from it.
    grows : whether it is a tube that stays where it has grown, and not a body that passes.

    Returns
    -------
    the axis, px.

    Raises
    ------
    RecordingError
        Where nothing moves, or what moves follows no line.
    """
    seen = luma if isinstance(luma, SmallPictures) else SmallPictures(luma)
    small = seen.frames
    if len(small) < 3:
        raise RecordingError("fewer than 3 frames: no motion can be seen")
    best = _line_of(small, seen.grown) if grows else _NO_LINE
    if best.collected <= 0:
        best = _line_of(small, seen.changed, insist=True)
    if best.order < LEAST_FRONT_SHARE:
        # It meets a wall, bends, sweeps: the longest beginning that is orderly tells the axis.
        stays = grows and seen.grown is not seen.changed
        for part in PREFIXES:
            count = max(3, int(part * len(small)))
            shorter = _line_of(small, _until(part, seen.grown) if stays else changed_pixels(small, count), patient=True)
            worth = shorter.order * shorter.collected
            if shorter.order >= LEAST_FRONT_SHARE and (
                best.order < LEAST_FRONT_SHARE or worth > best.order * best.collected
            ):
                best = shorter
    if best.collected <= 0:
        raise RecordingError("nothing moves in the picture")
    return _to_picture(best, seen.factor, seen.shape)


def front_share(luma: NDArray[Any] | SmallPictures, axis: Axis) -> float:
    """How much of what grows along `axis` is a front that passes once.

    Where hardly any of what changes along it stays (LEAST_GROWN), all that changes there is asked instead.

    Parameters
    ----------
    luma : brightness, shape (n_frames, height, width), or the small pictures made from it.
    axis : in the picture, px.

    Returns
    -------
    its share, 0 to 1: less than LEAST_FRONT_SHARE where the vine bends or sweeps away.

    Raises
    ------
    RecordingError
        Where nothing moves along the axis.
    """
    seen = luma if isinstance(luma, SmallPictures) else SmallPictures(luma)
    scaled = _shrunk(axis, seen.factor)
    angle = float(np.arctan2(scaled.direction[1], scaled.direction[0]))
    band = float(np.clip(0.6 * scaled.width_px, 2.0, 0.2 * np.hypot(*seen.frames.shape[1:])))
    line, grown = _beside(seen.changed, scaled, band), _beside(seen.grown, scaled, band)
    n_times = seen.changed[-1]
    if len(line[0]) < 12:
        raise RecordingError("nothing moves along the axis")
    if len(grown[0]) >= max(12, LEAST_GROWN * len(line[0])):
        line = grown
    agree, _, _ = pixels_on_front(*line, n_times, angle, np.array(scaled.from_px), band)
    return float(line[3][agree].sum() / line[3].sum())


def _beside(pixels: Pixels, axis: Axis, band: float) -> tuple[Floats, Floats, Floats, Floats]:
    """Place, time and worth of those pixels that lie nearer to an axis than `band`."""
    x, y, time, weight, _ = pixels
    near = np.abs((np.column_stack([x, y]) - axis.from_px) @ axis.normal) < band
    return x[near], y[near], time[near], weight[near]


def centred_on_motion(luma: NDArray[Any] | SmallPictures, given: Axis) -> Axis:
    """A given axis moved and turned onto the line of what moves within its width, and as wide as that.

    It keeps its ends' places along itself: only what lies across is corrected, by up to half of `given.width_px` and
    MOST_TURN_DEG. Of several bodies within the width the one that collects more change, and lies nearer, is taken.

    Parameters
    ----------
    luma : brightness, shape (n_frames, height, width), or the small pictures made from it.
    given : axis in the picture, its width that of the strip to look in, px.

    Returns
    -------
    the axis; the given one where no line passes near it.

    Raises
    ------
    RecordingError
        Where nothing moves within the width.
    """
    seen = luma if isinstance(luma, SmallPictures) else SmallPictures(luma)
    scaled, factor = _shrunk(given, seen.factor), seen.factor
    x, y, time, weight, n_times = seen.changed
    reach = max(0.5 * scaled.width_px, 3.0)
    offset = np.column_stack([x, y]) - scaled.from_px
    across = offset @ scaled.normal
    near = (np.abs(across) < reach) & (
        np.abs(offset @ scaled.direction - scaled.length_px / 2) < 0.6 * scaled.length_px
    )
    if near.sum() < 12:
        raise RecordingError("nothing moves along the axis")
    pixels = x[near], y[near], time[near], weight[near], n_times
    line = _line_near(*pixels, scaled, reach)
    if line is None:
        return given
    turned = np.array([np.cos(line.angle), np.sin(line.angle)])
    slope = float(turned @ scaled.normal) / max(float(turned @ scaled.direction), 0.5)
    middle = line.middle - scaled.from_px
    shift = float(middle @ scaled.normal - slope * (middle @ scaled.direction)) * factor
    start = given.points(np.array(0.0), shift)
    stop = given.points(np.array(given.length_px), shift + slope * given.length_px)
    ends = (float(start[0]), float(start[1])), (float(stop[0]), float(stop[1]))
    return Axis(*ends, 2 * line.half * factor)


@dataclass(frozen=True)
class _Line:
    """A line in the small pictures and how much change it collects: `order` is its share of all change."""

    angle: float
    middle: Floats
    half: float
    ends: tuple[float, float]
    collected: float
    order: float


_NO_LINE = _Line(0.0, np.zeros(2), 1.0, (0.0, 0.0), 0.0, 0.0)


def _shrunk(axis: Axis, factor: float) -> Axis:
    """The axis in a picture that is smaller by a factor."""
    (a, b), (c, d) = axis.from_px, axis.to_px
    ends = [((x + 0.5) / factor - 0.5, (y + 0.5) / factor - 0.5) for x, y in ((a, b), (c, d))]
    return Axis(ends[0], ends[1], axis.width_px / factor)


def _until(part: float, pixels: Pixels) -> Pixels:
    """Those of some pixels that change in a part of the time, from its beginning."""
    x, y, time, weight, n_times = pixels
    early = time < part * n_times
    return x[early], y[early], time[early], weight[early], n_times


def _line_of(small: NDArray[np.float32], changed: Pixels, patient: bool = False, insist: bool = False) -> _Line:
    """The best line through pixels that change; where none is, an empty one, or an error where one is insisted on."""
    x, y, time, weight, n_times = changed
    if len(x) < 12:
        return _NO_LINE
    diagonal = float(np.hypot(*small.shape[1:]))
    band = max(3.0, 0.03 * diagonal)
    # Of a vine that bends and sweeps what comes first counts most; else a door, which swings first, would count too.
    early = weight * (1 - 0.8 * time / n_times) if patient else weight
    try:
        angle, middle = _best_line(x, y, time, early, n_times, band, diagonal)
        return _converged(changed, angle, middle, band, 0.2 * diagonal)
    except RecordingError:
        if insist:
            raise
        return _NO_LINE


def _line_near(
    x: Floats, y: Floats, time: Floats, weight: Floats, n_times: int, given: Axis, reach: float
) -> _Line | None:
    """The line near a given one along which most change is collected in order, refined; None where none is.

    All in the small pictures. Lines that leave the middle of the given width count less, to a half at its border.
    """
    band = float(np.clip(0.25 * reach, 2.0, 6.0))
    start = float(np.arctan2(given.direction[1], given.direction[0]))
    middle = np.asarray(given.points(np.array(given.length_px / 2)))
    length = int(2 * given.length_px) + 4
    bins = int(np.ceil(2 * reach / band)) + 3
    best, angle, point = 0.0, start, middle
    for turn in np.radians(np.arange(-MOST_TURN_DEG, MOST_TURN_DEG + 0.5, 2.0)):
        unit = np.array([np.cos(start + turn), np.sin(start + turn)])
        side = np.array([-unit[1], unit[0]])
        place = np.column_stack([x, y]) - middle
        along, across = place @ unit + length / 2, (place @ side + reach) / band
        inside = (across >= 0) & (across < bins) & (along >= 0) & (along < length)
        gathered = fan_gains(along[inside], across[inside], time[inside], weight[inside], bins, length, n_times)
        away = (np.arange(gathered.size) + 1) * band - reach
        worth = gathered * (1 - 0.5 * np.clip(away / reach, -1, 1) ** 2)
        i = int(np.argmax(worth))
        if worth[i] > best:
            best, angle, point = float(worth[i]), start + float(turn), middle + away[i] * side
    if best <= 0:
        return None
    try:
        return _converged((x, y, time, weight, n_times), angle, point, 2 * band, reach)
    except RecordingError:
        return None


def _best_line(
    x: Floats, y: Floats, time: Floats, weight: Floats, n_times: int, band: float, diagonal: float
) -> tuple[float, Floats]:
    """Direction (rad, x towards y) and a point of the line along which most change is collected in order."""
    middle = np.array([x.mean(), y.mean()])
    bins = int(np.ceil(2 * diagonal / band)) + 3
    best, chosen = -1.0, (0.0, middle)
    for angle in np.radians(np.arange(0, 360, 6.0)):
        along = (x - middle[0]) * np.cos(angle) + (y - middle[1]) * np.sin(angle)
        across = -(x - middle[0]) * np.sin(angle) + (y - middle[1]) * np.cos(angle)
        gathered = fan_gains(
            along + diagonal, (across + diagonal) / band, time, weight, bins, int(2 * diagonal) + 2, n_times
        )
        i = int(np.argmax(gathered))
        if gathered[i] > best:
            offset = (i + 1) * band - diagonal
            best = float(gathered[i])
            chosen = (float(angle), middle + offset * np.array([-np.sin(angle), np.cos(angle)]))
    return chosen


def pixels_on_front(
    x: Floats, y: Floats, time: Floats, weight: Floats, n_times: int, angle: float, middle: Floats, band: float
) -> tuple[NDArray[np.bool_], Floats, Floats]:
    """Find the pixels that change when the best ordered path along a line passes them.

    Parameters
    ----------
    x, y : places of pixels that change, shape (n_pixels,), px.
    time, weight : when, counted in pictures, and how much; shape (n_pixels,).
    n_times : pictures.
    angle, middle : direction of the line, rad, and a point on it, px.
    band : distance from the line within which pixels count, px.

    Returns
    -------
    which agree, shape (n_pixels,), and the places of all along and across the line, px.
    """
    along = (x - middle[0]) * np.cos(angle) + (y - middle[1]) * np.sin(angle)
    across = -(x - middle[0]) * np.sin(angle) + (y - middle[1]) * np.cos(angle)
    place = ((along - float(along.min())) / 2).astype(int)
    near = np.abs(across) < band
    table = np.zeros((n_times, int(place.max()) + 1))
    np.add.at(table, (time[near].astype(int), place[near]), weight[near])
    passed = passing_times(table)
    agree = near & (np.abs(time - passed[place]) <= order_tolerance(n_times))
    return agree, along, across


def _converged(pixels: Pixels, angle: float, middle: Floats, band: float, most_band: float) -> _Line:
    """The line refined until its band, at most `most_band` wide to either side, no longer widens."""
    for round_ in range(1, MOST_ROUNDS + 1):
        angle, middle, half, ends, collected = _refine(*pixels, angle, middle, band)
        narrower, band = band, float(np.clip(1.2 * half, 2.0, most_band))
        if round_ >= LEAST_ROUNDS and band < WIDENS * narrower:
            break
    return _Line(angle, middle, half, ends, collected, collected / float(pixels[3].sum()))


def _refine(
    x: Floats, y: Floats, time: Floats, weight: Floats, n_times: int, angle: float, middle: Floats, band: float
) -> tuple[float, Floats, float, tuple[float, float], float]:
    """Line through the pixels that agree with a path: direction, point, half width, ends along it, their worth."""
    along_unit = np.array([np.cos(angle), np.sin(angle)])
    agree, _, _ = pixels_on_front(x, y, time, weight, n_times, angle, middle, band)
    if agree.sum() < 8:
        raise RecordingError("what moves in the picture follows no line; give the axis in the settings")
    w = weight[agree]
    points = np.column_stack([x, y])[agree]
    centre = np.average(points, axis=0, weights=w)
    spread = np.cov((points - centre).T, aweights=w)
    values, vectors = np.linalg.eigh(spread)
    main = vectors[:, 1] * np.sign(vectors[:, 1] @ along_unit)
    if values[1] < 2.0 * values[0] or main @ along_unit < 0.8:
        main = along_unit
    side = np.array([-main[1], main[0]])
    lateral = (points - centre) @ side
    shift = float(np.median(np.repeat(lateral, np.maximum(1, w.astype(int)))))
    half = float(np.quantile(np.abs(lateral - shift), 0.95)) + 0.5
    s = (points - centre) @ main
    ends = float(np.quantile(s, 0.002)), float(np.quantile(s, 0.998))
    return float(np.arctan2(main[1], main[0])), centre + shift * side, half, ends, float(w.sum())


def _to_picture(line: _Line, factor: float, shape: tuple[int, ...]) -> Axis:
    """Back to full pixels, with room behind, and ahead as far as the picture goes."""
    along, (height, width) = np.array([np.cos(line.angle), np.sin(line.angle)]), shape
    room = 6.0 * line.half + 12.0
    centre = (line.middle + 0.5) * factor - 0.5
    start, stop = (line.ends[0] - room) * factor, np.inf
    low, high = -np.inf, np.inf
    for origin, unit, size in ((centre[0], along[0], width), (centre[1], along[1], height)):
        if abs(unit) > 1e-6:
            a, b = sorted([(0.0 - origin) / unit, (size - 1.0 - origin) / unit])
            low, high = max(low, a), min(high, b)
    start, stop = max(start, low), min(stop, high)
    first, last = centre + start * along, centre + stop * along
    return Axis((float(first[0]), float(first[1])), (float(last[0]), float(last[1])), 2 * line.half * factor)
