"""What comes out at the end: the final speed, and how much of the gas's work became motion."""

from __future__ import annotations

import math

import numpy as np

from vinetrack.records import Floats, Trial


def lead_velocity_at(lead_position_m: Floats, lead_velocity_m_s: Floats, target_m: float) -> float:
    """Velocity where the leading edge first passes `target_m`, m/s; NaN where it never gets there.

    Both arrays have shape (n,), travel counted from rest; between points the velocity is interpolated linearly in
    position.
    """
    beyond = np.flatnonzero(lead_position_m >= target_m)
    if beyond.size == 0 or beyond[0] == 0:
        return math.nan
    i = int(beyond[0])
    span_m = lead_position_m[i] - lead_position_m[i - 1]
    part = (target_m - lead_position_m[i - 1]) / span_m if span_m > 0 else 0.0
    return float(lead_velocity_m_s[i - 1] + part * (lead_velocity_m_s[i] - lead_velocity_m_s[i - 1]))


def energy_efficiency(trial: Trial, lead_travel_m: float, lead_velocity_m_s: float) -> float:
    """Kinetic energy over the work of the gas, ½ m(x) ẋ² / (P₀ A y), at one point of the growth; NaN where undefined.

    m(x) is the moving mass, tail and payload, ẋ = r·ẏ. Source: Alvarez et al. (2025), section IV-D, with the moving
    mass of their Eq. (1).
    """
    work_J = trial.pressure_Pa * trial.area_m2 * lead_travel_m
    if not work_J > 0:
        return math.nan
    tail_velocity_m_s = trial.travel_ratio * lead_velocity_m_s
    return float(0.5 * trial.moving_mass_kg(lead_travel_m) * tail_velocity_m_s**2 / work_J)
