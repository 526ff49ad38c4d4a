"""Linear inversion for missing forces: generalised least squares with model parameters and trial effects free.

The fit is linearised about its parameters and about given trial effects. With a force of amplitudes f, positions are

    y = J δθ + Z b_i + S f + e

J the sensitivities to the model parameters θ, Z those to the effects b_i of trial i (release, origin, pressure, B), S
those to the force amplitudes (`vinetrack.diagnosis.force_sensitivities`), and e AR(1) noise of the tracks. θ and b_i
have normal priors. The trial effects are eliminated trial by trial, the model parameters over all trials (Schur
complements of the normal equations), so that only equations for f remain.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.diagnosis.replicate_scatter import LEAST_BETWEEN_TRIAL_SD, Scatter
from vinetrack.inference.fit_problem import track_correlation, variance_floor
from vinetrack.inference.fit_result import Fit
from vinetrack.inference.mixed_effects import DEVIATION_COLUMNS, FitState, trial_effect_prior
from vinetrack.inference.optimiser import FixedTerms, solve
from vinetrack.inference.sensitivity import N_TRIAL_EFFECTS
from vinetrack.inference.whitening import whiten

INDEPENDENT_POINTS_PER_TRIAL = 10.0  # Effective number of independent residuals in one trial (chosen)

MAX_TRIAL_EFFECT_ITERATIONS = 8  # Most iterations of the trial effects (chosen)

# Part of the largest information below which a force amplitude is not estimable (chosen)
LEAST_RELATIVE_INFORMATION = 1e-9

PARAMETER_CUTOFF = 1e-11  # Relative eigenvalue below which a combination of model parameters is not estimable (derived)

# Penalties on second differences among which generalised cross-validation chooses, relative to the mean information
# about a coefficient (chosen)
SMOOTHING_PENALTIES = np.geomspace(1e-6, 1e2, 17)


@dataclass(frozen=True)
class ForceEstimate:
    """Least-squares estimate of force amplitudes, N, and the fall of χ² that they bring. `sigma` is the root mean
    square standard error of an amplitude. `parameter_shift` is how far the model parameters move along, in the fit's
    own scaling.
    """

    delta_chi2: float
    amplitude: Floats
    sigma: float
    parameter_shift: Floats
    degrees_of_freedom: int

    @property
    def delta_chi2_beyond_chance(self) -> float:
        """The fall of χ² in excess of its expectation under no force; at least 0."""
        return max(self.delta_chi2 - self.degrees_of_freedom, 0.0)


class LinearInversion:
    """A fit linearised about its parameters and given trial effects, ready to estimate any number of forces. The noise
    variance is that of the tracks, so that misfit of the model does not count as noise. Pressure and B of a trial have
    the standard deviations estimated from replicates.
    """

    def __init__(self, fit: Fit, trial_effects: Floats, scatter: Scatter) -> None:
        data, problem = fit.predictor.data, fit.solution.problem
        rho = track_correlation(data)
        noise = np.array([trial_data.noise_m**2 for trial_data in data]) * (1 - rho**2)
        self.scatter = scatter
        spread = (max(scatter.pressure, LEAST_BETWEEN_TRIAL_SD[0]), max(scatter.damping, LEAST_BETWEEN_TRIAL_SD[1]))
        fitted = fit.solution.state
        state = FitState(fitted.theta, trial_effects, spread, rho, np.maximum(noise, variance_floor(data)))
        parameters_held = replace(problem, free=np.zeros_like(problem.free))
        noise_held = FixedTerms(spread, (rho, state.variance))
        solution = solve(
            fit.predictor, parameters_held, state, noise_held, warm=True, most_iterations=MAX_TRIAL_EFFECT_ITERATIONS
        )
        self.data, self.problem = data, problem
        self.state, self.columns = solution.state, solution.columns
        self.trial_effect_precision = trial_effect_prior(problem, self.state)[1]
        self.prior_score = -problem.prior_precision * (state.theta - problem.prior_mean)
        self.conditions = [trial_data.trial.condition for trial_data in data]
        self.n_points = float(sum(trial_data.time_s.size for trial_data in data))

    @property
    def trial_effects(self) -> Floats:
        """The trial effects about which everything is linear, shape (n_trials, 4)."""
        return self.state.trial_effects

    def estimate_each(self, sensitivities: Sequence[Floats], columns: Sequence[int]) -> list[ForceEstimate]:
        """Estimate each of several forces with none of the others present. Shapes: sensitivities (n_points,
        n_columns).
        """
        products = self._products_without_trial_effects(sensitivities)
        matrix, cross, total = self._sums_over_trials(products)
        parameter_response = scaled_pseudo_inverse(matrix, PARAMETER_CUTOFF) @ cross
        reduced = total - cross.T @ parameter_response
        ends = np.concatenate([[0], np.cumsum(columns)])
        return [
            self._estimate(products, parameter_response, reduced, slice(a, b))
            for a, b in itertools.pairwise(ends.tolist())
        ]

    def estimate_jointly(self, sensitivities: Sequence[Floats]) -> ForceEstimate:
        """Estimate all force amplitudes together, the same in every trial. Shapes: sensitivities (n_points,
        n_columns).
        """
        return self.estimate_each(sensitivities, [sensitivities[0].shape[1]])[0]

    def estimate_by_condition(self, sensitivities: Sequence[Floats]) -> ForceEstimate:
        """Estimate all force amplitudes together, with separate amplitudes for each condition. Shapes: sensitivities
        (n_points, n_columns).
        """
        names = list(dict.fromkeys(self.conditions))
        count = sensitivities[0].shape[1]
        of_conditions = []
        for condition, of_trial in zip(self.conditions, sensitivities, strict=True):
            block = np.zeros((len(of_trial), count * len(names)))
            k = names.index(condition) * count
            block[:, k : k + count] = of_trial
            of_conditions.append(block)
        return self.estimate_jointly(of_conditions)

    @cached_property
    def chi2_without_force(self) -> float:
        """χ² with model parameters and trial effects re-estimated and no force added."""
        products = self._products_without_trial_effects([np.zeros((len(c), 0)) for c in self.columns])
        matrix, cross, total = self._sums_over_trials(products)
        covariance = scaled_pseudo_inverse(matrix, PARAMETER_CUTOFF)
        return float(total[-1, -1] - cross[:, -1] @ covariance @ cross[:, -1])

    def bic(self, delta_chi2: float, n_parameters: int, largest_delta_chi2: float) -> float:
        """Bayesian information criterion of a force, relative to the force that explains most: smaller is better. The
        misfit that not even the best force explains is counted as further noise: it inflates the variance of every
        independent residual. Source: Schwarz, Annals of Statistics 6, 461 (1978), with χ² divided by that inflation.
        """
        independent_points = INDEPENDENT_POINTS_PER_TRIAL * len(self.data)
        unexplained = max(self.chi2_without_force - largest_delta_chi2 - self.n_points, 0.0)
        misfit = (largest_delta_chi2 - delta_chi2) / (1 + unexplained / independent_points)
        return misfit + n_parameters * math.log(independent_points)

    def smooth_force_by_condition(
        self, sensitivities: Sequence[Floats], parameter_shift: Floats
    ) -> dict[str, tuple[Floats, Floats]]:
        """Estimate a smooth force in every condition: spline coefficients and their covariance. The coefficients
        minimise χ² plus a penalty on their second differences (a P-spline, Eilers & Marx 1996). One penalty for all
        conditions is chosen by generalised cross-validation. Returns dict of (coefficients, covariance): By condition;
        shapes (n_columns,) in N and (n_columns, n_columns) in N². Shapes: sensitivities (n_points, n_columns);
        parameter_shift (n_free,).
        """
        products = self._products_without_trial_effects(sensitivities)
        k = self.problem.index.shape[1]
        shift_of_keys = np.append(parameter_shift, 0.0)[self.problem.index]
        names = list(dict.fromkeys(self.conditions))
        condition_of_trial = np.array([names.index(condition) for condition in self.conditions])
        count = sensitivities[0].shape[1]
        information, score = np.zeros((len(names), count, count)), np.zeros((len(names), count))
        residual_products = products[:, k:, -1] - np.einsum("nlk,nk->nl", products[:, k:, :k], shift_of_keys)
        np.add.at(information, condition_of_trial, products[:, k:-1, k:-1])
        np.add.at(score, condition_of_trial, residual_products[:, :-1])
        second_difference = np.diff(np.eye(count), 2, axis=0)
        unit = float(np.mean(np.einsum("nkk->n", information))) / count
        roughness = unit * (second_difference.T @ second_difference + 1e-6 * np.eye(count))
        best: tuple[float, Floats, Floats] | None = None
        independent_points = INDEPENDENT_POINTS_PER_TRIAL * len(self.data)
        unpenalised = np.linalg.solve(information + 1e-9 * roughness, score[:, :, None])[:, :, 0]
        largest_gain = float(np.sum(score * unpenalised))
        for penalty in SMOOTHING_PENALTIES:
            inverse = np.linalg.inv(information + penalty * roughness)
            coefficients = np.einsum("nkl,nl->nk", inverse, score)
            lost_gain = largest_gain - float(
                np.sum(2 * coefficients * score) - np.einsum("nk,nkl,nl->", coefficients, information, coefficients)
            )
            degrees_of_freedom = float(np.einsum("nkl,nlk->", inverse, information))
            cross_validation = (lost_gain + independent_points) / max(independent_points - degrees_of_freedom, 1.0) ** 2
            if best is None or cross_validation < best[0]:
                best = cross_validation, coefficients, inverse
        assert best is not None
        residual_dof = max(self.n_points - count * len(names), 1.0)
        unmoved = not parameter_shift.any()
        inflation = max(1.0, (self.chi2_without_force - largest_gain) / residual_dof) if unmoved else 1.0
        return {name: (best[1][i], inflation * best[2][i]) for i, name in enumerate(names)}

    def _products_without_trial_effects(self, sensitivities: Sequence[Floats]) -> Floats:
        """Cross products of [parameters, forces, residual] of each trial, its trial effects eliminated. Shape
        (n_trials, n_keys + n_forces + 1, the same again).
        """
        products = []
        for i, (columns, of_force) in enumerate(zip(self.columns, sensitivities, strict=True)):
            deviations = self.state.trial_effects[i, list(DEVIATION_COLUMNS)]
            residual = columns[:, -1] + columns[:, list(DEVIATION_COLUMNS)] @ deviations
            rows = np.column_stack([columns[:, :-1], of_force, residual])
            white = whiten(rows, self.data[i].first, self.state.rho, self.data[i].relative_sd)
            gram = white.T @ white / self.state.variance[i]
            effects, others = slice(None, N_TRIAL_EFFECTS), slice(N_TRIAL_EFFECTS, None)
            of_effects = gram[effects, effects] + np.diag(self.trial_effect_precision[i])
            eliminated = gram[others, effects] @ np.linalg.solve(of_effects, gram[effects, others])
            products.append(gram[others, others] - eliminated)
        return np.array(products)

    def _sums_over_trials(self, products: Floats) -> tuple[Floats, Floats, Floats]:
        """Normal equations over all trials, with the priors of the p model parameters. Blocks: parameters by parameters
        (p, p); parameters by [forces, residual] (p, L + 1); the latter by themselves.
        """
        k, p = self.problem.index.shape[1], self.prior_score.size
        index = self.problem.index
        matrix, cross = np.zeros((p + 1, p + 1)), np.zeros((p + 1, products.shape[1] - k))
        np.add.at(matrix, (index[:, :, None], index[:, None, :]), products[:, :k, :k])
        np.add.at(cross, index, products[:, :k, k:])
        matrix, cross = matrix[:p, :p] + np.diag(self.problem.prior_precision), cross[:p].copy()
        cross[:, -1] += self.prior_score
        held = ~self.problem.free | ~(np.diag(matrix) > 0)
        matrix[held, :] = matrix[:, held] = cross[held] = 0.0
        return matrix, cross, products[:, k:, k:].sum(axis=0)

    def _estimate(self, products: Floats, parameter_response: Floats, reduced: Floats, columns: slice) -> ForceEstimate:
        """The force whose amplitudes are in `columns`, from the equations with all other unknowns eliminated. Its
        standard error is the larger of the model-based one and the cluster-robust one with trials as clusters.
        """
        information, score = reduced[columns, columns], reduced[columns, -1]
        size = np.diag(information)
        estimable = size > LEAST_RELATIVE_INFORMATION * max(float(size.max()), 1e-300)
        if not estimable.any():
            return ForceEstimate(0.0, np.zeros(score.size), math.inf, np.zeros(parameter_response.shape[0]), 0)
        covariance = scaled_pseudo_inverse(information, LEAST_RELATIVE_INFORMATION, estimable)
        amplitude = covariance @ score
        shift = parameter_response[:, -1] - parameter_response[:, columns] @ amplitude
        scores = self._scores_by_trial(products, parameter_response[:, columns], columns, amplitude, shift)
        n_trials = len(scores)
        residual_dof = max(n_trials - shift.size - score.size, 1)
        robust = covariance @ (scores.T @ scores * n_trials / residual_dof) @ covariance
        sigma = math.sqrt(max(float(np.trace(covariance)), float(np.trace(robust))) / score.size)
        return ForceEstimate(float(score @ amplitude), amplitude, sigma, shift, int(np.count_nonzero(estimable)))

    def _scores_by_trial(
        self, products: Floats, parameter_response: Floats, columns: slice, amplitude: Floats, shift: Floats
    ) -> Floats:
        """Contribution of each trial to the score of the amplitudes at the estimate, shape (n_trials, n_columns)."""
        k = self.problem.index.shape[1]
        index = self.problem.index
        shift_of_keys = np.append(shift, 0.0)[index]
        forces = slice(k + columns.start, k + columns.stop)
        residual_products = (
            products[:, :, -1]
            - np.einsum("nqk,nk->nq", products[:, :, :k], shift_of_keys)
            - products[:, :, forces] @ amplitude
        )
        response_of_keys = np.vstack([parameter_response, np.zeros((1, parameter_response.shape[1]))])[index]
        return np.asarray(
            residual_products[:, forces] - np.einsum("nkl,nk->nl", response_of_keys, residual_products[:, :k])
        )


def scaled_pseudo_inverse(matrix: Floats, cutoff: float, estimable: NDArray[np.bool_] | None = None) -> Floats:
    """Pseudo-inverse of a symmetric matrix after scaling its diagonal to 1. Returns zero in the rows and columns that
    do not take part. Shapes: matrix (n, n); estimable (n,) → (n, n).
    """
    diagonal = np.diag(matrix)
    scale = np.where(diagonal > 0 if estimable is None else estimable, 1 / np.sqrt(np.maximum(diagonal, 1e-300)), 0.0)
    inverse = np.linalg.pinv(matrix * scale[:, None] * scale, rcond=cutoff, hermitian=True)
    return np.asarray(inverse * scale[:, None] * scale)
