"""Two further looks at what a fit leaves, where trials have numbers of their own to hide it in.

A model that lacks something lets every trial bend its own pressure and B until it fits. What is bent by chance differs
between replicates of a condition; what makes up for the model is the same in all of them. And what no bending mends
passes for noise: then the positions are noisier in motion than at rest, over stretches that any slow error needs.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.inference.fit_problem import variance_floor
from vinetrack.inference.fit_result import Fit

STRETCH_FRAMES = 8
"""Frames over which noise is summed: slow against the noise, short enough for a rest of two dozen frames. Chosen:
noise correlated by 0.6 is independent after eight frames to 2 %."""

MIN_STRETCHES = 12
"""Stretches, and degrees of freedom between replicates, below which the test is not made. Chosen: a variance is then
known to 40 and 70 %."""

MIN_REPLICATE_DEGREES = 4
"""Degrees of freedom between replicates from which their scatter can be told. Chosen: a variance of four degrees of
freedom is known to 70 %. At half chance scatter decides, at twice most campaigns are not asked."""

STATED_ERROR_FACTOR, CAREFUL_DAMPING_SCATTER = 2.0, 0.04
"""What conditions may differ by: twice the error that the sheet states of a pressure, and 4 % of B. Chosen: what a
gauge and a batch of vines may do."""

CAREFUL_PRESSURE_SCATTER = 0.02
"""Relative deviation below which conditions that differ are within what vines do. Chosen: what a gauge and a batch of
vines may do."""

REPLICATE_LIKE_P_VALUE = 0.05
"""Chance from which conditions are taken to differ by no more than their replicates do. Chosen: a model that bends its
trials passes for their scatter once in twenty times at most; at half seldomer, at twice one campaign in ten whose
trials scatter on their own is searched throughout for nothing."""


def between_conditions_p(fit: Fit) -> float:
    """Chance at which conditions differ in their trials' own pressure, or B, by so much more than replicates do.

    1 where replicates are too few, or where conditions differ by no more than an experimenter's care allows.

    Parameters
    ----------
    fit
        A fitted model.

    Returns
    -------
    float
        p-value.
    """
    stated = [
        trial.trial.pressure_sigma_Pa / trial.trial.pressure_Pa for trial in fit.trials if trial.trial.pressure_Pa > 0
    ]
    known = [part for part in stated if math.isfinite(part)]
    pressure = max(STATED_ERROR_FACTOR * float(np.median(known)) if known else 0.0, CAREFUL_PRESSURE_SCATTER)
    allowed = pressure, CAREFUL_DAMPING_SCATTER
    chances = [
        _one_way(deviations, *_grouping(fit), most)
        for deviations, most in zip(_own_deviations(fit), allowed, strict=True)
    ]
    return min(2 * min(chances), 1.0)


def has_excess_scatter(fit: Fit) -> bool:
    """Whether trials deviate by more than an experimenter's care allows: a model may have bent them to fit.

    It has not where conditions differ by no more than replicates, or than care allows: what makes up for a model is
    alike in replicates.

    Parameters
    ----------
    fit : the fit that is questioned.

    Returns
    -------
    bool
    """
    allowed = CAREFUL_PRESSURE_SCATTER, CAREFUL_DAMPING_SCATTER
    return any(
        spread > most and not _like_replicates(deviations, *_grouping(fit), most)
        for spread, most, deviations in zip(fit.state.spread, allowed, _own_deviations(fit), strict=True)
    )


def _own_deviations(fit: Fit) -> tuple[Floats, Floats]:
    """Each trial's own deviation of pressure and of ln B."""
    return (
        np.array([trial.pressure_deviation for trial in fit.trials]),
        np.log1p([trial.damping_deviation for trial in fit.trials]),
    )


def _grouping(fit: Fit) -> tuple[list[str], int]:
    """The condition of each trial, and how many numbers were fitted to all."""
    fitted = sum(1 for number in fit.numbers if not math.isfinite(number.bound))
    return [trial.trial.condition for trial in fit.trials], fitted


def _like_replicates(values: Floats, groups: Sequence[str], fitted: int, allowed: float) -> bool:
    """Whether groups differ by no more than their members do, or than is allowed, where enough members tell.

    Of no more groups than numbers that were fitted to them nothing would show.
    """
    inner, outer = values.size - len(set(groups)), len(set(groups)) - fitted
    told = inner >= MIN_REPLICATE_DEGREES and outer > 0
    return told and _one_way(values, groups, fitted, allowed) > REPLICATE_LIKE_P_VALUE


def _one_way(values: Floats, groups: Sequence[str], fitted: int, allowed: float) -> float:
    """Upper tail of the F test between groups, 1 where their means differ by less than `allowed`, root mean square."""
    from scipy.stats import f

    names = sorted(set(groups))
    members = [values[[group == name for group in groups]] for name in names]
    within = sum(float(np.sum((member - member.mean()) ** 2)) for member in members)
    inner, outer = values.size - len(names), max(len(names) - fitted, 1)
    between = sum(member.size * float(member.mean()) ** 2 for member in members)
    if inner < MIN_REPLICATE_DEGREES or not within > 0 or math.sqrt(between / values.size) < allowed:
        return 1.0
    # Those of replicates that hardly differ are held against what an experimenter's care allows.
    care = max(within / inner, allowed**2 / 9)
    return float(f.sf(between / outer / care, outer, inner))


def noise_in_motion_p(fit: Fit) -> float:
    """Chance at which positions in motion are so much noisier, over stretches, than at rest; 1 where nobody can tell.

    Positions read from recordings are not asked, for a tracker's slow errors in motion are larger than those at rest,
    none under a recorded pressure, for a gauge's noise moves what the model predicts, and none that are more precise
    than the integrator, as those of a simulation.

    Parameters
    ----------
    fit
        A fitted model.

    Returns
    -------
    float
        p-value.
    """
    from scipy.stats import f

    at_rest: list[Floats] = []
    motion: list[Floats] = []
    freedom = 0.0
    for trial, trial_data in zip(fit.trials, fit.predictor.data, strict=True):
        if (
            trial_data.slow_m is not None
            or trial_data.gauge_error > 0
            or trial_data.noise_m**2 < variance_floor([trial_data])[0]
        ):
            continue
        here = _sums(trial.whitened[: trial_data.n_rest])
        if here.size < 2:
            continue
        at_rest.append((here - here.mean()) * math.sqrt(here.size / (here.size - 1)))
        motion.append(_sums(trial.whitened[trial_data.n_rest :]))
        freedom += here.size - 1
    if freedom < MIN_STRETCHES:
        return 1.0
    still, moving = np.concatenate(at_rest), np.concatenate(motion)
    ratio = float(np.mean(moving**2) / np.mean(still**2))
    return float(f.sf(ratio, _degrees(moving, moving.size), _degrees(still, freedom)))


def _sums(white: Floats) -> Floats:
    """Sums over successive stretches, each of variance 1 where the noise is white."""
    count = white.size // STRETCH_FRAMES
    return np.asarray(
        white[: count * STRETCH_FRAMES].reshape(count, STRETCH_FRAMES).sum(axis=1) / math.sqrt(STRETCH_FRAMES)
    )


def _degrees(values: Floats, count: float) -> float:
    """Degrees of freedom of their mean square, fewer where the tails are heavy."""
    square = float(np.mean(values**2))
    kurtosis = float(np.mean(values**4)) / square**2 if square > 0 else 3.0
    return 2 * count / max(kurtosis - 1, 2.0)
