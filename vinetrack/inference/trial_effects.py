"""Effects of single trials, release, origin and deviations, brought to their best; releases looked for elsewhere.

The release, the origin and the deviations of a trial trade against each other, so that its misfit has a minimum in more
than one place: by far where no frame shows it at rest, and where a vine begins so slowly that its first frames hardly
differ from rest. A trajectory depends on the time since release alone, so one simulation, shifted, tells the misfit of
every release.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.inference.fit_data import FitTrial
from vinetrack.inference.mixed_effects import (
    FitState,
    MixedProblem,
    trial_effect_penalty,
    trial_effect_prior,
    trial_effect_step,
)
from vinetrack.inference.part_of_trials import parameters_of_trials, subset_predictor, subset_problem, subset_state
from vinetrack.inference.release_kernels import products_at_releases
from vinetrack.inference.sensitivity import (
    DAMPING_DEVIATION,
    N_TRIAL_EFFECTS,
    ORIGIN,
    PRESSURE,
    RELEASE,
    Predictor,
)
from vinetrack.inference.trajectory_jobs import Job
from vinetrack.inference.whitening import at_correlation, whiten

LARGEST_DEVIATION_STEP = 0.3
"""Largest step and largest size of a trial's deviation of pressure and ln B, and the largest step of its release,
frames. Chosen as trust region: beyond, a linear answer says little; spreads above are bounded much earlier."""

LARGEST_DEVIATION = 0.9
"""Chosen: a pressure or B off by 90 % is a fault of the sheet, not a deviation. At half such faults hold the fit at the
limit, at twice exp(1.8) multiplies B by six."""

LARGEST_RELEASE_STEP_FRAMES = 2.0
"""Chosen with the two above as a trust region; at half releases take more steps, at twice they overshoot."""


def optimise_trial_effects(
    predictor: Predictor, problem: MixedProblem, state: FitState, most: float = math.inf
) -> tuple[FitState, Floats]:
    """The trials' own numbers brought to their best for the others, and the costs there.

    They are known so well that a step of the shared numbers leaves the valley by its curvature alone. Every trial
    takes what serves it best: where a release meets a frame, the cost has a corner at which no full step helps.

    Parameters
    ----------
    predictor : of the trials to fit.
    problem : what does not change during the fit.
    state : where the fit stands.
    most : float
        Sum of the costs that is of use: where linear answers promise no less, no better place is looked for.

    Returns
    -------
    state : FitState
    costs : array, shape (n_trials,)
    """
    columns = predictor.linearise(state.theta, state.trial_effects, trial_effects_only=True)
    cross_products = predictor.products(columns)
    steps = [
        trial_effect_step(cross_products, problem, state, fixed_release=fixed_release)
        for fixed_release in (False, True)
    ]
    here = trial_costs(predictor, problem, state, residuals_in(columns))
    if float(np.sum(here - _promised(cross_products, problem, state, steps[0]))) >= most:
        return state, here
    moved = [limited_step(predictor, state.trial_effects, step) for step in steps]
    ways = [state, *(replace(state, trial_effects=trial_effects) for trial_effects in moved)]
    there = zip(ways[1:], predictor.residuals_of_each(state.theta, moved), strict=True)
    costs = np.array([here, *(trial_costs(predictor, problem, way, left_m) for way, left_m in there)])
    best = np.argmin(costs, axis=0)
    trial_effects = np.array([ways[way].trial_effects[i] for i, way in enumerate(best)])
    return replace(state, trial_effects=trial_effects), np.min(costs, axis=0)


def _promised(cross_products: Floats, problem: MixedProblem, state: FitState, step: Floats) -> Floats:
    """By how much a step of each trial's own numbers to their linear best lowers its cost, shape (n_trials,)."""
    centre, precision = trial_effect_prior(problem, state)
    told = at_correlation(cross_products[:, :, :N_TRIAL_EFFECTS, -1:], state.rho)[:, :, 0] / state.variance[:, None]
    return np.asarray(np.sum(step * (told - precision * (state.trial_effects - centre)), axis=1))


def limited_step(predictor: Predictor, trial_effects: Floats, step: Floats) -> Floats:
    """Own numbers after a step: the release moves by two frames at most, a deviation by 0.3.

    Parameters
    ----------
    predictor : of the trials to fit.
    trial_effects : array, shape (n_trials, 4)
        Before the step.
    step : array, shape (n_trials, 4)

    Returns
    -------
    array, shape (n_trials, 4)
    """
    reach = LARGEST_RELEASE_STEP_FRAMES * np.array([trial_data.frame_s for trial_data in predictor.data])
    moved = trial_effects + step
    moved[:, RELEASE] = trial_effects[:, RELEASE] + np.clip(step[:, RELEASE], -reach, reach)
    deviations = [PRESSURE, DAMPING_DEVIATION]
    stride = np.clip(step[:, deviations], -LARGEST_DEVIATION_STEP, LARGEST_DEVIATION_STEP)
    moved[:, deviations] = np.clip(trial_effects[:, deviations] + stride, -LARGEST_DEVIATION, LARGEST_DEVIATION)
    return moved


@np.errstate(over="ignore", invalid="ignore")  # of a step far off: see `whitening`
def trial_costs(
    predictor: Predictor, problem: MixedProblem, state: FitState, residuals: Sequence[Floats] | None = None
) -> Floats:
    """Whitened sum of squares of every trial with what the priors of its own numbers add, shape (n_trials,).

    Parameters
    ----------
    predictor : of the trials to fit.
    problem : what does not change during the fit.
    state : where the fit stands.
    residuals : sequence of arrays, shape (n_points,), m, optional
        What is left of each trial there, where it is known: then nothing is simulated.

    Returns
    -------
    array, shape (n_trials,)
    """
    if residuals is None:
        residuals = predictor.residuals(state.theta, state.trial_effects)
    white = whiten(np.concatenate(residuals), predictor.first, state.rho, predictor.relative_sd)
    squares = [np.sum(of_trial) for of_trial in predictor.by_trial(white**2)]
    return np.array(squares) / state.variance + trial_effect_penalty(problem, state)


def residuals_in(columns: Sequence[Floats]) -> list[Floats]:
    """The residuals among the columns of a linear form: what is known there need not be simulated again.

    Parameters
    ----------
    columns : sequence of arrays, shape (n_points, k), m
        From `Predictor.linearise`.

    Returns
    -------
    list of arrays, shape (n_points,), m
    """
    return [np.ascontiguousarray(column[:, -1]) for column in columns]


RELEASES = 60
"""Releases tried for a trial seen only in motion. Chosen for time; the best is improved by Newton steps afterwards."""

NEAR_FRAMES = np.concatenate([np.arange(-14.0, 15.0), [-0.6, -0.3, -0.12, -0.05, 0.05, 0.12, 0.3, 0.6]])
"""Where else the release of a trial may be that was seen at rest, from where it is held to be. Close by, it may lie on
the other side of a frame at which the edge jumps. Chosen: slow starts seen at rest were off by up to nine frames;
fractions resolve a frame."""

GRID_POINTS = 600
"""Points of the grid on which a trajectory is shifted. Derived: linear interpolation then errs by less than 1e-6 of
the travel."""

WORTH_MOVING = 0.5
"""Fall of a trial's −2 ln L for which its release jumps to another minimum. Derived: 0.5 of −2 ln L is 0.7 standard
errors; less is left to the next step."""

HARDLY_MISSED = 30.0
"""Times the variance of its noise by which a trial may be missed for its release to be looked for. Chosen for time: a
trial missed by more is not helped by its release alone."""

IMPROVED = 3
"""Steps in which a trial settles at another release before it is held against where it was. Chosen: Newton steps of
four numbers settle in two or three."""

STEPS = np.array([-np.inf, -0.3, -0.3]), np.array([np.inf, 0.3, 0.3])
"""Least and largest change of origin and deviations."""

DAMPING_STEP, PRESSURE_STEP = 1e-2, 1e-2
"""Steps of pressure and ln B for differences. Derived: 1 % moves a trajectory ten thousand times the integrator's
error and bends it by 1e-4."""


LED_BACK = 0.25
"""Part of a jump to within which steps have led back to where it began. Chosen: steps that go round in a circle come
back to a tenth and less. At half some circles are not seen, at twice trials that settle between are bound to what is
missed least."""

SAME_NUMBERS = 1e-3
"""Largest change of a shared number, scaled, at which it is the same. Chosen: a tenth of a per cent of B, far below its
error. At half circles are seen a step later, at twice a step still under way may count as one."""


class ReleaseSearch:
    """Releases looked for elsewhere during a fit, and what its steps made of those that were taken.

    A release is taken where a trial is likelier with its own numbers integrated out. The steps of a fit lower what is
    missed at the best numbers, and lead back where the volume of the likelihood alone spoke for a release; from then on
    such a trial jumps only to where less is missed as well. Else steps and searches go round in a circle.
    """

    def __init__(self, predictor: Predictor, problem: MixedProblem) -> None:
        self.predictor, self.problem = predictor, problem
        self.returned = np.zeros(len(predictor.data), dtype=bool)
        self.jumped_from = self.jumped_to = np.zeros(len(predictor.data))
        self.numbers = np.full((len(predictor.data), problem.prior_mean.size), np.nan)

    def likelier(self, state: FitState, residuals: Sequence[Floats]) -> FitState | None:
        """The state with likelier releases; None if none is.

        Trials into which the pressure was let while it was recorded are left alone, since the trace tells when, and
        those seen at rest that are missed by far more than noise: another release would make up for something else.

        Parameters
        ----------
        state : where the fit stands.
        residuals : sequence of arrays, shape (n_points,), m
            What is left of each trial there.

        Returns
        -------
        FitState or None
        """
        release_s = state.trial_effects[:, RELEASE]
        back = np.abs(release_s - self.jumped_from) < LED_BACK * np.abs(self.jumped_to - self.jumped_from)
        # Where the shared numbers have moved since, it is they that led there.
        self.returned |= back & (np.max(np.abs(state.theta - self.numbers), axis=1, initial=0.0) < SAME_NUMBERS)
        tried = self._likelier(state, residuals)
        kept = state if tried is None else self._borne_out(state, tried)
        jumped_s = kept.trial_effects[:, RELEASE]
        jumps = jumped_s != release_s
        self.jumped_from = np.where(jumps, release_s, self.jumped_from)
        self.jumped_to = np.where(jumps, jumped_s, self.jumped_to)
        self.numbers[jumps] = state.theta
        return None if np.array_equal(kept.trial_effects, state.trial_effects) else kept

    def _likelier(self, state: FitState, residuals: Sequence[Floats]) -> FitState | None:
        """The state with each trial at its likeliest release in a linear answer; None where no trial would move."""
        predictor, problem = self.predictor, self.problem
        missed = trial_costs(predictor, problem, state, residuals) * state.variance
        missed /= (1 - state.rho**2) * problem.points
        places = [
            i
            for i, trial_data in enumerate(predictor.data)
            if not trial_data.pressurised_in_recording
            and (not trial_data.shows_rest or missed[i] < HARDLY_MISSED * trial_data.noise_m**2)
        ]
        if not places:
            return None
        plain = predictor.jobs(state.theta, state.trial_effects)
        releases = [_releases(predictor.data[i], float(state.trial_effects[i, RELEASE])) for i in places]
        answers = _answers(predictor, [plain[i] for i in places], releases)
        trial_effects = state.trial_effects.copy()
        centre, precision = trial_effect_prior(problem, state)
        claimed = False
        for i, tried_s, answer in zip(places, releases, answers, strict=True):
            noise = state.rho, float(state.variance[i])
            there, gain = _best(predictor.data[i], trial_effects[i], (centre[i], precision[i]), noise, tried_s, *answer)
            if gain > WORTH_MOVING:
                trial_effects[i], claimed = there, True
        return replace(state, trial_effects=trial_effects) if claimed else None

    def _borne_out(self, state: FitState, tried: FitState) -> FitState:
        """Of both the own numbers that fit a trial better, once those tried have settled: lines are not straight.

        Trials that are not tried elsewhere stay as they are.
        """
        rows = np.flatnonzero((tried.trial_effects != state.trial_effects).any(axis=1))
        predictor, problem, before = self.predictor, self.problem, state
        if rows.size < len(predictor.data) and predictor.divisible:
            places = parameters_of_trials(predictor.layout, rows)
            predictor = subset_predictor(predictor, rows, places)
            problem = subset_problem(problem, predictor.layout, rows, places)
            before, tried = (subset_state(each, rows, places) for each in (state, tried))
        else:
            rows = np.arange(len(predictor.data))
        for _ in range(IMPROVED):
            tried = optimise_trial_effects(predictor, problem, tried)[0]
        better = _levels(predictor, problem, tried) < _levels(predictor, problem, before) - WORTH_MOVING
        if self.returned[rows].any():
            lower = trial_costs(predictor, problem, tried) < trial_costs(predictor, problem, before)
            better &= lower | ~self.returned[rows]
        trial_effects = state.trial_effects.copy()
        trial_effects[rows[better]] = tried.trial_effects[better]
        return replace(state, trial_effects=trial_effects)


def _levels(predictor: Predictor, problem: MixedProblem, state: FitState) -> Floats:
    """−2 ln L of every trial with its own numbers integrated out about where they stand, shape (n_trials,)."""
    columns = predictor.linearise(state.theta, state.trial_effects, trial_effects_only=True)
    white = at_correlation(predictor.products(columns), state.rho)
    square = white[:, :N_TRIAL_EFFECTS, :N_TRIAL_EFFECTS] / state.variance[:, None, None]
    precision = trial_effect_prior(problem, state)[1]
    log_volume = np.linalg.slogdet(square + precision[:, :, None] * np.eye(N_TRIAL_EFFECTS))[1]
    return np.asarray(trial_costs(predictor, problem, state, residuals_in(columns)) + log_volume)


def _best(
    trial_data: FitTrial,
    trial_effects: Floats,
    prior: tuple[Floats, Floats],
    noise: tuple[float, float],
    releases: Floats,
    times: Floats,
    plain: Floats,
    answers: Floats,
) -> tuple[Floats, float]:
    """The own numbers of one trial at its likeliest release, and the fall of −2 ln L from the last of the releases.

    `prior` are centre and precision of its own numbers, `noise` the correlation and the variance of the innovations.
    """
    centre, precision = prior
    rho, variance = noise
    relative = trial_data.point_sd
    position_m = trial_data.lead_position_m - trial_effects[ORIGIN]
    curves = np.vstack([answers, plain])
    square = (
        products_at_releases(trial_data.time_s, position_m, trial_data.first, relative, releases, times, curves, rho)
        / variance
    )
    tried = np.tile(trial_effects, (releases.size, 1))
    tried[:, RELEASE] = releases
    inner = square[:, :-1, :-1] + np.diag(precision)
    known, told = square[:, ORIGIN:-1, ORIGIN:-1], square[:, ORIGIN:-1, -1]
    slope = told - (precision * (tried - centre))[:, ORIGIN:]
    step = np.clip(np.linalg.solve(inner[:, ORIGIN:, ORIGIN:], slope[..., None])[..., 0], *STEPS)
    tried[:, ORIGIN:] += step
    left = square[:, -1, -1] - np.sum(step * (2 * told - (known @ step[..., None])[..., 0]), axis=1)
    levels = left + np.sum(precision * (tried - centre) ** 2, axis=1) + np.linalg.slogdet(inner)[1]
    k = int(np.argmin(levels))
    return tried[k], float(levels[-1] - levels[k])


def _releases(trial_data: FitTrial, release_s: float) -> Floats:
    """Where the release of a trial may be, s, shape (n,); the last is where it is held to be."""
    if trial_data.shows_rest:
        return np.append(release_s + trial_data.frame_s * NEAR_FRAMES, release_s)
    duration_s = float(trial_data.time_s[-1] - trial_data.time_s[0])
    return np.append(trial_data.time_s[0] - np.geomspace(0.1 * trial_data.frame_s, duration_s, RELEASES), release_s)


def _answers(
    predictor: Predictor, plain: Sequence[Job], releases: Sequence[Floats]
) -> list[tuple[Floats, Floats, Floats]]:
    """Of every trial other instants since release, shape (n,), positions there, and how they answer to its own numbers.

    Answers have shape (4, n), zero where it does not feel one. A recorded pressure is moved along with the release, as
    if it had been recorded that much later: a settled trace hardly differs, and what is taken is simulated as it was.
    """
    jobs: list[Job] = []
    moves: list[tuple[int, float]] = []
    grids: list[Floats] = []
    for job, tried_s in zip(plain, releases, strict=True):
        i = job.trial
        ways = [((-1, 0.0), job)]
        if predictor.has_pressure_deviation[i]:
            deviation = job.pressure_deviation + PRESSURE_STEP
            ways.append(((PRESSURE, PRESSURE_STEP), job._replace(pressure_deviation=deviation)))
        if predictor.has_damping_deviation[i]:
            row = job.row.copy()
            row[predictor.damping_column] *= np.exp(DAMPING_STEP)
            ways.append(((DAMPING_DEVIATION, DAMPING_STEP), job._replace(row=row)))
        longest_s = float(predictor.data[i].time_s[-1] - tried_s.min())
        for move, varied in ways:
            moves.append(move)
            jobs.append(varied)
            grids.append(longest_s * np.linspace(0.0, 1.0, GRID_POINTS) ** 1.5)
    answers_found: list[tuple[Floats, Floats, Floats]] = []
    instants = [job.release_s + times for job, times in zip(jobs, grids, strict=True)]
    for (place, step), times, moved in zip(moves, grids, predictor.run(jobs, times_s=instants), strict=True):
        y = moved.observed_position_m
        if place < 0:
            answers = np.zeros((N_TRIAL_EFFECTS, times.size))
            answers[RELEASE] = -np.gradient(y, times)
            answers[ORIGIN] = 1.0
            answers_found.append((times, y, answers))
        else:
            answers_found[-1][2][place] = (y - answers_found[-1][1]) / step
    return answers_found
