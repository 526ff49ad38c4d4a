"""The readings of a pressure gauge behind a recorded trace, and their noise.

A gauge that is read a hundred times a second has fewer readings than a film has frames. Between them the trace is
interpolated linearly or repeats the last value (sample and hold), so its noise is not independent from frame to frame.
The same holds for a gauge behind a filter, and for the error left by rounding a quiet pressure to coarse steps. Each
would look like a fluctuating pressure, which a light vine follows.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.inference.whitening import whiten
from vinetrack.tracks.position_noise import rough_noise

# Deviation of samples from a line drawn between readings, relative to the largest pressure, if the last digit is not
# coarser (derived)
EXACT_TOLERANCE = 1e-9

# Fraction of samples on a line through two others above which a trace counts as interpolated (chosen)
INTERPOLATED_PART = 0.25


NEGLIGIBLE_NOISE = 1e-4  # Noise below this fraction of the median pressure is rounding, and is not removed (chosen)

FEWEST_SAMPLES = 9  # Samples below which a trace does not determine its noise (derived)

# Least number of blocks into which a trace in coarse steps is divided, and least number of samples in each (chosen)
FEWEST_BLOCKS = 4


# Standard deviations at which differences are clipped in the noise estimate, the part of the variance of normal noise
# that remains (derived: 0.9707 + 9 · 0.0027), and iterations, of which the last changes it by 1e-4
CLIP_SIGMAS, VARIANCE_KEPT, CLIP_ROUNDS = 3.0, 0.9950, 3

NOISE_DEGREES = 2 / 4.62  # Degrees of freedom of the noise variance per sample (derived)


# Lag at which noise is compared with that of neighbouring readings, standard deviations from which it counts as
# correlated, and the largest correlation (chosen)
COMPARED_LAG, CORRELATION_SIGMAS, LARGEST_CORRELATION = 4, 3.0, 0.97


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
    return _with_rounding(places, values_Pa), _noise_of_uneven(
        places, values_Pa
    ) / digit_Pa if digit_Pa > 0 else math.inf


def _with_rounding(places: Floats, values_Pa: Floats) -> Readings:
    """Readings with the rounding error that follows from their own resolution."""
    return Readings(places, values_Pa, _resolution(values_Pa) / math.sqrt(12))


def _resolution(pressure_Pa: Floats) -> float:
    """Resolution of pressures, Pa: the largest step of which they are all multiples; 0 without one."""
    return _common_divisor(pressure_Pa, EXACT_TOLERANCE * float(np.max(np.abs(pressure_Pa))))


def _common_divisor(values: Floats, exact: float) -> float:
    """Largest number that divides all differences of values to within `exact`, by Euclid's algorithm; 0 if none."""
    remainders = np.unique(np.abs(values - values[0]))
    remainders = remainders[remainders > exact]
    while remainders.size > 1:
        smallest = remainders[0]
        remainder = np.mod(remainders, smallest)
        remainder = np.unique(np.minimum(remainder, smallest - remainder))
        remainders = np.concatenate([remainder[remainder > exact], [smallest]])
    return float(remainders[0]) if remainders.size and remainders[0] > 2 * exact else 0.0


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


def _noise_of_uneven(places: Floats, values: Floats) -> float:
    """Noise of values at uneven places on a smooth curve, from divided differences of up to third order."""
    windows = np.lib.stride_tricks.sliding_window_view
    x, y = (windows(each, min(values.size, 4)) for each in (places, values))
    differences = x[:, :, None] - x[:, None, :]
    np.einsum("kii->ki", differences)[:] = 1.0
    weights = 1 / np.prod(differences, axis=2)
    return float(np.median(np.abs(np.sum(weights * y, axis=1)) / np.linalg.norm(weights, axis=1))) / 0.6745


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
    for _ in range(CLIP_ROUNDS):
        sigma = math.sqrt(float(np.mean(np.minimum(third**2, (CLIP_SIGMAS * sigma) ** 2))) / VARIANCE_KEPT)
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
    threshold = CORRELATION_SIGMAS * math.sqrt(4 / NOISE_DEGREES * COMPARED_LAG / sum(counts))
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
