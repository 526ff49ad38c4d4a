"""What objects show of themselves in a notebook: tables as HTML, and the figures of the report.

The figures stand above the objects that they show, so an object names its drawing package as a backend, loaded when a
figure is asked for, as pandas does.
"""

from __future__ import annotations

import html
from collections.abc import Sequence
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PLOTTING_BACKEND = "vinetrack.interface.plotting"
"""Module whose `figure_of(object, name, **options)` draws an object of this package."""


def html_table(head: Sequence[str], rows: Sequence[Sequence[str]], title: str = "", notes: Sequence[str] = ()) -> str:
    """Return a table as HTML, every text escaped.

    Parameters
    ----------
    head, rows : texts, as many in a row as in the head.
    title : a line above the table.
    notes : lines below it.

    Returns
    -------
    str
    """
    above = f"<p><b>{html.escape(title)}</b></p>" if title else ""
    names = "".join(f"<th>{html.escape(name)}</th>" for name in head)
    body = "".join("<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    table = f"<table><thead><tr>{names}</tr></thead><tbody>{body}</tbody></table>" if rows else ""
    return above + table + "".join(f"<p>{html.escape(note)}</p>" for note in notes)


def plot(shown: Any, name: str = "", **options: Any) -> Figure:
    """Return the figure of an object as the report has it.

    Parameters
    ----------
    shown : a fit, a comparison, a diagnosis or loaded results.
    name : of the figure, see `vinetrack.figures.registry`; blank for the one that says most about the object.
    options : for figures of one trial, `trial`.

    Returns
    -------
    matplotlib.figure.Figure
    """
    figure: Figure = import_module(PLOTTING_BACKEND).figure_of(shown, name, **options)
    return figure
