"""Output of `vinetrack diagnose`, `add` and `power`: a whole diagnosis, and the improvement by an added effect."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable, Mapping, Sequence
from itertools import groupby
from typing import TYPE_CHECKING, Any

from vinetrack.core import units
from vinetrack.core.problems import joined
from vinetrack.core.process import table
from vinetrack.core.units import decimals, display_unit, number, pressure_text, with_error, with_interval
from vinetrack.diagnosis.ladder import not_better
from vinetrack.diagnosis.result import EXPECTED, NOT_TESTABLE, Diagnosis, Round
from vinetrack.experiment.schema import COLUMNS, LIMITED
from vinetrack.inference.fit_result import DAMPING
from vinetrack.narrative import sentence
from vinetrack.narrative.verdict_text import (
    SHARED_REMEDIES,
    estimates_text,
    expected_text,
    percent,
    spaced_name,
    value_text,
    verdict_line,
    verdict_table,
)

if TYPE_CHECKING:
    import pandas as pd

    from vinetrack.core.problems import Remark
    from vinetrack.core.records import Trial
    from vinetrack.diagnosis.missing_force import LearnedForce
    from vinetrack.diagnosis.propose import Proposal
    from vinetrack.diagnosis.result import EffectPower, FurtherTrials, Power
    from vinetrack.inference.fit_result import Fit, Number


# ------------------------------------------------------------------------------
# The power of a campaign in sentences: detectable sizes of effects, undetectable effects, false-alarm rate.


def size_text(power: EffectPower, value: float) -> str:
    """Return a value of the effect's parameter in its display unit, two digits; "–" where there is none."""
    if not math.isfinite(value):
        return "–"
    unit, factor = display_unit(power.unit, power.pressure_unit)
    return f"{number(factor * value, 2)} {unit}".strip()


def power_rows(effects: Sequence[EffectPower]) -> list[tuple[str, ...]]:
    """Return a row for each effect, with the columns of `POWER_COLUMNS`."""
    rows = []
    for entry in effects:
        taken = ", ".join(f"{spaced_name(other)} {percent(rate)}" for other, rate in list(entry.taken_for.items())[:3])
        sizes = [size_text(entry, size) for size in (entry.size_at(0.5), entry.size_at(0.9), entry.largest)]
        there = percent(entry.probability_at(entry.largest))
        rows.append((spaced_name(entry.effect), entry.symbol, *sizes, there, taken or "–"))
    return rows


# Headings of `power_rows`
POWER_COLUMNS = ("effect", "", "50 % power", "90 % power", "largest plausible", "power there", "mistaken for (at 90 %)")


def power_lines(power: Power) -> list[str]:
    """Return what `vinetrack power` prints: all effects in a table, visible ones first."""
    listed = power_rows(sorted(power.effects, key=lambda entry: (not entry.is_visible, entry.effect)))
    lines = [f"Power of {_count(power.n_trials, 'trial')} to detect effects beyond {' + '.join(power.model)}"]
    lines += [f"  {entry.name}: {entry.value} ({entry.origin})" for entry in power.inputs]
    if power.wary:
        lines.append(f"! {power.wary}")
    lines += table(listed, POWER_COLUMNS, indent="  ", align="<" * len(POWER_COLUMNS))
    lines += [f"  not testable: {spaced_name(name)}: {why}" for name, why in power.not_testable.items()]
    lines.append(sentence("false_alarms", {"rate": power.false_alarm_rate}))
    halves = [(one, (one.high - one.low) / 2) for one in power.numbers if math.isfinite(one.high - one.low)]
    widths = [
        f"{one.title} ± {percent(half / one.value) if one.key == DAMPING else number(half, 2)}" for one, half in halves
    ]
    lines += [f"95 % intervals: {', '.join(widths)}."] if widths else []
    for plan in power.further:
        lines += ["", *further_lines(plan)]
    # The rates of simulated campaigns beside those of linear theory
    lines += ["Simulated campaigns, each diagnosed in full:"] if power.simulated else []
    for rates in power.simulated:
        facts = {name: getattr(rates, name) for name in ("count", "campaigns", "promised", "failed")}
        facts |= {
            "interval": " to ".join(map(percent, rates.interval)),
            "names": [f"{a} {b}" for a, b in rates.named[:4]],
        }
        if rates.effect:
            entry = power[rates.effect]
            facts["what"] = f"{spaced_name(rates.effect)} at {entry.symbol} = {size_text(entry, rates.value)}"
        lines.append(f"  {sentence('simulated_effect' if rates.effect else 'simulated_null', facts)}")
    return lines


def further_lines(plan: FurtherTrials) -> list[str]:
    """Return the further trials with which an effect is detected with the wanted power, a row for each condition."""
    power = plan.power
    what = f"{spaced_name(power.effect)} at {power.symbol} = {size_text(power, plan.value)}"
    if plan.before >= plan.target:
        return [f"{what} is detected with {percent(plan.before)} power by these trials: none need be added."]
    if not plan.n_conditions:
        return [f"{what}: no further trial within `limits` can be made and filmed."]
    count = len(plan.trials)
    lines = [f"To detect {what} with {percent(plan.target)} power ({percent(plan.before)} with the trials so far):"]
    rows = []
    for trial, group in groupby(plan.trials, key=lambda added: dict(added, probability=None)):
        alike = list(group)
        new = ["a new vine"] if trial["new_vine"] else []
        new += [f"{(c := COLUMNS[name]).quantity} {trial.get(name, math.nan):g} {c.unit}" for name in trial["changed"]]
        pressure = pressure_text(1e3 * trial["pressure_kPa"], trial["pressure_unit"])
        payload, then = f"{trial.get('payload_g', 0.0):g}", percent(alike[-1]["probability"])
        rows.append((str(len(alike)), trial["vine"], pressure, payload, ", ".join(new) or "–", then))
    if rows and plan.after > plan.before:
        head = ("trials", "vine", "pressure", "payload", "new", "power then")
        lines += [f"  {line}" for line in table(rows, head, ("", "", "", "g", "", ""), align="><>><>")]
    if not plan.is_reached:
        if plan.unlimited < plan.target:
            lines.append(sentence("no_number_suffices", {"count": plan.n_conditions, "power": plan.unlimited}))
        else:
            lines.append(f"{count} further trials do not suffice; more would, up to {percent(plan.unlimited)} power.")
    if power.taken_for:
        names = [f"{spaced_name(other)} in {percent(rate)}" for other, rate in list(power.taken_for.items())[:3]]
        lines.append(f"With them it would be mistaken for {joined(names)} of campaigns (at the size of 90 % power).")
    return lines


# ------------------------------------------------------------------------------
# The next experiment in sentences: trials to make, hypotheses that they separate, and what to measure instead.


def trials_in_words(trials: Sequence[Mapping[str, Any]]) -> str:
    """Return the trials to make, as a list within a sentence."""
    told = []
    for trial in trials:
        pressure_Pa, unit = 1e3 * trial["pressure_kPa"], trial.get("pressure_unit", "kPa")
        condition = _condition_text(pressure_Pa, unit, trial["payload_g"] / 1e3 or None)
        words = f"{_count(trial['replicates'], 'trial')} at {condition}"
        size = f"{trial['diameter_mm']:.3g} mm × {trial['thickness_um']:.3g} µm × {trial['length_mm']:.3g} mm"
        words += f" with {'a new' if trial['new_vine'] else 'the'} vine of {size}"
        changed = [COLUMNS[key].in_words(trial[key]) for key in LIMITED["choice"] if key in trial["changed"]]
        told.append(f"{words}, {' and '.join(changed)}" if changed else words)
    return "; ".join(told)


def advice_text(unresolved: Sequence[str], measurement: Remark, **facts: Any) -> str:
    """Return the advice: the trials to make, the hypotheses that they separate, and what to measure instead."""
    text, advice = sentence("trials_separate", facts), str(measurement)
    if any(trial["new_vine"] for trial in facts["trials"]):
        text += " B of the new vine is predicted here by scaling and will be fitted; measure its yield pressure."
    if unresolved:
        pairs = joined([pair.replace(" | ", " from ") for pair in unresolved])
        text += f" They will not separate {pairs}. {advice}"
    elif advice:
        text += f" A measurement would decide as well: {advice}"
    return text.rstrip()


# ------------------------------------------------------------------------------
# The damping law of an experiment in sentences and tables, for terminal and report, and how it was determined.

# The two fits of the damping law, by their keys in `damping.json`
METHOD_NAMES = {"log_log": "log–log least squares", "both_axes": "errors on both axes"}

LAW_METHODS = METHOD_NAMES | {"paper": "the published rule, exactly as printed"}  # Rows of the tables of n and B


def damping_headline(damping: Mapping[str, Any]) -> str:
    """Return the main result in one sentence: that of the fit with errors on both axes."""
    fit = damping.get("both_axes") or {}
    if fit.get("refused") or fit.get("n") is None or not fit.get("vines"):
        return f"No damping law: {(fit.get('refused') or 'no trial gave a steady speed').removesuffix('.')}."
    first, *others = fit["vines"].values()
    n, count = with_interval(fit["n"], fit.get("n_95_total")), sum(law["n_trials"] for law in (first, *others))
    B = with_interval(first["B"], first.get("B_95_total"))
    facts = {"n": n, "B": B, "count": count, "vines": len(fit["vines"])}
    return sentence("damping_law" if others else "damping_law_of_one", facts)


def status_tally(trials: pd.DataFrame) -> str:
    """Return the number of trials of each status, as a sentence."""
    words = {"ok": "ok", "warning": "with a warning", "failed": "failed", "left_out": "left out on request"}
    counts = trials["status"].value_counts()
    parts = [f"{counts[status]} {words[status]}" for status in words if counts.get(status, 0)]
    return f"{_count(len(trials), 'trial')}: {', '.join(parts)}." if parts else "No trials."


def failures_told(trials: pd.DataFrame) -> tuple[str, bool]:
    """How many trials in use failed, and why the first did, blank if none; and whether these are most of them."""
    in_use = trials[trials["status"] != "left_out"]
    failed = in_use[in_use["status"] == "failed"]
    first = " first" if len(failed) > 1 else ""
    told = [
        f"{_count(len(in_use), 'trial')} failed, {one.trial}{first}: {one.reason}" for one in failed[:1].itertuples()
    ]
    return "".join(f"{len(failed)} of {words}" for words in told), len(failed) > len(in_use) / 2


def _count(n: int, noun: str) -> str:
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"


def diagnosis_text(diagnosis: Diagnosis) -> str:
    """Return the printed diagnosis: verdict, rounds with their candidates, ladder of errors."""
    if not diagnosis.rounds:
        return diagnosis.explanation
    lines = [verdict_line(diagnosis), *table_lines(diagnosis)]
    if diagnosis.contradicted_columns:  # all else rests on the sheet
        return "\n".join(lines)
    lines += ["", diagnosis.explanation]
    for step in diagnosis.rounds:
        if step.ranking:
            lines += ["", f"{' + '.join(step.model)}: {step.verdict}", *_ranking(step)]
    if diagnosis.ladder is not None and len(diagnosis.ladder) > 1:
        lines += ["", "position error", *_ladder_table(diagnosis.ladder)]
    if diagnosis.where:
        lines += ["", *map(str, diagnosis.where)]
    lines += [f"! {note}" for note in diagnosis.notes]
    return "\n".join(lines)


def table_lines(diagnosis: Diagnosis, in_short: bool = False) -> list[str]:
    """Return the rows of the verdict table below its headline, as aligned lines of at most 120 characters; in short
    without the notes beside them, and a line each, or two for the law and for what to do.
    """
    first, *rows = verdict_table(diagnosis)
    width = max((len(row.question) for row in rows), default=0)
    lines = [f"  {first.note}"] if first.note and not in_short else []
    for row in rows:
        most = (2 if row.question.startswith(("F =", "What to do")) else 1) if in_short else None
        texts = [row.answer] if in_short else [row.answer, row.note]
        while most and len(texts[0]) > most * (116 - width) and "; " in texts[0]:  # whole clauses, where there are any
            texts[0] = texts[0].rpartition("; ")[0]
        told = [line for text in texts for line in textwrap.wrap(text, 116 - width, max_lines=most, placeholder=" …")]
        lines += [f"  {'' if k else row.question:<{width}}  {line}" for k, line in enumerate(told)]
    return lines


def _ranking(step: Round) -> list[str]:
    testable = [candidate for candidate in step.ranking if candidate.status != NOT_TESTABLE]
    rows = [
        (
            ("* " if candidate.in_answer_set else "  ") + candidate.effect,
            f"{candidate.delta_chi2:.1f}" if math.isfinite(candidate.delta_chi2) else "–",
            f"{candidate.sigma:.1f}",
            size if len(size := estimates_text(candidate)) <= 64 else f"{size[:64].rpartition(', ')[0]}, …",
            str(candidate.reason) or candidate.status,
        )
        for candidate in testable[:8]  # as many as the terminal shows (chosen)
    ]
    lines = list(table(rows, ("candidate", "Δχ²", "σ", "size", ""), align="<>><<"))
    untestable = [candidate.effect for candidate in step.ranking if candidate.status == NOT_TESTABLE]
    return lines + ([f"{NOT_TESTABLE}: {', '.join(untestable)}"] if untestable else [])


def _ladder_table(ladder: pd.DataFrame) -> list[str]:
    body = []
    for row in ladder.to_dict("records"):
        model = (str(row["added"]) or "initial model") + ", partial" * row["partial"]
        errors = (row[f"{key}_m"] for key in ("rms_in_sample", "rms_left_out", "rms_highest_pressure", "floor"))
        cells = (f"{1e3 * error:.2f}" if math.isfinite(error) else "–" for error in errors)
        body.append((model, *cells, expected_text(*(row[name] for name in EXPECTED)) or "–"))
    headings = ("added", "in sample mm", "left out mm", "highest pressure mm", "replicates mm", "adequate, left out")
    return list(table(body, headings, align="<>>>><"))


def added_in_words(before: Fit, after: Fit, ladder: pd.DataFrame) -> list[str]:
    """Return how an effect added by hand changed position errors and parameters, as lines of aligned tables."""
    # The model with the effect contains the one without it: a loss shows that the optimiser has not converged.
    gain = 2 * (after.log_likelihood - before.log_likelihood)
    # 9.0: Δχ² above which an added effect is said to help (derived)
    helps = f"Δχ² = {gain:.1f}{'' if gain > 9.0 else ', no significant improvement'}"
    helps += "" if after.converged and gain >= 0 else "; the fit did not converge"
    name = " + ".join(name for name in after.model.names if name not in before.model.names)
    lines = [
        f"{name} added to {' + '.join(before.model.names)}: {helps}",
        "",
        "position error",
        *_ladder_table(ladder),
        "",
        "parameters",
    ]
    known = {one.name: one for fit in (before, after) for one in fit.numbers}
    was, now = ({one.name: value_text(one) for one in fit.numbers} for fit in (before, after))
    body = [(_title(one, known), was.get(name, "–"), now.get(name, "–"), one.shown[0]) for name, one in known.items()]
    lines += table(body, ("", "before", "after", "unit"), align="<>><")
    against = not_better(ladder) if gain > 9.0 else []
    return lines + [f"! {message}" for message in (*against, *after.messages)]


def _title(fitted: Number, beside: Mapping[str, Number]) -> str:
    """Symbol and vine of a number; with its effect where another effect has that symbol too."""
    is_shared = any(one.symbol == fitted.symbol and one.key != fitted.key for one in beside.values())
    return f"{fitted.title} of {fitted.key.split('.')[0]}" if is_shared else fitted.title


# ------------------------------------------------------------------------------
# Where a model fails, what drifts, and the force that it lacks.


def _condition_text(pressure_Pa: float, unit: str, payload_kg: float | None = None, vine: str = "") -> str:
    """Return what names a condition: pressure, and payload and vine where they vary."""
    load = "" if payload_kg is None else f" with {1e3 * payload_kg:.3g} g"
    return f"{pressure_text(pressure_Pa, unit)}{load}{f' ({vine})' if vine else ''}"


def drift_condition(column: str, pressure_unit: str = "kPa") -> tuple[str, str, float]:
    """Return name, unit and factor from SI of a condition that a parameter may drift with."""
    for known in COLUMNS.values():
        if known.field == column and known.scale:
            scale = units.UNITS[pressure_unit] if known.scale.si == "Pa" else known.scale
            return known.quantity, scale.text, scale.from_si(1.0)
    return column.replace("_", " "), "", 1.0


def drift_text(row: Mapping[str, Any], stated_sigma_Pa: float = math.nan, pressure_unit: str = "kPa") -> str:
    """Return how a parameter drifts: a row of the table, and the error of the sheet."""
    against, start, stop = (row[name] for name in ("against", "from_level", "to_level"))
    who = f"{row['symbol']} of {row['vine']}" if row["vine"] else row["symbol"]
    change, error = 100 * row["change"], 100 * row["change_sigma"]
    digits = max(decimals(error) - 1, 0)
    facts = {**row, "who": who, "amount": f"{change:.{digits}f} ± {error:.{digits}f} %"}
    if against == "sheet":
        levels = {"from_level": start, "to_level": stop, "sigma": stated_sigma_Pa}
        shown: dict[str, Any] = {name: units.convert(one, "Pa", pressure_unit) for name, one in levels.items()}
        shown |= {"stated": units.with_error(shown["from_level"], shown["sigma"])}
        return sentence("drifts_from_sheet", facts | shown | {"unit": units.UNITS[pressure_unit].text})
    name, unit, times = drift_condition(against, pressure_unit)
    facts |= {"name": name, "low": f"{start * times:.3g} {unit}", "high": f"{stop * times:.3g} {unit}"}
    return sentence("rises_with", facts)


def _variables_text(name: str) -> str:
    """Return a choice of variables in words."""
    words = {"growth": "the growth", "speed": "the speed of the tail", "time": "the time since release",
             "pressure": "the pressure"}  # fmt: skip
    return " and ".join(words[variable] for variable in name.split("+"))


def learned_force_text(
    name: str, weights: Mapping[str, float], alternatives: Sequence[str], range_N: tuple[float, float], **facts: Any
) -> str:
    """Return the variables of the learned force and how certain they are, its range and error, from where it is
    measured, what limits the result, and which trials would help.
    """
    shares = {one: f" (posterior weight {weights[one]:.0%})" for one in weights}
    choices = joined([f"{_variables_text(one)}{shares.get(one, '')}" for one in (name, *alternatives)], "or by")
    low, high = (f"{end_N:.2f}".replace("-", "−") for end_N in range_N)
    facts |= {"name": name, "choices": choices, "alternatives": alternatives, "low": low, "high": high}
    return sentence("force_is_learned", facts)


def proposal_lines(proposal: Proposal) -> list[str]:
    """Return which laws of force were fitted and what resulted, a line a sentence."""
    lines = []
    for law in proposal.laws if proposal.tied else ():
        line = f"{law.words}: Δχ² = {law.ratio.delta_chi2:.0f} ({law.ratio.sigma:.1f} σ)"
        if math.isfinite(law.rms_left_out_m):
            errors_mm = 1e3 * proposal.rms_left_out_m, 1e3 * law.rms_left_out_m
            line += ", error on left-out conditions {:.2f} → {:.2f} mm".format(*errors_mm)
        lines.append(line + " (not excluded)" * (law in proposal.tied[1:]))
    if proposal.tied:
        best, *others = [law.words for law in proposal.tied]
        lines.append(f"Proposed, fitted with the model: {best}.")
        lines += [f"These data fit nearly as well with {joined(others)}."] if others else []
    else:
        lines.append(f"{proposal.reason}{'' if proposal.table else '; nothing is proposed'}.")
    if (learned := proposal.table) is not None:
        before, after = proposal.before.chi2_per_dof, learned.ratio.fit.chi2_per_dof
        facts = {"name": learned.effect.name, "before": before, "after": after, "rms_m": learned.rms_left_out_m}
        lines.append(sentence("no_formula_but_a_table", facts))
    return lines


def _file_text(title: str, paragraphs: Sequence[str], formula: str) -> str:
    """Return the docstring of an effect file that was proposed."""
    wrapped = [textwrap.fill(paragraph, 118) for paragraph in paragraphs if paragraph]
    last = "Make trials that differ in the variables it depends on, and compare new trials with its prediction."
    return "\n\n".join([title, *wrapped, f"    {formula}", last]) + "\n"


def learned_file_text(learned: LearnedForce, origin: str) -> str:
    """Return the docstring of an effect file that holds a learned force."""
    domain = learned.domain
    shown = {"growth": ("y", "mm", 1e3), "speed": ("ẋ", "m/s", 1.0), "time": ("t", "ms", 1e3),
             "pressure": ("P", "kPa", 1e-3)}  # fmt: skip
    ranges = [
        f"{_variables_text(axis.name)} from {axis.low * times:.3g} to {axis.high * times:.3g} {unit}"
        for axis, (_, unit, times) in ((axis, shown[axis.name]) for axis in domain.axes)
    ]
    validity = sentence("valid_where_learned", {"ranges": ranges})
    symbols, counts = ", ".join(shown[name][0] for name in domain.variables), " × ".join(map(str, domain.counts))
    formula = f"tail force a T({symbols}), T the sum of {counts} cubic splines on even steps"
    title = f"Learned force: a table over {_variables_text(domain.name)}, no law."
    return _file_text(title, [origin, str(learned.sentence), validity], formula)


# ------------------------------------------------------------------------------
# Vines not yet built.


def volume_text(volume_m3: float) -> str:
    """Return a volume in litres, or in millilitres below 0.1 L."""
    return f"{1e3 * volume_m3:.3g} L" if volume_m3 >= 1e-4 else f"{1e6 * volume_m3:.3g} mL"


def trial_text(trial: Trial, in_full: bool = True) -> str:
    """Describe a trial in one line; if not in full by diameter, length and pressure."""
    pressure = pressure_text(trial.pressure_Pa, trial.pressure_unit, 4)
    if not in_full:
        return f"{1e3 * trial.diameter_m:.4g} mm × {1e3 * trial.length_m:.4g} mm at {pressure}"
    size = f"{1e3 * trial.diameter_m:.4g} mm × {1e6 * trial.thickness_m:.4g} µm × {1e3 * trial.length_m:.4g} mm"
    payload = f"payload {1e3 * trial.payload_kg:.4g} g" if trial.payload_kg > 0 else "no payload"
    degrees = math.degrees(trial.growth_angle_rad)
    names = {0: "straight down", 90: "horizontally", 180: "straight up"}
    direction = names.get(round(degrees, 6), f"{degrees:.4g}° from straight down")  # type: ignore[call-overload]
    rig = "" if math.isnan(trial.chamber_m3) else f", chamber {volume_text(trial.chamber_m3)}"
    rig += "" if math.isnan(trial.inlet_m) else f", inlet {1e3 * trial.inlet_m:.4g} mm"
    return f"{size} at {pressure}, {payload}, growing {direction}{rig}"


def value_in_unit(value: float, unit: str, pressure_unit: str = "kPa") -> str:
    """Format an SI value in its display unit; infinity, a time that is never reached, is `never`."""
    factor = display_unit(unit, pressure_unit, units.PREDICTION_UNITS)[1]
    return "never" if math.isinf(value) else number(value * factor)


# Facts in words, by the names that `sentences.csv` gives them in place of a format
FORMS: dict[str, Callable[[Any], str]] = {
    "and": joined,
    "or": lambda names: joined(names, "or"),
    "is": lambda names: "is" if len(names) == 1 else "are",
    "list": ", ".join,
    "rivals": "; ".join,
    "sum": " + ".join,
    "code": lambda names: f"`{'` and `'.join(names)}`",
    "number": number,
    "word": lambda count: ("two", "three", "four", "five")[count - 2],
    "changes": lambda changes: (
        ", ".join(f"{name} by {size:.2g} {unit}".rstrip() for name, size, unit in changes[:4])
        + (f", and {len(changes) - 4} more" if len(changes) > 4 else "")
    ),
    "remedy": lambda source: SHARED_REMEDIES[source],
    "pressure": lambda pressure_in: pressure_text(*pressure_in),
    "implied": lambda odd: "".join(
        f" {name} moves as at {pressure_text(implied_Pa, unit)}, but {pressure_text(stated_Pa, unit)} is stated."
        for name, unit, stated_Pa, implied_Pa in odd
        if implied_Pa > 0
    ),
    "condition": lambda condition: _condition_text(**condition),
    "off": lambda off_m: f"{with_error(*(1e3 * abs(m) for m in off_m))} mm",
    "variables": _variables_text,
    "newtons": lambda force_N: f"{'+' if force_N[0] > 0 else ''}{with_error(*force_N)} N".replace("-", "−"),
    "place": lambda y_over_L: "" if y_over_L == 1 else f" at y/L = {y_over_L:g}",
    "draws": lambda share: "in every draw" if share > 0.995 else f"in {share:.0%} of the draws",
    "spaced": lambda name: name.replace("_", " "),
    "percent": percent,
    "trials": trials_in_words,
    "separated": lambda if_true: ", ".join(
        f"{pair.replace(' | ', ' from ')} by {min(by_truth.values()):.2g} σ" for pair, by_truth in if_true.items()
    ),
    "recordings": lambda trials: (
        f"{_count(len(trials), 'recording')} ({joined(trials[:4])}{' and others' if len(trials) > 4 else ''})"
    ),
}


def _implausible_text(symbol: str, value: float, unit: str, low: float, high: float, pressure_unit: str = "kPa") -> str:
    """Say which size an effect would need, in the unit in which its estimate is shown, and which are plausible."""
    shown, factor = display_unit(unit or "1", pressure_unit)
    would = f"{symbol} = {factor * value:.3g} {shown}".rstrip()
    return f"it would need {would}, and {factor * low:.3g} to {factor * high:.3g} is plausible"


# Remarks that take more than a template, by their codes
REMARKS: dict[str, Callable[..., str]] = {
    "sweeps": lambda trial, swept_m3, in_full: f"{trial_text(trial, in_full)}: it sweeps {volume_text(swept_m3)}",
    "supplied_chambers": lambda ms, volumes: (
        f"with a supply that refills the chamber in {ms:g} ms, at the medians: "
        + ", ".join(f"{volume_text(m3) if m3 > 0 else 'none'} ({law.split(',')[0]})" for law, m3 in volumes.items())
    ),
    "implausible_size": _implausible_text,
    "deciding_measurements": lambda effects: " ".join(
        f"{one.name}: {words[0].lower()}{words[1:]}"
        for one in effects
        if (words := " ".join(filter(None, (one.told_apart, one.remedy))))
    ),
    "trials_to_make": advice_text,
    "drifts": drift_text,
    "learned_force": learned_force_text,
    "learned_file": learned_file_text,
    "law_file": lambda law, formula, origin: _file_text(
        f"Proposed law: {law}.",
        [
            origin,
            "It describes these data but explains nothing: its physical cause is for you to find. Forces are positive"
            " along the growth, so that a friction is negative.",
        ],
        formula,
    ),
}
