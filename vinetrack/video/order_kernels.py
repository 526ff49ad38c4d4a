"""Compiled medians by a histogram instead of by sorting, largest changes, and paths through pixels changing in order.

Medians are exact, of many values whose range is known.
"""

from __future__ import annotations

import numpy as np
from numba import njit

LEVELS = 256
"""Range of the values whose histogram is taken. Derived: brightness and its differences are in grey levels of 255."""
BINS_A_LEVEL = 16
"""Bins of a histogram by grey level, in one or two of which the median is looked for. Chosen: a bin then holds some
hundred of 9000 values; only time depends on it."""
FEW_TO_SORT = 300
"""Values that are put in order at once. Chosen for time alone: a bin holds some hundred, thousands where a coder has
frozen the picture."""


@njit(cache=True, nogil=True)
def median(values: np.ndarray, keep: np.ndarray, fine: float) -> float:
    """Median of the values that are kept; the mean of the two middle ones of an even number.

    Parameters
    ----------
    values : from 0 on, shape (n,).
    keep : 1 for those that count, else 0, shape (n,).
    fine : bins a unit.

    Returns
    -------
    the median; 0 of no values.
    """
    last = LEVELS * BINS_A_LEVEL - 1
    place = np.empty(len(values), np.int32)
    bins = np.zeros(last + 1, np.int32)
    count = 0
    for k in range(len(values)):
        place[k] = min(int(values[k] * fine), last) if keep[k] > 0 else -1
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
    middle = np.empty(within, values.dtype)
    j = 0
    for k in range(len(values)):
        if first <= place[k] <= second:
            middle[j] = values[k]
            j += 1
    return 0.5 * (_ranked(middle, lower - below) + _ranked(middle, upper - below))


@njit(cache=True, nogil=True)
def _ranked(values: np.ndarray, rank: int) -> float:
    """The value of a rank, counted from 0; what lies in one bin of a histogram is divided again, until few are left."""
    while len(values) > FEW_TO_SORT:
        low, high = values.min(), values.max()
        if low == high:
            return float(low)
        last = LEVELS * BINS_A_LEVEL - 1
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
    """Median ratio of each picture, one level brighter, to a reference.

    Parameters
    ----------
    pictures : shape (n, height, width).
    reference : shape (height, width), above 0.

    Returns
    -------
    shape (n,).
    """
    n, height, width = pictures.shape
    out, ratio, keep = np.empty(n, np.float32), np.empty(height * width, np.float32), np.ones(height * width, np.int8)
    for t in range(n):
        for y in range(height):
            for x in range(width):
                ratio[y * width + x] = (pictures[t, y, x] + np.float32(1.0)) / reference[y, x]
        # A flicker is by tenths: bins of 1/1024.
        out[t] = median(ratio, keep, 64.0 * BINS_A_LEVEL)
    return out


@njit(cache=True, nogil=True, fastmath={"nnan", "nsz"})
def largest_changes(pictures: np.ndarray, count: int) -> np.ndarray:
    """Mean of the largest absolute changes of single pixels from each picture to the next.

    Parameters
    ----------
    pictures : brightness, 0 to 255, shape (n, n_pixels).
    count : number of pixels of which the mean is taken.

    Returns
    -------
    shape (n - 1,).
    """
    n, pixels = pictures.shape
    count = min(count, pixels)
    out, change = np.zeros(n - 1, np.float32), np.empty(pixels, np.float32)
    bins, totals = np.zeros(LEVELS * BINS_A_LEVEL, np.int64), np.zeros(LEVELS * BINS_A_LEVEL)
    limit = np.float32(0.0)
    for t in range(n - 1):
        before, after = pictures[t], pictures[t + 1]
        for k in range(pixels):
            change[k] = abs(after[k] - before[k])
        # Most pixels change less than those that count: only changes near the last picture's smallest are sorted.
        while True:
            bins[:], totals[:] = 0, 0.0
            counted = 0
            for start in range(0, pixels, 16):
                block = change[start : start + 16]
                largest = np.float32(0.0)
                for value in block:
                    largest = max(largest, value)
                if largest < limit:
                    continue
                for value in block:
                    if value >= limit:
                        place = min(int(value * BINS_A_LEVEL), LEVELS * BINS_A_LEVEL - 1)
                        bins[place] += 1
                        totals[place] += value
                        counted += 1
            if counted >= count:
                break
            limit = np.float32(0.0)
        total, taken, place = 0.0, 0, LEVELS * BINS_A_LEVEL - 1
        while taken + bins[place] < count:
            taken += bins[place]
            total += totals[place]
            place -= 1
        total += (count - taken) * totals[place] / max(bins[place], 1)
        out[t] = total / count
        limit = np.float32(0.7 * place / BINS_A_LEVEL)
    return out


@njit(cache=True, nogil=True)
def largest_steps(pictures: np.ndarray, window: int) -> tuple[np.ndarray, np.ndarray]:
    """When the means of the pictures before and after differ most at each pixel, and the power of that difference.

    Parameters
    ----------
    pictures : shape (n, n_pixels).
    window : pictures before and after of which means are taken.

    Returns
    -------
    number of the first picture after the step and the power, each of shape (n_pixels,).
    """
    n, pixels = pictures.shape
    best, when = np.zeros(pixels, np.float32), np.zeros(pixels, np.int_)
    at_once = 512
    sums = np.zeros((n + 1, at_once), np.float32)
    for start in range(0, pixels, at_once):
        stop = min(start + at_once, pixels)
        for t in range(n):
            for k in range(stop - start):
                sums[t + 1, k] = sums[t, k] + pictures[t, start + k]
        for t in range(1, n):
            a, b = min(n, t + window), max(0, t - window)
            after, before = np.float32(a - t), np.float32(t - b)
            factor = np.float32((a - t) * (t - b) / (a - b))
            above, here, under = sums[a], sums[t], sums[b]
            top, place = best[start:stop], when[start:stop]
            for k in range(stop - start):
                step = (above[k] - here[k]) / after - (here[k] - under[k]) / before
                score = factor * step * step
                place[k] = t if score > top[k] else place[k]
                top[k] = max(score, top[k])
    return when, best


@njit(cache=True, nogil=True)
def block_means(luma: np.ndarray, side: int) -> np.ndarray:
    """Pictures shrunk by a whole factor: means of square blocks, rounded to whole grey levels as OpenCV does.

    Parameters
    ----------
    luma : grey levels, shape (n, height, width), height and width multiples of `side`.
    side : of a block, px.

    Returns
    -------
    grey levels, shape (n, height / side, width / side).
    """
    n, height, width = luma.shape
    out = np.empty((n, height // side, width // side), np.float32)
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
            if side == 4:  # the usual one: a number of neighbours that is known is added up many at a time
                for x in range(width // 4):
                    k = 4 * x
                    line[x] = np.rint((total[k] + total[k + 1] + total[k + 2] + total[k + 3]) * weight)
                continue
            for x in range(width // side):
                block = np.int32(0)
                for j in range(side):
                    block += total[x * side + j]
                line[x] = np.rint(block * weight)
    return out


@njit(cache=True, nogil=True)
def fan_gains(
    along: np.ndarray, across: np.ndarray, time: np.ndarray, weight: np.ndarray, bins: int, length: int, n_times: int
) -> np.ndarray:
    """Sum what monotone paths collect in each band of two bins across parallel lines.

    Parameters
    ----------
    along, across : place of each changed pixel along the lines, px, and across in bins, shape (n_pixels,).
    time, weight : when each changes, counted in pictures, and how much, shape (n_pixels,).
    bins : bins across.
    length : of the lines, px; places are 4 px apart.
    n_times : pictures.

    Returns
    -------
    change collected in order, shape (bins − 1,).
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
            # `best` never falls along the line: it rises only where something changes now, and on from there.
            for s in range(min(low[b, t], low[b + 1, t]) + 1, places + 1):
                if s > last and best[s] >= best[s - 1]:
                    break
                best[s] = max(best[s], best[s - 1] + table[b, t, s - 1] + table[b + 1, t, s - 1])
        out[b] = best[-1]
    return out


@njit(cache=True)
def passing_times(table: np.ndarray) -> np.ndarray:
    """Find the monotone path that collects most, and when it passes each place.

    Parameters
    ----------
    table : change by time and place, shape (n_times, n_places).

    Returns
    -------
    time, counted in pictures, shape (n_places,); NaN beyond the ends of the path.
    """
    n, places = table.shape
    best = np.zeros((n, places + 1))
    came = np.zeros((n, places + 1), np.uint8)
    for t in range(n):
        for s in range(places + 1):
            best[t, s] = best[t - 1, s] if t > 0 else 0.0
            if s > 0 and best[t, s - 1] + table[t, s - 1] > best[t, s]:
                best[t, s] = best[t, s - 1] + table[t, s - 1]
                came[t, s] = 1
    passed = np.full(places, np.nan)
    t, s = n - 1, places
    while s > 0 and t >= 0:
        if came[t, s] == 1:
            passed[s - 1] = t
            s -= 1
        elif t > 0:
            t -= 1
        else:
            break
    return passed
