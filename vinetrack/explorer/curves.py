"""Curves of a model at given sizes for every trial, fast enough to follow a slider.

As in a comparison, a prediction is aligned by the trial's own release and origin alone: the origin is where the vine is
seen at rest; the release, and the origin where no rest was filmed, minimise the mean square. Each trial is simulated
once on a grid and shifted there. A motion that follows a pressure measured along with it has the clock of that pressure
and cannot be shifted: its release stays that of the comparison.
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
from vinetrack.explorer.campaign import Campaign, ShownTrial
from vinetrack.inference.left_out import TOLD_APART, scaled_least_squares
from vinetrack.inference.parameters import YIELD_PRESSURE

GRID_POINTS = 500
"""Of the grid a trial is simulated on. Derived: linear interpolation errs by h²·x″/8; with h = T/500 and x″ of order
8·L/T² that is 4·10⁻⁶ of the length; half the points make it 1.6·10⁻⁵."""

ROOM_FRAMES = 25
"""Frames beyond the recording that the grid reaches; derived: five of the largest steps of the alignment."""

SHIFTS = 12
"""Newton steps of the alignment; chosen: a release found by the comparison settles in two or three."""

LARGEST_SHIFT_FRAMES = 5.0
"""Of one step; chosen: a steep start cannot throw the release beyond the data."""

SETTLED_FRAMES = 1e-3
"""Chosen: at 1 m/s and 1000 frames a second, a thousandth of a frame is 1 µm."""


@dataclass(frozen=True)
class SizedModel:
    """A model with its sizes: parameters in `model`, yield pressures, Pa, by name of trial."""

    model: Model
    yield_Pa: Mapping[str, float]


@dataclass(frozen=True)
class ModelCurves:
    """The model's prediction of one trial; arrays have shape (n_points,), at the trial's own frames.

    `release_s` and `origin_m` are on the track's clock and ruler. `growth_m` is the position the camera would report,
    from the origin that the page uses (`AlignedTrial.origin_m`), `residual_m` measurement minus model. `path_m`, shape
    (GRID_POINTS,), is the whole motion at `path_s` since that release, from the model's own origin.
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
        """Position on the track's ruler at instants of the track's clock; NaN beyond what was simulated.

        Parameters
        ----------
        time_s : instants, any shape.

        Returns
        -------
        array of the same shape, m
        """
        since = time_s - self.release_s
        return self.origin_m + np.interp(since, self.path_s, self.path_m, right=math.nan)


Curves = tuple[ModelCurves, ...]
"""A motion for every trial of a campaign, in its order."""


def follow(campaign: Campaign, sized: SizedModel, before: Curves | None = None) -> Curves:
    """Simulate every trial and align it with its measurement.

    Parameters
    ----------
    before : curves whose releases the alignment starts from; by default those of the comparison.
    campaign : the trials.
    sized : model, sizes and yield pressures.

    Returns
    -------
    tuple of ModelCurves, one a trial

    Raises
    ------
    SimulationError
        If the model cannot be followed at these sizes.
    """
    seen = campaign.trials
    starts = [trial.release_s for trial in seen]
    if before is not None:
        starts = [
            curve.release_s if trial.data.trace is None else start
            for curve, trial, start in zip(before, seen, starts, strict=True)
        ]
    grids = [_grid(trial) for trial in seen]
    moved = simulate_many(
        sized.model,
        [with_yield(trial.data.trial, sized.yield_Pa) for trial in seen],
        grids,
        traces=[_since(trial) for trial in seen],
        host=campaign.host,
    )
    return tuple(_aligned(*parts) for parts in zip(seen, grids, moved, starts, strict=True))


def with_yield(trial: Trial, yield_Pa: Mapping[str, float]) -> Trial:
    """The trial with the yield pressure that a fit found for its vine, where it found one.

    Parameters
    ----------
    trial : as the sheet has it.
    yield_Pa : fitted yield pressures by name of trial.

    Returns
    -------
    Trial
    """
    return replace(trial, yield_pressure_Pa=yield_Pa[trial.name]) if trial.name in yield_Pa else trial


def _grid(seen: ShownTrial) -> Floats:
    """Instants since release: until the end of the recording and a little on."""
    data = seen.data
    last_s = max(data.time_s[-1] - seen.release_s, 0.0) + ROOM_FRAMES * data.frame_s
    return np.linspace(0.0, last_s, GRID_POINTS)


def _since(seen: ShownTrial) -> Trace | None:
    trace = seen.data.trace
    return None if trace is None else (trace[0] - seen.release_s, trace[1])


def _aligned(seen: ShownTrial, grid: Floats, moved: Trajectory, start_s: float) -> ModelCurves:
    """Newton's steps in release, and in the origin where the vine was not seen at rest."""
    data, position = seen.data, moved.observed_position_m
    speed = np.gradient(position, grid)
    release_s, origin_m = start_s, seen.origin_m
    longest_s = LARGEST_SHIFT_FRAMES * data.frame_s
    for _ in range(SHIFTS):
        since = data.time_s - release_s
        left = data.lead_position_m - origin_m - np.interp(since, grid, position)
        # Before release the vine stands: its speed is zero there.
        held = data.trace is not None
        slope = np.zeros(since.size) if held else -np.interp(since, grid, speed, left=0.0, right=0.0)
        later_s, higher_m = _step(slope, left, free_origin=not seen.origin_known)
        later_s = min(max(later_s, -longest_s), longest_s)
        release_s += later_s
        origin_m += higher_m
        if abs(later_s) < SETTLED_FRAMES * data.frame_s:
            break
    growth = np.interp(data.time_s - release_s, grid, position)
    residual = data.lead_position_m - origin_m - growth
    counted = residual[seen.counts_from(release_s) :]
    above = origin_m - seen.origin_m
    return ModelCurves(release_s, origin_m, growth + above, residual, float(np.mean(counted**2)), grid, position)


def _step(slope: Floats, left: Floats, *, free_origin: bool) -> tuple[float, float]:
    """Least squares of what is left on a shift in time, and one in position where that is free."""
    if not free_origin:
        square = float(slope @ slope)
        return (float(slope @ left) / square if square > 0 else 0.0), 0.0
    design = np.column_stack([slope, np.ones(slope.size)])
    later, higher = scaled_least_squares(design, left, math.sqrt(TOLD_APART))
    return float(later), float(higher)


def errors_m(campaign: Campaign, curves: Curves) -> dict[str, float]:
    """Root mean square position error by condition, m; its trials count alike, however many frames they have.

    Parameters
    ----------
    campaign : as `read_campaign` returns it.
    curves : of the model.

    Returns
    -------
    dict, m by condition
    """
    return {
        condition: math.sqrt(float(np.mean([curves[i].mean_square_m2 for i in campaign.of_condition(condition)])))
        for condition in campaign.conditions
    }


def overall_m(errors: Mapping[str, float], conditions: Sequence[str]) -> float:
    """Root mean square over conditions, m; NaN over none. Conditions whose error is not known are passed over.

    Parameters
    ----------
    errors : m by condition; NaN where unknown.
    conditions : those that count.

    Returns
    -------
    float, m
    """
    known = [errors[name] for name in conditions if math.isfinite(errors.get(name, math.nan))]
    return math.sqrt(float(np.mean(np.square(known)))) if known else math.nan


def yields_of(campaign: Campaign, numbers: Mapping[str, float]) -> dict[str, float]:
    """Yield pressures, Pa, by trial, from those that a fit gives by vine (and stated value, where it has several).

    Parameters
    ----------
    campaign : as `read_campaign` returns it.
    numbers : values by name, SI.

    Returns
    -------
    dict, Pa by name of trial
    """
    yields_Pa = {}
    for seen in campaign.trials:
        trial = seen.data.trial
        for vine in (trial.vine, f"{trial.vine}, {trial.yield_pressure_Pa / 1e3:g} kPa"):
            value = numbers.get(f"{YIELD_PRESSURE}[{vine}]")
            if value is not None:
                yields_Pa[trial.name] = value
    return yields_Pa
