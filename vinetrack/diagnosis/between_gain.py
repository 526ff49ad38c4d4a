"""Likelihood gain of a difference between trials, from the linear mixed model of a fit, without simulations."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.diagnosis.result import N_BY_VINE
from vinetrack.inference.fit_result import Fit
from vinetrack.inference.fit_summary import FILM
from vinetrack.inference.marginal_likelihood import (
    deviance,
    deviations_eliminated,
    estimate_between_trial_sd,
    marginal,
    normal_equations,
    profiled_deviance,
)
from vinetrack.inference.mixed_effects import FitState, MixedProblem
from vinetrack.inference.optimiser import Solution, is_poor_fit, make_problem
from vinetrack.inference.parameters import BetweenTerm, ParameterMap, make_layout
from vinetrack.inference.position_errors import with_shapes, with_smooth_errors
from vinetrack.inference.robust_covariance import Systematics, film_errors, recorded_pressures, systematics_of
from vinetrack.inference.sensitivity import DAMPING_DEVIATION, N_TRIAL_EFFECTS, PRESSURE, Predictor


@dataclass(frozen=True)
class Difference:
    """One hypothesis that trials differ."""

    name: str
    terms: tuple[BetweenTerm, ...] = ()
    shared: Mapping[str, str] = field(default_factory=dict)
    stated: bool = True
    confounded: bool = True
    n_forms: int = 1
    gain: float = 0.0
    p: float = 1.0

    @property
    def penalised_gain(self) -> float:
        """Fall of −2 ln L less the penalty 2 ln(`n_forms`) for the choice among forms."""
        return self.gain - 2 * math.log(self.n_forms)


def gain_p_value(fit: Fit, difference: Difference, gain: float) -> float:
    """p-value of a gain where trials do not differ. For fixed coefficients by the F test, LR = N ln(1 + q F / dof),
    because χ² would be anticonservative for few trials. For random effects exp(gain / 2) is a Bayes factor K, and P(K >
    1/α) ≤ α by Markov's inequality. Returns 0 to 1.
    """
    from scipy.stats import f as fisher

    if gain <= 0:
        return 1.0
    if any(math.isfinite(term.prior_sd) for term in difference.terms):
        return min(1.0, math.exp(-0.5 * gain))
    trials = len(fit.trials)
    vines = len({trial.trial.vine for trial in fit.trials})
    extra = vines - 1 if difference.name == N_BY_VINE else len(difference.terms)
    spare = max(trials - int(np.count_nonzero(fit.predictor.layout.prior_precision == 0)) - extra, 1)
    return float(fisher.sf(math.expm1(min(gain / trials, 500.0)) * spare / extra, extra, spare))


def linear_gain(fit: Fit, base: Solution, difference: Difference, spread: tuple[float, float] | None = None) -> float:
    """Predicted fall of −2 ln L with a difference, from the sensitivities of the fit. The deviation of each trial is a
    column of the linear mixed model already, and the columns of the coefficients are multiples of it. Returns fall of
    −2 ln L.
    """
    cross_products, problem, state = _widened(fit, base, difference)
    before = marginal(base.cross_products, base.problem, base.state)
    after = marginal(cross_products, problem, state)
    if spread is None:
        sd_before = estimate_between_trial_sd(before, base.problem, base.state, base.estimable, restricted=False)
        sd_after = estimate_between_trial_sd(after, problem, state, base.estimable, restricted=False)
    else:
        sd_before = sd_after = spread
    deviance_before = deviance(before, base.problem, base.state, sd_before, restricted=False)
    return deviance_before - deviance(after, problem, state, sd_after, restricted=False)


def with_shared_errors(fit: Fit, base: Solution) -> Solution:
    """Add the shared systematic errors of payloads, set pressures and trackers to a solution as nuisance parameters.
    They are common to all replicates of a condition. With enough replicates they exceed the scatter of trials, and
    would pass for a difference between groups of conditions.
    """
    return with_errors(fit, base, systematics_of(fit.predictor, fit.solution, fit.trials, positions=False))


def with_trace_errors(fit: Fit, base: Solution) -> Solution:
    """Add the errors of recorded pressures to a solution as parameters, with the corrections of its fit undone."""
    return with_errors(fit, base, recorded_pressures(fit.predictor, fit.solution))


def with_errors(fit: Fit, base: Solution, errors: Systematics) -> Solution:
    """Add errors to a solution as parameters, each with a prior of mean 0 and standard deviation 1."""
    if not errors.n_columns:
        return base
    columns = [
        np.column_stack([of_fit[:, :-1], systematic, of_fit[:, -1]])
        for of_fit, systematic in zip(errors.at_zero_errors(base.columns), errors.columns, strict=True)
    ]
    places = np.where(errors.places < errors.count, base.problem.prior_mean.size + errors.places, -1)
    problem = with_shapes(base.problem, errors.count)
    return replace(
        base,
        state=replace(base.state, theta=np.append(base.state.theta, np.zeros(errors.count))),
        problem=replace(problem, index=np.column_stack([base.problem.index, places])),
        cross_products=fit.predictor.products(columns),
        columns=tuple(columns),
    )


def gains_by_onset(
    fit: Fit, base: Solution, difference: Difference, members: Sequence[int], onsets: Iterable[int]
) -> list[float]:
    """`linear_gain` of a difference for each of several onsets of its group. Between-trial standard deviations stay
    those of the solution. The contribution of each trial to the sums over trials is removed in turn, so that all onsets
    take little longer than one.
    """
    cross_products, problem, state = _widened(fit, base, difference)
    spread = base.state.spread
    deviance_before = deviance(
        marginal(base.cross_products, base.problem, base.state), base.problem, base.state, spread, restricted=False
    )
    marginals = marginal(cross_products, problem, state)
    information, gradient, square, log_det = normal_equations(marginals, problem, state, spread)
    constant = square + log_det + marginals.log_constant
    blocks, _ = deviations_eliminated(marginals, problem, spread)
    places, shapes = problem.places, base.problem.index.shape[1] - len(fit.predictor.layout.keys)
    end_of_terms = places.shape[1] - shapes
    of_term = np.zeros(places.shape[1], dtype=bool)
    of_term[end_of_terms - len(difference.terms) : end_of_terms] = True
    affected = of_term[:, None] | of_term
    # One more row for keys to which a trial does not respond.
    information, gradient = np.pad(information, (0, 1)), np.append(gradient, 0.0)
    gains: list[float] = []
    removed = 0
    for onset in onsets:
        for i in members[removed:onset]:
            np.subtract.at(information, (places[i][:, None], places[i]), np.where(affected, blocks[i, :-1, :-1], 0.0))
            np.subtract.at(gradient, places[i][of_term], blocks[i, :-1, -1][of_term])
        removed = onset
        deviance_after = profiled_deviance(
            information[:-1, :-1], gradient[:-1], constant, problem, state, restricted=False
        )
        gains.append(deviance_before - deviance_after)
    return gains


def _widened(fit: Fit, base: Solution, difference: Difference) -> tuple[Floats, MixedProblem, FitState]:
    """Cross products, problem and state of a solution with the coefficients of a difference added, all zero."""
    old, state = fit.predictor.layout, base.state
    data, options = fit.predictor.data, fit.options
    layout = make_layout(
        old.model, data, fixed=options["fixed"], free=options["free"],
        shared={**options["shared"], **difference.shared}, between=(*old.between, *difference.terms),
    )  # fmt: skip
    problem = make_problem(Predictor(layout, data, fit.predictor.host), state.trial_effects)
    problem = replace(problem, release_origin_mean=base.problem.release_origin_mean)
    theta = layout.start
    known = {number.name: number.from_scaled(float(at)) for number, at in zip(old.free, state.theta, strict=False)}
    for k, number in enumerate(layout.free):
        value = known.get(number.name, known.get(number.key))
        theta[k] = theta[k] if value is None else number.to_scaled(value)
    shapes = base.problem.index.shape[1] - len(old.keys)
    if shapes:
        error_values, error_index = state.theta[len(old.free) :], base.problem.index[:, len(old.keys) :]
        shifted = np.where(error_index < 0, -1, error_index - len(old.free) + len(layout.free))
        problem = replace(with_shapes(problem, error_values.size), index=np.column_stack([problem.index, shifted]))
        theta = np.append(theta, error_values)
    T = _column_map(old, layout, shapes)
    cross_products = np.einsum("nka,nckl,nlb->ncab", T, base.cross_products, T, optimize=True)
    return cross_products, problem, replace(state, theta=theta)


def _column_map(old: ParameterMap, layout: ParameterMap, shapes: int) -> Floats:
    """Matrices that map the columns of one layout to those of another, shape (n_trials, n_columns before, after).
    Columns are those of the trial effects, the keys, the shapes of smooth errors, and the residual.
    """
    count, size = len(old.keys), N_TRIAL_EFFECTS + len(layout.keys) + shapes + 1
    matrix = np.zeros((len(layout.index), N_TRIAL_EFFECTS + count + shapes + 1, size))
    matrix[:, range(N_TRIAL_EFFECTS), range(N_TRIAL_EFFECTS)] = 1.0
    errors_and_residual = np.arange(shapes + 1)
    matrix[
        :, N_TRIAL_EFFECTS + count + errors_and_residual, N_TRIAL_EFFECTS + len(layout.keys) + errors_and_residual
    ] = 1.0
    before_scale = np.array([number.scale for number in old.free] + [1.0])
    scale = np.array([number.scale for number in layout.free] + [0.0])
    logarithmic = np.array([number.logarithmic for number in layout.free] + [False])
    for column, key in enumerate(layout.keys):
        term, place = layout.term(key), layout.index[:, column]
        if term is not None and key not in old.keys:
            source = PRESSURE if term.pressure else DAMPING_DEVIATION
            matrix[:, source, N_TRIAL_EFFECTS + column] = np.where(place >= 0, term.scale * term.regressor, 0.0)
            continue
        former = old.keys.index(key)
        ratio = scale[place] / before_scale[old.index[:, former]]
        matrix[:, N_TRIAL_EFFECTS + former, N_TRIAL_EFFECTS + column] = np.where(logarithmic[place], 1.0, ratio)
    return matrix


# ------------------------------------------------------------------------------
# Gain of a hypothesis if the film mass of each vine is a nuisance parameter.
#
# Which of two effects has the higher likelihood may depend on the mass of the film: where the truth was a drag on
# film that is 1.5 % lighter than stated, a wrong scale was ahead of it by Δχ² 27. A hypothesis is therefore not
# excluded if it fits as well as the best once the film mass of every vine is free within its usual error. The tests
# of whether anything is missing use the stated mass: there a wrong film mass is a hypothesis of its own, `film_mass`.


def film_gain(fit: Fit) -> float:
    """Fall of −2 ln L with a relative error ε ~ N(0, `FILM_ERROR`²) of each vine's film mass, by linear algebra. ε
    takes its best value, with its prior as a penalty; it is not integrated out. Returns at least 0; 0 for a fit that is
    far off, has a free film mass already, or does not depend on it.
    """
    if FILM in fit.model or is_poor_fit(fit.predictor, fit.solution):
        return 0.0
    errors = film_errors(fit.predictor, fit.solution, fit.trials)
    if not errors.n_columns:
        return 0.0
    base = with_smooth_errors(fit)
    return max(_deviance(base, base) - _deviance(with_errors(fit, base, errors), base), 0.0)


def _deviance(solution: Solution, base: Solution) -> float:
    """−2 ln L, minimised over the parameters and over the between-trial standard deviations that `base` estimates."""
    part, problem, state = (
        marginal(solution.cross_products, solution.problem, solution.state),
        solution.problem,
        solution.state,
    )
    spread = estimate_between_trial_sd(part, problem, state, base.estimable, restricted=False)
    return deviance(part, problem, state, spread, restricted=False)
