"""What stands beside the figures, as HTML: the headline, what a fit found, what is tied, the next trial."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from vinetrack.explorer.campaign import Campaign
from vinetrack.explorer.choice import SHOWN_UNITS, Choice
from vinetrack.explorer.curves import overall_m
from vinetrack.explorer.export import model_words
from vinetrack.explorer.fitting import Fitted, gained_words, tied_words
from vinetrack.explorer.look import command_block, escaped, table
from vinetrack.explorer.story import Story
from vinetrack.model.fit_result import Number, decimals

AT_THE_FLOOR = 1.15
MOST_PAIRS = 6


@dataclass(frozen=True)
class Rung:
    """One model fitted on this page: its effects, error over all conditions, and what the fit said."""

    effects: tuple[str, ...]
    rms_m: float
    gained: str


def headline(campaign: Campaign, choice: Choice, now_m: Mapping[str, float], before_m: Mapping[str, float]) -> str:
    """In a sentence: how far off the model is, was, and could not help being."""
    now, before, floor = (overall_m(errors, campaign.conditions) for errors in (now_m, before_m, campaign.floors_m))
    words = model_words(choice.effects)
    model = escaped(words[:1].upper() + words[1:])
    if not math.isfinite(now):
        reason = f"The model in use was not fitted: {escaped(campaign.refused)}" if campaign.refused else "Preparing …"
        return f"<h1>{reason}</h1>"
    at_floor = math.isfinite(floor) and now <= AT_THE_FLOOR * floor
    grade = "good" if at_floor else "bad"
    was = f", {_mm(before)} when the page opened" if math.isfinite(before) and _mm(before) != _mm(now) else ""
    if math.isfinite(floor):
        least = f"; replicates differ by {_mm(floor)}" + (": no model can do better" if at_floor else "")
    else:
        least = "; there are no replicates to say how good it could be"
    return f'<h1>{model}: <span class="{grade}">off by {_mm(now)}</span> rms{was}{least}.</h1>'


def _mm(value_m: float) -> str:
    return f"{1e3 * value_m:.3g} mm"


def numbers_words(campaign: Campaign, fitted: Fitted | None, rungs: Sequence[Rung], touched: bool) -> str:
    """The table of fitted numbers and the models fitted so far."""
    if fitted is None:
        return "<p class='muted'>The model in use is being fitted; its numbers come here.</p>"
    rows = [_number_row(number) for number in fitted.fit.numbers]
    parts = [table(rows, ("", "vine", "value", "error", "95 %", "unit"), (2, 3, 4))]
    if touched:
        parts.append('<p class="muted">Sizes were moved since: these are the numbers of the last fit.</p>')
    spreads = "; ".join(
        f"{escaped(name)} {100 * s.value:.2g} %{'' if s.estimated else ' (held)'}"
        for name, s in fitted.fit.spreads.items()
    )
    chi2 = f"χ² per degree of freedom {fitted.fit.chi2_per_dof:.3g}" if math.isfinite(fitted.fit.chi2_per_dof) else ""
    noise = f"noise {1e3 * fitted.fit.noise_m:.2g} mm"
    facts = [noise, chi2, f"spread from trial to trial: {spreads}" if spreads else "", f"{fitted.seconds:.2g} s"]
    parts.append(f"<p><small>{' · '.join(fact for fact in facts if fact)}</small></p>")
    parts += [f"<p><small>{escaped(message)}</small></p>" for message in fitted.fit.messages]
    parts.append(_ladder(campaign, rungs))
    return "".join(parts)


def _number_row(number: Number) -> tuple[str, ...]:
    unit, factor = SHOWN_UNITS.get(number.unit, (number.unit, 1.0))
    if not math.isfinite(number.sigma):
        return number.symbol, number.vine or "all", f"{number.value * factor:.4g}", "open", "", unit
    digits = decimals(number.sigma * factor)
    value, low, high = (f"{x * factor:.{digits}f}" for x in (number.value, number.low, number.high))
    error = f"± {number.sigma * factor:.{digits}f}"
    return number.symbol, number.vine or "all", value, error, f"{low} to {high}", unit


def _ladder(campaign: Campaign, rungs: Sequence[Rung]) -> str:
    """The models fitted on this page, one below the other, with what is left beyond the replicates."""
    if not rungs:
        return ""
    floor = overall_m(campaign.floors_m, campaign.conditions)
    rows = []
    for rung in rungs:
        beyond = math.sqrt(max(rung.rms_m**2 - floor**2, 0.0)) if math.isfinite(floor) else math.nan
        rows.append((model_words(rung.effects), _mm(rung.rms_m), _mm(beyond) if math.isfinite(beyond) else "–"))
    said = f"<p><small>{escaped(rungs[-1].gained)}</small></p>" if rungs[-1].gained else ""
    return "<h3>Fitted on this page</h3>" + table(rows, ("model", "rms error", "beyond replicates"), (1, 2)) + said


def rung_of(campaign: Campaign, fitted: Fitted, before: Fitted | None) -> Rung:
    """A line of the ladder for a fit, and what it gained over the one before."""
    gained = "" if before is None else gained_words(before.fit, fitted.fit)
    return Rung(fitted.choice.effects, overall_m(fitted.errors_m, campaign.conditions), gained)


def tied_panel(campaign: Campaign, story: Story | None, fitted: Fitted | None) -> str:
    """What the data cannot tell apart: by the diagnosis among effects, by the fit among its numbers."""
    parts = []
    if story is None:
        parts.append(
            "<p>No diagnosis yet: it asks every effect whether it is missing, and says which of them these trials"
            " cannot tell apart. It appears here by itself after</p>"
        )
        parts.append(command_block([f"vinetrack diagnose {campaign.folder.as_posix()}"]))
    else:
        parts.append(f"<p><b>{escaped(story.verdict)}</b>: {escaped(story.explanation)}</p>")
        if len(story.answer_set) > 1:
            names = ", ".join(name.replace("_", " ") for name in story.answer_set)
            parts.append(f"<p>Not to be told apart: <b>{escaped(names)}</b>.</p>")
        pairs = story.most_tied()[:MOST_PAIRS]
        if pairs:
            rows = [(_spaced(one), _spaced(other), f"{cosine:+.2f}") for one, other, cosine in pairs]
            parts.append(table(rows, ("effect", "looks like", "cosine"), (2,)))
    if fitted is not None:
        pairs_words = tied_words(fitted.fit)
        parts.append("<h3>In the last fit</h3>")
        parts += [f"<p>{escaped(line)}</p>" for line in pairs_words[:MOST_PAIRS]] or [
            "<p class='muted'>No two numbers hang together by more than 0.9.</p>"
        ]
    return "".join(parts)


def _spaced(name: str) -> str:
    return name.replace("_", " ")


def next_panel(campaign: Campaign, story: Story | None) -> str:
    """What to film next, as the diagnosis says."""
    if story is None or not story.next_experiment:
        reason = (
            "A diagnosis says which trial would tell best."
            if story is None
            else "The diagnosis asks for no further trial."
        )
        command = command_block([f"vinetrack diagnose {campaign.folder.as_posix()}"]) if story is None else ""
        return f"<p>{reason}</p>{command}"
    return "".join(_said(key, value) for key, value in story.next_experiment.items())


def _said(key: str, value: Any) -> str:
    """One entry of a next experiment: sentences as they are, trials as a table, numbers with their name."""
    title = key.replace("_", " ")
    if isinstance(value, str):
        return f"<p>{escaped(value)}</p>" if " " in value else f"<p>{escaped(title)}: <b>{escaped(value)}</b></p>"
    if isinstance(value, Mapping):
        return "".join(_said(f"{key} {inner}" if key else inner, part) for inner, part in value.items())
    if isinstance(value, list | tuple):
        return _said_list(title, value)
    shown = f"{value:.3g}" if isinstance(value, float) else str(value)
    return "" if value is None else f"<p><small>{escaped(title)}</small> <b>{escaped(shown)}</b></p>"


def _said_list(title: str, values: Sequence[Any]) -> str:
    if values and all(isinstance(value, Mapping) for value in values):
        keys = [key for key in values[0] if not isinstance(values[0][key], list | tuple | dict)]
        rows = [[_cell(value.get(key)) for key in keys] for value in values]
        return f"<p><small>{escaped(title)}</small></p>" + table(rows, [key.replace("_", " ") for key in keys])
    return f"<p><small>{escaped(title)}</small> {escaped(', '.join(map(_cell, values)))}</p>" if values else ""


def _cell(value: Any) -> str:
    return "–" if value is None else f"{value:.3g}" if isinstance(value, float) else str(value)
