"""Panels, axes and legends common to all figures."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.figures.style import VINE_COLOURS, VINE_MARKERS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from numpy.typing import ArrayLike

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
