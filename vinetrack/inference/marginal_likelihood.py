"""The mixed-effects model of a fit, and its marginal and restricted likelihood: trial effects (and parameters) out.

Between-trial standard deviations and noise maximise the restricted likelihood (REML; Patterson & Thompson, Biometrika
58, 545, 1971).
"""

from __future__ import annotations

import itertools
import math
from dataclasses import KW_ONLY, dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.process import njit
from vinetrack.core.records import Floats
from vinetrack.inference.gaussian_processes import at_correlation
from vinetrack.inference.sensitivity import DAMPING_DEVIATION, N_TRIAL_EFFECTS, PRESSURE, RELEASE

# ------------------------------------------------------------------------------
# The nonlinear mixed-effects model of a fit, and its linearisation about the current trajectories.
#
# Point j of trial i, of vine v(i), is measured at time t_ij and lies at
#
#     y_ij = o_i + f(t_ij − r_i; θ, ln B_v(i) + b_i + z_iᵀγ, P_i (1 + p_i + z_iᵀγ)) + e_ij
#
# About the current θ and u_i the residuals are linear in both, r_i = X_i Δθ + Z_i Δu_i + e_i, with the sensitivities of
# `vinetrack.inference.sensitivity`. Variances of this linear model and steps of θ and u_i are computed in turn until
# neither changes (Lindstrom & Bates, Biometrics 46, 673, 1990; Pinheiro & Bates, Mixed-Effects Models in S and S-PLUS,
# Springer 2000, chapter 7).

# ------------------------------------------------------------------------------
# Compiled loops over trials for the likelihood of the variance components, which a fit evaluates some thousand times.
#
# Each trial has only a handful of columns, so that with array operations most of the time would go into calling them.

RIDGE = 1e-13  # Added to the diagonal of systems with a unit diagonal before they are solved (derived)


@njit(nogil=True, error_model="numpy")
def step_within_bounds(
    square: Floats, slope: Floats, below: Floats, above: Floats, free: NDArray[np.bool_]
) -> tuple[Floats, NDArray[np.bool_]]:
    """Step to the minimum of a quadratic form, at most `below` down and `above` up. Primal active-set method (Nocedal &
    Wright, Numerical Optimization, 2nd ed., Springer 2006, algorithm 16.3): a parameter that meets its bound is held
    there while the others go on. Returns step, moving (parameters that do not end at a bound). Shapes: square (n, n);
    slope, below, above, free (n,).
    """
    n, moving = slope.size, free.copy()
    step, outward, left, remaining, lower = np.zeros(n), np.zeros(n), slope.copy(), np.zeros(n), np.empty((n, n))
    for u in range(n):
        moving[u] = free[u] and square[u, u] > 0
    # 10: bounds met or released per parameter, at most, in the search for the minimum within bounds (chosen)
    for _ in range(10 * n + 1):
        solve_moving(square, left, moving, lower, remaining)
        # Go as far as the first bound, which lowers the sum of squares; fix that parameter, go on with the rest.
        part, first = 1.0, -1
        for u in range(n):
            room = max(above[u] - step[u] if remaining[u] > 0 else below[u] + step[u], 0.0)
            if room < part * abs(remaining[u]):
                part, first = room / abs(remaining[u]), u
        for u in range(n):
            step[u] += part * remaining[u]
        for u in range(n):
            left[u] = slope[u]
            for v in range(n):
                left[u] -= square[u, v] * step[v]
        if first >= 0:
            moving[first], outward[first] = False, math.copysign(1.0, remaining[first])
            continue
        # 1e-6: decrease of −2 ln L, by leaving its bound, from which a parameter is released (derived)
        most = 1e-6
        for u in range(n):
            inward = 0.0 if moving[u] else max(-outward[u] * left[u], 0.0)
            if inward**2 > most * square[u, u]:
                most, first = inward**2 / square[u, u], u
        if first < 0:
            break
        moving[first] = True
    return step, moving


@njit(nogil=True, error_model="numpy")
def solve_moving(square: Floats, slope: Floats, moving: NDArray[np.bool_], lower: Floats, solution: Floats) -> None:
    """Solve a symmetric system, scaled to a unit diagonal, for the moving unknowns; the others, and those without
    information of their own, stay 0. `lower` becomes its factor L D Lᵀ with D on the diagonal. Shapes: square, lower
    (n, n); slope, moving, solution (n,).
    """
    n, scale = slope.size, np.zeros(slope.size)
    for u in range(n):
        if moving[u]:
            scale[u] = 1 / math.sqrt(square[u, u])
        solution[u] = scale[u] * slope[u]
        for v in range(u + 1):
            left = scale[u] * square[u, v] * scale[v]
            for w in range(v):
                left -= lower[u, w] * lower[v, w] * lower[w, w]
            lower[u, v] = left if u == v else left / lower[v, v]
        # 1e-9: least pivot, the part of its information that an unknown keeps once the previous ones are eliminated
        # (derived); 1e300: as if it were known
        if not lower[u, u] > 1e-9:
            lower[u, u] = 1e300
        for v in range(u):
            solution[u] -= lower[u, v] * solution[v]
    for u in range(n):
        solution[u] /= lower[u, u]
    for u in range(n - 1, -1, -1):
        for v in range(u + 1, n):
            solution[u] -= lower[v, u] * solution[v]
    for u in range(n):
        solution[u] *= scale[u]


@njit(nogil=True, error_model="numpy")
def without_deviations(blocks: Floats, deviation_sd: Floats) -> tuple[Floats, float]:
    """Blocks of trials with their first two unknowns, of standard deviations S, integrated out; and the sum over trials
    of ln det(I + S Z S), Z the cross products of the two. Shapes: blocks (n_trials, k, k); deviation_sd (n_trials, 2) →
    (n_trials, k − 2, k − 2).
    """
    left, log_det = np.empty((len(blocks), blocks.shape[1] - 2, blocks.shape[1] - 2)), 0.0
    for i in range(len(blocks)):
        block, sd_pressure, sd_damping = blocks[i], deviation_sd[i, 0], deviation_sd[i, 1]
        # Eliminated one after the other, by the Cholesky factor of I + S Z S. At steady speed its two columns are
        # nearly collinear, and the explicit inverse would lose the residual of precise positions to cancellation.
        pivot_pressure = 1.0 + sd_pressure**2 * block[0, 0]
        of_pressure = sd_pressure * block[0] / math.sqrt(pivot_pressure)
        pivot_damping = 1.0 + sd_damping**2 * (block[1, 1] - of_pressure[1] ** 2)
        of_damping = sd_damping * (block[1] - of_pressure[1] * of_pressure) / math.sqrt(pivot_damping)
        log_det += math.log(pivot_pressure) + math.log(pivot_damping)
        for u in range(len(left[i])):
            for v in range(len(left[i])):
                of_both = of_pressure[u + 2] * of_pressure[v + 2] + of_damping[u + 2] * of_damping[v + 2]
                left[i, u, v] = block[u + 2, v + 2] - of_both
    return left, log_det


@njit(nogil=True, error_model="numpy")
def added_up(
    blocks: Floats, index: NDArray[np.int_], prior_precision: Floats, deviation: Floats
) -> tuple[Floats, Floats, float]:
    """`MixedProblem.summed`, given the deviations of the parameters from the means of their priors, (n_free,)."""
    square, slope, keys = np.diag(prior_precision), -prior_precision * deviation, index.shape[1]
    total = np.sum(prior_precision * deviation**2)
    for i in range(len(blocks)):
        for u in range(keys):
            if index[i, u] >= 0:
                slope[index[i, u]] += blocks[i, u, keys]
                for v in range(keys):
                    if index[i, v] >= 0:
                        square[index[i, u], index[i, v]] += blocks[i, u, v]
        total += blocks[i, keys, keys]
    return square, slope, total


@njit(nogil=True, error_model="numpy")
def profiled(
    blocks: Floats, deviation_sd: Floats, index: NDArray[np.int_], prior_precision: Floats, deviation: Floats,
    below: Floats, above: Floats, free: NDArray[np.bool_], random: NDArray[np.bool_], restricted: bool,
) -> Floats:  # fmt: skip
    """`Linearised.deviances`, without their constant. Shapes: deviation_sd (n, n_trials, 2) → (n,)."""
    deviances = np.empty(len(deviation_sd))
    for k in range(len(deviation_sd)):
        left, log_det = without_deviations(blocks, deviation_sd[k])
        square, slope, total = added_up(left, index, prior_precision, deviation)
        # A parameter at its bound must not be credited with the decrease beyond the bound.
        step, moving = step_within_bounds(square, slope, below, above, free)
        deviances[k] = total + log_det - np.sum(step * (2 * slope - square @ step))
        # Random effects w of groups of trials are integrated out. With w ~ N(0, D²) and M the information of the data
        # on w, the Gaussian integral of exp(−½ wᵀ(M + D⁻²)w) / det D is det(D (M + D⁻²) D)^(−½). So a hypothesis with
        # many groups is penalised for each of them.
        counted = np.flatnonzero(moving if restricted else moving & random)
        if counted.size:
            deviances[k] += np.linalg.slogdet(square[counted][:, counted])[1]
        if not restricted:
            deviances[k] -= np.sum(np.log(prior_precision[counted]))
    return deviances


LEAST_BETWEEN_TRIAL_SD = 1e-5  # Least between-trial standard deviation (chosen)

DEVIATION_COLUMNS = (PRESSURE, DAMPING_DEVIATION)


@dataclass(frozen=True)
class FitState:
    """Current estimates of a fit."""

    theta: Floats
    trial_effects: Floats
    spread: tuple[float, float]
    rho: float
    variance: Floats


@dataclass(frozen=True)
class MixedProblem:
    """The constant part of a fit: design, priors and bounds. `index`, shape (n_trials, n_keys), maps each trial's
    sensitivity columns to the free parameters, -1 where a trial does not depend on one.
    """

    index: NDArray[np.int_]
    has_deviation: NDArray[np.bool_]
    gauge_error: Floats
    release_origin_mean: Floats
    release_origin_precision: Floats
    release_reach_s: Floats
    prior_mean: Floats
    prior_precision: Floats
    lower: Floats
    upper: Floats
    free: NDArray[np.bool_]
    points: Floats
    stretches: Floats
    least_variance: Floats
    random: NDArray[np.bool_]
    own_errors: int = 0  #: systematic errors of a trial alone, its unknowns after its effects, with priors N(0, 1)

    @property
    def n_effects(self) -> int:
        """Unknowns of each trial alone."""
        return N_TRIAL_EFFECTS + self.own_errors

    def with_unknowns(self, places: NDArray[np.int_], precision: Floats) -> MixedProblem:
        """The problem with further parameters, each with a normal prior of mean 0 and given precision, (n_further,).
        `places`, (n_trials, n_columns), tells to which of them a further column of a trial belongs, -1 for none.
        """
        count, known = precision.size, self.prior_mean.size
        return replace(
            self,
            index=np.column_stack([self.index, np.where(places >= 0, known + places, -1)]),
            prior_mean=np.append(self.prior_mean, np.zeros(count)),
            prior_precision=np.append(self.prior_precision, precision),
            lower=np.append(self.lower, np.full(count, -np.inf)),
            upper=np.append(self.upper, np.full(count, np.inf)),
            free=np.append(self.free, np.ones(count, dtype=bool)),
            random=np.append(self.random, np.zeros(count, dtype=bool)),
        )

    def effect_priors(self, state: FitState) -> tuple[Floats, Floats]:
        """Prior mean and precision of the trial effects, shape (n_trials, n_effects) each."""
        n = self.index.shape[0]
        centre, precision = np.zeros((n, self.n_effects)), np.ones((n, self.n_effects))
        centre[:, :2], precision[:, :2] = self.release_origin_mean, self.release_origin_precision
        precision[:, DEVIATION_COLUMNS] = 1 / np.maximum(self.deviation_sd(state.spread), LEAST_BETWEEN_TRIAL_SD) ** 2
        return centre, precision

    def deviation_sd(self, spread: Floats | tuple[float, float]) -> Floats:
        """Standard deviations of the deviations of pressure, of a measured one the gauge's error, and ln B of each
        trial. Shapes: spread (..., 2) → (..., n_trials, 2).
        """
        sd = np.repeat(np.asarray(spread, dtype=float)[..., None, :], self.gauge_error.size, axis=-2)
        sd[..., 0] = np.where(self.gauge_error > 0, self.gauge_error, sd[..., 0])
        return sd

    def held_releases(self, precision: Floats) -> Floats:
        """Precisions of the trial effects by which a step of the release over its reach, a frame, costs 1. Of a vine
        filmed at steady speed alone nothing tells the release: a full step would spoil that of all trials, and steps of
        several frames would undo what `optimiser.likelier_releases` finds, time and again.
        """
        held = precision.copy()
        held[:, RELEASE] += 1 / self.release_reach_s**2
        return held

    def penalty(self, state: FitState) -> float:
        """Part of the priors of the free parameters in the penalised sum of squares."""
        return float(np.sum(self.prior_precision * (state.theta - self.prior_mean) ** 2))

    def summed(self, blocks: Floats, theta: Floats) -> tuple[Floats, Floats, float]:
        """Normal equations of the free parameters, the blocks of keys and residual of all trials added up, and the
        priors: information, slope (half the negative gradient), and the penalised sum of squares. Shapes: blocks
        (n_trials, n_keys + 1, n_keys + 1); theta (n_free,).
        """
        return added_up(np.ascontiguousarray(blocks), self.index, self.prior_precision, theta - self.prior_mean)


# ------------------------------------------------------------------------------
# Linear algebra of the blocks of trials.


def at_unknowns(blocks: Floats, index: NDArray[np.int_], size: int) -> Floats:
    """Blocks of trials at the unknowns of a campaign; those at −1 are dropped. Shapes: blocks (n, k, k); index (n, k) →
    (n, size, size).
    """
    placed = np.zeros((len(blocks), size + 1, size + 1))
    np.add.at(placed, (np.arange(len(blocks))[:, None, None], index[:, :, None], index[:, None, :]), blocks)
    return placed[:, :size, :size]


def inverse_of_block(square: Floats, places: NDArray[np.int_]) -> Floats:
    """Pseudo-inverse of the block of a symmetric matrix, (n, n), at these places, 0 elsewhere."""
    scale = 1 / np.sqrt(np.diag(square)[places])
    scaled = square[np.ix_(places, places)] * scale[:, None] * scale
    inverse = np.zeros_like(square)
    inverse[np.ix_(places, places)] = np.linalg.pinv(scaled, rcond=1e-11, hermitian=True) * scale[:, None] * scale
    return inverse


def solve_per_trial(square: Floats, right: Floats) -> Floats:
    """Solve one small symmetric system per trial, each scaled to a unit diagonal. Shapes: square (n_trials, k, k);
    right (n_trials, k, m) → (n_trials, k, m).
    """
    scale = 1 / np.sqrt(np.einsum("nkk->nk", square))
    scaled = square * scale[:, :, None] * scale[:, None, :] + RIDGE * np.eye(square.shape[1])
    return np.asarray(scale[:, :, None] * np.linalg.solve(scaled, scale[:, :, None] * right))


def eliminated(blocks: Floats, precision: Floats) -> tuple[Floats, Floats]:
    """Blocks of trials with their first m unknowns, of these prior precisions, integrated out (Schur complement); and
    the response of these unknowns to the others. Shapes: blocks (n_trials, k, k); precision (n_trials, m) → (n_trials,
    k − m, k − m), (n_trials, m, k − m).
    """
    m = precision.shape[1]
    response = solve_per_trial(with_diagonal(blocks[:, :m, :m], precision), blocks[:, :m, m:])
    explained = blocks[:, m:, :m] @ response
    return np.subtract(blocks[:, m:, m:], explained, out=explained), response


def with_diagonal(square: Floats, diagonal: Floats) -> Floats:
    """Matrices, (n, k, k), with something added to their diagonals, (n, k)."""
    return np.asarray(square + diagonal[:, :, None] * np.eye(diagonal.shape[1]))


def matrix_root(square: Floats) -> Floats:
    """A matrix R with R Rᵀ equal to a symmetric positive semidefinite matrix. Shapes: square (n, n) → (n, n)."""
    values, vectors = np.linalg.eigh(square)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :])


def at_prior_means(white: Floats, problem: MixedProblem, state: FitState) -> Floats:
    """Whitened cross products, (n_trials, k, k), changed in place: the residual, their last column, is taken at zero
    deviations of pressure and ln B and errors of single trials, and the priors of release and origin add their pull,
    and their penalty at the current values.
    """
    columns = list(range(PRESSURE, state.trial_effects.shape[1]))
    effects = state.trial_effects[:, columns, None]
    explained = (white[:, :, columns] @ effects)[:, :, 0]
    white[:, :, -1] += explained
    white[:, -1, :] = white[:, :, -1]
    # With r' = r + Z d, the product r'ᵀr' has the cross term rᵀZd twice, and dᵀZᵀZd.
    white[:, -1, -1] += explained[:, -1] + np.sum(explained[:, columns] * effects[:, :, 0], axis=1)
    offset = state.trial_effects[:, :2] - problem.release_origin_mean
    pull = problem.release_origin_precision * offset
    white[:, :2, -1] -= pull
    white[:, -1, :2] -= pull
    white[:, -1, -1] += np.sum(pull * offset, axis=1)
    return white


# ------------------------------------------------------------------------------
# The campaign, linearised: its steps, variances, likelihood and information.

LARGEST_SPREAD = (0.04, 0.15)  # Upper bounds of the between-trial standard deviations of pressure and ln B (chosen)

# Least and largest noise correlation (chosen). Up to 0.97, 30 frames: what stays longer is misfit, and a random
# walk would take up any. Slow errors of tracks are systematic ones.
CORRELATIONS = (-0.5, 0.97)


@dataclass(frozen=True)
class Linearised:
    """A campaign about the state of a fit. `cross_products`, (n_trials, 3, k, k), are those of trial effects, keys and
    residual. `estimable` tells whether the between-trial standard deviations of pressure and of ln B are estimated,
    `noise_held` that the noise is not.
    """

    problem: MixedProblem
    state: FitState
    cross_products: Floats
    _: KW_ONLY
    estimable: tuple[bool, bool] = (False, False)
    noise_held: bool = False

    def with_state(self, **changes: Any) -> Self:
        """The same blocks with other estimates, by name."""
        return replace(self, state=replace(self.state, **changes))

    def white(self) -> Floats:
        """Cross products in units of the noise, (n_trials, k, k)."""
        return np.asarray(at_correlation(self.cross_products, self.state.rho) / self.state.variance[:, None, None])

    def with_prior_gradient(self) -> Floats:
        """Whitened cross products; those of effects and residual, half a negative gradient, with the pull of priors."""
        white, n = self.white(), self.problem.n_effects
        centre, precision = self.problem.effect_priors(self.state)
        white[:, :n, -1] -= precision * (self.state.trial_effects - centre)
        white[:, -1, :n] = white[:, :n, -1]
        return white

    def without_effects(self) -> tuple[Floats, Floats]:
        """Whitened blocks of keys and residual, the trial effects integrated out; and the response of these, see
        `eliminated`.
        """
        white = at_prior_means(self.white(), self.problem, self.state)
        return eliminated(white, self.problem.effect_priors(self.state)[1])

    def information(self) -> tuple[Floats, Floats]:
        """Information, (n_trials, n_free, n_free), and scores, (n_trials, n_free), of each trial on the parameters."""
        size = self.problem.prior_mean.size
        index = np.pad(self.problem.index, ((0, 0), (0, 1)), constant_values=size)
        placed = at_unknowns(self.without_effects()[0], index, size + 1)
        return placed[:, :-1, :-1], placed[:, :-1, -1]

    def step(self) -> tuple[Floats, Floats, float]:
        """Gauss–Newton step of parameters, within the bounds, and of trial effects, which are eliminated before (Schur
        complement) and follow by back-substitution; and the decrease of the penalised sum of squares along it by the
        linear model. Shapes: (n_free,), (n_trials, n_effects).
        """
        problem, state = self.problem, self.state
        precision, white = problem.effect_priors(state)[1], self.with_prior_gradient()
        reduced, response = eliminated(white, problem.held_releases(precision))
        information, slope, _ = problem.summed(reduced, state.theta)
        room = state.theta - problem.lower, problem.upper - state.theta
        step, _ = step_within_bounds(information, slope, *room, problem.free)
        step_of_keys = np.append(step, 0.0)[problem.index]
        trial_effect_step = response[:, :, -1] - np.einsum("nuk,nk->nu", response[:, :, :-1], step_of_keys)
        # 2 sᵀg − sᵀHs. Only where no bound and no held release shortens the step, so that Hs = g, is that sᵀg.
        steps = np.hstack([trial_effect_step, step_of_keys])
        curvature = np.einsum("nu,nuv,nv->", steps, white[:, :-1, :-1], steps, optimize=True)
        prior_slope = problem.prior_precision * (problem.prior_mean - state.theta)
        curvature += np.sum(precision * trial_effect_step**2) + np.sum(problem.prior_precision * step**2)
        predicted_decrease = float(2 * (step @ prior_slope + np.sum(steps * white[:, :-1, -1])) - curvature)
        return step, trial_effect_step, predicted_decrease

    def with_variances(self, *, far_off: bool = False) -> Self:
        """Estimate noise and between-trial standard deviations; of a fit that is far off only the size of the noise."""
        at = self
        if not at.noise_held:
            rho, variance = at.likeliest_noise(at.state.rho if far_off else None)
            at = at.with_state(rho=rho, variance=np.maximum(variance, at.problem.least_variance))
        return at if far_off else at.with_state(spread=at.likeliest_spread())

    def likeliest_noise(self, rho: float | None = None) -> tuple[float, Floats]:
        """Noise correlation of all trials and innovation variance of each, by restricted likelihood of the residuals
        after the trial effects have been fitted.
        """
        problem, state, m = self.problem, self.state, self.problem.n_effects
        centre, precision = problem.effect_priors(state)
        prior_precision = precision * state.variance[:, None]
        prior_gradient = prior_precision * (state.trial_effects - centre)
        columns = [*range(m), -1]
        of_effects = self.cross_products[:, :, columns][:, :, :, columns]
        shared = np.count_nonzero(problem.free) / problem.index.shape[0]

        def at(rhos: Floats) -> tuple[Floats, Floats, Floats]:
            """−2 ln of the restricted likelihood, profiled over the variances, at each correlation; residual sums of
            squares and their degrees of freedom, shape (n_rhos, n_trials).
            """
            white = at_correlation(of_effects, rhos[:, None, None, None])
            residual, gradient = white[..., m, m], white[..., :m, m] - prior_gradient
            scale = 1 / np.sqrt(np.einsum("...kk->...k", white)[..., :m] + prior_precision)
            prior = prior_precision * scale**2 + RIDGE
            information = scale[..., :, None] * white[..., :m, :m] * scale[..., None, :] + prior[..., None] * np.eye(m)
            inverse = np.linalg.inv(information)
            log_det = np.linalg.slogdet(information)[1] - 2 * np.log(scale).sum(axis=-1)
            kept = np.sum(np.einsum("...kk->...k", inverse) * prior, axis=-1)
            dof = np.maximum(problem.points - shared - m + kept, 1.0)
            explained = np.einsum("...j,...jk,...k->...", scale * gradient, inverse, scale * gradient)
            # 0.2: least part of the residual sum of squares that remains (chosen)
            squares = np.maximum(residual - explained, 0.2 * residual)
            scores = np.sum(dof * np.log(squares / dof) + log_det, axis=1)
            return scores - np.sum(problem.stretches) * np.log(1 - rhos**2), squares, dof

        if rho is None:
            low, high = CORRELATIONS
            # 4, 12: rounds of a search for the correlation, each between the neighbours of the best one of so many
            # (chosen)
            for _ in range(4):
                grid = np.linspace(low, high, 12)
                best = int(np.argmin(at(grid)[0]))
                low, rho, high = grid[max(best - 1, 0)], float(grid[best]), grid[min(best + 1, 11)]
        assert rho is not None
        _, squares, degrees = at(np.array([rho]))
        return rho, _shrink_to_common(squares[0], degrees[0])

    @cached_property
    def marginal(self) -> tuple[Floats, float]:
        """Whitened cross products of [deviations, keys, residual] of each trial, release, origin and its own errors
        eliminated, the residual taken at zero deviations, (n_trials, 2 + n_keys + 1, 2 + n_keys + 1); and the constant
        of −2 ln L.
        """
        problem, state = self.problem, self.state
        white = at_prior_means(self.white(), problem, state)
        precision = np.pad(problem.release_origin_precision, ((0, 0), (0, problem.own_errors)), constant_values=1.0)
        if problem.own_errors:  # The deviations stay: they come after what is eliminated.
            own = np.r_[N_TRIAL_EFFECTS : problem.n_effects]
            order = np.r_[:PRESSURE, own, PRESSURE:N_TRIAL_EFFECTS, problem.n_effects : white.shape[-1]]
            white = white[:, order[:, None], order]
        log_noise = np.sum(problem.points * np.log(state.variance))
        log_noise -= np.sum(problem.stretches) * math.log(1 - state.rho**2)
        square = with_diagonal(white[:, : precision.shape[1], : precision.shape[1]], precision)
        log_alignment = np.sum(np.linalg.slogdet(square)[1] - np.log(precision).sum(axis=1))
        constant = float(log_noise + log_alignment + np.sum(problem.points) * math.log(2 * math.pi))
        return eliminated(white, precision)[0], constant

    def deviances(self, spreads: Floats, *, restricted: bool = True) -> Floats:
        """−2 ln of the (restricted) likelihood at each of several between-trial standard deviations, profiled over the
        parameters. Shapes: spreads (n, 2) → (n,).
        """
        (blocks, constant), problem, theta = self.marginal, self.problem, self.state.theta
        sd = problem.deviation_sd(spreads) * problem.has_deviation
        room = theta - problem.lower, problem.upper - theta, problem.free, problem.random
        prior = problem.prior_precision, theta - problem.prior_mean
        return np.asarray(profiled(blocks, sd, problem.index, *prior, *room, restricted) + constant)

    def likeliest_spread(self, *, restricted: bool = True) -> tuple[float, float]:
        """Between-trial standard deviations that maximise the restricted (or marginal) likelihood, by a pattern search
        from the best of a grid and the current values: there may be two maxima, since pressure and B can explain the
        same variation. The current ones stay where others are hardly likelier: along the valley between pressure and B
        the maximum moves far with every step of a fit. The restricted likelihood is multiplied by each standard
        deviation, so that none ends at 0 (Chung et al., Psychometrika 78, 685, 2013: about one standard error from 0
        then).
        """
        estimable, present = self.estimable, self.state.spread
        if not any(estimable):
            return present
        largest = np.where(estimable, LARGEST_SPREAD, np.inf)

        def best_of(spreads: Floats) -> tuple[Floats, float]:
            spreads = np.where(estimable, np.clip(spreads, LEAST_BETWEEN_TRIAL_SD, largest), present)
            found = self.deviances(spreads, restricted=restricted)
            if restricted:
                found -= 2 * np.sum(np.log(spreads), axis=1, where=estimable)
            return spreads[np.argmin(found)], float(found.min())

        current, at_current = best_of(np.array([present]))
        # Standard deviations from which the maximum of the likelihood is searched (chosen)
        grid = np.array(list(itertools.product((0.001, 0.004, 0.01, 0.025, 0.06), repeat=2)))
        best, lowest = min((current, at_current), best_of(grid), key=lambda found: found[1])
        # 0.4, 2e-3, 1e-5: logarithms of the first and the last ratio of standard deviations that are compared, and
        # decrease of −2 ln L that counts (chosen)
        reach, ways = 0.4, np.array(list(itertools.product((-1, 0, 1), repeat=2)))
        while reach > 2e-3:
            there, value = best_of(best * np.exp(reach * ways))
            best, lowest, reach = (there, value, 2 * reach) if value < lowest - 1e-5 else (best, lowest, 0.5 * reach)
        # 0.001: decrease of −2 ln L from which other standard deviations count as likelier (derived)
        return (float(best[0]), float(best[1])) if lowest < at_current - 0.001 else present

    def log_likelihood(self) -> float:
        """Marginal ln L, maximised over the between-trial standard deviations; the restricted one cannot compare
        models.
        """
        spread = self.likeliest_spread(restricted=False)
        return -0.5 * float(self.deviances(np.array([spread]), restricted=False)[0])


def _shrink_to_common(square: Floats, dof: Floats) -> Floats:
    """Variances of the trials, shrunk towards the common one by as much as their differences are due to chance."""
    common = float(np.sum(square) / np.sum(dof))
    if square.size < 2:
        return np.full(square.size, common)
    logs = np.log(square / dof / common)
    excess = float(np.average((logs - np.average(logs, weights=dof)) ** 2 - 2 / dof, weights=dof))
    strength = 2 / excess if excess > 1e-6 else 1e6
    return np.asarray((square + strength * common) / (dof + strength))
