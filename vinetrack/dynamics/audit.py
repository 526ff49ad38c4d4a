"""Audit of the terms that a model neglects, along the recorded motion of each trial.

For every effect of the catalogue that is not in the model, the audit computes the force on the tail at the effect's
typical size, relative to the drive ½PA; and the tail's tension. Warnings state which of the paper's rules for
neglecting effects a trial violates: drag above 5 % of the drive, friction along 30 cm and more, bends of 30° and more,
a reservoir whose pressure changes by more than 5 %, compression in the tail.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from scipy.integrate import cumulative_trapezoid

from vinetrack.core.records import Floats, Kinematics, Trial
from vinetrack.dynamics.kernel import Trace
from vinetrack.dynamics.model import Model, check_needs, effects_on, trial_inputs
from vinetrack.effects import Effect, EffectError, State, TrialInputs, catalogue

# ------------------------------------------------------------------------------
# Forces, pressure and masses of a model along a known motion, effect by effect.
#
# The same order of physics as in the compiled kernel (`vinetrack.dynamics.kernel`), in plain Python on arrays; a test
# compares the two.


@dataclass(frozen=True)
class Terms:
    """Everything that the model computes along a motion; arrays of the motion's shape, SI. `tip_N` and `tail_N` are the
    forces by effect: those at the tip act on the tail by 1/r, those on the tail in full.
    """

    pressure_Pa: Floats
    area_m2: Floats
    mass_kg: Floats
    tip_N: Mapping[str, Floats]
    tail_N: Mapping[str, Floats]
    tension_N: Floats
    acceleration_m_s2: Floats
    inertia_kg: Floats
    state: State


def evaluate(
    model: Model,
    trial: Trial,
    time_s: Floats,
    lead_position_m: Floats,
    lead_velocity_m_s: Floats,
    *,
    measured_Pa: Floats | None = None,
) -> Terms:
    """Evaluate every effect of the model along a motion since release. Shapes: time_s, lead_position_m,
    lead_velocity_m_s, measured_Pa (n,).
    """
    check_needs(model, trial)
    rig = trial_inputs(trial)
    hooks = _HookCaller(model, trial)
    motion = [np.asarray(a, dtype=float) for a in (time_s, lead_position_m, lead_velocity_m_s)]
    state = _initial_state(trial, rig, *motion)
    hooks.measured = measured_Pa is not None
    film = np.prod([np.ones_like(motion[0]), *hooks.each("film_gain", state, rig).values()], axis=0)
    film_mass = film * (rig.linear_density * rig.length - rig.mass_loss * state.tail_position)
    moving_mass = np.maximum(film_mass, rig.least_mass) + rig.payload_mass
    state = state._replace(moving_mass=moving_mass, linear_density=rig.linear_density * film)
    state = _with_pressure(hooks, state, rig, measured_Pa)
    state = state._replace(damping_gain=hooks("damping_gain", state, rig, state.damping_gain, "damping_gain"))
    tip, tail = hooks.each("tip_force", state, rig), hooks.each("tail_force", state, rig)
    tip_sum = sum(tip.values(), np.zeros_like(motion[0]))
    added = sum(hooks.each("added_mass", state, rig).values(), np.zeros_like(motion[0]))
    inertia = inertia_kg(film_mass, added, rig)
    tail_sum = sum(tail.values(), np.zeros_like(motion[0]))
    tension = tip_sum / rig.travel_ratio
    return Terms(
        pressure_Pa=np.asarray(state.pressure),
        area_m2=np.asarray(state.area),
        mass_kg=np.asarray(state.moving_mass),
        tip_N=tip,
        tail_N=tail,
        tension_N=tension,
        acceleration_m_s2=(tension + tail_sum) / inertia,
        inertia_kg=np.asarray(inertia),
        state=state,
    )


def inertia_kg(film_mass: Floats, added_mass: Floats, rig: TrialInputs) -> Floats:
    """Everything that moves with the tail. The floor of the film's mass is that of fold and gas: mass that effects add
    to the tail counts towards it. Mass that they remove is that of the payload, not film, which goes to zero during
    growth; fold and gas remain. Shapes: film_mass, added_mass (n,) → (n,).
    """
    tail = np.maximum(film_mass + np.maximum(added_mass, 0.0), rig.least_mass)
    return np.asarray(np.maximum(tail + np.minimum(added_mass, 0.0) + rig.payload_mass, rig.least_mass))


class _HookCaller:
    """Calls the hooks of a model's effects with the parameters of one trial's vine."""

    def __init__(self, model: Model, trial: Trial) -> None:
        theta = model.parameters_of(trial)
        values = iter(theta.tolist())
        self.arguments = {effect.name: [next(values) for _ in effect.parameters] for effect in model.effects}
        acting = effects_on(model, theta[None, :])[0]
        effects = [effect for effect, acts in zip(model.effects, acting, strict=True) if acts]
        self.effects = sorted(effects, key=lambda effect: effect.order)
        self.measured = False

    def _functions_of(self, hook: str) -> list[tuple[Effect, Callable[..., Any]]]:
        return [
            (effect, effect.functions[hook])
            for effect in self.effects
            if hook in effect.functions and not (effect.in_trace and self.measured)
        ]

    def has(self, hook: str) -> bool:
        return bool(self._functions_of(hook))

    def __call__(self, hook: str, state: State, rig: TrialInputs, value: Floats | float, name: str) -> Any:
        """The value after all effects in turn; each gets the previous value in the field `name` of the state."""
        for effect, function in self._functions_of(hook):
            value = function(state, rig, *self.arguments[effect.name])
            if name:
                changed: dict[str, Any] = {name: value}
                state = state._replace(**changed)
        return value

    def each(self, hook: str, state: State, rig: TrialInputs) -> dict[str, Floats]:
        """The value of each effect by itself."""
        return {
            effect.name: np.broadcast_to(
                np.asarray(function(state, rig, *self.arguments[effect.name]), dtype=float), np.shape(state.time)
            )
            for effect, function in self._functions_of(hook)
        }


def _initial_state(trial: Trial, rig: TrialInputs, time: Floats, position: Floats, velocity: Floats) -> State:
    ones = np.ones_like(time)
    angle = sum(
        (np.clip(position - bend.start_m, 0.0, bend.arc_m) / bend.radius_m for bend in trial.bends), np.zeros_like(time)
    )
    fields: dict[str, Any] = {
        "time": time,
        "lead_position": position,
        "lead_velocity": velocity,
        "tail_position": rig.travel_ratio * position,
        "tail_velocity": rig.travel_ratio * velocity,
        "set_pressure": rig.set_pressure * ones,
        "pressure": rig.set_pressure * ones,
        "yield_pressure": rig.yield_pressure * ones,
        "area": rig.area * ones,
        "linear_density": rig.linear_density * ones,
        "moving_mass": ones,
        "damping_gain": ones,
        "bend_angle": angle,
        "tail_tension": np.zeros_like(time),
        "observed": position,
    }
    return State(**fields)


def _with_pressure(hooks: _HookCaller, state: State, rig: TrialInputs, measured_Pa: Floats | None) -> State:
    """Gauge, chamber, area and losses, in the order of the physics."""
    set_pressure = hooks("gauge", state, rig, state.pressure, "pressure")
    state = state._replace(set_pressure=set_pressure, pressure=set_pressure)
    state = state._replace(yield_pressure=hooks("yield_gauge", state, rig, state.yield_pressure, "yield_pressure"))
    if measured_Pa is not None:
        measured: Any = np.asarray(measured_Pa, dtype=float)
        state = state._replace(pressure=measured)
        state = state._replace(pressure=hooks("gauge", state, rig, state.pressure, "pressure"))
    elif hooks.has("chamber_rate"):
        state = state._replace(pressure=_chamber_pressure(hooks, state, rig))
    return _with_consistent_area(hooks, state, rig)


def _with_consistent_area(hooks: _HookCaller, state: State, rig: TrialInputs) -> State:
    """Area and pressure at the tip that are consistent with each other, from the pressure in the chamber."""
    start, plain = state.pressure, state.area
    area = plain
    for turn in range(30):
        previous_area, area = area, hooks("area", state._replace(area=plain), rig, plain, "area")
        if turn > 0 and np.all(np.abs(area - previous_area) <= 1e-10 * area):
            break
        state = state._replace(area=area, pressure=start)
        state = state._replace(pressure=hooks("pressure", state, rig, start, "pressure"))
    return state._replace(area=area)


def _chamber_pressure(hooks: _HookCaller, state: State, rig: TrialInputs) -> Any:
    """Pressure of a chamber with an equation of its own. Exponential integration from point to point with the motion
    frozen half-way, exact to first order in the pressure: it is stable for a supply that is faster than the steps.
    """
    shape = np.shape(state.time)
    fields = [np.broadcast_to(np.asarray(value, dtype=float), shape) for value in state]
    half_way = [0.5 * (values[1:] + values[:-1]) for values in fields]

    def rate(i: int, pressure: float) -> float:
        state_here = State(*(float(values[i]) for values in half_way))._replace(pressure=pressure)
        state_here = _with_consistent_area(hooks, state_here, rig)._replace(pressure=pressure)
        return sum(float(value) for value in hooks.each("chamber_rate", state_here, rig).values())

    pressure = np.empty(shape)
    pressure[0] = float(fields[State._fields.index("set_pressure")][0])
    for i, step in enumerate(np.diff(state.time)):
        current = float(pressure[i])
        change = rate(i, current)
        delta = 1e-6 * (abs(current) + 1e3)
        decay = step * (rate(i, current + delta) - change) / delta
        pressure[i + 1] = current + step * change * (np.expm1(decay) / decay if decay else 1.0)
    return pressure


def pressure_along(
    model: Model, trial: Trial, time_s: Floats, lead_position_m: Floats, lead_velocity_m_s: Floats
) -> Floats:
    """Gauge pressure that drove a measured motion according to a model. Shape (n,)."""
    return evaluate(model, trial, time_s, lead_position_m, lead_velocity_m_s).pressure_Pa


NEGLIGIBLE_BEND_RAD = math.radians(30)
DRAG_SHARE, PRESSURE_SHARE, NEGLIGIBLE_LENGTH_M = 0.05, 0.05, 0.30  # Published: the rules by which Alvarez et al.

# The rules that a trial may violate, see `RuleViolation`
DRAG_RULE, LENGTH_RULE, BEND_RULE, RESERVOIR_RULE, TENSION_RULE = "drag", "length", "bends", "reservoir", "tension"

TENSION = "tail_tension"
COLUMNS = (
    "trial",
    "condition",
    "term",
    "size",
    "force_N",
    "share_of_drive",
    "shift_m",
    "time_s",
    "lead_position_m",
    "y_over_L",
    "slack_from_s",
    "note",
)


@dataclass(frozen=True)
class AuditedMotion:
    """Motion of one trial since release, measured or simulated; arrays of shape (n,), SI. `pressure_Pa` is the gauge
    pressure measured along with it, where there is one.
    """

    trial: Trial
    time_s: Floats
    lead_position_m: Floats
    lead_velocity_m_s: Floats
    pressure_Pa: Floats | None = None

    def thinned(self, most: int = 200) -> AuditedMotion:
        """The same motion at fewer points."""
        every = slice(None, None, max(1, math.ceil(self.time_s.size / most)))
        pressure = None if self.pressure_Pa is None else self.pressure_Pa[every]
        return AuditedMotion(
            self.trial, self.time_s[every], self.lead_position_m[every], self.lead_velocity_m_s[every], pressure
        )


@dataclass(frozen=True)
class RuleViolation:
    """A rule for neglecting an effect that a trial violates, such as `DRAG_RULE`, and how it does, in words."""

    trial: str
    rule: str
    words: str

    @property
    def sentence(self) -> str:
        """The violation as a sentence that names the trial."""
        return f"Trial {self.trial}: {self.words}."


@dataclass(frozen=True)
class Audit:
    """Result of an audit: a table of neglected terms and tensions by trial, and warnings. `table`, columns `COLUMNS`,
    has a row per trial for each neglected term and one for the tension.
    """

    table: pd.DataFrame
    violations: tuple[RuleViolation, ...]

    @property
    def warnings(self) -> tuple[str, ...]:
        """A sentence for each violation."""
        return tuple(violation.sentence for violation in self.violations)


def measured_motion(
    trial: Trial, kinematics: Kinematics, release_s: float, trace: Trace | None = None
) -> AuditedMotion:
    """Motion of a trial as recorded, from its release on."""
    k = kinematics
    moving = (k.time_s >= release_s) & np.isfinite(k.lead_position_m) & np.isfinite(k.lead_velocity_m_s)
    origin_m = np.interp(release_s, k.time_s, k.lead_position_m)
    time_s = k.time_s[moving] - release_s
    pressure = None if trace is None else np.interp(time_s, *trace)
    position_m = np.maximum(k.lead_position_m[moving] - origin_m, 0.0)
    return AuditedMotion(trial, time_s, position_m, np.maximum(k.lead_velocity_m_s[moving], 0.0), pressure)


def audit(model: Model, motions: Sequence[AuditedMotion], effects: Iterable[Effect] | None = None) -> Audit:
    """Compute what `model` neglects along each motion."""
    candidates = list(catalogue().values()) if effects is None else list(effects)
    rows: list[dict[str, Any]] = []
    violations: list[RuleViolation] = []
    for motion in (motion.thinned() for motion in motions):
        terms = _terms_along(model, motion)
        neglected = [e for e in candidates if e.kind != "measurement" and not _in_model(e, model, motion)]
        left_out = [_neglected_row(model, effect, motion, terms) for effect in neglected]
        tension = _tension_row(motion, terms)
        rows += [*left_out, tension]
        violations += [
            RuleViolation(motion.trial.name, rule, words)
            for rule, words in _violated_rules(model, motion, left_out, tension)
        ]
    return Audit(pd.DataFrame(rows, columns=list(COLUMNS)), tuple(violations))


def _terms_along(model: Model, motion: AuditedMotion) -> Terms:
    return evaluate(
        model,
        motion.trial,
        motion.time_s,
        motion.lead_position_m,
        motion.lead_velocity_m_s,
        measured_Pa=motion.pressure_Pa,
    )


def _in_model(effect: Effect, model: Model, motion: AuditedMotion) -> bool:
    """Whether the model, or a pressure measured during growth, includes an effect."""
    if effect.name in model or (effect.in_trace and motion.pressure_Pa is not None):
        return True
    return any(effect.name in other.replaces for other in model)


def _drive_N(motion: AuditedMotion) -> Floats:
    """The drive on the tail ½PA (PA/r), shape (n,), with the set pressure unless it was measured."""
    rig = trial_inputs(motion.trial)
    pressure = rig.set_pressure if motion.pressure_Pa is None else motion.pressure_Pa
    return np.broadcast_to(np.asarray(pressure * rig.area / rig.travel_ratio, dtype=float), motion.time_s.shape)


def _place_of(motion: AuditedMotion, i: int) -> dict[str, float]:
    y = float(motion.lead_position_m[i])
    length = motion.trial.length_m
    share = y / length if math.isfinite(length) and length > 0 else math.nan
    return {"time_s": float(motion.time_s[i]), "lead_position_m": y, "y_over_L": share}


def _row(motion: AuditedMotion, term: str) -> dict[str, Any]:
    blank: dict[str, Any] = dict.fromkeys(COLUMNS, math.nan)
    return {**blank, "trial": motion.trial.name, "condition": motion.trial.condition, "term": term, "note": ""}


def _neglected_row(model: Model, effect: Effect, motion: AuditedMotion, without: Terms) -> dict[str, Any]:
    """The change by one effect: the sum of forces on the tail, minus the inertia of mass that it adds."""
    row = _row(motion, effect.name)
    row["size"] = ", ".join(
        f"{p.symbol} = {p.default:g}{'' if p.unit == '1' else ' ' + p.unit}" for p in effect.parameters
    )
    try:
        terms = _terms_along(model + effect, motion)
    except EffectError as error:
        return {**row, "note": str(error)}
    if not set(effect.functions) - {"observed_position", "row_delay", "averaged_over"}:
        return {**row, **_largest_shift(effect, motion, without)}
    if not set(effect.functions) - {"rest_force"}:
        return {**row, "note": "acts on a vine at rest only"}
    force = _total_N(terms) - _total_N(without) - (terms.inertia_kg - without.inertia_kg) * without.acceleration_m_s2
    drive = _drive_N(motion)
    share = np.divide(force, drive, out=np.zeros_like(force), where=drive > 0)
    i = int(np.argmax(np.abs(share if np.any(drive > 0) else force)))
    return {**row, "force_N": float(force[i]), "share_of_drive": float(share[i]), **_place_of(motion, i)}


def _total_N(terms: Terms) -> Floats:
    """Total force on the tail, N."""
    return terms.tension_N + sum(terms.tail_N.values(), np.zeros_like(terms.tension_N))


def _largest_shift(effect: Effect, motion: AuditedMotion, terms: Terms) -> dict[str, float]:
    """Largest displacement by an effect that only changes the reported position, relative to release."""
    rig = trial_inputs(motion.trial)
    state = terms.state._replace(tail_tension=np.maximum(terms.tension_N, 0.0))  # type: ignore[arg-type]
    sizes = [parameter.default for parameter in effect.parameters]
    if "row_delay" in effect.functions:
        late_s = effect.functions["row_delay"](state, rig, *sizes) * motion.lead_position_m
        shift = np.interp(motion.time_s + late_s, motion.time_s, motion.lead_position_m) - motion.lead_position_m
    elif "averaged_over" in effect.functions:
        shift = _time_average(motion, math.sqrt(effect.functions["averaged_over"](state, rig, *sizes)))
        shift -= motion.lead_position_m
    else:
        shift = np.asarray(effect.functions["observed_position"](state, rig, *sizes), float) - motion.lead_position_m
    i = int(np.argmax(np.abs(shift)))
    return {"shift_m": float(shift[i]), **_place_of(motion, i)}


def _time_average(motion: AuditedMotion, over_s: float) -> Floats:
    """Positions averaged over a time, m; the edge is at rest before the first and after the last."""
    area = cumulative_trapezoid(motion.lead_position_m, motion.time_s, initial=0.0)
    time_s = np.concatenate([[motion.time_s[0] - over_s], motion.time_s, [motion.time_s[-1] + over_s]])
    ends = over_s * motion.lead_position_m[[0, -1]]
    area = np.concatenate([[-ends[0]], area, [area[-1] + ends[1]]])
    halves = [np.interp(motion.time_s + side * over_s / 2, time_s, area) for side in (1, -1)]
    return np.asarray((halves[0] - halves[1]) / over_s)


def _tension_row(motion: AuditedMotion, terms: Terms) -> dict[str, Any]:
    tension = terms.tension_N
    i = int(np.argmin(tension))
    drive = float(_drive_N(motion)[i])
    negative = np.flatnonzero(tension < 0)
    return {
        **_row(motion, TENSION),
        "force_N": float(tension[i]),
        "share_of_drive": float(tension[i]) / drive if drive > 0 else math.nan,
        **_place_of(motion, i),
        "slack_from_s": float(motion.time_s[negative[0]]) if negative.size else math.nan,
    }


def _violated_rules(
    model: Model, motion: AuditedMotion, rows: Sequence[dict[str, Any]], tension: dict[str, Any]
) -> Iterator[tuple[str, str]]:
    """Each rule that the trial violates, and how, in words."""
    trial = motion.trial
    neglected = {row["term"]: row for row in rows}
    drag = neglected.get("air_drag")
    if drag and abs(drag["share_of_drive"]) > DRAG_SHARE:
        yield (
            DRAG_RULE,
            f"air drag is {abs(drag['share_of_drive']):.1%} of the drive at y/L = {drag['y_over_L']:.2f} "
            f"({drag['size']}), above {DRAG_SHARE:.0%}; add air_drag to the model",
        )
    if "tail_friction" in neglected and trial.length_m >= NEGLIGIBLE_LENGTH_M:
        yield (
            LENGTH_RULE,
            f"friction along the length is neglected in a vine of {100 * trial.length_m:.0f} cm, which is safe below "
            f"{100 * NEGLIGIBLE_LENGTH_M:.0f} cm; add tail_friction to the model",
        )
    bent = sum(bend.arc_m / bend.radius_m for bend in trial.bends)
    if "capstan_friction" in neglected and bent >= NEGLIGIBLE_BEND_RAD:
        yield (
            BEND_RULE,
            f"the path bends by {math.degrees(bent):.0f}° in all, which is safe to neglect below "
            f"{math.degrees(NEGLIGIBLE_BEND_RAD):.0f}°; add capstan_friction to the model",
        )
    yield from _reservoir_rule(model, motion, neglected)
    if math.isfinite(tension["slack_from_s"]) and trial.tail_slack != "free":
        yield (
            TENSION_RULE,
            f"the model predicts compression in the tail from {1e3 * tension['slack_from_s']:.0f} ms on (tension down "
            f"to {tension['force_N']:.2f} N); `tail_slack: free` lets it go slack",
        )


def _reservoir_rule(
    model: Model, motion: AuditedMotion, neglected: dict[str, dict[str, Any]]
) -> Iterator[tuple[str, str]]:
    """The reservoir's rule, by the gas law in absolute pressure, for slow and for fast expansion."""
    row = neglected.get("reservoir_depletion")
    pressure = motion.trial.pressure_Pa
    if row is None or row["note"] or not pressure > 0:
        return
    effect = catalogue()["reservoir_depletion"]
    shares = []
    for gamma in (1.0, 1.4):
        lowest_Pa = _terms_along((model + effect).with_values({"reservoir_depletion.gamma": gamma}), motion).pressure_Pa
        shares.append(1 - float(np.min(lowest_Pa)) / pressure)
    if shares[1] > PRESSURE_SHARE:
        yield (
            RESERVOIR_RULE,
            f"the reservoir of {1e3 * motion.trial.chamber_m3:.3g} L loses {shares[0]:.0%} (slow) to {shares[1]:.0%} "
            f"(fast) of its gauge pressure while the vine grows, above {PRESSURE_SHARE:.0%}, unless a supply refills "
            "it; add reservoir_depletion or supply_refill to the model, or measure the pressure",
        )
