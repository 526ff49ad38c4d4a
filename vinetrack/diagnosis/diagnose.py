"""The diagnosis of an experiment: what its model lacks, how sure that is, what it brings to add it, what to do next.

diagnosis = vinetrack.diagnose("my_experiment")
print(diagnosis)
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vinetrack.core.records import Track
from vinetrack.diagnosis.between_trials import between_candidates
from vinetrack.diagnosis.candidates import testable
from vinetrack.diagnosis.contradictions import contradictions
from vinetrack.diagnosis.initial_fit import candidates_of, host_for, initial_fit, with_host
from vinetrack.diagnosis.likelihood_ratio import LikelihoodRatio, likelihood_ratio, weights_of
from vinetrack.diagnosis.linear_power import power_of
from vinetrack.diagnosis.lost_frames import correct_dropped_frames, lost_in_fit, with_lost_frames
from vinetrack.diagnosis.misfit_tests import MisfitTests
from vinetrack.diagnosis.odd_trials import odd_trials, with_odd_trials
from vinetrack.diagnosis.result import (
    ADEQUATE,
    AMBIGUOUS,
    ARTEFACT,
    BETWEEN_TRIALS,
    NOT_TESTABLE,
    REFITTED,
    SCREENED,
    UNEXPLAINED,
    Candidate,
    Diagnosis,
    Round,
)
from vinetrack.diagnosis.selection import SelectionStep, select_effects
from vinetrack.diagnosis.slack_hypothesis import TAIL_SLACK
from vinetrack.dynamics.model import Model, base_model, make_model
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.effects import Effect, EffectError
from vinetrack.inference.fit_data import FitError, Pairs, pairs_of
from vinetrack.inference.fit_result import Fit
from vinetrack.narrative.verdict_summary import joined
from vinetrack.narrative.verdict_text import explain
from vinetrack.tracks.outliers import rejected_points_note

if TYPE_CHECKING:
    from vinetrack.experiment.folder import Experiment
    from vinetrack.experiment.settings import Limits

log = logging.getLogger(__name__)

Report = Callable[[str], None]

NO_RESPONSE = "no trial answers to it at any plausible size"
TOO_WEAK = "in these conditions the largest plausible size would not show"


def _quiet(_: str) -> None:
    pass


def diagnose(
    source: Fit | Experiment | Path | str | Pairs,
    *,
    model: Model | None = None,
    tracks: Mapping[str, Track] | None = None,
    candidates: Iterable[str] | None = None,
    user_effects: Mapping[str, Effect] | None = None,
    limits: Limits | None = None,
    ladder: bool = True,
    advice: bool = True,
    report: Report = _quiet,
) -> Diagnosis:
    """Ask of a model what is missing from it.

    Parameters
    ----------
    source
        A fit, whose model is questioned; or an experiment, its folder, or pairs of trial and track, to which the model
        is fitted first.
    model : Model, optional
        The model to question, by default the one the experiment names, else the base model.
    tracks : mapping, optional
        Tracks by name of trial, where the experiment brings recordings.
    candidates : iterable of str, optional
        Names of the effects to question, by default those the experiment names, else the whole catalogue.
    user_effects : mapping, optional
        Effects of the user by name.
    limits : Limits, optional
        Within which limits further trials can be made.
    ladder, advice : bool
        Whether errors before and after are worked out, and what to do next.
    report : callable
        Called with a few words at each step.

    Returns
    -------
    Diagnosis

    Raises
    ------
    FitError
        If there is nothing to fit.
    EffectError
        If an effect is unknown or a trial lacks what the model needs.
    ExperimentError
        If the experiment cannot be read.
    """
    wild = ""
    if isinstance(source, Fit):
        questioned = candidates_of(source.model, candidates, user_effects)
        fit, missing = with_host(source, host_for(source.model, questioned)), lost_in_fit(source)
    else:
        settings = _settings(source)
        if settings is not None:
            source, named, listed_candidates, brought, stated = settings
            model, user_effects = model or named, {**brought, **(user_effects or {})}
            candidates = listed_candidates if candidates is None else candidates
            limits = limits or stated
        model = model or base_model()
        questioned = candidates_of(model, candidates, user_effects)
        pairs, left_out = pairs_of(source, tracks)
        pairs, missing = correct_dropped_frames(pairs)
        wild = rejected_points_note({trial.name: track for trial, track in pairs if trial.video is None})
        report("fitting the model")
        fit = initial_fit(model, pairs, questioned, profile=False)
        fit = replace(fit, left_out={**left_out, **fit.left_out})
    result = _questioned(fit, questioned, report)
    if not isinstance(source, Fit):
        result = with_odd_trials(
            result,
            odd_trials(fit.predictor.data),
            lambda names: _questioned(
                initial_fit(
                    fit.model, [pair for pair in pairs if pair[0].name not in names], questioned, profile=False
                ),
                questioned,
                report,
            ),
        )
    result = with_lost_frames(result, missing)
    if wild:
        result = replace(result, notes=(*result.notes, wild))
    if ladder:
        result = _with_ladder(result, report)
    if ladder and result.final_verdict == ADEQUATE:
        report("what speaks against it")
        objections = contradictions(result.fits, result.effects, result.ladder)
        result = replace(result, notes=(*result.notes, *(f"Against this verdict: {doubt}" for doubt in objections)))
    if advice:
        result = _with_advice(result, limits, report)
    return result


def _questioned(fit: Fit, questioned: Sequence[Effect], report: Report) -> Diagnosis:
    """What a fit lacks of these effects, in words and tables."""
    effects, blind = testable(questioned, fit.predictor.data)
    return _conclude(fit, select_effects(fit, effects, report), blind)


def _settings(
    source: Experiment | Path | str | Pairs,
) -> tuple[Experiment, Model, tuple[str, ...] | None, dict[str, Effect], Limits] | None:
    """An experiment with what it says of model, candidates, own effects and limits; None for bare pairs."""
    from vinetrack.effects import own_effects
    from vinetrack.experiment.folder import Experiment, read_experiment

    if isinstance(source, (str, Path)):
        source = read_experiment(source)
    if not isinstance(source, Experiment):
        return None
    settings = source.settings
    user_effects = own_effects([source.folder / path for path in settings.effects])
    return source, make_model(settings.model, user_effects), settings.candidates, dict(user_effects), settings.limits


def _conclude(fit: Fit, findings: Sequence[SelectionStep], blind: Mapping[str, str]) -> Diagnosis:
    """Findings in words and tables."""
    rounds = tuple(_round(finding, blind) for finding in findings)
    added: list[str] = []
    fits = [fit]
    for finding in findings[:-1]:
        effect = finding.answer_names[0]
        added.append(effect)
    for after in findings[1:]:
        fits.append(after.tests.fit)
    explanation = " ".join(step.explanation for step in rounds)
    lacking = [name for name, why in blind.items() if "`" in why]
    if lacking and any(step.verdict == UNEXPLAINED for step in rounds):
        explanation += f" Not tried, because the sheet does not say what they need: {joined(lacking)}."
    power = power_of(findings[-1].tests, blind, first_round=findings[0].tests)
    return Diagnosis(rounds=rounds, effects=tuple(added), explanation=explanation, fits=tuple(fits), power=power)


def _round(finding: SelectionStep, blind: Mapping[str, str]) -> Round:
    questions = finding.tests
    names, cosines = _cosines(questions)
    return Round(
        model=questions.fit.model.names,
        verdict=finding.verdict,
        answer_set=finding.answer_names,
        ranking=tuple(_ranking(finding, blind)),
        explanation=explain(finding),
        cosine_names=names,
        cosines=cosines,
        fit=questions.fit,
        fits={
            hypothesis.names[-1]: hypothesis.fit
            for hypothesis in finding.answer_set
            if hypothesis.effects[-1].kind != BETWEEN_TRIALS
        },
        sets=_sets(finding),
        partial=_partial(finding),
        partial_fits=tuple(hypothesis.fit for hypothesis in finding.partial),
    )


def _sets(finding: SelectionStep) -> tuple[tuple[str, ...], ...]:
    """The hypotheses of an answer set, each with all its effects, where one has several."""
    sets = tuple(hypothesis.names for hypothesis in finding.answer_set)
    return sets if any(len(names) > 1 for names in sets) else ()


def _partial(finding: SelectionStep) -> tuple[Candidate, ...]:
    """The steps that mend a part, each against the one before it."""
    steps, before = [], finding.tests.fit
    for hypothesis in finding.partial:
        effect = hypothesis.effects[-1]
        step = likelihood_ratio(before, (effect,), hypothesis.fit)
        steps.append(
            Candidate(effect.name, effect.kind, REFITTED, step.delta_chi2, step.sigma, step.numbers, step.plausible)
        )
        before = hypothesis.fit
    return tuple(steps)


def _cosines(questions: MisfitTests) -> tuple[tuple[str, ...], list[list[float]]]:
    """Cosines between effects, each in the shape that promises most."""
    names = tuple(dict.fromkeys(questions.sensitivities.effects))
    places = [questions.ranked_shapes(name)[0] for name in names]
    matrix = questions.scores.cosines[np.ix_(places, places)] if places else np.zeros((0, 0))
    return names, matrix.tolist()


def _ranking(finding: SelectionStep, blind: Mapping[str, str]) -> list[Candidate]:
    questions = finding.tests
    aside = dict(finding.rejected)
    singles = {hypothesis.names[0]: hypothesis for hypothesis in finding.fitted if len(hypothesis.names) == 1}
    weights = weights_of(list(singles.values()))
    rows = [_rule(hypothesis, finding) for hypothesis in finding.answer_set if hypothesis.effects[-1] is TAIL_SLACK]
    for effect in questions.effects:
        largest, shows = questions.upper_limits(effect)
        if effect.name in questions.sensitivities.silent:
            rows.append(Candidate(effect.name, effect.kind, NOT_TESTABLE, reason=NO_RESPONSE))
            continue
        z, place = questions.best_z(effect.name)
        if effect.name in singles:
            single = singles[effect.name]
            rows.append(
                Candidate(
                    effect.name,
                    effect.kind,
                    REFITTED,
                    single.delta_chi2,
                    single.sigma,
                    single.numbers,
                    single.plausible,
                    effect.name in finding.answer_names,
                    aside.get(effect.name, single.reason),
                    largest,
                    single.others if effect.name in finding.answer_names else (),
                    weights[effect.name],
                    tuple(single for single in finding.confounded if single.number.key.split(".")[0] == effect.name),
                    single.log_bayes,
                )
            )
        elif finding.verdict == ADEQUATE and not shows and z < questions.family.threshold(effect.name):
            rows.append(Candidate(effect.name, effect.kind, NOT_TESTABLE, z**2, z, reason=TOO_WEAK))
        else:
            rows.append(
                Candidate(
                    effect.name,
                    effect.kind,
                    SCREENED,
                    _promised(finding, effect.name, z),
                    z,
                    questions.predicted_size(effect, place),
                    in_answer_set=effect.name in finding.answer_names,
                    reason=_holds(effect, finding) or _behind(finding, effect.name),
                    largest={} if questions.poorly_fitted else largest,
                )
            )
    rows += between_candidates(finding.fitted, finding.answer_names, aside)
    rows += [
        Candidate(name, "", NOT_TESTABLE, reason=why) for name, why in blind.items() if name not in questions.fit.model
    ]
    order = {REFITTED: 0, SCREENED: 1, NOT_TESTABLE: 2}
    return sorted(rows, key=lambda row: (not row.in_answer_set, order[row.status], -_known(row.delta_chi2)))


def _rule(hypothesis: LikelihoodRatio, finding: SelectionStep) -> Candidate:
    """The rule that a tail cannot push, as a candidate without a size."""
    name = hypothesis.names[-1]
    return Candidate(
        name, "physical", REFITTED, hypothesis.delta_chi2, hypothesis.sigma, (), True, name in finding.answer_names
    )


def _promised(finding: SelectionStep, name: str, z: float) -> float:
    """Fall of −2 ln L that the sensitivities promise; of an adequate model, what the score says."""
    if finding.verdict == ADEQUATE:
        return z**2
    return math.nan if finding.tests.poorly_fitted else finding.tests.predicted_gain(name)


def _holds(effect: Effect, finding: SelectionStep) -> str:
    """That an effect contains one that was found, where it does: it can be no worse, and need not be tried."""
    held = [name for name in effect.replaces if name in finding.answer_names]
    return f"it contains {held[0]} as a limit" if held else ""


def _behind(finding: SelectionStep, name: str) -> str:
    """How far a candidate stayed behind the best where only one trial of every condition was fitted."""
    climbs = finding.search.subset_fits if finding.search else {}
    if name not in climbs:
        return ""
    behind = climbs[name].deviance - min(climb.deviance for climb in climbs.values())
    return f"fitted to one trial of every condition, worse by Δχ² = {behind:.0f}" if behind > 0 else ""


def _known(value: float) -> float:
    return value if math.isfinite(value) else -math.inf


def _with_ladder(result: Diagnosis, report: Report) -> Diagnosis:
    """Errors of every model, and how the numbers moved."""
    from vinetrack.diagnosis.ladder import ladder

    report("errors before and after")
    try:
        steps = [step.effect for last in result.rounds[-1:] for step in last.partial]
        further = [fit for last in result.rounds[-1:] for fit in last.partial_fits]
        table = ladder((*result.fits, *further), ("", *result.effects, *steps), len(steps))
        return replace(result, ladder=table, notes=(*result.notes, *table.attrs["notes"]))
    except (FitError, SimulationError, np.linalg.LinAlgError) as error:
        return replace(result, notes=(*result.notes, f"The ladder of errors could not be made: {error}"))


def _with_advice(result: Diagnosis, limits: Limits | None, report: Report) -> Diagnosis:
    """Where the first model fails, the force it lacks if nothing known mends it, and what to do where effects tie."""
    result = _located(result, report) if result.verdict != ADEQUATE else result
    if UNEXPLAINED in (result.verdict, result.final_verdict):
        result = _with_missing_force(result, report)
    return with_next_experiment(result, limits, report)


def with_next_experiment(result: Diagnosis, limits: Limits | None = None, report: Report = _quiet) -> Diagnosis:
    """A diagnosis with the trials that would tell apart the names that it leaves.

    Parameters
    ----------
    result : with fewer than two names left it stays as it is.
    limits, report : within which further trials can be made; called with a few words at each step.

    Returns
    -------
    Diagnosis
    """
    last = result.rounds[-1]
    tied = list(last.fits.values())
    if last.verdict == ARTEFACT and len(tied) == 1 and last.fit is not None:
        tied.insert(0, last.fit)
    if last.verdict not in (AMBIGUOUS, ARTEFACT) or len(tied) < 2:
        return result
    from vinetrack.diagnosis.next_experiment import next_experiment

    report("looking for the next experiment")
    try:
        return replace(result, next_experiment=next_experiment(tied, limits).to_json())
    except (FitError, EffectError, SimulationError, np.linalg.LinAlgError) as error:
        return replace(result, notes=(*result.notes, f"No next experiment could be worked out: {error}"))


def _located(result: Diagnosis, report: Report) -> Diagnosis:
    """Where the first model fails, and which of its numbers drift."""
    from vinetrack.diagnosis.locate import locate

    report("where it fails")
    try:
        failure = locate(result.fits[0])
    except (FitError, SimulationError, np.linalg.LinAlgError) as error:
        return replace(result, notes=(*result.notes, f"Where the model fails could not be worked out: {error}"))
    drift = [{str(key): value for key, value in row.items()} for row in failure.drift.table.to_dict("records")]
    return replace(result, failure=failure, where=failure.sentences(), drift=drift)


def _with_missing_force(result: Diagnosis, report: Report) -> Diagnosis:
    """The force that the first model lacks, and what simple law it looks like."""
    from vinetrack.diagnosis.missing_force import missing_force

    report("drawing the missing force")
    try:
        force = missing_force(result.fits[0])
    except (FitError, SimulationError, np.linalg.LinAlgError) as error:
        return replace(result, notes=(*result.notes, f"The missing force could not be drawn: {error}"))
    explanation = f"{result.explanation} {force.sentence}"
    learned = None if force.learned is None else force.learned.table
    return replace(
        result,
        missing_force=force.to_json(),
        force_table=force.table,
        learned_table=learned,
        explanation=explanation if force.learned is None else f"{explanation} {force.learned.sentence}",
    )
