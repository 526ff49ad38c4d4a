"""Family-wise thresholds of all candidates that give each of them an equal share of the false alarms.

A candidate with many shapes has many chances of a large score, a candidate with one shape has one. With one threshold
for all scores the first would take most of the false alarms and raise the threshold of the second. The largest score of
each candidate is therefore converted to a p-value of its own, and the family is tested by the smallest (min-p; Westfall
& Young, *Resampling-Based Multiple Testing*, 1993): every candidate has the threshold that it alone exceeds with
probability q, and q is such that any candidate exceeds its own with probability `level`.

The probability that any of many correlated normal scores exceeds its threshold is found by importance sampling (Adler,
Blanchet & Liu, Annals of Applied Probability 22, 1167, 2012): a score is chosen in proportion to its tail probability
and drawn beyond its threshold, and the others are drawn conditionally on it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from vinetrack.core.records import Floats

DRAWS, SEED = 2000, 20  # Draws of the scores, and the seed (measured)

NODES = 6  # Thresholds at which a candidate's exceedance probability p is computed (chosen)

HALVINGS = 30  # Bisection steps for ln q (derived)


@dataclass(frozen=True)
class FamilyTest:
    """Thresholds of all candidates, in standard deviations of a score. `candidate_level` is the probability with which
    each candidate alone exceeds its threshold; `thresholds` are by name of effect.
    """

    level: float
    candidate_level: float
    thresholds: Mapping[str, float]

    def threshold(self, name: str) -> float:
        """Threshold of a candidate; of one without shapes, that of a single two-sided score."""
        return self.thresholds.get(name, self.single_shape_threshold)

    @property
    def single_shape_threshold(self) -> float:
        """Threshold of a candidate with one shape and a size of either sign (two-sided)."""
        return -float(ndtri(self.candidate_level / 2))


class _Scores:
    """Correlated normal scores, one-sided or two-sided, and the probability that any exceeds its threshold."""

    def __init__(self, cosines: Floats, signs: Sequence[int]) -> None:
        self.informative = np.diag(cosines) > 0
        self.cosines, self.signs = cosines, np.array(signs)
        values, vectors = np.linalg.eigh(cosines)
        draw = np.random.default_rng(SEED)
        self.normal = draw.standard_normal((DRAWS, len(signs))) @ (vectors * np.sqrt(np.maximum(values, 0.0))).T
        self.tail_uniform, self.random_sign = draw.random(DRAWS), draw.choice([-1.0, 1.0], DRAWS)
        self.choice_uniform = (np.arange(DRAWS) + 0.5) / DRAWS
        self.choice_uniform = draw.permutation(self.choice_uniform)

    def exceedance(self, indices: NDArray[np.intp], thresholds: Floats) -> float:
        """Probability that any of these scores exceeds its threshold."""
        signs = self.signs[indices]
        tails = ndtr(-thresholds)
        weights = np.where(signs == 0, 2.0, 1.0) * tails
        total = float(weights.sum())
        if len(indices) == 1 or total == 0:
            return total
        chosen = np.minimum(np.searchsorted(np.cumsum(weights) / total, self.choice_uniform), len(indices) - 1)
        side = np.where(signs[chosen] == 0, self.random_sign, signs[chosen])
        scores = self.normal[:, indices]
        beyond = -ndtri(self.tail_uniform * tails[chosen]) * side
        shift = beyond - scores[np.arange(DRAWS), chosen]
        # The other scores move with the chosen one by their correlation with it.
        scores = scores + self.cosines[np.ix_(indices, indices)][chosen] * shift[:, None]
        exceed = np.where(signs == 0, np.abs(scores), scores * signs) > thresholds
        return total * float(np.mean(1.0 / np.maximum(exceed.sum(axis=1), 1)))


def family_test(cosines: Floats, signs: Sequence[int], effects: Sequence[str], level: float) -> FamilyTest:
    """Compute the threshold of every candidate. Shapes: cosines (n_shapes, n_shapes)."""
    if not effects:
        return FamilyTest(level, level, {})
    scores = _Scores(cosines, signs)
    names = np.array(effects)
    shapes = {name: np.flatnonzero((names == name) & scores.informative) for name in dict.fromkeys(effects)}
    shapes = {name: indices for name, indices in shapes.items() if indices.size}
    if not shapes:
        return FamilyTest(level, level, {})
    tables = {name: _exceedance_table(scores, indices, level, len(shapes)) for name, indices in shapes.items()}
    all_shapes = np.concatenate(list(shapes.values()))

    def thresholds(log_q: float) -> dict[str, float]:
        squares = {name: float(np.interp(-log_q, -logs, nodes)) for name, (nodes, logs) in tables.items()}
        return {name: math.sqrt(square) for name, square in squares.items()}

    low, high = math.log(level / len(shapes)), math.log(level)
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        by_name = thresholds(middle)
        by_shape = np.concatenate([np.full(indices.size, by_name[name]) for name, indices in shapes.items()])
        low, high = (middle, high) if scores.exceedance(all_shapes, by_shape) < level else (low, middle)
    return FamilyTest(level, math.exp(low), thresholds(low))


def family_p_value(cosines: Floats, signs: Sequence[int], effects: Sequence[str], observed: Floats) -> float:
    """Family-wise p-value of the most significant candidate. Returns 1 where there is no candidate. Shapes: observed
    (n_shapes,).
    """
    scores = _Scores(cosines, signs) if effects else None
    if scores is None or not scores.informative.any():
        return 1.0
    names = np.array(effects)
    shapes = [
        indices
        for name in dict.fromkeys(effects)
        if (indices := np.flatnonzero((names == name) & scores.informative)).size
    ]
    p_values = [
        scores.exceedance(indices, np.full(indices.size, max(float(observed[indices].max()), 0.0)))
        for indices in shapes
    ]
    smallest = min(p_values)
    thresholds = []
    for indices in shapes:
        nodes, logs = _exceedance_table(scores, indices, smallest, len(shapes))
        thresholds.append(math.sqrt(float(np.interp(-math.log(max(smallest, 1e-300)), -logs, nodes))))
    by_shape = np.concatenate([np.full(k.size, threshold) for k, threshold in zip(shapes, thresholds, strict=True)])
    return min(scores.exceedance(np.concatenate(shapes), by_shape), 1.0)


def _exceedance_table(
    scores: _Scores, indices: NDArray[np.intp], level: float, candidates: int
) -> tuple[Floats, Floats]:
    """Squares of thresholds of a candidate, increasing, and ln of the probability that it exceeds each."""
    n_tests = 2.0 * len(indices) * candidates
    nodes = np.linspace(-float(ndtri(min(level, 0.4))), -float(ndtri(max(level, 1e-290) / n_tests)), NODES)
    probabilities = [scores.exceedance(indices, np.full(indices.size, node)) for node in nodes]
    return nodes**2, np.log(np.maximum(probabilities, 1e-300))
