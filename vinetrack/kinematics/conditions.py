"""Replicates put together: what each condition gave, with errors, for whatever is to be set against size or payload.

The error of a mean is its standard error, from what replicates differ by; of a single trial it is what is known of
that trial, and nothing where nothing is. What all trials share (the scale, the yield pressure) is not in it: it moves
all conditions together.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from vinetrack.core.records import Floats, Trial
from vinetrack.kinematics.damping import LEAST_STEADY_SHARE
from vinetrack.kinematics.efficiency import efficiency_shares

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
    """A row a condition, columns `CONDITION_COLUMNS`, in the order of the sheet.

    Parameters
    ----------
    trials
        As in `trials.csv`; those that failed or were left out do not count.
    known
        The trials of the experiment, for their sizes.
    final_at_fraction, efficiency_at_mm
        Where the final speed and the efficiency of `trials` were taken.

    Returns
    -------
    DataFrame
        `x_ss_m_s` is NaN where less than half of a condition's trials were steady: the slower ones would stand for
        all. `efficiency` is ½ m(x) ẋ² / (P₀ A y), `efficiency_payload` counts the payload's motion alone, and
        `efficiency_with_weight` counts the work of the weight as spent; `weight_share` is that work over P₀ A y.
    """
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
    """Return the mean of the values that are known, its standard error, and their number.

    Parameters
    ----------
    values : shape (n,), any unit; NaN where unknown.
    sigmas : errors of single values, shape (n,); the error of the mean where only one value is known.

    Returns
    -------
    mean, standard error, number; NaN, NaN, 0 where nothing is known, and an error of NaN for a single value without
        one.
    """
    known = np.isfinite(values)
    count = int(known.sum())
    if count == 0:
        return math.nan, math.nan, 0
    mean = float(np.mean(values[known]))
    if count == 1:
        return mean, math.nan if sigmas is None else float(sigmas[known][0]), 1
    return mean, float(np.std(values[known], ddof=1)) / math.sqrt(count), count
