"""What a campaign can see: probability of finding each candidate over its size, as a map.

A row an effect, a column a size as a part of the largest plausible one; the sizes found with 50 and 90 % stand behind
the row in the unit of the effect.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.figures.style import BLUE, GRID, INK, MUTED, blank, look
from vinetrack.narrative.power_text import size_text
from vinetrack.narrative.verdict_summary import plain

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from vinetrack.diagnosis.power import EffectPower, Power

LEAST_PART, MOST_PART, COLUMNS = 1e-4, 3.0, 108
"""Range of sizes as parts of the largest plausible one, and columns of the map. Chosen: effects that trials show at a
ten-thousandth of what is plausible need no finer account, and beyond three times it no diagnosis counts a size; 24
columns a decade make a 10 % step."""

_COLUMNS_AT = (0.0, 0.35, 0.7)
"""Places of the columns of sizes, as parts of their width. Chosen: numbers with the longest unit do not meet."""

_ROW_IN, _WIDTH_IN = 0.31, 9.6
"""Chosen: one line of 10 pt a row; a map of 4 in between names and sizes."""


def draw_power(power: Power) -> Figure:
    """Draw the probability with which each effect is found over its size.

    Parameters
    ----------
    power : of a campaign.

    Returns
    -------
    Figure
    """
    from matplotlib.figure import Figure

    entries = sorted(power.effects, key=_order)
    if not entries or power.wary:
        return blank(f"What these trials could have seen is not worked out: {power.wary or 'no candidate acts here'}.")
    parts = np.geomspace(LEAST_PART, MOST_PART, COLUMNS)
    probabilities = np.array(
        [
            [entry.probability_at(entry.zero + part * (entry.largest - entry.zero)) for part in parts]
            for entry in entries
        ]
    )
    with look():
        fig = Figure(figsize=(_WIDTH_IN, _ROW_IN * len(entries) + 1.75), layout="constrained")
        ax, told = fig.subplots(1, 2, width_ratios=(1.45, 1.0))
        edges = np.geomspace(parts[0] ** 1.5 / parts[1] ** 0.5, parts[-1] ** 1.5 / parts[-2] ** 0.5, COLUMNS + 1)
        mesh = ax.pcolormesh(
            edges, np.arange(len(entries) + 1) - 0.5, probabilities, cmap=_colours(), vmin=0, vmax=1, rasterized=True
        )
        _mark_rows(ax, entries)
        _list_sizes(told, entries)
        bar = fig.colorbar(mesh, ax=ax, location="bottom", fraction=0.06, pad=0.02, aspect=50)
        bar.set_label("probability of finding it (%)")
        bar.set_ticks([0, 0.5, 0.9, 1], labels=["0", "50", "90", "100"])
        bar.outline.set_visible(False)
        trials = f"{power.n_trials} trial{'s' if power.n_trials != 1 else ''}"
        ax.set_title(f"What {trials} can show", loc="left", pad=26)
    return fig


def _order(entry: EffectPower) -> float:
    """Effects that are seen at the smallest part of their plausible sizes first."""
    return abs((entry.size_at(0.9) - entry.zero) / (entry.largest - entry.zero))


def _colours() -> Any:
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list("power", ["#ffffff", "#d7e6f2", "#7fb2d8", BLUE, "#003f66"])


def _mark_rows(ax: Axes, entries: list[EffectPower]) -> None:
    """Names to the left, and a line at what is plausible."""
    ax.set_xscale("log")
    ax.set_xlim(LEAST_PART, MOST_PART)
    ax.set_ylim(len(entries) - 0.5, -0.5)
    ax.grid(visible=False)
    ax.set_xlabel("size, as part of the largest plausible")
    ax.set_xticks([0.0001, 0.001, 0.01, 0.1, 1.0], labels=["0.0001", "0.001", "0.01", "0.1", "1"])
    # White beneath the dots: ink alone is not seen on the dark of what is found.
    ax.axvline(1.0, color="white", linewidth=2.2)
    ax.axvline(1.0, color=INK, linewidth=1.2, linestyle=":")
    ax.set_yticks(range(len(entries)), [f"{plain(entry.effect)}, {entry.symbol}" for entry in entries])
    ax.tick_params(axis="y", length=0)
    for row in range(1, len(entries)):
        ax.axhline(row - 0.5, color=GRID, linewidth=0.7)


def _list_sizes(ax: Axes, entries: list[EffectPower]) -> None:
    """Sizes beside the rows of the map, in the unit of each effect; grey beyond what is plausible."""
    ax.set_axis_off()
    ax.set_ylim(len(entries) - 0.5, -0.5)
    ax.set_xlim(0, 1)
    for row, entry in enumerate(entries):
        for column, value in zip(_COLUMNS_AT, (entry.size_at(0.5), entry.size_at(0.9), entry.largest), strict=True):
            beyond = column == _COLUMNS_AT[-1] or abs(value - entry.zero) > abs(entry.largest - entry.zero)
            ax.text(column, row, size_text(entry, value), va="center", fontsize=9, color=MUTED if beyond else INK)
    for column, words in zip(_COLUMNS_AT, ("found\n50 %", "found\n90 %", "largest\nplausible"), strict=True):
        ax.text(column, -0.65, words, va="bottom", fontsize=9, color=INK)
