"""A belief drawn and simulated: every draw from release to the end of growth, laid along common places."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from vinetrack.core.records import Floats, Trial
from vinetrack.dynamics.force_terms import evaluate
from vinetrack.dynamics.simulate import Trajectory, simulate_many
from vinetrack.inference.parameters import DAMPING, EXPONENT
from vinetrack.planning.predictive_inputs import PredictiveInputs

LONGEST_S = 600.0
"""A vine that has not grown by then is taken for one that does not get there."""

POINTS = 400
"""Instants of each draw: linear between them, speeds are good to a thousandth up to 0.99 of the length."""

MOST_TENSIONS = 300
"""Draws whose forces are looked at one by one, a third of a millisecond each."""

ROUNDING = 1e-9
"""Of the drive, below which a tension is none: forces of a slack tail cancel to rounding."""

SLACK_SHARE = 0.01
"""Of the drive ½PA that a tail must lack before it counts as slack: the mere weight of a bare tail does no harm."""


@dataclass(frozen=True)
class Runs:
    """Draws simulated, SI. Arrays have shape (n_draws,), or (n_draws, n_places) along `places_m`.

    A place that a draw never reaches has the time inf and the speed 0. Speeds are the leading edge's. Tensions and
    pressures are those of the first `MOST_TENSIONS` draws, NaN where not reached; `least_tension_N` is the least up to
    the last place. `slack` tells which of them would have a tail that pushes, or that goes slack where it may.
    """

    places_m: Floats
    time_s: Floats
    lead_velocity_m_s: Floats
    end_s: Floats
    end_lead_velocity_m_s: Floats
    steady_tail_m_s: Floats
    tension_N: Floats
    least_tension_N: Floats
    pressure_Pa: Floats
    slack: Floats


def run(
    belief: PredictiveInputs,
    places_m: Floats,
    samples: int,
    seed: int,
    *,
    only: Iterable[str] | None = None,
    with_tension: bool = True,
) -> Runs:
    """Draw a belief and simulate every draw.

    Parameters
    ----------
    places_m : array, shape (n_places,), m of growth, rising
    only : names of the uncertainties that vary, by default all

    Raises
    ------
    EffectError
        If the trial lacks what an effect of the model needs.
    SimulationError
        If a draw cannot be integrated.
    """
    trials, rows = belief.laid_out(belief.draw(samples, seed, only))
    moved, until_s = follow(belief, trials, rows)
    time_s, velocity_m_s = np.full((samples, places_m.size), math.inf), np.zeros((samples, places_m.size))
    for i, one in enumerate(moved):
        reached = places_m <= one.lead_position_m[-1]
        time_s[i, reached] = np.interp(places_m[reached], one.lead_position_m, one.time_s)
        velocity_m_s[i, reached] = np.interp(places_m[reached], one.lead_position_m, one.lead_velocity_m_s)
    looked_at = min(samples, MOST_TENSIONS) if with_tension else 0
    tension_N, pressure_Pa, least_N, slack = _forces(belief, trials[:looked_at], rows, moved, places_m)
    return Runs(
        places_m=places_m,
        time_s=time_s,
        lead_velocity_m_s=velocity_m_s,
        end_s=until_s,
        end_lead_velocity_m_s=np.where(np.isfinite(until_s), [one.lead_velocity_m_s[-1] for one in moved], 0.0),
        steady_tail_m_s=_steady(belief, trials, rows),
        tension_N=tension_N,
        least_tension_N=least_N,
        pressure_Pa=pressure_Pa,
        slack=slack,
    )


def follow(belief: PredictiveInputs, trials: Sequence[Trial], rows: Floats) -> tuple[list[Trajectory], Floats]:
    """Every draw at `POINTS` instants of its growth, and when it ends, shape (n_draws,), inf where it does not."""
    asked = [np.array([0.0, LONGEST_S])] * len(trials)
    ends = simulate_many(belief.model, trials, asked, parameters=rows)
    over = np.array([one.end_time_s if one.status in ("ended", "stalled") else LONGEST_S for one in ends])
    # An instant short of the end: there the bare vine's speed has left for infinity, and behind it is none.
    times = [max(end, 1e-9) * (1 - 1e-9) * np.linspace(0.0, 1.0, POINTS) for end in over]
    moved = simulate_many(belief.model, trials, times, parameters=rows)
    return moved, np.where([one.status == "ended" for one in ends], over, math.inf)


def _forces(
    belief: PredictiveInputs, trials: Sequence[Trial], rows: Floats, moved: Sequence[Trajectory], places_m: Floats
) -> tuple[Floats, Floats, Floats, Floats]:
    """Tension and pressure at the places, least tension up to the last of them, and whether the tail goes slack."""
    names = belief.model.parameter_names
    tension_N, pressure_Pa = (np.full((len(trials), places_m.size), math.nan) for _ in range(2))
    least_N, slack = np.full(len(trials), math.nan), np.zeros(len(trials))
    for i, trial in enumerate(trials):
        model = replace(belief.model, values=dict(zip(names, rows[i].tolist(), strict=True)))
        one = moved[i]
        terms = evaluate(model, trial, one.time_s, one.lead_position_m, one.lead_velocity_m_s)
        drive_N = trial.pressure_Pa * trial.area_m2 / trial.travel_ratio
        tension = np.where(np.abs(terms.tension_N) < ROUNDING * drive_N, 0.0, terms.tension_N)
        reached = places_m <= one.lead_position_m[-1]
        tension_N[i, reached] = np.interp(places_m[reached], one.lead_position_m, tension)
        pressure_Pa[i, reached] = np.interp(places_m[reached], one.lead_position_m, terms.pressure_Pa)
        moving = (one.lead_position_m <= places_m[-1]) & (one.lead_velocity_m_s > 0)
        if moving.any():
            least_N[i] = np.min(tension[moving])
        free = trial.tail_slack == "free"
        slack[i] = math.isfinite(one.slack_from_s) if free else least_N[i] < -SLACK_SHARE * drive_N
    return tension_N, pressure_Pa, least_N, slack


def _steady(belief: PredictiveInputs, trials: Sequence[Trial], rows: Floats) -> Floats:
    """Tail speed of (P − P_y)A = B ẋⁿ, m/s, weight and further effects left out; NaN for a model without it."""
    names = belief.model.parameter_names
    if DAMPING not in names:
        return np.full(len(trials), math.nan)
    B, n = rows[:, names.index(DAMPING)], rows[:, names.index(EXPONENT)]
    force_N = np.array([max(t.pressure_Pa - t.yield_pressure_Pa, 0.0) * t.area_m2 for t in trials])
    with np.errstate(divide="ignore", over="ignore"):
        return np.asarray((force_N / B) ** (1 / n))
