"""Every figure of a whole experiment: a drawing function with the decorator `figure`, which says all about it.

The decorator gives name, section of the report, title and data to download; the docstring of the function is the
caption, and its parameters are the names of the tables that it shows. `draw` takes them from any object that has them
as attributes. A function without anything to show returns None, and the figure does not exist.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import pandas as pd

from vinetrack.core.units import pressure_text
from vinetrack.figures.style import look
from vinetrack.narrative.verdict_text import listed_names
from vinetrack.results import Results, read_diagnosis, read_json, read_result, table_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from vinetrack.core.records import Trial
    from vinetrack.diagnosis.result import Diagnosis

_Drawing = TypeVar("_Drawing", bound="Callable[..., Figure | None]")


@dataclass(frozen=True)
class RegisteredFigure:
    """A figure of a results folder; `data`, to download beside it, is a file of it or the name of a table (no dot)."""

    name: str
    section: str
    title: str
    caption: str
    data: str
    drawing: Callable[..., Figure | None]

    @property
    def reads(self) -> tuple[str, ...]:
        """Names of the tables that it shows."""
        return tuple(inspect.signature(self.drawing).parameters)


SECTIONS = ("damping", "model", "verdict", "where", "candidates", "drift", "paper")

_registered: dict[str, RegisteredFigure] = {}


def figure(name: str, section: str, title: str, *, data: str = "") -> Callable[[_Drawing], _Drawing]:
    """Register the decorated function as the drawing of a figure, and draw it in the common style."""

    def register(drawing: _Drawing) -> _Drawing:
        assert section in SECTIONS, section
        styled = look()(drawing)
        caption = " ".join((drawing.__doc__ or "").split())
        _registered[name] = RegisteredFigure(name, section, title, caption, data, styled)
        return styled

    return register


@cache
def all_figures() -> dict[str, RegisteredFigure]:
    """Return all figures by name."""
    from vinetrack.figures import damping_figures, model_figures, motion_figures  # noqa: F401 - each registers its own

    return dict(_registered)


def figures_of(*sections: str) -> dict[str, RegisteredFigure]:
    """Return the figures of some sections of the page by name; without any, of all that an experiment has."""
    chosen = sections or SECTIONS[:-1]
    return {name: one for section in chosen for name, one in all_figures().items() if one.section == section}


def draw(name: str, tables: Any) -> Figure | None:
    """Draw a figure from the attributes of `tables`; None if there is nothing to show."""
    entry = all_figures()[name]
    return entry.drawing(*(getattr(tables, table) for table in entry.reads))


# ------------------------------------------------------------------------------
# The tables of a results folder, as figures name them.


class FigureTables:
    """The tables of a results folder by the names that figures give them; each is read when a figure first needs it.
    Those of the diagnosis are empty if there is none; `damping`, `scaling` and `paper…` are the files of that name.
    """

    def __init__(self, folder: Path, known: tuple[Trial, ...]) -> None:
        self.results = Results(folder)
        self.known = known

    def __getattr__(self, name: str) -> Any:
        if name in ("damping", "scaling"):
            return read_json(self.results.folder / f"{name}.json")
        if name.startswith("paper"):
            return read_result(self.results.folder / f"{name}.csv")
        return getattr(self.diagnosed or DiagnosisTables(), name)

    @cached_property
    def points(self) -> pd.DataFrame:
        """Points of the damping law; none counts as used if there is no fit."""
        from vinetrack.narrative.diagnosis_text import METHOD_NAMES

        points = read_result(self.results.points)
        is_fitted = any(self.damping[method]["vines"] for method in METHOD_NAMES)
        return points.assign(used=points["used"] & is_fitted)

    @property
    def pressure_unit(self) -> str:
        """The unit of pressures in the sheet."""
        return self.known[0].pressure_unit if self.known else "kPa"

    @cached_property
    def trials(self) -> pd.DataFrame:
        """`trials.csv` with pressure and label of the condition."""
        return describe_conditions(read_result(self.results.trials), self.known)

    @cached_property
    def comparison(self) -> pd.DataFrame:
        """`comparison.csv` with vines and labels; a refuted model says so in its name."""
        compared = label_conditions(read_result(self.results.comparison), self.trials)
        diagnosis = read_diagnosis(self.results)
        if diagnosis is not None and diagnosis.refutes():
            compared = compared.assign(model="refuted initial model: " + compared["model"])
        return compared

    @cached_property
    def trajectories(self) -> dict[str, pd.DataFrame]:
        """Measurement and models by condition, with `model_after_m` of the final model if effects were added."""
        tables = {name: read_result(self.results.trajectories(name)) for name in self.comparison["condition"]}
        if self.diagnosed is None or not self.diagnosed.added:
            return tables
        after = self.diagnosed.trials[["trial", "time_s", "model_after_m"]]
        return {name: table.merge(after, "left", ["trial", "time_s"]) for name, table in tables.items()}

    @property
    def curves(self) -> pd.DataFrame:
        """Measured and modelled growth of all trials, at most 1000 rows (chosen) at an even stride."""
        parts = [table.assign(condition=name) for name, table in self.trajectories.items()]
        whole = pd.concat(parts, ignore_index=True) if parts else pd.DataFrame()
        return whole.iloc[:: -(-len(whole) // 1000) or 1]

    @cached_property
    def diagnosed(self) -> DiagnosisTables | None:
        """Tables of the diagnosis; None if there is none, or that failed."""
        diagnosis = read_diagnosis(self.results)
        if diagnosis is None or not diagnosis.verdict:
            return None
        tables = {path.name: read_result(path) for path in (self.results.folder / "diagnosis").glob("*.csv")}
        return DiagnosisTables(diagnosis, self.trials, predicted_trials(self.results, self.trials), tables)


def describe_conditions(trials: pd.DataFrame, known: tuple[Trial, ...]) -> pd.DataFrame:
    """Add pressure and a short label of the condition to `trials.csv`."""
    by_name, label_of = {trial.name: trial for trial in known}, condition_labels({t.condition: t for t in known})
    labels, pressures = [], []
    for name, condition in zip(trials["trial"], trials["condition"], strict=True):
        trial = by_name.get(str(name))
        labels.append(label_of[trial.condition] if trial else str(condition) or "not readable")
        pressures.append(1e-3 * trial.pressure_Pa if trial else float("nan"))
    return trials.assign(condition_label=labels, pressure_kPa=pressures)


def condition_labels(examples: Mapping[str, Trial]) -> dict[str, str]:
    """Labels of conditions, by name with a trial of each: sizes, pressure, payload, and what else tells them apart."""
    labels = {name: ", ".join([f"{1e3 * t.diameter_m:g} mm", *features(t)[1:]]) for name, t in examples.items()}
    same = {label: [name.split("_") for name in labels if labels[name] == label] for label in labels.values()}
    return {
        name: ", ".join([label, *(part for part in name.split("_") if any(part not in parts for parts in same[label]))])
        for name, label in labels.items()
    }


def label_conditions(comparison: pd.DataFrame, described: pd.DataFrame) -> pd.DataFrame:
    """Add vine and label of each condition to `comparison.csv`, sorted by vine and then pressure."""
    first = described.drop_duplicates("condition")[["condition", "vine", "condition_label", "pressure_kPa"]]
    place = {vine: i for i, vine in enumerate(dict.fromkeys(described["vine"]))}
    table = comparison.merge(first, on="condition")
    table = table.assign(place=table["vine"].map(place))
    return table.sort_values(["place", "pressure_kPa"], kind="stable", ignore_index=True)


def features(trial: Trial) -> list[str]:
    """Return sizes, pressure and payload of a trial in words."""
    others = (f"{1e6 * trial.thickness_m:.4g} µm", f"{1e3 * trial.length_m:.4g} mm")
    sizes = " × ".join([f"{1e3 * trial.diameter_m:g} mm", *(size for size in others if not size.startswith("nan"))])
    payload = [f"{1e3 * trial.payload_kg:.3g} g"] if trial.payload_kg else []
    return [sizes, pressure_text(trial.pressure_Pa, trial.pressure_unit), *payload]


# ------------------------------------------------------------------------------
# The tables of a stored diagnosis. Any part may be missing: it may have failed, or added no effect.

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


def predicted_trials(results: Results, conditions: pd.DataFrame) -> pd.DataFrame:
    """Return measured and predicted positions of all trials, from release and origin as in `comparison`."""
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
    parts = trials.groupby("condition", sort=False)
    errors_m = pd.Series({str(name): rms_m(part, "model_before_m") for name, part in parts}, dtype=float).dropna()
    return str(errors_m.idxmax()) if len(errors_m) else ""


def _where_table(trials: pd.DataFrame, labels: Mapping[str, str], located: pd.DataFrame) -> pd.DataFrame:
    """The mean misfit of every condition in the sections of its growth, with its error, for the figure `where`."""
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
