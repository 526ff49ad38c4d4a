"""Release of a trial, its steady windows, and the force in them.

Windows are steady by an equivalence test (gated rule), by the paper's rule, or chosen by hand. The gated rule finds the
longest stretch, well above rest, whose change of speed is shown to be small (an equivalence test), rather than merely
not shown to be large.

The paper's rule is a coefficient of variation below 3 % over at least three points: Alvarez et al., "High-Velocity,
Pressure-Driven Eversion for Rapid Vine Robots", IEEE RA-L 2025. It also accepts frames at rest, drifting speeds and
chance agreement; it is computed too, for comparison.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from vinetrack.core.records import END_FRACTION, Floats, Indices, Kinematics, Track, Trial, with_flag
from vinetrack.core.units import GRAVITY_M_S2
from vinetrack.dynamics.audit import evaluate
from vinetrack.dynamics.model import Model
from vinetrack.experiment.settings import SteadySettings
from vinetrack.tracks.position_noise import ar1_sd, rest_points

# ------------------------------------------------------------------------------
# Release time and resting position of the leading edge: the zeros of time and position of a trial.


@dataclass(frozen=True)
class Release:
    """Onset of motion and resting position of the leading edge; `time_s` is NaN where nothing moves. A track
    `moving_from_start` has no rest: `reason` says whether its zeros are extrapolated or those of its first point.
    """

    time_s: float
    lead_position_m: float
    lead_position_sigma_m: float
    moving_from_start: bool
    reason: str


@dataclass(frozen=True)
class Window:
    """A window tested by one rule; speeds of the tail. `doubtful`: the user's choice, though not shown steady."""

    rule: str
    accepted: bool
    reason: str
    from_s: float = math.nan
    to_s: float = math.nan
    n_points: int = 0
    x_ss_m_s: float = math.nan
    x_ss_sigma_m_s: float = math.nan
    drift: float = math.nan
    drift_95: tuple[float, float] = (math.nan, math.nan)
    cv: float = math.nan
    doubtful: bool = False


@dataclass(frozen=True)
class TrialMotion:
    """Model-independent results of a trial: its corrected track, motion, release, and windows by rule."""

    trial: Trial
    track: Track
    kinematics: Kinematics
    release: Release
    windows: Mapping[str, Window]


def find_release(track: Track, kinematics: Kinematics) -> Release:
    """Find the resting position of the leading edge and the time of its release."""
    time_s, position_m = _points(track)
    n_rest = rest_points(position_m)
    span_m = float(np.ptp(kinematics.lead_position_m))
    # 5.0: standard deviations of a position by which the track must leave its start to count as moving
    if n_rest == position_m.size or not (span_m > 5.0 * kinematics.noise_m and span_m > 0):
        origin_m, sigma_m = _resting_level(position_m, kinematics)
        return Release(math.nan, origin_m, sigma_m, False, "the leading edge never moves forward beyond its noise")
    # 3: fewest points at rest that define a resting position (chosen)
    if n_rest < 3:
        return _moving_from_start(time_s, kinematics)
    origin_m, sigma_m = _resting_level(position_m[: max(n_rest - 2, 1)], kinematics)
    onset_s = _onset(time_s, position_m, n_rest, origin_m, kinematics)
    reason = f"at rest for {n_rest} points, then moving from {onset_s:.5g} s"
    return Release(onset_s, origin_m, sigma_m, False, reason)


def flag_rest(track: Track, release: Release) -> Track:
    """Flag every row before the release with `before_release`."""
    if not math.isfinite(release.time_s) or release.moving_from_start:
        return track
    return track.flagged(track.time_s < release.time_s, "before_release")


def _resting_level(position_m: Floats, kinematics: Kinematics) -> tuple[float, float]:
    """Mean of the points at rest and its standard error under AR(1) noise."""
    mean = np.full(position_m.size, 1 / position_m.size)
    return float(position_m.mean()), kinematics.noise_m * ar1_sd(mean, kinematics.noise_correlation)


def _moving_from_start(time_s: Floats, kinematics: Kinematics) -> Release:
    """Extrapolate to zero speed with the first acceleration where that is close, else use the first point."""
    velocity, acceleration = kinematics.lead_velocity_m_s[0], kinematics.lead_acceleration_m_s2[0]
    step_s = float(np.median(np.diff(time_s)))
    first_m = float(kinematics.lead_position_m[0])
    back_s = velocity / acceleration if acceleration > 0 else math.inf
    # 20: frames by which an extrapolated release may precede the first frame (chosen)
    moving = f"moving at the first point ({velocity:.3g} m/s)"
    if -step_s / 2 <= back_s <= 20 * step_s:
        back_s = max(back_s, 0.0)
        origin_m = float(first_m - 0.5 * velocity * back_s)
        sigma_m = math.hypot(kinematics.noise_m, 0.5 * velocity * back_s)
        reason = f"{moving}; release extrapolated {back_s * 1e3:.3g} ms back at {acceleration:.3g} m/s²"
        return Release(float(time_s[0]) - back_s, origin_m, sigma_m, True, reason)
    reason = f"{moving}, and the start cannot be extrapolated: zeros set to the first point"
    return Release(float(time_s[0]), first_m, kinematics.noise_m, True, reason)


def _onset(time_s: Floats, position_m: Floats, n_rest: int, origin_m: float, kinematics: Kinematics) -> float:
    """Time at which the edge leaves rest, by the best least-squares fit of y = y₀ + b·(t − t₀)^p with p = 1, 3/2 or 2.
    A vine of small mass reaches full speed within a frame (p = 1), a heavy one has constant acceleration (p = 2). The
    fit uses the points around the onset and on until the edge has clearly left its resting position, at least three.
    """
    travel = position_m - origin_m
    # 15.0: travel, in standard deviations of a position, at which motion is certain (chosen)
    clear = max(15.0 * kinematics.noise_m, 1e-9, 1e-6 * float(np.ptp(position_m)))
    lifted = np.flatnonzero(travel[n_rest - 1 :] > clear)
    off = n_rest - 1 + (int(lifted[0]) if lifted.size else 0)
    take = slice(max(n_rest - 10, 0), min(off + 3, position_m.size))
    frame_s = float(np.median(np.diff(time_s)))
    t, y = (time_s[take] - time_s[off]) / frame_s, travel[take]
    starts = np.arange(t[0] if off - take.start < 60 else -60.0, 0.0, 0.05)
    best_s, least = 0.0, math.inf
    for power in (1.0, 1.5, 2.0):
        shape = np.maximum(t - starts[:, None], 0.0) ** power
        norm = np.sum(shape**2, axis=1)
        cost = np.sum(y**2) - (shape @ y) ** 2 / np.maximum(norm, 1e-300)
        at = int(np.argmin(cost))
        if cost[at] < least:
            best_s, least = float(starts[at]), float(cost[at])
    return float(time_s[off] + best_s * frame_s)


# ------------------------------------------------------------------------------
# Least squares over windows of raw positions with AR(1) noise: speed, drift and their standard errors.


class WindowMoments:
    """Quadratic fits to the raw positions of any window in constant time, from cumulative sums of moments. A window of
    a fiftieth of the track loses seven of sixteen digits to their differences.
    """

    def __init__(self, time_s: Floats, position_m: Floats, noise_m: float, correlation: float) -> None:
        self.noise_m, self.correlation = noise_m, correlation
        self.unit_s = max(float(time_s[-1] - time_s[0]), np.finfo(float).tiny) / 2
        self.u = u = (time_s - (time_s[0] + time_s[-1]) / 2) / self.unit_s
        y = position_m - position_m.mean()
        terms = np.array([np.ones_like(u), u, u**2, u**3, u**4, y, y * u, y * u**2])
        self.sums = np.pad(np.cumsum(terms, axis=1), ((0, 0), (1, 0)))

    def drift(self, first: Indices, last: Indices) -> tuple[Floats, Floats, Floats]:
        """Fit a parabola to the positions in many windows of one length at once. Returns mean lead speed, m/s; relative
        change of speed from end to end; standard error of that. Shapes: first, last (n_windows,) → (n_windows,).
        """
        sums = self.sums[:, last + 1] - self.sums[:, first]
        half, middle = (self.u[last] - self.u[first]) / 2, (self.u[first] + self.u[last]) / 2
        # Moments about the middle of each window, Σ(u − m)ᵏ by repeated shifts, in units of its half-width
        for terms in (sums[:5], sums[5:]):
            for order in range(1, len(terms)):
                for k in range(len(terms) - 1, order - 1, -1):
                    terms[k] -= middle * terms[k - 1]
            terms /= [half**k for k in range(len(terms))]
        n, s1, s2, s3, s4, y0, y1, y2 = sums
        # Normal equations of 1, w, w² with the constant eliminated.
        a11, a12, a22 = s2 - s1 * s1 / n, s3 - s1 * s2 / n, s4 - s2 * s2 / n
        b1, b2 = y1 - s1 * y0 / n, y2 - s2 * y0 / n
        determinant = a11 * a22 - a12**2
        slope, curve = (a22 * b1 - a12 * b2) / determinant, (a11 * b2 - a12 * b1) / determinant
        # Error of a curvature under AR(1) noise over that under white noise
        weights = np.linspace(-1, 1, int(last[0] - first[0]) + 1) ** 2
        weights -= np.mean(weights)
        gain = ar1_sd(weights, self.correlation) / float(np.linalg.norm(weights))
        with np.errstate(divide="ignore", invalid="ignore"):
            sigma = 4 * self.noise_m * gain * np.sqrt(a11 / determinant) / np.abs(slope)
            return slope / (half * self.unit_s), 4 * curve / slope, sigma


def judge(time_s: Floats, position_m: Floats, kinematics: Kinematics, first: int, last: int, rule: str) -> Window:
    """Measure speed, drift and variation in a window of at least three points by least squares on the raw positions,
    with errors for AR(1) noise; the rule decides about acceptance. Where the points scatter about their cubic
    significantly more than the track's noise, the errors are those of the scatter. The error of x_ss includes the
    difference of the mean speeds of a cubic and of the line. Shapes: time_s, position_m (n,).
    """
    inside = slice(first, last + 1)
    t, y, noise_m, rho = time_s[inside], position_m[inside], kinematics.noise_m, kinematics.noise_correlation
    n, half = t.size, float(t[-1] - t[0]) / 2
    u, y = (t - (t[0] + t[-1]) / 2) / half, y - y.mean()
    order = min(3, n - 1)
    # Row k has the weights of the highest coefficient of a Legendre fit of order k: line, parabola, cubic.
    rows = [np.linalg.pinv(np.polynomial.legendre.legvander(u, k))[k] for k in range(1, order + 1)]
    residual = y - np.polynomial.legendre.legval(u, np.polynomial.legendre.legfit(u, y, order))
    # The track's noise, or the scatter in this window where it is larger by more than three standard errors
    effective = n * (1 - rho**2) / (1 + rho**2) - order - 1
    variance = float(np.sum(residual**2)) / max(n - order - 1, 1)
    if effective >= 2 and variance > noise_m**2 * (1 + 3 * math.sqrt(2 / effective)):
        noise_m = math.sqrt(variance)
    errors = [noise_m * ar1_sd(row, rho) for row in rows]
    slope, curve, bend = (float(row @ y) for row in (*rows, 0 * u)[:3])
    bend = math.sqrt(max(bend**2 - errors[-1] ** 2, 0.0))  # P₃ moves the ends by 2 of its coefficient
    # d(c₂P₂)/du runs from −3c₂ to 3c₂
    drift, drift_sigma = (6 * curve / slope, 6 * errors[1] / abs(slope)) if slope != 0 else (math.nan, math.nan)
    velocity = kinematics.lead_velocity_m_s[inside]
    return Window(
        rule=rule,
        accepted=False,
        reason="",
        from_s=float(t[0]),
        to_s=float(t[-1]),
        n_points=n,
        x_ss_m_s=kinematics.travel_ratio * slope / half,
        x_ss_sigma_m_s=kinematics.travel_ratio * math.hypot(errors[0], bend) / half,
        drift=drift,
        drift_95=(drift - 1.96 * drift_sigma, drift + 1.96 * drift_sigma),
        cv=float(velocity.std(ddof=1) / abs(velocity.mean())) if velocity.mean() != 0 else math.nan,
    )


SHORTEST_SHARE = 0.1  # Shortest steady window, as a fraction of the motion (derived)

BAND_SIGMAS = 4.0  # Standard errors by which a single velocity may lie outside the band


def gated_window(track: Track, kinematics: Kinematics, limits: SteadySettings, *, length_m: float = math.nan) -> Window:
    """Find the longest window in which the speed is shown to be constant within the drift limit."""
    time_s, position_m = _points(track)
    drift_limit = limits.drift_limit
    first, last, why = _gate(kinematics, limits)
    if why:
        return Window("gated", False, why)
    inside = slice(first, last + 1)
    latest = _before_the_end(track, position_m, first, last, length_m) - first
    steady, nearest = _longest_steady(time_s[inside], position_m[inside], kinematics, inside, latest, drift_limit)
    if steady is None:
        return Window("gated", False, nearest)
    window = judge(time_s, position_m, kinematics, first + steady[0], first + steady[1], "gated")
    moving = last - first + 1
    reason = (
        f"steady over {window.n_points} of {moving} moving points: speed changes by {_percent(window)},"
        f" within ±{100 * drift_limit:g} %"
    )
    return replace(window, accepted=True, reason=reason)


def user_window(
    track: Track, kinematics: Kinematics, window_s: tuple[float, float], limits: SteadySettings, length_m: float
) -> Window:
    """Evaluate a window chosen by hand, which is always used; `reason` warns where it is not steady by these limits."""
    time_s, position_m = _points(track)
    inside = np.flatnonzero((time_s >= window_s[0]) & (time_s <= window_s[1]))
    if inside.size < 3:
        reason = (
            f"the chosen window {window_s[0]:g}:{window_s[1]:g} s contains {inside.size} usable points, at least 3 are"
            f" needed; the track runs from {time_s[0]:g} to {time_s[-1]:g} s"
        )
        return Window("user", False, reason)
    window = judge(time_s, position_m, kinematics, int(inside[0]), int(inside[-1]), "user")
    if not window.x_ss_m_s > 0:
        reason = f"chosen by hand; warning: the mean tail speed is {window.x_ss_m_s:.3g} m/s"
        return replace(window, accepted=True, doubtful=True, reason=reason)
    steady = max(abs(window.drift_95[0]), abs(window.drift_95[1])) <= limits.drift_limit
    warnings = [] if steady else ["not shown to be steady"]
    first, last, why = _gate(kinematics, limits)
    if not why and inside[-1] > _before_the_end(track, position_m, first, last, length_m):
        warnings.append("runs into the end of growth")
    verdict = "; warning: ".join(["chosen by hand", *warnings])
    reason = f"{verdict}: speed changes by {_percent(window)} over {window.n_points} points"
    return replace(window, accepted=True, doubtful=bool(warnings), reason=reason)


def _points(track: Track) -> tuple[Floats, Floats]:
    """Times and raw positions at the usable points, which are those of the kinematics."""
    usable = track.usable
    return track.time_s[usable], track.lead_position_m[usable]


def _gate(kinematics: Kinematics, limits: SteadySettings) -> tuple[int, int, str]:
    """First and last point between which a window may lie, or the reason why there is none."""
    velocity, sigma = kinematics.lead_velocity_m_s, kinematics.lead_velocity_sigma_m_s
    top_speed = float(np.max(velocity - 3 * sigma))  # a lower limit, so that noise does not raise the gate
    if velocity.size < 3 or top_speed <= 0:
        return 0, 0, "nothing moves faster than three standard errors of its velocity"
    moving = velocity > np.maximum(limits.start_fraction * top_speed, limits.start_sigmas * sigma)
    points = np.flatnonzero(moving)
    if points.size < 3:
        faster = f"{limits.start_fraction:g} of the top speed and {limits.start_sigmas:g} standard errors"
        return 0, 0, f"only {points.size} points move faster than {faster}"
    return int(points[0]), int(points[-1]), ""


def _before_the_end(track: Track, position_m: Floats, first: int, last: int, length_m: float) -> int:
    """Last point that a window may contain: not in the last part of the growth, where that ends or is about to end."""
    grown_m = float(np.max(position_m[first : last + 1])) - float(position_m[0])
    # Growth has ended where the track is flagged so, or where a vine that moved is at rest again. A recording that
    # stops during the motion shows neither, but the length of the vine may show that growth is nearly complete.
    ended = last < position_m.size - 1 or with_flag(track.flag, "after_end").any()
    if grown_m > END_FRACTION * length_m:
        grown_m, ended = max(grown_m, length_m), True
    if not ended:
        return last
    reach_m = position_m[0] + END_FRACTION * grown_m
    beyond = np.flatnonzero(position_m[first : last + 1] > reach_m)
    return max(first + int(beyond[0]) - 1, first + 2) if beyond.size else last


def _longest_steady(
    time_s: Floats, position_m: Floats, kinematics: Kinematics, inside: slice, latest: int, drift_limit: float
) -> tuple[tuple[int, int] | None, str]:
    """First and last point of the longest steady window up to `latest`, or why there is none; of several the one whose
    speed changes least. Windows shrink by half a per cent of the motion at a time. Shapes: moving points, (n,).
    """
    from scipy.ndimage import maximum_filter1d, minimum_filter1d

    n, noise_m, rho = time_s.size, kinematics.noise_m, kinematics.noise_correlation
    moments = WindowMoments(time_s, position_m, noise_m, rho)
    velocity, width = kinematics.lead_velocity_m_s[inside], kinematics.window_points[inside]
    # Speeds that must lie within the band, by the points that each spans: those smoothed, and chords of the raw
    # positions over 1, 2, 4 … frames. Nothing is smoothed in a chord, so that a window may extend right up to the
    # start-up or the end of growth without being affected by those.
    speeds = {0: (velocity, BAND_SIGMAS * kinematics.lead_velocity_sigma_m_s[inside])}
    for span in (1 << k for k in range(max(1, (n - 1) // 2).bit_length())):
        gap_s = time_s[span:] - time_s[:-span]
        chord = (position_m[span:] - position_m[:-span]) / gap_s
        speeds[span] = chord, BAND_SIGMAS * noise_m * math.sqrt(2 * (1 - rho**span)) / gap_s
    nearest, least = "fewer points move than one smoothing window holds", math.inf
    # 0.02, 200: shortest window, as a fraction of the motion, and number of lengths that are tried (chosen)
    for length in range(min(n, latest + 1), max(3, math.ceil(0.02 * n)) - 1, -max(1, n // 200)):
        first = np.arange(latest + 2 - length)
        last = first + length - 1
        allowed = length >= width[(first + last) // 2] / 2 + 2
        mean, drift, sigma = moments.drift(first, last)
        worst = np.where(allowed & (mean > 0), np.abs(drift) + 1.96 * sigma, np.inf)
        # 1 / 3: where the speed falls by more than this part of the limit, a window may be that short (chosen)
        long_enough = (length >= SHORTEST_SHARE * n) | (drift < -(1 / 3) * drift_limit)
        steady = (worst <= drift_limit) & long_enough
        for span, (speed, error) in speeds.items():
            if span < length and steady.any():
                size, at = length - span, first + (length - span) // 2
                highest_low = maximum_filter1d(speed - error, size)[at]
                lowest_high = minimum_filter1d(speed + error, size)[at]
                # The band that holds every speed is as wide as the drift that is allowed.
                steady &= highest_low <= (1 + drift_limit / 2) * mean
                steady &= lowest_high >= (1 - drift_limit / 2) * mean
        if steady.any():
            start = int(np.argmin(np.where(steady, worst, np.inf)))
            return (start, start + length - 1), ""
        near = int(np.argmin(worst))
        if worst[near] < least:
            least = worst[near]
            nearest = (
                f"no window is shown to be steady within ±{100 * drift_limit:g} %: across the nearest, {length} of {n}"
                f" moving points, speed changes by {100 * drift[near]:.2g} ± {196 * sigma[near]:.2g} %"
                f"{'' if least > drift_limit else ' from end to end, and more between'}"
            )
    return None, nearest


def _percent(window: Window) -> str:
    low, high = window.drift_95
    return f"{100 * window.drift:.2g} % (95 %: {100 * low:.2g} to {100 * high:.2g} %)"


def paper_window(track: Track, *, travel_ratio: float, cv_limit: float = 0.03, min_points: int = 3) -> Window:
    """Find the window of the published rule: the longest run whose velocities vary by less than 3 %, wherever it is.
    Velocities are central differences of the raw positions, as Physics Tracker computes them.
    """
    time_s, position_m = _points(track)
    if time_s.size < min_points + 2:
        return Window("paper", False, f"{time_s.size} points are too few for {min_points} central differences")
    velocity = (position_m[2:] - position_m[:-2]) / (time_s[2:] - time_s[:-2])
    level = float(np.median(velocity))
    zero = 1e-9 * float(np.max(np.abs(velocity)))  # a mean below this is a rounding error of 0
    total = np.concatenate([[0.0], np.cumsum(velocity - level)])
    square = np.concatenate([[0.0], np.cumsum((velocity - level) ** 2)])
    for length in range(velocity.size, min_points - 1, -1):  # the longest; of several the one that varies least
        sums = total[length:] - total[:-length]
        spread = np.maximum(square[length:] - square[:-length] - sums**2 / length, 0.0) / (length - 1)
        mean = sums / length + level
        good = np.flatnonzero((spread < (cv_limit * mean) ** 2) & (np.abs(mean) > zero))
        if good.size:
            start = int(good[np.argmin(spread[good] / mean[good] ** 2)])
            break
    else:
        return Window("paper", False, f"no {min_points} consecutive velocities vary by less than {cv_limit:.0%}")
    chosen = velocity[start : start + length] * travel_ratio
    x_ss, sd = float(chosen.mean()), float(chosen.std(ddof=1))
    drift = float(np.polyfit(np.linspace(-0.5, 0.5, chosen.size), chosen, 1)[0]) / x_ss
    cv = sd / abs(x_ss)
    return Window(
        rule="paper",
        accepted=True,
        reason=f"longest run with a coefficient of variation below {cv_limit:.0%}: {chosen.size} velocities, {cv:.2%}",
        from_s=float(time_s[start + 1]),
        to_s=float(time_s[start + length]),
        n_points=chosen.size,
        x_ss_m_s=x_ss,
        x_ss_sigma_m_s=sd / math.sqrt(chosen.size),
        drift=drift,
        cv=cv,
    )


# ------------------------------------------------------------------------------
# Quasi-steady windows, in which a vine follows a changing pressure with negligible inertia.
#
# As the chamber empties no speed is steady, yet the forces balance at every instant as long as inertia is a small
# part of them. If the pressure during growth is known, measured or from the model in use, such a window gives a point
# of the damping law as good as a steady one; otherwise the point would be wrong, and the rule is not applied.


def quasi_steady_window(motion: TrialMotion, pressure_Pa: Floats) -> Window:
    """Find the longest window after the highest speed with little inertia in the force. Shapes: pressure_Pa (n,)."""
    parts = 3  # parts of a window in which inertia is fitted separately (chosen)
    fewest_points = 4 * parts
    trial, kinematics = motion.trial, motion.kinematics
    time_s, position_m = _points(motion.track)
    travel_m = position_m - motion.release.lead_position_m
    velocity = kinematics.lead_velocity_m_s
    first = int(np.argmax(velocity))
    lowest = (1 - 0.3) * velocity[first]  # 0.3: largest relative change of speed across a window (derived)
    beyond = np.flatnonzero((velocity[first:] < lowest) | (travel_m[first:] > END_FRACTION * trial.length_m))
    last = first + int(beyond[0]) - 1 if beyond.size else velocity.size - 1
    if last - first + 1 < fewest_points:
        points = max(last - first + 1, 0)
        reason = f"{points} points between the highest speed and the end are too few; {fewest_points} are needed"
        return Window("quasi_steady", False, reason)
    mass_kg = trial.moving_mass_kg(np.maximum(travel_m, 0.0))
    weight_N = trial.travel_ratio * mass_kg * GRAVITY_M_S2 * math.cos(trial.growth_angle_rad)
    force_N = (pressure_Pa - trial.yield_pressure_Pa) * trial.area_m2 + weight_N

    def largest_inertia(a: int, b: int) -> float:
        """Largest inertia in any part of a window as a fraction of the force, at the end of its 95 % interval."""
        largest = 0.0
        for low, high in itertools.pairwise(np.linspace(a, b + 1, parts + 1).round().astype(int)):
            part, force = judge(time_s, position_m, kinematics, low, high - 1, ""), force_N[low:high]
            if not (part.x_ss_m_s > 0 and np.all(force > 0)):
                return math.inf
            to_force = float(np.mean(trial.travel_ratio * mass_kg[low:high]) / np.mean(force))
            to_force *= part.x_ss_m_s / (part.to_s - part.from_s)
            largest = max(largest, to_force * max(-part.drift_95[0], part.drift_95[1]))
        return largest

    # 6: sections between whose ends all windows are tried (chosen)
    ends = np.linspace(first, last, 6 + 1).round().astype(int)
    candidates = sorted(itertools.combinations(ends.tolist(), 2), key=lambda ends: ends[0] - ends[1])
    smallest = math.inf
    for a, b in candidates:
        if b - a + 1 < fewest_points:
            break
        inertia = largest_inertia(a, b)
        smallest = min(smallest, inertia)
        # 0.1: largest inertia as a fraction of the force, at the end of its 95 % interval (chosen)
        if inertia <= 0.1:
            window = judge(time_s, position_m, kinematics, a, b, "quasi_steady")
            reason = (
                f"follows a known pressure over {window.n_points} points: speed changes by"
                f" {100 * window.drift:.2g} %, inertia at most {100 * inertia:.2g} % of the force"
            )
            return replace(window, accepted=True, reason=reason)
    return Window("quasi_steady", False, f"inertia takes at least {100 * smallest:.2g} % of the force in every window")


# ------------------------------------------------------------------------------
# Driving force of a vine in its steady window, and whether the trial enters the damping fit.
#
#     F = (P_w − P_y) A + r m̄ g cosθ
#
# In a window that is only quasi-steady, `r m̄ g cosθ` becomes `r m̄ (g cosθ − ẍ)`. P_w is the gauge pressure in the
# window (measured, else that of the model in use) and m̄ the mean moving mass there. The rule of the paper, Eq. (3),
# uses the set pressure and neglects the weight: noise-free data with n = 0.37 then give 0.38.


@dataclass(frozen=True)
class SteadyForce:
    """Force in a steady window, its random error, and the error by the yield pressure, which a vine's trials share."""

    force_N: float
    sigma_N: float
    yield_sigma_N: float
    window_pressure_Pa: float
    pressure_source: str  #: `trace` where it was measured in the window, else `set`


def steady_force(motion: TrialMotion, window: Window, model: Model) -> SteadyForce:
    """Compute the force of a trial in one window."""
    trial, kinematics = motion.trial, motion.kinematics
    inside = (kinematics.time_s >= window.from_s) & (kinematics.time_s <= window.to_s)
    travel_m = np.maximum(kinematics.lead_position_m[inside] - motion.release.lead_position_m, 0.0)
    trace_Pa, time_s = motion.track.pressure_Pa, motion.track.time_s
    measured_Pa = np.empty(0) if trace_Pa is None else trace_Pa[(time_s >= window.from_s) & (time_s <= window.to_s)]
    measured_Pa = measured_Pa[np.isfinite(measured_Pa)]
    if measured_Pa.size:
        pressure_Pa, sigma_Pa, source = float(measured_Pa.mean()), 0.0, "trace"
        if measured_Pa.size >= 4:  # error of the mean from the scatter about the linear trend, which is not an error
            steps = np.arange(measured_Pa.size)
            residual = measured_Pa - np.polyval(np.polyfit(steps, measured_Pa, 1), steps)
            sigma_Pa = float(np.sqrt(np.sum(residual**2) / (measured_Pa.size - 2) / measured_Pa.size))
    else:
        pressure_Pa = float(np.mean(_modelled_pressure(motion, model)[inside]))
        sigma_Pa, source = trial.pressure_sigma_Pa, "set"
    mass_kg = float(np.mean(trial.moving_mass_kg(travel_m)))
    weight_N = trial.travel_ratio * mass_kg * GRAVITY_M_S2 * math.cos(trial.growth_angle_rad)
    if window.rule == "quasi_steady":
        weight_N -= trial.travel_ratio * mass_kg * window.drift * window.x_ss_m_s / (window.to_s - window.from_s)
    return SteadyForce(
        force_N=(pressure_Pa - trial.yield_pressure_Pa) * trial.area_m2 + weight_N,
        sigma_N=sigma_Pa * trial.area_m2,
        yield_sigma_N=trial.yield_pressure_sigma_Pa * trial.area_m2,
        window_pressure_Pa=pressure_Pa,
        pressure_source=source,
    )


def paper_force_N(trial: Trial) -> float:
    """Return the force by the published rule, (P − P_y)A with the set pressure and without weight."""
    return (trial.pressure_Pa - trial.yield_pressure_Pa) * trial.area_m2


def known_pressure(motion: TrialMotion, model: Model) -> Floats | None:
    """Return the gauge pressure at the points of the kinematics; None where only the set pressure is known. It is the
    measured pressure, else that of a model with an effect on the pressure. Shape (n,).
    """
    trace_Pa, time_s = motion.track.pressure_Pa, motion.track.time_s
    if trace_Pa is not None and np.isfinite(trace_Pa).sum() > 1:
        measured = np.isfinite(trace_Pa)
        return np.interp(motion.kinematics.time_s, time_s[measured], trace_Pa[measured])
    if not any({"pressure", "chamber_rate"} & set(effect.functions) for effect in model):
        return None
    return _modelled_pressure(motion, model)


def _modelled_pressure(motion: TrialMotion, model: Model) -> Floats:
    kinematics, release = motion.kinematics, motion.release
    start_s = release.time_s if math.isfinite(release.time_s) else kinematics.time_s[0]
    travel_m = np.maximum(kinematics.lead_position_m - release.lead_position_m, 0.0)
    since_s = np.maximum(kinematics.time_s - start_s, 0.0)
    return evaluate(model, motion.trial, since_s, travel_m, np.maximum(kinematics.lead_velocity_m_s, 0.0)).pressure_Pa


def why_not_in_fit(trial: Trial) -> str:
    """Return why a trial cannot enter the damping fit whatever its motion; blank if it can."""
    if trial.travel_ratio != 2:
        return "a body that moves as a whole has no eversion damping"
    if trial.payload_kg > 0:
        return f"carries a payload of {trial.payload_kg * 1e3:g} g"
    return ""
