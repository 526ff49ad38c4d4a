"""Reading frames stored as the sensor gave them: 8 to 16 bits, packed or not, one frame at a time.

High-speed cameras write such files with headers of their own (`camera_headers`). Only the current frame is held in
memory.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import Floats
from vinetrack.video.decoding import memory_for_pictures
from vinetrack.video.frames import Frames, Recording, RecordingError, Region, slots_from_times, too_large

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
