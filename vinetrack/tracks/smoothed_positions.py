"""Positions that were smoothed before they were handed in, told by the frequencies that their noise lacks.

A moving average over N frames takes out all that oscillates N/j times a frame; a polynomial through N frames
(Savitzky & Golay, Anal. Chem. 36, 1627, 1964) takes out what oscillates faster than it bends. No noise of a camera or a
tracker has such holes. Positions of a campaign are compared with both kinds and with correlated noise by Whittle's
likelihood of the spectrum (Whittle, J. R. Stat. Soc. B 15, 125, 1953), above the frequencies of the motion itself.

Noise averaged over N frames hardly changes from one frame to the next: an autoregressive model takes it for a random
walk, beside which a fit sees next to nothing. One frame in N is as good as all, and its noise is independent.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from vinetrack.core.records import Floats, Track, Trial

WINDOWS = (3, 5, 7, 9, 11, 13, 15, 17, 19, 21)
"""Frames that are averaged over or that a polynomial goes through. Chosen: what spreadsheets and filters offer; longer
windows leave of a growth of a hundred frames little to fit."""

DEGREES = (0, 2)
"""Of the polynomials; 0 is the moving average. Derived: of an odd window the middle of degree 1 is that of 0, of 3 that
of 2."""

SLOWEST = 0.06
"""Oscillations a frame from which the spectrum is compared. Chosen: slower ones are motion; at half the release and the
end of growth pass for noise, at twice a third of the spectrum of a window of three is left."""

FEWEST_FRAMES = 40
"""Of a stretch without gaps. Chosen: twenty frequencies; at half hardly any hole is seen, at twice fast vines drop
out."""

UNEVEN = 0.02
"""Part of a frame by which frames may be apart unevenly. Chosen: positions between uneven frames are not those of a
filter, and motion makes noise of them. At half clocks that jitter by a per cent drop out, at twice more count."""

CORRELATIONS = tuple(np.linspace(0.0, 0.9, 10))
"""Of noise that was not smoothed. Chosen: a grid, fine enough for ln L to differ by less than the level asked."""

FALLING = 4.0
"""Power with which the spectrum of a motion falls that is rougher than its noise, as of a tube that sticks and slips
and is read fifty times a second. Derived: that of a jump of the speed."""

LEAST = 1e-5
"""Part of its power that a smoothed noise keeps in a hole. Derived: 1/N⁴ of a taper over N of 20 samples and more."""

MOST_STRETCHES, ROUNDS = 12, 30
"""The longest stretches that are compared, and rounds in which the parts of their spectra are found. Chosen for time: a
tenth of a second. Measured (eight campaigns, tuning seeds 20610 to 20625): with 40 stretches ln L gained 0.6 to 1.8
times as much and nothing was judged otherwise; with half as many it gains about half."""

SURE = 30.0
"""Gain of ln L over noise without holes, and over every other filter, from which positions count as smoothed. Chosen:
tapered neighbours count twice, so that it is a chance of e⁻¹⁵ for each of twenty windows. Measured (laboratories with 8
to 12 trials, tuning seeds 20620 to 20625): smoothed positions gain 48 to 1400, those of eight other kinds 15 at most;
two of twelve gained 12 and 13 less than another filter, and are passed over. At half or twice all these stay so."""


@dataclass(frozen=True)
class Smoothing:
    """Polynomials of this degree, 0 a moving average, through so many frames; `alike` is of how many one is as good."""

    window: int
    degree: int
    alike: int

    def __str__(self) -> str:
        kind = "by a moving average" if self.degree == 0 else f"by polynomials of degree {self.degree}"
        return f"{kind} over {self.window} frames"

    @property
    def note(self) -> str:
        """What a user is told."""
        return (
            f"positions look smoothed {self}: the model is smoothed alike, and one frame in {self.alike} is used; give"
            " them as they were measured, which shows more"
        )

    @property
    def weights(self) -> Floats:
        """Of the frames in the window, shape (window,)."""
        return _weights(self.window, self.degree)


def _weights(window: int, degree: int) -> Floats:
    """What each frame of a window counts in the value that a polynomial through them has in the middle.

    Those of Savitzky and Golay (Anal. Chem. 36, 1627, 1964). SciPy has them too, but takes half a second to be loaded.
    """
    places = np.linspace(-1, 1, window)
    return np.asarray(np.linalg.pinv(np.vander(places, degree + 1))[-1])


def detect_smoothing(pairs: Iterable[tuple[Trial, Track]], rounding_m: float = 0.0) -> Smoothing | None:
    """How the positions of a campaign were smoothed; None where they were not.

    Parameters
    ----------
    pairs : trials of one campaign with their tracks; recordings, whose positions nobody smoothed, are passed over.
    rounding_m : error of rounding where it is most of their noise, as `common_rounding_noise` has it.

    Returns
    -------
    Smoothing or None
        None for rounded positions too: what rounding does to a slow motion has no high frequencies either.
    """
    if rounding_m > 0:
        return None
    spectra = [spectrum for trial, track in pairs if trial.video is None for spectrum in _spectra(track)]
    if not spectra:
        return None
    spectra = sorted(spectra, key=lambda spectrum: -spectrum[0].size)[:MOST_STRETCHES]
    plain = max(_whittle(spectra, [_correlated(f, rho) for f, _ in spectra]) for rho in CORRELATIONS)
    likely: list[tuple[float, Smoothing | None]] = [(plain, None)]
    for window in WINDOWS:
        for degree in DEGREES:
            if degree >= window - 1:
                continue
            weights = _weights(window, degree)
            # Averaged over N frames noise has 1/N of its variance left.
            smoothing = Smoothing(window, degree, max(round(1 / float(weights @ weights)), 2))
            shapes = [np.maximum(_passed(f, weights), LEAST) for f, _ in spectra]
            likely.append((_whittle(spectra, shapes), smoothing))
    likely.sort(key=lambda pair: -pair[0])
    return likely[0][1] if likely[0][0] > likely[1][0] + SURE else None


def _spectra(track: Track) -> Iterator[tuple[Floats, Floats]]:
    """Frequencies, 1/frame, and power of the noise, of every even stretch of a track."""
    time_s, position_m = track.time_s[track.usable], track.lead_position_m[track.usable]
    if time_s.size < FEWEST_FRAMES:
        return
    steps = np.diff(time_s)
    uneven = np.median(np.abs(steps - np.median(steps))) > UNEVEN * np.median(steps)
    if uneven:
        return
    for part in np.split(np.arange(time_s.size), np.flatnonzero(steps > 1.5 * np.median(steps)) + 1):
        if part.size < FEWEST_FRAMES:
            continue
        # Third differences are free of the motion, and change the noise by a known factor.
        rough = np.diff(position_m[part], 3)
        taper = np.hanning(rough.size + 1)[:-1]
        frequency = np.fft.rfftfreq(rough.size)
        power = np.abs(np.fft.rfft(rough * taper)) ** 2
        seen = (frequency > SLOWEST) & (frequency < 0.5)
        power = power[seen] / (2 * np.sin(math.pi * frequency[seen])) ** 6
        if np.all(power > 0):
            yield np.asarray(frequency[seen], dtype=float), power


def _whittle(spectra: Sequence[tuple[Floats, Floats]], shapes: Sequence[Floats]) -> float:
    """Log-likelihood of the spectra as sums of these shapes, white noise and rough motion, in parts of their own.

    The parts maximise it by multiplicative steps (Févotte, Bertin & Durrieu, Neural Computation 21, 793, 2009).
    """
    total = 0.0
    for (frequency, power), shape in zip(spectra, shapes, strict=True):
        bases = np.stack([shape / shape.mean(), np.ones_like(shape), (SLOWEST / frequency) ** FALLING])
        parts = power.mean() * np.array([0.8, 0.1, 0.1])
        for _ in range(ROUNDS):
            modelled = parts @ bases
            parts = parts * np.sqrt((bases @ (power / modelled**2)) / (bases @ (1 / modelled)))
        modelled = parts @ bases
        total -= float(np.sum(np.log(modelled) + power / modelled))
    return total


def _correlated(frequency: Floats, rho: float) -> Floats:
    """Spectrum of autoregressive noise."""
    return np.asarray((1 - rho**2) / (1 - 2 * rho * np.cos(2 * math.pi * frequency) + rho**2))


def _passed(frequency: Floats, weights: Floats) -> Floats:
    """Power that a filter of these weights lets pass."""
    places = np.arange(weights.size) - weights.size // 2
    return np.asarray((np.cos(2 * math.pi * np.outer(frequency, places)) @ weights) ** 2)
