"""Analysis of one recording: track, kinematics, strip figure and summary row; a failure is confined to its trial."""

from __future__ import annotations

import logging
import traceback
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.core.tables import is_disk_full, write_bytes, write_json
from vinetrack.core.units import number
from vinetrack.pipeline.tracks_stage import TRIAL_NOT_ANALYSED, analyse, failed_row, write_empty
from vinetrack.results.folder_layout import Results, read_json, read_result

if TYPE_CHECKING:
    from vinetrack.core.problems import Problem
    from vinetrack.core.records import Trial
    from vinetrack.experiment.folder import Experiment
    from vinetrack.experiment.settings import RunSettings
    from vinetrack.video.survey import Measurement

log = logging.getLogger(__name__)


def analyse_recording(experiment: Experiment, name: str, folder: Path, settings: RunSettings) -> str:
    """Track the recording of one trial and analyse its motion; write all files of the trial."""
    trial = experiment.trial(name)
    results = Results(folder)
    reason, fault = _analyse(experiment, trial, results, settings)
    if fault:
        log.error("trial %s:\n%s", name, fault)
    log.info("%s: %s", name, reason or "analysed")
    return f"{name}: failed: {reason}" if reason else f"{name}: {_outcome(results, trial)}."


def _outcome(results: Results, trial: Trial) -> str:
    """Say in how many frames the edge was found, and compare measured sizes with those of the sheet."""
    track = read_result(results.track(trial.name))
    row = read_json(results.analysed(trial.name))["row"]
    frames = f"edge found in {int(track['lead_position_m'].notna().sum())} of {len(track)} frames"
    sizes = (
        ("tube", row["tube_width_mm"], "mm wide", trial.diameter_m),
        ("growth", row["growth_mm"], "mm", trial.length_m),
    )
    measured_sizes = [
        f"{name} {number(measured)} {unit} (sheet {1e3 * stated:g})"
        for name, measured, unit, stated in sizes
        if measured
    ]
    return "; ".join([frames, f"{number(row['mm_per_px'], 4)} mm/px", *measured_sizes])


def _analyse(experiment: Experiment, trial: Trial, results: Results, settings: RunSettings) -> tuple[str, str]:
    """Measure and analyse a recording; return the reason of a failure and a traceback, as `analyse` does."""
    from vinetrack.tracks.importers import TrackError, attach_pressure, read_pressure_trace
    from vinetrack.video.frames import RecordingError
    from vinetrack.video.survey import measure_recording

    measurement = None
    try:
        measurement = measure_recording(trial, experiment.settings, experiment.folder)
        contradictions = _contradictions(trial, measurement)
        track = measurement.tracking.track
        track = replace(track, notes=(*track.notes, *(problem.reason for problem in contradictions)))
        if trial.pressure_trace is not None:
            track = attach_pressure(track, *read_pressure_trace(trial.pressure_trace))
        reason, fault = analyse(
            trial,
            track,
            results,
            settings,
            experiment,
            mm_per_px=1e3 * measurement.m_per_px,
            scale_rel_sigma=measurement.scale_rel_sigma,
            tube_width_mm=1e3 * measurement.m_per_px * measurement.tracking.tube_width_px,
        )
        view = _calibration_and_axis(measurement, getattr(experiment.settings.calibration, "image", None))
        entries = [{"column": problem.column, "reason": problem.reason} for problem in contradictions]
        path = results.analysed(trial.name)
        write_json(path, read_json(path) | view | {"contradictions": entries})
    except (RecordingError, TrackError) as error:
        reason, fault = str(error), ""
        write_empty(results, trial.name, failed_row(trial, reason))
    except Exception as error:
        if is_disk_full(error):
            raise  # a full disk is not a fault of this trial
        reason, fault = TRIAL_NOT_ANALYSED, traceback.format_exc()
        write_empty(results, trial.name, failed_row(trial, reason))
    _draw_strip_figure(trial, results, measurement, reason, settings)
    return reason, fault


def _contradictions(trial: Trial, measurement: Measurement) -> list[Problem]:
    """Return the measured sizes and exposures that contradict the sheet, as warnings."""
    from vinetrack.video.frames import RecordingError
    from vinetrack.video.survey import exposure_problems, size_problems, tracked_facts

    problems = size_problems(trial, tracked_facts(trial, measurement))
    problems += exposure_problems(trial, measurement.tracking)
    errors = [problem.reason for problem in problems if problem.severity == "error"]
    if errors:
        raise RecordingError("; ".join(errors))
    return problems


def _calibration_and_axis(measurement: Measurement, image: str | None) -> dict[str, Any]:
    """Return the calibration of a recording, and the axis along which its `edge_px` is measured, as JSON entries."""
    from vinetrack.video.curved_axis import axis_entry

    calibration = measurement.calibration
    entry: dict[str, Any] = {
        "kind": "sheet" if calibration is None else calibration.kind,
        "image": image if calibration is not None else None,
        "mm_per_px": 1e3 * measurement.m_per_px,
        "scale_rel_sigma": measurement.scale_rel_sigma,
        "reprojection_px": None if calibration is None else calibration.reprojection_px,
        "n_corners": 0 if calibration is None else calibration.n_corners,
        "n_pictures": 0 if calibration is None else calibration.n_pictures,
        "notes": [] if calibration is None else calibration.notes,
    }
    axis = measurement.tracking.axis
    shake_px = measurement.tracking.shake_px
    line = axis_entry(axis) | {"width_px": axis.width_px}
    line |= {"shake_px": shake_px.round(2)} if np.any(shake_px) else {}
    return {"calibration": entry, "axis": line}


def _draw_strip_figure(
    trial: Trial, results: Results, measurement: Measurement | None, reason: str, settings: RunSettings
) -> None:
    from vinetrack.figures.overlay import draw_strip
    from vinetrack.figures.style import blank, render

    if measurement is None:
        figure = blank(f"{trial.name}: {reason}")
    else:
        figure = draw_strip(trial.name, measurement.tracking, measurement.m_per_px)
    path = partial(results.strip_figure, trial.name)
    for form, data in render(figure, settings.figures.formats, settings.figures.dpi).items():
        write_bytes(path(f".{form}"), data)
