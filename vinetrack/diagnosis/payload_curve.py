"""Final speed against payload as a fitted model has it, for the conditions that differ in payload alone.

The error is that of the fitted numbers, carried on through the model's own derivatives: what a mean of many trials
would deviate by, not what one trial does.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from vinetrack.core.records import Floats, Trial
from vinetrack.dynamics.simulate import Trajectory, simulate_many
from vinetrack.inference.fit_result import Fit, Number
from vinetrack.inference.parameters import YIELD_PRESSURE
from vinetrack.kinematics.conditions import lead_velocity_at

if TYPE_CHECKING:
    import pandas as pd

CURVE_COLUMNS = (
    "vine",
    "pressure_kPa",
    "payload_g",
    "final_at_mm",
    "final_lead_velocity_m_s",
    "final_lead_velocity_sigma_m_s",
)
PAYLOADS = 25
"""On each curve, evenly from the least payload to the largest. Chosen for the picture."""

LASTS = 2.0
"""How many times longer than the longest of its trials a curve's motions are followed. Chosen as a safeguard."""

INSTANTS = 801
"""Instants of a motion. Derived: linear interpolation then errs by 1e-6 of the growth."""

MARGIN = 1.05
"""By how much the instants outlast the arrival: a changed number may delay it. Chosen: fifty times STEP."""

STEP = 1e-3
"""Relative change of a number behind its derivative: far above the integrator's error, far below where it bends.
Derived: 1000 times the integrator's error."""


def payload_curves(fit: Fit, final_at_fraction: float) -> pd.DataFrame:
    """Final speed of the leading edge along payload, columns `CURVE_COLUMNS`; empty where payloads do not vary.

    Parameters
    ----------
    fit : a fit; its trials say which vines, pressures and payloads there are.
    final_at_fraction : float
        Fraction of the length at which the speed is taken.

    Returns
    -------
    DataFrame
    """
    import pandas as pd

    rows: list[tuple[object, ...]] = []
    for trials, lasts_s in _families(fit):
        at_m = final_at_fraction * trials[0].length_m
        speed, sigma = speeds_with_error(fit, trials, at_m, lasts_s)
        for trial, v, s in zip(trials, speed, sigma, strict=True):
            rows.append((trial.vine, trial.pressure_Pa / 1e3, 1e3 * trial.payload_kg, 1e3 * at_m, v, s))
    return pd.DataFrame(rows, columns=list(CURVE_COLUMNS))


def _families(fit: Fit) -> list[tuple[list[Trial], float]]:
    """Trials along the payload, for every vine and setting with more than one, and how long they may take, s."""
    alike: dict[str, list[tuple[float, float, Trial]]] = {}
    for fitted in fit.trials:
        trial = fitted.trial
        if math.isfinite(trial.length_m) and trial.pressure_Pa > 0:
            lasts_s = float(fitted.time_s[-1]) - fitted.release_s
            alike.setdefault(_but_for_payload(trial), []).append((trial.payload_kg, lasts_s, trial))
    families = []
    for seen in alike.values():
        payloads_kg = [load[0] for load in seen]
        low, high = min(payloads_kg), max(payloads_kg)
        if high > low:
            trials = [replace(seen[0][2], payload_kg=float(kg)) for kg in np.linspace(low, high, PAYLOADS)]
            families.append((trials, LASTS * max(load[1] for load in seen)))
    return families


def _but_for_payload(trial: Trial) -> str:
    """All that a motion depends on but the payload, as text: NaN equals nothing, itself included."""
    nan = math.nan
    bare = replace(trial, name="", condition="", video=None, track=None, pressure_trace=None, payload_kg=0.0)
    return repr(replace(bare, capture_fps=nan, exposure_s=nan, m_per_px=nan, steady_window_s=None))


def speeds_with_error(fit: Fit, trials: Sequence[Trial], at_m: float, lasts_s: float) -> tuple[Floats, Floats]:
    """Speed of the leading edge at `at_m` of growth and its standard error, m/s, shape (n_trials,) each.

    Trials of one vine. A motion that does not get there has speed 0.

    Parameters
    ----------
    fit : a fit.
    trials : sequence of Trial
        Of one vine.
    at_m : float
        Growth at which the speed is taken, m.
    lasts_s : float
        Growth is followed for so long, s.

    Returns
    -------
    speed, sigma : arrays, shape (n_trials,), m/s

    Raises
    ------
    ValueError
        If the speeds do not depend smoothly on the fitted numbers.
    """
    vine = trials[0].vine
    instants = _around_arrival(fit, trials, at_m, lasts_s)
    middle = _speeds(fit, trials, None, at_m, instants)
    felt = [i for i, number in enumerate(fit.numbers) if _concerns(number, trials[0])]
    slopes = np.zeros((len(felt), len(trials)))
    for row, i in enumerate(felt):
        number = fit.numbers[i]
        step = STEP * (abs(number.value) or 1.0)
        up, down = (
            _speeds(fit, trials, replace(number, value=number.value + sign * step), at_m, instants) for sign in (1, -1)
        )
        slopes[row] = (up - down) / (2 * step)
    covariance = np.nan_to_num(np.asarray(fit.covariance, dtype=float)[np.ix_(felt, felt)])
    variance = np.einsum("it,ij,jt->t", slopes, covariance, slopes)
    if not np.isfinite(variance).all():
        raise ValueError(f"the speeds of {vine} do not depend smoothly on the fitted numbers")
    return middle, np.sqrt(np.maximum(variance, 0.0))


def _concerns(number: Number, trial: Trial) -> bool:
    """Whether a number is one of this trial's: common to all, of its vine, or of its vine at its stated P_y."""
    stated = f"{trial.vine}, {trial.yield_pressure_Pa / 1e3:g} kPa"
    return number.vine in ("", trial.vine, stated)


def _around_arrival(fit: Fit, trials: Sequence[Trial], at_m: float, lasts_s: float) -> list[Floats]:
    """For each trial, instants from release to a little after it gets to `at_m`; to the end where it does not."""
    whole = [lasts_s * np.linspace(0, 1, INSTANTS)] * len(trials)
    ends = []
    for run in _runs(fit, trials, None, whole):
        there = np.flatnonzero(run.lead_position_m >= at_m)
        ends.append(run.time_s[there[0]] if there.size else lasts_s)
    return [MARGIN * end_s * np.linspace(0, 1, INSTANTS) for end_s in ends]


def _speeds(
    fit: Fit, trials: Sequence[Trial], changed: Number | None, at_m: float, instants: Sequence[Floats]
) -> Floats:
    runs = _runs(fit, trials, changed, instants)
    speeds = [lead_velocity_at(run.lead_position_m, run.lead_velocity_m_s, at_m) for run in runs]
    return np.nan_to_num(np.array(speeds))


def _runs(fit: Fit, trials: Sequence[Trial], changed: Number | None, instants: Sequence[Floats]) -> list[Trajectory]:
    """Motions with the fitted numbers, but for one that was changed."""
    theta = np.tile(fit.model.parameters_of(trials[0]), (len(trials), 1))
    moved = list(trials)
    for number in (*fit.numbers, *([changed] if changed is not None else [])):
        if number.key == YIELD_PRESSURE and _concerns(number, trials[0]):
            moved = [replace(trial, yield_pressure_Pa=number.value) for trial in moved]
    if changed is not None and changed.key != YIELD_PRESSURE:
        theta[:, fit.model.parameter_names.index(changed.key)] = changed.value
    return simulate_many(fit.model, moved, instants, parameters=theta)
