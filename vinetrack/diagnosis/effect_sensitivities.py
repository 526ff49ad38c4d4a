"""How the trajectories of a fit answer to effects that are not in its model.

Every column is what one unit of an effect's size does to the positions of a trial, the effect added to the fitted
model and nothing else moved. With the sensitivities of the fit itself they make one set of sums of products, from which
scores, cosines and predicted gains follow by linear algebra alone.
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

AIMED_RESPONSE, LARGEST_RESPONSE, LEAST_RESPONSE = 2e-3, 2e-2, 2e-4
"""A step is good that moves a trajectory by this part of its travel, and done again where it moves it by more than the
second or less than the third: beyond, curvature counts, below the integrator's error does. Derived as in
vinetrack.inference.sensitivity; ten times to both sides."""

STARTS = 0.1
"""Part of its travel that a vine must still make with a whole effect put in. Chosen: a vine that hardly moves has no
derivative."""

SILENT_RESPONSE = 3e-6
"""Part of its travel by which a trajectory must answer to count as answering: the integrator is no better. Measured:
the integrator errs by at most 7e-7 (benchmarks/integrator.py); four times that."""


@dataclass(frozen=True)
class EffectSensitivities:
    """Columns of shape (n_points, n_shapes) for every trial, in the order of `shapes`, per unit of each size.

    `silent` names effects to which no trajectory answers at any plausible size.
    """

    shapes: tuple[CandidateShape, ...]
    columns: list[Floats]
    silent: tuple[str, ...]

    @property
    def effects(self) -> tuple[str, ...]:
        """Name of the effect of each shape."""
        return tuple(shape.effect.name for shape in self.shapes)


def effect_sensitivities(fit: Fit, shapes: Sequence[CandidateShape]) -> EffectSensitivities:
    """Ask every shape; those that do nothing by a small step are tried at finite sizes before they count as silent.

    Parameters
    ----------
    fit : the fit that is questioned.
    shapes : sequence of CandidateShape

    Returns
    -------
    EffectSensitivities
    """
    plain = fit.predictor.trajectories_at(fit.solution.state.theta, fit.solution.state.trial_effects)
    kept: list[tuple[CandidateShape, list[Floats]]] = []
    heard: set[str] = set()
    names = dict.fromkeys(shape.effect.name for shape in shapes)
    for name in names:
        of_effect = [shape for shape in shapes if shape.effect.name == name]
        answered = [answer for shape in of_effect if (answer := _answer(fit, shape, plain)) is not None]
        if not answered and any(shape.effect.parameters for shape in of_effect):
            values = of_effect[0].other_values
            finite = whole_shapes(of_effect[0].effect, [values])
            answered = [answer for shape in finite if (answer := _answer(fit, shape, plain)) is not None]
        kept += answered
        heard |= {name} if answered else set()
    columns = [_beside_each_other(kept, i, trajectory.time_s.size) for i, trajectory in enumerate(plain)]
    return EffectSensitivities(
        tuple(shape for shape, _ in kept), columns, tuple(name for name in names if name not in heard)
    )


def _beside_each_other(kept: Sequence[tuple[CandidateShape, list[Floats]]], i: int, points: int) -> Floats:
    """Answers of one trial, shape (n_points, n_shapes); they are let go where they came from, for memory."""
    columns = np.empty((points, len(kept)))
    for k, (_, answers) in enumerate(kept):
        columns[:, k], answers[i] = answers[i], np.empty(0)
    return columns


def _answer(fit: Fit, shape: CandidateShape, plain: Sequence[Trajectory]) -> tuple[CandidateShape, list[Floats]] | None:
    """What one unit of its size does to every trial, and the shape with the step that was good; None where nothing."""
    try:
        change = _change(fit, shape, plain)
        response = _response(fit, change)
        if shape.whole:
            speaks = response > SILENT_RESPONSE and not _holds_back(plain, change)
            return (shape, [moved / shape.step for moved in change]) if speaks else None
        if response <= SILENT_RESPONSE * 1e-3:
            return None
        if not LEAST_RESPONSE < response < LARGEST_RESPONSE:
            size = shape.size
            step = shape.step * AIMED_RESPONSE / response
            room = size.bounds[1] - size.zero if shape.step > 0 else size.zero - size.bounds[0]
            shape = replace(shape, step=min(step, room) if room > 0 else step)
            change = _change(fit, shape, plain)
            response = _response(fit, change)
    except SimulationError:
        return None
    return (shape, [moved / shape.step for moved in change]) if response > SILENT_RESPONSE else None


def _holds_back(plain: Sequence[Trajectory], change: Sequence[Floats]) -> bool:
    """Whether some vine hardly starts any more, although it was seen to grow: no such size can hide."""
    return any(
        float(np.max(before.observed_position_m + moved)) < STARTS * float(np.max(before.observed_position_m))
        for before, moved in zip(plain, change, strict=True)
    )


def _response(fit: Fit, change: Sequence[Floats]) -> float:
    """Largest answer, as part of a trial's travel; infinite where one cannot be followed."""
    spans = [max(float(np.ptp(trial.lead_position_m)), 1e-9) for trial in fit.trials]
    parts = [float(np.max(np.abs(moved))) / span for moved, span in zip(change, spans, strict=True)]
    worst = max(parts, default=0.0)
    return worst if math.isfinite(worst) else math.inf


def _change(fit: Fit, shape: CandidateShape, plain: Sequence[Trajectory]) -> list[Floats]:
    """By how much the positions of every trial change with the step put in, m."""
    predictor, state = fit.predictor, fit.solution.state
    jobs = predictor.job_arrays(state.theta, state.trial_effects).with_effect(shape.values)
    shared = shape.size.shared if shape.group else ""
    felt = [i for i, trial in enumerate(fit.trials) if trial.trial.group(shared) == shape.group]
    moved = predictor.run_as(predictor.layout.model + shape.effect, jobs.take(np.array(felt)))
    change = [np.zeros(before.time_s.size) for before in plain]
    for i, trajectory in zip(felt, moved, strict=True):
        change[i] = position_change(plain[i], trajectory)
    return change
