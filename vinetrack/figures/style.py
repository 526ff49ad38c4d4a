"""Common style of all figures: colours that colour-blind readers can distinguish, sizes readable in a talk.

Figures are made without pyplot, so drawing leaves no global state and many can be drawn in parallel. The background is
transparent, that of a PNG white; `figures.mplstyle` holds all else that is common.
"""

from __future__ import annotations

import io
import math
import textwrap
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from vinetrack.core.tables import write_bytes

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch
    from numpy.typing import ArrayLike


INK, MUTED, GRID = "#20242a", "#7b828c", "#d9dde3"
PAPER = "#fdfdfe"  # Filling of hollow markers; a page may recolour it like INK and GRID

# Okabe and Ito's palette without black and yellow, each of which is invisible on one of the backgrounds
BLUE, VERMILLION, GREEN, PURPLE, SKY, ORANGE = "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00"

VINE_COLOURS = (BLUE, VERMILLION, GREEN, PURPLE, SKY, ORANGE)
VINE_MARKERS = ("o", "s", "^", "D", "v", "P", "X")

DASHED: Any = (0, (4, 2))  # Line of the second of two models, methods or laws


class VineStyle(NamedTuple):
    """Colour and marker of a vine, the same in every figure."""

    colour: str
    marker: str


@contextmanager
def look() -> Iterator[None]:
    """Context manager that applies the project's matplotlib settings and restores the former ones."""
    import matplotlib as mpl

    with mpl.rc_context(_settings()):
        yield


@cache
def _settings() -> Any:
    import matplotlib as mpl

    return mpl.rc_params_from_file(Path(__file__).with_name("figures.mplstyle"), use_default_template=False)


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


def column(table: pd.DataFrame, name: str, factor: float = 1.0) -> np.ndarray:
    """Return a column of numbers, times a factor. Shape (n_rows,)."""
    return factor * table[name].to_numpy(dtype=float)


def thinned(table: pd.DataFrame, n_points: int) -> pd.DataFrame:
    """Return every so many rows of a table: at least `n_points` of them, fewer than twice as many."""
    return table.iloc[:: max(len(table) // n_points, 1)]


def new_figure(width_in: float, height_in: float, layout: Any = "constrained") -> Figure:
    """Return an empty figure."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width_in, height_in), layout=layout)


def one_panel(width_in: float, height_in: float, **properties: Any) -> tuple[Figure, Axes]:
    """Return an empty figure with one panel, and that panel, with properties such as its labels."""
    fig = new_figure(width_in, height_in)
    ax = fig.add_subplot()
    ax.set(**properties)
    return fig, ax


@look()
def blank(message: str) -> Figure:
    """Return a figure with a message, in place of one that is promised and has nothing to show."""
    fig = new_figure(7.0, 1.6, layout=None)
    fig.text(0.5, 0.5, textwrap.fill(message, 77), ha="center", va="center", color=MUTED)
    return fig


def render(fig: Figure, formats: Iterable[str] = ("png", "svg"), dpi: float = 150) -> dict[str, bytes]:
    """Return the figure in each format, reproducible to the byte; PNG on white, the others transparent."""
    details: dict[str, dict[str, Any]] = {
        # zlib's level 1 instead of 6 packs a figure in a third of the time, in a quarter more room
        "png": {"facecolor": "white", "metadata": {"Software": None}, "pil_kwargs": {"compress_level": 1}},
        "svg": {"metadata": {"Date": None, "Creator": None}},
        "pdf": {"metadata": {"CreationDate": None}},
    }
    files = {}
    engine, before = fig.get_layout_engine(), fig.dpi
    with look():
        if engine is not None:  # once, instead of once per format, each of which would draw the figure again
            fig.dpi = dpi
            engine.execute(fig)
            fig.dpi = before
            fig.set_layout_engine(None)
        for form in formats:
            file = io.BytesIO()
            fig.savefig(file, format=form, dpi=dpi, **details[form])
            files[form] = file.getvalue()
    fig.set_layout_engine(engine)
    return files


def write_figure(path: Path | None, draw: Callable[[], Figure]) -> list[str]:
    """Write a figure in the format that the suffix names, where one is asked for; return the line that says so."""
    if path is None:
        return []
    form = path.suffix.lower().removeprefix(".")
    write_bytes(path, render(draw(), [form])[form])
    return [f"Figure: {path}"]


# ------------------------------------------------------------------------------
# Panels of the figures that every trial has. Axes of matplotlib have some two hundred parts, and take half the time of
# such a figure. Here one pair without a frame covers the figure, in inches, and panels with few parts lie on it.


def new_sheet(width_in: float, height_in: float) -> tuple[Figure, Axes]:
    """Return an empty figure and its only axes, in inches and without a frame."""
    fig = new_figure(width_in, height_in, layout=None)
    ax = fig.add_axes((0, 0, 1, 1))
    ax.set(xlim=(0, width_in), ylim=(0, height_in))
    ax.set_axis_off()
    return fig, ax


class Panel:
    """A rectangle of a sheet with coordinates of its own. `box` is left, bottom, width and height, in; `x` and `y` are
    the values at its left and right, and at its bottom and top.
    """

    def __init__(self, sheet: Axes, box: Sequence[float], x: Sequence[float], y: Sequence[float]) -> None:
        from matplotlib.transforms import Bbox, BboxTransformFrom, BboxTransformTo, TransformedBbox

        self.sheet, self.x, self.y, self.box = sheet, x, y, Bbox.from_bounds(*box)
        self.inches = BboxTransformFrom(Bbox(np.transpose([x, y]))) + BboxTransformTo(self.box)
        self.data, self.clip = self.inches + sheet.transData, TransformedBbox(self.box, sheet.transData)

    def plot(self, x: ArrayLike, y: ArrayLike, *form: str, **style: Any) -> None:
        """Draw a line or points; nothing without points."""
        if np.size(x):
            self.sheet.plot(x, y, *form, transform=self.data, **style)[0].set_clip_box(self.clip)

    def fill(self, x: ArrayLike, low: ArrayLike, high: ArrayLike, **style: Any) -> None:
        """Fill between two curves."""
        self.sheet.fill_between(x, low, high, transform=self.data, **style).set_clip_box(self.clip)

    def write(self, x: float, y: float, words: str, off_pt: tuple[float, float], **style: Any) -> None:
        """Write words at a distance from a place."""
        left, bottom = self.inches.transform((x, y)) + np.divide(off_pt, 72)
        self.sheet.text(left, bottom, words, **style)

    def picture(self, grey: np.ndarray, **style: Any) -> None:
        """Fill the panel with a picture. Shape (height, width)."""
        left, bottom, right, top = self.box.extents
        style |= {"cmap": "gray", "interpolation": "none", "aspect": "auto"}
        self.sheet.imshow(grey, extent=(left, right, bottom, top), **style)

    def scale(
        self, side: str, label: str = "", factor: float = 1.0, *, grid: bool = True, numbered: bool = True,
        off_in: float = 0.0,
    ) -> None:  # fmt: skip
        """Draw the scale of the left, right or bottom, in its values times a factor, at a distance from the panel."""
        from matplotlib.ticker import MaxNLocator, ScalarFormatter

        left, bottom, right, _ = self.box.extents
        below = side == "bottom"
        # From where the scale goes in which direction, what is outside, and how far outside its label is
        sides: dict[str, Any] = {
            "left": ((left, bottom), (0, 1), (-1, 0), 0.52, {"ha": "right", "va": "center", "rotation": 90}),
            "right": ((right, bottom), (0, 1), (1, 0), 0.39, {"ha": "left", "va": "center", "rotation": 90}),
            "bottom": ((left, bottom - off_in), (1, 0), (0, -1), 0.28, {"ha": "center", "va": "top"}),
        }
        start_in, along, out, label_in, place = sides[side]
        length_in, depth_in = (abs(np.dot(way, self.box.size)) for way in (along, out))
        start, end = factor * np.array(self.x if below else self.y)
        low, high = sorted((start, end))
        most = int(length_in / (0.8 if below else 0.35))  # numbers may be so far apart, in (chosen)
        values = np.array(MaxNLocator(most, steps=[1, 2, 2.5, 5, 10]).tick_values(low, high))
        values = values[(values >= low) & (values <= high)]

        def at(values: ArrayLike, outside_in: float) -> np.ndarray:
            """Places in the sheet, in. Shape (n_values, 2)."""
            share = (np.atleast_1d(values) - start) / (end - start)
            return start_in + np.outer(share * length_in, along) + outside_in * np.array(out)

        zero = at(values, 0.0)
        lines = list(zip(zero, at(values, -depth_in), strict=True)) if grid else []
        marks = [*zip(zero, at(values, 0.05), strict=True), (at(start, 0.0)[0], at(end, 0.0)[0])]
        for colour, pieces in ((GRID, lines), (INK, marks)):  # each a single line with gaps, which is small in an SVG
            if pieces:
                ends = np.concatenate([[*piece, (math.nan, math.nan)] for piece in pieces])
                self.sheet.plot(*ends.T, color=colour, lw=0.8, zorder=0.5)
        if not numbered:
            return
        formatter = ScalarFormatter()
        formatter.create_dummy_axis()
        assert formatter.axis is not None
        formatter.axis.set_view_interval(low, high)
        for (x, y), number in zip(at(values, 0.1), formatter.format_ticks(values), strict=True):
            self.sheet.text(x, y, number, None, fontsize=10, **place | {"rotation": 0})
        x, y = at((start + end) / 2, label_in)[0]
        self.sheet.text(x, y, f"{label} {formatter.get_offset()}".strip(), None, **place)


# ------------------------------------------------------------------------------
# Axes and legends common to all figures.


def panel_grid(fig: Figure, count: int, n_columns: int, **keywords: Any) -> list[Axes]:
    """Divide a figure into rows of panels and hide the surplus ones. Shape (count,)."""
    axes = fig.subplots(math.ceil(count / n_columns), n_columns, squeeze=False, **keywords).ravel().tolist()
    for ax in axes[count:]:
        ax.set_visible(False)
    return list(axes[:count])


def small_title(ax: Axes, title: str, **style: Any) -> None:
    """Put a remark, rather than a heading, above the axes."""
    ax.set_title(title, **{"fontsize": 9, "fontweight": "normal", **style})


def names_beside(ax: Axes, names: Sequence[str]) -> None:
    """Put names, one per unit, beside the vertical axis, without marks or grid lines."""
    ax.tick_params(axis="y", length=0)
    ax.grid(axis="y", visible=False)
    ax.set_yticks(range(len(names)), names)


def band(
    ax: Axes, x: ArrayLike, low: ArrayLike, high: ArrayLike, colour: str, alpha: float = 0.22, **style: Any
) -> None:
    """Fill between two curves. Shapes (n_points,)."""
    ax.fill_between(x, low, high, color=colour, alpha=alpha, lw=0, **style)


def line_key(label: str, **style: Any) -> Line2D:
    """Return a legend entry with a line or a marker."""
    from matplotlib.lines import Line2D

    return Line2D([], [], label=label, **style)


def patch_key(label: str, colour: str, alpha: float | None = None, **style: Any) -> Patch:
    """Return a legend entry with a filled rectangle."""
    from matplotlib.patches import Patch

    return Patch(facecolor=colour, alpha=alpha, label=label, **style)


def error_points(ax: Axes, x: ArrayLike, y: ArrayLike, sigma: ArrayLike, index: int, label: str, **style: Any) -> None:
    """Draw points with error bars, colour and marker by group. Shapes: x, y, sigma (n_points,)."""
    properties: dict[str, Any] = {"ms": 6, "capsize": 3, **style}
    colour, marker = VINE_COLOURS[index % len(VINE_COLOURS)], VINE_MARKERS[index % len(VINE_MARKERS)]
    bars = np.nan_to_num(np.asarray(sigma, dtype=float))
    ax.errorbar(x, y, yerr=bars, fmt=marker, color=colour, label=label, **properties)


def fitting_size(text: str, width_pt: float, largest: float, bold: bool = True) -> float:
    """Return the font size at which a text fits a width, at most `largest`, pt."""
    from matplotlib.font_manager import FontProperties
    from matplotlib.textpath import text_to_path

    font = FontProperties(family="DejaVu Sans", weight="bold" if bold else "normal", size=largest)
    taken_pt, _, _ = text_to_path.get_text_width_height_descent(text, font, ismath=False)
    return largest * min(1.0, width_pt / max(taken_pt, 1e-9))


def legend_above(ax: Axes, n_columns: int = 1, **keywords: Any) -> None:
    """Put the legend above the axes, where it covers no data."""
    if ax.get_legend_handles_labels()[0]:
        place: dict[str, Any] = {"loc": "lower left", "bbox_to_anchor": (0.0, 1.01), "borderaxespad": 0.0}
        ax.legend(ncols=n_columns, handlelength=1.8, columnspacing=1.4, **place | keywords)


def page_legend(fig: Figure, handles: Sequence[Any] | None, n_columns: int, **keywords: Any) -> None:
    """Put a legend above all panels; of the labelled parts of the figure if no entries are given."""
    fig.legend(handles=handles, loc="outside upper left", ncols=n_columns, fontsize=9, **keywords)


def up_from_zero(ax: Axes, *, x: bool = False) -> None:
    """Let the axes begin at zero and end 8 % above the largest value, however little the data vary."""
    ax.set_ylim(0, 1.08 * ax.dataLim.y1 if ax.dataLim.y1 > 0 else None)
    if x:
        ax.set_xlim(0, 1.08 * ax.dataLim.x1 if ax.dataLim.x1 > 0 else None)


def counted(counts: Sequence[int], noun: str) -> str:
    """Return a count with its noun, or the range of several counts."""
    low, high = int(min(counts)), int(max(counts))
    return f"{low}–{high} {noun}s" if low != high else f"{low} {noun}" + ("" if low == 1 else "s")


def per_point(counts: Sequence[int]) -> str:
    """Return the number of trials in each point, whose bars are standard errors."""
    return f"N = {counted(counts, 'trial')} per point{', ± standard error' if max(counts) > 1 else ''}"


def with_minus(value: float, form: str) -> str:
    """Return a number in a format such as `+.1f`, with a true minus sign."""
    return format(value, form).replace("-", "−")


def plain_log_ticks(ax: Axes, which: str = "both") -> None:
    """Label logarithmic axes with plain numbers, and let them span a factor of two at least, also of a single point."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    for axis in {"x": (ax.xaxis,), "y": (ax.yaxis,), "both": (ax.xaxis, ax.yaxis)}[which]:
        low, high = axis.get_view_interval()
        middle = math.sqrt(low * high)
        low, high = min(low, middle / math.sqrt(2)), max(high, middle * math.sqrt(2))
        axis.set_view_interval(low, high, ignore=True)
        decades = math.log10(high / low)
        steps: Sequence[int] = (1, 2, 3, 5, 7) if decades < 1 else (1, 2, 5) if decades < 3.2 else (1,)
        axis.set_major_locator(LogLocator(subs=steps))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_locator(NullLocator())
