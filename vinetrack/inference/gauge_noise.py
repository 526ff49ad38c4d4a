"""A recorded pressure with the noise of its gauge taken out, corners kept.

The speed of a light vine follows the pressure at once, so that 0.1 kPa of noise would throw it about by millimetres
that it never moved; and a noisy pressure passes a threshold early, in every trial by another time.

Where a few numbers explain a trace, they are fitted: a polynomial in time, or, since the pressure falls as the tube
fills and has its corner where the growth begins, a polynomial in time and in the growth that is seen, moved by what the
clocks of gauge and camera differ by (`vinetrack.inference.gauge_clock`), on the scale on which an expanding gas is
straight in the growth. Of the curves that leave only noise that with the least BIC (Schwarz, Ann. Stat. 6, 461, 1978)
is taken: a term too many bends the speed all through a trial, at 0.1 kPa of noise by more than its positions err. How
often each kind of curve occurs in a campaign is estimated along (empirical Bayes: Robbins, Proc. 3rd Berkeley Symp. 1,
157, 1956), and so is the exponent of the gas, which all trials have together. Where a second kind is not much less
likely, the curve is the mean of both, and what they differ by an error. Where no curve will do, straight lines
are laid around every sample through ever more neighbours, for as long as what is left beside them looks like noise and
each agrees with all narrower ones: wide where the pressure runs straight, narrow at a corner (the intersection of
confidence intervals: Goldenshluger & Nemirovski, Math. Methods Stat. 6, 135, 1997).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.polynomial.legendre import legvander

from vinetrack.core.constants import AMBIENT_PRESSURE_PA
from vinetrack.core.records import Floats, Track
from vinetrack.inference.gauge_clock import Clock, Growth, gauge_clocks, often, polynomial_along
from vinetrack.inference.gauge_readings import (
    FEWEST,
    GaugeNoise,
    Readings,
    gauge_readings,
    noise_correlation,
    noise_of,
    noises_of,
    whitened,
)

HALF_WIDTHS = (2, 3, 5, 8, 12, 18, 27, 40, 60, 90, 135, 200, 300, 450, 680, 1000)
"""Half widths of the smoothing lines, samples. Chosen: each half as wide again as the one before, so that the best
width is met within a quarter."""

AGREE_SIGMAS = 4.0
"""Half of the interval about each line's value that must share a point with those of all narrower lines. Chosen
(Lepski's rule with κ of 3 to 4): at half corners are found in noise, at twice corners are rounded."""

CHANCE = 1e-5
"""At which noise leaves more beside a line than is let pass. Chosen: one false alarm in 1e5 traces; its square root at
half the number of standard deviations."""

MOST_BENT, LOOKED_BEYOND, SLOW_SIGMAS = 6, 12, 4.0
"""Degree of a curve at most; of so many degrees beyond its own none may show by so many standard deviations. Chosen:
sixth degree follows any filling and draining seen. Derived: 4 standard deviations are a chance of 1e-3 among the
nineteen that are asked of a trace; at half three traces in five would be refused their curve, at twice a slow part of
eight standard errors stays."""

LOCAL_SIGMAS = 5.0
"""Standard deviations by which a sum of neighbouring residuals may stand out. Chosen: of a thousand samples in sixteen
widths one does by chance in two hundred traces; at 4 one in five, and the lines are taken where a curve would do."""

EXPONENTS = (1.0, 1.1, 1.2, 1.3, 1.4)
"""Exponents by which a chamber may empty into the tube, (P + P_air) V^γ: curves are fitted to the pressure on the scale
on which it is then straight in the growth. Derived: 1 with heat, 1.4 without. On falls of 5 to 8 kPa a line along
the growth is off by 44 to 120 Pa at the start on the plain scale, by 4 to 7 with an exponent wrong by 0.1 (measured on
`gauge_slow_depletion` of the laboratories, seeds 20602 and 30019)."""

ALONG_GROWTH = ((0, 1), (0, 2), (1, 1), (1, 2), (1, 3), (2, 2), (2, 3), (3, 4))
"""Degrees in time and in growth that are tried. Chosen: a chamber that empties without heat is of second degree in the
growth to 1e-4 of its pressure, a supply that refills it is slow in time."""

LEAST_WEIGHT = 0.01
"""Probability beside the likeliest from which a kind of curve counts. Chosen: a tenth of what such a kind differs by is
an error then; at half and at twice 0.07 and 0.14 of it are left out."""

LAST_PART, GOES_ON = 0.1, 0.2
"""Part of a trace along whose line it goes on beyond its end, and for how long, in parts of it. Measured: offsets of
13.5, 25 and 40 ms between clocks in 16 trials of 0.2 to 0.4 s (`trace_clock` of the laboratories, tuning seeds 20611 to
20613). With an end that is held a fit finds 6 to 9, 11 to 13 and 20 to 23 ms; with this 11 to 13, 21 to 25, 31 to 37.
At half or twice the first it finds the same to 4 ms; at half of the second 18 to 22 of 25 ms and 25 to 27 of 40."""

SMALL_ERROR = 1e-3
"""Part of the variance of all errors of a curve below which a direction of them is left out. Chosen: 3 % of their
standard deviation, at half 2 and at twice 4 %; each costs a simulation of its trial."""


@dataclass(frozen=True)
class QuietTrace:
    """A recorded pressure without its noise, s and Pa, shape (n,).

    `mean_error_Pa` is the standard deviation of its mean, 0 where the trace was left as it is. The columns of
    `errors_Pa`, shape (n, n_errors), are one standard deviation each of what else the curve may be wrong by. Where it
    `is_curve` these follow from it; of lines through neighbouring samples they only say how much it is in all.
    """

    time_s: Floats
    pressure_Pa: Floats
    mean_error_Pa: float
    errors_Pa: Floats
    is_curve: bool = False

    def extended(self) -> QuietTrace:
        """The trace with one more sample beyond its end, along the line through its last part.

        Where the clock of the gauge is behind that of the camera, the last frames were filmed under a pressure that was
        not recorded any more. Held there, a falling pressure would keep a fit from finding the offset of the clocks.
        """
        last_s, span_s = self.time_s[-1], np.ptp(self.time_s)
        late = self.time_s >= last_s - LAST_PART * span_s
        if np.count_nonzero(late) < 2:
            return self
        curves = np.column_stack([self.pressure_Pa, self.errors_Pa])
        slope = np.polyfit(self.time_s[late] - last_s, curves[late], 1)[0]
        end = curves[-1] + slope * GOES_ON * span_s
        # A gauge pressure that falls does not fall below that of the air.
        end[0] = max(end[0], min(curves[-1, 0], 0.0))
        return QuietTrace(
            np.append(self.time_s, last_s + GOES_ON * span_s),
            np.append(self.pressure_Pa, end[0]),
            self.mean_error_Pa,
            np.vstack([self.errors_Pa, end[1:]]),
            self.is_curve,
        )


@dataclass(frozen=True)
class _Recorded:
    """A trace with noise to be taken out: its readings, of how many samples, their noise, and the growth beside it.

    `growth` and `clock` are None where nothing is known to grow. The exponent by which a chamber empties has an error,
    which `alike` trials have together.
    """

    readings: Readings
    count: int
    noise: GaugeNoise
    growth: Growth | None
    clock: Clock | None
    exponent: float = EXPONENTS[len(EXPONENTS) // 2]
    exponent_sigma: float = 0.0
    alike: int = 1

    def basis(self, kind: int, off: float = 0.0) -> tuple[Floats, Floats]:
        """Columns of a kind of curve at the readings, where they are orthonormal, and at all samples.

        The first is the mean. What few readings tell is known between them too: a pressure that follows the growth
        bends where it does. The clocks may be so many standard deviations `off`.
        """
        at_samples = self._columns(kind, np.arange(float(self.count)), off)
        means = self.readings.edges is not None
        at_readings = self.readings.means_of(at_samples) if means else self._columns(kind, self.readings.places, off)
        q, r = np.linalg.qr(at_readings)
        return q, np.linalg.solve(r.T, at_samples.T).T

    def _columns(self, kind: int, at: Floats, off: float) -> Floats:
        """Powers of time, or of time and growth, at places among the samples."""
        places = self.readings.places
        t = 2 * (at - places[0]) / (places[-1] - places[0]) - 1
        if kind <= MOST_BENT:
            return legvander(t, kind)
        assert self.growth is not None
        assert self.clock is not None
        offset = self.clock.offset + off * self.clock.sigma
        seen_m = self.growth.at(places + offset)
        grown = (self.growth.at(at + offset) - seen_m[0]) / np.ptp(seen_m)
        return polynomial_along(t, grown, *ALONG_GROWTH[kind - MOST_BENT - 1])

    def criteria(self, exponents: Sequence[float] | None = None) -> Floats:
        """BIC of every kind of curve, infinite where it leaves more than noise.

        Of shape (n_kinds,), or (n_exponents, n_kinds) for several exponents by which the chamber may empty.
        """
        recorded = [self] if exponents is None else [replace(self, exponent=exponent) for exponent in exponents]
        y = whitened(np.column_stack([each._straight(self.readings.values_Pa) for each in recorded]), self.noise.rho)
        size, degrees = len(y), self.noise.degrees
        slow = _polynomials(size, min(MOST_BENT + LOOKED_BEYOND, size // 3))
        bent = [kind + 1 < slow.shape[1] for kind in range(MOST_BENT + 1)]
        along = [self.clock is not None and sum(of) <= size // 3 - 2 for of in ALONG_GROWTH]
        values = np.full((len(recorded), len(bent) + len(along)), math.inf)
        for kind in np.flatnonzero(bent + along):
            basis = np.linalg.qr(whitened(self.basis(int(kind))[0], self.noise.rho))[0]
            numbers, clock_cost = basis.shape[1], 0.0
            if kind > MOST_BENT:
                assert self.clock is not None
                numbers, clock_cost = numbers + 1, self.clock.cost - math.log(size)
            for value, left in zip(values, (y - basis @ (basis.T @ y)).T, strict=True):
                if _is_noise(left, self.noise, numbers, slow):
                    # Where the noise itself is known from few differences, what is left weighs as Student's t has it.
                    spread = float(left @ left) / (degrees * self.noise.sigma_Pa**2)
                    value[kind] = (degrees + size) * math.log1p(spread) + math.log(size) * numbers + clock_cost
        return values[0] if exponents is None else values

    def averaged(self, weights: Floats) -> tuple[Floats, float, Floats]:
        """As `curve`, of kinds of these weights: what they differ by is an error of their mean as well.

        Bayesian model averaging (Hoeting et al., Stat. Sci. 14, 382, 1999).
        """
        kinds = np.flatnonzero(weights)
        if not kinds.size:
            return self.curve(None)
        smooth_Pa, of_mean_Pa, errors_Pa = self.curve(int(np.argmax(weights)))
        every_Pa = [errors_Pa, *self._by_clock_and_exponent(int(np.argmax(weights)))]
        if kinds.size == 1:
            return smooth_Pa, of_mean_Pa, _fewest(np.column_stack(every_Pa))
        shares = weights[kinds] / weights[kinds].sum()
        curves_Pa = np.column_stack([self.curve(int(kind))[0] for kind in kinds])
        mean_Pa = curves_Pa @ shares
        between_Pa = (curves_Pa - mean_Pa[:, None]) * np.sqrt(shares)
        every_Pa.append(between_Pa - np.mean(between_Pa, axis=0))
        return mean_Pa, of_mean_Pa, _fewest(np.column_stack(every_Pa))

    def _by_clock_and_exponent(self, kind: int) -> list[Floats]:
        """What a curve along the growth is wrong by where clock or exponent are, by one standard deviation each, Pa.

        n trials have that of the exponent, σ, together. Told trial by trial, each is given √n σ: what all have then
        costs what one error does; no more, though, than the exponents that there are leave it.
        """
        if kind <= MOST_BENT:
            return []
        moved_Pa = [
            0.5 * (self.curve(kind, off=1.0)[0] - self.curve(kind, off=-1.0)[0]),
            0.5 * (self._emptying(1.0).curve(kind)[0] - self._emptying(-1.0).curve(kind)[0]),
        ]
        return [each - np.mean(each) for each in moved_Pa if np.ptp(each) > 0]

    def _emptying(self, off: float) -> _Recorded:
        sigma = min(math.sqrt(self.alike) * self.exponent_sigma, (EXPONENTS[-1] - EXPONENTS[0]) / math.sqrt(12))
        return replace(self, exponent=self.exponent + off * sigma)

    def curve(self, kind: int | None, off: float = 0.0) -> tuple[Floats, float, Floats]:
        """The curve of a kind, Pa, how well its mean is known, Pa, and a standard deviation each of what else is wrong.

        All are at the samples. Without a kind the curve is made of straight lines.
        """
        noise, values_Pa = self.noise, self.readings.values_Pa
        if kind is None:
            # Of a pressure that moves a correlation may be told that is none of its noise.
            white_Pa = noise_of(values_Pa) if values_Pa.size >= FEWEST else noise.sigma_Pa
            noise = replace(noise, sigma_Pa=white_Pa, rho=0.0)
            # What straight lines leave wrong is slow where they are long: as wrong as a curve of so many degrees.
            basis = _polynomials(values_Pa.size, min(MOST_BENT, values_Pa.size - 2))
            curves = np.column_stack([_lines(values_Pa, noise), noise.sigma_Pa * basis])
            at_samples = _at_samples(curves, self.readings.places, self.count)
            smooth, per_error = at_samples[:, 0], at_samples[:, 1:]
        else:
            basis, basis_at_samples = self.basis(kind, off)
            q, r = np.linalg.qr(whitened(basis, noise.rho))
            per_error = noise.sigma_Pa * np.linalg.solve(r.T, basis_at_samples.T).T
            straight = basis_at_samples @ np.linalg.solve(r, q.T @ whitened(self._straight(values_Pa), noise.rho))
            smooth, slope = self._pressure(straight)
            per_error = per_error * slope[:, None]
        means = np.mean(per_error, axis=0)
        return smooth, float(np.linalg.norm(means)), (per_error - means)[:, 1:]

    @property
    def _typical_Pa(self) -> float:
        """Absolute pressure about which scales agree."""
        return max(float(np.median(self.readings.values_Pa)), -0.5 * AMBIENT_PRESSURE_PA) + AMBIENT_PRESSURE_PA

    def _straight(self, pressure_Pa: Floats) -> Floats:
        """Pressure on the scale on which it is straight in the growth of a tube that empties its chamber, Pa."""
        whole = np.maximum(pressure_Pa + AMBIENT_PRESSURE_PA, 0.1 * AMBIENT_PRESSURE_PA) / self._typical_Pa
        return np.asarray(-self.exponent * self._typical_Pa * whole ** (-1 / self.exponent))

    def _pressure(self, straight: Floats) -> tuple[Floats, Floats]:
        """The pressure of values on that scale, Pa, and its slope against them."""
        part = np.maximum(-straight / (self.exponent * self._typical_Pa), 0.01)
        return self._typical_Pa * part**-self.exponent - AMBIENT_PRESSURE_PA, part ** (-self.exponent - 1)


def _fewest(errors_Pa: Floats) -> Floats:
    """The same covariance of errors in as few columns as it takes: kinds that are alike differ in the same way."""
    along, sizes_Pa, _ = np.linalg.svd(errors_Pa, full_matrices=False)
    tells = sizes_Pa**2 > SMALL_ERROR * np.sum(sizes_Pa**2)
    return np.asarray((along * sizes_Pa)[:, tells])


def quiet_traces(tracks: Sequence[Track]) -> list[QuietTrace | None]:
    """Recorded pressures of the trials of a campaign without the noise of their gauge; None where there are none.

    How often each kind of curve occurs among them is estimated along, and weighs in: where all pressures stand still, a
    bend that a single trace shows by chance is noise.

    Parameters
    ----------
    tracks : sequence of Track

    Returns
    -------
    list of QuietTrace or None
        At the samples that are known.
    """
    times: dict[int, Floats] = {}
    recorded: list[tuple[Floats, Growth | None]] = []
    for i, track in enumerate(tracks):
        if track.pressure_Pa is None:
            continue
        known = np.isfinite(track.pressure_Pa) & np.isfinite(track.time_s)
        if np.count_nonzero(known) < 2:
            continue
        times[i] = track.time_s[known].astype(float)
        seen = track.usable & np.isfinite(track.lead_position_m) & np.isfinite(track.time_s)
        growth = None
        if np.count_nonzero(seen) > 1:
            grown_m = np.interp(times[i], track.time_s[seen], track.lead_position_m[seen])
            growth = Growth(grown_m, float(np.median(np.diff(times[i]))))
        recorded.append((track.pressure_Pa[known].astype(float), growth))
    quiet = dict(zip(times, _quieted(recorded), strict=True))
    return [QuietTrace(times[i], *quiet[i]) if i in times else None for i in range(len(tracks))]


def _quieted(traces: Sequence[tuple[Floats, Growth | None]]) -> list[tuple[Floats, float, Floats, bool]]:
    """Of traces with the growth in each all but the times of a `QuietTrace`."""
    read = gauge_readings([pressure_Pa for pressure_Pa, _ in traces])
    rho = noise_correlation([readings.values_Pa for readings in read if not readings.all_noise])
    noises = noises_of(read, rho)
    growths = [growth for _, growth in traces]
    clocks = gauge_clocks(read, growths, noises)
    noisy = {
        i: _Recorded(readings, traces[i][0].size, noise, growth, clock)
        for i, (readings, noise, growth, clock) in enumerate(zip(read, noises, growths, clocks, strict=True))
        if noise.sigma_Pa > 0
    }
    noisy = _emptied_alike(noisy)
    criteria = np.array([recorded.criteria() for recorded in noisy.values()])
    weights = dict(zip(noisy, _weights(criteria), strict=True)) if noisy else {}
    quiet = []
    for i, (pressure_Pa, _) in enumerate(traces):
        if i in noisy:
            quiet.append((*noisy[i].averaged(weights[i]), bool(np.any(weights[i]))))
        else:
            quiet.append((pressure_Pa, 0.0, np.zeros((pressure_Pa.size, 0)), False))
    return quiet


def _emptied_alike(noisy: dict[int, _Recorded]) -> dict[int, _Recorded]:
    """The traces with the exponent by which their chamber empties, which is that of all, and its error."""
    least = np.array([np.min(each.criteria(EXPONENTS), axis=1) for each in noisy.values()])
    told = least[np.isfinite(least).all(axis=1)] if noisy else np.zeros((0, len(EXPONENTS)))
    levels = np.sum(told, axis=0)
    likely = np.exp(-0.5 * (levels - np.min(levels)))
    exponent = float(np.average(EXPONENTS, weights=likely))
    # Each stands for all about it.
    width = (EXPONENTS[-1] - EXPONENTS[0]) / (len(EXPONENTS) - 1)
    variance = float(np.average((np.array(EXPONENTS) - exponent) ** 2, weights=likely)) + width**2 / 12
    return {
        i: replace(each, exponent=exponent, exponent_sigma=math.sqrt(variance), alike=len(noisy))
        for i, each in noisy.items()
    }


def _at_samples(curves: Floats, places: Floats, count: int) -> Floats:
    """Columns at so many samples, of their values at places among them; they go on straight beyond the outermost."""
    samples = np.arange(count)
    if places.size == count:
        return curves
    inside = np.column_stack([np.interp(samples, places, curve) for curve in curves.T])
    for end, beyond in (([0, 1], samples < places[0]), ([-1, -2], samples > places[-1])):
        near, next_to = end
        slope = (curves[near] - curves[next_to]) / (places[near] - places[next_to])
        inside[beyond] = curves[near] + np.outer(samples[beyond] - places[near], slope)
    return inside


def _weights(criteria: Floats) -> Floats:
    """How likely each kind of curve is beside the likeliest, of the shape of `criteria`, (n_traces, n_kinds).

    0 where it is not likely enough to matter, and for all kinds of a trace of which none will do.
    """
    possible = np.asarray(np.isfinite(criteria).any(axis=1))
    lowest = np.where(possible, criteria.min(axis=1), 0.0)
    totals = criteria - 2 * np.log(often(np.exp(-0.5 * (criteria - lowest[:, None]))))
    least = np.where(possible, totals.min(axis=1), 0.0)
    weights = np.where(possible[:, None], np.exp(-0.5 * (totals - least[:, None])), 0.0)
    return np.where(weights >= LEAST_WEIGHT, weights, 0.0)


def _polynomials(count: int, degree: int) -> Floats:
    """Orthonormal polynomials in time, shape (count, degree + 1)."""
    return np.asarray(np.linalg.qr(legvander(np.linspace(-1, 1, count), degree))[0])


def _is_noise(residual_Pa: Floats, noise: GaugeNoise, fitted: int, slow: Floats) -> bool:
    """Whether what a curve of so many fitted numbers leaves has neither a slow part nor more than the noise."""
    if np.any(np.abs(slow.T @ residual_Pa) > _reach_Pa(SLOW_SIGMAS, noise)):
        return False
    # A corner that is cut stands out over the samples about it and nowhere else.
    total = np.concatenate([[0.0], np.cumsum(residual_Pa)])
    local = _reach_Pa(LOCAL_SIGMAS, noise)
    for width in (2 * half + 1 for half in HALF_WIDTHS if 2 * half < residual_Pa.size):
        if np.max(np.abs(total[width:] - total[:-width])) > local * np.sqrt(width):
            return False
    return bool(residual_Pa @ residual_Pa <= _most_left(noise, residual_Pa.size - fitted))


def _reach_Pa(sigmas: float, noise: GaugeNoise) -> float:
    """How far chance reaches, Pa, that of normal noise would reach so many standard deviations, were they known."""
    from scipy.special import ndtr, stdtrit

    return -noise.sigma_Pa * float(stdtrit(noise.degrees, ndtr(-sigmas)))


def _most_left(noise: GaugeNoise, degrees: Floats | int) -> Any:
    """Sum of squares of noise of so many degrees of freedom at most, Pa²."""
    from scipy.special import fdtri

    return noise.sigma_Pa**2 * degrees * fdtri(degrees, noise.degrees, 1 - CHANCE)


def _lines(pressure_Pa: Floats, noise: GaugeNoise) -> Floats:
    """A line through as many neighbours of every sample as agree with it."""
    smooth = pressure_Pa.copy()
    low, high = np.full(smooth.size, -np.inf), np.full(smooth.size, np.inf)
    agrees = np.ones(smooth.size, dtype=bool)
    for half in HALF_WIDTHS:
        value, part, left, degrees = _line(pressure_Pa, half)
        reach = AGREE_SIGMAS * noise.sigma_Pa * part
        low, high = np.maximum(low, value - reach), np.minimum(high, value + reach)
        agrees &= (low <= high) & (left < _most_left(noise, degrees))
        if not agrees.any():
            break
        smooth[agrees] = value[agrees]
    return smooth


def _line(y: Floats, half: int) -> tuple[Floats, Floats, Floats, Floats]:
    """Value at every sample of a line through its neighbours, `half` to each side where there are so many.

    With it the standard deviation of that value, as part of a sample's, and the sum of squares beside the line with its
    degrees of freedom. Shapes (n,).
    """
    y_mean = float(np.mean(y))
    y = y - y_mean
    place = np.arange(y.size)
    first, last = np.maximum(place - half, 0), np.minimum(place + half, y.size - 1) + 1
    x = place - 0.5 * (y.size - 1)
    sums = [np.concatenate([[0.0], np.cumsum(values)]) for values in (x, x * x, y, x * y, y * y)]
    count = (last - first).astype(float)
    mean_x, mean_xx, mean_y, mean_xy, mean_yy = ((values[last] - values[first]) / count for values in sums)
    spread = mean_xx - mean_x**2
    away = x - mean_x
    joint = mean_xy - mean_x * mean_y
    beside = np.maximum(mean_yy - mean_y**2 - joint**2 / spread, 0.0) * count
    part = np.sqrt((1 + away**2 / spread) / count)
    return y_mean + mean_y + joint / spread * away, part, beside, count - 2
