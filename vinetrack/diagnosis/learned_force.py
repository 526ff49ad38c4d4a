"""The missing force learned as a smooth function of one or two variables, inside the trajectory fit.

The force is a Gaussian process over growth, speed, time since release or pressure, or over two of them together
(`vinetrack.diagnosis.force_surface`). Its coefficients are fitted to positions, through what a force does to them, with
B, n, yield pressures and the release, origin, pressure and B of every trial free beside it, each with its own prior;
nothing is differentiated. For each choice of variables

    ln Z = −½ χ²(ĉ) − ½ ln |H| + ½ ln |K⁻¹|,   H = ∇∇ ½χ² + K⁻¹

is the marginal likelihood in Laplace's approximation (exact where positions are linear in the force), χ² with the
priors of all numbers, averaged over the amplitude and the lengths of the process. Forces that are not small bend that:
the best choices are followed to where their force leads (`force_refinement`) and weighed there. Posterior weights of
the choices then follow from ln Z, with equal odds beforehand for one variable and for two (Rasmussen & Williams 2006,
ch. 5).

What no force explains is no noise, but is weighed as if it were: χ² is divided by what the best leaves per point. Steps
end once χ² falls by less than a part of itself (`SETTLED`); differences of ln Z are counted in units of that.
A force that B, n and P_y could take over as well is not decided by these data. It is drawn as small as it may be, and
the band holds what they could shift. Growth, speed and time are hardly three variables where speeds are steady: weights
then lean to whichever surface is smoother. Choices that the tracks themselves do not exclude are named beside the best
(`learned_variables`). `vinetrack.diagnosis.propose` seeks a law for the force, or writes it as a table.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.diagnosis.force_inversion import ForceFit
from vinetrack.diagnosis.force_refinement import SETTLED, Normal, Place, followed, normal_equations
from vinetrack.diagnosis.force_sensitivities import FittedMotion, motions_of
from vinetrack.diagnosis.force_surface import AMPLITUDES, LENGTHS, VARIABLES, Domain, Surface, domains
from vinetrack.diagnosis.learned_variables import dependence, named, not_excluded
from vinetrack.diagnosis.likelihood_ratio import ANSWER_SET
from vinetrack.diagnosis.smoothed_motions import on_tracks
from vinetrack.inference.fit_result import Fit

if TYPE_CHECKING:
    import pandas as pd

LEARNED_COLUMNS = (*VARIABLES.values(), "force_N", "sigma_N", "trials", "condition")

HEARD = 18.0
"""ln Z beyond that of no force at all, for a force to be learned. Chosen: six standard deviations; at half of it noise
that is not quite what it is taken for is drawn as a force now and then, at twice a weak force goes undrawn."""

MISSES = 2.0
"""χ² per point of a model from which a force is learned: below, noise and scatter that are not quite what they are
taken for would pass for one. Chosen as in the words for what is missing."""

FOLLOWED = {1: 1, 2: 3}
"""Choices of one variable and of two that are followed, the best where all is taken as linear. Chosen for time."""

SILENT = 1e-8
"""Information below which a direction is not told apart from others, where each number alone has 1. Derived: sums of
squares are rounded at 1e-14 of the largest, and the score of such a direction at its root."""

ROUNDED = 1e-3
"""Part of the strongest direction below which splines are not set by a force along the motions. Chosen: places that
trials hardly came to are left at nothing; only the start of a search depends on it."""

PIECES = 20
"""Parts of a trial that err by themselves where a model leaves more than noise. Chosen as the pieces of an acceleration
in `smoothed_motions`: points within a part err together, and count as one (the design effect of Kish 1965, §5.4). At
half and at twice of it weights are that much nearer to each other, or farther apart."""

ROUNDS = 2
"""Turns of following a force and of choosing its amplitude and lengths anew. Chosen: the third moves no weight."""

MENDS = 0.95
"""Part of the misfit that a force must take away once it is followed, to be told. Chosen: what leaves more has not
settled, or something else is missing beside it, and weights of variables say nothing then. At half of the misfit wrong
variables are named where a force is of the drive's own size."""

DRAWN, NEAR = (60, 30), 0.06
"""Points of a curve, and along each side of a map; and how near to a point of the map, as a part of each side, a trial
must have come to have been there. Chosen for the picture."""


@dataclass(frozen=True)
class _Posterior:
    """What positions say of the coefficients of a domain's splines: precision, score about 0, χ² at 0, its fall.

    `log_determinant` is that of the information on all other numbers.
    """

    information: Floats
    score: Floats
    cost: float
    gain: float
    log_determinant: float


@dataclass(frozen=True)
class _Choice:
    """A domain with its marginal likelihood, and the surface whose lengths and amplitude are most likely."""

    domain: Domain
    log_evidence: float
    surface: Surface
    lengths: tuple[float, ...]
    mean: Floats
    covariance: Floats
    left: float

    def force(self, values: Sequence[Floats]) -> tuple[Floats, Floats]:
        """The force at values of the variables, SI, and its standard error, each of shape (n,), N."""
        basis = self.domain.basis(values)
        return basis @ self.mean, np.sqrt(np.einsum("nk,kl,nl->n", basis, self.covariance, basis))


@dataclass(frozen=True)
class LearnedForce:
    """The missing force over the variables that it most likely depends on.

    `weights` are posterior, by `growth`, `growth+speed`, …; `beside` names the choices that are not excluded either;
    `lengths` by variable, as parts of what was visited; `amplitude_N` the standard deviation of the process. `table`,
    columns `LEARNED_COLUMNS`, holds the force on a grid (condition blank; `trials` counts those that came near) and
    along the first trial of each condition; variables that do not count are NaN. `place` is where the fit ended.
    """

    variables: tuple[str, ...]
    weights: Mapping[str, float]
    beside: tuple[str, ...]
    lengths: Mapping[str, float]
    amplitude_N: float
    log_bayes_factor: float
    explained: float
    table: pd.DataFrame
    sentence: str
    place: Place

    def to_json(self) -> dict[str, Any]:
        """As `diagnosis.json` holds it."""
        return {
            "variables": list(self.variables),
            "weights": dict(self.weights),
            "not_excluded": list(self.beside),
            "length_scales": dict(self.lengths),
            "amplitude_N": self.amplitude_N,
            "log_bayes_factor": self.log_bayes_factor,
            "explained": self.explained,
            "sentence": self.sentence,
        }


def learned_force(
    model_fit: Fit, fit: ForceFit, motions: Sequence[FittedMotion], replicates: int
) -> LearnedForce | None:
    """Learn the missing force over the variables that make the tracks most likely.

    Parameters
    ----------
    model_fit : the fit that lacks the force.
    fit : its linear answers to forces.
    motions : sequence of FittedMotion
        The fitted motions that those belong to.
    replicates : int
        Trials beyond the first of each condition.

    Returns
    -------
    LearnedForce, or None where no force is heard, or none can be followed
    """
    if fit.chi2 < MISSES * fit.points:
        return None
    largest_N = max(float(np.max(np.nan_to_num(motion.pressure_Pa) * motion.trial.area_m2)) / 2 for motion in motions)
    effects = np.zeros_like(fit.trial_effects)
    effects[:, : fit.problem.own_centre.shape[1]] = fit.problem.own_centre
    motions = on_tracks(fit, effects, motions_of(model_fit, effects))
    begins = [
        Place(fit.state.theta, effects, surface, np.zeros(surface.domain.size), list(motions), driven=False)
        for surface in (Surface(domain, np.eye(domain.size)) for domain in domains(motions))
    ]
    about = [_posterior(place, normal_equations(model_fit, fit, place)) for place in begins]
    inflation = max(min(posterior.cost - posterior.gain for posterior in about) / fit.points, 1.0)
    silent = -0.5 * about[0].cost / inflation - 0.5 * about[0].log_determinant
    linear = [
        (_weighed(place.law.domain, posterior, inflation, largest_N), place)
        for place, posterior in zip(begins, about, strict=True)
        if isinstance(place.law, Surface)
    ]
    linear.sort(key=lambda pair: -pair[0].log_evidence)
    gain = linear[0][0].log_evidence - silent
    if gain < HEARD:
        return None
    # Where the model is far off linear answers err, most for what has few numbers: the best alone is followed too.
    near = [
        pair
        for size, most in FOLLOWED.items()
        for pair in [pair for pair in linear if len(pair[0].domain.variables) == size][:most]
    ]
    places = [(choice, _followed(model_fit, fit, place, choice, inflation, largest_N)) for choice, place in near]
    there = [(choice, *settled) for choice, settled in places if settled is not None]
    if not there:
        return None
    there = _again(model_fit, fit, there, inflation, largest_N)
    inflation = max(min(settled.cost - settled.gain for _, _, settled in there) / fit.points, 1.0)
    choices = [_weighed(choice.domain, settled, inflation, largest_N) for choice, _, settled in there]
    left = min(choice.left for choice in choices)
    if fit.chi2 - left < MENDS * (fit.chi2 - fit.points):
        return None
    # A fit that has settled within a part of χ² tells no smaller difference; nor do points that err together.
    together = max(fit.points / (PIECES * len(fit.data)), 1.0)
    error = max(0.5 * SETTLED * left, 1 + (inflation - 1) * together) / inflation
    weights = _weights(choices, error)
    best, place = max(
        zip(choices, (place for _, place, _ in there), strict=True), key=lambda pair: weights[pair[0].domain.name]
    )
    place = replace(place, amplitude=best.mean)
    bayes = next(choice.log_evidence for choice, _ in linear if choice.domain == best.domain) - silent
    remarks = []
    if not replicates:
        remarks.append("No condition was repeated: how sure this is rests on the scatter that the fit assumes.")
    if not any("pressure" in choice.domain.variables for choice, _ in linear):
        remarks.append("All trials had one pressure: whether the force depends on it they do not tell.")
    # What the splines of a choice leave at best, whatever the prior says of how smooth they are.
    lowest = {choice.domain.name: end.cost - end.gain for choice, (_, _, end) in zip(choices, there, strict=True)}
    losses = {name: (value - lowest[best.domain.name]) / inflation for name, value in lowest.items()}
    everything = [choice.domain for choice, _ in linear]
    beside = not_excluded(best.domain, weights, losses, ANSWER_SET * error, everything, motions)
    if beside:
        remarks.append("Trials that pass the same growth otherwise, at further pressures or payloads, tell.")
    return _told(fit, best, place, weights, bayes, remarks, beside)


def _again(
    model_fit: Fit,
    fit: ForceFit,
    there: Sequence[tuple[_Choice, Place, _Posterior]],
    inflation: float,
    largest_N: float,
) -> list[tuple[_Choice, Place, _Posterior]]:
    """Every choice of two variables begun once more from where the best ended, and kept where that leads further down.

    Each is begun from its own linear answer. Where that is far off, one stops short of what it could explain, and is
    set aside though it could hold the very force of the best.
    """
    best, end, settled = min(there, key=lambda ended: ended[2].cost - ended[2].gain)
    lowest = settled.cost - settled.gain
    force_N = np.concatenate(
        [best.domain.basis(best.domain.of_motion(motion)) @ end.amplitude for motion in end.motions]
    )
    kept = []
    for choice, place, posterior in there:
        kept.append((choice, place, posterior))
        lacks = posterior.cost - posterior.gain - lowest
        if choice.domain == best.domain or len(choice.domain.variables) < 2 or lacks < SETTLED * lowest:
            continue
        basis = np.concatenate([choice.domain.basis(choice.domain.of_motion(motion)) for motion in end.motions])
        amplitude = np.asarray(np.linalg.lstsq(basis, force_N, rcond=ROUNDED)[0])
        begin = replace(end, law=Surface(choice.domain, np.eye(choice.domain.size)), amplitude=amplitude)
        other = _followed(model_fit, fit, begin, choice, inflation, largest_N)
        if other is not None and other[1].cost - other[1].gain < posterior.cost - posterior.gain:
            kept[-1] = (choice, *other)
    return kept


def _followed(
    model_fit: Fit, fit: ForceFit, place: Place, choice: _Choice, inflation: float, largest_N: float
) -> tuple[Place, _Posterior] | None:
    """Where a force over these variables leads, and what positions say of it there."""
    settled: tuple[Place, _Posterior] | None = None
    free = Surface(choice.domain, np.eye(choice.domain.size))
    for _ in range(ROUNDS):
        # The fit weighs positions by the noise alone: so the process is as much narrower as the noise is wider.
        surface = replace(choice.surface, sd_N=choice.surface.sd_N / math.sqrt(inflation))
        amplitude = np.asarray(np.linalg.lstsq(surface.mix, place.amplitude, rcond=None)[0])
        after = followed(model_fit, fit, replace(place, law=surface, amplitude=amplitude))
        if after is None:
            break
        place = replace(after, law=free, amplitude=surface.mix @ after.amplitude)
        posterior = _posterior(place, normal_equations(model_fit, fit, place))
        # Another amplitude may lead away: what has been reached is kept.
        if settled is not None and posterior.cost - posterior.gain > settled[1].cost - settled[1].gain:
            break
        settled = place, posterior
        inflation = max((settled[1].cost - settled[1].gain) / fit.points, 1.0)
        choice = _weighed(choice.domain, settled[1], inflation, largest_N)
    return settled


def _posterior(place: Place, normal: Normal) -> _Posterior:
    """All numbers but the coefficients of the force integrated out; in units in which each has unit information."""
    p, q = place.theta.size, place.amplitude.size
    size = np.diag(normal.square)
    unit = np.where(size > 0, 1 / np.sqrt(np.where(size > 0, size, 1.0)), 0.0)
    square, slope = normal.square * unit[:, None] * unit, normal.slope * unit
    force = np.arange(p, p + q)
    beside = np.concatenate([np.arange(p), np.arange(p + q, slope.size)])
    beside = beside[size[beside] > 0]
    values, directions = np.linalg.eigh(square[np.ix_(beside, beside)])
    told = values > SILENT
    root = directions[:, told] / np.sqrt(values[told])
    cross, along = root.T @ square[np.ix_(beside, force)], root.T @ slope[beside]
    strength, ways = np.linalg.eigh(square[np.ix_(force, force)] - cross.T @ cross)
    # What other numbers do as well is known no better than numbers are rounded.
    ways, strength = ways[:, strength > SILENT], strength[strength > SILENT]
    back = np.where(unit[force] > 0, 1 / np.where(unit[force] > 0, unit[force], 1.0), 0.0)[:, None] * ways
    heard = ways.T @ (slope[force] - cross.T @ along)
    inner = np.where(unit[force] > 0, 1 / np.where(unit[force] > 0, unit[force], 1.0), 0.0) * place.amplitude @ ways
    cost = normal.cost - float(along @ along)
    return _Posterior(
        information=(back * strength) @ back.T,
        score=back @ (heard + strength * inner),
        cost=cost + 2 * float(heard @ inner) + float(strength @ inner**2),
        gain=float(np.sum((heard + strength * inner) ** 2 / strength)),
        log_determinant=float(np.sum(np.log(values[told]))) - 2 * float(np.sum(np.log(unit[beside]))),
    )


def _weighed(domain: Domain, posterior: _Posterior, inflation: float, largest_N: float) -> _Choice:
    """The marginal likelihood of a domain, averaged over lengths and amplitudes, and the most likely of them."""
    logs, best = [], None
    for lengths in itertools.product(LENGTHS, repeat=len(domain.variables)):
        mix = domain.mix(lengths)
        values, directions = np.linalg.eigh(mix.T @ posterior.information @ mix / inflation)
        heard = directions.T @ (mix.T @ posterior.score) / inflation
        values = np.maximum(values, 0.0)
        for sd_N in largest_N * AMPLITUDES:
            shrunk = sd_N**2 / (1 + sd_N**2 * values)
            log = 0.5 * float(np.sum(shrunk * heard**2) - np.sum(np.log1p(sd_N**2 * values)))
            logs.append(log)
            if best is None or log > best[0]:
                best = log, lengths, sd_N
    assert best is not None
    most, lengths, sd_N = best
    evidence = most + math.log(float(np.mean(np.exp(np.array(logs) - most))))
    mix = domain.mix(lengths)
    inner = np.linalg.inv(mix.T @ posterior.information @ mix / inflation + np.eye(mix.shape[1]) / sd_N**2)
    covariance = mix @ inner @ mix.T
    mean = covariance @ posterior.score / inflation
    return _Choice(
        domain,
        evidence - 0.5 * posterior.cost / inflation - 0.5 * posterior.log_determinant,
        Surface(domain, mix, sd_N),
        lengths,
        mean,
        covariance,
        posterior.cost - 2 * float(posterior.score @ mean) + float(mean @ posterior.information @ mean),
    )


def _weights(choices: Sequence[_Choice], error: float) -> dict[str, float]:
    """Posterior weights, one variable and two with the same odds beforehand; ln Z is known to an `error`."""
    counts = {size: sum(len(choice.domain.variables) == size for choice in choices) for size in (1, 2)}
    most = max(choice.log_evidence for choice in choices)
    raw = {
        choice.domain.name: math.exp((choice.log_evidence - most) / error) / counts[len(choice.domain.variables)]
        for choice in choices
    }
    return {name: value / sum(raw.values()) for name, value in sorted(raw.items(), key=lambda part: -part[1])}


def _told(
    fit: ForceFit,
    best: _Choice,
    place: Place,
    weights: Mapping[str, float],
    bayes: float,
    remarks: Sequence[str],
    beside: Sequence[str],
) -> LearnedForce:
    """The force of the best choice with its table and the words for it."""
    domain = best.domain
    misfit = max(fit.chi2 - fit.points, 1e-300)
    table = _table(best, place.motions)
    lengths = dict(zip(domain.variables, best.lengths, strict=True))
    explained = min(max((fit.chi2 - best.left) / misfit, 0.0), 1.0)
    return LearnedForce(
        variables=domain.variables,
        weights=weights,
        beside=tuple(beside),
        lengths=lengths,
        amplitude_N=best.surface.sd_N,
        log_bayes_factor=bayes,
        explained=explained,
        table=table,
        sentence=" ".join([_sentence(best.domain.name, weights, beside, explained, table), *remarks]),
        place=place,
    )


def _table(best: _Choice, motions: Sequence[FittedMotion]) -> pd.DataFrame:
    """The force on a grid, with the trials that came near each point, and along the first trial of each condition."""
    import pandas as pd

    domain = best.domain
    grid = [
        np.linspace(low, high, DRAWN[len(domain.variables) - 1])
        for low, high in zip(domain.low, domain.high, strict=True)
    ]
    places = [axis.ravel() for axis in np.meshgrid(*grid, indexing="ij")]
    trials = np.zeros(places[0].size)
    for motion in motions:
        near = np.ones((places[0].size, motion.time_s.size), dtype=bool)
        near &= motion.time_s <= motion.counts_until_s
        for at, along in zip(domain.parts(places), domain.parts(domain.of_motion(motion)), strict=True):
            near &= np.abs(at[:, None] - along) < NEAR
        trials += near.any(axis=1)
    parts = [_rows(best, places, trials, "")]
    seen: set[str] = set()
    for motion in motions:
        if motion.trial.condition not in seen:
            seen.add(motion.trial.condition)
            last = int(np.count_nonzero(motion.time_s <= motion.counts_until_s)) - 1
            every = np.linspace(0, last, DRAWN[0]).astype(int)
            courses = [course[every] for course in domain.of_motion(motion)]
            parts.append(_rows(best, courses, np.ones(every.size), motion.trial.condition))
    return pd.concat(parts, ignore_index=True)


def _rows(best: _Choice, places: Sequence[Floats], trials: Floats, condition: str) -> pd.DataFrame:
    import pandas as pd

    force, sigma = best.force(places)
    known = {VARIABLES[name]: at for name, at in zip(best.domain.variables, places, strict=True)}
    columns = {name: known.get(name, np.full(force.size, math.nan)) for name in VARIABLES.values()}
    return pd.DataFrame(
        columns | {"force_N": force, "sigma_N": sigma, "trials": trials.astype(int), "condition": condition}
    )


def _sentence(
    name: str, weights: Mapping[str, float], beside: Sequence[str], explained: float, table: pd.DataFrame
) -> str:
    """What describes it and how sure that is, and how large it is."""
    seen = table[(table["condition"] == "") & (table["trials"] > 0)]
    low, high, sigma = (
        float(value) for value in (seen["force_N"].min(), seen["force_N"].max(), seen["sigma_N"].median())
    )
    drawn = f" Over {named(name)} it" if beside else " It"
    return (
        f"{dependence(name, weights, beside)}.{drawn} lies between {low:.2f} and {high:.2f} N where trials have been,"
        f" with a standard error of {sigma:.2f} N beside the B, n and P_y fitted with it, and takes away"
        f" {explained:.0%} of the misfit. B, n and P_y may hold a part of it, and a law over other variables may leave"
        " the same tracks."
    ).replace("-", "−")
