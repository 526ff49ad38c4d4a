"""The fastest vine that can be built from given films, within ranges of diameter and length, burst stress
and supply.

For a given size a higher pressure always gives a higher speed, so the pressure is the highest that supply and wall
allow, P = min(P_supply, f · 2tσ/D) with f the allowed fraction of the burst stress σ. Diameter and length are optimised
by a grid search at the medians of the predictive inputs. How certain the choice of film is follows from their
distributions: every draw has its own fastest film.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import brentq

from vinetrack.core.records import Floats, Trial
from vinetrack.dynamics.audit import pressure_along
from vinetrack.dynamics.model import Model, host_for
from vinetrack.effects import catalogue
from vinetrack.experiment.schema import with_names
from vinetrack.planning.prediction import (
    VinePrediction,
    drawn_final_speeds,
    final_m_s,
    final_speeds,
    grown,
    predict_vine,
)
from vinetrack.planning.predictive_inputs import (
    BURST_STRESS_PA,
    FitNumbers,
    PredictiveInputs,
    StatedValues,
    burst_pressure_Pa,
    predictive_inputs,
)

GRID = (17, 9)  # Numbers of diameters and lengths in each round (chosen)


@dataclass(frozen=True)
class Room:
    """Limits of what can be built, SI. `rig` has what all share: payload, angle, chamber, yield pressure."""

    films_m: tuple[float, ...]
    diameter_m: tuple[float, float]
    length_m: tuple[float, float]
    pressure_Pa: float
    rig: Trial
    burst_share: float = 0.9
    burst_stress_Pa: float = BURST_STRESS_PA

    def pressure_of(self, diameter_m: float, thickness_m: float) -> float:
        """Return the highest pressure that supply and wall allow, Pa."""
        return min(self.pressure_Pa, self.bearable_Pa(diameter_m, thickness_m))

    def bearable_Pa(self, diameter_m: float, thickness_m: float) -> float:
        """Return the highest pressure that the wall allows, f · 2tσ/D, Pa."""
        burst_Pa = burst_pressure_Pa(diameter_m, thickness_m) * self.burst_stress_Pa / BURST_STRESS_PA
        return self.burst_share * burst_Pa

    def trial(self, diameter_m: float, thickness_m: float, length_m: float) -> Trial:
        """Return the trial with a vine of this size at the highest pressure allowed."""
        pressure_Pa = self.pressure_of(diameter_m, thickness_m)
        sized = replace(
            self.rig,
            diameter_m=diameter_m,
            thickness_m=thickness_m,
            length_m=length_m,
            pressure_Pa=pressure_Pa,
            pressure_sigma_Pa=0.01 * pressure_Pa,
        )
        return with_names([sized])[0]


@dataclass(frozen=True)
class Choice:
    """The fastest vine of one film; `limits` are the constraints that are active, `odds` is how often it is fastest.
    `others` has columns diameter, m, and lead speed, m/s, of the fastest vine of every diameter of the first round.
    """

    thickness_m: float
    prediction: VinePrediction
    limits: tuple[str, ...]
    odds: float
    others: Floats


def fastest(
    room: Room,
    stated: StatedValues | None = None,
    fit: FitNumbers | None = None,
    *,
    samples: int = 400,
    seed: int = 1,
    at_fraction: float = 0.95,
) -> tuple[Choice, ...]:
    """Find the fastest vine of every film, fastest first."""
    best: list[tuple[PredictiveInputs, Floats]] = [_best(room, film, stated, fit, at_fraction) for film in room.films_m]
    odds = _odds([inputs for inputs, _ in best], samples, seed, at_fraction)
    choices = [
        Choice(
            thickness_m=inputs.trial.thickness_m,
            prediction=predict_vine(inputs, samples=samples, seed=seed, at_fraction=at_fraction),
            limits=_limits(room, inputs.trial),
            odds=share,
            others=others,
        )
        for (inputs, others), share in zip(best, odds, strict=True)
    ]
    return tuple(sorted(choices, key=lambda choice: -choice.prediction.final.median))


def _best(
    room: Room, film_m: float, stated: StatedValues | None, fit: FitNumbers | None, at_fraction: float
) -> tuple[PredictiveInputs, Floats]:
    """Inputs of the fastest vine of one film, and the highest speed at every diameter of the first round."""
    spans = [room.diameter_m, (max(room.length_m[0], 1e-6), room.length_m[1])]
    limits = list(spans)
    others = np.empty((0, 2))
    inputs: PredictiveInputs | None = None
    # 3: rounds of the search, each a finer grid around the optimum of the one before (chosen)
    for round_number in range(3):
        axes = [np.unique(np.geomspace(*span, count)) for span, count in zip(spans, GRID, strict=True)]
        vine_inputs = [predictive_inputs(room.trial(D, film_m, L), stated, fit) for D in axes[0] for L in axes[1]]
        rows = np.array([inputs.model.parameters_of(inputs.trial) for inputs in vine_inputs])
        trials = [inputs.trial for inputs in vine_inputs]
        speeds = final_speeds(vine_inputs[0].model, trials, at_fraction, rows).reshape(axes[0].size, axes[1].size)
        i, j = np.unravel_index(int(np.argmax(speeds)), speeds.shape)
        inputs = vine_inputs[int(i) * axes[1].size + int(j)]
        if round_number == 0:
            others = np.column_stack([axes[0], speeds.max(axis=1)])
        spans = [_neighbours(axis, int(k), span) for axis, k, span in zip(axes, (i, j), limits, strict=True)]
    assert inputs is not None
    return inputs, others


def _neighbours(axis: Floats, k: int, limits: tuple[float, float]) -> tuple[float, float]:
    """Range from the grid value below the optimum to the one above, within the limits."""
    return max(limits[0], float(axis[max(k - 1, 0)])), min(limits[1], float(axis[min(k + 1, axis.size - 1)]))


def _limits(room: Room, trial: Trial) -> tuple[str, ...]:
    """The constraints that keep a vine from being faster: of its pressure, and bounds of its size."""
    bound_tolerance = 0.005  # Relative distance from a bound below which a vine counts as limited by it (chosen)
    bearable_Pa = room.bearable_Pa(trial.diameter_m, trial.thickness_m)
    limits = ["supply" if room.pressure_Pa <= bearable_Pa else "burst"]
    for name, value, (low, high) in (
        ("diameter", trial.diameter_m, room.diameter_m),
        ("length", trial.length_m, room.length_m),
    ):
        if high > low and value > high * (1 - bound_tolerance):
            limits.append(f"largest {name}")
        elif high > low and value < low * (1 + bound_tolerance):
            limits.append(f"smallest {name}")
    return tuple(limits)


def _odds(vine_inputs: Sequence[PredictiveInputs], samples: int, seed: int, at_fraction: float) -> list[float]:
    """Fraction of draws in which each is the fastest; inputs that vines share have the same draws in all."""
    speeds = [drawn_final_speeds(inputs, at_fraction, samples, seed) for inputs in vine_inputs]
    winners = np.argmax(np.array(speeds), axis=0)
    return [float(np.mean(winners == k)) for k in range(len(vine_inputs))]


# ------------------------------------------------------------------------------
# Volume of the chamber that keeps the gauge pressure nearly constant while a vine grows.
#
#     (P + P_atm) (V₀/(V₀ + S))^γ = (1 − ε) P + P_atm
#     V₀ = S q/(1 − q) with q = (((1 − ε) P + P_atm)/(P + P_atm))^(1/γ)
#
# with S = A·y the volume filled and ε the allowed loss as a fraction of the gauge pressure. The gas law needs
# *absolute* pressure. γ = 1 is isothermal: growth so slow that the gas stays at room temperature. γ = 1.4 is
# adiabatic: growth too fast for heat exchange.

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
    # Boyle's law with gauge instead of absolute pressure, V₁/V₂ = 1 − ε, gives too small a chamber.
    return (*asked, *needed, chamber("by gauge pressure (wrong)", volume * (1 - loss) / loss))


def supplied_loss(inputs: PredictiveInputs, chamber_m3: float, tau_s: float, gamma: float) -> float:
    """Return the largest fraction of the gauge pressure lost at the medians with a supply of time constant `tau_s`."""
    trial = replace(inputs.trial, chamber_m3=chamber_m3)
    model = _with(inputs.model, "supply_refill", tau=tau_s, gamma=gamma)
    (moved,), _ = grown(model, [trial], host=host_for(inputs.model))
    pressure = pressure_along(model, trial, moved.time_s, moved.lead_position_m, moved.lead_velocity_m_s)
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
