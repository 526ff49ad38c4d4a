"""Audit of the terms that a model neglects, along the recorded motion of each trial.

For every effect of the catalogue that is not in the model, the audit computes the force on the tail at the effect's
typical size, relative to the drive ½PA; and the tail's tension. Warnings state which of the paper's rules for
neglecting effects a trial violates: drag above 5 % of the drive, friction along 30 cm and more, bends of 30° and more,
a reservoir whose pressure changes by more than 5 %, compression in the tail.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from vinetrack.core.records import Floats, Trial
from vinetrack.dynamics.model import Model, check_needs, effects_on
from vinetrack.dynamics.simulate import Trace
from vinetrack.effects import HOOKS, Effect, EffectError, State, TrialInputs, catalogue

# ------------------------------------------------------------------------------
# Forces, pressure and masses of a model along a known motion, effect by effect.
#
# The order of physics is that of the compiled kernel (`vinetrack.dynamics.simulate`), with which a test compares it.


@dataclass(frozen=True)
class Terms:
    """Everything that the model computes along a motion; arrays of the motion's shape, SI. `tension_N` is what the
    forces at the tip do to the tail, by 1/r, `total_N` that and the forces on the tail.
    """

    pressure_Pa: Floats
    tension_N: Floats
    total_N: Floats
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
    """Evaluate every effect of the model along a motion since release. All arrays have shape (n,)."""
    check_needs(model, trial)
    hooks = _Hooks(model, trial, measured=measured_Pa is not None)
    rig = hooks.rig
    time, position, velocity = (np.asarray(a, dtype=float) for a in (time_s, lead_position_m, lead_velocity_m_s))
    ones, nothing = np.ones_like(time), np.zeros_like(time)
    angles = (np.clip(position - bend.start_m, 0.0, bend.arc_m) / bend.radius_m for bend in trial.bends)
    fields: dict[str, Any] = {
        **{name: getattr(rig, name) * ones for name in ("set_pressure", "yield_pressure", "area", "linear_density")},
        **{"time": time, "lead_position": position, "lead_velocity": velocity, "observed": position},
        **{"tail_position": rig.travel_ratio * position, "tail_velocity": rig.travel_ratio * velocity},
        **{"pressure": rig.set_pressure * ones, "moving_mass": ones, "damping_gain": ones},
        **{"bend_angle": sum(angles, nothing), "tail_tension": nothing, "pressure_slope": nothing},
    }
    state = State(**fields)
    film = np.prod([ones, *hooks.each("film_gain", state)], axis=0)
    film_mass = film * (rig.linear_density * rig.length - rig.mass_loss * state.tail_position)
    moving_mass = np.maximum(film_mass, rig.least_mass) + rig.payload_mass
    state = state._replace(moving_mass=moving_mass, linear_density=rig.linear_density * film)
    state = hooks.changed("gauge", state)
    state = hooks.changed("yield_gauge", state._replace(set_pressure=state.pressure))
    if measured_Pa is not None:
        measured: Any = np.asarray(measured_Pa, dtype=float)
        slope: Any = np.gradient(measured, time) if time.size > 1 else nothing
        state = hooks.changed("trace_pressure", state._replace(pressure=measured, pressure_slope=slope))
        state = hooks.changed("gauge", state)
    elif hooks.calls.get("chamber_rate"):
        state = state._replace(pressure=_chamber_pressure(hooks, state))
    state = hooks.changed("damping_gain", _with_consistent_area(hooks, state))
    tension = sum(hooks.each("tip_force", state), nothing) / rig.travel_ratio
    tail = sum(hooks.each("tail_force", state), nothing)
    # Everything that moves with the tail. The floor of the film's mass is that of fold and gas, which remain: mass that
    # effects add counts towards it. Mass that they remove is the payload's, not that of film, which goes to zero.
    added = sum(hooks.each("added_mass", state), nothing)
    with_film = np.maximum(film_mass + np.maximum(added, 0.0), rig.least_mass)
    inertia = np.asarray(np.maximum(with_film + np.minimum(added, 0.0) + rig.payload_mass, rig.least_mass))
    return Terms(
        pressure_Pa=np.asarray(state.pressure),
        tension_N=tension,
        total_N=tension + tail,
        acceleration_m_s2=(tension + tail) / inertia,
        inertia_kg=inertia,
        state=state,
    )


class _Hooks:
    """The functions of a model's effects, called with the inputs of one trial and the parameters of its vine."""

    def __init__(self, model: Model, trial: Trial, measured: bool) -> None:
        self.rig = TrialInputs.of(trial)
        theta = model.parameters_of(trial)
        on = effects_on(model, theta[None, :])[0]
        # A measured pressure includes everything that happens in the chamber.
        acts = [bool(on[i]) and not (effect.in_trace and measured) for i, effect in enumerate(model)]
        self.calls = {
            hook: [(function, theta[place].tolist()) for i, function, place in calls if acts[i]]
            for hook, calls in model.hooks.items()
        }

    def changed(self, hook: str, state: State) -> State:
        """The state after all effects in turn, each of which changes the same field."""
        for function, values in self.calls.get(hook, ()):
            state = state._replace(**{str(HOOKS[hook]): function(state, self.rig, *values)})
        return state

    def each(self, hook: str, state: State) -> list[Floats]:
        """The value of each effect by itself."""
        return [
            np.broadcast_to(np.asarray(function(state, self.rig, *values), dtype=float), np.shape(state.time))
            for function, values in self.calls.get(hook, ())
        ]


def _with_consistent_area(hooks: _Hooks, state: State) -> State:
    """Area and pressure at the tip that are consistent with each other, from the pressure in the chamber."""
    start, plain = state.pressure, state.area
    area = plain
    for turn in range(30):
        previous_area, area = area, hooks.changed("area", state._replace(area=plain)).area
        if turn > 0 and np.all(np.abs(area - previous_area) <= 1e-10 * area):
            break
        state = hooks.changed("pressure", state._replace(area=area, pressure=start))
    return state._replace(area=area)


def _chamber_pressure(hooks: _Hooks, state: State) -> Any:
    """Pressure of a chamber with an equation of its own. Exponential integration from point to point with the motion
    frozen half-way, exact to first order in the pressure: it is stable for a supply that is faster than the steps.
    """
    shape = np.shape(state.time)
    fields = [np.broadcast_to(np.asarray(value, dtype=float), shape) for value in state]
    half_way = [0.5 * (values[1:] + values[:-1]) for values in fields]

    def rate(i: int, pressure: float) -> float:
        here = State(*(float(values[i]) for values in half_way))._replace(pressure=pressure)
        here = _with_consistent_area(hooks, here)._replace(pressure=pressure)
        return sum(map(float, hooks.each("chamber_rate", here)))

    pressure = np.empty(shape)
    pressure[0] = float(fields[State._fields.index("set_pressure")][0])
    for i, step in enumerate(np.diff(state.time)):
        current = float(pressure[i])
        change = rate(i, current)
        delta = 1e-6 * (abs(current) + 1e3)
        decay = step * (rate(i, current + delta) - change) / delta
        pressure[i + 1] = current + step * change * (np.expm1(decay) / decay if decay else 1.0)
    return pressure


# Compression of the tail from which a model is in doubt, as a fraction of the drive ½PA (chosen)
DOUBTFUL_COMPRESSION = 0.01

COLUMNS = (
    "trial", "condition", "term", "size", "force_N", "share_of_drive", "shift_m", "time_s", "lead_position_m",
    "y_over_L", "slack_from_s", "note",
)  # fmt: skip


@dataclass(frozen=True)
class AuditedMotion:
    """Motion of one trial since release, measured or simulated; arrays of shape (n,), SI. `pressure_Pa` is the gauge
    pressure measured along with it, where there is one; `by_model` a measured one's as the model has it: along that
    is the tension, since a trial that is faster than its model by scatter would seem to push its tail.
    """

    trial: Trial
    time_s: Floats
    lead_position_m: Floats
    lead_velocity_m_s: Floats
    pressure_Pa: Floats | None = None
    by_model: AuditedMotion | None = None

    def thinned(self) -> AuditedMotion:
        """The same motion at 200 points or fewer."""
        every = slice(None, None, max(1, math.ceil(self.time_s.size / 200)))
        time_s, y, v = (part[every] for part in (self.time_s, self.lead_position_m, self.lead_velocity_m_s))
        return AuditedMotion(self.trial, time_s, y, v, None if self.pressure_Pa is None else self.pressure_Pa[every])

    def terms(self, model: Model) -> Terms:
        """Everything that a model computes along it."""
        motion = self.time_s, self.lead_position_m, self.lead_velocity_m_s
        return evaluate(model, self.trial, *motion, measured_Pa=self.pressure_Pa)

    def drive_N(self) -> Floats:
        """The drive on the tail ½PA (PA/r), shape (n,), with the set pressure unless it was measured."""
        rig = TrialInputs.of(self.trial)
        pressure = rig.set_pressure if self.pressure_Pa is None else self.pressure_Pa
        return np.broadcast_to(np.asarray(pressure * rig.area / rig.travel_ratio, dtype=float), self.time_s.shape)

    def row(self, term: str, i: int | None = None, **values: Any) -> dict[str, Any]:
        """A row of the table about one term, at the point i of the motion."""
        row: dict[str, Any] = dict.fromkeys(COLUMNS, math.nan)
        row |= {"trial": self.trial.name, "condition": self.trial.condition, "term": term, "note": ""}
        if i is not None:
            y = float(self.lead_position_m[i])
            row |= {"time_s": float(self.time_s[i]), "lead_position_m": y, "y_over_L": y / self.trial.length_m}
        return row | values


@dataclass(frozen=True)
class RuleViolation:
    """A rule for neglecting an effect that a trial violates, and how, in words; limits by Alvarez et al. (2025)."""

    trial: str
    rule: str
    words: str


@dataclass(frozen=True)
class Audit:
    """Result of an audit; `table`, columns `COLUMNS`, has a row per trial for each neglected term and the tension."""

    table: pd.DataFrame
    violations: tuple[RuleViolation, ...]

    @property
    def warnings(self) -> tuple[str, ...]:
        """A sentence for each violation."""
        return tuple(f"Trial {violation.trial}: {violation.words}." for violation in self.violations)


def motion_since(
    release_s: float, trial: Trial, time_s: Floats, lead_position_m: Floats, lead_velocity_m_s: Floats,
    trace: Trace | None = None, by_model: AuditedMotion | None = None,
) -> AuditedMotion:  # fmt: skip
    """Motion of one trial from its release on. Shapes: time_s, lead_position_m, lead_velocity_m_s (n,)."""
    moving = (time_s >= release_s) & np.isfinite(lead_position_m) & np.isfinite(lead_velocity_m_s)
    origin_m, since_s = np.interp(release_s, time_s, lead_position_m), time_s[moving] - release_s
    position_m, velocity_m_s = (np.maximum(a[moving], 0.0) for a in (lead_position_m - origin_m, lead_velocity_m_s))
    pressure_Pa = None if trace is None else np.interp(since_s, *trace)
    return AuditedMotion(trial, since_s, position_m, velocity_m_s, pressure_Pa, by_model)


def audit(model: Model, motions: Sequence[AuditedMotion]) -> Audit:
    """Compute what `model` neglects along each motion."""
    replaced = {name for effect in model for name in (effect.name, *effect.replaces)}
    left = [e for e in catalogue().values() if e.kind != "measurement" and e.name not in replaced]
    rows: list[dict[str, Any]] = []
    violations: list[RuleViolation] = []
    for motion, own in ((motion.thinned(), (motion.by_model or motion).thinned()) for motion in motions):
        terms = motion.terms(model)
        # A pressure measured during growth includes what happens in the chamber.
        neglected = [effect for effect in left if not (effect.in_trace and motion.pressure_Pa is not None)]
        left_out = [_neglected_row(model, effect, motion, terms) for effect in neglected]
        tension_N, drive_N = own.terms(model).tension_N, own.drive_N()
        i = int(np.argmin(tension_N))
        share = float(tension_N[i]) / float(drive_N[i]) if drive_N[i] > 0 else math.nan
        negative = np.flatnonzero(tension_N < -1e-6 * drive_N)  # 1e-6: beyond the rounding of a simulation
        slack_from_s = float(own.time_s[negative[0]]) if negative.size else math.nan
        least: dict[str, Any] = {"force_N": float(tension_N[i]), "share_of_drive": share, "slack_from_s": slack_from_s}
        tension = own.row("tail_tension", i, **least)
        rows += [*left_out, tension]
        violated = _violated_rules(model, motion, {row["term"]: row for row in left_out}, tension)
        violations += [RuleViolation(motion.trial.name, rule, words) for rule, words in violated]
    return Audit(pd.DataFrame(rows, columns=list(COLUMNS)), tuple(violations))


def _neglected_row(model: Model, effect: Effect, motion: AuditedMotion, without: Terms) -> dict[str, Any]:
    """The change by one effect: the sum of forces on the tail, minus the inertia of mass that it adds."""
    size = ", ".join(parameter.words(parameter.default) for parameter in effect.parameters)
    try:
        terms = motion.terms(model + effect)
    except EffectError as error:
        return motion.row(effect.name, size=size, note=str(error))
    if set(effect.functions) == {"observed_position"}:
        # It changes nothing but the reported position.
        state = without.state._replace(tail_tension=np.maximum(without.tension_N, 0.0))  # type: ignore[arg-type]
        sizes = (parameter.default for parameter in effect.parameters)
        seen = effect.functions["observed_position"](state, TrialInputs.of(motion.trial), *sizes)
        shift = np.asarray(seen, dtype=float) - motion.lead_position_m
        i = int(np.argmax(np.abs(shift)))
        return motion.row(effect.name, i, size=size, shift_m=float(shift[i]))
    if set(effect.functions) == {"rest_force"}:
        return motion.row(effect.name, size=size, note="acts on a vine at rest only")
    force = terms.total_N - without.total_N - (terms.inertia_kg - without.inertia_kg) * without.acceleration_m_s2
    drive = motion.drive_N()
    share = np.divide(force, drive, out=np.zeros_like(force), where=drive > 0)
    i = int(np.argmax(np.abs(share if np.any(drive > 0) else force)))
    return motion.row(effect.name, i, size=size, force_N=float(force[i]), share_of_drive=float(share[i]))


def _violated_rules(
    model: Model, motion: AuditedMotion, neglected: Mapping[str, dict[str, Any]], tension: dict[str, Any]
) -> Iterator[tuple[str, str]]:
    """Each rule that the trial violates, and how, in words."""
    trial = motion.trial
    drag = neglected.get("air_drag")
    if drag and (share := abs(drag["share_of_drive"])) > 0.05:
        where = f"at y/L = {drag['y_over_L']:.2f} ({drag['size']})"
        yield "drag", f"air drag is {share:.1%} of the drive {where}, above 5%; add air_drag to the model"
    if "tail_friction" in neglected and trial.length_m >= 0.30:
        yield (
            "length",
            f"friction along the length is neglected in a vine of {100 * trial.length_m:.0f} cm, which is safe below "
            "30 cm; add tail_friction to the model",
        )
    bent_deg = math.degrees(sum(bend.arc_m / bend.radius_m for bend in trial.bends))
    if "capstan_friction" in neglected and bent_deg >= 30:
        safe = "which is safe to neglect below 30°"
        yield "bends", f"the path bends by {bent_deg:.0f}° in all, {safe}; add capstan_friction to the model"
    # The reservoir's rule, by the gas law in absolute pressure, for slow and for fast expansion
    reservoir, pressure = neglected.get("reservoir_depletion"), trial.pressure_Pa
    if reservoir is not None and not reservoir["note"] and pressure > 0:
        depleted = model + catalogue()["reservoir_depletion"]
        models = (depleted.with_values({"reservoir_depletion.gamma": gamma}) for gamma in (1.0, 1.4))
        slow, fast = (1 - float(np.min(motion.terms(each).pressure_Pa)) / pressure for each in models)
        if fast > 0.05:
            yield (
                "reservoir",
                f"the reservoir of {1e3 * trial.chamber_m3:.3g} L loses {slow:.0%} (slow) to {fast:.0%} (fast) of its "
                "gauge pressure while the vine grows, above 5%, unless a supply refills it or a "
                "diagnosis excludes it; add reservoir_depletion or supply_refill to the model, or measure the pressure",
            )
    if tension["share_of_drive"] < -DOUBTFUL_COMPRESSION and trial.tail_slack != "free":
        yield (
            "tension",
            f"the model predicts compression in the tail from {1e3 * tension['slack_from_s']:.0f} ms on (tension down "
            f"to {tension['force_N']:.2f} N); `tail_slack: free` lets it go slack",
        )
