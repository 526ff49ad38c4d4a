"""The report: all results in one HTML file without scripts or external resources; the clips of recordings beside it,
slowed down, with tracked and modelled edges; and what is shown of a single recording.
"""

from __future__ import annotations

import base64
import contextlib
import io
import math
import re
import shlex
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import partial
from html import escape
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from vinetrack.core.records import UNUSABLE_FLAGS, Floats, Trial, with_flag
from vinetrack.core.tables import replacing, write_bytes, write_csv
from vinetrack.core.units import display_unit, interval, number, pressure_text, with_error
from vinetrack.diagnosis.result import ADEQUATE, NOT_TESTABLE, REFITTED, VERDICTS, Candidate, Diagnosis
from vinetrack.effects import EffectError, catalogue
from vinetrack.experiment.schema import LIMITED
from vinetrack.experiment.settings import OverlaySettings
from vinetrack.figures.motion_figures import TRACKED, ClipView, Edge, compose, draw_strip, levels
from vinetrack.figures.registry import FigureTables, RegisteredFigure, all_figures, figures_of
from vinetrack.figures.style import BLUE, GREEN, GRID, INK, MUTED, PAPER, SKY, VERMILLION, render, rows
from vinetrack.narrative import sentence
from vinetrack.narrative.diagnosis_text import LAW_METHODS, POWER_COLUMNS, damping_headline, power_rows, status_tally
from vinetrack.narrative.verdict_text import (
    bounds_text,
    estimates_text,
    expected_text,
    is_finite,
    listed_names,
    spaced_name,
    verdict_sentence,
    verdict_table,
)
from vinetrack.planning.predictive_inputs import SOURCE
from vinetrack.results import Results, ResultsError, read_diagnosis, read_fit, read_json, read_result
from vinetrack.tracks.importers import FEWEST_POINTS
from vinetrack.video.axis import Axis, axis_entry, axis_from_entry
from vinetrack.video.frames import Recording, RecordingError, inspect_recording, iterate_frames
from vinetrack.video.survey import Measurement

if TYPE_CHECKING:
    import pandas as pd

    from vinetrack.effects import Effect
    from vinetrack.experiment.folder import Experiment
    from vinetrack.figures.registry import DiagnosisTables


# ------------------------------------------------------------------------------
# Building blocks of the page.

# CSS custom property by colour of a figure, with a value for either scheme in `page_tokens.css`; purple, sky and orange
# are visible in both.
TOKENS = {INK: "--ink", GRID: "--grid", MUTED: "--muted", PAPER: "--paper"}
TOKENS |= {BLUE.lower(): "--blue", VERMILLION.lower(): "--vermillion", GREEN.lower(): "--green"}


def inline_picture(picture: str | bytes | None, prefix: str, description: str) -> Markup:
    """Return an SVG or PNG file as an element of the page, `--wide` if there is room; blank for none."""
    if not picture:
        return Markup()
    label = escape(description, quote=True)
    if isinstance(picture, str):
        return Markup(_inline_svg(picture, prefix, label))
    from PIL import Image

    image = Image.open(io.BytesIO(picture))
    wide = 96 * image.width / image.info.get("dpi", (150, 150))[0]
    return Markup(f'<img alt="{label}" style="--wide:{wide:.0f}px" src="{base64_uri("image/png", picture)}">')


def _inline_svg(svg: str, prefix: str, label: str) -> str:
    """An SVG of matplotlib with its colours from the page, so that it follows a dark scheme, and unique identifiers."""
    found = re.search(r'<svg[^>]* viewBox="0 0 ([\d.]+) ([\d.]+)"[^>]*>(.*)</svg>', svg, re.DOTALL)
    assert found is not None
    width, height = float(found[1]), float(found[2])
    colours = {colour: "currentColor" if token == "--ink" else f"var({token})" for colour, token in TOKENS.items()}
    body = re.sub(r"<metadata>.*?</metadata>|<style.*?</style>|<!--.*?-->", "", found[3], flags=re.DOTALL)
    body = re.sub("|".join(colours), lambda match: colours[match[0]], body)
    used = dict.fromkeys(re.findall(r'(?:url\(|href=")#([^")]+)', body))
    own = {name: f"{escape(prefix, quote=True)}-{k}" for k, name in enumerate(used)}
    body = re.sub(r' id="([^"]*)"', lambda match: f' id="{own[match[1]]}"' if match[1] in own else "", body)
    body = re.sub(r'(url\(|href=")#([^")]+)', lambda match: f"{match[1]}#{own[match[2]]}", body)
    head = f'viewBox="0 0 {width:g} {height:g}" role="img" aria-label="{label}" style="--wide:{1.33 * width:.0f}px"'
    return f"<svg {head}>{body}</svg>"


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


# ------------------------------------------------------------------------------
# The section of the report on the diagnosis: candidates, upper limits, tied candidates, the next trial, drift.


def diagnosis_section(content: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return the section on the diagnosis as text for the template; None if there is no diagnosis."""
    diagnosis: Diagnosis | None = content["diagnosis"]
    effects: Mapping[str, Effect] = content["effects"]
    if diagnosis is None:
        return None
    drifting = [str(row["sentence"]) for row in diagnosis.drift if row.get("sentence") and row.get("significant", True)]
    rounds, named = [], () if diagnosis.contradicted_columns else diagnosis.effects or diagnosis.answer_set
    for entry in diagnosis.rounds:
        testable = [row for row in entry.ranking if row.status != NOT_TESTABLE]
        # Those that were fitted, that cannot be excluded, or that reach 2 σ
        ranking = [row for row in testable if row.in_answer_set or row.status == REFITTED or abs(row.sigma) >= 2.0]
        untestable = [row for row in entry.ranking if row.status == NOT_TESTABLE]
        blind = [f"{spaced_name(row.effect)}: {row.reason or 'no reason given'}" for row in untestable]
        rounds.append({"ranking": ranking, "n_below": len(testable) - len(ranking), "blind": blind, "of": entry})
    sizes, power = [], diagnosis.power
    told = [sentence("false_alarms", {"rate": power.false_alarm_rate})] if power is not None else []
    if power is not None and power.wary:
        told.append(f"Detectable sizes are not known: {power.wary}.")
    elif power is not None:
        sizes = power_rows(sorted(power.effects, key=lambda entry: -entry.probability_at(entry.largest)))
    # Upper limits are valid only if no effect is missing.
    last = diagnosis.rounds[-1].ranking if diagnosis.final_verdict == ADEQUATE else ()
    limits = upper_limits(last, effects, diagnosis.pressure_unit)
    hidden = [(*name, limit) for name, limit in limits.items() if name not in {row[:2] for row in sizes}]
    columns = ["Effect", "number", *["at most"][: len(limits)], *POWER_COLUMNS[2:]]
    if limits:
        sizes = [(*row[:2], limits.get(row[:2], "–"), *row[2:]) for row in sizes]
    tied = [  # candidates with nearly proportional effects on the trajectories, from a cosine of 0.95 on (chosen)
        (abs(value), f"{spaced_name(entry.cosines.effects[j])} and {spaced_name(entry.cosines.effects[i])}")
        for entry in diagnosis.rounds[:1]
        for i, row in enumerate(entry.cosines.matrix)
        for j, value in enumerate(row[:i])
        if is_finite(value) and abs(value) >= 0.95
    ]
    badge = diagnosis.verdict if diagnosis.verdict in VERDICTS else "not diagnosed"
    return {
        "badge": "check the sheet" if diagnosis.contradicted_columns else badge,
        "kind": badge if badge in VERDICTS and not diagnosis.contradicted_columns else "none",
        "sentence": verdict_sentence(diagnosis),
        "summaries": [effects[name].summary for name in named if name in effects],
        "table": verdict_table(replace(diagnosis, results=shlex.quote(f"results/{content['name']}"))),
        "where": [line for line in map(str, diagnosis.where) if line not in drifting],
        "rounds": rounds,
        "hidden": hidden,
        "power": power and {"sentences": told, "sizes": sizes, "columns": columns},
        "tied": "; ".join(f"{text} (cosine {number(value)})" for value, text in sorted(tied, reverse=True)[:3]),
        "next": next_experiment(diagnosis.next_experiment),
        "drift": drifting,
    }


def upper_limits(
    ranking: Sequence[Candidate], effects: Mapping[str, Effect], pressure_unit: str = "kPa"
) -> dict[tuple[str, ...], str]:
    """Return one-sided 95 % upper limits by candidate of a ranking and symbol; `effects` are known by name."""
    limits: dict[tuple[str, ...], str] = {}
    for row in ranking:
        named = effects[row.effect].parameters if row.effect in effects else ()
        of = {parameter.name: (parameter.symbol, parameter.unit) for parameter in named}
        of |= {entry.key.split(".")[-1]: (entry.symbol, entry.unit) for entry in row.numbers}
        for name, largest in row.largest.items():
            if is_finite(largest):
                short = name.split(".")[-1]
                symbol, unit = of.get(short) or (short, "SI")
                shown, factor = display_unit(unit, pressure_unit)
                limits[spaced_name(row.effect), symbol] = f"{number(factor * largest)} {shown}".strip()
    return limits


def next_experiment(content: Mapping[str, Any] | None) -> dict[str, Any] | None:
    """Return the next experiment for the template: text, trials, and the expected significances; None for none."""
    if not content:
        return None
    trials = [dict(trial) for trial in content.get("trials") or []]
    keys = ("replicates", *LIMITED["range"], *(name for name in LIMITED["choice"] if name != "growth_angle_deg"))
    shown = [key for key in keys if any(is_finite(trial.get(key)) for trial in trials)]
    whole = {"replicates": "trials", "pressure_kPa": "pressure"}
    head = [whole.get(key, key.rpartition("_")[0] + f" ({key.rpartition('_')[2]})") for key in shown]
    rows = []
    for trial in trials:
        texts = {"replicates": str(trial.get("replicates"))}
        pressure_Pa = 1e3 * trial.get("pressure_kPa", math.nan)
        texts["pressure_kPa"] = pressure_text(pressure_Pa, trial.get("pressure_unit", "kPa"))
        rows.append([texts.get(key) or number(trial.get(key)) for key in shown])
    separations = [
        (" from ".join(map(spaced_name, pair.split(" | "))), number(sigma, 2))
        for pair, sigma in (content.get("separation_sigma") or {}).items()
    ]
    return {
        "text": str(content.get("text") or ""),
        "trials": ReportTable("", head, rows if head else (), frozenset(range(len(head)))),
        "separations": separations,
        "calibration": str(content.get("calibration") or ""),
    }


# ------------------------------------------------------------------------------
# Section of the report that compares the paper's numbers with ours: `paper.csv`, figures.


def paper_section(table: pd.DataFrame, figures: Sequence[ReportFigure]) -> dict[str, Any]:
    """Return the section for the template: paragraphs, then tables, then figures."""
    from vinetrack.paper.rows import MARKS

    present = [f"“{mark}”: {words}" for mark, words in MARKS.items() if (table["mark"] == mark).any()]
    return {
        "key": "paper",
        "title": "Comparison with the paper",
        "paragraphs": [
            f"The numbers of {SOURCE} next to ours. {tally(table)} Each row is marked with its kind.",
            f"{'; '.join(present)}.",
            "The errors of Eq. (2) at low pressure (1.90 cm at 7 kPa) are compared with those that a chamber without "
            "refill, and a tail that cannot push, would cause in the same vine. Neither is claimed to be the reason: "
            "how fast the regulator refills, and how long the vines were, is not published, and B and n of Fig. 6 may "
            "have absorbed a part of it.",
        ],
        "tables": [every_row(table)],
        "figures": figures,
    }


def tally(table: pd.DataFrame) -> str:
    """Return the number of rows of each kind, as a sentence."""
    from vinetrack.paper.rows import MARKS

    counts = table["mark"].value_counts()
    parts = [f"{counts[mark]} {mark}" for mark in MARKS if counts.get(mark, 0)]
    return f"{len(table)} rows: {', '.join(parts)}."


def every_row(table: pd.DataFrame) -> ReportTable:
    """Return all rows of `paper.csv`."""
    head = ("where", "what", "printed", "here (95 %)", "kind", "how obtained, and remarks")
    body = []
    for row in rows(table):
        what = ", ".join(filter(None, (row.quantity, row.setting))) + (f" ({row.unit})" if row.unit != "1" else "")
        remarks = "; ".join(filter(None, (row.how, row.beside)))
        whole = abs(row.ours - np.round(row.ours)) <= 1e-9 * abs(row.ours)
        ours, bounds = f"{row.ours:.0f}" if whole else number(row.ours), interval((row.ours_low_95, row.ours_high_95))
        ours += f" ({bounds})" if math.isfinite(row.ours) and bounds != "–" else ""
        body.append((row.where, what, row.as_printed, ours, row.mark, remarks))
    return ReportTable("Every number", head, body, frozenset({2, 3}))


# ------------------------------------------------------------------------------
# Calibration.


def calibration_table(calibrations: Mapping[str, Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return one row per calibration, with its results and its trials."""
    groups: dict[tuple[Any, ...], list[tuple[str, Mapping[str, Any]]]] = {}
    for name, one in calibrations.items():
        own = one["mm_per_px"] if one["kind"] == "sheet" else None
        key = (one["kind"], one["image"], one["n_corners"], one["reprojection_px"], *one["notes"], own)
        groups.setdefault(key, []).append((name, one))
    names = {
        "charuco": "ChArUco board",
        "two_points": "two points and their distance",
        "mm_per_px": "millimetres per pixel, as given",
        "sheet": "millimetres per pixel, from the sheet",
    }
    table = []
    for members in groups.values():
        first = members[0][1]
        scales = [one["mm_per_px"] for _, one in members]
        spread = number(min(scales), 6)
        if max(scales) - min(scales) > 1e-5 * max(scales):
            spread += f" to {number(max(scales), 6)}"
        errors = [one["scale_rel_sigma"] for _, one in members if is_finite(one["scale_rel_sigma"])]
        has_target = bool(first["n_corners"]) and is_finite(first["reprojection_px"])
        table.append({
            "kind": names.get(first["kind"], first["kind"]),
            "image": first["image"] or "",
            "mm_per_px": spread,
            "error": f"{number(100 * max(errors), 2)} %" if errors else "unknown",
            "reprojection": f"{number(first['reprojection_px'], 2)} px" if has_target else "–",
            "corners": f"{first['n_corners']} in {first['n_pictures']}" if has_target else "–",
            "notes": first["notes"],
            "trials": f"{len(members)} recordings" if len(members) > 1 else members[0][0],
        })  # fmt: skip
    return table


# ------------------------------------------------------------------------------
# The section of the report that compares the model in use with the measurement.


def beyond_adequate(rms_m: Iterable[float], high_m: Iterable[float], refuted: bool) -> str:
    """In how many conditions the error exceeds the most of an adequate model, and whether the model is refuted."""
    known = [rms > high for rms, high in zip(rms_m, high_m, strict=True) if math.isfinite(high)]
    told = f"; in {sum(known)} of {len(known)} conditions more than an adequate model would be" if known else ""
    return told + ("; the diagnosis refutes this model, by the shape of the motions" if refuted else "")


def model_errors(table: pd.DataFrame, refuted: bool = False) -> str:
    """The position error of the model in two sentences, from `comparison.csv` with numbers of trials; or blank."""
    if not len(table):
        return ""
    worst = table.sort_values("rms_position_m").iloc[-1]
    conditions = "one condition" if len(table) == 1 else f"{len(table)} conditions"
    rms_m = math.sqrt(np.average(table["rms_position_m"] ** 2, weights=table["n_trials"]))
    beyond = beyond_adequate(table["rms_position_m"], table["expected_high_m"], refuted)
    return (
        f"Over {conditions} the model is off by {number(1e3 * rms_m)} mm (root mean square){beyond}. "
        f"Worst is {worst['condition']}, by {number(1e3 * worst['rms_position_m'])} mm, with the maximum after "
        f"{number(1e3 * worst['worst_at_m'])} mm of growth."
    )


# ------------------------------------------------------------------------------
# What the report shows of a results folder, and the page.


def report_content(experiment: Experiment, folder: Path, provenance: Mapping[str, Any]) -> dict[str, Any]:
    """Collect tables, figures and recordings of a results folder, by their names in the templates."""
    results, tables = Results(folder), FigureTables(folder, experiment.trials)
    trials, diagnosis = read_result(results.trials), read_diagnosis(results)
    drawn = [name for name in trials["trial"] if results.kinematics(name).exists()]
    filmed = [trial.name for trial in experiment.trials if trial.video is not None and trial.name in drawn]
    seen = {name: read_json(results.analysed(name)).get("calibration") for name in filmed}
    fit, comparison, sections = read_fit(results), read_result(results.comparison), []
    fitted = Counter(trial.condition for trial in experiment.trials if trial.name in fit.trials)
    if experiment.settings.published:
        figures = _figures(tables, figures_of("paper").values())
        sections = [paper_section(tables.paper, figures)]
    known = dict(catalogue())
    with contextlib.suppress(EffectError):  # the file of an effect may no longer exist
        known |= experiment.user_effects
    return {
        "name": experiment.name,
        "trials": trials,
        "damping": read_json(results.damping),
        "provenance": provenance,
        "figures": _figures(tables, figures_of().values()),
        "pictures": {name: _pictures(results, name) for name in drawn},
        "calibrations": {name: one for name, one in seen.items() if one},
        "clip": _clip(results, tables.diagnosed, trials),
        "fit": fit,
        "comparison": comparison.assign(n_trials=comparison["condition"].map(fitted)),
        "check": read_result(results.model_check),
        "diagnosis": diagnosis,
        "effects": known,
        "sections": sections,
        "notes": experiment.blank_notes,
    }


def _picture(path: Callable[[str], Path], most: int = 1_500_000) -> str | bytes:
    """Return a figure for the page: its SVG of so many bytes at most (a tenth of what a report may have), else
    its PNG; empty if there is none.
    """
    svg, png = path(".svg"), path(".png")
    if svg.exists() and svg.stat().st_size <= most:
        return svg.read_text(encoding="utf-8")
    return png.read_bytes() if png.exists() else b""


def _pictures(results: Results, name: str) -> dict[str, str]:
    """Return the files that show one trial, by what they are, as a page in the results folder links to them."""
    drawn = {"strip": results.strip_figure, "motion": results.trial_figure}
    files = [(word, path(name, form)) for form in (".svg", ".png") for word, path in drawn.items()]
    files.append(("clip", results.overlay(name)))
    return {word: path.relative_to(results.folder).as_posix() for word, path in files if path.exists()}


def _figures(tables: FigureTables, figures: Iterable[RegisteredFigure]) -> list[ReportFigure]:
    """Return the drawn figures with their data: a short file of the results, or a table of its own with five digits."""
    shown = []
    for one in figures:
        if picture := _picture(partial(tables.results.figure, one.name)):
            name, data = one.data, ""
            if "." in name:
                data = (tables.results.folder / name).read_text(encoding="utf-8")
            elif name:
                table, name = getattr(tables, name), f"{one.name}.csv"
                data = table.to_csv(index=False, float_format="%.5g", lineterminator="\n")
            data = data if len(data) < 20_000 else ""  # as a page carries it (chosen); all else lies in the results
            shown.append(ReportFigure(one.name, one.title, one.caption, picture, name, data))
    return shown


def _clip(results: Results, diagnosed: DiagnosisTables | None, trials: pd.DataFrame) -> dict[str, Any] | None:
    """Return the clip that plays in the page, of the condition that the model predicts worst if it has one, else the
    first: trial, caption, MP4 file, and a WebP poster (empty if it cannot be read), shown until it plays and in print.
    """
    import av

    with_clip = trials[[results.overlay(name).exists() for name in trials["trial"]]]
    if not len(with_clip):
        return None
    worst = diagnosed.before_after["trial"] if diagnosed is not None and len(diagnosed.before_after) else ()
    chosen = with_clip[with_clip["trial"].isin(worst)] if with_clip["trial"].isin(worst).any() else with_clip
    name = str(chosen["trial"].iloc[0])
    path, poster = results.overlay(name), io.BytesIO()
    if path.stat().st_size > 2_500_000:  # chosen: a sixth of the 15 MB that a report may have
        return None
    with contextlib.suppress(av.error.FFmpegError), av.open(str(path)) as container:
        frames = list(container.decode(video=0))
        frames[2 * len(frames) // 3].to_image().save(poster, "WEBP", quality=60)  # where models differ visibly
    note = " The condition is the one that the model predicts worst." if len(chosen) < len(with_clip) else ""
    edges = "the tracked edge (yellow)"
    if diagnosed is not None:
        edges += ", that of the model in use (vermillion)"
        edges += f", and that with {diagnosed.added} (blue)" if diagnosed.added else ""
    caption = f"The recording, slowed down, with {edges}.{note}"
    return {"trial": name, "caption": caption, "mp4": path.read_bytes(), "poster": poster.getvalue()}


def build_report(content: dict[str, Any]) -> str:
    """Return the page with this content (`report_content`). User text is escaped; only SVG of the package is not."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("vinetrack.report"),
        undefined=StrictUndefined,
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {one.__name__: one for one in (number, with_error, interval)}
    in_templates = (rows, bounds_text, estimates_text, listed_names, spaced_name, expected_text, model_errors)
    environment.globals |= {one.__name__: one for one in (*in_templates, inline_picture, base64_uri)}
    sections = {name: figure.section for name, figure in all_figures().items()}
    drawn = [(sections.get(one.key, "damping"), one) for one in content["figures"]]
    figures = {part: [one for section, one in drawn if section == part] for part in sections.values()}
    laws = [
        (vine, law, method)
        for method in LAW_METHODS
        for vine, law in ((content["damping"].get(method) or {}).get("vines") or {}).items()
    ]
    page = environment.get_template("report.html").render(
        content
        | {
            "headline": damping_headline(content["damping"]),
            "tally": status_tally(content["trials"]),
            "law_methods": LAW_METHODS,
            "laws": sorted(laws, key=lambda one: (one[1]["diameter_mm"], one[1]["thickness_um"], one[0])),
            "final": content["diagnosis"],
            "diagnosis": diagnosis_section(content),
            "figures": figures,
            "calibrations": calibration_table(content["calibrations"]),
            "run": content["provenance"]["settings"],
        }
    )
    return re.sub("`([^`<]+)`", r"<code>\1</code>", page)


# ------------------------------------------------------------------------------
# Clips of recordings, and what is shown of a single recording.


MARGIN_FRAMES = 8  # Frames before and after the motion that a clip shows (chosen)


def write_overlay(trial: Trial, results: Results, settings: OverlaySettings) -> Path:
    """Write the clip of one trial of a results folder; return its path."""
    track, analysed = read_result(results.track(trial.name)), read_json(results.analysed(trial.name))
    shown, line = frames_to_show(track), analysed["axis"]
    mm_per_px = float(analysed["row"]["mm_per_px"] or math.nan)
    shake_px = shake_along(line, len(track))
    edges, release_s = edges_to_draw(trial.name, results, track)
    edges = [replace(edge, along_px=edge.along_px + shake_px) for edge in edges]
    since_s = track["time_s"].to_numpy(dtype=float) - release_s
    scale = 1e3 * trial.diameter_m / mm_per_px, mm_per_px
    path = results.overlay(trial.name)
    try:
        assert trial.video is not None
        recording = inspect_recording(trial.video)
        draw_clip(path, trial.name, recording, axis_from_entry(line), *scale, edges, since_s, shown, settings)
    except RecordingError as error:
        raise ResultsError(str(error)) from None
    return path


def draw_clip(
    path: Path, title: str, recording: Recording, axis: Axis, tube_px: float, mm_per_px: float, edges: list[Edge],
    since_s: Floats, shown: range, settings: OverlaySettings,
) -> None:  # fmt: skip
    """Write a clip of the shown frames; `since_s` is the time since release. Shapes: since_s (n_frames,)."""

    def drawn() -> Iterator[NDArray[np.uint8]]:
        low = high = 0.0
        for frame, picture in islice(enumerate(iterate_frames(recording)), shown.start, shown.stop, stride):
            if high == low:
                low, high = (float(value) for value in np.percentile(picture, (0.5, 99.5)))
            yield compose(view, levels(picture, low, high), frame, 1e3 * float(since_s[frame]))

    rate = 1.0 / float(np.median(np.diff(since_s))) if len(since_s) > 1 else math.nan
    play_fps, stride = playback_rate(len(shown), settings.seconds)
    size = recording.width, recording.height
    tube_px = tube_px if math.isfinite(tube_px) else 0.2 * min(size)
    view = ClipView(title, axis, edges, tube_px, size, mm_per_px, rate / play_fps / stride, settings.width_px)
    write_clip(path, drawn(), play_fps)


def frames_to_show(track: pd.DataFrame) -> range:
    """Return the range of frames in which the edge moves, with `MARGIN_FRAMES` before and after."""
    edge = track["edge_px"].to_numpy(dtype=float)
    tracked = np.flatnonzero(np.isfinite(edge))
    if tracked.size < FEWEST_POINTS:
        raise ResultsError("its edge was not found, so there is nothing to draw: trials.csv has the reason")
    low, high = float(np.nanmin(edge)), float(np.nanmax(edge))
    start = tracked[edge[tracked] > low + 0.01 * (high - low)][0]
    end = tracked[edge[tracked] < high - 0.002 * (high - low)][-1]
    return range(max(int(start) - MARGIN_FRAMES, 0), min(int(end) + MARGIN_FRAMES, int(tracked[-1])) + 1)


def playback_rate(n_frames: int, seconds: float) -> tuple[float, int]:
    """Return frames per second of a clip of about `seconds`, and of how many frames of the film it shows one."""
    fastest_fps, slowest_fps = 30.0, 4.0  # Limits of the playback rate of a clip, frames per second (chosen)
    stride = max(round(n_frames / seconds / fastest_fps), 1)
    return float(np.clip(n_frames / stride / seconds, slowest_fps, fastest_fps)), stride


def shake_along(line: Mapping[str, Any], n_frames: int) -> Floats:
    """Return the shift of each frame along the axis by camera shake, px, shape (n_frames,); 0 at rest."""
    stored_px = np.asarray(line.get("shake_px", ()), dtype=float)[:n_frames]
    return np.pad(stored_px, (0, n_frames - stored_px.size))


def edges_to_draw(trial: str, results: Results, track: pd.DataFrame) -> tuple[list[Edge], float]:
    """Return the tracked edge, the predicted edges if there are any, and the time of release, s."""
    edge_px = track["edge_px"].to_numpy(dtype=float)
    edges, first_moving = [Edge("tracked edge", TRACKED, edge_px)], frames_to_show(track).start + MARGIN_FRAMES
    release_s = float(track["time_s"].iloc[min(first_moving, len(track) - 1)])
    path = results.predictions(trial)
    if path.exists():
        predicted, to_px = read_result(path), position_to_px(track)
        diagnosis = read_diagnosis(results)
        added = " and ".join(map(spaced_name, diagnosis.effects)) if diagnosis is not None else ""
        models = [("model_before_m", "model in use", VERMILLION, 2.0)]
        models += [("model_after_m", f"with {added}", SKY, 1.4)] if added else []
        time_s, measured_m = (track[name].to_numpy(dtype=float) for name in ("time_s", "lead_position_m"))
        for column, label, colour, reach in models:
            prediction = predicted[["time_s", column]].dropna()
            if not prediction.empty:
                # There is no prediction before the first and after the last frame of the fit.
                ends = {"left": math.nan, "right": math.nan}
                position_m = np.interp(time_s, prediction["time_s"], prediction[column], **ends)
                edges.append(Edge(label, colour, to_px(position_m), 1e3 * (position_m - measured_m), reach))
        fitted = read_fit(results).trials if results.fit.exists() else {}
        release_s = fitted[trial].release_s if trial in fitted else release_s
    by_hand = with_flag(track["flag"], "corrected")
    if by_hand.any():
        edges.append(Edge("corrected by hand", GREEN, np.where(by_hand, edge_px, math.nan)))
    return edges, release_s


def position_to_px(track: pd.DataFrame) -> Any:
    """Return the quadratic (lens, tilt) that converts metres to pixels along the axis, fitted to a track."""
    both = track[["lead_position_m", "edge_px"]].dropna()
    metres, px = both["lead_position_m"].to_numpy(dtype=float), both["edge_px"].to_numpy(dtype=float)
    if len(both) < FEWEST_POINTS or np.ptp(metres) <= 0:
        raise ResultsError("too few of its positions are known in pixels and in metres")
    middle, half = (metres.max() + metres.min()) / 2, np.ptp(metres) / 2
    return np.polynomial.Polynomial.fit(metres, px, 2, domain=[middle - half, middle + half])


# ------------------------------------------------------------------------------
# A single recording, without an experiment: its edge as a table, the strip, the clip; and what it is, in numbers.


def write_recording(folder: Path, measured: Measurement, scaled: bool) -> dict[str, Path]:
    """Write the edge of every frame along the axis and in the picture, in metres if scaled; the strip; and the clip."""
    import pandas as pd

    tracking, recording, m_per_px = measured.tracking, measured.recording, measured.m_per_px
    track, axis, name = tracking.track, tracking.axis, recording.path.name
    assert track.lead_position_systematic_m is not None
    along_px = track.edge_px + tracking.shake_px
    columns = {
        "frame": np.arange(len(track.time_s)),
        "time_s": track.time_s,
        "edge_px": track.edge_px,
        "edge_sigma_px": track.lead_position_sigma_m / m_per_px,
        "edge_systematic_px": track.lead_position_systematic_m / m_per_px,
        **dict(zip(("x_px", "y_px"), axis.points(along_px).T, strict=True)),
    }
    if scaled:
        columns |= {"position_m": track.lead_position_m, "sigma_m": track.lead_position_sigma_m}
        columns |= {"systematic_m": track.lead_position_systematic_m}
    content = pd.DataFrame(columns | {"flag": track.flag})
    written = {"table": folder / "track.csv", "strip": folder / "strip.png", "clip": folder / "overlay.mp4"}
    write_csv(written["table"], content)
    m_per_px = m_per_px if scaled else math.nan
    write_bytes(written["strip"], render(draw_strip(name, tracking, m_per_px), ("png",))["png"])
    shown, edges = frames_to_show(content), [Edge("tracked edge", TRACKED, along_px)]
    since_s = track.time_s - track.time_s[min(shown.start + MARGIN_FRAMES, len(track.time_s) - 1)]
    scale = tracking.tube_width_px if math.isfinite(tracking.tube_width_px) else axis.width_px, 1e3 * m_per_px
    draw_clip(written["clip"], name, recording, axis, *scale, edges, since_s, shown, OverlaySettings())
    return written


def recording_facts(measured: Measurement, rate: float, mm_per_px: float) -> dict[str, Any]:
    """What a recording is and what was found in it, by names with units; NaN or None where not known."""
    recording, tracking, track = measured.recording, measured.tracking, measured.tracking.track
    usable = np.isfinite(track.edge_px) & ~with_flag(track.flag, *UNUSABLE_FLAGS)
    frame, edge_px = np.flatnonzero(usable), track.edge_px[usable]
    growth_px = float(np.ptp(edge_px)) if frame.size else math.nan
    fastest = float(np.nanmax(np.diff(edge_px) / np.diff(frame))) if frame.size > 1 else math.nan
    sigma_px = track.lead_position_sigma_m[usable & ~with_flag(track.flag, "before_release")] / measured.m_per_px
    return {
        "recording": recording.path,
        "width_px": recording.width,
        "height_px": recording.height,
        "bit_depth": recording.bit_depth,
        "playback_fps": recording.playback_fps,
        "capture_fps": rate,
        "exposure_us": math.nan if recording.exposure_s is None else 1e6 * recording.exposure_s,
        "duration_s": len(track.edge_px) / rate,
        "n_frames": len(track.edge_px),
        "n_known": frame.size,
        "axis": axis_entry(tracking.axis),
        "mm_per_px": mm_per_px,
        "scale_rel_sigma": measured.scale_rel_sigma,
        "tube_width_px": tracking.tube_width_px,
        "growth_px": growth_px,
        "growth_mm": mm_per_px * growth_px,
        "fastest_px_per_frame": fastest,
        "fastest_m_s": fastest * mm_per_px / 1e3 * rate,
        "edge_sigma_px": float(np.nanmedian(sigma_px)) if np.isfinite(sigma_px).any() else math.nan,
        "notes": list(track.notes),
    }


def write_clip(path: Path, pictures: Iterable[NDArray[np.uint8]], play_fps: float) -> int:
    """Write RGB pictures of shape (height, width, 3), all of one size and with even sides, as H.264 in MP4 with its
    index in front, which any player, browser and slide plays; the whole clip or nothing. Returns their number.
    """
    import av
    import cv2

    count, stream = 0, None
    with (
        replacing(path) as draft,
        av.open(str(draft), "w", format="mp4", options={"movflags": "+faststart"}) as container,
    ):
        for count, picture in enumerate(pictures, 1):
            if stream is None:
                height, width = picture.shape[:2]
                if height % 2 or width % 2:
                    raise ValueError(f"a clip needs pictures of even sides, not {width} × {height}")
                stream = container.add_stream("libx264", rate=Fraction(play_fps).limit_denominator(1001))
                stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
                # Without mbtree=0 the same pictures are encoded to different bytes (measured).
                options = {"preset": "superfast", "crf": "26", "profile": "high", "tune": "animation"}
                stream.options, context = {**options, "mbtree": "0"}, stream.codec_context
                context.thread_count = 1
                context.colorspace = context.color_primaries = context.color_trc = 6  # BT.601, as OpenCV converts
            planes = np.asarray(cv2.cvtColor(picture, cv2.COLOR_RGB2YUV_I420), dtype=np.uint8)
            frame = av.VideoFrame.from_ndarray(planes, format="yuv420p")
            frame.pts = count - 1
            container.mux(stream.encode(frame))
        if stream is None:
            raise ValueError("there is no picture to make a clip of")
        container.mux(stream.encode())
    return count
