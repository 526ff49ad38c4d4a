"""The report: all results in one HTML file without scripts or external resources."""

from __future__ import annotations

import base64
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import split_flags
from vinetrack.core.units import display_unit, number, with_error
from vinetrack.figures.registry import all_figures
from vinetrack.figures.style import RULE_NAMES, page_tokens, rows
from vinetrack.narrative.diagnosis_text import (
    DIAGNOSIS_METHODS,
    DIAGNOSIS_REFERENCES,
    REFERENCES,
    damping_headline,
    exponent_table,
    methods,
    status_tally,
    vine_table,
    vines_without_law,
)
from vinetrack.narrative.verdict_text import bounds_text, listed_names
from vinetrack.report.diagnosis_section import DiagnosisResult, diagnosis_section
from vinetrack.report.section import (
    ReportFigure,
    ReportSection,
    ReportTable,
    data_uri,
    figure_entry,
    inline_picture,
    section_entry,
)

if TYPE_CHECKING:
    import pandas as pd

    from vinetrack.diagnosis.result import Diagnosis
    from vinetrack.inference.fit_result import BetweenTrialSpread, Number
    from vinetrack.inference.fit_summary import FitSummary


# ------------------------------------------------------------------------------
# Trials in the report: values, status and reason, strip, motion, data, and calibration.

CALIBRATION_NAMES = {
    "charuco": "ChArUco board",
    "checkerboard": "checkerboard",
    "two_points": "two points and their distance",
    "mm_per_px": "millimetres per pixel, as given",
    "sheet": "millimetres per pixel, from the sheet",
}
FLAG_WORDS = {
    "before_release": "before release",
    "lost": "without the edge",
    "corrected": "corrected by hand",
    "after_end": "after the end",
}
SHARED_ERROR = (
    "The error of the scale is stated separately from the random error of single points: it is common to all points of "
    "a recording and to all recordings of one target. It changes every length and speed by the same factor, so that "
    "replicates do not show it and averaging does not reduce it. It is not included in the ± of a speed or in "
    "bootstrap intervals; the wider intervals of B include it (a relative scale error ε changes ln B by n·ε), and n is "
    "independent of it."
)

# Methods for recordings, as (heading, paragraph) pairs
METHODS = (
    (
        "Edge",
        "A strip along the axis of growth is cut from every frame; flicker and shake are estimated from the stationary "
        "scene beside the vine and removed. A pixel that the vine covers changes once: its brightness before and after "
        "and the position of the edge in every frame are estimated alternately, the edge by maximum likelihood from a "
        "step blurred by the optics and by its own motion, at mid-exposure. Time is the frame number divided by the "
        "capture rate.",
    ),
    (
        "Scale",
        "Positions along the axis are converted with the model of a camera with radial distortion looking at a tilted "
        "plane, fitted to the corners of the target; without a target, with a single scale.",
    ),
)


@dataclass(frozen=True)
class TrackedRecording:
    """A recording in the report: its strip as SVG or PNG (empty for none), the flags of its frames, its calibration.
    `calibration` was written by the recording's stage: `kind, image, mm_per_px, scale_rel_sigma, reprojection_px,
    n_corners, n_pictures, notes`; None if there is none.
    """

    strip: str | bytes
    flags: Sequence[str]
    calibration: Mapping[str, Any] | None = None


def count_frames(flags: Iterable[str]) -> str:
    """Return the number of frames, and of those with each flag, as text."""
    flags = list(flags)
    counted = Counter(part for flag in flags for part in split_flags(flag))
    parts = [f"{count} {FLAG_WORDS.get(flag, flag)}" for flag, count in counted.items()]
    return f"{len(flags)} frames" + (f": {', '.join(parts)}" if parts else "")


def calibration_table(recordings: Mapping[str, TrackedRecording]) -> list[dict[str, Any]]:
    """Return one row per calibration, with its results and its trials."""
    groups: dict[tuple[Any, ...], list[tuple[str, Mapping[str, Any]]]] = {}
    for name, recording in recordings.items():
        calibration = recording.calibration
        if calibration is not None:
            key = (
                calibration["kind"],
                calibration["image"],
                calibration["n_corners"],
                calibration["reprojection_px"],
                *calibration["notes"],
            )
            if calibration["kind"] == "sheet":
                key = (*key, calibration["mm_per_px"])
            groups.setdefault(key, []).append((name, calibration))
    return [_calibration_row(members) for members in groups.values()]


def _calibration_row(members: Sequence[tuple[str, Mapping[str, Any]]]) -> dict[str, Any]:
    first = members[0][1]
    scales = [calibration["mm_per_px"] for _, calibration in members]
    spread = f"{number(min(scales), 6)}"
    if max(scales) - min(scales) > 1e-5 * max(scales):
        spread += f" to {number(max(scales), 6)}"
    errors = [
        calibration["scale_rel_sigma"] for _, calibration in members if _is_number(calibration["scale_rel_sigma"])
    ]
    has_target = bool(first["n_corners"]) and _is_number(first["reprojection_px"])
    return {
        "kind": CALIBRATION_NAMES.get(first["kind"], first["kind"]),
        "image": first["image"] or "",
        "mm_per_px": spread,
        "error": f"{number(100 * max(errors), 2)} %" if errors else "unknown",
        "reprojection": f"{number(first['reprojection_px'], 2)} px" if has_target else "–",
        "corners": f"{first['n_corners']} in {first['n_pictures']}" if has_target else "–",
        "notes": list(first["notes"]),
        "trials": f"{len(members)} recordings" if len(members) > 1 else members[0][0],
    }


def _is_number(value: Any) -> bool:
    return value is not None and math.isfinite(value)


MAX_TRIAL_FIGURES_BYTES = 10_000_000  # Total size of the figures of single trials

MAX_DATA_ROWS, MAX_DATA_ROWS_TOTAL = 240, 24_000  # Maximum rows of motion data in the page, per trial and in total


def trial_entries(content: ReportContent) -> tuple[list[dict[str, Any]], int]:
    """Return all trials for the template, and the number of trials whose figures were left out for size. Returns
    entries, n_left_out.
    """
    entries, left_out, weight = [], 0, 0
    for row in rows(content.trials):
        entry = _trial_numbers(row, content)
        strip, motion = _trial_pictures(row, content)
        if weight + len(strip) + len(motion) > MAX_TRIAL_FIGURES_BYTES:
            left_out += bool(strip or motion)
            strip = motion = ""
        weight += len(strip) + len(motion)
        entries.append(entry | _marked(strip=strip, motion=motion))
    return entries, left_out


def _marked(**pictures: str) -> dict[str, Any]:
    from markupsafe import Markup

    return {name: Markup(svg) for name, svg in pictures.items()}


def _trial_pictures(row: Any, content: ReportContent) -> tuple[str, str]:
    """Strip and motion figure of one trial, ready for the page; blank if there is none."""
    name = row.trial
    if row.status == "failed":
        return "", ""
    recording, motion = content.recordings.get(name), content.trial_figures.get(name, "")
    strip = recording.strip if recording is not None else ""
    return (
        inline_picture(strip, f"s-{name}", f"Strip of {name} with its tracked edge") if strip else "",
        inline_picture(motion, f"t-{name}", f"Motion of {name}") if motion else "",
    )


def _trial_numbers(row: Any, content: ReportContent) -> dict[str, Any]:
    curve, recording = content.kinematics.get(row.trial), content.recordings.get(row.trial)
    spark, data = "", ""
    if curve is not None and len(curve) > 1:
        time_s, speed_m_s = (curve[name].to_numpy(dtype=float) for name in ("time_s", "lead_velocity_m_s"))
        spark = speed_sparkline(time_s, speed_m_s, (row.steady_from_s, row.steady_to_s))
        data = data_uri(f"{row.trial}.csv", _thinned(curve, len(content.trials)))
    return {
        "trial": row.trial,
        "vine": row.vine,
        "condition": row.condition,
        "status": row.status,
        "reason": row.reason if isinstance(row.reason, str) else "",
        "x_ss": with_error(row.x_ss_m_s, row.x_ss_sigma_m_s),
        "x_ss_paper": number(row.x_ss_paper_m_s),
        "force": number(row.force_N),
        "final": number(row.final_lead_velocity_m_s),
        "efficiency": number(100 * row.efficiency),
        "frames": "" if recording is None or row.status == "failed" else count_frames(recording.flags),
        "clip": content.clips.get(row.trial, ""),
        "data": data,
        "windows": [_window(window) for window in rows(content.windows[content.windows["trial"] == row.trial])],
        **_marked(spark=spark),
    }


def _thinned(curve: pd.DataFrame, n_trials: int) -> str:
    """Motion of a trial as CSV, with five digits, more than the accuracy of any value."""
    most = max(min(MAX_DATA_ROWS_TOTAL // n_trials, MAX_DATA_ROWS), 2)
    shown = curve.iloc[:: -(-len(curve) // most)]
    return str(shown.to_csv(index=False, float_format="%.5g", lineterminator="\n"))


def _window(window: Any) -> dict[str, str]:
    return {
        "rule": RULE_NAMES.get(window.rule, str(window.rule)),
        "verdict": "accepted" if window.accepted else "rejected",
        "from_to": f"{number(window.from_s, 4)} to {number(window.to_s, 4)} s",
        "points": str(int(window.points)),
        "x_ss": with_error(window.x_ss_m_s, window.x_ss_sigma_m_s),
        "drift": number(100 * window.drift, 2),
        "cv": number(100 * window.cv, 2),
        "reason": window.reason if isinstance(window.reason, str) else "",
    }


def speed_sparkline(
    time_s: NDArray[np.float64],
    speed_m_s: NDArray[np.float64],
    steady_s: tuple[float, float],
    width_px: int = 132,
    height_px: int = 30,
) -> str:
    """Return speed against time as a small SVG, with the steady window thick; blank if there is nothing to draw.
    Shapes: time_s, speed_m_s (n_points,).
    """
    good = np.isfinite(time_s) & np.isfinite(speed_m_s)
    time_s, speed_m_s = time_s[good], speed_m_s[good]
    if time_s.size < 2 or np.ptp(time_s) <= 0:
        return ""
    step = max(time_s.size // width_px, 1)
    time_s, speed_m_s = time_s[::step], speed_m_s[::step]
    top = max(float(np.percentile(speed_m_s, 99)), 1e-12)
    x = 1 + (width_px - 2) * (time_s - time_s[0]) / np.ptp(time_s)
    y = np.clip(height_px - 2 - (height_px - 5) * speed_m_s / top, 1, height_px - 1)
    steady = (time_s >= steady_s[0]) & (time_s <= steady_s[1])
    thick = f'<polyline class="steady" points="{_polyline(x[steady], y[steady])}"/>' if steady.sum() > 1 else ""
    return (
        f'<svg class="spark" viewBox="0 0 {width_px} {height_px}" width="{width_px}" height="{height_px}" '
        f'aria-hidden="true"><polyline points="{_polyline(x, y)}"/>{thick}</svg>'
    )


def _polyline(x: NDArray[np.float64], y: NDArray[np.float64]) -> str:
    return " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))


# ------------------------------------------------------------------------------
# The section of the report that compares the model in use with the measurement.

_EXPLAINED = (
    "The model in use is fitted to the positions of all trials at once. Each trial is then predicted with its own "
    "release and origin, at the nominal pressure and the vine's B: the difference is the error of position. The error "
    "of a complete model equals the replicate scatter: a ratio near 1 leaves nothing to explain, and with few "
    "replicates it may fall below 1 by chance. Final speeds of the leading edge are compared at the same growth."
)


@dataclass(frozen=True)
class ModelResult:
    """The fit, the comparison and the check of the damping law of a results folder."""

    fit: FitSummary
    comparison: pd.DataFrame
    check: pd.DataFrame
    diagnosis: Diagnosis | None = None


def model_section(result: ModelResult | None) -> dict[str, Any] | None:
    """Return the section on the model in use as text for the template; None if no model was fitted or refused."""
    if result is None:
        return None
    fit = result.fit
    return {
        "names": " + ".join(fit.names),
        "final": _final(result.diagnosis),
        "is_refuted": result.diagnosis is not None and result.diagnosis.refutes,
        "refused": fit.refused,
        "explained": _EXPLAINED,
        "verdict": verdict(result.comparison),
        "numbers": [_number(entry) for entry in fit.numbers],
        "spreads": [_spread(name, spread) for name, spread in fit.spreads.items()],
        "messages": list(fit.messages),
        "left_out": [f"{name}: {reason}" for name, reason in fit.left_out.items()],
        "warnings": list(fit.warnings),
        "conditions": [_condition(row) for row in rows(result.comparison)],
        "check": [_check(row) for row in rows(result.check)],
    }


def _final(diagnosis: Diagnosis | None) -> dict[str, Any] | None:
    """The final model of the diagnosis; None if nothing was added."""
    if diagnosis is None or not diagnosis.effects:
        return None
    from vinetrack.narrative.verdict_text import settled_rows

    text = ""
    if diagnosis.ladder is not None and len(diagnosis.ladder):
        last = settled_rows(diagnosis.ladder).iloc[-1]
        inside, outside, floor = (
            number(1e3 * float(last[key])) for key in ("rms_in_sample_m", "rms_left_out_m", "floor_m")
        )
        text = (
            f"With {listed_names(diagnosis.effects)} the error of the model is {inside} mm, and {outside} mm on "
            f"conditions left out of the fit; replicate scatter is {floor} mm (root mean square)."
        )
    return {
        "names": " + ".join(diagnosis.final_model),
        "verdict": text,
        "numbers": [_number(entry) for entry in diagnosis.parameters],
    }


def verdict(comparison: pd.DataFrame) -> str:
    """Return the position error of the model in two sentences; blank without a condition."""
    if not len(comparison):
        return ""
    worst = comparison.sort_values("rms_position_m").iloc[-1]
    sentence = (
        f"Over {_conditions(len(comparison))} the model is off by {number(1e3 * _rms(comparison['rms_position_m']))} mm"
    )
    known = comparison[comparison["replicate_floor_m"] > 0]
    if len(known):
        sentence += f", and replicates scatter by {number(1e3 * _rms(known['replicate_floor_m']))} mm"
    return (
        f"{sentence} (root mean square). Worst is {worst['condition']}, by {number(1e3 * worst['rms_position_m'])} mm, "
        f"with the maximum after {number(1e3 * worst['worst_at_m'])} mm of growth."
    )


def _conditions(count: int) -> str:
    return "one condition" if count == 1 else f"{count} conditions"


def _rms(values: pd.Series) -> float:
    return math.sqrt(float((values**2).mean()))


def _number(entry: Number) -> dict[str, str]:
    unit, factor = display_unit(entry.unit)
    return {
        "symbol": entry.symbol,
        "vine": entry.vine,
        "parameter": entry.key,
        "value": with_error(factor * entry.value, factor * entry.sigma),
        "interval": bounds_text(entry),
        "unit": unit,
    }


def _spread(name: str, spread: BetweenTrialSpread) -> str:
    how = "" if spread.estimated else " (fixed)"
    return f"{name} {number(100 * spread.value, 2)} %{how}"


def _condition(row: Any) -> dict[str, str]:
    return {
        "condition": row.condition,
        "rms": number(1e3 * row.rms_position_m),
        "floor": number(1e3 * row.replicate_floor_m),
        "ratio": number(row.ratio, 2),
        "speed": number(row.rms_final_velocity_m_s),
        "worst_ms": number(1e3 * row.worst_at_s),
        "worst_mm": number(1e3 * row.worst_at_m),
    }


def _check(row: Any) -> dict[str, str]:
    return {
        "vine": row.vine,
        "n_steady": number(row.n_steady),
        "n_trajectory": number(row.n_trajectory),
        "B_steady": number(row.B_steady),
        "B_trajectory": number(row.B_trajectory),
        "z": number(row.z, 2),
    }


__all__ = ["Clip", "ReportContent", "ReportFigure", "ReportSection", "ReportTable", "build_report"]

MAX_CLIP_BYTES = 2_500_000  # Chosen: a sixth of the 15 MB that a report may have


@dataclass(frozen=True)
class Clip:
    """A clip that plays in the page: the trial, the MP4 file, a caption, and a WebP poster. The poster is shown until
    the clip plays, and in print.
    """

    trial: str
    mp4: bytes
    caption: str
    poster: bytes = b""


@dataclass(frozen=True, kw_only=True)
class ReportContent:
    """Content of the report: tables, figures and provenance of the results folder. `recordings` has an entry for every
    trial with a recording; `clips` has the path of the clip of a trial relative to the page, and `clip` the one that
    plays in it. `sections` are further parts, shown before the trials.
    """

    name: str
    trials: pd.DataFrame
    windows: pd.DataFrame
    damping: Mapping[str, Any]
    provenance: Mapping[str, Any]
    kinematics: Mapping[str, pd.DataFrame]
    figures: Sequence[ReportFigure] = ()
    trial_figures: Mapping[str, str | bytes] = field(default_factory=dict)
    recordings: Mapping[str, TrackedRecording] = field(default_factory=dict)
    clips: Mapping[str, str] = field(default_factory=dict)
    clip: Clip | None = None
    model: ModelResult | None = None
    diagnosis: DiagnosisResult | None = None
    sections: Sequence[ReportSection] = ()
    notes: Sequence[str] = ()


def build_report(content: ReportContent) -> str:
    """Return the page. User text is escaped; only SVG made by the package is inserted as it is."""
    from jinja2 import Environment, FunctionLoader, StrictUndefined
    from markupsafe import Markup

    folder = files("vinetrack.report") / "templates"
    loader = FunctionLoader(lambda name: (folder / name).read_text(encoding="utf-8"))
    environment = Environment(
        loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    settings = content.provenance.get("settings") or {}
    trials, n_left_out = trial_entries(content)
    return environment.get_template("report.html").render(
        name=content.name,
        style=Markup(page_tokens() + (folder / "report.css").read_text(encoding="utf-8")),
        headline=damping_headline(content.damping),
        tally=status_tally(content.trials),
        notes=content.notes,
        exponents=exponent_table(content.damping),
        without_law=vines_without_law(content.damping),
        vines=vine_table(content.damping),
        model=model_section(content.model),
        diagnosis=diagnosis_section(content.diagnosis),
        figures=_figures(content),
        clip=_clip(content.clip),
        sections=[section_entry(section) for section in content.sections],
        trials=trials,
        n_left_out=n_left_out,
        calibrations=calibration_table(content.recordings),
        shared_error=SHARED_ERROR,
        methods=[
            *(METHODS if content.recordings else ()),
            *methods(settings),
            *(DIAGNOSIS_METHODS if content.diagnosis else ()),
        ],
        references=[*REFERENCES, *(DIAGNOSIS_REFERENCES if content.diagnosis else ())],
        settings=sorted(_flat(settings)),
        provenance=content.provenance,
    )


def _figures(content: ReportContent) -> dict[str, list[dict[str, Any]]]:
    """Figures for the template, by section of the page."""
    sections = {name: figure.section for name, figure in all_figures().items()}
    by_section: dict[str, list[dict[str, Any]]] = {section: [] for section in sections.values()}
    for figure in content.figures:
        by_section[sections.get(figure.key, "damping")].append(figure_entry(figure))
    return by_section


def _clip(clip: Clip | None) -> dict[str, str] | None:
    if clip is None or len(clip.mp4) > MAX_CLIP_BYTES:
        return None
    source, poster = (base64.b64encode(part).decode("ascii") for part in (clip.mp4, clip.poster))
    return {
        "trial": clip.trial,
        "caption": clip.caption,
        "source": f"data:video/mp4;base64,{source}",
        "poster": f"data:image/webp;base64,{poster}" if poster else "",
    }


def _flat(settings: Mapping[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    """Nested settings as (dotted name, value) pairs."""
    pairs: list[tuple[str, str]] = []
    for key, value in settings.items():
        if isinstance(value, Mapping):
            pairs += _flat(value, f"{prefix}{key}.")
        else:
            pairs.append((f"{prefix}{key}", "–" if value is None else str(value)))
    return pairs
