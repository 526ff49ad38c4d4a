"""A campaign grown in the virtual laboratory and filmed: recordings, and a picture of the calibration target.

The vine grows first (`tracks.grow`); the camera then films the true motion, so that whatever a tracker makes of the
recording can be held against it.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from vinetrack.core.records import Floats, Trial
from vinetrack.core.tables import replacing
from vinetrack.dynamics.simulate import simulate
from vinetrack.laboratory.camera import Camera
from vinetrack.laboratory.render import Truth, render_recording
from vinetrack.laboratory.scene import Scene, Tube, preset
from vinetrack.laboratory.targets import Target, render_target
from vinetrack.laboratory.tracks import VirtualTrial

FINE_STEPS = 8
"""Instants a frame at which the true motion is handed to the camera."""


@dataclass(frozen=True)
class Filming:
    """How a campaign is filmed: scene preset, camera, exposure as a part of the time between frames, and the target."""

    scene: str = "demo"
    camera: Camera = field(default_factory=Camera)
    exposure_fraction: float = 0.1
    target: Target = field(default_factory=Target)


def make_filming(content: dict[str, Any]) -> Filming:
    """Read from YAML's mapping: `scene`, `exposure_fraction`, and the fields of `camera` and `target`."""
    target = dict(content.get("target", {}))
    if "squares" in target:
        target["squares"] = tuple(target["squares"])
    return Filming(
        scene=content.get("scene", "demo"),
        camera=Camera(**content.get("camera", {})),
        exposure_fraction=content.get("exposure_fraction", 0.1),
        target=Target(**target),
    )


def scene_of(stated: Trial, filming: Filming) -> Scene:
    """The scene with the trial's own tube before the camera, of the size that the sheet states."""
    base = preset(filming.scene)
    subject = base.subject
    if isinstance(subject, Tube):
        subject = replace(
            subject,
            diameter_m=stated.diameter_m,
            length_m=stated.length_m,
            payload_diameter_m=0.6 * stated.diameter_m if stated.payload_kg > 0 else 0.0,
        )
    return replace(base, subject=subject, camera=filming.camera, exposure_fraction=filming.exposure_fraction)


def film(trial: VirtualTrial, filming: Filming, out_path: Path, seed: int = 0) -> Truth:
    """Film one grown trial; the truth of every frame is returned and written nowhere."""
    capture_fps = trial.stated.capture_fps
    n_frames = int(trial.track.time_s.size)
    return render_recording(
        scene_of(trial.stated, filming),
        _motion(trial, n_frames / capture_fps, FINE_STEPS * n_frames),
        n_frames=n_frames,
        capture_fps=capture_fps,
        out_path=out_path,
        seed=seed,
    )


def _motion(trial: VirtualTrial, duration_s: float, steps: int) -> tuple[Floats, Floats]:
    """True lead position at times far finer than the frames, s and m."""
    time_s = np.linspace(0.0, duration_s, steps + 1)
    return time_s, simulate(trial.model, trial.true, time_s - trial.release_s).lead_position_m


def picture_target(filming: Filming, path: Path, seed: int = 0) -> None:
    """Write a picture of the calibration target, held up in the plane of growth, as PNG."""
    import cv2

    picture = render_target(filming.target, replace(preset(filming.scene), camera=filming.camera), seed=seed)
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as temporary:
        temporary.write_bytes(cv2.imencode(".png", picture)[1].tobytes())
