"""Summary of a diagnosis: what is missing, how significant that is, and how much adding it reduces the error.

Report, figures, notebooks and explorer use these sentences; `diagnosis_text` prints a whole diagnosis.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from vinetrack.core.numbers import number, with_error
from vinetrack.core.units import display_unit
from vinetrack.diagnosis.confounder import Confounder, left_open
from vinetrack.diagnosis.result import ADEQUATE, AMBIGUOUS, ARTEFACT, MISSING, NOT_TESTABLE, UNEXPLAINED
from vinetrack.narrative.between_text import difference_headline, trials_differ

if TYPE_CHECKING:
    import pandas as pd

    from vinetrack.diagnosis.result import Candidate, Diagnosis
    from vinetrack.inference.fit_result import Number

# What each verdict means
MEANINGS = {
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

TRIALS_DIFFER = (
    "A difference between trials, not missing physics, explains the misfit: nothing was added. The explanation below "
    "says what to do."
)

ODD_MEANING = (
    "The row of a trial in the sheet contradicts its motion. The verdict in full covers the other trials. Correct its "
    "row, or leave it out with `use: no`, and run again."
)

# The verdict on the model with all added effects
THEREAFTER = {
    MISSING: "A further effect is still missing.",
    AMBIGUOUS: "A further effect is missing, and these trials cannot tell which.",
    ARTEFACT: "The remaining misfit is explained by a fault of the measurement.",
    ADEQUATE: "With it, no further effect can be detected.",
    UNEXPLAINED: "With it, the model still fails, and no effect of the catalogue explains the remaining misfit.",
}

MOST_UNDETECTABLE_LISTED = 6  # Undetectable effects listed on the first screen, at most (chosen)

SIGNIFICANT_SIGMA = 2.0  # Standard errors below which a size is reported as not significant


@dataclass(frozen=True)
class Fact:
    """One entry of the first screen: the quantity, its value, and a line below it."""

    question: str
    answer: str
    note: str = ""


def spaced_name(effect: str) -> str:
    """Return the name of an effect with blanks for underscores."""
    return str(effect).replace("_", " ")


def listed_names(names: Sequence[str], last: str = "and") -> str:
    """Return names of effects as a sentence lists them, with blanks for underscores: `air drag, leak or gravity`."""
    return joined([spaced_name(name) for name in names], last)


def joined(names: Sequence[str], last: str = "and") -> str:
    """Return names as a sentence lists them; blank for none."""
    return f"{', '.join(names[:-1])} {last} {names[-1]}" if len(names) > 1 else "".join(names)


def verdict_sentence(diagnosis: Diagnosis) -> str:
    """Return the verdict in one sentence."""
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
    if diagnosis.odd_trials:
        return ODD_MEANING
    text = MEANINGS.get(diagnosis.verdict, diagnosis.refused)
    if diagnosis.verdict == ARTEFACT and trials_differ(list(diagnosis.answer_set)):
        text = TRIALS_DIFFER
    added = diagnosis.effects
    final = THEREAFTER.get(diagnosis.final_verdict, "") if added else ""
    return f"{text} {final.replace('With it,', 'With them,') if len(added) > 1 else final}".strip()


def summary_facts(diagnosis: Diagnosis, ladder: pd.DataFrame | None) -> list[Fact]:
    """Return significance, sizes, power, change of the error and damping exponent, as far as the verdict has them."""
    entries = [
        _significance(diagnosis),
        *_sizes(diagnosis),
        _upper_limits(diagnosis),
        *_power_facts(diagnosis),
        *_errors(ladder),
        *_exponent(diagnosis),
    ]
    return [fact for fact in entries if fact is not None]


def is_finite(value: Any) -> bool:
    """Return whether a value of a JSON file is a finite number."""
    return isinstance(value, int | float) and math.isfinite(value)


def _significance(diagnosis: Diagnosis) -> Fact | None:
    ranking, verdict = diagnosis.ranking, diagnosis.verdict
    tested = [row for row in ranking if is_finite(row.delta_chi2)]
    others = [row for row in tested if not row.in_answer_set]
    best = max(tested, key=_gain, default=None)
    if verdict == ADEQUATE:
        # Ranked by the score: a predicted Δχ² may belong to a size of the wrong sign.
        scored = [row for row in ranking if is_finite(row.sigma)]
        best = max(scored, key=lambda row: abs(row.sigma), default=None)
        note = f"largest of {len(scored)} candidates: {spaced_name(best.effect)}" if best else ""
        return Fact("Most significant candidate", f"{_sigmas(best)} σ", note) if best else None
    if diagnosis.odd_trials:
        return None
    if verdict == UNEXPLAINED and best is not None:
        note = f"{_sigmas(best)} σ better" + (f", but {best.reason}" if best.reason else "")
        return Fact("Nearest candidate", spaced_name(best.effect), note)
    inside = [row for row in tested if row.in_answer_set]
    best = max(inside, key=_gain, default=None)
    if best is None:
        return None
    n_tested = sum(row.status != NOT_TESTABLE for row in ranking)
    note = f"of {n_tested} candidates tested" if n_tested > 1 else "the only candidate"
    note = f"{len(inside)} of {n_tested} candidates fit equally well" if len(inside) > 1 else note
    # A candidate that contains the answer as a limiting case fits as well by construction, and is no rival.
    rival = max([row for row in others if not row.plausible or not row.reason], key=_gain, default=None)
    if rival is not None:
        behind = best.delta_chi2 - rival.delta_chi2
        # An implausible candidate, or one whose Δχ² is only predicted, may have the larger Δχ².
        note = f"next best: {spaced_name(rival.effect)}" + (f", worse by Δχ² = {number(behind)}" if behind > 0 else "")
        note += "" if rival.plausible else ", not plausible"
    return Fact("Significance", f"{_sigmas(best)} σ", note)


def _gain(row: Candidate) -> float:
    return row.delta_chi2


def _sigmas(row: Candidate) -> str:
    sigma = abs(row.sigma) if is_finite(row.sigma) else math.sqrt(max(row.delta_chi2, 0.0))
    return f"{sigma:.0f}" if sigma >= 9.5 else f"{sigma:.1f}"


def value_text(entry: Number) -> str:
    """Return a fitted number with its standard error in its display unit, without symbol and unit: `1.170 ± 0.004`."""
    _, factor = display_unit(entry.unit)
    return with_error(factor * entry.value, factor * entry.sigma if is_finite(entry.sigma) else None)


def estimate_text(entry: Number) -> str:
    """Return a fitted number with its standard error in its display unit: `γ = 1.170 ± 0.004`."""
    unit, factor = display_unit(entry.unit)
    if is_finite(entry.bound):
        return f"{entry.title} = {number(factor * entry.bound)} {unit}".rstrip() + " (at its bound)"
    text = f"{entry.title} = {value_text(entry)} {unit}".strip()
    if entry.value < entry.lower or entry.value > entry.upper:
        text += " (negative, which is impossible)" if entry.value < 0 <= entry.lower else " (outside its bounds)"
    return text


def estimates_text(row: Candidate) -> str:
    """Return all fitted numbers of a candidate."""
    text = ", ".join(estimate_text(entry) for entry in row.numbers if is_finite(entry.value))
    return f"{text}: not significant" if text and is_finite(row.sigma) and abs(row.sigma) < SIGNIFICANT_SIGMA else text


def _sizes(diagnosis: Diagnosis) -> list[Fact]:
    """The size of each added effect in the final model; without one, the sizes of the members of the answer set."""
    if diagnosis.effects:
        of = {name: [n for n in diagnosis.parameters if n.key.split(".")[0] == name] for name in diagnosis.effects}
        return [
            Fact(
                f"Size of {spaced_name(name)}",
                estimate_text(n[0]),
                interval_text(n[0]) + _confounded_interval(diagnosis, n[0].key),
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
    """Return the 95 % interval of a fitted number in its display unit, a bound that it ends at named."""
    unit, factor = display_unit(entry.unit)
    if not (is_finite(entry.low) and is_finite(entry.high)):
        return "95 %: open"
    text = f"95 %: {number(factor * entry.low, 4)} to {number(factor * entry.high, 4)} {unit}".strip()
    ends = entry.ends_at
    return f"{text} (its {ends} bound{'s' if ' ' in ends else ''})" if ends else text


def _upper_limits(diagnosis: Diagnosis) -> Fact | None:
    bounded = [row for row in diagnosis.ranking if row.largest]
    if diagnosis.verdict != ADEQUATE or not bounded:
        return None
    return Fact("Upper limits", f"{len(bounded)} candidates", "the largest undetected size of each is listed below")


def _power_facts(diagnosis: Diagnosis) -> list[Fact]:
    """The false-alarm rate of such trials, and the effects that they could have detected."""
    if diagnosis.power is None:
        return []
    from vinetrack.narrative.power_text import AT_LARGEST, detectable_count, percent, unseen

    power = diagnosis.power
    alarm = Fact(
        "False alarms", f"at most {percent(power.false_alarm_rate)}", "of such campaigns if nothing is missing"
    )
    if power.wary or not power.effects:
        return [alarm, Fact("Detectable effects", "not computed", power.wary)]
    undetectable = unseen(power)
    listing = (
        f"; not even then: {listed_names(undetectable)}" if 0 < len(undetectable) <= MOST_UNDETECTABLE_LISTED else ""
    )
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


def _exponent(diagnosis: Diagnosis) -> list[Fact]:
    """The damping exponent of the final model."""
    for entry in diagnosis.parameters:
        if entry.key == "eversion_damping.n" and is_finite(entry.value):
            return [Fact("Damping exponent", estimate_text(entry), interval_text(entry))]
    return []


def settled_rows(table: pd.DataFrame) -> pd.DataFrame:
    """Return the ladder without its partial steps, which reduce an unexplained misfit without removing it."""
    if "partial" not in table:
        return table
    return table[[value not in (True, "True") for value in table["partial"]]]
