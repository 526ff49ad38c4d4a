"""Best-fit value of one parameter for each trial, with all other parameters at their common values."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vinetrack.core.records import Floats, Trial
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.effects import Parameter
from vinetrack.inference.fit_data import FitError
from vinetrack.inference.fit_result import Fit
from vinetrack.inference.left_out import aligned_to_trials, rest_is_seen
from vinetrack.inference.parameters import DAMPING
from vinetrack.inference.sensitivity import DAMPING_DEVIATION, ORIGIN, PRESSURE, RELEASE, Predictor

NEWTON_STEPS = 5  # Gauss–Newton steps (chosen)

LARGEST_STEP = 0.3  # Largest step of ln B, or of a parameter in units of its scale (chosen)

MAX_DEVIATION_SCALES = 3.0  # Largest deviation from the common value, in scales (chosen)

TYPICAL_SCATTER = (0.01, 0.03)  # Typical standard deviations of pressure and ln B between trials (chosen)


@dataclass(frozen=True)
class PerTrialEstimates:
    """Estimates of one parameter by trial; arrays of shape (n_trials,), SI, NaN where a trial does not depend on it.
    `value` is the best fit of the trial, `base` the common value, and `deviation` their difference, of logarithms where
    `logarithmic`. `variance` is the variance of `value` from a typical scatter of pressure and B, up to a factor.
    """

    key: str
    symbol: str
    unit: str
    per_vine: bool
    logarithmic: bool
    trials: tuple[Trial, ...]
    value: Floats
    base: Floats
    deviation: Floats
    variance: Floats
    trial_effects: Floats


@dataclass(frozen=True)
class AlignedTrials:
    """A fitted model aligned with its trials: each has its own release and origin, but no deviation of pressure or B.
    `columns` are the sensitivities there, see `vinetrack.inference.sensitivity`.
    """

    predictor: Predictor
    trial_effects: Floats
    columns: tuple[Floats, ...]


def align_trials(fit: Fit) -> AlignedTrials:
    """Align the model with the trials that it was fitted to, by release and origin."""
    predictor, trial_effects, _ = aligned_to_trials(fit, fit.predictor.data, from_rest=True)
    try:
        return AlignedTrials(predictor, trial_effects, tuple(predictor.linearise(np.empty(0), trial_effects)))
    except SimulationError as error:
        raise FitError(f"The model cannot be simulated: {error}") from error


def per_trial_estimates(fit: Fit, key: str, aligned: AlignedTrials) -> PerTrialEstimates:
    """Fit the value of `key` to each trial by least squares of position, with its release free."""
    predictor, trial_effects = aligned.predictor, aligned.trial_effects
    parameter = _parameter(fit, key)
    column = fit.model.parameter_names.index(key)
    base = predictor.layout.base[:, column].copy()
    logarithmic = key == DAMPING
    scale = np.ones_like(base) if logarithmic else np.full_like(base, _scale(parameter, base))
    scaled = np.zeros_like(base)
    projected = [np.zeros(0)] * base.size
    for _ in range(NEWTON_STEPS):
        scaled, trial_effects, projected = _gauss_newton_step(
            predictor, trial_effects, column, base, scaled, scale, logarithmic
        )
    response = np.array([float(np.sum(sensitivity**2)) for sensitivity in projected])
    known = response > 1e-12 * np.array(
        [np.ptp(trial_data.lead_position_m) ** 2 * trial_data.time_s.size for trial_data in predictor.data]
    )
    known &= np.abs(scaled) < 0.99 * MAX_DEVIATION_SCALES
    deviation = np.where(known, scaled * scale, np.nan)
    return PerTrialEstimates(
        key=key,
        symbol=parameter.symbol,
        unit=parameter.unit,
        per_vine=any(number.key == key and number.vine for number in fit.numbers),
        logarithmic=logarithmic,
        trials=tuple(trial_data.trial for trial_data in predictor.data),
        value=np.where(known, base * np.exp(scaled) if logarithmic else base + scaled * scale, np.nan),
        base=base,
        deviation=deviation,
        variance=_variance(aligned, projected, scale),
        trial_effects=_with_deviation(trial_effects, scaled) if logarithmic else trial_effects,
    )


def _with_deviation(trial_effects: Floats, deviation: Floats) -> Floats:
    changed = trial_effects.copy()
    changed[:, DAMPING_DEVIATION] = deviation
    return changed


def _parameter(fit: Fit, key: str) -> Parameter:
    for effect in fit.model:
        for parameter in effect.parameters:
            if f"{effect.name}.{parameter.name}" == key:
                return parameter
    raise KeyError(key)


def _scale(parameter: Parameter, base: Floats) -> float:
    low, high = parameter.plausible or (0.0, 0.0)
    return max(float(np.max(np.abs(base - parameter.zero))), 0.1 * (high - low), 1e-12)


def _gauss_newton_step(
    predictor: Predictor,
    trial_effects: Floats,
    column: int,
    base: Floats,
    scaled: Floats,
    scale: Floats,
    logarithmic: bool,
) -> tuple[Floats, Floats, list[Floats]]:
    """One Gauss–Newton step for every trial: scaled deviation, trial effects, and the projected sensitivities. The
    sensitivities of position to the parameter are projected off those to release and origin.
    """
    step = 1e-3
    plain = predictor.jobs(np.empty(0), trial_effects)

    def at(shift: float) -> list[Floats]:
        rows = []
        for i, job in enumerate(plain):
            row = job.row.copy()
            deviation = scaled[i] + shift
            row[column] = base[i] * np.exp(deviation) if logarithmic else base[i] + deviation * scale[i]
            rows.append(row)
        return rows

    jobs = [job._replace(row=row) for shift in (0.0, step) for job, row in zip(plain, at(shift), strict=True)]
    runs = predictor.run(jobs)
    trial_effects, scaled, projected = trial_effects.copy(), scaled.copy(), []
    origin_fixed = rest_is_seen(predictor.data)
    for i, trial_data in enumerate(predictor.data):
        here, stepped = runs[i], runs[i + base.size]
        sensitivity = (stepped.observed_position_m - here.observed_position_m) / step
        others = [-here.lead_velocity_m_s] if origin_fixed[i] else [-here.lead_velocity_m_s, np.ones(sensitivity.size)]
        residual = trial_data.lead_position_m - trial_effects[i, ORIGIN] - here.observed_position_m
        design = np.column_stack([sensitivity, *others])
        best = np.linalg.lstsq(design, residual, rcond=1e-9)[0]
        scaled[i] = np.clip(
            scaled[i] + np.clip(best[0], -LARGEST_STEP, LARGEST_STEP), -MAX_DEVIATION_SCALES, MAX_DEVIATION_SCALES
        )
        trial_effects[i, RELEASE] += np.clip(best[1], -2 * trial_data.frame_s, 2 * trial_data.frame_s)
        trial_effects[i, ORIGIN] += 0.0 if origin_fixed[i] else best[2]
        projected.append(orthogonal_part(sensitivity, np.column_stack(others)))
    return scaled, trial_effects, projected


def orthogonal_part(column: Floats, others: Floats) -> Floats:
    """Component of a column that is orthogonal to all linear combinations of others. Shapes: column (n_points,); others
    (n_points, n) → (n_points,).
    """
    return np.asarray(column - others @ np.linalg.lstsq(others, column, rcond=1e-9)[0])


def _variance(aligned: AlignedTrials, projected: list[Floats], scale: Floats) -> Floats:
    """Variance of each trial's value from a typical scatter of pressure and B, and from its noise."""
    origin_fixed = rest_is_seen(aligned.predictor.data)
    variance = np.empty(scale.size)
    for i, (c, sensitivity) in enumerate(zip(aligned.columns, projected, strict=True)):
        square = max(float(np.sum(sensitivity**2)), 1e-300)
        others = c[:, [RELEASE]] if origin_fixed[i] else c[:, [RELEASE, ORIGIN]]
        levers = [float(sensitivity @ orthogonal_part(c[:, k], others)) / square for k in (PRESSURE, DAMPING_DEVIATION)]
        scatter = sum((sd * lever) ** 2 for sd, lever in zip(TYPICAL_SCATTER, levers, strict=True))
        noise = aligned.predictor.data[i].mean_noise_m ** 2 / square
        variance[i] = (scatter + noise + 1e-12) * scale[i] ** 2
    return variance
