"""Common style of all figures: colours that colour-blind readers can distinguish, sizes readable in a talk.

Figures are made without pyplot, so drawing leaves no global state and many can be drawn in parallel. The background is
transparent and neutral parts are drawn in INK or GRID, so that a page can recolour an inline SVG for a dark scheme; a
PNG has a white background.
"""

from __future__ import annotations

import io
import textwrap
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

INK = "#20242a"
MUTED = "#7b828c"
GRID = "#d9dde3"
# Filling of hollow markers; a page may recolour it like INK and GRID
PAPER = "#fdfdfe"

# Okabe and Ito's palette without black and yellow, each of which is invisible on one of the backgrounds
BLUE, VERMILLION, GREEN, PURPLE, SKY, ORANGE = "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00"

VINE_COLOURS = (BLUE, VERMILLION, GREEN, PURPLE, SKY, ORANGE)
VINE_MARKERS = ("o", "s", "^", "D", "v", "P", "X")

# Colour of each rule for steady windows, the same in every figure
RULE_COLOURS = {"gated": BLUE, "quasi_steady": PURPLE, "paper": VERMILLION, "user": GREEN}

RULE_NAMES = {"gated": "gated rule", "quasi_steady": "quasi-steady", "paper": "paper's rule", "user": "chosen by hand"}

DASHED: Any = (0, (4, 2))  # Line of the second of two models, methods or laws

METHOD_COLOURS = {"log_log": VERMILLION, "both_axes": BLUE}
METHOD_LINES = {"log_log": DASHED, "both_axes": "-"}

_RC: Any = {
    "font.family": ["DejaVu Sans", "sans-serif"],
    "font.size": 11,
    "axes.titlesize": 11,
    "axes.titlelocation": "left",
    "axes.titleweight": "bold",
    "axes.labelsize": 11,
    "axes.labelcolor": INK,
    "axes.edgecolor": INK,
    "axes.linewidth": 0.8,
    "axes.facecolor": "none",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": GRID,
    "grid.linewidth": 0.7,
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "xtick.labelsize": 10,
    "ytick.labelsize": 10,
    "legend.frameon": False,
    "legend.fontsize": 10,
    "lines.linewidth": 1.6,
    "figure.facecolor": "none",
    "savefig.facecolor": "none",
    "svg.hashsalt": "vinetrack",
    "svg.fonttype": "none",
    "path.simplify": True,
}


@dataclass(frozen=True)
class VineStyle:
    """Colour and marker of a vine, the same in every figure."""

    colour: str
    marker: str


@contextmanager
def look() -> Iterator[None]:
    """Context manager that applies the project's matplotlib settings and restores the former ones."""
    import matplotlib as mpl

    with mpl.rc_context(_RC):
        yield


def vine_styles(vines: Iterable[str]) -> dict[str, VineStyle]:
    """Give each vine, in the order of first appearance, a colour and a marker; with 42 different pairs."""
    names = list(dict.fromkeys(vines))
    n_colours, n_markers = len(VINE_COLOURS), len(VINE_MARKERS)
    return {
        name: VineStyle(VINE_COLOURS[i % n_colours], VINE_MARKERS[(i + i // n_colours // n_markers) % n_markers])
        for i, name in enumerate(names)
    }


def rows(table: pd.DataFrame) -> Iterator[Any]:
    """Iterate over the rows of a table with its columns as attributes, typed as `Any` for convenience."""
    return iter(table.itertuples(index=False))


def blank(message: str, width_in: float = 7.0, height_in: float = 1.6) -> Figure:
    """Return a figure with a message in place of a figure that cannot be drawn."""
    from matplotlib.figure import Figure

    with look():
        fig = Figure(figsize=(width_in, height_in))
        wrapped = textwrap.fill(message, int(width_in * 11))
        fig.text(0.5, 0.5, wrapped, ha="center", va="center", color=MUTED)
    return fig


def render(fig: Figure, formats: Iterable[str] = ("png", "svg"), dpi: float = 150) -> dict[str, bytes]:
    """Return the figure in each format, reproducible to the byte; PNG on white, the others transparent."""
    details: dict[str, dict[str, Any]] = {
        "png": {"facecolor": "white", "metadata": {"Software": None}},
        "svg": {"metadata": {"Date": None, "Creator": None}},
        "pdf": {"metadata": {"CreationDate": None}},
    }
    files = {}
    with look(), _laid_out(fig, dpi):
        for form in formats:
            file = io.BytesIO()
            fig.savefig(file, format=form, dpi=dpi, **details[form])
            files[form] = file.getvalue()
    return files


@contextmanager
def _laid_out(fig: Figure, dpi: float) -> Iterator[None]:
    """Execute the layout engine once, instead of once per format, each of which would draw the figure again."""
    engine, before = fig.get_layout_engine(), fig.dpi
    if engine is None:
        yield
        return
    fig.dpi = dpi
    engine.execute(fig)
    fig.dpi = before
    fig.set_layout_engine(None)  # the engine "none" would still draw the figure twice
    try:
        yield
    finally:
        fig.set_layout_engine(engine)
