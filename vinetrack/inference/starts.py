"""Starting values of a fit: release and origin from the frames at rest, B and n from a coarse grid search."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.dynamics.simulate import SimulationError, simulate_many
from vinetrack.inference.fit_data import FitTrial
from vinetrack.inference.parameters import DAMPING, EXPONENT, ParameterMap
from vinetrack.inference.sensitivity import N_TRIAL_EFFECTS, ORIGIN, RELEASE, Predictor

EXPONENTS = (0.15, 0.37, 0.65, 1.0)  # Exponents of the grid (chosen)

# Factors of the grid, relative to the B that would balance the drive at the observed speed (chosen)
DAMPING_FACTORS = (0.2, 0.4, 0.6, 0.8, 0.95, 1.1)

POINTS_USED = 60  # Points of each trial that the grid search uses (chosen)


def initial_trial_effects(data: Sequence[FitTrial]) -> Floats:
    """Release and origin of every trial from its frames at rest; zero deviations. Shape (n_trials, 4)."""
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
    """Starting values, best first: misfit, scaled parameters and trial effects. For each exponent and each further
    starting value, every vine takes the B with the least misfit of its trials; the release of each trial is scanned at
    the same time.
    """
    trial_effects = initial_trial_effects(data)
    start_values = [
        sorted({number.start, *number.further_starts}) if number.further_starts else [number.start]
        for number in layout.free
    ]
    combined = list(itertools.islice(itertools.product(*start_values), 12))
    starts_found: list[tuple[Floats, Floats]] = []
    for values in combined:
        theta = np.array([number.to_scaled(value) for value, number in zip(values, layout.free, strict=True)])
        starts = _scan_damping(layout, data, predictor, theta, trial_effects) if DAMPING in layout.keys else [theta]
        starts_found += [(start, trial_effects) for start in starts]
    scored = []
    for theta, initial in starts_found:
        try:
            releases, misfit = align(data, predictor, theta, initial)
        except SimulationError:
            continue
        scored.append((float(np.sum(misfit)), theta, releases))
    return sorted(scored, key=lambda scored_start: scored_start[0])


def one_trial_per_condition(data: Sequence[FitTrial]) -> list[int]:
    """Indices of one trial of every condition, the one with the most points."""
    best: dict[str, int] = {}
    for i, trial_data in enumerate(data):
        condition = trial_data.trial.condition
        if condition not in best or trial_data.time_s.size > data[best[condition]].time_s.size:
            best[condition] = i
    return sorted(best.values())


def _scan_damping(
    layout: ParameterMap, data: Sequence[FitTrial], predictor: Predictor, theta: Floats, trial_effects: Floats
) -> list[Floats]:
    """For each exponent the best B of every vine."""
    speed = np.array([middle_speed(trial_data) for trial_data in data])
    drive = np.array([_driving_force_N(trial_data) for trial_data in data])
    free_n = [k for k, number in enumerate(layout.free) if number.key == EXPONENT]
    key = layout.keys.index(DAMPING)
    damping_index = layout.index[:, key]
    starts = []
    for n in EXPONENTS if free_n else (_fixed_exponent(layout),):
        values = theta.copy()
        values[free_n] = [layout.free[k].to_scaled(n) for k in free_n]
        guess = {
            k: float(np.exp(np.mean(np.log(drive[damping_index == k]) - n * np.log(speed[damping_index == k]))))
            for k in np.unique(damping_index)
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
                score = float(np.sum(misfit[damping_index == k]))
                if k not in best or score < best[k][0]:
                    best[k] = (score, float(values[k]))
        values = values.copy()
        for k, (_, B) in best.items():
            values[k] = B
        starts.append(values)
    return starts


def _fixed_exponent(layout: ParameterMap) -> float:
    names = layout.model.parameter_names
    return float(layout.base[0, names.index(EXPONENT)]) if EXPONENT in names else 1.0


def middle_speed(trial_data: FitTrial) -> float:
    """Mean speed of the tail from 40 to 85 % of the observed growth. Returns above 0."""
    y = trial_data.lead_position_m - trial_data.lead_position_m[: max(trial_data.n_rest, 1)].mean()
    total = float(np.max(y))
    low, high = (int(np.argmax(y >= part * total)) for part in (0.4, 0.85))
    high = max(high, low + 1) if low + 1 < y.size else low
    elapsed = trial_data.time_s[high] - trial_data.time_s[low] or trial_data.frame_s
    return max(trial_data.trial.travel_ratio * float(y[high] - y[low]) / float(elapsed), 1e-6)


def _driving_force_N(trial_data: FitTrial) -> float:
    """Force on the tip above the yield force, N, from the recorded pressure where there is one."""
    trial = trial_data.trial
    pressure_Pa = float(np.median(trial_data.trace[1])) if trial_data.trace is not None else trial.pressure_Pa
    over_Pa = pressure_Pa - np.nan_to_num(trial.yield_pressure_Pa)
    return max(float(over_Pa) * trial.area_m2, 1e-3 * abs(pressure_Pa) * trial.area_m2, 1e-9)


def align(
    data: Sequence[FitTrial], predictor: Predictor, theta: Floats, trial_effects: Floats
) -> tuple[Floats, Floats]:
    """Best release and origin of each trial at given parameters, by a scan, and the logarithm of its relative misfit.
    One trajectory per trial is simulated, at a subset of its frames, and shifted in time by interpolation. Returns
    trial_effects, misfit (ln of the root mean square relative to the travel). Shapes: theta (n_free,); trial_effects
    (n_trials, 4) → (n_trials, 4).
    """
    subsets = [_thinned(trial_data) for trial_data in data]
    jobs = predictor.jobs(theta, trial_effects)
    durations = [
        trial_data.time_s[-1] - min(trial_data.time_s[0], begin) + 25 * trial_data.frame_s
        for trial_data, begin in zip(data, trial_effects[:, RELEASE], strict=True)
    ]
    grids = [np.linspace(0.0, duration, 4 * POINTS_USED) for duration in durations]
    trajectories = simulate_many(
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
    for i, (trial_data, (time_s, y)) in enumerate(zip(data, subsets, strict=True)):
        if trial_data.pressurised_in_recording:
            shifts = np.zeros(1)
        elif trial_data.shows_rest:
            shifts = trial_data.frame_s * np.arange(-6, 3.01, 0.5)
        else:
            shifts = -np.geomspace(0.25 * trial_data.frame_s, durations[i], 30)
        since = time_s[None, :] - trial_effects[i, RELEASE] - shifts[:, None]
        predicted = np.interp(since, grids[i], trajectories[i].observed_position_m)
        residual_m = y[None, :] - predicted
        origin = residual_m.mean(axis=1)
        square = np.mean((residual_m - origin[:, None]) ** 2, axis=1)
        k = int(np.argmin(square))
        best[i, RELEASE], best[i, ORIGIN] = trial_effects[i, RELEASE] + shifts[k], origin[k]
        misfit[i] = 0.5 * np.log(square[k] / np.ptp(y) ** 2 + 1e-8)
    return best, misfit


def _thinned(trial_data: FitTrial) -> tuple[Floats, Floats]:
    """At most sixty points, most of them in motion."""
    begin = 0 if trial_data.pressurised_in_recording else max(trial_data.n_rest - 5, 0)
    take = np.unique(np.linspace(begin, trial_data.time_s.size - 1, POINTS_USED).astype(int))
    return trial_data.time_s[take], trial_data.lead_position_m[take]
