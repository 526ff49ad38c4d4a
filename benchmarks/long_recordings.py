"""Memory and time of tracking a short event in recordings of any length.

    python benchmarks/long_recordings.py [--lengths 200 2000 10000] [--gop 30] [--film FOLDER]

Films of 1280 x 1024 (H.264, a key frame every `gop`) of the same event of 83 moving frames, drawn by
`tests/helpers/plain_scene.py` (seed 20970), with more and more frames of rest about it; they are made in FOLDER and
kept there. Each is tracked in a process of its own, once compiled: peak resident memory, beyond that of a process that
has imported the tracker and tracked nothing; seconds, beside decoding every frame and keeping none; and the error of
the edge.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from fractions import Fraction
from pathlib import Path

import av
import numpy as np

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests" / "helpers"))
from plain_scene import Plan, plain_scene

PLAN = Plan(
    seed=20970, width=1280, height=1024, from_px=(60.0, 500.0), end_px=1100.0, rest_frames=60, end_frames=50,
    speed=14.0, radius=40.0,
)  # fmt: skip
FIRST_PART = 0.6
"""Part of a recording's rest that comes before the event."""

CHILD = """
import json, sys, time
from pathlib import Path
from vinetrack.core.records import Trial
from vinetrack.video.frames import DECODER_THREADS
from vinetrack.video.track import track_recording
from vinetrack.pages.setup_server import warm_up
def peak():
    # Of this process alone: what getrusage says includes the memory of the process that started it.
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(float(line.split()[1]) for line in lines if line.startswith("VmHWM")) / 1e3
import av
task, path = sys.argv[1:]
warm_up()
empty, start = peak(), time.perf_counter()
edge = []
if task == "decode":
    with av.open(path) as container:
        stream = container.streams.video[0]
        stream.thread_type, stream.codec_context.thread_count = "AUTO", DECODER_THREADS
        count = sum(1 for _ in container.decode(stream))
else:
    made = track_recording(Trial(name="t", video=Path(path), capture_fps=1000.0, exposure_s=2e-4))
    edge = [made.axis.from_px[0], *made.track.edge_px]
print(json.dumps([peak() - empty, time.perf_counter() - start, edge]))
"""


def film(path: Path, frames: np.ndarray, length: int, gop: int) -> int:
    """Write a film of that length unless it is there; return the number of the event's first frame."""
    start = int(FIRST_PART * (length - len(frames)))
    if path.exists():
        return start
    rng = np.random.default_rng(PLAN.seed + 1)
    grains = [rng.integers(-3, 4, frames.shape[1:]).astype(np.int16) for _ in range(7)]
    rest = frames[0].astype(np.int16), frames[-1].astype(np.int16)
    options = {"crf": "20", "preset": "ultrafast", "g": str(gop), "keyint_min": str(gop), "sc_threshold": "0"}
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=Fraction(30), options=options)
        stream.width, stream.height, stream.pix_fmt = frames.shape[2], frames.shape[1], "yuv420p"
        planes = np.full((frames.shape[1] * 3 // 2, frames.shape[2]), 128, np.uint8)
        for i in range(length):
            inside = 0 <= i - start < len(frames)
            still = np.clip(rest[i >= start] + grains[i % 7], 0, 255)
            planes[: frames.shape[1]] = frames[i - start] if inside else still
            frame = av.VideoFrame.from_ndarray(planes, format="yuv420p")
            frame.pts = i
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return start


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lengths", type=int, nargs="+", default=[200, 2000, 10_000])
    parser.add_argument("--gop", type=int, default=30)
    parser.add_argument("--film", type=Path)
    given = parser.parse_args()
    folder = given.film or Path(tempfile.mkdtemp())
    folder.mkdir(parents=True, exist_ok=True)
    scene = plain_scene(PLAN)
    print(
        f"{'frames':>7} {'peak, MB':>9} {'track, s':>9} {'decode all, s':>14} {'ratio':>6} {'SD, px':>7} {'known':>6}"
    )
    for length in given.lengths:
        path = folder / f"{length}_{given.gop}.mp4"
        start = film(path, scene.frames, length, given.gop)
        told = {}
        for task in ("decode", "track"):
            done = subprocess.run(
                [sys.executable, "-c", CHILD, task, str(path)], capture_output=True, text=True, check=True
            )
            told[task] = json.loads(done.stdout.splitlines()[-1])
        peak_mb, track_s, (origin, *edge) = told["track"]
        off = np.array(edge)[start : start + len(scene.frames)] + origin - PLAN.from_px[0] - scene.edge_px
        off = off[scene.moving & np.isfinite(off)]
        decode_s = told["decode"][1]
        print(
            f"{length:7} {peak_mb:9.0f} {track_s:9.2f} {decode_s:14.2f} {decode_s / track_s:6.2f} "
            f"{np.std(off):7.3f} {off.size:3}/{int(scene.moving.sum())}"
        )


if __name__ == "__main__":
    main()
