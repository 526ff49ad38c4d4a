"""Predictive inputs of a vine before it is grown: a model, the median of every input, and its distribution.

An input comes from a stated value, a fit, or the scaling prior below, in this order. Every uncertainty has
its own named stream of random numbers, so that what vines share (the exponent, the scaling law) varies together in all
of them, and what belongs to one vine varies independently.
"""

from __future__ import annotations

import math
import re
import zlib
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from vinetrack.core.problems import Problem, Remark, remark
from vinetrack.core.records import Floats, Trial
from vinetrack.core.units import GRAVITY_M_S2, convert, number
from vinetrack.dynamics.model import Model, make_model
from vinetrack.effects import BASE_EFFECTS, Effect, EffectError, Parameter, find_effect
from vinetrack.experiment.schema import with_names
from vinetrack.inference.fit_data import FitError
from vinetrack.inference.fit_result import DAMPING, EXPONENT, YIELD_PRESSURE, Fit, Number
from vinetrack.inference.optimiser import TYPICAL_SPREADS

if TYPE_CHECKING:
    from vinetrack.inference.fit_result import FitSummary

# ------------------------------------------------------------------------------
# Scaling priors for vines that have not been measured, each with a standard error.
#
#     B ≈ 6.44 (t/200 µm) (D/24 mm)^0.75 N·(s/m)ⁿ
#
# describes the four printed values and the printed linear rise with wall thickness. All four have nearly the same
# t/D, so they do not determine the exponents of t and D separately: their split has an error of its own. None of these
# values is a measurement, and every output that uses them says so.

# Table I and the damping law of Alvarez et al., IEEE Robotics and Automation Letters, 2025, from which the priors are;
# what else they print stands in `paper.motions`
SOURCE = "Alvarez et al. (2025)"
PRINTED_EXPONENT = 0.37  # Damping exponent n, one for all scales (published)
YIELD_PRESSURE_KPA = 3.0  # Yield pressure of the 24 mm × 200 µm vine, R = 4 (published)

SCATTER_DOF = 2  # Degrees of freedom of the scatter about the prior (derived)

BURST_STRESS_PA = 7.8e6  # Assumed hoop stress PD/2t at burst, Pa (derived)


class PrintedVine(NamedTuple):
    """A vine of Table I, its damping coefficient, N·(s/m)ⁿ, and R² of the power law at its steady points."""

    diameter_mm: float
    thickness_um: float
    B: float
    R2: float

    @property
    def size(self) -> tuple[float, float]:
        """Diameter and thickness, m."""
        return 1e-3 * self.diameter_mm, 1e-6 * self.thickness_um


# The four isometric vines, by their scale R
TABLE_I = {
    1: PrintedVine(6.0, 50.0, 0.57, 0.964),
    2: PrintedVine(12.0, 100.0, 1.83, 0.981),
    3: PrintedVine(18.0, 150.0, 4.54, 0.896),
    4: PrintedVine(24.0, 200.0, 6.44, 0.971),
}


def damping_prior(diameter_m: float, thickness_m: float) -> float:
    """The prior of B of a vine of this size, N·(s/m)ⁿ."""
    largest = TABLE_I[max(TABLE_I)]
    diameter, thickness = largest.size
    return largest.B * (thickness_m / thickness) * (diameter_m / diameter) ** 0.75


def damping_scatter() -> float:
    """The standard deviation of ln B of the four printed values about the prior.

    >>> round(damping_scatter(), 3)
    0.113
    """
    residuals = [math.log(one.B / damping_prior(*one.size)) for one in TABLE_I.values()]
    return math.sqrt(sum(residual**2 for residual in residuals) / SCATTER_DOF)


def damping_log_sigma(size: tuple[float, float], like: tuple[float, float] | None = None) -> float:
    """The standard error (scale of Student's t) of the predicted ln B of a vine with t/D as printed: that of a line
    fitted to the four printed points, σ √(1 + ¼ + (z − z̄)²/Σ(zᵢ − z̄)²) with z the logarithm of the size; or carried
    over from a vine `like` it, which scatters as well, σ √(1 + 1 + (z − z_like)²/Σ(zᵢ − z̄)²).
    """
    printed = [math.log(damping_prior(*one.size)) for one in TABLE_I.values()]
    middle = sum(printed) / len(printed)
    start, doubt = (middle, 1 / len(printed)) if like is None else (math.log(damping_prior(*like)), 1.0)
    distance = math.log(damping_prior(*size)) - start
    return damping_scatter() * math.sqrt(1 + doubt + distance**2 / sum((each - middle) ** 2 for each in printed))


def _split_leverage(diameter_m: float, thickness_m: float) -> float:
    """Change of ln B if 1 is added to the exponent of t and subtracted from that of D; 0 for t/D as printed."""
    diameter, thickness = TABLE_I[max(TABLE_I)].size
    return math.log(thickness_m / diameter_m / (thickness / diameter))


def exponent_sigma() -> float:
    """The standard error of the printed n, from the printed R² of the four fits of N = 8 to 11 pressures: that of a
    slope is n √((1 − R²)/R²/(N − 2)); the four are combined with inverse-variance weights.

    >>> round(exponent_sigma(), 3)
    0.012
    """
    dof = (8 + 11) / 2 - 2
    variances = [PRINTED_EXPONENT**2 * (1 - one.R2) / one.R2 / dof for one in TABLE_I.values()]
    return 1 / math.sqrt(sum(1 / variance for variance in variances))


def hoop_stress_Pa(pressure_Pa: float, diameter_m: float, thickness_m: float) -> float:
    """The hoop stress PD/2t of the wall, Pa."""
    return pressure_Pa * diameter_m / (2 * thickness_m)


# ------------------------------------------------------------------------------
# The distributions of all inputs of one trial, and draws from them.

# Names of the two inputs that belong to the trial and not to the model
PRESSURE, YIELD = "pressure_Pa", "yield_pressure_Pa"

BAND = (0.05, 0.5, 0.95)  # Convention: median and 90 % band of a prediction


@dataclass(frozen=True)
class Uncertainty:
    """One uncertainty. `key` names its stream of random numbers: uncertainties of the same key vary together, in
    different vines too. `of` are the inputs that vary with it, and whether as their logarithm, by the changes that
    `draw(generator, n)` returns, shape (n_inputs, n).
    """

    name: str
    why: Remark
    key: str
    of: Mapping[str, bool]
    draw: Callable[[np.random.Generator, int], Any] = field(repr=False, compare=False)


@dataclass(frozen=True)
class Band:
    """Median and 90 % band of an input or of a predicted quantity, SI. `y_over_L` is where a quantity is evaluated, NaN
    where it belongs to no place; for draws that never get there the time is infinite and the speed 0. `why` is the
    origin of an input, or of an uncertainty that is the only one in this band.
    """

    name: str
    unit: str
    low: float
    median: float
    high: float
    y_over_L: float = math.nan
    symbol: str = ""
    why: Remark = field(default_factory=Remark)


@dataclass(frozen=True)
class PredictiveInputs:
    """The distributions from which a trial is predicted; `spreads`: relative between-trial sd of pressure and B."""

    trial: Trial
    model: Model
    origins: Mapping[str, Remark]
    uncertainties: tuple[Uncertainty, ...]
    spreads: tuple[float, float]
    notes: tuple[Remark, ...] = ()

    @property
    def medians(self) -> dict[str, float]:
        """Median of every input, SI."""
        values = dict(zip(self.model.parameter_names, self.model.parameters_of(self.trial).tolist(), strict=True))
        return {**values, PRESSURE: self.trial.pressure_Pa, YIELD: self.trial.yield_pressure_Pa}

    def draw(self, count: int, seed: int, only: Collection[str] | None = None) -> dict[str, Floats]:
        """Draw every input `count` times within its physical bounds, by name; the same seed gives the same draws."""
        draws = {name: np.full(count, value) for name, value in self.medians.items()}
        for one in self.uncertainties:
            if only is None or one.name in only:
                changes = one.draw(np.random.default_rng([seed, zlib.crc32(one.key.encode())]), count)
                for (name, is_log), change in zip(one.of.items(), changes, strict=True):
                    draws[name] = draws[name] * np.exp(change) if is_log else draws[name] + change
        bounds = {name: parameter.bounds for name, _, parameter in _parameters(self.model)}
        return {name: np.clip(values, *bounds.get(name, (0.0, math.inf))) for name, values in draws.items()}

    def drawn_trials(self, count: int, seed: int, only: Collection[str] | None = None) -> tuple[list[Trial], Floats]:
        """The draws as the simulator takes them: a trial each with its pressures; parameters, (count, n_parameters)."""
        draws = self.draw(count, seed, only)
        rows = np.column_stack([draws[name] for name in self.model.parameter_names])
        pairs = zip(draws[PRESSURE].tolist(), draws[YIELD].tolist(), strict=True)
        return [replace(self.trial, pressure_Pa=P, yield_pressure_Pa=P_y) for P, P_y in pairs], rows

    def bands(self) -> list[Band]:
        """Every input with its 90 % band; fixed inputs have a band of zero width."""
        draws = self.draw(4000, 1)
        named = {name: (parameter.unit, parameter.symbol) for name, _, parameter in _parameters(self.model)}
        named |= {YIELD: ("Pa", "P_y"), PRESSURE: ("Pa", "P")}
        bands = []
        for name in dict.fromkeys([*(name for name in (DAMPING, EXPONENT, YIELD, PRESSURE) if name in draws), *draws]):
            (unit, symbol), (low, median, high) = named[name], np.quantile(draws[name], BAND).tolist()
            why = self.origins.get(name, Remark())
            bands.append(Band(name, unit, low, median, high, symbol=symbol, why=why))
        return bands


def _parameters(model: Model) -> list[tuple[str, Effect, Parameter]]:
    return [
        (f"{effect.name}.{parameter.name}", effect, parameter) for effect in model for parameter in effect.parameters
    ]


def read_sizes(text: str, further: Mapping[str, Effect] | None = None) -> tuple[str, dict[str, tuple[float, float]]]:
    """Parse an effect with its sizes: `NAME`, `NAME=value` or `NAME=low:high`, several parameters separated by commas.
    Returns name (of the effect), sizes (ends of a range by `effect.parameter`, equal for a fixed value).
    """
    name, _, sizes_text = text.partition("=")
    effect = find_effect(name.strip(), further)
    cells = [cell.strip() for cell in sizes_text.split(",")] if sizes_text.strip() else []
    if len(cells) > len(effect.parameters):
        known = ", ".join(f"{parameter.name} ({parameter.unit})" for parameter in effect.parameters) or "none"
        raise EffectError(f"{effect.name} has {len(effect.parameters)} parameters, not {len(cells)}: {known}.")
    sizes = {}
    for parameter, cell in zip(effect.parameters, cells, strict=False):
        wrong = f"{parameter.name} of {effect.name} cannot be"
        try:
            ends = [float(part) for part in cell.split(":")]
        except ValueError:
            ends = []
        if len(ends) not in (1, 2) or not all(map(math.isfinite, ends)):
            raise EffectError(f"{wrong} {cell!r}: write a number, or a range such as 0.5:1.5.")
        low, high = parameter.bounds
        if min(ends) < low or max(ends) > high:
            raise EffectError(f"{wrong} {cell}: it lies between {low:g} and {high:g}.")
        sizes[f"{effect.name}.{parameter.name}"] = (min(ends), max(ends))
    return effect.name, sizes


# ------------------------------------------------------------------------------
# Fitted parameters in the form from which predictions draw.


@dataclass(frozen=True)
class FitNumbers:
    """The parameters of a fit, in memory or from `fit.json`, as of a new trial."""

    fit: Fit | FitSummary
    source: str = "the fit"

    def __post_init__(self) -> None:
        if not isinstance(self.fit, Fit) and self.fit.refused:
            raise FitError(f"{self.source} holds no fit to predict from: {self.fit.refused}")
        if not any(number.key == DAMPING for number in self.fit.numbers):
            raise FitError(f"{self.source} is not a fit of everting vines: it has no B to predict with.")

    def place(self, key: str, vine: str = "", near: float = math.nan) -> int | None:
        """The index of a parameter, shared or of this vine, or None; of several P_y that nearest to a stated value."""
        numbers = self.fit.numbers
        of_vine = [one.vine in ("", vine) or one.vine.startswith(f"{vine}, ") for one in numbers]
        places = [k for k, one in enumerate(numbers) if one.key == key and of_vine[k]]
        return min(places, key=lambda k: np.nan_to_num(abs(numbers[k].value - near)), default=None)

    def sizes(self) -> dict[str, tuple[float, float]]:
        """Diameter and thickness, m, of every vine with a fitted B and a name that contains them."""
        vines = (number.vine for number in self.fit.numbers if number.key == DAMPING)
        named = (re.match(r"([\d.]+)mm-([\d.]+)um.*", vine) for vine in vines)
        return {m[0]: (float(m[1]) / 1e3, float(m[2]) / 1e6) for m in named if m}

    def vine_for(self, trial: Trial) -> tuple[str, bool]:
        """The vine from which a trial is predicted, and whether it has the same diameter and wall, at any length, since
        B belongs to the tip; else the nearest in their logarithms, blank where no name contains a size.
        """
        size, sizes = (trial.diameter_m, trial.thickness_m), self.sizes()
        same = [vine for vine in sizes if _alike(sizes[vine], size)]
        if same:
            return (trial.vine if trial.vine in same else same[0]), True
        return min(sizes, key=lambda vine: float(np.sum((np.log(sizes[vine]) - np.log(size)) ** 2)), default=""), False

    @cached_property
    def covariance(self) -> Floats:
        """Covariance of the parameters, of ln B in place of B; 0 where the fit does not determine one. It is widened
        where the 95 % interval is wider than a normal one's, unless a bound determines it.
        """
        covariance = self.fit.covariance
        scale = np.zeros(len(self.fit.numbers))
        for k, one in enumerate(self.fit.numbers):
            if math.isfinite(covariance[k, k]):
                log, low, high = _is_log(one), one.low, one.high
                unit, widening = one.value if log else 1.0, 1.0
                if one.method == "linear" and one.sigma > 0 and low < high and (low > 0 or not log):
                    half = (math.log(high / low) if log else high - low) / 2
                    # 1.96: a normal distribution's 95 % interval is so many standard deviations to either side
                    widening = max(half / (1.959963984540054 * (one.sigma / unit)), 1.0)
                scale[k] = widening / unit
        return np.asarray(np.nan_to_num(covariance, nan=0.0, posinf=0.0, neginf=0.0) * scale[:, None] * scale)


def _is_log(number: Number) -> bool:
    """Whether a parameter varies as its logarithm: B, as in the fit."""
    return number.key == DAMPING and number.value > 0


def _alike(first: tuple[float, float], second: tuple[float, float]) -> bool:
    """Whether two sizes are equal to five digits."""
    return all(abs(a / b - 1) < 1e-5 for a, b in zip(first, second, strict=True))


# ------------------------------------------------------------------------------
# Predictive inputs assembled from stated values, a fit, and printed values or scaling laws.


@dataclass(frozen=True)
class StatedValues:
    """Values stated by the user, which take precedence over all other sources; NaN where none is stated.

    `B_error` is relative, `n_error` absolute, both standard deviations. `effects` are added to those of `model`,
    `sizes` are their parameters where stated; `spreads` are the relative between-trial standard deviations of pressure
    and B.

    Examples
    --------
    >>> StatedValues(n=0.37, n_error=0.01).n
    0.37
    """

    B: float = math.nan
    B_error: float = 0.0
    n: float = math.nan
    n_error: float = 0.0
    model: tuple[str, ...] = BASE_EFFECTS
    effects: tuple[str, ...] = ()
    sizes: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    user_effects: Mapping[str, Effect] = field(default_factory=dict)
    spreads: tuple[float, float] | None = None


class _Assembly:
    """Predictive inputs while they are being assembled. `from_fit` are the inputs taken from the fit, and their indices
    in it; `vine` is the vine of the fit from which the trial is predicted, `is_same` whether it has the same size.
    """

    def __init__(self, trial: Trial, stated: StatedValues, fit: FitNumbers | None) -> None:
        self.trial, self.stated, self.fit = trial, stated, fit
        self.vine, self.is_same = ("", False) if fit is None else fit.vine_for(trial)
        self.size = trial.diameter_m, trial.thickness_m
        self.printed = next((one for one in TABLE_I.values() if _alike(one.size, self.size)), None)
        self.values: dict[str, float] = {}
        self.origins: dict[str, Remark] = {}
        self.uncertainties: list[Uncertainty] = []
        self.notes: list[Remark] = []
        self.from_fit: dict[str, int] = {}

    def set(self, name: str, value: float, origin: str, **facts: str) -> None:
        self.values[name], self.origins[name] = value, remark(origin, **facts)

    def set_fitted(self, name: str, place: int, factor: float = 1.0, origin: str = "fitted", **facts: str) -> None:
        """Take an input from the fit, multiplied by a factor."""
        assert self.fit is not None
        self.from_fit[name] = place
        self.set(name, factor * self.fit.fit.numbers[place].value, origin, source=self.fit.source, **facts)

    def vary(
        self, name: str, sigma: float, title: str, key: str, why: Remark, *, log: bool = False, dof: float = math.inf
    ) -> None:
        """Let an input, or its logarithm, vary by sigma times a normal deviate, or one of Student's t, if any."""

        def draw(rng: np.random.Generator, count: int) -> list[Floats]:
            if math.isinf(dof):
                return [sigma * rng.standard_normal(count)]
            return [sigma * np.clip(rng.standard_t(dof, count), -20.0, 20.0)]

        if sigma != 0:
            self.uncertainties.append(Uncertainty(title, why, key, {name: log}, draw))

    def damping(self) -> None:
        """B: as stated, fitted or printed; else by the scaling prior, from the nearest vine of the fit if any."""
        vine, fit, stated = self.trial.vine, self.fit, self.stated
        place = fit.place(DAMPING, self.vine) if fit else None
        if math.isfinite(stated.B):
            error, why = max(stated.B_error, 0.0), remark("B_given", percent=100 * stated.B_error)
            self.set(DAMPING, stated.B, "given")
            self.vary(DAMPING, error, "error of B", f"B given|{vine}", why, log=True)
        elif fit is not None and place is not None and (self.is_same or fit.fit.numbers[place].vine == ""):
            self.set_fitted(DAMPING, place)
        elif place is None and self.printed is not None:
            error = 0.05  # Relative standard error of a printed B, for which only R² is printed (derived)
            why = remark("B_printed", percent=100 * error)
            self.set(DAMPING, self.printed.B, "printed", source=SOURCE)
            self.vary(DAMPING, error, "error of B", f"B printed|{vine}", why, log=True)
        else:
            # The uncertainties are the scatter of the printed values about the prior, and the exponents of t against D.
            prior, split, like = damping_prior(*self.size), _split_leverage(*self.size), None
            if self.fit is None or place is None:
                self.set(DAMPING, prior, "B_guessed")
            else:
                like = self.fit.sizes()[self.vine]
                self.set_fitted(DAMPING, place, prior / damping_prior(*like), "B_scaled", vine=self.vine)
                self.notes.append(remark("B_carried_over", source=self.fit.source, vine=self.vine))
                split -= _split_leverage(*like)
            scatter = damping_log_sigma(self.size, like)
            why = remark("printed_B_scatter", printed=100 * damping_scatter(), here=100 * scatter, dof=SCATTER_DOF)
            self.vary(DAMPING, scatter, "guess of B", f"B scatter|{self.trial.vine}", why, log=True, dof=SCATTER_DOF)
            if abs(split) > 1e-9:
                sigma = 0.25  # Standard error of the exponent of t against that of D, at constant sum
                why = remark("one_t_over_D", sigma=sigma, here=100 * abs(split) * sigma)
                self.vary(DAMPING, split * sigma, "t against D", "B split", why, log=True)

    def exponent(self) -> None:
        """n: as stated, fitted or printed."""
        place = self.fit.place(EXPONENT) if self.fit else None
        if math.isfinite(self.stated.n):
            error = max(self.stated.n_error, 0.0)
            self.set(EXPONENT, self.stated.n, "given")
            self.vary(EXPONENT, error, "error of n", "n given", remark("n_given", error=error))
        elif place is not None:
            self.set_fitted(EXPONENT, place)
        else:
            error = exponent_sigma()
            self.set(EXPONENT, PRINTED_EXPONENT, "printed", source=SOURCE)
            self.vary(EXPONENT, error, "error of n", "n printed", remark("n_printed", error=error))

    def yield_pressure(self) -> None:
        """P_y: as fitted for this vine, unless the sheet contradicts it; as stated; as fitted for another vine; as
        printed, for one vine or all.
        """
        trial, fit = self.trial, self.fit
        stated, sigma = trial.yield_pressure_Pa, max(np.nan_to_num(trial.yield_pressure_sigma_Pa), 0.0)
        nearest = fit.place(YIELD_PRESSURE, self.vine, stated) if fit else None
        place = nearest if self.is_same else None
        if fit is not None and place is not None and math.isfinite(stated):
            # A stated yield pressure is believed where it contradicts the fitted one by more than 3 standard errors.
            tolerance = 3 * math.hypot(sigma, math.sqrt(fit.covariance[place, place]))
            place = place if abs(stated - fit.fit.numbers[place].value) <= max(tolerance, 1.0) else None
        printed_Pa = 1000 * YIELD_PRESSURE_KPA
        if place is not None:
            self.set_fitted(YIELD, place)
        elif math.isfinite(stated):
            self.set(YIELD, stated, "given")
            why = remark("P_y_stated", sigma=(sigma, trial.pressure_unit))
            self.vary(YIELD, sigma, "stated P_y", f"P_y stated|{trial.vine}", why)
        elif nearest is None and self.printed == TABLE_I[4]:  # the vine whose yield pressure is printed
            rounding_Pa = 1000 / math.sqrt(12)
            self.set(YIELD, printed_Pa, "printed", source=SOURCE)
            why = remark("P_y_printed", sigma=(rounding_Pa, trial.pressure_unit))
            self.vary(YIELD, rounding_Pa, "printed P_y", "P_y printed", why)
        else:
            if nearest is None:
                self.set(YIELD, printed_Pa, "P_y_guessed")
            else:
                self.set_fitted(YIELD, nearest, origin="P_y_carried_over", vine=self.vine)
            sigma = math.log(3.0) / 1.6448536269514722  # nine of ten vines within a factor of 3
            why = remark("P_y_guess", known=(self.values[YIELD], trial.pressure_unit))
            self.vary(YIELD, sigma, "guess of P_y", "P_y guess", why, log=True)

    def other_parameters(self, model: Model) -> None:
        """Parameters of all other effects: as stated, as fitted, or at their typical size."""
        for name, effect, parameter in _parameters(model):
            if name in self.values:
                continue
            place = self.fit.place(name, self.vine) if self.fit else None
            if name in self.stated.sizes:
                self._stated_size(name, effect, parameter, *self.stated.sizes[name])
            elif place is not None:
                self.set_fitted(name, place)
            else:
                self.set(name, parameter.default, "constant" if parameter.held else "typical_size")

    def _stated_size(self, name: str, effect: Effect, parameter: Parameter, low: float, high: float) -> None:
        self.set(name, (low + high) / 2, "given")
        facts = {"symbol": parameter.symbol, "effect": effect.name}
        least, most = parameter.plausible or parameter.bounds
        if low < least or high > most:
            unit = "" if parameter.unit == "1" else f" {parameter.unit}"
            self.notes.append(remark("implausible", **facts, low=least, high=most, unit=unit))
        if high > low:
            title, why = f"{parameter.symbol} ({effect.name})", remark("uniform", **facts, low=low, high=high)
            ends = low - self.values[name], high - self.values[name]
            uniform = Uncertainty(title, why, name, {name: False}, lambda rng, n: [rng.uniform(*ends, n)])
            self.uncertainties.append(uniform)

    def joint_draw_of_fit(self) -> None:
        """Draw all inputs that the fit provides jointly, with their covariance."""
        if self.fit is None or not self.from_fit:
            return
        source, fit, places = self.fit.source, self.fit.fit, list(self.from_fit.values())
        mean, covariance = np.zeros(len(places)), self.fit.covariance[np.ix_(places, places)]
        is_log = {name: _is_log(fit.numbers[place]) for name, place in self.from_fit.items()}
        symbols = {DAMPING: "B", EXPONENT: "n", YIELD: "P_y"}
        shown = ", ".join(symbols.get(name, name) for name in self.from_fit)
        why = remark("with_covariance", names=shown, source=source, count=len(fit.trials))

        def draw(rng: np.random.Generator, count: int) -> Floats:
            return rng.multivariate_normal(mean, covariance, count, method="svd").T

        self.uncertainties.insert(0, Uncertainty("fitted numbers", why, "fit", is_log, draw))
        is_known = np.isfinite(np.diag(fit.covariance))
        if not is_known.all():
            of_open = [number.symbol for number, known in zip(fit.numbers, is_known, strict=True) if not known]
            self.notes.append(remark("not_determined", source=source, names=", ".join(of_open)))

    def between_trials(self) -> tuple[float, float]:
        """Relative between-trial standard deviations of pressure and B; both become uncertainties."""
        trial, known, stated = self.trial, dict(zip("PB", TYPICAL_SPREADS, strict=True)), self.stated.spreads
        origins, dof = dict.fromkeys("PB", "assumed"), dict.fromkeys("PB", math.inf)
        if self.fit is not None:
            few = float(max(len(self.fit.fit.trials) - len(self.fit.fit.numbers), 3))
            for name, one in self.fit.fit.spreads.items():
                symbol = {"pressure": "P"}.get(name, name)
                known[symbol], how = one.value, "estimated" if one.estimated else "assumed"
                origins[symbol] = f"{how} in {self.fit.source}"
                dof[symbol] = few if one.estimated else math.inf  # t of fewer degrees of freedom has no variance
        if trial.pressure_Pa > 0 and math.isfinite(trial.pressure_sigma_Pa):
            known["P"], origins["P"], dof["P"] = trial.pressure_sigma_Pa / trial.pressure_Pa, "stated", math.inf
        if stated is not None:
            known, origins = dict(zip("PB", stated, strict=True)), dict.fromkeys("PB", "given")
            dof = dict.fromkeys("PB", math.inf)
        self.set(PRESSURE, trial.pressure_Pa, "set")
        for symbol, name in (("P", PRESSURE), ("B", DAMPING)):
            why = remark("spread", origin=origins[symbol], percent=100 * known[symbol])
            sigma, log = max(known[symbol], 0.0) * (trial.pressure_Pa if symbol == "P" else 1.0), symbol == "B"
            key = f"{symbol} trial|{trial.vine}"
            self.vary(name, sigma, f"{symbol} from trial to trial", key, why, log=log, dof=dof[symbol])
        return known["P"], known["B"]


def predictive_inputs(
    trial: Trial, stated: StatedValues | None = None, fit: FitNumbers | Fit | None = None
) -> PredictiveInputs:
    """Assemble the predictive inputs of a trial, each from the first source: stated value, fit, printed value or prior.

    Parameters
    ----------
    trial : the vine and its rig; a yield pressure of NaN is taken from the fit or the printed values.
    stated : values stated by the user.
    fit : a fit, or the numbers of one, whose model is then used.

    Returns
    -------
    PredictiveInputs

    Raises
    ------
    EffectError
        If an effect of the model is unknown.
    FitError
        If the fit is not one of everting vines.

    Examples
    --------
    >>> import vinetrack as vt
    >>> texts = {"diameter_mm": "24", "thickness_um": "200", "length_mm": "280", "pressure_kPa": "30"}
    >>> trial = vt.planned_trial(texts).trials[0]
    >>> inputs = vt.predictive_inputs(trial, vt.StatedValues(B=6.4, B_error=0.05, n=0.37, n_error=0.01))
    >>> inputs.model.values["eversion_damping.n"]
    0.37
    """
    stated = stated or StatedValues()
    if fit is not None and not isinstance(fit, FitNumbers):
        stated = replace(stated, user_effects={**{effect.name: effect for effect in fit.model}, **stated.user_effects})
        fit = FitNumbers(fit)
    names = [*(fit.fit.names if fit else stated.model), *stated.effects]
    model = make_model(dict.fromkeys(names), stated.user_effects)
    made = _Assembly(trial if trial.vine else with_names([trial])[0], stated, fit)
    made.damping()
    made.exponent()
    made.yield_pressure()
    made.other_parameters(model)
    made.joint_draw_of_fit()
    spreads = made.between_trials()
    values = {name: value for name, value in made.values.items() if name in model.parameter_names}
    return PredictiveInputs(
        trial=replace(made.trial, yield_pressure_Pa=made.values[YIELD]),
        model=model.with_values(values),
        origins=made.origins,
        uncertainties=tuple(made.uncertainties),
        spreads=spreads,
        notes=tuple(made.notes),
    )


# ------------------------------------------------------------------------------
# Check of stated pressures and rates against measured speeds, for errors of unit.
#
# The damping coefficient that a trial implies, B = (P − P_y) A / (2 ẏ)ⁿ with the printed n, is compared with the
# scaling prior. A pressure in psi stated as kPa is 6.9 times too low, and P − P_y by even more. A rate ten times too
# high makes the energy of motion a hundred times too large, more than gas and weight give in the whole growth.


def pressure_problems(speeds: Iterable[tuple[Trial, float]]) -> list[Problem]:
    """A warning if the speeds contradict the pressures as stated but agree with them in another unit: psi, kPa where
    psi are stated, or absolute instead of gauge pressure; else if they contradict the conservation of energy.
    """
    # Factors between implied and prior damping from which, and within which, another unit explains the speeds (chosen)
    far_off, near = 4.0, 2.5
    pairs = [(trial, speed) for trial, speed in speeds if trial.travel_ratio == 2 and trial.pressure_trace is None]
    as_stated = _middle_ratio(pairs)
    psi, stated = convert(1.0, "psi", "kPa"), pairs[0][0].pressure_unit if pairs else "kPa"
    factor, right, wrong = (psi, "psi", "kPa") if as_stated < 1 else (1 / psi, "kPa", "psi")
    unit = f"{right}, not {wrong} (1 psi is {psi:.4g} kPa)", "in the other unit", f"name the column pressure_{right}"
    absolute = "absolute pressure", "after the ambient pressure is subtracted", "state gauge pressure"
    gauge = [(replace(t, pressure_Pa=t.pressure_Pa - t.ambient_pressure_Pa), speed) for t, speed in pairs]
    converted = [(replace(t, pressure_Pa=factor * t.pressure_Pa), speed) for t, speed in pairs if stated == wrong]
    with_yield = [(replace(t, yield_pressure_Pa=factor * t.yield_pressure_Pa), speed) for t, speed in converted]
    gauge = gauge if all(trial.pressure_Pa > 0 for trial, _ in gauge) else []
    place: dict[str, Any] = {"file": "trials.csv", "severity": "warning"}
    for meant, (what, how, remedy) in ((gauge, absolute), (converted, unit), (with_yield, unit)):
        ratio = _middle_ratio(meant)
        if not 1 / far_off < as_stated < far_off and 1 / near < ratio < near:
            message = (
                f"looks like {what}: the measured speeds imply {number(as_stated, 2)} times the damping of tubes of "
                f"this size, and {number(ratio, 2)} times {how}"
            )
            remedy += ", if capture_fps and the scale are right"
            return [Problem(message=message, column=f"pressure_{stated}", remedy=remedy, **place)]
    shares = []  # Kinetic energy halfway at the mean speed, over the work of gas and weight in the whole growth
    for trial, speed in pairs:
        mass_kg = float(trial.moving_mass_kg(trial.length_m / 2))
        work_J = (trial.pressure_Pa * trial.area_m2 + trial.travel_ratio * mass_kg * GRAVITY_M_S2) * trial.length_m
        shares.append(0.5 * mass_kg * (trial.travel_ratio * speed) ** 2 / work_J)
    if not pairs or sum(share > 1 for share in shares) < min(2, len(pairs)):
        return []
    message = f"is too high: a vine would move with {number(np.nanmax(shares), 2)} times the energy that it gets"
    return [Problem("energy", message, "capture_fps", remedy="write the rate of capture, and check the scale", **place)]


def _middle_ratio(pairs: Iterable[tuple[Trial, float]]) -> float:
    """Median over the trials of the implied damping over its prior; NaN without growth. A trial that moves although the
    pressure does not exceed the yield pressure counts as a ratio of 0.
    """
    ratios = []
    for trial, speed in pairs:
        if 0 < speed < math.inf:
            drive_N = max(0.0, (trial.pressure_Pa - trial.yield_pressure_Pa) * trial.area_m2)
            damping = drive_N / (trial.travel_ratio * speed) ** PRINTED_EXPONENT
            ratios.append(damping / damping_prior(trial.diameter_m, trial.thickness_m))
    known = [ratio for ratio in ratios if math.isfinite(ratio)]
    return float(np.median(known)) if known else math.nan
