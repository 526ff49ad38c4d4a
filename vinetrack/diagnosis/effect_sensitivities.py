"""Sensitivities of a fit's trajectories to effects that are not in its model.

Each column is the change of a trial's positions per unit of an effect's size, with the effect added to the fitted model
and all other parameters held. Together with the fit's own sensitivities the columns give one set of cross products,
from which score tests, cosines and expected gains follow by linear algebra.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.diagnosis.candidates import CandidateShape, whole_shapes
from vinetrack.dynamics.simulate import SimulationError, Trajectory
from vinetrack.inference.fit_result import Fit
from vinetrack.inference.position_change import position_change

# A finite-difference step should move a trajectory by the first of these parts of its travel (derived)
TARGET_RESPONSE, LARGEST_RESPONSE, LEAST_RESPONSE = 2e-3, 2e-2, 2e-4

LEAST_REMAINING_TRAVEL = 0.1  # Part of its travel that a vine must still make with a finite effect added (chosen)

# Part of its travel by which a trajectory must change to count as responding, four times the integrator's error
# (measured)
LEAST_DETECTABLE_RESPONSE = 3e-6


@dataclass(frozen=True)
class EffectSensitivities:
    """Columns of shape (n_points, n_shapes) for every trial, in the order of `shapes`, per unit of each size. `silent`
    names the effects to which no trajectory responds at any plausible size.
    """

    shapes: tuple[CandidateShape, ...]
    columns: list[Floats]
    silent: tuple[str, ...]

    @property
    def effects(self) -> tuple[str, ...]:
        """Name of the effect of each shape."""
        return tuple(shape.effect.name for shape in self.shapes)


def effect_sensitivities(fit: Fit, shapes: Sequence[CandidateShape]) -> EffectSensitivities:
    """Compute the sensitivities to all shapes of all candidate effects. An effect to which no trajectory responds for a
    small step is tried at finite sizes before it counts as silent.
    """
    baseline = fit.predictor.trajectories_at(fit.solution.state.theta, fit.solution.state.trial_effects)
    responses: list[tuple[CandidateShape, list[Floats]]] = []
    detected: set[str] = set()
    names = dict.fromkeys(shape.effect.name for shape in shapes)
    for name in names:
        of_effect = [shape for shape in shapes if shape.effect.name == name]
        responding = [each for shape in of_effect if (each := _sensitivity(fit, shape, baseline)) is not None]
        if not responding and any(shape.effect.parameters for shape in of_effect):
            values = of_effect[0].other_values
            finite = whole_shapes(of_effect[0].effect, [values])
            responding = [each for shape in finite if (each := _sensitivity(fit, shape, baseline)) is not None]
        responses += responding
        detected |= {name} if responding else set()
    columns = [_columns_of_trial(responses, i, trajectory.time_s.size) for i, trajectory in enumerate(baseline)]
    return EffectSensitivities(
        tuple(shape for shape, _ in responses), columns, tuple(name for name in names if name not in detected)
    )


def _columns_of_trial(responses: Sequence[tuple[CandidateShape, list[Floats]]], i: int, points: int) -> Floats:
    """Columns of one trial, shape (n_points, n_shapes). The list entries are released, to save memory."""
    columns = np.empty((points, len(responses)))
    for k, (_, columns_of_trials) in enumerate(responses):
        columns[:, k], columns_of_trials[i] = columns_of_trials[i], np.empty(0)
    return columns


def _sensitivity(
    fit: Fit, shape: CandidateShape, baseline: Sequence[Trajectory]
) -> tuple[CandidateShape, list[Floats]] | None:
    """Change of all positions per unit of size, and the shape with the step used; None without a response."""
    try:
        change = _change(fit, shape, baseline)
        response = _response(fit, change)
        if shape.whole:
            usable = response > LEAST_DETECTABLE_RESPONSE and not _prevents_growth(baseline, change)
            return (shape, [moved / shape.step for moved in change]) if usable else None
        if response <= LEAST_DETECTABLE_RESPONSE * 1e-3:
            return None
        if not LEAST_RESPONSE < response < LARGEST_RESPONSE:
            size = shape.size
            step = shape.step * TARGET_RESPONSE / response
            available = size.bounds[1] - size.zero if shape.step > 0 else size.zero - size.bounds[0]
            shape = replace(shape, step=min(step, available) if available > 0 else step)
            change = _change(fit, shape, baseline)
            response = _response(fit, change)
    except SimulationError:
        return None
    return (shape, [moved / shape.step for moved in change]) if response > LEAST_DETECTABLE_RESPONSE else None


def _prevents_growth(baseline: Sequence[Trajectory], change: Sequence[Floats]) -> bool:
    """Whether some vine that grew in the recording hardly starts with the effect: so large a size is excluded."""
    return any(
        float(np.max(before.observed_position_m + moved))
        < LEAST_REMAINING_TRAVEL * float(np.max(before.observed_position_m))
        for before, moved in zip(baseline, change, strict=True)
    )


def _response(fit: Fit, change: Sequence[Floats]) -> float:
    """Largest change of a trial, as part of its travel; infinite where one cannot be simulated."""
    spans = [max(float(np.ptp(trial.lead_position_m)), 1e-9) for trial in fit.trials]
    parts = [float(np.max(np.abs(moved))) / span for moved, span in zip(change, spans, strict=True)]
    worst = max(parts, default=0.0)
    return worst if math.isfinite(worst) else math.inf


def _change(fit: Fit, shape: CandidateShape, baseline: Sequence[Trajectory]) -> list[Floats]:
    """Change of the positions of every trial with the step of the shape added, m."""
    predictor, state = fit.predictor, fit.solution.state
    jobs = predictor.job_arrays(state.theta, state.trial_effects).with_effect(shape.values)
    shared = shape.size.shared if shape.group else ""
    affected = [i for i, trial in enumerate(fit.trials) if trial.trial.group(shared) == shape.group]
    changed = predictor.run_as(predictor.layout.model + shape.effect, jobs.take(np.array(affected)))
    change = [np.zeros(before.time_s.size) for before in baseline]
    for i, trajectory in zip(affected, changed, strict=True):
        change[i] = position_change(baseline[i], trajectory)
    return change
