"""Shake of the camera beside a curve: how far each picture moved, by all that stands still outside the tube.

Along a curve a shift of the picture is along the path here and across it there. So it is measured in the picture, by
the same robust least squares as the bands beside a straight strip, before anything is laid straight.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.video.axis import Axis
from vinetrack.video.curved_axis import CurvedAxis
from vinetrack.video.registration import (
    PIXELS,
    REFERENCE_FRAMES,
    SHAKE_FLOOR_PX,
    SHAKE_ROUNDS,
    SHAKE_SETTLED_PX,
    SHAKE_STEP_PX,
    Reference,
    camera_unit,
    register,
    shaken_alike,
)
from vinetrack.video.strip import GAP_PX

BESIDE_PX = 120
"""Distance from the tube within which ground counts. Chosen: some thousand pixels lie there, of the plane in which the
vine grows; half leaves fewer, twice lets more in that moves by itself."""


def picture_shake(luma: NDArray[Any], axis: CurvedAxis, half_px: float) -> Floats | None:
    """Measure how far each picture moved against the others.

    Parameters
    ----------
    luma : grey levels, shape (n_frames, height, width).
    axis : the curve, px.
    half_px : half the width of what moves along it, px.

    Returns
    -------
    right and down, shape (n_frames, 2), px; None where nothing shakes, or what stands still does not tell.
    """
    height, width = luma.shape[1:]
    level = Axis((0.0, 0.0), (float(max(width - 1, 10)), 0.0))
    y, x = (values.ravel() for values in np.mgrid[2 : height - 2 : 2, 2 : width - 2 : 2])
    across = np.abs(axis.along_and_across(np.column_stack([x, y]).astype(float))[1])
    still = (across > half_px + GAP_PX) & (across < half_px + BESIDE_PX)
    if np.count_nonzero(still) < PIXELS // 10:
        return None
    every = max(1, np.count_nonzero(still) // PIXELS)
    x, y = x[still][::every], y[still][::every]
    picks = np.unique(np.linspace(0, len(luma) - 1, REFERENCE_FRAMES).astype(int))
    picture, unit = np.median(luma[picks], axis=0), camera_unit(luma)
    # A half of the ground must tell of the same shift as the other: what moves by itself does not.
    halves = [_reference(picture, x[part], y[part]) for part in (x < np.median(x), x >= np.median(x))]
    (first, first_sd), (second, second_sd) = (register(luma, level, half, None, unit) for half in halves)
    strength = float(np.median(np.abs(np.concatenate([first[:, 2:], second[:, 2:]]))))
    sd_sum = float(np.median(first_sd + second_sd))
    if not strength > max(SHAKE_FLOOR_PX, 1.25 * sd_sum) or not shaken_alike(luma, level, halves, unit):
        return None
    whole = _reference(picture, x, y)
    shift = np.zeros((len(luma), 2))
    for turn in range(SHAKE_ROUNDS):
        fit, _ = register(luma, level, whole, shift if turn else None, unit)
        step = np.clip(fit[:, 2:], -SHAKE_STEP_PX, SHAKE_STEP_PX)
        shift = shift + step
        if np.abs(step).max() < SHAKE_SETTLED_PX:
            break
        if turn == 0:
            whole = _reference(np.median(_moved_back(luma[picks], shift[picks]), axis=0), x, y)
    return shift


def _reference(picture: Floats, x: NDArray[np.int_], y: NDArray[np.int_]) -> Reference:
    """Places of the ground with what they show: brightness, unity, and slopes along rows and columns."""
    down, right = np.gradient(np.asarray(picture, dtype=float))
    basis = np.stack([picture[y, x], np.ones(len(x)), -right[y, x], -down[y, x]])
    return Reference(x.astype(float), y.astype(float), np.ascontiguousarray(basis, dtype=float))


def _moved_back(luma: NDArray[Any], shift_px: Floats) -> NDArray[np.float32]:
    import cv2

    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    size = luma.shape[2], luma.shape[1]
    return np.stack([
        cv2.warpAffine(frame.astype(np.float32), np.array([[1, 0, dx], [0, 1, dy]]), size, flags=flags,
                       borderMode=cv2.BORDER_REPLICATE)
        for frame, (dx, dy) in zip(luma, shift_px, strict=True)
    ])  # fmt: skip
