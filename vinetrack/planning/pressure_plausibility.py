"""Check of stated pressures against measured speeds, for errors of unit.

The damping coefficient that a trial implies, B = (P − P_y) A / (2 ẏ)ⁿ with the printed n, is compared with the scaling
prior (`planning.predictive_inputs`). A pressure in psi stated as kPa is 6.9 times too low, and P − P_y by even
more.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np

from vinetrack.core import published
from vinetrack.core.problems import Problem
from vinetrack.core.records import Trial
from vinetrack.core.units import convert, number
from vinetrack.planning.predictive_inputs import damping_prior

FAR_OFF = 4.0  # Factor between implied and prior damping from which another unit is tried (chosen)

NEAR = 2.5  # Factor to the prior within which the other unit explains the speeds (chosen)


def implied_ratio(trial: Trial, mean_speed_m_s: float, pressure_Pa: float, yield_pressure_Pa: float) -> float:
    """Return the damping coefficient that a trial implies over its scaling prior; NaN without growth or drive."""
    drive_N = (pressure_Pa - yield_pressure_Pa) * trial.area_m2
    if not (drive_N > 0 and mean_speed_m_s > 0 and math.isfinite(mean_speed_m_s)):
        return math.nan
    damping = drive_N / (trial.travel_ratio * mean_speed_m_s) ** published.EXPONENT
    return damping / damping_prior(trial.diameter_m, trial.thickness_m)


def pressure_problems(speeds: Iterable[tuple[Trial, float]]) -> list[Problem]:
    """Return a warning if the speeds contradict the pressures as stated but agree with them in another unit. The other
    unit is psi, kPa where psi are stated, or absolute instead of gauge pressure.
    """
    pairs = [(trial, speed) for trial, speed in speeds if trial.travel_ratio == 2 and trial.pressure_trace is None]
    as_stated = _middle_ratio(pairs, 1.0, 1.0)
    if not (as_stated < 1 / FAR_OFF or as_stated > FAR_OFF):
        return []
    place: dict[str, Any] = {"file": "trials.csv", "column": "pressure_kPa", "severity": "warning"}
    gauge = [(replace(each, pressure_Pa=each.pressure_Pa - each.ambient_pressure_Pa), speed) for each, speed in pairs]
    less = _middle_ratio(gauge, 1.0, 1.0)
    if 1 / NEAR < less < NEAR and all(trial.pressure_Pa > 0 for trial, _ in gauge):
        message = (
            f"looks like absolute pressure: the measured speeds imply {number(as_stated, 2)} times the damping of tubes"
            f" of this size, and {number(less, 2)} times after the ambient pressure is subtracted"
        )
        return [Problem(message=message, remedy="state gauge pressure, relative to the ambient pressure", **place)]
    psi = convert(1.0, "psi", "kPa")
    factor, wrong = (psi, "psi, not kPa") if as_stated < 1 else (1 / psi, "kPa, not psi")
    for yield_factor in (1.0, factor):
        converted = _middle_ratio(pairs, factor, yield_factor)
        if 1 / NEAR < converted < NEAR:
            message = (
                f"looks like {wrong} (1 psi is {psi:.4g} kPa): the measured speeds imply {number(as_stated, 2)} times "
                f"the damping of tubes of this size, and {number(converted, 2)} times in the other unit"
            )
            remedy = "name the column pressure_psi" if factor > 1 else "name the column pressure_kPa"
            return [Problem(message=message, remedy=remedy, **place)]
    return []


def _middle_ratio(pairs: list[tuple[Trial, float]], factor: float, yield_factor: float) -> float:
    """Median over the trials of `implied_ratio`, pressures multiplied by `factor`; NaN where no trial has a ratio. A
    trial that moves although the pressure does not exceed the yield pressure counts as a ratio of 0.
    """
    ratios = []
    for trial, speed in pairs:
        ratio = implied_ratio(trial, speed, factor * trial.pressure_Pa, yield_factor * trial.yield_pressure_Pa)
        ratios.append(0.0 if math.isnan(ratio) and speed > 0 else ratio)
    known = [ratio for ratio in ratios if math.isfinite(ratio)]
    return float(np.median(known)) if known else math.nan
