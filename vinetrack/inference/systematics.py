"""What is never known exactly and shared by trials: a payload's mass, a set pressure, the place a camera gives an edge.

Errors of that kind do not average out over trials, so that the scatter of trials does not tell of them; left out, they
pass for a small effect as soon as pressures and B scatter little.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.inference.fit_result import TrialFit
from vinetrack.inference.optimiser import Solution
from vinetrack.inference.position_errors import position_shapes
from vinetrack.inference.sensitivity import PRESSURE, Predictor, position_change

PAYLOAD_ERROR = 0.005
"""Standard deviation of a payload's mass beside what the sheet states, as part of it: a gram in two hundred."""

PRESSURE_ERROR_PA = 30.0
"""Standard deviation of a set pressure beside what the sheet states: read to a tenth of a kilopascal."""

PAYLOAD_STEP = 1e-2
"""Relative step of a payload's mass for its derivative. Derived: positions are linear in it to 1e-4."""

WAVES = 6
"""Half waves along the growth, at most, in which a tracker may be off by its stated error in all trials alike. Chosen:
six half waves describe what lens and pixel texture leave; more pass for noise, half leave steps of a door."""

BEGIN, END, COVERED = 0.015, 0.03, 4.0
"""Parts of the growth at its begin and end in which it may be off by so many times that: a door hides half of the tip
there, the last fold pulls it out of shape. Chosen after rendered recordings, in which frames behind a door and at the
end of growth were off by several stated errors."""


def systematics_of(
    predictor: Predictor, solution: Solution, trials: Sequence[TrialFit], *, positions: bool = True
) -> list[Floats]:
    """Columns of shape (n_points, n_doubts) for every trial: what one standard deviation of each does to positions.

    `positions` tells whether smooth errors of position are among them; a fit estimates those along with its numbers.

    Parameters
    ----------
    predictor : of the trials that were fitted.
    solution : where the iterations ended.
    trials : sequence of TrialFit
        In the order of the fit.
    positions : bool
        Whether smooth errors of position are among them; a fit estimates those along with its numbers.

    Returns
    -------
    list of arrays, shape (n_points, n_systematics), m
    """
    grown = [trial.predicted_position_m - trial.origin_m for trial in trials]
    ways = (
        _payloads(predictor, solution, trials),
        _set_pressures(predictor, solution),
        _tracker(predictor, trials),
    )
    parts = zip(*ways, position_shapes(predictor, grown), strict=True) if positions else zip(*ways, strict=True)
    return [np.column_stack(part) for part in parts]


def _payloads(predictor: Predictor, solution: Solution, trials: Sequence[TrialFit]) -> list[Floats]:
    """The relative error of each payload of the campaign. Trials with the same payload had the same body."""
    loaded = [i for i, trial in enumerate(trials) if trial.trial.payload_kg > 0 and trial.trial.travel_ratio != 1]
    payloads = dict.fromkeys(round(trials[i].trial.payload_kg, 9) for i in loaded)
    places = {payload: k for k, payload in enumerate(payloads)}
    columns = [np.zeros((trial.time_s.size, len(places))) for trial in trials]
    if not loaded:
        return columns
    jobs = predictor.jobs(solution.state.theta, solution.state.trial_effects)
    try:
        plain = predictor.run([jobs[i] for i in loaded])
        heavier = predictor.run([replace(jobs[i], payload_factor=1 + PAYLOAD_STEP) for i in loaded])
    except SimulationError:
        return [column[:, :0] for column in columns]
    for i, before, after in zip(loaded, plain, heavier, strict=True):
        place = places[round(trials[i].trial.payload_kg, 9)]
        columns[i][:, place] = PAYLOAD_ERROR / PAYLOAD_STEP * position_change(before, after)
    return columns


def _set_pressures(predictor: Predictor, solution: Solution) -> list[Floats]:
    """The error of the pressure that was set for a condition; its replicates have it together."""
    data = [trial_data.trial for trial_data in predictor.data]
    feels = predictor.feels_pressure & np.array([trial_data.trace is None for trial_data in predictor.data])
    conditions = dict.fromkeys(trial.condition for trial, felt in zip(data, feels, strict=True) if felt)
    places = {condition: k for k, condition in enumerate(conditions)}
    columns = [np.zeros((len(sensitivities), len(places))) for sensitivities in solution.columns]
    for column, trial, sensitivities, felt in zip(columns, data, solution.columns, feels, strict=True):
        if felt:
            column[:, places[trial.condition]] = PRESSURE_ERROR_PA / trial.pressure_Pa * sensitivities[:, PRESSURE]
    return columns


def _tracker(predictor: Predictor, trials: Sequence[TrialFit]) -> list[Floats]:
    """Slow errors along the picture, of the size of the error that is stated of positions read from recordings."""
    stated = np.array([trial_data.tracker_sigma_m for trial_data in predictor.data])
    if not np.isfinite(stated).any():
        return [np.zeros((trial.time_s.size, 0)) for trial in trials]
    sigma_m = float(np.nanmedian(stated))
    grown = [trial.predicted_position_m - trial.origin_m for trial in trials]
    reach = max(float(np.max(growth_m)) for growth_m in grown)
    waves = np.pi * np.arange(1, WAVES + 1)
    slow = [sigma_m * np.cos(growth_m[:, None] / reach * waves) for growth_m in grown]
    return [
        np.column_stack([first, *_ends(growth_m / reach, COVERED * sigma_m)])
        for first, growth_m in zip(slow, grown, strict=True)
    ]


def _ends(part: Floats, sigma_m: float) -> list[Floats]:
    """Errors where the tip leaves what holds it, and where the film runs out and the tip changes its shape."""
    last = float(np.max(part))
    return [
        sigma_m * np.exp(-part / BEGIN),
        sigma_m * np.exp(-part / (3 * BEGIN)),
        sigma_m * np.exp((part - last) / END),
    ]
