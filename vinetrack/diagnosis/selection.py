"""From a fit to verdicts: is something missing, which effect, is anything left once it is there.

A verdict is never more certain than the data. One effect alone must mend everything; if something is left, several
together must, up to five; if something is left then, the truth is not in the catalogue.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from vinetrack.diagnosis.between_trials import between_fits, differences, significant
from vinetrack.diagnosis.candidate_fits import CandidateFits, Report
from vinetrack.diagnosis.confounded_sizes import confounders_of
from vinetrack.diagnosis.confounder import Confounder
from vinetrack.diagnosis.contradictions import displacement_m, is_within_position_errors
from vinetrack.diagnosis.effect_sets import MAX_EFFECTS, MIN_LOG_LIKELIHOOD_GAIN, EffectSets
from vinetrack.diagnosis.initial_fit import with_host
from vinetrack.diagnosis.likelihood_ratio import (
    ANSWER_SET_DELTA_CHI2,
    LikelihoodRatio,
    best_of,
    likelihood_ratio,
)
from vinetrack.diagnosis.mending import has_credible_sizes, mending
from vinetrack.diagnosis.misfit_tests import (
    FALSE_ALARM_LEVEL_FIRST_ROUND,
    FALSE_ALARM_LEVEL_LATER_ROUNDS,
    FAR_OFF_CHI2_PER_DOF,
    SEARCH_SIGMAS,
    MisfitTests,
    misfit_tests,
)
from vinetrack.diagnosis.multi_start import restart_exponents, restart_without
from vinetrack.diagnosis.result import ADEQUATE, AMBIGUOUS, ARTEFACT, BETWEEN_TRIALS, MISSING, UNEXPLAINED
from vinetrack.diagnosis.slack_hypothesis import slack_fit
from vinetrack.diagnosis.trial_effect_tests import has_excess_scatter
from vinetrack.effects import Effect
from vinetrack.inference.fit_result import Fit

MAX_RESTARTS = 2
"""Times that all is asked again of a better minimum. Chosen as a safeguard."""

CLEAR_SCORE_EXCESS = 1.0
"""Standard deviations above the threshold from which a score is no chance, even if no refit bears it out."""

STALLED_CHI2_SHARE = 0.7
"""Part of χ² that a third or further effect may leave of a fit that stays far off, or no more are added. Chosen for
time: on what no catalogue holds steps go on for ever; at half of it four equal effects would not be found, at twice no
step is refused."""

PARTIAL_SHARE = 0.5
"""Part of the excess of χ² per degree of freedom over 1 that steps must take away for `unexplained` to show them as
partial. Chosen: what explains less than half says little of where to look; at half of it a quarter is enough,
at twice nothing is."""

LEADING_TERMS, LEADING_TERM_SHARE = ("lens", "perspective"), 0.95
"""Effects that are the first term of a series in the place in the picture, and the part of what a set gains that such a
term gains alone where the rest of the set may stand for the next term. Derived: at the edge of the picture the fifth
order of a lens is up to a fifth of its third, 4 % of the squares. At half, physics that is a few times weaker than a
lens waits until that is put right; at twice (0.975) a strong lens is taken for a lens and physics."""

NONPHYSICAL_KINDS = ("measurement", BETWEEN_TRIALS)
"""Kinds of hypotheses that are no physics."""


@dataclass(frozen=True)
class SelectionStep:
    """One round before it is put in words.

    `kept` are the hypotheses in the answer set (of sets of effects: the rest of them, given what was added before),
    `tried` all that were fitted, `aside` what was set aside and why, by name; `confounded` are sizes that may hold
    another effect. `unstated` are differences between trials that an adequate model stands beside, by an order that the
    sheet does not state. `partial` are steps, each of one effect more, that mend most of what nothing mends in full.
    """

    verdict: str
    tests: MisfitTests
    answer_set: tuple[LikelihoodRatio, ...] = ()
    fitted: tuple[LikelihoodRatio, ...] = ()
    rejected: tuple[tuple[str, str], ...] = ()
    answer_names: tuple[str, ...] = ()
    search: CandidateFits | None = None
    note: str = ""
    confounded: tuple[Confounder, ...] = ()
    partial: tuple[LikelihoodRatio, ...] = ()
    unstated_differences: tuple[LikelihoodRatio, ...] = ()


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
    if fit.chi2_per_dof > FAR_OFF_CHI2_PER_DOF and not again:
        report("fitting the model from other starts")
        fit = restart_exponents(fit)
    report("questioning the model")
    questions = misfit_tests(fit, effects, FALSE_ALARM_LEVEL_FIRST_ROUND)
    among = differences(fit)
    apart = significant(among, FALSE_ALARM_LEVEL_FIRST_ROUND)
    differ = any(difference.stated for difference in apart)
    if not questions.rejects_model and not questions.needs_search and not differ:
        return [SelectionStep(ADEQUATE, questions, unstated_differences=tuple(between_fits(fit, apart, 0.0, report)))]
    slack = _slack(questions, effects, report) if questions.rejects_model else None
    if slack is not None and not _leaves_room(slack[0].answer_set) and not slack[-1].tests.needs_search:
        return slack
    search = CandidateFits(questions, report)
    search.fit_singles()
    tried = search.fit_to_all_trials()
    between = between_fits(fit, among, max((hypothesis.delta_chi2 for hypothesis in tried), default=0.0), report)
    by_rows = {difference.name for difference in apart if not difference.stated}
    unstated = tuple(hypothesis for hypothesis in between if hypothesis.names[0] in by_rows)
    tried += between
    if slack is not None and not _is_better(tried, slack[0].answer_set[0]):
        return slack
    if not questions.rejects_model and not differ and (not tried or best_of(tried).sigma < SEARCH_SIGMAS):
        return [SelectionStep(ADEQUATE, questions, fitted=tuple(tried), search=search, unstated_differences=unstated)]
    if tried and again < MAX_RESTARTS and best_of(tried) not in between:
        rival = restart_without(fit, best_of(tried).fit)
        if rival.log_likelihood > fit.log_likelihood + MIN_LOG_LIKELIHOOD_GAIN:
            return select_effects(rival, effects, report, again=again + 1)
    alone = None if _leaves_room(tried) else _alone(questions, search, tried)
    if alone is not None:
        return alone
    # Linear promises choose well near the truth, not far from it. Where the best of those they chose leaves room for a
    # better one, and before `unexplained`, all are fitted.
    search.fit_singles(all_of_them=True)
    tried = [*search.fit_to_all_trials(all_of_them=True), *between]
    alone = _alone(questions, search, tried)
    if alone is not None:
        return alone
    if not questions.rejects_model and not questions.needs_search:
        return [SelectionStep(ADEQUATE, questions, fitted=tuple(tried), search=search, unstated_differences=unstated)]
    tried = [hypothesis for hypothesis in tried if hypothesis not in between]
    credible = [hypothesis for hypothesis in tried if hypothesis.credible]
    if not credible or not _any_stands_out(credible, questions):
        # A score that no refit bears out says nothing, unless it is high or the shape of what is left says it too.
        loud = questions.largest_excess(questions.family) > CLEAR_SCORE_EXCESS
        fails = questions.omnibus_rejects or questions.exceeds_slow_errors or loud
        verdict = UNEXPLAINED if fails else ADEQUATE
        told = unstated if verdict == ADEQUATE else ()
        return [SelectionStep(verdict, questions, fitted=tuple(tried), search=search, unstated_differences=told)]
    return _together(questions, search, tried, report)


def _leaves_room(tried: Sequence[LikelihoodRatio]) -> bool:
    """Whether the best hypothesis may stand for a better one: it is far off, or bends the trials until they fit.

    One that leaves the noise of the tracks, and trials that scatter no more than care allows, has taken all there is.
    """
    if not tried:
        return True
    best = best_of(tried).fit
    return best.chi2_per_dof > FAR_OFF_CHI2_PER_DOF or has_excess_scatter(best)


def _is_better(tried: Sequence[LikelihoodRatio], than: LikelihoodRatio) -> bool:
    """Whether the best of these hypotheses is likelier than another."""
    return bool(tried) and best_of(tried).fit.log_likelihood > than.fit.log_likelihood + MIN_LOG_LIKELIHOOD_GAIN


def _slack(questions: MisfitTests, effects: Sequence[Effect], report: Report) -> list[SelectionStep] | None:
    """Findings where a tail that may go slack explains what a tail that pushes does not; None where it does not.

    It is asked first: a tail cannot push, and the rule brings no number that could make up for something else. But
    where its trials scatter much they may have been bent to it: then it stands only if no effect alone does better.
    """
    slack = slack_fit(questions.fit)
    if slack is None or not _stands_out(slack, questions):
        return None
    report("letting the tail go slack")
    slack = replace(slack, fit=with_host(slack.fit, questions.fit.predictor.host))
    # A model far off may gain by any freedom: the rule is named only where it leaves nothing to explain.
    after = misfit_tests(slack.fit, effects, FALSE_ALARM_LEVEL_LATER_ROUNDS)
    if after.rejects_model or after.omnibus_rejects or after.exceeds_slow_errors:
        return None
    first = SelectionStep(MISSING, questions, (slack,), (slack,), (), slack.names)
    return [first, SelectionStep(ADEQUATE, after)]


def _stands_out(hypothesis: LikelihoodRatio, questions: MisfitTests) -> bool:
    """Whether an effect is worth more standard deviations than chance alone gives one of the candidates."""
    return hypothesis.sigma >= questions.family.threshold(hypothesis.names[-1])


def _any_stands_out(tried: Sequence[LikelihoodRatio], questions: MisfitTests) -> bool:
    """Whether the best does, or one that cannot be excluded beside it: each may scatter in its own way."""
    best = best_of(tried)
    return any(
        _stands_out(known, questions)
        for known in tried
        if known.deviance_excess(best) <= ANSWER_SET_DELTA_CHI2 * best.inflation
    )


def _alone(
    questions: MisfitTests, search: CandidateFits, tried: Sequence[LikelihoodRatio]
) -> list[SelectionStep] | None:
    """Findings where one effect mends everything; None where none does."""
    if not tried:
        return None
    if not _any_stands_out(tried, questions):
        return None
    kept, aside, after = mending(tried, search)
    if after is None:
        return None
    verdict = verdict_of(kept)
    if verdict == MISSING and is_within_position_errors(questions.fit, kept[0].fit):
        return [
            SelectionStep(ADEQUATE, questions, fitted=tuple(tried), search=search, note=_too_small(kept[0], questions))
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


def verdict_of(kept: Sequence[LikelihoodRatio]) -> str:
    """What an answer set amounts to.

    Where nothing in it is physics that is missing, the measurement or the trials are at fault.

    Parameters
    ----------
    kept : sequence of LikelihoodRatio
        The answer set.

    Returns
    -------
    str
    """
    if all(effect.kind in NONPHYSICAL_KINDS for hypothesis in kept for effect in hypothesis.effects):
        return ARTEFACT
    return MISSING if len(kept) == 1 else AMBIGUOUS


def _together(
    questions: MisfitTests, search: CandidateFits, tried: Sequence[LikelihoodRatio], report: Report
) -> list[SelectionStep]:
    """Findings where several effects together mend what fewer do not; else nothing known does."""
    ranked = sorted(tried, key=lambda single: -single.fit.log_likelihood)
    sets = EffectSets(search, ranked, report)
    size, again, reached = 2, 0, ranked[0]
    aside: dict[str, str] = {}
    while size <= MAX_EFFECTS:
        report(f"{size} effects together")
        grown = sets.grow(size)
        if not grown or not any(hypothesis.credible for hypothesis in grown):
            break
        kept, aside, after = mending(grown, search, sets)
        if after is not None:
            if sets.is_better(kept[0]):
                return _of_sets(questions, sets, kept, aside, after)
            aside[kept[0].label] = "it gains no more over the best smaller set than chance may"
        if not sets.is_better(grown[0]):
            break
        leads_nowhere = size > 2 and _leads_nowhere(grown, reached)
        reached = grown[0]
        if leads_nowhere:
            break
        # What was added first may have stood for two that came later: the search goes on from the better smaller set.
        back = size > 2 and again < MAX_RESTARTS and sets.prune(grown[0])
        size, again = (size - 1, again + 1) if back else (size + 1, again)
    fitted = tuple(sets.fitted.values())
    why = _why_not((*ranked[:1], *sets.of_size(2)[:1], reached), aside)
    steps = _partial(questions, sets)
    return [SelectionStep(UNEXPLAINED, questions, fitted=fitted, search=search, rejected=why, partial=steps)]


def _leads_nowhere(grown: Sequence[LikelihoodRatio], smaller: LikelihoodRatio) -> bool:
    """Whether larger sets are not worth their time: no size is plausible, or the best stays as far off as before."""
    if not any(has_credible_sizes(hypothesis) for hypothesis in grown):
        return True
    left = grown[0].fit.chi2_per_dof
    return left > FAR_OFF_CHI2_PER_DOF and left > STALLED_CHI2_SHARE * smaller.fit.chi2_per_dof


def _of_sets(
    questions: MisfitTests,
    sets: EffectSets,
    kept: Sequence[LikelihoodRatio],
    aside: dict[str, str],
    after: MisfitTests,
) -> list[SelectionStep]:
    """Rounds from sets of effects that mend everything: what all of them share, one by one, then what they differ in.

    Physics comes before faults of the measurement, and of either what mends most alone. A picture bent by so much that
    the first term of its bend mends nearly everything comes before all: what that leaves may be the next term.
    """
    tried, out_of_the_race = tuple(sets.fitted.values()), tuple(aside.items())
    gains = {single.names[0]: single.delta_chi2 for single in tried if len(single.names) == 1}
    kinds = {effect.name: effect.kind for hypothesis in kept for effect in hypothesis.effects}

    bent = {name for name in LEADING_TERMS if gains.get(name, 0.0) > LEADING_TERM_SHARE * kept[0].delta_chi2}

    def order(name: str) -> tuple[bool, bool, float]:
        return name not in bent, kinds[name] == "measurement", -gains.get(name, 0.0)

    common = sorted(set.intersection(*(set(hypothesis.names) for hypothesis in kept)), key=order)
    if not common:
        names = tuple(sorted(dict.fromkeys(name for hypothesis in kept for name in hypothesis.names), key=order))
        return [SelectionStep(AMBIGUOUS, questions, tuple(kept), tried, out_of_the_race, names, sets.search)]
    shared = common if len(kept) > 1 else common[:-1]
    steps: list[SelectionStep] = []
    added: tuple[Effect, ...] = ()
    asked = questions
    for name in shared:
        if kinds[name] == "measurement":
            return [*steps, _shared_step(ARTEFACT, asked, sets, kept[0], added, name, tried, out_of_the_race)]
        steps.append(_shared_step(MISSING, asked, sets, kept[0], added, name, tried, out_of_the_race))
        added = (*added, next(effect for effect in kept[0].effects if effect.name == name))
        alone = sets.subset(kept[0], added)
        asked = sets.search.tests_after(alone.fit if alone else kept[0].fit)
    further = tuple(_beside(asked, hypothesis, added) for hypothesis in kept)
    verdict = verdict_of(further)
    names = tuple(sorted(dict.fromkeys(name for hypothesis in further for name in hypothesis.names), key=order))
    confounded = confounders_of(after, kept[0].names) if verdict == MISSING else ()
    steps.append(SelectionStep(verdict, asked, further, further, answer_names=names, confounded=confounded))
    return [*steps, SelectionStep(ADEQUATE, after)] if verdict == MISSING else steps


def _shared_step(
    verdict: str,
    asked: MisfitTests,
    sets: EffectSets,
    whole: LikelihoodRatio,
    added: tuple[Effect, ...],
    name: str,
    tried: tuple[LikelihoodRatio, ...],
    aside: tuple[tuple[str, str], ...],
) -> SelectionStep:
    """The round in which an effect is named that all sets share, once those `added` before it are in the model."""
    left = [effect for effect in whole.effects if effect not in added]
    left.sort(key=lambda effect: effect.name != name)
    together = likelihood_ratio(asked.fit, left, whole.fit)
    several = {2: "two", 3: "three", 4: "four", 5: "five"}[len(left)] if len(left) > 1 else ""
    note = f"{several} effects are missing: none alone mends everything" if several else ""
    if not added:
        return SelectionStep(verdict, asked, (together,), tried, aside, (name,), sets.search, note)
    alone = sets.subset(whole, (*added, left[0]))
    fits = (together,) if alone is None else (likelihood_ratio(asked.fit, left[:1], alone.fit), together)
    return SelectionStep(verdict, asked, (together,), fits, (), (name,), None, note)


def _beside(asked: MisfitTests, hypothesis: LikelihoodRatio, added: Sequence[Effect]) -> LikelihoodRatio:
    """What a set adds to those that were added."""
    left = [effect for effect in hypothesis.effects if effect.name not in {effect.name for effect in added}]
    return likelihood_ratio(asked.fit, left, hypothesis.fit)


def _partial(questions: MisfitTests, sets: EffectSets) -> tuple[LikelihoodRatio, ...]:
    """The steps that mend most of a misfit at plausible sizes; none where they mend little."""
    steps = sets.plausible_steps()
    before = questions.fit.chi2_per_dof - 1
    mostly = bool(steps) and steps[-1].fit.chi2_per_dof - 1 < (1 - PARTIAL_SHARE) * before
    return steps if mostly else ()


def _why_not(nearest: Sequence[LikelihoodRatio], aside: dict[str, str]) -> tuple[tuple[str, str], ...]:
    """Why the nearest hypothesis of each size is no explanation."""
    left = "something is left once it is added"
    return tuple(
        dict.fromkeys(
            (hypothesis.label, hypothesis.reason if not hypothesis.credible else aside.get(hypothesis.label, left))
            for hypothesis in nearest
        )
    )
