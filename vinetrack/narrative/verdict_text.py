"""A diagnosis in words that a student understands, and as it is printed on a terminal."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

from vinetrack.core.numbers import decimals
from vinetrack.core.units import display_unit
from vinetrack.diagnosis.result import (
    ADEQUATE,
    AMBIGUOUS,
    ARTEFACT,
    DROPPED_FRAMES,
    MISSING,
    NOT_TESTABLE,
    Diagnosis,
    Round,
)
from vinetrack.dynamics.model import base_model
from vinetrack.inference.fit_result import Number

if TYPE_CHECKING:
    import pandas as pd

    from vinetrack.diagnosis.selection import SelectionStep
    from vinetrack.inference.fit_result import Fit

MEANINGS = {
    ADEQUATE: "nothing missing can be detected",
    MISSING: "one effect is missing",
    AMBIGUOUS: "one of several effects is missing, and these data cannot tell which",
    ARTEFACT: "the measurement is at fault, not the physics",
    "unexplained": "the model fails, and nothing in the catalogue mends it",
}
SHOWN_CANDIDATES = 8


def size_in_words(number: Number) -> str:
    """`γ = 1.170 ± 0.004`, in a unit that reads well."""
    unit, factor = display_unit(number.unit)
    tail = f" {unit}" if unit else ""
    if not (math.isfinite(number.sigma) and number.sigma > 0):
        return f"{number.symbol} = {number.value * factor:.4g}{tail}"
    digits = decimals(number.sigma * factor)
    vine = f" ({number.vine})" if number.vine else ""
    return f"{number.symbol}{vine} = {number.value * factor:.{digits}f} ± {number.sigma * factor:.{digits}f}{tail}"


def sizes_in_words(numbers: Sequence[Number]) -> str:
    """All sizes of a hypothesis, or nothing where it has none."""
    return ", ".join(map(size_in_words, numbers))


def listed(names: Sequence[str], word: str = "and") -> str:
    """`a, b and c`."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} {word} {names[-1]}"


def explain(finding: SelectionStep) -> str:
    """One round in sentences."""
    questions = finding.questions
    model = " + ".join(questions.found.model.names)
    count = len(questions.found.trials)
    trials = f"{count} trial{'s' if count != 1 else ''}"
    if finding.verdict == ADEQUATE:
        return _adequate(finding, model, trials)
    kept = finding.kept
    if finding.verdict == MISSING:
        best = kept[0]
        text = (
            f"{best.names[0] if finding.note else best.names[-1]} is missing from {model}: with "
            f"{sizes_in_words(best.numbers) or 'it'} the fit to {trials} gains Δχ² = {best.delta_chi2:.0f} "
            f"({abs(best.sigma):.1f} σ)."
        )
        if finding.note:
            return f"{text} {finding.note[0].upper()}{finding.note[1:]} ({' and '.join(best.names)} together do)."
        return f"{text} Nothing is left then that any candidate or any smooth force could explain.{_runner_up(finding)}"
    names = list(finding.answer)
    if finding.verdict == AMBIGUOUS:
        return (
            f"{model} lacks an effect, and these data cannot tell which: {listed(names, 'or')}. "
            f"{'; '.join(_one(one.names, one.numbers) for one in kept)}. They fit within Δχ² = 9 of each other."
        )
    if finding.verdict == ARTEFACT:
        which = listed(names, "or")
        return (
            f"The measurement is at fault rather than the physics: {which} mends what {model} misses "
            f"({'; '.join(_one(one.names, one.numbers) for one in kept)}). It is not added to the model: "
            f"find the fault and measure again, or correct the sheet.{_with_the_fault(finding)}"
        )
    text = (
        f"{model} fails beyond the noise of {trials}, and no effect of the catalogue nor any two of those that help "
        "most mend it."
    )
    for name, why in finding.aside:
        text += f" Nearest comes {name.replace('+', ' with ')}: {why}."
    return text


def _with_the_fault(finding: SelectionStep) -> str:
    """What effects found before amount to once the fault is fitted along: without it they make up for it."""
    found, best = finding.questions.found, finding.kept[0]
    mine = [number for number in best.others if number.key.split(".")[0] not in base_model()]
    before = {number.name: number for number in found.numbers}
    moved = [number for number in mine if number.name in before and math.isfinite(number.sigma)]
    if not moved:
        return ""
    instead = sizes_in_words([before[number.name] for number in moved])
    return f" Fitted along with {best.names[-1]}, {sizes_in_words(moved)} instead of {instead}."


def _one(names: Sequence[str], numbers: Sequence[Number]) -> str:
    sizes = sizes_in_words(numbers)
    return f"{' with '.join(names)}{f' has {sizes}' if sizes else ''}"


def _adequate(finding: SelectionStep, model: str, trials: str) -> str:
    questions = finding.questions
    text = f"{model} explains {trials}: nothing missing can be detected."
    if questions.possible.size:
        place = int(questions.possible.argmax())
        text += (
            f" The most suspicious of {len(set(questions.answers.effects))} candidates, "
            f"{questions.answers.effects[place]}, stands at {questions.possible[place]:.1f} σ; by chance the best of "
            f"them passes {questions.threshold:.1f} σ once in {1 / questions.level:.0f} campaigns."
        )
    return text


def _runner_up(finding: SelectionStep) -> str:
    others = [one for one in finding.tried if len(one.names) == 1 and one.names not in {k.names for k in finding.kept}]
    others = [one for one in others if one.label not in dict(finding.aside)]
    text = ""
    if others:
        best = max(others, key=lambda one: one.fit.log_likelihood)
        behind = 2 * (finding.kept[0].fit.log_likelihood - best.fit.log_likelihood)
        text = f" The next best, {best.names[0]}, is worse by Δχ² = {behind:.0f}."
    for name, why in finding.aside:
        text += f" {name} fits as well, but {why}."
    return text


def dropped_in_words(trials: Sequence[str]) -> str:
    """What is said where frames are missing from recordings."""
    some = listed(list(trials[:4])) + (" and others" if len(trials) > 4 else "")
    return (
        f"Frames are missing from {len(trials)} recording{'s' if len(trials) > 1 else ''} ({some}): there one frame's "
        "step is far above its neighbours'. That is the camera's or the disk's fault, not the vine's. The times were "
        "put right; record anew where it matters."
    )


def diagnosis_text(found: Diagnosis) -> str:
    """The verdict first, then the rounds with their candidates, then what to do next."""
    lines = [f"{found.verdict}: {_headline(found)}", "", found.explanation]
    for one in found.rounds:
        if one.ranking:
            lines += ["", f"{' + '.join(one.model)}: {one.verdict}", *_ranking(one)]
    if found.ladder is not None and len(found.ladder) > 1:
        lines += ["", "position error", *_ladder_table(found.ladder)]
    if found.where:
        lines += ["", *found.where]
    if found.next_experiment:
        lines += ["", str(found.next_experiment.get("text", ""))]
    lines += [f"! {note}" for note in found.notes]
    return "\n".join(lines)


def _rows(table: pd.DataFrame) -> Iterator[Any]:
    return iter(table.itertuples(index=False))


def _headline(found: Diagnosis) -> str:
    if found.verdict == MISSING:
        return listed(list(found.effects)) + (" is missing" if len(found.effects) == 1 else " are missing")
    if found.verdict in (AMBIGUOUS, ARTEFACT) and found.answer_set:
        if found.answer_set == (DROPPED_FRAMES,):
            return "frames are missing from the recordings"
        return f"{MEANINGS[found.verdict]}: {listed(list(found.answer_set), 'or')}"
    return MEANINGS[found.verdict]


def _ranking(one: Round) -> list[str]:
    from vinetrack.core.terminal import table

    rows = []
    testable = [candidate for candidate in one.ranking if candidate.status != NOT_TESTABLE]
    for candidate in testable[:SHOWN_CANDIDATES]:
        rows.append(
            (
                ("* " if candidate.in_answer_set else "  ") + candidate.effect,
                f"{candidate.delta_chi2:.1f}" if math.isfinite(candidate.delta_chi2) else "–",
                f"{candidate.sigma:.1f}",
                sizes_in_words(candidate.numbers) or "",
                candidate.status if not candidate.reason else candidate.reason,
            )
        )
    lines = list(table(rows, ("candidate", "Δχ²", "σ", "size", "")))
    blind = [candidate.effect for candidate in one.ranking if candidate.status == NOT_TESTABLE]
    return lines + ([f"not testable here: {', '.join(blind)}"] if blind else [])


def _ladder_table(ladder: pd.DataFrame) -> list[str]:
    from vinetrack.core.terminal import table

    body = [
        (
            str(row.added) or "as it came",
            *(
                f"{1e3 * value:.2f}" if math.isfinite(value) else "–"
                for value in (row.rms_in_sample_m, row.rms_left_out_m, row.rms_highest_pressure_m, row.floor_m)
            ),
        )
        for row in _rows(ladder)
    ]
    return list(table(body, ("added", "in sample mm", "left out mm", "highest pressure mm", "replicates mm")))


def added_in_words(before: Fit, after: Fit, table: pd.DataFrame, numbers: pd.DataFrame) -> list[str]:
    """What an effect put in by hand did to errors and numbers, as lines of aligned tables."""
    from vinetrack.core.terminal import table as aligned

    gain = 2 * (after.log_likelihood - before.log_likelihood)
    lines = [
        f"{after.model.names[-1]} added to {' + '.join(before.model.names)}: Δχ² = {gain:.1f}",
        "",
        "position error",
        *_ladder_table(table),
        "",
        "numbers",
    ]
    changed: dict[tuple[str, str], dict[str, str]] = {}
    for row in _rows(numbers):
        unit, factor = display_unit(row.unit)
        digits = decimals(row.sigma * factor) if math.isfinite(row.sigma) else 3
        title = f"{row.symbol} ({row.vine})" if row.vine else row.symbol
        place = changed.setdefault((title, unit), {})
        place["after" if row.added else "before"] = f"{row.value * factor:.{digits}f} ± {row.sigma * factor:.{digits}f}"
    body = [(title, one.get("before", "–"), one.get("after", "–"), unit) for (title, unit), one in changed.items()]
    lines += aligned(body, ("", "before", "after", "unit"))
    return lines + [f"! {message}" for message in after.messages]
