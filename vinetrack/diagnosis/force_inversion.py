"""Forces that a model lacks, estimated from positions: one linear problem, with all other unknowns free.

About motions that need not obey the model, such as those that lie on the tracks, positions are

    y = y₀ + J δθ + Z δb_i + S f + d + e

J the sensitivities to the model parameters θ, Z those to the effects b_i of trial i (release, origin, pressure, B), S
those to the force, f its coefficients, d the response to what the forces of the model lack along these motions (their
defect), and e AR(1) noise of the tracks. θ and b_i have normal priors. b_i are eliminated trial by trial, θ over all
trials (Schur complements), so that only equations for f remain. Smooth forces are splines whose coefficients are a
Gaussian process. For the final word the motions are moved to the solution, where all is linearised again.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import cumulative_trapezoid
from scipy.interpolate import CubicHermiteSpline, make_interp_spline

from vinetrack.core.records import Floats, Trial
from vinetrack.diagnosis.ladder import LEAST_SCATTER, align_trials
from vinetrack.dynamics.audit import Terms, evaluate
from vinetrack.dynamics.model import Model
from vinetrack.inference.fit_data import FitTrial
from vinetrack.inference.fit_result import Fit
from vinetrack.inference.gaussian_processes import LENGTH_SCALES, posterior, products, root_of_covariance, splines
from vinetrack.inference.marginal_likelihood import DEVIATION_COLUMNS, FitState, Linearised, inverse_of_block
from vinetrack.inference.optimiser import TYPICAL_SPREADS, track_correlation
from vinetrack.inference.sensitivity import DAMPING_DEVIATION, N_TRIAL_EFFECTS, ORIGIN, PRESSURE, RELEASE, Jobs

# ------------------------------------------------------------------------------
# Motions, and the sensitivities of their positions to a small added force on the tail.
#
# Linearised about a motion x(t), the equation of motion m ẍ = F(x, ẋ, t) + f becomes the variational equation
#
#     δẍ = (∂a/∂x) δx + (∂a/∂ẋ) δẋ + f/m,   a = F/m
#
# It is linear in f, so that the responses to many forces of any shape are integrated together, with no model compiled
# for them. The derivatives are finite differences of the model's own terms (`vinetrack.dynamics.audit`).

N_STEPS = 400  # Steps of a motion, denser at its start (derived)

# Part of the highest speed below which a vine counts as standing still and does not respond to a small force (chosen)
LEAST_RELATIVE_SPEED = 1e-3

MOST_OF_LENGTH = 0.96  # Part of the length up to which points are used: a moved motion does not end as its model would


@dataclass(frozen=True)
class FittedMotion:
    """The motion of one trial on a fine grid since release; arrays have shape (N_STEPS + 1,), SI. `model` and `trial`
    are those of its parameters, `push` is a force beside the model's; `acceleration` is that of the tail.
    """

    trial: Trial
    model: Model
    measured_Pa: Floats | None
    time_s: Floats
    lead_position_m: Floats
    lead_velocity_m_s: Floats
    acceleration: Floats
    observed_slope: Floats
    observation_offset_m: Floats
    counts_until_s: float = math.inf
    push: Push | None = None

    @cached_property
    def terms(self) -> Terms:
        """The terms of the model along the motion."""
        y, v = self.lead_position_m, self.lead_velocity_m_s
        return evaluate(self.model, self.trial, self.time_s, y, v, measured_Pa=self.measured_Pa)

    @property
    def pressure_Pa(self) -> Floats:
        """Driving pressure, Pa."""
        return np.broadcast_to(self.terms.pressure_Pa, self.time_s.shape)

    @property
    def mass_kg(self) -> Floats:
        """All moving mass, kg."""
        return np.broadcast_to(self.terms.inertia_kg, self.time_s.shape)

    @property
    def pushed_acceleration(self) -> Floats:
        """The acceleration by the model and the force beside it, m/s²."""
        by_push = 0.0 if self.push is None else self.push(self) / self.mass_kg
        return np.asarray(self.terms.acceleration_m_s2 + by_push)

    @cached_property
    def derivatives(self) -> tuple[Floats, Floats]:
        """Stiffness and friction: derivatives of that acceleration by position and velocity of the tail."""
        y, v, r, here = self.lead_position_m, self.lead_velocity_m_s, self.trial.travel_ratio, self.pushed_acceleration
        step_y, step_v = 1e-4 * max(float(y.max()), 1e-9), 1e-4 * max(float(v.max()), 1e-9)
        further = replace(self, lead_position_m=y + step_y).pushed_acceleration
        faster = replace(self, lead_velocity_m_s=v + step_v).pushed_acceleration
        stands = v < LEAST_RELATIVE_SPEED * v.max()
        late = self.time_s > self.time_s[N_STEPS // 20]
        friction = np.where(stands & late, -1e9, np.minimum((faster - here) / (r * step_v), 0.0))
        return np.where(stands, 0.0, (further - here) / (r * step_y)), friction

    @property
    def tail_position_m(self) -> Floats:
        """Position of the tail, r·y, m."""
        return self.trial.travel_ratio * self.lead_position_m

    @property
    def tail_velocity_m_s(self) -> Floats:
        """Velocity of the tail, r·ẏ, m/s."""
        return self.trial.travel_ratio * self.lead_velocity_m_s

    @property
    def is_visited(self) -> NDArray[np.bool_]:
        """Steps within the track, shape (N_STEPS + 1,)."""
        return self.time_s <= self.counts_until_s


# A force along a motion, N, shape (n_times,); and those of unit coefficients, shape (n_times, n_coefficients)
Push = Callable[[FittedMotion], Floats]


def motions_of(fit: Fit, trial_effects: Floats) -> list[FittedMotion]:
    """Simulate the fitted motions with given trial effects. Shapes: trial_effects (n_trials, 4)."""
    predictor = fit.predictor
    jobs = predictor.jobs(fit.solution.state.theta, trial_effects)
    # 3.0: frames by which a motion is integrated beyond its recording, in case its release moves (chosen)
    grids = [
        max(trial_data.time_s[-1] - release_s + 3.0 * trial_data.frame_s, 1e-6) * np.linspace(0, 1, N_STEPS + 1) ** 2
        for trial_data, release_s in zip(predictor.data, jobs.release_s, strict=True)
    ]
    runs = predictor.run(jobs, [grid + release_s for grid, release_s in zip(grids, jobs.release_s, strict=True)])
    motions = []
    for trial_data, job, time_s, run in zip(predictor.data, jobs, grids, runs, strict=True):
        model, trial = _of_job(fit.model, trial_data.trial, job)
        y, v = run.lead_position_m, run.lead_velocity_m_s
        measured = None if trial_data.trace is None else np.interp(time_s + job.release_s, *trial_data.trace)
        if measured is None and any("chamber_rate" in effect.functions for effect in model):
            # Chamber pressure is held as it is along the fitted motion: its response to a small force is of higher
            # order.
            measured = evaluate(model, trial, time_s, y, v).pressure_Pa
        # Derivative of the observed position by the true position of the leading edge; 1 where it stands still
        velocity = np.gradient(y, time_s)
        moving = velocity > LEAST_RELATIVE_SPEED * velocity.max()
        by_time = np.gradient(run.observed_position_m, time_s)
        slope = np.where(moving, by_time / np.where(moving, velocity, 1.0), 1.0)
        acceleration = np.asarray(evaluate(model, trial, time_s, y, v, measured_Pa=measured).acceleration_m_s2)
        offset_m = run.observed_position_m - y
        motions.append(FittedMotion(trial, model, measured, time_s, y, v, acceleration, slope, offset_m))
    return motions


def _of_job(model: Model, trial: Trial, job: Jobs) -> tuple[Model, Trial]:
    """The model with the parameters of a job, and the trial with the pressure and yield pressure that it simulates."""
    values = dict(zip(model.parameter_names, job.row.tolist(), strict=True))
    yield_Pa = trial.yield_pressure_Pa if np.isnan(job.yield_pressure_Pa) else float(job.yield_pressure_Pa)
    pressure_Pa = trial.pressure_Pa * (1 + float(job.pressure_deviation))
    return model.with_values(values), replace(trial, pressure_Pa=pressure_Pa, yield_pressure_Pa=yield_Pa)


def acceleration_sensitivities(
    fit: Fit, trial_effects: Floats, motions: Sequence[FittedMotion], accelerations: Sequence[Floats]
) -> list[Floats]:
    """Derivatives of the observed positions of every trial with respect to the amplitudes of added accelerations of the
    tail. Shapes: trial_effects (n_trials, 4); accelerations (N_STEPS + 1, n) → (n_points, n).
    """
    dx, _ = _responses(motions, accelerations)
    sensitivities = []
    for i, (trial_data, motion, response) in enumerate(zip(fit.predictor.data, motions, dx, strict=True)):
        since_s = trial_data.time_s - trial_effects[i, RELEASE]
        observed = _between_steps(
            motion, since_s, response * motion.observed_slope[:, None] / motion.trial.travel_ratio
        )
        sensitivities.append(np.where(since_s[:, None] > 0, observed, 0.0))
    return sensitivities


def _between_steps(motion: FittedMotion, since_s: Floats, values: Floats) -> Floats:
    """Values at the steps of a motion interpolated linearly. Shapes: since_s (n,); values (N_STEPS + 1, k) → (n, k)."""
    return np.asarray(make_interp_spline(motion.time_s, values, k=1)(np.clip(since_s, 0.0, motion.time_s[-1])))


def _responses(motions: Sequence[FittedMotion], accelerations: Sequence[Floats]) -> tuple[Floats, Floats]:
    """δx, m, and δẋ, m/s, of every trial to added accelerations; all of shape (n_trials, N_STEPS + 1, n)."""
    time_s, k, c = map(np.array, zip(*((motion.time_s, *motion.derivatives) for motion in motions), strict=True))
    return integrate_responses(time_s, k, c, np.array(accelerations))


def integrate_responses(
    time_s: Floats, stiffness: Floats, friction: Floats, acceleration: Floats
) -> tuple[Floats, Floats]:
    """Integrate δẍ = k δx + c δẋ + a from rest, for several added accelerations a along each motion, by the L-stable,
    singly diagonally implicit Runge-Kutta scheme of two stages of Alexander, SIAM J. Numer. Anal. 14, 1006 (1977), to
    changes of position, m, and velocity, m/s, (n_trials, n_times, n). Shapes: acceleration as these; others without n.
    """
    gamma = 1 - 1 / math.sqrt(2)  # Its diagonal coefficient (derived)
    courses = stiffness[:, :, None], friction[:, :, None], acceleration
    dx, dv = np.zeros_like(acceleration), np.zeros_like(acceleration)
    x, v = dx[:, 0], dv[:, 0]
    for i, h in enumerate(np.diff(time_s).T[:, :, None]):
        implicit, explicit = gamma * h, (1 - gamma) * h
        k, c, a = (each[:, i + 1] for each in courses)
        k_stage, c_stage, a_stage = ((1 - gamma) * each[:, i] + gamma * each[:, i + 1] for each in courses)
        pivot_stage = 1 - implicit * c_stage - implicit * implicit * k_stage
        rate = (k_stage * (x + implicit * v) + c_stage * v + a_stage) / pivot_stage
        x, v = x + explicit * (v + implicit * rate), v + explicit * rate
        v = v + implicit * ((k * (x + implicit * v) + c * v + a) / (1 - implicit * c - implicit * implicit * k))
        x = x + implicit * v
        dx[:, i + 1], dv[:, i + 1] = x, v
    return dx, dv


def _moved(motion: FittedMotion, push: Floats, dx: Floats, dv: Floats) -> FittedMotion:
    """The motion after a change of the tail's position and velocity by an acceleration; growth does not run backwards.
    A change takes away at most half of the speed: the rest is left to the next.
    """
    r, fast = motion.trial.travel_ratio, motion.lead_velocity_m_s > 0.05 * motion.lead_velocity_m_s.max()
    slowed = np.where(dv < 0, 0.5 * motion.tail_velocity_m_s / np.maximum(-dv, 1e-12), 1.0)
    part, (stiffness, friction) = float(np.min(slowed, initial=1.0, where=fast)), motion.derivatives
    return replace(
        motion,
        lead_position_m=np.maximum(motion.lead_position_m + part * dx / r, 0.0),
        lead_velocity_m_s=np.maximum(motion.lead_velocity_m_s + part * dv / r, 0.0),
        acceleration=motion.acceleration + part * (stiffness * dx + friction * dv + push),
    )


# ------------------------------------------------------------------------------
# Motions that lie on the tracks, whatever the model says: the starting point for a force that is not small.
#
# The acceleration of every trial is a smooth function of time, a Gaussian process, integrated twice from rest at its
# release and fitted to positions. It is not used as data: the equation of motion is linearised about this motion, and
# the defect there (what the model's forces lack) enters as one more known acceleration, so that noise in the smoothed
# motion cancels to first order (quasilinearisation, Bellman & Kalaba 1965). About the motion of a model that lacks a
# large force the linearisation would be poor.


def _on_track(data: FitTrial, trial_effects: Floats, motion: FittedMotion) -> FittedMotion:
    since_s = data.time_s - trial_effects[RELEASE]
    position_m = data.lead_position_m - trial_effects[ORIGIN]
    position_m = position_m - np.interp(since_s, motion.time_s, motion.observation_offset_m)
    growing = (since_s > 0) & ~(position_m > MOST_OF_LENGTH * motion.trial.length_m)
    if np.count_nonzero(growing) <= 2:
        return motion
    last_s, count = float(since_s[growing].max()), 20  # Splines (chosen)
    # Even in the square root of time, and so denser where a vine accelerates
    accelerations = splines(np.sqrt(np.clip(motion.time_s / last_s, 0.0, 1.0)), count)
    velocities = cumulative_trapezoid(accelerations, motion.time_s, axis=0, initial=0)
    positions = cumulative_trapezoid(velocities, motion.time_s, axis=0, initial=0)
    rows = np.column_stack([_between_steps(motion, since_s, positions), position_m])[growing]
    products = rows.T @ rows / data.mean_noise_m**2
    # Amplitudes, in parts of the acceleration that would be the same throughout (chosen)
    amplitudes = 2 * rows[:, -1].max() / last_s**2 * np.geomspace(0.1, 30, 9)
    priors = [root_of_covariance(count, length) for length in LENGTH_SCALES]
    coefficients = posterior(products[:-1, :-1], products[:-1, -1], priors, amplitudes).mean
    return replace(
        motion,
        lead_position_m=np.maximum.accumulate(np.maximum(positions @ coefficients, 0.0)),
        lead_velocity_m_s=np.maximum(velocities @ coefficients, 0.0),
        acceleration=motion.trial.travel_ratio * (accelerations @ coefficients),
        counts_until_s=last_s,
    )


# ------------------------------------------------------------------------------
# One linear problem for every question about a force: least squares about a set of motions, all other unknowns free.

# Part of what a coefficient would have alone below which its information is rounding (derived)
LEAST_INFORMATION = 1e-8


@dataclass(frozen=True)
class ForcePoint:
    """Values of the parameters and trial effects, and motions near by. `by_parameters`: derivatives of the acceleration
    along each motion by pressure and B of the trial and by every model parameter, shape (n_times, 2 + n_keys).
    """

    theta: Floats
    trial_effects: Floats
    motions: Sequence[FittedMotion]
    by_parameters: Sequence[Floats]


class ForceEstimate(NamedTuple):
    """Least-squares estimate of coefficients of a force, N, and the fall of χ² that they bring. `sigma` is the root
    mean square standard error of a coefficient.
    """

    delta_chi2: float
    amplitude: Floats
    sigma: float
    degrees_of_freedom: float

    @property
    def delta_chi2_beyond_chance(self) -> float:
        """The fall of χ² in excess of its expectation under no force; at least 0."""
        return max(self.delta_chi2 - self.degrees_of_freedom, 0.0)


class ForceProblem:
    """A fit, the noise of its tracks, with which misfit of the model does not count as noise, and the priors of its
    parameters and trial effects, those of pressure and B from replicates: what is asked of forces. `start` has the
    fitted parameters, and motions that lie on the tracks, whatever the model says.
    """

    def __init__(self, fit: Fit) -> None:
        self.fit, self.data, self.prior = fit, fit.predictor.data, fit.solution.problem
        self.scatter = align_trials(fit).scatter
        rho = track_correlation(self.data)
        noise = np.array([trial_data.noise_m**2 for trial_data in self.data]) * (1 - rho**2)
        multiple = max(self.scatter.multiple, LEAST_SCATTER)
        spread = (multiple * TYPICAL_SPREADS[0], multiple * TYPICAL_SPREADS[1])
        effects = np.zeros((len(self.data), N_TRIAL_EFFECTS))
        effects[:, [RELEASE, ORIGIN]] = self.prior.release_origin_mean
        variance = np.maximum(noise, self.prior.least_variance)
        self.state = FitState(fit.solution.state.theta, effects, spread, rho, variance)
        self.n_points = float(sum(trial_data.time_s.size for trial_data in self.data))
        self.n_independent = 20 * len(self.data)  # Independent residuals where a model leaves more than noise (chosen)
        motions = [_on_track(*each) for each in zip(self.data, effects, motions_of(fit, effects), strict=True)]
        self.start = self.point(self.state.theta, effects, motions)

    def inflation(self, chi2: float) -> float:
        """Variance in units of the noise's where a model leaves this χ². What it leaves beyond the noise is correlated
        along a trial.
        """
        return 1 + max(chi2 / self.n_points - 1, 0.0) * max(self.n_points / self.n_independent, 1.0)

    def point(
        self, theta: Floats, trial_effects: Floats, motions: Sequence[FittedMotion], push: Push | None = None
    ) -> ForcePoint:
        """The terms of the model, and of a force beside it, along motions."""
        step = 1e-3  # Step of finite differences, in the fit's scaling of parameters (derived)
        predictor, effects = self.fit.predictor, np.eye(N_TRIAL_EFFECTS)[[PRESSURE, DAMPING_DEVIATION]]
        here = predictor.jobs(theta, trial_effects)
        by_effect = [predictor.jobs(theta, trial_effects + step * unit) for unit in effects]
        # The last stands for a parameter that a trial does not have, whose place is −1.
        by_parameter = [*(predictor.jobs(theta + step * unit, trial_effects) for unit in np.eye(theta.size)), here]
        moved, derivatives = [], []
        for i, (motion, index) in enumerate(zip(motions, predictor.layout.index, strict=True)):
            moved.append(replace(self._with_job(motion, here[i]), push=push))
            jobs = [jobs[i] for jobs in (*by_effect, *(by_parameter[k] for k in index))]
            after = [self._with_job(moved[i], job).pushed_acceleration for job in jobs]
            derivatives.append((np.column_stack(after) - moved[i].pushed_acceleration[:, None]) / step)
        return ForcePoint(theta, trial_effects, moved, derivatives)

    def _with_job(self, motion: FittedMotion, job: Jobs) -> FittedMotion:
        """The same motion, its model and trial with the parameters of a job."""
        model, trial = _of_job(motion.model, self.data[int(job.trial)].trial, job)
        return replace(motion, model=model, trial=trial)


class ForceEquations:
    """The normal equations of the coefficients of a force about a point, where they have given values (0): unknowns
    beside the parameters (`joint`). `cost` is χ² there with the priors of all others, `chi2` that with all others
    estimated anew; `information` (q, q) and `score` (q,) are those with all others eliminated.
    """

    def __init__(
        self, problem: ForceProblem, point: ForcePoint, unit_push: Push, coefficients: Floats | None = None
    ) -> None:
        self.problem, self.point, self.unit_push = problem, point, unit_push
        pushes = [unit_push(motion) for motion in point.motions]
        q, p = pushes[0].shape[1], point.theta.size
        self.coefficients = np.zeros(q) if coefficients is None else coefficients
        self.accelerations = [
            np.column_stack([
                columns,
                push / motion.mass_kg[:, None],
                motion.terms.acceleration_m_s2 + push @ self.coefficients / motion.mass_kg - motion.acceleration,
            ])
            for motion, columns, push in zip(point.motions, point.by_parameters, pushes, strict=True)
        ]  # fmt: skip
        sensitivities = acceleration_sensitivities(problem.fit, point.trial_effects, point.motions, self.accelerations)
        cross_products = np.stack([self._products(*of_trial) for of_trial in enumerate(sensitivities)])
        places, theta = np.tile(np.arange(q), (len(point.motions), 1)), np.append(point.theta, np.zeros(q))
        self.joint = problem.prior.with_unknowns(places, np.zeros(q))
        state = replace(problem.state, theta=theta, trial_effects=point.trial_effects)
        blocks, self.of_effects = Linearised(self.joint, state, cross_products).without_effects()
        square, slope, self.cost = self.joint.summed(blocks, theta)
        own = np.diag(square)
        self.ridge = LEAST_INFORMATION * np.maximum(own[p:], max(1e-6 * own[p:].max(), 1e-300))
        total = np.column_stack([square, slope])
        determined = np.flatnonzero(problem.prior.free & (own[:p] > 0))
        self.of_parameters = inverse_of_block(square[:p, :p], determined) @ total[:p, p:]
        reduced = total[p:, p:] - square[p:, :p] @ self.of_parameters
        self.information, self.score = reduced[:, :-1], reduced[:, -1]
        self.chi2 = self.cost - float(slope[:p] @ self.of_parameters[:, -1])

    def _products(self, trial: int, sensitivities: Floats) -> Floats:
        """Cross products of trial effects, parameters, coefficients and residual of a trial."""
        trial_data, effects = self.problem.data[trial], self.point.trial_effects[trial]
        position_m, velocity_m_s = _observed(self.point.motions[trial], trial_data.time_s - effects[RELEASE])
        grown_m = trial_data.lead_position_m - effects[ORIGIN]
        residual_m = grown_m - position_m - sensitivities[:, -1]
        columns = np.column_stack([-velocity_m_s, np.ones_like(grown_m), sensitivities[:, :-1], residual_m])
        # Where a usual deviation would move a trial by more than it travels, no small force can be told.
        moved_m = np.max(np.abs(sensitivities[:, :2] * self.problem.state.spread), axis=1)
        ended = (grown_m > MOST_OF_LENGTH * trial_data.trial.length_m) | (moved_m > np.ptp(grown_m))
        if ended[0]:
            raise np.linalg.LinAlgError(f"none of the positions of {trial_data.trial.name} tells a force")
        used = slice(0, int(np.argmax(ended)) if ended.any() else None)
        relative_sd = None if trial_data.relative_sd is None else trial_data.relative_sd[used]
        return products(columns[used], trial_data.first[used], relative_sd)

    def estimate(self, columns: slice = slice(None)) -> ForceEstimate:
        """Least squares for some of the coefficients, the others as they are; what they leave counts as noise."""
        information, score = self.information[columns, columns], self.score[columns]
        covariance = np.linalg.inv(information + np.diag(self.ridge[columns]))
        change, variance = covariance @ score, float(np.trace(covariance)) / score.size
        if not variance > 0:
            raise np.linalg.LinAlgError("the positions do not determine a force")
        fall, dof = float(score @ change), float(np.trace(covariance @ information))
        return ForceEstimate(fall, change, math.sqrt(variance * self.problem.inflation(self.chi2 - fall)), dof)

    def moved(self, coefficients: Floats) -> ForcePoint:
        """The point with other coefficients, to first order: a Gauss–Newton step of all unknowns and motions together
        (lifted: Albersmeyer & Diehl, SIAM J. Optim. 20, 1655, 2010). Releases move by at most two frames, and
        parameters stay inside their bounds.
        """
        point, prior = self.point, self.problem.prior
        change = coefficients - self.coefficients
        theta = point.theta + self.of_parameters[:, -1] - self.of_parameters[:, :-1] @ change
        theta = np.clip(theta, prior.lower, prior.upper)
        step = np.concatenate([theta - point.theta, change, [0.0]])[self.joint.index]
        effects = self.of_effects[:, :, -1] - np.einsum("nek,nk->ne", self.of_effects[:, :, :-1], step)
        effects[:, DEVIATION_COLUMNS] -= point.trial_effects[:, DEVIATION_COLUMNS]
        limits_s = np.array([2 * trial_data.frame_s for trial_data in self.problem.data])
        effects[:, RELEASE] = np.clip(effects[:, RELEASE], -limits_s, limits_s)
        by_all = np.column_stack([effects[:, DEVIATION_COLUMNS], step, np.ones(len(effects))])
        pushes = [columns @ sizes for columns, sizes in zip(self.accelerations, by_all, strict=True)]
        dx, dv = (each[:, :, 0] for each in _responses(point.motions, [push[:, None] for push in pushes]))
        motions = [_moved(*each) for each in zip(point.motions, pushes, dx, dv, strict=True)]
        effects += point.trial_effects
        return self.problem.point(theta, effects, motions, lambda motion: self.unit_push(motion) @ coefficients)


def _observed(motion: FittedMotion, since_s: Floats) -> tuple[Floats, Floats]:
    """Observed position and velocity of the leading edge, by cubic interpolation between the points of the grid."""
    curve = CubicHermiteSpline(motion.time_s, motion.lead_position_m, motion.lead_velocity_m_s)
    at = np.clip(since_s, 0.0, motion.time_s[-1])
    moving = (since_s > 0) & (since_s < motion.time_s[-1])
    offset = np.interp(at, motion.time_s, motion.observation_offset_m)
    slope = np.interp(at, motion.time_s, motion.observed_slope)
    return np.asarray(curve(at) + offset), np.where(moving, curve(at, 1) * slope, 0.0)
