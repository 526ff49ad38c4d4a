"""The user's choice: the effects in the model and their sizes. Immutable; a change returns a new choice."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

from vinetrack.core.problems import UserError
from vinetrack.core.units import SLIDER_UNITS, display_unit
from vinetrack.dynamics.model import Model, Value
from vinetrack.effects import BASE_EFFECTS, Effect, Parameter
from vinetrack.explorer.campaign import Campaign
from vinetrack.explorer.curves import SizedModel, fitted_yield_pressures
from vinetrack.inference.parameters import DAMPING


class ChoiceError(UserError, ValueError):
    """An effect, parameter or value that does not exist or is not allowed; one sentence with a remedy."""


@dataclass(frozen=True)
class SizeControl:
    """One parameter of an effect with a slider, SI; `vine` is blank if one value applies to all trials."""

    effect: str
    parameter: Parameter
    vine: str
    low: float
    high: float

    @property
    def key(self) -> str:
        """`effect.parameter`."""
        return f"{self.effect}.{self.parameter.name}"

    @property
    def name(self) -> str:
        """`effect.parameter`, with the vine in brackets if each has its own value."""
        return f"{self.key}[{self.vine}]" if self.vine else self.key

    @property
    def shown(self) -> tuple[str, float]:
        """The displayed unit, and the factor from SI."""
        return display_unit(self.parameter.unit, SLIDER_UNITS)


@dataclass(frozen=True)
class ModelChoice:
    """Effects in the model, in the order they were added, and the value of every parameter, in the model or not.
    `numbers` also holds the fitted yield pressures by vine, which have no slider.
    """

    effects: tuple[str, ...]
    numbers: Mapping[str, float] = field(default_factory=dict)

    def __contains__(self, effect: object) -> bool:
        return effect in self.effects

    def with_effect(self, effect: str, wanted: bool = True) -> ModelChoice:
        """Return the choice with an effect added (at the end) or removed; its sizes are kept for when it returns."""
        if wanted == (effect in self.effects):
            return self
        kept = tuple(name for name in self.effects if name != effect)
        return replace(self, effects=(*kept, effect) if wanted else kept)

    def with_size(self, name: str, value: float) -> ModelChoice:
        """Return the choice with another value of one parameter."""
        return replace(self, numbers={**self.numbers, name: value})


def choice_in_use(campaign: Campaign) -> ModelChoice:
    """Return the model in use with its fitted values, and all other parameters at their defaults."""
    numbers = {
        size.name: size.parameter.default
        for effect in campaign.effects.values()
        for size in sizes_of(campaign, effect, {})
    }
    return ModelChoice(campaign.in_use, {**numbers, **campaign.numbers})


def sizes_of(campaign: Campaign, effect: Effect, numbers: Mapping[str, float]) -> list[SizeControl]:
    """Return the sliders of an effect: one per parameter, or one per vine or day if each has its own value. Their
    ranges include the present value.
    """
    sizes = []
    for parameter in effect.parameters:
        for vine in campaign.groups(parameter.shared):
            bare = SizeControl(effect.name, parameter, vine, 0.0, 1.0)
            low, high = slider_range(bare.key, parameter, numbers.get(bare.name, parameter.default))
            sizes.append(replace(bare, low=low, high=high))
    return sizes


def slider_range(key: str, parameter: Parameter, value: float) -> tuple[float, float]:
    """Return the range of a slider: the plausible range, extended to the size without effect and the present value.
    Returns low, high, >>> slider_range("x.k", Parameter("k", "k", "1", 1.0, bounds=(0.0, 9.0), plausible=(0.0, 3.0)),
    5.0), (0.0, 6.25).
    """
    low, high = parameter.plausible or parameter.bounds
    if key == DAMPING or not (math.isfinite(low) and math.isfinite(high)):
        reach = 2.0 * max(abs(value), abs(parameter.default), 1e-12)
        low, high = (0.0 if parameter.bounds[0] >= 0 else -reach), reach
    low, high = min(low, parameter.zero, value), max(high, parameter.zero)
    if value >= high:
        high = value + 0.25 * (value - low)
    return max(low, parameter.bounds[0]), min(high, parameter.bounds[1]) if value < parameter.bounds[1] else value


def sized_model(campaign: Campaign, choice: ModelChoice) -> SizedModel:
    """Return the chosen model with its sizes, ready to be simulated."""
    effects = tuple(campaign.effects[name] for name in choice.effects)
    values: dict[str, Value] = {}
    for effect in effects:
        for size in sizes_of(campaign, effect, choice.numbers):
            value = choice.numbers.get(size.name, size.parameter.default)
            if size.vine:
                by_vine = values.get(size.key, {})
                assert isinstance(by_vine, Mapping)
                values[size.key] = {**by_vine, size.vine: value}
            else:
                values[size.key] = value
    return SizedModel(Model(effects, values), fitted_yield_pressures(campaign, choice.numbers))


def is_removable(effect: str) -> bool:
    """Return whether an effect may be removed: the base effects may not, since all others are added to them."""
    return effect not in BASE_EFFECTS


def added_and_dropped(campaign: Campaign, choice: ModelChoice) -> tuple[list[str], list[str]]:
    """Return the effects added to the model in use, and those removed from it. Returns added, dropped : list of str,
    relative to the model in use.
    """
    added = [name for name in choice.effects if name not in campaign.in_use]
    dropped = [name for name in campaign.in_use if name not in choice.effects]
    return added, dropped


def choice_from_options(
    campaign: Campaign, start: ModelChoice, add: Iterable[str] = (), drop: Iterable[str] = (), sizes: Iterable[str] = ()
) -> ModelChoice:
    """Return the choice described by options of the command line."""
    choice = start
    for name in add:
        choice = choice.with_effect(_testable_effect(campaign, name))
    for name in drop:
        if not is_removable(name):
            raise ChoiceError(
                f"{name} is one of the base effects, to which all others are added: it cannot be dropped."
            )
        choice = choice.with_effect(name, False)
    for text in sizes:
        choice = _with_parsed_size(campaign, choice, text)
    return choice


def _testable_effect(campaign: Campaign, name: str) -> str:
    import difflib

    if name not in campaign.effects:
        near = difflib.get_close_matches(name, campaign.effects, n=1)
        raise ChoiceError(
            f"There is no effect named {name!r}: {f'did you mean {near[0]}?' if near else 'see vinetrack effects'}"
        )
    if name in campaign.unusable:
        raise ChoiceError(f"{name} {campaign.unusable[name]}.")
    return name


def _with_parsed_size(campaign: Campaign, choice: ModelChoice, text: str) -> ModelChoice:
    name, equals, written = text.partition("=")
    name = name.strip()
    effect = _testable_effect(campaign, name.split(".")[0])
    sizes = sizes_of(campaign, campaign.effects[effect], choice.numbers)
    matching = [size for size in sizes if name in (size.name, size.key)]
    if not equals or not matching:
        known = ", ".join(size.name for size in sizes) or "none"
        raise ChoiceError(f"{text!r} is no size: write NAME=VALUE, SI, with one of {known}.")
    try:
        value = float(written)
    except ValueError:
        raise ChoiceError(f"{written!r} is no number: write {name}=0.5, say, in SI units.") from None
    low, high = matching[0].parameter.bounds
    if not low <= value <= high:
        raise ChoiceError(f"{name} = {value:g} is outside its bounds, {low:g} to {high:g}.")
    choice = choice.with_effect(effect)
    for size in matching:
        choice = choice.with_size(size.name, value)
    return choice
