"""What the noise of a gauge leaves wrong in a recorded pressure, found along with a fit: the motion tells it too.

Of a curve through noisy readings a few ways are known in which it may be wrong, a standard deviation each
(`gauge_noise.QuietTrace.errors_Pa`). A light vine follows its pressure at once, so that a wrong curve moves it by
several times what its positions err by: left to the noise of positions, that would pass for whatever differs between
trials. So the sizes of these errors, a ~ N(0, 1) in each trial, are random effects beside those of
`vinetrack.inference.mixed_effects`. They are told by its linear model with the shared numbers and the trial's own all
free at once, put into the trace, and the model is fitted again, until nothing moves. −2 ln L is taken at the likeliest
a, with Σ a² for their prior.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.inference.fit_data import FitTrial
from vinetrack.inference.goodness_of_fit import is_poor_fit
from vinetrack.inference.mixed_effects import (
    bounded_solve,
    solve_per_trial,
    sum_matrix_blocks,
    sum_vector_blocks,
    trial_effects_eliminated,
)
from vinetrack.inference.optimiser import MOST_ITERATIONS, FixedTerms, Solution, Watch
from vinetrack.inference.sensitivity import N_TRIAL_EFFECTS, Predictor
from vinetrack.inference.solving import solve_onward
from vinetrack.inference.systematics import recorded_pressures

MOST_ROUNDS, SETTLED = 4, 0.1
"""Rounds at most, and by how many of its standard deviations an error may still move. Measured: nine fits settle after
one to three rounds (`trace_clock` of the laboratories, tuning seed 20600); at half some would not, twice as many are
never asked. Chosen: −2 ln L is quadratic about the likeliest, and 0.1 in one error is 0.01 of it; at half a round more
is asked now and then, at twice 0.04."""


def with_fitted_trace_errors(
    predictor: Predictor,
    solution: Solution,
    held: FixedTerms,
    *,
    most_iterations: int = MOST_ITERATIONS,
    watch: Watch | None = None,
    search: bool = False,
) -> tuple[Predictor, Solution]:
    """A solution with the errors of the recorded pressures found along, and the predictor of the pressures so mended.

    A model far off would bend the pressures to it: its trials keep those that were recorded. So do those whose trace is
    no curve: of lines through neighbouring samples it is not known in which ways they are wrong.

    Parameters
    ----------
    predictor : of the trials that were fitted.
    solution : where the iterations ended.
    held : spreads and noise that are not estimated.
    most_iterations : int
        Steps of each fit at most.
    watch : callable, optional
        Called with each step.
    search : bool
        Whether the fit is one of many, see `optimiser.solve`.

    Returns
    -------
    Predictor, Solution
    """
    if not any(_has_errors(trial_data) for trial_data in predictor.data):
        return predictor, solution
    for _ in range(MOST_ROUNDS):
        if is_poor_fit(predictor, solution):
            break
        moved = trace_error_step(predictor, solution)
        if not np.max(np.abs(moved), initial=0.0) > SETTLED:
            break
        mended = [_mended(trial_data, more) for trial_data, more in zip(predictor.data, moved, strict=True)]
        after = Predictor(predictor.layout, mended, predictor.host)
        try:
            solution = solve_onward(
                after, solution, solution.state.theta, held,
                most_iterations=most_iterations, watch=watch, search=search,
            )  # fmt: skip
        except SimulationError:
            break
        predictor = after
    return predictor, solution


def penalty(data: Sequence[FitTrial]) -> float:
    """What the priors of the errors that were found add to −2 ln L.

    Parameters
    ----------
    data : sequence of FitTrial

    Returns
    -------
    float
    """
    return sum(
        float(np.sum(trial_data.trace_error_sizes**2))
        for trial_data in data
        if trial_data.trace_error_sizes is not None
    )


def trace_correction_Pa(trial_data: FitTrial) -> Floats:
    """By how much a fit moved the recorded pressure of a trial.

    Parameters
    ----------
    trial_data : FitTrial
        With a recorded pressure.

    Returns
    -------
    array, shape (n_samples,), Pa
    """
    assert trial_data.trace is not None
    if trial_data.trace_errors_Pa is None or trial_data.trace_error_sizes is None:
        return np.zeros(trial_data.trace[0].size)
    return trial_data.trace_errors_Pa @ trial_data.trace_error_sizes


def as_recorded(trial_data: FitTrial) -> FitTrial:
    """A trial with its pressure as it was recorded, whatever a fit found of its errors.

    Parameters
    ----------
    trial_data : FitTrial

    Returns
    -------
    FitTrial
    """
    if trial_data.trace_error_sizes is None:
        return trial_data
    return replace(_mended(trial_data, -trial_data.trace_error_sizes), trace_error_sizes=None)


def _has_errors(trial_data: FitTrial) -> bool:
    """Whether the trial has a recorded pressure whose errors can be found."""
    return trial_data.trace is not None and trial_data.trace_errors_Pa is not None and trial_data.trace_is_curve


def _mended(trial_data: FitTrial, more: Floats) -> FitTrial:
    """A trial whose recorded pressure is moved by so many standard deviations of each of its errors."""
    if not _has_errors(trial_data):
        return trial_data
    assert trial_data.trace is not None
    assert trial_data.trace_errors_Pa is not None
    clock_s, pressure_Pa = trial_data.trace
    errors_Pa = trial_data.trace_errors_Pa
    more = more[: errors_Pa.shape[1]]
    told = more if trial_data.trace_error_sizes is None else trial_data.trace_error_sizes + more
    return replace(trial_data, trace=(clock_s, pressure_Pa + errors_Pa @ more), trace_error_sizes=told)


def trace_error_step(predictor: Predictor, solution: Solution) -> Floats:
    """By how many standard deviations each error moves beside what was found before.

    Parameters
    ----------
    predictor : of the trials that were fitted.
    solution : where the iterations ended.

    Returns
    -------
    array, shape (n_trials, n_errors)
        0 for errors that a trial does not have, and in all where a trial cannot be simulated with one of them.
    """
    errors = recorded_pressures(predictor, solution, curves_only=True)
    if not errors.n_columns:
        return np.zeros((len(predictor.data), 0))
    told = np.zeros((len(predictor.data), errors.n_columns))
    for row, trial_data in zip(told, predictor.data, strict=True):
        if trial_data.trace_error_sizes is not None:
            row[: trial_data.trace_error_sizes.size] = trial_data.trace_error_sizes
    problem, state = solution.problem, solution.state
    cross_products = predictor.products(
        [np.column_stack(both) for both in zip(solution.columns, errors.columns, strict=True)]
    )
    p = solution.cross_products.shape[-1] - N_TRIAL_EFFECTS - 1
    blocks = trial_effects_eliminated(cross_products, p, problem, state)
    # What is left once the errors are eliminated as well, each with its prior of standard deviation 1.
    square = blocks[:, p + 1 :, p + 1 :] + np.eye(errors.n_columns)
    mixed, slope = blocks[:, p + 1 :, :p], blocks[:, p + 1 :, p] - told
    solved = solve_per_trial(square, np.concatenate([mixed, slope[:, :, None]], axis=2))
    information = sum_matrix_blocks(blocks[:, :p, :p] - np.swapaxes(mixed, 1, 2) @ solved[:, :, :-1], problem)
    gradient = sum_vector_blocks(blocks[:, :p, p] - np.einsum("nek,ne->nk", mixed, solved[:, :, -1]), problem)
    gradient -= problem.prior_precision * (state.theta - problem.prior_mean)
    step, _ = bounded_solve(information + np.diag(problem.prior_precision), gradient, problem, state.theta)
    spread_out = np.append(step, 0.0)[problem.index]
    return np.asarray(solved[:, :, -1] - np.einsum("nek,nk->ne", solved[:, :, :-1], spread_out))
