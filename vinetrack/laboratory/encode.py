"""Writing of rendered frames to files, and file faults.

Formats are H.264 as in cameras, other codecs, and folders and stacks of images.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from vinetrack.laboratory.scene import Encoding, Scene

Frame = NDArray[np.uint8 | np.uint16]


class Renderer(Protocol):
    """Interface of what can be written: anything that renders frames by index."""

    scene: Scene
    seed: int
    capture_fps: float
    exposure_s: float

    def frame(self, frame: int, *, low: float = ..., span: float | None = ...) -> Frame:
        """Render the grey levels of one frame. Shape (height, width)."""
        ...


VIDEO_ENDINGS = (".mp4", ".mov", ".mkv", ".avi")
STACK_ENDINGS = (".tif", ".tiff")
PICTURE_FORMATS = ("png", "tiff", "jpg", "dng")
CODECS = {"h264": "libx264", "ffv1": "ffv1", "mjpeg": "mjpeg", "raw": "rawvideo"}
GREY_FORMATS = {8: "gray", 10: "gray10le", 12: "gray12le", 16: "gray16le"}
LIMITED_RANGE, FULL_RANGE = 1, 2  # Codes of the H.264 stream for 16…235 and 0…255 (defined)
HEADER_FRACTION = 0.15  # Fraction of a file that is spared when bytes are damaged (chosen)
TINT = (12, -8)  # Offsets (U, V) of a colour recording from grey: a warm wall and bluish film under LED lamps (chosen)


def write_recording(renderer: Renderer, order: NDArray[np.int_], path: Path) -> None:
    """Write frames `order` of `renderer` to `path`, completely or not at all, then apply the scene's file faults. A
    path without ending becomes a folder of numbered images, `frame_000000.png` and so on, in the format of
    `encoding.codec` if that is png, tiff, jpg or dng. Shapes: order (n_frames,).
    """
    scene, suffix = renderer.scene, path.suffix.lower()
    path.parent.mkdir(parents=True, exist_ok=True)
    if suffix in VIDEO_ENDINGS:
        draft = path.with_name("part-" + path.name)
        _write_video(renderer, order, draft)
    elif suffix in STACK_ENDINGS:
        draft = path.with_name("part-" + path.name)
        _write_stack(_frames(renderer, order), draft)
    elif not suffix:
        draft = path.with_name("part-" + path.name)
        shutil.rmtree(draft, ignore_errors=True)
        draft.mkdir()
        _write_pictures(_frames(renderer, order), draft, scene, renderer)
    else:
        endings = ", ".join((*VIDEO_ENDINGS, *STACK_ENDINGS))
        raise ValueError(f"{path.name}: cannot write a recording of this kind; end it in {endings}, or in nothing.")
    if suffix:
        _damage(draft, scene, renderer.seed)
    if path.is_dir():
        shutil.rmtree(path)
    draft.replace(path)


def _frames(
    renderer: Renderer, order: NDArray[np.int_], low: float = 0.0, span: float | None = None
) -> Iterator[Frame]:
    """Yield grey frames in the order of the file; garbage for −1."""
    camera, sensor = renderer.scene.camera, renderer.scene.sensor
    for index in order:
        if index >= 0:
            yield renderer.frame(int(index), low=low, span=span)
        else:
            yield _garbage(camera.height_px, camera.width_px, sensor.bit_depth, renderer.seed)


def _garbage(height: int, width: int, bit_depth: int, seed: int) -> Frame:
    """A frame as written by a camera whose buffer was not ready: bands of noise and black."""
    rng = np.random.default_rng([seed, 77])
    full = 2**bit_depth - 1
    bands = rng.integers(0, 2, size=(height // 16 + 1, 1)).repeat(16, axis=0)[:height]
    noise = rng.integers(0, full + 1, size=(height, width))
    return (bands * noise).astype(np.uint8 if bit_depth <= 8 else np.uint16)


def _write_video(renderer: Renderer, order: NDArray[np.int_], path: Path) -> None:
    import av

    scene, encoding = renderer.scene, renderer.scene.encoding
    pixel_format = _pixel_format(scene)
    levels = _video_levels(scene)
    options = {"movflags": "+faststart"} if path.suffix.lower() in (".mp4", ".mov") else {}
    chroma = _chroma(scene)
    with av.open(str(path), "w", options=options) as container:
        stream: Any = container.add_stream(CODECS[encoding.codec], rate=Fraction(encoding.container_fps))
        stream.width, stream.height, stream.pix_fmt = scene.camera.width_px, scene.camera.height_px, pixel_format
        stream.codec_context.thread_count = 1
        stream.options = _codec_options(encoding)
        if encoding.codec == "h264":
            stream.gop_size = encoding.gop
            stream.codec_context.color_range = LIMITED_RANGE if _is_limited(scene) else FULL_RANGE
        for index, levels_frame in enumerate(_frames(renderer, order, *levels)):
            picture = _picture(levels_frame, pixel_format, chroma)
            picture.pts = index
            container.mux(stream.encode(picture))
        container.mux(stream.encode())


def _is_limited(scene: Scene) -> bool:
    return scene.encoding.limited_range and scene.encoding.codec == "h264"


def _video_levels(scene: Scene) -> tuple[float, float | None]:
    """Black level and span to white: 16…235 for limited range, otherwise the full range."""
    return (16.0, 219.0) if _is_limited(scene) else (0.0, None)


def _pixel_format(scene: Scene) -> str:
    encoding, sensor = scene.encoding, scene.sensor
    if encoding.codec not in CODECS:
        raise ValueError(f"Unknown codec {encoding.codec!r}; choose one of {', '.join(CODECS)}.")
    depths: tuple[int, ...] = (8,)
    if encoding.codec == "h264":
        pixel_format = "yuv420p"
    elif encoding.codec == "mjpeg":
        pixel_format = "yuvj420p"
    elif encoding.codec == "raw" or sensor.colour:
        pixel_format = "yuv420p" if sensor.colour else "gray"
    else:
        pixel_format, depths = GREY_FORMATS.get(sensor.bit_depth, ""), tuple(GREY_FORMATS)
    if sensor.bit_depth not in depths:
        allowed = " or ".join(str(depth) for depth in depths)
        raise ValueError(f"{encoding.codec} here holds {allowed} bits, not {sensor.bit_depth}; use ffv1 or TIFF.")
    return pixel_format


def _codec_options(encoding: Encoding) -> dict[str, str]:
    if encoding.codec != "h264":
        return {"qmin": "2", "qmax": "4"} if encoding.codec == "mjpeg" else {}
    options = {"preset": encoding.preset, "bf": "0", "sc_threshold": "0"}
    if encoding.bitrate_Mbit_s is None:
        return options | {"crf": str(encoding.crf)}
    rate = f"{encoding.bitrate_Mbit_s * 1000:.0f}k"
    return options | {"b": rate, "maxrate": rate, "bufsize": rate}


def _chroma(scene: Scene) -> tuple[Frame, Frame] | None:
    """The two colour planes at half resolution, constant in time, since film is transparent; None for a grey scene."""
    if not scene.sensor.colour:
        return None
    rows, columns = (scene.camera.height_px + 1) // 2, (scene.camera.width_px + 1) // 2
    fade = np.linspace(0, 1, columns)[None, :] + 0.2 * np.linspace(0, 1, rows)[:, None]
    return (128 - TINT[0] * fade).astype(np.uint8), (128 - TINT[1] * fade).astype(np.uint8)


def _picture(levels: Frame, pixel_format: str, chroma: tuple[Frame, Frame] | None) -> Any:
    """Make a PyAV frame with `levels` as its first plane, without conversion."""
    import av

    height, width = levels.shape
    picture = av.VideoFrame(width, height, pixel_format)
    _fill(picture.planes[0], levels)
    if len(picture.planes) > 1:
        half = np.full(((height + 1) // 2, (width + 1) // 2), 128, dtype=np.uint8)
        for plane, values in zip(picture.planes[1:], chroma or (half, half), strict=True):
            _fill(plane, values)
    return picture


def _fill(plane: Any, values: Frame) -> None:
    row = plane.line_size // values.itemsize
    target = np.frombuffer(plane, dtype=values.dtype)[: row * values.shape[0]].reshape(values.shape[0], row)
    target[:, : values.shape[1]] = values


def _in_colour(levels: Frame, scene: Scene) -> Frame:
    """Return a BGR picture of `levels` with the scene's tint, for image files; unchanged if the scene is grey."""
    import cv2

    chroma = _chroma(scene)
    if chroma is None:
        return levels
    height, width = levels.shape
    full = 2**scene.sensor.bit_depth - 1
    planes = [cv2.resize(plane, (width, height)).astype(np.float32) / 255 - 0.5 for plane in chroma]
    bright = levels.astype(np.float32) / full
    blue, red = bright + 1.772 * planes[0], bright + 1.402 * planes[1]
    green = bright - 0.344136 * planes[0] - 0.714136 * planes[1]
    bgr = np.stack([blue, green, red], axis=-1).clip(0, 1) * full
    return np.asarray(np.round(bgr), dtype=levels.dtype)


def _as_stored(levels: Frame, bit_depth: int) -> Frame:
    """Return 10- and 12-bit values as 16-bit files hold them: in the lower bits, unchanged."""
    return levels if bit_depth <= 8 else levels.astype(np.uint16)


def _write_pictures(frames: Iterator[Frame], folder: Path, scene: Scene, renderer: Renderer) -> None:
    """Write numbered images: png, tiff, jpg or dng by the scene's `encoding.codec`; png for other codecs."""
    import cv2

    ending = scene.encoding.codec if scene.encoding.codec in PICTURE_FORMATS else "png"
    for index, levels in enumerate(frames):
        path = folder / f"frame_{index:06d}.{ending}"
        if ending == "dng":
            _write_dng(path, levels, scene.sensor.bit_depth, renderer.capture_fps, renderer.exposure_s)
            continue
        picture = _in_colour(_as_stored(levels, scene.sensor.bit_depth), scene)
        settings = [cv2.IMWRITE_PNG_COMPRESSION, 1] if ending == "png" else []
        if not cv2.imwrite(str(path), picture, settings):
            raise ValueError(f"{path}: the picture could not be written; is the disk full?")


def _write_stack(frames: Iterator[Frame], path: Path) -> None:
    import tifffile

    with tifffile.TiffWriter(path) as stack:
        for levels in frames:
            stack.write(levels, photometric="minisblack", contiguous=True)


def _write_dng(path: Path, levels: Frame, bit_depth: int, capture_fps: float, exposure_s: float) -> None:
    """Write a CinemaDNG frame as the Chronos does: FrameRate in tag 51044 (75 MHz timebase), exposure in 33434."""
    import tifffile

    period_ticks = round(75e6 / capture_fps)
    tags = [
        (33434, 5, 1, (round(exposure_s * 1e9), 10**9), True),
        (50706, 1, 4, (1, 4, 0, 0), True),
        (50714, 3, 1, 0, True),
        (50717, 3, 1, 2**bit_depth - 1, True),
        (51044, 10, 1, (75_000_000, period_ticks), True),
    ]
    tifffile.imwrite(path, levels, photometric="minisblack", extratags=tags, metadata=None, contiguous=True)


def _damage(path: Path, scene: Scene, seed: int) -> None:
    """Overwrite bytes behind the header, then truncate the file, according to the scene's faults."""
    faults = scene.faults
    if faults.damaged_fraction > 0:
        content = np.fromfile(path, dtype=np.uint8)
        rng = np.random.default_rng([seed, 78])
        run, start = 64, int(HEADER_FRACTION * content.size)
        runs = max(1, int(faults.damaged_fraction * (content.size - start) / run))
        for place in rng.integers(start, max(content.size - run, start + 1), size=runs):
            content[place : place + run] = rng.integers(0, 256, size=content[place : place + run].size)
        content.tofile(path)
    if faults.keep_fraction < 1:
        with path.open("r+b") as file:
            file.truncate(int(path.stat().st_size * faults.keep_fraction))
