"""Means over replicates of each condition with standard errors: steady speed, final speed, efficiency.

The standard error of a mean comes from the replicate scatter; for a single trial it is the error of that trial, NaN
where unknown. Systematic errors that all trials share (scale, yield pressure) are not included: they change all
conditions together.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vinetrack.core.constants import GRAVITY_M_S2
from vinetrack.core.records import Floats, Trial
from vinetrack.kinematics.damping import LEAST_STEADY_SHARE

if TYPE_CHECKING:
    import pandas as pd

CONDITION_COLUMNS = (
    "condition",
    "vine",
    "diameter_mm",
    "thickness_um",
    "length_mm",
    "pressure_kPa",
    "payload_g",
    "growth_angle_deg",
    "n_trials",
    "n_steady",
    "x_ss_m_s",
    "x_ss_sigma_m_s",
    "x_ss_over_diameter_1_s",
    "x_ss_over_diameter_sigma_1_s",
    "n_final",
    "final_at_mm",
    "final_lead_velocity_m_s",
    "final_lead_velocity_sigma_m_s",
    "n_efficiency",
    "efficiency_at_mm",
    "efficiency",
    "efficiency_sigma",
    "efficiency_payload",
    "efficiency_payload_sigma",
    "efficiency_with_weight",
    "efficiency_with_weight_sigma",
    "weight_share",
)


def condition_table(
    trials: pd.DataFrame, known: Sequence[Trial], *, final_at_fraction: float, efficiency_at_mm: float
) -> pd.DataFrame:
    """Return a row for each condition, columns `CONDITION_COLUMNS`, in the order of the sheet."""
    import pandas as pd

    measured = trials[trials["status"].isin(["ok", "warning"])]
    by_condition: dict[str, list[Trial]] = {}
    for trial in known:
        by_condition.setdefault(trial.condition, []).append(trial)
    tables = {name: group.set_index("trial") for name, group in measured.groupby("condition", sort=False)}
    rows = [
        _row(members[0], tables[condition], final_at_fraction, efficiency_at_mm)
        for condition, members in by_condition.items()
        if condition in tables
    ]
    return pd.DataFrame(rows, columns=list(CONDITION_COLUMNS))


def _row(trial: Trial, group: pd.DataFrame, final_at_fraction: float, efficiency_at_mm: float) -> dict[str, object]:
    steady = _steady(group)
    final, final_sigma, n_final = mean_with_error(group["final_lead_velocity_m_s"].to_numpy(float))
    diameter_m = trial.diameter_m
    return {
        "condition": trial.condition,
        "vine": trial.vine,
        "diameter_mm": 1e3 * trial.diameter_m,
        "thickness_um": 1e6 * trial.thickness_m,
        "length_mm": 1e3 * trial.length_m,
        "pressure_kPa": 1e-3 * trial.pressure_Pa,
        "payload_g": 1e3 * trial.payload_kg,
        "growth_angle_deg": math.degrees(trial.growth_angle_rad),
        "n_trials": len(group),
        **steady,
        "x_ss_over_diameter_1_s": steady["x_ss_m_s"] / diameter_m,
        "x_ss_over_diameter_sigma_1_s": steady["x_ss_sigma_m_s"] / diameter_m,
        "n_final": n_final,
        "final_at_mm": 1e3 * final_at_fraction * trial.length_m,
        "final_lead_velocity_m_s": final,
        "final_lead_velocity_sigma_m_s": final_sigma,
        **_efficiencies(trial, group["efficiency"].to_numpy(float), efficiency_at_mm),
    }


def _steady(group: pd.DataFrame) -> Mapping[str, float]:
    speeds, sigmas = (group[name].to_numpy(float) for name in ("x_ss_m_s", "x_ss_sigma_m_s"))
    mean, sigma, count = mean_with_error(speeds, sigmas)
    if count < LEAST_STEADY_SHARE * len(group):
        mean = sigma = math.nan
    return {"n_steady": count, "x_ss_m_s": mean, "x_ss_sigma_m_s": sigma}


def _efficiencies(trial: Trial, values: Floats, at_mm: float) -> dict[str, object]:
    mean, sigma, count = mean_with_error(values)
    shares = efficiency_shares(trial, at_mm / 1e3)
    row: dict[str, object] = {"n_efficiency": count, "efficiency_at_mm": at_mm if count else math.nan}
    for name, factor in (("", 1.0), ("_payload", shares.payload), ("_with_weight", 1 / (1 + shares.weight))):
        row[f"efficiency{name}"] = mean * factor
        row[f"efficiency{name}_sigma"] = sigma * factor
    return row | {"weight_share": shares.weight if count else math.nan}


def mean_with_error(values: Floats, sigmas: Floats | None = None) -> tuple[float, float, int]:
    """Return the mean of the known values, its standard error, and their number. Returns mean, standard error, number;
    NaN, NaN, 0 without known values, and an error of NaN for a single value without one. Shapes: values, sigmas (n,).
    """
    known = np.isfinite(values)
    count = int(known.sum())
    if count == 0:
        return math.nan, math.nan, 0
    mean = float(np.mean(values[known]))
    if count == 1:
        return mean, math.nan if sigmas is None else float(sigmas[known][0]), 1
    return mean, float(np.std(values[known], ddof=1)) / math.sqrt(count), count


def lead_velocity_at(lead_position_m: Floats, lead_velocity_m_s: Floats, target_m: float) -> float:
    """Return the velocity with which the leading edge first passes a position, interpolated linearly in position.
    Shapes: lead_position_m, lead_velocity_m_s (n,).
    """
    beyond = np.flatnonzero(lead_position_m >= target_m)
    if beyond.size == 0 or beyond[0] == 0:
        return math.nan
    i = int(beyond[0])
    span_m = lead_position_m[i] - lead_position_m[i - 1]
    part = (target_m - lead_position_m[i - 1]) / span_m if span_m > 0 else 0.0
    return float(lead_velocity_m_s[i - 1] + part * (lead_velocity_m_s[i] - lead_velocity_m_s[i - 1]))


def energy_efficiency(trial: Trial, lead_travel_m: float, lead_velocity_m_s: float) -> float:
    """Return the ratio of kinetic energy to work of the gas, ½ m(x) ẋ² / (P₀ A y), at one point of the growth. m(x) is
    the moving mass of tail and payload, ẋ = r·ẏ. NaN where there is no work. Source: Alvarez et al. (2025), section
    IV-D, with the moving mass of their Eq. (1).
    """
    work_J = trial.pressure_Pa * trial.area_m2 * lead_travel_m
    if not work_J > 0:
        return math.nan
    tail_velocity_m_s = trial.travel_ratio * lead_velocity_m_s
    return float(0.5 * trial.moving_mass_kg(lead_travel_m) * tail_velocity_m_s**2 / work_J)


class EfficiencyShares(NamedTuple):
    """Factors that turn an efficiency ½ m(x) ẋ² / (P₀ A y) into its variants. `payload` is the payload's fraction of
    the moving mass: efficiency × `payload` is that of the payload alone. `weight` is the work of the weight over that
    of the gas: efficiency / (1 + `weight`) counts both as work.
    """

    payload: float
    weight: float


def efficiency_shares(trial: Trial, lead_travel_m: float) -> EfficiencyShares:
    """Return the payload's fraction of the moving mass, and the work of the weight over that of the gas. The weight
    does work on tail and payload along the travel of the tail x = r·y: g cosθ ∫ m dx, the third term of Eq. (2) of
    Alvarez et al. (2025). NaN where there is no mass, or no work.
    """
    mass_kg = float(trial.moving_mass_kg(lead_travel_m))
    gas_J = trial.pressure_Pa * trial.area_m2 * lead_travel_m
    weight_J = GRAVITY_M_S2 * math.cos(trial.growth_angle_rad) * _mass_along(trial, trial.travel_ratio * lead_travel_m)
    return EfficiencyShares(
        payload=trial.payload_kg / mass_kg if mass_kg > 0 else math.nan,
        weight=weight_J / gas_J if gas_J > 0 else math.nan,
    )


def _mass_along(trial: Trial, tail_travel_m: float) -> float:
    """∫ m(x) dx from the release, kg·m: the mass of film decreases linearly until none is left."""
    film_kg = trial.linear_density_kg_m * (trial.length_m if math.isfinite(trial.length_m) else 0.0)
    loss_kg_m = trial.mass_loss_kg_m
    until_m = min(tail_travel_m, film_kg / loss_kg_m) if loss_kg_m > 0 else tail_travel_m
    return trial.payload_kg * tail_travel_m + film_kg * until_m - 0.5 * loss_kg_m * until_m**2
