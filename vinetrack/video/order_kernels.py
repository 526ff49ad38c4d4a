"""Compiled medians (by histogram instead of sorting), largest changes, and paths through pixels that change
in order.

Medians are exact; the range of the values must be known.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from vinetrack.video.threads import FEWEST_PICTURES, in_parts

LEVELS = 256  # Range of the values of the histogram (derived)
BINS_PER_LEVEL = 16  # Histogram bins per grey level; the median is then sought within one or two bins (chosen)
MAX_SORTED = 300  # Number of values up to which they are sorted directly (chosen)


@njit(cache=True, nogil=True)
def median(values: np.ndarray, keep: np.ndarray, bins_per_unit: float) -> float:
    """Median of the values with `keep` > 0; the mean of the two middle ones for an even number. Shapes: values, keep
    (n,).
    """
    last = LEVELS * BINS_PER_LEVEL - 1
    place = np.empty(len(values), np.int32)
    bins = np.zeros(last + 1, np.int32)
    count = 0
    for k in range(len(values)):
        place[k] = min(int(values[k] * bins_per_unit), last) if keep[k] > 0 else -1
    for k in range(len(values)):
        if place[k] >= 0:
            bins[place[k]] += 1
            count += 1
    if count == 0:
        return 0.0
    lower, upper = (count - 1) // 2, count // 2
    below, first = 0, 0
    while below + bins[first] <= lower:
        below += bins[first]
        first += 1
    second, within = first, bins[first]
    while below + within <= upper:
        second += 1
        within += bins[second]
    candidates = np.empty(within, values.dtype)
    j = 0
    for k in range(len(values)):
        if first <= place[k] <= second:
            candidates[j] = values[k]
            j += 1
    return 0.5 * (_order_statistic(candidates, lower - below) + _order_statistic(candidates, upper - below))


@njit(cache=True, nogil=True)
def _order_statistic(values: np.ndarray, rank: int) -> float:
    """Return the value of a rank, counted from 0, by repeated histograms until few values remain."""
    while len(values) > MAX_SORTED:
        low, high = values.min(), values.max()
        if low == high:
            return float(low)
        last = LEVELS * BINS_PER_LEVEL - 1
        place = np.minimum((values - low) * (last / (high - low)), last).astype(np.int64)
        bins = np.bincount(place, minlength=last + 1)
        below, chosen = 0, 0
        while below + bins[chosen] <= rank:
            below += bins[chosen]
            chosen += 1
        if bins[chosen] == len(values):
            break
        values, rank = values[place == chosen], rank - below
    return float(np.sort(values)[rank])


@njit(cache=True, nogil=True)
def ratio_medians(pictures: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Median ratio of each picture, plus one grey level, to a reference. Shapes: pictures (n, height, width); reference
    (height, width) → (n,).
    """
    n, height, width = pictures.shape
    out, ratio, keep = np.empty(n, np.float32), np.empty(height * width, np.float32), np.ones(height * width, np.int8)
    for t in range(n):
        for y in range(height):
            for x in range(width):
                ratio[y * width + x] = (pictures[t, y, x] + np.float32(1.0)) / reference[y, x]
        # Ratios need a finer histogram than grey levels: bins of 1/1024.
        out[t] = median(ratio, keep, 64.0 * BINS_PER_LEVEL)
    return out


@njit(cache=True, nogil=True, fastmath={"nnan", "nsz"})
def largest_changes(pictures: np.ndarray, count: int) -> np.ndarray:
    """Mean of the `count` largest absolute changes of single pixels from each picture to the next. Shapes: pictures (n,
    n_pixels) → (n - 1,).
    """
    n, pixels = pictures.shape
    count = min(count, pixels)
    out, change = np.zeros(n - 1, np.float32), np.empty(pixels, np.float32)
    bins, totals = np.zeros(LEVELS * BINS_PER_LEVEL, np.int64), np.zeros(LEVELS * BINS_PER_LEVEL)
    limit = np.float32(0.0)
    for t in range(n - 1):
        before, after = pictures[t], pictures[t + 1]
        for k in range(pixels):
            change[k] = abs(after[k] - before[k])
        # Most pixels change too little to count: only changes near the limit of the previous picture are binned.
        while True:
            bins[:], totals[:] = 0, 0.0
            counted = 0
            for start in range(0, pixels, 16):
                chunk = change[start : start + 16]
                largest = np.float32(0.0)
                for value in chunk:
                    largest = max(largest, value)
                if largest < limit:
                    continue
                for value in chunk:
                    if value >= limit:
                        place = min(int(value * BINS_PER_LEVEL), LEVELS * BINS_PER_LEVEL - 1)
                        bins[place] += 1
                        totals[place] += value
                        counted += 1
            if counted >= count:
                break
            limit = np.float32(0.0)
        total, taken, place = 0.0, 0, LEVELS * BINS_PER_LEVEL - 1
        while taken + bins[place] < count:
            taken += bins[place]
            total += totals[place]
            place -= 1
        total += (count - taken) * totals[place] / max(bins[place], 1)
        out[t] = total / count
        limit = np.float32(0.7 * place / BINS_PER_LEVEL)
    return out


@njit(cache=True, nogil=True)
def largest_steps(pictures: np.ndarray, window: int) -> tuple[np.ndarray, np.ndarray]:
    """Find the frame at which the mean brightness of each pixel changes most, and the power of that change. Returns
    index of the first picture after the step, and the power of the step, each of shape (n_pixels,). Shapes: pictures
    (n, n_pixels).
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


def block_means(luma: NDArray[Any], side: int) -> NDArray[np.float32]:
    """Shrink pictures by a whole factor: means of square blocks, rounded to whole grey levels as in OpenCV. Shapes:
    luma (n, height, width) → (n, height / side, width / side).
    """
    n, height, width = luma.shape
    out = np.empty((n, height // side, width // side), np.float32)
    in_parts(lambda first, last: _block_means(luma[first:last], side, out[first:last]), n, FEWEST_PICTURES)
    return out


@njit(cache=True, nogil=True)
def _block_means(luma: np.ndarray, side: int, out: np.ndarray) -> None:
    """Write the means of square blocks into `out`; see `block_means`."""
    n, height, width = luma.shape
    total = np.empty(width, np.int32)
    weight = np.float32(1.0 / (side * side))
    for t in range(n):
        for y in range(height // side):
            total[:] = 0
            for j in range(side):
                row = luma[t, y * side + j]
                for x in range(width):
                    total[x] += row[x]
            line = out[t, y]
            if side == 4:  # the usual case: with a constant number of terms the compiler vectorises the sum
                for x in range(width // 4):
                    k = 4 * x
                    line[x] = np.rint((total[k] + total[k + 1] + total[k + 2] + total[k + 3]) * weight)
                continue
            for x in range(width // side):
                block = np.int32(0)
                for j in range(side):
                    block += total[x * side + j]
                line[x] = np.rint(block * weight)


@njit(cache=True, nogil=True)
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


@njit(cache=True)
def passing_times(table: np.ndarray) -> np.ndarray:
    """Find the monotone path that collects most change, and the time at which it passes each position. Shapes: table
    (n_times, n_places) → (n_places,).
    """
    n, places = table.shape
    best = np.zeros((n, places + 1))
    predecessor = np.zeros((n, places + 1), np.uint8)
    for t in range(n):
        for s in range(places + 1):
            best[t, s] = best[t - 1, s] if t > 0 else 0.0
            if s > 0 and best[t, s - 1] + table[t, s - 1] > best[t, s]:
                best[t, s] = best[t, s - 1] + table[t, s - 1]
                predecessor[t, s] = 1
    passed = np.full(places, np.nan)
    t, s = n - 1, places
    while s > 0 and t >= 0:
        if predecessor[t, s] == 1:
            passed[s - 1] = t
            s -= 1
        elif t > 0:
            t -= 1
        else:
            break
    return passed


def mean_changes(pictures: NDArray[Any], step: int) -> NDArray[np.float64]:
    """Mean absolute change from each picture to the next, of every `step`-th row and column. Shapes: pictures (n,
    height, width) → (n - 1,).
    """
    sums = in_parts(
        lambda first, last: _sums_of_changes(pictures[first : last + 1], step), len(pictures) - 1, FEWEST_PICTURES
    )
    height, width = (-(-size // step) for size in pictures.shape[1:])
    return np.concatenate(sums) / (height * width)


@njit(cache=True, nogil=True)
def _sums_of_changes(pictures: np.ndarray, step: int) -> np.ndarray:
    """Sum the absolute changes of `mean_changes`."""
    n, height, width = pictures.shape
    out = np.zeros(n - 1)
    for t in range(n - 1):
        total = np.int64(0)
        for y in range(0, height, step):
            before, after = pictures[t, y], pictures[t + 1, y]
            row_total = np.int64(0)
            if step == 2:  # the usual case: with a constant step the compiler vectorises the sum
                for x in range(0, width, 2):
                    row_total += abs(np.int32(after[x]) - np.int32(before[x]))
            else:
                for x in range(0, width, step):
                    row_total += abs(np.int32(after[x]) - np.int32(before[x]))
            total += row_total
        out[t] = total
    return out
