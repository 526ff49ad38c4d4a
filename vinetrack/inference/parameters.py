"""Which numbers of a model a fit may move, and how a vector of them reaches every trial.

A number is named `effect.parameter`; the yield pressure, which the sheet brings along for each vine, is
`yield_pressure.P_y`. Inside, each is divided by its scale, so that all are of the order of one; but B enters as ln B:
then what a trial shares with the other trials and what it has of its own add up exactly, and so do ln B and n ln v.
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
LEAST_DAMPING = 1e-6
"""Least B, N·(s/m)ⁿ. Chosen: a millionth of the smallest published value."""


@dataclass(frozen=True)
class BetweenTerm:
    """A difference between trials that is part of the model: deviation_j = Σ_g a_g z_j over the groups of trials.

    It is added to the deviation that trial j has of its set pressure or of its ln B, before the random deviation.

    Parameters
    ----------
    key
        Name of the hypothesis and of the coefficient: `order_drift.B`.
    pressure
        Whether the pressure deviates (relative), else ln B.
    groups
        For each trial the group whose coefficient it feels, blank where it feels none.
    regressor
        z_j, shape (n_trials,), relative deviation per unit of the coefficient.
    prior_sd
        Standard deviation of the coefficients, their unit, where they are a random effect of the group; infinite where
        they are fixed effects. Those with a prior are integrated out of the likelihood (`mixed_effects.deviance`).
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
    """One number that a fit moves, SI. `vine` is whose it is, a vine's or a day's; blank where it is that of all.

    `prior_sd` is infinite where only the data speak. A prior's mean is `start`.
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
    tries: tuple[float, ...] = ()  #: other values to begin from
    logarithmic: bool = False

    @property
    def name(self) -> str:
        """`effect.parameter`, with the vine in brackets where it has one of its own."""
        return f"{self.key}[{self.vine}]" if self.vine else self.key

    def to_scaled(self, value: float) -> float:
        """The value as the fit holds it.

        Parameters
        ----------
        value : float, SI

        Returns
        -------
        float
        """
        if self.logarithmic:
            return math.log(max(value, LEAST_DAMPING))
        return value / self.scale

    def from_scaled(self, theta: float) -> float:
        """The value, SI, of what the fit holds.

        Parameters
        ----------
        theta : float
            As the fit holds it.

        Returns
        -------
        float
        """
        return math.exp(theta) if self.logarithmic else theta * self.scale

    def derivative(self, value: float) -> float:
        """By how much the value changes for a change of one in what the fit holds.

        Parameters
        ----------
        value : float, SI

        Returns
        -------
        float
        """
        return self.from_scaled(self.to_scaled(value)) if self.logarithmic else self.scale


@dataclass(frozen=True)
class ParameterMap:
    """The free numbers in order, and which of them each trial feels.

    `index`, shape (n_trials, n_keys), gives the place among `free` of each key for each trial, -1 where a trial does
    not feel it. Every trial sees as many columns as there are keys, however many vines there are.
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
        """1/sd² of the priors in scaled units, shape (n_free,); 0 where there is none."""
        return np.array([(number.scale / number.prior_sd) ** 2 for number in self.free])

    def values(self, theta: Floats) -> Floats:
        """Values in SI, shape (n_free,).

        Parameters
        ----------
        theta : array, shape (n_free,)
            As the fit holds them.

        Returns
        -------
        array, shape (n_free,)
        """
        return np.array([number.from_scaled(float(scaled)) for number, scaled in zip(self.free, theta, strict=True)])

    def rows(self, theta: Floats) -> tuple[Floats, Floats]:
        """Model parameters (n_trials, n_parameters) and yield pressures (n_trials,), Pa, for scaled values `theta`.

        Parameters
        ----------
        theta : array, shape (n_free,)
            As the fit holds them.

        Returns
        -------
        rows : array, shape (n_trials, n_parameters), SI
        yields : array, shape (n_trials,), Pa
            NaN where the sheet's value holds.
        """
        rows = self.base.copy()
        values = self.values(theta)
        yields = np.full(rows.shape[0], math.nan)
        for column, key in enumerate(self.keys):
            felt = self.index[:, column] >= 0
            if key == YIELD_PRESSURE:
                yields[felt] = values[self.index[felt, column]]
            elif key in self.model.parameter_names:
                rows[felt, self.model.parameter_names.index(key)] = values[self.index[felt, column]]
        return rows, yields

    def term(self, key: str) -> BetweenTerm | None:
        """The difference between trials that this key is the coefficient of; None for a parameter of the model.

        Parameters
        ----------
        key : str
            A key of the map.

        Returns
        -------
        BetweenTerm or None
        """
        return next((term for term in self.between if term.key == key), None)

    @property
    def random(self) -> NDArray[np.bool_]:
        """Which free numbers are random effects of a group of trials, shape (n_free,)."""
        keys = {term.key for term in self.between if math.isfinite(term.prior_sd)}
        return np.array([number.key in keys for number in self.free], dtype=bool)

    def shifts(self, theta: Floats) -> Floats:
        """Deviations of pressure (relative) and of ln B by the differences between trials, shape (n_trials, 2).

        Parameters
        ----------
        theta : array, shape (n_free,)
            As the fit holds them.

        Returns
        -------
        array, shape (n_trials, 2)
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
    """Decide which numbers are free.

    By default every parameter of every effect is, but those that are `held` (g); and the yield pressure of each vine
    within the error the sheet gives it. A model of gravity alone then has no free number: a g that adapts itself would
    take up the drag of a falling body.

    Parameters
    ----------
    model : sum of effects with its values.
    data : sequence of FitTrial
    fixed, free : iterable of str
        Names to hold at the value of the model, or to find although held. The parameter's own name will do where it is
        the only one of that name.
    shared : mapping, optional
        `"all"`, `"vine"` or `"day"` by name, in place of what the effect says.
    between : sequence of BetweenTerm
        Differences between trials that are fitted along.

    Returns
    -------
    ParameterMap

    Raises
    ------
    FitError
        If a name is not that of any parameter.
    """
    known = {f"{effect.name}.{parameter.name}": parameter for effect in model for parameter in effect.parameters}
    names = [*known, *([YIELD_PRESSURE] if "yield_pressure" in model else [])]
    held = {_find_name(name, names) for name in fixed}
    wanted = {_find_name(name, names) for name in free}
    sharing = {_find_name(name, names): how for name, how in (shared or {}).items()}
    for name, how in sharing.items():
        if how not in ("all", "vine", "day"):
            raise FitError(f"{name} is shared by {how!r}: say 'all', 'vine' or 'day'.")
    chosen = [name for name in known if name not in held and (name in wanted or not known[name].held)]
    trials = [trial_data.trial for trial_data in data]
    base = np.array([model.parameters_of(trial) for trial in trials])
    base = base.reshape(len(data), len(model.parameter_names))
    numbers: list[FreeParameter] = []
    index = np.full((len(data), 0), -1)
    for name in chosen:
        how = sharing.get(name, known[name].shared)
        groups, members = groups_of(trials, how), group_names(trials, how)
        places = {group: len(numbers) + i for i, group in enumerate(members)}
        numbers += [_number(name, known[name], group, base[groups.index(group)], model) for group in members]
        index = np.column_stack([index, [places[group] for group in groups]])
    keys = list(chosen)
    if YIELD_PRESSURE in names and YIELD_PRESSURE not in held:
        yield_numbers, column = _yield_pressures(data, len(numbers))
        if yield_numbers:
            numbers, keys, index = [*numbers, *yield_numbers], [*keys, YIELD_PRESSURE], np.column_stack([index, column])
    for term in between:
        members = [group for group in dict.fromkeys(term.groups) if group]
        place = {group: len(numbers) + i for i, group in enumerate(members)} | {"": -1}
        numbers += [_coefficient(term, group) for group in members]
        keys, index = [*keys, term.key], np.column_stack([index, [place[group] for group in term.groups]])
    return ParameterMap(model, tuple(numbers), tuple(keys), index.astype(int), base, tuple(between))


def groups_of(trials: Sequence[Trial], shared: str) -> list[str]:
    """For each trial the name of those that share a number with it; blank for all.

    Days count where the sheet states several, and one for every trial.

    Parameters
    ----------
    trials : sequence of Trial
    shared : str
        `all`, `vine` or `day`.

    Returns
    -------
    list of str
    """
    groups = [trial.group(shared) for trial in trials]
    if shared == "day" and (not all(groups) or len(set(groups)) == 1):
        return [""] * len(groups)
    return groups


def group_names(trials: Sequence[Trial], shared: str) -> list[str]:
    """Names of the groups of trials that share a number.

    Parameters
    ----------
    trials : sequence of Trial
    shared : str
        `all`, `vine` or `day`.

    Returns
    -------
    list of str
        Vines in the order of the trials, days in their own: 2 before 10.
    """
    names = list(dict.fromkeys(groups_of(trials, shared)))
    return sorted(names, key=lambda name: (len(name), name)) if shared == "day" else names


def _coefficient(term: BetweenTerm, group: str) -> FreeParameter:
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
    """The full name among `names` that `name` stands for.

    Raises
    ------
    FitError
        If it stands for none, or for several; the message suggests.
    """
    if name in names:
        return name
    short = [full for full in names if full.split(".")[1] == name]
    if len(short) == 1:
        return short[0]
    near = short or difflib.get_close_matches(name, names, n=1, cutoff=0.4) or list(names)
    raise FitError(f"No parameter of the model is named {name!r}: say {' or '.join(near)}.")


def _number(name: str, parameter: Parameter, vine: str, values: Floats, model: Model) -> FreeParameter:
    value = float(values[model.parameter_names.index(name)])
    low, high = parameter.plausible or parameter.bounds
    width = high - low if math.isfinite(high - low) else max(abs(parameter.default), 1.0)
    tries = (low + 0.5 * width,) if math.isfinite(low) and name not in (DAMPING, EXPONENT) else ()
    return FreeParameter(
        key=name,
        vine=vine,
        symbol=parameter.symbol,
        unit=parameter.unit,
        start=float(np.clip(value, *parameter.bounds)),
        lower=parameter.bounds[0],
        upper=parameter.bounds[1],
        scale=max(abs(value), 0.3 * width) or 1.0,
        tries=tries,
        logarithmic=name == DAMPING,
    )


def _yield_pressures(data: Sequence[FitTrial], offset: int) -> tuple[list[FreeParameter], NDArray[np.int_]]:
    """One yield pressure for each vine and stated value, known to the error of the sheet."""
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
