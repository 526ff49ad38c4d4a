"""Every figure of a whole experiment: a drawing function with the decorator `figure`, which says all about it.

The decorator gives name, section of the report, title and data to download; the docstring of the function is the
caption, and its parameters are the names of the tables that it shows. `draw` takes them from any object that has them
as attributes. A function without anything to show returns None, and the figure does not exist.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from vinetrack.core.units import pressure_text
from vinetrack.figures.style import look
from vinetrack.results.diagnosis_tables import DiagnosisTables, read_diagnosis_tables
from vinetrack.results.folder_layout import Results, read_diagnosis, read_json, read_result

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from vinetrack.core.records import Trial

_Drawing = TypeVar("_Drawing", bound="Callable[..., Figure | None]")


@dataclass(frozen=True)
class RegisteredFigure:
    """One figure of a results folder. `data` is a file of the folder, or the name of a table (no dot), to download
    beside it.
    """

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


DIAGNOSIS_SECTIONS = ("verdict", "where", "candidates", "drift")
SECTIONS = ("damping", "model", *DIAGNOSIS_SECTIONS, "paper")

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
    from vinetrack.figures import damping_figures, diagnosis_figures, motion_figures  # noqa: F401 - each registers its own

    return dict(_registered)


def figures_of(*sections: str) -> dict[str, RegisteredFigure]:
    """Return the figures of some sections of the page by name."""
    return {name: one for section in sections for name, one in all_figures().items() if one.section == section}


def campaign_figures() -> dict[str, RegisteredFigure]:
    """Return the figures of a whole experiment by name, those of its diagnosis last."""
    return figures_of("damping", "model", *DIAGNOSIS_SECTIONS)


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
        import pandas as pd

        parts = [table.assign(condition=name) for name, table in self.trajectories.items()]
        whole = pd.concat(parts, ignore_index=True) if parts else pd.DataFrame()
        return whole.iloc[:: -(-len(whole) // 1000) or 1]

    @cached_property
    def diagnosed(self) -> DiagnosisTables | None:
        """Tables of the diagnosis; None if there is none."""
        return read_diagnosis_tables(self.results, self.trials)


def describe_conditions(trials: pd.DataFrame, known: tuple[Trial, ...]) -> pd.DataFrame:
    """Add pressure and a short label of the condition to `trials.csv`."""
    by_name = {trial.name: trial for trial in known}
    labels, pressures = [], []
    for name, condition in zip(trials["trial"], trials["condition"], strict=True):
        trial = by_name.get(str(name))
        labels.append(condition_label(trial) if trial else str(condition) or "not readable")
        pressures.append(1e-3 * trial.pressure_Pa if trial else float("nan"))
    return trials.assign(condition_label=labels, pressure_kPa=pressures)


def condition_label(trial: Trial) -> str:
    """Return a short label of a trial's condition: diameter, pressure and payload."""
    return ", ".join([f"{1e3 * trial.diameter_m:g} mm", *features(trial)[1:]])


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
