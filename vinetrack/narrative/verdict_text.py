"""Explanation of each round of a diagnosis in sentences; `diagnosis_text` has the headline and the tables."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from vinetrack.core.numbers import decimals
from vinetrack.core.units import display_unit
from vinetrack.diagnosis.candidates import slip_of
from vinetrack.diagnosis.confounder import Confounder, left_open
from vinetrack.diagnosis.misfit_tests import FALSE_ALARM_LEVEL_FIRST_ROUND
from vinetrack.diagnosis.result import (
    ADEQUATE,
    AMBIGUOUS,
    ARTEFACT,
    BETWEEN_TRIALS,
    MISSING,
    N_BY_VINE,
    UNEXPLAINED,
)
from vinetrack.dynamics.model import base_model
from vinetrack.inference.film_influence import FILM
from vinetrack.inference.fit_result import Number
from vinetrack.inference.parameters import EXPONENT
from vinetrack.inference.systematics import FILM_ERROR
from vinetrack.narrative.between_text import difference_in_words, remedies_in_words, trials_differ
from vinetrack.narrative.verdict_summary import estimate_text, is_finite, joined, value_text

if TYPE_CHECKING:
    from vinetrack.diagnosis.likelihood_ratio import LikelihoodRatio
    from vinetrack.diagnosis.misfit_tests import MisfitTests
    from vinetrack.diagnosis.odd_trials import OddTrial
    from vinetrack.diagnosis.selection import SelectionStep

MEASUREMENT = "measurement"
MOST_BIASED_NAMED = 3  # Biased parameters named in a sentence, at most (chosen)

# Significance from which a fault of the measurement below its threshold is named as worth a check (chosen)
WORTH_A_CHECK_SIGMA = 3.0


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
        return f"{text} {step.note[0].upper()}{step.note[1:]} ({' and '.join(best.names)} together do)."
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
        f"{_weights(answers)}{_chamber(answers)}{_camera_of_a_vine(answers)}{_remedies(step)}"
    )


def _difference_between_trials(step: SelectionStep, model: str, trials: str) -> str:
    answers = step.answer_set
    return (
        f"The trials differ from each other, and no effect is missing from {model}: {_hypotheses(answers)}. That "
        f"explains the misfit of {trials} (Δχ² = {answers[0].delta_chi2:.0f}).{_remedies(step)}"
        f"{_with_the_fault(step)}"
    )


def _measurement_fault(step: SelectionStep, model: str, trials: str) -> str:
    answers = step.answer_set
    return (
        f"A fault of the measurement, not missing physics: {joined(list(step.answer_names), 'or')} explains the misfit "
        f"of {model} to {trials} ({_hypotheses(answers)}). It is not added to the model: find the fault and measure "
        f"again, or correct the sheet.{_slips(answers)}{_camera_of_a_vine(answers)}{_remedies(step)}"
        f"{_with_the_fault(step)}{_other_effects_beside_the_fault(answers[0].names)}"
    )


def _unexplained(step: SelectionStep, model: str, trials: str) -> str:
    text = (
        f"The misfit of {model} exceeds the noise of {trials}, and neither any one effect of the catalogue nor any "
        "combination of the best explains it."
    )
    for name, why in step.rejected:
        text += f" The nearest is {name.replace('+', ' with ')}: {why}."
    return text + _partial_in_words(step)


def _other_effects_beside_the_fault(names: Sequence[str]) -> str:
    """Warn that effects fitted beside a fault may describe more of the same fault; blank where there are none."""
    if len(names) < 2:
        return ""
    explains = "explains" if len(names) == 2 else "explain"
    return (
        f" {joined(names[1:])} {explains} what {names[0]} leaves, which may be more of the same fault: repeat the "
        "diagnosis once it is corrected."
    )


def _partial_in_words(step: SelectionStep) -> str:
    """Describe the effects that reduce an unexplained misfit, and by how much; blank where none do."""
    if not step.partial:
        return ""
    last = step.partial[-1]
    added = joined([f"{each.names[-1]} (Δχ² = {each.delta_chi2:.0f} in all)" for each in step.partial], "then")
    before, after = step.tests.fit.chi2_per_dof, last.fit.chi2_per_dof
    return (
        f" Part of the misfit is explained by adding {added}: χ² per degree of freedom falls from {before:.1f} to "
        f"{after:.1f}, with {sizes_in_words(last.numbers)}. Because a significant misfit remains, these steps are "
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
    if not any(FILM in hypothesis.names and len(_vines_with_film_error(hypothesis)) > 1 for hypothesis in answers):
        return ""
    return (
        " In a vine's recordings an error of ε/2 in frame rate, of −ε in scale or of −ε in pressure has the same effect"
        " as an error of ε in its film mass: check the camera settings and the gauge of each vine too."
    )


def _vines_with_film_error(hypothesis: LikelihoodRatio) -> set[str]:
    return {number.vine for number in hypothesis.numbers if number.key.startswith(f"{FILM}.")}


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
    biased = [
        number
        for number in best.others
        if number.name in before and math.isfinite(number.sigma) and _is_biased(before[number.name], number)
    ]
    biased.sort(key=lambda number: number.key != EXPONENT)
    if not biased:
        return ""
    changes = [f"{estimate_text(number)} instead of {value_text(before[number.name])}" for number in biased]
    more = len(changes) - MOST_BIASED_NAMED
    others = f", and {more} more parameter{'s change' if more > 1 else ' changes'}" if more > 0 else ""
    return f" Fitted together with {best.names[-1]}, {', '.join(changes[:MOST_BIASED_NAMED])}{others}."


def _is_biased(before: Number, with_fault: Number) -> bool:
    if before.key.split(".")[0] not in base_model():
        return True
    return math.isfinite(before.sigma) and not before.low <= with_fault.value <= before.high


def _hypotheses(answers: Sequence[LikelihoodRatio]) -> str:
    """The hypotheses of an answer set with their sizes, differences between trials first."""
    differences = [difference_in_words(result) for result in answers if result.effects[-1].kind == BETWEEN_TRIALS]
    effects = [result for result in answers if result.effects[-1].kind != BETWEEN_TRIALS]
    sizes = {" with ".join(result.names): sizes_in_words(result.numbers) for result in effects}
    return "; ".join([*differences, *(f"{names} has {size}" if size else names for names, size in sizes.items())])


def _remedies(step: SelectionStep) -> str:
    return remedies_in_words(step.answer_set, [trial.trial for trial in step.tests.fit.trials])


def _adequate(step: SelectionStep, model: str, trials: str) -> str:
    tests = step.tests
    if step.note:
        return f"{model} explains {trials} within the errors of position. {step.note[0].upper()}{step.note[1:]}."
    text = f"{model} explains {trials}: no missing effect can be detected."
    if tests.one_sided_z.size:
        names = tests.sensitivities.effects
        thresholds = [tests.family.threshold(name) for name in names]
        best = int((tests.one_sided_z - thresholds).argmax())
        stricter = " (the level once an effect was added)" if tests.level < FALSE_ALARM_LEVEL_FIRST_ROUND else ""
        text += (
            f" The most significant of {_count_testable(tests)} candidates, {names[best]}, reaches "
            f"{tests.one_sided_z[best]:.1f} σ; its threshold is {thresholds[best]:.1f} σ. Where nothing is missing, "
            f"chance takes a candidate to its threshold in one of {1 / tests.level:.0f} campaigns{stricter}."
        )
        kind = next(effect.kind for effect in tests.effects if effect.name == names[best])
        if kind == MEASUREMENT and tests.one_sided_z[best] >= WORTH_A_CHECK_SIGMA:
            text += f" It is a fault of the measurement that is soon checked: see `vinetrack effects {names[best]}`."
    return f"{text}{_unstated(step)}"


def _unstated(step: SelectionStep) -> str:
    """Describe a difference between trials that follows an order the sheet does not state; blank without one."""
    if not step.unstated_differences:
        return ""
    best = max(step.unstated_differences, key=lambda result: result.delta_chi2)
    trials = [trial.trial for trial in step.tests.fit.trials]
    return (
        f" However, the trials seem to differ, which biases the fitted numbers: {difference_in_words(best)}"
        f" (Δχ² = {best.delta_chi2:.0f}).{remedies_in_words([best], trials)}"
    )


def _count_testable(tests: MisfitTests) -> int:
    """Number of effects that these trials can test: those that the ranking does not call not testable."""
    return sum(
        effect.name not in tests.sensitivities.silent
        and (tests.upper_limits(effect)[1] or tests.best_z(effect.name)[0] >= tests.family.threshold(effect.name))
        for effect in tests.effects
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


def dropped_in_words(trials: Sequence[str]) -> str:
    """Return the explanation of a diagnosis where frames are missing from these recordings."""
    return (
        f"Frames are missing from {_recordings(trials)}: the edge moves much farther from one frame to the next than "
        "in the frames around them, so the camera or the disk dropped frames. The times were corrected; record again "
        "where it matters."
    )


def perhaps_dropped_in_words(trials: Sequence[str]) -> str:
    """Return the note of a diagnosis where frames may be missing from these recordings."""
    return (
        f"Frames may be missing from {_recordings(trials)}: the edge moves farther from one frame to the next than in "
        "the frames around them, and the later times were shifted accordingly. Points farther away are too few or too "
        "noisy to confirm it: look at the recording."
    )


def _recordings(trials: Sequence[str]) -> str:
    some = joined(list(trials[:4])) + (" and others" if len(trials) > 4 else "")
    return f"{len(trials)} recording{'s' if len(trials) > 1 else ''} ({some})"
