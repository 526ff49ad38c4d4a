"""Write pictures as a clip that any player, browser and slide plays: H.264 in MP4, with its index in front."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path

import numpy as np
from numpy.typing import NDArray


def write_clip(path: Path, pictures: Iterable[NDArray[np.uint8]], play_fps: float) -> int:
    """Write RGB pictures of shape (height, width, 3), all of one size and with even sides; the whole clip or nothing.
    Returns their number.
    """
    import av
    import cv2

    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f".part-{path.name}")
    count, stream = 0, None
    try:
        with av.open(str(draft), "w", format="mp4", options={"movflags": "+faststart"}) as container:
            for count, picture in enumerate(pictures, 1):
                if stream is None:
                    height, width = picture.shape[:2]
                    if height % 2 or width % 2:
                        raise ValueError(f"a clip needs pictures of even sides, not {width} × {height}")
                    stream = container.add_stream("libx264", rate=Fraction(play_fps).limit_denominator(1001))
                    stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
                    # Without mbtree=0 the same pictures are encoded to different bytes (measured).
                    options = {"preset": "superfast", "crf": "26", "profile": "high", "tune": "animation"}
                    stream.options, context = {**options, "mbtree": "0"}, stream.codec_context
                    context.thread_count = 1
                    context.colorspace = context.color_primaries = context.color_trc = 6  # BT.601, as OpenCV converts
                planes = np.asarray(cv2.cvtColor(picture, cv2.COLOR_RGB2YUV_I420), dtype=np.uint8)
                frame = av.VideoFrame.from_ndarray(planes, format="yuv420p")
                frame.pts = count - 1
                container.mux(stream.encode(frame))
            if stream is None:
                raise ValueError("there is no picture to make a clip of")
            container.mux(stream.encode())
        draft.replace(path)
    finally:
        with contextlib.suppress(FileNotFoundError):
            draft.unlink()
    return count
