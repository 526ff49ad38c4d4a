"""Replicates of one condition: laid over each other, what they differ by, and a model beside them.

Every trial of a condition has a release of its own, and an origin where its rest was not filmed, not even behind a
door; those two are what a model may shift too. They are found by Gauss–Newton steps towards the mean of all until
nothing moves. No model enters, so the same recordings differ by the same amount whatever model they are compared with:
the floor that no model can go below.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.inference.fit_result import TrialFit
from vinetrack.inference.left_out import FEWEST_AT_REST, scaled_least_squares
from vinetrack.tracks.outliers import FEWEST_POINTS, local_fit
from vinetrack.tracks.position_noise import rest_points, rough_noise

MIN_SINGULAR_VALUE = 0.05
"""Of a shift in time and one in position, the least singular value by which both are found. Chosen: below it the motion
is so straight that a shift in time and one in position are one; at half noise drives both, at twice curved motions are
left misaligned."""

MAX_ROUNDS = 200
"""Rounds of shifting every replicate onto their mean. A round moves a trial by two frames at most, so that this covers
400 frames; it ends when nothing moves. Chosen as a safeguard; most conditions settle within twenty."""

SETTLED_FRAMES = 1e-3
"""Part of a frame by which the largest shift of a round still counts: of a step of 3 mm it is 3 µm. Chosen: far below
the noise of any tracker."""

LARGEST_STEP_FRAMES = 2.0
"""Of a round: farther away the motion's speed is another. Chosen: at half alignment takes twice as many rounds, at
twice it may overshoot a steep start."""

LEAST_OVERLAP = 0.8
"""Part of the shorter motion in which it must lie beside the longer one, where no rest says when it began. Motions of
different speed agree best where they hardly overlap: without this, replicates that differ by 14 % in speed were slid
apart until the 10 mm in which they were equally fast gave a floor of 0.05 mm. Chosen: tracks that begin in motion begin
within a fifth of their length of each other; at 0.6 the floor may be half too small, at 0.9 a clip begun late is
misaligned."""

COARSE_SHIFTS = 201
"""Shifts in time that are tried for a track that begins in motion. Chosen: steps of a hundredth of the duration, which
the rounds then refine."""


@dataclass(frozen=True)
class Alignment:
    """Replicates on a common clock.

    `time_s`, shape (n_times,), is since the mean release; `deviation_m`, shape (n_trials, n_times), that of each trial
    from the mean of all that are there, NaN where it says nothing; `present`, shape (n_times,), counts them.
    `release_s` and `origin_m`, shape (n_trials,), lay the trials there. `begin_s` is when the first one moves.
    """

    time_s: Floats
    deviation_m: Floats
    present: Floats
    release_s: Floats
    origin_m: Floats
    begin_s: float

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

    @property
    def degrees(self) -> int:
        """Degrees of freedom of the floor: one for each replicate beyond the first.

        Replicates differ slowly along the whole motion, by pressure and B: a trial counts once, however many frames.
        """
        return self.release_s.size - 1

    @property
    def floor_sigma_m(self) -> float:
        """Standard error of the floor, m: σ/√(2ν) for a variance of ν degrees of freedom; NaN with one alone."""
        return self.floor_m / math.sqrt(2 * self.degrees) if self.degrees > 0 else math.nan


@dataclass(frozen=True)
class _Reference:
    """The motion of one replicate, smoothed: the shape that all share, which cancels from their differences."""

    since_s: Floats
    growth_m: Floats

    def at(self, since_s: Floats) -> Floats:
        """Growth at times since release; straight on beyond the ends."""
        inside = np.interp(since_s, self.since_s, self.growth_m)
        slopes = [self._slope(slice(0, 5)), self._slope(slice(-5, None))]
        before, after = np.minimum(since_s - self.since_s[0], 0.0), np.maximum(since_s - self.since_s[-1], 0.0)
        return np.asarray(inside + slopes[0] * before + slopes[1] * after)

    def _slope(self, part: slice) -> float:
        t, y = self.since_s[part], self.growth_m[part]
        return float((y[-1] - y[0]) / (t[-1] - t[0]))


def frames_at_rest(trial: TrialFit) -> int:
    """Frames before the motion; 0 where the track begins in motion.

    Parameters
    ----------
    trial
        A trial under the model.

    Returns
    -------
    int
    """
    count = rest_points(trial.lead_position_m)
    return count if count < trial.time_s.size else 0


def align_replicates(trials: Sequence[TrialFit]) -> Alignment:
    """Lay the measured motions of one condition over each other.

    Parameters
    ----------
    trials : sequence of TrialFit
        Trials of one condition; only their times and measured positions are read.

    Returns
    -------
    Alignment
    """
    rests = [frames_at_rest(trial) for trial in trials]
    release_s, origin_m = (np.array(values) for values in zip(*map(_begin, trials, rests), strict=True))
    seen = np.array([n > 0 or trial.imprecise_rest is not None for trial, n in zip(trials, rests, strict=True)])
    longest = int(np.argmax([trial.time_s[-1] - at for trial, at in zip(trials, release_s, strict=True)]))
    reference = _reference(trials[longest], float(release_s[longest]), float(origin_m[longest]))
    for i, trial in enumerate(trials):
        if i != longest and not (seen[i] and seen[longest]):
            release_s[i], origin_m[i] = _coarse(trial, reference)
    frame_s = np.array([float(np.median(np.diff(trial.time_s))) for trial in trials])
    begin_s = min(trial.time_s[0] - at for trial, at in zip(trials, release_s, strict=True))
    end_s = float(reference.since_s[-1])
    time_s = begin_s + frame_s.min() * np.arange(math.floor((end_s - begin_s) / frame_s.min() + 1e-6) + 1)
    speed_m_s = np.gradient(reference.at(time_s), time_s)
    at_rest = np.array(
        [n >= FEWEST_AT_REST or trial.imprecise_rest is not None for trial, n in zip(trials, rests, strict=True)]
    )
    earliest_s, latest_s = np.array([_within_reach(trial, reference) for trial in trials]).T
    for _ in range(MAX_ROUNDS):
        deviation_m, present = _deviations(trials, reference, time_s, release_s, origin_m)
        later_s, higher_m = _shifts(deviation_m, speed_m_s, at_rest)
        later_s = np.clip(later_s, -LARGEST_STEP_FRAMES * frame_s, LARGEST_STEP_FRAMES * frame_s)
        # Only differences of releases matter: all together would run away from the clock of the reference.
        later_s -= later_s.mean()
        moved_s = np.where(seen, release_s + later_s, np.clip(release_s + later_s, earliest_s, latest_s))
        later_s, release_s, origin_m = moved_s - release_s, moved_s, origin_m + higher_m
        if np.all(np.abs(later_s) < SETTLED_FRAMES * frame_s):
            break
    deviation_m, present = _deviations(trials, reference, time_s, release_s, origin_m)
    moves_s = min(_begin(trial, n)[0] - at for trial, n, at in zip(trials, rests, release_s, strict=True))
    return Alignment(time_s, deviation_m, present.astype(float), release_s, origin_m, moves_s - 1e-9)


def sampled(at_s: Floats, release_s: float, time_s: Floats, values: Floats) -> Floats:
    """Values of the frames nearest to times since release, NaN where none is within one frame's spacing.

    To interpolate positions would average their noise away.

    Parameters
    ----------
    at_s : array, shape (n,), s
        Times since release.
    release_s : float, s
        Release on the clock of `time_s`.
    time_s : array, shape (n_points,), s
        Rising.
    values : array, shape (n_points,)

    Returns
    -------
    array, shape (n,)
    """
    wanted = at_s + release_s
    k = np.clip(np.searchsorted(time_s, wanted), 1, time_s.size - 1)
    k -= wanted - time_s[k - 1] < time_s[k] - wanted
    spacing = float(np.median(np.diff(time_s)))
    return np.where(np.abs(time_s[k] - wanted) <= 0.51 * spacing, values[k], math.nan)


def _reference(trial: TrialFit, release_s: float, origin_m: float) -> _Reference:
    """A trial's motion freed of most of its noise by the cubic through each point's neighbours."""
    y = trial.lead_position_m
    if y.size >= FEWEST_POINTS:
        y = y - local_fit(trial.time_s, y, rough_noise(y)).residual_m
    return _Reference(trial.time_s - release_s, y - origin_m)


def _begin(trial: TrialFit, n_rest: int) -> tuple[float, float]:
    """When a trial begins to move, s, and from where, m, by its rest; its first frame where no rest was seen."""
    if n_rest == 0 and trial.imprecise_rest is not None:
        return trial.imprecise_rest.release_s, trial.imprecise_rest.origin_m
    return float(trial.time_s[max(n_rest - 1, 0)]), float(np.mean(trial.lead_position_m[: max(n_rest, 1)]))


def _within_reach(trial: TrialFit, reference: _Reference) -> tuple[float, float]:
    """Earliest and latest release, s, with which a trial lies beside enough of the reference."""
    first_s, last_s = float(trial.time_s[0]), float(trial.time_s[-1])
    begin_s, end_s = float(reference.since_s[0]), float(reference.since_s[-1])
    needed_s = LEAST_OVERLAP * min(last_s - first_s, end_s - begin_s)
    return needed_s + first_s - end_s, last_s - begin_s - needed_s


def _coarse(trial: TrialFit, reference: _Reference) -> tuple[float, float]:
    """Release and origin of a track that begins in motion, from where its shape lies nearest to the reference."""
    tried_s = np.linspace(*_within_reach(trial, reference), COARSE_SHIFTS)
    left = np.array([trial.lead_position_m - reference.at(trial.time_s - at) for at in tried_s])
    best = int(np.argmin(left.std(axis=1)))
    return float(tried_s[best]), float(left[best].mean())


def _deviations(
    trials: Sequence[TrialFit], reference: _Reference, time_s: Floats, release_s: Floats, origin_m: Floats
) -> tuple[Floats, Floats]:
    """Deviation of each trial from the mean at every instant, and how many trials are there.

    Only what is left beside the reference is compared: between frames the motion itself would count as a difference.
    """
    left_m = np.array(
        [
            sampled(
                time_s,
                release_s[i],
                trial.time_s,
                trial.lead_position_m - origin_m[i] - reference.at(trial.time_s - release_s[i]),
            )
            for i, trial in enumerate(trials)
        ]
    )
    present = np.isfinite(left_m).sum(axis=0)
    return np.where(present > 1, left_m - mean_of(left_m, present), math.nan), present


def _shifts(deviation_m: Floats, speed_m_s: Floats, at_rest: Floats) -> tuple[Floats, Floats]:
    """How much later each trial was released, s, and how much higher it lies, m; 0 where its rest tells that."""
    shifts = np.zeros((2, len(deviation_m)))
    for i, left_m in enumerate(deviation_m):
        use = np.isfinite(left_m)
        if np.count_nonzero(use) > 2:
            free = 0.0 if at_rest[i] else 1.0
            design = np.column_stack([-speed_m_s[use], np.full(np.count_nonzero(use), free)])
            shifts[:, i] = scaled_least_squares(design, left_m[use], MIN_SINGULAR_VALUE)
    return shifts[0], shifts[1]


def mean_of(values: Floats, present: Floats) -> Floats:
    """Mean over trials of shape (n_trials, n_times) where they are present, NaN where none is.

    Parameters
    ----------
    values : array, shape (n_trials, n_times)
        NaN where a trial is absent.
    present : array, shape (n_times,)
        Trials that are there.

    Returns
    -------
    array, shape (n_times,)
    """
    total = np.where(np.isfinite(values), values, 0.0).sum(axis=0)
    return np.where(present > 0, total / np.maximum(present, 1), math.nan)


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
        A trial under the model.

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
