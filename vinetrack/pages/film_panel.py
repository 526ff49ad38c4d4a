"""Panel to step through a recording, with the tracked edge and the model's drawn over it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from bokeh.document import Document
from bokeh.models import ColumnDataSource, LinearColorMapper, Range1d, Select, Slider
from bokeh.palettes import Greys256
from bokeh.plotting import figure
from numpy.typing import NDArray

from vinetrack.core.problems import UserError
from vinetrack.core.records import Floats, Trial, hand_corrected
from vinetrack.pages.campaign import Campaign, ExplorerTrial, Job, Prediction
from vinetrack.pages.local_page import jpeg
from vinetrack.pages.plots import (
    button,
    escaped,
    html_div,
    progress_bar,
    side_by_side,
    stacked,
    stylesheet,
)
from vinetrack.pipeline.overlays_stage import shake_along
from vinetrack.results.folder_layout import Results, ResultsError, read_json, read_result
from vinetrack.video.axis import Axis
from vinetrack.video.curved_axis import axis_from_entry
from vinetrack.video.frames import RecordingError, inspect_recording, iterate_frames

# ------------------------------------------------------------------------------
# Frames of one recording, and the positions of the tracked edge and the model's edge in the picture.
#
# A recording is decoded once, in the background, and its frames are kept as JPEG no wider than the page shows them: one
# second of a high-speed camera takes a few tens of megabytes.


# Name, colour over a grey picture, and line of each edge that is drawn
EDGES = (("tracked", "#56B4E9", "solid"), ("comparison", "#E69F00", "dotted"), ("model", "#D55E00", "dashed"))


@dataclass(frozen=True)
class RecordingView:
    """Mapping of positions along the growth axis to the picture of one recording, px of the recording. `edge_px`, shape
    (n_frames,), counts along the axis, NaN where the edge was not found; `time_s` and `lead_position_m` are those of
    the track.
    """

    path: Path
    axis: Axis
    half_width_px: float
    time_s: Floats
    edge_px: Floats
    lead_position_m: Floats
    shake_px: Floats
    by_hand: NDArray[np.bool_]

    def along_px(self, lead_position_m: Floats) -> Floats:
        """Return the pixels along the axis of positions of the track; linearly extrapolated beyond the track. NaN if
        the track has fewer than two points.
        """
        known = np.flatnonzero(np.isfinite(self.edge_px) & np.isfinite(self.lead_position_m))
        if known.size < 2:
            return np.full(np.shape(lead_position_m), np.nan)
        known = known[np.argsort(self.lead_position_m[known], kind="stable")]
        position, along = self.lead_position_m[known], self.edge_px[known]
        scale, offset = np.polyfit(position, along, 1)
        outside = (lead_position_m < position[0]) | (lead_position_m > position[-1])
        return np.where(outside, offset + scale * lead_position_m, np.interp(lead_position_m, position, along))

    def across(self, along_px: float, frame: int | None = None) -> tuple[tuple[float, float], tuple[float, float]]:
        """Return the ends of a line across the vine at a position along the axis; with `frame`, in that picture.
        Returns xs, ys : of both ends, px.
        """
        if frame is not None and frame < self.shake_px.size:
            along_px += float(self.shake_px[frame])
        half = self.half_width_px
        (x0, y0), (x1, y1) = self.axis.points(np.full(2, along_px), np.array([half, -half]))
        return (float(x0), float(x1)), (float(y0), float(y1))


def recording_view(results: Results, trial: Trial) -> RecordingView | str:
    """Return the view of a trial, or the reason why there is none."""
    if trial.video is None:
        name = trial.track.name if trial.track is not None else "a table"
        return f"{trial.name} came as a track ({name}): there is no recording to show, only the positions of its edge."
    if not trial.video.exists():
        return f"The recording of {trial.name}, {trial.video.name}, no longer exists; its track is shown instead."
    try:
        axis = read_json(results.analysed(trial.name)).get("axis")
        table = read_result(results.track(trial.name))
    except ResultsError as error:
        return str(error)
    if not axis:
        return f"The position of the axis of {trial.name} in its picture was not stored: run snakemake again."
    line = axis_from_entry(axis)
    width = axis.get("width_px")
    return RecordingView(
        path=trial.video,
        axis=line,
        half_width_px=0.75 * float(width) if width else 0.05 * line.length_px,
        time_s=table["time_s"].to_numpy(dtype=float),
        edge_px=table["edge_px"].to_numpy(dtype=float),
        lead_position_m=table["lead_position_m"].to_numpy(dtype=float),
        shake_px=shake_along(axis, len(table)),
        by_hand=hand_corrected(table["flag"]),
    )


@dataclass(frozen=True)
class Film:
    """Decoded frames of a recording as JPEG, with the number of their pixels per pixel of the recording."""

    frames: Sequence[bytes]
    scale: float

    def picture(self, frame: int) -> NDArray[np.uint8]:
        """Return the grey levels of one frame."""
        data = np.frombuffer(self.frames[frame], dtype=np.uint8)
        return np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE), dtype=np.uint8)


def decode(path: Path, watch: Callable[[tuple[int, float]], None]) -> Film:
    """Decode a recording as far as it can be decoded; `watch` gets the number of frames so far, and their share."""
    max_width_px = 960  # Chosen: as wide as the page shows a recording
    frames: list[bytes] = []
    scale, reason = 1.0, "no frame could be decoded"
    try:
        recording = inspect_recording(path)
        for luma in iterate_frames(recording):
            scale = min(max_width_px / luma.shape[1], 1.0)
            frames.append(jpeg(luma, max_width_px, 2.0**recording.bit_depth - 1))
            # Frames between two reports of progress; chosen: several reports a second
            if len(frames) % 10 == 1:
                watch((len(frames), len(frames) / (recording.declared_frames or math.inf)))
    except (RecordingError, OSError) as error:
        reason = str(error)
    if not frames:
        raise UserError(reason)
    return Film(frames, scale)


class FilmPanel:
    """Shows one trial at a time; calls `instant` with the time of the frame, s since release."""

    def __init__(self, campaign: Campaign, document: Document, instant: Callable[[str, float], None]) -> None:
        self.campaign, self._document, self._instant = campaign, document, instant
        self._now: Prediction | None = None
        self._reference: Prediction | None = None
        self._film: Film | None = None
        self._job: Job[tuple[int, float], Film] | None = None
        self._view: RecordingView | None = None
        self._no_view = ""
        self._playing: Any = None
        names = [aligned.name for aligned in campaign.trials]
        common: dict[str, Any] = {"stylesheets": [stylesheet()], "margin": 0}
        self.trial_select = Select(options=names, value=names[0], width=220, title="trial", name="film_trial", **common)
        self.play = button("▶ play", "film_play", self._toggle_play, width=84)
        self.frame = Slider(
            start=0,
            end=1,
            value=0,
            step=1,
            title="frame",
            sizing_mode="stretch_width",
            name="film_frame",
            stylesheets=[stylesheet(":host { padding: 0 10px 0 4px; min-width: 180px; flex: 1 1 180px; }")],
            margin=0,
        )
        self.caption = html_div(name="film_caption")
        self._picture = ColumnDataSource({"image": []}, name="film_picture")
        self._edges = ColumnDataSource({"xs": [], "ys": [], "colour": [], "dash": []}, name="film_edges")
        self.figure = self._draw()
        self.trial_select.on_change("value", lambda _attr, _old, new: self.show_trial(new))
        self.frame.on_change("value", lambda _attr, _old, new: self._show_frame(int(new)))
        controls = side_by_side(
            self.trial_select,
            self.play,
            self.frame,
            css=":host { flex-wrap: wrap; gap: 6px; align-items: end; }",
            sizing_mode="stretch_width",
        )
        self.root = stacked(controls, self.figure, self.caption, name="film")

    def _draw(self) -> Any:
        fig = figure(
            sizing_mode="scale_width",
            aspect_ratio=3.0,
            tools="",
            toolbar_location=None,
            x_range=Range1d(0, 1),
            y_range=Range1d(1, 0),
            visible=False,
            name="film_figure",
            min_border=0,
            margin=(6, 0, 4, 0),
        )
        fig.axis.visible = False
        fig.grid.visible = False
        self._mapper = LinearColorMapper(palette=list(Greys256), low=0, high=255)
        self._image = fig.image(
            "image", source=self._picture, x=-0.5, y=-0.5, dw=1, dh=1, color_mapper=self._mapper, level="image"
        )
        fig.multi_line("xs", "ys", source=self._edges, line_color="black", line_width=4.5, line_alpha=0.45)
        fig.multi_line("xs", "ys", source=self._edges, line_color="colour", line_width=2.6, line_dash={"field": "dash"})
        return fig

    def set_predictions(self, now: Prediction, reference: Prediction | None) -> None:
        """Set the predictions of the current model and of the model for comparison."""
        self._now, self._reference = now, reference
        self._draw_edges()
        if self._job is None:
            self._update_caption(int(self.frame.value))

    def show_trial(self, name: str) -> None:
        """Show another trial: decode its recording, or show why there is none."""
        self._stop()
        self.close()
        if self.trial_select.value != name:
            self.trial_select.value = name
            return
        self.figure.visible = False
        view = recording_view(Results(self.campaign.folder), self._shown.data.trial)
        if isinstance(view, str):
            self._show_track(view)
            return
        self._view, self._no_view = view, ""
        self.caption.text = progress_bar(0.0, f"decoding {view.path.name} …")
        soon = self._document.add_next_tick_callback
        decoding, decoded = partial(self._decoding, view), partial(self._decoded, view)
        self._job = Job(partial(decode, view.path), lambda done: soon(partial(decoding, *done)), decoded, soon)

    def _show_track(self, reason: str) -> None:
        """Show the positions alone, and why there is no recording."""
        self._view, self._no_view = None, reason
        data = self._shown.data
        last = max(data.time_s.size - 1, 1)
        self.frame.update(start=0, end=last, value=(data.n_rest + last) // 2)
        self._update_caption(int(self.frame.value))

    def _decoding(self, view: RecordingView, count: int, share: float) -> None:
        if view is self._view and self._job is not None:
            self.caption.text = progress_bar(share, f"decoding {view.path.name}: {count} frames")

    def _decoded(self, view: RecordingView, film: Film | None, reason: str) -> None:
        if view is not self._view:
            return
        self._job, self._film = None, film
        if film is None:
            self._show_track(reason)
            return
        height, width = film.picture(0).shape
        self.figure.x_range.update(start=-0.5, end=width - 0.5)
        self.figure.y_range.update(start=height - 0.5, end=-0.5)
        self._image.glyph.update(dw=width, dh=height)
        self.figure.update(aspect_ratio=width / height, visible=True)
        # The frame shown first is half-way along the motion.
        known = np.flatnonzero(np.isfinite(view.edge_px))
        last = len(film.frames) - 1
        moving = int(min(known[known.size // 2], last)) if known.size else 0
        self.frame.update(start=0, end=max(last, 1))
        if self.frame.value != moving:
            self.frame.value = moving
        else:
            self._show_frame(moving)

    def _show_frame(self, frame: int) -> None:
        if self._film is not None and frame < len(self._film.frames):
            self._picture.data = {"image": [self._film.picture(frame)]}
            self._draw_edges()
        self._update_caption(frame)

    def _time_s(self, frame: int) -> float:
        """Time of a frame on the clock of the track."""
        times = self._shown.data.time_s if self._view is None else self._view.time_s
        return float(times[min(frame, times.size - 1)])

    @property
    def _shown(self) -> ExplorerTrial:
        return self.campaign.trial(self.trial_select.value)

    def _positions(self, frame: int) -> Floats:
        """Position of each of `EDGES` in a frame, m; NaN if unknown. Shape (3,)."""
        time_s, aligned = self._time_s(frame), self._shown
        measured_m = aligned.data.lead_position_m if self._view is None else self._view.lead_position_m
        positions_m = np.full(3, math.nan)
        positions_m[0] = measured_m[frame] if frame < measured_m.size else math.nan
        for k, prediction in enumerate((self._reference, self._now), 1):
            if prediction is not None:
                # The model is defined between the first and the last frame of the fit.
                predicted_m = prediction.trials[self.campaign.trials.index(aligned)].predicted_position_m
                positions_m[k] = np.interp(time_s, aligned.data.time_s, predicted_m, math.nan, math.nan)
        return positions_m

    def _draw_edges(self) -> None:
        view, film = self._view, self._film
        if view is None or film is None:
            return
        frame = int(self.frame.value)
        drawn = [
            (view.across(float(px), frame), colour, dash)
            for (name, colour, dash), px in zip(EDGES, view.along_px(self._positions(frame)), strict=True)
            if math.isfinite(px) and not (name == "comparison" and self._reference is self._now)
        ]
        half = 0.5 * (1 - film.scale)
        self._edges.data = {
            "xs": [[film.scale * x - half for x in xs] for (xs, _), _, _ in drawn],
            "ys": [[film.scale * y - half for y in ys] for (_, ys), _, _ in drawn],
            "colour": [colour for _, colour, _ in drawn],
            "dash": [dash for _, _, dash in drawn],
        }

    def _update_caption(self, frame: int) -> None:
        aligned, view = self._shown, self._view
        since_s = self._time_s(frame) - aligned.release_s
        positions_text = [
            f'<span style="border-bottom:3px solid {colour}">{name} {1e3 * (m - aligned.origin_m):.1f} mm</span>'
            for (name, colour, _), m in zip(EDGES, self._positions(frame), strict=True)
            if math.isfinite(m)
        ]
        if view is not None and frame < view.by_hand.size and view.by_hand[frame]:
            positions_text.append("corrected by hand")
        notice = f"<p>{escaped(self._no_view)}</p>" if self._no_view else ""
        when = f"{1e3 * since_s:.1f} ms since release" if since_s >= 0 else f"−{-1e3 * since_s:.1f} ms, before release"
        self.caption.text = f"{notice}<p>{when} · {' · '.join(positions_text)}</p>"
        self._instant(aligned.name, since_s)

    def _toggle_play(self) -> None:
        if self._playing is not None:
            self._stop()
            return
        self.play.label = "❚❚ pause"
        # Interval of frames while playing; chosen: 14 per second, as fast as pictures of 960 pixels are sent
        self._playing = self._document.add_periodic_callback(self._next_frame, 70)

    def _next_frame(self) -> None:
        step = max(int(self.frame.end) // 150, 1)
        following = int(self.frame.value) + step
        self.frame.value = following if following <= self.frame.end else 0

    def _stop(self) -> None:
        if self._playing is not None:
            self._document.remove_periodic_callback(self._playing)
            self._playing = None
        self.play.label = "▶ play"

    def close(self) -> None:
        """Stop decoding, and let the recording go."""
        if self._job is not None:
            self._job.cancel()
        self._job = self._film = self._view = None
