"""The missing force as a smooth function of one or two variables, estimated inside the trajectory fit.

The force is a Gaussian process over growth, speed, time since release or pressure, or over two of them together
(`vinetrack.diagnosis.force_surface`). Its coefficients are fitted to positions, through the response of the trajectory
to a force, with B, n, yield pressures and the release, origin, pressure and B of every trial free, each under its own
prior; positions are never differentiated. For each choice of variables

    ln Z = −½ χ²(ĉ) − ½ ln |H| + ½ ln |K⁻¹|,   H = ∇∇ ½χ² + K⁻¹

Misfit that no force explains is treated as further noise: χ² is divided by what the best force leaves per point.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.diagnosis.force_evidence import (
    CoefficientLikelihood,
    ForcePosterior,
    VariableChoice,
    coefficient_likelihood,
    marginal_likelihood,
    variable_weights,
)
from vinetrack.diagnosis.force_inversion import LinearInversion
from vinetrack.diagnosis.force_refinement import (
    CONVERGENCE_TOLERANCE,
    SearchPoint,
    normal_equations,
    optimise_smooth_force,
)
from vinetrack.diagnosis.force_sensitivities import FittedMotion, motions_of
from vinetrack.diagnosis.force_surface import (
    CONSTANT_AT_START,
    FREE_AT_START,
    VARIABLES,
    Domain,
    SmoothForce,
    candidate_domains,
)
from vinetrack.diagnosis.learned_variables import force_sentence, not_excluded, remarks
from vinetrack.diagnosis.likelihood_ratio import ANSWER_SET_DELTA_CHI2
from vinetrack.diagnosis.smoothed_motions import on_tracks
from vinetrack.inference.fit_result import Fit

if TYPE_CHECKING:
    import pandas as pd

LEARNED_COLUMNS = (*VARIABLES.values(), "force_N", "sigma_N", "trials", "condition")

LEAST_LOG_BAYES_FACTOR = 18.0  # ln Z in excess of that of no force from which a force is reported (chosen)

LEAST_CHI2_PER_POINT = 2.0  # χ² per point of the fit from which a force is estimated (chosen)

CHOICES_REFINED = {1: 1, 2: 3}  # Choices of one variable and of two for which the nonlinear problem is solved (chosen)

# Relative singular value below which a force along the motions does not determine a combination of splines (chosen)
PROJECTION_CUTOFF = 1e-3

# Effective number of independent residuals in a trial where a model leaves more than noise (chosen)
INDEPENDENT_PARTS_PER_TRIAL = 20

HYPERPARAMETER_UPDATES = 2  # Rounds of optimising the force and then its amplitude and length scales (chosen)

LEAST_EXPLAINED = 0.95  # Part of the misfit that the refined force must take away to be reported (chosen)

PLOT_POINTS, VISITED_DISTANCE = (60, 30), 0.06  # Points of a curve, and along each side of a map (chosen)


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
    sentence: str
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
            "sentence": self.sentence,
        }


@dataclass(frozen=True)
class _RefinedChoice:
    """A choice of variables after the nonlinear fit: where the search ended, and the likelihood there."""

    choice: VariableChoice
    point: SearchPoint
    likelihood: CoefficientLikelihood


def learned_force(
    fit: Fit, inversion: LinearInversion, motions: Sequence[FittedMotion], replicates: int
) -> LearnedForce | None:
    """Estimate the missing force over the variables with the highest marginal likelihood."""
    if inversion.chi2_without_force < LEAST_CHI2_PER_POINT * inversion.n_points:
        return None
    largest_N = max(float(np.max(np.nan_to_num(motion.pressure_Pa) * motion.trial.area_m2)) / 2 for motion in motions)
    linear = _linear_choices(fit, inversion, largest_N)
    if linear is None or linear.log_bayes_factor(linear.choices[0][0]) < LEAST_LOG_BAYES_FACTOR:
        return None
    refined = _refined_choices(fit, inversion, linear, largest_N)
    if not refined:
        return None
    refined = _restarted_from_best(fit, inversion, refined, linear.inflation, largest_N)
    inflation = max(min(each.likelihood.least_chi2 for each in refined) / inversion.n_points, 1.0)
    choices = [marginal_likelihood(each.choice.domain, each.likelihood, inflation, largest_N) for each in refined]
    chi2 = min(choice.best().chi2 for choice in choices)
    noise_chi2 = inversion.n_points
    if inversion.chi2_without_force - chi2 < LEAST_EXPLAINED * (inversion.chi2_without_force - noise_chi2):
        return None
    correlation_error = _correlation_error(inversion, inflation)
    error = max(0.5 * CONVERGENCE_TOLERANCE * chi2 / inflation, correlation_error)
    weights = variable_weights(choices, error)
    choice, solution = max(
        zip(choices, (each.point for each in refined), strict=True), key=lambda pair: weights[pair[0].domain.name]
    )
    # Start conditions are compared at one solution, so that the tolerance of the search cancels.
    best = choice.best(correlation_error)
    # Choices are excluded by the χ² of their best coefficients, without regard to how smooth those are.
    least_chi2 = {each.choice.domain.name: each.likelihood.least_chi2 for each in refined}
    losses = {name: (value - least_chi2[best.domain.name]) / inflation for name, value in least_chi2.items()}
    threshold = ANSWER_SET_DELTA_CHI2 * error
    alternatives = not_excluded(best.domain, weights, losses, threshold, linear.domains, linear.motions)
    misfit = max(inversion.chi2_without_force - inversion.n_points, 1e-300)
    table = _table(best, solution.motions)
    explained = min(max((inversion.chi2_without_force - best.chi2) / misfit, 0.0), 1.0)
    sentence = force_sentence(best, weights, alternatives, explained, table, choice.undecided_N)
    return LearnedForce(
        best=best,
        motions=solution.motions,
        weights=weights,
        not_excluded=tuple(alternatives),
        log_bayes_factor=linear.log_bayes_factor(
            next(choice for choice, _ in linear.choices if choice.domain == best.domain)
        ),
        explained=explained,
        table=table,
        sentence=" ".join([sentence, *remarks(replicates, linear.domains, alternatives)]),
        undecided_N=choice.undecided_N,
    )


@dataclass(frozen=True)
class _LinearChoices:
    """All choices of variables about motions on the tracks, by the linear inversion, most likely first. Each has the
    point where its nonlinear fit starts. `inflation` is the ratio of residual to noise variance that the best of them
    leaves.
    """

    choices: list[tuple[VariableChoice, SearchPoint]]
    motions: list[FittedMotion]
    inflation: float
    log_evidence_without_force: float

    @property
    def domains(self) -> list[Domain]:
        """The variables of all choices."""
        return [choice.domain for choice, _ in self.choices]

    def log_bayes_factor(self, choice: VariableChoice) -> float:
        """Log Bayes factor of a choice against no force."""
        return choice.log_evidence - self.log_evidence_without_force


def _linear_choices(fit: Fit, inversion: LinearInversion, largest_N: float) -> _LinearChoices | None:
    """Linearise about motions on the tracks and compute the marginal likelihood of every choice of variables."""
    effects = np.zeros_like(inversion.trial_effects)
    effects[:, : inversion.problem.release_origin_mean.shape[1]] = inversion.problem.release_origin_mean
    motions = on_tracks(inversion, effects, motions_of(fit, effects))
    forces = [SmoothForce(domain, np.eye(domain.size)) for domain in candidate_domains(motions)]
    starts = [
        SearchPoint(
            inversion.state.theta,
            effects,
            force,
            np.zeros(force.domain.size),
            list(motions),
            motions_include_force=False,
        )
        for force in forces
    ]
    likelihoods = [coefficient_likelihood(start, normal_equations(fit, inversion, start)) for start in starts]
    if not all(likelihood.is_finite for likelihood in likelihoods):
        return None
    inflation = max(min(likelihood.least_chi2 for likelihood in likelihoods) / inversion.n_points, 1.0)
    without_force = -0.5 * likelihoods[0].chi2_at_zero / inflation - 0.5 * likelihoods[0].log_determinant
    choices = [
        (marginal_likelihood(force.domain, likelihood, inflation, largest_N), start)
        for force, start, likelihood in zip(forces, starts, likelihoods, strict=True)
    ]
    choices.sort(key=lambda pair: -pair[0].log_evidence)
    return _LinearChoices(choices, motions, inflation, without_force)


def _correlation_error(inversion: LinearInversion, inflation: float) -> float:
    """Unit of differences of ln Z where residuals beyond the noise are correlated, so that points count as fewer."""
    points_per_part = max(inversion.n_points / (INDEPENDENT_PARTS_PER_TRIAL * len(inversion.data)), 1.0)
    return (1 + (inflation - 1) * points_per_part) / inflation


def _refined_choices(
    fit: Fit, inversion: LinearInversion, linear: _LinearChoices, largest_N: float
) -> list[_RefinedChoice]:
    """The best choices of each number of variables after the nonlinear fit, without those that cannot be simulated. One
    variable is refined too, even where two are more likely: far from the solution the linear inversion errs, most for
    what has few coefficients.
    """
    best_of_size = [
        pair
        for size, count in CHOICES_REFINED.items()
        for pair in [pair for pair in linear.choices if len(pair[0].domain.variables) == size][:count]
    ]
    refined = [_refined(fit, inversion, start, choice, linear.inflation, largest_N) for choice, start in best_of_size]
    return [
        _RefinedChoice(choice, *solution)
        for (choice, _), solution in zip(best_of_size, refined, strict=True)
        if solution is not None
    ]


def _restarted_from_best(
    fit: Fit,
    inversion: LinearInversion,
    refined: Sequence[_RefinedChoice],
    inflation: float,
    largest_N: float,
) -> list[_RefinedChoice]:
    """Every choice of two variables searched again from the solution of the best, and the lower χ² kept. The first
    search starts from the choice's own linear inversion. Where that is far off it may stop in a local minimum, and the
    choice would be excluded though it could represent the very force of the best.
    """
    best = min(refined, key=lambda each: each.likelihood.chi2_at_zero - each.likelihood.delta_chi2)
    least_chi2 = best.likelihood.least_chi2
    motions, domain = best.point.motions, best.choice.domain
    force_N = np.concatenate([domain.basis(domain.values_along(motion)) @ best.point.amplitude for motion in motions])
    kept = []
    for each in refined:
        kept.append(each)
        choice = each.choice
        excess = each.likelihood.least_chi2 - least_chi2
        if choice.domain == domain or len(choice.domain.variables) < 2 or excess < CONVERGENCE_TOLERANCE * least_chi2:
            continue
        basis = np.concatenate([choice.domain.basis(choice.domain.values_along(motion)) for motion in motions])
        amplitude = np.asarray(np.linalg.lstsq(basis, force_N, rcond=PROJECTION_CUTOFF)[0])
        start = replace(best.point, law=SmoothForce(choice.domain, np.eye(choice.domain.size)), amplitude=amplitude)
        again = _refined(fit, inversion, start, choice, inflation, largest_N)
        if again is not None and again[1].least_chi2 < each.likelihood.least_chi2:
            kept[-1] = _RefinedChoice(choice, *again)
    return kept


def _refined(
    fit: Fit,
    inversion: LinearInversion,
    point: SearchPoint,
    choice: VariableChoice,
    inflation: float,
    largest_N: float,
) -> tuple[SearchPoint, CoefficientLikelihood] | None:
    """The nonlinear fit of a force over given variables, alternating between the force and its hyperparameters. The
    force is constrained to be constant at the start of growth, and freed in a last round if that is more likely.
    """
    solution: tuple[SearchPoint, CoefficientLikelihood] | None = None
    every_spline = SmoothForce(choice.domain, np.eye(choice.domain.size))
    for update in range(HYPERPARAMETER_UPDATES + 1):
        likely = choice.best()
        surface = choice.with_start(CONSTANT_AT_START) if update < HYPERPARAMETER_UPDATES else likely.surface
        if update == HYPERPARAMETER_UPDATES and likely.at_start != FREE_AT_START:
            break
        # The search weighs positions by the noise alone, so the prior is narrowed as much as the noise is inflated.
        surface = replace(surface, sd_N=surface.sd_N / math.sqrt(inflation))
        amplitude = np.asarray(np.linalg.lstsq(surface.modes, point.amplitude, rcond=None)[0])
        optimum = optimise_smooth_force(fit, inversion, replace(point, law=surface, amplitude=amplitude))
        if optimum is None:
            break
        point = replace(optimum, law=every_spline, amplitude=surface.modes @ optimum.amplitude)
        likelihood = coefficient_likelihood(point, normal_equations(fit, inversion, point))
        # New hyperparameters may lead to a worse fit: the last solution is then kept.
        if not likelihood.is_finite or (solution is not None and likelihood.least_chi2 > solution[1].least_chi2):
            break
        solution = point, likelihood
        inflation = max(likelihood.least_chi2 / inversion.n_points, 1.0)
        choice = marginal_likelihood(choice.domain, likelihood, inflation, largest_N)
    return solution


def _table(best: ForcePosterior, motions: Sequence[FittedMotion]) -> pd.DataFrame:
    """The force on a grid, with the trials that visited each point, and along the first trial of each condition."""
    import pandas as pd

    domain = best.domain
    axes = [
        np.linspace(low, high, PLOT_POINTS[len(domain.variables) - 1])
        for low, high in zip(domain.low, domain.high, strict=True)
    ]
    grid = [axis.ravel() for axis in np.meshgrid(*axes, indexing="ij")]
    trials = np.zeros(grid[0].size)
    for motion in motions:
        near = np.ones((grid[0].size, motion.time_s.size), dtype=bool)
        near &= motion.time_s <= motion.counts_until_s
        visited = domain.normalised(domain.values_along(motion))
        for at, along in zip(domain.normalised(grid), visited, strict=True):
            near &= np.abs(at[:, None] - along) < VISITED_DISTANCE
        trials += near.any(axis=1)
    parts = [_rows(best, grid, trials, "")]
    drawn: set[str] = set()
    for motion in motions:
        if motion.trial.condition not in drawn:
            drawn.add(motion.trial.condition)
            last = int(np.count_nonzero(motion.time_s <= motion.counts_until_s)) - 1
            points = np.linspace(0, last, PLOT_POINTS[0]).astype(int)
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
