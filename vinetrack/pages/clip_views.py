"""Views of a recording for the page: frames as JPEG, the proposed axis, and the result of tracking."""

from __future__ import annotations

import base64
import math
import threading
from collections import OrderedDict
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Trial
from vinetrack.core.tables import safe_join
from vinetrack.experiment.folder import SETTINGS, read_corrections
from vinetrack.experiment.schema import COLUMNS
from vinetrack.experiment.settings import ExperimentSettings, read_experiment_settings
from vinetrack.experiment.sheet import SHEET, read_row
from vinetrack.pages.local_page import jpeg
from vinetrack.tracks.importers import TrackError, read_pressure_trace
from vinetrack.video.axis import Axis
from vinetrack.video.curved_axis import CurvedAxis, axis_through
from vinetrack.video.frames import RecordingError, inspect_recording, iterate_frames, read_frames
from vinetrack.video.survey import Measurement, measure_recording, proposed_axis, size_problems, tracked_facts
from vinetrack.video.target_corners import find_board
from vinetrack.video.track import Tracking, track_recording

STRIP_PX = 1600  # Longest side of a strip; chosen: twice the page's width on a common screen


@dataclass(frozen=True)
class DecodedClip:
    """A decoded recording: its frames as JPEG, and the axis found from the motion, or the reason why there is none."""

    frames: tuple[bytes, ...]
    width: int
    height: int
    axis: Axis | None
    no_axis: str
    notes: tuple[str, ...]

    def to_json(self) -> dict[str, Any]:
        """Return what the page needs before it requests a frame."""
        axis = None if self.axis is None else axis_json(self.axis)
        size = {"frames": len(self.frames), "width": self.width, "height": self.height}
        return {**size, "axis": axis, "no_axis": self.no_axis, "notes": list(self.notes)}


class ClipStore:
    """Cache of decoded recordings of a folder. Thread-safe."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._clips: OrderedDict[tuple[str, int], DecodedClip] = OrderedDict()
        self._lock = threading.Lock()

    def clip(self, recording: str) -> DecodedClip:
        """Return a decoded recording, from the cache if possible."""
        path = safe_join(self.folder, recording)
        key = (recording, path.stat().st_mtime_ns if path.exists() else 0)
        with self._lock:
            if key not in self._clips:
                self._clips[key] = _decoded(path)
                # Recordings whose frames are cached; chosen: the current and the previous one
                while len(self._clips) > 2:
                    self._clips.popitem(last=False)
            self._clips.move_to_end(key)
            return self._clips[key]

    def thumbnail(self, recording: str) -> bytes:
        """Return the first frame as a small JPEG, without decoding more."""
        # Width of the pictures in the list; chosen: as wide as its column
        return jpeg(_first_frame(safe_join(self.folder, recording)), 220)

    def picture(self, name: str) -> NDArray[Any]:
        """Return a single picture, or the first frame of a film, as grey levels. Shape (height, width)."""
        return _first_frame(safe_join(self.folder, name))

    def board(self, name: str) -> dict[str, Any] | None:
        """The printed board in a picture or at the beginning of a film, as `experiment.yaml` names it, without sizes.
        Returns mapping of JSON types; None if there is no board.
        """
        target = find_board(self.picture(name))
        if target is None:
            return None
        board: dict[str, Any] = {"kind": target.kind, "image": name, "squares": list(target.squares)}
        if target.kind == "charuco":
            board |= {"dictionary": target.dictionary, "marker_share": round(target.marker_share, 3)}
        return board


def _first_frame(path: Path) -> NDArray[Any]:
    frame = next(iterate_frames(inspect_recording(path)), None)
    if frame is None:
        raise RecordingError(f"{path.name}: no frame can be decoded")
    return frame


def _decoded(path: Path) -> DecodedClip:
    frames = read_frames(path)
    height, width = frames.luma.shape[1:]
    try:
        axis, no_axis = proposed_axis(frames.luma), ""
    except RecordingError as error:
        axis, no_axis = None, str(error)
    top = float(np.quantile(frames.luma[0], 0.999)) if frames.luma.dtype != np.uint8 else 255.0
    pictures = tuple(jpeg(luma, white=top) for luma in frames.luma)
    return DecodedClip(pictures, width, height, axis, no_axis, frames.notes)


def axis_json(axis: Axis) -> dict[str, Any]:
    """Return an axis for the page, px to a hundredth. Returns mapping of JSON types: `from_px`, `to_px`, for a curve
    `via_px` and equally spaced points along it, `path_px`; and: `width_px`, None if unknown.
    """
    width = round(axis.width_px, 2) if math.isfinite(axis.width_px) else None
    ends: dict[str, Any] = {"from_px": [round(v, 2) for v in axis.from_px], "to_px": [round(v, 2) for v in axis.to_px]}
    if isinstance(axis, CurvedAxis):
        ends["via_px"] = [[round(v, 2) for v in point] for point in axis.via_px]
        # 4.0: spacing of the points of a curve sent to the page, px (chosen)
        along = np.linspace(0.0, axis.length_px, max(2, round(axis.length_px / 4.0)))
        ends["path_px"] = axis.points(along).round(2).tolist()
    return {**ends, "width_px": width}


def track_row(folder: Path, index: int) -> dict[str, Any]:
    """Track the recording of one row, which may be incomplete: strip, edge and notes. Returns mapping of JSON types:
    Without a scale positions are in pixels, without a rate times are in frames, see `scaled` and `timed`.
    """
    from vinetrack.core.tables import read_table
    from vinetrack.experiment.settings import in_sheet_units

    settings = read_experiment_settings(folder / SETTINGS)
    table = in_sheet_units(read_table(folder / SHEET), SHEET)[0]
    trial = _trial_of(read_row(table, index, settings).values, folder)
    given = read_corrections(folder)[0].get(table.rows[index].get("trial", ""), ())
    trial = replace(trial, corrections=given)
    timed = math.isfinite(trial.capture_fps)
    scaled = settings.calibration is not None or math.isfinite(trial.m_per_px)
    if not timed and trial.video is not None:
        rate = inspect_recording(trial.video).capture_fps
        timed = rate is not None
        trial = replace(trial, capture_fps=rate or 1.0, exposure_s=trial.exposure_s if timed else math.nan)
    remarks: list[str] = []
    measurement = None
    if scaled:
        measurement = measure_recording(trial, settings, folder)
        tracking = measurement.tracking
        remarks = [problem.reason for problem in size_problems(trial, tracked_facts(trial, measurement))]
    else:
        tracking = track_recording(trial, _axis_of(trial, settings))
    return {
        **_track_json(tracking),
        **_scale_json(measurement),
        "timed": timed,
        "scaled": scaled,
        "notes": [*remarks, *tracking.track.notes],
        "pressure": _pressure_json(trial),
    }


def warm_up() -> None:
    """Track a rendered bar, so that the tracker is compiled before the user needs it."""
    from vinetrack.video.frames import Frames, Recording
    from vinetrack.video.track import track_frames

    rng = np.random.default_rng(1)
    luma = rng.normal(60, 2, (30, 64, 240)).clip(0, 255).astype(np.uint8)
    for i, frame in enumerate(luma):
        frame[24:40, : 20 + max(0, i - 6) * 7] = 180
    recording = Recording(Path("warm-up"), "container", 240, 64, 8, len(luma))
    frames = Frames(recording, recording.whole, luma, np.arange(len(luma)), np.zeros(len(luma), dtype=bool))
    try:
        track_frames(frames, Trial(name="warm-up", capture_fps=1000.0), 1000.0)
    except RecordingError:
        # Only the compilation matters.
        return


def _trial_of(values: dict[str, Any], folder: Path) -> Trial:
    """A trial made of the readable cells; the others keep their defaults."""
    fields: dict[str, Any] = {}
    for name, value in values.items():
        column = COLUMNS[name]
        if column.kind == "path":
            fields[column.field] = safe_join(folder, value)
        else:
            fields[column.field] = column.to_si(float(value)) if column.kind in ("number", "choice") else value
    return Trial(**{"name": "trial", **fields})


def _axis_of(trial: Trial, settings: ExperimentSettings) -> Axis | None:
    """The given axis without its width, which is in millimetres, because there is no scale."""
    given = trial.axis or settings.axis
    if given is None:
        return None
    return axis_through((given.from_px, *(given.via_px or ()), given.to_px))


def _track_json(tracking: Tracking) -> dict[str, Any]:
    track, strip = tracking.track, tracking.kymograph
    dark, light = np.nanpercentile(strip, [1, 99])
    # Grey level of the strip where no frame was decoded (chosen)
    grey = np.full((len(track.time_s), strip.shape[1]), 128, np.uint8)
    grey[tracking.strip_rows] = (255 * (strip - dark) / max(float(light - dark), 1.0)).clip(0, 255).astype(np.uint8)
    import cv2

    # Time to the right, growth upwards.
    turned = np.ascontiguousarray(np.flipud(grey.T))
    size = (min(turned.shape[1], STRIP_PX), min(turned.shape[0], STRIP_PX))
    small = cv2.resize(turned, size, interpolation=cv2.INTER_AREA)
    return {
        "strip": "data:image/jpeg;base64," + base64.b64encode(jpeg(small)).decode(),
        "length_px": round(tracking.axis.length_px, 2),
        "axis": axis_json(tracking.axis),
        "time_s": _numbers(track.time_s, 6),
        "edge_px": _numbers(track.edge_px, 2),
        "position_mm": _numbers(1e3 * track.lead_position_m, 3),
        "tracked_px": _numbers(track.edge_px if track.tracked_px is None else track.tracked_px, 2),
        "flag": [str(flag) for flag in track.flag],
        "shake_px": _numbers(tracking.shake_px, 2),
    }


def _scale_json(measurement: Measurement | None) -> dict[str, Any]:
    if measurement is None:
        return {"mm_per_px": None, "growth_mm": None, "tube_width_mm": None}
    mm = 1e3 * measurement.m_per_px
    width = mm * measurement.tracking.tube_width_px
    return {
        "mm_per_px": _numbers(np.array([mm]), 6)[0],
        "growth_mm": _numbers(np.array([1e3 * measurement.growth_m]), 2)[0],
        "tube_width_mm": _numbers(np.array([width]), 2)[0],
    }


def _pressure_json(trial: Trial) -> dict[str, Any] | None:
    """The pressure trace of a trial, or the reason why it cannot be read; None if there is none."""
    if trial.pressure_trace is None:
        return None
    try:
        time_s, pressure_Pa = read_pressure_trace(trial.pressure_trace)
    except (TrackError, OSError) as error:
        return {"words": str(error)}
    every = max(1, len(time_s) // STRIP_PX)
    return {"time_s": _numbers(time_s[::every], 6), "pressure_kPa": _numbers(pressure_Pa[::every] / 1e3, 4)}


def _numbers(values: NDArray[Any], digits: int) -> list[float | None]:
    """Rounded numbers for JSON, with None for NaN."""
    return [round(float(value), digits) if math.isfinite(value) else None for value in np.asarray(values, float)]
