"""The model written back to `experiment.yaml`, the user's own words and comments around it left alone."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

SETTINGS = "experiment.yaml"
BOM = b"\xef\xbb\xbf"


def save_model(folder: Path, names: Sequence[str]) -> Path:
    """Set `model:` of an experiment, in a whole file or not at all; return the path of the settings.

    A mark at the beginning of the file and its line ends stay; a file in another encoding becomes UTF-8.

    Raises
    ------
    ExperimentError
        If the settings cannot be read, or the key cannot be set without harm to what else is there.
    TableError
        If the file is no text.
    """
    from vinetrack.core.tables import read_text, write_bytes
    from vinetrack.core.yaml_document import with_list

    path = folder / SETTINGS
    if not path.exists():
        write_bytes(path, with_list("", "model", names).encode())
        return path
    text = with_list(read_text(path), "model", names, path.name)
    before = path.read_bytes()
    if b"\r\n" in before:
        text = text.replace("\n", "\r\n")
    write_bytes(path, (BOM if before.startswith(BOM) else b"") + text.encode("utf-8"))
    return path
