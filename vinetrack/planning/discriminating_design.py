"""Which further trials separate hypotheses best: by how much −2 ln L of the wrong one will rise, to first order.

If a is true, new trials show what a predicts. Hypothesis b, refitted to all, is left with

    D² = min over δ, s of  Σ_new |W (y_a − y_b − X δ − Z u)|² + |u/s|² + δᵀ I_s δ − 2 g_sᵀ δ + (rise with s)

with X and Z its sensitivities to the free numbers and to what every trial has of its own, W what whitens the noise, I_s
the information of the trials so far and g_s their slope (not zero where b sits at a bound). The spreads s of pressure
and B are estimated along, so that a misfit which looks like scatter is passed off as scatter. √D² is a separation in
standard deviations. The smaller of a against b and b against a counts.

Which trials to make is the exact design problem; it is solved by exchange, one trial after the other replaced by the
best there is (Fedorov 1972, Theory of Optimal Experiments). No more than one new vine is asked for.
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
from vinetrack.planning.hypothesis_predictions import Hypothesis, View
from vinetrack.planning.simulated_tracks import GrowthCourse, TrackSampling, blank

POINTS = 100
"""Times at which a condition is looked at; each stands for the frames about it. Chosen: smooth curves are summed to a
thousandth. At half designs are rated to a few thousandths, at twice the search takes twice as long."""

PAST_THE_END = 1.05
"""In end times. Chosen: behind the end the position is constant, so that any instant there says the same."""

WELL_SEPARATED = 5.0
"""Standard deviations beyond which more of one pair is worth less than some of another. Chosen: five sigma leave no
doubt. At half a design is content with pairs at 2.5 σ; at twice it spends trials on pairs that are told apart
already."""

MOST_PASSES = 4
"""Chosen for time: exchange usually ends after two passes; at half it may stop short of the best, at twice nothing
changes."""

GAIN = 1.005
"""Chosen: an exchange must gain half a per cent, so that ties do not cycle; a design is left at most that much worse.
At half and twice the loss halves and doubles."""

BOUND_PASSES = 4
"""Chosen: each pass fixes all numbers that left their room; few ever leave it. At half some designs are rated a little
too good, at twice nothing changes."""


@dataclass(frozen=True)
class Side:
    """One hypothesis as the one that is refitted: the trials so far, and one trial of every condition.

    Over the views of its scatter (first axis): `known`, shape (n_views, n_free, n_free), `leans`, (n_views, n_free) and
    `rise`, (n_views,) from the trials so far; `information`, (n_views, n_conditions, n_free, n_free), of a trial; how
    the motion by each of the hypotheses pulls at the numbers, `pull`, (n_views, n_conditions, n_free, n), and is left
    over, `gap`, (n_views, n_conditions, n); and what a trial like the others adds to the rise, `each`, (n_views,
    n_conditions). `down` and `up`, shape (n_free,), are how far numbers may go.
    """

    known: Floats
    leans: Floats
    rise: Floats
    information: Floats
    pull: Floats
    gap: Floats
    each: Floats
    down: Floats
    up: Floats

    def narrowed(self, allowed: NDArray[np.int_]) -> Side:
        """With some of the conditions only, and the numbers that they or the trials so far say something of.

        Parameters
        ----------
        allowed : array of int, shape (n_allowed,)
            Places of the conditions kept.

        Returns
        -------
        Side
        """
        felt = np.any(self.information[0][allowed].diagonal(axis1=1, axis2=2) > 0, axis=0)
        use = np.flatnonzero(felt | (np.abs(self.leans[0]) > 0) | (np.count_nonzero(self.known[0], axis=0) > 1))
        return Side(
            self.known[:, use][:, :, use],
            self.leans[:, use],
            self.rise,
            self.information[:, allowed][:, :, use][:, :, :, use],
            self.pull[:, allowed][:, :, use],
            self.gap[:, allowed],
            self.each[:, allowed],
            self.down[use],
            self.up[use],
        )


def all_sides(
    hypotheses: Sequence[Hypothesis],
    conditions: Sequence[Condition],
    cameras: Sequence[TrackSampling],
    runs: Sequence[GrowthCourse],
) -> list[Side]:
    """Every hypothesis with what one trial of each condition would answer at its best values so far.

    Parameters
    ----------
    hypotheses : carried to the conditions, see `hypothesis_predictions.carry`.
    conditions : trials that could be made.
    cameras : of each condition.
    runs : how each condition runs, see `simulated_tracks.courses`.

    Returns
    -------
    list of Side
        One a hypothesis.
    """
    data = hypotheses[0].fit.predictor.data
    times, weights = zip(*(_times(lens, run) for lens, run in zip(cameras, runs, strict=True)), strict=True)
    items = [blank(condition, t, data, 1e-3 * t) for condition, t in zip(conditions, times, strict=True)]
    trial_effects = np.zeros((len(conditions), N_TRIAL_EFFECTS))
    predictors = [hypothesis.predictor(range(len(conditions)), items) for hypothesis in hypotheses]
    columns = [
        np.stack(p.linearise(hypothesis.theta, trial_effects))
        for p, hypothesis in zip(predictors, hypotheses, strict=True)
    ]
    heavy = np.sqrt(np.stack(weights))[:, :, None]
    # The last column is placeholder − motion; differences of two hypotheses are free of the placeholder.
    motions = np.stack([-block[:, :, -1] for block in columns], axis=2)
    sides = []
    for k, (hypothesis, mine, predictor) in enumerate(zip(hypotheses, columns, predictors, strict=True)):
        feels = np.column_stack([predictor.has_pressure_deviation, predictor.has_damping_deviation])
        sides.append(_side(hypothesis, mine * heavy, (motions - motions[:, :, [k]]) * heavy, feels))
    return sides


def _times(lens: TrackSampling, run: GrowthCourse) -> tuple[Floats, Floats]:
    """Times since release at which a condition is looked at and how many frames each stands for, shape (n_times,).

    First the rest, last what is seen behind the end of growth (without weight where nothing is).
    """
    step_s = run.near_end_s / POINTS
    moving = (np.arange(POINTS) + 0.5) * step_s
    behind = np.isfinite(run.ends_s) and lens.frames_behind_end > 0
    last_s = PAST_THE_END * run.ends_s if behind else moving[-1] + step_s
    weights = np.full(POINTS + 2, step_s / lens.frame_s)
    weights[0], weights[-1] = lens.rest_frames, lens.frames_behind_end if behind else 0.0
    return np.concatenate([[-lens.frame_s], moving, [last_s]]), weights


def _side(hypothesis: Hypothesis, columns: Floats, gaps: Floats, feels: NDArray[np.bool_]) -> Side:
    # Smooth curves under AR(1) noise count as under white noise of variance σ²_innovation/(1 − ρ)².
    scale = (1 - hypothesis.rho) / np.sqrt(hypothesis.variance)
    both = scale * np.concatenate([columns[:, :, :-1], gaps], axis=2)
    products = np.swapaxes(both, 1, 2) @ both
    seen = [_left(hypothesis, view, products) for view in hypothesis.views]
    information, pull, gap = (np.stack(part) for part in zip(*seen, strict=True))
    wider = np.array([view.factors for view in hypothesis.views])
    down, up = hypothesis.room
    return Side(
        known=np.stack([view.information for view in hypothesis.views]),
        leans=np.stack([view.slope for view in hypothesis.views]),
        rise=np.array([view.rise for view in hypothesis.views]),
        information=information,
        pull=pull,
        gap=gap,
        each=(2 * np.log(wider) + 1 / wider**2 - 1) @ feels.T.astype(float),
        down=down,
        up=up,
    )


def _left(hypothesis: Hypothesis, view: View, products: Floats) -> tuple[Floats, Floats, Floats]:
    """Information, pull and gap with the own numbers of a trial eliminated, placed among all free numbers."""
    precision = np.full(N_TRIAL_EFFECTS, 1e-9)
    precision[list(DEVIATION_COLUMNS)] = 1 / np.array(view.spread) ** 2
    within_trial = products[:, :N_TRIAL_EFFECTS, :N_TRIAL_EFFECTS] + np.diag(precision)
    reduced = products[:, N_TRIAL_EFFECTS:, N_TRIAL_EFFECTS:] - products[
        :, N_TRIAL_EFFECTS:, :N_TRIAL_EFFECTS
    ] @ solve_per_trial(within_trial, products[:, :N_TRIAL_EFFECTS, N_TRIAL_EFFECTS:])
    index = hypothesis.layout.index
    n, keys, size = len(products), index.shape[1], hypothesis.theta.size
    every = np.arange(n)
    wide = np.zeros((n, size + 1, size + 1))
    np.add.at(wide, (every[:, None, None], index[:, :, None], index[:, None, :]), reduced[:, :keys, :keys])
    pull = np.zeros((n, size + 1, reduced.shape[2] - keys))
    np.add.at(pull, (every[:, None], index), reduced[:, :keys, keys:])
    return wide[:, :size, :size], pull[:, :size], np.einsum("nkk->nk", reduced[:, keys:, keys:])


def separations(sides: Sequence[Side], designs: NDArray[np.int_]) -> Floats:
    """Separation of every ordered pair (true, refitted), σ, shape (n_designs, n, n); 0 on the diagonal.

    Parameters
    ----------
    sides : from `all_sides`.
    designs : array of int, shape (n_designs, n_trials)
        Places among the conditions, one a trial.

    Returns
    -------
    array, shape (n_designs, n, n)
    """
    n = len(sides)
    squares = np.zeros((len(designs), n, n))
    for b, side in enumerate(sides):
        for view in range(len(side.rise)):
            information = side.known[view] + _over_trials(side.information[view], designs)
            pull = side.leans[view][:, None] + _over_trials(side.pull[view], designs)
            left = _over_trials(side.gap[view], designs) + side.rise[view]
            left += _over_trials(side.each[view], designs)[:, None]
            for a in range(n):
                if a != b:
                    square = left[:, a] - _best_refit(information, pull[:, :, a], side.down, side.up)
                    squares[:, a, b] = square if view == 0 else np.minimum(squares[:, a, b], square)
    return np.sqrt(np.maximum(squares, 0.0))


def _over_trials(by_condition: Floats, designs: NDArray[np.int_]) -> Floats:
    return np.asarray(sum(by_condition[designs[:, k]] for k in range(designs.shape[1])))


def _best_refit(square: Floats, slope: Floats, down: Floats, up: Floats) -> Floats:
    """Largest 2 vᵀδ − δᵀIδ with every δ within its room, shape (n_designs,).

    A number that would leave its room is held at its end and the rest are solved again; none is let go again, which
    errs to the side of too large a separation by little and seldom.
    """
    n, size = slope.shape
    step = np.zeros((n, size))
    held: NDArray[np.bool_] = np.broadcast_to((down == 0) & (up == 0), (n, size)).copy()
    for _ in range(BOUND_PASSES):
        loose = ~held
        right = np.where(loose, slope - np.einsum("nij,nj->ni", square, np.where(held, step, 0.0)), 0.0)
        kept = square * (loose[:, :, None] & loose[:, None, :]) + held[:, :, None] * np.eye(size)
        solved = solve_per_trial(kept, right[:, :, None])[:, :, 0]
        step = np.where(loose, solved, step)
        out = loose & ((step < down) | (step > up))
        if not out.any():
            break
        step = np.clip(step, down, up)
        held |= out
    return np.asarray(2 * np.sum(slope * step, axis=1) - np.einsum("ni,nij,nj->n", step, square, step))


def worth(between: Floats) -> Floats:
    """How good designs are, shape (n_designs,), from their separations, shape (n_designs, n, n).

    Every pair counts by the smaller of its two directions, the first few σ of it most.

    Parameters
    ----------
    between : array, shape (n_designs, n, n)
        Separations, σ, of ordered pairs.

    Returns
    -------
    array, shape (n_designs,)
    """
    n = between.shape[1]
    first, second = np.triu_indices(n, 1)
    square = np.minimum(between[:, first, second], between[:, second, first]) ** 2
    return np.asarray(np.sum(square / (square + WELL_SEPARATED**2), axis=1))


def best_design(sides: Sequence[Side], allowed: NDArray[np.int_], trials: int) -> tuple[NDArray[np.int_], float]:
    """The trials that separate best, by exchange of one trial at a time (Fedorov 1972).

    Parameters
    ----------
    sides : from `all_sides`.
    allowed : array of int
        Places of the conditions to choose from.
    trials : int
        How many trials, replicates counted.

    Returns
    -------
    design : array of int, shape (trials,)
        Places among all conditions, rising.
    worth : float
        See `worth`.
    """
    narrow = [side.narrowed(allowed) for side in sides]
    alone = np.repeat(np.arange(allowed.size)[:, None], trials, axis=1)
    good = worth(separations(narrow, alone))
    design, best = alone[int(np.argmax(good))].copy(), float(np.max(good))
    for _ in range(MOST_PASSES):
        before = best
        for place in range(trials):
            tried = np.repeat(design[None], allowed.size, axis=0)
            tried[:, place] = np.arange(allowed.size)
            good = worth(separations(narrow, tried))
            if np.max(good) > GAIN * best:
                design, best = tried[int(np.argmax(good))], float(np.max(good))
        if best <= before:
            break
    return np.sort(allowed[design]), best


def likeliest_vines(
    sides: Sequence[Side], conditions: Sequence[Condition], places: NDArray[np.int_], trials: int, most: int
) -> list[str]:
    """New vines, best first, by what the best of their conditions alone would separate.

    Parameters
    ----------
    sides : from `all_sides`.
    conditions : trials that could be made.
    places : array of int
        Places of those with new vines.
    trials : int
        Replicates that each condition is rated with.
    most : int
        At most so many vines.

    Returns
    -------
    list of str
        Names of vines.
    """
    narrow = [side.narrowed(places) for side in sides]
    alone = np.repeat(np.arange(places.size)[:, None], trials, axis=1)
    order = np.argsort(-worth(separations(narrow, alone)))
    return list(dict.fromkeys(conditions[places[k]].trial.vine for k in order))[:most]
