"""Reading frames of any recording: brightness as the camera wrote it, and everything that is wrong with the file.

The Y plane is copied straight from the decoder's buffer, since a conversion to grey or colour would cost up to half the
decoding speed. The capture rate is never taken from the container, which only knows the playback rate. DNG frames carry
the true rate (tag 51044) and the exposure (33434), and so do the files of some high-speed cameras (`camera_headers`);
other image files carry neither.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import CONTAINERS, IMAGES, Floats
from vinetrack.core.tables import file_size
from vinetrack.video.decoding import (
    HALF_TICK,
    NON_MARKING_DECODERS,
    Decoded,
    PacketIndex,
    damaged_frames,
    decode_container,
    memory_for_pictures,
    open_film,
    quiet_log,
)
from vinetrack.video.frame_faults import torn_frames

if TYPE_CHECKING:
    import av


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
        from vinetrack.video.images import inspect_cine, inspect_mraw

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
    if path.suffix.lower() not in CONTAINERS:
        return f"{path.name}: not a video that can be read; save it from the camera as mp4, mov, avi, mkv, DNG or TIFF"
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


# ------------------------------------------------------------------------------
# Reading frames stored as the sensor gave them: 8 to 16 bits, packed or not, one frame at a time.
#
# High-speed cameras write such files with headers of their own (`camera_headers`). Only the current frame is held in
# memory.

# Steps from each of the 1024 values of a packed Phantom frame to the next, starting at 2, up to 4064
_TABLE_STEPS = (
    "31111111111110111111111111111101111111111111110111111111111111011111111111111110111111111111111011111111"
    "11111111011111111111111101111111111110111111111111111112111111111211111121111211121112111211211211211212"
    "11212121121212121212122121221212212212212212221222122212222212222222122222222222222222222222322222223222"
    "22322232223222322322322322323232232323232323232332323233233233233233323332333233333233333333233333333333"
    "33333333433333333433334333343334334333433434334343343434343434343434434344344344344344434443444434444443"
    "44444444444444444444444444544444544445444544454454454454454545445454545454554545455455455455455545554555"
    "54555555455555555555555555555555556555555655556555655565565565565655656565656565656565665665656656665666"
    "56665666656666666656666666666666676666666676666766667666766766766767667676767676767676767767677677677767"
    "77677767777767777777777767777787777777777787777787777877787787787787787878778787878788787878878878878878"
    "887888878888878888888888888888888888888988888988889888988988988988989898898988"
)

# 12-bit brightness for each value of a packed Phantom frame, shape (1024,)
PHANTOM_TABLE: NDArray[np.uint16] = np.full(1024, 4095, np.uint16)
PHANTOM_TABLE[: len(_TABLE_STEPS) + 1] = 2 + np.cumsum([0, *map(int, _TABLE_STEPS)])


@dataclass(frozen=True)
class RawFrames:
    """Location of the frames in a file, and packing of their pixels. `offsets` are the positions of the first byte of
    each frame. `stored_bits` is the number of bits of a pixel in the file: 8, 16 (least significant byte first), or
    packed 10 or 12 (most significant bits first).
    """

    file: Path
    offsets: Sequence[int]
    width: int
    height: int
    stored_bits: int
    bottom_up: bool = False
    linearise: bool = False
    mosaic: bool = False
    times_s: Floats | None = None

    @property
    def frame_bytes(self) -> int:
        """Size of a frame in the file, bytes."""
        return self.width * self.height * self.stored_bits // 8

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the pixels that `pictures` yields."""
        return np.dtype(np.uint8 if self.stored_bits == 8 else np.uint16)

    def pictures(self) -> Iterator[NDArray[Any]]:
        """Yield one frame after another, shape (height, width); stop where the file ends."""
        with self.file.open("rb") as stream:
            for offset in self.offsets:
                stream.seek(offset)
                data = stream.read(self.frame_bytes)
                if len(data) < self.frame_bytes:
                    return
                pixels = unpack_pixels(np.frombuffer(data, np.uint8), self.stored_bits)
                if self.linearise:
                    pixels = PHANTOM_TABLE[pixels]
                picture = pixels.reshape(self.height, self.width)
                picture = picture[::-1] if self.bottom_up else picture
                yield mosaic_brightness(picture) if self.mosaic else picture


def unpack_pixels(data: NDArray[np.uint8], bits: int) -> NDArray[Any]:
    """Unpack the pixels of a frame. Shapes: data (n_bytes,) → (8 n_bytes / bits,)."""
    if bits == 8:
        return data
    if bits == 16:
        return data.view("<u2").astype(np.uint16, copy=False)
    if bits == 12:
        first, both, second = data.reshape(-1, 3).astype(np.uint16).T
        return np.stack([first << 4 | both >> 4, (both & 15) << 8 | second], axis=1).ravel()
    a, b, c, d, e = data.reshape(-1, 5).astype(np.uint16).T
    return np.stack(
        [a << 2 | b >> 6, (b & 63) << 4 | c >> 4, (c & 15) << 6 | d >> 2, (d & 3) << 8 | e], axis=1
    ).ravel()  # fmt: skip


def mosaic_brightness(mosaic: NDArray[Any]) -> NDArray[Any]:
    """Return the brightness of a sensor with a colour filter array, for any 2 by 2 pattern: a [1 2 1] kernel both ways.
    Shapes: mosaic (height, width).
    """
    import cv2

    kernel = np.array([0.25, 0.5, 0.25], np.float32)
    return np.rint(cv2.sepFilter2D(mosaic.astype(np.float32), -1, kernel, kernel)).astype(mosaic.dtype)


def read_raw(recording: Recording, raw: RawFrames, region: Region) -> Frames:
    """Read every frame of a camera's own file, straight into one array."""
    name, notes = recording.path.name, list(recording.notes)
    shape = (len(raw.offsets), *region.shape)
    if math.prod(shape) * raw.dtype.itemsize > memory_for_pictures():
        raise too_large(recording)
    luma, n = np.empty(shape, raw.dtype), 0
    for n, picture in enumerate(raw.pictures(), 1):
        luma[n - 1] = picture[region.slices]
    if n == 0:
        raise RecordingError(f"{name}: not one frame is in the file; copy it from the camera again")
    if recording.declared_frames is not None and n < recording.declared_frames:
        notes.append(
            f"{name}: the file holds {n} frames but declares {recording.declared_frames}: cut short; "
            "copy it from the camera again"
        )
    slot, irregular = np.arange(n), ""
    if raw.times_s is not None:
        slot, irregular = slots_from_times(raw.times_s[:n])
    if irregular:
        notes.append(f"{name}: {irregular}")
    return Frames(recording, region, luma[:n], slot, np.zeros(n, dtype=bool), tuple(notes))
