"""Simulated recordings of a campaign, and a picture of the calibration target.

The campaign is simulated first (`tracks.grow`), and its true motion is then filmed, so that the results of a tracker
can be compared with it. An experiment of tracks is turned into one of recordings with the same sheet, a camera and a
target.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml

from vinetrack.core.records import Floats, Trial
from vinetrack.core.tables import replacing, write_csv, write_text
from vinetrack.dynamics.simulate import simulate
from vinetrack.experiment.folder import Experiment, read_experiment
from vinetrack.experiment.sheet import SHEET
from vinetrack.laboratory.camera import Camera
from vinetrack.laboratory.render import Truth, render_recording
from vinetrack.laboratory.scene import Scene, Tube, preset
from vinetrack.laboratory.targets import Target, render_target
from vinetrack.laboratory.tracks import VirtualTrial

FINE_STEPS = 8  # Samples per frame of the true motion (chosen)


@dataclass(frozen=True)
class Filming:
    """How a campaign is filmed: scene preset, camera, exposure as a fraction of the frame interval, and the target."""

    scene: str = "demo"
    camera: Camera = field(default_factory=Camera)
    exposure_fraction: float = 0.1
    target: Target = field(default_factory=Target)


def make_filming(content: dict[str, Any]) -> Filming:
    """Read how trials are filmed from a YAML mapping."""
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
    """Return the scene with a tube of the size that the sheet states for the trial."""
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
    """Film one simulated trial; its truth is returned and not written."""
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
    """True lead position at times much finer than the frames, s and m."""
    time_s = np.linspace(0.0, duration_s, steps + 1)
    return time_s, simulate(trial.model, trial.true, time_s - trial.release_s).lead_position_m


def picture_target(filming: Filming, path: Path, seed: int = 0) -> None:
    """Write a picture of the calibration target in the plane of growth as PNG."""
    import cv2

    picture = render_target(filming.target, replace(preset(filming.scene), camera=filming.camera), seed=seed)
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as temporary:
        temporary.write_bytes(cv2.imencode(".png", picture)[1].tobytes())


SETTINGS = "experiment.yaml"
TARGET = "calibration/board.png"


def recording_experiment(experiment: Experiment, trials: Sequence[str], filming: Filming, folder: Path) -> Experiment:
    """Write sheet and settings of an experiment of recordings of these trials; nothing is filmed yet."""
    if experiment.settings.calibration is not None or any(trial.video for trial in experiment.trials):
        raise ValueError(f"{experiment.folder} is an experiment of recordings already")
    if folder.exists() and folder.samefile(experiment.folder):
        raise ValueError(f"{folder} is the experiment itself: name another folder")
    sheet = pd.read_csv(experiment.folder / SHEET, dtype=str, keep_default_na=False)
    sheet = sheet[sheet["trial"].isin(list(trials))].rename(columns={"track": "video"})
    sheet["video"] = [f"videos/{trial}.mp4" for trial in sheet["trial"]]
    write_csv(folder / SHEET, sheet)
    path = experiment.folder / SETTINGS
    shared = path.read_text(encoding="utf-8") if path.exists() else ""
    write_text(folder / SETTINGS, shared + _camera_settings(experiment, filming))
    return read_experiment(folder, strict=True)


def _camera_settings(experiment: Experiment, filming: Filming) -> str:
    """The lines of `experiment.yaml` about exposure and calibration."""
    target = filming.target
    if target.kind != "charuco":
        raise ValueError(f"the target is a {target.kind}; a recording needs a charuco board")
    exposures_us = {round(1e6 * filming.exposure_fraction / trial.capture_fps, 3) for trial in experiment.trials}
    if len(exposures_us) != 1:
        raise ValueError("trials have several frame rates, so that no single exposure can be stated")
    board = {
        "kind": target.kind,
        "image": TARGET,
        "squares": list(target.squares),
        "square_mm": round(1e3 * target.square_m, 6),
        "marker_mm": round(1e3 * target.marker_m, 6),
        "dictionary": target.dictionary,
    }
    return yaml.safe_dump({"exposure_us": exposures_us.pop(), "calibration": board}, sort_keys=False)
