"""Common style of all figures: colours that colour-blind readers can distinguish, sizes readable in a talk.

Figures are made without pyplot, so drawing leaves no global state and many can be drawn in parallel. The background is
transparent and neutral parts are drawn in INK or GRID, so that a page can recolour an inline SVG for a dark scheme; a
PNG has a white background.
"""

from __future__ import annotations

import io
import math
import textwrap
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from numpy.typing import ArrayLike


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


def new_figure(width_in: float, height_in: float, layout: Any = "constrained") -> Figure:
    """Return an empty figure."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width_in, height_in), layout=layout)


@look()
def blank(message: str) -> Figure:
    """Return a figure with a message, in place of one that is promised and has nothing to show."""
    fig = new_figure(7.0, 1.6, layout=None)
    fig.text(0.5, 0.5, textwrap.fill(message, 77), ha="center", va="center", color=MUTED)
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


# ------------------------------------------------------------------------------
# Colours of pages with a light and a dark scheme, and their mapping from the colours of figures.

# CSS custom property by colour of a figure; purple, sky and orange are visible in either scheme
TOKENS = {
    INK.lower(): "--ink",
    GRID.lower(): "--grid",
    MUTED.lower(): "--muted",
    PAPER.lower(): "--paper",
    BLUE.lower(): "--blue",
    VERMILLION.lower(): "--vermillion",
    GREEN.lower(): "--green",
}


def page_tokens() -> str:
    """Return CSS with the values of the properties in the light and the dark scheme."""
    return Path(__file__).with_name("page_tokens.css").read_text(encoding="utf-8")


def page_frame() -> str:
    """Return CSS of local pages: the properties of `page_tokens`, and the style of page, heading and cards."""
    return page_tokens() + Path(__file__).with_name("page_frame.css").read_text(encoding="utf-8")


def follows_screen(colour: str) -> str:
    """Return the CSS of a figure's colour, as a property if the page may change it."""
    token = TOKENS.get(colour.lower())
    return colour if token is None else f"var({token})"


# ------------------------------------------------------------------------------
# Panels, axes and legends common to all figures.

_CHARACTERS_PER_IN = 12.5  # Chosen: the mean character of DejaVu Sans at 10 pt is 4.7 pt wide, 15 per inch

_HEADROOM = 1.08  # Chosen: axes that begin at zero end 8 % above the largest value, so that no marker of 6 pt is cut


def panel_grid(fig: Figure, count: int, n_columns: int, **keywords: Any) -> list[Axes]:
    """Divide a figure into rows of panels and hide the surplus ones. Shape (count,)."""
    axes = fig.subplots(math.ceil(count / n_columns), n_columns, squeeze=False, **keywords).ravel().tolist()
    for ax in axes[count:]:
        ax.set_visible(False)
    return list(axes[:count])


def page_columns(n_panels: int, most: int) -> int:
    """Return the number of panels per row with which the page is about 1.3 times as high as wide."""
    return min(max(math.ceil(math.sqrt(1.3 * n_panels)), 1), most) if n_panels > 3 else n_panels


def panel_font(n_columns: int) -> float:
    """Return the font size in panels of a page of 11 inches, smaller for narrower panels."""
    return 10.5 if n_columns <= 4 else 9.0 if n_columns <= 6 else 7.8


def line_key(label: str, **style: Any) -> Line2D:
    """Return a legend entry with a line or a marker."""
    from matplotlib.lines import Line2D

    return Line2D([], [], label=label, **style)


def error_points(ax: Axes, x: ArrayLike, y: ArrayLike, sigma: ArrayLike, index: int, label: str, **style: Any) -> None:
    """Draw points with error bars in the colour and with the marker of a group of vines or conditions. Shapes: x, y,
    sigma (n_points,).
    """
    properties: dict[str, Any] = {"ms": 6, "capsize": 3, **style}
    colour, marker = VINE_COLOURS[index % len(VINE_COLOURS)], VINE_MARKERS[index % len(VINE_MARKERS)]
    bars = np.nan_to_num(np.asarray(sigma, dtype=float))
    ax.errorbar(x, y, yerr=bars, fmt=marker, color=colour, label=label, **properties)


def fitting_size(text: str, width_pt: float, largest: float, bold: bool = True) -> float:
    """Return the font size at which a text fits a width, at most `largest`, pt."""
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import TextPath

    font = FontProperties(family="DejaVu Sans", weight="bold" if bold else "normal")
    taken_pt = TextPath((0, 0), text.replace("$", "S"), size=largest, prop=font).get_extents().width
    return largest * min(1.0, width_pt / max(taken_pt, 1e-9))


def legend_above(ax: Axes, n_columns: int = 2, **keywords: Any) -> None:
    """Put the legend above the axes, where it covers no data."""
    handles, labels = ax.get_legend_handles_labels()
    handles = keywords.pop("handles", handles)
    if handles:
        ax.legend(
            handles=handles,
            labels=[handle.get_label() for handle in handles] if not labels else None,
            loc="lower left",
            bbox_to_anchor=(0.0, 1.01),
            borderaxespad=0.0,
            ncols=n_columns,
            handlelength=1.8,
            columnspacing=1.4,
            **keywords,
        )


def note_below(fig: Figure, note: str) -> None:
    """Put a sentence below the figure, wrapped to its width; nothing if it is blank."""
    if note:
        fig.supxlabel(textwrap.fill(note, int(fig.get_figwidth() * _CHARACTERS_PER_IN)), fontsize=10)


def up_from_zero(ax: Axes, *, x: bool = False) -> None:
    """Let the axes begin at zero and end slightly above the largest value. A margin in proportion to the range of the
    data would vanish for two points of nearly equal value.
    """
    ax.set_ylim(0, _HEADROOM * ax.dataLim.y1 if ax.dataLim.y1 > 0 else None)
    if x:
        ax.set_xlim(0, _HEADROOM * ax.dataLim.x1 if ax.dataLim.x1 > 0 else None)


def counted(low: int, high: int, noun: str) -> str:
    """Return a count with its noun, or the range of counts."""
    return f"{low}–{high} {noun}s" if low != high else f"{low} {noun}" + ("" if low == 1 else "s")


def plain_log_ticks(ax: Axes, which: str = "both") -> None:
    """Label logarithmic axes with plain numbers, readable even within less than a decade."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    for axis in {"x": (ax.xaxis,), "y": (ax.yaxis,), "both": (ax.xaxis, ax.yaxis)}[which]:
        low, high = _at_least_an_octave(*axis.get_view_interval())
        axis.set_view_interval(low, high, ignore=True)
        decades = math.log10(high / low)
        steps: Sequence[int] = (1, 2, 3, 5, 7) if decades < 1 else (1, 2, 5) if decades < 3.2 else (1,)
        axis.set_major_locator(LogLocator(subs=steps))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_locator(NullLocator())


def _at_least_an_octave(low: float, high: float) -> tuple[float, float]:
    """Widen limits to a factor of two at least: a single point must not fill the figure with its error bars."""
    middle = math.sqrt(low * high)
    return min(low, middle / math.sqrt(2)), max(high, middle * math.sqrt(2))
