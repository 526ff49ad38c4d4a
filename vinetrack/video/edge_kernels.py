"""Compiled loops of the edge tracker, for strips of shape (n_frames, n_across, n_along).

A strip holds the values as the camera wrote them; `scale[t] * value + offset[t]` is the brightness without flicker. An
edge at `y`, blurred by the optics (a Gaussian of standard deviation `blur`) and by motion (a box of `length`), covers
the fraction p(y − s) of the pixel at `s`; see `edge_cover`.
"""

from __future__ import annotations

import math

import numpy as np

from vinetrack.core.process import njit

# ------------------------------------------------------------------------------
# Fraction of each pixel that the film covers, for an edge blurred by optics (Gaussian) and by its own motion (box).
#
# The fraction, called coverage, is tabulated at subpixel steps. Neighbouring columns lie a whole pixel apart, so that
# a row of pixels reads every SUBPIXEL_STEPS-th entry; the table is stored in that order, so that inner loops run
# over neighbours in memory, without a branch.
#
# Functions that other compiled ones call are inlined: each caller would hold a copy of its own, with other last digits,
# and the process that compiles them would run another one than those that load them.

MIN_MOTION_BLUR_PX = 0.02  # Shorter motion blurs are set to this length (derived)
SUBPIXEL_STEPS = 20  # Entries of the coverage table per pixel (derived)
FASTMATH = {"contract", "arcp", "nsz", "reassoc"}  # Floating-point freedom of the compiler (chosen)


@njit(forceinline=True, nogil=True, fastmath=FASTMATH, error_model="numpy")
def _normal(z: float) -> tuple[float, float]:
    """The normal distribution function Φ(z), and its integral zΦ(z) + φ(z)."""
    below = 0.5 * math.erfc(-z / math.sqrt(2))
    return below, z * below + math.exp(-0.5 * z * z) / math.sqrt(2 * math.pi)


@njit(forceinline=True, nogil=True, fastmath=FASTMATH, error_model="numpy")
def coverage_table(length: float, blur: float, half: float) -> np.ndarray:
    """Tabulate the coverage p and its slope dp/dx for one length of motion blur. Entry [j, k] is for x = middle − k +
    j/n, with n = SUBPIXEL_STEPS and middle = ceil(half) + 1. p is the mean of the normal distribution function over a
    box of `length`, from ∫Φ = zΦ(z) + φ(z). Beyond `coverage_reach` it is 0 or 1. Shape (2, n + 1, 2 middle + 2).
    """
    middle = math.ceil(half) + 1
    length = max(length, MIN_MOTION_BLUR_PX)
    reach = coverage_reach(length, blur)
    table = np.zeros((2, SUBPIXEL_STEPS + 1, 2 * middle + 2))
    last = 2 * middle + 1
    # One half is the other one mirrored: p(−x) = 1 − p(x).
    for k in range(middle + 1):
        for j in range(SUBPIXEL_STEPS + 1):
            x = middle - k + j / SUBPIXEL_STEPS
            table[0, j, k] = 1.0
            if x < reach:
                cdf_a, sum_a = _normal((x + length / 2) / blur)
                cdf_b, sum_b = _normal((x - length / 2) / blur)
                table[0, j, k] = (sum_a - sum_b) * blur / length
                table[1, j, k] = (cdf_a - cdf_b) / length
                table[0, SUBPIXEL_STEPS - j, last - k] = 1.0 - table[0, j, k]
                table[1, SUBPIXEL_STEPS - j, last - k] = table[1, j, k]
    return table


@njit(forceinline=True, nogil=True, fastmath=FASTMATH, error_model="numpy")
def coverage_reach(length: float, blur: float) -> float:
    """Return the distance from an edge beyond which a pixel is fully covered or fully uncovered."""
    return 0.5 * length + 4 * blur + 0.5


@njit(forceinline=True, nogil=True, fastmath=FASTMATH, error_model="numpy")
def subpixel_index(place: float) -> tuple[int, int, float]:
    """Whole part of the position of an edge, px; entry j of a coverage table below the rest; weight of entry j + 1."""
    whole = math.floor(place)
    fraction = (place - whole) * SUBPIXEL_STEPS
    j = min(int(fraction), SUBPIXEL_STEPS - 1)
    return int(whole), j, fraction - j


BANDS = 6  # Bands of rows from whose scatter the error of an edge is taken; 4 to 20 do as well (measured)
CLIP = 2.5  # Standard deviations at which the difference from film or background is clipped (chosen)
FILM_BIAS = 0.1  # Evidence in favour of film in every pixel (chosen)


@njit(nogil=True, fastmath=FASTMATH, error_model="numpy")
def film_evidence(
    strip: np.ndarray, scale: np.ndarray, offset: np.ndarray, appearance: np.ndarray, width: float
) -> np.ndarray:
    """Score each column of each frame: negative where it looks like film, positive where like background. The score is
    the sum over rows of min(a², 1.7 CLIP²) − min(b², CLIP²) − FILM_BIAS, with a and b the distances from film and
    background in standard deviations (`width` and the pixel's own variance). Shape (n_frames, n_along).
    """
    n, rows, columns = strip.shape
    out = np.zeros((n, columns), np.float32)
    unit, film_bias, extra_variance = np.float32(1.0), np.float32(FILM_BIAS), np.float32(width * width)
    background_clip, film_clip = np.float32(CLIP**2), np.float32(1.7 * CLIP**2)  # 1.7: film may look odder (chosen)
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


@njit(nogil=True, fastmath=FASTMATH, error_model="numpy")
def votes(
    strip: np.ndarray, scale: np.ndarray, offset: np.ndarray, first: np.ndarray, last: np.ndarray, weight: np.ndarray
) -> np.ndarray:
    """Weighted sum over rows of a pixel's distance from the `last` picture less that from the `first`, and sum of the
    squares of the latter, by column. Shapes: first, last, weight (n_across, n_along) → (2, n_frames, n_along).
    """
    n, rows, columns = strip.shape
    out = np.zeros((2, n, columns), np.float32)
    for t in range(n):
        gain, level, scores, squares = np.float32(scale[t]), np.float32(offset[t]), out[0, t], out[1, t]
        for u in range(rows):
            values, begin, end, share = strip[t, u], first[u], last[u], weight[u]
            for s in range(columns):
                value = np.float32(values[s]) * gain + level
                change = value - begin[s]
                scores[s] += (abs(value - end[s]) - abs(change)) * share[s]
                squares[s] += change * change
    return out


@njit(nogil=True, fastmath=FASTMATH, error_model="numpy")
def fit_edges(
    strip: np.ndarray, scale: np.ndarray, offset: np.ndarray, start: np.ndarray, lengths: np.ndarray, lag: np.ndarray,
    blur: float, appearance: np.ndarray, prior_sd: float, margin: float, rounds: int,
    shading: np.ndarray, frames: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Fit the edge by maximum likelihood (Gauss-Newton), one search after another; shape (n_searches, 5). Columns of
    the result: edge, its standard error, mean squared weighted residual, amplitude − 1, level. The standard error is
    that of a sandwich (Huber 1967): the scatter of what the residuals of bands of rows would move the edge by,
    whatever made them. Shapes: start, frames (n_searches,); appearance (4, n_across, n_along).
    """
    columns, bands = strip.shape[2], np.zeros((min(BANDS, strip.shape[1]), 3))
    out = np.full((len(frames), 5), np.nan)
    max_lag = lag.max()
    half, middle, table_length = 0.0, 0, -1.0
    table, shading32 = np.empty((0, 0, 0), np.float32), shading.astype(np.float32)
    for i in range(len(frames)):
        t, y = frames[i], start[i]
        length = max(lengths[t], MIN_MOTION_BLUR_PX)
        if length != table_length:
            table_length = length
            half = coverage_reach(length, blur) + margin
            table = coverage_table(length, blur, half).astype(np.float32)
            middle = math.ceil(half) + 1
        amplitude, level = 0.0, 0.0
        for _ in range(rounds):
            first = max(0, math.ceil(y - half - max_lag))
            last = min(columns, int(y + half) + 1)
            used, (yy, yg, yl, gg, gl, ll, ry, rg, rl, chi, less) = _normal_sums(
                strip[t], np.float32(scale[t]), np.float32(offset[t]), appearance, y, lag, half, first, last,
                middle, table, shading32, np.float32(1 + amplitude), np.float32(level), bands,
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
            moved = 0.0
            for band in range(len(bands)):
                moved += (bands[band, 0] - ag * bands[band, 1] - al * bands[band, 2]) ** 2
            # 0.3: least curvature of ln L, as a part of that without outliers (chosen)
            curvature = info * max(1 - less / yy, 0.3)
            out[i, 1] = math.sqrt(moved * len(bands) / max(len(bands) - 1, 1)) / curvature
            out[i, 2] = chi / max(used, 1.0)
            if abs(step) < 1e-3:
                break
        out[i, 0], out[i, 3], out[i, 4] = y, amplitude, level
    return out


# _nrt: numba need not count references in a function that allocates nothing (measured).
@njit(forceinline=True, nogil=True, fastmath=FASTMATH, error_model="numpy", _nrt=False)
def _normal_sums(
    picture: np.ndarray, scale: np.float32, offset: np.float32, appearance: np.ndarray, y: float, lag: np.ndarray,
    half: float, first: int, last: int, middle: int, table: np.ndarray, shading: np.ndarray, gain: np.float32,
    level: np.float32, bands: np.ndarray,
) -> tuple[int, tuple[float, float, float, float, float, float, float, float, float, float, float]]:  # fmt: skip
    """Number of pixels near the edge, and over them the sums of the normal equations for edge, amplitude and level; of
    squared residuals, weighted; and what these take from the curvature of ln L. The weights 1/(variance + r²/9), as of
    Student's t with nine degrees of freedom, limit the influence of outliers; the shading of the tip, one for all rows,
    is known to a third of itself. `bands`, shape (n_bands, 3), takes the sums with the residuals of each band of rows.
    """
    zero, unit, ninth = np.float32(0.0), np.float32(1.0), np.float32(1 / 9)
    yy = yg = yl = gg = gl = ll = ry = rg = rl = chi = less = zero
    used = 0
    bands[:] = 0.0
    for u in range(len(picture)):
        row_edge = y - lag[u]
        whole_px, j, table_fraction = subpixel_index(row_edge)
        a, b = max(first, math.ceil(row_edge - half)), min(last, math.floor(row_edge + half) + 1)
        if b <= a:
            continue
        k, m = a - whole_px + middle, b - a
        low, high = table[0, j, k : k + m], table[0, j + 1, k : k + m]
        low_slope, high_slope = table[1, j, k : k + m], table[1, j + 1, k : k + m]
        values, film, background = picture[u, a:b], appearance[0, u, a:b], appearance[1, u, a:b]
        film_variance, background_variance = appearance[2, u, a:b], appearance[3, u, a:b]
        f, fraction = np.float32(table_fraction), np.float32(row_edge - whole_px)
        first_bin = a - whole_px + (len(shading) - 1) // 2
        shade_before, shade_after = shading[first_bin - 1 : first_bin - 1 + m], shading[first_bin : first_bin + m]
        above_y, above_g, above_l = ry, rg, rl
        for i in range(m):
            p = low[i] + f * (high[i] - low[i])
            slope = low_slope[i] + f * (high_slope[i] - low_slope[i])
            contrast = film[i] - background[i]
            shading_slope = shade_before[i] - shade_after[i]
            shade = shade_after[i] + fraction * shading_slope
            excess = np.float32(values[i]) * scale + offset - background[i] - shade
            variance = p * p * film_variance[i] + (unit - p) * (unit - p) * background_variance[i]
            dg = contrast * p
            dy = contrast * gain * slope + shading_slope
            r = excess - gain * dg - contrast * level
            w = unit / (variance + (r * r + shade * shade) * ninth)
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
            less += wy * dy * w * r * r
        band = u * len(bands) // len(picture)
        bands[band, 0] += ry - above_y
        bands[band, 1] += rg - above_g
        bands[band, 2] += rl - above_l
        used += m
    return used, (
        float(yy), float(yg), float(yl), float(gg), float(gl), float(ll), float(ry), float(rg), float(rl), float(chi),
        2 / 9 * float(less),
    )  # fmt: skip


# ------------------------------------------------------------------------------
# Brightness of film and background at every pixel: weighted means over the frames in which it is wholly the one or the
# other. A pixel that the edge is passing tells of neither.

MEMORY_CUTOFF = 4.0  # Frames further away than this many memories are not read; their weight is e⁻⁴ = 2 % (chosen)
ROWS_PER_BLOCK = 8  # Rows processed together, so that their sums stay in the cache (chosen)


@njit(nogil=True, fastmath=FASTMATH, error_model="numpy")
def gather(
    strip: np.ndarray, scale: np.ndarray, offset: np.ndarray, edge: np.ndarray, reach: np.ndarray, lag: np.ndarray,
    early: np.ndarray, late: np.ndarray, memory_frames: float, appearance: np.ndarray, clip: float, shading: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Sum weight, value and its square over the frames in which a pixel is film, and in which it is background; shape
    (2, 3, n_across, n_along). It is film further than `reach` behind the edge, background as far ahead of it. The edge
    is over column s from frame `early[s]` to `late[s]`: the weight is exp(−frames / memory_frames), so that the frames
    nearest to the passage count most, and film counts from `late` on. Shapes: strip (n_frames, n_across, n_along);
    scale, offset, edge, reach (n_frames,); lag (n_across,); early, late (n_along,).
    """
    n, rows, columns = strip.shape
    sums = np.zeros((2, 3, rows, columns), np.float32)
    weights, limits = np.zeros((2, n, columns), np.float32), np.zeros((n, 2), np.int64)
    for t in range(n):
        limits[t, 0] = columns
        for s in range(columns):
            away = max(early[s] - t, t - late[s], 0.0) / memory_frames
            if away < MEMORY_CUTOFF:
                limits[t, 0], limits[t, 1] = min(limits[t, 0], s), s + 1
                weights[1, t, s] = math.exp(-away)
                weights[0, t, s] = weights[1, t, s] if t >= late[s] else 0.0
    centre, unit = (len(shading) - 1) // 2, np.float32(1.0)
    clip_weight = np.float32(1 / (clip * clip) if clip > 0 else 0.0)
    brightness = np.empty(columns, np.float32)
    for block in range(0, rows, ROWS_PER_BLOCK):
        for t in range(n):
            first, last = limits[t]
            gain, level = np.float32(scale[t]), np.float32(offset[t])
            for u in range(block, min(block + ROWS_PER_BLOCK, rows) if first < last else block):
                row_edge = edge[t] - lag[u]
                behind = min(max(math.ceil(row_edge - reach[t]), first), last)
                ahead = min(max(math.floor(row_edge + reach[t]) + 1, first), last)
                for s in range(first, last):
                    brightness[s] = np.float32(strip[t, u, s]) * gain + level
                whole_px = math.floor(row_edge)
                fraction = row_edge - whole_px
                for s in range(max(first, whole_px - centre + 1), min(last, whole_px + centre)):
                    d = s - whole_px + centre
                    brightness[s] -= np.float32(shading[d] + fraction * (shading[d - 1] - shading[d]))
                for part in range(2):
                    a, b = (first, behind) if part == 0 else (ahead, last)
                    values, weight, picture = brightness[a:b], weights[part, t, a:b], appearance[part, u, a:b]
                    count, total, squares = sums[part, 0, u, a:b], sums[part, 1, u, a:b], sums[part, 2, u, a:b]
                    for i in range(b - a):
                        r = values[i] - picture[i]
                        w = weight[i] / (unit + r * r * clip_weight)
                        count[i] += w
                        total[i] += w * values[i]
                        squares[i] += w * values[i] * values[i]
    return sums


@njit(nogil=True, fastmath=FASTMATH, error_model="numpy")
def solve(sums: np.ndarray, ridge: float, decay: float, fallback: float, noise: float, texture: float) -> np.ndarray:
    """Brightness of film and background at every pixel, and the variance about each. A pixel at which one of the two is
    never visible, or whose background changes (a door swings there), takes it from its row: film from the columns
    behind it, background from those ahead, with weights that fall as `decay`^distance. Shapes: sums (2, 3, n_across,
    n_along) → (4, n_across, n_along).
    """
    rows, columns = sums.shape[2:]
    out = np.empty((4, rows, columns), np.float32)
    variance_limit = (1.5 * texture) ** 2
    for part in range(2):
        for u in range(rows):
            neighbours, weight, guess = 0.0, 0.0, fallback
            for k in range(columns):
                s = k if part == 0 else columns - 1 - k
                count, total, squares = sums[part, 0, u, s], sums[part, 1, u, s], sums[part, 2, u, s]
                variance = noise**2
                if count > 0:
                    # Shrunk towards the noise if there are few frames
                    observed = max(squares / count - (total / count) ** 2, 0.0)
                    variance = max((count * observed + 2 * noise**2) / (count + 2), noise**2)
                changes = part == 1 and variance >= variance_limit
                if weight > 1e-3:
                    guess = neighbours / weight
                elif count > 0:
                    guess = total / count
                known = count > 0.1 and not changes
                out[part, u, s] = (total + ridge * guess) / (count + ridge) if known else guess
                out[2 + part, u, s] = variance if known else (1.1 if changes else 1.0) * texture**2
                neighbours = neighbours * decay + (0.0 if changes else total)
                weight = weight * decay + (0.0 if changes else count)
    return out


# ------------------------------------------------------------------------------
# What an edge fit leaves, from which the shape of the tip, its light and shade, its blur and the noise follow.


@njit(nogil=True, fastmath=FASTMATH, error_model="numpy")
def residual_sums(
    strip: np.ndarray, scale: np.ndarray, offset: np.ndarray, fit: np.ndarray, lengths: np.ndarray, lag: np.ndarray,
    blur: float, appearance: np.ndarray, margin: float, frames: np.ndarray, shading: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, float]:  # fmt: skip
    """Sums over the pixels about the edge of what a fit leaves, r, with the weights w of the fit. Of each row, w r d
    and w d², with d the derivative of the model by the row's lag, shape (2, n_across); at each distance ahead of the
    row's own edge, in the bins of `shading`, w r and w, (2, n_distances): a pixel counts in the two bins between which
    it lies; and the mean of log(1 + r²/9v), v the mean of both variances. Shapes: fit (n_frames, 5); frames (n_used,).
    """
    _, rows, columns = strip.shape
    of_rows, of_distances, total, count = np.zeros((2, rows)), np.zeros((2, len(shading))), 0.0, 0
    unit, ninth, shading32 = np.float32(1.0), np.float32(1 / 9), shading.astype(np.float32)
    weight, weighted, factors = np.empty((3, columns), np.float32)
    for t in frames:
        y, length = fit[t, 0], lengths[t]
        gain, shift, factor, dark = np.float32(1 + fit[t, 3]), np.float32(fit[t, 4]), scale[t], offset[t]
        half = coverage_reach(length, blur) + margin
        table, middle = coverage_table(length, blur, half).astype(np.float32), math.ceil(half) + 1
        first, last = max(0, math.ceil(y - half - lag.max())), min(columns, int(y + half) + 1)
        for u in range(rows):
            row_edge = y - lag[u]
            whole_px, j, table_fraction = subpixel_index(row_edge)
            a, b = max(first, math.ceil(row_edge - half)), min(last, math.floor(row_edge + half) + 1)
            if b <= a:
                continue
            k, m, d = a - whole_px + middle, b - a, a - whole_px + (len(shading) - 1) // 2
            f, fraction = np.float32(table_fraction), np.float32(row_edge - whole_px)
            low, high = table[0, j, k : k + m], table[0, j + 1, k : k + m]
            low_slope, high_slope = table[1, j, k : k + m], table[1, j + 1, k : k + m]
            values, film, background = strip[t, u, a:b], appearance[0, u, a:b], appearance[1, u, a:b]
            film_variance, background_variance = appearance[2, u, a:b], appearance[3, u, a:b]
            shade_before, shade_after = shading32[d - 1 : d - 1 + m], shading32[d : d + m]
            by_slope = known = np.float32(0.0)
            for i in range(m):
                p, contrast = low[i] + f * (high[i] - low[i]), film[i] - background[i]
                modelled = background[i] + contrast * (gain * p + shift)
                modelled += shade_after[i] + fraction * (shade_before[i] - shade_after[i])
                r = np.float32(values[i]) * np.float32(factor) + np.float32(dark) - modelled
                variance = p * p * film_variance[i] + (unit - p) * (unit - p) * background_variance[i]
                w = unit / (variance + r * r * ninth)
                slope = -contrast * (low_slope[i] + f * (high_slope[i] - low_slope[i]))
                by_slope += w * r * slope
                known += w * slope * slope
                weight[i], weighted[i] = w, w * r
                factors[i] = unit + np.float32(2.0) * ninth * r * r / (film_variance[i] + background_variance[i])
            of_rows[0, u] += by_slope
            of_rows[1, u] += known
            for share, at in ((unit - fraction, d), (fraction, d - 1)):
                residual_here, weight_here = of_distances[0, at : at + m], of_distances[1, at : at + m]
                for i in range(m):
                    residual_here[i] += share * weighted[i]
                    weight_here[i] += share * weight[i]
            count += m
            product = 1.0
            for i in range(m):  # one logarithm for many pixels
                product *= factors[i]
                if product > 1e200:
                    total += math.log(product)
                    product = 1.0
            total += math.log(product)
    return of_rows, of_distances, total / max(count, 1)
