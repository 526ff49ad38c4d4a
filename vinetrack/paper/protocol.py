"""Rows of the table about the protocol: the vines of Table I, their fabrication, and how trials were run."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
import pandas as pd

from vinetrack.core import published
from vinetrack.core.records import Floats, Trial
from vinetrack.kinematics.summary import lead_velocity_at, mean_with_error
from vinetrack.paper.arithmetic import NONE, NOT_CHECKABLE, SIMULATED, WITHIN, PaperRow, follow


def protocol_rows(trials: Sequence[Trial], steady: pd.DataFrame, mark: str) -> Iterator[PaperRow]:
    """Compare the protocol of an experiment with that of the paper."""
    source = "an input: the virtual trials were grown with it" if mark == SIMULATED else "as the trial sheet says"
    bare = [trial for trial in trials if trial.payload_kg == 0 and trial.travel_ratio == 2]
    by_scale = {
        scale: [t for t in bare if published.scale_of(1e3 * t.diameter_m, 1e6 * t.thickness_m) == scale]
        for scale in published.DAMPING_B
    }
    for scale, of_scale in by_scale.items():
        yield from _size_rows(scale, of_scale, mark, source)
    for scale, of_scale in by_scale.items():
        yield from _campaign_rows(scale, of_scale, mark, source)
    yield _capture_row(trials, mark, source)
    yield from _window_rows({trial.name for of_scale in by_scale.values() for trial in of_scale}, steady, mark)


def _size_rows(scale: int, of_scale: Sequence[Trial], mark: str, source: str) -> Iterator[PaperRow]:
    sizes = (
        ("thickness", "wall thickness", "µm", published.THICKNESS_UM, [1e6 * trial.thickness_m for trial in of_scale]),
        ("diameter", "diameter", "mm", published.DIAMETER_MM, [1e3 * trial.diameter_m for trial in of_scale]),
    )
    for name, quantity, unit, printed, ours in sizes:
        yield PaperRow(
            row=f"{name}_R{scale}",
            where="Table I",
            quantity=quantity,
            setting=f"R = {scale}",
            unit=unit,
            published=printed[scale],
            ours=float(np.mean(ours)) if ours else math.nan,
            mark=mark,
            how=source,
        )
    settings = (
        ("press", "temperature of the heat press", "°C", published.PRESS_TEMPERATURE_DEGC),
        ("laser", "power of the laser cutter", "%", published.LASER_POWER_PERCENT),
    )
    for name, quantity, unit, printed in settings:
        yield PaperRow(
            row=f"{name}_R{scale}",
            where="Table I",
            quantity=quantity,
            setting=f"R = {scale}",
            unit=unit,
            published=printed[scale],
            mark=NOT_CHECKABLE,
            how="a setting of the authors' machines; nothing follows from it",
        )


def _campaign_rows(scale: int, of_scale: Sequence[Trial], mark: str, source: str) -> Iterator[PaperRow]:
    pressures: dict[float, int] = {}
    for trial in of_scale:
        pressures[round(trial.pressure_Pa, 3)] = pressures.get(round(trial.pressure_Pa, 3), 0) + 1
    low, high = published.CONDITIONS
    yield PaperRow(
        row=f"pressures_R{scale}",
        where="Section III-D",
        quantity="pressures without payload",
        setting=f"R = {scale}",
        as_printed=f"{low} to {high}",
        ours=float(len(pressures)) if of_scale else math.nan,
        mark=mark,
        how=f"{source}; which pressures is not printed",
    )
    low, high = published.TRIALS
    yield PaperRow(
        row=f"trials_R{scale}",
        where="Section III-D",
        quantity="trials of each pressure",
        setting=f"R = {scale}",
        as_printed=f"{low} to {high}",
        ours=float(np.median(list(pressures.values()))) if of_scale else math.nan,
        mark=mark,
        how=source,
    )


def _capture_row(trials: Sequence[Trial], mark: str, source: str) -> PaperRow:
    rates = [trial.capture_fps for trial in trials if math.isfinite(trial.capture_fps)]
    return PaperRow(
        row="capture_fps",
        where="Section III-D",
        quantity="frames a second",
        unit="1/s",
        published=published.CAPTURE_FPS,
        ours=float(np.median(rates)) if rates else math.nan,
        mark=mark,
        how=source,
    )


def _window_rows(names: set[str], steady: pd.DataFrame, mark: str) -> Iterator[PaperRow]:
    """What the published rule for a steady window accepts in trials without payload, and the gated rule."""
    windows = steady[steady["trial"].isin(names)]
    literal, gated = windows[windows["rule"] == "paper"], windows[windows["rule"] == "gated"]
    accepted = literal[literal["accepted"]]
    drift = accepted["drift"].abs()
    row_of = partial(PaperRow, where="Section III-E", setting="trials of R = 1…4 without payload", mark=mark)
    yield row_of(
        row="window_fewest_points",
        quantity="fewest points in a steady window",
        as_printed=f"at least {published.STEADY_FEWEST_POINTS}",
        ours=float(accepted["points"].min()) if len(accepted) else math.nan,
        how=f"the published rule to the letter, N = {len(accepted)} windows",
        beside="noise alone makes three velocities in a row agree to 3 % somewhere",
    )
    yield row_of(
        row="window_largest_cv",
        quantity="largest coefficient of variation of velocity in a steady window",
        unit="%",
        published=100 * published.STEADY_CV,
        as_printed=f"below {100 * published.STEADY_CV:g}",
        ours=100 * float(accepted["cv"].max()) if len(accepted) else math.nan,
        how="the published rule to the letter",
        beside=f"a speed may drift within it: by up to {100 * drift.max():.1f} % across the window"
        if len(drift)
        else "",
    )
    yield row_of(
        row="window_share_accepted",
        quantity="trials in which the published rule finds a steady window",
        unit="%",
        as_printed="not printed",
        ours=100 * float(literal["accepted"].mean()) if len(literal) else math.nan,
        how="chosen by hand there, the longest run here",
        beside=f"the gated rule finds one in {100 * gated['accepted'].mean():.0f} %" if len(gated) else "",
    )


# ------------------------------------------------------------------------------
# Comparison of the trials of the paper's Figs. 4 and 5 with Eq. (2) and the printed numbers, by the paper's method.

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
