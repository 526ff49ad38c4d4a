"""Damaged recordings: whether each ends in a sentence or in a right track, within bounds of time and memory.

    python benchmarks/damaged_recordings.py [--count 100] [--seed 20300]

One clip of the laboratory in four forms (H.264 in mp4 and mkv, FFV1, MJPEG) is damaged by flipped bytes, cut, given a
wrong suffix, a header of other numbers, or no frame at all. Each is tracked in a process of its own with 60 s and 4 GB.
Counted are faults of the program, NumPy's warnings, processes that had to be ended, and tracks that are off by over
5 mm at a point whose stated error is below a fifth of that.
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import tempfile
import warnings
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import numpy as np

from vinetrack.core.records import Trial
from vinetrack.experiment.folder import read_experiment
from vinetrack.laboratory.campaigns import Filming, GroundTruth, film, grow
from vinetrack.laboratory.scene import Camera
from vinetrack.video.frames import RecordingError
from vinetrack.video.track import track_recording

SHEET = "trial,video,diameter_mm,thickness_um,length_mm,pressure_kPa,mm_per_px\np36,a.mp4,12,100,140,36,0.24\n"
SETTINGS = "capture_fps: 1069\nexposure_us: 93.5\nyield_pressure_kPa: 3\ngrowth_angle_deg: 90\n"
FORMS = {".mp4": ("copy", ""), ".mkv": ("libx264", "yuv420p"), ".mov": ("mjpeg", "yuvj420p"), ".avi": ("ffv1", "gray")}
DAMAGES = ("flipped", "flipped", "flipped", "cut", "suffix", "header", "empty", "zeroed")
SECONDS, BYTES = 60.0, 4 * 2**30
WRONG_M = 5e-3
"""Chosen: forty times the error of a sound frame; with a stated error below a fifth it is a confident wrong answer."""


def filmed(folder: Path) -> tuple[Trial, Any]:
    """One trial, filmed, and the truth of its recording."""
    (folder / "trials.csv").write_text(SHEET)
    (folder / "experiment.yaml").write_text(SETTINGS)
    values = {"eversion_damping.n": 0.37, "eversion_damping.B": {"12mm-100um-140mm": 1.83}}
    nature = GroundTruth(values=values, damping_scatter=0.0, pressure_scatter=0.0, release_frames=(14, 20), seed=411)
    grown = grow(read_experiment(folder, strict=True).trials, nature)[0]
    return grown.stated, film(grown, Filming(camera=Camera(m_per_px=2.4e-4)), grown.stated.video, seed=41)


def in_forms(video: Path) -> dict[str, bytes]:
    """The same recording in other containers and codecs, by suffix."""
    made = {".mp4": video.read_bytes()}
    with av.open(str(video)) as container:
        pictures = [frame.to_ndarray(format="gray") for frame in container.decode(video=0)]
    for suffix, (codec, pixels) in FORMS.items():
        if codec == "copy":
            continue
        path = video.with_name(f"form{suffix}")
        with av.open(str(path), "w") as out:
            stream: Any = out.add_stream(codec, rate=60)
            stream.height, stream.width, stream.pix_fmt, stream.gop_size = *pictures[0].shape, pixels, 30
            for i, picture in enumerate(pictures):
                frame = av.VideoFrame.from_ndarray(picture, format="gray").reformat(format=pixels)
                frame.pts = i
                out.mux(stream.encode(frame))
            out.mux(stream.encode())
        made[suffix] = path.read_bytes()
    return made


def damaged(content: bytes, kind: str, rng: np.random.Generator) -> bytes:
    """The bytes of a recording after an accident."""
    data = np.frombuffer(content, np.uint8).copy()
    if kind == "cut":
        data = data[: int(rng.uniform(0, 1) * data.size)]
    elif kind == "empty":
        data = data[: int(rng.choice([0, 1, 8, 32, 200]))]
    elif kind == "zeroed":
        start = int(rng.integers(0, data.size))
        data[start : start + data.size // 10] = 0
    elif kind in ("flipped", "header"):
        first, last = (0, 3000) if kind == "header" else (0, data.size)
        at = rng.integers(first, min(last, data.size), int(rng.choice([1, 3, 10, 40, 200])))
        data[at] = 0xFF if kind == "header" else data[at] ^ rng.integers(1, 256, at.size).astype(np.uint8)
    return data.tobytes()


def judge(trial: Trial, truth_m: np.ndarray, answer: Any) -> None:
    """Track one recording within the bounds; what came of it goes into `answer`."""
    resource.setrlimit(resource.RLIMIT_AS, (BYTES, BYTES))
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        try:
            track = track_recording(trial).track
            # At the time that the track gives a frame: where some were lost, that is what may be wrong.
            slot = np.rint((track.time_s - track.time_s[0]) * trial.capture_fps).astype(int)
            use = track.usable & np.isfinite(track.lead_position_m) & (slot < len(truth_m))
            error = track.lead_position_m[use] - truth_m[slot[use]]
            error = np.abs(error - np.median(error)) if error.size else np.zeros(0)
            sure = np.hypot(track.lead_position_sigma_m, track.lead_position_systematic_m)[use] < WRONG_M / 5
            outcome = "confident and wrong" if np.any(sure & (error > WRONG_M)) else "tracked"
        except RecordingError:
            outcome = "refused in a sentence"
        except BaseException as fault:
            outcome = f"FAULT {type(fault).__name__}: {str(fault)[:80]}"
    answer.put((outcome, [str(warning.message)[:80] for warning in warned]))


def main() -> None:
    """Make the recordings, track each in its own process, print the counts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--seed", type=int, default=20300)
    wanted = parser.parse_args()
    processes = multiprocessing.get_context("fork")
    tally: Counter[tuple[str, str]] = Counter()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        trial, truth = filmed(folder)
        forms = in_forms(folder / "a.mp4")
        track_recording(trial)  # compiled once, for all
        for i in range(wanted.count):
            rng = np.random.default_rng([wanted.seed, i])
            kind, suffix = DAMAGES[i % len(DAMAGES)], str(rng.choice(list(forms)))
            path = folder / f"damaged{rng.choice(['.avi', '.png', '.txt', '.tif']) if kind == 'suffix' else suffix}"
            path.write_bytes(damaged(forms[suffix], kind, rng))
            answer = processes.Queue()
            process = processes.Process(target=judge, args=(replace(trial, video=path), truth.lead_position_m, answer))
            process.start()
            try:
                outcome, warned = answer.get(timeout=SECONDS)
            except Exception:  # nothing came within the time, or the process died
                outcome, warned = "ENDED: too slow, or died", []
            process.kill()
            process.join()
            tally[kind, outcome] += 1
            if warned or outcome[0].isupper() or outcome.startswith("conf"):
                print(f"{i:4d} {kind:8s} {path.suffix:5s} {outcome} {warned[:1] or ''}", flush=True)
                tally[kind, "with warnings"] += bool(warned)
    for (kind, outcome), count in sorted(tally.items()):
        print(f"{kind:9s} {outcome:60s} {count:4d}")


if __name__ == "__main__":
    main()
