"""Simulated tracks of candidate trials, sampled as the camera of the experiment would."""

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

LONGEST = 1.5  # Longest recording, as a multiple of the longest so far (chosen)

LEAST_GROWTH = 0.3  # Fraction of its length that a vine must grow while filmed for a trial to be worth making (chosen)

SIMULATED_TIMES = 400  # Times at which a condition is simulated (derived)

# Ratio of tail speed to steady speed at the same pressure above which the model predicts compression in the tail
# (chosen)
LARGEST_SPEED_RATIO = 1.05

FEWEST_REST_FRAMES = 3  # Frames at rest that are planned, at least (chosen)


@dataclass(frozen=True)
class TrackSampling:
    """How the experiment films: frame interval, frames at rest, frames after the end of growth, longest motion."""

    frame_s: float
    rest_frames: int
    frames_behind_end: int
    longest_s: float


def sampling_of(data: Sequence[FitTrial], like: int) -> TrackSampling:
    """Return how the experiment films, at the frame rate of the trial at `like`."""
    everting = [trial_data for trial_data in data if trial_data.trial.travel_ratio != 1]
    moving_s = [trial_data.time_s[-1] - trial_data.time_s[max(trial_data.n_rest - 1, 0)] for trial_data in everting]
    return TrackSampling(
        frame_s=data[like].frame_s,
        rest_frames=max(int(np.median([trial_data.n_rest for trial_data in everting])), FEWEST_REST_FRAMES),
        frames_behind_end=int(np.median([_behind_end(trial_data) for trial_data in everting])),
        longest_s=LONGEST * float(max(moving_s)),
    )


def _behind_end(trial_data: FitTrial) -> int:
    """Number of points of a track that show the vine after the end of its growth."""
    last = int(np.flatnonzero(trial_data.first)[-1])
    y = trial_data.lead_position_m
    if last == 0 or not math.isfinite(trial_data.trial.length_m):
        return 0
    left_out = y[last] - y[last - 1] > 0.25 * (1 - END_FRACTION) * trial_data.trial.length_m
    still = float(np.ptp(y[last:])) < 10 * max(trial_data.noise_m, 1e-6)
    return y.size - last if left_out and still else 0


@dataclass(frozen=True)
class GrowthCourse:
    """Course of growth of a condition: when the first hypothesis nears the end, and when the last one has ended.
    `ends_s` is infinite where one of them does not end in time.
    """

    near_end_s: float
    ends_s: float


def blank_trial(condition: Condition, time_s: Floats, data: Sequence[FitTrial], lead_position_m: Floats) -> FitTrial:
    """Return the data of a candidate trial at these times; a recorded pressure is constant. Shapes: time_s,
    lead_position_m (n_points,).
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


def growth_courses(
    hypotheses: Sequence[Hypothesis], conditions: Sequence[Condition], cameras: Sequence[TrackSampling]
) -> list[GrowthCourse | None]:
    """Return the course of growth of every condition; None where it is not worth filming or the model is in doubt."""
    data = hypotheses[0].fit.predictor.data
    times = [np.linspace(0.0, camera.longest_s, SIMULATED_TIMES) for camera in cameras]
    items = [blank_trial(condition, t, data, t) for condition, t in zip(conditions, times, strict=True)]
    trial_effects = np.zeros((len(conditions), N_TRIAL_EFFECTS))
    runs: list[list[Trajectory | None]] = []
    jobs: list[Job] = []
    for hypothesis in hypotheses:
        predictor = hypothesis.predictor(range(len(conditions)), items)
        jobs = predictor.jobs(hypothesis.theta, trial_effects)
        runs.append(_simulated(predictor, jobs))
    largest_ratio = max(LARGEST_SPEED_RATIO, _largest_speed_ratio(hypotheses[-1].fit))
    growth: list[GrowthCourse | None] = []
    for i, condition in enumerate(conditions):
        trajectories = [trajectory for trajectory in (run[i] for run in runs) if trajectory is not None]
        if len(trajectories) < len(runs):
            growth.append(None)
            continue
        length_m = condition.trial.length_m
        near_s = min(_time_at(moved, END_FRACTION * length_m, cameras[i].longest_s) for moved in trajectories)
        grown_m = min(float(np.interp(near_s, moved.time_s, moved.lead_position_m)) for moved in trajectories)
        ratio = _speed_ratio(hypotheses[-1].fit, condition.trial, jobs[i], trajectories[-1].tail_velocity_m_s)
        grows_enough = grown_m > LEAST_GROWTH * (length_m if math.isfinite(length_m) else 0.0)
        is_compressed = condition.trial.tail_slack != "free" and ratio > largest_ratio
        ends = max(moved.end_time_s if moved.status == "ended" else math.inf for moved in trajectories)
        growth.append(
            GrowthCourse(near_s, ends)
            if grows_enough and not is_compressed and near_s > 8 * cameras[i].frame_s
            else None
        )
    return growth


def _simulated(predictor: Predictor, jobs: Sequence[Job]) -> list[Trajectory | None]:
    """Trajectories of all jobs; None for those that cannot be simulated, found by bisection."""
    try:
        return list(predictor.run(jobs))
    except SimulationError:
        if len(jobs) == 1:
            return [None]
    middle = len(jobs) // 2
    return _simulated(predictor, jobs[:middle]) + _simulated(predictor, jobs[middle:])


def _time_at(moved: Trajectory, position_m: float, otherwise_s: float) -> float:
    """Time at which a vine reaches a position, s."""
    beyond = moved.lead_position_m >= position_m
    if not beyond.any():
        return otherwise_s
    k = int(np.argmax(beyond))
    return float(np.interp(position_m, moved.lead_position_m[k - 1 : k + 1], moved.time_s[k - 1 : k + 1]))


def _speed_ratio(fit: Fit, trial: Trial, job: Job, tail_velocity_m_s: Floats) -> float:
    """Ratio of the largest tail speed to the steady speed without payload; 0 where the model has no damping."""
    names = fit.model.parameter_names
    if DAMPING not in names or EXPONENT not in names:
        return 0.0
    B, n = (float(job.row[names.index(key)]) for key in (DAMPING, EXPONENT))
    yield_Pa = trial.yield_pressure_Pa if math.isnan(job.yield_pressure_Pa) else job.yield_pressure_Pa
    drive_N = (trial.pressure_Pa - yield_Pa) * trial.area_m2
    if not (drive_N > 0 and B > 0 and n > 0.05):
        return math.inf if not drive_N > 0 else 0.0
    return float(np.max(tail_velocity_m_s)) / (drive_N / B) ** (1 / n)


def _largest_speed_ratio(fit: Fit) -> float:
    """Largest ratio of tail speed to steady speed among the trials of the experiment."""
    jobs = fit.predictor.jobs(fit.solution.state.theta, np.zeros((len(fit.trials), N_TRIAL_EFFECTS)))
    ratios = [
        _speed_ratio(fit, trial_fit.trial, job, trial_fit.trial.travel_ratio * trial_fit.predicted_velocity_m_s)
        for trial_fit, job in zip(fit.trials, jobs, strict=True)
        if trial_fit.trial.travel_ratio != 1
    ]
    return max((value for value in ratios if math.isfinite(value)), default=0.0)


def film_trials(
    truth: Hypothesis,
    places: Sequence[int],
    conditions: Sequence[Condition],
    cameras: Sequence[TrackSampling],
    theta: Floats,
    deviations: Floats,
    rng: np.random.Generator,
) -> list[FitTrial | None]:
    """Simulate the tracks of the conditions at `places` under a hypothesis, with random release, origin and noise.
    Shapes: theta (n_free,); deviations (n_places, 2).
    """
    chosen, of_chosen = [conditions[k] for k in places], [cameras[k] for k in places]
    data = truth.fit.predictor.data
    times = [
        camera.frame_s * np.arange(camera.rest_frames + math.ceil(camera.longest_s / camera.frame_s), dtype=float)
        for camera in of_chosen
    ]
    items = [blank_trial(condition, t, data, t) for condition, t in zip(chosen, times, strict=True)]
    predictor = truth.predictor(places, items)
    trial_effects = np.zeros((len(chosen), N_TRIAL_EFFECTS))
    trial_effects[:, RELEASE] = [(camera.rest_frames - 1 + rng.uniform()) * camera.frame_s for camera in of_chosen]
    trial_effects[:, ORIGIN] = rng.uniform(-0.02, 0.02, len(chosen))
    trial_effects[:, PRESSURE] = np.where(predictor.has_pressure_deviation, deviations[:, 0], 0.0)
    trial_effects[:, DAMPING_DEVIATION] = np.where(predictor.has_damping_deviation, deviations[:, 1], 0.0)
    tracks = []
    for i, moved in enumerate(predictor.run(predictor.jobs(theta, trial_effects))):
        stop = times[i].size
        if moved.status == "ended":
            last_s = trial_effects[i, RELEASE] + moved.end_time_s
            stop = min(stop, int(np.searchsorted(times[i], last_s)) + of_chosen[i].frames_behind_end)
        noise = ar1_noise(stop, math.sqrt(truth.variance / (1 - truth.rho**2)), truth.rho, rng)
        position_m = trial_effects[i, ORIGIN] + moved.observed_position_m[:stop] + noise
        tracks.append(_usable_points(chosen[i], times[i][:stop], position_m, items[i].trace))
    return tracks


def _usable_points(
    condition: Condition, time_s: Floats, position_m: Floats, trace: tuple[Floats, Floats] | None
) -> FitTrial | None:
    """The usable points of a simulated track, selected as for a fit; None where there are too few."""
    pressure = None if trace is None else np.full(time_s.size, trace[1][0])
    try:
        return prepare_trial(condition.trial, plain_track(time_s, position_m, pressure_Pa=pressure))
    except FitError:
        return None
