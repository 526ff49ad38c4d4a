"""Write pictures as a clip that any player, browser and slide plays: H.264 in MP4, with its index in front."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

CRF = 26  # Quality of the encoder (chosen)

# Option of libx264 without which the same pictures are encoded to different bytes (measured)
REPRODUCIBLE = {"mbtree": "0"}


def write_clip(path: Path, pictures: Iterable[NDArray[np.uint8]], play_fps: float, crf: int = CRF) -> int:
    """Write RGB pictures of shape (height, width, 3), all of one size and with even sides; the whole clip
    or nothing.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f".part-{path.name}")
    try:
        count = _encode(draft, pictures, play_fps, crf)
        draft.replace(path)
    finally:
        with contextlib.suppress(FileNotFoundError):
            draft.unlink()
    return count


def _encode(path: Path, pictures: Iterable[NDArray[np.uint8]], play_fps: float, crf: int) -> int:
    """Encode the pictures to a file and return their number."""
    import av

    count, stream = 0, None
    with av.open(str(path), "w", format="mp4", options={"movflags": "+faststart"}) as container:
        for count, picture in enumerate(pictures, 1):
            if stream is None:
                height, width = picture.shape[:2]
                if height % 2 or width % 2:
                    raise ValueError(f"a clip needs pictures of even sides, not {width} × {height}")
                stream = _stream(container, width, height, play_fps, crf)
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")
            frame = frame.reformat(format="yuv420p", dst_colorspace="ITU709")
            frame.pts = count - 1
            container.mux(stream.encode(frame))
        if stream is None:
            raise ValueError("there is no picture to make a clip of")
        container.mux(stream.encode())
    return count


def _stream(container: Any, width: int, height: int, play_fps: float, crf: int) -> Any:
    """A video stream of reproducible H.264 in BT.709 colours."""
    stream = container.add_stream("libx264", rate=Fraction(play_fps).limit_denominator(1001))
    stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
    stream.codec_context.thread_count = 1
    stream.options = {"preset": "faster", "crf": str(crf), "profile": "high", "tune": "animation", **REPRODUCIBLE}
    context = stream.codec_context
    # 1: code of ITU-R BT.709 in the stream (defined)
    context.colorspace = context.color_primaries = context.color_trc = 1
    return stream
