"""Final speed against payload as a fitted model predicts it, for conditions that differ only in payload.

The standard error is propagated from the fitted parameters through numerical derivatives of the model: it is that of
the mean of many trials, without the scatter of single trials.
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
from vinetrack.kinematics.summary import lead_velocity_at

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
PAYLOADS = 25  # Points on each curve, evenly spaced from the smallest payload to the largest (chosen)

TIME_FACTOR = 2.0  # Time for which motions are simulated, as a multiple of the longest of their trials (chosen)

N_TIMES = 801  # Output times of a motion (derived)

# Factor by which the output times extend beyond the arrival, which a changed parameter may delay (chosen)
ARRIVAL_MARGIN = 1.05

RELATIVE_STEP = 1e-3  # Relative finite-difference step of a parameter (derived)


def payload_curves(fit: Fit, final_at_fraction: float) -> pd.DataFrame:
    """Final speed of the leading edge against payload, columns `CURVE_COLUMNS`; empty where payloads do not vary."""
    import pandas as pd

    rows: list[tuple[object, ...]] = []
    for trials, longest_s in _families(fit):
        at_m = final_at_fraction * trials[0].length_m
        speed, sigma = speeds_with_error(fit, trials, at_m, longest_s)
        for trial, v, s in zip(trials, speed, sigma, strict=True):
            rows.append((trial.vine, trial.pressure_Pa / 1e3, 1e3 * trial.payload_kg, 1e3 * at_m, v, s))
    return pd.DataFrame(rows, columns=list(CURVE_COLUMNS))


def _families(fit: Fit) -> list[tuple[list[Trial], float]]:
    """Trials at evenly spaced payloads for every vine and setting with several, and the longest simulated time, s."""
    by_setting: dict[str, list[tuple[float, float, Trial]]] = {}
    for fitted in fit.trials:
        trial = fitted.trial
        if math.isfinite(trial.length_m) and trial.pressure_Pa > 0:
            longest_s = float(fitted.time_s[-1]) - fitted.release_s
            by_setting.setdefault(_but_for_payload(trial), []).append((trial.payload_kg, longest_s, trial))
    families = []
    for same_setting in by_setting.values():
        payloads_kg = [load[0] for load in same_setting]
        low, high = min(payloads_kg), max(payloads_kg)
        if high > low:
            trials = [replace(same_setting[0][2], payload_kg=float(kg)) for kg in np.linspace(low, high, PAYLOADS)]
            families.append((trials, TIME_FACTOR * max(load[1] for load in same_setting)))
    return families


def _but_for_payload(trial: Trial) -> str:
    """All settings that a motion depends on except the payload, as text, in which NaN equals NaN."""
    nan = math.nan
    bare = replace(trial, name="", condition="", video=None, track=None, pressure_trace=None, payload_kg=0.0)
    return repr(replace(bare, capture_fps=nan, exposure_s=nan, m_per_px=nan, steady_window_s=None))


def speeds_with_error(fit: Fit, trials: Sequence[Trial], at_m: float, longest_s: float) -> tuple[Floats, Floats]:
    """Speed of the leading edge at `at_m` of growth and its standard error, m/s, shape (n_trials,) each. A motion that
    does not reach `at_m` has speed 0. Returns speed, sigma : arrays, shape (n_trials,), m/s.
    """
    vine = trials[0].vine
    times = _output_times(fit, trials, at_m, longest_s)
    speed = _speeds(fit, trials, None, at_m, times)
    affecting = [i for i, number in enumerate(fit.numbers) if _applies_to(number, trials[0])]
    slopes = np.zeros((len(affecting), len(trials)))
    for row, i in enumerate(affecting):
        number = fit.numbers[i]
        step = RELATIVE_STEP * (abs(number.value) or 1.0)
        up, down = (
            _speeds(fit, trials, replace(number, value=number.value + sign * step), at_m, times) for sign in (1, -1)
        )
        slopes[row] = (up - down) / (2 * step)
    covariance = np.nan_to_num(np.asarray(fit.covariance, dtype=float)[np.ix_(affecting, affecting)])
    variance = np.einsum("it,ij,jt->t", slopes, covariance, slopes)
    if not np.isfinite(variance).all():
        raise ValueError(f"the speeds of {vine} do not depend smoothly on the fitted parameters")
    return speed, np.sqrt(np.maximum(variance, 0.0))


def _applies_to(number: Number, trial: Trial) -> bool:
    """Whether a parameter applies to this trial: common to all, of its vine, or of its vine at its stated P_y."""
    stated = f"{trial.vine}, {trial.yield_pressure_Pa / 1e3:g} kPa"
    return number.vine in ("", trial.vine, stated)


def _output_times(fit: Fit, trials: Sequence[Trial], at_m: float, longest_s: float) -> list[Floats]:
    """For each trial, output times from release to just after it reaches `at_m`, or to the end where it does not."""
    full_length = [longest_s * np.linspace(0, 1, N_TIMES)] * len(trials)
    ends = []
    for run in _runs(fit, trials, None, full_length):
        arrived = np.flatnonzero(run.lead_position_m >= at_m)
        ends.append(run.time_s[arrived[0]] if arrived.size else longest_s)
    return [ARRIVAL_MARGIN * end_s * np.linspace(0, 1, N_TIMES) for end_s in ends]


def _speeds(fit: Fit, trials: Sequence[Trial], changed: Number | None, at_m: float, times: Sequence[Floats]) -> Floats:
    runs = _runs(fit, trials, changed, times)
    speeds = [lead_velocity_at(run.lead_position_m, run.lead_velocity_m_s, at_m) for run in runs]
    return np.nan_to_num(np.array(speeds))


def _runs(fit: Fit, trials: Sequence[Trial], changed: Number | None, times: Sequence[Floats]) -> list[Trajectory]:
    """Motions with the fitted parameters, one of them possibly changed."""
    theta = np.tile(fit.model.parameters_of(trials[0]), (len(trials), 1))
    changed_trials = list(trials)
    for number in (*fit.numbers, *([changed] if changed is not None else [])):
        if number.key == YIELD_PRESSURE and _applies_to(number, trials[0]):
            changed_trials = [replace(trial, yield_pressure_Pa=number.value) for trial in changed_trials]
    if changed is not None and changed.key != YIELD_PRESSURE:
        theta[:, fit.model.parameter_names.index(changed.key)] = changed.value
    return simulate_many(fit.model, changed_trials, times, parameters=theta)
