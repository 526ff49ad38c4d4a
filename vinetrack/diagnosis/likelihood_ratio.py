"""What refits say: by how much each hypothesis is better, what it needs for that, and whether that can be believed."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import gammaincc, ndtri_exp

from vinetrack.diagnosis.candidates import is_plausible
from vinetrack.diagnosis.film_allowance import film_gain
from vinetrack.diagnosis.result import BETWEEN_TRIALS
from vinetrack.diagnosis.weighing import log_evidence, posterior_weights, prior_penalty
from vinetrack.effects import Effect
from vinetrack.inference.film_influence import FILM
from vinetrack.inference.fit_result import Fit, Number
from vinetrack.inference.robust_covariance import FEWEST_CLUSTERS, robust_covariance

ANSWER_SET_DELTA_CHI2 = 9.0
"""Hypotheses whose −2 ln L lies within this of the best cannot be excluded: three standard deviations."""

MAX_INFLATION = 6.0
"""How many times the variance of the noise model trials may be seen to scatter: beyond, few trials say too little.
Chosen: at half fewer differences count as scatter, at twice weak effects are missed."""

CREDIBLE_RANGE_FACTOR = 3.0
"""How many times beyond its plausible range a size is still an explanation: a drag that needs C_D 17 is no drag.
Chosen: plausible ranges are wide already; at half a true effect just outside is refused, at twice C_D 17 passes."""

MIN_SIZE_SIGMAS = 1.0
"""A size below this many of its own errors is none. Chosen: an effect that a likelihood ratio finds at 4 σ has a size
of about 4 errors, unless its size and shape cannot be told apart; at half, C = 0.0000057 ± 0.0000095 N would pass, at
twice, effects whose size and shape are correlated would be lost."""

SAME_CURVE_DISTANCE = 4.0
"""Squared distance, in units of the noise, below which what two hypotheses predict is the same curve. Derived: two
standard deviations of one number."""


@dataclass(frozen=True)
class LikelihoodRatio:
    """One hypothesis refitted: the effects it adds to a fit, its own fit, and what came of it.

    `delta_chi2` is the fall of −2 ln L from the fit without them, `sigma` that in standard deviations, brought down
    where trials scatter more than the model of the noise says. A size beyond what is `plausible` is said to be so; one
    not even `credible`, several times beyond, loses a tie and is no explanation. `inflation` is how many times more the
    sizes scatter than the model of the noise says, in variance, at least 1: by so much differences of −2 ln L do, too.
    """

    effects: tuple[Effect, ...]
    fit: Fit
    delta_chi2: float
    sigma: float
    plausible: bool
    reason: str
    credible: bool = True
    inflation: float = 1.0
    prior_penalty: float = 0.0  #: by how much its sizes lie beyond what is plausible, on the scale of −2 ln L
    log_evidence: float = math.nan  #: ln of its marginal likelihood, see `vinetrack.diagnosis.weighing`
    film_gain: float = 0.0  #: fall of −2 ln L with film a little off, see `vinetrack.diagnosis.film_allowance`

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the effects it adds."""
        return tuple(effect.name for effect in self.effects)

    @property
    def label(self) -> str:
        """Names joined, by which it is kept."""
        return "+".join(self.names)

    @property
    def log_bayes(self) -> float:
        """Logarithm of its marginal likelihood over that of the fit without it, as far as trials bear it out.

        Shared numbers are at their best in both; what it brings pays for itself, see `vinetrack.diagnosis.weighing`.
        """
        return 0.5 * self.delta_chi2 / self.inflation + self.log_evidence - self.fit.log_likelihood

    @property
    def numbers(self) -> tuple[Number, ...]:
        """Its sizes; numbers that move no trajectory are left out."""
        return tuple(
            number
            for number in self.fit.numbers
            if number.key.split(".")[0] in self.names and math.isfinite(number.sigma)
        )

    @property
    def others(self) -> tuple[Number, ...]:
        """All other numbers of its fit."""
        return tuple(number for number in self.fit.numbers if number.key.split(".")[0] not in self.names)

    def deviance_excess(self, other: LikelihoodRatio) -> float:
        """By how much it is worse than another, in −2 ln L.

        Parameters
        ----------
        other : LikelihoodRatio

        Returns
        -------
        float
        """
        return 2 * (other.fit.log_likelihood - self.fit.log_likelihood)


def best_of(hypotheses: Iterable[LikelihoodRatio]) -> LikelihoodRatio:
    """The hypothesis with the highest likelihood.

    Parameters
    ----------
    hypotheses : iterable of LikelihoodRatio
        At least one.

    Returns
    -------
    LikelihoodRatio
    """
    return max(hypotheses, key=lambda hypothesis: hypothesis.fit.log_likelihood)


def likelihood_ratio(
    before: Fit, effects: Sequence[Effect], after: Fit, *, widened_by: Collection[str] | None = None
) -> LikelihoodRatio:
    """Hold a refit against the fit without the effects.

    Parameters
    ----------
    before
        The fit without the effects.
    effects : sequence of Effect
        Those that were added.
    after
        The fit with them.
    widened_by : collection of str, optional
        Names as of `robust_ratio` whose scatter from trial to trial takes away from significance; by default those of
        the effects.

    Returns
    -------
    LikelihoodRatio
    """
    fall = 2 * (after.log_likelihood - before.log_likelihood)
    ratio = robust_ratio(after, [effect.name for effect in effects] if widened_by is None else widened_by)
    plausible, reason = plausibility(effects, after)
    parameters = {f"{effect.name}.{parameter.name}": parameter for effect in effects for parameter in effect.parameters}
    nothing = _compatible_with_nothing(effects, after)
    return LikelihoodRatio(
        effects=tuple(effects),
        fit=after,
        delta_chi2=fall,
        sigma=_in_sigmas(fall, effects, after) / ratio,
        plausible=plausible,
        reason=nothing or reason,
        credible=not nothing and plausibility(effects, after, CREDIBLE_RANGE_FACTOR)[0],
        inflation=min(ratio**2, MAX_INFLATION),
        prior_penalty=prior_penalty(after, parameters),
        log_evidence=log_evidence(after, parameters),
        film_gain=film_gain(after),
    )


def _compatible_with_nothing(effects: Sequence[Effect], after: Fit) -> str:
    """That a size is nothing, or smaller than its own error, in words; blank where none is.

    Such a fit is better by the shape that its other numbers give it, not by an effect of which anything is known.
    """
    for effect in effects:
        # Differences between groups are contrasts: each group's own may be uncertain where their differences are not.
        for parameter in () if effect.kind == BETWEEN_TRIALS else effect.parameters[:1]:
            key = f"{effect.name}.{parameter.name}"
            known = [number for number in after.numbers if number.key == key and math.isfinite(number.sigma)]
            # Where each vine has a size of its own, one that is not nothing is enough.
            away = [abs(number.value - parameter.zero) / number.sigma for number in known if number.sigma > 0]
            if away and max(away) < MIN_SIZE_SIGMAS:
                number = known[0]
                return f"its size, {number.symbol} = {number.value:.2g} ± {number.sigma:.2g}, is compatible with none"
    return ""


def _in_sigmas(fall: float, effects: Sequence[Effect], after: Fit) -> float:
    """A fall of −2 ln L in standard deviations of a normal deviate that is as rare, by Wilks' theorem.

    One number for each effect, whatever shapes it has; but where each vine or day has a size of its own, as many.
    """
    grouped = {f"{effect.name}.{p.name}" for effect in effects for p in effect.parameters if p.shared != "all"}
    count = sum(number.key in grouped for number in after.numbers)
    if count < 2 or fall <= 0:
        return math.copysign(math.sqrt(abs(fall)), fall)
    # Where the chance underflows, the first terms of its asymptotic series: Abramowitz & Stegun 6.5.32.
    a, x = 0.5 * count, 0.5 * fall
    chance = float(gammaincc(a, x))
    if chance > 0:
        log_chance = math.log(chance)
    else:
        log_chance = (a - 1) * math.log(x) - x - math.lgamma(a) + math.log1p((a - 1) / x)
    return max(float(-ndtri_exp(log_chance - math.log(2))), 0.0)


def plausibility(effects: Sequence[Effect], after: Fit, widened: float = 1.0) -> tuple[bool, str]:
    """Whether the fitted sizes are plausible, and why not.

    Parameters
    ----------
    effects : sequence of Effect
    after
        The fit with them.
    widened : float
        Factor by which plausible ranges are stretched.

    Returns
    -------
    plausible : bool
    reason : str
        Blank where they are.
    """
    for effect in effects:
        for parameter in effect.parameters:
            for number in after.numbers:
                if number.key != f"{effect.name}.{parameter.name}" or not math.isfinite(number.sigma):
                    continue
                low, high = parameter.plausible or (math.nan, math.nan)
                # At its bound, beyond what is plausible, it wants more than any rig has, whatever its error says.
                pressed = math.isfinite(number.bound) and (number.bound < low or number.bound > high)
                if pressed or not is_plausible(parameter, number.value, number.sigma, widened=widened):
                    unit = "" if parameter.unit == "1" else f" {parameter.unit}"
                    needs = f"it would need {number.symbol} = {number.value:.3g}{unit}"
                    return False, f"{needs}, and {low:.3g} to {high:.3g} is plausible"
    return True, ""


def robust_ratio(after: Fit, names: Collection[str]) -> float:
    """How much larger the error of a size is by the scatter of trials than by the noise model; at least 1.

    Parameters
    ----------
    after
        The fit with the sizes.
    names : collection of str
        Of effects, or of single parameters (`effect.parameter`).

    Returns
    -------
    float
        The largest of all of them.
    """
    if not names or len(after.trials) < FEWEST_CLUSTERS:
        return 1.0
    matrices = robust_covariance(after.predictor, after.solution)
    plain, robust = (np.sqrt(np.maximum(np.diag(matrix), 0.0)) for matrix in matrices)
    mine = [
        k
        for k, number in enumerate(after.numbers)
        if (number.key.split(".")[0] in names or number.key in names) and plain[k] > 0
    ]
    return max([1.0, *(float(robust[k] / plain[k]) for k in mine)])


def _distance(fit: Fit, other: Fit) -> float:
    """Squared distance of what two fits predict, in units of the noise of the first, its correlation counted."""
    rho = fit.noise_correlation
    total = 0.0
    data = fit.predictor.data
    for a, b, variance, trial_data in zip(fit.trials, other.trials, fit.solution.state.variance, data, strict=True):
        gap = a.predicted_position_m - b.predicted_position_m
        if trial_data.relative_sd is not None:
            gap = gap / trial_data.relative_sd
        total += float(np.sum((gap[1:] - rho * gap[:-1]) ** 2) + (1 - rho**2) * gap[0] ** 2) / float(variance)
    return total


def _complexity(hypothesis: LikelihoodRatio) -> int:
    """Parameters that its effects bring."""
    return sum(len(effect.parameters) for effect in hypothesis.effects)


def answer_set(hypotheses: Sequence[LikelihoodRatio]) -> tuple[list[LikelihoodRatio], dict[str, str]]:
    """Hypotheses that cannot be excluded, best first, and for those set aside the reason in words, by their names.

    Excluded is what is worse by 9 than the best, in −2 ln L both with film as stated and with film that weighs a little
    other (`film_gain`), as far as the scatter of trials bears it out, plus what its sizes lie beyond the plausible
    (`prior_penalty`). Set aside are those that hold a simpler one as a limit and are no
    better by 9 than it, and those that need a size beyond what is plausible where another does not.

    Parameters
    ----------
    hypotheses : sequence of LikelihoodRatio
        At least one.

    Returns
    -------
    kept : list of LikelihoodRatio
    aside : dict
        Reason by label.
    """
    highest = best_of(hypotheses)

    film_alone = [-2 * ratio.fit.log_likelihood for ratio in hypotheses if ratio.names == (FILM,)]
    off = {ratio.label: -2 * ratio.fit.log_likelihood - ratio.film_gain for ratio in hypotheses}
    lowest_off = min(off.values())

    def behind(hypothesis: LikelihoodRatio) -> float:
        as_stated = hypothesis.deviance_excess(highest)
        # Beside film that is off, an effect has to gain something itself.
        gained = film_alone[0] - off[hypothesis.label] if film_alone else math.inf
        needed = gained > ANSWER_SET_DELTA_CHI2 * highest.inflation
        return min(as_stated, off[hypothesis.label] - lowest_off if needed else math.inf) / highest.inflation

    likely = [hypothesis for hypothesis in hypotheses if behind(hypothesis) <= ANSWER_SET_DELTA_CHI2]
    likely.sort(key=lambda ratio: -ratio.fit.log_likelihood)

    def misfit(hypothesis: LikelihoodRatio) -> float:
        return behind(hypothesis) + hypothesis.prior_penalty

    lowest = min(misfit(ratio) for ratio in likely)
    near = [ratio for ratio in likely if misfit(ratio) - lowest <= ANSWER_SET_DELTA_CHI2]
    aside = {
        ratio.label: ratio.reason or "its size lies beyond what is plausible" for ratio in likely if ratio not in near
    }
    kept = []
    for ratio in near:
        simpler = [
            other
            for other in near
            if 2 * (ratio.fit.log_likelihood - other.fit.log_likelihood) <= ANSWER_SET_DELTA_CHI2
            and _complexity(other) < _complexity(ratio)
            and (
                _contains(ratio, other)
                or (_comparable(ratio, other) and _distance(other.fit, ratio.fit) < SAME_CURVE_DISTANCE)
            )
        ]
        if simpler:
            aside[ratio.label] = f"it holds {simpler[0].names[-1]} as a limit, and is no better"
        else:
            kept.append(ratio)
    credible = [hypothesis for hypothesis in kept if hypothesis.credible]
    if credible and len(credible) < len(kept):
        aside |= {hypothesis.label: hypothesis.reason for hypothesis in kept if not hypothesis.credible}
        kept = credible
    return kept, aside


def _comparable(hypothesis: LikelihoodRatio, other: LikelihoodRatio) -> bool:
    """Whether curves that agree mean that one is a limit of the other.

    With the deviation of B and pressure that every trial has, all hypotheses about levels of trials predict one curve.
    """
    return all(ratio.effects[-1].kind != BETWEEN_TRIALS for ratio in (hypothesis, other))


def weights_of(hypotheses: Sequence[LikelihoodRatio]) -> dict[str, float]:
    """Posterior weights of hypotheses by label; they add up to 1 over these.

    The likelihood counts as far as the scatter of trials bears it out: ln L over the best one's inflation. The film of
    the vines is free within `systematics.FILM_ERROR` of what is stated.

    Parameters
    ----------
    hypotheses : sequence of LikelihoodRatio

    Returns
    -------
    dict of float
    """
    if not hypotheses:
        return {}
    inflation = best_of(hypotheses).inflation
    tempered = [
        hypothesis.log_evidence
        - hypothesis.fit.log_likelihood
        + (hypothesis.fit.log_likelihood + 0.5 * hypothesis.film_gain) / inflation
        for hypothesis in hypotheses
    ]
    return dict(zip((hypothesis.label for hypothesis in hypotheses), posterior_weights(tempered), strict=True))


def _contains(hypothesis: LikelihoodRatio, other: LikelihoodRatio) -> bool:
    """Whether an effect of one says that it contains that of the other."""
    replaced = {name for effect in hypothesis.effects for name in effect.replaces}
    return bool(replaced & set(other.names))
