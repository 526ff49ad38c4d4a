"""Predictive inputs of a vine before it is grown: a model, the median of every input, and its distribution.

An input comes from a stated value, a fit, or the scaling prior below, in this order. Every uncertainty has
its own named stream of random numbers, so that what vines share (the exponent, the scaling law) varies together in all
of them, and what belongs to one vine varies independently.
"""

from __future__ import annotations

import math
import re
import zlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.core import published
from vinetrack.core.records import Floats, Trial
from vinetrack.dynamics.model import Model, make_model
from vinetrack.effects import BASE_EFFECTS, Effect, EffectError
from vinetrack.inference.fit_data import FitError
from vinetrack.inference.parameters import DAMPING, YIELD_PRESSURE

if TYPE_CHECKING:
    from vinetrack.inference.fit_result import Fit


# ------------------------------------------------------------------------------
# Scaling priors for vines that have not been measured, each with a standard error.
#
#     B ≈ 6.44 (t/200 µm) (D/24 mm)^0.75 N·(s/m)ⁿ
#
# describes the four printed values and the printed linear rise with wall thickness. All four have nearly the same t/D,
# so
# they do not determine the exponents of t and D separately: `SPLIT_SIGMA` allows for that. None of these values is a
# measurement, and every output that uses them says so.

DIAMETER_EXPONENT = 0.75  # Exponent of D in the prior of B (derived)

THICKNESS_EXPONENT = 1.0  # Exponent of t in the prior of B (published)

SCATTER_DOF = 2  # Degrees of freedom of the scatter about the prior (derived)

SPLIT_SIGMA = 0.25  # Standard error of the exponent of t against that of D, at constant sum

PRINTED_ERROR = 0.05  # Relative standard error of a printed B, for which only R² is printed (derived)

YIELD_PRESSURE_PA = 1000 * published.YIELD_PRESSURE_KPA
PRINTED_YIELD_SIGMA_PA = 1000 / math.sqrt(12)  # Standard error of the printed yield pressure, Pa

# Factor of the one printed yield pressure within which nine of ten other vines are assumed to lie (chosen)
YIELD_FACTOR = 3.0

BURST_STRESS_PA = 7.8e6  # Assumed hoop stress PD/2t at burst, Pa (derived)

NINE_OF_TEN = 1.6448536269514722  # Half width of the central 90 % of the normal distribution, in standard deviations

PRESSURE_SPREAD, DAMPING_SPREAD = 0.01, 0.03  # Relative between-trial standard deviations of pressure and B (chosen)


def damping_prior(diameter_m: float, thickness_m: float) -> float:
    """Return the prior of B of a vine of this size, N·(s/m)ⁿ."""
    largest = max(published.DAMPING_B)
    thickness = thickness_m / (1e-6 * published.THICKNESS_UM[largest])
    diameter = diameter_m / (1e-3 * published.DIAMETER_MM[largest])
    return published.DAMPING_B[largest] * thickness**THICKNESS_EXPONENT * diameter**DIAMETER_EXPONENT


def damping_scatter() -> float:
    """Return the standard deviation of ln B of the four printed values about the prior.

    >>> round(damping_scatter(), 3)
    0.113
    """
    residuals = [
        math.log(B / damping_prior(1e-3 * published.DIAMETER_MM[scale], 1e-6 * published.THICKNESS_UM[scale]))
        for scale, B in published.DAMPING_B.items()
    ]
    return math.sqrt(sum(residual**2 for residual in residuals) / SCATTER_DOF)


def damping_log_sigma(diameter_m: float, thickness_m: float) -> float:
    """Return the standard error (scale of Student's t) of the predicted ln B of a vine with t/D as printed. It is the
    prediction error of a line fitted to the four printed points, σ √(1 + ¼ + (z − z̄)²/Σ(zᵢ − z̄)²) with z the
    logarithm of the size; it grows beyond the smallest and the largest vine.
    """
    sizes = [
        math.log(damping_prior(1e-3 * published.DIAMETER_MM[scale], 1e-6 * published.THICKNESS_UM[scale]))
        for scale in published.DAMPING_B
    ]
    middle = sum(sizes) / len(sizes)
    distance = math.log(damping_prior(diameter_m, thickness_m)) - middle
    leverage = 1 / len(sizes) + distance**2 / sum((size - middle) ** 2 for size in sizes)
    return damping_scatter() * math.sqrt(1 + leverage)


def split_leverage(diameter_m: float, thickness_m: float) -> float:
    """Return the change of ln B if 1 is added to the exponent of t and subtracted from that of D; 0 for t/D
    as printed.
    """
    largest = max(published.DAMPING_B)
    printed = 1e-6 * published.THICKNESS_UM[largest] / (1e-3 * published.DIAMETER_MM[largest])
    return math.log(thickness_m / diameter_m / printed)


def exponent_sigma() -> float:
    """Return the standard error of the printed n, from the printed R² of the four fits with about ten pressures each.
    The standard error of a slope n of N points is n √((1 − R²)/R²/(N − 2)); the four are combined with inverse-variance
    weights.

    >>> round(exponent_sigma(), 3)
    0.012
    """
    dof = sum(published.CONDITIONS) / len(published.CONDITIONS) - 2
    variances = [published.EXPONENT**2 * (1 - R2) / R2 / dof for R2 in published.DAMPING_R2.values()]
    return 1 / math.sqrt(sum(1 / variance for variance in variances))


def yield_log_sigma() -> float:
    """Return the standard deviation of the logarithm of the prior of a yield pressure."""
    return math.log(YIELD_FACTOR) / NINE_OF_TEN


def burst_pressure_Pa(diameter_m: float, thickness_m: float) -> float:
    """Return the gauge pressure at which a vine of this size bursts, 2tσ/D, Pa; a guess from one vine."""
    return 2 * thickness_m * BURST_STRESS_PA / diameter_m


def hoop_stress_Pa(pressure_Pa: float, diameter_m: float, thickness_m: float) -> float:
    """Return the hoop stress PD/2t of the wall, Pa."""
    return pressure_Pa * diameter_m / (2 * thickness_m)


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


# ------------------------------------------------------------------------------
# Fitted parameters in the form from which predictions draw: means, covariance, between-trial standard deviations.
#
# They come from a `Fit` or from `fit.json`. B is held as its logarithm, as in the fit.

LEAST_DOF = 3  # Least degrees of freedom of a between-trial standard deviation (derived)

NORMAL_95 = 1.959963984540054  # Standard normal quantile of 0.975

_VINE = re.compile(r"([\d.]+)mm-([\d.]+)um(?:-([\d.]+)mm)?")


@dataclass(frozen=True)
class FitNumbers:
    """The parameters of a fit, named by `keys` and `vines`; `log` marks those held as logarithms. `mean` and
    `covariance` are those of the parameters of a new trial, between-trial differences included. Parameters that the fit
    does not determine have a variance of 0 and are listed in `open`.
    """

    source: str
    model: tuple[str, ...]
    keys: tuple[str, ...]
    vines: tuple[str, ...]
    log: np.ndarray
    mean: Floats
    covariance: Floats
    open: tuple[str, ...]
    spreads: Mapping[str, float]
    spread_dof: Mapping[str, float]
    n_trials: int

    def place(self, key: str, vine: str = "") -> int | None:
        """Return the index of a parameter, shared or of this vine; None where there is none."""
        for k, (name, of_vine) in enumerate(zip(self.keys, self.vines, strict=True)):
            if name == key and of_vine in ("", vine):
                return k
        return None

    def sizes(self) -> dict[str, tuple[float, float]]:
        """Diameter and thickness, m, of every vine with a fitted B."""
        sizes = {}
        for key, vine in zip(self.keys, self.vines, strict=True):
            if key == DAMPING and (size := size_of(vine)):
                sizes[vine] = size
        return sizes


def size_of(vine: str) -> tuple[float, float] | None:
    """Parse diameter and thickness, m, from the name of a vine; None where the name does not contain them. Returns
    (float, float) or None.
    """
    match = _VINE.match(vine)
    return (float(match[1]) / 1e3, float(match[2]) / 1e6) if match else None


def fit_numbers(content: Mapping[str, Any], source: str) -> FitNumbers:
    """Read the parameters of a fit from the content of `fit.json`."""
    if content.get("refused"):
        raise FitError(f"{source} holds no fit to predict from: {content['refused']}")
    numbers = content["numbers"]
    if not numbers:
        raise FitError(f"{source} holds a fit without numbers: there is nothing to predict from.")
    covariance = np.array([[_number(cell) for cell in row] for row in content["covariance"]], dtype=float)
    values = np.array([number["value"] for number in numbers], dtype=float)
    log = np.array([number["parameter"] == DAMPING and number["value"] > 0 for number in numbers], dtype=bool)
    slopes = np.where(log, 1 / np.where(log, values, 1.0), 1.0)
    widening = np.array(
        [_widening(number, bool(is_log)) for number, is_log in zip(numbers, log, strict=True)], dtype=float
    )
    between = np.array([[_number(cell) for cell in row] for row in content.get("between_trials") or ()], dtype=float)
    is_known = np.isfinite(np.diag(covariance))
    if between.shape == covariance.shape:
        # A prediction is of one trial, whose parameters differ from the shared ones.
        covariance = covariance + np.nan_to_num(between)
    dof = float(max(len(content["trials"]) - len(numbers), LEAST_DOF))
    scale = np.where(is_known, slopes * widening, 0.0)
    return FitNumbers(
        source=source,
        model=tuple(content["model"]),
        keys=tuple(number["parameter"] for number in numbers),
        vines=tuple(number["vine"] for number in numbers),
        log=log,
        mean=np.where(log, np.log(np.where(log, values, 1.0)), values),
        covariance=np.nan_to_num(covariance, nan=0.0, posinf=0.0, neginf=0.0) * scale[:, None] * scale,
        open=tuple(number["symbol"] for number, known in zip(numbers, is_known, strict=True) if not known),
        spreads={name: float(spread["value"]) for name, spread in content["spreads"].items()},
        spread_dof={name: dof if spread["estimated"] else math.inf for name, spread in content["spreads"].items()},
        n_trials=len(content["trials"]),
    )


def _number(cell: Any) -> float:
    return math.nan if cell is None else float(cell)


def _widening(number: Mapping[str, Any], log: bool) -> float:
    """Ratio of the fit's 95 % interval to that of a normal distribution, at least 1; 1 where a bound determines it."""
    low, high, sigma = (_number(number[key]) for key in ("low_95", "high_95", "sigma"))
    if number["interval"] != "linear" or not sigma > 0 or not low < high or (log and not low > 0):
        return 1.0
    half = (math.log(high / low) if log else high - low) / 2
    return max(half / (NORMAL_95 * (sigma / number["value"] if log else sigma)), 1.0)


def numbers_of(fit: Fit) -> FitNumbers:
    """Return the parameters of a fit as `vinetrack.fit` returns it."""
    content = {
        "model": fit.model.names,
        "numbers": [number.to_json() for number in fit.numbers],
        "covariance": fit.covariance,
        "between_trials": None if fit.between is None else fit.between.tolist(),
        "spreads": {
            name: {"value": spread.value, "estimated": spread.estimated} for name, spread in fit.spreads.items()
        },
        "trials": {trial.name: None for trial in fit.trials},
    }
    return fit_numbers(content, "the fit")


def same_vine(numbers: FitNumbers, trial: Trial) -> str | None:
    """Return the fitted vine of this diameter and wall and any length, since B belongs to the tip; None without one."""
    sizes = [
        (vine, size) for vine, size in numbers.sizes().items() if alike(size, (trial.diameter_m, trial.thickness_m))
    ]
    exact = [vine for vine, _ in sizes if vine == trial.vine]
    return exact[0] if exact else sizes[0][0] if sizes else None


def alike(first: tuple[float, float], second: tuple[float, float]) -> bool:
    """Return whether two sizes are equal to five digits."""
    return all(abs(a / b - 1) < 1e-5 for a, b in zip(first, second, strict=True))


def nearest_vine(numbers: FitNumbers, trial: Trial) -> str | None:
    """Return the fitted vine nearest in ln diameter and ln thickness; None where no name contains a size."""
    target = np.log([trial.diameter_m, trial.thickness_m])
    sizes = numbers.sizes()
    return min(sizes, key=lambda vine: float(np.sum((np.log(sizes[vine]) - target) ** 2)), default=None)


def yield_place(numbers: FitNumbers, vine: str, stated_Pa: float) -> int | None:
    """Return the index of the yield pressure of a fitted vine; of several, the one nearest to the stated value."""
    places = [
        k
        for k, (key, name) in enumerate(zip(numbers.keys, numbers.vines, strict=True))
        if key == YIELD_PRESSURE and (name == vine or name.startswith(f"{vine}, "))
    ]
    if not places:
        return None
    if not math.isfinite(stated_Pa):
        return places[0]
    return min(places, key=lambda k: abs(float(numbers.mean[k]) - stated_Pa))
