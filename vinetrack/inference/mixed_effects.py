"""The nonlinear mixed-effects model of a fit, and its linearisation about the current trajectories.

Point j of trial i, of vine v(i), is measured at time t_ij and lies at

    y_ij = o_i + f(t_ij − r_i; θ, ln B_v(i) + b_i + z_iᵀγ, P_i (1 + p_i + z_iᵀγ)) + e_ij

f : position of the leading edge that the equation of motion predicts, m, by time since release.
θ : fixed effects, called free parameters: ln B of each vine, n and the other parameters of the model, yield pressures
    for which the sheet states an error, and γ, the coefficients of differences between trials
    (`parameters.BetweenTerm`: z_i is 0 without them, and γ acts on ln B or on the pressure). Priors: N(stated value,
    stated error²) where the sheet states an error, and for coefficients of groups that are random; otherwise flat
    between the bounds.
u_i = (r_i, o_i, p_i, b_i) : random effects of the trial, called trial effects: release, s; origin, m; relative
    deviation of the pressure; deviation of ln B. Normal, independent of each other and between trials, with standard
    deviations
    r_i : RELEASE_PRIOR_FRAMES frames about the initial estimate where frames at rest are recorded, three durations of
          the track where they are not, `fit_problem.KNOWN_RELEASE_S` where the tube was pressurised in the recording;
    o_i : ORIGIN_PRIOR_SIGMAS of the noise where frames at rest are recorded, else three spans of the track;
    p_i : σ_P, the same for all trials; the gauge's error where the pressure was measured; 0 for undriven bodies;
    b_i : σ_B, the same for all trials; 0 for bodies without B.
e_ij : s_ij times stationary AR(1) noise, with one correlation ρ for all trials and an innovation variance v_i for each;
    independent on either side of a gap. s_ij is the stated noise of a point relative to that of its trial, else 1.

About the current θ and u_i the residuals are linear in both, r_i = X_i Δθ + Z_i Δu_i + e_i, with the sensitivities of
`vinetrack.inference.sensitivity`. The estimates, repeated in turn until they converge (Lindstrom & Bates, Biometrics
46, 673, 1990; Pinheiro & Bates, Mixed-Effects Models in S and S-PLUS, Springer 2000, chapter 7):

1. θ and u_i by Gauss–Newton steps at given σ_P, σ_B, ρ, v_i: the minimum of the penalised sum of squares. Each u_i is
   eliminated analytically (Schur complement), so that the cost is linear in the number of trials.
2. σ_P and σ_B by the restricted likelihood of the linearised model, u_i and θ integrated out
   (`marginal_likelihood.estimate_between_trial_sd`; Patterson & Thompson, Biometrika 58, 545, 1971). A standard
   deviation that applies to too few trials keeps its stated value.
3. ρ and v_i by the restricted likelihood of the residuals after u_i has been fitted, each v_i shrunk towards their
   common value by as much as their differences are due to chance (`marginal_likelihood.estimate_noise`).
4. Models are compared by the marginal likelihood, u_i (and random γ) integrated out, θ, σ_P and σ_B at its maximum, ρ
   and v_i as estimated in step 3: the restricted likelihood cannot compare models with different θ
   (`assemble.log_likelihood`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.inference.sensitivity import DAMPING_DEVIATION, N_TRIAL_EFFECTS, PRESSURE
from vinetrack.inference.variance_kernels import RIDGE
from vinetrack.inference.whitening import at_correlation

LEAST_BETWEEN_TRIAL_SD = 1e-5
"""Least between-trial standard deviation. Chosen far below the repeatability of any experiment, so that its logarithm
and its inverse stay finite."""

DEVIATION_COLUMNS = (PRESSURE, DAMPING_DEVIATION)


@dataclass(frozen=True)
class FitState:
    """Current estimates of a fit.

    `theta`, shape (n_free,), are the free parameters, scaled; `trial_effects`, shape (n_trials, 4), are release, origin
    and deviations, see `vinetrack.inference.sensitivity`; `spread` are the between-trial standard deviations of
    pressure (relative) and of ln B; `rho` is the lag-one correlation of the noise and `variance`, shape (n_trials,),
    the variance of its innovations, m².
    """

    theta: Floats
    trial_effects: Floats
    spread: tuple[float, float]
    rho: float
    variance: Floats


@dataclass(frozen=True)
class MixedProblem:
    """The constant part of a fit: design, priors and bounds.

    `index`, shape (n_trials, n_keys), maps each trial's sensitivity columns to the free parameters, -1 where a trial
    does not depend on one. `has_deviation`, shape (n_trials, 2), tells which trials have a deviation of pressure and of
    ln B. `gauge_error`, shape (n_trials,), is the relative error of a measured pressure, 0 for a set pressure.
    `release_origin_mean` and `release_origin_precision`, shape (n_trials, 2), are the prior of release and origin, so
    wide that it matters only where a track leaves them undetermined. `free` marks the parameters that are estimated;
    `points` and `stretches` count the points of each trial and its stretches between gaps. `random` marks parameters
    that are random effects of a group of trials; their prior is the distribution of the groups.
    """

    index: NDArray[np.int_]
    has_deviation: NDArray[np.bool_]
    gauge_error: Floats
    release_origin_mean: Floats
    release_origin_precision: Floats
    prior_mean: Floats
    prior_precision: Floats
    lower: Floats
    upper: Floats
    free: NDArray[np.bool_]
    points: Floats
    stretches: Floats
    random: NDArray[np.bool_] | None = None

    @cached_property
    def places(self) -> NDArray[np.int_]:
        """`index` with -1 replaced by n_free, one past the last parameter."""
        return np.where(self.index < 0, self.prior_mean.size, self.index)


def trial_effect_prior(problem: MixedProblem, state: FitState) -> tuple[Floats, Floats]:
    """Prior mean and precision of the trial effects.

    Parameters
    ----------
    problem : the constant part of the fit.
    state : where the fit stands.

    Returns
    -------
    centre, precision : arrays, shape (n_trials, 4)
    """
    n = problem.index.shape[0]
    centre, precision = np.zeros((n, N_TRIAL_EFFECTS)), np.ones((n, N_TRIAL_EFFECTS))
    centre[:, :2], precision[:, :2] = problem.release_origin_mean, problem.release_origin_precision
    precision[:, DEVIATION_COLUMNS] = (
        1 / np.maximum(trial_deviation_sd(problem, state.spread), LEAST_BETWEEN_TRIAL_SD) ** 2
    )
    return centre, precision


def trial_deviation_sd(problem: MixedProblem, spread: tuple[float, float]) -> Floats:
    """Standard deviations of the deviations of pressure and ln B of each trial.

    Parameters
    ----------
    problem : the constant part of the fit.
    spread : (float, float)
        Between-trial standard deviations of pressure, relative, and of ln B.

    Returns
    -------
    array, shape (n_trials, 2)
        The gauge's error in place of the first for a measured pressure.
    """
    sd = np.empty((problem.gauge_error.size, 2))
    sd[:, 0] = np.where(problem.gauge_error > 0, problem.gauge_error, spread[0])
    sd[:, 1] = spread[1]
    return sd


def shared_penalty(problem: MixedProblem, state: FitState) -> float:
    """Contribution of the priors of the free parameters to the penalised sum of squares.

    Parameters
    ----------
    problem : the constant part of the fit.
    state : where the fit stands.

    Returns
    -------
    float
    """
    return float(np.sum(problem.prior_precision * (state.theta - problem.prior_mean) ** 2))


def trial_effect_penalty(problem: MixedProblem, state: FitState) -> Floats:
    """Contribution of the priors of each trial's effects to the penalised sum of squares.

    Parameters
    ----------
    problem : the constant part of the fit.
    state : where the fit stands.

    Returns
    -------
    array, shape (n_trials,)
    """
    centre, precision = trial_effect_prior(problem, state)
    return np.asarray(np.sum(precision * (state.trial_effects - centre) ** 2, axis=1))


def sum_matrix_blocks(blocks: Floats, problem: MixedProblem) -> Floats:
    """Add the matrix block of each trial to the rows and columns of its free parameters, over all trials.

    Parameters
    ----------
    blocks : array, shape (n_trials, n_keys, n_keys)
    problem : its `index` maps the keys of each trial to the free parameters.

    Returns
    -------
    array, shape (n_free, n_free)
    """
    p = problem.prior_mean.size
    columns = problem.places
    flat_index = columns[:, :, None] * (p + 1) + columns[:, None, :]
    total = np.bincount(flat_index.ravel(), weights=blocks.ravel(), minlength=(p + 1) ** 2)
    return np.asarray(total.reshape(p + 1, p + 1)[:p, :p])


def sum_vector_blocks(blocks: Floats, problem: MixedProblem) -> Floats:
    """Add the vector block of each trial to the entries of its free parameters, over all trials.

    Parameters
    ----------
    blocks : array, shape (n_trials, n_keys)
    problem : its `index` maps the keys of each trial to the free parameters.

    Returns
    -------
    array, shape (n_free,)
    """
    p = problem.prior_mean.size
    return np.asarray(np.bincount(problem.places.ravel(), weights=blocks.ravel(), minlength=p + 1)[:p])


def inverse_of_block(square: Floats, places: NDArray[np.int_]) -> Floats:
    """Pseudo-inverse of the block of a symmetric matrix at these places, 0 elsewhere.

    Parameters
    ----------
    square : array, shape (n, n)
        Symmetric, with a positive diagonal at `places`.
    places : array of int
        Rows and columns of the block.

    Returns
    -------
    array, shape (n, n)
    """
    scale = 1 / np.sqrt(np.diag(square)[places])
    scaled = square[np.ix_(places, places)] * scale[:, None] * scale
    inverse = np.zeros_like(square)
    inverse[np.ix_(places, places)] = np.linalg.pinv(scaled, rcond=1e-11, hermitian=True) * scale[:, None] * scale
    return inverse


def solve_per_trial(square: Floats, right: Floats) -> Floats:
    """Solve one small symmetric system per trial, each scaled to a unit diagonal.

    Parameters
    ----------
    square : array, shape (n_trials, k, k)
        Symmetric, with positive diagonals.
    right : array, shape (n_trials, k, m)

    Returns
    -------
    array, shape (n_trials, k, m)
    """
    scale = 1 / np.sqrt(np.einsum("nkk->nk", square))
    scaled = square * scale[:, :, None] * scale[:, None, :] + RIDGE * np.eye(square.shape[1])
    return np.asarray(scale[:, :, None] * np.linalg.solve(scaled, scale[:, :, None] * right))


def trial_effects_eliminated(cross_products: Floats, n_keys: int, problem: MixedProblem, state: FitState) -> Floats:
    """Whitened cross products of keys, residual and further columns with the trial effects integrated out.

    Parameters
    ----------
    cross_products : array, shape (n_trials, 3, k, k)
        Of [trial effects, keys, residual, further columns].
    n_keys : int
        Number of keys.
    problem : the constant part of the fit.
    state : where the fit stands.

    Returns
    -------
    array, shape (n_trials, k − 4, k − 4)
    """
    white = at_correlation(cross_products, state.rho) / state.variance[:, None, None]
    white = at_zero_deviations(white, state, N_TRIAL_EFFECTS + n_keys)
    within_trial = white[:, :N_TRIAL_EFFECTS, :N_TRIAL_EFFECTS] + trial_effect_prior(problem, state)[1][
        :, :, None
    ] * np.eye(N_TRIAL_EFFECTS)
    cross = white[:, :N_TRIAL_EFFECTS, N_TRIAL_EFFECTS:]
    return np.asarray(
        white[:, N_TRIAL_EFFECTS:, N_TRIAL_EFFECTS:] - np.swapaxes(cross, 1, 2) @ solve_per_trial(within_trial, cross)
    )


def at_zero_deviations(white: Floats, state: FitState, residual: int) -> Floats:
    """Cross products with the residual taken at zero deviations of pressure and ln B instead of the current ones.

    Parameters
    ----------
    white : array, shape (n_trials, k, k)
        Whitened cross products, trial effects first.
    state : holds the deviations.
    residual : int
        Place of the column of the residual.

    Returns
    -------
    array, shape (n_trials, k, k)
    """
    columns = list(DEVIATION_COLUMNS)
    effects = state.trial_effects[:, columns, None]
    explained = (white[:, :, columns] @ effects)[:, :, 0]
    restored = white.copy()
    restored[:, :, residual] += explained
    restored[:, residual, :] = restored[:, :, residual]
    # With r' = r + Z d, the product r'ᵀr' has the cross term rᵀZd twice, and dᵀZᵀZd.
    restored[:, residual, residual] += explained[:, residual] + np.sum(explained[:, columns] * effects[:, :, 0], axis=1)
    return np.asarray(restored)
