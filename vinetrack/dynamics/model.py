"""A model is a sum of effects with values for their parameters."""

from __future__ import annotations

import itertools
import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.process import Printed
from vinetrack.core.records import Floats, Trial
from vinetrack.core.units import GAS_CONSTANT_AIR_J_KG_K, TEMPERATURE_K
from vinetrack.effects import BASE_EFFECTS, Effect, EffectError, TrialInputs, catalogue, find_effect, load_effect
from vinetrack.experiment.schema import COLUMNS

Value = float | Mapping[str, float]  # A parameter's value: one number, or one for each vine or each day by name


def values_by_key(numbers: Iterable[tuple[str, str, float]]) -> dict[str, Value]:
    """Values as `Model.with_values` takes them: those of single vines become a mapping."""
    values: dict[str, Any] = {}
    for key, vine, value in numbers:
        if vine:
            values.setdefault(key, {})[vine] = value
        else:
            values[key] = value
    return values


@dataclass(frozen=True, repr=False)
class Model(Printed):
    """A sum of effects; `model + effect` and `model - effect` (or its name) give new models.

    `values` holds parameters by `effect.parameter` (B of `eversion_damping` is `"eversion_damping.B"`), SI; parameters
    that are not given have their defaults. A value may be a mapping from names of vines, or of days (`day 2`).
    `user_effects` holds the user's effects by name, which `model + name` looks up before the catalogue.

    Examples
    --------
    >>> model = base_model() + "reservoir_depletion"
    >>> model
    Model(pressure_drive + gravity + eversion_damping + yield_pressure + reservoir_depletion)
    >>> print(model)
    m(x) ẍ = tip force +PA, on the tail +½PA, by ½ = 1/r
             tail force +m(x) g cosθ
             tip force −B ẋⁿ, on the tail −½B ẋⁿ, by ½ = 1/r
             tip force −P_y A, on the tail −½P_y A, by ½ = 1/r
             P → (P₀ + P_atm) (V₀ / (V₀ + A y))^γ − P_atm
      g = 9.81 m/s²
      B = 3 N·(s/m)ⁿ
      n = 0.37
      γ = 1.4
    """

    effects: tuple[Effect, ...]
    values: Mapping[str, Value] = field(default_factory=dict)
    user_effects: Mapping[str, Effect] = field(default_factory=dict, compare=False, repr=False)

    def __post_init__(self) -> None:
        names = [effect.name for effect in self.effects]
        if len(set(names)) != len(names):
            raise EffectError(f"An effect stands twice in the model: {', '.join(names)}.")
        unknown = set(self.values) - set(self.parameter_names)
        if unknown:
            raise EffectError(
                f"No effect of the model has the parameter {', '.join(sorted(unknown))}; it has "
                f"{', '.join(self.parameter_names) or 'none'}."
            )

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the effects, in order."""
        return tuple(effect.name for effect in self.effects)

    @cached_property
    def parameter_names(self) -> tuple[str, ...]:
        """Every parameter as `effect.parameter`, in the order of `parameters_for`."""
        return tuple(f"{effect.name}.{parameter.name}" for effect in self.effects for parameter in effect.parameters)

    @cached_property
    def places(self) -> list[slice]:
        """Slice of the parameters of each effect."""
        ends = list(itertools.accumulate((len(effect.parameters) for effect in self.effects), initial=0))
        return [slice(a, b) for a, b in itertools.pairwise(ends)]

    @cached_property
    def zeros(self) -> Floats:
        """Every parameter at its `zero`, in the order of `parameter_names`."""
        return np.array([number for effect in self.effects for number in effect.zero], dtype=float)

    # A fit determines several thousand times which effects act; the part that depends on the model alone is cached.
    @cached_property
    def sized_and_replaced(self) -> tuple[list[int], list[int], list[tuple[int, int]]]:
        """Indices of effects with parameters, and where those of each begin; pairs: an effect, and one it replaces."""
        sized = [i for i, effect in enumerate(self.effects) if effect.parameters]
        replaces = [(i, name) for i, effect in enumerate(self.effects) for name in effect.replaces]
        pairs = [(i, self.names.index(name)) for i, name in replaces if name in self.names]
        return sized, [self.places[i].start for i in sized], pairs

    @cached_property
    def hooks(self) -> Mapping[str, list[tuple[int, Callable[..., Any], slice]]]:
        """The functions of each hook in the order in which they are called, with index and parameters of the effect."""
        functions: dict[str, list[tuple[int, Callable[..., Any], slice]]] = defaultdict(list)
        for i in sorted(range(len(self.effects)), key=lambda i: self.effects[i].order):
            for hook, function in self.effects[i].functions.items():
                functions[hook].append((i, function, self.places[i]))
        return functions

    def __add__(self, other: Effect | str) -> Model:
        effect = find_effect(other, self.user_effects) if isinstance(other, str) else other
        return replace(self, effects=(*self.effects, effect))

    def __sub__(self, other: Effect | str) -> Model:
        name = other if isinstance(other, str) else other.name
        if name not in self.names:
            raise EffectError(f"The model has no effect {name!r}; it has {', '.join(self.names)}.")
        values = {key: value for key, value in self.values.items() if key.split(".")[0] != name}
        return replace(self, effects=tuple(effect for effect in self.effects if effect.name != name), values=values)

    def __contains__(self, name: object) -> bool:
        return name in self.names

    def __iter__(self) -> Iterator[Effect]:
        return iter(self.effects)

    def with_values(self, values: Mapping[str, Value]) -> Model:
        """The same sum of effects with other parameter values."""
        return replace(self, values={**self.values, **values})

    def parameters_for(self, vine: str, day: str = "") -> Floats:
        """Parameters of trials of a vine and a day, SI, in the order of `parameter_names`. Shape (n_parameters,)."""
        numbers = []
        for effect in self.effects:
            for parameter in effect.parameters:
                value = self.values.get(f"{effect.name}.{parameter.name}", parameter.default)
                if isinstance(value, Mapping) and parameter.shared == "day":
                    value = value.get(day, value.get(vine, parameter.zero))
                elif isinstance(value, Mapping):
                    if vine not in value:
                        raise EffectError(f"{effect.name}.{parameter.name} has no value for the vine {vine!r}.")
                    value = value[vine]
                numbers.append(float(value))
        return np.array(numbers)

    def parameters_of(self, trial: Trial) -> Floats:
        """Values of all parameters for one trial: those of its vine and of its day. Shape (n_parameters,)."""
        return self.parameters_for(trial.vine, trial.group("day"))

    def __repr__(self) -> str:
        return f"Model({' + '.join(self.names)})"

    def __str__(self) -> str:
        terms = "\n         ".join(effect.formula for effect in self.effects)
        lines = [f"m(x) ẍ = {terms}"]
        for effect in self.effects:
            for parameter in effect.parameters:
                value = self.values.get(f"{effect.name}.{parameter.name}", parameter.default)
                pairs = sorted(value.items()) if isinstance(value, Mapping) else [("", value)]
                lines += [f"  {parameter.words(number, vine)}" for vine, number in pairs]
        return "\n".join(lines)


def effects_on(model: Model, parameters: Floats) -> NDArray[np.bool_]:
    """Which effects act: none of size zero (every parameter at its `zero`), nor what an acting effect replaces, so that
    one compiled model serves all smaller ones. Shapes: (n_trials, n_parameters) → (n_trials, n_effects).
    """
    on = np.ones((len(parameters), len(model.effects)), dtype=bool)
    sized, begins, replaced = model.sized_and_replaced
    if sized:
        on[:, sized] = np.logical_or.reduceat(parameters != model.zeros, begins, axis=1)
    acting = on.copy()
    for i, j in replaced:
        on[:, j] &= ~acting[:, i]
    return on


def hosted(host: Model, model: Model, parameters: Floats) -> Floats:
    """Parameters of a model as those of a larger one, others at `zero`. Shapes: (n_trials, n_parameters of each)."""
    wider = np.tile(host.zeros, (len(parameters), 1))
    wider[:, [host.parameter_names.index(name) for name in model.parameter_names]] = parameters
    return wider


def make_model(names: Iterable[str] = BASE_EFFECTS, user_effects: Mapping[str, Effect] | None = None) -> Model:
    """The model with these effects, at their default values.

    Parameters
    ----------
    names : of effects, in the order of the sum.
    user_effects : the user's effects by name; they are looked up before the catalogue.

    Returns
    -------
    the model.

    Raises
    ------
    EffectError
        If a name is unknown or stands twice.

    Examples
    --------
    >>> make_model(["pressure_drive", "gravity", "air_drag"])
    Model(pressure_drive + gravity + air_drag)
    """
    effects = tuple(find_effect(name, user_effects) for name in names)
    return Model(effects, user_effects=dict(user_effects or {}))


def base_model() -> Model:
    """The four base effects: the equation of motion of the paper, Eq. (2).

    Examples
    --------
    >>> base_model() - "gravity"
    Model(pressure_drive + eversion_damping + yield_pressure)
    """
    return make_model()


def with_pressures(inputs: Floats, set_pressure_Pa: Floats, yield_pressure_Pa: Floats) -> Floats:
    """The inputs of trials at other pressures; the mass of the gas in them changes accordingly.
    Shapes: inputs (n_trials, n_fields); set_pressure_Pa, yield_pressure_Pa (n_trials,) → (n_trials, n_fields).
    """
    place = {name: k for k, name in enumerate(TrialInputs._fields)}
    changed = inputs.copy()
    denser = (set_pressure_Pa - inputs[:, place["set_pressure"]]) / (GAS_CONSTANT_AIR_J_KG_K * TEMPERATURE_K)
    volume = inputs[:, place["area"]] * inputs[:, place["length"]] / inputs[:, place["travel_ratio"]] ** 2
    changed[:, place["set_pressure"]] = set_pressure_Pa
    changed[:, place["least_mass"]] += denser * volume
    given = ~np.isnan(yield_pressure_Pa)
    changed[given, place["yield_pressure"]] = yield_pressure_Pa[given]
    return changed


def _of_trial(column: str, trial: Trial) -> object:
    """Value of a trial in a column of the sheet, SI; NaN where it is blank, and for a column that no sheet has."""
    value = getattr(trial, COLUMNS[column].field, math.nan) if column in COLUMNS else math.nan
    return math.nan if value is None or (isinstance(value, str | tuple) and not value) else value


def stated(column: str, trial: Trial) -> bool:
    """Whether the sheet gives a trial a value other than zero in this column."""
    value = _of_trial(column, trial)
    return not isinstance(value, float) or (math.isfinite(value) and value != 0)


def check_needs(model: Model, *trials: Trial) -> None:
    """Raise an error for a trial without a value that an effect of the model needs."""
    needs = [(effect, column) for effect in model for column in effect.needs]
    for trial in trials:
        for effect, column in needs:
            value = _of_trial(column, trial)
            if isinstance(value, float) and not math.isfinite(value) and trial.travel_ratio != 1:
                remedy = f"fill in this column, or state --{column.replace('_', '-')} of a vine to predict"
                raise EffectError(f"Trial {trial.name}: {effect.name} needs `{column}`, which is blank: {remedy}.")


# ------------------------------------------------------------------------------
# One model with the whole catalogue, compiled once for all that is asked of any of its effects.
#
# A model takes seconds to compile, an effect of no size next to nothing to simulate. What compares models therefore
# simulates each by the compiled form of one larger model, the host: the same wherever no effect of a user's own is
# involved. An effect that is switched off is skipped: trajectories are those of the smaller model to the last bit.


@lru_cache(maxsize=1)
def probe() -> Effect:
    """The probe force of the diagnosis (`probes/probe_force.py`)."""
    return load_effect(Path(__file__).with_name("probes") / "probe_force.py")


def host_for(model: Model, candidates: Iterable[Effect] = ()) -> Model:
    """Return one model of the catalogue, the probe force, a model and further effects."""
    held = {effect.name: effect for effect in (*catalogue().values(), probe(), *model, *candidates)}
    return Model(tuple(held.values()))


@lru_cache(maxsize=256)
def shared_host(effects: tuple[Effect, ...]) -> Model | None:
    """Return the host for a model of which none is stated. It saves 3 s for each further model that need not be
    compiled, while trajectories take 15 µs more each: as long for 200 000 of them, which is twenty fits.
    """
    known = all(catalogue().get(effect.name) == effect for effect in effects)
    return host_for(Model(())) if known and not {effect.name for effect in effects} <= set(BASE_EFFECTS) else None
