"""Check recordings and calibration before any work, in seconds.

Every recording is opened and its header read; its frames are counted where the file's index, or a walk through its
packets, gives the number without decoding. The calibration is read once for each picture size. One recording of each
condition is looked into, and what it shows is compared with the sheet.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vinetrack.core.problems import Problem
from vinetrack.core.records import PictureAxis, Trial
from vinetrack.core.terminal import progress
from vinetrack.experiment.settings import AxisSettings, ExperimentSettings
from vinetrack.video.capture_clock import capture_exposure, capture_rate
from vinetrack.video.curved_axis import axis_through, curve_problem
from vinetrack.video.frames import Recording, RecordingError, inspect_recording
from vinetrack.video.measure import given_axis
from vinetrack.video.quick_look import look_at
from vinetrack.video.recording_facts import RecordingFacts, size_problems
from vinetrack.video.track import FEWEST_FRAMES

if TYPE_CHECKING:
    from vinetrack.experiment.folder import Experiment
    from vinetrack.video.calibration import PlaneCalibration
    from vinetrack.video.raw_frames import RawFrames

SETTINGS = "experiment.yaml"
LARGEST_WALKED_BYTES = 64_000_000  # Largest file without an index that is read to its end to count its frames (chosen)


MOST_LOOKS = 12  # Most recordings that are looked into, about a second each (chosen)


class Surveyor:
    """Opens the recordings of an experiment and keeps the facts of each in `facts`, by trial. `looked_into` are the
    trials whose frames were looked at.
    """

    def __init__(self) -> None:
        self.facts: dict[Trial, RecordingFacts] = {}
        self.looked_into: list[Trial] = []

    def __call__(self, experiment: Experiment, trials: Iterable[Trial]) -> list[Problem]:
        """List the problems of the recordings of these trials, each with the trial's name, and of the calibration."""
        problems: list[Problem] = []
        opened: dict[Trial, Recording] = {}
        sound: list[Trial] = []
        for trial in progress(list(trials), "recordings", unit="recording"):
            try:
                opened[trial] = recording = inspect_recording(trial.video or Path())
                of_trial = _recording_problems(trial, recording)
            except (RecordingError, OSError) as error:
                of_trial = [_unusable_recording(error, trial.video.name if trial.video else "")]
            if all(problem.severity != "error" for problem in of_trial):
                sound.append(trial)
            problems += [replace(problem, trial=trial.name) for problem in of_trial]
        of_scale, calibrations = _scale_problems(experiment.settings, experiment.folder, opened)
        self.looked_into = _one_per_condition(sound)
        for trial in progress(sound, "looking into recordings", unit="recording"):
            scale = calibrations.get((opened[trial].width, opened[trial].height))
            facts = _recording_facts(trial, experiment.settings, opened[trial], scale, trial in self.looked_into)
            problems += [replace(problem, trial=trial.name) for problem in size_problems(trial, facts)]
            self.facts[trial] = facts
        return problems + of_scale


def survey(experiment: Experiment, trials: Iterable[Trial]) -> list[Problem]:
    """List the problems of the recordings of these trials; see `Surveyor`."""
    return Surveyor()(experiment, trials)


def _one_per_condition(trials: list[Trial]) -> list[Trial]:
    """The recordings to look into: all of a few, else one of each condition, or of each vine where those are many."""
    if len(trials) <= MOST_LOOKS:
        return trials
    conditions = list({(trial.condition, trial.m_per_px): trial for trial in reversed(trials)}.values())[::-1]
    if len(conditions) <= MOST_LOOKS:
        return conditions
    vines = list({(trial.vine, trial.m_per_px): trial for trial in reversed(trials)}.values())[::-1]
    others = [trial for trial in conditions if trial not in vines]
    return [*vines, *others][:MOST_LOOKS]


def _recording_facts(
    trial: Trial, settings: ExperimentSettings, recording: Recording, scale: PlaneCalibration | None, look: bool
) -> RecordingFacts:
    """Facts of one recording; with `look`, also those that a quick look at its frames gives."""
    m_per_px, rel_sigma = trial.m_per_px, math.nan
    if not math.isfinite(m_per_px) and scale is not None:
        m_per_px, rel_sigma = scale.m_per_px, scale.scale_rel_sigma
    axis = given_axis(trial, settings, m_per_px)
    count = _frames_present(recording)
    count = recording.declared_frames if count is None else count
    view = look_at(recording, trial, axis, count) if look else None
    if scale is not None and view is not None and view.axis is not None and not math.isfinite(trial.m_per_px):
        along = scale.along(view.axis.from_px, view.axis.to_px)
        m_per_px, rel_sigma = along.m_per_px, along.scale_rel_sigma
    capture_fps = capture_rate(trial, recording)
    facts = RecordingFacts(
        trial=trial.name,
        n_frames=count,
        capture_fps=capture_fps,
        playback_fps=recording.playback_fps,
        mm_per_px=1e3 * m_per_px,
        scale_rel_sigma=rel_sigma,
        picture_mm=1e3 * m_per_px * recording.width,
        axis=axis,
    )
    if view is None:
        return facts
    return replace(
        facts,
        axis=view.axis or axis,
        tube_width_mm=1e3 * m_per_px * view.tube_width_px,
        tube_width_sigma_mm=1e3 * m_per_px * view.tube_width_sigma_px,
        growth_mm=1e3 * m_per_px * view.growth_px,
        mean_speed_m_s=m_per_px * view.px_per_frame * capture_fps,
    )


def _recording_problems(trial: Trial, recording: Recording) -> list[Problem]:
    """Compare a recording that opens with the sheet and with what the file declares."""
    place: dict[str, Any] = {"column": "video", "value": recording.path.name}
    for column, clock in (("capture_fps", capture_rate), ("exposure_us", capture_exposure)):
        try:
            clock(trial, recording)
        except RecordingError as error:
            message, _, remedy = str(error).removeprefix(f"{trial.name}: {column} ").rpartition("; ")
            return [Problem(message=message or remedy, column=column, remedy=remedy if message else "")]
    problems = [
        Problem(message=f"is odd: {note.removeprefix(f'{recording.path.name}: ')}", severity="warning", **place)
        for note in recording.notes
    ]
    declared, present = recording.declared_frames, _frames_present(recording)
    count = declared if present is None else present
    if count is not None and count < FEWEST_FRAMES:
        remedy = f"at least {FEWEST_FRAMES} are needed"
        return [*problems, Problem(message=f"has {count} frames", remedy=remedy, **place)]
    if declared is not None and present is not None and present < declared:
        message = f"is cut short: {present} of the {declared} frames that it declares are there"
        remedy = "copy it from the camera again"
        problems.append(Problem(message=message, severity="warning", remedy=remedy, **place))
    return problems


def _frames_present(recording: Recording) -> int | None:
    """Number of frames in the file, if it can be known without decoding; None otherwise."""
    if recording.raw is not None:
        return _raw_frames_present(recording.path.stat().st_size, recording.raw)
    if recording.kind != "container":
        return recording.declared_frames
    import av

    size = recording.path.stat().st_size
    try:
        with av.open(str(recording.path)) as container:
            stream = container.streams.video[0]
            entries = stream.index_entries
            if stream.frames and len(entries) >= stream.frames:
                return sum(entry.pos + entry.size <= size for entry in entries)
            if size > LARGEST_WALKED_BYTES:
                return None
            return sum(1 for packet in container.demux(stream) if packet.size)
    except (av.error.FFmpegError, AttributeError):
        # The walk met damage, which decoding will report.
        return None


def _raw_frames_present(size: int, raw: RawFrames) -> int:
    """Number of whole frames in a raw file of `size` bytes."""
    return sum(offset + raw.frame_bytes <= size for offset in raw.offsets)


Calibrations = dict[tuple[int, int], "PlaneCalibration"]


def _scale_problems(
    settings: ExperimentSettings, folder: Path, opened: dict[Trial, Recording]
) -> tuple[list[Problem], Calibrations]:
    """Problems of calibration and axis, for the recordings that open; and the calibration by picture size."""
    problems: list[Problem] = []
    calibrations: Calibrations = {}
    unscaled = [trial for trial in opened if not math.isfinite(trial.m_per_px)]
    sizes = sorted({(opened[trial].width, opened[trial].height) for trial in unscaled})
    if unscaled and settings.calibration is None:
        lacking = "no recording has" if len(unscaled) == len(opened) else f"{len(unscaled)} recordings have no"
        remedy = "give it here, or mm_per_px in the sheet"
        message = f"is missing: {lacking} a scale" if lacking.startswith("no ") else f"is missing: {lacking} scale"
        problems.append(Problem(message=message, file=SETTINGS, column="calibration", remedy=remedy))
    elif unscaled:
        problems += _calibration_problems(settings, folder, sizes, calibrations)
    for trial, recording in opened.items():
        if trial.axis is not None:
            problems += _axis_problems(trial, trial.axis, recording, {"trial": trial.name}, calibrations)
    if settings.axis is not None:
        for trial, recording in opened.items():
            axis_problems = _axis_problems(trial, settings.axis, recording, {"file": SETTINGS}, calibrations)
            if trial.axis is None and axis_problems:
                problems += axis_problems
                break
    return problems, calibrations


def _axis_problems(
    trial: Trial, given: AxisSettings | PictureAxis, recording: Recording, place: dict[str, Any],
    calibrations: Calibrations,
) -> list[Problem]:  # fmt: skip
    """Problems of a given axis in the picture of one recording, reported at its place in the files."""
    through = (given.from_px, *(given.via_px or ()), given.to_px)
    if not all(-0.5 <= x <= recording.width - 0.5 and -0.5 <= y <= recording.height - 0.5 for x, y in through):
        message = f"leaves the picture of {recording.path.name}, {recording.width} × {recording.height} pixels"
        remedy = f"give {'points' if given.via_px else 'two points'} inside it"
        return [Problem(message=message, column="axis", remedy=remedy, **place)]
    if not given.via_px:
        return []
    scale = calibrations.get((recording.width, recording.height))
    m_per_px = trial.m_per_px if scale is None or math.isfinite(trial.m_per_px) else scale.m_per_px
    width_mm = given.width_mm if isinstance(given, AxisSettings) else 1e3 * given.width_m
    width_m = trial.diameter_m if width_mm is None or math.isnan(width_mm) else width_mm / 1e3
    complaint = curve_problem(axis_through(through), width_m / m_per_px / 2, (recording.width, recording.height))
    return [] if complaint is None else [Problem(message=complaint[0], column="axis", remedy=complaint[1], **place)]


def _calibration_problems(
    settings: ExperimentSettings, folder: Path, sizes: list[tuple[int, int]], calibrations: Calibrations
) -> list[Problem]:
    """Read the calibration for each picture size into `calibrations`; only the first problem is reported."""
    from vinetrack.video.calibration import CalibrationError, calibrate

    image = getattr(settings.calibration, "image", None)
    if settings.calibration is None or (image is not None and not (folder / image).exists()):
        return []
    place: dict[str, Any] = {"file": SETTINGS, "column": "calibration" if image is None else "calibration.image"}
    notes: dict[str, None] = {}
    for width_px, height_px in sizes:
        try:
            calibration = calibrate(settings.calibration, folder, width_px, height_px)
            calibrations[width_px, height_px] = calibration
        except CalibrationError as error:
            message, _, remedy = str(error).removeprefix("calibration: ").rpartition("; ")
            return [Problem(message=f"cannot be used: {message or remedy}", remedy=remedy if message else "", **place)]
        if image is not None:
            notes |= dict.fromkeys(calibration.notes)
    return [Problem(message=f"is weak: {note}", severity="warning", **place) for note in notes]


def _unusable_recording(error: Exception, name: str) -> Problem:
    """The problem of a recording that cannot be used, from the message of its error."""
    message, _, remedy = str(error).removeprefix(f"{name}: ").rpartition("; ")
    words = f"cannot be used: {message or remedy}"
    return Problem(message=words, column="video", value=name, remedy=remedy if message else "")
