"""The sum of the effects of a model as one compiled function, generated as Python source.

The effects are plain Python functions in separate files. This module writes a small module that calls them in the order
of the physics and passes the result, an `Equations`, to the integrator. It is compiled once and cached under a hash of
everything it depends on, so that other processes find the compiled form.
"""

from __future__ import annotations

import hashlib
import importlib.util
import inspect
import itertools
import math
import os
import sys
import tempfile
from collections.abc import Callable, Sequence, Sized
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from vinetrack.core import units
from vinetrack.core.records import Floats
from vinetrack.core.threads import available_cores, thread_pool
from vinetrack.dynamics.integrator import BATCH
from vinetrack.dynamics.model import Model, effects_on, hosted, shared_host
from vinetrack.effects import Effect, State, TrialInputs, effect_sources

_HEAD = '''"""Machine-made: the effects {names} summed, for the integrator of vinetrack.dynamics."""

from numba import njit

from vinetrack.dynamics.equations import Equations, angle_passed, inlined, trace_at
from vinetrack.dynamics.integrator import follow_slack, integrate_trials, slack_at_rest, slack_fraction
from vinetrack.effects import State, TrialInputs

'''

_FOOT = """
EQUATIONS = Equations(__name__, {fields})


# Only the outermost function is called from Python; what it calls is compiled into it, and kept with it.
@njit(nogil=True, error_model="numpy", _nrt=False, no_cfunc_wrapper=True, cache=True)
def integrate_many({batch}):
    integrate_trials(EQUATIONS, {batch})
"""

_SUM = """
@inlined
def {name}({arguments}):
    on, theta = trial.on, trial.theta
    rig = TrialInputs({rig_fields})
    film = 1.0
    {motion}
    yield_pressure = rig.yield_pressure
    area, gain, bend_angle, tension, seen = rig.area, 1.0, {angle}, 0.0, y
    mass, density = 0.0, rig.linear_density
    measured = {measured}
    chamber_rate, set_pressure, pressure = 0.0, rig.set_pressure, rig.set_pressure
    tip, tail = 0.0, 0.0
{body}
"""

_STATE = (
    "State(time, y, ydot, x, v, set_pressure, pressure, yield_pressure, area, density, mass, gain, bend_angle, "
    "tension, seen)"
)
_MOTION = "time, x, v, chamber, trial"
_MOVING = """x, v = max(x, 0.0), max(v, 0.0)
    y, ydot = x / rig.travel_ratio, v / rig.travel_ratio"""
_AT_REST = "v, ydot = 0.0, 0.0\n    x = max(x, 0.0)\n    y = x / rig.travel_ratio"
_AT_RELEASE = "x, v, y, ydot, time = 0.0, 0.0, 0.0, 0.0, 0.0"


class _Writer:
    """Writes the calls of hooks, in the order of the effects, and collects the functions to be loaded."""

    def __init__(self, effects: Sequence[Effect]) -> None:
        self.model = Model(tuple(effects))
        self.loads: dict[str, str] = {}

    def calls(self, hook: str, target: str, state: str = _STATE) -> list[str]:
        lines = []
        for i, _, place in self.model.hooks[hook]:
            effect = self.model.effects[i]
            arguments = "".join(f", theta[{j}]" for j in range(place.start, place.stop))
            name = f"{effect.name}__{hook}"
            self.loads[name] = f"{name} = inlined(EFFECTS[{i}].functions[{hook!r}])"
            # A measured pressure includes everything that happens in the chamber.
            condition = f"on[{i}] and not measured" if effect.in_trace else f"on[{i}]"
            lines += [f"if {condition}:", f"    {target.format(call=f'{name}({state}, rig{arguments})')}"]
        return lines

    def pressure(self) -> list[str]:
        """Gauge, then chamber, then area and losses; where the area depends on the pressure, iterate to consistency."""
        gauge = self.calls("gauge", "pressure = {call}")
        lines = [*gauge, "set_pressure = pressure"]
        lines += ["if measured:", "    pressure = trace_at(time, trial)"]
        lines += [f"    {line}" for line in gauge]
        if self.model.hooks["chamber_rate"]:
            lines += ["else:", "    pressure = chamber"]
        lines += self.calls("yield_gauge", "yield_pressure = {call}")
        pressures = self.calls("pressure", "pressure = {call}")
        areas = self.calls("area", "area = {call}")
        if not areas:
            return lines + pressures
        # Fixed-point iteration: without strain it converges at once, with the largest strain by one or two digits a
        # turn.
        lines += ["start = pressure", "for turn in range(30):", "    area_before, area = area, rig.area"]
        lines += [f"    {line}" for line in areas]
        lines += ["    if turn > 0 and abs(area - area_before) <= 1e-10 * area:", "        break"]
        return lines + [f"    {line}" for line in ["pressure = start", *pressures]]

    def mass(self) -> list[str]:
        lines = [*self.calls("film_gain", "film *= {call}"), "density = rig.linear_density * film"]
        everted = "rig.mass_loss * film * rig.travel_ratio * y"
        lines += [f"film_mass = density * rig.length - {everted}"]
        lines += ["mass = max(film_mass, rig.least_mass) + rig.payload_mass"]
        return lines

    def inertia(self) -> list[str]:
        """Everything that moves with the tail; see `vinetrack.dynamics.audit.inertia_kg`."""
        added = self.calls("added_mass", "added += {call}")
        tail = "mass = max(film_mass + max(added, 0.0), rig.least_mass)"
        total = "mass = max(mass + min(added, 0.0) + rig.payload_mass, rig.least_mass)"
        return ["added = 0.0", *added, tail, total] if added else []

    def forces(self) -> list[str]:
        lines = self.calls("damping_gain", "gain = {call}")
        lines += self.calls("tip_force", "tip += {call}")
        return lines + self.calls("tail_force", "tail += {call}")

    def camera_shortcut(self) -> list[str]:
        """Return the position at once where no effect changes the position that the camera reports."""
        acting = [f"on[{i}]" for i in sorted(i for i, _, _ in self.model.hooks["observed_position"])]
        return [f"if not ({' or '.join(acting)}):", "    return seen"]

    def function(self, name: str, arguments: str, motion: str, lines: Sequence[str]) -> str:
        at_release = motion == _AT_RELEASE
        return _SUM.format(
            name=name,
            arguments=arguments,
            motion=motion,
            rig_fields=", ".join(f"trial.inputs[{i}]" for i in range(len(TrialInputs._fields))),
            angle="0.0" if at_release else "angle_passed(y, trial)",
            measured="False" if at_release else "trial.trace_time.size > 0",
            body="\n".join(f"    {line}" for line in lines),
        )


def sum_source(effects: Sequence[Effect], tail_free: bool = False) -> str:
    """Source of the module with the `vinetrack.dynamics.equations.Equations` of this sum of effects. Mass that effects
    add moves with the tail but has no weight of its own, so it is added after the forces.
    """
    writer = _Writer(effects)
    common_terms = [*writer.mass(), *writer.pressure(), *writer.forces()]
    added = writer.inertia()
    seen = writer.calls("observed_position", "seen = {call}")
    rest_forces = writer.calls("rest_force", "tip += {call}")
    # The rate of the chamber depends on its own pressure, not on that at the tip.
    chamber_rates = writer.calls("chamber_rate", "chamber_rate += {call}", _STATE.replace(" pressure,", " chamber,"))
    per_mass = "return (tip / rig.travel_ratio + tail) / mass"
    tension = "max(tip, 0.0) / rig.travel_ratio"
    no_compression = ["if rig.tail_free > 0:", "    tip = max(tip, 0.0)"] if tail_free else []
    camera_position = [*writer.camera_shortcut(), *common_terms, f"tension = {tension}", *seen]
    functions = [
        writer.function(
            "rates", _MOTION, _MOVING, [*common_terms, *chamber_rates, *added, f"{per_mass}, chamber_rate"]
        ),
        writer.function(
            "rest_acceleration",
            _MOTION.replace("v, ", ""),
            _AT_REST,
            [*common_terms, *rest_forces, *no_compression, *added, per_mass],
        ),
        writer.function("observed", _MOTION, _MOVING, [*(camera_position if seen else []), "return seen"]),
        writer.function(
            "first_chamber",
            "trial",
            _AT_RELEASE,
            [*writer.calls("gauge", "pressure = {call}"), "return pressure"],
        ),
    ]
    for hook in ("row_delay", "averaged_over"):
        summed = ["total = 0.0", *writer.calls(hook, "total += {call}"), "return total"]
        functions += [writer.function(hook, "trial", _AT_RELEASE, summed)]
    if tail_free:
        resting = ["if resting:", *[f"    {line}" for line in rest_forces or ["pass"]]]
        functions += [
            writer.function(
                "tip_tension",
                _MOTION.replace("chamber,", "chamber, resting,"),
                _MOVING,
                [*common_terms, *resting, *chamber_rates, "return tip / rig.travel_ratio, chamber_rate"],
            ),
            writer.function(
                "free_fall", _MOTION.replace("x, v,", "y, ydot, x, v,"), "", [*common_terms, "return tail / mass"]
            ),
        ]
    names = ", ".join(effect.name for effect in effects)
    functions += [f"@inlined\ndef has_chamber():\n    return {bool(writer.model.hooks['chamber_rate'])}\n"]
    fields = ["rates", "rest_acceleration", "observed", "first_chamber", "has_chamber", "row_delay", "averaged_over"]
    fields += ["slack_fraction", "slack_at_rest", "follow_slack", "tip_tension", "free_fall"] if tail_free else []
    foot = _FOOT.format(fields=", ".join(fields), batch=", ".join(BATCH))
    return "\n".join((_HEAD.format(names=names), *writer.loads.values(), *functions, foot))


def _cache_folder() -> Path:
    for base in (
        os.environ.get("VINETRACK_CACHE"),
        os.environ.get("XDG_CACHE_HOME"),
        "~/.cache",
        tempfile.gettempdir(),
    ):
        if not base:
            continue
        folder = Path(base).expanduser() / "vinetrack" / "kernels"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder):
                return folder
        except OSError:
            continue
    raise OSError("No writable folder was found for the compiled model; set VINETRACK_CACHE to one.")


_LOADED: dict[str, ModuleType] = {}  # Kernels of this process by their hash


@lru_cache(maxsize=64)
def kernel(effects: tuple[Effect, ...], tail_free: bool = False) -> ModuleType:
    """The compiled module for these effects; its `integrate_many` is described in `vinetrack.dynamics.integrator`."""
    import numba

    source = sum_source(effects, tail_free)
    integrator = (Path(__file__).with_name(name) for name in ("equations.py", "integrator.py"))
    parts = [source, *(file.read_text(encoding="utf-8") for file in integrator)]
    parts += [inspect.getsource(part) for part in (sys.modules[Effect.__module__], units)]
    parts += [numba.__version__, sys.version]
    # The compiled form refers to the modules of the effects by name, so the names are part of the hash.
    parts += [function.__module__ for effect in effects for function in effect.functions.values()]
    parts += [file.read_text(encoding="utf-8") for effect in effects for file in effect_sources(effect.path)]
    digest = hashlib.sha256("\0".join(parts).encode()).hexdigest()[:20]
    if digest in _LOADED:
        return _LOADED[digest]
    path = _cache_folder() / f"kernel_{digest}.py"
    if not path.is_file():
        handle, temporary = tempfile.mkstemp(dir=path.parent, suffix=".tmp")
        with os.fdopen(handle, "w", encoding="utf-8") as stream:
            stream.write(source)
        Path(temporary).replace(path)
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    module.__dict__["EFFECTS"] = effects
    sys.modules[path.stem] = module  # numba finds its cached form by the module's name
    spec.loader.exec_module(module)
    _LOADED[digest] = module
    return module


# ------------------------------------------------------------------------------
# Trials concatenated for the compiled kernel, and its calls.

RELATIVE_TOLERANCE = 1e-4  # Local tolerance on the speed

_NOTHING = State(*(math.nan,) * len(State._fields))

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
        # For fewer than 64 trials another thread costs more than it saves.
        threads = threads or max(1, min(available_cores(), count // 64))
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
    for effect, function, place in model.hooks["film_gain"]:
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
    for effect, function, place in model.hooks["true_time"]:
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
    for effect, function, place in model.hooks["trace_time"]:
        for i in np.flatnonzero(on[:, effect]).tolist():
            if (trace := in_time[i]) is None:
                continue
            state = _NOTHING._replace(time=trace[0])  # type: ignore[arg-type]
            in_time[i] = np.asarray(function(state, TrialInputs(*inputs[i]), *thetas[i, place]), dtype=float), trace[1]
    return in_time
