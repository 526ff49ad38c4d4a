"""What the diagnosis of a results folder left there, as tidy tables for pictures and page.

Every part may be missing: a folder without a diagnosis, one that was refused, a verdict that added nothing.
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

N_SECTIONS = 8
"""Parts of the growth in which misfits are averaged where the diagnosis did not say. Chosen: as many as a page shows
side by side. At half a misfit at the start alone is averaged away, at twice each mean rests on few frames."""

CURVE_COLUMNS = ("trial", "condition", "time_s", "lead_position_m", "model_before_m", "model_after_m")


@dataclass(frozen=True)
class DiagnosisTables:
    """Tables behind the pictures, each empty where there is nothing to draw.

    `rounds` are (question, ranking) pairs, `worst` names the condition that `before_after` shows, `cosines` are names
    and matrix, `added` the effects that were added, in words.
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
    """Tables of a results folder; None where it has not been diagnosed, or that was refused.

    Parameters
    ----------
    results : results folder.
    conditions : DataFrame
        `trial, vine, condition, condition_label` of every trial, vines and pressures in their order.

    Returns
    -------
    DiagnosisTables or None
    """
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
    """Put the tables behind the pictures together.

    Parameters
    ----------
    diagnosis : with a verdict.
    conditions : DataFrame
        As of `read_diagnosis_tables`.
    trials : DataFrame
        Columns `CURVE_COLUMNS`.
    located, drifting, force, learned : DataFrame
        Misfit along the growth, values of groups of trials, the missing force, and the same as learned inside the fit;
        empty where there is none.

    Returns
    -------
    DiagnosisTables
    """
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
    """What the page says of the diagnosis; None where there is none.

    Parameters
    ----------
    results : results folder.
    experiment : names the files of the user's effects.

    Returns
    -------
    DiagnosisResult or None
    """
    from vinetrack.report.diagnosis_section import DiagnosisResult

    diagnosis = stored_diagnosis(results)
    if diagnosis is None:
        return None
    paths = (results.diagnosed("moved.csv"), results.diagnosed("damping_laws.csv"))
    moved, laws = (table if len(table := _table(path)) else None for path in paths)
    named = [*diagnosis.effects, *diagnosis.answer_set]
    effects = _effects([*named, *(row.effect for ranked in diagnosis.rounds for row in ranked.ranking)], experiment)
    return DiagnosisResult(
        diagnosis,
        diagnosis.ladder,
        moved,
        laws,
        {name: effects[name].summary for name in named if name in effects},
        {f"{name}.{p.name}": (p.symbol, p.unit) for name, effect in effects.items() for p in effect.parameters},
    )


def _effects(names: Sequence[str], experiment: Experiment) -> dict[str, Effect]:
    """Effects by name; without those whose file has gone."""
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
    """The table behind each picture that has something in it, by name of the picture.

    Parameters
    ----------
    diagnosed : from `read_diagnosis_tables`.

    Returns
    -------
    dict of DataFrame
    """
    import pandas as pd

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
    return {name: table for name, table in tables.items() if len(table)}


def _table(path: Any) -> pd.DataFrame:
    import pandas as pd

    return read_result(path) if path.exists() else pd.DataFrame()


def predicted_trials(results: Results, conditions: pd.DataFrame) -> pd.DataFrame:
    """Every trial with predictions, columns `CURVE_COLUMNS`: time since release, positions from the origin.

    Parameters
    ----------
    results : results folder.
    conditions : DataFrame
        `trial` and `condition` of every trial.

    Returns
    -------
    DataFrame
    """
    import pandas as pd

    parts = []
    compared: dict[str, pd.DataFrame] = {}
    for trial, condition in zip(conditions["trial"], conditions["condition"], strict=True):
        path = results.predictions(trial)
        table = read_result(path) if path.exists() else None
        if table is None or not len(table):
            continue
        if condition not in compared:
            there = bool(condition) and results.trajectories(condition).exists()
            compared[condition] = read_result(results.trajectories(condition)) if there else pd.DataFrame()
        release_s, origin_m = _start(trial, table, compared[condition])
        positions = {name: table[name] - origin_m for name in CURVE_COLUMNS[3:]}
        time_s = table["time_s"] - release_s
        parts.append(pd.DataFrame({"trial": trial, "condition": condition, "time_s": time_s, **positions}))
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=list(CURVE_COLUMNS))


def _start(trial: str, table: pd.DataFrame, compared: pd.DataFrame) -> tuple[float, float]:
    """Release and origin of a trial: as the comparison has them, which begins with the same point; else as seen."""
    same = compared[compared["trial"] == trial] if len(compared) else compared
    time_s, position_m = float(table["time_s"].iloc[0]), float(table["lead_position_m"].iloc[0])
    if len(same) == len(table):
        return time_s - float(same["time_s"].iloc[0]), position_m - float(same["lead_position_m"].iloc[0])
    origin_m = float(np.nanmin(table["lead_position_m"]))
    return _first_moving_s(table, origin_m), origin_m


def _first_moving_s(table: pd.DataFrame, origin_m: float) -> float:
    growth = table["lead_position_m"].to_numpy(dtype=float) - origin_m
    return float(table["time_s"].iloc[int(np.argmax(growth > 0.01 * np.nanmax(growth)))])


def worst_condition(trials: pd.DataFrame) -> str:
    """The condition where the model that the user came with is farthest off; blank without predictions.

    Parameters
    ----------
    trials : DataFrame
        From `predicted_trials`.

    Returns
    -------
    str
    """
    from vinetrack.figures.ladder_figures import rms_m

    if not len(trials):
        return ""
    off = {name: rms_m(part, "model_before_m") for name, part in trials.groupby("condition", sort=False)}
    usable = {name: value for name, value in off.items() if math.isfinite(value)}
    return str(max(usable, key=usable.__getitem__)) if usable else ""


def _where_table(trials: pd.DataFrame, labels: Mapping[str, str], located: pd.DataFrame) -> pd.DataFrame:
    """Mean misfit of every condition in stretches of its growth, as `misfit_figures.draw_where` draws it.

    Where the diagnosis found the misfit of the first model itself, with its error, that is taken.
    """
    import pandas as pd

    rows: list[dict[str, Any]] = []
    known_rows = located[located["condition"] != ""] if len(located) else located
    for condition in labels:
        members = trials[trials["condition"] == condition]
        if not len(members):
            continue
        of_condition = known_rows[known_rows["condition"] == condition] if len(known_rows) else known_rows
        rows += [
            {"condition": condition, "condition_label": labels[condition], **row}
            for row in (
                _located_sections(of_condition, located, members) if len(of_condition) else _measured_sections(members)
            )
        ]
    return pd.DataFrame(rows)


def _located_sections(of_condition: pd.DataFrame, located: pd.DataFrame, members: pd.DataFrame) -> list[dict[str, Any]]:
    vine = str(of_condition["vine"].iloc[0])
    whole_m = float(located.loc[located["vine"] == vine, "to_m"].max())
    if not whole_m > 0:
        return []  # Nothing grew: there is no place along the growth.
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
    """Stretches of what was measured; chance is what trials differ by, less their own mean over the growth."""
    whole_m = float(members["lead_position_m"].max())
    if not whole_m > 0:
        return []
    edges = np.linspace(0.0, whole_m, N_SECTIONS + 1)
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
    """Mean misfit of each trial, by model, where `along` lies from `low` to `high`; NaN for one that never does."""
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
    """What a round asks, in words.

    Parameters
    ----------
    index : int
        Number of the round, from 0.
    rounds : of the diagnosis.

    Returns
    -------
    str
    """
    if index == 0:
        return "Which effect is missing from the initial model?"
    added = [name for name in rounds[index].model if name not in rounds[0].model]
    return f"Which is missing with {listed_names(added)} added?"


def ranking_table(ranked: Round) -> pd.DataFrame:
    """The ranking of a round as a table; Δχ² of those not testable is NaN.

    Parameters
    ----------
    ranked : one round of the diagnosis.

    Returns
    -------
    DataFrame
        A row a candidate.
    """
    import pandas as pd

    columns = ["effect", "kind", "status", "delta_chi2", "sigma", "in_answer_set", "plausible", "size", "reason"]
    rows = [
        (c.effect, c.kind, c.status, c.delta_chi2, c.sigma, c.in_answer_set, c.plausible, estimates_text(c), c.reason)
        for c in ranked.ranking
    ]
    return pd.DataFrame(rows, columns=columns)


def cosines_by_rank(ranked: Round) -> tuple[list[str], list[list[float]]]:
    """Names and matrix of the cosines of a round with the answer first, then as it ranks its candidates.

    Parameters
    ----------
    ranked : the first round of the diagnosis.

    Returns
    -------
    names : list of str
    matrix : list of lists of float
    """
    names, matrix = ranked.cosine_names, ranked.cosines
    places = {row.effect: (not row.in_answer_set, i) for i, row in enumerate(ranked.ranking)}
    order = sorted(range(len(matrix)), key=lambda i: places.get(names[i], (True, len(ranked.ranking))))
    return [names[i] for i in order], [[matrix[i][j] for j in order] for i in order]


def _cosine_cells(names: Sequence[str], matrix: Sequence[Sequence[float]]) -> pd.DataFrame:
    """The matrix of cosines as rows of pairs, each once."""
    import pandas as pd

    rows = [(names[i], names[j], matrix[i][j]) for i in range(len(matrix)) for j in range(i)]
    return pd.DataFrame(rows, columns=["effect", "other", "cosine"])
