"""What a page is made of: pictures with their data, tables, and sections of both, from whichever room they come."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any
from urllib.parse import quote

from vinetrack.report.svg import inline_svg

_PLAIN = ",;:!*'()/ -._~+@=$?"
"""Characters that an address in quotation marks may hold as they are."""


@dataclass(frozen=True)
class ReportFigure:
    """A picture of the report: its SVG, what it shows, and the table it was drawn from as a file to download."""

    key: str
    title: str
    caption: str
    svg: str
    data_name: str = ""
    data: str = ""


@dataclass(frozen=True)
class ReportTable:
    """A table of the report: text in rows, shown as it is; `numbers` are the columns set to the right."""

    title: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    numbers: frozenset[int] = frozenset()
    note: str = ""


@dataclass(frozen=True)
class ReportSection:
    """A part of the page under one heading: paragraphs, then tables, then pictures."""

    key: str
    title: str
    paragraphs: Sequence[str] = ()
    tables: Sequence[ReportTable] = ()
    figures: Sequence[ReportFigure] = ()


def figure_entry(figure: ReportFigure) -> dict[str, Any]:
    """A picture for the template.

    Parameters
    ----------
    figure : its SVG as matplotlib wrote it.

    Returns
    -------
    dict for the template
    """
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
    """A section for the template; pictures too large for a page are left as files beside it.

    Parameters
    ----------
    section : of the page.
    largest_svg_bytes : of a picture in the page.

    Returns
    -------
    dict for the template
    """
    return {
        "key": section.key,
        "title": section.title,
        "paragraphs": list(section.paragraphs),
        "tables": list(section.tables),
        "figures": [figure_entry(figure) for figure in section.figures if len(figure.svg) <= largest_svg_bytes],
    }


def data_uri(name: str, text: str) -> str:
    """A file to download that is part of the page itself, written whichever way is shorter.

    Parameters
    ----------
    name : of the file; its ending gives the type.
    text : its content.

    Returns
    -------
    str, a data address
    """
    kind = "application/json" if name.endswith(".json") else "text/csv"
    escaped = quote(text, safe=_PLAIN)
    encoded = "base64," + base64.b64encode(text.encode("utf-8")).decode("ascii")
    head = f"data:{kind};charset=utf-8"
    return f"{head};{encoded}" if len(encoded) <= len(escaped) else f"{head},{escaped}"
