"""Registration of camera shake and flicker: each frame against the median picture of the static background.

Robust least squares on the median picture and its derivatives (Lucas-Kanade). Moving objects, such as a door or a hand,
appear as outliers and are left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.video.axis import Axis
from vinetrack.video.order_kernels import BINS_PER_LEVEL, median
from vinetrack.video.resample import sample
from vinetrack.video.threads import FEWEST_PICTURES, in_parts

REFERENCE_FRAMES = 15  # Frames whose median is the reference (derived)

SHIFT_PIXELS = 9000  # Pixels of the bands used to measure a shift, evenly spaced (derived)
# Pixels used to measure flicker alone, and to decide whether to measure shake with SHIFT_PIXELS (derived)
LEVEL_PIXELS = 3000
MEDIAN_EVERY = 4  # Stride of the pixels used for medians (derived)
# Median shift over its standard error, with LEVEL_PIXELS, below which no shake is measured (derived)
NOISE_SHIFT_RATIO = 1.5
SHAKE_FLOOR_PX = 0.04  # Smaller shake is not removed (chosen)
SHAKE_ROUNDS = 4  # Number of registration iterations, each from the result of the one before (chosen)
SHAKE_STEP_PX = 1.5  # Maximum shift per iteration (chosen)
SHAKE_CONVERGED_PX = 0.02  # Change of the shift below which the iteration has converged (chosen)
WHOLE_PIXEL_TOLERANCE = 1e-6  # Distance of a position from a whole pixel that is due to rounding (derived)
# Difference of the shifts measured in the two halves of the background, over their sum, below which the camera is taken
# to have shaken
HALF_DISAGREEMENT = 0.7

FEWEST_MEDIANS = 1000  # Fewest pixels of a reference for which another thread is used (chosen)


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
    """Return the number of grey levels of 255 per unit of the camera's values. Shapes: luma (n_frames,
    height, width).
    """
    if luma.dtype == np.uint8:
        return 1.0
    top = float(np.max(luma[:: max(1, len(luma) // 8), ::2, ::2]))
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
    return float(np.mean(difference[strongest])) < max(HALF_DISAGREEMENT * float(np.mean(total[strongest])), 2 * sd_sum)


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
    middle, left, right, above, below = np.concatenate(
        in_parts(lambda first, last: _medians_about(luma, picks, x[first:last], y[first:last]), len(x), FEWEST_MEDIANS),
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
    if shift_px is None and (max(abs(along)) > 1 - 1e-9 or np.abs(start - rounded).max() < WHOLE_PIXEL_TOLERANCE):
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
    n, count = data.shape
    out, error = np.zeros((n, 4)), np.full(n, np.inf)
    residuals, inlier = np.empty(count), np.ones(count)
    normal_matrix, bins_per_unit = basis @ basis.T + ridge, unit * BINS_PER_LEVEL
    # A sample of the pixels suffices for the median of the residuals.
    n_sampled = (count + MEDIAN_EVERY - 1) // MEDIAN_EVERY
    sampled, sampled_inlier, all_sampled = np.empty(n_sampled), np.empty(n_sampled), np.ones(n_sampled)
    for k in range(n_sampled):
        sampled[k] = basis[0, k * MEDIAN_EVERY]
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
                sampled[k], sampled_inlier[k] = residuals[k * MEDIAN_EVERY], inlier[k * MEDIAN_EVERY]
            scale = 1.4826 * median(sampled, sampled_inlier, bins_per_unit) + 0.3
            out[t, 0], out[t, 1], out[t, 2], out[t, 3] = a, b, c, d
            error[t] = scale * np.sqrt(max(inverse[2, 2], 0.0))
            if iteration == 0:
                for k in range(n_sampled):
                    sampled[k] = values[k * MEDIAN_EVERY]
                gain = median(sampled, all_sampled, bins_per_unit) / reference_median
                for k in range(n_sampled):
                    sampled[k] = abs(values[k * MEDIAN_EVERY] - gain * basis[0, k * MEDIAN_EVERY])
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
