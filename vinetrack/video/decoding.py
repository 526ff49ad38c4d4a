"""Frames out of a container, packet by packet, and which of them are damaged.

A fault in a file seldom stops a decoder: it fills in what it guesses, and the frames that follow are coded as
differences to that guess. Only what it says on the way tells which frames those are.
"""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Bools

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
"""Part of the machine's memory that the pictures of one recording may take. Derived: they are held twice while they are
put in one array, and a fifth is for everything else."""


@dataclass
class Decoded:
    """Frames in the order in which they are shown: pictures, times (NaN where unknown), and how each was coded.

    `corrupt` marks those that the decoder calls so, `key` those coded alone, `between` those coded from later frames
    too; `complaints` are what the decoder said.
    """

    pictures: list[NDArray[Any]] = field(default_factory=list)
    times_s: list[float] = field(default_factory=list)
    corrupt: list[bool] = field(default_factory=list)
    key: list[bool] = field(default_factory=list)
    between: list[bool] = field(default_factory=list)
    complaints: list[str] = field(default_factory=list)


def decode_container(
    path: Path, shape: tuple[int, int], picture_of: Callable[[av.VideoFrame], NDArray[Any]], threads: int
) -> Decoded:
    """Decode every frame; a packet that cannot be decoded costs its own frame, not all that follow.

    Parameters
    ----------
    path : of a film.
    shape : height and width that every frame must have, px; decoding ends at the first that has another.
    picture_of : what is kept of a frame.
    threads : of the decoder.

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
    with quiet_log() as complaints:
        try:
            with av.open(str(path)) as container:
                stream = container.streams.video[0]
                stream.thread_type = "AUTO"
                stream.codec_context.thread_count = threads
                decoder = stream.codec_context.name
                base = float(stream.time_base) if stream.time_base else 1.0
                for frame in _frames_of(container.demux(stream), complaints):
                    if (frame.height, frame.width) != shape:
                        complaints.append("the size of the picture changes")
                        break
                    _keep(decoded, frame, picture_of(frame), base)
                    room -= decoded.pictures[-1].nbytes
                    if room < 0:
                        raise MemoryError
        except av.error.FFmpegError as error:
            complaints.append(str(error.strerror or error))
    decoded.complaints = list(complaints)
    if decoded.complaints and decoded.pictures and decoder in UNMARKED:
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


def _keep(decoded: Decoded, frame: av.VideoFrame, picture: NDArray[Any], base_s: float) -> None:
    decoded.pictures.append(picture)
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
    with quiet_log(), av.open(str(path)) as container, contextlib.suppress(av.error.FFmpegError):
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
