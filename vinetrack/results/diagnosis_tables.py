"""Tables of a stored diagnosis for figures and report.

Any part may be missing: there may be no diagnosis, it may have failed, or it may have added no effect.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.diagnosis.result import Diagnosis
from vinetrack.narrative.verdict_text import listed_names
from vinetrack.results.folder_layout import Results, read_diagnosis, read_result, table_of

if TYPE_CHECKING:
    import pandas as pd

CURVE_COLUMNS = ("trial", "condition", "time_s", "lead_position_m", "model_before_m", "model_after_m")


class DiagnosisTables:
    """Data of the figures of a diagnosis; a table is empty if there is nothing to draw, all without one. `trials` are
    the positions that `predicted_trials` returns, `tables` the files of the folder `diagnosis` by name. `rounds` are
    (heading, ranking) pairs, `worst` is the label of the condition that `before_after` shows, `added` the added effects
    in words.
    """

    def __init__(
        self, diagnosis: Diagnosis | None = None, conditions: pd.DataFrame | None = None,
        trials: pd.DataFrame | None = None, tables: Mapping[str, pd.DataFrame] | None = None,
    ) -> None:  # fmt: skip
        found, none, rounds = tables or {}, table_of(()), diagnosis.rounds if diagnosis else ()
        named = table_of(("condition", "condition_label")) if conditions is None else conditions
        labels = dict(zip(named["condition"].astype(str), named["condition_label"].astype(str), strict=True))
        self.trials = table_of(CURVE_COLUMNS) if trials is None else trials
        worst = worst_condition(self.trials)
        self.worst = labels.get(worst, worst)
        self.before_after = self.trials[self.trials["condition"] == worst] if worst else self.trials.iloc[:0]
        self.where = _where_table(self.trials, labels, found.get("along_position.csv", none))
        self.ladder = none if (ladder := diagnosis and diagnosis.ladder) is None else found.get("steps.csv", ladder)
        self.refuted = bool(diagnosis and diagnosis.refutes())
        self.added = listed_names(diagnosis.effects if diagnosis else ())
        self.pressure_unit = diagnosis.pressure_unit if diagnosis else "kPa"
        self.drift = found.get("drift_groups.csv", none)
        self.learned_force = found.get("learned_force.csv", none)
        self.ranking = diagnosis.candidates() if diagnosis else none
        self.rounds: list[tuple[str, pd.DataFrame]] = []
        for i, ranked in enumerate(rounds):
            more = [name for name in ranked.model if name not in rounds[0].model]
            heading = f"is missing with {listed_names(more)} added" if i else "effect is missing from the initial model"
            self.rounds.append((f"Which {heading}?", self.ranking[self.ranking["round"] == i + 1]))


def read_diagnosis_tables(results: Results, conditions: pd.DataFrame) -> DiagnosisTables | None:
    """Read the tables of a results folder; None if it has no diagnosis, or that failed."""
    diagnosis = read_diagnosis(results)
    if diagnosis is None or not diagnosis.verdict:
        return None
    tables = {path.name: read_result(path) for path in (results.folder / "diagnosis").glob("*.csv")}
    return DiagnosisTables(diagnosis, conditions, predicted_trials(results, conditions), tables)


def predicted_trials(results: Results, conditions: pd.DataFrame) -> pd.DataFrame:
    """Return measured and predicted positions of all trials, from release and origin as in `comparison`."""
    import pandas as pd

    paths = {name: results.trajectories(name) for name in dict.fromkeys(conditions["condition"]) if name}
    compared = {name: read_result(path) for name, path in paths.items() if path.exists()}
    parts = []
    for trial, condition in zip(conditions["trial"], conditions["condition"], strict=True):
        path = results.predictions(trial)
        if condition not in compared or not path.exists():
            continue
        table, course = read_result(path), compared[condition][compared[condition]["trial"] == trial]
        after_m = table["model_after_m"] - (table["lead_position_m"] - course["lead_position_m"].to_numpy())
        models = {"model_before_m": course["model_position_m"], "model_after_m": after_m.to_numpy()}
        parts.append(course.assign(condition=condition, **models)[list(CURVE_COLUMNS)])
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=list(CURVE_COLUMNS))


def rms_m(trials: pd.DataFrame, model: str) -> float:
    """Root mean square error of a model after release, m, every trial with one weight; NaN without prediction."""
    squares = [
        float(np.mean((part["lead_position_m"] - part[model]) ** 2))
        for _, part in trials[trials["time_s"] >= 0].groupby("trial", sort=False)
    ]
    return math.sqrt(float(np.mean(squares))) if squares else math.nan


def worst_condition(trials: pd.DataFrame) -> str:
    """Return the condition with the largest RMS error of the initial model; blank without predictions."""
    import pandas as pd

    parts = trials.groupby("condition", sort=False)
    errors_m = pd.Series({str(name): rms_m(part, "model_before_m") for name, part in parts}, dtype=float).dropna()
    return str(errors_m.idxmax()) if len(errors_m) else ""


def _where_table(trials: pd.DataFrame, labels: Mapping[str, str], located: pd.DataFrame) -> pd.DataFrame:
    """Return the mean misfit of every condition in the sections of its growth that the diagnosis looked at, with its
    error as found there, for the figure `where`.
    """
    import pandas as pd

    if located.empty:
        return pd.DataFrame()
    counts = trials[trials["time_s"] >= 0].groupby("condition")["trial"].nunique()
    whole_m = located.groupby("vine")["to_m"].transform("max")
    parts = {"growth_from": located["from_m"] / whole_m, "growth_to": located["to_m"] / whole_m}
    names: dict[str, Any] = {
        "condition_label": located["condition"].map(labels),
        "n_trials": located["condition"].map(counts),
    }
    table = located.assign(**names, **parts, misfit_m=located["mean_residual_m"], scatter_m=located["sigma_m"])
    columns = ["condition", *names, *parts, "misfit_m", "scatter_m"]
    place = {condition: i for i, condition in enumerate(labels)}
    return table.dropna(subset=list(names))[columns].sort_values("condition", key=lambda c: c.map(place), kind="stable")


def all_steps(results: Results, ladder: pd.DataFrame) -> pd.DataFrame:
    """Return the ladder below the steps by which earlier runs came to its first model: those of their ladder above it,
    if its error there is the same, so that it is of the same trials.
    """
    import pandas as pd

    former = next((read_result(path) for path in (results.kept_steps, results.ladder) if path.exists()), ladder[:0])
    known = zip(former["model"], former["rms_in_sample_m"].astype(float), strict=True)
    for k, (model, rms_m) in enumerate(known if len(ladder) else ()):
        if model == ladder["model"][0] and np.isclose(rms_m, ladder["rms_in_sample_m"][0], 1e-2, 0):
            return pd.concat([former[: k + 1], ladder[1:]], ignore_index=True)
    return ladder
