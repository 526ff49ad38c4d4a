"""What a person has chosen: the effects in the model and their sizes. Plain data, changed by making another."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

from vinetrack.core.problems import UserError
from vinetrack.core.units import SLIDER_UNITS, display_unit
from vinetrack.dynamics.model import Model, Value
from vinetrack.effects import BASE_EFFECTS, Effect, Parameter
from vinetrack.explorer.campaign import Campaign
from vinetrack.explorer.curves import SizedModel, yields_of
from vinetrack.inference.parameters import DAMPING


class ChoiceError(UserError, ValueError):
    """Something was chosen that there is not; one sentence with a remedy."""


@dataclass(frozen=True)
class SizeControl:
    """One number of an effect that a slider moves, SI; `vine` is blank where it holds for all."""

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
        """`effect.parameter`, with the vine in brackets where it has one of its own."""
        return f"{self.key}[{self.vine}]" if self.vine else self.key

    @property
    def shown(self) -> tuple[str, float]:
        """The unit it is shown in, and the factor to it."""
        return display_unit(self.parameter.unit, SLIDER_UNITS)


@dataclass(frozen=True)
class ModelChoice:
    """Effects in the model, in the order they were added, and the size of every number by name, in it or not.

    `numbers` also holds the yield pressures that a fit found, by vine; no slider moves them.
    """

    effects: tuple[str, ...]
    numbers: Mapping[str, float] = field(default_factory=dict)

    def __contains__(self, effect: object) -> bool:
        return effect in self.effects

    def with_effect(self, effect: str, wanted: bool = True) -> ModelChoice:
        """With an effect put in (at the end) or taken out; its sizes are kept for when it comes back.

        Parameters
        ----------
        effect : its name.
        wanted : False takes it out.

        Returns
        -------
        Choice
        """
        if wanted == (effect in self.effects):
            return self
        kept = tuple(name for name in self.effects if name != effect)
        return replace(self, effects=(*kept, effect) if wanted else kept)

    def with_size(self, name: str, value: float) -> ModelChoice:
        """With one number, SI, at another size.

        Parameters
        ----------
        name : `effect.parameter`, with `[vine]` where each vine has its own.
        value : SI.

        Returns
        -------
        Choice
        """
        return replace(self, numbers={**self.numbers, name: value})


def first_choice(campaign: Campaign) -> ModelChoice:
    """The model in use at the sizes that were fitted, everything else at its default.

    Parameters
    ----------
    campaign : as `read_campaign` returns it.

    Returns
    -------
    Choice
    """
    numbers = {
        size.name: size.parameter.default
        for effect in campaign.effects.values()
        for size in sizes_of(campaign, effect, {})
    }
    return ModelChoice(campaign.in_use, {**numbers, **campaign.numbers})


def sizes_of(campaign: Campaign, effect: Effect, numbers: Mapping[str, float]) -> list[SizeControl]:
    """The sliders of an effect: one a number, or one a vine or day where each has its own.

    Ranges hold the present value.

    Parameters
    ----------
    campaign : as `read_campaign` returns it.
    effect : whose parameters are listed.
    numbers : present values by name, SI.

    Returns
    -------
    list of Size
    """
    sizes = []
    for parameter in effect.parameters:
        for vine in campaign.groups(parameter.shared):
            bare = SizeControl(effect.name, parameter, vine, 0.0, 1.0)
            low, high = slider_range(bare.key, parameter, numbers.get(bare.name, parameter.default))
            sizes.append(replace(bare, low=low, high=high))
    return sizes


def slider_range(key: str, parameter: Parameter, value: float) -> tuple[float, float]:
    """From where to where a slider goes: what is plausible, the size at which it vanishes, and the value it has.

    Parameters
    ----------
    key : `effect.parameter`.
    value : present value, SI.
    parameter : its default, bounds and plausible range, SI.

    Returns
    -------
    low, high : float, SI

    >>> slider_range("x.k", Parameter("k", "k", "1", 1.0, bounds=(0.0, 9.0), plausible=(0.0, 3.0)), 5.0)
    (0.0, 6.25)
    """
    low, high = parameter.plausible or parameter.bounds
    if key == DAMPING or not (math.isfinite(low) and math.isfinite(high)):
        reach = 2.0 * max(abs(value), abs(parameter.default), 1e-12)
        low, high = (0.0 if parameter.bounds[0] >= 0 else -reach), reach
    low, high = min(low, parameter.zero, value), max(high, parameter.zero)
    if value >= high:
        high = value + 0.25 * (value - low)
    return max(low, parameter.bounds[0]), min(high, parameter.bounds[1]) if value < parameter.bounds[1] else value


def sized(campaign: Campaign, choice: ModelChoice) -> SizedModel:
    """The model that was chosen, ready to be followed.

    Parameters
    ----------
    campaign : as `read_campaign` returns it.
    choice : effects and sizes.

    Returns
    -------
    SizedModel
    """
    effects = tuple(campaign.effects[name] for name in choice.effects)
    values: dict[str, Value] = {}
    for effect in effects:
        for size in sizes_of(campaign, effect, choice.numbers):
            value = choice.numbers.get(size.name, size.parameter.default)
            if size.vine:
                former = values.get(size.key, {})
                assert isinstance(former, Mapping)
                values[size.key] = {**former, size.vine: value}
            else:
                values[size.key] = value
    return SizedModel(Model(effects, values), yields_of(campaign, choice.numbers))


def can_leave(effect: str) -> bool:
    """Whether an effect may be taken out: the base effects are what all others are added to.

    Parameters
    ----------
    effect : its name.

    Returns
    -------
    bool
    """
    return effect not in BASE_EFFECTS


def changed(campaign: Campaign, choice: ModelChoice) -> tuple[list[str], list[str]]:
    """Effects added to the model in use, and those taken out of it.

    Parameters
    ----------
    campaign : as `read_campaign` returns it.
    choice : effects and sizes.

    Returns
    -------
    added, dropped : list of str, against the model in use
    """
    added = [name for name in choice.effects if name not in campaign.in_use]
    dropped = [name for name in campaign.in_use if name not in choice.effects]
    return added, dropped


def chosen(
    campaign: Campaign, start: ModelChoice, add: Iterable[str] = (), drop: Iterable[str] = (), sizes: Iterable[str] = ()
) -> ModelChoice:
    """A choice put together from words, as a command line has them.

    Parameters
    ----------
    campaign : what is explored.
    start : the choice that is changed.
    add, drop : names of effects.
    sizes : `effect.parameter=value` or `effect.parameter[vine]=value`, SI; the effect is put in.

    Returns
    -------
    Choice

    Raises
    ------
    ChoiceError
        If there is no such effect or number, these trials cannot be asked about it, or a base effect should go.
    """
    choice = start
    for name in add:
        choice = choice.with_effect(_usable(campaign, name))
    for name in drop:
        if not can_leave(name):
            raise ChoiceError(f"{name} is one of the base effects, which all others are added to: it stays.")
        choice = choice.with_effect(name, False)
    for text in sizes:
        choice = _with_written_size(campaign, choice, text)
    return choice


def _usable(campaign: Campaign, name: str) -> str:
    import difflib

    if name not in campaign.effects:
        near = difflib.get_close_matches(name, campaign.effects, n=1)
        raise ChoiceError(
            f"There is no effect named {name!r}: {f'did you mean {near[0]}?' if near else 'see vinetrack effects'}"
        )
    if name in campaign.unusable:
        raise ChoiceError(f"{name} {campaign.unusable[name]}.")
    return name


def _with_written_size(campaign: Campaign, choice: ModelChoice, text: str) -> ModelChoice:
    name, equals, written = text.partition("=")
    name = name.strip()
    effect = _usable(campaign, name.split(".")[0])
    sizes = sizes_of(campaign, campaign.effects[effect], choice.numbers)
    meant = [size for size in sizes if name in (size.name, size.key)]
    if not equals or not meant:
        known = ", ".join(size.name for size in sizes) or "none"
        raise ChoiceError(f"{text!r} is no size: write NAME=VALUE, SI, with one of {known}.")
    try:
        value = float(written)
    except ValueError:
        raise ChoiceError(f"{written!r} is no number: write {name}=0.5, say, in SI units.") from None
    low, high = meant[0].parameter.bounds
    if not low <= value <= high:
        raise ChoiceError(f"{name} = {value:g} lies outside its bounds, {low:g} to {high:g}.")
    choice = choice.with_effect(effect)
    for size in meant:
        choice = choice.with_size(size.name, value)
    return choice
