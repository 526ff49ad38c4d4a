"""Sensitivities of the predicted positions of every trial to the parameters of a fit, by finite differences.

Each trial has four trial effects: the time of release, the origin of position, the relative deviation of its pressure
from the set value, and the deviation of its ln B from that of its vine. The free parameters of the model come after
them. All trajectories, perturbed and unperturbed, are simulated in one call.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.dynamics.batch import Trace, lay_out, starts_of
from vinetrack.dynamics.model import Model
from vinetrack.dynamics.simulate import ENDED, Trajectory, bends_of
from vinetrack.dynamics.trial_inputs import check_needs, trial_inputs, with_pressures
from vinetrack.effects import TrialInputs
from vinetrack.inference.fit_data import FitTrial
from vinetrack.inference.parameters import DAMPING, YIELD_PRESSURE, ParameterMap
from vinetrack.inference.position_change import clip_at_end, position_change
from vinetrack.inference.trajectory_jobs import OBSERVED, Average, Job, Jobs, Motions, first_identical_trials
from vinetrack.inference.whitening import all_products

RELEASE, ORIGIN, PRESSURE, DAMPING_DEVIATION = range(4)
N_TRIAL_EFFECTS = 4  # Trial effects of each trial: release, s; origin, m; relative deviation of pressure (defined)

TARGET_RESPONSE = 2e-3  # Finite differences use steps that move a trajectory by this fraction of its travel (derived)

SMALLEST_STEP, LARGEST_STEP = 1e-5, 0.1  # Least and largest relative step of a finite difference (derived)

RELEASE_STEP_FRAMES = 0.1  # Step of the release (chosen)

PAYLOAD_COLUMN = TrialInputs._fields.index("payload_mass")
DAMPING_STEP = 1e-3  # Relative step of B (derived)


class Predictor:
    """Simulates the trials of a fit and differentiates their positions. `has_pressure_deviation`, shape (n_trials,),
    tells which trials have a pressure that may deviate: one that was set, or measured by a noisy gauge.
    `has_damping_deviation` tells which have a B.
    """

    separable = True

    def __init__(self, layout: ParameterMap, data: Sequence[FitTrial], host: Model | None = None) -> None:
        self.layout, self.data, self.host = layout, data, host
        model = layout.model
        self.damping_column = model.parameter_names.index(DAMPING) if DAMPING in model.parameter_names else -1
        driven = "pressure_drive" in model
        self.has_pressure_deviation = np.array(
            [
                driven
                and (trial_data.trial.pressure_Pa > 0 if trial_data.trace is None else trial_data.gauge_error > 0)
                for trial_data in data
            ],
            dtype=bool,
        )
        self.has_damping_deviation = np.array(
            [self.damping_column >= 0 and trial_data.trial.travel_ratio != 1 for trial_data in data], dtype=bool
        )
        check_needs(model, *(trial_data.trial for trial_data in data))
        self.inputs = np.array([trial_inputs(trial_data.trial) for trial_data in data], dtype=float)
        self.bends = [bends_of(trial_data.trial) for trial_data in data]
        transformed = any(
            {"true_time", "observed_position", "row_delay", "averaged_over"} & set(effect.functions) for effect in model
        )
        smoothed = any(trial_data.smoothing is not None for trial_data in data)
        self.averages = [Average.of(trial_data.time_s, *trial_data.window) for trial_data in data] if smoothed else []
        transformed |= smoothed
        self.release_is_shift = np.array([trial_data.trace is None and not transformed for trial_data in data])
        self.identical_trials = first_identical_trials(data, self.inputs, self.bends)
        self.any_identical = bool(np.any(self.identical_trials != np.arange(self.identical_trials.size)))
        self.ratios = [trial_data.trial.travel_ratio for trial_data in data]
        self.times_s = [np.asarray(trial_data.time_s, dtype=float) for trial_data in data]
        self.starts = starts_of(self.times_s)
        self.lead_position_m = np.concatenate([trial_data.lead_position_m for trial_data in data])
        self.spans_m = np.array([np.ptp(trial_data.lead_position_m) for trial_data in data])
        self.first = np.concatenate([trial_data.first for trial_data in data])
        unequal_noise = any(trial_data.relative_sd is not None for trial_data in data)
        self.relative_sd = np.concatenate([trial_data.point_sd for trial_data in data]) if unequal_noise else None
        self.frames_s = np.array([trial_data.frame_s for trial_data in data])
        self.with_trace = np.array([trial_data.trace is not None for trial_data in data], dtype=bool)
        self.pressure_step = np.full(len(data), 1e-3)
        self.steps = np.full(len(layout.keys), 1e-3)

    def run(self, jobs: Sequence[Job], times_s: Sequence[Floats] | None = None) -> list[Trajectory]:
        """Simulate at the times of each job's trial, or at `times_s`."""
        return self.run_as(self.layout.model, Jobs.of(jobs), times_s)

    def run_as(self, model: Model, jobs: Jobs, times_s: Sequence[Floats] | None = None) -> list[Trajectory]:
        """Simulate another model for the same trials."""
        return self._simulated(model, jobs, times_s).trajectories()

    def _simulated(self, model: Model, jobs: Jobs, times_s: Sequence[Floats] | None = None) -> Motions:
        """Trajectories of the jobs; identical replicates of a planned campaign are simulated once."""
        trajectory_of = np.arange(len(jobs))
        if times_s is None and self.any_identical:
            first, trajectory_of = jobs.distinct(self.identical_trials)
            jobs = jobs.take(first)
        trials = jobs.trial
        inputs = with_pressures(
            self.inputs[trials], self.inputs[trials, 0] * (1 + jobs.pressure_deviation), jobs.yield_pressure_Pa
        )
        inputs[:, PAYLOAD_COLUMN] *= jobs.payload_factor
        averages = [self.averages[i] for i in trials] if times_s is None and self.averages else []
        if times_s is None:
            times_s = [average.instants_s for average in averages] or [self.times_s[i] for i in trials]
        starts = starts_of(times_s)
        batch = lay_out(
            model,
            inputs,
            [self.bends[i] for i in trials],
            np.concatenate(times_s) - np.repeat(jobs.release_s, np.diff(starts)),
            starts,
            traces=self._traces(jobs) if self.with_trace.any() else None,
            parameters=jobs.row,
            host=self.host,
        )
        motions = Motions.of(batch, [self.data[i].trial for i in trials], trajectory_of)
        return motions.averaged(averages) if averages else motions

    def _traces(self, jobs: Jobs) -> list[Trace | None]:
        """Recorded pressures by time since the release of each job."""
        traces = (self.data[i].trace for i in jobs.trial)
        return [
            None if trace is None else (trace[0] - release_s, trace[1] * (1 + deviation))
            for trace, release_s, deviation in zip(traces, jobs.release_s, jobs.pressure_deviation, strict=True)
        ]

    def jobs(self, theta: Floats, trial_effects: Floats) -> list[Job]:
        """Simulation jobs at given parameters and trial effects. Shapes: theta (n_free,); trial_effects
        (n_trials, 4).
        """
        return self.job_arrays(theta, trial_effects).as_list()

    def job_arrays(self, theta: Floats, trial_effects: Floats) -> Jobs:
        """As `jobs`, in the form of arrays. Shapes: theta (n_free,); trial_effects (n_trials, 4)."""
        rows, yields = self.layout.rows(theta)
        trial_effects = self._total_deviations(theta, trial_effects)
        if self.damping_column >= 0:
            rows[:, self.damping_column] *= np.exp(trial_effects[:, DAMPING_DEVIATION])
        count = len(self.data)
        pressure, release = trial_effects[:, PRESSURE], trial_effects[:, RELEASE]
        return Jobs(np.arange(count), rows, yields, pressure, release, np.ones(count))

    def _total_deviations(self, theta: Floats, trial_effects: Floats) -> Floats:
        """Trial effects with the systematic differences between trials added to the deviations."""
        if not self.layout.between:
            return trial_effects
        whole = trial_effects.copy()
        whole[:, [PRESSURE, DAMPING_DEVIATION]] += self.layout.shifts(theta)
        return whole

    def trajectories_at(self, theta: Floats, trial_effects: Floats) -> list[Trajectory]:
        """Trajectories at given parameters and trial effects. Shapes: theta (n_free,); trial_effects (n_trials, 4)."""
        return self.run_as(self.layout.model, self.job_arrays(theta, trial_effects))

    def residuals(self, theta: Floats, trial_effects: Floats) -> list[Floats]:
        """Measured minus predicted positions of every trial. Shapes: theta (n_free,); trial_effects (n_trials, 4) →
        (n_points,).
        """
        return self.residuals_of_each(theta, [trial_effects])[0]

    def residuals_of_each(self, theta: Floats, effect_sets: Sequence[Floats]) -> list[list[Floats]]:
        """As `residuals`, for several sets of trial effects, simulated in one call. Shapes: theta (n_free,);
        effect_sets (n_trials, 4) → (n_points,).
        """
        count = len(self.data)
        motions = self._simulated(
            self.layout.model, Jobs.concatenated([self.job_arrays(theta, effects) for effects in effect_sets])
        )
        observed_m = [motions.rows(k * count, (k + 1) * count)[:, OBSERVED] for k in range(len(effect_sets))]
        return [
            self.by_trial(self._residuals(observed_of_set, effects))
            for observed_of_set, effects in zip(observed_m, effect_sets, strict=True)
        ]

    def _residuals(self, observed_m: Floats, trial_effects: Floats) -> Floats:
        """Measured minus predicted positions of all trials, concatenated."""
        return self.lead_position_m - np.repeat(trial_effects[:, ORIGIN], np.diff(self.starts)) - observed_m

    def by_trial(self, values: Floats) -> list[Floats]:
        """Split an array over the points of all trials into one per trial. Shapes: values (n_points_of_all, …) →
        (n_points, …).
        """
        edges = self.starts.tolist()
        return [values[a:b] for a, b in itertools.pairwise(edges)]

    def linearise(
        self, theta: Floats, trial_effects: Floats, *, trial_effects_only: bool = False, past_end: bool = False
    ) -> list[Floats]:
        """Sensitivities [trial effects, keys of the layout] and residual of every trial, as columns. Shapes: theta
        (n_free,); trial_effects (n_trials, 4) → (n_points, 4 + n_keys + 1).
        """
        unperturbed, total = self.job_arrays(theta, trial_effects), self._total_deviations(theta, trial_effects)
        perturbations = list(self._perturbations(unperturbed, theta, total, trial_effects_only))
        motions = self._simulated(
            self.layout.model, Jobs.concatenated([unperturbed, *(perturbed for _, _, perturbed in perturbations)])
        )
        count = len(self.data)
        rows = motions.rows(0, count)
        table = np.zeros((rows.shape[0], N_TRIAL_EFFECTS + len(self.layout.keys) + 1))
        table[:, ORIGIN] = 1.0
        table[:, RELEASE] = -(rows[:, 1] / np.repeat(self.ratios, np.diff(self.starts)))
        table[:, -1] = self._residuals(rows[:, OBSERVED], trial_effects)
        trajectories = motions.trajectories() if past_end else []
        first = count
        for place, steps, perturbed in perturbations:
            jobs, first = slice(first, first + len(perturbed)), first + len(perturbed)
            points = self._points_of(perturbed.trial)
            if past_end:
                pairs = zip(perturbed.trial, trajectories[jobs], strict=True)
                change = np.concatenate(
                    [position_change(trajectories[i], perturbed_trajectory) for i, perturbed_trajectory in pairs]
                )
            else:
                change = motions.rows(jobs.start, jobs.stop)[:, OBSERVED] - rows[points, OBSERVED]
                self._clip_after_end(change, motions, perturbed.trial, jobs)
            table[points, place] = change / np.repeat(steps, np.diff(self.starts)[perturbed.trial])
        columns = self.by_trial(table)
        self._copy_damping_column(columns)
        self._fill_between_columns(columns)
        if not (trial_effects_only or past_end):
            self._adapt_steps(table)
        return columns

    def _points_of(self, trials: NDArray[np.int_]) -> slice | NDArray[np.int_]:
        """Rows of some trials among the concatenated points of all."""
        if trials.size == len(self.data):
            return slice(None)
        return np.concatenate([np.arange(self.starts[i], self.starts[i + 1]) for i in trials])

    def _clip_after_end(self, change: Floats, motions: Motions, trials: NDArray[np.int_], jobs: slice) -> None:
        """Set the changes of position after the end of growth, see `position_change.clip_at_end`."""
        ends = motions.ends[motions.trajectory_of]
        if not np.any(ends[trials, 0] == ENDED):
            return
        starts = starts_of([self.times_s[i] for i in trials])
        for k, (i, perturbed_end) in enumerate(zip(trials, ends[jobs], strict=True)):
            if ends[i, 0] == ENDED:
                over = motions.stamps(i) > ends[i, 1]
                clip_at_end(change[starts[k] : starts[k + 1]], over, moved_ends=perturbed_end[0] == ENDED)

    def products(self, columns: Sequence[Floats]) -> Floats:
        """Cross products of the columns of every trial under its noise, see `whitening`. Shapes: columns (n_points, k)
        → (n_trials, 3, k, k).
        """
        return all_products(
            columns,
            [trial_data.first for trial_data in self.data],
            [trial_data.relative_sd for trial_data in self.data],
        )

    def _perturbations(
        self, unperturbed: Jobs, theta: Floats, trial_effects: Floats, trial_effects_only: bool
    ) -> Iterator[tuple[int, Floats, Jobs]]:
        """For each column to be differenced: its place, the step of each trial, and the perturbed jobs."""
        if len(shifted_trials := np.flatnonzero(~self.release_is_shift)):
            steps, perturbed = RELEASE_STEP_FRAMES * self.frames_s[shifted_trials], unperturbed.take(shifted_trials)
            yield RELEASE, steps, replace(perturbed, release_s=perturbed.release_s + steps)
        if len(pressure_trials := np.flatnonzero(self.has_pressure_deviation)):
            steps, perturbed = self.pressure_step[pressure_trials], unperturbed.take(pressure_trials)
            yield PRESSURE, steps, replace(perturbed, pressure_deviation=perturbed.pressure_deviation + steps)
        if DAMPING not in self.layout.keys and len(damping_trials := np.flatnonzero(self.has_damping_deviation)):
            perturbed = unperturbed.take(damping_trials)
            perturbed.row[:, self.damping_column] *= np.exp(DAMPING_STEP)
            yield DAMPING_DEVIATION, np.full(damping_trials.size, DAMPING_STEP), perturbed
        upper = self.layout.bounds[1]
        for column, key in enumerate(self.layout.keys):
            trials_of_key = np.flatnonzero(self.layout.index[:, column] >= 0)
            if not trials_of_key.size or (trial_effects_only and key != DAMPING) or self.layout.term(key) is not None:
                continue
            places = self.layout.index[trials_of_key, column]
            step = float(self.steps[column])
            steps = np.where(theta[places] + step > upper[places], -step, step)
            perturbed = unperturbed.take(trials_of_key)
            parameters = [self.layout.free[place] for place in places]
            perturbed_theta = theta[places] + steps
            if key == YIELD_PRESSURE:
                perturbed.yield_pressure_Pa[:] = [
                    number.from_scaled(x) for number, x in zip(parameters, perturbed_theta, strict=True)
                ]
            elif key == DAMPING:
                perturbed_theta = perturbed_theta + trial_effects[trials_of_key, DAMPING_DEVIATION]
                perturbed.row[:, self.damping_column] = [
                    number.from_scaled(x) for number, x in zip(parameters, perturbed_theta, strict=True)
                ]
            else:
                pairs = zip(parameters, theta[places], perturbed_theta, strict=True)
                k = self.layout.model.parameter_names.index(key)
                perturbed.row[:, k] += [number.from_scaled(x) - number.from_scaled(base) for number, base, x in pairs]
            yield N_TRIAL_EFFECTS + column, steps, perturbed

    def _copy_damping_column(self, columns: list[Floats]) -> None:
        """Copy the sensitivity to ln B to the deviation of ln B: they are the same."""
        if DAMPING not in self.layout.keys:
            return
        column = self.layout.keys.index(DAMPING)
        for i in np.flatnonzero(self.has_damping_deviation):
            columns[i][:, DAMPING_DEVIATION] = columns[i][:, N_TRIAL_EFFECTS + column]

    def _fill_between_columns(self, columns: list[Floats]) -> None:
        """Sensitivities to coefficients of differences between trials: that to the deviation, times the regressor."""
        for term in self.layout.between:
            if term.key not in self.layout.keys:
                continue
            column, source = self.layout.keys.index(term.key), PRESSURE if term.pressure else DAMPING_DEVIATION
            for i in np.flatnonzero(self.layout.index[:, column] >= 0):
                columns[i][:, N_TRIAL_EFFECTS + column] = term.scale * term.regressor[i] * columns[i][:, source]

    def _adapt_steps(self, table: Floats) -> None:
        """Adapt the step sizes for the next call to how far these steps moved the trajectories."""
        responses = np.maximum.reduceat(np.abs(table), self.starts[:-1], axis=0) / self.spans_m[:, None]
        for column in range(len(self.layout.keys)):
            self.steps[column] = _adapted_step(
                float(np.max(responses[:, N_TRIAL_EFFECTS + column])), float(self.steps[column])
            )
        for i in np.flatnonzero(self.has_pressure_deviation):
            self.pressure_step[i] = _adapted_step(float(responses[i, PRESSURE]), float(self.pressure_step[i]))


def _adapted_step(response: float, previous: float) -> float:
    """Step that gives the target response, from the response to a unit step."""
    if not response > 0:
        return previous
    return float(np.clip(TARGET_RESPONSE / response, SMALLEST_STEP, LARGEST_STEP))
