"""What a small further force on the tail would do to every trajectory of a fit.

About the fitted motion x(t) the equation of motion m ẍ = F(x, ẋ, t) + f becomes, for a small force f,

    δẍ = (∂a/∂x) δx + (∂a/∂ẋ) δẋ + f/m,   a = F/m

which is linear in f: any number of forces is followed at once, of any shape, and nothing is compiled for them. The
derivatives are differences of what the model's own effects say along the motion (`vinetrack.model.terms`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from vinetrack.model.fit_result import Fit
from vinetrack.model.model import Model
from vinetrack.model.sensitivity import RELEASE, Job
from vinetrack.model.simulate import Trajectory, simulate_many
from vinetrack.model.terms import evaluate
from vinetrack.records import Floats, Trial

STEPS = 400
"""Of each motion, closer together at its begin: what is slower than a hundredth of it is followed to 0.1 %."""

STAGE = 1 - 1 / math.sqrt(2)
"""Of the two-stage method of Alexander, SIAM J. Numer. Anal. 14, 1006 (1977): of second order, and calm where friction
settles much faster than a step."""

SLOWEST = 1e-3
"""Part of the highest speed below which a vine stands: no small force moves it."""


@dataclass(frozen=True)
class Motion:
    """The fitted motion of one trial on a fine grid; arrays have shape (STEPS + 1,), SI, since release.

    `mass_kg` is all that moves; `stiffness` and `friction` are ∂a/∂x and ∂a/∂ẋ. `seen` is by how much the camera sees
    the leading edge move when it moves.
    """

    trial: Trial
    time_s: Floats
    lead_position_m: Floats
    lead_velocity_m_s: Floats
    pressure_Pa: Floats
    mass_kg: Floats
    stiffness: Floats
    friction: Floats
    seen: Floats

    @property
    def tail_position_m(self) -> Floats:
        """Of the tail, r·y, m."""
        return self.trial.travel_ratio * self.lead_position_m

    @property
    def tail_velocity_m_s(self) -> Floats:
        """Of the tail, r·ẏ, m/s."""
        return self.trial.travel_ratio * self.lead_velocity_m_s


def motions_of(found: Fit, own: Floats) -> list[Motion]:
    """The fitted motions with these numbers of the trials' own, shape (n_trials, 4).

    Raises
    ------
    SimulationError
        If a trajectory cannot be followed.
    """
    predictor = found.predictor
    jobs = predictor.jobs(found.solution.state.theta, own)
    trials = [_as_it_was(item.trial, job) for item, job in zip(predictor.data, jobs, strict=True)]
    grids = [
        max(item.time_s[-1] - own[i, RELEASE], 1e-6) * np.linspace(0, 1, STEPS + 1) ** 2
        for i, item in enumerate(predictor.data)
    ]
    traces = [
        None if item.trace is None else (item.trace[0] - job.release_s, item.trace[1])
        for item, job in zip(predictor.data, jobs, strict=True)
    ]
    runs = simulate_many(
        found.model, trials, grids, traces=traces, parameters=np.array([job.row for job in jobs]), host=predictor.host
    )
    return [_motion(found.model, *one) for one in zip(trials, jobs, runs, traces, strict=True)]


def _as_it_was(trial: Trial, job: Job) -> Trial:
    """The trial with the pressures of its job."""
    yield_Pa = trial.yield_pressure_Pa if math.isnan(job.yield_pressure_Pa) else job.yield_pressure_Pa
    return replace(trial, pressure_Pa=trial.pressure_Pa * (1 + job.pressure_deviation), yield_pressure_Pa=yield_Pa)


def _motion(model: Model, trial: Trial, job: Job, run: Trajectory, trace: tuple[Floats, Floats] | None) -> Motion:
    values = dict(zip(model.parameter_names, job.row.tolist(), strict=True))
    model = model.with_values(values)
    time_s, y, v = run.time_s, run.lead_position_m, run.lead_velocity_m_s
    measured = None if trace is None else np.interp(time_s, *trace)
    plain = evaluate(model, trial, time_s, y, v, measured_Pa=measured)
    if measured is None and any("chamber_rate" in effect.functions for effect in model):
        # A chamber with a memory is taken as it is along the motion: a small force changes it by less still.
        measured = plain.pressure_Pa
    r = trial.travel_ratio
    step_y, step_v = 1e-4 * max(float(y.max()), 1e-9), 1e-4 * max(float(v.max()), 1e-9)
    further = evaluate(model, trial, time_s, y + step_y, v, measured_Pa=measured)
    faster = evaluate(model, trial, time_s, y, v + step_v, measured_Pa=measured)
    at_rest = v < SLOWEST * v.max()
    friction = (faster.acceleration_m_s2 - plain.acceleration_m_s2) / (r * step_v)
    return Motion(
        trial=trial,
        time_s=time_s,
        lead_position_m=y,
        lead_velocity_m_s=v,
        pressure_Pa=np.broadcast_to(plain.pressure_Pa, y.shape),
        mass_kg=np.broadcast_to(plain.inertia_kg, y.shape),
        stiffness=np.where(at_rest, 0.0, (further.acceleration_m_s2 - plain.acceleration_m_s2) / (r * step_y)),
        friction=np.where(at_rest & (time_s > time_s[STEPS // 20]), -1e9, np.minimum(friction, 0.0)),
        seen=_seen(run),
    )


def _seen(run: Trajectory) -> Floats:
    """By how much the camera sees the leading edge move when it moves; 0 once growth has ended."""
    away = np.gradient(run.lead_position_m, run.time_s)
    shown = np.gradient(run.observed_position_m, run.time_s)
    moving = away > SLOWEST * away.max()
    seen = np.where(moving, shown / np.where(moving, away, 1.0), 1.0)
    return np.where(run.time_s > run.end_time_s, 0.0, seen) if run.status == "ended" else seen


def answers_to_forces(
    found: Fit, own: Floats, motions: Sequence[Motion], force: Callable[[Motion], Floats]
) -> list[Floats]:
    """What forces on the tail do to the positions seen at the points of every trial, shape (n_points, n_forces), m.

    Parameters
    ----------
    force
        Gives the forces along a motion, N, shape (STEPS + 1, n_forces).
    """
    moved = _followed(motions, np.array([force(motion) for motion in motions]))
    answers = []
    for i, item in enumerate(found.predictor.data):
        since = item.time_s - own[i, RELEASE]
        motion = motions[i]
        grown = moved[i] / motion.trial.travel_ratio * motion.seen[:, None]
        answers.append(_at(since, motion.time_s, grown))
    return answers


def _at(since_s: Floats, grid_s: Floats, values: Floats) -> Floats:
    """Values of the grid at other times, linearly between; 0 before release."""
    k = np.clip(np.searchsorted(grid_s, since_s), 1, grid_s.size - 1)
    part = np.clip((since_s - grid_s[k - 1]) / (grid_s[k] - grid_s[k - 1]), 0.0, 1.0)[:, None]
    return np.where(since_s[:, None] > 0, values[k - 1] + part * (values[k] - values[k - 1]), 0.0)


def _followed(motions: Sequence[Motion], force: Floats) -> Floats:
    """δx of every trial and force, shape (n_trials, STEPS + 1, n_forces), m."""
    time_s = np.array([motion.time_s for motion in motions])
    k, c = (np.array([getattr(motion, name) for motion in motions])[:, :, None] for name in ("stiffness", "friction"))
    push = force / np.array([motion.mass_kg for motion in motions])[:, :, None]
    x, v = np.zeros_like(push[:, 0]), np.zeros_like(push[:, 0])
    moved = np.zeros_like(push)
    for i in range(STEPS):
        h = (time_s[:, i + 1] - time_s[:, i])[:, None]
        inside = [(1 - STAGE) * one[:, i] + STAGE * one[:, i + 1] for one in (k, c, push)]
        _, _, dx1, dv1 = _stage(x, v, STAGE * h, *inside)
        x2, v2 = x + (1 - STAGE) * h * dx1, v + (1 - STAGE) * h * dv1
        x, v, _, _ = _stage(x2, v2, STAGE * h, k[:, i + 1], c[:, i + 1], push[:, i + 1])
        moved[:, i + 1] = x
    return moved


def _stage(
    x: Floats, v: Floats, h: Floats, stiffness: Floats, friction: Floats, push: Floats
) -> tuple[Floats, Floats, Floats, Floats]:
    """Where (x, v) and its rates are once (x, v) = before + h·rates holds with the rates there."""
    rate = (stiffness * (x + h * v) + friction * v + push) / (1 - h * friction - h * h * stiffness)
    speed = v + h * rate
    return x + h * speed, speed, speed, rate
