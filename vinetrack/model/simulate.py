"""The trajectory that a model gives for a trial."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vinetrack.effects import Rig, State
from vinetrack.model.kernel import kernel
from vinetrack.model.model import Model, asked, effects_on
from vinetrack.model.rig import check_needs, rig_of
from vinetrack.records import Floats, Trial

RELATIVE_TOLERANCE = 1e-4
"""Local tolerance on the speed. Hairer's estimate is of order 3, the method of order 5: positions come out good to 10⁻⁶
of the distance travelled on every trial of the paper's protocol (`benchmarks/integrator.py` measures it)."""

STATUS = ("running", "ended", "stalled", "too hard")

_NOTHING = State(*(math.nan,) * len(State._fields))

Trace = tuple[Floats, Floats]
"""Times since release, s, and gauge pressures, Pa, measured there."""


@dataclass(frozen=True)
class Trajectory:
    """Motion of one trial since release; arrays have shape (n_times,), SI.

    `observed_position_m` is the lead position as the camera reports it: another where the model has measurement
    effects. `status` is `ended` where all film was everted before the last time asked for, `stalled` where it stopped
    for good before, else `running`. `end_time_s` is when growth ended (or last stalled), NaN if it did not;
    `slack_from_s` when the tail of a trial that lets it (`tail_slack: free`) first went slack.
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


class SimulationError(RuntimeError):
    """A trajectory could not be followed; the message names the trial."""


def simulate(
    model: Model,
    trial: Trial,
    times_s: Floats,
    *,
    trace: Trace | None = None,
    relative_tolerance: float = RELATIVE_TOLERANCE,
) -> Trajectory:
    """Follow one trial from rest at release.

    Parameters
    ----------
    times_s : array, shape (n_times,), s since release, increasing; before 0 the vine is at rest
    trace : measured gauge pressure, which then takes the place of the set pressure and of what happens in the chamber

    Raises
    ------
    EffectError
        If the trial lacks what an effect needs.
    SimulationError
        If the integration does not get through.
    """
    return simulate_many(model, [trial], [times_s], traces=[trace], relative_tolerance=relative_tolerance)[0]


def simulate_many(
    model: Model,
    trials: Sequence[Trial],
    times_s: Sequence[Floats],
    *,
    traces: Sequence[Trace | None] | None = None,
    parameters: Floats | None = None,
    relative_tolerance: float = RELATIVE_TOLERANCE,
) -> list[Trajectory]:
    """`simulate` for many trials in one call of the compiled kernel.

    `parameters`, shape (n_trials, n_parameters) in the order of `model.parameter_names`, gives every trial values of
    its own in place of the model's.
    """
    traces = traces or [None] * len(trials)
    check_needs(model, *trials)
    rigs = np.array([rig_of(trial) for trial in trials], dtype=float).reshape(len(trials), len(Rig._fields))
    if parameters is None:
        of_vine = {vine: model.parameters_for(vine) for vine in {trial.vine for trial in trials}}
        parameters = np.array([of_vine[trial.vine] for trial in trials])
    thetas = np.ascontiguousarray(parameters, dtype=float).reshape(len(trials), len(model.parameter_names))
    starts = np.concatenate([[0], np.cumsum([len(times) for times in times_s])]).astype(np.int64)
    trace_starts = np.concatenate([[0], np.cumsum([0 if t is None else len(t[0]) for t in traces])]).astype(np.int64)
    bends = [[(bend.start_m, bend.arc_m, bend.radius_m) for bend in trial.bends] for trial in trials]
    bend_starts = np.concatenate([[0], np.cumsum([len(rows) for rows in bends])]).astype(np.int64)
    given = [trace for trace in traces if trace is not None]
    trace_time = np.concatenate([np.asarray(t, float) for t, _ in given]) if given else np.empty(0)
    trace_pressure = np.concatenate([np.asarray(p, float) for _, p in given]) if given else np.empty(0)
    on = effects_on(model, thetas)
    kinks, stops = _limits(model, rigs, thetas, on, trials)
    given_times = [np.asarray(t, dtype=float) for t in times_s]
    true_times = _true_times(model, rigs, thetas, on, given_times)
    times = np.concatenate(true_times) if true_times else np.empty(0)
    out, ends = np.empty((times.size, 4)), np.empty((len(trials), 5))
    tail_free = any(rig[Rig._fields.index("tail_free")] for rig in rigs)
    kernel(model.effects, bool(tail_free)).integrate_many(
        starts,
        times,
        on,
        rigs,
        thetas,
        trace_starts,
        trace_time,
        trace_pressure,
        bend_starts,
        np.array([row for rows in bends for row in rows], dtype=float).reshape(-1, 3),
        kinks,
        stops,
        relative_tolerance,
        out,
        ends,
    )
    return [
        _trajectory(trials[i], given_times[i], out[a:b], ends[i]) for i, (a, b) in enumerate(itertools.pairwise(starts))
    ]


def _limits(
    model: Model, rigs: Floats, thetas: Floats, on: NDArray[np.bool_], trials: Sequence[Trial]
) -> tuple[Floats, Floats]:
    """Tail travel at which forces have corners, rising, and at which growth ends, m; infinite where they do not.

    Of shape (n_trials, n_corners) and (n_trials,). Corners are where the film's mass reaches its floor, where bends
    begin and end, and what effects say of theirs.
    """
    rig = Rig(*rigs.T)
    film = np.ones(len(rigs))
    for effect, function, place in asked(model, "film_gain"):
        for k in np.flatnonzero(on[:, effect]).tolist():
            film[k] *= function(_NOTHING, Rig(*rigs[k]), *thetas[k, place])
    end = np.where(np.asarray(rig.length) > 0, np.asarray(rig.length) * rig.travel_ratio, math.inf)
    left = np.asarray(rig.linear_density) * rig.length - rig.least_mass / film
    loss = np.asarray(rig.mass_loss)
    floor = np.where(loss > 0, np.maximum(left, 0.0) / np.where(loss > 0, loss, 1.0), math.inf)
    cornered = [i for i, effect in enumerate(model.effects) if effect.corners is not None and on[:, i].any()]
    if not cornered and not any(trial.bends for trial in trials):
        return floor[:, None].copy(), end
    found = [[edge for bend in trial.bends for edge in (bend.start_m, bend.start_m + bend.arc_m)] for trial in trials]
    for i in cornered:
        corners = model.effects[i].corners
        assert corners is not None
        for k in np.flatnonzero(on[:, i]).tolist():
            found[k] += corners(Rig(*rigs[k]))
    kinks = np.full((len(trials), 1 + max(map(len, found), default=0)), math.inf)
    kinks[:, 0] = floor
    for k, positions in enumerate(found):
        kinks[k, 1 : 1 + len(positions)] = np.array(positions) * trials[k].travel_ratio
    return np.sort(kinks, axis=1), end


def _true_times(
    model: Model, rigs: Floats, thetas: Floats, on: NDArray[np.bool_], times_s: Sequence[Floats]
) -> list[Floats]:
    """When what the camera stamps `times_s` really happened, by trial."""
    found = list(times_s)
    for effect, function, place in asked(model, "true_time"):
        for i in np.flatnonzero(on[:, effect]):
            state = _NOTHING._replace(time=found[i])  # type: ignore[arg-type]
            found[i] = np.asarray(function(state, Rig(*rigs[i]), *thetas[i, place]), dtype=float)
    return found


def _trajectory(trial: Trial, times_s: Floats, out: Floats, end: Floats) -> Trajectory:
    status = STATUS[int(end[0])]
    if status == "too hard":
        raise SimulationError(f"Trial {trial.name}: the model could not be integrated beyond {end[1]:.6g} s.")
    r = trial.travel_ratio
    return Trajectory(
        time_s=times_s,
        lead_position_m=out[:, 0] / r,
        lead_velocity_m_s=out[:, 1] / r,
        lead_acceleration_m_s2=out[:, 2] / r,
        observed_position_m=out[:, 3],
        travel_ratio=r,
        status=status,
        end_time_s=float(end[1]),
        end_lead_velocity_m_s=float(end[2]) / r,
        n_steps=int(end[3]),
        slack_from_s=float(end[4]),
    )


__all__ = [
    "SimulationError",
    "Trajectory",
    "check_needs",
    "rig_of",
    "simulate",
    "simulate_many",
]
