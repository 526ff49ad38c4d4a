"""What a fitted model says of trials it has not seen: their release and origin are found, nothing else."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from vinetrack.effects import EffectError
from vinetrack.model.assemble import trial_fit
from vinetrack.model.fit_data import FitError, FitTrial, Pairs, prepare_trial
from vinetrack.model.free import YIELD_PRESSURE, Layout
from vinetrack.model.sensitivity import DAMPING_DEVIATION, ORIGIN, OWN, PRESSURE, RELEASE, Predictor
from vinetrack.model.simulate import SimulationError
from vinetrack.model.starts import align, first_own
from vinetrack.model.whitened import all_products, at_correlation
from vinetrack.records import Floats, Track, Trial

if TYPE_CHECKING:
    from vinetrack.model.fit_result import Fit, TrialFit

MOST_STEPS = 20
SETTLED_FRAMES = 1e-3
FEWEST_AT_REST = 5
"""Frames before the motion that tell where a vine started, to half the noise of one."""


def predict_trials(found: Fit, pairs: Pairs, *, from_rest: bool = False) -> list[TrialFit]:
    """Trials with their own release and origin, deviations zero; see `vinetrack.model.fit.predict`.

    With `from_rest` the origin is where a vine is seen at rest before it moves, and release (and the origin where no
    rest was filmed) are where the root mean square is least. Else both weigh errors with the correlation that the fit
    found, which where a model fails is nearly 1, and leaves the origin to the misfit.
    """
    if from_rest:
        found = replace(found, noise_correlation=0.0)
    data = [_known_yield(found, _prepared(trial, track)) for trial, track in pairs]
    layout = _nothing_free(found, data)
    predictor = Predictor(layout, data, found.predictor.host)
    nothing = np.empty(0)
    try:
        own, _ = align(data, predictor, nothing, first_own(data))
        own = _settle(found, predictor, own, from_rest)
        columns = predictor.linearise(nothing, own)
        moved = predictor.run(predictor.jobs(nothing, own))
    except SimulationError as error:
        raise FitError(f"The model cannot be followed: {error}") from error
    rho, variance = found.noise_correlation, found.noise_m**2 * (1 - found.noise_correlation**2)
    square = _square(columns, data, rho) / variance
    sigma = np.zeros((len(data), OWN))
    sigma[:, :2] = np.sqrt(np.einsum("nkk->nk", np.linalg.pinv(square[:, :2, :2], hermitian=True)))
    return [
        trial_fit(item, own[i], sigma[i], moved[i].observed_position_m, moved[i].lead_velocity_m_s, rho, variance)
        for i, item in enumerate(data)
    ]


def _prepared(trial: Trial, track: Track) -> FitTrial:
    try:
        return prepare_trial(trial, track)
    except FitError as error:
        raise FitError(f"Trial {trial.name}: {error}.") from error


def _known_yield(found: Fit, item: FitTrial) -> FitTrial:
    """The trial with the yield pressure that the fit found for its vine, where it found one."""
    stated = f"{item.trial.vine}, {item.trial.yield_pressure_Pa / 1e3:g} kPa"
    for number in found.numbers:
        if number.key == YIELD_PRESSURE and number.vine in (item.trial.vine, stated):
            return replace(item, trial=replace(item.trial, yield_pressure_Pa=number.value))
    return item


def _nothing_free(found: Fit, data: Sequence[FitTrial]) -> Layout:
    try:
        base = np.array([found.model.parameters_for(item.trial.vine) for item in data])
    except EffectError as error:
        raise FitError(f"{error} A vine that was not in the fit cannot be predicted.") from error
    base = base.reshape(len(data), len(found.model.parameter_names))
    return Layout(found.model, (), (), np.zeros((len(data), 0), dtype=int), base)


def _square(columns: Sequence[Floats], data: Sequence[FitTrial], rho: float) -> Floats:
    return at_correlation(all_products(columns, [item.first for item in data]), rho)


def _settle(found: Fit, predictor: Predictor, own: Floats, from_rest: bool) -> Floats:
    """Newton's steps in release and origin, no longer than two frames."""
    frames = np.array([item.frame_s for item in predictor.data])
    held = np.array([from_rest and item.n_rest >= FEWEST_AT_REST for item in predictor.data], dtype=bool)
    own = own.copy()
    for i, item in enumerate(predictor.data):
        if held[i]:
            own[i, ORIGIN] = np.mean(item.lead_position_m[: item.n_rest])
    for _ in range(MOST_STEPS):
        square = _square(predictor.linearise(np.empty(0), own), predictor.data, found.noise_correlation)
        square[held, ORIGIN, :] = square[held, :, ORIGIN] = 0.0
        step = np.einsum("nij,nj->ni", np.linalg.pinv(square[:, :2, :2], hermitian=True), square[:, :2, -1])
        step[:, RELEASE] = np.clip(step[:, RELEASE], -2 * frames, 2 * frames)
        own = own.copy()
        own[:, :2] += step
        if np.all(np.abs(step[:, RELEASE]) < SETTLED_FRAMES * frames):
            break
    own[:, [PRESSURE, DAMPING_DEVIATION]] = 0.0
    return own
