"""Fit of the model in use to the tracks of a results folder, comparison with them, and audit of neglected effects.

Recordings and tracks are treated alike: both are read from `tracks/`. A model that cannot be fitted does not stop the
run: its tables have headers only, and `fit.json` states the reason.
"""

from __future__ import annotations

import logging
import shutil
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.core.problems import INTERNAL_ERROR
from vinetrack.core.records import Kinematics, Track, Trial
from vinetrack.core.tables import write_csv, write_json
from vinetrack.results.folder_layout import Results, ResultsError, read_fit, read_json, read_result

if TYPE_CHECKING:
    import pandas as pd

    from vinetrack.diagnosis.ladder import Comparison
    from vinetrack.dynamics.audit import Audit
    from vinetrack.experiment.folder import Experiment
    from vinetrack.experiment.settings import RunSettings
    from vinetrack.inference.fit_result import Fit

log = logging.getLogger(__name__)


def fit_model(experiment: Experiment, folder: Path, settings: RunSettings) -> dict[str, Any]:
    """Fit the model in use to all trials. Writes `fit.json`, `comparison.csv`, `comparison/`, `model_check.csv` and
    `audit.csv`. Returns `fit.json` as written; `refused` is None or the reason.
    """
    from vinetrack.diagnosis.ladder import COMPARISON_COLUMNS
    from vinetrack.dynamics.audit import COLUMNS as AUDIT_COLUMNS
    from vinetrack.inference.fit_result import CHECK_COLUMNS
    from vinetrack.inference.fit_summary import FitSummary, summary_of
    from vinetrack.results.folder_layout import empty_table

    results = Results(folder)
    damping = read_json(results.damping)
    pairs, kinematics = measured_trials(experiment, results)
    tables = {results.comparison: COMPARISON_COLUMNS, results.model_check: CHECK_COLUMNS, results.audit: AUDIT_COLUMNS}
    written: dict[Path, pd.DataFrame] = {}
    content: dict[str, Any] = {}
    trajectories: dict[str, pd.DataFrame] = {}
    try:
        fit, comparison = _fit_and_compare(experiment, pairs, kinematics, settings)
        damping_check, check_message = _damping_check(fit, damping)
        audited = _audit(fit, comparison, pairs, kinematics)
    except Exception as error:
        content = FitSummary(names=tuple(experiment.settings.model), refused=_reason(error)).to_json()
    else:
        content = summary_of(fit, audited.warnings, (check_message,) if check_message else ()).to_json()
        written = {
            results.comparison: comparison.table,
            results.model_check: damping_check,
            results.audit: audited.table,
        }
        trajectories = dict(comparison.trajectories)
    for path, columns in tables.items():
        write_csv(path, written.get(path, empty_table(columns)))
    _write_trajectories(results, trajectories)
    write_json(results.fit, content)
    log.info("%s", content["refused"] or f"fitted {len(content['trials'])} trials")
    return content


def measured_trials(
    experiment: Experiment, results: Results
) -> tuple[list[tuple[Trial, Track]], dict[str, Kinematics]]:
    """Read the tracks and kinematics of all trials that did not fail from a results folder. Returns pairs, kinematics
    (by name of trial).
    """
    pairs, kinematics = [], {}
    failed: set[str] = set()
    if results.trials.exists():
        gathered = read_result(results.trials)
        failed = set(gathered.loc[gathered["status"] == "failed", "trial"])
    for trial in experiment.trials:
        table = read_result(results.track(trial.name))
        if len(table) and trial.name not in failed:
            pairs.append((trial, read_stored_track(trial, table)))
            kinematics[trial.name] = _kinematics(read_result(results.kinematics(trial.name)), trial.travel_ratio)
    return pairs, kinematics


def read_stored_track(trial: Trial, table: pd.DataFrame) -> Track:
    """Make a track of `tracks/<trial>.csv`, with the measured pressure. The results do not contain the pressure: it is
    read from the user's track or pressure trace.
    """
    from vinetrack.tracks.importers import TrackError, attach_pressure, load_track, read_pressure_trace

    systematic_m = table["lead_position_systematic_m"].to_numpy(dtype=float)
    track = Track(
        time_s=table["time_s"].to_numpy(dtype=float),
        lead_position_m=table["lead_position_m"].to_numpy(dtype=float),
        lead_position_sigma_m=table["lead_position_sigma_m"].to_numpy(dtype=float),
        flag=table["flag"].to_numpy(dtype=str),
        edge_px=table["edge_px"].to_numpy(dtype=float),
        lead_position_systematic_m=systematic_m if np.isfinite(systematic_m).any() else None,
    )
    try:
        if trial.pressure_trace is not None:
            return attach_pressure(track, *read_pressure_trace(trial.pressure_trace))
        source_track = load_track(trial) if trial.track is not None else None
    except TrackError as error:
        raise ResultsError(f"trial {trial.name}: {error}; then run snakemake again") from None
    if source_track is None or source_track.pressure_Pa is None:
        return track
    return replace(track, pressure_Pa=np.interp(track.time_s, source_track.time_s, source_track.pressure_Pa))


def _kinematics(table: pd.DataFrame, travel_ratio: float) -> Kinematics:
    """Make kinematics of `kinematics/<trial>.csv`, which does not store smoothing windows and noise."""
    names = ("time_s", "lead_position_m", "lead_velocity_m_s", "lead_velocity_sigma_m_s", "lead_acceleration_m_s2")
    columns = {name: table[name].to_numpy(dtype=float) for name in names}
    return Kinematics(
        **columns,
        window_points=np.zeros(len(table), dtype=int),
        noise_m=np.nan,
        noise_correlation=np.nan,
        travel_ratio=travel_ratio,
    )


def _fit_and_compare(
    experiment: Experiment,
    pairs: list[tuple[Trial, Track]],
    kinematics: dict[str, Kinematics],
    settings: RunSettings,
) -> tuple[Fit, Comparison]:
    from vinetrack.diagnosis.ladder import candidates_of, compare, initial_fit
    from vinetrack.pipeline.tracks_stage import model_of

    model = model_of(experiment)
    candidates = candidates_of(model, experiment.settings.candidates, model.user_effects)
    # A model of gravity alone describes a falling body, whose fitted g tests the whole chain from recording to fit.
    free = ("gravity.g",) if model.names == ("gravity",) else ()
    fit = initial_fit(model, pairs, candidates, free=free)
    return fit, compare(fit, pairs, kinematics=kinematics, final_at_fraction=settings.final_at_fraction)


def _damping_check(fit: Fit, damping: dict[str, Any]) -> tuple[pd.DataFrame, str]:
    """Return the table `model_check.csv`, and the reason if it is empty."""
    from vinetrack.inference.fit_data import FitError
    from vinetrack.inference.fit_result import CHECK_COLUMNS, check_damping
    from vinetrack.results.folder_layout import empty_table

    method = "log_log" if damping["both_axes"].get("refused") else "both_axes"
    try:
        return check_damping(fit, damping[method]), ""
    except FitError as error:
        return empty_table(CHECK_COLUMNS), str(error)


def _audit(
    fit: Fit, comparison: Comparison, pairs: list[tuple[Trial, Track]], kinematics: dict[str, Kinematics]
) -> Audit:
    from vinetrack.dynamics.audit import audit, measured_motion

    tracks = {trial.name: track for trial, track in pairs}
    motions = []
    for trial in comparison.trials:
        track = tracks[trial.name]
        trace = None if track.pressure_Pa is None else (track.time_s - trial.release_s, track.pressure_Pa)
        motions.append(measured_motion(trial.trial, kinematics[trial.name], trial.release_s, trace))
    return audit(fit.model, motions)


def model_errors() -> tuple[type[Exception], ...]:
    """Return the exceptions of a model that cannot be fitted, whose messages are meant for the user."""
    from vinetrack.dynamics.simulate import SimulationError
    from vinetrack.effects import EffectError
    from vinetrack.inference.fit_data import FitError

    return FitError, EffectError, SimulationError


def _reason(error: Exception) -> str:
    """Return the reason why there is no fit; the traceback of an unexpected exception goes to the log."""
    if isinstance(error, model_errors()):
        return str(error)
    log.exception("the model could not be fitted")
    return INTERNAL_ERROR


def _write_trajectories(results: Results, trajectories: dict[str, pd.DataFrame]) -> None:
    """Write one file per condition, after removing those of an earlier run, whose conditions may no longer exist."""
    folder = results.folder / "comparison"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for condition, table in trajectories.items():
        write_csv(results.trajectories(condition), table)


def comparison_lines(folder: Path) -> list[str]:
    """Return `comparison.csv` as aligned lines for the terminal, or the reason why it is empty."""
    from vinetrack.core.terminal import table as aligned

    results = Results(folder)
    fit, table = read_fit(results), read_result(results.comparison)
    if fit.refused:
        return [f"{' + '.join(fit.names)} was not fitted: {fit.refused}"]
    body = [
        (
            str(row["condition"]),
            _shown(1e3 * row["rms_position_m"], 3),
            _shown(1e3 * row["replicate_floor_m"], 3),
            _shown(row["ratio"], 1),
            _shown(row["rms_final_velocity_m_s"], 3),
            _shown(1e3 * row["worst_at_s"], 1),
            _shown(1e3 * row["worst_at_m"], 1),
        )
        for row in table.to_dict("records")
    ]
    head = ("condition", "rms position", "replicates", "ratio", "rms final speed", "worst at", "")
    lines = aligned(body, head, ("", "mm", "mm", "", "m/s", "ms", "mm"), align="<>>>>>>")
    return [" + ".join(fit.names), *lines, *(f"! {message}" for message in fit.messages)]


def _shown(value: float, decimals: int) -> str:
    return f"{value:.{decimals}f}" if np.isfinite(value) else "–"
