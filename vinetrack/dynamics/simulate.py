"""Simulation of trials by a model."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vinetrack.core.problems import UserError
from vinetrack.core.records import Floats, Trial
from vinetrack.dynamics.equations import TOO_HARD
from vinetrack.dynamics.kernel import RELATIVE_TOLERANCE, Batch, Trace, lay_out, starts_of
from vinetrack.dynamics.model import Model, check_needs
from vinetrack.effects import TrialInputs


@dataclass(frozen=True)
class Trajectory:
    """Motion of one trial since release; arrays have shape (n_times,), SI. `observed_position_m` is the lead position
    as the camera reports it, which differs if the model has measurement effects.
    """

    time_s: Floats
    lead_position_m: Floats
    lead_velocity_m_s: Floats
    lead_acceleration_m_s2: Floats
    observed_position_m: Floats
    travel_ratio: float
    status: str
    end_time_s: float
    end_lead_velocity_m_s: float
    n_steps: int
    slack_from_s: float = math.nan

    @property
    def tail_velocity_m_s(self) -> Floats:
        """Speed of the tail while it is taut, shape (n_times,)."""
        return self.travel_ratio * self.lead_velocity_m_s


class SimulationError(UserError, RuntimeError):
    """A trajectory could not be integrated; the message names the trial."""


def simulate(
    model: Model,
    trial: Trial,
    times_s: Floats,
    *,
    trace: Trace | None = None,
    relative_tolerance: float = RELATIVE_TOLERANCE,
) -> Trajectory:
    """Simulate one trial from rest at release.

    Parameters
    ----------
    model : the sum of effects with its values
    trial : the vine and its settings
    times_s : array, shape (n_times,), s since release, increasing; before 0 the vine is at rest
    trace : measured gauge pressure, which replaces the set pressure and the effects in the chamber
    relative_tolerance : local tolerance on the speed

    Returns
    -------
    Trajectory
        At `times_s`.

    Raises
    ------
    EffectError
        If the trial lacks a value that an effect needs.
    SimulationError
        If the integration fails.

    >>> import vinetrack as vt
    >>> trial, _ = vt.tracks_from_frame(vt.example_tracks())[0]
    >>> vt.simulate(vt.base_model(), trial, np.array([0.0, 0.02])).status
    'running'
    """
    return simulate_many(model, [trial], [times_s], traces=[trace], relative_tolerance=relative_tolerance)[0]


def simulate_many(
    model: Model,
    trials: Sequence[Trial],
    times_s: Sequence[Floats],
    *,
    traces: Sequence[Trace | None] | None = None,
    parameters: Floats | None = None,
    host: Model | None = None,
    relative_tolerance: float = RELATIVE_TOLERANCE,
) -> list[Trajectory]:
    """Simulate many trials in one call of the kernel, see `simulate`. Shapes: parameters (n_trials, n_parameters)."""
    check_needs(model, *trials)
    inputs = np.array([TrialInputs.of(trial) for trial in trials], dtype=float).reshape(-1, len(TrialInputs._fields))
    if parameters is None:
        groups = [(trial.vine, trial.group("day")) for trial in trials]
        of_group = {group: model.parameters_for(*group) for group in set(groups)}
        parameters = np.array([of_group[group] for group in groups])
    bends = [bends_of(trial) for trial in trials]
    given = [np.asarray(t, dtype=float) for t in times_s]
    stamps = np.concatenate([np.empty(0), *given])
    batch = lay_out(model, inputs, bends, stamps, starts_of(given), traces=traces, parameters=parameters, host=host)
    out, ends = batch.run(relative_tolerance)
    check_completed(ends, [trial.name for trial in trials])
    return trajectories(batch, out, ends, [trial.travel_ratio for trial in trials])


def trajectories(batch: Batch, out: Floats, ends: Floats, ratios: Sequence[float]) -> list[Trajectory]:
    """The trajectories of a batch that was run."""
    edges = batch.starts.tolist()
    motion = np.ascontiguousarray(out[:, :3].T) / np.repeat(ratios, np.diff(batch.starts))
    statuses = ("running", "ended", "stalled", "too hard")  # in the order of the integrator's codes
    made = []
    for ratio, (first, last), end in zip(ratios, itertools.pairwise(edges), ends.tolist(), strict=True):
        (status, end_s, end_speed, n_steps, slack_from_s), time_s = end, batch.stamps[first:last]
        position, velocity, acceleration = motion[:, first:last]
        how = statuses[int(status)], end_s, end_speed / ratio, int(n_steps), slack_from_s
        made.append(Trajectory(time_s, position, velocity, acceleration, out[first:last, 3], ratio, *how))
    return made


def check_completed(ends: Floats, names: Sequence[str]) -> None:
    """Raise an error for a trial that the integrator could not complete. Shapes: ends (n_trials, 5)."""
    failed = np.flatnonzero(ends[:, 0] == TOO_HARD)
    if failed.size:
        end_s = float(ends[failed[0], 1])
        raise SimulationError(f"Trial {names[failed[0]]}: the model could not be integrated beyond {end_s:.6g} s.")


def bends_of(trial: Trial) -> list[tuple[float, float, float]]:
    """The bends of a trial as numbers."""
    return [(bend.start_m, bend.arc_m, bend.radius_m) for bend in trial.bends]
