"""A model beside the replicates of one condition, and what these differ by: the floor that no model can go below.

The floor comes from the measurements alone (`vinetrack.diagnosis.replicate_alignment`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.diagnosis.replicate_alignment import Alignment, align_replicates, frames_at_rest, mean_of, sampled
from vinetrack.inference.fit_result import TrialFit


@dataclass(frozen=True)
class Replicates:
    """The trials of one condition on a common clock; shapes (n_trials, n_times), NaN where a trial says nothing.

    `time_s`, shape (n_times,), is since release. `residual_m` is measurement minus model; `present`, shape (n_times,),
    counts the trials. `model_m`, shape (n_times,), is the model's growth, the longest of the trials'. `begin_s` is when
    the first of model and measurement moves: what counts begins there. `variance_m2`, shape (n_times,), is that of
    single replicates, and `alignment` what they differ by, both from the measurements alone.
    """

    time_s: Floats
    model_m: Floats
    residual_m: Floats
    present: Floats
    begin_s: float
    variance_m2: Floats
    alignment: Alignment

    @property
    def mean_residual_m(self) -> Floats:
        """Mean of the replicates minus the model, shape (n_times,)."""
        return mean_of(self.residual_m, self.present)


def replicates_of(trials: Sequence[TrialFit]) -> Replicates:
    """Lay the trials of one condition over each other.

    Every instant takes each trial's nearest frame, and only what is left beside the model is compared there: to
    interpolate positions would average their noise away.

    Parameters
    ----------
    trials : sequence of TrialFit
        Trials of one condition as a model predicts them, see `vinetrack.inference.fit.predict`.

    Returns
    -------
    Replicates
    """
    longest = max(trials, key=lambda trial: trial.time_s[-1] - trial.release_s)
    frame_s = min(float(np.median(np.diff(trial.time_s))) for trial in trials)
    begin_s = min(trial.time_s[0] - trial.release_s for trial in trials)
    end_s = longest.time_s[-1] - longest.release_s
    time_s = begin_s + frame_s * np.arange(math.floor((end_s - begin_s) / frame_s + 1e-6) + 1)
    model_m = _growth(longest, time_s)
    residuals_m = np.array([sampled(time_s, t.release_s, t.time_s, t.residual_m) for t in trials])
    alignment = align_replicates(trials)
    # The two clocks differ by what the releases do on average, which the mean of the replicates cannot tell.
    shift_s = float(np.mean(alignment.release_s - [trial.release_s for trial in trials]))
    variance_m2 = sampled(time_s, 0.0, alignment.time_s + shift_s, alignment.variance_m2)
    begin_moving_s = min(float(trial.time_s[first_that_counts(trial)]) - trial.release_s for trial in trials)
    present = np.isfinite(residuals_m).sum(axis=0).astype(float)
    return Replicates(time_s, model_m, residuals_m, present, begin_moving_s - 1e-9, variance_m2, alignment)


def first_that_counts(trial: TrialFit) -> int:
    """The frame where the first of model and measurement begins to move: rest would only dilute an error.

    Parameters
    ----------
    trial

    Returns
    -------
    int
    """
    released = int(np.searchsorted(trial.time_s, trial.release_s))
    # A pressure that is only let in moves nothing yet.
    moved = np.flatnonzero(trial.predicted_position_m > trial.origin_m)
    released = max(released, int(moved[0]) if moved.size else trial.time_s.size)
    return min(released, max(frames_at_rest(trial) - 1, 0), trial.time_s.size - 1)


def _growth(trial: TrialFit, since_release_s: Floats) -> Floats:
    """The model's growth at times since release; what lies beyond the trial's frames holds its ends."""
    from scipy.interpolate import PchipInterpolator

    t = trial.time_s - trial.release_s
    curve = PchipInterpolator(t, trial.predicted_position_m - trial.origin_m)
    return np.asarray(curve(np.clip(since_release_s, t[0], t[-1])))
