"""Two tests of whether trial effects and noise have absorbed what a model lacks.

The deviations of pressure and B of each trial can absorb part of a misfit. Deviations by chance differ between
replicates of a condition; those that compensate for the model are the same in all of them. What the deviations cannot
absorb is estimated as noise: positions are then noisier in motion than at rest, summed over stretches as long as slow
errors last.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.inference.fit_problem import variance_floor
from vinetrack.inference.fit_result import Fit

STRETCH_FRAMES = 8  # Frames over which residuals are summed (chosen)

MIN_STRETCHES = 12  # Degrees of freedom of the stretches at rest below which the noise test is not made (chosen)

MIN_REPLICATE_DEGREES = 4  # Degrees of freedom between replicates from which their scatter is estimated (chosen)

STATED_ERROR_FACTOR, CAREFUL_DAMPING_SCATTER = 2.0, 0.04  # Root mean square by which conditions may differ (chosen)

CAREFUL_PRESSURE_SCATTER = 0.02  # Relative standard deviation of pressure that is usual between trials (chosen)

REPLICATE_LIKE_P_VALUE = 0.05  # p-value from which conditions count as differing no more than their replicates (chosen)


def between_conditions_p(fit: Fit) -> float:
    """p-value that conditions differ in pressure or B no more than replicates do. 1 where replicates are too few, or
    where conditions differ by less than is usual in careful work. Returns p-value.
    """
    stated = [
        trial.trial.pressure_sigma_Pa / trial.trial.pressure_Pa for trial in fit.trials if trial.trial.pressure_Pa > 0
    ]
    known = [relative for relative in stated if math.isfinite(relative)]
    pressure = max(STATED_ERROR_FACTOR * float(np.median(known)) if known else 0.0, CAREFUL_PRESSURE_SCATTER)
    allowed = pressure, CAREFUL_DAMPING_SCATTER
    p_values = [
        _anova_p(deviations, *_grouping(fit), limit)
        for deviations, limit in zip(_trial_deviations(fit), allowed, strict=True)
    ]
    return min(2 * min(p_values), 1.0)


def has_excess_scatter(fit: Fit) -> bool:
    """Whether trials scatter more than is usual in careful work, so that their effects may have absorbed a misfit. They
    have not where conditions differ by no more than replicates, or than is usual: deviations that compensate for a
    model are the same in replicates.
    """
    allowed = CAREFUL_PRESSURE_SCATTER, CAREFUL_DAMPING_SCATTER
    return any(
        spread > limit and not _differ_like_replicates(deviations, *_grouping(fit), limit)
        for spread, limit, deviations in zip(fit.state.spread, allowed, _trial_deviations(fit), strict=True)
    )


def _trial_deviations(fit: Fit) -> tuple[Floats, Floats]:
    """Deviations of pressure and of ln B, by trial."""
    return (
        np.array([trial.pressure_deviation for trial in fit.trials]),
        np.log1p([trial.damping_deviation for trial in fit.trials]),
    )


def _grouping(fit: Fit) -> tuple[list[str], int]:
    """The condition of each trial, and the number of parameters fitted to all."""
    fitted = sum(1 for number in fit.numbers if not math.isfinite(number.bound))
    return [trial.trial.condition for trial in fit.trials], fitted


def _differ_like_replicates(values: Floats, groups: Sequence[str], fitted: int, allowed: float) -> bool:
    """Whether groups differ by no more than their members do, or than is allowed; False where too few members tell.
    With no more groups than parameters fitted to them, no difference between groups can show.
    """
    inner, outer = values.size - len(set(groups)), len(set(groups)) - fitted
    testable = inner >= MIN_REPLICATE_DEGREES and outer > 0
    return testable and _anova_p(values, groups, fitted, allowed) > REPLICATE_LIKE_P_VALUE


def _anova_p(values: Floats, groups: Sequence[str], fitted: int, allowed: float) -> float:
    """p-value of a one-way analysis of variance; 1 where the group means differ by less than `allowed`, rms."""
    from scipy.stats import f

    names = sorted(set(groups))
    members = [values[[group == name for group in groups]] for name in names]
    within = sum(float(np.sum((member - member.mean()) ** 2)) for member in members)
    inner, outer = values.size - len(names), max(len(names) - fitted, 1)
    between = sum(member.size * float(member.mean()) ** 2 for member in members)
    if inner < MIN_REPLICATE_DEGREES or not within > 0 or math.sqrt(between / values.size) < allowed:
        return 1.0
    # Replicates that hardly differ would make any difference significant: their variance is at least (allowed / 3)².
    within_variance = max(within / inner, allowed**2 / 9)
    return float(f.sf(between / outer / within_variance, outer, inner))


def noise_in_motion_p(fit: Fit) -> float:
    """p-value that residuals summed over stretches are no noisier in motion than at rest; 1 where this is unknown.
    Returns p-value.
    """
    from scipy.stats import f

    at_rest: list[Floats] = []
    in_motion: list[Floats] = []
    rest_degrees = 0.0
    for trial, trial_data in zip(fit.trials, fit.predictor.data, strict=True):
        if (
            trial_data.slow_m is not None
            or trial_data.gauge_error > 0
            or trial_data.noise_m**2 < variance_floor([trial_data])[0]
        ):
            continue
        standstill = _stretch_sums(trial.whitened[: trial_data.n_rest])
        if standstill.size < 2:
            continue
        at_rest.append((standstill - standstill.mean()) * math.sqrt(standstill.size / (standstill.size - 1)))
        in_motion.append(_stretch_sums(trial.whitened[trial_data.n_rest :]))
        rest_degrees += standstill.size - 1
    if rest_degrees < MIN_STRETCHES:
        return 1.0
    still, moving = np.concatenate(at_rest), np.concatenate(in_motion)
    ratio = float(np.mean(moving**2) / np.mean(still**2))
    return float(f.sf(ratio, _degrees(moving, moving.size), _degrees(still, rest_degrees)))


def _stretch_sums(white: Floats) -> Floats:
    """Sums over successive stretches, of variance 1 if the residuals are white."""
    count = white.size // STRETCH_FRAMES
    return np.asarray(
        white[: count * STRETCH_FRAMES].reshape(count, STRETCH_FRAMES).sum(axis=1) / math.sqrt(STRETCH_FRAMES)
    )


def _degrees(values: Floats, count: float) -> float:
    """Effective degrees of freedom of a mean square, fewer where the tails are heavy."""
    square = float(np.mean(values**2))
    kurtosis = float(np.mean(values**4)) / square**2 if square > 0 else 3.0
    return 2 * count / max(kurtosis - 1, 2.0)
