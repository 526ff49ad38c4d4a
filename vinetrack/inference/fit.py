"""Fit a model to the measured trajectories of an experiment.

    fit = vinetrack.fit(model, experiment)
    print(fit)

The fit compares positions, not derivatives. By default it estimates B of each vine, n, the yield pressure within the
error that the sheet states, and every parameter of further effects. Each trial also has random effects: release,
origin, and deviations of pressure and of ln B, whose between-trial standard deviations are estimated. Without them,
differences between trials would look like missing physics. The statistical model is stated in
`vinetrack.inference.marginal_likelihood`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.process import in_one_blas_thread
from vinetrack.core.records import Floats
from vinetrack.dynamics.model import Model, Value
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.effects import EffectError
from vinetrack.inference.errors import assemble, student, trial_fit, without
from vinetrack.inference.fit_data import FitError, FitTrial, Pairs, none_to_fit, prepare
from vinetrack.inference.fit_result import YIELD_PRESSURE, BetweenTerm, Fit, ParameterMap, TrialFit, make_layout
from vinetrack.inference.gaussian_processes import whiten
from vinetrack.inference.marginal_likelihood import matrix_root
from vinetrack.inference.optimiser import (
    CONVERGED_DECREASE,
    MOST_ITERATIONS,
    POOR_FIT,
    FixedTerms,
    Watch,
    cost,
    first_state,
    make_problem,
    solve,
    solve_from,
    solve_onward,
)
from vinetrack.inference.sensitivity import (
    DAMPING_DEVIATION,
    N_TRIAL_EFFECTS,
    ORIGIN,
    PRESSURE,
    Predictor,
    align,
    best_start,
    initial_trial_effects,
)
from vinetrack.inference.systematics import PRESSURE_ERROR_PA, position_shapes

# ------------------------------------------------------------------------------
# The 95 % prediction band of a trial that was not in the fit, for its position at each time.
#
# With release and origin of the trial fitted to it, the deviation from the prediction is
#
#     e = M (X δθ + Z d + S s + ε),   M = I − A (AᵀK⁻¹A)⁻¹ AᵀK⁻¹,   A = [release, origin]
#
# δθ is the error of the shared parameters, d the trial's deviations of pressure and B, s errors that replicates do not
# show (smooth errors of position, 30 Pa of a set pressure) and ε noise of covariance K, which includes the misfit of
# the model along each trial, since the noise of a fit is that of its residuals. The variance at a time is the diagonal
# of
#
#     M (X Cov(δθ) Xᵀ + Z Cov(d) Zᵀ + S Sᵀ + K) Mᵀ + δ² ℓ²
#
# with ℓ the travel of the trial. δ is the discrepancy of the model between trials (Kennedy & O'Hagan, J. R. Stat. Soc.
# B 63, 425, 2001), one standard deviation along the whole motion. It is chosen so that the trials of the fit, each left
# out in turn to first order, have the residuals that their bands predict (Paule & Mandel, J. Res. NBS 87, 377, 1982);
# 0 where they have less.

# A trial counts as covered where this part of its positions is, and a band has to cover this part of trials (chosen)
COVERED_POSITIONS, COVERAGE = 0.9, 0.95


def _calibrated(fit: Fit) -> tuple[float, float]:
    """Calibration of the bands by the trials of a fit, each predicted from the others: δ, relative to the travel, and
    the half width of the band in standard deviations.
    """
    solution, known = fit.solution, fit.solution.information()
    left_out = [(i, _leave_one_out(fit, *known, i)) for i in range(len(fit.trials))]
    predictable = [(i, *pair) for i, pair in left_out if pair is not None]
    if not predictable:
        return 0.0, 1.96  # Standard normal quantile of 0.975 (derived)
    square = np.array([np.mean(residual**2) for _, residual, _ in predictable])
    mean_variance = np.array([np.mean(variance) for *_, variance in predictable])
    travel2 = np.array([np.ptp(fit.trials[i].lead_position_m) ** 2 for i, *_ in predictable])
    delta2 = _paule_mandel(square, mean_variance, travel2)
    assumed = delta2 == 0.0 and not any(solution.estimable)
    # Restricted likelihood loses a degree of freedom for each fitted parameter; δ loses one.
    fitted = 1 if delta2 > 0 else int(np.count_nonzero(solution.problem.prior_precision == 0))
    degrees = math.inf if assumed else max(float(len(predictable) - fitted), 1.0)
    missed = [
        np.abs(residual) / np.sqrt(variance + delta2 * scale)
        for (_, residual, variance), scale in zip(predictable, travel2, strict=True)
    ]
    reaches = sorted(float(np.quantile(each, COVERED_POSITIONS)) for each in missed)
    enough = min(math.ceil(COVERAGE * (len(predictable) + 1)), len(predictable))
    return math.sqrt(delta2), max(float(student(np.array([degrees]))[0]), reaches[enough - 1])


def _paule_mandel(square: Floats, variance: Floats, scale: Floats) -> float:
    """The δ² at which the mean of square / (variance + δ² scale) is 1; 0 where that is less without it."""
    from scipy.optimize import brentq

    def excess(delta2: float) -> float:
        return float(np.mean(square / (variance + delta2 * scale))) - 1

    highest = float(np.max(square / scale)) * square.size
    return 0.0 if excess(0.0) <= 0 else float(brentq(excess, 0.0, highest))


def _leave_one_out(fit: Fit, information: Floats, scores: Floats, i: int) -> tuple[Floats, Floats] | None:
    """Residual of a trial once left out of the fit, m, and its variance, m², to first order; None where the other
    trials do not determine all parameters on which it depends.
    """
    problem, state, columns = fit.solution.problem, fit.solution.state, fit.solution.columns[i]
    if (known := without(fit.solution, information, scores, [i])) is None:
        return None
    step, root = known
    deviations, moved = [PRESSURE, DAMPING_DEVIATION], design_matrix(columns, problem.index[i], step.size)
    residual = columns[:, -1] + columns[:, deviations] @ state.trial_effects[i, deviations] - moved @ step
    own_sd = problem.deviation_sd(state.spread)[i] * problem.has_deviation[i]
    noise = float(state.variance[i]) / (1 - state.rho**2)
    return _aligned_error(fit, fit.predictor.data[i], columns, [moved @ root], own_sd, noise, residual)


def design_matrix(columns: Floats, index: np.ndarray, size: int) -> Floats:
    """Sensitivities of a trial to all free parameters, shape (n_points, size), from the columns of its keys."""
    design = np.zeros((len(columns), size + 1))
    np.add.at(design.T, index, columns[:, N_TRIAL_EFFECTS:-1].T)
    return design[:, :size]


def _variance_of_new_trial(fit: Fit, trial_data: FitTrial, trial: TrialFit) -> Floats:
    """Variance of the deviation of a new trial from its prediction, m², shape (n_points,), without the discrepancy."""
    layout = make_layout(fit.model, [trial_data], **{key: fit.options[key] for key in ("fixed", "free", "shared")})
    theta, places = values_for_trial(fit, layout, trial_data)
    predictor = Predictor(layout, [trial_data], fit.predictor.host)
    columns = predictor.linearise(theta, np.array([[trial.release_s, trial.origin_m, 0.0, 0.0]]))[0]
    held = zip(fit.predictor.layout.free, fit.numbers, strict=True)
    slopes = np.array([free.derivative(number.value) for free, number in held])
    scaled = np.where(np.isfinite(fit.covariance), fit.covariance, 0.0) / slopes[:, None] / slopes
    prior, matched = layout.prior_precision, np.flatnonzero(places >= 0)
    covariance = np.diag(np.where(prior > 0, 1 / np.maximum(prior, 1e-300), 0.0))
    covariance[matched, :] = covariance[:, matched] = 0.0
    covariance[np.ix_(matched, matched)] = scaled[np.ix_(places[matched], places[matched])]
    design = design_matrix(columns, layout.index[0], theta.size)
    unknown = matched[~np.isfinite(np.diag(fit.covariance)[places[matched]])]
    # 1e-6: part of the travel by which a trial does not depend on a parameter (derived)
    if np.any(np.abs(design[:, unknown]) > 1e-6 * np.ptp(trial_data.lead_position_m)):
        raise FitError("the trial depends on a parameter that the fit does not determine")
    state = fit.solution.state
    spread = np.array([trial_data.gauge_error or state.spread[0], state.spread[1]])
    spread *= [predictor.has_pressure_deviation[0], predictor.has_damping_deviation[0]]
    shapes = position_shapes(predictor, [trial_data.lead_position_m - trial.origin_m - columns[:, -1]])[0]
    noise = float(np.mean(state.variance)) / (1 - state.rho**2)
    loadings = [design @ matrix_root(covariance), shapes]
    return _aligned_error(fit, trial_data, columns, loadings, spread, noise, columns[:, -1])[1]


def values_for_trial(fit: Fit, layout: ParameterMap, trial_data: FitTrial) -> tuple[Floats, np.ndarray]:
    """The scaled parameters of a fit as the layout of one trial holds them, those of its vine and its day where each
    has its own, and their places among the numbers of the fit, -1 for new ones.
    """
    theta, places = layout.start, np.full(len(layout.free), -1)
    trial = trial_data.trial
    groups = {"", trial.vine, trial.group("day"), trial.yield_group}
    for k, free in enumerate(layout.free):
        for place, number in enumerate(fit.numbers):
            if number.key == free.key and number.vine in groups:
                theta[k], places[k] = free.to_scaled(number.value), place
    return theta, places


def _aligned_error(
    fit: Fit,
    trial_data: FitTrial,
    columns: Floats,
    loadings: list[Floats],
    deviation_sd: Floats,
    noise: float,
    residual: Floats,
) -> tuple[Floats, Floats]:
    """Residual and variance at each point after release and origin are fitted to the trial, as predictions fit them.
    `loadings` are displacements by one standard deviation of further errors, (n_points, …), `deviation_sd` the standard
    deviations of pressure and B, and `noise` is the variance of a position, m².
    """
    trial, rho = trial_data.trial, fit.solution.state.rho
    set_pressure = trial_data.trace is None and deviation_sd[0] > 0 and trial.pressure_Pa > 0
    sizes = [*deviation_sd, PRESSURE_ERROR_PA / trial.pressure_Pa if set_pressure else 0.0]
    moved = columns[:, [PRESSURE, DAMPING_DEVIATION, PRESSURE]] * sizes
    points, rows, design = np.eye(residual.size), np.arange(residual.size), columns[:, :2]
    whitener = whiten(points, trial_data.first, fit.noise_correlation, trial_data.relative_sd)
    white = whitener @ design
    fitted = np.array([not trial_data.pressurised_in_recording, True])
    inverse = np.linalg.pinv(white.T @ white * np.outer(fitted, fitted), rcond=1e-10, hermitian=True)
    left = points - design @ inverse @ (white.T @ whitener)
    aligned = left @ np.column_stack([*loadings, moved, residual])
    # Stretches are independent.
    stretch, sd = np.cumsum(trial_data.first), trial_data.point_sd
    correlation = np.where(stretch[:, None] == stretch, rho ** np.abs(rows[:, None] - rows), 0.0)
    random = noise * np.sum((left @ (correlation * np.outer(sd, sd))) * left, axis=1)
    return aligned[:, -1], np.sum(aligned[:, :-1] ** 2, axis=1) + random


# ------------------------------------------------------------------------------
# Predictions of a fitted model for trials outside the fit: only their release and origin are fitted.


def predict_prepared(fit: Fit, data: Sequence[FitTrial], *, from_rest: bool = False) -> list[TrialFit]:
    """Predict trials with their own release and origin and zero deviations, see `vinetrack.inference.fit.predict`."""
    return aligned_to_trials(fit, data, from_rest=from_rest)[2]


def aligned_to_trials(fit: Fit, data: Sequence[FitTrial], from_rest: bool) -> tuple[Predictor, Floats, list[TrialFit]]:
    """`predict_by_model` under a fit, with its noise and its yield pressures."""
    rho = 0.0 if from_rest else fit.noise_correlation
    data = [_with_fitted_yield_pressure(fit, trial_data) for trial_data in data]
    variance = fit.noise_m**2 * (1 - rho**2)
    return predict_by_model(fit.model, data, fit.predictor.host, rho, variance, from_rest=from_rest)


def predict_by_model(
    model: Model, data: Sequence[FitTrial], host: Model | None, rho: float, variance: float, *, from_rest: bool
) -> tuple[Predictor, Floats, list[TrialFit]]:
    """Predictor of trials, release and origin under a model of given sizes, (n_trials, 4), and the trials as predicted,
    with the noise that scales their whitened residuals.
    """
    try:
        base = np.array([model.parameters_of(trial_data.trial) for trial_data in data])
    except EffectError as error:
        raise FitError(f"{error} A vine that was not in the fit cannot be predicted.") from error
    base = base.reshape(len(data), len(model.parameter_names))
    layout, none = ParameterMap(model, (), (), np.zeros((len(data), 0), dtype=int), base), np.empty(0)
    predictor, undeviating = (Predictor(layout, data, host) for _ in range(2))
    undeviating.has_pressure_deviation[:] = undeviating.has_damping_deviation[:] = False
    try:
        trial_effects, _ = align(predictor, none, initial_trial_effects(data))
        problem = make_problem(undeviating, trial_effects)
        for i in np.flatnonzero(rest_is_seen(data) & from_rest).tolist():
            trial_effects[i, ORIGIN] = problem.release_origin_mean[i, 1] = data[i].rest_origin_m
            problem.release_origin_precision[i, 1] = 1e24  # The origin is known.
        state = replace(first_state(data, none, trial_effects), rho=rho)
        # 1e-5, 20: decrease, as a part of the misfit, at which a prediction is aligned, and most steps (chosen)
        least = max(1e-5 * cost(undeviating, problem, state), CONVERGED_DECREASE)
        held = FixedTerms(noise=(rho, state.variance))
        solution = solve(undeviating, problem, state, held, most_iterations=20, least_decrease=least)
        trial_effects = solution.state.trial_effects
        trajectories = predictor.trajectories_at(none, trial_effects)
    except SimulationError as error:
        raise FitError(f"The model cannot be simulated: {error}") from error
    trials = [
        trial_fit(each, trial_effects[i], moved.observed_position_m, moved.lead_velocity_m_s, rho, variance)
        for i, (each, moved) in enumerate(zip(data, trajectories, strict=True))
    ]
    return predictor, trial_effects, trials


def rest_is_seen(data: Sequence[FitTrial]) -> NDArray[np.bool_]:
    """Trials with enough frames at rest to determine where they started. Shape (n_trials,)."""
    # 5: frames at rest that determine where a vine started, to half the noise of one (derived)
    return np.array([each.n_rest >= 5 or each.imprecise_rest is not None for each in data], dtype=bool)


def _with_fitted_yield_pressure(fit: Fit, trial_data: FitTrial) -> FitTrial:
    """The trial with the fitted yield pressure of its vine, if the fit has one."""
    trial = trial_data.trial
    for number in fit.numbers:
        if number.key == YIELD_PRESSURE and number.vine in (trial.vine, trial.yield_group):
            return replace(trial_data, trial=replace(trial, yield_pressure_Pa=number.value))
    return trial_data


@in_one_blas_thread
def fit(
    model: Model,
    pairs: Pairs,
    *,
    fixed: Iterable[str] = (),
    free: Iterable[str] = (),
    shared: Mapping[str, str] | None = None,
    start: Mapping[str, Value] | None = None,
    spreads: tuple[float, float] | None = None,
    noise: tuple[float, float] | None = None,
    host: Model | None = None,
    watch: Watch | None = None,
) -> Fit:
    """Fit a model to trials and their tracks, see `vinetrack.fit`."""
    pairs = tuple(pairs)
    data, left_out = prepare(pairs, weighted=noise is None)
    if not data:
        raise none_to_fit(left_out)
    options: dict[str, Any] = {"fixed": tuple(fixed), "free": tuple(free), "shared": dict(shared or {})}
    fixed_terms = FixedTerms(spreads)
    if noise is not None:
        noise_m, rho = noise
        data = [replace(trial_data, noise_m=noise_m, correlation=rho) for trial_data in data]
        fixed_terms = FixedTerms(spreads, (rho, np.full(len(data), noise_m**2 * (1 - rho**2))))
    layout = make_layout(model.with_values(start or {}), data, **options)
    predictor = Predictor(layout, data, host)
    try:
        solution = solve_from(predictor, best_start(predictor), fixed_terms, watch=watch)
    except SimulationError as error:
        raise FitError(f"The model cannot be simulated from its starting values: {error}") from error
    trajectories = predictor.trajectories_at(solution.state.theta, solution.state.trial_effects)
    # 1e-9: travel below which a simulated trial counts as standing still (derived)
    if all(float(np.ptp(each.observed_position_m)) <= 1e-9 for each in trajectories):
        raise FitError(
            f"The model {' + '.join(model.names)} moves no trial. Check growth_angle_deg (0 is straight down),"
            " pressure_kPa and yield_pressure_kPa, or add the effect that drives them to `model:`."
        )
    return replace(assemble(solution, left_out, options), pairs=pairs)


def refit(
    before: Fit,
    model: Model | None = None,
    *,
    fixed: Iterable[str] | None = None,
    free: Iterable[str] | None = None,
    shared: Mapping[str, str] | None = None,
    between: Sequence[BetweenTerm] | None = None,
    start: Mapping[str, Value] | None = None,
    hold_variances: bool = False,
    most_iterations: int = MOST_ITERATIONS,
    afresh: bool = False,
    least: float = -math.inf,
    watch: Watch | None = None,
) -> Fit:
    """Fit another model, or other parameters of the same model, to the same data, starting from a previous fit.

    Parameters
    ----------
    before : the previous fit: its data, and its estimates as starting values.
    model : Model, optional
        The other model; parameters that it has in common with the fit start at the fitted values.
    fixed, free : iterable of str, optional
        As of `fit`, in place of the options of the previous fit.
    shared : mapping, optional
        `"all"`, `"vine"` or `"day"` by name of parameter, in addition to the options of the previous fit.
    between : sequence of BetweenTerm, optional
        Differences between trials to estimate, in place of those of the previous fit.
    start : mapping, optional
        Starting values of parameters, mainly of a new effect: a time constant that starts at zero stays there.
    hold_variances : bool
        Keep noise and between-trial standard deviations of the previous fit instead of estimating them again.
    most_iterations : int
        Maximum number of steps; a model that only has to be ruled out need not converge.
    afresh : bool
        Whether release, deviations and noise start from the tracks alone instead of the previous fit.
    least : float
        ln L that another fit reaches, less what counts as near it: a fit that cannot reach it is given up, one that is
        poor is left so.
    watch : callable, optional
        Called with every `Step` of the iterations; an exception that it raises ends the fit.

    Returns
    -------
    Fit

    Raises
    ------
    FitError
        If a name is not that of a parameter, or the model cannot be simulated.

    Examples
    --------
    >>> import vinetrack as vt
    >>> fit = vt.fit(vt.base_model(), vt.example_tracks())
    >>> later = vt.refit(fit, fit.model + "reservoir_depletion")
    >>> later.log_likelihood > fit.log_likelihood
    True
    """
    model = model or before.model
    if not isinstance(model, Model):
        raise FitError(f"{model!r} is no model: give the whole model, fit.model + {model!r} for one effect more.")
    fitted_values = {key: value for key, value in before.model.values.items() if key in model.parameter_names}
    model = model.with_values({**fitted_values, **(start or {})})
    data = before.predictor.data
    names = {part for name in (*model.parameter_names, YIELD_PRESSURE) for part in (name, name.split(".")[1])}
    options: dict[str, Any] = {
        key: tuple(name for name in before.options[key] if name in names) if given is None else tuple(given)
        for key, given in (("fixed", fixed), ("free", free))
    }
    all_shared = {**before.options["shared"], **(shared or {})}
    options["shared"] = {name: how for name, how in all_shared.items() if name in names}
    between = before.predictor.layout.between if between is None else between
    layout = make_layout(model, data, **options, between=between)
    host = before.predictor.host
    predictor = Predictor(layout, data, host if host is not None and set(model.names) <= set(host.names) else None)
    theta = layout.start
    # Those where its trajectories ended: the quoted ones are a step further, that of the systematic errors.
    known = before.predictor.layout
    values = dict(zip((number.name for number in known.free), known.values(before.solution.state.theta), strict=True))
    for k, number in enumerate(layout.free):
        if number.name in values and number.key not in (start or {}):
            theta[k] = number.to_scaled(float(np.clip(values[number.name], number.lower, number.upper)))
    state = before.state
    held = FixedTerms(state.spread, (state.rho, state.variance)) if hold_variances else FixedTerms()
    how: dict[str, Any] = {"most_iterations": most_iterations, "least": least, "watch": watch}
    try:
        if afresh or before.chi2_per_dof > POOR_FIT:
            solution = solve_from(predictor, theta, held, **how)
        else:
            solution = solve_onward(predictor, before.solution, theta, held, **how)
    except SimulationError as error:
        raise FitError(f"The model cannot be simulated from these starting values: {error}") from error
    return replace(assemble(solution, before.left_out, options), pairs=before.pairs)


def predict(fitted: Fit, pairs: Pairs) -> list[TrialFit]:
    """Predict trials that were not in the fit.

    Only release and origin are fitted to each trial; its deviations of pressure and B are zero. `band_m` is the half
    width of the 95 % prediction band, see `vinetrack.inference.fit`; after a fit to a single trial it
    assumes typical between-trial standard deviations.

    Parameters
    ----------
    fitted : the fit to predict from.
    pairs : iterable of (Trial, Track)
        Trials to predict.

    Returns
    -------
    list of TrialFit

    Raises
    ------
    FitError
        If a trial cannot be used, or its vine was not in the fit and B is one per vine.

    Examples
    --------
    >>> import vinetrack as vt
    >>> pairs = vt.tracks_from_frame(vt.example_tracks())
    >>> fit = vt.fit(vt.base_model(), pairs[:6])
    >>> [trial.name for trial in vt.predict(fit, pairs[6:])]
    ['P48_1', 'P48_2']
    """
    data, unusable = prepare(pairs, weighted=False)
    for name, reason in unusable.items():
        raise FitError(f"Trial {name}: {reason}.")
    banded, (discrepancy, reach) = predict_prepared(fitted, data), _calibrated(fitted)
    for i, trial_data in enumerate(data):
        # A trial that depends on a parameter that the fit does not determine has no band.
        with suppress(SimulationError, FitError):
            variance = _variance_of_new_trial(fitted, trial_data, banded[i])
            variance += (discrepancy * np.ptp(trial_data.lead_position_m)) ** 2
            banded[i] = replace(banded[i], band_m=reach * np.sqrt(variance))
    return banded
