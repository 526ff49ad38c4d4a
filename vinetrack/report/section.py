"""Building blocks of the page: figures with their data, tables, and sections of both."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any
from urllib.parse import quote

from vinetrack.report.svg import inline_svg

_UNESCAPED = ",;:!*'()/ -._~+@=$?"  # Characters that need no escaping in a quoted URL


@dataclass(frozen=True)
class ReportFigure:
    """A figure of the report: its SVG, its caption, and its data as a file to download."""

    key: str
    title: str
    caption: str
    svg: str
    data_name: str = ""
    data: str = ""


@dataclass(frozen=True)
class ReportTable:
    """A table of the report, as text in rows; `numbers` are the right-aligned columns."""

    title: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    numbers: frozenset[int] = frozenset()
    note: str = ""


@dataclass(frozen=True)
class ReportSection:
    """A part of the page under one heading: paragraphs, then tables, then figures."""

    key: str
    title: str
    paragraphs: Sequence[str] = ()
    tables: Sequence[ReportTable] = ()
    figures: Sequence[ReportFigure] = ()


def figure_entry(figure: ReportFigure) -> dict[str, Any]:
    """Return a figure for the template."""
    from markupsafe import Markup

    return {
        "key": figure.key,
        "title": figure.title,
        "caption": figure.caption,
        "svg": Markup(inline_svg(figure.svg, figure.key, figure.title)),
        "data_name": figure.data_name,
        "data_uri": data_uri(figure.data_name, figure.data) if figure.data else "",
    }


def section_entry(section: ReportSection, largest_svg_bytes: int) -> dict[str, Any]:
    """Return a section for the template, without figures that are too large for a page."""
    return {
        "key": section.key,
        "title": section.title,
        "paragraphs": list(section.paragraphs),
        "tables": list(section.tables),
        "figures": [figure_entry(figure) for figure in section.figures if len(figure.svg) <= largest_svg_bytes],
    }


def data_uri(name: str, text: str) -> str:
    """Return a file as a data URI, in the shorter of two encodings."""
    kind = "application/json" if name.endswith(".json") else "text/csv"
    escaped = quote(text, safe=_UNESCAPED)
    encoded = "base64," + base64.b64encode(text.encode("utf-8")).decode("ascii")
    head = f"data:{kind};charset=utf-8"
    return f"{head};{encoded}" if len(encoded) <= len(escaped) else f"{head},{escaped}"
