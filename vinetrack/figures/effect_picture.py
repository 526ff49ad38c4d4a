"""What one effect does: position and speed of the leading edge with and without it, and the difference."""

from __future__ import annotations

import textwrap
from typing import TYPE_CHECKING

import numpy as np

from vinetrack.figures.style import BLUE, INK, MUTED, VERMILLION, fitting_size, look

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

_WIDTH_IN = 7.2


def draw_effect(name: str, size: str, vine: str, table: pd.DataFrame) -> Figure:
    """Draw one effect on one vine.

    Parameters
    ----------
    name : of the effect.
    size : its parameters in words, such as `C_D = 1`; blank where it has none.
    vine : the vine and the trial in words.
    table : columns as of `vinetrack.dynamics.effect_motion.effect_motion`.
    """
    from matplotlib.figure import Figure

    time_ms = 1e3 * table["time_s"].to_numpy()
    with look():
        fig = Figure(figsize=(_WIDTH_IN, 7.0))
        position, speed, gap = fig.subplots(3, 1, sharex=True, height_ratios=(3, 3, 2))
        for axes, key, factor in ((position, "position_m", 1e3), (speed, "velocity_m_s", 1.0)):
            axes.plot(time_ms, factor * table[f"without_{key}"], color=MUTED, lw=2.4, label="without")
            axes.plot(time_ms, factor * table[f"with_{key}"], color=BLUE, label="with")
        difference_mm = 1e3 * table["difference_m"].to_numpy()
        gap.axhline(0.0, color=INK, lw=0.8)
        gap.plot(time_ms, difference_mm, color=VERMILLION)
        gap.fill_between(time_ms, 0.0, difference_mm, color=VERMILLION, alpha=0.15, lw=0)
        speed.set_ylim(*_speed_limits(table))
        position.set_ylabel("leading edge y (mm)")
        speed.set_ylabel("its speed ẏ (m/s)")
        gap.set_ylabel("difference (mm)")
        gap.set_xlabel("time since release (ms)")
        title = name + (f": {size}" if size else "")
        fig.text(0.12, 0.955, title, fontweight="bold", fontsize=fitting_size(title, 0.52 * 72 * _WIDTH_IN, 11))
        position.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2)
        fig.align_ylabels()
        fig.subplots_adjust(left=0.12, right=0.97, top=0.93, bottom=0.135, hspace=0.14)
        fig.text(0.012, 0.012, textwrap.fill(f"Simulated: {vine}.", 104), color=MUTED, fontsize=8.8, va="bottom")
    return fig


def _speed_limits(table: pd.DataFrame) -> tuple[float, float]:
    """From 0 past the bulk of both curves: the jump of a first frame or of a diverging end would hide them."""
    speeds = np.concatenate([table["without_velocity_m_s"], table["with_velocity_m_s"]])
    top = 1.15 * float(np.quantile(speeds, 0.99))
    return min(0.0, 1.15 * float(np.quantile(speeds, 0.01))), top if top > 0 else 1.0
