"""Trials that were already growing when they were first seen: their releases are looked for, not only improved.

Without frames at rest the release, the origin and the deviations of a trial trade against each other, and its misfit
has a minimum in more than one place. A trajectory depends on the time since release alone, so one simulation, shifted,
tells the misfit of every release.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vinetrack.model.mixed import Frame, State, own_prior
from vinetrack.model.sensitivity import (
    DAMPING_DEVIATION,
    ORIGIN,
    OWN,
    PRESSURE,
    RELEASE,
    Job,
    Predictor,
)
from vinetrack.model.whitened import whiten
from vinetrack.records import Floats

RELEASES = 60
GRID_POINTS = 600
WORTH_MOVING = 0.5
"""Fall of a trial's −2 ln L for which its release jumps to another minimum."""

STEPS = np.array([-np.inf, -0.3, -0.3]), np.array([np.inf, 0.3, 0.3])
"""Least and largest change of origin and deviations."""

DAMPING_STEP, PRESSURE_STEP = 1e-2, 1e-2


def unseen(predictor: Predictor) -> list[int]:
    """Places of the trials that show nothing of their release, and whose pressure is a single number."""
    return [i for i, item in enumerate(predictor.data) if not item.shows_rest and item.trace is None]


def release_again(predictor: Predictor, frame: Frame, state: State) -> State | None:
    """The state with likelier releases of such trials; None if none is."""
    places = unseen(predictor)
    if not places:
        return None
    plain = predictor.jobs(state.theta, state.own)
    own, moved = state.own.copy(), False
    for i in places:
        found, gain = _best(predictor, frame, state, plain[i])
        if gain > WORTH_MOVING:
            own[i], moved = found, True
    return replace(state, own=own) if moved else None


def _best(predictor: Predictor, frame: Frame, state: State, job: Job) -> tuple[Floats, float]:
    """The own numbers of one trial at its likeliest release, and the fall of −2 ln L from where it stands."""
    i = job.trial
    item, own = predictor.data[i], state.own[i]
    centre, precision = (part[i] for part in own_prior(frame, state))
    duration = float(item.time_s[-1] - item.time_s[0])
    times = duration * 2.05 * np.linspace(0.0, 1.0, GRID_POINTS) ** 1.5
    plain, answers = _answers(predictor, job, times)
    since_first = np.geomspace(0.1 * item.frame_s, duration, RELEASES)
    releases = np.append(item.time_s[0] - since_first, own[RELEASE])
    tried, levels = [], []
    for release_s in releases:
        since = np.clip(item.time_s - release_s, 0.0, times[-1])
        columns = np.column_stack([np.interp(since, times, answer) for answer in answers])
        residual = item.lead_position_m - own[ORIGIN] - np.interp(since, times, plain)
        white = np.column_stack([whiten(c, item.first, state.rho) for c in (*columns.T, residual)])
        white /= np.sqrt(state.variance[i])
        there = own.copy()
        there[RELEASE] = release_s
        square = white[:, :-1].T @ white[:, :-1] + np.diag(precision)
        slope = (white[:, :-1].T @ white[:, -1] - precision * (there - centre))[ORIGIN:]
        step = np.clip(np.linalg.solve(square[ORIGIN:, ORIGIN:], slope), *STEPS)
        there[ORIGIN:] += step
        left = white[:, -1] - white[:, 1:-1] @ step
        tried.append(there)
        levels.append(left @ left + np.sum(precision * (there - centre) ** 2) + np.linalg.slogdet(square)[1])
    k = int(np.argmin(levels))
    return tried[k], float(levels[-1] - levels[k])


def _answers(predictor: Predictor, job: Job, times: Floats) -> tuple[Floats, Floats]:
    """Positions of a trial at other instants since release, shape (n,), and their answers to its own numbers.

    These have shape (4, n), zero where it does not feel one.
    """
    i, job = job.trial, replace(job, release_s=0.0)
    jobs, places, steps = [job], [], []
    if predictor.feels_pressure[i]:
        jobs.append(replace(job, pressure_deviation=job.pressure_deviation + PRESSURE_STEP))
        places.append(PRESSURE)
        steps.append(PRESSURE_STEP)
    if predictor.feels_damping[i]:
        row = job.row.copy()
        row[predictor.damping_column] *= np.exp(DAMPING_STEP)
        jobs.append(replace(job, row=row))
        places.append(DAMPING_DEVIATION)
        steps.append(DAMPING_STEP)
    plain, *moved = predictor.run(jobs, times_s=times)
    answers = np.zeros((OWN, times.size))
    answers[RELEASE] = -np.gradient(plain.observed_position_m, times)
    answers[ORIGIN] = 1.0
    for place, step, other in zip(places, steps, moved, strict=True):
        answers[place] = (other.observed_position_m - plain.observed_position_m) / step
    return plain.observed_position_m, answers
