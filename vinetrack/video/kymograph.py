"""Search for fronts: monotone paths through what changes in order."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.core.threads import njit


@njit(nogil=True)
def monotone_path_sums(
    along: np.ndarray, across: np.ndarray, time: np.ndarray, weight: np.ndarray, bins: int, length: int, n_times: int
) -> np.ndarray:
    """Return the maximum change that a monotone path collects, for each band of two bins across parallel lines. Shapes:
    along, across, time, weight (n_pixels,) → (bins − 1,).
    """
    places = length // 4 + 1
    table = np.zeros((bins, n_times, places), np.float32)
    low, high = np.full((bins, n_times), places), np.full((bins, n_times), -1)
    for i in range(len(along)):
        b, t, s = min(max(int(across[i]), 0), bins - 1), int(time[i]), min(max(int(along[i] / 4), 0), places - 1)
        table[b, t, s] += weight[i]
        low[b, t], high[b, t] = min(low[b, t], s), max(high[b, t], s)
    out = np.zeros(bins - 1)
    best = np.zeros(places + 1)
    for b in range(bins - 1):
        best[:] = 0.0
        for t in range(n_times):
            last = max(high[b, t], high[b + 1, t]) + 1
            # `best` never decreases along the line: it changes only from where a pixel changes now onwards.
            for s in range(min(low[b, t], low[b + 1, t]) + 1, places + 1):
                if s > last and best[s] >= best[s - 1]:
                    break
                best[s] = max(best[s], best[s - 1] + table[b, t, s - 1] + table[b + 1, t, s - 1])
        out[b] = best[-1]
    return out


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
