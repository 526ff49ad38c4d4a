"""Fit of the model in use to the tracks of a results folder, comparison with them, and audit of neglected effects.

Recordings and tracks are treated alike: both are read from `tracks/`. A model that cannot be fitted does not stop the
run: its tables have headers only, and `fit.json` states the reason.
"""

from __future__ import annotations

import logging
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vinetrack.core.problems import INTERNAL_ERROR, confirmed, remark
from vinetrack.core.tables import write_csv, write_json, write_text
from vinetrack.diagnosis.ladder import (
    COMPARISON_COLUMNS,
    LADDER_COLUMNS,
    align_trials,
    candidates_of,
    compare,
    initial_fit,
)
from vinetrack.diagnosis.locate import drift_groups
from vinetrack.diagnosis.propose import propose
from vinetrack.diagnosis.result import UNEXPLAINED, Diagnosis
from vinetrack.dynamics.audit import COLUMNS as AUDIT_COLUMNS
from vinetrack.dynamics.audit import audit, motion_since
from vinetrack.dynamics.model import make_model
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.effects import EffectError, remember
from vinetrack.experiment.folder import Experiment
from vinetrack.experiment.settings import RunSettings
from vinetrack.inference.fit_data import FitError, Pairs
from vinetrack.inference.fit_result import CHECK_COLUMNS, Fit, TrialFit, check_damping
from vinetrack.inference.fit_summary import FitSummary, summary_of
from vinetrack.kinematics.summary import TrialMotion, law_table, look_at_motions, redo_damping
from vinetrack.narrative.diagnosis_text import proposal_lines
from vinetrack.narrative.verdict_text import verdict_sentence, verdict_table
from vinetrack.pipeline.stages import Job
from vinetrack.pipeline.trials import fit_damping, model_of
from vinetrack.planning.predictive_inputs import pressure_problems
from vinetrack.results import folder_layout as layout
from vinetrack.tracks.frame_timing import longer_than_stated, mean_speed

if TYPE_CHECKING:
    import pandas as pd


log = logging.getLogger(__name__)


def fit_and_diagnose(job: Job) -> list[str]:
    """Gather the trials, fit the damping law and the model in use, compare and audit it, and diagnose what it lacks. A
    diagnosis that fails does not stop the run: `diagnosis.json` then has no verdict and states the reason.
    """
    lines, results = fit_damping(job), layout.Results(job.results)
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
    experiment, results = job.experiment, layout.Results(job.results)
    damping = layout.read_json(results.damping)
    pairs = layout.measured_trials(experiment, results)
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
        check, messages = layout.table_of(CHECK_COLUMNS), list[str]()
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
        trajectories, tables = {}, [*map(layout.table_of, (COMPARISON_COLUMNS, CHECK_COLUMNS, AUDIT_COLUMNS))]
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
    if isinstance(error, FitError | EffectError | SimulationError):
        return str(error)
    log.exception("no fit or no diagnosis could be made")
    return INTERNAL_ERROR


# ------------------------------------------------------------------------------
# Diagnosis of a results folder: which effects the model lacks, and how much they reduce its errors.

Report = Callable[[str], None]


def diagnosed(
    experiment: Experiment, results: layout.Results, pairs: Pairs, report: Report, fitted: Fit | None = None
) -> Diagnosis:
    """The diagnosis of these trials as the experiment asks for it, with what contradicts its sheet."""
    from vinetrack.diagnosis.diagnose import diagnose

    tracks = {trial.name: track for trial, track in pairs}
    return with_contradictions(diagnose(experiment, tracks=tracks, report=report, fitted=fitted), results, pairs)


def with_contradictions(diagnosis: Diagnosis, results: layout.Results, pairs: Pairs) -> Diagnosis:
    """Add contradictions between measurements and sheet to a diagnosis: a wrong scale or unit can look like physics."""
    contradictions = sheet_contradictions(results, pairs)
    if not contradictions:
        return diagnosis
    others = (note for note in diagnosis.notes if str(note) not in contradictions.values())
    notes = (*contradictions.values(), *others)
    contradicted = replace(diagnosis, contradicted_columns=tuple(contradictions), notes=notes, next_experiment=None)
    return replace(contradicted, explanation=verdict_sentence(contradicted))


def sheet_contradictions(results: layout.Results, pairs: Pairs) -> dict[str, str]:
    """Return a sentence for each column of the sheet that recordings or speeds contradict, by its name."""
    noted: dict[str, list[str]] = {}
    content = {trial: layout.read_json(results.analysed(trial.name)) for trial, _ in pairs}
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
    results: layout.Results, diagnosis: Diagnosis, motions: Callable[[], list[TrialMotion]], settings: RunSettings
) -> None:
    """Write `diagnosis.json`, `ladder.csv` and the folder `diagnosis`; `motions` are needed if a model was extended."""
    ladder = layout.table_of(LADDER_COLUMNS) if diagnosis.ladder is None else diagnosis.ladder
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
    summary = [vars(row) for row in verdict_table(diagnosis)]
    write_json(results.diagnosis, {**diagnosis.to_json(), "summary": summary})


def all_steps(results: layout.Results, ladder: pd.DataFrame) -> pd.DataFrame:
    """Return the ladder below the steps by which earlier runs came to its first model: those of their ladder above it,
    if its error there is the same, so that it is of the same trials.
    """
    import pandas as pd

    former = next(
        (layout.read_result(path) for path in (results.kept_steps, results.ladder) if path.exists()), ladder[:0]
    )
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
    """Predict every trial with the initial and the final model. As in `comparison.csv` and the ladder, only release and
    origin are fitted per trial. Returns each trial under the initial model, and a table: s and m, `model_after_m` NaN
    if no effect was added.
    """
    import pandas as pd

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


def propose_effect(experiment: Experiment, folder: Path, report: Report) -> tuple[list[str], list[Path]]:
    """Write the law of a force that no effect of the catalogue explains, and its table; return lines, and the files."""
    results = layout.Results(folder)
    diagnosis = layout.read_diagnosis(results)
    if diagnosis is None:
        raise layout.ResultsError(f"{folder}: it has no diagnosis; run vinetrack diagnose {folder}")
    if diagnosis.contradicted_columns or not diagnosis.verdict:
        raise layout.ResultsError(f"{folder}: {verdict_sentence(diagnosis)}")
    if UNEXPLAINED not in (diagnosis.verdict, diagnosis.final_verdict):
        raise layout.ResultsError(str(remark("no_law_needed", folder=folder, verdict=diagnosis.verdict)))
    model = make_model(dict.fromkeys([*experiment.settings.model, *diagnosis.added]), experiment.user_effects)
    proposal = propose(model, diagnosis.settled(layout.measured_trials(experiment, results)), report)
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
        raise layout.ResultsError(f"{there[0]} exists already: move it away.")
    for path, text in files.items():
        write_text(path, text)
        remember(path)
        lines.append(f"Written to {path}. Read it, then fit it with `vinetrack add {path} {folder}`.")
    if files:
        settings = experiment.folder / "experiment.yaml"
        lines.append(f"To test it in the diagnosis, list it under `effects:` in {settings}.")
    return lines, list(files)
