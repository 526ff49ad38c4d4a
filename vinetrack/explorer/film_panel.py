"""The recording, to be scrubbed through, with the tracked edge and the model's drawn over it."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from bokeh.document import Document
from bokeh.models import Button, Column, ColumnDataSource, LinearColorMapper, Range1d, Row, Select, Slider
from bokeh.palettes import Greys256
from bokeh.plotting import figure

from vinetrack.explorer.campaign import Campaign, ShownTrial
from vinetrack.explorer.curves import Curves
from vinetrack.explorer.look import EARLIER_EDGE, MEASURED_EDGE, MODEL_EDGE, escaped, progress_bar, sheet, words
from vinetrack.explorer.recording import DecodedRecording, RecordingView, view_of
from vinetrack.results.folder_layout import Results

PLAY_MS = 70
"""Between two frames while playing; chosen: 14 a second, as fast as pictures of 960 pixels are sent."""
NARROW = ":host { flex-wrap: wrap; gap: 6px; align-items: end; }"


class FilmPanel:
    """One trial at a time. `instant` hears where in time, s since release, the frame lies (None: nowhere)."""

    def __init__(self, campaign: Campaign, document: Document, instant: Callable[[str, float | None], None]) -> None:
        self.campaign, self._document, self._instant = campaign, document, instant
        self._curves: Curves | None = None
        self._earlier: Curves | None = None
        self._film: DecodedRecording | None = None
        self._view: RecordingView | None = None
        self._playing: Any = None
        names = [seen.name for seen in campaign.trials]
        self.choose = Select(
            options=names, value=names[0], width=220, title="trial", name="film_trial", stylesheets=[sheet()], margin=0
        )
        self.play = Button(label="▶ play", width=84, name="film_play", stylesheets=[sheet()], margin=0)
        self.frame = Slider(
            start=0,
            end=1,
            value=0,
            step=1,
            title="frame",
            sizing_mode="stretch_width",
            name="film_frame",
            stylesheets=[sheet(":host { padding: 0 10px 0 4px; min-width: 180px; flex: 1 1 180px; }")],
            margin=0,
        )
        self.caption = words(name="film_caption")
        self._picture = ColumnDataSource({"image": []}, name="film_picture")
        self._edges = ColumnDataSource({"xs": [], "ys": [], "colour": [], "dash": []}, name="film_edges")
        self.figure = self._draw()
        self.choose.on_change("value", lambda _attr, _old, new: self.show_trial(new))
        self.frame.on_change("value", lambda _attr, _old, new: self._show_frame(int(new)))
        self.play.on_click(self._toggle_play)
        controls = Row(
            children=[self.choose, self.play, self.frame],
            sizing_mode="stretch_width",
            stylesheets=[sheet(NARROW)],
            margin=0,
        )
        self.root = Column(
            children=[controls, self.figure, self.caption], sizing_mode="stretch_width", name="film", margin=0
        )

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

    def set_curves(self, curves: Curves | None, earlier: Curves | None) -> None:
        """What the model says now, and said when the page opened.

        Parameters
        ----------
        curves, earlier : of the model now and as the page opened; None where not yet known.
        """
        self._curves, self._earlier = curves, earlier
        self._draw_edges()

    def show_trial(self, name: str) -> None:
        """Begin with another trial: decode its recording, or say that there is none.

        Parameters
        ----------
        name : of the trial.
        """
        self._stop()
        if self._film is not None:
            self._film.give_up()
        self._film = self._view = None
        if self.choose.value != name:
            self.choose.value = name
            return
        seen = self.campaign.trial(name)
        view = view_of(Results(self.campaign.folder), seen.data.trial)
        self.figure.visible = False
        if isinstance(view, str):
            last = max(seen.data.time_s.size - 1, 1)
            self.frame.update(start=0, end=last, value=(seen.data.n_rest + last) // 2)
            self._say_frame(int(self.frame.value), view)
            return
        self._view = view
        self.caption.text = progress_bar(0.0, f"decoding {view.path.name} …")
        self._film = DecodedRecording(view.path)
        self._film.in_background(self._heard)

    def _heard(self, film: DecodedRecording) -> None:
        """From the decoding thread."""
        self._document.add_next_tick_callback(partial(self._decoded, film))

    def _decoded(self, film: DecodedRecording) -> None:
        if film is not self._film or self._view is None:
            return
        if film.count and not self.figure.visible:
            self._fit_figure(film)
        if not film.complete:
            share = film.count / film.expected if film.expected else 0.0
            self.caption.text = progress_bar(share, f"decoding {film.path.name}: {film.count} frames")
            return
        if film.count == 0:
            self.caption.text = f'<span class="bad">{escaped(film.words or "not one frame can be decoded")}</span>'
            return
        moving = self._first_moving()
        self.frame.update(start=0, end=max(film.count - 1, 1))
        if self.frame.value != moving:
            self.frame.value = moving
        else:
            self._show_frame(moving)

    def _first_moving(self) -> int:
        """A frame worth seeing first: half-way along the motion."""
        if self._view is None or self._film is None:
            return 0
        known = np.flatnonzero(np.isfinite(self._view.edge_px))
        return 0 if not known.size else int(min(known[known.size // 2], self._film.count - 1))

    def _fit_figure(self, film: DecodedRecording) -> None:
        height, width = film.shape
        self.figure.x_range.update(start=-0.5, end=width - 0.5)
        self.figure.y_range.update(start=height - 0.5, end=-0.5)
        self._image.glyph.update(dw=width, dh=height)
        self.figure.aspect_ratio = width / height
        self.figure.visible = True

    def _show_frame(self, frame: int) -> None:
        if self._film is not None and self._film.complete and frame < self._film.count:
            self._picture.data = {"image": [self._film.picture(frame)]}
            self._draw_edges()
        self._say_frame(frame)

    def _time_s(self, frame: int) -> float:
        """When a frame was filmed, on the clock of the track."""
        times = self._seen().data.time_s if self._view is None else self._view.time_s
        return float(times[min(frame, times.size - 1)])

    def _seen(self) -> ShownTrial:
        return self.campaign.trial(self.choose.value)

    def _positions(self, frame: int) -> tuple[float, float, float]:
        """Where the edge was measured, and where the model had and has it, m on the track's ruler; NaN: unknown."""
        time_s, seen = self._time_s(frame), self._seen()
        place = self.campaign.trials.index(seen)
        at = np.array([time_s])
        # The fit begins at the first frame that it uses: before that the model says nothing.
        silent = time_s < float(seen.data.time_s[0])
        model_m = [
            math.nan if curves is None or silent else float(curves[place].lead_position_m(at)[0])
            for curves in (self._earlier, self._curves)
        ]
        if self._view is None:
            return float(seen.data.lead_position_m[min(frame, seen.data.time_s.size - 1)]), model_m[0], model_m[1]
        known = frame < self._view.lead_position_m.size
        return (float(self._view.lead_position_m[frame]) if known else math.nan), model_m[0], model_m[1]

    def _draw_edges(self) -> None:
        view, film = self._view, self._film
        if view is None or film is None or not film.complete or film.count == 0:
            return
        frame = int(self.frame.value)
        measured_m, earlier_m, now_m = self._positions(frame)
        edges = [
            (float(view.edge_px[frame]) if frame < view.edge_px.size else math.nan, MEASURED_EDGE, "solid", measured_m),
            (float(view.along_px(np.array(earlier_m))), EARLIER_EDGE, "dotted", earlier_m),
            (float(view.along_px(np.array(now_m))), MODEL_EDGE, "dashed", now_m),
        ]
        same = self._earlier is self._curves
        drawn = [
            (view.across(px, frame), colour, dash)
            for px, colour, dash, at in edges
            if math.isfinite(px) and math.isfinite(at) and not (same and colour == EARLIER_EDGE)
        ]
        half = 0.5 * (1 - film.scale)
        self._edges.data = {
            "xs": [[film.scale * x - half for x in xs] for (xs, _), _, _ in drawn],
            "ys": [[film.scale * y - half for y in ys] for (_, ys), _, _ in drawn],
            "colour": [colour for _, colour, _ in drawn],
            "dash": [dash for _, _, dash in drawn],
        }

    def _say_frame(self, frame: int, reason: str = "") -> None:
        seen = self._seen()
        since_s = self._time_s(frame) - seen.release_s
        positions = zip(("tracked", "compared with", "model"), self._positions(frame), strict=True)
        colours = {"tracked": MEASURED_EDGE, "compared with": EARLIER_EDGE, "model": MODEL_EDGE}
        positions_text = [
            f'<span style="border-bottom:3px solid {colours[name]}">{name} {1e3 * (at - seen.origin_m):.1f} mm</span>'
            for name, at in positions
            if math.isfinite(at)
        ]
        if not reason and self._view is None:
            reason = str(view_of(Results(self.campaign.folder), seen.data.trial))
        if self._view is not None and frame < self._view.by_hand.size and self._view.by_hand[frame]:
            positions_text.append("corrected by hand")
        words_ = f"<p>{escaped(reason)}</p>" if reason else ""
        when = f"{1e3 * since_s:.1f} ms since release" if since_s >= 0 else f"−{-1e3 * since_s:.1f} ms, before release"
        self.caption.text = f"{words_}<p>{when} · {' · '.join(positions_text)}</p>"
        self._instant(seen.name, since_s)

    def refresh(self) -> None:
        """Say the frame again, for curves that have changed."""
        if self._film is None or self._film.complete:
            self._say_frame(int(self.frame.value))

    def _toggle_play(self) -> None:
        if self._playing is not None:
            self._stop()
            return
        self.play.label = "❚❚ pause"
        self._playing = self._document.add_periodic_callback(self._next_frame, PLAY_MS)

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
        """Nobody looks any more."""
        if self._film is not None:
            self._film.give_up()
