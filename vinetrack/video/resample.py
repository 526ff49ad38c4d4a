"""Cutting the same strip out of many pictures, by slicing or by bicubic interpolation on a straight grid, compiled.

Along an axis close to the rows of a picture, neighbours in the strip are neighbours in the picture for hundreds of
pixels. A pixel then takes sixteen weights and sixteen loads from neighbouring addresses, and many pixels are computed
at a time.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.video.axis import Axis
from vinetrack.video.edge_cover import NO_REFCOUNT
from vinetrack.video.threads import FEWEST_PICTURES, in_parts

CUBIC_COEFFICIENT = np.float32(-0.75)  # Coefficient a of the bicubic kernel (Keys 1981) (defined)
MIN_MEAN_RUN_PX = 16  # Mean length of runs of neighbours from which the compiled loops are used (measured)
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
    if luma.dtype in (np.uint8, np.uint16) and len(runs) * MIN_MEAN_RUN_PX <= n_rows * n_along:
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
