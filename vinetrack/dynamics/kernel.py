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
import os
import sys
import tempfile
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from types import ModuleType

from vinetrack.core import constants
from vinetrack.dynamics.integrator import BATCH
from vinetrack.effects import Effect, TrialInputs

# Files of the integrator, which are part of the compiled form of a model
PARTS = (
    *("equations.py", "radau.py", "slack_tail.py", "between_frames.py", "row_readout.py", "time_average.py"),
    "integrator.py",
)

_HEAD = '''"""Machine-made: the effects {names} summed, for the integrator of vinetrack.dynamics."""

from numba import njit

from vinetrack.dynamics.equations import (
    Equations, angle_passed, inlined, never_slack, no_free_fall, no_row_delay, no_slack_phase, no_tip_tension,
    not_averaged, not_slack_at_rest, trace_at, with_chamber, without_chamber,
)
from vinetrack.dynamics.integrator import integrate_trials
from vinetrack.dynamics.slack_tail import follow_slack, slack_at_rest, slack_fraction
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
_TAIL_FREE = ("tip_tension", "free_fall", "slack_fraction", "slack_at_rest", "follow_slack")
_TAIL_TAUT = ("no_tip_tension", "no_free_fall", "never_slack", "not_slack_at_rest", "no_slack_phase")
_AT_RELEASE = "x, v, y, ydot, time = 0.0, 0.0, 0.0, 0.0, 0.0"


class _Writer:
    """Writes the calls of hooks, in the order of the effects, and collects the functions to be loaded."""

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
        if self.has("chamber_rate"):
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
        """Everything that moves with the tail; see `force_terms.inertia_kg`."""
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
        acting = [f"on[{i}]" for i, effect in enumerate(self.effects) if "observed_position" in effect.functions]
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


def _modules(effect: Effect) -> list[str]:
    """Names of the modules that define the functions of an effect."""
    return sorted({function.__module__ for function in effect.functions.values()})


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
    if writer.has("row_delay"):
        delays = ["delay = 0.0", *writer.calls("row_delay", "delay += {call}"), "return delay"]
        functions += [writer.function("row_delay", "trial", _AT_RELEASE, delays)]
    if writer.has("averaged_over"):
        squares = ["square = 0.0", *writer.calls("averaged_over", "square += {call}"), "return square"]
        functions += [writer.function("averaged_over", "trial", _AT_RELEASE, squares)]
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
    fields = ["rates", "rest_acceleration", "observed", "first_chamber"]
    fields += ["with_chamber" if writer.has("chamber_rate") else "without_chamber"]
    fields += ["row_delay" if writer.has("row_delay") else "no_row_delay"]
    fields += ["averaged_over" if writer.has("averaged_over") else "not_averaged"]
    fields += _TAIL_FREE if tail_free else _TAIL_TAUT
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
    parts = [source, *(Path(__file__).with_name(name).read_text(encoding="utf-8") for name in PARTS)]
    parts += [inspect.getsource(part) for part in (sys.modules[Effect.__module__], constants)]
    parts += [numba.__version__, sys.version]
    # The compiled form refers to the modules of the effects by name, so the names are part of the hash.
    parts += [text for effect in effects for text in (effect.path.read_text(), *_modules(effect))]
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
