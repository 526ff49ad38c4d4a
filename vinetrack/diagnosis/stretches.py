"""Trials cut into stretches, and how much replicates scatter in them; see `vinetrack.diagnosis.replicate_scatter`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vinetrack.core.records import Floats, Trial
from vinetrack.diagnosis.ladder import in_sample
from vinetrack.diagnosis.per_trial_estimates import lay
from vinetrack.diagnosis.replicate_scatter import (
    Scatter,
    Stretches,
    find_scatter,
    scatter_sensitivities,
    stretch_covariance,
)
from vinetrack.diagnosis.replicates import first_that_counts
from vinetrack.inference.fit_data import FitTrial
from vinetrack.inference.fit_result import Fit, TrialFit

STRETCHES = 8
"""Parts of the growth that a mean is taken over. Chosen: a trial errs in two or three independent ways; more stretches
share their errors."""

FEWEST_FRAMES = 2
"""Frames of a stretch, at least: a shorter recording is cut into fewer. Derived: one frame has no neighbour to average
with."""


@dataclass(frozen=True)
class Course:
    """One trial's residuals and what it answers to scatter, with the coordinates they are looked at along.

    From the first motion on; arrays have shape (n_points,), `answers` (n_points, 2). `noise_m2` is the variance of a
    frame's position, times the frames that share one error; `rest_m2` that of the origin.
    """

    trial: Trial
    residual_m: Floats
    answers: Floats
    time_s: Floats
    lead_position_m: Floats
    lead_velocity_m_s: Floats
    noise_m2: float
    rest_m2: float


def courses_of(fit: Fit) -> tuple[list[Course], tuple[TrialFit, ...]]:
    """Every trial of a fit as a course, and as predicted with a release and an origin of its own.

    Parameters
    ----------
    fit
        A fitted model.

    Returns
    -------
    courses : list of Course
    predicted : tuple of TrialFit

    Raises
    ------
    FitError
        If the model cannot be followed.
    """
    predicted = in_sample(fit).trials
    answers = scatter_sensitivities(lay(fit))
    return [_course(*members) for members in zip(predicted, answers, fit.predictor.data, strict=True)], predicted


def by_condition(courses: Sequence[Course]) -> dict[str, list[Course]]:
    """Courses by name of condition, in order.

    Parameters
    ----------
    courses : sequence of Course

    Returns
    -------
    dict of list of Course
    """
    names = dict.fromkeys(course.trial.condition for course in courses)
    return {name: [course for course in courses if course.trial.condition == name] for name in names}


def replicate_scatter(fit: Fit, courses: Sequence[Course]) -> Scatter:
    """How much replicates scatter, from stretches of time that all of a condition were filmed in.

    Parameters
    ----------
    fit
        A fitted model.
    courses : sequence of Course

    Returns
    -------
    Scatter
    """
    groups = by_condition(courses).values()
    return find_scatter(fit, [stretches_of(members, "time_s", common_edges(members)) for members in groups])


def _course(trial: TrialFit, answers: Floats, trial_data: FitTrial) -> Course:
    noise_m2 = trial_data.mean_noise_m**2 * (1 + trial_data.correlation) / (1 - trial_data.correlation)
    begin = first_that_counts(trial)
    growth = trial.predicted_position_m - trial.origin_m
    return Course(
        trial=trial.trial,
        residual_m=trial.residual_m[begin:],
        answers=answers[begin:],
        time_s=trial.time_s[begin:] - trial.release_s,
        lead_position_m=growth[begin:],
        lead_velocity_m_s=trial.predicted_velocity_m_s[begin:],
        noise_m2=noise_m2,
        rest_m2=noise_m2 / max(trial_data.n_rest, 1),
    )


def common_edges(members: Sequence[Course]) -> Floats:
    """Edges of stretches of time that every replicate was filmed in.

    Parameters
    ----------
    members : sequence of Course
        Of one condition.

    Returns
    -------
    array, shape (n_stretches + 1,), s
    """
    begin = max(float(member.time_s[0]) for member in members)
    end = min(float(member.time_s[-1]) for member in members)
    frames = min(int(np.count_nonzero((member.time_s >= begin) & (member.time_s <= end))) for member in members)
    count = max(min(STRETCHES, frames // FEWEST_FRAMES), 1)
    return np.linspace(begin, max(end, begin), count + 1)


def means_of(course: Course, along: str, edges: Floats) -> tuple[Floats, Floats]:
    """Means of [residual, answers] in each stretch, shape (n_stretches, 3), NaN where no frame is; and the frames.

    Parameters
    ----------
    course
        One trial along its growth.
    along : str
        Attribute of the course that the edges belong to.
    edges : array, shape (n_stretches + 1,)

    Returns
    -------
    means : array, shape (n_stretches, 3), m
    frames : array, shape (n_stretches,)
    """
    values, at = np.column_stack([course.residual_m, course.answers]), getattr(course, along)
    place = np.clip(np.searchsorted(edges, at, side="right") - 1, 0, edges.size - 2)
    inside = (at >= edges[0]) & (at <= edges[-1])
    total, count = np.zeros((edges.size - 1, values.shape[1])), np.zeros(edges.size - 1)
    np.add.at(total, place[inside], values[inside])
    np.add.at(count, place[inside], 1.0)
    return np.where(count[:, None] > 0, total / np.maximum(count, 1.0)[:, None], math.nan), count


def stretches_of(members: Sequence[Course], along: str, edges: Floats) -> Stretches:
    """The stretches that all of the members have frames in.

    Parameters
    ----------
    members : sequence of Course
        Of one condition.
    along : str
        Attribute of the courses that the edges belong to.
    edges : array, shape (n_stretches + 1,)

    Returns
    -------
    Stretches
    """
    parts = [means_of(member, along, edges) for member in members]
    both = np.array([means for means, _ in parts])
    reached = np.isfinite(both).all(axis=(0, 2))
    noise = np.mean([_noise(course, count[reached]) for course, (_, count) in zip(members, parts, strict=True)], axis=0)
    return Stretches(both[:, reached, 0], both[:, reached, 1:].mean(axis=0), noise)


def _noise(course: Course, count: Floats) -> Floats:
    """Covariance of the means of stretches of so many frames; the error of the origin is common to all."""
    return np.asarray(np.diag(course.noise_m2 / np.maximum(count, 1.0)) + course.rest_m2)


def variances_of(course: Course, part: tuple[Floats, Floats], scatter: Scatter) -> Floats:
    """Variances of the means of one trial's stretches, shape (n_stretches,).

    Parameters
    ----------
    course
        One trial along its growth.
    part : (means, frames)
        From `means_of`.
    scatter
        What replicates differ by.

    Returns
    -------
    array, shape (n_stretches,), m²
    """
    means, count = part
    alone = Stretches(means[None, :, 0], np.nan_to_num(means[:, 1:]), _noise(course, count))
    return np.diag(stretch_covariance(scatter, alone))
