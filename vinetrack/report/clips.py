"""Slowed-down clips of recordings with tracked and modelled edges; and what is shown of a single recording."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from fractions import Fraction
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import UNUSABLE_FLAGS, Floats, Trial, with_flag
from vinetrack.core.tables import replacing, write_bytes, write_csv
from vinetrack.experiment.settings import OverlaySettings
from vinetrack.figures.motion_figures import TRACKED, ClipView, Edge, compose, draw_strip, levels
from vinetrack.figures.style import GREEN, SKY, VERMILLION, render
from vinetrack.narrative.verdict_text import spaced_name
from vinetrack.results.folder_layout import Results, ResultsError, read_diagnosis, read_fit, read_json, read_result
from vinetrack.tracks.importers import FEWEST_POINTS
from vinetrack.video.axis import Axis, axis_entry, axis_from_entry
from vinetrack.video.frames import Recording, RecordingError, inspect_recording, iterate_frames
from vinetrack.video.survey import Measurement

if TYPE_CHECKING:
    import pandas as pd

MARGIN_FRAMES = 8  # Frames before and after the motion that a clip shows (chosen)


def write_overlay(trial: Trial, results: Results, settings: OverlaySettings) -> Path:
    """Write the clip of one trial of a results folder; return its path."""
    track, analysed = read_result(results.track(trial.name)), read_json(results.analysed(trial.name))
    shown, line = frames_to_show(track), analysed["axis"]
    mm_per_px = float(analysed["row"]["mm_per_px"] or math.nan)
    shake_px = shake_along(line, len(track))
    edges, release_s = edges_to_draw(trial.name, results, track)
    edges = [replace(edge, along_px=edge.along_px + shake_px) for edge in edges]
    since_s = track["time_s"].to_numpy(dtype=float) - release_s
    scale = 1e3 * trial.diameter_m / mm_per_px, mm_per_px
    path = results.overlay(trial.name)
    try:
        assert trial.video is not None
        recording = inspect_recording(trial.video)
        draw_clip(path, trial.name, recording, axis_from_entry(line), *scale, edges, since_s, shown, settings)
    except RecordingError as error:
        raise ResultsError(str(error)) from None
    return path


def draw_clip(
    path: Path, title: str, recording: Recording, axis: Axis, tube_px: float, mm_per_px: float, edges: list[Edge],
    since_s: Floats, shown: range, settings: OverlaySettings,
) -> None:  # fmt: skip
    """Write a clip of the shown frames; `since_s` is the time since release. Shapes: since_s (n_frames,)."""

    def drawn() -> Iterator[NDArray[np.uint8]]:
        low = high = 0.0
        for frame, picture in islice(enumerate(iterate_frames(recording)), shown.start, shown.stop, stride):
            if high == low:
                low, high = (float(value) for value in np.percentile(picture, (0.5, 99.5)))
            yield compose(view, levels(picture, low, high), frame, 1e3 * float(since_s[frame]))

    rate = 1.0 / float(np.median(np.diff(since_s))) if len(since_s) > 1 else math.nan
    play_fps, stride = playback_rate(len(shown), settings.seconds)
    size = recording.width, recording.height
    tube_px = tube_px if math.isfinite(tube_px) else 0.2 * min(size)
    view = ClipView(title, axis, edges, tube_px, size, mm_per_px, rate / play_fps / stride, settings.width_px)
    write_clip(path, drawn(), play_fps)


def frames_to_show(track: pd.DataFrame) -> range:
    """Return the range of frames in which the edge moves, with `MARGIN_FRAMES` before and after."""
    edge = track["edge_px"].to_numpy(dtype=float)
    tracked = np.flatnonzero(np.isfinite(edge))
    if tracked.size < FEWEST_POINTS:
        raise ResultsError("its edge was not found, so there is nothing to draw: trials.csv has the reason")
    low, high = float(np.nanmin(edge)), float(np.nanmax(edge))
    start = tracked[edge[tracked] > low + 0.01 * (high - low)][0]
    end = tracked[edge[tracked] < high - 0.002 * (high - low)][-1]
    return range(max(int(start) - MARGIN_FRAMES, 0), min(int(end) + MARGIN_FRAMES, int(tracked[-1])) + 1)


def playback_rate(n_frames: int, seconds: float) -> tuple[float, int]:
    """Return frames per second of a clip of about `seconds`, and of how many frames of the film it shows one."""
    fastest_fps, slowest_fps = 30.0, 4.0  # Limits of the playback rate of a clip, frames per second (chosen)
    stride = max(round(n_frames / seconds / fastest_fps), 1)
    return float(np.clip(n_frames / stride / seconds, slowest_fps, fastest_fps)), stride


def shake_along(line: Mapping[str, Any], n_frames: int) -> Floats:
    """Return the shift of each frame along the axis by camera shake, px, shape (n_frames,); 0 at rest."""
    stored_px = np.asarray(line.get("shake_px", ()), dtype=float)[:n_frames]
    return np.pad(stored_px, (0, n_frames - stored_px.size))


def edges_to_draw(trial: str, results: Results, track: pd.DataFrame) -> tuple[list[Edge], float]:
    """Return the tracked edge, the predicted edges if there are any, and the time of release, s."""
    edge_px = track["edge_px"].to_numpy(dtype=float)
    edges, first_moving = [Edge("tracked edge", TRACKED, edge_px)], frames_to_show(track).start + MARGIN_FRAMES
    release_s = float(track["time_s"].iloc[min(first_moving, len(track) - 1)])
    path = results.predictions(trial)
    if path.exists():
        predicted, to_px = read_result(path), position_to_px(track)
        diagnosis = read_diagnosis(results)
        added = " and ".join(map(spaced_name, diagnosis.effects)) if diagnosis is not None else ""
        models = [("model_before_m", "model in use", VERMILLION, 2.0)]
        models += [("model_after_m", f"with {added}", SKY, 1.4)] if added else []
        time_s, measured_m = (track[name].to_numpy(dtype=float) for name in ("time_s", "lead_position_m"))
        for column, label, colour, reach in models:
            prediction = predicted[["time_s", column]].dropna()
            if not prediction.empty:
                # There is no prediction before the first and after the last frame of the fit.
                ends = {"left": math.nan, "right": math.nan}
                position_m = np.interp(time_s, prediction["time_s"], prediction[column], **ends)
                edges.append(Edge(label, colour, to_px(position_m), 1e3 * (position_m - measured_m), reach))
        fitted = read_fit(results).trials if results.fit.exists() else {}
        release_s = fitted[trial].release_s if trial in fitted else release_s
    by_hand = with_flag(track["flag"], "corrected")
    if by_hand.any():
        edges.append(Edge("corrected by hand", GREEN, np.where(by_hand, edge_px, math.nan)))
    return edges, release_s


def position_to_px(track: pd.DataFrame) -> Any:
    """Return the quadratic (lens, tilt) that converts metres to pixels along the axis, fitted to a track."""
    both = track[["lead_position_m", "edge_px"]].dropna()
    metres, px = both["lead_position_m"].to_numpy(dtype=float), both["edge_px"].to_numpy(dtype=float)
    if len(both) < FEWEST_POINTS or np.ptp(metres) <= 0:
        raise ResultsError("too few of its positions are known in pixels and in metres")
    middle, half = (metres.max() + metres.min()) / 2, np.ptp(metres) / 2
    return np.polynomial.Polynomial.fit(metres, px, 2, domain=[middle - half, middle + half])


# ------------------------------------------------------------------------------
# A single recording, without an experiment: its edge as a table, the strip, the clip; and what it is, in numbers.


def write_recording(folder: Path, measured: Measurement, scaled: bool) -> dict[str, Path]:
    """Write the edge of every frame along the axis and in the picture, in metres if scaled; the strip; and the clip."""
    import pandas as pd

    tracking, recording, m_per_px = measured.tracking, measured.recording, measured.m_per_px
    track, axis, name = tracking.track, tracking.axis, recording.path.name
    assert track.lead_position_systematic_m is not None
    along_px = track.edge_px + tracking.shake_px
    columns = {
        "frame": np.arange(len(track.time_s)),
        "time_s": track.time_s,
        "edge_px": track.edge_px,
        "edge_sigma_px": track.lead_position_sigma_m / m_per_px,
        "edge_systematic_px": track.lead_position_systematic_m / m_per_px,
        **dict(zip(("x_px", "y_px"), axis.points(along_px).T, strict=True)),
    }
    if scaled:
        columns |= {"position_m": track.lead_position_m, "sigma_m": track.lead_position_sigma_m}
        columns |= {"systematic_m": track.lead_position_systematic_m}
    content = pd.DataFrame(columns | {"flag": track.flag})
    written = {"table": folder / "track.csv", "strip": folder / "strip.png", "clip": folder / "overlay.mp4"}
    write_csv(written["table"], content)
    m_per_px = m_per_px if scaled else math.nan
    write_bytes(written["strip"], render(draw_strip(name, tracking, m_per_px), ("png",))["png"])
    shown, edges = frames_to_show(content), [Edge("tracked edge", TRACKED, along_px)]
    since_s = track.time_s - track.time_s[min(shown.start + MARGIN_FRAMES, len(track.time_s) - 1)]
    scale = tracking.tube_width_px if math.isfinite(tracking.tube_width_px) else axis.width_px, 1e3 * m_per_px
    draw_clip(written["clip"], name, recording, axis, *scale, edges, since_s, shown, OverlaySettings())
    return written


def recording_facts(measured: Measurement, rate: float, mm_per_px: float) -> dict[str, Any]:
    """What a recording is and what was found in it, by names with units; NaN or None where not known."""
    recording, tracking, track = measured.recording, measured.tracking, measured.tracking.track
    usable = np.isfinite(track.edge_px) & ~with_flag(track.flag, *UNUSABLE_FLAGS)
    frame, edge_px = np.flatnonzero(usable), track.edge_px[usable]
    growth_px = float(np.ptp(edge_px)) if frame.size else math.nan
    fastest = float(np.nanmax(np.diff(edge_px) / np.diff(frame))) if frame.size > 1 else math.nan
    sigma_px = track.lead_position_sigma_m[usable & ~with_flag(track.flag, "before_release")] / measured.m_per_px
    return {
        "recording": recording.path,
        "width_px": recording.width,
        "height_px": recording.height,
        "bit_depth": recording.bit_depth,
        "playback_fps": recording.playback_fps,
        "capture_fps": rate,
        "exposure_us": math.nan if recording.exposure_s is None else 1e6 * recording.exposure_s,
        "duration_s": len(track.edge_px) / rate,
        "n_frames": len(track.edge_px),
        "n_known": frame.size,
        "axis": axis_entry(tracking.axis),
        "mm_per_px": mm_per_px,
        "scale_rel_sigma": measured.scale_rel_sigma,
        "tube_width_px": tracking.tube_width_px,
        "growth_px": growth_px,
        "growth_mm": mm_per_px * growth_px,
        "fastest_px_per_frame": fastest,
        "fastest_m_s": fastest * mm_per_px / 1e3 * rate,
        "edge_sigma_px": float(np.nanmedian(sigma_px)) if np.isfinite(sigma_px).any() else math.nan,
        "notes": list(track.notes),
    }


def write_clip(path: Path, pictures: Iterable[NDArray[np.uint8]], play_fps: float) -> int:
    """Write RGB pictures of shape (height, width, 3), all of one size and with even sides, as H.264 in MP4 with its
    index in front, which any player, browser and slide plays; the whole clip or nothing. Returns their number.
    """
    import av
    import cv2

    count, stream = 0, None
    with (
        replacing(path) as draft,
        av.open(str(draft), "w", format="mp4", options={"movflags": "+faststart"}) as container,
    ):
        for count, picture in enumerate(pictures, 1):
            if stream is None:
                height, width = picture.shape[:2]
                if height % 2 or width % 2:
                    raise ValueError(f"a clip needs pictures of even sides, not {width} × {height}")
                stream = container.add_stream("libx264", rate=Fraction(play_fps).limit_denominator(1001))
                stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
                # Without mbtree=0 the same pictures are encoded to different bytes (measured).
                options = {"preset": "superfast", "crf": "26", "profile": "high", "tune": "animation"}
                stream.options, context = {**options, "mbtree": "0"}, stream.codec_context
                context.thread_count = 1
                context.colorspace = context.color_primaries = context.color_trc = 6  # BT.601, as OpenCV converts
            planes = np.asarray(cv2.cvtColor(picture, cv2.COLOR_RGB2YUV_I420), dtype=np.uint8)
            frame = av.VideoFrame.from_ndarray(planes, format="yuv420p")
            frame.pts = count - 1
            container.mux(stream.encode(frame))
        if stream is None:
            raise ValueError("there is no picture to make a clip of")
        container.mux(stream.encode())
    return count
