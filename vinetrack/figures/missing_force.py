"""The force that the model lacks, against position, speed, time and pressure.

Along which of them it is one curve says what it hangs on.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vinetrack.figures.style import BLUE, INK, MUTED, blank, look

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

AXES = {
    "tail_position_m": ("tail position x (mm)", 1e3),
    "lead_position_m": ("growth y (mm)", 1e3),
    "tail_velocity_m_s": ("tail speed ẋ (m/s)", 1.0),
    "lead_velocity_m_s": ("leading-edge speed ẏ (m/s)", 1.0),
    "time_s": ("time since release (ms)", 1e3),
    "pressure_Pa": ("pressure (kPa)", 1e-3),
}
"""What it may hang on: how each is shown, and the factor from SI."""

MAX_PANELS = 4


def draw_missing_force(table: pd.DataFrame) -> Figure:
    """Draw the force that is missing.

    Parameters
    ----------
    table : one row a point: `against` (a key of `AXES`), `value` (SI), `force_N, sigma_N` (one standard error, NaN
        where unknown) and `condition`, blank for the mean over all.
    """
    from matplotlib.figure import Figure

    panels = [name for name in AXES if len(table) and (table["against"] == name).any()][:MAX_PANELS]
    if not panels:
        return blank("No force is missing that could be drawn.")
    n_columns = min(len(panels), 2)
    n_rows = -(-len(panels) // n_columns)
    with look():
        fig = Figure(figsize=(1.0 + 4.0 * n_columns, 0.5 + 2.7 * n_rows), layout="constrained")
        axes = fig.subplots(n_rows, n_columns, squeeze=False, sharey=True)
        for ax, against in zip(axes.flat, panels, strict=False):
            _draw_panel(ax, table[table["against"] == against], against)
        for ax in axes.flat[len(panels) :]:
            ax.set_visible(False)
        fig.supylabel("missing force (N)", fontsize=11)
    return fig


def _draw_panel(ax: Axes, points: pd.DataFrame, against: str) -> None:
    words, factor = AXES[against]
    single = points[points["condition"] != ""]
    for _, one in single.groupby("condition", sort=False):
        ordered = one.sort_values("value")
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
