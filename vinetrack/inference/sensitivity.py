"""Sensitivities of the predicted positions of every trial to the parameters of a fit, by finite differences.

Each trial has four trial effects: the time of release, the origin of position, the relative deviation of its pressure
from the set value, and the deviation of its ln B from that of its vine. The free parameters of the model come after
them. All trajectories, perturbed and unperturbed, are simulated in one call.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.dynamics.equations import Status
from vinetrack.dynamics.model import Model, check_needs, with_pressures
from vinetrack.dynamics.simulate import (
    Batch,
    SimulationError,
    Trace,
    Trajectory,
    bends_of,
    check_completed,
    lay_out,
    starts_of,
    trajectories,
)
from vinetrack.effects import TrialInputs
from vinetrack.inference.fit_data import FitTrial
from vinetrack.inference.fit_result import DAMPING, EXPONENT, ParameterMap
from vinetrack.inference.gaussian_processes import products

# ------------------------------------------------------------------------------
# Jobs of trajectories to simulate, as arrays: a fit needs a hundred at a time, thousands of times.

OBSERVED = 3  # Column of `Motions.rows` with the position of the edge as the camera reports it (defined)


@dataclass(frozen=True)
class Jobs:
    """Trajectories to simulate, one entry of each array per job; `row` has shape (n_jobs, n_parameters), SI. An index
    gives one of them or a copy of several.
    """

    trial: NDArray[np.int_]
    row: Floats
    yield_pressure_Pa: Floats
    pressure_deviation: Floats
    release_s: Floats

    def with_effect(self, values: Sequence[float]) -> Jobs:
        """The same trajectories for a model with one more effect."""
        return replace(self, row=np.hstack([self.row, np.tile(np.asarray(values, dtype=float), (len(self), 1))]))

    def __len__(self) -> int:
        return self.trial.size

    def __getitem__(self, places: int | slice | list[int] | NDArray[np.int_]) -> Jobs:
        return Jobs(*(values[places] for values in vars(self).values()))

    def __iter__(self) -> Iterator[Jobs]:
        return (self[i] for i in range(len(self)))

    @classmethod
    def concatenated(cls, parts: Sequence[Jobs]) -> Jobs:
        """Several sets of jobs as one."""
        return cls(*map(np.concatenate, zip(*(vars(part).values() for part in parts), strict=True)))


class Average(NamedTuple):
    """Weighted averages of positions over times around each point. `instants_s` are all times needed, increasing;
    `place`, shape (n_points, n_weights), are the indices of those that each average uses; `weights` are the weights.
    """

    instants_s: Floats
    place: NDArray[np.int_]
    weights: Floats

    @classmethod
    def of(cls, time_s: Floats, offsets_s: Floats, weights: Floats) -> Average:
        """Averages around points at these times. Shapes: time_s (n_points,); offsets_s, weights (n_weights,)."""
        instants_s = np.add.outer(time_s, offsets_s)
        order = np.argsort(instants_s, axis=None, kind="stable")
        place = np.empty(order.size, dtype=int)
        place[order] = np.arange(order.size)
        return cls(instants_s.ravel()[order], place.reshape(instants_s.shape), weights)


@dataclass(frozen=True)
class Motions:
    """Simulated trajectories of jobs: `out` and `ends` as `Batch.run` returns them, and the travel ratios of their
    trials.
    """

    batch: Batch
    out: Floats
    ends: Floats
    ratios: list[float]

    def averaged(self, averages: Sequence[Average]) -> Motions:
        """The motions at the requested points, their reported positions averaged over the times around them."""
        places = [first + each.place for first, each in zip(self.batch.starts, averages, strict=False)]
        middles = [place[:, place.shape[1] // 2] for place in places]
        kept, seen = np.concatenate(middles), zip(places, averages, strict=True)
        out = self.out[kept]
        out[:, OBSERVED] = np.concatenate([self.out[place, OBSERVED] @ each.weights for place, each in seen])
        arrays = self.batch.arrays._replace(times=self.batch.arrays.times[kept], starts=starts_of(middles))
        return replace(self, batch=replace(self.batch, stamps=self.batch.stamps[kept], arrays=arrays), out=out)

    def rows(self, first: int, last: int) -> Floats:
        """Position, velocity and acceleration of the tail, and position of the edge as the camera reports it, of jobs
        `first` up to `last`, concatenated, (n_times, 4).
        """
        return self.out[self.batch.starts[first] : self.batch.starts[last]]

    def trajectories(self) -> list[Trajectory]:
        """One trajectory per job."""
        return trajectories(self.batch, self.out, self.ends, self.ratios)


# ------------------------------------------------------------------------------
# Finite differences of the observed positions of a trial, taken correctly across the end of growth.


def position_change(plain: Trajectory, moved: Trajectory) -> Floats:
    """Change of the observed positions of a trial under a small perturbation, m, shape (n_points,). Growth ends at the
    same position whenever it ends: after it the change is that of the end position, or 0 where only the time changes.
    """
    change = np.asarray(moved.observed_position_m - plain.observed_position_m)
    if plain.status == "ended":
        change[plain.time_s > plain.end_time_s] = change[-1] if moved.status == "ended" else 0.0
    return change


RELEASE, ORIGIN, PRESSURE, DAMPING_DEVIATION = range(4)
N_TRIAL_EFFECTS = 4  # Trial effects of each trial: release, s; origin, m; relative deviation of pressure (defined)


class Predictor:
    """Simulates the trials of a fit and differentiates their positions. `has_pressure_deviation`, shape (n_trials,),
    tells which trials have a pressure that may deviate: one that was set, or measured by a noisy gauge.
    `has_damping_deviation` tells which have a B.
    """

    def __init__(self, layout: ParameterMap, data: Sequence[FitTrial], host: Model | None = None) -> None:
        self.layout, self.data, self.host = layout, data, host
        model = layout.model
        self.damping_column = model.parameter_names.index(DAMPING) if DAMPING in model.parameter_names else -1
        self.with_trace = np.array([each.trace is not None for each in data], dtype=bool)
        self.ratios = [each.trial.travel_ratio for each in data]
        uncertain = [each.trial.pressure_Pa > 0 if each.trace is None else each.gauge_error > 0 for each in data]
        self.has_pressure_deviation = np.array(uncertain, dtype=bool) & ("pressure_drive" in model)
        self.has_damping_deviation = (np.array(self.ratios) != 1) & (self.damping_column >= 0)
        check_needs(model, *(each.trial for each in data))
        self.inputs = np.array([TrialInputs.of(each.trial) for each in data], dtype=float)
        self.bends = [bends_of(each.trial) for each in data]
        seen_otherwise = {"true_time", "observed_position", "row_delay", "averaged_over"}
        smoothed = any(each.smoothing is not None for each in data)
        self.averages = [Average.of(each.time_s, *each.window) for each in data] if smoothed else []
        transformed = smoothed or any(seen_otherwise & set(effect.functions) for effect in model)
        self.release_is_shift = ~self.with_trace & (not transformed)
        self.times_s = [np.asarray(each.time_s, dtype=float) for each in data]
        self.starts = starts_of(self.times_s)
        self.lead_position_m = np.concatenate([each.lead_position_m for each in data])
        self.spans_m = np.array([np.ptp(each.lead_position_m) for each in data])
        self.first = np.concatenate([each.first for each in data])
        unequal_noise = any(each.relative_sd is not None for each in data)
        self.relative_sd = np.concatenate([each.point_sd for each in data]) if unequal_noise else None
        self.frames_s = np.array([each.frame_s for each in data])
        self.pressure_step = np.full(len(data), 1e-3)
        self.steps = np.full(len(layout.keys), 1e-3)
        self.is_central = False  # whether differences are central, of twice as many simulations

    def with_steps_of(self, other: Predictor) -> Predictor:
        """The predictor with the deviations of another one of the same parameters and trials, and with the finite
        differences to which that has adapted.
        """
        self.has_pressure_deviation, self.has_damping_deviation = (
            other.has_pressure_deviation,
            other.has_damping_deviation,
        )
        self.steps, self.pressure_step = other.steps.copy(), other.pressure_step.copy()
        self.is_central = other.is_central
        return self

    def run(self, jobs: Jobs, times_s: Sequence[Floats] | None = None, model: Model | None = None) -> list[Trajectory]:
        """Simulate at the times of each job's trial, or at `times_s`, by the model of the fit or another one."""
        return self._simulated(jobs, times_s, model).trajectories()

    def _simulated(self, jobs: Jobs, times_s: Sequence[Floats] | None = None, model: Model | None = None) -> Motions:
        trials = jobs.trial
        inputs = with_pressures(
            self.inputs[trials], self.inputs[trials, 0] * (1 + jobs.pressure_deviation), jobs.yield_pressure_Pa
        )
        averages = [self.averages[i] for i in trials] if times_s is None and self.averages else []
        if times_s is None:
            times_s = [average.instants_s for average in averages] or [self.times_s[i] for i in trials]
        starts = starts_of(times_s)
        batch = lay_out(
            model or self.layout.model,
            inputs,
            [self.bends[i] for i in trials],
            np.concatenate(times_s) - np.repeat(jobs.release_s, np.diff(starts)),
            starts,
            traces=self._traces(jobs) if self.with_trace.any() else None,
            parameters=jobs.row,
            host=self.host,
        )
        out, ends = batch.run()
        check_completed(ends, [self.data[i].trial.name for i in trials])
        motions = Motions(batch, out, ends, [self.ratios[i] for i in trials])
        return motions.averaged(averages) if averages else motions

    def _traces(self, jobs: Jobs) -> list[Trace | None]:
        """Recorded pressures by time since the release of each job."""
        traces = (self.data[i].trace for i in jobs.trial)
        return [
            None if trace is None else (trace[0] - release_s, trace[1] * (1 + deviation))
            for trace, release_s, deviation in zip(traces, jobs.release_s, jobs.pressure_deviation, strict=True)
        ]

    def jobs(self, theta: Floats, trial_effects: Floats) -> Jobs:
        """Simulation jobs at given parameters, (n_free,), and trial effects, (n_trials, 4)."""
        rows, yields = self.layout.rows(theta)
        deviations = trial_effects[:, [PRESSURE, DAMPING_DEVIATION]] + self.layout.shifts(theta)
        if self.damping_column >= 0:
            rows[:, self.damping_column] *= np.exp(deviations[:, 1])
        return Jobs(np.arange(len(self.data)), rows, yields, deviations[:, 0], trial_effects[:, RELEASE])

    def trajectories_at(self, theta: Floats, trial_effects: Floats) -> list[Trajectory]:
        """Trajectories at given parameters and trial effects."""
        return self.run(self.jobs(theta, trial_effects))

    def residuals(self, theta: Floats, trial_effects: Floats) -> Floats:
        """Measured minus predicted positions of all trials, (n_points_of_all,)."""
        motions = self._simulated(self.jobs(theta, trial_effects))
        return self._residuals(motions.rows(0, len(self.data))[:, OBSERVED], trial_effects)

    def _residuals(self, observed_m: Floats, trial_effects: Floats) -> Floats:
        """Measured minus predicted positions of all trials, concatenated."""
        return self.lead_position_m - np.repeat(trial_effects[:, ORIGIN], np.diff(self.starts)) - observed_m

    def linearise(self, theta: Floats, trial_effects: Floats, *, trial_effects_only: bool = False) -> list[Floats]:
        """Sensitivities [trial effects, keys of the layout] and residual of every trial, (n_points, 4 + n_keys + 1).
        One-sided differences hold second derivatives, which promise steps that no trajectory keeps: they are for trial
        effects alone, and far from a fit.
        """
        unperturbed, central = self.jobs(theta, trial_effects), self.is_central and not trial_effects_only
        sides, at = ((1, -1) if central else (1,)), (unperturbed, theta, trial_effects, trial_effects_only)
        perturbations = [one for side in sides for one in self._perturbations(*at, side)]
        motions = self._simulated(Jobs.concatenated([unperturbed, *(jobs for _, _, jobs in perturbations)]))
        count = len(self.data)
        rows = motions.rows(0, count)
        table = np.zeros((rows.shape[0], N_TRIAL_EFFECTS + len(self.layout.keys) + 1))
        table[:, ORIGIN] = 1.0
        table[:, RELEASE] = -(rows[:, 1] / np.repeat(self.ratios, np.diff(self.starts)))
        table[self._points_of(np.flatnonzero(~self.release_is_shift)), RELEASE] = 0.0  # differenced below
        table[:, -1] = self._residuals(rows[:, OBSERVED], trial_effects)
        first = count
        for place, steps, perturbed in perturbations:
            jobs, first = slice(first, first + len(perturbed)), first + len(perturbed)
            points = self._points_of(perturbed.trial)
            change = motions.rows(jobs.start, jobs.stop)[:, OBSERVED] - rows[points, OBSERVED]
            self._clip_after_end(change, motions, perturbed.trial, jobs)
            table[points, place] += change / np.repeat(steps, np.diff(self.starts)[perturbed.trial]) / len(sides)
        if DAMPING in self.layout.keys:
            # The sensitivity to ln B of the vine is also that to the deviation of ln B.
            points = self._points_of(np.flatnonzero(self.has_damping_deviation))
            table[points, DAMPING_DEVIATION] = table[points, N_TRIAL_EFFECTS + self.layout.keys.index(DAMPING)]
        for term in self.layout.between:
            if term.key in self.layout.keys:
                # The sensitivity to a difference between trials is that to the deviation, times the regressor.
                column, source = self.layout.keys.index(term.key), PRESSURE if term.pressure else DAMPING_DEVIATION
                trials = np.flatnonzero(self.layout.index[:, column] >= 0)
                points = self._points_of(trials)
                regressor = np.repeat(term.regressor[trials], np.diff(self.starts)[trials])
                table[points, N_TRIAL_EFFECTS + column] = term.scale * regressor * table[points, source]
        if not trial_effects_only:
            # Steps for the next call, by how far these moved the trajectories.
            responses = np.maximum.reduceat(np.abs(table), self.starts[:-1], axis=0) / self.spans_m[:, None]
            self.steps = _adapted_steps(np.max(responses[:, N_TRIAL_EFFECTS:-1], axis=0, initial=0.0), self.steps)
            self.pressure_step = _adapted_steps(responses[:, PRESSURE], self.pressure_step)
        return np.split(table, self.starts[1:-1])

    def _points_of(self, trials: NDArray[np.int_]) -> slice | NDArray[np.int_]:
        """Rows of some trials among the concatenated points of all."""
        if trials.size == len(self.data):
            return slice(None)
        chosen = np.zeros(len(self.data), dtype=bool)
        chosen[trials] = True
        return np.flatnonzero(np.repeat(chosen, np.diff(self.starts)))

    def _clip_after_end(self, change: Floats, motions: Motions, trials: NDArray[np.int_], jobs: slice) -> None:
        """Set the changes of position after the end of growth, see `position_change`."""
        plain, moved = motions.ends[trials], motions.ends[jobs]
        counts = np.diff(self.starts)[trials]
        end_s = np.repeat(np.where(plain[:, 0] == Status.ENDED, plain[:, 1], math.inf), counts)
        over = motions.batch.stamps[: self.starts[-1]][self._points_of(trials)] > end_s
        at_end = np.where(moved[:, 0] == Status.ENDED, change[np.cumsum(counts) - 1], 0.0)
        change[over] = np.repeat(at_end, counts)[over]

    def products(self, columns: Sequence[Floats]) -> Floats:
        """Cross products of the columns of every trial under its noise, (n_trials, 3, k, k)."""
        of_trials = zip(columns, self.data, strict=True)
        return np.stack([products(values, trial.first, trial.relative_sd) for values, trial in of_trials])

    def _perturbations(
        self, unperturbed: Jobs, theta: Floats, trial_effects: Floats, trial_effects_only: bool, side: int
    ) -> Iterator[tuple[int, Floats, Jobs]]:
        """Place of each column to be differenced, step of each trial (within the bounds), and perturbed jobs."""
        damping_step = 1e-3 * side  # Relative step of B (derived)
        if len(shifted_trials := np.flatnonzero(~self.release_is_shift)):
            # 0.1: step of the release, frames (chosen)
            steps, perturbed = side * 0.1 * self.frames_s[shifted_trials], unperturbed[shifted_trials]
            yield RELEASE, steps, replace(perturbed, release_s=perturbed.release_s + steps)
        if len(pressure_trials := np.flatnonzero(self.has_pressure_deviation)):
            steps, perturbed = side * self.pressure_step[pressure_trials], unperturbed[pressure_trials]
            yield PRESSURE, steps, replace(perturbed, pressure_deviation=perturbed.pressure_deviation + steps)
        if DAMPING not in self.layout.keys and len(damping_trials := np.flatnonzero(self.has_damping_deviation)):
            perturbed = unperturbed[damping_trials]
            perturbed.row[:, self.damping_column] *= np.exp(damping_step)
            yield DAMPING_DEVIATION, np.full(damping_trials.size, damping_step), perturbed
        lower, upper = self.layout.bounds
        for column, key in enumerate(self.layout.keys):
            trials_of_key = np.flatnonzero(self.layout.index[:, column] >= 0)
            if not trials_of_key.size or (trial_effects_only and key != DAMPING) or self.layout.term(key) is not None:
                continue
            places = self.layout.index[trials_of_key, column]
            step = side * float(self.steps[column])
            there = theta[places] + step
            steps = np.where((there > upper[places]) | (there < lower[places]), -step, step)
            perturbed_theta = theta.copy()
            perturbed_theta[places] = theta[places] + steps
            perturbed = self.jobs(perturbed_theta, trial_effects)[trials_of_key]
            yield N_TRIAL_EFFECTS + column, steps, perturbed


def _adapted_steps(response: Floats, previous: Floats) -> Floats:
    """Steps that give the target response, from the responses to unit steps."""
    # 2e-3: finite differences use steps that move a trajectory by this fraction of its travel (derived)
    # 1e-5, 0.1: least and largest relative step of a finite difference (derived)
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        return np.where(response > 0, np.clip(2e-3 / response, 1e-5, 0.1), previous)


# ------------------------------------------------------------------------------
# Starting values of a fit: release and origin from the frames at rest, B from a coarse search.


def initial_trial_effects(data: Sequence[FitTrial]) -> Floats:
    """Release and origin of every trial from its frames at rest; zero deviations. Shape (n_trials, 4)."""
    trial_effects = np.zeros((len(data), N_TRIAL_EFFECTS))
    for i, trial_data in enumerate(data):
        trial_effects[i, RELEASE], trial_effects[i, ORIGIN] = trial_data.rest_end_s, trial_data.rest_origin_m
        if trial_data.pressurised_in_recording:
            assert trial_data.trace is not None
            trial_effects[i, RELEASE] = min(trial_data.time_s[0], trial_data.trace[0][0])
    return trial_effects


def best_start(predictor: Predictor) -> Floats:
    """Scaled parameters of least misfit, of all combinations of further starting values, each release scanned."""
    layout, scored = predictor.layout, list[tuple[float, int, Floats]]()
    trial_effects, failure = initial_trial_effects(predictor.data), None
    start_values = [sorted({number.start, *number.further_starts}) for number in layout.free]
    for values in itertools.islice(itertools.product(*start_values), 12):
        start = np.array([number.to_scaled(value) for value, number in zip(values, layout.free, strict=True)])
        try:
            if DAMPING in layout.keys:
                start = _with_best_damping(predictor, start, trial_effects)
            scored.append((float(np.sum(align(predictor, start, trial_effects)[1])), len(scored), start))
        except SimulationError as error:
            failure = error
    if not scored and failure:
        raise failure
    return min(scored)[2]


def _with_best_damping(predictor: Predictor, theta: Floats, trial_effects: Floats) -> Floats:
    """Starting values with the B of least misfit for every vine, of a few that balance part of the drive."""
    layout, data = predictor.layout, predictor.data
    exponents = layout.rows(theta)[0][:, layout.model.parameter_names.index(EXPONENT)]
    # Forces on the tips above the yield forces, N, from the recorded pressures where there are any
    pressure_Pa = np.array([each.typical_pressure_Pa for each in data])
    over_Pa = pressure_Pa - np.nan_to_num([each.trial.yield_pressure_Pa for each in data])
    force_N = np.maximum(over_Pa, 1e-3 * np.abs(pressure_Pa)) * [each.trial.area_m2 for each in data]
    log_B = np.log(np.maximum(force_N, 1e-9)) - exponents * np.log(list(map(middle_speed, data)))
    of_trial, theta = layout.index[:, layout.keys.index(DAMPING)], theta.copy()
    best = dict.fromkeys(np.unique(of_trial), (math.inf, 0.0))
    for part in (0.2, 0.4, 0.6, 0.8, 0.95, 1.1):  # (chosen)
        for k in best:
            free = layout.free[k]
            B = part * float(np.exp(np.mean(log_B[of_trial == k])))
            theta[k] = free.to_scaled(float(np.clip(B, free.lower, free.upper)))
        with suppress(SimulationError):
            misfit = align(predictor, theta, trial_effects)[1]
            best = {k: min(of, (float(np.sum(misfit[of_trial == k])), float(theta[k]))) for k, of in best.items()}
    theta[list(best)] = [B for _, B in best.values()]
    return theta


def middle_speed(trial_data: FitTrial) -> float:
    """Mean speed of the tail from 40 to 85 % of the observed growth. Returns above 0."""
    y = trial_data.lead_position_m - trial_data.rest_origin_m
    total = float(np.max(y))
    low, high = (int(np.argmax(y >= part * total)) for part in (0.4, 0.85))
    high = max(high, low + 1) if low + 1 < y.size else low
    elapsed = trial_data.time_s[high] - trial_data.time_s[low] or trial_data.frame_s
    return max(trial_data.trial.travel_ratio * float(y[high] - y[low]) / float(elapsed), 1e-6)


# ------------------------------------------------------------------------------
# The release of a trial. Since a trajectory depends only on the time since release, one simulation, shifted in time,
# gives the misfit of every release.


def candidate_releases(trial_data: FitTrial, release_s: float) -> Floats:
    """Releases among which that of a trial is searched, s, shape (n,); the last is the given one."""
    if trial_data.pressurised_in_recording:
        return np.array([release_s])
    if trial_data.shows_rest:
        # Candidate releases of a trial recorded at rest, frames from the given one, which comes last (chosen)
        frames = [*np.arange(-14.0, 15.0), -0.6, -0.3, -0.12, -0.05, 0.05, 0.12, 0.3, 0.6, 0.0]
        return release_s + trial_data.frame_s * np.array(frames)
    duration_s = float(trial_data.time_s[-1] - trial_data.time_s[0])
    # 160: candidate releases of a trial recorded only in motion. With 60 the maximum that is found depends on the start
    # (measured).
    return np.append(trial_data.time_s[0] - np.geomspace(0.1 * trial_data.frame_s, duration_s, 160), release_s)


def over_time(predictor: Predictor, release_s: Floats, releases: Sequence[Floats]) -> Predictor:
    """A predictor of positions relative to 0 of the same trials, released at given times, (n_trials,), until the ends
    of their tracks would need them were they released at the earliest of these.
    """
    # 600: points of the time grid of a trajectory that is shifted, denser at its start (derived)
    grid = np.linspace(0.0, 1.0, 600) ** 1.5
    data = [
        replace(
            each,
            time_s=begin_s + (each.time_s[-1] - candidates_s.min()) * grid,
            lead_position_m=0 * grid,
            first=grid == 0,
            relative_sd=None,
            smoothing=None,
        )
        for each, begin_s, candidates_s in zip(predictor.data, release_s, releases, strict=True)
    ]
    return Predictor(predictor.layout, data, predictor.host).with_steps_of(predictor)


def align(predictor: Predictor, theta: Floats, trial_effects: Floats) -> tuple[Floats, Floats]:
    """Best release and origin of each trial at given parameters. Returns trial_effects, misfit (ln of the root mean
    square relative to the travel). Shapes: theta (n_free,); trial_effects (n_trials, 4) → (n_trials, 4), (n_trials,).
    """
    data = predictor.data
    # With the pressures of the sheet: the releases that suit deviations of another model start a fit in worse minima.
    of_sheet = {"pressure_deviation": np.zeros(len(data)), "yield_pressure_Pa": np.full(len(data), math.nan)}
    jobs = replace(predictor.jobs(theta, trial_effects), **of_sheet)
    releases = [candidate_releases(*each) for each in zip(data, jobs.release_s.tolist(), strict=True)]
    dense = over_time(predictor, jobs.release_s, releases)
    best, misfit = trial_effects.copy(), np.zeros(len(data))
    for i, (trial_data, moved) in enumerate(zip(data, dense.run(jobs), strict=True)):
        begin = 0 if trial_data.pressurised_in_recording else max(trial_data.n_rest - 5, 0)
        # 60: points that are compared, most of them in motion (chosen)
        seen = np.unique(np.linspace(begin, trial_data.time_s.size - 1, 60).astype(int))
        y = trial_data.lead_position_m[seen]
        since_s = trial_data.time_s[seen] - releases[i][:, None]
        residual_m = y - np.interp(since_s, moved.time_s, moved.observed_position_m)
        origin = residual_m.mean(axis=1)
        square = np.mean((residual_m - origin[:, None]) ** 2, axis=1)
        k = int(np.argmin(square))
        best[i, RELEASE], best[i, ORIGIN] = releases[i][k], origin[k]
        misfit[i] = 0.5 * np.log(square[k] / np.ptp(y) ** 2 + 1e-8)
    return best, misfit
