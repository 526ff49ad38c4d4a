"""Facts of a recording, and whether they agree with the sheet.

A ruler wrong by a factor of ten, a diameter in the column of the length or a playback rate would otherwise come out as
physics. `vinetrack.video.quick_look` measures width and growth before any work; the tracker measures them better.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from vinetrack.core.numbers import number
from vinetrack.core.problems import Problem
from vinetrack.core.records import Trial
from vinetrack.core.terminal import table
from vinetrack.video.axis import Axis
from vinetrack.video.axis_agreement import askew_trials, slope_deg
from vinetrack.video.curved_axis import CurvedAxis, axis_entry
from vinetrack.video.measure import Measurement
from vinetrack.video.track import Tracking

WIDTH_TOLERANCE = 0.08  # Relative difference of width and diameter that is allowed beyond the stated error (measured)
# Relative excess of growth over length that is allowed, with growth from the tracker (True) or a quick look (measured)
GROWTH_TOLERANCE = {True: 0.06, False: 0.12}
EXPOSURE_TOLERANCE_PX = 3.0  # Difference of the blur lengths of stated and seen exposure that is allowed (measured)
ERROR_FACTOR = 1.5  # Factor between picture and sheet above which the difference is an error (chosen)
SIGMAS = 3.0  # Standard errors of the width that are allowed for
# Difference of logarithms within which width and growth are off by the same factor (chosen)
SAME_FACTOR_LOG = 0.1
# Angle, in degrees, between growth and the picture's rows above which growth runs up or down (chosen)
STEEP_DEG = 60.0
OR_SKIP_COMPARISON = "or write compare_sizes: no where only part of the tube is seen"


@dataclass(frozen=True, kw_only=True)
class RecordingFacts:
    """Facts of one recording; NaN (None) where not known. `tracked` says whether width and growth come from the tracker
    or from a quick look; `picture_mm` is the width of the picture; `mean_speed_m_s` is that of the leading edge over
    the middle of its growth.
    """

    trial: str
    n_frames: int | None
    capture_fps: float
    playback_fps: float | None
    mm_per_px: float
    scale_rel_sigma: float = math.nan
    picture_mm: float
    axis: Axis | None
    tube_width_mm: float = math.nan
    tube_width_sigma_mm: float = math.nan
    growth_mm: float = math.nan
    mean_speed_m_s: float = math.nan
    tracked: bool = False

    @property
    def duration_s(self) -> float:
        """Time from the first frame to the last."""
        return math.nan if self.n_frames is None else (self.n_frames - 1) / self.capture_fps


def tracked_facts(trial: Trial, measurement: Measurement) -> RecordingFacts:
    """Facts of a recording that was tracked."""
    tracking = measurement.tracking
    mm_per_px = 1e3 * measurement.m_per_px
    return RecordingFacts(
        trial=trial.name,
        n_frames=len(tracking.track.time_s),
        capture_fps=measurement.capture_fps,
        playback_fps=measurement.recording.playback_fps,
        mm_per_px=mm_per_px,
        scale_rel_sigma=measurement.scale_rel_sigma,
        picture_mm=mm_per_px * measurement.recording.width,
        axis=tracking.axis,
        tube_width_mm=mm_per_px * tracking.tube_width_px,
        tube_width_sigma_mm=mm_per_px * tracking.tube_width_sigma_px,
        growth_mm=1e3 * measurement.growth_m,
        tracked=True,
    )


def size_problems(trial: Trial, facts: RecordingFacts) -> list[Problem]:
    """List the sizes in the picture that contradict the sheet: warnings, or errors beyond a factor of ERROR_FACTOR. A
    body that moves as a whole has no tube; `compare_sizes: no` in the sheet skips the comparison.
    """
    if trial.travel_ratio == 1 or not trial.compare_sizes:
        return []
    diameter_mm, length_mm = 1e3 * trial.diameter_m, 1e3 * trial.length_m
    width, growth = facts.tube_width_mm / diameter_mm, facts.growth_mm / length_mm
    sigma = math.hypot(facts.tube_width_sigma_mm / diameter_mm, float(np.nan_to_num(facts.scale_rel_sigma)))
    width_off = abs(width - 1) > WIDTH_TOLERANCE + SIGMAS * sigma
    growth_too_long = growth > 1 + GROWTH_TOLERANCE[facts.tracked]
    width_text = f"the tube in the picture is {number(facts.tube_width_mm)} mm wide, a factor {_factor(width)}"
    growth_text = f"the growth in the picture is {number(facts.growth_mm)} mm, a factor {_factor(growth)}"
    remedy = f"check it, its unit and the scale, {OR_SKIP_COMPARISON}"
    if width_off and _near_one(facts.tube_width_mm / length_mm) and _near_one(facts.growth_mm / diameter_mm):
        remedy = "diameter_mm and length_mm are swapped"
    elif width_off and growth > 0 and abs(math.log(width / growth)) < SAME_FACTOR_LOG:
        both = f"{width_text}, and {growth_text} ({length_mm:g} in the sheet)"
        return [_problem("diameter_mm", diameter_mm, both, width, "check the scale: calibration, mm_per_px")]
    problems = [_problem("diameter_mm", diameter_mm, width_text, width, remedy)] if width_off else []
    return [*problems, *([_problem("length_mm", length_mm, growth_text, growth, remedy)] if growth_too_long else [])]


def exposure_problems(trial: Trial, tracking: Tracking) -> list[Problem]:
    """Report a stated exposure that the blur of the moving edge contradicts. It is a warning beyond
    EXPOSURE_TOLERANCE_PX, and an error beyond twice that.
    """
    stated, seen = tracking.exposure_frames, tracking.seen_exposure_frames
    difference_px = abs(stated - seen) * tracking.fast_px_per_frame
    if not (
        difference_px > EXPOSURE_TOLERANCE_PX
        and max(stated / seen, seen / stated) > ERROR_FACTOR
        and trial.exposure_s > 0
    ):
        return []
    stated_us, seen_us = 1e6 * trial.exposure_s, 1e6 * trial.exposure_s * seen / stated
    message = (
        f"differs: the edge is blurred as by {number(seen_us, 2)} µs, a factor {_factor(stated / seen)}, where it "
        f"moves {number(tracking.fast_px_per_frame, 2)} px a frame"
    )
    severity = "error" if difference_px > 2 * EXPOSURE_TOLERANCE_PX else "warning"
    remedy = "check exposure_us, its unit and capture_fps"
    return [
        Problem(
            message=message,
            severity=severity,
            column="exposure_us",
            value=f"{stated_us:g}",
            remedy=remedy,
            of_a_measurement=True,
        )
    ]


def _near_one(ratio: float) -> bool:
    """Whether a ratio is 1 to within 0.2."""
    return abs(ratio - 1) < 0.2


def _factor(ratio: float) -> str:
    """The larger of a ratio and its inverse, in words."""
    return f"{max(ratio, 1 / ratio):.3g}"


def _problem(column: str, stated_mm: float, seen: str, ratio: float, remedy: str) -> Problem:
    """The problem of a stated size, an error beyond ERROR_FACTOR."""
    severity = "error" if max(ratio, 1 / ratio) > ERROR_FACTOR else "warning"
    return Problem(
        message=f"differs: {seen}",
        severity=severity,
        column=column,
        value=f"{stated_mm:g}",
        remedy=remedy,
        of_a_measurement=True,
    )


def direction_notes(facts: Iterable[RecordingFacts], trials: Iterable[Trial], blank: Collection[str]) -> list[str]:
    """Note where growth in the picture runs in another direction than in the sheet; no fault, since cameras are turned.
    That is a vine that is level by the sheet and runs up or down in the picture, and one whose blank angle counts as
    straight down and that runs level.
    """
    upright, level = [], []
    for fact, trial in zip(facts, trials, strict=True):
        if fact.axis is None or isinstance(fact.axis, CurvedAxis) or trial.travel_ratio == 1:
            continue
        right, down = (abs(b - a) for a, b in zip(fact.axis.from_px, fact.axis.to_px, strict=True))
        slope_deg = math.degrees(math.atan2(down, right))
        from_level_deg = math.degrees(math.asin(min(abs(math.cos(trial.growth_angle_rad)), 1.0)))
        upright += [trial.name] if slope_deg > STEEP_DEG and from_level_deg < 90 - STEEP_DEG else []
        level += [trial.name] if slope_deg < 90 - STEEP_DEG and trial.name in blank else []
    findings = (
        (upright, "up or down", "the sheet has it level: right if filmed from above or with the camera on its side"),
        (level, "level", "a blank growth_angle_deg means straight down: write 90 unless the camera lay on its side"),
    )
    return [
        f"growth runs {way} in the picture ({_named(names)}) and {remark}" for names, way, remark in findings if names
    ]


def axis_notes(facts: Iterable[RecordingFacts], trials: Iterable[Trial]) -> list[str]:
    """Name recordings whose axis was found askew to that of most others that grow at the same angle. Something else
    that moves, such as a door as long as the growth, was then taken for the tube.
    """
    axes = [(fact.trial, fact.axis) for fact in facts if fact.axis is not None]
    slopes_deg = {name: slope_deg(axis.from_px, axis.to_px, bends=axis.bends) for name, axis in axes}
    return [
        f"a growth axis other than that of {n_agreeing} recordings was found ({_named(names)}): where one camera "
        "filmed them all, something else that moves (a door, a hand) was taken for the tube; give the axis of those "
        "(column `axis`)"
        for names, n_agreeing in askew_trials(slopes_deg, trials)
    ]


def _named(names: list[str]) -> str:
    """One name, or how many recordings and the first of them."""
    return names[0] if len(names) == 1 else f"{len(names)} recordings, {names[0]} first"


def facts_rows(facts: Iterable[RecordingFacts], trials: Iterable[Trial]) -> list[str]:
    """Lay out a table for the terminal, a line a recording, with sizes in the picture next to those of the sheet.
    `down` is the growth angle from straight down as the sheet states it: no picture shows it.
    """
    rows = [_cells(fact, trial) for fact, trial in zip(facts, trials, strict=True)]
    head = (
        "recording",
        "frames",
        "rate",
        "plays",
        "lasts",
        "scale",
        "picture",
        "axis",
        "down",
        "tube",
        "sheet",
        "growth",
        "sheet",
    )
    units = ("", "", "1/s", "1/s", "s", "mm/px", "mm", "px", "°", "mm", "mm", "mm", "mm")
    return table(rows, head, units, align="<>>>>>><>>>>>")


def facts_entry(facts: RecordingFacts) -> dict[str, Any]:
    """Convert the facts of a recording to a JSON mapping. Returns mapping; units are in the keys."""
    entry = {key: value for key, value in vars(facts).items() if key != "axis"}
    axis = None if facts.axis is None else axis_entry(facts.axis)
    return entry | {"duration_s": facts.duration_s, "axis": axis}


def _cells(facts: RecordingFacts, trial: Trial) -> tuple[str, ...]:
    """Cells of one recording's row."""
    axis = "–"
    if facts.axis is not None:
        ends = (*facts.axis.from_px, *facts.axis.to_px)
        axis = "{},{} → {},{}".format(*(round(end) for end in ends))
    return (
        facts.trial,
        "–" if facts.n_frames is None else str(facts.n_frames),
        f"{facts.capture_fps:g}",
        "–" if facts.playback_fps is None else f"{facts.playback_fps:.4g}",
        number(facts.duration_s),
        number(facts.mm_per_px, 4),
        number(facts.picture_mm),
        axis,
        f"{math.degrees(trial.growth_angle_rad):g}",
        number(facts.tube_width_mm),
        number(1e3 * trial.diameter_m),
        number(facts.growth_mm),
        number(1e3 * trial.length_m),
    )
