"""What reading frames, and reading and tracking them, costs beside decoding alone.

    python benchmarks/decoding.py [--video FILE] [--repeats 5] [--frames 200,2000]

Rates are in frames a second, ratios against decoding alone (PyAV, 2 threads, frames thrown away). Each repeat times all
ways one after the other and the shortest of each counts, so that what else a machine does weighs on all alike. Without
--video recordings of the virtual laboratory are made, seed 7: one at a camera's bit rate and one of a light stream,
growth at 5 m/s followed by rest. The first call of the tracker, which compiles, is left out.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import av
import cv2
from tracking_accuracy import CAPTURE_FPS, approach

from vinetrack.core.records import Trial
from vinetrack.laboratory.campaigns import render_recording
from vinetrack.laboratory.scene import preset
from vinetrack.video.frames import read_frames
from vinetrack.video.track import track_frames, track_recording


def decode_only(path: Path) -> int:
    """Decode every frame and keep none."""
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        stream.thread_type = "AUTO"
        stream.codec_context.thread_count = 0  # as FFmpeg chooses
        return sum(1 for _ in container.decode(stream))


def to_grey(path: Path) -> int:
    """PyAV with its own conversion to grey."""
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        stream.thread_type = "AUTO"
        stream.codec_context.thread_count = 0  # as FFmpeg chooses
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


def best_seconds(ways: dict[str, Callable[[], object]], repeats: int) -> dict[str, float]:
    """Shortest of several runs of each, all of them in every round."""
    spent: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(repeats):
        for name, task in ways.items():
            start = time.perf_counter()
            task()
            spent[name].append(time.perf_counter() - start)
    return {name: min(times) for name, times in spent.items()}


def table(path: Path, repeats: int, all_ways: bool = True) -> None:
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
    if not all_ways:
        ways = {name: ways[name] for name in ("decode alone", "decode and track")}
    track_recording(trial)
    seconds = best_seconds(ways, repeats)
    print(f"{path.name}: {n} frames, {frames.recording.width} by {frames.recording.height}")
    for name, spent in seconds.items():
        print(f"  {name:24s} {n / spent:8.0f} frames/s   ratio {seconds['decode alone'] / spent:5.2f}", flush=True)


def recording(name: str, n_frames: int, folder: Path) -> Path:
    """Render a recording of so many frames: growth over 0.2 m, then rest."""
    path = folder / f"{name}_{n_frames}.mp4"
    motion = approach(5.0, 0.008, 20.4 / CAPTURE_FPS, 0.2)
    render_recording(preset(name), motion, n_frames=n_frames, capture_fps=CAPTURE_FPS, out_path=path, seed=7)
    return path


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--video", type=Path)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--frames", default="200,2000", help="frames of the recordings that are made")
    chosen = parser.parse_args()
    if chosen.video:
        table(chosen.video, chosen.repeats)
        return
    with tempfile.TemporaryDirectory() as scratch:
        for count in map(int, chosen.frames.split(",")):
            for name in ("flicker", "light_stream"):
                table(recording(name, count, Path(scratch)), chosen.repeats, all_ways=count <= 500)


if __name__ == "__main__":
    main()
