"""An experiment of tracks made one of recordings: the same sheet, a camera and a target in place of tracks.

What comes out is a folder like anybody's, to be analysed from the frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pandas as pd
import yaml

from vinetrack.core.tables import write_csv, write_text
from vinetrack.experiment.folder import Experiment, read_experiment
from vinetrack.experiment.sheet import SHEET
from vinetrack.laboratory.filming import Filming

SETTINGS = "experiment.yaml"
TARGET = "calibration/board.png"


def before_the_camera(experiment: Experiment, trials: Sequence[str], filming: Filming, folder: Path) -> Experiment:
    """Write sheet and settings of an experiment in which these trials are filmed; nothing is filmed yet.

    Parameters
    ----------
    experiment
        One whose trials are tracks.
    trials
        Names of those to film.
    folder
        Where the new experiment goes; its recordings will lie in `videos/`.

    Raises
    ------
    ValueError
        If the experiment brings recordings or a calibration already, the target is no board, or `folder` is the
        experiment itself.
    """
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
    """What `experiment.yaml` has to say of the camera and the target."""
    target = filming.target
    if target.kind != "charuco":
        raise ValueError(f"the target is a {target.kind}; a recording needs a charuco board")
    exposures_us = {round(1e6 * filming.exposure_fraction / trial.capture_fps, 3) for trial in experiment.trials}
    if len(exposures_us) != 1:
        raise ValueError("trials were captured at several rates: one exposure does not fit all")
    board = {
        "kind": target.kind,
        "image": TARGET,
        "squares": list(target.squares),
        "square_mm": round(1e3 * target.square_m, 6),
        "marker_mm": round(1e3 * target.marker_m, 6),
        "dictionary": target.dictionary,
    }
    return yaml.safe_dump({"exposure_us": exposures_us.pop(), "calibration": board}, sort_keys=False)
