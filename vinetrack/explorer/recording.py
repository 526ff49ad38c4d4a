"""Frames of one recording for scrubbing, with where the tracked edge and the model's edge lie in the picture.

A recording is decoded once, in the background, and its frames are kept as JPEG no wider than the page shows them: a
second of a high-speed camera fits in a few tens of megabytes.
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

WIDEST_PX = 960
"""Chosen: as wide as the page shows a recording."""

QUALITY = 88
"""Of JPEG, 0 to 100; chosen: at 88 an edge shows no blocks; a second of 1000 frames takes some tens of megabytes."""

TOLD_EVERY = 10
"""Frames between two reports of progress; chosen: several reports a second."""


@dataclass(frozen=True)
class RecordingView:
    """How positions along the growth axis lie in the picture of one recording, px of the recording.

    `edge_px`, shape (n_frames,), counts along the axis, NaN where the edge was not found; `time_s` and
    `lead_position_m` are those of the track. `shake_px`, shape (n_frames,), is how far along the axis a shaken camera
    moved each picture; `by_hand`, likewise, whether a person has corrected the point.
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
        """Where positions on the track's ruler lie along the axis; beyond the track, in a straight line.

        NaN where the track has fewer than two points.

        Parameters
        ----------
        lead_position_m : any shape.

        Returns
        -------
        array of the same shape, px
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
        """Ends, x and y, of a line across the vine at a place along the axis; with `frame` in the picture as it is.

        Parameters
        ----------
        along_px : place along the axis.
        frame : number of the picture; None for the axis itself.

        Returns
        -------
        xs, ys : of both ends, px
        """
        if frame is not None and frame < self.shake_px.size:
            along_px += float(self.shake_px[frame])
        half = self.half_width_px
        (x0, y0), (x1, y1) = self.axis.points(np.full(2, along_px), np.array([half, -half]))
        return (float(x0), float(x1)), (float(y0), float(y1))


def view_of(results: Results, trial: Trial) -> RecordingView | str:
    """The view of a trial, or in words why there is none: it is a track only, or its axis was not kept.

    Parameters
    ----------
    results : the folder.
    trial : of the experiment.

    Returns
    -------
    RecordingView, or str with the reason
    """
    if trial.video is None:
        name = trial.track.name if trial.track is not None else "a table"
        return f"{trial.name} came as a track ({name}): there is no recording to show, only where its edge was."
    if not trial.video.exists():
        return f"The recording of {trial.name}, {trial.video.name}, is no longer there; its track is shown instead."
    try:
        axis = read_json(results.analysed(trial.name)).get("axis")
        table = read_result(results.track(trial.name))
    except ResultsError as error:
        return str(error)
    if not axis:
        return f"Where the axis of {trial.name} lies in its picture was not kept: run snakemake again."
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
    """Frames of one recording, decoded in the background. `shape` is that of the pictures, height and width, px.

    `scale` is pixels of these pictures in one of the recording. `words` say what went wrong, blank where nothing.
    """

    path: Path
    count: int = 0
    expected: int = 0
    shape: tuple[int, int] = (0, 0)
    scale: float = 1.0
    complete: bool = False
    words: str = ""
    _frames: list[bytes] = field(default_factory=list)
    _unwanted: bool = False

    def picture(self, frame: int) -> NDArray[np.uint8]:
        """Grey levels of one frame, shape `shape`.

        Parameters
        ----------
        frame : its number.

        Returns
        -------
        array, uint8, shape `shape`
        """
        import cv2

        data = np.frombuffer(self._frames[frame], dtype=np.uint8)
        return np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE), dtype=np.uint8)

    def decode(self, told: Callable[[DecodedRecording], None] | None = None) -> DecodedRecording:
        """Decode every frame; `told` hears every so often.

        Parameters
        ----------
        told : called every `TOLD_EVERY` frames and at the end.

        Returns
        -------
        DecodedRecording, itself
        """
        from vinetrack.video.frames import RecordingError, inspect_recording, iterate_frames

        try:
            recording = inspect_recording(self.path)
            self.expected = recording.declared_frames or 0
            for luma in iterate_frames(recording):
                if self._unwanted:
                    return self
                self._add(luma, recording.bit_depth)
                if told is not None and self.count % TOLD_EVERY == 1:
                    told(self)
        except (RecordingError, OSError) as error:
            self.words = str(error)
        self.complete = True
        if told is not None:
            told(self)
        return self

    def in_background(self, told: Callable[[DecodedRecording], None]) -> None:
        """`decode` in a thread, from which `told` is called.

        Parameters
        ----------
        told : as of `decode`.
        """
        threading.Thread(target=self.decode, args=(told,), daemon=True, name=f"{THREAD_PREFIX}film").start()

    def give_up(self) -> None:
        """Stop decoding: another recording is wanted."""
        self._unwanted = True

    def _add(self, luma: NDArray[Any], bit_depth: int) -> None:
        import cv2

        height, width = luma.shape
        if luma.dtype != np.uint8:
            luma = (luma >> max(bit_depth - 8, 0)).astype(np.uint8)
        if width > WIDEST_PX:
            size = (WIDEST_PX, round(height * WIDEST_PX / width))
            luma = cv2.resize(luma, size, interpolation=cv2.INTER_AREA)
        _, data = cv2.imencode(".jpg", luma, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
        self._frames.append(data.tobytes())
        self.shape, self.scale = (luma.shape[0], luma.shape[1]), luma.shape[1] / width
        self.count += 1
