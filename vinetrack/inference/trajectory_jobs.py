"""Jobs of trajectories to simulate, as arrays: a fit needs a hundred at a time, thousands of times."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats, Trial
from vinetrack.dynamics.batch import Batch, starts_of
from vinetrack.dynamics.simulate import Trajectory, check_completed, trajectories
from vinetrack.inference.fit_data import FitTrial

OBSERVED = 3  # Column of `Motions.rows` with the position of the edge as the camera reports it (defined)


class Job(NamedTuple):
    """One trajectory to simulate: its trial, parameters, pressures and release, and a factor on its payload."""

    trial: int
    row: Floats
    yield_pressure_Pa: float
    pressure_deviation: float
    release_s: float
    payload_factor: float = 1.0


@dataclass(frozen=True)
class Jobs:
    """Trajectories to simulate, one entry of each array per job; `row` has shape (n_jobs, n_parameters), SI."""

    trial: NDArray[np.int_]
    row: Floats
    yield_pressure_Pa: Floats
    pressure_deviation: Floats
    release_s: Floats
    payload_factor: Floats

    @classmethod
    def of(cls, jobs: Sequence[Job]) -> Jobs:
        """Combine single jobs."""
        trials, rows, *values = zip(*jobs, strict=True) if jobs else [()] * len(Job._fields)
        others = [np.array(column, dtype=float) for column in values]
        return cls(np.array(trials, dtype=int), np.array(rows).reshape(len(jobs), -1), *others)

    def with_effect(self, values: Sequence[float]) -> Jobs:
        """The same trajectories for a model with one more effect."""
        return replace(self, row=np.hstack([self.row, np.tile(np.asarray(values, dtype=float), (len(self), 1))]))

    def __len__(self) -> int:
        return self.trial.size

    def take(self, places: NDArray[np.int_]) -> Jobs:
        """A copy of some of the jobs. Shapes: places (n_taken,)."""
        trial, *numbers = self._columns
        return Jobs(trial[places], *(values[places] for values in numbers))

    def as_list(self) -> list[Job]:
        """The jobs as a list."""
        rows, *columns = self.row, *(values.tolist() for values in self._columns[2:])
        return [Job(i, row, *numbers) for i, row, *numbers in zip(self.trial.tolist(), rows, *columns, strict=True)]

    @classmethod
    def concatenated(cls, parts: Sequence[Jobs]) -> Jobs:
        """Concatenate several sets of jobs."""
        trial, *numbers = (np.concatenate(values) for values in zip(*(part._columns for part in parts), strict=True))
        return cls(trial, *numbers)

    @property
    def _columns(self) -> tuple[NDArray[Any], ...]:
        return tuple(vars(self).values())

    def distinct(self, identical_trials: NDArray[np.int_]) -> tuple[NDArray[np.int_], NDArray[np.int_]]:
        """Indices of distinct jobs, and for each job its index among the distinct ones. Returns first, inverse. Shapes:
        identical_trials (n_trials,) → (n_distinct,).
        """
        numbers = np.column_stack([identical_trials[self.trial].astype(float), *self._columns[1:]])
        first: dict[bytes, int] = {}
        trajectory_of = [first.setdefault(numbers[k].tobytes(), k) for k in range(len(numbers))]
        return np.unique(trajectory_of, return_inverse=True)


def first_identical_trials(
    data: Sequence[FitTrial], inputs: Floats, bends: Sequence[Sequence[tuple[float, float, float]]]
) -> NDArray[np.int_]:
    """For each trial the first one with the same settings and times. Shapes: inputs (n_trials, n_fields of
    `TrialInputs`) → (n_trials,).
    """
    first: dict[tuple[object, ...], int] = {}
    identical_trials = np.arange(len(data))
    for i, trial_data in enumerate(data):
        if trial_data.trace is None:
            key = (inputs[i].tobytes(), tuple(bends[i]), trial_data.time_s.tobytes(), trial_data.trial.travel_ratio)
            identical_trials[i] = first.setdefault(key, i)
    return identical_trials


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
    """Simulated trajectories of jobs: `out` and `ends` as `Batch.run` returns them, one entry per distinct trajectory.
    `ratios` are the travel ratios of their trials; `trajectory_of`, shape (n_jobs,), is the trajectory of each job.
    """

    batch: Batch
    out: Floats
    ends: Floats
    ratios: list[float]
    trajectory_of: NDArray[np.int_]

    @classmethod
    def of(cls, batch: Batch, trials: Sequence[Trial], trajectory_of: NDArray[np.int_]) -> Motions:
        """Integrate a batch. Shapes: trajectory_of (n_jobs,)."""
        out, ends = batch.run()
        check_completed(ends, [trial.name for trial in trials])
        return cls(batch, out, ends, [trial.travel_ratio for trial in trials], trajectory_of)

    def averaged(self, averages: Sequence[Average]) -> Motions:
        """The motions at the requested points, their reported positions averaged over the times around them."""
        out, stamps, times = [], [], []
        for (first, last), average in zip(itertools.pairwise(self.batch.starts), averages, strict=True):
            middle = average.place[:, average.weights.size // 2]
            rows = self.out[first:last]
            averaged = rows[middle]
            averaged[:, OBSERVED] = rows[average.place, OBSERVED] @ average.weights
            out.append(averaged)
            stamps.append(self.batch.stamps[first:last][middle])
            times.append(self.batch.times[first:last][middle])
        batch = replace(self.batch, stamps=np.concatenate(stamps), times=np.concatenate(times), starts=starts_of(times))
        return replace(self, batch=batch, out=np.concatenate(out))

    def rows(self, first: int, last: int) -> Floats:
        """Rows of `out` of jobs `first` up to `last`, concatenated. Returns position, velocity and acceleration of the
        tail, position of the edge as the camera reports it. Shape (n_times, 4).
        """
        starts, trajectory_of = self.batch.starts, self.trajectory_of[first:last]
        if (
            trajectory_of.size
            and trajectory_of[-1] - trajectory_of[0] == trajectory_of.size - 1
            and np.all(np.diff(trajectory_of) == 1)
        ):
            return self.out[starts[trajectory_of[0]] : starts[trajectory_of[-1] + 1]]
        return np.concatenate([self.out[starts[k] : starts[k + 1]] for k in trajectory_of])

    def stamps(self, job: int) -> Floats:
        """Times of a job since its release, s, on the camera's clock. Shape (n_times,)."""
        return self.batch.stamps[
            self.batch.starts[self.trajectory_of[job]] : self.batch.starts[self.trajectory_of[job] + 1]
        ]

    def trajectories(self) -> list[Trajectory]:
        """One trajectory per job."""
        distinct_trajectories = trajectories(self.batch, self.out, self.ends, self.ratios)
        return [distinct_trajectories[k] for k in self.trajectory_of]
