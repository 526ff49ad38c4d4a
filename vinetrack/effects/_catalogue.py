"""Effects are read from files: those beside this one are the catalogue, a user's own lie wherever they say."""

from __future__ import annotations

import difflib
import hashlib
import importlib.util
import inspect
import re
import sys
from collections.abc import Iterable, Mapping
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType, ModuleType

from vinetrack.core.problems import UserError
from vinetrack.effects._base import HOOKS, KINDS, Effect, Parameter, Worked

BASE_EFFECTS = ("pressure_drive", "gravity", "eversion_damping", "yield_pressure")
"""The four effects that make the equation of motion of the paper, Eq. (2)."""


class EffectError(UserError, ValueError):
    """A file that should be an effect is not one, or a name is not in the catalogue; the message says what to mend."""


def _load_module(path: Path) -> ModuleType:
    """Run one effect file and return it as a module.

    It is entered in `sys.modules` under a name made of its path and text: the compiled form of a model looks there.

    Raises
    ------
    EffectError
        If the file is missing or cannot be run.
    """
    if not path.is_file():
        raise EffectError(f"{path}: there is no such effect file; `effects:` lists paths of Python files.")
    digest = hashlib.sha256(str(path.resolve()).encode() + path.read_bytes()).hexdigest()[:12]
    name = f"vinetrack_effect_{path.stem}_{digest}"
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise EffectError(f"{path}: an effect is a Python file whose name ends in .py.")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        del sys.modules[name]
        raise EffectError(f"{path}: this effect cannot be read ({type(error).__name__}: {error}).") from error
    return module


def load_effect(path: Path | str) -> Effect:
    """Read one effect from its file; its name is the file's.

    Parameters
    ----------
    path : a Python file like those of the catalogue.

    Returns
    -------
    the effect.

    Raises
    ------
    EffectError
        If the file does not follow the contract of `Effect`; the message names what is missing.
    """
    path = Path(path)
    module = _load_module(path)
    text = (module.__doc__ or "").strip()  # not `getdoc`: where only the formula follows, it would lose its indent
    functions = {hook: getattr(module, hook) for hook in HOOKS if callable(getattr(module, hook, None))}
    effect = Effect(
        name=path.stem,
        kind=getattr(module, "KIND", "physical"),
        summary=text.splitlines()[0].strip() if text else "",
        text=text,
        parameters=tuple(getattr(module, "PARAMETERS", ())),
        functions=MappingProxyType(functions),
        needs=tuple(getattr(module, "NEEDS", ())),
        easily_taken_for=tuple(getattr(module, "EASILY_TAKEN_FOR", ())),
        worked=tuple(getattr(module, "WORKED", ())),
        path=path.resolve(),
        in_trace=bool(getattr(module, "IN_TRACE", False)),
        replaces=tuple(getattr(module, "REPLACES", ())),
        order=int(getattr(module, "ORDER", 3)),
        finite=bool(getattr(module, "FINITE", False)),
        corners=getattr(module, "corners", None),
    )
    faults = list(_faults(effect))
    if faults:
        raise EffectError(f"{path}: " + "; ".join(faults) + ".")
    return effect


def _faults(effect: Effect) -> Iterable[str]:
    if not re.fullmatch(r"[a-z][a-z0-9_]*", effect.name):
        yield "the file's name is the effect's name and must be lower_case"
    if effect.kind not in KINDS:
        yield f"KIND is {effect.kind!r}, must be one of {', '.join(KINDS)}"
    if not effect.functions:
        yield f"defines none of the functions {', '.join(HOOKS)}"
    if not effect.text or not effect.formula:
        yield "the docstring must say what it is and show the formula on an indented line"
    if not all(isinstance(parameter, Parameter) for parameter in effect.parameters):
        yield "PARAMETERS must hold Parameter(...) entries"
        return
    if not all(isinstance(worked, Worked) for worked in effect.worked):
        yield "WORKED must hold Worked(...) entries"
    expected = ["s", "rig", *(parameter.name for parameter in effect.parameters)]
    for hook, function in effect.functions.items():
        given = list(inspect.signature(function).parameters)
        if given != expected:
            yield f"{hook}({', '.join(given)}) must be {hook}({', '.join(expected)})"
    for parameter in effect.parameters:
        low, high = parameter.bounds
        if not (low <= parameter.default <= high or parameter.default == parameter.zero):
            yield f"the default of {parameter.name} lies outside its bounds"


@lru_cache(maxsize=1)
def catalogue() -> Mapping[str, Effect]:
    """Every effect that comes with vinetrack, by name: base effects first, then alphabetical."""
    paths = {path.stem: path for path in Path(__file__).parent.glob("*.py") if not path.stem.startswith("_")}
    names = [*BASE_EFFECTS, *sorted(set(paths) - set(BASE_EFFECTS))]
    return MappingProxyType({name: load_effect(paths[name]) for name in names})


def find_effect(name: str, user_effects: Mapping[str, Effect] | None = None) -> Effect:
    """Return the effect of a name, from the user's own first, then from the catalogue.

    Parameters
    ----------
    name : of an effect.
    user_effects : effects by name, from `own_effects`.

    Returns
    -------
    the effect.

    Raises
    ------
    EffectError
        If there is none; the message suggests the nearest name.
    """
    known = {**catalogue(), **(user_effects or {})}
    if name in known:
        return known[name]
    near = difflib.get_close_matches(name, known, n=1)
    hint = f" Did you mean {near[0]!r}?" if near else f" Known are {', '.join(known)}."
    raise EffectError(f"There is no effect named {name!r}.{hint}")
