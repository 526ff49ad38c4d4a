"""The ladder of errors: of each model as effects are added, in sample and out of it, beside those of replicates; where
a model fails by more than these scatter, and which of its parameters drift with a condition.

Each trial has its own release and origin and no other trial effect, the origin is the position at standstill, and every
trial has the same weight. Errors differ in the data of the fit: all trials; all but the condition predicted, each in
turn (leave-one-condition-out cross-validation); all but the highest pressure of each vine. A fit without some trials is
one Newton step away from that to all (Giordano et al., AISTATS 2019, PMLR 89, 1139). What distinguishes
replicates so laid on a model is their scatter, the floor below which no model can fall. Two trials of a condition tell
little about it; all of them tell by what multiple of a typical scatter of pressure and of B they differ, and the
sensitivities of the trajectories spread it over the conditions.
"""

from __future__ import annotations

import itertools
import logging
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.special import fdtri, ndtri, stdtr

from vinetrack.core.problems import Remark, remark
from vinetrack.core.process import Drawn, in_one_blas_thread, table
from vinetrack.core.records import Floats, Kinematics, Track, Trial
from vinetrack.core.units import number
from vinetrack.diagnosis.result import EXPECTED, MAX_STRETCHES
from vinetrack.dynamics.model import Model, host_for
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.effects import Effect, catalogue, find_effect
from vinetrack.experiment.schema import COLUMNS, LIMITED, RIG
from vinetrack.inference.errors import precision, with_systematics, without
from vinetrack.inference.fit import aligned_to_trials, design_matrix, fit, rest_is_seen
from vinetrack.inference.fit_data import FitError, Pairs
from vinetrack.inference.fit_result import DAMPING, YIELD_PRESSURE, Fit, Number, TrialFit
from vinetrack.inference.optimiser import TYPICAL_SPREADS
from vinetrack.inference.sensitivity import DAMPING_DEVIATION, ORIGIN, PRESSURE, RELEASE, Predictor
from vinetrack.kinematics.summary import estimate_kinematics, lead_velocity_at
from vinetrack.tracks.position_noise import rest_points

# ------------------------------------------------------------------------------
# The fit of the initial model, for `fit.json` and for the diagnosis. A model that is far off has several minima close
# together: fits that are started or compiled differently end at parameters that differ in the third digit. The model is
# therefore compiled together with all candidates of the diagnosis in either case.


def candidates_of(
    model: Model, wanted: Iterable[str] | None, user_effects: Mapping[str, Effect] | None = None
) -> tuple[Effect, ...]:
    """Candidates of a diagnosis: the `wanted` effects and the user's own, less those in the model."""
    user_effects = user_effects or {}
    names = [name for name, effect in catalogue().items() if effect.kind != "base"] if wanted is None else list(wanted)
    names += [name for name in user_effects if name not in names]
    replaced = {name for effect in model for name in effect.replaces}
    return tuple(find_effect(name, user_effects) for name in names if name not in model and name not in replaced)


def with_host(fit: Fit, host: Model | None) -> Fit:
    """Return a fit whose trajectories are simulated by the compiled form of a larger model."""
    predictor = Predictor(fit.predictor.layout, fit.predictor.data, host)
    return replace(fit, solution=replace(fit.solution, predictor=predictor.with_steps_of(fit.predictor)))


def initial_fit(model: Model, pairs: Pairs, candidates: Iterable[Effect], *, free: Iterable[str] = ()) -> Fit:
    """Fit the model in use, as the diagnosis does."""
    return fit(model, pairs, free=free, host=host_for(model, tuple(candidates)))


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
    `columns` are the sensitivities and the residual there, see `vinetrack.inference.sensitivity`; `trials` are those
    predicted.
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
    def together(self) -> dict[str, Replicates]:
        """The replicates of each condition, by its name, in order."""
        names = dict.fromkeys(trial.trial.condition for trial in self.trials)
        return {name: replicates_of([one for one in self.trials if one.trial.condition == name]) for name in names}

    @property
    def floor_m(self) -> float:
        """Replicate floor over all conditions with replicates, m; NaN where none has any. Root of the mean variance of
        the conditions, weighted by their numbers of trials.
        """
        groups = [group for group in self.together.values() if math.isfinite(group.floor_m)]
        counts = [len(group.trials) for group in groups]
        return math.sqrt(np.average([group.floor_m**2 for group in groups], weights=counts)) if groups else math.nan

    @cached_property
    def scatter(self) -> Scatter:
        """The multiple of the typical scatter at which an adequate model would be off by the replicate floor; 1 where
        no pressure or B moves the trials.
        """
        beyond, typical, dof = 0.0, 0.0, 0
        for condition, members in self.courses.items():
            if not math.isnan(floor_m := self.together[condition].floor_m):
                beyond += sum(floor_m**2 - member.noise_m2 for member in members)
                typical += sum(float(np.trace(member.typical_m2)) for member in members)
                dof += len(members) - 1
        return Scatter(math.sqrt(max(beyond, 0.0) / typical) if typical > 0 else 1.0, dof)

    @cached_property
    def information(self) -> tuple[Floats, Floats]:
        """Information and scores of each trial of the fit."""
        return self.fit.solution.information()

    @cached_property
    def left_out(self) -> tuple[Floats, Floats]:
        """`errors_without` the condition of each trial (cross-validation)."""
        names = np.array([trial.trial.condition for trial in self.trials])
        squares_m2 = np.empty((2, names.size))
        for name in np.unique(names):
            squares_m2[:, names == name] = errors_without(self, np.flatnonzero(names == name))
        return squares_m2[0], squares_m2[1]

    def nuisances(self, i: int) -> list[int]:
        """Columns of release and, where no standstill was seen, origin of one trial."""
        return [RELEASE] if rest_is_seen(self.predictor.data[i : i + 1])[0] else [RELEASE, ORIGIN]


def align_trials(fit: Fit) -> AlignedTrials:
    """Align the model with the trials that it was fitted to, by release and origin."""
    predictor, trial_effects, trials = aligned_to_trials(fit, fit.predictor.data, from_rest=True)
    of_fit = Predictor(fit.predictor.layout, fit.predictor.data, fit.predictor.host).with_steps_of(fit.predictor)
    sensitivities = of_fit.linearise(fit.solution.state.theta, trial_effects)
    columns = [np.column_stack([each[:, :-1], one.residual_m]) for each, one in zip(sensitivities, trials, strict=True)]
    return AlignedTrials(fit, predictor, trial_effects, tuple(columns), trials)


def orthogonal_part(columns: Floats, others: Floats) -> Floats:
    """Component of columns that is orthogonal to all linear combinations of others. Shapes: columns (n_points, …);
    others (n_points, n) → (n_points, …).
    """
    return np.asarray(columns - others @ np.linalg.lstsq(others, columns, rcond=1e-9)[0])


class ResidualCourse(NamedTuple):
    """One trial from its first motion on, (n_points, …): residual; response to one typical standard deviation of
    pressure and of ln B, (n_points, 2); place along the growth; variances of a position by noise and by a lens.
    """

    trial: Trial
    residual_m: Floats
    response_m: Floats
    lead_position_m: Floats
    noise_m2: float
    smooth_m2: float

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
        noise_m2=trial_data.mean_noise_m**2,
        smooth_m2=trial_data.position_systematic_m**2,
    )


class Scatter(NamedTuple):
    """Scatter of trials in multiples of a typical one, and the replicates beyond the first of each condition that it
    was found from; where there are none, the typical one.
    """

    multiple: float
    dof: int


def mean_square(courses: Sequence[ResidualCourse], scatter: Scatter) -> tuple[float, float, float]:
    """Mean square error of an adequate model over trials of equal weight that scatter like replicates, m², its degrees
    of freedom (Satterthwaite), and those of the scatter of a single trial. That of a trial, S u + e with u ~ N(0, Σ),
    has the variance 2 tr((ΣSᵀS/n)²); a lens adds four polynomials that all trials share.
    """
    scattered = [(one, scatter.multiple**2 * one.typical_m2) for one in courses]
    own_m2 = np.array([np.trace(of) + one.noise_m2 for one, of in scattered])
    variance_m4 = 2 * np.array([np.trace(of @ of) + one.noise_m2**2 / len(one.residual_m) for one, of in scattered])
    smooth_m2 = sum(one.smooth_m2 for one in courses)
    total_m2 = float(np.sum(own_m2)) + smooth_m2
    degrees = 2 * total_m2**2 / (float(np.sum(variance_m4)) + 2 * smooth_m2**2 / 4)
    return total_m2 / len(courses), degrees, float(np.mean(2 * own_m2**2 / variance_m4))


def expected_error(courses: Sequence[ResidualCourse], scatter: Scatter, further_m2: float = 0.0) -> dict[str, float]:
    """Error of an adequate model over these trials, rms, m, and the ends of its 95 % range; NaN without replicates. As
    many degrees of freedom as a trial has, so many has every replicate: the range is of F. `further_m2` is a mean
    square that adds to that of the trials' scatter.
    """
    if not scatter.dof:
        return dict.fromkeys(EXPECTED, math.nan)
    mean_m2, degrees, of_trial = mean_square(courses, scatter)
    ends = fdtri(degrees, scatter.dof * of_trial, (0.025, 0.975))
    return dict(zip(EXPECTED, (math.sqrt((mean_m2 + further_m2) * part) for part in (1.0, *ends)), strict=True))


# ------------------------------------------------------------------------------
# Errors of a fitted model by condition: those of the paper's Table II (Alvarez et al., 2025), of position over the
# whole growth and of the final speed of the leading edge. The release, and the origin where no standstill was filmed,
# minimise the root mean square error: of a model that lacks nothing it is about the replicate floor, a ratio of 1.

COMPARISON_COLUMNS = (
    *("model", "condition", "rms_position_m", "rms_final_velocity_m_s", "replicate_floor_m", "ratio", "worst_at_s"),
    *("worst_at_m", *EXPECTED),
)


@dataclass(frozen=True, repr=False)
class Comparison(Drawn):
    """Result of `compare`: `table` has one row for each condition, columns `COMPARISON_COLUMNS`. `trajectories` holds
    the frames of each condition with the model's prediction, see `Replicates`. `trials` are the predictions.
    """

    table: pd.DataFrame
    trajectories: Mapping[str, pd.DataFrame]
    trials: tuple[TrialFit, ...]

    def __repr__(self) -> str:
        return f"Comparison({len(self.trials)} trials, {len(self.table)} conditions)"

    def __str__(self) -> str:
        return "\n".join(comparison_lines(self.table))

    def _repr_html_(self) -> str:
        return str(self.table._repr_html_())  # type: ignore[operator]


def comparison_lines(compared: pd.DataFrame) -> list[str]:
    """Return model and measurement of every condition as lines of an aligned table, below the effects of the model."""
    in_mm = ("rms_position_m", "replicate_floor_m", "expected_low_m", "expected_high_m")
    scale = dict.fromkeys(in_mm, 1e3) | {"rms_final_velocity_m_s": 1.0, "worst_at_s": 1e3, "worst_at_m": 1e3}
    shown = (compared[[*scale]] * [*scale.values()]).map(number)
    head = ("condition", "rms position", "replicates", "adequate from", "to", "rms final speed", "worst at", "")
    rows = zip(compared["condition"], *(shown[name] for name in scale), strict=True)
    lines = table(rows, head, ("", "mm", "mm", "mm", "mm", "m/s", "ms", "mm"), align="<>>>>>>>")
    return [*compared["model"][:1].str.replace("+", " + "), *lines]


@in_one_blas_thread
def compare(
    fit: Fit, pairs: Pairs, *, kinematics: Mapping[str, Kinematics] | None = None, final_at_fraction: float = 0.95
) -> Comparison:
    """Compare a fitted model with trials."""
    aligned = align_trials(fit)
    measured = {trial.name: track for trial, track in pairs}
    final = _final_speed_errors(aligned, measured, kinematics or {}, final_at_fraction)
    rows, trajectories = [], {}
    for condition, together in aligned.together.items():
        known = [final[trial.name] for trial in together.trials if math.isfinite(final[trial.name])]
        rows.append(
            {
                "model": "+".join(fit.model.names),
                "condition": condition,
                **position_errors(together),
                **expected_error(aligned.courses[condition], aligned.scatter),
                "rms_final_velocity_m_s": math.sqrt(np.mean(np.square(known))) if known else math.nan,
            }
        )
        trajectories[condition] = together.frames
    return Comparison(pd.DataFrame(rows, columns=list(COMPARISON_COLUMNS)), trajectories, tuple(aligned.trials))


def rms_of(trials: Iterable[TrialFit]) -> float:
    """Root mean square position error in motion, m, with equal weight for every trial, however many its frames; NaN
    without trials.
    """
    squares = [float(np.mean(trial.residual_m[first_that_counts(trial) :] ** 2)) for trial in trials]
    return math.sqrt(float(np.mean(squares))) if squares else math.nan


def position_errors(together: Replicates) -> dict[str, float]:
    """Position errors of one condition: columns of `comparison.csv`, m, s and ratios. The worst place is that of the
    largest mean residual of the replicates, smoothed.
    """
    rms_m, floor_m = rms_of(together.trials), together.floor_m
    moving = together.instants[together.instants["moves"]]
    # 0.05: fraction of the growth's duration over which the residual is averaged before its maximum is found (chosen)
    width = 2 * int(0.05 * len(moving) / 2) + 1
    smoothed_m = moving["mean_m"].rolling(width, center=True, min_periods=1).mean()
    worst = moving.iloc[int(np.argmax(smoothed_m.abs()))]
    return {
        "rms_position_m": rms_m,
        "replicate_floor_m": floor_m,
        "ratio": rms_m / floor_m if floor_m > 0 else math.nan,
        "worst_at_s": float(worst["time_s"]),
        "worst_at_m": float(worst["lead_position_m"]),
    }


def _final_speed_errors(
    aligned: AlignedTrials, tracks: Mapping[str, Track], kinematics: Mapping[str, Kinematics], at_fraction: float
) -> dict[str, float]:
    """Model minus measurement of the leading edge's final speed, m/s, by name of trial, both at the same position. A
    model that does not reach the position has stopped, and its speed there is 0. NaN where none was measured.
    """
    # 3.0: duration of the simulation, in durations of the recording, so that a slow model reaches the same
    # position (chosen)
    trials = aligned.trials
    times_s = [t.release_s + 3.0 * max(t.time_s[-1] - t.release_s, 1e-9) * np.linspace(0, 1, 601) for t in trials]
    runs = aligned.predictor.run(aligned.predictor.jobs(np.empty(0), aligned.trial_effects), times_s)
    errors = {}
    for trial, time_s, run in zip(trials, times_s, runs, strict=True):
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


LADDER_COLUMNS = (
    *("model", "added", "rms_in_sample_m", "rms_left_out_m", "rms_highest_pressure_m", "floor_m", "excess_left_out_m"),
    *(*EXPECTED, "partial"),
)


def ladder(fits: Sequence[Fit], added: Sequence[str], partial: int = 0) -> pd.DataFrame:
    """Compute the errors of the initial model and of every enlarged one, the last `partial` of them without a claim.
    The floor, and the error expected of an adequate model, are those of replicates laid on the last model that claims
    to be one. `attrs["notes"]` are remarks about trials that could not be predicted.
    """
    rows: list[dict[str, object]] = []
    notes: list[Remark] = []
    settled = align_trials(fits[len(fits) - partial - 1])
    floor_m, courses = settled.floor_m, list(itertools.chain(*settled.courses.values()))
    by_parameters_m = np.nan_to_num(root_mean(settled.left_out[1]))
    expected = expected_error(courses, settled.scatter, by_parameters_m**2)
    for place, (enlarged, name) in enumerate(zip(fits, added, strict=True)):
        aligned = settled if enlarged is settled.fit else align_trials(enlarged)
        outside_m2, highest_m2 = aligned.left_out[0], errors_without(aligned, highest_pressures(aligned))[0]
        rows.append(
            {
                "model": "+".join(enlarged.model.names),
                "added": name,
                "rms_in_sample_m": rms_of(aligned.trials),
                "rms_left_out_m": root_mean(outside_m2),
                "rms_highest_pressure_m": root_mean(highest_m2),
                "floor_m": floor_m,
                "excess_left_out_m": excess(root_mean(outside_m2), floor_m),
                **expected,
                "partial": place >= len(fits) - partial,
            }
        )
        for what, squares_m2 in (("conditions", outside_m2), ("highest_pressure", highest_m2)):
            if count := np.count_nonzero(np.isnan(squares_m2)):
                note = remark("left_out_error_without", left_out=what, count=count)
                notes += [note] if note not in notes else []
    table = pd.DataFrame(rows, columns=list(LADDER_COLUMNS))
    table.attrs["notes"] = notes
    return table


def not_better(table: pd.DataFrame) -> list[Remark]:
    """The effects of a ladder with which the error on left-out conditions, or on the highest pressure, does not fall,
    nor with those after them: that contradicts an adequate model.
    """
    return [
        remark("left_out_error_does_not_fall", name=name, highest=highest, without_m=without_m, with_m=with_m)
        for highest, errors_m in ((False, table["rms_left_out_m"]), (True, table["rms_highest_pressure_m"]))
        for k, (name, without_m, with_m) in enumerate(zip(table["added"][1:], errors_m, errors_m[1:], strict=False), 1)
        if errors_m[k:].min() >= without_m
    ]


def excess(rms_m: float, floor_m: float) -> float:
    """√(rms² − floor²), 0 where the error is below the floor; NaN where there is no floor."""
    return math.sqrt(max(rms_m**2 - floor_m**2, 0.0)) if math.isfinite(rms_m + floor_m) else math.nan


def root_mean(squares: Floats) -> float:
    """Root of the mean of those that are known; NaN where none is."""
    known = squares[np.isfinite(squares)]
    return math.sqrt(np.mean(known)) if known.size else math.nan


def left_out_error(fit: Fit) -> float:
    """Error of a fitted model on conditions left out, rms, m."""
    return root_mean(align_trials(fit).left_out[0])


def highest_pressures(aligned: AlignedTrials) -> NDArray[np.intp]:
    """Indices of the trials at the highest pressure of each vine."""
    pressures_Pa = pd.Series([trial.trial.pressure_Pa for trial in aligned.trials])
    highest_Pa = pressures_Pa.groupby([trial.trial.vine for trial in aligned.trials]).transform("max")
    return np.flatnonzero(pressures_Pa >= highest_Pa)


def errors_without(aligned: AlignedTrials, gone: NDArray[np.intp]) -> tuple[Floats, Floats]:
    """Mean squares in motion, m², of the errors of some trials as the fit to all others predicts them, and of what the
    errors of its parameters contribute; NaN where the others do not determine what these depend on. Shapes: gone (n,) →
    (n,), (n,).
    """
    squares_m2, index = np.full((2, gone.size), np.nan), aligned.fit.solution.problem.index
    if (known := without(aligned.fit.solution, *aligned.information, gone.tolist())) is not None:
        moved = np.column_stack(known)
        for k, i in enumerate(gone.tolist()):
            columns, moves = aligned.columns[i], first_that_counts(aligned.trials[i])
            design_m = design_matrix(columns, index[i], len(moved)) @ moved
            changes_m = orthogonal_part(design_m, columns[:, aligned.nuisances(i)])[moves:]
            squares_m2[0, k] = np.mean((columns[moves:, -1] - changes_m[:, 0]) ** 2)
            squares_m2[1, k] = np.mean(np.sum(changes_m[:, 1:] ** 2, axis=1))
    return squares_m2[0], squares_m2[1]


# ------------------------------------------------------------------------------
# Where a model fails by more than the scatter of replicates: by condition, and along the growth. Standard errors are
# those of the mean over trials, from that scatter: a thousand frames of one trial are one trial.

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Failure:
    """Where a model fails: what is said of the worst condition, the mean residuals (measurement minus model) along the
    growth, SI, and what drifts.
    """

    worst: Remark
    along_position: pd.DataFrame
    drift: Drift

    @property
    def remarks(self) -> tuple[Remark, ...]:
        """Where the model fails most, by how much, and what drifts."""
        return self.worst, *self.drift.remarks


def locate(fit: Fit) -> Failure:
    """Find where a fitted model fails."""
    aligned = align_trials(fit)
    along = _residual_along_growth(aligned)
    return Failure(_worst_condition(aligned, along), along, drift(fit, aligned))


def _worst_condition(aligned: AlignedTrials, along: pd.DataFrame) -> Remark:
    """The condition with the largest root mean square, which all pages call the worst, and the mean residual of the
    stretch where that is largest, with its standard error.
    """
    together = max(aligned.together.values(), key=lambda replicates: rms_of(replicates.trials))
    trial, trials = together.trials[0].trial, [trial.trial for trial in aligned.trials]
    stretches = along[along["condition"] == trial.condition]
    worst = stretches.iloc[int(stretches["mean_residual_m"].abs().argmax())]
    off_m = float(worst["mean_residual_m"]), float(worst["sigma_m"])
    # What names a condition: its pressure, and payload and vine where they vary
    varying = [name for name in ("payload_kg", "vine") if len({getattr(one, name) for one in trials}) > 1]
    return remark(
        "fails_most",
        condition={"unit": trial.pressure_unit} | {name: getattr(trial, name) for name in ("pressure_Pa", *varying)},
        rms_m=rms_of(together.trials),
        floor_m=together.floor_m,
        is_repeated=math.isfinite(together.floor_m),
        off_m=off_m,
        is_ahead=off_m[0] > 0,
    )


def _residual_along_growth(aligned: AlignedTrials) -> pd.DataFrame:
    """Mean residual of each condition in every stretch of the growth of its vine, over the trials that reach it."""
    multiple, rows = aligned.scatter.multiple, list[tuple[object, ...]]()
    every = list(itertools.chain(*aligned.courses.values()))
    for condition, members in aligned.courses.items():
        vine = members[0].trial.vine
        reach_m = max(float(course.lead_position_m.max()) for course in every if course.trial.vine == vine)
        edges = np.linspace(0.0, reach_m, MAX_STRETCHES + 1)
        for low, high in itertools.pairwise(edges.tolist()):
            inside = [(of, (of.lead_position_m >= low) & (of.lead_position_m <= high)) for of in members]
            there = [(of, of.residual_m[at].mean(), of.response_m[at].mean(axis=0)) for of, at in inside if at.any()]
            if count := len(there):
                mean_m = float(np.mean([residual_m for _, residual_m, _ in there]))
                variances = [multiple**2 * response_m @ response_m + of.noise_m2 for of, _, response_m in there]
                # A lens displaces all trials alike.
                smooth_m2 = float(np.mean([of.smooth_m2 for of, _, _ in there]))
                sigma_m = math.sqrt(sum(variances) / count**2 + smooth_m2)
                rows.append((vine, condition, low, high, (low + high) / 2, mean_m, sigma_m, mean_m / sigma_m, count))
    columns = ("vine", "condition", "from_m", "to_m", "lead_position_m", "mean_residual_m", "sigma_m", "z", "n_trials")
    return pd.DataFrame(rows, columns=list(columns))


# ------------------------------------------------------------------------------
# Parameters that drift with a condition on which they should not depend.
#
# One B should describe a vine at every pressure and with every payload. The best value is fitted to each trial, all
# other parameters at their common values: it takes upon itself whatever a model lacks. Scatter by chance is taken from
# replicates, not from the fit, which a model that fails inflates. The common parameters have absorbed part of the drift
# (n most of it, where B follows the pressure): z is too small rather than too large.

FALSE_ALARM_LEVEL = 0.01  # Family-wise probability that any drift is called significant where nothing drifts (chosen)
FEWEST_DEGREES = 2  # Degrees of freedom of replicates from which they determine the scatter of estimates (chosen)

DRIFT_COLUMNS = (
    *("parameter", "vine", "symbol", "against", "from_level", "to_level", "change", "change_sigma", "z"),
    *("significant", "sentence"),
)
GROUP_COLUMNS = ("parameter", "vine", "symbol", "against", "level", "ratio", "ratio_sigma", "n_trials")


@dataclass(frozen=True)
class Drift:
    """Drifts, most significant first, and the values of the groups; SI. `table`, columns `DRIFT_COLUMNS`, has one row
    for each parameter, vine (blank: all) and condition.
    """

    table: pd.DataFrame
    groups: pd.DataFrame

    @property
    def remarks(self) -> tuple[Remark, ...]:
        """One remark for each parameter and condition with a significant drift, on the most significant row."""
        significant = self.table[self.table["significant"]].drop_duplicates(["parameter", "against"])
        return tuple(significant["sentence"])


def drift(fit: Fit, aligned: AlignedTrials | None = None) -> Drift:
    """Test B for drift with pressure, payload, angle, chamber or inlet, and P_y against the sheet."""
    tests = list(against_the_sheet(fit))
    if DAMPING in fit.predictor.layout.keys:
        of_trials = per_trial_estimates(fit, aligned or align_trials(fit))
        damping = next(number for number in fit.numbers if number.key == DAMPING)
        covariates = [COLUMNS[name].field for name in (*LIMITED["range"], *RIG)]
        tests = [*(test for against in covariates for test in _against(of_trials, damping, against)), *tests]
    level = 1 - (1 - FALSE_ALARM_LEVEL) ** (1 / max(len(tests), 1))
    table = pd.DataFrame(tests, columns=[*DRIFT_COLUMNS, "p", "groups"]).sort_values(
        "p", kind="stable", ignore_index=True
    )
    groups = [group for of_test in table["groups"] for group in of_test]
    table["significant"] = table["p"] < level
    return Drift(table[list(DRIFT_COLUMNS)], pd.DataFrame(groups, columns=list(GROUP_COLUMNS)))


def drift_groups(before: Drift, after: Fit | None) -> pd.DataFrame:
    """Return the best values of each group of trials under the first model and, where something was added, the last."""
    parts = [before.groups.assign(model="before")]
    if after is not None:
        try:
            parts.append(drift(after).groups.assign(model="after"))
        except (FitError, SimulationError, np.linalg.LinAlgError) as error:
            log.info("the drift under the last model is not known: %s", error)
    return pd.concat([part for part in parts if len(part)] or parts, ignore_index=True)


Row = dict[str, object]


def _tested(
    number: Number,
    vine: str,
    against: str,
    levels: tuple[float, float],
    change: tuple[float, float],
    p: float,
    groups: Sequence[Row] = (),
    **told: Any,
) -> Row:
    """A test as a row of the table, with its p-value and its `groups`: levels from and to, the change between them and
    its standard error. `told` is what the sentence about it needs besides.
    """
    subject: Row = {"parameter": number.key, "vine": vine, "symbol": number.symbol, "against": against}
    row = subject | dict(zip(DRIFT_COLUMNS[4:], (*levels, *change, -float(ndtri(max(p, 1e-300) / 2))), strict=False))
    sentence = remark("drifts", row=row, pressure_unit=number.pressure_unit, **told)
    return row | {"sentence": sentence, "p": p, "groups": [subject | group for group in groups]}


def per_trial_estimates(fit: Fit, aligned: AlignedTrials) -> pd.DataFrame:
    """Ln B of each trial that depends on it, by least squares of position with its release free: the trial, its vine
    (blank where all have one B), the `deviation` of the best ln B from the common value, and its `weight`, the inverse
    of its variance by a typical scatter of pressure and B, up to a factor.
    """
    has_own = any(number.vine for number in fit.numbers if number.key == DAMPING)
    rows = list[tuple[object, ...]]()
    for i, (trial_data, columns) in enumerate(zip(aligned.predictor.data, aligned.columns, strict=True)):
        trial, others = trial_data.trial, columns[:, aligned.nuisances(i)]
        sensitivity = orthogonal_part(columns[:, DAMPING_DEVIATION], others)
        response = float(np.sum(sensitivity**2))
        # 1e-12: least response of a trial, relative to its travel, from which it tells its B (derived)
        if response > 1e-12 * float(np.ptp(trial_data.lead_position_m)) ** 2 * len(columns):
            levers = sensitivity @ orthogonal_part(columns[:, [PRESSURE, DAMPING_DEVIATION]], others) / response
            variance = np.sum(np.square(TYPICAL_SPREADS * levers)) + trial_data.mean_noise_m**2 / response + 1e-12
            vine = trial.vine if has_own else ""
            rows.append((trial, vine, trial.condition, sensitivity @ columns[:, -1] / response, 1 / variance))
    return pd.DataFrame(rows, columns=["trial", "vine", "condition", "deviation", "weight"])


def _against(of_trials: pd.DataFrame, number: Number, against: str) -> Iterator[Row]:
    """Tests of a linear trend against one condition, of each vine alone and of all, about the mean of each vine
    (Student's t). The variance is that of replicates, or about the slope where there are too few.
    """
    levels = np.array([float(getattr(trial, against)) for trial in of_trials["trial"]])
    linear = against in ("payload_kg", "growth_angle_rad") or not np.all(levels > 0)
    known = of_trials.assign(level=levels, x=levels if linear else np.log(levels))[np.isfinite(levels)]
    apart, replicates = within_groups(*(of_trials[name].to_numpy() for name in ("deviation", "condition", "weight")))
    varying = [of_vine for _, of_vine in known.groupby("vine", sort=False) if np.ptp(of_vine["level"]) > 0]
    for tested in [*varying, *([pd.concat(varying)] if len(varying) > 1 else [])]:
        vines, w = tested["vine"].to_numpy(), tested["weight"].to_numpy()
        x, d = (within_groups(tested[name].to_numpy(), vines, w)[0] for name in ("x", "deviation"))
        square, n_vines = float(np.sum(w * x**2)), len(set(vines))
        dof = replicates if replicates >= FEWEST_DEGREES else d.size - n_vines - 1
        if dof < FEWEST_DEGREES or not square > 0:
            continue
        slope = float(np.sum(w * x * d)) / square
        by_slope = np.sum(w * (d - x * slope) ** 2)
        variance = float(np.sum(of_trials["weight"] * apart**2) if replicates >= FEWEST_DEGREES else by_slope) / dof
        # 0.1: least scatter of replicates, as part of the expected scatter of pressure and B (chosen)
        variance = max(variance, 0.1**2)
        sigma = math.sqrt(variance / square)
        groups: list[Row] = []
        for level, alike in tested.groupby("level") if n_vines == 1 else ():
            ratio = math.exp(float(np.average(alike["deviation"], weights=alike["weight"])))
            error = ratio * math.sqrt(variance / float(alike["weight"].sum()))
            groups.append({"level": level, "ratio": ratio, "ratio_sigma": error, "n_trials": len(alike)})
        reach, ends = float(np.ptp(tested["x"])), (float(tested["level"].min()), float(tested["level"].max()))
        # Relative change from the smaller value, with its standard error
        larger, p = math.exp(abs(slope) * reach), float(2 * stdtr(dof, -abs(slope) / sigma))
        of_test = (ends if slope >= 0 else ends[::-1], (larger - 1, larger * sigma * reach), p, groups)
        yield _tested(number, vines[0] if n_vines == 1 else "", against, *of_test)


def against_the_sheet(fit: Fit) -> Iterator[Row]:
    """Compare fitted yield pressures with the sheet. With σ₀ that of the sheet and σ that of the fit with exact errors,
    the sheet's own value is part of the fitted one, and their difference has the variance σ₀² − σ², not σ₀²; what the
    fit adds to σ² for scatter comes on top.
    """
    extended = with_systematics(fit.solution).solution
    plain = np.diag(precision(extended).covariance)[: len(fit.numbers)]
    for fitted, free, exact in zip(fit.numbers, fit.predictor.layout.free, plain, strict=True):
        variance = free.prior_sd**2 + fitted.sigma**2 - 2 * float(exact) * free.derivative(fitted.value) ** 2
        if fitted.key != YIELD_PRESSURE or not 0 < variance < math.inf:
            continue
        pulled_Pa, sigma_Pa = fitted.value - free.start, math.sqrt(variance)
        p = math.erfc(abs(pulled_Pa) / sigma_Pa / math.sqrt(2))
        of_test = (free.start, fitted.value), (pulled_Pa, sigma_Pa), p
        yield _tested(fitted, fitted.vine, "sheet", *of_test, stated_sigma_Pa=free.prior_sd)
