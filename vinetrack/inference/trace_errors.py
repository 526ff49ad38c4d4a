"""Errors that gauge noise leaves in a recorded pressure, estimated as random effects along with a fit.

The remaining errors of a curve through noisy readings are known, one standard deviation each
(`gauge_noise.DenoisedTrace.errors_Pa`). A light vine follows its pressure immediately, so that an error of the curve
moves it by several times the noise of its positions and would look like a difference between trials. So the sizes of
these errors, a ~ N(0, 1) in each trial, are random effects besides those of `vinetrack.inference.mixed_effects`. The
linearised model estimates them with the parameters and trial effects all free at once; they are added to the trace, and
the model is fitted again, until they converge. −2 ln L is evaluated at the most likely a, with Σ a² for their prior.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.inference.fit_data import FitTrial
from vinetrack.inference.gauss_newton import bounded_solve
from vinetrack.inference.goodness_of_fit import is_poor_fit
from vinetrack.inference.mixed_effects import (
    solve_per_trial,
    sum_matrix_blocks,
    sum_vector_blocks,
    trial_effects_eliminated,
)
from vinetrack.inference.optimiser import MOST_ITERATIONS, FixedTerms, Solution, Watch
from vinetrack.inference.sensitivity import N_TRIAL_EFFECTS, Predictor
from vinetrack.inference.solving import solve_onward
from vinetrack.inference.systematics import recorded_pressures

# Maximum number of rounds (measured)
MOST_ROUNDS, CONVERGED_SIGMAS = 4, 0.1


def with_fitted_trace_errors(
    predictor: Predictor,
    solution: Solution,
    held: FixedTerms,
    *,
    most_iterations: int = MOST_ITERATIONS,
    watch: Watch | None = None,
    search: bool = False,
) -> tuple[Predictor, Solution]:
    """A solution with the errors of the recorded pressures estimated, and the predictor of the corrected pressures. A
    poor model would distort the pressures: its trials keep the recorded ones. So do trials whose trace is no curve: the
    errors of local lines are not known in detail. Returns predictor, Solution.
    """
    if not any(_has_errors(trial_data) for trial_data in predictor.data):
        return predictor, solution
    for _ in range(MOST_ROUNDS):
        if is_poor_fit(predictor, solution):
            break
        step = trace_error_step(predictor, solution)
        if not np.max(np.abs(step), initial=0.0) > CONVERGED_SIGMAS:
            break
        corrected = [_corrected(trial_data, more) for trial_data, more in zip(predictor.data, step, strict=True)]
        corrected_predictor = Predictor(predictor.layout, corrected, predictor.host)
        try:
            solution = solve_onward(
                corrected_predictor, solution, solution.state.theta, held,
                most_iterations=most_iterations, watch=watch, search=search,
            )  # fmt: skip
        except SimulationError:
            break
        predictor = corrected_predictor
    return predictor, solution


def trace_error_penalty(data: Sequence[FitTrial]) -> float:
    """Contribution of the priors of the estimated errors to −2 ln L."""
    return sum(
        float(np.sum(trial_data.trace_error_sizes**2))
        for trial_data in data
        if trial_data.trace_error_sizes is not None
    )


def trace_correction_Pa(trial_data: FitTrial) -> Floats:
    """Correction of the recorded pressure of a trial by a fit. Shape (n_samples,)."""
    assert trial_data.trace is not None
    if trial_data.trace_errors_Pa is None or trial_data.trace_error_sizes is None:
        return np.zeros(trial_data.trace[0].size)
    return trial_data.trace_errors_Pa @ trial_data.trace_error_sizes


def as_recorded(trial_data: FitTrial) -> FitTrial:
    """A trial with its pressure as recorded, without the correction by a fit."""
    if trial_data.trace_error_sizes is None:
        return trial_data
    return replace(_corrected(trial_data, -trial_data.trace_error_sizes), trace_error_sizes=None)


def _has_errors(trial_data: FitTrial) -> bool:
    """Whether the trial has a recorded pressure whose errors can be estimated."""
    return trial_data.trace is not None and trial_data.trace_errors_Pa is not None and trial_data.trace_is_curve


def _corrected(trial_data: FitTrial, step: Floats) -> FitTrial:
    """A trial with its recorded pressure changed by so many standard deviations of each of its errors."""
    if not _has_errors(trial_data):
        return trial_data
    assert trial_data.trace is not None
    assert trial_data.trace_errors_Pa is not None
    clock_s, pressure_Pa = trial_data.trace
    errors_Pa = trial_data.trace_errors_Pa
    step = step[: errors_Pa.shape[1]]
    sizes = step if trial_data.trace_error_sizes is None else trial_data.trace_error_sizes + step
    return replace(trial_data, trace=(clock_s, pressure_Pa + errors_Pa @ step), trace_error_sizes=sizes)


def trace_error_step(predictor: Predictor, solution: Solution) -> Floats:
    """Gauss–Newton step of the errors, in standard deviations, from their current estimates. Returns 0 for errors that
    a trial does not have, and everywhere if a trial cannot be simulated with one of them. Shape (n_trials, n_errors).
    """
    errors = recorded_pressures(predictor, solution, curves_only=True)
    if not errors.n_columns:
        return np.zeros((len(predictor.data), 0))
    sizes = np.zeros((len(predictor.data), errors.n_columns))
    for row, trial_data in zip(sizes, predictor.data, strict=True):
        if trial_data.trace_error_sizes is not None:
            row[: trial_data.trace_error_sizes.size] = trial_data.trace_error_sizes
    problem, state = solution.problem, solution.state
    cross_products = predictor.products(
        [np.column_stack(both) for both in zip(solution.columns, errors.columns, strict=True)]
    )
    p = solution.cross_products.shape[-1] - N_TRIAL_EFFECTS - 1
    blocks = trial_effects_eliminated(cross_products, p, problem, state)
    # Normal equations with the errors eliminated as well, each with a standard normal prior.
    square = blocks[:, p + 1 :, p + 1 :] + np.eye(errors.n_columns)
    mixed, slope = blocks[:, p + 1 :, :p], blocks[:, p + 1 :, p] - sizes
    solved = solve_per_trial(square, np.concatenate([mixed, slope[:, :, None]], axis=2))
    information = sum_matrix_blocks(blocks[:, :p, :p] - np.swapaxes(mixed, 1, 2) @ solved[:, :, :-1], problem)
    gradient = sum_vector_blocks(blocks[:, :p, p] - np.einsum("nek,ne->nk", mixed, solved[:, :, -1]), problem)
    gradient -= problem.prior_precision * (state.theta - problem.prior_mean)
    step, _ = bounded_solve(information + np.diag(problem.prior_precision), gradient, problem, state.theta)
    spread_out = np.append(step, 0.0)[problem.index]
    return np.asarray(solved[:, :, -1] - np.einsum("nek,nk->ne", solved[:, :, :-1], spread_out))
