"""Motions that lie on the tracks, whatever the model says: where a force that is not small is begun to be followed.

Every trial's acceleration is a sum of splines, integrated twice from rest at its release and held against positions, as
smooth as generalised cross-validation finds best (Wahba 1990, ch. 4). Nothing is read off it: the equation of motion
is linear about this motion, and what it lacks there is a push like any other, so that noise in it is undone to first
order (quasilinearisation, Bellman & Kalaba 1965). About the motion of a model that lacks a large force it is not.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.diagnosis.force_inversion import ForceFit
from vinetrack.diagnosis.force_sensitivities import FittedMotion, with_derivatives
from vinetrack.diagnosis.force_surface import curves
from vinetrack.inference.fit_data import FitTrial
from vinetrack.inference.sensitivity import ORIGIN, RELEASE

PIECES = 20
"""Splines of an acceleration, along the root of time: narrower where a vine gathers speed. Chosen: as many as forces
along the growth of a condition have."""

SMOOTHNESS = np.geomspace(1e-8, 1e2, 21)
"""Penalties tried, relative to what positions say. Chosen: from none that is felt to a straight line."""

END = 0.96
"""Part of the length up to which points count. Chosen as in `force_refinement`."""


def on_tracks(fit: ForceFit, trial_effects: Floats, motions: Sequence[FittedMotion]) -> list[FittedMotion]:
    """The motions moved onto their tracks, with what the model says along them.

    Parameters
    ----------
    fit : the trials.
    trial_effects : array, shape (n_trials, 4)
        Their releases and origins.
    motions : sequence of FittedMotion
        Those of the model, whose grids and trials are kept.

    Returns
    -------
    list of FittedMotion
        `actual` is the acceleration of the track, not that of the model.
    """
    return [_on_track(fit.data[i], trial_effects[i], motion) for i, motion in enumerate(motions)]


def _on_track(data: FitTrial, trial_effects: Floats, motion: FittedMotion) -> FittedMotion:
    since_s = data.time_s - trial_effects[RELEASE]
    shown = data.lead_position_m - trial_effects[ORIGIN]
    position_m = shown - np.interp(since_s, motion.time_s, motion.offset_m)
    length_m = motion.trial.length_m
    grows = (since_s > 0) & ~(position_m > END * length_m)
    if np.count_nonzero(grows) <= 2:
        return motion
    grid_s = motion.time_s
    last_s = float(since_s[grows].max())
    pieces = curves(np.sqrt(np.clip(grid_s / last_s, 0.0, 1.0)), PIECES)
    speeds = _integrated(grid_s, pieces)
    places = _integrated(grid_s, speeds)
    k = np.clip(np.searchsorted(grid_s, since_s[grows]), 1, grid_s.size - 1)
    part = ((since_s[grows] - grid_s[k - 1]) / (grid_s[k] - grid_s[k - 1]))[:, None]
    coefficients = _smooth(places[k - 1] + part * (places[k] - places[k - 1]), position_m[grows])
    r = motion.trial.travel_ratio
    moved = replace(
        motion,
        lead_position_m=np.maximum.accumulate(np.maximum(places @ coefficients, 0.0)),
        lead_velocity_m_s=np.maximum(speeds @ coefficients, 0.0),
        actual=r * (pieces @ coefficients),
        # Where the model would have ended is no end of the track: there, too, forces move it.
        end_s=math.inf,
        counts_until_s=last_s,
    )
    return with_derivatives(moved)


def _integrated(at_s: Floats, columns: Floats) -> Floats:
    """Integrals from the first time on, of the shape of `columns`."""
    steps = 0.5 * (columns[1:] + columns[:-1]) * np.diff(at_s)[:, None]
    return np.concatenate([np.zeros((1, columns.shape[1])), np.cumsum(steps, axis=0)])


def _smooth(design: Floats, values: Floats) -> Floats:
    """Coefficients whose second differences are as small as generalised cross-validation finds best."""
    bend = np.diff(np.eye(design.shape[1]), 2, axis=0)
    square = design.T @ design
    rough = float(np.trace(square)) / design.shape[1] * (bend.T @ bend + 1e-9 * np.eye(design.shape[1]))
    best: tuple[float, Floats] | None = None
    for strength in SMOOTHNESS:
        inverse = np.linalg.pinv(square + strength * rough, hermitian=True)
        coefficients = inverse @ (design.T @ values)
        freedom = min(float(np.trace(inverse @ square)), values.size - 1.0)
        score = float(np.sum((values - design @ coefficients) ** 2)) / (values.size - freedom) ** 2
        if best is None or score < best[0]:
            best = score, coefficients
    assert best is not None
    return best[1]
