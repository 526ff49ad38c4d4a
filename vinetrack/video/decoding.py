"""Decoding of video containers, packet by packet, and detection of damaged frames.

A fault in a file seldom stops a decoder: it conceals the fault with an estimate, and the frames that follow are coded
as differences from that estimate. Only the messages of the decoder tell which frames these are.
"""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Callable, Container, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Bools, Floats

if TYPE_CHECKING:
    import av

# FFmpeg decoders that report damaged frames in their log at best, but do not mark them
NON_MARKING_DECODERS = frozenset(
    {"ffv1", "mjpeg", "prores", "huffyuv", "ffvhuff", "utvideo", "dnxhd", "png", "jpeg2000"}
    | {"hevc", "vp8", "vp9", "libdav1d", "av1"}
)


HALF_TICK = 0.5  # Half a tick of a film's time base; times are whole ticks (derived)


@dataclass
class Decoded:
    """Decoded frames in display order, with their times (NaN where unknown) and types. `pictures` has shape (n_frames,
    height, width). `corrupt` marks frames that the decoder calls corrupt, `key` key frames, `between` B frames, which
    are coded from later frames too.
    """

    pictures: NDArray[Any] = field(default_factory=lambda: np.empty((0, 0, 0), np.uint8))
    times_s: list[float] = field(default_factory=list)
    corrupt: list[bool] = field(default_factory=list)
    key: list[bool] = field(default_factory=list)
    between: list[bool] = field(default_factory=list)
    messages: list[str] = field(default_factory=list)
    decoder: str = ""


def decode_container(
    path: Path,
    shape: tuple[int, int],
    picture_of: Callable[[av.VideoFrame], NDArray[Any]],
    threads: int,
    expected: int | None = None,
    between_s: tuple[float, float] | None = None,
) -> Decoded:
    """Decode every frame; a packet that cannot be decoded costs only its own frame. Pictures are written straight into
    one array, so that they are held in memory once.
    """
    import av

    decoded, available_bytes = Decoded(), memory_for_pictures()
    buffer: NDArray[Any] | None = None
    with quiet_log() as messages:
        try:
            with open_film(path) as container:
                stream = container.streams.video[0]
                stream.thread_type = "AUTO"
                stream.codec_context.thread_count = threads
                decoded.decoder = stream.codec_context.name
                base = float(stream.time_base) if stream.time_base else 1.0
                if between_s is not None:
                    container.seek(max(int(between_s[0] / base), 0), stream=stream)
                for frame in _frames_of(container.demux(stream), messages):
                    if between_s is not None:
                        if frame.pts is None or frame.pts * base < between_s[0] - HALF_TICK * base:
                            continue
                        if frame.pts * base > between_s[1] + HALF_TICK * base:
                            break
                    if (frame.height, frame.width) != shape:
                        messages.append("the size of the picture changes")
                        break
                    picture = picture_of(frame)
                    n = len(decoded.times_s)
                    if (n + 1) * picture.nbytes > available_bytes:
                        raise MemoryError
                    if buffer is None or n == len(buffer):
                        buffer = _enlarged(buffer, picture, expected, available_bytes)
                    buffer[n] = picture
                    _record_frame(decoded, frame, base)
        except av.error.FFmpegError as error:
            messages.append(str(error.strerror or error))
    decoded.messages = list(messages)
    if buffer is not None:
        decoded.pictures = buffer[: len(decoded.times_s)]
    if decoded.messages and decoded.times_s and decoded.decoder in NON_MARKING_DECODERS:
        marked = _times_of_faulty_packets(path)
        decoded.corrupt = [time_s in marked for time_s in decoded.times_s]
    return decoded


def damaged_frames(decoded: Decoded, slot: NDArray[np.int_]) -> Bools:
    """Mark frames that are corrupt or coded from corrupt frames, shape (n_frames,). A decoder marks only the frame in
    which it met the fault. The frames after it are coded as differences from it and are equally wrong, without a
    message, until the next key frame. Shapes: slot (n_frames,) → (n_frames,).
    """
    damaged = np.array(decoded.corrupt, dtype=bool)
    if decoded.messages:
        damaged[1:] |= (np.diff(slot) > 1) & ~np.array(decoded.key[1:], dtype=bool)
    for i in range(1, len(damaged)):
        damaged[i] |= damaged[i - 1] and not decoded.key[i]
    for i in range(len(damaged) - 2, -1, -1):
        damaged[i] |= damaged[i + 1] and decoded.between[i]
    return damaged


def _enlarged(
    buffer: NDArray[Any] | None, picture: NDArray[Any], expected: int | None, available_bytes: float
) -> NDArray[Any]:
    """Return a larger buffer with the same frames; untouched memory takes no space."""
    if buffer is None:
        # 256: frames for which memory is reserved if a film does not declare their number (chosen)
        count = expected if expected and expected * picture.nbytes <= available_bytes else 256
        return np.empty((count, *picture.shape), picture.dtype)
    enlarged = np.empty((len(buffer) + len(buffer) // 2 + 1, *buffer.shape[1:]), buffer.dtype)
    enlarged[: len(buffer)] = buffer
    return enlarged


@dataclass(frozen=True)
class PacketIndex:
    """All frames of a film in display order, shapes (n_frames,). `pts` is the presentation time in units of `base_s`,
    `key` marks key frames, `size_bytes` is the size of the packet.
    """

    pts: NDArray[np.int64]
    key: Bools
    base_s: float
    size_bytes: NDArray[np.int64]

    @property
    def times_s(self) -> Floats:
        """Time of every frame, s."""
        return np.asarray(self.pts * self.base_s, dtype=np.float64)


def packet_index(path: Path) -> PacketIndex | None:
    """List the frames of a film without decoding them."""
    import av

    pts, key, size = [], [], []
    with quiet_log(), contextlib.suppress(av.error.FFmpegError), av.open(str(path)) as container:
        stream = container.streams.video[0]
        base = float(stream.time_base) if stream.time_base else 1.0
        for packet in container.demux(stream):
            if not packet.size:
                continue
            if packet.pts is None:
                return None
            pts.append(packet.pts)
            key.append(packet.is_keyframe)
            size.append(packet.size)
    order = np.argsort(pts)
    times = np.array(pts, dtype=np.int64)[order]
    if len(times) < 2 or np.any(np.diff(times) <= 0):
        return None
    return PacketIndex(times, np.array(key, dtype=bool)[order], base, np.array(size, dtype=np.int64)[order])


def decode_packets(path: Path, chosen: Container[int] | None, threads: int) -> Iterator[av.VideoFrame]:
    """Decode selected packets of a film."""
    with quiet_log() as messages, open_film(path) as container:
        stream = container.streams.video[0]
        stream.thread_type = "AUTO"
        stream.codec_context.thread_count = threads
        packets = container.demux(stream)
        wanted = (packet for packet in packets if chosen is None or not packet.size or packet.pts in chosen)
        yield from _frames_of(wanted, messages)


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


def _record_frame(decoded: Decoded, frame: av.VideoFrame, base_s: float) -> None:
    decoded.times_s.append(math.nan if frame.pts is None else frame.pts * base_s)
    decoded.corrupt.append(bool(frame.is_corrupt))
    decoded.key.append(bool(frame.key_frame))
    # 3: code of a B frame (defined)
    decoded.between.append(frame.pict_type == 3)


def _frames_of(packets: Iterator[av.Packet[Any]], messages: list[str]) -> Iterator[av.VideoFrame]:
    """Yield the frames of packets; packets that cannot be decoded are skipped and their errors recorded."""
    import av

    for packet in packets:
        try:
            yield from packet.decode()
        except av.error.EOFError:
            return
        except av.error.FFmpegError as error:
            messages.append(str(error.strerror or error))


def _times_of_faulty_packets(path: Path) -> set[float]:
    """Return the times of the packets about which the decoder logs an error. The film is decoded once more, with one
    thread, so that each message can be assigned to its packet.
    """
    import av
    import av.logging

    marked: set[float] = set()
    with quiet_log(), open_film(path) as container, contextlib.suppress(av.error.FFmpegError):
        stream = container.streams.video[0]
        stream.codec_context.thread_count = 1
        base = float(stream.time_base) if stream.time_base else 1.0
        for packet in container.demux(stream):
            with av.logging.Capture(True) as messages, contextlib.suppress(av.error.FFmpegError):
                packet.decode()
            if messages and packet.pts is not None:
                marked.add(packet.pts * base)
    return marked


def memory_for_pictures() -> float:
    """Bytes that decoded pictures may take; infinity if the machine's memory is unknown."""
    try:
        # 0.4: fraction of the machine's memory that the pictures of one recording may take (derived)
        return 0.4 * os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        return math.inf


class quiet_log:  # noqa: N801 - used as a context, like a function
    """Collect the decoder's messages instead of printing or losing them; the log level is restored afterwards."""

    def __enter__(self) -> list[str]:
        import av.logging

        self._level = av.logging.get_level()
        av.logging.set_level(av.logging.ERROR)
        self._capture = av.logging.Capture(False)
        self._logs = self._capture.__enter__()
        self._messages: list[str] = []
        return self._messages

    def __exit__(self, *exc: object) -> None:
        import av.logging

        self._capture.__exit__(None, None, None)
        self._messages.extend(message.strip() for _, _, message in self._logs)
        av.logging.set_level(self._level)
