"""Shrunk frames of a recording and the time at which each pixel changes: input of the search for the axis.

Not every change is growth. A door, a hand or a payload passes over many pixels. What an everting tube covers stays
covered: `SmallPictures.grown` selects the pixels that change once and for good.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Bools, Floats, Indices
from vinetrack.core.threads import njit
from vinetrack.video.frames import (
    Frames,
    PacketIndex,
    Recording,
    film_shots,
    packet_index,
    quiet_log,
    read_frames,
)

MAX_FRAMES = 150  # Maximum number of frames in which the axis is sought, spread evenly over the changes (chosen)
MIN_GROWN_PART = 0.18  # Part of all change that must be growth (measured)


class Pixels(NamedTuple):
    """Pixels that change: their places, time of change and weight, shape (n_pixels,) each; and the number of times."""

    x: Floats
    y: Floats
    time: Floats
    weight: Floats
    n_times: int

    def where(self, kept: Bools) -> Pixels:
        """Return some of the pixels. Shapes: kept (n_pixels,)."""
        return Pixels(self.x[kept], self.y[kept], self.time[kept], self.weight[kept], self.n_times)


def _shrinkage(picture: NDArray[Any]) -> float:
    """Factor by which a picture is shrunk to at most 240 px (chosen)."""
    return max(1.0, max(picture.shape) / 240)


def _shrunk(picture: NDArray[Any]) -> NDArray[Any]:
    """The picture, shrunk."""
    import cv2

    width, height = (max(8, round(side / _shrinkage(picture))) for side in picture.shape[::-1])
    return np.asarray(cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA))


class SmallPictures:
    """The frames of a recording, shrunk once for every step that looks for its axis. `frames`, shape (n_frames, height,
    width), are in grey levels of 255, corrected for flicker; `factor` is the factor by which they were shrunk and
    `shape` their original height and width, px.
    """

    def __init__(self, luma: NDArray[Any]) -> None:
        self.shape, self.factor = luma.shape[1:], _shrinkage(luma[0])
        small = np.stack([_shrunk(frame) for frame in luma]).astype(np.float32)
        sampled = small[:, ::4, ::4] + np.float32(1.0)
        gain = np.median(sampled / sampled[len(luma) // 2], axis=(1, 2))
        small /= np.clip(gain, 0.2, 5.0)[:, None, None]
        self.frames = small * np.float32(255.0 / max(float(small.max()), 1.0))
        self._busy = busy_pictures(self.frames)

    @cached_property
    def changed(self) -> Pixels:
        """All pixels that change."""
        return changed_pixels(*self._busy)

    @cached_property
    def grown(self) -> Pixels:
        """Pixels that change as in growth, by a step that lasts. Their weight is reduced where many change at once, as
        where a door comes to rest. If too little of all change lasts (MIN_GROWN_PART), this is `changed`.
        """
        if not len(self.changed.x):
            return self.changed
        frames, noise = self._busy
        rows, columns = self.changed.y.astype(int), self.changed.x.astype(int)
        lasting = _step_fraction(frames[:, rows, columns].astype(float), self.changed.time.astype(int), noise)
        kept = self.changed.where(lasting > 0.8)  # 0.8: part of a pixel's change that the step explains (measured)
        if kept.weight.sum() < MIN_GROWN_PART * self.changed.weight.sum():
            return self.changed
        # The information of a pixel changing just when a front passes it, in nats, is minus the logarithm of the part
        # of all change that occurs at that time: where much changes at once, the order of changes says little.
        time, span = kept.time.astype(int), int(order_tolerance(kept.n_times))
        by_time = np.bincount(time, kept.weight, kept.n_times)
        share = np.convolve(by_time, np.ones(2 * span + 1))[span : span + kept.n_times] / by_time.sum()
        # 0.05: minimum information of a change, in nats (chosen)
        return kept._replace(weight=kept.weight * (0.05 - np.log(np.minimum(share[time], 1.0))))


@njit(nogil=True)
def largest_steps(pictures: np.ndarray, window: int) -> tuple[np.ndarray, np.ndarray]:
    """Find the first picture after the largest step of each pixel's mean brightness, and the power of that step,
    (n_pixels,) each. Shapes: pictures (n, n_pixels).
    """
    n, pixels = pictures.shape
    best, step_frame = np.zeros(pixels, np.float32), np.zeros(pixels, np.int_)
    block = 512
    sums = np.zeros((n + 1, block), np.float32)
    for start in range(0, pixels, block):
        stop = min(start + block, pixels)
        for t in range(n):
            for k in range(stop - start):
                sums[t + 1, k] = sums[t, k] + pictures[t, start + k]
        for t in range(1, n):
            a, b = min(n, t + window), max(0, t - window)
            after, before = np.float32(a - t), np.float32(t - b)
            factor = np.float32((a - t) * (t - b) / (a - b))
            sum_after, sum_here, sum_before = sums[a], sums[t], sums[b]
            top, place = best[start:stop], step_frame[start:stop]
            for k in range(stop - start):
                step = (sum_after[k] - sum_here[k]) / after - (sum_here[k] - sum_before[k]) / before
                score = factor * step * step
                place[k] = t if score > top[k] else place[k]
                top[k] = max(score, top[k])
    return step_frame, best


def changed_pixels(frames: NDArray[np.float32], noise_power: float) -> Pixels:
    """Find the pixels that change for good, by their largest step, in the `busy_pictures` of a recording."""
    n = len(frames)
    window = int(np.clip(n // 6, 2, 8))
    frame, best = (x.reshape(frames.shape[1:]) for x in largest_steps(frames.reshape(n, -1), window))
    floor = max(30.0 * noise_power, 0.02 * float(np.quantile(best, 0.995)))
    weight = np.where(best > floor, np.log(np.maximum(best, noise_power) / noise_power), 0.0).astype(np.float32)
    rows, columns = np.nonzero(weight > 0)
    time = frame[rows, columns].astype(float)
    return Pixels(columns.astype(float), rows.astype(float), time, weight[rows, columns].astype(float), n)


def busy_pictures(small: NDArray[np.float32]) -> tuple[NDArray[np.float32], float]:
    """At most MAX_FRAMES busy frames, and the variance of a pixel's noise in them, at least that of quantisation."""
    small = busy_frames(small, MAX_FRAMES)
    changes = np.abs(np.diff(small[:: max(1, len(small) // 30), ::2, ::2], axis=0)).ravel()
    return small, max(1.4826 * float(np.median(changes)) / np.sqrt(2), 0.7) ** 2


def busy_frames(pictures: NDArray[np.float32], most: int) -> NDArray[np.float32]:
    """At most so many frames, spread evenly over the changes rather than over time."""
    if (n := len(pictures)) <= most:
        return pictures
    # Squares: a few pixels that change much are activity, many that change a little are noise.
    activity = np.array([np.sqrt(np.mean((after - before) ** 2)) for before, after in pairwise(pictures)])
    floor = float(np.quantile(activity, 0.2))
    busy = np.clip(activity - 1.5 * floor, 0, None) + 0.02 * floor + 1e-6
    total = np.concatenate([[0.0], np.cumsum(np.minimum(busy, 4 * np.quantile(busy, 0.9)))])
    return pictures[np.unique(np.searchsorted(total, np.linspace(0, total[-1], most)).clip(0, n - 1))]


def _step_fraction(values: Floats, frame: Indices, noise_power: float) -> Floats:
    """Fraction of each pixel's variance, beyond noise, that a single step at `frame` explains, shape (n_pixels,).
    `values` has shape (n_frames, n_pixels). A passing object leaves a pixel as it was, so that a step explains hardly
    any.
    """
    n, sums = len(values), np.cumsum(values, axis=0)
    before = np.take_along_axis(sums, np.maximum(frame - 1, 0)[None], axis=0)[0]
    step = before / np.maximum(frame, 1) - (sums[-1] - before) / np.maximum(n - frame, 1)
    explained = frame * (n - frame) / n * step**2
    unexplained = np.maximum(n * values.var(axis=0) - explained - n * noise_power, 0.0)
    return explained / np.maximum(explained + unexplained, 1e-9)


def order_tolerance(n_times: int) -> float:
    """Return by how many pictures a pixel may change before or after the front passes it."""
    # 0.03, 2.0: time by which the change of a pixel may differ from the passage of the front (chosen)
    return max(2.0, 0.03 * n_times)


# ------------------------------------------------------------------------------
# Monotone paths through what changes in order.

# Number of frames at either end of the recording whose median shows the scene before and after growth (chosen)
END_FRAMES = 5


@njit()
def dividing_path(evidence: np.ndarray) -> np.ndarray:
    """Find the monotone path that best separates film from background, by dynamic programming. The sum of `evidence`
    behind the edge is minimised; the edge never retreats. Shapes: evidence (n_frames, n_along) → (n_frames,).
    """
    n, columns = evidence.shape
    best = np.zeros((n, columns + 1), np.float64)
    predecessor = np.zeros((n, columns + 1), np.int32)
    for t in range(n):
        cost, best_cost, best_column = 0.0, np.inf, 0
        for s in range(columns + 1):
            if s > 0:
                cost += evidence[t, s - 1]
            if t == 0:
                best[t, s] = cost
                continue
            if best[t - 1, s] < best_cost:
                best_cost, best_column = best[t - 1, s], s
            best[t, s] = best_cost + cost
            predecessor[t, s] = best_column
    path = np.zeros(n)
    s = int(np.argmin(best[n - 1]))
    for t in range(n - 1, -1, -1):
        path[t] = s
        s = predecessor[t, s]
    return path


def collecting_path(score: NDArray[Any]) -> Floats:
    """Find the monotone path that collects the greatest sum of scores, each column counted once, when the path passes
    it: the path that divides the score's decreases. A column that is passed at once has scored nothing. Shapes: score
    (n_frames, n_along) → (n_frames,).
    """
    gains = np.zeros((len(score) + 1, score.shape[1]))
    gains[1:-1] = score[1:]
    return np.asarray(dividing_path(np.diff(gains, axis=0)))


def column_after_leap(path: Floats) -> int:
    """Return the column at which growth begins if the path leaps at its start. At release the tail jerks inside the
    film that already stands there: its columns change, but no front passes. No front is three times as fast in its
    first frames as in those that follow. Shapes: path (n_frames,).
    """
    steps = np.diff(path)
    if not np.any(steps > 0):
        return 0
    onset = int(np.argmax(steps > 0))
    begin = 0
    for t in range(onset, min(onset + 4, len(steps) - 4)):
        # 3.0, 2.0: A first step more than so many times the median of the four that follow is not growth (chosen)
        if steps[t] > 3.0 * max(float(np.median(steps[t + 1 : t + 5])), 2.0):
            begin = int(path[t + 1])
    return begin


# ------------------------------------------------------------------------------
# Selection of the frames that show the event, so that the rest of a long recording is neither decoded nor held.
#
# A recording stopped by hand may hold thousands of frames of which tens or hundreds show the growth. A recording too
# large for memory is sampled first: the key frames of a film, which can be decoded on their own, or every n-th frame
# of other files. The event lasts from the last sample before pixels change for good to the first after it.

MAX_BYTES_WHOLE = 400_000_000  # Size of the pictures up to which a recording is read whole (chosen)
MAX_SAMPLE_INTERVAL = 120  # Maximum number of frames from one sample to the next (chosen)
MARGIN_FRAMES, MARGIN_PART = 40, 0.15  # Frames, and fraction of the event, added at either end (chosen)


def read_event(recording: Recording, frame_range: tuple[int, int] | None = None) -> Frames:
    """Decode the frames that show the event, or those of a range; the whole recording if it is small, if its frames
    cannot be read one by one, or if no event stands out.
    """
    pixel_bytes = 1 if recording.bit_depth <= 8 else 2
    if (recording.declared_frames or 0) * recording.width * recording.height * pixel_bytes <= MAX_BYTES_WHOLE:
        return read_frames(recording)
    raw, index = recording.raw, packet_index(recording.path) if recording.kind == "container" else None
    count = len(raw.offsets) if raw else len(index.ticks) if index else 0
    if count < MAX_SAMPLE_INTERVAL:
        return read_frames(recording)
    frame_range = frame_range or event_range(*_samples(recording, index), count)
    if frame_range is None or frame_range[0] >= count:
        return read_frames(recording)
    return read_frames(recording, (frame_range[0], min(frame_range[1], count - 1)), index)


def event_range(pictures: list[NDArray[Any]], numbers: Indices, count: int) -> tuple[int, int] | None:
    """Return the first and last frame of the event, both and a margin included, from samples of the recording; None if
    nothing changes. Shapes: pictures (height, width); numbers (n_pictures,).
    """
    fewest = 8  # Samples, and pixels that must have changed (chosen)
    time = SmallPictures(np.stack(pictures)).changed.time.astype(int) if len(pictures) >= fewest else np.zeros(0, int)
    if len(time) < fewest:
        return None
    time.sort()
    start, stop = int(numbers[time[fewest - 1] - 1]), int(numbers[time[-fewest]])
    margin = max(MARGIN_FRAMES, round(MARGIN_PART * (stop - start)))
    return max(start - margin, 0), min(stop + margin, count - 1)


def _samples(recording: Recording, index: PacketIndex | None) -> tuple[list[NDArray[Any]], Indices]:
    """Every n-th frame, shrunk, and their numbers; of a film the key frames, unless these are too rare."""
    if (raw := recording.raw) is not None:
        every = -(-len(raw.offsets) // MAX_FRAMES)
        pictures = [_shrunk(picture) for picture in replace(raw, offsets=raw.offsets[::every]).pictures()]
        return pictures, every * np.arange(len(pictures))
    assert index is not None
    count, keys = len(index.ticks), np.flatnonzero(index.key)
    # Key frames so close to each other that no event fits between two of them
    keys_only = len(keys) > 1 and np.diff(keys, append=count).max() <= MAX_SAMPLE_INTERVAL
    candidates = keys if keys_only else np.arange(count)
    chosen: dict[float, int] = {int(index.ticks[i]): int(i) for i in candidates[:: -(-len(candidates) // MAX_FRAMES)]}
    with quiet_log() as said:
        shots = film_shots(recording, said, chosen=chosen if keys_only else None)
        sampled = {chosen[shot.tick]: _shrunk(picture) for picture, shot in shots if shot.tick in chosen}
    return list(sampled.values()), np.array(list(sampled), dtype=int)
