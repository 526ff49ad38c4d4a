"""From the end of the iterations to a `Fit`: values with their errors, each trial's own numbers, words of warning."""

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
from vinetrack.inference.goodness_of_fit import chi2_per_dof
from vinetrack.inference.intervals import Precision, first_parameters, near_bound, precision, profile_interval, student
from vinetrack.inference.marginal_likelihood import deviance, estimate_between_trial_sd, marginal
from vinetrack.inference.mixed_effects import trial_effect_prior
from vinetrack.inference.optimiser import Solution
from vinetrack.inference.parameters import YIELD_PRESSURE, FreeParameter, ParameterMap
from vinetrack.inference.pooling import Pooled, pool
from vinetrack.inference.position_errors import SmoothErrors, smooth_errors
from vinetrack.inference.robust_covariance import too_few_clusters, widened_covariance
from vinetrack.inference.sensitivity import DAMPING_DEVIATION, N_TRIAL_EFFECTS, ORIGIN, PRESSURE, RELEASE, Predictor
from vinetrack.inference.trace_errors import penalty, trace_correction_Pa
from vinetrack.inference.trial_effects import LARGEST_DEVIATION
from vinetrack.inference.variance_kernels import RIDGE
from vinetrack.inference.whitening import at_correlation, whiten

HARD_TO_TELL_APART = 0.98
"""Correlation of two fitted numbers from which the fit warns. Chosen: at 0.98 the error of each is five times what it
would be with the other known (1/√(1 − 0.98²)); it decides a warning alone."""

ADDS_NOTHING = 0.95
"""Ratio of fitted to stated error of P_y from which the trajectories are said not to constrain it. Chosen: at 0.95
they add a tenth of the information; wording alone depends on it."""

WIDENED = 1.05
"""The same ratio from which it is said why the fitted error exceeds the stated one. Chosen; wording alone depends on
it."""

MISSES = 2.0
"""χ² per degree of freedom from which the fit warns that it misses the data. Chosen: half of it would warn of every
sound fit (χ² per degree of freedom is 1 there), twice would keep silent about visible misfit; it decides a warning
alone."""

DISAGREE = 1.0
"""Standard deviation between trials, in errors of the number shared, from which the fit says that trials disagree.
Derived: of two trials that scatter by more than their noise it is √2, of trials that agree mostly 0; wording alone."""

SPREAD_NAMES = ("pressure", "B")


def assemble(
    predictor: Predictor,
    solution: Solution,
    left_out: Mapping[str, str],
    options: Mapping[str, Any],
    *,
    profile: bool,
) -> Fit:
    """Assemble a `Fit` from where the iterations ended: numbers with errors and intervals, trial effects, messages.

    Parameters
    ----------
    predictor
        Of the trials that were fitted.
    solution
        Where the iterations ended.
    left_out : mapping
        Trials that could not be used, with the reason.
    options : mapping
        What the fit was told (`fixed`, `free`, `shared`, `held`), kept for refits.
    profile : bool
        Whether intervals near a bound are found by profile.

    Returns
    -------
    Fit
    """
    layout, state = predictor.layout, solution.state
    plain = log_likelihood(solution) - 0.5 * penalty(predictor.data)
    smooth = smooth_errors(predictor, solution, options.get("held"))
    wide = smooth.solution if smooth else solution
    by_noise = precision(wide)
    trials = _trial_fits(predictor, solution, first_parameters(by_noise, len(layout.free)))
    pooled = _pooled(predictor, solution, options)
    if pooled is not None:
        wide, by_noise = pooled.solution, replace(by_noise, covariance=_with_unknown(pooled.covariance, by_noise))
    if smooth is not None:
        trials = _beside_smooth_errors(trials, smooth)
    known = widened_covariance(predictor, solution, trials, by_noise, wide if smooth else None, pooled)
    by_noise, known = (first_parameters(each, len(layout.free)) for each in (by_noise, known))
    numbers = _numbers(predictor, solution, wide.state.theta, by_noise, known, profile=profile)
    between = _outside(layout, numbers, _between(pooled, len(numbers)))
    chi2 = chi2_per_dof(predictor, solution)
    weights = np.array([trial_data.time_s.size for trial_data in predictor.data], dtype=float)
    beside = smooth.solution.state if smooth else state
    variance = float(np.average(beside.variance, weights=weights)) / (1 - beside.rho**2)
    felt = [bool(solution.problem.has_deviation[:, k].any()) for k in range(2)]
    return Fit(
        model=_fitted_model(layout, numbers),
        numbers=numbers,
        covariance=_outside(layout, numbers, known.covariance),
        spreads={
            name: BetweenTrialSpread(beside.spread[k], solution.estimable[k])
            for k, name in enumerate(SPREAD_NAMES)
            if felt[k]
        },
        noise_m=math.sqrt(variance),
        noise_correlation=beside.rho,
        chi2_per_dof=chi2,
        log_likelihood=plain + smooth.gain if smooth else plain,
        trials=trials,
        messages=(
            *_messages(layout, solution, numbers, known, chi2),
            *_disagreements(numbers, between),
            *_weighted(predictor.data),
            *_smoothed(predictor.data),
            *_mended(predictor.data),
        ),
        left_out=dict(left_out),
        converged=solution.converged,
        iterations=solution.iterations,
        predictor=predictor,
        solution=solution,
        options=options,
        between=between,
        smooth=smooth.solution.state if smooth else None,
    )


def _beside_smooth_errors(trials: Sequence[TrialFit], smooth: SmoothErrors) -> tuple[TrialFit, ...]:
    """Trials with deviations and residuals as they are beside smooth errors of position: a lens deviates no tube.

    The deviations come from one linear step, which is unbounded where a fit is far off: they are limited as the fit's
    own are (LARGEST_DEVIATION). The residuals are those of the step itself.
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


def _pooled(predictor: Predictor, solution: Solution, options: Mapping[str, Any]) -> Pooled | None:
    """The trials weighed by how much they disagree, where the fit itself knows of no disagreement.

    That is where trials are few, or have nothing of their own: B and pressure are what a vine's trials may differ by.
    """
    held = options.get("held")
    if held is not None and held.noise is not None:
        return None
    if too_few_clusters(predictor, solution) or not solution.problem.has_deviation.any():
        return pool(predictor, solution, len(predictor.layout.free))
    return None


def _between(pooled: Pooled | None, count: int) -> Floats:
    return np.zeros((count, count)) if pooled is None else pooled.between[:count, :count]


def _disagreements(numbers: Sequence[Number], between: Floats) -> list[str]:
    """Numbers that trials disagree about by more than the error of their mean, in words."""
    sd = np.sqrt(np.diag(between))
    disagreements = [
        f"{n.title} by ± {sd[k] * display_unit(n.unit)[1]:.2g} {display_unit(n.unit)[0]}".rstrip()
        for k, n in enumerate(numbers)
        if sd[k] > DISAGREE * n.sigma and math.isfinite(n.sigma)
    ]
    if not disagreements:
        return []
    return [f"trials disagree by more than their noise, in {', '.join(disagreements)}: they count nearly alike"]


def _with_unknown(covariance: Floats, known: Precision) -> Floats:
    unknown = ~np.isfinite(np.diag(known.covariance))
    return np.where(np.diag(unknown), math.inf, covariance)


def log_likelihood(solution: Solution) -> float:
    """Marginal ln L, spreads at their best for it (not the restricted one, which cannot compare models).

    Parameters
    ----------
    solution
        Where the iterations ended.

    Returns
    -------
    float
    """
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
    known: Precision,
    *,
    profile: bool,
) -> tuple[Number, ...]:
    """The free numbers at `theta`, which holds them first, with their errors and intervals."""
    layout, problem = predictor.layout, solution.problem
    sigma = np.sqrt(np.diag(known.covariance))
    dof = known.degrees
    reach = student(dof)
    doubtful = near_bound(solution, sigma)
    numbers = []
    for k, number in enumerate(layout.free):
        low, high, method = theta[k] - reach[k] * sigma[k], theta[k] + reach[k] * sigma[k], "linear"
        if not math.isfinite(sigma[k]):
            low, high, method = problem.lower[k], problem.upper[k], "none"
        elif doubtful[k] and profile:
            # The likelihood knows of the noise alone: it is followed as much further as the error is wider.
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
                low=_bound_outside(number, low),
                high=_bound_outside(number, high),
                dof=float(dof[k]),
                method=method,
                bound=_bound_outside(number, at[0]) if at else math.nan,
                lower=_bound_outside(number, problem.lower[k]),
                upper=_bound_outside(number, problem.upper[k]),
            )
        )
    return tuple(numbers)


def _bound_outside(number: FreeParameter, theta: float) -> float:
    return number.from_scaled(float(theta)) if math.isfinite(theta) else math.inf * theta


def _outside(layout: ParameterMap, numbers: Sequence[Number], covariance: Floats) -> Floats:
    slopes = np.array([free.derivative(number.value) for free, number in zip(layout.free, numbers, strict=True)])
    return np.asarray(covariance * slopes[:, None] * slopes)


def _own_sigma(solution: Solution, known: Precision) -> Floats:
    """Standard errors of each trial's own numbers, shape (n_trials, 4), those of the shared numbers included."""
    problem, state = solution.problem, solution.state
    white = at_correlation(solution.cross_products, state.rho) / state.variance[:, None, None]
    precision_own = trial_effect_prior(problem, state)[1]
    square = white[:, :N_TRIAL_EFFECTS, :N_TRIAL_EFFECTS] + precision_own[:, :, None] * np.eye(N_TRIAL_EFFECTS)
    scale = 1 / np.sqrt(np.einsum("nkk->nk", square))
    even = square * scale[:, :, None] * scale[:, None, :] + RIDGE * np.eye(N_TRIAL_EFFECTS)
    inverse = np.linalg.inv(even) * scale[:, :, None] * scale[:, None, :]
    lever = inverse @ white[:, :N_TRIAL_EFFECTS, N_TRIAL_EFFECTS:-1]
    shared = np.zeros((state.theta.size + 1,) * 2)
    shared[:-1, :-1] = np.where(np.isfinite(known.covariance), known.covariance, 0.0)
    mine = shared[problem.index[:, :, None], problem.index[:, None, :]]
    total = inverse + lever @ mine @ np.swapaxes(lever, 1, 2)
    sigma = np.sqrt(np.maximum(np.einsum("nkk->nk", total), 0.0))
    for k, column in enumerate((PRESSURE, DAMPING_DEVIATION)):
        sigma[~problem.has_deviation[:, k], column] = 0.0
    return np.asarray(sigma)


def _trial_fits(predictor: Predictor, solution: Solution, known: Precision) -> tuple[TrialFit, ...]:
    state, sigma = solution.state, _own_sigma(solution, known)
    moved = predictor.trajectories_at(state.theta, state.trial_effects)
    return tuple(
        trial_fit(trial_data, state.trial_effects[i], sigma[i], moved[i].observed_position_m,
                  moved[i].lead_velocity_m_s, state.rho,
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
    """One trial with its own numbers and what the model says of it.

    Parameters
    ----------
    trial_data
        The trial as the fit sees it.
    trial_effects : array, shape (4,)
        Release, s; origin, m; deviations of pressure and ln B.
    sigma : array, shape (4,)
        Their standard errors.
    position_m : array, shape (n_points,), m
        Positions by the model, from an origin of 0.
    velocity_m_s : array, shape (n_points,), m/s
        Speed of the leading edge by the model.
    rho : float
        Lag-one correlation of the noise.
    variance : float
        Variance of its innovations, m².

    Returns
    -------
    TrialFit
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


def _messages(
    layout: ParameterMap, solution: Solution, numbers: Sequence[Number], known: Precision, chi2: float
) -> list[str]:
    """What to beware of, in words."""
    messages = []
    if not solution.converged:
        messages.append(
            f"the fit did not settle in {solution.iterations} iterations: its numbers are not to be trusted"
        )
    for k, number in enumerate(numbers):
        free = layout.free[k]
        if known.insensitive[k]:
            messages.append(
                f"{number.title} ({number.key}) never moved the trajectories: it stays at {number.value:.4g}"
            )
        elif math.isfinite(number.bound):
            messages.append(
                f"{number.title} ({number.key}) sits at its bound {number.bound:.4g}: the data want it beyond"
            )
        elif math.isfinite(free.prior_sd) and number.sigma > ADDS_NOTHING * free.prior_sd:
            wider = number.sigma > WIDENED * free.prior_sd
            why = "; they disagree by more than their noise, so its error exceeds the sheet's" if wider else ""
            messages.append(f"{number.title}: the trajectories say no more than the sheet does{why}")
    if known.collinear.any():
        titles = [f"{n.title} ({n.key})" for n, collinear in zip(numbers, known.collinear, strict=True) if collinear]
        messages.append(f"cannot be told apart at all by these data: {', '.join(titles)}")
    messages += _close_pairs(numbers, known)
    for k, name in enumerate(SPREAD_NAMES):
        if solution.problem.has_deviation[:, k].any() and not solution.estimable[k]:
            messages.append(
                f"the spread of {name} from trial to trial is taken as {100 * solution.state.spread[k]:.2g} %"
            )
    if chi2 > MISSES:
        messages.append(
            f"the model leaves {math.sqrt(chi2):.3g} times the noise of the tracks{_free_in_trials(solution)}:"
            " something is missing, or tracks err slowly by more than their noise"
        )
    return messages


def _free_in_trials(solution: Solution) -> str:
    """What every trial may have of its own, where it may: a falling body has neither B nor pressure."""
    felt = [SPREAD_NAMES[k] for k in (1, 0) if solution.problem.has_deviation[:, k].any()]
    return f", with {' and '.join(felt)} of every trial free to help" if felt else ""


def _smoothed(data: Sequence[FitTrial]) -> list[str]:
    """What is said of positions that somebody smoothed."""
    return list(dict.fromkeys(trial_data.smoothing.note for trial_data in data if trial_data.smoothing is not None))


def _mended(data: Sequence[FitTrial]) -> list[str]:
    """What is said of recorded pressures that the motion told better than their gauge."""
    moved = [float(np.max(np.abs(trace_correction_Pa(each)))) for each in data if each.trace_error_sizes is not None]
    if not moved:
        return []
    trials = f"{len(moved)} trials" if len(moved) > 1 else "one trial"
    return [
        f"recorded pressures of {trials} are corrected by up to {max(moved) / 1e3:.2g} kPa, as far as the noise of the"
        " gauge leaves them open and the motion tells them"
    ]


def _weighted(data: Sequence[FitTrial]) -> list[str]:
    """What is to be said of points that do not count alike."""
    weighted = [trial_data for trial_data in data if trial_data.relative_sd is not None]
    if not weighted:
        return []
    if weighted[0].blur_s > 0:
        blur_us = 1e6 * weighted[0].blur_s
        return [f"the noise of positions grows with speed, by {blur_us:.2g} µs × speed: points are weighted by it"]
    return ["points are weighted by the standard deviations that their files state"]


def _close_pairs(numbers: Sequence[Number], known: Precision) -> list[str]:
    pairs = []
    variance = np.diag(known.covariance)
    usable = np.flatnonzero(np.isfinite(variance) & (variance > 0))
    for i, j in itertools.combinations(usable.tolist(), 2):
        correlation = known.covariance[i, j] / math.sqrt(variance[i] * variance[j])
        if abs(correlation) > HARD_TO_TELL_APART:
            first, second = numbers[i].title, numbers[j].title
            pairs.append(f"{first} and {second} can hardly be told apart (correlation {correlation:.3f})")
    return pairs
