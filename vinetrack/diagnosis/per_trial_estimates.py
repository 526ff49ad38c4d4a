"""The value of one parameter that would suit every trial best, all else held at the common law."""

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

NEWTON_STEPS = 5
"""Newton steps. Chosen."""

LARGEST_STEP = 0.3
"""Of ln B, or of a parameter's scale, at once: beyond, a straight line says little. Chosen as trust region."""

MAX_DEVIATION_SCALES = 3.0
"""How many scales a value may end up from the common one: a trial that does not feel it would go anywhere. Chosen:
three scales cover the plausible range."""

LIKELY_SCATTER = (0.01, 0.03)
"""Of pressure and B; only how trials are weighed against each other hangs on it. Chosen as FIRST_SPREADS of the
optimiser."""


@dataclass(frozen=True)
class PerTrialEstimates:
    """One parameter, by trial; arrays have shape (n_trials,), SI, NaN where a trial does not feel it.

    `value` suits the trial best, `base` is that of the common law; `deviation` their difference, of the logarithms
    where `logarithmic`. `variance` is what a likely scatter of pressure and B makes of it, up to a factor. `own`, shape
    (n_trials, 4), are the trials' own numbers that belong to these values.
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
class AlignedTrial:
    """A fitted model laid on its trials: each has its own release and origin, nothing else.

    `columns` are the sensitivities there, see `vinetrack.inference.sensitivity`.
    """

    predictor: Predictor
    trial_effects: Floats
    columns: tuple[Floats, ...]


def lay(fit: Fit) -> AlignedTrial:
    """Lay the model on the trials that it was fitted to.

    Parameters
    ----------
    fit
        A fitted model.

    Returns
    -------
    AlignedTrial

    Raises
    ------
    FitError
        If it cannot be followed.
    """
    predictor, trial_effects, _ = aligned_to_trials(fit, fit.predictor.data, from_rest=True)
    try:
        return AlignedTrial(predictor, trial_effects, tuple(predictor.linearise(np.empty(0), trial_effects)))
    except SimulationError as error:
        raise FitError(f"The model cannot be followed: {error}") from error


def per_trial_estimates(fit: Fit, key: str, laid: AlignedTrial) -> PerTrialEstimates:
    """Find the best value of `key` for every trial: least squares of position, its release free.

    Parameters
    ----------
    fit
        A fitted model.
    key : str
        Name of a parameter, `effect.parameter`.
    laid : the model aligned with its trials, from `lay`.

    Returns
    -------
    PerTrialEstimates

    Raises
    ------
    SimulationError
        If a trial cannot be followed on the way.
    """
    predictor, trial_effects = laid.predictor, laid.trial_effects
    parameter = _parameter(fit, key)
    column = fit.model.parameter_names.index(key)
    base = predictor.layout.base[:, column].copy()
    logarithmic = key == DAMPING
    scale = np.ones_like(base) if logarithmic else np.full_like(base, _scale(parameter, base))
    moved = np.zeros_like(base)
    projected = [np.zeros(0)] * base.size
    for _ in range(NEWTON_STEPS):
        moved, trial_effects, projected = _improved(predictor, trial_effects, column, base, moved, scale, logarithmic)
    felt = np.array([float(np.sum(answer**2)) for answer in projected])
    known = felt > 1e-12 * np.array(
        [np.ptp(trial_data.lead_position_m) ** 2 * trial_data.time_s.size for trial_data in predictor.data]
    )
    known &= np.abs(moved) < 0.99 * MAX_DEVIATION_SCALES
    deviation = np.where(known, moved * scale, np.nan)
    return PerTrialEstimates(
        key=key,
        symbol=parameter.symbol,
        unit=parameter.unit,
        per_vine=any(number.key == key and number.vine for number in fit.numbers),
        logarithmic=logarithmic,
        trials=tuple(trial_data.trial for trial_data in predictor.data),
        value=np.where(known, base * np.exp(moved) if logarithmic else base + moved * scale, np.nan),
        base=base,
        deviation=deviation,
        variance=_variance(laid, projected, scale),
        trial_effects=_with_deviation(trial_effects, moved) if logarithmic else trial_effects,
    )


def _with_deviation(trial_effects: Floats, moved: Floats) -> Floats:
    changed = trial_effects.copy()
    changed[:, DAMPING_DEVIATION] = moved
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


def _improved(
    predictor: Predictor,
    trial_effects: Floats,
    column: int,
    base: Floats,
    moved: Floats,
    scale: Floats,
    logarithmic: bool,
) -> tuple[Floats, Floats, list[Floats]]:
    """One step of Gauss and Newton for every trial; also what its positions answer, release and origin taken away."""
    step = 1e-3
    plain = predictor.jobs(np.empty(0), trial_effects)

    def at(shift: float) -> list[Floats]:
        rows = []
        for i, job in enumerate(plain):
            row = job.row.copy()
            away = moved[i] + shift
            row[column] = base[i] * np.exp(away) if logarithmic else base[i] + away * scale[i]
            rows.append(row)
        return rows

    jobs = [job._replace(row=row) for shift in (0.0, step) for job, row in zip(plain, at(shift), strict=True)]
    runs = predictor.run(jobs)
    trial_effects, moved, projected = trial_effects.copy(), moved.copy(), []
    held = rest_is_seen(predictor.data)
    for i, trial_data in enumerate(predictor.data):
        here, there = runs[i], runs[i + base.size]
        answer = (there.observed_position_m - here.observed_position_m) / step
        others = [-here.lead_velocity_m_s] if held[i] else [-here.lead_velocity_m_s, np.ones(answer.size)]
        left = trial_data.lead_position_m - trial_effects[i, ORIGIN] - here.observed_position_m
        design = np.column_stack([answer, *others])
        best = np.linalg.lstsq(design, left, rcond=1e-9)[0]
        moved[i] = np.clip(
            moved[i] + np.clip(best[0], -LARGEST_STEP, LARGEST_STEP), -MAX_DEVIATION_SCALES, MAX_DEVIATION_SCALES
        )
        trial_effects[i, RELEASE] += np.clip(best[1], -2 * trial_data.frame_s, 2 * trial_data.frame_s)
        trial_effects[i, ORIGIN] += 0.0 if held[i] else best[2]
        projected.append(without(answer, np.column_stack(others)))
    return moved, trial_effects, projected


def without(answer: Floats, others: Floats) -> Floats:
    """What of an answer no sum of the others makes, shape (n_points,).

    Parameters
    ----------
    answer : array, shape (n_points,)
    others : array, shape (n_points, n)

    Returns
    -------
    array, shape (n_points,)
    """
    return np.asarray(answer - others @ np.linalg.lstsq(others, answer, rcond=1e-9)[0])


def _variance(laid: AlignedTrial, projected: list[Floats], scale: Floats) -> Floats:
    """What a likely scatter of pressure and B does to the value found for each trial, and its noise."""
    held = rest_is_seen(laid.predictor.data)
    variance = np.empty(scale.size)
    for i, (c, mine) in enumerate(zip(laid.columns, projected, strict=True)):
        square = max(float(np.sum(mine**2)), 1e-300)
        others = c[:, [RELEASE]] if held[i] else c[:, [RELEASE, ORIGIN]]
        levers = [float(mine @ without(c[:, k], others)) / square for k in (PRESSURE, DAMPING_DEVIATION)]
        scatter = sum((sd * lever) ** 2 for sd, lever in zip(LIKELY_SCATTER, levers, strict=True))
        noise = laid.predictor.data[i].mean_noise_m ** 2 / square
        variance[i] = (scatter + noise + 1e-12) * scale[i] ** 2
    return variance
