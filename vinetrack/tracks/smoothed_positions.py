"""Detect positions that were smoothed before they were handed in, by the frequencies that their noise lacks.

A moving average over N frames removes the frequencies j/N a frame; a polynomial through N frames (Savitzky & Golay,
Anal. Chem. 36, 1627, 1964) removes what oscillates faster than it bends. Noise of a camera or a tracker has no such
holes. The spectra of a campaign's positions, above the frequencies of the motion itself, are compared with both kinds
of filter and with correlated noise by Whittle's likelihood (Whittle, J. R. Stat. Soc. B 15, 125, 1953).

Noise averaged over N frames hardly changes from one frame to the next: an autoregressive model takes it for a random
walk, under which a fit can detect next to nothing. One frame in N carries the same information, and its noise is
independent.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from vinetrack.core.records import Floats, Track, Trial

LOWEST_FREQUENCY = 0.06  # Lowest frequency, in cycles a frame, at which the spectra are compared (chosen)

FEWEST_FRAMES = 40  # Fewest frames of a stretch without gaps (chosen)

# Median deviation of the spacings, as a part of their median, above which a track is not used (chosen)
UNEVEN_PART = 0.02

CORRELATIONS = tuple(np.linspace(0.0, 0.9, 10))  # Lag-one correlations of noise that was not smoothed (chosen)

# Gain of ln L over noise without holes, and over every other filter, above which positions count as smoothed (chosen)
SURE_GAIN = 30.0


@dataclass(frozen=True)
class Smoothing:
    """A filter: polynomials of this degree (0 is a moving average) through a window of so many frames. Every
    `decimation`-th smoothed frame carries the information of all.
    """

    window: int
    degree: int
    decimation: int

    def __str__(self) -> str:
        kind = "by a moving average" if self.degree == 0 else f"by polynomials of degree {self.degree}"
        return f"{kind} over {self.window} frames"

    @property
    def note(self) -> str:
        """Sentence for the user."""
        return (
            f"positions look smoothed {self}: the model is smoothed in the same way, and one frame in"
            f" {self.decimation} is used; give the positions as they were measured, which contain more information"
        )

    @property
    def weights(self) -> Floats:
        """Filter weights of the frames in the window, shape (window,)."""
        return _filter_weights(self.window, self.degree)


def _filter_weights(window: int, degree: int) -> Floats:
    """Weight of each frame of a window in the value in its middle of a polynomial through them. They are those of
    Savitzky and Golay (Anal. Chem. 36, 1627, 1964). SciPy has them too, but takes half a second to load.
    """
    places = np.linspace(-1, 1, window)
    return np.asarray(np.linalg.pinv(np.vander(places, degree + 1))[-1])


def detect_smoothing(pairs: Iterable[tuple[Trial, Track]], rounding_m: float = 0.0) -> Smoothing | None:
    """Find the filter with which the positions of a campaign were smoothed; None where they were not."""
    if rounding_m > 0:
        return None
    spectra = [spectrum for trial, track in pairs if trial.video is None for spectrum in _spectra(track)]
    if not spectra:
        return None
    # The twelve longest stretches are compared.
    spectra = sorted(spectra, key=lambda spectrum: -spectrum[0].size)[:12]
    unsmoothed = max(_whittle(spectra, [_ar1_spectrum(f, rho) for f, _ in spectra]) for rho in CORRELATIONS)
    ranked: list[tuple[float, Smoothing | None]] = [(unsmoothed, None)]
    # Filters are compared by their windows, in frames.
    for window in (3, 5, 7, 9, 11, 13, 15, 17, 19, 21):
        # Degrees of the polynomials; 0 is the moving average.
        for degree in (0, 2):
            if degree >= window - 1:
                continue
            weights = _filter_weights(window, degree)
            # Noise averaged over N frames keeps 1/N of its variance.
            smoothing = Smoothing(window, degree, max(round(1 / float(weights @ weights)), 2))
            # Part of its power that smoothed noise keeps in a hole.
            shapes = [np.maximum(_power_response(f, weights), 1e-5) for f, _ in spectra]
            ranked.append((_whittle(spectra, shapes), smoothing))
    ranked.sort(key=lambda pair: -pair[0])
    return ranked[0][1] if ranked[0][0] > ranked[1][0] + SURE_GAIN else None


def _spectra(track: Track) -> Iterator[tuple[Floats, Floats]]:
    """Frequencies, 1/frame, and periodogram of the noise, of every evenly spaced stretch of a track."""
    time_s, position_m = track.time_s[track.usable], track.lead_position_m[track.usable]
    if time_s.size < FEWEST_FRAMES:
        return
    steps = np.diff(time_s)
    uneven = np.median(np.abs(steps - np.median(steps))) > UNEVEN_PART * np.median(steps)
    if uneven:
        return
    for part in np.split(np.arange(time_s.size), np.flatnonzero(steps > 1.5 * np.median(steps)) + 1):
        if part.size < FEWEST_FRAMES:
            continue
        # Third differences remove the motion, and change the noise by a known factor.
        third_differences = np.diff(position_m[part], 3)
        taper = np.hanning(third_differences.size + 1)[:-1]
        frequency = np.fft.rfftfreq(third_differences.size)
        power = np.abs(np.fft.rfft(third_differences * taper)) ** 2
        compared = (frequency > LOWEST_FREQUENCY) & (frequency < 0.5)
        power = power[compared] / (2 * np.sin(math.pi * frequency[compared])) ** 6
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


def _ar1_spectrum(frequency: Floats, rho: float) -> Floats:
    """Spectrum of first-order autoregressive noise."""
    return np.asarray((1 - rho**2) / (1 - 2 * rho * np.cos(2 * math.pi * frequency) + rho**2))


def _power_response(frequency: Floats, weights: Floats) -> Floats:
    """Squared frequency response of a filter with these weights."""
    places = np.arange(weights.size) - weights.size // 2
    return np.asarray((np.cos(2 * math.pi * np.outer(frequency, places)) @ weights) ** 2)
