"""Trials beside their replicates and their sheet: odd rows, lost frames, the scatter of replicates.

Every trial has its own release, and its own origin where no standstill was filmed; a model is laid on each by the same
two (`vinetrack.inference.fit.predict_prepared`). What then distinguishes replicates is their scatter, the floor below
which no model can fall. Residuals of one trial are correlated from frame to frame: a trial with 3 % more B is late
everywhere. Frames are therefore not counted as independent. Every trial is cut into a few stretches, and the covariance
of the stretch means between replicates has three parameters for all conditions: the scatter of pressure and of B,
propagated by the sensitivities of the trajectories, and a residual scatter that is independent between stretches. They
are estimated from differences between replicates alone, so that a model that fails does not inflate them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.problems import Remark, remark
from vinetrack.core.records import Floats, Trial, with_flag
from vinetrack.core.units import GRAVITY_M_S2
from vinetrack.diagnosis.result import (
    ADEQUATE,
    ARTEFACT,
    DROPPED_FRAMES,
    EXPECTED,
    MAX_STRETCHES,
    UNEXPLAINED,
    Diagnosis,
)
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.inference.fit import aligned_to_trials, rest_is_seen
from vinetrack.inference.fit_data import FitError, FitTrial, Pairs
from vinetrack.inference.fit_result import Fit, TrialFit
from vinetrack.inference.sensitivity import DAMPING_DEVIATION, ORIGIN, PRESSURE, RELEASE, Predictor, middle_speed
from vinetrack.tracks.frame_timing import frames_surely_missing
from vinetrack.tracks.position_noise import rest_points

if TYPE_CHECKING:
    import pandas as pd

# ------------------------------------------------------------------------------
# Outlying trials: a row of the sheet that belongs to another recording, or a typing error.
#
# One such trial among thirty causes a misfit that no effect explains, and the verdict is `unexplained`. Outliers are
# detected without the model that failed: over the middle of the growth damping roughly balances the force,
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


def with_odd_trials(result: Diagnosis, odd: Sequence[OddTrial], without: Callable[[list[str]], Diagnosis]) -> Diagnosis:
    """Add what outlying trials mean for a diagnosis. Where the model is adequate, or the other trials support the same
    effect, they are a note. Where no effect explains all trials but one explains the others, the explanation says so.
    """
    if not odd:
        return result
    noted = replace(result, notes=(*result.notes, remark("odd_trials", odd=odd, count=len(result.fits[0].trials))))
    if result.verdict == ADEQUATE:
        return noted
    try:
        others = without([trial.name for trial in odd])
    except (FitError, SimulationError):
        return noted
    unexplained = UNEXPLAINED in (result.verdict, result.final_verdict)
    if UNEXPLAINED in (others.verdict, others.final_verdict):
        return result if unexplained else noted
    if not unexplained and set(result.answer_set) & set(others.answer_set):
        return noted
    result = replace(result, odd_trials=tuple(trial.name for trial in odd))
    facts = {"odd": odd, "count": len(result.fits[0].trials), "others": others, "with_them": result.explanation}
    words = str(Remark("odd_trials_decide", {**facts, "withdrawn": not unexplained}))
    if unexplained:
        return replace(result, explanation=words)
    ranking = tuple(replace(candidate, in_answer_set=False) for candidate in result.rounds[0].ranking)
    return _overruled(result, words, verdict=UNEXPLAINED, answer_set=(), ranking=ranking)


def _overruled(result: Diagnosis, words: str, **first: Any) -> Diagnosis:
    """The diagnosis of one round, without effects; `first` are the fields in which it differs from the first one."""
    nothing: dict[str, Any] = {"fits": {}, "sets": (), "partial": (), "partial_fits": ()}
    only = replace(result.rounds[0], explanation=words, **nothing, **first)
    return replace(result, rounds=(only,), effects=(), explanation=words, fits=result.fits[:1])


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
    return _overruled(
        replace(result, notes=(note,), odd_trials=()), words, verdict=ARTEFACT, answer_set=(DROPPED_FRAMES,)
    )


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
# Residuals of single trials averaged over stretches of their growth, and the scatter of replicates in them.

# Lower limits of the standard deviations of pressure and B where both are needed (chosen)
LEAST_BETWEEN_TRIAL_SD = (0.005, 0.015)


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
        """The scatter of replicates."""
        return _replicate_scatter(self.fit, list(self.courses.values()))

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


@dataclass(frozen=True)
class ResidualCourse:
    """One trial from its first motion on: residual and its responses to deviations of pressure and ln B, as columns of
    `values_m`, shape (n_points, 3); coordinates along the growth; variance of a single position, and of the noise of
    means, times their number of frames, and of the origin.
    """

    trial: Trial
    values_m: Floats
    time_s: Floats
    lead_position_m: Floats
    position_m2: float
    noise_m2: float
    origin_m2: float

    def means(self, along: str, edges: Floats) -> tuple[Floats, Floats]:
        """Means of the values in each stretch, NaN where there is no frame, and the numbers of frames. Shapes: edges
        (n_stretches + 1,) → (n_stretches, 3), (n_stretches,).
        """
        at = getattr(self, along)
        stretch = np.clip(np.searchsorted(edges, at, side="right") - 1, 0, edges.size - 2)
        inside = (at >= edges[0]) & (at <= edges[-1])
        total, count = np.zeros((edges.size - 1, 3)), np.zeros(edges.size - 1)
        np.add.at(total, stretch[inside], self.values_m[inside])
        np.add.at(count, stretch[inside], 1.0)
        return np.where(count[:, None] > 0, total / np.maximum(count, 1.0)[:, None], math.nan), count

    def noise(self, count: Floats) -> Floats:
        """Covariance of the means of stretches of so many frames; the error of the origin is common to all."""
        return np.asarray(np.diag(self.noise_m2 / np.maximum(count, 1.0)) + self.origin_m2)


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
    noise_m2 = trial_data.mean_noise_m**2 * (1 + trial_data.correlation) / (1 - trial_data.correlation)
    moved = slice(first_that_counts(trial), None)
    return ResidualCourse(
        trial=trial.trial,
        values_m=np.column_stack([trial.residual_m, response])[moved],
        time_s=trial.time_s[moved] - trial.release_s,
        lead_position_m=trial.predicted_position_m[moved] - trial.origin_m,
        position_m2=trial_data.mean_noise_m**2 + trial_data.position_systematic_m**2,
        noise_m2=noise_m2,
        origin_m2=noise_m2 / max(trial_data.n_rest, 1),
    )


class Stretches(NamedTuple):
    """Stretches of time that all replicates of a condition cover: mean residuals, shape (n_trials, n), their responses
    to pressure and ln B, (n, 2), and their covariance from the noise of the tracks alone, (n, n).
    """

    means_m: Floats
    response_m: Floats
    noise_m2: Floats


def common_stretches(members: Sequence[ResidualCourse]) -> Stretches:
    """The stretches in which all members have frames, of the time that all were recorded in."""
    start = max(float(member.time_s[0]) for member in members)
    end = min(float(member.time_s[-1]) for member in members)
    frames = min(int(np.count_nonzero((member.time_s >= start) & (member.time_s <= end))) for member in members)
    # 2: least frames of a stretch: a shorter recording is cut into fewer (derived)
    edges = np.linspace(start, max(end, start), max(min(MAX_STRETCHES, frames // 2), 1) + 1)
    parts = [member.means("time_s", edges) for member in members]
    all_means = np.array([means for means, _ in parts])
    reached = np.isfinite(all_means).all(axis=(0, 2))
    noise = [member.noise(count[reached]) for member, (_, count) in zip(members, parts, strict=True)]
    return Stretches(all_means[:, reached, 0], all_means[:, reached, 1:].mean(axis=0), np.mean(noise, axis=0))


@dataclass(frozen=True)
class Scatter:
    """Between-trial standard deviations of pressure (relative) and ln B, and of a residual, relative to their effect.
    `dof` counts replicates beyond the first of each condition. Where it is 0, the standard deviations of pressure and B
    are those of the fit.
    """

    pressure: float
    damping: float
    residual: float
    dof: int

    def covariance(self, response_m: Floats, noise_m2: Floats) -> Floats:
        """Covariance of the means of one trial's stretches, m². Shapes: response_m (n, 2), noise_m2 (n, n) → (n, n)."""
        shared = response_m * (self.pressure**2, self.damping**2) @ response_m.T
        residual = self.residual**2 * float(np.trace(shared)) / max(len(shared), 1)
        # 1e-6: lower limit of the error of a stretch mean, m (chosen)
        return np.asarray(shared + noise_m2 + (residual + 1e-6**2) * np.eye(len(shared)))


def _replicate_scatter(fit: Fit, courses: Sequence[Sequence[ResidualCourse]]) -> Scatter:
    """Maximum-likelihood estimate of the between-trial scatter from the differences between replicates."""
    from scipy.optimize import minimize

    start_values = (0.01, 0.03, 0.2)  # Starting values of the search: pressure, ln B, residual scatter (chosen)
    lower_bounds, upper_bounds = np.log((1e-5, 1e-5, 1e-3)), np.log((0.2, 0.5, 3.0))  # Bounds of the search (chosen)
    groups = [common_stretches(members) for members in courses if len(members) > 1]
    dof = sum(len(group.means_m) - 1 for group in groups)
    if dof < 1:
        spreads = [fit.spreads[name].value if name in fit.spreads else 0.0 for name in ("pressure", "B")]
        return Scatter(spreads[0], spreads[1], start_values[2], 0)
    deviations = [group.means_m - group.means_m.mean(axis=0) for group in groups]

    def scatter(logs: Floats) -> Scatter:
        pressure, damping, residual = np.exp(np.clip(logs, lower_bounds, upper_bounds)).tolist()
        return Scatter(pressure, damping, residual, dof)

    def minus_two_log_likelihood(logs: Floats) -> float:
        total = 0.0
        for group, deviation_m in zip(groups, deviations, strict=True):
            covariance = scatter(logs).covariance(group.response_m, group.noise_m2)
            total += (len(deviation_m) - 1) * float(np.linalg.slogdet(covariance)[1])
            total += float(np.sum(deviation_m * np.linalg.solve(covariance, deviation_m.T).T))
        return total

    how = {"xatol": 0.02, "fatol": 0.01}
    return scatter(minimize(minus_two_log_likelihood, np.log(start_values), method="Nelder-Mead", options=how).x)


def expected_error(courses: Sequence[ResidualCourse], scatter: Scatter) -> dict[str, float]:
    """Error of an adequate model over these trials, of equal weight, that scatter like their replicates, rms, m, and
    the ends of its 95 % range; NaN without replicates. A residual S u + e, u ~ N(0, Σ), has a mean square of tr(GΣ) +
    σ², G = SᵀS/n, with the variance 2 tr((GΣ)²). As many degrees of freedom (Satterthwaite) as a trial has, so many has
    every replicate that Σ was estimated from: the range is of F.
    """
    from scipy.stats import f as fisher

    if not scatter.dof:
        return dict.fromkeys(EXPECTED, math.nan)
    moments = np.zeros((len(courses), 2))  # mean and variance of the mean square of each trial
    for k, course in enumerate(courses):
        response_m = course.values_m[:, 1:]
        shared = response_m.T @ response_m / len(response_m) * (scatter.pressure**2, scatter.damping**2)
        residual_m2 = scatter.residual**2 * float(np.trace(shared))
        mean_m2 = float(np.trace(shared)) + residual_m2 + course.position_m2
        independent_m4 = residual_m2**2 / MAX_STRETCHES + course.position_m2**2 / len(response_m)
        moments[k] = mean_m2, 2 * (float(np.trace(shared @ shared)) + independent_m4)
    mean_m2, variance_m4 = moments.mean(axis=0)
    of_trials = 2 * moments[:, 0] ** 2 / moments[:, 1]
    degrees = 2 * len(courses) * mean_m2**2 / variance_m4
    ends = fisher.ppf((0.025, 0.975), degrees, scatter.dof * of_trials.mean())
    return dict(zip(EXPECTED, (math.sqrt(mean_m2 * part) for part in (1.0, *ends)), strict=True))
