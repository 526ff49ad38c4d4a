"""Text panels as HTML: headline, fitted parameters, tied candidates and next trial of a diagnosis."""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vinetrack.core.units import SLIDER_UNITS, decimals, display_unit
from vinetrack.diagnosis.result import Diagnosis
from vinetrack.experiment.schema import COLUMNS, LIMITED
from vinetrack.figures.diagnosis_figures import TIED_COSINE
from vinetrack.inference.fit_result import Number
from vinetrack.narrative.verdict_text import quantity_text
from vinetrack.pages.campaign import (
    Campaign,
    Fitted,
    ModelChoice,
    Prediction,
    correlated_pairs_text,
    likelihood_change_text,
    model_text,
    overall_m,
)
from vinetrack.pages.plots import command_block, escaped, table, vine_colours
from vinetrack.results.folder_layout import Results, ResultsError, read_diagnosis


@dataclass(frozen=True)
class HeldModel:
    """A model for comparison: its effects, what it predicts, and its fit, if it was fitted."""

    effects: tuple[str, ...]
    prediction: Prediction | None
    fitted: Fitted | None

    @property
    def errors_m(self) -> Mapping[str, float]:
        """Errors by condition, m."""
        return {} if self.prediction is None else self.prediction.errors_m


def comparison_table(campaign: Campaign, held: HeldModel | None, now: HeldModel) -> str:
    """Return the held model and the current one as a table: error, and every fitted parameter of either."""
    if held is None:
        return ""
    models = (held, now)
    rows = [
        ("effects", *(model_text(model.effects) for model in models)),
        ("rms of position", *(_mm(overall_m(model.errors_m, campaign.conditions)) for model in models)),
    ]
    fits = [{} if model.fitted is None else {n.name: n for n in model.fitted.fit.numbers} for model in models]
    for name in dict.fromkeys(name for numbers in fits for name in numbers):
        title = next(numbers[name].title for numbers in fits if name in numbers)
        rows.append((title, *(quantity_text(n[name]) if name in n else "–" for n in fits)))
    return table(rows, ("", "held", "now"), ())


def headline(
    campaign: Campaign, choice: ModelChoice, prediction: Prediction | None, opened_with: Prediction | None
) -> str:
    """Return the error of the model now and as the page opened, with the replicate scatter, as a heading."""
    parts: list[Mapping[str, float]] = [{}, {}, campaign.floors_m]
    if prediction is not None:
        parts = [prediction.errors_m, opened_with.errors_m if opened_with else {}, prediction.floors_m]
    now, before, floor = (overall_m(errors, campaign.conditions) for errors in parts)
    words = model_text(choice.effects)
    model = escaped(words[:1].upper() + words[1:])
    if not math.isfinite(now):
        reason = f"The model in use was not fitted: {escaped(campaign.refused)}" if campaign.refused else "Preparing …"
        return f"<h1>{reason}</h1>"
    # Chosen: an error up to 1.15 times the replicate scatter counts as equal to it
    at_floor = math.isfinite(floor) and now <= 1.15 * floor
    grade = "good" if at_floor else "bad"
    was = f", {_mm(before)} when the page opened" if math.isfinite(before) and _mm(before) != _mm(now) else ""
    if math.isfinite(floor):
        least = f"; replicate scatter {_mm(floor)}" + (": nothing is left to explain" if at_floor else "")
    else:
        least = "; there are no replicates to compare with"
    return f'<h1>{model}: <span class="{grade}">off by {_mm(now)}</span> rms{was}{least}.</h1>{not_run_yet(campaign)}'


def not_run_yet(campaign: Campaign) -> str:
    """Return that the results are of another model than the settings name now; blank if they are of the same."""
    if campaign.saved == campaign.in_use:
        return ""
    saved, shown = escaped(model_text(campaign.saved)), escaped(model_text(campaign.in_use))
    command = f"vinetrack run {shlex.quote(campaign.experiment.folder.as_posix())}"
    return (
        f'<p class="bad">experiment.yaml has the {saved} since these results were made: they, and what this page opened'
        f" with, are of the {shown}. For new results: <code>{escaped(command)}</code></p>"
    )


def _mm(value_m: float) -> str:
    return f"{1e3 * value_m:.3g} mm"


def fitted_numbers_html(campaign: Campaign, fits: Sequence[Fitted], sizes_changed: bool) -> str:
    """Return the table of the parameters of the last fit of this page, and all its fits, as HTML."""
    if not fits:
        return "<p class='muted'>The model in use is being fitted; its parameters will appear here.</p>"
    fitted = fits[-1]
    vines = dict(zip(campaign.vines, (label for label, _ in vine_colours(campaign)), strict=True))
    known = vines if len(vines) > 1 else {}
    rows = [_number_row(number, known.get(number.vine, number.vine) or "all") for number in fitted.fit.numbers]
    parts = [table(rows, ("", "vine", "value", "error", "95 %"), (2, 3, 4))]
    if sizes_changed:
        parts.append('<p class="muted">Sizes were changed since: these are the parameters of the last fit.</p>')
    spreads = "; ".join(
        f"{escaped(name)} {100 * s.value:.2g} %{'' if s.estimated else ' (fixed)'}"
        for name, s in fitted.fit.spreads.items()
    )
    chi2 = f"χ² per degree of freedom {fitted.fit.chi2_per_dof:.3g}" if math.isfinite(fitted.fit.chi2_per_dof) else ""
    noise = f"noise {1e3 * fitted.fit.noise_m:.2g} mm"
    facts = [noise, chi2, f"between-trial standard deviations: {spreads}" if spreads else "", f"{fitted.seconds:.2g} s"]
    parts.append(f"<p><small>{' · '.join(fact for fact in facts if fact)}</small></p>")
    parts += [f"<p><small>{escaped(message)}</small></p>" for message in fitted.fit.messages]
    parts.append(_ladder(campaign, fits))
    return "".join(parts)


def _number_row(number: Number, vine: str) -> tuple[str, ...]:
    unit, factor = display_unit(number.unit, SLIDER_UNITS)
    name = f"{number.symbol}, {unit}" if unit else number.symbol
    if math.isfinite(number.bound):
        return name, vine, f"{number.bound * factor:.4g}", "at its bound", ""
    if not (math.isfinite(number.sigma) and number.sigma > 0):
        return name, vine, f"{number.value * factor:.4g}", "undetermined", ""
    digits = decimals(number.sigma * factor)
    value, low, high = (f"{x * factor:.{digits}f}" for x in (number.value, number.low, number.high))
    return name, vine, value, f"± {number.sigma * factor:.{digits}f}", f"{low} to {high}"


def _ladder(campaign: Campaign, fits: Sequence[Fitted]) -> str:
    """The models fitted on this page, with the error in excess of replicate scatter."""
    floor = overall_m(campaign.floors_m, campaign.conditions)
    rows = []
    for fitted in fits:
        rms = overall_m(fitted.prediction.errors_m, campaign.conditions)
        beyond = math.sqrt(max(rms**2 - floor**2, 0.0)) if math.isfinite(floor) else math.nan
        rows.append((model_text(fitted.choice.effects), _mm(rms), _mm(beyond) if math.isfinite(beyond) else "–"))
    gained = likelihood_change_text(fits[-2].fit, fits[-1].fit) if len(fits) > 1 else ""
    return (
        "<h3>Fitted on this page</h3>"
        + table(rows, ("model", "rms error", "excess over replicates"), (1, 2))
        + (f"<p><small>{escaped(gained)}</small></p>" if gained else "")
    )


def tied_panel(campaign: Campaign, diagnosis: Diagnosis | None, fitted: Fitted | None) -> str:
    """Return what the data cannot separate: effects, by the diagnosis; parameters, by their correlations."""
    parts = []
    if diagnosis is None:
        parts.append(
            "<p>No diagnosis yet: it tests every effect and states which of them these trials cannot tell apart. It"
            " appears here after</p>"
        )
        parts.append(command_block([f"vinetrack diagnose {campaign.folder.as_posix()}"]))
    else:
        verdict = diagnosis.verdict or "not diagnosed"
        parts.append(f"<p><b>{escaped(verdict)}</b>: {escaped(diagnosis.explanation)}</p>")
        if len(diagnosis.answer_set) > 1:
            names = ", ".join(name.replace("_", " ") for name in diagnosis.answer_set)
            parts.append(f"<p>Cannot be told apart: <b>{escaped(names)}</b>.</p>")
        parts += [_cosine_grid(diagnosis)] if diagnosis.rounds else []
    if fitted is not None:
        pairs_words = correlated_pairs_text(fitted.fit)
        parts.append("<h3>In the last fit</h3>")
        # Pairs of correlated parameters shown; chosen: the card has room for six lines
        parts += [f"<p>{escaped(line)}</p>" for line in pairs_words[:6]] or [
            "<p class='muted'>No two parameters have a correlation above 0.9.</p>"
        ]
    return "".join(parts)


def _cosine_grid(diagnosis: Diagnosis) -> str:
    """The cosines between the effects of the likeliest candidates as a table; blank for fewer than two."""
    known, cosines = diagnosis.rounds[0].cosine_names, diagnosis.rounds[0].cosines
    pairs = [(abs(cosines[i][k]), name, other) for i, name in enumerate(known) for k, other in enumerate(known[:i])]
    tied = sorted((pair for pair in pairs if pair[0] >= TIED_COSINE), key=lambda pair: -pair[0])
    likely = [name for name in suspects(diagnosis) if name in known]
    # Candidates in the grid of cosines; chosen: eight columns fit the card of 380 pixels
    names = list(dict.fromkeys([*likely, *(name for _, *pair in tied for name in pair)]))[:8]
    if len(names) < 2:
        return ""
    place = [known.index(name) for name in names]
    titles = [escaped(name.replace("_", " ")) for name in names]
    head = "".join(f"<th class='up'><span>{title}</span></th>" for title in titles)
    body = "".join(
        f"<tr><th>{title}</th>" + "".join(_cosine_cell(cosines[i][k]) for k in place) + "</tr>"
        for title, i in zip(titles, place, strict=True)
    )
    caption = (
        "<small>Cosines between the effects on the trajectories: near ±1 two effects cannot be told apart.</small>"
    )
    return f"<div class='scroll'><table class='cosines'><tr><th></th>{head}</tr>{body}</table></div>{caption}"


def _cosine_cell(cosine: float) -> str:
    """Blue for positive, vermillion for negative cosines, the deeper the larger."""
    if not math.isfinite(cosine):
        return "<td>–</td>"
    strength = min(abs(cosine), 1.0) ** 2
    colour = f"rgba(0,114,178,{strength:.2f})" if cosine > 0 else f"rgba(213,94,0,{strength:.2f})"
    ink = "#fff" if strength > 0.6 else "inherit"
    return f"<td style='background:{colour};color:{ink}'>{cosine:+.2f}</td>"


def next_panel(campaign: Campaign, diagnosis: Diagnosis | None) -> str:
    """Return the next experiment of the diagnosis, as HTML."""
    if diagnosis is None:
        command = command_block([f"vinetrack diagnose {campaign.folder.as_posix()}"])
        return f"<p>A diagnosis states which trial would separate the candidates best.</p>{command}"
    advice = diagnosis.next_experiment
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
    """One condition in the units of the sheet, with what differs from the present rig."""
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


def suspects(diagnosis: Diagnosis | None) -> tuple[str, ...]:
    """Return the effects worth trying first, best first."""
    if diagnosis is None:
        return ()
    ranked = [candidate.effect for candidate in diagnosis.ranking if math.isfinite(candidate.delta_chi2)]
    return tuple(dict.fromkeys([*diagnosis.answer_set, *ranked]))


def diagnosis_of(folder: Path) -> Diagnosis | None:
    """Return the diagnosis of a results folder, None if there is none or it cannot be read."""
    try:
        return read_diagnosis(Results(folder))
    except ResultsError:
        return None
