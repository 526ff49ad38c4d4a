"""A straight strip along the axis, cut from every frame, corrected for flicker and camera shake.

The bands of background beside the tube stand still; each frame's gain and shift are estimated from them
(`registration`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.core.threads import FEWEST_PICTURES, in_parts
from vinetrack.video.axis import Axis
from vinetrack.video.edge_kernels import NO_REFCOUNT
from vinetrack.video.kymograph import BINS_PER_LEVEL, median

# ------------------------------------------------------------------------------
# Cutting the same strip out of many pictures, by slicing or by bicubic interpolation on a straight grid, compiled.
#
# Along an axis close to the rows of a picture, neighbours in the strip are neighbours in the picture for hundreds of
# pixels. A pixel then takes sixteen weights and sixteen loads from neighbouring addresses, and many pixels are
# computed at a time.

CUBIC_COEFFICIENT = np.float32(-0.75)  # Coefficient a of the bicubic kernel (Keys 1981) (defined)
# Adding and subtracting it rounds a single-precision number to the nearest integer, ties to even (derived)
ROUNDING_CONSTANT = np.float32(2**23)
VECTOR = 16  # Pixels computed at a time (derived)
CONTRACT_FASTMATH = {"contract", "nsz"}  # Floating-point freedom of the compiler: fused multiply-add only (chosen)


def warp_all(luma: NDArray[Any], matrix: NDArray[np.float64], n_rows: int, n_along: int) -> NDArray[Any]:
    """Interpolate every picture on a straight grid, bicubically; beyond its border the border pixel is repeated.
    Shapes: luma (n_frames, height, width); matrix (2, 3) → (n_frames, n_rows, n_along).
    """
    out = np.empty((len(luma), n_rows, n_along), luma.dtype)
    fractions, runs = _grid(np.asarray(matrix, np.float32), n_rows, n_along)
    # 16: mean length of runs of neighbours from which the compiled loops are used (measured)
    if luma.dtype in (np.uint8, np.uint16) and len(runs) * 16 <= n_rows * n_along:
        _interpolate(luma, fractions, runs, np.float32(np.iinfo(luma.dtype).max), out.reshape(len(luma), -1))
        return out
    import cv2

    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    for frame, cut in zip(luma, out, strict=True):
        cv2.warpAffine(frame, matrix, (n_along, n_rows), dst=cut, flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return out


@njit(cache=True, nogil=True)
def _grid(matrix: np.ndarray, n_rows: int, n_along: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the subpixel positions of a grid and the runs of pixels that are neighbours in the picture. Positions,
    along and across, have shape (2, n_rows, n_along + VECTOR).
    """
    fractions = np.zeros((2, n_rows, n_along + VECTOR), np.float32)
    runs = np.empty((n_rows * n_along, 5), np.int64)
    column, row = np.empty(n_along, np.float32), np.empty(n_along, np.float32)
    count = 0
    for u in range(n_rows):
        x0 = matrix[0, 1] * np.float32(u) + matrix[0, 2]
        y0 = matrix[1, 1] * np.float32(u) + matrix[1, 2]
        for s in range(n_along):
            x = matrix[0, 0] * np.float32(s) + x0
            y = matrix[1, 0] * np.float32(s) + y0
            column[s], row[s] = np.floor(x) - np.float32(s), np.floor(y)
            fractions[0, u, s], fractions[1, u, s] = x - np.floor(x), y - np.floor(y)
        first = 0
        while first < n_along:
            last = first + 1
            while last < n_along and column[last] == column[first] and row[last] == row[first]:
                last += 1
            runs[count, 0], runs[count, 1], runs[count, 2] = u, first, last
            runs[count, 3], runs[count, 4] = int(row[first]) - 1, int(column[first]) - 1
            count += 1
            first = last
    return fractions, runs[:count].copy()


@njit(cache=True, nogil=True, inline="always")
def _weights(x: np.float32) -> tuple[np.float32, np.float32, np.float32, np.float32]:
    """Bicubic weights of four neighbours; the position lies `x` after the second of them."""
    unit, a = np.float32(1.0), CUBIC_COEFFICIENT
    two, three, five, eight = np.float32(2.0), np.float32(3.0), np.float32(5.0), np.float32(8.0)
    from_first, from_third = x + unit, unit - x
    before = ((a * from_first - five * a) * from_first + eight * a) * from_first - np.float32(4.0) * a
    left = ((a + two) * x - (a + three)) * x * x + unit
    right = ((a + two) * from_third - (a + three)) * from_third * from_third + unit
    return before, left, right, unit - before - left - right


@njit(cache=True, nogil=True, fastmath=CONTRACT_FASTMATH, error_model="numpy")
def _interpolate(
    luma: np.ndarray, fractions: np.ndarray, runs: np.ndarray, max_value: np.float32, out: np.ndarray
) -> None:
    """Fill `out`, shape (n_frames, n_rows * n_along), run by run; see `_grid`. Whole vectors are computed; the excess
    of the last one is overwritten by the next run.
    """
    n, height, width = luma.shape
    top = max(0, runs[:, 3].min())
    bottom = max(top + 1, min(height, runs[:, 3].max() + 4))
    rows = np.zeros((bottom - top, width + VECTOR), np.float32)
    for t in range(n):
        picture, row_out = luma[t], out[t]
        for y in range(bottom - top):
            source, target = picture[top + y], rows[y]
            for s in range(width):
                target[s] = np.float32(source[s])
        _interpolate_one(picture, rows, top, fractions, runs, max_value, row_out)


@njit(cache=True, nogil=True, fastmath=CONTRACT_FASTMATH, error_model="numpy", **NO_REFCOUNT)
def _interpolate_one(
    picture: np.ndarray, rows: np.ndarray, top: int, fractions: np.ndarray, runs: np.ndarray, max_value: np.float32,
    row_out: np.ndarray,
) -> None:  # fmt: skip
    """Fill `row_out`, shape (n_rows * n_along,), from one picture. `rows` are the rows of the picture from `top` on, in
    single precision.
    """
    height, width = picture.shape
    bottom = top + len(rows)
    n_along = fractions.shape[2] - VECTOR
    zero = np.float32(0.0)
    for i in range(len(runs)):
        u, first, last, y, column_offset = runs[i]
        begin, end, place = first, first, u * n_along
        if y >= top and y + 4 <= bottom:
            begin = min(max(first, -column_offset), last)
            end = max(min(last, width - 3 - column_offset), begin)
            vector_length = end - begin + (begin - end) % VECTOR
            vector_length = vector_length if place + begin + vector_length <= row_out.size else end - begin
            at, j = begin + column_offset, y - top
            a, b, c, d = rows[j, at:], rows[j + 1, at:], rows[j + 2, at:], rows[j + 3, at:]
            p, q, out_run = fractions[0, u, begin:], fractions[1, u, begin:], row_out[place + begin :]
            for s in range(vector_length):
                x0, x1, x2, x3 = _weights(p[s])
                y0, y1, y2, y3 = _weights(q[s])
                value = y0 * (x0 * a[s] + x1 * a[s + 1] + x2 * a[s + 2] + x3 * a[s + 3])
                value += y1 * (x0 * b[s] + x1 * b[s + 1] + x2 * b[s + 2] + x3 * b[s + 3])
                value += y2 * (x0 * c[s] + x1 * c[s + 1] + x2 * c[s + 2] + x3 * c[s + 3])
                value += y3 * (x0 * d[s] + x1 * d[s + 1] + x2 * d[s + 2] + x3 * d[s + 3])
                out_run[s] = np.int32((min(max(value, zero), max_value) + ROUNDING_CONSTANT) - ROUNDING_CONSTANT)
        for s in range(first, last):
            if begin <= s < end:
                continue
            across, value = _weights(fractions[1, u, s]), zero
            along = _weights(fractions[0, u, s])
            for k in range(4):
                neighbours = picture[min(max(y + k, 0), height - 1)]
                total = zero
                for j in range(4):
                    total += along[j] * neighbours[min(max(s + column_offset + j, 0), width - 1)]
                value += across[k] * total
            row_out[place + s] = np.int32((min(max(value, zero), max_value) + ROUNDING_CONSTANT) - ROUNDING_CONSTANT)


def sample(luma: NDArray[Any], axis: Axis, rows_px: NDArray[np.int_], shift_px: Floats | None = None) -> NDArray[Any]:
    """Cut pixels at whole positions along the axis and at `rows_px` across; shape (n_frames, n_rows, n_along). An axis
    along rows or columns of the picture is sliced without interpolation, after moving it by less than half a pixel.
    Given `shift_px`, every frame is interpolated at its own displacement. Shapes: luma (n_frames, height, width);
    rows_px (n_rows,); shift_px (n_frames, 2) → (n_frames, n_rows, n_along).
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
    """Matrix from (along, row, 1) to x and y in the picture, shape (2, 3)."""
    return np.array([[along[0], across[0], origin[0]], [along[1], across[1], origin[1]]])


def _slice(luma: NDArray[Any], start: Floats, along: Floats, across: Floats, n_rows: int, n_along: int) -> NDArray[Any]:
    """Slice whole pixels of an axis along rows or columns of the picture; beyond the picture its border is repeated."""
    x = np.rint(
        start[0] + np.arange(n_along) * along[0] if abs(along[0]) > 0.5 else start[0] + np.arange(n_rows) * across[0]
    )
    y = np.rint(
        start[1] + np.arange(n_rows) * across[1] if abs(along[0]) > 0.5 else start[1] + np.arange(n_along) * along[1]
    )
    columns = np.clip(x, 0, luma.shape[2] - 1).astype(int)
    rows = np.clip(y, 0, luma.shape[1] - 1).astype(int)
    part = _take(_take(luma, rows, 1), columns, 2)
    part = part if abs(along[0]) > 0.5 else part.transpose(0, 2, 1)
    out = np.empty(part.shape, part.dtype)
    in_parts(lambda first, last: np.copyto(out[first:last], part[first:last]), len(part), FEWEST_PICTURES)
    return out


def _take(luma: NDArray[Any], index: NDArray[np.int_], dim: int) -> NDArray[Any]:
    """Index one dimension: consecutive indices as a view, others as a copy."""
    steps = np.diff(index)
    if len(steps) and np.all(steps == 1):
        chosen = slice(int(index[0]), int(index[-1]) + 1)
        return luma[:, chosen] if dim == 1 else luma[:, :, chosen]
    return np.take(luma, index, axis=dim)


# ------------------------------------------------------------------------------
# Registration of camera shake and flicker: each frame against the median picture of the static background.
#
# Robust least squares on the median picture and its derivatives (Lucas-Kanade). Moving objects, such as a door or a
# hand, appear as outliers and are left out.

REFERENCE_FRAMES = 15  # Frames whose median is the reference (derived)

SHIFT_PIXELS = 9000  # Pixels of the bands used to measure a shift, evenly spaced (derived)
# Pixels used to measure flicker alone, and to decide whether to measure shake with SHIFT_PIXELS (derived)
LEVEL_PIXELS = 3000
# Median shift over its standard error, with LEVEL_PIXELS, below which no shake is measured (derived)
NOISE_SHIFT_RATIO = 1.5
SHAKE_FLOOR_PX = 0.04  # Smaller shake is not removed (chosen)
SHAKE_ROUNDS = 4  # Number of registration iterations, each from the result of the one before (chosen)
SHAKE_STEP_PX = 1.5  # Maximum shift per iteration (chosen)
SHAKE_CONVERGED_PX = 0.02  # Change of the shift below which the iteration has converged (chosen)


@dataclass(frozen=True)
class Reference:
    """Pixels of the bands to which frames are registered: positions and median brightness. `along_px` and `across_px`,
    shape (n_pixels,), are whole numbers; the rows of `basis`, shape (4, n_pixels), are the median picture, ones, and
    the derivatives of the picture along and across.
    """

    along_px: Floats
    across_px: Floats
    basis: Floats


def camera_unit(luma: NDArray[Any]) -> float:
    """Return the number of grey levels of 255 per unit of the camera's values. Shapes: luma (n_frames, height, width).
    White is the brightest value but for one pixel in ten thousand, which may be hot.
    """
    if luma.dtype == np.uint8:
        return 1.0
    top = float(np.quantile(luma[:: max(1, len(luma) // 8), ::2, ::2], 0.9999))
    return 255.0 / max(top, 1.0)


def stabilise(
    luma: NDArray[Any], axis: Axis, bands: list[NDArray[np.int_]], unit: float, still: bool
) -> tuple[Floats, Floats, Floats, bool]:
    """Estimate flicker and shake of every frame against the median picture of its bands. Returns scale and offset that
    correct flicker, shape (n_frames,) each, shift along and across, shape (n_frames, 2), px, whether the camera shook.
    Shapes: luma (n_frames, height, width).
    """
    n = len(luma)
    shift = np.zeros((n, 2))
    fit, stabilised = np.zeros((n, 4)), False
    picks = np.unique(np.linspace(0, n - 1, REFERENCE_FRAMES).astype(int))
    columns = int(np.floor(axis.length_px)) + 1
    reference = _reference_at_whole_pixels(luma, axis, bands, picks, (0, columns), LEVEL_PIXELS)
    if not reference.basis[0].any():  # black all over: neither flicker nor shift can be measured
        return np.full(n, unit), np.zeros(n), shift, False
    fit, sd = register(luma, axis, reference, None, unit)
    if still or _is_still(fit, sd, reference):
        return *_flicker_correction(fit, unit), shift, False
    reference = _reference_at_whole_pixels(luma, axis, bands, picks, (0, columns), SHIFT_PIXELS)
    for iteration in range(SHAKE_ROUNDS):
        fit, sd = register(luma, axis, reference, shift if iteration else None, unit)
        if iteration == 0:
            strength = float(np.median(np.abs(fit[:, 2:]))), float(np.median(sd))
            if not np.isfinite(strength[1]) or strength[0] < max(SHAKE_FLOOR_PX, 2.5 * strength[1]):
                break
            parts = (0, columns // 2), (columns // 2, columns)
            halves = [_reference_at_whole_pixels(luma, axis, bands, picks, part, SHIFT_PIXELS) for part in parts]
            if not shifts_agree(luma, axis, halves, unit):
                break
            stabilised = True
        shift = shift + np.clip(fit[:, 2:], -SHAKE_STEP_PX, SHAKE_STEP_PX)
        if iteration == 1:
            reference = reference_pixels(_median_pictures(luma, axis, bands, picks, shift), bands)
        if iteration > 1 and float(np.abs(fit[:, 2:]).max()) < SHAKE_CONVERGED_PX:
            break
    return *_flicker_correction(fit, unit), shift, stabilised


def _is_still(fit: Floats, sd: Floats, reference: Reference) -> bool:
    """Return whether the shifts along and across are consistent with noise, or too small to be worth removing."""
    along, across = reference.basis[2:] @ reference.basis[2:].T
    ratio = np.sqrt(along[0] / max(across[1], 1e-9))
    median_shift = np.median(np.abs(fit[:, 2:]), axis=0)
    return bool(
        np.all(
            median_shift < np.maximum(SHAKE_FLOOR_PX, NOISE_SHIFT_RATIO * float(np.median(sd)) * np.array([1.0, ratio]))
        )
    )


def _flicker_correction(fit: Floats, unit: float) -> tuple[Floats, Floats]:
    """Scale and offset that undo the gain and level of a fit, shape (n_frames,) each."""
    gain = np.clip(fit[:, 0], 0.2, 5.0)
    return unit / gain, -fit[:, 1] * unit / gain


def shifts_agree(luma: NDArray[Any], axis: Axis, halves: Sequence[Reference], unit: float) -> bool:
    """Decide whether the camera shook: two halves of the background must then show the same shift. A door, a shadow or
    a mirror image of the tip passes one half after the other. Shifts of more than a pixel are beyond the linearisation,
    and its error differs between the halves; therefore each half is iterated to convergence. Shapes: luma (n_frames,
    height, width).
    """
    # Difference of the shifts measured in the two halves of the background, over their sum, below which the
    # camera is taken to have shaken
    half_disagreement = 0.7
    shifts, errors = [], []
    for half in halves:
        shift, sd = np.zeros((len(luma), 2)), np.zeros(len(luma))
        for iteration in range(SHAKE_ROUNDS):
            fit, sd = register(luma, axis, half, shift if iteration else None, unit)
            shift = shift + np.clip(fit[:, 2:], -SHAKE_STEP_PX, SHAKE_STEP_PX)
            if float(np.abs(fit[:, 2:]).max()) < SHAKE_CONVERGED_PX:
                break
        shifts.append(shift)
        errors.append(sd)
    first, second = shifts
    difference, total = np.hypot(*(first - second).T), np.hypot(*(first + second).T)
    strongest = difference + total >= np.quantile(difference + total, 0.75)
    sd_sum = float(np.median(errors[0] + errors[1]))
    return float(np.mean(difference[strongest])) < max(half_disagreement * float(np.mean(total[strongest])), 2 * sd_sum)


def _reference_at_whole_pixels(
    luma: NDArray[Any], axis: Axis, bands: list[NDArray[np.int_]], picks: NDArray[np.int_],
    columns: tuple[int, int], count: int,
) -> Reference:  # fmt: skip
    """Make a reference of about `count` whole pixels of some bands, from the median of some frames. Whole pixels need
    no interpolation, whatever the direction of the axis.
    """
    low, high = columns
    grids = [np.meshgrid(np.arange(low + 1, high - 1), rows[1:-1]) for rows in bands]
    along, across = (np.concatenate([grid[k].ravel() for grid in grids]) for k in (0, 1))
    stride = max(1, len(along) // count)
    height, width = luma.shape[1:]
    place = np.rint(axis.points(along[::stride].astype(float), across[::stride].astype(float))).astype(int)
    x, y = np.clip(place[:, 0], 1, width - 2), np.clip(place[:, 1], 1, height - 2)
    # 1000: fewest pixels of a reference for which another thread is used (chosen)
    middle, left, right, above, below = np.concatenate(
        in_parts(lambda first, last: _medians_about(luma, picks, x[first:last], y[first:last]), len(x), 1000),
        axis=1,
    )
    right, below = (right - left) / 2, (below - above) / 2
    direction, normal, relative_px = (
        axis.direction,
        axis.normal,
        np.column_stack([x, y]) - np.asarray(axis.from_px, float),
    )
    slopes = -(right * direction[0] + below * direction[1]), -(right * normal[0] + below * normal[1])
    return Reference(relative_px @ direction, relative_px @ normal, np.stack([middle, np.ones(len(x)), *slopes]))


@njit(cache=True, nogil=True)
def _medians_about(luma: np.ndarray, picks: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Median over some frames of pixels and of their left, right, upper and lower neighbours, shape (5, n_pixels)."""
    out, values = np.empty((5, len(x))), np.empty(len(picks))
    for i in range(len(x)):
        for k in range(5):
            right, down = (k == 2) - (k == 1), (k == 4) - (k == 3)
            for j in range(len(picks)):
                value = float(luma[picks[j], y[i] + down, x[i] + right])
                m = j
                while m > 0 and values[m - 1] > value:
                    values[m] = values[m - 1]
                    m -= 1
                values[m] = value
            out[k, i] = 0.5 * (values[(len(picks) - 1) // 2] + values[len(picks) // 2])
    return out


def _median_pictures(
    luma: NDArray[Any], axis: Axis, bands: list[NDArray[np.int_]], picks: NDArray[np.int_], shift_px: Floats
) -> list[NDArray[np.float32]]:
    """Median of some frames in each band, shape (n_rows, n_along)."""
    chosen = luma[picks]
    views = [sample(chosen, axis, rows, shift_px[picks]) for rows in bands]
    return [np.median(view, axis=0).astype(np.float32) for view in views]


def reference_pixels(
    medians: list[NDArray[np.float32]], bands: list[NDArray[np.int_]], columns: tuple[int, int] | None = None
) -> Reference:
    """Make a reference of about SHIFT_PIXELS pixels of some bands, from their median pictures. Shapes: medians (n_rows,
    n_along).
    """
    low, high = columns or (0, medians[0].shape[1])
    parts, along, across = [], [], []
    for picture, rows in zip(medians, bands, strict=True):
        part = (slice(1, -1), slice(low + 1, high - 1))
        slopes = -np.gradient(picture, axis=1)[part], -np.gradient(picture, axis=0)[part]
        parts.append(np.stack([x.ravel() for x in (picture[part], np.ones_like(picture[part]), *slopes)]))
        grid = np.meshgrid(np.arange(low + 1, high - 1), rows[1:-1])
        along.append(grid[0].ravel())
        across.append(grid[1].ravel())
    basis = np.concatenate(parts, axis=1)
    stride = max(1, basis.shape[1] // SHIFT_PIXELS)
    return Reference(
        np.concatenate(along)[::stride].astype(float), np.concatenate(across)[::stride].astype(float),
        np.ascontiguousarray(basis[:, ::stride], dtype=np.float64),
    )  # fmt: skip


def _pixels(luma: NDArray[Any], axis: Axis, reference: Reference, shift_px: Floats | None) -> NDArray[Any]:
    """Pixels of a reference in every frame, as `sample` would cut them, shape (n_frames, n_pixels)."""
    import cv2

    along, across = axis.direction, axis.normal
    start = axis.points(reference.along_px, reference.across_px)
    rounded = np.rint(start)
    # 1e-6: distance of a position from a whole pixel that is due to rounding (derived)
    if shift_px is None and (max(abs(along)) > 1 - 1e-9 or np.abs(start - rounded).max() < 1e-6):
        x, y = (np.clip(rounded[:, i], 0, luma.shape[2 - i] - 1).astype(int) for i in (0, 1))
        return np.concatenate(
            in_parts(lambda first, last: _whole_pixels(luma[first:last], x, y), len(luma), FEWEST_PICTURES)
        )
    # In rows of a thousand, since OpenCV accepts no picture wider than 32767 pixels.
    n_rows = -(-len(start) // 1000)
    place = np.pad(start, ((0, n_rows * 1000 - len(start)), (0, 0)), mode="edge").reshape(n_rows, 1000, 2)
    out = np.empty((len(luma), len(start)), luma.dtype)
    for i, frame in enumerate(luma):
        moved = place if shift_px is None else place + shift_px[i, 0] * along + shift_px[i, 1] * across
        x, y = moved[..., 0].astype(np.float32), moved[..., 1].astype(np.float32)
        interpolated = np.asarray(cv2.remap(frame, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE))
        out[i] = interpolated.ravel()[: len(start)]
    return out


@njit(cache=True, nogil=True)
def _whole_pixels(luma: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Read whole pixels of every frame, shape (n_frames, n_pixels)."""
    out = np.empty((len(luma), len(x)), luma.dtype)
    for t in range(len(luma)):
        for i in range(len(x)):
            out[t, i] = luma[t, y[i], x[i]]
    return out


def register(
    luma: NDArray[Any], axis: Axis, reference: Reference, shift_px: Floats | None, unit: float
) -> tuple[Floats, Floats]:
    """Register every frame to the static background by robust least squares. The model is frame(x) = gain · picture(x −
    shift) + level, linearised in the shift. A ridge keeps the level near zero, and the shift at zero where the bands
    have no texture. Returns gain, level, shift along and across of every frame, shape (n_frames, 4), and the standard
    error of the shift, shape, (n_frames,).. Shapes: luma (n_frames, height, width); shift_px (n_frames, 2).
    """
    basis = reference.basis
    level = float(np.abs(basis[0]).mean()) + 1e-9
    count = basis.shape[1]
    ridge = np.diag([0.0, 25.0 * count * (2.0 / level) ** 2 * 0.01, 1e-3 * level, 1e-3 * level])
    pixels = _pixels(luma, axis, reference, shift_px)
    parts = in_parts(
        lambda first, last: _robust_fits(pixels[first:last], basis, ridge, unit), len(pixels), FEWEST_PICTURES
    )
    solution, error = (np.concatenate(part) for part in zip(*parts, strict=True))
    gain = np.maximum(solution[:, 0], 0.05)
    return np.column_stack([gain, solution[:, 1], solution[:, 2] / gain, solution[:, 3] / gain]), error


@njit(cache=True, nogil=True, fastmath={"contract", "arcp", "nsz", "reassoc"}, error_model="numpy")
def _robust_fits(data: np.ndarray, basis: np.ndarray, ridge: np.ndarray, unit: float) -> tuple[np.ndarray, np.ndarray]:
    """Fit every frame to the rows of `basis` by least squares, twice: the second time without outliers (4 sd). `data`
    has shape (n_frames, n_pixels), `basis` (4, n_pixels). Returns the coefficients, shape (n_frames, 4), and the
    standard error of the third, shape (n_frames,).
    """
    median_every = 4  # Stride of the pixels used for medians (derived)
    n, count = data.shape
    out, error = np.zeros((n, 4)), np.full(n, np.inf)
    residuals, inlier = np.empty(count), np.ones(count)
    normal_matrix, bins_per_unit = basis @ basis.T + ridge, unit * BINS_PER_LEVEL
    # A sample of the pixels suffices for the median of the residuals.
    n_sampled = (count + median_every - 1) // median_every
    sampled, sampled_inlier, all_sampled = np.empty(n_sampled), np.empty(n_sampled), np.ones(n_sampled)
    for k in range(n_sampled):
        sampled[k] = basis[0, k * median_every]
    reference_median = max(median(sampled, all_sampled, bins_per_unit), 1e-9)
    for t in range(n):
        inlier[:] = 1.0
        values = data[t]
        for iteration in range(2):
            r0, r1, r2, r3 = 0.0, 0.0, 0.0, 0.0
            for k in range(count):
                value = inlier[k] * values[k]
                r0 += value * basis[0, k]
                r1 += value * basis[1, k]
                r2 += value * basis[2, k]
                r3 += value * basis[3, k]
            inverse = np.linalg.inv(normal_matrix if iteration == 0 else _masked_products(basis, inlier) + ridge)
            a, b, c, d = inverse @ np.array([r0, r1, r2, r3])
            for k in range(count):
                residuals[k] = abs(values[k] - a * basis[0, k] - b * basis[1, k] - c * basis[2, k] - d * basis[3, k])
            for k in range(n_sampled):
                sampled[k], sampled_inlier[k] = residuals[k * median_every], inlier[k * median_every]
            scale = 1.4826 * median(sampled, sampled_inlier, bins_per_unit) + 0.3
            out[t, 0], out[t, 1], out[t, 2], out[t, 3] = a, b, c, d
            error[t] = scale * np.sqrt(max(inverse[2, 2], 0.0))
            if iteration == 0:
                for k in range(n_sampled):
                    sampled[k] = values[k * median_every]
                gain = median(sampled, all_sampled, bins_per_unit) / reference_median
                for k in range(n_sampled):
                    sampled[k] = abs(values[k * median_every] - gain * basis[0, k * median_every])
                gain_only_scale = 1.4826 * median(sampled, all_sampled, bins_per_unit) + 0.3
                if gain_only_scale < scale:
                    scale = gain_only_scale
                    for k in range(count):
                        residuals[k] = abs(values[k] - gain * basis[0, k])
            n_inliers = 0.0
            for k in range(count):
                inlier[k] = 1.0 if residuals[k] < 4 * scale else 0.0
                n_inliers += inlier[k]
            if n_inliers > 0.99 * count:
                break
    return out, error


@njit(cache=True, nogil=True, fastmath={"contract", "arcp", "nsz", "reassoc"}, error_model="numpy")
def _masked_products(basis: np.ndarray, inlier: np.ndarray) -> np.ndarray:
    """Products of the rows of `basis` with each other, shape (4, 4), summed over the inliers."""
    out = np.empty((4, 4))
    for i in range(4):
        for j in range(i, 4):
            total, first, second = 0.0, basis[i], basis[j]
            for k in range(len(inlier)):
                total += inlier[k] * first[k] * second[k]
            out[i, j] = out[j, i] = total
    return out


BAND_GAP_PX = 5  # Rows left out between tube and band, to allow for sway and blur (chosen)
# Slope of an axis over its whole length up to which it is treated as lying along rows or columns (chosen)
SNAP_TOLERANCE_PX = 0.4
BAND_HEIGHT_PX = (14, 44)  # Minimum and maximum height of a band (chosen)


@dataclass(frozen=True)
class Strip:
    """Pixels along the axis in every frame. `values`, shape (n_frames, n_across, n_along), are as the camera wrote
    them; `scale * values + offset`, shape (n_frames,) each, is in grey levels of 255 and free of flicker.
    """

    values: NDArray[Any]
    scale: Floats
    offset: Floats
    shift_px: Floats
    noise: float
    axis: Axis
    stabilised: bool

    @property
    def shake_px(self) -> Floats | None:
        """`shift_px` if camera shake was removed, else None."""
        return self.shift_px if self.stabilised else None


def cut_strip(luma: NDArray[Any], axis: Axis, half_px: float, still: bool = False) -> Strip:
    """Cut the strip on both sides of an axis; correct flicker and camera shake. Shapes: luma (n_frames,
    height, width).
    """
    half = int(np.ceil(half_px))
    bands = _band_rows(luma.shape[1:], axis, half)
    unit = camera_unit(luma)
    n = len(luma)
    scale, offset, shift = np.full(n, unit), np.zeros(n), np.zeros((n, 2))
    stabilised = False
    if bands:
        scale, offset, shift, stabilised = stabilise(luma, axis, bands, unit, still)
    values = sample(luma, axis, np.arange(-half, half + 1), shift if stabilised else None)
    return Strip(values, scale, offset, shift, _noise(values, scale), axis, stabilised)


def recut(strip: Strip, luma: NDArray[Any], axis: Axis, half_px: float) -> Strip:
    """Cut the same frames along a slightly different axis, with the gain and shift of `strip`. Shapes: luma (n_frames,
    height, width).
    """
    half = int(np.ceil(half_px))
    values = sample(luma, axis, np.arange(-half, half + 1), strip.shake_px)
    return replace(strip, values=values, axis=axis)


def snap_to_grid(axis: Axis, tolerance_px: float = SNAP_TOLERANCE_PX) -> Axis:
    """Move an axis that lies along rows or columns, except for a small slope, onto whole rows or columns. Cutting then
    needs no interpolation, and a tenth of the time.
    """
    if type(axis) is not Axis:
        return axis
    (x0, y0), (x1, y1) = axis.from_px, axis.to_px
    if abs(y1 - y0) <= tolerance_px and abs(x1 - x0) > 10:
        y = round((y0 + y1) / 2)
        return Axis((round(x0), y), (round(x1), y), axis.width_px)
    if abs(x1 - x0) <= tolerance_px and abs(y1 - y0) > 10:
        x = round((x0 + x1) / 2)
        return Axis((x, round(y0)), (x, round(y1)), axis.width_px)
    return axis


def _band_rows(shape: tuple[int, ...], axis: Axis, half: int) -> list[NDArray[np.int_]]:
    """Rows of the bands on both sides that lie inside the picture along the whole axis."""
    height, width = shape
    bands = []
    depth = int(np.clip(half, *BAND_HEIGHT_PX))
    for side in (-1, 1):
        rows = np.arange(half + BAND_GAP_PX, half + BAND_GAP_PX + depth) * side
        ends = axis.points(np.array([[0.0], [axis.length_px]]), rows[None, :].astype(float))
        inside = ((ends > -0.5) & (ends < [width - 0.5, height - 0.5])).all(axis=(0, 2))
        inside_rows = np.sort(rows[inside])
        if len(inside_rows) >= 6:
            bands.append(inside_rows)
    return bands


def _noise(values: NDArray[Any], scale: Floats) -> float:
    """Estimate the standard deviation of a pixel from differences of neighbouring frames, grey levels, at least 1.
    Medians over pixels are used, since motion affects few of them. The minimum is needed because compression freezes a
    picture at rest, while moving pixels are never known better than to a grey level.
    """
    step = max(1, len(values) // 40)
    first, second = values[:-1:step, ::4, ::4], values[1::step, ::4, ::4]
    n = min(len(first), len(second))
    change = np.abs(second[:n].astype(np.float32) - first[:n].astype(np.float32))
    medians = np.median(change, axis=(1, 2)) if n else np.zeros(1)
    return max(1.0, float(np.quantile(medians, 0.7)) * 1.4826 / np.sqrt(2) * float(np.median(scale)))
