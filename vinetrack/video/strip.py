"""A straight strip along the axis, cut from every frame, corrected for flicker and camera shake.

The bands of background beside the tube stand still; each frame's gain and shift are estimated from them
(`registration`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.video.axis import Axis
from vinetrack.video.registration import camera_unit, stabilise
from vinetrack.video.resample import sample

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
