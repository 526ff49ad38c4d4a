"""The frames of a recording, shrunk, and when each of their pixels changes: where an axis is sought.

Not all that changes is growth. A door that swings away, a hand or a payload passes over many pixels, and where the
door stood at first it is gone. What an everting tube brings stays where it is, and stands out from its surroundings in
the last pictures but not in the first: `SmallPictures.grown` are the pixels that change so.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.video.order_kernels import (
    BINS_A_LEVEL,
    block_means,
    largest_changes,
    largest_steps,
    median,
    ratio_medians,
)

SMALL_PX = 240
"""Longest side of the pictures in which the axis is sought. Chosen: a vine of 3 % of it is then 7 px wide;
at half a thin vine is lost, at twice time is fourfold."""
MAX_FRAMES = 150
"""Frames, spread evenly over the changes, in which it is sought. Chosen for time; they resolve 1 % of the growth."""
BUSIEST_PIXELS = 200
"""Pixels of a small picture whose mean change is its activity. Chosen: the area of a thin vine's tip; half or twice
changes only how the MAX_FRAMES frames are spread over the changes."""
GROWN = 0.4
"""Part of a pixel's change that lasts, times the part by which it stands out at the end, from which growth may have
brought it. Measured on 40 short tubes beside long doors (`benchmarks/long_doors.py`, seeds 71001-71040) and 40 drawn by
other code, axes more than 5 degrees off: 8 and 2 at 0.4, 7 and none at 0.2, 6 and 4 at 0.6; 15 and 24 with all that
changes."""
LEAST_GROWN = 0.16
"""Part of all change that must be such, or all that changes is asked: a vine that sweeps leaves what it has covered.
Chosen between 0.08 of a real vine that sweeps and 0.32, the least of those 40; at half that vine counts as one that
stays, at twice two of those 40 do not."""
AROUND_PX = 4.0
"""Distance, in the small pictures, over which what has not changed tells how a pixel's surroundings look. Chosen:
between the widths of thin and wide tubes. Measured on the same: 6 and 4 axes are off at half, 8 and none at twice."""
ENDS = 12
"""Part of the pictures, a twelfth, whose median is the first and the last of them. Chosen: more than two, so that a
single one that is spoilt does not count; by reasoning, nothing changes at half or twice while it rests so long."""
TOLERANCE, LEAST_TOLERANCE = 0.03, 2.0
"""Part of the pictures, and number of them, by which a change may miss the front that brings it. Chosen: the tip's
shape and blur are within it. By reasoning: at half round tips fall out of order, at twice doors come into it."""
LEAST_SURPRISE = 0.05
"""Chosen: so that what all changes at once, as where a vine takes two pictures, tells as well. Half or twice changes
nothing where anything else does."""

Pixels = tuple[Floats, Floats, Floats, Floats, int]
"""Pixels that change: x, y, when and worth, shape (n_pixels,) each; and the number of times looked at."""


class SmallPictures:
    """The frames of a recording, shrunk once for all that look for its axis.

    `frames` has shape (n_frames, height, width) in grey levels of 255, free of flicker; `factor` is by how much they
    shrank and `shape` the height and width before, px.
    """

    def __init__(self, luma: NDArray[Any]) -> None:
        self.frames, self.factor = _small_frames(luma)
        self.shape = luma.shape[1:]

    @cached_property
    def _busy(self) -> tuple[NDArray[np.float32], float]:
        """The frames that are looked at, and the variance of their noise."""
        return _looked_at(self.frames)

    @cached_property
    def changed(self) -> Pixels:
        """All pixels that change."""
        return _changed(*self._busy)

    @cached_property
    def grown(self) -> Pixels:
        """Pixels that change as where a tube grows: what comes stays, and stands out where nothing did.

        Their worth is less where many change at once, as where a door comes to rest. It is `changed` itself where
        hardly any of it stays (LEAST_GROWN).
        """
        x, y, time, worth, n_times = self.changed
        if not len(x):
            return self.changed
        frames, noise = self._busy
        rows, columns = y.astype(int), x.astype(int)
        lasting = _lasting_part(frames[:, rows, columns].astype(float), time.astype(int), noise)
        kept = lasting * _standing_out(frames, rows, columns, noise) > GROWN
        if worth[kept].sum() < LEAST_GROWN * worth.sum():
            return self.changed
        worth = worth[kept] * _surprise(time[kept], worth[kept], n_times)
        return x[kept], y[kept], time[kept], worth, n_times


def changed_pixels(small: NDArray[np.float32], count: int) -> Pixels:
    """Find the pixels that change.

    Parameters
    ----------
    small : brightness, shape (n_frames, height, width).
    count : frames, from the first, within which they change.

    Returns
    -------
    the pixels.
    """
    return _changed(*_looked_at(small[:count]))


def _looked_at(small: NDArray[np.float32]) -> tuple[NDArray[np.float32], float]:
    """Frames in which something changes, and the variance of their noise."""
    busy = small[_busy_frames(small)]
    return busy, _noise_power(busy)


def _changed(busy: NDArray[np.float32], noise_power: float) -> Pixels:
    when, worth = _changes(busy, noise_power)
    rows, columns = np.nonzero(worth > 0)
    time = when[rows, columns].astype(float)
    return columns.astype(float), rows.astype(float), time, worth[rows, columns].astype(float), len(busy)


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
    activity = largest_changes(small.reshape(n, -1), BUSIEST_PIXELS)
    floor = float(np.quantile(activity, 0.2))
    busy = np.clip(activity - 1.5 * floor, 0, None) + 0.02 * floor + 1e-6
    total = np.concatenate([[0.0], np.cumsum(np.minimum(busy, 4 * np.quantile(busy, 0.9)))])
    return np.unique(np.searchsorted(total, np.linspace(0, total[-1], MAX_FRAMES)).clip(0, n - 1))


def _changes(frames: NDArray[np.float32], noise_power: float) -> tuple[NDArray[np.int_], NDArray[np.float32]]:
    """Frame at which each pixel changes most and for good, and what that change is worth; shapes (height, width)."""
    n = len(frames)
    window = int(np.clip(n // 6, 2, 8))
    when, best = (x.reshape(frames.shape[1:]) for x in largest_steps(frames.reshape(n, -1), window))
    floor = max(30.0 * noise_power, 0.02 * float(np.quantile(best, 0.995)))
    return when, np.where(best > floor, np.log(np.maximum(best, noise_power) / noise_power), 0.0).astype(np.float32)


def _noise_power(frames: NDArray[np.float32]) -> float:
    """Variance of the noise of a pixel, of a picture's quantisation at least."""
    changes = np.abs(np.diff(frames[:: max(1, len(frames) // 30), ::2, ::2], axis=0)).ravel()
    noise = 1.4826 * float(median(changes, np.ones(changes.size, np.int8), BINS_A_LEVEL)) / np.sqrt(2)
    return max(noise, 0.7) ** 2


def _lasting_part(values: Floats, when: NDArray[np.int_], noise_power: float) -> Floats:
    """Part of each pixel's variance, but for noise, that one step at `when` explains, shape (n_pixels,).

    `values` has shape (n_frames, n_pixels). What passes leaves a pixel as it was, and hardly any is explained.
    """
    n, sums = len(values), np.cumsum(values, axis=0)
    before = np.take_along_axis(sums, np.maximum(when - 1, 0)[None], axis=0)[0]
    step = before / np.maximum(when, 1) - (sums[-1] - before) / np.maximum(n - when, 1)
    explained = when * (n - when) / n * step**2
    left = np.maximum(n * values.var(axis=0) - explained - n * noise_power, 0.0)
    return explained / np.maximum(explained + left, 1e-9)


def _standing_out(
    frames: NDArray[np.float32], rows: NDArray[np.int_], columns: NDArray[np.int_], noise_power: float
) -> Floats:
    """How much more pixels that changed differ from their surroundings at the end than at the beginning, (n_pixels,).

    1 where they did not differ at first, 0 where they do not at last. The surroundings are what did not change, on the
    side where it tells most: film beside film that stands already differs from the ground above and below.
    """
    import cv2

    count = max(2, len(frames) // ENDS)
    ends = [np.median(frames[:count], axis=0), np.median(frames[-count:], axis=0)]
    still = np.ones(frames.shape[1:], np.float32)
    still[rows, columns] = 0.0
    grounds = [_sides(picture * still) for picture in (*ends, np.ones_like(still))]
    out = np.zeros(len(rows))
    for first, last, weight in zip(*grounds, strict=True):
        seen = np.maximum(weight, 1e-9)
        before, after = (
            cv2.blur((picture - ground / seen) ** 2, (3, 3))[rows, columns]
            for picture, ground in zip(ends, (first, last), strict=True)
        )
        out = np.maximum(out, np.where(seen[rows, columns] > 1e-6, after / (before + after + 2 * noise_power), 0.0))
    return out


def _sides(picture: NDArray[np.float32]) -> list[NDArray[np.float32]]:
    """Sums over what lies left, right, above and below of each pixel; far off counts where nothing is near."""
    import cv2

    out = [np.zeros_like(picture) for _ in range(4)]
    for share, reach in ((1.0, 1), (1e-2, 4), (1e-4, 16)):
        # Wide filters work on a picture that is shrunk by as much as they are wider.
        height, width = picture.shape
        shrunk = cv2.resize(picture, (-(-width // reach), -(-height // reach)), interpolation=cv2.INTER_AREA)
        size = 2 * min(round(3 * AROUND_PX), max(shrunk.shape)) + 1
        whole = cv2.getGaussianKernel(size, AROUND_PX, cv2.CV_32F).ravel()
        back, ahead = whole.copy(), whole.copy()
        back[size // 2 + 1 :] = ahead[: size // 2] = 0.0
        for side, (along, across) in zip(
            out, ((back, whole), (ahead, whole), (whole, back), (whole, ahead)), strict=True
        ):
            seen = cv2.sepFilter2D(shrunk, -1, along, across, borderType=cv2.BORDER_CONSTANT)
            side += share * (seen if reach == 1 else cv2.resize(seen, (width, height)))
    return out


def order_tolerance(n_times: int) -> float:
    """How much earlier or later than the front a pixel may change that it passes, in pictures.

    Parameters
    ----------
    n_times : pictures that are looked at.

    Returns
    -------
    pictures.
    """
    return max(LEAST_TOLERANCE, TOLERANCE * n_times)


def _surprise(time: Floats, worth: Floats, n_times: int) -> Floats:
    """How much it tells that a pixel changes just when a front passes it, shape (n_pixels,).

    It is the logarithm of how seldom any pixel changes then: where much changes at once, order says little.
    """
    by_time = np.bincount(time.astype(int), worth, n_times)
    span = int(order_tolerance(n_times))
    share = np.convolve(by_time, np.ones(2 * span + 1))[span : span + n_times] / by_time.sum()
    return np.asarray(LEAST_SURPRISE - np.log(np.minimum(share[time.astype(int)], 1.0)))
