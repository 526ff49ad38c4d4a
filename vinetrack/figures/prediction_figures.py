"""Simulated motions: predictions for vines not yet built, and the change by one effect."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from vinetrack.figures.panels import fitting_size, plain_log_ticks
from vinetrack.figures.style import BLUE, INK, MUTED, VERMILLION, VINE_COLOURS, look

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MAX_CURVES = len(VINE_COLOURS)  # Derived: the number of colours
_PREDICTION_WIDTH_IN = 9.6  # Chosen: two panels of 4 in with their labels

# Chosen: with a larger ratio of slowest to fastest the fastest takes less than a sixth of a linear axis
_LOG_AXIS_RATIO = 6.0

# Chosen: compression in the tail below 1 % of the largest tension is rounding of the simulation and gets no note
_NEGLIGIBLE_COMPRESSION = 0.01


@dataclass(frozen=True)
class PredictionPicture:
    """The prediction of one condition."""

    title: str
    curve: pd.DataFrame
    final_name: str
    shares: Sequence[tuple[str, float, float]]
    final: tuple[float, float, float]


def draw_predictions(pictures: Sequence[PredictionPicture], at_fraction: float) -> Figure:
    """Draw one condition with the uncertainty budget of its final speed, or several conditions superposed."""
    from matplotlib.figure import Figure

    drawn = pictures[:MAX_CURVES]
    with look():
        fig = Figure(figsize=(_PREDICTION_WIDTH_IN, 7.2))
        axes = fig.subplots(2, 2)
        for colour, picture in zip(VINE_COLOURS, drawn, strict=False):
            _draw_curves(axes, picture, colour)
        _label_prediction(axes, drawn, at_fraction)
        if len(drawn) == 1:
            _draw_shares(axes[1, 1], drawn[0])
        else:
            _list_conditions(axes[1, 1], pictures)
        title = drawn[0].title if len(drawn) == 1 else f"{len(pictures)} conditions"
        fig.text(
            0.075, 0.955, title, fontweight="bold", fontsize=fitting_size(title, 0.9 * 72 * _PREDICTION_WIDTH_IN, 12)
        )
        words = "line: median; band: 90 % interval; simulated from the distributions of the inputs"
        fig.text(0.075, 0.012, words, color=MUTED, fontsize=8.8)
        fig.align_ylabels(axes[:, 0])
        fig.subplots_adjust(left=0.075, right=0.985, top=0.91, bottom=0.105, hspace=0.3, wspace=0.27)
    return fig


def _draw_curves(axes: np.ndarray, picture: PredictionPicture, colour: str) -> None:
    """Position against time; speed and tension against growth."""
    position, speed, tension = axes[0, 0], axes[0, 1], axes[1, 0]
    table = picture.curve
    y_mm, along = 1e3 * table["lead_position_m"].to_numpy(), table["y_over_L"].to_numpy()
    early, middle, late = (
        1e3 * table[name].to_numpy(dtype=float) for name in ("time_low_90_s", "time_s", "time_high_90_s")
    )
    last = _longest(early, middle, late)
    ends = [np.where(np.isfinite(t), t, last) for t in (early, late)]
    position.fill_betweenx(y_mm, *ends, color=colour, alpha=0.18, lw=0)
    come = np.isfinite(middle)
    position.plot(middle[come], y_mm[come], color=colour)
    position.set_xlim(0.0, max(last, position.get_xlim()[1] if position.lines[1:] else 0.0))
    for ax, name, unit in ((speed, "lead_velocity", "m_s"), (tension, "tension", "N")):
        low, high = (table[f"{name}_{side}_90_{unit}"].to_numpy(dtype=float) for side in ("low", "high"))
        ax.fill_between(along, low, high, color=colour, alpha=0.18, lw=0)
        ax.plot(along, table[f"{name}_{unit}"], color=colour)


def _longest(*times_ms: np.ndarray) -> float:
    """End of the time axis: that of the slow limit, but at most four times that of the median."""
    ends = [float(np.max(t[np.isfinite(t)], initial=0.0)) for t in times_ms]
    return min(ends[2], 4 * ends[1]) if ends[1] > 0 else ends[0] or 1.0


def _label_prediction(axes: np.ndarray, drawn: Sequence[PredictionPicture], at_fraction: float) -> None:
    position, speed, tension = axes[0, 0], axes[0, 1], axes[1, 0]
    position.set_xlabel("time since release (ms)")
    position.set_ylabel("leading edge y (mm)")
    position.set_ylim(bottom=0.0)
    for ax, label in ((speed, "speed of the leading edge ẏ (m/s)"), (tension, "tension of the tail (N)")):
        ax.set_xlabel("growth y/L")
        ax.set_ylabel(label)
        ax.set_xlim(0.0, 1.0)
        ax.axvline(at_fraction, color=MUTED, lw=0.9, ls=(0, (4, 2)))
    low, high = speed.get_ylim()
    speed.set_ylim(max(low, 0.0), high)
    speed.text(at_fraction - 0.015, 0.03, f"y/L = {at_fraction:g}", transform=speed.get_xaxis_transform(), ha="right",
               fontsize=9, color=MUTED)  # fmt: skip
    lows, highs = zip(
        *((p.curve["tension_low_90_N"].min(), p.curve["tension_high_90_N"].max()) for p in drawn), strict=True
    )
    if min(lows) < -_NEGLIGIBLE_COMPRESSION * max(highs):
        tension.axhline(0.0, color=INK, lw=0.8)
        tension.set_title(
            "below 0 the model predicts compression in the tail", fontsize=9.5, fontweight="normal", color=MUTED
        )
    ends = [float(picture.curve["time_s"].replace(np.inf, np.nan).max()) for picture in drawn]
    if max(ends) > _LOG_AXIS_RATIO * min(ends):
        position.set_xscale("log")
        position.set_xlim(left=10.0 * min(ends))
        plain_log_ticks(position, "x")


def _draw_shares(ax: Axes, picture: PredictionPicture) -> None:
    """Bars of the final speed: with all uncertainties, then with each alone."""
    low, median, high = picture.final
    rows = [("all inputs", low, high), *picture.shares]
    for k, (_, start, stop) in enumerate(rows):
        ax.barh(k, stop - start, left=start, height=0.55, color=BLUE, alpha=0.85 if k == 0 else 0.4, lw=0)
    ax.axvline(median, color=INK, lw=1.0)
    ax.set_yticks(range(len(rows)), [_folded(name) for name, _, _ in rows], fontsize=8.8)
    ax.invert_yaxis()
    ax.margins(x=0.06)
    ax.use_sticky_edges = False
    if low > 0 and high > _LOG_AXIS_RATIO * low:
        ax.set_xscale("log")
        plain_log_ticks(ax, "x")
    ax.grid(visible=False, axis="y")
    ax.set_xlabel(f"{picture.final_name} (m/s)")
    ax.set_title("Uncertainty budget", fontsize=10.5)


def _folded(name: str) -> str:
    """Wrap a name at 15 letters; long names of effects are split at underscores."""
    return textwrap.fill(name if len(name) <= 15 else name.replace("_", " "), 15)


def _list_conditions(ax: Axes, pictures: Sequence[PredictionPicture]) -> None:
    """List the condition of each colour, instead of the bars."""
    ax.set_axis_off()
    lines = [(colour, picture.title) for colour, picture in zip(VINE_COLOURS, pictures, strict=False)]
    for k, (colour, words) in enumerate(lines):
        y = 0.97 - 0.155 * k
        ax.plot([0.0, 0.07], [y - 0.025] * 2, color=colour, lw=3, transform=ax.transAxes, clip_on=False)
        ax.text(0.1, y, textwrap.fill(words, 50), transform=ax.transAxes, va="top", fontsize=9.2)
    if len(pictures) > len(lines):
        ax.text(0.1, 0.02, f"and {len(pictures) - len(lines)} more, not drawn", transform=ax.transAxes, color=MUTED)


_EFFECT_WIDTH_IN = 7.2  # Chosen: one panel that fits a page of A4


def draw_effect(name: str, size: str, vine: str, table: pd.DataFrame) -> Figure:
    """Draw position and speed of the leading edge with and without one effect, and the difference."""
    from matplotlib.figure import Figure

    time_ms = 1e3 * table["time_s"].to_numpy()
    with look():
        fig = Figure(figsize=(_EFFECT_WIDTH_IN, 7.0))
        position, speed, gap = fig.subplots(3, 1, sharex=True, height_ratios=(3, 3, 2))
        for axes, key, factor in ((position, "position_m", 1e3), (speed, "velocity_m_s", 1.0)):
            axes.plot(time_ms, factor * table[f"without_{key}"], color=MUTED, lw=2.4, label="without")
            axes.plot(time_ms, factor * table[f"with_{key}"], color=BLUE, label="with")
        difference_mm = 1e3 * table["difference_m"].to_numpy()
        gap.axhline(0.0, color=INK, lw=0.8)
        gap.plot(time_ms, difference_mm, color=VERMILLION)
        gap.fill_between(time_ms, 0.0, difference_mm, color=VERMILLION, alpha=0.15, lw=0)
        speed.set_ylim(*_bulk_limits(table))
        position.set_ylabel("leading edge y (mm)")
        speed.set_ylabel("its speed ẏ (m/s)")
        gap.set_ylabel("difference (mm)")
        gap.set_xlabel("time since release (ms)")
        title = name + (f": {size}" if size else "")
        fig.text(0.12, 0.955, title, fontweight="bold", fontsize=fitting_size(title, 0.52 * 72 * _EFFECT_WIDTH_IN, 11))
        position.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2)
        fig.align_ylabels()
        fig.subplots_adjust(left=0.12, right=0.97, top=0.93, bottom=0.135, hspace=0.14)
        fig.text(0.012, 0.012, textwrap.fill(f"Simulated: {vine}.", 104), color=MUTED, fontsize=8.8, va="bottom")
    return fig


def _bulk_limits(table: pd.DataFrame) -> tuple[float, float]:
    """Limits from 0 to above the 99th percentile, since a jump at the start or a divergence would hide the rest."""
    speeds = np.concatenate([table["without_velocity_m_s"], table["with_velocity_m_s"]])
    top = 1.15 * float(np.quantile(speeds, 0.99))
    return min(0.0, 1.15 * float(np.quantile(speeds, 0.01))), top if top > 0 else 1.0
