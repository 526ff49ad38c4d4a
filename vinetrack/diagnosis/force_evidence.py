"""Marginal likelihood and posterior of a smooth force over given variables, averaged over its hyperparameters.

A force that is zero where growth begins, one that is constant there and one that is free there are compared by their
marginal likelihoods; `force_surface` explains why the first is drawn unless the tracks contradict it.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.diagnosis.force_refinement import NormalEquations, SearchPoint
from vinetrack.diagnosis.force_surface import (
    FREE_AT_START,
    LENGTH_SCALES,
    RELATIVE_AMPLITUDES,
    SEARCHED_VARIANCE,
    Domain,
    SmoothForce,
    standard_error,
)
from vinetrack.diagnosis.likelihood_ratio import ANSWER_SET_DELTA_CHI2

# Information, where each unknown alone has 1, below which a combination of unknowns is not estimable (derived)
LEAST_INFORMATION = 1e-8

# Log-likelihood below that of the best hyperparameters at which a set of them is left out of the mean and the band
# (chosen)
NEGLIGIBLE_LOG_RATIO = 5.0

GRID_POINTS = 30  # Points over a variable at which the standard error of a force is evaluated (chosen)


@dataclass(frozen=True)
class CoefficientLikelihood:
    """Quadratic log-likelihood of the spline coefficients, all other unknowns integrated out. `information` and `score`
    are about coefficients of zero, where χ² is `chi2_at_zero`; `delta_chi2` is its fall to the best coefficients.
    `log_determinant` is that of the information on all other unknowns.
    """

    information: Floats
    score: Floats
    chi2_at_zero: float
    delta_chi2: float
    log_determinant: float

    @property
    def least_chi2(self) -> float:
        """χ² of the best coefficients, without regard to the smoothness prior."""
        return self.chi2_at_zero - self.delta_chi2

    @property
    def is_finite(self) -> bool:
        """Whether all entries are finite: far outside the visited range the equations overflow."""
        parts = (self.information, self.score, self.chi2_at_zero, self.delta_chi2, self.log_determinant)
        return all(bool(np.isfinite(part).all()) for part in parts)


@dataclass(frozen=True)
class ForcePosterior:
    """Posterior of a force under one condition at the start of growth. `log_evidence` is the log marginal likelihood,
    averaged over amplitude and length scales; `surface` has the most likely ones. `mean`, N, and `covariance`, N², are
    those of the spline coefficients; `chi2` is that of the mean.
    """

    at_start: str
    log_evidence: float
    surface: SmoothForce
    length_scales: tuple[float, ...]
    mean: Floats
    covariance: Floats
    chi2: float

    @property
    def domain(self) -> Domain:
        """The variables of the force, with their ranges."""
        return self.surface.domain

    def force(self, values: Sequence[Floats]) -> tuple[Floats, Floats]:
        """Posterior mean of the force at values of the variables, and its standard error. Returns force, sigma :
        arrays, shape (n,), N. Shapes: values (n,).
        """
        basis = self.domain.basis(values)
        return basis @ self.mean, standard_error(basis, self.covariance)


@dataclass(frozen=True)
class VariableChoice:
    """A choice of variables with its log marginal likelihood, and the posterior under each start condition. The
    marginal likelihood is averaged over the start conditions.
    """

    domain: Domain
    log_evidence: float
    posteriors: tuple[ForcePosterior, ...]

    def best(self, error: float = 1.0) -> ForcePosterior:
        """The posterior that is drawn; differences of ln Z count in units of `error`. The force is zero where growth
        begins, or a constant where that is more likely. It is free there only if that is worth Δχ² of 9, because B, n
        and P_y could take over such a force.
        """
        restricted = [each for each in self.posteriors if each.at_start != FREE_AT_START]
        free = [each for each in self.posteriors if each.at_start == FREE_AT_START]
        highest = max((each.log_evidence for each in restricted), default=-math.inf)
        if not restricted or (free and free[0].log_evidence > highest + 0.5 * ANSWER_SET_DELTA_CHI2 * error):
            return free[0]
        weights = np.exp([(each.log_evidence - highest) / error for each in restricted])
        weights /= weights.sum()
        likely = next(each for each in restricted if each.log_evidence > highest - error)
        covariance = np.zeros_like(likely.covariance)
        for weight, each in zip(weights, restricted, strict=True):
            deviation = each.mean - likely.mean
            covariance += weight * (each.covariance + np.outer(deviation, deviation))
        return replace(likely, covariance=covariance)

    @property
    def undecided_N(self) -> float:
        """Standard error of a force that is free where growth begins, N: its median over the other variable. B, n and
        P_y compete with such a force.
        """
        free = [each for each in self.posteriors if each.at_start == FREE_AT_START]
        if not free or self.domain.start_axis < 0:
            return 0.0
        grid = [
            np.linspace(low, high, GRID_POINTS) for low, high in zip(self.domain.low, self.domain.high, strict=True)
        ]
        grid[self.domain.start_axis] = np.full(GRID_POINTS, self.domain.low[self.domain.start_axis])
        return float(np.median(free[0].force(grid)[1]))

    def with_start(self, at_start: str) -> SmoothForce:
        """A force with the most likely hyperparameters, but with this condition at the start of growth. While motions
        do not yet include the force, their defect at the start would be fitted as a force there.
        """
        likely = max(self.posteriors, key=lambda each: each.log_evidence)
        modes = self.domain.prior_modes(likely.length_scales, at_start, SEARCHED_VARIANCE)
        return SmoothForce(self.domain, modes, likely.surface.sd_N)


def coefficient_likelihood(point: SearchPoint, normal: NormalEquations) -> CoefficientLikelihood:
    """Integrate out all unknowns but the force coefficients, after scaling each unknown to unit information."""
    p, q = point.theta.size, point.amplitude.size
    size = np.diag(normal.matrix)
    unit = np.where(size > 0, 1 / np.sqrt(np.where(size > 0, size, 1.0)), 0.0)
    matrix, score = normal.matrix * unit[:, None] * unit, normal.score * unit
    force = np.arange(p, p + q)
    nuisance = np.concatenate([np.arange(p), np.arange(p + q, score.size)])
    nuisance = nuisance[size[nuisance] > 0]
    values, vectors = np.linalg.eigh(matrix[np.ix_(nuisance, nuisance)])
    estimable = values > LEAST_INFORMATION
    root = vectors[:, estimable] / np.sqrt(values[estimable])
    cross, nuisance_score = root.T @ matrix[np.ix_(nuisance, force)], root.T @ score[nuisance]
    strength, directions = np.linalg.eigh(matrix[np.ix_(force, force)] - cross.T @ cross)
    # Directions that the nuisance parameters reproduce have information only from rounding.
    directions, strength = directions[:, strength > LEAST_INFORMATION], strength[strength > LEAST_INFORMATION]
    scale = np.where(unit[force] > 0, 1 / np.where(unit[force] > 0, unit[force], 1.0), 0.0)
    back = scale[:, None] * directions
    local_score = directions.T @ (score[force] - cross.T @ nuisance_score)
    at_point = scale * point.amplitude @ directions
    cost = normal.cost - float(nuisance_score @ nuisance_score)
    return CoefficientLikelihood(
        information=(back * strength) @ back.T,
        score=back @ (local_score + strength * at_point),
        chi2_at_zero=cost + 2 * float(local_score @ at_point) + float(strength @ at_point**2),
        delta_chi2=float(np.sum((local_score + strength * at_point) ** 2 / strength)),
        log_determinant=float(np.sum(np.log(values[estimable]))) - 2 * float(np.sum(np.log(unit[nuisance]))),
    )


def marginal_likelihood(
    domain: Domain, likelihood: CoefficientLikelihood, inflation: float, largest_N: float
) -> VariableChoice:
    """Average the marginal likelihood of a domain over start conditions, length scales and amplitudes."""
    posteriors = tuple(
        _force_posterior(domain, at_start, likelihood, inflation, largest_N) for at_start in domain.start_conditions
    )
    logs = np.array([each.log_evidence for each in posteriors])
    return VariableChoice(domain, float(logs.max() + np.log(np.mean(np.exp(logs - logs.max())))), posteriors)


def _force_posterior(
    domain: Domain, at_start: str, likelihood: CoefficientLikelihood, inflation: float, largest_N: float
) -> ForcePosterior:
    """The posterior under one start condition, averaged over length scales and amplitudes by their likelihoods. For
    given length scales the information in the prior's modes is diagonalised, so that the amplitude only changes how
    much each component is shrunk.
    """
    sizes_N = largest_N * RELATIVE_AMPLITUDES[:, None]
    log_likelihoods, by_length = [], []
    for lengths in itertools.product(LENGTH_SCALES, repeat=len(domain.variables)):
        modes = domain.prior_modes(lengths, at_start)
        values, vectors = np.linalg.eigh(modes.T @ likelihood.information @ modes / inflation)
        score = vectors.T @ (modes.T @ likelihood.score) / inflation
        widening = 1 + sizes_N**2 * np.maximum(values, 0.0)
        variance = sizes_N**2 / widening
        log_likelihoods.append(0.5 * np.sum(variance * score**2 - np.log(widening), axis=1))
        by_length.append((lengths, modes @ vectors, variance, variance * score))
    logs = np.array(log_likelihoods)
    best, size = np.unravel_index(np.argmax(logs), logs.shape)
    highest = logs[best, size]
    likelihoods = np.exp(logs - highest)
    evidence = highest + math.log(float(np.mean(likelihoods)))
    weights = np.where(logs > highest - NEGLIGIBLE_LOG_RATIO, likelihoods, 0.0)
    weights /= weights.sum()
    mean, second_moment = np.zeros(domain.size), np.zeros((domain.size, domain.size))
    for weight, (_, components, variance, means) in zip(weights, by_length, strict=True):
        if weight.any():
            mean += components @ (weight @ means)
            second_moment += components @ (np.diag(weight @ variance) + (means.T * weight) @ means) @ components.T
    lengths = by_length[best][0]
    return ForcePosterior(
        at_start,
        float(evidence) - 0.5 * likelihood.chi2_at_zero / inflation - 0.5 * likelihood.log_determinant,
        SmoothForce(domain, domain.prior_modes(lengths, at_start, SEARCHED_VARIANCE), float(sizes_N[size, 0])),
        lengths,
        mean,
        second_moment - np.outer(mean, mean),
        likelihood.chi2_at_zero - 2 * float(likelihood.score @ mean) + float(mean @ likelihood.information @ mean),
    )


def variable_weights(choices: Sequence[VariableChoice], error: float) -> dict[str, float]:
    """Posterior probabilities of choices of variables, with equal prior odds for one variable and for two. Returns by
    name of the choice, highest first.
    """
    counts = {size: sum(len(choice.domain.variables) == size for choice in choices) for size in (1, 2)}
    highest = max(choice.log_evidence for choice in choices)
    raw = {
        choice.domain.name: math.exp((choice.log_evidence - highest) / error) / counts[len(choice.domain.variables)]
        for choice in choices
    }
    return {name: value / sum(raw.values()) for name, value in sorted(raw.items(), key=lambda part: -part[1])}
