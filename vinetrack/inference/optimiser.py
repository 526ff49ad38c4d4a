"""Maximum-likelihood iterations of the mixed-effects model: variance components and Gauss–Newton steps in turn.

The method is that of Lindstrom & Bates, Biometrics 46, 673 (1990): linearise the model about the current trajectories,
estimate noise and between-trial standard deviations of the linear model, take a Gauss–Newton step, and repeat
until neither changes.

Release, origin and deviations of a trial are correlated, so that its misfit may have several local minima: above all
where no frame shows it at rest, and where a vine starts so slowly that its first frames hardly differ from rest.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.inference.fit_data import FitTrial
from vinetrack.inference.gaussian_processes import at_correlation, whiten
from vinetrack.inference.marginal_likelihood import FitState, Linearised, MixedProblem, solve_per_trial, with_diagonal
from vinetrack.inference.sensitivity import (
    DAMPING_DEVIATION,
    N_TRIAL_EFFECTS,
    ORIGIN,
    PRESSURE,
    RELEASE,
    Predictor,
    align,
    candidate_releases,
    initial_trial_effects,
    over_time,
)

# ------------------------------------------------------------------------------
# Restriction of a fit to a subset of its trials: free parameters, predictor, state and problem.


def subset(
    predictor: Predictor, problem: MixedProblem, rows: NDArray[np.int_], *states: FitState
) -> tuple[Predictor, MixedProblem, list[FitState]]:
    """Predictor, problem and states of some trials and of the parameters that apply to one of them."""
    whole = predictor.layout
    places = np.unique(whole.index[rows][whole.index[rows] >= 0])
    index = np.where(whole.index[rows] >= 0, np.searchsorted(places, whole.index[rows]), -1)
    columns = np.flatnonzero((index >= 0).any(axis=0))
    layout = replace(
        whole,
        free=tuple(whole.free[place] for place in places),
        keys=tuple(whole.keys[column] for column in columns),
        index=index[:, columns],
        base=whole.base[rows],
        between=tuple(
            replace(term, groups=tuple(term.groups[row] for row in rows), regressor=term.regressor[rows])
            for term in whole.between
        ),
    )
    smaller = Predictor(layout, [predictor.data[row] for row in rows], predictor.host)
    smaller.pressure_step, smaller.steps = predictor.pressure_step[rows], predictor.steps[columns]
    smaller.is_central = predictor.is_central
    smaller.has_pressure_deviation = predictor.has_pressure_deviation[rows]
    smaller.has_damping_deviation = predictor.has_damping_deviation[rows]
    by_trial = "has_deviation gauge_error release_reach_s release_origin_mean release_origin_precision points stretches"
    by_trial += " least_variance"
    by_parameter = "prior_mean prior_precision lower upper free random"
    problem = replace(
        problem,
        index=layout.index,
        **{name: getattr(problem, name)[rows] for name in by_trial.split()},
        **{name: getattr(problem, name)[places] for name in by_parameter.split()},
    )
    reduced = [
        replace(each, theta=each.theta[places], trial_effects=each.trial_effects[rows], variance=each.variance[rows])
        for each in states
    ]
    return smaller, problem, reduced


# ------------------------------------------------------------------------------
# Trial effects at given parameters, and a global search for the release of each trial.

LARGEST_DEVIATION = 0.9  # Largest deviation of pressure and ln B (chosen)


def optimise_trial_effects(predictor: Predictor, problem: MixedProblem, state: FitState) -> tuple[FitState, Floats]:
    """One Gauss–Newton step of the trial effects at fixed parameters, and the resulting cost of each trial: effects are
    so precise that a step of the shared parameters leaves the curved valley, to which this step returns.
    """
    columns = predictor.linearise(state.theta, state.trial_effects, trial_effects_only=True)
    white = Linearised(problem, state, predictor.products(columns)).with_prior_gradient()
    precision = problem.held_releases(problem.effect_priors(state)[1])
    square = with_diagonal(white[:, :N_TRIAL_EFFECTS, :N_TRIAL_EFFECTS], precision)
    step = solve_per_trial(square, white[:, :N_TRIAL_EFFECTS, -1:])[:, :, 0]
    moved = replace(state, trial_effects=moved_effects(state.trial_effects, step))
    costs = trial_costs(predictor, problem, state, residuals_in(columns)), trial_costs(predictor, problem, moved)
    better = costs[1] < costs[0]
    trial_effects = np.where(better[:, None], moved.trial_effects, state.trial_effects)
    return replace(state, trial_effects=trial_effects), np.where(better, costs[1], costs[0])


def moved_effects(trial_effects: Floats, step: Floats) -> Floats:
    """Trial effects after a step. Shapes: trial_effects, step (n_trials, 4) → (n_trials, 4)."""
    effects, deviations = trial_effects + step, [PRESSURE, DAMPING_DEVIATION]
    effects[:, deviations] = np.clip(effects[:, deviations], -LARGEST_DEVIATION, LARGEST_DEVIATION)
    return effects


@np.errstate(over="ignore", invalid="ignore")  # of a long step: see `gaussian_processes`
def trial_costs(
    predictor: Predictor, problem: MixedProblem, state: FitState, residuals: Floats | None = None
) -> Floats:
    """Penalised sum of squares of each trial, (n_trials,): its whitened residuals plus the priors of its effects."""
    if residuals is None:
        residuals = predictor.residuals(state.theta, state.trial_effects)
    white = whiten(residuals, predictor.first, state.rho, predictor.relative_sd)
    squares = np.add.reduceat(white**2, predictor.starts[:-1])
    centre, precision = problem.effect_priors(state)
    return np.asarray(squares / state.variance + np.sum(precision * (state.trial_effects - centre) ** 2, axis=1))


def residuals_in(columns: Sequence[Floats]) -> Floats:
    """The residuals among the columns of a linearisation, of all trials, (n_points_of_all,)."""
    return np.concatenate([column[:, -1] for column in columns])


LEAST_DECREASE = 0.5  # Decrease of a trial's −2 ln L for which its release jumps to another minimum (derived)


def likelier_releases(predictor: Predictor, problem: MixedProblem, state: FitState) -> FitState | None:
    """The state with releases at which the trials' likelihoods are higher; None if there are none. They are proposed by
    the linear model, and kept where they remain better after a few steps on simulated trajectories.
    """
    rows = np.flatnonzero([not each.pressurised_in_recording for each in predictor.data])
    if not rows.size:
        return None
    free, _, (current,) = subset(predictor, problem, rows, state)
    releases = list(map(candidate_releases, free.data, current.trial_effects[:, RELEASE].tolist()))
    dense = over_time(free, current.trial_effects[:, RELEASE], releases)
    curves = dense.linearise(current.theta, current.trial_effects, trial_effects_only=True)
    trial_effects, prior = state.trial_effects.copy(), np.stack(problem.effect_priors(state), axis=1)
    for k, i in enumerate(rows.tolist()):
        since_s = dense.times_s[k] - state.trial_effects[i, RELEASE]
        curve = curves[k][:, [*range(N_TRIAL_EFFECTS), -1]]
        effects, gain = _best_release(predictor.data[i], i, state, prior[i], releases[k], since_s, curve)
        if gain > LEAST_DECREASE:
            trial_effects[i] = effects
    rows = np.flatnonzero((trial_effects != state.trial_effects).any(axis=1))
    if not rows.size:
        return None
    proposed = replace(state, trial_effects=trial_effects)
    predictor, problem, (current, proposed) = subset(predictor, problem, rows, state, proposed)
    # 3: steps of the trial effects at another release before it is compared with the current one (chosen)
    for _ in range(3):
        proposed = optimise_trial_effects(predictor, problem, proposed)[0]

    def deviances(state: FitState) -> Floats:
        """−2 ln L of each trial, its effects integrated out by the Laplace approximation."""
        columns = predictor.linearise(state.theta, state.trial_effects, trial_effects_only=True)
        white = Linearised(problem, state, predictor.products(columns)).white()
        square = with_diagonal(white[:, :N_TRIAL_EFFECTS, :N_TRIAL_EFFECTS], problem.effect_priors(state)[1])
        log_volume = np.linalg.slogdet(square)[1]
        return np.asarray(trial_costs(predictor, problem, state, residuals_in(columns)) + log_volume)

    better = deviances(proposed) < deviances(current) - LEAST_DECREASE
    trial_effects = state.trial_effects.copy()
    trial_effects[rows[better]] = proposed.trial_effects[better]
    return replace(state, trial_effects=trial_effects) if better.any() else None


def _best_release(
    trial_data: FitTrial, i: int, state: FitState, prior: Floats, releases: Floats, times: Floats, curves: Floats
) -> tuple[Floats, float]:  # fmt: skip
    """Effects of trial i at its likeliest release, and the decrease of −2 ln L from the last of the releases. `prior`
    are mean and precision of its effects.
    """
    trial_effects, (centre, precision) = state.trial_effects[i], prior
    # Sensitivities and residual at every point for each release, shape (n_points, n_releases, 5), and whitened
    place = np.interp(trial_data.time_s[:, None] - releases, times, np.arange(times.size))
    before = np.minimum(place.astype(int), times.size - 2)
    columns = curves[before] + (place - before)[..., None] * np.diff(curves, axis=0)[before]
    columns[..., -1] += trial_data.lead_position_m[:, None]
    white = whiten(columns, trial_data.first, state.rho, trial_data.relative_sd).transpose(1, 2, 0)
    square = white @ np.swapaxes(white, 1, 2) / float(state.variance[i])
    effects = np.tile(trial_effects, (releases.size, 1))
    effects[:, RELEASE] = releases
    information = square[:, :-1, :-1] + np.diag(precision)
    shared_information, gradient = square[:, ORIGIN:-1, ORIGIN:-1], square[:, ORIGIN:-1, -1]
    slope = gradient - (precision * (effects - centre))[:, ORIGIN:]
    largest = np.array([np.inf, 0.3, 0.3])  # Largest change of origin and deviations (chosen)
    step = np.clip(np.linalg.solve(information[:, ORIGIN:, ORIGIN:], slope[..., None])[..., 0], -largest, largest)
    effects[:, ORIGIN:] += step
    explained = np.sum(step * (2 * gradient - (shared_information @ step[..., None])[..., 0]), axis=1)
    penalty = np.sum(precision * (effects - centre) ** 2, axis=1)
    deviances = square[:, -1, -1] - explained + penalty + np.linalg.slogdet(information)[1]
    k = int(np.argmin(deviances))
    return effects[k], float(deviances[-1] - deviances[k])


# ------------------------------------------------------------------------------
# The constant part of a fit (priors, bounds) and its initial state (noise, between-trial standard deviations).


def make_problem(predictor: Predictor, trial_effects: Floats) -> MixedProblem:
    """The constant part of a fit. Shapes: trial_effects (n_trials, 4)."""
    layout, data = predictor.layout, predictor.data
    lower, upper = layout.bounds
    durations = np.array([each.time_s[-1] - each.time_s[0] for each in data])
    frames, spans, rests = predictor.frames_s, predictor.spans_m, np.array([each.shows_rest for each in data])
    pressurised = np.array([each.pressurised_in_recording for each in data])
    noise_m = [max(each.noise_m, each.imprecise_rest.sigma_m if each.imprecise_rest else 0.0) for each in data]
    # 10.0, 10.0: prior standard deviations of release, frames, and of origin, in standard deviations of the noise;
    # 1e-6: that of the release of a vine that was pressurised during the recording: it is known (chosen)
    release_sd = np.where(pressurised, 1e-6, np.where(rests, 10.0 * frames, 3 * durations))
    origin_sd = np.where(rests, np.maximum(10.0 * np.array(noise_m), 1e-4 * spans), 3 * spans)
    known = (rests | pressurised)[:, None]
    return MixedProblem(
        index=layout.index,
        has_deviation=np.column_stack([predictor.has_pressure_deviation, predictor.has_damping_deviation]),
        gauge_error=np.array([each.gauge_error for each in data]),
        release_origin_mean=np.where(known, initial_trial_effects(data)[:, :2], trial_effects[:, :2]),
        release_origin_precision=np.column_stack([1 / release_sd**2, 1 / origin_sd**2]),
        release_reach_s=frames,
        prior_mean=layout.start,
        prior_precision=layout.prior_precision,
        lower=lower,
        upper=upper,
        free=np.ones(lower.size, dtype=bool),
        points=np.array([float(each.time_s.size) for each in data]),
        stretches=np.array([float(np.count_nonzero(each.first)) for each in data]),
        least_variance=variance_floor(data),
        random=layout.random,
    )


def first_state(data: Sequence[FitTrial], theta: Floats, trial_effects: Floats) -> FitState:
    """Initial state: noise of the tracks alone, between-trial standard deviations as stated in the sheet or typical."""
    variance = np.array([each.noise_m**2 * (1 - each.correlation**2) for each in data])
    set_pressures = [each.trial for each in data if each.trial.pressure_Pa > 0]
    relative = [one.pressure_sigma_Pa / one.pressure_Pa for one in set_pressures if np.isfinite(one.pressure_sigma_Pa)]
    spread = (float(np.mean(relative)) if relative else TYPICAL_SPREADS[0]), TYPICAL_SPREADS[1]
    return FitState(theta, trial_effects, spread, track_correlation(data), np.maximum(variance, variance_floor(data)))


def track_correlation(data: Sequence[FitTrial]) -> float:
    """Lag-one correlation of the noise by the tracks alone: mean over trials, weighted by points."""
    return float(np.average([each.correlation for each in data], weights=[each.time_s.size for each in data]))


TYPICAL_SPREADS = (0.01, 0.03)  # Usual standard deviations of pressure (relative) and ln B between trials (chosen)


def variance_floor(data: Sequence[FitTrial]) -> Floats:
    """Least variance of the noise of each trial, given the accuracy of the integrator. Shape (n_trials,)."""
    # 2e-6: least noise, relative to a trial's travel, because the integrator is not more accurate (measured)
    return np.array([(2e-6 * np.ptp(each.lead_position_m)) ** 2 for each in data])


def estimable(problem: MixedProblem) -> tuple[bool, bool]:
    """Whether there are enough trials to estimate the between-trial standard deviations of pressure and of ln B."""
    # 3: A between-trial standard deviation is estimated where it applies to this many more trials than there are
    # parameters without a prior (chosen)
    needed = np.count_nonzero(problem.prior_precision == 0) + 3
    pressure = np.count_nonzero(problem.has_deviation[:, 0] & (problem.gauge_error == 0))
    return bool(pressure >= needed), bool(np.count_nonzero(problem.has_deviation[:, 1]) >= needed)


# ------------------------------------------------------------------------------
# How well a solution describes the tracks, and the iterations.

# χ² per degree of freedom above which a fit may be at a local minimum, and other starts are tried (chosen)
POOR_FIT = 4.0


def chi2_per_dof(solution: Solution) -> float:
    """χ² per degree of freedom, relative to the noise (variance and correlation) estimated from the tracks alone."""
    data, problem = solution.predictor.data, solution.problem
    rho = track_correlation(data)
    noise = np.maximum(np.array([each.noise_m**2 for each in data]) * (1 - rho**2), problem.least_variance)
    residual_squares = at_correlation(solution.cross_products, rho)[:, -1, -1]
    fitted = np.count_nonzero(problem.free) / len(data) + 2 + problem.has_deviation.any(axis=1)
    return float(np.sum(residual_squares / noise) / np.sum(np.maximum(problem.points - fitted, 1.0)))


def is_poor_fit(solution: Solution) -> bool:
    """Whether a solution misses the tracks by far more than their noise and by a visible fraction of the growth: slow
    errors of a few tenths of a millimetre may be far above the noise of a tracker, but are no reason to start anew.
    """
    # 3e-3: residual of the median trial, relative to its growth, above which a fit is poor (chosen)
    return chi2_per_dof(solution) > POOR_FIT and float(np.median(relative_residuals(solution))) > 3e-3


def relative_residuals(solution: Solution) -> Floats:
    """Root mean square residual of each trial, relative to its growth, (n_trials,)."""
    rms_m = [math.sqrt(float(np.mean(columns[:, -1] ** 2))) for columns in solution.columns]
    spans_m = [float(np.ptp(each.lead_position_m)) for each in solution.predictor.data]
    return np.asarray(rms_m / np.maximum(spans_m, 1e-9))


MOST_ITERATIONS = 60  # Maximum number of steps (chosen)

CONVERGED_DECREASE = 1e-2  # Predicted decrease of −2 ln L per step below which the parameters have converged (derived)

# Relative change of noise and between-trial standard deviations that counts as converged (chosen)
CONVERGED_VARIANCES = 0.02


@dataclass(frozen=True)
class FixedTerms:
    """Variance components that are not estimated: between-trial standard deviations of pressure (relative) and of ln B;
    correlation of the noise and its innovation variance in each trial, m².
    """

    spread: tuple[float, float] | None = None
    noise: tuple[float, Floats] | None = None


@dataclass(frozen=True)
class Solution(Linearised):
    """Where the iterations ended, with sensitivities and residuals of each trial there."""

    predictor: Predictor
    columns: tuple[Floats, ...]
    converged: bool = False
    iterations: int = 0

    @classmethod
    def at(cls, predictor: Predictor, problem: MixedProblem, state: FitState, **held: Any) -> Solution:
        """Linearised about a state; `held` are `estimable` and `noise_held`."""
        columns = tuple(predictor.linearise(state.theta, state.trial_effects))
        return cls(problem, state, predictor.products(columns), predictor, columns, **held)


@dataclass(frozen=True)
class Step:
    """Progress of a fit: parameter values, SI, by name, and the decrease of −2 ln L that the next step predicts."""

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
    """Iterate the mixed-effects fit to convergence, or until ln L will clearly not reach `least`."""
    held, state = _held(fixed_terms or FixedTerms(), problem, state)
    far_decrease = 1e3  # Predicted decrease of −2 ln L from which a fit is far off (chosen)
    converged, iteration, predicted_decrease, decrease = False, 0, math.inf, math.inf
    at, level, searched = Solution.at(predictor, problem, state, **held), -math.inf, False
    for iteration in range(1, most_iterations + 1):
        # Variance components of the model linearised about the current state, then a step of the parameters.
        before = at.state
        # Far off, noise correlation and differences between trials, which would take up the misfit, keep their values.
        # 9: steps at most in which a fit counts as far off (chosen)
        far_off = predicted_decrease > far_decrease and iteration <= 9
        at = at.with_variances(far_off=far_off)
        step, effect_step, predicted_decrease = at.step()
        predictor.is_central = predicted_decrease < far_decrease
        if least > -math.inf and not far_off:
            level_before, level = level, at.log_likelihood()
            # As much again as the last step gained, and twice what the next one promises, would not be enough.
            if level + max(level - level_before, predicted_decrease) < least:
                break
        if watch is not None:
            values = zip(predictor.layout.free, predictor.layout.values(at.state.theta).tolist(), strict=True)
            watch(Step(iteration, {number.name: value for number, value in values}, predicted_decrease))
        # At a corner of the cost, where a frame crosses the end of growth, a step brings less than it promises.
        small_step = min(predicted_decrease, decrease) < least_decrease
        # 5: steps between two searches (chosen). Now and then, and before the fit ends: does a trial have a likelier
        # release far from the current one?
        if (small_step and not searched) or iteration % 5 == 0:
            relocated = likelier_releases(predictor, problem, at.state)
            searched = small_step and relocated is None
            if relocated is not None:
                at, decrease = Solution.at(predictor, problem, relocated, **held), math.inf
                continue
        if small_step and variance_change(before, at.state) < CONVERGED_VARIANCES and not far_off:
            converged = predicted_decrease < far_decrease
            break
        penalised_squares = cost(predictor, problem, at.state, residuals_in(at.columns))
        # Shorten the step until it lowers the penalised sum of squares; linearise about the new state.
        accepted = _accepted_step(at, step, effect_step, penalised_squares)
        if accepted is None:
            decrease = 0.0
            continue
        try:
            at = Solution.at(predictor, problem, accepted, **held)
        except SimulationError:
            # A perturbed trajectory of the new state cannot be simulated: the last state is still a result.
            break
        decrease = penalised_squares - cost(predictor, problem, accepted, residuals_in(at.columns))
    return replace(at, converged=converged, iterations=iteration)


def _held(fixed_terms: FixedTerms, problem: MixedProblem, state: FitState) -> tuple[dict[str, Any], FitState]:
    """Which variance components are estimated, as a `Solution` states it, and the state with those that are not."""
    estimated, noise = estimable(problem), fixed_terms.noise
    if fixed_terms.spread is not None:
        state, estimated = replace(state, spread=fixed_terms.spread), (False, False)
    if noise is not None:
        state = replace(state, rho=noise[0], variance=noise[1])
    return {"estimable": estimated, "noise_held": noise is not None}, state


def variance_change(before: FitState, after: FitState) -> float:
    """Largest relative change of noise and between-trial standard deviations; those well below 0.001 count as zero."""
    spreads = [abs(np.log((b + 1e-3) / (a + 1e-3))) for a, b in zip(before.spread, after.spread, strict=True)]
    noise = np.max(np.abs(np.log(after.variance / before.variance)))
    return float(max(*spreads, noise, abs(after.rho - before.rho)))


def _accepted_step(at: Solution, step: Floats, effect_step: Floats, penalised_squares: float) -> FitState | None:
    """The state after the longest part of a step, of those tried, that lowers the penalised sum of squares; None where
    none does.
    """
    predictor, problem, state = at.predictor, at.problem, at.state
    for part in (1.0, 0.4, 0.15, 0.05, 0.015):  # (chosen)
        theta = np.clip(state.theta + part * step, problem.lower, problem.upper)
        try:
            reached = replace(state, theta=theta, trial_effects=moved_effects(state.trial_effects, part * effect_step))
            reached, costs = optimise_trial_effects(predictor, problem, reached)
        except SimulationError:
            continue
        if float(np.sum(costs)) + problem.penalty(reached) < penalised_squares:
            return reached
    return None


def cost(predictor: Predictor, problem: MixedProblem, state: FitState, residuals: Floats | None = None) -> float:
    """Penalised sum of squares: whitened residuals of all trials plus the priors of parameters and trial effects."""
    return float(np.sum(trial_costs(predictor, problem, state, residuals))) + problem.penalty(state)


# ------------------------------------------------------------------------------
# From where the iterations begin: starting values, part of the trials, or another fit.

ALIKE = (5e-4, 1e-3)  # Between-trial standard deviations of pressure and ln B of trials that are alike (chosen)
STEPS_TO_TELL = 4  # Steps by which it shows whether a fit stays poor (chosen)


def solve_from(
    predictor: Predictor, theta: Floats, fixed_terms: FixedTerms, *, least: float = -math.inf, **how: Any
) -> Solution:
    """Solve from parameters and the releases that suit them; `least` and `how` are options of `_solve_or_alike`."""
    trial_effects, _ = align(predictor, theta, initial_trial_effects(predictor.data))
    problem, state = make_problem(predictor, trial_effects), first_state(predictor.data, theta, trial_effects)
    if (rows := _part(predictor)).size:
        state, poor = _solved_for_part(predictor, problem, state, fixed_terms, rows, **how)
        if poor:  # It only has to be ruled out.
            fixed_terms, how = replace(fixed_terms, spread=ALIKE), how | {"most_iterations": STEPS_TO_TELL}
    return _solve_or_alike(predictor, problem, state, fixed_terms, least=least, **how)


def _part(predictor: Predictor) -> NDArray[np.int_]:
    """The trials with which a fit of many begins, evenly spaced by vine; none where there are few."""
    # 24, 2: trials with which a fit of at least twice as many begins, or this many per parameter (chosen)
    count, vines = max(24, 2 * len(predictor.layout.free)), [one.trial.vine for one in predictor.data]
    if len(vines) < 2 * count:
        return np.zeros(0, dtype=int)
    return np.sort(np.argsort(vines, kind="stable")[np.linspace(0, len(vines) - 1, count).round().astype(int)])


def _solved_for_part(
    predictor: Predictor, problem: MixedProblem, state: FitState, fixed_terms: FixedTerms, rows: NDArray[np.int_],
    **how: Any,
) -> tuple[FitState, bool]:  # fmt: skip
    """The state of all trials from where a fit to some of them ends, and whether that is poor. Most steps of a fit lead
    to the parameters, which need few trials.
    """
    if (noise := fixed_terms.noise) is not None:
        fixed_terms = replace(fixed_terms, noise=(noise[0], noise[1][rows]))
    part, problem, (start,) = subset(predictor, problem, rows, state)
    solution = _solve_or_alike(part, problem, start, fixed_terms, **how)
    theta, reached = state.theta.copy(), solution.state
    theta[np.unique(predictor.layout.index[rows][predictor.layout.index[rows] >= 0])] = reached.theta
    effects, _ = align(predictor, theta, state.trial_effects)
    effects[rows] = reached.trial_effects
    reached = FitState(theta, effects, reached.spread, reached.rho, state.variance)
    return reached, is_poor_fit(solution)


def _solve_or_alike(
    predictor: Predictor,
    problem: MixedProblem,
    state: FitState,
    fixed_terms: FixedTerms,
    *,
    least: float = -math.inf,
    **how: Any,
) -> Solution:
    """Solve, and where the fit is poor, unless another is known to reach `least`, with trials that are alike:
    differences between them in pressure and B take up what a model lacks, and n is meaningless then. From there trials
    may differ again, if a few steps of that lead near the tracks.
    """
    solution = solve(predictor, problem, state, fixed_terms, least=least, **how)
    if least > -math.inf or fixed_terms.spread is not None or not is_poor_fit(solution):
        return solution
    try:
        alike = solve(predictor, problem, state, replace(fixed_terms, spread=ALIKE), **how)
        differing = replace(alike.state, spread=state.spread)
        solution = solve(predictor, problem, differing, fixed_terms, most_iterations=STEPS_TO_TELL)
        if is_poor_fit(solution):
            return alike
        return solve(predictor, problem, solution.state, fixed_terms, **how)
    except SimulationError:
        return solution


def solve_onward(
    predictor: Predictor, before: Solution, theta: Floats, fixed_terms: FixedTerms, **how: Any
) -> Solution:
    """Solve from given parameters and the trial effects, noise and standard deviations of a previous solution; `how`
    are options of `_solve_or_alike`.
    """
    problem = replace(
        make_problem(predictor, before.state.trial_effects), release_origin_mean=before.problem.release_origin_mean
    )
    return _solve_or_alike(predictor, problem, replace(before.state, theta=theta), fixed_terms, **how)
