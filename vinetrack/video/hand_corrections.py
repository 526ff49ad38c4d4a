"""Apply corrections by hand to a track: points moved, dropped or confirmed, each flagged `corrected`."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from vinetrack.core.records import Correction, Track, join_flags
from vinetrack.video.calibration import CLICK_SIGMA_PX
from vinetrack.video.slow_errors import SLOW_PX

# Flags that no longer hold once a person has placed or confirmed a point
SETTLED_FLAGS = frozenset({"doubtful", "lost", "rejected", "after_end"})
PAST_TENSE = {"move": "moved", "drop": "dropped", "confirm": "confirmed"}


def corrected_by_hand(track: Track, corrections: Sequence[Correction]) -> Track:
    """Move, drop or confirm points of a track. A moved point has the error of a click; a dropped one is `rejected`; a
    confirmed one is no longer doubtful.
    """
    if not corrections:
        return track
    edge, sigma = track.edge_px.copy(), track.lead_position_sigma_m.copy()
    slow = None if track.lead_position_systematic_m is None else track.lead_position_systematic_m.copy()
    flag = track.flag.astype("<U80")
    counts: Counter[str] = Counter()
    notes = []
    for point in corrections:
        if point.frame >= len(edge):
            notes.append(f"the correction of frame {point.frame} is ignored: the recording has {len(edge)} frames")
            continue
        if point.action == "confirm" and not math.isfinite(edge[point.frame]):
            notes.append(f"frame {point.frame} has no edge to be confirmed; move it to where the edge is")
            continue
        flags = [part for part in str(flag[point.frame]).split(";") if part not in SETTLED_FLAGS]
        if point.action == "move":
            edge[point.frame], sigma[point.frame] = point.edge_px, CLICK_SIGMA_PX
            if slow is not None:
                slow[point.frame] = SLOW_PX
        elif point.action == "drop":
            edge[point.frame] = sigma[point.frame] = math.nan
            flags.append("rejected")
        flag[point.frame] = join_flags(*flags, "corrected")
        counts[PAST_TENSE[point.action]] += 1
    if counts:
        parts = ", ".join(f"{count} {words}" for words, count in counts.items())
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
