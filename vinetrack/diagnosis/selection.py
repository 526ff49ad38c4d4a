"""From a fit to verdicts: is something missing, which effect, is anything left once it is there.

A verdict is never more certain than the data. One effect alone must mend everything; if something is left, two effects
together must; if something is left then, the truth is not in the catalogue.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from vinetrack.diagnosis.between_trials import between_fits, called, differences
from vinetrack.diagnosis.candidate_fits import CandidateFits, Report, pairs
from vinetrack.diagnosis.confounded_sizes import Confounder, confounders_of
from vinetrack.diagnosis.contradictions import displacement_m, is_within_position_errors
from vinetrack.diagnosis.likelihood_ratio import (
    ANSWER_SET,
    MOST_INFLATION,
    LikelihoodRatio,
    answer_set,
    likelihood_ratio,
)
from vinetrack.diagnosis.misfit_tests import (
    FAR_OFF,
    FIRST_LEVEL,
    LATER_LEVEL,
    SUSPECT_SIGMAS,
    MisfitTests,
    misfit_tests,
)
from vinetrack.diagnosis.multi_start import from_other_starts, without
from vinetrack.diagnosis.result import ADEQUATE, AMBIGUOUS, ARTEFACT, BETWEEN_TRIALS, MISSING, UNEXPLAINED
from vinetrack.diagnosis.slack_hypothesis import slack_fit
from vinetrack.diagnosis.trial_effect_tests import scatters_much
from vinetrack.effects import Effect
from vinetrack.inference.fit_result import Fit

MOST_AGAIN = 2
"""Times that all is asked again of a better minimum. Chosen as a safeguard."""

LOUD = 1.0
"""Standard deviations above the threshold from which a score is no chance, even if no refit bears it out."""

NO_BETTER = 1.0
"""Difference in ln L that counts as a better minimum. Chosen: unsettled iterations differ by a tenth."""


NOT_PHYSICAL = ("measurement", BETWEEN_TRIALS)
"""Kinds of hypotheses that are no physics."""


@dataclass(frozen=True)
class SelectionStep:
    """One round before it is put in words.

    `kept` are the hypotheses in the answer set (of pairs: the partners, given what was added before), `tried` all that
    were fitted, `aside` what was set aside and why, by name; `confounded` are sizes that may hold another effect.
    """

    verdict: str
    questions: MisfitTests
    kept: tuple[LikelihoodRatio, ...] = ()
    tried: tuple[LikelihoodRatio, ...] = ()
    aside: tuple[tuple[str, str], ...] = ()
    answer: tuple[str, ...] = ()
    search: CandidateFits | None = None
    note: str = ""
    confounded: tuple[Confounder, ...] = ()


def select_effects(fit: Fit, effects: Sequence[Effect], report: Report, *, again: int = 0) -> list[SelectionStep]:
    """The findings of all rounds, the first about the fit itself.

    A fit may have ended in a local minimum, from which any effect seems to help. So one that is far off is begun again
    elsewhere before it is questioned, and again from where the best hypothesis ended: if it then does better without
    the effect, all is asked again of that, twice at most.

    Parameters
    ----------
    fit
        The fit that is questioned.
    effects : sequence of Effect
        Candidates.
    report : callable
        Called with a sentence at each step.
    again : int
        How often it has been begun again.

    Returns
    -------
    list of SelectionStep
    """
    if fit.chi2_per_dof > FAR_OFF and not again:
        report("fitting the model from other starts")
        fit = from_other_starts(fit)
    report("questioning the model")
    questions = misfit_tests(fit, effects, FIRST_LEVEL)
    among = differences(fit)
    differ = bool(called(among, FIRST_LEVEL))
    if not questions.something and not questions.suspect and not differ:
        return [SelectionStep(ADEQUATE, questions)]
    slack = _slack(questions, effects, report) if questions.something else None
    if slack is not None and not _leaves_room(slack[0].kept):
        return slack
    search = CandidateFits(questions, report)
    search.singles()
    tried = search.fit_in_full()
    between = between_fits(fit, among, max((hypothesis.delta_chi2 for hypothesis in tried), default=0.0), report)
    tried += between
    if slack is not None and not _is_better(tried, slack[0].kept[0]):
        return slack
    if not questions.something and not differ and (not tried or _best_of(tried).sigma < SUSPECT_SIGMAS):
        return [SelectionStep(ADEQUATE, questions, tried=tuple(tried), search=search)]
    if tried and again < MOST_AGAIN and _best_of(tried) not in between:
        rival = without(fit, _best_of(tried).fit)
        if rival.log_likelihood > fit.log_likelihood + NO_BETTER:
            return select_effects(rival, effects, report, again=again + 1)
    alone = None if _leaves_room(tried) else _alone(questions, search, tried)
    if alone is not None:
        return alone
    # Linear promises choose well near the truth, not far from it. Where the best of those they chose leaves room for a
    # better one, and before `unexplained`, all are fitted.
    search.singles(all_of_them=True)
    tried = [*search.fit_in_full(all_of_them=True), *between]
    alone = _alone(questions, search, tried)
    if alone is not None:
        return alone
    if not questions.something and not questions.suspect:
        return [SelectionStep(ADEQUATE, questions, tried=tuple(tried), search=search)]
    tried = [hypothesis for hypothesis in tried if hypothesis not in between]
    credible = [hypothesis for hypothesis in tried if hypothesis.credible]
    if not credible or not _stands_out(_best_of(credible), questions):
        # A score that no refit bears out says nothing, unless it is high or the shape of what is left says it too.
        loud = questions.excess(questions.family) > LOUD
        fails = questions.fails or questions.off or loud
        verdict = UNEXPLAINED if fails else ADEQUATE
        return [SelectionStep(verdict, questions, tried=tuple(tried), search=search)]
    report("two effects together")
    return _together(questions, search, tried, effects, report)


def _leaves_room(tried: Sequence[LikelihoodRatio]) -> bool:
    """Whether the best hypothesis may stand for a better one: it is far off, or bends the trials until they fit.

    One that leaves the noise of the tracks, and trials that scatter no more than care allows, has taken all there is.
    """
    if not tried:
        return True
    best = _best_of(tried).fit
    return best.chi2_per_dof > FAR_OFF or scatters_much(best)


def _is_better(tried: Sequence[LikelihoodRatio], than: LikelihoodRatio) -> bool:
    """Whether the best of these hypotheses is likelier than another."""
    return bool(tried) and _best_of(tried).fit.log_likelihood > than.fit.log_likelihood + NO_BETTER


def _slack(questions: MisfitTests, effects: Sequence[Effect], report: Report) -> list[SelectionStep] | None:
    """Findings where a tail that may go slack explains what a tail that pushes does not; None where it does not.

    It is asked first: a tail cannot push, and the rule brings no number that could make up for something else. But
    where its trials scatter much they may have been bent to it: then it stands only if no effect alone does better.
    """
    slack = slack_fit(questions.fit)
    if slack is None or not _stands_out(slack, questions):
        return None
    report("letting the tail go slack")
    # A model far off may gain by any freedom: the rule is named only where it leaves nothing to explain.
    after = misfit_tests(slack.fit, effects, LATER_LEVEL)
    if after.something or after.fails or after.off:
        return None
    first = SelectionStep(MISSING, questions, (slack,), (slack,), (), slack.names)
    return [first, SelectionStep(ADEQUATE, after)]


def _stands_out(hypothesis: LikelihoodRatio, questions: MisfitTests) -> bool:
    """Whether an effect is worth more standard deviations than chance alone gives one of the candidates."""
    return hypothesis.sigma >= questions.family.of(hypothesis.names[-1])


def _is_needed(pair: LikelihoodRatio, single: LikelihoodRatio, search: CandidateFits) -> bool:
    """Whether a pair is better than the best single effect by more than chance gives a further candidate."""
    further = search.after(single.fit).family
    limit = max(further.of(name) for name in pair.names if name not in single.names)
    return 2 * (pair.fit.log_likelihood - single.fit.log_likelihood) >= limit**2


def _best_of(tried: Sequence[LikelihoodRatio]) -> LikelihoodRatio:
    """The hypothesis with the highest likelihood."""
    return max(tried, key=lambda hypothesis: hypothesis.fit.log_likelihood)


def _alone(
    questions: MisfitTests, search: CandidateFits, tried: Sequence[LikelihoodRatio]
) -> list[SelectionStep] | None:
    """Findings where one effect mends everything; None where none does."""
    if not tried:
        return None
    best = _best_of(tried)
    if not _stands_out(best, questions):
        return None
    kept, aside, after = _mending(tried, search)
    if after is None:
        return None
    verdict = verdict_of(kept)
    if verdict == MISSING and is_within_position_errors(questions.fit, kept[0].fit):
        return [
            SelectionStep(ADEQUATE, questions, tried=tuple(tried), search=search, note=_too_small(kept[0], questions))
        ]
    first = SelectionStep(
        verdict,
        questions,
        tuple(kept),
        tuple(tried),
        tuple(aside.items()),
        tuple(hypothesis.names[0] for hypothesis in kept),
        search,
        confounded=confounders_of(after, kept[0].names) if verdict == MISSING else (),
    )
    return [first, SelectionStep(ADEQUATE, after)] if verdict == MISSING else [first]


def _too_small(best: LikelihoodRatio, questions: MisfitTests) -> str:
    moved_mm = 1e3 * displacement_m(questions.fit, best.fit)
    return (
        f"{best.label} would improve the fit by {best.sigma:.1f} σ, but it moves positions by only {moved_mm:.2g} mm, "
        "less than their systematic errors, and does not lower the error on left-out conditions; it is not counted"
    )


def _mending(
    hypotheses: Sequence[LikelihoodRatio], search: CandidateFits
) -> tuple[list[LikelihoodRatio], dict[str, str], MisfitTests | None]:
    """The hypotheses that cannot be excluded and leave nothing, why others were set aside, and what the best leaves.

    One that leaves something is excluded, and with it whatever it was better by: where all of the answer set leave
    something, those next to it are asked, as far as misjudged noise could have put them behind.
    """
    kept, aside = answer_set(hypotheses)
    best = max(hypothesis.fit.log_likelihood for hypothesis in hypotheses)
    behind = sorted(
        (hypothesis for hypothesis in hypotheses if hypothesis not in kept),
        key=lambda hypothesis: -hypothesis.fit.log_likelihood,
    )
    next_to_it = [
        hypothesis
        for hypothesis in behind
        if hypothesis.label not in aside and 2 * (best - hypothesis.fit.log_likelihood) < ANSWER_SET * MOST_INFLATION
    ]
    for group in (kept, next_to_it):
        mending: list[LikelihoodRatio] = []
        after: MisfitTests | None = None
        for hypothesis in group:
            asked = search.after(hypothesis.fit) if hypothesis.credible else None
            # Two effects together can imitate much that no catalogue holds: nothing at all may be left of them.
            if asked is None or asked.something or (len(hypothesis.effects) > 1 and asked.whispers):
                aside[hypothesis.label] = hypothesis.reason if asked is None else "something is left once it is added"
            elif not mending or hypothesis in answer_set([*mending, hypothesis])[0]:
                mending.append(hypothesis)
                after = after or asked
        if mending:
            return mending, aside, after
    return [], aside, None


def verdict_of(kept: Sequence[LikelihoodRatio]) -> str:
    """What an answer set amounts to; of each hypothesis the last effect counts.

    Where nothing in it is physics that is missing, the measurement or the trials are at fault.

    Parameters
    ----------
    kept : sequence of LikelihoodRatio
        The answer set.

    Returns
    -------
    str
    """
    if all(hypothesis.effects[-1].kind in NOT_PHYSICAL for hypothesis in kept):
        return ARTEFACT
    return MISSING if len(kept) == 1 else AMBIGUOUS


def _together(
    questions: MisfitTests,
    search: CandidateFits,
    tried: Sequence[LikelihoodRatio],
    effects: Sequence[Effect],
    report: Report,
) -> list[SelectionStep]:
    """Findings where two effects together mend what none does alone; else nothing known does."""
    ranked = sorted(tried, key=lambda single: -single.fit.log_likelihood)
    both = pairs(questions.fit, ranked, effects, report)
    nothing = [
        SelectionStep(UNEXPLAINED, questions, tried=(*ranked, *both), search=search, aside=_why_not(ranked, both))
    ]
    if not both:
        return nothing
    kept, aside, after = _mending(both, search)
    if after is None or not _is_needed(kept[0], ranked[0], search):
        return nothing
    common = set.intersection(*(set(hypothesis.names) for hypothesis in kept))
    by_name = {hypothesis.names[0]: hypothesis for hypothesis in ranked if len(hypothesis.names) == 1}
    if not common:
        names = tuple(dict.fromkeys(name for hypothesis in kept for name in hypothesis.names))
        answer = _ordered(names, by_name)
        first = SelectionStep(AMBIGUOUS, questions, tuple(kept), (*ranked, *both), tuple(aside.items()), answer, search)
        return [first]
    return _in_order(questions, search, kept, common, by_name, (*ranked, *both), aside, after)


def _ordered(names: Sequence[str], by_name: dict[str, LikelihoodRatio]) -> tuple[str, ...]:
    """Names by how much each mends alone."""
    return tuple(sorted(names, key=lambda name: -by_name[name].delta_chi2 if name in by_name else 0.0))


def _in_order(
    questions: MisfitTests,
    search: CandidateFits,
    kept: Sequence[LikelihoodRatio],
    common: set[str],
    by_name: dict[str, LikelihoodRatio],
    tried: Sequence[LikelihoodRatio],
    aside: dict[str, str],
    after: MisfitTests,
) -> list[SelectionStep]:
    """Two rounds from pairs that share an effect: that one first, physics before faults of the measurement."""
    kinds = {effect.name: effect.kind for hypothesis in kept for effect in hypothesis.effects}
    order = sorted(common, key=lambda name: (kinds[name] == "measurement", -_alone_gain(name, by_name)))
    first_name = order[0]
    turned = [_turned(hypothesis, first_name) for hypothesis in kept]
    verdict = ARTEFACT if kinds[first_name] == "measurement" else MISSING
    first = SelectionStep(
        verdict, questions, tuple(turned[:1]), tuple(tried), tuple(aside.items()), (first_name,), search,
        note="two effects are missing: none alone mends everything",
    )  # fmt: skip
    if verdict != MISSING:
        return [first]
    base = by_name.get(first_name)
    later = misfit_tests(base.fit if base else turned[0].fit, questions.effects, LATER_LEVEL)
    seconds = tuple(likelihood_ratio(later.fit, pair.effects[1:], pair.fit) for pair in turned)
    second_verdict = verdict_of(seconds)
    names = tuple(second.names[0] for second in seconds)
    confounded = confounders_of(after, kept[0].names) if second_verdict == MISSING else ()
    second = SelectionStep(second_verdict, later, seconds, seconds, answer=names, confounded=confounded)
    return [first, second, SelectionStep(ADEQUATE, after)] if second_verdict == MISSING else [first, second]


def _alone_gain(name: str, by_name: dict[str, LikelihoodRatio]) -> float:
    return by_name[name].delta_chi2 if name in by_name else 0.0


def _turned(hypothesis: LikelihoodRatio, first: str) -> LikelihoodRatio:
    """The same pair with the effect of that name in front."""
    from dataclasses import replace

    ordered = sorted(hypothesis.effects, key=lambda effect: effect.name != first)
    return replace(hypothesis, effects=tuple(ordered))


def _why_not(ranked: Sequence[LikelihoodRatio], both: Sequence[LikelihoodRatio]) -> tuple[tuple[str, str], ...]:
    return tuple(
        (hypothesis.label, hypothesis.reason if not hypothesis.credible else "something is left once it is added")
        for hypothesis in (*ranked[:1], *both[:1])
    )
