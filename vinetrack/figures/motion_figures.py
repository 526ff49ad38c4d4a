"""The motion of one trial: its figure, the strip of its recording, frames of its clip; and the model beside the
measurement in small panels.

In a clip the tracked edge crosses the tube and the predicted ones are drawn on both sides of it, that of the earlier
model farther out, so that all remain visible where they agree. A bar above, clear of the controls of video players,
names the edges and states the error of each model, the time, and the factor of the slow motion.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import FLAGS, UNUSABLE_FLAGS, Floats, with_flag
from vinetrack.core.units import pressure_text
from vinetrack.figures import style as st
from vinetrack.figures.registry import figure

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from PIL.Image import Image
    from PIL.ImageFont import FreeTypeFont

    from vinetrack.video.axis import Axis
    from vinetrack.video.track import Tracking


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
    colours = {"gated": st.BLUE, "quasi_steady": st.PURPLE, "paper": st.VERMILLION, "user": st.GREEN}
    for i, row in enumerate(st.rows(windows)):
        colour, ends_s = colours[row.rule], [row.from_s, row.to_s]
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
    low, high = min(float(speed_m_s.min()), 0.0), max(float(speed_m_s.max()), 0.0)
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


# ------------------------------------------------------------------------------
# One recording: its strip through time with the tracked edge, and the edge on the first, middle and last frame.


@st.look()
def draw_strip(title: str, tracking: Tracking, m_per_px: float, pressure_unit: str = "kPa") -> Figure:
    """Draw the strip of one tracked recording."""
    pictures = tracking.pictures
    wide_in = 7.2 / len(pictures) - 0.08
    tall_in = min(max(picture.shape[0] / picture.shape[1] for _, picture in pictures), 2.2) * wide_in
    scaled = np.isfinite(m_per_px)
    below_in = tall_in + (1.35 if scaled else 0.8)
    fig, sheet = st.new_sheet(7.2, below_in + 3.1)
    track, strip = tracking.track, tracking.kymograph
    timed = np.isfinite(track.time_s).all()
    time_ms = 1e3 * track.time_s if timed else np.arange(float(track.time_s.size))  # frames, where they have no time
    half_ms = 0.5 * float(np.median(np.diff(time_ms)))
    shown_ms = time_ms[tracking.strip_rows]
    ends_ms = float(shown_ms[-1]) + half_ms, float(shown_ms[0]) - half_ms
    box = (0.75, below_in, 6.38, 2.6)
    panel = st.Panel(sheet, box, (-0.5, strip.shape[1] - 0.5), ends_ms)
    small = _shrunk(strip, 480, 480)
    dark, light = np.nanpercentile(small, [1, 99])
    panel.picture(small, vmin=dark, vmax=light)
    edge, by_hand = track.edge_px, with_flag(track.flag, "corrected")
    odd = with_flag(track.flag, *set(FLAGS) - {"before_release"}) & ~by_hand
    fine = ~odd & ~by_hand & np.isfinite(edge)
    panel.plot(edge[fine], time_ms[fine], color=st.ORANGE, lw=1.0, label=f"leading edge, N = {fine.sum()}")
    panel.plot(edge[odd], time_ms[odd], "x", color=st.SKY, ms=4, mew=1.1, label=f"flagged, N = {odd.sum()}")
    before = edge if track.tracked_px is None else track.tracked_px
    panel.plot(before[by_hand], time_ms[by_hand], "+", color=st.SKY, ms=5, mew=1.0)
    label = f"corrected by hand, N = {by_hand.sum()}"
    panel.plot(edge[by_hand], time_ms[by_hand], "o", color=st.GREEN, ms=4, fillstyle="none", label=label)
    if track.pressure_Pa is not None:
        most_Pa = float(np.max(track.pressure_Pa))
        over = st.Panel(sheet, box, (0.0, 1.08 * most_Pa), ends_ms)
        label = f"pressure, up to {pressure_text(most_Pa, pressure_unit)}"
        over.plot(track.pressure_Pa, time_ms, color=st.VERMILLION, lw=1.2, label=label)
    panel.scale("left", "time (ms)" if timed else "frame", grid=False)
    panel.scale("bottom", "along the growth axis (px)", grid=False)
    st.legend_above(sheet, 2, bbox_to_anchor=(0.75, below_in + 2.63), bbox_transform=sheet.transData)
    if scaled:
        panel.scale("bottom", "along the growth axis (mm)", 1e3 * m_per_px, grid=False, off_in=0.54)
    panel.write(panel.x[1], panel.y[1], title, (0, 6), ha="right", fontsize=10, color=st.MUTED)
    for i, (frame, picture) in enumerate(pictures):
        height, width = picture.shape
        px_in = min(wide_in / width, tall_in / height)
        size_in = width * px_in, height * px_in
        corner_in = 0.04 + 7.2 * i / len(pictures) + (wide_in - size_in[0]) / 2, 0.05 + (tall_in - size_in[1]) / 2
        shown = st.Panel(sheet, (*corner_in, *size_in), (-0.5, width - 0.5), (height - 0.5, -0.5))
        _draw_frame(shown, tracking, frame, picture)
    return fig


def _shrunk(picture: np.ndarray, height: float, width: float) -> np.ndarray:
    """A picture averaged to at most this size, px. Shape (height, width)."""
    import cv2

    most = min(round(width), picture.shape[1]), min(round(height), picture.shape[0])
    return np.asarray(cv2.resize(picture, most, interpolation=cv2.INTER_AREA))


def _draw_frame(panel: st.Panel, tracking: Tracking, frame: int, picture: np.ndarray) -> None:
    panel.picture(_shrunk(picture, *np.multiply(picture.shape, 360 / max(picture.shape))))
    track, axis = tracking.track, tracking.axis
    if axis.bends:
        panel.plot(*axis.points(np.arange(0.0, axis.length_px, 3.0)).T, color=st.SKY, lw=0.8, ls=":")
    edge = float(track.edge_px[frame]) if frame < track.edge_px.size else np.nan
    if np.isfinite(edge):
        half = 0.75 * axis.width_px if np.isfinite(axis.width_px) else 0.25 * min(picture.shape)
        ends = np.array([axis.points(np.array(edge), across) for across in (-half, half)])
        unusable = bool(UNUSABLE_FLAGS.intersection(str(track.flag[frame]).split(";")))
        panel.plot(*ends.T, color=st.SKY if unusable else st.VERMILLION, lw=1.8)
    at = f", {1e3 * track.time_s[frame]:.1f} ms" if np.isfinite(track.time_s[frame]) else ""
    panel.write(-0.5, -0.5, f"frame {frame}{at}", (0, 6), fontsize=9)


# ------------------------------------------------------------------------------
# Frames of a clip.

TRACKED = "#F0E442"  # yellow of Okabe and Ito: with vermillion and sky everyone tells it apart on any grey


@dataclass(frozen=True)
class Edge:
    """One edge in a clip: its name, its colour, and its position along the axis in every frame, px (NaN: none).
    `off_mm` is its distance ahead of the tracked edge in every frame, None for the tracked edge itself. The line of an
    edge that was seen crosses the tube; that of a model stands on both sides of it, to `reach` radii from the axis.
    """

    name: str
    colour: str
    along_px: Floats
    off_mm: Floats | None = None
    reach: float = 0.0


@dataclass(frozen=True)
class ClipView:
    """What all frames of a clip have in common: edges, size of the recording, scale along the axis, slow motion."""

    title: str
    axis: Axis
    edges: list[Edge]
    tube_px: float
    size_px: tuple[int, int]
    mm_per_px: float
    slowed: float
    width_px: int = 960

    @property
    def zoom(self) -> float:
        """Pixels of the clip per pixel of the recording, at most 2: a larger zoom only shows single pixels."""
        return min(self.width_px / self.size_px[0], 2.0)

    @property
    def picture_px(self) -> tuple[int, int]:
        """Width and height of the picture in the clip, both even."""
        return _even(self.zoom * self.size_px[0]), _even(self.zoom * self.size_px[1])

    @property
    def line_px(self) -> int:
        """Height of the letters."""
        return max(round(self.picture_px[0] / 48), 11)

    def row_y(self, row: int) -> float:
        """Height of the middle of a line of text in the bar."""
        return (1.1 + 1.35 * row) * self.line_px

    def at(self, along_px: Any, across_px: float = 0.0) -> Any:
        """Places of the clip along the axis; pixel centres are at integers in the recording, at halves in the clip."""
        return (self.axis.points(along_px, across_px) + 0.5) * self.zoom - 0.5

    @cached_property
    def bar(self) -> Image:
        """The bar above the picture with what is the same in every frame: names of the edges, title."""
        from PIL import Image, ImageDraw

        width, line_px = self.picture_px[0], self.line_px
        bar = Image.new("RGB", (width, _even(1.35 * line_px * max(len(self.edges), 2) + 0.8 * line_px)), st.INK)
        pen = ImageDraw.Draw(bar)
        for i, edge in enumerate(self.edges):
            y, font = self.row_y(i), _font(line_px, edge.name, 0.42 * width)
            pen.line([(line_px, y), (2.6 * line_px, y)], fill=edge.colour, width=max(line_px // 4, 3))
            pen.text((3.2 * line_px, y), edge.name, font=font, fill=st.PAPER, anchor="lm")
        font = _font(line_px, self.title, 0.3 * width)
        pen.text((width - line_px, self.row_y(0)), self.title, font=font, fill=st.PAPER, anchor="rm")
        return bar

    @cached_property
    def scale_bar(self) -> Image:
        """A scale bar of a round length, about a sixth of the picture, for its lower left corner."""
        from PIL import Image, ImageDraw

        width, height, thick = self.picture_px[0], 3 * self.line_px, max(self.line_px // 6, 2)
        bar = Image.new("RGBA", (width, height))
        wanted_mm = width / 6 / self.zoom * self.mm_per_px
        if not 0 < wanted_mm < math.inf:
            return bar.crop((0, 0, 1, height))
        decade = 10.0 ** math.floor(math.log10(wanted_mm))
        length_mm = max(step * decade for step in (1, 2, 5) if step * decade <= wanted_mm)
        left, bottom = self.line_px, height - self.line_px
        right, pen = left + length_mm / self.mm_per_px * self.zoom, ImageDraw.Draw(bar)
        pen.rectangle((left - 1, bottom - thick - 1, right + 1, bottom + 1), fill="black")
        pen.rectangle((left, bottom - thick, right, bottom), fill="white")
        style: dict[str, Any] = {"fill": "white", "anchor": "ls", "stroke_width": 2, "stroke_fill": "black"}
        pen.text((left, bottom - thick - 3), f"{length_mm:g} mm", font=_font(self.line_px), **style)
        return bar.crop((0, 0, width // 2, height))


def _even(value: float) -> int:
    return max(2 * round(value / 2), 2)


def compose(view: ClipView, picture: NDArray[Any], frame: int, time_ms: float) -> NDArray[np.uint8]:
    """Draw one frame of the clip, RGB, with even height and width. Shape (height, width, 3)."""
    from PIL import Image, ImageDraw

    width, height = view.picture_px
    small = Image.fromarray(picture).resize((width, height), Image.Resampling.BILINEAR).convert("RGB")
    pen = ImageDraw.Draw(small)
    if view.axis.bends:  # a straight axis is obvious
        pen.line([tuple(place) for place in view.at(np.arange(0.0, view.axis.length_px, 3.0))], fill=st.MUTED, width=1)
    thick = max(round(width / 320), 3)
    for edge in sorted(view.edges, key=lambda edge: -edge.reach):
        along = float(edge.along_px[frame])
        spans = ((0.85, edge.reach), (-0.85, -edge.reach)) if edge.reach else ((-1.0, 1.0),)
        for span in spans if math.isfinite(along) else ():
            line = [tuple(view.at(np.array(along), across * 0.5 * view.tube_px)) for across in span]
            pen.line(line, fill="black", width=thick + 2)
            pen.line(line, fill=edge.colour, width=thick)
    small.paste(view.scale_bar, (0, height - view.scale_bar.height), view.scale_bar)
    whole = Image.new("RGB", (width, height + view.bar.height))
    whole.paste(view.bar)
    whole.paste(small, (0, view.bar.height))
    pen, font = ImageDraw.Draw(whole), _font(view.line_px)
    for i, edge in enumerate(view.edges):
        if edge.off_mm is not None and math.isfinite(edge.off_mm[frame]):
            words = f"{st.with_minus(edge.off_mm[frame], '+.1f')} mm"
            pen.text((0.6 * width, view.row_y(i)), words, font=font, fill=st.PAPER, anchor="rm")
    words = f"frame {frame}"
    if math.isfinite(time_ms):
        before = " (before release)" if time_ms < 0 else ""
        words = f"{st.with_minus(time_ms, '.1f')} ms{before}, {view.slowed:.3g} times slower"
    pen.text((width - view.line_px, view.row_y(1)), words, font=font, fill=st.GRID, anchor="rm")
    return np.asarray(whole)


@lru_cache(maxsize=8)
def _font(size_px: float, words: str = "", room_px: float = math.inf) -> FreeTypeFont:
    """Letters of this height, or smaller ones in which the words fit the room."""
    from matplotlib import get_data_path
    from PIL import ImageFont

    size_px = st.fitting_size(words, room_px, size_px, bold=False)
    return ImageFont.truetype(f"{get_data_path()}/fonts/ttf/DejaVuSans.ttf", size_px)


def levels(picture: NDArray[Any], low: float, high: float) -> NDArray[np.uint8]:
    """Return grey levels, shape (height, width), stretched so that `low` is black and `high` white."""
    stretched = (picture.astype(np.float32) - low) * (255.0 / max(high - low, 1e-9))
    return np.clip(np.round(stretched), 0, 255).astype(np.uint8)
