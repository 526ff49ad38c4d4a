"""Errors of fitted numbers beyond those of the noise model: how much trials scatter, and what they err by together.

The information matrix holds only if noise and scatter are what the model of them says. The scores of single trials
tell otherwise by how much they scatter (White, Econometrica 48, 817, 1980, with trials as clusters), and what trials
have in common (`vinetrack.inference.systematics`) moves numbers without any scatter. Both only ever widen an error.
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

FEWEST_CLUSTERS = 8
"""Trials from which their scatter says more than the model of the noise. Chosen: with fewer clusters a sandwich is
known to worse than 50 %."""

FEWEST_DEGREES = 4
"""And this many more than there are numbers. Chosen: with four the variance is known to a factor of about 1.7."""

LARGEST_SHARE = 0.99
"""Chosen: share of the information on a direction from which one trial is as good as alone to tell of it. At 0.98 its
score is enlarged by 7 instead of 10; what is left of it then is rounding more than scatter."""


def cluster_variance(single: Floats, degrees: float) -> Floats:
    """Variance of sums over trials from how single trials, shape (n_trials, n), scatter; 0 where they are too few.

    Priors' parts belong to no trial: the mean is taken out.

    Parameters
    ----------
    single : array, shape (n_trials, n)
        What each trial adds.
    degrees : float
        Degrees of freedom of the scatter.

    Returns
    -------
    array, shape (n,)
    """
    trials = len(single)
    if trials < FEWEST_CLUSTERS:
        return np.zeros(single.shape[1])
    return np.asarray(np.sum((single - single.mean(axis=0)) ** 2, axis=0) * trials / degrees)


def too_few_clusters(predictor: Predictor, solution: Solution) -> bool:
    """Whether trials are too few for a sandwich over them.

    Parameters
    ----------
    predictor : of the trials that were fitted.
    solution : at the end of the fit.

    Returns
    -------
    bool
    """
    spare = len(predictor.data) - np.count_nonzero(solution.problem.free)
    return len(predictor.data) < FEWEST_CLUSTERS or bool(spare < FEWEST_DEGREES)


def widened_covariance(
    predictor: Predictor,
    solution: Solution,
    trials: Sequence[TrialFit],
    known: Precision,
    wide: Solution | None = None,
    pooled: Pooled | None = None,
) -> Precision:
    """Covariance and degrees of freedom at the end of a fit, widened where trials say that they should be.

    Parameters
    ----------
    predictor : of the trials that were fitted.
    solution : where the iterations ended.
    trials : sequence of TrialFit
        In the order of the fit.
    known : covariance by the noise model.
    wide : Solution, optional
        The fit with smooth errors of position among its numbers, to which `known` then belongs.
    pooled : Pooled, optional
        Numbers with trials weighed by how much they disagree; its covariance is then widened.

    Returns
    -------
    Precision
    """
    systematics = systematics_of(predictor, solution, trials, positions=wide is None)
    plain, robust, moved = _sandwich(predictor, wide or solution, systematics)
    diagonal = np.diag(plain)
    live = diagonal > 0
    ratio = np.ones(diagonal.size)
    spare = len(trials) - np.count_nonzero(live)
    at_most = known.degrees
    if pooled is not None:
        diagonal = np.diag(pooled.covariance)
        live = diagonal > 0
        variance, few = _few_trials(pooled.information, pooled.scores, wide or solution, pooled.covariance)
        ratio[live] = np.sqrt(np.maximum(variance[live] / diagonal[live], 1.0))
        at_most = np.where(np.diag(pooled.between) > 0, np.minimum(at_most, few), at_most)
    elif len(trials) >= FEWEST_CLUSTERS and spare >= FEWEST_DEGREES:
        ratio[live] = np.sqrt(np.maximum(np.diag(robust)[live] / diagonal[live], 1.0))
        clusters = len(set(coarsest_groups([trial_data.trial for trial_data in predictor.data])))
        few = np.full(diagonal.size, float(min(int(spare), clusters - 1)))
    else:
        variance, few = _few_trials(*trial_information(wide or solution), wide or solution, plain)
        ratio[live] = np.sqrt(np.maximum(variance[live] / diagonal[live], 1.0))
    degrees = np.where(ratio > 1, np.minimum(at_most, few), at_most)
    covariance = (
        np.where(np.isfinite(known.covariance), known.covariance, 0.0) * ratio[:, None] * ratio + moved @ moved.T
    )
    unknown = np.flatnonzero(~np.isfinite(np.diag(known.covariance)))
    covariance[unknown, unknown] = np.inf
    return replace(known, covariance=covariance, degrees=degrees)


def robust_covariance(predictor: Predictor, solution: Solution) -> tuple[Floats, Floats]:
    """Covariance of the free numbers as the fit holds them, from the noise model and from the scatter of trials.

    Parameters
    ----------
    predictor : of the trials that were fitted.
    solution : where the iterations ended.

    Returns
    -------
    plain, robust : arrays, shape (n_free, n_free)
        Scaled as the fit holds the numbers.
    """
    nothing = Systematics.none([trial_data.time_s.size for trial_data in predictor.data])
    plain, robust, _ = _sandwich(predictor, solution, nothing)
    return plain, robust


def parameter_shifts(predictor: Predictor, solution: Solution, systematics: Systematics) -> Floats:
    """How far one standard deviation of each systematic error moves each free number, to first order.

    Parameters
    ----------
    predictor : of the trials that were fitted.
    solution : where the iterations ended.
    systematics : Systematics
        What each error does to positions.

    Returns
    -------
    array, shape (n_free, count)
        Scaled as the fit holds the numbers.
    """
    return _sandwich(predictor, solution, systematics)[2]


def _few_trials(information: Floats, scores: Floats, solution: Solution, plain: Floats) -> tuple[Floats, Floats]:
    """Variances of the free numbers from how trials disagree, unbiased for few of them; and their degrees of freedom.

    Each trial pulls the fit towards itself, by its share K_i of the information, and so shows less than it errs by: in
    units of the errors of the model its score has the variance K_i(1 − K_i), and is divided by √(1 − K_i) (CR2: Bell &
    McCaffrey, Survey Methodology 28, 169, 2002). What one trial alone tells of has no scatter: there the model's
    stands. Degrees of freedom are Satterthwaite's; two trials have one.

    Parameters
    ----------
    information, scores : of the trials, see `trial_information`
    plain : array, shape (n_free, n_free), covariance by the model

    Returns
    -------
    variance, degrees : arrays, shape (n_free,), numbers as the fit holds them
    """
    variance, degrees = np.diag(plain).copy(), np.full(len(plain), np.inf)
    live = np.flatnonzero(np.diag(plain) > 0)
    if not live.size or len(scores) < 2:
        return variance, degrees
    root = matrix_root(plain[np.ix_(live, live)])
    score = (scores - scores.mean(axis=0))[:, live] @ root
    shares, mended = [], []
    constant = root.T @ np.diag(solution.problem.prior_precision[live]) @ root
    for single in information:
        share = root.T @ single[np.ix_(live, live)] @ root
        values, vectors = np.linalg.eigh(share)
        seen = values < LARGEST_SHARE
        mended.append((vectors[:, seen] / np.sqrt(1 - np.maximum(values[seen], 0.0))) @ vectors[:, seen].T)
        constant = constant + (vectors[:, ~seen] * values[~seen]) @ vectors[:, ~seen].T
        shares.append(share)
    for k, place in enumerate(live.tolist()):
        lever = np.array([mend @ root[k] for mend in mended])
        scatter = float(np.sum(np.einsum("nk,nk->n", lever, score) ** 2))
        moved = np.einsum("nij,nj->ni", np.array(shares), lever)
        expected = np.diag(np.einsum("ni,ni->n", lever, moved)) - moved @ moved.T
        squares = float(np.sum(expected**2))
        variance[place] = scatter + float(root[k] @ constant @ root[k])
        if squares > 0 and scatter > 0:
            degrees[place] = max(np.trace(expected) ** 2 / squares * (variance[place] / scatter) ** 2, 1.0)
    return variance, degrees


def matrix_root(square: Floats) -> Floats:
    """A matrix whose product with its own transpose is a symmetric positive one.

    Parameters
    ----------
    square : array, shape (n, n)
        Symmetric, no eigenvalue below zero but by rounding.

    Returns
    -------
    array, shape (n, n)
    """
    values, vectors = np.linalg.eigh(square)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def _scores(rows: Floats, index: np.ndarray, size: int) -> Floats:
    """Scores of the free numbers by trial, shape (n_trials, size); the prior's part, which is no trial's, taken out."""
    single = np.zeros((len(rows), size + 1))
    for i, row in enumerate(rows):
        np.add.at(single[i], index[i], row)
    return np.asarray(single[:, :size] - single[:, :size].mean(axis=0))


def _sandwich(predictor: Predictor, solution: Solution, systematics: Systematics) -> tuple[Floats, Floats, Floats]:
    """Covariance by the noise model and by the scatter of trials, shape (n_free, n_free) each, and `parameter_shifts`.

    Numbers at a bound stay there.
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
    live = np.flatnonzero(problem.free & inside & (np.diag(square) > 0))
    plain = inverse_of_block(square, live)
    single = _scores(blocks[:, :p, p], problem.index, size)
    trials = len(blocks)
    # The prior's information does not scatter from trial to trial, yet it is uncertain all the same.
    prior = np.diag(problem.prior_precision)
    meat = single.T @ single * trials / max(trials - live.size, 1) + prior
    robust = plain @ meat @ plain
    groups = coarsest_groups([trial_data.trial for trial_data in predictor.data])
    if len(set(groups)) < trials:
        by_group = plain @ (group_scatter(single, groups, live.size) + prior) @ plain
        np.fill_diagonal(robust, np.maximum(np.diag(robust), np.diag(by_group)))
    # What a trial does not feel, number or error, is counted in a last row and column, and left out.
    cross = np.zeros((size + 1, systematics.count + 1))
    np.add.at(cross, (problem.index[:, :, None], systematics.places[:, None, :]), blocks[:, :p, p + 1 :])
    return plain, robust, plain @ cross[:size, : systematics.count]


def coarsest_groups(trials: Sequence[Trial]) -> list[str]:
    """The clusters of trials whose errors may be alike: specimens, else days, else single trials.

    Parameters
    ----------
    trials : in the order of the fit.

    Returns
    -------
    list
        A name for each trial. Fewer than `FEWEST_CLUSTERS` specimens or days say too little of their scatter: then the
        next finer groups are taken.
    """
    for column in ("specimen", "day"):
        names = [f"{trial.vine}, {trial.specimen}" if column == "specimen" else trial.day for trial in trials]
        if all(getattr(trial, column) for trial in trials) and len(set(names)) >= FEWEST_CLUSTERS:
            return names
    return [trial.name for trial in trials]


def group_scatter(single: Floats, groups: Sequence[str], fitted: int) -> Floats:
    """Variance of the sum of scores from how the sums of groups scatter, corrected for few groups.

    The correction is G/(G − 1) · (N − 1)/(N − p), CR1 of Cameron & Miller, Journal of Human Resources 50, 317 (2015).

    Parameters
    ----------
    single : scores of single trials, shape (n_trials, n_free), their mean taken out.
    groups : name of the group of each trial.
    fitted : how many numbers were fitted, p.

    Returns
    -------
    array, shape (n_free, n_free)
    """
    names = list(dict.fromkeys(groups))
    sums = np.array([single[[group == name for group in groups]].sum(axis=0) for name in names])
    count, trials = len(names), len(single)
    factor = count / max(count - 1, 1) * (trials - 1) / max(trials - fitted, 1)
    return np.asarray(sums.T @ sums * factor)
