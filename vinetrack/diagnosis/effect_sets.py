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

from vinetrack.diagnosis.candidate_fits import CandidateFits, Report
from vinetrack.diagnosis.fit_memory import drop_curves, with_curves
from vinetrack.diagnosis.likelihood_ratio import LikelihoodRatio, in_sigmas, likelihood_ratio, robust_ratio, sizes_of
from vinetrack.diagnosis.misfit_tests import SEARCH_SIGMAS
from vinetrack.diagnosis.multi_start import MIN_SHARE_OF_BEST_GAIN
from vinetrack.diagnosis.nested_forms import NestedForm, simpler_forms
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.effects import Effect
from vinetrack.inference.fit import refit
from vinetrack.inference.fit_data import FitError
from vinetrack.inference.fit_result import Fit

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

    def superfluous(self, hypothesis: LikelihoodRatio) -> str:
        """Find the first member of a set whose significance given the others is too low."""
        for effect in hypothesis.effects:
            others = frozenset(other.name for other in hypothesis.effects if other is not effect)
            sigmas = self.member_sigmas(hypothesis, effect)
            required = SEARCH_SIGMAS
            smaller = self.fitted.get(others)
            if smaller is not None:
                required = max(required, self.search.tests_after(smaller.fit).family.threshold(effect.name))
            if sigmas < required:
                return f"{effect.name} reaches {sigmas:.1f} σ given the others, and {required:.1f} σ are required"
        return ""

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
