"""A straight strip along the axis, cut from every frame, freed of flicker and of camera shake.

The bands beside the tube show what stands still. Each frame's gain and shift come from them, by least squares on the
mean picture and its slopes, robust against what does move there (a door, a hand).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.video.axis import Axis
from vinetrack.video.order_kernels import BINS_A_LEVEL, median
from vinetrack.video.resample import warp_all

GAP_PX = 5
"""Rows left out between tube and band, for sway and blur. Chosen; at half a swaying tube enters the bands, at twice
small pictures have none."""
BAND_PX = (14, 44)
"""Least and greatest height of a band. Chosen: at the least, two bands hold PIXELS along 320 px of axis. Half or twice
changes how well flicker is known."""
REFERENCE_FRAMES = 15
"""Frames whose mean is what all are compared with. Chosen: its noise is then a quarter of a frame's."""

PIXELS = 9000
"""Pixels of the bands that are used, evenly spread: enough for a shift of 0.01 px. Derived for slopes of 5 grey levels
a pixel and noise of 5: 1/√9000 = 0.01 px."""
SHAKE_FLOOR_PX = 0.04
"""Shake below this is left alone: moving a picture by it costs more than it mends. Chosen as FLOOR_PX of
`point_quality`."""
SHAKE_ROUNDS = 4
"""Times that a shake is measured, each against what the one before left. Chosen: each leaves a small part of it, more
cost time alone. Derived: pictures are followed over SHAKE_ROUNDS · SHAKE_STEP_PX = 6 px at most, at half over 3 px, at
twice over 12 px."""
SHAKE_STEP_PX = 1.5
"""Most that a round moves a picture. Chosen: its slopes tell of no more. Half or twice halves or doubles the 6 px of
SHAKE_ROUNDS; at twice a picture that departs for other reasons is also moved by twice as much."""
SHAKE_SETTLED_PX = 0.02
"""Shift of a round below which it is the last. Chosen: a fifth of the error of a shake that was taken off, and half of
SHAKE_FLOOR_PX. At half another round is made, at twice up to that floor is left."""
HALVES_APART = 0.7
"""Shift between both halves of the bands, over their sum, below which a camera shook. Measured on clips of seeds 1 to 6
of `benchmarks/tracking_accuracy.py`: 0.03 to 0.36 where it did, 0.89 to 1.02 where film and doors move one half alone.
At half a shake is left in; at twice film shakes the strip."""


@dataclass(frozen=True)
class Strip:
    """Pixels along the axis of every frame.

    `values` has shape (n_frames, n_across, n_along), as the camera wrote them; `scale * values + offset` (shape
    (n_frames,) each) is in grey levels of 255, free of flicker. `shift_px`, shape (n_frames, 2), is how far the
    picture had moved along and across (already undone); `noise` the standard deviation of a pixel, grey levels.
    `axis` runs through column 0 and along the middle row.
    """

    values: NDArray[Any]
    scale: Floats
    offset: Floats
    shift_px: Floats
    noise: float
    axis: Axis
    steadied: bool

    @property
    def shake_px(self) -> Floats | None:
        """`shift_px` where a shake was taken off, else None."""
        return self.shift_px if self.steadied else None


def cut_strip(luma: NDArray[Any], axis: Axis, half_px: float, still: bool = False) -> Strip:
    """Cut, level and steady the strip on both sides of an axis.

    Parameters
    ----------
    luma : grey levels, shape (n_frames, height, width).
    axis : in the picture, px.
    half_px : half the height of the strip, px.
    still : whether the pictures are known not to shake: they are levelled alone.

    Returns
    -------
    the strip.
    """
    half = int(np.ceil(half_px))
    bands = _band_rows(luma.shape[1:], axis, half)
    unit = camera_unit(luma)
    n = len(luma)
    scale, offset, shift = np.full(n, unit), np.zeros(n), np.zeros((n, 2))
    steadied = False
    if bands:
        scale, offset, shift, steadied = _steady(luma, axis, bands, unit, still)
    values = sample(luma, axis, np.arange(-half, half + 1), shift if steadied else None)
    return Strip(values, scale, offset, shift, _noise(values, scale), axis, steadied)


def recut(strip: Strip, luma: NDArray[Any], axis: Axis, half_px: float) -> Strip:
    """Cut the same frames along a slightly different axis; gain and shift are those of `strip`.

    Parameters
    ----------
    strip : the first cut.
    luma : grey levels, shape (n_frames, height, width).
    axis : in the picture, px.
    half_px : half the height of the strip, px.

    Returns
    -------
    the strip.
    """
    half = int(np.ceil(half_px))
    values = sample(luma, axis, np.arange(-half, half + 1), strip.shake_px)
    return replace(strip, values=values, axis=axis)


def sample(luma: NDArray[Any], axis: Axis, rows_px: NDArray[np.int_], shift_px: Floats | None = None) -> NDArray[Any]:
    """Values at whole pixels along the axis and at `rows_px` (consecutive) across; shape (n, n_rows, n_along).

    An axis along the picture's own rows or columns is cut out without interpolation, moved by less than half a
    pixel for it; `shift_px` (n, 2) moves every frame back by its own shift.

    Parameters
    ----------
    luma : grey levels, shape (n_frames, height, width).
    axis : in the picture, px.
    rows_px : consecutive distances beside the axis, shape (n_rows,), px.
    shift_px : shake of every frame along and across, shape (n_frames, 2), px.

    Returns
    -------
    grey levels, shape (n_frames, n_rows, n_along).
    """
    import cv2

    n_along = int(np.floor(axis.length_px)) + 1
    along, across = axis.direction, axis.normal
    start = axis.points(np.array(0.0), float(rows_px[0]))
    if shift_px is None and max(abs(along)) > 1 - 1e-9:
        return _slice(luma, start, along, across, len(rows_px), n_along)
    if shift_px is None:
        return warp_all(luma, _matrix(along, across, start), len(rows_px), n_along)
    out = np.empty((len(luma), len(rows_px), n_along), luma.dtype)
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    for i, frame in enumerate(luma):
        matrix = _matrix(along, across, start + shift_px[i, 0] * along + shift_px[i, 1] * across)
        cv2.warpAffine(frame, matrix, (n_along, len(rows_px)), dst=out[i], flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return out


def _matrix(along: Floats, across: Floats, origin: Floats) -> Floats:
    """Matrix of places in the picture: matrix @ (along, row, 1), shape (2, 3)."""
    return np.array([[along[0], across[0], origin[0]], [along[1], across[1], origin[1]]])


def _slice(luma: NDArray[Any], start: Floats, along: Floats, across: Floats, n_rows: int, n_along: int) -> NDArray[Any]:
    """Whole pixels of an axis that runs along rows or columns of the picture; outside it the border repeats."""
    x = np.rint(
        start[0] + np.arange(n_along) * along[0] if abs(along[0]) > 0.5 else start[0] + np.arange(n_rows) * across[0]
    )
    y = np.rint(
        start[1] + np.arange(n_rows) * across[1] if abs(along[0]) > 0.5 else start[1] + np.arange(n_along) * along[1]
    )
    columns = np.clip(x, 0, luma.shape[2] - 1).astype(int)
    rows = np.clip(y, 0, luma.shape[1] - 1).astype(int)
    part = _take(_take(luma, rows, 1), columns, 2)
    return np.ascontiguousarray(part if abs(along[0]) > 0.5 else part.transpose(0, 2, 1))


def _take(luma: NDArray[Any], index: NDArray[np.int_], dim: int) -> NDArray[Any]:
    """Consecutive indices as a view, others as a copy."""
    steps = np.diff(index)
    if len(steps) and np.all(steps == 1):
        chosen = slice(int(index[0]), int(index[-1]) + 1)
        return luma[:, chosen] if dim == 1 else luma[:, :, chosen]
    return np.take(luma, index, axis=dim)


def squared(axis: Axis) -> Axis:
    """The axis turned and moved onto whole rows or columns where it is that already but for 0.2 px of slope.

    Cutting is then exact. The slope is forgiven over the whole length, not per pixel.

    Parameters
    ----------
    axis : in the picture, px.

    Returns
    -------
    the axis, or the same where it slopes by more or is a curve.
    """
    if type(axis) is not Axis:
        return axis
    (x0, y0), (x1, y1) = axis.from_px, axis.to_px
    if abs(y1 - y0) <= 0.4 and abs(x1 - x0) > 10:
        y = round((y0 + y1) / 2)
        return Axis((round(x0), y), (round(x1), y), axis.width_px)
    if abs(x1 - x0) <= 0.4 and abs(y1 - y0) > 10:
        x = round((x0 + x1) / 2)
        return Axis((x, round(y0)), (x, round(y1)), axis.width_px)
    return axis


def camera_unit(luma: NDArray[Any]) -> float:
    """Return the grey levels of 255 in one unit of the camera's.

    Parameters
    ----------
    luma : grey levels, shape (n_frames, height, width).

    Returns
    -------
    grey levels.
    """
    if luma.dtype == np.uint8:
        return 1.0
    top = float(np.max(luma[:: max(1, len(luma) // 8), ::2, ::2]))
    return 255.0 / max(top, 1.0)


def _band_rows(shape: tuple[int, ...], axis: Axis, half: int) -> list[NDArray[np.int_]]:
    """Rows of the bands on both sides, as far as they lie inside the picture along the whole axis."""
    height, width = shape
    bands = []
    deep = int(np.clip(half, *BAND_PX))
    for side in (-1, 1):
        rows = np.arange(half + GAP_PX, half + GAP_PX + deep) * side
        ends = axis.points(np.array([[0.0], [axis.length_px]]), rows[None, :].astype(float))
        inside = ((ends > -0.5) & (ends < [width - 0.5, height - 0.5])).all(axis=(0, 2))
        kept = np.sort(rows[inside])
        if len(kept) >= 6:
            bands.append(kept)
    return bands


@dataclass(frozen=True)
class Reference:
    """Pixels of the bands with which frames are compared: where they lie, and what they show on average.

    `along_px` and `across_px`, shape (n_pixels,), whole numbers; `basis`, shape (4, n_pixels): mean picture, one, and
    its slopes along and across.
    """

    along_px: Floats
    across_px: Floats
    basis: Floats


def _steady(
    luma: NDArray[Any], axis: Axis, bands: list[NDArray[np.int_]], unit: float, still: bool
) -> tuple[Floats, Floats, Floats, bool]:
    """Gain, level and shift of every frame against the mean picture of its bands."""
    n = len(luma)
    shift = np.zeros((n, 2))
    fit, steadied = np.zeros((n, 4)), False
    picks = np.unique(np.linspace(0, n - 1, REFERENCE_FRAMES).astype(int))
    means = _mean_pictures(luma, axis, bands, picks, None)
    reference = _reference(means, bands)
    for turn in range(SHAKE_ROUNDS):
        fit, sd = register(luma, axis, reference, shift if turn else None, unit)
        if turn == 0:
            strength = float(np.median(np.abs(fit[:, 2:]))), float(np.median(sd))
            if still or not np.isfinite(strength[1]) or strength[0] < max(SHAKE_FLOOR_PX, 2.5 * strength[1]):
                break
            if not _halves_agree(luma, axis, bands, means, unit):
                break
            steadied = True
        shift = shift + np.clip(fit[:, 2:], -SHAKE_STEP_PX, SHAKE_STEP_PX)
        if turn == 1:
            reference = _reference(_mean_pictures(luma, axis, bands, picks, shift), bands)
        if turn > 1 and float(np.abs(fit[:, 2:]).max()) < SHAKE_SETTLED_PX:
            break
    gain = np.clip(fit[:, 0], 0.2, 5.0)
    return unit / gain, -fit[:, 1] * unit / gain, shift, steadied


def _halves_agree(
    luma: NDArray[Any], axis: Axis, bands: list[NDArray[np.int_]], means: list[NDArray[np.float32]], unit: float
) -> bool:
    """Whether the near and the far half of the bands tell of the same shift: a shaken camera moves both alike.

    A door, a shadow or a mirror image of the tip that passes moves one after the other. A shift of a pixel is more than
    the slopes of a picture tell at once, and what one half makes of it is not what the other does: each is followed
    until it is found.
    """
    columns = means[0].shape[1]
    shifts, errors = [], []
    for low, high in ((0, columns // 2), (columns // 2, columns)):
        reference, shift, sd = _reference(means, bands, (low, high)), np.zeros((len(luma), 2)), np.zeros(len(luma))
        for turn in range(SHAKE_ROUNDS):
            fit, sd = register(luma, axis, reference, shift if turn else None, unit)
            shift = shift + np.clip(fit[:, 2:], -SHAKE_STEP_PX, SHAKE_STEP_PX)
        shifts.append(shift)
        errors.append(sd)
    first, second = shifts
    apart, both = np.hypot(*(first - second).T), np.hypot(*(first + second).T)
    most = apart + both >= np.quantile(apart + both, 0.75)
    sd_sum = float(np.median(errors[0] + errors[1]))
    return float(np.mean(apart[most])) < max(HALVES_APART * float(np.mean(both[most])), 2 * sd_sum)


def _mean_pictures(
    luma: NDArray[Any], axis: Axis, bands: list[NDArray[np.int_]], picks: NDArray[np.int_], shift_px: Floats | None
) -> list[NDArray[np.float32]]:
    """Median of some frames in each band, shape (n_rows, n_along)."""
    chosen = luma[picks]
    views = [sample(chosen, axis, rows, None if shift_px is None else shift_px[picks]) for rows in bands]
    return [np.median(view, axis=0).astype(np.float32) for view in views]


def _reference(
    means: list[NDArray[np.float32]], bands: list[NDArray[np.int_]], columns: tuple[int, int] | None = None
) -> Reference:
    """About PIXELS pixels of the bands, between two columns, with what they show on average."""
    low, high = columns or (0, means[0].shape[1])
    parts, along, across = [], [], []
    for picture, rows in zip(means, bands, strict=True):
        part = (slice(1, -1), slice(low + 1, high - 1))
        slopes = -np.gradient(picture, axis=1)[part], -np.gradient(picture, axis=0)[part]
        parts.append(np.stack([x.ravel() for x in (picture[part], np.ones_like(picture[part]), *slopes)]))
        grid = np.meshgrid(np.arange(low + 1, high - 1), rows[1:-1])
        along.append(grid[0].ravel())
        across.append(grid[1].ravel())
    basis = np.concatenate(parts, axis=1)
    every = max(1, basis.shape[1] // PIXELS)
    return Reference(
        np.concatenate(along)[::every].astype(float), np.concatenate(across)[::every].astype(float),
        np.ascontiguousarray(basis[:, ::every], dtype=np.float64),
    )  # fmt: skip


def _pixels(luma: NDArray[Any], axis: Axis, reference: Reference, shift_px: Floats | None) -> NDArray[Any]:
    """The pixels of a reference in every frame, as `sample` would cut them, shape (n_frames, n_pixels)."""
    import cv2

    along, across = axis.direction, axis.normal
    start = axis.points(reference.along_px, reference.across_px)
    if shift_px is None and max(abs(along)) > 1 - 1e-9:
        x, y = (np.clip(np.rint(start[:, i]), 0, luma.shape[2 - i] - 1).astype(int) for i in (0, 1))
        return luma[:, y, x]
    # Rows of a thousand: OpenCV takes no picture wider than 32767 pixels.
    wide = -(-len(start) // 1000)
    place = np.pad(start, ((0, wide * 1000 - len(start)), (0, 0)), mode="edge").reshape(wide, 1000, 2)
    out = np.empty((len(luma), len(start)), luma.dtype)
    for i, frame in enumerate(luma):
        moved = place if shift_px is None else place + shift_px[i, 0] * along + shift_px[i, 1] * across
        x, y = moved[..., 0].astype(np.float32), moved[..., 1].astype(np.float32)
        seen = np.asarray(cv2.remap(frame, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE))
        out[i] = seen.ravel()[: len(start)]
    return out


def register(
    luma: NDArray[Any], axis: Axis, reference: Reference, shift_px: Floats | None, unit: float
) -> tuple[Floats, Floats]:
    """Compare every frame with what stands still, robustly.

    frame(x) = gain · picture(x − shift) + level. Where the bands show no texture the level is held near zero and the
    shift is left at zero.

    Parameters
    ----------
    luma : grey levels, shape (n_frames, height, width).
    axis : the reference's places lie along and across it, px.
    reference : what stands still.
    shift_px : what every frame is moved back by first, along and across, shape (n_frames, 2), px.
    unit : grey levels in one unit of the camera's.

    Returns
    -------
    gain, level, shift along and across of every frame, shape (n_frames, 4), and the error of the shift, (n_frames,).
    """
    basis = reference.basis
    level = float(np.abs(basis[0]).mean()) + 1e-9
    count = basis.shape[1]
    ridge = np.diag([0.0, 25.0 * count * (2.0 / level) ** 2 * 0.01, 1e-3 * level, 1e-3 * level])
    solution, error = _robust_fits(_pixels(luma, axis, reference, shift_px), basis, ridge, unit)
    gain = np.maximum(solution[:, 0], 0.05)
    return np.column_stack([gain, solution[:, 1], solution[:, 2] / gain, solution[:, 3] / gain]), error


@njit(cache=True, nogil=True, fastmath={"contract", "arcp", "nsz", "reassoc"}, error_model="numpy")
def _robust_fits(data: np.ndarray, basis: np.ndarray, ridge: np.ndarray, unit: float) -> tuple[np.ndarray, np.ndarray]:
    """Least squares of every frame on the rows of `basis`, once more without what strays by four standard deviations.

    Where a gain alone, the ratio of the medians, leaves less to the median pixel than least squares of all do, it
    tells what strays: a door that stands where the picture is brightest turns least squares so far that the door
    stays in.

    `data` has shape (n_frames, n_pixels), `basis` (4, n_pixels); the answer the coefficients (n_frames, 4) and the
    standard error of the third, (n_frames,).
    """
    n, count = data.shape
    out, error = np.zeros((n, 4)), np.full(n, np.inf)
    strays, keep, everywhere = np.empty(count), np.ones(count), np.ones(count)
    whole, fine = basis @ basis.T + ridge, unit * BINS_A_LEVEL
    usual = max(median(basis[0], everywhere, fine), 1e-9)
    for t in range(n):
        keep[:] = 1.0
        values = data[t]
        for turn in range(2):
            r0, r1, r2, r3 = 0.0, 0.0, 0.0, 0.0
            for k in range(count):
                value = keep[k] * values[k]
                r0 += value * basis[0, k]
                r1 += value * basis[1, k]
                r2 += value * basis[2, k]
                r3 += value * basis[3, k]
            inverse = np.linalg.inv(whole if turn == 0 else _products(basis, keep) + ridge)
            a, b, c, d = inverse @ np.array([r0, r1, r2, r3])
            for k in range(count):
                strays[k] = abs(values[k] - a * basis[0, k] - b * basis[1, k] - c * basis[2, k] - d * basis[3, k])
            size = 1.4826 * median(strays, keep, fine) + 0.3
            out[t, 0], out[t, 1], out[t, 2], out[t, 3] = a, b, c, d
            error[t] = size * np.sqrt(max(inverse[2, 2], 0.0))
            if turn == 0:
                gain = median(values.astype(np.float64), everywhere, fine) / usual
                bare = np.abs(values - gain * basis[0])
                bare_size = 1.4826 * median(bare, everywhere, fine) + 0.3
                if bare_size < size:
                    strays, size = bare, bare_size
            inside = 0.0
            for k in range(count):
                keep[k] = 1.0 if strays[k] < 4 * size else 0.0
                inside += keep[k]
            if inside > 0.99 * count:
                break
    return out, error


@njit(cache=True, nogil=True, fastmath={"contract", "arcp", "nsz", "reassoc"}, error_model="numpy")
def _products(basis: np.ndarray, keep: np.ndarray) -> np.ndarray:
    """Sums of products of the rows of `basis`, (4, 4), over the pixels that are kept."""
    out = np.empty((4, 4))
    for i in range(4):
        for j in range(i, 4):
            total, first, second = 0.0, basis[i], basis[j]
            for k in range(len(keep)):
                total += keep[k] * first[k] * second[k]
            out[i, j] = out[j, i] = total
    return out


def _noise(values: NDArray[Any], scale: Floats) -> float:
    """Standard deviation of a pixel from the differences of neighbouring frames, grey levels, at least 1.

    The median over frames and pixels: motion touches few of them. Compression freezes a resting picture; what moves
    is never known better than a grey level.
    """
    step = max(1, len(values) // 40)
    first, second = values[:-1:step, ::2, ::2], values[1::step, ::2, ::2]
    n = min(len(first), len(second))
    change = np.abs(second[:n].astype(np.float32) - first[:n].astype(np.float32))
    middle = np.median(change, axis=(1, 2)) if n else np.zeros(1)
    return max(1.0, float(np.quantile(middle, 0.7)) * 1.4826 / np.sqrt(2) * float(np.median(scale)))
