"""The trajectory that a model gives for a trial."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vinetrack.constants import GAS_CONSTANT_AIR_J_KG_K, TEMPERATURE_K
from vinetrack.effects import Effect, EffectError, Rig, State
from vinetrack.model.kernel import kernel
from vinetrack.model.model import Model
from vinetrack.records import Floats, Trial

RELATIVE_TOLERANCE = 1e-4
"""Local tolerance on the speed. Hairer's estimate is of order 3, the method of order 5: positions come out good to 10⁻⁶
of the distance travelled on every trial of the paper's protocol (`benchmarks/integrator.py` measures it)."""

STATUS = ("running", "ended", "stalled", "too hard")

Trace = tuple[Floats, Floats]
"""Times since release, s, and gauge pressures, Pa, measured there."""


@dataclass(frozen=True)
class Trajectory:
    """Motion of one trial since release; arrays have shape (n_times,), SI.

    `status` is `ended` where all film was everted before the last time asked for, `stalled` where it stopped for good
    before, else `running`. `end_time_s` is when growth ended (or last stalled), NaN if it did not.
    """

    time_s: Floats
    lead_position_m: Floats
    lead_velocity_m_s: Floats
    lead_acceleration_m_s2: Floats
    travel_ratio: float
    status: str
    end_time_s: float
    end_lead_velocity_m_s: float
    n_steps: int

    @property
    def tail_velocity_m_s(self) -> Floats:
        """Speed of the tail, shape (n_times,)."""
        return self.travel_ratio * self.lead_velocity_m_s


class SimulationError(RuntimeError):
    """A trajectory could not be followed; the message names the trial."""


def rig_of(trial: Trial) -> Rig:
    """What the effects see of a trial, in SI."""
    whole_body = trial.travel_ratio == 1
    length = trial.length_m if math.isfinite(trial.length_m) else 0.0
    area = trial.area_m2 if math.isfinite(trial.diameter_m) else 0.0
    linear_density = trial.linear_density_kg_m
    pressure = 0.0 if whole_body and not math.isfinite(trial.pressure_Pa) else trial.pressure_Pa
    yield_pressure = 0.0 if whole_body and not math.isfinite(trial.yield_pressure_Pa) else trial.yield_pressure_Pa
    gas_density = (pressure + trial.ambient_pressure_Pa) / (GAS_CONSTANT_AIR_J_KG_K * TEMPERATURE_K)
    fold = 0.0 if linear_density == 0 else linear_density * math.pi * trial.thickness_m
    return Rig(
        set_pressure=pressure,
        yield_pressure=yield_pressure,
        diameter=trial.diameter_m,
        thickness=trial.thickness_m,
        length=length,
        area=area,
        linear_density=linear_density,
        mass_loss=trial.mass_loss_kg_m if linear_density else 0.0,
        payload_mass=trial.payload_kg,
        cos_angle=math.cos(trial.growth_angle_rad),
        travel_ratio=trial.travel_ratio,
        ambient_pressure=trial.ambient_pressure_Pa,
        chamber_volume=trial.chamber_m3,
        inlet_area=math.pi * trial.inlet_m**2 / 4,
        least_mass=fold + gas_density * area * length / trial.travel_ratio**2,
    )


_COLUMN_OF_FIELD = {"chamber_l": "chamber_m3", "yield_pressure_kPa": "yield_pressure_Pa", "inlet_mm": "inlet_m"}


def check_needs(model: Model, trial: Trial) -> None:
    """Refuse a trial that lacks what an effect of the model needs.

    Raises
    ------
    EffectError
        Naming the effect, the column and the trial.
    """
    for effect in model.effects:
        for column in effect.needs:
            attribute = _COLUMN_OF_FIELD.get(column, column)
            value = getattr(trial, attribute, math.nan)
            if isinstance(value, float) and not math.isfinite(value) and trial.travel_ratio != 1:
                raise EffectError(f"Trial {trial.name}: the effect {effect.name} needs `{column}`, which is blank.")


def simulate(
    model: Model,
    trial: Trial,
    times_s: Floats,
    *,
    trace: Trace | None = None,
    relative_tolerance: float = RELATIVE_TOLERANCE,
) -> Trajectory:
    """Follow one trial from rest at release.

    Parameters
    ----------
    times_s : array, shape (n_times,), s since release, increasing; before 0 the vine is at rest
    trace : measured gauge pressure, which then takes the place of the set pressure and of what happens in the chamber

    Raises
    ------
    EffectError
        If the trial lacks what an effect needs.
    SimulationError
        If the integration does not get through.
    """
    return simulate_many(model, [trial], [times_s], traces=[trace], relative_tolerance=relative_tolerance)[0]


def simulate_many(
    model: Model,
    trials: Sequence[Trial],
    times_s: Sequence[Floats],
    *,
    traces: Sequence[Trace | None] | None = None,
    parameters: Floats | None = None,
    relative_tolerance: float = RELATIVE_TOLERANCE,
) -> list[Trajectory]:
    """`simulate` for many trials in one call of the compiled kernel.

    `parameters`, shape (n_trials, n_parameters) in the order of `model.parameter_names`, gives every trial values of
    its own in place of the model's.
    """
    traces = traces or [None] * len(trials)
    for trial in trials:
        check_needs(model, trial)
    rigs = np.array([rig_of(trial) for trial in trials], dtype=float).reshape(len(trials), len(Rig._fields))
    if parameters is None:
        parameters = np.array([model.parameters_for(trial.vine) for trial in trials])
    thetas = np.ascontiguousarray(parameters, dtype=float).reshape(len(trials), len(model.parameter_names))
    starts = np.concatenate([[0], np.cumsum([len(times) for times in times_s])]).astype(np.int64)
    trace_starts = np.concatenate([[0], np.cumsum([0 if t is None else len(t[0]) for t in traces])]).astype(np.int64)
    given = [trace for trace in traces if trace is not None]
    trace_time = np.concatenate([np.asarray(t, float) for t, _ in given]) if given else np.empty(0)
    trace_pressure = np.concatenate([np.asarray(p, float) for _, p in given]) if given else np.empty(0)
    limits = np.array([_limits(Rig(*rig)) for rig in rigs]).reshape(-1, 2)
    times = np.concatenate([np.asarray(t, float) for t in times_s]) if len(times_s) else np.empty(0)
    out, ends = np.empty((times.size, 3)), np.empty((len(trials), 4))
    on = np.ones(len(model.effects), dtype=bool)
    kernel(model.effects).integrate_many(
        starts,
        times,
        on,
        rigs,
        thetas,
        trace_starts,
        trace_time,
        trace_pressure,
        *limits.T.copy(),
        relative_tolerance,
        out,
        ends,
    )
    return [
        _trajectory(trials[i], times[a:b], out[a:b], ends[i])
        for i, (a, b) in enumerate(zip(starts, starts[1:], strict=False))
    ]


def _limits(rig: Rig) -> tuple[float, float]:
    """Tail travel at which the film's mass reaches its floor, and at which growth ends, m; infinite where there is none."""
    end = rig.length * rig.travel_ratio or math.inf
    floor = (rig.linear_density * rig.length - rig.least_mass) / rig.mass_loss if rig.mass_loss > 0 else math.inf
    return max(floor, 0.0), end


def _trajectory(trial: Trial, times_s: Floats, out: Floats, end: Floats) -> Trajectory:
    status = STATUS[int(end[0])]
    if status == "too hard":
        raise SimulationError(f"Trial {trial.name}: the model could not be integrated beyond {end[1]:.6g} s.")
    r = trial.travel_ratio
    return Trajectory(
        time_s=times_s,
        lead_position_m=out[:, 0] / r,
        lead_velocity_m_s=out[:, 1] / r,
        lead_acceleration_m_s2=out[:, 2] / r,
        travel_ratio=r,
        status=status,
        end_time_s=float(end[1]),
        end_lead_velocity_m_s=float(end[2]) / r,
        n_steps=int(end[3]),
    )


def pressure_along(
    model: Model, trial: Trial, time_s: Floats, lead_position_m: Floats, lead_velocity_m_s: Floats
) -> Floats:
    """Gauge pressure that a model says drove a motion that was measured, Pa, shape as given.

    Time and position run from release. Nothing is integrated: the effects on the pressure are asked one after the
    other.

    Raises
    ------
    EffectError
        If the trial lacks what an effect needs.
    """
    check_needs(model, trial)
    rig = rig_of(trial)
    theta = dict(zip(model.parameter_names, model.parameters_for(trial.vine), strict=True))
    pressure = np.full(np.shape(lead_position_m), rig.set_pressure)
    for effect in model.effects:
        function = effect.functions.get("pressure")
        if function is not None:
            arguments = [theta[f"{effect.name}.{parameter.name}"] for parameter in effect.parameters]
            pressure = function(
                _state(trial, rig, time_s, lead_position_m, lead_velocity_m_s, pressure), rig, *arguments
            )
    return np.asarray(pressure, dtype=float)


def _state(trial: Trial, rig: Rig, time_s: Floats, position: Floats, velocity: Floats, pressure: Floats) -> State:
    return State(
        time=time_s,  # type: ignore[arg-type]
        lead_position=position,  # type: ignore[arg-type]
        lead_velocity=velocity,  # type: ignore[arg-type]
        tail_position=rig.travel_ratio * position,  # type: ignore[arg-type]
        tail_velocity=rig.travel_ratio * velocity,  # type: ignore[arg-type]
        pressure=pressure,  # type: ignore[arg-type]
        area=rig.area,
        moving_mass=trial.moving_mass_kg(position),  # type: ignore[arg-type]
        damping_gain=1.0,
    )


__all__ = [
    "Effect",
    "SimulationError",
    "Trajectory",
    "check_needs",
    "pressure_along",
    "rig_of",
    "simulate",
    "simulate_many",
]
