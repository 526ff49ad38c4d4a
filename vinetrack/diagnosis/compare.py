"""Errors of a fitted model by condition, compared with the scatter of replicates.

The prediction of a trial has its own release and origin, but no deviation of pressure and B, as for a trial that was
left out of the fit. The origin is the position at standstill; the release, and the origin where no standstill was
filmed, minimise the root mean square error. Replicates are aligned with their mean in the same way, without any model,
so that a model which lacks nothing has an error equal to the replicate floor, a ratio of 1.

The two errors are those of the paper's Table II (Alvarez et al., 2025): of position over the whole growth, and of the
final speed of the leading edge.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vinetrack.core.blas_threads import in_one_blas_thread
from vinetrack.core.notebook import plot
from vinetrack.core.records import Floats, Kinematics, Track
from vinetrack.diagnosis.replicates import Replicates, first_that_counts, replicates_of
from vinetrack.dynamics.simulate import simulate_many
from vinetrack.inference.fit_data import Pairs, pairs_of
from vinetrack.inference.fit_result import Fit, TrialFit
from vinetrack.inference.left_out import predict_trials
from vinetrack.kinematics.conditions import lead_velocity_at
from vinetrack.kinematics.velocity import estimate_kinematics

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

    from vinetrack.experiment.folder import Experiment

COMPARISON_COLUMNS = (
    "model",
    "condition",
    "rms_position_m",
    "rms_final_velocity_m_s",
    "replicate_floor_m",
    "ratio",
    "worst_at_s",
    "worst_at_m",
    "replicate_floor_sigma_m",
)
TRAJECTORY_COLUMNS = (
    "trial",
    "time_s",
    "lead_position_m",
    "model_position_m",
    "replicates_mean_m",
    "replicates_sigma_m",
)

FINAL_AT_FRACTION = 0.95  # Fraction of the length, or of the part seen, at which the final speed is taken (chosen)

# Duration of the simulation, in durations of the recording, so that a slow model reaches the same position (chosen)
MAX_DURATION_FACTOR = 3.0

# Fraction of the growth's duration over which the residual is averaged before its maximum is found (chosen)
SMOOTHED_SHARE = 0.05


@dataclass(frozen=True, repr=False)
class Comparison:
    """Result of `compare`: `table` has one row for each condition, columns `COMPARISON_COLUMNS`. `trajectories` holds
    the trials of each condition with the model's prediction, columns `TRAJECTORY_COLUMNS`, with time since release and
    position from the origin. `trials` are the predictions.
    """

    table: pd.DataFrame
    trajectories: Mapping[str, pd.DataFrame]
    trials: tuple[TrialFit, ...]

    def plot(self, name: str = "model_comparison") -> Figure:
        """Return a figure of the report: `model_comparison` or `model_residuals`."""
        return plot(self, name)

    def __repr__(self) -> str:
        return f"Comparison({len(self.trials)} trials, {len(self.table)} conditions)"

    def _repr_html_(self) -> str:
        return str(self.table._repr_html_())  # type: ignore[operator]


@in_one_blas_thread
def compare(
    fit: Fit,
    experiment: Experiment | Path | str | Pairs,
    *,
    tracks: Mapping[str, Track] | None = None,
    kinematics: Mapping[str, Kinematics] | None = None,
    final_at_fraction: float = FINAL_AT_FRACTION,
) -> Comparison:
    """Compare a fitted model with the trials of an experiment."""
    import pandas as pd

    fitted = {trial.name for trial in fit.trials}
    chosen = [(trial, track) for trial, track in pairs_of(experiment, tracks)[0] if trial.name in fitted]
    predicted = predict_trials(fit, chosen, from_rest=True)
    measured = {trial.name: track for trial, track in chosen}
    errors = _final_speed_errors(fit, predicted, measured, kinematics or {}, final_at_fraction)
    rows, trajectories = [], {}
    for condition in dict.fromkeys(trial.trial.condition for trial in predicted):
        members = [trial for trial in predicted if trial.trial.condition == condition]
        together = replicates_of(members)
        rows.append(
            {
                "model": "+".join(fit.model.names),
                "condition": condition,
                **position_errors(members, together),
                "rms_final_velocity_m_s": _rms([errors[trial.name] for trial in members]),
            }
        )
        trajectories[condition] = trajectory_table(members, together)
    return Comparison(pd.DataFrame(rows, columns=list(COMPARISON_COLUMNS)), trajectories, tuple(predicted))


def position_errors(trials: Sequence[TrialFit], together: Replicates) -> dict[str, float]:
    """Position errors of one condition in motion, with equal weight for every trial, however many its frames. Returns
    columns of `comparison.csv`: m, s and ratios.
    """
    squares = [float(np.mean(trial.residual_m[first_that_counts(trial) :] ** 2)) for trial in trials]
    rms_m = math.sqrt(float(np.mean(squares)))
    floor_m = together.alignment.floor_m
    worst_at_s, worst_at_m = _worst(together)
    return {
        "rms_position_m": rms_m,
        "replicate_floor_m": floor_m,
        "ratio": rms_m / floor_m if floor_m > 0 else math.nan,
        "worst_at_s": worst_at_s,
        "worst_at_m": worst_at_m,
        "replicate_floor_sigma_m": together.alignment.floor_sigma_m,
    }


def _worst(together: Replicates) -> tuple[float, float]:
    """Time since release and growth where the smoothed mean residual of the replicates is largest."""
    moving = (together.time_s >= together.begin_s) & (together.present > 0)
    if not moving.any():
        return math.nan, math.nan
    residual_m, time_s = together.mean_residual_m[moving], together.time_s[moving]
    half = int(SMOOTHED_SHARE * residual_m.size / 2)
    cumulative = np.concatenate([[0.0], np.cumsum(residual_m)])
    low = np.maximum(np.arange(residual_m.size) - half, 0)
    high = np.minimum(np.arange(residual_m.size) + half + 1, residual_m.size)
    worst = int(np.argmax(np.abs((cumulative[high] - cumulative[low]) / (high - low))))
    return float(time_s[worst]), float((together.model_m[moving] + residual_m)[worst])


def _final_speed_errors(
    fit: Fit,
    predicted: Sequence[TrialFit],
    tracks: Mapping[str, Track],
    kinematics: Mapping[str, Kinematics],
    at_fraction: float = FINAL_AT_FRACTION,
) -> dict[str, float]:
    """Model minus measurement of the leading edge's final speed, m/s, by name of trial, both at the same position. A
    model that does not reach the position has stopped, and its speed there is 0. NaN where none was measured.
    """
    times = [MAX_DURATION_FACTOR * max(t.time_s[-1] - t.release_s, 1e-9) * np.linspace(0, 1, 601) for t in predicted]
    traces = [_trace_since_release(tracks[t.name], t.release_s) for t in predicted]
    runs = simulate_many(fit.model, [t.trial for t in predicted], times, traces=traces)
    errors = {}
    for trial, time_s, run in zip(predicted, times, runs, strict=True):
        motion = kinematics.get(trial.name) or estimate_kinematics(
            tracks[trial.name], travel_ratio=trial.trial.travel_ratio
        )
        travel_m = motion.lead_position_m - trial.origin_m
        seen_m = float(np.max(trial.lead_position_m)) - trial.origin_m
        length_m = trial.trial.length_m
        place_m = at_fraction * (min(length_m, seen_m) if math.isfinite(length_m) else seen_m)
        measured = lead_velocity_at(travel_m, motion.lead_velocity_m_s, place_m)
        by_model = lead_velocity_at(run.observed_position_m, np.gradient(run.observed_position_m, time_s), place_m)
        errors[trial.name] = (by_model if math.isfinite(by_model) else 0.0) - measured
    return errors


def _trace_since_release(track: Track, release_s: float) -> tuple[Floats, Floats] | None:
    if track.pressure_Pa is None:
        return None
    known = np.isfinite(track.pressure_Pa) & np.isfinite(track.time_s)
    return track.time_s[known] - release_s, track.pressure_Pa[known]


def trajectory_table(trials: Sequence[TrialFit], together: Replicates) -> pd.DataFrame:
    """Trials of one condition with the model, since release and from the origin, columns `TRAJECTORY_COLUMNS`.
    `replicates_mean_m` is the mean of the replicates at that time, `replicates_sigma_m` their standard deviation.
    """
    import pandas as pd

    mean_m = together.model_m + together.mean_residual_m
    sigma_m = np.sqrt(together.variance_m2)
    parts = []
    for trial in trials:
        time_s = trial.time_s - trial.release_s
        k = np.clip(np.rint((time_s - together.time_s[0]) / _step(together.time_s)).astype(int), 0, mean_m.size - 1)
        columns = (
            trial.name,
            time_s,
            trial.lead_position_m - trial.origin_m,
            trial.predicted_position_m - trial.origin_m,
            mean_m[k],
            sigma_m[k],
        )
        parts.append(pd.DataFrame(dict(zip(TRAJECTORY_COLUMNS, columns, strict=True))))
    return pd.concat(parts, ignore_index=True)


def _step(time_s: Floats) -> float:
    return float(time_s[1] - time_s[0]) if time_s.size > 1 else 1.0


def _rms(values: Sequence[float]) -> float:
    known = [value for value in values if math.isfinite(value)]
    return math.sqrt(float(np.mean(np.square(known)))) if known else math.nan
