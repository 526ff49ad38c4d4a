"""What a fitted hypothesis says of trials that have not been made.

The free numbers of the fit stay as they are; every new vine adds its own: B from the guess for vines not built, brought
to the level of the vines that were measured, and its yield pressure within the error it will be measured to.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from vinetrack.core.records import Floats, Trial
from vinetrack.inference.fit_data import FitTrial
from vinetrack.inference.fit_result import Fit
from vinetrack.inference.marginal_likelihood import LARGEST_SPREAD, marginal, normal_equations
from vinetrack.inference.mixed_effects import LEAST_BETWEEN_TRIAL_SD
from vinetrack.inference.parameters import DAMPING, YIELD_PRESSURE, FreeParameter, ParameterMap
from vinetrack.inference.sensitivity import Predictor
from vinetrack.planning.feasible_trials import Condition
from vinetrack.planning.scaling_priors import damping_prior, damping_scatter

OPEN = 1.0
"""Standard deviation given to a new vine's own numbers, in the units of the fit (of ln B that is a factor of e): so
wide that any trial with the vine says more."""


WIDER = ((1.0, 1.0), (2.0, 1.0), (1.0, 2.0), (2.0, 2.0), (4.0, 2.0), (2.0, 5.0), (4.0, 5.0))
"""Factors on the spreads of pressure and B that a refit may come to: a wrong hypothesis explains by scatter what it
can. Chosen: up to what scatter real batches show. Reasoned: without the last a wrong hypothesis is rated as separated
where five times the scatter of B would hide it; with twice as wide ones the rating hardly changes, since scatter costs
ln L."""


@dataclass(frozen=True)
class View:
    """What the trials so far say of a hypothesis' numbers if pressure and B scatter by `spread` from trial to trial.

    `information`, shape (n_free, n_free), and `slope`, shape (n_free,), of half the sum of squares at the best values;
    the slope is not zero at a bound. `rise` is by how much −2 ln L rises when the spreads are these instead of those
    fitted, `factors` how much wider they are.
    """

    spread: tuple[float, float]
    factors: tuple[float, float]
    information: Floats
    slope: Floats
    rise: float


@dataclass(frozen=True)
class Hypothesis:
    """One of the fits that are tied, carried to further conditions.

    `layout` places the free numbers in the conditions' trials: those of the fit first, then those of new vines. All
    numbers are scaled as the fit holds them, `theta` their best values, shape (n_free,). `views` tell what is known of
    them from the trials so far, as fitted and with more scatter. `spread_of_new` is how far the numbers of new vines
    may truly lie from their values here. `rho` and `variance` are the noise's correlation and the variance of its
    innovations, m²; `spread` the relative ones of pressure and B.
    """

    name: str
    fit: Fit
    layout: ParameterMap
    theta: Floats
    views: tuple[View, ...]
    spread_of_new: Floats
    rho: float
    variance: float
    spread: tuple[float, float]

    @property
    def room(self) -> tuple[Floats, Floats]:
        """How far each number may go down and up, shape (n_free,) each."""
        lower, upper = self.layout.bounds
        return np.minimum(lower - self.theta, 0.0), np.maximum(upper - self.theta, 0.0)

    def layout_of(self, places: Sequence[int]) -> ParameterMap:
        """The layout of some conditions.

        Parameters
        ----------
        places : sequence of int
            Places among the conditions.

        Returns
        -------
        ParameterMap
        """
        return replace(self.layout, index=self.layout.index[list(places)], base=self.layout.base[list(places)])

    def predictor(self, places: Sequence[int], items: Sequence[FitTrial]) -> Predictor:
        """Simulates these trials, one for each of the conditions at `places`.

        Parameters
        ----------
        places : sequence of int
            Places among the conditions.
        items : sequence of FitTrial
            The trial to simulate at each place.

        Returns
        -------
        Predictor
            With the step sizes of the fit.
        """
        made = Predictor(self.layout_of(places), items, self.fit.predictor.host)
        made.steps = self.fit.predictor.steps.copy()
        return made


def carry(fit: Fit, name: str, conditions: Sequence[Condition]) -> Hypothesis:
    """A fit carried to further conditions: new vines add their numbers, with priors.

    Parameters
    ----------
    fit : one of the fits that the data cannot tell apart.
    name : str
        Name of the hypothesis.
    conditions : trials that could be made.

    Returns
    -------
    Hypothesis
    """
    old = fit.predictor.layout
    state = fit.solution.state
    numbers, index = list(old.free), []
    places: dict[tuple[str, str], int] = {}
    for condition in conditions:
        row = old.index[condition.like].copy()
        for column, key in enumerate(old.keys):
            if row[column] >= 0 and old.free[row[column]].vine and condition.trial.vine != _vine_of(fit, condition):
                spot = (key, condition.trial.vine)
                if spot not in places:
                    places[spot] = len(numbers)
                    numbers.append(_of_new_vine(fit, old.free[row[column]], condition.trial))
                row[column] = places[spot]
        index.append(row)
    added = numbers[len(old.free) :]
    moved = [damping_scatter() if number.key == DAMPING else _stated_sd(number) for number in added]
    base = np.array([_base_row(fit, condition) for condition in conditions])
    return Hypothesis(
        name=name,
        fit=fit,
        layout=ParameterMap(old.model, tuple(numbers), old.keys, np.array(index).reshape(len(conditions), -1), base),
        theta=np.concatenate([state.theta, [number.to_scaled(number.start) for number in added]]),
        views=_views(fit, np.array([1 / OPEN**2 + (number.scale / number.prior_sd) ** 2 for number in added])),
        spread_of_new=np.array(moved),
        rho=state.rho,
        variance=float(np.exp(np.mean(np.log(state.variance)))),
        spread=state.spread,
    )


def _views(fit: Fit, precision_of_new: Floats) -> tuple[View, ...]:
    """What the trials so far say, with all the scatter that a refit may come to; new numbers by their priors alone."""
    state, problem = fit.solution.state, fit.solution.problem
    part = marginal(fit.solution.cross_products, problem, state)
    views: dict[tuple[float, float], View] = {}
    plain = 0.0
    for factors in WIDER:
        spread = tuple(
            min(s * factor, most) if can and s > LEAST_BETWEEN_TRIAL_SD else s
            for s, factor, most, can in zip(state.spread, factors, LARGEST_SPREAD, fit.solution.estimable, strict=True)
        )
        pair = (max(spread[0], LEAST_BETWEEN_TRIAL_SD), max(spread[1], LEAST_BETWEEN_TRIAL_SD))
        if pair in views:
            continue
        information, slope, square, log_det = normal_equations(part, problem, state, pair)
        old, size = slope.size, slope.size + precision_of_new.size
        wide = np.zeros((size, size))
        wide[:old, :old] = information
        wide[range(old, size), range(old, size)] = precision_of_new
        plain = plain if views else square + log_det
        wider = (
            pair[0] / max(state.spread[0], LEAST_BETWEEN_TRIAL_SD),
            pair[1] / max(state.spread[1], LEAST_BETWEEN_TRIAL_SD),
        )
        leans = np.concatenate([slope, np.zeros(size - old)])
        views[pair] = View(pair, wider, wide, leans, square + log_det - plain)
    return tuple(views.values())


def _stated_sd(number: FreeParameter) -> float:
    return number.prior_sd / number.scale if math.isfinite(number.prior_sd) else 0.0


def _vine_of(fit: Fit, condition: Condition) -> str:
    return fit.predictor.data[condition.like].trial.vine


def _of_new_vine(fit: Fit, like: FreeParameter, trial: Trial) -> FreeParameter:
    """The number of a new vine in place of that of the vine it is modelled on."""
    if like.key == YIELD_PRESSURE:
        return replace(like, vine=trial.vine, start=trial.yield_pressure_Pa)
    start = _new_damping(fit, trial) if like.key == DAMPING else _mean_of_vines(fit, like.key)
    return replace(like, vine=trial.vine, start=float(np.clip(start, like.lower, like.upper)))


def _mean_of_vines(fit: Fit, key: str) -> float:
    return float(np.mean([number.value for number in fit.numbers if number.key == key]))


def _new_damping(fit: Fit, trial: Trial) -> float:
    """B of a vine that has not been grown, N·(s/m)ⁿ: the guess by size, times what the grown vines differ from it."""
    sizes = {
        trial_data.trial.vine: trial_data.trial
        for trial_data in fit.predictor.data
        if trial_data.trial.travel_ratio != 1
    }
    column = fit.predictor.damping_column
    rows, _ = fit.predictor.layout.rows(fit.solution.state.theta)
    grown = {trial_data.trial.vine: float(rows[i, column]) for i, trial_data in enumerate(fit.predictor.data)}
    off = [
        math.log(max(grown[vine], 1e-9) / damping_prior(trial_of_vine.diameter_m, trial_of_vine.thickness_m))
        for vine, trial_of_vine in sizes.items()
    ]
    return damping_prior(trial.diameter_m, trial.thickness_m) * math.exp(float(np.mean(off)))


def _base_row(fit: Fit, condition: Condition) -> Floats:
    """Model parameters of a condition: those of the trial it is like, but for the B of a new vine."""
    rows, _ = fit.predictor.layout.rows(fit.solution.state.theta)
    row = np.array(rows[condition.like])
    if fit.predictor.damping_column >= 0 and condition.trial.vine != _vine_of(fit, condition):
        row[fit.predictor.damping_column] = _new_damping(fit, condition.trial)
    return row
