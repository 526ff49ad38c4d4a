"""The motion of all trials, of one trial, and of the model beside the measurement, mostly in small panels."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.core.records import UNUSABLE_FLAGS, hand_corrected, with_flag
from vinetrack.core.units import with_error
from vinetrack.figures import style as st
from vinetrack.figures.registry import DASHED_REFUTED, SHOWS_REFUTED, figure

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# ------------------------------------------------------------------------------
# All trials: speed against growth in small panels, replicates superposed, steady windows thick.
#
# The abscissa is growth rather than time, because trials last between milliseconds and seconds but grow equally far.
# With few conditions every condition has a panel with its own speed axis, since steady speed rises about as P^2.7; with
# more, every vine has one on a shared logarithmic axis, with trials coloured by pressure.


@figure("overview", "damping", "All trials at a glance", data="trials.csv")
def draw_overview(trials: pd.DataFrame, kinematics: Mapping[str, pd.DataFrame]) -> Figure | None:
    """Speed of the leading edge against growth, replicates superposed. Thick: the steady window of the gated rule."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    max_panels = 120  # Chosen: twelve rows of ten panels; further vines are left out, and the title says so
    shown = trials[trials["status"] != "left_out"]
    tables = {name: kinematics[name] for name in shown["trial"] if len(kinematics.get(name, ())) > 1}
    if not tables:
        return None
    n_points = min(max(12_000 // len(tables), 15), 150)  # 12,000 points in all keep the SVG below a megabyte
    curves = {}
    for name, table in tables.items():
        part = st.thinned(table, n_points)
        curves[name] = part.assign(growth_mm=1e3 * (part["lead_position_m"] - part["lead_position_m"].min()))
    # 60 (chosen): in rows of nine they are 1.2 in wide, the narrowest that has room for its label
    by_condition = shown["condition"].nunique() <= 60
    if by_condition:
        order = {name: i for i, name in enumerate(dict.fromkeys(shown["vine"]))}
        ordered = shown.assign(order=shown["vine"].map(order)).sort_values(["order", "pressure_kPa"], kind="stable")
        groups = ordered.groupby("condition", sort=False)
        panels = [(str(part["condition_label"].iloc[0]), part) for _, part in groups]
    else:
        panels = [(str(vine), part) for vine, part in shown.groupby("vine", sort=False)][:max_panels]
    n_columns = st.page_columns(len(panels), 10)
    font = st.panel_font(n_columns)
    row_in = min(max(0.72 * 11.0 / n_columns, 1.15), 3.6)
    fig = st.new_figure(11.0, math.ceil(len(panels) / n_columns) * row_in + 1.15)
    axes = st.panel_grid(fig, len(panels), n_columns, sharex=True, sharey=not by_condition)
    colours: dict[str, Any] = {}
    if by_condition:
        styles = st.vine_styles(shown["vine"])
        colours = {row.trial: styles[row.vine].colour for row in st.rows(shown)}
    else:
        scale = ScalarMappable(Normalize(shown["pressure_kPa"].min(), shown["pressure_kPa"].max()), "cividis")
        bar = fig.colorbar(scale, ax=fig.axes, fraction=0.02, pad=0.01, aspect=40)
        bar.set_label("pressure (kPa)")
        bar.outline.set_visible(False)
        colours = {row.trial: scale.to_rgba(row.pressure_kPa) for row in st.rows(shown)}
    for ax, (label, part) in zip(axes, panels, strict=True):
        drawn = part[part["trial"].isin(curves)]
        for row in st.rows(drawn):
            curve, colour = curves[row.trial], colours[row.trial]
            ax.plot(curve["growth_mm"], curve["lead_velocity_m_s"], color=colour, lw=0.8, alpha=0.5)
            steady = curve[curve["time_s"].between(row.steady_from_s, row.steady_to_s)]
            if len(steady) > 1:
                at = steady["growth_mm"], steady["lead_velocity_m_s"]
                ax.plot(*at, color=colour, lw=2.2, solid_capstyle="butt")
        words = textwrap.shorten(label, 30, placeholder="…") if font > 8 else label
        st.small_title(ax, words, fontsize=font, pad=3)
        st.corner_text(ax, 0.98, 0.05, f"N = {len(part)}", ha="right", fontsize=font - 1)
        if n_failed := int((part["status"] == "failed").sum()):
            st.corner_text(ax, 0.98, 0.2, f"{n_failed} failed", ha="right", fontsize=font - 1, color=st.VERMILLION)
        st.small_ticks(ax, font - 0.5)
        if by_condition:
            _limit_speed(ax, [curves[name] for name in drawn["trial"]])
    for ax in axes[-n_columns:]:
        ax.tick_params(labelbottom=True)
    axes[0].set_xlim(0, 1.02 * max(float(curve["growth_mm"].max()) for curve in curves.values()))
    if not by_condition:
        _limit_speed(axes[0], list(curves.values()), logarithmic=True)
    what = "one panel per condition, each with its own speed axis" if by_condition else "one panel per vine"
    missing = len(shown) - len(curves)
    title = f"{len(curves)} {'trial' if len(curves) == 1 else 'trials'}, {what}; thick: steady by the gated rule"
    title += f"; {missing} without positions" if missing else ""
    title += f"; the first {max_panels} panels" if len(panels) == max_panels else ""
    st.page_labels(fig, "growth (mm)", "leading-edge speed (m/s)", title)
    return fig


def _limit_speed(ax: Axes, curves: Sequence[pd.DataFrame], logarithmic: bool = False) -> None:
    """Set limits that are robust to outliers: the fastest per cent of points may lie outside the panel."""
    if not curves:
        ax.set_yticks([])
        return
    speeds_m_s = [st.column(curve, "lead_velocity_m_s") for curve in curves]
    speed_m_s = np.concatenate(speeds_m_s)
    moving_m_s = speed_m_s[speed_m_s > 0]
    top = float(np.percentile(moving_m_s, 99)) if moving_m_s.size else 1.0
    if logarithmic and moving_m_s.size:
        medians = [float(np.nanmedian(of_curve)) for of_curve in speeds_m_s]
        ax.set_yscale("log")
        ax.set_ylim(0.5 * min(median for median in medians if median > 0), 1.5 * top)
        st.plain_log_ticks(ax, "y")
    else:
        ax.set_ylim(0, 1.15 * top)


# ------------------------------------------------------------------------------
# One trial: position and speed against time, and the steady window of each rule.
#
# The rules are bars in a strip below the curves, so that overlapping windows are separate, with the result of each as
# text below; their x_ss is drawn across the curve where it was measured.


@st.look()
def draw_trial_motion(
    title: str, track: pd.DataFrame, kinematics: pd.DataFrame, windows: pd.DataFrame, travel_ratio: float = 2.0
) -> Figure | None:
    """Draw one trial."""
    if kinematics.empty:
        return None
    unusable, by_hand = with_flag(track["flag"], *UNUSABLE_FLAGS), hand_corrected(track["flag"])
    counts = f"{len(kinematics)} points"
    counts += f", {unusable.sum()} left out (×)" if unusable.any() else ""
    counts += f", {by_hand.sum()} corrected by hand (○)" if by_hand.any() else ""
    notes = [(st.MUTED, counts), *(line for row in st.rows(windows) for line in _verdict(row))]
    line_in = 0.175  # of 8.8 pt
    text_in, strip_in = line_in * len(notes) + 0.1, 0.24 * max(len(windows), 1)
    height_in = 1.75 + 2.1 + strip_in + text_in + 1.2
    fig = st.new_figure(7.2, height_in, layout=None)
    lead, speed, strip = fig.subplots(3, 1, sharex=True, height_ratios=(1.75, 2.1, strip_in))
    tall_in = 1.75 + 2.1 + strip_in  # and twice 0.12 in between the panels
    bottom, top = (text_in + 0.58) / height_in, (text_in + 0.82 + tall_in) / height_in
    fig.subplots_adjust(left=0.125, right=0.89, bottom=bottom, top=top, hspace=0.36 / tall_in)
    for ax in (lead, speed):
        ax.yaxis.set_label_coords(-0.095, 0.5)
    _draw_position(lead, track, kinematics, unusable, by_hand)
    lead.set_title(title, pad=8, fontsize=st.fitting_size(title, 0.8 * 72 * 7.2, 11))
    _draw_speed(speed, kinematics, windows, travel_ratio)
    _draw_strip(strip, windows)
    # Ticks of the strip in the panels above; tick by tick, matplotlib would take a tenth of the figure.
    low, high = strip.get_xlim()
    ticks = [tick for tick in strip.get_xticks() if low <= tick <= high]
    strip.set_xlim(low, high)
    for ax in (lead, speed):
        ax.xaxis.set_visible(False)
        across = ax.get_xaxis_transform()
        ax.vlines(ticks, 0, 1, color=st.GRID, lw=0.7, zorder=0.5, transform=across)
        style: dict[str, Any] = {"marker": 3, "ms": 3.5, "mew": 0.8, "color": st.INK, "clip_on": False}
        ax.plot(ticks, [0] * len(ticks), ls="none", transform=across, **style)
    for i, (colour, line) in enumerate(notes):
        fig.text(0.012, (text_in - 0.05 - i * line_in) / height_in, line, color=colour, fontsize=8.8, va="top")
    return fig


def _draw_position(
    ax: Axes, track: pd.DataFrame, kinematics: pd.DataFrame, unusable: np.ndarray, by_hand: np.ndarray
) -> None:
    time_s, position_mm = st.column(track, "time_s"), st.column(track, "lead_position_m", 1e3)
    step = max(len(track) // 300, 1)
    ax.plot(time_s[~unusable][::step], position_mm[~unusable][::step], ".", color=st.MUTED, ms=3.5, mew=0)
    if (unusable & np.isfinite(position_mm)).any():
        ax.plot(time_s[unusable], position_mm[unusable], "x", color=st.VERMILLION, ms=4, mew=1)
    if by_hand.any():
        ax.plot(time_s[by_hand], position_mm[by_hand], "o", color=st.GREEN, ms=4, fillstyle="none", mew=1)
    ax.plot(kinematics["time_s"], 1e3 * kinematics["lead_position_m"], "-", color=st.INK, lw=1.1)
    ax.set_ylabel("leading edge (mm)")


def _draw_speed(ax: Axes, kinematics: pd.DataFrame, windows: pd.DataFrame, travel_ratio: float) -> None:
    time_s, speed_m_s = st.column(kinematics, "time_s"), st.column(kinematics, "lead_velocity_m_s")
    two_sigma_m_s = st.column(kinematics, "lead_velocity_sigma_m_s", 2.0)
    st.band(ax, time_s, speed_m_s - two_sigma_m_s, speed_m_s + two_sigma_m_s, st.MUTED, 0.28)
    ax.plot(time_s, speed_m_s, color=st.INK, lw=1.3)
    for row in st.rows(windows):
        if np.isfinite(row.x_ss_m_s):
            level = row.x_ss_m_s / travel_ratio
            style: dict[str, Any] = {"color": st.RULE_COLOURS[row.rule], "ls": "-" if row.accepted else (0, (1.5, 1.2))}
            ax.plot([row.from_s, row.to_s], [level, level], lw=3.2, alpha=0.9, **style)
    ax.set_ylim(*_speed_limits(speed_m_s, two_sigma_m_s))
    ax.set_ylabel("leading edge (m/s)")
    if travel_ratio != 1:
        right = ax.twinx()
        right.set(ylabel="tail (m/s)", ylim=[travel_ratio * limit for limit in ax.get_ylim()])
        right.grid(visible=False)
        right.yaxis.set_label_coords(1.07, 0.5)
        right.spines[["left", "bottom"]].set_visible(False)
        right.spines["right"].set_visible(True)


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


def _draw_strip(ax: Axes, windows: pd.DataFrame) -> None:
    ax.set_xlabel("time (s)")
    ax.set_ylim(len(windows) - 0.4, -0.6)
    st.names_on_axis(ax, "y", ["by hand" if rule == "user" else rule for rule in windows["rule"]], fontsize=9)
    for i, row in enumerate(st.rows(windows)):
        colour = st.RULE_COLOURS[row.rule]
        if np.isfinite(row.from_s) and np.isfinite(row.to_s):
            fill = colour if row.accepted else "none"
            ax.barh(i, row.to_s - row.from_s, left=row.from_s, height=0.56, color=fill, edgecolor=colour, lw=1.3)
        else:
            ax.axhline(i, color=st.GRID, lw=1, ls=":")


def _verdict(row: Any) -> list[tuple[str, str]]:
    """The result of one rule, as coloured lines of text that fit the figure's width."""
    parts = ["accepted" if row.accepted else "rejected"]
    if np.isfinite(row.x_ss_m_s):
        parts.append(f"x_ss {with_error(row.x_ss_m_s, row.x_ss_sigma_m_s)} m/s (tail)")
    if isinstance(row.reason, str) and row.reason:
        parts.append(row.reason)
    sentence = f"{st.RULE_NAMES[row.rule]}: " + ", ".join(parts)
    unbroken = sentence.replace(" %", "\N{NO-BREAK SPACE}%").replace(" m/s", "\N{NO-BREAK SPACE}m/s")
    lines = textwrap.wrap(unbroken, 106, subsequent_indent="    ", max_lines=2)
    return [(st.RULE_COLOURS[row.rule], line) for line in lines]


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
    added = "; dashed: this model, full: with the effects that were added"
    labels = "time since release (ms)", "growth (mm)"
    return _model_panels(comparison, trajectories, _draw_positions, corner, *labels, added)


@figure("model_residuals", "model", "Residuals of the model", data="comparison.csv", if_refuted=SHOWS_REFUTED)
def draw_model_residuals(comparison: pd.DataFrame, trajectories: Mapping[str, pd.DataFrame]) -> Figure | None:
    """Measurement minus model against the growth, one panel per condition, one line per trial, with the band of one
    standard deviation of the replicates. With a complete model the lines cross zero within the band; a bend that
    all trials of a panel share, or that grows with pressure, shows a missing effect.
    """
    corner = (0.98, 0.03, "right", "bottom")  # where residuals get extra room
    labels = "growth (mm)", "measurement − model (mm)"
    return _model_panels(comparison, trajectories, _draw_residuals, corner, *labels, "")


def _model_panels(
    comparison: pd.DataFrame, trajectories: Mapping[str, pd.DataFrame],
    draw: Callable[[Axes, list[pd.DataFrame], str], None], corner: tuple[float, float, str, str], x_label: str,
    y_label: str, if_added: str,
) -> Figure | None:  # fmt: skip
    known = [row for row in st.rows(comparison) if row.condition in trajectories]
    farthest = sorted(known, key=lambda row: -np.nan_to_num(row.rms_position_m))[:60]  # in rows of eight, 1.4 in wide
    shown = [row for row in known if row in farthest]
    if not shown:
        return None
    n_columns = st.page_columns(len(shown), 8)
    n_trials = sum(trajectories[row.condition]["trial"].nunique() for row in shown)
    n_points = min(max(12_000 // n_trials, 25), 150)
    styles = st.vine_styles([row.vine for row in shown])
    font, panel_in, (x, y, ha, va) = st.panel_font(n_columns), min(11.0 / n_columns, 6.0), corner
    row_in = min(max(0.78 * panel_in, 1.35), 3.6)
    fig = st.new_figure(n_columns * panel_in, math.ceil(len(shown) / n_columns) * row_in + 0.95)
    for ax, row in zip(st.panel_grid(fig, len(shown), n_columns), shown, strict=True):
        parts = _moving(trajectories[row.condition], n_points)
        draw(ax, parts, styles[row.vine].colour)
        label = str(row.condition_label)
        st.small_title(ax, label, fontsize=st.fitting_size(label, 72 * (panel_in - 0.45), font, bold=False), pad=3)
        times = f" ({row.ratio:.2g}×)" if math.isfinite(row.ratio) else ""
        words = f"rms {1e3 * row.rms_position_m:.2g} mm{times}\nN = {len(parts)}"
        st.corner_text(ax, x, y, words, ha=ha, va=va, fontsize=font - 1.5)
        st.small_ticks(ax, font - 0.5)
    title = f"{str(shown[0].model).replace('+', ' + ')}; {n_trials} trials"
    title += if_added if "model_after_m" in trajectories[shown[0].condition] else ""
    if len(known) > len(shown):
        title += f"; the {len(shown)} of {len(known)} conditions with the largest error"
    st.page_labels(fig, x_label, y_label, textwrap.fill(title, int(n_columns * panel_in * 11)))
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
