"""Output of `vinetrack diagnose` and `vinetrack add`: a whole diagnosis, and the improvement by an added effect."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

from vinetrack.core.notebook import html_table
from vinetrack.core.units import decimals, display_unit, interval, number, with_error, with_interval
from vinetrack.diagnosis.remarks import joined
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
from vinetrack.narrative.power_text import (
    advice_text,
    could_have_seen,
    false_alarm_sentence,
    measure_first_text,
    measurement_text,
    power_brief,
)
from vinetrack.narrative.verdict_text import (
    ODD_MEANING,
    difference_headline,
    dropped_in_words,
    estimates_text,
    odd_deciding_in_words,
    odd_in_words,
    perhaps_dropped_in_words,
    summary_facts,
    trials_differ,
    verdict_sentence,
)

if TYPE_CHECKING:
    import pandas as pd

    from vinetrack.diagnosis.force_laws import Law
    from vinetrack.inference.fit_result import Fit


# ------------------------------------------------------------------------------
# The damping law of an experiment in sentences and tables, for terminal and report, and how it was determined.

_STATUS_WORDS = {"ok": "ok", "warning": "with a warning", "failed": "failed", "left_out": "left out on request"}

# The two fits of the damping law, by their keys in `damping.json`
METHOD_NAMES = {"log_log": "log–log least squares", "both_axes": "errors on both axes"}

_TABLE_METHODS = METHOD_NAMES | {"paper": "the published rule, exactly as printed"}  # Rows of the tables of n and B

PREFERRED = "both_axes"  # The fit whose numbers head the report

REFERENCES = (
    "Alvarez et al., High-Velocity, Pressure-Driven Eversion for Rapid Vine Robots, IEEE Robotics and Automation "
    "Letters, 2025: the equation of motion, the damping law and the 3 % rule.",
    "Savitzky and Golay, Smoothing and Differentiation of Data by Simplified Least Squares Procedures, Analytical "
    "Chemistry 36, 1964: velocity.",
    "York, Evensen, Martínez and De Basabe Delgado, Unified equations for the slope, intercept, and standard errors of "
    "the best straight line, American Journal of Physics 72, 2004: the fit with errors on both axes.",
    "Efron and Tibshirani, An Introduction to the Bootstrap, 1993: intervals by resampling whole trials.",
)

DIAGNOSIS_METHODS = (
    (
        "Model",
        "Simulated positions are fitted to the measured ones of all trials at once. Shared parameters: those of the "
        "model, B of every vine, one n, and the yield pressure with the sheet's error as prior. Parameters of each "
        "trial: its release, its origin, and deviations of pressure and of B, whose standard deviations between trials "
        "are estimated too, like replicate scatter, noise and the noise's correlation.",
    ),
    (
        "Diagnosis",
        "For every candidate of the catalogue a score test predicts by how much the fit would improve with it, all "
        "fitted parameters estimated anew; faults of the measurement are candidates too. The best, and those "
        "correlated with them, are fitted in full. Hypotheses within Δχ² = 9 of the best form the answer set. The "
        "threshold for calling an effect missing accounts for the number of candidates and the correlation between "
        "them. An effect is added only if it is the only member of the answer set; all candidates are then tested "
        "again.",
    ),
    (
        "Ladder",
        "Position errors are root mean squares; only release and origin are estimated for each trial. "
        "Left-out conditions are predicted by the model fitted to all other conditions, the highest pressure of each "
        "vine by the model fitted to all lower ones. The floor is the replicate scatter.",
    ),
)
DIAGNOSIS_REFERENCES = (
    "Rao, Large sample tests of statistical hypotheses concerning several parameters with applications to problems of "
    "estimation, Proceedings of the Cambridge Philosophical Society 44, 1948: testing candidates without fitting each.",
    "Wilks, The large-sample distribution of the likelihood ratio for testing composite hypotheses, Annals of "
    "Mathematical Statistics 9, 1938: the significance of a Δχ².",
)


def damping_headline(damping: Mapping[str, Any]) -> str:
    """Return the main result in one sentence."""
    fit = damping.get(PREFERRED) or {}
    if fit.get("refused") or fit.get("n") is None or not fit.get("vines"):
        return f"No damping law: {_sentence(fit.get('refused') or 'no trial gave a steady speed')}"
    vines = fit["vines"]
    n_trials = sum(law["n_trials"] for law in vines.values())
    n = with_interval(fit["n"], fit.get("n_95"))
    if len(vines) == 1:
        (law,) = vines.values()
        B = with_interval(law["B"], law.get("B_95"))
        law = f"damping exponent n = {n}, with B = {B} N·(s/m)ⁿ, from {_count(n_trials, 'trial')} of one vine"
    else:
        law = f"one damping exponent fits all vines: n = {n}, from {_count(n_trials, 'trial')} of {len(vines)} vines"
    return f"From steady speeds: {law}."


def status_tally(trials: pd.DataFrame) -> str:
    """Return the number of trials of each status, as a sentence."""
    counts = trials["status"].value_counts()
    parts = [f"{counts[status]} {_STATUS_WORDS[status]}" for status in _STATUS_WORDS if counts.get(status, 0)]
    return f"{_count(len(trials), 'trial')}: {', '.join(parts)}." if parts else "No trials."


def vine_table(damping: Mapping[str, Any]) -> list[dict[str, str]]:
    """Return size, B, its intervals, R² and N of each vine and method of `damping.json` as text, smallest
    vine first.
    """
    table, sizes = [], []
    for method, method_name in _TABLE_METHODS.items():
        for vine, law in ((damping.get(method) or {}).get("vines") or {}).items():
            table.append(
                {
                    "vine": vine,
                    "method": method_name,
                    "size": f"{number(law['diameter_mm'])} mm × {number(law['thickness_um'])} µm",
                    "B": number(law["B"], 4),
                    "B_95": interval(law.get("B_95")),
                    "B_95_total": interval(law.get("B_95_total")),
                    "R2": number(law.get("R2")),
                    "n_trials": str(law["n_trials"]),
                }
            )
            sizes.append((law["diameter_mm"], law["thickness_um"], vine))
    order = sorted(range(len(table)), key=lambda i: sizes[i])
    return [table[i] for i in order]


def exponent_table(damping: Mapping[str, Any]) -> list[dict[str, str]]:
    """Return n and its intervals by each method of `damping.json` as text, or why a method refused."""
    table = []
    for method, method_name in _TABLE_METHODS.items():
        fit = damping.get(method)
        if fit is None:
            continue
        table.append(
            {
                "method": method_name,
                "n": number(fit.get("n"), 4),
                "n_95": interval(fit.get("n_95")),
                "n_95_total": interval(fit.get("n_95_total")),
                "refused": str(fit.get("refused") or ""),
            }
        )
    return table


def vines_without_law(damping: Mapping[str, Any]) -> list[str]:
    """Return the vines that the preferred fit of `damping.json` left out, each with the reason."""
    left_out = (damping.get(PREFERRED) or {}).get("left_out") or {}
    return [f"{vine}: {reason}" for vine, reason in left_out.items()]


def methods(settings: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return how the results were computed, as (heading, paragraph) pairs, with the numbers of the run's settings."""
    velocity, steady, damping = (settings.get(key) or {} for key in ("velocity", "steady", "damping"))
    return [
        (
            "Speed",
            f"Positions are smoothed and differentiated by local polynomials of order {velocity.get('order', 3)} "
            "(Savitzky–Golay). The window at each point is the widest whose fit agrees with narrower ones within the "
            "noise; noise and its correlation are estimated from the positions. Speeds in results are those of the "
            "tail, which moves twice as fast as the leading edge.",
        ),
        (
            "Steady stretch",
            "The gated rule takes the longest stretch whose change of speed is shown to be below "
            f"{_percent(steady.get('drift_limit', 0.03))} by an equivalence test, so that noise cannot pass as "
            "steadiness. "
            f"The paper's rule takes at least {steady.get('paper_points', 3)} consecutive points whose speeds vary by "
            f"less than {_percent(steady.get('paper_cv', 0.03))}. A window chosen by hand is used where the sheet "
            "gives one. All are reported for every trial.",
        ),
        (
            "Force",
            "F = (P − P_y)·πD²/4 + 2·m·g·cosθ. P is the mean pressure in the window, measured or else computed by the "
            "model in use; P_y is the yield pressure, and m the mean mass in motion in the window. Only everting "
            "bodies "
            "without payload enter the fit.",
        ),
        (
            "Damping law",
            "F = B·x_ssⁿ with one n for all vines and a B for each: by least squares on logarithms, as in the paper, "
            "and with errors on both axes (York), where the scatter between vines is added to the measured errors. "
            f"95 % intervals come from a bootstrap of {damping.get('resamples', 2000)} resamplings of whole trials "
            f"(seed {damping.get('seed', 0)}), or from Student's t where there are too few trials to resample. The "
            "total intervals add the stated systematic errors: of the yield pressure, common to a vine, and of the "
            "scale, "
            "common to all recordings.",
        ),
    ]


def _count(n: int, noun: str) -> str:
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"


def _percent(fraction: float) -> str:
    return f"{100 * fraction:g} %"


def _sentence(text: str) -> str:
    return text if text.endswith(".") else text + "."


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
    # 8: candidates of a round that the terminal shows (chosen)
    for candidate in testable[:8]:
        rows.append(
            (
                ("* " if candidate.in_answer_set else "  ") + candidate.effect,
                f"{candidate.delta_chi2:.1f}" if math.isfinite(candidate.delta_chi2) else "–",
                f"{candidate.sigma:.1f}",
                estimates_text(candidate),
                str(candidate.reason) or _status(candidate, step),
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
    clear_gain = 9.0  # Δχ² above which an added effect is said to help (derived)
    gain = 2 * (after.log_likelihood - before.log_likelihood)
    if gain < 0:
        return "the fit did not converge, so whether it helps is unknown"
    helps = f"Δχ² = {gain:.1f}"
    if gain <= clear_gain:
        helps = f"no significant improvement ({helps}; {clear_gain:g} are needed)"
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


def diagnosis_page(diagnosis: Diagnosis) -> str:
    """Return the first screen of a diagnosis as HTML, for a notebook."""
    rows = [(fact.question, fact.answer, fact.note) for fact in summary_facts(diagnosis, diagnosis.ladder)]
    title = f"{diagnosis.verdict or 'refused'}: {verdict_sentence(diagnosis)}"
    return html_table(("", "", ""), rows, title, [diagnosis.explanation])


def contradicted_in_words(columns: Sequence[str]) -> str:
    """Return the warning that measurements contradict the sheet in these columns."""
    named = joined(columns)
    return f"But the measurements contradict the sheet in {named}: correct that before relying on this verdict."


def sentences_of(text: str) -> list[str]:
    """Return the sentences of an explanation, for a line each."""
    return re.split(r"(?<=[.!?]) (?=[A-Z])", text.strip())


# ------------------------------------------------------------------------------
# Simple laws of a missing force.

# Form of a force, and where along the motions it has the stated size
_LAWS = {
    "constant": ("a constant force of {size}", ""),
    "position": ("a force in proportion to the tail's travel x", "{size} at the end"),
    "speed": ("a force in proportion to the speed ẋ", "{size} at the highest"),
    "speed_squared": ("a force in proportion to ẋ²", "{size} at the highest speed"),
    "position_squared": ("a force in proportion to x²", "{size} at the end"),
    "beyond_a_place": ("a force that rises in proportion to the growth beyond {scale_mm} mm", "{size} at the end"),
    "speed_cubed": ("a force in proportion to ẋ³", "{size} at the highest speed"),
    "beyond_a_speed": ("a force in proportion to the excess of ẋ over {scale} m/s", "{size} at the highest speed"),
    "squared_beyond_a_speed": (
        "a force in proportion to the square of the excess of ẋ over {scale} m/s",
        "{size} at the highest speed",
    ),
    "pressure": ("a force in proportion to the pressure", "{size} at the highest"),
    "time": ("a force that grows in proportion to time", "{size} at the end of the longest trial"),
    "inverse_speed": ("a force that falls with speed as 1/ẋ", "{size} at {scale} m/s and below"),
    "falling_with_speed": (
        "a force that falls with speed",
        "{size} at the lowest speed, by a factor of e every {scale} m/s of ẋ",
    ),
    "fading_in_time": ("a force that decays in time", "{size} at release, by a factor of e every {scale_ms} ms"),
    "fading_along": (
        "a force that decays along the growth",
        "{size} at the start, by a factor of e every {scale_mm} mm",
    ),
    "patch": ("a force that acts between {low} and {high} mm of growth, {size}", ""),
    "periodic": ("a force that repeats every {scale_mm} mm of growth, {size}", ""),
}


def law_text(law: Law, amplitude_N: Sequence[float], sigma_N: float) -> str:
    """Describe a law of force with its size."""
    if law.kind == "periodic":
        size = f"with an amplitude of {_force_text(math.hypot(*amplitude_N), sigma_N)}"
    else:
        size = f"{'+' if amplitude_N[0] > 0 else ''}{_force_text(amplitude_N[0], sigma_N)}".replace("-", "−")
    form, place = _LAWS[law.kind]
    if law.factor:
        by = {"position": "the tail's travel x", "speed": "the speed ẋ", "pressure": "the pressure"}[law.factor]
        form, place = f"{form}, times {by}", "{size} at its largest"
    text = (f"{form}, {place}" if place else form).format(
        size=size,
        low=f"{1e3 * max(law.low, 0.0):.0f}",
        high=f"{1e3 * law.high:.0f}",
        scale_mm=_whole_or_two_digits(1e3 * law.scale),
        scale_ms=_whole_or_two_digits(1e3 * law.scale),
        scale=f"{law.scale:.2g}",
    )
    return f"{text}, in proportion to the cross-section of the vine" if law.reference_area_m2 else text


def _whole_or_two_digits(value: float) -> str:
    return f"{value:.0f}" if value >= 10 else f"{value:.2g}"


def _force_text(value_N: float, sigma_N: float) -> str:
    if not math.isfinite(sigma_N):
        return "any size"
    digits = decimals(sigma_N)
    return f"{value_N:.{digits}f} ± {sigma_N:.{digits}f} N"


# Remarks that take more than a template, by their codes
REMARKS: dict[str, Callable[..., str]] = {
    "odd_trials": odd_in_words,
    "odd_trials_decide": odd_deciding_in_words,
    "frames_missing": dropped_in_words,
    "frames_perhaps_missing": perhaps_dropped_in_words,
    "deciding_measurements": measurement_text,
    "measure_first": measure_first_text,
    "no_feasible_trial": lambda measurement: f"No trial within the limits can be made and simulated. {measurement}",
    "trials_to_make": advice_text,
    "no_trials_separate": partial(advice_text, worth_it=False),
    "detectable": lambda power: "\n".join([false_alarm_sentence(power), *could_have_seen(power)]),
    "diagnosis_page": diagnosis_page,
    "law": law_text,
}
