"""Widgets and figures of the explorer: positions, residuals, errors, and the recording with edges drawn over it."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from html import escape
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
from bokeh import models as bk
from bokeh.document import Document
from bokeh.palettes import Greys256
from bokeh.plotting import figure
from bokeh.themes import Theme
from jinja2 import Environment, FileSystemLoader
from numpy.typing import NDArray

from vinetrack.core.problems import UserError
from vinetrack.core.records import Floats, Trial, with_flag
from vinetrack.figures.style import GRID, INK, MUTED, ORANGE, SKY, VERMILLION, VINE_COLOURS, vine_styles
from vinetrack.inference.fit_result import TrialFit
from vinetrack.pages.campaign import Campaign, ExplorerTrial, Job, Prediction
from vinetrack.pages.local_page import TEMPLATES, jpeg
from vinetrack.report.build import position_to_px, shake_along
from vinetrack.results import Results, ResultsError, read_json, read_result
from vinetrack.video.axis import Axis, axis_from_entry
from vinetrack.video.frames import RecordingError, inspect_recording, iterate_frames

# ------------------------------------------------------------------------------
# Style shared with the report: colours, fonts, and the pieces of HTML of the page.


def theme() -> Theme:
    """The look of widgets, whose insides the CSS of the page does not reach, and of figures."""
    font = 'system-ui, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif'
    wide = {"sizing_mode": "stretch_width"}
    looks: dict[str, dict[str, Any]] = {
        "Widget": {"margin": 0, "stylesheets": [(TEMPLATES / "widgets.css").read_text(encoding="utf-8")]},
        "Div": wide,
        "Column": wide,
        "Plot": {
            **dict.fromkeys(("background_fill_color", "border_fill_color", "outline_line_color"), None),
            "toolbar_inner": True,
        },
        "Toolbar": {"autohide": True, "logo": None},
        "Axis": {
            **dict.fromkeys(("axis_label_text_font", "major_label_text_font"), font),
            **dict.fromkeys(("axis_label_text_color", "major_label_text_color"), INK),
            **dict.fromkeys(("axis_line_color", "major_tick_line_color"), INK),
            "axis_label_text_font_size": "13px",
            "axis_label_text_font_style": "normal",
            "major_label_text_font_size": "12px",
            "minor_tick_line_color": None,
            "axis_label_standoff": 6,
        },
        "Grid": {"grid_line_color": GRID, "grid_line_width": 0.8},
    }
    return Theme(json={"attrs": looks})


def vine_colour() -> dict[str, Any]:
    """Return the colour of glyphs with a column `colour`: a palette, so that a page can change it."""
    colours = list(VINE_COLOURS)
    return {"field": "colour", "transform": bk.CategoricalColorMapper(factors=colours, palette=colours)}


def set_text(piece: bk.Div, text: str) -> None:
    """Change a piece of HTML only if it differs, because whatever is sent is drawn again."""
    if piece.text != text:
        piece.text = text


def button(label: str, name: str, does: Callable[[], None], **options: Any) -> bk.Button:
    """Return a button that calls `does` when it is clicked."""
    made = bk.Button(label=label, name=name, **options)
    made.on_click(does)
    return made


def beside(*parts: bk.UIElement, css: str = ":host { gap: 6px; }") -> bk.Row:
    """Return parts beside each other."""
    return bk.Row(*parts, stylesheets=[css])


def plot(height: int, x_label: str, y_label: str, **keywords: Any) -> figure:
    """Return an empty figure as wide as its card."""
    return figure(
        height=height,
        sizing_mode="stretch_width",
        tools="box_zoom,pan,reset",
        active_drag=None,
        active_scroll=None,
        toolbar_location="above",
        x_axis_label=x_label,
        y_axis_label=y_label,
        min_border_right=14,
        margin=0,
        **keywords,
    )


@cache
def templates() -> Environment:
    """The templates of the page."""
    return Environment(loader=FileSystemLoader(TEMPLATES, encoding="utf-8"), autoescape=True)


def panel(name: str, **given: Any) -> str:
    """Return a piece of HTML that `panels.html` makes of what is given."""
    made = str(getattr(templates().get_template("panels.html").module, name)(**given))
    return re.sub("`([^`<]+)`", r"<code>\1</code>", made)


def progress_bar(share: float, text: str) -> str:
    """Return a bar filled to a fraction, with text below it."""
    percent = 100 * min(max(share, 0.02), 1.0)
    return f'<div class="bar"><i style="width:{percent:.0f}%"></i></div><small>{escape(text)}</small>'


# ------------------------------------------------------------------------------
# Figures and their data, as plain columns in milliseconds and millimetres.

Columns = dict[str, list[Any]]
Errors = Mapping[str, float]


def round_up(value: float, steps: Sequence[float]) -> float:
    """Return the next of these steps times a power of ten, so that an axis rarely changes; 1 for nothing, or NaN."""
    if not value > 0:
        return 1.0
    power = 10.0 ** math.floor(math.log10(value))
    return next(round(power * step, 12) for step in steps if power * step >= value or step == steps[-1])


class Plots:
    """Figures and their data sources, updated by `set_shown`, `draw` and `set_instant`."""

    def __init__(self, campaign: Campaign, on_condition_click: Callable[[str], None]) -> None:
        self.campaign, self._on_condition_click = campaign, on_condition_click
        styles = vine_styles(campaign.vines)
        # The colour of each condition is that of its vine, as in every figure.
        self._colour = {aligned.condition: styles[aligned.data.trial.vine].colour for aligned in campaign.trials}
        self._measured = bk.ColumnDataSource(self._lines(()))
        self._reference = bk.ColumnDataSource({"xs": [], "ys": []})
        self._model = bk.ColumnDataSource({"xs": [], "ys": []}, name="model_curves")
        self._residuals = bk.ColumnDataSource(self._lines(()), name="residual_curves")
        self._bars = bk.ColumnDataSource(self._error_bars({}, {}, ()), name="error_bars")
        self.motion, self.residual = self._draw_motion(), self._draw_residual()
        self.errors = self._draw_errors()

    def _draw_motion(self) -> Any:
        fig = plot(360, "since release (ms)", "growth (mm)", name="motion")
        look = {"line_color": vine_colour(), "line_width": 1.6, "line_alpha": 0.9}
        lines = fig.multi_line("xs", "ys", source=self._measured, **look)
        for of_axis in (fig.x_range, fig.y_range):
            of_axis.update(renderers=[lines], range_padding=0.05)
        ghost = {"line_color": MUTED, "line_width": 1.5, "line_dash": [2, 3]}
        fig.multi_line("xs", "ys", source=self._reference, **ghost)
        model = fig.multi_line("xs", "ys", source=self._model, line_color=INK, line_width=2, line_dash=[7, 4])
        values = [("since release", "$x{0.0} ms"), ("growth", "$y{0.0} mm")]
        for drawn, tips in ((lines, [("trial", "@trial"), ("", "@condition")]), (model, [("", "model")])):
            fig.add_tools(bk.HoverTool(renderers=[drawn], tooltips=[*tips, *values], line_policy="interp"))
        self.instant = bk.Span(dimension="height", line_color=INK, line_width=1, line_alpha=0.5, visible=False)
        fig.add_layout(self.instant)
        return fig

    def _draw_residual(self) -> Any:
        fig = plot(230, "growth (mm)", "measured − model (mm)", name="residual", y_range=bk.Range1d(-1, 1))
        fig.add_layout(bk.Span(location=0, dimension="width", line_color=INK, line_width=1.5, line_dash=[7, 4]))
        lines = fig.multi_line("xs", "ys", source=self._residuals, line_color=vine_colour(), line_width=1.4)
        tips = [("trial", "@trial"), ("", "@condition"), ("growth", "$x{0.0} mm"), ("measured − model", "$y{0.00} mm")]
        fig.add_tools(bk.HoverTool(renderers=[lines], tooltips=tips, line_policy="interp"))
        return fig

    def _draw_errors(self) -> Any:
        names = list(reversed(self.campaign.conditions))
        # Height of a bar of the errors; chosen: a label of 12 pixels and a gap of equal height
        height = 70 + 25 * max(len(names), 2)
        fig = plot(height, "rms error of position (mm)", "", name="errors", y_range=names, x_range=bk.Range1d(0, 1))
        common = {"y": "condition", "source": self._bars}
        pale = {"fill_color": GRID, "fill_alpha": 0.65, "line_color": MUTED, "line_alpha": 0.5}
        held = fig.hbar(right="before", height=0.8, **pale, **common)
        solid = {"fill_color": vine_colour(), "fill_alpha": "alpha", "line_color": None}
        bars = fig.hbar(right="now", height=0.44, **solid, **common)
        mark = {"marker": "dash", "angle": math.pi / 2, "size": 17, "line_color": INK, "line_width": 2.6}
        for drawn in (bars, fig.scatter(x="highest", **mark, **common), held):
            drawn.nonselection_glyph = drawn.selection_glyph = None
        columns = {"now": "now", "for comparison": "before", "an adequate model, at most": "highest"}
        tips = [("", "@label"), *((words, f"@{column}{{0.000}} mm") for words, column in columns.items())]
        fig.add_tools(bk.HoverTool(renderers=[bars], tooltips=tips), bk.TapTool(renderers=[bars, held]))
        self._bars.selected.on_change("indices", self._tapped)
        labels = [self.campaign.labels[name] for name in names]
        code = "return labels[names.indexOf(tick)] ?? tick"
        fig.yaxis.formatter = bk.CustomJSTickFormatter(args={"names": names, "labels": labels}, code=code)
        fig.ygrid.visible = False
        # Toolbar buttons would cover the first bar; tapping needs none.
        fig.toolbar_location = None
        fig.yaxis.major_tick_line_color = None
        return fig

    def _tapped(self, _attr: str, _old: list[int], new: list[int]) -> None:
        if new:
            self._bars.selected.indices = []
            self._on_condition_click(self.campaign.conditions[-1 - new[0]])

    def _lines(self, lines: Iterable[tuple[ExplorerTrial, Floats, Floats]]) -> Columns:
        """One line per trial, from abscissae and ordinates in SI, scaled by 1000; none crosses frames left out."""
        columns: Columns = {"xs": [], "ys": [], "colour": [], "trial": [], "condition": []}
        for aligned, x, y in lines:
            gaps = np.diff(np.cumsum(aligned.data.first)[aligned.rows], prepend=0) > 0
            gaps[0] = False
            columns["xs"].append(1e3 * x[aligned.rows])
            columns["ys"].append(np.where(gaps, math.nan, 1e3 * y[aligned.rows]))
            columns["colour"].append(self._colour[aligned.condition])
            columns["trial"].append(aligned.name)
            columns["condition"].append(self.campaign.labels[aligned.condition])
        return columns

    def _model_lines(self, prediction: Prediction, shown: Sequence[int]) -> Columns:
        """One line per condition, of its longest trial that is shown: `xs` ms since release, `ys` mm of growth."""
        longest: dict[str, tuple[ExplorerTrial, TrialFit]] = {}
        for i in sorted(shown, key=lambda i: self.campaign.trials[i].time_s[-1]):
            longest[self.campaign.trials[i].condition] = self.campaign.trials[i], prediction.trials[i]
        drawn = [longest[name] for name in self.campaign.conditions if name in longest]
        return {
            "xs": [1e3 * trial.time_s[trial.rows] for trial, _ in drawn],
            "ys": [1e3 * (model.predicted_position_m - trial.origin_m)[trial.rows] for trial, model in drawn],
        }

    def _error_bars(self, now_m: Errors, before_m: Errors, conditions: Sequence[str]) -> Columns:
        """One row per condition, the first at the bottom, mm; those not in `conditions` are faint."""
        names = list(reversed(self.campaign.conditions))
        errors = {"now": now_m, "before": before_m, "highest": self.campaign.highest_m}
        return {
            "condition": names,
            "label": [self.campaign.labels[name] for name in names],
            **{key: [1e3 * of_condition.get(name, math.nan) for name in names] for key, of_condition in errors.items()},
            "colour": [self._colour[name] for name in names],
            "alpha": [0.95 if name in conditions else 0.3 for name in names],
        }

    def set_shown(self, shown: Sequence[int]) -> None:
        """Select the trials to draw."""
        trials = (self.campaign.trials[i] for i in shown)
        self._measured.data = self._lines((aligned, aligned.time_s, aligned.growth_m) for aligned in trials)

    def set_instant(self, since_s: float) -> None:
        """Mark a time since release."""
        self.instant.update(visible=True, location=1e3 * since_s)

    def draw(
        self, now: Prediction, reference: Prediction | None, shown: Sequence[int], conditions: Sequence[str]
    ) -> None:
        """Draw the current model, and another for comparison; errors of conditions that are not selected are faint."""
        trials = self.campaign.trials
        residual = self._lines((trials[i], trials[i].growth_m, now.trials[i].residual_m) for i in shown)
        largest_mm = max((float(np.nanmax(np.abs(part))) for part in residual["ys"]), default=0.0)
        reach = round_up(1.05 * max(largest_mm, 0.1), (1.2, 2, 3, 5, 7, 10))
        self.residual.y_range.update(start=-reach, end=reach)
        self._model.data, self._residuals.data = self._model_lines(now, shown), residual
        other = None if reference is now else reference
        self._reference.data = {"xs": [], "ys": []} if other is None else self._model_lines(other, shown)
        before_m = {} if reference is None else reference.errors_m
        rows = self._error_bars(now.errors_m, before_m, conditions)
        known = [value for key in ("now", "before", "highest") for value in rows[key] if math.isfinite(value)]
        self.errors.x_range.end = round_up(1.04 * max(known, default=1.0), (1, 1.5, 2, 3, 4, 5, 6, 8, 10))
        self._bars.data = rows


# ------------------------------------------------------------------------------
# Frames of one recording, and the positions of the tracked edge and the model's edge in the picture.
#
# A recording is decoded once, in the background, and its frames are kept as JPEG no wider than the page shows them: one
# second of a high-speed camera takes a few tens of megabytes.

# Name, colour over a grey picture, and line of each edge that is drawn
EDGES = (("tracked", SKY, "solid"), ("comparison", ORANGE, "dotted"), ("model", VERMILLION, "dashed"))


@dataclass(frozen=True)
class RecordingView:
    """A recording: axis, half the width of a line across it, px, track, and the shift of each frame along the axis."""

    path: Path
    axis: Axis
    half_width_px: float
    track: pd.DataFrame
    shake_px: Floats

    def along_px(self, lead_position_m: Floats) -> Floats:
        """Return the pixels along the axis of positions of the track, as in a clip; NaN where too few are known."""
        try:
            return np.asarray(position_to_px(self.track)(lead_position_m))
        except ResultsError:
            return np.full(np.shape(lead_position_m), np.nan)

    def across(self, along_px: float, frame: int) -> tuple[tuple[float, float], tuple[float, float]]:
        """Return xs and ys of the ends of a line across the vine at a position along the axis, px of one picture."""
        if frame < self.shake_px.size:
            along_px += float(self.shake_px[frame])
        half = self.half_width_px
        (x0, y0), (x1, y1) = self.axis.points(np.full(2, along_px), np.array([half, -half]))
        return (float(x0), float(x1)), (float(y0), float(y1))


def recording_view(results: Results, trial: Trial) -> RecordingView | str:
    """Return the view of a trial, or the reason why there is none."""
    if trial.video is None:
        name = trial.track.name if trial.track is not None else "a table"
        return f"{trial.name} came as a track ({name}): there is no recording to show."
    if not trial.video.exists():
        return f"The recording of {trial.name}, {trial.video.name}, no longer exists."
    try:
        axis = read_json(results.analysed(trial.name)).get("axis")
        table = read_result(results.track(trial.name))
    except ResultsError as error:
        return str(error)
    if not axis:
        return f"The position of the axis of {trial.name} in its picture was not stored: run `vinetrack run` again."
    line = axis_from_entry(axis)
    width = axis.get("width_px")
    half_px = 0.75 * float(width) if width else 0.05 * line.length_px
    return RecordingView(trial.video, line, half_px, table, shake_along(axis, len(table)))


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

    def __init__(self, campaign: Campaign, document: Document, instant: Callable[[float], None]) -> None:
        self.campaign, self._document, self._instant = campaign, document, instant
        self._now: Prediction | None = None
        self._reference: Prediction | None = None
        self._film: Film | None = None
        self._job: Job[tuple[int, float], Film] | None = None
        self._view: RecordingView | None = None
        names = [aligned.name for aligned in campaign.trials]
        self.trial_select = bk.Select(options=names, value=names[0], width=220, title="trial", name="film_trial")
        numbers = {"start": 0, "end": 1, "value": 0, "step": 1, "sizing_mode": "stretch_width"}
        self.frame = bk.Slider(**numbers, title="frame", name="film_frame", css_classes=["frame"])
        self.caption = bk.Div(name="film_caption")
        self._picture = bk.ColumnDataSource({"image": []}, name="film_picture")
        self._edges = bk.ColumnDataSource({"xs": [], "ys": [], "colour": [], "dash": []}, name="film_edges")
        self.figure = self._draw()
        self.trial_select.on_change("value", lambda _attr, _old, new: self.show_trial(new))
        self.frame.on_change("value", lambda _attr, _old, _new: self._show_frame())
        css = ":host { flex-wrap: wrap; gap: 6px; align-items: end; }"
        controls = bk.Row(self.trial_select, self.frame, stylesheets=[css], sizing_mode="stretch_width")
        self.root = bk.Column(controls, self.figure, self.caption, name="film")

    def _draw(self) -> Any:
        fig = figure(
            sizing_mode="scale_width",
            aspect_ratio=3.0,
            tools="",
            toolbar_location=None,
            x_range=bk.Range1d(0, 1),
            y_range=bk.Range1d(1, 0),
            visible=False,
            name="film_figure",
            min_border=0,
            margin=(6, 0, 4, 0),
        )
        fig.axis.visible = False
        fig.grid.visible = False
        greys = bk.LinearColorMapper(palette=list(Greys256), low=0, high=255)
        place = {"x": -0.5, "y": -0.5, "dw": 1, "dh": 1, "level": "image"}
        self._image = fig.image("image", source=self._picture, color_mapper=greys, **place)
        fig.multi_line("xs", "ys", source=self._edges, line_color="black", line_width=4.5, line_alpha=0.45)
        fig.multi_line("xs", "ys", source=self._edges, line_color="colour", line_width=2.6, line_dash={"field": "dash"})
        return fig

    def set_predictions(self, now: Prediction, reference: Prediction | None) -> None:
        """Set the predictions of the current model and of the model for comparison."""
        self._now, self._reference = now, reference
        if self._job is None:
            self._show_edges()

    def show_trial(self, name: str) -> None:
        """Show another trial: decode its recording, or show why there is none."""
        self.close()
        if self.trial_select.value != name:
            self.trial_select.value = name
            return
        self.figure.visible = self.frame.visible = False
        view = recording_view(Results(self.campaign.folder), self._shown.data.trial)
        if isinstance(view, str):
            self.caption.text = f"<p>{escape(view)}</p>"
            return
        self._view = view
        self.caption.text = progress_bar(0.0, f"decoding {view.path.name} …")
        soon = self._document.add_next_tick_callback
        decoding, decoded = partial(self._decoding, view), partial(self._decoded, view)
        self._job = Job(partial(decode, view.path), lambda done: soon(partial(decoding, *done)), decoded, soon)

    def _decoding(self, view: RecordingView, count: int, share: float) -> None:
        if view is self._view and self._job is not None:
            self.caption.text = progress_bar(share, f"decoding {view.path.name}: {count} frames")

    def _decoded(self, view: RecordingView, film: Film | None, reason: str) -> None:
        self._job, self._film = None, film
        if film is None:
            self.caption.text = f"<p>{escape(reason)}</p>"
            return
        height, width = film.picture(0).shape
        shown = max(width, 1.5 * height)  # 1.5: a picture on end stays within the window (chosen)
        self.figure.x_range.update(start=(width - shown) / 2 - 0.5, end=(width + shown) / 2 - 0.5)
        self.figure.y_range.update(start=height - 0.5, end=-0.5)
        self._image.glyph.update(dw=width, dh=height)
        self.figure.aspect_ratio = shown / height
        self.figure.visible = self.frame.visible = True
        known = np.flatnonzero(view.track["edge_px"].notna())
        last = len(film.frames) - 1
        # The first frame that is shown: half-way along the motion
        middle = int(min(known[known.size // 2], last)) if known.size else 0
        self.frame.update(start=0, end=max(last, 1), value=middle)
        self._show_frame()

    def _show_frame(self) -> None:
        frame = int(self.frame.value)
        if self._film is not None and frame < len(self._film.frames):
            self._picture.data = {"image": [self._film.picture(frame)]}
        self._show_edges()

    @property
    def _shown(self) -> ExplorerTrial:
        return self.campaign.trial(self.trial_select.value)

    def _show_edges(self) -> None:
        """Draw each of `EDGES` that is known in the frame shown, and state their positions below."""
        aligned, view, frame = self._shown, self._view, int(self.frame.value)
        if view is None or self._film is None:
            return
        time_s, measured_m = (view.track[name].to_numpy(dtype=float) for name in ("time_s", "lead_position_m"))
        at_s = float(time_s[min(frame, time_s.size - 1)])
        positions_m = np.full(3, math.nan)
        if frame < measured_m.size:
            positions_m[0] = measured_m[frame]
        for k, prediction in enumerate((self._reference, self._now), 1):
            if prediction is not None:
                # The model is defined between the first and the last frame of the fit.
                predicted_m = prediction.trials[self.campaign.trials.index(aligned)].predicted_position_m
                positions_m[k] = np.interp(at_s, aligned.data.time_s, predicted_m, math.nan, math.nan)
        said = [
            f'<span style="border-bottom:3px solid {colour}">{name} {1e3 * (m - aligned.origin_m):.1f} mm</span>'
            for (name, colour, _), m in zip(EDGES, positions_m, strict=True)
            if math.isfinite(m)
        ]
        if frame < len(view.track):
            if with_flag(view.track["flag"], "corrected")[frame]:
                said.append("corrected by hand")
            along_px = view.along_px(positions_m)
            along_px[0] = view.track["edge_px"].iloc[frame]
            self._draw_lines(view, self._film.scale, frame, along_px)
        since_s = at_s - aligned.release_s
        when = f"{1e3 * since_s:.1f} ms since release" if since_s >= 0 else f"−{-1e3 * since_s:.1f} ms, before release"
        self.caption.text = f"<p>{when} · {' · '.join(said)}</p>"
        self._instant(since_s)

    def _draw_lines(self, view: RecordingView, scale: float, frame: int, along_px: Floats) -> None:
        """Draw a line across the vine for each of `EDGES`; the picture may be smaller than the recording."""
        lines: Columns = {"xs": [], "ys": [], "colour": [], "dash": []}
        for (name, colour, dash), px in zip(EDGES, along_px, strict=True):
            if math.isfinite(px) and not (name == "comparison" and self._reference is self._now):
                ends = [[scale * end - 0.5 * (1 - scale) for end in of_one] for of_one in view.across(float(px), frame)]
                for key, value in zip(lines, (*ends, colour, dash), strict=True):
                    lines[key].append(value)
        self._edges.data = lines

    def close(self) -> None:
        """Stop decoding, and let the recording go."""
        if self._job is not None:
            self._job.cancel()
        self._job, self._film, self._view = None, None, None
