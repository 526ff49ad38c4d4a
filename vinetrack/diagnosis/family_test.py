"""A test of all candidates at once that gives each of them an equal share of the false alarms.

A candidate that is tried in many shapes has many chances to stand out, a candidate of one shape has one. Held against
one threshold for all scores, the first takes most of the false alarms and lifts the threshold of the second. So the
largest score of every candidate becomes its own p-value, and the family is tested by the least of them (min-p;
Westfall & Young, *Resampling-Based Multiple Testing*, 1993): every candidate has the threshold that it alone exceeds
with probability q, and q is such that any of them exceeds its own with probability `level`.

Probabilities that any of many correlated normal scores exceeds its threshold come from importance sampling (Adler,
Blanchet & Liu, Annals of Applied Probability 22, 1167, 2012): a score is chosen in proportion to its own tail, drawn
beyond its threshold, and the others given it; with N the number that exceed theirs then,

    P(any) = Σ_j P(j) · E[1 / N],

as exact at a chance of one in a million as at one in ten.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from vinetrack.core.records import Floats

DRAWS, SEED = 2000, 20
"""Draws of the scores. Measured: with 2000 the thresholds of 13 to 134 shapes differ by 0.01 standard deviations from
seed to seed (tests/diagnosis/test_family_test.py)."""

NODES = 6
"""Thresholds at which a candidate's own chance is worked out, linear between them in ln p over z². Chosen: steps of a
quarter of a standard deviation, where what is left of curvature is a thousandth of ln p."""

HALVINGS = 30
"""Derived: halvings of the range of ln q, which spans less than 10, down to 1e-8."""


@dataclass(frozen=True)
class FamilyTest:
    """Thresholds of all candidates, in standard deviations of a score.

    `candidate_level` is the probability with which each candidate alone exceeds its threshold; `thresholds` are by name
    of effect.
    """

    level: float
    candidate_level: float
    thresholds: Mapping[str, float]

    def threshold(self, name: str) -> float:
        """The threshold of a candidate; of one without shapes, that of a single score of either sign.

        Parameters
        ----------
        name : of an effect or another hypothesis.

        Returns
        -------
        float
        """
        return self.thresholds.get(name, self.single_shape_threshold)

    @property
    def single_shape_threshold(self) -> float:
        """Threshold of a candidate that is tried in one shape, of either sign."""
        return -float(ndtri(self.candidate_level / 2))


class _Scores:
    """Correlated normal scores that count in one direction or in both, and how likely they exceed thresholds."""

    def __init__(self, cosines: Floats, signs: Sequence[int]) -> None:
        self.live = np.diag(cosines) > 0
        self.cosines, self.signs = cosines, np.array(signs)
        values, vectors = np.linalg.eigh(cosines)
        draw = np.random.default_rng(SEED)
        self.normal = draw.standard_normal((DRAWS, len(signs))) @ (vectors * np.sqrt(np.maximum(values, 0.0))).T
        self.beyond, self.coin = draw.random(DRAWS), draw.choice([-1.0, 1.0], DRAWS)
        self.picks = (np.arange(DRAWS) + 0.5) / DRAWS
        self.picks = draw.permutation(self.picks)

    def chance(self, places: NDArray[np.intp], thresholds: Floats) -> float:
        """Chance that any score at these places exceeds its threshold."""
        signs = self.signs[places]
        tails = ndtr(-thresholds)
        weights = np.where(signs == 0, 2.0, 1.0) * tails
        total = float(weights.sum())
        if len(places) == 1 or total == 0:
            return total
        chosen = np.minimum(np.searchsorted(np.cumsum(weights) / total, self.picks), len(places) - 1)
        side = np.where(signs[chosen] == 0, self.coin, signs[chosen])
        scores = self.normal[:, places]
        new = -ndtri(self.beyond * tails[chosen]) * side
        shift = new - scores[np.arange(DRAWS), chosen]
        scores = scores + self.cosines[np.ix_(places, places)][chosen] * shift[:, None]
        exceed = np.where(signs == 0, np.abs(scores), scores * signs) > thresholds
        return total * float(np.mean(1.0 / np.maximum(exceed.sum(axis=1), 1)))


def family_test(cosines: Floats, signs: Sequence[int], effects: Sequence[str], level: float) -> FamilyTest:
    """Work out the threshold of every candidate.

    Parameters
    ----------
    cosines : array, shape (n_shapes, n_shapes)
        Correlations of the scores.
    signs : sequence of int
        Sign of each size, 0 where it may have either.
    effects : sequence of str
        Name of the effect of each shape.
    level : float
        Chance that any candidate exceeds its threshold where nothing is missing.

    Returns
    -------
    FamilyTest
    """
    if not effects:
        return FamilyTest(level, level, {})
    scores = _Scores(cosines, signs)
    of = np.array(effects)
    places = {name: np.flatnonzero((of == name) & scores.live) for name in dict.fromkeys(effects)}
    places = {name: where for name, where in places.items() if where.size}
    if not places:
        return FamilyTest(level, level, {})
    tables = {name: _own_chances(scores, where, level, len(places)) for name, where in places.items()}
    everywhere = np.concatenate(list(places.values()))

    def thresholds(log_share: float) -> dict[str, float]:
        squares = {name: float(np.interp(-log_share, -logs, nodes)) for name, (nodes, logs) in tables.items()}
        return {name: math.sqrt(square) for name, square in squares.items()}

    low, high = math.log(level / len(places)), math.log(level)
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        each = thresholds(middle)
        asked = np.concatenate([np.full(where.size, each[name]) for name, where in places.items()])
        low, high = (middle, high) if scores.chance(everywhere, asked) < level else (low, middle)
    return FamilyTest(level, math.exp(low), thresholds(low))


def family_p_value(cosines: Floats, signs: Sequence[int], effects: Sequence[str], observed: Floats) -> float:
    """Chance that any candidate stands out as far as the one that does so most: the p-value of the family.

    Parameters
    ----------
    cosines, signs, effects
        As in `family_test`.
    observed : array, shape (n_shapes,)
        Scores where they count in their direction, 0 where they do not.

    Returns
    -------
    float
        1 where there is no candidate. Below 1e-12 it is no more than an order of magnitude.
    """
    scores = _Scores(cosines, signs) if effects else None
    if scores is None or not scores.live.any():
        return 1.0
    of = np.array(effects)
    places = [where for name in dict.fromkeys(effects) if (where := np.flatnonzero((of == name) & scores.live)).size]
    alone = [scores.chance(where, np.full(where.size, max(float(observed[where].max()), 0.0))) for where in places]
    least = min(alone)
    limits = []
    for where in places:
        nodes, logs = _own_chances(scores, where, least, len(places))
        limits.append(math.sqrt(float(np.interp(-math.log(max(least, 1e-300)), -logs, nodes))))
    asked = np.concatenate([np.full(where.size, limit) for where, limit in zip(places, limits, strict=True)])
    return min(scores.chance(np.concatenate(places), asked), 1.0)


def _own_chances(scores: _Scores, places: NDArray[np.intp], level: float, candidates: int) -> tuple[Floats, Floats]:
    """Squares of thresholds of a candidate, increasing, and ln of the chance at which it exceeds each."""
    most = 2.0 * len(places) * candidates
    nodes = np.linspace(-float(ndtri(min(level, 0.4))), -float(ndtri(max(level, 1e-290) / most)), NODES)
    chances = [scores.chance(places, np.full(places.size, node)) for node in nodes]
    return nodes**2, np.log(np.maximum(chances, 1e-300))
