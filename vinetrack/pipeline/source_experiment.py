"""From a results folder back to the experiment it was made from, and a model written back to `experiment.yaml`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from vinetrack.results.folder_layout import Results, ResultsError, read_json

if TYPE_CHECKING:
    from vinetrack.experiment.folder import Experiment


def read_source_experiment(folder: Path, experiment: Path | None = None) -> Experiment:
    """The experiment that a results folder was made from, by its `provenance.json`.

    Parameters
    ----------
    folder : results folder.
    experiment : Path, optional
        Where the experiment is now, if it has moved.

    Returns
    -------
    Experiment

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


SETTINGS = "experiment.yaml"
BOM = b"\xef\xbb\xbf"


def save_model(folder: Path, names: Sequence[str], files: Sequence[str] = ()) -> Path:
    """Set `model:` of an experiment, in a whole file or not at all; return the path of the settings.

    A mark at the beginning of the file and its line ends stay; a file in another encoding becomes UTF-8.

    Parameters
    ----------
    folder : experiment folder.
    names : sequence of str
        Effects of the model.
    files : sequence of str
        Files of own effects in that folder that `effects:` has to name as well, where it does not yet.

    Returns
    -------
    Path

    Raises
    ------
    ExperimentError
        If the settings cannot be read, or the key cannot be set without harm to what else is there.
    TableError
        If the file is no text.
    """
    from vinetrack.core.tables import read_text, write_bytes
    from vinetrack.core.yaml_document import with_list
    from vinetrack.experiment.settings import read_experiment_settings

    path = folder / SETTINGS
    before = path.read_bytes() if path.exists() else b""
    text = read_text(path) if before else ""
    named = list(read_experiment_settings(path).effects) if before and files else []
    new = [name for name in files if name not in named]
    if new:
        text = with_list(text, "effects", [*named, *new], path.name)
    text = with_list(text, "model", names, path.name)
    if b"\r\n" in before:
        text = text.replace("\n", "\r\n")
    write_bytes(path, (BOM if before.startswith(BOM) else b"") + text.encode("utf-8"))
    return path
