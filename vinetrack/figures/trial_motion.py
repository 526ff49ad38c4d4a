"""One trial: position and speed against time, and the steady window of each rule.

The three rules are bars in a strip below the curves, so that overlapping windows are separate, with the result of each
as text below; their x_ss is drawn across the curve where it was measured.
"""

from __future__ import annotations

import textwrap
from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.core.numbers import with_error
from vinetrack.core.records import UNUSABLE_FLAGS, hand_corrected
from vinetrack.figures.panels import fitting_size
from vinetrack.figures.style import GREEN, GRID, INK, MUTED, RULE_COLOURS, RULE_NAMES, VERMILLION, blank, look, rows

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_WIDTH_IN = 7.2  # Chosen: one panel that fits a page of A4

_TEXT_COLUMNS = 106  # Chosen: of 8.8 pt in 7.2 in: a mean character of 4.1 pt makes 126

_LINE_IN = 0.175  # Derived: 8.8 pt · 1.43 spacing / 72 pt

_MAX_DOTS = 600  # Chosen: on 5.5 in, 600 dots of 3.5 pt overlap


def draw_trial_motion(
    title: str, track: pd.DataFrame, kinematics: pd.DataFrame, windows: pd.DataFrame, travel_ratio: float = 2.0
) -> Figure:
    """Draw one trial."""
    from matplotlib.figure import Figure

    if kinematics.empty:
        return blank(f"{title}: no positions to draw.", _WIDTH_IN)
    unusable = _unusable(track)
    by_hand = hand_corrected(track["flag"].fillna(""))
    notes = [
        _counts(len(kinematics), int(unusable.sum()), int(by_hand.sum())),
        *(line for row in rows(windows) for line in _verdict(row)),
    ]
    with look():
        text_in = _LINE_IN * len(notes) + 0.1
        strip_in = 0.24 * max(len(windows), 1)
        heights_in = {"position": 1.75, "speed": 2.1, "strip": strip_in, "text": text_in}
        height_in = sum(heights_in.values()) + 1.2
        fig = Figure(figsize=(_WIDTH_IN, height_in))
        lead, speed, strip = _three_rows(fig, heights_in, height_in)
        _draw_position(lead, track, kinematics, unusable)
        lead.set_title(title, pad=8, fontsize=fitting_size(title, 0.8 * 72 * _WIDTH_IN, 11))
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
