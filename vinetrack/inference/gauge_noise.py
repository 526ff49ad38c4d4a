"""Denoising of a recorded pressure, with the errors that remain.

The speed of a light vine follows the pressure immediately: 0.1 kPa of noise would move it by millimetres that it never
moved, and a noisy pressure crosses a threshold early, at a different time in every trial.

A trace is a constant and smooth functions of time and of the observed growth, since the pressure falls as the tube
fills and has its corner where growth begins: Gaussian processes (`vinetrack.inference.gaussian_processes`) on the scale
on which the pressure of an expanding gas is linear in the growth. Their size, how smooth they are, and what they depend
on are averaged over by the evidence of all traces of a campaign together: where all other pressures are constant, a
bend that one shows by chance counts as noise. The growth is seen as by the gauge, whose clock differs from that of the
camera and which may follow the pressure slowly. A trace that such functions do not explain is smoothed by a spline.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtri

from vinetrack.core.records import Floats, Track
from vinetrack.core.units import AMBIENT_PRESSURE_PA
from vinetrack.inference.gaussian_processes import (
    Posterior,
    posterior,
    product_of_modes,
    root_of_covariance,
    splines,
    whiten,
)
from vinetrack.tracks.position_noise import rough_noise

# ------------------------------------------------------------------------------
# The readings of a pressure gauge behind a recorded trace, and their noise.
#
# A gauge that is read a hundred times a second has fewer readings than a film has frames. Between them the trace is
# interpolated linearly or repeats the last value (sample and hold), so its noise is not independent from frame to
# frame.
# The same holds for a gauge behind a filter, and for the error left by rounding a quiet pressure to coarse steps. Each
# would look like a fluctuating pressure, which a light vine follows.

# Deviation of samples from a line drawn between readings, relative to the largest pressure, if the last digit is not
# coarser (derived)
EXACT_TOLERANCE = 1e-9

# Fraction of samples on a line through two others above which a trace counts as interpolated (chosen)
INTERPOLATED_PART = 0.25

NEGLIGIBLE_NOISE = 1e-4  # Noise below this fraction of the median pressure is rounding, and is not removed (chosen)

FEWEST_SAMPLES = 9  # Samples below which a trace does not determine its noise (derived)

# Least number of blocks into which a trace in coarse steps is divided, and least number of samples in each (chosen)
FEWEST_BLOCKS = 4

NOISE_DEGREES = 2 / 4.62  # Degrees of freedom of the noise variance per sample (derived)

COMPARED_LAG = 4  # Lag at which noise is compared with that of neighbouring readings (chosen)


@dataclass(frozen=True)
class GaugeNoise:
    """Noise of a gauge: innovation standard deviation, Pa; degrees of freedom of its variance; lag-one correlation."""

    sigma_Pa: float
    degrees: float
    rho: float


@dataclass(frozen=True)
class Readings:
    """Readings of a gauge during a trace, Pa, and their places, in samples from the first; standard deviation of their
    rounding error. With `edges` they are means of the samples between these, and rounding is all their noise.
    """

    places: Floats
    values_Pa: Floats
    rounding_Pa: float = 0.0
    edges: NDArray[np.intp] | None = None


def gauge_readings(traces: Sequence[Floats]) -> list[Readings]:
    """Readings of a gauge: the samples of a trace, or those between which it was interpolated or held."""
    found = [_interpolated_readings(pressure_Pa) for pressure_Pa in traces]
    scatter_digits = [digits for *_, digits in filter(None, found)]
    # Samples rounded to steps coarser than their noise lie on lines for that reason alone.
    # 2.0: least median scatter, in last digits, of the readings found in traces (measured)
    interpolated = bool(scatter_digits) and float(np.median(scatter_digits)) >= 2.0
    return [
        # Readings have the rounding error that follows from their own resolution.
        Readings(one[0], one[1], _resolution(one[1]) / math.sqrt(12))
        if interpolated and one is not None
        else _samples_as_readings(pressure_Pa)
        for one, pressure_Pa in zip(found, traces, strict=True)
    ]


def _samples_as_readings(pressure_Pa: Floats) -> Readings:
    """Samples as readings; where they are in steps coarser than their noise, means of blocks of samples. The rounding
    errors of such samples are correlated over as many samples as the pressure takes for one step.
    """
    count = pressure_Pa.size
    plain = Readings(np.arange(float(count)), pressure_Pa)
    rounding_Pa = _resolution(pressure_Pa) / math.sqrt(12)
    if rounding_Pa <= NEGLIGIBLE_NOISE * abs(float(np.median(pressure_Pa))) or count < FEWEST_SAMPLES:
        return plain
    if white_noise_sd(pressure_Pa) >= rounding_Pa:
        return replace(plain, rounding_Pa=rounding_Pa)
    steps = float(np.ptp(pressure_Pa)) / (math.sqrt(12) * rounding_Pa) + 1
    blocks = max(round(steps), FEWEST_BLOCKS)
    if blocks * FEWEST_BLOCKS > count:
        return plain
    edges = np.round(np.linspace(0, count, blocks + 1)).astype(int)
    means_Pa, middles = np.add.reduceat(pressure_Pa, edges[:-1]) / np.diff(edges), 0.5 * (edges[:-1] + edges[1:] - 1)
    return Readings(middles, means_Pa, rounding_Pa * math.sqrt(blocks / steps), edges)


def _interpolated_readings(pressure_Pa: Floats) -> tuple[Floats, Floats, float] | None:
    """Places and values of the readings of an interpolated or held trace and their scatter in last digits; None if it
    is neither.
    """
    steps, digit_Pa = np.abs(np.diff(pressure_Pa)), _resolution(pressure_Pa)
    if pressure_Pa.size < 4 or not steps.any():
        return None
    still = np.mean(steps == 0.0) > INTERPOLATED_PART
    if still and (held := _sample_and_hold_readings(pressure_Pa, digit_Pa)) is not None:
        return *held, math.inf
    begins = _straight_runs(pressure_Pa, max(0.5 * digit_Pa, EXACT_TOLERANCE * float(np.max(np.abs(pressure_Pa)))))
    within = np.diff(begins, append=pressure_Pa.size) - 2
    if begins.size == 1 or np.sum(np.maximum(within, 0)) < INTERPOLATED_PART * pressure_Pa.size:
        return None
    places, values_Pa = _line_intersections(pressure_Pa, begins)
    return places, values_Pa, rough_noise(values_Pa) / digit_Pa if digit_Pa > 0 else math.inf


def _resolution(pressure_Pa: Floats) -> float:
    """The largest step, Pa, of which all pressures are multiples, by Euclid's algorithm; 0 without one."""
    exact_Pa = EXACT_TOLERANCE * float(np.max(np.abs(pressure_Pa)))
    remainders = np.unique(np.abs(pressure_Pa - pressure_Pa[0]))
    remainders = remainders[remainders > exact_Pa]
    while remainders.size > 1:
        smallest = remainders[0]
        remainder = np.mod(remainders, smallest)
        remainder = np.unique(np.minimum(remainder, smallest - remainder))
        remainders = np.concatenate([remainder[remainder > exact_Pa], [smallest]])
    return float(remainders[0]) if remainders.size and remainders[0] > 2 * exact_Pa else 0.0


def _straight_runs(values: Floats, reach: float) -> NDArray[np.intp]:
    """First samples of maximal runs that a straight line fits to within `reach`. A line through intervals exists if the
    ranges of slopes that each pair of them allows have a common value.
    """
    begins = [0]
    low, high = -math.inf, math.inf
    for j in range(1, values.size):
        distance = np.arange(j - begins[-1], 0, -1)
        rise = values[j] - values[begins[-1] : j]
        low = max(low, float(np.max((rise - 2 * reach) / distance)))
        high = min(high, float(np.min((rise + 2 * reach) / distance)))
        if low > high:
            begins.append(j)
            low, high = -math.inf, math.inf
    return np.array(begins)


def _sample_and_hold_readings(pressure_Pa: Floats, digit_Pa: float) -> tuple[Floats, Floats] | None:
    """Readings that are held until the next one; each was read up to a sample before it first appears. In coarse steps
    many readings equal the previous one: they follow from the even period of those that differ. None if the trace is
    not held.
    """
    steps = np.diff(pressure_Pa)
    changes = np.flatnonzero(steps) + 1
    continues = (np.abs(np.diff(steps)) <= 2 * digit_Pa) & (steps[1:] != 0) & (steps[:-1] != 0)
    if np.mean(continues) > INTERPOLATED_PART / 2:
        return None
    if np.median(np.abs(steps[changes - 1])) > 1.5 * digit_Pa:
        places = np.concatenate([[0.0], changes - 0.5])
        # The trace does not show when its first value was read.
        if places.size > 2:
            places[0] = min(0.0, places[1] - float(np.median(np.diff(places)[1:])))
        return places, pressure_Pa[[0, *changes]]
    if (found := _sampling_period(changes.astype(float) - 0.5)) is None:
        return None
    first, period = found
    places = np.arange(first - math.ceil(first / period) * period, pressure_Pa.size - 1.0, period)
    middle = np.clip(np.round(places + 0.5 * period), 0, pressure_Pa.size - 1).astype(int)
    return places, pressure_Pa[middle]


def _sampling_period(instants: Floats) -> tuple[float, float] | None:
    """First instant and period, samples, of a regular grid that contains all the instants; None if there is none."""
    # Samples by which a change may deviate from the even sampling period of a gauge (derived)
    period_tolerance, period_false_alarm = 0.75, 1e-4
    gaps = np.diff(instants)
    if gaps.size < 3 or gaps.min() < 2:
        return None
    period = float(gaps.min())
    # Refine the period from short gaps to long ones, so that the number of periods in a gap is never miscounted.
    for longest in (1.5, 4.0, 12.0, math.inf):
        short_gaps = gaps <= longest * period
        period = float(np.sum(gaps[short_gaps]) / np.sum(np.round(gaps[short_gaps] / period)))
    periods = np.concatenate([[0.0], np.cumsum(np.round(gaps / period))])
    slope, first = np.polyfit(periods, instants, 1)
    uneven = np.max(np.abs(instants - first - slope * periods)) > period_tolerance
    by_chance = gaps.size * math.log(slope / (2 * period_tolerance)) < -math.log(period_false_alarm)
    return None if uneven or by_chance else (float(first), float(slope))


def _line_intersections(pressure_Pa: Floats, begins: NDArray[np.intp]) -> tuple[Floats, Floats]:
    """Readings that were interpolated linearly: the intersections of lines through neighbouring runs of samples.
    `begins` are the first samples of the runs. A trace begins and ends between two readings: the readings outside it
    are the values of its first and last line after the typical spacing.
    """
    lines: list[tuple[float, float]] = []
    for begin, end in itertools.pairwise([*begins, pressure_Pa.size]):
        at = np.arange(begin, end)
        # A single sample gets the slope of the previous line.
        slope = np.polyfit(at, pressure_Pa[at], 1)[0] if at.size > 1 else lines[-1][0]
        lines.append((slope, float(np.mean(pressure_Pa[at])) - slope * float(np.mean(at))))
    places, values = [], []
    for begin, (slope, at_0), (next_slope, next_at_0) in zip(begins[1:], lines, lines[1:], strict=False):
        intersection = (next_at_0 - at_0) / (slope - next_slope) if slope != next_slope else begin - 0.5
        places.append(place := float(np.clip(intersection, begin - 1, begin)))
        values.append(0.5 * (slope * place + at_0 + next_slope * place + next_at_0))
    spacing, ends = float(np.median(np.diff(places))) if len(places) > 1 else 0.0, []
    for inner, end, (slope, at_0) in ((places[0], 0.0, lines[0]), (places[-1], pressure_Pa.size - 1.0, lines[-1])):
        shown_length = abs(end - inner)
        # A line longer than the typical spacing contains a further reading.
        place = inner + math.copysign(max(spacing, shown_length), end - inner)
        # 0.25: fraction of a line that must be visible at an end of a trace to determine the reading that it
        # leads to (chosen)
        ends.append([(place, slope * place + at_0)] if shown_length >= 0.25 * spacing and shown_length > 0 else [])
    readings = np.array([*ends[0], *zip(places, values, strict=True), *ends[1]])
    return readings[:, 0], readings[:, 1]


def white_noise_sd(pressure_Pa: Floats) -> float:
    """Standard deviation of white noise on a smooth curve, from third differences; their variance is 20 σ². Differences
    beyond three standard deviations, such as at a corner, are clipped (Winsorised).
    """
    third = np.diff(pressure_Pa, 3) / math.sqrt(20)
    sigma = rough_noise(pressure_Pa)
    # 3: iterations, of which the last changes the noise by 1e-4; 0.9950: part of the variance of normal noise that
    # remains once differences are clipped at 3.0 standard deviations (derived: 0.9707 + 9 · 0.0027)
    for _ in range(3):
        sigma = math.sqrt(float(np.mean(np.minimum(third**2, (3.0 * sigma) ** 2))) / 0.9950)
    return sigma


def noise_of_traces(readings: Sequence[Readings], rho: float) -> list[GaugeNoise]:
    """Noise of every trace, shrunk towards that of other traces of the gauge; 0 if negligible or undetermined."""
    own_sigma = [
        white_noise_sd(whitened(each.values_Pa, rho)[1:] if rho else each.values_Pa)
        if each.values_Pa.size >= FEWEST_SAMPLES and each.edges is None
        else math.nan
        for each in readings
    ]
    known_sigmas = [sigma for sigma in own_sigma if sigma > 0]
    typical = float(np.median(known_sigmas)) if len(known_sigmas) > 1 else 0.0
    noises = []
    for sigma, each in zip(own_sigma, readings, strict=True):
        if each.edges is not None:
            # 1e6: degrees of freedom of a noise that is derived instead of estimated
            noises.append(GaugeNoise(each.rounding_Pa, 1e6, 0.0))
            continue
        own_degrees = NOISE_DEGREES * (each.values_Pa.size - 2.5) if math.isfinite(sigma) else 0.0
        # 3: samples below which a trace is left unchanged although other traces determine the noise (derived)
        # 20.0: degrees of freedom that the other traces of a campaign add to the noise of a trace (chosen)
        degrees_of_others = 20.0 if typical > 0 and sigma != 0 and each.values_Pa.size >= 3 else 0.0
        degrees = own_degrees + degrees_of_others
        squares = degrees_of_others * typical**2 + (own_degrees * sigma**2 if own_degrees else 0.0)
        pooled_sigma = max(math.sqrt(squares / degrees), each.rounding_Pa) if degrees else 0.0
        negligible = pooled_sigma <= NEGLIGIBLE_NOISE * abs(float(np.median(each.values_Pa)))
        noises.append(GaugeNoise(0.0 if negligible else pooled_sigma, degrees, rho))
    return noises


def noise_correlations(traces: Sequence[Floats]) -> list[float]:
    """Lag-one correlations that the noise of readings may have, the same in all traces: an estimate, others within two
    of its standard errors, and 0; that alone unless the estimate is significantly positive. If noise is correlated,
    third differences of readings COMPARED_LAG apart are larger than those of neighbours. A changing pressure has slow
    differences too, but not in most traces: the median over traces is used.
    """
    ratios, counts = [], []
    for readings_Pa in traces:
        distant = [readings_Pa[begin::COMPARED_LAG] for begin in range(COMPARED_LAG)]
        neighbour_sigma = white_noise_sd(readings_Pa) if distant[-1].size >= FEWEST_SAMPLES else 0.0
        if neighbour_sigma > NEGLIGIBLE_NOISE * abs(float(np.median(readings_Pa))):
            variance_ratio = float(np.mean([white_noise_sd(each) ** 2 for each in distant])) / neighbour_sigma**2
            ratios.append(math.log(max(variance_ratio, NEGLIGIBLE_NOISE)))  # Distant readings may all be equal.
            counts.append(readings_Pa.size)
    if not ratios:
        return [0.0]
    sigma, ratio = math.sqrt(4 / NOISE_DEGREES * COMPARED_LAG / sum(counts)), float(np.median(ratios))
    # 3.0: standard deviations from which the noise of distant readings shows a correlation (chosen)
    if ratio < 3.0 * sigma:
        return [0.0]
    rhos = np.linspace(0.0, 0.97, 98)
    # Variances of third differences of such noise, relative to those of white noise
    far, near = (1 - 1.5 * rho + 0.6 * rho**2 - 0.1 * rho**3 for rho in (rhos**COMPARED_LAG, rhos))
    told = np.log(far / near)
    nearby = sigma * np.array([0.0, -0.5, 0.5, -1.0, 1.0, -1.5, 1.5, -2.0, 2.0])
    return [*np.interp(ratio + nearby, told, rhos).tolist(), 0.0]


def whitened(values: Floats, rho: float) -> Floats:
    """Readings, or columns of curves through them, whitened for noise of the given lag-one correlation."""
    return whiten(values, np.arange(len(values)) == 0, rho)


# ------------------------------------------------------------------------------
# Curves through the readings: a constant and smooth functions of time and of growth.

GAMMA = 1.2  # Exponent with which a chamber empties into the tube, between isothermal and adiabatic (derived)

TIME_SPLINES, GROWTH_SPLINES = 24, 12  # Splines over the time of a trace and over its growth (chosen)


@dataclass(frozen=True)
class DenoisedTrace:
    """A recorded pressure without its noise, shape (n,): standard deviation of its mean, 0 where the trace was left
    unchanged, and one of each other error of the curve, columns of shape (n, n_errors).
    """

    time_s: Floats
    pressure_Pa: Floats
    mean_error_Pa: float
    errors_Pa: Floats

    def extended(self) -> DenoisedTrace:
        """The trace with one more sample beyond its end, along the line through its last part. If the clock of the
        gauge is behind that of the camera, the last frames were filmed under a pressure that was not recorded any more.
        """
        last_s, span_s = self.time_s[-1], np.ptp(self.time_s)
        # 0.1, 0.2: last part of a trace whose line extrapolates it, and by how much (measured)
        late = self.time_s >= last_s - 0.1 * span_s
        if np.count_nonzero(late) < 2:
            return self
        curves = np.column_stack([self.pressure_Pa, self.errors_Pa])
        beyond_s = 0.2 * span_s
        end = curves[-1] + np.polyfit(self.time_s[late] - last_s, curves[late], 1)[0] * beyond_s
        # A falling gauge pressure does not fall below zero.
        end[0] = max(end[0], min(curves[-1, 0], 0.0))
        curves = np.vstack([curves, end])
        return DenoisedTrace(np.append(self.time_s, last_s + beyond_s), curves[:, 0], self.mean_error_Pa, curves[:, 1:])

    def thinned(self) -> DenoisedTrace:
        """The samples from which lines give all others, since a simulation stops at each (Ramer, Computer Graphics and
        Image Processing 1, 244, 1972).
        """
        curves = np.column_stack([self.pressure_Pa, self.errors_Pa])
        kept, spans = {0, len(curves) - 1}, [(0, len(curves) - 1)]
        while spans:
            begin, end = spans.pop()
            part = (self.time_s[begin : end + 1] - self.time_s[begin]) / (self.time_s[end] - self.time_s[begin])
            line = curves[begin] + part[:, None] * (curves[end] - curves[begin])
            distance_Pa = np.max(np.abs(curves[begin : end + 1] - line), axis=1)
            farthest = begin + int(np.argmax(distance_Pa))
            # 1e-5: distance from a line, relative to the median pressure, that no position shows (derived)
            if distance_Pa[farthest - begin] > 1e-5 * abs(float(np.median(self.pressure_Pa))):
                kept.add(farthest)
                spans += [(begin, farthest), (farthest, end)]
        places = sorted(kept)
        return DenoisedTrace(self.time_s[places], curves[places, 0], self.mean_error_Pa, curves[places, 1:])


@dataclass(frozen=True)
class Growth:
    """Growth of a trial at all samples of its trace, m, shape (n,), and their spacing, s."""

    grown_m: Floats
    frame_s: float

    def lagging(self, lag_s: float) -> Growth:
        """The growth that a gauge with this time constant shows; of a negative one as far ahead."""
        if lag_s == 0:
            return self
        lag, rate_m = abs(lag_s) / self.frame_s, np.diff(self.grown_m, prepend=self.grown_m[0])
        # 12: time constants after which a gauge has forgotten a step (chosen)
        memory = np.exp(-np.arange(min(math.ceil(12 * lag) + 1, rate_m.size)) / lag)
        behind_m = lag * (1 - math.exp(-1 / lag)) * np.convolve(rate_m, memory)[: rate_m.size]
        return replace(self, grown_m=self.grown_m - math.copysign(1.0, lag_s) * behind_m)

    def at(self, places: Floats) -> Floats:
        """Growth at places among the samples, m; constant before them, and beyond them at the speed of the last."""
        last = self.grown_m.size - 1
        late = max(last // 10, 1)
        per_sample_m = max(float(self.grown_m[last] - self.grown_m[last - late]) / late, 0.0)
        inside = np.interp(places, np.arange(last + 1), self.grown_m)
        return np.asarray(inside + per_sample_m * np.maximum(places - last, 0.0))


@dataclass(frozen=True)
class Recorded:
    """A trace to be denoised: readings, number of samples, noise; growth, None where unknown."""

    readings: Readings
    count: int
    noise: GaugeNoise
    growth: Growth | None

    @property
    def typical_Pa(self) -> float:
        """Absolute pressure at which the scale of `part` is 1."""
        return max(float(np.median(self.readings.values_Pa)), -0.5 * AMBIENT_PRESSURE_PA) + AMBIENT_PRESSURE_PA

    @property
    def part(self) -> Floats:
        """Readings on the scale on which those of a chamber emptying into the tube are linear in the growth."""
        absolute = np.maximum(self.readings.values_Pa + AMBIENT_PRESSURE_PA, 0.1 * AMBIENT_PRESSURE_PA)
        return np.asarray((absolute / self.typical_Pa) ** (-1 / GAMMA))

    def at_samples(self, clock_s: Floats) -> Floats:
        """Splines in time and in growth at all samples, shape (n_samples, n_splines), by a clock, see `GaugeClock`."""
        return self._splines(np.arange(float(self.count)), clock_s)

    def at_readings(self, clock_s: Floats) -> Floats:
        """The same at the readings, shape (n_readings, n_splines)."""
        if (edges := self.readings.edges) is not None:
            return np.asarray(np.add.reduceat(self.at_samples(clock_s), edges[:-1]) / np.diff(edges)[:, None])
        return self._splines(self.readings.places, clock_s)

    def _splines(self, where: Floats, clock_s: Floats) -> Floats:
        places = self.readings.places
        in_time = splines((where - places[0]) / (places[-1] - places[0]), TIME_SPLINES)
        in_growth = np.zeros((where.size, GROWTH_SPLINES))
        if self.growth is not None:
            shown, offset = self.growth.lagging(clock_s[1]), clock_s[0] / self.growth.frame_s
            seen_m = shown.at(places + offset)
            if np.ptp(seen_m) > 0:
                in_growth = splines((shown.at(where + offset) - seen_m[0]) / np.ptp(seen_m), GROWTH_SPLINES)
        return np.hstack([in_time, in_growth])

    def equations(self, clock_s: Floats) -> Floats:
        """Triangular factor of the whitened columns constant, splines, readings, in units of the noise, which the scale
        of `part` makes larger where the pressure is high.
        """
        columns = np.column_stack([np.ones(self.part.size), self.at_readings(clock_s), -GAMMA * self.part])
        noise = self.noise.sigma_Pa / self.typical_Pa * self.part ** (GAMMA + 1)
        white = whitened(columns / noise[:, None], self.noise.rho)
        return np.asarray(np.linalg.qr(np.vstack([white, np.zeros((columns.shape[1], columns.shape[1]))]), mode="r"))


@cache
def kinds_of_curves() -> tuple[list[Floats], ...]:
    """Modes of the coefficients of the splines, in time, in growth, and in both, for every way in which a pressure may
    change. A chamber that empties gives a line in the growth, bent a little.
    """
    line, over_time = ((np.arange(count)[:, None] - 1.0) / (count - 3) for count in (GROWTH_SPLINES, TIME_SPLINES))
    bent, smooth = (
        product_of_modes([root_of_covariance(GROWTH_SPLINES, length, zero_at_start=True)]) for length in (0.25, 0.8)
    )
    lengths = (0.05, 0.08, 0.14, 0.25, 0.45, 0.8)  # in time, parts of a trace (chosen)
    in_time = [over_time, *(product_of_modes([root_of_covariance(TIME_SPLINES, length)]) for length in lengths)]
    # 0.01, 0.1: by how much a chamber's pressure departs from the line, as a part of its fall (chosen)
    in_growth = [np.hstack([line, 0.01 * smooth]), np.hstack([line, 0.1 * smooth]), smooth, bent]
    time = [np.vstack([modes, np.zeros((GROWTH_SPLINES, modes.shape[1]))]) for modes in in_time]
    growth = [np.vstack([np.zeros((TIME_SPLINES, modes.shape[1])), modes]) for modes in in_growth]
    both = [np.hstack([modes, growth[1]]) for modes in (time[0], *time[-3:])]
    return time, growth, both


def curves_of(factors: Floats, *kinds: Sequence[Floats]) -> tuple[Floats, Posterior]:
    """Products of splines and readings, (n_traces, q + 1, q + 1), the constant eliminated, and the posterior of the
    coefficients over kinds of curves, each sort with the same odds, and no curve, since a regulator keeps most
    pressures constant, with those of all together.
    """
    rows = factors[:, 1:, 1:]
    products = np.swapaxes(rows, 1, 2) @ rows
    log_odds = [math.log(len(kinds)), *(-math.log(len(sort)) for sort in kinds for _ in sort)]
    # Amplitudes of the smooth functions, parts of the absolute pressure (chosen)
    amplitudes = np.geomspace(1e-6, 0.3, 16)
    modes = [np.zeros((rows.shape[2] - 1, 1)), *itertools.chain(*kinds)]
    return products, posterior(products[:, :-1, :-1], products[:, :-1, -1], modes, amplitudes, log_odds)


@dataclass(frozen=True)
class GaugeClock:
    """Delay from a reading to the growth that belongs to it, and time constant with which the gauge follows, s, shape
    (2,), the same in all traces; and independent errors of both, of a standard deviation each, shape (n_errors, 2).
    """

    at_s: Floats
    errors_s: Floats


def gauge_clock(traces: Sequence[Recorded]) -> GaugeClock:
    """The likeliest clock by the evidence of curves in growth, and its errors by the parabola through it there; without
    a lag unless its own evidence, integrated over it, is higher (Laplace).
    """
    # 24: traces that tell the clock (chosen)
    telling = [trace for trace in traces if trace.growth is not None][:: len(traces) // 24 + 1]
    if not telling:
        return GaugeClock(np.zeros(2), np.zeros((0, 2)))
    frame_s = float(np.median([trace.growth.frame_s for trace in telling if trace.growth]))
    _, growth, both = kinds_of_curves()

    @cache
    def evidence(clock: tuple[float, float]) -> float:
        """Log evidence of delay and lag, frames, with their prior: few are more than 30 frames (chosen)."""
        factors = np.array([trace.equations(frame_s * np.array([clock[0], abs(clock[1])])) for trace in telling])
        return curves_of(factors, growth[:2], both)[1].log_evidence - 0.5 * (clock[0] ** 2 + clock[1] ** 2) / 30.0**2

    def top(begins: Iterable[tuple[float, float]], lags: Sequence[int]) -> tuple[Floats, Floats]:
        """The clock of highest evidence near the best beginning, and its errors, frames."""
        at, step, free = max(begins, key=evidence), 2.0, np.array([1, len(lags) > 1])
        # Compass search, down to steps over which a parabola holds: ln L falls by 4 at most, or 1/64 frame (chosen)
        while True:
            ways = np.array([*itertools.product((0, -1, 1), lags)], dtype=float)
            around = [(at[0] + a * step, at[1] + b * step) for a, b in ways.tolist()]
            before, at = at, max(around, key=evidence)
            if at == before and (evidence(at) - min(map(evidence, around)) < 4 or step <= 1 / 64):
                break
            step = step / 2 if at == before else step
        a, b = ways.T
        square = np.column_stack([a**2, a * b, b**2, a, b, np.ones(a.size)])
        aa, ab, bb, *slope, _ = np.linalg.lstsq(square, [evidence(clock) for clock in around])[0]
        sharpness, axes = np.linalg.eigh([[-2 * aa, -ab], [-ab, -2 * bb]])
        sharpness = np.maximum(sharpness, (step / 30.0) ** 2)
        shift = np.clip(axes @ (axes.T @ slope / sharpness), -1, 1)
        return at + step * shift * free, step * (axes / np.sqrt(sharpness)).T * free

    # 60, 4; 2 to 24: delays and lags from which the search begins, frames (chosen)
    prompt = top(((delay, 0.0) for delay in range(-60, 61, 4)), (0,))
    delays = prompt[0][0] + np.array([-4, 0, 4])
    slow = top([(delay + lag, lag) for lag in (2.0, 4.0, 8.0, 16.0, 24.0) for delay in delays.tolist()], (0, -1, 1))
    of_lag = math.log(abs(np.linalg.det(slow[1])) / (15.0 * np.linalg.norm(prompt[1])))  # half of its prior's width
    at, errors = slow if evidence(tuple(slow[0])) + of_lag > evidence(tuple(prompt[0])) else prompt
    return GaugeClock(frame_s * at, frame_s * errors)


def denoised_traces(tracks: Sequence[Track]) -> list[DenoisedTrace | None]:
    """Recorded pressures of the trials of a campaign without gauge noise; None for trials without a trace."""
    raw: dict[int, DenoisedTrace] = {}
    growths: list[Growth | None] = []
    for i, track in enumerate(tracks):
        if track.pressure_Pa is None:
            continue
        known = np.isfinite(track.pressure_Pa) & np.isfinite(track.time_s)
        if np.count_nonzero(known) < 2:
            continue
        time_s, pressure_Pa = track.time_s[known].astype(float), track.pressure_Pa[known].astype(float)
        raw[i] = DenoisedTrace(time_s, pressure_Pa, 0.0, np.zeros((time_s.size, 0)))
        in_track = track.usable & np.isfinite(track.lead_position_m) & np.isfinite(track.time_s)
        growths.append(None)
        if np.count_nonzero(in_track) > 1:
            grown_m = np.interp(time_s, track.time_s[in_track], track.lead_position_m[in_track])
            growths[-1] = Growth(grown_m, float(np.median(np.diff(time_s))))
    places, traces = list(raw), list(raw.values())
    read = gauge_readings([trace.pressure_Pa for trace in traces])
    correlations = noise_correlations([readings.values_Pa for readings in read if readings.edges is None])
    noises = [noise_of_traces(read, rho) for rho in correlations]
    noisy = [k for k in range(len(read)) if min(of_all[k].sigma_Pa for of_all in noises) > 0]
    if noisy:
        counts = [trace.time_s.size for trace in traces]
        recorded = [[Recorded(read[k], counts[k], of_all[k], growths[k]) for k in noisy] for of_all in noises]
        # A pressure that changes between readings can pass for a correlation of their noise: the evidence decides, that
        # of traces which curves explain.
        clock = gauge_clock(recorded[0])
        excess = Curves(recorded[0], clock).excess
        telling = np.flatnonzero((excess <= 1) | (excess.min() > 1)).tolist()
        possible = (Curves([of_all[k] for k in telling], clock) for of_all in recorded)
        curves = max(possible, key=lambda each: each.log_likelihood)
        smooth = {k: one for k, one, excess in zip(telling, curves.all(), curves.excess, strict=True) if excess <= 1}
        for k, (place, trace) in enumerate(zip(noisy, recorded[0], strict=True)):
            quiet = smooth[k] if k in smooth else _splined(trace, clock)
            raw[places[place]] = DenoisedTrace(traces[place].time_s, *quiet)
    return [raw.get(i) for i in range(len(tracks))]


class Curves:
    """The curves through the readings of traces, given their noise; `log_likelihood` is that of the readings, with the
    curves integrated out; `excess` is what they leave, in units of what noise may leave (F test).
    """

    def __init__(self, traces: Sequence[Recorded], clock: GaugeClock) -> None:
        self.traces, self.clock = traces, clock
        self.factors = np.array([trace.equations(clock.at_s) for trace in traces])
        products, self.found = curves_of(self.factors, *kinds_of_curves())
        information, score, squares = products[:, :-1, :-1], products[:, :-1, -1], products[:, -1, -1]
        explained = 2 * score - np.einsum("nkl,nl->nk", information, self.found.mean)
        left = squares - np.sum(self.found.mean * explained, axis=1)
        degrees = np.array([trace.readings.values_Pa.size - 1 for trace in traces])
        # 1e-5: probability with which pure noise leaves more than is accepted (chosen)
        largest = degrees * fdtri(degrees, [trace.noise.degrees for trace in traces], 1 - 1e-5)
        # None where the scale of curves ends
        ends = [np.min(trace.readings.values_Pa) < -0.9 * AMBIENT_PRESSURE_PA for trace in traces]
        self.excess = left / np.where(ends, 1e-300, largest)
        scales = np.array([math.log(trace.noise.sigma_Pa) * trace.readings.places.size for trace in traces])
        correlated = 0.5 * np.log1p([-(trace.noise.rho**2) for trace in traces])
        without = correlated - scales - np.log(np.abs(self.factors[:, 0, 0])) - 0.5 * squares
        self.log_likelihood = float(np.sum(without)) + self.found.log_evidence

    def all(self) -> Iterator[tuple[Floats, float, Floats]]:
        """Of every trace pressure at all samples, standard deviation of its mean, and of each other error, columns."""
        found = (self.found.mean, self.found.covariance)
        for trace, factor, mean, covariance in zip(self.traces, self.factors, *found, strict=True):
            constant = factor[0, -1] / factor[0, 0]
            at_samples = trace.at_samples(self.clock.at_s) - factor[0, 1:-1] / factor[0, 0]
            part = np.maximum(-(constant + at_samples @ mean) / GAMMA, 0.01)
            variances, vectors = np.linalg.eigh(covariance)
            by_clock = [
                0.5 * (trace.at_samples(self.clock.at_s + off_s) - trace.at_samples(self.clock.at_s - off_s)) @ mean
                for off_s in self.clock.errors_s
            ]
            errors = np.column_stack([
                np.full(part.size, 1 / factor[0, 0]),
                at_samples @ (vectors * np.sqrt(np.maximum(variances, 0.0))),
                *by_clock,
            ])  # fmt: skip
            errors_Pa = (trace.typical_Pa * part ** (-GAMMA - 1))[:, None] * errors
            means_Pa = errors_Pa.mean(axis=0)
            least_Pa = NEGLIGIBLE_NOISE * abs(float(np.median(trace.readings.values_Pa)))
            pressure_Pa = trace.typical_Pa * part**-GAMMA - AMBIENT_PRESSURE_PA
            yield pressure_Pa, float(np.linalg.norm(means_Pa)), _principal_errors(errors_Pa - means_Pa, least_Pa)


def _splined(trace: Recorded, clock: GaugeClock) -> tuple[Floats, float, Floats]:
    """A trace that no smooth function explains, by a smoothing spline with knots where the pressure bends (Dierckx, IMA
    J. Numer. Anal. 1, 267, 1981); of fewer than five readings lines. Its errors are those of the curve through it
    alone, as much larger as that leaves more than noise.
    """
    from scipy.interpolate import UnivariateSpline

    places, values_Pa = trace.readings.places, trace.readings.values_Pa
    # White noise is assumed: a changing pressure can mimic a correlation of the noise.
    white_Pa = white_noise_sd(values_Pa) if values_Pa.size >= FEWEST_SAMPLES else 0.0
    # 0.85: part of the squares of the noise that the spline leaves, the rest for its knots (measured)
    order, left = (1, 0.0) if places.size < 5 else (3, 0.85 * places.size)
    weights = np.full(places.size, 1 / (white_Pa or trace.noise.sigma_Pa))
    # ext=3: constant beyond the readings, from which a cubic runs away
    spline, alone = UnivariateSpline(places, values_Pa, weights, k=order, s=left, ext=3), Curves([trace], clock)
    ((_, mean_error_Pa, errors_Pa),) = alone.all()
    larger = math.sqrt(max(float(alone.excess[0]), 1.0))
    return np.asarray(spline(np.arange(float(trace.count)))), mean_error_Pa, larger * errors_Pa


def _principal_errors(errors_Pa: Floats, least_Pa: float) -> Floats:
    """The same error covariance in as few columns as possible, by principal components; none of less than so much."""
    directions, sizes_Pa, _ = np.linalg.svd(errors_Pa, full_matrices=False)
    # 1e-2: part of the total error variance of a curve below which a principal direction is dropped (chosen)
    kept = sizes_Pa**2 > max(1e-2 * float(np.sum(sizes_Pa**2)), least_Pa**2 * len(errors_Pa))
    return np.asarray((directions * sizes_Pa)[:, kept])
