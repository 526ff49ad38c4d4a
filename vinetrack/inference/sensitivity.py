"""How the predicted positions of every trial answer to what a fit may move.

Per trial there are four numbers of its own: the instant of release, the origin of position, the relative deviation of
its pressure from what was set, and that of its B from its vine's, as a difference of logarithms. Behind them come the
free numbers of the model.
All trajectories, moved and unmoved, are simulated in one call.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.dynamics.model import Model
from vinetrack.dynamics.simulate import Trajectory, bends_of, lay_out, trajectories
from vinetrack.dynamics.trial_inputs import check_needs, trial_inputs, with_pressures
from vinetrack.effects import TrialInputs
from vinetrack.inference.fit_data import FitTrial
from vinetrack.inference.parameters import DAMPING, YIELD_PRESSURE, ParameterMap
from vinetrack.inference.whitening import all_products

RELEASE, ORIGIN, PRESSURE, DAMPING_DEVIATION = range(4)
OWN = 4
"""Numbers of a trial's own: release, s; origin, m; relative deviation of pressure; deviation of ln B. Defined by the
model: release, origin, pressure, B."""

AIMED_RESPONSE = 2e-3
"""Differences are taken over steps that move a trajectory by this part of its length: 1000 times the integrator's
error, and small enough for the curvature not to count. Derived: with the integrator's 1e-6 the optimum of truncation
against rounding lies between 1e-3 and 1e-2."""

SMALLEST_STEP, LARGEST_STEP = 1e-5, 0.1
"""Relative steps of a difference, least and largest. Derived: below 1e-5 the integrator's error shows, above 0.1
curvature."""

RELEASE_STEP_FRAMES = 0.1
"""Chosen: a tenth of a frame, in which no trajectory bends."""

MOST_CONTINUED = 3.0
"""Times the delay that a step makes over which a trajectory is continued past its end. Derived: one for motions that
keep their speed to the end; three allows for one that slows down to a third."""

PAYLOAD_COLUMN = TrialInputs._fields.index("payload_mass")
DAMPING_STEP = 1e-3
"""Relative step of B. Derived as AIMED_RESPONSE is: its answer is of the order of the step."""


class Job(NamedTuple):
    """One trajectory to simulate: which trial, its parameters, pressures and release, and how wrong its payload is."""

    trial: int
    row: Floats
    yield_pressure_Pa: float
    pressure_deviation: float
    release_s: float
    payload_factor: float = 1.0


class Predictor:
    """Simulates the trials of a fit.

    `feels_pressure` and `feels_damping`, shape (n_trials,), tell which trials have a pressure that may deviate (it was
    set, or measured by a gauge with noise) and a B. `host` is a larger model whose compiled form serves this one.
    """

    def __init__(self, layout: ParameterMap, data: Sequence[FitTrial], host: Model | None = None) -> None:
        self.layout, self.data, self.host = layout, data, host
        model = layout.model
        self.damping_column = model.parameter_names.index(DAMPING) if DAMPING in model.parameter_names else -1
        driven = "pressure_drive" in model
        self.feels_pressure = np.array(
            [
                driven
                and (trial_data.trial.pressure_Pa > 0 if trial_data.trace is None else trial_data.gauge_error > 0)
                for trial_data in data
            ],
            dtype=bool,
        )
        self.feels_damping = np.array(
            [self.damping_column >= 0 and trial_data.trial.travel_ratio != 1 for trial_data in data], dtype=bool
        )
        check_needs(model, *(trial_data.trial for trial_data in data))
        self.rigs = np.array([trial_inputs(trial_data.trial) for trial_data in data], dtype=float)
        self.bends = [bends_of(trial_data.trial) for trial_data in data]
        measured_otherwise = any(
            {"true_time", "observed_position", "row_delay"} & set(effect.functions) for effect in model
        )
        self.plain_release = [trial_data.trace is None and not measured_otherwise for trial_data in data]
        self.twins = _twins(data, self.rigs, self.bends)
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
        rows = np.array([job.row for job in jobs]).reshape(len(jobs), -1)
        return self.run_as(self.layout.model, jobs, rows, times_s)

    def run_as(
        self, model: Model, jobs: Sequence[Job], rows: Floats, times_s: Sequence[Floats] | None = None
    ) -> list[Trajectory]:
        """Simulate another model, with parameters `rows`, shape (n_jobs, n_parameters), for the same trials.

        What replicates of a planned campaign do alike is simulated once.

        Parameters
        ----------
        model : simulated in place of the fit's.
        jobs : sequence of Job
        rows : array, shape (n_jobs, n_parameters), SI
        times_s : sequence of arrays, optional
            Instants, s, one array a job.

        Returns
        -------
        list of Trajectory
        """
        if times_s is None and np.any(self.twins != np.arange(self.twins.size)):
            keys = [(self.twins[job.trial], rows[k].tobytes(), *job[2:]) for k, job in enumerate(jobs)]
            first = {key: k for k, key in reversed(list(enumerate(keys)))}
            if len(first) < len(jobs):
                distinct = sorted(first.values())
                moved = self._run_each(model, [jobs[k] for k in distinct], rows[distinct], None)
                of = {keys[k]: trajectory for k, trajectory in zip(distinct, moved, strict=True)}
                return [of[key] for key in keys]
        return self._run_each(model, jobs, rows, times_s)

    def _run_each(
        self, model: Model, jobs: Sequence[Job], rows: Floats, times_s: Sequence[Floats] | None
    ) -> list[Trajectory]:
        """Simulate every job."""
        places = np.array([job.trial for job in jobs], dtype=int)
        rigs = with_pressures(
            self.rigs[places],
            self.rigs[places, 0] * (1 + np.array([job.pressure_deviation for job in jobs])),
            np.array([job.yield_pressure_Pa for job in jobs]),
        )
        rigs[:, PAYLOAD_COLUMN] *= [job.payload_factor for job in jobs]
        data = [self.data[job.trial] for job in jobs]
        batch = lay_out(
            model,
            rigs,
            [self.bends[job.trial] for job in jobs],
            [
                time_s - job.release_s
                for time_s, job in zip(times_s or [trial_data.time_s for trial_data in data], jobs, strict=True)
            ],
            traces=[
                None
                if trial_data.trace is None
                else (trial_data.trace[0] - job.release_s, trial_data.trace[1] * (1 + job.pressure_deviation))
                for trial_data, job in zip(data, jobs, strict=True)
            ],
            parameters=rows,
            host=self.host,
        )
        return trajectories(
            batch,
            [trial_data.trial.travel_ratio for trial_data in data],
            [trial_data.trial.name for trial_data in data],
        )

    def jobs(self, theta: Floats, trial_effects: Floats) -> list[Job]:
        """The unmoved trajectories at scaled values `theta` and the trials' `own` numbers, shape (n_trials, 4).

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
        rows, yields = self.layout.rows(theta)
        trial_effects = self._deviations(theta, trial_effects)
        if self.damping_column >= 0:
            rows[:, self.damping_column] *= np.exp(trial_effects[:, DAMPING_DEVIATION])
        return [
            Job(i, rows[i], float(yields[i]), float(trial_effects[i, PRESSURE]), float(trial_effects[i, RELEASE]))
            for i in range(len(self.data))
        ]

    def _deviations(self, theta: Floats, trial_effects: Floats) -> Floats:
        """The trials' own numbers, their deviations with what trials differ by systematically put in."""
        if not self.layout.between:
            return trial_effects
        whole = trial_effects.copy()
        whole[:, [PRESSURE, DAMPING_DEVIATION]] += self.layout.shifts(theta)
        return whole

    def unmoved(self, theta: Floats, trial_effects: Floats) -> list[Trajectory]:
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
        return self.run(self.jobs(theta, trial_effects))

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
        moved = self.unmoved(theta, trial_effects)
        return [self._residual(i, moved[i], trial_effects) for i in range(len(self.data))]

    def _residual(self, i: int, moved: Trajectory, trial_effects: Floats) -> Floats:
        return self.data[i].lead_position_m - trial_effects[i, ORIGIN] - moved.observed_position_m

    def linearise(
        self, theta: Floats, trial_effects: Floats, *, own_only: bool = False, past_end: bool = False
    ) -> list[Floats]:
        """Columns [own numbers, keys of the layout, residual] of every trial, shape (n_points, 4 + n_keys + 1).

        `own_only` leaves the columns of the keys empty, but for B. `past_end` takes derivatives as `position_change`
        does, for tests that hold columns against each other; an iteration wants what a step really changes, the jump
        at the end of growth included, and settles in other places without it.

        Parameters
        ----------
        theta : array, shape (n_free,)
            Free numbers, scaled.
        trial_effects : array, shape (n_trials, 4)
        own_only : bool
            Leave the columns of the keys empty, but for B.
        past_end : bool
            Run trajectories on past the end of growth. The steps of later calls are not adapted then.

        Returns
        -------
        list of arrays, shape (n_points, 4 + n_keys + 1)
            Derivatives of the predicted position, m per unit of the column (trial effects SI, keys scaled); the last
            column is the residual, m.
        """
        plain, whole = self.jobs(theta, trial_effects), self._deviations(theta, trial_effects)
        jobs, moves = list(plain), [(-1, 0.0)] * len(plain)
        for i, job in enumerate(plain):
            for place, step, varied in self._variations(i, job, theta, whole, own_only):
                jobs.append(varied)
                moves.append((place, step))
        moved = self.run(jobs)
        columns = [np.zeros((trial_data.time_s.size, OWN + len(self.layout.keys) + 1)) for trial_data in self.data]
        for i in range(len(plain)):
            columns[i][:, ORIGIN] = 1.0
            columns[i][:, RELEASE] = -moved[i].lead_velocity_m_s
            columns[i][:, -1] = self._residual(i, moved[i], trial_effects)
        for job, (place, step), other in zip(jobs, moves, moved, strict=True):
            if place >= 0:
                change = position_change if past_end else _clipped_change
                columns[job.trial][:, place] = change(moved[job.trial], other) / step
        self._share_damping(columns)
        self._share_deviations(columns)
        if not (own_only or past_end):
            self._adapt(columns)
        return columns

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
        self, i: int, job: Job, theta: Floats, trial_effects: Floats, own_only: bool
    ) -> list[tuple[int, float, Job]]:
        """What to simulate for the differences of one trial: place of the column, step, and the moved trajectory."""
        variations: list[tuple[int, float, Job]] = []
        if not self.plain_release[i]:
            step = RELEASE_STEP_FRAMES * self.data[i].frame_s
            variations.append((RELEASE, step, job._replace(release_s=job.release_s + step)))
        if self.feels_pressure[i]:
            step = float(self.pressure_step[i])
            variations.append((PRESSURE, step, job._replace(pressure_deviation=job.pressure_deviation + step)))
        if self.feels_damping[i] and DAMPING not in self.layout.keys:
            row = job.row.copy()
            row[self.damping_column] *= np.exp(DAMPING_STEP)
            variations.append((DAMPING_DEVIATION, DAMPING_STEP, job._replace(row=row)))
        upper = self.layout.bounds[1]
        for column, key in enumerate(self.layout.keys):
            place = self.layout.index[i, column]
            if place < 0 or (own_only and key != DAMPING) or self.layout.term(key) is not None:
                continue
            step = float(self.steps[column])
            if theta[place] + step > upper[place]:
                step = -step
            number = self.layout.free[place]
            if key == YIELD_PRESSURE:
                varied = job._replace(yield_pressure_Pa=number.outside(theta[place] + step))
            else:
                row, k = job.row.copy(), self.layout.model.parameter_names.index(key)
                row[k] += number.outside(theta[place] + step) - number.outside(theta[place])
                if key == DAMPING:
                    row[k] = number.outside(theta[place] + step + trial_effects[i, DAMPING_DEVIATION])
                varied = job._replace(row=row)
            variations.append((OWN + column, step, varied))
        return variations

    def _share_damping(self, columns: list[Floats]) -> None:
        """A trial's deviation of B and ln B itself are one sensitivity."""
        if DAMPING not in self.layout.keys:
            return
        column = self.layout.keys.index(DAMPING)
        for i in np.flatnonzero(self.feels_damping):
            columns[i][:, DAMPING_DEVIATION] = columns[i][:, OWN + column]

    def _share_deviations(self, columns: list[Floats]) -> None:
        """What trials differ by systematically moves them as their own deviation does, times its regressor."""
        for term in self.layout.between:
            if term.key not in self.layout.keys:
                continue
            column, source = self.layout.keys.index(term.key), PRESSURE if term.pressure else DAMPING_DEVIATION
            for i in np.flatnonzero(self.layout.index[:, column] >= 0):
                columns[i][:, OWN + column] = term.scale * term.regressor[i] * columns[i][:, source]

    def _adapt(self, columns: list[Floats]) -> None:
        """Steps for the next time, from how far these moved the trajectories."""
        spans = np.array([np.ptp(trial_data.lead_position_m) for trial_data in self.data])
        answers = np.array([np.max(np.abs(column), axis=0) for column in columns]) / spans[:, None]
        for column in range(len(self.layout.keys)):
            self.steps[column] = _step(float(np.max(answers[:, OWN + column])), float(self.steps[column]))
        for i in np.flatnonzero(self.feels_pressure):
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


def _clipped_change(plain: Trajectory, moved: Trajectory) -> Floats:
    """How far positions move, ended where the growth ends; behind that nothing that only delays the end moves them."""
    change = moved.observed_position_m - plain.observed_position_m
    if plain.status == "ended":
        over = plain.time_s > plain.end_time_s
        change[over] = change[-1] if moved.status == "ended" else 0.0
    return np.asarray(change)


def position_change(plain: Trajectory, moved: Trajectory) -> Floats:
    """How far the observed positions of a trial answer to a small step, m, shape (n_points,).

    Growth ends at the same place whenever it ends, so a plain difference has a jump between the two ends, of the order
    of the whole answer, that depends on the sign and size of the step: two effects that do exactly the same would seem
    to differ by that one frame. So until the unmoved trajectory ends the moved one is continued at its last speed, and
    from there on only what moves the place of the end counts.

    Parameters
    ----------
    plain : Trajectory
        The unmoved trajectory.
    moved : Trajectory
        The same trial, at the same instants, with a step made.

    Returns
    -------
    array, shape (n_points,), m
    """
    change = _clipped_change(plain, moved)
    plain_end_s, moved_end_s = (each.end_time_s if each.status == "ended" else math.inf for each in (plain, moved))
    early = (plain.time_s <= plain_end_s) & (plain.time_s > moved_end_s)
    last = int(np.argmax(early)) - 1
    if early.any() and last >= 0:
        # A step small enough ends growth earlier by what it moves over the speed; where the unmoved motion takes longer
        # it is another one, such as a stop before the end, and is not continued.
        speed_m_s = max(float(plain.lead_velocity_m_s[last]), 1e-9)
        reach_s = plain.time_s[last] + MOST_CONTINUED * abs(float(change[last])) / speed_m_s
        early &= plain.time_s <= reach_s + 2 * (plain.time_s[1] - plain.time_s[0])
        if early.any():
            faster = moved.lead_velocity_m_s[last] - plain.lead_velocity_m_s[last]
            change[early] = change[last] + faster * (plain.time_s[early] - plain.time_s[last])
    return change


def _step(answer: float, before: float) -> float:
    """Step that moves a trajectory as far as aimed at, given how far a unit step would."""
    if not answer > 0:
        return before
    return float(np.clip(AIMED_RESPONSE / answer, SMALLEST_STEP, LARGEST_STEP))
