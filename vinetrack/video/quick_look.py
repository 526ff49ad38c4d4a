"""Look into a recording before any work: axis, width of the tube and growth, from about a hundred of its frames.

It takes a second a recording and fits no edge: the widths agree with those of the tracker, growth is known to some per
cent.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Trial
from vinetrack.video.axis import Axis
from vinetrack.video.curve_search import find_growth_axis
from vinetrack.video.curved_strip import front_share_function
from vinetrack.video.edge import rough_growth
from vinetrack.video.frames import Recording, RecordingError, iterate_frames
from vinetrack.video.small_pictures import SmallPictures
from vinetrack.video.track import locate_axis
from vinetrack.video.tube_strip import tube_strip

FRAMES_LOOKED_AT = 100  # Frames of a recording that are looked at (chosen)
MOST_BYTES = 200_000_000  # Memory for those frames (chosen)
MOST_DECODED = 4000  # Most frames that are decoded, some three seconds' work (chosen)


@dataclass(frozen=True)
class Look:
    """What a quick look shows; NaN where not seen. `growth_px` is NaN as well where the recording is longer than what
    was looked at; `px_per_frame` is the mean speed over the middle of the growth.
    """

    axis: Axis | None = None
    tube_width_px: float = math.nan
    tube_width_sigma_px: float = math.nan
    growth_px: float = math.nan
    px_per_frame: float = math.nan


def look_at(recording: Recording, trial: Trial, axis: Axis | None, count: int | None) -> Look:
    """Look for the axis, the width of the tube and its growth. The sheet's diameter is not used: what it will be
    compared with must not depend on it.
    """
    most = int(np.clip(MOST_BYTES // (recording.width * recording.height), FRAMES_LOOKED_AT // 4, FRAMES_LOOKED_AT))
    every = max(1, -(-min(count or MOST_DECODED, MOST_DECODED) // most))
    luma = np.stack(list(islice(iterate_frames(recording), 0, MOST_DECODED, every)))
    try:
        located, front_share_of = locate_axis(luma, axis, replace(trial, diameter_m=math.nan), math.nan)
        outlined = tube_strip(luma, located, front_share_of) if trial.travel_ratio == 2 else None
        if outlined is None:
            return Look(located)
        strip, tube = outlined
        growth_px, px_per_frame = rough_growth(strip)
    except (RecordingError, ValueError):
        return Look()
    whole = count is None or count <= MOST_DECODED
    return Look(strip.axis, tube.width_px, tube.width_sigma_px, growth_px if whole else math.nan, px_per_frame / every)


def proposed_axis(luma: NDArray[Any]) -> Axis:
    """Propose the growth axis that the motion shows, along the middle of the tube where one front passes once. Shapes:
    luma (n_frames, height, width).
    """
    small = SmallPictures(luma)
    axis = find_growth_axis(small, luma)
    try:
        outlined = tube_strip(luma, axis, front_share_function(small, luma))
    except ValueError:
        return axis
    return axis if outlined is None else outlined[0].axis
