"""Slowed-down clips of recordings with tracked and modelled edges, `overlays/<trial>.mp4`."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.problems import INTERNAL_ERROR, UserError
from vinetrack.core.records import UNUSABLE_FLAGS, Floats, PictureAxis, Trial, hand_corrected, with_flag
from vinetrack.core.tables import write_bytes, write_csv
from vinetrack.core.units import number
from vinetrack.experiment.folder import Experiment
from vinetrack.experiment.settings import ExperimentSettings, OverlaySettings, read_experiment_settings
from vinetrack.experiment.sheet import closest_entry
from vinetrack.figures.overlay import AFTER, BEFORE, TRACKED, ClipView, Edge, compose, draw_strip, levels
from vinetrack.figures.style import GREEN, render
from vinetrack.narrative.verdict_text import spaced_name
from vinetrack.pipeline.stages import Job, map_unordered
from vinetrack.results.folder_layout import (
    Results,
    ResultsError,
    read_diagnosis,
    read_fit,
    read_json,
    read_result,
    read_source_experiment,
)
from vinetrack.video.axis import Axis
from vinetrack.video.curved_axis import axis_entry, axis_from_entry
from vinetrack.video.frames import CONTAINERS, IMAGES, Recording, RecordingError, inspect_recording, iterate_frames
from vinetrack.video.survey import Measurement, measure_recording
from vinetrack.video.write import write_clip

if TYPE_CHECKING:
    import pandas as pd


log = logging.getLogger(__name__)

MARGIN_FRAMES = 8  # Frames before and after the motion that a clip shows (chosen)
FEWEST_POINTS = 5  # Fewest points known in pixels and in metres for drawing a prediction into the picture (derived)


def draw_overlays(job: Job) -> list[str]:
    """Write the clips that the settings request, and again those that there are; a line for each that could not be."""
    experiment, results, settings = job.experiment, Results(job.results), job.settings.overlays
    chosen = chosen_trials(experiment, results, settings.of)
    for path in results.overlays.glob("*.mp4"):  # of a trial that is not tracked any more
        if path.stem not in chosen:
            path.unlink()
    work = partial(_try_overlay, results=results, settings=settings)
    messages = []
    for count, line in enumerate(map_unordered(work, [experiment.trial(name) for name in chosen], job.threads), 1):
        messages += [f"  {line}"] if line else []
        job.say(f"{count} of {len(chosen)} clips")
    return sorted(messages)


def overlay_one(folder: Path, trial: str, experiment: Path | None = None, seconds: float = math.nan) -> Path:
    """Write the clip of one trial of a results folder with the settings of its run; return its path."""
    results, read = Results(folder), read_source_experiment(folder, experiment)
    filmed = [one.name for one in read.trials if one.video is not None]
    if trial not in filmed:
        existing = f"there are {', '.join(filmed[:6])}{' …' if len(filmed) > 6 else ''}" if filmed else "there are none"
        raise ResultsError(f"{trial!r} is not a trial with a recording in {read.folder}: {existing}")
    of_run = read_json(results.provenance).get("settings") or {}
    asked = {"seconds": seconds} if math.isfinite(seconds) else {}
    return _write_overlay(read.trial(trial), results, OverlaySettings(**(of_run.get("overlays") or {}) | asked))


def chosen_trials(experiment: Experiment, results: Results, of: str) -> list[str]:
    """Return the names of the trials to draw: the first tracked recording of every condition, all, or none; and those
    whose clip is there already, which would show another model otherwise.
    """
    trials = read_result(results.trials)
    tracked = set(trials.loc[~trials["status"].isin(("failed", "left_out")), "trial"])
    filmed = {trial.name: trial.condition for trial in experiment.trials if trial.video and trial.name in tracked}
    first = {condition: name for name, condition in reversed(filmed.items())}
    wanted: dict[str, Collection[str]] = {"all": filmed.keys(), "one_per_condition": first.values(), "none": ()}
    return [name for name in filmed if name in wanted[of] or results.overlay(name).exists()]


def _try_overlay(trial: Trial, results: Results, settings: OverlaySettings) -> str:
    """Write the clip of one trial; return why it could not be made, or blank."""
    try:
        _write_overlay(trial, results, settings)
    except ResultsError as error:
        log.warning("%s: no clip: %s", trial.name, error)
        return f"{trial.name}: no clip: {error}"
    except Exception:
        log.exception("%s: no clip", trial.name)
        return f"{trial.name}: no clip: {INTERNAL_ERROR}"
    return ""


def _write_overlay(trial: Trial, results: Results, settings: OverlaySettings) -> Path:
    """Write the clip of one trial; return its path."""
    track, analysed = read_result(results.track(trial.name)), read_json(results.analysed(trial.name))
    shown, line = frames_to_show(track), analysed.get("axis")
    if line is None:
        raise ResultsError(f"{results.analysed(trial.name)} does not state the axis: run snakemake again")
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
        _write_clip(path, trial.name, recording, axis_from_entry(line), *scale, edges, since_s, shown, settings)
    except RecordingError as error:
        raise ResultsError(str(error)) from None
    return path


def _write_clip(
    path: Path, title: str, recording: Recording, axis: Axis, tube_px: float, mm_per_px: float, edges: list[Edge],
    since_s: Floats, shown: range, settings: OverlaySettings,
) -> None:  # fmt: skip
    """Write a clip of the shown frames; `since_s` is the time since release. Shapes: since_s (n_frames,)."""
    rate = 1.0 / float(np.median(np.diff(since_s))) if len(since_s) > 1 else math.nan
    play_fps, stride = playback_rate(len(shown), settings.seconds)
    size = recording.width, recording.height
    tube_px = tube_px if math.isfinite(tube_px) else 0.2 * min(size)
    view = ClipView(title, axis, tube_px, size, mm_per_px, rate / play_fps / stride, settings.width_px)
    write_clip(path, draw_over(recording, view, edges, 1e3 * since_s, shown, stride), play_fps)


def frames_to_show(track: pd.DataFrame) -> range:
    """Return the range of frames in which the edge moves, with `MARGIN_FRAMES` before and after."""
    edge = track["edge_px"].to_numpy(dtype=float)
    tracked = np.flatnonzero(np.isfinite(edge))
    if tracked.size < FEWEST_POINTS:
        raise ResultsError("its edge was not found, so there is nothing to draw")
    low, high = float(np.nanmin(edge)), float(np.nanmax(edge))
    start = tracked[edge[tracked] > low + 0.01 * (high - low)][0]
    end = tracked[edge[tracked] < high - 0.002 * (high - low)][-1]
    return range(max(int(start) - MARGIN_FRAMES, 0), min(int(end) + MARGIN_FRAMES, int(tracked[-1])) + 1)


def playback_rate(n_frames: int, seconds: float) -> tuple[float, int]:
    """Return frames per second of a clip of about `seconds`, and of how many frames of the film it shows one."""
    fastest_fps, slowest_fps = 30.0, 4.0  # Limits of the playback rate of a clip, frames per second (chosen)
    stride = max(round(n_frames / seconds / fastest_fps), 1)
    return float(np.clip(n_frames / stride / seconds, slowest_fps, fastest_fps)), stride


def draw_over(
    recording: Recording, view: ClipView, edges: list[Edge], time_ms: Floats, shown: range, stride: int
) -> Iterator[NDArray[np.uint8]]:
    """Draw edges over the frames of a recording. Shapes: time_ms (n_frames,)."""
    low = high = 0.0
    for frame, picture in enumerate(iterate_frames(recording)):
        if frame >= shown.stop:
            break
        if frame < shown.start or (frame - shown.start) % stride:
            continue
        if high == low:
            low, high = (float(value) for value in np.percentile(picture, (0.5, 99.5)))
        yield compose(view, levels(picture, low, high), frame, float(time_ms[frame]), edges)


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
        models = [("model_before_m", "initial model", BEFORE)]
        models += [("model_after_m", f"with {added}", AFTER)] if added else []
        time_s, measured_m = (track[name].to_numpy(dtype=float) for name in ("time_s", "lead_position_m"))
        for column, label, colour in models:
            prediction = predicted[["time_s", column]].dropna()
            if not prediction.empty:
                # There is no prediction before the first and after the last frame of the fit.
                ends = {"left": math.nan, "right": math.nan}
                position_m = np.interp(time_s, prediction["time_s"], prediction[column], **ends)
                edges.append(Edge(label, colour, to_px(position_m), 1e3 * (position_m - measured_m)))
        fitted = read_fit(results).trials if results.fit.exists() else {}
        release_s = fitted[trial].release_s if trial in fitted else release_s
    by_hand = hand_corrected(track["flag"])
    if by_hand.any():
        edges.append(Edge("corrected by hand", GREEN, np.where(by_hand, edge_px, math.nan), by_hand=True))
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
# The command `vinetrack track`: the leading edge of a single recording as a table, a strip figure and a clip.


def track_file(
    path: Path, say: Callable[[str], None], *, capture_fps: float = math.nan, exposure_us: float = math.nan,
    mm_per_px: float = math.nan, calibration: Path | None = None, axis: PictureAxis | None = None,
    frames_used: tuple[int, int] | None = None, body: bool = False, out: Path | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Track the leading edge of one recording; write table, strip and clip in `out`. NaN and None for what is not
    given; the scale is `mm_per_px` or the `calibration:` of a settings file. Returns facts, units in the keys.
    """
    settings, folder = _calibration(calibration, mm_per_px)
    scaled = math.isfinite(mm_per_px) or calibration is not None
    try:
        recording = inspect_recording(_recording_path(path))
        rate = _capture_fps(recording, capture_fps)
        n_frames = recording.declared_frames
        recording_facts = {
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
        for line in _recording_lines(recording_facts):
            say(line)
        trial = Trial(
            name=path.stem,
            video=recording.path,
            capture_fps=rate if math.isfinite(rate) else 1.0,
            capture_fps_is_playback=True,
            exposure_s=exposure_us / 1e6 if math.isfinite(rate) else math.nan,
            # Without a scale, the unit of length is one pixel.
            m_per_px=mm_per_px / 1e3 if scaled else 1.0,
            travel_ratio=1.0 if body else 2.0,
            axis=axis,
            frames_used=frames_used,
        )
        measurement = measure_recording(trial, settings, folder)
    except RecordingError as error:
        raise UserError(str(error)) from None
    if not math.isfinite(rate):
        tracking = measurement.tracking
        untimed = replace(tracking.track, time_s=np.full(len(tracking.track.time_s), math.nan))
        measurement = replace(measurement, tracking=replace(tracking, track=untimed))
    table = _table(measurement, scaled)
    written = _write(out or Path(f"{recording.path.stem}_track"), measurement, table, scaled)
    tracking_facts = _tracking_facts(measurement, table, axis is not None, scaled, rate)
    for line in _tracking_lines(tracking_facts):
        say(line)
    say("Written: " + ", ".join(map(str, written.values())))
    return recording_facts | tracking_facts | {"written": written}


def _recording_path(path: Path) -> Path:
    """Return the path if it can be a single recording."""
    if not path.exists():
        near = closest_entry(path)
        remedy = f"did you mean {path.with_name(near)}?" if near else "check its folder and its name"
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


def _calibration(file: Path | None, mm_per_px: float) -> tuple[ExperimentSettings, Path]:
    """Return settings with only the calibration, and the folder to which the path of its picture is relative."""
    if file is None:
        return ExperimentSettings(), Path()
    if math.isfinite(mm_per_px):
        raise UserError("--mm-per-px and --calibration are two scales: give one")
    if file.is_dir():
        file = file / "experiment.yaml"
    if not file.is_file():
        raise UserError(f"{file}: there is no such file; --calibration takes an experiment.yaml, or its folder")
    calibration = read_experiment_settings(file).calibration
    if calibration is None:
        raise UserError(f"{file}: has no calibration; add one, or give --mm-per-px")
    return ExperimentSettings(calibration=calibration), file.parent


def _capture_fps(recording: Recording, given_fps: float) -> float:
    """Capture rate, Hz: that stated by the file, else that given by the user; NaN if neither is known."""
    stated_fps = recording.capture_fps
    if stated_fps is None:
        return given_fps
    if math.isfinite(given_fps) and abs(given_fps / stated_fps - 1) > 1e-3:
        raise UserError(
            f"{recording.path.name}: --capture-fps is {given_fps:g}, but the file states a capture rate of "
            f"{stated_fps:g}; leave --capture-fps out"
        )
    return stated_fps


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
        second = f"Capture rate unknown{playback}: without --capture-fps there are no times"
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
        columns |= {"position_m": track.lead_position_m, "sigma_m": track.lead_position_sigma_m}
        columns |= {"systematic_m": systematic_m}
    return pd.DataFrame(columns | {"flag": track.flag})


def _write(folder: Path, measurement: Measurement, table: pd.DataFrame, scaled: bool) -> dict[str, Path]:
    if folder.exists() and not folder.is_dir():
        raise UserError(f"{folder}: is a file; name a folder with --out")
    tracking, recording = measurement.tracking, measurement.recording
    name, settings = recording.path.name, OverlaySettings()
    written = {"table": folder / "track.csv", "strip": folder / "strip.png", "clip": folder / "overlay.mp4"}
    write_csv(written["table"], table)
    m_per_px = measurement.m_per_px if scaled else math.nan
    write_bytes(written["strip"], render(draw_strip(name, tracking, m_per_px), ("png",))["png"])
    shown, time_s = frames_to_show(table), tracking.track.time_s
    tube_px = tracking.tube_width_px if math.isfinite(tracking.tube_width_px) else tracking.axis.width_px
    edges = [Edge("tracked edge", TRACKED, tracking.track.edge_px + tracking.shake_px)]
    since_s = time_s - time_s[min(shown.start + MARGIN_FRAMES, len(time_s) - 1)]
    scale = tube_px, 1e3 * m_per_px
    _write_clip(written["clip"], name, recording, tracking.axis, *scale, edges, since_s, shown, settings)
    return written


def _tracking_facts(
    measurement: Measurement, table: pd.DataFrame, axis_given: bool, scaled: bool, rate: float
) -> dict[str, Any]:
    tracking = measurement.tracking
    edge_px = tracking.track.edge_px
    usable = np.isfinite(edge_px) & ~with_flag(tracking.track.flag, *UNUSABLE_FLAGS)
    moving = usable & ~with_flag(tracking.track.flag, "before_release")
    frame = np.flatnonzero(usable)
    scale = measurement.m_per_px if scaled else math.nan
    growth_px = float(np.ptp(edge_px[usable])) if usable.any() else math.nan
    steps = np.diff(edge_px[frame]) / np.diff(frame) if frame.size > 1 else np.full(1, math.nan)
    sigma = table["edge_sigma_px"].to_numpy()[moving]
    axis = tracking.axis
    return {
        "n_frames": len(edge_px),
        "n_known": int(usable.sum()),
        "axis": axis_entry(axis),
        "axis_given": axis_given,
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
