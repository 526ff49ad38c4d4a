"""What vines not yet built will do: position, speed and tension with their bands, and what leaves it open."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from vinetrack.figures.style import BLUE, INK, MUTED, VINE_COLOURS, fitting_size, look, plain_log_ticks

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MOST_CURVES = len(VINE_COLOURS)
_WIDTH_IN = 9.6
_FAR_APART = 6.0
"""Ratio of the largest to the least above which an axis is logarithmic; that of time from 1 % of the fastest on."""

_SLACK = 0.01
"""Of the largest tension, that a tail must push with before it is worth a word."""


@dataclass(frozen=True)
class Picture:
    """What is drawn of one condition.

    `curve` has the columns of `vinetrack.planning.prediction.CURVE_COLUMNS`; `shares` are (name, low, high) of the
    final speed with one uncertainty alone, m/s, largest first; `final` its low, median and high with all.
    """

    title: str
    curve: pd.DataFrame
    final_name: str
    shares: Sequence[tuple[str, float, float]]
    final: tuple[float, float, float]


def draw_foresight(pictures: Sequence[Picture], at_fraction: float) -> Figure:
    """Draw one condition with what leaves its final speed open, or several beside each other.

    Parameters
    ----------
    pictures : the conditions; beyond the number of colours the last are left out, and that is said.
    at_fraction : y/L at which final speeds are taken.
    """
    from matplotlib.figure import Figure

    drawn = pictures[:MOST_CURVES]
    with look():
        fig = Figure(figsize=(_WIDTH_IN, 7.2))
        axes = fig.subplots(2, 2)
        for colour, picture in zip(VINE_COLOURS, drawn, strict=False):
            _draw_curves(axes, picture, colour)
        _label(axes, drawn, at_fraction)
        if len(drawn) == 1:
            _draw_shares(axes[1, 1], drawn[0])
        else:
            _list_conditions(axes[1, 1], pictures)
        title = drawn[0].title if len(drawn) == 1 else f"{len(pictures)} conditions"
        fig.text(0.075, 0.955, title, fontweight="bold", fontsize=fitting_size(title, 0.9 * 72 * _WIDTH_IN, 12))
        words = "line: median; band: nine draws in ten; everything simulated from what is believed of the vine"
        fig.text(0.075, 0.012, words, color=MUTED, fontsize=8.8)
        fig.align_ylabels(axes[:, 0])
        fig.subplots_adjust(left=0.075, right=0.985, top=0.91, bottom=0.105, hspace=0.3, wspace=0.27)
    return fig


def _draw_curves(axes: np.ndarray, picture: Picture, colour: str) -> None:
    """Position against time; speed and tension against growth."""
    position, speed, tension = axes[0, 0], axes[0, 1], axes[1, 0]
    table = picture.curve
    y_mm, along = 1e3 * table["lead_position_m"].to_numpy(), table["y_over_L"].to_numpy()
    early, middle, late = (
        1e3 * table[name].to_numpy(dtype=float) for name in ("time_low_90_s", "time_s", "time_high_90_s")
    )
    last = _longest(early, middle, late)
    ends = [np.where(np.isfinite(t), t, last) for t in (early, late)]
    position.fill_betweenx(y_mm, *ends, color=colour, alpha=0.18, lw=0)
    come = np.isfinite(middle)
    position.plot(middle[come], y_mm[come], color=colour)
    position.set_xlim(0.0, max(last, position.get_xlim()[1] if position.lines[1:] else 0.0))
    for ax, name, unit in ((speed, "lead_velocity", "m_s"), (tension, "tension", "N")):
        low, high = (table[f"{name}_{side}_90_{unit}"].to_numpy(dtype=float) for side in ("low", "high"))
        ax.fill_between(along, low, high, color=colour, alpha=0.18, lw=0)
        ax.plot(along, table[f"{name}_{unit}"], color=colour)


def _longest(*times_ms: np.ndarray) -> float:
    """The time axis: to the end of the slow side, but no more than four times that of the median."""
    ends = [float(np.max(t[np.isfinite(t)], initial=0.0)) for t in times_ms]
    return min(ends[2], 4 * ends[1]) if ends[1] > 0 else ends[0] or 1.0


def _label(axes: np.ndarray, drawn: Sequence[Picture], at_fraction: float) -> None:
    position, speed, tension = axes[0, 0], axes[0, 1], axes[1, 0]
    position.set_xlabel("time since release (ms)")
    position.set_ylabel("leading edge y (mm)")
    position.set_ylim(bottom=0.0)
    for ax, label in ((speed, "speed of the leading edge ẏ (m/s)"), (tension, "tension of the tail (N)")):
        ax.set_xlabel("growth y/L")
        ax.set_ylabel(label)
        ax.set_xlim(0.0, 1.0)
        ax.axvline(at_fraction, color=MUTED, lw=0.9, ls=(0, (4, 2)))
    low, high = speed.get_ylim()
    speed.set_ylim(max(low, 0.0), high)
    speed.text(at_fraction - 0.015, 0.03, f"y/L = {at_fraction:g}", transform=speed.get_xaxis_transform(), ha="right",
               fontsize=9, color=MUTED)  # fmt: skip
    lows, highs = zip(
        *((p.curve["tension_low_90_N"].min(), p.curve["tension_high_90_N"].max()) for p in drawn), strict=True
    )
    if min(lows) < -_SLACK * max(highs):
        tension.axhline(0.0, color=INK, lw=0.8)
        tension.set_title("below 0 the tail would have to push", fontsize=9.5, fontweight="normal", color=MUTED)
    ends = [float(picture.curve["time_s"].replace(np.inf, np.nan).max()) for picture in drawn]
    if max(ends) > _FAR_APART * min(ends):
        position.set_xscale("log")
        position.set_xlim(left=10.0 * min(ends))
        plain_log_ticks(position, "x")


def _draw_shares(ax: Axes, picture: Picture) -> None:
    """Bars of the final speed: all uncertainties together, then each alone."""
    low, median, high = picture.final
    rows = [("all together", low, high), *picture.shares]
    for k, (_, start, stop) in enumerate(rows):
        ax.barh(k, stop - start, left=start, height=0.55, color=BLUE, alpha=0.85 if k == 0 else 0.4, lw=0)
    ax.axvline(median, color=INK, lw=1.0)
    ax.set_yticks(range(len(rows)), [_folded(name) for name, _, _ in rows], fontsize=8.8)
    ax.invert_yaxis()
    ax.margins(x=0.06)
    ax.use_sticky_edges = False
    if low > 0 and high > _FAR_APART * low:
        ax.set_xscale("log")
        plain_log_ticks(ax, "x")
    ax.grid(visible=False, axis="y")
    ax.set_xlabel(f"{picture.final_name} (m/s)")
    ax.set_title("What leaves it open", fontsize=10.5)


def _folded(name: str) -> str:
    """A name in lines of 15 letters; long names of effects are parted at their underscores."""
    return textwrap.fill(name if len(name) <= 15 else name.replace("_", " "), 15)


def _list_conditions(ax: Axes, pictures: Sequence[Picture]) -> None:
    """Which colour is which condition, in place of the bars."""
    ax.set_axis_off()
    lines = [(colour, picture.title) for colour, picture in zip(VINE_COLOURS, pictures, strict=False)]
    for k, (colour, words) in enumerate(lines):
        y = 0.97 - 0.155 * k
        ax.plot([0.0, 0.07], [y - 0.025] * 2, color=colour, lw=3, transform=ax.transAxes, clip_on=False)
        ax.text(0.1, y, textwrap.fill(words, 50), transform=ax.transAxes, va="top", fontsize=9.2)
    if len(pictures) > len(lines):
        ax.text(0.1, 0.02, f"and {len(pictures) - len(lines)} more, not drawn", transform=ax.transAxes, color=MUTED)
