"""Trials of the paper's Figs. 4 and 5 held against Eq. (2) with the printed numbers, in the paper's own way."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pandas as pd

from vinetrack import published
from vinetrack.motion.conditions import mean_with_error
from vinetrack.motion.efficiency import lead_velocity_at
from vinetrack.paper.departures import NONE, WITHIN, follow
from vinetrack.records import Trial

POSITION_COLUMNS = ("condition", "pressure_kPa", "n_trials", "rms_mean_m", "rms_single_m", "floor_m")
SPEED_COLUMNS = (
    "condition",
    "vine",
    "pressure_kPa",
    "payload_g",
    "n_final",
    "final_at_mm",
    "final_lead_velocity_m_s",
    "final_lead_velocity_sigma_m_s",
    "eq2_lead_velocity_m_s",
)
MEAN_COLUMNS = ("pressure_kPa", "time_s", "lead_position_m", "lead_position_sigma_m", "n_trials")


def position_conditions(trials: Sequence[Trial]) -> dict[float, list[Trial]]:
    """Trials of Fig. 4, by pressure in kPa: the 24 mm × 200 µm vine with the paper's payload."""
    found: dict[float, list[Trial]] = {}
    for pressure_kPa in published.POSITION_RMS_CM:
        own = [trial for trial in trials if _is(trial, published.THICKNESS_UM[4], pressure_kPa, published.PAYLOAD_G)]
        if own:
            found[float(pressure_kPa)] = [trial for trial in own if trial.condition == own[0].condition]
    return found


def speed_conditions(trials: Sequence[Trial]) -> dict[str, list[Trial]]:
    """Trials of Fig. 5, by condition: 24 mm × 150 µm vines at the paper's pressures with any payload."""
    found: dict[str, list[Trial]] = {}
    for pressure_kPa in published.FINAL_SPEED_RMS_M_S:
        for trial in trials:
            if _is(trial, published.FINAL_SPEED_THICKNESS_UM, pressure_kPa) and trial.payload_kg > 0:
                found.setdefault(trial.condition, []).append(trial)
    return found


def _is(trial: Trial, thickness_um: float, pressure_kPa: float, payload_g: float | None = None) -> bool:
    pairs = [
        (1e3 * trial.diameter_m, published.DIAMETER_MM[4]),
        (1e6 * trial.thickness_m, thickness_um),
        (trial.pressure_Pa / 1e3, float(pressure_kPa)),
    ]
    if payload_g is not None:
        pairs.append((1e3 * trial.payload_kg, payload_g))
    return all(math.isclose(ours, printed, rel_tol=0.02) for ours, printed in pairs)


def mean_motions(conditions: Mapping[float, list[Trial]], moved: Mapping[str, pd.DataFrame]) -> pd.DataFrame:
    """The mean of the trials of each pressure since release, until the first ends, columns `MEAN_COLUMNS`.

    Parameters
    ----------
    conditions : as `position_conditions` finds them.
    moved : by condition, its trials as `comparison/CONDITION.csv` holds them.
    """
    parts = []
    for pressure_kPa, trials in conditions.items():
        table = moved.get(trials[0].condition)
        if table is None or not len(table):
            continue
        ends_s = table.groupby("trial")["time_s"].max()
        one = table[(table["trial"] == ends_s.idxmax()) & table["time_s"].between(0, ends_s.min())]
        parts.append(
            pd.DataFrame(
                {
                    "pressure_kPa": pressure_kPa,
                    "time_s": one["time_s"],
                    "lead_position_m": one["replicates_mean_m"],
                    "lead_position_sigma_m": one["replicates_sigma_m"],
                    "n_trials": table["trial"].nunique(),
                }
            )
        )
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=list(MEAN_COLUMNS), dtype=float)


def position_errors(
    conditions: Mapping[float, list[Trial]], means: pd.DataFrame, comparison: pd.DataFrame
) -> pd.DataFrame:
    """How far the mean of the trials lies from Eq. (2) with the printed B and n, columns `POSITION_COLUMNS`.

    Until Eq. (2) has grown to 95 % of the length, or the first trial ends, both since release. `rms_single_m` and
    `floor_m` are what `comparison.csv` says of single trials and the model that was fitted to them.
    """
    rows = []
    for pressure_kPa, trials in conditions.items():
        own = means[means["pressure_kPa"] == pressure_kPa]
        stated = comparison[comparison["condition"] == trials[0].condition]
        if not len(own) or not len(stated):
            continue
        plain = follow(trials[0], NONE, published.DAMPING_B[4])
        stop = int(np.searchsorted(plain.lead_position_m, WITHIN * trials[0].length_m))
        end_s = plain.time_s[min(stop, plain.time_s.size - 1)]
        own = own[own["time_s"] <= end_s]
        said_m = np.interp(own["time_s"], plain.time_s, plain.lead_position_m)
        rms_m = math.sqrt(float(np.mean((own["lead_position_m"] - said_m) ** 2)))
        single = stated.iloc[0]
        rows.append(
            (
                trials[0].condition,
                pressure_kPa,
                int(own["n_trials"].iloc[0]),
                rms_m,
                float(single["rms_position_m"]),
                float(single["replicate_floor_m"]),
            )
        )
    return pd.DataFrame(rows, columns=list(POSITION_COLUMNS))


def final_speeds(
    conditions: Mapping[str, list[Trial]], kinematics: Mapping[str, pd.DataFrame], origins_m: Mapping[str, float]
) -> pd.DataFrame:
    """Speed of the leading edge at the paper's 12 cm, means of trials, beside Eq. (2), columns `SPEED_COLUMNS`.

    Parameters
    ----------
    conditions : as `speed_conditions` finds them.
    kinematics : by trial, as `kinematics/TRIAL.csv` holds them.
    origins_m : by trial, where it was at rest.
    """
    rows = []
    at_m = published.FINAL_SPEED_AT_MM / 1e3
    for condition, trials in conditions.items():
        speeds = [
            lead_velocity_at(
                kinematics[trial.name]["lead_position_m"].to_numpy(float) - origins_m[trial.name],
                kinematics[trial.name]["lead_velocity_m_s"].to_numpy(float),
                at_m,
            )
            for trial in trials
            if trial.name in kinematics and trial.name in origins_m
        ]
        mean, sigma, count = mean_with_error(np.array(speeds, dtype=float))
        if count:
            one = trials[0]
            sizes = (condition, one.vine, one.pressure_Pa / 1e3, 1e3 * one.payload_kg)
            rows.append((*sizes, count, 1e3 * at_m, mean, sigma, eq2_speed_m_s(one)))
    return pd.DataFrame(rows, columns=list(SPEED_COLUMNS))


def eq2_speed_m_s(trial: Trial) -> float:
    """Speed of the leading edge at 12 cm by Eq. (2), B in proportion to the wall; 0 where it does not get there."""
    B = published.DAMPING_B[4] * 1e6 * trial.thickness_m / published.THICKNESS_UM[4]
    moved = follow(trial, NONE, B)
    speed = lead_velocity_at(moved.lead_position_m, moved.lead_velocity_m_s, published.FINAL_SPEED_AT_MM / 1e3)
    return speed if math.isfinite(speed) else 0.0


def speed_curves(conditions: Mapping[str, list[Trial]], instants: int = 15) -> pd.DataFrame:
    """Eq. (2) along payloads, from the least of each pressure to the largest, in the columns of `final_speeds`."""
    rows = []
    by_pressure: dict[float, list[Trial]] = {}
    for trials in conditions.values():
        by_pressure.setdefault(trials[0].pressure_Pa, []).append(trials[0])
    for pressure_Pa, trials in by_pressure.items():
        payloads_kg = [trial.payload_kg for trial in trials]
        for payload_kg in np.linspace(min(payloads_kg), max(payloads_kg), instants):
            speed = eq2_speed_m_s(replace(trials[0], payload_kg=float(payload_kg)))
            rows.append((trials[0].vine, pressure_Pa / 1e3, 1e3 * payload_kg, speed, math.nan))
    names = ["vine", "pressure_kPa", "payload_g", "final_lead_velocity_m_s", "final_lead_velocity_sigma_m_s"]
    return pd.DataFrame(rows, columns=names)
