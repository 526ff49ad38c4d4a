"""Planned trials: one given by command-line options, or the rows of a sheet, with or without recordings.

Both pass the checks of a trial sheet, so that a wrong unit gets the same message everywhere.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from vinetrack.core.problems import ExperimentError, Problem
from vinetrack.core.records import Trial
from vinetrack.core.tables import Table, TableError, read_table
from vinetrack.experiment.schema import SHARED, option, with_names
from vinetrack.experiment.settings import ExperimentSettings, in_sheet_units, read_experiment_settings
from vinetrack.experiment.sheet import (
    SHEET,
    Row,
    check_pressures,
    check_wall,
    make_trial,
    read_row,
    similar_entry,
    unknown_columns,
)

# Columns that a prediction needs; an unknown yield pressure is taken from the scaling prior
REQUIRED_FOR_PREDICTION = ("diameter_mm", "thickness_um", "length_mm", "pressure_kPa")

# Columns about recordings: optional for a planned trial, and ignored
_RECORDING_COLUMNS = ("video", "track", "pressure_trace", "capture_fps", "exposure_us", "mm_per_px", "steady")


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
    settings = settings or ExperimentSettings()
    table = table_of_texts([{"trial": "planned", **{name: text.strip() for name, text in values.items()}}])
    rows, problems = _checked_rows(table, settings, needed)
    problems = [replace(p, file="", trial="", column=option(p.column) if p.column else "") for p in problems]
    return PlannedTrials(tuple(_trials(rows, settings, problems)), settings, None, tuple(problems))


def planned_sheet(path: Path, *, every_row: bool = False) -> PlannedTrials:
    """Read the conditions of an experiment folder or of a single sheet, filmed or not. Rows with the same nominal
    settings form one condition, represented by the first; rows with `use: no` are skipped.
    """
    file = path / SHEET if path.is_dir() else path
    if not file.is_file():
        remedy = similar_entry(file) or f"give a folder with {SHEET}, or a sheet"
        raise ExperimentError([Problem("no_file", "does not exist", file=str(file), remedy=remedy)])
    try:
        table = read_table(file)
    except TableError as error:
        raise ExperimentError([Problem.from_error(error, file.name)]) from None
    table, header = in_sheet_units(table, file.name)
    settings = read_experiment_settings(file.parent / "experiment.yaml")
    if not table.rows:
        raise ExperimentError([Problem("no_rows", "has no rows", file=file.name, remedy="write one row a trial")])
    header += _check_header(table, settings, file.name)
    rows, problems = _checked_rows(table, settings, REQUIRED_FOR_PREDICTION)
    problems = [*header, *(replace(problem, file=file.name) for problem in problems)]
    trials = _trials(rows, settings, problems)
    first = {trial.condition: trial for trial in reversed(trials)}
    if not every_row:
        trials = [first[condition] for condition in dict.fromkeys(trial.condition for trial in trials)]
    return PlannedTrials(tuple(trials), settings, file.parent, tuple(problems))


def table_of_texts(rows: Sequence[dict[str, str]]) -> Table:
    """Return a table of rows that stand in no file: their lines are 0."""
    columns = tuple(dict.fromkeys(name for row in rows for name in row))
    return Table(columns, tuple(rows), (0,) * len(rows), ((),) * len(rows), ",", ".")


def _check_header(table: Table, settings: ExperimentSettings, file: str) -> list[Problem]:
    """Return warnings about unknown columns; refuse a sheet that lacks required ones."""
    unknown = unknown_columns(table, file)
    shared = {name for name in SHARED if getattr(settings, name) is not None}
    absent = [name for name in REQUIRED_FOR_PREDICTION if name not in table.columns and name not in shared]
    if not absent:
        return unknown
    message = f"has no column {', '.join(absent)}"
    if len(absent) == len(REQUIRED_FOR_PREDICTION):
        remedy = "give a trial sheet, one row a trial"
        raise ExperimentError([Problem("missing", message, file=file, remedy=remedy)])
    raise ExperimentError([Problem("missing", message, file=file, remedy="add what is missing"), *unknown])


def _checked_rows(table: Table, settings: ExperimentSettings, needed: Sequence[str]) -> tuple[list[Row], list[Problem]]:
    """Read and check the rows in use; return them with their problems, those of recordings left out."""
    rows = [row for i in range(len(table.rows)) if (row := read_row(table, i, settings)).in_use]
    for row in rows:
        row.add_blank(needed, "give it")
        if row.travel_ratio != 2:
            remedy = "predictions are for everting vines (travel_ratio 2)"
            row.add("a_body", "is that of a body that moves as a whole", "travel_ratio", remedy=remedy)
        check_wall(row)
        check_pressures(row)
    if not rows:
        remedy = "remove `use: no` from at least one row"
        return rows, [Problem("no_rows", "has no trial in use", remedy=remedy)]
    return rows, [p for row in rows for p in row.problems if p.column not in _RECORDING_COLUMNS]


def _trials(rows: Sequence[Row], settings: ExperimentSettings, problems: Sequence[Problem]) -> list[Trial]:
    """Return named trials without their recordings; a yield pressure that is not given is NaN. Refuse errors."""
    if any(problem.severity == "error" for problem in problems):
        raise ExperimentError(problems)
    trials = []
    for row in rows:
        values = {name: value for name, value in row.values.items() if name not in _RECORDING_COLUMNS}
        trial = make_trial(replace(row, values=values), Path(), settings)
        trial = replace(trial, capture_fps=row.number("capture_fps"))
        if "yield_pressure_kPa" not in values:
            trial = replace(trial, yield_pressure_Pa=math.nan, yield_pressure_sigma_Pa=math.nan)
        trials.append(trial)
    return list(with_names(trials))
