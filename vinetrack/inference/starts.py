"""Where a fit begins: release and origin from the rest frames, B and n from a coarse look at all trajectories."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.dynamics.simulate import SimulationError, simulate_many
from vinetrack.inference.fit_data import FitTrial
from vinetrack.inference.parameters import DAMPING, EXPONENT, ParameterMap
from vinetrack.inference.sensitivity import N_TRIAL_EFFECTS, ORIGIN, RELEASE, Predictor

EXPONENTS = (0.15, 0.37, 0.65, 1.0)
"""Exponents tried. Chosen around the published 0.37, from nearly constant friction to linear damping."""

DAMPING_FACTORS = (0.2, 0.4, 0.6, 0.8, 0.95, 1.1)
"""Tried against the B that would hold the speed reached; a vine that still accelerates has less. Chosen: the coarse
grid only has to come within a factor of two."""

POINTS_LOOKED_AT = 60
"""Points of a trial that the coarse search looks at. Chosen for time."""


def initial_trial_effects(data: Sequence[FitTrial]) -> Floats:
    """Release and origin of every trial from its rest frames, shape (n_trials, 4); deviations 0.

    Parameters
    ----------
    data : sequence of FitTrial

    Returns
    -------
    array, shape (n_trials, 4)
    """
    trial_effects = np.zeros((len(data), N_TRIAL_EFFECTS))
    for i, trial_data in enumerate(data):
        if trial_data.n_rest > 0:
            trial_effects[i, RELEASE] = trial_data.time_s[trial_data.n_rest - 1]
            trial_effects[i, ORIGIN] = np.mean(trial_data.lead_position_m[: max(trial_data.n_rest - 1, 1)])
        elif trial_data.imprecise_rest is not None:
            trial_effects[i, RELEASE], trial_effects[i, ORIGIN] = (
                trial_data.imprecise_rest.release_s,
                trial_data.imprecise_rest.origin_m,
            )
        else:
            trial_effects[i, RELEASE], trial_effects[i, ORIGIN] = trial_data.time_s[0], trial_data.lead_position_m[0]
        if trial_data.pressurised_in_recording:
            assert trial_data.trace is not None
            trial_effects[i, RELEASE] = min(trial_data.time_s[0], trial_data.trace[0][0])
    return trial_effects


def candidates(
    layout: ParameterMap, data: Sequence[FitTrial], predictor: Predictor
) -> list[tuple[float, Floats, Floats]]:
    """Starting points, best first: misfit, scaled values and own numbers of the trials.

    For each exponent, and each further value worth a try, every vine takes the B that misses its trials least; the
    release of each trial is scanned along.

    Parameters
    ----------
    layout : free numbers of the fit.
    data : sequence of FitTrial
    predictor : of these trials.

    Returns
    -------
    list of (misfit, theta, trial_effects)
        Shapes (), (n_free,), (n_trials, 4).
    """
    trial_effects = initial_trial_effects(data)
    tries = [sorted({number.start, *number.tries}) if number.tries else [number.start] for number in layout.free]
    combined = list(itertools.islice(itertools.product(*tries), 12))
    starts_found: list[tuple[Floats, Floats]] = []
    for values in combined:
        theta = np.array([number.to_scaled(value) for value, number in zip(values, layout.free, strict=True)])
        starts = _scan(layout, data, predictor, theta, trial_effects) if DAMPING in layout.keys else [theta]
        starts_found += [(start, trial_effects) for start in starts]
    scored = []
    for theta, begin in starts_found:
        try:
            releases, misfit = align(data, predictor, theta, begin)
        except SimulationError:
            continue
        scored.append((float(np.sum(misfit)), theta, releases))
    return sorted(scored, key=lambda scored_start: scored_start[0])


def one_of_each_condition(data: Sequence[FitTrial]) -> list[int]:
    """Places of one trial of every condition, the one with the most points.

    Parameters
    ----------
    data : sequence of FitTrial

    Returns
    -------
    list of int
    """
    best: dict[str, int] = {}
    for i, trial_data in enumerate(data):
        condition = trial_data.trial.condition
        if condition not in best or trial_data.time_s.size > data[best[condition]].time_s.size:
            best[condition] = i
    return sorted(best.values())


def _scan(
    layout: ParameterMap, data: Sequence[FitTrial], predictor: Predictor, theta: Floats, trial_effects: Floats
) -> list[Floats]:
    """For each exponent the best B of every vine."""
    speed = np.array([middle_speed(trial_data) for trial_data in data])
    drive = np.array([_drive(trial_data) for trial_data in data])
    free_n = [k for k, number in enumerate(layout.free) if number.key == EXPONENT]
    key = layout.keys.index(DAMPING)
    place = layout.index[:, key]
    starts = []
    for n in EXPONENTS if free_n else (_held_exponent(layout),):
        values = theta.copy()
        values[free_n] = [layout.free[k].to_scaled(n) for k in free_n]
        guess = {
            k: float(np.exp(np.mean(np.log(drive[place == k]) - n * np.log(speed[place == k]))))
            for k in np.unique(place)
        }
        best: dict[int, tuple[float, float]] = {}
        for factor in DAMPING_FACTORS:
            for k, B in guess.items():
                free = layout.free[k]
                values[k] = free.to_scaled(float(np.clip(factor * B, free.lower, free.upper)))
            try:
                _, misfit = align(data, predictor, values, trial_effects)
            except SimulationError:
                continue
            for k in guess:
                score = float(np.sum(misfit[place == k]))
                if k not in best or score < best[k][0]:
                    best[k] = (score, float(values[k]))
        values = values.copy()
        for k, (_, B) in best.items():
            values[k] = B
        starts.append(values)
    return starts


def _held_exponent(layout: ParameterMap) -> float:
    names = layout.model.parameter_names
    return float(layout.base[0, names.index(EXPONENT)]) if EXPONENT in names else 1.0


def middle_speed(trial_data: FitTrial) -> float:
    """Speed of the tail from 40 to 85 % of the growth that was seen.

    Parameters
    ----------
    trial_data : of one trial.

    Returns
    -------
    float, m/s
        Above 0.
    """
    y = trial_data.lead_position_m - trial_data.lead_position_m[: max(trial_data.n_rest, 1)].mean()
    total = float(np.max(y))
    low, high = (int(np.argmax(y >= part * total)) for part in (0.4, 0.85))
    high = max(high, low + 1) if low + 1 < y.size else low
    elapsed = trial_data.time_s[high] - trial_data.time_s[low] or trial_data.frame_s
    return max(trial_data.trial.travel_ratio * float(y[high] - y[low]) / float(elapsed), 1e-6)


def _drive(trial_data: FitTrial) -> float:
    """Force on the tip less what it takes to begin, N; what the trace says where there is one."""
    trial = trial_data.trial
    pressure_Pa = float(np.median(trial_data.trace[1])) if trial_data.trace is not None else trial.pressure_Pa
    over_Pa = pressure_Pa - np.nan_to_num(trial.yield_pressure_Pa)
    return max(float(over_Pa) * trial.area_m2, 1e-3 * abs(pressure_Pa) * trial.area_m2, 1e-9)


def align(
    data: Sequence[FitTrial], predictor: Predictor, theta: Floats, trial_effects: Floats
) -> tuple[Floats, Floats]:
    """Own numbers with the release at which each trial fits best, and the logarithm of its relative misfit.

    One trajectory a trial is simulated, at a subset of its frames, and shifted by interpolation.

    Parameters
    ----------
    data : sequence of FitTrial
    predictor : of these trials.
    theta : array, shape (n_free,)
        Free numbers, scaled.
    trial_effects : array, shape (n_trials, 4)
        Where to look from.

    Returns
    -------
    trial_effects : array, shape (n_trials, 4)
    misfit : array, shape (n_trials,)
        ln of the root mean square as part of the travel.
    """
    thin = [_thinned(trial_data) for trial_data in data]
    jobs = predictor.jobs(theta, trial_effects)
    durations = [
        trial_data.time_s[-1] - min(trial_data.time_s[0], begin) + 25 * trial_data.frame_s
        for trial_data, begin in zip(data, trial_effects[:, RELEASE], strict=True)
    ]
    grids = [np.linspace(0.0, duration, 4 * POINTS_LOOKED_AT) for duration in durations]
    moved = simulate_many(
        predictor.layout.model,
        [trial_data.trial for trial_data in data],
        grids,
        traces=[
            None if trial_data.trace is None else (trial_data.trace[0] - job.release_s, trial_data.trace[1])
            for trial_data, job in zip(data, jobs, strict=True)
        ],
        parameters=np.array([job.row for job in jobs]).reshape(len(jobs), -1),
        host=predictor.host,
    )
    best, misfit = trial_effects.copy(), np.zeros(len(data))
    for i, (trial_data, (time_s, y)) in enumerate(zip(data, thin, strict=True)):
        if trial_data.pressurised_in_recording:
            shifts = np.zeros(1)
        elif trial_data.shows_rest:
            shifts = trial_data.frame_s * np.arange(-6, 3.01, 0.5)
        else:
            shifts = -np.geomspace(0.25 * trial_data.frame_s, durations[i], 30)
        since = time_s[None, :] - trial_effects[i, RELEASE] - shifts[:, None]
        predicted = np.interp(since, grids[i], moved[i].observed_position_m)
        gap = y[None, :] - predicted
        origin = gap.mean(axis=1)
        square = np.mean((gap - origin[:, None]) ** 2, axis=1)
        k = int(np.argmin(square))
        best[i, RELEASE], best[i, ORIGIN] = trial_effects[i, RELEASE] + shifts[k], origin[k]
        misfit[i] = 0.5 * np.log(square[k] / np.ptp(y) ** 2 + 1e-8)
    return best, misfit


def _thinned(trial_data: FitTrial) -> tuple[Floats, Floats]:
    """At most sixty points, most of them in motion."""
    begin = 0 if trial_data.pressurised_in_recording else max(trial_data.n_rest - 5, 0)
    take = np.unique(np.linspace(begin, trial_data.time_s.size - 1, POINTS_LOOKED_AT).astype(int))
    return trial_data.time_s[take], trial_data.lead_position_m[take]
