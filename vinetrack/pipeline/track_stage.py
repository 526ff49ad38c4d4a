"""The command `vinetrack track`: the leading edge of a single recording as a table, a strip figure and a clip."""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vinetrack.core.numbers import number
from vinetrack.core.problems import UserError
from vinetrack.core.records import UNUSABLE_FLAGS, PictureAxis, Trial, with_flag
from vinetrack.core.tables import write_bytes, write_csv
from vinetrack.experiment.settings import ExperimentSettings, OverlaySettings, read_experiment_settings

if TYPE_CHECKING:
    import pandas as pd

    from vinetrack.video.frames import Recording
    from vinetrack.video.measure import Measurement

TABLE, STRIP, CLIP = "track.csv", "strip.png", "overlay.mp4"  # Names of the output files


@dataclass(frozen=True, kw_only=True)
class TrackOptions:
    """Options of the command; NaN and None for those not given. `fps` is the capture rate, `exposure_us` the exposure
    of a frame. The scale is `mm_per_px`, or the `calibration:` of the settings file `calibration`. `body`: the object
    moves as a whole. `out` is the output folder.
    """

    fps: float = math.nan
    exposure_us: float = math.nan
    mm_per_px: float = math.nan
    calibration: Path | None = None
    axis: PictureAxis | None = None
    frames_used: tuple[int, int] | None = None
    body: bool = False
    out: Path | None = None

    @property
    def scaled(self) -> bool:
        """Whether there is a scale, so that positions are also given in metres."""
        return math.isfinite(self.mm_per_px) or self.calibration is not None


def track_file(path: Path, options: TrackOptions, say: Callable[[str], None]) -> dict[str, Any]:
    """Track the leading edge of one recording; write its table, strip and clip. Returns mapping with facts about the
    file, results of tracking, and paths of output files, units in the keys.
    """
    from vinetrack.video.frames import RecordingError, inspect_recording
    from vinetrack.video.measure import measure_recording

    settings, folder = _calibration(options)
    try:
        recording = inspect_recording(_recording_path(path))
        rate = _capture_fps(recording, options)
        recording_facts = _recording_facts(recording, rate)
        for line in _recording_lines(recording_facts):
            say(line)
        trial = Trial(
            name=path.stem,
            video=recording.path,
            capture_fps=rate if math.isfinite(rate) else 1.0,
            capture_fps_is_playback=True,
            exposure_s=options.exposure_us / 1e6 if math.isfinite(rate) else math.nan,
            # Without a scale, the unit of length is one pixel.
            m_per_px=options.mm_per_px / 1e3 if options.scaled else 1.0,
            travel_ratio=1.0 if options.body else 2.0,
            axis=options.axis,
            frames_used=options.frames_used,
        )
        measurement = measure_recording(trial, settings, folder)
        if not math.isfinite(rate):
            unknown = np.full(len(measurement.tracking.track.time_s), math.nan)
            track = replace(measurement.tracking.track, time_s=unknown)
            measurement = replace(measurement, tracking=replace(measurement.tracking, track=track))
    except RecordingError as error:
        raise UserError(str(error)) from None
    table = _table(measurement, options.scaled)
    written = _write(options.out or Path(f"{recording.path.stem}_track"), measurement, table, options.scaled, rate)
    tracking_facts = _tracking_facts(measurement, table, options, rate)
    for line in _tracking_lines(tracking_facts):
        say(line)
    say("Written: " + ", ".join(map(str, written.values())))
    return recording_facts | tracking_facts | {"written": written}


def _recording_path(path: Path) -> Path:
    """Return the path if it can be a single recording."""
    from vinetrack.video.frames import CONTAINERS, IMAGES

    if not path.exists():
        parent = path.parent
        names = sorted(entry.name for entry in parent.iterdir()) if parent.is_dir() else []
        near = difflib.get_close_matches(path.name, names, 1, 0.5)
        remedy = f"did you mean {parent / near[0]}?" if near else "check its folder and its name"
        raise UserError(f"{path}: there is no such file or folder; {remedy}")
    if path.is_dir():
        inside = sorted(entry for entry in path.iterdir() if entry.is_file() and not entry.name.startswith("."))
        films = [entry for entry in inside if entry.suffix.lower() in CONTAINERS]
        if films and not any(entry.suffix.lower() in IMAGES for entry in inside):
            count = "a film is" if len(films) == 1 else f"{len(films)} films are"
            raise UserError(f"{path}: a folder in which {count}; name one file, such as {films[0]}")
        if not inside:
            raise UserError(f"{path}: the folder holds no files; name a film, or a folder of numbered pictures")
    return path


def _calibration(options: TrackOptions) -> tuple[ExperimentSettings, Path]:
    """Return settings with only the calibration, and the folder to which the path of its picture is relative."""
    if options.calibration is None:
        return ExperimentSettings(), Path()
    if math.isfinite(options.mm_per_px):
        raise UserError("--mm-per-px and --calibration are two scales: give one")
    file = options.calibration
    if file.is_dir():
        file = file / "experiment.yaml"
    if not file.is_file():
        raise UserError(f"{file}: there is no such file; --calibration takes an experiment.yaml, or its folder")
    calibration = read_experiment_settings(file).calibration
    if calibration is None:
        raise UserError(f"{file}: has no calibration; add one, or give --mm-per-px")
    return ExperimentSettings(calibration=calibration), file.parent


def _capture_fps(recording: Recording, options: TrackOptions) -> float:
    """Capture rate, Hz: that stated by the file, else that given by the user; NaN if neither is known."""
    stated_fps = recording.capture_fps
    if stated_fps is None:
        return options.fps
    if math.isfinite(options.fps) and abs(options.fps / stated_fps - 1) > 1e-3:
        raise UserError(
            f"{recording.path.name}: --fps is {options.fps:g}, but the file states a capture rate of {stated_fps:g}; "
            "leave --fps out"
        )
    return stated_fps


def _recording_facts(recording: Recording, rate: float) -> dict[str, Any]:
    n_frames = recording.declared_frames
    return {
        "recording": recording.path,
        "width_px": recording.width,
        "height_px": recording.height,
        "bit_depth": recording.bit_depth,
        "declared_frames": n_frames,
        "playback_fps": recording.playback_fps,
        "capture_fps": rate,
        "capture_fps_from_file": recording.capture_fps is not None,
        "exposure_us": math.nan if recording.exposure_s is None else 1e6 * recording.exposure_s,
        "duration_s": math.nan if n_frames is None else n_frames / rate,
    }


def _recording_lines(facts: dict[str, Any]) -> list[str]:
    n_frames, playback_fps = facts["declared_frames"], facts["playback_fps"]
    picture = f"{facts['width_px']} × {facts['height_px']} px, {facts['bit_depth']} bit"
    count = "an unknown number of frames" if n_frames is None else f"{n_frames} frames"
    first = f"{facts['recording']}: {count} of {picture}"
    if math.isfinite(facts["capture_fps"]):
        origin = "stated by the file" if facts["capture_fps_from_file"] else "as given"
        duration = f": {number(facts['duration_s'])} s" if math.isfinite(facts["duration_s"]) else ""
        second = f"Captured at {facts['capture_fps']:g} frames per second, {origin}{duration}"
        if math.isfinite(facts["exposure_us"]):
            second += f"; exposure {facts['exposure_us']:g} µs"
    else:
        playback = f"; it plays at {playback_fps:.4g} per second" if playback_fps else ""
        second = f"Capture rate unknown{playback}: without --fps there are no times"
    return [f"{first}.", f"{second}."]


def _table(measurement: Measurement, scaled: bool) -> pd.DataFrame:
    """One row per frame: the edge along the axis and in the picture, with errors, and in metres if there is a scale."""
    import pandas as pd

    tracking = measurement.tracking
    track = tracking.track
    edge_xy_px = tracking.axis.points(track.edge_px + tracking.shake_px)
    systematic_m = track.lead_position_systematic_m
    assert systematic_m is not None
    columns = {
        "frame": np.arange(len(track.time_s)),
        "time_s": track.time_s,
        "edge_px": track.edge_px,
        "edge_sigma_px": track.lead_position_sigma_m / measurement.m_per_px,
        "edge_systematic_px": systematic_m / measurement.m_per_px,
        "x_px": edge_xy_px[:, 0],
        "y_px": edge_xy_px[:, 1],
    }
    if scaled:
        columns |= {
            "position_m": track.lead_position_m,
            "sigma_m": track.lead_position_sigma_m,
            "systematic_m": systematic_m,
        }
    return pd.DataFrame(columns | {"flag": track.flag})


def _write(
    folder: Path, measurement: Measurement, table: pd.DataFrame, scaled: bool, rate: float
) -> dict[str, Path]:  # fmt: skip
    from vinetrack.figures.overlay import TRACKED, ClipView, Edge
    from vinetrack.figures.strip_figure import draw_strip
    from vinetrack.figures.style import render
    from vinetrack.pipeline.overlays_stage import MARGIN_FRAMES, draw_over, frames_to_show, playback_rate
    from vinetrack.video.write import write_clip

    if folder.exists() and not folder.is_dir():
        raise UserError(f"{folder}: is a file; name a folder with --out")
    tracking, recording = measurement.tracking, measurement.recording
    name, settings = recording.path.name, OverlaySettings()
    written = {"table": folder / TABLE, "strip": folder / STRIP, "clip": folder / CLIP}
    write_csv(written["table"], table)
    m_per_px = measurement.m_per_px if scaled else math.nan
    write_bytes(written["strip"], render(draw_strip(name, tracking, m_per_px), ("png",))["png"])
    shown = frames_to_show(table)
    play_fps, stride = playback_rate(len(shown), settings.seconds)
    size = recording.width, recording.height
    tube_px = tracking.tube_width_px if math.isfinite(tracking.tube_width_px) else tracking.axis.width_px
    tube_px = tube_px if math.isfinite(tube_px) else 0.2 * min(size)
    slowed = rate / play_fps / stride
    view = ClipView(name, tracking.axis, tube_px, size, 1e3 * m_per_px, slowed, settings.width_px)
    edges = [Edge("tracked edge", TRACKED, tracking.track.edge_px + tracking.shake_px)]
    time_s = tracking.track.time_s
    time_ms = 1e3 * (time_s - time_s[min(shown.start + MARGIN_FRAMES, len(time_s) - 1)])
    write_clip(written["clip"], draw_over(recording, view, edges, time_ms, shown, stride), play_fps)
    return written


def _tracking_facts(
    measurement: Measurement, table: pd.DataFrame, options: TrackOptions, rate: float
) -> dict[str, Any]:
    from vinetrack.video.curved_axis import axis_entry

    tracking = measurement.tracking
    edge_px = tracking.track.edge_px
    usable = np.isfinite(edge_px)
    for flag in UNUSABLE_FLAGS:
        usable &= ~with_flag(tracking.track.flag, flag)
    moving = usable & ~with_flag(tracking.track.flag, "before_release")
    frame = np.flatnonzero(usable)
    scale = measurement.m_per_px if options.scaled else math.nan
    growth_px = float(np.ptp(edge_px[usable])) if usable.any() else math.nan
    steps = np.diff(edge_px[frame]) / np.diff(frame) if frame.size > 1 else np.full(1, math.nan)
    sigma = table["edge_sigma_px"].to_numpy()[moving]
    axis = tracking.axis
    return {
        "n_frames": len(edge_px),
        "n_known": int(usable.sum()),
        "axis": axis_entry(axis),
        "axis_given": options.axis is not None,
        "mm_per_px": 1e3 * scale,
        "scale_rel_sigma": measurement.scale_rel_sigma,
        "tube_width_px": tracking.tube_width_px,
        "growth_px": growth_px,
        "growth_mm": 1e3 * scale * growth_px,
        "fastest_px_per_frame": float(np.nanmax(steps)),
        "fastest_m_s": float(np.nanmax(steps)) * scale * rate,
        "edge_sigma_px": float(np.nanmedian(sigma)) if np.isfinite(sigma).any() else math.nan,
        "notes": list(tracking.track.notes),
    }


def _tracking_lines(facts: dict[str, Any]) -> list[str]:
    ends = (*facts["axis"]["from_px"], *facts["axis"]["to_px"])
    axis = "Axis ({:.0f}, {:.0f}) → ({:.0f}, {:.0f}) px".format(*ends)
    axis += ", a curve" if "via_px" in facts["axis"] else ""
    width = f"; tube {number(facts['tube_width_px'])} px wide" if math.isfinite(facts["tube_width_px"]) else ""
    millimetres = f" = {number(facts['growth_mm'])} mm" if math.isfinite(facts["growth_mm"]) else ""
    speed = f"{number(facts['fastest_px_per_frame'])} px per frame"
    speed += f" = {number(facts['fastest_m_s'])} m/s" if math.isfinite(facts["fastest_m_s"]) else ""
    error = f"; ± {number(facts['edge_sigma_px'], 2)} px per point" if math.isfinite(facts["edge_sigma_px"]) else ""
    return [
        f"{axis}, {'given' if facts['axis_given'] else 'found from the motion'}{width}.",
        f"Edge found in {facts['n_known']} of {facts['n_frames']} frames: it moves by "
        f"{number(facts['growth_px'])} px{millimetres}, at most {speed}{error}.",
        *(f"warning: {note}" for note in facts["notes"]),
    ]
