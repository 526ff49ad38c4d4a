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
LARGEST_RELEASE_STEP_FRAMES = 2.0


def follow_trial_effects(predictor: Predictor, frame: MixedProblem, state: FitState) -> tuple[FitState, Floats]:
    """The trials' own numbers brought to their best for the others, and the costs there.

    They are known so well that a step of the shared numbers leaves the valley by its curvature alone. Every trial
    takes what serves it best: where a release meets a frame, the cost has a corner at which no full step helps.
    """
    columns = predictor.linearise(state.theta, state.own, own_only=True)
    grams = predictor.products(columns)
    ways = [
        state,
        *(
            replace(state, own=limited(predictor, state.own, trial_effect_step(grams, frame, state, pinned=pinned)))
            for pinned in (False, True)
        ),
    ]
    costs = np.array([trial_costs(predictor, frame, way) for way in ways])
    best = np.argmin(costs, axis=0)
    own = np.array([ways[way].own[i] for i, way in enumerate(best)])
    return replace(state, own=own), np.min(costs, axis=0)


def limited(predictor: Predictor, own: Floats, step: Floats) -> Floats:
    """Own numbers after a step: the release moves by two frames at most, a deviation by 0.3."""
    reach = LARGEST_RELEASE_STEP_FRAMES * np.array([item.frame_s for item in predictor.data])
    moved = own + step
    moved[:, RELEASE] = own[:, RELEASE] + np.clip(step[:, RELEASE], -reach, reach)
    deviations = [PRESSURE, DAMPING_DEVIATION]
    stride = np.clip(step[:, deviations], -LARGEST_DEVIATION_STEP, LARGEST_DEVIATION_STEP)
    moved[:, deviations] = np.clip(own[:, deviations] + stride, -LARGEST_DEVIATION, LARGEST_DEVIATION)
    return moved


def trial_costs(predictor: Predictor, frame: MixedProblem, state: FitState) -> Floats:
    """Whitened sum of squares of every trial with what the priors of its own numbers add, shape (n_trials,)."""
    residuals = predictor.residuals(state.theta, state.own)
    squares = [
        float(np.sum(whiten(residual, item.first, state.rho, item.relative_sd) ** 2)) / variance
        for item, residual, variance in zip(predictor.data, residuals, state.variance, strict=True)
    ]
    return np.array(squares) + trial_effect_penalty(frame, state)
