"""Robust covariance of the parameters of a fit, from the scatter of trials and from shared systematic errors.

The inverse information is the covariance only if noise and between-trial variation are as modelled. The scatter of the
scores of single trials gives a cluster-robust (sandwich) covariance (White, Econometrica 48, 817, 1980, with trials as
clusters), which only ever widens an error.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import replace

import numpy as np

from vinetrack.core.records import Floats, Trial
from vinetrack.experiment.schema import GROUPINGS
from vinetrack.inference.marginal_likelihood import inverse_of_block, matrix_root
from vinetrack.inference.optimiser import Solution
from vinetrack.inference.position_errors import (
    Pooled,
    Precision,
    trial_information,
)
from vinetrack.inference.sensitivity import Predictor

FEWEST_CLUSTERS = 8  # Trials from which the sandwich is better than the model of the noise (chosen)

FEWEST_DEGREES = 4  # Trials beyond the number of parameters that a sandwich needs (chosen)


def cluster_variance(single: Floats, fitted: int, groups: Sequence[str]) -> Floats:
    """Variance of sums over trials, from the scatter of single trials or, where that is larger, of their clusters
    (`coarsest_groups`); 0 where trials are too few. Shapes: single (n_trials, n) → (n,).
    """
    trials = len(single)
    if trials < FEWEST_CLUSTERS:
        return np.zeros(single.shape[1])
    single = single - single.mean(axis=0)
    return np.max([np.diag(group_scatter(single, each, fitted)) for each in (range(trials), groups)], axis=0)


def too_few_clusters(predictor: Predictor, solution: Solution) -> bool:
    """Whether there are too few trials for a sandwich covariance."""
    spare = len(predictor.data) - np.count_nonzero(solution.problem.free)
    return len(predictor.data) < FEWEST_CLUSTERS or bool(spare < FEWEST_DEGREES)


def widened_covariance(
    predictor: Predictor,
    solution: Solution,
    model_precision: Precision,
    sources: Sequence[str],
    pooled: Pooled | None = None,
) -> Precision:
    """Covariance and degrees of freedom at the end of a fit with its systematic errors, the last unknowns, widened by
    the scatter of trials. `sources` are where each of these errors comes from.
    """
    plain, robust = robust_covariance(predictor, solution)
    at_most, trials = model_precision.degrees, len(predictor.data)
    spare = trials - estimated_unknowns(solution, plain)
    if pooled is None and trials >= FEWEST_CLUSTERS and spare >= FEWEST_DEGREES:
        variance = np.diag(robust)
        clusters = len(set(coarsest_groups([trial_data.trial for trial_data in predictor.data])))
        few = np.full(variance.size, min(spare, clusters - 1.0))
    elif pooled is None:
        variance, few = _few_trial_variances(*trial_information(solution), solution, plain)
    else:
        plain = pooled.covariance
        variance, few = _few_trial_variances(pooled.information, pooled.scores, solution, plain)
        at_most = np.where(np.diag(pooled.between) > 0, np.minimum(at_most, few), at_most)
    diagonal = np.diag(plain)
    ratio = np.sqrt(np.maximum(np.divide(variance, diagonal, out=np.ones_like(diagonal), where=diagonal > 0), 1.0))
    degrees = np.where(ratio > 1, np.minimum(at_most, few), at_most)
    covariance = (
        np.where(np.isfinite(model_precision.covariance), model_precision.covariance, 0.0) * ratio[:, None] * ratio
    )
    unknown = np.flatnonzero(~np.isfinite(np.diag(model_precision.covariance)))
    covariance[unknown, unknown] = np.inf
    # What the parameters would be known better by if the errors from a source were known.
    source_of, shared = np.array([""] * (len(plain) - len(sources)) + list(sources)), {}
    for source in dict.fromkeys(sources):
        across = plain[:, source_of == source]
        known = np.linalg.pinv(plain[np.ix_(source_of == source, source_of == source)], hermitian=True)
        shared[source] = np.sum((across @ known) * across, axis=1) * ratio**2
    return replace(model_precision, covariance=covariance, degrees=degrees, shared=shared)


def estimated_unknowns(solution: Solution, covariance: Floats) -> float:
    """How many unknowns the trials determine: each counts by the part of its information that is not its prior's."""
    by_prior = solution.problem.prior_precision * np.diag(covariance)
    return float(np.sum(np.where(np.diag(covariance) > 0, 1 - by_prior, 0.0)))


def _few_trial_variances(
    information: Floats, scores: Floats, solution: Solution, plain: Floats
) -> tuple[Floats, Floats]:
    """Variances of the free parameters from the disagreement of few trials, without bias, and their degrees of freedom.
    Each trial pulls the fit towards itself, by its share K_i of the information, and so shows less than its error: in
    units of the errors of the model its score has the variance K_i(1 − K_i), and is divided by √(1 − K_i) (CR2: Bell &
    McCaffrey, Survey Methodology 28, 169, 2002). Returns variance, degrees : arrays, shape (n_free,), of scaled
    parameters. Shapes: plain (n_free, n_free).
    """
    variance, degrees = np.diag(plain).copy(), np.full(len(plain), np.inf)
    estimated = np.flatnonzero(np.diag(plain) > 0)
    if not estimated.size or len(scores) < 2:
        return variance, degrees
    root = matrix_root(plain[np.ix_(estimated, estimated)])
    score = (scores - scores.mean(axis=0))[:, estimated] @ root
    shares, adjustments = [], []
    constant = root.T @ np.diag(solution.problem.prior_precision[estimated]) @ root
    for single in information:
        share = root.T @ single[np.ix_(estimated, estimated)] @ root
        values, vectors = np.linalg.eigh(share)
        # 0.99: share of the information on a direction from which one trial is practically the only one to
        # determine it (chosen)
        below_limit = values < 0.99
        adjustments.append(
            (vectors[:, below_limit] / np.sqrt(1 - np.maximum(values[below_limit], 0.0))) @ vectors[:, below_limit].T
        )
        constant = constant + (vectors[:, ~below_limit] * values[~below_limit]) @ vectors[:, ~below_limit].T
        shares.append(share)
    for k, place in enumerate(estimated.tolist()):
        weights_of_score = np.array([adjustment @ root[k] for adjustment in adjustments])
        scatter = float(np.sum(np.einsum("nk,nk->n", weights_of_score, score) ** 2))
        moved = np.einsum("nij,nj->ni", np.array(shares), weights_of_score)
        expected = np.diag(np.einsum("ni,ni->n", weights_of_score, moved)) - moved @ moved.T
        squares = float(np.sum(expected**2))
        variance[place] = scatter + float(root[k] @ constant @ root[k])
        if squares > 0 and scatter > 0:
            degrees[place] = max(np.trace(expected) ** 2 / squares * (variance[place] / scatter) ** 2, 1.0)
    return variance, degrees


def robust_covariance(predictor: Predictor, solution: Solution) -> tuple[Floats, Floats]:
    """Covariance of the free parameters by the noise model, and cluster-robust, from the scatter of trials, shape
    (n_free, n_free) each. Parameters at a bound are fixed there.
    """
    problem, theta = solution.problem, solution.state.theta
    information, scores = trial_information(solution)
    square = information.sum(axis=0) + np.diag(problem.prior_precision)
    inside = (theta > problem.lower) & (theta < problem.upper)
    estimated = np.flatnonzero(problem.free & inside & (np.diag(square) > 0))
    plain = inverse_of_block(square, estimated)
    # Scores of a parameter add up to the pull of its prior, in equal parts from each trial that depends on it.
    depend = (problem.index[:, :, None] == np.arange(len(theta))).any(axis=1)
    scores -= depend * (scores.sum(axis=0) / np.maximum(depend.sum(axis=0), 1))
    # The prior does not scatter from trial to trial, but its uncertainty contributes as well.
    prior = np.diag(problem.prior_precision)
    groups = coarsest_groups([trial_data.trial for trial_data in predictor.data])
    fitted = estimated_unknowns(solution, plain)
    meats = [group_scatter(scores, each, fitted) + prior for each in (range(len(scores)), groups)]
    robust, by_group = (plain @ meat @ plain for meat in meats)
    np.fill_diagonal(robust, np.maximum(np.diag(robust), np.diag(by_group)))
    return plain, robust


def coarsest_groups(trials: Sequence[Trial]) -> list[str]:
    """The clusters of trials whose errors may be correlated: specimens, else days, else single trials."""
    for column in GROUPINGS:
        names = [trial.group(column) for trial in trials]
        if all(getattr(trial, column) for trial in trials) and len(set(names)) >= FEWEST_CLUSTERS:
            return names
    return [str(i) for i in range(len(trials))]  # Not their names: a planned trial may be there several times


def group_scatter(single: Floats, groups: Sequence[Hashable], fitted: float) -> Floats:
    """Variance of the sum of scores from the scatter of sums over groups, corrected for few groups. The correction is
    G/(G − 1) · (N − 1)/(N − p), CR1 of Cameron & Miller, Journal of Human Resources 50, 317 (2015). Shapes: single
    (n_trials, n_free) → (n_free, n_free).
    """
    of_trial = np.unique(np.asarray(groups), return_inverse=True)[1]
    count, trials = of_trial.max() + 1, len(single)
    sums = np.zeros((count, single.shape[1]))
    np.add.at(sums, of_trial, single)
    factor = count / max(count - 1, 1) * (trials - 1) / max(trials - fitted, 1)
    return np.asarray(sums.T @ sums * factor)
