"""Frames a second that the virtual laboratory writes on one core, and where the time goes.

Run as `python benchmarks/rendering_speed.py`. Prints one row a preset: frames a second from scene to closed file by
the processor's own clock (so that other work on the machine does not count), by the wall clock, and without encoding.
The goal is 150 frames a second of 960 × 320 on one core.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import cv2
import numpy as np

from vinetrack.laboratory.filming import render_recording
from vinetrack.laboratory.render import FrameRenderer
from vinetrack.laboratory.scene import Ball, preset

CAPTURE_FPS, N_FRAMES, SEED = 1069.0, 250, 11
CASES = (
    ("clean", ".avi"),
    ("demo", ".mp4"),
    ("light_stream", ".mp4"),
    ("door", ".mp4"),
    ("half_frame_exposure", ".mp4"),
    ("payload", ".mp4"),
    ("shake", ".mp4"),
    ("diagonal", ".mp4"),
    ("twelve_bit", ".mkv"),
    ("twelve_bit", ""),
    ("falling_ball", ".mp4"),
)


def growth_m(time_s: np.ndarray) -> np.ndarray:
    """Growth that speeds up to 2 m/s with a time constant of 20 ms from 20 ms on, and ends at 280 mm."""
    since_s = np.clip(time_s - 0.02, 0, None)
    return np.minimum(2.0 * (since_s - 0.02 * (1 - np.exp(-since_s / 0.02))), 0.28)


def fall_m(time_s: np.ndarray) -> np.ndarray:
    return 0.5 * 9.81 * np.clip(time_s - 0.02, 0, None) ** 2


def main() -> None:
    cv2.setNumThreads(1)
    print(f"{'preset':22s} {'file':6s} {'size':>10s} {'fps cpu':>9s} {'fps wall':>9s} {'no file':>9s} {'MB':>7s}")
    settings = {"n_frames": N_FRAMES, "capture_fps": CAPTURE_FPS, "seed": SEED}
    with tempfile.TemporaryDirectory() as folder:
        render_recording(preset("shake"), growth_m, out_path=Path(folder) / "warm.mp4", **settings)
        render_recording(preset("falling_ball"), fall_m, out_path=Path(folder) / "warm.mp4", **settings)
        for name, ending in CASES:
            scene = preset(name)
            motion = fall_m if isinstance(scene.subject, Ball) else growth_m
            path = Path(folder) / f"{name}{ending}"
            cpu_s, wall_s = time.process_time(), time.perf_counter()
            render_recording(scene, motion, out_path=path, **settings)
            cpu_s, wall_s = time.process_time() - cpu_s, time.perf_counter() - wall_s
            bare_s = time.process_time()
            renderer = FrameRenderer(scene, motion, **settings)
            for index in range(N_FRAMES):
                renderer.frame(index)
            bare_s = time.process_time() - bare_s
            files = path.iterdir() if path.is_dir() else [path]
            size_mb = sum(file.stat().st_size for file in files) / 1e6
            shape = f"{scene.camera.width_px}x{scene.camera.height_px}"
            rates = f"{N_FRAMES / cpu_s:9.0f} {N_FRAMES / wall_s:9.0f} {N_FRAMES / bare_s:9.0f}"
            print(f"{name:22s} {ending or 'folder':6s} {shape:>10s} {rates} {size_mb:7.1f}")


if __name__ == "__main__":
    main()
