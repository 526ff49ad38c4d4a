"""What a fitted model says of trials it has not seen: their release and origin are found, nothing else."""

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

TOLD_APART = 1e-4
"""Least eigenvalue, of a matrix of unit diagonal, at which release and origin are both found."""

MOST_STEPS = 20
"""Steps of the alignment at most, and the shift in frames that counts as settled. Chosen: a thousandth of a frame is a
hundredth of a good tracker's error."""

SETTLED_FRAMES = 1e-3
"""Shift of the release below which the alignment has settled, frames. Chosen: a hundredth of what a good tracker
resolves; half takes one more step, twice is still not seen."""

FEWEST_AT_REST = 5
"""Frames before the motion that tell where a vine started, to half the noise of one. Derived: the mean of five frames
errs by 0.45 of one frame's noise."""


def predict_trials(fit: Fit, pairs: Pairs, *, from_rest: bool = False) -> list[TrialFit]:
    """Trials with their own release and origin, deviations zero; see `vinetrack.inference.fit.predict`.

    With `from_rest` the origin is where a vine is seen at rest before it moves, and release (and the origin where no
    rest was filmed) are where the root mean square is least. Else both weigh errors with the correlation that the fit
    found, which where a model fails is nearly 1, and leaves the origin to the misfit.

    Parameters
    ----------
    fit : a fit.
    pairs : iterable of (Trial, Track)
        Trials to predict.
    from_rest : bool
        Whether the origin is where the vine rests.

    Returns
    -------
    list of TrialFit

    Raises
    ------
    FitError
        If a trial cannot be used, or its vine was not in the fit and B is one per vine.
    """
    return predict_prepared(fit, prepared_pairs(pairs), from_rest=from_rest)


def predict_prepared(fit: Fit, data: Sequence[FitTrial], *, from_rest: bool = False) -> list[TrialFit]:
    """As `predict_trials`, for trials that were laid out for a fit already.

    Parameters
    ----------
    fit : a fit.
    data : sequence of FitTrial
        Trials to predict.
    from_rest : bool
        Whether the origin is where the vine rests.

    Returns
    -------
    list of TrialFit

    Raises
    ------
    FitError
        If a vine was not in the fit and B is one per vine, or the model cannot be followed.
    """
    rho = 0.0 if from_rest else fit.noise_correlation
    variance = fit.noise_m**2 * (1 - rho**2)
    predictor, trial_effects, square = aligned_to_trials(fit, data, from_rest=from_rest)
    data = predictor.data
    try:
        moved = predictor.run(predictor.jobs(np.empty(0), trial_effects))
    except SimulationError as error:
        raise FitError(f"The model cannot be followed: {error}") from error
    sigma = np.zeros((len(data), N_TRIAL_EFFECTS))
    sigma[:, :2] = np.sqrt(np.einsum("nkk->nk", np.linalg.pinv(square / variance, hermitian=True)))
    return [
        trial_fit(
            trial_data,
            trial_effects[i],
            sigma[i],
            moved[i].observed_position_m,
            moved[i].lead_velocity_m_s,
            rho,
            variance,
        )
        for i, trial_data in enumerate(data)
    ]


def aligned_to_trials(fit: Fit, data: Sequence[FitTrial], *, from_rest: bool) -> tuple[Predictor, Floats, Floats]:
    """The fitted model laid on trials: see `predict_prepared`.

    Parameters
    ----------
    fit : a fit.
    data : sequence of FitTrial
        Trials to lay it on.
    from_rest : bool
        Whether the origin is where the vine rests.

    Returns
    -------
    predictor : Predictor
        Of these trials with nothing free.
    trial_effects : array, shape (n_trials, 4)
        Release and origin found; deviations 0.
    square : array, shape (n_trials, 2, 2)
        Whitened products of release and origin.

    Raises
    ------
    FitError
        As `predict_prepared`.
    """
    data = [_known_yield(fit, trial_data) for trial_data in data]
    predictor = Predictor(_nothing_free(fit, data), data, fit.predictor.host)
    try:
        trial_effects, _ = align(data, predictor, np.empty(0), initial_trial_effects(data))
        trial_effects, square = _settle(
            predictor, trial_effects, 0.0 if from_rest else fit.noise_correlation, from_rest
        )
    except SimulationError as error:
        raise FitError(f"The model cannot be followed: {error}") from error
    return predictor, trial_effects, square


def scaled_least_squares(design: Floats, left: Floats, least: float) -> Floats:
    """Least squares of columns brought to one length, shape (n_columns,); what is hardly told apart is left alone.

    At constant speed a later release and a higher origin are one. `least` is the least singular value that counts.

    Parameters
    ----------
    design : array, shape (n_points, n_columns)
    left : array, shape (n_points,)
        What the columns have to explain.
    least : float
        Least singular value that counts, relative to the largest.

    Returns
    -------
    array, shape (n_columns,)
    """
    length = np.maximum(np.linalg.norm(design, axis=0), 1e-300)
    return np.asarray(np.linalg.lstsq(design / length, left, rcond=least)[0] / length)


def rest_is_seen(data: Sequence[FitTrial]) -> NDArray[np.bool_]:
    """Trials filmed long enough at rest to say where they began, shape (n_trials,).

    Parameters
    ----------
    data : sequence of FitTrial

    Returns
    -------
    array of bool, shape (n_trials,)
    """
    return np.array(
        [trial_data.n_rest >= FEWEST_AT_REST or trial_data.imprecise_rest is not None for trial_data in data],
        dtype=bool,
    )


def prepared_pairs(pairs: Pairs) -> list[FitTrial]:
    """Trials laid out for a prediction.

    Parameters
    ----------
    pairs : trials with their tracks

    Returns
    -------
    list of FitTrial

    Raises
    ------
    FitError
        If a trial cannot be used; the message names it.
    """
    data, unusable = prepare(pairs, weighted=False)
    for name, reason in unusable.items():
        raise FitError(f"Trial {name}: {reason}.")
    return data


def _known_yield(fit: Fit, trial_data: FitTrial) -> FitTrial:
    """The trial with the yield pressure that the fit found for its vine, where it found one."""
    stated = f"{trial_data.trial.vine}, {trial_data.trial.yield_pressure_Pa / 1e3:g} kPa"
    for number in fit.numbers:
        if number.key == YIELD_PRESSURE and number.vine in (trial_data.trial.vine, stated):
            return replace(trial_data, trial=replace(trial_data.trial, yield_pressure_Pa=number.value))
    return trial_data


def _nothing_free(fit: Fit, data: Sequence[FitTrial]) -> ParameterMap:
    try:
        base = np.array([fit.model.parameters_of(trial_data.trial) for trial_data in data])
    except EffectError as error:
        raise FitError(f"{error} A vine that was not in the fit cannot be predicted.") from error
    base = base.reshape(len(data), len(fit.model.parameter_names))
    return ParameterMap(fit.model, (), (), np.zeros((len(data), 0), dtype=int), base)


def _settle(predictor: Predictor, trial_effects: Floats, rho: float, from_rest: bool) -> tuple[Floats, Floats]:
    """Newton's steps in release and origin, no longer than two frames; the own numbers, and their information.

    A trial that has settled is left alone: it costs as much to simulate as one that has not.
    """
    data = predictor.data
    frames = np.array([trial_data.frame_s for trial_data in data])
    held = rest_is_seen(data) & from_rest
    trial_effects, square = trial_effects.copy(), np.zeros((len(data), 2, 2))
    trial_effects[:, [PRESSURE, DAMPING_DEVIATION]] = 0.0
    pressurised_in_recording = np.array([trial_data.pressurised_in_recording for trial_data in data], dtype=bool)
    for i in np.flatnonzero(held).tolist():
        trial_effects[i, ORIGIN] = data[i].rest_origin_m
    moving = np.arange(len(data))
    for _ in range(MOST_STEPS):
        sums = _sums(predictor, trial_effects, moving, rho)
        square[moving] = sums[:, :2, :2]
        sums[held[moving], ORIGIN, :] = sums[held[moving], :, ORIGIN] = 0.0
        sums[pressurised_in_recording[moving], RELEASE, :] = sums[pressurised_in_recording[moving], :, RELEASE] = 0.0
        # At constant speed a later release and a higher origin are one: brought to a unit diagonal that is seen.
        scale = 1 / np.sqrt(np.maximum(np.einsum("nkk->nk", sums[:, :2, :2]), 1e-300))
        scale[held[moving], ORIGIN] = scale[pressurised_in_recording[moving], RELEASE] = 0.0
        even = sums[:, :2, :2] * scale[:, :, None] * scale[:, None, :]
        inverse = np.linalg.pinv(even, rcond=TOLD_APART, hermitian=True) * scale[:, :, None] * scale[:, None, :]
        step = np.einsum("nij,nj->ni", inverse, sums[:, :2, -1])
        reach = 2 * frames[moving]
        step[:, RELEASE] = np.clip(step[:, RELEASE], -reach, reach)
        trial_effects[moving, :2] += step
        moving = moving[np.abs(step[:, RELEASE]) >= SETTLED_FRAMES * frames[moving]]
        if not moving.size:
            break
    return trial_effects, square


def _sums(predictor: Predictor, trial_effects: Floats, rows: NDArray[np.int_], rho: float) -> Floats:
    """Whitened products of [release, origin, residual] of some trials, shape (n_rows, 3, 3)."""
    jobs = predictor.jobs(np.empty(0), trial_effects)
    later = [row for row in rows.tolist() if not predictor.release_is_shift[row]]
    steps = {row: RELEASE_STEP_FRAMES * predictor.data[row].frame_s for row in later}
    moved = predictor.run(
        [jobs[row] for row in rows] + [jobs[k]._replace(release_s=trial_effects[k, RELEASE] + steps[k]) for k in later]
    )
    shifted = dict(zip(later, moved[rows.size :], strict=True))
    columns = []
    for row, plain in zip(rows.tolist(), moved, strict=False):
        answer = -plain.lead_velocity_m_s
        if row in shifted:
            answer = (shifted[row].observed_position_m - plain.observed_position_m) / steps[row]
        residual = predictor.data[row].lead_position_m - trial_effects[row, ORIGIN] - plain.observed_position_m
        columns.append(np.column_stack([answer, np.ones_like(answer), residual]))
    return at_correlation(all_products(columns, [predictor.data[row].first for row in rows]), rho)
