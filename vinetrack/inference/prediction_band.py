"""The 95 % prediction band of a trial that was not in the fit, for its position at each time.

With release and origin of the trial fitted to it, the deviation from the prediction is

    e = M (X δθ + X u + Z d + S s + ε),   M = I − A (AᵀK⁻¹A)⁻¹ AᵀK⁻¹,   A = [release, origin]

δθ is the error of the shared parameters, u the difference of the trial's parameters from those (`inference.pooling`), d
its deviations of pressure and B, s errors that replicates do not show (smooth errors of position, 30 Pa of a set
pressure) and ε noise of covariance K, which includes the misfit of the model along each trial, since the noise of a fit
is that of its residuals. The variance at a time is the diagonal of

with ℓ the travel of the trial. δ is the discrepancy of the model between trials (Kennedy & O'Hagan, J. R. Stat. Soc. B
63, 425, 2001), one standard deviation along the whole motion. It is chosen so that the trials of the fit, each left out
in turn to first order, have the residuals that their bands predict (Paule & Mandel, J. Res. NBS 87, 377, 1982); 0 where
they have less.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.inference.fit_data import FitTrial
from vinetrack.inference.mixed_effects import FitState, inverse_of_block, trial_deviation_sd
from vinetrack.inference.optimiser import Solution
from vinetrack.inference.parameters import ParameterMap, make_layout
from vinetrack.inference.position_errors import pool, position_shapes, student, trial_information
from vinetrack.inference.robust_covariance import PRESSURE_ERROR_PA, matrix_root
from vinetrack.inference.sensitivity import DAMPING_DEVIATION, N_TRIAL_EFFECTS, ORIGIN, PRESSURE, Predictor
from vinetrack.inference.whitening import whiten

# A trial counts as covered where this part of its positions is, and a band has to cover this part of trials (chosen)
COVERED_POSITIONS, COVERAGE = 0.9, 0.95


if TYPE_CHECKING:
    from vinetrack.inference.fit_result import Fit, TrialFit


@dataclass(frozen=True)
class Calibration:
    """Calibration of the bands by the trials of a fit, each predicted from the others. `discrepancy` is δ, relative to
    the travel; `reach` the half width of the band in standard deviations; `degrees` are Student's; `trials` is the
    number of trials that could be predicted.
    """

    discrepancy: float
    reach: float
    degrees: float
    trials: int


@dataclass(frozen=True)
class _Basis:
    """The fit as predictions use it: scaled parameters, including smooth errors of position where there are any.
    `information` and `scores` are those of the trials, `between` is the between-trial covariance of the parameters.
    """

    solution: Solution
    information: Floats
    scores: Floats
    between: Floats


def with_bands(fit: Fit, data: Sequence[FitTrial], predicted: Sequence[TrialFit]) -> list[TrialFit]:
    """Predicted trials with the half width of their 95 % bands. Shape (n_points,)."""
    basis = _pooled_basis(fit)
    calibration_of_fit = _calibrated(fit, basis)
    banded = []
    for trial_data, trial in zip(data, predicted, strict=True):
        try:
            loadings, random = _loadings_of_new_trial(fit, basis, trial_data, trial)
        except SimulationError:
            banded.append(trial)
            continue
        discrepancy_variance = (calibration_of_fit.discrepancy * np.ptp(trial_data.lead_position_m)) ** 2
        sigma = np.sqrt(np.sum(loadings**2, axis=1) + random + discrepancy_variance)
        reach = max(calibration_of_fit.reach, _simultaneous(loadings / sigma[:, None], calibration_of_fit.degrees))
        banded.append(replace(trial, band_m=reach * sigma))
    return banded


def _simultaneous(loadings: Floats, degrees: float) -> float:
    """Standard deviations within which COVERED_POSITIONS of the positions of COVERAGE of trials lie. For a single way
    to deviate that is Student's t; for several, more, since a trial may deviate by one early and by another late.
    """
    draws = 1000  # Curves drawn for a simultaneous band (chosen)
    draw = np.random.default_rng(1)
    scale = np.ones(draws) if math.isinf(degrees) else np.sqrt(degrees / draw.chisquare(degrees, draws))
    thinned = loadings[:: max(len(loadings) // 60, 1)]
    curves = np.abs(thinned @ draw.standard_normal((loadings.shape[1], draws))) * scale
    return float(np.quantile(np.quantile(curves, COVERED_POSITIONS, axis=0), COVERAGE))


def calibration(fit: Fit) -> Calibration:
    """Calibration of the prediction bands by the trials of a fit, each predicted from the others."""
    return _calibrated(fit, _pooled_basis(fit))


def _pooled_basis(fit: Fit) -> _Basis:
    count = len(fit.numbers)
    pooled = None
    if fit.between is not None and fit.between.any():
        pooled = pool(fit.predictor, fit.solution, count)
    if pooled is not None:
        return _Basis(pooled.solution, pooled.information, pooled.scores, pooled.between)
    size = fit.solution.problem.prior_mean.size
    return _Basis(fit.solution, *trial_information(fit.solution), np.zeros((size, size)))


def _calibrated(fit: Fit, basis: _Basis) -> Calibration:
    """The discrepancy between trials and its degrees of freedom."""
    solution, data = basis.solution, fit.predictor.data
    pairs = [_leave_one_out(basis, trial_data, i, fit.noise_correlation) for i, trial_data in enumerate(data)]
    predictable = [(i, *pair) for i, pair in enumerate(pairs) if pair is not None]
    if not predictable:
        # 1.96: derived: standard normal quantile of 0.975
        return Calibration(0.0, 1.96, math.inf, 0)
    square = np.array([np.mean(residual**2) for _, residual, _ in predictable])
    mean_variance = np.array([np.mean(variance) for *_, variance in predictable])
    travel2 = np.array([np.ptp(data[i].lead_position_m) ** 2 for i, *_ in predictable])
    delta2 = _paule_mandel(square, mean_variance, travel2)
    assumed = delta2 == 0.0 and not basis.between.any() and not any(solution.estimable)
    # Restricted likelihood loses a degree of freedom for each fitted parameter; δ and τ lose one.
    fitted = 1 if delta2 > 0 or basis.between.any() else int(np.count_nonzero(solution.problem.prior_precision == 0))
    degrees = math.inf if assumed else max(float(len(predictable) - fitted), 1.0)
    reaches = np.sort(
        [
            np.quantile(np.abs(residual) / np.sqrt(variance + delta2 * scale), COVERED_POSITIONS)
            for (_, residual, variance), scale in zip(predictable, travel2, strict=True)
        ]
    )
    enough = min(math.ceil(COVERAGE * (len(predictable) + 1)), len(predictable))
    reach = max(float(student(np.array([degrees]))[0]), float(reaches[enough - 1]))
    return Calibration(math.sqrt(delta2), reach, degrees, len(predictable))


def _paule_mandel(square: Floats, variance: Floats, scale: Floats) -> float:
    """The δ² at which the mean of square / (variance + δ² scale) is 1; 0 where that is less without it."""
    from scipy.optimize import brentq

    def excess(delta2: float) -> float:
        return float(np.mean(square / (variance + delta2 * scale))) - 1

    highest = float(np.max(square / scale)) * square.size
    return 0.0 if excess(0.0) <= 0 else float(brentq(excess, 0.0, highest))


def _leave_one_out(basis: _Basis, trial_data: FitTrial, i: int, fit_correlation: float) -> tuple[Floats, Floats] | None:
    """Residual of a trial of the fit once left out of it, m, and its variance, m², to first order. None where the other
    trials do not determine all parameters on which it depends.
    """
    solution = basis.solution
    problem, state = solution.problem, solution.state
    size = problem.prior_mean.size
    total = basis.information.sum(axis=0) + np.diag(problem.prior_precision)
    others = total - basis.information[i]
    inside = (state.theta > problem.lower) & (state.theta < problem.upper)
    free = np.flatnonzero(problem.free & inside & (np.diag(total) > 0))
    needed = free[np.diag(basis.information[i])[free] > 0]
    # 1e-6: part of the information on a parameter that must come from other trials to predict a trial from them
    # (chosen)
    if len(basis.scores) < 2 or (np.diag(others)[needed] <= 1e-6 * np.diag(total)[needed]).any():
        return None
    covariance = inverse_of_block(others, free)
    columns, deviations = solution.columns[i], [PRESSURE, DAMPING_DEVIATION]
    design = _design_matrix(columns, problem.index[i], size)
    shift = covariance @ (basis.scores[i] - basis.scores.mean(axis=0))
    residual = columns[:, -1] + columns[:, deviations] @ state.trial_effects[i, deviations] + design @ shift
    own_loadings = _deviation_loadings(_deviation_sd(solution, i), columns, trial_data)
    loadings = np.column_stack([design @ matrix_root(covariance + basis.between), own_loadings])
    noise = float(state.variance[i]) / (1 - state.rho**2)
    aligned, random, residual = _with_release_and_origin_fitted(
        loadings, residual, columns[:, :2], trial_data, fit_correlation, state, noise
    )
    return residual, np.sum(aligned**2, axis=1) + random


def _design_matrix(columns: Floats, index: np.ndarray, size: int) -> Floats:
    """Sensitivities of a trial to all free parameters, shape (n_points, size), from the columns of its keys."""
    design = np.zeros((len(columns), size + 1))
    np.add.at(design.T, index, columns[:, N_TRIAL_EFFECTS:-1].T)
    return design[:, :size]


def _deviation_sd(solution: Solution, i: int) -> Floats:
    """Standard deviations of the deviations of pressure and ln B of one trial, shape (2,), 0 where it has none."""
    return np.asarray(
        trial_deviation_sd(solution.problem, solution.state.spread)[i] * solution.problem.has_deviation[i]
    )


def _deviation_loadings(spread: Floats, columns: Floats, trial_data: FitTrial) -> Floats:
    """Displacement by one standard deviation of pressure, of B and of a set pressure, shape (n_points, 3)."""
    set_pressure = trial_data.trace is None and spread[0] > 0 and trial_data.trial.pressure_Pa > 0
    misset = PRESSURE_ERROR_PA / trial_data.trial.pressure_Pa if set_pressure else 0.0
    moved = columns[:, [PRESSURE, DAMPING_DEVIATION, PRESSURE]]
    return np.asarray(moved * [spread[0], spread[1], misset])


def _loadings_of_new_trial(fit: Fit, basis: _Basis, trial_data: FitTrial, trial: TrialFit) -> tuple[Floats, Floats]:
    """Displacement of a new trial by one standard deviation of each error, m, and the variance of its noise, m²."""
    layout = make_layout(fit.model, [trial_data], **{key: fit.options[key] for key in ("fixed", "free", "shared")})
    theta, places = values_for_trial(fit, layout, trial_data)
    predictor = Predictor(layout, [trial_data], fit.predictor.host)
    trial_effects = np.array([[trial.release_s, trial.origin_m, 0.0, 0.0]])
    columns = predictor.linearise(theta, trial_effects)[0]
    covariance = _covariance(fit, basis) + basis.between[: len(fit.numbers), : len(fit.numbers)]
    parameter_covariance = np.diag(
        np.where(layout.prior_precision > 0, 1 / np.maximum(layout.prior_precision, 1e-300), 0.0)
    )
    matched = np.flatnonzero(places >= 0)
    parameter_covariance[matched, :] = parameter_covariance[:, matched] = 0.0
    parameter_covariance[np.ix_(matched, matched)] = covariance[np.ix_(places[matched], places[matched])]
    design = _design_matrix(columns, layout.index[0], theta.size)
    state = basis.solution.state
    spread = np.array([trial_data.gauge_error or state.spread[0], state.spread[1]])
    spread *= [predictor.has_pressure_deviation[0], predictor.has_damping_deviation[0]]
    shapes = position_shapes(predictor, [trial_data.lead_position_m - trial_effects[0, ORIGIN] - columns[:, -1]])[0]
    loadings = np.column_stack(
        [design @ matrix_root(parameter_covariance), _deviation_loadings(spread, columns, trial_data), shapes]
    )
    noise = float(np.mean(state.variance)) / (1 - state.rho**2)
    return _with_release_and_origin_fitted(
        loadings, columns[:, -1], columns[:, :2], trial_data, fit.noise_correlation, state, noise
    )[:2]


def values_for_trial(fit: Fit, layout: ParameterMap, trial_data: FitTrial) -> tuple[Floats, np.ndarray]:
    """The parameters of a fit as the layout of one trial holds them. Returns theta (scaled; those of its vine and its
    day where each has its own), places (indices among the numbers of the fit, -1 for new ones). Shape (n_free,).
    """
    theta, places = layout.start, np.full(len(layout.free), -1)
    trial = trial_data.trial
    stated = f"{trial.vine}, {trial.yield_pressure_Pa / 1e3:g} kPa"
    groups = {"", trial.vine, trial.group("day"), stated}
    for k, free in enumerate(layout.free):
        for place, number in enumerate(fit.numbers):
            if number.key == free.key and number.vine in groups:
                theta[k], places[k] = free.to_scaled(number.value), place
    return theta, places


def _covariance(fit: Fit, basis: _Basis) -> Floats:
    """Covariance of the parameters, scaled, with everything that widens their errors."""
    problem = basis.solution.problem
    total = basis.information.sum(axis=0) + np.diag(problem.prior_precision)
    count = len(fit.numbers)
    plain = inverse_of_block(total, np.flatnonzero(problem.free & (np.diag(total) > 0)))[:count, :count]
    held = fit.predictor.layout.free
    sigma = np.array(
        [n.sigma / (n.value if free.logarithmic else free.scale) for n, free in zip(fit.numbers, held, strict=True)]
    )
    by_noise = np.sqrt(np.maximum(np.diag(plain), 1e-300))
    ratio = np.where(np.isfinite(sigma) & (np.diag(plain) > 0), np.maximum(sigma / by_noise, 1.0), 1.0)
    return np.asarray(plain * ratio[:, None] * ratio)


def _with_release_and_origin_fitted(
    loadings: Floats,
    residual: Floats,
    design: Floats,
    trial_data: FitTrial,
    fit_correlation: float,
    state: FitState,
    noise: float,
) -> tuple[Floats, Floats, Floats]:
    """Loadings, noise variance at each point, and residual after release and origin are fitted to the trial. `design`
    holds the columns of release and origin, `fit_correlation` is the noise correlation with which predictions fit them,
    `noise` the variance of a position, m².
    """
    white = whiten(design, trial_data.first, fit_correlation, trial_data.relative_sd)
    fixed = np.array([not trial_data.pressurised_in_recording, True])
    inverse = np.linalg.pinv(white.T @ white * np.outer(fixed, fixed), rcond=1e-10, hermitian=True)
    points = residual.size
    whitener = whiten(np.eye(points), trial_data.first, fit_correlation, trial_data.relative_sd)
    estimator = inverse @ (white.T @ whitener)
    columns = np.column_stack([loadings, residual])
    aligned = columns - design @ (estimator @ columns)
    covariance = noise * _correlation(trial_data, state.rho)
    propagated = estimator @ covariance
    explained = 2 * np.einsum("nk,kn->n", design, propagated) - np.einsum(
        "nk,kl,nl->n", design, propagated @ estimator.T, design
    )
    return aligned[:, :-1], np.maximum(np.diag(covariance) - explained, 0.0), aligned[:, -1]


def _correlation(trial_data: FitTrial, rho: float) -> Floats:
    """Noise covariance of a trial's points over its variance, shape (n_points, n_points); stretches are independent."""
    points = np.arange(trial_data.time_s.size)
    stretch = np.cumsum(trial_data.first)
    same_stretch = stretch[:, None] == stretch
    sd = trial_data.point_sd
    correlation = np.power(rho, np.arange(points.size))[np.abs(points[:, None] - points)]
    return np.asarray(np.where(same_stretch, correlation, 0.0) * sd[:, None] * sd)
