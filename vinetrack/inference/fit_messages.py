"""Messages of a fit: warnings on its numbers, and notes on what was done to its data."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.core.units import display_unit
from vinetrack.inference.fit_data import FitTrial
from vinetrack.inference.fit_result import Number
from vinetrack.inference.intervals import Precision
from vinetrack.inference.optimiser import Solution
from vinetrack.inference.parameters import ParameterMap
from vinetrack.inference.sensitivity import Predictor
from vinetrack.inference.trace_errors import trace_correction_Pa

STRONG_CORRELATION = 0.98  # Correlation of two fitted numbers from which the fit warns (chosen)

# Ratio of fitted to stated error of P_y from which the trajectories are said not to constrain it (chosen)
UNCONSTRAINED_RATIO = 0.95

# The same ratio from which the message explains why the fitted error exceeds the stated one (chosen)
WIDENED_RATIO = 1.05

MISFIT_CHI2 = 2.0  # χ² per degree of freedom from which the fit warns of misfit (chosen)

# Standard deviation between trials, in errors of the shared number, from which the fit says that trials disagree
DISAGREEMENT_SIGMAS = 1.0

SPREAD_NAMES = ("pressure", "B")


def fit_messages(
    predictor: Predictor,
    solution: Solution,
    numbers: Sequence[Number],
    precision: Precision,
    between: Floats,
    chi2: float,
) -> tuple[str, ...]:
    """All messages of a fit. Shapes: between (n_numbers, n_numbers)."""
    return (
        *_messages(predictor.layout, solution, numbers, precision, chi2),
        *_disagreement_messages(numbers, between),
        *_weighting_messages(predictor.data),
        *_smoothing_messages(predictor.data),
        *_pressure_messages(predictor.data),
    )


def _messages(
    layout: ParameterMap, solution: Solution, numbers: Sequence[Number], precision: Precision, chi2: float
) -> list[str]:
    """Warnings on convergence, on each number, and on the size of the residuals."""
    messages = []
    if not solution.converged:
        messages.append(f"the fit did not converge in {solution.iterations} iterations: its values are not reliable")
    for k, number in enumerate(numbers):
        free = layout.free[k]
        if precision.insensitive[k]:
            messages.append(
                f"{number.title} ({number.key}) has no influence on the trajectories: it stays at {number.value:.4g}"
            )
        elif math.isfinite(number.bound):
            messages.append(
                f"{number.title} ({number.key}) sits at its bound {number.bound:.4g}: the data favour values outside"
            )
        elif math.isfinite(free.prior_sd) and number.sigma > UNCONSTRAINED_RATIO * free.prior_sd:
            wider = number.sigma > WIDENED_RATIO * free.prior_sd
            why = (
                "; trials disagree by more than their noise, so its error is larger than in the sheet" if wider else ""
            )
            messages.append(f"{number.title}: the trajectories do not constrain it beyond the value in the sheet{why}")
    if precision.collinear.any():
        titles = [
            f"{n.title} ({n.key})" for n, collinear in zip(numbers, precision.collinear, strict=True) if collinear
        ]
        messages.append(f"these data do not determine separate values of {', '.join(titles)}")
    messages += _correlation_messages(numbers, precision)
    for k, name in enumerate(SPREAD_NAMES):
        if solution.problem.has_deviation[:, k].any() and not solution.estimable[k]:
            messages.append(
                f"the between-trial standard deviation of {name} is taken as {100 * solution.state.spread[k]:.2g} %"
            )
    if chi2 > MISFIT_CHI2:
        messages.append(
            f"the residuals are {math.sqrt(chi2):.3g} times the noise of the tracks{_variation_allowed(solution)}:"
            " an effect is missing, or the tracks have slow errors larger than their noise"
        )
    return messages


def _variation_allowed(solution: Solution) -> str:
    """Which of B and pressure may vary from trial to trial, as a clause; blank if the bodies have neither."""
    varying = [SPREAD_NAMES[k] for k in (1, 0) if solution.problem.has_deviation[:, k].any()]
    return f", although {' and '.join(varying)} may vary from trial to trial" if varying else ""


def _correlation_messages(numbers: Sequence[Number], precision: Precision) -> list[str]:
    pairs = []
    variance = np.diag(precision.covariance)
    usable = np.flatnonzero(np.isfinite(variance) & (variance > 0))
    for i, j in itertools.combinations(usable.tolist(), 2):
        correlation = precision.covariance[i, j] / math.sqrt(variance[i] * variance[j])
        if abs(correlation) > STRONG_CORRELATION:
            first, second = numbers[i].title, numbers[j].title
            pairs.append(f"{first} and {second} are strongly correlated ({correlation:.3f})")
    return pairs


def _disagreement_messages(numbers: Sequence[Number], between: Floats) -> list[str]:
    """A message naming the numbers on which trials disagree by more than the error of their mean."""
    sd = np.sqrt(np.diag(between))
    disagreements = [
        f"{n.title} by ± {sd[k] * display_unit(n.unit)[1]:.2g} {display_unit(n.unit)[0]}".rstrip()
        for k, n in enumerate(numbers)
        if sd[k] > DISAGREEMENT_SIGMAS * n.sigma and math.isfinite(n.sigma)
    ]
    if not disagreements:
        return []
    return [f"trials disagree by more than their noise, in {', '.join(disagreements)}: they get nearly equal weights"]


def _weighting_messages(data: Sequence[FitTrial]) -> list[str]:
    """A note on points with unequal weights."""
    weighted = [trial_data for trial_data in data if trial_data.relative_sd is not None]
    if not weighted:
        return []
    if weighted[0].blur_s > 0:
        blur_us = 1e6 * weighted[0].blur_s
        return [
            f"the noise of positions grows with speed, by {blur_us:.2g} µs × speed: points are weighted accordingly"
        ]
    return ["points are weighted by the standard deviations that their files state"]


def _smoothing_messages(data: Sequence[FitTrial]) -> list[str]:
    """Notes on positions that were smoothed before they were imported."""
    return list(dict.fromkeys(trial_data.smoothing.note for trial_data in data if trial_data.smoothing is not None))


def _pressure_messages(data: Sequence[FitTrial]) -> list[str]:
    """A note on recorded pressures that the fit corrected."""
    corrections = [
        float(np.max(np.abs(trace_correction_Pa(each)))) for each in data if each.trace_error_sizes is not None
    ]
    if not corrections:
        return []
    trials = f"{len(corrections)} trials" if len(corrections) > 1 else "one trial"
    largest_kPa = max(corrections) / 1e3
    return [
        f"recorded pressures of {trials} are corrected by up to {largest_kPa:.2g} kPa, within the errors that the noise"
        " of the gauge leaves, to agree with the motion"
    ]
