"""Errors of fitted numbers beyond those of the noise model: how much trials scatter, and what they err by together.

The information matrix holds only if noise and scatter are what the model of them says. The scores of single trials
tell otherwise by how much they scatter (White, Econometrica 48, 817, 1980, with trials as clusters), and what trials
have in common (`vinetrack.inference.systematics`) moves numbers without any scatter. Both only ever widen an error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.inference.fit_result import TrialFit
from vinetrack.inference.intervals import Precision
from vinetrack.inference.mixed_effects import cross_products, inverse_among, trial_effects_eliminated
from vinetrack.inference.optimiser import Solution
from vinetrack.inference.sensitivity import OWN, Predictor
from vinetrack.inference.systematics import systematics_of
from vinetrack.inference.whitening import products

FEWEST_CLUSTERS = 8
"""Trials from which their scatter says more than the model of the noise. Chosen: with fewer clusters a sandwich is
known to worse than 50 %."""

FEWEST_DEGREES = 4
"""And this many more than there are numbers. Chosen: with four the variance is known to a factor of about 1.7."""


def scatter_of(single: Floats, degrees: float) -> Floats:
    """Variance of sums over trials from how single trials, shape (n_trials, n), scatter; 0 where they are too few.

    Priors' parts belong to no trial: the mean is taken out.
    """
    trials = len(single)
    if trials < FEWEST_CLUSTERS:
        return np.zeros(single.shape[1])
    return np.asarray(np.sum((single - single.mean(axis=0)) ** 2, axis=0) * trials / degrees)


def widened_covariance(
    predictor: Predictor,
    solution: Solution,
    trials: Sequence[TrialFit],
    known: Precision,
    wide: Solution | None = None,
) -> Precision:
    """Covariance and degrees of freedom at the end of a fit, widened where trials say that they should be.

    `wide` is the fit with smooth errors of position among its numbers, to which `known` then belongs.
    """
    doubts = systematics_of(predictor, solution, trials, positions=wide is None)
    plain, robust, shared = _sandwich(predictor, wide or solution, doubts)
    diagonal = np.diag(plain)
    live = diagonal > 0
    ratio = np.ones(diagonal.size)
    degrees = known.degrees.copy()
    spare = len(trials) - np.count_nonzero(live)
    if len(trials) >= FEWEST_CLUSTERS and spare >= FEWEST_DEGREES:
        ratio[live] = np.sqrt(np.maximum(np.diag(robust)[live] / diagonal[live], 1.0))
        degrees = np.where(ratio > 1, np.minimum(degrees, spare), degrees)
    covariance = np.where(np.isfinite(known.covariance), known.covariance, 0.0) * ratio[:, None] * ratio + shared
    unknown = np.flatnonzero(~np.isfinite(np.diag(known.covariance)))
    covariance[unknown, unknown] = np.inf
    return replace(known, covariance=covariance, degrees=degrees)


def robust_covariance(predictor: Predictor, solution: Solution) -> tuple[Floats, Floats]:
    """Covariance of the free numbers as the fit holds them, from the noise model and from the scatter of trials."""
    nothing = [np.zeros((item.time_s.size, 0)) for item in predictor.data]
    plain, robust, _ = _sandwich(predictor, solution, nothing)
    return plain, robust


def _sandwich(predictor: Predictor, solution: Solution, doubts: Sequence[Floats]) -> tuple[Floats, Floats, Floats]:
    """Covariance by the noise model, by the scatter of trials, and what the doubts add, shape (n_free, n_free) each.

    Numbers at a bound stay there.
    """
    frame, state = solution.frame, solution.state
    p, size = solution.columns[0].shape[1] - OWN - 1, frame.prior_mean.size
    grams = solution.grams
    if doubts[0].shape[1]:
        both = zip(solution.columns, doubts, predictor.data, strict=True)
        grams = np.stack([products(np.column_stack([own, doubt]), item.first) for own, doubt, item in both])
    blocks = trial_effects_eliminated(grams, p, frame, state)
    square = cross_products(blocks[:, :p, :p], frame) + np.diag(frame.prior_precision)
    inside = (state.theta > frame.lower) & (state.theta < frame.upper)
    live = np.flatnonzero(frame.free & inside & (np.diag(square) > 0))
    plain = inverse_among(square, live)
    single = np.zeros((len(blocks), size + 1))
    for i, row in enumerate(blocks[:, :p, p]):
        np.add.at(single[i], frame.index[i], row)
    single = single[:, :size] - single[:, :size].mean(axis=0)
    trials = len(blocks)
    # The prior's information does not scatter from trial to trial, yet it is uncertain all the same.
    meat = single.T @ single * trials / max(trials - live.size, 1) + np.diag(frame.prior_precision)
    cross = np.zeros((size + 1, doubts[0].shape[1]))
    np.add.at(cross, frame.index, blocks[:, :p, p + 1 :])
    lever = plain @ cross[:size]
    return plain, plain @ meat @ plain, lever @ lever.T
