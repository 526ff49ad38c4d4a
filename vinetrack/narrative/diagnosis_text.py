"""Output of `vinetrack diagnose` and `vinetrack add`: a whole diagnosis, and the improvement by an added effect."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from vinetrack.core.numbers import with_error
from vinetrack.core.units import display_unit
from vinetrack.diagnosis.result import (
    ADEQUATE,
    AMBIGUOUS,
    ARTEFACT,
    DROPPED_FRAMES,
    MISSING,
    NOT_TESTABLE,
    UNEXPLAINED,
    Candidate,
    Diagnosis,
    Round,
)
from vinetrack.narrative.between_text import difference_headline, trials_differ
from vinetrack.narrative.power_text import could_have_seen, false_alarm_sentence, power_brief
from vinetrack.narrative.verdict_summary import ODD_MEANING, estimates_text, joined, verdict_sentence

if TYPE_CHECKING:
    import pandas as pd

    from vinetrack.inference.fit_result import Fit

_HEADLINES = {
    ADEQUATE: "no missing effect can be detected",
    MISSING: "one effect is missing",
    AMBIGUOUS: "one of several effects is missing, and these data cannot tell which",
    ARTEFACT: "a fault of the measurement, not missing physics",
    UNEXPLAINED: "the model fails, and no effect of the catalogue explains it",
}
# What a user does next where no effect of the catalogue explains the misfit
GO_ON = (
    "Next: look at the figures of the missing force in the report, and run `vinetrack propose` on the results folder. "
    "It looks for a law that describes the missing force and writes the law as an effect file of your own."
)

CLEAR_GAIN = 9.0  # Δχ² above which an added effect is said to help (derived)

_SHOWN_CANDIDATES = 8  # Candidates of a round that the terminal shows (chosen)


def diagnosis_text(diagnosis: Diagnosis) -> str:
    """Return the printed diagnosis: verdict, rounds with their candidates, ladder of errors, next experiment."""
    if not diagnosis.rounds:
        return diagnosis.explanation
    lines = [verdict_line(diagnosis), "", diagnosis.explanation]
    if diagnosis.power is not None:
        lines += ["", false_alarm_sentence(diagnosis.power), *could_have_seen(diagnosis.power)]
    for step in diagnosis.rounds:
        if step.ranking:
            lines += ["", f"{' + '.join(step.model)}: {step.verdict}", *_ranking(step)]
    if diagnosis.ladder is not None and len(diagnosis.ladder) > 1:
        lines += ["", "position error", *_ladder_table(diagnosis.ladder)]
    if diagnosis.where:
        lines += ["", *diagnosis.where]
    if diagnosis.next_experiment:
        lines += ["", str(diagnosis.next_experiment.get("text", ""))]
    lines += [f"! {note}" for note in diagnosis.notes]
    if next_step := to_go_on(diagnosis):
        lines += ["", next_step]
    return "\n".join(lines)


def to_go_on(diagnosis: Diagnosis) -> str:
    """Return what to do next where no effect of the catalogue explains the trials; blank elsewhere."""
    if UNEXPLAINED not in (diagnosis.verdict, diagnosis.final_verdict):
        return ""
    return ODD_MEANING if diagnosis.odd_trials else GO_ON


def verdict_line(diagnosis: Diagnosis) -> str:
    """Return the verdict in one line."""
    return f"{diagnosis.verdict}: {_headline(diagnosis)}"


def _rows(table: pd.DataFrame) -> Iterator[Any]:
    return iter(table.itertuples(index=False))


def _headline(diagnosis: Diagnosis) -> str:
    if diagnosis.odd_trials:
        return verdict_sentence(diagnosis).rstrip(".")
    if diagnosis.verdict == MISSING:
        return joined(list(diagnosis.effects)) + (" is missing" if len(diagnosis.effects) == 1 else " are missing")
    if diagnosis.verdict in (AMBIGUOUS, ARTEFACT) and diagnosis.answer_set:
        if diagnosis.answer_set == (DROPPED_FRAMES,):
            return "frames are missing from the recordings"
        if trials_differ(diagnosis.answer_set):
            return f"the trials differ, and no physics is missing: {difference_headline(diagnosis.answer_set)}"
        return f"{_HEADLINES[diagnosis.verdict]}: {joined(list(diagnosis.answer_set), 'or')}"
    power = f" ({power_brief(diagnosis.power)})" if diagnosis.power is not None else ""
    return _HEADLINES[diagnosis.verdict] + power


def _ranking(step: Round) -> list[str]:
    from vinetrack.core.terminal import table

    rows = []
    testable = [candidate for candidate in step.ranking if candidate.status != NOT_TESTABLE]
    for candidate in testable[:_SHOWN_CANDIDATES]:
        rows.append(
            (
                ("* " if candidate.in_answer_set else "  ") + candidate.effect,
                f"{candidate.delta_chi2:.1f}" if math.isfinite(candidate.delta_chi2) else "–",
                f"{candidate.sigma:.1f}",
                estimates_text(candidate),
                candidate.reason or _status(candidate, step),
            )
        )
    lines = list(table(rows, ("candidate", "Δχ²", "σ", "size", "")))
    untestable = [candidate.effect for candidate in step.ranking if candidate.status == NOT_TESTABLE]
    return lines + ([f"{NOT_TESTABLE}: {', '.join(untestable)}"] if untestable else [])


def _status(candidate: Candidate, step: Round) -> str:
    """How a candidate was tested, with its posterior weight and its richer forms where those share that weight."""
    if not (candidate.in_answer_set and candidate.posterior_weight < 0.995):
        return candidate.status
    text = f"{candidate.status}, posterior weight {100 * candidate.posterior_weight:.0f} %"
    weighed = [row for row in step.ranking if row.posterior_weight > 0]
    richer = [row.effect for row in weighed if row.is_richer_form_of(candidate.effect)]
    return f"{text}, shared with {joined(richer)}, which contain{'s' * (len(richer) == 1)} it" if richer else text


def _ladder_table(ladder: pd.DataFrame) -> list[str]:
    from vinetrack.core.terminal import table

    body = [
        (
            (str(row.added) or "initial model") + _partial_mark(row),
            *(
                f"{1e3 * value:.2f}" if math.isfinite(value) else "–"
                for value in (row.rms_in_sample_m, row.rms_left_out_m, row.rms_highest_pressure_m, row.floor_m)
            ),
        )
        for row in _rows(ladder)
    ]
    return list(table(body, ("added", "in sample mm", "left out mm", "highest pressure mm", "replicates mm")))


def _partial_mark(row: Any) -> str:
    """Mark of a step of the ladder that reduces an unexplained misfit without removing it."""
    return ", partial" if getattr(row, "partial", False) in (True, "True") else ""


def gain_in_words(before: Fit, after: Fit) -> str:
    """Return the improvement by an added effect. The model with the effect contains the one without it, so a loss shows
    that the optimiser has not converged.
    """
    gain = 2 * (after.log_likelihood - before.log_likelihood)
    if gain < 0:
        return "the fit did not converge, so whether it helps is unknown"
    helps = f"Δχ² = {gain:.1f}"
    if gain <= CLEAR_GAIN:
        helps = f"no significant improvement ({helps}; {CLEAR_GAIN:g} are needed)"
    return helps if after.converged else f"{helps}; the fit did not converge"


def added_in_words(before: Fit, after: Fit, table: pd.DataFrame, numbers: pd.DataFrame) -> list[str]:
    """Return how an effect added by hand changed position errors and parameters, as lines of aligned tables."""
    from vinetrack.core.terminal import table as aligned

    lines = [
        f"{after.model.names[-1]} added to {' + '.join(before.model.names)}: {gain_in_words(before, after)}",
        "",
        "position error",
        *_ladder_table(table),
        "",
        "parameters",
    ]
    changed: dict[tuple[str, str], dict[str, str]] = {}
    for row in _rows(numbers):
        unit, factor = display_unit(row.unit)
        title = f"{row.symbol} ({row.vine})" if row.vine else row.symbol
        place = changed.setdefault((title, unit), {})
        place["after" if row.added else "before"] = with_error(row.value * factor, row.sigma * factor)
    body = [(title, row.get("before", "–"), row.get("after", "–"), unit) for (title, unit), row in changed.items()]
    lines += aligned(body, ("", "before", "after", "unit"))
    return lines + [f"! {message}" for message in after.messages]
