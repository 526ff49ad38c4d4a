"""Planned trials: one given by command-line options, or the rows of a sheet, with or without recordings.

Both pass the checks of a trial sheet, so that a wrong unit gets the same message everywhere.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from vinetrack.core.problems import ExperimentError, Problem
from vinetrack.core.records import Trial
from vinetrack.core.tables import Table, TableError, read_table
from vinetrack.experiment.schema import COLUMNS, SHARED, option, with_names
from vinetrack.experiment.settings import ExperimentSettings, in_sheet_units, read_experiment_settings
from vinetrack.experiment.sheet import (
    SHEET,
    Row,
    check_pressures,
    check_wall,
    make_trial,
    read_row,
    unknown_columns,
)

# Columns that a prediction needs; an unknown yield pressure is taken from the scaling prior
REQUIRED_FOR_PREDICTION = ("diameter_mm", "thickness_um", "length_mm", "pressure_kPa")

# Columns about recordings: optional for a planned trial, and ignored
_RECORDING_COLUMNS = ("video", "track", "pressure_trace", "capture_fps", "exposure_us", "mm_per_px", "steady")

Relocate = Callable[[Problem], Problem]


@dataclass(frozen=True)
class PlannedTrials:
    """Planned trials, one per condition or one per row, with the settings they share; `problems` are warnings."""

    trials: tuple[Trial, ...]
    settings: ExperimentSettings
    folder: Path | None
    problems: tuple[Problem, ...]


def planned_trial(
    values: Mapping[str, str],
    settings: ExperimentSettings | None = None,
    needed: Sequence[str] = REQUIRED_FOR_PREDICTION,
) -> PlannedTrials:
    """Read a trial from texts by name of column, as given on the command line.

    A yield pressure that is not given is NaN. Messages name the command-line option.

    Parameters
    ----------
    values : texts by column, in the unit of the column.
    settings : shared settings; None for the defaults.
    needed : required columns.

    Returns
    -------
    planned : the trial, and warnings.

    Raises
    ------
    ExperimentError
        With every value that is missing or not allowed.

    Examples
    --------
    >>> texts = {"diameter_mm": "24", "thickness_um": "200", "length_mm": "280", "pressure_kPa": "30"}
    >>> planned_trial(texts).trials[0].vine
    '24mm-200um-280mm'
    """

    def shown(problem: Problem) -> Problem:
        return replace(problem, file="", trial="", line=0, column=option(problem.column) if problem.column else "")

    settings = settings or ExperimentSettings()
    cells = {"trial": "planned", **{name: text.strip() for name, text in values.items()}}
    table = Table(tuple(cells), (cells,), (0,), ((),), ",", ".")
    return _planned_trials(table, settings, None, needed, shown)


def planned_sheet(path: Path, *, every_row: bool = False) -> PlannedTrials:
    """Read the conditions of an experiment folder or of a single sheet, filmed or not. Rows with the same nominal
    settings form one condition, represented by the first; rows with `use: no` are skipped.
    """
    file = path / SHEET if path.is_dir() else path
    if not file.is_file():
        remedy = _nearest(file) or f"give a folder with {SHEET}, or a sheet"
        raise ExperimentError([Problem(message="does not exist", file=str(file), remedy=remedy)])
    try:
        table = read_table(file)
    except TableError as error:
        raise ExperimentError([Problem.from_error(error, file.name)]) from None
    table, converted = in_sheet_units(table, file.name)
    settings = read_experiment_settings(file.parent / "experiment.yaml")
    if not table.rows:
        raise ExperimentError([Problem(message="has no rows", file=file.name, remedy="write one row a trial")])
    header = [*converted, *_check_header(table, settings, file.name)]

    def shown(problem: Problem) -> Problem:
        return replace(problem, file=file.name)

    return _planned_trials(table, settings, file.parent, REQUIRED_FOR_PREDICTION, shown, header, every_row=every_row)


def _check_header(table: Table, settings: ExperimentSettings, file: str) -> list[Problem]:
    """Return warnings about unknown columns."""
    unknown = unknown_columns(table, file)
    absent = [
        name
        for name in REQUIRED_FOR_PREDICTION
        if name not in table.columns and not (name in SHARED and getattr(settings, name) is not None)
    ]
    if absent:
        message = f"has no column {', '.join(absent)}"
        if len(absent) == len(REQUIRED_FOR_PREDICTION):
            raise ExperimentError([Problem(message=message, file=file, remedy="give a trial sheet, one row a trial")])
        raise ExperimentError([Problem(message=message, file=file, remedy="add what is missing"), *unknown])
    return unknown


def _nearest(file: Path) -> str:
    try:
        names = [entry.name for entry in file.parent.iterdir()]
    except OSError:
        return ""
    close = difflib.get_close_matches(file.name, names, 1, 0.6)
    return f"did you mean {close[0]}?" if close else ""


def _planned_trials(
    table: Table,
    settings: ExperimentSettings,
    folder: Path | None,
    needed: Sequence[str],
    shown: Relocate,
    header: Sequence[Problem] = (),
    *,
    every_row: bool = False,
) -> PlannedTrials:
    """Read, check and name the rows; raise an ExperimentError if any has an error."""
    rows = [row for i in range(len(table.rows)) if (row := read_row(table, i, settings)).in_use]
    for row in rows:
        _check_row(row, needed)
    of_rows = (shown(problem) for row in rows for problem in row.problems if problem.column not in _RECORDING_COLUMNS)
    problems = [*header, *of_rows]
    if any(problem.severity == "error" for problem in problems) or not rows:
        nothing = (
            []
            if rows
            else [shown(Problem(message="has no trial in use", remedy="remove `use: no` from at least one row"))]
        )
        raise ExperimentError([*problems, *nothing])
    trials = with_names([_trial(row, settings) for row in rows])
    first = {trial.condition: trial for trial in reversed(trials)}
    kept = trials if every_row else (first[condition] for condition in dict.fromkeys(t.condition for t in trials))
    return PlannedTrials(tuple(kept), settings, folder, tuple(problems))


def _check_row(row: Row, needed: Sequence[str]) -> None:
    broken = {problem.column for problem in row.problems}
    for name in needed:
        if name not in row.values and name not in broken:
            row.add(
                "is missing" if row.line == 0 else "is blank", name, allowed=COLUMNS[name].allowed, remedy="give it"
            )
    if row.travel_ratio != 2:
        row.add(
            "is that of a body that moves as a whole",
            "travel_ratio",
            remedy="predictions are for everting vines (travel_ratio 2)",
        )
    check_wall(row)
    check_pressures(row)


def _trial(row: Row, settings: ExperimentSettings) -> Trial:
    """Return the trial of a row, without its recording; a yield pressure that is not given is NaN."""
    values = {name: value for name, value in row.values.items() if name not in _RECORDING_COLUMNS}
    trial = make_trial(replace(row, values=values), Path(), settings)
    fps = row.values.get("capture_fps", math.nan)
    trial = replace(trial, capture_fps=float(fps))
    if "yield_pressure_kPa" not in row.values:
        return replace(trial, yield_pressure_Pa=math.nan, yield_pressure_sigma_Pa=math.nan)
    return trial
