"""Weighted least squares for the brightness of film and background at every pixel.

Compiled loops over strips of shape (n_frames, n_across, n_along): sums over frames, and their solution; see
`edge_kernels`.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from vinetrack.video.edge_cover import (
    FASTMATH,
    MIN_MOTION_BLUR_PX,
    NO_REFCOUNT,
    SUBPIXEL_STEPS,
    coverage_reach,
    coverage_table,
    subpixel_index,
)
from vinetrack.video.threads import in_parts

MEMORY_CUTOFF = 4.0  # Frames further away than this many memories are not read; their weight is e⁻⁴ = 2 % (chosen)
PARTIAL_WEIGHT = 0.05  # Weight of a half-covered pixel (chosen)
# Coverage from which a pixel counts as film, and below 1 − COVERED_FRACTION as background (chosen)
COVERED_FRACTION = 0.98
MIXED_BLURS = 2.06  # Distance from the edge, in optical blurs, from which a pixel is pure film or background (derived)
FAR_PX = 80  # Columns beyond the range of the edge that are gathered (chosen)
ROWS_PER_BLOCK = 8  # Rows processed together, so that their sums stay in the cache (chosen)


def gather(
    strip: np.ndarray,
    scale: np.ndarray,
    offset: np.ndarray,
    edge: np.ndarray,
    lengths: np.ndarray,
    lag: np.ndarray,
    blur: float,
    early: np.ndarray,
    late: np.ndarray,
    memory_frames: float,
    appearance: np.ndarray,
    clip: float,
    shading: np.ndarray,
) -> np.ndarray:
    """Accumulate the sums of the least squares for background and film at every pixel; shape (11, n_across, n_along).
    The edge is over column s from frame `early[s]` to `late[s]`. A pixel counts as background before and as film after,
    with the weight exp(−frames / memory_frames), so that the frames nearest to the passage count most. Shapes: strip
    (n_frames, n_across, n_along); scale, offset, edge, lengths (n_frames,); lag (n_across,); early, late (n_along,).
    """
    _, rows, columns = strip.shape
    sums = np.zeros((11, rows, columns), np.float32)
    weights = _column_weights(columns, edge, early, late, memory_frames)
    tables = _tables(edge, lengths, blur, weights[2])
    clip_weight = np.float32(1 / (clip * clip) if clip > 0 else 0.0)

    def gather_rows(first: int, last: int) -> None:
        _gather_blocks(
            strip, scale, offset, edge, lengths, lag, blur, early, late, appearance, clip_weight, shading, *weights,
            *tables, first, last, sums,
        )  # fmt: skip

    in_parts(gather_rows, rows, ROWS_PER_BLOCK)
    return sums


@njit(cache=True, nogil=True, fastmath=FASTMATH, error_model="numpy")
def _column_weights(
    columns: int, edge: np.ndarray, early: np.ndarray, late: np.ndarray, memory_frames: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Weights of columns for background and for film, and the first column that counts and the one behind the last.
    Shapes (n_frames, n_along) twice and (n_frames, 2); common to all rows.
    """
    n = len(edge)
    bare_weights, film_weights = np.zeros((n, columns), np.float32), np.zeros((n, columns), np.float32)
    limits = np.zeros((n, 2), np.int64)
    # Columns far from every position of the edge are skipped.
    low, high = columns, 0
    for t in range(n):
        if math.isfinite(edge[t]):
            low, high = min(low, int(edge[t]) - FAR_PX), max(high, int(edge[t]) + FAR_PX)
    low, high = max(low, 0), min(high, columns)
    for t in range(n):
        first, last = columns, 0
        if math.isfinite(edge[t]):
            for s in range(low, high):
                d = max(early[s] - t, t - late[s], 0.0) / memory_frames
                if d < MEMORY_CUTOFF:
                    bare_weights[t, s] = math.exp(-d)
                    film_weights[t, s] = bare_weights[t, s] if t >= late[s] else 0.0
                    first, last = min(first, s), s + 1
        limits[t, 0], limits[t, 1] = first, last
    return bare_weights, film_weights, limits


@njit(cache=True, nogil=True, fastmath=FASTMATH, error_model="numpy")
def _tables(edge: np.ndarray, lengths: np.ndarray, blur: float, limits: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Coverage tables, shape (n_frames, SUBPIXEL_STEPS + 1, n_distances), and which of them each frame uses."""
    n = len(edge)
    max_reach = 0.0
    for t in range(n):
        if limits[t, 1] > limits[t, 0]:
            max_reach = max(max_reach, coverage_reach(max(lengths[t], MIN_MOTION_BLUR_PX), blur))
    # Frames at rest (motion blur up to MIN_MOTION_BLUR_PX) share a table.
    tables = np.zeros((n, SUBPIXEL_STEPS + 1, 2 * math.ceil(max_reach) + 4))
    table_index, rest_table = np.empty(n, np.int64), -1
    for t in range(n):
        table_index[t] = t
        if limits[t, 1] > limits[t, 0]:
            if lengths[t] <= MIN_MOTION_BLUR_PX and rest_table >= 0:
                table_index[t] = rest_table
                continue
            table = coverage_table(lengths[t], blur, coverage_reach(max(lengths[t], MIN_MOTION_BLUR_PX), blur))
            tables[t, :, : table.shape[2]] = table[0]
            if lengths[t] <= MIN_MOTION_BLUR_PX:
                rest_table = t
    return tables, table_index


@njit(cache=True, nogil=True, fastmath=FASTMATH, error_model="numpy")
def _gather_blocks(
    strip: np.ndarray, scale: np.ndarray, offset: np.ndarray, edge: np.ndarray, lengths: np.ndarray, lag: np.ndarray,
    blur: float, early: np.ndarray, late: np.ndarray, appearance: np.ndarray, clip_weight: np.float32,
    shading: np.ndarray, bare_weights: np.ndarray, film_weights: np.ndarray, limits: np.ndarray, tables: np.ndarray,
    table_index: np.ndarray, first_row: int, last_row: int, sums: np.ndarray,
) -> None:  # fmt: skip
    """Add rows `first_row` up to `last_row`, that one excluded, to `sums`; see `gather`."""
    n, _, columns = strip.shape
    brightness = np.empty(columns, np.float32)
    # A few rows at a time, so that their sums stay in the cache.
    for block in range(first_row, last_row, ROWS_PER_BLOCK):
        for t in range(n):
            first, last = limits[t]
            if last <= first:
                continue
            middle = math.ceil(coverage_reach(max(lengths[t], MIN_MOTION_BLUR_PX), blur)) + 1
            mixed = min(math.ceil(0.5 * max(lengths[t], MIN_MOTION_BLUR_PX) + MIXED_BLURS * blur) + 1, middle)
            table, bare_weight, film_weight = tables[table_index[t]], bare_weights[t], film_weights[t]
            gain, level = np.float32(scale[t]), np.float32(offset[t])
            _gather_rows(
                strip[t], block, min(block + ROWS_PER_BLOCK, last_row), gain, level, edge[t], lag, table, middle, mixed,
                first, last, bare_weight, film_weight, early, late, t, appearance, clip_weight, shading, brightness,
                sums,
            )  # fmt: skip


@njit(cache=True, nogil=True, fastmath=FASTMATH, error_model="numpy", **NO_REFCOUNT)
def _gather_rows(
    picture: np.ndarray, low: int, high: int, gain: np.float32, level: np.float32, edge: float, lag: np.ndarray,
    table: np.ndarray, middle: int, mixed: int, first: int, last: int, bare_weight: np.ndarray,
    film_weight: np.ndarray, early: np.ndarray, late: np.ndarray, t: int, appearance: np.ndarray,
    clip_weight: np.float32, shading: np.ndarray, brightness: np.ndarray, sums: np.ndarray,
) -> None:  # fmt: skip
    """Add rows `low` to `high` of one frame to `sums`; see `gather`."""
    unit = np.float32(1.0)
    for u in range(low, high):
        row_edge = edge - lag[u]
        whole_px, j, f, _ = subpixel_index(row_edge)
        behind = min(max(whole_px - mixed + 1, first), last)
        ahead = min(max(whole_px + mixed + 1, first), last)
        values, brightness_of = picture[u, first:last], brightness[first:last]
        for s in range(last - first):
            brightness_of[s] = np.float32(values[s]) * gain + level
        centre = (len(shading) - 1) // 2
        fraction = row_edge - whole_px
        for s in range(max(first, whole_px - centre + 1), min(last, whole_px + centre)):
            d = s - whole_px + centre
            brightness[s] -= np.float32(shading[d] + fraction * (shading[d - 1] - shading[d]))
        _add_pure_pixels(brightness[first:behind], film_weight[first:behind], appearance[0, u, first:behind],
               clip_weight, sums[8, u, first:behind], sums[9, u, first:behind], sums[10, u, first:behind])  # fmt: skip
        _add_pure_pixels(brightness[ahead:last], bare_weight[ahead:last], appearance[1, u, ahead:last],
               clip_weight, sums[5, u, ahead:last], sums[6, u, ahead:last], sums[7, u, ahead:last])  # fmt: skip
        for s in range(behind, ahead):
            k = s - whole_px + middle
            p = np.float32(table[j, k] + f * (table[j + 1, k] - table[j, k]))
            q = unit - p
            value = brightness[s]
            w = bare_weight[s]
            if p > COVERED_FRACTION:
                w = film_weight[s]
            elif p > 1 - COVERED_FRACTION:
                if t < early[s] or t > late[s]:
                    continue
                w *= np.float32(PARTIAL_WEIGHT)
            r = value - appearance[1, u, s] * q - appearance[0, u, s] * p
            w /= unit + r * r * clip_weight
            if q > COVERED_FRACTION:
                sums[5, u, s] += w
                sums[6, u, s] += w * value
                sums[7, u, s] += w * value * value
            elif p > COVERED_FRACTION:
                sums[8, u, s] += w
                sums[9, u, s] += w * value
                sums[10, u, s] += w * value * value
            else:
                sums[0, u, s] += w * q * q
                sums[1, u, s] += w * q * p
                sums[2, u, s] += w * p * p
                sums[3, u, s] += w * q * value
                sums[4, u, s] += w * p * value


@njit(cache=True, nogil=True, fastmath=FASTMATH, error_model="numpy", **NO_REFCOUNT)
def _add_pure_pixels(
    values: np.ndarray, weight: np.ndarray, picture: np.ndarray, clip_weight: np.float32,
    count: np.ndarray, total: np.ndarray, squares: np.ndarray,
) -> None:  # fmt: skip
    """Add pixels of pure film, or pure background, to their weight, sum and sum of squares."""
    unit = np.float32(1.0)
    for k in range(len(values)):
        value = values[k]
        r = value - picture[k]
        w = weight[k] / (unit + r * r * clip_weight)
        count[k] += w
        total[k] += w * value
        squares[k] += w * value * value


def solve(sums: np.ndarray, ridge: float, decay: float, fallback: float, noise: float, texture: float) -> np.ndarray:
    """Solve for the brightness of film and background at every pixel, and the variance about each. A pixel at which one
    of the two is never visible, or whose background changes (a door swings there), takes it from its row: film from the
    columns behind it, background from those ahead, with weights that fall as `decay`^distance. Shapes: sums (11,
    n_across, n_along) → (4, n_across, n_along).
    """
    out = np.empty((4, *sums.shape[1:]), np.float32)

    def solve_rows(first: int, last: int) -> None:
        _solve_rows(sums, ridge, decay, fallback, noise, texture, first, last, out)

    in_parts(solve_rows, sums.shape[1], ROWS_PER_BLOCK)
    return out


@njit(cache=True, nogil=True, fastmath=FASTMATH, error_model="numpy")
def _solve_rows(
    sums: np.ndarray, ridge: float, decay: float, fallback: float, noise: float, texture: float, first_row: int,
    last_row: int, out: np.ndarray,
) -> None:  # fmt: skip
    """Solve for rows `first_row` up to `last_row`, that one excluded; see `solve`."""
    columns = sums.shape[2]
    background_guess = np.empty(columns)
    variance_limit = (1.5 * texture) ** 2
    for u in range(first_row, last_row):
        total, count, film_guess = 0.0, 0.0, fallback
        for s in range(columns - 1, -1, -1):
            if count > 1e-3:
                film_guess = total / count
            background_guess[s] = film_guess
            is_steady = _variance(sums[5, u, s], sums[6, u, s], sums[7, u, s], noise) < variance_limit
            total = total * decay + (sums[6, u, s] if is_steady else 0.0)
            count = count * decay + (sums[5, u, s] if is_steady else 0.0)
        for s in range(columns - 1, -1, -1):
            if background_guess[s] != fallback:
                break
            background_guess[s] = sums[6, u, s] / sums[5, u, s] if sums[5, u, s] > 0 else fallback
        total, count, film_guess = 0.0, 0.0, fallback
        for s in range(columns):
            if count > 1e-3:
                film_guess = total / count
            elif sums[8, u, s] > 0:
                film_guess = sums[9, u, s] / sums[8, u, s]
            total = total * decay + sums[9, u, s]
            count = count * decay + sums[8, u, s]
            # Background never fully visible: the estimate from half-covered pixels would follow any error of the edge.
            bare_variance = _variance(sums[5, u, s], sums[6, u, s], sums[7, u, s], noise)
            bare, film = sums[5, u, s] > 0.1 and bare_variance < variance_limit, sums[8, u, s] > 0.1
            qq, qp, pp = sums[0, u, s] + sums[5, u, s], sums[1, u, s], sums[2, u, s] + sums[8, u, s]
            vq, vp = sums[3, u, s] + sums[6, u, s], sums[4, u, s] + sums[9, u, s]
            rq = ridge if bare else 1e4 * (1 + qq)
            rp = ridge if film else 1e4 * (1 + pp)
            qq, pp, vq, vp = qq + rq, pp + rp, vq + rq * background_guess[s], vp + rp * film_guess
            det = qq * pp - qp * qp
            out[0, u, s] = (vp * qq - vq * qp) / det
            out[1, u, s] = (vq * pp - vp * qp) / det
            out[2, u, s] = _variance(sums[8, u, s], sums[9, u, s], sums[10, u, s], noise) if film else texture**2
            out[3, u, s] = bare_variance if bare else (1.1 if bare_variance >= variance_limit else 1.0) * texture**2


@njit(cache=True, nogil=True, fastmath=FASTMATH, error_model="numpy")
def _variance(weight: float, total: float, squares: float, noise: float) -> float:
    """Variance of the values of a pixel, at least that of the noise, shrunk towards it if there are few frames."""
    if weight <= 0:
        return noise**2
    observed = max(squares / weight - (total / weight) ** 2, 0.0)
    return max((weight * observed + 2 * noise**2) / (weight + 2), noise**2)
