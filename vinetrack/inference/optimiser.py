"""Maximum-likelihood iterations of the mixed-effects model: variance components and Gauss–Newton steps in turn.

The method is that of Lindstrom & Bates, Biometrics 46, 673 (1990): linearise the model about the current trajectories,
estimate noise and between-trial standard deviations of the linear model, take a damped Gauss–Newton step, and repeat
until neither changes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.inference.fit_data import FitTrial
from vinetrack.inference.gaussian_processes import at_correlation
from vinetrack.inference.marginal_likelihood import (
    CORRELATIONS,
    LARGEST_SPREAD,
    FitState,
    MixedProblem,
    estimate_between_trial_sd,
    estimate_noise,
    levenberg_marquardt_step,
    log_likelihood,
    marginal,
    shared_penalty,
)
from vinetrack.inference.sensitivity import Predictor, initial_trial_effects
from vinetrack.inference.trial_effects import (
    likelier_releases,
    moved_effects,
    optimise_trial_effects,
    residuals_in,
    trial_costs,
)

# ------------------------------------------------------------------------------
# The constant part of a fit (priors, bounds) and its initial state (noise, between-trial standard deviations).


def make_problem(predictor: Predictor, trial_effects: Floats) -> MixedProblem:
    """The constant part of a fit. Shapes: trial_effects (n_trials, 4)."""
    layout, data = predictor.layout, predictor.data
    lower, upper = layout.bounds
    durations = np.array([trial_data.time_s[-1] - trial_data.time_s[0] for trial_data in data])
    spans = np.array([np.ptp(trial_data.lead_position_m) for trial_data in data])
    frames = np.array([trial_data.frame_s for trial_data in data])
    rests = np.array([trial_data.shows_rest for trial_data in data])
    release_known = rests | np.array([trial_data.pressurised_in_recording for trial_data in data])
    rest_sigma_m = np.array(
        [0.0 if trial_data.imprecise_rest is None else trial_data.imprecise_rest.sigma_m for trial_data in data]
    )
    # 10.0, 10.0: prior standard deviations of release, frames, and of origin, in standard deviations of the noise
    # (chosen)
    release_sd = np.where(rests, 10.0 * frames, 3 * durations)
    # 1e-6: prior standard deviation of the release of a vine that was pressurised during the recording: it is
    # known (chosen)
    release_sd[[trial_data.pressurised_in_recording for trial_data in data]] = 1e-6
    noise = np.array([trial_data.noise_m for trial_data in data])
    origin_room_m = np.maximum(10.0 * np.maximum(noise, rest_sigma_m), 1e-4 * spans)
    origin_sd = np.where(rests, origin_room_m, 3 * spans)
    return MixedProblem(
        index=layout.index,
        has_deviation=np.column_stack([predictor.has_pressure_deviation, predictor.has_damping_deviation]),
        gauge_error=np.array([trial_data.gauge_error for trial_data in data]),
        release_origin_mean=np.where(release_known[:, None], initial_trial_effects(data)[:, :2], trial_effects[:, :2]),
        release_origin_precision=np.column_stack([1 / release_sd**2, 1 / origin_sd**2]),
        release_reach_s=frames,
        prior_mean=layout.start,
        prior_precision=layout.prior_precision,
        lower=lower,
        upper=upper,
        free=np.ones(lower.size, dtype=bool),
        points=np.array([float(trial_data.time_s.size) for trial_data in data]),
        stretches=np.array([float(np.count_nonzero(trial_data.first)) for trial_data in data]),
        random=layout.random,
    )


def first_state(data: Sequence[FitTrial], theta: Floats, trial_effects: Floats) -> FitState:
    """Initial state: noise of the tracks alone, between-trial standard deviations as stated in the sheet or typical.
    Shapes: theta (n_free,); trial_effects (n_trials, 4).
    """
    rho = track_correlation(data)
    variance = np.array([trial_data.noise_m**2 * (1 - trial_data.correlation**2) for trial_data in data])
    relative = [
        trial_data.trial.pressure_sigma_Pa / trial_data.trial.pressure_Pa
        for trial_data in data
        if trial_data.trial.pressure_Pa > 0 and np.isfinite(trial_data.trial.pressure_sigma_Pa)
    ]
    spread = (float(np.mean(relative)) if relative else TYPICAL_SPREADS[0]), TYPICAL_SPREADS[1]
    return FitState(theta, trial_effects, spread, rho, np.maximum(variance, variance_floor(data)))


def track_correlation(data: Sequence[FitTrial]) -> float:
    """Lag-one correlation of the noise, estimated from the tracks without a model. Returns mean over trials, weighted
    by points.
    """
    return float(
        np.average(
            [trial_data.correlation for trial_data in data], weights=[trial_data.time_s.size for trial_data in data]
        )
    )


TYPICAL_SPREADS = (0.01, 0.03)  # Usual standard deviations of pressure (relative) and ln B between trials (chosen)


def variance_floor(data: Sequence[FitTrial]) -> Floats:
    """Least variance of the noise of each trial, given the accuracy of the integrator. Shape (n_trials,)."""
    # 2e-6: least noise, relative to a trial's travel, because the integrator is not more accurate (measured)
    return np.array([(2e-6 * np.ptp(trial_data.lead_position_m)) ** 2 for trial_data in data])


def estimable(problem: MixedProblem) -> tuple[bool, bool]:
    """Whether there are enough trials to estimate the between-trial standard deviations of pressure and of ln B."""
    # 3: A between-trial standard deviation is estimated where it applies to this many more trials than there are
    # parameters without a prior (chosen)
    needed = np.count_nonzero(problem.prior_precision == 0) + 3
    pressure = np.count_nonzero(problem.has_deviation[:, 0] & (problem.gauge_error == 0))
    return bool(pressure >= needed), bool(np.count_nonzero(problem.has_deviation[:, 1]) >= needed)


# ------------------------------------------------------------------------------
# How well a solution describes the tracks: χ² per degree of freedom, relative residual, and what counts as poor.

# χ² per degree of freedom above which a fit may be at a local minimum, and other starts are tried (chosen)
POOR_FIT = 4.0


def chi2_per_dof(predictor: Predictor, solution: Solution) -> float:
    """χ² per degree of freedom, relative to the noise (variance and correlation) estimated from the tracks alone. Noise
    below the accuracy of the integrator is replaced by that accuracy, see `variance_floor`.
    """
    data = predictor.data
    rho = track_correlation(data)
    noise = np.maximum(np.array([trial_data.noise_m**2 for trial_data in data]) * (1 - rho**2), variance_floor(data))
    residual_squares = at_correlation(solution.cross_products, rho)[:, -1, -1]
    fitted_degrees = (
        np.count_nonzero(solution.problem.free) / residual_squares.size + 2 + solution.problem.has_deviation.any(axis=1)
    )
    return float(np.sum(residual_squares / noise) / np.sum(np.maximum(solution.problem.points - fitted_degrees, 1.0)))


def is_poor_fit(predictor: Predictor, solution: Solution) -> bool:
    """Whether a solution misses the tracks by far more than their noise and by a visible fraction of the growth. Both
    are needed: a tracker whose frames agree to a hundredth of a millimetre may have slow errors of a few tenths. That
    is far above its noise, but no reason to try other starts.
    """
    # 3e-3: residual of the median trial, relative to its growth, above which a fit is poor (chosen)
    missed = float(np.median(relative_residuals(predictor, solution)))
    return chi2_per_dof(predictor, solution) > POOR_FIT and missed > 3e-3


def relative_residuals(predictor: Predictor, solution: Solution) -> Floats:
    """Root mean square residual of each trial, relative to its observed growth, shape (n_trials,)."""
    relative = [
        math.sqrt(float(np.mean(columns[:, -1] ** 2))) / max(float(np.ptp(trial_data.lead_position_m)), 1e-9)
        for columns, trial_data in zip(solution.columns, predictor.data, strict=True)
    ]
    return np.array(relative)


MOST_ITERATIONS = 60  # Maximum number of steps (chosen)

CONVERGED_DECREASE = 1e-2  # Predicted decrease of −2 ln L per step below which the parameters have converged (derived)

# Relative change of noise and between-trial standard deviations that counts as converged (chosen)
CONVERGED_VARIANCES = 0.02


@dataclass(frozen=True)
class FixedTerms:
    """Variance components that are fixed instead of estimated. `spread` are the between-trial standard deviations of
    pressure (relative) and of ln B; `noise` is the correlation and the innovation variance of each trial, m².
    """

    spread: tuple[float, float] | None = None
    noise: tuple[float, Floats] | None = None


@dataclass(frozen=True)
class Solution:
    """Where the iterations ended. `columns` are the sensitivities and residuals of each trial at `state`
    (`Predictor.linearise`), `cross_products` their sums of products (`gaussian_processes.products`).
    """

    state: FitState
    problem: MixedProblem
    cross_products: Floats
    columns: tuple[Floats, ...]
    estimable: tuple[bool, bool]
    converged: bool
    iterations: int
    noise_held: bool = False

    def log_likelihood(self) -> float:
        """`marginal_likelihood.log_likelihood` at the state."""
        return log_likelihood(self.cross_products, self.problem, self.state, self.estimable)


@dataclass(frozen=True)
class Step:
    """Progress of a fit: parameter values, SI, by name, and the decrease of −2 ln L that the next step predicts.
    Systematic errors are fitted after the last step and change the reported values slightly.
    """

    iteration: int
    values: Mapping[str, float]
    predicted_decrease: float


Watch = Callable[[Step], None]  # Called with every step; an exception that it raises ends the fit


def solve(
    predictor: Predictor,
    problem: MixedProblem,
    state: FitState,
    fixed_terms: FixedTerms | None = None,
    *,
    most_iterations: int = MOST_ITERATIONS,
    watch: Watch | None = None,
    least_decrease: float = CONVERGED_DECREASE,
    least: float = -math.inf,
) -> Solution:
    """Iterate the mixed-effects fit to convergence, or until ln L will clearly not reach `least`. Method:
    Lindstrom & Bates, Biometrics 46, 673 (1990): Gauss–Newton steps for the parameters alternate with estimates of
    noise and between-trial standard deviations; Levenberg–Marquardt damping where a full step fails.
    """
    fixed_terms, estimable_sd = fixed_terms or FixedTerms(), estimable(problem)
    if fixed_terms.spread is not None:
        state, estimable_sd = replace(state, spread=fixed_terms.spread), (False, False)
    if noise_held := fixed_terms.noise is not None:
        state = replace(state, rho=fixed_terms.noise[0], variance=fixed_terms.noise[1])
    far_decrease = 1e3  # Predicted decrease of −2 ln L from which a fit is far off (chosen)
    damping, converged, iteration, predicted_decrease, decrease = 0.0, False, 0, math.inf, math.inf
    columns, cross_products = _linearise(predictor, state)
    level, searched = -math.inf, False
    for iteration in range(1, most_iterations + 1):
        # Variance components of the model linearised about the current state, then a step of the parameters.
        before = state
        # Far off, noise correlation and differences between trials, which would take up the misfit, keep their values.
        # 9: steps at most in which a fit counts as far off (chosen)
        far_off = predicted_decrease > far_decrease and iteration <= 9
        state = update_variances(predictor, problem, cross_products, state, estimable_sd, noise_held, far_off)
        if state.rho == CORRELATIONS[1] and np.greater_equal(state.spread, LARGEST_SPREAD).all():
            break  # They have taken up what the model lacks.
        variances_moved = variance_change(before, state)
        full = levenberg_marquardt_step(cross_products, problem, state, 0.0)
        damped = levenberg_marquardt_step(cross_products, problem, state, damping) if damping > 0 else full
        predicted_decrease = full[2]
        predictor.is_central = predicted_decrease < far_decrease
        if least > -math.inf and not far_off:
            level_before, level = level, log_likelihood(cross_products, problem, state, estimable_sd)
            # As much again as the last step gained, and twice what the next one promises, would not be enough.
            if level + max(level - level_before, predicted_decrease) < least:
                break
        if watch is not None:
            values = zip(predictor.layout.free, predictor.layout.values(state.theta).tolist(), strict=True)
            watch(Step(iteration, {number.name: value for number, value in values}, predicted_decrease))
        # At a corner of the cost, where a frame crosses the end of growth, a step brings less than it promises.
        small_step = min(predicted_decrease, decrease) < least_decrease
        # 5: steps between two searches (chosen). Now and then, and before the fit ends: does a trial have a likelier
        # release far from the current one?
        if (small_step and not searched) or iteration % 5 == 0:
            relocated = likelier_releases(predictor, problem, state)
            searched = small_step and relocated is None
            if relocated is not None:
                state, (columns, cross_products) = relocated, _linearise(predictor, relocated)
                decrease = math.inf
                continue
        if small_step and variances_moved < CONVERGED_VARIANCES and not far_off:
            converged = predicted_decrease < far_decrease
            break
        penalised_squares = cost(predictor, problem, state, residuals_in(columns))
        # Shorten or damp the step until it lowers the penalised sum of squares; linearise about the new state.
        accepted, damping = _accepted_step(
            predictor, problem, cross_products, state, damped[:2], damping, penalised_squares
        )
        try:
            if accepted is not None:
                columns, cross_products = _linearise(predictor, accepted)
        except SimulationError:
            # A perturbed trajectory of the new state cannot be simulated: the last state is still a result.
            break
        state = accepted or state
        decrease = penalised_squares - cost(predictor, problem, state, residuals_in(columns))
    return Solution(state, problem, cross_products, tuple(columns), estimable_sd, converged, iteration, noise_held)


def _linearise(predictor: Predictor, state: FitState) -> tuple[list[Floats], Floats]:
    """Sensitivities and residuals at a state, and their cross products."""
    columns = predictor.linearise(state.theta, state.trial_effects)
    return columns, predictor.products(columns)


def update_variances(
    predictor: Predictor,
    problem: MixedProblem,
    cross_products: Floats,
    state: FitState,
    estimable_sd: tuple[bool, bool],
    noise_held: bool,
    far_off: bool = False,
) -> FitState:
    """Estimate noise and between-trial standard deviations; of a fit that is far off only the size of the noise."""
    if not noise_held:
        rho, variance = estimate_noise(cross_products, problem, state, state.rho if far_off else None)
        state = replace(state, rho=rho, variance=np.maximum(variance, variance_floor(predictor.data)))
    if any(estimable_sd) and not far_off:
        spread = estimate_between_trial_sd(marginal(cross_products, problem, state), problem, state, estimable_sd)
        state = replace(state, spread=spread)
    return state


def variance_change(before: FitState, after: FitState) -> float:
    """Largest relative change of noise and between-trial standard deviations. Between-trial standard deviations well
    below 0.001 count as zero.
    """
    spreads = [abs(np.log((b + 1e-3) / (a + 1e-3))) for a, b in zip(before.spread, after.spread, strict=True)]
    noise = np.max(np.abs(np.log(after.variance / before.variance)))
    return float(max(*spreads, noise, abs(after.rho - before.rho)))


def _accepted_step(
    predictor: Predictor,
    problem: MixedProblem,
    cross_products: Floats,
    state: FitState,
    steps: tuple[Floats, Floats],
    damping: float,
    penalised_squares: float,
) -> tuple[FitState | None, float]:
    """The first state that lowers the penalised sum of squares, and the damping for the next step. A line search comes
    first, then ever more damping: in a curved valley a step that is too long has the right direction, and damping would
    turn it across the valley. `penalised_squares` is that of the current state.
    """

    def lowered(step: Floats, effect_step: Floats) -> FitState | None:
        theta = np.clip(state.theta + step, problem.lower, problem.upper)
        try:
            reached = replace(state, theta=theta, trial_effects=moved_effects(state.trial_effects, effect_step))
            reached, costs = optimise_trial_effects(predictor, problem, reached)
        except SimulationError:
            return None
        return reached if float(np.sum(costs)) + shared_penalty(problem, reached) < penalised_squares else None

    # (1.0, 0.4, 0.15), 11: fractions of a step that a line search tries, and how many times the damping is then
    # increased (chosen)
    for fraction in (1.0, 0.4, 0.15):
        candidate = lowered(*(fraction * step for step in steps))
        if candidate is not None:
            return candidate, damping * 0.1 if damping > 1e-6 else 0.0
    for _ in range(11):
        damping = max(10 * damping, 1e-4)
        candidate = lowered(*levenberg_marquardt_step(cross_products, problem, state, damping)[:2])
        if candidate is not None:
            return candidate, damping * 0.1
    return None, 0.0


def cost(predictor: Predictor, problem: MixedProblem, state: FitState, residuals: Floats | None = None) -> float:
    """Penalised sum of squares: whitened residuals of all trials plus the priors of parameters and trial effects.
    Shapes: residuals (n_points_of_all,).
    """
    return float(np.sum(trial_costs(predictor, problem, state, residuals))) + shared_penalty(problem, state)
