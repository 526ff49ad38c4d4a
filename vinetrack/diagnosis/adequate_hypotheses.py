"""Which hypotheses leave an adequate model: the misfit tests are repeated with each member of the answer set added."""

from __future__ import annotations

from collections.abc import Sequence

from vinetrack.diagnosis.candidate_fits import CandidateFits
from vinetrack.diagnosis.effect_sets import EffectSets
from vinetrack.diagnosis.likelihood_ratio import (
    ANSWER_SET_DELTA_CHI2,
    MAX_INFLATION,
    LikelihoodRatio,
    answer_set,
    best_of,
)
from vinetrack.diagnosis.misfit_tests import MisfitTests

MISFIT_REMAINS = "a significant misfit remains once it is added"


def adequate_hypotheses(
    hypotheses: Sequence[LikelihoodRatio], search: CandidateFits, sets: EffectSets | None = None
) -> tuple[list[LikelihoodRatio], dict[str, str], MisfitTests | None]:
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
