"""Predictive inputs of a vine before it is grown: a model, the median of every input, and its distribution.

An input comes from a stated value, a fit, or `vinetrack.planning.scaling_priors`, in this order. Every uncertainty has
its own named stream of random numbers, so that what vines share (the exponent, the scaling law) varies together in all
of them, and what belongs to one vine varies independently.
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

# Names of the two inputs that belong to the trial and not to the model
PRESSURE, YIELD = "pressure_Pa", "yield_pressure_Pa"

BAND = (0.05, 0.5, 0.95)  # Convention: median and 90 % band of a prediction

_BAND_SAMPLES = 4000  # Draws for the bands of the inputs (derived)

Draws = dict[str, Floats]  # Values, shape (n,), by name of a parameter (`effect.parameter`) or of a pressure

Sampler = Callable[[Draws, np.random.Generator], Draws]


@dataclass(frozen=True)
class Uncertainty:
    """One uncertainty; `sample` returns draws in which it varies, given draws in which it does not. `key` names its
    stream of random numbers: uncertainties of the same key vary together, in different vines too.
    """

    name: str
    words: str
    key: str
    sample: Sampler = field(repr=False, compare=False)


@dataclass(frozen=True)
class Input:
    """One input of a prediction: median and 90 % band, SI, and their origin."""

    name: str
    symbol: str
    unit: str
    low: float
    median: float
    high: float
    origin: str


@dataclass(frozen=True)
class PredictiveInputs:
    """The distributions from which one trial is predicted."""

    trial: Trial
    model: Model
    origins: Mapping[str, str]
    uncertainties: tuple[Uncertainty, ...]
    spreads: tuple[float, float]
    notes: tuple[str, ...] = ()

    @property
    def medians(self) -> dict[str, float]:
        """Median of every input, SI."""
        values = dict(zip(self.model.parameter_names, self.model.parameters_of(self.trial).tolist(), strict=True))
        return {**values, PRESSURE: self.trial.pressure_Pa, YIELD: self.trial.yield_pressure_Pa}

    def draw(self, count: int, seed: int, only: Iterable[str] | None = None) -> Draws:
        """Draw every input `count` times; the same seed gives the same draws."""
        chosen = None if only is None else set(only)
        draws = {name: np.full(count, value) for name, value in self.medians.items()}
        for uncertainty in self.uncertainties:
            if chosen is None or uncertainty.name in chosen:
                draws = uncertainty.sample(draws, np.random.default_rng([seed, zlib.crc32(uncertainty.key.encode())]))
        return _within_bounds(draws, self.model)

    def laid_out(self, draws: Draws) -> tuple[list[Trial], Floats]:
        """Return the trials and model parameters of these draws, as the simulator takes them. Returns trials (one for
        each draw, with its pressures), parameters. Shape (n, n_parameters).
        """
        rows = np.column_stack([draws[name] for name in self.model.parameter_names])
        pressures, yields = draws[PRESSURE].tolist(), draws[YIELD].tolist()
        return [
            replace(self.trial, pressure_Pa=P, yield_pressure_Pa=P_y) for P, P_y in zip(pressures, yields, strict=True)
        ], rows

    def bands(self, seed: int = 1) -> list[Input]:
        """Return every input with its 90 % band; fixed inputs have a band of zero width."""
        draws = self.draw(_BAND_SAMPLES, seed)
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
    """The draws, clipped to the physical bounds of each input."""
    bounds = {f"{effect.name}.{p.name}": p.bounds for effect in model for p in effect.parameters}
    bounds |= {YIELD: (0.0, math.inf), PRESSURE: (0.0, math.inf)}
    return {name: np.clip(values, *bounds[name]) for name, values in draws.items()}


def wanted_model(
    names: Iterable[str] = BASE_EFFECTS,
    further: Iterable[str] = (),
    user_effects: Mapping[str, Effect] | None = None,
) -> Model:
    """Return a model of these effects and further ones, each once."""
    return make_model(dict.fromkeys([*names, *further]), user_effects)


@dataclass(frozen=True)
class Size:
    """Assumed value of a parameter: the range of a uniform distribution, of zero width for a fixed value; SI."""

    low: float
    high: float

    @property
    def middle(self) -> float:
        """Middle of the range."""
        return (self.low + self.high) / 2


def read_sizes(text: str, further: Mapping[str, Effect] | None = None) -> tuple[str, dict[str, Size]]:
    """Parse an effect with its sizes: `NAME`, `NAME=value` or `NAME=low:high`, several parameters separated by commas.
    Returns name (of the effect), sizes (by `effect.parameter`; empty where the text gives none).
    """
    from vinetrack.effects import find_effect

    name, _, sizes_text = text.partition("=")
    effect = find_effect(name.strip(), further)
    if not sizes_text.strip():
        return effect.name, {}
    cells = [cell.strip() for cell in sizes_text.split(",")]
    parameters = ", ".join(f"{parameter.name} ({parameter.unit})" for parameter in effect.parameters) or "none"
    if len(cells) > len(effect.parameters):
        raise EffectError(f"{effect.name} has {len(effect.parameters)} parameters, not {len(cells)}: {parameters}.")
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


LARGEST_T_DEVIATE = 20.0  # At which deviates of Student's t are clipped (chosen)


def _deviates(draw: np.random.Generator, count: int, dof: float = math.inf) -> Floats:
    """Standard normal deviates, or deviates of Student's t with `dof` degrees of freedom, shape (count,)."""
    if math.isinf(dof):
        return draw.standard_normal(count)
    return np.clip(draw.standard_t(dof, count), -LARGEST_T_DEVIATE, LARGEST_T_DEVIATE)


def scaled(name: str, log_sigma: float, dof: float = math.inf) -> Sampler:
    """Return a sampler that multiplies an input by a log-normal (or log-t) factor."""

    def sample(draws: Draws, draw: np.random.Generator) -> Draws:
        return {**draws, name: draws[name] * np.exp(log_sigma * _deviates(draw, draws[name].size, dof))}

    return sample


def shifted(name: str, sigma: float) -> Sampler:
    """Return a sampler that adds a normal deviate to an input."""

    def sample(draws: Draws, draw: np.random.Generator) -> Draws:
        return {**draws, name: draws[name] + sigma * draw.standard_normal(draws[name].size)}

    return sample


def relative(name: str, sigma: float, dof: float = math.inf) -> Sampler:
    """Return a sampler that multiplies an input by one plus a normal (or t) deviate."""

    def sample(draws: Draws, draw: np.random.Generator) -> Draws:
        return {**draws, name: draws[name] * (1 + sigma * _deviates(draw, draws[name].size, dof))}

    return sample


def even(name: str, size: Size) -> Sampler:
    """Return a sampler that draws an input uniformly from a range."""

    def sample(draws: Draws, draw: np.random.Generator) -> Draws:
        return {**draws, name: draw.uniform(size.low, size.high, draws[name].size)}

    return sample
