"""What a small further force on the tail would do to every trajectory of a fit.

About the fitted motion x(t) the equation of motion m ẍ = F(x, ẋ, t) + f becomes, for a small force f,

    δẍ = (∂a/∂x) δx + (∂a/∂ẋ) δẋ + f/m,   a = F/m

which is linear in f: any number of forces is followed at once, of any shape, and nothing is compiled for them. The
derivatives are differences of what the model's own effects say along the motion (`vinetrack.dynamics.force_terms`).
A force that is not small is followed by doing so again about the motion that it leads to (Newton and Kantorovich).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from vinetrack.core.records import Floats, Trial
from vinetrack.diagnosis.force_kernels import answers
from vinetrack.dynamics.force_terms import evaluate
from vinetrack.dynamics.model import Model
from vinetrack.dynamics.simulate import Trajectory, simulate_many
from vinetrack.inference.fit_result import Fit
from vinetrack.inference.sensitivity import RELEASE
from vinetrack.inference.trajectory_jobs import Job

STEPS = 400
"""Of each motion, closer together at its begin: what is slower than a hundredth of it is followed to 0.1 %. Derived:
second order with 400 steps errs by 1e-5, by 1e-3 where a hundredth of the motion decides."""

STAGE = 1 - 1 / math.sqrt(2)
"""Of the two-stage method of Alexander, SIAM J. Numer. Anal. 14, 1006 (1977): of second order, and calm where friction
settles much faster than a step."""

SPARE_FRAMES = 3.0
"""By which a motion is followed beyond its recording, should its release move. Chosen: a release moves by less than a
frame."""

SLOWEST = 1e-3
"""Part of the highest speed below which a vine stands: no small force moves it. Chosen: below a thousandth of the top
speed nothing is seen to move."""


@dataclass(frozen=True)
class FittedMotion:
    """The motion of one trial on a fine grid; arrays have shape (STEPS + 1,), SI, since release.

    `mass_kg` is all that moves; `stiffness` and `friction` are ∂a/∂x and ∂a/∂ẋ; `free` is the tail's acceleration by
    the model's own forces there, `actual` that of this motion. `seen` is by how much the camera sees the leading edge
    move when it moves, `offset_m` how far from where it is; growth ends at `end_s`, positions count until
    `counts_until_s`. `model` holds the trial's own values, `measured_Pa` the pressure where it does not follow them.
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
    free: Floats
    actual: Floats
    seen: Floats
    offset_m: Floats
    end_s: float
    counts_until_s: float = math.inf

    @property
    def tail_position_m(self) -> Floats:
        """Of the tail, r·y, m."""
        return self.trial.travel_ratio * self.lead_position_m

    @property
    def tail_velocity_m_s(self) -> Floats:
        """Of the tail, r·ẏ, m/s."""
        return self.trial.travel_ratio * self.lead_velocity_m_s


def motions_of(fit: Fit, trial_effects: Floats, theta: Floats | None = None) -> list[FittedMotion]:
    """The fitted motions with these numbers of the trials' own, shape (n_trials, 4), and other numbers of the model.

    Parameters
    ----------
    fit : the fit whose model is followed.
    trial_effects : array, shape (n_trials, 4)
    theta : array, shape (n_free,), optional
        Numbers of the model, scaled; those of the fit where None.

    Returns
    -------
    list of FittedMotion

    Raises
    ------
    SimulationError
        If a trajectory cannot be followed.
    """
    predictor = fit.predictor
    jobs = predictor.jobs(fit.solution.state.theta if theta is None else theta, trial_effects)
    trials = [as_it_was(trial_data.trial, job) for trial_data, job in zip(predictor.data, jobs, strict=True)]
    grids = [
        max(trial_data.time_s[-1] - trial_effects[i, RELEASE] + SPARE_FRAMES * trial_data.frame_s, 1e-6)
        * np.linspace(0, 1, STEPS + 1) ** 2
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


def as_it_was(trial: Trial, job: Job) -> Trial:
    """The trial with the pressures of its job.

    Parameters
    ----------
    trial
        Row of the sheet.
    job
        Trajectory to simulate.

    Returns
    -------
    Trial
    """
    yield_Pa = trial.yield_pressure_Pa if math.isnan(job.yield_pressure_Pa) else job.yield_pressure_Pa
    return replace(trial, pressure_Pa=trial.pressure_Pa * (1 + job.pressure_deviation), yield_pressure_Pa=yield_Pa)


def _motion(model: Model, trial: Trial, job: Job, run: Trajectory, trace: tuple[Floats, Floats] | None) -> FittedMotion:
    model = model.with_values(dict(zip(model.parameter_names, job.row.tolist(), strict=True)))
    measured = None if trace is None else np.interp(run.time_s, *trace)
    if measured is None and any("chamber_rate" in effect.functions for effect in model):
        # A chamber with a memory is taken as it is along the motion: a small force changes it by less still.
        measured = evaluate(model, trial, run.time_s, run.lead_position_m, run.lead_velocity_m_s).pressure_Pa
    nothing = np.zeros_like(run.time_s)
    bare = FittedMotion(trial, model, measured, run.time_s, run.lead_position_m, run.lead_velocity_m_s, nothing,
                  nothing, nothing, nothing, nothing, nothing, _seen(run),
                  run.observed_position_m - run.lead_position_m,
                  run.end_time_s if run.status == "ended" else math.inf)  # fmt: skip
    motion = with_derivatives(bare)
    return replace(motion, actual=motion.free)


def with_derivatives(motion: FittedMotion) -> FittedMotion:
    """The motion with what the model says along it.

    Parameters
    ----------
    motion
        A fitted motion.

    Returns
    -------
    FittedMotion
    """
    y, v = motion.lead_position_m, motion.lead_velocity_m_s
    step_y, step_v = 1e-4 * max(float(y.max()), 1e-9), 1e-4 * max(float(v.max()), 1e-9)
    plain, further, faster = (
        evaluate(motion.model, motion.trial, motion.time_s, *at, measured_Pa=motion.measured_Pa)
        for at in ((y, v), (y + step_y, v), (y, v + step_v))
    )
    r = motion.trial.travel_ratio
    at_rest = v < SLOWEST * v.max()
    late = motion.time_s > motion.time_s[STEPS // 20]
    stiffness = (further.acceleration_m_s2 - plain.acceleration_m_s2) / (r * step_y)
    friction = (faster.acceleration_m_s2 - plain.acceleration_m_s2) / (r * step_v)
    return replace(
        motion,
        pressure_Pa=np.broadcast_to(plain.pressure_Pa, y.shape),
        mass_kg=np.broadcast_to(plain.inertia_kg, y.shape),
        stiffness=np.where(at_rest, 0.0, stiffness),
        friction=np.where(at_rest & late, -1e9, np.minimum(friction, 0.0)),
        free=np.asarray(plain.acceleration_m_s2),
    )


def _seen(run: Trajectory) -> Floats:
    """By how much the camera sees the leading edge move when it moves."""
    away = np.gradient(run.lead_position_m, run.time_s)
    shown = np.gradient(run.observed_position_m, run.time_s)
    moving = away > SLOWEST * away.max()
    seen = np.where(moving, shown / np.where(moving, away, 1.0), 1.0)
    return np.asarray(seen)


def force_sensitivities(
    fit: Fit, trial_effects: Floats, motions: Sequence[FittedMotion], force: Callable[[FittedMotion], Floats]
) -> list[Floats]:
    """What forces on the tail do to the positions seen at the points of every trial, shape (n_points, n_forces), m.

    Parameters
    ----------
    fit : the fit whose model is followed.
    trial_effects : array, shape (n_trials, 4)
    motions : sequence of FittedMotion
        One a trial.
    force : callable
        Gives the forces along a motion, N, shape (STEPS + 1, n_forces).

    Returns
    -------
    list of arrays, shape (n_points, n_forces), m
    """
    return push_sensitivities(
        fit, trial_effects, motions, [force(motion) / motion.mass_kg[:, None] for motion in motions]
    )


def push_sensitivities(
    fit: Fit, trial_effects: Floats, motions: Sequence[FittedMotion], pushes: Sequence[Floats]
) -> list[Floats]:
    """As `force_sensitivities`, for further accelerations of the tail, m/s², shape (STEPS + 1, n) for each trial.

    Parameters
    ----------
    fit : the fit whose model is followed.
    trial_effects : array, shape (n_trials, 4)
    motions : sequence of FittedMotion
        One a trial.
    pushes : sequence of arrays, shape (STEPS + 1, n), m/s²
        Further accelerations of the tail.

    Returns
    -------
    list of arrays, shape (n_points, n), m
    """
    moved, _ = _followed(motions, np.array(pushes))
    return [
        _at(
            trial_data.time_s - trial_effects[i, RELEASE],
            motion,
            answer * motion.seen[:, None] / motion.trial.travel_ratio,
        )
        for i, (trial_data, motion, answer) in enumerate(zip(fit.predictor.data, motions, moved, strict=True))
    ]


def pushed(motions: Sequence[FittedMotion], force: Callable[[FittedMotion], Floats], rounds: int) -> list[FittedMotion]:
    """The motions with a further force on the tail, N, shape (STEPS + 1,), that need not be small.

    Every round leaves about a tenth of the error of the one before; the motions are corrected to those of their models,
    if they are not that. Their stiffness and friction are then those with the force.

    Parameters
    ----------
    motions : sequence of FittedMotion
    force : callable
        Force along a motion, N, shape (STEPS + 1,).
    rounds : int
        Corrections.

    Returns
    -------
    list of FittedMotion
    """
    for _ in range(rounds):
        motions = [_answering(motion, force) for motion in motions]
        lacks = np.array([motion.free + force(motion) / motion.mass_kg - motion.actual for motion in motions])
        moved, sped = (answer[:, :, 0] for answer in _followed(motions, lacks[:, :, None]))
        motions = [_moved(*step) for step in zip(motions, lacks, moved, sped, strict=True)]
    return [_answering(motion, force) for motion in motions]


def _answering(motion: FittedMotion, force: Callable[[FittedMotion], Floats]) -> FittedMotion:
    """The motion with what the further force changes along it in stiffness and friction."""
    y, v = motion.lead_position_m, motion.lead_velocity_m_s
    step_y, step_v = 1e-4 * max(float(y.max()), 1e-9), 1e-4 * max(float(v.max()), 1e-9)
    plain, r = force(motion), motion.trial.travel_ratio
    further = (force(replace(motion, lead_position_m=y + step_y)) - plain) / (r * step_y * motion.mass_kg)
    faster = (force(replace(motion, lead_velocity_m_s=v + step_v)) - plain) / (r * step_v * motion.mass_kg)
    moves = v >= SLOWEST * v.max()
    return replace(
        motion,
        stiffness=motion.stiffness + np.where(moves, further, 0.0),
        friction=np.where(moves, np.minimum(motion.friction + faster, 0.0), motion.friction),
    )


def _moved(motion: FittedMotion, lacks: Floats, moved: Floats, sped: Floats) -> FittedMotion:
    """The motion after a change of the tail's position and speed; growth goes neither back nor beyond its end."""
    r = motion.trial.travel_ratio
    # A correction is no larger than half of the speed: what goes beyond is left to the next.
    part = float(np.min(np.where(sped < 0, 0.5 * motion.tail_velocity_m_s / np.maximum(-sped, 1e-12), 1.0), initial=1.0,
                        where=motion.lead_velocity_m_s > 0.05 * motion.lead_velocity_m_s.max()))  # fmt: skip
    part = min(part, 1.0)
    changed = replace(
        motion,
        lead_position_m=np.maximum(motion.lead_position_m + part * moved / r, 0.0),
        lead_velocity_m_s=np.maximum(motion.lead_velocity_m_s + part * sped / r, 0.0),
        actual=motion.actual + part * (motion.stiffness * moved + motion.friction * sped + lacks),
    )
    return with_derivatives(changed)


def _at(since_s: Floats, motion: FittedMotion, values: Floats) -> Floats:
    """Values of the grid at other times, linearly between; 0 before release and once growth has ended."""
    grid_s = motion.time_s
    k = np.clip(np.searchsorted(grid_s, since_s), 1, grid_s.size - 1)
    part = np.clip((since_s - grid_s[k - 1]) / (grid_s[k] - grid_s[k - 1]), 0.0, 1.0)[:, None]
    growing = (since_s > 0) & (since_s <= motion.end_s)
    return np.where(growing[:, None], values[k - 1] + part * (values[k] - values[k - 1]), 0.0)


def _followed(motions: Sequence[FittedMotion], push: Floats) -> tuple[Floats, Floats]:
    """δx and δẋ of every trial for further accelerations `push`, all of shape (n_trials, STEPS + 1, n), m and m/s."""
    time_s, k, c = (
        np.array([getattr(motion, name) for motion in motions]) for name in ("time_s", "stiffness", "friction")
    )
    moved, sped = answers(time_s, k, c, np.ascontiguousarray(push), STAGE)
    # What is compiled raises nothing by itself.
    if np.geterr()["over"] == "raise" and not (np.isfinite(moved).all() and np.isfinite(sped).all()):
        raise FloatingPointError("answers to a force that are not finite")
    return moved, sped
