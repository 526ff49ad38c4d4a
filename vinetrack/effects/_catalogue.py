"""Reading effects from files: the catalogue in this folder, and a user's own effects from any path."""

from __future__ import annotations

import ast
import contextlib
import difflib
import hashlib
import inspect
import math
import os
import re
import sys
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import fields, replace
from functools import cache, lru_cache
from pathlib import Path
from types import MappingProxyType, ModuleType

from pydantic import TypeAdapter, ValidationError

from vinetrack.core.problems import UserError
from vinetrack.core.records import Bend, Trial
from vinetrack.core.tables import file_size, write_text
from vinetrack.core.units import BASE_EFFECTS, split_unit
from vinetrack.effects._base import HOOKS, REFERENCE_TRIAL, Effect, State, TrialInputs, Worked

# ------------------------------------------------------------------------------
# First run of a user's own effects: each is a program, so it is announced before it runs, and remembered by hash.

PACKAGE = Path(__file__).resolve().parents[1]  # Files below this folder are not announced
POLICY = "VINETRACK_OWN_EFFECTS"  # Environment variable: if `known`, own effects that never ran here are refused


def _mark_of(path: Path) -> Path:
    """The file, named by the hash of an own effect's text, that is there once this text has run."""
    state = os.environ.get("XDG_STATE_HOME") or Path("~/.local/state").expanduser()
    return Path(state, "vinetrack", "own_effects", hashlib.sha256(path.read_bytes()).hexdigest())


def remember(path: Path) -> None:
    """Remember an own effect as known, because it was announced or written by this program."""
    with contextlib.suppress(OSError):
        write_text(_mark_of(path), str(path.resolve()))


def announce(path: Path) -> None:
    """Announce an own effect that has not run before on standard error, and remember it."""
    path = path.resolve()
    if path.is_relative_to(PACKAGE) or os.access(mark := _mark_of(path), os.F_OK):
        return
    if os.environ.get(POLICY) == "known":
        remedy = "read it, then run it once without that"
        raise EffectError(f"{path}: has never run here (sha256 {mark.name}), and {POLICY} is `known`: {remedy}.")
    print(f"{path} (sha256 {mark.name}) runs for the first time: it is a program with your rights.", file=sys.stderr)
    remember(path)


class EffectError(UserError, ValueError):
    """A file that is not a valid effect, or a name that is not in the catalogue; the message gives the remedy."""


# What an effect may import. It is one file, so that the hash of its text stands for it wherever it lies.
_IMPORTED = "__future__ collections dataclasses functools itertools math numba numpy scipy typing vinetrack"


def _load_module(path: Path) -> ModuleType:
    """Execute one effect file and return it as a module. It is registered in `sys.modules`, where the compiled form of
    a model looks for it, under a name derived from its text.
    """
    # The text itself is executed: cached bytecode could be that of an older version saved within the same second.
    text = path.read_bytes()
    name = f"vinetrack_effect_{path.stem}_{hashlib.sha256(text).hexdigest()[:12]}"
    if name not in sys.modules:
        tree = ast.parse(text)
        imported = [alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names]
        imported += [node.module or "." for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
        if foreign := sorted({name.split(".")[0] for name in imported}.difference(_IMPORTED.split())):
            known = ", ".join(_IMPORTED.split()[1:])
            raise EffectError(f"{path}: imports {', '.join(foreign)}, but an effect may only import {known}.")
        module = ModuleType(name)
        exec(compile(text, str(path), "exec", dont_inherit=True), module.__dict__)
        sys.modules[name] = module
    return sys.modules[name]


def load_effect(path: Path | str) -> Effect:
    """Read one effect from its file, whose name it has; an EffectError says where the file does not follow the contract
    of `Effect`.
    """
    path = Path(path)
    try:
        file_size(path)
        announce(path)
        effect = _effect_of(_load_module(path), path)
        faults = list(_faults(effect))
    except EffectError:
        raise
    except FileNotFoundError:
        raise EffectError(f"{path}: there is no such effect file; `effects:` lists paths of Python files.") from None
    except OSError as error:
        raise EffectError(f"{path}: this effect cannot be read: {error.strerror}.") from None
    except ValidationError as error:
        faults = [f"{' '.join(map(str, one['loc']))}: {one['msg']}" for one in error.errors()]
    except Exception as error:
        raise EffectError(f"{path}: this effect cannot be read ({type(error).__name__}: {error}).") from error
    if faults:
        raise EffectError(f"{path}: " + "; ".join(faults) + ".")
    return effect


def _effect_of(module: ModuleType, path: Path) -> Effect:
    """The effect that a file defines: its names in capitals are fields of `Effect`, of which pydantic checks types."""
    # From the source, because from Python 3.13 on `__doc__` loses the indentation that marks the formula.
    text = (ast.get_docstring(ast.parse(path.read_text(encoding="utf-8")), clean=False) or "").strip()
    capitals = {field.name.upper(): field.name for field in fields(Effect)}
    given = {capitals[name]: value for name, value in vars(module).items() if name in capitals}
    breakpoints = of_rig = getattr(module, "breakpoints", None)
    if of_rig is not None and len(inspect.signature(of_rig).parameters) == 1:
        breakpoints = lambda rig, *_: of_rig(rig)  # noqa: E731
    given |= {
        "name": path.stem,
        "summary": text.partition("\n")[0].strip(),
        "text": text,
        "functions": {hook: getattr(module, hook) for hook in HOOKS if callable(getattr(module, hook, None))},
        "path": path.resolve(),
        "breakpoints": breakpoints,
    }
    return _adapter().validate_python(given)


_adapter = cache(lambda: TypeAdapter(Effect))  # made when first used: it takes a while


def _faults(effect: Effect) -> Iterable[str]:
    if not re.fullmatch(r"[a-z][a-z0-9_]*", effect.name):
        yield "the file's name is the effect's name and must be lower_case"
    if not effect.functions:
        yield f"defines none of the functions {', '.join(HOOKS)}"
    if not effect.text or not effect.formula:
        yield "the docstring must say what it is and show the formula on an indented line"
    known = {split_unit(field.name)[0] for field in fields(Trial)}
    if unknown := [column for column in effect.needs if split_unit(column)[0] not in known]:
        yield f"NEEDS {unknown[0]}, which is no column of a sheet"
    expected = ["s", "rig", *(parameter.name for parameter in effect.parameters)]
    for hook, function in effect.functions.items():
        given = list(inspect.signature(function).parameters)
        if given != expected:
            yield f"{hook}({', '.join(given)}) must be {hook}({', '.join(expected)})"
    for one in effect.parameters:
        if not (one.bounds[0] <= one.default <= one.bounds[1] or one.default == one.zero):
            yield f"the default of {one.name} lies outside its bounds"


@lru_cache(maxsize=1)
def catalogue() -> Mapping[str, Effect]:
    """Return every effect of vinetrack by name: base effects first, then alphabetical."""
    paths = {path.stem: path for path in Path(__file__).parent.glob("*.py") if not path.stem.startswith("_")}
    names = [*BASE_EFFECTS, *sorted(set(paths) - set(BASE_EFFECTS))]
    return MappingProxyType({name: load_effect(paths[name]) for name in names})


def find_effect(name: str, user_effects: Mapping[str, Effect] | None = None) -> Effect:
    """Return the effect of this name, from the user's own effects or else from the catalogue; an EffectError suggests
    the nearest name.
    """
    known = {**catalogue(), **(user_effects or {})}
    if name in known:
        return known[name]
    near = difflib.get_close_matches(name, known, n=1)
    hint = f" Did you mean {near[0]!r}?" if near else " `vinetrack effects` lists them all."
    if name == "tail_slack":
        hint = " It is a rule of the model: `tail_slack: free` in experiment.yaml."
    raise EffectError(f"There is no effect named {name!r}.{hint}")


# ------------------------------------------------------------------------------
# A user's own effects: read, and checked before a model uses them.

# A vine in motion, in which every effect can act
_STATE = State(
    time=0.05, lead_position=0.1, lead_velocity=1.5, tail_position=0.2, tail_velocity=3.0, set_pressure=28e3,
    pressure=27e3, yield_pressure=3e3, area=4.5e-4, linear_density=0.018, moving_mass=0.039, damping_gain=1.1,
    bend_angle=0.5, tail_tension=2.0, observed=0.101, pressure_slope=-5e3,
)  # fmt: skip
_RIG = TrialInputs.of(replace(REFERENCE_TRIAL, bends=(Bend(0.1, 0.1, 0.1),)))


def own_effects(paths: Iterable[Path | str]) -> Mapping[str, Effect]:
    """Read and check a user's effects; returns them by name. An EffectError says in one sentence where a file is not an
    effect, two have the same name, or one fails its checks.
    """
    effects: dict[str, Effect] = {}
    for path in map(Path, paths):
        effect = load_effect(path)
        if effect.name in effects:
            raise EffectError(f"{path}: there is another effect named {effect.name!r}, {effects[effect.name].path}.")
        for fault in behaviour_faults(effect):
            raise EffectError(f"{path}: {fault}.")
        effects[effect.name] = effect
    return effects


def behaviour_faults(effect: Effect) -> Iterator[str]:
    """Check an effect against its file: that it runs, its worked numbers, and that it vanishes at `zero`. Functions are
    evaluated in motion, where every effect can act.
    """
    if fault := _fault_in_motion(effect, effect.path.read_bytes()):
        yield fault
    zero = {parameter.name: parameter.zero for parameter in effect.parameters}
    at = ", ".join(f"{name} = {value:g}" for name, value in zero.items())
    how = f"at {at} nothing should change; give what shapes the effect a `zero=` that can be evaluated"
    for worked in effect.worked:
        yield from _worked_faults(effect, worked)
    for hook in effect.functions if zero else ():
        unchanged = getattr(_STATE, field) if isinstance(field := HOOKS[hook], str) else field
        at_zero = Worked(hook, unchanged, how, _STATE._asdict(), _RIG._asdict(), zero, rel=1e-9)
        yield from _worked_faults(effect, at_zero)


def _worked_faults(effect: Effect, worked: Worked) -> Iterator[str]:
    """Evaluate the effect at the state, rig and parameters of a worked number; fields that it does not give are NaN."""
    try:
        state = State(*(math.nan,) * len(State._fields))._replace(**worked.state)
        rig = TrialInputs(*(math.nan,) * len(TrialInputs._fields))._replace(**worked.rig)
        values = {parameter.name: parameter.default for parameter in effect.parameters}
        value = float(effect.functions[worked.hook](state, rig, *(values | dict(worked.parameters)).values()))
    except (KeyError, TypeError, ValueError, ArithmeticError) as error:
        yield f"{worked.hook} cannot be tried ({error}): {worked.how}"
        return
    if not math.isclose(value, worked.expected, rel_tol=worked.rel, abs_tol=1e-12):
        yield f"{worked.hook} gives {value:.6g} where it should be {worked.expected:.6g} ({worked.how})"


@lru_cache(maxsize=1024)
def _fault_in_motion(effect: Effect, _text: bytes) -> str:
    """Run the functions of an effect, then compiled like the kernel, without the runtime that allocates arrays; once
    for each text of its file. What fails, and why; Python, unlike numba, names a field that there is not.
    """
    from numba import njit
    from numba.core.errors import NumbaError

    values, hook = [parameter.default for parameter in effect.parameters], "breakpoints"
    try:
        if effect.breakpoints is not None:
            list(map(float, effect.breakpoints(_RIG, *values)))
        for hook, function in effect.functions.items():  # noqa: B007
            function(_STATE, _RIG, *values)
            njit(_nrt=False)(function)(_STATE, _RIG, *values)  # type: ignore[call-overload]
    except NumbaError:
        return f"{hook} cannot be compiled: it may use numbers, functions of math and numpy, and fields of s and rig"
    except Exception as error:
        return f"{hook} fails in motion ({type(error).__name__}: {error})"
    return ""
