"""Where a fit begins: release and origin from the rest frames, B and n from a coarse look at all trajectories."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.dynamics.simulate import SimulationError, simulate_many
from vinetrack.inference.fit_data import FitTrial
from vinetrack.inference.parameters import DAMPING, EXPONENT, ParameterMap
from vinetrack.inference.sensitivity import ORIGIN, OWN, RELEASE, Predictor

EXPONENTS = (0.15, 0.37, 0.65, 1.0)
"""Exponents tried. Chosen around the published 0.37, from nearly constant friction to linear damping."""

DAMPING_FACTORS = (0.2, 0.4, 0.6, 0.8, 0.95, 1.1)
"""Tried against the B that would hold the speed reached; a vine that still accelerates has less. Chosen: the coarse
grid only has to come within a factor of two."""

POINTS_LOOKED_AT = 60
"""Points of a trial that the coarse search looks at. Chosen for time."""


def initial_trial_effects(data: Sequence[FitTrial]) -> Floats:
    """Release and origin of every trial from its rest frames, shape (n_trials, 4); deviations 0."""
    own = np.zeros((len(data), OWN))
    for i, item in enumerate(data):
        if item.n_rest > 0:
            own[i, RELEASE] = item.time_s[item.n_rest - 1]
            own[i, ORIGIN] = np.mean(item.lead_position_m[: max(item.n_rest - 1, 1)])
        elif item.vague_rest is not None:
            own[i, RELEASE], own[i, ORIGIN] = item.vague_rest.release_s, item.vague_rest.origin_m
        else:
            own[i, RELEASE], own[i, ORIGIN] = item.time_s[0], item.lead_position_m[0]
        if item.let_in:
            assert item.trace is not None
            own[i, RELEASE] = min(item.time_s[0], item.trace[0][0])
    return own


def candidates(
    layout: ParameterMap, data: Sequence[FitTrial], predictor: Predictor
) -> list[tuple[float, Floats, Floats]]:
    """Starting points, best first: misfit, scaled values and own numbers of the trials.

    For each exponent, and each further value worth a try, every vine takes the B that misses its trials least; the
    release of each trial is scanned along.
    """
    own = initial_trial_effects(data)
    tries = [sorted({number.start, *number.tries}) if number.tries else [number.start] for number in layout.free]
    combined = list(itertools.islice(itertools.product(*tries), 12))
    found: list[tuple[Floats, Floats]] = []
    for values in combined:
        theta = np.array([number.inside(value) for value, number in zip(values, layout.free, strict=True)])
        starts = _scan(layout, data, predictor, theta, own) if DAMPING in layout.keys else [theta]
        found += [(start, own) for start in starts]
    scored = []
    for theta, begin in found:
        try:
            releases, misfit = align(data, predictor, theta, begin)
        except SimulationError:
            continue
        scored.append((float(np.sum(misfit)), theta, releases))
    return sorted(scored, key=lambda one: one[0])


def one_of_each_condition(data: Sequence[FitTrial]) -> list[int]:
    """Places of one trial of every condition, the one with the most points."""
    best: dict[str, int] = {}
    for i, item in enumerate(data):
        condition = item.trial.condition
        if condition not in best or item.time_s.size > data[best[condition]].time_s.size:
            best[condition] = i
    return sorted(best.values())


def _scan(
    layout: ParameterMap, data: Sequence[FitTrial], predictor: Predictor, theta: Floats, own: Floats
) -> list[Floats]:
    """For each exponent the best B of every vine."""
    speed = np.array([_speed(item) for item in data])
    drive = np.array([_drive(item) for item in data])
    free_n = [k for k, number in enumerate(layout.free) if number.key == EXPONENT]
    key = layout.keys.index(DAMPING)
    place = layout.index[:, key]
    found = []
    for n in EXPONENTS if free_n else (_held_exponent(layout),):
        values = theta.copy()
        values[free_n] = [layout.free[k].inside(n) for k in free_n]
        guess = {
            k: float(np.exp(np.mean(np.log(drive[place == k]) - n * np.log(speed[place == k]))))
            for k in np.unique(place)
        }
        best: dict[int, tuple[float, float]] = {}
        for factor in DAMPING_FACTORS:
            for k, B in guess.items():
                free = layout.free[k]
                values[k] = free.inside(float(np.clip(factor * B, free.lower, free.upper)))
            try:
                _, misfit = align(data, predictor, values, own)
            except SimulationError:
                continue
            for k in guess:
                score = float(np.sum(misfit[place == k]))
                if k not in best or score < best[k][0]:
                    best[k] = (score, float(values[k]))
        values = values.copy()
        for k, (_, B) in best.items():
            values[k] = B
        found.append(values)
    return found


def _held_exponent(layout: ParameterMap) -> float:
    names = layout.model.parameter_names
    return float(layout.base[0, names.index(EXPONENT)]) if EXPONENT in names else 1.0


def _speed(item: FitTrial) -> float:
    """Tail speed in the last part of the motion, m/s."""
    y = item.lead_position_m - item.lead_position_m[: max(item.n_rest, 1)].mean()
    total = float(np.max(y))
    low, high = (int(np.argmax(y >= part * total)) for part in (0.4, 0.85))
    high = max(high, low + 1) if low + 1 < y.size else low
    elapsed = item.time_s[high] - item.time_s[low] or item.frame_s
    return max(item.trial.travel_ratio * float(y[high] - y[low]) / float(elapsed), 1e-6)


def _drive(item: FitTrial) -> float:
    """Force on the tip less what it takes to begin, N; what the trace says where there is one."""
    trial = item.trial
    pressure_Pa = float(np.median(item.trace[1])) if item.trace is not None else trial.pressure_Pa
    over_Pa = pressure_Pa - np.nan_to_num(trial.yield_pressure_Pa)
    return max(float(over_Pa) * trial.area_m2, 1e-3 * abs(pressure_Pa) * trial.area_m2, 1e-9)


def align(data: Sequence[FitTrial], predictor: Predictor, theta: Floats, own: Floats) -> tuple[Floats, Floats]:
    """Own numbers with the release at which each trial fits best, and the logarithm of its relative misfit.

    One trajectory a trial is simulated, at a subset of its frames, and shifted by interpolation.
    """
    thin = [_thinned(item) for item in data]
    jobs = predictor.jobs(theta, own)
    durations = [
        item.time_s[-1] - min(item.time_s[0], begin) + 25 * item.frame_s
        for item, begin in zip(data, own[:, RELEASE], strict=True)
    ]
    grids = [np.linspace(0.0, duration, 4 * POINTS_LOOKED_AT) for duration in durations]
    moved = simulate_many(
        predictor.layout.model,
        [item.trial for item in data],
        grids,
        traces=[
            None if item.trace is None else (item.trace[0] - job.release_s, item.trace[1])
            for item, job in zip(data, jobs, strict=True)
        ],
        parameters=np.array([job.row for job in jobs]).reshape(len(jobs), -1),
        host=predictor.host,
    )
    best, misfit = own.copy(), np.zeros(len(data))
    for i, (item, (time_s, y)) in enumerate(zip(data, thin, strict=True)):
        if item.let_in:
            shifts = np.zeros(1)
        elif item.shows_rest:
            shifts = item.frame_s * np.arange(-6, 3.01, 0.5)
        else:
            shifts = -np.geomspace(0.25 * item.frame_s, durations[i], 30)
        since = time_s[None, :] - own[i, RELEASE] - shifts[:, None]
        predicted = np.interp(since, grids[i], moved[i].observed_position_m)
        gap = y[None, :] - predicted
        origin = gap.mean(axis=1)
        square = np.mean((gap - origin[:, None]) ** 2, axis=1)
        k = int(np.argmin(square))
        best[i, RELEASE], best[i, ORIGIN] = own[i, RELEASE] + shifts[k], origin[k]
        misfit[i] = 0.5 * np.log(square[k] / np.ptp(y) ** 2 + 1e-8)
    return best, misfit


def _thinned(item: FitTrial) -> tuple[Floats, Floats]:
    """At most sixty points, most of them in motion."""
    begin = 0 if item.let_in else max(item.n_rest - 5, 0)
    take = np.unique(np.linspace(begin, item.time_s.size - 1, POINTS_LOOKED_AT).astype(int))
    return item.time_s[take], item.lead_position_m[take]
