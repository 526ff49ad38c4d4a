"""Results in words: the only room with prose. A result or a remark (a code with its numbers) becomes sentences here."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

# A sentence of each remark; longer ones are functions in `diagnosis_text.REMARKS`
SENTENCES = {
    "in_measured_pressure": "the measured pressure already includes it",
    "no_measured_pressure": "it needs a pressure measured during growth, and no trial has one",
    "column_blank": "it needs `{column}`, which is blank or zero for every trial",
    "no_response": "no trial responds to it at any plausible size",
    "too_weak_here": "in these conditions the largest plausible size would not be detected",
    "contains": "it contains {name} as a limit",
    "contains_and_fits_no_better": "it contains {name} as a limit and fits no better",
    "size_may_be_zero": "its size, {symbol} = {value:.2g} ± {sigma:.2g}, is compatible with none",
    "outside_plausible_range": "its size lies outside the plausible range",
    "misfit_remains": "a significant misfit remains once it is added",
    "too_weak_in_set": "{effect} reaches {sigmas:.1f} σ given the others, and {required:.1f} σ are required",
    "gain_within_chance": "its gain over the best smaller set is within chance",
    "excess_counted_as_noise": "the residuals exceed the noise of the trials, and the sizes count the excess as noise",
    "no_law_detected": "No simple law of force is detected in the misfit of the model",
    "no_law_predicts_better": "No simple law of force both explains the misfit and predicts left-out conditions better",
    "no_ladder": "The ladder of errors could not be computed: {error}",
    "no_next_experiment": "No next experiment could be computed: {error}",
    "not_located": "Where the model fails could not be computed: {error}",
    "no_missing_force": "The missing force could not be computed: {error}",
    "fails_in": "It fails in {count} of {total} conditions by more than the scatter of replicates.",
    "undetermined_vine": "no other condition of the vine {vine} determines its parameters",
    "no_smooth_force": "No smooth force on the tail explains the misfit: a separate one in every condition takes away "
    "{reduction:.0%} of it. Either it is no force, or the model is too far off to say.",
    "no_law_agreed_on": "What is missing is no simple law of force that single trials agree on.",
    "no_further_force": "No further force on the tail is significant beyond the scatter between trials.",
    # Origins of the inputs of a prediction, and why they are uncertain
    "given": "given",
    "set": "set",
    "constant": "constant",
    "fitted": "fitted, {source}",
    "printed": "printed, {source}",
    "typical_size": "typical size, without an error",
    "B_guessed": "guess: 6.44 (t/200 µm)(D/24 mm)^0.75",
    "B_scaled": "scaled from {vine} of {source} as t·D^0.75: a guess",
    "P_y_guessed": "guess: the one that is printed, for another vine",
    "B_given": "B is given to {percent:.2g} % (one standard deviation)",
    "printed_B_scatter": "the four printed B scatter by {printed:.0f} % about it: {here:.0f} % at this size (Student's "
    "t, {dof} degrees of freedom)",
    "one_t_over_D": "B is printed for one t/D only: exponents of t and D ±{sigma:g} against each other, {here:.0f} % "
    "at this t/D",
    "spread": "{origin}: {percent:.2g} %",
    "B_printed": "the error of the printed B is not printed: assumed to be {percent:.0f} %",
    "n_given": "n is given to {error:.2g} (one standard deviation)",
    "n_printed": "±{error:.2g}, from the printed R² of the fits",
    "P_y_stated": "stated to {kPa:.2g} kPa",
    "P_y_printed": "printed to a whole number: ±{kPa:.2g} kPa",
    "P_y_guess": "{kPa:g} kPa is printed for one vine; nine of ten others within a factor 3",
    "uniform": "{symbol} of {effect} uniform between {low:g} and {high:g}",
    "with_covariance": "{names} of {source}, with their covariance ({count} trials)",
    # Warnings about a vine not yet built
    "B_carried_over": "no vine of {source} has this diameter and wall: B is carried over from {vine} by the scaling "
    "prior, a guess",
    "not_determined": "{source} does not determine {names}: kept at the fitted values, without an error",
    "implausible": "{symbol} of {effect} is outside its plausible range, {low:g} to {high:g}{unit}",
    "bursts": "the vine would burst: its hoop stress PD/2t is {MPa:.3g} MPa, film is guessed to burst at {burst_MPa:g} "
    "MPa, so at {burst_kPa:.3g} kPa; lower the pressure or thicken the wall",
    "nearly_bursts": "the vine is about to burst: its hoop stress PD/2t is {MPa:.3g} MPa, film is guessed to burst at "
    "{burst_MPa:g} MPa, so at {burst_kPa:.3g} kPa (a guess from one vine)",
    "below_yield": "{kPa:g} kPa lies below the yield pressure, {yield_kPa:.3g} kPa ({low_kPa:.2g} to {high_kPa:.2g}): "
    "nothing would evert; raise the pressure",
    "stalls": "in {share:.0%} of the draws the vine does not grow to its end; raise the pressure or measure its yield "
    "pressure",
    "rule": "{words}",
    "fit_not_diagnosed": "{folder} has no diagnosis: it is unknown whether this model describes the trials",
    "from_final_model": "predicted from the final model of the diagnosis, with {added} added",
    "from_refuted_model": "the following is nevertheless predicted from {model}",
    "final_speed": "final speed: of the leading edge; at y/L = 1, of a payload as it leaves the vine",
    "film_uncertain": "the choice of film is uncertain: {um:g} µm is the fastest in only {odds:.0%} of the draws; "
    "measuring B and P_y of the first two films would decide it",
    "supply_needs_wall": "--supply-s needs --thickness-um: how fast the vine takes up gas depends on its wall",
    "keeps_pressure": "closed chamber that keeps the gauge pressure within {percent:g} %, by the gas law in absolute "
    "pressure",
    "slow_and_fast": "slow: γ = 1, isothermal; fast: γ = 1.4, adiabatic, as within milliseconds",
    # Messages of a fit
    "not_converged": "the fit did not converge in {iterations} iterations: its values are not reliable",
    "no_influence": "{title} ({key}) has no influence on the trajectories: it stays at {value:.4g}",
    "at_bound": "{title} ({key}) sits at its bound {bound:.4g}: the data favour values outside",
    "correlated": "{first} and {second} are strongly correlated ({correlation:.3f})",
    "weighted_by_speed": "the noise of positions grows with speed, by {blur_us:.2g} µs × speed: points are weighted "
    "accordingly",
    "weighted_as_stated": "points are weighted by the standard deviations that their files state",
    "smoothed": "{note}",
    "with_corrected_times": "With corrected times: {verdict}. {explanation}",
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

    return REMARKS[code](**facts) if code in REMARKS else SENTENCES[code].format_map(facts)
