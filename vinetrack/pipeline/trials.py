"""The stages of the trials: from recording or track to kinematics and figures of each, and the tables of all of them.

Worker processes take one trial after another. The track of a recording in pixels and the pictures of a trial are kept.
A trial that fails writes its reason and never stops the others.
"""

from __future__ import annotations

import logging
import traceback
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache, partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.core.problems import INTERNAL_ERROR, InputError, remark
from vinetrack.core.records import Track, Trial
from vinetrack.core.tables import is_disk_full, write_csv, write_json
from vinetrack.dynamics.model import Model, make_model
from vinetrack.effects import load_effect
from vinetrack.experiment.folder import Experiment
from vinetrack.experiment.settings import FigureSettings, RunSettings
from vinetrack.figures.motion_figures import draw_strip, draw_trial_motion
from vinetrack.figures.registry import features
from vinetrack.figures.style import blank
from vinetrack.kinematics.damping import fit_laws, fit_scaling, fit_trends, mark_left_out
from vinetrack.kinematics.summary import TrialError, TrialResult, condition_table, summarise_trial
from vinetrack.narrative.diagnosis_text import damping_headline, failures_told
from vinetrack.pipeline.stages import Job, Kept, map_unordered
from vinetrack.results.folder_layout import (
    KINEMATICS_COLUMNS,
    POINT_COLUMNS,
    STEADY_COLUMNS,
    TRACK_COLUMNS,
    TRIALS_COLUMNS,
    Results,
    read_json,
    read_result,
    table_of,
)
from vinetrack.tracks.frame_timing import correct_frames
from vinetrack.tracks.importers import load_track, with_pressure_trace
from vinetrack.video.axis import askew_trials, axis_entry, slope_deg
from vinetrack.video.frames import RecordingError
from vinetrack.video.survey import Measurement, exposure_problems, measure_recording, size_problems, tracked_facts

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure


log = logging.getLogger(__name__)

# ------------------------------------------------------------------------------
# One trial: its track, kinematics, contribution to the tables, and pictures.


def analyse_trials(job: Job) -> list[str]:
    """Analyse all trials in use, or some, and write their files; empty ones of faulty rows. Tells what failed."""
    experiment, only = job.experiment, job.trials
    names = [name for name in experiment.names if name not in experiment.left_out and (only is None or name in only)]
    model_of(experiment)
    for module in ("matplotlib.backends.backend_svg", "scipy.ndimage", "scipy.optimize", "cv2"):
        import_module(module)  # once, before processes are forked
    work = partial(_analyse, experiment=experiment, results=Results(job.results), settings=job.settings)
    reasons = {}
    for count, (name, reason, fault) in enumerate(map_unordered(work, names, job.threads), 1):
        reasons[name] = reason
        log.info("%s: %s", name, reason or "analysed")
        if fault:
            log.error("trial %s:\n%s", name, fault)
        job.say(f"{count} of {len(names)} trials")
    Kept(job.results).forget()
    failed = [f"  {name}: {reasons[name]}" for name in names if reasons[name]]
    return [f"{len(names) - len(failed)} of {len(names)} analysed", *failed[:10]]


def _analyse(name: str, experiment: Experiment, results: Results, settings: RunSettings) -> tuple[str, str, str]:
    """Analyse one trial. Returns its name, why it failed and the traceback of a fault; blank if there are none."""
    reason, fault, kept = experiment.failed.get(name, ""), "", Kept(results.folder)
    trial = None if reason else experiment.trial(name)
    measurement, summary = None, None
    columns, view = dict[str, float](), dict[str, Any]()
    try:
        if trial is not None and trial.video is None:
            summary = summarise_trial(trial, correct_frames(load_track(trial)), settings, model_of(experiment))
        elif trial is not None:
            measurement = measure_recording(trial, experiment.settings, experiment.folder, kept.track)
            track, columns, view = _of_recording(trial, measurement, experiment)
            summary = summarise_trial(trial, track, settings, model_of(experiment))
    except (RecordingError, InputError, TrialError) as error:
        from_file = trial.track if trial is not None and trial.video is None and isinstance(error, InputError) else None
        reason = f"{from_file.name} {error}" if from_file else str(error)
    except Exception as error:
        if is_disk_full(error):
            raise  # a full disk is not a fault of this trial
        reason, fault = f"could not be analysed: {INTERNAL_ERROR}", traceback.format_exc()
    row = _bare_row(name, "failed", reason, trial) if summary is None else dict(summary.row) | columns
    content = _write(results, name, summary, row) | view
    _draw(name, trial, measurement, reason, content, results, settings.figures, kept)
    write_json(results.analysed(name), content)  # the last of its files
    return name, reason, fault


def _of_recording(
    trial: Trial, measurement: Measurement, experiment: Experiment
) -> tuple[Track, dict[str, float], dict[str, Any]]:
    """Return the track of a recording, its columns of `trials.csv`, and what pages show of it as JSON entries."""
    tracking, calibration = measurement.tracking, measurement.calibration
    problems = [*size_problems(trial, tracked_facts(trial, measurement)), *exposure_problems(trial, tracking)]
    if errors := [problem.reason for problem in problems if problem.severity == "error"]:
        raise RecordingError("; ".join(errors))
    track = replace(tracking.track, notes=(*tracking.track.notes, *(problem.reason for problem in problems)))
    mm_per_px = 1e3 * measurement.m_per_px
    scale = {"mm_per_px": mm_per_px, "scale_rel_sigma": measurement.scale_rel_sigma}
    seen: dict[str, Any] = {"kind": "sheet", "image": None, **scale}
    if calibration is not None:
        seen |= {"kind": calibration.kind, "image": getattr(experiment.settings.calibration, "image", None)}
    known: dict[str, Any] = {"reprojection_px": None, "n_corners": 0, "notes": []}
    seen |= {name: getattr(calibration, name, blank) for name, blank in known.items()}
    seen["n_pictures"] = int(seen["n_corners"] > 0)
    axis = axis_entry(tracking.axis) | {"width_px": tracking.axis.width_px}
    axis |= {"shake_px": tracking.shake_px.round(2)} if np.any(tracking.shake_px) else {}
    contradictions = [{key: getattr(problem, key) for key in ("code", "column", "reason")} for problem in problems]
    view = {"calibration": seen, "axis": axis, "contradictions": contradictions}
    return with_pressure_trace(trial, track), scale | {"tube_width_mm": mm_per_px * tracking.tube_width_px}, view


@lru_cache(maxsize=1)
def _model(names: tuple[str, ...], paths: tuple[Path, ...]) -> Model:
    return make_model(names, {effect.name: effect for effect in map(load_effect, paths)})


def model_of(experiment: Experiment) -> Model:
    """Return the model in use; each process makes its own, since a user's effects cannot be pickled."""
    return _model(experiment.settings.model, tuple(experiment.folder / path for path in experiment.settings.effects))


def _bare_row(name: str, status: str, reason: str, trial: Trial | None = None) -> dict[str, Any]:
    """Return a row of `trials.csv` for a trial without results; `trial` is None if its row of the sheet is faulty."""
    vine, condition = ("", "") if trial is None else (trial.vine, trial.condition)
    known = {"trial": name, "vine": vine, "condition": condition, "status": status, "reason": reason, "steady_rule": ""}
    return dict.fromkeys(TRIALS_COLUMNS, np.nan) | known


def _write(results: Results, name: str, summary: TrialResult | None, row: dict[str, Any]) -> dict[str, Any]:
    """Write the tables of a trial, without results headers only; return what it adds to those of the experiment."""
    import pandas as pd

    content: dict[str, Any] = {"row": row, "windows": (), "point": None}
    if summary is None:
        track, kinematics = table_of(TRACK_COLUMNS), table_of(KINEMATICS_COLUMNS)
    else:
        measured = summary.track
        columns = {name: np.nan if values is None else values for name, values in vars(measured).items()}
        columns |= {"frame": np.arange(len(measured.time_s))}
        columns |= {"tracked_edge_px": measured.edge_px if measured.tracked_px is None else measured.tracked_px}
        track = pd.DataFrame({column: columns[column] for column in TRACK_COLUMNS})
        kinematics = pd.DataFrame({column: getattr(summary.kinematics, column) for column in KINEMATICS_COLUMNS})
        point = dict(summary.point) | {"scale_rel_sigma": row["scale_rel_sigma"]}
        windows = []
        for window in summary.windows.values():
            low, high = window.drift_95
            row_of = {column: getattr(window, column, None) for column in STEADY_COLUMNS}
            row_of |= {"trial": name, "points": window.n_points, "drift_95_low": low, "drift_95_high": high}
            windows.append(row_of)
        content |= {"windows": windows, "point": point}
    write_csv(results.track(name), track)
    write_csv(results.kinematics(name), kinematics)
    return content


def _draw(
    name: str, trial: Trial | None, measurement: Measurement | None, reason: str, content: dict[str, Any],
    results: Results, settings: FigureSettings, kept: Kept,
) -> None:  # fmt: skip
    """Draw the motion of a trial, and the strip of a recording with its tracked edge, unless nothing changed."""
    title, ratio = _described(name, trial)
    shown = [results.track(name).read_bytes(), results.kinematics(name).read_bytes(), content]

    def motion() -> Figure:
        drawn = draw_trial(results, trial, name, content["windows"])
        return drawn or blank(f"{title}: no positions to draw.")

    def strip() -> Figure:
        if measurement is None:
            return blank(f"{name}: {reason}")
        return draw_strip(name, measurement.tracking, measurement.m_per_px, unit)

    unit = "kPa" if trial is None else trial.pressure_unit
    kept.figure(("trial", title, ratio, *shown), partial(results.trial_figure, name), settings, motion)
    if trial is not None and trial.video is not None:
        seen = (reason,) if measurement is None else (kept.tracked, measurement.m_per_px, trial.corrections, unit)
        kept.figure(("strip", name, *seen), partial(results.strip_figure, name), settings, strip)


def _described(name: str, trial: Trial | None) -> tuple[str, float]:
    """Title of the figure of a trial, and its travel ratio; `trial` is None if its row of the sheet is faulty."""
    return (name, 2.0) if trial is None else (" · ".join([name, *features(trial)]), trial.travel_ratio)


def draw_trial(results: Results, trial: Trial | None, name: str, windows: Sequence[dict[str, Any]]) -> Figure | None:
    """Draw position, speed and steady windows of one trial; None if there are no positions."""
    title, ratio = _described(name, trial)
    tables = read_result(results.track(name)), read_result(results.kinematics(name))
    return draw_trial_motion(title, *tables, table_of(STEADY_COLUMNS, windows), ratio)


# ------------------------------------------------------------------------------
# All trials: the tables of the experiment, and the damping law with its scaling with the size of the vine.


def fit_damping(job: Job) -> list[str]:
    """Gather the trials; fit the damping law and its scaling with size, and write `damping.json` and `scaling.json`."""
    table, results, settings = gather(job.experiment, job.results, job.settings), Results(job.results), job.settings
    law = fit_laws(read_result(results.points), resamples=settings.damping.resamples, seed=settings.damping.seed)
    write_json(results.scaling, fit_scaling(law) | fit_trends(read_result(results.conditions)))
    write_json(results.damping, law)
    return [failures_told(table)[0] or f"{len(table)} trials.", damping_headline(law)]


def gather(experiment: Experiment, folder: Path, settings: RunSettings) -> pd.DataFrame:
    """Gather the results of all trials in `trials.csv`, `conditions.csv`, `steady.csv` and `damping_points.csv`."""
    results = Results(folder)
    analysed = {name: read_json(results.analysed(name)) for name in experiment.names if name not in experiment.left_out}
    if experiment.settings.axis is None:
        # Those whose axis is askew to that of most other trials with the same growth angle failed.
        slopes_deg = {
            name: slope_deg(axis["from_px"], axis["to_px"], bends="via_px" in axis)
            for name, content in analysed.items()
            if content["row"]["status"] != "failed" and (axis := content.get("axis"))
        }
        for names, agreed in askew_trials(slopes_deg, experiment.trials):
            for name in names:
                row = _bare_row(name, "failed", str(remark("axis_askew", count=agreed)), experiment.trial(name))
                analysed[name] = {"row": row, "windows": [], "point": None}
    rows = {name: content["row"] for name, content in analysed.items()}
    rows |= {name: _bare_row(name, "left_out", reason) for name, reason in experiment.left_out.items()}
    table = table_of(TRIALS_COLUMNS, [rows[name] for name in experiment.names])
    windows = table_of(STEADY_COLUMNS, [row for content in analysed.values() for row in content["windows"]])
    points = table_of(POINT_COLUMNS, [content["point"] for content in analysed.values() if content["point"]])
    evaluated_at = {"final_at_fraction": settings.final_at_fraction, "efficiency_at_mm": settings.efficiency_at_mm}
    write_csv(results.steady, windows)
    write_csv(results.points, mark_left_out(points))
    write_csv(results.conditions, condition_table(table, experiment.trials, **evaluated_at))
    write_csv(results.trials, table)
    return table
