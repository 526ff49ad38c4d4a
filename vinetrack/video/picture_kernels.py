"""What lies before and after an edge at every pixel: sums over the frames that show it, and their solution.

Compiled loops over strips of shape (n_frames, n_across, n_along); see `edge_kernels`.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from vinetrack.video.edge_cover import BORROWED, MATHS, PHASES, SHORTEST_PX, VECTOR, cover_reach, cover_table, phase

FORGOTTEN = 4.0
"""Frames further off than this many memories, e⁻⁴ = 2 %, are not read. Chosen for time; at half 14 % of the weight is
left out, at twice time grows."""
PARTIAL = 0.05
"""Weight of a half-covered pixel: what it says of film and background depends on where the edge was thought to be.
Chosen: a pixel seen half covered in 20 frames weighs as one seen bare once. By reasoning: at half or twice the few
pixels never seen bare change."""
COVERED = 0.98
"""Cover from which a pixel counts as film, and below 1 − COVERED as background. Chosen: 2 % of the contrast is less
than the noise. By reasoning: at 1 hardly a pixel is bare; at 0.75 mixtures are taken for film."""
MIXED_BLURS = 2.06
"""Distance from the edge, in optical blurs, from which a pixel is bare or covered. Derived: Φ(2.054) = COVERED."""
FAR_PX = 80
"""Columns beyond all places of the edge that are gathered. Chosen: what is looked at about an edge lies within 60 px of
it. At half the surroundings of the start are cut off; at twice time grows."""
ROWS_AT_ONCE = 8
"""Rows whose sums are gathered together. Chosen for time alone: eleven sums of eight rows of 960 columns are 340 kB."""


@njit(cache=True, nogil=True, fastmath=MATHS, error_model="numpy")
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
    pictures: np.ndarray,
    clip: float,
    shading: np.ndarray,
) -> np.ndarray:
    """Sums for the least squares of (before, after) at every pixel; shape (11, n_across, n_along).

    The edge is over column s from frame `early[s]` to `late[s]`. Background counts before, film after, by a weight
    that falls as exp(−frames / memory_frames): what was seen last before and first after counts most. Half-covered
    pixels count in between, hardly. In the answer: Σwq², Σwqp, Σwp², ΣwqV, ΣwpV (q = 1 − p) of those, then
    weight, sum and sum of squares of V where only background, and where only film, is seen.
    With `clip` > 0 a value that strays from the last solution is weighed down by 1/(1 + (r/clip)²).

    Parameters
    ----------
    strip : values as the camera wrote them, shape (n_frames, n_across, n_along).
    scale, offset : brightness = scale · value + offset, shape (n_frames,).
    edge, lengths : place of the edge and length of its motion blur, shape (n_frames,), px; NaN where unknown.
    lag : by how much each row of the tip lags behind its foremost point, shape (n_across,), px.
    blur : standard deviation of the optical blur, px.
    early, late : first and last frame with the edge over a column, shape (n_along,).
    memory_frames : frames after which weights fall to 1/e.
    pictures : the last solution of `solve`; unused where `clip` is 0.
    clip : grey levels.
    shading : as in `edge_kernels.fit_edges`; taken off what is seen.

    Returns
    -------
    the sums.
    """
    n, rows, columns = strip.shape
    sums = np.zeros((11, rows, columns), np.float32)
    tight = np.float32(1 / (clip * clip) if clip > 0 else 0.0)
    # What is the same for all rows: weights of columns, first and behind the last that counts, covers by distance.
    seen, film = np.zeros((n, columns), np.float32), np.zeros((n, columns), np.float32)
    limits = np.zeros((n, 2), np.int64)
    widest = 0.0
    # Far from where the edge ever is nothing is asked.
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
                if d < FORGOTTEN:
                    seen[t, s] = math.exp(-d)
                    film[t, s] = seen[t, s] if t >= late[s] else 0.0
                    first, last = min(first, s), s + 1
        limits[t, 0], limits[t, 1] = first, last
        if last > first:
            widest = max(widest, cover_reach(max(lengths[t], SHORTEST_PX), blur))
    # Frames of rest share a table: all motion blurs up to SHORTEST_PX are taken for that.
    tables = np.zeros((n, PHASES + 1, 2 * math.ceil(widest) + 4 + VECTOR))
    places, resting = np.empty(n, np.int64), -1
    for t in range(n):
        places[t] = t
        if limits[t, 1] > limits[t, 0]:
            if lengths[t] <= SHORTEST_PX and resting >= 0:
                places[t] = resting
                continue
            table = cover_table(lengths[t], blur, cover_reach(max(lengths[t], SHORTEST_PX), blur))
            tables[t, :, : table.shape[2]] = table[0]
            if lengths[t] <= SHORTEST_PX:
                resting = t
    bright = np.empty(columns, np.float32)
    # A few rows at a time, so that their sums stay near the processor.
    for block in range(0, rows, ROWS_AT_ONCE):
        for t in range(n):
            first, last = limits[t]
            if last <= first:
                continue
            middle = math.ceil(cover_reach(max(lengths[t], SHORTEST_PX), blur)) + 1
            zone = min(math.ceil(0.5 * max(lengths[t], SHORTEST_PX) + MIXED_BLURS * blur) + 1, middle)
            table, bare_weight, film_weight = tables[places[t]], seen[t], film[t]
            gain, level = np.float32(scale[t]), np.float32(offset[t])
            _gather_rows(
                strip[t], block, min(block + ROWS_AT_ONCE, rows), gain, level, edge[t], lag, table, middle, zone, first,
                last, bare_weight, film_weight, early, late, t, pictures, tight, shading, bright, sums,
            )  # fmt: skip
    return sums


@njit(cache=True, nogil=True, fastmath=MATHS, error_model="numpy", **BORROWED)
def _gather_rows(
    picture: np.ndarray, low: int, high: int, gain: np.float32, level: np.float32, edge: float, lag: np.ndarray,
    table: np.ndarray, middle: int, zone: int, first: int, last: int, bare_weight: np.ndarray, film_weight: np.ndarray,
    early: np.ndarray, late: np.ndarray, t: int, pictures: np.ndarray, tight: np.float32,
    shading: np.ndarray, bright: np.ndarray, sums: np.ndarray,
) -> None:  # fmt: skip
    """Add what rows `low` to `high` of one frame show to `sums`; see `gather`."""
    unity = np.float32(1.0)
    for u in range(low, high):
        at = edge - lag[u]
        whole, j, f, _ = phase(at)
        behind = min(max(whole - zone + 1, first), last)
        ahead = min(max(whole + zone + 1, first), last)
        values, levelled = picture[u, first:last], bright[first:last]
        for s in range(last - first):
            levelled[s] = np.float32(values[s]) * gain + level
        centre = (len(shading) - 1) // 2
        fraction = at - whole
        for s in range(max(first, whole - centre + 1), min(last, whole + centre)):
            d = s - whole + centre
            bright[s] -= np.float32(shading[d] + fraction * (shading[d - 1] - shading[d]))
        _count(bright[first:behind], film_weight[first:behind], pictures[0, u, first:behind], tight,
               sums[8, u, first:behind], sums[9, u, first:behind], sums[10, u, first:behind])  # fmt: skip
        _count(bright[ahead:last], bare_weight[ahead:last], pictures[1, u, ahead:last],
               tight, sums[5, u, ahead:last], sums[6, u, ahead:last], sums[7, u, ahead:last])  # fmt: skip
        for s in range(behind, ahead):
            k = s - whole + middle
            p = np.float32(table[j, k] + f * (table[j + 1, k] - table[j, k]))
            q = unity - p
            value = bright[s]
            w = bare_weight[s]
            if p > COVERED:
                w = film_weight[s]
            elif p > 1 - COVERED:
                if t < early[s] or t > late[s]:
                    continue
                w *= np.float32(PARTIAL)
            r = value - pictures[1, u, s] * q - pictures[0, u, s] * p
            w /= unity + r * r * tight
            if q > COVERED:
                sums[5, u, s] += w
                sums[6, u, s] += w * value
                sums[7, u, s] += w * value * value
            elif p > COVERED:
                sums[8, u, s] += w
                sums[9, u, s] += w * value
                sums[10, u, s] += w * value * value
            else:
                sums[0, u, s] += w * q * q
                sums[1, u, s] += w * q * p
                sums[2, u, s] += w * p * p
                sums[3, u, s] += w * q * value
                sums[4, u, s] += w * p * value


@njit(cache=True, nogil=True, fastmath=MATHS, error_model="numpy", **BORROWED)
def _count(
    values: np.ndarray, weight: np.ndarray, picture: np.ndarray, tight: np.float32,
    count: np.ndarray, total: np.ndarray, squares: np.ndarray,
) -> None:  # fmt: skip
    """Add the pixels of a row that are bare, or covered, to their weight, sum and sum of squares."""
    unity = np.float32(1.0)
    for k in range(len(values)):
        value = values[k]
        r = value - picture[k]
        w = weight[k] / (unity + r * r * tight)
        count[k] += w
        total[k] += w * value
        squares[k] += w * value * value


@njit(cache=True, nogil=True, fastmath=MATHS, error_model="numpy")
def solve(sums: np.ndarray, ridge: float, memory: float, fallback: float, noise: float, texture: float) -> np.ndarray:
    """Brightness after and before the edge at every pixel, and the variance about each; shape (4, n_across, n_along).

    A pixel that never shows unity of the two, or whose background changes (a door swings there), takes it from its row:
    film from the columns behind it, background from those ahead, with weights falling as `memory`^distance; its
    variance is then `texture`², a tenth more where it changes.

    Parameters
    ----------
    sums : from `gather`, shape (11, n_across, n_along).
    ridge : weight of the row's guess where a pixel was seen itself, frames.
    memory : factor by which weights of neighbours fall from column to column.
    fallback : brightness where nothing is known.
    noise, texture : standard deviation of a value, and of a pixel about its neighbours, grey levels.

    Returns
    -------
    after, before, variance after, variance before.
    """
    _, rows, columns = sums.shape
    out = np.empty((4, rows, columns), np.float32)
    guess = np.empty(columns)
    unsteady = (1.5 * texture) ** 2
    for u in range(rows):
        total, count, level = 0.0, 0.0, fallback
        for s in range(columns - 1, -1, -1):
            if count > 1e-3:
                level = total / count
            guess[s] = level
            steady = _variance(sums[5, u, s], sums[6, u, s], sums[7, u, s], noise) < unsteady
            total = total * memory + (sums[6, u, s] if steady else 0.0)
            count = count * memory + (sums[5, u, s] if steady else 0.0)
        for s in range(columns - 1, -1, -1):
            if guess[s] != fallback:
                break
            guess[s] = sums[6, u, s] / sums[5, u, s] if sums[5, u, s] > 0 else fallback
        total, count, level = 0.0, 0.0, fallback
        for s in range(columns):
            if count > 1e-3:
                level = total / count
            elif sums[8, u, s] > 0:
                level = sums[9, u, s] / sums[8, u, s]
            total = total * memory + sums[9, u, s]
            count = count * memory + sums[8, u, s]
            # Never seen bare: what a half-covered pixel seems to show would follow any error of the edge.
            bare_variance = _variance(sums[5, u, s], sums[6, u, s], sums[7, u, s], noise)
            bare, film = sums[5, u, s] > 0.1 and bare_variance < unsteady, sums[8, u, s] > 0.1
            qq, qp, pp = sums[0, u, s] + sums[5, u, s], sums[1, u, s], sums[2, u, s] + sums[8, u, s]
            vq, vp = sums[3, u, s] + sums[6, u, s], sums[4, u, s] + sums[9, u, s]
            rq = ridge if bare else 1e4 * (1 + qq)
            rp = ridge if film else 1e4 * (1 + pp)
            qq, pp, vq, vp = qq + rq, pp + rp, vq + rq * guess[s], vp + rp * level
            det = qq * pp - qp * qp
            out[0, u, s] = (vp * qq - vq * qp) / det
            out[1, u, s] = (vq * pp - vp * qp) / det
            out[2, u, s] = _variance(sums[8, u, s], sums[9, u, s], sums[10, u, s], noise) if film else texture**2
            out[3, u, s] = bare_variance if bare else (1.1 if bare_variance >= unsteady else 1.0) * texture**2
    return out


@njit(cache=True, nogil=True, fastmath=MATHS, error_model="numpy")
def _variance(weight: float, total: float, squares: float, noise: float) -> float:
    """Variance of what a pixel showed, never below that of the noise, drawn towards it where few frames speak."""
    if weight <= 0:
        return noise**2
    seen = max(squares / weight - (total / weight) ** 2, 0.0)
    return max((weight * seen + 2 * noise**2) / (weight + 2), noise**2)
