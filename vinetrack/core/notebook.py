"""Display of objects in a notebook: tables as HTML, and figures of the report.

The figure packages lie above the objects that they draw, so the drawing module is a backend that is imported when a
figure is requested, as in pandas.
"""

from __future__ import annotations

import html
from collections.abc import Sequence
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def html_table(head: Sequence[str], rows: Sequence[Sequence[str]], title: str = "", notes: Sequence[str] = ()) -> str:
    """Return a table as HTML with all text escaped."""
    above = f"<p><b>{html.escape(title)}</b></p>" if title else ""
    names = "".join(f"<th>{html.escape(name)}</th>" for name in head)
    body = "".join("<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    table = f"<table><thead><tr>{names}</tr></thead><tbody>{body}</tbody></table>" if rows else ""
    return above + table + "".join(f"<p>{html.escape(note)}</p>" for note in notes)


def plot(shown: Any, name: str = "", **options: Any) -> Figure:
    """Draw an object as in the report."""
    figure: Figure = import_module("vinetrack.interface.loaded").figure_of(shown, name, **options)
    return figure
