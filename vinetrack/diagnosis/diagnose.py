"""Diagnose an experiment: what its model lacks, how certain that is, how far the error falls, and what to do next.

diagnosis = vinetrack.diagnose("my_experiment")
print(diagnosis)
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.special import stdtrit

from vinetrack.core.problems import Remark, in_words, remark
from vinetrack.core.process import in_one_blas_thread
from vinetrack.core.records import Floats, Track, with_flag
from vinetrack.diagnosis.further_trials import next_experiment
from vinetrack.diagnosis.hypotheses import FAR_BEHIND, LikelihoodRatio, likelihood_ratio
from vinetrack.diagnosis.ladder import candidates_of, initial_fit, locate, not_better, with_host
from vinetrack.diagnosis.ladder import ladder as error_ladder
from vinetrack.diagnosis.linear_power import power_of
from vinetrack.diagnosis.misfit_tests import LARGEST_MISSED, testable
from vinetrack.diagnosis.missing_force import missing_force
from vinetrack.diagnosis.result import (
    ADEQUATE,
    AMBIGUOUS,
    ARTEFACT,
    BETWEEN_TRIALS,
    DROPPED_FRAMES,
    NOT_TESTABLE,
    REFITTED,
    SCREENED,
    UNEXPLAINED,
    Candidate,
    Cosines,
    Diagnosis,
    Round,
)
from vinetrack.diagnosis.selection import Report, SelectionStep, confounders_of, select_effects
from vinetrack.dynamics.model import Model, base_model, host_for, make_model
from vinetrack.dynamics.simulate import SimulationError
from vinetrack.effects import Effect, EffectError
from vinetrack.experiment.folder import Experiment
from vinetrack.experiment.settings import Limits
from vinetrack.inference.errors import FEWEST_CLUSTERS
from vinetrack.inference.fit import predict_prepared
from vinetrack.inference.fit_data import FitError, FitTrial, Pairs, pairs_of
from vinetrack.inference.fit_result import Fit
from vinetrack.inference.optimiser import relative_residuals
from vinetrack.tracks.frame_timing import correct_frames, ends_short, frames_surely_missing, longer_than_stated
from vinetrack.tracks.position_noise import low_passed, rejected_points_note


@in_one_blas_thread
def diagnose(
    source: Fit | Experiment | Pairs,
    *,
    model: Model | None = None,
    tracks: Mapping[str, Track] | None = None,
    candidates: Iterable[str] | None = None,
    user_effects: Mapping[str, Effect] | None = None,
    limits: Limits | None = None,
    ladder: bool = True,
    advice: bool = True,
    report: Report = lambda _: None,
    fitted: Fit | None = None,
) -> Diagnosis:
    """Find what is missing from a model; `fitted` is its `initial_fit` to the same tracks, if there is one already."""
    if isinstance(source, Fit):
        fitted, model, source = source, source.model, source.pairs
    if isinstance(source, Experiment):
        settings, own_effects = source.settings, source.user_effects
        model = model or make_model(settings.model, own_effects)
        user_effects = {**own_effects, **(user_effects or {})}
        candidates = settings.candidates if candidates is None else candidates
        limits = limits or settings.limits
    model = model or base_model()
    effects = candidates_of(model, candidates, user_effects)
    pairs, left_out = pairs_of(source, tracks)
    if not isinstance(source, Experiment):  # whose tracks were corrected as they were read
        pairs = [(trial, track if trial.video else correct_frames(track)) for trial, track in pairs]
    # Trials whose times were corrected for dropped frames, each with whether it has dropped some for certain
    retimed = [(trial.name, track) for trial, track in pairs if with_flag(track.flag, "retimed").any()]
    dropped = {name: frames_surely_missing(track) for name, track in retimed}
    report("fitting the model")
    if fitted is None or dropped:
        fit = initial_fit(model, pairs, effects)
    else:
        fit = with_host(fitted, host_for(model, effects))
    unfit: dict[str, list[str]] = {}
    by_request = source.left_out if isinstance(source, Experiment) else {}
    for name, reason in {**left_out, **fit.left_out}.items():
        if name not in by_request:
            unfit.setdefault(reason, []).append(name)
    told = [remark("not_in_the_fit", names=names, reason=reason) for reason, names in unfit.items()]

    def diagnosed(fit: Fit) -> Diagnosis:
        return _diagnosis_of(replace(fit, left_out={**left_out, **fit.left_out}), effects, report)

    result = diagnosed(fit)
    last_fit = (*result.fits, *result.rounds[-1].partial_fits)[-1]
    named = {row.kind for row in result.rounds[-1].ranking if row.in_answer_set}
    unnamed = result.final_verdict in (ADEQUATE, UNEXPLAINED) or named == {BETWEEN_TRIALS}
    if unnamed and (names := odd_trials(last_fit)):
        others = diagnosed(initial_fit(model, [pair for pair in pairs if pair[0].name not in names], effects))
        if others.final_verdict == ADEQUATE:
            model_fit = others.fits[-1]
            odd = [
                (one.trial.name, one.trial.pressure_unit, one.typical_pressure_Pa, implied_pressure_Pa(model_fit, one))
                for one in last_fit.predictor.data
                if one.trial.name in names
            ]
            told.append(remark("odd_trials", odd=odd, names=names, others=len(others.fit.trials)))
            result = replace(others, odd_trials=names)
    result = with_lost_frames(result, dropped)
    told += [longer_than_stated(pairs), ends_short(pairs), low_passed(pairs)]
    if far_off := _far_off(result.fits[-1]):
        told.append(remark("far_off", names=list(far_off), percent=100 * max(far_off.values())))
    outliers = rejected_points_note({trial.name: track for trial, track in pairs if trial.video is None})
    result = replace(result, notes=(*result.notes, *filter(None, (*told, outliers))))
    return _with_advice(result, limits, report, ladder, advice)


def _far_off(fit: Fit) -> dict[str, float]:
    """Trials that a model misses though it describes the others, and by which part of their growth: by far in itself,
    or far more than by their noise and than it misses the others. None where half are missed, or two of a condition:
    that is physics.
    """
    missed, data = relative_residuals(fit.solution), fit.predictor.data
    noises = [trial_data.noise_m / max(float(np.ptp(trial_data.lead_position_m)), 1e-9) for trial_data in data]
    # 5, 3, 0.01: times the median of all trials, times its own noise, and part of its growth, from which a trial is far
    # off (chosen)
    beside_others = (missed > 5 * np.median(missed)) & (missed > 3 * np.array(noises)) & (missed > 0.01)
    far_off = np.flatnonzero((missed > LARGEST_MISSED) | beside_others).tolist()
    if len(far_off) > 0.5 * len(data) or len({data[i].trial.condition for i in far_off}) < len(far_off):
        return {}
    return {data[i].trial.name: float(missed[i]) for i in far_off}


def _diagnosis_of(fit: Fit, candidates: Sequence[Effect], report: Report) -> Diagnosis:
    """Select the effects that a fit lacks among these candidates, and tell the rounds in words and tables."""
    effects, not_testable = testable(candidates, fit.predictor.data)
    steps = select_effects(fit, effects, report)
    rounds = tuple(_to_round(step, not_testable) for step in steps)
    explanation = " ".join(finished.explanation for finished in rounds)
    lacks = {name: why for name, why in not_testable.items() if why.code in ("column_blank", "columns_partly_blank")}
    lack_columns = [name for name, why in lacks.items() if why.facts.get("column") != "payload_g"]  # blank: none
    not_tried = lack_columns if any(finished.verdict == UNEXPLAINED for finished in rounds) else []
    return Diagnosis(
        rounds=rounds,
        effects=tuple(step.answer_names[0] for step in steps[:-1]),
        explanation=explanation,
        not_tried=tuple(not_tried),
        fits=tuple(step.tests.fit for step in steps),
        power=power_of(steps[-1].tests, not_testable),
        refused=str(remark("take_effects_out")) if steps[-1].is_open else "",
    )


def _to_round(step: SelectionStep, not_testable: Mapping[str, Remark]) -> Round:
    tests = step.tests
    names = tuple(dict.fromkeys(tests.products.effects))
    # Between effects, each in the shape of the largest predicted gain
    best_shapes = [tests.ranked_shapes(name)[0] for name in names]
    cosines = tests.scores.cosines[np.ix_(best_shapes, best_shapes)] if best_shapes else np.zeros((0, 0))
    sets = tuple(hypothesis.names for hypothesis in step.answer_set)
    partial_fits = tuple(hypothesis.fit for hypothesis in step.partial)
    partial = zip((tests.fit, *partial_fits), step.partial, strict=False)  # each with the fit before it
    return Round(
        model=tests.fit.model.names,
        verdict=step.verdict,
        answer_set=step.answer_names,
        ranking=tuple(_ranking(step, not_testable)),
        explanation=in_words(step),
        slips=step.slips,
        cosines=Cosines(names, cosines.tolist()),
        confounded=confounders_of(tests) if step.verdict == ADEQUATE else (),
        fit=tests.fit,
        fits=tuple(one.fit for one in step.answer_set if one.effects[-1].kind != BETWEEN_TRIALS),
        sets=sets if any(len(effects) > 1 for effects in sets) else (),
        partial=tuple(_refitted(likelihood_ratio(before, one.effects[-1:], one.fit)) for before, one in partial),
        partial_fits=partial_fits,
    )


def _refitted(single: LikelihoodRatio, within: LikelihoodRatio | None = None, **more: Any) -> Candidate:
    """The row of a fitted effect; what is known of it `within` a set is that of the set, and its size there."""
    effect, told = single.effects[0], within or single
    numbers = tuple(one for one in told.numbers if not within or one.key.split(".")[0] == effect.name)
    known = told.delta_chi2, told.sigma, numbers, told.plausible
    return Candidate(effect.name, effect.kind, REFITTED, *known, **more)


def _ranking(step: SelectionStep, not_testable: Mapping[str, Remark]) -> list[Candidate]:
    """All candidates: the answer set, then those fitted (also differences between trials, and a tail that goes slack),
    those screened, and those that cannot be tested.
    """
    tests, rejected = step.tests, dict(step.rejected)
    singles = {hypothesis.names[0]: hypothesis for hypothesis in step.fitted if len(hypothesis.names) == 1}
    effects = {effect.name: effect for effect in tests.effects}
    rows = []
    reached = max((single.fit.log_likelihood for single in singles.values()), default=-math.inf)
    sets = {name: one for one in reversed(step.answer_set) if len(one.names) > 1 for name in one.names}
    for name, single in singles.items():
        within = sets.get(name) if name in step.answer_names else None
        row = _refitted(
            single,
            within,
            in_answer_set=name in step.answer_names,
            reason=within.reason if within else rejected.get(name, single.reason),
            along=(within or single).others if name in step.answer_names else (),
        )
        if not single.fit.converged and single.fit.log_likelihood < reached - FAR_BEHIND:
            row = replace(row, numbers=(), reason=remark("given_up"))
        rows.append(row)
    for effect in (effect for name, effect in effects.items() if name not in singles):
        z, is_adequate = tests.best_z(effect.name), step.verdict == ADEQUATE
        # An effect that contains one of the answer set can fit no worse, and need not be fitted.
        reasons = [remark("contains", name=answer) for answer in effect.replaces if answer in step.answer_names]
        status, delta_chi2, sigma = SCREENED, z**2, z
        if effect.name in tests.products.silent:
            status, delta_chi2, sigma, reasons = NOT_TESTABLE, math.nan, math.nan, [remark("no_response")]
        row = Candidate(
            effect.name,
            effect.kind,
            status,
            delta_chi2,
            sigma,
            in_answer_set=effect.name in step.answer_names,
            reason=reasons[0] if reasons else Remark(),
            largest=tests.upper_limits(effect) if is_adequate else {},
        )
        rows.append(row)
    rows += [
        Candidate(name, "", NOT_TESTABLE, reason=reason)
        for name, reason in not_testable.items()
        if name not in tests.fit.model
    ]
    order = {REFITTED: 0, SCREENED: 1, NOT_TESTABLE: 2}
    return sorted(rows, key=lambda row: (not row.in_answer_set, order[row.status], -np.nan_to_num(row.delta_chi2)))


def _with_ladder(result: Diagnosis) -> Diagnosis:
    """Add the ladder: the errors of every model."""
    last = result.rounds[-1]
    added = ("", *result.effects, *(step.effect for step in last.partial))
    table = error_ladder((*result.fits, *last.partial_fits), added, len(last.partial))
    against = not_better(table) if result.final_verdict == ADEQUATE else []
    return replace(result, ladder=table, notes=(*result.notes, *table.attrs["notes"], *against))


def _with_advice(result: Diagnosis, limits: Limits | None, report: Report, ladder: bool, advice: bool) -> Diagnosis:
    """Add the ladder; where the first model fails, the force it lacks if no effect explains it, and the next
    experiment, which would discriminate between the hypotheses that remain. A note says why one cannot be computed.
    """
    last, is_unexplained = result.rounds[-1], UNEXPLAINED in (result.verdict, result.final_verdict)
    tied = list(last.fits)
    if last.verdict == ARTEFACT and len(tied) == 1 and last.fit is not None:
        tied.insert(0, last.fit)
    are_tied = last.verdict in (AMBIGUOUS, ARTEFACT) and len(tied) > 1

    def with_next(known: Diagnosis) -> Diagnosis:
        return replace(known, next_experiment=next_experiment(tied, limits).to_json())

    for is_wanted, what, code, added in (
        (ladder, "errors before and after", "no_ladder", _with_ladder),
        (advice and result.verdict != ADEQUATE, "where it fails", "not_located", _located),
        (advice and is_unexplained, "computing the missing force", "no_missing_force", _with_missing_force),
        (advice and are_tied, "looking for the next experiment", "no_next_experiment", with_next),
    ):
        if is_wanted:
            report(what)
            try:
                result = added(result)
            except (FitError, EffectError, SimulationError, np.linalg.LinAlgError) as error:
                result = replace(result, notes=(*result.notes, remark(code, error=str(error))))
    return result


def _located(result: Diagnosis) -> Diagnosis:
    """Add where the first model fails, and which of its parameters drift."""
    failure = locate(result.fits[0])
    drift = [{str(key): value for key, value in row.items()} for row in failure.drift.table.to_dict("records")]
    return replace(result, failure=failure, where=failure.remarks, drift=drift)


def _with_missing_force(result: Diagnosis) -> Diagnosis:
    """Add the force that the first model lacks, and the simple law that it resembles."""
    force = missing_force(result.fits[0])
    told = (force.sentence, *([force.learned.sentence] if force.learned else []))
    explanation = " ".join(map(str, (result.explanation, *told)))
    return replace(result, missing_force=force.to_json(), force=force, explanation=explanation)


# ------------------------------------------------------------------------------
# Odd trials: a row of the sheet that belongs to another recording, or a typing error. A fit gives a trial deviations of
# pressure and B, which together are one of the force that damping balances,
#
#     Δ ln F = ln (1 + p P / (P − P_y)) − b
#
# The farthest is held against the others, and left out, one after the other, up to the last that is too far: two
# outliers cannot hide each other (generalised ESD: Rosner, Technometrics 25, 165, 1983). An effect that the model lacks
# changes all trials of a condition alike; a pressure with its digits swapped does not. They are believed where the
# others leave nothing unexplained.

CHANCE = 1e-3  # Probability that normal scatter makes any trial of a campaign an outlier (chosen)


def odd_trials(fit: Fit) -> tuple[str, ...]:
    """Find trials whose force is off by far more than that of the others; else those that the model alone misses."""
    trials, data = [one.trial for one in fit.trials], fit.predictor.data
    if len(trials) < FEWEST_CLUSTERS or any(trial.travel_ratio != 2 for trial in trials):
        return ()
    pressure_Pa = np.array([one.typical_pressure_Pa for one in data])
    over_Pa = pressure_Pa - [np.nan_to_num(trial.yield_pressure_Pa) for trial in trials]
    deviations = np.array([(one.pressure_deviation, math.log1p(one.damping_deviation)) for one in fit.trials])
    # 0.05: least part of a pressure above the yield pressure, and of its stated force that a trial may have (chosen)
    relative = deviations[:, 0] * pressure_Pa / np.maximum(over_Pa, 0.05 * pressure_Pa)
    off = np.log(np.maximum(1 + relative, 0.05)) - deviations[:, 1]
    found = tuple(trials[k].name for k in _farthest(off)) or tuple(_far_off(fit))
    # Where two replicates are odd, the cause is physics of the condition.
    conditions = {trial.condition for trial in trials if trial.name in found}
    return found if len(conditions) == len(found) <= _most(len(trials)) else ()


def implied_pressure_Pa(fit: Fit, data: FitTrial) -> float:
    """The pressure under which trials of a fit would have moved as another trial did; NaN where there is none."""

    def missed(log_factor: float) -> float:
        """Part of its growth by which the fit misses the trial, its pressure times a factor."""
        factor = math.exp(log_factor)
        trial = replace(data.trial, pressure_Pa=factor * data.trial.pressure_Pa)
        trace = None if data.trace is None else (data.trace[0], factor * data.trace[1])
        try:
            (moved,) = predict_prepared(fit, [replace(data, trial=trial, trace=trace)])
        except FitError:
            return math.inf
        return moved.rms_m / float(np.ptp(data.lead_position_m))

    near = min(np.arange(-3, 3.1, 0.25), key=missed)  # Up to a factor of twenty, where no vine moves or all jump
    best = minimize_scalar(missed, bounds=(near - 0.25, near + 0.25), method="bounded", options={"xatol": 1e-3})
    return data.typical_pressure_Pa * math.exp(best.x) if best.fun < LARGEST_MISSED else math.nan


def _farthest(values: Floats) -> list[int]:
    """Indices of the values too far from the others, in order; none where they would be too many."""
    kept, far, count = np.arange(values.size), list[int](), 0
    while len(far) <= _most(values.size):
        worst = int(np.argmax(np.abs(values[kept] - np.median(values[kept]))))
        farthest, kept = int(kept[worst]), np.delete(kept, worst)
        far.append(farthest)
        # 0.02: least scatter of ln F, that of careful trials (chosen)
        scatter = max(float(np.std(values[kept], ddof=1)), 0.02) * math.sqrt(1 + 1 / kept.size)
        quantile = -float(stdtrit(kept.size - 1, CHANCE / (2 * (kept.size + 1))))
        if abs(values[farthest] - np.mean(values[kept])) > quantile * scatter:
            count = len(far)
    return sorted(far[:count]) if count <= _most(values.size) else []


def _most(trials: int) -> int:
    """How many of so many trials may be odd."""
    return max(2, int(0.125 * trials))  # 0.125: the largest fraction (chosen)


def with_lost_frames(result: Diagnosis, lost: Mapping[str, bool]) -> Diagnosis:
    """Put certain dropped frames first in a diagnosis, and its verdict with corrected times into a note. A jump that a
    few outlying points may have caused becomes a note only.
    """
    if not lost:
        return result
    if not any(lost.values()):
        return replace(result, notes=(*result.notes, remark("frames_perhaps_missing", trials=tuple(lost))))
    note = remark("with_corrected_times", verdict=result.verdict, explanation=result.explanation)
    words = str(remark("frames_missing", trials=tuple(lost)))
    nothing: dict[str, Any] = {"fits": (), "sets": (), "partial": (), "partial_fits": ()}
    only = replace(result.rounds[0], explanation=words, verdict=ARTEFACT, answer_set=(DROPPED_FRAMES,), **nothing)
    alone = replace(result, rounds=(only,), effects=(), explanation=words, fits=result.fits[:1])
    return replace(alone, notes=(note,), odd_trials=())
