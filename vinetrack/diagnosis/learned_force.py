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
A force that B, n and P_y could take over as well is not decided by these data: it is counted from where growth begins
(`force_surface`). The band holds everything beside that: noise, scatter, lengths and amplitude, and a constant. Growth,
speed and time are hardly three variables where speeds are steady: weights then lean to whichever surface is smoother.
Choices that the tracks themselves do not exclude are named beside the best (`learned_variables`).
`vinetrack.diagnosis.propose` seeks a law for the force, or writes it as a table.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.diagnosis.force_evidence import (
    Beginning,
    Posterior,
    VariableChoice,
    posterior,
    posterior_weights,
    weighed,
)
from vinetrack.diagnosis.force_inversion import ForceFit
from vinetrack.diagnosis.force_refinement import SETTLED, Place, followed, normal_equations
from vinetrack.diagnosis.force_sensitivities import FittedMotion, motions_of
from vinetrack.diagnosis.force_surface import ANY, CONSTANT, VARIABLES, Domain, Surface, domains
from vinetrack.diagnosis.learned_variables import dependence, named, not_excluded, reference
from vinetrack.diagnosis.likelihood_ratio import ANSWER_SET_DELTA_CHI2
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

TRIED = {1: 1, 2: 3}
"""Choices of one variable and of two that are followed, the best where all is taken as linear. Chosen for time."""

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
class LearnedForce:
    """The missing force over the variables that it most likely depends on.

    `best` is the force itself, with its error; `motions` are those of the trials where its fit ended. `weights` are
    posterior, by `growth`, `growth+speed`, …; `beside` names the choices that are not excluded either. `table`, columns
    `LEARNED_COLUMNS`, holds the force on a grid (condition blank; `trials` counts those that came near) and along the
    first trial of each condition; variables that do not count are NaN. `undecided_N` is the standard error of a part of
    it that is the same all along the growth, N: beside B, n and P_y, which are the vine's where growth begins.
    """

    best: Beginning
    motions: Sequence[FittedMotion]
    weights: Mapping[str, float]
    beside: tuple[str, ...]
    log_bayes_factor: float
    explained: float
    table: pd.DataFrame
    sentence: str
    undecided_N: float = 0.0

    @property
    def domain(self) -> Domain:
        """The variables that it depends on, with their ranges."""
        return self.best.surface.domain

    def to_json(self) -> dict[str, Any]:
        """As `diagnosis.json` holds it."""
        return {
            "variables": list(self.domain.variables),
            "weights": dict(self.weights),
            "not_excluded": list(self.beside),
            "length_scales": dict(zip(self.domain.variables, self.best.lengths, strict=True)),
            "amplitude_N": self.best.surface.sd_N,
            "log_bayes_factor": self.log_bayes_factor,
            "explained": self.explained,
            "begins": self.best.begins,
            "undecided_N": self.undecided_N,
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
    effects[:, : fit.problem.release_origin_mean.shape[1]] = fit.problem.release_origin_mean
    motions = on_tracks(fit, effects, motions_of(model_fit, effects))
    begins = [
        Place(fit.state.theta, effects, surface, np.zeros(surface.domain.size), list(motions), driven=False)
        for surface in (Surface(domain, np.eye(domain.size)) for domain in domains(motions))
    ]
    about = [posterior(place, normal_equations(model_fit, fit, place)) for place in begins]
    if not all(told.finite for told in about):
        return None
    inflation = max(min(told.lowest for told in about) / fit.points, 1.0)
    silent = -0.5 * about[0].cost / inflation - 0.5 * about[0].log_determinant
    linear = [
        (weighed(place.law.domain, told, inflation, largest_N), place)
        for place, told in zip(begins, about, strict=True)
        if isinstance(place.law, Surface)
    ]
    linear.sort(key=lambda pair: -pair[0].log_evidence)
    gain = linear[0][0].log_evidence - silent
    if gain < HEARD:
        return None
    # Where the model is far off linear answers err, most for what has few numbers: the best alone is followed too.
    near = [
        pair
        for size, most in TRIED.items()
        for pair in [pair for pair in linear if len(pair[0].domain.variables) == size][:most]
    ]
    places = [(choice, _followed(model_fit, fit, place, choice, inflation, largest_N)) for choice, place in near]
    there = [(choice, *settled) for choice, settled in places if settled is not None]
    if not there:
        return None
    there = _again(model_fit, fit, there, inflation, largest_N)
    inflation = max(min(settled.lowest for _, _, settled in there) / fit.points, 1.0)
    choices = [weighed(choice.domain, settled, inflation, largest_N) for choice, _, settled in there]
    left = min(choice.best().left for choice in choices)
    if fit.chi2 - left < MENDS * (fit.chi2 - fit.points):
        return None
    # A fit that has settled within a part of χ² tells no smaller difference; nor do points that err together.
    together = max(fit.points / (PIECES * len(fit.data)), 1.0)
    shared = (1 + (inflation - 1) * together) / inflation
    error = max(0.5 * SETTLED * left / inflation, shared)
    weights = posterior_weights(choices, error)
    choice, place = max(
        zip(choices, (place for _, place, _ in there), strict=True), key=lambda pair: weights[pair[0].domain.name]
    )
    # Forces that begin in different ways are weighed at one place: how far the fit has settled they share.
    best = choice.best(shared)
    bayes = next(choice.log_evidence for choice, _ in linear if choice.domain == best.surface.domain) - silent
    remarks = []
    if not replicates:
        remarks.append("No condition was repeated: how sure this is rests on the scatter that the fit assumes.")
    if not any("pressure" in choice.domain.variables for choice, _ in linear):
        remarks.append("All trials had one pressure: whether the force depends on it they do not tell.")
    # What the splines of a choice leave at best, whatever the prior says of how smooth they are.
    lowest = {choice.domain.name: told.lowest for choice, _, told in there}
    losses = {name: (value - lowest[best.surface.domain.name]) / inflation for name, value in lowest.items()}
    everything = [choice.domain for choice, _ in linear]
    beside = not_excluded(best.surface.domain, weights, losses, ANSWER_SET_DELTA_CHI2 * error, everything, motions)
    if beside:
        remarks.append("Trials that pass the same growth otherwise, at further pressures or payloads, tell.")
    return _told(fit, best, place.motions, weights, bayes, remarks, beside, choice.undecided_N)


def _again(
    model_fit: Fit,
    fit: ForceFit,
    there: Sequence[tuple[VariableChoice, Place, Posterior]],
    inflation: float,
    largest_N: float,
) -> list[tuple[VariableChoice, Place, Posterior]]:
    """Every choice of two variables begun once more from where the best ended, and kept where that leads further down.

    Each is begun from its own linear answer. Where that is far off, one stops short of what it could explain, and is
    set aside though it could hold the very force of the best.
    """
    best, end, settled = min(there, key=lambda ended: ended[2].cost - ended[2].gain)
    lowest = settled.lowest
    force_N = np.concatenate(
        [best.domain.basis(best.domain.of_motion(motion)) @ end.amplitude for motion in end.motions]
    )
    kept = []
    for choice, place, told in there:
        kept.append((choice, place, told))
        lacks = told.lowest - lowest
        if choice.domain == best.domain or len(choice.domain.variables) < 2 or lacks < SETTLED * lowest:
            continue
        basis = np.concatenate([choice.domain.basis(choice.domain.of_motion(motion)) for motion in end.motions])
        amplitude = np.asarray(np.linalg.lstsq(basis, force_N, rcond=ROUNDED)[0])
        begin = replace(end, law=Surface(choice.domain, np.eye(choice.domain.size)), amplitude=amplitude)
        other = _followed(model_fit, fit, begin, choice, inflation, largest_N)
        if other is not None and other[1].lowest < told.lowest:
            kept[-1] = (choice, *other)
    return kept


def _followed(
    model_fit: Fit, fit: ForceFit, place: Place, choice: VariableChoice, inflation: float, largest_N: float
) -> tuple[Place, Posterior] | None:
    """Where a force over these variables leads, and what positions say of it there."""
    settled: tuple[Place, Posterior] | None = None
    free = Surface(choice.domain, np.eye(choice.domain.size))
    for turn in range(ROUNDS + 1):
        likely = choice.best()
        surface = choice.smooth_from(CONSTANT) if turn < ROUNDS else likely.surface
        if turn == ROUNDS and likely.begins != ANY:
            break
        # The fit weighs positions by the noise alone: so the process is as much narrower as the noise is wider.
        surface = replace(surface, sd_N=surface.sd_N / math.sqrt(inflation))
        amplitude = np.asarray(np.linalg.lstsq(surface.mix, place.amplitude, rcond=None)[0])
        after = followed(model_fit, fit, replace(place, law=surface, amplitude=amplitude))
        if after is None:
            break
        place = replace(after, law=free, amplitude=surface.mix @ after.amplitude)
        told = posterior(place, normal_equations(model_fit, fit, place))
        # Another amplitude may lead away: what has been reached is kept.
        if not told.finite or (settled is not None and told.lowest > settled[1].lowest):
            break
        settled = place, told
        inflation = max(told.lowest / fit.points, 1.0)
        choice = weighed(choice.domain, told, inflation, largest_N)
    return settled


def _told(
    fit: ForceFit,
    best: Beginning,
    motions: Sequence[FittedMotion],
    weights: Mapping[str, float],
    bayes: float,
    remarks: Sequence[str],
    beside: Sequence[str],
    undecided_N: float,
) -> LearnedForce:
    """The force of the best choice with its table and the words for it."""
    misfit = max(fit.chi2 - fit.points, 1e-300)
    table = _table(best, motions)
    explained = min(max((fit.chi2 - best.left) / misfit, 0.0), 1.0)
    return LearnedForce(
        best=best,
        motions=motions,
        weights=weights,
        beside=tuple(beside),
        log_bayes_factor=bayes,
        explained=explained,
        table=table,
        sentence=" ".join([_sentence(best, weights, beside, explained, table, undecided_N), *remarks]),
        undecided_N=undecided_N,
    )


def _table(best: Beginning, motions: Sequence[FittedMotion]) -> pd.DataFrame:
    """The force on a grid, with the trials that came near each point, and along the first trial of each condition."""
    import pandas as pd

    domain = best.surface.domain
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


def _rows(best: Beginning, places: Sequence[Floats], trials: Floats, condition: str) -> pd.DataFrame:
    import pandas as pd

    force, sigma = best.force(places)
    known = {VARIABLES[name]: at for name, at in zip(best.surface.domain.variables, places, strict=True)}
    columns = {name: known.get(name, np.full(force.size, math.nan)) for name in VARIABLES.values()}
    return pd.DataFrame(
        columns | {"force_N": force, "sigma_N": sigma, "trials": trials.astype(int), "condition": condition}
    )


def _sentence(
    best: Beginning,
    weights: Mapping[str, float],
    beside: Sequence[str],
    explained: float,
    table: pd.DataFrame,
    undecided_N: float,
) -> str:
    """What describes it and how sure that is, how large it is, and from what it is counted."""
    seen = table[(table["condition"] == "") & (table["trials"] > 0)]
    low, high, sigma = (
        float(value) for value in (seen["force_N"].min(), seen["force_N"].max(), seen["sigma_N"].median())
    )
    name = best.surface.domain.name
    drawn = f" Over {named(name)} it" if beside else " It"
    return (
        f"{dependence(name, weights, beside)}.{drawn} lies between {low:.2f} and {high:.2f} N where trials have been,"
        f" with a standard error of {sigma:.2f} N, and takes away {explained:.0%} of the misfit."
        f" {reference(best.surface.domain, best.begins, undecided_N)} A law over other variables may leave the same"
        " tracks."
    ).replace("-", "−")
