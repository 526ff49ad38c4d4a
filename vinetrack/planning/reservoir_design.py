"""Volume of the chamber that keeps the gauge pressure nearly constant while a vine grows.

    (P + P_atm) (V₀/(V₀ + S))^γ = (1 − ε) P + P_atm
    V₀ = S q/(1 − q) with q = (((1 − ε) P + P_atm)/(P + P_atm))^(1/γ)

with S = A·y the volume filled and ε the allowed loss as a fraction of the gauge pressure. The gas law needs *absolute*
pressure. γ = 1 is isothermal: growth so slow that the gas stays at room temperature. γ = 1.4 is adiabatic: growth too
fast for heat exchange.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import brentq

from vinetrack.core.records import Trial
from vinetrack.dynamics.force_terms import pressure_along
from vinetrack.dynamics.host import host_for
from vinetrack.dynamics.model import Model
from vinetrack.dynamics.simulate import simulate_many
from vinetrack.effects import catalogue
from vinetrack.planning.design_checks import final_m_s
from vinetrack.planning.prediction import LONGEST_S, POINTS
from vinetrack.planning.predictive_inputs import PredictiveInputs

GAMMAS = {"slow, isothermal (γ = 1)": 1.0, "fast, adiabatic (γ = 1.4)": 1.4}  # Gas laws between which every growth lies


def swept_m3(trial: Trial) -> float:
    """Return the volume of the grown vine, m³."""
    return trial.area_m2 * trial.length_m


def gauge_loss(pressure_Pa: float, swept: float, chamber_m3: float, gamma: float, ambient_Pa: float) -> float:
    """Return the fraction of the gauge pressure lost after the volume `swept` is filled from a closed chamber."""
    left_Pa = (pressure_Pa + ambient_Pa) * (chamber_m3 / (chamber_m3 + swept)) ** gamma - ambient_Pa
    return 1 - left_Pa / pressure_Pa


def chamber_for(pressure_Pa: float, swept: float, loss: float, gamma: float, ambient_Pa: float) -> float:
    """Return the volume of the closed chamber, m³, that loses exactly this fraction of its gauge pressure."""
    q = (((1 - loss) * pressure_Pa + ambient_Pa) / (pressure_Pa + ambient_Pa)) ** (1 / gamma)
    return swept * q / (1 - q)


def chamber_by_gauge(swept: float, loss: float) -> float:
    """Return the volume, m³, by Boyle's law with gauge instead of absolute pressure, V₁/V₂ = 1 − ε, which
    is too small.
    """
    return swept * (1 - loss) / loss


@dataclass(frozen=True)
class Chamber:
    """One chamber and the loss of pressure in it: `losses` by gas law, as a fraction of the gauge pressure."""

    name: str
    volume_m3: float
    losses: dict[str, float]


def chambers(trial: Trial, loss: float) -> tuple[Chamber, ...]:
    """Return the chambers to compare: the stated one, those that keep the pressure, and the one by gauge pressure."""
    volume = swept_m3(trial)

    def chamber(name: str, volume_m3: float) -> Chamber:
        losses = {
            law: gauge_loss(trial.pressure_Pa, volume, volume_m3, gamma, trial.ambient_pressure_Pa)
            for law, gamma in GAMMAS.items()
        }
        return Chamber(name, volume_m3, losses)

    asked = [chamber("asked about", trial.chamber_m3)] if math.isfinite(trial.chamber_m3) else []
    needed = [
        chamber(
            f"needed if {law.split(',')[0]}",
            chamber_for(trial.pressure_Pa, volume, loss, gamma, trial.ambient_pressure_Pa),
        )
        for law, gamma in GAMMAS.items()
    ]
    return (*asked, *needed, chamber("by gauge pressure (wrong)", chamber_by_gauge(volume, loss)))


def supplied_loss(inputs: PredictiveInputs, chamber_m3: float, tau_s: float, gamma: float) -> float:
    """Return the largest fraction of the gauge pressure lost at the medians with a supply of time constant `tau_s`."""
    trial = replace(inputs.trial, chamber_m3=chamber_m3)
    model = _with(inputs.model, "supply_refill", tau=tau_s, gamma=gamma)
    (end,) = simulate_many(model, [trial], [np.array([0.0, LONGEST_S])], host=host_for(inputs.model))
    until = end.end_time_s if end.status in ("ended", "stalled") else LONGEST_S
    times = until * (1 - 1e-9) * np.linspace(0.0, 1.0, POINTS)
    (moved,) = simulate_many(model, [trial], [times], host=host_for(inputs.model))
    pressure = pressure_along(model, trial, times, moved.lead_position_m, moved.lead_velocity_m_s)
    return 1 - float(np.min(pressure)) / trial.pressure_Pa


def supplied_chamber(inputs: PredictiveInputs, loss: float, tau_s: float, gamma: float) -> float:
    """Return the volume of the chamber that with such a supply loses exactly this fraction; 0 where none is needed.
    Returns m³.
    """

    def excess_loss(log_volume: float) -> float:
        return supplied_loss(inputs, math.exp(log_volume), tau_s, gamma) - loss

    closed = chamber_for(
        inputs.trial.pressure_Pa, swept_m3(inputs.trial), loss, gamma, inputs.trial.ambient_pressure_Pa
    )
    low, high = math.log(closed / 1e4), math.log(closed * 1.01)
    if excess_loss(low) <= 0:
        return 0.0
    return math.exp(brentq(excess_loss, low, high, xtol=1e-3))


def final_with(inputs: PredictiveInputs, chamber_m3: float, gamma: float, at_fraction: float) -> float:
    """Return the final speed at the medians with a closed chamber of this volume, m/s; see `VinePrediction.final`."""
    model = _with(inputs.model, "reservoir_depletion", gamma=gamma)
    trial = replace(inputs.trial, chamber_m3=chamber_m3)
    return final_m_s(replace(inputs, trial=trial, model=model), model, host_for(inputs.model), at_fraction)


def _with(model: Model, name: str, **values: float) -> Model:
    """The model with this effect in place of any other effect of the chamber."""
    for other in ("reservoir_depletion", "supply_refill"):
        model = model - other if other in model else model
    return (model + catalogue()[name]).with_values({f"{name}.{key}": value for key, value in values.items()})
