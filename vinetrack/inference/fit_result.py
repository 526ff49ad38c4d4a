"""The result of a fit: numbers with errors and intervals, trial effects, and messages."""

from __future__ import annotations

import difflib
import math
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field, PlainSerializer, PlainValidator

from vinetrack.core.problems import Remark
from vinetrack.core.process import Drawn, Printed, table
from vinetrack.core.records import Floats, Track, Trial
from vinetrack.core.tables import JsonRecord
from vinetrack.core.units import decimals, display_unit, or_nan
from vinetrack.dynamics.model import Model, Value, values_by_key
from vinetrack.effects import Parameter
from vinetrack.inference.fit_data import FitError, FitTrial

if TYPE_CHECKING:
    import pandas as pd

    from vinetrack.inference.marginal_likelihood import FitState
    from vinetrack.inference.optimiser import Solution
    from vinetrack.inference.sensitivity import Predictor


# ------------------------------------------------------------------------------
# The free parameters of a fit, and their mapping to the parameters of each trial.
#
# A parameter is named `effect.parameter`; the yield pressure, which the sheet states for each vine, is
# `yield_pressure.P_y`. Internally each is divided by its scale, so that all are of order one, except B, which enters as
# ln B: the value of the vine and the deviation of the trial then add up exactly, and so do ln B and n ln v.

YIELD_PRESSURE = "yield_pressure.P_y"
DAMPING = "eversion_damping.B"
EXPONENT = "eversion_damping.n"


@dataclass(frozen=True)
class BetweenTerm:
    """A systematic difference between trials as part of the model: deviation_j = Σ_g a_g z_j over the groups of trials.
    It is added to the set pressure (relative) or ln B of trial j, before the random deviation.
    """

    key: str
    symbol: str
    unit: str
    pressure: bool
    groups: tuple[str, ...]
    regressor: Floats
    scale: float
    prior_sd: float = math.inf


@dataclass(frozen=True)
class FreeParameter:
    """One free parameter of a fit, SI. `vine` is the vine or day to which it belongs; blank if it applies to all.
    `prior_sd` is infinite without a prior; the mean of a prior is `start`.
    """

    key: str
    vine: str
    symbol: str
    unit: str
    start: float
    lower: float
    upper: float
    scale: float
    prior_sd: float = math.inf
    further_starts: tuple[float, ...] = ()  #: other values to begin from
    logarithmic: bool = False

    @property
    def name(self) -> str:
        """`effect.parameter`, followed by the vine in brackets if it belongs to one."""
        return f"{self.key}[{self.vine}]" if self.vine else self.key

    def to_scaled(self, value: float) -> float:
        """The scaled value."""
        if self.logarithmic:
            # 1e-6: least B, N·(s/m)ⁿ (chosen)
            return math.log(max(value, 1e-6))
        return value / self.scale

    def from_scaled(self, theta: float) -> float:
        """The value, SI, of a scaled value."""
        return math.exp(theta) if self.logarithmic else theta * self.scale

    def derivative(self, value: float) -> float:
        """Derivative of the value with respect to the scaled value."""
        return self.from_scaled(self.to_scaled(value)) if self.logarithmic else self.scale


@dataclass(frozen=True)
class ParameterMap:
    """The free parameters in order, and which of them apply to each trial. `index`, shape (n_trials, n_keys), gives the
    place among `free` of each key for each trial, -1 where it does not apply.
    """

    model: Model
    free: tuple[FreeParameter, ...]
    keys: tuple[str, ...]
    index: NDArray[np.int_]
    base: Floats
    between: tuple[BetweenTerm, ...] = ()

    @property
    def start(self) -> Floats:
        """Starting values, scaled, shape (n_free,)."""
        return np.array([number.to_scaled(number.start) for number in self.free])

    @property
    def bounds(self) -> tuple[Floats, Floats]:
        """Lower and upper bounds, scaled, shape (n_free,) each."""
        lower = np.array([number.to_scaled(number.lower) for number in self.free])
        return lower, np.array([number.to_scaled(number.upper) for number in self.free])

    @property
    def prior_precision(self) -> Floats:
        """Prior precisions of the scaled parameters, shape (n_free,); 0 without a prior."""
        return np.array([(number.scale / number.prior_sd) ** 2 for number in self.free])

    def values(self, theta: Floats) -> Floats:
        """Values, SI, of scaled parameters."""
        return np.array([number.from_scaled(value) for number, value in zip(self.free, theta.tolist(), strict=True)])

    def rows(self, theta: Floats) -> tuple[Floats, Floats]:
        """Model parameters, (n_trials, n_parameters), and yield pressures of every trial, NaN where the value in the
        sheet applies, for scaled parameters.
        """
        rows = self.base.copy()
        values = self.values(theta)
        yields = np.full(rows.shape[0], math.nan)
        for column, key in enumerate(self.keys):
            applies = self.index[:, column] >= 0
            if key == YIELD_PRESSURE:
                yields[applies] = values[self.index[applies, column]]
            elif key in self.model.parameter_names:
                rows[applies, self.model.parameter_names.index(key)] = values[self.index[applies, column]]
        return rows, yields

    def term(self, key: str) -> BetweenTerm | None:
        """The difference between trials of which this key is the coefficient; None for a parameter of the model."""
        return next((term for term in self.between if term.key == key), None)

    @property
    def random(self) -> NDArray[np.bool_]:
        """Free parameters that are random effects of a group of trials, shape (n_free,)."""
        keys = {term.key for term in self.between if math.isfinite(term.prior_sd)}
        return np.array([number.key in keys for number in self.free], dtype=bool)

    def shifts(self, theta: Floats) -> Floats:
        """Deviations of pressure (relative) and ln B by the systematic differences, (n_trials, 2)."""
        shifts = np.zeros((self.index.shape[0], 2))
        values = np.append(self.values(theta), 0.0) if self.between else np.zeros(1)
        for term in self.between:
            if term.key in self.keys:
                place = self.index[:, self.keys.index(term.key)]
                shifts[:, 0 if term.pressure else 1] += values[place] * term.regressor
        return shifts


def make_layout(
    model: Model,
    data: Sequence[FitTrial],
    *,
    fixed: Iterable[str] = (),
    free: Iterable[str] = (),
    shared: Mapping[str, str] | None = None,
    between: Sequence[BetweenTerm] = (),
) -> ParameterMap:
    """The free parameters of a fit, and which trials they apply to: by default all of every effect that are not `held`
    (g), and the yield pressure of each vine within the error in the sheet.
    """
    parameters = {f"{effect.name}.{parameter.name}": parameter for effect in model for parameter in effect.parameters}
    names = [*parameters, *([YIELD_PRESSURE] if "yield_pressure" in model else [])]
    fixed_names = {_find_name(name, names) for name in fixed}
    freed_names = {_find_name(name, names) for name in free}
    sharing_by_name = {_find_name(name, names): how for name, how in (shared or {}).items()}
    for name, how in sharing_by_name.items():
        if how not in ("all", "vine", "day"):
            raise FitError(f"{name} is shared by {how!r}: say 'all', 'vine' or 'day'.")
    held = fixed_names.union(name for name, one in parameters.items() if one.held and name not in freed_names)
    keys = [name for name in parameters if name not in held]
    trials = [trial_data.trial for trial_data in data]
    base = np.array([model.parameters_of(trial) for trial in trials])
    base = base.reshape(len(data), len(model.parameter_names))
    numbers: list[FreeParameter] = []
    index = np.full((len(data), 0), -1)
    for name in keys:
        how = sharing_by_name.get(name, parameters[name].shared)
        groups, members = groups_of(trials, how), group_names(trials, how)
        places = {group: len(numbers) + i for i, group in enumerate(members)}
        numbers += [
            _free_parameter(name, parameters[name], group, base[groups.index(group)], model) for group in members
        ]
        index = np.column_stack([index, [places[group] for group in groups]])
    if YIELD_PRESSURE in names and YIELD_PRESSURE not in fixed_names:
        yield_numbers, column = _yield_pressures(data, len(numbers))
        if yield_numbers:
            numbers, keys, index = [*numbers, *yield_numbers], [*keys, YIELD_PRESSURE], np.column_stack([index, column])
    for term in between:
        members = [group for group in dict.fromkeys(term.groups) if group]
        place = {group: len(numbers) + i for i, group in enumerate(members)} | {"": -1}
        shown = (term.symbol, term.unit, 0.0, -math.inf, math.inf, term.scale, term.prior_sd)
        numbers += [FreeParameter(term.key, group, *shown) for group in members]
        keys, index = [*keys, term.key], np.column_stack([index, [place[group] for group in term.groups]])
    return ParameterMap(model, tuple(numbers), tuple(keys), index.astype(int), base, tuple(between))


def groups_of(trials: Sequence[Trial], shared: str) -> list[str]:
    """For each trial the name of the group with which it shares a parameter, blank if all do: of `day` the vine unless
    the sheet states several days, and one for every trial, since a camera is set up anew for either.
    """
    groups = [trial.group(shared) for trial in trials]
    if shared == "day" and (not all(groups) or len(set(groups)) == 1):
        several = len({trial.vine for trial in trials}) > 1
        return [trial.vine if several else "" for trial in trials]
    return groups


def group_names(trials: Sequence[Trial], shared: str) -> list[str]:
    """Names of the groups of trials that share a parameter."""
    names = list(dict.fromkeys(groups_of(trials, shared)))
    return sorted(names, key=lambda name: (len(name), name)) if shared == "day" else names


def _find_name(name: str, names: Sequence[str]) -> str:
    """The full name among `names` for a full or short name."""
    if name in names:
        return name
    short = [full for full in names if full.split(".")[1] == name]
    if len(short) == 1:
        return short[0]
    near = short or difflib.get_close_matches(name, names, n=1, cutoff=0.4) or list(names)
    raise FitError(f"No parameter of the model is named {name!r}: say {' or '.join(near)}.")


def _free_parameter(name: str, parameter: Parameter, vine: str, values: Floats, model: Model) -> FreeParameter:
    value = float(values[model.parameter_names.index(name)])
    low, high = parameter.plausible or parameter.bounds
    width = high - low if math.isfinite(high - low) else max(abs(parameter.default), 1.0)
    return FreeParameter(
        name,
        vine,
        parameter.symbol,
        parameter.unit,
        float(np.clip(value, *parameter.bounds)),
        *parameter.bounds,
        scale=max(abs(value), 0.3 * width) or 1.0,
        further_starts=(low + 0.5 * width,) if math.isfinite(low) and name not in (DAMPING, EXPONENT) else (),
        logarithmic=name == DAMPING,
    )


def _yield_pressures(data: Sequence[FitTrial], offset: int) -> tuple[list[FreeParameter], NDArray[np.int_]]:
    """One yield pressure for each vine and stated value, with the error in the sheet as prior."""
    numbers: dict[tuple[str, float], FreeParameter] = {}
    column = np.full(len(data), -1)
    values = {(each.trial.vine, round(each.trial.yield_pressure_Pa, 3)) for each in data}
    count = Counter(vine for vine, _ in values)
    for i, trial in enumerate(each.trial for each in data):
        sigma_Pa, stated_Pa = trial.yield_pressure_sigma_Pa, trial.yield_pressure_Pa
        if trial.travel_ratio == 1 or not (math.isfinite(sigma_Pa) and sigma_Pa > 0 and math.isfinite(stated_Pa)):
            continue
        place, group = (trial.vine, round(stated_Pa, 3)), trial.yield_group if count[trial.vine] > 1 else trial.vine
        how = (YIELD_PRESSURE, group, "P_y", "Pa", stated_Pa, 0.0, math.inf, max(stated_Pa, 1e3), sigma_Pa)
        numbers.setdefault(place, FreeParameter(*how))
        column[i] = offset + list(numbers).index(place)
    return list(numbers.values()), column


OrNaN = Annotated[float, BeforeValidator(or_nan)]  # A number of a JSON file, where null means that it is not known


def or_open(end: float) -> BeforeValidator:
    """A number of a JSON file, where null means this end of the numbers."""
    return BeforeValidator(lambda value: end if value is None else value)


@dataclass(frozen=True)
class Number(JsonRecord):
    """One fitted number, SI, with its standard error, degrees of freedom and 95 % interval. `method` is `linear`, or
    `none` if the data do not determine it; `shared` is the part of the error that all trials share, by its source.
    """

    key: Annotated[str, Field(alias="parameter")]
    vine: str
    symbol: str
    unit: str
    value: OrNaN
    sigma: OrNaN
    low: Annotated[OrNaN, Field(alias="low_95")]
    high: Annotated[OrNaN, Field(alias="high_95")]
    dof: Annotated[float, Field(exclude=True)] = math.nan
    method: Annotated[str, Field(alias="interval")] = "linear"
    bound: OrNaN = math.nan
    lower: Annotated[float, or_open(-math.inf), Field(alias="lower_bound")] = -math.inf
    upper: Annotated[float, or_open(math.inf), Field(alias="upper_bound")] = math.inf
    shared: Annotated[Mapping[str, OrNaN], Field(alias="sigma_shared")] = field(default_factory=dict)
    pressure_unit: str = "kPa"

    @property
    def shown(self) -> tuple[str, float]:
        """The unit in which people read it, a pressure that of the sheet, and the factor from SI."""
        return display_unit(self.unit, self.pressure_unit)

    @property
    def name(self) -> str:
        """`effect.parameter`, with the vine in brackets if it belongs to one."""
        return f"{self.key}[{self.vine}]" if self.vine else self.key

    @property
    def title(self) -> str:
        """Symbol, with the vine in brackets if it belongs to one."""
        return f"{self.symbol} ({self.vine})" if self.vine else self.symbol

    @property
    def shared_sigma(self) -> float:
        """The part of the standard error that all trials share, of all sources together."""
        return math.hypot(*self.shared.values())

    @property
    def ends_at(self) -> str:
        """Ends of the 95 % interval that are bounds, not estimates: `lower`, `upper`, `lower and upper`, or blank."""
        slack = 1e-6 * max(abs(self.high - self.low), 1e-12 * max(abs(self.low), abs(self.high)))
        ends = {"lower": self.low - self.lower, "upper": self.upper - self.high}
        return " and ".join(name for name, room in ends.items() if room <= slack)


@dataclass(frozen=True)
class BetweenTrialSpread:
    """Between-trial standard deviation, relative; `estimated` tells whether it is from these data."""

    value: OrNaN
    estimated: bool


@dataclass(frozen=True)
class TrialEstimates:
    """What a fit estimated for one trial; deviations are relative, of the set pressure and of the vine's B."""

    release_s: OrNaN = math.nan
    release_sigma_s: OrNaN = math.nan
    origin_m: OrNaN = math.nan
    origin_sigma_m: OrNaN = math.nan
    pressure_deviation: OrNaN = math.nan
    pressure_deviation_sigma: OrNaN = math.nan
    damping_deviation: OrNaN = math.nan
    damping_deviation_sigma: OrNaN = math.nan


@dataclass(frozen=True, kw_only=True)
class TrialFit(TrialEstimates):
    """One trial under the model; arrays have shape (n_points,), at the points that were used. `whitened` are whitened
    residuals, without systematic errors, in standard deviations.
    """

    trial: Trial
    time_s: Floats
    lead_position_m: Floats
    predicted_position_m: Floats
    predicted_velocity_m_s: Floats
    residual_m: Floats
    whitened: Floats
    noise_m: float
    band_m: Floats | None = None

    @property
    def within_band(self) -> float:
        """Fraction of the positions within the band; NaN without a band."""
        if self.band_m is None:
            return math.nan
        return float(np.mean(np.abs(self.residual_m) <= self.band_m))

    @property
    def name(self) -> str:
        """The trial's name."""
        return self.trial.name

    @property
    def rms_m(self) -> float:
        """Root mean square of the residuals, m."""
        return float(np.sqrt(np.mean(self.residual_m**2)))


class NumberTable(Printed):
    """Access to the numbers of a fit and their covariance, common to a fit in memory and one read from a file."""

    names: tuple[str, ...]
    numbers: tuple[Number, ...]
    covariance: Floats
    messages: tuple[Any, ...]
    trials: Collection[Any]

    @property
    def heading(self) -> str:
        """The model and the number of trials, in words."""
        return f"{' + '.join(self.names)}, fitted to {len(self.trials)} trials"

    def __getitem__(self, name: str) -> Number:
        """The number of this name: `effect.parameter`, `effect.parameter[vine]`, or the parameter's name if unique."""
        fits = [n for n in self.numbers if name in (n.name, n.key, n.key.split(".")[1], n.title)]
        if len(fits) != 1:
            known = ", ".join(number.name for number in (fits or self.numbers)) or "none"
            raise FitError(f"{name!r} is {'no number' if not fits else 'more than one number'} of the fit: {known}.")
        return fits[0]

    def table(self) -> pd.DataFrame:
        """One row per number: `parameter, vine, value, sigma, low_95, high_95, unit, interval`; SI."""
        import pandas as pd

        return pd.DataFrame(
            [(n.key, n.vine, n.value, n.sigma, n.low, n.high, n.unit, n.method) for n in self.numbers],
            columns=["parameter", "vine", "value", "sigma", "low_95", "high_95", "unit", "interval"],
        )


@dataclass(frozen=True, repr=False)
class Fit(NumberTable, Drawn):
    """A model fitted to trajectories. Printed, it is a table. `model` has the fitted values. `covariance` is that of
    `numbers`, SI, in their order.
    """

    model: Model
    numbers: tuple[Number, ...]
    covariance: Floats
    spreads: Mapping[str, BetweenTrialSpread]
    noise_m: float
    noise_correlation: float
    chi2_per_dof: float
    log_likelihood: float
    trials: tuple[TrialFit, ...]
    messages: tuple[Remark, ...]
    left_out: Mapping[str, str]
    converged: bool
    iterations: int
    solution: Solution
    options: Mapping[str, Any]
    pairs: tuple[tuple[Trial, Track], ...] = ()
    with_errors: FitState | None = None

    @property
    def predictor(self) -> Predictor:
        """Simulates the trials of the fit."""
        return self.solution.predictor

    @property
    def state(self) -> FitState:
        """State of the solution, with the variance components of the fit that includes the systematic errors: without
        them the displacement by a lens is taken for deviations of single trials and enlarges these.
        """
        state, with_errors = self.solution.state, self.with_errors
        if with_errors is None:
            return state
        return replace(state, spread=with_errors.spread, rho=with_errors.rho, variance=with_errors.variance)

    @property
    def names(self) -> tuple[str, ...]:  # type: ignore[override]
        """Names of the effects of the model, in order."""
        return self.model.names

    def __repr__(self) -> str:
        return f"Fit({' + '.join(self.model.names)}; {len(self.trials)} trials)"

    def __str__(self) -> str:
        points = sum(trial.time_s.size for trial in self.trials)
        return "\n".join([f"{self.heading} ({points} positions)", *numbers_text(self)])


def numbers_text(fit: Any) -> list[str]:
    """The numbers of a fit, its noise and its messages as lines of text."""
    head = ("", "value", "error", "of it shared", "95 % interval", "unit")
    lines = table(map(number_row, fit.numbers), head, indent="  ", align="<><<<<")
    for name, spread in fit.spreads.items():
        how = "" if spread.estimated else " (fixed: given, too few trials to estimate it, or a poor fit)"
        lines.append(f"between-trial standard deviation of {name} {100 * spread.value:.2g} %{how}")
    lines.append(
        f"noise {fit.noise_m * 1e3:.3g} mm, correlation {fit.noise_correlation:.2f};"
        f" χ² per degree of freedom {fit.chi2_per_dof:.3g}; ln L {fit.log_likelihood:.1f}"
    )
    lines += [f"! {message}" for message in fit.messages]
    if fit.left_out:
        lines.append(f"left out: {'; '.join(f'{name} ({why})' for name, why in fit.left_out.items())}")
    return lines


def number_row(number: Number) -> tuple[str, ...]:
    """A number as texts in its display unit: name, value, `± standard error`, its shared part, 95 % interval, unit."""
    unit, factor = number.shown
    if math.isfinite(number.bound):
        return number.title, f"{number.bound * factor:.4g}", "at its bound", "", "", unit
    if not (math.isfinite(number.sigma) and number.sigma > 0):
        return number.title, f"{number.value * factor:.4g}", "open", "", "", unit
    digits = decimals(number.sigma * factor)
    value, low, high = (f"{x * factor:.{digits}f}" for x in (number.value, number.low, number.high))
    error, shared = (f"± {sigma * factor:.{digits}f}" for sigma in (number.sigma, number.shared_sigma))
    return number.title, value, error, shared if number.shared else "", f"{low} to {high}", unit


def _array(content: Any) -> Floats:
    """An array of a JSON file, where null means that a number is not known."""
    return np.array(content if content is not None else (), dtype=float)


Stored = Annotated[Floats, PlainValidator(_array), PlainSerializer(lambda array: array)]


@dataclass(frozen=True, repr=False)
class FitSummary(NumberTable, JsonRecord):
    """The quoted results of a fit, as `fit.json` holds them: `names` are those of the effects, `warnings` those of the
    audit. `refused` is the reason why the model was not fitted, blank if it was: everything else is empty then.
    """

    names: Annotated[tuple[str, ...], Field(alias="model")] = ()
    refused: Annotated[
        str, BeforeValidator(lambda reason: reason or ""), PlainSerializer(lambda text: text or None)
    ] = ""
    numbers: tuple[Number, ...] = ()
    covariance: Stored = field(default_factory=lambda: np.empty((0, 0)))
    moved_by_film: Stored = field(default_factory=lambda: np.empty(0))
    spreads: Mapping[str, BetweenTrialSpread] = field(default_factory=dict)
    noise_m: OrNaN = math.nan
    noise_correlation: OrNaN = math.nan
    chi2_per_dof: OrNaN = math.nan
    log_likelihood: OrNaN = math.nan
    converged: bool = False
    messages: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    left_out: Mapping[str, str] = field(default_factory=dict)
    trials: Mapping[str, TrialEstimates] = field(default_factory=dict)

    @property
    def fitted_values(self) -> dict[str, Value]:
        """Fitted values by `effect.parameter`, SI, as `Model.with_values` takes them."""
        return values_by_key((number.key, number.vine, number.value) for number in self.numbers)

    def to_json(self) -> dict[str, Any]:
        """As `fit.json` holds it, SI; a refused fit has its model and the reason alone."""
        content = super().to_json()
        return {key: content[key] for key in ("model", "refused")} if self.refused else content

    def __repr__(self) -> str:
        state = "refused" if self.refused else f"{len(self.trials)} trials"
        return f"FitSummary({' + '.join(self.names)}; {state})"

    def __str__(self) -> str:
        if self.refused:
            return f"{' + '.join(self.names)} was not fitted: {self.refused}"
        return "\n".join([self.heading, *numbers_text(self)])
