"""How far a camera shook and its light flickered, told by what stands still: each frame against the median picture.

Robust least squares on the median picture and its slopes. What moves there (a door, a hand) strays and is left out.
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
from vinetrack.video.order_kernels import BINS_A_LEVEL, median
from vinetrack.video.resample import sample

REFERENCE_FRAMES = 15
"""Frames whose median is what all are compared with. Derived: its noise is then a third of a frame's, √(π/2)/√15. By
reasoning: at half it is nearly a half, at twice a quarter."""

PIXELS = 9000
"""Pixels of the bands that are used, evenly spread: enough for a shift of 0.01 px. Derived for slopes of 5 grey levels
a pixel and noise of 5: 1/√9000 = 0.01 px."""
LEVEL_PIXELS = 3000
"""Pixels that tell of light alone, and whether a shake is worth measuring with PIXELS. Derived for noise of 5 grey
levels at 100: 5/(100·√3000) = 0.1 % of the light, 0.003 px of an edge of 30 grey levels. At half 0.004 px; at twice
time is as of PIXELS."""
MEDIAN_EVERY = 4
"""Every so many pixels count in medians. Derived: of 750 pixels a median is known to 1.25/√750 = 5 % of their scatter.
At half time grows, at twice it is known to 7 %."""
AS_NOISE = 1.5
"""Median shift over its standard error, with LEVEL_PIXELS, below which no shake is looked for. Derived: 0.67 of noise
alone; a shake of 2.5 standard errors with PIXELS, the least that is taken off, makes 1.6. By reasoning: at half every
recording is measured twice, at twice faint shakes stay."""
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
WHOLE_PX = 1e-6
"""Distance of a place from a whole pixel that is rounding. Derived: places of some thousand px are known to 1e-12."""
HALVES_APART = 0.7
"""Difference of the shifts that both halves of what stands still tell, over their sum, below which a camera shook.
Measured on clips of seeds 1 to 6
of `benchmarks/tracking_accuracy.py`: 0.03 to 0.36 where it did, 0.89 to 1.02 where film and doors move one half alone.
The ground beside a curve is judged alike. At half a shake is left in; at twice film shakes the strip."""


@dataclass(frozen=True)
class Reference:
    """Pixels of the bands with which frames are compared: where they lie, and what they show on average.

    `along_px` and `across_px`, shape (n_pixels,), whole numbers; `basis`, shape (4, n_pixels): median picture, one, and
    its slopes along and across.
    """

    along_px: Floats
    across_px: Floats
    basis: Floats


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


def steady(
    luma: NDArray[Any], axis: Axis, bands: list[NDArray[np.int_]], unit: float, still: bool
) -> tuple[Floats, Floats, Floats, bool]:
    """Level and steady every frame against the median picture of its bands.

    Parameters
    ----------
    luma : grey levels, shape (n_frames, height, width).
    axis : in the picture, px.
    bands : rows beside it that show what stands still, px across.
    unit : grey levels in one unit of the camera's.
    still : whether the pictures are known not to shake: they are levelled alone.

    Returns
    -------
    scale and offset that free a frame of flicker, shape (n_frames,) each
    shift along and across, shape (n_frames, 2), px
    whether the camera shook
    """
    n = len(luma)
    shift = np.zeros((n, 2))
    fit, steadied = np.zeros((n, 4)), False
    picks = np.unique(np.linspace(0, n - 1, REFERENCE_FRAMES).astype(int))
    columns = int(np.floor(axis.length_px)) + 1
    reference = _still_pixels(luma, axis, bands, picks, (0, columns), LEVEL_PIXELS)
    if not reference.basis[0].any():  # black all over: it tells of no light and of no shift
        return np.full(n, unit), np.zeros(n), shift, False
    fit, sd = register(luma, axis, reference, None, unit)
    if still or _stands_still(fit, sd, reference):
        return *_levelled(fit, unit), shift, False
    reference = _still_pixels(luma, axis, bands, picks, (0, columns), PIXELS)
    for turn in range(SHAKE_ROUNDS):
        fit, sd = register(luma, axis, reference, shift if turn else None, unit)
        if turn == 0:
            strength = float(np.median(np.abs(fit[:, 2:]))), float(np.median(sd))
            if not np.isfinite(strength[1]) or strength[0] < max(SHAKE_FLOOR_PX, 2.5 * strength[1]):
                break
            parts = (0, columns // 2), (columns // 2, columns)
            halves = [_still_pixels(luma, axis, bands, picks, part, PIXELS) for part in parts]
            if not shaken_alike(luma, axis, halves, unit):
                break
            steadied = True
        shift = shift + np.clip(fit[:, 2:], -SHAKE_STEP_PX, SHAKE_STEP_PX)
        if turn == 1:
            reference = reference_pixels(_median_pictures(luma, axis, bands, picks, shift), bands)
        if turn > 1 and float(np.abs(fit[:, 2:]).max()) < SHAKE_SETTLED_PX:
            break
    return *_levelled(fit, unit), shift, steadied


def _stands_still(fit: Floats, sd: Floats, reference: Reference) -> bool:
    """Whether the shifts of frames along and across are so small that they are noise, or not worth being taken off."""
    along, across = reference.basis[2:] @ reference.basis[2:].T
    ratio = np.sqrt(along[0] / max(across[1], 1e-9))
    size = np.median(np.abs(fit[:, 2:]), axis=0)
    return bool(np.all(size < np.maximum(SHAKE_FLOOR_PX, AS_NOISE * float(np.median(sd)) * np.array([1.0, ratio]))))


def _levelled(fit: Floats, unit: float) -> tuple[Floats, Floats]:
    """Scale and offset that free each frame of the gain and level of a fit, shape (n_frames,) each."""
    gain = np.clip(fit[:, 0], 0.2, 5.0)
    return unit / gain, -fit[:, 1] * unit / gain


def shaken_alike(luma: NDArray[Any], axis: Axis, halves: Sequence[Reference], unit: float) -> bool:
    """Judge whether two halves of what stands still tell of the same shift: a shaken camera moves both alike.

    A door, a shadow or a mirror image of the tip that passes moves one after the other. A shift of a pixel is more than
    the slopes of a picture tell at once, and what one half makes of it is not what the other does: each is followed
    until it is found.

    Parameters
    ----------
    luma : grey levels, shape (n_frames, height, width).
    axis : the places of both lie along and across it, px.
    halves : two of them.
    unit : grey levels in one unit of the camera's.

    Returns
    -------
    whether the camera shook.
    """
    shifts, errors = [], []
    for half in halves:
        shift, sd = np.zeros((len(luma), 2)), np.zeros(len(luma))
        for turn in range(SHAKE_ROUNDS):
            fit, sd = register(luma, axis, half, shift if turn else None, unit)
            shift = shift + np.clip(fit[:, 2:], -SHAKE_STEP_PX, SHAKE_STEP_PX)
            if float(np.abs(fit[:, 2:]).max()) < SHAKE_SETTLED_PX:
                break
        shifts.append(shift)
        errors.append(sd)
    first, second = shifts
    apart, both = np.hypot(*(first - second).T), np.hypot(*(first + second).T)
    most = apart + both >= np.quantile(apart + both, 0.75)
    sd_sum = float(np.median(errors[0] + errors[1]))
    return float(np.mean(apart[most])) < max(HALVES_APART * float(np.mean(both[most])), 2 * sd_sum)


def _still_pixels(
    luma: NDArray[Any], axis: Axis, bands: list[NDArray[np.int_]], picks: NDArray[np.int_],
    columns: tuple[int, int], count: int,
) -> Reference:  # fmt: skip
    """About `count` whole pixels of the picture in some bands, with the median of some frames and its slopes.

    Whole pixels need no interpolation, along whatever axis.
    """
    low, high = columns
    grids = [np.meshgrid(np.arange(low + 1, high - 1), rows[1:-1]) for rows in bands]
    along, across = (np.concatenate([grid[k].ravel() for grid in grids]) for k in (0, 1))
    every = max(1, len(along) // count)
    height, width = luma.shape[1:]
    place = np.rint(axis.points(along[::every].astype(float), across[::every].astype(float))).astype(int)
    x, y = np.clip(place[:, 0], 1, width - 2), np.clip(place[:, 1], 1, height - 2)
    middle, left, right, above, below = _medians_about(luma, picks, x, y)
    right, below = (right - left) / 2, (below - above) / 2
    unit, side, away = axis.direction, axis.normal, np.column_stack([x, y]) - np.asarray(axis.from_px, float)
    slopes = -(right * unit[0] + below * unit[1]), -(right * side[0] + below * side[1])
    return Reference(away @ unit, away @ side, np.stack([middle, np.ones(len(x)), *slopes]))


@njit(cache=True, nogil=True)
def _medians_about(luma: np.ndarray, picks: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Median over some frames of pixels and of those left, right, above and below them, shape (5, n_pixels)."""
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
    """Choose about PIXELS pixels of some bands, with their median brightness and its slopes.

    Parameters
    ----------
    medians : median picture of each band, shape (n_rows, n_along).
    bands : their rows, px across.
    columns : the first, and the one behind the last; all where None.

    Returns
    -------
    the pixels.
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
    whole = np.rint(start)
    if shift_px is None and (max(abs(along)) > 1 - 1e-9 or np.abs(start - whole).max() < WHOLE_PX):
        x, y = (np.clip(whole[:, i], 0, luma.shape[2 - i] - 1).astype(int) for i in (0, 1))
        return _whole_pixels(luma, x, y)
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


@njit(cache=True, nogil=True)
def _whole_pixels(luma: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Some pixels of every frame, shape (n_frames, n_pixels)."""
    out = np.empty((len(luma), len(x)), luma.dtype)
    for t in range(len(luma)):
        for i in range(len(x)):
            out[t, i] = luma[t, y[i], x[i]]
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
    strays, keep = np.empty(count), np.ones(count)
    whole, fine = basis @ basis.T + ridge, unit * BINS_A_LEVEL
    # A median of a part of the pixels tells as well how large residuals are.
    few = (count + MEDIAN_EVERY - 1) // MEDIAN_EVERY
    part, kept, everywhere = np.empty(few), np.empty(few), np.ones(few)
    for k in range(few):
        part[k] = basis[0, k * MEDIAN_EVERY]
    usual = max(median(part, everywhere, fine), 1e-9)
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
            for k in range(few):
                part[k], kept[k] = strays[k * MEDIAN_EVERY], keep[k * MEDIAN_EVERY]
            size = 1.4826 * median(part, kept, fine) + 0.3
            out[t, 0], out[t, 1], out[t, 2], out[t, 3] = a, b, c, d
            error[t] = size * np.sqrt(max(inverse[2, 2], 0.0))
            if turn == 0:
                for k in range(few):
                    part[k] = values[k * MEDIAN_EVERY]
                gain = median(part, everywhere, fine) / usual
                for k in range(few):
                    part[k] = abs(values[k * MEDIAN_EVERY] - gain * basis[0, k * MEDIAN_EVERY])
                bare_size = 1.4826 * median(part, everywhere, fine) + 0.3
                if bare_size < size:
                    size = bare_size
                    for k in range(count):
                        strays[k] = abs(values[k] - gain * basis[0, k])
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
