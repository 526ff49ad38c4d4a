"""The fastest vine within what can be built: films to choose from, ranges of diameter and length, burst, supply.

At a given diameter, wall and length more pressure is always faster, so the pressure is as high as the supply and the
wall allow, P = min(P_supply, f · 2tσ/D) with f the share of the burst stress that one dares. Diameter and length are
searched, at the medians of the predictive inputs; their uncertainties then say how sure the choice is: every draw has
its own fastest film.
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

GRID = (17, 9)
"""Diameters and lengths looked at in each round. Chosen: over a range of ten, neighbouring diameters differ by 15 %. At
half the first round may miss a narrow best, at twice the search takes four times as long."""

ROUNDS = 3
"""Each looks closer about the best of the one before: a range of a tenth is left to a few thousandths. Chosen: the
speed about its best is flat, so that a few thousandths of size do not show. At half sizes are good to a few per cent,
at twice only time is spent."""

AT_A_BOUND = 0.005
"""Relative distance from a bound below which a vine counts as limited by it. Chosen: what the last round leaves;
only the wording depends on it."""


@dataclass(frozen=True)
class Room:
    """What can be built, SI. `rig` holds what all have in common: payload, angle, chamber, yield pressure."""

    films_m: tuple[float, ...]
    diameter_m: tuple[float, float]
    length_m: tuple[float, float]
    pressure_Pa: float
    rig: Trial
    burst_share: float = 0.9
    burst_stress_Pa: float = BURST_STRESS_PA

    def pressure_of(self, diameter_m: float, thickness_m: float) -> float:
        """The highest pressure that the supply gives and the wall is trusted with, Pa.

        P = min(P_supply, f · 2tσ/D), with f the share of the burst stress and σ the burst stress.

        Parameters
        ----------
        diameter_m, thickness_m : float
            Size of the tube, m.

        Returns
        -------
        float
        """
        burst_Pa = burst_pressure_Pa(diameter_m, thickness_m) * self.burst_stress_Pa / BURST_STRESS_PA
        return min(self.pressure_Pa, self.burst_share * burst_Pa)

    def trial(self, diameter_m: float, thickness_m: float, length_m: float) -> Trial:
        """The trial with a vine of this size, at the highest pressure for it.

        Parameters
        ----------
        diameter_m, thickness_m, length_m : float
            Size of the vine, m.

        Returns
        -------
        Trial
        """
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
    """The best vine of one film; `limits` say what keeps it from being faster, `odds` how often it is the fastest.

    `others` has columns diameter_m, lead speed m/s, of the best vine of every diameter: how much the choice matters.
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
    """The best vine of every film, fastest first.

    Parameters
    ----------
    room : what can be built.
    stated : values of numbers in place of other sources.
    fit : a fit to predict from, if any.
    samples : int
        Draws for bands and odds.
    seed : int
        Of the random numbers.
    at_fraction : float
        y/L at which a bare vine's final speed is taken.

    Returns
    -------
    tuple of Choice

    Raises
    ------
    EffectError
        If the rig lacks what an effect of the model needs.
    SimulationError
        If a vine cannot be simulated.
    """
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
    """The best diameter and length for one film, and the best speed at every diameter of the first round."""
    spans = [room.diameter_m, (max(room.length_m[0], 1e-6), room.length_m[1])]
    whole = list(spans)
    others = np.empty((0, 2))
    inputs: PredictiveInputs | None = None
    for turn in range(ROUNDS):
        axes = [np.unique(np.geomspace(*span, count)) for span, count in zip(spans, GRID, strict=True)]
        vine_inputs = [predictive_inputs(room.trial(D, film_m, L), stated, fit) for D in axes[0] for L in axes[1]]
        speeds = final_speeds(vine_inputs, at_fraction).reshape(axes[0].size, axes[1].size)
        i, j = np.unravel_index(int(np.argmax(speeds)), speeds.shape)
        inputs = vine_inputs[int(i) * axes[1].size + int(j)]
        if turn == 0:
            others = np.column_stack([axes[0], speeds.max(axis=1)])
        spans = [_about(axis, int(k), span) for axis, k, span in zip(axes, (i, j), whole, strict=True)]
    assert inputs is not None
    return inputs, others


def _about(axis: Floats, k: int, whole: tuple[float, float]) -> tuple[float, float]:
    """From the neighbour below the best to the one above."""
    return max(whole[0], float(axis[max(k - 1, 0)])), min(whole[1], float(axis[min(k + 1, axis.size - 1)]))


def final_speeds(vine_inputs: Sequence[PredictiveInputs], at_fraction: float) -> Floats:
    """The final speed of every vine at its medians, m/s, shape (n,): a payload's at the end, else the edge's.

    Parameters
    ----------
    vine_inputs : predictive inputs, all of one model.
    at_fraction : float
        y/L at which a bare vine's final speed is taken.

    Returns
    -------
    array, shape (n,)
        0 for a vine that does not grow to its end.
    """
    trials = [inputs.trial for inputs in vine_inputs]
    model = vine_inputs[0].model
    rows = np.array([inputs.model.parameters_of(inputs.trial) for inputs in vine_inputs])
    ends = simulate_many(model, trials, [np.array([0.0, LONGEST_S])] * len(trials), parameters=rows)
    over = np.array([end.end_time_s if end.status == "ended" else LONGEST_S for end in ends])
    times = [end * (1 - 1e-9) * np.linspace(0.0, 1.0, POINTS) for end in over]
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
    """What keeps a vine from being faster: bounds it sits at, and what holds its pressure."""
    burst = room.burst_share * burst_pressure_Pa(trial.diameter_m, trial.thickness_m)
    burst *= room.burst_stress_Pa / BURST_STRESS_PA
    limits = ["supply" if room.pressure_Pa <= burst else "burst"]
    for name, value, (low, high) in (
        ("diameter", trial.diameter_m, room.diameter_m),
        ("length", trial.length_m, room.length_m),
    ):
        if high > low and value > high * (1 - AT_A_BOUND):
            limits.append(f"largest {name}")
        elif high > low and value < low * (1 + AT_A_BOUND):
            limits.append(f"smallest {name}")
    return tuple(limits)


def _odds(vine_inputs: Sequence[PredictiveInputs], samples: int, seed: int, at_fraction: float) -> list[float]:
    """How often each is the fastest of them, everything uncertain drawn; what vines have in common is drawn once."""
    speeds = []
    for inputs in vine_inputs:
        trial = inputs.trial
        runs = run(inputs, np.array([at_fraction * trial.length_m]), samples, seed, with_tension=False)
        speeds.append(
            runs.end_lead_velocity_m_s * trial.travel_ratio if told_by_payload(trial) else runs.lead_velocity_m_s[:, 0]
        )
    winners = np.argmax(np.array(speeds), axis=0)
    return [float(np.mean(winners == k)) for k in range(len(vine_inputs))]
