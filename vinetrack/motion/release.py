"""When a vine was released and where its leading edge rested: the zeros of time and position of a trial."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from vinetrack.motion.noise import rest_points
from vinetrack.records import Floats, Kinematics, Track, join_flags

FEWEST_REST_POINTS = 3
LIFTED_SIGMAS = 5.0
LONGEST_EXTRAPOLATION_FRAMES = 20


@dataclass(frozen=True)
class Release:
    """Onset of motion and the resting position of the leading edge; `time_s` is NaN where nothing moves.

    `moving_from_start` tells that the track shows no rest, so that both zeros are extrapolated or simply the first
    point: `reason` says which, in one sentence.
    """

    time_s: float
    lead_position_m: float
    lead_position_sigma_m: float
    moving_from_start: bool
    reason: str


def find_release(track: Track, kinematics: Kinematics) -> Release:
    """Find where and until when the leading edge rested.

    Parameters
    ----------
    track
        The track from which `kinematics` was made.
    kinematics
        Its motion; the noise is taken from here.

    Returns
    -------
    Release
        Origin and onset, with a sentence on how they were found.
    """
    usable = track.usable
    time_s, position_m = track.time_s[usable], track.lead_position_m[usable]
    n_rest = rest_points(position_m)
    if n_rest == position_m.size or not _ever_moves(kinematics):
        origin_m, sigma_m = _resting_level(position_m, kinematics)
        return Release(math.nan, origin_m, sigma_m, False, "the leading edge never moves beyond its noise")
    if n_rest < FEWEST_REST_POINTS:
        return _moving_from_start(time_s, position_m, kinematics)
    origin_m, sigma_m = _resting_level(position_m[: max(n_rest - 2, 1)], kinematics)
    onset_s = _onset(time_s, position_m, n_rest, origin_m, kinematics)
    reason = f"at rest for {n_rest} points, then moving from {onset_s:.5g} s"
    return Release(onset_s, origin_m, sigma_m, False, reason)


def flag_rest(track: Track, release: Release) -> Track:
    """A copy of the track with `before_release` on every row earlier than the release."""
    if not math.isfinite(release.time_s) or release.moving_from_start:
        return track
    resting = track.time_s < release.time_s
    flag = np.array(
        [join_flags(old, "before_release") if rest else old for old, rest in zip(track.flag, resting, strict=True)],
        dtype=track.flag.dtype if track.flag.dtype.itemsize >= 320 else "<U80",
    )
    return replace(track, flag=flag)


def _ever_moves(kinematics: Kinematics) -> bool:
    """Whether the track ends, or passes, further from its start than noise can carry it."""
    span_m = float(np.ptp(kinematics.lead_position_m))
    return span_m > LIFTED_SIGMAS * kinematics.noise_m and span_m > 0


def _resting_level(position_m: Floats, kinematics: Kinematics) -> tuple[float, float]:
    """Mean of the points at rest and its standard error, with ρ counted."""
    n, rho = position_m.size, kinematics.noise_correlation
    lag = np.arange(1, n)
    variance = (1 + 2 * float(np.sum((1 - lag / n) * rho**lag))) / n
    return float(position_m.mean()), kinematics.noise_m * math.sqrt(variance)


def _moving_from_start(time_s: Floats, position_m: Floats, kinematics: Kinematics) -> Release:
    """Go back to zero speed at the first acceleration where that is near, else take the first point."""
    velocity, acceleration = kinematics.lead_velocity_m_s[0], kinematics.lead_acceleration_m_s2[0]
    step_s = float(np.median(np.diff(time_s)))
    first_m = float(kinematics.lead_position_m[0])
    back_s = velocity / acceleration if acceleration > 0 else math.inf
    if 0 <= back_s <= LONGEST_EXTRAPOLATION_FRAMES * step_s:
        origin_m = first_m - 0.5 * velocity * back_s
        sigma_m = math.hypot(kinematics.noise_m, 0.5 * velocity * back_s)
        reason = (
            f"moving at the first point ({velocity:.3g} m/s); release extrapolated {back_s * 1e3:.3g} ms back"
            f" at {acceleration:.3g} m/s²"
        )
        return Release(float(time_s[0]) - back_s, origin_m, sigma_m, True, reason)
    reason = f"moving at the first point ({velocity:.3g} m/s) without a trace of the start: zeros set to the first point"
    return Release(float(time_s[0]), first_m, kinematics.noise_m, True, reason)


def _onset(time_s: Floats, position_m: Floats, n_rest: int, origin_m: float, kinematics: Kinematics) -> float:
    """Time at which the edge leaves rest: where a line through √(travel) reaches zero.

    Travel grows as ½at² from rest, so its root is a straight line in time, whatever the acceleration. A vine that
    reaches its speed within a frame gives a time up to a frame early: onset is kept between the last resting point
    and the first that is clearly off.
    """
    travel = position_m - origin_m
    clear = max(LIFTED_SIGMAS * kinematics.noise_m, 1e-9 + 1e-6 * float(np.ptp(position_m)))
    lifted = np.flatnonzero(travel[n_rest - 1 :] > clear)
    if lifted.size == 0:
        return float(time_s[n_rest - 1])
    first = n_rest - 1 + int(lifted[0])
    earliest, latest = float(time_s[max(n_rest - 3, 0)]), float(time_s[first])
    take = slice(first, min(first + 3, time_s.size))
    root = np.sqrt(np.maximum(travel[take], 0.0))
    if root.size < 2 or root[-1] <= root[0]:
        return float(np.clip((earliest + latest) / 2, earliest, latest))
    slope, intercept = np.polyfit(time_s[take] - latest, root, 1)
    return float(np.clip(latest - intercept / slope, earliest, latest))
