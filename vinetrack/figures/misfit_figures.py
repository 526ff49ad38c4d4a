"""Where the model fails: the misfit of every condition along its growth, and the missing force.

Colour shows size and sign of the misfit; numbers, in millimetres, are written only where it exceeds replicate scatter.
Cells become transparent with decreasing misfit, so that the page shows through, whatever its colour. If the force is a
single curve against one quantity, it depends on that quantity.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.figures.panels import panel_grid
from vinetrack.figures.style import BLUE, INK, MUTED, VERMILLION, blank, look, rows

if TYPE_CHECKING:
    from collections.abc import Sequence

    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_AHEAD_COLOUR, _BEHIND_COLOUR = BLUE, VERMILLION
_MAX_ROWS = 48  # Chosen: conditions of 0.3 in each, 16 in together; a page shows no more at once

_NUMBERED_ROWS = 26  # Chosen: with more conditions, the figure is scaled down until numbers of 7.5 pt cannot be read

_COLUMNS = {"misfit_before_m": "before", "misfit_after_m": "after"}


def draw_where(table: pd.DataFrame, added: str = "") -> Figure:
    """Draw the misfit by condition and position."""
    from matplotlib.figure import Figure

    shown = [c for c in _COLUMNS if len(table) and np.isfinite(table[c].to_numpy(dtype=float)).any()]
    if not shown:
        return blank("There is no prediction to compare with a measurement.")
    labels, n_conditions = _largest_misfits(table, shown), table["condition_label"].nunique()
    known_mm = 1e3 * np.abs(table[shown].to_numpy(dtype=float))
    full_mm = max(float(np.nanpercentile(known_mm, 97)), 1e-6)
    with look():
        width_in = 2.6 + 4.3 * len(shown)
        fig = Figure(figsize=(width_in, 0.3 * len(labels) + 1.75), layout="constrained")
        axes = fig.subplots(1, len(shown), sharey=True, squeeze=False)[0]
        for ax, column in zip(axes, shown, strict=True):
            _draw_cells(ax, table, column, labels, full_mm)
            words = _COLUMNS[column] + (f": with {added}" if column == "misfit_after_m" and added else "")
            ax.set_title(words, fontsize=10)
            ax.set_xlabel("along the growth (%)")
        axes[0].set_yticks(range(len(labels)), _row_names(table, labels), fontsize=9)
        left_out = f"the {len(labels)} of {n_conditions} conditions with the largest misfit"
        numbers = "; numbers in mm, where beyond scatter" if len(labels) <= _NUMBERED_ROWS else ""
        legend = f"full colour: {full_mm:.2g} mm{numbers}", left_out if n_conditions > len(labels) else ""
        _misfit_legend(fig, legend, 3 if len(shown) > 1 else 2)
    return fig


def _largest_misfits(table: pd.DataFrame, columns: Sequence[str]) -> list[str]:
    """Labels of the conditions with the largest misfit, at most `_MAX_ROWS`, in the order of the table."""
    labels = list(dict.fromkeys(table["condition_label"]))
    if len(labels) <= _MAX_ROWS:
        return labels
    misfit_m = table.set_index("condition_label")[columns[0]].astype(float)
    square = (misfit_m**2).groupby(level=0).mean().sort_values(ascending=False, kind="stable")
    largest = set(square.index[:_MAX_ROWS])
    return [label for label in labels if label in largest]


def _row_names(table: pd.DataFrame, labels: Sequence[str]) -> list[str]:
    counts = table.drop_duplicates("condition_label").set_index("condition_label")["n_trials"]
    return [f"{label}, N = {int(counts[label])}" for label in labels]


def _draw_cells(ax: Axes, table: pd.DataFrame, column: str, labels: Sequence[str], full_mm: float) -> None:
    from matplotlib.patches import Rectangle

    place = {label: i for i, label in enumerate(labels)}
    for row in rows(table):
        misfit_m = getattr(row, column)
        if row.condition_label not in place or not np.isfinite(misfit_m):
            continue
        y, misfit_mm = place[row.condition_label], 1e3 * misfit_m
        left, width = 100 * row.growth_from, 100 * (row.growth_to - row.growth_from)
        depth = min(abs(misfit_mm) / full_mm, 1.0)
        cell: dict[str, Any] = {
            "facecolor": _AHEAD_COLOUR if misfit_mm > 0 else _BEHIND_COLOUR,
            "alpha": 0.85 * depth,
            "lw": 0,
        }
        ax.add_patch(Rectangle((left, y - 0.46), width, 0.92, **cell))
        beyond = not abs(misfit_m) <= 2 * row.scatter_m  # an unknown scatter (NaN) explains no misfit
        if beyond and len(labels) <= _NUMBERED_ROWS and depth > 0.06:
            digits = 0 if abs(misfit_mm) >= 9.95 else 1
            words = f"{misfit_mm:+.{digits}f}".replace("-", "−")
            ax.text(left + width / 2, y, words, ha="center", va="center", fontsize=7.5, color=INK)
    ax.set(xlim=(0, 100), ylim=(len(labels) - 0.45, -0.55))
    ax.grid(visible=False)
    ax.tick_params(axis="y", length=0)


def _misfit_legend(fig: Figure, words: tuple[str, str], n_columns: int) -> None:
    """The legend: both colours, the meaning of full colour, and which conditions are shown (blank if all)."""
    from matplotlib.patches import Patch

    full_colour, which = words
    handles = [
        Patch(facecolor=_AHEAD_COLOUR, alpha=0.85, label="measured is ahead of the model"),
        Patch(facecolor=_BEHIND_COLOUR, alpha=0.85, label="measured is behind"),
        Patch(facecolor=MUTED, alpha=0.2, label=full_colour),
    ]
    if which:
        handles.append(Patch(alpha=0.0, label=which))
    fig.legend(handles=handles, loc="outside upper left", ncols=n_columns, fontsize=9, handlelength=1.3)


# Quantities that the force may depend on: label, and factor from SI
FORCE_AXES = {
    "tail_position_m": ("tail position x (mm)", 1e3),
    "lead_position_m": ("growth y (mm)", 1e3),
    "tail_velocity_m_s": ("tail speed ẋ (m/s)", 1.0),
    "lead_velocity_m_s": ("leading-edge speed ẏ (m/s)", 1.0),
    "time_s": ("time since release (ms)", 1e3),
    "pressure_Pa": ("pressure (kPa)", 1e-3),
}

_MAX_FORCE_PANELS = 4  # Chosen: two rows of two panels


def draw_missing_force(table: pd.DataFrame) -> Figure:
    """Draw the missing force."""
    from matplotlib.figure import Figure

    panels = [name for name in FORCE_AXES if len(table) and (table["against"] == name).any()][:_MAX_FORCE_PANELS]
    if not panels:
        return blank("No missing force was found that could be drawn.")
    n_columns = min(len(panels), 2)
    n_rows = -(-len(panels) // n_columns)
    with look():
        fig = Figure(figsize=(1.0 + 4.0 * n_columns, 0.5 + 2.7 * n_rows), layout="constrained")
        for ax, against in zip(panel_grid(fig, len(panels), n_columns, sharey=True), panels, strict=True):
            _draw_force(ax, table[table["against"] == against], against)
        fig.supylabel("missing force (N)", fontsize=11)
    return fig


def _draw_force(ax: Axes, points: pd.DataFrame, against: str) -> None:
    words, factor = FORCE_AXES[against]
    single = points[points["condition"] != ""]
    for _, curve in single.groupby("condition", sort=False):
        ordered = curve.sort_values("value")
        ax.plot(factor * ordered["value"], ordered["force_N"], color=MUTED, lw=0.9, alpha=0.8)
    mean = points[points["condition"] == ""].sort_values("value")
    if len(mean):
        sigma = np.nan_to_num(mean["sigma_N"].to_numpy(dtype=float))
        ax.errorbar(factor * mean["value"], mean["force_N"], sigma, color=BLUE, marker="o", ms=4, lw=1.5, elinewidth=1)
    ax.axhline(0, color=INK, lw=0.8)
    ax.set_xlabel(words)
    count = single["condition"].nunique()
    if count:
        ax.set_title(f"N = {count} conditions", fontsize=9, fontweight="normal", color=MUTED)
