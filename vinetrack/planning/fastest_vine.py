"""The fastest vine that can be built from given films, within ranges of diameter and length, burst stress
and supply.

For a given size a higher pressure always gives a higher speed, so the pressure is the highest that supply and wall
allow, P = min(P_supply, f · 2tσ/D) with f the allowed fraction of the burst stress σ. Diameter and length are optimised
by a grid search at the medians of the predictive inputs. How certain the choice of film is follows from their
distributions: every draw has its own fastest film.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from vinetrack.core.records import Floats, Trial
from vinetrack.dynamics.simulate import simulate_many
from vinetrack.experiment.naming import with_names
from vinetrack.planning.fit_inputs import FitNumbers
from vinetrack.planning.input_sources import StatedValues, predictive_inputs
from vinetrack.planning.prediction import LONGEST_S, POINTS, VinePrediction, predict_vine, run, told_by_payload
from vinetrack.planning.predictive_inputs import PredictiveInputs
from vinetrack.planning.scaling_priors import BURST_STRESS_PA, burst_pressure_Pa

GRID = (17, 9)  # Numbers of diameters and lengths in each round (chosen)

ROUNDS = 3  # Rounds of the search, each a finer grid around the optimum of the one before (chosen)

BOUND_TOLERANCE = 0.005  # Relative distance from a bound below which a vine counts as limited by it (chosen)


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
        """Return the highest pressure that supply and wall allow, Pa. P = min(P_supply, f · 2tσ/D), with f the allowed
        fraction of the burst stress σ.
        """
        burst_Pa = burst_pressure_Pa(diameter_m, thickness_m) * self.burst_stress_Pa / BURST_STRESS_PA
        return min(self.pressure_Pa, self.burst_share * burst_Pa)

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
    for round_number in range(ROUNDS):
        axes = [np.unique(np.geomspace(*span, count)) for span, count in zip(spans, GRID, strict=True)]
        vine_inputs = [predictive_inputs(room.trial(D, film_m, L), stated, fit) for D in axes[0] for L in axes[1]]
        speeds = final_speeds(vine_inputs, at_fraction).reshape(axes[0].size, axes[1].size)
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


def final_speeds(vine_inputs: Sequence[PredictiveInputs], at_fraction: float) -> Floats:
    """Return the final speed of every vine at its medians, m/s: a payload's at the end, else the leading edge's.
    Returns 0 for a vine that does not grow to its end. Shape (n,).
    """
    trials = [inputs.trial for inputs in vine_inputs]
    model = vine_inputs[0].model
    rows = np.array([inputs.model.parameters_of(inputs.trial) for inputs in vine_inputs])
    ends = simulate_many(model, trials, [np.array([0.0, LONGEST_S])] * len(trials), parameters=rows)
    stop_s = np.array([end.end_time_s if end.status == "ended" else LONGEST_S for end in ends])
    times = [stop * (1 - 1e-9) * np.linspace(0.0, 1.0, POINTS) for stop in stop_s]
    moved = simulate_many(model, trials, times, parameters=rows)
    speeds = np.zeros(len(trials))
    for k, (trial, end, trajectory) in enumerate(zip(trials, ends, moved, strict=True)):
        if end.status != "ended":
            continue
        if told_by_payload(trial):
            speeds[k] = trial.travel_ratio * trajectory.lead_velocity_m_s[-1]
        else:
            speeds[k] = np.interp(
                at_fraction * trial.length_m, trajectory.lead_position_m, trajectory.lead_velocity_m_s
            )
    return speeds


def _limits(room: Room, trial: Trial) -> tuple[str, ...]:
    """The constraints that keep a vine from being faster: of its pressure, and bounds of its size."""
    burst = room.burst_share * burst_pressure_Pa(trial.diameter_m, trial.thickness_m)
    burst *= room.burst_stress_Pa / BURST_STRESS_PA
    limits = ["supply" if room.pressure_Pa <= burst else "burst"]
    for name, value, (low, high) in (
        ("diameter", trial.diameter_m, room.diameter_m),
        ("length", trial.length_m, room.length_m),
    ):
        if high > low and value > high * (1 - BOUND_TOLERANCE):
            limits.append(f"largest {name}")
        elif high > low and value < low * (1 + BOUND_TOLERANCE):
            limits.append(f"smallest {name}")
    return tuple(limits)


def _odds(vine_inputs: Sequence[PredictiveInputs], samples: int, seed: int, at_fraction: float) -> list[float]:
    """Fraction of draws in which each is the fastest; inputs that vines share have the same draws in all."""
    speeds = []
    for inputs in vine_inputs:
        trial = inputs.trial
        runs = run(inputs, np.array([at_fraction * trial.length_m]), samples, seed, with_tension=False)
        speeds.append(
            runs.end_lead_velocity_m_s * trial.travel_ratio if told_by_payload(trial) else runs.lead_velocity_m_s[:, 0]
        )
    winners = np.argmax(np.array(speeds), axis=0)
    return [float(np.mean(winners == k)) for k in range(len(vine_inputs))]
