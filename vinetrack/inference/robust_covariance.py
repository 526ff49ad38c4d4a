"""Robust covariance of the parameters of a fit, from the scatter of trials and from shared systematic errors.

The inverse information is the covariance only if noise and between-trial variation are as modelled. The scatter of the
scores of single trials gives a cluster-robust (sandwich) covariance (White, Econometrica 48, 817, 1980, with trials as
clusters). Errors that trials share (`vinetrack.inference.systematics`) move parameters without any scatter. Both only
ever widen an error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from vinetrack.core.records import Floats, Trial
from vinetrack.inference.fit_result import TrialFit
from vinetrack.inference.intervals import Precision
from vinetrack.inference.mixed_effects import inverse_of_block, sum_matrix_blocks, trial_effects_eliminated
from vinetrack.inference.optimiser import Solution
from vinetrack.inference.pooling import Pooled, trial_information
from vinetrack.inference.sensitivity import N_TRIAL_EFFECTS, Predictor
from vinetrack.inference.systematics import Systematics, systematics_of
from vinetrack.inference.whitening import products

FEWEST_CLUSTERS = 8  # Trials from which the sandwich is better than the model of the noise (chosen)

FEWEST_DEGREES = 4  # Trials beyond the number of parameters that a sandwich needs (chosen)

# Share of the information on a direction from which one trial is practically the only one to determine it (chosen)
LARGEST_SHARE = 0.99


def cluster_variance(single: Floats, degrees: float) -> Floats:
    """Variance of sums over trials, estimated from the scatter of single trials; 0 where they are too few. The
    contributions of priors belong to no trial: the mean is subtracted. Shapes: single (n_trials, n) → (n,).
    """
    trials = len(single)
    if trials < FEWEST_CLUSTERS:
        return np.zeros(single.shape[1])
    return np.asarray(np.sum((single - single.mean(axis=0)) ** 2, axis=0) * trials / degrees)


def too_few_clusters(predictor: Predictor, solution: Solution) -> bool:
    """Whether there are too few trials for a sandwich covariance."""
    spare = len(predictor.data) - np.count_nonzero(solution.problem.free)
    return len(predictor.data) < FEWEST_CLUSTERS or bool(spare < FEWEST_DEGREES)


def widened_covariance(
    predictor: Predictor,
    solution: Solution,
    trials: Sequence[TrialFit],
    model_precision: Precision,
    extended: Solution | None = None,
    pooled: Pooled | None = None,
) -> Precision:
    """Covariance and degrees of freedom at the end of a fit, widened by the scatter of trials and by
    systematic errors.
    """
    systematics = systematics_of(predictor, solution, trials, positions=extended is None)
    plain, robust, moved = _sandwich(predictor, extended or solution, systematics)
    diagonal = np.diag(plain)
    estimated = diagonal > 0
    ratio = np.ones(diagonal.size)
    spare = len(trials) - np.count_nonzero(estimated)
    at_most = model_precision.degrees
    if pooled is not None:
        diagonal = np.diag(pooled.covariance)
        estimated = diagonal > 0
        variance, few = _few_trial_variances(pooled.information, pooled.scores, extended or solution, pooled.covariance)
        ratio[estimated] = np.sqrt(np.maximum(variance[estimated] / diagonal[estimated], 1.0))
        at_most = np.where(np.diag(pooled.between) > 0, np.minimum(at_most, few), at_most)
    elif len(trials) >= FEWEST_CLUSTERS and spare >= FEWEST_DEGREES:
        ratio[estimated] = np.sqrt(np.maximum(np.diag(robust)[estimated] / diagonal[estimated], 1.0))
        clusters = len(set(coarsest_groups([trial_data.trial for trial_data in predictor.data])))
        few = np.full(diagonal.size, float(min(int(spare), clusters - 1)))
    else:
        variance, few = _few_trial_variances(*trial_information(extended or solution), extended or solution, plain)
        ratio[estimated] = np.sqrt(np.maximum(variance[estimated] / diagonal[estimated], 1.0))
    degrees = np.where(ratio > 1, np.minimum(at_most, few), at_most)
    covariance = (
        np.where(np.isfinite(model_precision.covariance), model_precision.covariance, 0.0) * ratio[:, None] * ratio
        + moved @ moved.T
    )
    unknown = np.flatnonzero(~np.isfinite(np.diag(model_precision.covariance)))
    covariance[unknown, unknown] = np.inf
    return replace(model_precision, covariance=covariance, degrees=degrees)


def robust_covariance(predictor: Predictor, solution: Solution) -> tuple[Floats, Floats]:
    """Covariance of the free parameters by the noise model, and cluster-robust, from the scatter of trials. Returns
    plain, robust : arrays, shape (n_free, n_free).
    """
    no_errors = Systematics.none([trial_data.time_s.size for trial_data in predictor.data])
    plain, robust, _ = _sandwich(predictor, solution, no_errors)
    return plain, robust


def parameter_shifts(predictor: Predictor, solution: Solution, systematics: Systematics) -> Floats:
    """Change of each free parameter by one standard deviation of each systematic error, to first order. Shape (n_free,
    count).
    """
    return _sandwich(predictor, solution, systematics)[2]


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
        below_limit = values < LARGEST_SHARE
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


def matrix_root(square: Floats) -> Floats:
    """A matrix R with R Rᵀ equal to a symmetric positive semidefinite matrix. Shapes: square (n, n) → (n, n)."""
    values, vectors = np.linalg.eigh(square)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def _scores(rows: Floats, index: np.ndarray, size: int) -> Floats:
    """Scores of the free parameters by trial, shape (n_trials, size), with the mean, that of the prior, subtracted."""
    single = np.zeros((len(rows), size + 1))
    for i, row in enumerate(rows):
        np.add.at(single[i], index[i], row)
    return np.asarray(single[:, :size] - single[:, :size].mean(axis=0))


def _sandwich(predictor: Predictor, solution: Solution, systematics: Systematics) -> tuple[Floats, Floats, Floats]:
    """Model-based and cluster-robust covariance, shape (n_free, n_free) each, and `parameter_shifts`. Parameters at a
    bound are fixed there.
    """
    problem, state = solution.problem, solution.state
    cross_products = solution.cross_products
    p, size = cross_products.shape[-1] - N_TRIAL_EFFECTS - 1, problem.prior_mean.size
    if systematics.n_columns:
        both = zip(solution.columns, systematics.columns, predictor.data, strict=True)
        cross_products = np.stack(
            [
                products(np.column_stack([sensitivities, systematic]), trial_data.first, trial_data.relative_sd)
                for sensitivities, systematic, trial_data in both
            ]
        )
    blocks = trial_effects_eliminated(cross_products, p, problem, state)
    square = sum_matrix_blocks(blocks[:, :p, :p], problem) + np.diag(problem.prior_precision)
    inside = (state.theta > problem.lower) & (state.theta < problem.upper)
    estimated = np.flatnonzero(problem.free & inside & (np.diag(square) > 0))
    plain = inverse_of_block(square, estimated)
    scores = _scores(blocks[:, :p, p], problem.index, size)
    trials = len(blocks)
    # The prior does not scatter from trial to trial, but its uncertainty contributes as well.
    prior = np.diag(problem.prior_precision)
    meat = scores.T @ scores * trials / max(trials - estimated.size, 1) + prior
    robust = plain @ meat @ plain
    groups = coarsest_groups([trial_data.trial for trial_data in predictor.data])
    if len(set(groups)) < trials:
        by_group = plain @ (group_scatter(scores, groups, estimated.size) + prior) @ plain
        np.fill_diagonal(robust, np.maximum(np.diag(robust), np.diag(by_group)))
    # Parameters and errors that a trial does not depend on are collected in a last row and column, and dropped.
    cross = np.zeros((size + 1, systematics.count + 1))
    np.add.at(cross, (problem.index[:, :, None], systematics.places[:, None, :]), blocks[:, :p, p + 1 :])
    return plain, robust, plain @ cross[:size, : systematics.count]


def coarsest_groups(trials: Sequence[Trial]) -> list[str]:
    """The clusters of trials whose errors may be correlated: specimens, else days, else single trials."""
    for column in ("specimen", "day"):
        names = [f"{trial.vine}, {trial.specimen}" if column == "specimen" else trial.day for trial in trials]
        if all(getattr(trial, column) for trial in trials) and len(set(names)) >= FEWEST_CLUSTERS:
            return names
    return [trial.name for trial in trials]


def group_scatter(single: Floats, groups: Sequence[str], fitted: int) -> Floats:
    """Variance of the sum of scores from the scatter of sums over groups, corrected for few groups. The correction is
    G/(G − 1) · (N − 1)/(N − p), CR1 of Cameron & Miller, Journal of Human Resources 50, 317 (2015). Shapes: single
    (n_trials, n_free) → (n_free, n_free).
    """
    names = list(dict.fromkeys(groups))
    sums = np.array([single[[group == name for group in groups]].sum(axis=0) for name in names])
    count, trials = len(names), len(single)
    factor = count / max(count - 1, 1) * (trials - 1) / max(trials - fitted, 1)
    return np.asarray(sums.T @ sums * factor)
