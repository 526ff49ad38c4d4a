"""The Python interface: a results folder in memory, `vt.load("results/demo")`; data frames as trials with tracks;
figures by name; and `vt.fit`, `vt.diagnose`, `vt.power` and `vt.compare` for trials from any source.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from importlib.resources import files
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from vinetrack.core.problems import ExperimentError, Problem
from vinetrack.core.process import Drawn, Printed
from vinetrack.core.records import Track, Trial, plain_track
from vinetrack.core.tables import PROVENANCE
from vinetrack.diagnosis.ladder import Comparison
from vinetrack.diagnosis.ladder import compare as compare_pairs
from vinetrack.diagnosis.result import Diagnosis, Power
from vinetrack.dynamics.model import Model, make_model
from vinetrack.effects import catalogue
from vinetrack.experiment import folder as experiments
from vinetrack.experiment.settings import ExperimentSettings, in_sheet_units
from vinetrack.figures.model_figures import draw_power
from vinetrack.figures.registry import FigureTables, describe_conditions, draw, figures_of, label_conditions
from vinetrack.inference.fit import fit as fit_pairs
from vinetrack.inference.fit_data import FitError, Pairs, pairs_of
from vinetrack.inference.fit_result import Fit, FitSummary
from vinetrack.results import (
    Results,
    ResultsError,
    measured_trials,
    read_diagnosis,
    read_fit,
    read_json,
    read_result,
    read_source_experiment,
)
from vinetrack.tracks.importers import flag_end_of_motion, table_track

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from vinetrack.figures.registry import DiagnosisTables


class LoadedResults(Printed, Drawn):
    """A results folder, read on first access. Tables are DataFrames with units in their columns (`docs/results.md`)."""

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
    def experiment(self) -> experiments.Experiment:
        """The experiment that the results were made from; raises a ResultsError if it has moved."""
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
        return self._model(self.fit)

    @cached_property
    def final_model(self) -> Model:
        """The final model of the diagnosis with its fitted values; the initial one if no effect was added."""
        diagnosis = self.diagnosis
        if diagnosis is None or not diagnosis.effects:
            return self.initial_model
        return self._model(FitSummary(diagnosis.final_model, numbers=diagnosis.parameters))

    def _model(self, fit: FitSummary) -> Model:
        own = not set(fit.names) <= set(catalogue())
        model = make_model(fit.names, self.experiment.user_effects if own else {})
        return model.with_values({key: one for key, one in fit.fitted_values.items() if key in model.parameter_names})

    def _concatenated(self, path_of: Callable[[str], Path]) -> pd.DataFrame:
        paths = {name: path_of(name) for name in self.trials["trial"]}
        parts = {name: read_result(path) for name, path in paths.items() if path.exists()}
        if not parts:
            return pd.DataFrame(columns=["trial"])
        return pd.concat(parts, names=["trial"]).reset_index(level="trial").reset_index(drop=True)

    def __repr__(self) -> str:
        return f"Results({self.name}: {self._state()})"

    def _state(self) -> str:
        usable = int(self.trials["status"].isin(["ok", "warning"]).sum())
        diagnosis = self.diagnosis
        named = ", ".join(diagnosis.effects or diagnosis.answer_set) if diagnosis is not None else ""
        verdict = "not diagnosed" if diagnosis is None or not diagnosis.verdict else diagnosis.verdict
        return f"{usable} of {len(self.trials)} trials; {verdict}{f': {named}' if named else ''}"

    def __str__(self) -> str:
        is_diagnosed = self.diagnosis is not None and self.diagnosis.verdict
        return f"{self.name}: {self._state()}\n\n{self.diagnosis if is_diagnosed else self.fit}"


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
    vinetrack.results.ResultsError: nowhere is not a results folder, ...
    """
    folder = Path(folder)
    if not Results(folder).provenance.exists():
        what = "because it has no provenance.json" if folder.is_dir() else "because it does not exist"
        raise ResultsError(
            f"{folder} is not a results folder, {what}: give the folder that a run made, such as results/demo"
        )
    return LoadedResults(folder)


# ------------------------------------------------------------------------------
# Trials and tracks from one pandas DataFrame with one row per point.

POSITION_COLUMNS = ("lead_position_m", "position_m")
ERROR_COLUMNS = ("lead_position_sigma_m", "lead_position_systematic_m")


def tracks_from_frame(frame: pd.DataFrame) -> list[tuple[Trial, Track]]:
    """Return trials and tracks from a frame with one row per point.

    Parameters
    ----------
    frame : columns `trial, time_s` and `lead_position_m` (or `position_m`); if known, `lead_position_sigma_m`,
        `lead_position_systematic_m` and `flag`; and the columns of a trial sheet, constant within a trial:
        `diameter_mm, thickness_um, length_mm, pressure_kPa, yield_pressure_kPa, …`, or in other units. A
        `pressure_kPa` that changes within a trial is a measured trace, and its first value the set pressure.

    Returns
    -------
    list of (Trial, Track), in the order of the frame

    Raises
    ------
    ExperimentError
        If a column is missing, or a value is refused as in a trial sheet.

    Examples
    --------
    >>> import vinetrack as vt
    >>> trial, track = vt.tracks_from_frame(vt.example_tracks())[0]
    >>> f"{trial.name}: {1e3 * trial.diameter_m:g} mm, {track.time_s.size} points"
    'P24_1: 24 mm, 224 points'
    """
    position = next((name for name in (*POSITION_COLUMNS, "x", "y") if name in frame), "")
    needed = ("trial",) if position in ("x", "y") else ("trial", "time_s", position or "lead_position_m")
    if absent := [name for name in needed if name not in frame]:
        remedy = "a frame of tracks has trial, time_s, lead_position_m and the columns of a trial sheet"
        raise ExperimentError([Problem(message=f"has no column {', '.join(absent)}", file="the frame", remedy=remedy)])
    parts = {str(name): part for name, part in frame.groupby("trial", sort=False)}
    cells = [_cells(name, part, position) for name, part in parts.items()]
    table, _ = in_sheet_units(experiments.table_of_texts(cells), "the frame")
    made = experiments.planned_rows(
        table, ExperimentSettings(), experiments.REQUIRED_FOR_PREDICTION, file=Path("the frame"), measured=True
    )
    return [(trial, _track(trial, parts[trial.name], position)) for trial in made.trials]


def _cells(name: str, part: pd.DataFrame, position: str) -> dict[str, str]:
    """Return the cells that a trial sheet would have for a trial: all columns but those of the track, as text."""
    cells = {"trial": name}
    of_track = {"trial", "time_s", *POSITION_COLUMNS, *ERROR_COLUMNS, "flag", "edge_px", "frame"}
    for column in part.columns:
        first, varies = part[column].iloc[0], len(part[column].unique()) > 1
        if column in of_track or pd.isna(first) or first == "" or (varies and position in ("x", "y")):
            continue
        if column != "pressure_kPa" and varies:
            message, remedy = f"changes within the trial {name}", "give it one value in all rows of the trial"
            raise ExperimentError([Problem(message=message, file="the frame", column=str(column), remedy=remedy)])
        cells[str(column)] = f"{first:.15g}" if isinstance(first, float | np.floating) else str(first)
    return cells


def _track(trial: Trial, part: pd.DataFrame, position: str) -> Track:
    if position in ("x", "y"):
        return flag_end_of_motion(trial, table_track(part.to_csv(index=False), "", trial.capture_fps, trial.m_per_px))
    known = {name: part[name].to_numpy(dtype=float) for name in ERROR_COLUMNS if name in part}
    flag = part["flag"].fillna("").to_numpy(dtype=str) if "flag" in part else np.full(len(part), "", dtype=str)
    traced = "pressure_kPa" in part and len(part["pressure_kPa"].unique()) > 1
    track = plain_track(
        part["time_s"].to_numpy(dtype=float),
        part[position].to_numpy(dtype=float),
        flag=flag,
        pressure_Pa=1e3 * part["pressure_kPa"].to_numpy(dtype=float) if traced else None,
        **known,
    )
    return flag_end_of_motion(trial, track)


# ------------------------------------------------------------------------------
# Trials with their tracks from any source: a results folder, an experiment, a frame of tracks, or pairs.

# Loaded results, a results folder, an experiment or its folder, a frame of tracks, or pairs of trial and track
Source = LoadedResults | experiments.Experiment | Path | str | pd.DataFrame | Pairs


def read_source(
    source: Source, tracks: Mapping[str, Track] | None = None
) -> tuple[list[tuple[Trial, Track]], experiments.Experiment | None, dict[str, str]]:
    """Read trials from any source; `tracks` go before those that an experiment names. Returns pairs of trial and track,
    their experiment (None for a frame and for pairs), and the reasons why trials were left out, by name.
    """
    if isinstance(source, LoadedResults):
        source = source.folder
    if isinstance(source, FitSummary):
        raise ResultsError("a fit that was loaded holds no trials: pass the results that it came from, r for r.fit")
    if isinstance(source, pd.DataFrame):
        return tracks_from_frame(source), None, {}
    if isinstance(source, (str, Path)) and tracks is None and (Path(source) / PROVENANCE).exists():
        experiment = read_source_experiment(Path(source))
        pairs = measured_trials(experiment, Results(Path(source)))
        return pairs, experiment, {**experiment.failed, **experiment.left_out}
    if isinstance(source, (str, Path)):
        source = experiments.read_experiment(source)
    pairs, left_out = pairs_of(source, tracks)
    return pairs, source if isinstance(source, experiments.Experiment) else None, left_out


# ------------------------------------------------------------------------------
# Figures of the report for objects in memory and for results folders, by name in the registry.


def figure_of(shown: Any, name: str = "", *, trial: str = "") -> Figure:
    """Draw results, a fit, a comparison, a diagnosis or a power as in the report: the figure of this name, or the main
    one; `trial` for figures of one trial. A ResultsError if there is no such figure.
    """
    if isinstance(shown, LoadedResults):
        from vinetrack.pipeline.analysis import draw_trial

        if name == "trial_motion":
            if trial not in (names := list(shown.trials["trial"])):
                raise ResultsError(f"There is no trial {trial!r}; there are {', '.join(names)}.")
            stated = next((row for row in shown.experiment.trials if row.name == trial), None)
            windows = read_json(shown._results.analysed(trial))["windows"]
            return _with_content(draw_trial(shown._results, stated, trial, windows), name)
        trials: tuple[Trial, ...] = ()
        with suppress(Exception):  # without the sheet, the figures have simpler labels
            trials = shown.experiment.trials
        of_folder = FigureTables(shown.folder, trials)
        return _draw_figure(of_folder, name or ("ladder" if len(of_folder.ladder) else "damping_law"))
    if isinstance(shown, Fit):
        shown = compare(shown)
    if isinstance(shown, Power):
        return _with_content(draw_power(shown), "power")
    if isinstance(shown, Comparison):
        table = label_conditions(shown.table, _described([compared.trial for compared in shown.trials]))
        tables = SimpleNamespace(comparison=table, trajectories=dict(shown.trajectories))
        return _draw_figure(tables, name or "model_comparison")
    return _draw_figure(_tables_in_memory(shown) if shown.rounds else None, name)


def _draw_figure(tables: Any, name: str = "") -> Figure:
    """Draw a figure, or the first with content; only the tables that it shows are read."""
    asked = [one for one in figures_of().values() if name in ("", one.name)]
    drawn = (draw(one.name, tables) for one in asked if all(hasattr(tables, table) for table in one.reads))
    return _with_content(next(filter(None, drawn), None), name)


def _with_content(drawn: Figure | None, name: str) -> Figure:
    if drawn is None:
        names = ", ".join(figures_of())
        raise ResultsError(f"There is no figure {name!r} with content; figures are {names}, trial_motion and power.")
    return drawn


def _described(trials: Sequence[Trial]) -> pd.DataFrame:
    """Trials as figures name them: with vine, condition and its label."""
    named = [(trial.name, trial.vine, trial.condition) for trial in trials]
    rows = pd.DataFrame(named, columns=["trial", "vine", "condition"])
    return describe_conditions(rows, tuple(trials))


def _tables_in_memory(shown: Diagnosis) -> DiagnosisTables:
    """The tables of a diagnosis as a results folder would hold them."""
    from vinetrack.figures.registry import CURVE_COLUMNS, DiagnosisTables
    from vinetrack.pipeline.analysis import diagnosis_tables, predictions

    curves = []
    for one, table in predictions(shown.fits[0], shown.fits[-1]) if shown.fits else ():
        positions = {name: table[name] - one.origin_m for name in CURVE_COLUMNS[3:]}
        of_trial = {"trial": one.name, "condition": one.trial.condition, "time_s": table["time_s"] - one.release_s}
        curves.append(pd.DataFrame({**of_trial, **positions}))
    trials = pd.concat(curves, ignore_index=True) if curves else pd.DataFrame(columns=list(CURVE_COLUMNS))
    conditions = _described([fitted.trial for fitted in shown.fits[0].trials] if shown.fits else [])
    return DiagnosisTables(shown, conditions, trials, diagnosis_tables(shown))


# ------------------------------------------------------------------------------
# Fits, diagnoses, power and comparisons of trials from any source.


def fit(model: Model, source: Source, **options: Any) -> Fit:
    """Fit a model to the trajectories of all trials.

    Parameters
    ----------
    model : a sum of effects.
    source : loaded results, a results folder, an experiment or its folder, a frame of tracks (see
        `tracks_from_frame`), or pairs of trial and track.
    options : options of `vinetrack.inference.fit.fit`, such as `fixed`, `free`, `start` and `tracks`.

    Returns
    -------
    Fit

    Raises
    ------
    FitError
        If there is nothing to fit, or the model cannot be simulated.
    ExperimentError, ResultsError
        If the source cannot be read.

    Examples
    --------
    >>> import vinetrack as vt
    >>> fit = vt.fit(vt.base_model(), vt.example_tracks())
    >>> fit
    Fit(pressure_drive + gravity + eversion_damping + yield_pressure; 8 trials)
    >>> fit.table()["unit"].tolist()
    ['N·(s/m)ⁿ', '1', 'Pa']
    """
    if not isinstance(model, Model):
        raise FitError(f"{model!r} is no model: give vt.base_model() or vt.make_model(names of effects).")
    pairs, _, left_out = read_source(source, options.pop("tracks", None))
    fitted = fit_pairs(model, pairs, **options)
    return replace(fitted, left_out={**left_out, **fitted.left_out})


def diagnose(source: Fit | Source, **options: Any) -> Diagnosis:
    """Diagnose what a model lacks: verdict, candidates with sizes, errors before and after, next experiment.

    Parameters
    ----------
    source : a fit, whose model is diagnosed, or any source of trials as in `fit`; the model is then that of the
        experiment, else the base model.
    options : options of `vinetrack.diagnosis.diagnose.diagnose`, such as `model`, `candidates`, `ladder` and `advice`.

    Returns
    -------
    Diagnosis

    Raises
    ------
    FitError
        If there is nothing to fit.
    ExperimentError, ResultsError
        If the source cannot be read.

    Examples
    --------
    >>> import vinetrack as vt
    >>> diagnosis = vt.diagnose(vt.example_tracks(), ladder=False, advice=False)
    >>> diagnosis
    Diagnosis(missing: reservoir_depletion)
    >>> diagnosis.candidates().loc[0, ["effect", "status"]].tolist()
    ['reservoir_depletion', 'refitted']
    """
    from vinetrack.diagnosis.diagnose import diagnose as diagnose_pairs

    if isinstance(source, Fit):
        return diagnose_pairs(source, **options)
    pairs, experiment, _ = read_source(source, options.pop("tracks", None))
    tracks = {trial.name: track for trial, track in pairs}
    return diagnose_pairs(experiment or pairs, tracks=tracks, **options)


def power(source: Fit | Source, *effects: str, **options: Any) -> Power:
    """Calculate the power of trials: detectable sizes of all effects, confusions between them, false-alarm rate.

    Parameters
    ----------
    source : a fit; or a results folder, an experiment's folder, a sheet without recordings, loaded results, a frame of
        tracks, or pairs of trial and track.
    *effects : names, or `name=size` in the unit of the parameter; all by default.
    **options
        Options of `vinetrack.pipeline.planning_stage.PowerRequest`: `noise_mm`, `noise_correlation`, `spread_P` and
        `spread_B` (relative), `capture_fps`, `B`, `n`; `simulate`, `jobs`, `first_seed` for complete diagnoses
        of simulated campaigns; `reach`, the probability with which further trials shall detect `name=size`.

    Returns
    -------
    Power

    Raises
    ------
    FitError
        If there is nothing to fit.
    ExperimentError, ResultsError
        If the source cannot be read, or there is no such effect.

    Examples
    --------
    >>> import vinetrack as vt
    >>> power = vt.power(vt.example_tracks(), "leak")
    >>> round(power["leak"].probability_at(1.0), 2)
    1.0
    """
    from vinetrack.pipeline.planning_stage import PowerRequest, power_of_target

    if isinstance(source, LoadedResults | experiments.Experiment):
        source = source.folder
    if isinstance(source, str | Path):
        return power_of_target(PowerRequest(Path(source), effects, **options))
    given = source if isinstance(source, Fit) else read_source(source)[0]
    return power_of_target(PowerRequest(Path("trials"), effects, **options), given)


def compare(fitted: Fit | Source, source: Source | None = None, **options: Any) -> Comparison:
    """Compare a fitted model with the trials, condition by condition, and with the scatter of replicates.

    Parameters
    ----------
    fitted : a fit; or any source of trials, to which the model of the experiment (else the base model) is first fitted.
    source : the trials to compare with, as in `fit`; None for those that the model was fitted to.
    options : `tracks`, and options of `vinetrack.diagnosis.ladder.compare`, such as `final_at_fraction`.

    Returns
    -------
    Comparison

    Raises
    ------
    FitError
        If the model cannot be simulated.
    ExperimentError, ResultsError
        If the source cannot be read.

    Examples
    --------
    >>> import vinetrack as vt
    >>> comparison = vt.compare(vt.fit(vt.base_model(), vt.example_tracks()))
    >>> list(comparison.table.columns)[:3]
    ['model', 'condition', 'rms_position_m']
    """
    tracks = options.pop("tracks", None)
    if isinstance(fitted, Fit):
        fit_shown, pairs = fitted, list(fitted.pairs)
    else:
        pairs, experiment, _ = read_source(fitted, tracks)
        named = () if experiment is None else (experiment.settings.model, experiment.user_effects)
        fit_shown = fit_pairs(make_model(*named), pairs)
    if source is not None:
        pairs, *_ = read_source(source, tracks)
    if not pairs:
        raise FitError("The fit does not contain its tracks: pass the trials to compare with.")
    return compare_pairs(fit_shown, pairs, **options)


def example_tracks() -> pd.DataFrame:
    """Return eight trials of one vine from the virtual laboratory, supplied by a chamber of 2 L that depletes.

    Returns
    -------
    DataFrame
        A frame of tracks as `fit`, `diagnose` and `compare` take it: `trial, time_s, lead_position_m` and columns of
        the trial sheet.

    Examples
    --------
    >>> import vinetrack as vt
    >>> vt.example_tracks()["trial"].nunique()
    8
    """
    with (files("vinetrack") / "example_tracks.csv").open(encoding="utf-8") as file:
        return pd.read_csv(file)
