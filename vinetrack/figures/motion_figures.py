"""Model and measurement, one small panel per condition: positions against time, or residuals against growth."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.core.records import UNUSABLE_FLAGS, hand_corrected
from vinetrack.core.units import with_error
from vinetrack.figures.registry import DASHED_REFUTED, SHOWS_REFUTED, figure
from vinetrack.figures.style import (
    DASHED,
    GREEN,
    GRID,
    INK,
    MUTED,
    RULE_COLOURS,
    RULE_NAMES,
    VERMILLION,
    fitting_size,
    look,
    new_figure,
    page_columns,
    panel_font,
    panel_grid,
    plain_log_ticks,
    rows,
    vine_styles,
)

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable
    from matplotlib.figure import Figure

# ------------------------------------------------------------------------------
# All trials: speed against growth in small panels, replicates superposed, steady windows thick.
#
# The abscissa is growth rather than time, because trials last between milliseconds and seconds but grow equally far.
# With
# up to 60 conditions every condition has a panel with its own speed axis, since steady speed rises about as P^2.7; with
# more, every vine has one on a shared logarithmic axis, with trials coloured by pressure.

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


@figure("overview", "damping", "All trials at a glance", data="trials.csv")
def draw_overview(trials: pd.DataFrame, kinematics: Mapping[str, pd.DataFrame]) -> Figure | None:
    """Speed of the leading edge against growth, replicates superposed. Thick: the steady window of the gated rule."""
    shown = trials[trials["status"] != "left_out"]
    drawn = [name for name in shown["trial"] if _has_points(kinematics.get(name))]
    n_points = min(max(_MAX_POINTS_IN_ALL // max(len(drawn), 1), _MIN_POINTS), _MAX_POINTS)
    curves = {name: _curve(kinematics[name], n_points) for name in drawn}
    if not curves:
        return None
    by_condition = shown["condition"].nunique() <= MAX_CONDITION_PANELS
    panels = _panels(shown, by_condition)
    n_columns = page_columns(len(panels), 10)
    n_rows = math.ceil(len(panels) / n_columns)
    panel_in = _WIDTH_IN / n_columns
    font = panel_font(n_columns)
    row_in = min(max(0.72 * panel_in, 1.15), 3.6)
    height_in = n_rows * row_in + 1.15
    fig = new_figure(_WIDTH_IN, height_in)
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


# ------------------------------------------------------------------------------
# One trial: position and speed against time, and the steady window of each rule.
#
# The three rules are bars in a strip below the curves, so that overlapping windows are separate, with the result of
# each
# as text below; their x_ss is drawn across the curve where it was measured.

_TRIAL_MOTION_WIDTH_IN = 7.2  # Chosen: one panel that fits a page of A4

_TEXT_COLUMNS = 106  # Chosen: of 8.8 pt in 7.2 in: a mean character of 4.1 pt makes 126

_LINE_IN = 0.175  # Derived: 8.8 pt · 1.43 spacing / 72 pt

_MAX_DOTS = 300  # Chosen: on 5.5 in, dots of 3.5 pt touch from 113 on


@look()
def draw_trial_motion(
    title: str, track: pd.DataFrame, kinematics: pd.DataFrame, windows: pd.DataFrame, travel_ratio: float = 2.0
) -> Figure | None:
    """Draw one trial."""
    if kinematics.empty:
        return None
    unusable = _unusable(track)
    by_hand = hand_corrected(track["flag"].fillna(""))
    notes = [
        _counts(len(kinematics), int(unusable.sum()), int(by_hand.sum())),
        *(line for row in rows(windows) for line in _verdict(row)),
    ]
    text_in = _LINE_IN * len(notes) + 0.1
    strip_in = 0.24 * max(len(windows), 1)
    heights_in = {"position": 1.75, "speed": 2.1, "strip": strip_in, "text": text_in}
    height_in = sum(heights_in.values()) + 1.2
    fig = new_figure(_TRIAL_MOTION_WIDTH_IN, height_in, layout=None)
    lead, speed, strip = _three_rows(fig, heights_in, height_in)
    _draw_position(lead, track, kinematics, unusable)
    lead.set_title(title, pad=8, fontsize=fitting_size(title, 0.8 * 72 * _TRIAL_MOTION_WIDTH_IN, 11))
    _draw_speed(speed, kinematics, windows, travel_ratio)
    _draw_strip(strip, windows)
    for i, (colour, line) in enumerate(notes):
        fig.text(0.012, (text_in - 0.05 - i * _LINE_IN) / height_in, line, color=colour, fontsize=8.8, va="top")
    return fig


def _three_rows(fig: Figure, heights_in: dict[str, float], height_in: float) -> tuple[Axes, Axes, Axes]:
    left, width, gap = 0.125, 0.765, 0.14
    bottom = heights_in["text"] + 0.58
    strip = fig.add_axes((left, bottom / height_in, width, heights_in["strip"] / height_in))
    bottom += heights_in["strip"] + 0.1
    speed = fig.add_axes((left, bottom / height_in, width, heights_in["speed"] / height_in), sharex=strip)
    bottom += heights_in["speed"] + gap
    lead = fig.add_axes((left, bottom / height_in, width, heights_in["position"] / height_in), sharex=strip)
    for ax in (lead, speed):
        ax.tick_params(labelbottom=False)
        ax.yaxis.set_label_coords(-0.095, 0.5)
    return lead, speed, strip


def _unusable(track: pd.DataFrame) -> np.ndarray:
    """Mask of the rows without a usable position."""
    flags = track["flag"].fillna("").astype(str)
    return flags.map(lambda flag: bool(UNUSABLE_FLAGS.intersection(flag.split(";")))).to_numpy(dtype=bool)


def _counts(n_used: int, n_left: int, n_by_hand: int) -> tuple[str, str]:
    left = f", {n_left} left out (×)" if n_left else ""
    return MUTED, f"{n_used} points{left}" + (f", {n_by_hand} corrected by hand (○)" if n_by_hand else "")


def _draw_position(ax: Axes, track: pd.DataFrame, kinematics: pd.DataFrame, unusable: np.ndarray) -> None:
    position_mm = 1e3 * track["lead_position_m"].to_numpy(dtype=float)
    time_s = track["time_s"].to_numpy(dtype=float)
    step = max(len(track) // _MAX_DOTS, 1)
    ax.plot(time_s[~unusable][::step], position_mm[~unusable][::step], ".", color=MUTED, ms=3.5, mew=0)
    if (unusable & np.isfinite(position_mm)).any():
        ax.plot(time_s[unusable], position_mm[unusable], "x", color=VERMILLION, ms=4, mew=1)
    by_hand = hand_corrected(track["flag"].fillna(""))
    if by_hand.any():
        ax.plot(time_s[by_hand], position_mm[by_hand], "o", color=GREEN, ms=4, fillstyle="none", mew=1)
    ax.plot(kinematics["time_s"], 1e3 * kinematics["lead_position_m"], "-", color=INK, lw=1.1)
    ax.set_ylabel("leading edge (mm)")


def _draw_speed(ax: Axes, kinematics: pd.DataFrame, windows: pd.DataFrame, travel_ratio: float) -> None:
    time_s = kinematics["time_s"].to_numpy(dtype=float)
    speed_m_s = kinematics["lead_velocity_m_s"].to_numpy(dtype=float)
    sigma_m_s = kinematics["lead_velocity_sigma_m_s"].to_numpy(dtype=float)
    ax.fill_between(time_s, speed_m_s - 2 * sigma_m_s, speed_m_s + 2 * sigma_m_s, color=MUTED, alpha=0.28, lw=0)
    ax.plot(time_s, speed_m_s, color=INK, lw=1.3)
    for row in rows(windows):
        if np.isfinite(row.x_ss_m_s):
            level = row.x_ss_m_s / travel_ratio
            style = "-" if row.accepted else (0, (1.5, 1.2))
            ax.plot([row.from_s, row.to_s], [level, level], color=RULE_COLOURS[row.rule], ls=style, lw=3.2, alpha=0.9)
    low, high = _speed_limits(speed_m_s, sigma_m_s)
    ax.set_ylim(low, high)
    ax.set_ylabel("leading edge (m/s)")
    if travel_ratio != 1:

        def to_tail(lead_m_s: Any) -> Any:
            return travel_ratio * lead_m_s

        def to_lead(tail_m_s: Any) -> Any:
            return tail_m_s / travel_ratio

        right = ax.secondary_yaxis("right", functions=(to_tail, to_lead))
        right.set_ylabel("tail (m/s)")
        right.spines["right"].set_visible(True)


def _speed_limits(speed_m_s: np.ndarray, sigma_m_s: np.ndarray) -> tuple[float, float]:
    """Limits that contain every speed, and its 2 σ band unless that would shrink the curve below half the axes."""
    finite = speed_m_s[np.isfinite(speed_m_s)]
    if not finite.size:
        return 0.0, 1.0
    low, high = min(float(finite.min()), 0.0), max(float(finite.max()), 0.0)
    span = (high - low) or 1.0
    band_low = float(np.nanmin(np.where(np.isfinite(sigma_m_s), speed_m_s - 2 * sigma_m_s, low)))
    band_high = float(np.nanmax(np.where(np.isfinite(sigma_m_s), speed_m_s + 2 * sigma_m_s, high)))
    low = max(min(low, band_low), low - 0.5 * span)
    high = min(max(high, band_high), high + 0.5 * span)
    return low - 0.04 * span * (low < 0), high + 0.06 * span


def _draw_strip(ax: Axes, windows: pd.DataFrame) -> None:
    ax.set_xlabel("time (s)")
    ax.set_ylim(len(windows) - 0.4, -0.6)
    ax.set_yticks(range(len(windows)), [{"user": "by hand"}.get(rule, rule) for rule in windows["rule"]], fontsize=9)
    ax.tick_params(axis="y", length=0)
    ax.grid(axis="y", visible=False)
    for i, row in enumerate(rows(windows)):
        colour = RULE_COLOURS[row.rule]
        if np.isfinite(row.from_s) and np.isfinite(row.to_s):
            fill = colour if row.accepted else "none"
            ax.barh(i, row.to_s - row.from_s, left=row.from_s, height=0.56, color=fill, edgecolor=colour, lw=1.3)
        else:
            ax.axhline(i, color=GRID, lw=1, ls=":")


def _verdict(row: Any) -> list[tuple[str, str]]:
    """The result of one rule, as coloured lines of text that fit the figure's width."""
    name, colour = RULE_NAMES[row.rule], RULE_COLOURS[row.rule]
    parts = ["accepted" if row.accepted else "rejected"]
    if np.isfinite(row.x_ss_m_s):
        parts.append(f"x_ss {with_error(row.x_ss_m_s, row.x_ss_sigma_m_s)} m/s (tail)")
    if isinstance(row.reason, str) and row.reason:
        parts.append(row.reason)
    sentence = f"{name}: " + ", ".join(parts)
    unbroken = sentence.replace(" %", "\N{NO-BREAK SPACE}%").replace(" m/s", "\N{NO-BREAK SPACE}m/s")
    lines = textwrap.wrap(unbroken, _TEXT_COLUMNS, subsequent_indent="    ", max_lines=2)
    return [(colour, line) for line in lines]


MODEL_COMPARISON_MAX_PANELS = (
    60  # Chosen: 60 panels in rows of eight are 1.4 in wide, the narrowest that has room for its label
)


_NO_FIT = "The model in use was not fitted: there is no prediction to compare with the measurement."

_Drawing = Callable[["Axes", "pd.DataFrame", str, int], None]


@figure("model_comparison", "model", "Model and measurement", data="curves", if_refuted=DASHED_REFUTED)
def draw_model_comparison(comparison: pd.DataFrame, trajectories: Mapping[str, pd.DataFrame]) -> Figure | None:
    """Position of the leading edge since release, one panel per condition: every replicate (thin lines), the band
    of one standard deviation around their mean, and the model in use (dashed; full: with the added effects).
    Release and origin are fitted for each trial; pressure and B are those of the fit. Each panel states the root
    mean square of model minus measurement, and in brackets its ratio to the replicate scatter.
    """
    return _model_comparison_panels(comparison, trajectories, _draw_positions, "time since release (ms)", "growth (mm)")


@figure("model_residuals", "model", "Residuals of the model", data="comparison.csv", if_refuted=SHOWS_REFUTED)
def draw_model_residuals(comparison: pd.DataFrame, trajectories: Mapping[str, pd.DataFrame]) -> Figure | None:
    """Measurement minus model against the growth, one panel per condition, one line per trial, with the band of one
    standard deviation of the replicates. With a complete model the lines cross zero within the band; a bend that
    all trials of a panel share, or that grows with pressure, shows a missing effect.
    """
    return _model_comparison_panels(
        comparison, trajectories, _draw_residuals, "growth (mm)", "measurement − model (mm)"
    )


def _model_comparison_panels(
    comparison: pd.DataFrame, trajectories: Mapping[str, pd.DataFrame], draw: _Drawing, x_label: str, y_label: str
) -> Figure | None:
    known = [row for row in rows(comparison) if row.condition in trajectories]
    farthest = sorted(known, key=lambda row: -np.nan_to_num(row.rms_position_m))[:MODEL_COMPARISON_MAX_PANELS]
    chosen = {row.condition for row in farthest}
    shown = [row for row in known if row.condition in chosen]
    if not shown:
        return None
    n_columns = page_columns(len(shown), 8)
    n_rows = math.ceil(len(shown) / n_columns)
    n_trials = sum(trajectories[row.condition]["trial"].nunique() for row in shown)
    n_points = min(max(_MAX_POINTS_IN_ALL // n_trials, 25), 150)
    styles = vine_styles([row.vine for row in shown])
    font = panel_font(n_columns)
    panel_in = min(_WIDTH_IN / n_columns, 6.0)
    row_in = min(max(0.78 * panel_in, 1.35), 3.6)
    fig = new_figure(n_columns * panel_in, n_rows * row_in + 0.95)
    for ax, row in zip(panel_grid(fig, len(shown), n_columns), shown, strict=True):
        draw(ax, trajectories[row.condition], styles[row.vine].colour, n_points)
        _label(ax, row, trajectories[row.condition]["trial"].nunique(), font, 72 * (panel_in - 0.45), draw)
    fig.supxlabel(x_label, fontsize=11)
    fig.supylabel(y_label, fontsize=11)
    title = f"{str(shown[0].model).replace('+', ' + ')}; {n_trials} trials"
    if draw is _draw_positions and "model_after_m" in trajectories[shown[0].condition]:
        title += "; dashed: this model, full: with the effects that were added"
    if len(known) > len(shown):
        title += f"; the {len(shown)} of {len(known)} conditions with the largest error"
    wrapped = textwrap.fill(title, int(n_columns * panel_in * 11))
    fig.suptitle(wrapped, fontsize=11, x=0.01, ha="left")
    return fig


def _label(ax: Axes, row: Any, n_trials: int, font: float, width_pt: float, draw: _Drawing) -> None:
    label = str(row.condition_label)
    size = fitting_size(label, width_pt, font, bold=False)
    ax.set_title(label, fontsize=size, fontweight="normal", pad=3)
    times = f" ({row.ratio:.2g}×)" if math.isfinite(row.ratio) else ""
    words = f"rms {1e3 * row.rms_position_m:.2g} mm{times}\nN = {n_trials}"
    # The curve of growth leaves the upper left empty; residuals get extra room below.
    x, y, side, height = (0.98, 0.03, "right", "bottom") if draw is _draw_residuals else (0.03, 0.97, "left", "top")
    ax.text(x, y, words, transform=ax.transAxes, ha=side, va=height, fontsize=font - 1.5, color=MUTED)
    ax.tick_params(labelsize=font - 0.5, colors=INK)
    ax.locator_params(nbins=4)


def _moving(table: pd.DataFrame, n_points: int) -> list[pd.DataFrame]:
    """Each trial from shortly before model or measurement moves, thinned for a small panel."""
    parts = []
    for _, part in table.groupby("trial", sort=False):
        time_s, growth_m = (part[name].to_numpy(dtype=float) for name in ("time_s", "lead_position_m"))
        begun = growth_m >= growth_m[0] + 0.01 * (np.max(growth_m) - growth_m[0])
        first_s = min(0.0, float(np.min(time_s[begun])))
        begin_s = first_s - 0.05 * (time_s[-1] - first_s)
        kept = part[time_s >= begin_s]
        parts.append(kept.iloc[:: max(len(kept) // n_points, 1)])
    return parts


def _longest(parts: list[pd.DataFrame]) -> pd.DataFrame:
    return max(parts, key=lambda part: float(part["time_s"].iloc[-1]))


def _draw_positions(ax: Axes, table: pd.DataFrame, colour: str, n_points: int) -> None:
    parts = _moving(table, n_points)
    longest = _longest(parts)
    time_ms, mean_mm, sigma_mm = (
        1e3 * longest[name].to_numpy(dtype=float) for name in ("time_s", "replicates_mean_m", "replicates_sigma_m")
    )
    ax.fill_between(time_ms, mean_mm - sigma_mm, mean_mm + sigma_mm, color=colour, alpha=0.22, lw=0)
    for part in parts:
        ax.plot(1e3 * part["time_s"], 1e3 * part["lead_position_m"], color=colour, lw=0.8)
    ax.plot(1e3 * longest["time_s"], 1e3 * longest["model_position_m"], color=INK, lw=1.5, ls=DASHED)
    if "model_after_m" in longest:
        ax.plot(1e3 * longest["time_s"], 1e3 * longest["model_after_m"], color=INK, lw=1.5)


def _draw_residuals(ax: Axes, table: pd.DataFrame, colour: str, n_points: int) -> None:
    parts = _moving(table, n_points)
    longest = _longest(parts)
    growth_mm, sigma_mm = (
        1e3 * longest[name].to_numpy(dtype=float) for name in ("replicates_mean_m", "replicates_sigma_m")
    )
    order = np.argsort(growth_mm)
    ax.fill_between(growth_mm[order], -sigma_mm[order], sigma_mm[order], color=colour, alpha=0.22, lw=0)
    ax.axhline(0, color=INK, lw=1.0, ls=DASHED)
    for part in parts:
        residual_mm = 1e3 * (part["lead_position_m"] - part["model_position_m"])
        ax.plot(1e3 * part["lead_position_m"], residual_mm, color=colour, lw=0.9)
    low, high = ax.get_ylim()
    ax.set_ylim(low - 0.35 * (high - low), high)  # room for the text below
