"""The stages of the trials and of the model: from recording or track to kinematics and figures of each trial, and the
tables of all of them; the fit of the model in use, its comparison with the tracks, the audit of neglected effects, and
the diagnosis.

Worker processes take one trial after another. The track of a recording in pixels and the pictures of a trial are kept.
A trial that fails writes its reason and never stops the others. A model that cannot be fitted does not stop the run:
its tables have headers only, and `fit.json` states the reason.
"""

from __future__ import annotations

import logging
import math
import shutil
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from scipy.special import ndtri_exp

from vinetrack.core.problems import INTERNAL_ERROR, InputError, UserError, confirmed, remark
from vinetrack.core.records import Track, Trial
from vinetrack.core.tables import is_disk_full, write_bytes, write_csv, write_json, write_text
from vinetrack.core.units import or_nan
from vinetrack.diagnosis.ladder import (
    COMPARISON_COLUMNS,
    LADDER_COLUMNS,
    align_trials,
    candidates_of,
    compare,
    drift_groups,
    initial_fit,
)
from vinetrack.diagnosis.propose import propose
from vinetrack.diagnosis.result import UNEXPLAINED, Diagnosis
from vinetrack.dynamics.audit import COLUMNS as AUDIT_COLUMNS
from vinetrack.dynamics.audit import audit, motion_since
from vinetrack.dynamics.model import Model, make_model
from vinetrack.effects import load_effect, remember
from vinetrack.experiment.folder import SETTINGS, Experiment
from vinetrack.experiment.settings import FigureSettings, RunSettings
from vinetrack.figures.motion_figures import draw_strip, draw_trial_motion
from vinetrack.figures.registry import features
from vinetrack.figures.style import blank, render
from vinetrack.inference.errors import summary_of
from vinetrack.inference.fit_data import FitError, Pairs
from vinetrack.inference.fit_result import DAMPING, EXPONENT, Fit, FitSummary, TrialFit
from vinetrack.kinematics.damping import fit_laws, fit_scaling, fit_trends, mark_half_steady, mark_left_out
from vinetrack.kinematics.summary import (
    TrialMotion,
    TrialResult,
    condition_table,
    law_table,
    look_at_motions,
    redo_damping,
    summarise_trial,
)
from vinetrack.narrative.diagnosis_text import damping_headline, failures_told, proposal_lines
from vinetrack.narrative.verdict_text import verdict_sentence, verdict_table
from vinetrack.pipeline.workflow import Job, Kept, Say, code_hash, map_unordered
from vinetrack.planning.predictive_inputs import pressure_problems
from vinetrack.results import (
    KINEMATICS_COLUMNS,
    POINT_COLUMNS,
    STEADY_COLUMNS,
    TRACK_COLUMNS,
    TRIALS_COLUMNS,
    Results,
    ResultsError,
    measured_trials,
    read_diagnosis,
    read_json,
    read_result,
    table_of,
)
from vinetrack.tracks.frame_timing import correct_frames, longer_than_stated, mean_speed
from vinetrack.tracks.importers import load_track, with_pressure_trace
from vinetrack.video.axis import askew_trials, axis_entry
from vinetrack.video.frames import RecordingError
from vinetrack.video.survey import Measurement, exposure_problems, measure_recording, size_problems, tracked_facts

if TYPE_CHECKING:
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
    except UserError as error:
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
    unit = "kPa" if trial is None else trial.pressure_unit
    shown = [results.track(name).read_bytes(), results.kinematics(name).read_bytes(), content]

    def motion() -> Figure:
        return draw_trial(results, trial, name, content["windows"]) or blank(f"{title}: no positions to draw.")

    def strip() -> Figure:
        if measurement is None:
            return blank(f"{name}: {reason}")
        return draw_strip(name, measurement.tracking, measurement.m_per_px, unit)

    def write(draw: Callable[[], Figure], path: Callable[..., Path], *inputs: object) -> None:
        state = code_hash(), settings.dpi, settings.formats, inputs
        pictures = kept.made("figure", state, lambda: render(draw(), settings.formats, settings.dpi))
        for form, data in pictures.items():
            write_bytes(path(name, suffix=f".{form}"), data)

    write(motion, results.trial_figure, "trial", title, ratio, *shown)
    if trial is not None and trial.video is not None:
        seen = (reason,) if measurement is None else (kept.tracked, measurement.m_per_px, trial.corrections, unit)
        write(strip, results.strip_figure, "strip", name, *seen)


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
    """Gather the trials, fit the damping law and its scaling with size; write both, and why points are left out."""
    table, points = gather(job.experiment, job.results, job.settings)
    results, settings = Results(job.results), job.settings.damping
    law = fit_laws(points, resamples=settings.resamples, seed=settings.seed)
    write_csv(results.points, mark_left_out(points, law["both_axes"]["left_out"]))
    write_json(results.scaling, fit_scaling(law) | fit_trends(read_result(results.conditions)))
    write_json(results.damping, law)
    return [failures_told(table)[0] or f"{len(table)} trials.", damping_headline(law)]


def gather(experiment: Experiment, folder: Path, settings: RunSettings) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Gather all trials in `trials.csv`, `conditions.csv`, `steady.csv`; return the first, and points of the law."""
    results = Results(folder)
    analysed = {name: read_json(results.analysed(name)) for name in experiment.names if name not in experiment.left_out}
    if experiment.settings.axis is None:
        # Those whose axis is askew to that of most other trials with the same growth angle failed.
        axes = {
            name: axis
            for name, content in analysed.items()
            if content["row"]["status"] != "failed" and (axis := content.get("axis"))
        }
        for name, agreed in askew_trials(axes, experiment.trials).items():
            row = _bare_row(name, "failed", str(remark("axis_askew", count=agreed)), experiment.trial(name))
            analysed[name] = {"row": row, "windows": [], "point": None}
    rows = {name: content["row"] for name, content in analysed.items()}
    rows |= {name: _bare_row(name, "left_out", reason) for name, reason in experiment.left_out.items()}
    table = table_of(TRIALS_COLUMNS, [rows[name] for name in experiment.names])
    windows = table_of(STEADY_COLUMNS, [row for content in analysed.values() for row in content["windows"]])
    points = table_of(POINT_COLUMNS, [content["point"] for content in analysed.values() if content["point"]])
    evaluated_at = {"final_at_fraction": settings.final_at_fraction, "efficiency_at_mm": settings.efficiency_at_mm}
    write_csv(results.steady, windows)
    write_csv(results.conditions, condition_table(table, experiment.trials, **evaluated_at))
    write_csv(results.trials, table)
    return table, mark_half_steady(points)


# ------------------------------------------------------------------------------
# Check of the damping fits by the dynamic model: B and n from steady windows against B and n from whole trajectories.
#
# Both use the same recordings, but not the same part of them: steady windows show the final speed of a vine,
# trajectories also the approach to it. If they differ by more than their errors, the model lacks an effect.

CHECK_COLUMNS = ("vine", "n_steady", "n_trajectory", "B_steady", "B_trajectory", "z")


def check_damping(fit: Fit, damping: Mapping[str, Any]) -> pd.DataFrame:
    """One row per vine, as `model_check.csv` holds it."""
    if EXPONENT not in [number.key for number in fit.numbers]:
        raise FitError("The exponent n was fixed in this fit: there is nothing to check the steady windows against.")
    n, n_steady, rows = fit[EXPONENT], or_nan(damping.get("n")), []
    for vine in dict.fromkeys(trial.trial.vine for trial in fit.trials):
        steady, z = (damping.get("vines") or {}).get(vine), math.nan
        B = next((b for b in fit.numbers if b.key == DAMPING and b.vine in (vine, "")), None)
        if steady and B and math.isfinite(n_steady):
            difference = np.array([n_steady - n.value, math.log(steady["B"] / B.value)])
            # Covariances of n and ln B of the vine.
            names = damping["covariance"]["parameters"]
            k = [names.index("n"), names.index(f"ln B {vine}")]
            of_steady = np.array(damping["covariance"]["matrix"], dtype=float)[np.ix_(k, k)]
            k, slopes = [fit.numbers.index(n), fit.numbers.index(B)], np.array([1.0, 1 / B.value])
            of_trajectories = fit.covariance[np.ix_(k, k)] * slopes[:, None] * slopes
            z = _deviate(difference, of_steady + of_trajectories)
        rows.append((vine, n_steady, n.value, steady["B"] if steady else math.nan, B.value if B else math.nan, z))
    return pd.DataFrame(rows, columns=list(CHECK_COLUMNS))


def _deviate(difference: np.ndarray, covariance: np.ndarray) -> float:
    """Normal deviate as unlikely as this difference of two parameters, from χ² with two degrees of freedom."""
    if not np.isfinite(covariance).all() or np.linalg.matrix_rank(covariance) < 2:
        return math.nan
    square = float(difference @ np.linalg.solve(covariance, difference))
    # ln P(χ²₂ > s) = −s/2; half of it on each side of the normal, in logarithms so that 40 σ is 40 σ.
    return -float(ndtri_exp(-square / 2 - math.log(2)))


# ------------------------------------------------------------------------------
# The model in use: its fit to the tracks in `tracks/`, comparison with them, and audit of neglected effects.


def fit_and_diagnose(job: Job) -> list[str]:
    """Do the stage `model`. A diagnosis that fails does not stop the run: `diagnosis.json` then states the reason."""
    lines, results = fit_damping(job), Results(job.results)
    job.say("fitting the model")
    fitted, pairs, motions = fit_model(job)
    try:
        diagnosis = diagnosed(job.experiment, results, pairs, job.say, fitted)
    except Exception as error:
        reason = _reason(error) if pairs else lines[0]
        explanation = f"No diagnosis could be made: {reason}"
        diagnosis = Diagnosis(rounds=(), effects=(), explanation=explanation, refused=reason)
    log.info("%s: %s", diagnosis.verdict, diagnosis.explanation)
    job.say("fitting the damping law under every model")
    write_diagnosis(results, diagnosis, lambda: motions, job.settings)
    return ["fitted and diagnosed" if diagnosis.verdict else "no diagnosis", *lines, str(diagnosis)]


def fit_model(job: Job) -> tuple[Fit | None, Pairs, list[TrialMotion]]:
    """Fit the model in use, write the fit and what it is compared with; return it, its trials and their motions."""
    experiment, results = job.experiment, Results(job.results)
    damping = read_json(results.damping)
    pairs = measured_trials(experiment, results)
    seen = look_at_motions(pairs, job.settings)
    kinematics = {motion.trial.name: motion.kinematics for motion in seen}
    initial: Fit | None = None
    try:
        model = model_of(experiment)
        candidates = candidates_of(model, experiment.settings.candidates, experiment.user_effects)
        # The g of a body that falls by gravity alone tests the whole chain; a diagnosis holds it.
        free = ("gravity.g",) if model.names == ("gravity",) else ()
        fit = initial_fit(model, pairs, candidates, free=free)
        initial = None if free else fit
        comparison = compare(fit, pairs, kinematics=kinematics, final_at_fraction=job.settings.final_at_fraction)
        check, messages = table_of(CHECK_COLUMNS), list[str]()
        try:
            check = check_damping(fit, damping["log_log" if damping["both_axes"].get("refused") else "both_axes"])
        except FitError as error:
            messages.append(str(error))
        tracks, motions = {trial.name: track for trial, track in pairs}, []
        for trial in comparison.trials:
            track, k = tracks[trial.name], kinematics[trial.name]
            trace = None if track.pressure_Pa is None else (track.time_s - trial.release_s, track.pressure_Pa)
            since = partial(motion_since, trial.release_s, trial.trial, trace=trace)
            own = since(trial.time_s, trial.predicted_position_m, trial.predicted_velocity_m_s)
            motions.append(since(k.time_s, k.lead_position_m, k.lead_velocity_m_s, by_model=own))
        audited = audit(fit.model, motions)
        content = summary_of(fit, audited.warnings, tuple(messages)).to_json()
        trajectories, tables = comparison.trajectories, [comparison.table, check, audited.table]
    except Exception as error:
        content = FitSummary(names=tuple(experiment.settings.model), refused=_reason(error)).to_json()
        trajectories, tables = {}, [*map(table_of, (COMPARISON_COLUMNS, CHECK_COLUMNS, AUDIT_COLUMNS))]
    for path, table in zip((results.comparison, results.model_check, results.audit), tables, strict=True):
        write_csv(path, table)
    _emptied(results.folder / "comparison")
    for condition, table in trajectories.items():
        write_csv(results.trajectories(condition), table)
    write_json(results.fit, content)
    log.info("%s", content["refused"] or f"fitted {len(content['trials'])} trials")
    return initial, pairs, seen


def _emptied(folder: Path) -> Path:
    """A folder without the files of an earlier run, whose trials and conditions may no longer exist."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    return folder


def _reason(error: Exception) -> str:
    """Return why there is no fit or verdict; the traceback of an unexpected exception goes to the log."""
    if isinstance(error, UserError):
        return str(error)
    log.exception("no fit or no diagnosis could be made")
    return INTERNAL_ERROR


# ------------------------------------------------------------------------------
# Diagnosis of a results folder: which effects the model lacks, and how much they reduce its errors.


def diagnosed(
    experiment: Experiment, results: Results, pairs: Pairs, report: Say, fitted: Fit | None = None
) -> Diagnosis:
    """The diagnosis of these trials as the experiment asks for it, with what contradicts its sheet."""
    from vinetrack.diagnosis.diagnose import diagnose

    tracks = {trial.name: track for trial, track in pairs}
    return with_contradictions(diagnose(experiment, tracks=tracks, report=report, fitted=fitted), results, pairs)


def with_contradictions(diagnosis: Diagnosis, results: Results, pairs: Pairs) -> Diagnosis:
    """Add contradictions between measurements and sheet to a diagnosis: a wrong scale or unit can look like physics."""
    contradictions = sheet_contradictions(results, pairs)
    if not contradictions:
        return diagnosis
    others = (note for note in diagnosis.notes if str(note) not in contradictions.values())
    notes = (*contradictions.values(), *others)
    contradicted = replace(diagnosis, contradicted_columns=tuple(contradictions), notes=notes, next_experiment=None)
    return replace(contradicted, explanation=verdict_sentence(contradicted))


def sheet_contradictions(results: Results, pairs: Pairs) -> dict[str, str]:
    """Return a sentence for each column of the sheet that recordings or speeds contradict, by its name."""
    noted: dict[str, list[str]] = {}
    content = {trial: read_json(results.analysed(trial.name)) for trial, _ in pairs}
    found = [(trial, entry) for trial, seen in content.items() for entry in seen.get("contradictions", [])]
    sure = confirmed([(trial.vine, entry["column"]) for trial, entry in found], [trial.vine for trial in content])
    for trial, entry in found:
        if entry.get("code") != "size" or (trial.vine, entry["column"]) in sure:
            noted.setdefault(entry["column"], []).append(f"{trial.name}: {entry['reason']}")
    sentences = {}
    for column, (first, *others) in noted.items():
        sentences[column] = f"{first} (and {len(others)} more trial{'s'[: len(others) > 1]})" if others else first
    if longer := longer_than_stated(pairs):
        sentences["length_mm"] = str(longer)
    speeds = [(trial, mean_speed(track)) for trial, track in pairs]
    return sentences | {problem.column: problem.reason for problem in pressure_problems(speeds)}


def write_diagnosis(
    results: Results, diagnosis: Diagnosis, motions: Callable[[], list[TrialMotion]], settings: RunSettings
) -> None:
    """Write `diagnosis.json`, `ladder.csv` and the folder `diagnosis`; `motions` are needed if a model was extended."""
    ladder = table_of(LADDER_COLUMNS) if diagnosis.ladder is None else diagnosis.ladder
    laws, steps, folder = {}, all_steps(results, ladder), _emptied(results.folder / "diagnosis")
    if len(diagnosis.fits) > 1:
        of_trials = motions()  # with the pressure that each model of the ladder predicts
        for fit in diagnosis.fits:
            try:
                laws["+".join(fit.model.names)] = redo_damping(fit.model, of_trials, settings)
            except ValueError as error:
                log.info("no damping law with %s: %s", " + ".join(fit.model.names), error)
        write_json(results.final_fit, summary_of(diagnosis.fits[-1]).to_json())
    tables = {"damping_laws.csv": law_table(laws), "steps.csv": steps, **diagnosis_tables(diagnosis)}
    for name, table in tables.items():
        write_csv(folder / name, table)
    write_csv(results.kept_steps, steps)
    for one, table in predictions(diagnosis.fits[0], diagnosis.fits[-1]) if diagnosis.fits else ():
        write_csv(results.predictions(one.name), table)
    write_csv(results.ladder, ladder)
    write_json(results.diagnosis, diagnosis_content(diagnosis))


def diagnosis_content(diagnosis: Diagnosis) -> dict[str, Any]:
    """Content of `diagnosis.json`, with the table of the verdict as it is told."""
    return {**diagnosis.to_json(), "summary": [vars(row) for row in verdict_table(diagnosis)]}


def all_steps(results: Results, ladder: pd.DataFrame) -> pd.DataFrame:
    """Return the ladder below the steps by which earlier runs came to its first model: those of their ladder above it,
    if its error there is the same, so that it is of the same trials.
    """
    former = next((read_result(path) for path in (results.kept_steps, results.ladder) if path.exists()), ladder[:0])
    known = zip(former["model"], former["rms_in_sample_m"].astype(float), strict=True)
    for k, (model, rms_m) in enumerate(known if len(ladder) else ()):
        if model == ladder["model"][0] and np.isclose(rms_m, ladder["rms_in_sample_m"][0], 1e-2, 0):
            reached = ladder[:1].assign(added=former["added"][k])  # with the errors of this run
            return pd.concat([former[:k], reached, ladder[1:]], ignore_index=True)
    return ladder


def diagnosis_tables(diagnosis: Diagnosis) -> dict[str, pd.DataFrame]:
    """Return the tables of the initial model's misfit and of the missing force, by file name."""
    tables: dict[str, pd.DataFrame] = {}
    if diagnosis.force is not None and diagnosis.force.learned is not None:
        tables["learned_force.csv"] = diagnosis.force.learned.table
    if (failure := diagnosis.failure) is not None:
        tables |= {
            "along_position.csv": failure.along_position,
            "drift_groups.csv": drift_groups(failure.drift, diagnosis.fits[-1] if len(diagnosis.fits) > 1 else None),
        }
    return tables


def predictions(before: Fit, after: Fit) -> list[tuple[TrialFit, pd.DataFrame]]:
    """Predict every trial with the initial and the final model; as in `comparison.csv`, only release and origin are
    fitted per trial. Returns each trial under the first, and a table, s and m, `model_after_m` NaN if none was added.
    """
    final = {} if after is before else {one.name: one.predicted_position_m for one in _followed(after)}
    found = []
    for one in _followed(before):
        measured = {"time_s": one.time_s, "lead_position_m": one.lead_position_m}
        models = {"model_before_m": one.predicted_position_m, "model_after_m": final.get(one.name, np.nan)}
        found.append((one, pd.DataFrame(measured | models)))
    return found


def _followed(fit: Fit) -> Sequence[TrialFit]:
    """The trials as a model predicts them; none where it cannot be followed through one of them."""
    try:
        return align_trials(fit).trials
    except FitError as error:
        log.info("no predictions of %s: %s", fit.model, error)
        return ()


def propose_effect(experiment: Experiment, folder: Path, report: Say) -> tuple[list[str], list[Path]]:
    """Write the law of a force that no effect of the catalogue explains, and its table; return lines, and the files."""
    results = Results(folder)
    diagnosis = read_diagnosis(results)
    if diagnosis is None:
        raise ResultsError(f"{folder}: it has no diagnosis; run vinetrack diagnose {folder}")
    if diagnosis.contradicted_columns or not diagnosis.verdict:
        raise ResultsError(f"{folder}: {verdict_sentence(diagnosis)}")
    if UNEXPLAINED not in (diagnosis.verdict, diagnosis.final_verdict):
        raise ResultsError(str(remark("no_law_needed", folder=folder, verdict=diagnosis.verdict)))
    model = make_model(dict.fromkeys([*experiment.settings.model, *diagnosis.added]), experiment.user_effects)
    proposal = propose(model, diagnosis.settled(measured_trials(experiment, results)), report)
    learned = (diagnosis.missing_force or {}).get("learned") or {}
    lines = [*([learned["sentence"]] if learned else []), *proposal_lines(proposal)]
    facts = {"count": len(proposal.before.trials), "experiment": experiment.name, "model": model.names}
    facts |= {"before_m": proposal.rms_left_out_m}
    files: dict[Path, str] = {}
    if proposal.tied:
        best = proposal.tied[0]
        origin = remark("law_origin", **facts, rms_m=best.rms_left_out_m, gain=best.ratio.delta_chi2)
        files[experiment.folder / best.effect.path.name] = best.text(str(origin))
    if (table := proposal.table) is not None:
        origin = remark("table_origin", **facts, rms_m=table.rms_left_out_m)
        files[experiment.folder / table.effect.path.name] = table.text(str(origin))
    if there := [path for path in files if path.exists()]:
        raise ResultsError(f"{there[0]} exists already: move it away.")
    for path, text in files.items():
        write_text(path, text)
        remember(path)
        lines.append(f"Written to {path}. Read it, then fit it with `vinetrack add {path} {folder}`.")
    if files:
        lines.append(f"To test it in the diagnosis, list it under `effects:` in {experiment.folder / SETTINGS}.")
    return lines, list(files)
