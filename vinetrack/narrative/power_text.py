"""The power of a campaign in sentences: detectable sizes of effects, undetectable effects, false-alarm rate."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from vinetrack.core.units import display_unit, number
from vinetrack.diagnosis.remarks import joined
from vinetrack.effects import Effect, remedy, told_apart
from vinetrack.experiment.schema import COLUMNS, LIMITED
from vinetrack.narrative.verdict_text import MOST_NAMED, listed_names, spaced_name

if TYPE_CHECKING:
    from vinetrack.diagnosis.further_trials import InformativeTrials
    from vinetrack.diagnosis.power import EffectPower, FurtherTrials, NumberWidth, Power
    from vinetrack.diagnosis.remarks import Remark


LOW_POWER = 0.1  # Power below which an effect counts as undetectable (chosen)


AT_LARGEST = "with 90 % power at their largest plausible size"  # Follows the number of detectable effects


def percent(rate: float) -> str:
    """Return a rate in per cent, two digits."""
    return f"{number(100 * rate, 2)} %"


def size_text(power: EffectPower, value: float) -> str:
    """Return a value of the effect's parameter in its display unit, two digits; "–" where there is none."""
    if not math.isfinite(value):
        return "–"
    unit, factor = display_unit(power.unit)
    return f"{number(factor * value, 2)} {unit}".strip()


def effect_sentence(power: EffectPower, n_trials: int) -> str:
    """Return the sizes of one effect that the trials detect, in a sentence."""
    trials, detect = (f"These {n_trials} trials", "detect") if n_trials != 1 else ("This trial", "detects")
    name, symbol = spaced_name(power.effect), power.symbol
    largest, at_largest = size_text(power, power.largest), power.probability_at(power.largest)
    if at_largest < LOW_POWER:
        text = (
            f"{trials} {detect} {name} with less than {percent(LOW_POWER)} power even at its largest plausible size, "
            f"{symbol} = {largest}"
        )
    elif at_largest < 0.9:
        text = (
            f"{trials} {detect} {name} with {percent(at_largest)} power at its largest plausible size, "
            f"{symbol} = {largest}"
        )
    elif power.least != power.zero and power.probability_at(power.least) >= 0.9:
        text = (
            f"{trials} {detect} {name} of any plausible size (90 % power at {symbol} = "
            f"{size_text(power, power.size_at(0.9))})"
        )
    else:
        beyond, within = ("above", "below") if power.largest > power.zero else ("below", "above")
        text = (
            f"{trials} {detect} {name} with at least 90 % power {beyond} {symbol} = "
            f"{size_text(power, power.size_at(0.9))}, and with less than {percent(LOW_POWER)} {within} "
            f"{size_text(power, power.size_at(LOW_POWER))}"
        )
    if power.taken_for and at_largest >= LOW_POWER:
        names = [f"{spaced_name(other)} in {percent(rate)}" for other, rate in list(power.taken_for.items())[:2]]
        text += f"; it would be mistaken for {joined(names)} of campaigns"
    return f"{text}."


def false_alarm_sentence(power: Power) -> str:
    """Return the false-alarm rate of such trials: how often something is called missing where nothing is."""
    return (
        f"If nothing is missing, such trials raise a false alarm in at most {percent(power.false_alarm_rate)} of "
        "campaigns, provided that noise and scatter are as fitted."
    )


def power_brief(power: Power) -> str:
    """Return the false-alarm rate and the number of detectable effects, which must stand beside a verdict."""
    alarms = f"false alarms in at most {percent(power.false_alarm_rate)} of such campaigns"
    if power.wary or not power.effects:
        return alarms
    return f"{alarms}; {detectable_count(power)} would have been detected {AT_LARGEST}"


def detectable_count(power: Power) -> str:
    """Return how many effects the trials detect with 90 % power at their largest plausible size."""
    n_detectable = sum(entry.probability_at(entry.largest) >= 0.9 for entry in power.effects)
    return f"{n_detectable} of {len(power.effects) + len(power.not_testable)} effects"


def could_have_seen(power: Power) -> list[str]:
    """Return the sizes that the trials detect with 90 % power, and the effects that they do not detect."""
    if power.wary:
        return [f"Detectable sizes were not computed: {power.wary}."]
    physical = _physical(power)
    detectable = [entry for entry in physical if entry.probability_at(entry.largest) >= 0.9]
    sometimes = [entry for entry in physical if LOW_POWER <= entry.probability_at(entry.largest) < 0.9]
    lines = []
    if detectable:
        sizes = "; ".join(
            f"{spaced_name(entry.effect)} from {entry.symbol} = {size_text(entry, entry.size_at(0.9))}"
            for entry in detectable
        )
        lines.append(f"Detectable with 90 % power: {sizes}.")
    if sometimes:
        parts = [
            f"{spaced_name(entry.effect)} ({percent(entry.probability_at(entry.largest))} at "
            f"{entry.symbol} = {size_text(entry, entry.largest)})"
            for entry in sometimes
        ]
        lines.append(f"Detectable with less power, even at the largest plausible size: {joined(parts)}.")
    if undetectable := unseen(power):
        lines.append(f"Not detectable: {listed_names(undetectable)}.")
    return lines


def unseen(power: Power) -> list[str]:
    """Return the physical effects that are not testable, or detected with less than 10 % power at any
    plausible size.
    """
    undetectable = [entry.effect for entry in _physical(power) if entry.probability_at(entry.largest) < LOW_POWER]
    return [*undetectable, *(name for name in power.not_testable if name not in undetectable)]


def _physical(power: Power) -> list[EffectPower]:
    """The physical effects; all effects where none is physical."""
    return [entry for entry in power.effects if entry.kind == "physical"] or list(power.effects)


def width_text(width: NumberWidth) -> str:
    """Return the half width of the 95 % interval of a parameter: `n ± 0.0075`."""
    title = f"{width.name} ({width.vine})" if width.vine else width.name
    half = percent(width.half_width) if width.is_relative else number(width.half_width, 2)
    return f"{title} ± {half}"


def power_rows(effects: Sequence[EffectPower]) -> list[tuple[str, str, str, str, str, str, str]]:
    """Return a row for each effect, with the columns of `POWER_COLUMNS`."""
    rows = []
    for entry in effects:
        taken = ", ".join(f"{spaced_name(other)} {percent(rate)}" for other, rate in list(entry.taken_for.items())[:3])
        rows.append(
            (
                spaced_name(entry.effect),
                entry.symbol,
                size_text(entry, entry.size_at(0.5)),
                size_text(entry, entry.size_at(0.9)),
                size_text(entry, entry.largest),
                percent(entry.probability_at(entry.largest)),
                taken or "–",
            )
        )
    return rows


POWER_COLUMNS = (
    "effect",
    "",
    "50 % power",
    "90 % power",
    "largest plausible",
    "power there",
    "mistaken for (at 90 %)",
)  # Headings of `power_rows`


def power_lines(power: Power) -> list[str]:
    """Return what `vinetrack power` prints."""
    lines = [f"Power of {power.n_trials} trials to detect effects beyond {' + '.join(power.model)}"]
    lines += [f"  {entry.name}: {entry.value} ({entry.origin})" for entry in power.inputs]
    if power.wary:
        lines.append(f"! {power.wary}")
    lines += _size_table(power.effects)
    lines += [f"  not testable: {spaced_name(name)}: {why}" for name, why in power.not_testable.items()]
    lines += [effect_sentence(entry, power.n_trials) for entry in _effects_in_sentences(power)]
    lines += [false_alarm_sentence(power)]
    if power.numbers:
        lines.append(f"95 % intervals: {', '.join(map(width_text, power.numbers))}.")
    if power.recommended is not None:
        lines += ["", informative_text(power.recommended)]
    for plan in power.further:
        lines += ["", *further_lines(plan)]
    return lines + simulated_lines(power)


def _size_table(effects: Sequence[EffectPower]) -> list[str]:
    """A row for each effect, detectable ones first."""
    rows = [POWER_COLUMNS, *power_rows(sorted(effects, key=lambda entry: (not entry.is_visible, entry.effect)))]
    widths = [max(len(row[k]) for row in rows) for k in range(len(POWER_COLUMNS))]
    return [
        ("  " + "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True))).rstrip() for row in rows
    ]


def _effects_in_sentences(power: Power) -> list[EffectPower]:
    """All effects if they are few, else the physical ones of the lowest power."""
    most_sentences = 4  # Effects that get a sentence each, at most (chosen)
    if len(power.effects) <= most_sentences:
        return list(power.effects)
    physical = [entry for entry in power.effects if entry.kind == "physical"]
    return sorted(physical, key=lambda entry: entry.probability_at(entry.largest))[:most_sentences]


def simulated_lines(power: Power) -> list[str]:
    """Return the detection and false-alarm rates of simulated campaigns beside those of linear theory."""
    lines = []
    for rates in power.simulated:
        counted = rates.detections if rates.effect else rates.alarms
        low, high = counted.interval
        rate = f"{counted.count} of {counted.campaigns} ({percent(low)} to {percent(high)} with 95 % confidence)"
        named = ", ".join(f"{names} {count}" for names, count in rates.named[:4])
        if rates.effect:
            entry = power[rates.effect]
            what = (
                f"{spaced_name(rates.effect)} at {entry.symbol} = {size_text(entry, rates.value)}: detected in {rate}, "
            )
            what += f"{percent(rates.promised)} by linear theory"
        else:
            what = f"nothing missing: a false alarm in {rate}, at most {percent(rates.promised)} by the tests' levels"
        lines.append(
            what + (f"; named: {named}" if named else "") + (f"; no verdict: {rates.failed}" if rates.failed else "")
        )
    return ["Simulated campaigns, each diagnosed in full:", *(f"  {line}" for line in lines)] if lines else []


def further_lines(plan: FurtherTrials) -> list[str]:
    """Return the further trials with which an effect is detected with the wanted power, a row for each condition."""
    from vinetrack.core.terminal import table
    from vinetrack.diagnosis.power import sheet_cells

    size = size_text(plan.power, plan.value) if plan.power is not None else number(plan.value, 2)
    what = f"{spaced_name(plan.effect)} at {plan.symbol} = {size}"
    if plan.before >= plan.target:
        return [f"{what} is detected with {percent(plan.before)} power by these trials: none need be added."]
    if not plan.n_conditions:
        return [f"{what}: no further trial within `limits` can be made and filmed."]
    count = len(plan.trials)
    lines = [f"To detect {what} with {percent(plan.target)} power ({percent(plan.before)} with the trials so far):"]
    rows, done = [], 0
    while done < count:
        added = plan.trials[done]
        same = [other for other in plan.trials[done:] if sheet_cells(other.trial) == sheet_cells(added.trial)]
        times = next((k for k, other in enumerate(plan.trials[done:]) if other not in same), count - done)
        cells = sheet_cells(added.trial)
        changed = [f"{COLUMN_WORDS.get(name, name)} {cells.get(name, math.nan):g}" for name in added.changed]
        new = ["a new vine"] if added.new_vine else []
        rows.append(
            (
                str(times), added.trial.vine, f"{cells.get('pressure_kPa', math.nan):g}",
                f"{cells.get('payload_g', 0.0):g}", ", ".join([*new, *changed]) or "–",
                percent(plan.trials[done + times - 1].probability),
            )
        )  # fmt: skip
        done += times
    if rows and plan.after > plan.before:
        head = ("trials", "vine", "pressure", "payload", "new", "power then")
        lines += [f"  {line}" for line in table(rows, head, ("", "", "kPa", "g", "", ""), align="><>><>")]
    if not plan.is_reached:
        if plan.unlimited < plan.target:
            lines.append(
                f"No number of trials within `limits` suffices: with unlimited replicates of all {plan.n_conditions} "
                f"conditions considered, the power would be {percent(plan.unlimited)}."
            )
        else:
            lines.append(f"{count} further trials do not suffice; more would, up to {percent(plan.unlimited)} power.")
    changes = {"with a new vine"} if any(added.new_vine for added in plan.trials) else set()
    changes |= {"with another rig"} if any(added.changed for added in plan.trials) else set()
    alternatives = [
        f"{words} about {needed}"
        for words, needed in plan.needed.items()
        if changes and words not in changes and needed >= count
    ]
    if plan.is_reached and alternatives:
        lines.append(f"Without these changes: {', '.join(alternatives)} trials.")
    if plan.power is not None and plan.power.taken_for:
        names = [f"{spaced_name(other)} in {percent(rate)}" for other, rate in list(plan.power.taken_for.items())[:3]]
        lines.append(f"With them it would be mistaken for {joined(names)} of campaigns (at the size of 90 % power).")
    return lines


# Columns of the rig that a further trial may change, as printed
COLUMN_WORDS = {"chamber_l": "chamber (l)", "inlet_mm": "inlet (mm)", "growth_angle_deg": "angle (°)"}


# ------------------------------------------------------------------------------
# The next experiment in sentences: trials to make, hypotheses that they separate, and what to measure instead.


def measurement_text(trace_decides: bool, effects: Sequence[Effect], faults_only: bool) -> str:
    """Return what to measure in order to exclude one of the hypotheses, as the files of their effects state."""
    with_trace = (
        "Record the pressure at the vine during growth and give it with the track: the pressure in the chamber is then"
        " measured, and only the other hypothesis can explain a remaining misfit."
    )
    sentences = [with_trace] if trace_decides else []
    for effect in effects:
        words = " ".join(filter(None, ("" if faults_only else told_apart(effect), remedy(effect))))
        if words:
            sentences.append(f"{effect.name}: {words[0].lower()}{words[1:]}")
    return " ".join(sentences)


def trials_in_words(trials: Sequence[Mapping[str, Any]]) -> str:
    """Return the trials to make, as a list within a sentence."""
    return "; ".join(_trial_in_words(trial) for trial in trials)


def _trial_in_words(trial: Mapping[str, Any]) -> str:
    count = trial["replicates"]
    words = f"{count} {'trial' if count == 1 else 'trials'} at {trial['pressure_kPa']:.3g} kPa"
    if trial["payload_g"]:
        words += f" with {trial['payload_g']:.3g} g"
    size = f"{trial['diameter_mm']:.3g} mm × {trial['thickness_um']:.3g} µm × {trial['length_mm']:.3g} mm"
    words += f" with {'a new' if trial['new_vine'] else 'the'} vine of {size}"
    changed = [COLUMNS[key].in_words(trial[key]) for key in LIMITED["choice"] if key in trial["changed"]]
    return f"{words}, {' and '.join(changed)}" if changed else words


def separation_text(
    if_true: Mapping[str, Mapping[str, float]], simulated: Mapping[str, tuple[float, float]] | None = None
) -> str:
    """Return the expected significance with which the trials separate each pair of hypotheses."""
    parts = []
    for pair, by_truth in if_true.items():
        least, most = sorted(by_truth, key=by_truth.__getitem__)
        # 1.5: ratio from which the larger of two expected significances is stated beside the smaller (chosen)
        is_much_larger = by_truth[most] > 1.5 * max(by_truth[least], 1.0)
        notes = [f"{by_truth[most]:.2g} σ if {most} is true"] if is_much_larger else []
        mean, sd = (simulated or {}).get(pair, (math.nan, math.nan))
        if math.isfinite(mean):
            notes.append(f"simulated: {mean:.2g}" + (f" ± {max(sd, 0.1):.1g} σ" if math.isfinite(sd) else " σ"))
        remark = f" ({'; '.join(notes)})" if notes else ""
        parts.append(f"{pair.replace(' | ', ' from ')} by {by_truth[least]:.2g} σ{remark}")
    return ", ".join(parts)


def advice_text(
    trials: Sequence[Mapping[str, Any]],
    if_true: Mapping[str, Mapping[str, float]],
    simulated: Mapping[str, tuple[float, float]],
    unresolved: Sequence[str],
    measurement: Remark,
    least_sigma: float,
    *,
    worth_it: bool = True,
) -> str:
    """Return the advice: the trials to make, the hypotheses that they separate, and what to measure instead."""
    promise, advice = separation_text(if_true, simulated), str(measurement)
    if not worth_it:
        return (
            f"No trials within `limits` separate the tied hypotheses by {least_sigma:g} σ; the best would separate"
            f" {promise}. {advice}".rstrip()
        )
    text = f"Make {trials_in_words(trials)}. Together with the trials so far, they are expected to separate {promise}."
    if any(trial["new_vine"] for trial in trials):
        text += " B of the new vine is predicted here by scaling and will be fitted; measure its yield pressure."
    if unresolved:
        pairs = joined([pair.replace(" | ", " from ") for pair in unresolved])
        text += f" They will not separate {pairs}. {advice}"
    elif advice:
        text += f" A measurement would decide as well: {advice}"
    return text.rstrip()


def measure_first_text(faults: Sequence[str], measurement: Remark) -> str:
    """Return the advice where only faults of the measurement are tied."""
    are = "are errors" if len(faults) > 1 else "is an error"
    return f"Measure before making more trials: {joined(faults)} {are} of measurement. {measurement}"


# ------------------------------------------------------------------------------
# Trials that would reveal most, in words.


def informative_text(plan: InformativeTrials) -> str:
    """Return recommended trials in words, and the detectable sizes that they lower most."""
    before = {entry.effect: entry for entry in plan.now.effects}
    gains = [
        (before[entry.effect], entry, _gain(before[entry.effect], entry))
        for entry in plan.then.effects
        if entry.effect in before and _is_plausible(entry)
    ]
    # 1.1: factor by which a detectable size must fall to be stated (chosen)
    gains = [gain for gain in sorted(gains, key=lambda gain: -gain[2]) if gain[2] > 1.1][:MOST_NAMED]
    lower = [
        f"{spaced_name(then.effect)} from {then.symbol or 'size'} = {size_text(now, now.size_at(0.9))} to "
        f"{size_text(then, then.size_at(0.9))}"
        for now, then, _ in gains
    ]
    sizes = f" They lower the size that is detected with 90 % power: {joined(lower)}." if lower else ""
    made = trials_in_words(plan.trials)
    return f"Make {made}. These trials are expected to reveal most of what could be missing.{sizes}"


def _gain(now: EffectPower, then: EffectPower) -> float:
    """Factor by which the size detected with 90 % power falls; 0 where either is unknown."""
    sizes = [abs(entry.size_at(0.9) - entry.zero) for entry in (now, then)]
    return sizes[0] / sizes[1] if math.isfinite(sizes[0]) and sizes[1] > 0 else 0.0


def _is_plausible(entry: EffectPower) -> bool:
    """Whether the size detected with 90 % power is no larger than the largest plausible one."""
    return abs(entry.size_at(0.9) - entry.zero) <= abs(entry.largest - entry.zero)
