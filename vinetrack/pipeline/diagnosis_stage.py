"""Diagnosis of a results folder: which effects the model lacks, and how much they reduce its errors.

A diagnosis that fails does not stop the run: `diagnosis.json` then has no verdict and states the reason.
"""

from __future__ import annotations

import contextlib
import itertools
import logging
import math
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.core.problems import INTERNAL_ERROR
from vinetrack.core.tables import write_csv, write_json
from vinetrack.core.units import with_error
from vinetrack.figures.style import rows as iter_rows
from vinetrack.narrative.diagnosis_text import contradicted_in_words, sentences_of, to_go_on, verdict_line
from vinetrack.narrative.power_text import power_brief
from vinetrack.narrative.verdict_text import estimates_text, listed_names, settled_rows, summary_facts
from vinetrack.pipeline.model_stage import measured_trials, model_errors
from vinetrack.results.folder_layout import Results, ResultsError, empty_table, read_diagnosis, read_json, read_result
from vinetrack.results.folder_layout import read_diagnosis as stored_diagnosis

if TYPE_CHECKING:
    import pandas as pd

    from vinetrack.core.records import Track, Trial
    from vinetrack.diagnosis.locate import Failure
    from vinetrack.diagnosis.result import Diagnosis, Round
    from vinetrack.effects import Effect
    from vinetrack.experiment.folder import Experiment
    from vinetrack.experiment.settings import RunSettings
    from vinetrack.inference.fit_result import Fit
    from vinetrack.report.diagnosis_section import DiagnosisResult


# ------------------------------------------------------------------------------
# Tables of a stored diagnosis for figures and report.
#
# Any part may be missing: there may be no diagnosis, it may have failed, or it may have added no effect.

CURVE_COLUMNS = ("trial", "condition", "time_s", "lead_position_m", "model_before_m", "model_after_m")


def _no_table() -> pd.DataFrame:
    import pandas as pd

    return pd.DataFrame()


@dataclass(frozen=True)
class DiagnosisTables:
    """Data of the figures; a table is empty if there is nothing to draw. `rounds` are (heading, ranking) pairs, `worst`
    is the label of the condition that `before_after` shows, `added` the added effects in words.
    """

    ladder: pd.DataFrame = field(default_factory=_no_table)
    trials: pd.DataFrame = field(default_factory=_no_table)
    before_after: pd.DataFrame = field(default_factory=_no_table)
    where: pd.DataFrame = field(default_factory=_no_table)
    cosines: pd.DataFrame = field(default_factory=_no_table)
    drift: pd.DataFrame = field(default_factory=_no_table)
    missing_force: pd.DataFrame = field(default_factory=_no_table)
    learned_force: pd.DataFrame = field(default_factory=_no_table)
    rounds: Sequence[tuple[str, pd.DataFrame]] = ()
    worst: str = ""
    added: str = ""

    @property
    def ranking(self) -> pd.DataFrame:
        """The rankings of all rounds in one table."""
        import pandas as pd

        parts = [table.assign(round=i + 1) for i, (_, table) in enumerate(self.rounds) if len(table)]
        return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame()


def read_diagnosis_tables(results: Results, conditions: pd.DataFrame) -> DiagnosisTables | None:
    """Read the tables of a results folder; None if it has no diagnosis, or that failed."""
    diagnosis = stored_diagnosis(results)
    if diagnosis is None or not diagnosis.verdict:
        return None
    names = ("along_position.csv", "drift_groups.csv", "missing_force.csv", "learned_force.csv")
    located, drifting, force, learned = (_table(results.diagnosed(name)) for name in names)
    trials = predicted_trials(results, conditions)
    return assemble_tables(diagnosis, conditions, trials, located, drifting, force, learned)


def assemble_tables(
    diagnosis: Diagnosis,
    conditions: pd.DataFrame,
    trials: pd.DataFrame,
    located: pd.DataFrame,
    drifting: pd.DataFrame,
    force: pd.DataFrame,
    learned: pd.DataFrame | None = None,
) -> DiagnosisTables:
    """Assemble the data of the figures."""
    import pandas as pd

    labels = {str(row.condition): str(row.condition_label) for row in conditions.itertuples()}
    worst = worst_condition(trials)
    names, matrix = cosines_by_rank(diagnosis.rounds[0])
    return DiagnosisTables(
        ladder=pd.DataFrame() if diagnosis.ladder is None else diagnosis.ladder,
        trials=trials,
        before_after=trials[trials["condition"] == worst] if worst else trials.iloc[:0],
        where=_where_table(trials, labels, located),
        cosines=_cosine_cells(names, matrix),
        drift=drifting,
        missing_force=force,
        rounds=[
            (round_heading(i, diagnosis.rounds), ranking_table(ranked)) for i, ranked in enumerate(diagnosis.rounds)
        ],
        worst=labels.get(worst, worst),
        added=listed_names(diagnosis.effects),
        learned_force=pd.DataFrame() if learned is None else learned,
    )


def read_diagnosis_section(results: Results, experiment: Experiment) -> DiagnosisResult | None:
    """Return the content of the report's section on the diagnosis; None if there is no diagnosis."""
    from vinetrack.report.diagnosis_section import DiagnosisResult

    diagnosis = stored_diagnosis(results)
    if diagnosis is None:
        return None
    paths = (results.diagnosed("moved.csv"), results.diagnosed("damping_laws.csv"))
    moved, laws = (table if len(table := _table(path)) else None for path in paths)
    reported = [*diagnosis.effects, *diagnosis.answer_set]
    effects = _effects([*reported, *(row.effect for ranked in diagnosis.rounds for row in ranked.ranking)], experiment)
    return DiagnosisResult(
        diagnosis,
        diagnosis.ladder,
        moved,
        laws,
        {name: effects[name].summary for name in reported if name in effects},
        {f"{name}.{p.name}": (p.symbol, p.unit) for name, effect in effects.items() for p in effect.parameters},
    )


def _effects(names: Sequence[str], experiment: Experiment) -> dict[str, Effect]:
    """Return effects by name, without those whose file no longer exists."""
    from vinetrack.effects import EffectError, find_effect, own_effects

    try:
        user_effects = own_effects([experiment.folder / path for path in experiment.settings.effects])
    except EffectError:
        user_effects = {}
    effects = {}
    for name in dict.fromkeys(names):
        with contextlib.suppress(EffectError):
            effects[name] = find_effect(name, user_effects)
    return effects


def _table(path: Any) -> pd.DataFrame:
    import pandas as pd

    return read_result(path) if path.exists() else pd.DataFrame()


def predicted_trials(results: Results, conditions: pd.DataFrame) -> pd.DataFrame:
    """Return measured and predicted positions of all trials, relative to release and origin."""
    import pandas as pd

    parts = []
    compared: dict[str, pd.DataFrame] = {}
    for trial, condition in zip(conditions["trial"], conditions["condition"], strict=True):
        path = results.predictions(trial)
        table = read_result(path) if path.exists() else None
        if table is None or not len(table):
            continue
        if condition not in compared:
            exists = bool(condition) and results.trajectories(condition).exists()
            compared[condition] = read_result(results.trajectories(condition)) if exists else pd.DataFrame()
        release_s, origin_m = _start(trial, table, compared[condition])
        positions = {name: table[name] - origin_m for name in CURVE_COLUMNS[3:]}
        time_s = table["time_s"] - release_s
        parts.append(pd.DataFrame({"trial": trial, "condition": condition, "time_s": time_s, **positions}))
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=list(CURVE_COLUMNS))


def _start(trial: str, table: pd.DataFrame, compared: pd.DataFrame) -> tuple[float, float]:
    """Return release and origin of a trial: those of the comparison, which starts at the same point, else estimates."""
    of_trial = compared[compared["trial"] == trial] if len(compared) else compared
    time_s, position_m = float(table["time_s"].iloc[0]), float(table["lead_position_m"].iloc[0])
    if len(of_trial) == len(table):
        return time_s - float(of_trial["time_s"].iloc[0]), position_m - float(of_trial["lead_position_m"].iloc[0])
    origin_m = float(np.nanmin(table["lead_position_m"]))
    return _first_moving_s(table, origin_m), origin_m


def _first_moving_s(table: pd.DataFrame, origin_m: float) -> float:
    growth = table["lead_position_m"].to_numpy(dtype=float) - origin_m
    return float(table["time_s"].iloc[int(np.argmax(growth > 0.01 * np.nanmax(growth)))])


def worst_condition(trials: pd.DataFrame) -> str:
    """Return the condition with the largest RMS error of the initial model; blank without predictions."""
    from vinetrack.figures.diagnosis_figures import rms_m

    if not len(trials):
        return ""
    errors_m = {name: rms_m(part, "model_before_m") for name, part in trials.groupby("condition", sort=False)}
    finite_m = {name: value for name, value in errors_m.items() if math.isfinite(value)}
    return str(max(finite_m, key=finite_m.__getitem__)) if finite_m else ""


def _where_table(trials: pd.DataFrame, labels: Mapping[str, str], located: pd.DataFrame) -> pd.DataFrame:
    """Return the mean misfit of every condition in sections of its growth, for the figure `where`. The misfit
    of the initial model and its error are taken from the diagnosis if it contains them.
    """
    import pandas as pd

    rows: list[dict[str, Any]] = []
    by_condition = located[located["condition"] != ""] if len(located) else located
    for condition in labels:
        members = trials[trials["condition"] == condition]
        if not len(members):
            continue
        of_condition = by_condition[by_condition["condition"] == condition] if len(by_condition) else by_condition
        rows += [
            {"condition": condition, "condition_label": labels[condition], **row}
            for row in (
                _located_sections(of_condition, located, members) if len(of_condition) else _measured_sections(members)
            )
        ]
    return pd.DataFrame(rows)


def _located_sections(of_condition: pd.DataFrame, located: pd.DataFrame, members: pd.DataFrame) -> list[dict[str, Any]]:
    """Return the sections of the diagnosis, with the misfit of the final model added."""
    vine = str(of_condition["vine"].iloc[0])
    whole_m = float(located.loc[located["vine"] == vine, "to_m"].max())
    if not whole_m > 0:
        return []  # There was no growth to divide into sections.
    rows = []
    for row in iter_rows(of_condition):
        after = _mean_misfits(members, "model_before_m", float(row.from_m), float(row.to_m))["model_after_m"]
        rows.append(
            {
                "n_trials": int(members["trial"].nunique()),
                "growth_from": float(row.from_m) / whole_m,
                "growth_to": float(row.to_m) / whole_m,
                "misfit_before_m": float(row.mean_residual_m),
                "misfit_after_m": float(np.nanmean(after)) if np.isfinite(after).any() else math.nan,
                "scatter_m": float(row.sigma_m),
            }
        )
    return rows


def _measured_sections(members: pd.DataFrame) -> list[dict[str, Any]]:
    """Return equal sections of the measured growth; the scatter is the standard error of the mean over trials."""
    from vinetrack.diagnosis.result import MAX_STRETCHES

    whole_m = float(members["lead_position_m"].max())
    if not whole_m > 0:
        return []
    edges = np.linspace(0.0, whole_m, MAX_STRETCHES + 1)
    count = int(members["trial"].nunique())
    rows = []
    for low, high in itertools.pairwise(edges):
        means = _mean_misfits(members, "lead_position_m", low, high if high < whole_m else math.inf)
        before, after = means["model_before_m"], means["model_after_m"]
        if not np.isfinite(before).any():
            continue
        spread = float(np.nanstd(before, ddof=1)) if np.isfinite(before).sum() > 1 else math.nan
        rows.append(
            {
                "n_trials": count,
                "growth_from": low / whole_m,
                "growth_to": high / whole_m,
                "misfit_before_m": float(np.nanmean(before)),
                "misfit_after_m": float(np.nanmean(after)) if np.isfinite(after).any() else math.nan,
                "scatter_m": spread / math.sqrt(count),
            }
        )
    return rows


def _mean_misfits(members: pd.DataFrame, along: str, low: float, high: float) -> dict[str, np.ndarray]:
    """Return the mean misfit of each trial, by model, where `low <= along < high`; NaN for a trial without points."""
    chosen = members[(members["time_s"] >= 0) & (members[along] >= low) & (members[along] < high)]
    means: dict[str, list[float]] = {"model_before_m": [], "model_after_m": []}
    for trial in dict.fromkeys(members["trial"]):
        part = chosen[chosen["trial"] == trial]
        for model, values in means.items():
            misfit = (part["lead_position_m"] - part[model]).to_numpy(dtype=float)
            misfit = misfit[np.isfinite(misfit)]
            values.append(float(misfit.mean()) if misfit.size else math.nan)
    return {model: np.array(values) for model, values in means.items()}


def round_heading(index: int, rounds: Sequence[Round]) -> str:
    """Return the heading of a round of the diagnosis, as a question."""
    if index == 0:
        return "Which effect is missing from the initial model?"
    added = [name for name in rounds[index].model if name not in rounds[0].model]
    return f"Which is missing with {listed_names(added)} added?"


def ranking_table(ranked: Round) -> pd.DataFrame:
    """Return the ranking of a round as a table; Δχ² of candidates that are not testable is NaN."""
    import pandas as pd

    columns = ["effect", "kind", "status", "delta_chi2", "sigma", "in_answer_set", "plausible", "size", "reason"]
    rows = [
        (c.effect, c.kind, c.status, c.delta_chi2, c.sigma, c.in_answer_set, c.plausible, estimates_text(c), c.reason)
        for c in ranked.ranking
    ]
    return pd.DataFrame(rows, columns=columns)


def cosines_by_rank(ranked: Round) -> tuple[list[str], list[list[float]]]:
    """Return the cosines of a round, ordered by rank, with the answer set first. Returns names, matrix."""
    names, matrix = ranked.cosine_names, ranked.cosines
    ranks = {row.effect: (not row.in_answer_set, i) for i, row in enumerate(ranked.ranking)}
    order = sorted(range(len(matrix)), key=lambda i: ranks.get(names[i], (True, len(ranked.ranking))))
    return [names[i] for i in order], [[matrix[i][j] for j in order] for i in order]


def _cosine_cells(names: Sequence[str], matrix: Sequence[Sequence[float]]) -> pd.DataFrame:
    """Return the matrix of cosines as a table with one row per pair."""
    import pandas as pd

    rows = [(names[i], names[j], matrix[i][j]) for i in range(len(matrix)) for j in range(i)]
    return pd.DataFrame(rows, columns=["effect", "other", "cosine"])


log = logging.getLogger(__name__)

Report = Callable[[str], None]
PREDICTION_COLUMNS = ("time_s", "lead_position_m", "model_before_m", "model_after_m")


def _quiet(_: str) -> None:
    pass


def diagnose_results(
    experiment: Experiment, folder: Path, report: Report = _quiet, settings: RunSettings | None = None
) -> dict[str, Any]:
    """Diagnose the trials of a results folder; write `diagnosis.json`, `ladder.csv` and the folder `diagnosis`. Returns
    `diagnosis.json` as written; `refused` is None, or the reason why there is no verdict.
    """
    results = Results(folder)
    pairs, _ = measured_trials(experiment, results)
    try:
        diagnosis = with_contradictions(diagnose_pairs(experiment, pairs, report), results, pairs)
    except Exception as error:
        return _write_refusal(results, experiment, _reason(error))
    log.info("%s: %s", diagnosis.verdict, diagnosis.explanation)
    content = write_diagnosis(results, diagnosis)
    report("fitting the damping law under every model")
    _write_laws(results, diagnosis, pairs, settings)
    return content


def diagnose_pairs(experiment: Experiment, pairs: Sequence[Any], report: Report = _quiet) -> Diagnosis:
    """Diagnose trials with the model, candidates, user effects and limits that the experiment states."""
    from vinetrack.diagnosis.diagnose import diagnose

    return diagnose(experiment, tracks={trial.name: track for trial, track in pairs}, report=report)


def with_contradictions(diagnosis: Diagnosis, results: Results, pairs: Sequence[tuple[Trial, Track]]) -> Diagnosis:
    """Add contradictions between measurements and sheet to a diagnosis: a wrong scale or unit can look like physics."""
    contradictions = sheet_contradictions(results, pairs)
    if not contradictions:
        return diagnosis
    return replace(
        diagnosis,
        explanation=f"{diagnosis.explanation} {contradicted_in_words(tuple(contradictions))}",
        contradicted_columns=tuple(contradictions),
        notes=(*diagnosis.notes, *contradictions.values()),
    )


def sheet_contradictions(results: Results, pairs: Sequence[tuple[Trial, Track]]) -> dict[str, str]:
    """Return a sentence for each column of the sheet that recordings or speeds contradict. Returns by name of the
    column.
    """
    from vinetrack.planning.predictive_inputs import pressure_problems
    from vinetrack.tracks.frame_timing import mean_speed

    noted: dict[str, list[tuple[str, str]]] = {}
    for trial, _ in pairs:
        for entry in read_json(results.analysed(trial.name)).get("contradictions", []):
            noted.setdefault(entry["column"], []).append((trial.name, entry["reason"]))
    sentences = {
        column: f"{of_trial[0][0]}: {of_trial[0][1]}"
        + (f" (and {len(of_trial) - 1} more trial{'s' if len(of_trial) > 2 else ''})" if len(of_trial) > 1 else "")
        for column, of_trial in noted.items()
    }
    speeds = [(trial, mean_speed(track)) for trial, track in pairs]
    return sentences | {problem.column: problem.reason for problem in pressure_problems(speeds)}


def _reason(error: Exception) -> str:
    """Return the reason why there is no verdict; the traceback of an unexpected exception goes to the log."""
    if isinstance(error, model_errors()):
        return str(error)
    log.exception("no diagnosis could be made")
    return INTERNAL_ERROR


def _write_refusal(results: Results, experiment: Experiment, reason: str) -> dict[str, Any]:
    from vinetrack.diagnosis.ladder import LADDER_COLUMNS
    from vinetrack.diagnosis.result import Diagnosis

    explanation = f"No diagnosis could be made: {reason}"
    refusal = Diagnosis(rounds=(), effects=(), explanation=explanation, refused=reason)
    content = {**refusal.to_json(), "model": list(experiment.settings.model)}
    _emptied_folder(results)
    write_csv(results.ladder, empty_table(LADDER_COLUMNS))
    write_json(results.diagnosis, content)
    log.info("%s", content["explanation"])
    return content


def _emptied_folder(results: Results) -> Path:
    folder = results.folder / "diagnosis"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    return folder


def write_diagnosis(results: Results, diagnosis: Diagnosis) -> dict[str, Any]:
    """Write `diagnosis.json`, `ladder.csv` and the folder `diagnosis`. Returns `diagnosis.json` as written."""
    from vinetrack.diagnosis.ladder import LADDER_COLUMNS, MOVED_COLUMNS, moved

    folder = _emptied_folder(results)
    for name, table in _tables_of(diagnosis).items():
        write_csv(folder / name, table)
    has_added = len(diagnosis.fits) > 1
    parameter_changes = moved(diagnosis.fits, ("", *diagnosis.effects)) if has_added else empty_table(MOVED_COLUMNS)
    write_csv(folder / "moved.csv", parameter_changes)
    if has_added:
        from vinetrack.inference.fit_summary import summary_of

        write_json(results.final_fit, summary_of(diagnosis.fits[-1]).to_json())
    for name, table in predictions(diagnosis.fits[0], diagnosis.fits[-1]).items():
        path = results.predictions(name)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_csv(path, table)
    write_csv(results.ladder, empty_table(LADDER_COLUMNS) if diagnosis.ladder is None else diagnosis.ladder)
    content = diagnosis.to_json()
    write_json(results.diagnosis, content)
    return content


def _write_laws(
    results: Results, diagnosis: Diagnosis, pairs: Sequence[tuple[Trial, Track]], settings: RunSettings | None
) -> None:
    """Refit the damping law with the pressure predicted by each model of the ladder, to show how n and B change."""
    from vinetrack.kinematics.summary import LAW_COLUMNS, law_table, look_at_motions, redo_damping

    path = results.folder / "diagnosis" / "damping_laws.csv"
    laws: dict[str, Any] = {}
    if len(diagnosis.fits) > 1:
        motions = look_at_motions(pairs, settings)
        for fit in diagnosis.fits:
            try:
                laws["+".join(fit.model.names)] = redo_damping(fit.model, motions, settings).laws
            except ValueError as error:
                log.info("no damping law with %s: %s", " + ".join(fit.model.names), error)
    write_csv(path, law_table(laws) if laws else empty_table(LAW_COLUMNS))


def _tables_of(diagnosis: Diagnosis) -> dict[str, pd.DataFrame]:
    """Return the tables of the initial model's misfit and of the missing force, by file name."""
    from vinetrack.diagnosis.drift import drift_groups

    tables: dict[str, pd.DataFrame] = {}
    failure: Failure | None = diagnosis.failure
    if failure is not None:
        tables |= {
            "conditions.csv": failure.by_condition,
            "along_time.csv": failure.along_time,
            "along_position.csv": failure.along_position,
            "along_speed.csv": failure.along_speed,
            "drift_groups.csv": drift_groups(failure.drift, diagnosis.fits[-1] if len(diagnosis.fits) > 1 else None),
        }
    if diagnosis.force_table is not None:
        tables["missing_force.csv"] = diagnosis.force_table
    if diagnosis.learned_table is not None:
        tables["learned_force.csv"] = diagnosis.learned_table
    return tables


def predictions(before: Fit, after: Fit) -> dict[str, pd.DataFrame]:
    """Predict every trial with the initial and the final model. As in `comparison.csv` and the ladder, only release and
    origin are fitted per trial. `model_after_m` is NaN if no effect was added. Returns by name of trial, columns
    `PREDICTION_COLUMNS`: s and m.
    """
    import pandas as pd

    from vinetrack.diagnosis.ladder import in_sample

    first = in_sample(before).trials
    last = in_sample(after).trials if after is not before else first
    tables = {}
    for under_first, under_last in zip(first, last, strict=True):
        later = under_last.predicted_position_m if after is not before else np.full(under_first.time_s.size, np.nan)
        columns = (under_first.time_s, under_first.lead_position_m, under_first.predicted_position_m, later)
        tables[under_first.name] = pd.DataFrame(dict(zip(PREDICTION_COLUMNS, columns, strict=True)))
    return tables


def add_effect(experiment: Experiment, folder: Path, name: str, report: Report = _quiet) -> list[str]:
    """Add an effect to the model and refit; the errors are appended to `ladder.csv`."""
    import pandas as pd

    from vinetrack.diagnosis.ladder import LADDER_COLUMNS, moved
    from vinetrack.diagnosis.propose import add
    from vinetrack.narrative.diagnosis_text import added_in_words

    results = Results(folder)
    pairs, _ = measured_trials(experiment, results)
    before, after, table = add(experiment, {trial.name: track for trial, track in pairs}, name, report)
    history = read_result(results.ladder) if results.ladder.exists() else empty_table(LADDER_COLUMNS)
    rows = table if not len(history) else table.iloc[1:]
    settled = settled_rows(history)
    recorded = set(zip(settled["model"], settled["added"].fillna(""), strict=True))
    new = rows[[(model, added) not in recorded for model, added in zip(rows["model"], rows["added"], strict=True)]]
    if len(new):
        write_csv(results.ladder, pd.concat([history, new], ignore_index=True) if len(history) else new)
    return added_in_words(before, after, table, moved((before, after), ("", name)))


def diagnosis_lines(folder: Path) -> list[str]:
    """Return the verdict of a results folder in one line, then its reasons, one sentence per line."""
    diagnosis = read_diagnosis(Results(folder))
    if diagnosis is None:
        raise ResultsError(f"{folder} has no diagnosis: run snakemake, or vinetrack diagnose {folder}")
    if not diagnosis.verdict:
        return [diagnosis.explanation]
    power = power_brief(diagnosis.power) if diagnosis.power is not None else ""
    columns = diagnosis.contradicted_columns
    warning = f" {contradicted_in_words(columns)}" if columns else ""
    sizes = [fact.answer for fact in summary_facts(diagnosis, None) if fact.code in ("significance", "size")]
    headline = verdict_line(diagnosis) + (f" ({'; '.join(sizes)})" if sizes else "")
    return [
        f"{headline}.{warning}" if columns else headline,
        *(f"  {line}" for line in sentences_of(diagnosis.explanation.removesuffix(warning))),
        *([f"{power[0].upper()}{power[1:]}"] if power and power not in headline else []),
        *_damping_line(diagnosis),
        *(f"! {note}" for note in diagnosis.notes),
        *filter(None, [to_go_on(diagnosis)]),
    ]


def _damping_line(diagnosis: Diagnosis) -> list[str]:
    """Return the damping law of the final model, F = B·ẋⁿ, as a line; empty if that model has none."""
    numbers = [number for number in diagnosis.parameters if number.key in ("eversion_damping.B", "eversion_damping.n")]
    if not numbers:
        return []
    parts = [
        f"{number.symbol}{f' ({number.vine})' if number.vine else ''} = {with_error(number.value, number.sigma)}"
        f"{f' {number.unit}' if number.unit != '1' else ''}"
        for number in sorted(numbers, key=lambda number: number.key != "eversion_damping.n")
    ]
    with_effects = f" with {' + '.join(diagnosis.effects)} in the model" if diagnosis.effects else ""
    return [f"F = B·ẋⁿ{with_effects}: {', '.join(parts)}; ± is one standard error"]
