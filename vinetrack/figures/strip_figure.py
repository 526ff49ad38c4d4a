"""One recording: its strip through time with the tracked edge, and the edge on the first, middle and last frame."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.core.records import UNUSABLE_FLAGS, hand_corrected
from vinetrack.figures.panels import legend_above
from vinetrack.figures.style import GREEN, INK, MUTED, ORANGE, SKY, VERMILLION, look

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from vinetrack.video.track import Tracking

MAX_STRIP_PX = 480  # Pixels per side of the strip

_FRAME_PX = 320  # Pixels per side of a frame; chosen: frames are a third as wide as the strip, 133 pixels per inch

_IGNORED_FLAGS = frozenset({"before_release"})


def draw_strip(title: str, tracking: Tracking, m_per_px: float) -> Figure:
    """Draw the strip of one tracked recording."""
    from matplotlib.figure import Figure

    with look():
        aspect = min(max(picture.shape[0] / picture.shape[1] for _, picture in tracking.pictures), 2.2)
        pictures_in = 7.2 / len(tracking.pictures) * aspect + 0.35
        fig = Figure(figsize=(7.2, 3.9 + pictures_in), layout="constrained")
        above, below = np.asarray(fig.subfigures(2, 1, height_ratios=[3.9, pictures_in]))
        above.patch.set_alpha(0)
        below.patch.set_alpha(0)
        ax = above.add_subplot()
        _draw_kymograph(ax, title, tracking, m_per_px)
        frames = below.subplots(1, len(tracking.pictures), squeeze=False)[0]
        for axes, (frame, picture) in zip(frames, tracking.pictures, strict=True):
            _draw_frame(axes, tracking, frame, picture)
    return fig


def _draw_kymograph(ax: Axes, title: str, tracking: Tracking, m_per_px: float) -> None:
    track, strip = tracking.track, tracking.kymograph
    small = shrunk(strip, MAX_STRIP_PX)
    time_ms, down = _time_axis(tracking)
    dark, light = np.nanpercentile(small, [1, 99])
    half_ms = 0.5 * float(np.median(np.diff(time_ms)))
    shown_ms = time_ms[tracking.strip_rows]
    extent = (-0.5, strip.shape[1] - 0.5, float(shown_ms[-1]) + half_ms, float(shown_ms[0]) - half_ms)
    ax.imshow(small, aspect="auto", extent=extent, cmap="gray", vmin=dark, vmax=light, interpolation="none")
    edge, by_hand = track.edge_px, hand_corrected(track.flag)
    odd = flagged(track.flag) & ~by_hand
    fine = ~odd & ~by_hand & np.isfinite(edge)
    ax.plot(edge[fine], time_ms[fine], color=ORANGE, linewidth=1.0, label=f"leading edge, N = {int(fine.sum())}")
    if odd.any():
        shown = odd & np.isfinite(edge)
        label = f"flagged, N = {int(odd.sum())}"
        ax.plot(edge[shown], time_ms[shown], "x", color=SKY, markersize=4, markeredgewidth=1.1, label=label)
    if by_hand.any():
        before = edge if track.tracked_px is None else track.tracked_px
        ax.plot(before[by_hand], time_ms[by_hand], "+", color=SKY, markersize=5, markeredgewidth=1.0)
        label = f"corrected by hand, N = {int(by_hand.sum())}"
        ax.plot(edge[by_hand], time_ms[by_hand], "o", color=GREEN, markersize=4, fillstyle="none", label=label)
    ax.set(xlabel="along the growth axis (px)", ylabel=down)
    ax.grid(visible=False)

    def in_mm(px: Any) -> Any:
        return 1e3 * m_per_px * px

    def in_px(mm: Any) -> Any:
        return mm / (1e3 * m_per_px)

    if np.isfinite(m_per_px):
        top = ax.secondary_xaxis(-0.21, functions=(in_mm, in_px))
        top.set_xlabel("along the growth axis (mm)")
    legend_above(ax, 2)
    ax.set_title(title, loc="right", fontsize=10, color=MUTED, fontweight="normal")


def _time_axis(tracking: Tracking) -> tuple[np.ndarray, str]:
    """Ordinate of every frame in the strip, in ms or frames, and its label."""
    time_s = tracking.track.time_s
    return (1e3 * time_s, "time (ms)") if np.isfinite(time_s).all() else (np.arange(float(time_s.size)), "frame")


def shrunk(picture: np.ndarray, largest_px: int) -> np.ndarray:
    """Return a picture reduced to at most `largest_px` pixels per side by averaging, ignoring NaN. Shapes: picture
    (height, width) → (≤ largest_px, ≤ largest_px).
    """
    for axis in (0, 1):
        step = -(-picture.shape[axis] // largest_px)
        if step > 1:
            starts = np.arange(0, picture.shape[axis], step)
            known = np.isfinite(picture)
            sums = np.add.reduceat(np.where(known, picture, 0).astype(np.float32), starts, axis=axis)
            counts = np.add.reduceat(known.astype(np.float32), starts, axis=axis)
            picture = np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)
    return picture


def flagged(flag: Any) -> np.ndarray:
    """Return a mask, shape (n_frames,), of the frames with any flag except `before_release`. Shapes: flag (n_frames,) →
    (n_frames,).
    """
    return np.array([bool(set(str(entry).split(";")) - _IGNORED_FLAGS - {""}) for entry in flag], dtype=bool)


def _draw_frame(ax: Axes, tracking: Tracking, frame: int, picture: np.ndarray) -> None:
    height, width = picture.shape
    whole = (-0.5, width - 0.5, height - 0.5, -0.5)
    ax.imshow(shrunk(picture, _FRAME_PX), cmap="gray", extent=whole, interpolation="none")
    ax.set(xticks=[], yticks=[])
    ax.grid(visible=False)
    if tracking.axis.bends:
        path = tracking.axis.points(np.arange(0.0, tracking.axis.length_px, 3.0))
        ax.plot(path[:, 0], path[:, 1], color=SKY, linewidth=0.8, linestyle=":")
    track = tracking.track
    edge = float(track.edge_px[frame]) if frame < track.edge_px.size else np.nan
    if np.isfinite(edge):
        half = 0.75 * tracking.axis.width_px
        half = half if np.isfinite(half) else 0.25 * min(height, width)
        ends = np.array([tracking.axis.points(np.array(edge), across) for across in (-half, half)])
        unusable = bool(UNUSABLE_FLAGS.intersection(str(track.flag[frame]).split(";")))
        ax.plot(ends[:, 0], ends[:, 1], color=SKY if unusable else VERMILLION, linewidth=1.8)
    ax.set_xlim(-0.5, width - 0.5)
    ax.set_ylim(height - 0.5, -0.5)
    at = f", {1e3 * track.time_s[frame]:.1f} ms" if np.isfinite(track.time_s[frame]) else ""
    ax.set_title(f"frame {frame}{at}", fontsize=9, fontweight="normal", color=INK)
