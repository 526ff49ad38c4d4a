"""Recordings and their scale, as the report shows them."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from vinetrack.core.numbers import number

LARGEST_SVG_BYTES = 1_500_000
"""A larger picture is left as a file beside the report."""

KINDS = {
    "charuco": "ChArUco board",
    "checkerboard": "checkerboard",
    "two_points": "two points and their distance",
    "mm_per_px": "millimetres per pixel, as given",
    "sheet": "millimetres per pixel, from the sheet",
}
FLAG_WORDS = {
    "before_release": "before release",
    "lost": "without the edge",
    "after_end": "after the end",
}
SHARED_ERROR = (
    "The error of the scale is kept apart from the random error of single points: all points of a recording share it, "
    "and all recordings share that of one target. It stretches every length and speed alike, so that no replicate "
    "shows it and no average reduces it. It is no part of the ± of a speed nor of the intervals from resampling; the "
    "wider intervals of B include it (a scale that is off by ε moves ln B by n·ε), and n does not depend on it."
)

METHODS = (
    (
        "Edge",
        "A straight strip along the axis of growth is cut from every frame and freed of flicker and shake by what "
        "stands still beside the vine. A pixel that the vine covers changes once: its brightness before and after and "
        "the place of the edge in every frame are found in turns, the edge by maximum likelihood from a step blurred "
        "by optics and by its own motion, at mid-exposure. Time is the number of the frame over the rate of capture.",
    ),
    (
        "Scale",
        "Positions along the axis go through a camera with radial distortion that looks at a tilted plane, fitted to "
        "the corners of the target; without a target, through one number.",
    ),
)
"""How recordings were measured, as (heading, paragraph) pairs."""


@dataclass(frozen=True)
class Recording:
    """A recording in the report: its strip as SVG ("" for none), the flags of its frames, and its calibration.

    `calibration` is what the recording's stage wrote: `kind, image, mm_per_px, scale_rel_sigma, reprojection_px,
    n_corners, n_pictures, notes`; None where there was none to be had.
    """

    strip: str
    flags: Sequence[str]
    calibration: Mapping[str, Any] | None = None


def count_frames(flags: Iterable[str]) -> str:
    """How many frames there are, and how many of them carry which flag, in words.

    >>> count_frames(["before_release", "", "", "doubtful", "lost;gap"])
    '5 frames: 1 before release, 1 doubtful, 1 without the edge, 1 gap'
    """
    flags = list(flags)
    counted = Counter(part for flag in flags for part in flag.split(";") if part)
    parts = [f"{count} {FLAG_WORDS.get(flag, flag)}" for flag, count in counted.items()]
    return f"{len(flags)} frames" + (f": {', '.join(parts)}" if parts else "")


def calibration_table(recordings: Mapping[str, Recording]) -> list[dict[str, Any]]:
    """One row a calibration, with what it found and the trials that rest on it."""
    groups: dict[tuple[Any, ...], list[tuple[str, Mapping[str, Any]]]] = {}
    for name, recording in recordings.items():
        found = recording.calibration
        if found is not None:
            key = (found["kind"], found["image"], found["n_corners"], found["reprojection_px"], *found["notes"])
            if found["kind"] == "sheet":
                key = (*key, found["mm_per_px"])
            groups.setdefault(key, []).append((name, found))
    return [_calibration_row(members) for members in groups.values()]


def _calibration_row(members: Sequence[tuple[str, Mapping[str, Any]]]) -> dict[str, Any]:
    first = members[0][1]
    scales = [found["mm_per_px"] for _, found in members]
    spread = f"{number(min(scales), 6)}"
    if max(scales) - min(scales) > 1e-5 * max(scales):
        spread += f" to {number(max(scales), 6)}"
    errors = [found["scale_rel_sigma"] for _, found in members if _known(found["scale_rel_sigma"])]
    has_target = bool(first["n_corners"]) and _known(first["reprojection_px"])
    return {
        "kind": KINDS.get(first["kind"], first["kind"]),
        "image": first["image"] or "",
        "mm_per_px": spread,
        "error": f"{number(100 * max(errors), 2)} %" if errors else "unknown",
        "reprojection": f"{number(first['reprojection_px'], 2)} px" if has_target else "–",
        "corners": f"{first['n_corners']} in {first['n_pictures']}" if has_target else "–",
        "notes": list(first["notes"]),
        "trials": f"{len(members)} recordings" if len(members) > 1 else members[0][0],
    }


def _known(value: Any) -> bool:
    return value is not None and math.isfinite(value)
