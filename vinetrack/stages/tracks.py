"""From measured positions to tracks, kinematics and one row a trial.

A bad trial writes its reason and never stops the rest.
"""

from __future__ import annotations

import logging
import traceback
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.records import Kinematics, Track, Trial, Window
from vinetrack.stages.pool import map_trials
from vinetrack.stages.results import (
    KINEMATICS_COLUMNS,
    POINT_COLUMNS,
    STEADY_COLUMNS,
    TRACK_COLUMNS,
    TRIALS_COLUMNS,
    Results,
    empty_table,
)
from vinetrack.tables import write_csv

if TYPE_CHECKING:
    import pandas as pd

    from vinetrack.experiment import Experiment
    from vinetrack.model.model import Model
    from vinetrack.settings import RunSettings

log = logging.getLogger(__name__)

NO_RECORDINGS_YET = "recordings cannot be tracked by this version: give the positions as a table, in the column track"
INTERNAL_FAULT = "could not be analysed: a fault of the program, written down in the log of this stage"


@dataclass(frozen=True)
class _Analysed:
    """What one trial adds to the tables of the experiment; `fault` is the traceback of an unforeseen error."""

    row: dict[str, Any]
    windows: list[dict[str, Any]]
    point: dict[str, Any] | None
    fault: str = ""


def analyse_tracks(experiment: Experiment, folder: Path, settings: RunSettings, n_workers: int = 1) -> pd.DataFrame:
    """Analyse every trial and write `tracks/`, `kinematics/`, `trials.csv`, `steady.csv` and `damping_points.csv`.

    Returns
    -------
    DataFrame
        `trials.csv` as written, in the order of the sheet.
    """
    import pandas as pd

    results = Results(folder)
    for name in experiment.failed:
        _write_empty(results, name)
    effects = experiment.settings.model, tuple(experiment.folder / path for path in experiment.settings.effects)
    _model(*effects)
    work = partial(_analyse_trial, results=results, settings=settings, effects=effects)
    analysed = {found.row["trial"]: found for found in map_trials(work, experiment.trials, n_workers, "tracks")}
    for name, found in analysed.items():
        if found.fault:
            log.error("trial %s:\n%s", name, found.fault)
    rows = {name: found.row for name, found in analysed.items()}
    rows |= {name: _bare_row(name, "failed", reason) for name, reason in experiment.failed.items()}
    rows |= {name: _bare_row(name, "left_out", reason) for name, reason in experiment.left_out.items()}
    table = pd.DataFrame([rows[name] for name in experiment.names], columns=list(TRIALS_COLUMNS))
    windows = [window for found in analysed.values() for window in found.windows]
    points = [found.point for found in analysed.values() if found.point]
    write_csv(results.steady, pd.DataFrame(windows, columns=list(STEADY_COLUMNS)))
    write_csv(results.points, pd.DataFrame(points, columns=list(POINT_COLUMNS)))
    write_csv(results.trials, table)
    for row in table.itertuples():
        log.info("%s: %s %s", row.trial, row.status, row.reason)
    return table


@lru_cache(maxsize=1)
def _model(names: tuple[str, ...], own: tuple[Path, ...]) -> Model:
    """The model in use; every process makes its own, since a user's effects cannot travel between processes."""
    from vinetrack.effects import load_effect
    from vinetrack.model.model import make_model

    return make_model(names, {effect.name: effect for effect in map(load_effect, own)})


def _analyse_trial(
    trial: Trial, results: Results, settings: RunSettings, effects: tuple[tuple[str, ...], tuple[Path, ...]]
) -> _Analysed:
    """One trial from its file to its rows; its own files are written here, in the worker."""
    from vinetrack.motion.summary import TrialError, summarise_trial
    from vinetrack.video.importers import TrackError, load_track

    try:
        if trial.track is None:
            raise TrackError(NO_RECORDINGS_YET)
        summary = summarise_trial(trial, load_track(trial), settings, _model(*effects))
    except TrackError as error:
        return _failed(results, trial, f"{trial.track.name + ' ' if trial.track else ''}{error}")
    except TrialError as error:
        return _failed(results, trial, str(error))
    except Exception:
        return _failed(results, trial, INTERNAL_FAULT, traceback.format_exc())
    write_csv(results.track(trial.name), track_table(summary.track))
    write_csv(results.kinematics(trial.name), kinematics_table(summary.kinematics))
    windows = [_window_row(trial.name, window) for window in summary.windows.values()]
    return _Analysed(dict(summary.row), windows, dict(summary.point))


def _failed(results: Results, trial: Trial, reason: str, fault: str = "") -> _Analysed:
    _write_empty(results, trial.name)
    row = _bare_row(trial.name, "failed", reason) | {"vine": trial.vine, "condition": trial.condition}
    return _Analysed(row, [], None, fault)


def _write_empty(results: Results, trial: str) -> None:
    write_csv(results.track(trial), empty_table(TRACK_COLUMNS))
    write_csv(results.kinematics(trial), empty_table(KINEMATICS_COLUMNS))


def _bare_row(trial: str, status: str, reason: str) -> dict[str, Any]:
    """A row of `trials.csv` for a trial without results."""
    blank: dict[str, Any] = dict.fromkeys(TRIALS_COLUMNS, np.nan)
    return blank | {"trial": trial, "vine": "", "condition": "", "status": status, "reason": reason, "steady_rule": ""}


def track_table(track: Track) -> pd.DataFrame:
    """A track as `tracks/<trial>.csv` holds it: one row a frame, `frame` counted from 0."""
    import pandas as pd

    columns = (
        np.arange(len(track.time_s)),
        track.time_s,
        track.edge_px,
        track.lead_position_m,
        track.lead_position_sigma_m,
        track.flag,
    )
    return pd.DataFrame(dict(zip(TRACK_COLUMNS, columns, strict=True)))


def kinematics_table(kinematics: Kinematics) -> pd.DataFrame:
    """Kinematics as `kinematics/<trial>.csv` holds them."""
    import pandas as pd

    return pd.DataFrame({column: getattr(kinematics, column) for column in KINEMATICS_COLUMNS})


def _window_row(trial: str, window: Window) -> dict[str, Any]:
    low, high = window.drift_95
    row = {column: getattr(window, column, None) for column in STEADY_COLUMNS}
    return row | {"trial": trial, "points": window.n_points, "drift_95_low": low, "drift_95_high": high}
