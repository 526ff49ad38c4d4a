"""Detection power of a campaign: the probability of detecting each effect against its size, as a map.

One row per effect; columns are sizes relative to the largest plausible one. The sizes of 50 and 90 % power are listed
at the end of each row in the unit of the effect.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.figures.style import BLUE, GRID, INK, MUTED, blank, look
from vinetrack.narrative.power_text import size_text
from vinetrack.narrative.verdict_summary import spaced_name

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from vinetrack.diagnosis.power import EffectPower, Power

# Range of sizes relative to the largest plausible one, and columns of the map (chosen)
MIN_RELATIVE_SIZE, MAX_RELATIVE_SIZE, N_COLUMNS = 1e-4, 3.0, 108

_TEXT_COLUMN_X = (0.0, 0.35, 0.7)  # Abscissae of the columns of sizes, relative to their width (chosen)

_ROW_IN, _WIDTH_IN = 0.31, 9.6  # Chosen: one line of 10 pt per row; a map of 4 in between names and sizes


def draw_power(power: Power) -> Figure:
    """Draw the power to detect each effect against its size."""
    from matplotlib.figure import Figure

    entries = sorted(power.effects, key=_order)
    if not entries or power.wary:
        return blank(f"Detectable sizes were not computed: {power.wary or 'no candidate acts here'}.")
    parts = np.geomspace(MIN_RELATIVE_SIZE, MAX_RELATIVE_SIZE, N_COLUMNS)
    probabilities = np.array(
        [
            [entry.probability_at(entry.zero + part * (entry.largest - entry.zero)) for part in parts]
            for entry in entries
        ]
    )
    with look():
        fig = Figure(figsize=(_WIDTH_IN, _ROW_IN * len(entries) + 1.75), layout="constrained")
        ax, sizes = fig.subplots(1, 2, width_ratios=(1.45, 1.0))
        edges = np.geomspace(parts[0] ** 1.5 / parts[1] ** 0.5, parts[-1] ** 1.5 / parts[-2] ** 0.5, N_COLUMNS + 1)
        mesh = ax.pcolormesh(
            edges, np.arange(len(entries) + 1) - 0.5, probabilities, cmap=_colours(), vmin=0, vmax=1, rasterized=True
        )
        _mark_rows(ax, entries)
        _list_sizes(sizes, entries)
        bar = fig.colorbar(mesh, ax=ax, location="bottom", fraction=0.06, pad=0.02, aspect=50)
        bar.set_label("power: probability of detection (%)")
        bar.set_ticks([0, 0.5, 0.9, 1], labels=["0", "50", "90", "100"])
        bar.outline.set_visible(False)
        trials = f"{power.n_trials} trial{'s' if power.n_trials != 1 else ''}"
        ax.set_title(f"What {trials} can detect", loc="left", pad=26)
    return fig


def _order(entry: EffectPower) -> float:
    """Sort key: effects detected at the smallest fraction of their plausible size first."""
    return abs((entry.size_at(0.9) - entry.zero) / (entry.largest - entry.zero))


def _colours() -> Any:
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list("power", ["#ffffff", "#d7e6f2", "#7fb2d8", BLUE, "#003f66"])


def _mark_rows(ax: Axes, entries: list[EffectPower]) -> None:
    """Label the rows, and draw a line at the largest plausible size."""
    ax.set_xscale("log")
    ax.set_xlim(MIN_RELATIVE_SIZE, MAX_RELATIVE_SIZE)
    ax.set_ylim(len(entries) - 0.5, -0.5)
    ax.grid(visible=False)
    ax.set_xlabel("size relative to the largest plausible")
    ax.set_xticks([0.0001, 0.001, 0.01, 0.1, 1.0], labels=["0.0001", "0.001", "0.01", "0.1", "1"])
    # A white line below the dots keeps them visible on the dark part of the map.
    ax.axvline(1.0, color="white", linewidth=2.2)
    ax.axvline(1.0, color=INK, linewidth=1.2, linestyle=":")
    ax.set_yticks(range(len(entries)), [f"{spaced_name(entry.effect)}, {entry.symbol}" for entry in entries])
    ax.tick_params(axis="y", length=0)
    for row in range(1, len(entries)):
        ax.axhline(row - 0.5, color=GRID, linewidth=0.7)


def _list_sizes(ax: Axes, entries: list[EffectPower]) -> None:
    """Write sizes next to the rows of the map, in the unit of each effect; grey beyond the plausible range."""
    ax.set_axis_off()
    ax.set_ylim(len(entries) - 0.5, -0.5)
    ax.set_xlim(0, 1)
    for row, entry in enumerate(entries):
        for column, value in zip(_TEXT_COLUMN_X, (entry.size_at(0.5), entry.size_at(0.9), entry.largest), strict=True):
            beyond = column == _TEXT_COLUMN_X[-1] or abs(value - entry.zero) > abs(entry.largest - entry.zero)
            ax.text(column, row, size_text(entry, value), va="center", fontsize=9, color=MUTED if beyond else INK)
    for column, words in zip(_TEXT_COLUMN_X, ("50 %\npower", "90 %\npower", "largest\nplausible"), strict=True):
        ax.text(column, -0.65, words, va="bottom", fontsize=9, color=INK)
