"""The explanation of every round of a diagnosis, in sentences. Its tables and headline are in `diagnosis_text`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from vinetrack.core.numbers import decimals
from vinetrack.core.units import display_unit
from vinetrack.diagnosis.candidates import slip_of
from vinetrack.diagnosis.confounder import Confounder, left_open
from vinetrack.diagnosis.result import (
    ADEQUATE,
    AMBIGUOUS,
    ARTEFACT,
    BETWEEN_TRIALS,
    MISSING,
    N_BY_VINE,
)
from vinetrack.dynamics.model import base_model
from vinetrack.inference.film_influence import FILM
from vinetrack.inference.fit_result import Number
from vinetrack.inference.parameters import EXPONENT
from vinetrack.inference.systematics import FILM_ERROR
from vinetrack.narrative.between_text import difference_in_words, remedies_in_words, trials_differ
from vinetrack.narrative.verdict_summary import joined, known, size, value_alone

if TYPE_CHECKING:
    from vinetrack.diagnosis.likelihood_ratio import LikelihoodRatio
    from vinetrack.diagnosis.misfit_tests import MisfitTests
    from vinetrack.diagnosis.odd_trials import OddTrial
    from vinetrack.diagnosis.selection import SelectionStep

MEASUREMENT = "measurement"
MOST_MOVED = 3
"""Numbers that a fault has moved, named at most. Chosen to keep the sentence short; the ranking holds all of them."""

WORTH_A_CHECK_SIGMA = 3.0
"""From which an error of measurement that falls short of its threshold is named as worth a check. Chosen: about one
campaign in fifty has one by chance among its ten; at 2.5 one in ten, at 3.5 one in 200. It changes no verdict."""


def sizes_in_words(numbers: Sequence[Number]) -> str:
    """Return all sizes of a hypothesis; blank where it has none.

    Parameters
    ----------
    numbers : SI.

    Returns
    -------
    str
    """
    return ", ".join(map(size, numbers))


def explain(finding: SelectionStep) -> str:
    """Return the explanation of one round: its verdict with the reasons.

    Parameters
    ----------
    finding : the selection step of the round.

    Returns
    -------
    str
    """
    questions = finding.tests
    model = " + ".join(questions.fit.model.names)
    count = len(questions.fit.trials)
    trials = f"{count} trial{'s' if count != 1 else ''}"
    if finding.verdict == ADEQUATE:
        return _adequate(finding, model, trials)
    kept = finding.answer_set
    if finding.verdict == MISSING:
        best = kept[0]
        text = (
            f"{best.names[0] if finding.note else best.names[-1]} is missing from {model}: with "
            f"{sizes_in_words(best.numbers) or 'it'} the fit to {trials} gains Δχ² = {best.delta_chi2:.0f} "
            f"({abs(best.sigma):.1f} σ)."
        )
        if finding.note:
            return f"{text} {finding.note[0].upper()}{finding.note[1:]} ({' and '.join(best.names)} together do)."
        if best.names[-1] == "tail_slack":
            text += (
                " The model has the tail push, which it cannot: `tail_slack: free` in experiment.yaml lets it go slack."
            )
            return text
        text += " With it in the model, no other candidate and no smooth force improves the fit."
        return text + _chamber(kept) + confounders_in_words(finding.confounded) + _runner_up(finding)
    names = list(finding.answer_names)
    if finding.verdict == AMBIGUOUS:
        return (
            f"{model} lacks an effect, and these data cannot tell which: {joined(names, 'or')}. "
            f"{_hypotheses(kept)}. They fit within Δχ² = 9 of each other{_by_film(kept)}.{_weights(kept)}"
            f"{_chamber(kept)}{_camera_of_a_vine(kept)}{_remedies(finding)}"
        )
    if finding.verdict == ARTEFACT and trials_differ(names):
        return (
            f"Trials differ, and {model} holds otherwise: {_hypotheses(kept)}. That explains the misfit in {trials} "
            f"(Δχ² = {kept[0].delta_chi2:.0f}); no effect is needed beside it.{_remedies(finding)}"
            f"{_with_the_fault(finding)}"
        )
    if finding.verdict == ARTEFACT:
        which = joined(names, "or")
        return (
            f"A fault of the measurement, not of the physics: {which} explains the misfit of {model} "
            f"({_hypotheses(kept)}). It is not added to the model: "
            f"find the fault and measure again, or correct the sheet.{_slips(kept)}{_camera_of_a_vine(kept)}"
            f"{_remedies(finding)}"
            f"{_with_the_fault(finding)}{_taken_up(kept[0].names)}"
        )
    text = (
        f"The misfit of {model} exceeds the noise of {trials}, and no effect of the catalogue nor any set of the best "
        "explain it."
    )
    for name, why in finding.rejected:
        text += f" The nearest is {name.replace('+', ' with ')}: {why}."
    return text + _partial_in_words(finding)


def _taken_up(names: Sequence[str]) -> str:
    """That effects beside a fault may stand for more of it; blank where there are none."""
    if len(names) < 2:
        return ""
    takes = "takes" if len(names) == 2 else "take"
    return (
        f" What {names[0]} leaves, {joined(names[1:])} {takes} up here: look again once the fault is mended, for it "
        "may be more of the same."
    )


def _partial_in_words(finding: SelectionStep) -> str:
    """Steps that mend most of a misfit, and how much; blank where none do."""
    if not finding.partial:
        return ""
    best = finding.partial[-1]
    steps = joined([f"{step.names[-1]} (Δχ² = {step.delta_chi2:.0f} in all)" for step in finding.partial], "then")
    before, after = finding.tests.fit.chi2_per_dof, best.fit.chi2_per_dof
    return (
        f" A part of it would be mended by {steps}: χ² per degree of freedom falls from {before:.1f} to {after:.1f}, "
        f"with {sizes_in_words(best.numbers)}. Since something is left, these steps are partial: none is shown to be "
        "missing."
    )


def confounders_in_words(confounders: Sequence[Confounder]) -> str:
    """Say how much of each size another effect may be that the data cannot exclude.

    Parameters
    ----------
    confounders
        Of the sizes that were added.

    Returns
    -------
    str
        A sentence for each, a blank before it; blank where there are none.
    """
    text = ""
    for name in dict.fromkeys(confounder.number.name for confounder in confounders):
        alike = [confounder for confounder in confounders if confounder.number.name == name]
        number = alike[0].number
        unit, factor = display_unit(number.unit)
        tail, digits = f" {unit}" if unit else "", decimals(number.sigma * factor)
        smaller = [_part_in_words(rival, digits, "of") for rival in alike if abs(rival.value) < abs(number.value)]
        larger = [_part_in_words(rival, digits, "beside") for rival in alike if abs(rival.value) >= abs(number.value)]
        parts = [f"includes up to {joined(smaller, 'or')}"] if smaller else []
        parts += [f"would be larger by up to {joined(larger, 'or')}"] if larger else []
        low, high = left_open(alike)
        text += (
            f" This {number.title} {', or '.join(parts)}: the data do not exclude that. "
            f"With {joined([rival.effect for rival in alike])} left open, {number.title} lies between "
            f"{factor * low:.{digits}f} and {factor * high:.{digits}f}{tail} (95 %)."
        )
    return text


def _part_in_words(confounder: Confounder, digits: int, preposition: str) -> str:
    """`0.061 of air_drag (C_D up to 4.1)`: what the other effect changes, and up to which size."""
    unit, factor = display_unit(confounder.number.unit)
    limit_unit, limit_factor = display_unit(confounder.unit)
    change = f"{abs(confounder.value - confounder.number.value) * factor:.{digits}f}{' ' + unit if unit else ''}"
    limit = f"{confounder.symbol} up to {confounder.limit * limit_factor:.2g}{' ' + limit_unit if limit_unit else ''}"
    return f"{change} {preposition} {confounder.effect} ({limit})"


def _weights(kept: Sequence[LikelihoodRatio]) -> str:
    """Posterior weights of the hypotheses in the answer set, the heaviest first."""
    from vinetrack.diagnosis.likelihood_ratio import weights_of

    weights = sorted(weights_of(kept).items(), key=lambda pair: -pair[1])
    each = ", ".join(f"{label.replace('+', ' with ')} {100 * weight:.0f} %" for label, weight in weights)
    return f" Posterior weights, with plausible sizes as priors: {each}."


def _chamber(kept: Sequence[LikelihoodRatio]) -> str:
    """That a chamber is larger or smaller than stated, where γ says so; blank where it does not."""
    exponents = {f"{effect.name}.{p.name}": p for hypothesis in kept for effect in hypothesis.effects
                 for p in effect.parameters if "chamber_l" in effect.needs and p.symbol == "γ"}  # fmt: skip
    for entry in (entry for hypothesis in kept for entry in hypothesis.numbers if entry.key in exponents):
        low, high = exponents[entry.key].plausible or (-math.inf, math.inf)
        if not known(entry.sigma) or low - 2 * entry.sigma <= entry.value <= high + 2 * entry.sigma:
            continue
        larger = entry.value < low
        how, times, hint = ("least", low, "; count the hoses") if larger else ("most", high, "")
        return (
            f" Air has a γ of {low:g} to {high:g}, not {entry.value:.2f}: the chamber is at {how}"
            f" {times / entry.value:.2f} times what chamber_l says{hint}."
        )
    return ""


def _slips(kept: Sequence[LikelihoodRatio]) -> str:
    """Slips in the sheet that leave the sizes of an answer set; blank where none does."""
    done: dict[str, str] = {}
    for hypothesis in kept:
        parameters = {f"{effect.name}.{p.name}": p for effect in hypothesis.effects for p in effect.parameters}
        for entry in hypothesis.numbers:
            if entry.key in parameters and (slip := slip_of(parameters[entry.key], entry.value, entry.sigma)):
                done.setdefault(slip[1], entry.key.split(".")[0])
    return "".join(
        f" The size of {name} is what is left where {slip}: look there first." for slip, name in done.items()
    )


def _camera_of_a_vine(kept: Sequence[LikelihoodRatio]) -> str:
    """What else films that differ from vine to vine may be; blank where no answer says that they do.

    ε of the mass is ε/2 of the frame rate of that vine's recordings, exactly so on the level without a payload, and
    close to −ε of their scale or of their pressures: mass times acceleration is what is seen of any of them.
    """
    if not any(FILM in hypothesis.names and len(_films(hypothesis)) > 1 for hypothesis in kept):
        return ""
    return (
        " A vine filmed at a frame rate that is off by half of its ε, with a scale off by −ε, or at pressures off by −ε"
        " looks the same: check the camera's settings and the gauge of that vine too."
    )


def _films(hypothesis: LikelihoodRatio) -> set[str]:
    return {number.vine for number in hypothesis.numbers if number.key.startswith(f"{FILM}.")}


def _by_film(kept: Sequence[LikelihoodRatio]) -> str:
    """Which of an answer set need film that weighs a little other than stated; blank where none does."""
    from vinetrack.diagnosis.likelihood_ratio import ANSWER_SET_DELTA_CHI2, best_of

    best = best_of(kept)
    need = [
        ratio.label.replace("+", " with ")
        for ratio in kept
        if ratio.deviance_excess(best) > ANSWER_SET_DELTA_CHI2 * best.inflation
    ]
    if not need:
        return ""
    names = joined(need)
    return (
        f", {names} where the film weighs about {100 * FILM_ERROR:.0f} % more or less than thickness and density say: "
        "weigh a piece of it"
    )


def _with_the_fault(finding: SelectionStep) -> str:
    """Numbers that are biased without the fault, fitted along with the likeliest one, and instead of what.

    Those are all of effects added before, and of the base model n first, then others that leave their 95 % intervals.
    B of a vine with an n of its own is another quantity.
    """
    fit, best = finding.tests.fit, finding.answer_set[0]
    if best.names[-1] == N_BY_VINE:
        return ""
    before = {number.name: number for number in fit.numbers}
    moved = [
        number
        for number in best.others
        if number.name in before and math.isfinite(number.sigma) and _is_biased(before[number.name], number)
    ]
    moved.sort(key=lambda number: number.key != EXPONENT)
    if not moved:
        return ""
    each = ", ".join(f"{size(number)} instead of {value_alone(before[number.name])}" for number in moved[:MOST_MOVED])
    more = f", and {len(moved) - MOST_MOVED} more move" if len(moved) > MOST_MOVED else ""
    return f" Fitted along with {best.names[-1]}, {each}{more}."


def _is_biased(before: Number, with_fault: Number) -> bool:
    if before.key.split(".")[0] not in base_model():
        return True
    return math.isfinite(before.sigma) and not before.low <= with_fault.value <= before.high


def _hypotheses(kept: Sequence[LikelihoodRatio]) -> str:
    """The hypotheses of an answer set with their sizes."""
    differ = [difference_in_words(result) for result in kept if result.effects[-1].kind == BETWEEN_TRIALS]
    effects = [result for result in kept if result.effects[-1].kind != BETWEEN_TRIALS]
    sizes = {" with ".join(result.names): sizes_in_words(result.numbers) for result in effects}
    return "; ".join([*differ, *(f"{names} has {size}" if size else names for names, size in sizes.items())])


def _remedies(finding: SelectionStep) -> str:
    return remedies_in_words(finding.answer_set, [trial.trial for trial in finding.tests.fit.trials])


def _adequate(finding: SelectionStep, model: str, trials: str) -> str:
    questions = finding.tests
    if finding.note:
        return f"{model} explains {trials} as well as positions are known. {finding.note[0].upper()}{finding.note[1:]}."
    text = f"{model} explains {trials}: no missing effect can be detected."
    if questions.one_sided_z.size:
        names = questions.sensitivities.effects
        limits = [questions.family.threshold(name) for name in names]
        place = int((questions.one_sided_z - limits).argmax())
        text += (
            f" The most significant of {_count_testable(questions)} candidates, "
            f"{names[place]}, has {questions.one_sided_z[place]:.1f} σ, and {limits[place]:.1f} σ are asked of it; by "
            f"chance any of them has what is asked of it once in {1 / questions.level:.0f} campaigns."
        )
        kind = next(effect.kind for effect in questions.effects if effect.name == names[place])
        if kind == MEASUREMENT and questions.one_sided_z[place] >= WORTH_A_CHECK_SIGMA:
            text += f" It is an error of measurement, and soon checked: see `vinetrack effects {names[place]}`."
    return f"{text}{_unstated(finding)}"


def _unstated(finding: SelectionStep) -> str:
    """Differences between trials by an order that the sheet does not state; blank where there are none."""
    if not finding.unstated_differences:
        return ""
    best = max(finding.unstated_differences, key=lambda result: result.delta_chi2)
    trials = [trial.trial for trial in finding.tests.fit.trials]
    return (
        f" But trials seem to differ, and the numbers of the model hold what that does: {difference_in_words(best)}"
        f" (Δχ² = {best.delta_chi2:.0f}).{remedies_in_words([best], trials)}"
    )


def _count_testable(questions: MisfitTests) -> int:
    """How many effects these trials could show: those that the ranking has as tested."""
    return sum(
        effect.name not in questions.sensitivities.silent
        and (
            questions.upper_limits(effect)[1]
            or questions.best_z(effect.name)[0] >= questions.family.threshold(effect.name)
        )
        for effect in questions.effects
    )


def _runner_up(finding: SelectionStep) -> str:
    from vinetrack.diagnosis.likelihood_ratio import best_of

    kept, aside = {result.names for result in finding.answer_set}, dict(finding.rejected)
    others = [r for r in finding.fitted if len(r.names) == 1 and r.names not in kept and r.label not in aside]
    text = ""
    if others:
        best = best_of(others)
        text = f" The next best, {best.names[0]}, is worse by Δχ² = {best.deviance_excess(finding.answer_set[0]):.0f}."
    for name, why in finding.rejected:
        text += f" {name} fits as well, but {why}."
    return text


def odd_in_words(odd: Sequence[OddTrial], count: int) -> str:
    """Return what to say of trials that do not go with the others.

    Parameters
    ----------
    odd : at least one.
    count : of all trials.

    Returns
    -------
    str
    """
    names = joined([trial.name for trial in odd])
    alone = len(odd) == 1
    like = [
        f"{'it' if alone else trial.name} moves as with {trial.implied_pressure_Pa / 1e3:.3g} kPa, and"
        f" {trial.stated_Pa / 1e3:.3g} kPa is stated"
        for trial in odd
        if trial.implied_pressure_Pa > 0
    ]
    return (
        f"{names} {'does' if alone else 'do'} not go with the other {count - len(odd)} trials"
        f"{': ' if like else ''}{'; '.join(like)}. Look at {'its row' if alone else 'their rows'} in the sheet and at "
        "what was filmed; `use: no` leaves a trial out."
    )


def dropped_in_words(trials: Sequence[str]) -> str:
    """Return the explanation of a diagnosis where frames are missing from these recordings.

    Parameters
    ----------
    trials : names of the recordings.

    Returns
    -------
    str
    """
    return (
        f"Frames are missing from {_recordings(trials)}: the step of one "
        "frame is far above those of its neighbours. Camera or disk dropped frames. The times were corrected; record "
        "again where it matters."
    )


def perhaps_dropped_in_words(trials: Sequence[str]) -> str:
    """Return the note of a diagnosis where frames may be missing from these recordings.

    Parameters
    ----------
    trials : names of the recordings.

    Returns
    -------
    str
    """
    return (
        f"Frames may be missing from {_recordings(trials)}: one step is above those of its neighbours, and the later "
        "times were moved on. Points farther away are too few or too noisy to confirm it: look at the recording."
    )


def _recordings(trials: Sequence[str]) -> str:
    some = joined(list(trials[:4])) + (" and others" if len(trials) > 4 else "")
    return f"{len(trials)} recording{'s' if len(trials) > 1 else ''} ({some})"
