"""Nonlinear least squares for a missing force, with model parameters and trial effects free.

The linear inversion (`vinetrack.diagnosis.force_inversion`) tells laws apart; but a force that slows a vine down keeps
it longer where the force acts, so that the linear estimate of a force of a tenth of the drive comes out a fifth too
large. Here the motions respond to the force in full (`vinetrack.diagnosis.force_sensitivities.with_force`), and
Gauss-Newton steps, damped as by Levenberg and Marquardt where needed, find the amplitudes, the shape parameters of the
law, the model parameters and the trial effects. The search starts from the fitted motions, which lie near the tracks:
simulated from the parameters of the model without the force, they would run ahead of the tracks.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.diagnosis.force_inversion import ForceEstimate, LinearInversion, scaled_pseudo_inverse
from vinetrack.diagnosis.force_laws import Law
from vinetrack.diagnosis.force_sensitivities import (
    FittedMotion,
    acceleration_sensitivities,
    trial_of_job,
    with_force,
    with_model_terms,
)
from vinetrack.diagnosis.force_surface import SmoothForce
from vinetrack.dynamics.force_terms import evaluate
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.inference.fit_data import FitTrial
from vinetrack.inference.fit_result import Fit
from vinetrack.inference.mixed_effects import trial_effect_prior
from vinetrack.inference.parameters import YIELD_PRESSURE
from vinetrack.inference.sensitivity import N_TRIAL_EFFECTS, ORIGIN, RELEASE
from vinetrack.inference.trajectory_jobs import Job
from vinetrack.inference.whitening import whiten

MAX_STEPS, MOTION_CORRECTIONS = 12, 2  # Most Gauss-Newton steps, and corrections of the motions at each (chosen)

# The first steps are undamped Gauss-Newton steps, taken even where the cost rises (chosen)
UNDAMPED_STEPS, STEPS_WITH_SHAPE_HELD = 5, 2

MAX_STEPS_ON_TRACKS = 10  # Most steps on motions that lie on the tracks, before motions respond to the force (chosen)

# Damping factors of Levenberg and Marquardt, for steps that must lower the cost (chosen)
FIRST_DAMPING, LEAST_DAMPING = 1e-3, 1e-5

UNDAMPED_SUCCESS = 0.5  # Part of χ² above which the undamped steps have failed (chosen)

# Step of finite differences, in the fit's scaling of parameters, and relative for shape parameters (derived)
DIFFERENCE_STEP = 1e-3

LAST_LENGTH_FRACTION = 0.96  # Part of the length up to which points are used (chosen)

CONVERGENCE_TOLERANCE = 1e-3  # Relative fall of χ² below which the search ends (chosen)

SHAPE_CUTOFF = 1e-12  # Relative eigenvalue of the scaled normal matrix below which a direction does not move (derived)

MAX_RELATIVE_SHAPE_STEP = 0.2  # Part of its size by which a shape parameter may move in one step (chosen)


@dataclass(frozen=True)
class RefinedLaw:
    """A law after the nonlinear fit: amplitudes and the standard error of one, N, and the χ² that remains.
    `parameter_shift` is how far the model parameters moved, in the fit's own scaling.
    """

    law: Law
    amplitude: Floats
    sigma: float
    chi2: float
    parameter_shift: Floats


@dataclass(frozen=True)
class SearchPoint:
    """The unknowns at one point of a search, and the motions that they are linearised about. Where
    `motions_include_force`, the motions are those of these parameters and this force. Otherwise they are others near
    by, and their defect (by how much they violate the equation of motion) is carried as a residual.
    """

    theta: Floats
    trial_effects: Floats
    law: Law | SmoothForce
    amplitude: Floats
    motions: list[FittedMotion]
    motions_include_force: bool = True


@dataclass(frozen=True)
class NormalEquations:
    """Gauss-Newton equations `matrix` · step = `score` at a point, and the cost there (χ² with all priors). Unknowns in
    order: model parameters, amplitudes, shape parameters, effects of each trial.
    """

    cost: float
    matrix: Floats
    score: Floats


def refine_law(
    fit: Fit,
    inversion: LinearInversion,
    motions: Sequence[FittedMotion],
    law: Law,
    linear: ForceEstimate,
    *,
    thorough: bool = False,
) -> RefinedLaw | None:
    """Fit a law by nonlinear least squares, starting from the linear inversion."""
    start = SearchPoint(inversion.state.theta, inversion.trial_effects, law, 0.0 * linear.amplitude, list(motions))
    best = _gauss_newton(fit, inversion, start, 0.0)
    if thorough and (best is None or best[1].cost > UNDAMPED_SUCCESS * inversion.chi2_without_force):
        best = _gauss_newton(fit, inversion, start, FIRST_DAMPING)
    if best is None:
        return None
    point, normal = best
    p, q = point.theta.size, point.amplitude.size
    inflation = max(1.0, normal.cost / inversion.n_points)
    covariance = scaled_pseudo_inverse(normal.matrix, SHAPE_CUTOFF)
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0) * inflation)
    relative = linear.sigma / max(float(np.hypot.reduce(linear.amplitude)), 1e-300)
    return RefinedLaw(
        law=point.law if isinstance(point.law, Law) else law,
        amplitude=point.amplitude,
        sigma=max(float(np.sqrt(np.mean(sigma[p : p + q] ** 2))), relative * float(np.hypot.reduce(point.amplitude))),
        chi2=normal.cost,
        parameter_shift=point.theta - inversion.state.theta,
    )


def optimise_smooth_force(fit: Fit, inversion: LinearInversion, start: SearchPoint) -> SearchPoint | None:
    """Find the most probable smooth force under the prior of its amplitudes, with all other unknowns free."""
    begin = start if start.motions_include_force else _settled_on_tracks(fit, inversion, start)
    best = _gauss_newton(fit, inversion, begin, LEAST_DAMPING)
    return None if best is None else best[0]


def _gauss_newton(
    fit: Fit, inversion: LinearInversion, start: SearchPoint, damping: float
) -> tuple[SearchPoint, NormalEquations] | None:
    """The point of least cost on the way from `start`; without damping the first steps may raise the cost."""
    best: tuple[SearchPoint, NormalEquations] | None = None
    point, undamped = start, 0 if damping else UNDAMPED_STEPS
    for iteration in range(MAX_STEPS):
        try:
            with np.errstate(all="raise", under="ignore"):
                point = _with_updated_motions(fit, point)
                normal = normal_equations(fit, inversion, point)
        except (SimulationError, FloatingPointError, np.linalg.LinAlgError):
            break
        before = best
        if best is None or normal.cost < best[1].cost:
            best = point, normal
        if iteration < undamped:
            point = _step(inversion, point, normal, 0.0, shape_free=iteration >= STEPS_WITH_SHAPE_HELD)
            continue
        if undamped and best[1].cost > UNDAMPED_SUCCESS * inversion.chi2_without_force:
            break
        if before is not None and best is not before:
            damping *= 0.3
            if best[1].cost > before[1].cost * (1 - CONVERGENCE_TOLERANCE):
                break
        elif before is not None and iteration > undamped:
            damping = max(5 * damping, LEAST_DAMPING)
        point = _step(inversion, *best, damping, shape_free=iteration >= STEPS_WITH_SHAPE_HELD)
    return best


def _settled_on_tracks(fit: Fit, inversion: LinearInversion, start: SearchPoint) -> SearchPoint:
    """All unknowns optimised with the motions held on the tracks, where only the parameters enter nonlinearly."""
    damping, best, point = FIRST_DAMPING, None, start
    for _ in range(MAX_STEPS_ON_TRACKS):
        try:
            with np.errstate(all="raise", under="ignore"):
                point = _with_updated_motions(fit, point)
                normal = normal_equations(fit, inversion, point)
        except (SimulationError, FloatingPointError, np.linalg.LinAlgError):
            normal = None
        if normal is not None and (best is None or normal.cost < best[1].cost):
            best, damping = (point, normal), 0.1 * damping
        else:
            damping *= 30
        if best is None:
            break
        point = replace(_step(inversion, *best, damping, shape_free=True), motions_include_force=False)
    return replace(start if best is None else best[0], motions_include_force=True)


def normal_equations(fit: Fit, inversion: LinearInversion, point: SearchPoint) -> NormalEquations:
    """Gauss-Newton equations of all unknowns at a point."""
    theta, trial_effects, q, s = point.theta, point.trial_effects, point.amplitude.size, len(point.law.shape_names)
    problem = inversion.problem
    p, n = theta.size, trial_effects.shape[0]
    sensitivities = acceleration_sensitivities(fit, trial_effects, point.motions, _acceleration_derivatives(fit, point))
    centre, precision = trial_effect_prior(problem, inversion.state)
    size = p + q + s + n * N_TRIAL_EFFECTS
    matrix, score = np.zeros((size + 1, size + 1)), np.zeros(size + 1)
    cost = float(np.sum(precision * (trial_effects - centre) ** 2))
    cost += float(np.sum(problem.prior_precision * (theta - problem.prior_mean) ** 2))
    cost += point.law.amplitude_precision * float(point.amplitude @ point.amplitude)
    for i, trial_data in enumerate(fit.predictor.data):
        position, velocity = _observed(point.motions[i], trial_data.time_s - trial_effects[i, RELEASE])
        residual = trial_data.lead_position_m - trial_effects[i, ORIGIN] - position
        of_trial = sensitivities[i]
        if not point.motions_include_force:
            of_trial, of_defect = of_trial[:, :-1], of_trial[:, -1]
            residual = residual - of_defect
        rows = np.column_stack([of_trial[:, 2:], -velocity, np.ones(residual.size), of_trial[:, :2], residual])
        used = _points_before_end(trial_data, trial_effects[i])
        relative_sd = None if trial_data.relative_sd is None else trial_data.relative_sd[used]
        white = whiten(rows[used], trial_data.first[used], inversion.state.rho, relative_sd) / math.sqrt(
            inversion.state.variance[i]
        )
        gram = white.T @ white
        effects = p + q + s + i * N_TRIAL_EFFECTS + np.arange(N_TRIAL_EFFECTS)
        keys = np.where(problem.index[i] >= 0, problem.index[i], size)
        index = np.concatenate([keys, p + np.arange(q + s), effects])
        matrix[np.ix_(index, index)] += gram[:-1, :-1]
        np.add.at(score, index, gram[:-1, -1])
        matrix[effects, effects] += precision[i]
        score[effects] -= precision[i] * (trial_effects[i] - centre[i])
        cost += float(gram[-1, -1])
    matrix, score = matrix[:size, :size], score[:size]
    matrix[np.arange(p), np.arange(p)] += problem.prior_precision
    score[:p] -= problem.prior_precision * (theta - problem.prior_mean)
    matrix[np.arange(p, p + q), np.arange(p, p + q)] += point.law.amplitude_precision
    score[p : p + q] -= point.law.amplitude_precision * point.amplitude
    held = np.flatnonzero(~problem.free)
    matrix[held, :] = matrix[:, held] = score[held] = 0.0
    return NormalEquations(cost, matrix, score)


def _step(
    inversion: LinearInversion, point: SearchPoint, normal: NormalEquations, damping: float, *, shape_free: bool
) -> SearchPoint:
    """The next point, with steps of shape parameters and releases limited and parameters kept inside their bounds."""
    p, q = point.theta.size, point.amplitude.size
    law = point.law
    matrix = normal.matrix + damping * np.diag(np.diag(normal.matrix))
    if not shape_free:
        held = p + q + np.arange(len(law.shape_names))
        matrix[held, :] = matrix[:, held] = 0.0
    step = scaled_pseudo_inverse(matrix, SHAPE_CUTOFF) @ normal.score
    for k, name in enumerate(law.shape_names):
        limit = MAX_RELATIVE_SHAPE_STEP * law.size_of(name)
        law = law.shifted(name, float(np.clip(step[p + q + k], -limit, limit)))
    law = law.within_growth(max(float(motion.lead_position_m.max()) for motion in point.motions))
    release_limit_s = 2 * np.array([trial_data.frame_s for trial_data in inversion.data])
    trial_effects = point.trial_effects + step[p + q + len(law.shape_names) :].reshape(-1, N_TRIAL_EFFECTS)
    trial_effects[:, RELEASE] = point.trial_effects[:, RELEASE] + np.clip(
        trial_effects[:, RELEASE] - point.trial_effects[:, RELEASE], -release_limit_s, release_limit_s
    )
    theta = np.clip(point.theta + step[:p], inversion.problem.lower, inversion.problem.upper)
    return replace(
        point,
        theta=theta,
        trial_effects=trial_effects,
        law=law,
        amplitude=point.amplitude + step[p : p + q],
    )


def _with_updated_motions(fit: Fit, point: SearchPoint) -> SearchPoint:
    """The point with its motions corrected for its parameters and, where they include it, its force."""
    jobs = fit.predictor.jobs(point.theta, point.trial_effects)
    motions = [with_model_terms(_with_parameters_of_job(fit, *pair)) for pair in zip(point.motions, jobs, strict=True)]
    corrections = MOTION_CORRECTIONS if point.motions_include_force else 0
    return replace(point, motions=with_force(motions, lambda motion: _force_along(point, motion), corrections))


def _force_along(point: SearchPoint, motion: FittedMotion) -> Floats:
    law = point.law
    # Summing many splines with their coefficients costs far less than evaluating each.
    if isinstance(law, SmoothForce):
        return law.force(motion, point.amplitude)
    return law.unit_force(motion) @ point.amplitude


def _points_before_end(trial_data: FitTrial, trial_effects: Floats) -> slice:
    """The points before the end of growth, since a corrected motion does not end where its model would."""
    length_m = trial_data.trial.length_m if math.isfinite(trial_data.trial.length_m) else math.inf
    after_end = np.flatnonzero(trial_data.lead_position_m - trial_effects[ORIGIN] > LAST_LENGTH_FRACTION * length_m)
    return slice(0, int(after_end[0]) if after_end.size else trial_data.time_s.size)


def _observed(motion: FittedMotion, since_s: Floats) -> tuple[Floats, Floats]:
    """Observed position and velocity of the leading edge, by cubic interpolation between the points of the grid."""
    from scipy.interpolate import CubicHermiteSpline

    curve = CubicHermiteSpline(motion.time_s, motion.lead_position_m, motion.lead_velocity_m_s)
    at = np.clip(since_s, 0.0, motion.time_s[-1])
    moving = (since_s > 0) & (since_s < motion.time_s[-1])
    offset = np.interp(at, motion.time_s, motion.observation_offset_m)
    slope = np.interp(at, motion.time_s, motion.observed_slope)
    return np.asarray(curve(at) + offset), np.where(moving, curve(at, 1) * slope, 0.0)


def _acceleration_derivatives(fit: Fit, point: SearchPoint) -> list[Floats]:
    """Derivatives of the acceleration along each motion, shape (n_times, n). By [pressure and B of the trial, every
    model parameter, amplitudes, shape parameters]. Where the motions do not include the force, a last column holds
    their defect.
    """
    layout, theta = fit.predictor.layout, point.theta
    jobs = fit.predictor.jobs(theta, point.trial_effects)
    damping = fit.predictor.damping_column
    derivatives = []
    for i, (motion, job) in enumerate(zip(point.motions, jobs, strict=True)):
        varied = [job._replace(pressure_deviation=job.pressure_deviation + DIFFERENCE_STEP)]
        varied.append(
            _with_parameter(job, damping, job.row[damping] * math.exp(DIFFERENCE_STEP)) if damping >= 0 else job
        )
        for column, key in enumerate(layout.keys):
            number = layout.free[layout.index[i, column]] if layout.index[i, column] >= 0 else None
            if number is None:
                varied.append(job)
                continue
            at = theta[layout.index[i, column]]
            change = number.from_scaled(at + DIFFERENCE_STEP) - number.from_scaled(at)
            if key == YIELD_PRESSURE:
                varied.append(job._replace(yield_pressure_Pa=job.yield_pressure_Pa + change))
            else:
                k = layout.model.parameter_names.index(key)
                if number.logarithmic:
                    factor = number.from_scaled(at + DIFFERENCE_STEP) / number.from_scaled(at)
                    varied.append(_with_parameter(job, k, job.row[k] * factor))
                else:
                    varied.append(_with_parameter(job, k, job.row[k] + change))
        has_deviation = (fit.predictor.has_pressure_deviation[i], fit.predictor.has_damping_deviation[i])
        affected = [*has_deviation, *[True] * len(layout.keys)]
        columns = [
            (_acceleration(fit, point, motion, changed_job) - motion.model_acceleration) / DIFFERENCE_STEP
            if affects and changed_job is not job
            else 0.0 * motion.model_acceleration
            for changed_job, affects in zip(varied, affected, strict=True)
        ]
        defect = (
            []
            if point.motions_include_force
            else [motion.model_acceleration + _force_along(point, motion) / motion.mass_kg - motion.acceleration]
        )
        derivatives.append(np.column_stack([*columns, _law_derivatives(point, motion), *defect]))
    return derivatives


def _acceleration(fit: Fit, point: SearchPoint, motion: FittedMotion, job: Job) -> Floats:
    """Acceleration along a motion with a job's parameters, with the change of a force that depends on the pressure."""
    changed = _with_parameters_of_job(fit, motion, job)
    y, v = motion.lead_position_m, motion.lead_velocity_m_s
    terms = evaluate(changed.model, changed.trial, motion.time_s, y, v, measured_Pa=motion.measured_Pa)
    if not point.amplitude.any() or np.array_equal(np.broadcast_to(terms.pressure_Pa, y.shape), motion.pressure_Pa):
        return terms.acceleration_m_s2
    at_pressure = replace(motion, pressure_Pa=np.broadcast_to(terms.pressure_Pa, y.shape))
    return terms.acceleration_m_s2 + (_force_along(point, at_pressure) - _force_along(point, motion)) / motion.mass_kg


def _law_derivatives(point: SearchPoint, motion: FittedMotion) -> Floats:
    """Derivatives of the acceleration by each amplitude and each shape parameter of the law."""
    unit_force = point.law.unit_force(motion)
    by_shape = [
        (point.law.shifted(name, step).unit_force(motion) - unit_force) @ point.amplitude / step
        for name, step in ((name, DIFFERENCE_STEP * point.law.size_of(name)) for name in point.law.shape_names)
    ]
    return np.column_stack([unit_force, *by_shape]) / motion.mass_kg[:, None]


def _with_parameters_of_job(fit: Fit, motion: FittedMotion, job: Job) -> FittedMotion:
    """The same motion, its model and trial with the parameters of a job."""
    values = dict(zip(fit.model.parameter_names, job.row.tolist(), strict=True))
    trial = trial_of_job(fit.predictor.data[job.trial].trial, job)
    return replace(motion, model=fit.model.with_values(values), trial=trial)


def _with_parameter(job: Job, column: int, value: float) -> Job:
    row = job.row.copy()
    row[column] = value
    return job._replace(row=row)
