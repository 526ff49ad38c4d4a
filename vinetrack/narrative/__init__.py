"""Results in words: the only room with prose. A result or a remark (a code with its numbers) becomes sentences here."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from vinetrack.diagnosis.remarks import joined

# A sentence of each remark; longer ones are functions in `diagnosis_text.REMARKS`
SENTENCES = {
    "in_measured_pressure": "the measured pressure already includes it",
    "no_measured_pressure": "it needs a pressure measured during growth, and no trial has one",
    "column_blank": "it needs `{column}`, which is blank or zero for every trial",
    "columns_partly_blank": "it needs `{columns}`, which the sheet leaves blank for some trials",
    "no_tube": "it acts on {column}, and a body that moves as a whole has none",
    "no_response": "no trial responds to it at any plausible size",
    "too_weak_here": "in these conditions the largest plausible size would not be detected",
    "contains": "it contains {name} as a limit",
    "contains_and_fits_no_better": "it contains {name} as a limit and fits no better",
    "behind_in_one_trial_each": "fitted to one trial of every condition, worse by Δχ² = {delta_chi2:.0f}",
    "size_may_be_zero": "its size, {symbol} = {value:.2g} ± {sigma:.2g}, is compatible with none",
    "implausible_size": "it would need {symbol} = {value:.3g}{unit}, and {low:.3g} to {high:.3g} is plausible",
    "outside_plausible_range": "its size lies outside the plausible range",
    "misfit_remains": "a significant misfit remains once it is added",
    "too_weak_in_set": "{effect} reaches {sigmas:.1f} σ given the others, and {required:.1f} σ are required",
    "gain_within_chance": "its gain over the best smaller set is within chance",
    "several_missing": "{count} effects are missing: none alone removes the misfit",
    "not_tried": "Not tried, because the sheet does not state what they need: {names}.",
    "excess_counted_as_noise": "the residuals exceed the noise of the trials, and the sizes count the excess as noise",
    "no_law_detected": "No simple law of force is detected in the misfit of the model",
    "no_law_predicts_better": "No simple law of force both explains the misfit and predicts left-out conditions better",
    "no_ladder": "The ladder of errors could not be computed: {error}",
    "no_next_experiment": "No next experiment could be computed: {error}",
    "not_located": "Where the model fails could not be computed: {error}",
    "no_missing_force": "The missing force could not be computed: {error}",
    "left_out_error_does_not_fall": "Against this verdict: The error on left-out conditions does not fall with {name}: "
    "{without_mm:.2f} mm without it, {with_mm:.2f} mm with it. The data support {name} by the shape of the motion "
    "alone.",
    "still_drifts": "Against this verdict: With {model}: {drift}",
    "left_out_error_without": "The error on {left_out} is without {trials}, unlike that in sample: {reason}",
    "with_corrected_times": "With corrected times: {verdict}. {explanation}",
}
# What facts are called in a sentence
_NAMES: dict[Any, str] = {
    "chamber_l": "the gas of a chamber",
    "inlet_mm": "the gas of a chamber",
    "yield_pressure_kPa": "a tube under pressure",
    "conditions": "left-out conditions",
    "highest_pressure": "the left-out highest pressure",
    2: "two",
    3: "three",
    4: "four",
    5: "five",
}


def in_words(told: Any) -> str:
    """Return a remark or a result of the diagnosis in words."""
    from vinetrack.narrative.diagnosis_text import diagnosis_text, power_lines
    from vinetrack.narrative.verdict_text import estimates_text, explain

    makers: dict[str, Callable[[Any], str]] = {
        "Remark": lambda remark: sentence(remark.code, remark.facts),
        "SelectionStep": explain,
        "Candidate": estimates_text,
        "Diagnosis": diagnosis_text,
        "Power": lambda power: "\n".join(power_lines(power)),
    }
    return str(makers[type(told).__name__](told))


def sentence(code: str, facts: Mapping[str, Any]) -> str:
    """Return the sentence of a remark."""
    from vinetrack.narrative.diagnosis_text import REMARKS

    if code in REMARKS:
        return REMARKS[code](**facts)
    shown = dict(facts)
    if code == "no_tube":
        shown["column"] = _NAMES[shown["column"]]
    elif code == "columns_partly_blank":
        shown["columns"] = "` and `".join(shown["columns"])
    elif code == "left_out_error_does_not_fall":
        shown |= {"without_mm": 1e3 * shown["without_m"], "with_mm": 1e3 * shown["with_m"]}
    elif code == "left_out_error_without":
        count = shown["count"]
        shown |= {"left_out": _NAMES[shown["left_out"]], "trials": f"{count} trial{'s' if count > 1 else ''}"}
    elif code == "several_missing":
        shown["count"] = _NAMES[shown["count"]]
    elif code == "still_drifts":
        shown["model"] = " + ".join(shown["model"])
    elif code == "not_tried":
        shown["names"] = joined(shown["names"])
    elif code == "implausible_size":
        shown["unit"] = f" {shown['unit']}" if shown["unit"] else ""
    return SENTENCES[code].format_map(shown)
