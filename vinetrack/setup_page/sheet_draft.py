"""Editing of the trial sheet: cells as text, with those of an existing sheet preserved."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from vinetrack.core.problems import ExperimentError, Problem
from vinetrack.core.tables import TableError, read_table
from vinetrack.core.units import split_unit
from vinetrack.experiment.sheet import SHEET
from vinetrack.setup_page.clip_names import columns_from_names, trial_names

# Columns of a new sheet: the names, and what differs between trials in most campaigns
FIRST_COLUMNS = ("trial", "video", "diameter_mm", "thickness_um", "length_mm", "pressure_kPa", "payload_g")


@dataclass(frozen=True)
class SheetDraft:
    """Rows of cells by column, as text; `delimiter` and `decimal` are those of the existing sheet."""

    columns: tuple[str, ...]
    rows: tuple[Mapping[str, str], ...]
    delimiter: str = ","
    decimal: str = "."

    def text(self) -> str:
        """Return the sheet as CSV text."""
        out = io.StringIO()
        writer = csv.writer(out, delimiter=self.delimiter, lineterminator="\n")
        writer.writerow(self.columns)
        writer.writerows([row.get(column, "") for column in self.columns] for row in self.rows)
        return out.getvalue()


def read_draft(folder: Path) -> SheetDraft:
    """Read the sheet of a folder as a draft; without rows if there is none."""
    path = folder / SHEET
    if not path.exists():
        return SheetDraft(FIRST_COLUMNS, ())
    try:
        table = read_table(path)
    except TableError as error:
        raise ExperimentError([Problem.from_error(error, SHEET)]) from None
    loose = [line for line, extra in zip(table.lines, table.extra, strict=True) if extra]
    if loose or table.nameless:
        message = "has cells without a column, which would be lost"
        remedy = "name their columns in the first line, or remove them"
        raise ExperimentError([Problem(message=message, file=SHEET, line=loose[0] if loose else 1, remedy=remedy)])
    return SheetDraft(table.columns, table.rows, table.delimiter, table.decimal)


def with_recordings(draft: SheetDraft, recordings: Sequence[str], shared: Mapping[str, object]) -> SheetDraft:
    """Return the draft with a row added for each recording that has none, filled in from the recordings' names."""
    named = {_path(row.get("video", "")) for row in draft.rows}
    new = [recording for recording in recordings if _path(recording) not in named]
    if not new:
        return draft
    names = trial_names(new, [row.get("trial", "") for row in draft.rows])
    columns = list(draft.columns)
    rows: list[Mapping[str, str]] = list(draft.rows)
    present = {split_unit(column)[0]: column for column in columns}
    for recording, name, guess in zip(new, names, columns_from_names(new), strict=True):
        row = {"trial": name, "video": recording}
        for column, cell in guess.items():
            quantity = split_unit(column)[0]
            if str(shared.get(column, "")) == cell:
                continue
            if present.get(quantity, column) != column and (draft.rows or quantity not in _first_quantities()):
                continue
            if present.get(quantity, column) != column:
                columns[columns.index(present[quantity])] = column
            elif column not in columns:
                columns.append(column)
            present[quantity] = column
            row[column] = cell.replace(".", draft.decimal or ".")
        rows.append(row)
    missing = [column for column in ("trial", "video") if column not in columns]
    return replace(draft, columns=(*missing, *columns), rows=tuple(rows))


def _first_quantities() -> set[str]:
    return {split_unit(column)[0] for column in FIRST_COLUMNS}


def _path(text: str) -> str:
    """A normalised path."""
    parts = [part for part in text.strip().replace("\\", "/").split("/") if part not in ("", ".")]
    return "/".join(parts)
