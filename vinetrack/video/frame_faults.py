"""Detect pictures that are not what the camera saw at their time: torn ones, odd ones at the beginning, copies."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from vinetrack.core.records import Bools, Floats

if TYPE_CHECKING:
    from vinetrack.video.strip import Strip


def torn_frames(luma: NDArray[Any]) -> Bools:
    """Frames in which part of a row of blocks is unlike the frames before and after: decoded from damaged data. A front
    that passes leaves a block between its values before and after; a tear lies outside both. Shapes: luma (n_frames,
    height, width) → (n_frames,).
    """
    torn_block_px, torn_run = 16, 12  # Side of the blocks that are compared (derived)
    n, height, width = luma.shape
    rows, columns = height // torn_block_px, width // torn_block_px
    if n < 6 or rows == 0 or columns < torn_run:
        return np.zeros(n, dtype=bool)
    cropped = luma[:, : rows * torn_block_px, : columns * torn_block_px]
    grid = (rows, torn_block_px, columns, torn_block_px)
    block = np.array([picture.reshape(grid).mean(axis=(1, 3), dtype=np.float32) for picture in cropped])
    block -= np.median(block - np.median(block, axis=0), axis=(1, 2))[:, None, None]  # flicker
    excess = np.zeros_like(block)
    place = np.arange(n)
    for gap in (1, 2):  # two torn frames in a row are compared with those around both
        before = np.where(place >= gap, place - gap, place + 2 * gap)
        after = np.where(place + gap < n, place + gap, place - 2 * gap)
        low, high = np.minimum(block[before], block[after]), np.maximum(block[before], block[after])
        excess = np.maximum(excess, np.maximum(block - high, low - block))
    unit = 1.0 if luma.dtype == np.uint8 else max(float(block.max()), 1.0) / 255
    # 4.0, 4.0: distance of a block outside them (chosen)
    limit = 4.0 * unit + 4.0 * np.quantile(excess, 0.75, axis=0)
    return np.asarray((excess > limit).sum(axis=2).max(axis=1) >= torn_run)


def odd_frames(luma: NDArray[Any]) -> Bools:
    """Frames among the first few that resemble none after them; some cameras write such. Shapes: luma (n_frames,
    height, width) → (n_frames,).
    """
    odd = np.zeros(len(luma), dtype=bool)
    if len(luma) < 8:
        return odd
    small = luma[:8, ::4, ::4].astype(np.float32)

    def difference(a: int, b: int) -> float:
        return float(np.mean(np.abs(small[a] - small[b])))

    median_difference = float(np.median([difference(i, i + 1) for i in range(3, 7)]))
    unit = 1.0 if luma.dtype == np.uint8 else max(float(small.max()), 1.0) / 255
    # 8.0, 6.0: A frame is odd where it differs from later ones by this many times what neighbours differ by (chosen)
    limit = max(8.0 * median_difference, 6.0 * unit)
    # 3: number of first frames that may be odd (chosen)
    for i in range(3):
        odd[i] = difference(i, 3) > limit and difference(i, 4) > limit
    return odd


def repeated_frames(strip: Strip, edge_px: Floats) -> Bools:
    """Frames in which the surroundings of the edge repeat those of the frame before. The change of the picture is
    compared with that where the edge moves, and the edge must stand still between frames that show it moving on.
    Shapes: edge_px (n_frames,) → (n_frames,).
    """
    around_px = 40  # Columns on either side of the edge that are compared (chosen)
    clear_step_px = 2.0  # Mean step of three frames above which a copy can be told from slow growth (chosen)
    n, _, columns = strip.values.shape
    seen_px = np.where(np.isfinite(edge_px), edge_px, 0.0)
    low = np.clip(seen_px - around_px, 0, columns - 1).astype(int)
    high = np.maximum(np.clip(seen_px + around_px, 1, columns).astype(int), low + 1)
    change = np.where(np.isfinite(edge_px), _changes_between(strip.values, low, high) * strip.scale, np.inf)
    moving = np.zeros(n, dtype=bool)
    moving[1:] = np.diff(edge_px) > clear_step_px / 2
    median_change = float(np.median(change[moving])) if moving.any() else np.inf
    repeated = np.zeros(n, dtype=bool)
    for i in range(2, n - 1):
        mean_step = 0.5 * (edge_px[i + 1] - edge_px[i - 2])
        # 0.1, 0.15: A copy moves less than this part of a step, and its picture changes by less than this
        # part of the median (chosen)
        stands = abs(edge_px[i] - edge_px[i - 1]) < 0.1 * mean_step
        repeated[i] = mean_step > clear_step_px and stands and change[i] < 0.15 * median_change
    return repeated


@njit(cache=True, nogil=True)
def _changes_between(values: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Mean absolute change of each frame, of every second row of some columns, from the one before; shape (n_frames,).
    The first has none before it: infinity.
    """
    n, rows, _ = values.shape
    out = np.full(n, np.inf)
    for t in range(1, n):
        total = np.int64(0)
        for u in range(0, rows, 2):
            before, after = values[t - 1, u, low[t] : high[t]], values[t, u, low[t] : high[t]]
            for s in range(len(before)):
                total += abs(np.int32(after[s]) - np.int32(before[s]))
        out[t] = total / ((rows + 1) // 2 * (high[t] - low[t]))
    return out
