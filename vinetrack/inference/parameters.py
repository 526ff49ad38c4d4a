"""The free parameters of a fit, and their mapping to the parameters of each trial.

A parameter is named `effect.parameter`; the yield pressure, which the sheet states for each vine, is
`yield_pressure.P_y`. Internally each is divided by its scale, so that all are of order one, except B, which enters as
ln B: the value of the vine and the deviation of the trial then add up exactly, and so do ln B and n ln v.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats, Trial
from vinetrack.dynamics.model import Model
from vinetrack.effects import Parameter
from vinetrack.inference.fit_data import FitError, FitTrial

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
    place among `free` of each key for each trial, -1 where it does not apply. Every trial has as many columns as there
    are keys, however many vines there are.
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
        return (
            np.array([number.to_scaled(number.lower) for number in self.free]),
            np.array([number.to_scaled(number.upper) for number in self.free]),
        )

    @property
    def prior_precision(self) -> Floats:
        """Prior precisions of the scaled parameters, shape (n_free,); 0 without a prior."""
        return np.array([(number.scale / number.prior_sd) ** 2 for number in self.free])

    def values(self, theta: Floats) -> Floats:
        """Values, SI, of scaled parameters. Shapes: theta (n_free,) → (n_free,)."""
        return np.array([number.from_scaled(float(scaled)) for number, scaled in zip(self.free, theta, strict=True)])

    def rows(self, theta: Floats) -> tuple[Floats, Floats]:
        """Model parameters and yield pressures of every trial for scaled parameters. Returns rows, yields (naN where
        the value in the sheet applies). Shapes: theta (n_free,) → (n_trials, n_parameters).
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
        """Deviations of pressure (relative) and ln B by the systematic differences between trials. Shapes: theta
        (n_free,) → (n_trials, 2).
        """
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
    """Choose the free parameters of a fit and map them to the trials. By default every parameter of every effect is
    free, except those that are `held` (g), and so is the yield pressure of each vine within the error in the sheet.
    """
    parameters = {f"{effect.name}.{parameter.name}": parameter for effect in model for parameter in effect.parameters}
    names = [*parameters, *([YIELD_PRESSURE] if "yield_pressure" in model else [])]
    fixed_names = {_find_name(name, names) for name in fixed}
    freed_names = {_find_name(name, names) for name in free}
    sharing_by_name = {_find_name(name, names): how for name, how in (shared or {}).items()}
    for name, how in sharing_by_name.items():
        if how not in ("all", "vine", "day"):
            raise FitError(f"{name} is shared by {how!r}: say 'all', 'vine' or 'day'.")
    free_names = [
        name for name in parameters if name not in fixed_names and (name in freed_names or not parameters[name].held)
    ]
    trials = [trial_data.trial for trial_data in data]
    base = np.array([model.parameters_of(trial) for trial in trials])
    base = base.reshape(len(data), len(model.parameter_names))
    numbers: list[FreeParameter] = []
    index = np.full((len(data), 0), -1)
    for name in free_names:
        how = sharing_by_name.get(name, parameters[name].shared)
        groups, members = groups_of(trials, how), group_names(trials, how)
        places = {group: len(numbers) + i for i, group in enumerate(members)}
        numbers += [
            _free_parameter(name, parameters[name], group, base[groups.index(group)], model) for group in members
        ]
        index = np.column_stack([index, [places[group] for group in groups]])
    keys = list(free_names)
    if YIELD_PRESSURE in names and YIELD_PRESSURE not in fixed_names:
        yield_numbers, column = _yield_pressures(data, len(numbers))
        if yield_numbers:
            numbers, keys, index = [*numbers, *yield_numbers], [*keys, YIELD_PRESSURE], np.column_stack([index, column])
    for term in between:
        members = [group for group in dict.fromkeys(term.groups) if group]
        place = {group: len(numbers) + i for i, group in enumerate(members)} | {"": -1}
        numbers += [_between_coefficient(term, group) for group in members]
        keys, index = [*keys, term.key], np.column_stack([index, [place[group] for group in term.groups]])
    return ParameterMap(model, tuple(numbers), tuple(keys), index.astype(int), base, tuple(between))


def groups_of(trials: Sequence[Trial], shared: str) -> list[str]:
    """For each trial the name of the group with which it shares a parameter; blank if all trials share it. With `day`,
    all trials share it unless the sheet states several days, and one for every trial.
    """
    groups = [trial.group(shared) for trial in trials]
    if shared == "day" and (not all(groups) or len(set(groups)) == 1):
        return [""] * len(groups)
    return groups


def group_names(trials: Sequence[Trial], shared: str) -> list[str]:
    """Names of the groups of trials that share a parameter."""
    names = list(dict.fromkeys(groups_of(trials, shared)))
    return sorted(names, key=lambda name: (len(name), name)) if shared == "day" else names


def _between_coefficient(term: BetweenTerm, group: str) -> FreeParameter:
    return FreeParameter(
        key=term.key,
        vine=group,
        symbol=term.symbol,
        unit=term.unit,
        start=0.0,
        lower=-math.inf,
        upper=math.inf,
        scale=term.scale,
        prior_sd=term.prior_sd,
    )


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
    further_starts = (low + 0.5 * width,) if math.isfinite(low) and name not in (DAMPING, EXPONENT) else ()
    return FreeParameter(
        key=name,
        vine=vine,
        symbol=parameter.symbol,
        unit=parameter.unit,
        start=float(np.clip(value, *parameter.bounds)),
        lower=parameter.bounds[0],
        upper=parameter.bounds[1],
        scale=max(abs(value), 0.3 * width) or 1.0,
        further_starts=further_starts,
        logarithmic=name == DAMPING,
    )


def _yield_pressures(data: Sequence[FitTrial], offset: int) -> tuple[list[FreeParameter], NDArray[np.int_]]:
    """One yield pressure for each vine and stated value, with the error in the sheet as prior."""
    numbers: list[FreeParameter] = []
    places: dict[tuple[str, float], int] = {}
    column = np.full(len(data), -1)
    stated = {(trial_data.trial.vine, round(trial_data.trial.yield_pressure_Pa, 3)) for trial_data in data}
    several = {vine for vine, _ in stated if sum(vine == other for other, _ in stated) > 1}
    for i, trial_data in enumerate(data):
        trial = trial_data.trial
        sigma_Pa, stated_Pa = trial.yield_pressure_sigma_Pa, trial.yield_pressure_Pa
        if trial.travel_ratio == 1 or not (math.isfinite(sigma_Pa) and sigma_Pa > 0 and math.isfinite(stated_Pa)):
            continue
        place = (trial.vine, round(stated_Pa, 3))
        if place not in places:
            places[place] = offset + len(numbers)
            numbers.append(
                FreeParameter(
                    key=YIELD_PRESSURE,
                    vine=f"{trial.vine}, {stated_Pa / 1e3:g} kPa" if trial.vine in several else trial.vine,
                    symbol="P_y",
                    unit="Pa",
                    start=stated_Pa,
                    lower=0.0,
                    upper=math.inf,
                    scale=max(stated_Pa, 1e3),
                    prior_sd=sigma_Pa,
                )
            )
        column[i] = places[place]
    return numbers, column
