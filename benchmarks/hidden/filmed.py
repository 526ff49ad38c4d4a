"""A campaign before the camera: its motions rendered as recordings, in a folder like anybody's."""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np
from scipy.interpolate import PchipInterpolator

from hidden.campaigns import Hidden
from hidden.folder import write_folder
from vinetrack.core.records import Track, Trial
from vinetrack.experiment.folder import Experiment, read_experiment
from vinetrack.laboratory.filming import (
    FINE_STEPS,
    Filming,
    picture_target,
    recording_experiment,
    render_recording,
    scene_of,
)
from vinetrack.laboratory.scene import Camera, Target

WIDTH_PX, HEIGHT_PX, MARGIN = 960, 320, 1.35
"""Of the picture, and how many times the longest vine it is wide."""


def filming_of(campaign: Hidden) -> Filming:
    """A camera that sees the longest vine, and a board that fills its picture."""
    longest_m = max(trial.length_m for trial, _ in campaign.pairs)
    m_per_px = MARGIN * longest_m / WIDTH_PX
    square_m = round(WIDTH_PX * m_per_px / 15.5, 4)
    return Filming(
        camera=Camera(
            width_px=WIDTH_PX, height_px=HEIGHT_PX, m_per_px=m_per_px, focal_px=2600, k1=-0.08, tilt_y_deg=0.8
        ),
        target=Target(kind="charuco", squares=(14, 5), square_m=square_m, marker_m=round(0.73 * square_m, 4)),
    )


def film_campaign(campaign: Hidden, folder: Path, processes: int) -> Experiment:
    """Write sheet, settings and target, and film every trial; `campaign` is one made to be filmed."""
    filming = filming_of(campaign)
    write_folder(campaign, folder / "as_tracks")
    names = [trial.name for trial, _ in campaign.pairs]
    experiment = recording_experiment(read_experiment(folder / "as_tracks"), names, filming, folder / "filmed")
    assert experiment.settings.calibration is not None
    picture_target(filming, experiment.folder / experiment.settings.calibration.image, campaign.seed)
    (experiment.folder / "videos").mkdir(exist_ok=True)
    with ProcessPoolExecutor(processes) as pool:
        list(pool.map(partial(_film, filming=filming, folder=experiment.folder), campaign.pairs))
    return experiment


def _film(pair: tuple[Trial, Track], filming: Filming, folder: Path) -> None:
    trial, track = pair
    grown = track.lead_position_m - track.lead_position_m[0]
    count = track.time_s.size
    fine_s = np.linspace(0.0, count / trial.capture_fps, FINE_STEPS * count + 1)
    # Between frames the motion is smooth, and at rest it stays at rest.
    motion = fine_s, PchipInterpolator(track.time_s, grown)(np.minimum(fine_s, track.time_s[-1]))
    scene = scene_of(trial, filming)
    path = folder / "videos" / f"{trial.name}.mp4"
    render_recording(
        scene, motion, n_frames=count, capture_fps=trial.capture_fps, out_path=path, seed=int(trial.name[1:])
    )
