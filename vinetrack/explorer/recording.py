"""Frames of one recording, and the positions of the tracked edge and the model's edge in the picture.

A recording is decoded once, in the background, and its frames are kept as JPEG no wider than the page shows them: one
second of a high-speed camera takes a few tens of megabytes.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.local_page import THREAD_PREFIX
from vinetrack.core.records import Floats, Trial, hand_corrected
from vinetrack.pipeline.overlays_stage import shake_along
from vinetrack.results.folder_layout import Results, ResultsError, read_json, read_result

if TYPE_CHECKING:
    import pandas as pd

    from vinetrack.video.axis import Axis

MAX_WIDTH_PX = 960  # Chosen: as wide as the page shows a recording

JPEG_QUALITY = 88  # JPEG quality, 0 to 100

PROGRESS_EVERY_FRAMES = 10  # Frames between two reports of progress; chosen: several reports a second


@dataclass(frozen=True)
class RecordingView:
    """Mapping of positions along the growth axis to the picture of one recording, px of the recording. `edge_px`, shape
    (n_frames,), counts along the axis, NaN where the edge was not found; `time_s` and `lead_position_m` are those of
    the track.
    """

    trial: str
    path: Path
    axis: Axis
    half_width_px: float
    time_s: Floats
    edge_px: Floats
    lead_position_m: Floats
    shake_px: Floats
    by_hand: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, dtype=bool))

    def along_px(self, lead_position_m: Floats) -> Floats:
        """Return the pixels along the axis of positions of the track; linearly extrapolated beyond the track. NaN if
        the track has fewer than two points.
        """
        known = np.isfinite(self.edge_px) & np.isfinite(self.lead_position_m)
        if np.count_nonzero(known) < 2:
            return np.full(np.shape(lead_position_m), np.nan)
        position, along = self.lead_position_m[known], self.edge_px[known]
        order = np.argsort(position, kind="stable")
        position, along = position[order], along[order]
        scale, offset = np.polyfit(position, along, 1)
        inside = np.interp(lead_position_m, position, along)
        outside = (lead_position_m < position[0]) | (lead_position_m > position[-1])
        return np.where(outside, offset + scale * lead_position_m, inside)

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
    return _view(trial, axis, table)


def _view(trial: Trial, axis: dict[str, Any], table: pd.DataFrame) -> RecordingView:
    from vinetrack.video.curved_axis import axis_from_entry

    line = axis_from_entry(axis)
    width = axis.get("width_px")
    assert trial.video is not None
    return RecordingView(
        trial=trial.name,
        path=trial.video,
        axis=line,
        half_width_px=0.75 * float(width) if width else 0.05 * line.length_px,
        time_s=table["time_s"].to_numpy(dtype=float),
        edge_px=table["edge_px"].to_numpy(dtype=float),
        lead_position_m=table["lead_position_m"].to_numpy(dtype=float),
        shake_px=shake_along(axis, len(table)),
        by_hand=hand_corrected(table["flag"]),
    )


@dataclass
class DecodedRecording:
    """Frames of one recording, decoded in the background. `shape` is the height and width of the pictures, px. `scale`
    is the number of their pixels per pixel of the recording; `error` is blank unless decoding failed.
    """

    path: Path
    count: int = 0
    expected: int = 0
    shape: tuple[int, int] = (0, 0)
    scale: float = 1.0
    complete: bool = False
    error: str = ""
    _frames: list[bytes] = field(default_factory=list)
    _cancelled: bool = False

    def picture(self, frame: int) -> NDArray[np.uint8]:
        """Return the grey levels of one frame."""
        import cv2

        data = np.frombuffer(self._frames[frame], dtype=np.uint8)
        return np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE), dtype=np.uint8)

    def decode(self, on_progress: Callable[[DecodedRecording], None] | None = None) -> DecodedRecording:
        """Decode every frame."""
        from vinetrack.video.frames import RecordingError, inspect_recording, iterate_frames

        try:
            recording = inspect_recording(self.path)
            self.expected = recording.declared_frames or 0
            for luma in iterate_frames(recording):
                if self._cancelled:
                    return self
                self._add(luma, recording.bit_depth)
                if on_progress is not None and self.count % PROGRESS_EVERY_FRAMES == 1:
                    on_progress(self)
        except (RecordingError, OSError) as error:
            self.error = str(error)
        self.complete = True
        if on_progress is not None:
            on_progress(self)
        return self

    def start_decoding(self, on_progress: Callable[[DecodedRecording], None]) -> None:
        """Run `decode` in a thread, from which `on_progress` is called."""
        threading.Thread(target=self.decode, args=(on_progress,), daemon=True, name=f"{THREAD_PREFIX}film").start()

    def cancel(self) -> None:
        """Stop decoding."""
        self._cancelled = True

    def _add(self, luma: NDArray[Any], bit_depth: int) -> None:
        import cv2

        height, width = luma.shape
        if luma.dtype != np.uint8:
            luma = (luma >> max(bit_depth - 8, 0)).astype(np.uint8)
        if width > MAX_WIDTH_PX:
            size = (MAX_WIDTH_PX, round(height * MAX_WIDTH_PX / width))
            luma = cv2.resize(luma, size, interpolation=cv2.INTER_AREA)
        _, data = cv2.imencode(".jpg", luma, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        self._frames.append(data.tobytes())
        self.shape, self.scale = (luma.shape[0], luma.shape[1]), luma.shape[1] / width
        self.count += 1
