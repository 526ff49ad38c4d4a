"""What comes out at the end: the final speed, and how much of the gas's work became motion."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from vinetrack.core.constants import GRAVITY_M_S2
from vinetrack.core.records import Floats, Trial


def lead_velocity_at(lead_position_m: Floats, lead_velocity_m_s: Floats, target_m: float) -> float:
    """Return the velocity with which the leading edge first passes a position, linear in position between points.

    Both arrays have shape (n,), travel counted from rest; between points the velocity is interpolated linearly in
    position.

    Parameters
    ----------
    lead_position_m : travel from rest, shape (n,), m.
    lead_velocity_m_s : shape (n,), m/s.
    target_m : travel from rest, m.

    Returns
    -------
    m/s; NaN where the edge never gets there, or is beyond at the first point.
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

    Parameters
    ----------
    trial : its pressure, size and payload.
    lead_travel_m : growth y since release, m.
    lead_velocity_m_s : ẏ there, m/s.

    Returns
    -------
    a fraction.
    """
    work_J = trial.pressure_Pa * trial.area_m2 * lead_travel_m
    if not work_J > 0:
        return math.nan
    tail_velocity_m_s = trial.travel_ratio * lead_velocity_m_s
    return float(0.5 * trial.moving_mass_kg(lead_travel_m) * tail_velocity_m_s**2 / work_J)


class EfficiencyShares(NamedTuple):
    """What turns an efficiency ½ m(x) ẋ² / (P₀ A y) into its variants: all are the same speed, counted differently.

    `payload` is the payload's part of the moving mass, so that efficiency × `payload` counts the payload alone;
    `weight` the work of the weight over that of the gas, so that efficiency / (1 + `weight`) counts both as spent.
    """

    payload: float
    weight: float


def efficiency_shares(trial: Trial, lead_travel_m: float) -> EfficiencyShares:
    """The payload's share of the moving mass, and the weight's share of the work, after `lead_travel_m` of growth.

    The weight works on tail and payload along the tail's own travel x = r·y: g cosθ ∫ m dx, the third term of Eq. (2)
    of Alvarez et al. (2025). NaN where there is no mass, or no work.

    Parameters
    ----------
    trial : its pressure, size, payload and angle.
    lead_travel_m : growth y since release, m.

    Returns
    -------
    two fractions.
    """
    mass_kg = float(trial.moving_mass_kg(lead_travel_m))
    gas_J = trial.pressure_Pa * trial.area_m2 * lead_travel_m
    weight_J = GRAVITY_M_S2 * math.cos(trial.growth_angle_rad) * _mass_along(trial, trial.travel_ratio * lead_travel_m)
    return EfficiencyShares(
        payload=trial.payload_kg / mass_kg if mass_kg > 0 else math.nan,
        weight=weight_J / gas_J if gas_J > 0 else math.nan,
    )


def _mass_along(trial: Trial, tail_travel_m: float) -> float:
    """∫ m(x) dx from the release, kg·m: the film runs out in a straight line, until none is left."""
    film_kg = trial.linear_density_kg_m * (trial.length_m if math.isfinite(trial.length_m) else 0.0)
    loss_kg_m = trial.mass_loss_kg_m
    until_m = min(tail_travel_m, film_kg / loss_kg_m) if loss_kg_m > 0 else tail_travel_m
    return trial.payload_kg * tail_travel_m + film_kg * until_m - 0.5 * loss_kg_m * until_m**2
