"""Which further trials separate hypotheses best: the expected Δχ² of the wrong one, refitted to old and new trials.

If a is true, new trials show what a predicts. Hypothesis b, refitted to all, is left with

    D² = min over δ of  Σ_new |W (y_a − y_b − X δ − Z u)|² + |u/s|² + δᵀ I δ − 2 gᵀ δ

with X and Z its sensitivities to the free numbers and to what every trial has of its own, s the spreads of the latter,
W what whitens the noise, I the information of the trials so far and g their slope (not zero where b sits at a bound).
That is what −2 ln L would differ by more than it does now, on average; √D² is a separation in standard deviations. The
smaller of a against b and b against a counts.

Which trials to make is the exact design problem; it is solved by exchange, one trial after the other replaced by the
best there is (Fedorov 1972, Theory of Optimal Experiments).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vinetrack.diagnosis.next_conditions import Condition
from vinetrack.diagnosis.next_film import Camera, Course, blank
from vinetrack.diagnosis.next_predict import Hypothesis
from vinetrack.model.mixed import LEAST_SPREAD, SPREAD_COLUMNS, solve_each
from vinetrack.model.sensitivity import OWN
from vinetrack.records import Floats

POINTS = 100
"""Times at which a condition is looked at; each stands for the frames about it."""

PAST_THE_END = 1.05
WELL_SEPARATED = 5.0
"""Standard deviations beyond which more of one pair is worth less than some of another."""

MOST_PASSES = 4
GAIN = 1.005
BOUND_PASSES = 4


@dataclass(frozen=True)
class Answers:
    """What one trial of every condition tells of one hypothesis, what a trial has of its own eliminated.

    `information`, shape (n_conditions, n_free, n_free), is of the hypothesis' own numbers; `pull`, shape (n_conditions,
    n_free, n_hypotheses), how the motion by each of the others draws at them; `gap`, shape (n_conditions,
    n_hypotheses), the sum of squares between its motion and theirs.
    """

    information: Floats
    pull: Floats
    gap: Floats


def all_answers(
    hypotheses: Sequence[Hypothesis],
    conditions: Sequence[Condition],
    cameras: Sequence[Camera],
    runs: Sequence[Course],
) -> list[Answers]:
    """The answers of every hypothesis; sensitivities are those at its best values so far."""
    data = hypotheses[0].fit.predictor.data
    times, weights = zip(*(_times(lens, run) for lens, run in zip(cameras, runs, strict=True)), strict=True)
    items = [blank(one, t, data, 1e-3 * t) for one, t in zip(conditions, times, strict=True)]
    own = np.zeros((len(conditions), OWN))
    columns = [np.stack(one.predictor(range(len(conditions)), items).linearise(one.theta, own)) for one in hypotheses]
    heavy = np.sqrt(np.stack(weights))[:, :, None]
    # The last column is placeholder − motion; differences of two hypotheses are free of the placeholder.
    motions = np.stack([-one[:, :, -1] for one in columns], axis=2)
    return [
        _answers(one, mine * heavy, (motions - motions[:, :, [k]]) * heavy)
        for k, (one, mine) in enumerate(zip(hypotheses, columns, strict=True))
    ]


def _times(lens: Camera, run: Course) -> tuple[Floats, Floats]:
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


def _answers(hypothesis: Hypothesis, columns: Floats, gaps: Floats) -> Answers:
    """Products of the columns with the own numbers of a trial eliminated, placed among all free numbers."""
    keys = columns.shape[2] - OWN - 1
    # Smooth curves under AR(1) noise count as under white noise of variance σ²_innovation/(1 − ρ)².
    scale = (1 - hypothesis.rho) / np.sqrt(hypothesis.variance)
    both = scale * np.concatenate([columns[:, :, :-1], gaps], axis=2)
    products = np.swapaxes(both, 1, 2) @ both
    own = products[:, :OWN, :OWN] + np.diag(own_precision(hypothesis)) + 1e-9 * np.eye(OWN)
    rest = products[:, OWN:, OWN:] - products[:, OWN:, :OWN] @ solve_each(own, products[:, :OWN, OWN:])
    n, size = columns.shape[0], hypothesis.theta.size
    index = hypothesis.layout.index
    wide = np.zeros((n, size + 1, size + 1))
    every = np.arange(n)
    np.add.at(wide, (every[:, None, None], index[:, :, None], index[:, None, :]), rest[:, :keys, :keys])
    pull = np.zeros((n, size + 1, gaps.shape[2]))
    np.add.at(pull, (every[:, None], index), rest[:, :keys, keys:])
    return Answers(wide[:, :size, :size], pull[:, :size], np.einsum("nkk->nk", rest[:, keys:, keys:]))


def own_precision(hypothesis: Hypothesis) -> Floats:
    """Precision of release, origin and deviations of a trial, shape (4,): only the last two are known beforehand."""
    precision = np.zeros(OWN)
    for place, spread in zip(SPREAD_COLUMNS, hypothesis.spread, strict=True):
        precision[place] = 1 / max(spread, LEAST_SPREAD) ** 2
    return precision


def separations(hypotheses: Sequence[Hypothesis], answers: Sequence[Answers], counts: Floats) -> Floats:
    """Separation of every ordered pair (true, refitted) by each design, σ, shape (n_designs, n, n); 0 on the diagonal.

    Parameters
    ----------
    counts : array, shape (n_designs, n_conditions): trials of each condition
    """
    n = len(hypotheses)
    found = np.zeros((counts.shape[0], n, n))
    for b, (hypothesis, answer) in enumerate(zip(hypotheses, answers, strict=True)):
        information = np.tensordot(counts, answer.information, axes=1) + hypothesis.information
        pulls = np.tensordot(counts, answer.pull, axes=1)
        gaps = counts @ answer.gap
        for a in range(n):
            if a != b:
                taken = _best_refit(information, pulls[:, :, a] + hypothesis.slope, *hypothesis.room)
                found[:, a, b] = np.sqrt(np.maximum(gaps[:, a] - taken, 0.0))
    return found


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
        solved = solve_each(kept, right[:, :, None])[:, :, 0]
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
    """
    n = between.shape[1]
    one, other = np.triu_indices(n, 1)
    square = np.minimum(between[:, one, other], between[:, other, one]) ** 2
    return np.asarray(np.sum(square / (square + WELL_SEPARATED**2), axis=1))


def best_design(
    hypotheses: Sequence[Hypothesis],
    answers: Sequence[Answers],
    allowed: NDArray[np.int_],
    trials: int,
) -> NDArray[np.int_]:
    """The conditions (places, one a trial, rising) that separate best, among those `allowed`."""
    n = answers[0].gap.shape[0]
    alone = np.zeros((allowed.size, n))
    alone[np.arange(allowed.size), allowed] = trials
    first = allowed[int(np.argmax(worth(separations(hypotheses, answers, alone))))]
    design = np.full(trials, first)
    for _ in range(MOST_PASSES):
        before = design.copy()
        for place in range(trials):
            counts = np.zeros((allowed.size, n))
            counts += np.bincount(np.delete(design, place), minlength=n)
            counts[np.arange(allowed.size), allowed] += 1
            good = worth(separations(hypotheses, answers, counts))
            now = good[np.flatnonzero(allowed == design[place])[0]]
            if np.max(good) > GAIN * now:
                design[place] = allowed[int(np.argmax(good))]
        if np.array_equal(before, design):
            break
    return np.sort(design)
