"""Trials and tracks from one pandas DataFrame with one row per point."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from vinetrack.core.problems import ExperimentError, Problem
from vinetrack.core.records import Kinematics, Track, Trial
from vinetrack.core.tables import PROVENANCE
from vinetrack.experiment.folder import Experiment, read_experiment
from vinetrack.experiment.planned import REQUIRED_FOR_PREDICTION, table_of_texts
from vinetrack.experiment.schema import with_names
from vinetrack.experiment.settings import ExperimentSettings, in_sheet_units
from vinetrack.experiment.sheet import check_pressures, check_wall, make_trial, read_row
from vinetrack.inference.fit_data import Pairs
from vinetrack.interface.loaded import LoadedResults

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
    position = next((name for name in POSITION_COLUMNS if name in frame), "")
    absent = [name for name in ("trial", "time_s") if name not in frame] + ([] if position else ["lead_position_m"])
    if absent:
        remedy = "a frame of tracks has trial, time_s, lead_position_m and the columns of a trial sheet"
        raise ExperimentError([Problem(message=f"has no column {', '.join(absent)}", file="the frame", remedy=remedy)])
    parts = [(str(name), part) for name, part in frame.groupby("trial", sort=False)]
    trials = _trials([_cells(name, part) for name, part in parts])
    return [(trial, _track(part, position)) for trial, (_, part) in zip(trials, parts, strict=True)]


def _cells(name: str, part: pd.DataFrame) -> dict[str, str]:
    """Return the cells that a trial sheet would have for a trial: all columns but those of the track, as text."""
    cells = {"trial": name}
    of_track = {"trial", "time_s", *POSITION_COLUMNS, *ERROR_COLUMNS, "flag", "edge_px", "frame"}
    for column in part.columns:
        first = part[column].iloc[0]
        if column in of_track or _is_blank(first):
            continue
        if column != "pressure_kPa" and not _is_constant(part[column]):
            message, remedy = f"changes within the trial {name}", "give it one value in all rows of the trial"
            raise ExperimentError([Problem(message=message, file="the frame", column=str(column), remedy=remedy)])
        cells[str(column)] = f"{first:.15g}" if isinstance(first, float | np.floating) else str(first)
    return cells


def _is_blank(value: Any) -> bool:
    return value is None or value == "" or (isinstance(value, float | np.floating) and math.isnan(value))


def _is_constant(column: pd.Series) -> bool:
    first = column.iloc[0]
    return bool(column.isna().all() if _is_blank(first) else (column == first).all())


def _trials(rows: Sequence[dict[str, str]]) -> list[Trial]:
    table, _ = in_sheet_units(table_of_texts(rows), "the frame")
    settings = ExperimentSettings()
    problems: list[Problem] = []
    trials = []
    for i in range(len(rows)):
        row = read_row(table, i, settings)
        required = REQUIRED_FOR_PREDICTION if row.travel_ratio == 2 else REQUIRED_FOR_PREDICTION[:1]
        row.add_blank(required, "give it as a column of the frame")
        check_wall(row)
        check_pressures(row)
        problems += [replace(problem, file="the frame") for problem in row.problems]
        if not row.failed:
            # Marks the trial as a track measured elsewhere, which determines the default of its smooth errors.
            row.values["track"] = row.name
            trials.append(replace(make_trial(row, Path(), settings), track=None))
    if any(problem.severity == "error" for problem in problems):
        raise ExperimentError(problems)
    return list(with_names(trials))


def _track(part: pd.DataFrame, position: str) -> Track:
    count = len(part)
    unknown = np.full(count, math.nan)
    sigma_m, systematic_m = (part[name].to_numpy(dtype=float) if name in part else unknown for name in ERROR_COLUMNS)
    flag = part["flag"].fillna("").to_numpy(dtype=str) if "flag" in part else np.full(count, "", dtype=str)
    traced = "pressure_kPa" in part and not _is_constant(part["pressure_kPa"])
    return Track(
        time_s=part["time_s"].to_numpy(dtype=float),
        lead_position_m=part[position].to_numpy(dtype=float),
        lead_position_sigma_m=sigma_m,
        flag=flag,
        edge_px=unknown,
        pressure_Pa=1e3 * part["pressure_kPa"].to_numpy(dtype=float) if traced else None,
        lead_position_systematic_m=systematic_m,
    )


# ------------------------------------------------------------------------------
# Trials with their tracks from any source: a results folder, an experiment, a frame of tracks, or pairs.

# Loaded results, a results folder, an experiment or its folder, a frame of tracks, or pairs of trial and track
Source = LoadedResults | Experiment | Path | str | pd.DataFrame | Pairs


@dataclass(frozen=True)
class TrialSource:
    """Trials with their tracks, their experiment, and the reasons why trials were left out. `experiment` is None for a
    frame and for pairs; `kinematics` are those of a results folder, by name of trial.
    """

    pairs: list[tuple[Trial, Track]]
    experiment: Experiment | None = None
    left_out: Mapping[str, str] = field(default_factory=dict)
    kinematics: Mapping[str, Kinematics] = field(default_factory=dict)

    @property
    def tracks(self) -> dict[str, Track]:
        """Tracks by name of trial."""
        return {trial.name: track for trial, track in self.pairs}


def read_source(source: Source) -> TrialSource:
    """Read trials and tracks from any source."""
    from vinetrack.inference.fit_data import pairs_of
    from vinetrack.results.folder_layout import Results, measured_trials, read_source_experiment

    if isinstance(source, LoadedResults):
        source = source.folder
    if isinstance(source, pd.DataFrame):
        return TrialSource(tracks_from_frame(source))
    if isinstance(source, (str, Path)) and (Path(source) / PROVENANCE).exists():
        experiment = read_source_experiment(Path(source))
        pairs, kinematics = measured_trials(experiment, Results(Path(source)))
        return TrialSource(pairs, experiment, {**experiment.failed, **experiment.left_out}, kinematics)
    if isinstance(source, (str, Path)):
        source = read_experiment(source)
    pairs, left_out = pairs_of(source)
    return TrialSource(pairs, source if isinstance(source, Experiment) else None, left_out)
