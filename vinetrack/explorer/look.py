"""Style shared with the report: colours, fonts, and the pieces of HTML of the page."""

from __future__ import annotations

import html
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from bokeh.models import CategoricalColorMapper, CustomJS, Div, InlineStyleSheet
from bokeh.plotting import figure
from bokeh.themes import Theme

from vinetrack.figures.page_tokens import TOKENS, page_frame
from vinetrack.figures.style import GRID, INK, MUTED, VINE_COLOURS

TEMPLATES = Path(__file__).with_name("templates")
SANS = 'system-ui, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif'
# Colours over a grey picture: the tracked edge, the edge of the model for comparison, and of the current model
MEASURED_EDGE, REFERENCE_EDGE, MODEL_EDGE = "#56B4E9", "#E69F00", "#D55E00"

_AXIS = {
    "axis_label_text_font": SANS,
    "axis_label_text_font_size": "13px",
    "axis_label_text_font_style": "normal",
    "axis_label_text_color": INK,
    "axis_line_color": INK,
    "major_label_text_font": SANS,
    "major_label_text_font_size": "12px",
    "major_label_text_color": INK,
    "major_tick_line_color": INK,
    "minor_tick_line_color": None,
    "axis_label_standoff": 6,
}
THEME: dict[str, Any] = {
    "attrs": {
        "Plot": {"background_fill_color": None, "border_fill_color": None, "outline_line_color": None},
        "Axis": _AXIS,
        "Grid": {"grid_line_color": GRID, "grid_line_width": 0.8},
    }
}


def theme() -> Theme:
    """Return the style of plots and widgets."""
    return Theme(json=THEME)


def page_template() -> str:
    """Return the template of the page, for jinja2."""
    return (TEMPLATES / "page.html").read_text(encoding="utf-8")


def page_style() -> str:
    """Return the CSS of the page around the widgets."""
    return page_frame() + (TEMPLATES / "page.css").read_text(encoding="utf-8")


def screen_script(figures: Sequence[figure]) -> CustomJS:
    """Return a script that adapts figures to a light or dark colour scheme."""
    code = (TEMPLATES / "screen.js").read_text(encoding="utf-8")
    return CustomJS(args={"plots": list(figures), "tokens": TOKENS}, code=code)


def vine_colour() -> dict[str, Any]:
    """Return the colour of glyphs with a column `colour`: a palette, so that a page can change it."""
    colours = list(VINE_COLOURS)
    return {"field": "colour", "transform": CategoricalColorMapper(factors=colours, palette=colours)}


def stylesheet(more: str = "") -> InlineStyleSheet:
    """Return CSS inside a widget, which the CSS of the page does not reach."""
    return InlineStyleSheet(css=(TEMPLATES / "widgets.css").read_text(encoding="utf-8") + more)


def html_div(text: str = "", name: str | None = None, **keywords: Any) -> Div:
    """Return a piece of HTML as a widget."""
    return Div(text=text, name=name, sizing_mode="stretch_width", stylesheets=[stylesheet()], margin=0, **keywords)


def plot(height: int, x_label: str, y_label: str, **keywords: Any) -> figure:
    """Return an empty figure as wide as its card."""
    fig = figure(
        height=height,
        sizing_mode="stretch_width",
        tools="box_zoom,pan,reset",
        active_drag=None,
        active_scroll=None,
        toolbar_location="above",
        x_axis_label=x_label,
        y_axis_label=y_label,
        min_border_right=14,
        margin=0,
        **keywords,
    )
    fig.toolbar.autohide = True
    fig.toolbar_inner = True
    fig.toolbar.logo = None
    return fig


def escaped(text: object) -> str:
    """Return text escaped for HTML."""
    return html.escape(str(text))


def table(rows: Iterable[Sequence[object]], header: Sequence[str], numeric: Sequence[int] = ()) -> str:
    """Return a table in HTML; cells are escaped, columns `numeric` are right-aligned."""
    kinds = [' class="n"' if k in numeric else "" for k in range(len(header))]
    head = "".join(f"<th{kind}>{escaped(cell)}</th>" for kind, cell in zip(kinds, header, strict=True))
    body = "".join(
        "<tr>" + "".join(f"<td{kind}>{escaped(cell)}</td>" for kind, cell in zip(kinds, row, strict=True)) + "</tr>"
        for row in rows
    )
    return f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'


def progress_bar(share: float, text: str) -> str:
    """Return a bar filled to a fraction, with text below it."""
    percent = 100 * min(max(share, 0.02), 1.0)
    return f'<div class="bar"><i style="width:{percent:.0f}%"></i></div><small>{escaped(text)}</small>'


def command_block(lines: Sequence[str]) -> str:
    """Return commands to copy, as HTML."""
    return f"<pre><code>{escaped(chr(10).join(lines))}</code></pre>"


__all__ = [
    "INK",
    "MEASURED_EDGE",
    "MODEL_EDGE",
    "MUTED",
    "REFERENCE_EDGE",
    "command_block",
    "escaped",
    "html_div",
    "page_style",
    "page_template",
    "plot",
    "progress_bar",
    "screen_script",
    "stylesheet",
    "table",
    "theme",
    "vine_colour",
]
