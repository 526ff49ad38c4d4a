"""Estimates of the trial effects at given parameters, and a global search for the release of each trial.

Release, origin and deviations of a trial are correlated, so that its misfit may have several local minima: above all
where no frame shows it at rest, and where a vine starts so slowly that its first frames hardly differ from rest. Since
a trajectory depends only on the time since release, one simulation, shifted in time, gives the misfit of every release.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.inference.fit_data import FitTrial
from vinetrack.inference.gaussian_processes import whiten
from vinetrack.inference.marginal_likelihood import (
    FitState,
    MixedProblem,
    trial_effect_prior,
    trial_effect_step,
    whitened_products,
    with_diagonal,
)
from vinetrack.inference.sensitivity import (
    DAMPING_DEVIATION,
    N_TRIAL_EFFECTS,
    ORIGIN,
    PRESSURE,
    RELEASE,
    Jobs,
    Predictor,
)

# ------------------------------------------------------------------------------
# Restriction of a fit to a subset of its trials: free parameters, predictor, state and problem.


def subset(
    predictor: Predictor, problem: MixedProblem, rows: NDArray[np.int_], *states: FitState
) -> tuple[Predictor, MixedProblem, list[FitState]]:
    """Predictor, with the finite-difference steps of the other, problem and states of some trials and of the parameters
    that apply to one of them; names, scales and priors are unchanged.
    """
    whole = predictor.layout
    places = np.unique(whole.index[rows])
    places = places[places >= 0]
    new_index = np.full(len(whole.free) + 1, -1)
    new_index[places] = np.arange(places.size)
    index = new_index[whole.index[rows]]
    columns = np.flatnonzero((index >= 0).any(axis=0))
    layout = replace(
        whole,
        free=tuple(whole.free[place] for place in places),
        keys=tuple(whole.keys[column] for column in columns),
        index=index[:, columns].astype(int),
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


LARGEST_DEVIATION = 0.9  # Largest deviation of pressure and ln B (chosen)


def optimise_trial_effects(predictor: Predictor, problem: MixedProblem, state: FitState) -> tuple[FitState, Floats]:
    """One Gauss–Newton step of the trial effects at fixed parameters, and the resulting cost of each trial. The trial
    effects are determined so precisely that a step of the shared parameters leaves the curved valley; this step returns
    to it. Returns state, costs. Shape (n_trials,).
    """
    columns = predictor.linearise(state.theta, state.trial_effects, trial_effects_only=True)
    step = trial_effect_step(predictor.products(columns), problem, state)
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
    """Penalised sum of squares of each trial: its whitened residuals plus the priors of its effects. Shapes: residuals
    (n_points_of_all,) → (n_trials,).
    """
    if residuals is None:
        residuals = predictor.residuals(state.theta, state.trial_effects)
    white = whiten(residuals, predictor.first, state.rho, predictor.relative_sd)
    squares = np.add.reduceat(white**2, predictor.starts[:-1])
    centre, precision = trial_effect_prior(problem, state)
    return np.asarray(squares / state.variance + np.sum(precision * (state.trial_effects - centre) ** 2, axis=1))


def residuals_in(columns: Sequence[Floats]) -> Floats:
    """The residuals among the columns of a linearisation, of all trials. Shapes: columns (n_points, k) →
    (n_points_of_all,).
    """
    return np.concatenate([column[:, -1] for column in columns])


LEAST_DECREASE = 0.5  # Decrease of a trial's −2 ln L for which its release jumps to another minimum (derived)


def likelier_releases(predictor: Predictor, problem: MixedProblem, state: FitState) -> FitState | None:
    """The state with releases at which the trials' likelihoods, their effects integrated out, are higher; None if there
    are none. They are proposed by the linear model, and kept where they remain better after a few steps on simulated
    trajectories. Of trials pressurised during the recording the trace shows the release.
    """
    places = [i for i, trial_data in enumerate(predictor.data) if not trial_data.pressurised_in_recording]
    if not places:
        return None
    releases = [_candidate_releases(predictor.data[i], float(state.trial_effects[i, RELEASE])) for i in places]
    jobs = predictor.jobs(state.theta, state.trial_effects)[places]
    trial_effects, (centre, precision) = state.trial_effects.copy(), trial_effect_prior(problem, state)
    for i, candidates_s, sensitivity in zip(
        places, releases, _release_sensitivities(predictor, jobs, releases), strict=True
    ):
        noise = state.rho, float(state.variance[i])
        effects, gain = _best_release(
            predictor.data[i], trial_effects[i], (centre[i], precision[i]), noise, candidates_s, *sensitivity
        )
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
    better = (
        _trial_deviances(predictor, problem, proposed) < _trial_deviances(predictor, problem, current) - LEAST_DECREASE
    )
    trial_effects = state.trial_effects.copy()
    trial_effects[rows[better]] = proposed.trial_effects[better]
    return replace(state, trial_effects=trial_effects) if better.any() else None


def _trial_deviances(predictor: Predictor, problem: MixedProblem, state: FitState) -> Floats:
    """−2 ln L of each trial, its effects integrated out by the Laplace approximation, shape (n_trials,)."""
    columns = predictor.linearise(state.theta, state.trial_effects, trial_effects_only=True)
    square = whitened_products(predictor.products(columns), state)[:, :N_TRIAL_EFFECTS, :N_TRIAL_EFFECTS]
    log_volume = np.linalg.slogdet(with_diagonal(square, trial_effect_prior(problem, state)[1]))[1]
    return np.asarray(trial_costs(predictor, problem, state, residuals_in(columns)) + log_volume)


def _best_release(
    trial_data: FitTrial,
    trial_effects: Floats,
    prior: tuple[Floats, Floats],
    noise: tuple[float, float],
    releases: Floats,
    times: Floats,
    plain: Floats,
    sensitivities: Floats,
) -> tuple[Floats, float]:
    """Effects of one trial at its likeliest release, and the decrease of −2 ln L from the last of the releases. `prior`
    are mean and precision of its effects, `noise` the correlation and the variance of the innovations.
    """
    centre, precision = prior
    rho, variance = noise
    # Sensitivities and residual at every point for each release, shape (n_points, n_releases, 5), and whitened
    place = np.interp(trial_data.time_s[:, None] - releases, times, np.arange(times.size))
    before, curves = np.minimum(place.astype(int), times.size - 2), np.column_stack([*sensitivities, plain])
    columns = curves[before] + (place - before)[..., None] * np.diff(curves, axis=0)[before]
    columns[..., -1] = (trial_data.lead_position_m - trial_effects[ORIGIN])[:, None] - columns[..., -1]
    white = whiten(columns, trial_data.first, rho, trial_data.relative_sd).transpose(1, 2, 0)
    square = white @ np.swapaxes(white, 1, 2) / variance
    effects = np.tile(trial_effects, (releases.size, 1))
    effects[:, RELEASE] = releases
    information = square[:, :-1, :-1] + np.diag(precision)
    shared_information, gradient = square[:, ORIGIN:-1, ORIGIN:-1], square[:, ORIGIN:-1, -1]
    slope = gradient - (precision * (effects - centre))[:, ORIGIN:]
    largest = np.array([np.inf, 0.3, 0.3])  # Largest change of origin and deviations (chosen)
    step = np.clip(np.linalg.solve(information[:, ORIGIN:, ORIGIN:], slope[..., None])[..., 0], -largest, largest)
    effects[:, ORIGIN:] += step
    residual_squares = square[:, -1, -1] - np.sum(
        step * (2 * gradient - (shared_information @ step[..., None])[..., 0]), axis=1
    )
    deviances = (
        residual_squares + np.sum(precision * (effects - centre) ** 2, axis=1) + np.linalg.slogdet(information)[1]
    )
    k = int(np.argmin(deviances))
    return effects[k], float(deviances[-1] - deviances[k])


def _candidate_releases(trial_data: FitTrial, release_s: float) -> Floats:
    """Candidate releases of a trial, s, shape (n,); the last is the current one."""
    if trial_data.shows_rest:
        # Candidate releases of a trial recorded at rest, frames from the current one, which comes last (chosen)
        frames = [*np.arange(-14.0, 15.0), -0.6, -0.3, -0.12, -0.05, 0.05, 0.12, 0.3, 0.6, 0.0]
        return release_s + trial_data.frame_s * np.array(frames)
    duration_s = float(trial_data.time_s[-1] - trial_data.time_s[0])
    # 60: candidate releases of a trial recorded only in motion (chosen)
    return np.append(trial_data.time_s[0] - np.geomspace(0.1 * trial_data.frame_s, duration_s, 60), release_s)


def _release_sensitivities(
    predictor: Predictor, plain: Jobs, releases: Sequence[Floats]
) -> list[tuple[Floats, Floats, Floats]]:
    """For each trial times since release, shape (n,), positions there, m, and their sensitivities to its effects.
    Sensitivities have shape (4, n), zero for an effect that the trial does not have.
    """
    damping_step, pressure_step = 1e-2, 1e-2  # Finite-difference steps of ln B and of pressure (derived)
    with_pressure = predictor.has_pressure_deviation[plain.trial]
    with_damping = predictor.has_damping_deviation[plain.trial]
    pressures, dampings = plain[np.flatnonzero(with_pressure)], plain[np.flatnonzero(with_damping)]
    pressures = replace(pressures, pressure_deviation=pressures.pressure_deviation + pressure_step)
    dampings.row[:, predictor.damping_column] *= np.exp(damping_step)
    longest_s = np.array([predictor.data[i].time_s[-1] - s.min() for i, s in zip(plain.trial, releases, strict=True)])
    # 600: points of the time grid of a trajectory that is shifted (derived)
    grids = longest_s * np.linspace(0.0, 1.0, 600)[:, None] ** 1.5
    grids = np.concatenate([grids.T, grids.T[with_pressure], grids.T[with_damping]])
    jobs = Jobs.concatenated([plain, pressures, dampings])
    moved = predictor.run(jobs, list(jobs.release_s[:, None] + grids))
    y = np.array([trajectory.observed_position_m for trajectory in moved])
    n, n_pressures = len(plain), len(pressures)
    sensitivities = np.zeros((n, N_TRIAL_EFFECTS, grids.shape[1]))
    sensitivities[:, RELEASE] = [-np.gradient(along_m, times) for along_m, times in zip(y, grids[:n], strict=False)]
    sensitivities[:, ORIGIN] = 1.0
    sensitivities[with_pressure, PRESSURE] = (y[n : n + n_pressures] - y[:n][with_pressure]) / pressure_step
    sensitivities[with_damping, DAMPING_DEVIATION] = (y[n + n_pressures :] - y[:n][with_damping]) / damping_step
    return list(zip(grids, y, sensitivities, strict=False))
