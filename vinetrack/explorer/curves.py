"""Curves of a model with given sizes for every trial, fast enough for a slider.

As in a comparison, a prediction is aligned only by the trial's own release and origin. The origin is the rest position
of the vine; the release, and the origin if no rest was filmed, minimise the mean square residual. Each trial is
simulated once on a grid, which is then shifted. A motion under a recorded pressure is tied to the clock of that
pressure and cannot be shifted: its release remains that of the comparison.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from vinetrack.core.records import Floats, Trial
from vinetrack.dynamics.batch import Trace
from vinetrack.dynamics.model import Model
from vinetrack.dynamics.simulate import Trajectory, simulate_many
from vinetrack.explorer.campaign import Campaign, ExplorerTrial
from vinetrack.inference.left_out import LEAST_EIGENVALUE, scaled_least_squares
from vinetrack.inference.parameters import YIELD_PRESSURE

GRID_POINTS = 500  # Points of the simulation grid (derived)

MARGIN_FRAMES = 25  # Frames by which the grid extends beyond the recording

MAX_NEWTON_STEPS = 12  # Newton steps of the alignment at most

MAX_STEP_FRAMES = 5.0  # Largest step, in frames; chosen: keeps the release within the data even from a poor start

CONVERGED_STEP_FRAMES = 1e-3  # Step, in frames, below which the alignment has converged (chosen)


@dataclass(frozen=True)
class SizedModel:
    """A model with its parameter values, and yield pressures, Pa, by name of trial."""

    model: Model
    yield_Pa: Mapping[str, float]


@dataclass(frozen=True)
class ModelCurves:
    """The model's prediction of one trial; arrays have shape (n_points,), at the trial's own frames. `release_s` and
    `origin_m` are in the coordinates of the track. `growth_m` is the position that the camera would report, from the
    origin of the page (`ExplorerTrial.origin_m`), `residual_m` is measurement minus model.
    """

    release_s: float
    origin_m: float
    growth_m: Floats
    residual_m: Floats
    mean_square_m2: float
    path_s: Floats
    path_m: Floats

    @property
    def rms_m(self) -> float:
        """Root mean square of the residuals while anything moves, m."""
        return math.sqrt(self.mean_square_m2)

    def lead_position_m(self, time_s: Floats) -> Floats:
        """Return positions at times, both in the coordinates of the track; NaN beyond the simulation."""
        since_release = time_s - self.release_s
        return self.origin_m + np.interp(since_release, self.path_s, self.path_m, right=math.nan)


Curves = tuple[ModelCurves, ...]  # The predicted motion of every trial of a campaign, in its order


def simulate_curves(campaign: Campaign, sized_model: SizedModel, before: Curves | None = None) -> Curves:
    """Simulate every trial and align it with its measurement."""
    trials = campaign.trials
    starts = [trial.release_s for trial in trials]
    if before is not None:
        starts = [
            curve.release_s if trial.data.trace is None else start
            for curve, trial, start in zip(before, trials, starts, strict=True)
        ]
    grids = [_grid(trial) for trial in trials]
    trajectories = simulate_many(
        sized_model.model,
        [with_yield_pressure(trial.data.trial, sized_model.yield_Pa) for trial in trials],
        grids,
        traces=[_trace_since_release(trial) for trial in trials],
        host=campaign.host,
    )
    return tuple(_aligned(*parts) for parts in zip(trials, grids, trajectories, starts, strict=True))


def with_yield_pressure(trial: Trial, yield_Pa: Mapping[str, float]) -> Trial:
    """Return the trial with the fitted yield pressure of its vine, if there is one."""
    return replace(trial, yield_pressure_Pa=yield_Pa[trial.name]) if trial.name in yield_Pa else trial


def _grid(aligned: ExplorerTrial) -> Floats:
    """Times since release, up to the end of the recording plus a margin."""
    data = aligned.data
    last_s = max(data.time_s[-1] - aligned.release_s, 0.0) + MARGIN_FRAMES * data.frame_s
    return np.linspace(0.0, last_s, GRID_POINTS)


def _trace_since_release(aligned: ExplorerTrial) -> Trace | None:
    trace = aligned.data.trace
    return None if trace is None else (trace[0] - aligned.release_s, trace[1])


def _aligned(aligned: ExplorerTrial, grid: Floats, moved: Trajectory, start_s: float) -> ModelCurves:
    """Newton steps in release, and in the origin if the vine was not filmed at rest."""
    data, position = aligned.data, moved.observed_position_m
    speed = np.gradient(position, grid)
    release_s, origin_m = start_s, aligned.origin_m
    longest_s = MAX_STEP_FRAMES * data.frame_s
    for _ in range(MAX_NEWTON_STEPS):
        since_release = data.time_s - release_s
        residual = data.lead_position_m - origin_m - np.interp(since_release, grid, position)
        # Before release the vine is at rest: its velocity is zero.
        is_fixed = data.trace is not None
        slope = (
            np.zeros(since_release.size) if is_fixed else -np.interp(since_release, grid, speed, left=0.0, right=0.0)
        )
        shift_s, rise_m = _step(slope, residual, free_origin=not aligned.origin_known)
        shift_s = min(max(shift_s, -longest_s), longest_s)
        release_s += shift_s
        origin_m += rise_m
        if abs(shift_s) < CONVERGED_STEP_FRAMES * data.frame_s:
            break
    growth = np.interp(data.time_s - release_s, grid, position)
    residual = data.lead_position_m - origin_m - growth
    counted = residual[aligned.first_counted_frame(release_s) :]
    offset = origin_m - aligned.origin_m
    return ModelCurves(release_s, origin_m, growth + offset, residual, float(np.mean(counted**2)), grid, position)


def _step(slope: Floats, residual: Floats, *, free_origin: bool) -> tuple[float, float]:
    """Least-squares fit of the residuals by a shift in time, and one in position if that is free."""
    if not free_origin:
        square = float(slope @ slope)
        return (float(slope @ residual) / square if square > 0 else 0.0), 0.0
    design = np.column_stack([slope, np.ones(slope.size)])
    shift, rise = scaled_least_squares(design, residual, math.sqrt(LEAST_EIGENVALUE))
    return float(shift), float(rise)


def errors_m(campaign: Campaign, curves: Curves) -> dict[str, float]:
    """Return the root mean square position error by condition, m; all trials have the same weight."""
    return {
        condition: math.sqrt(
            float(np.mean([curves[i].mean_square_m2 for i in campaign.indices_of_condition(condition)]))
        )
        for condition in campaign.conditions
    }


def overall_m(errors: Mapping[str, float], conditions: Sequence[str]) -> float:
    """Return the root mean square over conditions with a known error, m; NaN if there are none."""
    known = [errors[name] for name in conditions if math.isfinite(errors.get(name, math.nan))]
    return math.sqrt(float(np.mean(np.square(known)))) if known else math.nan


def fitted_yield_pressures(campaign: Campaign, numbers: Mapping[str, float]) -> dict[str, float]:
    """Return fitted yield pressures by trial, from those by vine (and stated value, if a vine has several)."""
    yields_Pa = {}
    for aligned in campaign.trials:
        trial = aligned.data.trial
        for vine in (trial.vine, f"{trial.vine}, {trial.yield_pressure_Pa / 1e3:g} kPa"):
            value = numbers.get(f"{YIELD_PRESSURE}[{vine}]")
            if value is not None:
                yields_Pa[trial.name] = value
    return yields_Pa
