"""Reading frames of any recording: brightness as the camera wrote it, and everything that is wrong with the file.

The Y plane is copied straight from the decoder's buffer, since a conversion to grey or colour would cost up to half the
decoding speed. The capture rate is never taken from the container, which only knows the playback rate. DNG frames carry
the true rate (tag 51044) and the exposure (33434), and so do the files of some high-speed cameras (`camera_headers`);
other image files carry neither.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.files import file_size
from vinetrack.video.decoding import (
    HALF_TICK,
    NON_MARKING_DECODERS,
    Decoded,
    PacketIndex,
    damaged_frames,
    decode_container,
    open_film,
    quiet_log,
)
from vinetrack.video.frame_faults import torn_frames

if TYPE_CHECKING:
    import av

    from vinetrack.video.raw_frames import RawFrames

CONTAINERS = frozenset({".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm", ".mts", ".ts", ".cine", ".mraw"})
IMAGES = frozenset({".png", ".jpg", ".jpeg", ".tif", ".tiff", ".dng", ".bmp", ".pgm"})
# Formats that are not read, and what they are: no vendor documentation was available to check a reader against
UNSUPPORTED_FORMATS = {
    ".raw": "raw pixels without a header, as a Chronos writes them; nothing says their size, depth and rate",
    ".r3d": "a recording in RED's own format",
    ".braw": "a recording in Blackmagic's own format",
    ".seq": "a sequence of StreamPix",
}
# Formats under which FFmpeg renders any text as a picture of its letters
TEXT_FORMATS = frozenset({"tty", "bin", "xbin", "adf", "idf", "svg_pipe"})

DECODER_THREADS = 2  # Decoder threads per recording (chosen)


class RecordingError(ValueError):
    """A recording that cannot be used; the message is one sentence."""


@dataclass(frozen=True)
class Region:
    """Rectangle of a picture in whole pixels: columns `left` to `right`, rows `top` to `bottom`, ends excluded."""

    left: int
    top: int
    right: int
    bottom: int

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width, px."""
        return self.bottom - self.top, self.right - self.left

    @property
    def slices(self) -> tuple[slice, slice]:
        """Index of the rectangle in a picture of shape (height, width)."""
        return slice(self.top, self.bottom), slice(self.left, self.right)


@dataclass(frozen=True)
class Recording:
    """Properties of a recording, known before its frames are decoded. `kind` is `container`, `folder`, `stack` or
    `raw`. `declared_frames` is the frame count that the file states (None if it states none).
    """

    path: Path
    kind: str
    width: int
    height: int
    bit_depth: int
    declared_frames: int | None
    capture_fps: float | None = None
    exposure_s: float | None = None
    files: tuple[Path, ...] = ()
    numbers: tuple[int, ...] = ()
    notes: tuple[str, ...] = ()
    playback_fps: float | None = None
    raw: RawFrames | None = None

    @property
    def whole(self) -> Region:
        """The full picture."""
        return Region(0, 0, self.width, self.height)


@dataclass(frozen=True)
class Frames:
    """Decoded frames of one region. `luma` has shape (n_frames, height, width), uint8 or uint16. `slot`, shape
    (n_frames,), is the number of capture periods since the first frame, from timestamps or from the numbers of image
    files: 0, 1, 2 … if no frame is missing.
    """

    recording: Recording
    region: Region
    luma: NDArray[Any]
    slot: NDArray[np.int_]
    damaged: NDArray[np.bool_]
    notes: tuple[str, ...] = ()
    slots_before: NDArray[np.int_] = field(default_factory=lambda: np.zeros(0, dtype=int))
    slots_after: NDArray[np.int_] = field(default_factory=lambda: np.zeros(0, dtype=int))

    def __len__(self) -> int:
        return len(self.luma)

    @property
    def first(self) -> int:
        """Index of the first decoded frame in the recording, from 0."""
        return len(self.slots_before)

    @property
    def n_recorded(self) -> int:
        """Number of frames of the recording, decoded or not."""
        return len(self.slots_before) + len(self.luma) + len(self.slots_after)


def inspect_recording(path: Path | str) -> Recording:
    """Read the header of a recording; at most one frame is decoded."""
    path = Path(path)
    try:
        size = 1 if path.is_dir() else file_size(path)
    except FileNotFoundError:
        raise RecordingError(f"{path.name}: there is no such file or folder") from None
    except OSError as error:
        raise RecordingError(f"{path.name}: cannot be read: {error.strerror}") from None
    if path.is_dir() or path.suffix.lower() in IMAGES:
        from vinetrack.video.images import inspect_images

        return inspect_images(path)
    if size == 0:
        raise RecordingError(f"{path.name}: the file is empty; copy it from the camera again")
    if path.suffix.lower() in {".cine", ".mraw", ".cih", ".cihx"}:
        from vinetrack.video.camera_headers import inspect_cine, inspect_mraw

        return inspect_cine(path) if path.suffix.lower() == ".cine" else inspect_mraw(path)
    return _inspect_container(path)


def read_frames(
    path: Path | str | Recording,
    region: Region | None = None,
    threads: int = DECODER_THREADS,
    part: tuple[int, int, PacketIndex] | None = None,
) -> Frames:
    """Decode all frames of a recording, or a `region` of them."""
    recording = path if isinstance(path, Recording) else inspect_recording(path)
    region = region or recording.whole
    if recording.raw is not None:
        from vinetrack.video.raw_frames import read_raw

        return read_raw(recording, recording.raw, region)
    if recording.kind != "container":
        from vinetrack.video.images import read_images

        return read_images(recording, region)
    shape = recording.height, recording.width
    expected, between_s = recording.declared_frames, None
    if part is not None:
        first, last, index = part
        expected, between_s = last - first + 1, (float(index.times_s[first]), float(index.times_s[last]))
    try:
        decoded = decode_container(
            recording.path, shape, lambda frame: luma_plane(frame, region, copy=False), threads, expected, between_s
        )
    except MemoryError:
        raise too_large(recording) from None
    return _assemble(recording, region, decoded, None if part is None else part[2])


def too_large(recording: Recording) -> RecordingError:
    """Make the error for a recording that does not fit in memory."""
    return RecordingError(
        f"{recording.path.name}: its frames of {recording.width} x {recording.height} px do not fit in the memory "
        "of this machine; cut it to the growth, and to the part of the picture that shows it"
    )


def iterate_frames(recording: Recording, region: Region | None = None) -> Iterator[NDArray[Any]]:
    """Yield the region of one frame after another, as copies; stop where decoding fails."""
    region = region or recording.whole
    if recording.raw is not None:
        for picture in recording.raw.pictures():
            yield picture[region.slices]
        return
    if recording.kind != "container":
        from vinetrack.video.images import iterate_images

        yield from iterate_images(recording, region)
        return
    import av

    with open_film(recording.path) as container:
        try:
            for frame in container.decode(video=0):
                yield luma_plane(frame, region)
        except av.error.FFmpegError:
            return


def luma_plane(frame: av.VideoFrame, region: Region, copy: bool = True) -> NDArray[Any]:
    """Return the brightness of a decoded frame."""
    name = frame.format.name
    depth = frame.format.components[0].bits
    if not (name.startswith(("yuv", "gray", "nv12", "nv16", "nv21", "p010")) and frame.format.is_planar) and (
        name not in {"gray", "gray10le", "gray12le", "gray14le", "gray16le"}
    ):
        target = "gray16le" if depth > 8 else "gray"
        return np.array(frame.to_ndarray(format=target)[region.slices])
    plane = frame.planes[0]
    dtype = np.dtype(np.uint8) if depth <= 8 else np.dtype(">u2" if name.endswith("be") else "<u2")
    rows = np.frombuffer(memoryview(plane), dtype=dtype).reshape(-1, plane.line_size // dtype.itemsize)
    picture = rows[region.slices]
    return np.array(picture, np.uint8 if dtype.itemsize == 1 else np.uint16) if copy else picture


def _inspect_container(path: Path) -> Recording:
    import av

    try:
        with quiet_log() as messages, open_film(path) as container:
            if container.format.name in TEXT_FORMATS:
                raise RecordingError(f"{path.name}: a text, not a recording; name a film, or a folder of pictures")
            if not container.streams.video:
                raise RecordingError(f"{path.name}: holds no video stream; name a video file")
            stream = container.streams.video[0]
            first = next(container.decode(stream), None)
            if first is None:
                raise RecordingError(f"{path.name}: not one frame can be decoded; the file is damaged or empty")
            depth = first.format.components[0].bits
            declared = _declared_frames(stream, container)
            playback = float(stream.average_rate) if stream.average_rate else None
            return Recording(path, "container", first.width, first.height, depth, declared, playback_fps=playback)
    except (av.error.FFmpegError, UnicodeDecodeError) as error:
        # PyAV decodes names in a header as UTF-8, which fails for a damaged one.
        raise RecordingError(_why_unreadable(path, messages, str(error))) from error


def _declared_frames(stream: Any, container: Any) -> int | None:
    """Frame count of the header; if absent, duration times playback rate."""
    if stream.frames > 0:
        return int(stream.frames)
    seconds = None
    if stream.duration is not None and stream.time_base is not None:
        seconds = float(stream.duration * stream.time_base)
    elif container.duration is not None:
        seconds = container.duration / 1e6
    if seconds is None or not stream.average_rate:
        return None
    return max(round(seconds * float(stream.average_rate)), 0) or None


def _why_unreadable(path: Path, messages: list[str], error: str) -> str:
    text = " ".join([*messages, error])
    if "moov atom not found" in text and _looks_like_mp4(path):
        return f"{path.name}: cut short: the index that is written last is missing; copy the file again, or repair it"
    if path.suffix.lower() in UNSUPPORTED_FORMATS:
        return f"{path.name}: {UNSUPPORTED_FORMATS[path.suffix.lower()]}; save it from the camera as DNG, TIFF or mp4"
    if path.suffix.lower() not in CONTAINERS:
        return f"{path.name}: not a video that can be read; use mp4, mov, avi, mkv, or a folder of images"
    return f"{path.name}: not a video, or its beginning is damaged; copy it from the camera again"


def _looks_like_mp4(path: Path) -> bool:
    with path.open("rb") as stream:
        return stream.read(12)[4:8] in {b"ftyp", b"mdat", b"wide", b"free"}


def _assemble(recording: Recording, region: Region, decoded: Decoded, index: PacketIndex | None) -> Frames:
    n = len(decoded.times_s)
    name = recording.path.name
    if n == 0:
        raise RecordingError(f"{name}: not one frame can be decoded; the file is damaged")
    notes = list(recording.notes)
    there = n if index is None else len(index.pts)
    if recording.declared_frames is not None and there < recording.declared_frames:
        notes.append(
            f"{name}: {there} frames {'decoded' if index is None else 'are there'} where the file declares "
            f"{recording.declared_frames}: cut short or damaged; copy it from the camera again"
        )
    undecoded = max((recording.declared_frames or 0) - there, 0)
    times_s = np.array(decoded.times_s)
    before = after = slot = np.zeros(0, dtype=int)
    if index is None:
        slot, irregular = slots_from_times(times_s, undecoded)
    else:
        slots, irregular = slots_from_times(index.times_s, undecoded)
        number = np.searchsorted(index.times_s, times_s - HALF_TICK * index.base_s)
        before, slot, after = slots[: number[0]], slots[number], slots[number[-1] + 1 :]
        notes.append(
            f"{name}: of {there} frames only {number[0]} to {number[-1]}, around the motion, are decoded; set others "
            "in frames_used"
        )
    if decoded.decoder in NON_MARKING_DECODERS:
        decoded.corrupt = (np.array(decoded.corrupt) | torn_frames(decoded.pictures)).tolist()
    damaged = damaged_frames(decoded, slot)
    if decoded.messages or damaged.any():
        first_message = f"; the first: {decoded.messages[0].strip()}" if decoded.messages else ""
        notes.append(
            f"{name}: damaged: {int(damaged.sum())} of {n} frames are corrupt or coded from corrupt ones"
            f" ({len(decoded.messages)} messages of the decoder{first_message})"
        )
    if irregular:
        notes.append(f"{name}: {irregular}")
    return Frames(recording, region, decoded.pictures, slot, damaged, tuple(notes), before, after)


def slots_from_times(times: NDArray[np.float64], known_missing: int = 0) -> tuple[NDArray[np.int_], str]:
    """Return the capture period of every frame from its timestamp, and a note on irregularities ("" if there are none).
    Timestamps are rounded to whole multiples of their median spacing, so that a missing frame leaves a gap. Timestamps
    that repeat, run backwards or fit no common period are not used; frames are then numbered consecutively. Returns
    capture periods since the first frame, shape (n_frames,), and the note. Shapes: times (n_frames,).
    """
    plain = np.arange(len(times))
    if len(times) < 3 or not np.all(np.isfinite(times)):
        return plain, ""
    steps = np.diff(times)
    period = float(np.median(steps))
    if period <= 0 or np.any(steps <= 0):
        return plain, "timestamps repeat or run backwards; frames are timed by their index"
    # Times in whole milliseconds alternate between, say, steps of 16 and 17: over a long gap only their mean is right.
    period = float(np.mean(steps[steps < 1.5 * period]))
    periods = steps / period
    if np.any(np.abs(periods - np.rint(periods)) > 0.25) or np.any(np.rint(periods) < 1):
        return plain, "the container's frame rate varies; frames are timed by their index"
    slot = np.concatenate([[0], np.cumsum(np.rint(periods).astype(int))])
    missing = int(slot[-1] - plain[-1])
    # Cameras drop single frames; if a tenth of all frames seems missing, the container counts in other units.
    if missing == 0 or missing > max(3, len(times) // 10, known_missing):
        return plain, "" if missing == 0 else "its timestamps are irregular; frames are timed by their index"
    return slot, f"{missing} frames are missing according to the timestamps; the others keep their own times"
