"""The files of a draft: read, checked in a copy of the folder, and written atomically."""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from vinetrack.core.problems import ExperimentError, Problem
from vinetrack.core.records import Correction
from vinetrack.core.tables import write_text
from vinetrack.experiment.corrections import CORRECTIONS_FILE, corrections_text, read_corrections
from vinetrack.experiment.folder import SETTINGS
from vinetrack.experiment.sheet import SHEET
from vinetrack.setup_page.clip_names import list_recordings
from vinetrack.setup_page.settings_draft import read_settings_text, shared_values
from vinetrack.setup_page.sheet_draft import SheetDraft, read_draft, with_recordings

FILES = (SHEET, SETTINGS, CORRECTIONS_FILE)  # The only files that are written


@dataclass(frozen=True)
class Draft:
    """A sheet, settings and corrections not yet written; `stamp` is the fingerprint of the files that were read."""

    sheet: SheetDraft
    settings: str
    stamp: str
    corrections: Mapping[str, tuple[Correction, ...]] = field(default_factory=dict)


def open_draft(folder: Path) -> Draft:
    """Read the files of a folder, and add a row for every recording that has none."""
    if not folder.is_dir():
        message = "is a file, not a folder" if folder.exists() else "does not exist"
        remedy = "name the folder that holds the recordings"
        raise ExperimentError([Problem(message=message, file=str(folder), remedy=remedy)])
    settings = read_settings_text(folder)
    recordings = list_recordings(folder)
    sheet = read_draft(folder)
    if not recordings and not sheet.rows:
        message = "holds no recording"
        remedy = "put films (mp4, mov, avi, mkv) or folders of pictures in it"
        raise ExperimentError([Problem(message=message, file=str(folder), remedy=remedy)])
    corrections, problems = read_corrections(folder)
    if problems:
        raise ExperimentError(problems)
    rows = with_recordings(sheet, recordings, shared_values(settings))
    return Draft(rows, settings, files_stamp(folder), corrections)


def files_stamp(folder: Path) -> str:
    """Return a fingerprint of the present files."""
    digest = hashlib.sha256()
    for name in FILES:
        path = folder / name
        digest.update(path.read_bytes() if path.is_file() else b"\0absent\0")
    return digest.hexdigest()


def write_draft(folder: Path, draft: Draft) -> list[str]:
    """Write the files that differ from the present ones; nothing else in the folder is changed."""
    if files_stamp(folder) != draft.stamp:
        message = "has changed since it was read, and is left as it is"
        name = SHEET if (folder / SHEET).exists() else SETTINGS
        raise ExperimentError([Problem(message=message, file=name, remedy="reload the page, and enter it again")])
    written = []
    if not (folder / SHEET).exists() or not same_cells(read_draft(folder), draft.sheet):
        write_text(folder / SHEET, draft.sheet.text())
        written.append(SHEET)
    if not (folder / SETTINGS).exists() or read_settings_text(folder) != draft.settings:
        write_text(folder / SETTINGS, draft.settings)
        written.append(SETTINGS)
    if corrections_text(read_corrections(folder)[0]) != corrections_text(draft.corrections):
        write_text(folder / CORRECTIONS_FILE, corrections_text(draft.corrections))
        written.append(CORRECTIONS_FILE)
    return written


def same_cells(first: SheetDraft, other: SheetDraft) -> bool:
    """Return whether two sheets have the same columns and cells, whatever their format."""
    if first.columns != other.columns or len(first.rows) != len(other.rows):
        return False
    return all(
        a.get(column, "") == b.get(column, "")
        for a, b in zip(first.rows, other.rows, strict=True)
        for column in first.columns
    )


@contextmanager
def draft_folder(folder: Path, draft: Draft) -> Iterator[Path]:
    """Make a temporary folder with this draft and links to everything else, for `check` and the tracker."""
    with tempfile.TemporaryDirectory(prefix="vinetrack-setup-") as temporary:
        copy = Path(temporary) / (folder.resolve().name or "experiment")
        copy.mkdir()
        for path in folder.iterdir():
            if path.name not in FILES:
                (copy / path.name).symlink_to(os.path.realpath(path), target_is_directory=path.is_dir())
        write_text(copy / SHEET, draft.sheet.text())
        write_text(copy / SETTINGS, draft.settings)
        if draft.corrections:
            write_text(copy / CORRECTIONS_FILE, corrections_text(draft.corrections))
        yield copy
