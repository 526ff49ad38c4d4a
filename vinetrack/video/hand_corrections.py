"""Points of a track moved, dropped or confirmed by a person, each marked `corrected`; the tracker's own stay beside."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from vinetrack.core.records import Correction, Track, join_flags
from vinetrack.video.calibration import CLICK_SIGMA_PX
from vinetrack.video.slow_errors import SLOW_PX

SETTLED = frozenset({"doubtful", "lost", "rejected", "after_end"})
"""Flags that no longer hold of a point that a person has placed or confirmed."""
DONE = {"move": "moved", "drop": "dropped", "confirm": "confirmed"}


def corrected_by_hand(track: Track, corrections: Sequence[Correction]) -> Track:
    """The track with points moved, dropped or confirmed.

    A point that is moved has the error of a click; one that is dropped is `rejected`; one that is confirmed is no
    longer doubtful. A frame that the recording does not have, and a confirmation where there is no edge, change nothing
    and are told in `notes`.

    Parameters
    ----------
    track : in pixels along the axis, a row for every frame.
    corrections : of its frames.

    Returns
    -------
    Track : with `tracked_px`, the edge as the tracker saw it.
    """
    if not corrections:
        return track
    edge, sigma = track.edge_px.copy(), track.lead_position_sigma_m.copy()
    slow = None if track.lead_position_systematic_m is None else track.lead_position_systematic_m.copy()
    flag = track.flag.astype("<U80")
    done: Counter[str] = Counter()
    notes = []
    for point in corrections:
        if point.frame >= len(edge):
            notes.append(f"the correction of frame {point.frame} is ignored: the recording has {len(edge)} frames")
            continue
        if point.action == "confirm" and not math.isfinite(edge[point.frame]):
            notes.append(f"frame {point.frame} has no edge to be confirmed; move it to where the edge is")
            continue
        kept = [part for part in str(flag[point.frame]).split(";") if part not in SETTLED]
        if point.action == "move":
            edge[point.frame], sigma[point.frame] = point.edge_px, CLICK_SIGMA_PX
            if slow is not None:
                slow[point.frame] = SLOW_PX
        elif point.action == "drop":
            edge[point.frame] = sigma[point.frame] = math.nan
            kept.append("rejected")
        flag[point.frame] = join_flags(*kept, "corrected")
        done[DONE[point.action]] += 1
    if done:
        parts = ", ".join(f"{count} {words}" for words, count in done.items())
        notes.append(f"points corrected by hand: {parts}")
    return replace(
        track,
        edge_px=edge,
        lead_position_sigma_m=sigma,
        lead_position_systematic_m=slow,
        flag=np.asarray(flag),
        tracked_px=track.edge_px,
        notes=(*track.notes, *notes),
    )
