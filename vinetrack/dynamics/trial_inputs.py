"""The inputs of effects that are constant for a trial, as SI numbers."""

from __future__ import annotations

import math

import numpy as np

from vinetrack.core.constants import GAS_CONSTANT_AIR_J_KG_K, TEMPERATURE_K
from vinetrack.core.records import Floats, Trial
from vinetrack.dynamics.model import Model
from vinetrack.effects import EffectError, TrialInputs
from vinetrack.experiment.schema import COLUMNS


def trial_inputs(trial: Trial) -> TrialInputs:
    """The inputs of effects for a trial."""
    whole_body = trial.travel_ratio == 1
    length = trial.length_m if math.isfinite(trial.length_m) else 0.0
    area = trial.area_m2 if math.isfinite(trial.diameter_m) else 0.0
    linear_density = trial.linear_density_kg_m
    pressure = 0.0 if whole_body and not math.isfinite(trial.pressure_Pa) else trial.pressure_Pa
    yield_pressure = 0.0 if whole_body and not math.isfinite(trial.yield_pressure_Pa) else trial.yield_pressure_Pa
    gas_density = (pressure + trial.ambient_pressure_Pa) / (GAS_CONSTANT_AIR_J_KG_K * TEMPERATURE_K)
    fold = 0.0 if linear_density == 0 else linear_density * math.pi * trial.thickness_m
    return TrialInputs(
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
        has_bends=float(bool(trial.bends)),
        tail_on_reel=float(trial.tail_store == "reel"),
        bend_count=float(len(trial.bends)),
        bend_total=sum(bend.arc_m / bend.radius_m for bend in trial.bends),
        as_printed=float(trial.mass_loss == "as_printed"),
        tail_free=float(trial.tail_slack == "free" and not whole_body),
    )


def with_pressures(inputs: Floats, set_pressure_Pa: Floats, yield_pressure_Pa: Floats) -> Floats:
    """The inputs of trials at other pressures; the mass of the gas in them changes accordingly. Returns A changed copy.
    Shapes: inputs (n_trials, n_fields); set_pressure_Pa, yield_pressure_Pa (n_trials,) → (n_trials, n_fields).
    """
    place = {name: k for k, name in enumerate(TrialInputs._fields)}
    changed = inputs.copy()
    denser = (set_pressure_Pa - inputs[:, place["set_pressure"]]) / (GAS_CONSTANT_AIR_J_KG_K * TEMPERATURE_K)
    volume = inputs[:, place["area"]] * inputs[:, place["length"]] / inputs[:, place["travel_ratio"]] ** 2
    changed[:, place["set_pressure"]] = set_pressure_Pa
    changed[:, place["least_mass"]] += denser * volume
    given = ~np.isnan(yield_pressure_Pa)
    changed[given, place["yield_pressure"]] = yield_pressure_Pa[given]
    return changed


def _of_trial(column: str, trial: Trial) -> object:
    """Value of a trial in a column of the sheet, SI; NaN for a column that no sheet has."""
    return getattr(trial, COLUMNS[column].field, math.nan) if column in COLUMNS else math.nan


def stated(column: str, trial: Trial) -> bool:
    """Whether the sheet gives a trial a value other than zero in this column."""
    value = _of_trial(column, trial)
    return not isinstance(value, float) or (math.isfinite(value) and value != 0)


def check_needs(model: Model, *trials: Trial) -> None:
    """Raise an error for a trial without a value that an effect of the model needs."""
    needs = [(effect, column) for effect in model for column in effect.needs]
    for trial in trials:
        for effect, column in needs:
            value = _of_trial(column, trial)
            if isinstance(value, float) and not math.isfinite(value) and trial.travel_ratio != 1:
                raise EffectError(f"Trial {trial.name}: the effect {effect.name} needs `{column}`, which is blank.")
