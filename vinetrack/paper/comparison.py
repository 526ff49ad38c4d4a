"""Comparison of the trials of the paper's Figs. 4 and 5 with Eq. (2) and the printed numbers, by the paper's method."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pandas as pd

from vinetrack.core import published
from vinetrack.core.records import Floats, Trial
from vinetrack.kinematics.conditions import lead_velocity_at, mean_with_error
from vinetrack.paper.departures import NONE, WITHIN, follow

POSITION_COLUMNS = ("condition", "pressure_kPa", "n_trials", "rms_mean_m", "rms_single_m")
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


class Rest(NamedTuple):
    """Release time of a trial, on the clock of its track, and resting position of its edge."""

    release_s: float
    origin_m: float


def position_conditions(trials: Sequence[Trial]) -> dict[float, list[Trial]]:
    """Find the trials of Fig. 4, by pressure in kPa: the 24 mm × 200 µm vine with the paper's payload. Returns trials
    of one condition each, by pressure in kPa.
    """
    conditions: dict[float, list[Trial]] = {}
    for pressure_kPa in published.POSITION_RMS_CM:
        alike = [trial for trial in trials if _is(trial, published.THICKNESS_UM[4], pressure_kPa, published.PAYLOAD_G)]
        if alike:
            conditions[float(pressure_kPa)] = [trial for trial in alike if trial.condition == alike[0].condition]
    return conditions


def speed_conditions(trials: Sequence[Trial]) -> dict[str, list[Trial]]:
    """Find the trials of Fig. 5, by condition: 24 mm × 150 µm vines at the paper's pressures with any payload. Returns
    trials by condition.
    """
    conditions: dict[str, list[Trial]] = {}
    for pressure_kPa in published.FINAL_SPEED_RMS_M_S:
        for trial in trials:
            if _is(trial, published.FINAL_SPEED_THICKNESS_UM, pressure_kPa) and trial.payload_kg > 0:
                conditions.setdefault(trial.condition, []).append(trial)
    return conditions


def _is(trial: Trial, thickness_um: float, pressure_kPa: float, payload_g: float | None = None) -> bool:
    pairs = [
        (1e3 * trial.diameter_m, published.DIAMETER_MM[4]),
        (1e6 * trial.thickness_m, thickness_um),
        (trial.pressure_Pa / 1e3, float(pressure_kPa)),
    ]
    if payload_g is not None:
        pairs.append((1e3 * trial.payload_kg, payload_g))
    return all(math.isclose(ours, printed, rel_tol=0.02) for ours, printed in pairs)


def mean_motions(
    conditions: Mapping[float, list[Trial]], kinematics: Mapping[str, pd.DataFrame], rests: Mapping[str, Rest]
) -> pd.DataFrame:
    """Average the trials of each pressure since release, columns `MEAN_COLUMNS`, until the first has grown to 95 %. The
    release comes from a fit in which each trial has its own pressure and B. With one B for all, the release of a trial
    would absorb its deviation of speed.
    """
    parts = []
    for pressure_kPa, trials in conditions.items():
        time_s, laid_m = _since_release(trials, kinematics, rests)
        if not len(laid_m):
            continue
        sigma_m = np.std(laid_m, axis=0, ddof=1) if len(laid_m) > 1 else np.full(time_s.size, math.nan)
        columns = (pressure_kPa, time_s, laid_m.mean(axis=0), sigma_m, len(laid_m))
        parts.append(pd.DataFrame(dict(zip(MEAN_COLUMNS, columns, strict=True))))
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=list(MEAN_COLUMNS), dtype=float)


def _since_release(
    trials: Sequence[Trial], kinematics: Mapping[str, pd.DataFrame], rests: Mapping[str, Rest]
) -> tuple[Floats, Floats]:
    """Common times since release, shape (n,), and positions from rest, shape (n_trials, n), of those that are known."""
    motions = []
    for trial in trials:
        if trial.name in kinematics and trial.name in rests:
            start, table = rests[trial.name], kinematics[trial.name]
            grown_m = table["lead_position_m"].to_numpy(float) - start.origin_m
            time_s, known = table["time_s"].to_numpy(float) - start.release_s, np.isfinite(grown_m)
            beyond = np.flatnonzero(known & (grown_m >= WITHIN * trial.length_m))
            stop = int(beyond[0]) + 1 if beyond.size else grown_m.size
            motions.append((time_s[:stop][known[:stop]], grown_m[:stop][known[:stop]]))
    if not motions:
        return np.empty(0), np.empty((0, 0))
    end_s = min(float(time_s[-1]) for time_s, _ in motions)
    common_s = np.arange(0, end_s, 1 / published.CAPTURE_FPS)
    return common_s, np.array([np.interp(common_s, *motion) for motion in motions])


def position_errors(
    conditions: Mapping[float, list[Trial]], kinematics: Mapping[str, pd.DataFrame], rests: Mapping[str, Rest]
) -> pd.DataFrame:
    """Compare positions with Eq. (2) and the printed B and n, of the mean and of single trials (`POSITION_COLUMNS`).
    From release until Eq. (2) or the first trial has grown to 95 %; parameters as those of `mean_motions`.
    """
    rows = []
    for pressure_kPa, trials in conditions.items():
        time_s, laid_m = _since_release(trials, kinematics, rests)
        if not len(laid_m):
            continue
        plain = follow(trials[0], NONE, published.DAMPING_B[4])
        stop = int(np.searchsorted(plain.lead_position_m, WITHIN * trials[0].length_m))
        counts = time_s <= plain.time_s[min(stop, plain.time_s.size - 1)]
        off_m = (laid_m - np.interp(time_s, plain.time_s, plain.lead_position_m))[:, counts]
        mean_m, single_m = (math.sqrt(float(np.mean(np.square(part_m)))) for part_m in (off_m.mean(axis=0), off_m))
        rows.append((trials[0].condition, pressure_kPa, len(laid_m), mean_m, single_m))
    return pd.DataFrame(rows, columns=list(POSITION_COLUMNS))


def final_speeds(
    conditions: Mapping[str, list[Trial]], kinematics: Mapping[str, pd.DataFrame], rests: Mapping[str, Rest]
) -> pd.DataFrame:
    """Average the speed of the leading edge at the paper's 12 cm, and compute it by Eq. (2), columns
    `SPEED_COLUMNS`.
    """
    rows = []
    at_m = published.FINAL_SPEED_AT_MM / 1e3
    for condition, trials in conditions.items():
        speeds = [
            lead_velocity_at(
                kinematics[trial.name]["lead_position_m"].to_numpy(float) - rests[trial.name].origin_m,
                kinematics[trial.name]["lead_velocity_m_s"].to_numpy(float),
                at_m,
            )
            for trial in trials
            if trial.name in kinematics and trial.name in rests
        ]
        mean, sigma, count = mean_with_error(np.array(speeds, dtype=float))
        if count:
            first = trials[0]
            sizes = (condition, first.vine, first.pressure_Pa / 1e3, 1e3 * first.payload_kg)
            rows.append((*sizes, count, 1e3 * at_m, mean, sigma, eq2_speed_m_s(first)))
    return pd.DataFrame(rows, columns=list(SPEED_COLUMNS))


def eq2_speed_m_s(trial: Trial) -> float:
    """Return the speed of the leading edge at 12 cm by Eq. (2), B proportional to the wall; 0 where not reached."""
    B = published.DAMPING_B[4] * 1e6 * trial.thickness_m / published.THICKNESS_UM[4]
    moved = follow(trial, NONE, B)
    speed = lead_velocity_at(moved.lead_position_m, moved.lead_velocity_m_s, published.FINAL_SPEED_AT_MM / 1e3)
    return speed if math.isfinite(speed) else 0.0


def speed_curves(conditions: Mapping[str, list[Trial]], instants: int = 15) -> pd.DataFrame:
    """Compute Eq. (2) over the range of payloads of each pressure, in the columns of `final_speeds`."""
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
