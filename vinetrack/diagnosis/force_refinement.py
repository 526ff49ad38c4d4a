"""A simple law of force fitted in full: its size and shape, the model's numbers, and every trial's own.

Linear answers tell laws apart; but a force that slows a vine down keeps it longer where the force acts, and the size of
a tenth of the drive comes out a fifth too large. Here the motions follow the force as it is (`force_answers.pushed`),
and Gauss and Newton's steps go on from there. They begin from the fitted motions, which lie near the tracks, so that a
force need not first lose what the model without it would have run ahead.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.diagnosis.force_inversion import ForceFit, Gain
from vinetrack.diagnosis.force_laws import Law
from vinetrack.diagnosis.force_sensitivities import (
    FittedMotion,
    as_it_was,
    push_sensitivities,
    pushed,
    with_derivatives,
)
from vinetrack.diagnosis.force_surface import Surface
from vinetrack.dynamics.force_terms import evaluate
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.inference.fit_data import FitTrial
from vinetrack.inference.fit_result import Fit
from vinetrack.inference.mixed_effects import trial_effect_prior
from vinetrack.inference.parameters import YIELD_PRESSURE
from vinetrack.inference.sensitivity import N_TRIAL_EFFECTS, ORIGIN, RELEASE
from vinetrack.inference.trajectory_jobs import Job
from vinetrack.inference.whitening import whiten

STEPS, ROUNDS = 12, 2
"""Steps of a refinement and rounds of each motion. Chosen: every round leaves a tenth of the error."""

BARE, SHAPED = 5, 2
"""So many first steps are bare ones of Gauss and Newton, the cost rising or not: pressure and B of a trial do nearly
the same, a first step along their difference overshoots, and the next ones mend it. Place and scale wait for two.
Chosen; the damped steps that follow make up for a bad choice."""

NEAR = 10
"""Steps on motions that lie on the tracks, before motions follow the force. Chosen: numbers such as n, in which the
model bends, settle in three to six; at half of it some have not, at twice only time is spent."""

FIRST_DAMPING, LEAST_DAMPING = 1e-3, 1e-5
"""Of Levenberg and Marquardt, for steps that may only lower the cost: the first where bare ones lead nowhere. Chosen
as usual for the method; only time depends on it."""

MENDED = 0.5
"""Part of χ² that the bare steps may leave, to have led anywhere. Chosen: half of χ²."""

SMALL = 1e-3
"""Step of a difference, as the fit holds numbers, and relative for places and scales. Derived: 1000 times the
integrator's error."""

END = 0.96
"""Part of the length up to which points count. Chosen: a hundredth beyond the fit's END_FRACTION."""

SETTLED = 1e-3
"""Part of χ² by which a step must lower it for another to follow. Chosen: a thousandth of χ² moves no law's place in
the ranking."""


@dataclass(frozen=True)
class Refined:
    """A law as the full fit found it: amplitudes, N, with the error of one, and what is left.

    `numbers` is how far the model's own numbers moved, as the fit holds them.
    """

    law: Law
    amplitude: Floats
    sigma: float
    chi2: float
    numbers: Floats


@dataclass(frozen=True)
class Place:
    """Where the search stands; `motions` are those of these numbers, with the force.

    Not `driven`, they are others near by: what they lack is then a push of its own.
    """

    theta: Floats
    trial_effects: Floats
    law: Law | Surface
    amplitude: Floats
    motions: list[FittedMotion]
    driven: bool = True


@dataclass(frozen=True)
class Normal:
    """Cost at a place, its curvature and slope by numbers, amplitudes, shapes and the own numbers of all trials."""

    cost: float
    square: Floats
    slope: Floats


def refine(
    model_fit: Fit, fit: ForceFit, motions: Sequence[FittedMotion], law: Law, gain: Gain, *, thorough: bool = False
) -> Refined | None:
    """Fit a law in full, begun from its linear fit; None where it cannot be followed.

    Parameters
    ----------
    model_fit : the fit that lacks the force.
    fit : its linear answers to forces.
    motions : sequence of FittedMotion
        The fitted motions that `gain` belongs to.
    law : form of the force.
    gain : its linear fit.
    thorough : bool
        Whether to search once more with care where the quick way leads nowhere.

    Returns
    -------
    Refined or None
    """
    start = Place(fit.state.theta, fit.trial_effects, law, 0.0 * gain.amplitude, list(motions))
    best = _searched(model_fit, fit, start, 0.0)
    if thorough and (best is None or best[1].cost > MENDED * fit.chi2):
        best = _searched(model_fit, fit, start, FIRST_DAMPING)
    if best is None:
        return None
    place, normal = best
    p, q = place.theta.size, place.amplitude.size
    inflated = max(1.0, normal.cost / fit.points)
    sigma = np.sqrt(np.maximum(np.diag(_inverse(normal.square)), 0.0) * inflated)
    relative = gain.sigma / max(float(np.hypot.reduce(gain.amplitude)), 1e-300)
    return Refined(
        law=place.law if isinstance(place.law, Law) else law,
        amplitude=place.amplitude,
        sigma=max(float(np.sqrt(np.mean(sigma[p : p + q] ** 2))), relative * float(np.hypot.reduce(place.amplitude))),
        chi2=normal.cost,
        numbers=place.theta - fit.state.theta,
    )


def followed(model_fit: Fit, fit: ForceFit, place: Place) -> Place | None:
    """Where a force with amplitudes of its own precision leads, all other numbers free beside it.

    Parameters
    ----------
    model_fit : the fit that lacks the force.
    fit : its linear answers to forces.
    place : where to begin. What is not driven settles on its motions first.

    Returns
    -------
    Place, or None where it cannot be followed
    """
    begin = place if place.driven else _on_tracks(model_fit, fit, place)
    best = _searched(model_fit, fit, begin, LEAST_DAMPING)
    return None if best is None else best[0]


def _searched(model_fit: Fit, fit: ForceFit, start: Place, damping: float) -> tuple[Place, Normal] | None:
    """The best place on the way down from `start`; without damping the first steps may lead up."""
    best: tuple[Place, Normal] | None = None
    place, bare = start, 0 if damping else BARE
    for turn in range(STEPS):
        try:
            with np.errstate(all="raise", under="ignore"):
                place = _as_driven(model_fit, place)
                normal = normal_equations(model_fit, fit, place)
        except (SimulationError, FloatingPointError, np.linalg.LinAlgError):
            break
        before = best
        if best is None or normal.cost < best[1].cost:
            best = place, normal
        if turn < bare:
            place = _stepped(fit, place, normal, 0.0, shaped=turn >= SHAPED)
            continue
        if bare and best[1].cost > MENDED * fit.chi2:
            break
        if before is not None and best is not before:
            damping *= 0.3
            if best[1].cost > before[1].cost * (1 - SETTLED):
                break
        elif before is not None and turn > bare:
            damping = max(5 * damping, LEAST_DAMPING)
        place = _stepped(fit, *best, damping, shaped=turn >= SHAPED)
    return best


def _on_tracks(model_fit: Fit, fit: ForceFit, place: Place) -> Place:
    """The numbers settled on motions that lie on the tracks, where the model is linear in all but its own numbers."""
    damping, best, tried = FIRST_DAMPING, None, place
    for _ in range(NEAR):
        try:
            with np.errstate(all="raise", under="ignore"):
                tried = _as_driven(model_fit, tried)
                normal = normal_equations(model_fit, fit, tried)
        except (SimulationError, FloatingPointError, np.linalg.LinAlgError):
            normal = None
        if normal is not None and (best is None or normal.cost < best[1].cost):
            best, damping = (tried, normal), 0.1 * damping
        else:
            damping *= 30
        if best is None:
            break
        tried = replace(_stepped(fit, *best, damping, shaped=True), driven=False)
    return replace(place if best is None else best[0], driven=True)


def _force(place: Place, motion: FittedMotion) -> Floats:
    law = place.law
    # Of many splines the sum costs far less than each.
    return law.force(motion, place.amplitude) if isinstance(law, Surface) else law.along(motion) @ place.amplitude


def _as_driven(fit: Fit, place: Place) -> Place:
    """The motions of these numbers and this force, corrected from those of the place before."""
    jobs = fit.predictor.jobs(place.theta, place.trial_effects)
    motions = [with_derivatives(_with_numbers(fit, *pair)) for pair in zip(place.motions, jobs, strict=True)]
    return replace(place, motions=pushed(motions, lambda motion: _force(place, motion), ROUNDS if place.driven else 0))


def _with_numbers(fit: Fit, motion: FittedMotion, job: Job) -> FittedMotion:
    """The motion as it is, its model and trial with other numbers."""
    values = dict(zip(fit.model.parameter_names, job.row.tolist(), strict=True))
    trial = as_it_was(fit.predictor.data[job.trial].trial, job)
    return replace(motion, model=fit.model.with_values(values), trial=trial)


def normal_equations(model_fit: Fit, fit: ForceFit, place: Place) -> Normal:
    """Normal equations of all unknowns at a place.

    Parameters
    ----------
    model_fit : the fit that lacks the force.
    fit : its linear answers to forces.
    place : where they are taken.

    Returns
    -------
    Normal
    """
    theta, trial_effects, q, s = place.theta, place.trial_effects, place.amplitude.size, len(place.law.shape_names)
    p, n = theta.size, trial_effects.shape[0]
    columns = push_sensitivities(model_fit, trial_effects, place.motions, _pushes(model_fit, place))
    centre, precision = trial_effect_prior(fit.problem, fit.state)
    size = p + q + s + n * N_TRIAL_EFFECTS
    square, slope = np.zeros((size + 1, size + 1)), np.zeros(size + 1)
    cost = float(np.sum(precision * (trial_effects - centre) ** 2))
    cost += float(np.sum(fit.problem.prior_precision * (theta - fit.problem.prior_mean) ** 2))
    cost += place.law.precision * float(place.amplitude @ place.amplitude)
    for i, trial_data in enumerate(model_fit.predictor.data):
        position, velocity = _seen(place.motions[i], trial_data.time_s - trial_effects[i, RELEASE])
        left = trial_data.lead_position_m - trial_effects[i, ORIGIN] - position
        answers = columns[i]
        if not place.driven:
            answers, lacking = answers[:, :-1], answers[:, -1]
            left = left - lacking
        rows = np.column_stack([answers[:, 2:], -velocity, np.ones(left.size), answers[:, :2], left])
        growing = _growing(trial_data, trial_effects[i])
        relative_sd = None if trial_data.relative_sd is None else trial_data.relative_sd[growing]
        white = whiten(rows[growing], trial_data.first[growing], fit.state.rho, relative_sd) / math.sqrt(
            fit.state.variance[i]
        )
        gram = white.T @ white
        mine = p + q + s + i * N_TRIAL_EFFECTS + np.arange(N_TRIAL_EFFECTS)
        keys = np.where(fit.problem.index[i] >= 0, fit.problem.index[i], size)
        index = np.concatenate([keys, p + np.arange(q + s), mine])
        square[np.ix_(index, index)] += gram[:-1, :-1]
        np.add.at(slope, index, gram[:-1, -1])
        square[mine, mine] += precision[i]
        slope[mine] -= precision[i] * (trial_effects[i] - centre[i])
        cost += float(gram[-1, -1])
    square, slope = square[:size, :size], slope[:size]
    square[np.arange(p), np.arange(p)] += fit.problem.prior_precision
    slope[:p] -= fit.problem.prior_precision * (theta - fit.problem.prior_mean)
    square[np.arange(p, p + q), np.arange(p, p + q)] += place.law.precision
    slope[p : p + q] -= place.law.precision * place.amplitude
    still = np.flatnonzero(~fit.problem.free)
    square[still, :] = square[:, still] = slope[still] = 0.0
    return Normal(cost, square, slope)


def _inverse(square: Floats) -> Floats:
    scale = np.where(np.diag(square) > 0, 1 / np.sqrt(np.maximum(np.diag(square), 1e-300)), 0.0)
    inverse = np.linalg.pinv(square * scale[:, None] * scale, rcond=1e-12, hermitian=True)
    return np.asarray(inverse * scale[:, None] * scale)


def _growing(trial_data: FitTrial, trial_effects: Floats) -> slice:
    """The points before the end of growth: a motion that is corrected does not end where it ought to."""
    length_m = trial_data.trial.length_m if math.isfinite(trial_data.trial.length_m) else math.inf
    beyond = np.flatnonzero(trial_data.lead_position_m - trial_effects[ORIGIN] > END * length_m)
    return slice(0, int(beyond[0]) if beyond.size else trial_data.time_s.size)


def _seen(motion: FittedMotion, since_s: Floats) -> tuple[Floats, Floats]:
    """Position and speed of the leading edge as the camera sees them, cubic between the points of the grid."""
    from scipy.interpolate import CubicHermiteSpline

    curve = CubicHermiteSpline(motion.time_s, motion.lead_position_m, motion.lead_velocity_m_s)
    at = np.clip(since_s, 0.0, motion.time_s[-1])
    moving = (since_s > 0) & (since_s < motion.time_s[-1])
    offset = np.interp(at, motion.time_s, motion.offset_m)
    seen = np.interp(at, motion.time_s, motion.seen)
    return np.asarray(curve(at) + offset), np.where(moving, curve(at, 1) * seen, 0.0)


def _pushes(fit: Fit, place: Place) -> list[Floats]:
    """Accelerations by a unit of [pressure, B of the trial, every key, amplitudes, shapes], (n_times, n) each.

    Where motions are not driven a last column holds what they lack.
    """
    layout, theta = fit.predictor.layout, place.theta
    jobs = fit.predictor.jobs(theta, place.trial_effects)
    damping = fit.predictor.damping_column
    pushes = []
    for i, (motion, job) in enumerate(zip(place.motions, jobs, strict=True)):
        varied = [job._replace(pressure_deviation=job.pressure_deviation + SMALL)]
        varied.append(_with(job, damping, job.row[damping] * math.exp(SMALL)) if damping >= 0 else job)
        for column, key in enumerate(layout.keys):
            number = layout.free[layout.index[i, column]] if layout.index[i, column] >= 0 else None
            if number is None:
                varied.append(job)
                continue
            at = theta[layout.index[i, column]]
            change = number.from_scaled(at + SMALL) - number.from_scaled(at)
            if key == YIELD_PRESSURE:
                varied.append(job._replace(yield_pressure_Pa=job.yield_pressure_Pa + change))
            else:
                k = layout.model.parameter_names.index(key)
                factor = number.from_scaled(at + SMALL) / number.from_scaled(at) if number.logarithmic else 0.0
                varied.append(_with(job, k, job.row[k] * factor if number.logarithmic else job.row[k] + change))
        felt = [
            fit.predictor.has_pressure_deviation[i],
            fit.predictor.has_damping_deviation[i],
            *[True] * len(layout.keys),
        ]
        changes = [
            (_acceleration(fit, place, motion, moved) - motion.free) / SMALL
            if feels and moved is not job
            else 0.0 * motion.free
            for moved, feels in zip(varied, felt, strict=True)
        ]
        lacks = [] if place.driven else [motion.free + _force(place, motion) / motion.mass_kg - motion.actual]
        pushes.append(np.column_stack([*changes, _law_pushes(place, motion), *lacks]))
    return pushes


def _with(job: Job, column: int, value: float) -> Job:
    row = job.row.copy()
    row[column] = value
    return job._replace(row=row)


def _acceleration(fit: Fit, place: Place, motion: FittedMotion, job: Job) -> Floats:
    """What the model with a job's numbers says along a motion, and what a law of the pressure adds for these."""
    other = _with_numbers(fit, motion, job)
    y, v = motion.lead_position_m, motion.lead_velocity_m_s
    terms = evaluate(other.model, other.trial, motion.time_s, y, v, measured_Pa=motion.measured_Pa)
    if not place.amplitude.any() or np.array_equal(np.broadcast_to(terms.pressure_Pa, y.shape), motion.pressure_Pa):
        return terms.acceleration_m_s2
    felt = replace(motion, pressure_Pa=np.broadcast_to(terms.pressure_Pa, y.shape))
    return terms.acceleration_m_s2 + (_force(place, felt) - _force(place, motion)) / motion.mass_kg


def _law_pushes(place: Place, motion: FittedMotion) -> Floats:
    """Accelerations by a unit of each amplitude and of each number that shapes the law."""
    shape = place.law.along(motion)
    changes = [
        (place.law.shifted(name, step).along(motion) - shape) @ place.amplitude / step
        for name, step in ((name, SMALL * place.law.size_of(name)) for name in place.law.shape_names)
    ]
    return np.column_stack([shape, *changes]) / motion.mass_kg[:, None]


def _stepped(fit: ForceFit, place: Place, normal: Normal, damping: float, *, shaped: bool) -> Place:
    """The next place; a law's place or scale moves by no more than a fifth of its size at once."""
    p, q = place.theta.size, place.amplitude.size
    law = place.law
    square = normal.square + damping * np.diag(np.diag(normal.square))
    if not shaped:
        held = p + q + np.arange(len(law.shape_names))
        square[held, :] = square[:, held] = 0.0
    step = _inverse(square) @ normal.slope
    for k, name in enumerate(law.shape_names):
        reach = 0.2 * law.size_of(name)
        law = law.shifted(name, float(np.clip(step[p + q + k], -reach, reach)))
    law = law.kept_inside(max(float(motion.lead_position_m.max()) for motion in place.motions))
    reach_s = 2 * np.array([trial_data.frame_s for trial_data in fit.data])
    trial_effects = place.trial_effects + step[p + q + len(law.shape_names) :].reshape(-1, N_TRIAL_EFFECTS)
    trial_effects[:, RELEASE] = place.trial_effects[:, RELEASE] + np.clip(
        trial_effects[:, RELEASE] - place.trial_effects[:, RELEASE], -reach_s, reach_s
    )
    theta = np.clip(place.theta + step[:p], fit.problem.lower, fit.problem.upper)
    return replace(
        place,
        theta=theta,
        trial_effects=trial_effects,
        law=law,
        amplitude=place.amplitude + step[p : p + q],
    )
