"""Text beside the figures as HTML: headline, fitted numbers, and of a diagnosis tied candidates and the next trial."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vinetrack.core.numbers import decimals
from vinetrack.core.units import SLIDER_UNITS, display_unit
from vinetrack.diagnosis.result import UNEXPLAINED
from vinetrack.experiment.schema import COLUMNS, LIMITED
from vinetrack.explorer.campaign import Campaign
from vinetrack.explorer.choice import ModelChoice
from vinetrack.explorer.curves import Curves, overall_m
from vinetrack.explorer.export import model_words
from vinetrack.explorer.fitting import Fitted, gained_words, tied_words
from vinetrack.explorer.look import command_block, escaped, table
from vinetrack.explorer.series import vine_colours
from vinetrack.figures.candidate_figures import TIED_COSINE
from vinetrack.inference.fit_result import Number
from vinetrack.narrative.verdict_summary import size
from vinetrack.results.folder_layout import Results, ResultsError
from vinetrack.results.stored_diagnosis import read_diagnosis

AT_THE_FLOOR = 1.15
"""Chosen: an error within 15 % of the replicate scatter counts as equal to it; with six replicates that scatter is
itself known to 1/√(2·5) = 32 %."""

MOST_PAIRS = 6
"""Of correlated numbers; chosen: the card holds six lines."""

MOST_COMPARED = 8
"""Candidates in the grid of cosines; chosen: eight columns fit the card of 380 pixels."""


@dataclass(frozen=True)
class FittedRung:
    """One model fitted on this page: its effects, error over all conditions, and what the fit said."""

    effects: tuple[str, ...]
    rms_m: float
    gained: str


@dataclass(frozen=True)
class HeldModel:
    """A model to compare with: its effects, curves, errors by condition (m), and its fit where it is one."""

    effects: tuple[str, ...]
    curves: Curves | None
    errors_m: Mapping[str, float]
    fitted: Fitted | None


def side_by_side(campaign: Campaign, held: HeldModel | None, now: HeldModel) -> str:
    """Return the held model and the present one as a table: error, and every fitted number of either.

    Parameters
    ----------
    campaign : as `read_campaign` returns it.
    held : None where nothing is held.
    now : the model as it is drawn.

    Returns
    -------
    str, HTML; blank where nothing is held
    """
    if held is None:
        return ""
    models = (held, now)
    rows = [
        ("effects", *(model_words(model.effects) for model in models)),
        ("rms of position", *(_mm(overall_m(model.errors_m, campaign.conditions)) for model in models)),
    ]
    fits = [{} if model.fitted is None else {n.name: n for n in model.fitted.fit.numbers} for model in models]
    for name in dict.fromkeys(name for numbers in fits for name in numbers):
        title = next(numbers[name].title for numbers in fits if name in numbers)
        rows.append((title, *(size(n[name]).partition(" = ")[2] if name in n else "–" for n in fits)))
    return table(rows, ("", "held", "now"), ())


def headline(campaign: Campaign, choice: ModelChoice, now_m: Mapping[str, float], before_m: Mapping[str, float]) -> str:
    """Return the error of the model now and as the page opened, with the replicate scatter, as a heading.

    Parameters
    ----------
    campaign : as `read_campaign` returns it.
    choice : effects and sizes.
    now_m, before_m : errors by condition, m.

    Returns
    -------
    str, HTML
    """
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
        least = f"; replicate scatter {_mm(floor)}" + (": nothing is left to explain" if at_floor else "")
    else:
        least = "; there are no replicates to compare with"
    return f'<h1>{model}: <span class="{grade}">off by {_mm(now)}</span> rms{was}{least}.</h1>'


def _mm(value_m: float) -> str:
    return f"{1e3 * value_m:.3g} mm"


def numbers_words(campaign: Campaign, fitted: Fitted | None, rungs: Sequence[FittedRung], touched: bool) -> str:
    """The table of fitted numbers and the models fitted so far.

    Parameters
    ----------
    campaign : as `read_campaign` returns it.
    fitted : the last fit; None before the first.
    rungs : models fitted on this page.
    touched : whether sizes were moved since.

    Returns
    -------
    str, HTML
    """
    if fitted is None:
        return "<p class='muted'>The model in use is being fitted; its numbers come here.</p>"
    vines = dict(zip(campaign.vines, (label for label, _ in vine_colours(campaign)), strict=True))
    known = vines if len(vines) > 1 else {}
    rows = [_number_row(number, known.get(number.vine, number.vine) or "all") for number in fitted.fit.numbers]
    parts = [table(rows, ("", "vine", "value", "error", "95 %"), (2, 3, 4))]
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


def _number_row(number: Number, vine: str) -> tuple[str, ...]:
    unit, factor = display_unit(number.unit, SLIDER_UNITS)
    name = f"{number.symbol}, {unit}" if unit else number.symbol
    if math.isfinite(number.bound):
        return name, vine, f"{number.bound * factor:.4g}", "at its bound", ""
    if not (math.isfinite(number.sigma) and number.sigma > 0):
        return name, vine, f"{number.value * factor:.4g}", "open", ""
    digits = decimals(number.sigma * factor)
    value, low, high = (f"{x * factor:.{digits}f}" for x in (number.value, number.low, number.high))
    return name, vine, value, f"± {number.sigma * factor:.{digits}f}", f"{low} to {high}"


def _ladder(campaign: Campaign, rungs: Sequence[FittedRung]) -> str:
    """The models fitted on this page, one below the other, with what is left beyond the replicates."""
    if not rungs:
        return ""
    floor = overall_m(campaign.floors_m, campaign.conditions)
    rows = []
    for rung in rungs:
        beyond = math.sqrt(max(rung.rms_m**2 - floor**2, 0.0)) if math.isfinite(floor) else math.nan
        rows.append((model_words(rung.effects), _mm(rung.rms_m), _mm(beyond) if math.isfinite(beyond) else "–"))
    gained = f"<p><small>{escaped(rungs[-1].gained)}</small></p>" if rungs[-1].gained else ""
    return "<h3>Fitted on this page</h3>" + table(rows, ("model", "rms error", "beyond replicates"), (1, 2)) + gained


def rung_of(campaign: Campaign, fitted: Fitted, before: Fitted | None) -> FittedRung:
    """A line of the ladder for a fit, and what it gained over the one before.

    Parameters
    ----------
    campaign : as `read_campaign` returns it.
    fitted : the fit.
    before : the fit before it; None for the first.

    Returns
    -------
    FittedRung
    """
    gained = "" if before is None else gained_words(before.fit, fitted.fit)
    return FittedRung(fitted.choice.effects, overall_m(fitted.errors_m, campaign.conditions), gained)


def tied_panel(campaign: Campaign, story: DiagnosisSummary | None, fitted: Fitted | None) -> str:
    """Return what the data cannot tell apart: effects, by the diagnosis; fitted numbers, by their correlations.

    Parameters
    ----------
    campaign : as `read_campaign` returns it.
    story : the diagnosis; None where there is none.
    fitted : the last fit; None before the first.

    Returns
    -------
    str, HTML
    """
    parts = []
    if story is None:
        parts.append(
            "<p>No diagnosis yet: it tests every effect and states which of them these trials cannot tell apart. It"
            " appears here after</p>"
        )
        parts.append(command_block([f"vinetrack diagnose {campaign.folder.as_posix()}"]))
    else:
        parts.append(f"<p><b>{escaped(story.verdict)}</b>: {escaped(story.explanation)}</p>")
        if len(story.answer_set) > 1:
            names = ", ".join(name.replace("_", " ") for name in story.answer_set)
            parts.append(f"<p>Cannot be told apart: <b>{escaped(names)}</b>.</p>")
        parts.append(cosine_grid(story))
    if fitted is not None:
        pairs_words = tied_words(fitted.fit)
        parts.append("<h3>In the last fit</h3>")
        parts += [f"<p>{escaped(line)}</p>" for line in pairs_words[:MOST_PAIRS]] or [
            "<p class='muted'>No two numbers are correlated by more than 0.9.</p>"
        ]
    return "".join(parts)


def cosine_grid(story: DiagnosisSummary) -> str:
    """Return the cosines between the effects of the likeliest candidates as a table; blank for fewer than two.

    Parameters
    ----------
    story : the diagnosis.

    Returns
    -------
    str, HTML
    """
    names = [name for name in story.best if name in story.cosine_names]
    names += [name for *pair, _ in story.most_tied() for name in pair]
    names = list(dict.fromkeys(names))[:MOST_COMPARED]
    if len(names) < 2:
        return ""
    place = [story.cosine_names.index(name) for name in names]
    head = "".join(f"<th class='up'><span>{escaped(_spaced(name))}</span></th>" for name in names)
    body = "".join(
        f"<tr><th>{escaped(_spaced(name))}</th>" + "".join(_cosine_cell(story.cosines[i][k]) for k in place) + "</tr>"
        for name, i in zip(names, place, strict=True)
    )
    caption = "<small>Cosines of what effects do to the trajectories: near ±1 they cannot be told apart.</small>"
    return f"<div class='scroll'><table class='cosines'><tr><th></th>{head}</tr>{body}</table></div>{caption}"


def _cosine_cell(cosine: float) -> str:
    """Blue for alike, vermillion for opposite, the deeper the more."""
    if not math.isfinite(cosine):
        return "<td>–</td>"
    strength = min(abs(cosine), 1.0) ** 2
    colour = f"rgba(0,114,178,{strength:.2f})" if cosine > 0 else f"rgba(213,94,0,{strength:.2f})"
    ink = "#fff" if strength > 0.6 else "inherit"
    return f"<td style='background:{colour};color:{ink}'>{cosine:+.2f}</td>"


def _spaced(name: str) -> str:
    return name.replace("_", " ")


def next_panel(campaign: Campaign, story: DiagnosisSummary | None) -> str:
    """What to film next, as the diagnosis says.

    Parameters
    ----------
    campaign : as `read_campaign` returns it.
    story : the diagnosis; None where there is none.

    Returns
    -------
    str, HTML
    """
    if story is None:
        command = command_block([f"vinetrack diagnose {campaign.folder.as_posix()}"])
        return f"<p>A diagnosis states which trial would separate the candidates best.</p>{command}"
    advice = story.next_experiment
    if not advice:
        return "<p>The diagnosis proposes no further trial.</p>"
    parts = [f"<p>{escaped(advice.get('text', ''))}</p>"]
    rows = [_trial_row(trial) for trial in advice.get("trials", ())]
    if rows:
        parts.append(table(rows, ("vine", "pressure", "payload", "trials", "other"), (1, 2, 3)))
    separations = [
        (pair.replace(" | ", " from ").replace("_", " "), f"{sigma:.2g} σ")
        for pair, sigma in (advice.get("separation_sigma") or {}).items()
        if sigma is not None
    ]
    if separations:
        parts.append(table(separations, ("separates", "by"), (1,)))
    if advice.get("calibration"):
        parts.append(f"<p>{escaped(advice['calibration'])}</p>")
    return "".join(parts)


def _trial_row(trial: Mapping[str, Any]) -> tuple[str, ...]:
    """One condition to make, in the units of the sheet; what differs from the rig so far is said."""
    size = f"{_cell(trial.get('diameter_mm'))} mm × {_cell(trial.get('thickness_um'))} µm"
    changed = trial.get("changed") or ()
    other = [COLUMNS[key].in_words(trial[key]) for key in LIMITED["choice"] if key in changed and trial.get(key)]
    return (
        f"{size}{' (new)' if trial.get('new_vine') else ''}",
        f"{_cell(trial.get('pressure_kPa'))} kPa",
        f"{_cell(trial.get('payload_g') or 0)} g",
        _cell(trial.get("replicates", 1)),
        ", ".join(other),
    )


def _cell(value: Any) -> str:
    return "–" if value is None else f"{value:.3g}" if isinstance(value, float) else str(value)


DIAGNOSIS = "diagnosis.json"


@dataclass(frozen=True)
class RankedCandidate:
    """A candidate of the ranking: the fall of −2 ln L with it, and whether it is in the answer set."""

    effect: str
    delta_chi2: float
    in_answer_set: bool
    reason: str


@dataclass(frozen=True)
class DiagnosisSummary:
    """The first round of a diagnosis, and what to do next. `cosines` is a matrix in the order of `cosine_names`."""

    verdict: str
    unexplained: bool
    explanation: str
    answer_set: tuple[str, ...]
    suspects: tuple[RankedCandidate, ...]
    cosine_names: tuple[str, ...]
    cosines: tuple[tuple[float, ...], ...]
    next_experiment: Mapping[str, Any] | None

    @property
    def best(self) -> tuple[str, ...]:
        """Effects worth trying first, best first."""
        ranked = [candidate.effect for candidate in self.suspects if math.isfinite(candidate.delta_chi2)]
        return tuple(dict.fromkeys([*self.answer_set, *ranked]))

    def most_tied(self, least: float = TIED_COSINE) -> list[tuple[str, str, float]]:
        """Pairs of candidates with |cosine| of `least` or more, largest first.

        Parameters
        ----------
        least : smallest |cosine|.

        Returns
        -------
        list of (effect, effect, cosine)
        """
        pairs = [
            (name, other, self.cosines[i][k])
            for i, name in enumerate(self.cosine_names)
            for k, other in enumerate(self.cosine_names[:i])
            if abs(self.cosines[i][k]) >= least
        ]
        return sorted(pairs, key=lambda pair: -abs(pair[2]))


def read_summary(folder: Path) -> DiagnosisSummary | None:
    """The diagnosis of a results folder, None where there is none or it cannot be understood.

    Parameters
    ----------
    folder : the results.

    Returns
    -------
    DiagnosisSummary or None
    """
    try:
        diagnosis = read_diagnosis(Results(folder))
    except ResultsError:
        return None
    if diagnosis is None:
        return None
    first = diagnosis.rounds[0] if diagnosis.rounds else None
    return DiagnosisSummary(
        verdict=diagnosis.verdict or "not diagnosed",
        unexplained=UNEXPLAINED in (diagnosis.verdict, diagnosis.final_verdict),
        explanation=diagnosis.explanation,
        answer_set=diagnosis.answer_set,
        suspects=tuple(RankedCandidate(c.effect, c.delta_chi2, c.in_answer_set, c.reason) for c in diagnosis.ranking),
        cosine_names=first.cosine_names if first else (),
        cosines=tuple(tuple(row) for row in first.cosines) if first else (),
        next_experiment=diagnosis.next_experiment,
    )
