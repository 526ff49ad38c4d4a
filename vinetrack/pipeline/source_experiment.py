"""The experiment that a results folder was made from, and saving a model to its `experiment.yaml`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from vinetrack.results.folder_layout import Results, ResultsError, read_json

if TYPE_CHECKING:
    from vinetrack.experiment.folder import Experiment


def read_source_experiment(folder: Path, experiment: Path | None = None) -> Experiment:
    """Read the experiment that a results folder was made from, as stated by its `provenance.json`."""
    from vinetrack.experiment.folder import read_experiment

    results = Results(folder)
    if not folder.is_dir():
        raise ResultsError(f"{folder} is not a folder: give the results folder of a run, such as results/NAME")
    if not results.provenance.exists():
        raise ResultsError(
            f"{folder} is not a results folder, because it has no {results.provenance.name}: run vinetrack run or "
            "snakemake first"
        )
    path = experiment or Path(str(read_json(results.provenance)["experiment"]))
    if not path.is_dir():
        raise ResultsError(
            f"{folder} was made from {path}, which does not exist any more: give its new path with --experiment PATH"
        )
    return read_experiment(path)


SETTINGS = "experiment.yaml"
BOM = b"\xef\xbb\xbf"


def save_model(folder: Path, names: Sequence[str], files: Sequence[str] = ()) -> Path:
    """Set `model:` in `experiment.yaml`, atomically; return the path of the settings. A byte-order mark and the line
    ends of the file are kept; other encodings are converted to UTF-8.
    """
    from vinetrack.core.tables import read_text, write_bytes
    from vinetrack.core.yaml_document import with_list
    from vinetrack.experiment.settings import read_experiment_settings

    path = folder / SETTINGS
    before = path.read_bytes() if path.exists() else b""
    text = read_text(path) if before else ""
    listed = list(read_experiment_settings(path).effects) if before and files else []
    new = [name for name in files if name not in listed]
    if new:
        text = with_list(text, "effects", [*listed, *new], path.name)
    text = with_list(text, "model", names, path.name)
    if b"\r\n" in before:
        text = text.replace("\n", "\r\n")
    write_bytes(path, (BOM if before.startswith(BOM) else b"") + text.encode("utf-8"))
    return path
