"""The report: all results in one HTML file without scripts or external resources."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from typing import TYPE_CHECKING, Any

from vinetrack.figures.page_tokens import page_tokens
from vinetrack.figures.registry import FIGURES
from vinetrack.narrative.law_text import (
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
from vinetrack.report.diagnosis_section import DiagnosisResult, diagnosis_section
from vinetrack.report.model_section import ModelResult, model_section
from vinetrack.report.section import ReportFigure, ReportSection, ReportTable, figure_entry, section_entry
from vinetrack.report.trials_section import (
    MAX_SVG_BYTES,
    METHODS,
    SHARED_ERROR,
    TrackedRecording,
    calibration_table,
    trial_entries,
)

if TYPE_CHECKING:
    import pandas as pd

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
    trial_figures: Mapping[str, str] = field(default_factory=dict)
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
        sections=[section_entry(section, MAX_SVG_BYTES) for section in content.sections],
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


def figure_caption(name: str) -> str:
    """Return the caption of a figure of `vinetrack.figures.registry` as one line of text."""
    path = files("vinetrack.report") / "captions" / f"{name}.rst"
    return " ".join(path.read_text(encoding="utf-8").split())


def _figures(content: ReportContent) -> dict[str, list[dict[str, Any]]]:
    """Figures for the template, by section of the page."""
    by_section: dict[str, list[dict[str, Any]]] = {figure.section: [] for figure in FIGURES.values()}
    for figure in content.figures:
        if len(figure.svg) <= MAX_SVG_BYTES:
            section = FIGURES[figure.key].section if figure.key in FIGURES else "damping"
            by_section[section].append(figure_entry(figure))
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
