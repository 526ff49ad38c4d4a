"""Trajectories to simulate, as arrays: a fit asks for a hundred at a time, thousands of times over."""

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

OBSERVED = 3
"""Column of `Motions.rows` that holds the position of the edge as the camera reports it. Defined by the kernel."""


class Job(NamedTuple):
    """One trajectory to simulate: which trial, its parameters, pressures and release, and how wrong its payload is."""

    trial: int
    row: Floats
    yield_pressure_Pa: float
    pressure_deviation: float
    release_s: float
    payload_factor: float = 1.0


@dataclass(frozen=True)
class Jobs:
    """Trajectories to simulate, an entry of every array for each; `row` has shape (n_jobs, n_parameters), SI."""

    trial: NDArray[np.int_]
    row: Floats
    yield_pressure_Pa: Floats
    pressure_deviation: Floats
    release_s: Floats
    payload_factor: Floats

    @classmethod
    def of(cls, jobs: Sequence[Job]) -> Jobs:
        """Single jobs together.

        Parameters
        ----------
        jobs : sequence of Job

        Returns
        -------
        Jobs
        """
        trials, rows, *values = zip(*jobs, strict=True) if jobs else [()] * len(Job._fields)
        others = [np.array(column, dtype=float) for column in values]
        return cls(np.array(trials, dtype=int), np.array(rows).reshape(len(jobs), -1), *others)

    def with_effect(self, values: Sequence[float]) -> Jobs:
        """The same trajectories of a model with one effect more.

        Parameters
        ----------
        values : sequence of float
            Its parameters, SI, alike for all.

        Returns
        -------
        Jobs
        """
        return replace(self, row=np.hstack([self.row, np.tile(np.asarray(values, dtype=float), (len(self), 1))]))

    def __len__(self) -> int:
        return self.trial.size

    def take(self, places: NDArray[np.int_]) -> Jobs:
        """Some of them, copied.

        Parameters
        ----------
        places : array of int, shape (n_taken,)

        Returns
        -------
        Jobs
        """
        trial, *numbers = self._columns
        return Jobs(trial[places], *(values[places] for values in numbers))

    def single(self) -> list[Job]:
        """Each of them.

        Returns
        -------
        list of Job
        """
        rows, *columns = self.row, *(values.tolist() for values in self._columns[2:])
        return [Job(i, row, *numbers) for i, row, *numbers in zip(self.trial.tolist(), rows, *columns, strict=True)]

    @classmethod
    def joined(cls, parts: Sequence[Jobs]) -> Jobs:
        """All of several, one after the other.

        Parameters
        ----------
        parts : sequence of Jobs

        Returns
        -------
        Jobs
        """
        trial, *numbers = (np.concatenate(values) for values in zip(*(part._columns for part in parts), strict=True))
        return cls(trial, *numbers)

    @property
    def _columns(self) -> tuple[NDArray[Any], ...]:
        return tuple(vars(self).values())

    def distinct(self, twins: NDArray[np.int_]) -> tuple[NDArray[np.int_], NDArray[np.int_]]:
        """Which of them are the first of their kind, and of each which of those is like it.

        Parameters
        ----------
        twins : array of int, shape (n_trials,)
            Of every trial the first of the same settings and instants.

        Returns
        -------
        first : array of int, shape (n_distinct,)
        like : array of int, shape (n_jobs,)
        """
        numbers = np.column_stack([twins[self.trial].astype(float), *self._columns[1:]])
        first: dict[bytes, int] = {}
        like = [first.setdefault(numbers[k].tobytes(), k) for k in range(len(numbers))]
        return np.unique(like, return_inverse=True)


class Average(NamedTuple):
    """Positions that are means over instants about a point: all instants, s, those that each mean takes, its weights.

    `instants_s` increases; `place` has shape (n_points, n_weights).
    """

    instants_s: Floats
    place: NDArray[np.int_]
    weights: Floats

    @classmethod
    def of(cls, time_s: Floats, offsets_s: Floats, weights: Floats) -> Average:
        """About points at these times.

        Parameters
        ----------
        time_s : array, shape (n_points,)
        offsets_s, weights : array, shape (n_weights,)
            An odd number, the middle one at the point itself.

        Returns
        -------
        Average
        """
        about_s = np.add.outer(time_s, offsets_s)
        order = np.argsort(about_s, axis=None, kind="stable")
        place = np.empty(order.size, dtype=int)
        place[order] = np.arange(order.size)
        return cls(about_s.ravel()[order], place.reshape(about_s.shape), weights)


@dataclass(frozen=True)
class Motions:
    """What was simulated for jobs: rows of `out` and `ends` as `Batch.run` returns them, for distinct trajectories.

    `ratios` are the travel ratios of their trials; `like`, shape (n_jobs,), tells of each job which is its own.
    """

    batch: Batch
    out: Floats
    ends: Floats
    ratios: list[float]
    like: NDArray[np.int_]

    @classmethod
    def of(cls, batch: Batch, trials: Sequence[Trial], like: NDArray[np.int_]) -> Motions:
        """Integrate a batch.

        Parameters
        ----------
        batch : Batch
            Distinct trajectories.
        trials : sequence of Trial
            One a trajectory.
        like : array of int, shape (n_jobs,)
            Of each job its trajectory.

        Returns
        -------
        Motions

        Raises
        ------
        SimulationError
            If the integration does not get through.
        """
        out, ends = batch.run()
        check_completed(ends, [trial.name for trial in trials])
        return cls(batch, out, ends, [trial.travel_ratio for trial in trials], like)

    def averaged(self, averages: Sequence[Average]) -> Motions:
        """The same at the points that were asked for, their reported positions averaged over the instants about them.

        Parameters
        ----------
        averages : sequence of Average
            One a trajectory, whose instants it was followed at.

        Returns
        -------
        Motions
        """
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
        """Rows of `out` of jobs `first` up to `last`, end to end.

        Parameters
        ----------
        first, last : int

        Returns
        -------
        array, shape (n_times, 4)
            Position, velocity and acceleration of the tail, position of the edge as the camera reports it.
        """
        starts, like = self.batch.starts, self.like[first:last]
        if like.size and like[-1] - like[0] == like.size - 1 and np.all(np.diff(like) == 1):
            return self.out[starts[like[0]] : starts[like[-1] + 1]]
        return np.concatenate([self.out[starts[k] : starts[k + 1]] for k in like])

    def stamps(self, job: int) -> Floats:
        """Instants of a job since its release, s, as the camera has them.

        Parameters
        ----------
        job : int

        Returns
        -------
        array, shape (n_times,)
        """
        return self.batch.stamps[self.batch.starts[self.like[job]] : self.batch.starts[self.like[job] + 1]]

    def trajectories(self) -> list[Trajectory]:
        """A trajectory for each job.

        Returns
        -------
        list of Trajectory
        """
        known = trajectories(self.batch, self.out, self.ends, self.ratios)
        return [known[k] for k in self.like]
