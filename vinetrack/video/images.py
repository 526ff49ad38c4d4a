"""Read recordings that are image files: a numbered folder of PNG, JPEG, TIFF, DNG or BMP, or one TIFF stack."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vinetrack.core.files import NOT_A_FILE, is_pipe_or_device
from vinetrack.video.camera_headers import side_file_of
from vinetrack.video.frames import IMAGES, Frames, Recording, RecordingError, Region
from vinetrack.video.raw_frames import mosaic_brightness, unpack_pixels

TAG_EXPOSURE = 33434  # Defined by TIFF/EP (ISO 12234-2): exposure time

TAG_FRAME_RATE = 51044  # Defined by CinemaDNG: frame rate

JPEG_END, PNG_END = b"\xff\xd9", b"IEND\xaeB`\x82"


def inspect_images(path: Path) -> Recording:
    """Read the facts of a folder of images or a TIFF stack from its first picture."""
    if path.is_dir():
        files, numbers, notes = _numbered_files(path)
        kind = "folder"
    else:
        files, numbers, notes = (path,), (), ()
        kind = "stack"
        if path.stat().st_size == 0:
            raise RecordingError(f"{path.name}: the file is empty; copy it from the camera again")
    readable = next((p for p in map(_read_or_none, files[:3]) if p is not None), None)
    if readable is None:
        raise RecordingError(f"{path.name}: {files[0].name} is not an image that can be read")
    depth = 8 if readable.dtype == np.uint8 else 16
    fps, exposure = _dng_clock(files[0]) if files[0].suffix.lower() == ".dng" else (None, None)
    count = _pages(path) if kind == "stack" else len(files)
    height, width = readable.shape
    side = side_file_of(path, files[0].suffix.lower().removeprefix("."), (width, height), count)
    if side is not None and fps is None:
        fps, exposure, depth, notes = side.rate, side.exposure_s, side.depth or depth, (*notes, *side.notes)
    return Recording(path, kind, width, height, depth, count, fps, exposure, files, numbers, notes)


def read_images(recording: Recording, region: Region) -> Frames:
    """Read every picture; one that is truncated or cannot be read is partial or black, and marked damaged."""
    name = recording.path.name
    notes = list(recording.notes)
    if recording.kind == "stack":
        pictures = [p[region.slices] for p in _stack_pages(recording)]
        damaged = [False] * len(pictures)
        if recording.declared_frames is not None and len(pictures) < recording.declared_frames:
            notes.append(
                f"{name}: {len(pictures)} pages read where the stack declares {recording.declared_frames}: cut short"
            )
    else:
        pictures, damaged = _read_folder(recording, region)
    if not pictures or all(damaged):
        raise RecordingError(f"{name}: not one picture can be read; the files are damaged")
    if any(damaged):
        bad = [f.name for f, d in zip(recording.files, damaged, strict=True) if d]
        notes.append(
            f"{name}: damaged: {len(bad)} of {len(pictures)} pictures are cut short or unreadable, first {bad[0]}"
        )
    slot = np.arange(len(pictures))
    if recording.numbers:
        slot, missing = _capture_periods(np.array(recording.numbers))
        if missing:
            notes.append(f"{name}: {missing} pictures are missing by their numbers; the others keep their own time")
    return Frames(recording, region, np.stack(pictures), slot, np.array(damaged, dtype=bool), tuple(notes))


def iterate_images(recording: Recording, region: Region) -> Iterator[NDArray[Any]]:
    """Yield the region of each picture that can be read."""
    if recording.kind == "stack":
        for page in _stack_pages(recording):
            yield page[region.slices]
        return
    for file in recording.files:
        picture = _read_or_none(file)
        if picture is not None and picture.shape == (recording.height, recording.width):
            yield picture[region.slices]


def _numbered_files(folder: Path) -> tuple[tuple[Path, ...], tuple[int, ...], tuple[str, ...]]:
    """Images of the folder in the order of their numbers; those not named like the majority are left out."""
    images = sorted(f for f in folder.iterdir() if f.suffix.lower() in IMAGES and not f.name.startswith("."))
    if not images:
        raise RecordingError(f"{folder.name}: the folder holds no images; expected PNG, JPEG, TIFF or DNG frames")
    if unreadable := next(filter(is_pipe_or_device, images), None):
        raise RecordingError(f"{folder.name}: {unreadable.name} cannot be read: {NOT_A_FILE}")
    groups: dict[tuple[str, str], list[tuple[int, Path]]] = {}
    for file in images:
        match = re.fullmatch(r"(.*?)(\d+)\D*", file.stem)
        if match:
            groups.setdefault((match.group(1), file.suffix.lower()), []).append((int(match.group(2)), file))
    if not groups:
        return tuple(images), (), ()
    longest = max(groups, key=lambda name: len(groups[name]))
    group = sorted(groups[longest])
    files = tuple(file for _, file in group)
    numbers = tuple(number for number, _ in group)
    left_out = [f.name for f in images if f not in set(files)]
    note = (
        f"{folder.name}: {len(left_out)} images not numbered like the rest are left out, first {left_out[0]}"
        if left_out
        else ""
    )
    return files, numbers, (note,) if note else ()


def _capture_periods(numbers: NDArray[np.int_]) -> tuple[NDArray[np.int_], int]:
    """Capture periods from the numbers of the files, which may count in any step, and how many are missing."""
    consecutive = np.arange(len(numbers))
    if len(numbers) < 3:
        return consecutive, 0
    steps = np.diff(numbers)
    step = int(np.median(steps))
    if step <= 0 or np.any(steps % step) or np.any(steps <= 0):
        return consecutive, 0
    slot = np.concatenate([[0], np.cumsum(steps // step)])
    missing = int(slot[-1] - consecutive[-1])
    return (slot, missing) if missing <= max(3, len(numbers) // 10) else (consecutive, 0)


def _read_folder(recording: Recording, region: Region) -> tuple[list[NDArray[Any]], list[bool]]:
    """The pictures of a folder, and which are damaged."""
    pictures: list[NDArray[Any]] = []
    damaged: list[bool] = []
    dtype = np.uint8 if recording.bit_depth == 8 else np.uint16
    for file in recording.files:
        picture = _read_or_none(file)
        bad = picture is None or picture.shape != (recording.height, recording.width) or not _has_end_marker(file)
        if picture is None or picture.shape != (recording.height, recording.width):
            picture = np.zeros((recording.height, recording.width), dtype)
        pictures.append(picture[region.slices].astype(dtype, copy=False))
        damaged.append(bad)
    return pictures, damaged


def _has_end_marker(file: Path) -> bool:
    """Whether a JPEG or PNG has its end marker: decoders silently fill a missing part with grey."""
    suffix = file.suffix.lower()
    if suffix not in {".jpg", ".jpeg", ".png"}:
        return True
    with file.open("rb") as stream:
        stream.seek(max(file.stat().st_size - 64, 0))
        end = stream.read()
    return (PNG_END if suffix == ".png" else JPEG_END) in end


def _read_or_none(file: Path) -> NDArray[Any] | None:
    """One picture as brightness, uint8 or uint16; None where it cannot be read."""
    import cv2

    try:
        if file.stat().st_size == 0:
            return None
        if file.suffix.lower() == ".dng":
            return _read_dng(file)
        picture = cv2.imread(str(file), cv2.IMREAD_ANYDEPTH)
    except (cv2.error, OSError, ValueError, IndexError, KeyError):
        return None
    if picture is None or picture.dtype not in (np.uint8, np.uint16):
        return None
    return np.asarray(picture)


def _pages(path: Path) -> int:
    """Number of pages of a TIFF stack."""
    import cv2

    return int(cv2.imcount(str(path), cv2.IMREAD_ANYDEPTH))


def _stack_pages(recording: Recording) -> Iterator[NDArray[Any]]:
    """Pages of a TIFF stack in order, up to the first that cannot be read."""
    import cv2

    count = recording.declared_frames or 0
    for start in range(0, count, 64):
        ok, pages = cv2.imreadmulti(str(recording.path), start, min(64, count - start), flags=cv2.IMREAD_ANYDEPTH)
        if not ok:
            return
        for page in pages:
            if page.shape != (recording.height, recording.width):
                return
            yield np.asarray(page)


def _dng_pages(tiff: Any) -> Iterator[Any]:
    """Pages of a DNG file with their sub-pages."""
    for page in tiff.pages:
        yield page
        yield from page.pages or ()


def _dng_clock(file: Path) -> tuple[float | None, float | None]:
    """Capture rate and exposure of a CinemaDNG frame (tags 51044 and 33434); None where absent."""
    import tifffile

    values: dict[int, float] = {}
    with tifffile.TiffFile(file) as tiff:
        for page in _dng_pages(tiff):
            for code in (TAG_FRAME_RATE, TAG_EXPOSURE):
                if code in page.tags and code not in values:
                    value = page.tags[code].value
                    top, bottom = (value[0], value[1]) if isinstance(value, tuple) else (value, 1)
                    if bottom:
                        values[code] = float(top) / float(bottom)
    return values.get(TAG_FRAME_RATE), values.get(TAG_EXPOSURE)


def _read_dng(file: Path) -> NDArray[np.uint16]:
    """Raw values of a DNG; a colour mosaic is levelled by a [1 2 1] kernel, fair to every 2 by 2 pattern."""
    import tifffile

    with tifffile.TiffFile(file) as tiff:
        pages = [p for p in _dng_pages(tiff) if p.photometric in (32803, 34892, 1, 2)]
        page = max(pages, key=lambda p: int(p.imagewidth) * int(p.imagelength) * (2 if p.photometric == 32803 else 1))
        if page.compression == 1 and page.bitspersample == 12:
            raw = _unpack_12_bit(file, page)
        else:
            raw = np.asarray(page.asarray())
        mosaic = page.photometric == 32803
    if raw.ndim == 3:
        raw = np.rint(raw[..., :3].astype(np.float32) @ np.array([0.299, 0.587, 0.114], np.float32)).astype(raw.dtype)
    if mosaic:
        raw = mosaic_brightness(raw)
    return raw.astype(np.uint16)


def _unpack_12_bit(file: Path, page: Any) -> NDArray[np.uint16]:
    """Unpack two pixels from three bytes, most significant bits first, rows beginning on whole bytes."""
    with file.open("rb") as stream:
        parts = []
        for offset, count in zip(page.dataoffsets, page.databytecounts, strict=True):
            stream.seek(offset)
            parts.append(stream.read(count))
    height, width = int(page.imagelength), int(page.imagewidth)
    row = (width * 12 + 7) // 8
    data = np.frombuffer(b"".join(parts), np.uint8)[: height * row].reshape(height, row)
    padded = np.pad(data, ((0, 0), (0, -row % 3)))
    return unpack_pixels(padded.ravel(), 12).reshape(height, -1)[:, :width]
