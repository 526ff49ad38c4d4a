"""Noise of measured positions: the standard deviation of one of them and the correlation of the noise in time.

The noise is modelled as AR(1): correlation ρ^k between frames k apart. σ and ρ maximise the restricted likelihood
(Harville 1977, J. Am. Stat. Assoc. 72:320) of short stretches of the track, each with its own polynomial: a straight
line where the vine is at rest, a cubic where it moves. Stretches that a cubic cannot follow (release, the end of
growth) are left out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from vinetrack.core.records import Floats, Track

ENOUGH_REST_FRAMES = 60  # Frames at rest from which their noise alone counts as that of the track (chosen)

REST_MARGIN_FRAMES = 3  # Frames left out before the corner between rest and motion (chosen)

LONG_TRACK_POINTS = 90  # Moving points from which stretches are twice as long (chosen)

REST_STRETCH, REST_ORDER = 32, 1  # Points in a stretch at rest and degree of its polynomial (chosen)

MOVING_STRETCH, MOVING_ORDER = 12, 3  # The same in motion (chosen)

RHO_GRID = np.linspace(0.0, 0.95, 20)
PRIOR_RHO_SD = 0.5  # Standard deviation of the normal prior of ρ about 0

SHORTEST_MOTION = 12  # Points in motion below which the whole track is used (chosen)

# Correlation above which the noise may be motion that a cubic does not follow (chosen)
SUSPECT_RHO, SHORTEST_STRETCH = 0.85, 7

THIRD_DIFFERENCE_SD = math.sqrt(20.0)  # Standard deviation of third differences of white noise of unit variance

# Factor by which the median third difference may underestimate correlated noise (derived)
THIRD_DIFFERENCE_ALLOWANCE = 1.84

SAME_STEP_TOLERANCE = 0.01  # Relative difference within which two rounding steps are the same (chosen)

# Noise of a track, in errors of rounding, below which most of it is rounding (derived)
ROUNDING_DOMINATES = math.sqrt(2.0)


def position_noise(time_s: Floats, position_m: Floats) -> tuple[float, float]:
    """Estimate the standard deviation and lag-one correlation of the random error of single positions. Returns noise_m
    (standard deviation, m. 0 where the positions are exact or fewer than 5), correlation (lag-one correlation, 0 to
    0.95; shrunk to 0 where the track is short). Shapes: time_s, position_m (n,).
    """
    noise_m, correlation, rounding_m = _noise_and_rounding(time_s, position_m)
    return (rounding_m, 0.0) if noise_m < rounding_m else (noise_m, correlation)


def _noise_and_rounding(time_s: Floats, position_m: Floats) -> tuple[float, float, float]:
    """Noise and its correlation as if nothing were rounded, and the error of rounding."""
    if position_m.size < 5:
        return 0.0, 0.0, 0.0
    groups = []
    n_rest = _frames_at_rest(position_m)
    if n_rest:
        groups.append(_stretches(time_s[:n_rest], position_m[:n_rest], REST_STRETCH, REST_ORDER))
    n_moving = position_m.size - n_rest
    if n_rest < ENOUGH_REST_FRAMES or n_moving > n_rest:
        length = MOVING_STRETCH if n_moving < LONG_TRACK_POINTS else 2 * MOVING_STRETCH
        groups.append(_stretches(time_s[n_rest:], position_m[n_rest:], length, MOVING_ORDER))
    noise_m, correlation = _restricted_likelihood(groups)
    if correlation > SUSPECT_RHO:
        short = [_stretches(time_s, position_m, SHORTEST_STRETCH, MOVING_ORDER)]
        noise_m, correlation = min((noise_m, correlation), _restricted_likelihood(short))
    return noise_m, correlation, rounding_noise(position_m)


def robust_position_noise(time_s: Floats, position_m: Floats) -> tuple[float, float]:
    """Estimate `position_noise`, bounded so that a fault in a short track does not pass for noise. The bound is the
    median third difference, which a single fault hardly changes, times THIRD_DIFFERENCE_ALLOWANCE; of positions that
    are rounded, and mostly at rest, it carries no information. Returns noise_m, correlation. Shapes: time_s, position_m
    (n,).
    """
    noise_m, correlation, rounding_m = _noise_and_rounding(time_s, position_m)
    correlation = 0.0 if noise_m < rounding_m else correlation
    return max(min(noise_m, THIRD_DIFFERENCE_ALLOWANCE * rough_noise(position_m)), rounding_m), correlation


def _frames_at_rest(position_m: Floats) -> int:
    """Points at rest, if they are enough for stretches of their own, else 0."""
    n_rest = max(rest_points(position_m) - REST_MARGIN_FRAMES, 0)
    return n_rest if n_rest >= 2 * MOVING_STRETCH else 0


def rounding_noise(position_m: Floats) -> float:
    """Estimate the standard deviation of the error of rounded positions (whole pixels, printed decimals). Returns 0
    where they are not rounded, or where it does not show. Shapes: position_m (n,).
    """
    floor_m = _rounding_step(position_m) / math.sqrt(12)
    if floor_m == 0:
        return 0.0
    moving_m = position_m[_frames_at_rest(position_m) :]
    moving_m = moving_m if moving_m.size >= SHORTEST_MOTION else position_m
    return floor_m if _shows_rounding(moving_m, floor_m) else 0.0


def common_rounding_noise(tracks: Sequence[Floats]) -> float:
    """Return the `rounding_noise` of most of a campaign's tracks where it dominates their noise; it then holds for all.
    Returns 0 where most are not rounded, or to different steps, or are noisier than that. Shapes: tracks (n_points,).
    """
    limit = ROUNDING_DOMINATES / math.sqrt(12)
    noises = sorted(
        rounding_noise(position_m) if rough_noise(position_m) < limit * _rounding_step(position_m) else 0.0
        for position_m in tracks
    )
    typical = noises[len(noises) // 2] if noises else 0.0
    n_same = sum(
        typical * (1 - SAME_STEP_TOLERANCE) <= noise <= typical * (1 + SAME_STEP_TOLERANCE) for noise in noises
    )
    return typical if 2 * n_same > len(noises) else 0.0


def _shows_rounding(position_m: Floats, floor_m: float) -> bool:
    """Whether positions that are all multiples of a step are so from rounding. Exact positions at one speed are
    multiples of their step too, but smooth: their third differences are zero except a few at a corner.
    """
    uneven = np.count_nonzero(np.abs(np.diff(position_m, 3)) > floor_m)
    allowed = 5 if position_m.size >= SHORTEST_MOTION else 0
    return bool(uneven > max(allowed, 0.05 * position_m.size))


def _rounding_step(position_m: Floats) -> float:
    """Step of which all positions are multiples (whole pixels, printed decimals), m; 0 where there is none. Rounding to
    a step q adds an error of standard deviation q/√12, which frames at rest cannot show.
    """
    values = np.unique(position_m)
    if values.size < 3:
        return 0.0
    steps = np.diff(values)
    span = float(values[-1] - values[0])
    resolution = np.finfo(float).eps * float(np.max(np.abs(values)))
    # Fast motion may skip single steps: the smallest difference is then several steps.
    for count in range(1, 7):
        step = float(np.min(steps)) / count
        # A match is meaningful only where the step is coarse beside float resolution, and the span holds several.
        if step < 1e4 * resolution or span < 3 * step or span / step > 1e7:
            return 0.0
        multiples = steps / step
        if np.all(np.abs(multiples - np.rint(multiples)) < 1e-3 + 8 * resolution / step * multiples):
            return step
    return 0.0


def rough_noise(position_m: Floats) -> float:
    """Estimate the noise from the median third difference, as if it were white. Third differences of white noise have
    variance 20σ², and the median of |x| is 0.6745 of a normal standard deviation. Shapes: position_m (n,).
    """
    if position_m.size < 5:
        return 0.0
    third = np.diff(position_m, 3)
    return float(np.median(np.abs(third))) / 0.6745 / THIRD_DIFFERENCE_SD


def rest_points(position_m: Floats) -> int:
    """Count the points at the start that are at rest; 0 where the track starts in motion. The track leaves rest where
    it rises above the resting level for good; the corner is then that of the best flat-then-straight line through the
    points up to there. Shapes: position_m (n,).
    """
    n = position_m.size
    if n < 5:
        return 0
    noise_m = 2 * rough_noise(position_m) + 1e-12
    future_low = np.minimum.accumulate(position_m[::-1])[::-1]
    level, left = float(np.median(position_m[:5])), n
    for _ in range(4):
        above = np.flatnonzero(future_low > level + 5 * noise_m)
        left_now = int(above[0]) if above.size else n
        if left_now == left:
            break
        left = left_now
        level = float(np.median(position_m[: max(left, 3)]))
    if left == n:
        return n
    return _corner(position_m[: min(n, left + 3)])


def _corner(position_m: Floats) -> int:
    """Number of points before the corner of the best flat-then-straight line through all points given."""
    n = position_m.size
    index = np.arange(n, dtype=float)
    y = position_m - position_m[0]
    corners = np.arange(0, n - 1) if n <= 400 else np.arange(n - 400, n - 1)
    ramps = np.maximum(index[None, :] - corners[:, None], 0.0)
    mean_ramp, mean_y = ramps.mean(axis=1), float(y.mean())
    centred = ramps - mean_ramp[:, None]
    slope = centred @ (y - mean_y) / np.sum(centred**2, axis=1)
    cost = np.sum((y - mean_y) ** 2) - slope**2 * np.sum(centred**2, axis=1)
    best = int(corners[int(np.argmin(cost))])
    return best + 1 if best > 0 else 0


def _stretches(time_s: Floats, position_m: Floats, length: int, order: int) -> tuple[Floats, Floats]:
    """Positions cut into stretches, shape (s, m), and the polynomial basis of each in its time, (s, m, order + 1)."""
    n = position_m.size
    length = min(length, n)
    starts = np.unique(np.linspace(0, n - length, max(1, math.ceil(n / length))).astype(int))
    take = starts[:, None] + np.arange(length)
    y = position_m[take]
    t = time_s[take]
    middle, half = (t[:, :1] + t[:, -1:]) / 2, (t[:, -1:] - t[:, :1]) / 2
    u = (t - middle) / half
    order = min(order, length - 2)
    return y - y.mean(axis=1, keepdims=True), u[:, :, None] ** np.arange(order + 1)


def _restricted_likelihood(groups: list[tuple[Floats, Floats]]) -> tuple[float, float]:
    """σ and ρ that maximise the restricted likelihood of all stretches that follow their polynomial."""
    tables = [_whitened_residuals(y, basis) for y, basis in groups]
    dof = np.concatenate([np.full(y.shape[0], y.shape[1] - basis.shape[2]) for y, basis in groups])
    rss = np.concatenate([table[0] for table in tables], axis=1)
    log_det = np.concatenate([table[1] for table in tables], axis=1)
    scale = max(float(np.ptp(y)) for y, _ in groups)
    used = np.ones(dof.size, dtype=bool)
    best = 0
    for _ in range(6):
        variance = np.median(rss[best] / _chi2_median(dof)) if used.all() else rss[best, used].sum() / dof[used].sum()
        following = rss[best] <= variance * (dof + 4 * np.sqrt(2 * dof) + 3)
        used = following if following.any() else used
        pooled, n = rss[:, used].sum(axis=1), float(dof[used].sum())
        if pooled.min() <= n * (1e-13 * scale) ** 2:
            return 0.0, 0.0
        score = -0.5 * (n * np.log(pooled) + log_det[:, used].sum(axis=1)) - 0.5 * (RHO_GRID / PRIOR_RHO_SD) ** 2
        best = int(np.argmax(score))
    rho = _parabola_vertex(RHO_GRID, score, best)
    innovation = math.exp(np.interp(rho, RHO_GRID, np.log(pooled / n)))
    return math.sqrt(innovation / (1 - rho**2)), rho


def _chi2_median(dof: Floats) -> Floats:
    """Median of χ² (Wilson and Hilferty)."""
    return dof * (1 - 2 / (9 * dof)) ** 3


def _whitened_residuals(y: Floats, basis: Floats) -> tuple[Floats, Floats]:
    """For each ρ of the grid and each stretch: whitened residual sum of squares, and the log-determinants of REML."""
    rho, root = RHO_GRID[:, None, None], np.sqrt(1 - RHO_GRID**2)[:, None, None]
    white_y = np.concatenate([root * y[:, :1], y[:, 1:] - rho * y[:, :-1]], axis=2)
    rho, root = rho[..., None], root[..., None]
    white_x = np.concatenate([root * basis[:, :1], basis[:, 1:] - rho * basis[:, :-1]], axis=2)
    q, r = np.linalg.qr(white_x)
    inside = np.swapaxes(q, 2, 3) @ white_y[..., None]
    residual = white_y - (q @ inside)[..., 0]
    diagonal = np.abs(np.diagonal(r, axis1=2, axis2=3))
    return np.sum(residual**2, axis=2), 2 * np.log(diagonal).sum(axis=2) - np.log(1 - RHO_GRID**2)[:, None]


def _parabola_vertex(x: Floats, score: Floats, best: int) -> float:
    """Abscissa of the vertex of the parabola through the best grid point and its neighbours."""
    if best == 0 or best == x.size - 1:
        return float(x[best])
    left, middle, right = score[best - 1 : best + 2]
    return float(x[best] + 0.5 * (x[1] - x[0]) * (left - right) / (left - 2 * middle + right))


def track_noise(track: Track) -> tuple[float, float]:
    """Estimate the noise of a track's usable points; see `position_noise`. Returns noise_m (standard deviation, m. 0
    where the positions are exact or fewer than 5), correlation (lag-one correlation, 0 to 0.95; shrunk to 0 where the
    track is short).
    """
    usable = track.usable
    return position_noise(track.time_s[usable], track.lead_position_m[usable])


def ar1_noise(count: int, sd: float, correlation: float, draw: np.random.Generator) -> Floats:
    """Draw stationary first-order autoregressive noise, as simulated tracks have it. Shape (count,)."""
    from scipy.signal import lfilter

    white = draw.standard_normal(count)
    white[1:] *= math.sqrt(1 - correlation**2)
    return sd * np.asarray(lfilter([1.0], [1.0, -correlation], white))
