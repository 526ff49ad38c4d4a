"""Candidates of a diagnosis: which effects the trials can test, and in which shapes each is tried."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from vinetrack.core.records import Floats, Trial
from vinetrack.diagnosis.remarks import Remark, remark
from vinetrack.dynamics.model import Model, check_needs, stated
from vinetrack.dynamics.simulate import SimulationError, Trajectory
from vinetrack.effects import Effect, EffectError, Parameter
from vinetrack.inference.fit_data import FitTrial
from vinetrack.inference.fit_result import Fit
from vinetrack.inference.parameters import group_names
from vinetrack.inference.sensitivity import position_change

# Where the ends of a plausible range differ by more than the first factor, a size may lie below it by the second
# (chosen)
NARROW_RANGE, BELOW_RANGE_FACTOR = 2.0, 3.0


# The same for an effect with a threshold (chosen)
THRESHOLD_AMPLITUDES = (0.03, 0.06, 0.1, 0.15, 0.2, 0.28, 0.37, 0.48, 0.6, 0.75)

# Fraction of the plausible range within which a size may differ from that of a slip in the sheet (chosen)
RANGE_SHARE_BESIDE_SLIP = 0.5

# Columns that only a tube has, and what an effect that needs them acts on
COLUMN_BLANK, COLUMNS_PARTLY_BLANK = "column_blank", "columns_partly_blank"  # Codes of reasons


@dataclass(frozen=True)
class CandidateShape:
    """An effect in the form in which its size is tested: the first parameter is the size, the others are fixed. The
    others are fixed at `other_values`. `step` is the step of the size in the finite difference. Where `whole`, the step
    is a finite size, because the effect has no or another response to small sizes.
    """

    effect: Effect
    other_values: tuple[float, ...]
    step: float
    whole: bool = False
    group: str = ""
    other_groups: tuple[str, ...] = ()

    @property
    def values(self) -> tuple[float, ...]:
        """Parameter values with the size one step from zero."""
        return (self.size.zero + self.step, *self.other_values) if self.effect.parameters else ()

    @property
    def size(self) -> Parameter:
        """The parameter that is the size of the effect."""
        return self.effect.parameters[0]


def testable(candidates: Sequence[Effect], data: Sequence[FitTrial]) -> tuple[tuple[Effect, ...], dict[str, Remark]]:
    """Candidates that these trials can test, and for the others the reason why not. Returns testable, reasons (why each
    of the others cannot be tested, by name).
    """
    tube_only_columns = ("chamber_l", "inlet_mm", "yield_pressure_kPa")
    can_act: list[Effect] = []
    reasons: dict[str, Remark] = {}
    no_tube = all(trial_data.trial.travel_ratio == 1 for trial_data in data)
    for effect in candidates:
        if no_tube and (absent := [column for column in effect.needs if column in tube_only_columns]):
            reasons[effect.name] = remark("no_tube", column=absent[0])
            continue
        if effect.in_trace and all(trial_data.trace is not None for trial_data in data):
            reasons[effect.name] = remark("in_measured_pressure")
            continue
        if "trace_time" in effect.functions and all(trial_data.trace is None for trial_data in data):
            reasons[effect.name] = remark("no_measured_pressure")
            continue
        if absent := [
            column for column in effect.needs if not any(stated(column, trial_data.trial) for trial_data in data)
        ]:
            reasons[effect.name] = remark(COLUMN_BLANK, column=absent[0])
            continue
        try:
            check_needs(Model((effect,)), *(trial_data.trial for trial_data in data))
        except EffectError:
            reasons[effect.name] = remark(COLUMNS_PARTLY_BLANK, columns=list(effect.needs))
            continue
        can_act.append(effect)
    return tuple(can_act), reasons


def shapes_of(effect: Effect, trials: Sequence[Trial] = ()) -> list[CandidateShape]:
    """Shapes in which an effect is tried: every combination of typical values of its shape parameters. An effect whose
    size may differ between vines or days is tried with one size for all, and in each group alone.
    """
    if not effect.parameters:
        return [CandidateShape(effect, (), 1.0, whole=True)]
    size, *others = effect.parameters
    combinations = list(itertools.product(*(_typical_values(parameter) for parameter in others)))
    shapes = [CandidateShape(effect, values, _first_step(size)) for values in combinations]
    if others or effect.finite:
        middle = [values for k, values in enumerate(combinations) if k == len(combinations) // 2]
        shapes += whole_shapes(effect, middle)
    groups = group_names(trials, size.shared)
    if len(groups) > 1:
        shapes += [
            replace(shapes[0], group=group, other_groups=tuple(other for other in groups if other != group))
            for group in groups
        ]
    return shapes


def whole_shapes(effect: Effect, other_values: Sequence[tuple[float, ...]] = ((),)) -> list[CandidateShape]:
    """Shapes of an effect at finite sizes within its plausible range."""
    low, high = plausible_range(effect.parameters[0])
    largest = high if abs(high) >= abs(low) else low
    zero = effect.parameters[0].zero
    # (0.03, 0.2, 0.7): fractions of the plausible range at which an effect is tried that has no response to an
    # infinitesimal size (chosen)
    fractions = THRESHOLD_AMPLITUDES if "rest_force" in effect.functions else (0.03, 0.2, 0.7)
    return [
        CandidateShape(effect, values, fraction * (largest - zero), whole=True)
        for values in other_values
        for fraction in fractions
    ]


def _first_step(size: Parameter) -> float:
    """A size small compared with the plausible range."""
    low, high = plausible_range(size)
    return 0.01 * max(abs(high - size.zero), abs(low - size.zero))


def plausible_range(parameter: Parameter) -> tuple[float, float]:
    """Plausible range of a parameter; where the effect states none, three times its default on either side of zero.
    Returns low, high : float, SI.
    """
    if parameter.plausible is not None:
        return parameter.plausible
    low, high = parameter.bounds
    reach = 3 * abs(parameter.default - parameter.zero) or 1.0
    return max(low, parameter.zero - reach), min(high, parameter.zero + reach)


def _typical_values(parameter: Parameter) -> tuple[float, ...]:
    """Values that the effect names; else three that span the plausible range, or its middle where that is narrow."""
    if parameter.tried:
        return parameter.tried
    low, high = plausible_range(parameter)
    # 10.0: ratio of the ends of a plausible range from which values are tried in geometric steps (chosen)
    if low > 0 and high / low > 10.0:
        return tuple(np.geomspace(low, high, 5)[1:4].tolist())
    if low > 0 and high / low < NARROW_RANGE:
        return ((low + high) / 2,)
    return tuple((low + fraction * (high - low)) for fraction in (0.15, 0.5, 0.85))


def slip_of(parameter: Parameter, value: float, sigma: float, *, reach: float = 3.0) -> tuple[float, str] | None:
    """Find the common slip in the sheet that would produce a fitted size, up to an ordinary error. Returns (float, str)
    or None: Size that the slip produces, and what was done; None where no slip fits.
    """
    if parameter.plausible is None:
        return None
    low, high = (RANGE_SHARE_BESIDE_SLIP * end for end in parameter.plausible)
    for size, action in parameter.slips:
        remaining, margin = (1 + value) / (1 + size) - 1, reach * sigma / (1 + size)
        if low - margin <= remaining <= high + margin:
            return size, action
    return None


def is_plausible(parameter: Parameter, value: float, sigma: float, *, reach: float = 3.0, widened: float = 1.0) -> bool:
    """Whether a value lies in the plausible range, within `reach` standard errors of it, or is that of a slip."""
    if (
        parameter.plausible is None
        or value == parameter.zero
        or slip_of(parameter, value, sigma, reach=reach) is not None
    ):
        return True
    low, high = parameter.plausible
    if math.isfinite(parameter.period):
        value = low + (value - low) % parameter.period
    if low > 0 and high / low > NARROW_RANGE:
        low /= BELOW_RANGE_FACTOR
    low, high = min(low / widened, low * widened), max(high * widened, high / widened)
    margin = reach * sigma if math.isfinite(sigma) else math.inf
    return bool(low - margin <= value <= high + margin)


# ------------------------------------------------------------------------------
# Sensitivities of a fit's trajectories to effects that are not in its model.
#
# Each column is the change of a trial's positions per unit of an effect's size, with the effect added to the fitted
# model and all other parameters held. Together with the fit's own sensitivities the columns give one set of cross
# products, from which score tests, cosines and expected gains follow by linear algebra.


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
    # Part of its travel by which a trajectory must change to count as responding, four times the integrator's
    # error (measured)
    least_detectable_response = 3e-6
    try:
        change = _change(fit, shape, baseline)
        response = _response(fit, change)
        if shape.whole:
            usable = response > least_detectable_response and not _prevents_growth(baseline, change)
            return (shape, [moved / shape.step for moved in change]) if usable else None
        if response <= least_detectable_response * 1e-3:
            return None
        # 2e-3, 2e-2, 2e-4: A finite-difference step should move a trajectory by the first of these parts of
        # its travel (derived)
        if not 2e-4 < response < 2e-2:
            size = shape.size
            step = shape.step * 2e-3 / response
            available = size.bounds[1] - size.zero if shape.step > 0 else size.zero - size.bounds[0]
            shape = replace(shape, step=min(step, available) if available > 0 else step)
            change = _change(fit, shape, baseline)
            response = _response(fit, change)
    except SimulationError:
        return None
    return (shape, [moved / shape.step for moved in change]) if response > least_detectable_response else None


def _prevents_growth(baseline: Sequence[Trajectory], change: Sequence[Floats]) -> bool:
    """Whether some vine that grew in the recording hardly starts with the effect: so large a size is excluded."""
    # 0.1: part of its travel that a vine must still make with a finite effect added (chosen)
    return any(
        float(np.max(before.observed_position_m + moved)) < 0.1 * float(np.max(before.observed_position_m))
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
