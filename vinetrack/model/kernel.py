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

_RATES = '''

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
def rates(time, x, v, chamber, on, rig_row, theta, trace_time, trace_pressure):
    rig = Rig({rig_fields})
    mass = max(rig.linear_density * rig.length - rig.mass_loss * x, rig.least_mass) + rig.payload_mass
    y = x / rig.travel_ratio
    forward = max(v, 0.0)
    ydot = forward / rig.travel_ratio
    area = rig.area
    gain = 1.0
    pressure = chamber
    measured = trace_time.size > 0
    if measured:
        pressure = trace_at(time, trace_time, trace_pressure)
{body}
    return (tip / rig.travel_ratio + tail) / mass, 0.0

'''

_STATE = "State(time, y, ydot, x, forward, pressure, area, mass, gain)"
_TARGETS = {
    "pressure": "pressure = {call}",
    "damping_gain": "gain = {call}",
    "added_mass": "mass += {call}",
    "tip_force": "tip += {call}",
    "tail_force": "tail += {call}",
}


def rates_source(effects: Sequence[Effect]) -> str:
    """Python text of the function `rates` for this sum of effects; see `vinetrack.model.integrator`."""
    loads, body = [], []
    for hook, target in _TARGETS.items():
        if hook == "tip_force":
            body.append("    tip = 0.0")
            body.append("    tail = 0.0")
        offset = 0
        for i, effect in enumerate(effects):
            arguments = "".join(f", theta[{offset + j}]" for j in range(len(effect.parameters)))
            offset += len(effect.parameters)
            if hook not in effect.functions:
                continue
            name = f"{effect.name}__{hook}"
            loads.append(f"{name} = njit(nogil=True)(load_module(Path({str(effect.path)!r})).{hook})")
            # A measured trace already holds what happens in the chamber.
            condition = f"on[{i}] and not measured" if hook == "pressure" and effect.in_trace else f"on[{i}]"
            body.append(f"    if {condition}:")
            body.append("        " + target.format(call=f"{name}({_STATE}, rig{arguments})"))
    rig_fields = ", ".join(f"rig_row[{i}]" for i in range(len(Rig._fields)))
    names = ", ".join(effect.name for effect in effects)
    return _HEAD.format(names=names) + "\n".join(loads) + _RATES.format(rig_fields=rig_fields, body="\n".join(body))


def _module_source(effects: Sequence[Effect]) -> str:
    integrator = INTEGRATOR.read_text(encoding="utf-8").split(MARK)[1]
    text = rates_source(effects) + integrator
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
