"""Compiled sums over the residuals of the edge fit, from which the shape of the tip and its blur follow.

Sums are returned frame by frame, so that frames may be shared among threads and no result depends on their number.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from vinetrack.video.edge_cover import FASTMATH, NO_REFCOUNT, coverage_reach, coverage_table, subpixel_index

# Largest factor of a product whose logarithm is taken, and number of factors (derived)
LARGEST_FACTOR, FACTORS = 1e9, 32


@njit(cache=True, nogil=True, fastmath=FASTMATH, error_model="numpy")
def distance_sums(
    strip: np.ndarray,
    scale: np.ndarray,
    offset: np.ndarray,
    fit: np.ndarray,
    lengths: np.ndarray,
    lag: np.ndarray,
    blur: float,
    appearance: np.ndarray,
    margin: float,
    frames: np.ndarray,
    shading: np.ndarray,
) -> np.ndarray:
    """Sum the residuals of a fit by distance from the edge, 1 px per bin, edge at the middle bin. The sums are of z² /
    var z, with z = Σ C r / v over the rows of a column (C the contrast, r the residual, v the variance), and of the
    number of terms. Shapes: fit (n_frames, 6); frames (n_used,) → (n_used, n_bins, 2).
    """
    _, rows, columns = strip.shape
    bins = int(2 * (0.5 * max(lengths.max(), 0.0) + 4 * blur + margin + lag.max())) + 5
    centre_bin = bins // 2
    by_distance, pixels = np.zeros((len(frames), bins, 2)), np.empty((2, columns))
    for used in range(len(frames)):
        t = frames[used]
        y = fit[t, 0]
        half, table, middle, first, last = _around_edge(y, lengths[t], lag, blur, margin, columns)
        # Indexed by k, the position in the table, from 1 on: a whole number of pixels behind or ahead of the edge.
        column_sums = np.zeros((2, table.shape[2] + 1))
        for u in range(rows):
            a, k, m, fraction = _residuals_of_row(
                strip[t], u, scale[t], offset[t], appearance, y - lag[u], 1 + fit[t, 3], fit[t, 4], half, first, last,
                middle, table, shading, pixels,
            )  # fmt: skip
            k += 0 if fraction > 0 else 1
            residual, weight = pixels[0, :m], pixels[1, :m]
            film, background = appearance[0, u, a : a + m], appearance[1, u, a : a + m]
            numerators, denominators = column_sums[0, k : k + m], column_sums[1, k : k + m]
            for i in range(m):
                numerators[i] += weight[i] * (film[i] - background[i]) * residual[i]
            for i in range(m):
                denominators[i] += weight[i] * (film[i] - background[i]) * (film[i] - background[i])
        for k in range(column_sums.shape[1]):
            if column_sums[1, k] > 0:
                i = min(max(centre_bin - middle + k - 1, 0), bins - 1)
                by_distance[used, i, 0] += column_sums[0, k] * column_sums[0, k] / column_sums[1, k]
                by_distance[used, i, 1] += 1
    return by_distance


@njit(cache=True, nogil=True, fastmath=FASTMATH, error_model="numpy")
def place_sums(
    strip: np.ndarray,
    scale: np.ndarray,
    offset: np.ndarray,
    fit: np.ndarray,
    lengths: np.ndarray,
    lag: np.ndarray,
    blur: float,
    appearance: np.ndarray,
    margin: float,
    frames: np.ndarray,
    shading: np.ndarray,
) -> np.ndarray:
    """Sum Σ w r and Σ w by distance from the row's own edge, in the bins of `shading`, w the weight and r the residual.
    Shape (n_used, 2, n_distances).
    """
    _, rows, columns = strip.shape
    by_place, pixels = np.zeros((len(frames), 2, len(shading))), np.empty((2, columns))
    for used in range(len(frames)):
        t = frames[used]
        y = fit[t, 0]
        half, table, middle, first, last = _around_edge(y, lengths[t], lag, blur, margin, columns)
        sums = by_place[used]
        for u in range(rows):
            _, k, m, fraction = _residuals_of_row(
                strip[t], u, scale[t], offset[t], appearance, y - lag[u], 1 + fit[t, 3], fit[t, 4], half, first, last,
                middle, table, shading, pixels,
            )  # fmt: skip
            residual, weight = pixels[0, :m], pixels[1, :m]
            # The row's edge lies between two whole columns: each pixel counts in two bins.
            for further in range(2):
                part, d = (fraction if further else 1 - fraction), k - middle + (len(shading) - 1) // 2 - further
                weighted, weights = sums[0, d : d + m], sums[1, d : d + m]
                for i in range(m):
                    weighted[i] += part * weight[i] * residual[i]
                for i in range(m):
                    weights[i] += part * weight[i]
    return by_place


@njit(cache=True, nogil=True, fastmath=FASTMATH, error_model="numpy")
def _around_edge(
    y: float, length: float, lag: np.ndarray, blur: float, margin: float, columns: int
) -> tuple[float, np.ndarray, int, int, int]:
    """Reach of an edge at `y`, its table of coverage and the middle of that, the first column, one behind the last."""
    half = coverage_reach(length, blur) + margin
    table = coverage_table(length, blur, half)
    return half, table, math.ceil(half) + 1, max(0, math.ceil(y - half - lag.max())), min(columns, int(y + half) + 1)


@njit(cache=True, nogil=True, fastmath=FASTMATH, error_model="numpy", **NO_REFCOUNT)
def _residuals_of_row(
    picture: np.ndarray, u: int, scale: float, offset: float, appearance: np.ndarray, row_edge: float, gain: float,
    level: float, half: float, first: int, last: int, middle: int, table: np.ndarray, shading: np.ndarray,
    pixels: np.ndarray,
) -> tuple[int, int, int, float]:  # fmt: skip
    """Write residual and weight of the pixels of a row into the first columns of `pixels`. Their first column in the
    picture and in the table, their number, and the fraction of the row's edge are returned. Each loop writes one array:
    the compiler then proves that none overlaps, and computes several pixels at a time.
    """
    whole_px, j, f, _ = subpixel_index(row_edge)
    a, b = max(first, math.ceil(row_edge - half)), min(last, math.floor(row_edge + half) + 1)
    k, m, fraction = a - whole_px + middle, max(b - a, 0), row_edge - whole_px
    if m == 0:
        return 0, 1, 0, fraction
    low, high = table[0, j, k : k + m], table[0, j + 1, k : k + m]
    values, film, background = picture[u, a:b], appearance[0, u, a:b], appearance[1, u, a:b]
    film_variance, background_variance = appearance[2, u, a:b], appearance[3, u, a:b]
    first_bin = a - whole_px + (len(shading) - 1) // 2
    shade_before, shade_after = shading[first_bin - 1 : first_bin - 1 + m], shading[first_bin : first_bin + m]
    residual, weight = pixels[0, :m], pixels[1, :m]
    for i in range(m):
        p = low[i] + f * (high[i] - low[i])
        r = values[i] * scale + offset - background[i] - (film[i] - background[i]) * (gain * p + level)
        residual[i] = r - shade_after[i] - fraction * (shade_before[i] - shade_after[i])
    for i in range(m):
        p = low[i] + f * (high[i] - low[i])
        v = p * p * film_variance[i] + (1 - p) * (1 - p) * background_variance[i]
        weight[i] = 1 / (v + residual[i] * residual[i] / 9)
    return a, k, m, fraction


@njit(cache=True, nogil=True, fastmath=FASTMATH, error_model="numpy")
def row_sums(
    strip: np.ndarray,
    scale: np.ndarray,
    offset: np.ndarray,
    fit: np.ndarray,
    lengths: np.ndarray,
    lag: np.ndarray,
    blur: float,
    appearance: np.ndarray,
    margin: float,
    frames: np.ndarray,
    shading: np.ndarray,
) -> np.ndarray:
    """Sum Σ g r and Σ g² by row, weighted, with g the derivative of the model with respect to the row's lag. Shape
    (n_used, n_across, 2).
    """
    _, rows, columns = strip.shape
    by_row = np.zeros((len(frames), rows, 2))
    for used in range(len(frames)):
        t = frames[used]
        y = fit[t, 0]
        half, table, middle, first, last = _around_edge(y, lengths[t], lag, blur, margin, columns)
        for u in range(rows):
            by_row[used, u] = _sums_of_row(
                strip[t], u, scale[t], offset[t], appearance, y - lag[u], 1 + fit[t, 3], fit[t, 4], half, first,
                last, middle, table, shading,
            )  # fmt: skip
    return by_row


@njit(cache=True, nogil=True, fastmath=FASTMATH, error_model="numpy", **NO_REFCOUNT)
def _sums_of_row(
    picture: np.ndarray, u: int, scale: float, offset: float, appearance: np.ndarray, row_edge: float, gain: float,
    level: float, half: float, first: int, last: int, middle: int, table: np.ndarray, shading: np.ndarray,
) -> tuple[float, float]:  # fmt: skip
    """Sums of `row_sums` over one row of one frame."""
    whole_px, j, f, _ = subpixel_index(row_edge)
    a, b = max(first, math.ceil(row_edge - half)), min(last, math.floor(row_edge + half) + 1)
    if b <= a:
        return 0.0, 0.0
    k, m = a - whole_px + middle, b - a
    low, high = table[0, j, k : k + m], table[0, j + 1, k : k + m]
    low_slope, high_slope = table[1, j, k : k + m], table[1, j + 1, k : k + m]
    values, film, background = picture[u, a:b], appearance[0, u, a:b], appearance[1, u, a:b]
    film_variance, background_variance = appearance[2, u, a:b], appearance[3, u, a:b]
    fraction, first_bin = row_edge - whole_px, a - whole_px + (len(shading) - 1) // 2
    shade_before, shade_after = shading[first_bin - 1 : first_bin - 1 + m], shading[first_bin : first_bin + m]
    gradient, curvature = 0.0, 0.0
    for i in range(m):
        p = low[i] + f * (high[i] - low[i])
        slope = low_slope[i] + f * (high_slope[i] - low_slope[i])
        contrast = film[i] - background[i]
        r = values[i] * scale + offset - background[i] - contrast * (gain * p + level)
        r -= shade_after[i] + fraction * (shade_before[i] - shade_after[i])
        v = p * p * film_variance[i] + (1 - p) * (1 - p) * background_variance[i]
        w = 1 / (v + r * r / 9)
        g = -contrast * slope
        gradient += w * g * r
        curvature += w * g * g
    return gradient, curvature


@njit(cache=True, nogil=True, fastmath=FASTMATH, error_model="numpy")
def misfit_sums(
    strip: np.ndarray,
    scale: np.ndarray,
    offset: np.ndarray,
    fit: np.ndarray,
    lengths: np.ndarray,
    lag: np.ndarray,
    blur: float,
    appearance: np.ndarray,
    margin: float,
    frames: np.ndarray,
    shading: np.ndarray,
) -> np.ndarray:
    """Sum log(1 + r²/9v̄) over all pixels, v̄ the mean of the variances of film and background, and count the pixels.
    The mean is a robust misfit for comparing blurs. The variance does not depend on the blur: otherwise a wider blur
    would lower its own misfit. Shape (n_used, 2).
    """
    _, rows, columns = strip.shape
    out = np.zeros((len(frames), 2))
    for used in range(len(frames)):
        t = frames[used]
        y = fit[t, 0]
        half, table, middle, first, last = _around_edge(y, lengths[t], lag, blur, margin, columns)
        for u in range(rows):
            logarithms, pixels = _logarithms_of_row(
                strip[t], u, scale[t], offset[t], appearance, y - lag[u], 1 + fit[t, 3], fit[t, 4], half, first,
                last, middle, table, shading,
            )  # fmt: skip
            out[used, 0] += logarithms
            out[used, 1] += pixels
    return out


@njit(cache=True, nogil=True, fastmath=FASTMATH, error_model="numpy", **NO_REFCOUNT)
def _logarithms_of_row(
    picture: np.ndarray, u: int, scale: float, offset: float, appearance: np.ndarray, row_edge: float, gain: float,
    level: float, half: float, first: int, last: int, middle: int, table: np.ndarray, shading: np.ndarray,
) -> tuple[float, int]:  # fmt: skip
    """Sum the logarithms of `misfit_sums` over one row of one frame, and count its pixels."""
    whole_px, j, f, _ = subpixel_index(row_edge)
    begin, end = max(first, math.ceil(row_edge - half)), min(last, math.floor(row_edge + half) + 1)
    if end <= begin:
        return 0.0, 0
    fraction, total = row_edge - whole_px, 0.0
    for a in range(begin, end, FACTORS):
        m = min(FACTORS, end - a)
        k, b, first_bin = a - whole_px + middle, a + m, a - whole_px + (len(shading) - 1) // 2
        low, high = table[0, j, k : k + m], table[0, j + 1, k : k + m]
        values, film, background = picture[u, a:b], appearance[0, u, a:b], appearance[1, u, a:b]
        film_variance, background_variance = appearance[2, u, a:b], appearance[3, u, a:b]
        shade_before, shade_after = shading[first_bin - 1 : first_bin - 1 + m], shading[first_bin : first_bin + m]
        product = 1.0
        for i in range(m):
            p = low[i] + f * (high[i] - low[i])
            r = values[i] * scale + offset - background[i] - (film[i] - background[i]) * (gain * p + level)
            r -= shade_after[i] + fraction * (shade_before[i] - shade_after[i])
            factor = 1 + r * r / (4.5 * (film_variance[i] + background_variance[i]))
            product *= min(factor, LARGEST_FACTOR)
        total += math.log(product)
    return total, end - begin
