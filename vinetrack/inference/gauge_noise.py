"""A recorded pressure with the noise of its gauge taken out, corners kept.

The speed of a light vine follows the pressure at once, so that 0.1 kPa of noise would throw it about by millimetres
that it never moved; and a noisy pressure passes a threshold early, in every trial by another time.

Where a few numbers explain a trace, they are fitted: a polynomial in time, or, since the pressure falls as the tube
fills and has its corner where the growth begins, a polynomial in time and in the growth that is seen. Gauge and camera
may differ in their clocks, so the growth may be shifted, by any of so many samples alike. Of the curves that leave only
noise that with the least BIC (Schwarz, Ann. Stat. 6, 461, 1978) is taken: a term too many bends the speed all
through a trial, at 0.1 kPa of noise by more than its positions err. How often each kind of curve occurs in a campaign
is estimated along (empirical Bayes: Robbins, Proc. 3rd Berkeley Symp. 1, 157, 1956). Where a second kind is not much
less likely, the curve is the mean of both, and what they differ by an error. Where no curve will do, straight lines
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

from vinetrack.core.records import Floats, Track
from vinetrack.inference.gauge_readings import (
    FEWEST,
    GaugeNoise,
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

MOST_SHIFTED, COARSE = 60, 4
"""Samples by which the clocks of gauge and camera may differ here, and the step in which that is looked for first.
Chosen: 60 frames are 40 ms at 1500 frames/s, beyond which a clock is mended and not doubted; a step of four samples is
refined to one."""

ENOUGH = 400
"""Samples from which the shift is found. Chosen: a few hundred tell it to a frame, more only cost time."""

ALONG_GROWTH = ((0, 1), (0, 2), (1, 1), (1, 2), (1, 3), (2, 2), (2, 3), (3, 4))
"""Degrees in time and in growth that are tried. Chosen: a chamber that empties without heat is of second degree in the
growth to 1e-4 of its pressure, a supply that refills it is slow in time."""


EXPECTATIONS = 30
"""Rounds in which it is estimated how often each kind of curve occurs. Measured: after ten, shares in twelve
campaigns (kind null:trace of the hidden effects, seeds 20600 to 20611) change by 1e-5 at most."""


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
    `errors_Pa`, shape (n, n_errors), are one standard deviation each of what else the curve may be wrong by.
    """

    time_s: Floats
    pressure_Pa: Floats
    mean_error_Pa: float
    errors_Pa: Floats

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
        )


@dataclass(frozen=True)
class _Recorded:
    """A trace with noise to be taken out: samples, Pa, their noise, and the growth at each, m.

    `growth_m` is shifted to where it explains the pressure best, of so many `shifts`; None where nothing is known to
    grow.
    """

    pressure_Pa: Floats
    noise: GaugeNoise
    growth_m: Floats | None
    shifts: int

    def basis(self, kind: int) -> Floats:
        """Orthonormal columns of a kind of curve, the first of them the mean."""
        if kind <= MOST_BENT:
            return _polynomials(self.pressure_Pa.size, kind)
        assert self.growth_m is not None
        return np.asarray(np.linalg.qr(_along(self.growth_m, *ALONG_GROWTH[kind - MOST_BENT - 1]))[0])

    def criteria(self) -> list[float]:
        """BIC of every kind of curve, infinite where it leaves more than noise."""
        rho, y = self.noise.rho, whitened(self.pressure_Pa, self.noise.rho)
        slow = _polynomials(y.size, min(MOST_BENT + LOOKED_BEYOND, y.size // 3))
        bent = [(kind + 1 < slow.shape[1], False) for kind in range(MOST_BENT + 1)]
        most = y.size // 3 - 2 if self.growth_m is not None else -1
        along = [(sum(degrees) <= most, True) for degrees in ALONG_GROWTH]
        # The shift of the growth is one of so many, each as likely as the others.
        shift_cost = 2 * math.log(self.shifts)
        values = []
        for kind, (possible, shifted) in enumerate(bent + along):
            values.append(math.inf)
            if not possible:
                continue
            basis = np.linalg.qr(whitened(self.basis(kind), rho))[0]
            left, numbers = y - basis @ (basis.T @ y), basis.shape[1]
            if _is_noise(left, self.noise, numbers + shifted, slow):
                penalty = math.log(y.size) * numbers + shifted * shift_cost
                # Where the noise itself is known from few differences, what is left weighs as Student's t has it.
                degrees = self.noise.degrees
                spread = float(left @ left) / (degrees * self.noise.sigma_Pa**2)
                values[-1] = (degrees + y.size) * math.log1p(spread) + penalty
        return values

    def averaged(self, weights: Floats) -> tuple[Floats, float, Floats]:
        """As `curve`, of kinds of these weights: what they differ by is an error of their mean as well.

        Bayesian model averaging (Hoeting et al., Stat. Sci. 14, 382, 1999).
        """
        kinds = np.flatnonzero(weights)
        if not kinds.size:
            return self.curve(None)
        smooth_Pa, of_mean_Pa, errors_Pa = self.curve(int(np.argmax(weights)))
        if kinds.size == 1:
            return smooth_Pa, of_mean_Pa, errors_Pa
        shares = weights[kinds] / weights[kinds].sum()
        curves_Pa = np.column_stack([self.curve(int(kind))[0] for kind in kinds])
        mean_Pa = curves_Pa @ shares
        between_Pa = (curves_Pa - mean_Pa[:, None]) * np.sqrt(shares)
        every_Pa = np.column_stack([errors_Pa, between_Pa - np.mean(between_Pa, axis=0)])
        # The same covariance in as few columns as it takes: kinds that are alike differ in the same way.
        along, sizes_Pa, _ = np.linalg.svd(every_Pa, full_matrices=False)
        tells = sizes_Pa**2 > SMALL_ERROR * np.sum(sizes_Pa**2)
        return mean_Pa, of_mean_Pa, (along * sizes_Pa)[:, tells]

    def curve(self, kind: int | None) -> tuple[Floats, float, Floats]:
        """The curve of a kind, Pa, how well its mean is known, Pa, and a standard deviation each of what else is wrong.

        Without a kind it is made of straight lines.
        """
        noise = self.noise
        if kind is None:
            # Of a pressure that moves a correlation may be told that is none of its noise.
            white_Pa = noise_of(self.pressure_Pa) if self.pressure_Pa.size >= FEWEST else noise.sigma_Pa
            noise = replace(noise, sigma_Pa=white_Pa, rho=0.0)
            # What straight lines leave wrong is slow where they are long: as wrong as a curve of so many degrees.
            basis = _polynomials(self.pressure_Pa.size, min(MOST_BENT, self.pressure_Pa.size - 2))
            smooth = _lines(self.pressure_Pa, noise)
        else:
            basis = self.basis(kind)
        q, r = np.linalg.qr(whitened(basis, noise.rho))
        per_error = noise.sigma_Pa * np.linalg.solve(r.T, basis.T).T
        if kind is not None:
            smooth = basis @ np.linalg.solve(r, q.T @ whitened(self.pressure_Pa, noise.rho))
        means = np.mean(per_error, axis=0)
        return smooth, float(np.linalg.norm(means)), (per_error - means)[:, 1:]


def without_noise(pressure_Pa: Floats, growth_m: Floats | None = None) -> Floats:
    """Pressure, shape (n,), of samples about evenly spaced, with white noise taken out.

    Returns the same values where there is no noise to speak of, or too few samples (under 9) to tell.

    Parameters
    ----------
    pressure_Pa : array, shape (n,), Pa
        Samples of a trace.
    growth_m : array, shape (n,), m, optional
        Position of the leading edge at the same instants.

    Returns
    -------
    array, shape (n,), Pa
    """
    return _quieted([(pressure_Pa, growth_m)])[0][0]


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
    recorded = []
    for i, track in enumerate(tracks):
        if track.pressure_Pa is None:
            continue
        known = np.isfinite(track.pressure_Pa) & np.isfinite(track.time_s)
        if np.count_nonzero(known) < 2:
            continue
        times[i] = track.time_s[known].astype(float)
        seen = track.usable & np.isfinite(track.lead_position_m) & np.isfinite(track.time_s)
        grows = np.count_nonzero(seen) > 1
        growth_m = np.interp(times[i], track.time_s[seen], track.lead_position_m[seen]) if grows else None
        recorded.append((track.pressure_Pa[known].astype(float), growth_m))
    quiet = dict(zip(times, _quieted(recorded), strict=True))
    return [QuietTrace(times[i], *quiet[i]) if i in times else None for i in range(len(tracks))]


def _quieted(traces: Sequence[tuple[Floats, Floats | None]]) -> list[tuple[Floats, float, Floats]]:
    """Of traces with the growth in each the pressure without noise, how wrong its mean is, and what else is, Pa."""
    read = gauge_readings([pressure_Pa for pressure_Pa, _ in traces])
    rho = noise_correlation([readings.values_Pa for readings in read if not readings.all_noise])
    noisy: dict[int, _Recorded] = {}
    for i, ((_, growth_m), readings, noise) in enumerate(zip(traces, read, noises_of(read, rho), strict=True)):
        if noise.sigma_Pa > 0:
            grows = growth_m is not None and np.ptp(growth_m) > 0
            shifted_m = (
                _shifted(readings.values_Pa, readings.places, growth_m) if growth_m is not None and grows else None
            )
            shifts = 2 * _reach(growth_m.size) + 1 if growth_m is not None else 1
            noisy[i] = _Recorded(readings.values_Pa, noise, shifted_m, shifts)
    criteria = np.array([recorded.criteria() for recorded in noisy.values()])
    weights = dict(zip(noisy, _weights(criteria), strict=True)) if noisy else {}
    quiet = []
    for i, ((pressure_Pa, _), readings) in enumerate(zip(traces, read, strict=True)):
        if i not in noisy:
            quiet.append((pressure_Pa, 0.0, np.zeros((pressure_Pa.size, 0))))
            continue
        smooth_Pa, of_mean_Pa, errors_Pa = noisy[i].averaged(weights[i])
        curves = _at_samples(np.column_stack([smooth_Pa, errors_Pa]), readings.places, pressure_Pa.size)
        quiet.append((curves[:, 0], of_mean_Pa, curves[:, 1:]))
    return quiet


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
    totals = criteria - 2 * np.log(_often(criteria))
    possible = np.asarray(np.isfinite(criteria).any(axis=1))
    least = np.where(possible, totals.min(axis=1), 0.0)
    weights = np.where(possible[:, None], np.exp(-0.5 * (totals - least[:, None])), 0.0)
    return np.where(weights >= LEAST_WEIGHT, weights, 0.0)


def _often(criteria: Floats) -> Floats:
    """How often each kind of curve occurs among the other traces, of the shape of `criteria`, (n_traces, n_kinds).

    By expectation and maximisation, with one trace counted beside them that is of every kind alike, so that none is
    ruled out. A trace tells nothing of how often its own kind occurs, or one bend by chance would make itself likely
    (the collapsed variational rule: Asuncion et al., Proc. 25th UAI, 27, 2009).
    """
    told = np.asarray(np.isfinite(criteria).any(axis=1))
    n_kinds = criteria.shape[1]
    least = np.where(told, criteria.min(axis=1), 0.0)
    likely = np.where(told[:, None], np.exp(-0.5 * (criteria - least[:, None])), 0.0)
    often: Floats = np.full(criteria.shape, 1 / n_kinds)
    for _ in range(EXPECTATIONS if np.count_nonzero(told) > 1 else 0):
        belongs = likely * often
        belongs = belongs / np.where(told, belongs.sum(axis=1), 1.0)[:, None]
        others = belongs.sum(axis=0) - belongs
        often = (others + 1 / n_kinds) / (others.sum(axis=1, keepdims=True) + 1)
    return often


def _polynomials(count: int, degree: int) -> Floats:
    """Orthonormal polynomials in time, shape (count, degree + 1)."""
    from numpy.polynomial.legendre import legvander

    return np.asarray(np.linalg.qr(legvander(np.linspace(-1, 1, count), degree))[0])


def _along(growth_m: Floats, bent: int, along: int) -> Floats:
    """Powers of time and of growth, shape (n, bent + along + 1)."""
    t, g = np.linspace(-1, 1, growth_m.size), (growth_m - growth_m[0]) / np.ptp(growth_m)
    return np.column_stack([t**k for k in range(bent + 1)] + [g**k for k in range(1, along + 1)])


def _reach(count: int) -> int:
    """Samples by which the growth may be shifted, either way, of so many."""
    return min(count // 4, MOST_SHIFTED)


def _shifted(pressure_Pa: Floats, places: Floats, growth_m: Floats) -> Floats:
    """The growth at readings, of shape (n,), moved by as many samples as explain their pressure best.

    `growth_m`, shape (n_samples,), is that of all samples.
    """
    reach = _reach(growth_m.size)
    samples = np.arange(growth_m.size)
    every = max(places.size // ENOUGH, 1)

    def moved(shift: int) -> Floats:
        return np.interp(places + shift, samples, growth_m)

    def explained(shift: int) -> float:
        there_m = moved(shift)
        if not np.ptp(there_m) > 0:
            return -math.inf
        few = np.linalg.qr(_along(there_m, 1, 2)[::every])[0]
        return float(np.sum((few.T @ pressure_Pa[::every]) ** 2))

    best = max(range(-reach, reach + 1, COARSE), key=explained)
    return moved(max(range(best - COARSE, best + COARSE + 1), key=explained))


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
    from scipy.stats import norm, t

    return noise.sigma_Pa * float(t.isf(norm.sf(sigmas), noise.degrees))


def _most_left(noise: GaugeNoise, degrees: Floats | int) -> Any:
    """Sum of squares of noise of so many degrees of freedom at most, Pa²."""
    from scipy.stats import f

    return noise.sigma_Pa**2 * degrees * f.isf(CHANCE, degrees, noise.degrees)


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
