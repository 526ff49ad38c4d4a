"""Select the frames of a damaged recording that are tracked: the longest undamaged stretch.

What a decoder makes of a damaged frame looks like a picture and may be tracked, with small stated errors, to a wrong
place; so may the frames after a hole in the motion. Neither is used until a person has placed the edge of such a frame
(`corrections.csv`).
"""

from __future__ import annotations

import numpy as np

from vinetrack.core.records import Bools
from vinetrack.video.frames import Frames, RecordingError

LONGEST_HOLE = 1  # Most frames missing in a row that the tracker bridges (measured)
MOST_DROPPED = 3  # Most frames missing in a row that a recorder may have dropped from an undamaged recording (chosen)
LEAST_PART = 0.5  # Least part of the frames that must follow each other without damage (measured)


def sound_stretch(frames: Frames, allowed: Bools) -> Bools:
    """Frames to be tracked: all that are allowed where none is damaged, else the longest stretch without damage.
    Shapes: allowed (n_frames,) → (n_frames,).
    """
    damaged = frames.damaged & allowed
    # Lost frames, within the recording or at its end, count as damage.
    span = 1 + int(np.ptp(frames.slot[allowed]))
    if allowed.all():
        span = max(span, (frames.recording.declared_frames or 0) - len(frames.slots_before) - len(frames.slots_after))
    complete = span < allowed.sum() / LEAST_PART
    if complete and not damaged.any() and np.max(np.diff(frames.slot[allowed]), initial=1) <= MOST_DROPPED + 1:
        return allowed
    sound = np.flatnonzero(allowed & ~damaged)
    breaks = np.flatnonzero(np.diff(frames.slot[sound]) > LONGEST_HOLE + 1) + 1
    longest = max(np.split(sound, breaks), key=len)
    if len(longest) < LEAST_PART * span:
        where = f", {longest[0]} to {longest[-1]}," if len(longest) else ""
        count = int(damaged.sum())
        problem = f"{count} of {int(allowed.sum())} frames are damaged" if count else "frames are missing"
        raise RecordingError(
            f"{frames.recording.path.name}: {problem} and only {len(longest)}{where} follow each other without damage: "
            "copy it from the camera again, or name sound ones in frames_used"
        )
    mask = np.zeros(len(frames), dtype=bool)
    mask[longest] = True
    return mask
