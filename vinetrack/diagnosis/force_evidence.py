"""How likely a force over some variables makes the tracks, and the most likely force among all that they allow.

A force that is nothing where growth begins, one that is a constant there and one that is anything there are compared by
their marginal likelihoods: see `force_surface` for why the first is what is drawn unless the tracks are against it.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.diagnosis.force_refinement import Normal, Place
from vinetrack.diagnosis.force_surface import AMPLITUDES, ANY, FOLLOWED, LENGTHS, Domain, Surface, standard_error
from vinetrack.diagnosis.likelihood_ratio import ANSWER_SET_DELTA_CHI2

LEAST_INFORMATION = 1e-8
"""Information below which a direction is not told apart from others, where each number alone has 1. Derived: sums of
squares are rounded at 1e-14 of the largest, and the score of such a direction at its root."""

UNLIKELY = 5.0
"""ln of how much less likely lengths and amplitudes may be to count in the mean and the band. Chosen: a hundredth and
a half; at twice of it the band is the same within a hundredth and takes four times as long."""

DRAWN = 30
"""Points over a variable at which it is asked what a force is known to. Chosen: more than it has splines."""


@dataclass(frozen=True)
class Posterior:
    """What positions say of the coefficients of a domain's splines: precision, score about 0, χ² at 0, its fall.

    `log_determinant` is that of the information on all other numbers.
    """

    information: Floats
    score: Floats
    cost: float
    gain: float
    log_determinant: float

    @property
    def lowest(self) -> float:
        """χ² of the best coefficients, whatever the prior says of how smooth they are."""
        return self.cost - self.gain

    @property
    def finite(self) -> bool:
        """Whether positions say anything: far beyond what trials have been through numbers overflow."""
        parts = (self.information, self.score, self.cost, self.gain, self.log_determinant)
        return all(bool(np.isfinite(part).all()) for part in parts)


@dataclass(frozen=True)
class Beginning:
    """A force that begins in one way, with its marginal likelihood at the most likely lengths and amplitude.

    `mean` and `covariance` are those of the splines' coefficients, N; `left` is the χ² that it leaves.
    """

    begins: str
    log_evidence: float
    surface: Surface
    lengths: tuple[float, ...]
    mean: Floats
    covariance: Floats
    left: float

    def force(self, values: Sequence[Floats]) -> tuple[Floats, Floats]:
        """The force at values of the variables, SI, and its standard error, each of shape (n,), N.

        Parameters
        ----------
        values : sequence of arrays, shape (n,), SI
            One a variable.

        Returns
        -------
        force, sigma : arrays, shape (n,), N
        """
        basis = self.surface.domain.basis(values)
        return basis @ self.mean, standard_error(basis, self.covariance)


@dataclass(frozen=True)
class VariableChoice:
    """A domain with its marginal likelihood, averaged over all ways to begin, and each of these."""

    domain: Domain
    log_evidence: float
    beginnings: tuple[Beginning, ...]

    def best(self, error: float = 1.0) -> Beginning:
        """The force that is drawn; differences of ln Z count in units of `error`.

        Where growth begins it is nothing, or a constant where that is likelier. Whether it is anything else there stays
        open unless that is worth Δχ² 9: B, n and P_y could hold it. The band holds what nothing and a constant differ
        by, each as likely as it is.

        Parameters
        ----------
        error : float
            What ln Z is known to.

        Returns
        -------
        Beginning
        """
        narrow = [each for each in self.beginnings if each.begins != ANY]
        wide = [each for each in self.beginnings if each.begins == ANY]
        most = max((each.log_evidence for each in narrow), default=-math.inf)
        if not narrow or (wide and wide[0].log_evidence > most + 0.5 * ANSWER_SET_DELTA_CHI2 * error):
            return wide[0]
        weights = np.exp([(each.log_evidence - most) / error for each in narrow])
        weights /= weights.sum()
        likely = next(each for each in narrow if each.log_evidence > most - error)
        covariance = np.zeros_like(likely.covariance)
        for weight, each in zip(weights, narrow, strict=True):
            off = each.mean - likely.mean
            covariance += weight * (each.covariance + np.outer(off, off))
        return replace(likely, covariance=covariance)

    @property
    def undecided_N(self) -> float:
        """What a force where growth begins is known to, N, beside B, n and P_y: the median over its other variable."""
        wide = [each for each in self.beginnings if each.begins == ANY]
        if not wide or self.domain.course < 0:
            return 0.0
        grid = [np.linspace(low, high, DRAWN) for low, high in zip(self.domain.low, self.domain.high, strict=True)]
        grid[self.domain.course] = np.full(DRAWN, self.domain.low[self.domain.course])
        return float(np.median(wide[0].force(grid)[1]))

    def smooth_from(self, begins: str) -> Surface:
        """As smooth and as large as the most likely force, but one that begins in this way where it may.

        Where motions do not follow the force yet, what they lack at their begin would pass for a force there.

        Parameters
        ----------
        begins : str

        Returns
        -------
        Surface
        """
        likely = max(self.beginnings, key=lambda each: each.log_evidence)
        return Surface(self.domain, self.domain.mix(likely.lengths, begins, FOLLOWED), likely.surface.sd_N)


def posterior(place: Place, normal: Normal) -> Posterior:
    """All numbers but the coefficients of the force integrated out; in units in which each has unit information.

    Parameters
    ----------
    place : where the search stands.
    normal : its normal equations.

    Returns
    -------
    Posterior
    """
    p, q = place.theta.size, place.amplitude.size
    size = np.diag(normal.square)
    unit = np.where(size > 0, 1 / np.sqrt(np.where(size > 0, size, 1.0)), 0.0)
    square, slope = normal.square * unit[:, None] * unit, normal.slope * unit
    force = np.arange(p, p + q)
    beside = np.concatenate([np.arange(p), np.arange(p + q, slope.size)])
    beside = beside[size[beside] > 0]
    values, directions = np.linalg.eigh(square[np.ix_(beside, beside)])
    told = values > LEAST_INFORMATION
    root = directions[:, told] / np.sqrt(values[told])
    cross, along = root.T @ square[np.ix_(beside, force)], root.T @ slope[beside]
    strength, ways = np.linalg.eigh(square[np.ix_(force, force)] - cross.T @ cross)
    # What other numbers do as well is known no better than numbers are rounded.
    ways, strength = ways[:, strength > LEAST_INFORMATION], strength[strength > LEAST_INFORMATION]
    scale = np.where(unit[force] > 0, 1 / np.where(unit[force] > 0, unit[force], 1.0), 0.0)
    back = scale[:, None] * ways
    heard = ways.T @ (slope[force] - cross.T @ along)
    inner = scale * place.amplitude @ ways
    cost = normal.cost - float(along @ along)
    return Posterior(
        information=(back * strength) @ back.T,
        score=back @ (heard + strength * inner),
        cost=cost + 2 * float(heard @ inner) + float(strength @ inner**2),
        gain=float(np.sum((heard + strength * inner) ** 2 / strength)),
        log_determinant=float(np.sum(np.log(values[told]))) - 2 * float(np.sum(np.log(unit[beside]))),
    )


def weighed(domain: Domain, told: Posterior, inflation: float, largest_N: float) -> VariableChoice:
    """The marginal likelihood of a domain, averaged over ways to begin, lengths and amplitudes.

    Parameters
    ----------
    domain : the variables.
    told : what positions say of a force over them.
    inflation : float
        By how much χ² counts for less than noise alone would let it.
    largest_N : float
        The largest drive of any trial.

    Returns
    -------
    VariableChoice
    """
    beginnings = tuple(_begun(domain, begins, told, inflation, largest_N) for begins in domain.beginnings)
    logs = np.array([each.log_evidence for each in beginnings])
    return VariableChoice(domain, float(logs.max() + np.log(np.mean(np.exp(logs - logs.max())))), beginnings)


def _begun(domain: Domain, begins: str, told: Posterior, inflation: float, largest_N: float) -> Beginning:
    """One way to begin: averaged over lengths and amplitudes, each as likely as positions make it.

    In the directions of one choice of lengths, each known by itself, only the shrinkage depends on the amplitude.
    """
    sizes_N = largest_N * AMPLITUDES[:, None]
    by_length, tried = [], []
    for lengths in itertools.product(LENGTHS, repeat=len(domain.variables)):
        mix = domain.mix(lengths, begins)
        values, directions = np.linalg.eigh(mix.T @ told.information @ mix / inflation)
        heard = directions.T @ (mix.T @ told.score) / inflation
        spread = 1 + sizes_N**2 * np.maximum(values, 0.0)
        shrunk = sizes_N**2 / spread
        by_length.append(0.5 * np.sum(shrunk * heard**2 - np.log(spread), axis=1))
        tried.append((lengths, mix @ directions, shrunk, shrunk * heard))
    logs = np.array(by_length)
    best, size = np.unravel_index(np.argmax(logs), logs.shape)
    most = logs[best, size]
    likelihoods = np.exp(logs - most)
    evidence = most + math.log(float(np.mean(likelihoods)))
    weights = np.where(logs > most - UNLIKELY, likelihoods, 0.0)
    weights /= weights.sum()
    mean, square = np.zeros(domain.size), np.zeros((domain.size, domain.size))
    for weight, (_, ways, shrunk, means) in zip(weights, tried, strict=True):
        if weight.any():
            mean += ways @ (weight @ means)
            square += ways @ (np.diag(weight @ shrunk) + (means.T * weight) @ means) @ ways.T
    lengths = tried[best][0]
    return Beginning(
        begins,
        float(evidence) - 0.5 * told.cost / inflation - 0.5 * told.log_determinant,
        Surface(domain, domain.mix(lengths, begins, FOLLOWED), float(sizes_N[size, 0])),
        lengths,
        mean,
        square - np.outer(mean, mean),
        told.cost - 2 * float(told.score @ mean) + float(mean @ told.information @ mean),
    )


def posterior_weights(choices: Sequence[VariableChoice], error: float) -> dict[str, float]:
    """Posterior weights of choices by name, one variable and two with the same odds beforehand.

    Parameters
    ----------
    choices : sequence of VariableChoice
    error : float
        What ln Z is known to.

    Returns
    -------
    dict, best first
    """
    counts = {size: sum(len(choice.domain.variables) == size for choice in choices) for size in (1, 2)}
    most = max(choice.log_evidence for choice in choices)
    raw = {
        choice.domain.name: math.exp((choice.log_evidence - most) / error) / counts[len(choice.domain.variables)]
        for choice in choices
    }
    return {name: value / sum(raw.values()) for name, value in sorted(raw.items(), key=lambda part: -part[1])}
