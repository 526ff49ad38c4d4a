"""Candidate trials: those that could be made next, and a fit extended by them as if they had been filmed.

Every condition within the limits of the user is filmed once, without noise, as a fit predicts it. `extended` adds such
trials to the fit: its parameters stay as they are, and every new vine adds its own. What a design would tell, which is
all trials so far and some of these, is then a sum over trials (`vinetrack.diagnosis.further_trials`).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from vinetrack.core.records import END_FRACTION, Floats, Track, Trial, plain_track
from vinetrack.dynamics.model import Model
from vinetrack.dynamics.simulate import SimulationError, Trajectory
from vinetrack.experiment.schema import COLUMNS, RIG, with_names
from vinetrack.experiment.settings import Limits
from vinetrack.inference.errors import trial_fit
from vinetrack.inference.fit_data import FitTrial
from vinetrack.inference.fit_result import DAMPING, EXPONENT, YIELD_PRESSURE, Fit, ParameterMap
from vinetrack.inference.marginal_likelihood import FitState, MixedProblem
from vinetrack.inference.optimiser import Solution, make_problem
from vinetrack.inference.sensitivity import N_TRIAL_EFFECTS, ORIGIN, RELEASE, Jobs, Predictor, initial_trial_effects
from vinetrack.planning.predictive_inputs import damping_prior, hoop_stress_Pa
from vinetrack.tracks.position_noise import ar1_noise

# ------------------------------------------------------------------------------
# Candidate trials for the next experiment: pressures, payloads, vines and rigs within the user's limits.
#
# Where a limit is not given it follows from the experiment: pressures from the lowest used to a quarter above the
# highest and never above the strength of the film; no payload or the heaviest used; half and twice the chamber;
# connectors of half and twice the area; and vines of other diameters and film thicknesses. Only one part of a rig
# changes at a time.

SAME_RIG, OTHER_RIG, NEW_VINE = 0, 1, 2  # Effort of a trial: nothing new (defined)


@dataclass(frozen=True)
class Condition:
    """A trial that could be made, modelled on that of index `like`: of its vine, else of the vine nearest in size."""

    trial: Trial
    like: int
    effort: int
    changed: tuple[str, ...] = ()


def feasible_conditions(trials: Sequence[Trial], limits: Limits) -> list[Condition]:
    """Every candidate trial; empty where the limits exclude all."""
    used = [trial for trial in trials if trial.travel_ratio != 1]
    first = {trial.vine: k for k, trial in reversed(list(enumerate(trials))) if trial.travel_ratio != 1}
    models = [(trials[k], k) for k in sorted(first.values())]
    sizes = ("diameter_mm", "thickness_um", "length_mm")
    stated = {column: values for column in sizes if (values := _stated(limits, column)) is not None}
    vines = [
        (trial, k, SAME_RIG)
        for trial, k in models
        if all(_is_among(_of(trial, column), [*values, math.nan]) for column, values in stated.items())
    ]
    if limits.new_vines:
        vines += [(vine, like, NEW_VINE) for vine, like in _new_vines(models, limits)]
    loads = {trial.payload_kg for trial in used}
    # No payload (or the lightest allowed), the heaviest (0.05 kg where none was used yet), and those used in between
    low, high = _stated(limits, "payload_g") or (0.0, max(loads, default=0.0) or 0.05)
    payloads = sorted({low, high, *(payload for payload in loads if low <= payload <= high)})
    conditions: list[Condition] = []
    for vine, like, effort_of_vine in vines:
        rigs = _rigs(vine, used, limits)
        least = min((effort for effort, _ in rigs), default=SAME_RIG)
        for effort, rig in rigs:
            if effort_of_vine == NEW_VINE and effort > least:
                continue
            for payload in payloads:
                for pressure, sigma in _pressures(rig, payload, used, limits):
                    name = f"next_{len(conditions) + 1}"
                    trial = replace(rig, name=name, payload_kg=payload, pressure_Pa=pressure, pressure_sigma_Pa=sigma)
                    changed = _changed(trial, trials[like])
                    conditions.append(Condition(trial, like, max(effort, effort_of_vine), changed))
    return conditions


def _of(trial: Trial, column: str) -> float:
    """The value of a column, SI."""
    value: float = getattr(trial, COLUMNS[column].field)
    return value


def _stated(limits: Limits, column: str) -> list[float] | None:
    """Values of a column that the user allows, SI; None for any."""
    values = getattr(limits, column)
    return None if values is None else [COLUMNS[column].scale.to_si(value) for value in values]


def _is_among(value: float, values: Iterable[float]) -> bool:
    """Whether a value is one of these; a blank one is one of blank ones."""
    return any(
        math.isclose(value, listed, rel_tol=1e-4, abs_tol=1e-12) or (math.isnan(value) and math.isnan(listed))
        for listed in values
    )


def _changed(trial: Trial, before: Trial, columns: Iterable[str] = RIG) -> tuple[str, ...]:
    """The columns in which two trials differ."""
    return tuple(column for column in columns if not _is_among(_of(trial, column), [_of(before, column)]))


def _choices(
    limits: Limits, column: str, factors: Sequence[float], now: Sequence[float], others: Sequence[float] = ()
) -> list[float]:
    """Values of a column to choose from, SI: the user's; else those of now, others, and multiples of the smallest and
    largest of now to two significant digits, as a person would order them. A part that is not there stays so.
    """
    now, stated = [value for value in now if math.isfinite(value)], _stated(limits, column)
    if not now or stated is not None:
        return stated if stated and now else [math.nan]
    multiples = [float(f"{f * (min(now) if f < 1 else max(now)):.2g}") for f in factors]
    values = [*now, *filter(math.isfinite, others), *multiples]
    return [value for i, value in enumerate(values) if not _is_among(value, values[:i])]


def _rigs(vine: Trial, used: Sequence[Trial], limits: Limits) -> list[tuple[int, Trial]]:
    """The vine on every rig; chamber, connector and angle change one at a time unless the limits require more."""
    factors_of = {"chamber_l": (0.5, 2.0), "inlet_mm": (math.sqrt(0.5), math.sqrt(2.0)), "growth_angle_deg": ()}
    choices = [
        _choices(limits, column, factors, [_of(vine, column)], [_of(trial, column) for trial in used])
        for column, factors in factors_of.items()
    ]
    rigs: list[tuple[int, int, Trial]] = []
    for parts in itertools.product(*choices):
        changed: dict[str, Any] = {COLUMNS[column].field: part for column, part in zip(factors_of, parts, strict=True)}
        rig = replace(vine, **changed)
        changes = len(_changed(rig, vine))
        if changes == 0 or not rig.inlet_m > vine.diameter_m:
            at_hand = any(not _changed(rig, trial) for trial in used)
            rigs.append((changes, SAME_RIG if at_hand else OTHER_RIG, rig))
    fewest = min((changes for changes, _, _ in rigs), default=0)
    return [(effort, rig) for changes, effort, rig in rigs if changes <= max(1, fewest)]


def _pressures(rig: Trial, payload_kg: float, used: Sequence[Trial], limits: Limits) -> list[tuple[float, float]]:
    """Set pressures in equal ratios, Pa, each with its standard error."""
    pressure_step_pa = 100.0  # Resolution of set pressures, Pa (chosen)
    pressures = [trial.pressure_Pa for trial in used if trial.pressure_Pa > 0]
    if not pressures:
        return []
    # 1.25: a quarter above the highest used
    low, high = _stated(limits, "pressure_kPa") or (min(pressures), 1.25 * max(pressures))
    stress_Pa = hoop_stress_Pa(1.0, rig.diameter_m, rig.thickness_m)
    if math.isfinite(stress_Pa):
        # The default strength of film must not exclude pressures that this vine has held; a stated strength may.
        is_stated = "hoop_stress_MPa" in limits.model_fields_set
        held = [trial.pressure_Pa for trial in used if trial.vine == rig.vine and not is_stated]
        bursts_Pa = 1e6 * limits.hoop_stress_MPa / stress_Pa
        high = min(high, max([pressure_step_pa * math.floor(bursts_Pa / pressure_step_pa), *held]))
    if payload_kg == 0 and math.isfinite(rig.yield_pressure_Pa):
        # 1.15: lowest candidate pressure of a vine without payload, as a multiple of the yield pressure (chosen)
        low = max(low, 1.15 * rig.yield_pressure_Pa)
    if not low <= high:
        return []
    # 6: candidate pressures of a vine (chosen)
    steps = np.geomspace(low, high, 6) if high > 1.02 * low else np.array([high])
    relative = [t.pressure_sigma_Pa / t.pressure_Pa for t in used if t.pressure_Pa > 0]
    share = float(np.nanmedian(relative)) if np.isfinite(relative).any() else math.nan
    steps = np.clip(pressure_step_pa * np.round(steps / pressure_step_pa), low, high)
    return [(float(pressure), share * float(pressure)) for pressure in np.unique(steps.round(3))]


def _new_vines(models: Sequence[tuple[Trial, int]], limits: Limits) -> list[tuple[Trial, int]]:
    """Vines that could be made, each with the index of the trial whose vine is nearest in size."""
    vines = [trial for trial, _ in models]
    diameters, walls = (
        sorted(_choices(limits, column, factors, [_of(vine, column) for vine in vines]))
        for column, factors in (("diameter_mm", (0.5, 0.75, 1.5)), ("thickness_um", (0.5, 2.0)))
    )
    new_vines: list[tuple[Trial, int]] = []
    for diameter, wall in itertools.product(diameters, walls):
        column = COLUMNS["diameter_mm"]
        if not wall <= diameter / 4 or not column.low <= 1e3 * diameter <= column.high:
            continue
        distances = [math.hypot(math.log(v.diameter_m / diameter), math.log(v.thickness_m / wall)) for v in vines]
        near, like = models[int(np.argmin(distances))]
        for length in _stated(limits, "length_mm") or [near.length_m]:
            size: dict[str, Any] = {"diameter_m": diameter, "thickness_m": wall, "length_m": length}
            sized = replace(near, video=None, track=None, pressure_trace=None, **size)
            if all(_changed(sized, vine, ("diameter_mm", "thickness_um", "length_mm")) for vine in vines):
                new_vines.append((with_names([sized])[0], like))
    most = 10  # New vines considered, at most (chosen)
    if len(new_vines) <= most:
        return new_vines
    return [new_vines[k] for k in np.linspace(0, len(new_vines) - 1, most).round().astype(int)]


# ------------------------------------------------------------------------------
# A fit extended by trials that it was not fitted to, as if they had been filmed.


def extended(fit: Fit, films: Sequence[tuple[Condition, FitTrial]]) -> tuple[Predictor, MixedProblem, FitState]:
    """Predictor, problem and state of a fit with further trials, its parameters as they are. A new vine adds its own: B
    of the vine nearest in size, scaled by the ratio of their priors, and the yield pressure with the error to which it
    will be measured.
    """
    old, state, data, names = fit.predictor.layout, fit.solution.state, fit.predictor.data, fit.model.parameter_names
    further = [film for _, film in films]
    fitted_rows, _ = old.rows(state.theta)
    free, index, base = list(old.free), list(old.index), list(old.base)
    places: dict[tuple[str, str], int] = {}
    for condition, film in films:
        trial, like = film.trial, data[condition.like].trial
        row, values = old.index[condition.like].copy(), np.array(fitted_rows[condition.like])
        is_new = trial.vine != like.vine
        if is_new and fit.predictor.damping_column >= 0:
            prior, known = (damping_prior(vine.diameter_m, vine.thickness_m) for vine in (trial, like))
            values[fit.predictor.damping_column] *= prior / known
        for column, key in enumerate(old.keys):
            if is_new and row[column] >= 0 and (of_like := old.free[row[column]]).vine:
                if (key, trial.vine) not in places:
                    places[key, trial.vine] = len(free)
                    start = trial.yield_pressure_Pa if key == YIELD_PRESSURE else of_like.start
                    if key in names:
                        start = float(np.clip(values[names.index(key)], of_like.lower, of_like.upper))
                    free.append(replace(of_like, vine=trial.vine, start=start))
                row[column] = places[key, trial.vine]
        index.append(row)
        base.append(values)
    layout = ParameterMap(old.model, tuple(free), old.keys, np.array(index), np.array(base))
    predictor = Predictor(layout, [*data, *further], fit.predictor.host)
    predictor.steps = fit.predictor.steps.copy()
    typical = np.exp(np.mean(np.log(state.variance)))
    state = replace(
        state,
        theta=np.append(state.theta, layout.start[state.theta.size :]),
        trial_effects=np.concatenate([state.trial_effects, initial_trial_effects(further)]),
        variance=np.append(state.variance, np.full(len(films), typical)),
    )
    problem = make_problem(predictor, state.trial_effects)
    problem.release_origin_mean[: len(data)] = fit.solution.problem.release_origin_mean
    return predictor, problem, state


def extended_fit(fit: Fit, films: Sequence[tuple[Condition, FitTrial]]) -> Fit:
    """The fit with further trials, as `filmed`, linearised at its parameters and not refitted."""
    predictor, problem, state = extended(fit, films)
    state.trial_effects[len(fit.trials) :] = 0.0
    held = {name: getattr(fit.solution, name) for name in ("estimable", "noise_held", "converged", "iterations")}
    return at_solution(fit, Solution.at(predictor, problem, state, **held))


def at_solution(fit: Fit, solution: Solution) -> Fit:
    """The fit with other data and state; its numbers and errors are not computed anew."""
    state, trials = solution.state, []
    of_trials = zip(solution.predictor.data, state.trial_effects, solution.columns, state.variance, strict=True)
    for film, effects, columns, variance in of_trials:
        position_m = film.lead_position_m - effects[ORIGIN] - columns[:, -1]
        trials.append(trial_fit(film, effects, position_m, -columns[:, RELEASE], state.rho, float(variance)))
    return replace(fit, solution=solution, trials=tuple(trials), with_errors=None)


# ------------------------------------------------------------------------------
# Films of candidate trials, sampled as the camera of the experiment would.


def blank_film(fit: Fit, condition: Condition, time_s: Floats) -> FitTrial:
    """A trial of a condition at these times; its positions are placeholders, and a recorded pressure is constant."""
    trial, like = condition.trial, fit.predictor.data[condition.like]
    constant = (np.array([-1e3, 1e3]), np.full(2, trial.pressure_Pa))
    return FitTrial(
        trial=trial,
        time_s=time_s,
        lead_position_m=time_s,
        first=np.arange(time_s.size) == 0,
        n_rest=int(np.count_nonzero(time_s <= 0)),
        noise_m=like.noise_m,
        correlation=like.correlation,
        trace=None if like.trace is None else constant,
        position_systematic_m=like.position_systematic_m,
        slow_m=None if like.slow_m is None else np.full(time_s.size, np.median(like.slow_m)),
    )


def filming(fit: Fit) -> tuple[int, float]:
    """Frames at rest before release, and the longest motion that is filmed, s: longer than any so far."""
    data = [trial_data for trial_data in fit.predictor.data if trial_data.trial.travel_ratio != 1]
    moving_s = [trial_data.time_s[-1] - trial_data.time_s[max(trial_data.n_rest - 1, 0)] for trial_data in data]
    return max(int(np.median([trial_data.n_rest for trial_data in data])), 3), 1.5 * float(max(moving_s))


def _courses(fit: Fit, blanks: Sequence[tuple[Condition, FitTrial]]) -> list[tuple[Jobs, Trajectory | None]]:
    """Job and trajectory of trials released at time and position 0; None, by bisection, if one cannot be simulated."""
    predictor, _, state = extended(fit, blanks)
    state.trial_effects[len(fit.trials) :] = 0.0
    jobs = predictor.jobs(state.theta, state.trial_effects)[len(fit.trials) :]
    try:
        return list(zip(jobs, predictor.run(jobs), strict=True))
    except SimulationError:
        if len(blanks) == 1:
            return [(jobs[0], None)]
    middle = len(blanks) // 2
    return _courses(fit, blanks[:middle]) + _courses(fit, blanks[middle:])


def filmed(fits: Sequence[Fit], conditions: Sequence[Condition]) -> list[tuple[Condition, FitTrial]]:
    """One trial of every condition without noise, as the first fit predicts it, until the first of all predictions
    nears the end of the growth. Conditions that are not worth filming, or for which the last model is in doubt, are
    left out.
    """
    if not conditions:
        return []
    fit, (rest_frames, longest_s) = fits[-1], filming(fits[-1])
    # Fine at the start, where a quick vine has its whole growth
    grid_s = longest_s * np.linspace(0.0, 1.0, 1000) ** 2
    runs = [_courses(each, [(one, blank_film(fit, one, grid_s)) for one in conditions]) for each in fits]
    # The largest ratio of tail speed to steady speed among the trials so far
    made = fit.predictor.jobs(fit.solution.state.theta, np.zeros((len(fit.trials), N_TRIAL_EFFECTS)))
    seen = [
        _speed_ratio(fit, trial_fit.trial, job, trial_fit.trial.travel_ratio * trial_fit.predicted_velocity_m_s)
        for trial_fit, job in zip(fit.trials, made, strict=True)
        if trial_fit.trial.travel_ratio != 1
    ]
    # 1.05: the ratio above which the model predicts compression in the tail (chosen)
    largest_ratio = max(1.05, *filter(math.isfinite, seen))
    films = []
    for condition, *courses in zip(conditions, *runs, strict=True):
        trial, moving = condition.trial, [moved for _, moved in courses if moved is not None]
        if len(moving) < len(fits):
            continue
        near_m = np.nan_to_num(END_FRACTION * trial.length_m, nan=math.inf)
        # When the first of these courses nears the end of the growth, s, or ends
        near_s = min(float(np.interp(near_m, moved.lead_position_m, moved.time_s)) for moved in moving)
        grown_m = min(float(np.interp(near_s, moved.time_s, moved.lead_position_m)) for moved in moving)
        ratio = _speed_ratio(fit, trial, courses[-1][0], moving[-1].tail_velocity_m_s)
        # 0.3: fraction of its length that a vine must grow while filmed for a trial to be worth making (chosen)
        grows_enough = (
            grown_m > 0.3 * np.nan_to_num(trial.length_m) and near_s > 8 * fit.predictor.frames_s[condition.like]
        )
        if grows_enough and (trial.tail_slack == "free" or ratio <= largest_ratio):
            films.append((condition, _film(fit, condition, near_s, moving[0], rest_frames)))
    return films


def _film(fit: Fit, condition: Condition, near_s: float, course: Trajectory, rest_frames: int) -> FitTrial:
    """A film of a course at points that stand for the frames around them, the first one for those at rest: what frames
    themselves tell of a quick vine depends on where in a frame it is released.
    """
    points = 100  # Points of a film in motion (chosen)
    step_s, frame_s, rho = near_s / points, fit.predictor.frames_s[condition.like], fit.solution.state.rho
    time_s = np.insert(step_s * (np.arange(points) + 0.5), 0, -frame_s)
    frames = np.insert(np.full(points, step_s / frame_s), 0, rest_frames)
    return replace(
        blank_film(fit, condition, time_s),
        lead_position_m=np.interp(time_s, course.time_s, course.observed_position_m),
        # For smooth curves AR(1) noise is equivalent to white noise of variance σ²_innovation/(1 − ρ)².
        first=np.ones(time_s.size, dtype=bool),
        relative_sd=np.sqrt((1 + rho) / (1 - rho) / frames),
    )


def _speed_ratio(fit: Fit, trial: Trial, job: Jobs, tail_velocity_m_s: Floats) -> float:
    """Ratio of the largest tail speed to the steady speed without payload; 0 where the model has no damping."""
    names = fit.model.parameter_names
    if DAMPING not in names or EXPONENT not in names:
        return 0.0
    B, n = (float(job.row[names.index(key)]) for key in (DAMPING, EXPONENT))
    yield_Pa = trial.yield_pressure_Pa if np.isnan(job.yield_pressure_Pa) else float(job.yield_pressure_Pa)
    drive_N = (trial.pressure_Pa - yield_Pa) * trial.area_m2
    if not (drive_N > 0 and B > 0 and n > 0.05):
        return math.inf if not drive_N > 0 else 0.0
    return float(np.max(tail_velocity_m_s)) / (drive_N / B) ** (1 / n)


def tracks_of(
    predictor: Predictor,
    state: FitState,
    jobs: Jobs,
    rng: np.random.Generator,
    times_s: Sequence[Floats] | None = None,
    model: Model | None = None,
) -> list[tuple[Trial, Track]]:
    """Tracks of simulated trials up to the end of growth, with the noise of a fit; at its times, or others."""
    tracks = []
    times_s = times_s or [predictor.data[i].time_s for i in jobs.trial]
    for i, time_s, trajectory in zip(jobs.trial.tolist(), times_s, predictor.run(jobs, times_s, model), strict=True):
        film, release_s, origin_m = predictor.data[i], *state.trial_effects[i, [RELEASE, ORIGIN]]
        ends_s = release_s + trajectory.end_time_s if trajectory.status == "ended" else math.inf
        stop = int(np.searchsorted(time_s, ends_s))
        noise_m = ar1_noise(stop, math.sqrt(state.variance[i] / (1 - state.rho**2)), state.rho, rng)
        position_m = origin_m + trajectory.observed_position_m[:stop] + noise_m
        pressure_Pa = None if film.trace is None else np.interp(time_s[:stop], *film.trace)
        track = plain_track(time_s[:stop], position_m, pressure_Pa=pressure_Pa)
        slow_m = np.full(stop, math.nan if film.slow_m is None else np.median(film.slow_m))
        tracks.append((film.trial, replace(track, lead_position_systematic_m=slow_m)))
    return tracks
