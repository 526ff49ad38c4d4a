"""Measure the shake of a camera beside a curved axis: how far each picture moved, by the still background.

A shift of the picture is along the curve in one place and across it in another. It is therefore measured in the
picture, before anything is straightened, by the same robust least squares as the bands beside a straight strip.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.video.axis import Axis
from vinetrack.video.curved_axis import CurvedAxis
from vinetrack.video.registration import (
    REFERENCE_FRAMES,
    SHAKE_CONVERGED_PX,
    SHAKE_FLOOR_PX,
    SHAKE_ROUNDS,
    SHAKE_STEP_PX,
    SHIFT_PIXELS,
    Reference,
    camera_unit,
    register,
    shifts_agree,
)
from vinetrack.video.strip import BAND_GAP_PX

GROUND_PX = 120  # Distance from the tube within which background counts (chosen)


def picture_shake(luma: NDArray[Any], axis: CurvedAxis, half_px: float) -> Floats | None:
    """Measure how far each picture moved against the others. Shapes: luma (n_frames, height, width) → (n_frames, 2)."""
    height, width = luma.shape[1:]
    level = Axis((0.0, 0.0), (float(max(width - 1, 10)), 0.0))
    y, x = (values.ravel() for values in np.mgrid[2 : height - 2 : 2, 2 : width - 2 : 2])
    across = np.abs(axis.along_and_across(np.column_stack([x, y]).astype(float))[1])
    still = (across > half_px + BAND_GAP_PX) & (across < half_px + GROUND_PX)
    if np.count_nonzero(still) < SHIFT_PIXELS // 10:
        return None
    every = max(1, np.count_nonzero(still) // SHIFT_PIXELS)
    x, y = x[still][::every], y[still][::every]
    sampled = np.unique(np.linspace(0, len(luma) - 1, REFERENCE_FRAMES).astype(int))
    picture, unit = np.median(luma[sampled], axis=0), camera_unit(luma)
    # Both halves of the background must show the same shift; what moves by itself does not.
    halves = [_reference(picture, x[part], y[part]) for part in (x < np.median(x), x >= np.median(x))]
    (first, first_sd), (second, second_sd) = (register(luma, level, half, None, unit) for half in halves)
    shake_px = float(np.median(np.abs(np.concatenate([first[:, 2:], second[:, 2:]]))))
    sd_sum = float(np.median(first_sd + second_sd))
    if not shake_px > max(SHAKE_FLOOR_PX, 1.25 * sd_sum) or not shifts_agree(luma, level, halves, unit):
        return None
    whole = _reference(picture, x, y)
    shift = np.zeros((len(luma), 2))
    for turn in range(SHAKE_ROUNDS):
        fit, _ = register(luma, level, whole, shift if turn else None, unit)
        step = np.clip(fit[:, 2:], -SHAKE_STEP_PX, SHAKE_STEP_PX)
        shift = shift + step
        if np.abs(step).max() < SHAKE_CONVERGED_PX:
            break
        if turn == 0:
            whole = _reference(np.median(_moved_back(luma[sampled], shift[sampled]), axis=0), x, y)
    return shift


def _reference(picture: Floats, x: NDArray[np.int_], y: NDArray[np.int_]) -> Reference:
    """Pixels of the background and the basis of the fit: brightness, one, and slopes along rows and columns."""
    down, right = np.gradient(np.asarray(picture, dtype=float))
    basis = np.stack([picture[y, x], np.ones(len(x)), -right[y, x], -down[y, x]])
    return Reference(x.astype(float), y.astype(float), np.ascontiguousarray(basis, dtype=float))


def _moved_back(luma: NDArray[Any], shift_px: Floats) -> NDArray[np.float32]:
    """Pictures shifted back by the shake, bicubic."""
    import cv2

    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    size = luma.shape[2], luma.shape[1]
    return np.stack([
        cv2.warpAffine(frame.astype(np.float32), np.array([[1, 0, dx], [0, 1, dy]]), size, flags=flags,
                       borderMode=cv2.BORDER_REPLICATE)
        for frame, (dx, dy) in zip(luma, shift_px, strict=True)
    ])  # fmt: skip
