"""Sets of several effects, by forward and backward steps.

Forward, effects are added to the best sets of k effects: those that the score tests predict to improve the fit most.
Backward, each member of the best set of k + 1 is removed: an effect added early may only have stood in for two added
later, and a smaller set that is better than all known of its size is followed instead (floating search; Pudil,
Novovičová & Kittler, Pattern Recognition Letters 15, 1119, 1994).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from vinetrack.core.records import Floats
from vinetrack.diagnosis.candidate_fits import MIN_SHARE_OF_BEST_GAIN, CandidateFits, Report, drop_curves, with_curves
from vinetrack.diagnosis.candidates import plausible_range
from vinetrack.diagnosis.likelihood_ratio import (
    ANSWER_SET_DELTA_CHI2,
    MAX_INFLATION,
    LikelihoodRatio,
    NestedForm,
    answer_set,
    best_of,
    in_sigmas,
    likelihood_ratio,
    robust_ratio,
    simpler_forms,
    sizes_of,
)
from vinetrack.diagnosis.misfit_tests import SEARCH_SIGMAS, MisfitTests
from vinetrack.diagnosis.remarks import Remark, remark
from vinetrack.diagnosis.result import Confounder
from vinetrack.diagnosis.score_test import levers_of
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.effects import Effect, Parameter
from vinetrack.inference.fit import refit
from vinetrack.inference.fit_data import FitError
from vinetrack.inference.fit_result import Fit, Number

MAX_EFFECTS = 5  # Largest number of effects in a set (chosen)

# Number of best single effects from which pairs are built, and of partners tried with each (chosen)
PAIR_BASES, PAIR_PARTNERS = 3, 4

# The same for larger sets, built on the best sets of one effect fewer and, besides them, on the best whose sizes are
# credible (chosen)
LARGER_SET_BASES, LARGER_SET_PARTNERS = 2, 3

MIN_LOG_LIKELIHOOD_GAIN = 1.0  # Difference in ln L from which a fit counts as better (chosen)

Names = frozenset[str]


class EffectSets:
    """Sets of effects fitted from one model, by their names. A set is fitted again only from a better start."""

    def __init__(self, search: CandidateFits, singles: Sequence[LikelihoodRatio], report: Report) -> None:
        self.search, self.report = search, report
        self.before = search.tests.fit
        self.effects = search.tests.effects
        self.fitted: dict[Names, LikelihoodRatio] = {}
        for single in singles:
            self._keep_best(single)
        self.extended: set[Names] = set()
        self.left_out: set[tuple[str, str]] = set()
        self.nested_tried: set[NestedForm] = set()

    def of_size(self, size: int) -> list[LikelihoodRatio]:
        """Fitted sets of this many effects, the highest likelihood first."""
        of_size = [hypothesis for names, hypothesis in self.fitted.items() if len(names) == size]
        return sorted(of_size, key=lambda hypothesis: -hypothesis.fit.log_likelihood)

    def grow(self, size: int) -> list[LikelihoodRatio]:
        """Forward step: fit sets of this many effects, built on the best sets of one fewer."""
        n_partners = PAIR_PARTNERS if size == 2 else LARGER_SET_PARTNERS
        for base in self._bases(size - 1):
            names = frozenset(base.names)
            if names in self.extended:
                continue
            self.extended.add(names)
            search = CandidateFits(self.search.tests_after(base.fit), self.report, max_full_fits=n_partners)
            search.fit_singles()
            for name, log_likelihood, larger, simpler in search.nested_tried:
                self.nested_tried.add(("+".join(sorted((*base.names, name))), log_likelihood, larger, simpler))
            ranked = sorted(search.fitted.values(), key=lambda partner: -partner.fit.log_likelihood)
            partners = [
                partner for k, partner in enumerate(ranked) if k < n_partners or partner.label in search.nested_labels
            ]
            for partner in partners:
                self._keep_best(likelihood_ratio(self.before, (*base.effects, *partner.effects), partner.fit))
        for hypothesis in self.of_size(size)[:n_partners]:
            for effects, fit in simpler_forms(self.before, hypothesis, self.effects, self.nested_tried):
                self._keep_best(likelihood_ratio(self.before, effects, fit))
        return self.of_size(size)

    def _bases(self, size: int) -> list[LikelihoodRatio]:
        """Sets of this many effects on which larger ones are built."""
        of_size = self.of_size(size)
        best_gain = max((hypothesis.delta_chi2 for hypothesis in of_size), default=0.0)
        strong = [hypothesis for hypothesis in of_size if hypothesis.delta_chi2 >= MIN_SHARE_OF_BEST_GAIN * best_gain]
        if size == 1:
            return strong[:PAIR_BASES]
        bases = strong[:LARGER_SET_BASES]
        credible = [hypothesis for hypothesis in strong if hypothesis.credible]
        return [*bases, *(best for best in credible[:1] if best not in bases)]

    def prune(self, hypothesis: LikelihoodRatio) -> bool:
        """Backward step: remove each member from a set in turn."""
        size = len(hypothesis.effects) - 1
        best = max((known.fit.log_likelihood for known in self.of_size(size)), default=-math.inf)
        for effect in hypothesis.effects:
            self.leave_out(hypothesis, effect)
        return self.of_size(size)[0].fit.log_likelihood > best + MIN_LOG_LIKELIHOOD_GAIN

    def leave_out(self, hypothesis: LikelihoodRatio, effect: Effect) -> LikelihoodRatio | None:
        """Fit a set without one of its members, from where the set ended; None where no fit succeeds. A fit of the
        smaller set that is known already may have ended in a local minimum, which would make the member look needed:
        the better of the two counts.
        """
        others = tuple(other for other in hypothesis.effects if other is not effect)
        if (hypothesis.label, effect.name) not in self.left_out:
            self.left_out.add((hypothesis.label, effect.name))
            self.report(f"taking out {effect.name}")
            fit = self._refitted(hypothesis.fit, others)
            if fit is not None:
                self._keep_best(likelihood_ratio(self.before, others, fit))
        return self.fitted.get(frozenset(other.name for other in others))

    def subset(self, hypothesis: LikelihoodRatio, effects: Sequence[Effect]) -> LikelihoodRatio | None:
        """Some members of a set alone, refitted from the set unless known already; None where the fit fails."""
        names = frozenset(effect.name for effect in effects)
        if names not in self.fitted:
            fit = self._refitted(hypothesis.fit, effects)
            if fit is not None:
                self._keep_best(likelihood_ratio(self.before, effects, fit))
        known = self.fitted.get(names)
        return None if known is None else replace(known, fit=with_curves(known.fit))

    def _refitted(self, fit: Fit, effects: Iterable[Effect]) -> Fit | None:
        try:
            return refit(fit, self.before.model.with_effects(effects), thorough=False)
        except (FitError, SimulationError, np.linalg.LinAlgError):
            return None

    def member_sigmas(self, hypothesis: LikelihoodRatio, effect: Effect) -> float:
        """Significance of a member of a set given the others, in standard deviations; 0 where it is not known. Δχ² is
        divided by the inflation and has a degree of freedom for each size of the member (`sizes_of`).
        """
        others = self.leave_out(hypothesis, effect)
        if others is None:
            return 0.0
        delta_chi2 = 2 * (hypothesis.fit.log_likelihood - others.fit.log_likelihood)
        return in_sigmas(max(delta_chi2, 0.0) / hypothesis.inflation, sizes_of((effect,), hypothesis.fit))

    def superfluous(self, hypothesis: LikelihoodRatio) -> Remark:
        """Find the first member of a set whose significance given the others is too low."""
        for effect in hypothesis.effects:
            others = frozenset(other.name for other in hypothesis.effects if other is not effect)
            sigmas = self.member_sigmas(hypothesis, effect)
            required = SEARCH_SIGMAS
            smaller = self.fitted.get(others)
            if smaller is not None:
                required = max(required, self.search.tests_after(smaller.fit).family.threshold(effect.name))
            if sigmas < required:
                return remark("too_weak_in_set", effect=effect.name, sigmas=sigmas, required=required)
        return Remark()

    def is_better(self, hypothesis: LikelihoodRatio, smaller: LikelihoodRatio | None = None) -> bool:
        """Whether a set is better than a smaller one by at least the threshold of its additional effect. The smaller
        set need not be nested in it. If it is the best of one effect fewer, it fits at least as well as any nested one
        that was fitted, so the criterion is then the stricter. The difference of −2 ln L is divided by the inflation of
        the sizes added: where they scatter between trials more widely than the noise model predicts, chance makes it
        larger by as much (Kent, Biometrika 69, 19, 1982).
        """
        smaller = smaller or self.of_size(len(hypothesis.effects) - 1)[0]
        family = self.search.tests_after(smaller.fit).family
        threshold = max(family.threshold(name) for name in hypothesis.names if name not in smaller.names)
        added = [effect for effect in hypothesis.effects if effect.name not in smaller.names]
        delta_chi2 = 2 * (hypothesis.fit.log_likelihood - smaller.fit.log_likelihood)
        inflation = robust_ratio(hypothesis.fit, [effect.name for effect in added]) ** 2
        return in_sigmas(delta_chi2 / inflation, sizes_of(added, hypothesis.fit)) >= threshold

    def plausible_steps(self) -> tuple[LikelihoodRatio, ...]:
        """Steps, one effect each, to the largest set of plausible sizes in which each additional effect is significant.
        Returns empty where no single effect is plausible.
        """
        best: LikelihoodRatio | None = None
        for size in range(1, MAX_EFFECTS + 1):
            plausible = [each for each in self.of_size(size) if each.plausible and each.credible]
            if not plausible or (best is not None and not self.is_better(plausible[0], best)):
                break
            best = plausible[0]
        if best is None:
            return ()
        steps = [self.subset(best, best.effects[: k + 1]) for k in range(len(best.effects))]
        return tuple(step for step in steps if step is not None)

    def _keep_best(self, hypothesis: LikelihoodRatio) -> None:
        """Keep a set unless a fit of the same effects with a higher likelihood is known; drop curves not needed."""
        names = frozenset(hypothesis.names)
        known = self.fitted.get(names)
        if known is None or hypothesis.fit.log_likelihood > known.fit.log_likelihood:
            self.fitted[names] = hypothesis
            of_size = {others: known for others, known in self.fitted.items() if len(others) == len(names)}
            drop_curves(of_size)
            self.fitted |= of_size


# ------------------------------------------------------------------------------
# Which hypotheses leave an adequate model: the misfit tests are repeated with each member of the answer set added.

MISFIT_REMAINS = remark("misfit_remains")


def adequate_hypotheses(
    hypotheses: Sequence[LikelihoodRatio], search: CandidateFits, sets: EffectSets | None = None
) -> tuple[list[LikelihoodRatio], dict[str, Remark], MisfitTests | None]:
    """Test the model with each hypothesis of the answer set added, and keep those that no test rejects. A hypothesis
    that leaves a significant misfit is rejected, and no longer sets the likelihood that others are compared with.
    Returns adequate (the likeliest first; empty where every hypothesis is rejected), rejected (reason by label), after
    (tests of the model with the first adequate hypothesis added).
    """
    in_answer_set, rejected = answer_set(hypotheses)
    best = best_of(hypotheses)
    others = sorted(
        (hypothesis for hypothesis in hypotheses if hypothesis not in in_answer_set),
        key=lambda hypothesis: -hypothesis.fit.log_likelihood,
    )
    next_best = [
        hypothesis
        for hypothesis in others
        if hypothesis.label not in rejected and hypothesis.deviance_excess(best) < ANSWER_SET_DELTA_CHI2 * MAX_INFLATION
    ]
    for group in (in_answer_set, next_best):
        adequate: list[LikelihoodRatio] = []
        after: MisfitTests | None = None
        for hypothesis, film_free in [(each, film_free) for film_free in (False, True) for each in group]:
            # With the best, film of another mass is a set of two effects, unless an equally likely hypothesis is
            # adequate with the film as stated.
            only_best = hypothesis is best and not adequate
            if film_free and (hypothesis in adequate or only_best or hypothesis.film_gain < ANSWER_SET_DELTA_CHI2):
                continue
            tests = search.tests_after(hypothesis.fit, film=film_free) if has_credible_sizes(hypothesis) else None
            # Two effects together can imitate much that is in no catalogue, so a set must also pass at the level of the
            # first round, which rejects more readily.
            if tests is None:
                rejected[hypothesis.label] = hypothesis.reason
            elif tests.rejects_model or (len(hypothesis.effects) > 1 and tests.rejects_at_first_round_level):
                rejected[hypothesis.label] = MISFIT_REMAINS
            elif sets is not None and len(hypothesis.effects) > 2 and (reason := sets.superfluous(hypothesis)):
                rejected[hypothesis.label] = reason
            elif not adequate or hypothesis in answer_set([*adequate, hypothesis])[0]:
                adequate.append(hypothesis)
                after = after or tests
                rejected.pop(hypothesis.label, None)
        if adequate:
            return sorted(adequate, key=lambda ratio: -ratio.fit.log_likelihood), rejected, after
        # With film of another mass the best leaves nothing to a candidate or a force: a set of both is tried instead of
        # hypotheses that are further behind.
        film_may_suffice = best.film_gain > ANSWER_SET_DELTA_CHI2 and best.credible
        if film_may_suffice and not _candidate_or_probe_rejects(search.tests_after(best.fit, film=True)):
            break
    return [], rejected, None


def _candidate_or_probe_rejects(tests: MisfitTests) -> bool:
    """Whether a candidate or a smooth force would still improve the fit, whatever the trial effects absorb."""
    return bool(tests.exceeds_slow_errors or tests.probes_reject or tests.largest_excess(tests.family) > 0)


def has_credible_sizes(hypothesis: LikelihoodRatio) -> bool:
    """Whether the fitted sizes can be an explanation; with three effects or more all must be plausible."""
    return hypothesis.plausible and hypothesis.credible if len(hypothesis.effects) > 2 else hypothesis.credible


# ------------------------------------------------------------------------------
# How much of a fitted size may belong to another, undetected effect: "this K includes up to … of drag".
#
# Once an effect is in the model, the other candidates are too weak to be detected, but not zero: air is never absent.
# If another effect were present with size s, the size θ of the added one would fall by L s, with L = I_θθ⁻¹ I_θs the
# coefficient of omitted-variable bias of the linear fit (`score_test.levers_of`). The estimate of s from the
# trajectories, N(ŝ, σ_s²), is combined with a normal prior centred on zero, scaled so that 95 % of it lies within the
# farther end of the plausible range, and truncated where physics allows one sign only (Bayesian bias analysis).
# Effects are considered one at a time and to first order. The interval stated is the hull of the fit's own and of the
# one with the other effect left free: at least 95 %.


TWO_SIDED_95 = 1.959964  # Derived: quantile of the normal distribution


def confounders_of(after: MisfitTests, added: Sequence[str]) -> tuple[Confounder, ...]:
    """Find, for each size of the added effects, the physical effects that it may include. Returns for each size, those
    that could shift it by more than its standard error, the largest first.
    """
    if after.poorly_fitted or not after.sensitivities.shapes:
        return ()
    levers = levers_of(after.fit, after.products)
    chosen = []
    for k, number in enumerate(after.fit.numbers):
        if number.key.split(".")[0] in added and math.isfinite(number.sigma) and number.sigma > 0:
            relevant = [confounder for confounder in _of_number(after, number, levers[k]) if _is_relevant(confounder)]
            # 3: confounders listed for each size (chosen)
            chosen += sorted(relevant, key=lambda confounder: -abs(confounder.value - number.value))[:3]
    return tuple(chosen)


def _is_relevant(confounder: Confounder) -> bool:
    # 1.0: shift, in standard errors of the size, from which a confounder is reported (chosen)
    return abs(confounder.value - confounder.number.value) > 1.0 * confounder.number.sigma


def _of_number(after: MisfitTests, number: Number, lever: Floats) -> list[Confounder]:
    """Every physical effect as a confounder of one size, in the shape that shifts the size most."""
    physical = {effect.name: effect for effect in after.effects if effect.kind == "physical"}
    confounders = []
    for name in dict.fromkeys(after.sensitivities.effects):
        # An effect that contains the added one as a limit is an alternative to it, no confounder.
        if name not in physical or number.key.split(".")[0] in physical[name].replaces:
            continue
        by_shape = [_in_shape(after, number, k, float(lever[k])) for k in after.ranked_shapes(name)]
        informative = [confounder for confounder in by_shape if confounder is not None]
        if informative:
            confounders.append(max(informative, key=lambda confounder: abs(confounder.value - number.value)))
    return confounders


def _in_shape(after: MisfitTests, number: Number, index: int, lever: float) -> Confounder | None:
    """One shape of an effect as a confounder; None where the data hold no information about its size."""
    shape = after.sensitivities.shapes[index]
    sigma = float(after.scores.sigma[index])
    if not shape.effect.parameters or shape.whole or not math.isfinite(sigma):
        return None
    mean, sd, limit = size_not_excluded(float(after.scores.size[index]), sigma, shape.size)
    expected = number.value - lever * mean
    half_width = _quantile(number) * math.hypot(number.sigma, lever * sd)
    lower, upper = _bounds(after, number)
    return Confounder(
        number=number,
        effect=shape.effect.name,
        symbol=shape.size.symbol,
        unit=shape.size.unit,
        limit=shape.size.zero + limit,
        value=min(max(number.value - lever * limit, lower), upper),
        low_95=max(min(number.low, expected - half_width), lower),
        high_95=min(max(number.high, expected + half_width), upper),
    )


def _bounds(after: MisfitTests, number: Number) -> tuple[float, float]:
    """Bounds of a parameter, SI."""
    effect, _, name = number.key.partition(".")
    parameters = next(
        effect_of_model for effect_of_model in after.fit.model if effect_of_model.name == effect
    ).parameters
    return next(parameter.bounds for parameter in parameters if parameter.name == name)


def _quantile(number: Number) -> float:
    """Half width of the 95 % interval of a fitted size, in standard errors."""
    quantile = 0.5 * (number.high - number.low) / number.sigma
    return max(quantile, TWO_SIDED_95) if math.isfinite(quantile) else TWO_SIDED_95


def size_not_excluded(estimate: float, sigma: float, parameter: Parameter) -> tuple[float, float, float]:
    """Combine the estimate of a size with its plausible range (truncated normal posterior). Returns mean, sd, limit :
    float.
    """
    from scipy.stats import truncnorm

    low, high = plausible_range(parameter)
    prior_sd = max(abs(low - parameter.zero), abs(high - parameter.zero)) / TWO_SIDED_95
    precision = 1 / sigma**2 + 1 / prior_sd**2
    centre, width = estimate / sigma**2 / precision, 1 / math.sqrt(precision)
    lower, upper = (-math.inf, math.inf)
    if parameter.sign > 0:
        lower = 0.0
    elif parameter.sign < 0:
        upper = 0.0
    posterior = truncnorm((lower - centre) / width, (upper - centre) / width, loc=centre, scale=width)
    ends = [float(posterior.ppf(share)) for share in (0.05, 0.95)]
    return float(posterior.mean()), float(posterior.std()), max(ends, key=abs)
