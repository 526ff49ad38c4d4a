"""Building blocks of the page, and its sections on the diagnosis and on the paper."""

from __future__ import annotations

import base64
import io
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import numpy as np
from markupsafe import Markup

from vinetrack.core import published
from vinetrack.core.units import display_unit, interval, number, with_error
from vinetrack.diagnosis.result import ADEQUATE, NOT_TESTABLE, REFITTED, VERDICTS, Candidate, Diagnosis, Round
from vinetrack.experiment.schema import LIMITED
from vinetrack.figures.diagnosis_figures import TIED_COSINE
from vinetrack.figures.paper_figures import CAUSES
from vinetrack.figures.style import TOKENS, rows
from vinetrack.inference.fit_result import Number
from vinetrack.narrative.diagnosis_text import (
    POWER_COLUMNS,
    PREFERRED,
    could_have_seen,
    false_alarm_sentence,
    power_rows,
)
from vinetrack.narrative.verdict_text import (
    estimates_text,
    is_finite,
    listed_names,
    quantity_text,
    spaced_name,
    summary_facts,
    verdict_meaning,
    verdict_sentence,
)

if TYPE_CHECKING:
    import pandas as pd

    from vinetrack.diagnosis.power import Power


def inline_picture(picture: str | bytes, prefix: str, description: str) -> Markup:
    """Return an SVG file or a PNG file as an element of the page, as wide as `--wide` where there is room: then its
    text is as large as that of the page. Blank for an empty file.
    """
    if not picture:
        return Markup()
    if isinstance(picture, str):
        return Markup(_inline_svg(picture, prefix, description))
    from PIL import Image

    image = Image.open(io.BytesIO(picture))
    wide = 96 * image.width / image.info.get("dpi", (150, 150))[0]
    source = _as_webp(picture, 85)  # The same of a whole figure, whose letters must stay sharp (chosen)
    return Markup(f'<img alt="{escape(description, quote=True)}" style="--wide:{wide:.0f}px" src="{source}">')


def _inline_svg(svg: str, prefix: str, description: str) -> str:
    """An SVG of matplotlib with its colours from the page, so that it follows a dark scheme, its identifiers unique,
    coordinates to a hundredth of a point, and its images as WebP.
    """
    found = re.search(r'<svg[^>]* viewBox="0 0 ([\d.]+) ([\d.]+)"[^>]*>(.*)</svg>', svg, re.DOTALL)
    if found is None:
        raise ValueError("not an SVG file of a figure")
    width, height = float(found[1]), float(found[2])
    colours = {colour: "currentColor" if token == "--ink" else f"var({token})" for colour, token in TOKENS.items()}
    any_colour = re.compile("|".join(colours))

    def short(tag: re.Match[str]) -> str:
        return any_colour.sub(lambda match: colours[match[0]], re.sub(r"(\.\d\d)\d+", r"\1", tag[0]))

    body = re.sub(r"<metadata>.*?</metadata>|<style.*?</style>|<!--.*?-->", "", found[3], flags=re.DOTALL)
    body = re.sub(r"<(?!image)[^>]*>", short, body)  # images are placed by matrices, which need all their decimals
    own = f"{escape(prefix, quote=True)}-"
    body = re.sub(r'\bid="|url\(#|href="#', lambda match: match[0] + own, body)
    # WebP quality of the images in a strip, 0 to 100
    body = re.sub(r'data:image/png;base64,([^"]+)', lambda match: _as_webp(base64.b64decode(match[1]), 45), body)
    body = re.sub(r"\s*\n\s*", " ", body)
    label = escape(description, quote=True)
    head = f'viewBox="0 0 {width:g} {height:g}" role="img" aria-label="{label}" style="--wide:{1.33 * width:.0f}px"'
    return f"<svg {head}>{body}</svg>"


def _as_webp(png: bytes, quality: int) -> str:
    """Return a PNG as a data URI of a WebP."""
    from PIL import Image

    picture = Image.open(io.BytesIO(png))
    is_opaque = picture.mode != "RGBA" or picture.getchannel("A").getextrema() == (255, 255)
    file = io.BytesIO()
    picture.convert("RGB" if is_opaque else "RGBA").save(file, "WEBP", quality=quality, method=4)
    return base64_uri("image/webp", file.getvalue())


def base64_uri(kind: str, content: bytes) -> str:
    """Return a file as a data URI."""
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"


@dataclass(frozen=True)
class ReportFigure:
    """A figure of the report: its SVG or PNG, its caption, and its data as a file to download."""

    key: str
    title: str
    caption: str
    picture: str | bytes
    data_name: str = ""
    data: str = ""


@dataclass(frozen=True)
class ReportTable:
    """A table of the report, as text in rows, false if it has none; `numbers` are the right-aligned columns."""

    title: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    numbers: frozenset[int] = frozenset()
    note: str = ""

    def __bool__(self) -> bool:
        return bool(self.rows)


@dataclass(frozen=True)
class ReportSection:
    """A part of the page under one heading: paragraphs, then tables, then figures."""

    key: str
    title: str
    paragraphs: Sequence[str] = ()
    tables: Sequence[ReportTable] = ()
    figures: Sequence[ReportFigure] = ()


def data_uri(name: str, text: str) -> str:
    """Return a file as a data URI, in the shorter of two encodings."""
    unescaped = ",;:!*'()/ -._~+@=$?"  # Characters that need no escaping in a quoted URL
    kind = "application/json" if name.endswith(".json") else "text/csv"
    escaped = f"data:{kind};charset=utf-8,{quote(text, safe=unescaped)}"
    encoded = base64_uri(f"{kind};charset=utf-8", text.encode("utf-8"))
    return min(encoded, escaped, key=len)


# ------------------------------------------------------------------------------
# The section of the report on the diagnosis: candidates, upper limits, tied candidates, the next trial, drift.


@dataclass(frozen=True)
class DiagnosisResult:
    """The diagnosis, with the errors, parameters and damping laws of its models; None for parts that do not exist.
    `summaries` describes each effect in a sentence; `units` has symbol and unit by `effect.parameter`.
    """

    diagnosis: Diagnosis
    ladder: pd.DataFrame | None = None
    moved: pd.DataFrame | None = None
    laws: pd.DataFrame | None = None
    summaries: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, tuple[str, str]] = field(default_factory=dict)


def diagnosis_section(result: DiagnosisResult | None) -> dict[str, Any] | None:
    """Return the section on the diagnosis as text for the template; None if there is no diagnosis."""
    if result is None:
        return None
    diagnosis = result.diagnosis
    drifting = [str(row["sentence"]) for row in diagnosis.drift if row.get("sentence") and row.get("significant", True)]
    rounds, named = [], diagnosis.effects or diagnosis.answer_set
    for entry in diagnosis.rounds:
        untestable = [row for row in entry.ranking if row.status == NOT_TESTABLE]
        blind = [f"{spaced_name(row.effect)}: {row.reason or 'no reason given'}" for row in untestable]
        rounds.append({"table": ranking_table(entry), "blind": blind, "of": entry})
    return {
        "badge": diagnosis.verdict if diagnosis.verdict in VERDICTS else "not diagnosed",
        "kind": diagnosis.verdict if diagnosis.verdict in VERDICTS else "none",
        "sentence": verdict_sentence(diagnosis),
        "meaning": verdict_meaning(diagnosis),
        "summaries": [result.summaries[name] for name in named if name in result.summaries],
        "facts": summary_facts(diagnosis, result.ladder),
        "explanation": diagnosis.explanation,
        "ladder": ladder_table(result.ladder),
        "where": [line for line in diagnosis.where if line not in drifting],
        "force": missing_force(diagnosis.missing_force),
        "rounds": rounds,
        # Upper limits are valid only if no effect is missing.
        "hidden": upper_limit_table(
            diagnosis.rounds[-1].ranking if diagnosis.final_verdict == ADEQUATE else (), result.units
        ),
        "power": power_entry(diagnosis.power),
        "tied": tied_pairs(diagnosis.rounds[0]) if diagnosis.rounds else [],
        "next": next_experiment(diagnosis.next_experiment),
        "drift": drifting,
        "moved": moved_table(result.moved),
        "laws": law_table(result.laws),
        "notes": list(diagnosis.notes),
    }


def ladder_table(ladder: pd.DataFrame | None) -> ReportTable:
    """Return the errors of every model of `ladder.csv`, mm."""
    keys = ("rms_in_sample_m", "rms_left_out_m", "rms_highest_pressure_m", "floor_m", "excess_left_out_m")
    head = (
        "Model",
        "in sample (mm)",
        "conditions left out (mm)",
        "highest pressure left out (mm)",
        "replicates (mm)",
        "excess on left out (mm)",
    )
    rows = [
        (_step(str(row["added"] or ""), row.get("partial")), *(number(1e3 * float(row[key])) for key in keys))
        for row in ([] if ladder is None else ladder.to_dict("records"))
    ]
    note = (
        "Root mean square error of position. Left out: every condition is predicted by the model fitted to all others; "
        "every vine's highest pressure by the model fitted to all lower ones. Excess: √(rms² − replicates²). Partial: "
        "a step that explains part of a misfit that nothing explains in full; it is not claimed to be missing."
    )
    return ReportTable("The numbers of the ladder", head, rows, frozenset(range(1, len(head))), note)


def _step(added: str, partial: object = False) -> str:
    mark = " (partial)" if partial else ""
    return f"+ {listed_names(added.split('+'))}{mark}" if added else "initial model"


def ranking_table(entry: Round) -> ReportTable:
    """Return the candidates of a round that could be tested."""
    head = ("Candidate", "kind", "Δχ²", "σ", "size", "status", "")
    rows = [
        (
            ("● " if row.in_answer_set else "") + spaced_name(row.effect),
            row.kind,
            number(row.delta_chi2),
            number(row.sigma, 2),
            estimates_text(row) or "–",
            "fitted" if row.status == REFITTED else "predicted",
            "; ".join(part for part in ("" if row.plausible else "not plausible", str(row.reason)) if part),
        )
        for row in entry.ranking
        if row.status != NOT_TESTABLE
    ]
    note = (
        "● in the answer set. Δχ² is relative to the noise of the tracks alone; σ also accounts for disagreement "
        "between trials: for a fitted candidate it is √Δχ² or less."
    )
    return ReportTable("", head, rows, frozenset({2, 3}), note)


def upper_limit_table(ranking: Sequence[Candidate], units: Mapping[str, tuple[str, str]]) -> ReportTable:
    """Return one-sided 95 % upper limits on the size of every candidate of a ranking; `units` as in the result."""
    rows = []
    for row in ranking:
        of = {entry.key.split(".")[-1]: (entry.symbol, entry.unit) for entry in row.numbers}
        for name, largest in row.largest.items():
            if not is_finite(largest):
                continue
            short = name.split(".")[-1]
            symbol, unit = of.get(short) or units.get(f"{row.effect}.{short}") or (short, "SI")
            shown, factor = display_unit(unit)
            rows.append((spaced_name(row.effect), symbol, f"{number(factor * largest)} {shown}".strip()))
    note = (
        "Larger sizes contradict these trials (95 %, one-sided; of the sign with the larger limit). Sizes that would "
        "have been detected are larger; they are given with the verdict."
    )
    return ReportTable(
        "Upper limits on undetected effects", ("Candidate", "number", "limit"), rows, frozenset({2}), note
    )


def power_entry(power: Power | None) -> dict[str, Any] | None:
    """Return what the trials could have detected, for the template: sentences and a table of sizes; None if unknown."""
    if power is None:
        return None
    order = [] if power.wary else sorted(power.effects, key=lambda entry: -entry.probability_at(entry.largest))
    head = ("Effect", "number", *POWER_COLUMNS[2:])
    note = (
        "By linear theory, with the noise and scatter of the fit, given all effects of the last model. Power there: at "
        "the largest plausible size. Mistaken for: the other candidates with the highest score, at the size of 90 % "
        "power."
    )
    table = ReportTable("", head, power_rows(order), frozenset({2, 3, 4, 5}), note)
    return {"sentences": [false_alarm_sentence(power), *could_have_seen(power)], "table": table}


def tied_pairs(entry: Round) -> list[str]:
    """Return the pairs of candidates with nearly proportional effects on the trajectories, largest cosine first."""
    names, matrix = entry.cosine_names, entry.cosines
    pairs = [
        (abs(matrix[i][j]), names[i], names[j], matrix[i][j])
        for i in range(len(matrix))
        for j in range(i)
        if is_finite(matrix[i][j]) and abs(matrix[i][j]) >= TIED_COSINE
    ]
    return [
        f"{spaced_name(b)} and {spaced_name(a)} (cosine {number(value)})"
        for _, a, b, value in sorted(pairs, reverse=True)
    ]


def next_experiment(content: Mapping[str, Any] | None) -> dict[str, Any] | None:
    """Return the next experiment for the template: text, trials, and the expected significances; None for none."""
    if not content:
        return None
    trials = [dict(trial) for trial in content.get("trials") or []]
    keys = ("replicates", *LIMITED["range"], *(name for name in LIMITED["choice"] if name != "growth_angle_deg"))
    shown = [key for key in keys if any(is_finite(trial.get(key)) for trial in trials)]
    head = [{"replicates": "trials"}.get(key, key.rpartition("_")[0] + f" ({key.rpartition('_')[2]})") for key in shown]
    rows = [
        [number(trial.get(key)) if key != "replicates" else str(trial.get(key)) for key in shown] for trial in trials
    ]
    simulated = content.get("simulated_sigma") or {}
    separations = []
    for pair, sigma in (content.get("separation_sigma") or {}).items():
        found = simulated.get(pair) or {}
        spread = f"{number(found['mean'], 2)} ± {number(found.get('sd'), 1)}" if is_finite(found.get("mean")) else "–"
        separations.append((" from ".join(map(spaced_name, pair.split(" | "))), number(sigma, 2), spread))
    columns = ("They separate", "by (σ)", "in simulation (σ)")
    return {
        "text": str(content.get("text") or ""),
        "trials": ReportTable("", head, rows if head else (), frozenset(range(len(head)))),
        "separations": ReportTable("", columns, separations, frozenset({1, 2})),
        "calibration": str(content.get("calibration") or ""),
    }


def missing_force(content: Mapping[str, Any] | None) -> dict[str, Any] | None:
    """Return the missing force for the template: sentences, weights and simple laws; None for none."""
    if not content:
        return None
    rows = [
        (
            str(law.get("words") or law.get("law") or ""),
            f"{100 * float(law['explained']):.0f} %" if is_finite(law.get("explained")) else "–",
            with_error(law.get("amplitude_N"), law.get("sigma_N")),
        )
        for law in content.get("laws") or []
    ]
    head = ("Simple law", "explains of the missing force", "size (N)")
    learned = content.get("learned") or {}
    weights = [
        (" and ".join(name.split("+")), f"{100 * float(weight):.1f} %")
        for name, weight in (learned.get("weights") or {}).items()
    ]
    return {
        "sentence": str(content.get("sentence") or content.get("text") or ""),
        "laws": ReportTable("Simple laws that resemble it", head, rows, frozenset({1, 2})),
        "learned": str(learned.get("sentence") or ""),
        "weights": ReportTable(
            "Variables of the learned force", ("Variables", "posterior weight"), weights, frozenset({1})
        ),
    }


def moved_table(moved: pd.DataFrame | None) -> ReportTable:
    """Return the change of the parameters as effects were added, one column per model."""
    entries = [] if moved is None else moved.fillna({"vine": "", "added": ""}).to_dict("records")
    cells: dict[tuple[str, str], dict[str, str]] = {}
    titles: dict[tuple[str, str], str] = {}
    for entry in entries:
        key = (str(entry["parameter"]), str(entry["vine"]))
        fitted = Number.from_json({str(k): v for k, v in entry.items()})
        titles[key] = fitted.title
        cells.setdefault(key, {})[str(entry["added"])] = quantity_text(fitted)
    steps = list(dict.fromkeys(str(entry["added"]) for entry in entries))
    head = ["Parameter", *map(_step, steps)]
    rows = [[titles[key], *(cells[key].get(step, "–") for step in steps)] for key in cells]
    return ReportTable("Parameters of every model", head, rows, frozenset(range(1, len(head))))


def law_table(laws: pd.DataFrame | None) -> ReportTable | None:
    """Return the damping law from steady speeds with the pressure at the vine in each model; None without laws."""
    if laws is None or not len(laws):
        return None
    chosen = laws[laws["method"] == PREFERRED] if (laws["method"] == PREFERRED).any() else laws
    first = set(str(chosen["model"].iloc[0]).split("+"))
    rows = []
    for entry in chosen.to_dict("records"):
        added = [name for name in str(entry["model"]).split("+") if name not in first]
        bounds = {key: [entry[f"{key}_low_95"], entry[f"{key}_high_95"]] for key in ("n", "B")}
        row = (_step("+".join(added)), str(entry["vine"]), number(entry["n"], 4), interval(bounds["n"]))
        rows.append((*row, number(entry["B"], 4), interval(bounds["B"]), f"{entry['n_trials']:.0f}"))
    head = ("Model", "Vine", "n", "95 %", "B, N·(s/m)ⁿ", "95 %", "Trials")
    note = "From steady speeds, as in the section on the damping law, with the pressure at the vine in each model."
    return ReportTable(
        "The damping law with the pressure of every model", head, rows, frozenset(range(2, len(head))), note
    )


# ------------------------------------------------------------------------------
# Section of the report that compares the paper's numbers with ours: Tables I and II, `paper.csv`, figures.


def paper_section(table: pd.DataFrame, departures: pd.DataFrame, figures: Sequence[ReportFigure]) -> ReportSection:
    """Return the section."""
    from vinetrack.paper.rows import MARKS

    by_row = {row.row: row for row in rows(table)}
    present = [f"“{mark}”: {words}" for mark, words in MARKS.items() if (table["mark"] == mark).any()]
    return ReportSection(
        key="paper",
        title="Comparison with the paper",
        paragraphs=[
            f"The numbers of {published.SOURCE} next to ours. {tally(table)} Each row is marked with its kind.",
            f"{'; '.join(present)}.",
            "The errors of Eq. (2) at low pressure (1.90 cm at 7 kPa) are compared with those that a chamber without "
            "refill, and a tail that cannot push, would cause in the same vine. Neither is claimed to be the reason: "
            "how fast the regulator refills, and how long the vines were, is not published, and B and n of Fig. 6 may "
            "have absorbed a part of it.",
        ],
        tables=[table_one(by_row), *table_two(by_row, departures), *every_row(table)],
        figures=list(figures),
    )


def tally(table: pd.DataFrame) -> str:
    """Return the number of rows of each kind, as a sentence."""
    from vinetrack.paper.rows import MARKS

    counts = table["mark"].value_counts()
    parts = [f"{counts[mark]} {mark}" for mark in MARKS if counts.get(mark, 0)]
    return f"{len(table)} rows: {', '.join(parts)}."


def table_one(by_row: Mapping[str, Any]) -> ReportTable:
    """Return Table I of the paper, with the results of Fig. 6 and ours."""
    head = (
        *("R", "wall, µm", "diameter, mm", "heat press, °C", "laser, %"),
        *("B printed, N·(s/m)ⁿ", "B here (95 %)", "R² printed", "R² here"),
    )
    body = []
    for scale, B in published.DAMPING_B.items():
        made = [by_row.get(f"{name}_R{scale}") for name in ("thickness", "diameter", "press", "laser")]
        R2 = f"{published.DAMPING_R2[scale]:g}", number(_value(by_row.get(f"R2_R{scale}")))
        printed = [_shown(_value(row, "published")) for row in made]
        body.append((str(scale), *printed, f"{B:g}", _ours(by_row.get(f"B_R{scale}")), *R2))
    return ReportTable("Table I, with the results of Fig. 6", head, body, frozenset(range(1, len(head))))


def table_two(by_row: Mapping[str, Any], departures: pd.DataFrame) -> list[ReportTable]:
    """Return Table II of the paper, positions and speeds, with ours and the effects of departures from Eq. (2)."""
    about_positions = (
        "Here: mean of the trials minus Eq. (2) with the printed numbers. The last three columns: the error that a "
        "departure from Eq. (2) would cause, simulated for a vine of 280 mm."
    )
    about_speeds = "At 12 cm, over payloads; B of this vine is not printed and is scaled in proportion to the wall."
    positions = ("position_rms", published.POSITION_RMS_CM, about_positions)
    speeds = ("final_speed_rms", published.FINAL_SPEED_RMS_M_S, about_speeds)
    head = ("pressure, kPa", "printed", "here", *CAUSES)
    made = []
    for title, figure, column, factor, (row, printed, note) in (
        ("rms of position, cm", "Fig. 4", "rms_position_m", 100, positions),
        ("rms of final speed, m/s", "Fig. 5", "rms_final_lead_velocity_m_s", 1, speeds),
    ):
        body = []
        for kPa, error in printed.items():
            of_figure = departures[(departures["figure"] == figure) & np.isclose(departures["pressure_kPa"], kPa)]
            caused = [
                _range((factor * of_figure.loc[of_figure["departure"].isin(names), column]).tolist())
                for names in CAUSES.values()
            ]
            body.append((f"{kPa:g}", f"{error:g}", number(_value(by_row.get(f"{row}_{kPa:g}kPa"))), *caused))
        made.append(ReportTable(f"Table II, {title}", head, body, frozenset(range(len(head))), note))
    return made


def _range(sizes: Sequence[float]) -> str:
    """One size, or two as a range, the smaller first; – for none."""
    return " to ".join(dict.fromkeys(map(number, sorted(sizes)))) or "–"


def every_row(table: pd.DataFrame) -> list[ReportTable]:
    """Return all rows of `paper.csv`, in one table for each part of the paper."""
    head = ("what", "printed", "here (95 %)", "kind", "how obtained, and remarks")
    parts = table["where"].str.split(";|,| against", n=1, regex=True).str[0].map(_PARTS).fillna(_ELSEWHERE)
    made = []
    for title in dict.fromkeys([*_PARTS.values(), _ELSEWHERE]):
        body = []
        for row in rows(table[parts == title]):
            what = ", ".join(filter(None, (row.quantity, row.setting))) + (f" ({row.unit})" if row.unit != "1" else "")
            body.append((what, row.as_printed, _ours(row), row.mark, "; ".join(filter(None, (row.how, row.beside)))))
        if body:
            made.append(ReportTable(f"{title}, every number", head, body, frozenset({1, 2})))
    return made


# Part of the paper that a place in it belongs to
_PARTS = {
    "Table I": "Table I",
    **dict.fromkeys(("Section III-D", "Section III-E"), "Protocol"),
    **dict.fromkeys(("Fig. 4", "Fig. 5", "Section IV-A"), "Figs. 4 and 5, Table II"),
    "Fig. 6": "Fig. 6",
    **dict.fromkeys(("Fig. 7A", "Fig. 7B"), "Fig. 7"),
    "Fig. 8": "Fig. 8",
    "Fig. 9": "Fig. 9",
    **dict.fromkeys(("Section III-B", "Section V-B"), "Chamber and injector"),
}
_ELSEWHERE = "The fast vine, air drag, pressures"


def _value(row: Any, column: str = "ours") -> float | None:
    return None if row is None else float(getattr(row, column))


def _ours(row: Any) -> str:
    if row is None or not math.isfinite(row.ours):
        return "–"
    bounds = interval((row.ours_low_95, row.ours_high_95))
    return f"{_shown(row.ours)} ({bounds})" if bounds != "–" else _shown(row.ours)


def _shown(value: float | None) -> str:
    """A number to three digits; integers are unchanged."""
    whole = value is not None and math.isfinite(value) and math.isclose(value, round(value), rel_tol=1e-9)
    return f"{value:.0f}" if whole else number(value)
