"""Grow the trials of an experiment folder in the virtual laboratory and write the tracks its sheet names.

    python -m vinetrack.laboratory data/demo [--nature FILE] [--truth FILE]

The sheet says what is to be grown; `--nature` what is true and hidden (default: that of the demonstration). The truth
is written only where `--truth` says, never inside the experiment.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from vinetrack.experiment import read_experiment
from vinetrack.laboratory.nature import read_nature
from vinetrack.laboratory.tracks import grow, write_tracks, write_truth

DEMO = Path(__file__).with_name("demo.yaml")


def main(arguments: list[str] | None = None) -> None:
    """Run the command described above."""
    parser = argparse.ArgumentParser(prog="python -m vinetrack.laboratory", description="Grow the trials of a sheet.")
    parser.add_argument("experiment", type=Path)
    parser.add_argument("--nature", type=Path, default=DEMO)
    parser.add_argument("--truth", type=Path)
    given = parser.parse_args(arguments)
    experiment = read_experiment(given.experiment, strict=True)
    nature = read_nature(given.nature)
    grown = grow(experiment.trials, nature)
    folders = {trial.track.parent for trial in experiment.trials if trial.track is not None}
    if len(folders) != 1:
        parser.error("every trial of the sheet needs a `track`, all in one folder")
    write_tracks(grown, folders.pop())
    if given.truth is not None:
        write_truth(grown, nature, given.truth)
    print(f"Grown in the virtual laboratory: {len(grown)} trials, {sum(g.track.time_s.size for g in grown)} frames.")


if __name__ == "__main__":
    main()
