"""Residuals of trials averaged over stretches of the growth, and the scatter of replicates in them.

See `vinetrack.diagnosis.replicate_scatter`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vinetrack.core.records import Floats, Trial
from vinetrack.diagnosis.ladder import in_sample
from vinetrack.diagnosis.per_trial_estimates import align_trials
from vinetrack.diagnosis.replicate_scatter import (
    Scatter,
    Stretches,
    find_scatter,
    scatter_sensitivities,
    stretch_covariance,
)
from vinetrack.diagnosis.replicates import first_that_counts
from vinetrack.diagnosis.result import MAX_STRETCHES
from vinetrack.inference.fit_data import FitTrial
from vinetrack.inference.fit_result import Fit, TrialFit

MIN_FRAMES_PER_STRETCH = 2  # Least frames of a stretch: a shorter recording is cut into fewer (derived)


@dataclass(frozen=True)
class ResidualCourse:
    """One trial's residuals, their response to between-trial scatter, and the coordinates along the growth. From the
    first motion on; arrays have shape (n_points,), `scatter_response` (n_points, 2).
    """

    trial: Trial
    residual_m: Floats
    scatter_response: Floats
    time_s: Floats
    lead_position_m: Floats
    lead_velocity_m_s: Floats
    noise_variance_m2: float
    origin_variance_m2: float


def residual_courses(fit: Fit) -> tuple[list[ResidualCourse], tuple[TrialFit, ...]]:
    """Residuals of every trial of a fit, and the trials as predicted with their own release and origin. Returns
    courses, predicted.
    """
    predicted = in_sample(fit).trials
    response = scatter_sensitivities(align_trials(fit))
    return [_course(*members) for members in zip(predicted, response, fit.predictor.data, strict=True)], predicted


def courses_by_condition(courses: Sequence[ResidualCourse]) -> dict[str, list[ResidualCourse]]:
    """Courses by name of condition, in order."""
    names = dict.fromkeys(course.trial.condition for course in courses)
    return {name: [course for course in courses if course.trial.condition == name] for name in names}


def replicate_scatter(fit: Fit, courses: Sequence[ResidualCourse]) -> Scatter:
    """Estimate the scatter of replicates from stretches of time that all trials of a condition were recorded in."""
    groups = courses_by_condition(courses).values()
    return find_scatter(fit, [common_stretches(members, "time_s", common_edges(members)) for members in groups])


def _course(trial: TrialFit, response: Floats, trial_data: FitTrial) -> ResidualCourse:
    noise_variance_m2 = trial_data.mean_noise_m**2 * (1 + trial_data.correlation) / (1 - trial_data.correlation)
    begin = first_that_counts(trial)
    growth = trial.predicted_position_m - trial.origin_m
    return ResidualCourse(
        trial=trial.trial,
        residual_m=trial.residual_m[begin:],
        scatter_response=response[begin:],
        time_s=trial.time_s[begin:] - trial.release_s,
        lead_position_m=growth[begin:],
        lead_velocity_m_s=trial.predicted_velocity_m_s[begin:],
        noise_variance_m2=noise_variance_m2,
        origin_variance_m2=noise_variance_m2 / max(trial_data.n_rest, 1),
    )


def common_edges(members: Sequence[ResidualCourse]) -> Floats:
    """Edges of stretches of time that every replicate was recorded in. Shape (n_stretches + 1,)."""
    start = max(float(member.time_s[0]) for member in members)
    end = min(float(member.time_s[-1]) for member in members)
    frames = min(int(np.count_nonzero((member.time_s >= start) & (member.time_s <= end))) for member in members)
    count = max(min(MAX_STRETCHES, frames // MIN_FRAMES_PER_STRETCH), 1)
    return np.linspace(start, max(end, start), count + 1)


def stretch_means(course: ResidualCourse, along: str, edges: Floats) -> tuple[Floats, Floats]:
    """Means of [residual, scatter response] in each stretch, NaN where there is no frame, and the numbers of frames.
    Returns means, frames. Shapes: edges (n_stretches + 1,) → (n_stretches, 3).
    """
    values, at = np.column_stack([course.residual_m, course.scatter_response]), getattr(course, along)
    stretch = np.clip(np.searchsorted(edges, at, side="right") - 1, 0, edges.size - 2)
    inside = (at >= edges[0]) & (at <= edges[-1])
    total, count = np.zeros((edges.size - 1, values.shape[1])), np.zeros(edges.size - 1)
    np.add.at(total, stretch[inside], values[inside])
    np.add.at(count, stretch[inside], 1.0)
    return np.where(count[:, None] > 0, total / np.maximum(count, 1.0)[:, None], math.nan), count


def common_stretches(members: Sequence[ResidualCourse], along: str, edges: Floats) -> Stretches:
    """The stretches in which all members have frames. Shapes: edges (n_stretches + 1,)."""
    parts = [stretch_means(member, along, edges) for member in members]
    all_means = np.array([means for means, _ in parts])
    reached = np.isfinite(all_means).all(axis=(0, 2))
    noise = np.mean([_noise(course, count[reached]) for course, (_, count) in zip(members, parts, strict=True)], axis=0)
    return Stretches(all_means[:, reached, 0], all_means[:, reached, 1:].mean(axis=0), noise)


def _noise(course: ResidualCourse, count: Floats) -> Floats:
    """Covariance of the means of stretches of so many frames; the error of the origin is common to all."""
    return np.asarray(np.diag(course.noise_variance_m2 / np.maximum(count, 1.0)) + course.origin_variance_m2)


def stretch_variances(course: ResidualCourse, part: tuple[Floats, Floats], scatter: Scatter) -> Floats:
    """Variances of the means of one trial's stretches. Shape (n_stretches,)."""
    means, count = part
    single = Stretches(means[None, :, 0], np.nan_to_num(means[:, 1:]), _noise(course, count))
    return np.diag(stretch_covariance(scatter, single))
