"""Measure a recording: its track in metres by the experiment's calibration, and the error of the scale."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vinetrack.core.records import Trial
from vinetrack.video.axis import Axis
from vinetrack.video.calibration import CalibrationError, PlaneCalibration, calibrate
from vinetrack.video.capture_clock import capture_rate
from vinetrack.video.curved_axis import CurvedAxis, axis_through
from vinetrack.video.event_frames import read_event
from vinetrack.video.frames import Recording, RecordingError, inspect_recording
from vinetrack.video.track import Tracking, track_frames

if TYPE_CHECKING:
    from vinetrack.experiment.settings import ExperimentSettings


@dataclass(frozen=True)
class Measurement:
    """A tracked recording with its scale. `m_per_px` is the mean along the growth axis and `scale_rel_sigma` its
    relative standard error, NaN where unknown: an error that all points share, kept apart from the random error of
    each.
    """

    tracking: Tracking
    m_per_px: float
    scale_rel_sigma: float
    calibration: PlaneCalibration | None
    capture_fps: float
    recording: Recording

    @property
    def growth_m(self) -> float:
        """Distance from the first usable position to the furthest, m."""
        position_m = self.tracking.track.lead_position_m[self.tracking.track.usable]
        return float(np.max(position_m) - position_m[0]) if position_m.size else math.nan


def measure_recording(trial: Trial, settings: ExperimentSettings, folder: Path) -> Measurement:
    """Decode, calibrate and track the recording of one trial."""
    if trial.video is None:
        raise RecordingError(f"{trial.name}: no recording is named; fill in the column video")
    recording = inspect_recording(trial.video)
    capture_fps = capture_rate(trial, recording)
    calibration = calibration_of(trial, settings, folder, recording)
    if calibration is None and not math.isfinite(trial.m_per_px):
        raise RecordingError(
            f"{trial.name}: there is no scale; give `calibration` in experiment.yaml, or mm_per_px in the sheet"
        )
    frames = read_event(recording, trial.frames_used)
    m_per_px = trial.m_per_px if calibration is None else calibration.m_per_px
    axis = given_axis(trial, settings, m_per_px)
    along_path = None if calibration is None else calibration.along_path
    tracking = track_frames(frames, trial, capture_fps, axis, m_per_px=m_per_px, along_path=along_path)
    rel_sigma = math.nan
    if calibration is not None:
        bent = isinstance(tracking.axis, CurvedAxis) and math.isfinite(tracking.tube_width_sigma_px)
        along = calibration.along_path(tracking.axis, tracking.tube_width_sigma_px / 2 if bent else 0.0)
        m_per_px, rel_sigma = along.m_per_px, along.scale_rel_sigma
    notes = [*tracking.track.notes]
    # Notes on a scale that was merely given belong to the experiment, not to each of its trials.
    if calibration is not None and math.isfinite(calibration.reprojection_px):
        notes += calibration.notes
    tracking = replace(tracking, track=replace(tracking.track, notes=tuple(notes)))
    return Measurement(tracking, m_per_px, rel_sigma, calibration, capture_fps, recording)


def calibration_of(
    trial: Trial, settings: ExperimentSettings, folder: Path, recording: Recording
) -> PlaneCalibration | None:
    """The calibration of the experiment; None where the trial has its own scale or there is no calibration."""
    if math.isfinite(trial.m_per_px) or settings.calibration is None:
        return None
    try:
        return calibrate(settings.calibration, folder, recording.width, recording.height)
    except CalibrationError as error:
        raise RecordingError(f"calibration: {error}") from error


def given_axis(trial: Trial, settings: ExperimentSettings, m_per_px: float) -> Axis | None:
    """Return the growth axis of the sheet, else of the settings."""
    if trial.axis is not None:
        axis = trial.axis
        return axis_through((axis.from_px, *axis.via_px, axis.to_px), axis.width_m / m_per_px)
    if settings.axis is None:
        return None
    shared = settings.axis
    width_px = shared.width_mm / 1e3 / m_per_px if shared.width_mm is not None else math.nan
    return axis_through((shared.from_px, *(shared.via_px or ()), shared.to_px), width_px)
