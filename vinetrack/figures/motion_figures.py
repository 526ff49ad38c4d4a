"""The motion of all trials, of one trial, and of the model beside the measurement, mostly in small panels."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.core.records import UNUSABLE_FLAGS, with_flag
from vinetrack.figures import style as st
from vinetrack.figures.registry import DASHED_REFUTED, SHOWS_REFUTED, figure

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_MOST_PANELS = 60  # Chosen: in rows of eight they are 1.4 in wide, the narrowest that has room for its label


def _small_panels(labels: Sequence[str], x_label: str, y_label: str, title: str) -> tuple[Figure, list[Axes], float]:
    """A page of small panels, about 1.3 times as high as wide, each with its label; the panels and their font size."""
    n = len(labels)
    n_columns = min(math.ceil(math.sqrt(1.3 * n)), 8) if n > 3 else n
    font = 10.5 if n_columns <= 4 else 9.0 if n_columns <= 6 else 7.8
    panel_in = min(11.0 / n_columns, 6.0)
    row_in = min(max(0.78 * panel_in, 1.35), 3.6)
    fig = st.new_figure(n_columns * panel_in, math.ceil(n / n_columns) * row_in + 0.95)
    panels = st.panel_grid(fig, n, n_columns)
    for ax, label in zip(panels, labels, strict=True):
        st.small_title(ax, label, fontsize=st.fitting_size(label, 72 * (panel_in - 0.45), font, bold=False), pad=3)
        ax.tick_params(labelsize=font - 0.5)
        ax.locator_params(nbins=4)
    fig.supxlabel(x_label, fontsize=11)
    fig.supylabel(y_label, fontsize=11)
    fig.suptitle(textwrap.fill(title, int(n_columns * panel_in * 11)), fontsize=11, x=0.01, ha="left")
    return fig, panels, font


def _points_each(n_trials: int) -> int:
    """Points of each curve: 12,000 in all keep the SVG below a megabyte."""
    return min(max(12_000 // n_trials, 25), 150)


@figure("overview", "damping", "All trials at a glance", data="trials.csv")
def draw_overview(trials: pd.DataFrame, kinematics: Mapping[str, pd.DataFrame]) -> Figure | None:
    """Speed of the leading edge against growth, one panel per condition in the order of the sheet, each with its own
    speed axis; replicates are superposed. Thick: the steady window of the gated rule. The fastest per cent of points
    may lie outside a panel.
    """
    drawn = trials[[len(kinematics.get(name, ())) > 1 for name in trials["trial"]]]
    if drawn.empty:
        return None
    conditions = list(drawn.groupby("condition", sort=False))
    shown = conditions[:_MOST_PANELS]
    styles, n_points = st.vine_styles(trials["vine"]), _points_each(len(drawn))
    title = f"{len(drawn)} of {len(trials)} trials; thick: steady by the gated rule"
    title += f"; the first {len(shown)} of {len(conditions)} conditions" if len(conditions) > len(shown) else ""
    labels = [str(part["condition_label"].iloc[0]) for _, part in shown]
    fig, panels, font = _small_panels(labels, "growth (mm)", "leading-edge speed (m/s)", title)
    for ax, (_, part) in zip(panels, shown, strict=True):
        fastest_m_s = 0.0
        for row in st.rows(part):
            curve, colour = st.thinned(kinematics[row.trial], n_points), styles[row.vine].colour
            grown_mm, speed_m_s = st.column(curve, "lead_position_m", 1e3), st.column(curve, "lead_velocity_m_s")
            grown_mm = grown_mm - grown_mm.min()
            steady = curve["time_s"].between(row.steady_from_s, row.steady_to_s).to_numpy()
            ax.plot(grown_mm, speed_m_s, color=colour, lw=0.8, alpha=0.5)
            ax.plot(grown_mm[steady], speed_m_s[steady], color=colour, lw=2.2, solid_capstyle="butt")
            fastest_m_s = max(fastest_m_s, float(np.percentile(speed_m_s, 99)))
        ax.set(xlim=(0, None), ylim=(0, 1.15 * fastest_m_s or None))
        st.corner_text(ax, 0.98, 0.05, f"N = {len(part)}", ha="right", fontsize=font - 1)
    return fig


# ------------------------------------------------------------------------------
# One trial: position and speed against time, and the steady window of each rule.
#
# The rules are bars in a strip below the curves, so that overlapping windows are separate, hollow where a rule rejects
# its window; their x_ss is drawn across the curve where it was measured.


@st.look()
def draw_trial_motion(
    title: str, track: pd.DataFrame, kinematics: pd.DataFrame, windows: pd.DataFrame, travel_ratio: float = 2.0
) -> Figure | None:
    """Draw one trial."""
    if kinematics.empty:
        return None
    unusable, by_hand = with_flag(track["flag"], *UNUSABLE_FLAGS), with_flag(track["flag"], "corrected")
    counts = f"{len(kinematics)} points"
    counts += f", {unusable.sum()} left out (×)" if unusable.any() else ""
    counts += f", {by_hand.sum()} corrected by hand (○)" if by_hand.any() else ""
    strip_from, strip_in = 0.86, 0.24 * max(len(windows), 1)
    speed_from = strip_from + strip_in + 0.12
    lead_from = speed_from + 2.1 + 0.12
    fig, sheet = st.new_sheet(7.2, lead_from + 1.75 + 0.38)
    time_s, position_mm = st.column(track, "time_s"), st.column(track, "lead_position_m", 1e3)
    known = np.isfinite(position_mm)
    speed_m_s, two_sigma_m_s = (
        st.column(kinematics, name, factor)
        for name, factor in (("lead_velocity_m_s", 1.0), ("lead_velocity_sigma_m_s", 2.0))
    )
    over = _with_margin(time_s[known])
    lead = st.Panel(sheet, (0.9, lead_from, 5.5, 1.75), over, _with_margin(position_mm[known]))
    speed = st.Panel(sheet, (0.9, speed_from, 5.5, 2.1), over, _speed_limits(speed_m_s, two_sigma_m_s))
    strip = st.Panel(sheet, (0.9, strip_from, 5.5, strip_in), over, (len(windows) - 0.4, -0.6))

    step = max(len(track) // 300, 1)
    lead.plot(time_s[~unusable][::step], position_mm[~unusable][::step], ".", color=st.MUTED, ms=3.5, mew=0)
    lead.plot(time_s[unusable], position_mm[unusable], "x", color=st.VERMILLION, ms=4, mew=1)
    lead.plot(time_s[by_hand], position_mm[by_hand], "o", color=st.GREEN, ms=4, fillstyle="none", mew=1)
    moving_s = st.column(kinematics, "time_s")
    lead.plot(moving_s, st.column(kinematics, "lead_position_m", 1e3), color=st.INK, lw=1.1)
    speed.fill(moving_s, speed_m_s - two_sigma_m_s, speed_m_s + two_sigma_m_s, color=st.MUTED, alpha=0.28, lw=0)
    speed.plot(moving_s, speed_m_s, color=st.INK, lw=1.3)
    for i, row in enumerate(st.rows(windows)):
        colour, ends_s = st.RULE_COLOURS[row.rule], [row.from_s, row.to_s]
        if np.isfinite(row.x_ss_m_s):
            dashes: Any = "-" if row.accepted else (0, (1.5, 1.2))
            speed.plot(ends_s, [row.x_ss_m_s / travel_ratio] * 2, color=colour, lw=3.2, alpha=0.9, ls=dashes)
        if np.isfinite(ends_s).all():
            fill = colour if row.accepted else "none"
            strip.fill(ends_s, i - 0.28, i + 0.28, facecolor=fill, edgecolor=colour, lw=1.3)
        else:
            strip.plot(over, [i, i], color=st.GRID, lw=1, ls=":")
        name = "by hand" if row.rule == "user" else row.rule
        strip.write(over[0], i, name, (-3.5, 0), ha="right", va="center", fontsize=9)

    lead.scale("left", "leading edge (mm)")
    speed.scale("left", "leading edge (m/s)")
    if travel_ratio != 1:
        speed.scale("right", "tail (m/s)", travel_ratio)
    for panel in (lead, speed):
        panel.scale("bottom", numbered=False)
    strip.scale("bottom", "time (s)")
    lead.write(over[0], lead.y[1], title, (0, 8), fontweight="bold", fontsize=st.fitting_size(title, 415, 11))
    sheet.text(0.09, 0.22, counts, color=st.MUTED, fontsize=8.8, va="top")
    return fig


def _with_margin(values: np.ndarray) -> tuple[float, float]:
    low, high = float(values.min()), float(values.max())
    margin = 0.05 * (high - low) or 1.0
    return low - margin, high + margin


def _speed_limits(speed_m_s: np.ndarray, half_band_m_s: np.ndarray) -> tuple[float, float]:
    """Limits that contain every speed, and its band unless that would shrink the curve below half the axes."""
    finite = speed_m_s[np.isfinite(speed_m_s)]
    if not finite.size:
        return 0.0, 1.0
    low, high = min(float(finite.min()), 0.0), max(float(finite.max()), 0.0)
    span = (high - low) or 1.0
    band_low = float(np.nanmin(speed_m_s - half_band_m_s, initial=low))
    band_high = float(np.nanmax(speed_m_s + half_band_m_s, initial=high))
    low, high = max(band_low, low - 0.5 * span), min(band_high, high + 0.5 * span)
    return low - 0.04 * span * (low < 0), high + 0.06 * span


# ------------------------------------------------------------------------------
# Model and measurement, one small panel per condition: positions against time, or residuals against growth.


@figure("model_comparison", "model", "Model and measurement", data="curves", if_refuted=DASHED_REFUTED)
def draw_model_comparison(comparison: pd.DataFrame, trajectories: Mapping[str, pd.DataFrame]) -> Figure | None:
    """Position of the leading edge since release, one panel per condition: every replicate (thin lines), the band
    of one standard deviation around their mean, and the model in use (dashed; full: with the added effects).
    Release and origin are fitted for each trial; pressure and B are those of the fit. Each panel states the root
    mean square of model minus measurement, and in brackets its ratio to the replicate scatter.
    """
    corner = (0.03, 0.97, "left", "top")  # which the curve of growth leaves empty
    labels = "time since release (ms)", "growth (mm)"
    return _model_panels(comparison, trajectories, _draw_positions, corner, *labels)


@figure("model_residuals", "model", "Residuals of the model", data="comparison.csv", if_refuted=SHOWS_REFUTED)
def draw_model_residuals(comparison: pd.DataFrame, trajectories: Mapping[str, pd.DataFrame]) -> Figure | None:
    """Measurement minus model against the growth, one panel per condition, one line per trial, with the band of one
    standard deviation of the replicates. With a complete model the lines cross zero within the band; a bend that
    all trials of a panel share, or that grows with pressure, shows a missing effect.
    """
    corner = (0.98, 0.03, "right", "bottom")  # where residuals get extra room
    labels = "growth (mm)", "measurement − model (mm)"
    return _model_panels(comparison, trajectories, _draw_residuals, corner, *labels)


def _model_panels(
    comparison: pd.DataFrame, trajectories: Mapping[str, pd.DataFrame],
    draw: Callable[[Axes, list[pd.DataFrame], str], None], corner: tuple[float, float, str, str], x_label: str,
    y_label: str,
) -> Figure | None:  # fmt: skip
    known = comparison[comparison["condition"].isin(list(trajectories))]
    farthest = known["rms_position_m"].fillna(0.0).sort_values(ascending=False, kind="stable").index[:_MOST_PANELS]
    shown = list(st.rows(known[known.index.isin(farthest)]))
    if not shown:
        return None
    n_trials = sum(trajectories[row.condition]["trial"].nunique() for row in shown)
    styles, (x, y, ha, va) = st.vine_styles([row.vine for row in shown]), corner
    title = f"{str(shown[0].model).replace('+', ' + ')}; {n_trials} trials"
    if len(known) > len(shown):
        title += f"; the {len(shown)} of {len(known)} conditions with the largest error"
    fig, panels, font = _small_panels([str(row.condition_label) for row in shown], x_label, y_label, title)
    for ax, row in zip(panels, shown, strict=True):
        parts = _moving(trajectories[row.condition], _points_each(n_trials))
        draw(ax, parts, styles[row.vine].colour)
        times = f" ({row.ratio:.2g}×)" if math.isfinite(row.ratio) else ""
        words = f"rms {1e3 * row.rms_position_m:.2g} mm{times}\nN = {len(parts)}"
        st.corner_text(ax, x, y, words, ha=ha, va=va, fontsize=font - 1.5)
    return fig


def _moving(table: pd.DataFrame, n_points: int) -> list[pd.DataFrame]:
    """Each trial from shortly before model or measurement moves, thinned for a small panel."""
    parts = []
    for _, part in table.groupby("trial", sort=False):
        time_s, growth_m = st.column(part, "time_s"), st.column(part, "lead_position_m")
        begun = growth_m >= growth_m[0] + 0.01 * (np.max(growth_m) - growth_m[0])
        first_s = min(0.0, float(np.min(time_s[begun])))
        parts.append(st.thinned(part[time_s >= first_s - 0.05 * (time_s[-1] - first_s)], n_points))
    return parts


def _longest(parts: list[pd.DataFrame]) -> pd.DataFrame:
    return max(parts, key=lambda part: float(part["time_s"].iloc[-1]))


def _draw_positions(ax: Axes, parts: list[pd.DataFrame], colour: str) -> None:
    longest = _longest(parts)
    time_ms = st.column(longest, "time_s", 1e3)
    mean_mm, sigma_mm = st.column(longest, "replicates_mean_m", 1e3), st.column(longest, "replicates_sigma_m", 1e3)
    st.band(ax, time_ms, mean_mm - sigma_mm, mean_mm + sigma_mm, colour)
    for part in parts:
        ax.plot(1e3 * part["time_s"], 1e3 * part["lead_position_m"], color=colour, lw=0.8)
    ax.plot(time_ms, st.column(longest, "model_position_m", 1e3), color=st.INK, lw=1.5, ls=st.DASHED)
    if "model_after_m" in longest:
        ax.plot(time_ms, st.column(longest, "model_after_m", 1e3), color=st.INK, lw=1.5)


def _draw_residuals(ax: Axes, parts: list[pd.DataFrame], colour: str) -> None:
    by_growth = _longest(parts).sort_values("replicates_mean_m")
    sigma_mm = st.column(by_growth, "replicates_sigma_m", 1e3)
    st.band(ax, st.column(by_growth, "replicates_mean_m", 1e3), -sigma_mm, sigma_mm, colour)
    ax.axhline(0, color=st.INK, lw=1.0, ls=st.DASHED)
    for part in parts:
        residual_mm = 1e3 * (part["lead_position_m"] - part["model_position_m"])
        ax.plot(1e3 * part["lead_position_m"], residual_mm, color=colour, lw=0.9)
    low, high = ax.get_ylim()
    ax.set_ylim(low - 0.35 * (high - low), high)  # room for the text below
