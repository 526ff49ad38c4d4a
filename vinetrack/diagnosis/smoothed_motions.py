"""Motions that lie on the tracks, whatever the model says: the starting point for a force that is not small.

The acceleration of every trial is a sum of splines, integrated twice from rest at its release and fitted to positions
with the smoothing chosen by generalised cross-validation (Wahba 1990, ch. 4). The acceleration itself is not used as
data: the equation of motion is linearised about this motion, and the defect there (what the model's forces lack) enters
as one more known acceleration, so that noise in the smoothed motion cancels to first order (quasilinearisation, Bellman
& Kalaba 1965). About the motion of a model that lacks a large force the linearisation would be poor.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.diagnosis.cubic_splines import uniform_splines
from vinetrack.diagnosis.force_inversion import LinearInversion
from vinetrack.diagnosis.force_sensitivities import FittedMotion, with_model_terms
from vinetrack.inference.fit_data import FitTrial
from vinetrack.inference.sensitivity import ORIGIN, RELEASE

# Splines of an acceleration, even in the square root of time and so denser where a vine accelerates (chosen)
N_SPLINES = 20

# Penalties on second differences, relative to the information from positions (chosen)
SMOOTHING_PENALTIES = np.geomspace(1e-8, 1e2, 21)

LAST_LENGTH_FRACTION = 0.96  # Part of the length up to which points are used (chosen)


def on_tracks(inversion: LinearInversion, trial_effects: Floats, motions: Sequence[FittedMotion]) -> list[FittedMotion]:
    """Move motions onto their tracks and evaluate the model along them. Shapes: trial_effects (n_trials, 4)."""
    return [_on_track(inversion.data[i], trial_effects[i], motion) for i, motion in enumerate(motions)]


def _on_track(data: FitTrial, trial_effects: Floats, motion: FittedMotion) -> FittedMotion:
    since_s = data.time_s - trial_effects[RELEASE]
    observed_m = data.lead_position_m - trial_effects[ORIGIN]
    position_m = observed_m - np.interp(since_s, motion.time_s, motion.observation_offset_m)
    length_m = motion.trial.length_m
    growing = (since_s > 0) & ~(position_m > LAST_LENGTH_FRACTION * length_m)
    if np.count_nonzero(growing) <= 2:
        return motion
    grid_s = motion.time_s
    last_s = float(since_s[growing].max())
    accelerations = uniform_splines(np.sqrt(np.clip(grid_s / last_s, 0.0, 1.0)), N_SPLINES)
    velocities = _integrated(grid_s, accelerations)
    positions = _integrated(grid_s, velocities)
    k = np.clip(np.searchsorted(grid_s, since_s[growing]), 1, grid_s.size - 1)
    part = ((since_s[growing] - grid_s[k - 1]) / (grid_s[k] - grid_s[k - 1]))[:, None]
    at_frames = positions[k - 1] + part * (positions[k] - positions[k - 1])
    coefficients = _penalised_fit(at_frames, position_m[growing])
    r = motion.trial.travel_ratio
    moved = replace(
        motion,
        lead_position_m=np.maximum.accumulate(np.maximum(positions @ coefficients, 0.0)),
        lead_velocity_m_s=np.maximum(velocities @ coefficients, 0.0),
        acceleration=r * (accelerations @ coefficients),
        # The model's end of growth is not that of the track: the vine responds to forces beyond it.
        end_s=math.inf,
        counts_until_s=last_s,
    )
    return with_model_terms(moved)


def _integrated(time_s: Floats, columns: Floats) -> Floats:
    """Cumulative integrals of the columns by the trapezoidal rule, 0 at the first time."""
    steps = 0.5 * (columns[1:] + columns[:-1]) * np.diff(time_s)[:, None]
    return np.concatenate([np.zeros((1, columns.shape[1])), np.cumsum(steps, axis=0)])


def _penalised_fit(design: Floats, values: Floats) -> Floats:
    """Coefficients with penalised second differences, the penalty chosen by generalised cross-validation."""
    second_difference = np.diff(np.eye(design.shape[1]), 2, axis=0)
    gram = design.T @ design
    unit = float(np.trace(gram)) / design.shape[1]
    roughness = unit * (second_difference.T @ second_difference + 1e-9 * np.eye(design.shape[1]))
    best: tuple[float, Floats] | None = None
    for penalty in SMOOTHING_PENALTIES:
        inverse = np.linalg.pinv(gram + penalty * roughness, hermitian=True)
        coefficients = inverse @ (design.T @ values)
        degrees_of_freedom = min(float(np.trace(inverse @ gram)), values.size - 1.0)
        score = float(np.sum((values - design @ coefficients) ** 2)) / (values.size - degrees_of_freedom) ** 2
        if best is None or score < best[0]:
            best = score, coefficients
    assert best is not None
    return best[1]
