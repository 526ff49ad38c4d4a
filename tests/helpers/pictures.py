"""Pictures in memory as a recording that was read."""

from pathlib import Path

import numpy as np

from vinetrack.core.records import Trial
from vinetrack.video.axis import Axis
from vinetrack.video.frames import Frames, Recording
from vinetrack.video.track import Tracking, track_frames

FPS = 1000.0


def in_memory(luma: np.ndarray) -> Frames:
    """Frames (n, height, width) as those of a sound container of eight bits."""
    n, height, width = luma.shape
    recording = Recording(Path("scene.mp4"), "container", width, height, 8, n)
    return Frames(recording, luma, np.arange(n), np.zeros(n, dtype=bool))


def tracked(luma: np.ndarray, exposure: float, axis: Axis | None = None, m_per_px: float = 1e-3) -> Tracking:
    """Tracking of frames taken a thousand a second; `exposure` in frames."""
    trial = Trial(name="t", capture_fps=FPS, exposure_s=exposure / FPS, m_per_px=m_per_px)
    return track_frames(in_memory(luma), trial, FPS, axis)
