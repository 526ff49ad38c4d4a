"""From a results folder back to the experiment that it was made from."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from vinetrack.results.folder_layout import Results, ResultsError, read_json

if TYPE_CHECKING:
    from vinetrack.experiment.folder import Experiment


def experiment_behind(folder: Path, experiment: Path | None = None) -> Experiment:
    """The experiment that a results folder was made from, by its `provenance.json`.

    Parameters
    ----------
    experiment
        Where it is now, if it has moved.

    Raises
    ------
    ResultsError
        If it is no results folder, or its experiment has moved.
    ExperimentError
        If the experiment cannot be read.
    """
    from vinetrack.experiment.folder import read_experiment

    results = Results(folder)
    if not folder.is_dir():
        raise ResultsError(f"{folder} is no folder: name the one that snakemake made, results/NAME")
    if not results.provenance.exists():
        raise ResultsError(f"{folder} is no results folder: it has no {results.provenance.name}; run snakemake first")
    where = experiment or Path(str(read_json(results.provenance)["experiment"]))
    if not where.is_dir():
        raise ResultsError(f"{where}, the experiment of {folder}, has moved: say where it is with --experiment PATH")
    return read_experiment(where)
