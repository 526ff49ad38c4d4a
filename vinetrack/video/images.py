"""Read recordings that are image files (a numbered folder, a TIFF stack) or files of high-speed cameras."""

from __future__ import annotations

import itertools
import re
import struct
from collections.abc import Generator, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, BinaryIO
from xml.etree import ElementTree

import cv2
import numpy as np
from numpy.typing import NDArray

from vinetrack.core.records import SIDE_FILES, Floats, Trial
from vinetrack.core.tables import NOT_A_FILE, file_size
from vinetrack.video.frames import (
    IMAGES,
    RawFrames,
    Recording,
    RecordingError,
    Said,
    Shot,
    mosaic_brightness,
    unpack_pixels,
)

# ------------------------------------------------------------------------------
# Rate and exposure of capture: what the recording states, else the sheet; never the playback rate.

SAME_RATE = 0.005  # Relative difference within which two rates are the same (derived)


def capture_rate(trial: Trial, recording: Recording) -> float:
    """Return the capture rate: the recording's where it states one, else the sheet's."""
    true_fps, stated = recording.capture_fps, trial.capture_fps
    if true_fps is not None:
        if np.isfinite(stated) and abs(stated / true_fps - 1) > 1e-3:
            message = f"capture_fps is stated as {stated:g} but {true_fps:g} in the recording"
            raise RecordingError(message, "correct it", trial.name)
        return true_fps
    if not np.isfinite(stated):
        raise RecordingError("capture_fps is missing", "the file knows its playback rate only", trial.name)
    playback = recording.playback_fps
    if playback and abs(stated / playback - 1) < SAME_RATE and not trial.capture_fps_is_playback:
        raise RecordingError(
            f"capture_fps is stated as {stated:g}, the rate at which the file plays ({playback:.4g})",
            "write the rate of capture, or capture_fps_is_playback: yes where it plays as fast as it was captured",
            trial.name,
        )
    return stated


def capture_exposure(trial: Trial, recording: Recording) -> float:
    """Return the exposure of a frame: the recording's where it states one, else the sheet's."""
    true_s, stated_s = recording.exposure_s, trial.exposure_s
    if true_s is None:
        return stated_s
    # 0.02: relative difference within which exposures of sheet and recording are the same (chosen)
    if np.isfinite(stated_s) and abs(stated_s / true_s - 1) > 0.02:
        message = f"exposure_us is stated as {1e6 * stated_s:.4g} but {1e6 * true_s:.4g} in the recording"
        raise RecordingError(message, "correct it", trial.name)
    return true_s


# ------------------------------------------------------------------------------
# Read the headers of high-speed camera files: Phantom `.cine`, Photron `.mraw` with its `.cih` or `.cihx`.
#
# They state rate and exposure of capture, which no ordinary film does. What cannot be read with certainty is refused
# by name: compressed frames, unknown depths and versions, interleaved colours.

MARK_AT, REAL_BITS_AT, SHUTTER_NS_AT = 140, 896, 1568  # Offsets in the settings of a cine, bytes from their beginning
EXPOSURE_TOLERANCE = 0.01  # Relative difference within which the exposures of frames count as one (chosen)


def inspect_cine(path: Path) -> Recording:
    """Read the header of a Phantom `.cine`."""
    name = path.name
    try:
        size = file_size(path)
        with path.open("rb") as stream:
            header = stream.read(44)
            kind, _, compression, version, _, _, _, count, bitmap, setup, table = struct.unpack(
                "<2s3HiIiI3I", header[:36]
            )
            if kind != b"CI":
                raise RecordingError("not a Phantom cine", "name a film, or a folder of pictures", name)
            end = table + 8 * count
            if min(bitmap, setup, table) < 44 or count == 0 or end > size:
                raise RecordingError("cut short, or its header is damaged", "copy it from the camera again", name)
            stream.seek(0)
            header = stream.read(max(end, setup + SHUTTER_NS_AT + 4))
            offsets = tuple(int(at) for at in np.frombuffer(header, "<i8", count, table))
            frames = _cine_frames(path, stream, header, (version, compression, bitmap, setup), offsets, size)
        setup_bytes = header[setup:]
        blocks: dict[int, bytes] = {}  # content of the tagged blocks behind the settings, by type
        at, more = setup + struct.unpack_from("<H", header, setup + MARK_AT + 2)[0], 1
        while more and at + 8 <= table:
            length, kind, more = struct.unpack_from("<IHH", header, at)
            if length < 8 or at + length > table:
                break
            blocks[kind] = header[at + 8 : at + length]
            at += length
        rate, exposure_s, times_s, notes = _cine_clock(name, setup_bytes, blocks, count)
    except (struct.error, ValueError, OSError) as error:
        if isinstance(error, RecordingError):
            raise
        raise RecordingError("its header is damaged", "copy it from the camera again", name) from None
    depth = struct.unpack_from("<I", setup_bytes, REAL_BITS_AT)[0]
    depth = 12 if frames.stored_bits in (10, 12) else depth if 0 < depth <= frames.stored_bits else frames.stored_bits
    return Recording(
        path, "raw", frames.width, frames.height, int(depth), count, rate, exposure_s,
        notes=notes, raw=replace(frames, times_s=times_s),
    )  # fmt: skip


def _cine_frames(
    path: Path, stream: BinaryIO, header: bytes, places: tuple[int, int, int, int], offsets: tuple[int, ...], size: int
) -> RawFrames:
    """Offsets of the frames and how they are packed; refuses what cannot be read."""
    name = path.name
    version, compression, bitmap, setup = places
    _, width, height, _, bits, packing = struct.unpack_from("<IiiHHI", header, bitmap)
    mark, length = struct.unpack_from("<2sH", header, setup + MARK_AT)
    if mark != b"ST" or length < REAL_BITS_AT + 4:
        raise RecordingError("its camera's settings are missing or of an unknown kind", "save it anew", name)
    filters = struct.unpack_from("<I", header, setup + 808)[0]  # colour filters; 1 to 6 are of 2 by 2 pixels
    packed_bits = {0: None, 256: 10, 1024: 12}  # of a packed pixel, by `biCompression`
    grey = compression == 0 or (compression == 2 and 0 <= filters <= 6)
    if not (version == 1 and grey and packing in packed_bits and bits in (8, 16)):
        kind = f"version {version}, compression {compression}, packing {packing}, {bits} bits, colours {filters:#x}"
        raise RecordingError(f"a cine of {kind} is not read", "save it as raw cine or AVI", name)
    packed = packed_bits[packing]
    frames = RawFrames(
        path, (), width, abs(height), packed or bits, bottom_up=packed is None and height > 0,
        linearise=packed == 10, mosaic=compression == 2 and 1 <= filters <= 6,
    )  # fmt: skip
    if width <= 0 or height == 0 or (width * abs(height) * frames.stored_bits) % 8:
        raise RecordingError("its header is damaged", "copy it from the camera again", name)
    starts = []
    for at in offsets:
        if not 0 < at <= size - 8:
            break
        stream.seek(at)
        annotation = struct.unpack("<I", stream.read(4))[0]
        stream.seek(at + annotation - 4)
        size_field = stream.read(4)
        if annotation < 8 or len(size_field) < 4:
            break
        taken = struct.unpack("<I", size_field)[0]
        if taken != frames.frame_bytes:
            wanted = f"{width} x {abs(height)} px of {frames.stored_bits} bits take {frames.frame_bytes}"
            raise RecordingError(f"a frame takes {taken} bytes where {wanted}", "it is not read", name)
        starts.append(at + annotation)
    return replace(frames, offsets=tuple(starts))


def _cine_clock(
    name: str, setup: bytes, blocks: dict[int, bytes], count: int
) -> tuple[float | None, float | None, Floats | None, tuple[str, ...]]:
    """Rate and exposure of capture: from the stamps of the frames where they exist, else as the camera was set."""
    fraction_s = 2.0**-32  # Unit of times and exposures in a cine (defined)
    notes = []
    # 768: offset of the rate, and behind it of the exposure in µs (defined)
    length, (rate, exposure_us) = struct.unpack_from("<H", setup, MARK_AT + 2)[0], struct.unpack_from("<II", setup, 768)
    rate, exposure_s = float(rate), exposure_us * 1e-6
    if length >= SHUTTER_NS_AT + 4:
        exposure_s = struct.unpack_from("<I", setup, SHUTTER_NS_AT)[0] * 1e-9 or exposure_s
    # 1002, 1003: types of the tagged blocks of a cine
    times_s, stored_exposures = None, blocks.get(1003, b"")
    if len(stored_exposures) >= 4 * count:
        exposures_s = np.frombuffer(stored_exposures, "<u4", count) * fraction_s
        exposure_s = float(np.median(exposures_s)) or exposure_s
        if np.ptp(exposures_s) > EXPOSURE_TOLERANCE * exposure_s:
            span = f"{1e6 * exposures_s.min():.4g} to {1e6 * exposures_s.max():.4g} µs"
            notes.append(f"{name}: the exposure changes from frame to frame, {span}: switch automatic exposure off")
    stamps = blocks.get(1002, b"")
    if len(stamps) >= 8 * count and count > 2:
        pairs = np.frombuffer(stamps, "<u4", 2 * count).reshape(-1, 2).astype(np.int64)
        # The lowest two bits flag synchronisation. Integers are subtracted: a float cannot hold both words.
        ticks = ((pairs[:, 1] - pairs[0, 1]) << 32) + (pairs[:, 0] & ~3)
        times_s = (ticks - ticks[0]) * fraction_s
        period_s = float(np.median(np.diff(times_s)))
        if period_s <= 0:
            times_s = None
        elif rate <= 0 or abs(rate * period_s - 1) > SAME_RATE:
            if rate > 0:
                notes.append(f"{name}: set to {rate:g} frames a second, but its frames are {1 / period_s:.6g} a second")
            rate = 1 / period_s
    return rate or None, exposure_s or None, times_s, tuple(notes)


def inspect_mraw(path: Path) -> Recording:
    """Read the side file of a Photron `.mraw`."""
    data = next(iter(_siblings(path, (".mraw",))), None)
    side = path if path.suffix.lower() in SIDE_FILES else next(iter(_siblings(path, SIDE_FILES)), None)
    if side is None or data is None:
        missing = ".mraw is missing, which holds" if side else ".cih or .cihx is missing, which describes"
        raise RecordingError(f"its {missing} the pictures", "put it in the same folder", path.name)
    recording, file_format, colour = read_side_file(side)
    raw, grey = recording.raw, not colour or colour.lower().startswith("mono")
    assert raw is not None
    if not (file_format.lower() == "mraw" and grey and raw.stored_bits in (8, 12, 16)):
        raise RecordingError(
            f"{file_format or 'unknown'} pictures of {raw.stored_bits} bits ({colour}) are not read",
            "save them as MRAW with 8, 12 or 16 bits of grey, or as AVI or TIFF",
            side.name,
        )
    count = recording.declared_frames or 0
    if min(raw.width, raw.height, count) < 1 or (raw.width * raw.height * raw.stored_bits) % 8:
        raise RecordingError("size or number of frames is missing", "copy it from the camera again", side.name)
    present = min(count, file_size(data) // raw.frame_bytes)
    offsets = range(0, present * raw.frame_bytes, raw.frame_bytes)
    return replace(recording, path=data, raw=replace(raw, file=data, offsets=offsets))


def read_side_file(path: Path) -> tuple[Recording, str, str]:
    """What a Photron `.cih` or `.cihx` states of a recording, still without frames; format, colours of its pictures."""
    name = path.name
    try:
        file_size(path)  # refuses a pipe, on which reading would wait
        with path.open("rb") as stream:
            # 4_000_000: most bytes of a side file that are read (chosen)
            data = stream.read(4_000_000)
    except OSError as error:
        raise RecordingError(f"cannot be read: {error.strerror}", name=name) from None
    if path.suffix.lower() == ".cihx":
        values = _cihx_values(name, data)
    else:  # lines `key : value`, of which the first counts
        lines = [line.partition(":") for line in data.decode("utf-8", "replace").splitlines()]
        values = {key.strip(): text.strip() for key, colon, text in reversed(lines) if colon}

    def value(key: str) -> float:
        """The number at the beginning of a value, or a fraction such as 1/20000; 0 where there is none."""
        match = re.match(r"\s*([0-9.]+(?:[eE][-+]?\d+)?)(?:\s*/\s*([0-9.]+))?", values.get(key, ""))
        try:
            return float(match.group(1)) / float(match.group(2) or 1) if match else 0.0
        except (ValueError, ZeroDivisionError):
            return 0.0

    rate, exposure_s, notes = value("Record Rate(fps)"), value("Shutter Speed(s)"), []
    # A number above 1 is the denominator: 20000 for 1/20000 s.
    exposure_s = 1 / exposure_s if exposure_s > 1 else exposure_s
    step = value("Save Step")
    if step > 1:
        rate /= step
        notes.append(f"{name}: every {step:g}th frame was saved: {rate:g} frames a second of {rate * step:g}")
    if not 0 < exposure_s * rate <= 1.0 + EXPOSURE_TOLERANCE:
        exposure_s = 0.0
    width, height, bits, depth = (
        int(value(key)) for key in ("Image Width", "Image Height", "Color Bit", "EffectiveBit Depth")
    )
    recording = Recording(
        path, "raw", width, height, depth if 0 < depth <= bits else bits, int(value("Total Frame")),
        rate if rate > 0 else None, exposure_s or None, notes=tuple(notes),
        raw=RawFrames(path, (), width, height, bits),
    )  # fmt: skip
    return recording, values.get("File Format", ""), values.get("Color Type", "")


def side_file_of(pictures: Path, file_format: str, size: tuple[int, int], count: int) -> Recording | None:
    """Find and read the side file of a TIFF stack or of a folder of pictures."""
    if pictures.is_dir():
        side_files = [at for at in sorted(pictures.iterdir()) if at.suffix.lower() in SIDE_FILES]
    else:
        side_files = _siblings(pictures, SIDE_FILES)
    if len({at.stem for at in side_files}) != 1:
        return None
    recording, stated, _ = read_side_file(side_files[0])
    formats = {"tif": "tiff", "jpg": "jpeg"}
    stated = formats.get(stated.lower(), stated.lower())
    same = (recording.width, recording.height) == size and recording.declared_frames == count
    return recording if same and stated == formats.get(file_format, file_format) else None


def _siblings(path: Path, suffixes: tuple[str, ...]) -> list[Path]:
    """Files of the same name with one of the suffixes, in upper or lower case."""
    beside = path.parent.iterdir() if path.parent.is_dir() else ()
    return sorted(at for at in beside if at.stem == path.stem and at.suffix.lower() in suffixes)


def _cihx_values(name: str, data: bytes) -> dict[str, str]:
    """The same values, by the keys of a `.cih`, from the XML within a `.cihx`."""
    places = {
        "Record Rate(fps)": "recordInfo/recordRate",
        "Shutter Speed(s)": "recordInfo/shutterSpeed",
        "Total Frame": "frameInfo/totalFrame",
        "Image Width": "imageDataInfo/resolution/width",
        "Image Height": "imageDataInfo/resolution/height",
        "Color Bit": "imageDataInfo/colorInfo/bit",
        "Color Type": "imageDataInfo/colorInfo/type",
        "EffectiveBit Depth": "imageDataInfo/effectiveBit/depth",
        "File Format": "imageFileInfo/fileFormat",
    }
    begin, end = data.find(b"<cih>"), data.rfind(b"</cih>")
    try:
        root = ElementTree.fromstring(data[begin : end + 6].decode("utf-8", "replace")) if begin >= 0 else None
    except ElementTree.ParseError:
        root = None
    if root is None:
        raise RecordingError("its XML is damaged", "copy it from the camera again", name)
    return {key: (root.findtext(place) or "").strip() for key, place in places.items()}


# Readers of the headers of files of high-speed cameras, by suffix
CAMERA_READERS = {".cine": inspect_cine} | dict.fromkeys((".mraw", *SIDE_FILES), inspect_mraw)


def inspect_images(path: Path) -> Recording:
    """Read the facts of a folder of images or a TIFF stack from its first picture."""
    is_stack = not path.is_dir()
    files, numbers, notes = ((path,), (), ()) if is_stack else _numbered_files(path)
    readable = next((p for p in map(_read_or_none, files[:3]) if p is not None), None)
    if readable is None:
        raise RecordingError(f"{files[0].name} is not an image that can be read", name=path.name)
    depth = 8 if readable.dtype == np.uint8 else 16
    fps, exposure = _dng_clock(files[0]) if files[0].suffix.lower() == ".dng" else (None, None)
    count = int(cv2.imcount(str(path), cv2.IMREAD_ANYDEPTH)) if is_stack else len(files)
    height, width = readable.shape
    side = side_file_of(path, files[0].suffix.lower().removeprefix("."), (width, height), count)
    if side is not None and fps is None:
        fps, exposure, depth, notes = side.capture_fps, side.exposure_s, side.bit_depth or depth, (*notes, *side.notes)
    kind = "stack" if is_stack else "folder"
    return Recording(path, kind, width, height, depth, count, fps, exposure, files, numbers, notes)


def picture_shots(
    recording: Recording, said: list[Said], part: tuple[int, int] | None = None
) -> Generator[tuple[NDArray[Any], Shot]]:
    """Each picture, or part of a camera's file; an unreadable one is black and `said` so; a stack ends before it."""
    if (raw := recording.raw) is not None:
        first, last = part or (0, len(raw.offsets) - 1)
        pictures = replace(raw, offsets=raw.offsets[first : last + 1]).pictures()
        yield from zip(pictures, map(Shot, raw.times[first:].tolist()), strict=False)
        return
    if recording.kind == "stack":
        yield from zip(_stack_pages(recording), map(Shot, itertools.count()), strict=False)
        return
    shape, dtype = (recording.height, recording.width), np.uint8 if recording.bit_depth <= 8 else np.uint16
    # Decoders silently fill a missing part with grey: a JPEG or PNG must have its end marker.
    markers = {".jpg": b"\xff\xd9", ".jpeg": b"\xff\xd9", ".png": b"IEND\xaeB`\x82"}
    for file, number in zip(recording.files, recording.numbers or itertools.count(), strict=False):  # in any step
        picture, is_whole = _read_or_none(file), False
        if picture is None or picture.shape != shape:
            picture = np.zeros(shape, dtype)
        else:
            with file.open("rb") as stream:
                stream.seek(max(file.stat().st_size - 64, 0))
                is_whole = markers.get(file.suffix.lower(), b"") in stream.read()
        if not is_whole:
            said.append((0, "", f"{file.name} is cut short or cannot be read"))
        yield picture, Shot(number, not is_whole)


def _numbered_files(folder: Path) -> tuple[tuple[Path, ...], tuple[int, ...], tuple[str, ...]]:
    """Images of the folder in the order of their numbers; those not named like the majority are left out."""
    images = sorted(f for f in folder.iterdir() if f.suffix.lower() in IMAGES and not f.name.startswith("."))
    if not images:
        raise RecordingError("the folder holds no images", "expected PNG, JPEG, TIFF or DNG frames", folder.name)
    if unreadable := next((one for one in images if not (one.is_file() or one.is_dir()) and one.exists()), None):
        raise RecordingError(f"{unreadable.name} cannot be read: {NOT_A_FILE}", name=folder.name)
    named: dict[tuple[str, ...], list[tuple[list[int], Path]]] = {}
    for file in images:
        texts = re.split(r"(\d+)", file.stem)  # with the numbers at odd places
        if len(texts) > 1:
            named.setdefault((*texts[::2], file.suffix.lower()), []).append((list(map(int, texts[1::2])), file))
    if not named:
        return tuple(images), (), ()
    # The number of a frame is that which differs most, the last of several; the others are those of a series.
    alike = max(named.values(), key=len)
    differing = [len(set(of_all)) for of_all in zip(*(numbers for numbers, _ in alike), strict=True)]
    k = max(range(len(differing)), key=lambda place: (differing[place], place))
    series: dict[tuple[int, ...], list[tuple[int, Path]]] = {}
    for of_name, file in alike:
        series.setdefault((*of_name[:k], *of_name[k + 1 :]), []).append((of_name[k], file))
    longest = max(series.values(), key=len)
    numbers, files = zip(*sorted(longest), strict=True)
    left_out = [f.name for f in images if f not in set(files)]
    what = f"{len(left_out)} images not numbered like the rest are left out"
    return files, numbers, (f"{folder.name}: {what}, first {left_out[0]}",) if left_out else ()


def _read_or_none(file: Path) -> NDArray[Any] | None:
    """One picture as brightness, uint8 or uint16; None where it cannot be read."""
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


def _stack_pages(recording: Recording) -> Iterator[NDArray[Any]]:
    """Pages of a TIFF stack in order, up to the first that cannot be read."""
    count = recording.declared_frames or 0
    for start in range(0, count, 64):
        ok, pages = cv2.imreadmulti(str(recording.path), start, min(64, count - start), flags=cv2.IMREAD_ANYDEPTH)
        if not ok:
            return
        for page in pages:
            if page.shape != (recording.height, recording.width):
                return
            yield np.asarray(page)


def _dng_clock(file: Path) -> tuple[float | None, float | None]:
    """Capture rate (tag 51044 of CinemaDNG) and exposure (33434 of TIFF/EP, ISO 12234-2) of a frame, None if absent."""
    import tifffile

    values: dict[int, float] = {}
    with tifffile.TiffFile(file) as tiff:
        for page in (part for whole in tiff.pages for part in (whole, *(whole.pages or ()))):
            for code in (51044, 33434):
                if code in page.tags and code not in values:
                    value = page.tags[code].value
                    top, bottom = (value[0], value[1]) if isinstance(value, tuple) else (value, 1)
                    if bottom:
                        values[code] = float(top) / float(bottom)
    return values.get(51044), values.get(33434)


def _read_dng(file: Path) -> NDArray[np.uint16]:
    """Raw values of a DNG; a colour mosaic is levelled by a [1 2 1] kernel, fair to every 2 by 2 pattern."""
    import tifffile

    with tifffile.TiffFile(file) as tiff:
        parts = (part for whole in tiff.pages for part in (whole, *(whole.pages or ())))
        pages = [part for part in parts if part.photometric in (32803, 34892, 1, 2)]
        page = max(pages, key=lambda p: int(p.imagewidth) * int(p.imagelength) * (2 if p.photometric == 32803 else 1))
        if page.compression == 1 and page.bitspersample == 12:
            # Two pixels in three bytes, rows beginning on whole bytes
            strips: Any = tiff.filehandle.read_segments(page.dataoffsets, page.databytecounts)
            height, width = int(page.imagelength), int(page.imagewidth)
            row = (width * 12 + 7) // 8
            data = np.frombuffer(b"".join(strip for strip, _ in strips), np.uint8)[: height * row].reshape(height, row)
            padded = np.pad(data, ((0, 0), (0, -row % 3)))
            raw = unpack_pixels(padded.ravel(), 12).reshape(height, -1)[:, :width]
        else:
            raw = np.asarray(page.asarray())
        mosaic = page.photometric == 32803
    if raw.ndim == 3:
        raw = np.rint(raw[..., :3].astype(np.float32) @ np.array([0.299, 0.587, 0.114], np.float32)).astype(raw.dtype)
    if mosaic:
        raw = mosaic_brightness(raw)
    return raw.astype(np.uint16)
