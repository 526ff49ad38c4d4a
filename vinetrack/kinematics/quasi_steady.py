"""Quasi-steady windows, in which a vine follows a changing pressure with negligible inertia.

As the chamber empties no speed is steady, yet the forces balance at every instant as long as inertia is a small part of
them. If the pressure during growth is known, measured or from the model in use, such a window gives a point of the
damping law as good as a steady one. If it is not known, the point would be wrong, and the rule is not applied.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np

from vinetrack.core.constants import GRAVITY_M_S2
from vinetrack.core.records import Floats, Kinematics, Track, Trial, Window
from vinetrack.kinematics.plateau import fit_window, judge
from vinetrack.kinematics.release import Release

INERTIA_LIMIT = 0.1  # Largest inertia as a fraction of the force, at the end of its 95 % interval (chosen)

LARGEST_CHANGE = 0.3  # Largest relative change of speed across a window (derived)

# Fraction of the length up to which the moving mass of a vine without payload is known well enough (chosen)
LAST_FRACTION = 0.95

PARTS = 3  # Parts of a window in which inertia is fitted separately (chosen)

FEWEST_POINTS = 4 * PARTS  # Fewest points of a window (derived)

SECTIONS = 6  # Sections between whose ends all windows are tried (chosen)


def quasi_steady_window(
    trial: Trial,
    track: Track,
    kinematics: Kinematics,
    release: Release,
    pressure_Pa: Floats,
    *,
    start_fraction: float = 0.2,
) -> Window:
    """Find the longest window after the highest speed in which inertia is a small part of the force. Shapes:
    pressure_Pa (n,).
    """
    usable = track.usable
    time_s, position_m = track.time_s[usable], track.lead_position_m[usable]
    travel_m = position_m - release.lead_position_m
    velocity = kinematics.lead_velocity_m_s
    first = int(np.argmax(velocity))
    lowest = max(start_fraction, 1 - LARGEST_CHANGE) * velocity[first]
    beyond = np.flatnonzero((velocity[first:] < lowest) | (travel_m[first:] > LAST_FRACTION * trial.length_m))
    last = first + int(beyond[0]) - 1 if beyond.size else velocity.size - 1
    if last - first + 1 < FEWEST_POINTS:
        points = max(last - first + 1, 0)
        reason = f"{points} points between the highest speed and the end are too few; {FEWEST_POINTS} are needed"
        return Window("quasi_steady", False, reason)
    mass_kg = trial.moving_mass_kg(np.maximum(travel_m, 0.0))
    weight_N = trial.travel_ratio * mass_kg * GRAVITY_M_S2 * math.cos(trial.growth_angle_rad)
    force_N = (pressure_Pa - trial.yield_pressure_Pa) * trial.area_m2 + weight_N
    inertial_mass_kg = trial.travel_ratio**2 * mass_kg
    ends = np.linspace(first, last, SECTIONS + 1).round().astype(int)
    candidates = sorted(itertools.combinations(ends.tolist(), 2), key=lambda ends: ends[0] - ends[1])
    smallest = math.inf
    for a, b in candidates:
        if b - a + 1 < FEWEST_POINTS:
            break
        inertia = _largest_inertia(time_s, position_m, kinematics, inertial_mass_kg, force_N, a, b)
        smallest = min(smallest, inertia)
        if inertia <= INERTIA_LIMIT:
            window = judge(time_s, position_m, kinematics, a, b, "quasi_steady")
            reason = (
                f"follows a known pressure over {window.n_points} points: speed changes by"
                f" {100 * window.drift:.2g} %, inertia at most {100 * inertia:.2g} % of the force"
            )
            return replace(window, accepted=True, reason=reason)
    return Window("quasi_steady", False, f"inertia takes at least {100 * smallest:.2g} % of the force in every window")


def _largest_inertia(
    time_s: Floats,
    position_m: Floats,
    kinematics: Kinematics,
    inertial_mass_kg: Floats,
    force_N: Floats,
    a: int,
    b: int,
) -> float:
    """Largest inertia in any third of a window as a fraction of the force, at the end of its 95 % interval."""
    edges = np.linspace(a, b + 1, PARTS + 1).round().astype(int)
    largest = 0.0
    for low, high in itertools.pairwise(edges):
        t = time_s[low:high]
        fit = fit_window(t, position_m[low:high], kinematics.noise_m, kinematics.noise_correlation)
        to_force = (
            float(np.mean(inertial_mass_kg[low:high]) / np.mean(force_N[low:high]))
            * fit.speed_m_s
            / float(t[-1] - t[0])
        )
        if not (fit.speed_m_s > 0 and np.all(force_N[low:high] > 0)):
            return math.inf
        largest = max(largest, to_force * (abs(fit.drift) + 1.96 * fit.drift_sigma))
    return largest
