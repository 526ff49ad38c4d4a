"""What a gauge read, and the noise of its readings.

A gauge that is read a hundred times a second has fewer readings than a film has frames. Between them a trace is filled
up by straight lines or by repeating the last value, and its noise is no longer independent from frame to frame; nor is
that of a gauge behind a filter. Either would pass for a pressure that wanders, which a light vine follows.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.inference.whitening import whiten
from vinetrack.tracks.position_noise import rough_noise

STRAIGHT = 1e-9
"""Part of the largest pressure by which neighbours may be off a straight line that was drawn between readings. Derived:
a million times the rounding of double precision, and as much as six decimals of a kilopascal leave of one."""

FILLED = 0.25
"""Part of the samples that lie straight between their neighbours from which a trace is taken for filled up. Chosen: of
three samples a reading a third do, of white noise none; at half a trace of which an eighth stands still is
taken for one, at twice a gauge of two fifths of the frame rate is not seen."""

QUIET = 1e-4
"""Noise below this part of the median pressure is rounding, and left as it is. Chosen: a tenth of the last digit that
pressure gauges print."""

FEWEST = 9
"""Samples below which a trace does not tell its noise. Derived: twice the degrees of freedom of a cubic, and one."""

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


def gauge_readings(pressure_Pa: Floats) -> tuple[Floats, Floats] | None:
    """Readings of a gauge among samples that were filled up between them; None where they were not.

    Parameters
    ----------
    pressure_Pa : array, shape (n,), Pa
        Samples, evenly spaced.

    Returns
    -------
    places : array, shape (n_readings,)
        Where each was read, in samples from the first, increasing.
    values : array, shape (n_readings,), Pa
    """
    if pressure_Pa.size < 4:
        return None
    bends = np.abs(np.diff(pressure_Pa, 2)) > STRAIGHT * float(np.max(np.abs(pressure_Pa)))
    if not bends.any() or np.mean(~bends) < FILLED:
        return None
    steps = np.diff(pressure_Pa) == 0.0
    return _held(pressure_Pa) if np.mean(steps) > FILLED else _joined(pressure_Pa, bends)


def _held(pressure_Pa: Floats) -> tuple[Floats, Floats]:
    """Readings that were repeated until the next; each was read up to a sample before it shows first."""
    first = np.flatnonzero(np.diff(pressure_Pa, prepend=np.nan) != 0.0)
    return np.maximum(first - 0.5, 0.0), pressure_Pa[first]


def _joined(pressure_Pa: Floats, bends: NDArray[np.bool_]) -> tuple[Floats, Floats]:
    """Readings that were joined by straight lines: where two neighbouring lines meet.

    `bends` tells of samples 1 to n − 2 which are not straight between their neighbours. A reading between two samples
    bends both.
    """
    inner = np.flatnonzero(bends) + 1
    groups = np.split(inner, np.flatnonzero(np.diff(inner) > 1) + 1)
    # Before the first and behind the last of them the ends of the trace stand for readings that are not in it.
    places, values = [0.0], [float(pressure_Pa[0])]
    for group in groups:
        left, right = int(group[0]), int(group[-1])
        slopes = pressure_Pa[left] - pressure_Pa[left - 1], pressure_Pa[right + 1] - pressure_Pa[right]
        if left == right or slopes[0] == slopes[1]:
            place = 0.5 * (left + right)
        else:
            apart = pressure_Pa[right] - pressure_Pa[left] - slopes[1] * (right - left)
            place = left + float(np.clip(apart / (slopes[0] - slopes[1]), 0.0, right - left))
        places.append(place)
        values.append(float(pressure_Pa[left] + slopes[0] * (place - left)))
    return np.array([*places, float(pressure_Pa.size - 1)]), np.array([*values, float(pressure_Pa[-1])])


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


def noises_of(traces: Sequence[Floats], rho: float) -> list[GaugeNoise]:
    """Noise of every trace, those of a gauge being about alike; 0 where there is none, or too few readings tell of it.

    Parameters
    ----------
    traces : sequence of arrays, shape (n_readings,), Pa
    rho : float
        Correlation of neighbours.

    Returns
    -------
    list of GaugeNoise
    """
    alone = [
        noise_of(whitened(readings_Pa, rho)[1:] if rho else readings_Pa) if readings_Pa.size >= FEWEST else 0.0
        for readings_Pa in traces
    ]
    told = [sigma for sigma, readings_Pa in zip(alone, traces, strict=True) if readings_Pa.size >= FEWEST]
    typical = float(np.median(told)) if len(told) > 1 else 0.0
    noises = []
    for sigma, readings_Pa in zip(alone, traces, strict=True):
        told_here = NOISE_DEGREES * readings_Pa.size if readings_Pa.size >= FEWEST else 0.0
        told_by_others = ALIKE if typical > 0 and readings_Pa.size >= FEWEST_WITH_OTHERS else 0.0
        degrees = told_here + told_by_others
        together = math.sqrt((told_here * sigma**2 + told_by_others * typical**2) / degrees) if degrees else 0.0
        quiet = together <= QUIET * abs(float(np.median(readings_Pa)))
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
            ratios.append(math.log(float(np.mean([noise_of(each) ** 2 for each in far])) / near**2))
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
