"""Find where the motion of a body in an imported track ends: it turns back (a bounce) or stops abruptly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vinetrack.core.records import Floats, Track, join_flags
from vinetrack.tracks.position_noise import rough_noise

# Distance behind its furthest place, in standard deviations of a position and as a part of its travel, at which a body
# has turned back (chosen)
BACK_SIGMAS, BACK_TRAVEL_PART = 8.0, 0.02
# Tolerance of standstill at the end, in standard deviations, and the fewest points that show a stop (chosen)
STILL_SIGMAS, FEWEST_STILL = 5.0, 3
# Last step before an abrupt stop, as a part of the median step, above which the stop is abrupt (chosen)
ABRUPT_STEP_PART = 0.5
FEWEST_LEFT = 5  # Fewest points that must be left (derived)


def flag_end_of_body(track: Track) -> Track:
    """Flag points after the end of the body's motion `after_end`, and report the end in the notes."""
    rows = np.flatnonzero(track.usable)
    y = track.lead_position_m[rows]
    if rows.size <= FEWEST_LEFT:
        return track
    noise_m = rough_noise(y)
    end, what = _turns_back(y, noise_m), "turns back"
    if end is None:
        end, what = _stops_dead(y, noise_m), "stops"
    if end is None or end + 1 < FEWEST_LEFT:
        return track
    flag = track.flag.astype("<U80")
    for row in rows[end + 1 :]:
        flag[row] = join_flags(str(flag[row]), "after_end")
    note = f"the body {what} after {track.time_s[rows[end]]:.5g} s: the end of its motion; later points are not used"
    return replace(track, flag=flag, notes=(*track.notes, note))


def _turns_back(y: Floats, noise_m: float) -> int | None:
    """Furthest point before the body comes back; None where it does not."""
    is_back = np.maximum.accumulate(y) - y > max(BACK_SIGMAS * noise_m, BACK_TRAVEL_PART * float(np.ptp(y)))
    turned = np.flatnonzero(is_back[:-1] & is_back[1:])
    return int(np.argmax(y[: turned[0] + 1])) if turned.size else None


def _stops_dead(y: Floats, noise_m: float) -> int | None:
    """First point of a standstill that lasts to the end and begins within a frame; None where there is none."""
    tolerance_m = max(STILL_SIGMAS * noise_m, 1e-9)
    moving = np.flatnonzero(np.abs(y - np.median(y[-FEWEST_STILL:])) > tolerance_m)
    if not moving.size or y.size - moving[-1] - 1 < FEWEST_STILL or moving[-1] < FEWEST_LEFT:
        return None
    last = int(moving[-1])
    median_step = float(np.median(np.diff(y[last - FEWEST_LEFT : last + 1])))
    last_step = float(y[last] - y[last - 1])
    return last + 1 if median_step > tolerance_m and last_step > ABRUPT_STEP_PART * median_step else None
