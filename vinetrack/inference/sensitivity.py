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
from vinetrack.inference.trajectory_jobs import OBSERVED, Average, Job, Jobs, Motions
from vinetrack.inference.whitening import all_products

RELEASE, ORIGIN, PRESSURE, DAMPING_DEVIATION = range(4)
N_TRIAL_EFFECTS = 4
"""Trial effects of each trial: release, s; origin, m; relative deviation of pressure; deviation of ln B. Defined by the
model."""

TARGET_RESPONSE = 2e-3
"""Finite differences use steps that move a trajectory by this fraction of its travel: 1000 times the integrator's
error, yet small enough to neglect curvature. Derived: with an integrator error of 1e-6 the optimum between truncation
and rounding error lies between 1e-3 and 1e-2."""

SMALLEST_STEP, LARGEST_STEP = 1e-5, 0.1
"""Least and largest relative step of a finite difference. Derived: below 1e-5 the integrator's error dominates, above
0.1 the curvature."""

RELEASE_STEP_FRAMES = 0.1
"""Step of the release. Chosen: over a tenth of a frame every trajectory is straight."""

PAYLOAD_COLUMN = TrialInputs._fields.index("payload_mass")
DAMPING_STEP = 1e-3
"""Relative step of B. Derived as TARGET_RESPONSE is: the response is of the order of the step."""


class Predictor:
    """Simulates the trials of a fit and differentiates their positions.

    `has_pressure_deviation`, shape (n_trials,), tells which trials have a pressure that may deviate: one that was set,
    or measured by a noisy gauge. `has_damping_deviation` tells which have a B. `host` is a larger model whose compiled
    form serves this one. `divisible` tells whether a predictor of a subset of the trials gives the same results.
    """

    divisible = True

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
        self.rigs = np.array([trial_inputs(trial_data.trial) for trial_data in data], dtype=float)
        self.bends = [bends_of(trial_data.trial) for trial_data in data]
        measured_otherwise = any(
            {"true_time", "observed_position", "row_delay", "averaged_over"} & set(effect.functions) for effect in model
        )
        smoothed = any(trial_data.smoothing is not None for trial_data in data)
        self.averages = [Average.of(known.time_s, *known.window) for known in data] if smoothed else []
        measured_otherwise |= smoothed
        self.plain_release = np.array([trial_data.trace is None and not measured_otherwise for trial_data in data])
        self.twins = _twins(data, self.rigs, self.bends)
        self.has_twins = bool(np.any(self.twins != np.arange(self.twins.size)))
        self.ratios = [trial_data.trial.travel_ratio for trial_data in data]
        self.times_s = [np.asarray(trial_data.time_s, dtype=float) for trial_data in data]
        self.starts = starts_of(self.times_s)
        self.lead_position_m = np.concatenate([trial_data.lead_position_m for trial_data in data])
        self.spans_m = np.array([np.ptp(trial_data.lead_position_m) for trial_data in data])
        self.first = np.concatenate([trial_data.first for trial_data in data])
        uneven = any(trial_data.relative_sd is not None for trial_data in data)
        self.relative_sd = np.concatenate([trial_data.point_sd for trial_data in data]) if uneven else None
        self.frames_s = np.array([trial_data.frame_s for trial_data in data])
        self.with_trace = np.array([trial_data.trace is not None for trial_data in data], dtype=bool)
        self.pressure_step = np.full(len(data), 1e-3)
        self.steps = np.full(len(layout.keys), 1e-3)

    def run(self, jobs: Sequence[Job], times_s: Sequence[Floats] | None = None) -> list[Trajectory]:
        """Simulate at the instants of each job's trial, or at those of `times_s`, one array a job.

        Parameters
        ----------
        jobs : sequence of Job
        times_s : sequence of arrays, optional
            Instants on the clock of the recording, s, one array a job.

        Returns
        -------
        list of Trajectory
        """
        return self.run_as(self.layout.model, Jobs.of(jobs), times_s)

    def run_as(self, model: Model, jobs: Jobs, times_s: Sequence[Floats] | None = None) -> list[Trajectory]:
        """Simulate another model for the same trials.

        Parameters
        ----------
        model : simulated in place of the fit's.
        jobs : with the parameters of that model.
        times_s : sequence of arrays, optional
            Instants, s, one array a job.

        Returns
        -------
        list of Trajectory
        """
        return self._simulated(model, jobs, times_s).trajectories()

    def _simulated(self, model: Model, jobs: Jobs, times_s: Sequence[Floats] | None = None) -> Motions:
        """What jobs come to; what replicates of a planned campaign do alike is simulated once."""
        like = np.arange(len(jobs))
        if times_s is None and self.has_twins:
            first, like = jobs.distinct(self.twins)
            jobs = jobs.take(first)
        trials = jobs.trial
        rigs = with_pressures(
            self.rigs[trials], self.rigs[trials, 0] * (1 + jobs.pressure_deviation), jobs.yield_pressure_Pa
        )
        rigs[:, PAYLOAD_COLUMN] *= jobs.payload_factor
        averages = [self.averages[i] for i in trials] if times_s is None and self.averages else []
        if times_s is None:
            times_s = [average.instants_s for average in averages] or [self.times_s[i] for i in trials]
        starts = starts_of(times_s)
        batch = lay_out(
            model,
            rigs,
            [self.bends[i] for i in trials],
            np.concatenate(times_s) - np.repeat(jobs.release_s, np.diff(starts)),
            starts,
            traces=self._traces(jobs) if self.with_trace.any() else None,
            parameters=jobs.row,
            host=self.host,
        )
        motions = Motions.of(batch, [self.data[i].trial for i in trials], like)
        return motions.averaged(averages) if averages else motions

    def _traces(self, jobs: Jobs) -> list[Trace | None]:
        """Recorded pressures on the clock of each job."""
        traces = (self.data[i].trace for i in jobs.trial)
        return [
            None if trace is None else (trace[0] - release_s, trace[1] * (1 + deviation))
            for trace, release_s, deviation in zip(traces, jobs.release_s, jobs.pressure_deviation, strict=True)
        ]

    def jobs(self, theta: Floats, trial_effects: Floats) -> list[Job]:
        """Simulation jobs at scaled parameters `theta` and the given trial effects, one a trial.

        Parameters
        ----------
        theta : array, shape (n_free,)
            Free numbers, scaled.
        trial_effects : array, shape (n_trials, 4)

        Returns
        -------
        list of Job
            One a trial.
        """
        return self.together(theta, trial_effects).single()

    def together(self, theta: Floats, trial_effects: Floats) -> Jobs:
        """`jobs` as arrays.

        Parameters
        ----------
        theta : array, shape (n_free,)
            Free numbers, scaled.
        trial_effects : array, shape (n_trials, 4)

        Returns
        -------
        Jobs
        """
        rows, yields = self.layout.rows(theta)
        trial_effects = self._deviations(theta, trial_effects)
        if self.damping_column >= 0:
            rows[:, self.damping_column] *= np.exp(trial_effects[:, DAMPING_DEVIATION])
        count = len(self.data)
        pressure, release = trial_effects[:, PRESSURE], trial_effects[:, RELEASE]
        return Jobs(np.arange(count), rows, yields, pressure, release, np.ones(count))

    def _deviations(self, theta: Floats, trial_effects: Floats) -> Floats:
        """The trials' own numbers, their deviations with what trials differ by systematically put in."""
        if not self.layout.between:
            return trial_effects
        whole = trial_effects.copy()
        whole[:, [PRESSURE, DAMPING_DEVIATION]] += self.layout.shifts(theta)
        return whole

    def trajectories_at(self, theta: Floats, trial_effects: Floats) -> list[Trajectory]:
        """The trajectories with nothing moved.

        Parameters
        ----------
        theta : array, shape (n_free,)
            Free numbers, scaled.
        trial_effects : array, shape (n_trials, 4)

        Returns
        -------
        list of Trajectory
            One a trial.
        """
        return self.run_as(self.layout.model, self.together(theta, trial_effects))

    def residuals(self, theta: Floats, trial_effects: Floats) -> list[Floats]:
        """Measured minus predicted position of every trial, m.

        Parameters
        ----------
        theta : array, shape (n_free,)
            Free numbers, scaled.
        trial_effects : array, shape (n_trials, 4)

        Returns
        -------
        list of arrays, shape (n_points,)
        """
        return self.residuals_of_each(theta, [trial_effects])[0]

    def residuals_of_each(self, theta: Floats, ways: Sequence[Floats]) -> list[list[Floats]]:
        """`residuals` for several sets of the trials' own numbers, simulated in one call.

        Parameters
        ----------
        theta : array, shape (n_free,)
            Free numbers, scaled.
        ways : sequence of arrays, shape (n_trials, 4)

        Returns
        -------
        list of lists of arrays, shape (n_points,)
            One list a way.
        """
        count = len(self.data)
        motions = self._simulated(self.layout.model, Jobs.joined([self.together(theta, way) for way in ways]))
        observed_m = [motions.rows(k * count, (k + 1) * count)[:, OBSERVED] for k in range(len(ways))]
        return [self.by_trial(self._left(left_m, way)) for left_m, way in zip(observed_m, ways, strict=True)]

    def _left(self, observed_m: Floats, trial_effects: Floats) -> Floats:
        """Measured minus predicted positions of all trials, end to end."""
        return self.lead_position_m - np.repeat(trial_effects[:, ORIGIN], np.diff(self.starts)) - observed_m

    def by_trial(self, values: Floats) -> list[Floats]:
        """What all trials have end to end, as an array for each.

        Parameters
        ----------
        values : array, shape (n_points_of_all, …)

        Returns
        -------
        list of arrays, shape (n_points, …)
        """
        edges = self.starts.tolist()
        return [values[a:b] for a, b in itertools.pairwise(edges)]

    def linearise(
        self, theta: Floats, trial_effects: Floats, *, trial_effects_only: bool = False, past_end: bool = False
    ) -> list[Floats]:
        """Sensitivities [trial effects, keys of the layout] and residual of every trial, as columns.

        Parameters
        ----------
        theta : array, shape (n_free,)
            Free parameters, scaled.
        trial_effects : array, shape (n_trials, 4)
        trial_effects_only : bool
            Leave the columns of the keys zero, except that of B.
        past_end : bool
            Differentiate as `position_change` does, across the end of growth, for tests that compare columns with each
            other; step sizes are then not adapted. The iterations of a fit need the actual change, including the jump
            at the end of growth, and converge elsewhere without it.

        Returns
        -------
        list of arrays, shape (n_points, 4 + n_keys + 1)
            Derivatives of the predicted position, m per unit of the column (trial effects SI, keys scaled); the last
            column is the residual, m.
        """
        plain, whole = self.together(theta, trial_effects), self._deviations(theta, trial_effects)
        moves = list(self._variations(plain, theta, whole, trial_effects_only))
        motions = self._simulated(self.layout.model, Jobs.joined([plain, *(varied for _, _, varied in moves)]))
        count = len(self.data)
        rows = motions.rows(0, count)
        table = np.zeros((rows.shape[0], N_TRIAL_EFFECTS + len(self.layout.keys) + 1))
        table[:, ORIGIN] = 1.0
        table[:, RELEASE] = -(rows[:, 1] / np.repeat(self.ratios, np.diff(self.starts)))
        table[:, -1] = self._left(rows[:, OBSERVED], trial_effects)
        every = motions.trajectories() if past_end else []
        first = count
        for place, steps, varied in moves:
            jobs, first = slice(first, first + len(varied)), first + len(varied)
            points = self._points_of(varied.trial)
            if past_end:
                pairs = zip(varied.trial, every[jobs], strict=True)
                change = np.concatenate([position_change(every[i], moved) for i, moved in pairs])
            else:
                change = motions.rows(jobs.start, jobs.stop)[:, OBSERVED] - rows[points, OBSERVED]
                self._clip(change, motions, varied.trial, jobs)
            table[points, place] = change / np.repeat(steps, np.diff(self.starts)[varied.trial])
        columns = self.by_trial(table)
        self._share_damping(columns)
        self._share_deviations(columns)
        if not (trial_effects_only or past_end):
            self._adapt(table)
        return columns

    def _points_of(self, trials: NDArray[np.int_]) -> slice | NDArray[np.int_]:
        """Rows of some trials among those of all, end to end."""
        if trials.size == len(self.data):
            return slice(None)
        return np.concatenate([np.arange(self.starts[i], self.starts[i + 1]) for i in trials])

    def _clip(self, change: Floats, motions: Motions, trials: NDArray[np.int_], jobs: slice) -> None:
        """End what positions move by where the growth ends."""
        ends = motions.ends[motions.like]
        if not np.any(ends[trials, 0] == ENDED):
            return
        starts = starts_of([self.times_s[i] for i in trials])
        for k, (i, moved) in enumerate(zip(trials, ends[jobs], strict=True)):
            if ends[i, 0] == ENDED:
                over = motions.stamps(i) > ends[i, 1]
                clip_at_end(change[starts[k] : starts[k + 1]], over, moved_ends=moved[0] == ENDED)

    def products(self, columns: Sequence[Floats]) -> Floats:
        """Sums of products of the trials' columns under their noise, shape (n_trials, 3, k, k), see `whitening`.

        Parameters
        ----------
        columns : sequence of arrays, shape (n_points, k)

        Returns
        -------
        array, shape (n_trials, 3, k, k)
        """
        return all_products(
            columns,
            [trial_data.first for trial_data in self.data],
            [trial_data.relative_sd for trial_data in self.data],
        )

    def _variations(
        self, plain: Jobs, theta: Floats, trial_effects: Floats, trial_effects_only: bool
    ) -> Iterator[tuple[int, Floats, Jobs]]:
        """What to simulate for the differences: place of the column, the trials' steps, and the moved trajectories."""
        if len(measured := np.flatnonzero(~self.plain_release)):
            steps, varied = RELEASE_STEP_FRAMES * self.frames_s[measured], plain.take(measured)
            yield RELEASE, steps, replace(varied, release_s=varied.release_s + steps)
        if len(driven := np.flatnonzero(self.has_pressure_deviation)):
            steps, varied = self.pressure_step[driven], plain.take(driven)
            yield PRESSURE, steps, replace(varied, pressure_deviation=varied.pressure_deviation + steps)
        if DAMPING not in self.layout.keys and len(damped := np.flatnonzero(self.has_damping_deviation)):
            varied = plain.take(damped)
            varied.row[:, self.damping_column] *= np.exp(DAMPING_STEP)
            yield DAMPING_DEVIATION, np.full(damped.size, DAMPING_STEP), varied
        upper = self.layout.bounds[1]
        for column, key in enumerate(self.layout.keys):
            feels = np.flatnonzero(self.layout.index[:, column] >= 0)
            if not feels.size or (trial_effects_only and key != DAMPING) or self.layout.term(key) is not None:
                continue
            places = self.layout.index[feels, column]
            step = float(self.steps[column])
            steps = np.where(theta[places] + step > upper[places], -step, step)
            varied = plain.take(feels)
            free = [self.layout.free[place] for place in places]
            there = theta[places] + steps
            if key == YIELD_PRESSURE:
                varied.yield_pressure_Pa[:] = [number.from_scaled(x) for number, x in zip(free, there, strict=True)]
            elif key == DAMPING:
                there = there + trial_effects[feels, DAMPING_DEVIATION]
                varied.row[:, self.damping_column] = [
                    number.from_scaled(x) for number, x in zip(free, there, strict=True)
                ]
            else:
                here_and_there = zip(free, theta[places], there, strict=True)
                k = self.layout.model.parameter_names.index(key)
                varied.row[:, k] += [
                    number.from_scaled(x) - number.from_scaled(here) for number, here, x in here_and_there
                ]
            yield N_TRIAL_EFFECTS + column, steps, varied

    def _share_damping(self, columns: list[Floats]) -> None:
        """A trial's deviation of B and ln B itself are one sensitivity."""
        if DAMPING not in self.layout.keys:
            return
        column = self.layout.keys.index(DAMPING)
        for i in np.flatnonzero(self.has_damping_deviation):
            columns[i][:, DAMPING_DEVIATION] = columns[i][:, N_TRIAL_EFFECTS + column]

    def _share_deviations(self, columns: list[Floats]) -> None:
        """What trials differ by systematically moves them as their own deviation does, times its regressor."""
        for term in self.layout.between:
            if term.key not in self.layout.keys:
                continue
            column, source = self.layout.keys.index(term.key), PRESSURE if term.pressure else DAMPING_DEVIATION
            for i in np.flatnonzero(self.layout.index[:, column] >= 0):
                columns[i][:, N_TRIAL_EFFECTS + column] = term.scale * term.regressor[i] * columns[i][:, source]

    def _adapt(self, table: Floats) -> None:
        """Steps for the next time, from how far these moved the trajectories."""
        answers = np.maximum.reduceat(np.abs(table), self.starts[:-1], axis=0) / self.spans_m[:, None]
        for column in range(len(self.layout.keys)):
            self.steps[column] = _step(float(np.max(answers[:, N_TRIAL_EFFECTS + column])), float(self.steps[column]))
        for i in np.flatnonzero(self.has_pressure_deviation):
            self.pressure_step[i] = _step(float(answers[i, PRESSURE]), float(self.pressure_step[i]))


def _twins(
    data: Sequence[FitTrial], rigs: Floats, bends: Sequence[Sequence[tuple[float, float, float]]]
) -> NDArray[np.int_]:
    """Of every trial the first of the same settings and instants, shape (n_trials,)."""
    first: dict[tuple[object, ...], int] = {}
    twins = np.arange(len(data))
    for i, trial_data in enumerate(data):
        if trial_data.trace is None:
            key = (rigs[i].tobytes(), tuple(bends[i]), trial_data.time_s.tobytes(), trial_data.trial.travel_ratio)
            twins[i] = first.setdefault(key, i)
    return twins


def _step(answer: float, before: float) -> float:
    """Step that moves a trajectory as far as aimed at, given how far a unit step would."""
    if not answer > 0:
        return before
    return float(np.clip(TARGET_RESPONSE / answer, SMALLEST_STEP, LARGEST_STEP))
