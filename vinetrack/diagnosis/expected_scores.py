"""Expected scores of effects of a finite size: the model without the effect, fitted to what the effect would show.

Linear theory (`vinetrack.diagnosis.linear_power`) takes the free numbers to move in proportion to the size of an
effect. An effect that they nearly imitate moves them by many standard errors before anything is left to be seen, and by
then sensitivities have changed. So each effect is put into noise-free trajectories at the size in question, the model
without it is fitted to them with noise and spreads held, and its score is read there: the data set of Asimov (Cowan,
Cranmer, Gross & Vitells, European Physical Journal C 71, 1554, 2011).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.diagnosis.candidates import CandidateShape
from vinetrack.diagnosis.effect_sensitivities import effect_sensitivities
from vinetrack.diagnosis.misfit_tests import MisfitTests
from vinetrack.diagnosis.power import PROBABILITIES
from vinetrack.diagnosis.score_test import projected, scores_of
from vinetrack.diagnosis.shape_products import Products, products_of
from vinetrack.dynamics.simulate import SimulationError, Trajectory
from vinetrack.inference.fit_data import END_FRACTION, FEWEST_POINTS, FRAMES_BEHIND_END, FitTrial
from vinetrack.inference.fit_result import Fit
from vinetrack.inference.mixed_effects import FitState, solve_per_trial, trial_effect_prior
from vinetrack.inference.optimiser import FixedTerms, solve
from vinetrack.inference.sensitivity import DAMPING_DEVIATION, N_TRIAL_EFFECTS, ORIGIN, PRESSURE, RELEASE, Predictor
from vinetrack.inference.systematics import systematics_of
from vinetrack.inference.trajectory_jobs import Jobs
from vinetrack.inference.whitening import at_correlation

ITERATIONS, SETTLED = 20, 0.2
"""Gauss–Newton steps of the fit without the effect, after which it is not trusted; and the decrease of −2 ln L,
promised by a step, below which it has settled. Chosen as a safeguard: of 62 fits of 24 trials of one vine 55 settle
within four steps and all within fourteen (a pressure gauge 1.5 kPa off was the last); at half that is passed over.
Derived: 0.2 of the 49 of seven standard errors moves a score by 0.2 %; at half or twice by 0.1 and 0.4 %."""


IN_PROPORTION = 0.02
"""Relative deviation of an expected score from proportion to the size that is passed over. Chosen: 2 % of a size, where
the draws leave 0.5 %; at half more effects are followed at two sizes, and at twice sizes err by as much as noise and
scatter are known from 24 trials."""

BELIEVABLE = 2.0
"""Ratio of an expected score to that in proportion to the size from which neither is trusted, as below 0. Chosen: a fit
without the effect that ends in another minimum leaves too much; at half every convex effect is passed over, at twice
some of those fits count. A small ratio is trusted: 0.11 and 0.20 of rolling shutter (tuning seed 21100), 0.43 of a slow
valve (21110) were borne out by the independent simulator."""

ENOUGH = 7.0
"""Expected score from which no larger size is tried. Chosen: thresholds are 3.6 to 4.6, and 90 % lie 1.3 above; at half
sizes are worked out by proportion from below a threshold, at twice time is spent beyond all of them."""

LARGEST_MULTIPLE = 56.0
"""Multiple of the size of one standard error beyond which no size is tried. Chosen: three doublings of 7; what is not
seen there is fitted away by other numbers, and larger sizes take time only."""


@dataclass(frozen=True)
class NoiselessStart:
    """Trajectories of a fit without deviations of its trials, where every fit without an effect begins.

    `predictor` has the steps of differences that suit them, `columns` are their sensitivities at the fit's points, the
    last the residual.
    """

    state: FitState
    predictor: Predictor
    jobs: Jobs
    columns: list[Floats]


def noiseless_start(fit: Fit) -> NoiselessStart:
    """Take the deviations of trials out of a fit and linearise there: the same for every effect and size.

    Parameters
    ----------
    fit : of the model without the effects.

    Returns
    -------
    NoiselessStart

    Raises
    ------
    SimulationError
        If the trajectories cannot be followed.
    """
    trial_effects = fit.state.trial_effects.copy()
    trial_effects[:, [PRESSURE, DAMPING_DEVIATION]] = 0.0
    state = replace(fit.state, trial_effects=trial_effects)
    predictor = _predictor_of(fit.predictor, fit.predictor.data)
    columns = predictor.linearise(state.theta, trial_effects)
    return NoiselessStart(state, predictor, predictor.job_arrays(state.theta, trial_effects), columns)


def _predictor_of(predictor: Predictor, data: Sequence[FitTrial]) -> Predictor:
    """A predictor of other positions of the same trials, which begins with the same steps of differences."""
    other = Predictor(predictor.layout, data, predictor.host)
    other.steps, other.pressure_step = predictor.steps.copy(), predictor.pressure_step.copy()
    return other


def score_ratios(questions: MisfitTests, place: int, unit: float, start: NoiselessStart) -> tuple[Floats, Floats]:
    """Sizes that an effect is followed at, and by what its expected scores there differ from proportion to the size.

    Where the score at seven units, beyond any threshold, is in proportion, no other size is tried; else, and where it
    cannot be followed (exactly 1), one about a threshold too, and ever larger ones as long as their scores are below
    thresholds: what the release times of trials take up, such as a slow valve, is seen only where it is large. Beyond
    what is believable of a ratio, proportion stands.

    Parameters
    ----------
    questions : the fit, held against all candidates.
    place : of the shape in which the effect is put in.
    unit : size whose score is one standard error, SI.
    start : NoiselessStart
        Of the fit.

    Returns
    -------
    sizes : array, shape (n_sizes,), SI
    ratios : array, shape (n_sizes,)
    """
    large = score_ratio(questions, place, 7 * unit, start)
    if 0 < abs(large - 1) < IN_PROPORTION:
        return np.array([7 * unit]), np.array([large])
    multiples, ratios = [4.0, 7.0], [score_ratio(questions, place, 4 * unit, start), large]
    if not all(0 < ratio < BELIEVABLE for ratio in ratios):
        return unit * np.array(multiples), np.ones(2)
    while ratios[-1] * multiples[-1] < ENOUGH and multiples[-1] < LARGEST_MULTIPLE:
        ratio = score_ratio(questions, place, 2 * multiples[-1] * unit, start)
        if ratio == 1 or not 0 < ratio < BELIEVABLE:
            break
        multiples.append(2 * multiples[-1])
        ratios.append(ratio)
    return unit * np.array(multiples), np.array(ratios)


def score_ratio(questions: MisfitTests, place: int, size: float, start: NoiselessStart) -> float:
    """Expected score of an effect at a size, over what linear theory gives.

    Parameters
    ----------
    questions : the fit, held against all candidates.
    place : of the shape in which the effect is put in.
    size : deviation from absence, SI.
    start : NoiselessStart
        Of the fit.

    Returns
    -------
    float
        1 where the trajectories cannot be followed with the effect at that size, or the fit without it does not settle.
    """
    fit, shape = questions.fit, questions.sensitivities.shapes[place]
    sigma = float(questions.scores.plain_sigma[place])
    if shape.whole or not shape.effect.parameters:
        return 1.0
    try:
        after = fitted_without(fit, shape, size, start)
        if not after.solution.converged:
            return 1.0
        answers = effect_sensitivities(after, [shape])
        if shape.effect.name in answers.silent or not answers.shapes:
            return 1.0
        systematics = systematics_of(after.predictor, after.solution, after.trials)
        # No point lies where growth ends, so the columns of the last step are those that `fit_columns` would make.
        scores = scores_of(
            after, products_of(after, systematics.at_zero_errors(after.solution.columns), answers, systematics)
        )
    except (SimulationError, np.linalg.LinAlgError):
        return 1.0
    return float(scores.size[0] / scores.plain_sigma[0]) / (size / sigma)


def sizes_at_systematic_error(questions: MisfitTests) -> Floats:
    """Sizes at which an effect moves positions by as much as their systematic errors.

    Parameters
    ----------
    questions : the fit, held against all candidates.

    Returns
    -------
    array, shape (n_shapes,)
        Deviations from absence, SI, positive; 0 where positions have no such errors.
    """
    fit = questions.fit
    systematic_m = float(np.median([trial_data.position_systematic_m for trial_data in fit.predictor.data]))
    if not systematic_m > 0:
        return np.zeros(len(questions.sensitivities.shapes))
    moved_m = residual_displacements(fit, questions.products)
    return np.asarray(systematic_m / np.maximum(moved_m, 1e-300))


def residual_displacements(fit: Fit, sums: Products) -> Floats:
    """How far a fit without an effect stays from trajectories with a unit of its size, to first order.

    Parameters
    ----------
    fit : the fit that is questioned.
    sums : its columns and those of the candidates.

    Returns
    -------
    array, shape (n_shapes,), m per unit of each size
        Root mean square over trials of the largest distance, all free numbers and those of each trial fitted.
    """
    problem, state, n_shapes = fit.solution.problem, fit.state, sums.n_shapes
    levers = np.vstack([projected(fit, sums, state).lever[:, :n_shapes], np.zeros((1, n_shapes))])[problem.index]
    precision = trial_effect_prior(problem, state)[1]
    keys, shapes = (
        slice(N_TRIAL_EFFECTS, N_TRIAL_EFFECTS + sums.n_keys),
        slice(N_TRIAL_EFFECTS + sums.n_keys + 1, N_TRIAL_EFFECTS + sums.n_keys + 1 + n_shapes),
    )
    largest = []
    for part in sums.parts:
        white = at_correlation(sums.cross_products(part), state.rho) / state.variance[part, None, None]
        within_trial = white[:, :N_TRIAL_EFFECTS, :N_TRIAL_EFFECTS] + precision[part][:, :, None] * np.eye(
            N_TRIAL_EFFECTS
        )
        deviations = solve_per_trial(
            within_trial, white[:, :N_TRIAL_EFFECTS, shapes] - white[:, :N_TRIAL_EFFECTS, keys] @ levers[part]
        )
        largest += [
            np.max(np.abs(columns[:, shapes] - columns[:, :N_TRIAL_EFFECTS] @ mine - columns[:, keys] @ shared), axis=0)
            for columns, mine, shared in zip(sums.columns[part], deviations, levers[part], strict=True)
        ]
    return np.asarray(np.sqrt(np.mean(np.square(largest), axis=0)))


def half_power_below(least: float, sizes: Floats) -> Floats:
    """Return sizes by probability where a finding below the least size counts half.

    Parameters
    ----------
    least : float
        Deviation from absence, SI, positive.
    sizes : array
        Deviations at `PROBABILITIES`.

    Returns
    -------
    array
        Of the same shape.
    """
    away = np.abs(sizes)
    half = np.interp(2 * np.array(PROBABILITIES), PROBABILITIES, away, right=math.inf)
    return np.asarray(np.sign(sizes) * np.where(away >= least, away, np.minimum(half, least)))


def fitted_without(fit: Fit, shape: CandidateShape, size: float, start: NoiselessStart) -> Fit:
    """Fit the model of a fit to noise-free trajectories with an effect; noise and spreads stay as they are.

    Parameters
    ----------
    fit : of the model without the effect.
    shape : in which the effect is put in.
    size : float
        Deviation from absence, SI.
    start : NoiselessStart
        Of the fit.

    Returns
    -------
    Fit
        What its solution's columns leave is what the model cannot follow.

    Raises
    ------
    SimulationError
        If a trial does not move with the effect.
    """
    state, jobs = start.state, start.jobs.with_effect([shape.size.zero + size, *shape.other_values])
    moved = start.predictor.run_as(fit.model + shape.effect, jobs)
    kept = [_kept(trial_data, trajectory) for trial_data, trajectory in zip(fit.predictor.data, moved, strict=True)]
    data = [
        _recorded(trial_data, trajectory, state.trial_effects[i], keep)
        for i, (trial_data, trajectory, keep) in enumerate(zip(fit.predictor.data, moved, kept, strict=True))
    ]
    if any(trial_data.time_s.size < FEWEST_POINTS or not np.ptp(trial_data.lead_position_m) > 0 for trial_data in data):
        raise SimulationError(f"With {shape.effect.name} at that size a trial does not move.")
    begin = [columns[keep] for columns, keep in zip(start.columns, kept, strict=True)]
    for columns, trial_data, before, keep in zip(begin, data, fit.predictor.data, kept, strict=True):
        columns[:, -1] += trial_data.lead_position_m - before.lead_position_m[keep]
    predictor = _predictor_of(start.predictor, data)
    held = FixedTerms(spread=state.spread, noise=(state.rho, state.variance))
    solution = solve(
        predictor,
        fit.solution.problem,
        state,
        held,
        warm=True,
        most_iterations=ITERATIONS,
        columns=begin,
        least_decrease=SETTLED,
    )
    trials = [
        replace(
            trial,
            time_s=trial_data.time_s,
            lead_position_m=trial_data.lead_position_m,
            predicted_position_m=trial_data.lead_position_m - columns[:, -1],
            predicted_velocity_m_s=-columns[:, RELEASE],
            origin_m=float(solution.state.trial_effects[i, ORIGIN]),
        )
        for i, (trial, trial_data, columns) in enumerate(zip(fit.trials, data, solution.columns, strict=True))
    ]
    return replace(fit, predictor=predictor, solution=solution, trials=tuple(trials), smooth=None)


def _kept(trial_data: FitTrial, trajectory: Trajectory) -> NDArray[np.bool_]:
    """Points that a fit would use: not on the last of the growth, and not next to its end."""
    behind_s = trajectory.end_time_s + (FRAMES_BEHIND_END + 1) * trial_data.frame_s
    ended = trajectory.status == "ended"
    grown = trajectory.lead_position_m < END_FRACTION * trial_data.trial.length_m
    return np.asarray(grown | (ended & (trajectory.time_s > behind_s)) | ~np.isfinite(trial_data.trial.length_m))


def _recorded(trial_data: FitTrial, trajectory: Trajectory, trial_effects: Floats, keep: NDArray[np.bool_]) -> FitTrial:
    """A trial with the positions of a trajectory, at the points that a fit would use."""
    return replace(
        trial_data,
        time_s=trial_data.time_s[keep],
        lead_position_m=(trial_effects[ORIGIN] + trajectory.observed_position_m)[keep],
        first=_first(trial_data, keep),
        relative_sd=None if trial_data.relative_sd is None else trial_data.relative_sd[keep],
    )


def _first(trial_data: FitTrial, keep: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which of the points that are kept begin a stretch without gaps."""
    stretch = np.cumsum(trial_data.first | np.concatenate([[False], ~keep[:-1]]))[keep]
    return np.concatenate([[True], np.diff(stretch) > 0])
