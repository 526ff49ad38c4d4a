"""Extension of a fitted hypothesis to trials that have not been made.

The free parameters of the fit stay as they are. Every new vine adds its own: B from the scaling prior, multiplied by
the mean ratio of the measured vines to their prior, and the yield pressure with the error to which it will be measured.
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

NEW_VINE_SD = 1.0  # Prior standard deviation of the parameters of a new vine, scaled as in the fit (chosen)


# Factors on the between-trial standard deviations of pressure and B that a refit may estimate (chosen)
SCATTER_FACTORS = ((1.0, 1.0), (2.0, 1.0), (1.0, 2.0), (2.0, 2.0), (4.0, 2.0), (2.0, 5.0), (4.0, 5.0))


@dataclass(frozen=True)
class ScatterLevel:
    """Likelihood of the trials so far near the best values, for one assumed pair of between-trial standard deviations.
    `information`, shape (n_free, n_free), and `gradient`, shape (n_free,), of half the sum of squares at the best
    values; the gradient is not zero at a bound.
    """

    spread: tuple[float, float]
    factors: tuple[float, float]
    information: Floats
    gradient: Floats
    rise: float


@dataclass(frozen=True)
class Hypothesis:
    """One of the tied fits, extended to further conditions. `layout` maps the free parameters to the trials of the
    conditions: those of the fit first, then those of new vines. All are scaled as in the fit; `theta`, shape (n_free,),
    are their best values.
    """

    name: str
    fit: Fit
    layout: ParameterMap
    theta: Floats
    scatter_levels: tuple[ScatterLevel, ...]
    sd_of_new: Floats
    rho: float
    variance: float
    spread: tuple[float, float]

    @property
    def room(self) -> tuple[Floats, Floats]:
        """Distance of each parameter to its lower and upper bound, shape (n_free,) each; the first is negative."""
        lower, upper = self.layout.bounds
        return np.minimum(lower - self.theta, 0.0), np.maximum(upper - self.theta, 0.0)

    def layout_of(self, places: Sequence[int]) -> ParameterMap:
        """Return the parameter map of some of the conditions."""
        return replace(self.layout, index=self.layout.index[list(places)], base=self.layout.base[list(places)])

    def predictor(self, places: Sequence[int], items: Sequence[FitTrial]) -> Predictor:
        """Return a predictor of these trials, one for each of the conditions at `places`."""
        predictor = Predictor(self.layout_of(places), items, self.fit.predictor.host)
        predictor.steps = self.fit.predictor.steps.copy()
        return predictor


def extend(fit: Fit, name: str, conditions: Sequence[Condition]) -> Hypothesis:
    """Extend a fit to further conditions; new vines add parameters with priors."""
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
    precision_of_new = np.array([1 / NEW_VINE_SD**2 + (number.scale / number.prior_sd) ** 2 for number in added])
    sd_of_new = [damping_scatter() if number.key == DAMPING else _stated_sd(number) for number in added]
    base = np.array([_base_row(fit, condition) for condition in conditions])
    return Hypothesis(
        name=name,
        fit=fit,
        layout=ParameterMap(old.model, tuple(numbers), old.keys, np.array(index).reshape(len(conditions), -1), base),
        theta=np.concatenate([state.theta, [number.to_scaled(number.start) for number in added]]),
        scatter_levels=_scatter_levels(fit, precision_of_new),
        sd_of_new=np.array(sd_of_new),
        rho=state.rho,
        variance=float(np.exp(np.mean(np.log(state.variance)))),
        spread=state.spread,
    )


def _scatter_levels(fit: Fit, precision_of_new: Floats) -> tuple[ScatterLevel, ...]:
    """Likelihood of the trials so far at every scatter that a refit may estimate; new parameters have only priors."""
    state, problem = fit.solution.state, fit.solution.problem
    reduced = marginal(fit.solution.cross_products, problem, state)
    levels: dict[tuple[float, float], ScatterLevel] = {}
    as_fitted = 0.0
    for factors in SCATTER_FACTORS:
        spread = tuple(
            min(s * factor, most) if can and s > LEAST_BETWEEN_TRIAL_SD else s
            for s, factor, most, can in zip(state.spread, factors, LARGEST_SPREAD, fit.solution.estimable, strict=True)
        )
        pair = (max(spread[0], LEAST_BETWEEN_TRIAL_SD), max(spread[1], LEAST_BETWEEN_TRIAL_SD))
        if pair in levels:
            continue
        of_old, gradient_of_old, square, log_det = normal_equations(reduced, problem, state, pair)
        old, size = gradient_of_old.size, gradient_of_old.size + precision_of_new.size
        information = np.zeros((size, size))
        information[:old, :old] = of_old
        information[range(old, size), range(old, size)] = precision_of_new
        as_fitted = as_fitted if levels else square + log_det
        ratios = (
            pair[0] / max(state.spread[0], LEAST_BETWEEN_TRIAL_SD),
            pair[1] / max(state.spread[1], LEAST_BETWEEN_TRIAL_SD),
        )
        gradient = np.concatenate([gradient_of_old, np.zeros(size - old)])
        levels[pair] = ScatterLevel(pair, ratios, information, gradient, square + log_det - as_fitted)
    return tuple(levels.values())


def _stated_sd(number: FreeParameter) -> float:
    return number.prior_sd / number.scale if math.isfinite(number.prior_sd) else 0.0


def _vine_of(fit: Fit, condition: Condition) -> str:
    return fit.predictor.data[condition.like].trial.vine


def _of_new_vine(fit: Fit, like: FreeParameter, trial: Trial) -> FreeParameter:
    """The parameter of a new vine that replaces the one of the vine it is modelled on."""
    if like.key == YIELD_PRESSURE:
        return replace(like, vine=trial.vine, start=trial.yield_pressure_Pa)
    start = _new_damping(fit, trial) if like.key == DAMPING else _mean_of_vines(fit, like.key)
    return replace(like, vine=trial.vine, start=float(np.clip(start, like.lower, like.upper)))


def _mean_of_vines(fit: Fit, key: str) -> float:
    return float(np.mean([number.value for number in fit.numbers if number.key == key]))


def _new_damping(fit: Fit, trial: Trial) -> float:
    """B of a vine not yet made, N·(s/m)ⁿ: its scaling prior times the mean ratio of measured vines to their prior."""
    sizes = {
        trial_data.trial.vine: trial_data.trial
        for trial_data in fit.predictor.data
        if trial_data.trial.travel_ratio != 1
    }
    column = fit.predictor.damping_column
    rows, _ = fit.predictor.layout.rows(fit.solution.state.theta)
    grown = {trial_data.trial.vine: float(rows[i, column]) for i, trial_data in enumerate(fit.predictor.data)}
    log_ratios = [
        math.log(max(grown[vine], 1e-9) / damping_prior(trial_of_vine.diameter_m, trial_of_vine.thickness_m))
        for vine, trial_of_vine in sizes.items()
    ]
    return damping_prior(trial.diameter_m, trial.thickness_m) * math.exp(float(np.mean(log_ratios)))


def _base_row(fit: Fit, condition: Condition) -> Floats:
    """Model parameters of a condition: those of the trial it is modelled on, with the B of the new vine."""
    rows, _ = fit.predictor.layout.rows(fit.solution.state.theta)
    row = np.array(rows[condition.like])
    if fit.predictor.damping_column >= 0 and condition.trial.vine != _vine_of(fit, condition):
        row[fit.predictor.damping_column] = _new_damping(fit, condition.trial)
    return row
