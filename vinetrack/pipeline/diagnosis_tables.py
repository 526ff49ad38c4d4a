"""Tables of a stored diagnosis for figures and report.

Any part may be missing: there may be no diagnosis, it may have failed, or it may have added no effect.
"""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.figures.style import rows as iter_rows
from vinetrack.narrative.verdict_summary import estimates_text, listed_names
from vinetrack.results.folder_layout import Results, read_result
from vinetrack.results.stored_diagnosis import read_diagnosis as stored_diagnosis

if TYPE_CHECKING:
    import pandas as pd

    from vinetrack.diagnosis.result import Diagnosis, Round
    from vinetrack.effects import Effect
    from vinetrack.experiment.folder import Experiment
    from vinetrack.report.diagnosis_section import DiagnosisResult

CURVE_COLUMNS = ("trial", "condition", "time_s", "lead_position_m", "model_before_m", "model_after_m")


@dataclass(frozen=True)
class DiagnosisTables:
    """Data of the figures; a table is empty if there is nothing to draw. `rounds` are (heading, ranking) pairs, `worst`
    is the condition that `before_after` shows, `cosines` are names and matrix, `added` the added effects in words,
    `labels` the labels of conditions by name.
    """

    ladder: pd.DataFrame
    trials: pd.DataFrame
    before_after: pd.DataFrame
    where: pd.DataFrame
    cells: pd.DataFrame
    drift: pd.DataFrame
    force: pd.DataFrame
    rounds: Sequence[tuple[str, pd.DataFrame]] = ()
    cosines: tuple[Sequence[str], Sequence[Sequence[float]]] = ((), ())
    worst: str = ""
    added: str = ""
    labels: Mapping[str, str] = field(default_factory=dict)
    learned: pd.DataFrame | None = None


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
        cells=_cosine_cells(names, matrix),
        drift=drifting,
        force=force,
        rounds=[
            (round_heading(i, diagnosis.rounds), ranking_table(ranked)) for i, ranked in enumerate(diagnosis.rounds)
        ],
        cosines=(names, matrix),
        worst=worst,
        added=listed_names(diagnosis.effects),
        labels=labels,
        learned=learned,
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


def figure_tables(diagnosed: DiagnosisTables | None) -> dict[str, pd.DataFrame]:
    """Return the data table of each figure with content, by name of the figure."""
    import pandas as pd

    from vinetrack.figures.registry import DIAGNOSIS_FIGURES

    if diagnosed is None:
        return {}
    parts = [table.assign(round=i + 1) for i, (_, table) in enumerate(diagnosed.rounds) if len(table)]
    tables = {
        "ladder": diagnosed.ladder,
        "before_after": diagnosed.before_after,
        "where": diagnosed.where,
        "missing_force": diagnosed.force,
        "learned_force": pd.DataFrame() if diagnosed.learned is None else diagnosed.learned,
        "candidates": pd.concat(parts, ignore_index=True) if parts else diagnosed.ladder.iloc[:0],
        "cosines": diagnosed.cells,
        "drift": diagnosed.drift,
    }
    if unmatched := sorted(set(tables) ^ set(DIAGNOSIS_FIGURES)):
        raise RuntimeError(f"{', '.join(unmatched)}: not both in figures.registry and in figure_tables")
    return {name: table for name, table in tables.items() if len(table)}


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
    from vinetrack.figures.ladder_figures import rms_m

    if not len(trials):
        return ""
    errors_m = {name: rms_m(part, "model_before_m") for name, part in trials.groupby("condition", sort=False)}
    finite_m = {name: value for name, value in errors_m.items() if math.isfinite(value)}
    return str(max(finite_m, key=finite_m.__getitem__)) if finite_m else ""


def _where_table(trials: pd.DataFrame, labels: Mapping[str, str], located: pd.DataFrame) -> pd.DataFrame:
    """Return the mean misfit of every condition in sections of its growth, for `misfit_figures.draw_where`. The misfit
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
