"""The report: all results in one HTML file without scripts or external resources."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from vinetrack.core.records import split_flags
from vinetrack.core.units import display_unit, interval, number, with_error
from vinetrack.figures.registry import all_figures
from vinetrack.figures.style import RULE_NAMES, page_tokens, rows
from vinetrack.narrative.diagnosis_text import LAW_METHODS, damping_headline, status_tally
from vinetrack.narrative.verdict_text import bounds_text, is_finite, listed_names, settled_rows
from vinetrack.report.section import (
    DiagnosisResult,
    ReportFigure,
    ReportSection,
    base64_uri,
    data_uri,
    diagnosis_section,
    inline_picture,
)

if TYPE_CHECKING:
    import pandas as pd

    from vinetrack.diagnosis.result import Diagnosis
    from vinetrack.inference.fit_summary import FitSummary


# ------------------------------------------------------------------------------
# Trials in the report: values, status and reason, strip, motion, data, and calibration.


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
    words = {"lost": "without the edge", "corrected": "corrected by hand", "after_end": "after the end"}
    parts = [f"{count} {words.get(flag, flag.replace('_', ' '))}" for flag, count in counted.items()]
    return f"{len(flags)} frames" + (f": {', '.join(parts)}" if parts else "")


def calibration_table(recordings: Mapping[str, TrackedRecording]) -> list[dict[str, Any]]:
    """Return one row per calibration, with its results and its trials."""
    groups: dict[tuple[Any, ...], list[tuple[str, Mapping[str, Any]]]] = {}
    for name, recording in recordings.items():
        one = recording.calibration
        if one is not None:
            key = (one["kind"], one["image"], one["n_corners"], one["reprojection_px"], *one["notes"])
            own = (one["mm_per_px"],) if one["kind"] == "sheet" else ()
            groups.setdefault((*key, *own), []).append((name, one))
    return list(map(_calibration_row, groups.values()))


def _calibration_row(members: Sequence[tuple[str, Mapping[str, Any]]]) -> dict[str, Any]:
    names = {
        "charuco": "ChArUco board",
        "two_points": "two points and their distance",
        "mm_per_px": "millimetres per pixel, as given",
        "sheet": "millimetres per pixel, from the sheet",
    }
    first = members[0][1]
    scales = [one["mm_per_px"] for _, one in members]
    spread = number(min(scales), 6)
    if max(scales) - min(scales) > 1e-5 * max(scales):
        spread += f" to {number(max(scales), 6)}"
    errors = [one["scale_rel_sigma"] for _, one in members if is_finite(one["scale_rel_sigma"])]
    has_target = bool(first["n_corners"]) and is_finite(first["reprojection_px"])
    return {
        "kind": names.get(first["kind"], first["kind"]),
        "image": first["image"] or "",
        "mm_per_px": spread,
        "error": f"{number(100 * max(errors), 2)} %" if errors else "unknown",
        "reprojection": f"{number(first['reprojection_px'], 2)} px" if has_target else "–",
        "corners": f"{first['n_corners']} in {first['n_pictures']}" if has_target else "–",
        "notes": first["notes"],
        "trials": f"{len(members)} recordings" if len(members) > 1 else members[0][0],
    }


MAX_TRIAL_FIGURES_BYTES = 10_000_000  # Total size of the figures of single trials


def trial_entries(content: ReportContent) -> tuple[list[dict[str, Any]], int]:
    """Return all trials for the template, and the number of trials whose figures were left out for size. Returns
    entries, n_left_out.
    """
    entries, left_out, weight = [], 0, 0
    for row in rows(content.trials):
        name, curve = row.trial, content.kinematics.get(row.trial)
        curve = None if curve is None or len(curve) < 2 else curve
        shown = None if row.status == "failed" else content.recordings.get(name)
        strip = inline_picture(shown.strip if shown else "", f"s-{name}", f"Strip of {name} with its tracked edge")
        drawn = "" if row.status == "failed" else content.trial_figures.get(name, "")
        motion = inline_picture(drawn, f"t-{name}", f"Motion of {name}")
        if weight + len(strip) + len(motion) > MAX_TRIAL_FIGURES_BYTES:
            left_out += bool(strip or motion)
            strip = motion = Markup()
        weight += len(strip) + len(motion)
        entry = {
            "row": row,
            "frames": count_frames(shown.flags) if shown else "",
            "spark": "" if curve is None else speed_sparkline(curve, (row.steady_from_s, row.steady_to_s)),
            "data": "" if curve is None else data_uri(f"{name}.csv", _thinned(curve, len(content.trials))),
            "clip": content.clips.get(name, ""),
            "windows": list(rows(content.windows[content.windows["trial"] == name])),
        }
        entries.append({**entry, "strip": strip, "motion": motion})
    return entries, left_out


def _thinned(curve: pd.DataFrame, n_trials: int) -> str:
    """Motion of a trial as CSV, with five digits, more than the accuracy of any value."""
    # 240, 24_000: maximum rows of motion data in the page, per trial and in total
    most = max(min(24_000 // n_trials, 240), 2)
    shown = curve.iloc[:: -(-len(curve) // most)]
    return str(shown.to_csv(index=False, float_format="%.5g", lineterminator="\n"))


def speed_sparkline(curve: pd.DataFrame, steady_s: tuple[float, float]) -> Markup:
    """Return the speed of a trial against time as a small SVG, with the steady window thick; blank if there is nothing
    to draw.
    """
    spark_px = (132, 30)  # Width and height of the small curve of a trial (chosen)
    known = curve[np.isfinite(curve["time_s"]) & np.isfinite(curve["lead_velocity_m_s"])]
    known = known.iloc[:: max(len(known) // spark_px[0], 1)]
    time_s, speed_m_s = (known[name].to_numpy(dtype=float) for name in ("time_s", "lead_velocity_m_s"))
    if len(known) < 2 or np.ptp(time_s) <= 0:
        return Markup()
    width, height = spark_px
    top = max(float(np.percentile(speed_m_s, 99)), 1e-12)
    x = 1 + (width - 2) * (time_s - time_s[0]) / np.ptp(time_s)
    y = np.clip(height - 2 - (height - 5) * speed_m_s / top, 1, height - 1)
    steady = (time_s >= steady_s[0]) & (time_s <= steady_s[1])
    thick = f'<polyline class="steady" points="{_polyline(x[steady], y[steady])}"/>' if steady.sum() > 1 else ""
    return Markup(
        f'<svg class="spark" viewBox="0 0 {width} {height}" width="{width}" height="{height}" '
        f'aria-hidden="true"><polyline points="{_polyline(x, y)}"/>{thick}</svg>'
    )


def _polyline(x: NDArray[np.float64], y: NDArray[np.float64]) -> str:
    return " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))


# ------------------------------------------------------------------------------
# The section of the report that compares the model in use with the measurement.


@dataclass(frozen=True)
class ModelResult:
    """The fit, the comparison and the check of the damping law of a results folder."""

    fit: FitSummary
    comparison: pd.DataFrame
    check: pd.DataFrame
    diagnosis: Diagnosis | None = None

    @property
    def verdict(self) -> str:
        """The position error of the model in two sentences; blank without a condition."""
        table = self.comparison
        if not len(table):
            return ""
        worst = table.sort_values("rms_position_m").iloc[-1]
        conditions = "one condition" if len(table) == 1 else f"{len(table)} conditions"
        sentence = f"Over {conditions} the model is off by {_rms_mm(table['rms_position_m'])} mm"
        known = table[table["replicate_floor_m"] > 0]
        if len(known):
            sentence += f", and replicates scatter by {_rms_mm(known['replicate_floor_m'])} mm"
        return (
            f"{sentence} (root mean square). Worst is {worst['condition']}, by "
            f"{number(1e3 * worst['rms_position_m'])} mm, with the maximum after "
            f"{number(1e3 * worst['worst_at_m'])} mm of growth."
        )


def final_errors(diagnosis: Diagnosis) -> str:
    """Return the position errors of the final model of a diagnosis as a sentence; blank without its ladder."""
    if diagnosis.ladder is None or not len(diagnosis.ladder):
        return ""
    last = settled_rows(diagnosis.ladder).iloc[-1]
    inside, outside, floor = (
        number(1e3 * float(last[key])) for key in ("rms_in_sample_m", "rms_left_out_m", "floor_m")
    )
    return (
        f"With {listed_names(diagnosis.effects)} the error of the model is {inside} mm, and {outside} mm on "
        f"conditions left out of the fit; replicate scatter is {floor} mm (root mean square)."
    )


def _rms_mm(values_m: pd.Series) -> str:
    return number(1e3 * math.sqrt(float((values_m**2).mean())))


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

    folder = files("vinetrack.report") / "templates"
    loader = FunctionLoader(lambda name: (folder / name).read_text(encoding="utf-8"))
    environment = Environment(
        loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters |= {"number": number, "with_error": with_error, "interval": interval}
    environment.globals |= {"rows": rows, "display_unit": display_unit, "bounds_text": bounds_text}
    environment.globals |= {"listed_names": listed_names, "inline_picture": inline_picture}
    environment.globals |= {"data_uri": data_uri, "base64_uri": base64_uri}
    settings = content.provenance.get("settings") or {}
    sections = {name: figure.section for name, figure in all_figures().items()}
    figures: dict[str, list[ReportFigure]] = {section: [] for section in sections.values()}
    for figure in content.figures:
        figures[sections.get(figure.key, "damping")].append(figure)
    trials, n_left_out = trial_entries(content)
    laws = [
        (vine, law, method)
        for method in LAW_METHODS
        for vine, law in ((content.damping.get(method) or {}).get("vines") or {}).items()
    ]
    return environment.get_template("report.html").render(
        name=content.name,
        style=Markup(page_tokens() + (folder / "report.css").read_text(encoding="utf-8")),
        headline=damping_headline(content.damping),
        tally=status_tally(content.trials),
        notes=content.notes,
        damping=content.damping,
        law_methods=LAW_METHODS,
        laws=sorted(laws, key=lambda one: (one[1]["diameter_mm"], one[1]["thickness_um"], one[0])),
        model=content.model,
        final_errors=final_errors,
        diagnosis=diagnosis_section(content.diagnosis),
        figures=figures,
        # Chosen: a sixth of the 15 MB that a report may have
        clip=content.clip if content.clip is not None and len(content.clip.mp4) <= 2_500_000 else None,
        sections=content.sections,
        trials=trials,
        rule_names=RULE_NAMES,
        n_left_out=n_left_out,
        calibrations=calibration_table(content.recordings),
        filmed=bool(content.recordings),
        run=settings,
        settings=sorted(_flat(settings)),
        provenance=content.provenance,
    )


def _flat(settings: Mapping[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    """Nested settings as (dotted name, value) pairs."""
    pairs: list[tuple[str, str]] = []
    for key, value in settings.items():
        if isinstance(value, Mapping):
            pairs += _flat(value, f"{prefix}{key}.")
        else:
            pairs.append((f"{prefix}{key}", "–" if value is None else str(value)))
    return pairs
