"""Release time and resting position of the leading edge: the zeros of time and position of a trial."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from vinetrack.core.records import Floats, Kinematics, Track, join_flags
from vinetrack.tracks.position_noise import rest_points

FEWEST_REST_POINTS = 3  # Fewest points at rest that define a resting position (chosen)

LIFTED_SIGMAS = 5.0  # Standard deviations of a position by which the track must leave its start to count as moving

CLEAR_SIGMAS = 15.0  # Travel, in standard deviations of a position, at which motion is certain (chosen)

LONGEST_EXTRAPOLATION_FRAMES = 20  # Frames by which an extrapolated release may precede the first frame (chosen)


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


def find_release(track: Track, kinematics: Kinematics) -> Release:
    """Find the resting position of the leading edge and the time of its release."""
    usable = track.usable
    time_s, position_m = track.time_s[usable], track.lead_position_m[usable]
    n_rest = rest_points(position_m)
    if n_rest == position_m.size or not _ever_moves(kinematics):
        origin_m, sigma_m = _resting_level(position_m, kinematics)
        return Release(math.nan, origin_m, sigma_m, False, "the leading edge never moves forward beyond its noise")
    if n_rest < FEWEST_REST_POINTS:
        return _moving_from_start(time_s, kinematics)
    origin_m, sigma_m = _resting_level(position_m[: max(n_rest - 2, 1)], kinematics)
    onset_s = _onset(time_s, position_m, n_rest, origin_m, kinematics)
    reason = f"at rest for {n_rest} points, then moving from {onset_s:.5g} s"
    return Release(onset_s, origin_m, sigma_m, False, reason)


def flag_rest(track: Track, release: Release) -> Track:
    """Flag every row before the release with `before_release`."""
    if not math.isfinite(release.time_s) or release.moving_from_start:
        return track
    resting = track.time_s < release.time_s
    flag = np.array(
        [
            join_flags(old, "before_release") if at_rest else old
            for old, at_rest in zip(track.flag, resting, strict=True)
        ],
        dtype=track.flag.dtype if track.flag.dtype.itemsize >= 320 else "<U80",
    )
    return replace(track, flag=flag)


def _ever_moves(kinematics: Kinematics) -> bool:
    """Whether positions span more than noise can explain."""
    span_m = float(np.ptp(kinematics.lead_position_m))
    return span_m > LIFTED_SIGMAS * kinematics.noise_m and span_m > 0


def _resting_level(position_m: Floats, kinematics: Kinematics) -> tuple[float, float]:
    """Mean of the points at rest and its standard error under AR(1) noise."""
    n, rho = position_m.size, kinematics.noise_correlation
    lag = np.arange(1, n)
    variance = (1 + 2 * float(np.sum((1 - lag / n) * rho**lag))) / n
    return float(position_m.mean()), kinematics.noise_m * math.sqrt(variance)


def _moving_from_start(time_s: Floats, kinematics: Kinematics) -> Release:
    """Extrapolate to zero speed with the first acceleration where that is close, else use the first point."""
    velocity, acceleration = kinematics.lead_velocity_m_s[0], kinematics.lead_acceleration_m_s2[0]
    step_s = float(np.median(np.diff(time_s)))
    first_m = float(kinematics.lead_position_m[0])
    back_s = velocity / acceleration if acceleration > 0 else math.inf
    if -step_s / 2 <= back_s <= LONGEST_EXTRAPOLATION_FRAMES * step_s:
        back_s = max(back_s, 0.0)
        origin_m = float(first_m - 0.5 * velocity * back_s)
        sigma_m = math.hypot(kinematics.noise_m, 0.5 * velocity * back_s)
        reason = (
            f"moving at the first point ({velocity:.3g} m/s); release extrapolated {back_s * 1e3:.3g} ms back"
            f" at {acceleration:.3g} m/s²"
        )
        return Release(float(time_s[0]) - back_s, origin_m, sigma_m, True, reason)
    reason = (
        f"moving at the first point ({velocity:.3g} m/s), and the start cannot be extrapolated: zeros set to the first"
        " point"
    )
    return Release(float(time_s[0]), first_m, kinematics.noise_m, True, reason)


def _onset(time_s: Floats, position_m: Floats, n_rest: int, origin_m: float, kinematics: Kinematics) -> float:
    """Time at which the edge leaves rest, by the best least-squares fit of y = y₀ + b·(t − t₀)^p with p = 1, 3/2 or 2.
    A vine of small mass reaches full speed within a frame (p = 1), a heavy one has constant acceleration (p = 2). The
    fit uses the points around the onset and on until the edge has clearly left its resting position, at least three.
    """
    travel = position_m - origin_m
    clear = max(CLEAR_SIGMAS * kinematics.noise_m, 1e-9, 1e-6 * float(np.ptp(position_m)))
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
