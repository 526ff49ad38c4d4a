"""Predictions of a fitted model for trials outside the fit: only their release and origin are fitted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.effects import EffectError
from vinetrack.inference.assemble import trial_fit
from vinetrack.inference.fit_data import FitError, FitTrial, Pairs
from vinetrack.inference.parameters import YIELD_PRESSURE, ParameterMap
from vinetrack.inference.prepared_trials import prepare
from vinetrack.inference.sensitivity import (
    DAMPING_DEVIATION,
    N_TRIAL_EFFECTS,
    ORIGIN,
    PRESSURE,
    RELEASE,
    RELEASE_STEP_FRAMES,
    Predictor,
)
from vinetrack.inference.starts import align, initial_trial_effects
from vinetrack.inference.whitening import all_products, at_correlation

if TYPE_CHECKING:
    from vinetrack.inference.fit_result import Fit, TrialFit

# Least eigenvalue, of an information matrix of unit diagonal, at which release and origin are both determined (chosen)
LEAST_EIGENVALUE = 1e-4

MOST_STEPS = 20  # Maximum number of Gauss–Newton steps for release and origin (chosen)

SETTLED_FRAMES = 1e-3  # Step of the release below which it has converged, frames (chosen)

FEWEST_AT_REST = 5  # Frames at rest that determine where a vine started, to half the noise of one (derived)


def predict_trials(fit: Fit, pairs: Pairs, *, from_rest: bool = False) -> list[TrialFit]:
    """Predict trials with their own release and origin and zero deviations, see `vinetrack.inference.fit.predict`."""
    return predict_prepared(fit, prepared_pairs(pairs), from_rest=from_rest)


def predict_prepared(fit: Fit, data: Sequence[FitTrial], *, from_rest: bool = False) -> list[TrialFit]:
    """As `predict_trials`, for trials whose data are already prepared."""
    rho = 0.0 if from_rest else fit.noise_correlation
    variance = fit.noise_m**2 * (1 - rho**2)
    predictor, trial_effects, square = aligned_to_trials(fit, data, from_rest=from_rest)
    data = predictor.data
    try:
        trajectories = predictor.run(predictor.jobs(np.empty(0), trial_effects))
    except SimulationError as error:
        raise FitError(f"The model cannot be simulated: {error}") from error
    sigma = np.zeros((len(data), N_TRIAL_EFFECTS))
    sigma[:, :2] = np.sqrt(np.einsum("nkk->nk", np.linalg.pinv(square / variance, hermitian=True)))
    return [
        trial_fit(
            trial_data,
            trial_effects[i],
            sigma[i],
            trajectories[i].observed_position_m,
            trajectories[i].lead_velocity_m_s,
            rho,
            variance,
        )
        for i, trial_data in enumerate(data)
    ]


def aligned_to_trials(fit: Fit, data: Sequence[FitTrial], *, from_rest: bool) -> tuple[Predictor, Floats, Floats]:
    """Fit release and origin of trials to a fitted model. Returns predictor (of these trials, without free parameters),
    trial_effects (release and origin; zero deviations), square (whitened cross products of release and origin). Shape
    (n_trials, 4).
    """
    data = [_with_fitted_yield_pressure(fit, trial_data) for trial_data in data]
    predictor = Predictor(_without_free_parameters(fit, data), data, fit.predictor.host)
    try:
        trial_effects, _ = align(data, predictor, np.empty(0), initial_trial_effects(data))
        trial_effects, square = _fit_release_and_origin(
            predictor, trial_effects, 0.0 if from_rest else fit.noise_correlation, from_rest
        )
    except SimulationError as error:
        raise FitError(f"The model cannot be simulated: {error}") from error
    return predictor, trial_effects, square


def scaled_least_squares(design: Floats, residual: Floats, least: float) -> Floats:
    """Least squares with columns scaled to unit length; directions that are hardly determined get zero. At constant
    speed a later release and a higher origin are collinear. Shapes: design (n_points, n_columns); residual (n_points,)
    → (n_columns,).
    """
    length = np.maximum(np.linalg.norm(design, axis=0), 1e-300)
    return np.asarray(np.linalg.lstsq(design / length, residual, rcond=least)[0] / length)


def rest_is_seen(data: Sequence[FitTrial]) -> NDArray[np.bool_]:
    """Trials with enough frames at rest to determine where they started. Shape (n_trials,)."""
    return np.array(
        [trial_data.n_rest >= FEWEST_AT_REST or trial_data.imprecise_rest is not None for trial_data in data],
        dtype=bool,
    )


def prepared_pairs(pairs: Pairs) -> list[FitTrial]:
    """Prepare the data of trials for a prediction."""
    data, unusable = prepare(pairs, weighted=False)
    for name, reason in unusable.items():
        raise FitError(f"Trial {name}: {reason}.")
    return data


def _with_fitted_yield_pressure(fit: Fit, trial_data: FitTrial) -> FitTrial:
    """The trial with the fitted yield pressure of its vine, if the fit has one."""
    stated = f"{trial_data.trial.vine}, {trial_data.trial.yield_pressure_Pa / 1e3:g} kPa"
    for number in fit.numbers:
        if number.key == YIELD_PRESSURE and number.vine in (trial_data.trial.vine, stated):
            return replace(trial_data, trial=replace(trial_data.trial, yield_pressure_Pa=number.value))
    return trial_data


def _without_free_parameters(fit: Fit, data: Sequence[FitTrial]) -> ParameterMap:
    try:
        base = np.array([fit.model.parameters_of(trial_data.trial) for trial_data in data])
    except EffectError as error:
        raise FitError(f"{error} A vine that was not in the fit cannot be predicted.") from error
    base = base.reshape(len(data), len(fit.model.parameter_names))
    return ParameterMap(fit.model, (), (), np.zeros((len(data), 0), dtype=int), base)


def _fit_release_and_origin(
    predictor: Predictor, trial_effects: Floats, rho: float, from_rest: bool
) -> tuple[Floats, Floats]:
    """Gauss–Newton steps in release and origin, of at most two frames; the trial effects and their information. Trials
    that have converged are not simulated again.
    """
    data = predictor.data
    frames = np.array([trial_data.frame_s for trial_data in data])
    origin_fixed = rest_is_seen(data) & from_rest
    trial_effects, square = trial_effects.copy(), np.zeros((len(data), 2, 2))
    trial_effects[:, [PRESSURE, DAMPING_DEVIATION]] = 0.0
    pressurised_in_recording = np.array([trial_data.pressurised_in_recording for trial_data in data], dtype=bool)
    for i in np.flatnonzero(origin_fixed).tolist():
        trial_effects[i, ORIGIN] = data[i].rest_origin_m
    active = np.arange(len(data))
    for _ in range(MOST_STEPS):
        sums = _cross_products_of(predictor, trial_effects, active, rho)
        square[active] = sums[:, :2, :2]
        sums[origin_fixed[active], ORIGIN, :] = sums[origin_fixed[active], :, ORIGIN] = 0.0
        sums[pressurised_in_recording[active], RELEASE, :] = sums[pressurised_in_recording[active], :, RELEASE] = 0.0
        # At constant speed release and origin are collinear, which shows at a unit diagonal.
        scale = 1 / np.sqrt(np.maximum(np.einsum("nkk->nk", sums[:, :2, :2]), 1e-300))
        scale[origin_fixed[active], ORIGIN] = scale[pressurised_in_recording[active], RELEASE] = 0.0
        scaled = sums[:, :2, :2] * scale[:, :, None] * scale[:, None, :]
        inverse = np.linalg.pinv(scaled, rcond=LEAST_EIGENVALUE, hermitian=True) * scale[:, :, None] * scale[:, None, :]
        step = np.einsum("nij,nj->ni", inverse, sums[:, :2, -1])
        largest_step = 2 * frames[active]
        step[:, RELEASE] = np.clip(step[:, RELEASE], -largest_step, largest_step)
        trial_effects[active, :2] += step
        active = active[np.abs(step[:, RELEASE]) >= SETTLED_FRAMES * frames[active]]
        if not active.size:
            break
    return trial_effects, square


def _cross_products_of(predictor: Predictor, trial_effects: Floats, rows: NDArray[np.int_], rho: float) -> Floats:
    """Whitened cross products of [release, origin, residual] of some trials, shape (n_rows, 3, 3)."""
    jobs = predictor.jobs(np.empty(0), trial_effects)
    differenced = [row for row in rows.tolist() if not predictor.release_is_shift[row]]
    steps = {row: RELEASE_STEP_FRAMES * predictor.data[row].frame_s for row in differenced}
    trajectories = predictor.run(
        [jobs[row] for row in rows]
        + [jobs[k]._replace(release_s=trial_effects[k, RELEASE] + steps[k]) for k in differenced]
    )
    shifted = dict(zip(differenced, trajectories[rows.size :], strict=True))
    columns = []
    for row, trajectory in zip(rows.tolist(), trajectories, strict=False):
        sensitivity = -trajectory.lead_velocity_m_s
        if row in shifted:
            sensitivity = (shifted[row].observed_position_m - trajectory.observed_position_m) / steps[row]
        residual = predictor.data[row].lead_position_m - trial_effects[row, ORIGIN] - trajectory.observed_position_m
        columns.append(np.column_stack([sensitivity, np.ones_like(sensitivity), residual]))
    return at_correlation(all_products(columns, [predictor.data[row].first for row in rows]), rho)
