"""Sensitivities of the fitted trajectories to a small added force on the tail.

Linearised about a motion x(t), the equation of motion m ẍ = F(x, ẋ, t) + f becomes the variational equation

    δẍ = (∂a/∂x) δx + (∂a/∂ẋ) δẋ + f/m,   a = F/m

It is linear in f, so that the responses to many forces of any shape are integrated together, with no model compiled for
them. The derivatives are finite differences of the model's own terms (`vinetrack.dynamics.force_terms`). For a force
that is not small the motion is corrected and linearised again (Newton's method in function space, Kantorovich; also
known as quasilinearisation).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from vinetrack.core.records import Floats, Trial
from vinetrack.diagnosis.force_kernels import integrate_responses
from vinetrack.dynamics.force_terms import evaluate
from vinetrack.dynamics.model import Model
from vinetrack.dynamics.simulate import Trajectory, simulate_many
from vinetrack.inference.fit_result import Fit
from vinetrack.inference.sensitivity import RELEASE
from vinetrack.inference.trajectory_jobs import Job

N_STEPS = 400  # Steps of a motion, denser at its start (derived)

# Diagonal coefficient of the two-stage, second-order, L-stable method of Alexander, SIAM J. Numer
SDIRK_GAMMA = 1 - 1 / math.sqrt(2)

EXTRA_FRAMES = 3.0  # Frames by which a motion is integrated beyond its recording, in case its release moves (chosen)

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


def motions_of(fit: Fit, trial_effects: Floats, theta: Floats | None = None) -> list[FittedMotion]:
    """Simulate the fitted motions with given trial effects and, optionally, other model parameters. Shapes:
    trial_effects (n_trials, 4); theta (n_free,).
    """
    predictor = fit.predictor
    jobs = predictor.jobs(fit.solution.state.theta if theta is None else theta, trial_effects)
    trials = [trial_of_job(trial_data.trial, job) for trial_data, job in zip(predictor.data, jobs, strict=True)]
    grids = [
        max(trial_data.time_s[-1] - trial_effects[i, RELEASE] + EXTRA_FRAMES * trial_data.frame_s, 1e-6)
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


def force_sensitivities(
    fit: Fit, trial_effects: Floats, motions: Sequence[FittedMotion], force: Callable[[FittedMotion], Floats]
) -> list[Floats]:
    """Derivatives of the observed positions of every trial with respect to force amplitudes. Shapes: trial_effects
    (n_trials, 4) → (n_points, n_forces).
    """
    return acceleration_sensitivities(
        fit, trial_effects, motions, [force(motion) / motion.mass_kg[:, None] for motion in motions]
    )


def acceleration_sensitivities(
    fit: Fit, trial_effects: Floats, motions: Sequence[FittedMotion], accelerations: Sequence[Floats]
) -> list[Floats]:
    """As `force_sensitivities`, for added accelerations of the tail in place of forces. Shapes: trial_effects
    (n_trials, 4); accelerations (N_STEPS + 1, n) → (n_points, n).
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
