"""What steady speeds alone would say of n: the error of the damping law, beside that of whole trajectories.

    ln (P − P_y)A = ln B + n ln ẋ_ss

scatters by what B and P do from trial to trial, and a yield pressure that is off tilts it. A fit to trajectories knows
more (how a vine gets to its speed), as long as its model lacks nothing; this knows less and needs less.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from vinetrack.core.records import Floats, Trial
from vinetrack.dynamics.model import Model
from vinetrack.dynamics.simulate import simulate_many
from vinetrack.inference.parameters import DAMPING, EXPONENT

STEADY = 0.97
"""Of the speed of Eq. (3), that a vine must have come to at 0.95 of its length to count as steady."""


def reaches_steady(model: Model, trials: Sequence[Trial], longest_s: float) -> np.ndarray:
    """Which bare vines come to within 3 % of their steady speed before the end, shape (n_trials,)."""
    times = [np.linspace(0.0, longest_s, 2000)] * len(trials)
    reached = []
    for trial, moved in zip(trials, simulate_many(model, trials, times), strict=True):
        inside = moved.lead_position_m < 0.95 * trial.length_m
        highest = trial.travel_ratio * float(np.max(moved.lead_velocity_m_s[inside]))
        reached.append(trial.payload_kg == 0 and highest > STEADY * steady_speed(model, trial))
    return np.array(reached)


def steady_speed(model: Model, trial: Trial) -> float:
    """Tail speed of Eq. (3), m/s."""
    values = dict(zip(model.parameter_names, model.parameters_for(trial.vine).tolist(), strict=True))
    force_N = max(trial.pressure_Pa - trial.yield_pressure_Pa, 0.0) * trial.area_m2
    return float((force_N / values[DAMPING]) ** (1 / values[EXPONENT]))


def steady_error(
    model: Model, trials: Sequence[Trial], counts: Floats, spreads: tuple[float, float], steady: np.ndarray
) -> float:
    """Standard error of n from the steady trials among so many of each condition; infinite where they cannot tell."""
    vines = list(dict.fromkeys(trial.vine for trial in trials))
    size = 1 + 2 * len(vines)
    total = np.zeros((size, size))
    for trial, count, settles in zip(trials, counts.tolist(), steady.tolist(), strict=True):
        if not settles or count == 0:
            continue
        drive = trial.pressure_Pa - trial.yield_pressure_Pa
        scatter = math.hypot(spreads[1], spreads[0] * trial.pressure_Pa / drive)
        row = np.zeros(size)
        row[0] = math.log(steady_speed(model, trial))
        row[1 + vines.index(trial.vine)] = 1.0
        row[1 + len(vines) + vines.index(trial.vine)] = trial.yield_pressure_sigma_Pa / drive
        total += count * np.outer(row, row) / max(scatter, 1e-6) ** 2
    known = np.diag(total) > 0
    if not known[0]:
        return math.inf
    # Yield pressures in units of their stated error: known to 1 beforehand.
    total[np.arange(1 + len(vines), size), np.arange(1 + len(vines), size)] += 1.0
    kept = np.flatnonzero(known)
    inside = total[np.ix_(kept, kept)]
    if np.linalg.cond(inside) > 1e12:
        return math.inf
    return math.sqrt(float(np.linalg.inv(inside)[0, 0]))
