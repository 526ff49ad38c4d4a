"""The motion of one trial, and of the model beside the measurement in small panels."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.core.records import UNUSABLE_FLAGS, with_flag
from vinetrack.figures import style as st
from vinetrack.figures.registry import figure

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


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
    step = max(len(track) // 40, 1)  # chosen: few points, since the curve goes through them, keep the figure small
    counts = f"{len(kinematics)} points" + (f", one in {step} drawn" if step > 1 else "")
    counts += f", {unusable.sum()} left out (×)" if unusable.any() else ""
    counts += f", {by_hand.sum()} corrected by hand (○)" if by_hand.any() else ""
    kinematics = st.thinned(kinematics, 120)
    # From below, in: counts and time scale, a bar for each window, speed, position, title; to the right a second scale
    strip_from, strip_in, speed_in, lead_in, title_in = 0.86, 0.24 * max(len(windows), 1), 2.1, 1.75, 0.38
    left, wide_in, right_in, gap_in = 0.9, 5.5, 0.8, 0.12
    speed_from = strip_from + strip_in + gap_in
    lead_from = speed_from + speed_in + gap_in
    fig, sheet = st.new_sheet(left + wide_in + right_in, lead_from + lead_in + title_in)
    time_s, position_mm = st.column(track, "time_s"), st.column(track, "lead_position_m", 1e3)
    known = np.isfinite(position_mm)
    speed_m_s, two_sigma_m_s = (
        st.column(kinematics, name, factor)
        for name, factor in (("lead_velocity_m_s", 1.0), ("lead_velocity_sigma_m_s", 2.0))
    )
    over = _with_margin(time_s[known])
    lead = st.Panel(sheet, (left, lead_from, wide_in, lead_in), over, _with_margin(position_mm[known]))
    speed = st.Panel(sheet, (left, speed_from, wide_in, speed_in), over, _speed_limits(speed_m_s, two_sigma_m_s))
    strip = st.Panel(sheet, (left, strip_from, wide_in, strip_in), over, (len(windows) - 0.4, -0.6))

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
    lead.write(over[0], lead.y[1], title, (0, 8), fontweight="bold", fontsize=st.fitting_size(title, 72 * wide_in, 11))
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


@figure("model_comparison", "model", "Model and measurement", data="curves")
def draw_model_comparison(comparison: pd.DataFrame, trajectories: Mapping[str, pd.DataFrame]) -> Figure | None:
    """Position of the leading edge since release, one panel per condition: every replicate (thin lines), the band
    of one standard deviation around their mean, and the model in use (dashed), with effects that the diagnosis
    added, if any, full. Release and origin are fitted for each trial; pressure and B are those of the fit. Each
    panel states the root mean square of model minus measurement.
    """
    corner = (0.03, 0.97, "left", "top")  # which the curve of growth leaves empty
    fig, panels = _model_panels(comparison, trajectories, corner, "time since release (ms)", "growth (mm)")
    for ax, parts, longest, colour in panels:
        time_ms, mean_mm, sigma_mm, model_mm = (
            st.column(longest, name, 1e3)
            for name in ("time_s", "replicates_mean_m", "replicates_sigma_m", "model_position_m")
        )
        st.band(ax, time_ms, mean_mm - sigma_mm, mean_mm + sigma_mm, colour)
        for part in parts:
            ax.plot(1e3 * part["time_s"], 1e3 * part["lead_position_m"], color=colour, lw=0.8)
        ax.plot(time_ms, model_mm, color=st.INK, lw=1.5, ls=st.DASHED)
        if "model_after_m" in longest:
            ax.plot(time_ms, st.column(longest, "model_after_m", 1e3), color=st.INK, lw=1.5)
    return fig


@figure("model_residuals", "model", "Residuals of the model", data="comparison.csv")
def draw_model_residuals(comparison: pd.DataFrame, trajectories: Mapping[str, pd.DataFrame]) -> Figure | None:
    """Measurement minus model against the growth, one panel per condition, one line per trial, with the band of one
    standard deviation of the replicates. With a complete model the lines cross zero within the band; a bend that
    all trials of a panel share, or that grows with pressure, shows a missing effect.
    """
    corner = (0.98, 0.03, "right", "bottom")  # where residuals get extra room
    fig, panels = _model_panels(comparison, trajectories, corner, "growth (mm)", "measurement − model (mm)")
    for ax, parts, longest, colour in panels:
        by_growth = longest.sort_values("replicates_mean_m")
        sigma_mm = st.column(by_growth, "replicates_sigma_m", 1e3)
        st.band(ax, st.column(by_growth, "replicates_mean_m", 1e3), -sigma_mm, sigma_mm, colour)
        ax.axhline(0, color=st.INK, lw=1.0, ls=st.DASHED)
        for part in parts:
            residual_mm = 1e3 * (part["lead_position_m"] - part["model_position_m"])
            ax.plot(1e3 * part["lead_position_m"], residual_mm, color=colour, lw=0.9)
        low, high = ax.get_ylim()
        ax.set_ylim(low - 0.35 * (high - low), high)  # room for the words below
    return fig


def _model_panels(
    comparison: pd.DataFrame, trajectories: Mapping[str, pd.DataFrame], corner: tuple[float, float, str, str],
    x_label: str, y_label: str,
) -> tuple[Figure | None, list[tuple[Axes, list[pd.DataFrame], pd.DataFrame, str]]]:  # fmt: skip
    """A page of small panels, and of each its axes, its trials from before they move, the longest, and its colour."""
    known = comparison[comparison["condition"].isin(list(trajectories))]
    # 60: panels at most (chosen: in rows of eight they are 1.4 in wide, the narrowest that has room for its label)
    farthest = known["rms_position_m"].fillna(0.0).sort_values(ascending=False, kind="stable").index[:60]
    shown = list(st.rows(known[known.index.isin(farthest)]))
    if not shown:
        return None, []
    n, n_trials = len(shown), sum(trajectories[row.condition]["trial"].nunique() for row in shown)
    n_points = min(max(1_000 // n_trials, 25), 150)  # 1,000 in all keep the SVG below 50 kB (measured)
    title = f"{str(shown[0].model).replace('+', ' + ')}; {n_trials} trials"
    if len(known) > n:
        title += f"; the {n} of {len(known)} conditions with the largest error"
    # Chosen by eye: a page 11 in wide, panels of at most 6 in and 1.3 times as wide as high, letters that fit them,
    # and below and above them 0.95 in for labels and title, of which an inch holds 11 letters
    n_columns = min(math.ceil(math.sqrt(1.3 * n)), 8) if n > 3 else n
    font = 10.5 if n_columns <= 4 else 9.0 if n_columns <= 6 else 7.8
    panel_in = min(11.0 / n_columns, 6.0)
    row_in = min(max(panel_in / 1.3, 1.35), 3.6)
    fig = st.new_figure(n_columns * panel_in, math.ceil(n / n_columns) * row_in + 0.95)
    styles, (x, y, ha, va), panels = st.vine_styles([row.vine for row in shown]), corner, []
    for ax, row in zip(st.panel_grid(fig, n, n_columns), shown, strict=True):
        label = str(row.condition_label)
        st.small_title(ax, label, fontsize=st.fitting_size(label, 72 * (panel_in - 0.45), font, bold=False), pad=3)
        ax.tick_params(labelsize=font - 0.5)
        ax.locator_params(nbins=4)
        parts = []
        for _, part in trajectories[row.condition].groupby("trial", sort=False):
            time_s, growth_m = st.column(part, "time_s"), st.column(part, "lead_position_m")
            begun = growth_m >= growth_m[0] + 0.01 * (np.max(growth_m) - growth_m[0])
            first_s = min(0.0, float(np.min(time_s[begun])))
            parts.append(st.thinned(part[time_s >= first_s - 0.05 * (time_s[-1] - first_s)], n_points))
        words = f"rms {1e3 * row.rms_position_m:.2g} mm\nN = {len(parts)}"
        ax.text(x, y, words, transform=ax.transAxes, color=st.MUTED, ha=ha, va=va, fontsize=font - 1.5)
        longest = max(parts, key=lambda part: float(part["time_s"].iloc[-1]))
        panels.append((ax, parts, longest, styles[row.vine].colour))
    fig.supxlabel(x_label, fontsize=11)
    fig.supylabel(y_label, fontsize=11)
    fig.suptitle(textwrap.fill(title, int(n_columns * panel_in * 11)), fontsize=11, x=0.01, ha="left")
    return fig, panels
