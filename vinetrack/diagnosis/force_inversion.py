"""Least squares for forces that a model lacks, beside its own numbers and those of every trial."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.diagnosis.replicate_scatter import LEAST_BETWEEN_TRIAL_SD, Scatter
from vinetrack.inference.fit_problem import track_correlation, variance_floor
from vinetrack.inference.fit_result import Fit
from vinetrack.inference.mixed_effects import DEVIATION_COLUMNS, FitState, trial_effect_prior
from vinetrack.inference.optimiser import FixedTerms, solve
from vinetrack.inference.sensitivity import N_TRIAL_EFFECTS
from vinetrack.inference.whitening import whiten

PER_TRIAL = 10.0
"""Independent pieces of information that one trial counts for: its frames err together. Chosen: residual correlation
times of a tenth of a recording; half or twice moves the error of a force by 1.4."""

OWN_ITERATIONS = 8
"""Iterations of the trial effects at most. Chosen."""

LEAST_INFORMATION = 1e-9
"""Part of the largest information below which a force moves nothing, or only what others move too. Chosen far below
anything of weight."""

SMOOTHNESS = np.geomspace(1e-6, 1e2, 17)


@dataclass(frozen=True)
class Gain:
    """What forces explain: the fall of χ², their amplitudes, N, and the error of one.

    `terms` counts the amplitudes that the data feel: chance alone lets χ² fall by as much. `numbers` is how the model's
    own numbers move along, as the fit holds them.
    """

    chi2: float
    amplitude: Floats
    sigma: float
    numbers: Floats
    terms: int

    @property
    def beyond(self) -> float:
        """The fall of χ² beyond what chance gives."""
        return max(self.chi2 - self.terms, 0.0)


class ForceFit:
    """The trials of a fit laid out for any number of forces.

    The noise is that of the tracks: what the model misses is no noise. Pressure and B of a trial scatter as replicates
    do. `chi2` is what is left without any further force. `own`, shape (n_trials, 4), is where the trials' own numbers
    begin: each comes as near to its track as they let it, so that little is left for forces.
    """

    def __init__(self, fit: Fit, trial_effects: Floats, scatter: Scatter) -> None:
        data, problem = fit.predictor.data, fit.solution.problem
        rho = track_correlation(data)
        noise = np.array([trial_data.noise_m**2 for trial_data in data]) * (1 - rho**2)
        self.scatter = scatter
        spread = (max(scatter.pressure, LEAST_BETWEEN_TRIAL_SD[0]), max(scatter.damping, LEAST_BETWEEN_TRIAL_SD[1]))
        before = fit.solution.state
        state = FitState(before.theta, trial_effects, spread, rho, np.maximum(noise, variance_floor(data)))
        still = replace(problem, free=np.zeros_like(problem.free))
        held = FixedTerms(spread, (rho, state.variance))
        solution = solve(fit.predictor, still, state, held, warm=True, most_iterations=OWN_ITERATIONS)
        self.data, self.problem = data, problem
        self.state, self.columns = solution.state, solution.columns
        self.precision = trial_effect_prior(problem, self.state)[1]
        self.pull = -problem.prior_precision * (state.theta - problem.prior_mean)
        self.conditions = [trial_data.trial.condition for trial_data in data]
        self.points = float(sum(trial_data.time_s.size for trial_data in data))

    @property
    def trial_effects(self) -> Floats:
        """The trials' own numbers, about which everything is linear, shape (n_trials, 4)."""
        return self.state.trial_effects

    def _blocks(self, answers: Sequence[Floats]) -> Floats:
        """Products of [keys, forces, residual] of every trial, its own numbers eliminated."""
        blocks = []
        for i, (columns, more) in enumerate(zip(self.columns, answers, strict=True)):
            left = (
                columns[:, -1]
                + columns[:, list(DEVIATION_COLUMNS)] @ self.state.trial_effects[i, list(DEVIATION_COLUMNS)]
            )
            rows = np.column_stack([columns[:, :-1], more, left])
            white = whiten(rows, self.data[i].first, self.state.rho, self.data[i].relative_sd)
            gram = white.T @ white / self.state.variance[i]
            within_trial = gram[:N_TRIAL_EFFECTS, :N_TRIAL_EFFECTS] + np.diag(self.precision[i])
            blocks.append(
                gram[N_TRIAL_EFFECTS:, N_TRIAL_EFFECTS:]
                - gram[N_TRIAL_EFFECTS:, :N_TRIAL_EFFECTS]
                @ np.linalg.solve(within_trial, gram[:N_TRIAL_EFFECTS, N_TRIAL_EFFECTS:])
            )
        return np.array(blocks)

    def _spread(self, blocks: Floats) -> tuple[Floats, Floats, Floats]:
        """Sums over trials: numbers with themselves (p, p), with forces and residual (p, L + 1), and the rest."""
        k, p = self.problem.index.shape[1], self.pull.size
        index = self.problem.index
        square, cross = np.zeros((p + 1, p + 1)), np.zeros((p + 1, blocks.shape[1] - k))
        np.add.at(square, (index[:, :, None], index[:, None, :]), blocks[:, :k, :k])
        np.add.at(cross, index, blocks[:, :k, k:])
        square, cross = square[:p, :p] + np.diag(self.problem.prior_precision), cross[:p].copy()
        cross[:, -1] += self.pull
        still = ~self.problem.free | ~(np.diag(square) > 0)
        square[still, :] = square[:, still] = cross[still] = 0.0
        return square, cross, blocks[:, k:, k:].sum(axis=0)

    def _inverse(self, square: Floats) -> Floats:
        scale = np.where(np.diag(square) > 0, 1 / np.sqrt(np.maximum(np.diag(square), 1e-300)), 0.0)
        inverse = np.linalg.pinv(square * scale[:, None] * scale, rcond=1e-11, hermitian=True)
        return np.asarray(inverse * scale[:, None] * scale)

    def gains(self, answers: Sequence[Floats], columns: Sequence[int]) -> list[Gain]:
        """What each of several forces explains alone; `columns` counts the columns of each among the answers.

        Parameters
        ----------
        answers : sequence of arrays, shape (n_points, n_columns), m
            What the forces do to the positions of each trial, side by side.
        columns : sequence of int
            Columns of each force.

        Returns
        -------
        list of Gain
        """
        blocks = self._blocks(answers)
        square, cross, total = self._spread(blocks)
        inverse = self._inverse(square)
        lever = inverse @ cross
        left = total - cross.T @ lever
        ends = np.concatenate([[0], np.cumsum(columns)])
        return [self._gain(blocks, lever, left, slice(a, b)) for a, b in itertools.pairwise(ends.tolist())]

    def _gain(self, blocks: Floats, lever: Floats, left: Floats, place: slice) -> Gain:
        information, score = left[place, place], left[place, -1]
        size = np.diag(information)
        heard = size > LEAST_INFORMATION * max(float(size.max()), 1e-300)
        if not heard.any():
            return Gain(0.0, np.zeros(score.size), math.inf, np.zeros(lever.shape[0]), 0)
        scale = np.where(heard, 1 / np.sqrt(np.maximum(size, 1e-300)), 0.0)
        covariance = np.linalg.pinv(information * scale[:, None] * scale, rcond=LEAST_INFORMATION, hermitian=True)
        covariance = covariance * scale[:, None] * scale
        amplitude = covariance @ score
        numbers = lever[:, -1] - lever[:, place] @ amplitude
        single = self._scores(blocks, lever[:, place], place, amplitude, numbers)
        count = len(single)
        robust = covariance @ (single.T @ single * count / max(count - numbers.size - score.size, 1)) @ covariance
        sigma = math.sqrt(max(float(np.trace(covariance)), float(np.trace(robust))) / score.size)
        return Gain(float(score @ amplitude), amplitude, sigma, numbers, int(np.count_nonzero(heard)))

    def _scores(self, blocks: Floats, lever: Floats, place: slice, amplitude: Floats, numbers: Floats) -> Floats:
        """What single trials say beyond the fit about amplitudes, shape (n_trials, n_columns)."""
        k = self.problem.index.shape[1]
        index = self.problem.index
        moved = np.append(numbers, 0.0)[index]
        forces = slice(k + place.start, k + place.stop)
        left = blocks[:, :, -1] - np.einsum("nqk,nk->nq", blocks[:, :, :k], moved) - blocks[:, :, forces] @ amplitude
        levers = np.vstack([lever, np.zeros((1, lever.shape[1]))])[index]
        return np.asarray(left[:, forces] - np.einsum("nkl,nk->nl", levers, left[:, :k]))

    def information(self, answers: Sequence[Floats]) -> tuple[Floats, Floats]:
        """Precision and score of forces that are the same in every trial, all other numbers integrated out.

        Parameters
        ----------
        answers : sequence of arrays, shape (n_points, n_columns), m

        Returns
        -------
        information : array, shape (n_columns, n_columns), 1/N²
        score : array, shape (n_columns,), 1/N
        """
        square, cross, total = self._spread(self._blocks(answers))
        left = total - cross.T @ self._inverse(square) @ cross
        return left[:-1, :-1], left[:-1, -1]

    def together(self, answers: Sequence[Floats]) -> Gain:
        """What forces explain all together, the same in every trial.

        Parameters
        ----------
        answers : sequence of arrays, shape (n_points, n_columns), m

        Returns
        -------
        Gain
        """
        return self.gains(answers, [answers[0].shape[1]])[0]

    def by_condition(self, answers: Sequence[Floats]) -> Gain:
        """What forces explain all together, each condition with amplitudes of its own.

        Parameters
        ----------
        answers : sequence of arrays, shape (n_points, n_columns), m

        Returns
        -------
        Gain
        """
        names = list(dict.fromkeys(self.conditions))
        count = answers[0].shape[1]
        wide = []
        for condition, answer in zip(self.conditions, answers, strict=True):
            block = np.zeros((len(answer), count * len(names)))
            k = names.index(condition) * count
            block[:, k : k + count] = answer
            wide.append(block)
        return self.together(wide)

    @cached_property
    def chi2(self) -> float:
        """What is left without any further force."""
        blocks = self._blocks([np.zeros((len(c), 0)) for c in self.columns])
        square, cross, total = self._spread(blocks)
        return float(total[-1, -1] - cross[:, -1] @ self._inverse(square) @ cross[:, -1])

    def bic(self, chi2: float, numbers: int, most: float) -> float:
        """How badly forces of so many numbers do beside the `most` that any explained: smaller is better.

        What not even that explains is no noise but counts as if it were, once for every independent piece.

        Source: Schwarz, Annals of Statistics 6, 461 (1978), with the misfit scaled by what nothing explains.

        Parameters
        ----------
        chi2 : float
            What the forces explain.
        numbers : int
            Numbers that they have.
        most : float
            The most that any explained.

        Returns
        -------
        float
        """
        pieces = PER_TRIAL * len(self.data)
        beyond = max(self.chi2 - most - self.points, 0.0)
        return (most - chi2) / (1 + beyond / pieces) + numbers * math.log(pieces)

    def smooth(self, answers: Sequence[Floats], numbers: Floats) -> dict[str, tuple[Floats, Floats]]:
        """A smooth force in every condition, the model's numbers moved by `numbers`: coefficients and covariance.

        As smooth as generalised cross-validation finds best, the same in all conditions.

        Parameters
        ----------
        answers : sequence of arrays, shape (n_points, n_columns), m
            Of a spline's pieces.
        numbers : array, shape (n_free,)
            How far the model's numbers moved, scaled.

        Returns
        -------
        dict of (coefficients, covariance)
            By condition; shapes (n_columns,) and (n_columns, n_columns), N.
        """
        blocks = self._blocks(answers)
        k = self.problem.index.shape[1]
        moved = np.append(numbers, 0.0)[self.problem.index]
        names = list(dict.fromkeys(self.conditions))
        place = np.array([names.index(condition) for condition in self.conditions])
        count = answers[0].shape[1]
        square, slope = np.zeros((len(names), count, count)), np.zeros((len(names), count))
        left = blocks[:, k:, -1] - np.einsum("nlk,nk->nl", blocks[:, k:, :k], moved)
        np.add.at(square, place, blocks[:, k:-1, k:-1])
        np.add.at(slope, place, left[:, :-1])
        bend = np.diff(np.eye(count), 2, axis=0)
        unit = float(np.mean(np.einsum("nkk->n", square))) / count
        rough = unit * (bend.T @ bend + 1e-6 * np.eye(count))
        best: tuple[float, Floats, Floats] | None = None
        pieces = PER_TRIAL * len(self.data)
        whole = float(np.sum(slope * np.linalg.solve(square + 1e-9 * rough, slope[:, :, None])[:, :, 0]))
        for strength in SMOOTHNESS:
            inverse = np.linalg.inv(square + strength * rough)
            coefficients = np.einsum("nkl,nl->nk", inverse, slope)
            missed = whole - float(
                np.sum(2 * coefficients * slope) - np.einsum("nk,nkl,nl->", coefficients, square, coefficients)
            )
            freedom = float(np.einsum("nkl,nlk->", inverse, square))
            score = (missed + pieces) / max(pieces - freedom, 1.0) ** 2
            if best is None or score < best[0]:
                best = score, coefficients, inverse
        assert best is not None
        spare = max(self.points - count * len(names), 1.0)
        noise = max(1.0, (self.chi2 - whole) / spare) if not numbers.any() else 1.0
        return {name: (best[1][i], noise * best[2][i]) for i, name in enumerate(names)}
