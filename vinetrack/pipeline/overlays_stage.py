"""Slowed-down clips of recordings with tracked and modelled edges, `overlays/<trial>.mp4`."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.problems import INTERNAL_ERROR
from vinetrack.core.records import hand_corrected
from vinetrack.figures.style import GREEN
from vinetrack.narrative.verdict_summary import spaced_name
from vinetrack.pipeline.pool import map_trials
from vinetrack.results.folder_layout import Results, ResultsError, read_json, read_result
from vinetrack.results.stored_diagnosis import read_diagnosis
from vinetrack.results.stored_fit import read_fit

if TYPE_CHECKING:
    import pandas as pd

    from vinetrack.core.records import Trial
    from vinetrack.experiment.folder import Experiment
    from vinetrack.experiment.settings import OverlaySettings
    from vinetrack.figures.overlay import ClipView, Edge
    from vinetrack.video.frames import Recording

log = logging.getLogger(__name__)

Floats = NDArray[np.float64]

FASTEST_FPS, SLOWEST_FPS = 30.0, 4.0  # Limits of the playback rate of a clip, frames per second (chosen)

MARGIN_FRAMES = 8  # Frames before and after the motion that a clip shows (chosen)

FEWEST_POINTS = 5  # Fewest points known in pixels and in metres for drawing a prediction into the picture (derived)


def draw_overlays(experiment: Experiment, folder: Path, settings: OverlaySettings, n_workers: int = 1) -> list[str]:
    """Write the clips that the settings request; return a line for every clip that could not be made. A recording that
    cannot be drawn does not stop the others. The folder is created even without clips.
    """
    results = Results(folder)
    results.overlays.mkdir(parents=True, exist_ok=True)
    chosen = chosen_trials(experiment, results, settings.of)
    work = partial(_try_overlay, results=results, settings=settings)
    messages = map_trials(work, [experiment.trial(name) for name in chosen], n_workers, "overlay clips")
    return [line for line in messages if line]


def overlay_one(folder: Path, trial: str, experiment: Path | None = None, seconds: float | None = None) -> Path:
    """Write the clip of one trial of a results folder with the settings of its run; return its path."""
    from vinetrack.experiment.folder import read_experiment
    from vinetrack.experiment.settings import OverlaySettings

    results = Results(folder)
    provenance = read_json(results.provenance)
    read = read_experiment(experiment or Path(str(provenance["experiment"])))
    filmed = [filmed_trial.name for filmed_trial in read.trials if filmed_trial.video is not None]
    if trial not in filmed:
        existing = f"there are {', '.join(filmed[:6])}{' …' if len(filmed) > 6 else ''}" if filmed else "there are none"
        raise ResultsError(f"{trial!r} is not a trial with a recording in {read.folder}: {existing}")
    settings = OverlaySettings(**(provenance.get("settings") or {}).get("overlays") or {})
    if seconds is not None:
        settings = settings.model_copy(update={"seconds": seconds})
    return _write_overlay(read.trial(trial), results, settings)


def chosen_trials(experiment: Experiment, results: Results, of: str) -> list[str]:
    """Return the names of the trials to draw: the first tracked recording of every condition, all, or none."""
    if of == "none":
        return []
    trials = read_result(results.trials)
    tracked = set(trials.loc[~trials["status"].isin(("failed", "left_out")), "trial"])
    filmed = [trial for trial in experiment.trials if trial.video is not None and trial.name in tracked]
    if of == "all":
        return [trial.name for trial in filmed]
    first: dict[str, str] = {}
    for trial in filmed:
        first.setdefault(trial.condition, trial.name)
    return list(first.values())


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
    from vinetrack.video.frames import RecordingError
    from vinetrack.video.write import write_clip

    if trial.video is None:
        raise ResultsError(f"{trial.name} has no recording to draw on")
    track = read_result(results.track(trial.name))
    shown = frames_to_show(track)
    rate = 1.0 / float(np.median(np.diff(track["time_s"].to_numpy()))) if len(track) > 1 else math.nan
    play_fps, stride = playback_rate(shown.stop - shown.start, settings.seconds)
    path = results.overlay(trial.name)
    try:
        pictures = _pictures(trial, results, track, shown, stride, rate / play_fps / stride, settings)
        write_clip(path, pictures, play_fps)
    except RecordingError as error:
        raise ResultsError(str(error)) from None
    return path


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
    """Return playback rate and stride of a clip that lasts about `seconds`. Returns play_fps (frames per second),
    stride (every how many frames of the recording one is shown).
    """
    stride = max(round(n_frames / seconds / FASTEST_FPS), 1)
    return float(np.clip(n_frames / stride / seconds, SLOWEST_FPS, FASTEST_FPS)), stride


def _pictures(
    trial: Trial,
    results: Results,
    track: pd.DataFrame,
    shown: range,
    stride: int,
    slowed: float,
    settings: OverlaySettings,
) -> Iterator[NDArray[np.uint8]]:
    from vinetrack.figures.overlay import ClipView
    from vinetrack.video.curved_axis import axis_from_entry
    from vinetrack.video.frames import inspect_recording

    assert trial.video is not None
    recording = inspect_recording(trial.video)
    analysed = read_json(results.analysed(trial.name))
    line = analysed.get("axis")
    if line is None:
        raise ResultsError(f"{results.analysed(trial.name)} does not state the axis: run snakemake again")
    axis = axis_from_entry(line)
    mm_per_px = float(analysed["row"]["mm_per_px"] or math.nan)
    tube_px = 1e3 * trial.diameter_m / mm_per_px
    tube_px = tube_px if math.isfinite(tube_px) else 0.2 * min(recording.width, recording.height)
    view = ClipView(
        trial.name, axis, tube_px, (recording.width, recording.height), mm_per_px, slowed, settings.width_px
    )
    edges, release_s = edges_to_draw(trial.name, results, track)
    shake_px = shake_along(line, len(track))
    edges = [replace(edge, along_px=edge.along_px + shake_px) for edge in edges]
    time_ms = 1e3 * (track["time_s"].to_numpy(dtype=float) - release_s)
    yield from draw_over(recording, view, edges, time_ms, shown, stride)


def draw_over(
    recording: Recording, view: ClipView, edges: list[Edge], time_ms: Floats, shown: range, stride: int
) -> Iterator[NDArray[np.uint8]]:
    """Draw edges over the frames of a recording. Shapes: time_ms (n_frames,)."""
    from vinetrack.figures.overlay import compose, levels
    from vinetrack.video.frames import iterate_frames

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
    """Return the shift of each frame along the axis due to camera shake, px; 0 for a camera at rest. Shape
    (n_frames,).
    """
    shake_px = np.zeros(n_frames)
    stored_px = np.asarray(line.get("shake_px", ()), dtype=float)[:n_frames]
    shake_px[: stored_px.size] = stored_px
    return shake_px


def edges_to_draw(trial: str, results: Results, track: pd.DataFrame) -> tuple[list[Edge], float]:
    """Return the tracked edge, the predicted edges if there are any, and the time of release, s. Returns edges,
    release_s.
    """
    from vinetrack.figures.overlay import AFTER, BEFORE, TRACKED, Edge

    edge_px = track["edge_px"].to_numpy(dtype=float)
    edges = [Edge("tracked edge", TRACKED, edge_px)]
    by_hand = hand_corrected(track["flag"].fillna(""))
    corrected = [Edge("corrected by hand", GREEN, np.where(by_hand, edge_px, math.nan), by_hand=True)]
    corrected = corrected if by_hand.any() else []
    path = results.predictions(trial)
    if not path.exists():
        return [*edges, *corrected], float(_first_moving_s(track))
    predicted = read_result(path)
    to_px = position_to_px(track)
    added = _added_effects(results)
    labels = {"model_before_m": "initial model", "model_after_m": f"with {added}" if added else ""}
    time_s, measured_m = (track[name].to_numpy(dtype=float) for name in ("time_s", "lead_position_m"))
    for column, label in labels.items():
        prediction = predicted[["time_s", column]].dropna()
        if not label or prediction.empty:
            continue
        # There is no prediction before the first and after the last frame of the fit.
        position_m = np.interp(time_s, prediction["time_s"], prediction[column], left=math.nan, right=math.nan)
        error_mm = 1e3 * (position_m - measured_m)
        edges.append(Edge(label, BEFORE if column == "model_before_m" else AFTER, to_px(position_m), error_mm))
    return [*edges, *corrected], _release_s(trial, results, track)


def position_to_px(track: pd.DataFrame) -> Any:
    """Return the conversion from metres to pixels along the axis, fitted to the points of a track. It is a quadratic
    polynomial, since lens distortion and tilt make it slightly nonlinear.
    """
    both = track[["lead_position_m", "edge_px"]].dropna()
    metres, px = both["lead_position_m"].to_numpy(dtype=float), both["edge_px"].to_numpy(dtype=float)
    if len(both) < FEWEST_POINTS or np.ptp(metres) <= 0:
        raise ResultsError("too few of its positions are known in pixels and in metres")
    middle, half = (metres.max() + metres.min()) / 2, np.ptp(metres) / 2
    quadratic = np.polynomial.Polynomial.fit(metres, px, 2, domain=[middle - half, middle + half])
    return quadratic


def _added_effects(results: Results) -> str:
    """Return the effects that the diagnosis added, in words; blank if there are none."""
    diagnosis = read_diagnosis(results)
    return " and ".join(map(spaced_name, diagnosis.effects)) if diagnosis is not None else ""


def _release_s(trial: str, results: Results, track: pd.DataFrame) -> float:
    fitted = read_fit(results).trials if results.fit.exists() else {}
    return fitted[trial].release_s if trial in fitted else _first_moving_s(track)


def _first_moving_s(track: pd.DataFrame) -> float:
    return float(track["time_s"].iloc[min(frames_to_show(track).start + MARGIN_FRAMES, len(track) - 1)])
