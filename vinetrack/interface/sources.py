"""Trials with their tracks from any source: a results folder, an experiment, a frame of tracks, or pairs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import pandas as pd

from vinetrack.core.records import Kinematics, Track, Trial
from vinetrack.experiment.folder import Experiment, read_experiment
from vinetrack.experiment.provenance import PROVENANCE
from vinetrack.inference.fit_data import Pairs
from vinetrack.interface.data_frames import tracks_from_frame
from vinetrack.interface.loaded import LoadedResults

# Loaded results, a results folder, an experiment or its folder, a frame of tracks, or pairs of trial and track
Source = LoadedResults | Experiment | Path | str | pd.DataFrame | Pairs


@dataclass(frozen=True)
class TrialSource:
    """Trials with their tracks, their experiment, and the reasons why trials were left out. `experiment` is None for a
    frame and for pairs; `kinematics` are those of a results folder, by name of trial.
    """

    pairs: list[tuple[Trial, Track]]
    experiment: Experiment | None = None
    left_out: Mapping[str, str] = field(default_factory=dict)
    kinematics: Mapping[str, Kinematics] = field(default_factory=dict)

    @property
    def tracks(self) -> dict[str, Track]:
        """Tracks by name of trial."""
        return {trial.name: track for trial, track in self.pairs}


def read_source(source: Source) -> TrialSource:
    """Read trials and tracks from any source."""
    from vinetrack.inference.fit_data import pairs_of
    from vinetrack.pipeline.model_stage import measured_trials
    from vinetrack.pipeline.source_experiment import read_source_experiment
    from vinetrack.results.folder_layout import Results

    if isinstance(source, LoadedResults):
        source = source.folder
    if isinstance(source, pd.DataFrame):
        return TrialSource(tracks_from_frame(source))
    if isinstance(source, (str, Path)) and (Path(source) / PROVENANCE).exists():
        experiment = read_source_experiment(Path(source))
        pairs, kinematics = measured_trials(experiment, Results(Path(source)))
        return TrialSource(pairs, experiment, {**experiment.failed, **experiment.left_out}, kinematics)
    if isinstance(source, (str, Path)):
        source = read_experiment(source)
    pairs, left_out = pairs_of(source)
    return TrialSource(pairs, source if isinstance(source, Experiment) else None, left_out)
