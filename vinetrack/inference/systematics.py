"""Systematic errors of a campaign, as nuisance parameters of every fit, each with a normal prior.

Payloads, set pressures, gauge noise, slow errors of the tracker, the mass of the film, and an uncalibrated lens, which
displaces the leading edge by a smooth function of its position. Most are shared by several trials and do not average
out, so that neither replicates nor the scatter of trials reveal them. If neglected, they look like a small effect as
soon as pressures and B vary little between trials. About a fit, r_i = X_i Δθ + Z_i u_i + D_i s + e_i with s ~ N(0, 1)
and D_i the displacements by one standard deviation: the linear mixed model of `marginal_likelihood` with more columns.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.inference.fit_data import FitTrial
from vinetrack.inference.optimiser import Solution
from vinetrack.inference.sensitivity import ORIGIN, PRESSURE, Predictor, position_change

PRESSURE_ERROR_PA = 30.0  # Standard deviation of a set pressure in addition to that of the sheet

FILM_ERROR = 0.02  # Least standard deviation of the mass of a vine's film, relative (chosen)

# Sources of systematic errors in every fit: all but the film, which can be weighed
SOURCES = ("payloads", "set pressures", "gauge", "tracking", "lens")

# Largest number of half waves along the growth in the slow error of a tracker that all trials share (chosen)
HALF_WAVES = 6


@dataclass(frozen=True)
class Systematics:
    """Displacement of the positions of each trial by one standard deviation of each systematic error that affects it.
    `places`, shape (n_trials, n_columns), gives the error of each column, -1 for none, and `sources`, shape (count,),
    where each error comes from. Those of one trial alone, `own`, are unknowns of that trial like its effects, and are
    eliminated with them: a campaign has many of them.
    """

    columns: list[Floats]
    places: NDArray[np.int_]
    sources: Sequence[str]
    own: list[Floats]

    def beside(self, solution: Solution) -> Solution:
        """A solution with the errors as further unknowns, each with a standard normal prior and still 0: the columns of
        those of single trials come after their effects, of the others before the residual.
        """
        problem, state, n = solution.problem, solution.state, solution.problem.n_effects
        columns = tuple(
            np.column_stack([of_fit[:, :n], own, of_fit[:, n:-1], shared, of_fit[:, -1]])
            for of_fit, own, shared in zip(solution.columns, self.own, self.columns, strict=True)
        )
        count, own_errors = len(self.sources), self.own[0].shape[1]
        problem = problem.with_unknowns(self.places, np.ones(count))
        return replace(
            solution,
            problem=replace(problem, own_errors=problem.own_errors + own_errors),
            columns=columns,
            cross_products=solution.predictor.products(columns),
        ).with_state(
            theta=np.append(state.theta, np.zeros(count)),
            trial_effects=np.pad(state.trial_effects, ((0, 0), (0, own_errors))),
        )


# By index of trial: what its errors are shared by, and its displacement by each, m, shape (n_points, n_errors)
Displaced = Mapping[int, tuple[Hashable, Floats]]


def systematics_of(solution: Solution, sources: Iterable[str] = SOURCES) -> Systematics:
    """The systematic errors of a fit that come from these sources: those of every fit, and `film`."""
    functions: dict[str, Callable[[Solution], Displaced]] = {
        "payloads": _payload_errors,
        "set pressures": _set_pressure_errors,
        "film": _film_errors,
        "tracking": _tracker_errors,
        "lens": _lens_errors,
    }
    data = solution.predictor.data
    columns: list[list[Floats]] = [[np.zeros((each.time_s.size, 0))] for each in data]
    places: list[list[int]] = [[] for _ in data]
    errors: dict[tuple[str, Hashable, int], int] = {}
    for source in filter(functions.__contains__, sources):
        displaced = functions[source](solution)
        width = max((moved_m.shape[1] for _, moved_m in displaced.values()), default=0)
        for i, (nothing, *_) in enumerate(columns):
            group, moved_m = displaced.get(i, (None, nothing))
            own = [errors.setdefault((source, group, k), len(errors)) for k in range(moved_m.shape[1])]
            places[i] += own + [-1] * (width - len(own))
            columns[i].append(np.pad(moved_m, ((0, 0), (0, width - len(own)))))
    index = np.array(places, dtype=int).reshape(len(data), -1)
    alone = _gauge_errors(solution) if "gauge" in sources else [nothing for nothing, *_ in columns]
    return Systematics(list(map(np.hstack, columns)), index, [source for source, *_ in errors], alone)


def _changes_of(solution: Solution, varied: Sequence[tuple[int, FitTrial]]) -> Iterator[tuple[int, Floats]]:
    """Indices of trials as they might be, and changes of position, (n_points, 1); nothing where one cannot be
    simulated.
    """
    if not varied:
        return
    predictor = solution.predictor
    jobs = predictor.jobs(solution.state.theta, solution.state.trial_effects)
    trials = [i for i, _ in varied]
    once = list(dict.fromkeys(trials))
    other = Predictor(predictor.layout, [trial_data for _, trial_data in varied], predictor.host)
    try:
        plain = dict(zip(once, predictor.run(jobs[once]), strict=True))
        moved = other.run(replace(jobs[trials], trial=np.arange(len(varied))))
    except SimulationError:
        return
    for i, trajectory in zip(trials, moved, strict=True):
        yield i, position_change(plain[i], trajectory)[:, None]


def _payload_errors(solution: Solution) -> Displaced:
    """Relative error of each payload of the campaign. Trials with the same payload mass used the same body."""
    data = solution.predictor.data
    carried = [each.trial.payload_kg > 0 and each.trial.travel_ratio != 1 for each in data]
    bodies = [round(each.trial.payload_kg, 9) if so else None for each, so in zip(data, carried, strict=True)]
    # 1e-2, 0.5: relative step of a payload's mass for its derivative (derived), and standard deviation of the mass in
    # addition to that of the sheet, in such steps
    return _changes_by(solution, "payload_kg", 1e-2, 0.5, bodies)


def _film_errors(solution: Solution) -> Displaced:
    """Error of the film mass of each vine, `FILM_ERROR`."""
    vines = [each.trial.vine if each.trial.linear_density_kg_m > 0 else None for each in solution.predictor.data]
    return _changes_by(solution, "film_density_kg_m3", FILM_ERROR, 1.0, vines)


def _changes_by(solution: Solution, name: str, step: float, sigma: float, groups: Sequence[Hashable]) -> Displaced:
    """Displacement where a field of the sheet is larger by a relative step times `sigma`; none of a trial without
    group.
    """
    larger = [
        (i, replace(each, trial=replace(each.trial, **{name: (1 + step) * getattr(each.trial, name)})))
        for i, each in enumerate(solution.predictor.data)
        if groups[i] is not None
    ]
    return {i: (groups[i], sigma * change_m) for i, change_m in _changes_of(solution, larger)}


def _set_pressure_errors(solution: Solution) -> Displaced:
    """Error of the set pressure of each condition, shared by its replicates."""
    varies = solution.predictor.has_pressure_deviation
    return {
        i: (each.trial.condition, PRESSURE_ERROR_PA / each.trial.pressure_Pa * solution.columns[i][:, [PRESSURE]])
        for i, each in enumerate(solution.predictor.data)
        if varies[i] and each.trace is None
    }


def _gauge_errors(solution: Solution) -> list[Floats]:
    """Displacement by the errors that gauge noise leaves in each recorded pressure, but that of its mean, which is part
    of the fit: (n_points, n_errors), the same number for every trial.
    """
    misread = [
        (i, replace(each, trace=(each.trace[0], each.trace[1] + error_Pa)))
        for i, each in enumerate(solution.predictor.data)
        if each.trace is not None and each.trace_errors_Pa is not None
        for error_Pa in each.trace_errors_Pa.T
    ]
    of_trial = [[np.zeros((each.time_s.size, 0))] for each in solution.predictor.data]
    for i, change_m in _changes_of(solution, misread):
        of_trial[i].append(change_m)
    width = max(map(len, of_trial))
    return [np.pad(np.hstack(moved_m), ((0, 0), (0, width - len(moved_m)))) for moved_m in of_trial]


def _tracker_errors(solution: Solution) -> Displaced:
    """Slow errors of positions from recordings, of the size that the tracks state; none for imported positions."""
    grown = grown_in(solution)
    # With extreme parameters no trial moves, and all growth fractions are zero.
    largest_growth_m = max(float(np.max(growth_m)) for growth_m in grown) or 1.0
    return {
        i: ("", _slow_shapes(growth_m / largest_growth_m, each.slow_m))
        for i, (growth_m, each) in enumerate(zip(grown, solution.predictor.data, strict=True))
        if each.slow_m is not None
    }


def _slow_shapes(part: Floats, slow_m: Floats) -> Floats:
    """One standard deviation of each slow error of a trial, shape (n_points, HALF_WAVES + 5), m. Waves along the growth
    have the usual error of the trial each. What is stated beyond that, near a door or at low contrast, is one error at
    the very start and one after it; one is of the tip at rest, before background that no frame shows; two grow towards
    the end.
    """
    usual = np.minimum(slow_m, np.median(slow_m))
    excess = np.sqrt(np.maximum(slow_m**2 - usual**2, 0.0))
    waves = usual[:, None] * np.cos(np.pi * part[:, None] * np.arange(1, HALF_WAVES + 1))
    # 0.015, 0.002: fractions of the growth over which a slow error that is larger at the start, and the error at rest,
    # may decay: a door, and the blur of the edge (chosen)
    start, rest = (np.exp(-np.maximum(part, 0.0) / fraction) for fraction in (0.015, 0.002))
    # 0.1, 0.03: fractions of the growth before its end (measured)
    before_end = part - np.max(part)
    ends = [2.0 * usual * np.exp(before_end / 0.1), 4.0 * usual * np.exp(before_end / 0.03)]
    return np.column_stack([waves, excess * start, excess * (1 - start), slow_m * rest, *ends])


def _lens_errors(solution: Solution) -> Displaced:
    """Displacement by a lens, of all trials alike."""
    return {i: ("", shapes) for i, shapes in enumerate(position_shapes(solution.predictor, grown_in(solution)))}


def position_shapes(predictor: Predictor, grown_m: Sequence[Floats]) -> list[Floats]:
    """Displacement by one standard deviation of each shape, m, for every trial. The polynomials span the growth of all
    trials, since one camera records them. Shapes: grown_m (n_points,) → (n_points, n_shapes).
    """
    orders, select = np.arange(1, 5), np.eye(5)[1:].T  # Legendre orders of the shapes
    sigma_m = [trial_data.position_systematic_m for trial_data in predictor.data]
    if not max(sigma_m) > 0:
        return [np.zeros((growth_m.size, 0)) for growth_m in grown_m]
    # Without any growth the shapes are zero, since their value at rest is subtracted.
    # 1e-9: growth that counts as none (derived)
    reach = max(1e-9, *(float(np.max(growth_m)) for growth_m in grown_m))
    # P_l(−1) = (−1)^l: an error of the position at rest is the origin's, which is free.
    return [
        sigma * (np.polynomial.legendre.legval(2 * np.clip(growth_m / reach, 0, 1) - 1, select).T - (-1.0) ** orders)
        for growth_m, sigma in zip(grown_m, sigma_m, strict=True)
    ]


def grown_in(solution: Solution) -> list[Floats]:
    """Growth of each trial by a fit, m, shape (n_points,)."""
    of_trials = zip(solution.predictor.data, solution.state.trial_effects[:, ORIGIN], solution.columns, strict=True)
    return [trial_data.lead_position_m - origin_m - columns[:, -1] for trial_data, origin_m, columns in of_trials]
