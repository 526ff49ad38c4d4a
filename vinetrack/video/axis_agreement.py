"""Whether the growth axes of recordings agree: vines filmed by one camera grow along one line of its picture."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from vinetrack.core.records import Trial

ASKEW_DEG = 10.0  # Angle between a recording's axis and that of most others above which the recording is named (chosen)
FEWEST_ALIKE = 3  # Fewest recordings whose axes agree from which the others are judged (chosen)


def slope_deg(from_px: Sequence[float], to_px: Sequence[float], *, bends: bool) -> float:
    """Direction of an axis in the picture, degrees from +x towards +y; NaN for a curve, which agrees with no line."""
    return math.nan if bends else math.degrees(math.atan2(to_px[1] - from_px[1], to_px[0] - from_px[0]))


def askew(slopes_deg: Mapping[str, float]) -> tuple[list[str], int]:
    """Recordings whose axis differs from that of most others, where most agree. Returns their names, and how many
    recordings agree; no names where fewer than FEWEST_ALIKE agree, or not most.
    """
    straight = [slope for slope in slopes_deg.values() if math.isfinite(slope)]
    agreeing = [sum(_apart_deg(slope, other) < ASKEW_DEG for other in straight) for slope in straight]
    common = straight[int(np.argmax(agreeing))] if straight else 0.0
    names = [name for name, slope in slopes_deg.items() if not _apart_deg(slope, common) < ASKEW_DEG]
    agreed = len(slopes_deg) - len(names)
    return (names, agreed) if FEWEST_ALIKE <= agreed > len(names) else ([], agreed)


def askew_trials(slopes_deg: Mapping[str, float], trials: Iterable[Trial]) -> list[tuple[list[str], int]]:
    """Trials whose axis was found askew to that of most others that grow at the same angle. Bodies that fly free and
    trials with a given axis are not compared.
    """
    by_angle: dict[float, dict[str, float]] = {}
    for trial in trials:
        if trial.name in slopes_deg and trial.axis is None and trial.travel_ratio != 1:
            by_angle.setdefault(trial.growth_angle_rad, {})[trial.name] = slopes_deg[trial.name]
    return [named for slopes in by_angle.values() if (named := askew(slopes))[0]]


def _apart_deg(slope: float, other: float) -> float:
    """Angle between two lines, whichever way they run, 0 to 90 degrees."""
    return abs((slope - other + 90.0) % 180.0 - 90.0)
