"""Which hypotheses leave nothing: the answer set asked again, each with what it adds in the model."""

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


def mending(
    hypotheses: Sequence[LikelihoodRatio], search: CandidateFits, sets: EffectSets | None = None
) -> tuple[list[LikelihoodRatio], dict[str, str], MisfitTests | None]:
    """The hypotheses that cannot be excluded and leave nothing, why others were set aside, and what the best leaves.

    One that leaves something is excluded, and with it whatever it was better by: where all of the answer set leave
    something, those next to it are asked, as far as misjudged noise could have put them behind. What one leaves may be
    film that weighs a little other than stated.

    Parameters
    ----------
    hypotheses : sequence of LikelihoodRatio
        At least one.
    search : CandidateFits
        Asks what each leaves, once.
    sets : EffectSets, optional
        Where the hypotheses are sets of effects.

    Returns
    -------
    whole : list of LikelihoodRatio
        The likeliest first; none where all leave something.
    aside : dict
        Reason by label.
    after : MisfitTests or None
        What the first that was found whole leaves.
    """
    kept, aside = answer_set(hypotheses)
    best = best_of(hypotheses)
    behind = sorted(
        (hypothesis for hypothesis in hypotheses if hypothesis not in kept),
        key=lambda hypothesis: -hypothesis.fit.log_likelihood,
    )
    next_to_it = [
        hypothesis
        for hypothesis in behind
        if hypothesis.label not in aside and hypothesis.deviance_excess(best) < ANSWER_SET_DELTA_CHI2 * MAX_INFLATION
    ]
    for group in (kept, next_to_it):
        whole: list[LikelihoodRatio] = []
        after: MisfitTests | None = None
        for hypothesis, film in [(each, film) for film in (False, True) for each in group]:
            # Film beside the best is looked for as a set, unless another as likely leaves nothing as it stands.
            alone = hypothesis is best and not whole
            if film and (hypothesis in whole or alone or hypothesis.film_gain < ANSWER_SET_DELTA_CHI2):
                continue
            asked = search.tests_after(hypothesis.fit, film=film) if has_credible_sizes(hypothesis) else None
            # Two effects together can imitate much that no catalogue holds: nothing at all may be left of them.
            if (
                asked is None
                or asked.rejects_model
                or (len(hypothesis.effects) > 1 and asked.rejects_at_first_round_level)
            ):
                aside[hypothesis.label] = hypothesis.reason if asked is None else "something is left once it is added"
            elif sets is not None and len(hypothesis.effects) > 2 and (why := sets.superfluous(hypothesis)):
                aside[hypothesis.label] = why
            elif not whole or hypothesis in answer_set([*whole, hypothesis])[0]:
                whole.append(hypothesis)
                after = after or asked
                aside.pop(hypothesis.label, None)
        if whole:
            return sorted(whole, key=lambda ratio: -ratio.fit.log_likelihood), aside, after
        if (
            best.film_gain > ANSWER_SET_DELTA_CHI2
            and best.credible
            and not _has_a_shape(search.tests_after(best.fit, film=True))
        ):
            break
    return [], aside, None


def _has_a_shape(asked: MisfitTests) -> bool:
    """Whether any candidate or smooth force would mend what is left, whatever the trials take upon themselves."""
    return bool(asked.exceeds_slow_errors or asked.probes_reject or asked.largest_excess(asked.family) > 0)


def has_credible_sizes(hypothesis: LikelihoodRatio) -> bool:
    """Whether its sizes can be an explanation; of three effects and more all must be plausible.

    Parameters
    ----------
    hypothesis : LikelihoodRatio

    Returns
    -------
    bool
    """
    return hypothesis.plausible and hypothesis.credible if len(hypothesis.effects) > 2 else hypothesis.credible
