"""Assemble a `Fit` from a solution: values with errors and intervals, trial effects, messages."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.core.units import display_unit
from vinetrack.dynamics.model import Model, values_by_key
from vinetrack.inference.fit_data import FitTrial
from vinetrack.inference.fit_result import BetweenTrialSpread, Fit, Number, TrialFit
from vinetrack.inference.marginal_likelihood import deviance, estimate_between_trial_sd, marginal
from vinetrack.inference.mixed_effects import RIDGE, trial_effect_prior
from vinetrack.inference.optimiser import Solution, chi2_per_dof
from vinetrack.inference.parameters import YIELD_PRESSURE, FreeParameter, ParameterMap
from vinetrack.inference.position_errors import (
    Pooled,
    Precision,
    SmoothErrors,
    first_parameters,
    near_bound,
    pool,
    precision,
    profile_interval,
    smooth_errors,
    student,
)
from vinetrack.inference.robust_covariance import too_few_clusters, widened_covariance
from vinetrack.inference.sensitivity import DAMPING_DEVIATION, N_TRIAL_EFFECTS, ORIGIN, PRESSURE, RELEASE, Predictor
from vinetrack.inference.solving import trace_correction_Pa, trace_error_penalty
from vinetrack.inference.trial_effects import LARGEST_DEVIATION
from vinetrack.inference.whitening import at_correlation, whiten

# ------------------------------------------------------------------------------
# Messages of a fit: warnings on its numbers, and notes on what was done to its data.


SPREAD_NAMES = ("pressure", "B")


def fit_messages(
    predictor: Predictor,
    solution: Solution,
    numbers: Sequence[Number],
    precision: Precision,
    between: Floats,
    chi2: float,
) -> tuple[str, ...]:
    """All messages of a fit. Shapes: between (n_numbers, n_numbers)."""
    return (
        *_messages(predictor.layout, solution, numbers, precision, chi2),
        *_disagreement_messages(numbers, between),
        *_weighting_messages(predictor.data),
        *_smoothing_messages(predictor.data),
        *_pressure_messages(predictor.data),
    )


def _messages(
    layout: ParameterMap, solution: Solution, numbers: Sequence[Number], precision: Precision, chi2: float
) -> list[str]:
    """Warnings on convergence, on each number, and on the size of the residuals."""
    messages = []
    if not solution.converged:
        messages.append(f"the fit did not converge in {solution.iterations} iterations: its values are not reliable")
    for k, number in enumerate(numbers):
        free = layout.free[k]
        if precision.insensitive[k]:
            messages.append(
                f"{number.title} ({number.key}) has no influence on the trajectories: it stays at {number.value:.4g}"
            )
        elif math.isfinite(number.bound):
            messages.append(
                f"{number.title} ({number.key}) sits at its bound {number.bound:.4g}: the data favour values outside"
            )
        # 0.95: ratio of fitted to stated error of P_y from which the trajectories are said not to constrain
        # it (chosen)
        elif math.isfinite(free.prior_sd) and number.sigma > 0.95 * free.prior_sd:
            # 1.05: the same ratio from which the message explains why the fitted error exceeds the stated
            # one (chosen)
            wider = number.sigma > 1.05 * free.prior_sd
            why = (
                "; trials disagree by more than their noise, so its error is larger than in the sheet" if wider else ""
            )
            messages.append(f"{number.title}: the trajectories do not constrain it beyond the value in the sheet{why}")
    if precision.collinear.any():
        titles = [
            f"{n.title} ({n.key})" for n, collinear in zip(numbers, precision.collinear, strict=True) if collinear
        ]
        messages.append(f"these data do not determine separate values of {', '.join(titles)}")
    messages += _correlation_messages(numbers, precision)
    for k, name in enumerate(SPREAD_NAMES):
        if solution.problem.has_deviation[:, k].any() and not solution.estimable[k]:
            messages.append(
                f"the between-trial standard deviation of {name} is taken as {100 * solution.state.spread[k]:.2g} %"
            )
    # 2.0: χ² per degree of freedom from which the fit warns of misfit (chosen)
    if chi2 > 2.0:
        messages.append(
            f"the residuals are {math.sqrt(chi2):.3g} times the noise of the tracks{_variation_allowed(solution)}:"
            " an effect is missing, or the tracks have slow errors larger than their noise"
        )
    return messages


def _variation_allowed(solution: Solution) -> str:
    """Which of B and pressure may vary from trial to trial, as a clause; blank if the bodies have neither."""
    varying = [SPREAD_NAMES[k] for k in (1, 0) if solution.problem.has_deviation[:, k].any()]
    return f", although {' and '.join(varying)} may vary from trial to trial" if varying else ""


def _correlation_messages(numbers: Sequence[Number], precision: Precision) -> list[str]:
    pairs = []
    variance = np.diag(precision.covariance)
    usable = np.flatnonzero(np.isfinite(variance) & (variance > 0))
    for i, j in itertools.combinations(usable.tolist(), 2):
        correlation = precision.covariance[i, j] / math.sqrt(variance[i] * variance[j])
        # 0.98: correlation of two fitted numbers from which the fit warns (chosen)
        if abs(correlation) > 0.98:
            first, second = numbers[i].title, numbers[j].title
            pairs.append(f"{first} and {second} are strongly correlated ({correlation:.3f})")
    return pairs


def _disagreement_messages(numbers: Sequence[Number], between: Floats) -> list[str]:
    """A message naming the numbers on which trials disagree by more than the error of their mean."""
    sd = np.sqrt(np.diag(between))
    # 1.0: standard deviation between trials, in errors of the shared number, from which the fit says that trials
    # disagree
    disagreements = [
        f"{n.title} by ± {sd[k] * display_unit(n.unit)[1]:.2g} {display_unit(n.unit)[0]}".rstrip()
        for k, n in enumerate(numbers)
        if sd[k] > 1.0 * n.sigma and math.isfinite(n.sigma)
    ]
    if not disagreements:
        return []
    return [f"trials disagree by more than their noise, in {', '.join(disagreements)}: they get nearly equal weights"]


def _weighting_messages(data: Sequence[FitTrial]) -> list[str]:
    """A note on points with unequal weights."""
    weighted = [trial_data for trial_data in data if trial_data.relative_sd is not None]
    if not weighted:
        return []
    if weighted[0].blur_s > 0:
        blur_us = 1e6 * weighted[0].blur_s
        return [
            f"the noise of positions grows with speed, by {blur_us:.2g} µs × speed: points are weighted accordingly"
        ]
    return ["points are weighted by the standard deviations that their files state"]


def _smoothing_messages(data: Sequence[FitTrial]) -> list[str]:
    """Notes on positions that were smoothed before they were imported."""
    return list(dict.fromkeys(trial_data.smoothing.note for trial_data in data if trial_data.smoothing is not None))


def _pressure_messages(data: Sequence[FitTrial]) -> list[str]:
    """A note on recorded pressures that the fit corrected."""
    corrections = [
        float(np.max(np.abs(trace_correction_Pa(each)))) for each in data if each.trace_error_sizes is not None
    ]
    if not corrections:
        return []
    trials = f"{len(corrections)} trials" if len(corrections) > 1 else "one trial"
    largest_kPa = max(corrections) / 1e3
    return [
        f"recorded pressures of {trials} are corrected by up to {largest_kPa:.2g} kPa, within the errors that the noise"
        " of the gauge leaves, to agree with the motion"
    ]


def assemble(
    predictor: Predictor,
    solution: Solution,
    left_out: Mapping[str, str],
    options: Mapping[str, Any],
    *,
    profile: bool,
) -> Fit:
    """Assemble a `Fit` from a solution: numbers with errors and intervals, trial effects, messages."""
    layout, state = predictor.layout, solution.state
    plain = log_likelihood(solution) - 0.5 * trace_error_penalty(predictor.data)
    smooth = smooth_errors(predictor, solution, options.get("held"))
    extended = smooth.solution if smooth else solution
    by_noise = precision(extended)
    trials = _trial_fits(predictor, solution, first_parameters(by_noise, len(layout.free)))
    pooled = _pooled_if_few(predictor, solution, options)
    if pooled is not None:
        extended, by_noise = (
            pooled.solution,
            replace(by_noise, covariance=_with_undetermined(pooled.covariance, by_noise)),
        )
    if smooth is not None:
        trials = _with_smooth_errors_removed(trials, smooth)
    precision_of_fit = widened_covariance(predictor, solution, trials, by_noise, extended if smooth else None, pooled)
    by_noise, precision_of_fit = (first_parameters(each, len(layout.free)) for each in (by_noise, precision_of_fit))
    numbers = _numbers(predictor, solution, extended.state.theta, by_noise, precision_of_fit, profile=profile)
    between = _in_SI_units(layout, numbers, _between(pooled, len(numbers)))
    chi2 = chi2_per_dof(predictor, solution)
    weights = np.array([trial_data.time_s.size for trial_data in predictor.data], dtype=float)
    variance_state = smooth.solution.state if smooth else state
    variance = float(np.average(variance_state.variance, weights=weights)) / (1 - variance_state.rho**2)
    has_deviations = [bool(solution.problem.has_deviation[:, k].any()) for k in range(2)]
    return Fit(
        model=_fitted_model(layout, numbers),
        numbers=numbers,
        covariance=_in_SI_units(layout, numbers, precision_of_fit.covariance),
        spreads={
            name: BetweenTrialSpread(variance_state.spread[k], solution.estimable[k])
            for k, name in enumerate(SPREAD_NAMES)
            if has_deviations[k]
        },
        noise_m=math.sqrt(variance),
        noise_correlation=variance_state.rho,
        chi2_per_dof=chi2,
        log_likelihood=plain + smooth.gain if smooth else plain,
        trials=trials,
        messages=fit_messages(predictor, solution, numbers, precision_of_fit, between, chi2),
        left_out=dict(left_out),
        converged=solution.converged,
        iterations=solution.iterations,
        predictor=predictor,
        solution=solution,
        options=options,
        between=between,
        smooth=smooth.solution.state if smooth else None,
    )


def _with_smooth_errors_removed(trials: Sequence[TrialFit], smooth: SmoothErrors) -> tuple[TrialFit, ...]:
    """Trials with the deviations and residuals of the fit that includes smooth errors of position. The deviations come
    from one linear step, which is unbounded for a poor fit, so they are limited as those of a fit are
    (LARGEST_DEVIATION). The residuals are those of the step itself.
    """
    effects = np.clip(smooth.solution.state.trial_effects, -LARGEST_DEVIATION, LARGEST_DEVIATION)
    return tuple(
        replace(
            trial,
            whitened=white,
            pressure_deviation=float(values[PRESSURE]),
            damping_deviation=math.expm1(values[DAMPING_DEVIATION]),
        )
        for trial, white, values in zip(trials, smooth.whitened, effects, strict=True)
    )


def _pooled_if_few(predictor: Predictor, solution: Solution, options: Mapping[str, Any]) -> Pooled | None:
    """The fit with trials weighted by their disagreement, where the fit itself has no term for it. That is where trials
    are few, or have neither B nor pressure, which are what trials of a vine may differ by.
    """
    held = options.get("held")
    if held is not None and held.noise is not None:
        return None
    if too_few_clusters(predictor, solution) or not solution.problem.has_deviation.any():
        return pool(predictor, solution, len(predictor.layout.free))
    return None


def _between(pooled: Pooled | None, count: int) -> Floats:
    return np.zeros((count, count)) if pooled is None else pooled.between[:count, :count]


def _with_undetermined(covariance: Floats, precision_of_fit: Precision) -> Floats:
    unknown = ~np.isfinite(np.diag(precision_of_fit.covariance))
    return np.where(np.diag(unknown), math.inf, covariance)


def log_likelihood(solution: Solution) -> float:
    """Marginal ln L, maximised over the between-trial standard deviations; the restricted one cannot compare models."""
    part = marginal(solution.cross_products, solution.problem, solution.state)
    spread = estimate_between_trial_sd(part, solution.problem, solution.state, solution.estimable, restricted=False)
    return -0.5 * deviance(part, solution.problem, solution.state, spread, restricted=False)


def _fitted_model(layout: ParameterMap, numbers: Sequence[Number]) -> Model:
    """The model with the fitted values; yield pressures belong to the trials and stay in the numbers."""
    return layout.model.with_values(
        values_by_key(
            (number.key, number.vine, number.value)
            for number in numbers
            if number.key != YIELD_PRESSURE and layout.term(number.key) is None
        )
    )


def _numbers(
    predictor: Predictor,
    solution: Solution,
    theta: Floats,
    by_noise: Precision,
    precision_of_fit: Precision,
    *,
    profile: bool,
) -> tuple[Number, ...]:
    """The free parameters, the first entries of `theta`, with their errors and intervals."""
    layout, problem = predictor.layout, solution.problem
    sigma = np.sqrt(np.diag(precision_of_fit.covariance))
    dof = precision_of_fit.degrees
    reach = student(dof)
    doubtful = near_bound(solution, sigma)
    numbers = []
    for k, number in enumerate(layout.free):
        low, high, method = theta[k] - reach[k] * sigma[k], theta[k] + reach[k] * sigma[k], "linear"
        if not math.isfinite(sigma[k]):
            low, high, method = problem.lower[k], problem.upper[k], "none"
        elif doubtful[k] and profile:
            # The likelihood accounts for the noise alone; the interval is widened by the ratio of the errors.
            narrow = math.sqrt(by_noise.covariance[k, k])
            low, high = profile_interval(predictor, solution, k, narrow, float(reach[k] * sigma[k] / narrow))
            method = "profile"
        low, high = max(low, problem.lower[k]), min(high, problem.upper[k])
        at = [b for b in (problem.lower[k], problem.upper[k]) if abs(theta[k] - b) <= 1e-9 * max(abs(b), 1.0)]
        numbers.append(
            Number(
                key=number.key,
                vine=number.vine,
                symbol=number.symbol,
                unit=number.unit,
                value=number.from_scaled(float(theta[k])),
                sigma=float(sigma[k]) * number.derivative(number.from_scaled(float(theta[k]))),
                low=_bound_in_SI_units(number, low),
                high=_bound_in_SI_units(number, high),
                dof=float(dof[k]),
                method=method,
                bound=_bound_in_SI_units(number, at[0]) if at else math.nan,
                lower=_bound_in_SI_units(number, problem.lower[k]),
                upper=_bound_in_SI_units(number, problem.upper[k]),
            )
        )
    return tuple(numbers)


def _bound_in_SI_units(number: FreeParameter, theta: float) -> float:
    return number.from_scaled(float(theta)) if math.isfinite(theta) else math.inf * theta


def _in_SI_units(layout: ParameterMap, numbers: Sequence[Number], covariance: Floats) -> Floats:
    slopes = np.array([free.derivative(number.value) for free, number in zip(layout.free, numbers, strict=True)])
    return np.asarray(covariance * slopes[:, None] * slopes)


def _trial_effect_sigma(solution: Solution, precision_of_fit: Precision) -> Floats:
    """Standard errors of the trial effects, including those of the shared parameters, shape (n_trials, 4)."""
    problem, state = solution.problem, solution.state
    white = at_correlation(solution.cross_products, state.rho) / state.variance[:, None, None]
    precision_own = trial_effect_prior(problem, state)[1]
    square = white[:, :N_TRIAL_EFFECTS, :N_TRIAL_EFFECTS] + precision_own[:, :, None] * np.eye(N_TRIAL_EFFECTS)
    scale = 1 / np.sqrt(np.einsum("nkk->nk", square))
    scaled = square * scale[:, :, None] * scale[:, None, :] + RIDGE * np.eye(N_TRIAL_EFFECTS)
    inverse = np.linalg.inv(scaled) * scale[:, :, None] * scale[:, None, :]
    response = inverse @ white[:, :N_TRIAL_EFFECTS, N_TRIAL_EFFECTS:-1]
    shared = np.zeros((state.theta.size + 1,) * 2)
    shared[:-1, :-1] = np.where(np.isfinite(precision_of_fit.covariance), precision_of_fit.covariance, 0.0)
    shared_of_trial = shared[problem.index[:, :, None], problem.index[:, None, :]]
    total = inverse + response @ shared_of_trial @ np.swapaxes(response, 1, 2)
    sigma = np.sqrt(np.maximum(np.einsum("nkk->nk", total), 0.0))
    for k, column in enumerate((PRESSURE, DAMPING_DEVIATION)):
        sigma[~problem.has_deviation[:, k], column] = 0.0
    return np.asarray(sigma)


def _trial_fits(predictor: Predictor, solution: Solution, precision_of_fit: Precision) -> tuple[TrialFit, ...]:
    state, sigma = solution.state, _trial_effect_sigma(solution, precision_of_fit)
    trajectories = predictor.trajectories_at(state.theta, state.trial_effects)
    return tuple(
        trial_fit(trial_data, state.trial_effects[i], sigma[i], trajectories[i].observed_position_m,
                  trajectories[i].lead_velocity_m_s, state.rho,
                  float(state.variance[i]))
        for i, trial_data in enumerate(predictor.data)
    )  # fmt: skip


def trial_fit(
    trial_data: FitTrial,
    trial_effects: Floats,
    sigma: Floats,
    position_m: Floats,
    velocity_m_s: Floats,
    rho: float,
    variance: float,
) -> TrialFit:
    """One trial with its trial effects and the predictions of the model. Shapes: trial_effects, sigma (4,); position_m,
    velocity_m_s (n_points,).
    """
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
        imprecise_rest=trial_data.imprecise_rest,
    )
