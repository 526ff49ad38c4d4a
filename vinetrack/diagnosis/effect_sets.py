"""Several effects together: forward and backward steps over sets of effects.

Forward, the best sets of k effects are questioned, and those effects are added that promise to mend what is left.
Backward, each member of the best set of k + 1 is taken out again: what was added early may only have stood for two that
were added later, and a smaller set that is better than all before it is followed instead (floating search; Pudil,
Novovičová & Kittler, Pattern Recognition Letters 15, 1119, 1994).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from vinetrack.diagnosis.candidate_fits import CandidateFits, Report
from vinetrack.diagnosis.held_fits import let_go, with_curves
from vinetrack.diagnosis.likelihood_ratio import LikelihoodRatio, likelihood_ratio
from vinetrack.diagnosis.misfit_tests import SEARCH_SIGMAS
from vinetrack.diagnosis.multi_start import MIN_SHARE_OF_BEST_GAIN
from vinetrack.diagnosis.nested_forms import NestedForm, simpler_forms
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.effects import Effect
from vinetrack.inference.fit import refit
from vinetrack.inference.fit_data import FitError
from vinetrack.inference.fit_result import Fit

MAX_EFFECTS = 5
"""Effects of a set at most. Chosen: with six and more the sets outnumber what 48 trials can tell apart."""

PAIR_BASES, PAIR_PARTNERS = 3, 4
"""Number of best single effects from which pairs are built, and of partners tried with each. A single effect needs
MIN_SHARE_OF_BEST_GAIN of the best one's gain. Chosen for time."""

LARGER_SET_BASES, LARGER_SET_PARTNERS = 2, 3
"""Larger sets are built on the two best and the best credible one of those a size smaller. Chosen for time."""

MIN_LOG_LIKELIHOOD_GAIN = 1.0
"""Difference in ln L that counts as better. Chosen: unsettled iterations differ by a tenth."""

Names = frozenset[str]


class EffectSets:
    """Sets of effects tried from one fit, by their names; each is fitted once, unless it is met from a better start."""

    def __init__(self, search: CandidateFits, singles: Sequence[LikelihoodRatio], report: Report) -> None:
        self.search, self.report = search, report
        self.before = search.tests.fit
        self.effects = search.tests.effects
        self.fitted: dict[Names, LikelihoodRatio] = {}
        for single in singles:
            self._keep(single)
        self.extended: set[Names] = set()
        self.nested_tried: set[NestedForm] = set()

    def of_size(self, size: int) -> list[LikelihoodRatio]:
        """Known sets of so many effects, most likely first.

        Parameters
        ----------
        size : number of effects.

        Returns
        -------
        list of LikelihoodRatio
        """
        known = [hypothesis for names, hypothesis in self.fitted.items() if len(names) == size]
        return sorted(known, key=lambda hypothesis: -hypothesis.fit.log_likelihood)

    def grow(self, size: int) -> list[LikelihoodRatio]:
        """Forward: fit sets of so many effects, built on the best of one less.

        Parameters
        ----------
        size : number of effects.

        Returns
        -------
        list of LikelihoodRatio
            All known sets of that size, most likely first.
        """
        partners = PAIR_PARTNERS if size == 2 else LARGER_SET_PARTNERS
        for first in self._firsts(size - 1):
            names = frozenset(first.names)
            if names in self.extended:
                continue
            self.extended.add(names)
            search = CandidateFits(self.search.tests_after(first.fit), self.report, max_full_fits=partners)
            search.fit_singles()
            for name, likely, held, simpler in search.nested_tried:
                self.nested_tried.add(("+".join(sorted((*first.names, name))), likely, held, simpler))
            ranked = sorted(search.fitted.values(), key=lambda further: -further.fit.log_likelihood)
            kept = [other for k, other in enumerate(ranked) if k < partners or other.label in search.nested_labels]
            for further in kept:
                self._keep(likelihood_ratio(self.before, (*first.effects, *further.effects), further.fit))
        for hypothesis in self.of_size(size)[:partners]:
            for effects, fit in simpler_forms(self.before, hypothesis, self.effects, self.nested_tried):
                self._keep(likelihood_ratio(self.before, effects, fit))
        return self.of_size(size)

    def _firsts(self, size: int) -> list[LikelihoodRatio]:
        known = self.of_size(size)
        top = max((hypothesis.delta_chi2 for hypothesis in known), default=0.0)
        known = [hypothesis for hypothesis in known if hypothesis.delta_chi2 >= MIN_SHARE_OF_BEST_GAIN * top]
        if size == 1:
            return known[:PAIR_BASES]
        credible = [hypothesis for hypothesis in known if hypothesis.credible]
        return [*known[:LARGER_SET_BASES], *(best for best in credible[:1] if best not in known[:LARGER_SET_BASES])]

    def prune(self, hypothesis: LikelihoodRatio) -> bool:
        """Backward: take each member out of a set.

        Parameters
        ----------
        hypothesis : a set of at least two effects.

        Returns
        -------
        bool
            Whether one of the smaller sets is better than all of its size before it.
        """
        size = len(hypothesis.effects) - 1
        best = max((known.fit.log_likelihood for known in self.of_size(size)), default=-math.inf)
        for effect in hypothesis.effects:
            self.leave_out(hypothesis, effect)
        return self.of_size(size)[0].fit.log_likelihood > best + MIN_LOG_LIKELIHOOD_GAIN

    def leave_out(self, hypothesis: LikelihoodRatio, effect: Effect) -> LikelihoodRatio | None:
        """A set with one member taken out, the others fitted again; None where that cannot be followed.

        Parameters
        ----------
        hypothesis : a set of at least two effects.
        effect : one of them.

        Returns
        -------
        LikelihoodRatio or None
        """
        others = tuple(other for other in hypothesis.effects if other is not effect)
        known = self.fitted.get(frozenset(other.name for other in others))
        if known is None or known.fit.log_likelihood > hypothesis.fit.log_likelihood:
            self.report(f"taking out {effect.name}")
            fit = self._refitted(hypothesis.fit, others)
            if fit is not None:
                self._keep(likelihood_ratio(self.before, others, fit))
        return self.fitted.get(frozenset(other.name for other in others))

    def subset(self, hypothesis: LikelihoodRatio, effects: Sequence[Effect]) -> LikelihoodRatio | None:
        """Some members of a set alone, fitted from the set where they are not known; None where that fails.

        Parameters
        ----------
        hypothesis : a set.
        effects : some of its effects.

        Returns
        -------
        LikelihoodRatio or None
        """
        names = frozenset(effect.name for effect in effects)
        if names not in self.fitted:
            fit = self._refitted(hypothesis.fit, effects)
            if fit is not None:
                self._keep(likelihood_ratio(self.before, effects, fit))
        known = self.fitted.get(names)
        return None if known is None else replace(known, fit=with_curves(known.fit))

    def _refitted(self, fit: Fit, effects: Iterable[Effect]) -> Fit | None:
        try:
            return refit(fit, self.before.model.with_effects(effects), thorough=False)
        except (FitError, SimulationError, np.linalg.LinAlgError):
            return None

    def member_sigmas(self, hypothesis: LikelihoodRatio, effect: Effect) -> float:
        """What a member of a set is worth beside the others, in standard deviations; 0 where it is not known.

        Parameters
        ----------
        hypothesis : a set.
        effect : one of its members.

        Returns
        -------
        float
        """
        others = self.leave_out(hypothesis, effect)
        if others is None:
            return 0.0
        fall = 2 * (hypothesis.fit.log_likelihood - others.fit.log_likelihood)
        return math.sqrt(max(fall, 0.0) / hypothesis.inflation)

    def superfluous(self, hypothesis: LikelihoodRatio) -> str:
        """The first member of a set that it can do without, or that is worth too little; blank where there is none.

        Parameters
        ----------
        hypothesis : a set of at least three effects.

        Returns
        -------
        str
            What to say of it.
        """
        for effect in hypothesis.effects:
            others = tuple(other for other in hypothesis.effects if other is not effect)
            sigmas = self.member_sigmas(hypothesis, effect)
            asked = SEARCH_SIGMAS
            smaller = self.fitted.get(frozenset(other.name for other in others))
            if smaller is not None:
                asked = max(asked, self.search.tests_after(smaller.fit).family.threshold(effect.name))
            if sigmas < asked:
                return f"{effect.name} is worth {sigmas:.1f} σ beside the others, and {asked:.1f} σ are asked of it"
        return ""

    def is_better(self, hypothesis: LikelihoodRatio, smaller: LikelihoodRatio | None = None) -> bool:
        """Whether a set is better than a smaller one by more than chance gives a further effect.

        Parameters
        ----------
        hypothesis : a set of at least two effects.
        smaller : another set; the likeliest that is smaller by one where it is not given.

        Returns
        -------
        bool
        """
        smaller = smaller or self.of_size(len(hypothesis.effects) - 1)[0]
        further = self.search.tests_after(smaller.fit).family
        limit = max(further.threshold(name) for name in hypothesis.names if name not in smaller.names)
        return 2 * (hypothesis.fit.log_likelihood - smaller.fit.log_likelihood) >= limit**2

    def plausible_steps(self) -> tuple[LikelihoodRatio, ...]:
        """The steps to the largest set of plausible sizes in which each effect more is no chance, one effect a step.

        Returns
        -------
        tuple of LikelihoodRatio
            Empty where no single effect is plausible.
        """
        best: LikelihoodRatio | None = None
        for size in range(1, MAX_EFFECTS + 1):
            plausible = [known for known in self.of_size(size) if known.plausible and known.credible]
            if not plausible or (best is not None and not self.is_better(plausible[0], best)):
                break
            best = plausible[0]
        if best is None:
            return ()
        steps = [self.subset(best, best.effects[: k + 1]) for k in range(len(best.effects))]
        return tuple(step for step in steps if step is not None)

    def _keep(self, hypothesis: LikelihoodRatio) -> None:
        names = frozenset(hypothesis.names)
        known = self.fitted.get(names)
        if known is None or hypothesis.fit.log_likelihood > known.fit.log_likelihood:
            self.fitted[names] = hypothesis
            same = {others: known for others, known in self.fitted.items() if len(others) == len(names)}
            let_go(same)
            self.fitted |= same
