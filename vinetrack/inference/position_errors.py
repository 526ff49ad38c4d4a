"""Smooth errors of position that all trials of a camera share, as nuisance parameters of a fit.

An uncalibrated lens displaces the leading edge by a smooth function of its position. That function is the same in every
trial, so neither replicates nor the scatter of trials reveal it, and an effect that resembles it would absorb it. It is
modelled by Legendre polynomials of order 1 to 4 over the growth, each minus its value where the edge rests and with a
normal prior of standard deviation σ_s (`position_systematic_mm`).

About a fit, r_i = X_i Δθ + Z_i u_i + D_i s + e_i with s ~ N(0, 1) and D_i the shapes times σ_s. With s among the free
parameters this is the linear mixed model of `vinetrack.inference.mixed_effects` with four more columns and priors. Its
likelihood compares hypotheses without crediting any of them with what a lens could explain.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.inference.fit_problem import variance_floor
from vinetrack.inference.gauss_newton import levenberg_marquardt_step
from vinetrack.inference.intervals import LEAST_INFORMATION
from vinetrack.inference.marginal_likelihood import (
    deviance,
    estimate_between_trial_sd,
    estimate_noise,
    marginal,
    normal_equations,
)
from vinetrack.inference.mixed_effects import FitState, MixedProblem
from vinetrack.inference.optimiser import CONVERGED_VARIANCES, FixedTerms, Solution, variance_change
from vinetrack.inference.sensitivity import ORIGIN, Predictor
from vinetrack.inference.whitening import whiten

if TYPE_CHECKING:
    from vinetrack.inference.fit_result import Fit

ORDERS = (1, 2, 3, 4)  # Legendre orders of the shapes

NO_GROWTH_M = 1e-9  # Growth that counts as none (derived)

# Decrease of −2 ln L of a step at which the linear iteration has converged, a hundredth of what matters in a
# comparison, where differences count from 1; and the maximum number of steps (measured)
CONVERGED_DECREASE_SMOOTH, MOST_STEPS = 1e-2, 15


@dataclass(frozen=True)
class SmoothErrors:
    """A fit with smooth errors of position included. `solution` holds the free parameters of the fit and after them the
    sizes of the errors in prior standard deviations.
    """

    solution: Solution
    gain: float
    whitened: tuple[Floats, ...]
    displacement_m: tuple[Floats, ...]


def position_shapes(predictor: Predictor, grown_m: Sequence[Floats]) -> list[Floats]:
    """Displacement by one standard deviation of each shape, m, for every trial. The polynomials span the growth of all
    trials, since one camera records them. Shapes: grown_m (n_points,) → (n_points, n_shapes).
    """
    sigma_m = np.array([trial_data.position_systematic_m for trial_data in predictor.data])
    if not (sigma_m > 0).any():
        return [np.zeros((growth_m.size, 0)) for growth_m in grown_m]
    # Without any growth the shapes are zero, since their value at rest is subtracted.
    reach = max(NO_GROWTH_M, *(float(np.max(growth_m)) for growth_m in grown_m))
    select = np.eye(max(ORDERS) + 1)[list(ORDERS)].T
    # P_l(−1) = (−1)^l: an error of the position at rest is the origin's, which is free.
    at_rest = (-1.0) ** np.array(ORDERS)
    return [
        sigma * (np.polynomial.legendre.legval(2 * np.clip(growth_m / reach, 0, 1) - 1, select).T - at_rest)
        for growth_m, sigma in zip(grown_m, sigma_m.tolist(), strict=True)
    ]


def smooth_errors(predictor: Predictor, solution: Solution, held: FixedTerms | None = None) -> SmoothErrors | None:
    """Fit the smooth errors of position along with the parameters of a fit, to first order; None where
    there are none.
    """
    grown = [
        trial_data.lead_position_m - trial_effects[ORIGIN] - columns[:, -1]
        for trial_data, trial_effects, columns in zip(
            predictor.data, solution.state.trial_effects, solution.columns, strict=True
        )
    ]
    shapes = position_shapes(predictor, grown)
    count = shapes[0].shape[1]
    if not count:
        return None
    extended = [
        np.column_stack([columns[:, :-1], shape, columns[:, -1]])
        for columns, shape in zip(solution.columns, shapes, strict=True)
    ]
    held = held or FixedTerms()
    fixed_insensitive = replace(solution.problem, free=solution.problem.free & _sensitive(solution))
    problem = with_shapes(fixed_insensitive, count)
    start = replace(solution.state, theta=np.concatenate([solution.state.theta, np.zeros(count)]))
    state, cross_products, moved, log_likelihood = _newton_on_fixed_columns(
        predictor, solution, extended, problem, start, held
    )
    # A poor fit is not at its minimum, and the linear model overestimates the gain. That part is the same without the
    # shapes, so it is subtracted.
    without_shapes = _newton_on_fixed_columns(
        predictor, solution, solution.columns, fixed_insensitive, solution.state, held
    )[3]
    residuals = [values[:, -1] - values[:, :-1] @ change for values, change in zip(extended, moved, strict=True)]
    return SmoothErrors(
        solution=replace(
            solution,
            state=state,
            problem=with_shapes(solution.problem, count),
            cross_products=cross_products,
            columns=tuple(_with_residual(extended, residuals)),
        ),
        gain=max(log_likelihood - without_shapes, 0.0),
        whitened=tuple(
            whiten(values, trial_data.first, state.rho, trial_data.relative_sd) / np.sqrt(variance)
            for values, trial_data, variance in zip(residuals, predictor.data, state.variance, strict=True)
        ),
        displacement_m=tuple(shape @ state.theta[-count:] for shape in shapes),
    )


def _sensitive(solution: Solution) -> NDArray[np.bool_]:
    """Free parameters that influence some trajectory. The column of a parameter without influence is rounding error.
    With fixed columns, a step along it would be millions of scales long and predict a likelihood that no trajectory
    confirms.
    """
    part = marginal(solution.cross_products, solution.problem, solution.state)
    information = normal_equations(part, solution.problem, solution.state, solution.state.spread)[0]
    return np.asarray(np.diag(information) > LEAST_INFORMATION)


def _newton_on_fixed_columns(
    predictor: Predictor,
    solution: Solution,
    columns: Sequence[Floats],
    problem: MixedProblem,
    state: FitState,
    held: FixedTerms,
) -> tuple[FitState, Floats, Floats, float]:
    """Newton steps at fixed sensitivities: state, cross products there, total change of each trial's unknowns, ln L.
    Steps are taken as long as they raise ln L. Two parameters that only rounding separates may get a step of any length
    along the direction in which they cancel; no trajectory is simulated here that would reject it.
    """
    cross_products = predictor.products(columns)
    total_change = np.zeros((len(cross_products), cross_products.shape[-1] - 1))
    state = _variances(predictor, problem, cross_products, state, solution, held)
    level = _log_likelihood(cross_products, problem, state, solution)
    for _ in range(MOST_STEPS):
        step, own_step, predicted_decrease = levenberg_marquardt_step(cross_products, problem, state, 0.0)
        change = np.column_stack([own_step, np.append(step, 0.0)[problem.index]])
        products = _products_after_step(cross_products, change)
        before = replace(state, theta=state.theta + step, trial_effects=state.trial_effects + own_step)
        after = _variances(predictor, problem, products, before, solution, held)
        new_level = _log_likelihood(products, problem, after, solution)
        if new_level < level - CONVERGED_DECREASE_SMOOTH:
            break
        cross_products, total_change, state, level = products, total_change + change, after, new_level
        if predicted_decrease < CONVERGED_DECREASE_SMOOTH and variance_change(before, state) < CONVERGED_VARIANCES:
            break
    return state, cross_products, total_change, level


def _log_likelihood(cross_products: Floats, problem: MixedProblem, state: FitState, solution: Solution) -> float:
    """Marginal ln L at a state, maximised over the between-trial standard deviations."""
    part = marginal(cross_products, problem, state)
    spread = estimate_between_trial_sd(part, problem, state, solution.estimable, restricted=False)
    return -0.5 * deviance(part, problem, state, spread, restricted=False)


def _with_residual(columns: Sequence[Floats], residual: Sequence[Floats]) -> list[Floats]:
    return [np.column_stack([block[:, :-1], left]) for block, left in zip(columns, residual, strict=True)]


def with_shapes(problem: MixedProblem, count: int) -> MixedProblem:
    """The problem with the sizes of the shapes as further free parameters, each with a standard normal prior."""
    places = problem.prior_mean.size + np.arange(count)
    # A column that belongs to no free parameter has index −1, the appended zero.
    index = np.column_stack([problem.index, np.tile(places, (len(problem.index), 1))])
    return replace(
        problem,
        index=index,
        prior_mean=np.append(problem.prior_mean, np.zeros(count)),
        prior_precision=np.append(problem.prior_precision, np.ones(count)),
        lower=np.append(problem.lower, np.full(count, -np.inf)),
        upper=np.append(problem.upper, np.full(count, np.inf)),
        free=np.append(problem.free, np.ones(count, dtype=bool)),
        random=None if problem.random is None else np.append(problem.random, np.zeros(count, dtype=bool)),
    )


def _variances(
    predictor: Predictor,
    problem: MixedProblem,
    cross_products: Floats,
    state: FitState,
    solution: Solution,
    held: FixedTerms,
) -> FitState:
    """Estimate noise and between-trial standard deviations, unless they are fixed. The noise correlation may not exceed
    that of the fit: noise of correlation near 1 would make anything likely.
    """
    estimable = solution.estimable
    if held.noise is None:
        rho, variance = estimate_noise(cross_products, problem, state, held.correlation)
        if rho > solution.state.rho:
            rho, variance = estimate_noise(cross_products, problem, state, solution.state.rho)
        state = replace(state, rho=rho, variance=np.maximum(variance, variance_floor(predictor.data)))
    if any(estimable):
        state = replace(
            state, spread=estimate_between_trial_sd(marginal(cross_products, problem, state), problem, state, estimable)
        )
    return state


def _products_after_step(cross_products: Floats, change: Floats) -> Floats:
    """Cross products after a change of the unknowns of each trial, shape (n_trials, n_columns − 1). The residual
    becomes r − C·change, the other columns stay.
    """
    transformation = np.broadcast_to(
        np.eye(cross_products.shape[-1]), (len(cross_products), *cross_products.shape[-2:])
    ).copy()
    transformation[:, :-1, -1] = -change
    return np.asarray(np.swapaxes(transformation, 1, 2)[:, None] @ cross_products @ transformation[:, None])


def with_smooth_errors(fit: Fit) -> Solution:
    """The solution of a fit, with the smooth errors of position among its parameters where there are any."""
    smooth = smooth_errors(fit.predictor, fit.solution, fit.options.get("held"))
    return smooth.solution if smooth else fit.solution
