"""Trials concatenated for the compiled kernel, and its calls."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence, Sized
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.core.thread_pool import available_cores, thread_pool
from vinetrack.dynamics.host import shared_host
from vinetrack.dynamics.kernel import kernel
from vinetrack.dynamics.model import Model, effects_on, hook_functions, hosted
from vinetrack.effects import State, TrialInputs

RELATIVE_TOLERANCE = 1e-4  # Local tolerance on the speed

_NOTHING = State(*(math.nan,) * len(State._fields))

SMALLEST_SHARE = 64  # Trials below which another thread costs more than it saves (chosen)

Trace = tuple[Floats, Floats]  # Times since release, s, and gauge pressures, Pa, measured at them


@dataclass(frozen=True)
class Batch:
    """Trials laid out for the compiled kernel: prepared once, run as often as needed. Trial i has rows
    `starts[i]:starts[i + 1]` of the result; `stamps`, shape (n_times,), are its times since release on the camera's
    clock, `times` the true ones.
    """

    integrate_many: Callable[..., None]
    stamps: Floats
    starts: NDArray[np.int64]
    times: Floats
    on: NDArray[np.bool_]
    inputs: Floats
    thetas: Floats
    trace_starts: NDArray[np.int64]
    trace_time: Floats
    trace_pressure: Floats
    bend_starts: NDArray[np.int64]
    bends: Floats
    breakpoints: Floats
    stops: Floats

    def run(self, relative_tolerance: float = RELATIVE_TOLERANCE, threads: int | None = None) -> tuple[Floats, Floats]:
        """Integrate every trial. Returns out, ends. Shape (n_times, 4)."""
        count = self.starts.size - 1
        out, ends = np.empty((self.times.size, 4)), np.empty((count, 5))
        threads = threads or max(1, min(available_cores(), count // SMALLEST_SHARE))
        edges = np.linspace(0, count, threads + 1).astype(int).tolist()
        if threads == 1:
            self._part(0, count, relative_tolerance, out, ends)
        else:
            shared = relative_tolerance, out, ends
            (begin, end), *others = itertools.pairwise(edges)
            shares = [thread_pool(threads).submit(self._part, a, b, *shared) for a, b in others]
            self._part(begin, end, *shared)
            for share in shares:
                share.result()
        return out, ends

    def _part(self, a: int, b: int, relative_tolerance: float, out: Floats, ends: Floats) -> None:
        """Integrate trials a to b, each into its own rows of `out` and `ends`."""
        self.integrate_many(
            self.starts[a : b + 1],
            self.times,
            self.on[a:b],
            self.inputs[a:b],
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
            np.empty(int(np.diff(self.starts[a : b + 1]).max(initial=0))),
        )


def lay_out(
    model: Model,
    inputs: Floats,
    bends: Sequence[Sequence[tuple[float, float, float]]],
    stamps: Floats,
    starts: NDArray[np.int64],
    *,
    traces: Sequence[Trace | None] | None = None,
    parameters: Floats,
    host: Model | None = None,
) -> Batch:
    """As `simulate.prepare`, for trials whose inputs are numbers already. Shapes: inputs (n_trials, n_fields of
    `TrialInputs`); stamps (n_times,); starts (n_trials + 1,).
    """
    count = len(inputs)
    thetas = np.ascontiguousarray(parameters, dtype=float).reshape(count, len(model.parameter_names))
    tail_free = bool(inputs[:, TrialInputs._fields.index("tail_free")].any()) if count else False
    if host is None and not tail_free:
        host = shared_host(model.effects)
    if host is not None and host.names != model.names:
        resting = np.array([name not in model for name in host.names])
        model, thetas = host, hosted(host, model, thetas)
        on = effects_on(model, thetas) & ~resting
    else:
        on = effects_on(model, thetas)
    breakpoints, stops = _limits(model, inputs, thetas, on, bends)
    times = _true_times(model, inputs, thetas, on, stamps, starts)
    traces = _true_traces(model, inputs, thetas, on, traces) if traces is not None else [None] * count
    given = [trace for trace in traces if trace is not None]
    return Batch(
        integrate_many=kernel(model.effects, tail_free).integrate_many,
        stamps=stamps,
        starts=starts,
        times=times,
        on=on,
        inputs=inputs,
        thetas=thetas,
        trace_starts=starts_of([() if trace is None else trace[0] for trace in traces] if given else [()] * count),
        trace_time=np.concatenate([np.asarray(t, float) for t, _ in given]) if given else np.empty(0),
        trace_pressure=np.concatenate([np.asarray(p, float) for _, p in given]) if given else np.empty(0),
        bend_starts=starts_of(bends),
        bends=np.array([row for rows in bends for row in rows], dtype=float).reshape(-1, 3),
        breakpoints=breakpoints,
        stops=stops,
    )


def starts_of(parts: Sequence[Sized]) -> NDArray[np.int64]:
    """Start of each part in their concatenation, and the end of the last. Shape (n_parts + 1,)."""
    starts = np.zeros(len(parts) + 1, dtype=np.int64)
    np.cumsum([len(part) for part in parts], out=starts[1:])
    return starts


def _limits(
    model: Model,
    inputs: Floats,
    thetas: Floats,
    on: NDArray[np.bool_],
    bends: Sequence[Sequence[tuple[float, float, float]]],
) -> tuple[Floats, Floats]:
    """Tail travel at the breakpoints of the forces, increasing, and at the end of growth, m; infinite if there is none.
    Of shape (n_trials, n_breakpoints) and (n_trials,). Breakpoints are where the film's mass reaches its floor, where
    bends begin and end, and where effects declare them.
    """
    rig = TrialInputs(*inputs.T)
    film = np.ones(len(inputs))
    for effect, function, place in hook_functions(model, "film_gain"):
        for k in np.flatnonzero(on[:, effect]).tolist():
            film[k] *= function(_NOTHING, TrialInputs(*inputs[k]), *thetas[k, place])
    end = np.where(np.asarray(rig.length) > 0, np.asarray(rig.length) * rig.travel_ratio, math.inf)
    everting_mass_kg = np.asarray(rig.linear_density) * rig.length - rig.least_mass / film
    mass_loss_kg_m = np.asarray(rig.mass_loss)
    floor_x_m = np.where(
        mass_loss_kg_m > 0,
        np.maximum(everting_mass_kg, 0.0) / np.where(mass_loss_kg_m > 0, mass_loss_kg_m, 1.0),
        math.inf,
    )
    with_breakpoints = [
        i for i, effect in enumerate(model.effects) if effect.breakpoints is not None and on[:, i].any()
    ]
    if not with_breakpoints and not any(bends):
        return floor_x_m[:, None].copy(), end
    positions_m = [[edge for start, arc, _ in rows for edge in (start, start + arc)] for rows in bends]
    for i in with_breakpoints:
        of_effect = model.effects[i].breakpoints
        assert of_effect is not None
        cached: dict[tuple[bytes, bytes], list[float]] = {}
        for k in np.flatnonzero(on[:, i]).tolist():
            # Finite differences change one parameter of a trial at a time, and most affect no breakpoint.
            key = inputs[k].tobytes(), thetas[k, model.places[i]].tobytes()
            if key not in cached:
                cached[key] = list(of_effect(TrialInputs(*inputs[k]), *thetas[k, model.places[i]]))
            positions_m[k] += cached[key]
    breakpoints = np.full((len(inputs), 1 + max(map(len, positions_m), default=0)), math.inf)
    breakpoints[:, 0] = floor_x_m
    for k, positions in enumerate(positions_m):
        breakpoints[k, 1 : 1 + len(positions)] = np.array(positions) * np.asarray(rig.travel_ratio)[k]
    return np.sort(breakpoints, axis=1), end


def _true_times(
    model: Model, inputs: Floats, thetas: Floats, on: NDArray[np.bool_], stamps: Floats, starts: NDArray[np.int64]
) -> Floats:
    """True times of the camera's stamps, for all trials concatenated, shape (n_times,)."""
    true_times = stamps
    for effect, function, place in hook_functions(model, "true_time"):
        true_times = true_times.copy()
        for i in np.flatnonzero(on[:, effect]):
            of_trial = slice(starts[i], starts[i + 1])
            state = _NOTHING._replace(time=true_times[of_trial])  # type: ignore[arg-type]
            true_times[of_trial] = function(state, TrialInputs(*inputs[i]), *thetas[i, place])
    return true_times


def _true_traces(
    model: Model, inputs: Floats, thetas: Floats, on: NDArray[np.bool_], traces: Sequence[Trace | None]
) -> list[Trace | None]:
    """Measured pressures of each trial at the true times of their samples."""
    in_time = list(traces)
    for effect, function, place in hook_functions(model, "trace_time"):
        for i in np.flatnonzero(on[:, effect]).tolist():
            if (trace := in_time[i]) is None:
                continue
            state = _NOTHING._replace(time=trace[0])  # type: ignore[arg-type]
            in_time[i] = np.asarray(function(state, TrialInputs(*inputs[i]), *thetas[i, place]), dtype=float), trace[1]
    return in_time
