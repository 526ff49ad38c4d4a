"""Predictive inputs of a vine before it is grown: a model, the median of every number, and the uncertainty of each.

A number is taken from what a person states, from a fit, or from `vinetrack.planning.scaling_priors`, in this order.
Every uncertainty draws from a stream of random numbers of its own name: what vines have in common (an exponent, the law
of the guess) then moves them together, and what each has of its own does not.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from vinetrack.core.records import Floats, Trial
from vinetrack.dynamics.model import Model, make_model
from vinetrack.effects import BASE_EFFECTS, Effect, EffectError

PRESSURE, YIELD = "pressure_Pa", "yield_pressure_Pa"
"""Names of the two numbers that belong to a trial and not to the model."""

BAND = (0.05, 0.5, 0.95)
"""Convention: median and 90 % band of a prediction."""

_FOR_BANDS = 4000
"""Draws for the bands of the inputs. Derived: their ends are known to 0.35 % of the draws."""

Draws = dict[str, Floats]
"""By name of parameter, `effect.parameter`, or of a pressure: values, shape (n,)."""

Move = Callable[[Draws, np.random.Generator], Draws]


@dataclass(frozen=True)
class Uncertainty:
    """One uncertainty; `move` gives draws in which it varies, from those in which it does not.

    `key` names its stream of random numbers: uncertainties of one key vary together, in different vines too.
    """

    name: str
    words: str
    key: str
    move: Move = field(repr=False, compare=False)


@dataclass(frozen=True)
class Input:
    """One number that went into a prediction: median and 90 % band, SI, and where they come from."""

    name: str
    symbol: str
    unit: str
    low: float
    median: float
    high: float
    origin: str


@dataclass(frozen=True)
class PredictiveInputs:
    """The distributions from which one trial is predicted.

    `trial` and `model` stand at the medians; `origins` says by number where it comes from; `spreads` are those of
    pressure and B from trial to trial, relative, and among the uncertainties too; `notes` are sentences for people.
    """

    trial: Trial
    model: Model
    origins: Mapping[str, str]
    uncertainties: tuple[Uncertainty, ...]
    spreads: tuple[float, float]
    notes: tuple[str, ...] = ()

    @property
    def medians(self) -> dict[str, float]:
        """Every number, SI, as it stands with nothing uncertain."""
        values = dict(zip(self.model.parameter_names, self.model.parameters_of(self.trial).tolist(), strict=True))
        return {**values, PRESSURE: self.trial.pressure_Pa, YIELD: self.trial.yield_pressure_Pa}

    def draw(self, count: int, seed: int, only: Iterable[str] | None = None) -> Draws:
        """Draw every number `count` times; the same seed gives the same draws.

        Parameters
        ----------
        count : int
            Number of draws.
        seed : int
            The same seed gives the same draws, whatever else varies.
        only : iterable of str, optional
            Names of the uncertainties that vary; the others stay at their medians. By default all vary.

        Returns
        -------
        Draws
            Within the bounds of each parameter.
        """
        chosen = None if only is None else set(only)
        draws = {name: np.full(count, value) for name, value in self.medians.items()}
        for uncertainty in self.uncertainties:
            if chosen is None or uncertainty.name in chosen:
                draws = uncertainty.move(draws, np.random.default_rng([seed, zlib.crc32(uncertainty.key.encode())]))
        return _within_bounds(draws, self.model)

    def laid_out(self, draws: Draws) -> tuple[list[Trial], Floats]:
        """Trials and parameters, shape (n, n_parameters), of these draws, as the simulator takes them.

        Parameters
        ----------
        draws : from `draw`.

        Returns
        -------
        trials : list of Trial
            One a draw, with its pressures.
        parameters : array, shape (n, n_parameters), SI
        """
        rows = np.column_stack([draws[name] for name in self.model.parameter_names])
        pressures, yields = draws[PRESSURE].tolist(), draws[YIELD].tolist()
        return [
            replace(self.trial, pressure_Pa=P, yield_pressure_Pa=P_y) for P, P_y in zip(pressures, yields, strict=True)
        ], rows

    def bands(self, seed: int = 1) -> list[Input]:
        """Every number with its 90 % band; those that never vary have a band of no width.

        Parameters
        ----------
        seed : int
            Of the draws.

        Returns
        -------
        list of Input
            B, n and the pressures first.
        """
        draws = self.draw(_FOR_BANDS, seed)
        names = {
            f"{effect.name}.{parameter.name}": (parameter.symbol, parameter.unit)
            for effect in self.model
            for parameter in effect.parameters
        }
        named = {**names, YIELD: ("P_y", "Pa"), PRESSURE: ("P", "Pa")}
        order = [name for name in ("eversion_damping.B", "eversion_damping.n", YIELD, PRESSURE) if name in draws]
        order += [name for name in draws if name not in order]
        bands = []
        for name in order:
            symbol, unit = named[name]
            low, median, high = (float(q) for q in np.quantile(draws[name], BAND))
            bands.append(Input(name, symbol, unit, low, median, high, self.origins.get(name, "")))
        return bands


def _within_bounds(draws: Draws, model: Model) -> Draws:
    """No number beyond what physics allows of it."""
    bounds = {f"{effect.name}.{p.name}": p.bounds for effect in model for p in effect.parameters}
    bounds |= {YIELD: (0.0, math.inf), PRESSURE: (0.0, math.inf)}
    return {name: np.clip(values, *bounds[name]) for name, values in draws.items()}


def wanted_model(
    names: Iterable[str] = BASE_EFFECTS,
    further: Iterable[str] = (),
    user_effects: Mapping[str, Effect] | None = None,
) -> Model:
    """A model of these effects and further ones, each once.

    Parameters
    ----------
    names : iterable of str
        Effects of the model.
    further : iterable of str
        Effects added to them.
    user_effects : mapping, optional
        Effects of the user by name, beside the catalogue.

    Returns
    -------
    Model

    Raises
    ------
    EffectError
        If a name is unknown.
    """
    return make_model(dict.fromkeys([*names, *further]), user_effects)


@dataclass(frozen=True)
class Size:
    """How large an effect is taken: a value and, where it is uncertain, the range it evenly lies in; SI."""

    low: float
    high: float

    @property
    def middle(self) -> float:
        """Half-way."""
        return (self.low + self.high) / 2


def read_sizes(text: str, further: Mapping[str, Effect] | None = None) -> tuple[str, dict[str, Size]]:
    """Name and sizes of an effect from `NAME`, `NAME=value`, `NAME=low:high`, several parameters joined by commas.

    Parameters
    ----------
    text : str
        As a user writes it.
    further : mapping, optional
        Effects of the user by name, beside the catalogue.

    Returns
    -------
    name : str
        Of the effect.
    sizes : dict
        By `effect.parameter`; blank where the text gives none.

    Raises
    ------
    EffectError
        If there is no such effect or its sizes cannot be read.

    Examples
    --------
    >>> read_sizes("reservoir_depletion=1:1.4")
    ('reservoir_depletion', {'reservoir_depletion.gamma': Size(low=1.0, high=1.4)})
    """
    from vinetrack.effects import find_effect

    name, _, sizes_text = text.partition("=")
    effect = find_effect(name.strip(), further)
    if not sizes_text.strip():
        return effect.name, {}
    cells = [cell.strip() for cell in sizes_text.split(",")]
    known = ", ".join(f"{parameter.name} ({parameter.unit})" for parameter in effect.parameters) or "none"
    if len(cells) > len(effect.parameters):
        raise EffectError(f"{effect.name} has {len(effect.parameters)} parameters, not {len(cells)}: {known}.")
    return effect.name, {
        f"{effect.name}.{parameter.name}": _size(effect, parameter.name, cell, parameter.bounds)
        for parameter, cell in zip(effect.parameters, cells, strict=False)
    }


def _size(effect: Effect, parameter: str, cell: str, bounds: tuple[float, float]) -> Size:
    try:
        ends = [float(part) for part in cell.split(":")]
    except ValueError:
        ends = []
    if len(ends) not in (1, 2) or not all(map(math.isfinite, ends)):
        raise EffectError(
            f"{parameter} of {effect.name} cannot be {cell!r}: write a number, or a range such as 0.5:1.5."
        )
    low, high = min(ends), max(ends)
    if low < bounds[0] or high > bounds[1]:
        raise EffectError(
            f"{parameter} of {effect.name} cannot be {cell}: it lies between {bounds[0]:g} and {bounds[1]:g}."
        )
    return Size(low, high)


FARTHEST = 20.0
"""At which a deviate of Student's t is cut: a factor ten of a guessed B, beyond all vines. Chosen: it cuts one draw
in 400 of t with two degrees of freedom, at half one in 100, at twice one in 1600; the 90 % band ends at 2.9."""


def _deviates(draw: np.random.Generator, count: int, dof: float = math.inf) -> Floats:
    """Normal deviates, or Student's with so many degrees of freedom, shape (count,)."""
    if math.isinf(dof):
        return draw.standard_normal(count)
    return np.clip(draw.standard_t(dof, count), -FARTHEST, FARTHEST)


def scaled(name: str, log_sigma: float, dof: float = math.inf) -> Move:
    """Multiplied by a factor whose logarithm has this standard deviation, or scale of Student's t.

    Parameters
    ----------
    name : str
        Number that is drawn.
    log_sigma : float
        Standard deviation, or scale of Student's t, of the logarithm of the factor.
    dof : float
        Degrees of freedom; infinite for a normal distribution.

    Returns
    -------
    Move
    """

    def move(draws: Draws, draw: np.random.Generator) -> Draws:
        return {**draws, name: draws[name] * np.exp(log_sigma * _deviates(draw, draws[name].size, dof))}

    return move


def shifted(name: str, sigma: float) -> Move:
    """Moved by a normal deviate, SI.

    Parameters
    ----------
    name : str
        Number that is drawn.
    sigma : float
        Standard deviation, SI.

    Returns
    -------
    Move
    """

    def move(draws: Draws, draw: np.random.Generator) -> Draws:
        return {**draws, name: draws[name] + sigma * draw.standard_normal(draws[name].size)}

    return move


def relative(name: str, sigma: float, dof: float = math.inf) -> Move:
    """Multiplied by one plus a deviate of this standard deviation, or scale of Student's t.

    Parameters
    ----------
    name : str
        Number that is drawn.
    sigma : float
        Relative standard deviation, or scale of Student's t.
    dof : float
        Degrees of freedom; infinite for a normal distribution.

    Returns
    -------
    Move
    """

    def move(draws: Draws, draw: np.random.Generator) -> Draws:
        return {**draws, name: draws[name] * (1 + sigma * _deviates(draw, draws[name].size, dof))}

    return move


def even(name: str, size: Size) -> Move:
    """Drawn evenly from a range.

    Parameters
    ----------
    name : str
        Number that is drawn.
    size : range, SI.

    Returns
    -------
    Move
    """

    def move(draws: Draws, draw: np.random.Generator) -> Draws:
        return {**draws, name: draw.uniform(size.low, size.high, draws[name].size)}

    return move
