"""Selection of the frames that show the event, so that the rest of a long recording is neither decoded nor held.

A recording stopped by hand may hold thousands of frames of which tens or hundreds show the growth. A recording too
large for memory is sampled first: the key frames of a film, which can be decoded on their own, or every n-th frame of
other files. The event lasts from the first sample that differs from the initial pictures to the last that differs from
the final ones. In a film with few key frames the packet sizes are used instead, if frames at rest take hardly any
bytes.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vinetrack.video.decoding import PacketIndex, decode_packets, packet_index
from vinetrack.video.frames import DECODER_THREADS, Frames, Recording, luma_plane, read_frames, slots_from_times

MAX_BYTES_WHOLE = 400_000_000  # Size of the pictures up to which a recording is read whole (chosen)
MAX_SAMPLES = 400  # Maximum number of samples (chosen)
MAX_SAMPLE_INTERVAL = 120  # Maximum number of frames from one sample to the next (chosen)
SAMPLE_SIZE_PX = 320  # Longer side of the samples, px (chosen)
CHANGE_THRESHOLD = 6.0  # Change of a pixel that counts, in units of its noise (measured)
MIN_CHANGE = 3.0  # Smallest change that counts, grey levels of 255 (chosen)
MIN_CHANGED_PIXELS = 8  # Number of pixels that must have changed (chosen)
NOISE_PAIRS = 40  # Pairs of samples from which the noise is estimated (chosen)
EMPTY_BYTES = 100  # Maximum packet size of a frame that repeats the one before it (measured)
# Something moves where packets are, on average over the second number of frames (chosen)
ACTIVE_RATIO, ACTIVE_FRAMES = 2.0, 9
MARGIN_FRAMES, MARGIN_PART = 40, 0.15  # Frames, and fraction of the event, added at either end (chosen)


def read_event(recording: Recording, frame_range: tuple[int, int] | None = None) -> Frames:
    """Decode the frames that show the event; the whole recording if it is small or if no event stands out."""
    count = recording.declared_frames or 0
    pixel_bytes = 1 if recording.bit_depth <= 8 else 2
    if count * recording.width * recording.height * pixel_bytes <= MAX_BYTES_WHOLE:
        return read_frames(recording)
    if recording.raw is not None:
        return _raw_event(recording, frame_range)
    if recording.kind == "container":
        return _film_event(recording, frame_range)
    return read_frames(recording)


def event_range(pictures: list[NDArray[np.uint8]], numbers: NDArray[np.int_], count: int) -> tuple[int, int] | None:
    """Return the first and last frame of the event, margin included, from samples of the recording. Returns first and
    last frame, both included; None if nothing changes. Shapes: pictures (height, width); numbers (n_pictures,).
    """
    if len(pictures) < 8:
        return None
    import cv2

    reference = pictures[len(pictures) // 2][::2, ::2].astype(np.float32) + 1.0

    def level(picture: NDArray[np.uint8]) -> NDArray[np.float32]:
        # After blurring, values are no longer integers, so that medians resolve noise below one grey level.
        blurred = cv2.blur(picture.astype(np.float32), (3, 3))
        gain = np.clip(np.median((blurred[::2, ::2] + 1.0) / reference), 0.2, 5.0)
        return np.asarray(blurred / np.float32(gain), dtype=np.float32)

    pairs = np.linspace(0, len(pictures) - 2, min(NOISE_PAIRS, len(pictures) - 1)).astype(int)
    steps = [np.abs(level(pictures[i + 1]) - level(pictures[i])) for i in pairs]
    noise = 1.4826 / np.sqrt(2) * np.median(steps, axis=0)
    # The median of three samples at either end shows the scene at rest.
    first, last = (np.median([level(picture) for picture in end], axis=0) for end in (pictures[:3], pictures[-3:]))
    limit = np.maximum(CHANGE_THRESHOLD * np.maximum(noise, np.median(noise)), MIN_CHANGE)

    def differ(still: NDArray[np.float32]) -> NDArray[np.int_]:
        counts = [np.count_nonzero(np.abs(level(picture) - still) > limit) for picture in pictures]
        return np.flatnonzero(np.array(counts) >= MIN_CHANGED_PIXELS)

    differs_from_first, differs_from_last = differ(first), differ(last)
    if not len(differs_from_first) or not len(differs_from_last):
        return None
    start = int(numbers[max(differs_from_first[0] - 1, 0)])
    stop = int(numbers[min(max(differs_from_last[-1], differs_from_first[0]) + 1, len(numbers) - 1)])
    return _with_margin(start, stop, count)


def _film_event(recording: Recording, frame_range: tuple[int, int] | None) -> Frames:
    """Decode the event of a film; the whole film if its packets cannot be assigned to frames."""
    index = packet_index(recording.path)
    if index is None or len(index.pts) < MAX_SAMPLE_INTERVAL:
        return read_frames(recording)
    count = len(index.pts)
    if frame_range is None:
        frame_range = _range_by_packets(recording, index)
    if frame_range is None:
        pictures, numbers = _sample_film(recording, index)
        frame_range = event_range(pictures, numbers, count)
        pictures.clear()
    if frame_range is None or frame_range[0] >= count:
        return read_frames(recording)
    if frame_range == (0, count - 1):
        return read_frames(recording)
    return read_frames(recording, part=(frame_range[0], min(frame_range[1], count - 1), index))


def _range_by_packets(recording: Recording, index: PacketIndex) -> tuple[int, int] | None:
    """Return the first and last frame of the event, margin included, from packet sizes of a film with few key frames. A
    frame that repeats the one before it takes a packet of a few bytes; one in which something moves takes more. The key
    frames before and after the event, which can be decoded on their own, must show that nothing changes there.
    """
    count, keys = len(index.pts), np.flatnonzero(index.key)
    if _keys_suffice(index) or len(keys) < 2:
        return None
    size = np.where(index.key, 0, index.size_bytes).astype(float)
    smallest = float(size[~index.key].min(initial=np.inf))
    mean = np.convolve(size, np.ones(ACTIVE_FRAMES), "same") / np.convolve(~index.key, np.ones(ACTIVE_FRAMES), "same")
    active = np.flatnonzero(mean > ACTIVE_RATIO * smallest)
    if smallest > EMPTY_BYTES or not len(active):
        return None
    first, last = _with_margin(int(active[0]), int(active[-1]), count)
    before, after = keys[keys <= active[0]], keys[keys >= active[-1]]
    if not len(before) or not len(after):
        return None
    sampled = [keys[:: max(1, -(-len(keys) // MAX_SAMPLES))] for keys in (before, after)]
    pictures = _samples_of(recording, index, np.concatenate(sampled), keys_only=True)
    sides = [[pictures[number] for number in numbers if number in pictures] for numbers in sampled]
    if not all(sides) or any(_differ(side[0], picture) for side in sides for picture in side[1:]):
        return None
    return first, last


def _differ(still: NDArray[np.uint8], picture: NDArray[np.uint8]) -> bool:
    """Whether two samples differ by more than noise, apart from a change of brightness."""
    import cv2

    first, second = (cv2.blur(sample.astype(np.float32), (3, 3)) for sample in (still, picture))
    change = np.abs(second * (np.median(first + 1) / np.median(second + 1)) - first)
    limit = max(CHANGE_THRESHOLD * 1.4826 * float(np.median(change)), MIN_CHANGE)
    return bool(np.count_nonzero(change > limit) >= MIN_CHANGED_PIXELS)


def _with_margin(start: int, stop: int, count: int) -> tuple[int, int]:
    """Extend the range of an event by the margin."""
    margin = max(MARGIN_FRAMES, round(MARGIN_PART * (stop - start)))
    return max(start - margin, 0), min(stop + margin, count - 1)


def _keys_suffice(index: PacketIndex) -> bool:
    """Whether key frames are so close to each other that no event fits between two of them."""
    keys = np.flatnonzero(index.key)
    return len(keys) > 1 and max(int(np.diff(keys).max()), len(index.pts) - int(keys[-1])) <= MAX_SAMPLE_INTERVAL


def _sample_film(recording: Recording, index: PacketIndex) -> tuple[list[NDArray[np.uint8]], NDArray[np.int_]]:
    """Sample the key frames of a film or, if these are too rare, every n-th frame of the whole film."""
    keys_only = _keys_suffice(index)
    candidates = np.flatnonzero(index.key) if keys_only else np.arange(len(index.pts))
    pictures = _samples_of(recording, index, candidates[:: max(1, -(-len(candidates) // MAX_SAMPLES))], keys_only)
    numbers = sorted(pictures)
    return [pictures[number] for number in numbers], np.array(numbers, dtype=int)


def _samples_of(
    recording: Recording, index: PacketIndex, numbers: NDArray[np.int_], keys_only: bool
) -> dict[int, NDArray[np.uint8]]:
    """Decode and shrink some frames, by their index; with `keys_only` no other frame is decoded."""
    chosen = {int(index.pts[i]): int(i) for i in numbers}
    pictures = {}
    for frame in decode_packets(recording.path, set(chosen) if keys_only else None, DECODER_THREADS):
        number = None if frame.pts is None else chosen.get(frame.pts)
        if number is not None and (frame.width, frame.height) == (recording.width, recording.height):
            pictures[number] = _shrunk(luma_plane(frame, recording.whole), recording.bit_depth)
    return pictures


def _raw_event(recording: Recording, frame_range: tuple[int, int] | None) -> Frames:
    """Read the event of a file in a camera's own format."""
    raw = recording.raw
    assert raw is not None
    count = len(raw.offsets)
    if frame_range is None:
        every = max(1, -(-count // MAX_SAMPLES))
        chosen = np.arange(0, count, every)
        sparse = replace(raw, offsets=raw.offsets[::every])
        pictures = [_shrunk(picture, recording.bit_depth) for picture in sparse.pictures()]
        frame_range = event_range(pictures, chosen[: len(pictures)], count)
    if frame_range is None or frame_range[0] >= count:
        return read_frames(recording)
    first, last = frame_range[0], min(frame_range[1], count - 1)
    slots, irregular = np.arange(count), ""
    if raw.times_s is not None:
        slots, irregular = slots_from_times(raw.times_s[:count])
    part = replace(raw, offsets=raw.offsets[first : last + 1], times_s=None)
    frames = read_frames(replace(recording, raw=part, declared_frames=len(part.offsets)))
    name = recording.path.name
    notes = [
        f"{name}: of {count} frames only {first} to {last}, around the motion, are read; choose others in frames_used"
    ]
    notes += [f"{name}: {irregular}"] if irregular else []
    end = first + len(frames)
    return replace(
        frames, recording=recording, slot=slots[first:end], notes=(*frames.notes, *notes),
        slots_before=slots[:first], slots_after=slots[end:],
    )  # fmt: skip


def _shrunk(picture: NDArray[Any], bit_depth: int = 8) -> NDArray[np.uint8]:
    """Shrink a picture to at most SAMPLE_SIZE_PX, grey levels of 255."""
    import cv2

    height, width = picture.shape
    factor = max(1.0, max(height, width) / SAMPLE_SIZE_PX)
    size = (max(8, round(width / factor)), max(8, round(height / factor)))
    small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    scale = 1.0 if picture.dtype == np.uint8 else 255.0 / (2**bit_depth - 1)
    return np.asarray(small if scale == 1.0 else np.minimum(small * scale, 255).astype(np.uint8))
