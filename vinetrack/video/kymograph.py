"""Initial paths of the front: monotone paths through the kymograph (frame by column), by dynamic programming.

A path is found in two passes. The first knows neither film nor background, only that a column changes once, when the
front passes it: `path_by_change` maximises the change collected along the path; `path_by_appearance` separates columns
that look as at the end of the recording from columns that look as at its start. The second (`edge`) knows both and
compares every pixel with them; distances are clipped, so that a door, a payload flying ahead or a reflection cannot
capture the path.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.core.threads import FEWEST_PICTURES, in_parts, njit
from vinetrack.video.edge_kernels import FASTMATH

if TYPE_CHECKING:
    from vinetrack.video.strip import Strip

# ------------------------------------------------------------------------------
# Compiled: the largest change of each pixel, and paths through pixels that change in order.


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


WINDOW = 10  # Frames before and after a frame whose means are compared (chosen)
PEAK_FRACTION = 0.15  # Part of the largest score of a column that its changes must exceed (chosen)
# Number of frames at either end of the recording whose median shows the scene before and after growth (chosen)
END_FRAMES = 5


@njit(nogil=True, fastmath=FASTMATH, error_model="numpy")
def _change_score(
    strip: np.ndarray, scale: np.ndarray, offset: np.ndarray, window: int, group_size: int, noise: float, begin: int,
    end: int,
) -> np.ndarray:  # fmt: skip
    """Score the change of columns `begin` up to `end`, excluded, at each frame, shape (n_frames, end − begin). The
    score is the sum over groups of rows of the squared difference between the means of the `window` frames before and
    from frame t on, divided by its expectation under noise, less 1.
    """
    n, rows, _ = strip.shape
    groups, columns = rows // group_size, end - begin
    binned = np.zeros((n + 1, columns), np.float32)
    score = np.zeros((n, columns), np.float32)
    group_sum = np.empty(columns, np.int32)
    for g in range(groups):
        for t in range(n):
            group_sum[:] = 0
            for k in range(group_size):
                values = strip[t, g * group_size + k, begin:end]
                for s in range(columns):
                    group_sum[s] += values[s]
            gain, level = np.float32(scale[t] / group_size), np.float32(offset[t])
            before, after = binned[t], binned[t + 1]
            for s in range(columns):
                after[s] = before[s] + (np.float32(group_sum[s]) * gain + level)
        for t in range(1, n):
            a, b = min(n, t + window), max(0, t - window)
            factor = np.float32((a - t) * (t - b) / (a - b))
            share_after, share_before = np.float32(1 / (a - t)), np.float32(1 / (t - b))
            sum_after, sum_here, sum_before, score_of = binned[a], binned[t], binned[b], score[t]
            for s in range(columns):
                d = (sum_after[s] - sum_here[s]) * share_after - (sum_here[s] - sum_before[s]) * share_before
                score_of[s] += factor * d * d
    noise_power = np.float32(noise * noise / group_size * max(groups, 1))
    return score / noise_power - np.float32(1.0)


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


def path_by_change(strip: Strip) -> tuple[Floats, Floats]:
    """Find the front as the monotone path that collects most change; also return the change of each column. Within a
    column the score is proportional to the power of the change, so that the strongest change wins; between columns only
    its logarithm counts, so that a bright glint in a few columns cannot outweigh the others. Returns column of the
    front, shape (n_frames,), px, log of each column's change relative to noise, less PEAK_FRACTION of its maximum;
    shape (n_along,).
    """

    def score_of(first: int, last: int) -> NDArray[np.float32]:
        return _change_score(
            strip.values, strip.scale, strip.offset, WINDOW, _group_size(strip), strip.noise, first, last
        )

    # 100: fewest columns of a strip for which another thread is used (chosen)
    score = np.concatenate(in_parts(score_of, strip.values.shape[2], 100), axis=1)
    peak = score.max(axis=0)
    # 3.0, 0.2: peak score from which a column counts as changed, and the cost of any other (chosen)
    weight = np.where(peak > 3.0, np.log1p(np.maximum(peak, 0)) / np.maximum(peak, 1e-6), 0.0).astype(np.float32)
    score = score * weight
    score = np.where(weight > 0, score - PEAK_FRACTION * score.max(axis=0), -0.2).astype(np.float32)
    path, columns = collecting_path(score), np.arange(score.shape[1])
    passage = np.clip(np.searchsorted(path, columns + 0.5), 0, len(path) - 1)
    return path, np.max([score[np.clip(passage + d, 0, len(path) - 1), columns] for d in (-1, 0, 1)], axis=0)


def path_by_appearance(strip: Strip) -> tuple[Floats, Floats]:
    """Find the front as the path that separates pixels that look as at the end from pixels that look as at the start.
    The vote of a pixel is its distance from the final less that from the initial appearance, divided by the distance
    between the two plus 4 times the noise: near −1 if it looks as at the end, near 1 if as at the start. Also returned
    is the change of each column from start to end, in the units of `path_by_change`.
    """
    first, last = _median_frame(strip, slice(0, END_FRAMES)), _median_frame(strip, slice(-END_FRAMES, None))

    def votes_of(begin: int, end: int) -> NDArray[np.float32]:
        scale, offset = strip.scale[begin:end], strip.offset[begin:end]
        # 4.0: change of a pixel, in units of the noise, at which it has half a vote (chosen)
        return _votes(strip.values[begin:end], scale, offset, first, last, 4.0 * strip.noise)

    votes = np.concatenate(in_parts(votes_of, len(strip.values), FEWEST_PICTURES))
    group_size = _group_size(strip)
    grouped = (last - first)[: len(first) // group_size * group_size].reshape(-1, group_size, first.shape[1])
    power = grouped.mean(axis=1) ** 2
    times_noise = WINDOW / 2 * power.mean(axis=0) / (strip.noise**2 / group_size)
    return dividing_path(votes), (1 - PEAK_FRACTION) * np.log1p(times_noise)


def _group_size(strip: Strip) -> int:
    """Number of rows of a strip that are averaged."""
    # 12, 4: number of groups into which the rows of a strip are divided, and maximum rows per group (chosen)
    return int(np.clip(strip.values.shape[1] // 12, 1, 4))


def _median_frame(strip: Strip, frames: slice) -> NDArray[np.float32]:
    """Median brightness of every pixel over some frames, shape (n_across, n_along)."""
    values = strip.values[frames] * strip.scale[frames, None, None].astype(np.float32)
    values += strip.offset[frames, None, None].astype(np.float32)
    if len(values) != END_FRAMES:
        return np.asarray(np.median(values, axis=0), np.float32)
    # Median of five: the median of the fifth value, the larger minimum and the smaller maximum of two pairs.
    a, b, c, d, e = values
    low, high = np.maximum(np.minimum(a, b), np.minimum(c, d)), np.minimum(np.maximum(a, b), np.maximum(c, d))
    return np.maximum(np.minimum(low, high), np.minimum(np.maximum(low, high), e))


@njit(nogil=True, fastmath=FASTMATH, error_model="numpy")
def _votes(
    strip: np.ndarray, scale: np.ndarray, offset: np.ndarray, first: np.ndarray, last: np.ndarray, softening: float
) -> np.ndarray:
    """Sum the votes of each column in each frame, shape (n_frames, n_along); see `path_by_appearance`."""
    n, rows, columns = strip.shape
    out = np.zeros((n, columns), np.float32)
    weight = np.float32(1.0) / (np.abs(last - first) + np.float32(softening))
    for t in range(n):
        gain, level = np.float32(scale[t]), np.float32(offset[t])
        for u in range(rows):
            for s in range(columns):
                value = np.float32(strip[t, u, s]) * gain + level
                out[t, s] += (abs(value - last[u, s]) - abs(value - first[u, s])) * weight[u, s]
    return out


@njit(nogil=True, fastmath=FASTMATH, error_model="numpy")
def clipped_residual_sums(
    strip: np.ndarray, scale: np.ndarray, offset: np.ndarray, noise: float, path: np.ndarray, appearance: np.ndarray,
    begin: int, end: int,
) -> np.ndarray:  # fmt: skip
    """Sum the clipped squared residuals of a path: a frame against film behind it and background ahead of it. Shapes:
    strip (n_frames, n_across, n_along); scale, offset, path (n_frames,); appearance (2, n_across, n_along) →
    (n_frames,).
    """
    residual_clip = 3.0  # Residual, in units of the noise, at which residuals are clipped (chosen)
    n, rows, _ = strip.shape
    unit, largest_square, totals = np.float32(1 / noise), np.float32(residual_clip * residual_clip), np.zeros(n)
    for t in range(n):
        gain, level = np.float32(scale[t]), np.float32(offset[t])
        front = min(max(math.ceil(path[t]), begin), end)
        for u in range(rows):
            row_total: Any = np.float32(0.0)
            for k in range(2):
                low, high = (begin, front) if k == 0 else (front, end)
                values, picture = strip[t, u, low:high], appearance[k, u, low:high]
                for s in range(high - low):
                    off = (np.float32(values[s]) * gain + level - picture[s]) * unit
                    row_total += min(off * off, largest_square)
            totals[t] += row_total
    return totals


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
