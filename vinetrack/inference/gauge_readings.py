"""What a gauge read, and the noise of its readings.

A gauge that is read a hundred times a second has fewer readings than a film has frames. Between them a trace is filled
up by straight lines or by repeating the last value, and its noise is no longer independent from frame to frame; nor is
that of a gauge behind a filter, or what rounding to coarse steps leaves of a quiet pressure. Each would pass for a
pressure that wanders, which a light vine follows.
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

STRAIGHT = 1e-9
"""Part of the largest pressure by which samples may be off a straight line that was drawn between readings, if no last
digit is coarser. Derived: a million times the rounding of double precision."""

FILLED = 0.25
"""Part of the samples that lie on a line through two others from which a trace is taken for filled up. Chosen: of
three samples a reading a third do, of white noise none; at half a trace of which an eighth stands still is
taken for one, at twice a gauge of two fifths of the frame rate is not seen."""

DIGITS = 2.0
"""Last digits by which readings found in traces scatter at least, in the median; else they are none, since any samples
rounded to a coarse digit lie on lines. Measured on 400 samples at 2.2 to 40 a reading: noise without readings scatters
by 1.1 digits at most where every trace seems filled up, readings of two digits of noise and more by 1.6. At half noise
of a digit is taken for readings; at twice readings with noise of three digits are taken for samples."""

BEAT_OFF, BEAT_CHANCE = 0.75, 1e-4
"""Samples by which a change may be off the even beat of a gauge, and the chance of changes at random to keep to one.
Derived: a reading shows first up to a sample later, half a sample either way, and the beat that is fitted to few of
them is off by half of that. Chosen: one trace in ten thousand; at half and at twice a gauge of five samples a reading
must change half a time more or less often."""

SEEN = 0.25
"""Part of a line that must show at an end of a trace for the reading that it leads to. Chosen: a line through rounded
samples is then known to four digits there; at half to eight, at twice the noise of one reading more is lost of every
other trace."""

QUIET = 1e-4
"""Noise below this part of the median pressure is rounding, and left as it is. Chosen: a tenth of the last digit that
pressure gauges print."""

FEWEST = 9
"""Samples below which a trace does not tell its noise. Derived: twice the degrees of freedom of a cubic, and one."""

FEWEST_BLOCKS = 4
"""Blocks at least into which a trace in coarse steps is parted, and samples at least in each. Chosen: four tell a slope
from a bend; at half a pressure that falls by less than a step is a line at most, at twice its means hang together.
Traces of shorter blocks are left as they are."""

KNOWN = 1e6
"""Degrees of freedom of a noise that is derived. Derived: as good as endless."""

FEWEST_WITH_OTHERS = 3
"""Samples below which a trace is left as it is where others tell the noise. Derived: a mean, and two to test it by."""

CLIPPED, KEPT, CLIPPED_ROUNDS = 3.0, 0.9950, 3
"""Standard deviations at which differences are clipped for the noise, what that leaves of the variance of normal noise
(derived: 0.9707 + 9 · 0.0027), and rounds, of which the last changes it by 1e-4. Chosen: on 2,000 traces of 300
samples it errs by 6.2 %, at 2 by 6.4 %; a corner of ten standard deviations raises it by 1.2 %, at 4 by 1.7 %."""

NOISE_DEGREES = 2 / 4.62
"""Degrees of freedom of the variance of the noise per sample. Derived: neighbouring third differences are correlated by
-15/20, 6/20 and -1/20, so that the relative variance of their mean square is 2 (1 + 2 · 0.655) / n = 4.62 / n."""

ALIKE = 20.0
"""Degrees of freedom that the other traces of a campaign add to what a trace tells of its noise. Chosen: one gauge
reads them all; as much as 46 readings of its own. At half the noise of short traces is what it is by chance, at twice a
gauge whose noise grows with the pressure is misjudged more."""

APART, SURELY_CORRELATED, MOST_CORRELATED = 4, 3.0, 0.97
"""How many readings apart noise is held against that of neighbours, from how many standard deviations it is taken for
correlated, and the largest correlation. Chosen: 4 apart noise of a correlation of 0.5 is as good as independent, 8
apart pressures move as far on their own; 3 are a chance of 1e-3; a correlation of 0.97 lasts for 33 readings, beyond
which noise and the course of a pressure are one."""


@dataclass(frozen=True)
class GaugeNoise:
    """Noise of a gauge: what is new in a reading, Pa, how surely that is known, correlation of neighbours.

    `degrees` are the degrees of freedom of its variance.
    """

    sigma_Pa: float
    degrees: float
    rho: float


@dataclass(frozen=True)
class Readings:
    """What a gauge read in the course of a trace, Pa, and where, in samples from its first; both of shape (n,).

    `rounding_Pa` is the standard deviation that rounding leaves in each, 0 where nothing is rounded. Where it is
    `all_noise`, what the readings scatter by tells nothing of it. Where readings are means of blocks of samples, these
    begin and end at `edges`, shape (n + 1,).
    """

    places: Floats
    values_Pa: Floats
    rounding_Pa: float = 0.0
    all_noise: bool = False
    edges: NDArray[np.intp] | None = None

    def means_of(self, curves: Floats) -> Floats:
        """Means over the blocks of curves at all samples, where the readings are such means.

        Parameters
        ----------
        curves : array, shape (n_samples, …)

        Returns
        -------
        array, shape (n, …)
        """
        assert self.edges is not None
        sums = np.add.reduceat(curves, self.edges[:-1], axis=0)
        counts = np.diff(self.edges).reshape(-1, *(1,) * (curves.ndim - 1))
        return np.asarray(sums / counts)


def gauge_readings(traces: Sequence[Floats]) -> list[Readings]:
    """Readings of a gauge: the samples of a trace, or those among them between which it was filled up.

    Parameters
    ----------
    traces : sequence of arrays, shape (n,), Pa
        Samples of one gauge, evenly spaced, perhaps rounded after they were filled up.

    Returns
    -------
    list of Readings
        Their places increase; the first and the last may have been read before and after the trace.
    """
    told = [_filled(pressure_Pa) for pressure_Pa in traces]
    in_digits = [digits for _, digits in filter(None, told)]
    # Where samples are rounded to more than they are noisy by, lines run through them for no other reason.
    filled = bool(in_digits) and float(np.median(in_digits)) >= DIGITS
    return [
        each[0] if filled and each is not None else _sampled(pressure_Pa)
        for each, pressure_Pa in zip(told, traces, strict=True)
    ]


def _sampled(pressure_Pa: Floats) -> Readings:
    """Samples that are readings themselves; of those in steps coarser than their noise the means of blocks.

    How much such samples are off by rounding hangs together over as many as the pressure takes for a step.
    """
    count = pressure_Pa.size
    plain = Readings(np.arange(float(count)), pressure_Pa)
    rounding_Pa = _digit_of(pressure_Pa) / math.sqrt(12)
    if rounding_Pa <= QUIET * abs(float(np.median(pressure_Pa))) or count < FEWEST:
        return plain
    if noise_of(pressure_Pa) >= rounding_Pa:
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


def _filled(pressure_Pa: Floats) -> tuple[Readings, float] | None:
    """Readings between which samples were filled up and by how many last digits they scatter, or None."""
    steps = np.abs(np.diff(pressure_Pa))
    if pressure_Pa.size < 4 or not steps.any():
        return None
    digit_Pa = _digit_of(pressure_Pa)
    if np.mean(steps == 0.0) > FILLED and (held := _held(pressure_Pa, digit_Pa)) is not None:
        return _rounded(*held), math.inf
    begins = _straight_runs(pressure_Pa, max(0.5 * digit_Pa, STRAIGHT * float(np.max(np.abs(pressure_Pa)))))
    within = np.diff(begins, append=pressure_Pa.size) - 2
    if begins.size == 1 or np.sum(np.maximum(within, 0)) < FILLED * pressure_Pa.size:
        return None
    places, values_Pa = _joined(pressure_Pa, begins)
    return _rounded(places, values_Pa), _scatter(places, values_Pa) / digit_Pa if digit_Pa > 0 else math.inf


def _rounded(places: Floats, values_Pa: Floats) -> Readings:
    """Readings with what their own steps leave of noise at least."""
    return Readings(places, values_Pa, _digit_of(values_Pa) / math.sqrt(12))


def _digit_of(pressure_Pa: Floats) -> float:
    """The step in which pressures are told, Pa; 0 where they are told in none."""
    return _last_digit(pressure_Pa, STRAIGHT * float(np.max(np.abs(pressure_Pa))))


def _last_digit(values: Floats, exact: float) -> float:
    """The largest number of which all differences of values are multiples to within `exact`; 0 where there is none.

    By Euclid's algorithm.
    """
    left = np.unique(np.abs(values - values[0]))
    left = left[left > exact]
    while left.size > 1:
        least = left[0]
        remainder = np.mod(left, least)
        remainder = np.unique(np.minimum(remainder, least - remainder))
        left = np.concatenate([remainder[remainder > exact], [least]])
    return float(left[0]) if left.size and left[0] > 2 * exact else 0.0


def _straight_runs(values: Floats, reach: float) -> NDArray[np.intp]:
    """First samples of runs, each as long as it goes, that one straight line fits to within `reach`.

    A line through intervals exists where the slopes that any two of them allow have one in common.
    """
    begins = [0]
    low, high = -math.inf, math.inf
    for j in range(1, values.size):
        apart = np.arange(j - begins[-1], 0, -1)
        rise = values[j] - values[begins[-1] : j]
        low = max(low, float(np.max((rise - 2 * reach) / apart)))
        high = min(high, float(np.min((rise + 2 * reach) / apart)))
        if low > high:
            begins.append(j)
            low, high = -math.inf, math.inf
    return np.array(begins)


def _scatter(places: Floats, values: Floats) -> float:
    """Typical noise of values on a smooth course, from divided differences of the third order or the most there are."""
    windows = np.lib.stride_tricks.sliding_window_view
    x, y = (windows(each, min(values.size, 4)) for each in (places, values))
    apart = x[:, :, None] - x[:, None, :]
    np.einsum("kii->ki", apart)[:] = 1.0
    weights = 1 / np.prod(apart, axis=2)
    return float(np.median(np.abs(np.sum(weights * y, axis=1)) / np.linalg.norm(weights, axis=1))) / 0.6745


def _held(pressure_Pa: Floats, digit_Pa: float) -> tuple[Floats, Floats] | None:
    """Readings that were repeated until the next; each was read up to a sample before it shows first.

    Of readings in coarse steps many are the same as those before: they are told by the even beat of all that differ.
    None where the trace does not look like that.
    """
    steps = np.diff(pressure_Pa)
    changes = np.flatnonzero(steps) + 1
    runs_on = (np.abs(np.diff(steps)) <= 2 * digit_Pa) & (steps[1:] != 0) & (steps[:-1] != 0)
    if np.mean(runs_on) > FILLED / 2:
        return None
    if np.median(np.abs(steps[changes - 1])) > 1.5 * digit_Pa:
        places = np.concatenate([[0.0], changes - 0.5])
        # When the first was read, the trace does not show.
        if places.size > 2:
            places[0] = min(0.0, places[1] - float(np.median(np.diff(places)[1:])))
        return places, pressure_Pa[[0, *changes]]
    beat = _beat(changes.astype(float) - 0.5)
    if beat is None:
        return None
    first, period = beat
    places = np.arange(first - math.ceil(first / period) * period, pressure_Pa.size - 1.0, period)
    middle = np.clip(np.round(places + 0.5 * period), 0, pressure_Pa.size - 1).astype(int)
    return places, pressure_Pa[middle]


def _beat(instants: Floats) -> tuple[float, float] | None:
    """The first of the instants and the period, samples, on which all of them fall; None where they have none."""
    gaps = np.diff(instants)
    if gaps.size < 3 or gaps.min() < 2:
        return None
    period = float(gaps.min())
    # From short gaps to long ones, so that a period a little off never counts one too few or too many.
    for most in (1.5, 4.0, 12.0, math.inf):
        told = gaps <= most * period
        period = float(np.sum(gaps[told]) / np.sum(np.round(gaps[told] / period)))
    counted = np.concatenate([[0.0], np.cumsum(np.round(gaps / period))])
    slope, first = np.polyfit(counted, instants, 1)
    off = np.max(np.abs(instants - first - slope * counted))
    if off > BEAT_OFF or gaps.size * math.log(slope / (2 * BEAT_OFF)) < -math.log(BEAT_CHANCE):
        return None
    return float(first), float(slope)


def _joined(pressure_Pa: Floats, begins: NDArray[np.intp]) -> tuple[Floats, Floats]:
    """Readings that were joined by straight lines: where the lines through neighbouring runs of samples meet.

    `begins` are the first samples of the runs. A trace begins and ends between two readings: those outside it are where
    its first and last line come to after as long as the others take.
    """
    lines: list[tuple[float, float]] = []
    for begin, end in itertools.pairwise([*begins, pressure_Pa.size]):
        at = np.arange(begin, end)
        # A sample alone has the slope of the line before it.
        slope = np.polyfit(at, pressure_Pa[at], 1)[0] if at.size > 1 else lines[-1][0]
        lines.append((slope, float(np.mean(pressure_Pa[at])) - slope * float(np.mean(at))))
    places, values = [], []
    for begin, (slope, at_0), (next_slope, next_at_0) in zip(begins[1:], lines, lines[1:], strict=False):
        meets = (next_at_0 - at_0) / (slope - next_slope) if slope != next_slope else begin - 0.5
        place = float(np.clip(meets, begin - 1, begin))
        places.append(place)
        values.append(0.5 * (slope * place + at_0 + next_slope * place + next_at_0))
    spacing = float(np.median(np.diff(places))) if len(places) > 1 else 0.0
    last = pressure_Pa.size - 1.0
    ends = []
    for inner, end, (slope, at_0) in ((places[0], 0.0, lines[0]), (places[-1], last, lines[-1])):
        shows = abs(end - inner)
        # A line that is longer than others passes over a reading.
        place = inner + math.copysign(max(spacing, shows), end - inner)
        ends.append([(place, slope * place + at_0)] if shows >= SEEN * spacing and shows > 0 else [])
    readings = np.array([*ends[0], *zip(places, values, strict=True), *ends[1]])
    return readings[:, 0], readings[:, 1]


def noise_of(pressure_Pa: Floats) -> float:
    """Standard deviation of white noise on a smooth course, from third differences; their variance is 20 σ².

    Differences beyond three standard deviations, such as at a corner, count as if they were no more.

    Parameters
    ----------
    pressure_Pa : array, shape (n,), Pa
        Samples of a trace.

    Returns
    -------
    float
        Pa
    """
    third = np.diff(pressure_Pa, 3) / math.sqrt(20)
    sigma = rough_noise(pressure_Pa)
    for _ in range(CLIPPED_ROUNDS):
        sigma = math.sqrt(float(np.mean(np.minimum(third**2, (CLIPPED * sigma) ** 2))) / KEPT)
    return sigma


def noises_of(readings: Sequence[Readings], rho: float) -> list[GaugeNoise]:
    """Noise of every trace, those of a gauge being about alike; 0 where there is none, or too few readings tell of it.

    Parameters
    ----------
    readings : sequence of Readings
    rho : float
        Correlation of neighbours.

    Returns
    -------
    list of GaugeNoise
    """
    alone = [math.nan] * len(readings)
    for i, each in enumerate(readings):
        if each.values_Pa.size >= FEWEST and not each.all_noise:
            alone[i] = noise_of(whitened(each.values_Pa, rho)[1:] if rho else each.values_Pa)
    told = [sigma for sigma in alone if math.isfinite(sigma)]
    typical = float(np.median(told)) if len(told) > 1 else 0.0
    noises = []
    for sigma, each in zip(alone, readings, strict=True):
        if each.all_noise:
            noises.append(GaugeNoise(each.rounding_Pa, KNOWN, 0.0))
            continue
        told_here = NOISE_DEGREES * each.values_Pa.size if math.isfinite(sigma) else 0.0
        told_by_others = ALIKE if typical > 0 and each.values_Pa.size >= FEWEST_WITH_OTHERS else 0.0
        degrees = told_here + told_by_others
        squares = told_by_others * typical**2 + (told_here * sigma**2 if told_here else 0.0)
        together = max(math.sqrt(squares / degrees), each.rounding_Pa) if degrees else 0.0
        quiet = together <= QUIET * abs(float(np.median(each.values_Pa)))
        noises.append(GaugeNoise(0.0 if quiet else together, degrees, rho))
    return noises


def noise_correlation(traces: Sequence[Floats]) -> float:
    """Correlation of the noise of neighbouring readings, alike in all traces; 0 where it is white as far as they tell.

    Third differences of readings that lie APART are larger than those of neighbours by what these have together. A
    pressure that moves has slow differences too, but not in most of them.

    Parameters
    ----------
    traces : sequence of arrays, shape (n_readings,), Pa

    Returns
    -------
    float
    """
    ratios, counts = [], []
    for readings_Pa in traces:
        far = [readings_Pa[begin::APART] for begin in range(APART)]
        near = noise_of(readings_Pa) if far[-1].size >= FEWEST else 0.0
        if near > QUIET * abs(float(np.median(readings_Pa))):
            # Of readings in coarse steps those far apart may all be the same.
            apart = max(float(np.mean([noise_of(each) ** 2 for each in far])), QUIET * near**2)
            ratios.append(math.log(apart / near**2))
            counts.append(readings_Pa.size)
    if not ratios:
        return 0.0
    chance = SURELY_CORRELATED * math.sqrt(4 / NOISE_DEGREES * APART / sum(counts))
    ratio = float(np.median(ratios))
    if ratio < chance:
        return 0.0
    rhos = np.linspace(0.0, MOST_CORRELATED, 98)
    return float(np.interp(ratio, np.log(_third(rhos**APART) / _third(rhos)), rhos))


def _third(rho: Floats) -> Floats:
    """Variance of third differences of samples of which neighbours have the correlation `rho`, of 1 where it is 0."""
    return np.asarray(1 - 1.5 * rho + 0.6 * rho**2 - 0.1 * rho**3)


def whitened(values: Floats, rho: float) -> Floats:
    """What is new in every reading, where noise of neighbours has the correlation `rho`.

    Parameters
    ----------
    values : array, shape (n,) or (n, k)
        Readings, or columns of a curve through them.
    rho : float

    Returns
    -------
    array, of the same shape
    """
    return whiten(values, np.arange(len(values)) == 0, rho)
