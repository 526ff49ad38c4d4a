"""What speaks against a verdict among the other results of the same diagnosis: ladder of errors, drift of parameters.

A verdict rests on likelihoods. Two results are worked out independently of it: how well conditions are predicted that
a model had not seen, and whether single trials ask for the same numbers under every condition. Where they disagree with
the verdict a reader must see that beside it.
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

CONTRADICTING_DRIFT_SIGMAS = 4.0
"""Standard deviations of a drift that contradicts an adequate model. Chosen: `drift` calls any at 1 % a campaign, which
is too often for a sentence that doubts the verdict; 4 is 0.006 % a test, a quarter of a per cent for 40 tests. At half
one campaign in two would carry a doubt, at twice n that differs by 7 σ between vines would go unmentioned."""


def displacement_m(before: Fit, after: Fit) -> float:
    """Find how far an added effect moves the predicted positions.

    Parameters
    ----------
    before, after : fits to the same trials without and with the effect.

    Returns
    -------
    float
        Root mean square over trials of the largest difference of predicted positions, release and origin of each fit
        its own, m.
    """
    moved = [
        float(np.max(np.abs(trial.predicted_position_m - later.predicted_position_m)))
        for trial, later in zip(before.trials, after.trials, strict=True)
    ]
    return float(np.sqrt(np.mean(np.square(moved))))


def is_within_position_errors(before: Fit, after: Fit) -> bool:
    """Whether an effect moves positions by less than their systematic errors and predicts no new condition better.

    Such a gain in likelihood may be a lens. Only where the displacement is that small is the left-out error worked out.

    Parameters
    ----------
    before, after : fits to the same trials without and with the effect.

    Returns
    -------
    bool
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
    """Say what speaks against the model that a diagnosis ended with, where it calls that adequate.

    Parameters
    ----------
    fits : the first model and every one after it.
    added : the effects added, in order.
    ladder : table of errors with a row a model, see `vinetrack.diagnosis.ladder`; None where it was not made.

    Returns
    -------
    tuple of str
        Sentences; empty where everything agrees.
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
