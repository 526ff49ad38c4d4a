"""Errors of the models of the ladder, and the condition with the largest error of the initial model, before
and after.

Errors change by factors, so their axis is logarithmic. The range below replicate scatter is shaded: an error there says
nothing about the model.
"""

from __future__ import annotations

import math
import textwrap
from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.core.numbers import number
from vinetrack.figures.panels import line_key, plain_log_ticks
from vinetrack.figures.style import BLUE, DASHED, GREEN, INK, MUTED, VERMILLION, blank, look

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Columns of `ladder.csv`, with label, colour, marker and line style
_ERRORS = {
    "rms_in_sample_m": ("in sample", BLUE, "o", "-"),
    "rms_left_out_m": ("on left-out conditions", VERMILLION, "s", "-"),
    "rms_highest_pressure_m": ("on the left-out highest pressure", GREEN, "^", DASHED),
}

_WIDTH_IN = 5.2  # Chosen: both figures fit side by side on a page of 11 in

_STEP_IN = 1.55  # Width per model of the ladder; chosen: the longest name of an effect, wrapped at 18 letters of 10 pt


def draw_ladder(ladder: pd.DataFrame) -> Figure:
    """Draw the errors of the initial model and of every further model of the ladder."""
    from matplotlib.figure import Figure

    if not len(ladder):
        return blank("No model was fitted: there are no errors to show.", _WIDTH_IN)
    steps = np.arange(len(ladder))
    errors_mm = {key: 1e3 * ladder[key].to_numpy(dtype=float) for key in _ERRORS}
    floor_mm = 1e3 * ladder["floor_m"].to_numpy(dtype=float)
    with look():
        fig = Figure(figsize=(max(_WIDTH_IN, 2.4 + _STEP_IN * len(ladder)), 3.9), layout="constrained")
        ax = fig.add_subplot()
        ax.set(yscale="log", ylabel="error of position, rms (mm)", xlim=(-0.5, len(ladder) - 0.5))
        ax.set_ylim(*_error_limits([*errors_mm.values(), floor_mm]))
        _draw_floor(ax, floor_mm)
        for key, (_, colour, marker, line) in _ERRORS.items():
            ax.plot(steps, errors_mm[key], marker=marker, color=colour, ls=line, ms=7, zorder=3)
        _write_values(ax, errors_mm)
        partial = ladder["partial"] if "partial" in ladder else [False] * len(ladder)
        labels = [_step_label(*step) for step in zip(range(len(ladder)), ladder["added"], partial, strict=True)]
        ax.set_xticks(steps, labels)
        ax.grid(axis="x", visible=False)
        plain_log_ticks(ax, "y")
        _ladder_legend(ax, errors_mm)
    return fig


def _step_label(step: int, added: Any, partial: Any) -> str:
    if step == 0:
        return "initial\nmodel"
    words = str(added).replace("+", " + ").replace("_", " ") + (" (partial)" if partial in (True, "True") else "")
    return "+ " + "\n".join(textwrap.wrap(words, 18, break_long_words=False))


def _error_limits(errors_mm: list[np.ndarray]) -> tuple[float, float]:
    """Limits around all values with a margin, spanning at least a factor of four."""
    known = np.concatenate(errors_mm)
    known = known[np.isfinite(known) & (known > 0)]
    if not known.size:
        return 0.1, 1.0
    low, high = float(known.min()), float(known.max())
    middle = math.sqrt(low * high)
    return min(0.72 * low, middle / 2), max(1.35 * high, middle * 2)


def _draw_floor(ax: Axes, floor_mm: np.ndarray) -> None:
    known = floor_mm[np.isfinite(floor_mm) & (floor_mm > 0)]
    if not known.size:
        return
    floor = float(known[-1])
    ax.axhspan(ax.get_ylim()[0], floor, color=MUTED, alpha=0.16, lw=0, zorder=0)
    ax.axhline(floor, color=MUTED, lw=1.3, ls=(0, (1.5, 1.5)), zorder=1)
    words = f"replicate scatter: {number(floor)} mm"
    ax.annotate(
        words, (0.015, floor), (0, -4), ("axes fraction", "data"), "offset points", color=MUTED, va="top", fontsize=9
    )


def _write_values(ax: Axes, errors_mm: dict[str, np.ndarray]) -> None:
    """Write the values next to the points, clear of the lines and of each other."""
    low, high = (math.log10(value) for value in ax.get_ylim())
    spacing = 0.075 * (high - low)
    n_steps = len(next(iter(errors_mm.values())))
    for step in range(n_steps):
        shown = [(float(values[step]), _ERRORS[key][1]) for key, values in errors_mm.items() if values[step] > 0]
        shown.sort()
        side, sideways = ("right", -9) if step == 0 and n_steps > 1 else ("left", 9)
        lifted = 0.6 * spacing if 0 < step < n_steps - 1 else 0.0  # lines arrive from above left and leave to the right
        levels = [math.log10(value) + lifted for value, _ in shown]
        for i in range(1, len(levels)):
            levels[i] = max(levels[i], levels[i - 1] + spacing)
        excess = max(levels[-1] - (high - spacing / 2), 0.0) if levels else 0.0
        for (value, colour), level in zip(shown, levels, strict=True):
            style: dict[str, Any] = {"color": colour, "fontsize": 9, "fontweight": "bold", "ha": side, "va": "center"}
            ax.annotate(
                number(value), (step, 10 ** (level - excess)), (sideways, 0), textcoords="offset points", **style
            )


def _ladder_legend(ax: Axes, errors_mm: dict[str, np.ndarray]) -> None:
    handles = [
        line_key(name, color=colour, marker=marker, ls=line, ms=6)
        for key, (name, colour, marker, line) in _ERRORS.items()
        if np.isfinite(errors_mm[key]).any()
    ]
    ax.legend(
        handles=handles, loc="lower left", bbox_to_anchor=(-0.02, 1.0), fontsize=9, labelspacing=0.25, labelcolor=INK
    )


BEFORE, AFTER = VERMILLION, BLUE  # Colours of the models before and after adding effects, here and in the clips

_BEFORE_LINE: Any = (0, (5, 2))  # Dashes of five line widths
_MAX_POINTS = 160  # Points per trial; chosen


def draw_before_after(title: str, trials: pd.DataFrame, added: str = "") -> Figure:
    """Draw one condition."""
    from matplotlib.figure import Figure

    if trials.empty:
        return blank("There is no prediction to compare with a measurement.", _WIDTH_IN)
    parts = [_moving(part) for _, part in trials.groupby("trial", sort=False)]
    has_after = bool(np.isfinite(trials["model_after_m"]).any())
    with look():
        fig = Figure(figsize=(_WIDTH_IN, 4.3), layout="constrained")
        growth, misfit = fig.subplots(2, 1, sharex=True, height_ratios=(2.1, 1))
        for part in parts:
            time_ms, measured_mm = 1e3 * part["time_s"].to_numpy(), 1e3 * part["lead_position_m"].to_numpy()
            growth.plot(time_ms, measured_mm, ".", color=MUTED, ms=4.5, mew=0)
            misfit.plot(time_ms, measured_mm - 1e3 * part["model_before_m"], color=BEFORE, lw=1.3, ls=_BEFORE_LINE)
            if has_after:
                misfit.plot(time_ms, measured_mm - 1e3 * part["model_after_m"], color=AFTER, lw=1.3)
        for part in parts:
            growth.plot(1e3 * part["time_s"], 1e3 * part["model_before_m"], color=BEFORE, lw=1.6, ls=_BEFORE_LINE)
            if has_after:
                growth.plot(1e3 * part["time_s"], 1e3 * part["model_after_m"], color=AFTER, lw=1.6)
        misfit.axhline(0, color=INK, lw=0.8)
        growth.set_ylabel("growth (mm)")
        misfit.set(xlabel="time since release (ms)", ylabel="misfit (mm)")
        growth.set_title(title, fontsize=10)
        _before_after_legend(growth, trials, len(parts), has_after, added)
    return fig


def rms_m(trials: pd.DataFrame, model: str) -> float:
    """Return the root mean square error of position of a model after release, m. Returns all trials have the same
    weight, as in `comparison.csv`; NaN without a prediction.
    """
    squares = [
        float(np.mean((part["lead_position_m"] - part[model]) ** 2))
        for _, part in trials[trials["time_s"] >= 0].groupby("trial", sort=False)
    ]
    return math.sqrt(float(np.mean(squares))) if squares else math.nan


def _moving(part: pd.DataFrame) -> pd.DataFrame:
    """One trial, starting before release by 6 % of its duration, thinned for a small figure."""
    end_s = float(part["time_s"].iloc[-1])
    kept = part[part["time_s"] >= -0.06 * end_s]
    return kept.iloc[:: max(len(kept) // _MAX_POINTS, 1)]


def _before_after_legend(ax: Axes, trials: pd.DataFrame, n_trials: int, has_after: bool, added: str) -> None:
    handles = [
        line_key(f"measured, N = {n_trials}", color=MUTED, marker=".", ls="none", ms=8),
        line_key(f"initial model: {_rms_text(trials, 'model_before_m')}", color=BEFORE, ls=_BEFORE_LINE),
    ]
    if has_after:
        after = f"with {added}" if added else "after"
        handles.append(line_key(f"{after}: {_rms_text(trials, 'model_after_m')}", color=AFTER))
    ax.legend(handles=handles, loc="lower right", fontsize=9, borderaxespad=0.2, labelspacing=0.3)


def _rms_text(trials: pd.DataFrame, model: str) -> str:
    return f"{number(1e3 * rms_m(trials, model), 2)} mm rms"
