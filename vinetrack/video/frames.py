"""Reading frames of any recording: brightness as the camera wrote it, and everything that is wrong with the file.

The Y plane is copied straight from the decoder's buffer, since a conversion to grey or colour would cost up to half the
decoding speed. The capture rate is never taken from the container, which only knows the playback rate. DNG frames carry
the true rate (tag 51044) and the exposure (33434), and so do the files of some high-speed cameras (`images`);
other image files carry neither.
"""

from __future__ import annotations

import contextlib
import math
import multiprocessing
import os
import threading
from collections.abc import Container, Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.problems import UserError
from vinetrack.core.records import CAMERA_FILES, CONTAINERS, IMAGES, Bools, Floats, Indices
from vinetrack.core.tables import file_size

if TYPE_CHECKING:
    import av


# ------------------------------------------------------------------------------
# Decoding of video containers, packet by packet, and detection of damaged frames.
#
# A fault in a file seldom stops a decoder: it conceals the fault with an estimate, and the frames that follow are coded
# as differences from that estimate. Only the messages of the decoder tell which frames these are.

# FFmpeg decoders that report damaged frames in their log at best, but do not mark them
NON_MARKING_DECODERS = frozenset(
    {"ffv1", "mjpeg", "prores", "huffyuv", "ffvhuff", "utvideo", "dnxhd", "png", "jpeg2000"}
    | {"hevc", "vp8", "vp9", "libdav1d", "av1"}
)


class Shot(NamedTuple):
    """A picture's time in ticks, whether `corrupt`, a `key` frame, or `between` others (B), coded from later too."""

    tick: float
    corrupt: bool = False
    key: bool = True
    between: bool = False


def film_shots(
    recording: Recording, said: list[Said], span: tuple[int, int] | None = None, chosen: Container[float] | None = None
) -> Generator[tuple[NDArray[Any], Shot]]:
    """Decode a film: all, from a tick to another, or the packets of chosen ticks. A frame is corrupt as the decoder
    marks it, or as it says of the packet, which is added to `said`; an undecodable packet costs only its own frame.
    """
    import av

    try:
        with open_film(recording.path) as container:
            stream = container.streams.video[0]
            marks = stream.codec_context.name not in NON_MARKING_DECODERS
            faulty: set[int | None] = set()
            # With one thread each message belongs to the packet that is decoded; and one costs less where workers share
            # the cores. Else FFmpeg chooses how many.
            stream.thread_type = "AUTO"
            stream.codec_context.thread_count = 0 if marks and multiprocessing.parent_process() is None else 1
            if span is not None:
                container.seek(max(span[0], 0), stream=stream)
            for packet in container.demux(stream):
                if chosen is not None and packet.size and packet.pts not in chosen:
                    continue
                heard, frames = len(said), []
                try:
                    frames = packet.decode()
                except av.error.EOFError:
                    return
                except av.error.FFmpegError as error:
                    said.append((0, "", str(error.strerror or error)))
                if len(said) > heard and not marks:
                    faulty.add(packet.pts)
                for frame in frames:
                    tick = math.nan if frame.pts is None else frame.pts
                    if span is not None and not tick >= span[0]:
                        continue
                    if span is not None and tick > span[1]:
                        return
                    if (frame.height, frame.width) != (recording.height, recording.width):
                        said.append((0, "", "the size of the picture changes"))
                        return
                    is_corrupt = bool(frame.is_corrupt) or frame.pts in faulty
                    # 3: code of a B frame (defined)
                    yield luma_plane(frame), Shot(tick, is_corrupt, bool(frame.key_frame), frame.pict_type == 3)
    except av.error.FFmpegError as error:
        said.append((0, "", str(error.strerror or error)))


def damaged_frames(shots: Sequence[Shot], slot: Indices, complained: bool) -> Bools:
    """Mark frames that are corrupt or coded from corrupt ones, shape (n_frames,). A decoder marks only the frame in
    which it met the fault; those after it, coded as differences from it, are equally wrong, without a message, until
    the next key frame; where it `complained`, so are those after lost ones. Shapes: slot (n_frames,).
    """
    damaged = np.array([shot.corrupt for shot in shots], dtype=bool)
    after_lost = complained & (np.diff(slot, prepend=slot[0]) > 1)
    for i in range(1, len(damaged)):
        damaged[i] |= not shots[i].key and (after_lost[i] or damaged[i - 1])
    for i in range(len(damaged) - 2, -1, -1):
        damaged[i] |= damaged[i + 1] and shots[i].between
    return damaged


class PacketIndex(NamedTuple):
    """All frames of a film in display order: time in ticks, and whether it is a key frame. Shapes (n_frames,)."""

    ticks: NDArray[np.int64]
    key: Bools


def packet_index(path: Path) -> PacketIndex | None:
    """List the frames of a film without decoding them."""
    import av

    ticks, key = [], []
    with quiet_log(), contextlib.suppress(av.error.FFmpegError), av.open(str(path)) as container:
        for packet in container.demux(video=0):
            if not packet.size:
                continue
            if packet.pts is None:
                return None
            ticks.append(packet.pts)
            key.append(packet.is_keyframe)
    order = np.argsort(ticks)
    times = np.array(ticks, dtype=np.int64)[order]
    if len(times) < 2 or np.any(np.diff(times) <= 0):
        return None
    return PacketIndex(times, np.array(key, dtype=bool)[order])


@contextlib.contextmanager
def open_film(path: Path) -> Iterator[av.container.InputContainer]:
    """Open a film for decoding; its decoder is flushed before it is closed. Freeing a decoder waits for its threads
    while holding Python's lock. A thread that has just met a fault waits for that lock to log its message, and both
    wait for ever. A flush waits as well, but releases the lock.
    """
    import av

    with av.open(str(path)) as container:
        try:
            yield container
        finally:
            for stream in container.streams.video:
                if stream.codec_context is not None:
                    stream.codec_context.flush_buffers()


def memory_for_pictures() -> float:
    """Bytes that decoded pictures may take; infinity if the machine's memory is unknown."""
    try:
        # 0.4: fraction of the machine's memory that the pictures of one recording may take (derived)
        return 0.4 * os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        return math.inf


Said = tuple[int, str, str]  # Level, source and text of a message of the decoder

_one_log = threading.RLock()  # The decoder has one log for the whole process


@contextlib.contextmanager
def quiet_log() -> Iterator[list[Said]]:
    """Collect the decoder's messages instead of printing or losing them; the log level is restored afterwards. Films
    that several threads decode wait for each other, or one would count as damaged for the faults of another.
    """
    import av.logging

    with _one_log:
        level = av.logging.get_level()
        av.logging.set_level(av.logging.ERROR)
        av.logging.set_skip_repeated(False)  # Else what two films say alike is heard once, in either
        try:
            with av.logging.Capture(False) as said:
                yield said
        finally:
            av.logging.set_level(level)


# ------------------------------------------------------------------------------
# Detect pictures that are not what the camera saw at their time: odd ones at either end.


def odd_frames(luma: NDArray[Any]) -> Bools:
    """Frames among the first or last few that are cut off from the others, since more of the picture changes than
    growth could: blank ones, or those of another scene or time. Shapes: luma (n_frames, height, width) → (n_frames,).
    """

    def cut_off(pictures: NDArray[Any]) -> int:
        """Number of the first pictures before the last cut."""
        changes = np.abs(np.diff(pictures.astype(np.float32), axis=0))
        # 6.0, 8.0: change of a pixel, in grey levels of 255 and in usual changes, that no noise makes (chosen)
        unlike = changes > max(6.0 * unit, 8.0 * float(np.median(changes)))
        # 0.15: part of the picture that no vine covers in a frame (chosen)
        return 1 + int(np.max(np.flatnonzero(unlike.mean(axis=(1, 2)) > 0.15), initial=-1))

    # 3, 10: frames at either end that may be odd, and one in how many of a long recording (chosen)
    small, some = luma[:, ::4, ::4], max(3, len(luma) // 10) + 1
    unit = 1.0 if luma.dtype == np.uint8 else max(float(small.max()), 1.0) / 255
    odd = np.zeros(len(luma), dtype=bool)
    if len(luma) >= 8:
        odd[: cut_off(small[:some])] = odd[len(luma) - cut_off(small[::-1][:some]) :] = True
    return odd


class RecordingError(UserError, ValueError):
    """A recording that cannot be used: whose it is, what is wrong and what to do; together they are one sentence."""

    def __init__(self, message: str, remedy: str = "", name: str = "") -> None:
        self.message, self.remedy = message, remedy
        self.what = f"{name}: {message}" if name else message
        super().__init__(f"{self.what}; {remedy}" if remedy else self.what)


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


@dataclass(frozen=True)
class Frames:
    """Decoded frames. `luma` has shape (n_frames, height, width), uint8 or uint16; the first is number `first` of those
    recorded. `slots`, shape (n_recorded,), are the numbers of capture periods from the first frame recorded to each,
    from timestamps or from the numbers of image files: 0, 1, 2 … if no frame is missing.
    """

    recording: Recording
    luma: NDArray[Any]
    slots: Indices
    damaged: Bools
    notes: tuple[str, ...] = ()
    first: int = 0

    def __len__(self) -> int:
        return len(self.luma)

    @property
    def slot(self) -> Indices:
        """Slots of the decoded frames, shape (n_frames,)."""
        return self.slots[self.first : self.first + len(self.luma)]


def inspect_recording(path: Path | str) -> Recording:
    """Read the header of a recording; at most one frame is decoded."""
    path = Path(path)
    try:
        size = 1 if path.is_dir() else file_size(path)
    except FileNotFoundError:
        raise RecordingError("there is no such file or folder", name=path.name) from None
    except OSError as error:
        raise RecordingError(f"cannot be read: {error.strerror}", name=path.name) from None
    from vinetrack.video.images import CAMERA_READERS, inspect_images

    if size == 0:
        raise RecordingError("the file is empty", "copy it from the camera again", path.name)
    if path.is_dir() or path.suffix.lower() in IMAGES:
        return inspect_images(path)
    if path.suffix.lower() in CAMERA_FILES:
        return CAMERA_READERS[path.suffix.lower()](path)
    return _inspect_container(path)


def read_frames(
    path: Path | str | Recording, part: tuple[int, int] | None = None, index: PacketIndex | None = None
) -> Frames:
    """Decode all frames of a recording, or those from a frame to another; a part of a film needs its index. Frames that
    cannot be read are left out, or partial or black, and marked damaged.
    """
    recording = path if isinstance(path, Recording) else inspect_recording(path)
    name, notes, declared = recording.path.name, list(recording.notes), recording.declared_frames or 0
    shots: list[Shot] = []

    def pictures() -> Iterator[NDArray[Any]]:
        for picture, shot in taken:
            shots.append(shot)
            yield picture

    # 256: frames for which memory is reserved if a film does not declare their number (chosen)
    count = part[1] - part[0] + 1 if part else declared or 256
    with quiet_log() as said, contextlib.closing(shots_of(recording, said, part, index)) as taken:
        luma = filled(recording, pictures(), count)
    if not len(luma):
        raise RecordingError("not one frame can be read", "copy it from the camera again", name)
    times, number = np.array([shot.tick for shot in shots]), np.arange(len(shots))
    if part is not None and recording.raw is not None:
        number, times = part[0] + number, recording.raw.times
    elif part is not None and index is not None:
        number, times = np.searchsorted(index.ticks, times), index.ticks
    if len(times) < declared:
        notes.append(
            f"{name}: {len(times)} frames are there where the file declares {declared}: cut short or damaged; copy it "
            "from the camera again"
        )
    slots, irregular = slots_from_times(times, max(declared - len(times), 0))
    first, last = int(number[0]), int(number[-1])
    slots = np.concatenate([slots[:first], slots[number], slots[last + 1 :]])
    damaged = damaged_frames(shots, slots[first : first + len(luma)], bool(said))
    if said or damaged.any():
        messages = f" ({len(said)} messages; the first: {said[0][2].strip()})" if said else ""
        notes.append(
            f"{name}: damaged: {int(damaged.sum())} of {len(luma)} frames are corrupt, cut short or coded from such"
            + messages
        )
    if len(luma) < len(times):
        around = f"of {len(times)} frames only {first} to {last}, around the motion, are read"
        notes.append(f"{name}: {around}; choose others in frames_used")
    notes += [f"{name}: {irregular}"] if irregular else []
    return Frames(recording, luma, slots, damaged, tuple(notes), first)


def shots_of(
    recording: Recording, said: list[Said], part: tuple[int, int] | None = None, index: PacketIndex | None = None
) -> Generator[tuple[NDArray[Any], Shot]]:
    """Read one picture after another, of the whole recording or from a frame to another; see `read_frames`."""
    if recording.kind == "container":
        span = (int(index.ticks[part[0]]), int(index.ticks[part[1]])) if part and index else None
        return film_shots(recording, said, span)
    from vinetrack.video.images import picture_shots

    return picture_shots(recording, said, part)


def filled(recording: Recording, pictures: Iterable[NDArray[Any]], count: int) -> NDArray[Any]:
    """Write pictures straight into one array, for `count` of them, longer if more come, unless memory is too small."""
    pixel_bytes = 1 if recording.bit_depth <= 8 else 2
    most = int(min(memory_for_pictures() / (recording.height * recording.width * pixel_bytes), 2**31))
    luma, n = np.empty((0, recording.height, recording.width), np.uint8), 0
    too_large = RecordingError(
        f"its frames of {recording.width} x {recording.height} px do not fit in the memory of this machine",
        "cut it to the growth, and to the part of the picture that shows it",
        recording.path.name,
    )
    if count > most:
        raise too_large
    for n, picture in enumerate(pictures, 1):
        if n > most:
            raise too_large
        if n == 1:  # untouched memory takes no space
            luma = np.empty((count, *picture.shape), picture.dtype)
        if n > len(luma):
            luma = np.concatenate([luma, np.empty_like(luma[: n // 2 + 1])])
        luma[n - 1] = picture
    return luma[:n]


def iterate_frames(recording: Recording) -> Iterator[NDArray[Any]]:
    """Yield one frame after another, as copies."""
    for picture, _ in shots_of(recording, []):
        yield picture.copy()


def luma_plane(frame: av.VideoFrame) -> NDArray[Any]:
    """Return the brightness of a decoded frame, in the decoder's own memory where that holds it."""
    name = frame.format.name
    depth = frame.format.components[0].bits
    if not (name.startswith(("yuv", "gray", "nv12", "nv16", "nv21", "p010")) and frame.format.is_planar) and (
        name not in {"gray", "gray10le", "gray12le", "gray14le", "gray16le"}
    ):
        return frame.to_ndarray(format="gray16le" if depth > 8 else "gray")
    plane = frame.planes[0]
    dtype = np.dtype(np.uint8) if depth <= 8 else np.dtype(">u2" if name.endswith("be") else "<u2")
    rows = np.frombuffer(memoryview(plane), dtype=dtype).reshape(-1, plane.line_size // dtype.itemsize)
    picture = rows[: frame.height, : frame.width]
    return picture.astype(np.uint16) if name.endswith("be") else picture


def _inspect_container(path: Path) -> Recording:
    import av

    try:
        with quiet_log() as said, open_film(path) as container:
            # Formats under which FFmpeg renders any text as a picture of its letters
            if container.format.name in {"tty", "bin", "xbin", "adf", "idf", "svg_pipe"}:
                raise RecordingError("a text, not a recording", "name a film, or a folder of pictures", path.name)
            if not container.streams.video:
                raise RecordingError("holds no video stream", "name a video file", path.name)
            stream = container.streams.video[0]
            first = next(container.decode(stream), None)
            if first is None:
                raise RecordingError("not one frame can be decoded", "the file is damaged or empty", path.name)
            depth = first.format.components[0].bits
            playback = float(stream.average_rate) if stream.average_rate else None
            declared = stream.frames or None
            if declared is None and playback:  # of the header; if absent, duration times playback rate
                seconds = (container.duration or 0) / 1e6
                if stream.duration is not None and stream.time_base is not None:
                    seconds = float(stream.duration * stream.time_base)
                declared = max(round(seconds * playback), 0) or None
            return Recording(path, "container", first.width, first.height, depth, declared, playback_fps=playback)
    except (av.error.FFmpegError, UnicodeDecodeError) as error:
        # PyAV decodes names in a header as UTF-8, which fails for a damaged one.
        why = "not a video, or its beginning is damaged", "copy it from the camera again"
        if path.suffix.lower() not in CONTAINERS:
            why = "not a video that can be read", "save it from the camera as mp4, mov, avi, mkv, DNG or TIFF"
        with path.open("rb") as begin:
            is_film = begin.read(12)[4:8] in {b"ftyp", b"mdat", b"wide", b"free"}
        if is_film and "moov atom not found" in " ".join([*(text for *_, text in said), str(error)]):
            why = "cut short: the index that is written last is missing", "copy the file again, or repair it"
        raise RecordingError(*why, path.name) from error


def slots_from_times(times: NDArray[np.float64], known_missing: int = 0) -> tuple[Indices, str]:
    """Capture period of every frame since the first from its timestamp, both (n_frames,), and a note on irregularities,
    if any. Timestamps are rounded to multiples of their median spacing, so that a missing frame leaves a gap; where
    they repeat, run backwards or fit no common period, frames are numbered consecutively.
    """
    plain = np.arange(len(times))
    if len(times) < 3 or not np.all(np.isfinite(times)):
        return plain, ""
    steps = np.diff(times)
    period = float(np.median(steps))
    if period <= 0 or np.any(steps <= 0):
        return plain, "times repeat or run backwards; frames are timed by their index"
    # Times in whole milliseconds alternate between, say, steps of 16 and 17: over a long gap only their mean is right.
    period = float(np.mean(steps[steps < 1.5 * period]))
    periods = steps / period
    if np.any(np.abs(periods - np.rint(periods)) > 0.25) or np.any(np.rint(periods) < 1):
        return plain, "its frame rate varies; frames are timed by their index"
    slot = np.concatenate([[0], np.cumsum(np.rint(periods).astype(int))])
    missing = int(slot[-1] - plain[-1])
    # Cameras drop single frames; if a tenth of all frames seems missing, the container counts in other units.
    if missing == 0 or missing > max(3, len(times) // 10, known_missing):
        return plain, "" if missing == 0 else "its times are irregular; frames are timed by their index"
    return slot, f"{missing} frames are missing by the times or numbers of the others, which keep their own times"


# ------------------------------------------------------------------------------
# Reading frames stored as the sensor gave them: 8 to 16 bits, packed or not, one frame at a time.
#
# High-speed cameras write such files with headers of their own (`images`). Only one frame is held in memory.

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
    """Location of the frames in a file (`offsets` of their first bytes), and packing of their pixels: `stored_bits` is
    8, 16 (least significant byte first), or packed 10 or 12 (most significant bits first).
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
    def times(self) -> NDArray[Any]:
        """Times of the frames, in seconds where the camera stamped them, else their numbers."""
        n = len(self.offsets)
        return np.arange(n) if self.times_s is None else self.times_s[:n]

    @property
    def frame_bytes(self) -> int:
        """Size of a frame in the file, bytes."""
        return self.width * self.height * self.stored_bits // 8

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
    """Brightness of a sensor with any 2 by 2 colour mosaic: a [1 2 1] kernel both ways. Shape (height, width)."""
    import cv2

    kernel = np.array([0.25, 0.5, 0.25], np.float32)
    return np.rint(cv2.sepFilter2D(mosaic.astype(np.float32), -1, kernel, kernel)).astype(mosaic.dtype)
