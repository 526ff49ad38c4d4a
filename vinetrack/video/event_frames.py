"""Which frames of a long recording show the event, so that no others need be decoded or held.

A recorder that is stopped by hand holds thousands of frames of which some tens or hundreds show the growth. Of a
recording too large to hold, pictures far apart are looked at first: the key frames of a film, which decode by
themselves, or every so many frames of other files. What differs from the first pictures, or from the last, is the
event. Of a film with few key frames the sizes of packets tell more, where frames at rest take hardly any bytes.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vinetrack.video.decoding import PacketIndex, decode_packets, packet_index
from vinetrack.video.frames import DECODER_THREADS, Frames, Recording, luma_plane, read_frames, slots_from_times

HELD_BYTES = 400_000_000
"""Memory that the pictures of a recording may take without being looked at first. Chosen: 300 frames of 1280 x 1024. At
half recordings of 150 such frames are bracketed, which decodes a few of them twice; at twice the memory doubles."""
LOOKED_AT = 400
"""Pictures that are looked at, at most. Chosen: a recording of 10,000 frames with a key frame every 30 has 333. At half
brackets are wider; at twice a look at a film of key frames alone takes longer than the event."""
SPARSEST = 120
"""Frames from one picture to the next at most. Chosen: an event shorter than that which leaves nothing behind would be
missed; a film with fewer key frames is decoded once to be looked at. At half they are decoded twice for
little."""
LOOK_PX = 320
"""Longer side of the pictures that are compared, px. Chosen near SMALL_PX of `small_pictures`; half or twice takes a
quarter or four times the memory."""
CHANGED = 6.0
"""Change in units of the noise of a pixel that counts. Measured (still pictures of 320 x 256, noise of 1, 3, 6 and 10
grey levels, 120 pictures each, seeds 20980 to 20989): no event was seen in any of 40; at 5 in three. By
reasoning: at half noise widens every bracket; at twice faint film is seen late, for which the margin is."""
LEAST_GREY = 3.0
"""Smallest change that counts, grey levels of 255. Chosen: compression changes resting pixels by one or two. At half it
widens brackets, at twice the first pixels of growth are missed, for which the margin is."""
LEAST_PIXELS = 8
"""Pixels that must have changed. Chosen: the tip of a vine 20 px wide that moves by 10 px. By reasoning: at half glints
count, at twice the first 20 px are missed, for which the margin is."""
NOISE_PAIRS = 40
"""Pairs of pictures from which the noise is known. Chosen: to a tenth of itself in each pixel. At half to a seventh, at
twice twice the memory."""
EMPTY_BYTES = 100
"""Packet of a frame that repeats the one before it, at most. Measured: 20 bytes (H.264, 960 x 540 px). Chosen with room
for larger pictures and other codecs; at half some of those are decoded whole, at twice films of few bits pass, in which
packets of moving frames stand out as well."""
LOUD, LOUD_FRAMES = 2.0, 9
"""Packets that are on average so many times as large as the smallest, over so many frames, show that something moves.
Chosen: a frame with a tip of a few pixels takes three times as much. By reasoning: at half single blocks that are coded
anew count, at twice slow beginnings do not, for which the margin is."""
MARGIN_FRAMES, MARGIN_PART = 40, 0.15
"""Frames, and part of the event, that are added at either end. Chosen: rest and background are seen in them; slow
beginnings change less than LEAST_GREY. By reasoning: at half little rest is left; at twice a short event takes
twice the memory."""


def read_event(recording: Recording, wanted: tuple[int, int] | None = None) -> Frames:
    """Decode the frames that show the event; all of a recording that is small, or in which no event stands out.

    Parameters
    ----------
    recording : from `inspect_recording`.
    wanted : first and last frame that the sheet names, or None: then the event is looked for.

    Returns
    -------
    frames : with their number in the recording, see `Frames.first`.

    Raises
    ------
    RecordingError
        In one sentence, where not one frame can be decoded.
    """
    count = recording.declared_frames or 0
    pixel_bytes = 1 if recording.bit_depth <= 8 else 2
    if count * recording.width * recording.height * pixel_bytes <= HELD_BYTES:
        return read_frames(recording)
    if recording.raw is not None:
        return _raw_event(recording, wanted)
    if recording.kind == "container":
        return _film_event(recording, wanted)
    return read_frames(recording)


def event_range(pictures: list[NDArray[np.uint8]], numbers: NDArray[np.int_], count: int) -> tuple[int, int] | None:
    """First and last frame of the event, with a margin, from pictures far apart.

    Parameters
    ----------
    pictures : small, grey levels of 255, each of shape (height, width).
    numbers : of each in the recording, increasing, shape (n_pictures,).
    count : frames of the recording.

    Returns
    -------
    both included; None where nothing changes.
    """
    if len(pictures) < 8:
        return None
    import cv2

    middle = pictures[len(pictures) // 2][::2, ::2].astype(np.float32) + 1.0

    def level(picture: NDArray[np.uint8]) -> NDArray[np.float32]:
        # Blurred, the values are no whole numbers any more, and medians of them tell of noise below a grey level.
        blurred = cv2.blur(picture.astype(np.float32), (3, 3))
        gain = np.clip(np.median((blurred[::2, ::2] + 1.0) / middle), 0.2, 5.0)
        return np.asarray(blurred / np.float32(gain), dtype=np.float32)

    pairs = np.linspace(0, len(pictures) - 2, min(NOISE_PAIRS, len(pictures) - 1)).astype(int)
    steps = [np.abs(level(pictures[i + 1]) - level(pictures[i])) for i in pairs]
    noise = 1.4826 / np.sqrt(2) * np.median(steps, axis=0)
    # The median of three pictures at either end is rest.
    first, last = (np.median([level(picture) for picture in end], axis=0) for end in (pictures[:3], pictures[-3:]))
    limit = np.maximum(CHANGED * np.maximum(noise, np.median(noise)), LEAST_GREY)

    def differ(still: NDArray[np.float32]) -> NDArray[np.int_]:
        counts = [np.count_nonzero(np.abs(level(picture) - still) > limit) for picture in pictures]
        return np.flatnonzero(np.array(counts) >= LEAST_PIXELS)

    begun, going = differ(first), differ(last)
    if not len(begun) or not len(going):
        return None
    start = int(numbers[max(begun[0] - 1, 0)])
    stop = int(numbers[min(max(going[-1], begun[0]) + 1, len(numbers) - 1)])
    return _with_margin(start, stop, count)


def _film_event(recording: Recording, wanted: tuple[int, int] | None) -> Frames:
    """Frames of a film about its event; all of it where its packets do not tell which frame they are."""
    index = packet_index(recording.path)
    if index is None or len(index.pts) < SPARSEST:
        return read_frames(recording)
    count = len(index.pts)
    if wanted is None:
        wanted = _range_by_packets(recording, index)
    if wanted is None:
        pictures, numbers = _look_into_film(recording, index)
        wanted = event_range(pictures, numbers, count)
        pictures.clear()
    if wanted is None or wanted[0] >= count:
        return read_frames(recording)
    if wanted == (0, count - 1):
        return read_frames(recording)
    return read_frames(recording, part=(wanted[0], min(wanted[1], count - 1), index))


def _range_by_packets(recording: Recording, index: PacketIndex) -> tuple[int, int] | None:
    """First and last frame of the event, with a margin, from the packets of a film with few key frames.

    A frame that repeats the one before it takes a packet of some bytes, and one in which something moves takes more.
    Key frames, which decode by themselves, must show that nothing changes before the event and nothing after it. None
    where even the smallest packets are large, or key frames differ, and the film must be looked into.
    """
    count, keys = len(index.pts), np.flatnonzero(index.key)
    if _keys_suffice(index) or len(keys) < 2:
        return None
    size = np.where(index.key, 0, index.size_bytes).astype(float)
    smallest = float(size[~index.key].min(initial=np.inf))
    mean = np.convolve(size, np.ones(LOUD_FRAMES), "same") / np.convolve(~index.key, np.ones(LOUD_FRAMES), "same")
    loud = np.flatnonzero(mean > LOUD * smallest)
    if smallest > EMPTY_BYTES or not len(loud):
        return None
    first, last = _with_margin(int(loud[0]), int(loud[-1]), count)
    before, after = keys[keys <= loud[0]], keys[keys >= loud[-1]]
    if not len(before) or not len(after):
        return None
    looked_at = [keys[:: max(1, -(-len(keys) // LOOKED_AT))] for keys in (before, after)]
    pictures = _pictures_of(recording, index, np.concatenate(looked_at), alone=True)
    sides = [[pictures[number] for number in numbers if number in pictures] for numbers in looked_at]
    if not all(sides) or any(_differ(side[0], picture) for side in sides for picture in side[1:]):
        return None
    return first, last


def _differ(still: NDArray[np.uint8], picture: NDArray[np.uint8]) -> bool:
    """Whether two small pictures differ by more than noise, apart from their brightness."""
    import cv2

    first, second = (cv2.blur(seen.astype(np.float32), (3, 3)) for seen in (still, picture))
    change = np.abs(second * (np.median(first + 1) / np.median(second + 1)) - first)
    limit = max(CHANGED * 1.4826 * float(np.median(change)), LEAST_GREY)
    return bool(np.count_nonzero(change > limit) >= LEAST_PIXELS)


def _with_margin(start: int, stop: int, count: int) -> tuple[int, int]:
    """First and last frame of an event, and as many more as the margin has."""
    margin = max(MARGIN_FRAMES, round(MARGIN_PART * (stop - start)))
    return max(start - margin, 0), min(stop + margin, count - 1)


def _keys_suffice(index: PacketIndex) -> bool:
    """Whether key frames are so close to each other that no event lies between two of them."""
    keys = np.flatnonzero(index.key)
    return len(keys) > 1 and max(int(np.diff(keys).max()), len(index.pts) - int(keys[-1])) <= SPARSEST


def _look_into_film(recording: Recording, index: PacketIndex) -> tuple[list[NDArray[np.uint8]], NDArray[np.int_]]:
    """Small pictures of key frames, or, where those are too rare, of every so many frames of the whole film."""
    alone = _keys_suffice(index)
    candidates = np.flatnonzero(index.key) if alone else np.arange(len(index.pts))
    pictures = _pictures_of(recording, index, candidates[:: max(1, -(-len(candidates) // LOOKED_AT))], alone)
    numbers = sorted(pictures)
    return [pictures[number] for number in numbers], np.array(numbers, dtype=int)


def _pictures_of(
    recording: Recording, index: PacketIndex, numbers: NDArray[np.int_], alone: bool
) -> dict[int, NDArray[np.uint8]]:
    """Small pictures of some frames by their number; of key frames `alone` no others are decoded."""
    chosen = {int(index.pts[i]): int(i) for i in numbers}
    pictures = {}
    for frame in decode_packets(recording.path, set(chosen) if alone else None, DECODER_THREADS):
        number = None if frame.pts is None else chosen.get(frame.pts)
        if number is not None and (frame.width, frame.height) == (recording.width, recording.height):
            pictures[number] = _shrunk(luma_plane(frame, recording.whole), recording.bit_depth)
    return pictures


def _raw_event(recording: Recording, wanted: tuple[int, int] | None) -> Frames:
    """Frames about the event of a camera's own file."""
    raw = recording.raw
    assert raw is not None
    count = len(raw.offsets)
    if wanted is None:
        every = max(1, -(-count // LOOKED_AT))
        chosen = np.arange(0, count, every)
        sparse = replace(raw, offsets=raw.offsets[::every])
        pictures = [_shrunk(picture, recording.bit_depth) for picture in sparse.pictures()]
        wanted = event_range(pictures, chosen[: len(pictures)], count)
    if wanted is None or wanted[0] >= count:
        return read_frames(recording)
    first, last = wanted[0], min(wanted[1], count - 1)
    slots, irregular = np.arange(count), ""
    if raw.times_s is not None:
        slots, irregular = slots_from_times(raw.times_s[:count])
    part = replace(raw, offsets=raw.offsets[first : last + 1], times_s=None)
    frames = read_frames(replace(recording, raw=part, declared_frames=len(part.offsets)))
    name = recording.path.name
    notes = [f"{name}: of {count} frames {first} to {last} are read, about what moves; name others in frames_used"]
    notes += [f"{name}: {irregular}"] if irregular else []
    end = first + len(frames)
    return replace(
        frames, recording=recording, slot=slots[first:end], notes=(*frames.notes, *notes),
        slots_before=slots[:first], slots_after=slots[end:],
    )  # fmt: skip


def _shrunk(picture: NDArray[Any], bit_depth: int = 8) -> NDArray[np.uint8]:
    """A picture no longer than LOOK_PX, grey levels of 255."""
    import cv2

    height, width = picture.shape
    factor = max(1.0, max(height, width) / LOOK_PX)
    size = (max(8, round(width / factor)), max(8, round(height / factor)))
    small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    scale = 1.0 if picture.dtype == np.uint8 else 255.0 / (2**bit_depth - 1)
    return np.asarray(small if scale == 1.0 else np.minimum(small * scale, 255).astype(np.uint8))
