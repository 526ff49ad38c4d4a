"""All trials: speed against growth in small panels, replicates superposed, steady windows thick.

The abscissa is growth rather than time, because trials last between milliseconds and seconds but grow equally far. With
up to 60 conditions every condition has a panel with its own speed axis, since steady speed rises about as P^2.7; with
more, every vine has one on a shared logarithmic axis, with trials coloured by pressure.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.figures.panels import page_columns, panel_font, panel_grid, plain_log_ticks
from vinetrack.figures.style import INK, MUTED, VERMILLION, blank, look, rows, vine_styles

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable
    from matplotlib.figure import Figure

# Chosen: 60 panels in rows of nine are 1.2 in wide, the narrowest that has room for its label
MAX_CONDITION_PANELS = 60

MAX_PANELS = 120  # Chosen: twelve rows of ten panels; further vines are left out, and the title says so

_MAX_POINTS_IN_ALL = 12_000  # Measured: 12,000 points keep the SVG below a megabyte, with 900 trials too

_MIN_POINTS, _MAX_POINTS = 15, 150  # Points per trial (chosen)

_WIDTH_IN = 11.0  # Chosen: the width of the page at which letters of 11 pt are as large as its text


@dataclass(frozen=True)
class _Panel:
    label: str
    trials: pd.DataFrame


@dataclass(frozen=True)
class _Curve:
    time_s: np.ndarray
    growth_mm: np.ndarray
    speed_m_s: np.ndarray


def draw_overview(trials: pd.DataFrame, kinematics: Mapping[str, pd.DataFrame]) -> Figure:
    """Draw the speed of every trial."""
    from matplotlib.figure import Figure

    shown = trials[trials["status"] != "left_out"]
    drawn = [name for name in shown["trial"] if _has_points(kinematics.get(name))]
    n_points = min(max(_MAX_POINTS_IN_ALL // max(len(drawn), 1), _MIN_POINTS), _MAX_POINTS)
    curves = {name: _curve(kinematics[name], n_points) for name in drawn}
    if not curves:
        return blank("No trial has positions from which a speed could be computed.")
    by_condition = shown["condition"].nunique() <= MAX_CONDITION_PANELS
    panels = _panels(shown, by_condition)
    n_columns = page_columns(len(panels), 10)
    n_rows = math.ceil(len(panels) / n_columns)
    panel_in = _WIDTH_IN / n_columns
    with look():
        font = panel_font(n_columns)
        row_in = min(max(0.72 * panel_in, 1.15), 3.6)
        height_in = n_rows * row_in + 1.15
        fig = Figure(figsize=(_WIDTH_IN, height_in), layout="constrained")
        axes = panel_grid(fig, len(panels), n_columns, sharex=True, sharey=not by_condition)
        colours = _colours(shown, by_condition)
        for ax, panel in zip(axes, panels, strict=True):
            _draw_panel(ax, panel, curves, colours, font)
            if by_condition:
                _limit_speed(ax, [curves[name] for name in panel.trials["trial"] if name in curves])
        for ax in axes[-n_columns:]:
            ax.tick_params(labelbottom=True)
        axes[0].set_xlim(0, 1.02 * max(float(np.nanmax(curve.growth_mm)) for curve in curves.values()))
        fig.supxlabel("growth (mm)", fontsize=11)
        fig.supylabel("leading-edge speed (m/s)", fontsize=11)
        fig.suptitle(_title(shown, curves, len(panels), by_condition), fontsize=11, x=0.01, ha="left")
        if not by_condition:
            _limit_speed(axes[0], list(curves.values()), logarithmic=True)
            _pressure_bar(fig, shown)
    return fig


def _has_points(table: pd.DataFrame | None) -> bool:
    return table is not None and len(table) > 1


def _curve(table: pd.DataFrame, n_points: int) -> _Curve:
    """One trial's curve, thinned for a small panel."""
    position_m = table["lead_position_m"].to_numpy(dtype=float)
    step = max(len(table) // n_points, 1)
    return _Curve(
        table["time_s"].to_numpy(dtype=float)[::step],
        1e3 * (position_m - np.nanmin(position_m))[::step],
        table["lead_velocity_m_s"].to_numpy(dtype=float)[::step],
    )


def _panels(trials: pd.DataFrame, by_condition: bool) -> list[_Panel]:
    if by_condition:
        ordered = trials.sort_values(["vine", "pressure_kPa"], kind="stable", key=_in_order_of_appearance)
        groups = ordered.groupby("condition", sort=False)
        return [_Panel(str(rows["condition_label"].iloc[0]), rows) for _, rows in groups]
    return [_Panel(str(vine), rows) for vine, rows in trials.groupby("vine", sort=False)][:MAX_PANELS]


def _in_order_of_appearance(column: pd.Series) -> pd.Series:
    if column.name != "vine":
        return column
    first = {name: i for i, name in enumerate(dict.fromkeys(column))}
    return column.map(first)


def _colours(trials: pd.DataFrame, by_condition: bool) -> dict[str, Any]:
    if by_condition:
        styles = vine_styles(trials["vine"])
        return {row.trial: styles[row.vine].colour for row in rows(trials)}
    scale = _pressure_scale(trials)
    return {row.trial: scale.to_rgba(row.pressure_kPa) for row in rows(trials)}


def _pressure_scale(trials: pd.DataFrame) -> ScalarMappable:
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    return ScalarMappable(Normalize(trials["pressure_kPa"].min(), trials["pressure_kPa"].max()), "cividis")


def _pressure_bar(fig: Figure, trials: pd.DataFrame) -> None:
    bar = fig.colorbar(_pressure_scale(trials), ax=fig.axes, fraction=0.02, pad=0.01, aspect=40)
    bar.set_label("pressure (kPa)")
    bar.outline.set_visible(False)


def _draw_panel(ax: Axes, panel: _Panel, curves: Mapping[str, _Curve], colours: Mapping[str, Any], font: float) -> None:
    for row in rows(panel.trials):
        if row.trial not in curves:
            continue
        curve, colour = curves[row.trial], colours[row.trial]
        ax.plot(curve.growth_mm, curve.speed_m_s, color=colour, lw=0.8, alpha=0.5)
        steady = (curve.time_s >= row.steady_from_s) & (curve.time_s <= row.steady_to_s)
        if steady.sum() > 1:
            ax.plot(curve.growth_mm[steady], curve.speed_m_s[steady], color=colour, lw=2.2, solid_capstyle="butt")
    n_failed = int((panel.trials["status"] == "failed").sum())
    label = textwrap.shorten(panel.label, 30, placeholder="…") if font > 8 else panel.label
    ax.set_title(label, fontsize=font, fontweight="normal", pad=3)
    ax.text(0.98, 0.05, f"N = {len(panel.trials)}", transform=ax.transAxes, ha="right", fontsize=font - 1, color=MUTED)
    if n_failed:
        ax.text(
            0.98, 0.2, f"{n_failed} failed", transform=ax.transAxes, ha="right", fontsize=font - 1, color=VERMILLION
        )
    ax.tick_params(labelsize=font - 0.5, colors=INK)
    ax.locator_params(nbins=4)


def _limit_speed(ax: Axes, curves: Sequence[_Curve], logarithmic: bool = False) -> None:
    """Set limits that are robust to outliers: the fastest per cent of points may lie outside the panel."""
    if not curves:
        ax.set_yticks([])
        return
    speed_m_s = np.concatenate([curve.speed_m_s for curve in curves])
    moving_m_s = speed_m_s[speed_m_s > 0]
    top = float(np.percentile(moving_m_s, 99)) if moving_m_s.size else 1.0
    if logarithmic and moving_m_s.size:
        ax.set_yscale("log")
        ax.set_ylim(0.5 * min(float(np.nanmedian(curve.speed_m_s)) for curve in curves if _moves(curve)), 1.5 * top)
        plain_log_ticks(ax, "y")
    else:
        ax.set_ylim(0, 1.15 * top)


def _moves(curve: _Curve) -> bool:
    return bool(np.nanmedian(curve.speed_m_s) > 0)


def _title(trials: pd.DataFrame, curves: Mapping[str, _Curve], n_panels: int, by_condition: bool) -> str:
    what = "one panel per condition, each with its own speed axis" if by_condition else "one panel per vine"
    missing = len(trials) - len(curves)
    lines = f"{len(curves)} {'trial' if len(curves) == 1 else 'trials'}, {what}; thick: steady by the gated rule"
    if missing:
        lines += f"; {missing} without positions"
    if n_panels == MAX_PANELS:
        lines += f"; the first {MAX_PANELS} panels"
    return lines
