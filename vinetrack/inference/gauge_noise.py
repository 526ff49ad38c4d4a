"""Denoising of a recorded pressure that preserves its corners, with the errors that remain.

The speed of a light vine follows the pressure immediately: 0.1 kPa of noise would move it by millimetres that it never
moved, and a noisy pressure crosses a threshold early, at a different time in every trial.

Where a few parameters explain a trace, a curve is fitted: a polynomial in time; or, since the pressure falls as the
tube fills and has its corner where growth begins, a polynomial in time and in the observed growth, shifted by the clock
offset of gauge and camera, on the scale on which the pressure of an expanding gas is linear in the growth. Of the
curves that leave only noise, that of least BIC is taken (Schwarz, Ann. Stat. 6, 461, 1978): a superfluous term bends
the speed through the whole trial, at 0.1 kPa of noise by more than its position errors. The frequency of each kind of
curve in the campaign is estimated too and used as a prior (empirical Bayes: Robbins, Proc. 3rd Berkeley Symp. 1, 157,
1956). Any other trace is smoothed by a spline.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.polynomial.legendre import legvander
from numpy.typing import NDArray

from vinetrack.core.records import Floats, Track
from vinetrack.core.units import AMBIENT_PRESSURE_PA
from vinetrack.inference.whitening import whiten
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


# Lag at which noise is compared with that of neighbouring readings, and its largest correlation (chosen)
COMPARED_LAG, LARGEST_CORRELATION = 4, 0.97


@dataclass(frozen=True)
class GaugeNoise:
    """Noise of a gauge: innovation standard deviation, Pa; degrees of freedom of its variance; lag-one correlation."""

    sigma_Pa: float
    degrees: float
    rho: float


@dataclass(frozen=True)
class Readings:
    """Readings of a gauge during a trace, Pa, and their places, in samples from the first; both of shape (n,).
    `rounding_Pa` is the standard deviation of the rounding error, 0 where nothing is rounded. Where the readings are
    `all_noise`, their scatter does not determine the noise.
    """

    places: Floats
    values_Pa: Floats
    rounding_Pa: float = 0.0
    all_noise: bool = False
    edges: NDArray[np.intp] | None = None

    def means_of(self, curves: Floats) -> Floats:
        """Block means of curves given at all samples, where the readings are such means. Shapes: curves (n_samples, …)
        → (n, …).
        """
        assert self.edges is not None
        sums = np.add.reduceat(curves, self.edges[:-1], axis=0)
        counts = np.diff(self.edges).reshape(-1, *(1,) * (curves.ndim - 1))
        return np.asarray(sums / counts)


def gauge_readings(traces: Sequence[Floats]) -> list[Readings]:
    """Readings of a gauge: the samples of a trace, or those between which it was interpolated or held. Shapes: traces
    (n,).
    """
    candidates = [_interpolated_readings(pressure_Pa) for pressure_Pa in traces]
    scatter_digits = [digits for _, digits in filter(None, candidates)]
    # Samples rounded to steps coarser than their noise lie on lines for that reason alone.
    # 2.0: least median scatter, in last digits, of the readings found in traces (measured)
    interpolated = bool(scatter_digits) and float(np.median(scatter_digits)) >= 2.0
    return [
        candidate[0] if interpolated and candidate is not None else _samples_as_readings(pressure_Pa)
        for candidate, pressure_Pa in zip(candidates, traces, strict=True)
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
    means = [float(np.mean(pressure_Pa[begin:end])) for begin, end in itertools.pairwise(edges)]
    return Readings(
        0.5 * (edges[:-1] + edges[1:] - 1), np.array(means), rounding_Pa * math.sqrt(blocks / steps), all_noise=True,
        edges=edges,
    )  # fmt: skip


def _interpolated_readings(pressure_Pa: Floats) -> tuple[Readings, float] | None:
    """Readings of an interpolated or held trace and their scatter in last digits; None if it is neither."""
    steps = np.abs(np.diff(pressure_Pa))
    if pressure_Pa.size < 4 or not steps.any():
        return None
    digit_Pa = _resolution(pressure_Pa)
    if (
        np.mean(steps == 0.0) > INTERPOLATED_PART
        and (held_readings := _sample_and_hold_readings(pressure_Pa, digit_Pa)) is not None
    ):
        return _with_rounding(*held_readings), math.inf
    begins = _straight_runs(pressure_Pa, max(0.5 * digit_Pa, EXACT_TOLERANCE * float(np.max(np.abs(pressure_Pa)))))
    within = np.diff(begins, append=pressure_Pa.size) - 2
    if begins.size == 1 or np.sum(np.maximum(within, 0)) < INTERPOLATED_PART * pressure_Pa.size:
        return None
    places, values_Pa = _line_intersections(pressure_Pa, begins)
    return _with_rounding(places, values_Pa), rough_noise(values_Pa) / digit_Pa if digit_Pa > 0 else math.inf


def _with_rounding(places: Floats, values_Pa: Floats) -> Readings:
    """Readings with the rounding error that follows from their own resolution."""
    return Readings(places, values_Pa, _resolution(values_Pa) / math.sqrt(12))


def _resolution(pressure_Pa: Floats) -> float:
    """Resolution of pressures, Pa: the largest step of which they are all multiples, to within EXACT_TOLERANCE, by
    Euclid's algorithm; 0 without one.
    """
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
    period_found = _sampling_period(changes.astype(float) - 0.5)
    if period_found is None:
        return None
    first, period = period_found
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
    largest_error = np.max(np.abs(instants - first - slope * periods))
    if largest_error > period_tolerance or gaps.size * math.log(slope / (2 * period_tolerance)) < -math.log(
        period_false_alarm
    ):
        return None
    return float(first), float(slope)


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
        place = float(np.clip(intersection, begin - 1, begin))
        places.append(place)
        values.append(0.5 * (slope * place + at_0 + next_slope * place + next_at_0))
    spacing = float(np.median(np.diff(places))) if len(places) > 1 else 0.0
    last = pressure_Pa.size - 1.0
    ends = []
    for inner, end, (slope, at_0) in ((places[0], 0.0, lines[0]), (places[-1], last, lines[-1])):
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
    beyond three standard deviations, such as at a corner, are clipped (Winsorised). Shapes: pressure_Pa (n,).
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
    own_sigma = [math.nan] * len(readings)
    for i, each in enumerate(readings):
        if each.values_Pa.size >= FEWEST_SAMPLES and not each.all_noise:
            own_sigma[i] = white_noise_sd(whitened(each.values_Pa, rho)[1:] if rho else each.values_Pa)
    known_sigmas = [sigma for sigma in own_sigma if math.isfinite(sigma)]
    typical = float(np.median(known_sigmas)) if len(known_sigmas) > 1 else 0.0
    noises = []
    for sigma, each in zip(own_sigma, readings, strict=True):
        if each.all_noise:
            # 1e6: degrees of freedom of a noise that is derived instead of estimated
            noises.append(GaugeNoise(each.rounding_Pa, 1e6, 0.0))
            continue
        own_degrees = NOISE_DEGREES * each.values_Pa.size if math.isfinite(sigma) else 0.0
        # 3: samples below which a trace is left unchanged although other traces determine the noise (derived)
        # 20.0: degrees of freedom that the other traces of a campaign add to the noise of a trace (chosen)
        degrees_of_others = 20.0 if typical > 0 and each.values_Pa.size >= 3 else 0.0
        degrees = own_degrees + degrees_of_others
        squares = degrees_of_others * typical**2 + (own_degrees * sigma**2 if own_degrees else 0.0)
        pooled_sigma = max(math.sqrt(squares / degrees), each.rounding_Pa) if degrees else 0.0
        negligible = pooled_sigma <= NEGLIGIBLE_NOISE * abs(float(np.median(each.values_Pa)))
        noises.append(GaugeNoise(0.0 if negligible else pooled_sigma, degrees, rho))
    return noises


def noise_correlation(traces: Sequence[Floats]) -> float:
    """Lag-one correlation of the noise of readings, the same in all traces; 0 unless significantly positive. If noise
    is correlated, third differences of readings COMPARED_LAG apart are larger than those of neighbours. A changing
    pressure has slow differences too, but not in most traces, so the median over traces is used. Shapes: traces
    (n_readings,).
    """
    ratios, counts = [], []
    for readings_Pa in traces:
        distant = [readings_Pa[begin::COMPARED_LAG] for begin in range(COMPARED_LAG)]
        neighbour_sigma = white_noise_sd(readings_Pa) if distant[-1].size >= FEWEST_SAMPLES else 0.0
        if neighbour_sigma > NEGLIGIBLE_NOISE * abs(float(np.median(readings_Pa))):
            # In coarse steps, distant readings may all be equal.
            distant_variance = max(
                float(np.mean([white_noise_sd(each) ** 2 for each in distant])), NEGLIGIBLE_NOISE * neighbour_sigma**2
            )
            ratios.append(math.log(distant_variance / neighbour_sigma**2))
            counts.append(readings_Pa.size)
    if not ratios:
        return 0.0
    # 3.0: standard deviations from which the noise of distant readings shows a correlation (chosen)
    threshold = 3.0 * math.sqrt(4 / NOISE_DEGREES * COMPARED_LAG / sum(counts))
    ratio = float(np.median(ratios))
    if ratio < threshold:
        return 0.0
    rhos = np.linspace(0.0, LARGEST_CORRELATION, 98)
    return float(
        np.interp(
            ratio, np.log(_third_difference_variance(rhos**COMPARED_LAG) / _third_difference_variance(rhos)), rhos
        )
    )


def _third_difference_variance(rho: Floats) -> Floats:
    """Variance of third differences of noise with lag-one correlation `rho`, relative to that of white noise."""
    return np.asarray(1 - 1.5 * rho + 0.6 * rho**2 - 0.1 * rho**3)


def whitened(values: Floats, rho: float) -> Floats:
    """Readings, or columns of curves through them, whitened for noise of the given lag-one correlation. Shapes: values
    (n,).
    """
    return whiten(values, np.arange(len(values)) == 0, rho)


# ------------------------------------------------------------------------------
# Clock offset between pressure gauge and camera, estimated from the growth that empties the chamber.
#
# A pressure that falls as the tube fills has its corner where growth begins. So the growth is shifted in time to
# where it explains the readings of each trace best. All trials share gauge and camera, so that the same offset is
# likely: the distribution of offsets in the other trials is the prior of each (empirical Bayes: Robbins, Proc. 3rd
# Berkeley Symp. 1, 157, 1956), since a short trace determines its own offset to a few samples at best.


@dataclass(frozen=True)
class Clock:
    """Clock offset, samples: delay from a reading to the growth that belongs to it; and its standard deviation. `cost`
    is −2 ln of the prior probability of this offset.
    """

    offset: float
    sigma: float
    cost: float


@dataclass(frozen=True)
class Growth:
    """Growth of a trial at all samples of its trace, m, shape (n,), and their spacing, s."""

    grown_m: Floats
    frame_s: float

    def at(self, places: Floats) -> Floats:
        """Growth at places among the samples, m; constant beyond both ends."""
        return np.interp(places, np.arange(self.grown_m.size), self.grown_m)


def polynomial_along(t: Floats, growth_m: Floats, time_degree: int, growth_degree: int) -> Floats:
    """Powers of time and of growth. The first column is 1. Shapes: t, growth_m (n,) → (n, bent + along + 1)."""
    return np.column_stack(
        [*(t**k for k in range(time_degree + 1)), *(growth_m**k for k in range(1, growth_degree + 1))]
    )


def frequencies_in_other_trials(likelihoods: Floats) -> Floats:
    """Frequencies of several kinds in the other trials of a campaign, as a prior for each trial. Estimated by
    expectation–maximisation. One pseudo-trial that is of every kind alike is added, so that none is ruled out. A trial
    does not contribute to its own prior, since a chance result would then make itself likely (collapsed variational
    rule: Asuncion et al., Proc. 25th UAI, 27, 2009). Shapes: likelihoods (n_trials, n_kinds).
    """
    informative = likelihoods.any(axis=1)
    n_kinds = likelihoods.shape[1]
    shares: Floats = np.full(likelihoods.shape, 1 / n_kinds)
    # 30: iterations of the expectation–maximisation of frequencies (measured)
    for _ in range(30 if np.count_nonzero(informative) > 1 else 0):
        responsibilities = likelihoods * shares
        responsibilities = responsibilities / np.where(informative, responsibilities.sum(axis=1), 1.0)[:, None]
        counts_of_others = responsibilities.sum(axis=0) - responsibilities
        shares = (counts_of_others + 1 / n_kinds) / (counts_of_others.sum(axis=1, keepdims=True) + 1)
    return shares


def gauge_clocks(
    read: Sequence[Readings], growths: Sequence[Growth | None], noises: Sequence[GaugeNoise]
) -> list[Clock | None]:
    """Clock offset of every trace of a campaign."""
    largest_offset_frames = 60  # Largest clock offset, samples (chosen)
    frames_s = [growth.frame_s for growth in growths if growth is not None]
    if not frames_s:
        return [None] * len(read)
    step_s = float(np.median(frames_s))
    offsets_s: Floats = step_s * np.arange(-largest_offset_frames, largest_offset_frames + 1.0)
    logs: dict[int, Floats] = {}
    for i, (readings, growth, noise) in enumerate(zip(read, growths, noises, strict=True)):
        if growth is not None and noise.sigma_Pa > 0:
            log_likelihood = _offset_log_likelihood(readings, growth, noise, offsets_s / growth.frame_s)
            if log_likelihood is not None:
                logs[i] = log_likelihood
    if not logs:
        return [None] * len(read)
    shares = frequencies_in_other_trials(np.exp(np.array(list(logs.values()))))
    clocks: list[Clock | None] = [None] * len(read)
    for (i, log_likelihood), share in zip(logs.items(), shares, strict=True):
        posterior = log_likelihood + np.log(share)
        best = int(np.argmax(posterior))
        # 4.5: log posterior below the maximum down to which an offset belongs to its peak (derived)
        in_peak = posterior > posterior[best] - 4.5
        # The peak is the contiguous range around the likeliest offset.
        gaps = np.flatnonzero(~in_peak)
        begin = int(max(gaps[gaps < best], default=-1)) + 1
        end = int(min(gaps[gaps > best], default=in_peak.size))
        weights = np.exp(posterior[begin:end] - posterior[best])
        peak_offsets_s = offsets_s[begin:end]
        mean_s = float(np.average(peak_offsets_s, weights=weights))
        sigma_s = math.sqrt(float(np.average((peak_offsets_s - mean_s) ** 2, weights=weights)))
        growth = growths[i]
        assert growth is not None
        cost = -2 * math.log(float(np.sum(share[begin:end])))
        clocks[i] = Clock(mean_s / growth.frame_s, sigma_s / growth.frame_s, cost)
    return clocks


def _offset_log_likelihood(readings: Readings, growth: Growth, noise: GaugeNoise, offsets: Floats) -> Floats | None:
    """Log likelihood of offsets, samples, relative to the likeliest; None if there is no information. Where no curve
    explains the readings to their noise, the residual counts as noise.
    """
    # Degrees in time and in growth of the curve by which the offset is estimated (chosen)
    time_degree, growth_degree = 1, 2
    size, columns = readings.places.size, time_degree + growth_degree + 1
    if size <= columns:
        return None
    means = readings.edges is not None
    at = np.arange(growth.grown_m.size) if means else readings.places
    t, y = np.linspace(-1, 1, at.size), whitened(readings.values_Pa - np.mean(readings.values_Pa), noise.rho)
    # 400: readings used to estimate an offset (chosen)
    stride = max(size // 400, 1)
    y = y[::stride]
    residual_squares = np.full(offsets.size, np.inf)
    for k in np.flatnonzero(np.abs(offsets) <= growth.grown_m.size // 4):
        shifted_m = growth.at(at + offsets[k])
        range_m = np.ptp(shifted_m)
        if range_m == 0:
            continue
        curves = polynomial_along(t, (shifted_m - shifted_m[0]) / range_m, time_degree, growth_degree)
        white = whitened(readings.means_of(curves) if means else curves, noise.rho)
        q = np.linalg.qr(white[::stride])[0]
        residual_squares[k] = y @ y - np.sum((q.T @ y) ** 2)
    least = float(np.min(residual_squares))
    if not math.isfinite(least):
        return None
    variance = max(noise.sigma_Pa**2, least / max(y.size - columns - 1, 1))
    return np.asarray(-0.5 * (residual_squares - least) / variance)


# Half widths of the windows in which a residual may not show a local part, samples (chosen)
HALF_WIDTHS = (2, 3, 5, 8, 12, 18, 27, 40, 60, 90, 135, 200, 300, 450, 680, 1000)


LARGEST_DEGREE = 6  # Largest degree of a polynomial in time (chosen)


GAMMA = 1.2  # Exponent with which a chamber empties into the tube, between isothermal and adiabatic (derived)

# Degrees in time and in growth of the other kinds of curves (chosen)
GROWTH_DEGREES = ((0, 1), (0, 2), (1, 1), (1, 2), (1, 3), (2, 2), (2, 3), (3, 4))


@dataclass(frozen=True)
class DenoisedTrace:
    """A recorded pressure without its noise, s and Pa, shape (n,), with its remaining errors. `mean_error_Pa` is the
    standard deviation of its mean, 0 where the trace was left unchanged. The columns of `errors_Pa`, shape (n,
    n_errors), are one standard deviation each of the other errors of the curve.
    """

    time_s: Floats
    pressure_Pa: Floats
    mean_error_Pa: float
    errors_Pa: Floats
    is_curve: bool = False

    def extended(self) -> DenoisedTrace:
        """The trace with one more sample beyond its end, along the line through its last part. If the clock of the
        gauge is behind that of the camera, the last frames were filmed under a pressure that was not recorded any more.
        A constant extrapolation of a falling pressure would bias a fit of the clock offset.
        """
        last_s, span_s = self.time_s[-1], np.ptp(self.time_s)
        # 0.1, 0.2: last part of a trace whose line extrapolates it, and by how much (measured)
        late = self.time_s >= last_s - 0.1 * span_s
        if np.count_nonzero(late) < 2:
            return self
        curves = np.column_stack([self.pressure_Pa, self.errors_Pa])
        slope = np.polyfit(self.time_s[late] - last_s, curves[late], 1)[0]
        beyond_s = 0.2 * span_s
        end = curves[-1] + slope * beyond_s
        # A falling gauge pressure does not fall below zero.
        end[0] = max(end[0], min(curves[-1, 0], 0.0))
        return replace(
            self,
            time_s=np.append(self.time_s, last_s + beyond_s),
            pressure_Pa=np.append(self.pressure_Pa, end[0]),
            errors_Pa=np.vstack([self.errors_Pa, end[1:]]),
        )


@dataclass(frozen=True)
class _Recorded:
    """A trace to be denoised: readings, number of samples, noise; growth and clock offset, None where unknown."""

    readings: Readings
    count: int
    noise: GaugeNoise
    growth: Growth | None
    clock: Clock | None

    @property
    def typical_Pa(self) -> float:
        """Absolute pressure at which the scale of `_linearised` has unit slope."""
        return max(float(np.median(self.readings.values_Pa)), -0.5 * AMBIENT_PRESSURE_PA) + AMBIENT_PRESSURE_PA

    def basis(self, kind: int, offset_sigmas: float = 0.0) -> tuple[Floats, Floats]:
        """Basis functions of a kind of curve at the readings, orthonormal, and at all samples; the first is the mean.
        `offset_sigmas` shifts the clock by so many of its standard deviations.
        """
        at_samples = self._columns(kind, np.arange(float(self.count)), offset_sigmas)
        means = self.readings.edges is not None
        at_readings = (
            self.readings.means_of(at_samples) if means else self._columns(kind, self.readings.places, offset_sigmas)
        )
        q, r = np.linalg.qr(at_readings)
        return q, np.linalg.solve(r.T, at_samples.T).T

    def _columns(self, kind: int, where: Floats, offset_sigmas: float) -> Floats:
        """Powers of time, or of time and growth, at places among the samples."""
        places = self.readings.places
        t = 2 * (where - places[0]) / (places[-1] - places[0]) - 1
        if kind <= LARGEST_DEGREE:
            return legvander(t, kind)
        assert self.growth is not None
        assert self.clock is not None
        offset = self.clock.offset + offset_sigmas * self.clock.sigma
        seen_m = self.growth.at(places + offset)
        grown = (self.growth.at(where + offset) - seen_m[0]) / np.ptp(seen_m)
        return polynomial_along(t, grown, *GROWTH_DEGREES[kind - LARGEST_DEGREE - 1])

    def criteria(self) -> Floats:
        """BIC of every kind of curve, infinite where its residual is more than noise. Shape (n_kinds,)."""
        y = whitened(_linearised(self.readings.values_Pa, self.typical_Pa), self.noise.rho)
        size, degrees = len(y), self.noise.degrees
        # 12: further degrees that a residual may not show (chosen)
        polynomials = _polynomials(size, min(LARGEST_DEGREE + 12, size // 3))
        time_only = [kind + 1 < polynomials.shape[1] for kind in range(LARGEST_DEGREE + 1)]
        with_growth = [self.clock is not None and sum(of) <= size // 3 - 2 for of in GROWTH_DEGREES]
        values = np.full(len(time_only) + len(with_growth), math.inf)
        for kind in np.flatnonzero(time_only + with_growth):
            basis = np.linalg.qr(whitened(self.basis(int(kind))[0], self.noise.rho))[0]
            numbers, clock_cost = basis.shape[1], 0.0
            if kind > LARGEST_DEGREE:
                assert self.clock is not None
                numbers, clock_cost = numbers + 1, self.clock.cost - math.log(size)
            residual = y - basis @ (basis.T @ y)
            if _is_noise(residual, self.noise, numbers, polynomials):
                # A noise estimated from few differences makes the likelihood a Student t.
                relative_squares = float(residual @ residual) / (degrees * self.noise.sigma_Pa**2)
                values[kind] = (degrees + size) * math.log1p(relative_squares) + math.log(size) * numbers + clock_cost
        return values

    def averaged(self, weights: Floats) -> tuple[Floats, float, Floats]:
        """As `curve`, averaged over kinds with these weights; the differences between kinds are errors of the average.
        The errors within a kind are those of the kind of largest weight. Bayesian model averaging (Hoeting et al.,
        Stat. Sci. 14, 382, 1999).
        """
        kinds = np.flatnonzero(weights)
        if not kinds.size:
            return self.curve(None)
        _, of_mean_Pa, errors_Pa = self.curve(int(np.argmax(weights)))
        all_errors_Pa = [errors_Pa, *self._clock_errors(int(np.argmax(weights)))]
        shares = weights[kinds] / weights[kinds].sum()
        curves_Pa = np.column_stack([self.curve(int(kind))[0] for kind in kinds])
        mean_Pa = curves_Pa @ shares
        between_Pa = (curves_Pa - mean_Pa[:, None]) * np.sqrt(shares)
        all_errors_Pa.append(between_Pa - np.mean(between_Pa, axis=0))
        return mean_Pa, of_mean_Pa, _principal_errors(np.column_stack(all_errors_Pa))

    def _clock_errors(self, kind: int) -> list[Floats]:
        """Error of a curve in growth due to one standard deviation of the clock offset, Pa."""
        if kind <= LARGEST_DEGREE:
            return []
        change_Pa = 0.5 * (self.curve(kind, offset_sigmas=1.0)[0] - self.curve(kind, offset_sigmas=-1.0)[0])
        return [change_Pa - np.mean(change_Pa)] if np.ptp(change_Pa) > 0 else []

    def curve(self, kind: int | None, offset_sigmas: float = 0.0) -> tuple[Floats, float, Floats]:
        """The curve of a kind at all samples, Pa, the error of its mean, Pa, and one column per other error. Without a
        kind it is a smoothing spline. Errors are one standard deviation each.
        """
        noise, values_Pa = self.noise, self.readings.values_Pa
        if kind is None:
            # White noise is assumed: a changing pressure can mimic a correlation of the noise.
            white_Pa = white_noise_sd(values_Pa) if values_Pa.size >= FEWEST_SAMPLES else 0.0
            noise = replace(noise, sigma_Pa=white_Pa or noise.sigma_Pa, rho=0.0)
        # A spline has slow errors: their size is taken as that of a polynomial of the largest degree.
        basis, basis_at_samples = self.basis(
            min(LARGEST_DEGREE, values_Pa.size - 2) if kind is None else kind, offset_sigmas
        )
        q, r = np.linalg.qr(whitened(basis, noise.rho))
        per_error = noise.sigma_Pa * np.linalg.solve(r.T, basis_at_samples.T).T
        if kind is None:
            smooth = _spline(self.readings.places, values_Pa, noise.sigma_Pa, self.count)
        else:
            white = whitened(_linearised(values_Pa, self.typical_Pa), noise.rho)
            part = np.maximum(-basis_at_samples @ np.linalg.solve(r, q.T @ white) / (GAMMA * self.typical_Pa), 0.01)
            smooth = self.typical_Pa * part**-GAMMA - AMBIENT_PRESSURE_PA
            per_error = per_error * part[:, None] ** (-GAMMA - 1)
        means = np.mean(per_error, axis=0)
        return smooth, float(np.linalg.norm(means)), (per_error - means)[:, 1:]


def _linearised(pressure_Pa: Floats, typical_Pa: float) -> Floats:
    """Pressure on the scale on which that of a chamber emptying into the tube is linear in the growth, Pa."""
    whole = np.maximum(pressure_Pa + AMBIENT_PRESSURE_PA, 0.1 * AMBIENT_PRESSURE_PA) / typical_Pa
    return np.asarray(-GAMMA * typical_Pa * whole ** (-1 / GAMMA))


def _principal_errors(errors_Pa: Floats) -> Floats:
    """The same error covariance in as few columns as possible, by principal components."""
    directions, sizes_Pa, _ = np.linalg.svd(errors_Pa, full_matrices=False)
    # 1e-3: part of the total error variance of a curve below which a principal direction is dropped (chosen)
    kept = sizes_Pa**2 > 1e-3 * np.sum(sizes_Pa**2)
    return np.asarray((directions * sizes_Pa)[:, kept])


def denoised_traces(tracks: Sequence[Track]) -> list[DenoisedTrace | None]:
    """Recorded pressures of the trials of a campaign without gauge noise; None for trials without a trace. The
    frequency of each kind of curve in the campaign enters as a prior: where all other pressures are constant, a bend
    that a single trace shows by chance counts as noise.
    """
    denoised: list[DenoisedTrace | None] = [None] * len(tracks)
    growths: dict[int, Growth | None] = {}
    for i, track in enumerate(tracks):
        known = np.zeros(0, dtype=bool)
        if track.pressure_Pa is not None:
            known = np.isfinite(track.pressure_Pa) & np.isfinite(track.time_s)
        if track.pressure_Pa is None or np.count_nonzero(known) < 2:
            continue
        time_s, pressure_Pa = track.time_s[known].astype(float), track.pressure_Pa[known].astype(float)
        denoised[i] = DenoisedTrace(time_s, pressure_Pa, 0.0, np.zeros((time_s.size, 0)))
        in_track = track.usable & np.isfinite(track.lead_position_m) & np.isfinite(track.time_s)
        growths[i] = None
        if np.count_nonzero(in_track) > 1:
            grown_m = np.interp(time_s, track.time_s[in_track], track.lead_position_m[in_track])
            growths[i] = Growth(grown_m, float(np.median(np.diff(time_s))))
    raw = {i: trace for i, trace in enumerate(denoised) if trace is not None}
    read = gauge_readings([trace.pressure_Pa for trace in raw.values()])
    rho = noise_correlation([readings.values_Pa for readings in read if not readings.all_noise])
    noises = noise_of_traces(read, rho)
    clocks = gauge_clocks(read, list(growths.values()), noises)
    noisy = {
        i: _Recorded(readings, raw[i].time_s.size, noise, growths[i], clock)
        for i, readings, noise, clock in zip(raw, read, noises, clocks, strict=True)
        if noise.sigma_Pa > 0
    }
    if noisy:
        weights = _weights(np.array([recorded.criteria() for recorded in noisy.values()]))
        for (i, recorded), weight in zip(noisy.items(), weights, strict=True):
            denoised[i] = DenoisedTrace(raw[i].time_s, *recorded.averaged(weight), bool(np.any(weight)))
    return denoised


def _spline(places: Floats, values_Pa: Floats, sigma_Pa: float, count: int) -> Floats:
    """Smoothing spline through readings at all samples, with knots where the pressure bends (Dierckx, IMA J. Numer.
    Anal. 1, 267, 1981); of fewer than five readings lines.
    """
    from scipy.interpolate import UnivariateSpline

    # 0.85: part of the squares of the noise that the spline leaves, the rest for its knots (measured)
    few = places.size < 5
    weights = np.full(places.size, 1 / sigma_Pa)
    spline = UnivariateSpline(places, values_Pa, weights, k=1 if few else 3, s=0.0 if few else 0.85 * places.size)
    return np.asarray(spline(np.arange(float(count))))


def _weights(criteria: Floats) -> Floats:
    """Probabilities of kinds of curves relative to the most probable; 0 if negligible or if none explains a trace."""
    possible = np.asarray(np.isfinite(criteria).any(axis=1))
    lowest = np.where(possible, criteria.min(axis=1), 0.0)
    totals = criteria - 2 * np.log(frequencies_in_other_trials(np.exp(-0.5 * (criteria - lowest[:, None]))))
    least = np.where(possible, totals.min(axis=1), 0.0)
    weights = np.where(possible[:, None], np.exp(-0.5 * (totals - least[:, None])), 0.0)
    # 0.01: probability, relative to the most probable kind of curve, from which a kind enters the average (chosen)
    return np.where(weights >= 0.01, weights, 0.0)


def _polynomials(count: int, degree: int) -> Floats:
    """Orthonormal polynomials in time, shape (count, degree + 1)."""
    return np.asarray(np.linalg.qr(legvander(np.linspace(-1, 1, count), degree))[0])


def _is_noise(residual_Pa: Floats, noise: GaugeNoise, fitted: int, slow: Floats) -> bool:
    """Whether a curve with so many parameters leaves no slow or local part and no more than the noise."""
    # 4.0: standard deviations from which a slow residual is more than noise (chosen)
    if np.any(np.abs(slow.T @ residual_Pa) > _quantile_Pa(4.0, noise)):
        return False
    # A corner that is cut leaves residuals only in the samples around it.
    total = np.concatenate([[0.0], np.cumsum(residual_Pa)])
    # 5.0: standard deviations from which a sum of neighbouring residuals is more than noise
    local = _quantile_Pa(5.0, noise)
    for width in (2 * half + 1 for half in HALF_WIDTHS if 2 * half < residual_Pa.size):
        if np.max(np.abs(total[width:] - total[:-width])) > local * np.sqrt(width):
            return False
    return bool(residual_Pa @ residual_Pa <= _largest_residual_squares(noise, residual_Pa.size - fitted))


def _quantile_Pa(sigmas: float, noise: GaugeNoise) -> float:
    """Bound, Pa, at the false-alarm rate of so many normal standard deviations, by Student's t."""
    from scipy.special import ndtr, stdtrit

    return -noise.sigma_Pa * float(stdtrit(noise.degrees, ndtr(-sigmas)))


def _largest_residual_squares(noise: GaugeNoise, degrees: Floats | int) -> Any:
    """Largest accepted residual sum of squares with so many degrees of freedom, Pa² (F test)."""
    from scipy.special import fdtri

    # 1e-5: probability with which pure noise leaves a larger residual sum of squares than is accepted (chosen)
    return noise.sigma_Pa**2 * degrees * fdtri(degrees, noise.degrees, 1 - 1e-5)
