"""The missing force as a smooth function of one or two variables, estimated inside the trajectory fit.

The force is a Gaussian process over growth, speed, time since release or pressure, or over two of them together
(`vinetrack.diagnosis.force_inversion`). Its coefficients are fitted to positions, through the response of the
trajectory to a force, with B, n, yield pressures and the release, origin, pressure and B of every trial free, each
under its own prior; positions are never differentiated. For each choice of variables

    ln Z = −½ χ²(ĉ) − ½ ln |H| + ½ ln |K⁻¹|,   H = ∇∇ ½χ² + K⁻¹

Misfit that no force explains is treated as further noise: χ² is divided by what the best force leaves per point.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.core.problems import Remark, remark
from vinetrack.core.records import Floats
from vinetrack.diagnosis.force_inversion import (
    CONVERGENCE_TOLERANCE,
    CoefficientLikelihood,
    FittedMotion,
    ForcePoint,
    ForceProblem,
    optimise_force,
)
from vinetrack.diagnosis.force_laws import (
    CONSTANT_AT_START,
    FREE_AT_START,
    LENGTH_SCALES,
    RELATIVE_AMPLITUDES,
    SEARCHED_VARIANCE,
    VARIABLES,
    Domain,
    SmoothForce,
    candidate_domains,
    standard_error,
)
from vinetrack.diagnosis.likelihood_ratio import ANSWER_SET_DELTA_CHI2

if TYPE_CHECKING:
    import pandas as pd


# ------------------------------------------------------------------------------
# Marginal likelihood and posterior of a smooth force over given variables, averaged over its hyperparameters.
#
# A force that is zero where growth begins, one that is constant there and one that is free there are compared by
# their marginal likelihoods; `force_inversion` explains why the first is drawn unless the tracks contradict it.


# Log-likelihood below that of the best hyperparameters at which a set of them is left out of the mean and the band
# (chosen)
NEGLIGIBLE_LOG_RATIO = 5.0


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
        grid_points = 30  # Points over a variable at which the standard error of a force is evaluated (chosen)
        free = [each for each in self.posteriors if each.at_start == FREE_AT_START]
        if not free or self.domain.start_axis < 0:
            return 0.0
        grid = [
            np.linspace(low, high, grid_points) for low, high in zip(self.domain.low, self.domain.high, strict=True)
        ]
        grid[self.domain.start_axis] = np.full(grid_points, self.domain.low[self.domain.start_axis])
        return float(np.median(free[0].force(grid)[1]))


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


# ------------------------------------------------------------------------------
# Which variables a learned force may depend on when the trials cannot tell.
#
# Where speeds are steady, growth, speed and time are hardly three separate variables: a surface over two of them can
# be written over another two. Posterior weights then compare only how smooth the surfaces are, which depends on the
# prior. A choice of variables is therefore excluded by the misfit that it leaves, not by its weight alone.


def not_excluded(
    best: Domain, weights: Mapping[str, float], losses: Mapping[str, float], threshold: float, others: Sequence[Domain]
) -> list[str]:
    """Choices of variables, besides the best, that the trials do not exclude: those with enough weight, and those of no
    more variables than the best whose χ² is hardly larger; highest weight first.
    """
    # 0.05: weight from which a choice of variables is reported with the best (chosen)
    names = [
        domain.name
        for domain in others
        if domain.name != best.name
        and (
            weights[domain.name] >= 0.05
            or (len(domain.variables) <= len(best.variables) and losses[domain.name] < threshold)
        )
    ]
    return sorted(names, key=lambda name: -weights[name])


LEARNED_COLUMNS = (*VARIABLES.values(), "force_N", "sigma_N", "trials", "condition")


LEAST_CHI2_PER_POINT = 2.0  # χ² per point of the fit from which a force is estimated (chosen)


@dataclass(frozen=True)
class LearnedForce:
    """The missing force over the variables that it most likely depends on. `best` is the posterior of the force;
    `motions` are those of the trials at the solution.
    """

    best: ForcePosterior
    motions: Sequence[FittedMotion]
    weights: Mapping[str, float]
    not_excluded: tuple[str, ...]
    log_bayes_factor: float
    explained: float
    table: pd.DataFrame
    sentence: Remark
    undecided_N: float = 0.0

    @property
    def domain(self) -> Domain:
        """The variables that the force depends on, with their ranges."""
        return self.best.domain

    def to_json(self) -> dict[str, Any]:
        """As `diagnosis.json` holds it."""
        return {
            "variables": list(self.domain.variables),
            "weights": dict(self.weights),
            "not_excluded": list(self.not_excluded),
            "length_scales": dict(zip(self.domain.variables, self.best.length_scales, strict=True)),
            "amplitude_N": self.best.surface.sd_N,
            "log_bayes_factor": self.log_bayes_factor,
            "explained": self.explained,
            "begins": self.best.at_start,
            "undecided_N": self.undecided_N,
            "sentence": str(self.sentence),
        }


def learned_force(problem: ForceProblem) -> LearnedForce | None:
    """Estimate the missing force over the variables with the highest marginal likelihood. All choices of variables are
    compared about the same motions: those on the tracks, then those under the force that leaves least.
    """
    seen = _choices_seen_from(problem, problem.tracks)
    if seen is None or seen.chi2_without_force < LEAST_CHI2_PER_POINT * problem.n_points:
        return None
    log_bayes_factors = {each.domain.name: each.log_evidence - seen.log_evidence_without_force for each in seen.choices}
    # 18.0: ln Z in excess of that of no force from which a force is reported (chosen)
    if max(log_bayes_factors.values()) < 18.0:
        return None
    chi2_without_force = seen.chi2_without_force
    point = _under_best(problem, seen)
    again = None if point is None else _choices_seen_from(problem, point)
    if again is None:
        return None
    seen = again
    # 20: effective number of independent residuals in a trial where a model leaves more than noise (chosen)
    points_per_part = max(problem.n_points / (20 * len(problem.data)), 1.0)
    # Unit of differences of ln Z where residuals beyond the noise are correlated, so that points count as fewer, and
    # where the search has ended short of the least χ²
    correlated = (1 + (seen.inflation - 1) * points_per_part) / seen.inflation
    error = max(0.5 * CONVERGENCE_TOLERANCE * min(seen.least_chi2.values()) / seen.inflation, correlated)
    weights = variable_weights(seen.choices, error)
    choice = max(seen.choices, key=lambda each: weights[each.domain.name])
    best = choice.best(correlated)
    misfit = chi2_without_force - problem.n_points
    explained = (chi2_without_force - best.chi2) / misfit
    # 0.95: part of the misfit that the force must take away to be reported (chosen)
    if explained < 0.95:
        return None
    # Choices are excluded by the χ² of their best coefficients, without regard to how smooth those are.
    losses = {
        name: (chi2 - seen.least_chi2[best.domain.name]) / seen.inflation for name, chi2 in seen.least_chi2.items()
    }
    alternatives = not_excluded(best.domain, weights, losses, ANSWER_SET_DELTA_CHI2 * error, seen.domains)
    table, explained = _table(best, seen.point.motions), min(explained, 1.0)
    visited = table[(table["condition"] == "") & (table["trials"] > 0)]
    return LearnedForce(
        best=best,
        motions=seen.point.motions,
        weights=weights,
        not_excluded=tuple(alternatives),
        log_bayes_factor=log_bayes_factors[best.domain.name],
        explained=explained,
        table=table,
        sentence=remark(
            "learned_force",
            name=best.domain.name,
            weights=weights,
            alternatives=alternatives,
            begins=best.at_start if best.domain.start_axis >= 0 else "",
            range_N=(float(visited["force_N"].min()), float(visited["force_N"].max())),
            sigma_N=float(visited["sigma_N"].median()),
            undecided_N=choice.undecided_N,
            explained=explained,
            is_repeated=bool(problem.scatter.dof),
            has_pressures=any("pressure" in domain.variables for domain in seen.domains),
        ),
        undecided_N=choice.undecided_N,
    )


@dataclass(frozen=True)
class _Choices:
    """All choices of variables about the motions of a point, most likely first. `inflation` is the ratio of residual to
    noise variance that the best coefficients of any of them leave, `least_chi2` what those of each leave, by name.
    """

    point: ForcePoint
    choices: list[VariableChoice]
    inflation: float
    least_chi2: dict[str, float]
    chi2_without_force: float
    log_evidence_without_force: float

    @property
    def domains(self) -> list[Domain]:
        """The variables of all choices."""
        return [choice.domain for choice in self.choices]


def _choices_seen_from(problem: ForceProblem, point: ForcePoint) -> _Choices | None:
    """The marginal likelihood of every choice of variables; None where they cannot be computed."""
    largest_N = max(float(np.max(np.nan_to_num(m.pressure_Pa) * m.trial.area_m2)) / 2 for m in point.motions)
    domains = candidate_domains(point.motions)
    likelihoods = [
        problem.linearised(point.asking(SmoothForce(domain, np.eye(domain.size)))).likelihood() for domain in domains
    ]
    if not all(likelihood.is_finite for likelihood in likelihoods):
        return None
    inflation = max(min(likelihood.least_chi2 for likelihood in likelihoods) / problem.n_points, 1.0)
    chi2_without_force = likelihoods[0].chi2_at_zero
    choices = [
        marginal_likelihood(domain, likelihood, inflation, largest_N)
        for domain, likelihood in zip(domains, likelihoods, strict=True)
    ]
    return _Choices(
        point,
        sorted(choices, key=lambda choice: -choice.log_evidence),
        inflation,
        {domain.name: likelihood.least_chi2 for domain, likelihood in zip(domains, likelihoods, strict=True)},
        chi2_without_force,
        -0.5 * chi2_without_force / inflation - 0.5 * likelihoods[0].log_determinant,
    )


def _under_best(problem: ForceProblem, seen: _Choices) -> ForcePoint | None:
    """The motions under the most probable force of the most likely variable or of the most likely two, whichever leaves
    less: far from the solution, two are often the more likely for errors of the linear equations alone. The force is
    constant at the start of growth: what motions on the tracks lack there would be fitted as a force.
    """
    optima = []
    for size in (1, 2):
        choice = next((each for each in seen.choices if len(each.domain.variables) == size), None)
        if choice is None:
            continue
        likely = max(choice.posteriors, key=lambda each: each.log_evidence)
        modes = choice.domain.prior_modes(likely.length_scales, CONSTANT_AT_START, SEARCHED_VARIANCE)
        # The search weighs positions by the noise alone, so the prior is narrowed as much as the noise is inflated.
        surface = SmoothForce(choice.domain, modes, likely.surface.sd_N / math.sqrt(seen.inflation))
        optima.append(optimise_force(problem, seen.point.asking(surface)))
    found = [optimum for optimum in optima if optimum is not None]
    return min(found, key=lambda optimum: optimum.cost).point if found else None


def _table(best: ForcePosterior, motions: Sequence[FittedMotion]) -> pd.DataFrame:
    """The force on a grid, with the trials that visited each point, and along the first trial of each condition."""
    import pandas as pd

    plot_points, visited_distance = (60, 30), 0.06  # Points of a curve, and along each side of a map (chosen)
    domain = best.domain
    axes = [
        np.linspace(low, high, plot_points[len(domain.variables) - 1])
        for low, high in zip(domain.low, domain.high, strict=True)
    ]
    grid = [axis.ravel() for axis in np.meshgrid(*axes, indexing="ij")]
    trials = np.zeros(grid[0].size)
    for motion in motions:
        near = np.ones((grid[0].size, motion.time_s.size), dtype=bool)
        near &= motion.time_s <= motion.counts_until_s
        visited = domain.normalised(domain.values_along(motion))
        for at, along in zip(domain.normalised(grid), visited, strict=True):
            near &= np.abs(at[:, None] - along) < visited_distance
        trials += near.any(axis=1)
    parts = [_rows(best, grid, trials, "")]
    drawn: set[str] = set()
    for motion in motions:
        if motion.trial.condition not in drawn:
            drawn.add(motion.trial.condition)
            last = int(np.count_nonzero(motion.time_s <= motion.counts_until_s)) - 1
            points = np.linspace(0, last, plot_points[0]).astype(int)
            values = [along[points] for along in domain.values_along(motion)]
            parts.append(_rows(best, values, np.ones(points.size), motion.trial.condition))
    return pd.concat(parts, ignore_index=True)


def _rows(best: ForcePosterior, values: Sequence[Floats], trials: Floats, condition: str) -> pd.DataFrame:
    import pandas as pd

    force, sigma = best.force(values)
    given = {VARIABLES[name]: at for name, at in zip(best.domain.variables, values, strict=True)}
    columns = {name: given.get(name, np.full(force.size, math.nan)) for name in VARIABLES.values()}
    return pd.DataFrame(
        columns | {"force_N": force, "sigma_N": sigma, "trials": trials.astype(int), "condition": condition}
    )
