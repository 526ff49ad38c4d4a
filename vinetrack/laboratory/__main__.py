"""Grow the trials of an experiment folder in the virtual laboratory and make what its sheet names.

    python -m vinetrack.laboratory data/demo [--nature FILE] [--truth FILE] [--processes N]

Trials with a `video` are filmed, with the calibration picture that `experiment.yaml` names; those with a `track` are
measured. The sheet says what is to be grown; `--nature` what is true and hidden (default: that of the demonstration).
The truth is written only where `--truth` says, never inside the experiment.
"""

from __future__ import annotations

import argparse
import os
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import yaml

from vinetrack.experiment import Experiment, read_experiment
from vinetrack.laboratory.filming import Filming, film, make_filming, picture_target
from vinetrack.laboratory.nature import read_nature
from vinetrack.laboratory.tracks import VirtualTrial, grow, write_tracks, write_truth

DEMO = Path(__file__).with_name("demo.yaml")


def main(arguments: list[str] | None = None) -> None:
    """Run the command described above."""
    parser = argparse.ArgumentParser(prog="python -m vinetrack.laboratory", description="Grow the trials of a sheet.")
    parser.add_argument("experiment", type=Path)
    parser.add_argument("--nature", type=Path, default=DEMO)
    parser.add_argument("--truth", type=Path)
    parser.add_argument("--processes", type=int, default=min(os.cpu_count() or 1, 4))
    given = parser.parse_args(arguments)
    experiment = read_experiment(given.experiment, strict=True)
    nature = read_nature(given.nature)
    grown = grow(experiment.trials, nature)
    filmed = [trial for trial in grown if trial.stated.video is not None]
    measured = [trial for trial in grown if trial.stated.track is not None]
    for folder in {trial.stated.track.parent for trial in measured if trial.stated.track is not None}:
        write_tracks(
            [trial for trial in measured if trial.stated.track and trial.stated.track.parent == folder], folder
        )
    if filmed:
        n_frames = sum(trial.track.time_s.size for trial in filmed)
        print(
            f"Filming {len(filmed)} trials in the virtual laboratory, {n_frames} frames. The first takes longest.",
            flush=True,
        )
        content: dict[str, Any] = yaml.safe_load(given.nature.read_text(encoding="utf-8"))
        _film(experiment, filmed, make_filming(content.get("filming", {})), nature.seed, given.processes)
    if given.truth is not None:
        write_truth(grown, nature, given.truth)
    n_frames = sum(trial.track.time_s.size for trial in grown)
    print(f"Grown in the virtual laboratory: {len(grown)} trials, {n_frames} frames.", flush=True)


def _film(experiment: Experiment, grown: list[VirtualTrial], filming: Filming, seed: int, processes: int) -> None:
    """Film every trial, in a few processes, with a line for each that is done."""
    image = getattr(experiment.settings.calibration, "image", None)
    if image is not None:
        picture_target(filming, experiment.folder / image, seed)
    one = partial(_film_one, filming=filming, seed=seed)
    with ProcessPoolExecutor(processes) as pool:
        for i, name in enumerate(pool.map(one, grown, range(len(grown)))):
            print(f"filmed {i + 1} of {len(grown)}: {name}", flush=True)


def _film_one(trial: VirtualTrial, number: int, filming: Filming, seed: int) -> str:
    path = trial.stated.video
    assert path is not None
    path.parent.mkdir(parents=True, exist_ok=True)
    truth = film(trial, filming, path, seed + number)
    return f"{trial.stated.name}, {truth.time_s.size} frames"


if __name__ == "__main__":
    main()
