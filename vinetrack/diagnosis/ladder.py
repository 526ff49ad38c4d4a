"""The ladder of errors: what every added effect did to them, in sample and on what a model had not seen.

All errors are those of `vinetrack.diagnosis.compare`: a trial has a release and an origin of its own and nothing else,
the origin is where the vine was seen at rest, and every trial counts alike. They differ only in what the model was
fitted to: to everything; to everything but the condition that is predicted, each in turn; to everything but the
highest pressure of each vine. The floor is what replicates differ by. Where it is most of the error, the error itself
hardly falls when the model gets better: the excess √(rms² − floor²) does.
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

MAX_FOLDS = 48
"""Parts in which conditions are left out at most; of more conditions several are left out at once, so that the time
grows as the number of trials alone and not as that times the number of conditions. Chosen: the fit still sees 98 % of
the conditions; at half 96 %, at twice the time of this step doubles."""

MOST_ITERATIONS = 6
"""A fit without one condition begins beside its end, and settles in two or three. Chosen."""


@dataclass(frozen=True)
class Errors:
    """Predictions of trials, and for those that cannot be predicted the reason, by name of trial."""

    trials: tuple[TrialFit, ...]
    not_predicted: Mapping[str, str]

    @property
    def rms_m(self) -> float:
        """Root mean square of the position errors while something moves, every trial alike; NaN where there is none."""
        squares = [float(np.mean(trial.residual_m[first_that_counts(trial) :] ** 2)) for trial in self.trials]
        return math.sqrt(float(np.mean(squares))) if squares else math.nan

    @cached_property
    def floor(self) -> tuple[float, float]:
        """What replicates differ by, over all conditions that have any, and its standard error, m; NaN where none has.

        Mean of the conditions' variances weighted by their numbers of trials; the error of a variance s² of ν degrees
        of freedom is s²√(2/ν).
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
    """Errors of the model that the user came with and of every one after it.

    Parameters
    ----------
    fits : fits of the models in order, all to the same trials.
    added : what each added to the one before; blank for the first.
    partial : how many of the last are steps that mend a part of what nothing mends in full.

    Returns
    -------
    DataFrame
        A row a model, columns `LADDER_COLUMNS`. `attrs["notes"]` holds sentences about what could not be predicted.

    Raises
    ------
    FitError
        If a model cannot be followed.
    """
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
    """The row of one model, and sentences about what could not be predicted."""
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
    """√(rms² − floor²), 0 where the error is below the floor; NaN where there is no floor.

    Parameters
    ----------
    rms_m, floor_m : float, m
        Error and what replicates differ by.

    Returns
    -------
    float, m
    """
    return math.sqrt(max(rms_m**2 - floor_m**2, 0.0)) if math.isfinite(rms_m + floor_m) else math.nan


def in_sample(fit: Fit) -> Errors:
    """Predictions of the trials that the model was fitted to.

    Parameters
    ----------
    fit
        A fitted model.

    Returns
    -------
    Errors
    """
    return _predicted(fit, [as_recorded(trial_data) for trial_data in fit.predictor.data])


def left_out(fit: Fit) -> Errors:
    """Predictions of every condition by the model fitted to all the others.

    Of more than `MAX_FOLDS` conditions several are left out at once, those of one vine as far apart as it goes.

    Parameters
    ----------
    fit
        A fitted model.

    Returns
    -------
    Errors
    """
    vines = {trial.trial.condition: trial.trial.vine for trial in fit.trials}
    conditions = list(vines) if len(vines) <= MAX_FOLDS else sorted(vines, key=lambda name: vines[name])
    parts = [set(conditions[k::MAX_FOLDS]) for k in range(min(len(conditions), MAX_FOLDS))]
    return _together([_without(fit, [trial.trial.condition in part for trial in fit.trials]) for part in parts])


def highest_pressure(fit: Fit) -> Errors:
    """Predictions of each vine's highest pressure by the model fitted to all lower ones.

    Parameters
    ----------
    fit
        A fitted model.

    Returns
    -------
    Errors
    """
    highest: dict[str, float] = {}
    for trial_fit in fit.trials:
        trial = trial_fit.trial
        highest[trial.vine] = max(highest.get(trial.vine, -math.inf), trial.pressure_Pa)
    return _without(fit, [trial.trial.pressure_Pa >= highest[trial.trial.vine] for trial in fit.trials])


def _without(fit: Fit, gone: Sequence[bool]) -> Errors:
    """Predictions of the trials that are `gone` by the model fitted to the rest."""
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
    alone = {trial_data.trial.vine for trial_data in data} - {trial.trial.vine for trial in others.trials}
    alone = {vine for vine in alone if _has_numbers_of_its_own(fit, vine)}
    known = [trial_data for trial_data in data if trial_data.trial.vine not in alone]
    left = {
        trial_data.trial.name: f"no other condition of the vine {trial_data.trial.vine} says what its numbers are"
        for trial_data in data
        if trial_data.trial.vine in alone
    }
    return _together([_predicted(others, known), Errors((), left)])


def _predicted(fit: Fit, data: Sequence[FitTrial]) -> Errors:
    """Predictions of trials; those that the model cannot be followed for are left without one, by their reason."""
    if not data:
        return Errors((), {})
    try:
        return Errors(tuple(predict_prepared(fit, data, from_rest=True)), {})
    except FitError as error:
        if len(data) == 1:
            return Errors((), {data[0].trial.name: str(error)})
        return _together([_predicted(fit, [trial_data]) for trial_data in data])


def _has_numbers_of_its_own(fit: Fit, vine: str) -> bool:
    return any(number.vine == vine and number.key in fit.model.parameter_names for number in fit.numbers)


def _together(parts: Sequence[Errors]) -> Errors:
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
    """How the numbers moved along the ladder: a row a number of each model, columns `MOVED_COLUMNS`, SI.

    Parameters
    ----------
    fits : sequence of Fit
        One a step of the ladder.
    added : sequence of str
        What each step added; blank for the first.

    Returns
    -------
    DataFrame
    """
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
