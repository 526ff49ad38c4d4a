"""The trajectory that a model gives for a trial."""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Callable, Sequence, Sized
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.problems import UserError
from vinetrack.core.records import Floats, Trial
from vinetrack.dynamics.kernel import kernel
from vinetrack.dynamics.model import Model, asked, effects_on, hosted
from vinetrack.dynamics.trial_inputs import check_needs, trial_inputs
from vinetrack.effects import State, TrialInputs

RELATIVE_TOLERANCE = 1e-4
"""Local tolerance on the speed. Hairer's estimate is of order 3, the method of order 5: positions come out good to 10⁻⁶
of the distance travelled on every trial of the paper's protocol (measured by `benchmarks/integrator.py`)."""

STATUS = ("running", "ended", "stalled", "too hard")

_NOTHING = State(*(math.nan,) * len(State._fields))

SMALLEST_SHARE = 64
"""Trials below which another thread costs more than it saves. Chosen: a millisecond of work; no result changes."""

Trace = tuple[Floats, Floats]
"""Times since release, s, and gauge pressures, Pa, measured there."""


@dataclass(frozen=True)
class Trajectory:
    """Motion of one trial since release; arrays have shape (n_times,), SI.

    `observed_position_m` is the lead position as the camera reports it: another where the model has measurement
    effects. `status`: `ended` (all film everted before the last time asked for), `stalled` for good before, `running`.
    `end_time_s` is when growth ended (or last stalled), NaN if it did not; `slack_from_s` when the tail of a trial that
    lets it (`tail_slack: free`) first went slack.
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
    model : the sum of effects with its values
    trial : the vine and its settings
    times_s : array, shape (n_times,), s since release, increasing; before 0 the vine is at rest
    trace : measured gauge pressure, which then takes the place of the set pressure and of what happens in the chamber
    relative_tolerance : local tolerance on the speed

    Returns
    -------
    Trajectory
        At `times_s`.

    Raises
    ------
    EffectError
        If the trial lacks what an effect needs.
    SimulationError
        If the integration does not get through.

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
    """`simulate` for many trials in one call of the compiled kernel.

    Parameters
    ----------
    model, trials, times_s, traces, relative_tolerance : as those of `simulate`, lists with an entry for each trial
    parameters : shape (n_trials, n_parameters), SI, in the order of `model.parameter_names`: values by trial in place
        of those of the model.
    host : a larger model whose compiled form serves this one; its other effects do not act

    Returns
    -------
    list of Trajectory
        One for each trial.
    """
    batch = prepare(model, trials, times_s, traces=traces, parameters=parameters, host=host)
    ratios = [trial.travel_ratio for trial in trials]
    return trajectories(batch, ratios, [trial.name for trial in trials], relative_tolerance)


def trajectories(
    batch: Batch, ratios: Sequence[float], names: Sequence[str], relative_tolerance: float = RELATIVE_TOLERANCE
) -> list[Trajectory]:
    """Run a batch.

    Parameters
    ----------
    batch : as `prepare` or `lay_out` return it
    ratios, names : travel ratio and name of each trial
    relative_tolerance : local tolerance on the speed

    Returns
    -------
    list of Trajectory
        One for each trial.

    Raises
    ------
    SimulationError
        If the integration does not get through.
    """
    out, ends = batch.run(relative_tolerance)
    edges = batch.starts.tolist()
    motion = np.ascontiguousarray(out[:, :3].T) / np.repeat(ratios, np.diff(batch.starts))
    return [
        _trajectory(names[i], ratios[i], batch.times_s[i], motion[:, a:b], out[a:b, 3], end)
        for i, ((a, b), end) in enumerate(zip(itertools.pairwise(edges), ends.tolist(), strict=True))
    ]


@dataclass(frozen=True)
class Batch:
    """Many trials laid out for the compiled kernel: prepared once, run as often as one likes.

    Trial i has rows `starts[i]:starts[i + 1]` of the answer. `thetas`, shape (n_trials, n_parameters), may be replaced
    between runs as long as no effect changes between none and some.
    """

    integrate_many: Callable[..., None]
    times_s: list[Floats]
    starts: NDArray[np.int64]
    times: Floats
    on: NDArray[np.bool_]
    rigs: Floats
    thetas: Floats
    trace_starts: NDArray[np.int64]
    trace_time: Floats
    trace_pressure: Floats
    bend_starts: NDArray[np.int64]
    bends: Floats
    breakpoints: Floats
    stops: Floats

    def run(self, relative_tolerance: float = RELATIVE_TOLERANCE, threads: int | None = None) -> tuple[Floats, Floats]:
        """Integrate every trial.

        Parameters
        ----------
        relative_tolerance : of the integrator, relative to the speed that a motion reaches.
        threads : to share the trials among, by default one for every 64 trials and no more than there are cores: the
            kernel runs outside the interpreter's lock.

        Returns
        -------
        out : array, shape (n_times, 4): x, v, a of the tail, position of the leading edge as the camera reports it
        ends : array, shape (n_trials, 5): status, end time, end speed, number of steps, first slack
        """
        count = self.starts.size - 1
        out, ends = np.empty((self.times.size, 4)), np.empty((count, 5))
        threads = threads or max(1, min(os.cpu_count() or 1, count // SMALLEST_SHARE))
        edges = np.linspace(0, count, threads + 1).astype(int).tolist()
        if threads == 1:
            self._part(0, count, relative_tolerance, out, ends)
        else:
            shared = relative_tolerance, out, ends
            (begin, end), *others = itertools.pairwise(edges)
            shares = [_pool(os.getpid(), threads).submit(self._part, a, b, *shared) for a, b in others]
            self._part(begin, end, *shared)
            for share in shares:
                share.result()
        return out, ends

    def _part(self, a: int, b: int, relative_tolerance: float, out: Floats, ends: Floats) -> None:
        """Trials a to b, each into its own rows of `out` and `ends`."""
        self.integrate_many(
            self.starts[a : b + 1],
            self.times,
            self.on[a:b],
            self.rigs[a:b],
            self.thetas[a:b],
            self.trace_starts[a : b + 1],
            self.trace_time,
            self.trace_pressure,
            self.bend_starts[a : b + 1],
            self.bends,
            self.breakpoints[a:b],
            self.stops[a:b],
            relative_tolerance,
            out,
            ends[a:b],
            np.empty((7, 4)),
        )


@lru_cache
def _pool(process: int, threads: int) -> ThreadPoolExecutor:  # noqa: ARG001
    """Threads that wait for work; a process that was forked off has its own."""
    return ThreadPoolExecutor(threads)


def prepare(
    model: Model,
    trials: Sequence[Trial],
    times_s: Sequence[Floats],
    *,
    traces: Sequence[Trace | None] | None = None,
    parameters: Floats | None = None,
    host: Model | None = None,
) -> Batch:
    """Lay out trials for the compiled kernel.

    Parameters
    ----------
    model, trials, times_s, traces, parameters, host : as those of `simulate_many`

    Returns
    -------
    Batch
        Ready to be run, as often as needed.

    Raises
    ------
    EffectError
        If a trial lacks what an effect needs, or the host does not hold the model.
    """
    check_needs(model, *trials)
    rigs = np.array([trial_inputs(trial) for trial in trials], dtype=float).reshape(
        len(trials), len(TrialInputs._fields)
    )
    if parameters is None:
        of_vine = {vine: model.parameters_for(vine) for vine in {trial.vine for trial in trials}}
        parameters = np.array([of_vine[trial.vine] for trial in trials])
    bends = [bends_of(trial) for trial in trials]
    return lay_out(model, rigs, bends, times_s, traces=traces, parameters=parameters, host=host)


def bends_of(trial: Trial) -> list[tuple[float, float, float]]:
    """The bends of a trial as numbers.

    Parameters
    ----------
    trial : the vine and its settings

    Returns
    -------
    list of (start, arc, radius)
        m, one for each bend.
    """
    return [(bend.start_m, bend.arc_m, bend.radius_m) for bend in trial.bends]


def lay_out(
    model: Model,
    rigs: Floats,
    bends: Sequence[Sequence[tuple[float, float, float]]],
    times_s: Sequence[Floats],
    *,
    traces: Sequence[Trace | None] | None = None,
    parameters: Floats,
    host: Model | None = None,
) -> Batch:
    """As `prepare`, for trials that are rows of numbers already.

    Parameters
    ----------
    model, times_s, traces, parameters, host : as those of `simulate_many`
    rigs : shape (n_trials, n_fields of `TrialInputs`), SI
    bends : by trial, as `bends_of` returns them

    Returns
    -------
    Batch
        Ready to be run.
    """
    count = len(rigs)
    traces = traces or [None] * count
    thetas = np.ascontiguousarray(parameters, dtype=float).reshape(count, len(model.parameter_names))
    if host is not None and host.names != model.names:
        resting = np.array([name not in model for name in host.names])
        model, thetas = host, hosted(host, model, thetas)
        on = effects_on(model, thetas) & ~resting
    else:
        on = effects_on(model, thetas)
    breakpoints, stops = _limits(model, rigs, thetas, on, bends)
    given_times = [np.asarray(t, dtype=float) for t in times_s]
    true_times = _true_times(model, rigs, thetas, on, given_times)
    traces = _true_traces(model, rigs, thetas, on, traces)
    given = [trace for trace in traces if trace is not None]
    tail_free = bool(rigs[:, TrialInputs._fields.index("tail_free")].any()) if count else False
    return Batch(
        integrate_many=kernel(model.effects, tail_free).integrate_many,
        times_s=given_times,
        starts=_starts(given_times),
        times=np.concatenate(true_times) if true_times else np.empty(0),
        on=on,
        rigs=rigs,
        thetas=thetas,
        trace_starts=_starts([() if trace is None else trace[0] for trace in traces]),
        trace_time=np.concatenate([np.asarray(t, float) for t, _ in given]) if given else np.empty(0),
        trace_pressure=np.concatenate([np.asarray(p, float) for _, p in given]) if given else np.empty(0),
        bend_starts=_starts(bends),
        bends=np.array([row for rows in bends for row in rows], dtype=float).reshape(-1, 3),
        breakpoints=breakpoints,
        stops=stops,
    )


def _starts(parts: Sequence[Sized]) -> NDArray[np.int64]:
    """Where each part begins when all are laid end to end, and where the last ends, shape (n_parts + 1,)."""
    return np.concatenate([[0], np.cumsum([len(part) for part in parts])]).astype(np.int64)


def _limits(
    model: Model,
    rigs: Floats,
    thetas: Floats,
    on: NDArray[np.bool_],
    bends: Sequence[Sequence[tuple[float, float, float]]],
) -> tuple[Floats, Floats]:
    """Tail travel at the breakpoints of the forces, rising, and at which growth ends, m; infinite where there is none.

    Of shape (n_trials, n_breakpoints) and (n_trials,). Breakpoints are where the film's mass reaches its floor, where
    bends begin and end, and what effects say of theirs.
    """
    rig = TrialInputs(*rigs.T)
    film = np.ones(len(rigs))
    for effect, function, place in asked(model, "film_gain"):
        for k in np.flatnonzero(on[:, effect]).tolist():
            film[k] *= function(_NOTHING, TrialInputs(*rigs[k]), *thetas[k, place])
    end = np.where(np.asarray(rig.length) > 0, np.asarray(rig.length) * rig.travel_ratio, math.inf)
    left = np.asarray(rig.linear_density) * rig.length - rig.least_mass / film
    loss = np.asarray(rig.mass_loss)
    floor = np.where(loss > 0, np.maximum(left, 0.0) / np.where(loss > 0, loss, 1.0), math.inf)
    broken = [i for i, effect in enumerate(model.effects) if effect.breakpoints is not None and on[:, i].any()]
    if not broken and not any(bends):
        return floor[:, None].copy(), end
    positions_m = [[edge for start, arc, _ in rows for edge in (start, start + arc)] for rows in bends]
    for i in broken:
        of_effect = model.effects[i].breakpoints
        assert of_effect is not None
        for k in np.flatnonzero(on[:, i]).tolist():
            positions_m[k] += of_effect(TrialInputs(*rigs[k]), *thetas[k, model.places[i]])
    breakpoints = np.full((len(rigs), 1 + max(map(len, positions_m), default=0)), math.inf)
    breakpoints[:, 0] = floor
    for k, positions in enumerate(positions_m):
        breakpoints[k, 1 : 1 + len(positions)] = np.array(positions) * np.asarray(rig.travel_ratio)[k]
    return np.sort(breakpoints, axis=1), end


def _true_times(
    model: Model, rigs: Floats, thetas: Floats, on: NDArray[np.bool_], times_s: Sequence[Floats]
) -> list[Floats]:
    """When what the camera stamps `times_s` really happened, by trial."""
    true_times = list(times_s)
    for effect, function, place in asked(model, "true_time"):
        for i in np.flatnonzero(on[:, effect]):
            state = _NOTHING._replace(time=true_times[i])  # type: ignore[arg-type]
            true_times[i] = np.asarray(function(state, TrialInputs(*rigs[i]), *thetas[i, place]), dtype=float)
    return true_times


def _true_traces(
    model: Model, rigs: Floats, thetas: Floats, on: NDArray[np.bool_], traces: Sequence[Trace | None]
) -> list[Trace | None]:
    """Measured pressures at the times at which they were really measured, by trial."""
    in_time = list(traces)
    for effect, function, place in asked(model, "trace_time"):
        for i in np.flatnonzero(on[:, effect]).tolist():
            if (trace := in_time[i]) is None:
                continue
            state = _NOTHING._replace(time=trace[0])  # type: ignore[arg-type]
            in_time[i] = np.asarray(function(state, TrialInputs(*rigs[i]), *thetas[i, place]), dtype=float), trace[1]
    return in_time


def _trajectory(
    name: str, r: float, times_s: Floats, motion: Floats, observed_m: Floats, end: Sequence[float]
) -> Trajectory:
    """One trial of a batch; `motion` has position, velocity and acceleration of the leading edge in its rows."""
    status = STATUS[int(end[0])]
    if status == "too hard":
        raise SimulationError(f"Trial {name}: the model could not be integrated beyond {end[1]:.6g} s.")
    return Trajectory(
        time_s=times_s,
        lead_position_m=motion[0],
        lead_velocity_m_s=motion[1],
        lead_acceleration_m_s2=motion[2],
        observed_position_m=observed_m,
        travel_ratio=r,
        status=status,
        end_time_s=end[1],
        end_lead_velocity_m_s=end[2] / r,
        n_steps=int(end[3]),
        slack_from_s=end[4],
    )
