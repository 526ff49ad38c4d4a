"""The further trials that separate hypotheses best: expected rise of −2 ln L of the wrong one, to first order.

If a is true, new trials show what a predicts. Hypothesis b, refitted to old and new trials, keeps a misfit of

    D² = min over δ, s of  Σ_new |W (y_a − y_b − X δ − Z u)|² + |u/s|² + δᵀ I_s δ − 2 g_sᵀ δ + (rise with s)

with X and Z its sensitivities to the free parameters and to the trial effects u, W the whitening of the noise, I_s the
information of the trials so far and g_s their gradient (not zero where b is at a bound). The between-trial standard
deviations s of pressure and B are estimated too, so that a wrong hypothesis may explain part of its misfit as scatter.
√D² is a separation in standard deviations; of a against b and b against a the smaller counts (T-optimality).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.inference.mixed_effects import DEVIATION_COLUMNS, solve_per_trial
from vinetrack.inference.sensitivity import N_TRIAL_EFFECTS
from vinetrack.planning.feasible_trials import Condition
from vinetrack.planning.hypothesis_predictions import Hypothesis, ScatterLevel
from vinetrack.planning.simulated_tracks import GrowthCourse, TrackSampling, blank_trial

POINTS = 100  # Times at which a condition is evaluated; each stands for the frames around it (chosen)

PAST_THE_END = 1.05  # Time at which the vine is evaluated after its end, in end times (chosen)

# Separation, in standard deviations, at which a pair has half of its largest worth (chosen)
WELL_SEPARATED = 5.0

MOST_PASSES = 4  # Passes of the exchange, at most (chosen)

GAIN = 1.005  # Factor by which an exchange must raise the worth (chosen)

BOUND_PASSES = 4  # Passes that fix parameters at their bounds (chosen)


@dataclass(frozen=True)
class RefitTerms:
    """Quadratic form of −2 ln L of one hypothesis refitted to the trials so far and one trial of every condition. The
    first axis is that of the scatter levels. From the trials so far: `old_information`, shape (n_levels, n_free,
    n_free), `old_gradient`, (n_levels, n_free), and `old_rise`, (n_levels,).
    """

    old_information: Floats
    old_gradient: Floats
    old_rise: Floats
    information: Floats
    gradient: Floats
    misfit: Floats
    scatter_rise: Floats
    down: Floats
    up: Floats

    def narrowed(self, allowed: NDArray[np.int_]) -> RefitTerms:
        """Keep some of the conditions, and the parameters about which they or the trials so far have information.
        Shapes: allowed (n_allowed,).
        """
        has_new = np.any(self.information[0][allowed].diagonal(axis1=1, axis2=2) > 0, axis=0)
        has_old = (np.abs(self.old_gradient[0]) > 0) | (np.count_nonzero(self.old_information[0], axis=0) > 1)
        use = np.flatnonzero(has_new | has_old)
        return RefitTerms(
            self.old_information[:, use][:, :, use],
            self.old_gradient[:, use],
            self.old_rise,
            self.information[:, allowed][:, :, use][:, :, :, use],
            self.gradient[:, allowed][:, :, use],
            self.misfit[:, allowed],
            self.scatter_rise[:, allowed],
            self.down[use],
            self.up[use],
        )


def refit_terms(
    hypotheses: Sequence[Hypothesis],
    conditions: Sequence[Condition],
    cameras: Sequence[TrackSampling],
    runs: Sequence[GrowthCourse],
) -> list[RefitTerms]:
    """Return the quadratic form of each hypothesis, with one trial of each condition, at its best values so far."""
    data = hypotheses[0].fit.predictor.data
    times, weights = zip(*(_times(camera, run) for camera, run in zip(cameras, runs, strict=True)), strict=True)
    placeholders = [blank_trial(condition, t, data, 1e-3 * t) for condition, t in zip(conditions, times, strict=True)]
    trial_effects = np.zeros((len(conditions), N_TRIAL_EFFECTS))
    predictors = [hypothesis.predictor(range(len(conditions)), placeholders) for hypothesis in hypotheses]
    columns = [
        np.stack(p.linearise(hypothesis.theta, trial_effects))
        for p, hypothesis in zip(predictors, hypotheses, strict=True)
    ]
    root_weights = np.sqrt(np.stack(weights))[:, :, None]
    # The last column is placeholder − motion; the placeholder cancels in the difference of two hypotheses.
    motions = np.stack([-block[:, :, -1] for block in columns], axis=2)
    terms = []
    for k, (hypothesis, sensitivities, predictor) in enumerate(zip(hypotheses, columns, predictors, strict=True)):
        has_deviations = np.column_stack([predictor.has_pressure_deviation, predictor.has_damping_deviation])
        differences = (motions - motions[:, :, [k]]) * root_weights
        terms.append(_terms_of(hypothesis, sensitivities * root_weights, differences, has_deviations))
    return terms


def _times(camera: TrackSampling, run: GrowthCourse) -> tuple[Floats, Floats]:
    """Times since release at which a condition is evaluated, and the number of frames that each represents. The first
    represents the frames at rest, the last those after the end of growth (weight 0 where there are none).
    """
    step_s = run.near_end_s / POINTS
    moving = (np.arange(POINTS) + 0.5) * step_s
    ends_filmed = np.isfinite(run.ends_s) and camera.frames_behind_end > 0
    last_s = PAST_THE_END * run.ends_s if ends_filmed else moving[-1] + step_s
    weights = np.full(POINTS + 2, step_s / camera.frame_s)
    weights[0], weights[-1] = camera.rest_frames, camera.frames_behind_end if ends_filmed else 0.0
    return np.concatenate([[-camera.frame_s], moving, [last_s]]), weights


def _terms_of(
    hypothesis: Hypothesis, columns: Floats, differences: Floats, has_deviations: NDArray[np.bool_]
) -> RefitTerms:
    # For smooth curves AR(1) noise is equivalent to white noise of variance σ²_innovation/(1 − ρ)².
    scale = (1 - hypothesis.rho) / np.sqrt(hypothesis.variance)
    both = scale * np.concatenate([columns[:, :, :-1], differences], axis=2)
    products = np.swapaxes(both, 1, 2) @ both
    levels = hypothesis.scatter_levels
    by_level = [_without_trial_effects(hypothesis, level, products) for level in levels]
    information, gradient, misfit = (np.stack(part) for part in zip(*by_level, strict=True))
    factors = np.array([level.factors for level in levels])
    down, up = hypothesis.room
    return RefitTerms(
        old_information=np.stack([level.information for level in levels]),
        old_gradient=np.stack([level.gradient for level in levels]),
        old_rise=np.array([level.rise for level in levels]),
        information=information,
        gradient=gradient,
        misfit=misfit,
        scatter_rise=(2 * np.log(factors) + 1 / factors**2 - 1) @ has_deviations.T.astype(float),
        down=down,
        up=up,
    )


def _without_trial_effects(
    hypothesis: Hypothesis, level: ScatterLevel, products: Floats
) -> tuple[Floats, Floats, Floats]:
    """Information, gradient and misfit over all free parameters, trial effects eliminated (Schur complement)."""
    precision = np.full(N_TRIAL_EFFECTS, 1e-9)
    precision[list(DEVIATION_COLUMNS)] = 1 / np.array(level.spread) ** 2
    within_trial = products[:, :N_TRIAL_EFFECTS, :N_TRIAL_EFFECTS] + np.diag(precision)
    reduced = products[:, N_TRIAL_EFFECTS:, N_TRIAL_EFFECTS:] - products[
        :, N_TRIAL_EFFECTS:, :N_TRIAL_EFFECTS
    ] @ solve_per_trial(within_trial, products[:, :N_TRIAL_EFFECTS, N_TRIAL_EFFECTS:])
    index = hypothesis.layout.index
    n, keys, size = len(products), index.shape[1], hypothesis.theta.size
    every = np.arange(n)
    information = np.zeros((n, size + 1, size + 1))  # the last row and column collect what is not free (index −1)
    np.add.at(information, (every[:, None, None], index[:, :, None], index[:, None, :]), reduced[:, :keys, :keys])
    gradient = np.zeros((n, size + 1, reduced.shape[2] - keys))
    np.add.at(gradient, (every[:, None], index), reduced[:, :keys, keys:])
    return information[:, :size, :size], gradient[:, :size], np.einsum("nkk->nk", reduced[:, keys:, keys:])


def separations(terms: Sequence[RefitTerms], designs: NDArray[np.int_]) -> Floats:
    """Return the separation of every ordered pair (true, refitted), in standard deviations; 0 on the diagonal. Shapes:
    designs (n_designs, n_trials) → (n_designs, n, n).
    """
    n = len(terms)
    squares = np.zeros((len(designs), n, n))
    for b, refitted in enumerate(terms):
        for level in range(len(refitted.old_rise)):
            information = refitted.old_information[level] + _over_trials(refitted.information[level], designs)
            gradient = refitted.old_gradient[level][:, None] + _over_trials(refitted.gradient[level], designs)
            misfit = _over_trials(refitted.misfit[level], designs) + refitted.old_rise[level]
            misfit += _over_trials(refitted.scatter_rise[level], designs)[:, None]
            for a in range(n):
                if a != b:
                    gain = _largest_gain(information, gradient[:, :, a], refitted.down, refitted.up)
                    square = misfit[:, a] - gain
                    squares[:, a, b] = square if level == 0 else np.minimum(squares[:, a, b], square)
    return np.sqrt(np.maximum(squares, 0.0))


def _over_trials(by_condition: Floats, designs: NDArray[np.int_]) -> Floats:
    return np.asarray(sum(by_condition[designs[:, k]] for k in range(designs.shape[1])))


def _largest_gain(information: Floats, gradient: Floats, down: Floats, up: Floats) -> Floats:
    """Largest 2 gᵀδ − δᵀIδ with every δ within its bounds, shape (n_designs,), by an active-set method. A parameter
    that would cross a bound is fixed there, and the others are solved again. None is released again, which seldom, and
    then by little, overestimates the separation.
    """
    n, size = gradient.shape
    step = np.zeros((n, size))
    fixed: NDArray[np.bool_] = np.broadcast_to((down == 0) & (up == 0), (n, size)).copy()
    for _ in range(BOUND_PASSES):
        free = ~fixed
        right = np.where(free, gradient - np.einsum("nij,nj->ni", information, np.where(fixed, step, 0.0)), 0.0)
        of_free = information * (free[:, :, None] & free[:, None, :]) + fixed[:, :, None] * np.eye(size)
        solved = solve_per_trial(of_free, right[:, :, None])[:, :, 0]
        step = np.where(free, solved, step)
        crossed = free & ((step < down) | (step > up))
        if not crossed.any():
            break
        step = np.clip(step, down, up)
        fixed |= crossed
    return np.asarray(2 * np.sum(gradient * step, axis=1) - np.einsum("ni,nij,nj->n", step, information, step))


def worth(between: Floats) -> Floats:
    """Return the worth of designs: the sum over pairs of d²/(d² + 5²), d the smaller separation of the two directions.
    Shapes: between (n_designs, n, n) → (n_designs,).
    """
    n = between.shape[1]
    first, second = np.triu_indices(n, 1)
    square = np.minimum(between[:, first, second], between[:, second, first]) ** 2
    return np.asarray(np.sum(square / (square + WELL_SEPARATED**2), axis=1))


def best_design(terms: Sequence[RefitTerms], allowed: NDArray[np.int_], trials: int) -> tuple[NDArray[np.int_], float]:
    """Find the trials that separate best, by exchange of one trial at a time (Fedorov 1972). Returns design (indices
    among all conditions, increasing), worth (see `worth`). Shape (trials,).
    """
    of_allowed = [of_hypothesis.narrowed(allowed) for of_hypothesis in terms]
    replicates = np.repeat(np.arange(allowed.size)[:, None], trials, axis=1)
    values = worth(separations(of_allowed, replicates))
    design, best = replicates[int(np.argmax(values))].copy(), float(np.max(values))
    for _ in range(MOST_PASSES):
        before = best
        for exchanged in range(trials):
            designs = np.repeat(design[None], allowed.size, axis=0)
            designs[:, exchanged] = np.arange(allowed.size)
            values = worth(separations(of_allowed, designs))
            if np.max(values) > GAIN * best:
                design, best = designs[int(np.argmax(values))], float(np.max(values))
        if best <= before:
            break
    return np.sort(allowed[design]), best


def best_new_vines(
    terms: Sequence[RefitTerms], conditions: Sequence[Condition], places: NDArray[np.int_], trials: int, most: int
) -> list[str]:
    """Return the new vines in order of the worth of replicates at their best condition, best first."""
    of_new_vines = [of_hypothesis.narrowed(places) for of_hypothesis in terms]
    replicates = np.repeat(np.arange(places.size)[:, None], trials, axis=1)
    order = np.argsort(-worth(separations(of_new_vines, replicates)))
    return list(dict.fromkeys(conditions[places[k]].trial.vine for k in order))[:most]
