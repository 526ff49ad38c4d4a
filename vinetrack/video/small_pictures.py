"""The frames of a recording, shrunk, and when each of their pixels changes for good: where an axis is sought."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.video.order_kernels import BINS_A_LEVEL, block_means, largest_steps, median, ratio_medians

SMALL_PX = 240
"""Longest side of the pictures in which the axis is sought. Chosen: a vine of 3 % of it is then 7 px wide;
at half a thin vine is lost, at twice time is fourfold."""
MAX_FRAMES = 150
"""Frames, spread evenly over the changes, in which it is sought. Chosen for time; they resolve 1 % of the growth."""


class SmallPictures:
    """The frames of a recording, shrunk once for all that look for its axis.

    `frames` has shape (n_frames, height, width) in grey levels of 255, free of flicker; `factor` is by how much they
    shrank and `shape` the height and width before, px.
    """

    def __init__(self, luma: NDArray[Any]) -> None:
        self.frames, self.factor = _small_frames(luma)
        self.shape = luma.shape[1:]

    @cached_property
    def changed(self) -> tuple[Floats, Floats, Floats, Floats, int]:
        """Pixels that change: x, y, when and worth, shape (n_pixels,) each; and the number of times looked at."""
        return changed_pixels(self.frames, len(self.frames))


def changed_pixels(small: NDArray[np.float32], count: int) -> tuple[Floats, Floats, Floats, Floats, int]:
    """Find the pixels that change.

    Parameters
    ----------
    small : brightness, shape (n_frames, height, width).
    count : frames, from the first, within which they change.

    Returns
    -------
    x, y, when and worth, shape (n_pixels,) each; and the number of times looked at.
    """
    picked = _busy_frames(small[:count])
    when, worth = _changes(small[picked])
    rows, columns = np.nonzero(worth > 0)
    time = when[rows, columns].astype(float)
    return columns.astype(float), rows.astype(float), time, worth[rows, columns].astype(float), len(picked)


def _small_frames(luma: NDArray[Any]) -> tuple[NDArray[np.float32], float]:
    """Pictures no longer than SMALL_PX, brightness freed of flicker, and the factor by which they shrank."""
    import cv2

    n, height, width = luma.shape
    factor = max(1.0, max(height, width) / SMALL_PX)
    size = (max(8, round(width / factor)), max(8, round(height / factor)))
    side = round(factor)
    if side == factor and height % side == 0 and width % side == 0 and 8 * side <= min(height, width):
        small = block_means(luma, side)
    else:
        small = np.stack([cv2.resize(frame, size, interpolation=cv2.INTER_AREA) for frame in luma]).astype(np.float32)
    gain = ratio_medians(small[:, ::2, ::2], small[n // 2, ::2, ::2] + np.float32(1.0))
    small /= np.clip(gain, 0.2, 5.0)[:, None, None]
    return small * np.float32(255.0 / max(float(small.max()), 1.0)), factor


def _busy_frames(small: NDArray[np.float32]) -> NDArray[np.int_]:
    """At most MAX_FRAMES frames, spread evenly over what changes rather than over time."""
    n = len(small)
    if n <= MAX_FRAMES:
        return np.arange(n)
    change = np.abs(np.diff(small, axis=0))
    activity = np.partition(change.reshape(n - 1, -1), -20, axis=1)[:, -200:].mean(axis=1)
    floor = float(np.quantile(activity, 0.2))
    busy = np.clip(activity - 1.5 * floor, 0, None) + 0.02 * floor + 1e-6
    total = np.concatenate([[0.0], np.cumsum(np.minimum(busy, 4 * np.quantile(busy, 0.9)))])
    return np.unique(np.searchsorted(total, np.linspace(0, total[-1], MAX_FRAMES)).clip(0, n - 1))


def _changes(frames: NDArray[np.float32]) -> tuple[NDArray[np.int_], NDArray[np.float32]]:
    """Frame at which each pixel changes most and for good, and what that change is worth; shapes (height, width)."""
    n = len(frames)
    window = int(np.clip(n // 6, 2, 8))
    changes = np.abs(np.diff(frames[:: max(1, n // 30)], axis=0)).ravel()
    noise = 1.4826 * float(median(changes, np.ones(changes.size, np.int8), BINS_A_LEVEL)) / np.sqrt(2)
    when, best = (x.reshape(frames.shape[1:]) for x in largest_steps(frames.reshape(n, -1), window))
    unit = max(noise, 0.7) ** 2
    floor = max(30.0 * unit, 0.02 * float(np.quantile(best, 0.995)))
    return when, np.where(best > floor, np.log(np.maximum(best, unit) / unit), 0.0).astype(np.float32)
