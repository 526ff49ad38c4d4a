"""Compiled loops of the edge tracker, over strips of shape (n_frames, n_across, n_along).

A strip is kept as the camera wrote it; `scale[t] * value + offset[t]` is its brightness freed of flicker. An edge
`y` blurred by optics (Gaussian of width `blur`) and by motion (a box of `length`) covers the pixel at `s` by
p(y − s), see `cover_table`.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

STEP = 0.05
"""Spacing of the table of covers, px. Derived: linear interpolation errs by at most |p''|·STEP²/8, with |p''| ≤
0.242/blur² and the least blur of 0.4 px 5e-4."""
BEHIND = 25
"""Columns behind the first passed one whose film is looked at: neighbours that stand in where it is never seen.
Chosen: nearly two lengths of MEMORY in `edge_state`. Half or twice changes only film that is never seen."""
FORGOTTEN = 4.0
"""Frames further off than this many memories, e⁻⁴ = 2 %, are not read. Chosen for time; at half 14 % of the weight is
left out, at twice time grows."""
PARTIAL = 0.05
"""Weight of a half-covered pixel: what it says of film and background depends on where the edge was thought to be.
Chosen: a pixel seen half covered in 20 frames weighs as one seen bare once. By reasoning: at half or twice the few
pixels never seen bare change."""
FOREIGN = 1.7
"""How much farther than background film is from what resembles neither. Chosen above 1, so that what resembles neither
hides background. By reasoning: nearer 1 a payload counts as film, farther a stain on the film does as background."""
DOUBT = 0.1
"""By how much a pixel that could be either is called film: one that never changed was film from the start. Chosen
small beside the clip of 6: only pixels without contrast are decided by it."""


@njit(cache=True, fastmath={"contract", "arcp", "nsz", "reassoc"})
def cover_table(length: float, blur: float, reach: float) -> np.ndarray:
    """Cover p and slope dp/dx at x = −reach, −reach + STEP, … ; shape (n, 2).

    p is the mean of the normal distribution function over a box of `length`: ∫Φ = zΦ(z) + φ(z).

    Parameters
    ----------
    length : of the motion blur, px.
    blur : standard deviation of the optical blur, px.
    reach : farthest distance from the edge, px.

    Returns
    -------
    p and dp/dx, shape (n, 2), n = 2 reach/STEP + 2.
    """
    n = int(2 * reach / STEP) + 2
    table = np.empty((n, 2))
    length = max(length, 0.02)
    for i in range(n):
        x = -reach + i * STEP
        a = (x + length / 2) / blur
        b = (x - length / 2) / blur
        cdf_a = 0.5 * (1 + math.erf(a * 0.7071067811865476))
        cdf_b = 0.5 * (1 + math.erf(b * 0.7071067811865476))
        ga = a * cdf_a + 0.3989422804014327 * math.exp(-0.5 * a * a)
        gb = b * cdf_b + 0.3989422804014327 * math.exp(-0.5 * b * b)
        table[i, 0] = (ga - gb) * blur / length
        table[i, 1] = (cdf_a - cdf_b) / length
    return table


@njit(cache=True, fastmath={"contract", "arcp", "nsz", "reassoc"})
def _look_up(table: np.ndarray, reach: float, x: float) -> tuple[float, float]:
    if x <= -reach:
        return 0.0, 0.0
    if x >= reach:
        return 1.0, 0.0
    at = (x + reach) / STEP
    i = int(at)
    f = at - i
    return table[i, 0] + f * (table[i + 1, 0] - table[i, 0]), table[i, 1] + f * (table[i + 1, 1] - table[i, 1])


@njit(cache=True, fastmath={"contract", "arcp", "nsz", "reassoc"})
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
) -> np.ndarray:
    """Sums for the least squares of (before, after) at every pixel; shape (n_across, n_along, 11).

    The edge is over column s from frame `early[s]` to `late[s]`. Background counts before, film after, by a weight
    that falls as exp(−frames / memory_frames): what was seen last before and first after counts most. Half-covered
    pixels count in between, hardly. The answer's columns: Σwq², Σwqp, Σwp², ΣwqV, ΣwpV (q = 1 − p) of those, then
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

    Returns
    -------
    the sums.
    """
    n, rows, columns = strip.shape
    sums = np.zeros((rows, columns, 11), np.float32)
    share = np.zeros(columns)
    for t in range(n):
        if not math.isfinite(edge[t]):
            continue
        reach = 0.5 * lengths[t] + 4 * blur + 0.5
        table = cover_table(lengths[t], blur, reach)
        first, last = columns, 0
        for s in range(columns):
            d = max(early[s] - t, t - late[s], 0.0) / memory_frames
            share[s] = math.exp(-d) if d < FORGOTTEN else 0.0
            if share[s] > 0:
                first, last = min(first, s), s + 1
        for u in range(rows):
            at = edge[t] - lag[u]
            for s in range(first, last):
                p, _ = _look_up(table, reach, at - s)
                q = 1 - p
                value = strip[t, u, s] * scale[t] + offset[t]
                w = share[s]
                if p > 0.98:
                    if t < late[s]:
                        continue
                elif p > 0.02:
                    if t < early[s] or t > late[s]:
                        continue
                    w *= PARTIAL
                if clip > 0:
                    r = value - pictures[1, u, s] * q - pictures[0, u, s] * p
                    w /= 1 + r * r / (clip * clip)
                at_pixel = sums[u, s]
                if q > 0.98:
                    at_pixel[5] += w
                    at_pixel[6] += w * value
                    at_pixel[7] += w * value * value
                elif p > 0.98:
                    at_pixel[8] += w
                    at_pixel[9] += w * value
                    at_pixel[10] += w * value * value
                else:
                    at_pixel[0] += w * q * q
                    at_pixel[1] += w * q * p
                    at_pixel[2] += w * p * p
                    at_pixel[3] += w * q * value
                    at_pixel[4] += w * p * value
    return sums


@njit(cache=True, fastmath={"contract", "arcp", "nsz", "reassoc"})
def solve(sums: np.ndarray, ridge: float, memory: float, fallback: float, noise: float, texture: float) -> np.ndarray:
    """Brightness after and before the edge at every pixel, and the variance about each; shape (4, n_across, n_along).

    A pixel that never shows one of the two, or whose background changes (a door swings there), takes it from its row:
    film from the columns behind it, background from those ahead, with weights falling as `memory`^distance; its
    variance is then `texture`², a tenth more where it changes.

    Parameters
    ----------
    sums : from `gather`, shape (n_across, n_along, 11).
    ridge : weight of the row's guess where a pixel was seen itself, frames.
    memory : factor by which weights of neighbours fall from column to column.
    fallback : brightness where nothing is known.
    noise, texture : standard deviation of a value, and of a pixel about its neighbours, grey levels.

    Returns
    -------
    after, before, variance after, variance before.
    """
    rows, columns, _ = sums.shape
    out = np.empty((4, rows, columns), np.float32)
    guess = np.empty(columns)
    unsteady = (1.5 * texture) ** 2
    for u in range(rows):
        total, count, level = 0.0, 0.0, fallback
        for s in range(columns - 1, -1, -1):
            if count > 1e-3:
                level = total / count
            guess[s] = level
            steady = _variance(sums[u, s, 5], sums[u, s, 6], sums[u, s, 7], noise) < unsteady
            total = total * memory + (sums[u, s, 6] if steady else 0.0)
            count = count * memory + (sums[u, s, 5] if steady else 0.0)
        for s in range(columns - 1, -1, -1):
            if guess[s] != fallback:
                break
            guess[s] = sums[u, s, 6] / sums[u, s, 5] if sums[u, s, 5] > 0 else fallback
        total, count, level = 0.0, 0.0, fallback
        for s in range(columns):
            if count > 1e-3:
                level = total / count
            elif sums[u, s, 8] > 0:
                level = sums[u, s, 9] / sums[u, s, 8]
            total = total * memory + sums[u, s, 9]
            count = count * memory + sums[u, s, 8]
            # Never seen bare: what a half-covered pixel seems to show would follow any error of the edge.
            bare_variance = _variance(sums[u, s, 5], sums[u, s, 6], sums[u, s, 7], noise)
            bare, film = sums[u, s, 5] > 0.1 and bare_variance < unsteady, sums[u, s, 8] > 0.1
            qq, qp, pp = sums[u, s, 0] + sums[u, s, 5], sums[u, s, 1], sums[u, s, 2] + sums[u, s, 8]
            vq, vp = sums[u, s, 3] + sums[u, s, 6], sums[u, s, 4] + sums[u, s, 9]
            rq = ridge if bare else 1e4 * (1 + qq)
            rp = ridge if film else 1e4 * (1 + pp)
            qq, pp, vq, vp = qq + rq, pp + rp, vq + rq * guess[s], vp + rp * level
            det = qq * pp - qp * qp
            out[0, u, s] = (vp * qq - vq * qp) / det
            out[1, u, s] = (vq * pp - vp * qp) / det
            out[2, u, s] = _variance(sums[u, s, 8], sums[u, s, 9], sums[u, s, 10], noise) if film else texture**2
            out[3, u, s] = bare_variance if bare else (1.1 if bare_variance >= unsteady else 1.0) * texture**2
    return out


@njit(cache=True, fastmath={"contract", "arcp", "nsz", "reassoc"})
def _variance(weight: float, total: float, squares: float, noise: float) -> float:
    """Variance of what a pixel showed, never below that of the noise, drawn towards it where few frames speak."""
    if weight <= 0:
        return noise**2
    seen = max(squares / weight - (total / weight) ** 2, 0.0)
    return max((weight * seen + 2 * noise**2) / (weight + 2), noise**2)


@njit(cache=True, fastmath={"contract", "arcp", "nsz", "reassoc"})
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
    top = clip * clip
    for t in range(n):
        for u in range(rows):
            for s in range(columns):
                value = strip[t, u, s] * scale[t] + offset[t]
                a = (value - pictures[0, u, s]) ** 2 / (pictures[2, u, s] + width * width)
                b = (value - pictures[1, u, s]) ** 2 / (pictures[3, u, s] + width * width)
                out[t, s] += min(a, FOREIGN * top) - min(b, top) - DOUBT
    return out


@njit(cache=True, fastmath={"contract", "arcp", "nsz", "reassoc"})
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
) -> np.ndarray:
    """Most likely edge in every frame by Gauss-Newton; shape (n_frames, 6).

    Columns: edge, its Fisher sigma, mean squared weighted residual, amplitude − 1, level, pixels used. Amplitude and
    level of the contrast are free within `prior_sd`. `inflation[i]` multiplies the variance of pixels i − len/2 px
    ahead of the edge: how far their noise adds up.

    Parameters
    ----------
    strip, scale, offset, lengths, lag, blur : as in `gather`.
    start : where each search begins, shape (n_frames,), px; NaN to leave a frame out.
    pictures : from `solve`, shape (4, n_across, n_along).
    inflation : shape (n_bins,), about its middle.
    prior_sd : standard deviation of relative amplitude and level.
    margin : pixels beyond the blurred edge that take part.
    rounds : steps at most.

    Returns
    -------
    a row a frame, NaN where there is no start.
    """
    n, rows, columns = strip.shape
    out = np.full((n, 6), np.nan)
    middle = len(inflation) // 2
    deepest = lag.max()
    for t in range(n):
        y = start[t]
        if not math.isfinite(y):
            continue
        reach = 0.5 * lengths[t] + 4 * blur + 0.5
        table = cover_table(lengths[t], blur, reach)
        half = reach + margin
        gain, level = 0.0, 0.0
        for _ in range(rounds):
            first = max(0, math.ceil(y - half - deepest))
            last = min(columns, int(y + half) + 1)
            yy, yg, yl, gg, gl, ll = 1e-12, 0.0, 0.0, prior_sd**-2, 0.0, prior_sd**-2
            ry, rg, rl = 0.0, -gain * prior_sd**-2, -level * prior_sd**-2
            chi, used = 0.0, 0.0
            for u in range(rows):
                at = y - lag[u]
                for s in range(first, last):
                    x = at - s
                    if x > half or x < -half:
                        continue
                    p, slope = _look_up(table, reach, x)
                    contrast = pictures[0, u, s] - pictures[1, u, s]
                    value = strip[t, u, s] * scale[t] + offset[t]
                    r = value - pictures[1, u, s] - contrast * ((1 + gain) * p + level)
                    i = min(max(int(middle - x), 0), len(inflation) - 1)
                    variance = p * p * pictures[2, u, s] + (1 - p) * (1 - p) * pictures[3, u, s]
                    variance *= inflation[i]
                    w = 1 / (variance * (1 + r * r / (9 * variance)))
                    dy = contrast * (1 + gain) * slope
                    dg = contrast * p
                    yy += w * dy * dy
                    yg += w * dy * dg
                    yl += w * dy * contrast
                    gg += w * dg * dg
                    gl += w * dg * contrast
                    ll += w * contrast * contrast
                    ry += w * dy * r
                    rg += w * dg * r
                    rl += w * contrast * r
                    chi += w * r * r
                    used += 1
            # Level and amplitude eliminated from the 3 by 3 normal equations.
            det = gg * ll - gl * gl
            ag, al = (yg * ll - yl * gl) / det, (yl * gg - yg * gl) / det
            info = yy - yg * ag - yl * al
            if info <= 1e-9:
                break
            step = (ry - ag * rg - al * rl) / info
            gain += (ll * (rg - yg * step) - gl * (rl - yl * step)) / det
            level += (gg * (rl - yl * step) - gl * (rg - yg * step)) / det
            gain, level = min(max(gain, -0.7), 1.5), min(max(level, -0.7), 0.7)
            limit = 1.0 + 0.25 * lengths[t]
            y += min(max(step, -limit), limit)
            out[t, 1] = 1 / math.sqrt(info)
            out[t, 2] = chi / max(used, 1.0)
            out[t, 5] = used
            if abs(step) < 1e-3:
                break
        out[t, 0], out[t, 3], out[t, 4] = y, gain, level
    return out


@njit(cache=True, fastmath={"contract", "arcp", "nsz", "reassoc"})
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
) -> tuple[np.ndarray, np.ndarray, float]:
    """What the fit leaves: by distance ahead of the edge, by row, and in all.

    First answer: shape (n, 2), bins of 1 px about the middle: the sum over frames of z² / var z, z = Σ C r / v over
    all rows of a column, and the count: 1 on average for white noise, more where noise adds up across
    neighbours (grain of the film, its tail moving inside). Second: shape (n_across, 2), Σ g r and Σ g² with g the
    slope of the model in the row's own lag. Third: the mean of log(1 + r²/9v̄), v̄ the mean
    of the two variances: a robust misfit for comparing blurs.

    Parameters
    ----------
    strip, scale, offset, lengths, lag, blur, pictures, margin : as in `fit_edges`.
    fit : from `fit_edges`, shape (n_frames, 6).
    use : mask of frames, shape (n_frames,).

    Returns
    -------
    three sums, as above.
    """
    n, rows, columns = strip.shape
    widest = 0.0
    for t in range(n):
        widest = max(widest, 0.5 * lengths[t])
    bins = int(2 * (widest + 4 * blur + margin + lag.max())) + 5
    middle = bins // 2
    by_distance = np.zeros((bins, 2))
    column = np.zeros((bins, 2))
    by_row = np.zeros((rows, 2))
    misfit, count = 0.0, 0
    for t in range(n):
        if not use[t]:
            continue
        y = fit[t, 0]
        reach = 0.5 * lengths[t] + 4 * blur + 0.5
        table = cover_table(lengths[t], blur, reach)
        half = reach + margin
        first = max(0, math.ceil(y - half - lag.max()))
        last = min(columns, int(y + half) + 1)
        column[:] = 0.0
        for u in range(rows):
            at = y - lag[u]
            for s in range(first, last):
                x = at - s
                if x > half or x < -half:
                    continue
                p, slope = _look_up(table, reach, x)
                contrast = pictures[0, u, s] - pictures[1, u, s]
                value = strip[t, u, s] * scale[t] + offset[t]
                r = value - pictures[1, u, s] - contrast * ((1 + fit[t, 3]) * p + fit[t, 4])
                i = min(max(int(middle - x), 0), bins - 1)
                v = p * p * pictures[2, u, s] + (1 - p) * (1 - p) * pictures[3, u, s]
                w = 1 / (v * (1 + r * r / (9 * v)))
                column[i, 0] += w * contrast * r
                column[i, 1] += w * contrast * contrast
                g = -contrast * slope
                by_row[u, 0] += w * g * r
                by_row[u, 1] += w * g * g
                # A variance that knows nothing of the blur: else the widest blur would be its own excuse.
                misfit += math.log(1 + r * r / (4.5 * (pictures[2, u, s] + pictures[3, u, s])))
                count += 1
        for i in range(bins):
            if column[i, 1] > 0:
                by_distance[i, 0] += column[i, 0] * column[i, 0] / column[i, 1]
                by_distance[i, 1] += 1
    return by_distance, by_row, misfit / max(count, 1)
