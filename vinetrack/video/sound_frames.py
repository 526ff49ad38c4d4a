"""Which frames of a damaged recording are tracked: the longest stretch of sound frames.

What a decoder makes of a damaged frame looks like a picture and may be followed with small errors to the wrong place.
A tracker that leaps over a hole in the motion does the same. So neither counts until a person has placed the edge of
such a frame (`corrections.csv`).
"""

from __future__ import annotations

import numpy as np

from vinetrack.core.records import Bools
from vinetrack.video.frames import Frames, RecordingError

LONGEST_HOLE = 1
"""Frames missing in a row over which the tracker finds its way. Measured (clips of the laboratory of 101, 71 and 56
frames, seeds 40 to 42): errors stay below 0.7 mm with one, reach 5 and 11 mm with two and three, and 28 mm with six."""
MOST_DROPPED = 3
"""Frames missing in a row that a recorder may have dropped from a sound recording. Chosen: single frames are dropped;
more than three were lost from the file. At half two in a row break a recording, at twice six are leapt over."""
LEAST_PART = 0.5
"""Part of the frames that must follow each other without damage. Measured (36 damaged clips of the laboratory, seed
20100): of those with less, 6 of 17 were followed to wrong places by up to 16 mm, since neither rest nor background were
seen; of 4 with more none by over 0.3 mm, nor of 10 others (seed 20101)."""


def sound_stretch(frames: Frames, used: Bools) -> Bools:
    """Frames to be tracked: all that are used where none is damaged, else those of the longest stretch without damage.

    Parameters
    ----------
    frames : decoded, `damaged` marked.
    used : frames that the sheet allows, shape (n_frames,).

    Returns
    -------
    mask, shape (n_frames,).

    Raises
    ------
    RecordingError
        In one sentence, where that stretch is not long enough.
    """
    damaged = frames.damaged & used
    # Frames that are lost, within or at the end, are not sound either.
    span = 1 + int(np.ptp(frames.slot[used]))
    if used.all():
        span = max(span, (frames.recording.declared_frames or 0) - len(frames.slots_before) - len(frames.slots_after))
    whole = span < used.sum() / LEAST_PART
    if whole and not damaged.any() and np.max(np.diff(frames.slot[used]), initial=1) <= MOST_DROPPED + 1:
        return used
    sound = np.flatnonzero(used & ~damaged)
    breaks = np.flatnonzero(np.diff(frames.slot[sound]) > LONGEST_HOLE + 1) + 1
    longest = max(np.split(sound, breaks), key=len)
    if len(longest) < LEAST_PART * span:
        where = f", {longest[0]} to {longest[-1]}," if len(longest) else ""
        count = int(damaged.sum())
        what = f"{count} of {int(used.sum())} frames are damaged" if count else "frames are missing"
        raise RecordingError(
            f"{frames.recording.path.name}: {what} and only {len(longest)}{where} follow each other without damage: "
            "copy it from the camera again, or name sound ones in frames_used"
        )
    mask = np.zeros(len(frames), dtype=bool)
    mask[longest] = True
    return mask
