"""Compiled search for fronts: when each pixel changes, and monotone paths through what changes in order."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.core.threads import njit


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
