"""Tests of whether B changes along the growth, and whether the fitted yield pressure agrees with the sheet.

B is estimated for the first and second half of the growth of each trial. The scatter of pressure and B between trials
is the same in both halves and cancels in their difference. An effect that builds up along the growth shows here even
where n and the yield pressure absorb it in every comparison between trials.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from vinetrack.core.numbers import decimals
from vinetrack.core.records import Floats, Trial
from vinetrack.diagnosis.constancy_tests import FEWEST_DEGREES, ConstancyTest, normal_deviate
from vinetrack.diagnosis.force_sensitivities import FittedMotion, acceleration_sensitivities, motions_of
from vinetrack.diagnosis.per_trial_estimates import AlignedTrials, PerTrialEstimates
from vinetrack.dynamics.force_terms import evaluate
from vinetrack.inference.fit_result import Fit
from vinetrack.inference.left_out import rest_is_seen
from vinetrack.inference.parameters import DAMPING, YIELD_PRESSURE
from vinetrack.inference.sensitivity import DAMPING_DEVIATION, ORIGIN, RELEASE

STEP = 1e-3  # Relative step of a finite difference (derived)

LEAST_SCATTER = 2e-3  # Lower limit of the standard deviation of the rise of ln B in single trials (chosen)

LARGEST_STEP = 3.0  # Deviation of ln B of a half (chosen)

HALVES = (0.25, 0.75)  # Midpoints of the halves, as fractions of the growth (defined)


@dataclass(frozen=True)
class _Halves:
    """Best-fit deviation of ln B in each half of the growth, by trial, shape (n_trials, 2)."""

    trials: tuple[Trial, ...]
    deviation: Floats


def along_growth(fit: Fit, aligned: AlignedTrials, estimates: PerTrialEstimates) -> Iterator[ConstancyTest]:
    """Test B for a change along the growth, for every vine and for all."""
    if aligned.predictor.damping_column < 0:
        return
    halves = _halves(fit, aligned, estimates.trial_effects)
    vines = np.array([trial.vine for trial in halves.trials])
    usable = (np.abs(halves.deviation) <= LARGEST_STEP).all(axis=1)
    names = list(dict.fromkeys(vines[usable]))
    for vine in [*names, *([""] if len(names) > 1 else [])]:
        chosen = np.flatnonzero(usable & ((vines == vine) | (vine == "")))
        test = _difference_test(fit, halves, str(vine), chosen)
        if test is not None:
            yield test


def _halves(fit: Fit, aligned: AlignedTrials, trial_effects: Floats) -> _Halves:
    """Deviations of ln B in both halves, linearised about each trial's own B. About the common B, the between-trial
    scatter would enter in second order.
    """
    motions = motions_of(fit, trial_effects)
    data = aligned.predictor.data
    columns = aligned.predictor.linearise(np.empty(0), trial_effects)
    origin_fixed = rest_is_seen(data)
    middles_m = [
        0.5
        * float(np.max(np.interp(trial_data.time_s - trial_effects[i, RELEASE], motion.time_s, motion.lead_position_m)))
        for i, (trial_data, motion) in enumerate(zip(data, motions, strict=True))
    ]
    pushes = [_pushes(*pair) for pair in zip(motions, middles_m, strict=True)]
    deviation = np.full((len(data), 2), math.nan)
    for i, sensitivities in enumerate(acceleration_sensitivities(fit, trial_effects, motions, pushes)):
        others = columns[i][:, [RELEASE]] if origin_fixed[i] else columns[i][:, [RELEASE, ORIGIN]]
        if aligned.predictor.has_damping_deviation[i] and np.all(np.ptp(sensitivities, axis=0) > 0):
            design = np.column_stack([sensitivities, others])
            deviation[i] = np.linalg.lstsq(design, columns[i][:, -1], rcond=1e-9)[0][:2]
    return _Halves(tuple(trial_data.trial for trial_data in data), deviation + trial_effects[:, [DAMPING_DEVIATION]])


def _pushes(motion: FittedMotion, middle_m: float) -> Floats:
    """Derivative of the tail's acceleration by ln B in each half of the growth, m/s², shape (n_times, 2)."""
    value = motion.model.values[DAMPING]
    assert isinstance(value, float)
    increased = motion.model.with_values({DAMPING: value * math.exp(STEP)})
    y, v = motion.lead_position_m, motion.lead_velocity_m_s
    changed = evaluate(increased, motion.trial, motion.time_s, y, v, measured_Pa=motion.measured_Pa).acceleration_m_s2
    push = (changed - motion.model_acceleration) / STEP
    return np.column_stack([np.where(y < middle_m, push, 0.0), np.where(y < middle_m, 0.0, push)])


def _difference_test(fit: Fit, halves: _Halves, vine: str, chosen: np.ndarray) -> ConstancyTest | None:
    """Student's t test of the mean difference of the halves; None without enough degrees of freedom."""
    from scipy.stats import t as student

    rise = halves.deviation[chosen, 1] - halves.deviation[chosen, 0]
    scatter, dof = _scatter(rise, [halves.trials[i].condition for i in chosen])
    scatter = max(scatter, LEAST_SCATTER)
    if dof < FEWEST_DEGREES:
        return None
    mean, sigma = float(rise.mean()), scatter / math.sqrt(rise.size)
    p = float(2 * student.sf(abs(mean) / sigma, dof))
    change = math.expm1(abs(mean))
    error = math.exp(abs(mean)) * sigma
    start, stop = HALVES if mean >= 0 else HALVES[::-1]
    where = ("first", "second") if mean >= 0 else ("second", "first")
    who = f"B of {vine}" if vine else "B"
    digits = max(decimals(100 * error) - 1, 0)
    row = {
        "parameter": DAMPING,
        "vine": vine,
        "symbol": "B",
        "unit": "N·(s/m)ⁿ",
        "against": "growth",
        "from_level": start,
        "to_level": stop,
        "change": change,
        "change_sigma": error,
        "relative": True,
        "z": normal_deviate(p),
        "z_constancy": normal_deviate(p),
        "dof": dof,
        "n_trials": int(chosen.size),
        "sentence": (
            f"{who} would have to be {100 * change:.{digits}f} ± {100 * error:.{digits}f} % larger in the {where[1]}"
            f" half of the growth than in the {where[0]} ({normal_deviate(p):.1f} σ), though it should not change along"
            " the growth."
        ),
    }
    return ConstancyTest(row, p, _groups(fit, halves, vine, chosen) if vine else [])


def _scatter(values: Floats, conditions: list[str]) -> tuple[float, int]:
    """Standard deviation of replicates about their means, or of all trials without replicates; degrees of freedom."""
    names = np.array(conditions)
    deviations = values.copy()
    for name in set(conditions):
        deviations[names == name] -= values[names == name].mean()
    dof = values.size - len(set(conditions))
    if dof < FEWEST_DEGREES:
        deviations, dof = values - values.mean(), values.size - 1
    return math.sqrt(float(np.sum(deviations**2)) / max(dof, 1)), dof


def _groups(fit: Fit, halves: _Halves, vine: str, chosen: np.ndarray) -> list[dict[str, object]]:
    """Mean value of each half; the variance of their difference is divided equally between them."""
    rows: list[dict[str, object]] = []
    conditions = [halves.trials[i].condition for i in chosen]
    rise = halves.deviation[chosen, 1] - halves.deviation[chosen, 0]
    sigma = max(_scatter(rise, conditions)[0], LEAST_SCATTER) / math.sqrt(2 * chosen.size)
    base = float(fit.model.parameters_for(vine)[fit.model.parameter_names.index(DAMPING)])
    for half, level in enumerate(HALVES):
        ratio = math.exp(float(halves.deviation[chosen, half].mean()))
        rows.append(
            {
                "parameter": DAMPING,
                "vine": vine,
                "symbol": "B",
                "unit": "N·(s/m)ⁿ",
                "against": "growth",
                "level": level,
                "value": base * ratio,
                "sigma": base * ratio * sigma,
                "ratio": ratio,
                "ratio_sigma": ratio * sigma,
                "n_trials": int(chosen.size),
            }
        )
    return rows


def against_the_sheet(fit: Fit) -> Iterator[ConstancyTest]:
    """Compare fitted yield pressures with the sheet, in units of the standard error stated there."""
    for number, free in zip(fit.numbers, fit.predictor.layout.free, strict=True):
        if number.key != YIELD_PRESSURE or not math.isfinite(free.prior_sd):
            continue
        change = number.value - free.start
        z = abs(change) / free.prior_sd
        p = math.erfc(z / math.sqrt(2))
        row = {
            "parameter": number.key,
            "vine": number.vine,
            "symbol": number.symbol,
            "unit": number.unit,
            "against": "sheet",
            "from_level": free.start,
            "to_level": number.value,
            "change": change,
            "change_sigma": free.prior_sd,
            "relative": False,
            "z": z,
            "z_constancy": z,
            "dof": math.inf,
            "n_trials": sum(trial.trial.vine == number.vine.split(",")[0] for trial in fit.trials),
            "sentence": (
                f"{number.symbol} of {number.vine} is pulled from the {free.start / 1e3:.2f} ±"
                f" {free.prior_sd / 1e3:.2f} kPa of the sheet to {number.value / 1e3:.2f} kPa ({z:.1f} σ)."
            ),
        }
        yield ConstancyTest(row, p, [])
