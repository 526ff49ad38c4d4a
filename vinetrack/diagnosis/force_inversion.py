"""Forces that a model lacks, estimated from positions: one linear problem, with all other unknowns free.

Positions are linearised about motions that lie on the tracks, whatever the model says. With a force of amplitudes f,

    y = J δθ + Z b_i + S f + d + e

J the sensitivities to the model parameters θ, Z those to the effects b_i of trial i (release, origin, pressure, B), S
those to the force, d the response to what the model's forces lack along these motions (their defect), and e AR(1) noise
of the tracks. θ, b_i and f have normal priors. The trial effects are eliminated trial by trial, the model parameters
over all trials (Schur complements), so that only equations for f remain. For the final word motions respond to the
force in full, and the same equations give the steps.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats, Trial
from vinetrack.core.threads import njit
from vinetrack.diagnosis.replicates import LEAST_BETWEEN_TRIAL_SD, Scatter
from vinetrack.dynamics.audit import evaluate
from vinetrack.dynamics.model import Model
from vinetrack.dynamics.simulate import SimulationError, Trajectory, simulate_many
from vinetrack.inference.fit_data import FitTrial
from vinetrack.inference.fit_result import Fit
from vinetrack.inference.marginal_likelihood import eliminated, trial_effect_prior, with_diagonal
from vinetrack.inference.optimiser import track_correlation, variance_floor
from vinetrack.inference.sensitivity import DAMPING_DEVIATION, N_TRIAL_EFFECTS, ORIGIN, PRESSURE, RELEASE, Job
from vinetrack.inference.whitening import whiten

# ------------------------------------------------------------------------------
# Cubic B-splines, evaluated through the four that are nonzero at each position.

N_NONZERO = 4  # Cubic splines that are nonzero between two knots (derived)


@lru_cache(maxsize=64)
def _pieces(knots: tuple[float, ...]) -> tuple[Floats, Floats]:
    """Knots, and the polynomials of the nonzero splines on each interval, shape (n_knots − 1, power, spline)."""
    from scipy.interpolate import BSpline, PPoly

    ends = np.array([knots[0]] * 3 + [*knots] + [knots[-1]] * 3)
    polynomials = np.array([PPoly.from_spline(BSpline(ends, unit, 3)).c[::-1] for unit in np.eye(len(knots) + 2)])
    pieces = [polynomials[k : k + N_NONZERO, :, 3 + k].T for k in range(len(knots) - 1)]
    return np.array(knots), np.array(pieces)


def nonzero_splines(at: Floats, knots: tuple[float, ...]) -> tuple[np.ndarray, Floats]:
    """Indices and values of the splines that are nonzero at each position; constant beyond the end knots. Returns first
    (the first of the four nonzero splines, of n_knots + 2), values (of these four; they sum to 1). Shapes: at (n,) →
    (n,).
    """
    breaks, pieces = _pieces(knots)
    inside = np.clip(at, breaks[0], breaks[-1])
    first = np.clip(np.searchsorted(breaks, inside, side="right") - 1, 0, len(pieces) - 1)
    offset = inside - breaks[first]
    polynomials = pieces[first]
    values = polynomials[:, 3]
    for power in (2, 1, 0):
        values = values * offset[:, None] + polynomials[:, power]
    return first, values


def splines(at: Floats, knots: Floats) -> Floats:
    """Design matrix of cubic B-splines on these knots; constant beyond the end knots. Shapes: at (n,); knots (n_knots,)
    → (n, n_knots + 2).
    """
    first, values = nonzero_splines(at, tuple(np.asarray(knots).tolist()))
    design = np.zeros((len(first), len(knots) + 2))
    np.put_along_axis(design, first[:, None] + np.arange(N_NONZERO), values, axis=1)
    return design


def uniform_splines(at: Floats, count: int) -> Floats:
    """Cubic B-splines on 0 to 1 with evenly spaced knots. Shapes: at (n,) → (n, count)."""
    return splines(at, np.array(uniform_knots(count)))


@lru_cache
def uniform_knots(count: int) -> tuple[float, ...]:
    """Knots of `uniform_splines`."""
    return tuple(np.linspace(0.0, 1.0, count - 2).tolist())


# ------------------------------------------------------------------------------
# Compiled integration of the variational equations: responses of motions to small accelerations.


@njit(nogil=True, error_model="numpy")
def integrate_responses(
    time_s: Floats, stiffness: Floats, friction: Floats, acceleration: Floats, gamma: float
) -> tuple[Floats, Floats]:
    """Integrate δẍ = k δx + c δẋ + a from rest, for several added accelerations a along each motion. The method is the
    L-stable, singly diagonally implicit Runge-Kutta scheme of two stages and second order by Alexander, SIAM J. Numer.
    Anal. 14, 1006 (1977). Returns position_change, velocity_change : arrays, shape (n_trials, n_steps + 1, n), m and
    m/s. Shapes: time_s, stiffness, friction (n_trials, n_steps + 1); acceleration (n_trials, n_steps + 1, n).
    """
    trials, points, count = acceleration.shape
    position_change, velocity_change = np.zeros_like(acceleration), np.zeros_like(acceleration)
    for trial in range(trials):
        for i in range(points - 1):
            h = time_s[trial, i + 1] - time_s[trial, i]
            implicit, explicit = gamma * h, (1 - gamma) * h
            k, c = stiffness[trial, i + 1], friction[trial, i + 1]
            k_stage = (1 - gamma) * stiffness[trial, i] + gamma * k
            c_stage = (1 - gamma) * friction[trial, i] + gamma * c
            pivot_stage = 1 - implicit * c_stage - implicit * implicit * k_stage
            pivot = 1 - implicit * c - implicit * implicit * k
            for j in range(count):
                x, v, a = position_change[trial, i, j], velocity_change[trial, i, j], acceleration[trial, i + 1, j]
                a_stage = (1 - gamma) * acceleration[trial, i, j] + gamma * a
                rate = (k_stage * (x + implicit * v) + c_stage * v + a_stage) / pivot_stage
                x, v = x + explicit * (v + implicit * rate), v + explicit * rate
                v_end = v + implicit * ((k * (x + implicit * v) + c * v + a) / pivot)
                position_change[trial, i + 1, j], velocity_change[trial, i + 1, j] = x + implicit * v_end, v_end
    return position_change, velocity_change


# ------------------------------------------------------------------------------
# Sensitivities of the fitted trajectories to a small added force on the tail.
#
# Linearised about a motion x(t), the equation of motion m ẍ = F(x, ẋ, t) + f becomes the variational equation
#
#     δẍ = (∂a/∂x) δx + (∂a/∂ẋ) δẋ + f/m,   a = F/m
#
# It is linear in f, so that the responses to many forces of any shape are integrated together, with no model compiled
# for them. The derivatives are finite differences of the model's own terms (`vinetrack.dynamics.audit`). For a force
# that is not small the motion is corrected and linearised again (Newton's method in function space, Kantorovich; also
# known as quasilinearisation).

N_STEPS = 400  # Steps of a motion, denser at its start (derived)

# Diagonal coefficient of the two-stage, second-order, L-stable method of Alexander, SIAM J. Numer
SDIRK_GAMMA = 1 - 1 / math.sqrt(2)


# Part of the highest speed below which a vine counts as standing still and does not respond to a small force (chosen)
LEAST_RELATIVE_SPEED = 1e-3


@dataclass(frozen=True)
class FittedMotion:
    """The motion of one trial on a fine grid since release; arrays have shape (N_STEPS + 1,), SI. `mass_kg` is all
    moving mass; `stiffness` and `friction` are ∂a/∂x and ∂a/∂ẋ.
    """

    trial: Trial
    model: Model
    measured_Pa: Floats | None
    time_s: Floats
    lead_position_m: Floats
    lead_velocity_m_s: Floats
    pressure_Pa: Floats
    mass_kg: Floats
    stiffness: Floats
    friction: Floats
    model_acceleration: Floats
    acceleration: Floats
    observed_slope: Floats
    observation_offset_m: Floats
    end_s: float
    counts_until_s: float = math.inf

    @property
    def tail_position_m(self) -> Floats:
        """Position of the tail, r·y, m."""
        return self.trial.travel_ratio * self.lead_position_m

    @property
    def tail_velocity_m_s(self) -> Floats:
        """Velocity of the tail, r·ẏ, m/s."""
        return self.trial.travel_ratio * self.lead_velocity_m_s


def motions_of(fit: Fit, trial_effects: Floats) -> list[FittedMotion]:
    """Simulate the fitted motions with given trial effects. Shapes: trial_effects (n_trials, 4)."""
    predictor = fit.predictor
    jobs = predictor.jobs(fit.solution.state.theta, trial_effects)
    trials = [trial_of_job(trial_data.trial, job) for trial_data, job in zip(predictor.data, jobs, strict=True)]
    # 3.0: frames by which a motion is integrated beyond its recording, in case its release moves (chosen)
    grids = [
        max(trial_data.time_s[-1] - trial_effects[i, RELEASE] + 3.0 * trial_data.frame_s, 1e-6)
        * np.linspace(0, 1, N_STEPS + 1) ** 2
        for i, trial_data in enumerate(predictor.data)
    ]
    traces = [
        None if trial_data.trace is None else (trial_data.trace[0] - job.release_s, trial_data.trace[1])
        for trial_data, job in zip(predictor.data, jobs, strict=True)
    ]
    runs = simulate_many(
        fit.model, trials, grids, traces=traces, parameters=np.array([job.row for job in jobs]), host=predictor.host
    )
    return [_motion(fit.model, *run) for run in zip(trials, jobs, runs, traces, strict=True)]


def trial_of_job(trial: Trial, job: Job) -> Trial:
    """The trial with the pressure and yield pressure that its job simulates."""
    yield_Pa = trial.yield_pressure_Pa if math.isnan(job.yield_pressure_Pa) else job.yield_pressure_Pa
    return replace(trial, pressure_Pa=trial.pressure_Pa * (1 + job.pressure_deviation), yield_pressure_Pa=yield_Pa)


def _motion(model: Model, trial: Trial, job: Job, run: Trajectory, trace: tuple[Floats, Floats] | None) -> FittedMotion:
    model = model.with_values(dict(zip(model.parameter_names, job.row.tolist(), strict=True)))
    measured = None if trace is None else np.interp(run.time_s, *trace)
    if measured is None and any("chamber_rate" in effect.functions for effect in model):
        # Chamber pressure is held as it is along the fitted motion: its response to a small force is of higher order.
        measured = evaluate(model, trial, run.time_s, run.lead_position_m, run.lead_velocity_m_s).pressure_Pa
    zeros = np.zeros_like(run.time_s)
    unevaluated = FittedMotion(trial, model, measured, run.time_s, run.lead_position_m, run.lead_velocity_m_s, zeros,
                  zeros, zeros, zeros, zeros, zeros, _observed_slope(run),
                  run.observed_position_m - run.lead_position_m,
                  run.end_time_s if run.status == "ended" else math.inf)  # fmt: skip
    motion = with_model_terms(unevaluated)
    return replace(motion, acceleration=motion.model_acceleration)


def with_model_terms(motion: FittedMotion) -> FittedMotion:
    """The motion with acceleration, mass, stiffness and friction of the model evaluated along it."""
    y, v = motion.lead_position_m, motion.lead_velocity_m_s
    step_y, step_v = 1e-4 * max(float(y.max()), 1e-9), 1e-4 * max(float(v.max()), 1e-9)
    at_motion, further, faster = (
        evaluate(motion.model, motion.trial, motion.time_s, *at, measured_Pa=motion.measured_Pa)
        for at in ((y, v), (y + step_y, v), (y, v + step_v))
    )
    r = motion.trial.travel_ratio
    stands = v < LEAST_RELATIVE_SPEED * v.max()
    late = motion.time_s > motion.time_s[N_STEPS // 20]
    stiffness = (further.acceleration_m_s2 - at_motion.acceleration_m_s2) / (r * step_y)
    friction = (faster.acceleration_m_s2 - at_motion.acceleration_m_s2) / (r * step_v)
    return replace(
        motion,
        pressure_Pa=np.broadcast_to(at_motion.pressure_Pa, y.shape),
        mass_kg=np.broadcast_to(at_motion.inertia_kg, y.shape),
        stiffness=np.where(stands, 0.0, stiffness),
        friction=np.where(stands & late, -1e9, np.minimum(friction, 0.0)),
        model_acceleration=np.asarray(at_motion.acceleration_m_s2),
    )


def _observed_slope(run: Trajectory) -> Floats:
    """Derivative of the observed position by the true position of the leading edge; 1 where it stands still."""
    velocity = np.gradient(run.lead_position_m, run.time_s)
    observed_velocity = np.gradient(run.observed_position_m, run.time_s)
    moving = velocity > LEAST_RELATIVE_SPEED * velocity.max()
    return np.where(moving, observed_velocity / np.where(moving, velocity, 1.0), 1.0)


def acceleration_sensitivities(
    fit: Fit, trial_effects: Floats, motions: Sequence[FittedMotion], accelerations: Sequence[Floats]
) -> list[Floats]:
    """Derivatives of the observed positions of every trial with respect to the amplitudes of added accelerations of the
    tail. Shapes: trial_effects (n_trials, 4); accelerations (N_STEPS + 1, n) → (n_points, n).
    """
    dx, _ = _responses(motions, np.array(accelerations))
    return [
        _interpolated(
            trial_data.time_s - trial_effects[i, RELEASE],
            motion,
            response * motion.observed_slope[:, None] / motion.trial.travel_ratio,
        )
        for i, (trial_data, motion, response) in enumerate(zip(fit.predictor.data, motions, dx, strict=True))
    ]


def with_force(
    motions: Sequence[FittedMotion], force: Callable[[FittedMotion], Floats], rounds: int
) -> list[FittedMotion]:
    """The motions under an added force on the tail that need not be small. Each correction leaves about a tenth of the
    error of the one before. Motions that do not satisfy their models are corrected to do so. The stiffness and friction
    returned include the force.
    """
    for _ in range(rounds):
        motions = [_with_force_derivatives(motion, force) for motion in motions]
        defect = np.array(
            [motion.model_acceleration + force(motion) / motion.mass_kg - motion.acceleration for motion in motions]
        )
        dx, dv = (response[:, :, 0] for response in _responses(motions, defect[:, :, None]))
        motions = [_corrected(*step) for step in zip(motions, defect, dx, dv, strict=True)]
    return [_with_force_derivatives(motion, force) for motion in motions]


def _with_force_derivatives(motion: FittedMotion, force: Callable[[FittedMotion], Floats]) -> FittedMotion:
    """The motion with the derivatives of the added force included in stiffness and friction."""
    y, v = motion.lead_position_m, motion.lead_velocity_m_s
    step_y, step_v = 1e-4 * max(float(y.max()), 1e-9), 1e-4 * max(float(v.max()), 1e-9)
    at_motion, r = force(motion), motion.trial.travel_ratio
    further = (force(replace(motion, lead_position_m=y + step_y)) - at_motion) / (r * step_y * motion.mass_kg)
    faster = (force(replace(motion, lead_velocity_m_s=v + step_v)) - at_motion) / (r * step_v * motion.mass_kg)
    moves = v >= LEAST_RELATIVE_SPEED * v.max()
    return replace(
        motion,
        stiffness=motion.stiffness + np.where(moves, further, 0.0),
        friction=np.where(moves, np.minimum(motion.friction + faster, 0.0), motion.friction),
    )


def _corrected(motion: FittedMotion, defect: Floats, dx: Floats, dv: Floats) -> FittedMotion:
    """The motion after a change of the tail's position and velocity; growth does not run backwards."""
    r = motion.trial.travel_ratio
    # Step limit: a correction takes away at most half of the speed; the rest is left to the next correction.
    part = float(np.min(np.where(dv < 0, 0.5 * motion.tail_velocity_m_s / np.maximum(-dv, 1e-12), 1.0), initial=1.0,
                        where=motion.lead_velocity_m_s > 0.05 * motion.lead_velocity_m_s.max()))  # fmt: skip
    part = min(part, 1.0)
    changed = replace(
        motion,
        lead_position_m=np.maximum(motion.lead_position_m + part * dx / r, 0.0),
        lead_velocity_m_s=np.maximum(motion.lead_velocity_m_s + part * dv / r, 0.0),
        acceleration=motion.acceleration + part * (motion.stiffness * dx + motion.friction * dv + defect),
    )
    return with_model_terms(changed)


def _interpolated(since_s: Floats, motion: FittedMotion, values: Floats) -> Floats:
    """Grid values interpolated linearly at other times; 0 before release and after growth has ended."""
    grid_s = motion.time_s
    k = np.clip(np.searchsorted(grid_s, since_s), 1, grid_s.size - 1)
    part = np.clip((since_s - grid_s[k - 1]) / (grid_s[k] - grid_s[k - 1]), 0.0, 1.0)[:, None]
    growing = (since_s > 0) & (since_s <= motion.end_s)
    return np.where(growing[:, None], values[k - 1] + part * (values[k] - values[k - 1]), 0.0)


def _responses(motions: Sequence[FittedMotion], acceleration: Floats) -> tuple[Floats, Floats]:
    """δx, m, and δẋ, m/s, of every trial to added accelerations; all of shape (n_trials, N_STEPS + 1, n)."""
    time_s, k, c = (
        np.array([getattr(motion, name) for motion in motions]) for name in ("time_s", "stiffness", "friction")
    )
    dx, dv = integrate_responses(time_s, k, c, np.ascontiguousarray(acceleration), SDIRK_GAMMA)
    # Compiled code does not raise on overflow.
    if np.geterr()["over"] == "raise" and not (np.isfinite(dx).all() and np.isfinite(dv).all()):
        raise FloatingPointError("the response to a force is not finite")
    return dx, dv


# ------------------------------------------------------------------------------
# Motions that lie on the tracks, whatever the model says: the starting point for a force that is not small.
#
# The acceleration of every trial is a sum of splines, integrated twice from rest at its release and fitted to
# positions with the smoothing chosen by generalised cross-validation (Wahba 1990, ch. 4). The acceleration itself is
# not used as data: the equation of motion is linearised about this motion, and the defect there (what the model's
# forces lack) enters as one more known acceleration, so that noise in the smoothed motion cancels to first order
# (quasilinearisation, Bellman & Kalaba 1965). About the motion of a model that lacks a large force the linearisation
# would be poor.


def _on_track(data: FitTrial, trial_effects: Floats, motion: FittedMotion) -> FittedMotion:
    since_s = data.time_s - trial_effects[RELEASE]
    observed_m = data.lead_position_m - trial_effects[ORIGIN]
    position_m = observed_m - np.interp(since_s, motion.time_s, motion.observation_offset_m)
    length_m = motion.trial.length_m
    # 0.96: part of the length up to which points are used (chosen)
    growing = (since_s > 0) & ~(position_m > 0.96 * length_m)
    if np.count_nonzero(growing) <= 2:
        return motion
    grid_s = motion.time_s
    last_s = float(since_s[growing].max())
    # 20: splines of an acceleration, even in the square root of time and so denser where a vine accelerates (chosen)
    accelerations = uniform_splines(np.sqrt(np.clip(grid_s / last_s, 0.0, 1.0)), 20)
    velocities = _integrated(grid_s, accelerations)
    positions = _integrated(grid_s, velocities)
    k = np.clip(np.searchsorted(grid_s, since_s[growing]), 1, grid_s.size - 1)
    part = ((since_s[growing] - grid_s[k - 1]) / (grid_s[k] - grid_s[k - 1]))[:, None]
    at_frames = positions[k - 1] + part * (positions[k] - positions[k - 1])
    coefficients = _penalised_fit(at_frames, position_m[growing])
    r = motion.trial.travel_ratio
    moved = replace(
        motion,
        lead_position_m=np.maximum.accumulate(np.maximum(positions @ coefficients, 0.0)),
        lead_velocity_m_s=np.maximum(velocities @ coefficients, 0.0),
        acceleration=r * (accelerations @ coefficients),
        # The model's end of growth is not that of the track: the vine responds to forces beyond it.
        end_s=math.inf,
        counts_until_s=last_s,
    )
    return with_model_terms(moved)


def _integrated(time_s: Floats, columns: Floats) -> Floats:
    """Cumulative integrals of the columns by the trapezoidal rule, 0 at the first time."""
    steps = 0.5 * (columns[1:] + columns[:-1]) * np.diff(time_s)[:, None]
    return np.concatenate([np.zeros((1, columns.shape[1])), np.cumsum(steps, axis=0)])


def _penalised_fit(design: Floats, values: Floats) -> Floats:
    """Coefficients with penalised second differences, the penalty chosen by generalised cross-validation."""
    second_difference = np.diff(np.eye(design.shape[1]), 2, axis=0)
    gram = design.T @ design
    unit = float(np.trace(gram)) / design.shape[1]
    roughness = unit * (second_difference.T @ second_difference + 1e-9 * np.eye(design.shape[1]))
    best: tuple[float, Floats] | None = None
    # Penalties, relative to the information from positions (chosen)
    for penalty in np.geomspace(1e-8, 1e2, 21):
        inverse = np.linalg.pinv(gram + penalty * roughness, hermitian=True)
        coefficients = inverse @ (design.T @ values)
        degrees_of_freedom = min(float(np.trace(inverse @ gram)), values.size - 1.0)
        score = float(np.sum((values - design @ coefficients) ** 2)) / (values.size - degrees_of_freedom) ** 2
        if best is None or score < best[0]:
            best = score, coefficients
    assert best is not None
    return best[1]


# ------------------------------------------------------------------------------
# One linear problem for every question about a force: least squares about a set of motions, all other unknowns free.


class Force(Protocol):
    """Forces that are searched for: those of unit amplitudes along a motion, and the prior of the amplitudes."""

    @property
    def amplitude_precision(self) -> float:
        """Prior precision of each amplitude, 1/N²; 0 where it is free."""

    def unit_force(self, motion: FittedMotion) -> Floats:
        """The force of each unit amplitude along a motion. Shape (n_times, n_amplitudes)."""

    def force(self, motion: FittedMotion, amplitude: Floats) -> Floats:
        """The force with these amplitudes along a motion. Shapes: amplitude (n_amplitudes,) → (n_times,)."""


PARAMETER_CUTOFF = 1e-11  # Relative eigenvalue below which a combination of model parameters is not estimable (derived)
LEAST_INFORMATION = 1e-9  # Part of the largest information below which an amplitude is not estimable (chosen)


@dataclass(frozen=True)
class FreeForce:
    """Forces of free amplitudes: any functions of the motion."""

    unit_force: Callable[[FittedMotion], Floats]
    amplitude_precision: float = 0.0

    def force(self, motion: FittedMotion, amplitude: Floats) -> Floats:
        """The force with these amplitudes along a motion. Shapes: amplitude (n_amplitudes,) → (n_times,)."""
        return np.asarray(self.unit_force(motion) @ amplitude)


@dataclass(frozen=True)
class ForcePoint:
    """Values of all unknowns, and the motions that they are linearised about. Where `motions_include_force`, the
    motions are those of these parameters and this force. Otherwise they are others near by, and their defect (by how
    much they violate the equation of motion) is carried as a residual.
    """

    theta: Floats
    trial_effects: Floats
    force: Force
    amplitude: Floats
    motions: Sequence[FittedMotion]
    motions_include_force: bool = False

    def asking(self, force: Force) -> ForcePoint:
        """The same motions, to ask what another force explains: its amplitudes are 0, and the defect is all of it."""
        count = force.unit_force(self.motions[0]).shape[1]
        return replace(self, force=force, amplitude=np.zeros(count), motions_include_force=False)


@dataclass(frozen=True)
class ForceEstimate:
    """Least-squares estimate of force amplitudes, N, and the fall of χ² that they bring. `sigma` is the root mean
    square standard error of an amplitude. `parameter_shift` is how far the model parameters move along, in the fit's
    own scaling.
    """

    delta_chi2: float
    amplitude: Floats
    sigma: float
    parameter_shift: Floats
    degrees_of_freedom: int

    @property
    def delta_chi2_beyond_chance(self) -> float:
        """The fall of χ² in excess of its expectation under no force; at least 0."""
        return max(self.delta_chi2 - self.degrees_of_freedom, 0.0)


@dataclass(frozen=True)
class CoefficientLikelihood:
    """Quadratic log-likelihood of the amplitudes, all other unknowns integrated out. `information` and `score` are
    about amplitudes of zero, where χ² is `chi2_at_zero`; `delta_chi2` is its fall to the best amplitudes.
    `log_determinant` is that of the information on all other unknowns.
    """

    information: Floats
    score: Floats
    chi2_at_zero: float
    delta_chi2: float
    log_determinant: float

    @property
    def least_chi2(self) -> float:
        """χ² of the best coefficients, without regard to the smoothness prior."""
        return self.chi2_at_zero - self.delta_chi2

    @property
    def is_finite(self) -> bool:
        """Whether all entries are finite: far outside the visited range the equations overflow."""
        parts = (self.information, self.score, self.chi2_at_zero, self.delta_chi2, self.log_determinant)
        return all(bool(np.isfinite(part).all()) for part in parts)


class ForceProblem:
    """A fit, the noise of its tracks, and the priors of its parameters and trial effects: what is asked of forces. The
    noise variance is that of the tracks, so that misfit of the model does not count as noise. Pressure and B of a trial
    have the standard deviations estimated from replicates. `tracks` are the motions that lie on the tracks, whatever
    the model says, at its fitted parameters.
    """

    def __init__(self, fit: Fit, scatter: Scatter) -> None:
        self.fit, self.data, self.scatter = fit, fit.predictor.data, scatter
        self.prior = fit.solution.problem
        self.rho = track_correlation(self.data)
        noise = np.array([trial_data.noise_m**2 for trial_data in self.data]) * (1 - self.rho**2)
        self.variance = np.maximum(noise, variance_floor(self.data))
        spread = (max(scatter.pressure, LEAST_BETWEEN_TRIAL_SD[0]), max(scatter.damping, LEAST_BETWEEN_TRIAL_SD[1]))
        state = replace(fit.solution.state, spread=spread)
        self.effects_mean, self.effects_precision = trial_effect_prior(self.prior, state)
        self.conditions = [trial_data.trial.condition for trial_data in self.data]
        self.n_points = float(sum(trial_data.time_s.size for trial_data in self.data))
        effects = np.zeros_like(self.effects_mean)
        effects[:, :2] = self.effects_mean[:, :2]
        on_tracks = [_on_track(*pair) for pair in zip(self.data, effects, motions_of(fit, effects), strict=True)]
        none = FreeForce(lambda motion: np.zeros((motion.time_s.size, 0)))
        self.tracks = ForcePoint(fit.solution.state.theta, effects, none, np.zeros(0), on_tracks)

    @property
    def independent_points(self) -> float:
        """Effective number of independent residuals where a model leaves more than noise."""
        # 10.0: of one trial (chosen)
        return 10.0 * len(self.data)

    def bic(self, chi2_without_force: float, delta_chi2: float, n_parameters: int, largest_delta_chi2: float) -> float:
        """Bayesian information criterion of a force, relative to the force that explains most: smaller is better. The
        misfit that not even the best force explains is counted as further noise: it inflates the variance of every
        independent residual. Source: Schwarz, Annals of Statistics 6, 461 (1978), with χ² divided by that inflation.
        """
        unexplained = max(chi2_without_force - largest_delta_chi2 - self.n_points, 0.0)
        misfit = (largest_delta_chi2 - delta_chi2) / (1 + unexplained / self.independent_points)
        return misfit + n_parameters * math.log(self.independent_points)

    def linearised(self, point: ForcePoint) -> LinearForce:
        """Positions as linear functions of all unknowns about a point."""
        accelerations = _acceleration_derivatives(self.fit, point)
        sensitivities = acceleration_sensitivities(self.fit, point.trial_effects, point.motions, accelerations)
        grams = []
        for i, trial_data in enumerate(self.data):
            position, velocity = _observed(point.motions[i], trial_data.time_s - point.trial_effects[i, RELEASE])
            residual = trial_data.lead_position_m - point.trial_effects[i, ORIGIN] - position
            of_trial = sensitivities[i]
            if not point.motions_include_force:
                of_trial, of_defect = of_trial[:, :-1], of_trial[:, -1]
                residual = residual - of_defect
            rows = np.column_stack([-velocity, np.ones(residual.size), of_trial, residual])
            used = _points_before_end(trial_data, point.trial_effects[i])
            relative_sd = None if trial_data.relative_sd is None else trial_data.relative_sd[used]
            white = whiten(rows[used], trial_data.first[used], self.rho, relative_sd)
            grams.append(white.T @ white / self.variance[i])
        return LinearForce(self, point, np.array(grams))


class LinearForce:
    """The normal equations about a point. `cost` is χ² there with all priors. Trial by trial the unknowns are its
    effects, the model parameters that it depends on, and the amplitudes of the force; the effects are eliminated in
    each trial, then the parameters over all trials (Schur complements).
    """

    def __init__(self, problem: ForceProblem, point: ForcePoint, grams: Floats) -> None:
        self.problem, self.point, self.grams = problem, point, grams
        prior, p, q = problem.prior, point.theta.size, point.amplitude.size
        off = point.trial_effects - problem.effects_mean
        from_mean = point.theta - prior.prior_mean
        each = np.arange(N_TRIAL_EFFECTS)
        grams[:, each, -1] -= problem.effects_precision * off
        grams[:, -1, each] = grams[:, each, -1]
        self.prior_precision = np.concatenate([prior.prior_precision, np.full(q, point.force.amplitude_precision)])
        self.prior_score = -self.prior_precision * np.concatenate([from_mean, point.amplitude])
        self.cost = float(grams[:, -1, -1].sum() + np.sum(problem.effects_precision * off**2))
        self.cost += float(self.prior_precision @ np.concatenate([from_mean, point.amplitude]) ** 2)
        # Places of a trial's parameters and amplitudes among all; parameters that it does not depend on come last.
        keys = np.where(prior.index >= 0, prior.index, p + q)
        self.places = np.hstack([keys, np.broadcast_to(p + np.arange(q), (len(keys), q))])
        self.eliminated, _ = self._without_effects(0.0)

    def _without_effects(self, damping: float) -> tuple[Floats, Floats]:
        """Products of [parameters, amplitudes, residual] of each trial, its effects eliminated, and the response of the
        effects to those. Shapes (n_trials, m, m), (n_trials, 4, m).
        """
        precision = self.problem.effects_precision
        own = np.einsum("nkk->nk", self.grams)[:, :N_TRIAL_EFFECTS] + precision
        return eliminated(self.grams, precision + damping * own)

    def _blocks(self, products: Floats) -> tuple[Floats, Floats, Floats]:
        """Normal equations over all trials, with priors: parameters by themselves (p, p), by [amplitudes, residual]
        (p, q + 1), and the latter by themselves.
        """
        prior = self.problem.prior
        k, p = prior.index.shape[1], prior.prior_mean.size
        index = np.where(prior.index >= 0, prior.index, p)
        parameters, cross = np.zeros((p + 1, p + 1)), np.zeros((p + 1, products.shape[1] - k))
        np.add.at(parameters, (index[:, :, None], index[:, None, :]), products[:, :k, :k])
        np.add.at(cross, index, products[:, :k, k:])
        parameters, cross = parameters[:p, :p] + np.diag(self.prior_precision[:p]), cross[:p]
        cross[:, -1] += self.prior_score[:p]
        rest = products[:, k:, k:].sum(axis=0)
        rest[:-1, :-1] += np.diag(self.prior_precision[p:])
        rest[:-1, -1] += self.prior_score[p:]
        held = ~prior.free | ~(np.diag(parameters) > 0)
        parameters[held, :] = parameters[:, held] = cross[held] = 0.0
        return parameters, cross, rest

    @cached_property
    def blocks(self) -> tuple[Floats, Floats, Floats]:
        """The normal equations with the trial effects eliminated; see `_blocks`."""
        return self._blocks(self.eliminated)

    @cached_property
    def parameter_response(self) -> Floats:
        """Steps of the parameters by [each amplitude, the residual], shape (p, q + 1)."""
        parameters, cross, _ = self.blocks
        return np.asarray(scaled_pseudo_inverse(parameters, PARAMETER_CUTOFF) @ cross)

    @cached_property
    def chi2_without_force(self) -> float:
        """χ² with parameters and trial effects estimated anew, and the amplitudes as they are at the point."""
        gained = float(self.blocks[1][:, -1] @ self.parameter_response[:, -1])
        return self.cost - float((self.grams[:, -1, -1] - self.eliminated[:, -1, -1]).sum()) - gained

    def estimates(self, widths: Sequence[int]) -> list[ForceEstimate]:
        """Each of several forces estimated with none of the others present: so many amplitudes each, in order."""
        _, cross, rest = self.blocks
        reduced = rest - cross.T @ self.parameter_response
        ends = np.concatenate([[0], np.cumsum(widths)])
        return [self._estimate(reduced, slice(a, b)) for a, b in itertools.pairwise(ends.tolist())]

    def _estimate(self, reduced: Floats, columns: slice) -> ForceEstimate:
        """The force whose amplitudes are in `columns`, from the equations with all other unknowns eliminated. Its
        standard error is the larger of the model-based one and the cluster-robust one with trials as clusters.
        """
        information, score = reduced[columns, columns], reduced[columns, -1]
        size = np.diag(information)
        estimable = size > LEAST_INFORMATION * max(float(size.max()), 1e-300)
        response = self.parameter_response
        if not estimable.any():
            return ForceEstimate(0.0, np.zeros(score.size), math.inf, np.zeros(len(response)), 0)
        covariance = scaled_pseudo_inverse(information, LEAST_INFORMATION, estimable)
        amplitude = covariance @ score
        shift = response[:, -1] - response[:, columns] @ amplitude
        scores = self._scores_by_trial(columns, amplitude, shift)
        residual_dof = max(len(scores) - shift.size - score.size, 1)
        robust = covariance @ (scores.T @ scores * len(scores) / residual_dof) @ covariance
        sigma = math.sqrt(max(float(np.trace(covariance)), float(np.trace(robust))) / score.size)
        return ForceEstimate(float(score @ amplitude), amplitude, sigma, shift, int(np.count_nonzero(estimable)))

    def _scores_by_trial(self, columns: slice, amplitude: Floats, shift: Floats) -> Floats:
        """Contribution of each trial to the score of the amplitudes at the estimate, shape (n_trials, n_columns)."""
        index, products = self.problem.prior.index, self.eliminated
        k = index.shape[1]
        forces = slice(k + columns.start, k + columns.stop)
        residual_products = (
            products[:, :, -1]
            - np.einsum("nqk,nk->nq", products[:, :, :k], np.append(shift, 0.0)[index])
            - products[:, :, forces] @ amplitude
        )
        response = self.parameter_response[:, columns]
        of_keys = np.vstack([response, np.zeros((1, response.shape[1]))])[index]
        return np.asarray(residual_products[:, forces] - np.einsum("nkl,nk->nl", of_keys, residual_products[:, :k]))

    def likelihood(self) -> CoefficientLikelihood:
        """Integrate out all unknowns but the amplitudes, after scaling each unknown to unit information."""
        # Information, where each unknown alone has 1, below which a combination of unknowns is not estimable (derived)
        least_information = 1e-8
        parameters, cross, rest = self.blocks
        size = np.diag(parameters)
        unit = 1 / np.sqrt(size[size > 0])
        values, vectors = np.linalg.eigh(parameters[np.ix_(size > 0, size > 0)] * unit[:, None] * unit)
        estimable = values > least_information
        root = vectors[:, estimable] / np.sqrt(values[estimable])
        explained = root.T @ (cross[size > 0] * unit[:, None])
        reduced = rest - explained.T @ explained
        of_effects = with_diagonal(self.grams[:, :N_TRIAL_EFFECTS, :N_TRIAL_EFFECTS], self.problem.effects_precision)
        own = np.einsum("nkk->k", self.grams)[-len(rest) : -1] + self.prior_precision[size.size :]
        scale = np.sqrt(own)
        inverse_scale = np.where(scale > 0, 1 / np.where(scale > 0, scale, 1.0), 0.0)
        strength, directions = np.linalg.eigh(reduced[:-1, :-1] * inverse_scale[:, None] * inverse_scale)
        # Directions that other unknowns reproduce have information only from rounding.
        directions, strength = directions[:, strength > least_information], strength[strength > least_information]
        back = scale[:, None] * directions
        local_score = directions.T @ (reduced[:-1, -1] * inverse_scale)
        at_point = scale * self.point.amplitude @ directions
        cost = self.chi2_without_force
        return CoefficientLikelihood(
            information=(back * strength) @ back.T,
            score=back @ (local_score + strength * at_point),
            chi2_at_zero=cost + 2 * float(local_score @ at_point) + float(strength @ at_point**2),
            delta_chi2=float(np.sum((local_score + strength * at_point) ** 2 / strength)),
            log_determinant=float(np.log(values[estimable]).sum() + np.log(size[size > 0]).sum())
            + float(np.linalg.slogdet(of_effects)[1].sum()),
        )

    def step(self, damping: float) -> ForcePoint:
        """The point of a damped Gauss–Newton step: releases limited, parameters inside their bounds."""
        point, prior, p = self.point, self.problem.prior, self.point.theta.size
        products, response = self._without_effects(damping)
        parameters, cross, rest = self._blocks(products)
        matrix = np.block([[parameters, cross[:, :-1]], [cross[:, :-1].T, rest[:-1, :-1]]])
        matrix += damping * np.diag(np.diag(matrix))
        # 1e-12: relative eigenvalue below which a combination of unknowns is not moved in a step (derived)
        step = scaled_pseudo_inverse(matrix, 1e-12) @ np.concatenate([cross[:, -1], rest[:-1, -1]])
        of_effects = response[:, :, -1] - np.einsum(
            "nem,nm->ne", response[:, :, :-1], np.append(step, 0.0)[self.places]
        )
        release_limit_s = 2 * np.array([trial_data.frame_s for trial_data in self.problem.data])
        of_effects[:, RELEASE] = np.clip(of_effects[:, RELEASE], -release_limit_s, release_limit_s)
        return replace(
            point,
            theta=np.clip(point.theta + step[:p], prior.lower, prior.upper),
            trial_effects=point.trial_effects + of_effects,
            amplitude=point.amplitude + step[p:],
        )


# A force that slows a vine down keeps it longer where the force acts, so that the linear estimate of a force of a tenth
# of the drive comes out a fifth too large. Below, motions respond to the force in full, and damped Gauss-Newton steps
# find all unknowns. The search starts on the tracks: simulated without the force, motions would run ahead of them.

CONVERGENCE_TOLERANCE = 1e-3  # Relative fall of χ² below which the search ends (chosen)


def optimise_force(problem: ForceProblem, start: ForcePoint) -> LinearForce | None:
    """The most probable force, all other unknowns free: first with the motions held where they are, then with motions
    that respond to the force.
    """
    if not start.motions_include_force:
        settled = _descend(problem, start)
        start = replace(start if settled is None else settled.point, motions_include_force=True)
    return _descend(problem, start)


def _descend(problem: ForceProblem, point: ForcePoint) -> LinearForce | None:
    """The normal equations at the point of least cost on the way down (Levenberg and Marquardt)."""
    best: LinearForce | None = None
    damping = 1e-3  # First damping factor (chosen)
    # 12: most Gauss-Newton steps (chosen)
    for _ in range(12):
        try:
            with np.errstate(all="raise", under="ignore"):
                linear = problem.linearised(_with_updated_motions(problem.fit, point))
        except (SimulationError, FloatingPointError, np.linalg.LinAlgError):
            linear = None
        if linear is not None and (best is None or linear.cost < best.cost):
            converged = best is not None and linear.cost > (1 - CONVERGENCE_TOLERANCE) * best.cost
            best, damping = linear, 0.2 * damping
            if converged:
                break
        elif best is None:
            break
        else:
            damping = 10 * damping
        point = best.step(damping)
    return best


def _with_updated_motions(fit: Fit, point: ForcePoint) -> ForcePoint:
    """The point with its motions corrected for its parameters and, where they include it, its force."""
    jobs = fit.predictor.jobs(point.theta, point.trial_effects)
    motions = [with_model_terms(_with_parameters_of_job(fit, *pair)) for pair in zip(point.motions, jobs, strict=True)]
    # 2: corrections of the motions at each step (chosen)
    corrections = 2 if point.motions_include_force else 0
    return replace(
        point, motions=with_force(motions, lambda motion: point.force.force(motion, point.amplitude), corrections)
    )


def _points_before_end(trial_data: FitTrial, trial_effects: Floats) -> slice:
    """The points before the end of growth, since a corrected motion does not end where its model would."""
    length_m = trial_data.trial.length_m if math.isfinite(trial_data.trial.length_m) else math.inf
    # 0.96: part of the length up to which points are used (chosen)
    after_end = np.flatnonzero(trial_data.lead_position_m - trial_effects[ORIGIN] > 0.96 * length_m)
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


def _acceleration_derivatives(fit: Fit, point: ForcePoint) -> list[Floats]:
    """Derivatives of the acceleration along each motion, shape (n_times, n): by pressure and B of the trial, every
    model parameter, every amplitude. Where the motions do not include the force, a last column holds their defect.
    """
    # Step of finite differences, in the fit's scaling of parameters (derived)
    step = 1e-3
    predictor, theta, effects, force = fit.predictor, point.theta, point.trial_effects, point.force
    by_effect = [
        predictor.jobs(theta, effects + step * np.eye(N_TRIAL_EFFECTS)[k]) for k in (PRESSURE, DAMPING_DEVIATION)
    ]
    by_parameter = [predictor.jobs(theta + step * unit, effects) for unit in np.eye(theta.size)]
    derivatives = []
    for i, motion in enumerate(point.motions):
        affected = (predictor.has_pressure_deviation[i], predictor.has_damping_deviation[i])
        changed = [jobs[i] if affects else None for jobs, affects in zip(by_effect, affected, strict=True)]
        changed += [by_parameter[k][i] if k >= 0 else None for k in predictor.layout.index[i]]
        columns = [
            np.zeros_like(motion.time_s)
            if job is None
            else (_acceleration(fit, point, motion, job) - motion.model_acceleration) / step
            for job in changed
        ]
        columns.append(force.unit_force(motion) / motion.mass_kg[:, None])
        if not point.motions_include_force:
            of_force = force.force(motion, point.amplitude) / motion.mass_kg
            columns.append(motion.model_acceleration + of_force - motion.acceleration)
        derivatives.append(np.column_stack(columns))
    return derivatives


def _acceleration(fit: Fit, point: ForcePoint, motion: FittedMotion, job: Job) -> Floats:
    """Acceleration along a motion with a job's parameters, with the change of a force that depends on the pressure."""
    changed = _with_parameters_of_job(fit, motion, job)
    y, v = motion.lead_position_m, motion.lead_velocity_m_s
    terms = evaluate(changed.model, changed.trial, motion.time_s, y, v, measured_Pa=motion.measured_Pa)
    pressure_Pa = np.broadcast_to(terms.pressure_Pa, y.shape)
    if not point.amplitude.any() or np.array_equal(pressure_Pa, motion.pressure_Pa):
        return terms.acceleration_m_s2
    before, after = (
        point.force.force(at, point.amplitude) for at in (motion, replace(motion, pressure_Pa=pressure_Pa))
    )
    return np.asarray(terms.acceleration_m_s2 + (after - before) / motion.mass_kg)


def _with_parameters_of_job(fit: Fit, motion: FittedMotion, job: Job) -> FittedMotion:
    """The same motion, its model and trial with the parameters of a job."""
    values = dict(zip(fit.model.parameter_names, job.row.tolist(), strict=True))
    trial = trial_of_job(fit.predictor.data[job.trial].trial, job)
    return replace(motion, model=fit.model.with_values(values), trial=trial)


def scaled_pseudo_inverse(matrix: Floats, cutoff: float, estimable: NDArray[np.bool_] | None = None) -> Floats:
    """Pseudo-inverse of a symmetric matrix after scaling its diagonal to 1. Returns zero in the rows and columns that
    do not take part. Shapes: matrix (n, n); estimable (n,) → (n, n).
    """
    diagonal = np.diag(matrix)
    scale = np.where(diagonal > 0 if estimable is None else estimable, 1 / np.sqrt(np.maximum(diagonal, 1e-300)), 0.0)
    inverse = np.linalg.pinv(matrix * scale[:, None] * scale, rcond=cutoff, hermitian=True)
    return np.asarray(inverse * scale[:, None] * scale)
