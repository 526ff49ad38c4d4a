"""Noise of measured positions: the standard deviation of one of them and the correlation of the noise in time.

The noise is modelled as AR(1): correlation ρ^k between frames k apart. σ and ρ maximise the restricted likelihood
(Harville 1977, J. Am. Stat. Assoc. 72:320) of short stretches of the track, each with its own polynomial: a straight
line where the vine is at rest, a cubic where it moves. Stretches that a cubic cannot follow (release, the end of
growth) are left out.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate, product

import numpy as np

from vinetrack.core.problems import Remark, remark
from vinetrack.core.process import njit
from vinetrack.core.records import Bools, Floats, Track, Trial, with_flag

# ------------------------------------------------------------------------------
# Detect positions that were smoothed before they were handed in, by the frequencies that their noise lacks.
#
# A moving average over N frames removes the frequencies j/N a frame; a polynomial through N frames (Savitzky & Golay,
# Anal. Chem. 36, 1627, 1964) removes what oscillates faster than it bends. Noise of a camera or a tracker has no such
# holes. The spectra of a campaign's positions, above the frequencies of the motion itself, are compared with both kinds
# of filter and with correlated noise by Whittle's likelihood (Whittle, J. R. Stat. Soc. B 15, 125, 1953).
#
# Noise averaged over N frames hardly changes from one to the next: an autoregressive model takes it for a random walk,
# under which a fit detects next to nothing. One frame in N carries as much, and its noise is independent.

LOWEST_FREQUENCY = 0.06  # Lowest frequency, in cycles a frame, at which the spectra are compared (chosen)
FEWEST_FRAMES = 40  # Fewest frames of a stretch without gaps (chosen)


@dataclass(frozen=True)
class Smoothing:
    """A filter: polynomials of this degree (0 is a moving average) through a window of so many frames."""

    window: int
    degree: int

    def __str__(self) -> str:
        kind = "by a moving average" if self.degree == 0 else f"by polynomials of degree {self.degree}"
        return f"{kind} over {self.window} frames"

    @property
    def weights(self) -> Floats:
        """Weight of each frame of the window in the value in its middle of a polynomial through them, shape (window,):
        that of Savitzky and Golay. SciPy has them too, but takes half a second to load.
        """
        places = np.linspace(-1, 1, self.window)
        return np.asarray(np.linalg.pinv(np.vander(places, self.degree + 1))[-1])

    @property
    def decimation(self) -> int:
        """One smoothed frame in so many carries the information of all: an average of N keeps 1/N of the variance."""
        return max(round(1 / float(self.weights @ self.weights)), 2)


def detect_smoothing(pairs: Iterable[tuple[Trial, Track]], rounding_m: float = 0.0) -> Smoothing | None:
    """Find the filter with which the positions of a campaign were smoothed; None where they were not."""
    if rounding_m > 0 or not (spectra := _longest(pairs, 3)):
        return None
    ranked: list[tuple[float, Smoothing | None]] = [(_unsmoothed(spectra), None)]
    for window, degree in product(range(3, 22, 2), (0, 2)):
        if degree < window - 1:
            smoothing = Smoothing(window, degree)
            # The squared response of the filter; 1e-5: part of its power that smoothed noise keeps in a hole.
            phases = [2 * math.pi * np.outer(f, np.arange(window) - window // 2) for f, _ in spectra]
            shapes = [np.maximum((np.cos(phase) @ smoothing.weights) ** 2, 1e-5) for phase in phases]
            ranked.append((_whittle(spectra, shapes), smoothing))
    ranked.sort(key=lambda pair: -pair[0])
    # 30.0: gain of ln L over noise without holes, and over every other filter, that is sure (chosen)
    return ranked[0][1] if ranked[0][0] > ranked[1][0] + 30.0 else None


def low_passed(pairs: Iterable[tuple[Trial, Track]]) -> Remark:
    """Say that positions were smoothed by a low-pass (Butterworth 1930, run both ways), and about where it cuts off;
    blank where not. It shows at rest alone: a smooth motion lacks high frequencies too.
    """
    if not (spectra := _longest(pairs, 0)):
        return Remark()
    gains = {}
    for cutoff, order in product(np.geomspace(0.02, 0.3, 15).tolist(), (2, 4)):
        ratios = (np.tan(math.pi * f) / math.tan(math.pi * cutoff) for f, _ in spectra)
        gains[_whittle(spectra, [np.maximum((1 + ratio ** (2 * order)) ** -2.0, 1e-8) for ratio in ratios])] = cutoff
    # 30.0: gain of ln L over noise without a low-pass that is sure (chosen)
    return remark("low_passed", cutoff=gains[max(gains)]) if max(gains) > _unsmoothed(spectra) + 30.0 else Remark()


def _unsmoothed(spectra: Sequence[tuple[Floats, Floats]]) -> float:
    """The largest log-likelihood of noise that was not smoothed: first-order autoregressive."""
    shapes = (
        [(1 - r**2) / (1 - 2 * r * np.cos(2 * math.pi * f) + r**2) for f, _ in spectra] for r in np.arange(0, 1, 0.1)
    )
    return max(_whittle(spectra, of_all) for of_all in shapes)


def _longest(pairs: Iterable[tuple[Trial, Track]], order: int) -> Sequence[tuple[Floats, Floats]]:
    """The twelve longest stretches of imported tracks."""
    spectra = [spectrum for trial, track in pairs if trial.video is None for spectrum in _spectra(track, order)]
    return sorted(spectra, key=lambda spectrum: -spectrum[0].size)[:12]


def _spectra(track: Track, order: int) -> Iterator[tuple[Floats, Floats]]:
    """Frequencies, 1/frame, and periodogram of the noise, of every evenly spaced stretch of a track, by differences of
    this order, which remove the motion; of order 0 those of its rest, where that is no mere rounding.
    """
    time_s, position_m = track.time_s[track.usable], track.lead_position_m[track.usable]
    if order == 0:
        # 0.8: part of a rest that the beginning of a smoothed motion leaves (chosen)
        rest = position_m[: int(0.8 * rest_points(position_m))]
        time_s = time_s[: rest.size if rest.size and np.std(rest) > 2 * rounding_noise(position_m) else 0]
    if time_s.size < FEWEST_FRAMES:
        return
    steps = np.diff(time_s)
    # 0.02: median deviation of the spacings, as a part of their median, above which a track is not used (chosen)
    if np.median(np.abs(steps - np.median(steps))) > 0.02 * np.median(steps):
        return
    for part in np.split(np.arange(time_s.size), np.flatnonzero(steps > 1.5 * np.median(steps)) + 1):
        if part.size < FEWEST_FRAMES:
            continue
        differences = np.diff(position_m[part] - position_m[part].mean(), order)
        taper = np.hanning(differences.size + 1)[:-1]
        frequency = np.fft.rfftfreq(differences.size)
        power = np.abs(np.fft.rfft(differences * taper)) ** 2
        compared = (frequency > (LOWEST_FREQUENCY if order else 0.0)) & (frequency < 0.5)
        power = power[compared] / (2 * np.sin(math.pi * frequency[compared])) ** (2 * order)
        if np.all(power > 0):
            yield np.asarray(frequency[compared], dtype=float), power


def _whittle(spectra: Sequence[tuple[Floats, Floats]], shapes: Sequence[Floats]) -> float:
    """Log-likelihood of the spectra as sums of the given shape, white noise and rough motion, with free amplitudes. The
    amplitudes maximise it by multiplicative updates (Févotte, Bertin & Durrieu, Neural Computation 21, 793, 2009).
    """
    total = 0.0
    for (frequency, power), shape in zip(spectra, shapes, strict=True):
        # The spectrum of a motion rougher than its noise, as of a tube that sticks and slips, falls as 1/f⁴.
        bases = np.stack([shape / shape.mean(), np.ones_like(shape), (LOWEST_FREQUENCY / frequency) ** 4.0])
        amplitudes = power.mean() * np.array([0.8, 0.1, 0.1])
        for _ in range(30):
            spectrum = amplitudes @ bases
            amplitudes = amplitudes * np.sqrt((bases @ (power / spectrum**2)) / (bases @ (1 / spectrum)))
        spectrum = amplitudes @ bases
        total -= float(np.sum(np.log(spectrum) + power / spectrum))
    return total


MOVING_STRETCH, MOVING_ORDER = 12, 3  # Points of a stretch in motion, and degree of its polynomial (chosen)
RHO_GRID = np.linspace(0.0, 0.95, 20)
THIRD_DIFFERENCE_SD = math.sqrt(20.0)  # Standard deviation of third differences of white noise of unit variance


def position_noise(time_s: Floats, position_m: Floats, *, robust: bool = False) -> tuple[float, float]:
    """Standard deviation (0 where positions are exact, or fewer than 5) and lag-one correlation (0 to 0.95, shrunk to 0
    in short tracks) of the random error of single positions. `robust`: so that a fault in a short track is no noise, at
    most 1.84 times what the median third difference says, which a single fault hardly changes; it says nothing of
    positions that are rounded, and mostly at rest. Shapes: time_s, position_m (n,).
    """
    if position_m.size < 5:
        return 0.0, 0.0
    n_rest = _frames_at_rest(position_m)
    # From 90 moving points on, stretches are twice as long.
    length = MOVING_STRETCH if position_m.size - n_rest < 90 else 2 * MOVING_STRETCH
    groups = [_stretches(time_s[n_rest:], position_m[n_rest:], length, MOVING_ORDER)]
    if n_rest:  # straight lines through 32 points
        groups.append(_stretches(time_s[:n_rest], position_m[:n_rest], 32, 1))
    noise_m, correlation = _restricted_likelihood(groups)
    # Such noise may be motion that a cubic does not follow.
    if correlation > 0.85:
        short = [_stretches(time_s, position_m, 7, MOVING_ORDER)]
        noise_m, correlation = min((noise_m, correlation), _restricted_likelihood(short))
    rounding_m = rounding_noise(position_m)
    correlation = 0.0 if noise_m < rounding_m else correlation
    if robust:
        # 1.84: factor by which the median third difference may underestimate correlated noise (derived)
        noise_m = min(noise_m, 1.84 * rough_noise(position_m))
    return max(noise_m, rounding_m), correlation


def _frames_at_rest(position_m: Floats) -> int:
    """Points at rest, if they are enough for stretches of their own, else 0."""
    # Three frames before the corner between rest and motion are left out.
    n_rest = max(rest_points(position_m) - 3, 0)
    return n_rest if n_rest >= 2 * MOVING_STRETCH else 0


def rounding_noise(position_m: Floats) -> float:
    """Standard deviation of the error of rounded positions; 0 where they are not, or where it does not show."""
    floor_m = _rounding_step(position_m) / math.sqrt(12)
    if floor_m == 0:
        return 0.0
    shortest = 12  # Points in motion below which the whole track is used (chosen)
    moving_m = position_m[_frames_at_rest(position_m) :]
    moving_m = moving_m if moving_m.size >= shortest else position_m
    # Exact positions at one speed are multiples of their step too, but their third differences are 0 but at corners.
    uneven = np.count_nonzero(np.abs(np.diff(moving_m, 3)) > floor_m)
    allowed = 5 if moving_m.size >= shortest else 0
    return floor_m if uneven > max(allowed, 0.05 * moving_m.size) else 0.0


def common_rounding_noise(tracks: Sequence[Floats]) -> float:
    """The `rounding_noise` of most of a campaign's tracks where it dominates their noise and so holds for all, or 0."""
    # Below √2 errors of rounding, most of the noise is rounding.
    limit = math.sqrt(2) / math.sqrt(12)
    noises = sorted(
        rounding_noise(position_m) if rough_noise(position_m) < limit * _rounding_step(position_m) else 0.0
        for position_m in tracks
    )
    typical = noises[len(noises) // 2] if noises else 0.0
    # 0.01: relative difference within which two rounding steps are the same (chosen)
    n_same = np.isclose(noises, typical, rtol=0.01, atol=0).sum()
    return typical if 2 * n_same > len(noises) else 0.0


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
    """Noise by the median third difference, as if white; a median of |x| is 0.6745 of a normal standard deviation."""
    if position_m.size < 5:
        return 0.0
    third = np.diff(position_m, 3)
    return float(np.median(np.abs(third))) / 0.6745 / THIRD_DIFFERENCE_SD


def rest_points(position_m: Floats) -> int:
    """Count the points at rest at the start; 0 where the track starts in motion. It leaves rest where it rises above
    the resting level for good, at the corner of the best flat-then-straight line up to there. Shapes: position_m (n,).
    """
    n = position_m.size
    if n < 5:
        return 0
    noise_m = 2 * rough_noise(position_m) + 1e-12
    future_low = np.minimum.accumulate(position_m[::-1])[::-1]
    above = np.flatnonzero(future_low > float(np.median(position_m[:5])) + 5 * noise_m)
    if not above.size:
        return n
    left = int(above[0])
    # Points before the corner of the best flat-then-straight line through those up to there
    y = position_m[: min(n, left + 3)] - position_m[0]
    corners = np.arange(max(y.size - 400, 0), y.size - 1)
    ramps = np.maximum(np.arange(y.size, dtype=float)[None, :] - corners[:, None], 0.0)
    centred = ramps - ramps.mean(axis=1)[:, None]
    mean_y = float(y.mean())
    slope = centred @ (y - mean_y) / np.sum(centred**2, axis=1)
    cost = np.sum((y - mean_y) ** 2) - slope**2 * np.sum(centred**2, axis=1)
    best = int(np.argmin(cost))
    # 4.0: fall of the squares, in (2σ)², by which a corner must beat a track that moves from its first point (chosen)
    is_corner = cost[best] < cost[0] - 4.0 * noise_m**2
    return int(corners[best]) + 1 if corners[best] > 0 and (is_corner or corners[0] > 0) else 0


def turning_point(position: Floats, back: Floats | float) -> int | None:
    """Furthest point before two in a row lie farther than `back` behind it; None if there are none. Shapes (n,)."""
    is_back = np.maximum.accumulate(position) - position > back
    turned = np.flatnonzero(is_back[:-1] & is_back[1:])
    return int(np.argmax(position[: turned[0] + 1])) if turned.size else None


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
        # The median of χ² by Wilson and Hilferty.
        chi2_median = dof * (1 - 2 / (9 * dof)) ** 3
        variance = np.median(rss[best] / chi2_median) if used.all() else rss[best, used].sum() / dof[used].sum()
        following = rss[best] <= variance * (dof + 4 * np.sqrt(2 * dof) + 3)
        used = following if following.any() else used
        pooled, n = rss[:, used].sum(axis=1), float(dof[used].sum())
        if pooled.min() <= n * (1e-13 * scale) ** 2:
            return 0.0, 0.0
        # ρ has a normal prior about 0 with a standard deviation of 0.5.
        score = -0.5 * (n * np.log(pooled) + log_det[:, used].sum(axis=1)) - 0.5 * (RHO_GRID / 0.5) ** 2
        best = int(np.argmax(score))
    rho = float(RHO_GRID[best])
    if 0 < best < RHO_GRID.size - 1:  # the vertex of the parabola through it and its neighbours
        left, middle, right = score[best - 1 : best + 2]
        rho = float(rho + 0.5 * (RHO_GRID[1] - RHO_GRID[0]) * (left - right) / (left - 2 * middle + right))
    innovation = math.exp(np.interp(rho, RHO_GRID, np.log(pooled / n)))
    return math.sqrt(innovation / (1 - rho**2)), rho


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


def correlated(weights: Floats, rho: float) -> Floats:
    """Multiply weights by the correlation of AR(1) noise, R_ij = ρ^|i − j|, along the last axis. w·(R·w) is the
    variance of Σ w_i e_i for noise e of variance 1. Shapes: weights (…, n) → (…, n).
    """
    if rho == 0 or weights.size == 0:
        return weights
    both_ways = np.array([weights, weights[..., ::-1]])
    _add_up(both_ways.reshape(-1, weights.shape[-1]), rho)
    return both_ways[0] + both_ways[1, ..., ::-1] - weights


@njit(nogil=True)
def _add_up(rows: Floats, factor: float) -> None:  # scipy.signal.lfilter, which loads scipy.stats in a second
    for row in rows:
        for k in range(1, row.size):
            row[k] += factor * row[k - 1]


def ar1_sd(weights: Floats, rho: float) -> float:
    """Standard deviation of Σ w_i e_i for AR(1) noise e of unit variance. Shapes: weights (n,)."""
    return math.sqrt(max(float(weights @ correlated(weights, rho)), 0.0))


def ar1_noise(count: int, sd: float, correlation: float, draw: np.random.Generator) -> Floats:
    """Draw stationary first-order autoregressive noise, as simulated tracks have it. Shape (count,)."""
    white = draw.standard_normal(count)
    white[1:] *= math.sqrt(1 - correlation**2)
    return sd * np.fromiter(accumulate(white, lambda before, new: new + correlation * before), dtype=float)


# ------------------------------------------------------------------------------
# Outliers of a track: points far off the motion around them (a reflection, a lost edge, a slip of the hand).
#
# Every point is compared with a cubic through its neighbours, itself left out. The cubic is fitted by iteratively
# reweighted least squares, first for least absolute residuals, then with Tukey's biweight (Beaton & Tukey,
# Technometrics 16, 147, 1974), so that a second outlier nearby does not bend it. No model of the motion enters: what
# a model misses is no reason to drop a point.
#
# An outlier is isolated: the motion goes on through its neighbours as if it were not there. After a dropped frame all
# later points are displaced together, and at a corner of the motion one side leaves the cubic; both leave too few
# neighbours on one cubic, and nothing is rejected there.

HALF_WIDTH = 6  # Neighbours on either side (chosen)
LEAST_SHARE = 0.75  # Least share of the neighbours that must lie on the cubic (chosen)
FEWEST_POINTS = 2 * HALF_WIDTH + 1  # Fewest points of a window: the point and its neighbours (derived)


@dataclass(frozen=True)
class LocalFit:
    """Comparison of every point with the cubic through its neighbours; arrays of shape (n_points,)."""

    residual_m: Floats
    gain: Floats
    spread_m: Floats
    share: Floats
    near: Floats
    speed_m_s: Floats


def local_fit(time_s: Floats, position_m: Floats, noise_m: float) -> LocalFit:
    """Compare every point with a robust cubic through its twelve neighbours. Shapes: time_s, position_m (n_points,)."""
    n = time_s.size
    begin = np.clip(np.arange(n) - HALF_WIDTH, 0, n - FEWEST_POINTS)
    places = begin[:, None] + np.arange(FEWEST_POINTS)
    # Each row holds the twelve others: the point itself is dropped.
    places = places[places != np.arange(n)[:, None]].reshape(n, -1)
    time_from_point = time_s[places] - time_s[:, None]
    width = np.abs(time_from_point).max(axis=1)
    relative_time = time_from_point / width[:, None]
    powers = relative_time[..., None] ** np.arange(4)
    y = position_m[places] - position_m[:, None]
    # 1e-12: m, of a track that stands still to the last digit
    smallest_scale = np.maximum(noise_m, max(1e-9 * float(np.ptp(position_m)), 1e-12))
    weight = np.ones_like(y)
    for turn in range(10):
        coefficients = _normal_solution(powers, weight, np.einsum("wip,wi->wp", powers, weight * y))
        residuals = np.abs(y - np.einsum("wip,wp->wi", powers, coefficients))
        if turn < 6:  # least absolute residuals
            weight = 1 / np.maximum(residuals, 0.1 * smallest_scale)
        else:  # Tukey's biweight; the median of 12 residuals about 4 fitted numbers is 0.55 of their sd
            median = np.sort(residuals, axis=1)[:, HALF_WIDTH - 1 : HALF_WIDTH + 1].mean(axis=1)
            scale = np.maximum(median / 0.55, smallest_scale)
            # From 6 standard deviations of the noise on, a neighbour has no weight.
            weight = np.maximum(1 - (residuals / (6.0 * scale[:, None])) ** 2, 0.0) ** 2 + 1e-9
    on_cubic = weight > 0.1
    used = np.maximum(on_cubic.sum(axis=1), 5)
    # The point itself lies at 0, where the cubic is its first coefficient.
    first_coefficient = np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
    leverage = weight * np.einsum("wip,wp->wi", powers, _normal_solution(powers, weight, first_coefficient))
    nearest = np.argsort(np.abs(time_from_point), axis=1, kind="stable")[:, :4]
    return LocalFit(
        residual_m=-coefficients[:, 0],
        gain=np.sqrt(1 + np.sum(leverage**2, axis=1)),
        spread_m=np.sqrt(np.sum(np.where(on_cubic, residuals, 0.0) ** 2, axis=1) / (used - 4)),
        share=on_cubic.mean(axis=1),
        near=np.take_along_axis(on_cubic, nearest, axis=1).sum(axis=1),
        speed_m_s=coefficients[:, 1] / width,
    )


def local_noise(distance_m: Floats, half_width: int = 20) -> Floats:
    """Standard deviation around each point by the running median of so many on either side. (n_points,) → same."""
    width = min(2 * half_width + 1, distance_m.size)
    view = np.median(np.lib.stride_tricks.sliding_window_view(distance_m, width), axis=1) / 0.6745
    middle = np.clip(np.arange(distance_m.size) - width // 2, 0, view.size - 1)
    return np.asarray(view[middle])


def find_outliers(time_s: Floats, position_m: Floats) -> Bools:
    """Mark the points far off the motion around them: the largest deviations first, others only if they remain without
    those, since an outlier spoils its neighbours. Shapes: time_s, position_m (n_points,) → (n_points,).
    """
    from scipy.special import stdtrit  # scipy.stats takes most of a second to load

    most_rounds = 4  # Most rounds of rejection (measured)
    n = time_s.size
    is_outlier = np.zeros(n, dtype=bool)
    if n < FEWEST_POINTS + most_rounds or not np.all(np.diff(time_s) > 0):
        return is_outlier
    # Normal noise costs one track in a thousand a point; the local noise has 0.37 × 41 degrees of freedom.
    limit = -float(stdtrit(15.0, 1e-3 / (2 * n)))
    for _ in range(most_rounds):
        candidates = np.flatnonzero(~is_outlier)
        if candidates.size < FEWEST_POINTS:
            break
        outlying_kept = _outlying(time_s[candidates], position_m[candidates], limit)
        if not outlying_kept.any():
            break
        is_outlier[candidates[outlying_kept]] = True
    # 0.1: largest share of points that may be rejected (chosen)
    return is_outlier if np.mean(is_outlier) <= 0.1 else np.zeros(n, dtype=bool)


def reject_outliers(track: Track) -> Track:
    """Flag the outliers of a track `rejected`, and name them in its notes; points corrected by hand stay."""
    rows = np.flatnonzero(track.usable)
    is_wild = find_outliers(track.time_s[rows], track.lead_position_m[rows])
    outlying = rows[is_wild]
    # A point that a person has placed or confirmed is right.
    outlying = outlying[~with_flag(track.flag[outlying], "corrected")] if outlying.size else outlying
    if not outlying.size:
        return track
    rejected = track.flagged(outlying, "rejected")
    around = track.time_s[rejected.usable], track.lead_position_m[rejected.usable]
    off_m = track.lead_position_m[outlying] - np.interp(track.time_s[outlying], *around)
    places = [f"{1e3 * s:.5g} ms ({1e3 * m:+.2g} mm)" for s, m in zip(track.time_s[outlying], off_m, strict=True)]
    return rejected.flagged([], "", f"points far off the motion around are left out: at {', '.join(places)}")


def rejected_points_note(tracks: Mapping[str, Track]) -> str:
    """Count the rejected points of tracks by trial in one sentence; blank where there are none."""
    # What lies before the frames that a person chose is flagged so too.
    counts = {name: with_flag(one.flag[np.argmax(one.usable) :], "rejected").sum() for name, one in tracks.items()}
    told = ", ".join(f"{count} of {name}" for name, count in counts.items() if count)
    return f"Points far off the motion around are left out: {told}." if told else ""


def _outlying(time_s: Floats, position_m: Floats, limit: float) -> Bools:
    """Points beyond the limit whose neighbours follow one cubic without them."""
    noise_m, _ = position_noise(time_s, position_m, robust=True)
    fit = local_fit(time_s, position_m, noise_m)
    sigma_m = np.maximum(np.maximum(local_noise(np.abs(fit.residual_m) / fit.gain), noise_m), fit.spread_m)
    distance_m = np.abs(fit.residual_m)
    step_m = np.abs(fit.speed_m_s) * float(np.median(np.diff(time_s)))
    lags = fit.residual_m * fit.speed_m_s < 0
    from_end = np.where(lags, np.arange(distance_m.size)[::-1], np.arange(distance_m.size))
    # Within this many points of an end the motion may have stopped or begun between two frames.
    allowance_m = np.where(from_end < 2, 1.5 * (from_end + 1) * step_m, 0.0)
    isolated = (fit.share >= LEAST_SHARE) & (fit.near >= 3) & (sigma_m > 0)
    return np.asarray((distance_m > limit * fit.gain * sigma_m + allowance_m) & isolated)


def _normal_solution(powers: Floats, weight: Floats, right: Floats) -> Floats:
    """Coefficients, (n_windows, 4), of weighted least squares with these right sides of the normal equations, which are
    scaled to a unit diagonal, with a ridge of 1e-10. Shapes: powers (n_windows, n_places, 4).
    """
    normal = np.swapaxes(powers * weight[..., None], 1, 2) @ powers
    scale = 1 / np.sqrt(np.diagonal(normal, axis1=1, axis2=2))
    scaled = normal * scale[:, :, None] * scale[:, None, :] + 1e-10 * np.eye(4)
    return np.asarray(np.linalg.solve(scaled, (right * scale)[..., None])[..., 0] * scale)


# ------------------------------------------------------------------------------
# How the noise of positions varies from point to point: with the speed of the edge, or as a file states it.
#
# A picture is exposed for a while, so a moving edge is blurred over speed × exposure, and its measured place scatters
# by a part of that: sd² = s² + (τ v)², with s of each trial and τ of the experiment. Or the file has a column of
# standard deviations, which need not have the right size but show which points are better: sd = s σ.
#
# Both are compared with equal noise by the likelihood of the fourth differences of the positions: the distance of a
# point from the cubic through the four around it, a stretch so short that fast motion leaves nothing in it. No model
# of the motion enters, so what a model misses cannot pass for noise.

FOURTH_DIFFERENCE = np.array([1.0, -4.0, 6.0, -4.0, 1.0])  # Weights of a fourth difference


@dataclass(frozen=True)
class NoiseShape:
    """Standard deviations of each trial's points, (n_points,); `blur_s` is τ, or 0 where they follow those stated."""

    sd_m: tuple[Floats, ...]
    blur_s: float


@dataclass(frozen=True)
class _Differences:
    """Fourth differences of a trial, m, scaled to the noise of a position; which are used; speeds, all (n_points,)."""

    distance_m: Floats
    use: np.ndarray
    speed_m_s: Floats


def noise_shape(
    time_s: Sequence[Floats], position_m: Sequence[Floats], stated_m: Sequence[Floats | None]
) -> NoiseShape | None:
    """Find how the noise of tracks varies; None where equal noise describes them as well. Shapes (n_points,) each."""
    if not time_s or min(times.size for times in time_s) < FEWEST_POINTS:
        return None
    differences = [_differences(t, y) for t, y in zip(time_s, position_m, strict=True)]
    # The noise of a trial is estimated from 20 fourth differences or more.
    if min(int(part.use.sum()) for part in differences) < 20:
        return None
    squares = [part.distance_m[part.use] ** 2 for part in differences]
    equal_noise = sum(square.size * (math.log(float(np.mean(square))) + 1) for square in squares)
    shapes = [result for result in (_by_speed(differences), _as_stated(differences, stated_m)) if result is not None]
    if not shapes:
        return None
    deviance, shape = min(shapes, key=lambda result: result[0])
    # Noise that varies is used if it is far more likely and, in the trial where they differ most, the standard
    # deviations of the noisiest and the quietest points differ by a quarter.
    ratio = max(float(np.quantile(sd, 0.95) / np.quantile(sd, 0.05)) for sd in shape.sd_m)
    return None if equal_noise - deviance < 28.0 or ratio < 1.25 else shape


def _differences(time_s: Floats, position_m: Floats) -> _Differences:
    """Fourth differences of a trial, winsorised, without those over uneven spacings or at corners of the motion."""
    noise_m, _ = position_noise(time_s, position_m, robust=True)
    fit = local_fit(time_s, position_m, noise_m)
    distance_m = np.zeros(time_s.size)
    distance_m[2:-2] = np.abs(np.convolve(position_m, FOURTH_DIFFERENCE, "valid")) / np.linalg.norm(FOURTH_DIFFERENCE)
    spacing = np.diff(time_s) / np.median(np.diff(time_s))
    even = np.zeros(time_s.size, dtype=bool)
    # Spacings in a fourth difference may differ by 5 % of a frame.
    even[2:-2] = np.lib.stride_tricks.sliding_window_view(np.abs(spacing - 1) < 0.05, 4).all(axis=1)
    around_m = local_noise(distance_m)
    # 1e-12: part of the travel below which differences are the rounding of a float (derived)
    use = even & (fit.share >= LEAST_SHARE) & (around_m > 1e-12 * np.ptp(position_m))
    # They are winsorised to 4 standard deviations of their surroundings.
    winsorised_m = np.minimum(distance_m, 4.0 * around_m)
    # The slope in one window is unreliable at a corner: the median of five is taken.
    speeds = np.lib.stride_tricks.sliding_window_view(np.pad(np.abs(fit.speed_m_s), 2, mode="edge"), 5)
    return _Differences(winsorised_m, use, np.median(speeds, axis=1))


def _by_speed(differences: Sequence[_Differences]) -> tuple[float, NoiseShape] | None:
    """−2 ln L of noise with the most likely τ and s of each trial, and its sd, by the updates of `_whittle`."""
    trial = np.repeat(np.arange(len(differences)), [np.count_nonzero(part.use) for part in differences])
    square = np.concatenate([part.distance_m[part.use] for part in differences]) ** 2
    speed_square = np.concatenate([part.speed_m_s[part.use] for part in differences]) ** 2
    if not speed_square.any():
        return None
    typical = np.bincount(trial, square) / np.bincount(trial)
    still, blur = typical, float(np.sum(square) / np.sum(speed_square))
    for _ in range(300):
        variance = still[trial] + blur * speed_square
        still = still * np.sqrt(np.bincount(trial, square / variance**2) / np.bincount(trial, 1 / variance))
        still = np.maximum(still, typical / 30**2)  # a few points rounded to one value are no sign of none (chosen)
        blur *= math.sqrt(float(speed_square @ (square / variance**2)) / float(speed_square @ (1 / variance)))
    variance = still[trial] + blur * speed_square
    sd_m = tuple(np.sqrt(part_s + blur * part.speed_m_s**2) for part_s, part in zip(still, differences, strict=True))
    return float(np.sum(np.log(variance) + square / variance)), NoiseShape(sd_m, math.sqrt(blur))


def _as_stated(
    differences: Sequence[_Differences], stated_m: Sequence[Floats | None]
) -> tuple[float, NoiseShape] | None:
    """−2 ln L of noise in proportion to the stated standard deviations; None where a trial states none."""
    deviance, sd_m = 0.0, []
    for part, stated in zip(differences, stated_m, strict=True):
        if stated is None:
            return None
        is_stated = np.isfinite(stated) & (stated > 0)
        # Nine tenths of a trial's points must have a stated standard deviation.
        if np.mean(is_stated) < 0.9:
            return None
        sigma = np.where(is_stated, stated, np.median(stated[is_stated]))
        # Expected size of a fourth difference, from the noise of its five points.
        weights = FOURTH_DIFFERENCE**2
        variance = np.convolve(np.pad(sigma**2, 2, mode="edge"), weights, "valid") / np.sum(weights)
        expected_m = np.sqrt(variance)[part.use]
        scale = math.sqrt(float(np.mean((part.distance_m[part.use] / expected_m) ** 2)))
        if not scale > 0:
            return None
        deviance += float(np.sum(2 * np.log(scale * expected_m) + 1))
        sd_m.append(scale * sigma)
    return deviance, NoiseShape(tuple(sd_m), 0.0)
