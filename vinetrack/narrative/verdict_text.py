"""Explanation of each round of a diagnosis in sentences; `diagnosis_text` has the headline and the tables."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import TYPE_CHECKING, Any

from vinetrack.core.problems import joined
from vinetrack.core.units import decimals, display_unit, number, with_error
from vinetrack.diagnosis.hypotheses import ANSWER_SET_DELTA_CHI2, BETWEEN, ORDER_DRIFT, SPECIMEN
from vinetrack.diagnosis.result import (
    ADEQUATE,
    AMBIGUOUS,
    ARTEFACT,
    BETWEEN_TRIALS,
    DROPPED_FRAMES,
    EXPECTED,
    MISSING,
    NOT_TESTABLE,
    REFITTED,
    TAIL_SLACK,
    UNEXPLAINED,
)
from vinetrack.effects import BASE_EFFECTS, catalogue
from vinetrack.experiment.folder import trial_order
from vinetrack.inference.fit_result import DAMPING, EXPONENT, Number
from vinetrack.narrative import sentence

if TYPE_CHECKING:
    import pandas as pd

    from vinetrack.diagnosis.hypotheses import LikelihoodRatio
    from vinetrack.diagnosis.result import Candidate, Confounder, Diagnosis
    from vinetrack.diagnosis.selection import SelectionStep


# ------------------------------------------------------------------------------
# Differences between trials in words: which trials differ, by how much, and how to confirm it.


def trials_differ(names: Sequence[str]) -> bool:
    """Whether every name of an answer set is a difference between trials."""
    return bool(names) and all(name in BETWEEN for name in names)


def difference_text(name: str, remedy: bool = False) -> str:
    """A difference between trials, or what to do about it."""
    return sentence(name, {"remedy": remedy})


def hypothesis_in_words(result: LikelihoodRatio) -> str:
    """A hypothesis with its sizes: `leak has 1/τ = …`, `specimens (tubes of one kind) differ: ΔlnB (2) = …`."""
    if result.effects[-1].kind != BETWEEN_TRIALS:
        return " has ".join(filter(None, (" with ".join(result.names), sizes_in_words(result.numbers))))
    more = len(result.numbers) - MOST_NAMED
    sizes = f"{sizes_in_words(result.numbers[:MOST_NAMED])}{f' and {more} more' if more > 0 else ''}"
    return f"{difference_text(result.names[-1])}: {sizes}"


def remedies_in_words(step: SelectionStep, answers: Sequence[LikelihoodRatio] = ()) -> str:
    """What to do about the differences between trials in an answer set; blank where there are none."""
    trials = [trial.trial for trial in step.tests.fit.trials]
    names = [result.names[-1] for result in answers or step.answer_set if result.effects[-1].kind == BETWEEN_TRIALS]
    if not names:
        return ""
    text = "".join(f" {difference_text(name, remedy=True)}." for name in names)
    if (ORDER_DRIFT in names or SPECIMEN in names) and not trial_order(trials)[1]:
        text = f" The trials were assumed to be in the order of the rows.{text}"
    return text


# ------------------------------------------------------------------------------
# The verdict as a table, the same in terminal, report, explorer, notebook and `diagnosis.json`.

# What would make the part of an error smaller that all trials share, by its source
SHARED_REMEDIES = {
    "payloads": "weigh the payloads", "set pressures": "calibrate the gauge", "gauge": "record a quieter pressure",
    "tracking": "film the edge larger or sharper",
    "lens": "film a board that fills the picture, or a ruler along the growth (position_systematic_mm)",
}  # fmt: skip


@dataclass(frozen=True)
class Row:
    """A row of the verdict table: a question, its answer, and what there is to say beside it."""

    question: str
    answer: str
    note: str = ""


def percent(rate: float) -> str:
    """Return a rate in per cent, two digits."""
    return f"{number(100 * rate, 2)} %"


def spaced_name(effect: str) -> str:
    """Return the name of an effect with blanks for underscores."""
    return str(effect).replace("_", " ")


def listed_names(names: Sequence[str], last: str = "and") -> str:
    """Return names of effects as a sentence lists them, with blanks for underscores: `air drag, leak or gravity`."""
    return joined([spaced_name(name) for name in names], last)


def verdict_line(diagnosis: Diagnosis) -> str:
    """Return the verdict in one line, with the names of effects as commands take them."""
    return f"{'check the sheet' if diagnosis.contradicted_columns else diagnosis.verdict}: {_told(diagnosis, str)}"


def verdict_sentence(diagnosis: Diagnosis) -> str:
    """Return the verdict in one sentence; what contradicts the sheet in its place, since any verdict rests on it."""
    told = _told(diagnosis, spaced_name)
    return f"{told if diagnosis.contradicted_columns else told[0].upper() + told[1:]}."


def _told(diagnosis: Diagnosis, shown: Callable[[str], str]) -> str:
    verdict, answers = diagnosis.verdict, diagnosis.answer_set
    names = [shown(name) for name in (diagnosis.effects if verdict == MISSING else ()) or answers]
    if diagnosis.contradicted_columns:
        verdict, names = "sheet_contradicted", list(diagnosis.contradicted_columns)
    elif answers == (DROPPED_FRAMES,):
        verdict = DROPPED_FRAMES
    elif verdict and diagnosis.refused:
        verdict = "does_not_converge"
    elif verdict == ARTEFACT and trials_differ(answers):
        verdict, names = "only_trials_differ", list(map(difference_text, answers))
    added = [name for name in diagnosis.initial_model if name not in BASE_EFFECTS]
    sizes = {name: sizes_in_words([p for p in diagnosis.parameters if p.key.split(".")[0] == name]) for name in added}
    told = joined([f"{shown(name)} ({size})" if size else shown(name) for name, size in sizes.items()])
    return sentence(verdict or "no_verdict", {"names": names, "added": told})


def verdict_table(diagnosis: Diagnosis) -> list[Row]:
    """Return the verdict as rows: what is missing, how sure, how large, the damping law, what it could be instead,
    what cannot be excluded, and what to do now. A row without an answer is left out.
    """
    odd = f"Without {joined(diagnosis.odd_trials)}, inconsistent with the others. " if diagnosis.odd_trials else ""
    rows = [Row("What is missing", verdict_sentence(diagnosis), f"{odd}{_thereafter(diagnosis)}".rstrip())]
    if diagnosis.verdict and not diagnosis.contradicted_columns:
        rows += [
            Row("How sure", *_how_sure(diagnosis)),
            Row("How large", *_how_large(diagnosis)),
            Row("F = B·ẋⁿ", *_damping_law(diagnosis)),
            Row("What it could be instead", *_instead(diagnosis)),
            Row("What cannot be excluded", *_not_excluded(diagnosis)),
        ]
    rows.append(Row("What to do now", *_to_do(diagnosis)))
    return [row for row in rows if row.answer]


def _thereafter(diagnosis: Diagnosis) -> str:
    """What the model lacks once all that was found is in it; blank where that is the verdict itself."""
    if not diagnosis.effects or diagnosis.contradicted_columns:
        return ""
    last = diagnosis.rounds[-1]
    facts = {"several": len(diagnosis.effects) > 1, "names": list(map(spaced_name, last.answer_set))}
    codes = {ADEQUATE: "nothing_further", AMBIGUOUS: "one_of_these_too", ARTEFACT: "a_fault_remains"}
    code = (codes | {UNEXPLAINED: "still_fails"}).get(last.verdict)
    return sentence(code, facts) if code else ""


def _how_sure(diagnosis: Diagnosis) -> tuple[str, str]:
    tested = [row for row in diagnosis.ranking if row.status != NOT_TESTABLE and is_finite(row.sigma)]
    inside = [row for row in tested if row.in_answer_set]
    answer = ""
    if diagnosis.verdict == ADEQUATE and tested:
        best = max(tested, key=lambda row: abs(row.sigma))
        answer = f"{spaced_name(best.effect)}, the most significant candidate, reaches {_sigmas(best)} σ"
    elif inside:
        answer = f"{_sigmas(max(inside, key=attrgetter('delta_chi2')))} σ"
        if len(inside) > 1:
            answer += f"; {len(inside)} candidates fit equally well"
    notes = [_errors(diagnosis.ladder)]
    if diagnosis.power is not None:
        notes.append(f"false alarms in at most {percent(diagnosis.power.false_alarm_rate)} of such campaigns")
    note = "; ".join(filter(None, notes))
    return (answer, note) if answer else (note, "")


def _errors(ladder: pd.DataFrame | None) -> str:
    """The error of position before and after, on conditions left out where there are such. Partial steps, which reduce
    an unexplained misfit without removing it, do not count.
    """
    if ladder is None:
        return ""
    ladder = ladder[~ladder["partial"]]
    first, last = ladder.iloc[0], ladder.iloc[-1]
    key, what = "rms_left_out_m", "error on conditions left out"
    if not math.isfinite(float(first[key])):
        key, what = "rms_in_sample_m", "error of position"
    then = f" → {number(1e3 * float(last[key]))}" if len(ladder) > 1 else ""
    adequate = f", of an adequate model {expected}" if (expected := expected_text(*last[EXPECTED])) else ""
    return f"{what} {number(1e3 * float(first[key]))}{then} mm{adequate}"


def expected_text(error_m: float, low_m: float, high_m: float) -> str:
    """Error that an adequate model would show, with its 95 % range, mm; blank where it is not known."""
    middle, low, high = (number(1e3 * end_m) for end_m in (error_m, low_m, high_m))
    return f"{middle} mm ({low} to {high})" if math.isfinite(error_m) else ""


def _settled(diagnosis: Diagnosis) -> tuple[Sequence[Number], Sequence[str]]:
    """Parameters of the last model, fitted together with the faults of the measurement that remain, and their names."""
    last = diagnosis.rounds[-1]
    faults = [row for row in last.ranking if row.in_answer_set and row.along and last.verdict == ARTEFACT]
    names = (last.sets or [(row.effect,) for row in faults])[:1]
    return (faults[0].along, names[0]) if len(faults) == 1 else (diagnosis.parameters, ())


def _how_large(diagnosis: Diagnosis) -> tuple[str, str]:
    """Sizes of what is in the model beyond its base, and where nothing was added of the members of the answer set."""
    beyond = [p for p in _settled(diagnosis)[0] if p.key.split(".")[0] not in BASE_EFFECTS]
    wider = [f"95 %: {bounds_text(p, with_unit=True)}{_confounded_interval(diagnosis, p)}" for p in beyond]
    wider = [f"{p.title} {of_one}" for p, of_one in zip(beyond, wider, strict=True)] if len(beyond) > 1 else wider
    members = [row for row in diagnosis.ranking if row.in_answer_set and row.numbers and not diagnosis.effects]
    sizes = [f"{spaced_name(row.effect)}: {estimates_text(row)}" for row in members[:MOST_NAMED]]
    answer = "; ".join(filter(None, (", ".join(map(split_estimate, beyond)), *sizes)))
    # Believed for want of a hypothesis with a plausible size
    implausible = [
        str(row.reason) for step in diagnosis.rounds for row in step.ranking if row.in_answer_set and not row.plausible
    ]
    return answer, "; ".join([*implausible, *wider, *_shared_remedies(beyond)])


def _damping_law(diagnosis: Diagnosis) -> tuple[str, str]:
    """Exponent n and B of the last model."""
    numbers, faults = _settled(diagnosis)
    law = [p for p in numbers if p.key in (EXPONENT, DAMPING) and is_finite(p.value)]
    # 5: n and the B of as many vines as a line has room for
    law = sorted(law, key=lambda p: p.key != EXPONENT)[:5]
    known = listed_names([*diagnosis.effects, *faults])
    with_them = [f"with {known} in the model"] if law and known else []
    if diagnosis.answer_set == (DROPPED_FRAMES,):
        with_them.append("with corrected times")
    elif law and not faults and diagnosis.final_verdict not in (ADEQUATE, ""):
        with_them.append("of a model that these trials refute")
    within = [f"n 95 %: {bounds_text(p)}{_confounded_interval(diagnosis, p)}" for p in law[:1]]
    wider = [f"{p.title} {interval}" for p in law if p.key == DAMPING and (interval := _hull(diagnosis, p))]
    within += [f"allowing for such effects {joined(wider)}"] if wider else []
    notes = [*within, *with_them, *_shared_remedies(law)]
    return ", ".join(map(estimate_text, law)), "; ".join(notes)


def _shared_remedies(numbers: Sequence[Number]) -> list[str]:
    """What would make the shared part of the errors smaller, where that is most of an error."""
    most = [p for p in numbers if p.shared and p.shared_sigma**2 > 0.5 * p.sigma**2]
    whole = ", and may be all of the size" * any(p.low < 0 < p.high for p in most)  # its 95 % interval holds 0
    sources = dict.fromkeys(max(p.shared, key=lambda source: p.shared[source]) for p in most)
    remedies = ", and ".join(SHARED_REMEDIES[source] for source in sources)
    return [f"what all trials share is most of the error{whole}: {remedies}"] if most else []


def _instead(diagnosis: Diagnosis) -> tuple[str, str]:
    """The members of the answer set; else the nearest rivals, and why they are none."""
    fitted = [row for row in diagnosis.ranking if row.status == REFITTED and is_finite(row.delta_chi2)]
    members = [row for row in fitted if row.in_answer_set]
    rivals = sorted((row for row in fitted if not row.in_answer_set), key=lambda row: -row.delta_chi2)
    best = max((row.delta_chi2 for row in members), default=math.nan)
    why = "; ".join(_why_not(row, best) for row in rivals[:MOST_NAMED])
    if len(members) < 2:
        return ("" if diagnosis.verdict == ADEQUATE else why), ""
    return ", ".join(spaced_name(row.effect) for row in members), why


def _why_not(row: Candidate, best: float) -> str:
    """A candidate outside the answer set, and why: its reason, or how far it is behind."""
    # An implausible candidate may have the larger Δχ².
    behind = f"worse by Δχ² = {number(best - row.delta_chi2)}" if best > row.delta_chi2 else f"{_sigmas(row)} σ"
    return f"{spaced_name(row.effect)}: {', '.join(filter(None, [behind, str(row.reason)]))}"


def _not_excluded(diagnosis: Diagnosis) -> tuple[str, str]:
    """Effects that would not have been detected, of any plausible size or of smaller ones."""
    power = diagnosis.power
    if power is None:
        return "", ""
    if power.wary or not power.effects:
        return "which smaller effects would be detected is not known", str(power.wary)
    found = {name for entry in diagnosis.rounds for name in entry.answer_set}
    unlikely = [entry.effect for entry in power.effects if entry.probability_at(entry.largest) < 0.9]
    missed = [name for name in unlikely if name not in found]
    facts = {"seen": len(power.effects) - len(missed), "count": len(power.effects) + len(power.not_testable)}
    unseen = {"not even then": missed, "not testable with these trials": [*power.not_testable]}
    named = [f"{why}: {listed_names(names)}" for why, names in unseen.items() if names]
    return sentence("smaller_effects", facts), "; ".join(named)


def _to_do(diagnosis: Diagnosis) -> tuple[str, str]:
    """What to check first: a slip in the sheet that would look so; else the next step. And the rest beside it."""
    step, more = _next_step(diagnosis)
    slips = {slip: name for entry in diagnosis.rounds for slip, name in entry.slips.items()}
    if diagnosis.contradicted_columns or not slips:
        return step, more
    first = [f"check first whether {slip}: {spaced_name(name)} has that size" for slip, name in slips.items()]
    return "; ".join(first), " ".join(filter(None, (f"If not: {step.rstrip('.')}.", more)))


def _next_step(diagnosis: Diagnosis) -> tuple[str, str]:
    """The next step, and how the effects in question are measured or reduced."""
    verdict, last = diagnosis.verdict, diagnosis.final_verdict
    if diagnosis.contradicted_columns:
        told = " ".join(f"{str(note).rstrip('.')}." for note in diagnosis.notes[: len(diagnosis.contradicted_columns)])
        return "correct the sheet and run again", f"{told} With the sheet as it is, the verdict is {verdict}."
    if diagnosis.refused:
        return diagnosis.refused, ""
    if diagnosis.odd_trials:
        return "correct the row of that trial, or leave it out with `use: no`, and run again", ""
    if TAIL_SLACK in diagnosis.effects:
        return "write `tail_slack: free` in experiment.yaml, and run again", ""
    if UNEXPLAINED in (verdict, last):
        table, told = diagnosis.ladder, "it writes a law of the missing force as an effect file of your own"
        then = f"run `vinetrack propose {diagnosis.results}`"
        if diagnosis.not_tried:
            lacks = f"fill in what the sheet lacks for {listed_names(diagnosis.not_tried)}: not tried so far"
            return lacks, f"If that does not explain it, {then}: {told}."
        if table is not None and (near := list(table["added"][table["partial"]])):
            return f"see what `vinetrack add {near[0]} {diagnosis.results}`, a part, leaves; then {then}", told
        return f"look at the figures of the missing force, and {then}", told
    if diagnosis.next_experiment:
        return str(diagnosis.next_experiment.get("text", "")), ""
    if diagnosis.answer_set == (DROPPED_FRAMES,):
        return "see what is said with corrected times; record again where it matters", ""
    if last == ARTEFACT:
        names = diagnosis.rounds[-1].answer_set
        return "correct the measurement, and run again", _remedies(names)
    if verdict == MISSING:
        saved = f"`vinetrack add {'+'.join(diagnosis.effects)} {diagnosis.results} --save`"
        return f"keep it with {saved}, and measure its size by other means", _remedies(diagnosis.effects)
    if verdict == AMBIGUOUS:
        return "measure what tells them apart", _remedies(diagnosis.answer_set)
    return ("use the model where you filmed" if verdict == ADEQUATE else ""), ""


def _remedies(names: Sequence[str]) -> str:
    """How each of these is measured, reduced or corrected."""
    known = {name: difference_text(name, remedy=True) for name in BETWEEN}
    known |= {name: effect.remedy for name, effect in catalogue().items()}
    return " ".join(f"{words.rstrip('.')}." for name in names if (words := known.get(name)))


def is_finite(value: Any) -> bool:
    """Return whether a value of a JSON file is a finite number."""
    return isinstance(value, int | float) and math.isfinite(value)


def _sigmas(row: Candidate) -> str:
    sigma = abs(row.sigma) if is_finite(row.sigma) else math.sqrt(max(row.delta_chi2, 0.0))
    return f"{sigma:.0f}" if sigma >= 9.5 else f"{sigma:.1f}"


def value_text(entry: Number) -> str:
    """Return a fitted number with its standard error in its display unit, without symbol and unit: `1.170 ± 0.004`."""
    _, factor = entry.shown
    return with_error(factor * entry.value, factor * entry.sigma if is_finite(entry.sigma) else None)


def estimate_text(entry: Number) -> str:
    """Return a fitted number with its symbol and standard error: `γ = 1.170 ± 0.004`."""
    return f"{entry.title} = {quantity_text(entry)}"


def split_estimate(entry: Number) -> str:
    """Return a fitted number with its standard error, that of trials apart from that of what all trials share."""
    if is_finite(entry.bound) or not (entry.shared_sigma > 0 and is_finite(entry.sigma)):
        return estimate_text(entry)
    unit, factor = entry.shown
    digits = decimals(factor * entry.sigma)
    own, shared = math.sqrt(max(entry.sigma**2 - entry.shared_sigma**2, 0.0)), entry.shared_sigma
    value, own_text, shared_text = (f"{factor * each:.{digits}f}" for each in (entry.value, own, shared))
    return f"{entry.title} = {value} ± {own_text} (trials) ± {shared_text} (shared) {unit}".rstrip()


def quantity_text(entry: Number) -> str:
    """Return a fitted number with its standard error in its display unit: `1.170 ± 0.004`."""
    unit, factor = entry.shown
    if is_finite(entry.bound):
        return f"{number(factor * entry.bound)} {unit}".rstrip() + " (at its bound)"
    text = f"{value_text(entry)} {unit}".strip()
    text += f" ({number(1e-3 * entry.value)} kPa)" if entry.unit == "Pa" and unit != "kPa" else ""
    if entry.value < entry.lower or entry.value > entry.upper:
        text += " (negative, which is impossible)" if entry.value < 0 <= entry.lower else " (outside its bounds)"
    return text


def estimates_text(row: Candidate) -> str:
    """Return all fitted numbers of a candidate."""
    text = ", ".join(estimate_text(entry) for entry in row.numbers if is_finite(entry.value))
    # 2.0: standard errors below which a size is reported as not significant
    return f"{text}: not significant" if text and is_finite(row.sigma) and abs(row.sigma) < 2.0 else text


def _confounded_interval(diagnosis: Diagnosis, size: Number) -> str:
    """The wider interval of a size that allows for effects the data do not exclude (hull); blank without any."""
    names = []
    for rival in _rivals(diagnosis, size):
        unit, times = display_unit(rival.unit, size.pressure_unit)
        limit = f"{number(rival.limit * times, 2)} {unit}".rstrip()
        names.append(f"{spaced_name(rival.effect)} ({rival.symbol} as far as {limit})")
    return f"; allowing for {joined(names)}: {_hull(diagnosis, size)}" if names else ""


def _rivals(diagnosis: Diagnosis, size: Number) -> list[Confounder]:
    confounded = diagnosis.rounds[-1].confounded
    return [rival for rival in confounded if (rival.parameter, rival.vine) == (size.key, size.vine)]


def _hull(diagnosis: Diagnosis, size: Number) -> str:
    """Ends of the wider interval of a number in its display unit; blank without any effect that it may include."""
    alike, factor = _rivals(diagnosis, size), size.shown[1]
    low, high = min((one.low_95 for one in alike), default=0.0), max((one.high_95 for one in alike), default=0.0)
    return f"{number(factor * low, 4)} to {number(factor * high, 4)}" if alike else ""


def bounds_text(entry: Number, with_unit: bool = False) -> str:
    """Return the ends of the 95 % interval of a fitted number in its display unit, a bound that it ends at named."""
    unit, factor = entry.shown
    if not (is_finite(entry.low) and is_finite(entry.high)):
        return "open"
    text = f"{number(factor * entry.low, 4)} to {number(factor * entry.high, 4)} {unit if with_unit else ''}".strip()
    ends = entry.ends_at
    return f"{text} (its {ends} bound{'s' if ' ' in ends else ''})" if ends else text


MOST_NAMED = 3  # Parameters or effects named in a sentence, at most (chosen)


def sizes_in_words(numbers: Sequence[Number]) -> str:
    """Return the fitted sizes of a hypothesis with their standard errors; blank where it has none."""
    return ", ".join(map(estimate_text, numbers))


def explain(step: SelectionStep) -> str:
    """Return the explanation of one round: its verdict with the reasons."""
    fit, answers, verdict = step.tests.fit, step.answer_set, step.verdict
    count = len(fit.trials)
    model, trials = " + ".join(fit.model.names), f"{count} trial{'s' if count != 1 else ''}"
    if verdict in (ADEQUATE, UNEXPLAINED):
        return (_adequate if verdict == ADEQUATE else _unexplained)(step, model, trials)
    if verdict == ARTEFACT and trials_differ(step.answer_names):
        verdict = BETWEEN_TRIALS
    best = answers[0]
    several = len(step.answer_names) == 1 < len(best.names)  # of which this round adds the first
    facts: dict[str, Any] = {"name": best.names[0 if several else -1], "model": model, "trials": trials}
    facts |= {"sizes": sizes_in_words(best.numbers) or "it", "gain": best.delta_chi2, "sigma": abs(best.sigma)}
    reach = ANSWER_SET_DELTA_CHI2 * best.inflation
    facts |= {"hypotheses": "; ".join(map(hypothesis_in_words, answers)), "reach": reach}
    codes = {MISSING: "is_missing", AMBIGUOUS: "is_ambiguous", BETWEEN_TRIALS: "trials_differ", ARTEFACT: "is_a_fault"}
    text = sentence(codes[verdict], facts)
    if several:
        text += f" {sentence('several_missing', {'count': len(best.names), 'names': best.names})}"
    text += remedies_in_words(step)
    if step.verdict == ARTEFACT:
        text += _with_the_fault(step)
    if verdict == ARTEFACT and (others := best.names[1:]):
        text += f" {sentence('beside_a_fault', {'fault': best.names[0], 'others': others})}"
    return text


def _unexplained(step: SelectionStep, model: str, trials: str) -> str:
    if step.is_open:
        return sentence("model_is_open", {"model": model, "trials": trials})
    text = sentence("nothing_explains", {"model": model, "trials": trials})
    for name, why in step.rejected:
        text += f" The nearest is {name.replace('+', ' with ')}: {why}."
    if not step.partial:
        return text
    last = step.partial[-1]
    added = joined([each.names[-1] for each in step.partial], "then")
    facts: dict[str, Any] = {"added": added, "sizes": sizes_in_words(last.numbers)}
    facts |= {"before": step.tests.fit.chi2_per_dof, "after": last.fit.chi2_per_dof}
    return f"{text} {sentence('a_part_is_explained', facts)}"


def _with_the_fault(step: SelectionStep) -> str:
    """N and B with the likeliest fault in the model, and without it."""
    best, before = step.answer_set[0], {number.name: number for number in step.tests.fit.numbers}
    law = [each for each in best.others if each.key in (EXPONENT, DAMPING) and each.name in before]
    law = sorted(law, key=lambda each: each.key != EXPONENT)[:MOST_NAMED]
    changes = ", ".join(f"{estimate_text(each)} instead of {value_text(before[each.name])}" for each in law)
    return f" Fitted together with {best.names[-1]}, {changes}." if changes else ""


def _adequate(step: SelectionStep, model: str, trials: str) -> str:
    text = f"{model} explains {trials}: no missing effect can be detected."
    if not step.unstated_differences:
        return text
    unstated = max(step.unstated_differences, key=lambda result: result.delta_chi2)
    facts = {"difference": hypothesis_in_words(unstated), "gain": unstated.delta_chi2}
    return f"{text} {sentence('trials_seem_to_differ', facts)}{remedies_in_words(step, [unstated])}"
