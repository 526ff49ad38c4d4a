"""Expected scores of effects of finite size: the model without the effect, fitted to noise-free data with it.

In linear theory (`vinetrack.diagnosis.linear_power`) the free parameters move in proportion to the size of an effect.
An effect that they nearly imitate moves them by many standard errors before it becomes detectable, and by then the
sensitivities have changed. So each effect is put into noise-free trajectories at the size in question, the model
without it is fitted to them with noise and between-trial standard deviations held, and the score is computed there: the
Asimov data set of Cowan, Cranmer, Gross & Vitells, European Physical Journal C 71, 1554, 2011.
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

# Most Gauss–Newton steps of the fit without the effect, beyond which it is not used (chosen)
MAX_ITERATIONS, CONVERGENCE_DECREASE = 20, 0.2


LINEARITY_TOLERANCE = 0.02  # Relative deviation of an expected score from linear theory that is neglected (chosen)

# Ratio of an expected score to that of linear theory from which neither is used, as below 0 (chosen)
MAX_SCORE_RATIO = 2.0

LARGEST_SCORE = 7.0  # Expected score from which no larger size is tried (chosen)

LARGEST_MULTIPLE = 56.0  # Multiple of the size of one standard error beyond which no size is tried (chosen)


@dataclass(frozen=True)
class NoiselessStart:
    """Trajectories of a fit with the deviations of its trials set to zero, where every fit without an effect starts.
    `predictor` has finite-difference steps that suit them; `columns` are their sensitivities at the fit's points, the
    residual last.
    """

    state: FitState
    predictor: Predictor
    jobs: Jobs
    columns: list[Floats]


def noiseless_start(fit: Fit) -> NoiselessStart:
    """Set the trial deviations of a fit to zero and linearise there: the same start for every effect and size."""
    trial_effects = fit.state.trial_effects.copy()
    trial_effects[:, [PRESSURE, DAMPING_DEVIATION]] = 0.0
    state = replace(fit.state, trial_effects=trial_effects)
    predictor = _predictor_of(fit.predictor, fit.predictor.data)
    columns = predictor.linearise(state.theta, trial_effects)
    return NoiselessStart(state, predictor, predictor.job_arrays(state.theta, trial_effects), columns)


def _predictor_of(predictor: Predictor, data: Sequence[FitTrial]) -> Predictor:
    """A predictor for other positions of the same trials, with the same initial finite-difference steps."""
    other = Predictor(predictor.layout, data, predictor.host)
    other.steps, other.pressure_step = predictor.steps.copy(), predictor.pressure_step.copy()
    return other


def score_ratios(tests: MisfitTests, shape_index: int, unit: float, start: NoiselessStart) -> tuple[Floats, Floats]:
    """Sizes of an effect, and the ratios of its expected scores there to those of linear theory. Where the score at
    seven units, above any threshold, agrees with linear theory, no other size is computed. Returns sizes, ratios. Shape
    (n_sizes,).
    """
    large = score_ratio(tests, shape_index, 7 * unit, start)
    if 0 < abs(large - 1) < LINEARITY_TOLERANCE:
        return np.array([7 * unit]), np.array([large])
    multiples, ratios = [4.0, 7.0], [score_ratio(tests, shape_index, 4 * unit, start), large]
    if not all(0 < ratio < MAX_SCORE_RATIO for ratio in ratios):
        return unit * np.array(multiples), np.ones(2)
    while ratios[-1] * multiples[-1] < LARGEST_SCORE and multiples[-1] < LARGEST_MULTIPLE:
        ratio = score_ratio(tests, shape_index, 2 * multiples[-1] * unit, start)
        if ratio == 1 or not 0 < ratio < MAX_SCORE_RATIO:
            break
        multiples.append(2 * multiples[-1])
        ratios.append(ratio)
    return unit * np.array(multiples), np.array(ratios)


def score_ratio(tests: MisfitTests, shape_index: int, size: float, start: NoiselessStart) -> float:
    """Expected score of an effect at a size, divided by that of linear theory. Returns 1 where the trajectories with
    the effect cannot be simulated, or the fit without it does not converge.
    """
    fit, shape = tests.fit, tests.sensitivities.shapes[shape_index]
    sigma = float(tests.scores.plain_sigma[shape_index])
    if shape.whole or not shape.effect.parameters:
        return 1.0
    try:
        refit = fitted_without(fit, shape, size, start)
        if not refit.solution.converged:
            return 1.0
        sensitivities = effect_sensitivities(refit, [shape])
        if shape.effect.name in sensitivities.silent or not sensitivities.shapes:
            return 1.0
        systematics = systematics_of(refit.predictor, refit.solution, refit.trials)
        # No point lies where growth ends, so the columns of the last step are those that `fit_columns` would make.
        scores = scores_of(
            refit, products_of(refit, systematics.at_zero_errors(refit.solution.columns), sensitivities, systematics)
        )
    except (SimulationError, np.linalg.LinAlgError):
        return 1.0
    return float(scores.size[0] / scores.plain_sigma[0]) / (size / sigma)


def sizes_at_systematic_error(tests: MisfitTests) -> Floats:
    """Sizes at which an effect moves positions by as much as their systematic errors. Returns deviations from absence,
    SI, positive; 0 where positions have no such errors. Shape (n_shapes,).
    """
    fit = tests.fit
    systematic_m = float(np.median([trial_data.position_systematic_m for trial_data in fit.predictor.data]))
    if not systematic_m > 0:
        return np.zeros(len(tests.sensitivities.shapes))
    displacement_m = residual_displacements(fit, tests.products)
    return np.asarray(systematic_m / np.maximum(displacement_m, 1e-300))


def residual_displacements(fit: Fit, products: Products) -> Floats:
    """Distance of a fit without an effect from trajectories with a unit of its size, to first order. Returns root mean
    square over trials of the largest distance, all parameters and trial effects re-estimated. Shape (n_shapes,).
    """
    problem, state, n_shapes = fit.solution.problem, fit.state, products.n_shapes
    response = projected(fit, products, state).lever[:, :n_shapes]
    of_keys = np.vstack([response, np.zeros((1, n_shapes))])[problem.index]
    precision = trial_effect_prior(problem, state)[1]
    residual = N_TRIAL_EFFECTS + products.n_keys
    effects, keys = slice(N_TRIAL_EFFECTS), slice(N_TRIAL_EFFECTS, residual)
    shapes = slice(residual + 1, residual + 1 + n_shapes)
    largest = []
    for part in products.parts:
        white = at_correlation(products.cross_products(part), state.rho) / state.variance[part, None, None]
        of_effects = white[:, effects, effects] + precision[part][:, :, None] * np.eye(N_TRIAL_EFFECTS)
        trial_response = solve_per_trial(
            of_effects, white[:, effects, shapes] - white[:, effects, keys] @ of_keys[part]
        )
        largest += [
            np.max(np.abs(columns[:, shapes] - columns[:, effects] @ by_effects - columns[:, keys] @ by_keys), axis=0)
            for columns, by_effects, by_keys in zip(products.columns[part], trial_response, of_keys[part], strict=True)
        ]
    return np.asarray(np.sqrt(np.mean(np.square(largest), axis=0)))


def half_power_below(least: float, sizes: Floats) -> Floats:
    """Detectable sizes where a detection below the least size counts with probability one half."""
    deviation = np.abs(sizes)
    at_half_power = np.interp(2 * np.array(PROBABILITIES), PROBABILITIES, deviation, right=math.inf)
    return np.asarray(np.sign(sizes) * np.where(deviation >= least, deviation, np.minimum(at_half_power, least)))


def fitted_without(fit: Fit, shape: CandidateShape, size: float, start: NoiselessStart) -> Fit:
    """Fit the model of a fit to noise-free trajectories with an effect; noise and between-trial scatter are held."""
    state, jobs = start.state, start.jobs.with_effect([shape.size.zero + size, *shape.other_values])
    moved = start.predictor.run_as(fit.model + shape.effect, jobs)
    used = [
        _used_points(trial_data, trajectory) for trial_data, trajectory in zip(fit.predictor.data, moved, strict=True)
    ]
    data = [
        _with_positions(trial_data, trajectory, state.trial_effects[i], keep)
        for i, (trial_data, trajectory, keep) in enumerate(zip(fit.predictor.data, moved, used, strict=True))
    ]
    if any(trial_data.time_s.size < FEWEST_POINTS or not np.ptp(trial_data.lead_position_m) > 0 for trial_data in data):
        raise SimulationError(f"With {shape.effect.name} at that size a trial does not move.")
    initial = [columns[keep] for columns, keep in zip(start.columns, used, strict=True)]
    for columns, trial_data, before, keep in zip(initial, data, fit.predictor.data, used, strict=True):
        columns[:, -1] += trial_data.lead_position_m - before.lead_position_m[keep]
    predictor = _predictor_of(start.predictor, data)
    held = FixedTerms(spread=state.spread, noise=(state.rho, state.variance))
    solution = solve(
        predictor,
        fit.solution.problem,
        state,
        held,
        warm=True,
        most_iterations=MAX_ITERATIONS,
        columns=initial,
        least_decrease=CONVERGENCE_DECREASE,
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


def _used_points(trial_data: FitTrial, trajectory: Trajectory) -> NDArray[np.bool_]:
    """Points that a fit uses: before the last part of the growth, and not next to its end."""
    behind_s = trajectory.end_time_s + (FRAMES_BEHIND_END + 1) * trial_data.frame_s
    ended = trajectory.status == "ended"
    grown = trajectory.lead_position_m < END_FRACTION * trial_data.trial.length_m
    return np.asarray(grown | (ended & (trajectory.time_s > behind_s)) | ~np.isfinite(trial_data.trial.length_m))


def _with_positions(
    trial_data: FitTrial, trajectory: Trajectory, trial_effects: Floats, keep: NDArray[np.bool_]
) -> FitTrial:
    """A trial with the positions of a trajectory, at the points that a fit uses."""
    return replace(
        trial_data,
        time_s=trial_data.time_s[keep],
        lead_position_m=(trial_effects[ORIGIN] + trajectory.observed_position_m)[keep],
        first=_stretch_starts(trial_data, keep),
        relative_sd=None if trial_data.relative_sd is None else trial_data.relative_sd[keep],
    )


def _stretch_starts(trial_data: FitTrial, keep: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which of the used points begin a stretch without gaps."""
    stretch = np.cumsum(trial_data.first | np.concatenate([[False], ~keep[:-1]]))[keep]
    return np.concatenate([[True], np.diff(stretch) > 0])
