"""Compiled loops of the edge tracker, over strips of shape (n_frames, n_across, n_along).

A strip is kept as the camera wrote it; `scale[t] * value + offset[t]` is its brightness freed of flicker. An edge
`y` blurred by optics (Gaussian of width `blur`) and by motion (a box of `length`) covers the pixel at `s` by
p(y − s), see `edge_cover`.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from vinetrack.video.edge_cover import BORROWED, MATHS, SHORTEST_PX, VECTOR, cover_reach, cover_table, phase

BEHIND = 25
"""Columns behind the first passed one whose film is looked at: neighbours that stand in where it is never seen.
Chosen: nearly two lengths of MEMORY in `edge_state`. Half or twice changes only film that is never seen."""
BEYOND = 50
"""Columns ahead of the last passed one that are looked at. Chosen: no front lies there. Half or twice changes only
time."""
FOREIGN = 1.7
"""How much farther than background film is from what resembles neither. Chosen above 1, so that what resembles neither
hides background. By reasoning: nearer 1 a payload counts as film, farther a stain on the film does as background."""
FILM_BIAS = 0.1
"""By how much a pixel that could be either is called film: one that never changed was film from the start. Chosen
small beside the clip of 6: only pixels without contrast are decided by it."""


@njit(cache=True, nogil=True, fastmath=MATHS, error_model="numpy")
def film_evidence(
    strip: np.ndarray, scale: np.ndarray, offset: np.ndarray, pictures: np.ndarray, width: float, clip: float
) -> np.ndarray:
    """How much less like film than like background each column looks in each frame; shape (n_frames, n_along).

    The sum over rows of min(a², FOREIGN clip²) − min(b², clip²), a and b the distances from film and background in
    units of `width` and their own variances. A pixel like neither (door, payload) rather hides background: what film
    looks like is known from the frames after, what may come before the background is not.

    Parameters
    ----------
    strip, scale, offset : as in `gather`.
    pictures : from `solve`, shape (4, n_across, n_along).
    width : further standard deviation of a pixel, grey levels.
    clip : widths beyond which a difference counts no more.

    Returns
    -------
    negative where a column looks like film.
    """
    n, rows, columns = strip.shape
    out = np.zeros((n, columns), np.float32)
    unity, bias, wide = np.float32(1.0), np.float32(FILM_BIAS), np.float32(width * width)
    top, far = np.float32(clip * clip), np.float32(FOREIGN * clip * clip)
    weight = unity / (pictures[2:] + wide)
    for t in range(n):
        gain, level = np.float32(scale[t]), np.float32(offset[t])
        line = out[t]
        for u in range(rows):
            values, after, before = strip[t, u], pictures[0, u], pictures[1, u]
            after_weight, before_weight = weight[0, u], weight[1, u]
            for s in range(columns):
                value = np.float32(values[s]) * gain + level
                a, b = value - after[s], value - before[s]
                a, b = a * a * after_weight[s], b * b * before_weight[s]
                line[s] += (a if a < far else far) - (b if b < top else top) - bias
    return out


@njit(cache=True, nogil=True, fastmath=MATHS, error_model="numpy")
def fit_edges(
    strip: np.ndarray,
    scale: np.ndarray,
    offset: np.ndarray,
    start: np.ndarray,
    lengths: np.ndarray,
    lag: np.ndarray,
    blur: float,
    pictures: np.ndarray,
    inflation: np.ndarray,
    prior_sd: float,
    margin: float,
    rounds: int,
    shading: np.ndarray,
    frames: np.ndarray,
) -> np.ndarray:
    """Most likely edge by Gauss-Newton, of one search after another; shape (n_searches, 6).

    Columns: edge, its Fisher sigma, mean squared weighted residual, amplitude − 1, level, pixels used. Amplitude and
    level of the contrast are free within `prior_sd`. `inflation[i]` multiplies the variance of pixels i − len/2 px
    ahead of the edge: how far their noise adds up.

    Parameters
    ----------
    strip, scale, offset, lengths, lag, blur : as in `gather`.
    start : where each search begins, shape (n_searches,), px.
    pictures : from `solve`, shape (4, n_across, n_along).
    inflation : shape (n_bins,), about its middle.
    prior_sd : standard deviation of relative amplitude and level.
    margin : pixels beyond the blurred edge that take part.
    rounds : steps at most.
    shading : brightness of the tip beyond that of film and background, by distance ahead of the edge, 1 px apart about
        its middle, shape (n_distances,); VECTOR + 4 px wider than what takes part, grey levels.
    frames : frame of each search, shape (n_searches,).

    Returns
    -------
    a row a search, NaN where it has no start.
    """
    _, rows, columns = strip.shape
    out = np.full((len(frames), 6), np.nan)
    deepest = lag.max()
    longest = 0.0
    for t in frames:
        longest = max(longest, lengths[t])
    most = rows * (2 * math.ceil(cover_reach(longest, blur) + margin) + 4) + VECTOR
    covers, slopes, steps = np.empty(most, np.float32), np.empty(most, np.float32), np.empty(most, np.float32)
    left, variances, falls = np.empty(most, np.float32), np.empty(most, np.float32), np.empty(most, np.float32)
    half, middle, tabled = 0.0, 0, -1.0
    table, wider = np.empty((0, 0, 0), np.float32), np.empty(0, np.float32)
    shade = shading.astype(np.float32)
    for i in range(len(frames)):
        t, y = frames[i], start[i]
        if not math.isfinite(y):
            continue
        length = max(lengths[t], SHORTEST_PX)
        if length != tabled:
            tabled = length
            half = cover_reach(length, blur) + margin
            table = cover_table(length, blur, half).astype(np.float32)
            middle = math.ceil(half) + 1
            wider = np.empty(table.shape[2] + 1, np.float32)
            for k in range(len(wider)):
                wider[k] = inflation[min(max(len(inflation) // 2 - middle + k - 1, 0), len(inflation) - 1)]
        amplitude, level = 0.0, 0.0
        for _ in range(rounds):
            first = max(0, math.ceil(y - half - deepest))
            last = min(columns, int(y + half) + 1)
            # All rows of pixels behind one another first: sums over them are then one long loop.
            used = _line_up(
                strip[t], np.float32(scale[t]), np.float32(offset[t]), pictures, y, lag, half, first, last, middle,
                table, wider, shade, covers, slopes, steps, left, variances, falls,
            )  # fmt: skip
            sums = _normal_sums(
                covers[:used], slopes[:used], steps[:used], left[:used], variances[:used], falls[:used],
                np.float32(1 + amplitude), np.float32(level),
            )  # fmt: skip
            yy, yg, yl, gg, gl, ll, ry, rg, rl, chi = sums
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


@njit(cache=True, nogil=True, fastmath=MATHS, error_model="numpy", **BORROWED)
def _normal_sums(
    covers: np.ndarray, slopes: np.ndarray, steps: np.ndarray, left: np.ndarray, variances: np.ndarray,
    falls: np.ndarray, strength: np.float32, level: np.float32,
) -> tuple[float, float, float, float, float, float, float, float, float, float]:  # fmt: skip
    """Sums of the normal equations for place, amplitude and level, and the weighted square of the residuals.

    In single precision, sixteen pixels at a time: a relative error of 1e-6 is far below that of a place.
    """
    nothing, unity, ninth = np.float32(0.0), np.float32(1.0), np.float32(1 / 9)
    yy = yg = yl = gg = gl = ll = ry = rg = rl = chi = nothing
    for k in range(len(covers)):
        contrast = steps[k]
        dg = contrast * covers[k]
        dy = contrast * strength * slopes[k] + falls[k]
        r = left[k] - strength * dg - contrast * level
        w = unity / (variances[k] + r * r * ninth)
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
    return (
        float(yy), float(yg), float(yl), float(gg), float(gl), float(ll), float(ry), float(rg), float(rl), float(chi),
    )  # fmt: skip


@njit(cache=True, nogil=True, fastmath=MATHS, error_model="numpy", **BORROWED)
def _line_up(
    picture: np.ndarray, gain: np.float32, level: np.float32, pictures: np.ndarray, y: float, lag: np.ndarray,
    half: float, first: int, last: int, middle: int, table: np.ndarray, wider: np.ndarray, shading: np.ndarray,
    covers: np.ndarray, slopes: np.ndarray, steps: np.ndarray, left: np.ndarray, variances: np.ndarray,
    falls: np.ndarray,
) -> int:  # fmt: skip
    """What each pixel about an edge at `y` says, row behind row, into the last six arrays; how many there are."""
    columns, unity = picture.shape[1], np.float32(1.0)
    used = 0
    for u in range(picture.shape[0]):
        at = y - lag[u]
        whole, j, part, even = phase(at)
        a, b = max(first, math.ceil(at - half)), min(last, math.floor(at + half) + 1)
        if b <= a:
            continue
        k, m = a - whole + middle, b - a
        # Whole vectors; what is too much of the last one is overwritten by the next row, or not looked at.
        full = m + (-m) % VECTOR if b + VECTOR <= columns else m
        b, to = a + full, used + full
        low, high = table[0, j, k : k + full], table[0, j + 1, k : k + full]
        low_slope, high_slope = table[1, j, k : k + full], table[1, j + 1, k : k + full]
        factor = wider[k + even : k + even + full]
        values, after, before = picture[u, a:b], pictures[0, u, a:b], pictures[1, u, a:b]
        after_variance, before_variance = pictures[2, u, a:b], pictures[3, u, a:b]
        cover, slope, step_of = covers[used:to], slopes[used:to], steps[used:to]
        rest_of, variance_of, fall_of = left[used:to], variances[used:to], falls[used:to]
        f, fraction, shaded = np.float32(part), np.float32(at - whole), a - whole + (len(shading) - 1) // 2
        shade_before, shade_after = shading[shaded - 1 : shaded - 1 + full], shading[shaded : shaded + full]
        for i in range(full):
            p = low[i] + f * (high[i] - low[i])
            cover[i] = p
            slope[i] = low_slope[i] + f * (high_slope[i] - low_slope[i])
            step_of[i] = after[i] - before[i]
            fall_of[i] = shade_before[i] - shade_after[i]
            rest_of[i] = np.float32(values[i]) * gain + level - before[i] - shade_after[i] - fraction * fall_of[i]
            variance_of[i] = (p * p * after_variance[i] + (unity - p) * (unity - p) * before_variance[i]) * factor[i]
        used += m
    return used


@njit(cache=True, nogil=True, fastmath=MATHS, error_model="numpy")
def residual_sums(
    strip: np.ndarray,
    scale: np.ndarray,
    offset: np.ndarray,
    fit: np.ndarray,
    lengths: np.ndarray,
    lag: np.ndarray,
    blur: float,
    pictures: np.ndarray,
    margin: float,
    use: np.ndarray,
    shading: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, float, np.ndarray]:
    """What the fit leaves: by distance ahead of the edge, by row, and in all.

    First answer: shape (n, 2), bins of 1 px about the middle: the sum over frames of z² / var z, z = Σ C r / v over
    all rows of a column, and the count: 1 on average for white noise, more where noise adds up across
    neighbours (grain of the film, its tail moving inside). Second: shape (n_across, 2), Σ g r and Σ g² with g the
    slope of the model in the row's own lag. Third: the mean of log(1 + r²/9v̄), v̄ the mean
    of the two variances: a robust misfit for comparing blurs. Fourth: shape (n_distances, 2), Σ w r and Σ w by
    distance ahead of the row's own edge, places as those of `shading`.

    Parameters
    ----------
    strip, scale, offset, lengths, lag, blur, pictures, margin, shading : as in `fit_edges`.
    fit : from `fit_edges`, shape (n_frames, 6).
    use : mask of frames, shape (n_frames,).

    Returns
    -------
    four sums, as above.
    """
    n, rows, columns = strip.shape
    bins = int(2 * (0.5 * max(lengths.max(), 0.0) + 4 * blur + margin + lag.max())) + 5
    centre = bins // 2
    by_distance = np.zeros((bins, 2))
    by_row = np.zeros((rows, 2))
    by_place = np.zeros((len(shading), 2))
    misfit, count = 0.0, 0
    for t in range(n):
        if not use[t]:
            continue
        y = fit[t, 0]
        half = cover_reach(lengths[t], blur) + margin
        table = cover_table(lengths[t], blur, half)
        middle = math.ceil(half) + 1
        first = max(0, math.ceil(y - half - lag.max()))
        last = min(columns, int(y + half) + 1)
        # By k, the place in the table, from 1 on: a whole number of pixels behind or ahead of the edge.
        column = np.zeros((2, table.shape[2] + 1))
        odds = np.empty(table.shape[2])
        for u in range(rows):
            at = y - lag[u]
            whole, j, f, even = phase(at)
            a, b = max(first, math.ceil(at - half)), min(last, math.floor(at + half) + 1)
            if b <= a:
                continue
            k = a - whole + middle
            m = b - a
            count += m
            low, high = table[0, j, k : k + m], table[0, j + 1, k : k + m]
            low_slope, high_slope = table[1, j, k : k + m], table[1, j + 1, k : k + m]
            values, after, before = strip[t, u, a:b], pictures[0, u, a:b], pictures[1, u, a:b]
            after_variance, before_variance = pictures[2, u, a:b], pictures[3, u, a:b]
            tops, squares = column[0, k + even : k + even + m], column[1, k + even : k + even + m]
            fraction, shaded = at - whole, a - whole + (len(shading) - 1) // 2
            top, square = 0.0, 0.0
            for i in range(m):
                p = low[i] + f * (high[i] - low[i])
                slope = low_slope[i] + f * (high_slope[i] - low_slope[i])
                contrast = after[i] - before[i]
                r = values[i] * scale[t] + offset[t] - before[i] - contrast * ((1 + fit[t, 3]) * p + fit[t, 4])
                d = shaded + i
                r -= shading[d] + fraction * (shading[d - 1] - shading[d])
                v = p * p * after_variance[i] + (1 - p) * (1 - p) * before_variance[i]
                w = 1 / (v + r * r / 9)
                tops[i] += w * contrast * r
                squares[i] += w * contrast * contrast
                by_place[d, 0] += w * (1 - fraction) * r
                by_place[d, 1] += w * (1 - fraction)
                by_place[d - 1, 0] += w * fraction * r
                by_place[d - 1, 1] += w * fraction
                g = -contrast * slope
                top += w * g * r
                square += w * g * g
                # A variance that knows nothing of the blur: else the widest blur would be its own excuse.
                odds[i] = 1 + r * r / (4.5 * (after_variance[i] + before_variance[i]))
            by_row[u, 0] += top
            by_row[u, 1] += square
            misfit += _log_of_product(odds[:m])
        for k in range(column.shape[1]):
            if column[1, k] > 0:
                i = min(max(centre - middle + k - 1, 0), bins - 1)
                by_distance[i, 0] += column[0, k] * column[0, k] / column[1, k]
                by_distance[i, 1] += 1
    return by_distance, by_row, misfit / max(count, 1), by_place


@njit(cache=True, nogil=True, fastmath=MATHS, error_model="numpy")
def _log_of_product(factors: np.ndarray) -> float:
    """Sum of the logarithms of factors from 1 to 1e18: of sixteen at a time, whose product is a finite number."""
    total = 0.0
    for start in range(0, len(factors), 16):
        product = 1.0
        for factor in factors[start : start + 16]:
            product *= min(factor, 1e18)
        total += math.log(product)
    return total
