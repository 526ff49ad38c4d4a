"""One condition before and after: its trials, the model that the user came with, and the one with the effects added.

Above positions, below the misfit: measured minus model. Replicates share one clock, each shifted by its own release.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.core.numbers import number
from vinetrack.figures.style import BLUE, INK, MUTED, VERMILLION, blank, look

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BEFORE, AFTER = VERMILLION, BLUE
"""Colours of the model before and after, here and in the clips."""

BEFORE_LINE = (0, (5, 2))
_WIDTH_IN = 5.2
_MAX_POINTS = 160


def draw_before_after(title: str, trials: pd.DataFrame, added: str = "") -> Figure:
    """Draw one condition.

    Parameters
    ----------
    title : the condition in words.
    trials : `trial, time_s, lead_position_m, model_before_m, model_after_m`, time since release and positions from the
        origin; `model_after_m` NaN where nothing was added.
    added : the effects that were added, in words.
    """
    from matplotlib.figure import Figure

    if trials.empty:
        return blank("There is no prediction to hold against a measurement.", _WIDTH_IN)
    parts = [_moving(part) for _, part in trials.groupby("trial", sort=False)]
    has_after = bool(np.isfinite(trials["model_after_m"]).any())
    with look():
        fig = Figure(figsize=(_WIDTH_IN, 4.3), layout="constrained")
        growth, left = fig.subplots(2, 1, sharex=True, height_ratios=(2.1, 1))
        for part in parts:
            time_ms, measured_mm = 1e3 * part["time_s"].to_numpy(), 1e3 * part["lead_position_m"].to_numpy()
            growth.plot(time_ms, measured_mm, ".", color=MUTED, ms=4.5, mew=0)
            left.plot(time_ms, measured_mm - 1e3 * part["model_before_m"], color=BEFORE, lw=1.3, ls=BEFORE_LINE)
            if has_after:
                left.plot(time_ms, measured_mm - 1e3 * part["model_after_m"], color=AFTER, lw=1.3)
        for part in parts:
            growth.plot(1e3 * part["time_s"], 1e3 * part["model_before_m"], color=BEFORE, lw=1.6, ls=BEFORE_LINE)
            if has_after:
                growth.plot(1e3 * part["time_s"], 1e3 * part["model_after_m"], color=AFTER, lw=1.6)
        left.axhline(0, color=INK, lw=0.8)
        growth.set_ylabel("growth (mm)")
        left.set(xlabel="time since release (ms)", ylabel="misfit (mm)")
        growth.set_title(title, fontsize=10)
        _legend(growth, trials, len(parts), has_after, added)
    return fig


def rms_m(trials: pd.DataFrame, model: str) -> float:
    """Root mean square of what a model (`model_before_m` or `model_after_m`) leaves while something moves, m.

    Every trial counts alike, as in `comparison.csv`; NaN where the model says nothing.
    """
    squares = [
        float(np.mean((part["lead_position_m"] - part[model]) ** 2))
        for _, part in trials[trials["time_s"] >= 0].groupby("trial", sort=False)
    ]
    return math.sqrt(float(np.mean(squares))) if squares else math.nan


def _moving(part: pd.DataFrame) -> pd.DataFrame:
    """From a little before release, thinned to what a small figure can show."""
    end_s = float(part["time_s"].iloc[-1])
    kept = part[part["time_s"] >= -0.06 * end_s]
    return kept.iloc[:: max(len(kept) // _MAX_POINTS, 1)]


def _legend(ax: Axes, trials: pd.DataFrame, n_trials: int, has_after: bool, added: str) -> None:
    from matplotlib.lines import Line2D

    measured: dict[str, Any] = {"color": MUTED, "marker": ".", "ls": "none", "ms": 8}
    handles = [
        Line2D([], [], label=f"measured, N = {n_trials}", **measured),
        Line2D([], [], color=BEFORE, ls=BEFORE_LINE, label=f"model you came with: {_off(trials, 'model_before_m')}"),
    ]
    if has_after:
        after = f"with {added}" if added else "after"
        handles.append(Line2D([], [], color=AFTER, label=f"{after}: {_off(trials, 'model_after_m')}"))
    ax.legend(handles=handles, loc="lower right", fontsize=9, borderaxespad=0.2, labelspacing=0.3)


def _off(trials: pd.DataFrame, model: str) -> str:
    return f"{number(1e3 * rms_m(trials, model), 2)} mm rms"
