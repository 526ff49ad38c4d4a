"""Where the way of a body that moves as a whole ends in an imported track: it turns back (a bounce), or stops dead."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vinetrack.core.records import Floats, Track, join_flags
from vinetrack.tracks.position_noise import rough_noise

BACK_SIGMAS, BACK_PART = 8.0, 0.02
"""A body this far behind where it was, in standard deviations of a position and as a part of its way, has turned back.
Chosen: two such points in a row never come by chance. By reasoning: at half wild points end tracks; at twice the first
points of a bounce stay."""
STILL_SIGMAS, FEWEST_STILL = 5.0, 3
"""Points at the end that stand, to within so many standard deviations, and how many show a stop. Chosen as in the fit
of growing vines. By reasoning: at half noise hides the stop; at twice slow motion passes for one."""
DEAD_STOP = 0.5
"""Part of the usual step that the last step before a dead stop still has. Chosen: friction brings a body to rest over
many steps. By reasoning: at half a body that slides to rest loses its end; at twice impacts between frames are
missed."""
FEWEST_LEFT = 5
"""Points that must be left. Derived: those that a track needs."""


def flag_end_of_body(track: Track) -> Track:
    """The track with points after the end of the body's way flagged `after_end`, and the end told in its notes.

    Parameters
    ----------
    track : of a body that moves one way; positions may be NaN.

    Returns
    -------
    Track
    """
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
    note = f"the body {what} after {track.time_s[rows[end]]:.5g} s: the end of its way; later points are not used"
    return replace(track, flag=flag, notes=(*track.notes, note))


def _turns_back(y: Floats, noise_m: float) -> int | None:
    """Furthest point before the body comes back; None where it does not."""
    back = np.maximum.accumulate(y) - y > max(BACK_SIGMAS * noise_m, BACK_PART * float(np.ptp(y)))
    turned = np.flatnonzero(back[:-1] & back[1:])
    return int(np.argmax(y[: turned[0] + 1])) if turned.size else None


def _stops_dead(y: Floats, noise_m: float) -> int | None:
    """First point of a standstill that lasts to the end and begins within a frame; None where there is none."""
    near = max(STILL_SIGMAS * noise_m, 1e-9)
    moving = np.flatnonzero(np.abs(y - np.median(y[-FEWEST_STILL:])) > near)
    if not moving.size or y.size - moving[-1] - 1 < FEWEST_STILL or moving[-1] < FEWEST_LEFT:
        return None
    last = int(moving[-1])
    usual = float(np.median(np.diff(y[last - FEWEST_LEFT : last + 1])))
    before = float(y[last] - y[last - 1])
    return last + 1 if usual > near and before > DEAD_STOP * usual else None
