"""Clock offset between pressure gauge and camera, estimated from the growth that empties the chamber.

A pressure that falls as the tube fills has its corner where growth begins. So the growth is shifted in time to where it
explains the readings of each trace best. All trials share gauge and camera, so that the same offset is likely: the
distribution of offsets in the other trials is the prior of each (empirical Bayes: Robbins, Proc. 3rd Berkeley Symp. 1,
157, 1956), since a short trace determines its own offset to a few samples at best.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.inference.gauge_readings import GaugeNoise, Readings, whitened

LARGEST_OFFSET_FRAMES = 60  # Largest clock offset, samples (chosen)

ENOUGH_READINGS = 400  # Readings used to estimate an offset (chosen)

EM_ITERATIONS = 30  # Iterations of the expectation–maximisation of frequencies (measured)

PEAK_LOG_WIDTH = 4.5  # Log posterior below the maximum down to which an offset belongs to its peak (derived)

# Degrees in time and in growth of the curve by which the offset is estimated (chosen)
TIME_DEGREE, GROWTH_DEGREE = 1, 2


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
    """Powers of time and of growth. Returns the first column is 1. Shapes: t, growth_m (n,) → (n, bent + along + 1)."""
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
    for _ in range(EM_ITERATIONS if np.count_nonzero(informative) > 1 else 0):
        responsibilities = likelihoods * shares
        responsibilities = responsibilities / np.where(informative, responsibilities.sum(axis=1), 1.0)[:, None]
        counts_of_others = responsibilities.sum(axis=0) - responsibilities
        shares = (counts_of_others + 1 / n_kinds) / (counts_of_others.sum(axis=1, keepdims=True) + 1)
    return shares


def gauge_clocks(
    read: Sequence[Readings], growths: Sequence[Growth | None], noises: Sequence[GaugeNoise]
) -> list[Clock | None]:
    """Clock offset of every trace of a campaign."""
    frames_s = [growth.frame_s for growth in growths if growth is not None]
    if not frames_s:
        return [None] * len(read)
    step_s = float(np.median(frames_s))
    offsets_s: Floats = step_s * np.arange(-LARGEST_OFFSET_FRAMES, LARGEST_OFFSET_FRAMES + 1.0)
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
        in_peak = posterior > posterior[best] - PEAK_LOG_WIDTH
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
    size, columns = readings.places.size, TIME_DEGREE + GROWTH_DEGREE + 1
    if size <= columns:
        return None
    means = readings.edges is not None
    at = np.arange(growth.grown_m.size) if means else readings.places
    t, y = np.linspace(-1, 1, at.size), whitened(readings.values_Pa - np.mean(readings.values_Pa), noise.rho)
    stride = max(size // ENOUGH_READINGS, 1)
    y = y[::stride]
    residual_squares = np.full(offsets.size, np.inf)
    for k in np.flatnonzero(np.abs(offsets) <= growth.grown_m.size // 4):
        shifted_m = growth.at(at + offsets[k])
        range_m = np.ptp(shifted_m)
        if range_m == 0:
            continue
        curves = polynomial_along(t, (shifted_m - shifted_m[0]) / range_m, TIME_DEGREE, GROWTH_DEGREE)
        white = whitened(readings.means_of(curves) if means else curves, noise.rho)
        q = np.linalg.qr(white[::stride])[0]
        residual_squares[k] = y @ y - np.sum((q.T @ y) ** 2)
    least = float(np.min(residual_squares))
    if not math.isfinite(least):
        return None
    variance = max(noise.sigma_Pa**2, least / max(y.size - columns - 1, 1))
    return np.asarray(-0.5 * (residual_squares - least) / variance)
