"""Count missing frames of a recording from single steps of its edge, before positions are in metres.

The threshold is that of `frame_timing`, which examines tracks of any source and what remains undecided here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vinetrack.core.records import Bools, Floats, Indices
from vinetrack.tracks.frame_timing import CLEAR_STEP_SIGMAS, DROP_RATIO, frames_are

SMALLEST_STEP_PX = 2.0  # Smallest step of a recording that can show a missing frame (chosen)

# Range of the four steps around a long one, as a part of their median, below which the motion is steady (chosen)
EVEN_STEP_RANGE = 0.35

# A long step this near to a whole number of steps, and no more than so many, is counted in (chosen)
WHOLE_STEP_TOLERANCE, MOST_MISSING_STEPS = 0.2, 4


@dataclass(frozen=True)
class MissingFrames:
    """Missing frames of a recording; all arrays of shape (n_frames,). `slot` counts capture periods from the first
    frame, missing ones included; `gap` marks frames before which some are missing or may be, `retimed` those from which
    `slot` was corrected.
    """

    slot: Indices
    gap: Bools
    retimed: Bools
    notes: tuple[str, ...]


def count_missing(
    edge_px: Floats, sigma_px: Floats, slot: Indices, number: Indices, repeated: Bools, moving: tuple[int, int]
) -> MissingFrames:
    """Count in the frames that steps of the motion show to be missing. A step is compared with two on each side, which
    must agree (EVEN_STEP_RANGE) and be clear of the stated errors. Shapes: edge_px, sigma_px, slot, number, repeated
    (n_frames,).
    """
    n = len(edge_px)
    gap, retimed = np.zeros(n, dtype=bool), np.zeros(n, dtype=bool)
    gap[1:] = np.diff(slot) > np.diff(number)
    counted, notes = slot.copy(), []
    step = np.full(n, np.nan)
    step[1:] = np.diff(edge_px) / np.maximum(np.diff(slot), 1)
    first, last = moving
    for i in range(max(first, 1) + 2, min(last, n - 1) - 1):
        around = step[[i - 2, i - 1, i + 1, i + 2]]
        near = step[[i - 1, i + 1]]
        if not np.all(np.isfinite(around)) or not np.isfinite(step[i]) or repeated[i - 2 : i + 3].any():
            continue
        median_step = float(np.median(around))
        least_step = max(SMALLEST_STEP_PX, CLEAR_STEP_SIGMAS * float(np.max(sigma_px[i - 1 : i + 1])))
        if median_step < least_step or np.ptp(around) > EVEN_STEP_RANGE * median_step:
            continue
        ratio = step[i] / float(near.mean())
        if ratio <= DROP_RATIO:
            continue
        gap[i] = True
        whole = round(ratio)
        retimed[i] = abs(ratio - whole) < WHOLE_STEP_TOLERANCE and whole <= MOST_MISSING_STEPS
        if retimed[i]:
            counted[i:] += whole - 1
            where = f"before frame {number[i]} (the step there is too long)"
            notes.append(f"{frames_are(whole - 1)} missing {where}: later times moved on")
        else:
            notes.append(f"a step of {ratio:.1f} times its neighbours before frame {number[i]}: frames may be missing")
    return MissingFrames(counted, gap, retimed, tuple(notes))
