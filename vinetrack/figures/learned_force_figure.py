"""The missing force learned within the fit: a curve with its band, or a map with the paths of the trials.

Regions without trials are left blank: there the force is that of the prior.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vinetrack.figures.misfit_figures import FORCE_AXES
from vinetrack.figures.style import BLUE, INK, MUTED, VERMILLION, blank, look

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from vinetrack.core.records import Floats

_BAND = 1.96  # Half width of a 95 % band in standard errors (derived)

_LEVELS, _LABELLED = 11, 5  # Shades from zero to the largest force, and labelled contour lines (chosen)


def draw_learned_force(table: pd.DataFrame) -> Figure:
    """Draw the learned force."""
    from matplotlib.figure import Figure

    variables = [name for name in FORCE_AXES if name in table and table[name].notna().any()]
    if not len(table) or not variables:
        return blank("No missing force was learned.")
    grid, along = (table[table["condition"].fillna("") == ""], table[table["condition"].fillna("") != ""])
    with look():
        if len(variables) == 1:
            fig = Figure(figsize=(6.4, 3.6), layout="constrained")
            _draw_curve(fig.subplots(), grid, along, variables[0])
            return fig
        fig = Figure(figsize=(9.6, 4.4), layout="constrained")
        left, right = fig.subplots(1, 2, sharex=True, sharey=True)
        _draw_map(left, grid, along, variables, "force_N", "missing force (N)")
        _draw_map(right, grid, along, variables, "sigma_N", "its standard error (N)")
        right.set_ylabel("")
    return fig


def _draw_curve(ax: Axes, grid: pd.DataFrame, along: pd.DataFrame, variable: str) -> None:
    words, factor = FORCE_AXES[variable]
    seen = grid[grid["trials"] > 0].sort_values(variable)
    at, force = factor * seen[variable].to_numpy(float), seen["force_N"].to_numpy(float)
    half = _BAND * seen["sigma_N"].to_numpy(float)
    ax.fill_between(at, force - half, force + half, color=BLUE, alpha=0.22, lw=0, label="95 % band")
    ax.plot(at, force, color=BLUE, lw=1.8, label="learned force")
    ax.axhline(0, color=INK, lw=0.8)
    places = factor * along[variable].to_numpy(float)
    ax.plot(places, np.full(places.size, 0.02), "|", color=MUTED, ms=6, transform=ax.get_xaxis_transform(),
            label=f"range of the trials, N = {along['condition'].nunique()} conditions")  # fmt: skip
    ax.set(xlabel=words, ylabel="missing force (N)")
    ax.margins(x=0.01)
    ax.figure.legend(loc="outside upper left", ncols=3, fontsize=9)


def _draw_map(ax: Axes, grid: pd.DataFrame, along: pd.DataFrame, variables: list[str], column: str, label: str) -> None:
    from matplotlib.colors import LinearSegmentedColormap
    from matplotlib.ticker import MaxNLocator

    (x_words, x_factor), (y_words, y_factor) = (FORCE_AXES[name] for name in variables)
    wide = grid.pivot_table(index=variables[1], columns=variables[0], values=[column, "trials"])
    values: Floats = np.where(wide["trials"].to_numpy(float) > 0, wide[column].to_numpy(float), np.nan)
    x, y = x_factor * wide[column].columns.to_numpy(float), y_factor * wide[column].index.to_numpy(float)
    signed = column == "force_N"
    most = max(float(np.nanmax(np.abs(values))), 1e-12)
    colours = (VERMILLION, "#ffffff", BLUE) if signed else ("#ffffff", MUTED)
    shown = LinearSegmentedColormap.from_list("force", colours)
    levels = MaxNLocator(2 * _LEVELS if signed else _LEVELS).tick_values(-most if signed else 0.0, most)
    filled = ax.contourf(x, y, values, levels=levels, cmap=shown, alpha=0.85)
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    if high > low:
        steps = np.linspace(low, high, _LABELLED + 2)[1:-1]
        lines = ax.contour(x, y, values, levels=steps, colors=INK, linewidths=0.7)
        ax.clabel(lines, fmt=lambda force: f"{force:.2g}".replace("-", "−"), fontsize=8)
    for _, course in along.groupby("condition", sort=False):
        ax.plot(x_factor * course[variables[0]], y_factor * course[variables[1]], color=MUTED, lw=0.5, alpha=0.7)
    bar = ax.figure.colorbar(filled, ax=ax)
    bar.set_label(label)
    ax.set(xlabel=x_words, ylabel=y_words, xlim=(x[0], x[-1]), ylim=(y[0], y[-1]))
    ax.grid(visible=False)
    if signed:
        ax.set_title(f"grey: trials, N = {along['condition'].nunique()} conditions", fontsize=9, fontweight="normal",
                     color=MUTED)  # fmt: skip
