"""Driving force of a vine in its steady window, and whether the trial enters the damping fit.

    F = (P_w − P_y) A + r m̄ g cosθ

In a window that is only quasi-steady, `r m̄ g cosθ` becomes `r m̄ (g cosθ − ẍ)`.

P_w is the gauge pressure in the window (measured, else that of the model in use) and m̄ the mean moving mass there. The
rule of the paper, Eq. (3), uses the set pressure and neglects the weight: noise-free data with n = 0.37 then give 0.38.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from vinetrack.core.records import Floats, Kinematics, Track, Trial
from vinetrack.core.units import GRAVITY_M_S2
from vinetrack.dynamics.audit import evaluate
from vinetrack.dynamics.model import Model
from vinetrack.tracks.position_noise import ar1_sd, rest_points

# ------------------------------------------------------------------------------
# Release time and resting position of the leading edge: the zeros of time and position of a trial.


@dataclass(frozen=True)
class Release:
    """Onset of motion and resting position of the leading edge; `time_s` is NaN where nothing moves.
    `moving_from_start` marks tracks without rest, whose zeros are extrapolated or those of the first point; `reason`
    says which.
    """

    time_s: float
    lead_position_m: float
    lead_position_sigma_m: float
    moving_from_start: bool
    reason: str


@dataclass(frozen=True)
class Window:
    """A window tested for steadiness by one rule; `doubtful`: used by the user's choice, though not shown steady.
    Speeds are those of the tail.
    """

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
    usable = track.usable
    time_s, position_m = track.time_s[usable], track.lead_position_m[usable]
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


@dataclass(frozen=True)
class SteadyForce:
    """Force in a steady window, N, its random standard error, and `yield_sigma_N`, the error due to the yield pressure,
    which all trials of a vine share.
    """

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
