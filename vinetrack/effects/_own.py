"""A user's own effects: read, and checked before a model uses them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

from vinetrack.effects._base import HOOKS, Effect, State, TrialInputs, Worked
from vinetrack.effects._catalogue import EffectError, load_effect

# A vine in motion, in which every effect can act
_STATE = State(
    time=0.05, lead_position=0.1, lead_velocity=1.5, tail_position=0.2, tail_velocity=3.0, set_pressure=28e3,
    pressure=27e3, yield_pressure=3e3, area=4.5e-4, linear_density=0.018, moving_mass=0.039, damping_gain=1.1,
    bend_angle=0.5, tail_tension=2.0, observed=0.101,
)  # fmt: skip
_RIG = TrialInputs(
    set_pressure=28e3, yield_pressure=3e3, diameter=24e-3, thickness=200e-6, length=0.28, area=4.5e-4,
    linear_density=0.018, mass_loss=0.009, payload_mass=0.0356, cos_angle=1.0, travel_ratio=2.0,
    ambient_pressure=101_325.0, chamber_volume=3.7e-3, inlet_area=2.8e-5, least_mass=6e-5, has_bends=1.0,
    tail_on_reel=0.0, bend_count=1.0, bend_total=1.0, as_printed=0.0, tail_free=0.0,
)  # fmt: skip


def own_effects(paths: Iterable[Path | str]) -> Mapping[str, Effect]:
    """Read and check a user's effects; returns them by name. An EffectError says in one sentence where a file is not an
    effect, two have the same name, or one fails its checks.

    Examples
    --------
    >>> import vinetrack as vt
    >>> dict(vt.effects.own_effects([]))
    {}
    """
    effects: dict[str, Effect] = {}
    for path in map(Path, paths):
        effect = load_effect(path)
        if effect.name in effects:
            raise EffectError(f"{path}: there is another effect named {effect.name!r}, {effects[effect.name].path}.")
        fault = next(behaviour_faults(effect), None)
        if fault is not None:
            raise EffectError(f"{path}: {fault}.")
        effects[effect.name] = effect
    return effects


def behaviour_faults(effect: Effect) -> Iterator[str]:
    """Check an effect against its file: compilation, worked numbers, and that it vanishes at `zero`. Functions are
    evaluated in motion, where every effect can act.
    """
    for hook in effect.functions:
        yield from _compile_faults(effect, hook, effect.path.read_bytes())
    for worked in effect.worked:
        yield from _worked_faults(effect, worked)
    if effect.parameters:
        for hook, function in effect.functions.items():
            value = float(function(_STATE, _RIG, *effect.zero))
            unchanged = getattr(_STATE, field) if isinstance(field := HOOKS[hook], str) else field
            if not math.isclose(value, unchanged, rel_tol=1e-9, abs_tol=1e-12):
                zero = ", ".join(f"{p.name} = {p.zero:g}" for p in effect.parameters)
                yield f"{hook} gives {value:.6g} at {zero}, where nothing should change ({unchanged:g})"


def _worked_faults(effect: Effect, worked: Worked) -> Iterator[str]:
    """Evaluate the effect at the state, rig and parameters of a worked number; fields that it does not give are NaN."""
    try:
        state = State(*(math.nan,) * len(State._fields))._replace(**worked.state)
        rig = TrialInputs(*(math.nan,) * len(TrialInputs._fields))._replace(**worked.rig)
        values = {parameter.name: parameter.default for parameter in effect.parameters}
        if unknown := set(worked.parameters) - set(values):
            raise ValueError(f"there is no parameter {', '.join(sorted(unknown))}")
        value = float(effect.functions[worked.hook](state, rig, *(values | dict(worked.parameters)).values()))
    except (KeyError, ValueError) as error:
        yield f"a worked number of {worked.hook} cannot be tried ({error})"
        return
    if not math.isclose(value, worked.expected, rel_tol=worked.rel, abs_tol=1e-12):
        yield f"{worked.hook} gives {value:.6g} where worked out by hand it is {worked.expected:.6g} ({worked.how})"


@lru_cache(maxsize=1024)
def _compile_faults(effect: Effect, hook: str, _text: bytes) -> tuple[str, ...]:
    """Compile a function like the kernel, without the runtime that allocates arrays; once for each text of its file."""
    from numba import njit
    from numba.core.errors import NumbaError

    flags: dict[str, Any] = {"_nrt": False}
    try:
        compiled = njit(**flags)(effect.functions[hook])
        compiled(_STATE, _RIG, *(parameter.default for parameter in effect.parameters))
    except NumbaError:
        return (f"{hook} cannot be compiled: it may use numbers, math and numpy functions only",)
    except Exception as error:
        return (f"{hook} fails in motion ({type(error).__name__}: {error})",)
    return ()
