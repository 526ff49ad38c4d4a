"""Trials that have not been made, as the camera of the experiment would film them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vinetrack.core.records import Floats, Trial, plain_track
from vinetrack.dynamics.simulate import SimulationError, Trajectory
from vinetrack.inference.fit_data import END_FRACTION, FitError, FitTrial, prepare_trial
from vinetrack.inference.fit_result import Fit
from vinetrack.inference.parameters import DAMPING, EXPONENT
from vinetrack.inference.sensitivity import DAMPING_DEVIATION, N_TRIAL_EFFECTS, ORIGIN, PRESSURE, RELEASE, Predictor
from vinetrack.inference.trajectory_jobs import Job
from vinetrack.planning.feasible_trials import Condition
from vinetrack.planning.hypothesis_predictions import Hypothesis
from vinetrack.tracks.position_noise import ar1_noise

LONGEST = 1.5
"""A recording lasts no longer than this many times the longest that was used. Chosen: storage and light of a camera
allow a little more than was used. At half slow trials are not offered, at twice some that the camera may not hold."""

LEAST_TRAVEL = 0.3
"""Part of its length that a vine must grow while filmed for a trial to be worth making. Chosen: less hardly leaves the
start behind. At half trials that show only the start are offered, at twice only those that nearly finish."""

TIMES_LOOKED_AT = 400
"""Instants at which a condition is followed. Derived: the end is interpolated to (1/400)²/8 of the curvature."""

LEAST_SLACK = 1.05
"""Tail speed, in steady speeds at the same pressure, beyond which a tail would have to push: there the model is in
doubt unless it was made for that, or the trials so far were of that kind. Chosen: 5 % over the steady speed is the
model's rounding of the start; at half ordinary trials are refused, at twice trials with a pushing tail pass."""

LINGER_FRAMES = 3
"""Least frames at rest that are planned. Chosen: they fix the origin to 0.6 of one frame's noise."""


@dataclass(frozen=True)
class TrackSampling:
    """How the experiment filmed: spacing of frames, frames at rest, frames behind the end of growth, longest motion."""

    frame_s: float
    rest_frames: int
    frames_behind_end: int
    longest_s: float


def camera_of(data: Sequence[FitTrial], like: int) -> TrackSampling:
    """The experiment's camera, at the frame rate of the trial at `like`.

    Parameters
    ----------
    data : trials of the experiment, with everting ones among them.
    like : int
        Place of the trial whose frame rate is taken.

    Returns
    -------
    TrackSampling
    """
    seen = [trial_data for trial_data in data if trial_data.trial.travel_ratio != 1]
    moving_s = [trial_data.time_s[-1] - trial_data.time_s[max(trial_data.n_rest - 1, 0)] for trial_data in seen]
    return TrackSampling(
        frame_s=data[like].frame_s,
        rest_frames=max(int(np.median([trial_data.n_rest for trial_data in seen])), LINGER_FRAMES),
        frames_behind_end=int(np.median([_behind_end(trial_data) for trial_data in seen])),
        longest_s=LONGEST * float(max(moving_s)),
    )


def _behind_end(trial_data: FitTrial) -> int:
    """Points of a track that show the vine at the end of its growth."""
    last = int(np.flatnonzero(trial_data.first)[-1])
    y = trial_data.lead_position_m
    if last == 0 or not math.isfinite(trial_data.trial.length_m):
        return 0
    left_out = y[last] - y[last - 1] > 0.25 * (1 - END_FRACTION) * trial_data.trial.length_m
    still = float(np.ptp(y[last:])) < 10 * max(trial_data.noise_m, 1e-6)
    return y.size - last if left_out and still else 0


@dataclass(frozen=True)
class GrowthCourse:
    """How a condition runs: when the first hypothesis nears the end of growth, and when the last of them has ended.

    `ends_s` is infinite where one of them does not end in time.
    """

    near_end_s: float
    ends_s: float


def blank(condition: Condition, time_s: Floats, data: Sequence[FitTrial], lead_position_m: Floats) -> FitTrial:
    """A trial as a fit sees it, at these times since release; where the experiment measures pressure it is constant.

    Parameters
    ----------
    condition : the trial that could be made.
    time_s : array, shape (n_points,), s
        Times since release; those up to 0 are at rest.
    data : trials of the experiment; noise and pressure trace are those of the one the condition is like.
    lead_position_m : array, shape (n_points,), m
        Positions to fill in.

    Returns
    -------
    FitTrial
    """
    like = data[condition.like]
    trace = None
    if like.trace is not None:
        ends = np.array([-1e3, 1e3])
        trace = (ends, np.full(2, condition.trial.pressure_Pa))
    return FitTrial(
        trial=condition.trial,
        time_s=time_s,
        lead_position_m=lead_position_m,
        first=np.arange(time_s.size) == 0,
        n_rest=int(np.count_nonzero(time_s <= 0)),
        noise_m=like.noise_m,
        correlation=like.correlation,
        trace=trace,
    )


def courses(
    hypotheses: Sequence[Hypothesis], conditions: Sequence[Condition], cameras: Sequence[TrackSampling]
) -> list[GrowthCourse | None]:
    """How every condition would run; None where it is not worth filming, or where the model is in doubt.

    Parameters
    ----------
    hypotheses : carried to the conditions; the slack of the last one decides.
    conditions : trials that could be made.
    cameras : of each condition.

    Returns
    -------
    list of Course or None
    """
    data = hypotheses[0].fit.predictor.data
    times = [np.linspace(0.0, camera.longest_s, TIMES_LOOKED_AT) for camera in cameras]
    items = [blank(condition, t, data, t) for condition, t in zip(conditions, times, strict=True)]
    every = range(len(conditions))
    trial_effects = np.zeros((len(conditions), N_TRIAL_EFFECTS))
    runs: list[list[Trajectory | None]] = []
    jobs: list[Job] = []
    for hypothesis in hypotheses:
        predictor = hypothesis.predictor(every, items)
        jobs = predictor.jobs(hypothesis.theta, trial_effects)
        runs.append(_followed(predictor, jobs))
    allowed = max(LEAST_SLACK, _slackest_so_far(hypotheses[-1].fit))
    runs_or_none: list[GrowthCourse | None] = []
    for i, condition in enumerate(conditions):
        mine = [trajectory for trajectory in (run[i] for run in runs) if trajectory is not None]
        if len(mine) < len(runs):
            runs_or_none.append(None)
            continue
        length_m = condition.trial.length_m
        near_s = min(_reaches(trajectory, END_FRACTION * length_m, cameras[i].longest_s) for trajectory in mine)
        grown_m = min(float(np.interp(near_s, trajectory.time_s, trajectory.lead_position_m)) for trajectory in mine)
        slack = _slackness(hypotheses[-1].fit, condition.trial, jobs[i], mine[-1].tail_velocity_m_s)
        worth = grown_m > LEAST_TRAVEL * (length_m if math.isfinite(length_m) else 0.0)
        doubtful = condition.trial.tail_slack != "free" and slack > allowed
        ends = max(trajectory.end_time_s if trajectory.status == "ended" else math.inf for trajectory in mine)
        runs_or_none.append(
            GrowthCourse(near_s, ends) if worth and not doubtful and near_s > 8 * cameras[i].frame_s else None
        )
    return runs_or_none


def _followed(predictor: Predictor, jobs: Sequence[Job]) -> list[Trajectory | None]:
    """Trajectories of all jobs, None for those that cannot be followed."""
    try:
        return list(predictor.run(jobs))
    except SimulationError:
        if len(jobs) == 1:
            return [None]
    middle = len(jobs) // 2
    return _followed(predictor, jobs[:middle]) + _followed(predictor, jobs[middle:])


def _reaches(moved: Trajectory, position_m: float, otherwise_s: float) -> float:
    """When a vine is so far, s."""
    beyond = moved.lead_position_m >= position_m
    if not beyond.any():
        return otherwise_s
    k = int(np.argmax(beyond))
    return float(np.interp(position_m, moved.lead_position_m[k - 1 : k + 1], moved.time_s[k - 1 : k + 1]))


def _slackness(fit: Fit, trial: Trial, job: Job, tail_velocity_m_s: Floats) -> float:
    """Largest tail speed, in the steady speed of a bare vine there; 0 where the model has no damping."""
    names = fit.model.parameter_names
    if DAMPING not in names or EXPONENT not in names:
        return 0.0
    B, n = (float(job.row[names.index(key)]) for key in (DAMPING, EXPONENT))
    yield_Pa = trial.yield_pressure_Pa if math.isnan(job.yield_pressure_Pa) else job.yield_pressure_Pa
    drive_N = (trial.pressure_Pa - yield_Pa) * trial.area_m2
    if not (drive_N > 0 and B > 0 and n > 0.05):
        return math.inf if not drive_N > 0 else 0.0
    return float(np.max(tail_velocity_m_s)) / (drive_N / B) ** (1 / n)


def _slackest_so_far(fit: Fit) -> float:
    """Largest slackness among the trials of the experiment."""
    jobs = fit.predictor.jobs(fit.solution.state.theta, np.zeros((len(fit.trials), N_TRIAL_EFFECTS)))
    slack = [
        _slackness(fit, trial_fit.trial, job, trial_fit.trial.travel_ratio * trial_fit.predicted_velocity_m_s)
        for trial_fit, job in zip(fit.trials, jobs, strict=True)
        if trial_fit.trial.travel_ratio != 1
    ]
    return max((value for value in slack if math.isfinite(value)), default=0.0)


def film(
    truth: Hypothesis,
    places: Sequence[int],
    conditions: Sequence[Condition],
    cameras: Sequence[TrackSampling],
    theta: Floats,
    deviations: Floats,
    rng: np.random.Generator,
) -> list[FitTrial | None]:
    """The conditions at `places` grown as the hypothesis has it and filmed: each as a fit sees it.

    Every trial has a release, an origin and noise of its own. None where the film shows nothing that can be fitted.

    Parameters
    ----------
    truth : the hypothesis taken for true.
    places : sequence of int
        Places among the conditions, one a trial.
    conditions : all conditions.
    cameras : of all conditions.
    theta : array, shape (n_free,)
        The true numbers, scaled.
    deviations : array, shape (n_places, 2)
        Of pressure, relative, and of ln B.
    rng : numpy.random.Generator

    Returns
    -------
    list of FitTrial or None
        One a place.
    """
    chosen, lenses = [conditions[k] for k in places], [cameras[k] for k in places]
    data = truth.fit.predictor.data
    times = [
        lens.frame_s * np.arange(lens.rest_frames + math.ceil(lens.longest_s / lens.frame_s), dtype=float)
        for lens in lenses
    ]
    items = [blank(condition, t, data, t) for condition, t in zip(chosen, times, strict=True)]
    predictor = truth.predictor(places, items)
    trial_effects = np.zeros((len(chosen), N_TRIAL_EFFECTS))
    trial_effects[:, RELEASE] = [(lens.rest_frames - 1 + rng.uniform()) * lens.frame_s for lens in lenses]
    trial_effects[:, ORIGIN] = rng.uniform(-0.02, 0.02, len(chosen))
    trial_effects[:, PRESSURE] = np.where(predictor.has_pressure_deviation, deviations[:, 0], 0.0)
    trial_effects[:, DAMPING_DEVIATION] = np.where(predictor.has_damping_deviation, deviations[:, 1], 0.0)
    seen = []
    for i, moved in enumerate(predictor.run(predictor.jobs(theta, trial_effects))):
        stop = times[i].size
        if moved.status == "ended":
            last_s = trial_effects[i, RELEASE] + moved.end_time_s
            stop = min(stop, int(np.searchsorted(times[i], last_s)) + lenses[i].frames_behind_end)
        noise = ar1_noise(stop, math.sqrt(truth.variance / (1 - truth.rho**2)), truth.rho, rng)
        position_m = trial_effects[i, ORIGIN] + moved.observed_position_m[:stop] + noise
        seen.append(_as_seen(chosen[i], times[i][:stop], position_m, items[i].trace))
    return seen


def _as_seen(
    condition: Condition, time_s: Floats, position_m: Floats, trace: tuple[Floats, Floats] | None
) -> FitTrial | None:
    """The usable points of the film, as a fit would choose them."""
    pressure = None if trace is None else np.full(time_s.size, trace[1][0])
    try:
        return prepare_trial(condition.trial, plain_track(time_s, position_m, pressure_Pa=pressure))
    except FitError:
        return None
