"""Model and measurement, one small panel per condition: positions against time, or residuals against growth."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.figures.panels import fitting_size, page_columns, panel_font, panel_grid
from vinetrack.figures.style import DASHED, INK, MUTED, blank, look, rows, vine_styles

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MAX_PANELS = 60  # Chosen: 60 panels in rows of eight are 1.4 in wide, the narrowest that has room for its label

_MAX_POINTS_IN_ALL = 12_000  # Measured: 12,000 points keep the SVG below a megabyte, with 200 trials too

_WIDTH_IN = 11.0  # Chosen: the width of the page at which letters of 11 pt are as large as its text
_NO_FIT = "The model in use was not fitted: there is no prediction to compare with the measurement."

_Drawing = Callable[["Axes", "pd.DataFrame", str, int], None]


def draw_model_comparison(comparison: pd.DataFrame, trajectories: Mapping[str, pd.DataFrame]) -> Figure:
    """Draw positions since release: replicates, their band, and the model."""
    return _panels(comparison, trajectories, _draw_positions, "time since release (ms)", "growth (mm)")


def draw_model_residuals(comparison: pd.DataFrame, trajectories: Mapping[str, pd.DataFrame]) -> Figure:
    """Draw measurement minus model against growth."""
    return _panels(comparison, trajectories, _draw_residuals, "growth (mm)", "measurement − model (mm)")


def _panels(
    comparison: pd.DataFrame, trajectories: Mapping[str, pd.DataFrame], draw: _Drawing, x_label: str, y_label: str
) -> Figure:
    from matplotlib.figure import Figure

    known = [row for row in rows(comparison) if row.condition in trajectories]
    farthest = sorted(known, key=lambda row: -np.nan_to_num(row.rms_position_m))[:MAX_PANELS]
    chosen = {row.condition for row in farthest}
    shown = [row for row in known if row.condition in chosen]
    if not shown:
        return blank(_NO_FIT)
    n_columns = page_columns(len(shown), 8)
    n_rows = math.ceil(len(shown) / n_columns)
    n_trials = sum(trajectories[row.condition]["trial"].nunique() for row in shown)
    n_points = min(max(_MAX_POINTS_IN_ALL // n_trials, 25), 150)
    styles = vine_styles([row.vine for row in shown])
    with look():
        font = panel_font(n_columns)
        panel_in = min(_WIDTH_IN / n_columns, 6.0)
        row_in = min(max(0.78 * panel_in, 1.35), 3.6)
        fig = Figure(figsize=(n_columns * panel_in, n_rows * row_in + 0.95), layout="constrained")
        for ax, row in zip(panel_grid(fig, len(shown), n_columns), shown, strict=True):
            draw(ax, trajectories[row.condition], styles[row.vine].colour, n_points)
            _label(ax, row, trajectories[row.condition]["trial"].nunique(), font, 72 * (panel_in - 0.45), draw)
        fig.supxlabel(x_label, fontsize=11)
        fig.supylabel(y_label, fontsize=11)
        title = f"{str(shown[0].model).replace('+', ' + ')}; {n_trials} trials"
        if draw is _draw_positions and "model_after_m" in trajectories[shown[0].condition]:
            title += "; dashed: this model, full: with the effects that were added"
        if len(known) > len(shown):
            title += f"; the {len(shown)} of {len(known)} conditions with the largest error"
        wrapped = textwrap.fill(title, int(n_columns * panel_in * 11))
        fig.suptitle(wrapped, fontsize=11, x=0.01, ha="left")
    return fig


def _label(ax: Axes, row: Any, n_trials: int, font: float, width_pt: float, draw: _Drawing) -> None:
    label = str(row.condition_label)
    size = fitting_size(label, width_pt, font, bold=False)
    ax.set_title(label, fontsize=size, fontweight="normal", pad=3)
    times = f" ({row.ratio:.2g}×)" if math.isfinite(row.ratio) else ""
    words = f"rms {1e3 * row.rms_position_m:.2g} mm{times}\nN = {n_trials}"
    # The curve of growth leaves the upper left empty; residuals get extra room below.
    x, y, side, height = (0.98, 0.03, "right", "bottom") if draw is _draw_residuals else (0.03, 0.97, "left", "top")
    ax.text(x, y, words, transform=ax.transAxes, ha=side, va=height, fontsize=font - 1.5, color=MUTED)
    ax.tick_params(labelsize=font - 0.5, colors=INK)
    ax.locator_params(nbins=4)


def _moving(table: pd.DataFrame, n_points: int) -> list[pd.DataFrame]:
    """Each trial from shortly before model or measurement moves, thinned for a small panel."""
    parts = []
    for _, part in table.groupby("trial", sort=False):
        time_s, growth_m = (part[name].to_numpy(dtype=float) for name in ("time_s", "lead_position_m"))
        begun = growth_m >= growth_m[0] + 0.01 * (np.max(growth_m) - growth_m[0])
        first_s = min(0.0, float(np.min(time_s[begun])))
        begin_s = first_s - 0.05 * (time_s[-1] - first_s)
        kept = part[time_s >= begin_s]
        parts.append(kept.iloc[:: max(len(kept) // n_points, 1)])
    return parts


def _longest(parts: list[pd.DataFrame]) -> pd.DataFrame:
    return max(parts, key=lambda part: float(part["time_s"].iloc[-1]))


def _draw_positions(ax: Axes, table: pd.DataFrame, colour: str, n_points: int) -> None:
    parts = _moving(table, n_points)
    longest = _longest(parts)
    time_ms, mean_mm, sigma_mm = (
        1e3 * longest[name].to_numpy(dtype=float) for name in ("time_s", "replicates_mean_m", "replicates_sigma_m")
    )
    ax.fill_between(time_ms, mean_mm - sigma_mm, mean_mm + sigma_mm, color=colour, alpha=0.22, lw=0)
    for part in parts:
        ax.plot(1e3 * part["time_s"], 1e3 * part["lead_position_m"], color=colour, lw=0.8)
    ax.plot(1e3 * longest["time_s"], 1e3 * longest["model_position_m"], color=INK, lw=1.5, ls=DASHED)
    if "model_after_m" in longest:
        ax.plot(1e3 * longest["time_s"], 1e3 * longest["model_after_m"], color=INK, lw=1.5)


def _draw_residuals(ax: Axes, table: pd.DataFrame, colour: str, n_points: int) -> None:
    parts = _moving(table, n_points)
    longest = _longest(parts)
    growth_mm, sigma_mm = (
        1e3 * longest[name].to_numpy(dtype=float) for name in ("replicates_mean_m", "replicates_sigma_m")
    )
    order = np.argsort(growth_mm)
    ax.fill_between(growth_mm[order], -sigma_mm[order], sigma_mm[order], color=colour, alpha=0.22, lw=0)
    ax.axhline(0, color=INK, lw=1.0, ls=DASHED)
    for part in parts:
        residual_mm = 1e3 * (part["lead_position_m"] - part["model_position_m"])
        ax.plot(1e3 * part["lead_position_m"], residual_mm, color=colour, lw=0.9)
    low, high = ax.get_ylim()
    ax.set_ylim(low - 0.35 * (high - low), high)  # room for the text below
