"""By how much the clock of a pressure gauge differs from the camera's, told from the growth that empties a chamber.

A pressure that falls as the tube fills has its corner where the growth begins. So the growth is moved in time to where
it explains the readings of each trace best. One gauge and one camera were used, so the same offset is likely in all:
how often each occurs is estimated along (empirical Bayes: Robbins, Proc. 3rd Berkeley Symp. 1, 157, 1956), and a short
trace, which tells its own to a few samples at best, is led by the others.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.inference.gauge_readings import GaugeNoise, Readings, whitened

MOST_SHIFTED = 60
"""Samples by which the clocks of gauge and camera may differ here. Chosen: 60 frames are 40 ms at 1500 frames/s, beyond
which a clock is mended and not doubted. At half offsets of 20 ms and more are read as bends of the pressure, twice as
many cost twice the time."""

ENOUGH = 400
"""Readings from which an offset is found. Chosen: a few hundred tell it to a frame, more only cost time. At half its
error grows by √2, at twice it falls by as much for traces that are long enough."""

EXPECTATIONS = 30
"""Rounds in which it is estimated how often each thing occurs. Measured: after ten, shares of kinds of curves in twelve
campaigns (kind null:trace of the hidden effects, seeds 20600 to 20611) change by 1e-5 at most."""

FAR_LESS = 4.5
"""Difference in the logarithm of the posterior beyond which an offset belongs to the likeliest no more. Derived: that
of normal errors at three standard deviations; further off lies what every offset has that nothing rules out."""

BENT, ALONG = 1, 2
"""Degrees in time and in growth of the curve by which the offset is found. Chosen: a chamber that empties without heat
is of second degree in the growth to 1e-4 of its pressure, a supply that refills it is slow in time."""


@dataclass(frozen=True)
class Clock:
    """How many samples after a reading the growth was there that belongs to it, and how surely.

    `cost` is −2 ln of how often such an offset occurs.
    """

    offset: float
    sigma: float
    cost: float


@dataclass(frozen=True)
class Growth:
    """The growth of a trial at all samples of its trace, m, shape (n,), and their spacing, s."""

    grown_m: Floats
    frame_s: float

    def at(self, places: Floats) -> Floats:
        """Growth at places among the samples, m; it stands still beyond both ends.

        Parameters
        ----------
        places : array, samples from the first

        Returns
        -------
        array, of the same shape
        """
        return np.interp(places, np.arange(self.grown_m.size), self.grown_m)


def polynomial_along(t: Floats, growth_m: Floats, bent: int, along: int) -> Floats:
    """Powers of time and of growth.

    Parameters
    ----------
    t : array, shape (n,)
        Time on any scale.
    growth_m : array, shape (n,)
        Growth on any scale.
    bent, along : int
        Degrees in time and in growth.

    Returns
    -------
    array, shape (n, bent + along + 1)
        The first column is 1.
    """
    return np.column_stack([*(t**k for k in range(bent + 1)), *(growth_m**k for k in range(1, along + 1))])


def often(likely: Floats) -> Floats:
    """How often each of several things occurs in the other trials of a campaign.

    By expectation and maximisation, with one trial counted beside them that is of every kind alike, so that none is
    ruled out. A trial tells nothing of how often its own kind occurs, or what it shows by chance would make itself
    likely (the collapsed variational rule: Asuncion et al., Proc. 25th UAI, 27, 2009).

    Parameters
    ----------
    likely : array, shape (n_trials, n_kinds)
        Likelihoods, on a scale of its own for each trial; 0 in all of a trial that tells nothing.

    Returns
    -------
    array, of the same shape
    """
    told = likely.any(axis=1)
    n_kinds = likely.shape[1]
    shares: Floats = np.full(likely.shape, 1 / n_kinds)
    for _ in range(EXPECTATIONS if np.count_nonzero(told) > 1 else 0):
        belongs = likely * shares
        belongs = belongs / np.where(told, belongs.sum(axis=1), 1.0)[:, None]
        others = belongs.sum(axis=0) - belongs
        shares = (others + 1 / n_kinds) / (others.sum(axis=1, keepdims=True) + 1)
    return shares


def gauge_clocks(
    read: Sequence[Readings], growths: Sequence[Growth | None], noises: Sequence[GaugeNoise]
) -> list[Clock | None]:
    """The offset of every trace of a campaign.

    Parameters
    ----------
    read : sequence of Readings
    growths : sequence of Growth or None
        Of the same trials.
    noises : sequence of GaugeNoise

    Returns
    -------
    list of Clock or None
        None where nothing grows, or nothing is noisy.
    """
    frames_s = [growth.frame_s for growth in growths if growth is not None]
    if not frames_s:
        return [None] * len(read)
    step_s = float(np.median(frames_s))
    offsets_s: Floats = step_s * np.arange(-MOST_SHIFTED, MOST_SHIFTED + 1.0)
    logs: dict[int, Floats] = {}
    for i, (readings, growth, noise) in enumerate(zip(read, growths, noises, strict=True)):
        if growth is not None and noise.sigma_Pa > 0:
            explained = _explained(readings, growth, noise, offsets_s / growth.frame_s)
            if explained is not None:
                logs[i] = explained
    if not logs:
        return [None] * len(read)
    shares = often(np.exp(np.array(list(logs.values()))))
    clocks: list[Clock | None] = [None] * len(read)
    for (i, explained), share in zip(logs.items(), shares, strict=True):
        posterior = explained + np.log(share)
        best = int(np.argmax(posterior))
        near = posterior > posterior[best] - FAR_LESS
        # What belongs to the likeliest offset reaches without a gap to it.
        gaps = np.flatnonzero(~near)
        begin = int(max(gaps[gaps < best], default=-1)) + 1
        end = int(min(gaps[gaps > best], default=near.size))
        weights = np.exp(posterior[begin:end] - posterior[best])
        around_s = offsets_s[begin:end]
        mean_s = float(np.average(around_s, weights=weights))
        sigma_s = math.sqrt(float(np.average((around_s - mean_s) ** 2, weights=weights)))
        growth = growths[i]
        assert growth is not None
        cost = -2 * math.log(float(np.sum(share[begin:end])))
        clocks[i] = Clock(mean_s / growth.frame_s, sigma_s / growth.frame_s, cost)
    return clocks


def _explained(readings: Readings, growth: Growth, noise: GaugeNoise, offsets: Floats) -> Floats | None:
    """Logarithm of the likelihood of offsets, samples, beside that of the likeliest; None where none tells anything.

    Where no curve explains the readings to their noise, what is left counts as noise.
    """
    size, columns = readings.places.size, BENT + ALONG + 1
    if size <= columns:
        return None
    means = readings.edges is not None
    at = np.arange(growth.grown_m.size) if means else readings.places
    t, y = np.linspace(-1, 1, at.size), whitened(readings.values_Pa - np.mean(readings.values_Pa), noise.rho)
    every = max(size // ENOUGH, 1)
    y = y[::every]
    left = np.full(offsets.size, np.inf)
    for k in np.flatnonzero(np.abs(offsets) <= growth.grown_m.size // 4):
        there_m = growth.at(at + offsets[k])
        range_m = np.ptp(there_m)
        if range_m == 0:
            continue
        curves = polynomial_along(t, (there_m - there_m[0]) / range_m, BENT, ALONG)
        white = whitened(readings.means_of(curves) if means else curves, noise.rho)
        q = np.linalg.qr(white[::every])[0]
        left[k] = y @ y - np.sum((q.T @ y) ** 2)
    least = float(np.min(left))
    if not math.isfinite(least):
        return None
    variance = max(noise.sigma_Pa**2, least / max(y.size - columns - 1, 1))
    return np.asarray(-0.5 * (left - least) / variance)
