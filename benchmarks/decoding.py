"""What reading frames, and reading and tracking them, costs beside decoding alone.

    python benchmarks/decoding.py [--video FILE] [--repeats 3]

Rates are in frames a second, ratios against decoding alone (PyAV, 2 threads, frames thrown away), side by side in one
run; without --video a recording of the virtual laboratory's demonstration and one at a camera's bit rate are made.
The first call of the tracker, which compiles, is left out.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import av
import cv2
from tracking_accuracy import CAPTURE_FPS, film

from vinetrack.core.records import Trial
from vinetrack.laboratory.scene import preset
from vinetrack.video.frames import DECODER_THREADS, read_frames
from vinetrack.video.track import track_frames, track_recording


def decode_only(path: Path) -> int:
    """Decode every frame and keep none."""
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        stream.thread_type = "AUTO"
        stream.codec_context.thread_count = DECODER_THREADS
        return sum(1 for _ in container.decode(stream))


def to_grey(path: Path) -> int:
    """PyAV with its own conversion to grey."""
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        stream.thread_type = "AUTO"
        stream.codec_context.thread_count = DECODER_THREADS
        return sum(frame.to_ndarray(format="gray").shape[0] > 0 for frame in container.decode(stream))


def opencv_grey(path: Path) -> int:
    """OpenCV to BGR, then grey."""
    capture = cv2.VideoCapture(str(path))
    count = 0
    while True:
        good, frame = capture.read()
        if not good:
            return count
        cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
        count += 1


def best_seconds(task: Callable[[], object], repeats: int) -> float:
    """Shortest of several runs."""
    spent = []
    for _ in range(repeats):
        start = time.perf_counter()
        task()
        spent.append(time.perf_counter() - start)
    return min(spent)


def table(path: Path, repeats: int) -> None:
    """Print one recording's rates."""
    trial = Trial(name="t", video=path, capture_fps=CAPTURE_FPS, exposure_s=0.1 / CAPTURE_FPS, m_per_px=1.0)
    frames = read_frames(path)
    n = len(frames)
    ways: dict[str, Callable[[], object]] = {
        "decode alone": lambda: decode_only(path),
        "Y plane copied (ours)": lambda: read_frames(path),
        "PyAV to grey": lambda: to_grey(path),
        "OpenCV, then grey": lambda: opencv_grey(path),
        "track alone": lambda: track_frames(frames, trial, CAPTURE_FPS),
        "decode and track": lambda: track_recording(trial),
    }
    track_recording(trial)
    alone = best_seconds(ways["decode alone"], repeats)
    print(f"{path.name}: {n} frames, {frames.recording.width} by {frames.recording.height}")
    for name, task in ways.items():
        seconds = alone if name == "decode alone" else best_seconds(task, repeats)
        print(f"  {name:24s} {n / seconds:8.0f} frames/s   ratio {alone / seconds:5.2f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--video", type=Path)
    parser.add_argument("--repeats", type=int, default=3)
    chosen = parser.parse_args()
    if chosen.video:
        table(chosen.video, chosen.repeats)
        return
    with tempfile.TemporaryDirectory() as scratch:
        for name in ("demo", "flicker"):
            path, _ = film(preset(name), name, 7, Path(scratch), 5.0)
            table(path, chosen.repeats)


if __name__ == "__main__":
    main()
