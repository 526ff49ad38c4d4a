"""What each trial has of its own, release, origin and deviations, brought to its best while all else stays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.inference.mixed_effects import FitState, MixedProblem, trial_effect_penalty, trial_effect_step
from vinetrack.inference.sensitivity import DAMPING_DEVIATION, PRESSURE, RELEASE, Predictor
from vinetrack.inference.whitening import whiten

LARGEST_DEVIATION_STEP = 0.3
"""Largest step and largest size of a trial's deviation of pressure and ln B, and the largest step of its release,
frames. Chosen as trust region: beyond, a linear answer says little; spreads above are bounded much earlier."""

LARGEST_DEVIATION = 0.9
"""Chosen: a pressure or B off by 90 % is a fault of the sheet, not a deviation. At half such faults hold the fit at the
limit, at twice exp(1.8) multiplies B by six."""

LARGEST_RELEASE_STEP_FRAMES = 2.0
"""Chosen with the two above as a trust region; at half releases take more steps, at twice they overshoot."""


def follow_trial_effects(predictor: Predictor, problem: MixedProblem, state: FitState) -> tuple[FitState, Floats]:
    """The trials' own numbers brought to their best for the others, and the costs there.

    They are known so well that a step of the shared numbers leaves the valley by its curvature alone. Every trial
    takes what serves it best: where a release meets a frame, the cost has a corner at which no full step helps.

    Parameters
    ----------
    predictor
        Of the trials to fit.
    problem
        What does not change during the fit.
    state
        Where the fit stands.

    Returns
    -------
    state : FitState
    costs : array, shape (n_trials,)
    """
    columns = predictor.linearise(state.theta, state.trial_effects, own_only=True)
    grams = predictor.products(columns)
    ways = [
        state,
        *(
            replace(
                state,
                trial_effects=limited(
                    predictor, state.trial_effects, trial_effect_step(grams, problem, state, pinned=pinned)
                ),
            )
            for pinned in (False, True)
        ),
    ]
    costs = np.array([trial_costs(predictor, problem, way) for way in ways])
    best = np.argmin(costs, axis=0)
    trial_effects = np.array([ways[way].trial_effects[i] for i, way in enumerate(best)])
    return replace(state, trial_effects=trial_effects), np.min(costs, axis=0)


def limited(predictor: Predictor, trial_effects: Floats, step: Floats) -> Floats:
    """Own numbers after a step: the release moves by two frames at most, a deviation by 0.3.

    Parameters
    ----------
    predictor
        Of the trials to fit.
    trial_effects : array, shape (n_trials, 4)
        Before the step.
    step : array, shape (n_trials, 4)

    Returns
    -------
    array, shape (n_trials, 4)
    """
    reach = LARGEST_RELEASE_STEP_FRAMES * np.array([trial_data.frame_s for trial_data in predictor.data])
    moved = trial_effects + step
    moved[:, RELEASE] = trial_effects[:, RELEASE] + np.clip(step[:, RELEASE], -reach, reach)
    deviations = [PRESSURE, DAMPING_DEVIATION]
    stride = np.clip(step[:, deviations], -LARGEST_DEVIATION_STEP, LARGEST_DEVIATION_STEP)
    moved[:, deviations] = np.clip(trial_effects[:, deviations] + stride, -LARGEST_DEVIATION, LARGEST_DEVIATION)
    return moved


def trial_costs(predictor: Predictor, problem: MixedProblem, state: FitState) -> Floats:
    """Whitened sum of squares of every trial with what the priors of its own numbers add, shape (n_trials,).

    Parameters
    ----------
    predictor
        Of the trials to fit.
    problem
        What does not change during the fit.
    state
        Where the fit stands.

    Returns
    -------
    array, shape (n_trials,)
    """
    residuals = predictor.residuals(state.theta, state.trial_effects)
    squares = [
        float(np.sum(whiten(residual, trial_data.first, state.rho, trial_data.relative_sd) ** 2)) / variance
        for trial_data, residual, variance in zip(predictor.data, residuals, state.variance, strict=True)
    ]
    return np.array(squares) + trial_effect_penalty(problem, state)
