"""The iterations of a fit: new trajectories, new spreads and noise, one damped Newton step, until nothing moves."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.inference.fit_data import FitTrial
from vinetrack.inference.mixed_effects import (
    FitState,
    MixedProblem,
    estimate_noise,
    estimate_spreads,
    marginal,
    newton_step,
    shared_penalty,
)
from vinetrack.inference.release_search import search_releases
from vinetrack.inference.sensitivity import Predictor
from vinetrack.inference.starts import initial_trial_effects
from vinetrack.inference.trial_effects import follow_trial_effects, limited, trial_costs
from vinetrack.inference.whitening import at_correlation

MOST_ITERATIONS = 60
"""Chosen as a safeguard against creeping; a fit that reaches it says that it has not settled."""

SETTLED_DECREASE = 1e-2
"""A step that promises less than this of −2 ln L moves every number by under a twentieth of its error. Derived: −2 ln
L of 0.01 is 0.1 standard errors for all numbers together."""

SETTLED_SPREAD = 0.02
"""Relative change of spreads and noise that counts as settled. Chosen: errors follow to 2 %; half costs one or two
iterations, twice moves intervals by 4 %."""

NEARLY_SETTLED, PATIENCE, MOST_LOOKS = 3.0, 4, 8
"""Where a step promises less, or after so many steps, releases that no frame at rest shows are looked for elsewhere: a
step only creeps along such a valley. So often at most. Chosen for time: the search of releases costs as much as four
steps."""

EARLY_ITERATIONS, MOST_EARLY, FAR_OFF = 3, 9, 1e3
"""Spreads and the correlation of the noise stay those first assumed for three steps, and on while a step still
promises more than this of −2 ln L: what is only not yet fitted must not pass for noise or scatter. Chosen: a start
misses by less than that after three steps, or needs more; at half the spreads soak up what the first steps have not
fitted yet."""

FIRST_SPREADS = (0.01, 0.03)
"""Chosen as a usual batch of vines: one per cent of pressure and three of B."""

EXACT_PART = 2e-6
"""Least noise, as part of a trial's travel: the integrator is no better. Measured: the integrator errs by at most 7e-7
(benchmarks/integrator.py)."""

RELEASE_ROOM_FRAMES, ORIGIN_ROOM_SIGMAS = 10.0, 10.0
"""Where the rest is seen it says of release and origin what it says through its points, a hundred times less a second
time: that only counts where a wrong model would drag both along. Chosen: ten standard deviations make the prior a
hundredth of what the frames say."""

KNOWN_RELEASE_S = 1e-6
"""The release of a vine whose pressure was let in while it was recorded: nothing to find. Chosen far below any
frame."""

SHORTER, MOST_DAMPED = (1.0, 0.4, 0.15), 11
"""Parts of a step that are tried, and how often it is damped further if none of them helps. Chosen: a line search in
factors of about 0.4, then damping in factors of ten."""

FEWEST_TO_SPARE = 3
"""A spread is estimated where this many more trials feel it than there are numbers without a prior. Chosen: with fewer
degrees of freedom a variance is known to worse than a factor of two."""


@dataclass(frozen=True)
class FixedTerms:
    """What a fit is told instead of finding it: spreads of pressure and B, correlation and variances of the noise.

    `correlation` alone leaves the size of the noise to be found: what a model misses then counts as noise, but not as
    slow noise, which could explain anything.
    """

    spread: tuple[float, float] | None = None
    noise: tuple[float, Floats] | None = None
    correlation: float | None = None


@dataclass(frozen=True)
class Solution:
    """Where the iterations ended. `grams` and `columns` belong to `state`, see `whitened` and `sensitivity`."""

    state: FitState
    problem: MixedProblem
    grams: Floats
    columns: tuple[Floats, ...]
    estimable: tuple[bool, bool]
    converged: bool
    iterations: int


@dataclass(frozen=True)
class Step:
    """Where the iterations are: the numbers, SI, by name, and by how much the step just found lowers −2 ln L.

    Smooth errors of position (`vinetrack.inference.position_errors`) are fitted after the last step, and move the
    numbers that the fit reports.
    """

    iteration: int
    values: Mapping[str, float]
    promised: float


Watch = Callable[[Step], None]
"""Told of every step; what it raises ends the fit."""


def make_problem(predictor: Predictor, trial_effects: Floats) -> MixedProblem:
    """What stays the same during the iterations; `own` holds the first guess of releases and origins."""
    layout, data = predictor.layout, predictor.data
    lower, upper = layout.bounds
    durations = np.array([trial_data.time_s[-1] - trial_data.time_s[0] for trial_data in data])
    spans = np.array([np.ptp(trial_data.lead_position_m) for trial_data in data])
    frames = np.array([trial_data.frame_s for trial_data in data])
    rests = np.array([trial_data.shows_rest for trial_data in data])
    known = rests | np.array([trial_data.let_in for trial_data in data])
    vague = np.array([0.0 if trial_data.vague_rest is None else trial_data.vague_rest.sigma_m for trial_data in data])
    release_sd = np.where(rests, RELEASE_ROOM_FRAMES * frames, 3 * durations)
    release_sd[[trial_data.let_in for trial_data in data]] = KNOWN_RELEASE_S
    noise = np.array([trial_data.noise_m for trial_data in data])
    room = np.maximum(ORIGIN_ROOM_SIGMAS * np.maximum(noise, vague), 1e-4 * spans)
    origin_sd = np.where(rests, room, 3 * spans)
    return MixedProblem(
        index=layout.index,
        feels=np.column_stack([predictor.feels_pressure, predictor.feels_damping]),
        gauge_error=np.array([trial_data.gauge_error for trial_data in data]),
        own_centre=np.where(known[:, None], initial_trial_effects(data)[:, :2], trial_effects[:, :2]),
        own_precision=np.column_stack([1 / release_sd**2, 1 / origin_sd**2]),
        prior_mean=layout.start,
        prior_precision=layout.prior_precision,
        lower=lower,
        upper=upper,
        free=np.ones(lower.size, dtype=bool),
        points=np.array([float(trial_data.time_s.size) for trial_data in data]),
        stretches=np.array([float(np.count_nonzero(trial_data.first)) for trial_data in data]),
        random=layout.random if layout.between else None,
    )


def first_state(data: Sequence[FitTrial], theta: Floats, trial_effects: Floats) -> FitState:
    """A state to begin from: noise of the tracks alone, spreads as the sheet and experience say."""
    rho = track_correlation(data)
    variance = np.array([trial_data.noise_m**2 * (1 - trial_data.correlation**2) for trial_data in data])
    return FitState(theta, trial_effects, stated_spreads(data), rho, np.maximum(variance, floor(data)))


def track_correlation(data: Sequence[FitTrial]) -> float:
    """Lag-one correlation of the noise as the tracks alone show it."""
    return float(
        np.average(
            [trial_data.correlation for trial_data in data], weights=[trial_data.time_s.size for trial_data in data]
        )
    )


def stated_spreads(data: Sequence[FitTrial]) -> tuple[float, float]:
    """Spread of pressure that the sheet states, and 3 % for B."""
    relative = [
        trial_data.trial.pressure_sigma_Pa / trial_data.trial.pressure_Pa
        for trial_data in data
        if trial_data.trial.pressure_Pa > 0 and np.isfinite(trial_data.trial.pressure_sigma_Pa)
    ]
    return (float(np.mean(relative)) if relative else FIRST_SPREADS[0]), FIRST_SPREADS[1]


def floor(data: Sequence[FitTrial]) -> Floats:
    """Least variance of a position that the integrator can answer for, m², shape (n_trials,)."""
    return np.array([(EXACT_PART * np.ptp(trial_data.lead_position_m)) ** 2 for trial_data in data])


def estimable(problem: MixedProblem) -> tuple[bool, bool]:
    """Whether there are trials enough to estimate the spread of pressure, and that of B."""
    needed = np.count_nonzero(problem.prior_precision == 0) + FEWEST_TO_SPARE
    varied = problem.feels & np.column_stack([problem.gauge_error == 0, np.ones(problem.gauge_error.size, dtype=bool)])
    pressure, damping = (bool(np.count_nonzero(varied[:, k]) >= needed) for k in range(2))
    return pressure, damping


def solve(
    predictor: Predictor,
    problem: MixedProblem,
    state: FitState,
    held: FixedTerms | None = None,
    *,
    warm: bool = False,
    most_iterations: int = MOST_ITERATIONS,
    watch: Watch | None = None,
) -> Solution:
    """Iterate to the end. `warm` says that the state is near it already.

    Raises
    ------
    SimulationError
        If the trajectories of the start cannot be followed.
    """
    held = held or FixedTerms()
    can = (False, False) if held.spread is not None else estimable(problem)
    if held.spread is not None:
        state = replace(state, spread=held.spread)
    if held.noise is not None:
        state = replace(state, rho=held.noise[0], variance=held.noise[1])
    if held.correlation is not None:
        state = replace(state, rho=held.correlation)
    damping, converged, iteration, promised = (0.0 if warm else 1e-3), False, 0, math.inf
    early = not warm
    columns, grams = _about(predictor, state)
    looks, looked, in_vain = MOST_LOOKS, 0, False
    for iteration in range(1, most_iterations + 1):
        near = promised < FAR_OFF or iteration > MOST_EARLY
        search = early and iteration > EARLY_ITERATIONS and near
        early = early and not search
        before = state
        state = _update_variances(predictor, problem, grams, state, can, held, early=early, search=search)
        moved = variances_moved(before, state)
        step, own_change, promised = newton_step(grams, problem, state, damping)
        if watch is not None:
            watch(_step_report(predictor, state, iteration, promised))
        settled = promised < SETTLED_DECREASE
        if looks and (settled or (promised < NEARLY_SETTLED and not in_vain) or iteration >= looked + PATIENCE):
            looked, in_vain = iteration, True
            jumped = search_releases(predictor, problem, state)
            if jumped is not None:
                state, (columns, grams) = jumped, _about(predictor, jumped)
                looks, in_vain = looks - 1, False
                continue
            looks = 0 if settled else looks
        if settled and moved < SETTLED_SPREAD and not early:
            converged = True
            break
        taken, damping = _take_step(predictor, problem, grams, state, step, own_change, damping)
        if taken is None:
            # No step helps: a corner of the cost, where a frame meets the end of growth. It is as low as it gets.
            converged = moved < SETTLED_SPREAD
            if converged:
                break
            continue
        try:
            columns, grams = _about(predictor, taken)
        except SimulationError:
            # A neighbour of the new place cannot be followed: what was reached before is worth more than nothing.
            break
        state = taken
    return Solution(state, problem, grams, tuple(columns), can, converged, iteration)


def _about(predictor: Predictor, state: FitState) -> tuple[list[Floats], Floats]:
    """Sensitivities at a state, and their sums of products."""
    columns = predictor.linearise(state.theta, state.trial_effects)
    return columns, predictor.products(columns)


def _step_report(predictor: Predictor, state: FitState, iteration: int, promised: float) -> Step:
    values = predictor.layout.values(state.theta).tolist()
    return Step(iteration, dict(zip([number.name for number in predictor.layout.free], values, strict=True)), promised)


def chi2_per_dof(predictor: Predictor, solution: Solution) -> float:
    """What the model leaves against the noise that the tracks show alone, of their correlation; NaN if none do."""
    data = predictor.data
    rho = track_correlation(data)
    noise = np.array([trial_data.noise_m**2 for trial_data in data]) * (1 - rho**2)
    if not (noise > 0).all():
        return math.nan
    left = at_correlation(solution.grams, rho)[:, -1, -1]
    taken = np.count_nonzero(solution.problem.free) / left.size + 2 + solution.problem.feels.any(axis=1)
    return float(np.sum(left / noise) / np.sum(np.maximum(solution.problem.points - taken, 1.0)))


def _update_variances(
    predictor: Predictor,
    problem: MixedProblem,
    grams: Floats,
    state: FitState,
    can: tuple[bool, bool],
    held: FixedTerms,
    *,
    early: bool,
    search: bool,
) -> FitState:
    """Noise and spreads anew; while the trajectories are still far off only the size of what is left."""
    if held.noise is None:
        known = state.rho if early or held.correlation is not None else None
        rho, variance = estimate_noise(grams, problem, state, known)
        state = replace(state, rho=rho, variance=np.maximum(variance, floor(predictor.data)))
    if not early and any(can):
        spread = estimate_spreads(marginal(grams, problem, state), problem, state, can, search=search)
        state = replace(state, spread=spread)
    return state


def variances_moved(before: FitState, after: FitState) -> float:
    """Largest relative change among spreads and noise; spreads below a thousandth count as none."""
    spreads = [abs(np.log((b + 1e-3) / (a + 1e-3))) for a, b in zip(before.spread, after.spread, strict=True)]
    noise = np.max(np.abs(np.log(after.variance / before.variance)))
    return float(max(*spreads, noise, abs(after.rho - before.rho)))


def _take_step(
    predictor: Predictor,
    problem: MixedProblem,
    grams: Floats,
    state: FitState,
    step: Floats,
    own_change: Floats,
    damping: float,
) -> tuple[FitState | None, float]:
    """The first of ever shorter, then ever more damped steps that lowers the sum of squares, and the damping to go on.

    A step too long for a curved valley is right in its direction, which damping would turn across the valley.
    """
    now = cost(predictor, problem, state)
    for part in SHORTER:
        tried = _tried(predictor, problem, state, part * step, part * own_change, now)
        if tried is not None:
            return tried, damping * 0.1 if damping > 1e-6 else 0.0
    for _ in range(MOST_DAMPED):
        damping = max(10 * damping, 1e-4)
        step, own_change, _ = newton_step(grams, problem, state, damping)
        tried = _tried(predictor, problem, state, step, own_change, now)
        if tried is not None:
            return tried, damping * 0.1
    return None, 0.0


def _tried(
    predictor: Predictor, problem: MixedProblem, state: FitState, step: Floats, own_change: Floats, now: float
) -> FitState | None:
    """The state after a step, if that lowers the sum of squares."""
    theta = np.clip(state.theta + step, problem.lower, problem.upper)
    try:
        there = replace(state, theta=theta, trial_effects=limited(predictor, state.trial_effects, own_change))
        there, costs = follow_trial_effects(predictor, problem, there)
    except SimulationError:
        return None
    return there if float(np.sum(costs)) + shared_penalty(problem, there) < now else None


def cost(predictor: Predictor, problem: MixedProblem, state: FitState) -> float:
    """Whitened sum of squares of all trials with what the priors add."""
    return float(np.sum(trial_costs(predictor, problem, state))) + shared_penalty(problem, state)


__all__ = ["FixedTerms", "Solution", "Step", "Watch", "cost", "estimable", "first_state", "make_problem", "solve"]
