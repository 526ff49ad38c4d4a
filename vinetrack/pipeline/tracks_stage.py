"""Analysis of trials that are tracks: track, kinematics and summary row of each, and the tables of all trials.

A trial that fails writes its reason and never stops the others.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import sys
import threading
import traceback
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from vinetrack.core.problems import INTERNAL_ERROR
from vinetrack.core.records import Kinematics, Track, Trial, Window
from vinetrack.core.tables import write_csv, write_json
from vinetrack.core.terminal import progress
from vinetrack.results.folder_layout import (
    COUNT_COLUMNS,
    KINEMATICS_COLUMNS,
    POINT_COLUMNS,
    STEADY_COLUMNS,
    TEXT_COLUMNS,
    TRACK_COLUMNS,
    TRIALS_COLUMNS,
    TRUTH_COLUMNS,
    Results,
    empty_table,
    read_json,
    read_result,
)

if TYPE_CHECKING:
    import pandas as pd

    from vinetrack.dynamics.model import Model
    from vinetrack.experiment.folder import Experiment
    from vinetrack.experiment.settings import DampingSettings, RunSettings


# ------------------------------------------------------------------------------
# Applying a function to many trials in several processes, with a progress bar.

Item = TypeVar("Item")
Answer = TypeVar("Answer")

MIN_ITEMS_FOR_POOL = 8  # Fewest items for which a second process is started (chosen)


def map_trials(
    function: Callable[[Item], Answer], items: Sequence[Item], n_workers: int, label: str
) -> Iterator[Answer]:
    """Yield `function(item)` for every item, in order, with a progress bar on a terminal. `function` and items are sent
    to other processes and must be picklable.
    """
    if n_workers < 2 or len(items) < MIN_ITEMS_FOR_POOL:
        yield from progress(map(function, items), label, total=len(items))
        return
    chunk = max(len(items) // (8 * n_workers), 1)
    with _pool(n_workers) as pool:
        yield from progress(pool.map(function, items, chunksize=chunk), label, total=len(items))


def map_unordered(function: Callable[[Item], Answer], items: Sequence[Item], n_workers: int) -> Iterator[Answer]:
    """Yield `function(item)` of every item as soon as it is ready, in any order. `function` and items are sent to other
    processes and must be picklable.
    """
    if n_workers < 2 or len(items) < 2:
        yield from map(function, items)
        return
    with _pool(n_workers) as pool:
        futures = [pool.submit(function, argument) for argument in items]
        try:
            yield from (future.result() for future in as_completed(futures))
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def _pool(n_workers: int) -> ProcessPoolExecutor:
    """Return a pool of processes, forked on Linux, where they are ready at once, and spawned elsewhere."""
    method = "fork" if "fork" in multiprocessing.get_all_start_methods() and sys.platform == "linux" else "spawn"
    context = multiprocessing.get_context(method)
    return ProcessPoolExecutor(n_workers, mp_context=context, initializer=_end_with_parent)


def _end_with_parent() -> None:
    """End this worker when its parent process ends, even if the parent is killed. A worker waits for its next argument
    on a pipe that the other workers hold open as well: after a killed run all of them would wait forever and keep their
    memory.
    """
    parent = multiprocessing.parent_process()
    assert parent is not None

    def wait() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, name="end with the parent", daemon=True).start()


log = logging.getLogger(__name__)

TRIAL_NOT_ANALYSED = f"could not be analysed: {INTERNAL_ERROR}"


def analyse_tracks(
    experiment: Experiment,
    folder: Path,
    settings: RunSettings,
    n_workers: int = 1,
    only: Collection[str] | None = None,
) -> list[str]:
    """Analyse all trials that are tracks; write the files of each in `tracks/`, `kinematics/` and `analysed/`. Trials
    with a faulty row of the sheet get empty files.
    """
    results = Results(folder)
    failed = {name: reason for name, reason in experiment.failed.items() if only is None or name in only}
    for name, reason in failed.items():
        write_empty(results, name, _bare_row(name, "failed", reason))
    model_of(experiment)
    work = partial(_analyse_track, results=results, settings=settings, experiment=experiment)
    trials = [trial for trial in experiment.trials if trial.video is None and (only is None or trial.name in only)]
    outcomes = list(map_trials(work, trials, n_workers, "tracks"))
    for trial, (reason, fault) in zip(trials, outcomes, strict=True):
        log.info("%s: %s", trial.name, reason or "analysed")
        if fault:
            log.error("trial %s:\n%s", trial.name, fault)
    failed |= {trial.name: reason for trial, (reason, _) in zip(trials, outcomes, strict=True) if reason}
    return [f"{name}: {reason}" for name, reason in failed.items()]


def _analyse_track(trial: Trial, results: Results, settings: RunSettings, experiment: Experiment) -> tuple[str, str]:
    """Analyse one track in a worker process; return as `analyse` does."""
    from vinetrack.tracks.importers import TrackError, load_track

    try:
        track = load_track(trial)
    except TrackError as error:
        reason = f"{trial.track.name + ' ' if trial.track else ''}{error}"
        write_empty(results, trial.name, failed_row(trial, reason))
        return reason, ""
    return analyse(trial, track, results, settings, experiment)


def analyse(
    trial: Trial, track: Track, results: Results, settings: RunSettings, experiment: Experiment, **columns: float
) -> tuple[str, str]:
    """Analyse the track of one trial, and write its files. Returns reason (why the trial failed; blank if it did not),
    fault (traceback of an unexpected exception; blank if there was none).
    """
    from vinetrack.kinematics.summary import TrialError, summarise_trial

    try:
        summary = summarise_trial(trial, track, settings, model_of(experiment))
    except TrialError as error:
        write_empty(results, trial.name, failed_row(trial, str(error)))
        return str(error), ""
    except Exception:
        write_empty(results, trial.name, failed_row(trial, TRIAL_NOT_ANALYSED))
        return TRIAL_NOT_ANALYSED, traceback.format_exc()
    write_csv(results.track(trial.name), _track_table(summary.track))
    write_csv(results.kinematics(trial.name), _kinematics_table(summary.kinematics))
    windows = [_window_row(trial.name, window) for window in summary.windows.values()]
    row = dict(summary.row) | columns
    point = dict(summary.point) | {"scale_rel_sigma": row["scale_rel_sigma"]}
    write_json(results.analysed(trial.name), {"row": row, "windows": windows, "point": point})
    return "", ""


def gather(experiment: Experiment, folder: Path, settings: RunSettings) -> pd.DataFrame:
    """Gather the results of all trials in `trials.csv`, `conditions.csv`, `steady.csv` and `damping_points.csv`."""
    from vinetrack.kinematics.damping import mark_left_out
    from vinetrack.kinematics.summary import condition_table

    results = Results(folder)
    analysed = {name: read_json(results.analysed(name)) for name in experiment.names if name not in experiment.left_out}
    analysed |= _askew_as_failed(experiment, analysed)
    rows = {name: content["row"] for name, content in analysed.items()}
    rows |= {name: _bare_row(name, "left_out", reason) for name, reason in experiment.left_out.items()}
    table = _frame([rows[name] for name in experiment.names], TRIALS_COLUMNS)
    write_csv(
        results.steady, _frame([row for content in analysed.values() for row in content["windows"]], STEADY_COLUMNS)
    )
    points = _frame([c["point"] for c in analysed.values() if c["point"]], POINT_COLUMNS)
    write_csv(results.points, mark_left_out(points))
    evaluated_at = {"final_at_fraction": settings.final_at_fraction, "efficiency_at_mm": settings.efficiency_at_mm}
    write_csv(results.conditions, condition_table(table, experiment.trials, **evaluated_at))
    write_csv(results.trials, table)
    for row in table.itertuples():
        log.info("%s: %s %s", row.trial, row.status, row.reason)
    return table


def _askew_as_failed(experiment: Experiment, analysed: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return, as failed trials, those whose axis is askew to that of most other trials with the same growth angle."""
    from vinetrack.video.axis import askew_trials, slope_deg

    failed: dict[str, dict[str, Any]] = {}
    if experiment.settings.axis is not None:
        return failed
    tracked = [
        (name, content.get("axis")) for name, content in analysed.items() if content["row"]["status"] != "failed"
    ]
    slopes_deg = {
        name: slope_deg(axis["from_px"], axis["to_px"], bends="via_px" in axis) for name, axis in tracked if axis
    }
    for names, agreed in askew_trials(slopes_deg, experiment.trials):
        for name in names:
            reason = (
                f"its growth axis was found askew to that of {agreed} other recordings: another moving object, such as "
                "a door, was taken for the tube; state its axis in the column `axis`, even if the camera was turned"
            )
            failed[name] = {"row": failed_row(experiment.trial(name), reason), "windows": [], "point": None}
    return failed


def _frame(rows: list[dict[str, Any]], columns: tuple[str, ...]) -> pd.DataFrame:
    """Return rows, or none, as a table with typed columns; a number that JSON stores as null becomes NaN."""
    import pandas as pd

    frame = pd.DataFrame(rows, columns=list(columns))
    counts = [column for column in columns if column in COUNT_COLUMNS]
    truths = [column for column in columns if column in TRUTH_COLUMNS]
    numbers = [column for column in columns if column not in TEXT_COLUMNS | TRUTH_COLUMNS | COUNT_COLUMNS]
    kinds = dict.fromkeys(numbers, "float") | dict.fromkeys(counts, "Int64") | dict.fromkeys(truths, "bool")
    return frame.astype(kinds)


def model_of(experiment: Experiment) -> Model:
    """Return the model in use; each process makes its own, since a user's effects cannot be pickled."""
    return _model(experiment.settings.model, tuple(experiment.folder / path for path in experiment.settings.effects))


@lru_cache(maxsize=1)
def _model(names: tuple[str, ...], paths: tuple[Path, ...]) -> Model:
    from vinetrack.dynamics.model import make_model
    from vinetrack.effects import load_effect

    return make_model(names, {effect.name: effect for effect in map(load_effect, paths)})


def failed_row(trial: Trial, reason: str) -> dict[str, Any]:
    """Return the row of `trials.csv` of a trial that failed."""
    return _bare_row(trial.name, "failed", reason) | {"vine": trial.vine, "condition": trial.condition}


def write_empty(results: Results, trial: str, row: dict[str, Any]) -> None:
    """Write the files of a trial without results: tables with headers only, and its row."""
    write_csv(results.track(trial), empty_table(TRACK_COLUMNS))
    write_csv(results.kinematics(trial), empty_table(KINEMATICS_COLUMNS))
    write_json(results.analysed(trial), {"row": row, "windows": [], "point": None})


def _bare_row(trial: str, status: str, reason: str) -> dict[str, Any]:
    """Return a row of `trials.csv` for a trial without results."""
    blank: dict[str, Any] = dict.fromkeys(TRIALS_COLUMNS, np.nan)
    return blank | {"trial": trial, "vine": "", "condition": "", "status": status, "reason": reason, "steady_rule": ""}


def _track_table(track: Track) -> pd.DataFrame:
    """Return a track as the table `tracks/<trial>.csv`: one row per frame, `frame` counted from 0."""
    import pandas as pd

    columns = (
        np.arange(len(track.time_s)),
        track.time_s,
        track.edge_px,
        track.lead_position_m,
        track.lead_position_sigma_m,
        track.flag,
        track.edge_px if track.tracked_px is None else track.tracked_px,
        np.nan if track.lead_position_systematic_m is None else track.lead_position_systematic_m,
    )
    return pd.DataFrame(dict(zip(TRACK_COLUMNS, columns, strict=True)))


def _kinematics_table(kinematics: Kinematics) -> pd.DataFrame:
    """Return kinematics as the table `kinematics/<trial>.csv`."""
    import pandas as pd

    return pd.DataFrame({column: getattr(kinematics, column) for column in KINEMATICS_COLUMNS})


def _window_row(trial: str, window: Window) -> dict[str, Any]:
    low, high = window.drift_95
    row = {column: getattr(window, column, None) for column in STEADY_COLUMNS}
    return row | {"trial": trial, "points": window.n_points, "drift_95_low": low, "drift_95_high": high}


# ------------------------------------------------------------------------------
# Fit of the damping law and of its scaling with the size of the vine.


def fit_law(folder: Path, settings: DampingSettings) -> dict[str, Any]:
    """Fit the damping law to `damping_points.csv`; write `damping.json` and `scaling.json`. Returns `damping.json` as
    written.
    """
    results = Results(folder)
    points = read_result(results.points)

    from vinetrack.kinematics.damping import fit_laws, fit_scaling, fit_trends

    damping = fit_laws(points, resamples=settings.resamples, seed=settings.seed)
    write_json(results.scaling, fit_scaling(damping) | fit_trends(read_result(results.conditions)))
    write_json(results.damping, damping)
    for method, fit in damping.items():
        log.info("%s: n = %s, refused: %s", method, fit.get("n"), fit.get("refused"))
    return damping
