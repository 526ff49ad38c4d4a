"""A results folder in memory: `vt.load("results/demo")`."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

from vinetrack.core.notebook import html_table, plot
from vinetrack.diagnosis.result import Diagnosis
from vinetrack.dynamics.model import Model, make_model
from vinetrack.inference.fit_summary import FitSummary
from vinetrack.results.folder_layout import Results, ResultsError, read_diagnosis, read_fit, read_json, read_result

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from vinetrack.experiment.folder import Experiment


class LoadedResults:
    """A results folder, whose files are read on first access. Tables are pandas DataFrames whose columns carry their
    units, as in the files (`docs/results.md`).
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._results = Results(folder)

    @property
    def name(self) -> str:
        """The experiment's name."""
        return self.folder.name

    @cached_property
    def provenance(self) -> Mapping[str, Any]:
        """Version, settings and the hash of every file read."""
        return read_json(self._results.provenance)

    @cached_property
    def experiment(self) -> Experiment:
        """The experiment that the results were made from; raises a ResultsError if it has moved."""
        from vinetrack.results.folder_layout import read_source_experiment

        return read_source_experiment(self.folder)

    @cached_property
    def trials(self) -> pd.DataFrame:
        """`trials.csv`: one row per trial of the sheet."""
        return read_result(self._results.trials)

    @cached_property
    def tracks(self) -> pd.DataFrame:
        """Positions of all trials, one row per frame: `trial, frame, time_s, edge_px, lead_position_m, …, flag`."""
        return self._concatenated(self._results.track)

    @cached_property
    def kinematics(self) -> pd.DataFrame:
        """Speeds of all trials, one row per usable point: `trial, time_s, lead_position_m, lead_velocity_m_s, …`."""
        return self._concatenated(self._results.kinematics)

    @cached_property
    def fit(self) -> FitSummary:
        """The fit of the model in use: `fit.json`."""
        return read_fit(self._results)

    @cached_property
    def diagnosis(self) -> Diagnosis | None:
        """The diagnosis of the model in use: `diagnosis.json`; None if there is none."""
        return read_diagnosis(self._results)

    @cached_property
    def damping(self) -> Mapping[str, Any]:
        """The damping law by both methods: `damping.json`."""
        return read_json(self._results.damping)

    @cached_property
    def scaling(self) -> Mapping[str, Any]:
        """Scaling of B, speed and efficiency with size: `scaling.json`."""
        return read_json(self._results.scaling)

    @cached_property
    def ladder(self) -> pd.DataFrame:
        """`ladder.csv`: errors of the initial model and of each later model."""
        return read_result(self._results.ladder)

    @cached_property
    def tables(self) -> Mapping[str, pd.DataFrame]:
        """All tables of the folder by file name without `.csv`; those of the diagnosis as `diagnosis/…`."""
        paths = [*sorted(self.folder.glob("*.csv")), *sorted((self.folder / "diagnosis").glob("*.csv"))]
        return {path.relative_to(self.folder).with_suffix("").as_posix(): read_result(path) for path in paths}

    @cached_property
    def initial_model(self) -> Model:
        """The model in use with its fitted values."""
        return self._model(self.fit.names, self.fit.fitted_values)

    @cached_property
    def final_model(self) -> Model:
        """The final model of the diagnosis with its fitted values; the initial one if no effect was added."""
        diagnosis = self.diagnosis
        if diagnosis is None or not diagnosis.effects:
            return self.initial_model
        values = FitSummary(diagnosis.final_model, diagnosis.parameters).fitted_values
        return self._model(diagnosis.final_model, values)

    def _model(self, names: tuple[str, ...], values: Mapping[str, Any]) -> Model:
        from vinetrack.effects import catalogue
        from vinetrack.interface.calls import named_model
        from vinetrack.interface.data_frames import TrialSource

        user_effects: Mapping[str, Any] = {}
        if not set(names) <= set(catalogue()):
            user_effects = named_model(TrialSource([], self.experiment)).user_effects
        model = make_model(names, user_effects)
        return model.with_values({key: value for key, value in values.items() if key in model.parameter_names})

    def _concatenated(self, path_of: Any) -> pd.DataFrame:
        paths = {name: path_of(name) for name in self.trials["trial"]}
        parts = [read_result(path).assign(trial=name) for name, path in paths.items() if path.exists()]
        if not parts:
            return pd.DataFrame(columns=["trial"])
        whole = pd.concat(parts, ignore_index=True)
        return whole[["trial", *(name for name in whole.columns if name != "trial")]]

    def plot(self, name: str = "", **options: Any) -> Figure:
        """Return a figure of the report."""
        return plot(self, name, **options)

    def __repr__(self) -> str:
        return f"Results({self.name}: {self._state()})"

    def _state(self) -> str:
        usable = int(self.trials["status"].isin(["ok", "warning"]).sum())
        diagnosis = self.diagnosis
        named = ", ".join(diagnosis.effects or diagnosis.answer_set) if diagnosis is not None else ""
        verdict = "not diagnosed" if diagnosis is None or not diagnosis.verdict else diagnosis.verdict
        return f"{usable} of {len(self.trials)} trials; {verdict}{f': {named}' if named else ''}"

    def _repr_html_(self) -> str:
        title = f"{self.name}: {self._state()}"
        if self.diagnosis is not None and self.diagnosis.verdict:
            return html_table((), (), title) + self.diagnosis._repr_html_()
        return html_table((), (), title) + self.fit._repr_html_()


def load(folder: Path | str) -> LoadedResults:
    """Load a results folder.

    Parameters
    ----------
    folder : results folder made by `snakemake` or `vinetrack run`, such as `results/demo`.

    Returns
    -------
    LoadedResults

    Raises
    ------
    ResultsError
        If it is not a results folder.

    Examples
    --------
    >>> import vinetrack as vt
    >>> vt.load("nowhere")
    Traceback (most recent call last):
    vinetrack.results.folder_layout.ResultsError: nowhere is not a results folder, ...
    """
    folder = Path(folder)
    if not Results(folder).provenance.exists():
        what = "because it has no provenance.json" if folder.is_dir() else "because it does not exist"
        raise ResultsError(
            f"{folder} is not a results folder, {what}: give the folder that a run made, such as results/demo"
        )
    return LoadedResults(folder)
