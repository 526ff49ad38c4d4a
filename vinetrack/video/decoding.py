"""Frames out of a container, packet by packet, and which of them are damaged.

A fault in a file seldom stops a decoder: it fills in what it guesses, and the frames that follow are coded as
differences to that guess. Only what it says on the way tells which frames those are.
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

UNMARKED = frozenset(
    {"ffv1", "mjpeg", "prores", "huffyuv", "ffvhuff", "utvideo", "dnxhd", "png", "jpeg2000"}
    | {"hevc", "vp8", "vp9", "libdav1d", "av1"}
)
"""Decoders of FFmpeg that at best complain of a damaged frame and do not mark it, since they do not conceal errors.
Those that mark frames (H.264, MPEG-4) complain of harmless things too."""

PREDICTED_BOTH_WAYS = 3
"""Code of a B frame. Defined by FFmpeg (AV_PICTURE_TYPE_B)."""

MEMORY_PART = 0.4
"""Part of the machine's memory that the pictures of one recording may take. Derived: strips of them take as much again
at most, and a fifth is for everything else."""

FEW = 256
"""Frames for which there is place where a film does not declare how many it has; a half more whenever that is full.
Chosen; at half or twice one is copied once more or less."""

HALF_TICK = 0.5
"""Of a film's unit of time: times are whole numbers of it. Derived."""


@dataclass
class Decoded:
    """Frames in the order in which they are shown: pictures, times (NaN where unknown), and how each was coded.

    `pictures` has shape (n_frames, height, width).
    `corrupt` marks those that the decoder calls so, `key` those coded alone, `between` those coded from later frames
    too; `complaints` are what the decoder said, and `decoder` is its name.
    """

    pictures: NDArray[Any] = field(default_factory=lambda: np.empty((0, 0, 0), np.uint8))
    times_s: list[float] = field(default_factory=list)
    corrupt: list[bool] = field(default_factory=list)
    key: list[bool] = field(default_factory=list)
    between: list[bool] = field(default_factory=list)
    complaints: list[str] = field(default_factory=list)
    decoder: str = ""


def decode_container(
    path: Path,
    shape: tuple[int, int],
    picture_of: Callable[[av.VideoFrame], NDArray[Any]],
    threads: int,
    expected: int | None = None,
    between_s: tuple[float, float] | None = None,
) -> Decoded:
    """Decode every frame; a packet that cannot be decoded costs its own frame, not all that follow.

    Pictures go straight into one array, so that they are held once.

    Parameters
    ----------
    path : of a film.
    shape : height and width that every frame must have, px; decoding ends at the first that has another.
    picture_of : what is kept of a frame.
    threads : of the decoder.
    expected : frames that the file declares; None where it does not.
    between_s : times of the first and last frame that are wanted, s; all where None.

    Returns
    -------
    frames and complaints.

    Raises
    ------
    MemoryError
        If the pictures take more than MEMORY_PART of the machine's memory.
    """
    import av

    decoded, room = Decoded(), memory_for_pictures()
    held: NDArray[Any] | None = None
    with quiet_log() as complaints:
        try:
            with opened(path) as container:
                stream = container.streams.video[0]
                stream.thread_type = "AUTO"
                stream.codec_context.thread_count = threads
                decoded.decoder = stream.codec_context.name
                base = float(stream.time_base) if stream.time_base else 1.0
                if between_s is not None:
                    container.seek(max(int(between_s[0] / base), 0), stream=stream)
                for frame in _frames_of(container.demux(stream), complaints):
                    if between_s is not None and frame.pts is not None:
                        if frame.pts * base < between_s[0] - HALF_TICK * base:
                            continue
                        if frame.pts * base > between_s[1] + HALF_TICK * base:
                            break
                    if (frame.height, frame.width) != shape:
                        complaints.append("the size of the picture changes")
                        break
                    picture = picture_of(frame)
                    n = len(decoded.times_s)
                    if (n + 1) * picture.nbytes > room:
                        raise MemoryError
                    if held is None or n == len(held):
                        held = _longer(held, picture, expected, room)
                    held[n] = picture
                    _keep(decoded, frame, base)
        except av.error.FFmpegError as error:
            complaints.append(str(error.strerror or error))
    decoded.complaints = list(complaints)
    if held is not None:
        decoded.pictures = held[: len(decoded.times_s)]
    if decoded.complaints and decoded.times_s and decoded.decoder in UNMARKED:
        marked = _times_complained_of(path)
        decoded.corrupt = [time_s in marked for time_s in decoded.times_s]
    return decoded


def damaged_frames(decoded: Decoded, slot: NDArray[np.int_]) -> Bools:
    """Frames that are corrupt or made from corrupt ones, shape (n_frames,).

    A decoder calls only the frame corrupt in which it met the fault. Those that follow are coded as differences to it
    and are as wrong, without a word, up to the next frame that is coded alone; so are those that follow a frame which
    the decoder gave up, and those that are shown before a corrupt frame but coded from it.

    Parameters
    ----------
    decoded : from `decode_container`.
    slot : capture period of every frame, shape (n_frames,).

    Returns
    -------
    mask, shape (n_frames,).
    """
    damaged = np.array(decoded.corrupt, dtype=bool)
    if decoded.complaints:
        damaged[1:] |= (np.diff(slot) > 1) & ~np.array(decoded.key[1:], dtype=bool)
    for i in range(1, len(damaged)):
        damaged[i] |= damaged[i - 1] and not decoded.key[i]
    for i in range(len(damaged) - 2, -1, -1):
        damaged[i] |= damaged[i + 1] and decoded.between[i]
    return damaged


def _longer(held: NDArray[Any] | None, picture: NDArray[Any], expected: int | None, room: float) -> NDArray[Any]:
    """Place for more pictures; memory that nothing is written to takes none."""
    if held is None:
        count = expected if expected and expected * picture.nbytes <= room else FEW
        return np.empty((count, *picture.shape), picture.dtype)
    longer = np.empty((len(held) + len(held) // 2 + 1, *held.shape[1:]), held.dtype)
    longer[: len(held)] = held
    return longer


@dataclass(frozen=True)
class PacketIndex:
    """Every frame of a film in the order in which it is shown: `pts` in units of `base_s`, and whether it is a key one.

    `size_bytes` is that of its packet. Shapes (n_frames,).
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
    """List the frames of a film without decoding them.

    Parameters
    ----------
    path : of a film.

    Returns
    -------
    index : None where packets bear no times, or the same ones.
    """
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
    """Decode packets of a film, by themselves.

    Parameters
    ----------
    path : of a film.
    chosen : presentation times of those to be decoded, which must be key frames; None for all.
    threads : of the decoder.

    Yields
    ------
    frames, those that cannot be decoded left out.
    """
    with quiet_log() as complaints, opened(path) as container:
        stream = container.streams.video[0]
        stream.thread_type = "AUTO"
        stream.codec_context.thread_count = threads
        packets = container.demux(stream)
        wanted = (packet for packet in packets if chosen is None or not packet.size or packet.pts in chosen)
        yield from _frames_of(wanted, complaints)


@contextlib.contextmanager
def opened(path: Path) -> Iterator[av.container.InputContainer]:
    """Open a film to decode it; its decoder comes to rest before it is closed.

    A decoder that is freed waits for its threads, and Python with it. A thread that has just met a fault waits for
    Python to take its complaint, and both wait for ever; a flush waits as well, but lets Python go on.

    Parameters
    ----------
    path : of a film.

    Yields
    ------
    container
    """
    import av

    with av.open(str(path)) as container:
        try:
            yield container
        finally:
            for stream in container.streams.video:
                if stream.codec_context is not None:
                    stream.codec_context.flush_buffers()


def _keep(decoded: Decoded, frame: av.VideoFrame, base_s: float) -> None:
    decoded.times_s.append(math.nan if frame.pts is None else frame.pts * base_s)
    decoded.corrupt.append(bool(frame.is_corrupt))
    decoded.key.append(bool(frame.key_frame))
    decoded.between.append(frame.pict_type == PREDICTED_BOTH_WAYS)


def _frames_of(packets: Iterator[av.Packet[Any]], complaints: list[str]) -> Iterator[av.VideoFrame]:
    """Frames of a container's packets; packets that cannot be decoded are left out and complained of."""
    import av

    for packet in packets:
        try:
            yield from packet.decode()
        except av.error.EOFError:
            return
        except av.error.FFmpegError as error:
            complaints.append(str(error.strerror or error))


def _times_complained_of(path: Path) -> set[float]:
    """Times of the packets that a decoder complained of.

    Decoded once more, by one thread, so that it is known which packet a complaint is about.
    """
    import av
    import av.logging

    marked: set[float] = set()
    with quiet_log(), opened(path) as container, contextlib.suppress(av.error.FFmpegError):
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
    """Bytes that decoded pictures may take; infinity where the machine does not say how much it has."""
    try:
        return MEMORY_PART * os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        return math.inf


class quiet_log:  # noqa: N801 - used as a context, like a function
    """Collect the decoder's complaints instead of printing or losing them; the log level is put back."""

    def __enter__(self) -> list[str]:
        import av.logging

        self._level = av.logging.get_level()
        av.logging.set_level(av.logging.ERROR)
        self._capture = av.logging.Capture(False)
        self._logs = self._capture.__enter__()
        self._complaints: list[str] = []
        return self._complaints

    def __exit__(self, *exc: object) -> None:
        import av.logging

        self._capture.__exit__(None, None, None)
        self._complaints.extend(message.strip() for _, _, message in self._logs)
        av.logging.set_level(self._level)
