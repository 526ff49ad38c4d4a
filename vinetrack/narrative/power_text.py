"""The power of a campaign in sentences: what it would have shown, what not, and how often it raises a false alarm."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from vinetrack.core.numbers import number
from vinetrack.core.units import display_unit
from vinetrack.narrative.verdict_summary import joined, listed, plain

if TYPE_CHECKING:
    from vinetrack.diagnosis.power import EffectPower, FurtherTrials, NumberWidth, Power

HARDLY_EVER = 0.1
"""Probability below which an effect is found "hardly ever". Chosen: one campaign in ten; with one in twenty the size
that is named is smaller by a tenth."""

MOST_TOLD = 4
"""Effects that are told of in sentences. Chosen: the table above them has all; twice as many would not be read."""

_IN_WORDS = (
    (0.95, "nearly always"), (0.85, "nine times in ten"), (0.71, "three times in four"), (0.6, "two times in three"),
    (0.42, "every other time"), (0.29, "one time in three"), (0.22, "one time in four"), (0.17, "one time in five"),
    (0.07, "one time in ten"), (0.0, "one time in twenty"),
)  # fmt: skip


def frequency(probability: float) -> str:
    """Return a probability as people say it.

    Parameters
    ----------
    probability : 0 to 1.

    Returns
    -------
    str

    >>> frequency(0.27), frequency(0.9)
    ('one time in four', 'nine times in ten')
    """
    return next(words for least, words in _IN_WORDS if probability >= least)


def percent(rate: float) -> str:
    """Return a rate in per cent, two digits.

    Parameters
    ----------
    rate : 0 to 1.

    Returns
    -------
    str
    """
    return f"{number(100 * rate, 2)} %"


def size_text(power: EffectPower, value: float) -> str:
    """Return a value of the effect's parameter in its display unit, two digits; "–" where there is none.

    Parameters
    ----------
    power : of the effect.
    value : SI.

    Returns
    -------
    str
    """
    if not math.isfinite(value):
        return "–"
    unit, factor = display_unit(power.unit)
    return f"{number(factor * value, 2)} {unit}".strip()


def effect_sentence(power: EffectPower, n_trials: int) -> str:
    """Return what the trials show of one effect, in a sentence.

    Parameters
    ----------
    power : of the effect.
    n_trials : how many trials there are.

    Returns
    -------
    str
    """
    trials = f"these {n_trials} trials" if n_trials != 1 else "this trial"
    show = "show" if n_trials != 1 else "shows"
    name = f"{power.symbol} of {plain(power.effect)}"
    top, seen = size_text(power, power.largest), power.probability_at(power.largest)
    at_90, at_few = power.size_at(0.9), power.size_at(HARDLY_EVER)
    beyond = "beyond" if power.largest > power.zero else "below"
    within = "short of" if power.largest > power.zero else "above"
    if seen < HARDLY_EVER:
        text = f"{trials} hardly ever {show} {name}, even at its largest plausible size, {top}"
    elif seen < 0.9:
        text = f"{trials} {show} {name} {frequency(seen)} at its largest plausible size, {top}"
    elif power.least != power.zero and power.probability_at(power.least) >= 0.9:
        text = f"{trials} {show} {name} at any plausible size ({size_text(power, at_90)} nine times in ten)"
    else:
        text = (
            f"{trials} {show} {name} {beyond} {size_text(power, at_90)} nine times in ten; "
            f"{within} {size_text(power, at_few)} hardly ever"
        )
    if power.taken_for and seen >= HARDLY_EVER:
        taken = ", ".join(f"{plain(other)} {frequency(rate)}" for other, rate in list(power.taken_for.items())[:2])
        text += f"; it would be called {taken}"
    return text[0].upper() + text[1:] + "."


def false_alarm_sentence(power: Power) -> str:
    """Return how often such trials say that something is missing where nothing is.

    Parameters
    ----------
    power : of the trials.

    Returns
    -------
    str
    """
    return (
        f"Where nothing is missing, such trials raise a false alarm in at most {percent(power.false_alarm_rate)} of "
        "campaigns, if noise and scatter are as the fit holds them."
    )


def power_brief(power: Power) -> str:
    """Return what must stand beside a verdict, in one clause: false alarms, and how many effects would have been found.

    Parameters
    ----------
    power : of the trials.

    Returns
    -------
    str
    """
    alarms = f"false alarms in at most {percent(power.false_alarm_rate)} of such campaigns"
    if power.wary or not power.effects:
        return alarms
    seen = sum(entry.probability_at(entry.largest) >= 0.9 for entry in power.effects)
    total = len(power.effects) + len(power.not_testable)
    return (
        f"{alarms}; {seen} of {total} effects would have been found nine times in ten at their largest plausible size"
    )


def could_have_seen(power: Power) -> list[str]:
    """Return what the trials would have shown nine times in ten and what not even at its largest plausible size.

    Parameters
    ----------
    power : of the trials.

    Returns
    -------
    list of str
        At most three sentences.
    """
    if power.wary:
        return [f"What they could have seen is not worked out: {power.wary}."]
    physical = _physical(power)
    seen = [entry for entry in physical if entry.probability_at(entry.largest) >= 0.9]
    at_times = [entry for entry in physical if HARDLY_EVER <= entry.probability_at(entry.largest) < 0.9]
    lines = []
    if seen:
        sizes = "; ".join(
            f"{plain(entry.effect)} from {entry.symbol} = {size_text(entry, entry.size_at(0.9))}" for entry in seen
        )
        lines.append(f"Found nine times in ten: {sizes}.")
    if at_times:
        parts = [
            f"{plain(entry.effect)} ({frequency(entry.probability_at(entry.largest))} at "
            f"{entry.symbol} = {size_text(entry, entry.largest)})"
            for entry in at_times
        ]
        lines.append(f"Found at times, at the largest plausible size: {joined(parts)}.")
    if blind := unseen(power):
        lines.append(f"Could not have been seen: {listed(blind)}.")
    return lines


def unseen(power: Power) -> list[str]:
    """Return the physical effects that the trials show hardly ever even at their largest plausible size, or not at all.

    Parameters
    ----------
    power : of the trials.

    Returns
    -------
    list of str
        Names of effects; of all kinds where none is physical.
    """
    never = [entry.effect for entry in _physical(power) if entry.probability_at(entry.largest) < HARDLY_EVER]
    return [*never, *(name for name in power.not_testable if name not in never)]


def _physical(power: Power) -> list[EffectPower]:
    """The physical effects, all effects where there are none."""
    return [entry for entry in power.effects if entry.kind == "physical"] or list(power.effects)


def width_text(width: NumberWidth) -> str:
    """Return the half width of the 95 % interval of a number.

    Parameters
    ----------
    width : of n or a B.

    Returns
    -------
    str
    """
    title = f"{width.name} ({width.vine})" if width.vine else width.name
    half = percent(width.half_width) if width.is_relative else number(width.half_width, 2)
    return f"{title} ± {half}"


def power_rows(effects: Sequence[EffectPower]) -> list[tuple[str, str, str, str, str, str, str]]:
    """Return a row an effect: name, symbol, sizes found with 50 and 90 %, largest plausible, found there, taken for.

    Parameters
    ----------
    effects : of the trials.

    Returns
    -------
    list of tuple of str
    """
    rows = []
    for entry in effects:
        taken = ", ".join(f"{plain(other)} {percent(rate)}" for other, rate in list(entry.taken_for.items())[:3])
        rows.append(
            (
                plain(entry.effect),
                entry.symbol,
                size_text(entry, entry.size_at(0.5)),
                size_text(entry, entry.size_at(0.9)),
                size_text(entry, entry.largest),
                percent(entry.probability_at(entry.largest)),
                taken or "–",
            )
        )
    return rows


HEAD = ("effect", "", "found 50 %", "found 90 %", "largest plausible", "found there", "taken for (at 90 %)")


def power_lines(power: Power) -> list[str]:
    """Return what `vinetrack power` prints.

    Parameters
    ----------
    power : of the trials.

    Returns
    -------
    list of str
    """
    lines = [f"What {power.n_trials} trials can show of effects beside {' + '.join(power.model)}"]
    lines += [f"  {entry.name}: {entry.value} ({entry.origin})" for entry in power.inputs]
    if power.wary:
        lines.append(f"! {power.wary}")
    lines += _size_table(power.effects)
    lines += [f"  not testable: {plain(name)}: {why}" for name, why in power.not_testable.items()]
    lines += [effect_sentence(entry, power.n_trials) for entry in _told(power)]
    lines += [false_alarm_sentence(power)]
    if power.numbers:
        lines.append(f"95 % intervals: {', '.join(map(width_text, power.numbers))}.")
    if power.calibration is not None:
        from vinetrack.narrative.calibration_text import calibration_lines

        lines += ["", *calibration_lines(power.calibration)]
    for plan in power.further:
        lines += ["", *further_lines(plan)]
    return lines + simulated_lines(power)


def _size_table(effects: Sequence[EffectPower]) -> list[str]:
    """A row an effect, those that can be seen first."""
    rows = [HEAD, *power_rows(sorted(effects, key=lambda entry: (not entry.is_visible, entry.effect)))]
    widths = [max(len(row[k]) for row in rows) for k in range(len(HEAD))]
    return [
        ("  " + "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True))).rstrip() for row in rows
    ]


def seen_lines(power: Power) -> list[str]:
    """Return what a campaign designed for n and B could see of other effects.

    Parameters
    ----------
    power : of the campaign.

    Returns
    -------
    list of str
    """
    physical = [entry for entry in power.effects if entry.kind == "physical"]
    head = f"what these {power.n_trials} trials could see of physics that their model lacks, by linear theory:"
    return [head, *_size_table(physical), false_alarm_sentence(power)]


def _told(power: Power) -> list[EffectPower]:
    """The effects that are told of in a sentence each: few, else those hardest to see among the visible ones."""
    if len(power.effects) <= MOST_TOLD:
        return list(power.effects)
    physical = [entry for entry in power.effects if entry.kind == "physical"]
    return sorted(physical, key=lambda entry: entry.probability_at(entry.largest))[:MOST_TOLD]


def simulated_lines(power: Power) -> list[str]:
    """Return what complete diagnoses of simulated campaigns said, beside what linear theory promises.

    Parameters
    ----------
    power : of the trials.

    Returns
    -------
    list of str
        Empty where no campaign was simulated.
    """
    lines = []
    for rates in power.simulated:
        counted = rates.detections if rates.effect else rates.alarms
        low, high = counted.interval
        rate = f"{counted.count} of {counted.campaigns} ({percent(low)} to {percent(high)} with 95 % confidence)"
        named = ", ".join(f"{names} {count}" for names, count in rates.named[:4])
        if rates.effect:
            entry = power[rates.effect]
            what = f"{plain(rates.effect)} at {entry.symbol} = {size_text(entry, rates.value)}: found in {rate}, "
            what += f"{percent(rates.promised)} by linear theory"
        else:
            what = f"nothing missing: a false alarm in {rate}, at most {percent(rates.promised)} by the tests' levels"
        lines.append(
            what + (f"; named: {named}" if named else "") + (f"; no verdict: {rates.failed}" if rates.failed else "")
        )
    return ["Simulated campaigns, diagnosed from beginning to end:", *(f"  {line}" for line in lines)] if lines else []


def further_lines(plan: FurtherTrials) -> list[str]:
    """Return the trials that bring an effect to the wanted probability, a row a condition, or why none do.

    Parameters
    ----------
    plan : of further trials.

    Returns
    -------
    list of str
    """
    from vinetrack.core.terminal import table
    from vinetrack.diagnosis.power import sheet_cells

    size = size_text(plan.power, plan.value) if plan.power is not None else number(plan.value, 2)
    what = f"{plain(plan.effect)} at {plan.symbol} = {size}"
    if plan.before >= plan.reach:
        return [f"{what} is found in {percent(plan.before)} of campaigns with these trials: none need be added."]
    if not plan.looked_at:
        return [f"{what}: no further trial within `limits` can be made and filmed."]
    count = len(plan.trials)
    lines = [f"To find {what} in {percent(plan.reach)} of campaigns, {percent(plan.before)} now:"]
    rows, done = [], 0
    while done < count:
        added = plan.trials[done]
        same = [other for other in plan.trials[done:] if sheet_cells(other.trial) == sheet_cells(added.trial)]
        times = next((k for k, other in enumerate(plan.trials[done:]) if other not in same), count - done)
        cells = sheet_cells(added.trial)
        changed = [f"{COLUMN_WORDS.get(name, name)} {cells.get(name, math.nan):g}" for name in added.changed]
        new = ["a vine to be made"] if added.new_vine else []
        rows.append(
            (
                str(times), added.trial.vine, f"{cells.get('pressure_kPa', math.nan):g}",
                f"{cells.get('payload_g', 0.0):g}", ", ".join([*new, *changed]) or "–",
                percent(plan.trials[done + times - 1].probability),
            )
        )  # fmt: skip
        done += times
    if rows and plan.after > plan.before:
        head = ("trials", "vine", "pressure", "payload", "what is new", "found then")
        lines += [f"  {line}" for line in table(rows, head, ("", "", "kPa", "g", "", ""), align="><>><>")]
    if not plan.is_reached:
        if plan.endless < plan.reach:
            lines.append(
                f"No number of trials within `limits` gets there: {plan.looked_at} kinds of trial were looked at, and "
                f"all of them, made without end, would find it in {percent(plan.endless)}."
            )
        else:
            lines.append(f"{count} further trials do not get there; more would, up to {percent(plan.endless)}.")
    asked = {"with a new vine"} if any(added.new_vine for added in plan.trials) else set()
    asked |= {"with another rig"} if any(added.changed for added in plan.trials) else set()
    less = [
        f"{words} about {needed}"
        for words, needed in plan.needed.items()
        if asked and words not in asked and needed >= count
    ]
    if plan.is_reached and less:
        lines.append(f"Without what is new: {', '.join(less)} trials.")
    if plan.power is not None and plan.power.taken_for:
        taken = ", ".join(f"{plain(other)} {percent(rate)}" for other, rate in list(plan.power.taken_for.items())[:3])
        lines.append(f"With them it would be taken for: {taken} (at the size found nine times in ten).")
    return lines


COLUMN_WORDS = {"chamber_l": "chamber (l)", "inlet_mm": "inlet (mm)", "growth_angle_deg": "angle (°)"}
"""What of a rig may change from trial to trial, as it is printed."""
