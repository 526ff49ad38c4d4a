"""The sum of effects as one compiled function.

The effects of a model are plain Python functions in separate files. Here a small module is written out that calls
them in the order of the physics, sets the integrator behind them, and is compiled once; the compiled form is kept in
the user's cache under a name made of everything it depends on, so that it is found again by the next process.
"""

from __future__ import annotations

import hashlib
import importlib.util
import inspect
import os
import sys
import tempfile
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from types import ModuleType

from vinetrack.effects import Effect, Rig
from vinetrack.effects import _base as effects_base
from vinetrack.effects._catalogue import load_module

INTEGRATOR = Path(__file__).with_name("integrator.py")
MARK = "# ---- what follows is set behind the rates of one model ----\n"

_HEAD = '''"""Machine-made: the effects {names} summed, and the integrator behind them."""

from pathlib import Path

import numpy as np
from numba import njit

from vinetrack.effects._base import Rig, State
from vinetrack.effects._catalogue import load_module

'''

_TABLES = '''

@njit(nogil=True)
def trace_at(time, trace_time, trace_pressure):
    """The measured pressure, linear between its samples, constant beyond them."""
    last = trace_time.size - 1
    if time <= trace_time[0]:
        return trace_pressure[0]
    if time >= trace_time[last]:
        return trace_pressure[last]
    k = np.searchsorted(trace_time, time)
    part = (time - trace_time[k - 1]) / (trace_time[k] - trace_time[k - 1])
    return trace_pressure[k - 1] + part * (trace_pressure[k] - trace_pressure[k - 1])


@njit(nogil=True)
def angle_passed(y, bends):
    """Angle of the bends (rows: start, arc, radius) that the tip has passed at y."""
    angle = 0.0
    for k in range(bends.shape[0]):
        angle += min(max(y - bends[k, 0], 0.0), bends[k, 1]) / bends[k, 2]
    return angle

'''

_SUM = """
@njit(nogil=True)
def {name}({arguments}):
    rig = Rig({rig_fields})
    film = 1.0
    x, v = max(x, 0.0), max(v, 0.0)
    y, ydot = x / rig.travel_ratio, v / rig.travel_ratio
    yield_pressure = rig.yield_pressure
    area, gain, bend_angle, tension, seen = rig.area, 1.0, angle_passed(y, bends), 0.0, y
    mass, density = 0.0, rig.linear_density
    measured = trace_time.size > 0
    chamber_rate, set_pressure, pressure = 0.0, rig.set_pressure, rig.set_pressure
    tip, tail = 0.0, 0.0
{body}
"""

_STATE = (
    "State(time, y, ydot, x, v, set_pressure, pressure, yield_pressure, area, density, mass, gain, bend_angle, "
    "tension, seen)"
)
_COMMON = "on, rig_row, theta, trace_time, trace_pressure, bends"
_MOTION = f"time, x, v, chamber, {_COMMON}"


class _Writer:
    """Writes the calls of hooks, in the order of the effects, and remembers which functions must be loaded."""

    def __init__(self, effects: Sequence[Effect]) -> None:
        self.effects = effects
        self.loads: dict[str, str] = {}

    def has(self, hook: str) -> bool:
        return any(hook in effect.functions for effect in self.effects)

    def calls(self, hook: str, target: str) -> list[str]:
        lines, offset = [], 0
        for i, effect in enumerate(self.effects):
            arguments = "".join(f", theta[{offset + j}]" for j in range(len(effect.parameters)))
            offset += len(effect.parameters)
            if hook not in effect.functions:
                continue
            name = f"{effect.name}__{hook}"
            self.loads[name] = f"{name} = njit(nogil=True)(load_module(Path({str(effect.path)!r})).{hook})"
            # A measured trace already holds what happens in the chamber.
            condition = f"on[{i}] and not measured" if effect.in_trace else f"on[{i}]"
            lines += [f"if {condition}:", f"    {target.format(call=f'{name}({_STATE}, rig{arguments})')}"]
        return lines

    def pressure(self) -> list[str]:
        """Gauge → what the chamber does → area and losses; where the area yields to pressure, twice."""
        lines = [*self.calls("gauge", "set_pressure = {call}"), "pressure = set_pressure"]
        lines += ["if measured:", "    pressure = trace_at(time, trace_time, trace_pressure)"]
        lines += [f"    {line}" for line in self.calls("gauge", "pressure = {call}")]
        if self.has("chamber_rate"):
            lines += ["else:", "    pressure = chamber"]
        lines += self.calls("yield_gauge", "yield_pressure = {call}")
        once = self.calls("pressure", "pressure = {call}")
        stretch = self.calls("area", "area = {call}")
        if not stretch:
            return lines + once
        lines += ["start = pressure", "for _ in range(2):", "    area = rig.area"]
        lines += [f"    {line}" for line in [*stretch, "pressure = start", *once]]
        return [*lines, "area = rig.area", *stretch]

    def mass(self) -> list[str]:
        lines = [*self.calls("film_gain", "film = {call}"), "density = rig.linear_density * film"]
        lines += ["mass = max(density * rig.length - rig.mass_loss * film * x, rig.least_mass) + rig.payload_mass"]
        return lines

    def forces(self) -> list[str]:
        lines = self.calls("damping_gain", "gain = {call}")
        lines += self.calls("tip_force", "tip += {call}")
        return lines + self.calls("tail_force", "tail += {call}")

    def function(self, name: str, arguments: str, lines: Sequence[str]) -> str:
        rig_fields = ", ".join(f"rig_row[{i}]" for i in range(len(Rig._fields)))
        body = "\n".join(f"    {line}" for line in lines)
        return _SUM.format(name=name, arguments=arguments, rig_fields=rig_fields, body=body)


def sum_source(effects: Sequence[Effect]) -> str:
    """Python text of the functions that `vinetrack.model.integrator` calls, for this sum of effects.

    Mass that effects add moves like the tail but has no weight of its own: it is counted after the forces.
    """
    write = _Writer(effects)
    both = [*write.mass(), *write.pressure(), *write.forces()]
    added = write.calls("added_mass", "mass += {call}")
    seen = write.calls("observed_position", "seen = {call}")
    functions = [
        write.function(
            "rates",
            _MOTION,
            [
                *both,
                *(write.calls("chamber_rate", "chamber_rate = {call}") if write.has("chamber_rate") else []),
                *added,
                "return (tip / rig.travel_ratio + tail) / mass, chamber_rate",
            ],
        ),
        write.function(
            "rest_acceleration",
            _MOTION.replace("v, ", ""),
            ["v, ydot = 0.0, 0.0", *both, *write.calls("rest_force", "tip += {call}"), *added]
            + ["return (tip / rig.travel_ratio + tail) / mass"],
        ).replace("x, v = max(x, 0.0), max(v, 0.0)", "x, v = max(x, 0.0), 0.0"),
        write.function(
            "observed",
            _MOTION,
            [*both, "tension = max(tip, 0.0) / rig.travel_ratio", *seen, "return seen"] if seen else ["return seen"],
        ),
        write.function(
            "first_chamber",
            "on, rig_row, theta",
            [*write.calls("gauge", "set_pressure = {call}"), "return set_pressure"],
        )
        .replace("angle_passed(y, bends)", "0.0")
        .replace("trace_time.size > 0", "False")
        .replace("x, v = max(x, 0.0), max(v, 0.0)", "x, v, time = 0.0, 0.0, 0.0"),
    ]
    names = ", ".join(effect.name for effect in effects)
    return _HEAD.format(names=names) + "\n".join(write.loads.values()) + _TABLES + "\n".join(functions) + "\n\n"


def _module_source(effects: Sequence[Effect]) -> str:
    integrator = INTEGRATOR.read_text(encoding="utf-8").split(MARK)[1]
    text = sum_source(effects) + integrator
    # Only the outermost function is called from Python; what it calls is compiled into it.
    return text.replace("@njit(nogil=True)\ndef integrate_many", "@njit(nogil=True, cache=True)\ndef integrate_many")


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
    raise OSError("No folder can be written to keep the compiled model; set VINETRACK_CACHE to one.")


@lru_cache(maxsize=64)
def kernel(effects: tuple[Effect, ...]) -> ModuleType:
    """The compiled module for these effects; its `integrate_many` is described in `vinetrack.model.integrator`."""
    import numba

    source = _module_source(effects)
    parts = [source, inspect.getsource(effects_base), inspect.getsource(load_module), numba.__version__, sys.version]
    parts += [effect.path.read_text() for effect in effects]
    digest = hashlib.sha256("\0".join(parts).encode()).hexdigest()[:20]
    path = _cache_folder() / f"kernel_{digest}.py"
    if not path.is_file():
        handle, temporary = tempfile.mkstemp(dir=path.parent, suffix=".tmp")
        with os.fdopen(handle, "w", encoding="utf-8") as stream:
            stream.write(source)
        Path(temporary).replace(path)
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module  # numba finds its cached form by the module's name
    spec.loader.exec_module(module)
    return module
