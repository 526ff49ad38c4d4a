"""Results of a diagnosis that contradict its verdict: errors on left-out conditions, and drifting parameters.

The verdict rests on likelihoods. Two results are independent of it: how well left-out conditions are predicted, and
whether the best parameter values of single trials are the same under every condition. Where they disagree with the
verdict, notes report it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from vinetrack.diagnosis.drift import drift
from vinetrack.diagnosis.ladder import left_out
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.inference.fit_data import FitError
from vinetrack.inference.fit_result import Fit

if TYPE_CHECKING:
    import pandas as pd

CONTRADICTING_DRIFT_SIGMAS = 4.0  # Significance of a drift from which it contradicts an adequate model (chosen)


def displacement_m(before: Fit, after: Fit) -> float:
    """Root mean square displacement of the predicted positions by an added effect. Returns over trials, of the largest
    difference of predicted positions, each fit with its own release and origin, m.
    """
    moved = [
        float(np.max(np.abs(trial.predicted_position_m - later.predicted_position_m)))
        for trial, later in zip(before.trials, after.trials, strict=True)
    ]
    return float(np.sqrt(np.mean(np.square(moved))))


def is_within_position_errors(before: Fit, after: Fit) -> bool:
    """Whether an effect moves positions by less than their systematic error and does not improve left-out predictions.
    Such a gain in likelihood may be lens distortion. The left-out error is computed only for so small a displacement.
    """
    systematic_m = float(np.median([trial_data.position_systematic_m for trial_data in before.predictor.data]))
    if not displacement_m(before, after) < systematic_m:
        return False
    try:
        without_m, with_m = left_out(before).rms_m, left_out(after).rms_m
    except (FitError, SimulationError, np.linalg.LinAlgError):
        return False
    return math.isfinite(without_m + with_m) and with_m >= without_m


def contradictions(fits: Sequence[Fit], added: Sequence[str], ladder: pd.DataFrame | None) -> tuple[str, ...]:
    """List the results that contradict the final model of a diagnosis where the verdict calls it adequate. Returns
    sentences; empty where nothing contradicts the verdict.
    """
    return (*_not_better(added, ladder), *_still_drifts(fits[-1]))


def _not_better(added: Sequence[str], ladder: pd.DataFrame | None) -> Iterator[str]:
    if ladder is None:
        return
    errors_m = [float(value) for value in ladder["rms_left_out_m"]]
    for name, without_m, with_m in zip(added, errors_m, errors_m[1:], strict=False):
        if math.isfinite(without_m + with_m) and with_m >= without_m:
            yield (
                f"The error on left-out conditions does not fall with {name}: {without_m * 1e3:.2f} mm without "
                f"it, {with_m * 1e3:.2f} mm with it. The data support {name} by the shape of the motion alone."
            )


def _still_drifts(fit: Fit) -> Iterator[str]:
    try:
        result = drift(fit)
    except (FitError, SimulationError, np.linalg.LinAlgError):
        return
    table = result.table
    sure = table[table["significant"] & (np.maximum(table["z"], table["z_constancy"]) > CONTRADICTING_DRIFT_SIGMAS)]
    model = " + ".join(fit.model.names)
    yield from (f"With {model}: {line}" for line in sure.drop_duplicates(["parameter", "against"])["sentence"])
