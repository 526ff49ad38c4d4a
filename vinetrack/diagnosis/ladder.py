"""The ladder of errors: in-sample and out-of-sample errors of each model as effects are added.

All errors are those of `vinetrack.diagnosis.compare`: each trial has its own release and origin and no other trial
effect, the origin is the position at standstill, and every trial has the same weight. They differ in the data of the
fit: all trials; all but the condition predicted, each in turn (leave-one-condition-out cross-validation); all but the
highest pressure of each vine. The floor is the scatter of replicates. Where it dominates, the error hardly falls as the
model improves, but the excess √(rms² − floor²) does.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from vinetrack.diagnosis.replicates import align_replicates, first_that_counts
from vinetrack.inference.fit_data import FitError, FitTrial
from vinetrack.inference.fit_result import Fit, TrialFit
from vinetrack.inference.left_out import predict_prepared
from vinetrack.inference.subset import fit_subset
from vinetrack.inference.trace_errors import as_recorded

if TYPE_CHECKING:
    import pandas as pd

LADDER_COLUMNS = (
    "model",
    "added",
    "rms_in_sample_m",
    "rms_left_out_m",
    "rms_highest_pressure_m",
    "floor_m",
    "excess_left_out_m",
    "floor_sigma_m",
    "partial",
)
MOVED_COLUMNS = ("model", "added", "parameter", "vine", "symbol", "unit", "value", "sigma", "low_95", "high_95")

MAX_FOLDS = 48  # Maximum number of folds of the cross-validation (chosen)

# Iterations of a fit without one condition, which starts near its minimum and converges in two or three (chosen)
MOST_ITERATIONS = 6


@dataclass(frozen=True)
class Errors:
    """Predictions of trials, and the reason for each trial that cannot be predicted, by name."""

    trials: tuple[TrialFit, ...]
    not_predicted: Mapping[str, str]

    @property
    def rms_m(self) -> float:
        """Root mean square position error in motion, with equal weight for every trial; NaN without trials."""
        squares = [float(np.mean(trial.residual_m[first_that_counts(trial) :] ** 2)) for trial in self.trials]
        return math.sqrt(float(np.mean(squares))) if squares else math.nan

    @cached_property
    def floor(self) -> tuple[float, float]:
        """Replicate floor over all conditions with replicates, and its standard error, m; NaN where none has any. Root
        of the mean variance of the conditions, weighted by their numbers of trials; the standard error of a variance s²
        of ν degrees of freedom is s²√(2/ν).
        """
        conditions = dict.fromkeys(trial.trial.condition for trial in self.trials)
        squares, counts, degrees = [], [], []
        for condition in conditions:
            members = [trial for trial in self.trials if trial.trial.condition == condition]
            alignment = align_replicates(members)
            if math.isfinite(alignment.floor_m):
                squares.append(alignment.floor_m**2)
                counts.append(len(members))
                degrees.append(alignment.degrees)
        if not squares:
            return math.nan, math.nan
        share = np.array(counts) / np.sum(counts)
        floor_m = math.sqrt(float(np.sum(share * squares)))
        error_m2 = math.sqrt(float(np.sum((share * squares) ** 2 * 2 / np.array(degrees))))
        return floor_m, error_m2 / (2 * floor_m) if floor_m > 0 else 0.0


def ladder(fits: Sequence[Fit], added: Sequence[str], partial: int = 0) -> pd.DataFrame:
    """Compute the errors of the initial model and of every enlarged one."""
    import pandas as pd

    rows: list[dict[str, object]] = []
    notes: list[str] = []
    for fit, name in zip(fits, added, strict=True):
        row, remarks = _ladder_row(fit, name)
        row["partial"] = len(rows) >= len(fits) - partial
        rows.append(row)
        notes += [note for note in remarks if note not in notes]
    table = pd.DataFrame(rows, columns=list(LADDER_COLUMNS))
    table.attrs["notes"] = notes
    return table


def _ladder_row(fit: Fit, added: str = "") -> tuple[dict[str, object], list[str]]:
    """The row of one model, and notes about trials that could not be predicted."""
    inside, outside, highest = in_sample(fit), left_out(fit), highest_pressure(fit)
    floor_m, floor_sigma_m = inside.floor
    row: dict[str, object] = {
        "model": "+".join(fit.model.names),
        "added": added,
        "rms_in_sample_m": inside.rms_m,
        "rms_left_out_m": outside.rms_m,
        "rms_highest_pressure_m": highest.rms_m,
        "floor_m": floor_m,
        "excess_left_out_m": excess(outside.rms_m, floor_m),
        "floor_sigma_m": floor_sigma_m,
    }
    return row, [*_notes("left-out conditions", outside), *_notes("the left-out highest pressure", highest)]


def excess(rms_m: float, floor_m: float) -> float:
    """√(rms² − floor²), 0 where the error is below the floor; NaN where there is no floor."""
    return math.sqrt(max(rms_m**2 - floor_m**2, 0.0)) if math.isfinite(rms_m + floor_m) else math.nan


def in_sample(fit: Fit) -> Errors:
    """Predictions of the trials that the model was fitted to."""
    return _predicted(fit, [as_recorded(trial_data) for trial_data in fit.predictor.data])


def left_out(fit: Fit) -> Errors:
    """Predictions of every condition by the model fitted to all others (cross-validation). Of more than `MAX_FOLDS`
    conditions several are left out at once, those of one vine spread over the folds.
    """
    vines = {trial.trial.condition: trial.trial.vine for trial in fit.trials}
    conditions = list(vines) if len(vines) <= MAX_FOLDS else sorted(vines, key=lambda name: vines[name])
    folds = [set(conditions[k::MAX_FOLDS]) for k in range(min(len(conditions), MAX_FOLDS))]
    return _combined([_held_out(fit, [trial.trial.condition in fold for trial in fit.trials]) for fold in folds])


def highest_pressure(fit: Fit) -> Errors:
    """Predictions of each vine's highest pressure by the model fitted to all lower ones."""
    highest: dict[str, float] = {}
    for trial_fit in fit.trials:
        trial = trial_fit.trial
        highest[trial.vine] = max(highest.get(trial.vine, -math.inf), trial.pressure_Pa)
    return _held_out(fit, [trial.trial.pressure_Pa >= highest[trial.trial.vine] for trial in fit.trials])


def _held_out(fit: Fit, gone: Sequence[bool]) -> Errors:
    """Predictions of the trials left out (`gone`) by the model fitted to the others."""
    data = [as_recorded(trial_data) for trial_data, out in zip(fit.predictor.data, gone, strict=True) if out]
    try:
        others = fit_subset(
            fit,
            [not out for out in gone],
            hold_spreads=True,
            hold_noise=True,
            most_iterations=MOST_ITERATIONS,
        )
    except FitError as error:
        return Errors((), {trial_data.trial.name: str(error) for trial_data in data})
    undetermined = {trial_data.trial.vine for trial_data in data} - {trial.trial.vine for trial in others.trials}
    undetermined = {vine for vine in undetermined if _has_own_parameters(fit, vine)}
    predictable = [trial_data for trial_data in data if trial_data.trial.vine not in undetermined]
    not_predicted = {
        trial_data.trial.name: f"no other condition of the vine {trial_data.trial.vine} determines its parameters"
        for trial_data in data
        if trial_data.trial.vine in undetermined
    }
    return _combined([_predicted(others, predictable), Errors((), not_predicted)])


def _predicted(fit: Fit, data: Sequence[FitTrial]) -> Errors:
    """Predictions of trials; where the simulation of a trial fails, the reason instead."""
    if not data:
        return Errors((), {})
    try:
        return Errors(tuple(predict_prepared(fit, data, from_rest=True)), {})
    except FitError as error:
        if len(data) == 1:
            return Errors((), {data[0].trial.name: str(error)})
        return _combined([_predicted(fit, [trial_data]) for trial_data in data])


def _has_own_parameters(fit: Fit, vine: str) -> bool:
    return any(number.vine == vine and number.key in fit.model.parameter_names for number in fit.numbers)


def _combined(parts: Sequence[Errors]) -> Errors:
    return Errors(
        tuple(trial for part in parts for trial in part.trials),
        {name: why for part in parts for name, why in part.not_predicted.items()},
    )


def _notes(what: str, errors: Errors) -> list[str]:
    reasons: dict[str, int] = {}
    for reason in errors.not_predicted.values():
        reasons[reason] = reasons.get(reason, 0) + 1
    return [
        f"The error on {what} is without {count} trial{'s' if count > 1 else ''}, unlike that in sample: {reason}"
        for reason, count in reasons.items()
    ]


def moved(fits: Sequence[Fit], added: Sequence[str]) -> pd.DataFrame:
    """Table of the parameters of every model of the ladder, columns `MOVED_COLUMNS`, SI."""
    import pandas as pd

    rows = [
        (
            "+".join(fit.model.names),
            name,
            number.key,
            number.vine,
            number.symbol,
            number.unit,
            number.value,
            number.sigma,
            number.low,
            number.high,
        )
        for fit, name in zip(fits, added, strict=True)
        for number in fit.numbers
    ]
    return pd.DataFrame(rows, columns=list(MOVED_COLUMNS))
