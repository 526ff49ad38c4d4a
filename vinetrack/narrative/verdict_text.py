"""Explanation of each round of a diagnosis in sentences; `diagnosis_text` has the headline and the tables."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import TYPE_CHECKING, Any

from vinetrack.core.problems import joined
from vinetrack.core.units import decimals, display_unit, number, with_error
from vinetrack.diagnosis.misfit_tests import FALSE_ALARM_LEVEL_FIRST_ROUND
from vinetrack.diagnosis.result import (
    ADEQUATE,
    AMBIGUOUS,
    ARTEFACT,
    BETWEEN,
    BETWEEN_TRIALS,
    MISSING,
    N_BY_VINE,
    NOT_TESTABLE,
    ORDER_DRIFT,
    SPECIMEN,
    UNEXPLAINED,
    Confounder,
    left_open,
)
from vinetrack.diagnosis.score_test import slip_of
from vinetrack.dynamics.model import base_model
from vinetrack.experiment.folder import CONFOUNDING_CORRELATION, order_pressure_correlation, trial_order
from vinetrack.inference.fit_result import DAMPING, EXPONENT, Number
from vinetrack.inference.fit_summary import FILM
from vinetrack.inference.robust_covariance import FILM_ERROR

if TYPE_CHECKING:
    import pandas as pd

    from vinetrack.core.problems import Remark
    from vinetrack.diagnosis.likelihood_ratio import LikelihoodRatio
    from vinetrack.diagnosis.replicates import OddTrial
    from vinetrack.diagnosis.result import Candidate, Diagnosis
    from vinetrack.diagnosis.selection import SelectionStep


# ------------------------------------------------------------------------------
# Differences between trials in words: which trials differ, by how much, and how to confirm it.


def trials_differ(names: Sequence[str]) -> bool:
    """Whether every name of an answer set is a difference between trials."""
    return bool(names) and all(name in BETWEEN for name in names)


def difference_headline(names: Sequence[str]) -> str:
    """The differences between trials of an answer set, each in a clause."""
    return " or ".join(BETWEEN[name].summary for name in names)


def difference_in_words(result: LikelihoodRatio) -> str:
    """The size of one difference between trials: `pressure rises by 0.42 ± 0.03 % with each trial`."""
    name = result.names[-1]
    if name == N_BY_VINE:
        return "n differs between the vines: " + ", ".join(
            f"{_value(number.value, number.sigma)} ({number.vine})" for number in result.numbers
        )
    if name == ORDER_DRIFT:
        slope = result.numbers[0]
        if slope.key.endswith(".step"):
            way = "higher" if slope.value > 0 else "lower"
            return f"pressure is {way} by {_value(100 * abs(slope.value), 100 * slope.sigma)} % {slope.vine}"
        way = "rises" if slope.value > 0 else "falls"
        what, each = ("B", "each trial of a tube") if slope.key.endswith(".B") else ("pressure", "each trial")
        return f"{what} {way} by {_value(100 * abs(slope.value), 100 * slope.sigma)} % with {each}"
    parts = []
    in_B = [number for number in result.numbers if number.key.endswith(".B")]
    in_P = [number for number in result.numbers if number.key.endswith(".P")]
    if in_B:
        parts.append(f"in B by {_range(in_B, 100, '%')}")
    if in_P:
        parts.append(f"in pressure (zero of the gauge, or P_y) by {_range(in_P, 1e-3, 'kPa')}")
    if gains := [number for number in result.numbers if number.key.endswith(".gain")]:
        parts.append(f"in pressure (setting of a regulator) by {_range(gains, 100, '%')}")
    return f"{name}s differ {' and '.join(parts)}"


def remedies_in_words(step: SelectionStep, answers: Sequence[LikelihoodRatio] = ()) -> str:
    """What to do about the differences between trials in an answer set; blank where there are none."""
    trials = [trial.trial for trial in step.tests.fit.trials]
    names = [result.names[-1] for result in answers or step.answer_set if result.effects[-1].kind == BETWEEN_TRIALS]
    if not names:
        return ""
    text = "".join(f" {BETWEEN[name].remedy}." for name in names)
    if ORDER_DRIFT not in names and SPECIMEN not in names:
        return text
    _, stated = trial_order(trials)
    if not stated:
        text = f" The trials were assumed to be in the order of the rows.{text}"
    correlation = order_pressure_correlation(trials)
    if math.isfinite(correlation) and abs(correlation) >= CONFOUNDING_CORRELATION:
        text = f" Trials were made in the order of pressure (rank correlation {correlation:.2f}).{text}"
    return text


def _value(value: float, sigma: float) -> str:
    digits = decimals(sigma)
    return f"{value:.{digits}f} ± {sigma:.{digits}f}"


def _range(numbers: Sequence[Number], factor: float, unit: str) -> str:
    """One coefficient with its standard error; several as a range."""
    if len(numbers) == 1:
        return f"{_value(factor * numbers[0].value, factor * numbers[0].sigma)} {unit} ({numbers[0].vine})"
    values = [factor * number.value for number in numbers]
    return f"{min(values):+.2g} to {max(values):+.2g} {unit}"


# ------------------------------------------------------------------------------
# Summary of a diagnosis: what is missing, how significant that is, and how much adding it reduces the error.
#
# Report, figures, notebooks and explorer use these sentences; `diagnosis_text` prints a whole diagnosis.

ODD_MEANING = (
    "The row of a trial in the sheet contradicts its motion. The verdict in full covers the other trials. Correct its "
    "row, or leave it out with `use: no`, and run again."
)


@dataclass(frozen=True)
class Fact:
    """One entry of the first screen: the quantity, its value, and a line below it."""

    question: str
    answer: str
    note: str = ""
    code: str = ""


def spaced_name(effect: str) -> str:
    """Return the name of an effect with blanks for underscores."""
    return str(effect).replace("_", " ")


def listed_names(names: Sequence[str], last: str = "and") -> str:
    """Return names of effects as a sentence lists them, with blanks for underscores: `air drag, leak or gravity`."""
    return joined([spaced_name(name) for name in names], last)


def verdict_sentence(diagnosis: Diagnosis) -> str:
    """Return the verdict in one sentence; what contradicts the sheet in its place, since any verdict rests on it."""
    if diagnosis.contradicted_columns:
        return f"{joined(diagnosis.contradicted_columns)} in the sheet cannot fit the measurements: correct it first."
    verdict, answers = diagnosis.verdict, list(diagnosis.answer_set)
    added = list(diagnosis.effects)
    if verdict == MISSING:
        return f"Missing from the model: {listed_names(added or answers, 'and')}."
    if verdict == AMBIGUOUS:
        return f"Missing from the model: {listed_names(answers, 'or')}. These trials cannot tell which."
    if verdict == ARTEFACT and trials_differ(answers):
        return f"The trials differ, and no physics is missing: {difference_headline(answers)}."
    if verdict == ARTEFACT:
        return f"A fault of the measurement, not missing physics: {listed_names(answers, 'or')}."
    if verdict == ADEQUATE:
        return "No missing effect can be detected."
    if diagnosis.odd_trials:
        verb = "is" if len(diagnosis.odd_trials) == 1 else "are"
        return f"{joined(diagnosis.odd_trials)} {verb} inconsistent with the others, which the model explains."
    if verdict == UNEXPLAINED:
        return "The model fails, and no effect of the catalogue explains it."
    return "No diagnosis could be made."


def verdict_meaning(diagnosis: Diagnosis) -> str:
    """Return what the verdict means, and the verdict on the model with all added effects."""
    if diagnosis.contradicted_columns:
        told = " ".join(f"{str(note).rstrip('.')}." for note in diagnosis.notes[: len(diagnosis.contradicted_columns)])
        return f"{told} With the sheet as it is, the verdict is {diagnosis.verdict}; correct the sheet and run again."
    if diagnosis.odd_trials:
        return ODD_MEANING
    meanings = {
        MISSING: "An effect is missing from the model. It was identified, added, and the model fitted again.",
        AMBIGUOUS: "An effect is missing, and these trials cannot tell which of several: nothing was added. "
        "The next experiment below says how to separate them.",
        ARTEFACT: "A fault of the measurement, not missing physics, explains the misfit: nothing was added. "
        "Correct the measurement first.",
        ADEQUATE: "Every candidate was tested, and none improves the fit significantly. "
        "Upper limits on the size of each are listed below.",
        UNEXPLAINED: "The misfit exceeds the replicate scatter, and no effect of the catalogue explains it. "
        "The missing force is drawn below; `vinetrack propose` looks for a law that describes it.",
    }
    text = meanings.get(diagnosis.verdict, diagnosis.refused)
    if diagnosis.verdict == ARTEFACT and trials_differ(list(diagnosis.answer_set)):
        text = (
            "A difference between trials, not missing physics, explains the misfit: nothing was added. The explanation "
            "below says what to do."
        )
    thereafter = {
        MISSING: "A further effect is still missing.",
        AMBIGUOUS: "A further effect is missing, and these trials cannot tell which.",
        ARTEFACT: "The remaining misfit is explained by a fault of the measurement.",
        ADEQUATE: "With it, no further effect can be detected.",
        UNEXPLAINED: "With it, the model still fails, and no effect of the catalogue explains the remaining misfit.",
    }
    added = diagnosis.effects
    final = thereafter.get(diagnosis.final_verdict, "") if added else ""
    return f"{text} {final.replace('With it,', 'With them,') if len(added) > 1 else final}".strip()


def summary_facts(diagnosis: Diagnosis, ladder: pd.DataFrame | None) -> list[Fact]:
    """Return significance, sizes, power, change of the error and damping exponent, as far as the verdict has them."""
    bounded = [row for row in diagnosis.ranking if row.largest] if diagnosis.verdict == ADEQUATE else []
    n, B = ([p for p in diagnosis.parameters if p.key == key and is_finite(p.value)] for key in (EXPONENT, DAMPING))
    vines = [estimate_text(p) for p in B[:3]]  # as many as a tile has room for
    return [
        *filter(None, [_significance(diagnosis)]),
        *_sizes(diagnosis),
        *([Fact("Upper limits", f"{len(bounded)} candidates", "of undetected sizes, listed below")] if bounded else []),
        *_power_facts(diagnosis),
        *_errors(ladder),
        *(Fact("Damping law", estimate_text(p), "; ".join([interval_text(p), *vines])) for p in n[:1]),
    ]


def is_finite(value: Any) -> bool:
    """Return whether a value of a JSON file is a finite number."""
    return isinstance(value, int | float) and math.isfinite(value)


def _significance(diagnosis: Diagnosis) -> Fact | None:
    ranking, verdict = diagnosis.ranking, diagnosis.verdict
    tested = [row for row in ranking if is_finite(row.delta_chi2)]
    others = [row for row in tested if not row.in_answer_set]
    by_gain = attrgetter("delta_chi2")
    best = max(tested, key=by_gain, default=None)
    if verdict == ADEQUATE:
        # Ranked by the score: a predicted Δχ² may belong to a size of the wrong sign.
        scored = [row for row in ranking if is_finite(row.sigma)]
        best = max(scored, key=lambda row: abs(row.sigma), default=None)
        note = f"largest of {len(scored)} candidates: {spaced_name(best.effect)}" if best else ""
        return Fact("Most significant candidate", f"{_sigmas(best)} σ", note, "most_significant") if best else None
    if diagnosis.odd_trials:
        return None
    if verdict == UNEXPLAINED and best is not None:
        note = f"{_sigmas(best)} σ better" + (f", but {best.reason}" if best.reason else "")
        return Fact("Nearest candidate", spaced_name(best.effect), note)
    inside = [row for row in tested if row.in_answer_set]
    best = max(inside, key=by_gain, default=None)
    if best is None:
        return None
    n_tested = sum(row.status != NOT_TESTABLE for row in ranking)
    note = f"of {n_tested} candidates tested" if n_tested > 1 else "the only candidate"
    note = f"{len(inside)} of {n_tested} candidates fit equally well" if len(inside) > 1 else note
    # A candidate that contains the answer as a limiting case fits as well by construction, and is no rival.
    rival = max([row for row in others if not row.plausible or not row.reason], key=by_gain, default=None)
    if rival is not None:
        behind = best.delta_chi2 - rival.delta_chi2
        # An implausible candidate, or one whose Δχ² is only predicted, may have the larger Δχ².
        note = f"next best: {spaced_name(rival.effect)}" + (f", worse by Δχ² = {number(behind)}" if behind > 0 else "")
        note += "" if rival.plausible else ", not plausible"
    return Fact("Significance", f"{_sigmas(best)} σ", note, "significance")


def _sigmas(row: Candidate) -> str:
    sigma = abs(row.sigma) if is_finite(row.sigma) else math.sqrt(max(row.delta_chi2, 0.0))
    return f"{sigma:.0f}" if sigma >= 9.5 else f"{sigma:.1f}"


def value_text(entry: Number) -> str:
    """Return a fitted number with its standard error in its display unit, without symbol and unit: `1.170 ± 0.004`."""
    _, factor = display_unit(entry.unit)
    return with_error(factor * entry.value, factor * entry.sigma if is_finite(entry.sigma) else None)


def estimate_text(entry: Number) -> str:
    """Return a fitted number with its symbol and standard error: `γ = 1.170 ± 0.004`."""
    return f"{entry.title} = {quantity_text(entry)}"


def quantity_text(entry: Number) -> str:
    """Return a fitted number with its standard error in its display unit: `1.170 ± 0.004`."""
    unit, factor = display_unit(entry.unit)
    if is_finite(entry.bound):
        return f"{number(factor * entry.bound)} {unit}".rstrip() + " (at its bound)"
    text = f"{value_text(entry)} {unit}".strip()
    if entry.value < entry.lower or entry.value > entry.upper:
        text += " (negative, which is impossible)" if entry.value < 0 <= entry.lower else " (outside its bounds)"
    return text


def estimates_text(row: Candidate) -> str:
    """Return all fitted numbers of a candidate."""
    text = ", ".join(estimate_text(entry) for entry in row.numbers if is_finite(entry.value))
    # 2.0: standard errors below which a size is reported as not significant
    return f"{text}: not significant" if text and is_finite(row.sigma) and abs(row.sigma) < 2.0 else text


def _sizes(diagnosis: Diagnosis) -> list[Fact]:
    """The size of each added effect in the final model; without one, the sizes of the members of the answer set."""
    if diagnosis.effects:
        of = {name: [n for n in diagnosis.parameters if n.key.split(".")[0] == name] for name in diagnosis.effects}
        return [
            Fact(
                f"Size of {spaced_name(name)}",
                estimate_text(n[0]),
                interval_text(n[0]) + _confounded_interval(diagnosis, n[0].key),
                "size",
            )
            for name, n in of.items()
            if n
        ]
    members = [row for row in diagnosis.ranking if row.in_answer_set and row.numbers]
    return [Fact(f"If {spaced_name(row.effect)}", estimates_text(row)) for row in members[:3]]


def _confounded_interval(diagnosis: Diagnosis, key: str) -> str:
    """The wider interval of a size that allows for effects the data do not exclude; blank without any."""
    alike: list[Confounder] = []
    for entry in diagnosis.rounds:
        rivals = [rival for row in entry.ranking if row.in_answer_set for rival in row.confounded_by]
        alike = [rival for rival in rivals if rival.number.key == key] or alike
    if not alike:
        return ""
    factor = display_unit(alike[0].number.unit)[1]
    low, high = left_open(alike)
    names = joined([spaced_name(rival.effect) for rival in alike])
    return f"; allowing for {names}: {number(factor * low, 4)} to {number(factor * high, 4)}"


def interval_text(entry: Number) -> str:
    """Return the 95 % interval of a fitted number, said to be one, in its display unit."""
    return f"95 %: {bounds_text(entry, display_unit(entry.unit)[0])}"


def bounds_text(entry: Number, unit: str = "") -> str:
    """Return the ends of the 95 % interval of a fitted number in its display unit, a bound that it ends at named."""
    factor = display_unit(entry.unit)[1]
    if not (is_finite(entry.low) and is_finite(entry.high)):
        return "open"
    text = f"{number(factor * entry.low, 4)} to {number(factor * entry.high, 4)} {unit}".strip()
    ends = entry.ends_at
    return f"{text} (its {ends} bound{'s' if ' ' in ends else ''})" if ends else text


def _power_facts(diagnosis: Diagnosis) -> list[Fact]:
    """The false-alarm rate of such trials, and the effects that they could have detected."""
    if diagnosis.power is None:
        return []
    from vinetrack.narrative.diagnosis_text import AT_LARGEST, detectable_count, percent, unseen

    power = diagnosis.power
    alarm = Fact(
        "False alarms", f"at most {percent(power.false_alarm_rate)}", "of such campaigns if nothing is missing"
    )
    if power.wary or not power.effects:
        return [alarm, Fact("Detectable effects", "not computed", str(power.wary))]
    undetectable = unseen(power)
    # 6: undetectable effects listed on the first screen, at most (chosen)
    listing = f"; not even then: {listed_names(undetectable)}" if 0 < len(undetectable) <= 6 else ""
    return [alarm, Fact("Detectable effects", detectable_count(power), f"{AT_LARGEST}{listing}")]


def _errors(ladder: pd.DataFrame | None) -> list[Fact]:
    ladder = None if ladder is None else settled_rows(ladder)
    if ladder is None or not len(ladder):
        return []
    first, last = ladder.iloc[0], ladder.iloc[-1]
    key, what = "rms_left_out_m", "Error on conditions left out"
    if not math.isfinite(float(first[key])):
        key, what = "rms_in_sample_m", "Error of position"
    before, floor = 1e3 * float(first[key]), 1e3 * float(last["floor_m"])
    answer = f"{number(before)} mm"
    if len(ladder) > 1:
        answer = f"{number(before)} → {number(1e3 * float(last[key]))} mm"
    return [Fact(what, answer, f"replicate scatter {number(floor)} mm" if math.isfinite(floor) else "")]


def settled_rows(table: pd.DataFrame) -> pd.DataFrame:
    """Return the ladder without its partial steps, which reduce an unexplained misfit without removing it."""
    return table[~table["partial"].astype(bool)] if "partial" in table else table


MOST_NAMED = 3  # Parameters or effects named in a sentence, at most (chosen)


def sizes_in_words(numbers: Sequence[Number]) -> str:
    """Return the fitted sizes of a hypothesis with their standard errors; blank where it has none."""
    return ", ".join(map(estimate_text, numbers))


def explain(step: SelectionStep) -> str:
    """Return the explanation of one round: its verdict with the reasons."""
    fit = step.tests.fit
    count = len(fit.trials)
    model, trials = " + ".join(fit.model.names), f"{count} trial{'s' if count != 1 else ''}"
    if step.verdict == ARTEFACT and trials_differ(step.answer_names):
        return _difference_between_trials(step, model, trials)
    explanation = {
        ADEQUATE: _adequate,
        MISSING: _missing,
        AMBIGUOUS: _ambiguous,
        ARTEFACT: _measurement_fault,
        UNEXPLAINED: _unexplained,
    }
    return explanation[step.verdict](step, model, trials)


def _missing(step: SelectionStep, model: str, trials: str) -> str:
    best = step.answer_set[0]
    text = (
        f"{best.names[0] if step.note else best.names[-1]} is missing from {model}: with "
        f"{sizes_in_words(best.numbers) or 'it'} the fit to {trials} improves by Δχ² = {best.delta_chi2:.0f} "
        f"({abs(best.sigma):.1f} σ)."
    )
    if step.note:
        return f"{text} {_capital(step.note)} ({' and '.join(best.names)} together do)."
    if best.names[-1] == "tail_slack":
        return (
            f"{text} The model predicts compression in the tail, which thin film cannot carry: `tail_slack: free` in "
            "experiment.yaml lets the tail go slack."
        )
    return (
        f"{text} With it in the model, no other candidate and no smooth force improves the fit."
        f"{_chamber(step.answer_set)}{confounders_in_words(step.confounded)}{_runner_up(step)}"
    )


def _ambiguous(step: SelectionStep, model: str, trials: str) -> str:
    answers = step.answer_set
    return (
        f"{model} lacks an effect, and these data cannot tell which: {joined(list(step.answer_names), 'or')}. "
        f"{_hypotheses(answers)}. Their fits to {trials} lie within Δχ² = 9 of each other{_by_film(answers)}."
        f"{_weights(answers)}{_chamber(answers)}{_camera_of_a_vine(answers)}{remedies_in_words(step)}"
    )


def _difference_between_trials(step: SelectionStep, model: str, trials: str) -> str:
    answers = step.answer_set
    return (
        f"The trials differ from each other, and no effect is missing from {model}: {_hypotheses(answers)}. That "
        f"explains the misfit of {trials} (Δχ² = {answers[0].delta_chi2:.0f}).{remedies_in_words(step)}"
        f"{_with_the_fault(step)}"
    )


def _measurement_fault(step: SelectionStep, model: str, trials: str) -> str:
    answers, (fault, *others) = step.answer_set, step.answer_set[0].names
    # Effects fitted beside a fault may describe more of the same fault.
    beside = (
        f" {joined(others)} {'explains' if len(others) == 1 else 'explain'} what {fault} leaves, which may be more of "
        "the same fault: repeat the diagnosis once it is corrected."
    )
    return (
        f"A fault of the measurement, not missing physics: {joined(list(step.answer_names), 'or')} explains the misfit "
        f"of {model} to {trials} ({_hypotheses(answers)}). It is not added to the model: find the fault and measure "
        f"again, or correct the sheet.{_slips(answers)}{_camera_of_a_vine(answers)}{remedies_in_words(step)}"
        f"{_with_the_fault(step)}{beside if others else ''}"
    )


def _unexplained(step: SelectionStep, model: str, trials: str) -> str:
    text = (
        f"The misfit of {model} exceeds the noise of {trials}, and neither any one effect of the catalogue nor any "
        "combination of the best explains it."
    )
    for name, why in step.rejected:
        text += f" The nearest is {name.replace('+', ' with ')}: {why}."
    if not step.partial:
        return text
    last = step.partial[-1]
    added = joined([f"{each.names[-1]} (Δχ² = {each.delta_chi2:.0f} in all)" for each in step.partial], "then")
    before, after = step.tests.fit.chi2_per_dof, last.fit.chi2_per_dof
    return (
        f"{text} Part of the misfit is explained by adding {added}: χ² per degree of freedom falls from {before:.1f} "
        f"to {after:.1f}, with {sizes_in_words(last.numbers)}. Because a significant misfit remains, these steps are "
        "partial: none is shown to be missing."
    )


def confounders_in_words(confounders: Sequence[Confounder]) -> str:
    """State how far each fitted size would change with another effect that the data do not exclude in the model."""
    text = ""
    for name in dict.fromkeys(confounder.number.name for confounder in confounders):
        alike = [confounder for confounder in confounders if confounder.number.name == name]
        number = alike[0].number
        unit, factor = display_unit(number.unit)
        tail, digits = f" {unit}" if unit else "", decimals(number.sigma * factor)
        smaller = [_change_in_words(rival, digits) for rival in alike if abs(rival.value) < abs(number.value)]
        larger = [_change_in_words(rival, digits) for rival in alike if abs(rival.value) >= abs(number.value)]
        parts = [f"too large by up to {joined(smaller, 'or')}"] if smaller else []
        parts += [f"too small by up to {joined(larger, 'or')}"] if larger else []
        low, high = left_open(alike)
        text += (
            f" This {number.title} may be {', or '.join(parts)}, which the data do not exclude. "
            f"Allowing for {joined([rival.effect for rival in alike])}, {number.title} lies between "
            f"{factor * low:.{digits}f} and {factor * high:.{digits}f}{tail} (95 %)."
        )
    return text


def _change_in_words(confounder: Confounder, digits: int) -> str:
    """`0.061 because of air_drag (C_D up to 4.1)`: the change, the other effect, and its largest size."""
    unit, factor = display_unit(confounder.number.unit)
    limit_unit, limit_factor = display_unit(confounder.unit)
    change = f"{abs(confounder.value - confounder.number.value) * factor:.{digits}f}{' ' + unit if unit else ''}"
    limit = f"{confounder.symbol} up to {confounder.limit * limit_factor:.2g}{' ' + limit_unit if limit_unit else ''}"
    return f"{change} because of {confounder.effect} ({limit})"


def _weights(answers: Sequence[LikelihoodRatio]) -> str:
    """Posterior weights of the hypotheses in the answer set, largest first."""
    from vinetrack.diagnosis.likelihood_ratio import weights_of

    weights = sorted(weights_of(answers).items(), key=lambda pair: -pair[1])
    each = ", ".join(f"{label.replace('+', ' with ')} {100 * weight:.0f} %" for label, weight in weights)
    return f" Posterior weights, with the plausible range of each size as its prior: {each}."


def _chamber(answers: Sequence[LikelihoodRatio]) -> str:
    """Bound the volume of the chamber where the fitted γ is not one of air; blank where it is."""
    exponents = {f"{effect.name}.{p.name}": p for hypothesis in answers for effect in hypothesis.effects
                 for p in effect.parameters if "chamber_l" in effect.needs and p.symbol == "γ"}  # fmt: skip
    for entry in (entry for hypothesis in answers for entry in hypothesis.numbers if entry.key in exponents):
        low, high = exponents[entry.key].plausible or (-math.inf, math.inf)
        if not is_finite(entry.sigma) or low - 2 * entry.sigma <= entry.value <= high + 2 * entry.sigma:
            continue
        larger = entry.value < low
        how, times, hint = ("least", low, "; count the hoses too") if larger else ("most", high, "")
        return (
            f" Air has a γ of {low:g} to {high:g}, not {entry.value:.2f}: the volume of the chamber is at {how}"
            f" {times / entry.value:.2f} times the stated chamber_l{hint}."
        )
    return ""


def _slips(answers: Sequence[LikelihoodRatio]) -> str:
    """Name the slips in the sheet that would produce the fitted sizes of an answer set; blank where none would."""
    effect_of_slip: dict[str, str] = {}
    for hypothesis in answers:
        parameters = {f"{effect.name}.{p.name}": p for effect in hypothesis.effects for p in effect.parameters}
        for entry in hypothesis.numbers:
            if entry.key in parameters and (slip := slip_of(parameters[entry.key], entry.value, entry.sigma)):
                effect_of_slip.setdefault(slip[1], entry.key.split(".")[0])
    return "".join(
        f" {name} has the size that results if {slip}: check that first." for slip, name in effect_of_slip.items()
    )


def _camera_of_a_vine(answers: Sequence[LikelihoodRatio]) -> str:
    """Name the faults of camera and gauge equivalent to film masses that differ between vines; blank where none do."""
    vines = [{one.vine for one in answer.numbers if one.key.startswith(f"{FILM}.")} for answer in answers]
    if not any(FILM in answer.names and len(of) > 1 for answer, of in zip(answers, vines, strict=True)):
        return ""
    return (
        " In a vine's recordings an error of ε/2 in frame rate, of −ε in scale or of −ε in pressure has the same effect"
        " as an error of ε in its film mass: check the camera settings and the gauge of each vine too."
    )


def _by_film(answers: Sequence[LikelihoodRatio]) -> str:
    """Name the hypotheses that are in the answer set only if the film's mass is off; blank where none is."""
    from vinetrack.diagnosis.likelihood_ratio import ANSWER_SET_DELTA_CHI2, best_of

    best = best_of(answers)
    only_by_film = [ratio for ratio in answers if ratio.deviance_excess(best) > ANSWER_SET_DELTA_CHI2 * best.inflation]
    if not only_by_film:
        return ""
    names = joined([ratio.label.replace("+", " with ") for ratio in only_by_film])
    return (
        f", {names} only if the film weighs about {100 * FILM_ERROR:.0f} % more or less than thickness and density "
        "give: weigh a piece of it"
    )


def _with_the_fault(step: SelectionStep) -> str:
    """Give the parameters that are biased without the likeliest fault in the model, fitted with it and without it.
    These are all parameters of effects added before, and those of the base model whose value with the fault lies
    outside their 95 % interval without it; n comes first.
    """
    fit, best = step.tests.fit, step.answer_set[0]
    if best.names[-1] == N_BY_VINE:
        return ""
    before = {number.name: number for number in fit.numbers}
    biased = []
    for fitted in best.others:
        without = before.get(fitted.name)
        if without is None or not math.isfinite(fitted.sigma):
            continue
        within = not math.isfinite(without.sigma) or without.low <= fitted.value <= without.high
        if fitted.key.split(".")[0] not in base_model() or not within:
            biased.append(fitted)
    biased.sort(key=lambda number: number.key != EXPONENT)
    if not biased:
        return ""
    changes = [f"{estimate_text(number)} instead of {value_text(before[number.name])}" for number in biased]
    more = len(changes) - MOST_NAMED
    others = f", and {more} more parameter{'s change' if more > 1 else ' changes'}" if more > 0 else ""
    return f" Fitted together with {best.names[-1]}, {', '.join(changes[:MOST_NAMED])}{others}."


def _hypotheses(answers: Sequence[LikelihoodRatio]) -> str:
    """The hypotheses of an answer set with their sizes, differences between trials first."""
    differences = [difference_in_words(result) for result in answers if result.effects[-1].kind == BETWEEN_TRIALS]
    effects = [result for result in answers if result.effects[-1].kind != BETWEEN_TRIALS]
    sizes = {" with ".join(result.names): sizes_in_words(result.numbers) for result in effects}
    return "; ".join([*differences, *(f"{names} has {size}" if size else names for names, size in sizes.items())])


def _adequate(step: SelectionStep, model: str, trials: str) -> str:
    tests = step.tests
    if step.note:
        return f"{model} explains {trials} within the errors of position. {_capital(step.note)}."
    text = f"{model} explains {trials}: no missing effect can be detected."
    if tests.one_sided_z.size:
        names = tests.sensitivities.effects
        thresholds = [tests.family.threshold(name) for name in names]
        best = int((tests.one_sided_z - thresholds).argmax())
        stricter = " (the level once an effect was added)" if tests.level < FALSE_ALARM_LEVEL_FIRST_ROUND else ""
        # Those that the ranking does not call not testable
        count = sum(
            effect.name not in tests.sensitivities.silent
            and (tests.upper_limits(effect)[1] or tests.best_z(effect.name)[0] >= tests.family.threshold(effect.name))
            for effect in tests.effects
        )
        text += (
            f" The most significant of {count} candidates, {names[best]}, reaches "
            f"{tests.one_sided_z[best]:.1f} σ; its threshold is {thresholds[best]:.1f} σ. Where nothing is missing, "
            f"chance takes a candidate to its threshold in one of {1 / tests.level:.0f} campaigns{stricter}."
        )
        kind = next(effect.kind for effect in tests.effects if effect.name == names[best])
        # 3.0: significance from which a fault of the measurement below its threshold is named as worth a
        # check (chosen)
        if kind == "measurement" and tests.one_sided_z[best] >= 3.0:
            text += f" It is a fault of the measurement that is soon checked: see `vinetrack effects {names[best]}`."
    if not step.unstated_differences:
        return text
    unstated = max(step.unstated_differences, key=lambda result: result.delta_chi2)
    return (
        f"{text} However, the trials seem to differ, which biases the fitted numbers: {difference_in_words(unstated)}"
        f" (Δχ² = {unstated.delta_chi2:.0f}).{remedies_in_words(step, [unstated])}"
    )


def _runner_up(step: SelectionStep) -> str:
    from vinetrack.diagnosis.likelihood_ratio import best_of

    answers, excluded = {result.names for result in step.answer_set}, dict(step.rejected)
    others = [r for r in step.fitted if len(r.names) == 1 and r.names not in answers and r.label not in excluded]
    text = ""
    if others:
        best = best_of(others)
        text = f" The next best, {best.names[0]}, is worse by Δχ² = {best.deviance_excess(step.answer_set[0]):.0f}."
    for name, why in step.rejected:
        text += f" {name} fits as well, but {why}."
    return text


def _capital(note: Remark) -> str:
    text = str(note)
    return f"{text[0].upper()}{text[1:]}"


def odd_in_words(odd: Sequence[OddTrial], count: int) -> str:
    """Return the explanation for trials whose stated pressure is inconsistent with the other trials."""
    names = joined([trial.name for trial in odd])
    single = len(odd) == 1
    pressures = [
        f"{'it' if single else trial.name} moves as at {trial.implied_pressure_Pa / 1e3:.3g} kPa, but"
        f" {trial.stated_Pa / 1e3:.3g} kPa is stated"
        for trial in odd
        if trial.implied_pressure_Pa > 0
    ]
    return (
        f"{names} {'is' if single else 'are'} inconsistent with the other {count - len(odd)} trials"
        f"{': ' if pressures else ''}{'; '.join(pressures)}. Check {'its row' if single else 'their rows'} in the "
        f"sheet and {'its recording' if single else 'their recordings'}; `use: no` leaves a trial out."
    )


def odd_deciding_in_words(
    odd: Sequence[OddTrial], count: int, others: Diagnosis, with_them: str, withdrawn: bool
) -> str:
    """Return the explanation where the verdict rests on trials that are inconsistent with the others."""
    names = joined([trial.name for trial in odd])
    text = f"{odd_in_words(odd, count)} Without {names} the verdict is `{others.verdict}`: {others.explanation}"
    rests = f" the verdict would rest on {'it' if len(odd) == 1 else 'them'} alone." if withdrawn else ""
    return f"{text} With {names}:{rests} {with_them}"
