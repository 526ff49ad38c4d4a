"""Compiled loops of the edge tracker, for strips of shape (n_frames, n_across, n_along).

A strip holds the values as the camera wrote them; `scale[t] * value + offset[t]` is the brightness without flicker. An
edge at `y`, blurred by the optics (a Gaussian of standard deviation `blur`) and by motion (a box of `length`), covers
the fraction p(y − s) of the pixel at `s`; see `edge_cover`.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from vinetrack.video.edge_cover import (
    FASTMATH,
    MIN_MOTION_BLUR_PX,
    NO_REFCOUNT,
    coverage_reach,
    coverage_table,
    subpixel_index,
)

COLUMNS_BEHIND = 25  # Columns behind the first passed one that are used (chosen)
COLUMNS_AHEAD = 50  # Columns ahead of the last passed one that are used (chosen)
FILM_CLIP_RATIO = 1.7  # Ratio of the clipped squared distance from film to that from background (chosen)
FILM_BIAS = 0.1  # Evidence in favour of film in every pixel (chosen)


@njit(cache=True, nogil=True, fastmath=FASTMATH, error_model="numpy")
def film_evidence(
    strip: np.ndarray, scale: np.ndarray, offset: np.ndarray, appearance: np.ndarray, width: float, clip: float
) -> np.ndarray:
    """Score each column of each frame: negative where it looks like film, positive where like background. The score is
    the sum over rows of min(a², FILM_CLIP_RATIO clip²) − min(b², clip²), with a and b the distances from film and
    background in standard deviations (`width` and the pixel's own variance). Shapes: appearance (4, n_across, n_along)
    → (n_frames, n_along).
    """
    n, rows, columns = strip.shape
    out = np.zeros((n, columns), np.float32)
    unit, film_bias, extra_variance = np.float32(1.0), np.float32(FILM_BIAS), np.float32(width * width)
    background_clip, film_clip = np.float32(clip * clip), np.float32(FILM_CLIP_RATIO * clip * clip)
    weight = unit / (appearance[2:] + extra_variance)
    for t in range(n):
        gain, level = np.float32(scale[t]), np.float32(offset[t])
        scores = out[t]
        for u in range(rows):
            values, film, background = strip[t, u], appearance[0, u], appearance[1, u]
            film_weight, background_weight = weight[0, u], weight[1, u]
            for s in range(columns):
                value = np.float32(values[s]) * gain + level
                a, b = value - film[s], value - background[s]
                a, b = a * a * film_weight[s], b * b * background_weight[s]
                scores[s] += (
                    (a if a < film_clip else film_clip) - (b if b < background_clip else background_clip) - film_bias
                )
    return out


@njit(cache=True, nogil=True, fastmath=FASTMATH, error_model="numpy")
def fit_edges(
    strip: np.ndarray,
    scale: np.ndarray,
    offset: np.ndarray,
    start: np.ndarray,
    lengths: np.ndarray,
    lag: np.ndarray,
    blur: float,
    appearance: np.ndarray,
    inflation: np.ndarray,
    prior_sd: float,
    margin: float,
    rounds: int,
    shading: np.ndarray,
    frames: np.ndarray,
    rows: tuple[int, int],
) -> np.ndarray:
    """Fit the edge by maximum likelihood (Gauss-Newton), one search after another; shape (n_searches, 6). Columns of
    the result: edge, its standard error from the Fisher information, mean squared weighted residual, amplitude − 1,
    level, number of pixels. Shapes: start, frames (n_searches,); appearance (4, n_across, n_along); inflation
    (n_bins,).
    """
    columns = strip.shape[2]
    out = np.full((len(frames), 6), np.nan)
    max_lag = lag[rows[0] : rows[1]].max()
    half, middle, table_length = 0.0, 0, -1.0
    table, bin_inflation = np.empty((0, 0, 0), np.float32), np.empty(0, np.float32)
    shading32 = shading.astype(np.float32)
    for i in range(len(frames)):
        t, y = frames[i], start[i]
        if not math.isfinite(y):
            continue
        length = max(lengths[t], MIN_MOTION_BLUR_PX)
        if length != table_length:
            table_length = length
            half = coverage_reach(length, blur) + margin
            table = coverage_table(length, blur, half).astype(np.float32)
            middle = math.ceil(half) + 1
            bin_inflation = np.empty(table.shape[2] + 1, np.float32)
            for k in range(len(bin_inflation)):
                bin_inflation[k] = inflation[min(max(len(inflation) // 2 - middle + k - 1, 0), len(inflation) - 1)]
        amplitude, level = 0.0, 0.0
        for _ in range(rounds):
            first = max(0, math.ceil(y - half - max_lag))
            last = min(columns, int(y + half) + 1)
            used, (yy, yg, yl, gg, gl, ll, ry, rg, rl, chi) = _normal_sums(
                strip[t], rows, np.float32(scale[t]), np.float32(offset[t]), appearance, y, lag, half, first, last,
                middle, table, bin_inflation, shading32, np.float32(1 + amplitude), np.float32(level),
            )  # fmt: skip
            yy, gg, ll = yy + 1e-12, gg + prior_sd**-2, ll + prior_sd**-2
            rg, rl = rg - amplitude * prior_sd**-2, rl - level * prior_sd**-2
            # Level and amplitude eliminated from the 3 by 3 normal equations.
            det = gg * ll - gl * gl
            ag, al = (yg * ll - yl * gl) / det, (yl * gg - yg * gl) / det
            info = yy - yg * ag - yl * al
            if info <= 1e-9:
                break
            step = (ry - ag * rg - al * rl) / info
            amplitude += (ll * (rg - yg * step) - gl * (rl - yl * step)) / det
            level += (gg * (rl - yl * step) - gl * (rg - yg * step)) / det
            amplitude, level = min(max(amplitude, -0.7), 1.5), min(max(level, -0.7), 0.7)
            limit = 1.0 + 0.25 * lengths[t]
            y += min(max(step, -limit), limit)
            out[i, 1] = 1 / math.sqrt(info)
            out[i, 2] = chi / max(used, 1.0)
            out[i, 5] = used
            if abs(step) < 1e-3:
                break
        out[i, 0], out[i, 3], out[i, 4] = y, amplitude, level
    return out


@njit(cache=True, nogil=True, fastmath=FASTMATH, error_model="numpy", **NO_REFCOUNT)
def _normal_sums(
    picture: np.ndarray, rows: tuple[int, int], scale: np.float32, offset: np.float32, appearance: np.ndarray, y: float,
    lag: np.ndarray, half: float, first: int, last: int, middle: int, table: np.ndarray, bin_inflation: np.ndarray,
    shading: np.ndarray, gain: np.float32, level: np.float32,
) -> tuple[int, tuple[float, float, float, float, float, float, float, float, float, float]]:  # fmt: skip
    """Number of pixels near the edge, and over them the sums of the normal equations for edge, amplitude and level. The
    last sum is that of squared residuals, weighted. The weights 1/(variance + r²/9), as of Student's t with nine
    degrees of freedom, limit the influence of outliers.
    """
    zero, unit, ninth = np.float32(0.0), np.float32(1.0), np.float32(1 / 9)
    yy = yg = yl = gg = gl = ll = ry = rg = rl = chi = zero
    used = 0
    for u in range(rows[0], rows[1]):
        row_edge = y - lag[u]
        whole_px, j, table_fraction, on_grid = subpixel_index(row_edge)
        a, b = max(first, math.ceil(row_edge - half)), min(last, math.floor(row_edge + half) + 1)
        if b <= a:
            continue
        k, m = a - whole_px + middle, b - a
        low, high = table[0, j, k : k + m], table[0, j + 1, k : k + m]
        low_slope, high_slope = table[1, j, k : k + m], table[1, j + 1, k : k + m]
        inflation = bin_inflation[k + on_grid : k + on_grid + m]
        values, film, background = picture[u, a:b], appearance[0, u, a:b], appearance[1, u, a:b]
        film_variance, background_variance = appearance[2, u, a:b], appearance[3, u, a:b]
        f, fraction, first_bin = (
            np.float32(table_fraction),
            np.float32(row_edge - whole_px),
            a - whole_px + (len(shading) - 1) // 2,
        )
        shade_before, shade_after = (
            shading[first_bin - 1 : first_bin - 1 + m],
            shading[first_bin : first_bin + m],
        )
        for i in range(m):
            p = low[i] + f * (high[i] - low[i])
            slope = low_slope[i] + f * (high_slope[i] - low_slope[i])
            contrast = film[i] - background[i]
            shading_slope = shade_before[i] - shade_after[i]
            excess = np.float32(values[i]) * scale + offset - background[i] - shade_after[i] - fraction * shading_slope
            variance = (p * p * film_variance[i] + (unit - p) * (unit - p) * background_variance[i]) * inflation[i]
            dg = contrast * p
            dy = contrast * gain * slope + shading_slope
            r = excess - gain * dg - contrast * level
            w = unit / (variance + r * r * ninth)
            wy, wg, wl = w * dy, w * dg, w * contrast
            yy += wy * dy
            yg += wy * dg
            yl += wy * contrast
            gg += wg * dg
            gl += wg * contrast
            ll += wl * contrast
            ry += wy * r
            rg += wg * r
            rl += wl * r
            chi += w * r * r
        used += m
    return used, (
        float(yy), float(yg), float(yl), float(gg), float(gl), float(ll), float(ry), float(rg), float(rl), float(chi),
    )  # fmt: skip
