"""Simulate the trials of an experiment folder and write the recordings or tracks that its sheet names.

    python -m vinetrack.laboratory data/demo [--nature FILE] [--processes N]
    python -m vinetrack.laboratory data/paper --film FOLDER

Trials with a `video` are filmed, with the calibration picture that `experiment.yaml` names; those with a `track` are
measured. The sheet defines the trials, and `--nature` the ground truth (default: the file of this package with the name
of the experiment's folder, else that of the demonstration). `--film` makes recordings of an experiment of tracks.
"""

from __future__ import annotations

import argparse
import os
from concurrent.futures import ProcessPoolExecutor
from itertools import count, repeat
from pathlib import Path

import yaml

from vinetrack.experiment.folder import read_experiment
from vinetrack.laboratory.campaigns import (
    compile_the_tracker,
    film,
    grow,
    make_filming,
    picture_target,
    read_ground_truth,
    recording_experiment,
    write_tracks,
)

DEMO = Path(__file__).with_name("demo.yaml")


def main(arguments: list[str] | None = None) -> None:
    """Run the command described above."""
    parser = argparse.ArgumentParser(prog="python -m vinetrack.laboratory", description="Grow the trials of a sheet.")
    parser.add_argument("experiment", type=Path)
    parser.add_argument("--nature", type=Path)
    parser.add_argument("--film", type=Path, metavar="FOLDER")
    parser.add_argument("--processes", type=int, default=min(os.cpu_count() or 1, 4))
    given = parser.parse_args(arguments)
    experiment = read_experiment(given.experiment, strict=True)
    named = Path(__file__).with_name(f"{experiment.name}.yaml")
    path = given.nature or (named if named.exists() else DEMO)
    truth, content = read_ground_truth(path), yaml.safe_load(path.read_text(encoding="utf-8"))
    filming = make_filming(content.get("filming", {}))
    if given.film is not None:
        try:
            experiment = recording_experiment(experiment, filming, given.film)
        except ValueError as error:
            parser.error(str(error))
    with ProcessPoolExecutor(given.processes) as pool:
        if any(trial.video for trial in experiment.trials) and given.processes > 1:
            pool.submit(compile_the_tracker)
        grown = grow(experiment.trials, truth)
        for trial in grown:
            if trial.stated.track is not None:
                write_tracks([trial], trial.stated.track.parent)
        if filmed := [trial for trial in grown if trial.stated.video is not None]:
            n_frames = sum(trial.track.time_s.size for trial in filmed)
            told = f"Filming {len(filmed)} trials in the virtual laboratory, {n_frames} frames."
            print(f"{told} The first takes longest.", flush=True)
            image = getattr(experiment.settings.calibration, "image", None)
            if image is not None:
                picture_target(filming, experiment.folder / image, truth.seed)
            paths = [trial.stated.video for trial in filmed]
            truths = pool.map(film, filmed, repeat(filming), paths, count(truth.seed))
            for i, (trial, seen) in enumerate(zip(filmed, truths, strict=True), 1):
                print(f"filmed {i} of {len(filmed)}: {trial.stated.name}, {seen.time_s.size} frames", flush=True)
    n_frames = sum(trial.track.time_s.size for trial in grown)
    print(f"Grown in the virtual laboratory: {len(grown)} trials, {n_frames} frames.", flush=True)


if __name__ == "__main__":
    main()
