"""Check recordings and calibration before any work, in seconds.

Every recording is opened and its header read; its frames are counted where the file's index, or a walk through its
packets, gives the number without decoding. The calibration is read once for each picture size. One recording of each
condition is tracked, by the function that tracks for `run`, and what it shows is compared with the sheet.
"""

from __future__ import annotations

import contextlib
import math
import os
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from vinetrack.core.problems import Problem, confirmed
from vinetrack.core.process import progress, table
from vinetrack.core.records import CONTAINERS, IMAGES, SIDE_FILES, Trial
from vinetrack.core.tables import PROVENANCE
from vinetrack.core.units import number
from vinetrack.experiment.folder import SETTINGS, SHEET, Experiment
from vinetrack.experiment.settings import Calibration, ExperimentSettings
from vinetrack.tracks.frame_timing import mean_speed
from vinetrack.tracks.importers import FEWEST_POINTS
from vinetrack.video.axis import Axis, axis_entry, axis_problem, axis_through, read_event
from vinetrack.video.calibration import CalibrationError, PlaneCalibration, calibrate
from vinetrack.video.frames import Recording, RecordingError, inspect_recording
from vinetrack.video.images import capture_exposure, capture_rate
from vinetrack.video.track import Tracking, in_metres, too_few, track_pixels

# ------------------------------------------------------------------------------
# Measure a recording: its track in metres by the experiment's calibration, and the error of the scale.


@dataclass(frozen=True)
class Measurement:
    """A tracked recording with its scale: the mean along the axis, and its relative error, one for all points."""

    tracking: Tracking
    m_per_px: float
    scale_rel_sigma: float
    calibration: PlaneCalibration | None
    capture_fps: float
    recording: Recording


Keep = Callable[[Path, tuple[object, ...], Callable[[], Tracking]], Tracking]


def measure_recording(
    trial: Trial, settings: ExperimentSettings, folder: Path, keep: Keep | None = None
) -> Measurement:
    """Track the recording of one trial by its own scale or the calibration of the experiment: the one look into a
    recording. `keep` returns the tracking in pixels that it keeps of a film with these inputs, or makes it as given.
    """
    if trial.video is None:
        raise RecordingError("no recording is named", "fill in the column video", trial.name)
    recording = inspect_recording(trial.video)
    capture_fps = capture_rate(trial, recording)
    calibration = None
    if not math.isfinite(trial.m_per_px):
        if settings.calibration is None:
            remedy = "give `calibration` in experiment.yaml, or mm_per_px in the sheet"
            raise RecordingError("there is no scale", remedy, trial.name)
        try:
            calibration = _calibrated(settings.calibration, folder, recording.width, recording.height)
        except CalibrationError as error:
            raise RecordingError(error.what, error.remedy, "calibration") from error
    m_per_px = trial.m_per_px if calibration is None else calibration.middle.m_per_px
    axis = given_axis(trial, settings, m_per_px)
    diameter_px = math.nan if axis is None else trial.diameter_m / m_per_px  # an axis that is found has its width
    exposure_s = capture_exposure(trial, recording)
    inputs = trial.frames_used, trial.travel_ratio, capture_fps, exposure_s, axis, diameter_px

    def track() -> Tracking:
        return track_pixels(read_event(recording, trial.frames_used), trial, capture_fps, axis, diameter_px)

    tracking = track() if keep is None else keep(recording.path, inputs, track)
    rel_sigma, position_m = math.nan, None
    if calibration is not None:
        bent = tracking.axis.bends and math.isfinite(tracking.tube_width_sigma_px)
        along = calibration.along(tracking.axis, tracking.tube_width_sigma_px / 2 if bent else 0.0)
        m_per_px, rel_sigma, position_m = along.m_per_px, along.scale_rel_sigma, along.position_m
    tracking = in_metres(tracking, trial, m_per_px, position_m)
    # Notes on a scale that was merely given belong to the experiment, not to each of its trials.
    if calibration is not None and math.isfinite(calibration.reprojection_px):
        notes = (*tracking.track.notes, *calibration.notes)
        tracking = replace(tracking, track=replace(tracking.track, notes=notes))
    return Measurement(tracking, m_per_px, rel_sigma, calibration, capture_fps, recording)


def _calibrated(target: Calibration, folder: Path, *size_px: int) -> PlaneCalibration:
    """The calibration for a size of picture; a process looks at a target once while its picture stays the same."""
    image = folder / (getattr(target, "image", None) or "")
    return _seen(target, folder, *size_px, image.stat().st_mtime_ns if image.is_file() else 0)


@lru_cache(maxsize=8)
def _seen(target: Calibration, folder: Path, width_px: int, height_px: int, _state: int) -> PlaneCalibration:
    return calibrate(target, folder, width_px, height_px)


def given_axis(trial: Trial, settings: ExperimentSettings, m_per_px: float) -> Axis | None:
    """Return the growth axis of the sheet, else of the settings."""
    if (of_trial := trial.axis) is not None:
        width_px, through = of_trial.width_m / m_per_px, (of_trial.from_px, *of_trial.via_px, of_trial.to_px)
    elif (shared := settings.axis) is not None:
        width_px = math.nan if shared.width_mm is None else shared.width_mm / 1e3 / m_per_px
        through = shared.from_px, *(shared.via_px or ()), shared.to_px
    else:
        return None
    return axis_through(through, width_px)


# ------------------------------------------------------------------------------
# Recordings that lie in the folder.


def list_recordings(folder: Path, depth: int = 4) -> list[str]:
    """Return the recordings below a folder, as relative paths in natural order."""
    # 4: levels of folders that are searched; chosen: vine, day, pressure and a folder of pictures
    found = []
    for path in entries(folder):
        if path.is_file() and (path.suffix.lower() in CONTAINERS or _is_stack(path)):
            found.append(path.name)
        elif path.is_dir() and not (path / PROVENANCE).exists() and not is_calibration(path):
            if sum(entry.suffix.lower() in IMAGES for entry in entries(path)) >= FEWEST_POINTS:
                found.append(path.name)
            elif depth > 0:
                found += [f"{path.name}/{name}" for name in list_recordings(path, depth - 1)]
    return sorted(found, key=natural_order)


def entries(folder: Path) -> list[Path]:
    """Return what a folder holds, without hidden files; nothing if it cannot be read."""
    try:
        return [path for path in folder.iterdir() if not path.name.startswith(".")]
    except OSError:
        return []


def is_calibration(folder: Path) -> bool:
    """Whether a folder's name says that it holds pictures of a target."""
    return folder.name.lower().startswith("calib")


def _is_stack(path: Path) -> bool:
    """Whether a TIFF holds as many pictures as a recording needs."""
    return path.suffix.lower() in (".tif", ".tiff") and cv2.imcount(str(path)) >= FEWEST_POINTS


def natural_order(text: str) -> list[Any]:
    """Sort key that orders numbers in a name by value: 2 before 10."""
    return [int(part) if i % 2 else part.lower() for i, part in enumerate(re.split(r"(\d+)", text))]


def in_no_row(experiment: Experiment) -> list[Problem]:
    """Warn of recordings in the folder that neither a row of the sheet nor the calibration names."""
    written = (*experiment.recordings, *(path for _, path in experiment.settings.paths))
    named = {Path(os.path.normpath(path.replace("\\", "/"))) for path in written}
    named |= {path.parent for path in named if path.suffix.lower() in IMAGES}  # the first picture of a burst
    named |= {path.with_suffix(".mraw") for path in named if path.suffix.lower() in SIDE_FILES}
    found = [name for name in list_recordings(experiment.folder) if Path(name) not in named]
    if not found:
        return []
    more = f" and {len(found) - 5} more" if len(found) > 5 else ""
    message = f"has no row for {', '.join(found[:5])}{more}"
    remedy = "add a row for each, with `use: no` if it is to be left out, or move it elsewhere"
    return [Problem("in_no_row", message, file=SHEET, severity="warning", remedy=remedy)]


# ------------------------------------------------------------------------------
# Facts of a recording, and whether they agree with the sheet.
#
# A ruler wrong by a factor of ten, a diameter for a length or a playback rate would otherwise come out as physics.

ERROR_FACTOR = 1.5  # Factor between picture and sheet above which the difference is an error (chosen)


@dataclass(frozen=True, kw_only=True)
class RecordingFacts:
    """Facts of one recording; NaN (None) where not known, as width, growth and speed of one that was not tracked.
    `picture_mm` is the width of the picture; `mean_speed_m_s` that of the leading edge over the middle of its growth.
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

    @property
    def duration_s(self) -> float:
        """Time from the first frame to the last."""
        return math.nan if self.n_frames is None else (self.n_frames - 1) / self.capture_fps


def tracked_facts(trial: Trial, measurement: Measurement) -> RecordingFacts:
    """Facts of a recording that was tracked."""
    tracking, mm_per_px = measurement.tracking, 1e3 * measurement.m_per_px
    position_m = tracking.track.lead_position_m[tracking.track.usable]
    return replace(
        _stated_facts(trial, measurement.recording, measurement.m_per_px, measurement.scale_rel_sigma, tracking.axis),
        n_frames=len(tracking.track.time_s),
        tube_width_mm=mm_per_px * tracking.tube_width_px,
        tube_width_sigma_mm=mm_per_px * tracking.tube_width_sigma_px,
        growth_mm=1e3 * float(np.max(position_m) - position_m[0]) if position_m.size else math.nan,
        mean_speed_m_s=mean_speed(tracking.track),
    )


def _stated_facts(
    trial: Trial, recording: Recording, m_per_px: float, scale_rel_sigma: float, axis: Axis | None
) -> RecordingFacts:
    """Facts of one recording that its header and the sheet state."""
    return RecordingFacts(
        trial=trial.name, n_frames=_frames_present(recording), capture_fps=capture_rate(trial, recording),
        playback_fps=recording.playback_fps, mm_per_px=1e3 * m_per_px, scale_rel_sigma=scale_rel_sigma,
        picture_mm=1e3 * m_per_px * recording.width, axis=axis,
    )  # fmt: skip


def size_problems(trial: Trial, facts: RecordingFacts) -> list[Problem]:
    """Sizes in the picture that contradict the sheet: warnings, or errors beyond ERROR_FACTOR; none of a body."""
    if trial.travel_ratio == 1 or not trial.compare_sizes:
        return []
    diameter_mm, length_mm = 1e3 * trial.diameter_m, 1e3 * trial.length_m
    width, growth = facts.tube_width_mm / diameter_mm, facts.growth_mm / length_mm
    sigma = math.hypot(facts.tube_width_sigma_mm / diameter_mm, float(np.nan_to_num(facts.scale_rel_sigma)))
    # 0.08: relative difference of width and diameter that is allowed beyond the stated error (measured)
    # 3.0: standard errors of the width that are allowed for
    width_off = abs(width - 1) > 0.08 + 3.0 * sigma
    # 0.06: relative excess of growth over length that is allowed (measured)
    growth_too_long = growth > 1 + 0.06
    width_text = f"the tube in the picture is {number(facts.tube_width_mm)} mm wide, a factor {_factor(width):.3g}"
    growth_text = f"the growth in the picture is {number(facts.growth_mm)} mm, a factor {_factor(growth):.3g}"
    remedy = "check it, its unit and the scale, or write compare_sizes: no where only part of the tube is seen"
    # 0.2, 0.1: difference from 1 of a ratio of swapped sizes, and between logarithms of equal factors (chosen)
    if width_off and max(abs(facts.tube_width_mm / length_mm - 1), abs(facts.growth_mm / diameter_mm - 1)) < 0.2:
        remedy = "diameter_mm and length_mm are swapped"
    elif width_off and growth > 0 and abs(math.log(width / growth)) < 0.1:
        both = f"{width_text}, and {growth_text} ({length_mm:g} in the sheet)"
        return [_differs("scale", "diameter_mm", diameter_mm, both, width, "check the scale: calibration, mm_per_px")]
    problems = [_differs("size", "diameter_mm", diameter_mm, width_text, width, remedy)] if width_off else []
    if growth_too_long:
        problems.append(_differs("size", "length_mm", length_mm, growth_text, growth, remedy))
    return problems


def exposure_problems(trial: Trial, tracking: Tracking) -> list[Problem]:
    """A stated exposure that the blur of the moving edge contradicts: a warning, at twice what is allowed an error."""
    allowed_px = 3.0  # Difference of the blur lengths of stated and seen exposure (measured)
    stated, seen = tracking.exposure_frames, tracking.seen_exposure_frames
    difference_px = abs(stated - seen) * tracking.fast_px_per_frame
    # A whole frame, the longest exposure that is tried, fits best where the edge changes its contrast as it moves.
    off = difference_px > allowed_px and _factor(stated / seen) > ERROR_FACTOR and seen < 1
    if not (off and trial.exposure_s > 0):
        return []
    stated_us, ratio = 1e6 * trial.exposure_s, stated / seen
    blur = f"the edge is blurred as by {number(stated_us / ratio, 2)} µs, a factor {_factor(ratio):.3g}"
    message = f"{blur}, where it moves {number(tracking.fast_px_per_frame, 2)} px a frame"
    remedy = "check exposure_us, its unit and capture_fps"
    problem = _differs("exposure", "exposure_us", stated_us, message, ratio, remedy)
    return [problem if difference_px > 2 * allowed_px else replace(problem, severity="warning")]


def _factor(ratio: float) -> float:
    """The larger of a ratio and its inverse."""
    return max(ratio, 1 / ratio)


def _differs(code: str, column: str, stated: float, seen: str, ratio: float, remedy: str) -> Problem:
    """The problem of a number that what is seen contradicts by a factor, an error beyond ERROR_FACTOR."""
    known: dict[str, Any] = {"value": f"{stated:g}", "remedy": remedy, "of_a_measurement": True}
    severity = "error" if _factor(ratio) > ERROR_FACTOR else "warning"
    return Problem(code, f"differs: {seen}", column, severity=severity, **known)


def facts_rows(facts: Iterable[RecordingFacts], trials: Iterable[Trial]) -> list[str]:
    """A line a recording: sizes in the picture next to the sheet's, and the angle that no picture shows, `down`."""
    rows = []
    for fact, trial in zip(facts, trials, strict=True):
        ends = () if fact.axis is None else (*fact.axis.from_px, *fact.axis.to_px)
        axis = "{},{} → {},{}".format(*(round(end) for end in ends)) if ends else "–"
        frames, plays = fact.n_frames, fact.playback_fps
        cells = (
            fact.trial, "–" if frames is None else str(frames), f"{fact.capture_fps:g}",
            "–" if plays is None else f"{plays:.4g}", number(fact.duration_s), number(fact.mm_per_px, 4),
            number(fact.picture_mm), axis, f"{math.degrees(trial.growth_angle_rad):g}", number(fact.tube_width_mm),
            number(1e3 * trial.diameter_m), number(fact.growth_mm), number(1e3 * trial.length_m),
        )  # fmt: skip
        rows.append(cells)
    head = ("recording", "frames", "rate", "plays", "lasts", "scale", "picture", "axis", "down",
            "tube", "sheet", "growth", "sheet")  # fmt: skip
    units = ("", "", "1/s", "1/s", "s", "mm/px", "mm", "px", "°", "mm", "mm", "mm", "mm")
    return table(rows, head, units, align="<>>>>>><>>>>>")


def facts_entry(facts: RecordingFacts) -> dict[str, Any]:
    """Convert the facts of a recording to a JSON mapping; units are in the keys."""
    axis = None if facts.axis is None else axis_entry(facts.axis)
    return vars(facts) | {"duration_s": facts.duration_s, "axis": axis}


class Surveyor:
    """Opens the recordings of an experiment: the `facts` of each by trial, and the trials `looked_into` by tracking."""

    def __init__(self, keep: Keep | None = None) -> None:
        self.keep = keep
        self.facts: dict[Trial, RecordingFacts] = {}
        self.looked_into: list[Trial] = []

    def __call__(self, experiment: Experiment, trials: Iterable[Trial]) -> list[Problem]:
        """List the problems of the recordings of these trials, each with the trial's name, and of the calibration."""
        problems: list[Problem] = []
        opened: dict[Trial, Recording] = {}
        sound: list[Trial] = []
        for trial in progress(list(trials), "recordings"):
            try:
                opened[trial] = recording = inspect_recording(trial.video or Path())
                of_trial = _recording_problems(trial, recording)
            except (RecordingError, OSError) as error:
                of_trial = [_unusable(trial, error)]
            if all(problem.severity != "error" for problem in of_trial):
                sound.append(trial)
            problems += [replace(problem, trial=trial.name) for problem in of_trial]
        of_scale, calibrations = _scale_problems(experiment.settings, experiment.folder, opened)
        self.looked_into, seen = _one_per_condition(sound), list[tuple[Trial, Problem]]()
        for trial in progress(sound, "looking into recordings"):
            of_trial, m_per_px, rel_sigma = [], trial.m_per_px, math.nan
            scale = calibrations.get((opened[trial].width, opened[trial].height))
            if not math.isfinite(m_per_px) and scale is not None:
                m_per_px, rel_sigma = scale.middle.m_per_px, scale.middle.scale_rel_sigma
            axis = given_axis(trial, experiment.settings, m_per_px)
            facts = _stated_facts(trial, opened[trial], m_per_px, rel_sigma, axis)
            if trial in self.looked_into:
                try:
                    measurement = measure_recording(trial, experiment.settings, experiment.folder, self.keep)
                    facts = tracked_facts(trial, measurement)
                    of_trial = [*size_problems(trial, facts), *exposure_problems(trial, measurement.tracking)]
                except RecordingError as error:
                    told = math.isnan(m_per_px) or any(problem.column == "axis" for problem in of_scale)
                    of_trial = [] if told else [_unusable(trial, error)]
            seen += [(trial, problem) for problem in of_trial]
            self.facts[trial] = facts
        found = [(trial.vine, one.column) for trial, one in seen if one.code == "size"]
        sure = confirmed(found, [trial.vine for trial in self.looked_into])
        for trial, one in seen:
            if one.severity == "error" or one.code != "size" or (trial.vine, one.column) in sure:
                problems.append(replace(one, trial=trial.name))
        return problems + of_scale


def _unusable(trial: Trial, error: RecordingError | OSError) -> Problem:
    """The problem of a recording that cannot be read or followed."""
    what, remedy = (str(error), "") if isinstance(error, OSError) else (error.message, error.remedy)
    return Problem("unusable", f"cannot be used: {what}", "video", value=(trial.video or Path()).name, remedy=remedy)


def _one_per_condition(trials: list[Trial]) -> list[Trial]:
    """The recordings to look into: all of a few, else one of each vine, and of each condition while they are few."""
    most_looks = 12  # Most recordings that are tracked, a second or two each (chosen)
    if len(trials) <= most_looks:
        return trials
    kinds = [{(getattr(t, kind), t.m_per_px): t for t in reversed(trials)} for kind in ("vine", "condition")]
    return list(dict.fromkeys(trial for firsts in kinds for trial in reversed(firsts.values())))[:most_looks]


def _recording_problems(trial: Trial, recording: Recording) -> list[Problem]:
    """Compare a recording that opens with the sheet and with what the file declares."""
    place: dict[str, Any] = {"column": "video", "value": recording.path.name}
    for column, clock in (("capture_fps", capture_rate), ("exposure_us", capture_exposure)):
        try:
            clock(trial, recording)
        except RecordingError as error:
            return [Problem(message=error.message.removeprefix(f"{column} "), column=column, remedy=error.remedy)]
    problems = [
        Problem(message=f"is odd: {note.removeprefix(f'{recording.path.name}: ')}", severity="warning", **place)
        for note in recording.notes
    ]
    declared, present = recording.declared_frames, _frames_present(recording)
    if present is not None and declared is not None and present < declared:
        message = f"is cut short: {present} of the {declared} frames that it declares are there"
        severity, remedy = "error" if present < FEWEST_POINTS else "warning", "copy it from the camera again"
        problems.append(Problem("cut_short", message, severity=severity, remedy=remedy, **place))
    elif present is not None and present < FEWEST_POINTS:
        problems.append(Problem(message=too_few(present), remedy="name a film or a folder of pictures", **place))
    return problems


def _frames_present(recording: Recording) -> int | None:
    """Number of frames in the file, if it can be known without decoding; else as many as it declares."""
    if recording.raw is not None:
        size, raw = recording.path.stat().st_size, recording.raw
        return sum(offset + raw.frame_bytes <= size for offset in raw.offsets)
    if recording.kind != "container":
        return recording.declared_frames
    import av

    size = recording.path.stat().st_size
    # Damage that the walk meets decoding will report.
    with contextlib.suppress(av.error.FFmpegError, AttributeError), av.open(str(recording.path)) as container:
        stream = container.streams.video[0]
        entries = stream.index_entries
        if stream.frames and len(entries) >= stream.frames:
            return sum(entry.pos + entry.size <= size for entry in entries)
        # 64_000_000: largest file without an index that is read to its end to count its frames (chosen)
        if size <= 64_000_000:
            return sum(1 for packet in container.demux(stream) if packet.size)
    return recording.declared_frames


def _scale_problems(
    settings: ExperimentSettings, folder: Path, opened: dict[Trial, Recording]
) -> tuple[list[Problem], dict[tuple[int, int], PlaneCalibration]]:
    """Problems of calibration and axis, for the recordings that open; and the calibration by picture size."""
    problems: list[Problem] = []
    calibrations: dict[tuple[int, int], PlaneCalibration] = {}
    unscaled = [trial for trial in opened if not math.isfinite(trial.m_per_px)]
    sizes = sorted({(opened[trial].width, opened[trial].height) for trial in unscaled})
    if unscaled and settings.calibration is None:
        none = len(unscaled) == len(opened)
        lacking = "no recording has a scale" if none else f"{len(unscaled)} recordings have no scale"
        remedy = "give it here, or mm_per_px in the sheet"
        problems.append(Problem("missing", f"is missing: {lacking}", "calibration", file=SETTINGS, remedy=remedy))
    image = getattr(settings.calibration, "image", None)
    if unscaled and settings.calibration is not None and (image is None or (folder / image).exists()):
        place: dict[str, Any] = {"file": SETTINGS, "column": "calibration" if image is None else "calibration.image"}
        notes: dict[str, None] = {}
        try:
            for size in sizes:
                calibrations[size] = _calibrated(settings.calibration, folder, *size)
                notes |= dict.fromkeys(calibrations[size].notes if image is not None else ())
            problems += [Problem(message=f"is weak: {note}", severity="warning", **place) for note in notes]
        except CalibrationError as error:  # only the first is reported
            problems.append(Problem(message=f"cannot be used: {error.what}", remedy=error.remedy, **place))
    of_all = False  # whether the axis that all share was named, for the first picture that it does not fit
    for trial, recording in opened.items():
        scale = calibrations.get((recording.width, recording.height))
        m_per_px = trial.m_per_px if scale is None or math.isfinite(trial.m_per_px) else scale.middle.m_per_px
        axis = given_axis(trial, settings, m_per_px)
        half_px = trial.diameter_m / m_per_px / 2 if axis is None or math.isnan(axis.width_px) else axis.width_px / 2
        if axis and (complaint := axis_problem(axis, half_px, (recording.width, recording.height))):
            place = {"file": SETTINGS} if trial.axis is None else {"trial": trial.name}
            problem = Problem(message=complaint[0], column="axis", remedy=complaint[1], **place)
            problems += [] if trial.axis is None and of_all else [problem]
            of_all = of_all or trial.axis is None
    return problems, calibrations
