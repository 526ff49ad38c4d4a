"""Forces, pressure and masses of a model along a known motion, effect by effect.

The same order of physics as in the compiled kernel (`vinetrack.dynamics.kernel`), in plain Python on arrays; a test
compares the two.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from vinetrack.core.records import Floats, Trial
from vinetrack.dynamics.model import Model, effects_on
from vinetrack.dynamics.trial_inputs import check_needs, trial_inputs
from vinetrack.effects import Effect, State, TrialInputs


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
