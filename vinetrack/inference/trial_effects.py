"""Estimates of the trial effects at given parameters, and a search for the release of each trial.

Release, origin and deviations of a trial are correlated, so that its misfit may have several minima: above all where no
frame shows it at rest, and where a vine starts so slowly that its first frames hardly differ from rest.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.inference.gaussian_processes import whiten
from vinetrack.inference.marginal_likelihood import (
    FitState,
    MixedProblem,
    trial_effect_penalty,
    trial_effect_prior,
    trial_effect_step,
    whitened_products,
    with_diagonal,
)
from vinetrack.inference.sensitivity import (
    DAMPING_DEVIATION,
    N_TRIAL_EFFECTS,
    PRESSURE,
    RELEASE,
    Predictor,
)

# ------------------------------------------------------------------------------
# Restriction of a fit to a subset of its trials: free parameters, predictor, state and problem.

Indices = NDArray[np.int_]


def subset(
    predictor: Predictor, problem: MixedProblem, rows: Indices, *states: FitState
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
    by_parameter = "prior_mean prior_precision lower upper free random"
    problem = replace(
        problem.of_trials(rows),
        index=layout.index,
        **{name: getattr(problem, name)[places] for name in by_parameter.split()},
    )
    reduced = [
        replace(each, theta=each.theta[places], trial_effects=each.trial_effects[rows], variance=each.variance[rows])
        for each in states
    ]
    return smaller, problem, reduced


LARGEST_DEVIATION = 0.9  # Largest deviation of pressure and ln B (chosen)


def optimise_trial_effects(
    predictor: Predictor, problem: MixedProblem, state: FitState, largest_useful_cost: float = math.inf
) -> tuple[FitState, Floats]:
    """One Gauss–Newton step of the trial effects at fixed parameters, and the resulting cost of each trial. The trial
    effects are determined so precisely that a step of the shared parameters leaves the curved valley; this step returns
    to it. Returns state, costs. Shape (n_trials,).
    """
    columns = predictor.linearise(state.theta, state.trial_effects, trial_effects_only=True)
    cross_products = predictor.products(columns)
    (step, decrease), (step_at_release, _) = (
        trial_effect_step(cross_products, problem, state, fixed_release=fixed_release)
        for fixed_release in (False, True)
    )
    current_costs = trial_costs(predictor, problem, state, residuals_in(columns))
    if float(np.sum(current_costs - decrease)) >= largest_useful_cost:
        return state, current_costs
    moved_effects = [limited_step(predictor, state.trial_effects, each) for each in (step, step_at_release)]
    candidates = [state, *(replace(state, trial_effects=trial_effects) for trial_effects in moved_effects)]
    residuals_of_candidates = zip(candidates[1:], predictor.residuals_of_each(state.theta, moved_effects), strict=True)
    costs = np.array(
        [
            current_costs,
            *(trial_costs(predictor, problem, candidate, left_m) for candidate, left_m in residuals_of_candidates),
        ]
    )
    best = np.argmin(costs, axis=0)
    trial_effects = np.array([candidates[candidate].trial_effects[i] for i, candidate in enumerate(best)])
    return replace(state, trial_effects=trial_effects), np.min(costs, axis=0)


def limited_step(predictor: Predictor, trial_effects: Floats, step: Floats) -> Floats:
    """Trial effects after a step, within the trust region: two frames for the release, 0.3 for a deviation. Shapes:
    trial_effects, step (n_trials, 4) → (n_trials, 4).
    """
    largest_deviation_step = 0.3  # Largest step of a trial's deviations of pressure and ln B (chosen)
    # 2.0: largest step of a release, frames (chosen)
    largest_release_step = 2.0 * np.array([trial_data.frame_s for trial_data in predictor.data])
    effects = trial_effects + step
    effects[:, RELEASE] = trial_effects[:, RELEASE] + np.clip(
        step[:, RELEASE], -largest_release_step, largest_release_step
    )
    deviations = [PRESSURE, DAMPING_DEVIATION]
    deviation_step = np.clip(step[:, deviations], -largest_deviation_step, largest_deviation_step)
    effects[:, deviations] = np.clip(
        trial_effects[:, deviations] + deviation_step, -LARGEST_DEVIATION, LARGEST_DEVIATION
    )
    return effects


@np.errstate(over="ignore", invalid="ignore")  # of a long step: see `gaussian_processes`
def trial_costs(
    predictor: Predictor, problem: MixedProblem, state: FitState, residuals: Sequence[Floats] | None = None
) -> Floats:
    """Penalised sum of squares of each trial: its whitened residuals plus the priors of its effects. Shapes: residuals
    (n_points,) → (n_trials,).
    """
    if residuals is None:
        residuals = predictor.residuals(state.theta, state.trial_effects)
    white = whiten(np.concatenate(residuals), predictor.first, state.rho, predictor.relative_sd)
    squares = [np.sum(of_trial) for of_trial in predictor.by_trial(white**2)]
    return np.array(squares) / state.variance + trial_effect_penalty(problem, state)


def residuals_in(columns: Sequence[Floats]) -> list[Floats]:
    """The residuals among the columns of a linearisation. Shapes: columns (n_points, k) → (n_points,)."""
    return [np.ascontiguousarray(column[:, -1]) for column in columns]


LEAST_DECREASE = 0.5  # Decrease of a trial's −2 ln L for which its release jumps to another minimum (derived)


def likelier_releases(predictor: Predictor, problem: MixedProblem, state: FitState) -> FitState | None:
    """The state with releases at which trials are likelier, their effects integrated out; None if there are none. From
    each of many releases, before the first frame where no frame shows the rest and about the current one elsewhere, one
    step leads to effects that suit it, from the likeliest a few more. A trace shows the release of a vine that was
    pressurised during the recording.
    """
    rows = np.flatnonzero([not one.pressurised_in_recording for one in predictor.data])
    if not rows.size:
        return None
    predictor, problem, (current,) = subset(predictor, problem, rows, state)
    first_s, duration_s = (np.array([f(one.time_s) for one in predictor.data]) for f in (np.min, np.ptp))
    shows_rest, frames_s = np.array([one.shows_rest for one in predictor.data]), predictor.frames_s
    best, least = current, (before := _trial_deviances(predictor, problem, current))
    # 0.1: releases that are tried, from so many frames before the first to the duration of the track, and frames from
    # the current one (chosen)
    frames_off = (-12.0, -8.0, -5.0, -3.0, -2.0, -1.0, 1.0, 2.0, 3.0, 5.0, 8.0, 12.0)
    for part, off in zip(np.linspace(0.0, 1.0, len(frames_off)), frames_off, strict=True):
        effects = current.trial_effects.copy()
        early_s = first_s - duration_s**part * (0.1 * frames_s) ** (1 - part)
        effects[:, RELEASE] = np.where(shows_rest, effects[:, RELEASE] + off * frames_s, early_s)
        with suppress(SimulationError):
            tried, _ = optimise_trial_effects(predictor, problem, replace(current, trial_effects=effects))
            deviances = _trial_deviances(predictor, problem, tried)
            likelier = (deviances < least)[:, None]
            best = replace(best, trial_effects=np.where(likelier, tried.trial_effects, best.trial_effects))
            least = np.minimum(deviances, least)
    # 3: further steps of the trial effects before another release is compared with the current one (chosen)
    for _ in range(3):
        best, _ = optimise_trial_effects(predictor, problem, best)
    better = _trial_deviances(predictor, problem, best) < before - LEAST_DECREASE
    if not better.any():
        return None
    effects = state.trial_effects.copy()
    effects[rows[better]] = best.trial_effects[better]
    return replace(state, trial_effects=effects)


def _trial_deviances(predictor: Predictor, problem: MixedProblem, state: FitState) -> Floats:
    """−2 ln L of each trial, its effects integrated out by the Laplace approximation, shape (n_trials,)."""
    columns = predictor.linearise(state.theta, state.trial_effects, trial_effects_only=True)
    square = whitened_products(predictor.products(columns), state)[:, :N_TRIAL_EFFECTS, :N_TRIAL_EFFECTS]
    log_volume = np.linalg.slogdet(with_diagonal(square, trial_effect_prior(problem, state)[1]))[1]
    return np.asarray(trial_costs(predictor, problem, state, residuals_in(columns)) + log_volume)
