"""The report: everything a person wants to see, in one HTML file without scripts, links or fonts from elsewhere."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from vinetrack.figures.numbers import number, with_error
from vinetrack.figures.style import RULE_NAMES, rows
from vinetrack.report.model import ModelResult, model_section
from vinetrack.report.recordings import (
    LARGEST_SVG_BYTES,
    METHODS,
    SHARED_ERROR,
    Recording,
    calibration_table,
    recording_entry,
)
from vinetrack.report.svg import inline_svg, speed_sparkline
from vinetrack.report.words import REFERENCES, exponent_table, headline, methods, tally, vine_table, without_law

if TYPE_CHECKING:
    import pandas as pd

MODEL_FIGURES = ("model_comparison", "model_residuals")
"""Figures that stand in the section on the model, not among the others."""


@dataclass(frozen=True)
class ReportFigure:
    """A picture of the report: its SVG, what it shows, and the table it was drawn from as a file to download."""

    key: str
    title: str
    caption: str
    svg: str
    data_name: str = ""
    data: str = ""


@dataclass(frozen=True, kw_only=True)
class ReportContent:
    """Everything the report is made of: the tables of the results folder, its pictures and its provenance.

    `recordings` has an entry for every trial that came as one, `n_strips_left_out` says how many of their strips were
    too many for one page.
    """

    name: str
    trials: pd.DataFrame
    windows: pd.DataFrame
    damping: Mapping[str, Any]
    provenance: Mapping[str, Any]
    kinematics: Mapping[str, pd.DataFrame]
    figures: Sequence[ReportFigure] = ()
    trial_figures: Mapping[str, str] = field(default_factory=dict)
    recordings: Mapping[str, Recording] = field(default_factory=dict)
    n_strips_left_out: int = 0
    model: ModelResult | None = None


def build_report(content: ReportContent) -> str:
    """Return the page. Whatever a user wrote is escaped; only our own SVG goes in as it is.

    Parameters
    ----------
    content : see `ReportContent`; `trial_figures` holds an SVG per trial that is to be shown in full.
    """
    from importlib.resources import files

    from jinja2 import Environment, StrictUndefined
    from markupsafe import Markup

    folder = files("vinetrack.report") / "templates"
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    template = environment.from_string((folder / "report.html").read_text(encoding="utf-8"))
    settings = content.provenance.get("settings") or {}
    figures = [_figure(figure) for figure in content.figures if len(figure.svg) <= LARGEST_SVG_BYTES]
    return template.render(
        name=content.name,
        style=Markup((folder / "report.css").read_text(encoding="utf-8")),
        headline=headline(content.damping),
        tally=tally(content.trials),
        exponents=exponent_table(content.damping),
        without_law=without_law(content.damping),
        vines=vine_table(content.damping),
        figures=[figure for figure in figures if figure["key"] not in MODEL_FIGURES],
        model=model_section(content.model),
        model_figures=[figure for figure in figures if figure["key"] in MODEL_FIGURES],
        trials=[_trial(row, content) for row in rows(content.trials)],
        recordings=[
            recording_entry(row.trial, content.recordings[row.trial], row, content.trial_figures.get(row.trial, ""))
            for row in rows(content.trials)
            if row.trial in content.recordings
        ],
        n_strips_left_out=content.n_strips_left_out,
        calibrations=calibration_table(content.recordings),
        shared_error=SHARED_ERROR,
        methods=[*(METHODS if content.recordings else ()), *methods(settings)],
        references=REFERENCES,
        settings=sorted(_flat(settings)),
        provenance=content.provenance,
    )


def _figure(figure: ReportFigure) -> dict[str, Any]:
    from markupsafe import Markup

    data = base64.b64encode(figure.data.encode("utf-8")).decode("ascii")
    kind = "application/json" if figure.data_name.endswith(".json") else "text/csv"
    return {
        "key": figure.key,
        "title": figure.title,
        "caption": figure.caption,
        "svg": Markup(inline_svg(figure.svg, figure.key, figure.title)),
        "data_name": figure.data_name,
        "data_uri": f"data:{kind};charset=utf-8;base64,{data}" if figure.data else "",
    }


def _trial(row: Any, content: ReportContent) -> dict[str, Any]:
    from markupsafe import Markup

    curve = content.kinematics.get(row.trial)
    filmed = row.trial in content.recordings
    spark, svg = "", "" if filmed else content.trial_figures.get(row.trial, "")
    if curve is not None and len(curve) > 1:
        time_s, speed_m_s = (curve[name].to_numpy(dtype=float) for name in ("time_s", "lead_velocity_m_s"))
        spark = speed_sparkline(time_s, speed_m_s, (row.steady_from_s, row.steady_to_s))
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
        "filmed": filmed,
        "spark": Markup(spark),
        "svg": Markup(inline_svg(svg, f"t-{row.trial}", f"Trial {row.trial}")) if svg else "",
        "windows": [_window(window) for window in rows(content.windows[content.windows["trial"] == row.trial])],
    }


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


def _flat(settings: Mapping[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    """Nested settings as (dotted name, value) pairs."""
    pairs: list[tuple[str, str]] = []
    for key, value in settings.items():
        if isinstance(value, Mapping):
            pairs += _flat(value, f"{prefix}{key}.")
        else:
            pairs.append((f"{prefix}{key}", "–" if value is None else str(value)))
    return pairs
