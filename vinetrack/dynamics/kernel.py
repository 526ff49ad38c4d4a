"""The sum of effects as one compiled function.

The effects of a model are plain Python functions in separate files. Here a small module is written out that calls
them in the order of the physics, sets the integrator behind them, and is compiled once; the compiled form is kept in
the user's cache under a name made of everything it depends on, so that it is found again by the next process.
"""

from __future__ import annotations

import hashlib
import importlib.util
import inspect
import itertools
import os
import sys
import tempfile
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from types import ModuleType

from vinetrack.core import constants
from vinetrack.effects import Effect, TrialInputs
from vinetrack.effects import _base as effects_base
from vinetrack.effects._catalogue import load_module

TEXTS = tuple(
    Path(__file__).with_name(name) for name in ("radau.py", "breakpoints.py", "slack_tail.py", "integrator.py")
)
"""What is set behind the rates, in this order; `slack` only where a tail may go slack."""

MARK = "# ---- what follows is set behind the rates of one model ----\n"

_HEAD = '''"""Machine-made: the effects {names} summed, and the integrator behind them."""

from pathlib import Path

import numpy as np
from numba import njit

from vinetrack.effects._base import State, TrialInputs
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
_INDICES = {"FREE": "tail_free", "RATIO": "travel_ratio"}
_COMMON = "on, rig_row, theta, trace_time, trace_pressure, bends"
_MOTION = f"time, x, v, chamber, {_COMMON}"
_MOVING = """x, v = max(x, 0.0), max(v, 0.0)
    y, ydot = x / rig.travel_ratio, v / rig.travel_ratio"""
_AT_REST = "v, ydot = 0.0, 0.0\n    x = max(x, 0.0)\n    y = x / rig.travel_ratio"
_AT_RELEASE = "x, v, y, ydot, time = 0.0, 0.0, 0.0, 0.0, 0.0"


class _Writer:
    """Writes the calls of hooks, in the order of the effects, and remembers which functions must be loaded."""

    def __init__(self, effects: Sequence[Effect]) -> None:
        self.effects = effects
        self.loads: dict[str, str] = {}

    def has(self, hook: str) -> bool:
        return any(hook in effect.functions for effect in self.effects)

    def calls(self, hook: str, target: str, state: str = _STATE) -> list[str]:
        lines = []
        offsets = list(itertools.accumulate((len(effect.parameters) for effect in self.effects), initial=0))
        for i, effect in sorted(enumerate(self.effects), key=lambda pair: pair[1].order):
            if hook not in effect.functions:
                continue
            arguments = "".join(f", theta[{offsets[i] + j}]" for j in range(len(effect.parameters)))
            name = f"{effect.name}__{hook}"
            self.loads[name] = f"{name} = njit(nogil=True)(load_module(Path({str(effect.path)!r})).{hook})"
            # A measured trace already holds what happens in the chamber.
            condition = f"on[{i}] and not measured" if effect.in_trace else f"on[{i}]"
            lines += [f"if {condition}:", f"    {target.format(call=f'{name}({state}, rig{arguments})')}"]
        return lines

    def pressure(self) -> list[str]:
        """Gauge → what the chamber does → area and losses; where the area yields to pressure, until both agree."""
        gauge = self.calls("gauge", "pressure = {call}")
        lines = [*gauge, "set_pressure = pressure"]
        lines += ["if measured:", "    pressure = trace_at(time, trace_time, trace_pressure)"]
        lines += [f"    {line}" for line in gauge]
        if self.has("chamber_rate"):
            lines += ["else:", "    pressure = chamber"]
        lines += self.calls("yield_gauge", "yield_pressure = {call}")
        once = self.calls("pressure", "pressure = {call}")
        stretch = self.calls("area", "area = {call}")
        if not stretch:
            return lines + once
        # An area that no effect changes agrees at once; each turn gains a digit or two on the strongest stretch.
        lines += ["start = pressure", "for turn in range(30):", "    area_before, area = area, rig.area"]
        lines += [f"    {line}" for line in stretch]
        lines += ["    if turn > 0 and abs(area - area_before) <= 1e-10 * area:", "        break"]
        return lines + [f"    {line}" for line in ["pressure = start", *once]]

    def mass(self) -> list[str]:
        lines = [*self.calls("film_gain", "film *= {call}"), "density = rig.linear_density * film"]
        lost = "rig.mass_loss * film * rig.travel_ratio * y"
        lines += [f"film_mass = density * rig.length - {lost}"]
        lines += ["mass = max(film_mass, rig.least_mass) + rig.payload_mass"]
        return lines

    def inertia(self) -> list[str]:
        """All that moves with the tail; what effects add counts in the floor that the mass comes to."""
        added = self.calls("added_mass", "added += {call}")
        total = "mass = max(film_mass + added, rig.least_mass) + rig.payload_mass"
        return ["added = 0.0", *added, total] if added else []

    def forces(self) -> list[str]:
        lines = self.calls("damping_gain", "gain = {call}")
        lines += self.calls("tip_force", "tip += {call}")
        return lines + self.calls("tail_force", "tail += {call}")

    def unseen(self) -> list[str]:
        """Where no effect changes what the camera reports, nothing has to be worked out for it."""
        acting = [f"on[{i}]" for i, effect in enumerate(self.effects) if "observed_position" in effect.functions]
        return [f"if not ({' or '.join(acting)}):", "    return seen"]

    def function(self, name: str, arguments: str, motion: str, lines: Sequence[str]) -> str:
        at_release = motion == _AT_RELEASE
        return _SUM.format(
            name=name,
            arguments=arguments,
            motion=motion,
            rig_fields=", ".join(f"rig_row[{i}]" for i in range(len(TrialInputs._fields))),
            angle="0.0" if at_release else "angle_passed(y, bends)",
            measured="False" if at_release else "trace_time.size > 0",
            body="\n".join(f"    {line}" for line in lines),
        )


def sum_source(effects: Sequence[Effect], tail_free: bool = False) -> str:
    """Python text of the functions that `vinetrack.dynamics.integrator` calls, for this sum of effects.

    Mass that effects add moves like the tail but has no weight of its own: it is counted after the forces.
    """
    write = _Writer(effects)
    both = [*write.mass(), *write.pressure(), *write.forces()]
    added = write.inertia()
    seen = write.calls("observed_position", "seen = {call}")
    rest = write.calls("rest_force", "tip += {call}")
    # The chamber knows its own pressure, not what is left of it at the tip.
    filling = write.calls("chamber_rate", "chamber_rate += {call}", _STATE.replace(" pressure,", " chamber,"))
    per_mass = "return (tip / rig.travel_ratio + tail) / mass"
    tension = "max(tip, 0.0) / rig.travel_ratio"
    pushed = ["if rig.tail_free > 0:", "    tip = max(tip, 0.0)"] if tail_free else []
    looked = [*write.unseen(), *both, f"tension = {tension}", *seen]
    functions = [
        write.function("rates", _MOTION, _MOVING, [*both, *filling, *added, f"{per_mass}, chamber_rate"]),
        write.function(
            "rest_acceleration", _MOTION.replace("v, ", ""), _AT_REST, [*both, *rest, *pushed, *added, per_mass]
        ),
        write.function("observed", _MOTION, _MOVING, [*(looked if seen else []), "return seen"]),
        write.function(
            "first_chamber",
            "on, rig_row, theta",
            _AT_RELEASE,
            [*write.calls("gauge", "pressure = {call}"), "return pressure"],
        ),
    ]
    if tail_free:
        resting = ["if resting:", *[f"    {line}" for line in rest or ["pass"]]]
        functions += [
            write.function(
                "tip_tension",
                _MOTION.replace("chamber,", "chamber, resting,"),
                _MOVING,
                [*both, *resting, *filling, "return tip / rig.travel_ratio, chamber_rate"],
            ),
            write.function("free_fall", _MOTION.replace("x, v,", "y, ydot, x, v,"), "", [*both, "return tail / mass"]),
        ]
    names = ", ".join(effect.name for effect in effects)
    constants = [f"HAS_CHAMBER, TAIL_FREE = {write.has('chamber_rate')}, {tail_free}"]
    constants += [f"{name} = {TrialInputs._fields.index(field)}" for name, field in _INDICES.items()]
    return "".join(
        f"{part}\n"
        for part in (_HEAD.format(names=names), *write.loads.values(), _TABLES, *functions, *constants, "", "")
    )


def _module_source(effects: Sequence[Effect], tail_free: bool) -> str:
    text = sum_source(effects, tail_free)
    for path in TEXTS:
        if tail_free or path.stem != "slack_tail":
            text += path.read_text(encoding="utf-8").split(MARK)[1]
    # Only the outermost function is called from Python; what it calls is compiled into it. Nothing but a slack tail
    # makes an array: not to count references to those passed along, nor to look for division by zero, is three times
    # as fast.
    text = text.replace("@njit(nogil=True)\ndef integrate_many", "@njit(nogil=True, cache=True)\ndef integrate_many")
    counting = "" if tail_free else ", _nrt=False"
    return text.replace("njit(nogil=True", f"njit(nogil=True, error_model='numpy'{counting}")


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
def kernel(effects: tuple[Effect, ...], tail_free: bool = False) -> ModuleType:
    """The compiled module for these effects; its `integrate_many` is described in `vinetrack.dynamics.integrator`.

    Only one for tails that may go slack holds `vinetrack.dynamics.slack_tail`: it takes longer to compile.
    """
    import numba

    source = _module_source(effects, tail_free)
    parts = [source, *(inspect.getsource(part) for part in (effects_base, load_module, constants))]
    parts += [numba.__version__, sys.version]
    parts += [effect.path.read_text() for effect in effects]
    digest = hashlib.sha256("\0".join(parts).encode()).hexdigest()[:20]
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
    sys.modules[path.stem] = module  # numba finds its cached form by the module's name
    spec.loader.exec_module(module)
    return module
