"""Trials beside their replicates and their sheet: odd rows, lost frames, the scatter of replicates.

Every trial has its own release, and its own origin where no standstill was filmed; a model is laid on each by the same
two (`vinetrack.inference.fit.predict_prepared`). What then distinguishes replicates is their scatter, the floor below
which no model can fall. Two trials of a condition tell little about it, all of them together tell by what multiple of a
typical scatter of pressure and of B they differ; the sensitivities of the trajectories spread it over the conditions.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.problems import remark
from vinetrack.core.records import Floats, Trial, with_flag
from vinetrack.core.units import GRAVITY_M_S2
from vinetrack.diagnosis.result import (
    ARTEFACT,
    DROPPED_FRAMES,
    EXPECTED,
    Diagnosis,
)
from vinetrack.inference.fit import aligned_to_trials, rest_is_seen
from vinetrack.inference.fit_data import FitTrial, Pairs
from vinetrack.inference.fit_result import Fit, TrialFit
from vinetrack.inference.optimiser import TYPICAL_SPREADS
from vinetrack.inference.sensitivity import DAMPING_DEVIATION, ORIGIN, PRESSURE, RELEASE, Predictor, middle_speed
from vinetrack.tracks.frame_timing import frames_surely_missing
from vinetrack.tracks.position_noise import rest_points

if TYPE_CHECKING:
    import pandas as pd

# ------------------------------------------------------------------------------
# Outlying trials: a row of the sheet that belongs to another recording, or a typing error.
#
# One such trial among thirty causes a misfit that no effect explains: it is left out and named. Outliers are detected
# without the model that failed: over the middle of the growth damping roughly balances the force,
#
#     ln F_j = ln B_vine + n ln v_j + c (ln v_j)²,    F = (P − P_y) A + r m̄ g cos θ
#
# with a curvature c for a force of another power of speed. The residual of a trial from a robust fit of these curves is
# compared with the residuals of the others. An effect that the model lacks changes all trials of a condition alike; a
# pressure with its digits swapped does not.

CHANCE = 1e-4  # Probability that normal scatter makes any trial of a campaign an outlier (chosen)
FEWEST_TRIALS = 8  # Number of trials from which outliers are looked for (chosen)


@dataclass(frozen=True)
class OddTrial:
    """An outlying trial, with its stated pressure and the pressure that its motion implies, Pa, and the unit of the
    sheet. `implied_pressure_Pa` is NaN where it is not known.
    """

    name: str
    stated_Pa: float
    implied_pressure_Pa: float
    unit: str = "kPa"


def odd_trials(data: Sequence[FitTrial]) -> list[OddTrial]:
    """Find trials whose speed contradicts the sheet although the other trials agree with it."""
    from scipy.optimize import least_squares
    from scipy.stats import t as student

    trials = [trial_data.trial for trial_data in data]
    if len(data) < FEWEST_TRIALS or any(trial.travel_ratio != 2 for trial in trials):
        return []
    stated_Pa = [trial_data.typical_pressure_Pa for trial_data in data]
    force_N = np.array([_force_N(*pair) for pair in zip(trials, stated_Pa, strict=True)])
    of_vine = np.array([trial.vine for trial in trials])
    vines = np.unique(of_vine)
    # 2: slope and curvature of the fitted curves, common to all vines, besides a level for each vine (derived)
    remaining = len(data) - vines.size - 2
    if remaining < 1:
        return []
    # A trial that its stated force could not move lies far off every curve.
    log_force = np.log(np.maximum(force_N, 1e-9))
    log_speed = np.log([middle_speed(trial_data) for trial_data in data])
    log_speed -= np.median(log_speed)
    curves = np.column_stack([*(of_vine == vine for vine in vines), log_speed, log_speed**2])
    usual_exponent = 0.37  # Starting value of the exponent (PHYSICS)
    straight = log_force - usual_exponent * log_speed
    levels = [float(np.median(straight[of_vine == vine])) for vine in vines]
    # 0.05: residual of ln F at which the robust fit (Cauchy loss) halves the weight of a trial (chosen)
    fitted = least_squares(
        lambda values: log_force - curves @ values, [*levels, usual_exponent, 0.0], loss="cauchy", f_scale=0.05
    )
    residual = log_force - curves @ fitted.x
    # Fitted curves follow the trials: the scatter about them is smaller by the degrees of freedom that they take.
    median_deviation = float(np.median(np.abs(residual))) / 0.6745
    # 0.02: lower limit of the scatter of ln F: the scatter of careful trials (chosen)
    scatter = max(median_deviation * math.sqrt(len(data) / remaining), 0.02)
    # 0.37, 1.0: efficiency of a standard deviation from the median absolute deviation, relative to that from the
    # mean square, and degrees of freedom added to so many times those that the fitted curves leave (derived)
    allowed = scatter * float(student.isf(CHANCE / (2 * len(data)), max(0.37 * remaining + 1.0, 3.0)))
    replicates = [[j for j, other in enumerate(trials) if other.condition == trial.condition and j != k]
             for k, trial in enumerate(trials)]  # fmt: skip
    # Where a replicate deviates as much, the cause is physics of the condition.
    odd = [
        k
        for k in np.flatnonzero(np.abs(residual) > allowed).tolist()
        if all(abs(residual[j]) < allowed < abs(residual[k] - residual[j]) for j in replicates[k])
    ]
    # 0.125: the largest fraction that may be outliers (chosen)
    if len(odd) > max(2, int(0.125 * len(data))):
        return []
    lacking_Pa = [(np.exp(curves[k] @ fitted.x) - force_N[k]) / trials[k].area_m2 for k in odd]
    return [
        OddTrial(trials[k].name, stated_Pa[k], stated_Pa[k] + float(lacks), trials[k].pressure_unit)
        for k, lacks in zip(odd, lacking_Pa, strict=True)
    ]


def _force_N(trial: Trial, pressure_Pa: float) -> float:
    """Twice the driving force on the tip: pressure above the yield pressure, and weight; as in `kinematics.force`."""
    middle_m = np.array([0.25 * np.nan_to_num(trial.length_m)])
    mass_kg = float(np.nan_to_num(trial.moving_mass_kg(middle_m))[0])
    weight_N = trial.travel_ratio * mass_kg * GRAVITY_M_S2 * math.cos(trial.growth_angle_rad)
    return (pressure_Pa - float(np.nan_to_num(trial.yield_pressure_Pa))) * trial.area_m2 + weight_N


# ------------------------------------------------------------------------------
# Recordings with dropped frames: their times are corrected, and dropped frames beyond doubt become the verdict.


def lost_frames(pairs: Pairs) -> dict[str, bool]:
    """Trials whose times were corrected for dropped frames, each with whether it has dropped some for certain."""
    return {
        trial.name: frames_surely_missing(track) for trial, track in pairs if with_flag(track.flag, "retimed").any()
    }


def with_lost_frames(result: Diagnosis, lost: Mapping[str, bool]) -> Diagnosis:
    """Put certain dropped frames first in a diagnosis, and its verdict with corrected times into a note. A jump that a
    few outlying points may have caused becomes a note only.
    """
    if not lost:
        return result
    if not any(lost.values()):
        return replace(result, notes=(*result.notes, remark("frames_perhaps_missing", trials=tuple(lost))))
    note = remark("with_corrected_times", verdict=result.verdict, explanation=result.explanation)
    words = str(remark("frames_missing", trials=tuple(lost)))
    nothing: dict[str, Any] = {"fits": {}, "sets": (), "partial": (), "partial_fits": ()}
    only = replace(result.rounds[0], explanation=words, verdict=ARTEFACT, answer_set=(DROPPED_FRAMES,), **nothing)
    alone = replace(result, rounds=(only,), effects=(), explanation=words, fits=result.fits[:1])
    return replace(alone, notes=(note,), odd_trials=())


# ------------------------------------------------------------------------------
# The trials of one condition, each laid on the model by its own release and origin.


def within_groups(
    values: Floats, groups: Sequence[str] | NDArray[np.str_], weight: Floats | float = 1.0
) -> tuple[Floats, int]:
    """Deviations from the weighted mean of each group, and their degrees of freedom. Shapes: values (n, …)."""
    names, group = np.unique(groups, return_inverse=True)
    shares = np.where(group == np.arange(names.size)[:, None], weight, 0.0)
    means = (shares / shares.sum(axis=1, keepdims=True)) @ values
    return np.asarray(values - means[group]), len(group) - names.size


@dataclass(frozen=True)
class Replicates:
    """Trials of one condition: all `frames`, since release and from the origin, with the mean of the replicates then
    and their standard deviation; and the mean and variance of the residuals, measurement minus model, at `instants` one
    frame apart, with the number of trials present and whether any of them has begun to move.
    """

    trials: Sequence[TrialFit]
    frames: pd.DataFrame
    instants: pd.DataFrame

    @property
    def floor_m(self) -> float:
        """Replicate floor: rms deviation of a replicate from the mean of infinitely many; NaN for one trial alone."""
        use = self.instants[self.instants["moves"] & (self.instants["present"] > 1)]
        return math.sqrt(np.average(use["variance_m2"], weights=use["present"])) if len(use) else math.nan


def replicates_of(trials: Sequence[TrialFit]) -> Replicates:
    """Residuals of a model for the trials of one condition at common times. A frame counts at the instant nearest to
    it: interpolation would average the noise of positions away, and positions, other than residuals, change by much
    more than their noise within half a frame.
    """
    import pandas as pd

    step_s = min(float(np.median(np.diff(trial.time_s))) for trial in trials)
    parts = [
        pd.DataFrame(
            {
                "trial": trial.name,
                "time_s": trial.time_s - trial.release_s,
                "lead_position_m": trial.lead_position_m - trial.origin_m,
                "model_position_m": trial.predicted_position_m - trial.origin_m,
                "residual_m": trial.residual_m,
                "moves": np.arange(trial.time_s.size) >= first_that_counts(trial),
            }
        )
        for trial in trials
    ]
    frames = pd.concat(parts, ignore_index=True)
    instant = np.rint(frames["time_s"] / step_s)
    residual_m = frames.pivot_table("residual_m", instant, "trial")
    of_instant = frames.groupby(instant)
    instants = pd.DataFrame(
        {
            "time_s": step_s * residual_m.index,
            "lead_position_m": of_instant["lead_position_m"].mean(),
            "mean_m": residual_m.mean(axis=1),
            "variance_m2": residual_m.var(axis=1),
            "present": residual_m.count(axis=1),
            "moves": of_instant["moves"].any(),
        }
    )
    at = instants.loc[instant]
    frames["replicates_mean_m"] = frames["model_position_m"] + at["mean_m"].to_numpy()
    frames["replicates_sigma_m"] = np.sqrt(at["variance_m2"].to_numpy())
    return Replicates(trials, frames.drop(columns=["residual_m", "moves"]), instants)


def replicates_by_condition(trials: Sequence[TrialFit]) -> dict[str, Replicates]:
    """The replicates of each condition, in order."""
    names = dict.fromkeys(trial.trial.condition for trial in trials)
    return {name: replicates_of([trial for trial in trials if trial.trial.condition == name]) for name in names}


def first_that_counts(trial: TrialFit) -> int:
    """Index of the frame where model or measurement begins to move: a standstill would only dilute an error."""
    released = int(np.searchsorted(trial.time_s, trial.release_s))
    # While the pressure is still rising, nothing moves yet.
    moved = np.flatnonzero(trial.predicted_position_m > trial.origin_m)
    released = max(released, int(moved[0]) if moved.size else trial.time_s.size)
    at_rest = rest_points(trial.lead_position_m)  # all of them where nothing moved
    at_rest = at_rest if at_rest < trial.time_s.size else 0
    return min(released, max(at_rest - 1, 0), trial.time_s.size - 1)


# ------------------------------------------------------------------------------
# How far trials scatter: by what multiple of a typical scatter of pressure and of B, as replicates show it.

LEAST_SCATTER = 0.5  # Least scatter of trials, in multiples of the typical one, where it is needed (chosen)


@dataclass(frozen=True)
class AlignedTrials:
    """A fitted model aligned with its trials: each has its own release and origin, but no deviation of pressure or B.
    `columns` are the sensitivities there, see `vinetrack.inference.sensitivity`; `trials` are those predicted.
    """

    fit: Fit
    predictor: Predictor
    trial_effects: Floats
    columns: tuple[Floats, ...]
    trials: Sequence[TrialFit]

    @cached_property
    def courses(self) -> dict[str, list[ResidualCourse]]:
        """Residuals of the trials of each condition, by its name, in order."""
        courses: dict[str, list[ResidualCourse]] = {}
        for i, trial in enumerate(self.trials):
            courses.setdefault(trial.trial.condition, []).append(_course(self, i, trial))
        return courses

    @cached_property
    def scatter(self) -> Scatter:
        """The multiple of the typical scatter at which an adequate model would be off by the replicate floor."""
        together, beyond, typical, dof = replicates_by_condition(self.trials), 0.0, 0.0, 0
        for condition, members in self.courses.items():
            if not math.isnan(floor_m := together[condition].floor_m):
                beyond += sum(floor_m**2 - member.position_m2 for member in members)
                typical += sum(float(np.trace(member.typical_m2)) for member in members)
                dof += len(members) - 1
        return Scatter(math.sqrt(max(beyond, 0.0) / max(typical, 1e-300)), dof) if dof else Scatter(1.0, 0)

    def nuisances(self, i: int) -> list[int]:
        """Columns of release and, where no standstill was seen, origin of one trial."""
        return [RELEASE] if rest_is_seen(self.predictor.data[i : i + 1])[0] else [RELEASE, ORIGIN]


def align_trials(fit: Fit) -> AlignedTrials:
    """Align the model with the trials that it was fitted to, by release and origin."""
    predictor, trial_effects, trials = aligned_to_trials(fit, fit.predictor.data, from_rest=True)
    columns = tuple(predictor.linearise(np.empty(0), trial_effects))
    return AlignedTrials(fit, predictor, trial_effects, columns, trials)


def orthogonal_part(columns: Floats, others: Floats) -> Floats:
    """Component of columns that is orthogonal to all linear combinations of others. Shapes: columns (n_points, …);
    others (n_points, n) → (n_points, …).
    """
    return np.asarray(columns - others @ np.linalg.lstsq(others, columns, rcond=1e-9)[0])


class ResidualCourse(NamedTuple):
    """One trial from its first motion on, arrays of shape (n_points, …): residual; response to one typical standard
    deviation of pressure and of ln B, (n_points, 2); place along the growth; variance of a position by its own errors.
    """

    trial: Trial
    residual_m: Floats
    response_m: Floats
    lead_position_m: Floats
    position_m2: float

    @property
    def typical_m2(self) -> Floats:
        """Covariance by time of what typical deviations do, m²; its trace is their mean square. Shape (2, 2)."""
        return np.asarray(self.response_m.T @ self.response_m / len(self.response_m))


def _course(aligned: AlignedTrials, i: int, trial: TrialFit) -> ResidualCourse:
    """The course of one trial. Responses are orthogonal to those to release and origin. Where growth has ended in the
    model they would be zero, but the vine may still grow: the last values are kept.
    """
    trial_data, columns = aligned.predictor.data[i], aligned.columns[i].copy()
    moving = np.flatnonzero(columns[:, RELEASE] != 0)
    if moving.size:
        kept = [RELEASE, PRESSURE, DAMPING_DEVIATION]
        columns[moving[-1] + 1 :, kept] = columns[moving[-1], kept]
    response = orthogonal_part(columns[:, [PRESSURE, DAMPING_DEVIATION]], columns[:, aligned.nuisances(i)])
    moved = slice(first_that_counts(trial), None)
    return ResidualCourse(
        trial=trial.trial,
        residual_m=trial.residual_m[moved],
        response_m=response[moved] * TYPICAL_SPREADS,
        lead_position_m=trial.predicted_position_m[moved] - trial.origin_m,
        position_m2=trial_data.mean_noise_m**2 + trial_data.position_systematic_m**2,
    )


class Scatter(NamedTuple):
    """Scatter of trials in multiples of a typical one, and the replicates beyond the first of each condition that it
    was found from; where there are none, the typical one.
    """

    multiple: float
    dof: int


def mean_square(courses: Sequence[ResidualCourse], scatter: Scatter) -> tuple[float, float, float]:
    """Mean square error of an adequate model over trials of equal weight that scatter like replicates, m², its degrees
    of freedom (Satterthwaite), and those of a single trial. That of a trial, S u + e with u ~ N(0, Σ), has the variance
    2 tr((ΣSᵀS/n)²).
    """
    shared = [scatter.multiple**2 * course.typical_m2 for course in courses]
    mean_m2 = np.array([np.trace(of) + one.position_m2 for of, one in zip(shared, courses, strict=True)])
    by_position = [one.position_m2**2 / len(one.residual_m) for one in courses]
    variance_m4 = 2 * (np.array([np.trace(of @ of) for of in shared]) + by_position)
    degrees = 2 * float(np.sum(mean_m2)) ** 2 / float(np.sum(variance_m4))
    return float(np.mean(mean_m2)), degrees, float(np.mean(2 * mean_m2**2 / variance_m4))


def expected_error(courses: Sequence[ResidualCourse], scatter: Scatter) -> dict[str, float]:
    """Error of an adequate model over these trials, rms, m, and the ends of its 95 % range; NaN without replicates. As
    many degrees of freedom as a trial has, so many has every replicate: the range is of F.
    """
    from scipy.stats import f as fisher

    if not scatter.dof:
        return dict.fromkeys(EXPECTED, math.nan)
    mean_m2, degrees, of_trial = mean_square(courses, scatter)
    ends = fisher.ppf((0.025, 0.975), degrees, scatter.dof * of_trial)
    return dict(zip(EXPECTED, (math.sqrt(mean_m2 * part) for part in (1.0, *ends)), strict=True))
