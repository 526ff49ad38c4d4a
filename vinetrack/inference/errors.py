"""Errors of fitted parameters, from systematic errors, few trials and the scatter of trials; and all that a fit states.

The systematic errors (`vinetrack.inference.systematics`) are parameters of the linearised fit, each with its prior. Its
likelihood compares hypotheses without crediting any of them with what such an error could explain.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, NamedTuple

import numpy as np
from scipy.special import stdtrit

from vinetrack.core.problems import Remark, remark
from vinetrack.core.records import Floats, Trial
from vinetrack.dynamics.model import values_by_key
from vinetrack.experiment.schema import GROUPINGS
from vinetrack.inference.fit_data import FitTrial
from vinetrack.inference.fit_result import (
    YIELD_PRESSURE,
    BetweenTrialSpread,
    Fit,
    FitSummary,
    Number,
    TrialEstimates,
    TrialFit,
)
from vinetrack.inference.gaussian_processes import whiten
from vinetrack.inference.marginal_likelihood import (
    Linearised,
    MixedProblem,
    inverse_of_block,
    matrix_root,
    solve_per_trial,
    with_diagonal,
)
from vinetrack.inference.optimiser import (
    CONVERGED_DECREASE,
    CONVERGED_VARIANCES,
    LARGEST_DEVIATION,
    Solution,
    chi2_per_dof,
    variance_change,
)
from vinetrack.inference.sensitivity import DAMPING_DEVIATION, N_TRIAL_EFFECTS, ORIGIN, PRESSURE
from vinetrack.inference.systematics import FILM_ERROR, systematics_of

# ------------------------------------------------------------------------------
# Uncertainty of the parameters of a fit: covariance and degrees of freedom.
#
# The covariance is the inverse information of the linearised mixed model, widened by the scatter of trials, with its
# degrees of freedom. A 95 % interval ends at the bounds of its parameter: near one it holds the truth more often.

LEAST_INFORMATION = 1e-6  # Information below which a parameter has no influence on the trajectories (chosen)


@dataclass(frozen=True)
class Precision:
    """Covariance of the free parameters, scaled, shape (n_free, n_free), infinite for undetermined ones: `insensitive`
    are those without influence on the trajectories, `collinear` those of which only a combination with others is
    determined. `degrees` of freedom of the errors, and the part of the variance that all trials share, by its source.
    """

    covariance: Floats
    insensitive: np.ndarray
    collinear: np.ndarray
    degrees: Floats = field(default_factory=lambda: np.empty(0))
    shared: Mapping[str, Floats] = field(default_factory=dict)


def precision(solution: Linearised) -> Precision:
    """Covariance at the end of a fit, from the model of noise and between-trial variation."""
    problem = solution.problem
    information = solution.information()[0].sum(axis=0) + np.diag(problem.prior_precision)
    diagonal = np.diag(information)
    insensitive = problem.free & ~(diagonal > LEAST_INFORMATION)
    k, collinear = np.flatnonzero(problem.free & ~insensitive), np.zeros(diagonal.size, dtype=bool)
    scale, covariance = 1 / np.sqrt(diagonal[k]), inverse_of_block(information, k)
    values, vectors = np.linalg.eigh(information[np.ix_(k, k)] * scale[:, None] * scale)
    # 1e-10: smallest eigenvalue of an information matrix of unit diagonal at which a direction counts as determined
    collinear[k] = (np.abs(vectors[:, values < 1e-10]) > 0.1).any(axis=1)
    unknown = np.flatnonzero(insensitive | collinear)
    covariance[unknown, unknown] = math.inf
    return Precision(covariance, insensitive, collinear)


def student(dof: Floats) -> Floats:
    """Half width of a 95 % interval in standard errors."""
    return np.asarray(stdtrit(np.minimum(dof, 1e6), 0.975))


class WithSystematics(NamedTuple):
    """A fit with its systematic errors as further parameters, in prior standard deviations, the source of each, and the
    gain of ln L over the fit as it is.
    """

    solution: Solution
    sources: Sequence[str]
    gain: float


def with_systematics(solution: Solution) -> WithSystematics:
    """Fit the systematic errors along with the parameters of a fit, to first order."""
    errors, free = systematics_of(solution), solution.problem.free
    # The column of a parameter without influence is rounding error: with fixed columns, a step along it would be
    # millions of scales long and predict a likelihood that no trajectory confirms.
    held = replace(solution.problem, free=free & ~precision(solution).insensitive)
    fixed = replace(solution, problem=held)
    reached, level = _newton_on_fixed_columns(errors.beside(fixed))
    problem = replace(reached.problem, free=np.append(free, np.ones(len(errors.sources), dtype=bool)))
    # A poor fit is not at its minimum, and the linear model overestimates the gain. That part is the same without the
    # errors, so it is subtracted.
    gain = level - _newton_on_fixed_columns(fixed)[1]
    return WithSystematics(replace(reached, problem=problem), errors.sources, gain)


def _newton_on_fixed_columns(solution: Solution) -> tuple[Solution, float]:
    """The solution after Newton steps at fixed sensitivities, while they raise ln L, and ln L there: two parameters
    that only rounding separates may get steps of any length along the direction in which they cancel.
    """
    index = solution.problem.index
    solution = solution.with_variances()
    level = solution.log_likelihood()
    # The columns C and r of a trial become C and r − CΔ, and so do their products.
    total_change = np.tile(np.eye(solution.cross_products.shape[-1]), (len(index), 1, 1))
    for _ in range(15):  # (measured)
        state = solution.state
        step, own_step, predicted_decrease = solution.step()
        change = np.zeros_like(total_change)
        change[:, :-1, -1] = -np.column_stack([own_step, np.append(step, 0.0)[index]])
        moved = np.eye(change.shape[-1]) + change
        products = np.swapaxes(moved, 1, 2)[:, None] @ solution.cross_products @ moved[:, None]
        before = replace(state, theta=state.theta + step, trial_effects=state.trial_effects + own_step)
        after = replace(solution, state=before, cross_products=products).with_variances()
        new_level = after.log_likelihood()
        if not new_level >= level - CONVERGED_DECREASE:  # nor is NaN taken
            break
        solution, level, total_change = after, new_level, total_change + change
        if predicted_decrease < CONVERGED_DECREASE and variance_change(before, after.state) < CONVERGED_VARIANCES:
            break
    columns = tuple(of_trial @ change for of_trial, change in zip(solution.columns, total_change, strict=True))
    return replace(solution, columns=columns), level


# ------------------------------------------------------------------------------
# Errors from the scatter of trials.
#
# The inverse information is the covariance only if noise and between-trial variation are as modelled. The scatter of
# the scores of single trials, or of the specimens or days that they share, gives a variance that only ever widens an
# error: the cluster-robust sandwich, without bias and with Satterthwaite degrees of freedom for few clusters (CR2: Bell
# & McCaffrey, Survey Methodology 28, 169, 2002).

FEWEST_CLUSTERS = 8  # Clusters from which their scatter counts in tests of a model (chosen)


def robust_variances(solution: Solution) -> tuple[Floats, Floats, Floats]:
    """Covariance of the free parameters by the noise model, (n_free, n_free); their variances from the scatter of
    trials, or of their clusters where these are larger, and the degrees of freedom of those, (n_free,).
    """
    problem, theta = solution.problem, solution.state.theta
    information, scores = solution.information()
    plain = _covariance_by_noise(solution, information)
    # Scores of a parameter add up to the pull of its prior, in equal parts from each trial that depends on it.
    depend = (problem.index[:, :, None] == np.arange(len(theta))).any(axis=1)
    scores -= depend * (scores.sum(axis=0) / np.maximum(depend.sum(axis=0), 1))
    variance, degrees = np.diag(plain), np.full(len(plain), np.inf)
    trials = [trial_data.trial for trial_data in solution.predictor.data]
    for groups in (range(len(trials)), coarsest_groups(trials)):
        by_scatter, few = scatter_variances(
            _summed_over(groups, information),
            _summed_over(groups, scores),
            problem,
            plain,
            len(solution.predictor.layout.free),
        )
        degrees = np.where((by_scatter > variance) | np.isinf(degrees), few, degrees)
        variance = np.maximum(variance, by_scatter)
    return plain, variance, degrees


def _covariance_by_noise(solution: Linearised, information: Floats) -> Floats:
    """Covariance of the unknowns by the noise model; those at a bound are fixed there."""
    problem, theta = solution.problem, solution.state.theta
    square = information.sum(axis=0) + np.diag(problem.prior_precision)
    inside = (theta > problem.lower) & (theta < problem.upper)
    return inverse_of_block(square, np.flatnonzero(problem.free & inside & (np.diag(square) > 0)))


def without(
    solution: Solution, information: Floats, scores: Floats, trials: Sequence[int]
) -> tuple[Floats, Floats] | None:
    """The step of the unknowns to the fit to all other trials, to first order, and a root of their covariance by those;
    None where those do not determine what these depend on.
    """
    problem, theta, kept = solution.problem, solution.state.theta, np.delete(information, trials, axis=0)
    by_all, by_others = (np.einsum("nkk->k", each) + problem.prior_precision for each in (information, kept))
    # 1e-6: part of the information on a parameter that must come from other trials (chosen)
    lost = problem.free & (by_others < by_all) & (by_others <= 1e-6 * by_all)
    if lost.any():
        return None
    root = matrix_root(_covariance_by_noise(solution, kept))
    # At the end of the fit the scores of all trials and the pull of the priors cancel.
    reached = theta - root @ (root.T @ scores[trials].sum(axis=0))
    return np.clip(reached, problem.lower, problem.upper) - theta, root


def scatter_variances(
    information: Floats, scores: Floats, problem: MixedProblem, plain: Floats, count: int
) -> tuple[Floats, Floats]:
    """Variances of the first `count` unknowns from the disagreement of clusters, and their degrees of freedom. Each
    cluster pulls the fit towards itself, by its share K_i of the information, and so shows less than its error: in
    units of the errors of the model its score has the variance K_i(1 − K_i), and is divided by √(1 − K_i).
    """
    variance, degrees = np.diag(plain).copy(), np.full(len(plain), np.inf)
    estimated = np.flatnonzero(np.diag(plain) > 0)
    if not estimated.size or len(scores) < 2:
        return variance, degrees
    root = matrix_root(plain[np.ix_(estimated, estimated)])
    score = scores[:, estimated] @ root
    shares = root.T @ information[:, estimated[:, None], estimated] @ root
    values, vectors = np.linalg.eigh(shares)
    # 0.99: share of the information on a direction from which one cluster is practically the only one to determine it
    # (chosen)
    shown = np.where(values < 0.99, 1 / np.sqrt(1 - np.clip(values, 0.0, 0.99)), 0.0)
    adjustments = (vectors * shown[:, None, :]) @ np.swapaxes(vectors, 1, 2)
    hidden = (vectors * np.where(values < 0.99, 0.0, values)[:, None, :]) @ np.swapaxes(vectors, 1, 2)
    constant = root.T @ np.diag(problem.prior_precision[estimated]) @ root + hidden.sum(axis=0)
    for k, place in enumerate(estimated[estimated < count].tolist()):
        weights_of_score = adjustments @ root[k]
        scatter = float(np.sum(np.einsum("nk,nk->n", weights_of_score, score) ** 2))
        moved = np.einsum("nij,nj->ni", shares, weights_of_score)
        expected = np.diag(np.einsum("ni,ni->n", weights_of_score, moved)) - moved @ moved.T
        known, shown_by = float(root[k] @ constant @ root[k]), max(scatter, float(np.trace(expected)))
        variance[place] = scatter + known
        if (squares := float(np.sum(expected**2))) > 0:
            degrees[place] = max(np.trace(expected) ** 2 / squares * (1 + known / shown_by) ** 2, 1.0)
    return variance, degrees


def widened_covariance(solution: Solution, model_precision: Precision, sources: Sequence[str]) -> Precision:
    """Covariance and degrees of freedom of the parameters of a fit with its systematic errors, the last unknowns, which
    come from these sources, widened by the scatter of trials.
    """
    plain, variance, few = robust_variances(solution)
    diagonal = np.diag(plain)
    ratio = np.sqrt(np.maximum(np.divide(variance, diagonal, out=np.ones_like(diagonal), where=diagonal > 0), 1.0))
    # Where the between-trial standard deviations are the usual ones, no trial had to tell them.
    degrees = np.where((ratio > 1) | any(solution.estimable), few, math.inf)
    covariance = model_precision.covariance
    covariance = np.where(np.isfinite(covariance), ratio[:, None] * ratio, 1.0) * covariance
    source_of = np.array([""] * (len(plain) - len(sources)) + list(sources))
    shared = {source: part * ratio**2 for source, part in shared_parts(plain, source_of).items()}
    if solution.problem.own_errors:
        exact = _with_known_pressures(solution)
        known_by = np.diag(_covariance_by_noise(exact, exact.information()[0]))
        shared["gauge"] = np.maximum(diagonal - known_by, 0.0) * ratio**2
    n = len(solution.predictor.layout.free)
    return Precision(
        covariance[:n, :n],
        model_precision.insensitive[:n],
        model_precision.collinear[:n],
        degrees[:n],
        {source: part[:n] for source, part in shared.items()},
    )


def shared_parts(covariance: Floats, source_of: np.ndarray) -> dict[str, Floats]:
    """What the variances of unknowns would lose if the errors from a source, blank for none, were known, (n_unknowns,);
    in all as much as if all were: where only a sum of errors is determined, each tells the others.
    """

    def known_by(chosen: np.ndarray) -> Floats:
        across = covariance[:, chosen]
        known = np.linalg.pinv(covariance[np.ix_(chosen, chosen)], hermitian=True)
        return np.asarray(np.sum((across @ known) * across, axis=1))

    parts = {str(source): known_by(source_of == source) for source in dict.fromkeys(source_of[source_of != ""])}
    apart = sum(parts.values(), np.zeros(len(covariance)))
    together = np.divide(known_by(source_of != ""), apart, out=np.ones_like(apart), where=apart > 0)
    return {source: part * together for source, part in parts.items()}


def _with_known_pressures(solution: Solution) -> Solution:
    """The solution without the errors that gauges leave in single trials."""
    own = np.s_[N_TRIAL_EFFECTS : solution.problem.n_effects]
    cross_products = np.delete(np.delete(solution.cross_products, own, axis=2), own, axis=3)
    exact = replace(solution, cross_products=cross_products, problem=replace(solution.problem, own_errors=0))
    return exact.with_state(trial_effects=solution.state.trial_effects[:, :N_TRIAL_EFFECTS])


def coarsest_groups(trials: Sequence[Trial]) -> list[str]:
    """The clusters of trials whose errors may be correlated: specimens, else days, else single trials."""
    for column in GROUPINGS:
        names = [trial.group(column) for trial in trials]
        if all(getattr(trial, column) for trial in trials) and len(set(names)) >= FEWEST_CLUSTERS:
            return names
    return [str(i) for i in range(len(trials))]  # Not their names: a planned trial may be there several times


def _summed_over(groups: Sequence[Hashable], single: Floats) -> Floats:
    """Sums over the trials of each group."""
    of_trial = np.unique(np.asarray(groups), return_inverse=True)[1]
    sums = np.zeros((of_trial.max(initial=-1) + 1, *single.shape[1:]))
    np.add.at(sums, of_trial, single)
    return sums


def cluster_variance(single: Floats, fitted: int, groups: Sequence[str]) -> Floats:
    """Variance of sums over trials, from the scatter of single trials or, where that is larger, of their clusters
    (`coarsest_groups`), corrected for few groups by G/(G − 1) · (N − 1)/(N − p): CR1 of Cameron & Miller, Journal of
    Human Resources 50, 317 (2015); 0 where trials are too few. Shapes: single (n_trials, n) → (n,).
    """
    trials = len(single)
    if trials < FEWEST_CLUSTERS:
        return np.zeros(single.shape[1])
    sums = [_summed_over(each, single - single.mean(axis=0)) for each in (range(trials), groups)]
    return np.max([np.sum(one**2, axis=0) * len(one) / max(len(one) - 1, 1) for one in sums], axis=0) * (
        (trials - 1) / max(trials - fitted, 1)
    )


# ------------------------------------------------------------------------------
# Sensitivity of fitted numbers to the mass of the film.
#
# The mass of the film is computed from its thickness and density, which no sheet states to better than a few per
# cent. It is not part of the stated errors, because it can be weighed and is then negligible. In a campaign of two
# dozen precise trials it may exceed all stated errors, and the fit then says so.


def film_influence(fit: Fit) -> Floats:
    """Standard deviation of each fitted number due to an unknown film mass, independent by 2 % for each vine.

    Parameters
    ----------
    fit : Fit

    Returns
    -------
    array, shape (n_numbers,)
        In the units of `fit.numbers`, SI. Zeros if the fit estimates the mass of the film, or it has no influence.

    Examples
    --------
    >>> import vinetrack as vt
    >>> fit = vt.fit(vt.base_model(), vt.example_tracks())
    >>> vt.film_influence(fit).shape
    (3,)
    """
    if "film_mass" in fit.model:
        return np.zeros(len(fit.numbers))
    solution = with_systematics(fit.solution).solution
    plain, n = robust_variances(solution)[0], solution.state.theta.size
    information = systematics_of(fit.solution, ["film"]).beside(solution).information()[0].sum(axis=0)
    moved = (plain @ information[:n, n:])[: len(fit.numbers)]
    free = fit.predictor.layout.free
    slopes = np.array([each.derivative(number.value) for each, number in zip(free, fit.numbers, strict=True)])
    return np.asarray(np.sqrt(np.sum(moved**2, axis=1)) * slopes)


# ------------------------------------------------------------------------------
# What a fit states: numbers, trials, and messages that warn of them or tell what was done to the data.

SPREAD_NAMES = ("pressure", "B")
ESTIMATES = tuple(entry.name for entry in fields(TrialEstimates))  # of each trial effect its value and its error


def fit_messages(
    solution: Solution, numbers: Sequence[Number], precision: Precision, chi2: float
) -> tuple[Remark, ...]:
    """Warnings on convergence, on each number and on the size of the residuals; notes on unequal weights of points and
    on positions that were smoothed before they were imported.
    """
    predictor = solution.predictor
    told = [] if solution.converged else [remark("not_converged", iterations=solution.iterations)]
    for k, number in enumerate(numbers):
        named, free = {"title": number.title, "key": number.key}, predictor.layout.free[k]
        if precision.insensitive[k]:
            told.append(remark("no_influence", **named, value=number.value))
        elif math.isfinite(number.bound):
            told.append(remark("at_bound", **named, bound=number.bound))
        # 0.95, 1.05: ratios of fitted to stated error of P_y from which the trajectories are said not to constrain it,
        # and why the fitted error exceeds the stated one (chosen)
        elif math.isfinite(free.prior_sd) and number.sigma > 0.95 * free.prior_sd:
            told.append(remark("not_constrained", title=number.title, wider=number.sigma > 1.05 * free.prior_sd))
    if precision.collinear.any():
        together = [n for n, collinear in zip(numbers, precision.collinear, strict=True) if collinear]
        told.append(remark("not_separable", names=[f"{n.title} ({n.key})" for n in together]))
    variance = np.diag(precision.covariance)
    usable = np.flatnonzero(np.isfinite(variance) & (variance > 0))
    for i, j in itertools.combinations(usable.tolist(), 2):
        correlation = precision.covariance[i, j] / math.sqrt(variance[i] * variance[j])
        # 0.98: correlation of two fitted numbers from which the fit warns (chosen)
        if abs(correlation) > 0.98:
            first, second = numbers[i].title, numbers[j].title
            told.append(remark("correlated", first=first, second=second, correlation=float(correlation)))
    varying = [bool(solution.problem.has_deviation[:, k].any()) for k in range(2)]
    for k, name in enumerate(SPREAD_NAMES):
        if varying[k] and not solution.estimable[k]:
            told.append(remark("spread_taken", name=name, spread=solution.state.spread[k]))
    # 2.0: χ² per degree of freedom from which the fit warns of misfit (chosen)
    if chi2 > 2.0:
        may_vary = [SPREAD_NAMES[k] for k in (1, 0) if varying[k]]
        told.append(remark("misfit", ratio=math.sqrt(chi2), may_vary=may_vary))
    by_source: dict[str, list[str]] = {}
    for number in numbers:
        if number.shared and number.shared_sigma**2 > 0.5 * number.sigma**2:
            largest = max(number.shared, key=lambda source: number.shared[source])
            by_source.setdefault(largest, []).append(number.title)
    told += [remark("mostly_shared", names=titles, source=source) for source, titles in by_source.items()]
    weighted = [each for each in predictor.data if np.ptp(each.point_sd[: each.time_s.size - each.sees_end]) > 0]
    if weighted and weighted[0].blur_s > 0:
        told.append(remark("weighted_by_speed", blur_us=1e6 * weighted[0].blur_s))
    elif weighted:
        told.append(remark("weighted_as_stated"))
    smoothed = dict.fromkeys(each.smoothing for each in predictor.data if each.smoothing is not None)
    return (*told, *(remark("smoothed", how=str(one), frames=one.decimation) for one in smoothed))


def assemble(solution: Solution, left_out: Mapping[str, str], options: Mapping[str, Any]) -> Fit:
    """Assemble a `Fit` from a solution: numbers with errors and intervals, trial effects, messages."""
    layout, with_errors = solution.predictor.layout, with_systematics(solution)
    extended, count = with_errors.solution, len(layout.free)
    by_noise = precision(extended)
    precision_of_fit = widened_covariance(extended, by_noise, with_errors.sources)
    numbers = _numbers(extended, precision_of_fit)
    slopes = np.array([free.derivative(number.value) for free, number in zip(layout.free, numbers, strict=True)])
    chi2 = chi2_per_dof(solution)
    points, state = solution.problem.points, extended.state
    variance = float(np.average(state.variance, weights=points)) / (1 - state.rho**2)
    # Yield pressures belong to the trials and stay in the numbers.
    of_model = [each for each in numbers if each.key != YIELD_PRESSURE and layout.term(each.key) is None]
    return Fit(
        model=layout.model.with_values(values_by_key((each.key, each.vine, each.value) for each in of_model)),
        numbers=numbers,
        covariance=precision_of_fit.covariance * slopes[:, None] * slopes,
        spreads={
            name: BetweenTrialSpread(state.spread[k], solution.estimable[k])
            for k, name in enumerate(SPREAD_NAMES)
            if solution.problem.has_deviation[:, k].any()
        },
        noise_m=math.sqrt(variance),
        noise_correlation=state.rho,
        chi2_per_dof=chi2,
        log_likelihood=solution.log_likelihood() + with_errors.gain,
        trials=_trial_fits(solution, with_errors, by_noise.covariance[:count, :count]),
        messages=fit_messages(solution, numbers, precision_of_fit, chi2),
        left_out=dict(left_out),
        converged=solution.converged,
        iterations=solution.iterations,
        solution=solution,
        options=options,
        with_errors=state,
    )


def _numbers(solution: Solution, precision_of_fit: Precision) -> tuple[Number, ...]:
    """The free parameters, the first unknowns of a solution, with their errors and intervals."""
    numbers, dof, layout = [], precision_of_fit.degrees, solution.predictor.layout
    sigmas = np.sqrt(np.diag(precision_of_fit.covariance))
    of_parameters = zip(layout.free, *layout.bounds, solution.state.theta.tolist(), strict=False)
    for k, (free, lower, upper, at) in enumerate(of_parameters):
        reach, sigma = student(dof)[k] * sigmas[k], float(sigmas[k])
        low, high = (at - reach, at + reach) if math.isfinite(sigma) else (-math.inf, math.inf)
        ends = [end for end in (lower, upper) if abs(at - end) <= 1e-9 * max(abs(end), 1.0)]
        slope = free.derivative(free.from_scaled(at))
        shared = {name: math.sqrt(v[k]) * slope for name, v in precision_of_fit.shared.items() if v[k] > 0}
        numbers.append(
            Number(
                *(free.key, free.vine, free.symbol, free.unit),
                value=free.from_scaled(at),
                sigma=sigma * slope,
                low=free.from_scaled(float(max(low, lower))),
                high=free.from_scaled(float(min(high, upper))),
                dof=float(dof[k]),
                method="linear" if math.isfinite(sigma) else "none",
                bound=free.from_scaled(float(ends[0])) if ends else math.nan,
                lower=free.from_scaled(float(lower)),
                upper=free.from_scaled(float(upper)),
                shared=shared if math.isfinite(sigma) else {},
                pressure_unit=solution.predictor.data[0].trial.pressure_unit,
            )
        )
    return tuple(numbers)


def _trial_effect_sigma(solution: Solution, covariance: Floats) -> Floats:
    """Standard errors of the trial effects, including those of the shared parameters, shape (n_trials, 4)."""
    problem, white = solution.problem, solution.white()
    precision = problem.effect_priors(solution.state)[1]
    square = with_diagonal(white[:, :N_TRIAL_EFFECTS, :N_TRIAL_EFFECTS], precision)
    inverse = solve_per_trial(square, np.broadcast_to(np.eye(N_TRIAL_EFFECTS), square.shape))
    response = inverse @ white[:, :N_TRIAL_EFFECTS, N_TRIAL_EFFECTS:-1]
    shared = np.pad(np.where(np.isfinite(covariance), covariance, 0.0), (0, 1))
    shared_of_trial = shared[problem.index[:, :, None], problem.index[:, None, :]]
    total = inverse + response @ shared_of_trial @ np.swapaxes(response, 1, 2)
    sigma = np.sqrt(np.maximum(np.einsum("nkk->nk", total), 0.0))
    for k, column in enumerate((PRESSURE, DAMPING_DEVIATION)):
        sigma[~problem.has_deviation[:, k], column] = 0.0
    return np.asarray(sigma)


def _trial_fits(solution: Solution, with_errors: WithSystematics, covariance: Floats) -> tuple[TrialFit, ...]:
    """The trials at a solution, with the deviations and whitened residuals of the fit that includes the systematic
    errors: one linear step, unbounded for a poor fit, so that the deviations are limited as those of a fit are.
    """
    state, sigma, reached = solution.state, _trial_effect_sigma(solution, covariance), with_errors.solution
    trajectories = solution.predictor.trajectories_at(state.theta, state.trial_effects)
    deviations = np.clip(reached.state.trial_effects, -LARGEST_DEVIATION, LARGEST_DEVIATION)
    effects = np.column_stack([state.trial_effects[:, :PRESSURE], deviations[:, PRESSURE:N_TRIAL_EFFECTS]])
    trials = []
    for i, (one, moved) in enumerate(zip(solution.predictor.data, trajectories, strict=True)):
        white = whiten(reached.columns[i][:, -1], one.first, reached.state.rho, one.relative_sd)
        position_m, velocity_m_s, variance = moved.observed_position_m, moved.lead_velocity_m_s, state.variance[i]
        trial = trial_fit(one, effects[i], position_m, velocity_m_s, state.rho, float(variance), sigma[i])
        trials.append(replace(trial, whitened=white / math.sqrt(reached.state.variance[i])))
    return tuple(trials)


def trial_fit(
    trial_data: FitTrial, trial_effects: Floats, position_m: Floats, velocity_m_s: Floats, rho: float, variance: float,
    sigma: Floats | None = None,
) -> TrialFit:  # fmt: skip
    """One trial with its trial effects, their errors, and the predictions of the model."""
    predicted_m = position_m + trial_effects[ORIGIN]
    residual_m = trial_data.lead_position_m - predicted_m
    effects = [*trial_effects[:DAMPING_DEVIATION], math.expm1(trial_effects[DAMPING_DEVIATION])]
    stated = np.column_stack([effects, np.full(N_TRIAL_EFFECTS, math.nan) if sigma is None else sigma])
    return TrialFit(
        trial=trial_data.trial,
        time_s=trial_data.time_s,
        lead_position_m=trial_data.lead_position_m,
        predicted_position_m=predicted_m,
        predicted_velocity_m_s=velocity_m_s,
        residual_m=residual_m,
        whitened=whiten(residual_m, trial_data.first, rho, trial_data.relative_sd) / math.sqrt(variance),
        noise_m=math.sqrt(variance / (1 - rho**2)),
        **dict(zip(ESTIMATES, stated.ravel().tolist(), strict=True)),
    )


def summary_of(fit: Fit, warnings: Sequence[str] = (), further_messages: Sequence[str] = ()) -> FitSummary:
    """The summary of a fit, with a message on the film mass where it matters as much as the stated errors."""
    moved, sigma = film_influence(fit), np.array([number.sigma for number in fit.numbers])
    ratio = np.divide(moved, sigma, out=np.zeros_like(moved), where=np.isfinite(sigma) & (sigma > 0))
    affected = [k for k in np.argsort(-ratio, kind="stable").tolist() if ratio[k] >= 1]
    shown = [(fit.numbers[k].title, moved[k], *fit.numbers[k].shown) for k in affected]
    changes = [(title, factor * size, unit) for title, size, unit, factor in shown]
    messages = [*fit.messages, *([remark("film_matters", error=FILM_ERROR, changes=changes)] if affected else [])]
    same = "numbers covariance spreads noise_m noise_correlation chi2_per_dof log_likelihood converged left_out"
    return FitSummary(
        **{name: getattr(fit, name) for name in same.split()},
        names=tuple(fit.model.names),
        moved_by_film=moved,
        messages=tuple(map(str, (*messages, *further_messages))),
        warnings=tuple(warnings),
        trials={trial.name: TrialEstimates(*(getattr(trial, name) for name in ESTIMATES)) for trial in fit.trials},
    )
