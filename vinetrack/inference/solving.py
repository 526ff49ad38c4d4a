"""Solve for the parameters of a model from starting values or onward from another fit, and assemble what is stated."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.problems import Remark, remark
from vinetrack.core.records import Floats
from vinetrack.dynamics.model import values_by_key
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.inference.errors import (
    Precision,
    WithSystematics,
    precision,
    student,
    widened_covariance,
    with_systematics,
)
from vinetrack.inference.fit_data import FitTrial
from vinetrack.inference.fit_result import YIELD_PRESSURE, BetweenTrialSpread, Fit, Number, TrialFit
from vinetrack.inference.gaussian_processes import whiten
from vinetrack.inference.marginal_likelihood import (
    FitState,
    MixedProblem,
    solve_per_trial,
    trial_effect_prior,
    whitened_products,
    with_diagonal,
)
from vinetrack.inference.optimiser import (
    FixedTerms,
    Solution,
    chi2_per_dof,
    cost,
    first_state,
    is_poor_fit,
    make_problem,
    solve,
)
from vinetrack.inference.sensitivity import (
    DAMPING_DEVIATION,
    N_TRIAL_EFFECTS,
    ORIGIN,
    PRESSURE,
    RELEASE,
    Predictor,
    align,
    initial_trial_effects,
)
from vinetrack.inference.trial_effects import LARGEST_DEVIATION, subset

ALIKE = (5e-4, 1e-3)  # Between-trial standard deviations of pressure and ln B of trials that are alike (chosen)
STEPS_TO_TELL = 4  # Steps by which it shows whether a fit stays poor (chosen)


def solve_from(
    predictor: Predictor, theta: Floats, fixed_terms: FixedTerms, *, least: float = -math.inf, **how: Any
) -> Solution:
    """Solve from given parameters and the releases that suit them, with the initial noise and standard deviations of
    `first_state`; `least` and `how` are options of `_solve_or_alike`. Shapes: theta (n_free,).
    """
    trial_effects, _ = align(predictor, theta, initial_trial_effects(predictor.data))
    problem, state = make_problem(predictor, trial_effects), first_state(predictor.data, theta, trial_effects)
    if (rows := _part(predictor)).size:
        state, poor = _solved_for_part(predictor, problem, state, fixed_terms, rows, **how)
        if poor:  # It only has to be ruled out.
            fixed_terms, how = replace(fixed_terms, spread=ALIKE), how | {"most_iterations": STEPS_TO_TELL}
    return _solve_or_alike(predictor, problem, state, fixed_terms, least=least, **how)


def _part(predictor: Predictor) -> NDArray[np.int_]:
    """Rows of the trials with which a fit of many begins, evenly spaced by vine; none where there are few."""
    # 24, 2: trials with which a fit of at least twice as many begins, or this many per parameter (chosen)
    count, vines = max(24, 2 * len(predictor.layout.free)), [one.trial.vine for one in predictor.data]
    if len(vines) < 2 * count:
        return np.zeros(0, dtype=int)
    return np.sort(np.argsort(vines, kind="stable")[np.linspace(0, len(vines) - 1, count).round().astype(int)])


def _solved_for_part(
    predictor: Predictor, problem: MixedProblem, state: FitState, fixed_terms: FixedTerms, rows: NDArray[np.int_],
    **how: Any,
) -> tuple[FitState, bool]:  # fmt: skip
    """The state of all trials from where a fit to some of them ends, and whether that is poor. Most steps of a fit lead
    to the parameters, which need few trials.
    """
    if (noise := fixed_terms.noise) is not None:
        fixed_terms = replace(fixed_terms, noise=(noise[0], noise[1][rows]))
    part, problem, (start,) = subset(predictor, problem, rows, state)
    solution = _solve_or_alike(part, problem, start, fixed_terms, **how)
    theta, reached = state.theta.copy(), solution.state
    theta[np.unique(predictor.layout.index[rows][predictor.layout.index[rows] >= 0])] = reached.theta
    effects, _ = align(predictor, theta, state.trial_effects)
    effects[rows] = reached.trial_effects
    reached = FitState(theta, effects, reached.spread, reached.rho, state.variance)
    return reached, is_poor_fit(part, solution)


def _solve_or_alike(
    predictor: Predictor,
    problem: MixedProblem,
    state: FitState,
    fixed_terms: FixedTerms,
    *,
    least: float = -math.inf,
    **how: Any,
) -> Solution:
    """Solve, and where the fit is poor, unless another is known to reach `least`, with trials that are alike:
    differences between them in pressure and B take up what a model lacks, and n is meaningless then. From there trials
    may differ again, if a few steps of that lead near the tracks.
    """
    solution = solve(predictor, problem, state, fixed_terms, least=least, **how)
    if least > -math.inf or fixed_terms.spread is not None or not is_poor_fit(predictor, solution):
        return solution
    try:
        alike = solve(predictor, problem, state, replace(fixed_terms, spread=ALIKE), **how)
        differing = replace(alike.state, spread=state.spread)
        solution = solve(predictor, problem, differing, fixed_terms, most_iterations=STEPS_TO_TELL)
        if is_poor_fit(predictor, solution):
            return alike
        return solve(predictor, problem, solution.state, fixed_terms, **how)
    except SimulationError:
        return solution


def solve_onward(
    predictor: Predictor, before: Solution, theta: Floats, fixed_terms: FixedTerms, **how: Any
) -> Solution:
    """Solve from given parameters and the trial effects, noise and standard deviations of a previous solution; `how`
    are options of `_solve_or_alike`. From bad starting values the fit descends with the noise fixed first, and with
    trials that are alike: noise and differences between trials would take up what the model can explain. Shapes: theta
    (n_free,).
    """
    problem = replace(
        make_problem(predictor, before.state.trial_effects), release_origin_mean=before.problem.release_origin_mean
    )
    state = replace(before.state, theta=theta)
    # 1.5: χ² per point, at the noise of the previous fit, above which starting values are bad (chosen)
    if fixed_terms.noise is None and cost(predictor, problem, state) >= 1.5 * float(np.sum(problem.points)):
        noise = FixedTerms(fixed_terms.spread or ALIKE, (state.rho, state.variance))
        # 40, 10.0: steps at fixed noise, at most, and least decrease of the last (chosen)
        reached = solve(predictor, problem, state, noise, most_iterations=40, least_decrease=10.0).state
        state = replace(reached, spread=state.spread)
    return _solve_or_alike(predictor, problem, state, fixed_terms, **how)


# ------------------------------------------------------------------------------
# Messages of a fit: warnings on its numbers, and notes on what was done to its data.


SPREAD_NAMES = ("pressure", "B")


def fit_messages(
    predictor: Predictor, solution: Solution, numbers: Sequence[Number], precision: Precision, chi2: float
) -> tuple[Remark, ...]:
    """Warnings on convergence, on each number and on the size of the residuals; notes on the data."""
    told = [] if solution.converged else [remark("not_converged", iterations=solution.iterations)]
    for k, number in enumerate(numbers):
        named, free = {"title": number.title, "key": number.key}, predictor.layout.free[k]
        if precision.insensitive[k]:
            told.append(remark("no_influence", **named, value=number.value))
        elif math.isfinite(number.bound):
            told.append(remark("at_bound", **named, bound=number.bound))
        # 0.95, 1.05: ratios of fitted to stated error of P_y from which the trajectories are said not to constrain it,
        # and why the fitted error exceeds the stated one (chosen)
        elif math.isfinite(free.prior_sd) and number.sigma > 0.95 * free.prior_sd:
            told.append(remark("not_constrained", title=number.title, wider=number.sigma > 1.05 * free.prior_sd))
    if precision.collinear.any():
        together = [n for n, collinear in zip(numbers, precision.collinear, strict=True) if collinear]
        told.append(remark("not_separable", names=[f"{n.title} ({n.key})" for n in together]))
    variance = np.diag(precision.covariance)
    usable = np.flatnonzero(np.isfinite(variance) & (variance > 0))
    for i, j in itertools.combinations(usable.tolist(), 2):
        correlation = precision.covariance[i, j] / math.sqrt(variance[i] * variance[j])
        # 0.98: correlation of two fitted numbers from which the fit warns (chosen)
        if abs(correlation) > 0.98:
            first, second = numbers[i].title, numbers[j].title
            told.append(remark("correlated", first=first, second=second, correlation=float(correlation)))
    varying = [bool(solution.problem.has_deviation[:, k].any()) for k in range(2)]
    for k, name in enumerate(SPREAD_NAMES):
        if varying[k] and not solution.estimable[k]:
            told.append(remark("spread_taken", name=name, spread=solution.state.spread[k]))
    # 2.0: χ² per degree of freedom from which the fit warns of misfit (chosen)
    if chi2 > 2.0:
        may_vary = [SPREAD_NAMES[k] for k in (1, 0) if varying[k]]
        told.append(remark("misfit", ratio=math.sqrt(chi2), may_vary=may_vary))
    by_source: dict[str, list[str]] = {}
    for number in numbers:
        if number.shared and number.shared_sigma**2 > 0.5 * number.sigma**2:
            largest = max(number.shared, key=lambda source: number.shared[source])
            by_source.setdefault(largest, []).append(number.title)
    told += [remark("mostly_shared", names=titles, source=source) for source, titles in by_source.items()]
    return (*told, *_notes_on_data(predictor.data))


def _notes_on_data(data: Sequence[FitTrial]) -> list[Remark]:
    """Notes on points with unequal weights, on positions that were smoothed before they were imported, and on recorded
    pressures that the fit corrected.
    """
    notes = []
    weighted = [each for each in data if np.ptp(each.point_sd[: each.time_s.size - each.sees_end]) > 0]
    if weighted and weighted[0].blur_s > 0:
        notes.append(remark("weighted_by_speed", blur_us=1e6 * weighted[0].blur_s))
    elif weighted:
        notes.append(remark("weighted_as_stated"))
    smoothed = dict.fromkeys(trial_data.smoothing for trial_data in data if trial_data.smoothing is not None)
    notes += [remark("smoothed", how=str(one), frames=one.decimation) for one in smoothed]
    return notes


def assemble(predictor: Predictor, solution: Solution, left_out: Mapping[str, str], options: Mapping[str, Any]) -> Fit:
    """Assemble a `Fit` from a solution: numbers with errors and intervals, trial effects, messages."""
    layout = predictor.layout
    with_errors = with_systematics(predictor, solution)
    extended, count = with_errors.solution, len(layout.free)
    by_noise = precision(extended)
    precision_of_fit = widened_covariance(predictor, extended, by_noise, with_errors.sources).first(count)
    numbers = _numbers(predictor, solution, extended.state.theta, precision_of_fit)
    slopes = np.array([free.derivative(number.value) for free, number in zip(layout.free, numbers, strict=True)])
    chi2 = chi2_per_dof(predictor, solution)
    points, state = solution.problem.points, extended.state
    variance = float(np.average(state.variance, weights=points)) / (1 - state.rho**2)
    # Yield pressures belong to the trials and stay in the numbers.
    values = [
        (number.key, number.vine, number.value)
        for number in numbers
        if number.key != YIELD_PRESSURE and layout.term(number.key) is None
    ]
    return Fit(
        model=layout.model.with_values(values_by_key(values)),
        numbers=numbers,
        covariance=precision_of_fit.covariance * slopes[:, None] * slopes,
        spreads={
            name: BetweenTrialSpread(state.spread[k], solution.estimable[k])
            for k, name in enumerate(SPREAD_NAMES)
            if solution.problem.has_deviation[:, k].any()
        },
        noise_m=math.sqrt(variance),
        noise_correlation=state.rho,
        chi2_per_dof=chi2,
        log_likelihood=solution.log_likelihood() + with_errors.gain,
        trials=_trial_fits(predictor, solution, with_errors, by_noise.covariance[:count, :count]),
        messages=fit_messages(predictor, solution, numbers, precision_of_fit, chi2),
        left_out=dict(left_out),
        converged=solution.converged,
        iterations=solution.iterations,
        predictor=predictor,
        solution=solution,
        options=options,
        with_errors=state,
    )


def _numbers(
    predictor: Predictor, solution: Solution, theta: Floats, precision_of_fit: Precision
) -> tuple[Number, ...]:
    """The free parameters, the first entries of `theta`, with their errors and intervals."""
    layout, problem = predictor.layout, solution.problem
    sigma = np.sqrt(np.diag(precision_of_fit.covariance))
    dof = precision_of_fit.degrees
    reach = student(dof)
    numbers = []
    for k, number in enumerate(layout.free):
        low, high, method = theta[k] - reach[k] * sigma[k], theta[k] + reach[k] * sigma[k], "linear"
        if not math.isfinite(sigma[k]):
            low, high, method = problem.lower[k], problem.upper[k], "none"
        low, high = max(low, problem.lower[k]), min(high, problem.upper[k])
        at = [b for b in (problem.lower[k], problem.upper[k]) if abs(theta[k] - b) <= 1e-9 * max(abs(b), 1.0)]
        slope = number.derivative(number.from_scaled(float(theta[k])))
        shared = {name: math.sqrt(v[k]) * slope for name, v in precision_of_fit.shared.items() if v[k] > 0}
        numbers.append(
            Number(
                **{name: getattr(number, name) for name in ("key", "vine", "symbol", "unit")},
                value=number.from_scaled(float(theta[k])),
                sigma=float(sigma[k]) * slope,
                low=number.from_scaled(float(low)),
                high=number.from_scaled(float(high)),
                dof=float(dof[k]),
                method=method,
                bound=number.from_scaled(float(at[0])) if at else math.nan,
                lower=number.from_scaled(float(problem.lower[k])),
                upper=number.from_scaled(float(problem.upper[k])),
                shared=shared if math.isfinite(sigma[k]) else {},
                pressure_unit=predictor.data[0].trial.pressure_unit,
            )
        )
    return tuple(numbers)


def _trial_effect_sigma(solution: Solution, covariance: Floats) -> Floats:
    """Standard errors of the trial effects, including those of the shared parameters, shape (n_trials, 4)."""
    problem, state = solution.problem, solution.state
    white = whitened_products(solution.cross_products, state)
    square = with_diagonal(white[:, :N_TRIAL_EFFECTS, :N_TRIAL_EFFECTS], trial_effect_prior(problem, state)[1])
    inverse = solve_per_trial(square, np.broadcast_to(np.eye(N_TRIAL_EFFECTS), square.shape))
    response = inverse @ white[:, :N_TRIAL_EFFECTS, N_TRIAL_EFFECTS:-1]
    shared = np.pad(np.where(np.isfinite(covariance), covariance, 0.0), (0, 1))
    shared_of_trial = shared[problem.index[:, :, None], problem.index[:, None, :]]
    total = inverse + response @ shared_of_trial @ np.swapaxes(response, 1, 2)
    sigma = np.sqrt(np.maximum(np.einsum("nkk->nk", total), 0.0))
    for k, column in enumerate((PRESSURE, DAMPING_DEVIATION)):
        sigma[~problem.has_deviation[:, k], column] = 0.0
    return np.asarray(sigma)


def _trial_fits(
    predictor: Predictor, solution: Solution, with_errors: WithSystematics, covariance: Floats
) -> tuple[TrialFit, ...]:
    """The trials at a solution, with the deviations and whitened residuals of the fit that includes the systematic
    errors: one linear step, unbounded for a poor fit, so that the deviations are limited as those of a fit are.
    """
    state, sigma, reached = solution.state, _trial_effect_sigma(solution, covariance), with_errors.solution
    trajectories = predictor.trajectories_at(state.theta, state.trial_effects)
    deviations = np.clip(reached.state.trial_effects, -LARGEST_DEVIATION, LARGEST_DEVIATION)
    effects = np.column_stack([state.trial_effects[:, :PRESSURE], deviations[:, PRESSURE:N_TRIAL_EFFECTS]])
    trials = []
    for i, (one, moved) in enumerate(zip(predictor.data, trajectories, strict=True)):
        white = whiten(reached.columns[i][:, -1], one.first, reached.state.rho, one.relative_sd)
        position_m, velocity_m_s, variance = moved.observed_position_m, moved.lead_velocity_m_s, state.variance[i]
        trial = trial_fit(one, effects[i], position_m, velocity_m_s, state.rho, float(variance), sigma[i])
        trials.append(replace(trial, whitened=white / math.sqrt(reached.state.variance[i])))
    return tuple(trials)


def trial_fit(
    trial_data: FitTrial,
    trial_effects: Floats,
    position_m: Floats,
    velocity_m_s: Floats,
    rho: float,
    variance: float,
    sigma: Floats | None = None,
) -> TrialFit:
    """One trial with its trial effects and the predictions of the model. Shapes: trial_effects, sigma (4,); position_m,
    velocity_m_s (n_points,).
    """
    sigma = np.full(N_TRIAL_EFFECTS, math.nan) if sigma is None else sigma
    predicted_m = position_m + trial_effects[ORIGIN]
    residual_m = trial_data.lead_position_m - predicted_m
    return TrialFit(
        trial=trial_data.trial,
        time_s=trial_data.time_s,
        lead_position_m=trial_data.lead_position_m,
        predicted_position_m=predicted_m,
        predicted_velocity_m_s=velocity_m_s,
        residual_m=residual_m,
        whitened=whiten(residual_m, trial_data.first, rho, trial_data.relative_sd) / math.sqrt(variance),
        release_s=float(trial_effects[RELEASE]),
        release_sigma_s=float(sigma[RELEASE]),
        origin_m=float(trial_effects[ORIGIN]),
        origin_sigma_m=float(sigma[ORIGIN]),
        pressure_deviation=float(trial_effects[PRESSURE]),
        pressure_deviation_sigma=float(sigma[PRESSURE]),
        damping_deviation=math.expm1(trial_effects[DAMPING_DEVIATION]),
        damping_deviation_sigma=float(sigma[DAMPING_DEVIATION]),
        noise_m=math.sqrt(variance / (1 - rho**2)),
    )
