"""What repeated trials differ by: the floor that no model can go below.

Replicates are laid over each other with a release and an origin of their own, as a model is laid over a trial. What
then remains about their mean is nobody's to predict.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.inference.fit_result import TrialFit
from vinetrack.inference.left_out import FEWEST_AT_REST, told_apart
from vinetrack.tracks.position_noise import rest_points

TELLS_APART = 0.05
"""Of a shift in time and one in position, the least singular value by which both are found. Chosen: below, a shift in
time is one in position to 5 %."""

ALIGNMENTS = 5
"""Rounds of shifting every replicate onto their mean; each round leaves about a tenth of what the one before left."""


@dataclass(frozen=True)
class Replicates:
    """The trials of one condition on a common clock; shapes (n_trials, n_times), NaN where a trial says nothing.

    `time_s`, shape (n_times,), is since release. `residual_m` is measurement minus model; `deviation_m` that of a
    replicate from the mean of all that are there, each laid on that mean; `present`, shape (n_times,), counts them.
    `model_m`, shape (n_times,), is the model's growth, the longest of the trials'. `begin_s` is when the first of
    model and measurement moves: what counts begins there.
    """

    time_s: Floats
    model_m: Floats
    residual_m: Floats
    deviation_m: Floats
    present: Floats
    begin_s: float

    @property
    def mean_residual_m(self) -> Floats:
        """Mean of the replicates minus the model, shape (n_times,)."""
        return _mean(self.residual_m, self.present)

    @property
    def variance_m2(self) -> Floats:
        """Variance of single replicates, shape (n_times,), unbiased for their number; NaN with one alone."""
        square = np.where(np.isfinite(self.deviation_m), self.deviation_m, 0.0) ** 2
        return np.where(self.present > 1, square.sum(axis=0) / np.maximum(self.present - 1, 1), math.nan)

    @property
    def floor_m(self) -> float:
        """Root mean square of what a replicate differs by from the mean of infinitely many; NaN with one alone."""
        moving = (self.time_s >= self.begin_s) & (self.present > 1)
        if not moving.any():
            return math.nan
        return float(math.sqrt(np.average(self.variance_m2[moving], weights=self.present[moving])))


def replicates_of(trials: Sequence[TrialFit]) -> Replicates:
    """Lay the trials of one condition over each other.

    Every instant takes each trial's nearest frame, and only what is left beside the model is compared there: to
    interpolate positions would average their noise away.

    Parameters
    ----------
    trials
        Trials of one condition as a model predicts them, see `vinetrack.inference.fit.predict`.
    """
    longest = max(trials, key=lambda trial: trial.time_s[-1] - trial.release_s)
    frame_s = min(float(np.median(np.diff(trial.time_s))) for trial in trials)
    begin_s = min(trial.time_s[0] - trial.release_s for trial in trials)
    end_s = longest.time_s[-1] - longest.release_s
    time_s = begin_s + frame_s * np.arange(math.floor((end_s - begin_s) / frame_s + 1e-6) + 1)
    model_m = _growth(longest, time_s)
    own = np.array([_sampled(t, time_s, t.release_s, t.time_s, t.residual_m) for t in trials])
    deviation_m = _about_their_mean(trials, longest, time_s)
    begin_moving_s = min(float(trial.time_s[first_that_counts(trial)]) - trial.release_s for trial in trials)
    present = np.isfinite(own).sum(axis=0).astype(float)
    return Replicates(time_s, model_m, own, deviation_m, present, begin_moving_s - 1e-9)


def frames_at_rest(trial: TrialFit) -> int:
    """Frames before the motion; 0 where the track begins in motion."""
    count = rest_points(trial.lead_position_m)
    return count if count < trial.time_s.size else 0


def first_that_counts(trial: TrialFit) -> int:
    """The frame where the first of model and measurement begins to move: rest would only dilute an error."""
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


def _sampled(trial: TrialFit, at_s: Floats, release_s: float, time_s: Floats, values: Floats) -> Floats:
    """Values of the frames nearest to times since release, NaN where none is within one frame's spacing."""
    wanted = at_s + release_s
    k = np.clip(np.searchsorted(time_s, wanted), 1, time_s.size - 1)
    k -= wanted - time_s[k - 1] < time_s[k] - wanted
    spacing = float(np.median(np.diff(trial.time_s)))
    return np.where(np.abs(time_s[k] - wanted) <= 0.51 * spacing, values[k], math.nan)


def _about_their_mean(trials: Sequence[TrialFit], reference: TrialFit, time_s: Floats) -> Floats:
    """Deviation of each replicate from their mean, once a shift in time and one in position laid it there.

    Gauss and Newton's steps; the reference only stands for the shape that all share, and cancels.
    """
    speed_m_s = np.gradient(_growth(reference, time_s), time_s)
    release_s = np.array([trial.release_s for trial in trials])
    origin_m = np.array([trial.origin_m for trial in trials])
    at_rest = [frames_at_rest(trial) >= FEWEST_AT_REST for trial in trials]
    frames_s = np.array([float(np.median(np.diff(trial.time_s))) for trial in trials])
    deviation_m = np.full((len(trials), time_s.size), math.nan)
    for _ in range(ALIGNMENTS):
        left_m = np.array(
            [
                _sampled(
                    trial,
                    time_s,
                    release_s[i],
                    trial.time_s,
                    trial.lead_position_m - origin_m[i] - _growth(reference, trial.time_s - release_s[i]),
                )
                for i, trial in enumerate(trials)
            ]
        )
        present = np.isfinite(left_m).sum(axis=0)
        deviation_m = np.where(present > 1, left_m - _mean(left_m, present), math.nan)
        for i in range(len(trials)):
            use = np.isfinite(deviation_m[i])
            if np.count_nonzero(use) > 2:
                free = 0.0 if at_rest[i] else 1.0
                design = np.column_stack([-speed_m_s[use], np.full(np.count_nonzero(use), free)])
                later_s, higher_m = told_apart(design, deviation_m[i, use], TELLS_APART)
                release_s[i] += np.clip(later_s, -2 * frames_s[i], 2 * frames_s[i])
                origin_m[i] += higher_m
    return deviation_m


def _mean(values: Floats, present: Floats) -> Floats:
    total = np.where(np.isfinite(values), values, 0.0).sum(axis=0)
    return np.where(present > 0, total / np.maximum(present, 1), math.nan)
