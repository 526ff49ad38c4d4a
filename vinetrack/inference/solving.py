"""Solve for the parameters from several starting values; where the solution is poor, again with fixed noise.

A fit estimates the noise together with its parameters. From poor starting values it may absorb the whole misfit as slow
noise: the likelihood is then high and the parameters are wrong. `is_poor_fit` recognises such a solution by its
residual relative to the growth; the fit is then repeated with the noise fixed at that of the tracks.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.inference.fit_data import FitError, FitTrial
from vinetrack.inference.marginal_likelihood import bounded_solve, deviance, marginal
from vinetrack.inference.mixed_effects import (
    FitState,
    MixedProblem,
    solve_per_trial,
    sum_matrix_blocks,
    sum_vector_blocks,
    trial_effects_eliminated,
)
from vinetrack.inference.optimiser import (
    MOST_ITERATIONS,
    POOR_FIT,
    FixedTerms,
    Shortfall,
    Solution,
    Watch,
    chi2_per_dof,
    cost,
    first_state,
    is_poor_fit,
    make_problem,
    solve,
    track_correlation,
)
from vinetrack.inference.robust_covariance import recorded_pressures
from vinetrack.inference.sensitivity import N_TRIAL_EFFECTS, Predictor, align, candidates, initial_trial_effects
from vinetrack.inference.trial_effects import trial_costs

# Maximum number of steps of a fit that is continued, and of one at the noise correlation of the tracks (chosen)
CONTINUATION_ITERATIONS, TRACK_CORRELATION_ITERATIONS = 25, 40


SLOW_NOISE = 0.99  # Noise correlation above which a fit has absorbed misfit as noise (chosen)

# Steps at the noise of the tracks, and χ² per degree of freedom after them above which the attempt is given up (chosen)
TRACK_NOISE_ITERATIONS, GIVE_UP_CHI2 = 8, 30.0

# Between-trial standard deviations of pressure and ln B that are fixed while the noise is (chosen)
TRACK_CORRELATION_SD, TRACK_NOISE_SD = (5e-4, 1e-3), (0.01, 0.03)


def solve_from_scratch(
    predictor: Predictor, fixed_terms: FixedTerms, watch: Watch | None, *, thorough: bool
) -> Solution:
    """Solve from the starting values of least misfit and return the best solution. Later starting values are tried only
    until a fit converges; a poor best solution is repeated at the noise correlation of the tracks.
    """
    solutions: list[Solution] = []
    reason = ""
    # 3: maximum number of starting values (chosen)
    starts = candidates(predictor.layout, predictor.data, predictor)[:3]
    for _, theta, trial_effects in starts:
        try:
            most_iterations = MOST_ITERATIONS if thorough else CONTINUATION_ITERATIONS
            solutions.append(
                solve_from(predictor, theta, trial_effects, fixed_terms, most_iterations=most_iterations, watch=watch)
            )
        except SimulationError as error:
            reason = str(error)
            continue
        if solutions[-1].converged or not thorough:
            break
    if not solutions:
        raise FitError(
            f"The model cannot be simulated from any starting values: {reason or 'no trajectory could be simulated'}"
        )
    best = min(solutions, key=_deviance)
    if not is_poor_fit(predictor, best):
        return _with_noise_refitted(predictor, best, fixed_terms, watch)
    at_track_correlation = [
        _solve_at_track_correlation(predictor, theta, trial_effects, fixed_terms, watch)
        for _, theta, trial_effects in (starts if thorough else starts[:1])
    ]
    return _best_unabsorbed(predictor, best, [solution for solution in at_track_correlation if solution is not None])


def _with_noise_refitted(
    predictor: Predictor, best: Solution, fixed_terms: FixedTerms, watch: Watch | None
) -> Solution:
    """The solution, or a better one found at the noise of the tracks if its noise is slow. As long as parameters are
    slightly wrong, all trials share a smooth misfit of a fraction of a per cent. Taken for slow noise, it stops the
    parameters from moving on.
    """
    if best.state.rho < SLOW_NOISE:
        return best
    other = _solve_at_track_noise(predictor, best.state.theta, best.state.trial_effects, fixed_terms, watch)
    return best if other is None else min((best, other), key=_deviance)


def _best_unabsorbed(predictor: Predictor, free: Solution, at_track_correlation: list[Solution]) -> Solution:
    """The best solution at track correlation, preferably one that is not poor; without any, the one at free noise. A
    poor solution at free noise may have absorbed its misfit as slow noise, and with a noise correlation near 1 any
    misfit has a high likelihood.
    """
    good = [solution for solution in at_track_correlation if not is_poor_fit(predictor, solution)]
    return min(good or at_track_correlation or [free], key=_deviance)


def _solve_at_track_correlation(
    predictor: Predictor,
    theta: Floats,
    trial_effects: Floats,
    fixed_terms: FixedTerms,
    watch: Watch | None,
    *,
    then_free: bool = True,
    goal: float = -math.inf,
) -> Solution | None:
    """Solve with the noise correlation fixed at that of the tracks, then, with `then_free`, from there with free noise.
    Between-trial standard deviations are fixed near zero: a misfit far above the noise would otherwise distort the
    pressure and B of each trial until n is meaningless.
    """
    if fixed_terms.noise is not None:
        return None
    correlation_fixed = FixedTerms(
        spread=fixed_terms.spread or TRACK_CORRELATION_SD, correlation=track_correlation(predictor.data)
    )
    state, problem = first_state(predictor.data, theta, trial_effects), make_problem(predictor, trial_effects)
    try:
        first = solve(
            predictor,
            problem,
            state,
            correlation_fixed,
            warm=True,
            most_iterations=TRACK_CORRELATION_ITERATIONS,
            watch=watch,
            search=not then_free,
            shortfall=_shortfall_from(goal) if math.isfinite(goal) else None,
        )
        if not then_free:
            return first
        trial_effects, _ = align(predictor.data, predictor, first.state.theta, initial_trial_effects(predictor.data))
        free = solve_from(
            predictor,
            first.state.theta,
            trial_effects,
            fixed_terms,
            most_iterations=CONTINUATION_ITERATIONS,
            watch=watch,
        )
        return first if is_poor_fit(predictor, free) else free
    except SimulationError:
        return None


def _shortfall_from(goal: float) -> Shortfall:
    """−2 ln L of a fit, profiled over its shared parameters, minus that of the `goal` (a ln L)."""

    def shortfall(cross_products: Floats, problem: MixedProblem, state: FitState, _: float) -> float:
        reached = deviance(marginal(cross_products, problem, state), problem, state, state.spread, restricted=False)
        return reached + 2 * goal

    return shortfall


def _shortfall_from_giving_up(_: Floats, problem: MixedProblem, __: FitState, penalised_squares: float) -> float:
    """By how much −2 ln L must fall until χ² per point is GIVE_UP_CHI2, with the noise variance profiled out."""
    points = float(np.sum(problem.points))
    return points * math.log(max(penalised_squares, 1e-300) / (GIVE_UP_CHI2 * points))


def _solve_at_track_noise(
    predictor: Predictor,
    theta: Floats,
    trial_effects: Floats,
    fixed_terms: FixedTerms,
    watch: Watch | None,
    *,
    search: bool = False,
) -> Solution | None:
    """Solve with the noise fixed at that of the tracks, so that misfit cannot enlarge it, then with all terms free. For
    parameters that are nearly right: otherwise trials whose pressure or B is far from the set value would be treated as
    noise altogether. None if the fit stays poor.
    """
    if fixed_terms.noise is not None:
        return None
    state, problem = first_state(predictor.data, theta, trial_effects), make_problem(predictor, trial_effects)
    noise = FixedTerms(spread=fixed_terms.spread or TRACK_NOISE_SD, noise=(state.rho, state.variance))
    try:
        first = solve(
            predictor,
            problem,
            state,
            noise,
            warm=True,
            most_iterations=TRACK_NOISE_ITERATIONS,
            watch=watch,
            search=search,
            shortfall=_shortfall_from_giving_up if search else None,
        )
        if chi2_per_dof(predictor, first) > GIVE_UP_CHI2:
            return None
        if not first.converged:
            first = solve(
                predictor, problem, first.state, noise, warm=True, most_iterations=CONTINUATION_ITERATIONS, watch=watch
            )
        if chi2_per_dof(predictor, first) > POOR_FIT:
            return None
        return solve(
            predictor,
            problem,
            first.state,
            fixed_terms,
            warm=True,
            most_iterations=CONTINUATION_ITERATIONS,
            watch=watch,
        )
    except SimulationError:
        return None


def solve_from(
    predictor: Predictor,
    theta: Floats,
    trial_effects: Floats,
    fixed_terms: FixedTerms,
    *,
    most_iterations: int = MOST_ITERATIONS,
    watch: Watch | None = None,
    search: bool = False,
) -> Solution:
    """Solve from given parameters and trial effects, with the initial noise and standard deviations of `first_state`.
    Shapes: theta (n_free,); trial_effects (n_trials, 4).
    """
    state = first_state(predictor.data, theta, trial_effects)
    problem = make_problem(predictor, trial_effects)
    return solve(predictor, problem, state, fixed_terms, most_iterations=most_iterations, watch=watch, search=search)


def solve_onward(
    predictor: Predictor,
    before: Solution,
    theta: Floats,
    fixed_terms: FixedTerms,
    *,
    most_iterations: int = MOST_ITERATIONS,
    watch: Watch | None = None,
    search: bool = False,
) -> Solution:
    """Solve from given parameters and the trial effects, noise and standard deviations of a previous solution. Shapes:
    theta (n_free,).
    """
    problem = replace(
        make_problem(predictor, before.state.trial_effects), release_origin_mean=before.problem.release_origin_mean
    )
    state = start_at_fixed_noise(predictor, problem, replace(before.state, theta=theta), fixed_terms, search=search)
    return solve(
        predictor, problem, state, fixed_terms, warm=True, most_iterations=most_iterations, watch=watch, search=search
    )


def solve_again(
    predictor: Predictor,
    solution: Solution,
    fixed_terms: FixedTerms,
    watch: Watch | None,
    *,
    thorough: bool,
    goal: float = -math.inf,
) -> Solution:
    """The solution, or, if it is poor, one found from its parameters with the noise of the tracks."""
    if not is_poor_fit(predictor, solution):
        return solution
    theta = solution.state.theta
    try:
        trial_effects, _ = align(predictor.data, predictor, theta, initial_trial_effects(predictor.data))
    except SimulationError:
        return solution
    at_track_noise = _solve_at_track_noise(predictor, theta, trial_effects, fixed_terms, watch, search=not thorough)
    if at_track_noise is not None and not is_poor_fit(predictor, at_track_noise):
        return at_track_noise
    at_track_correlation = _solve_at_track_correlation(
        predictor, theta, trial_effects, fixed_terms, watch, then_free=thorough, goal=goal
    )
    return solution if at_track_correlation is None else _best_unabsorbed(predictor, solution, [at_track_correlation])


def _deviance(solution: Solution) -> float:
    part = marginal(solution.cross_products, solution.problem, solution.state)
    return deviance(part, solution.problem, solution.state, solution.state.spread)


def start_at_fixed_noise(
    predictor: Predictor, problem: MixedProblem, state: FitState, fixed_terms: FixedTerms, *, search: bool = False
) -> FitState:
    """Starting values of a warm fit; where they are bad, the result of a descent with the noise fixed. With free noise,
    the misfit of bad starting values would be absorbed as noise and stall the optimiser.
    """
    # 1.5: χ² per point, at the noise of the previous fit, above which starting values are bad (chosen)
    if fixed_terms.noise is not None or cost(predictor, problem, state) < 1.5 * float(np.sum(problem.points)):
        return state
    # An apparently late release may be the action of the new effect: each trial starts at the release that fits best.
    aligned, _ = align(predictor.data, predictor, state.theta, state.trial_effects)
    options = [state, replace(state, trial_effects=aligned)]
    best = np.argmin([trial_costs(predictor, problem, option) for option in options], axis=0)
    state = replace(state, trial_effects=np.array([options[option].trial_effects[i] for i, option in enumerate(best)]))
    noise = FixedTerms(fixed_terms.spread or state.spread, (state.rho, state.variance))
    return solve(
        predictor, problem, state, noise, warm=True, most_iterations=TRACK_CORRELATION_ITERATIONS, search=search
    ).state


# ------------------------------------------------------------------------------
# Errors that gauge noise leaves in a recorded pressure, estimated as random effects along with a fit.
#
# The remaining errors of a curve through noisy readings are known, one standard deviation each
# (`gauge_noise.DenoisedTrace.errors_Pa`). A light vine follows its pressure immediately, so that an error of the
# curve moves it by several times the noise of its positions and would look like a difference between trials. So the
# sizes of these errors, a ~ N(0, 1) in each trial, are random effects besides those of
# `vinetrack.inference.mixed_effects`. The linearised model estimates them with the parameters and trial effects all
# free at once; they are added to the trace, and the model is fitted again, until they converge. −2 ln L is evaluated
# at the most likely a, with Σ a² for their prior.

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
