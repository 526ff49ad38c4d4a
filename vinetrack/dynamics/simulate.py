"""Simulation of trials by a model, whose effects are one compiled function that is generated as Python source.

The effects are plain Python functions in separate files. This module writes a small module that calls them in the order
of the physics and passes itself to the integrator. It is compiled once and cached under a hash of everything it depends
on, so that other processes find the compiled form. Trials are laid out one after the other for it, and integrated in
one call.
"""

from __future__ import annotations

import atexit
import hashlib
import importlib.util
import inspect
import itertools
import math
import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Sequence, Sized
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from types import ModuleType
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from vinetrack.core import units
from vinetrack.core.problems import UserError
from vinetrack.core.records import Floats, Trial
from vinetrack.core.tables import write_text
from vinetrack.dynamics.equations import BatchArrays, Status
from vinetrack.dynamics.model import Model, check_needs, effects_on, hosted, shared_host
from vinetrack.effects import Effect, State, TrialInputs

_STATE = (
    "State(time, y, ydot, x, v, set_pressure, pressure, yield_pressure, area, density, mass, gain, bend_angle, "
    "tension, seen, 0.0)"
)


def sum_source(effects: Sequence[Effect]) -> str:
    """Source of the module with the functions of this sum of effects: see `vinetrack.dynamics.equations`."""
    model = Model(tuple(effects))
    loads: dict[str, str] = {}

    def calls(hook: str, assign: str, indent: int = 4, state: str = _STATE) -> str:
        """Call a hook of every effect that acts, one after the other, and load its functions."""
        lines = []
        for i, _, place in model.hooks[hook]:
            effect = model.effects[i]
            name = f"{effect.name}__{hook}"
            loads[name] = f"{name} = inlined(EFFECTS[{i}].functions[{hook!r}])"
            arguments = "".join(f", theta[{j}]" for j in range(place.start, place.stop))
            # A measured pressure includes everything that happens in the chamber.
            condition = f"on[{i}] and not measured" if effect.in_trace else f"on[{i}]"
            lines += [f"if {condition}:", f"    {assign} {name}({state}, rig{arguments})"]
        return ("\n" + " " * indent).join(lines)

    def function(
        name: str, arguments: str, motion: str, *body: str, at_release: bool = False, how: str = "inlined"
    ) -> str:
        lines = "\n    ".join(body)
        return f"""
@{how}
def {name}({arguments}):
    on, theta = trial.on, trial.theta
    rig = TrialInputs({", ".join(f"trial.inputs[{i}]" for i in range(len(TrialInputs._fields)))})
    film = 1.0
    {motion}
    yield_pressure = rig.yield_pressure
    area, gain, bend_angle, tension, seen = rig.area, 1.0, {"0.0" if at_release else "angle_passed(y, trial)"}, 0.0, y
    mass, density = 0.0, rig.linear_density
    measured = {"False" if at_release else "trial.trace_time.size > 0"}
    chamber_rate, set_pressure, pressure = 0.0, rig.set_pressure, rig.set_pressure
    tip, tail = 0.0, 0.0
    {lines}
"""

    # Gauge, then chamber, then area and losses. Where the area depends on the pressure, they are iterated: without
    # strain that converges at once, with the largest strain by one or two digits a turn.
    losses = calls("pressure", "pressure =")
    if model.hooks["area"]:
        losses = f"""start = pressure
    for turn in range(30):
        area_before, area = area, rig.area
        {calls("area", "area =", 8)}
        if turn > 0 and abs(area - area_before) <= 1e-10 * area:
            break
        pressure = start
        {calls("pressure", "pressure =", 8)}"""
    has_chamber = bool(model.hooks["chamber_rate"])
    terms = f"""{calls("film_gain", "film *=")}
    density = rig.linear_density * film
    film_mass = density * rig.length - rig.mass_loss * film * rig.travel_ratio * y
    mass = max(film_mass, rig.least_mass) + rig.payload_mass
    {calls("gauge", "pressure =")}
    set_pressure = pressure
    if measured:
        pressure = trace_at(time, trial)
        {calls("gauge", "pressure =", 8)}
    {"else: pressure = chamber" if has_chamber else ""}
    {calls("yield_gauge", "yield_pressure =")}
    {losses}
    {calls("damping_gain", "gain =")}
    {calls("tip_force", "tip +=")}
    {calls("tail_force", "tail +=")}"""
    # Everything that moves with the tail (`vinetrack.dynamics.audit.evaluate`): mass that effects add has no weight
    # of its own, so it is added after the forces.
    added = f"""added = 0.0
    {calls("added_mass", "added +=")}
    mass = max(film_mass + max(added, 0.0), rig.least_mass)
    mass = max(mass + min(added, 0.0) + rig.payload_mass, rig.least_mass)"""
    added = added if model.hooks["added_mass"] else ""
    # The rate of the chamber depends on its own pressure, not on that at the tip.
    chamber = calls("chamber_rate", "chamber_rate +=", state=_STATE.replace(" pressure,", " chamber,"))
    acceleration = "return (tip / rig.travel_ratio + tail) / mass, chamber_rate"
    moving = "x, v = max(x, 0.0), max(v, 0.0)\n    y, ydot = x / rig.travel_ratio, v / rig.travel_ratio"
    released = "x, v, y, ydot, time = 0.0, 0.0, 0.0, 0.0, 0.0"
    gauge, held = calls("gauge", "pressure ="), calls("rest_force", "tip +=", 8) or "pass"
    seen = f"""tension = max(tip, 0.0) / rig.travel_ratio
        {calls("observed_position", "seen =", 8)}"""
    asked = f"""if what == Asked.SEEN:
        {seen}
        return seen, 0.0
    if what == Asked.REST_ACCELERATION or what == Asked.REST_TENSION:
        {held}
    {chamber}
    if what == Asked.FREE_FALL:
        return tail / mass, chamber_rate
    if what == Asked.TENSION or what == Asked.REST_TENSION:
        return tip / rig.travel_ratio, chamber_rate
    if what == Asked.REST_ACCELERATION and rig.tail_free > 0:
        tip = max(tip, 0.0)
    {added}
    {acceleration}"""
    # Without an effect that changes the position that the camera reports, it is that of the edge.
    acting = " or ".join(f"on[{i}]" for i in sorted(i for i, _, _ in model.hooks["observed_position"]))
    seen = f"""if {acting or "False"}:
        seen, chamber_rate = ask(Asked.SEEN, time, y, ydot, x, v, chamber, trial)
    return seen"""
    functions = [
        function("rates", "time, x, v, chamber, trial", moving, terms, chamber, added, acceleration),
        function("ask", "what, time, y, ydot, x, v, chamber, trial", "", terms, asked, how="compiled"),
        function("observed", "time, x, v, chamber, trial", moving, seen),
        function("first_chamber", "trial", released, gauge, "return pressure", at_release=True),
        f"\n@inlined\ndef has_chamber():\n    return {has_chamber}\n",
    ]
    for hook in ("row_delay", "averaged_over"):
        summed = "total = 0.0", calls(hook, "total +="), "return total"
        functions.append(function(hook, "trial", released, *summed, at_release=True))
    loaded = "\n".join(loads.values())
    return f"""\"""Machine-made: a sum of effects, for the integrator of vinetrack.dynamics.\"""

import sys

from numba import njit

from vinetrack.dynamics.equations import Asked, angle_passed, compiled, inlined, trace_at
from vinetrack.dynamics.integrator import integrate_trials
from vinetrack.effects import State, TrialInputs

{loaded}
{"".join(functions)}
EQUATIONS = sys.modules[__name__]


# Only the outermost function is called from Python; what it calls is compiled into it, and kept with it.
@njit(nogil=True, error_model="numpy", _nrt=False, no_cfunc_wrapper=True, cache=True)
def integrate_many(batch, first, last, rtol, out, ends, work, means):
    integrate_trials(EQUATIONS, batch, first, last, rtol, out, ends, work, means)
"""


@lru_cache
def _cache_folder() -> Path:
    for base in filter(None, (os.environ.get("VINETRACK_CACHE"), os.environ.get("XDG_CACHE_HOME"), "~/.cache")):
        folder = Path(base).expanduser() / "vinetrack" / "kernels"
        with suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder):
                return folder
    own = tempfile.mkdtemp(prefix="vinetrack-")  # of this process alone: code is run from there
    atexit.register(shutil.rmtree, own, ignore_errors=True)
    return Path(own)


@lru_cache(maxsize=64)
def kernel(effects: tuple[Effect, ...]) -> ModuleType:
    """The compiled module for these effects; its `integrate_many` is described in `vinetrack.dynamics.integrator`."""
    source = sum_source(effects)
    integrator = (Path(__file__).with_name(name) for name in ("equations.py", "integrator.py"))
    parts = [source, *(file.read_text(encoding="utf-8") for file in integrator)]
    parts += [inspect.getsource(part) for part in (sys.modules[Effect.__module__], units)]
    parts += [numba.__version__, sys.version]
    # The compiled form refers to the modules of the effects by name; a name holds the hash of the file's text.
    parts += [function.__module__ for effect in effects for function in effect.functions.values()]
    name = f"kernel_{hashlib.sha256(chr(0).join(parts).encode()).hexdigest()[:20]}"
    if name in sys.modules:  # of equal effects that were read again
        return sys.modules[name]
    path = _cache_folder() / f"{name}.py"
    if not path.is_file():
        write_text(path, source)
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    module.__dict__["EFFECTS"] = effects
    sys.modules[name] = module  # numba finds its cached form by the module's name
    spec.loader.exec_module(module)
    return module


# ------------------------------------------------------------------------------
# Trials concatenated for the compiled kernel, and its calls.

RELATIVE_TOLERANCE = 1e-4  # Local tolerance on the speed

_NOTHING = State(*(math.nan,) * len(State._fields))

Trace = tuple[Floats, Floats]  # Times since release, s, and gauge pressures, Pa, measured at them


_pool = lru_cache(ThreadPoolExecutor)  # Threads of this process, kept: starting them takes as long as a small batch
os.register_at_fork(after_in_child=_pool.cache_clear)


@dataclass(frozen=True)
class Batch:
    """Trials laid out for the kernel; `stamps`, (n_times,), are on the clock of the camera, `arrays.times` true, s."""

    integrate_many: Callable[..., None]
    stamps: Floats
    arrays: BatchArrays

    @property
    def starts(self) -> NDArray[np.int64]:
        """Start of each trial's rows, and the end of the last."""
        return self.arrays.starts

    def run(self, relative_tolerance: float = RELATIVE_TOLERANCE) -> tuple[Floats, Floats]:
        """Integrate every trial: out, shape (n_times, 4), and ends, shape (n_trials, 5)."""
        count = self.starts.size - 1
        out, ends = np.empty((self.stamps.size, 4)), np.empty((count, 5))
        # For fewer than 64 trials another thread costs more than it saves.
        threads = min(numba.config.NUMBA_NUM_THREADS, count // 64)  # type: ignore[attr-defined]
        longest = int(np.diff(self.starts).max(initial=0))

        def integrate(first: int, last: int) -> None:
            work, means = np.empty((5, 4)), np.empty((2, longest))
            self.integrate_many(self.arrays, first, last, relative_tolerance, out, ends, work, means)

        if threads < 2:
            integrate(0, count)
        else:
            edges = np.linspace(0, count, threads + 1).astype(int)
            list(_pool(threads).map(integrate, edges[:-1], edges[1:]))
        return out, ends


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
    """Lay out trials. Shapes: inputs (n_trials, fields of `TrialInputs`), stamps (n_times,), starts (n_trials + 1,)."""
    count = len(inputs)
    thetas = np.ascontiguousarray(parameters, dtype=float).reshape(count, len(model.parameter_names))
    if host is None:
        host = shared_host(model.effects)
    if host is not None and host.names != model.names:
        resting = np.array([name not in model for name in host.names])
        model, thetas = host, hosted(host, model, thetas)
        on = effects_on(model, thetas) & ~resting
    else:
        on = effects_on(model, thetas)
    breakpoints, stops = _limits(model, inputs, thetas, on, bends)
    samples = [np.empty(0) if trace is None else trace[0] for trace in traces] if traces else [np.empty(0)] * count
    sampled, trace_starts = np.concatenate([np.empty(0), *(samples if traces else ())]), starts_of(samples)
    clocks = model, inputs, thetas, on
    trace_time = _true(*clocks, "trace_time", trace_starts, sampled)
    read_Pa = np.concatenate([np.empty(0), *(trace[1] for trace in traces or () if trace is not None)])
    arrays = BatchArrays(
        starts=starts,
        times=_true(*clocks, "true_time", starts, stamps),
        on=on,
        inputs=inputs,
        thetas=thetas,
        trace_starts=trace_starts,
        trace_time=trace_time,
        trace_pressure=_true(*clocks, "trace_pressure", trace_starts, trace_time, read_Pa),
        bend_starts=starts_of(bends),
        bends=np.array([row for rows in bends for row in rows], dtype=float).reshape(-1, 3),
        breakpoints=breakpoints,
        stops=stops,
    )
    return Batch(kernel(model.effects).integrate_many, stamps, arrays)


def starts_of(parts: Sequence[Sized]) -> NDArray[np.int64]:
    """Start of each part in their concatenation, and the end of the last. Shape (n_parts + 1,)."""
    starts = np.zeros(len(parts) + 1, dtype=np.int64)
    np.cumsum(np.fromiter(map(len, parts), np.int64, len(parts)), out=starts[1:])
    return starts


def _limits(
    model: Model,
    inputs: Floats,
    thetas: Floats,
    on: NDArray[np.bool_],
    bends: Sequence[Sequence[tuple[float, float, float]]],
) -> tuple[Floats, Floats]:
    """Tail travel, m, at the breakpoints of the forces, increasing, (n_trials, n_breakpoints), and at the end of
    growth, (n_trials,); infinite if there is none. Film mass at its floor, ends of bends, and effects make breakpoints.
    """
    rig = TrialInputs(*inputs.T)
    film = np.ones(len(inputs))
    for effect, function, place in model.hooks["film_gain"]:
        for k in np.flatnonzero(on[:, effect]).tolist():
            film[k] *= function(_NOTHING, TrialInputs(*inputs[k]), *thetas[k, place])
    end = np.where(np.asarray(rig.length) > 0, np.asarray(rig.length) * rig.travel_ratio, math.inf)
    everting_mass_kg = np.asarray(rig.linear_density) * rig.length - rig.least_mass / film
    mass_loss_kg_m = np.asarray(rig.mass_loss)
    never = np.full(len(inputs), math.inf)
    floor_x_m = np.divide(np.maximum(everting_mass_kg, 0.0), mass_loss_kg_m, out=never, where=mass_loss_kg_m > 0)
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
    aligned = np.array(list(itertools.zip_longest(*positions_m, fillvalue=math.inf))).reshape(-1, len(inputs))
    return np.sort(np.vstack([floor_x_m, aligned * np.asarray(rig.travel_ratio)]).T, axis=1), end


def _true(
    model: Model, inputs: Floats, thetas: Floats, on: NDArray[np.bool_], hook: str, starts: NDArray[np.int64],
    time_s: Floats, read_Pa: Floats | None = None,
) -> Floats:  # fmt: skip
    """True times since release of stamps, or pressures behind readings at these times, of all trials, by the effects on
    the clock or the trace. Shapes: time_s, read_Pa (n_times,).
    """
    true = (time_s if read_Pa is None else read_Pa).copy()
    for effect, function, place in model.hooks[hook]:
        for i in np.flatnonzero(on[:, effect] & (np.diff(starts) > 0)).tolist():
            part = slice(starts[i], starts[i + 1])
            own, time = true[part], time_s[part]
            known: dict[str, Any] = {"time": own}
            if read_Pa is not None:
                known = {"time": time, "pressure": own}
                known["pressure_slope"] = np.gradient(own, time) if own.size > 1 else np.zeros(1)
            own[:] = function(_NOTHING._replace(**known), TrialInputs(*inputs[i]), *thetas[i, place])
    return true


# ------------------------------------------------------------------------------
# Trajectories of trials.


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
    made = []
    for ratio, (first, last), end in zip(ratios, itertools.pairwise(edges), ends.tolist(), strict=True):
        (status, end_s, end_speed, n_steps, slack_from_s), time_s = end, batch.stamps[first:last]
        position, velocity, acceleration = motion[:, first:last]
        how = Status(status).name.lower(), end_s, end_speed / ratio, int(n_steps), slack_from_s
        made.append(Trajectory(time_s, position, velocity, acceleration, out[first:last, 3], ratio, *how))
    return made


def check_completed(ends: Floats, names: Sequence[str]) -> None:
    """Raise an error for a trial that the integrator could not complete. Shapes: ends (n_trials, 5)."""
    failed = np.flatnonzero(ends[:, 0] == Status.TOO_HARD)
    if failed.size:
        end_s = float(ends[failed[0], 1])
        raise SimulationError(f"Trial {names[failed[0]]}: the model could not be integrated beyond {end_s:.6g} s.")


def bends_of(trial: Trial) -> list[tuple[float, float, float]]:
    """The bends of a trial as numbers."""
    return [(bend.start_m, bend.arc_m, bend.radius_m) for bend in trial.bends]
