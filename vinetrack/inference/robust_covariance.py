"""Robust covariance of the parameters of a fit, from the scatter of trials and from shared systematic errors.

The inverse information is the covariance only if noise and between-trial variation are as modelled. The scatter of the
scores of single trials gives a cluster-robust (sandwich) covariance (White, Econometrica 48, 817, 1980, with trials as
clusters). Errors that trials share (systematics, below) move parameters without any scatter. Both only
ever widen an error.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats, Trial
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.experiment.schema import GROUPINGS
from vinetrack.inference.fit_data import FitTrial
from vinetrack.inference.marginal_likelihood import MixedProblem, inverse_of_block, matrix_root
from vinetrack.inference.optimiser import Solution
from vinetrack.inference.position_errors import (
    Pooled,
    Precision,
    grown_in,
    position_shapes,
    trial_information,
    with_shapes,
)
from vinetrack.inference.sensitivity import PRESSURE, Predictor, position_change

# ------------------------------------------------------------------------------
# Systematic errors of a campaign: payloads, set pressures, film mass, position errors of the camera, gauge noise.
#
# Most of them are shared by several trials and do not average out, so that the scatter of trials does not reveal
# them. If neglected, they look like a small effect as soon as pressures and B vary little between trials. The error
# that gauge noise leaves in a recorded pressure belongs to a single trial and bends its whole motion.


PRESSURE_ERROR_PA = 30.0  # Standard deviation of a set pressure in addition to that of the sheet

FILM_ERROR = 0.02  # Least standard deviation of the mass of a vine's film, relative (chosen)


# Sources of systematic errors in every fit: all but the film, which can be weighed
SOURCES = ("payloads", "set pressures", "gauge", "tracking", "lens")

# Largest number of half waves along the growth in the slow error of a tracker that all trials share (chosen)
HALF_WAVES = 6


@dataclass(frozen=True)
class Systematics:
    """Displacement of the positions of each trial by one standard deviation of each systematic error. An error of one
    payload or of one set pressure affects its own trials alone, and there are as many as conditions: a trial has
    columns only for those that affect it. `places`, shape (n_trials, n_columns), gives the error of each column, -1 for
    none, and `sources`, shape (count,), where each error comes from. `estimated_m` is the displacement by the errors
    that the fit has estimated and taken out.
    """

    columns: list[Floats]
    places: NDArray[np.int_]
    sources: Sequence[str]
    estimated_m: list[Floats]

    @property
    def count(self) -> int:
        """Number of errors."""
        return len(self.sources)

    def at_zero_errors(self, columns: Sequence[Floats]) -> list[Floats]:
        """Columns of a fit with the residual, the last column, taken at zero errors instead of the estimated ones.
        Shapes: columns (n_points, k).
        """
        restored = [of_fit.copy() for of_fit in columns]
        for of_fit, trial_estimate_m in zip(restored, self.estimated_m, strict=True):
            of_fit[:, -1] += trial_estimate_m
        return restored

    def added_to(self, columns: Sequence[Floats], problem: MixedProblem) -> tuple[list[Floats], MixedProblem]:
        """Columns and problem of a fit with the errors as further parameters, each with a standard normal prior; the
        residual is that at zero errors. Shapes: columns (n_points, k) → (n_points, k + n_columns).
        """
        extended = [
            np.column_stack([of_fit[:, :-1], systematic, of_fit[:, -1]])
            for of_fit, systematic in zip(self.at_zero_errors(columns), self.columns, strict=True)
        ]
        places = np.where(self.places >= 0, problem.prior_mean.size + self.places, -1)
        widened = with_shapes(problem, self.count)
        return extended, replace(widened, index=np.column_stack([problem.index, places]))


# By index of trial: what its errors are shared by, and its displacement by each, m, shape (n_points, n_errors)
Displaced = Mapping[int, tuple[Hashable, Floats]]


def systematics_of(predictor: Predictor, solution: Solution, sources: Iterable[str] = SOURCES) -> Systematics:
    """The systematic errors of a fit that come from these sources: those of every fit, and `film`."""
    functions: dict[str, Callable[[Predictor, Solution], Displaced]] = {
        "payloads": _payload_errors,
        "set pressures": _set_pressure_errors,
        "gauge": _gauge_errors,
        "film": _film_errors,
        "tracking": _tracker_errors,
        "lens": _lens_errors,
    }
    data = predictor.data
    columns: list[list[Floats]] = [[np.zeros((each.time_s.size, 0))] for each in data]
    places: list[list[int]] = [[] for _ in data]
    estimated_m = [np.zeros(each.time_s.size) for each in data]
    errors: dict[tuple[str, Hashable, int], int] = {}
    for source in sources:
        displaced = functions[source](predictor, solution)
        width = max((moved_m.shape[1] for _, moved_m in displaced.values()), default=0)
        for i, (trial_data, (nothing, *_)) in enumerate(zip(data, columns, strict=True)):
            group, moved_m = displaced.get(i, (None, nothing))
            own = [errors.setdefault((source, group, k), len(errors)) for k in range(moved_m.shape[1])]
            places[i] += own + [-1] * (width - len(own))
            columns[i].append(np.pad(moved_m, ((0, 0), (0, width - len(own)))))
            if source == "gauge" and own and trial_data.trace_error_sizes is not None:
                estimated_m[i] = moved_m @ trial_data.trace_error_sizes
    index = np.array(places, dtype=int).reshape(len(data), -1)
    return Systematics(list(map(np.hstack, columns)), index, [source for source, *_ in errors], estimated_m)


def _changes_of(
    predictor: Predictor, solution: Solution, varied: Sequence[tuple[int, FitTrial]]
) -> Iterator[tuple[int, Floats]]:
    """Indices of trials, each as it is or as it might be, and the change of their positions, m, shape (n_points, 1);
    nothing where one cannot be simulated.
    """
    if not varied:
        return
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


def _payload_errors(predictor: Predictor, solution: Solution) -> Displaced:
    """Relative error of each payload of the campaign. Trials with the same payload mass used the same body."""
    payload_step = 1e-2  # Relative step of a payload's mass for its derivative (derived)
    heavier = [
        (i, replace(each, trial=replace(each.trial, payload_kg=(1 + payload_step) * each.trial.payload_kg)))
        for i, each in enumerate(predictor.data)
        if each.trial.payload_kg > 0 and each.trial.travel_ratio != 1
    ]
    # 0.005: standard deviation of a payload's mass in addition to that of the sheet, relative
    return {
        i: (round(predictor.data[i].trial.payload_kg, 9), 0.005 / payload_step * change_m)
        for i, change_m in _changes_of(predictor, solution, heavier)
    }


def _film_errors(predictor: Predictor, solution: Solution) -> Displaced:
    """Error of the film mass of each vine, `FILM_ERROR`."""
    heavier = [
        (
            i,
            replace(
                each, trial=replace(each.trial, film_density_kg_m3=(1 + FILM_ERROR) * each.trial.film_density_kg_m3)
            ),
        )
        for i, each in enumerate(predictor.data)
        if each.trial.linear_density_kg_m > 0
    ]
    return {i: (predictor.data[i].trial.vine, change_m) for i, change_m in _changes_of(predictor, solution, heavier)}


def _set_pressure_errors(predictor: Predictor, solution: Solution) -> Displaced:
    """Error of the set pressure of each condition, shared by its replicates."""
    return {
        i: (each.trial.condition, PRESSURE_ERROR_PA / each.trial.pressure_Pa * solution.columns[i][:, [PRESSURE]])
        for i, each in enumerate(predictor.data)
        if predictor.has_pressure_deviation[i] and each.trace is None
    }


def _gauge_errors(predictor: Predictor, solution: Solution) -> Displaced:
    """Errors that gauge noise leaves in each recorded pressure, except that of its mean, which is part of the fit."""
    misread = [
        (i, replace(each, trace=(each.trace[0], each.trace[1] + error_Pa)))
        for i, each in enumerate(predictor.data)
        if each.trace is not None and each.trace_errors_Pa is not None
        for error_Pa in each.trace_errors_Pa.T
    ]
    of_trial: dict[int, list[Floats]] = {}
    for i, change_m in _changes_of(predictor, solution, misread):
        of_trial.setdefault(i, []).append(change_m)
    return {i: (i, np.hstack(changes_m)) for i, changes_m in of_trial.items()}


def _lens_errors(predictor: Predictor, solution: Solution) -> Displaced:
    """Smooth errors of position that all trials of a camera share."""
    return {i: ("", shapes) for i, shapes in enumerate(position_shapes(predictor, grown_in(predictor, solution)))}


def _tracker_errors(predictor: Predictor, solution: Solution) -> Displaced:
    """Slow errors of positions from recordings, of the size that the tracks state; none for imported positions."""
    grown = grown_in(predictor, solution)
    # With extreme parameters no trial moves, and all growth fractions are zero.
    largest_growth_m = max(float(np.max(growth_m)) for growth_m in grown) or 1.0
    return {
        i: ("", _slow_shapes(growth_m / largest_growth_m, each.slow_m))
        for i, (growth_m, each) in enumerate(zip(grown, predictor.data, strict=True))
        if each.slow_m is not None
    }


def _slow_shapes(part: Floats, slow_m: Floats) -> Floats:
    """One standard deviation of each slow error of a trial, shape (n_points, HALF_WAVES + 4), m. Waves along the growth
    have the usual error of the trial each. What is stated beyond that, near a door or at low contrast, is one error at
    the very start and one after it; two more grow towards the end.
    """
    end_shapes = ((0.1, 2.0), (0.03, 4.0))  # Fractions of the growth before its end (measured)
    usual = np.minimum(slow_m, np.median(slow_m))
    excess = np.sqrt(np.maximum(slow_m**2 - usual**2, 0.0))
    waves = usual[:, None] * np.cos(np.pi * part[:, None] * np.arange(1, HALF_WAVES + 1))
    # 0.015: fraction of the growth over which a slow error that is larger at the start may decay (chosen)
    start = np.exp(-np.maximum(part, 0.0) / 0.015)
    ends = [times * usual * np.exp((part - np.max(part)) / fraction) for fraction, times in end_shapes]
    return np.column_stack([waves, excess * start, excess * (1 - start), *ends])


FEWEST_CLUSTERS = 8  # Trials from which the sandwich is better than the model of the noise (chosen)

FEWEST_DEGREES = 4  # Trials beyond the number of parameters that a sandwich needs (chosen)


def cluster_variance(single: Floats, fitted: int, groups: Sequence[str]) -> Floats:
    """Variance of sums over trials, from the scatter of single trials or, where that is larger, of their clusters
    (`coarsest_groups`); 0 where trials are too few. Shapes: single (n_trials, n) → (n,).
    """
    trials = len(single)
    if trials < FEWEST_CLUSTERS:
        return np.zeros(single.shape[1])
    single = single - single.mean(axis=0)
    return np.max([np.diag(group_scatter(single, each, fitted)) for each in (range(trials), groups)], axis=0)


def too_few_clusters(predictor: Predictor, solution: Solution) -> bool:
    """Whether there are too few trials for a sandwich covariance."""
    spare = len(predictor.data) - np.count_nonzero(solution.problem.free)
    return len(predictor.data) < FEWEST_CLUSTERS or bool(spare < FEWEST_DEGREES)


def widened_covariance(
    predictor: Predictor,
    solution: Solution,
    model_precision: Precision,
    extended: Solution | None = None,
    pooled: Pooled | None = None,
) -> Precision:
    """Covariance and degrees of freedom at the end of a fit, widened by the scatter of trials and by
    systematic errors.
    """
    # The lens is among the parameters of the extended solution.
    systematics = systematics_of(predictor, solution, SOURCES[: None if extended is None else -1])
    plain, robust = robust_covariance(predictor, extended or solution)
    moved = moved_by(predictor, extended or solution, systematics, plain)
    at_most, trials = model_precision.degrees, len(predictor.data)
    spare = trials - int(np.count_nonzero(np.diag(plain) > 0))
    if pooled is None and trials >= FEWEST_CLUSTERS and spare >= FEWEST_DEGREES:
        variance = np.diag(robust)
        clusters = len(set(coarsest_groups([trial_data.trial for trial_data in predictor.data])))
        few = np.full(variance.size, float(min(spare, clusters - 1)))
    elif pooled is None:
        variance, few = _few_trial_variances(*trial_information(extended or solution), extended or solution, plain)
    else:
        plain = pooled.covariance
        variance, few = _few_trial_variances(pooled.information, pooled.scores, extended or solution, plain)
        at_most = np.where(np.diag(pooled.between) > 0, np.minimum(at_most, few), at_most)
    diagonal = np.diag(plain)
    ratio = np.sqrt(np.maximum(np.divide(variance, diagonal, out=np.ones_like(diagonal), where=diagonal > 0), 1.0))
    degrees = np.where(ratio > 1, np.minimum(at_most, few), at_most)
    covariance = (
        np.where(np.isfinite(model_precision.covariance), model_precision.covariance, 0.0) * ratio[:, None] * ratio
        + moved @ moved.T
    )
    unknown = np.flatnonzero(~np.isfinite(np.diag(model_precision.covariance)))
    covariance[unknown, unknown] = np.inf
    source_of = np.array(systematics.sources)
    shared = {name: np.sum(moved[:, source_of == name] ** 2, axis=1) for name in dict.fromkeys(systematics.sources)}
    if extended is not None:
        # What the parameters would be known better by if the errors of the lens, the last unknowns, were known.
        first = solution.problem.prior_mean.size
        across = plain[:first, first:] @ np.linalg.pinv(plain[first:, first:], hermitian=True)
        lens = np.sum(across * plain[:first, first:], axis=1) * ratio[:first] ** 2
        shared["lens"] = np.append(lens, np.zeros(len(plain) - first))
    return replace(model_precision, covariance=covariance, degrees=degrees, shared=shared)


def _few_trial_variances(
    information: Floats, scores: Floats, solution: Solution, plain: Floats
) -> tuple[Floats, Floats]:
    """Variances of the free parameters from the disagreement of few trials, without bias, and their degrees of freedom.
    Each trial pulls the fit towards itself, by its share K_i of the information, and so shows less than its error: in
    units of the errors of the model its score has the variance K_i(1 − K_i), and is divided by √(1 − K_i) (CR2: Bell &
    McCaffrey, Survey Methodology 28, 169, 2002). Returns variance, degrees : arrays, shape (n_free,), of scaled
    parameters. Shapes: plain (n_free, n_free).
    """
    variance, degrees = np.diag(plain).copy(), np.full(len(plain), np.inf)
    estimated = np.flatnonzero(np.diag(plain) > 0)
    if not estimated.size or len(scores) < 2:
        return variance, degrees
    root = matrix_root(plain[np.ix_(estimated, estimated)])
    score = (scores - scores.mean(axis=0))[:, estimated] @ root
    shares, adjustments = [], []
    constant = root.T @ np.diag(solution.problem.prior_precision[estimated]) @ root
    for single in information:
        share = root.T @ single[np.ix_(estimated, estimated)] @ root
        values, vectors = np.linalg.eigh(share)
        # 0.99: share of the information on a direction from which one trial is practically the only one to
        # determine it (chosen)
        below_limit = values < 0.99
        adjustments.append(
            (vectors[:, below_limit] / np.sqrt(1 - np.maximum(values[below_limit], 0.0))) @ vectors[:, below_limit].T
        )
        constant = constant + (vectors[:, ~below_limit] * values[~below_limit]) @ vectors[:, ~below_limit].T
        shares.append(share)
    for k, place in enumerate(estimated.tolist()):
        weights_of_score = np.array([adjustment @ root[k] for adjustment in adjustments])
        scatter = float(np.sum(np.einsum("nk,nk->n", weights_of_score, score) ** 2))
        moved = np.einsum("nij,nj->ni", np.array(shares), weights_of_score)
        expected = np.diag(np.einsum("ni,ni->n", weights_of_score, moved)) - moved @ moved.T
        squares = float(np.sum(expected**2))
        variance[place] = scatter + float(root[k] @ constant @ root[k])
        if squares > 0 and scatter > 0:
            degrees[place] = max(np.trace(expected) ** 2 / squares * (variance[place] / scatter) ** 2, 1.0)
    return variance, degrees


def robust_covariance(predictor: Predictor, solution: Solution) -> tuple[Floats, Floats]:
    """Covariance of the free parameters by the noise model, and cluster-robust, from the scatter of trials, shape
    (n_free, n_free) each. Parameters at a bound are fixed there.
    """
    problem, theta = solution.problem, solution.state.theta
    information, scores = trial_information(solution)
    square = information.sum(axis=0) + np.diag(problem.prior_precision)
    inside = (theta > problem.lower) & (theta < problem.upper)
    estimated = np.flatnonzero(problem.free & inside & (np.diag(square) > 0))
    plain = inverse_of_block(square, estimated)
    # Scores of a parameter add up to the pull of its prior, in equal parts from each trial that depends on it.
    depend = (problem.index[:, :, None] == np.arange(len(theta))).any(axis=1)
    scores -= depend * (scores.sum(axis=0) / np.maximum(depend.sum(axis=0), 1))
    # The prior does not scatter from trial to trial, but its uncertainty contributes as well.
    prior = np.diag(problem.prior_precision)
    groups = coarsest_groups([trial_data.trial for trial_data in predictor.data])
    meats = [group_scatter(scores, each, estimated.size) + prior for each in (range(len(scores)), groups)]
    robust, by_group = (plain @ meat @ plain for meat in meats)
    np.fill_diagonal(robust, np.maximum(np.diag(robust), np.diag(by_group)))
    return plain, robust


def moved_by(predictor: Predictor, solution: Solution, systematics: Systematics, plain: Floats) -> Floats:
    """Change of each free parameter by one standard deviation of each systematic error, to first order. Shapes: plain
    (n_free, n_free) → (n_free, count).
    """
    columns, widened = systematics.added_to(solution.columns, solution.problem)
    both = replace(solution, problem=widened, cross_products=predictor.products(columns))
    return np.asarray(plain @ trial_information(both)[0].sum(axis=0)[: len(plain), len(plain) :])


def coarsest_groups(trials: Sequence[Trial]) -> list[str]:
    """The clusters of trials whose errors may be correlated: specimens, else days, else single trials."""
    for column in GROUPINGS:
        names = [trial.group(column) for trial in trials]
        if all(getattr(trial, column) for trial in trials) and len(set(names)) >= FEWEST_CLUSTERS:
            return names
    return [str(i) for i in range(len(trials))]  # Not their names: a planned trial may be there several times


def group_scatter(single: Floats, groups: Sequence[Hashable], fitted: int) -> Floats:
    """Variance of the sum of scores from the scatter of sums over groups, corrected for few groups. The correction is
    G/(G − 1) · (N − 1)/(N − p), CR1 of Cameron & Miller, Journal of Human Resources 50, 317 (2015). Shapes: single
    (n_trials, n_free) → (n_free, n_free).
    """
    of_trial = np.unique(np.asarray(groups), return_inverse=True)[1]
    count, trials = of_trial.max() + 1, len(single)
    sums = np.zeros((count, single.shape[1]))
    np.add.at(sums, of_trial, single)
    factor = count / max(count - 1, 1) * (trials - 1) / max(trials - fitted, 1)
    return np.asarray(sums.T @ sums * factor)
