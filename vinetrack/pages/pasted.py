"""A block of text pasted into the table: split into cells, its header read, its rows matched by the names of the clips.

Whatever matches nothing is named and changes nothing, so that no number stands beside another film than its own.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import PurePosixPath

from vinetrack.core.units import UNITS, convert, split_unit
from vinetrack.experiment.schema import COLUMNS

SHARED_ROW = "shared"  # The row of the table that applies to all trials
NAME_WORDS = frozenset(
    {"trial", "video", "clip", "film", "recording", "file", "file_name", "filename", "name", "movie"}
)

_DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+")
_NUMBER = re.compile(r"[+-]?(\d+([.,]\d*)?|[.,]\d+)([eE][+-]?\d+)?")


@dataclass
class Pasted:
    """Cells to change, as (row of the sheet or `SHARED_ROW`, column, text), and sentences on what was left out."""

    cells: list[tuple[int | str, str, str]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def read_block(text: str) -> list[list[str]]:
    """Split pasted text into rows of cells, at tabs, semicolons, commas or blanks, whichever it has first."""
    lines = [line.strip("\r") for line in text.strip("\n\r").split("\n")]
    lines = [line for line in lines if line.strip()]
    if any("\t" in line for line in lines):
        delimiter = "\t"
    elif any(";" in line for line in lines):
        delimiter = ";"
    elif any("," in _DECIMAL_COMMA.sub("", line) or line.count(",") > 1 for line in lines) or _same_commas(lines):
        delimiter = ","
    else:
        wide = any(re.search(r"\S {2,}\S", line) for line in lines)
        return [re.split(r" {2,}" if wide else r"\s+", line.strip()) for line in lines]
    return [[cell.strip() for cell in row] for row in csv.reader(lines, delimiter=delimiter, skipinitialspace=True)]


def _same_commas(lines: Sequence[str]) -> bool:
    """Whether one comma in each line separates cells: blanks do not, and not all lines are numbers."""
    return all(line.count(",") == 1 for line in lines) and not all(_DECIMAL_COMMA.fullmatch(s.strip()) for s in lines)


def place_block(
    text: str,
    columns: Sequence[str],
    rows: Sequence[Mapping[str, str]],
    at_row: int | str,
    at_column: str,
    decimal: str = ".",
) -> Pasted:
    """Say which cells of a table with these columns (as shown, without the trial) and rows a pasted block changes.
    Without a header its columns follow the one pasted into, and without names its rows the row pasted into.
    """
    block = read_block(text)
    pasted = Pasted()
    header = [_header_column(word, columns) for word in block[0]] if block else []
    known = [name for name in header if name]
    has_header = bool(known) and not any(_NUMBER.fullmatch(word) for word in block[0])
    if has_header:
        unknown = [word for word, name in zip(block[0], header, strict=True) if word and not name]
        pasted.notes += [f"No column is named “{word}”: left out." for word in unknown]
        block = block[1:]
        name_place = next((i for i, name in enumerate(header) if name == "trial"), None)
    else:
        name_place = _place_of_names(block, rows)
        start = columns.index(at_column) if at_column in columns else 0
        places = [i for i in range(max(map(len, block), default=0)) if i != name_place]
        if at_column not in columns and name_place is None:
            pasted.notes.append("No cell of this block is the name of a recording or of a column: nothing was pasted.")
            return pasted
        targets = dict(zip(places, columns[start:], strict=False))
        header = ["trial" if i == name_place else targets.get(i, "") for i in range(len(places) + 1)]
        if len(places) > len(targets):
            pasted.notes.append(f"{len(places) - len(targets)} columns of this block lie beyond the table: left out.")
    order: list[int | str] = [SHARED_ROW, *range(len(rows))]
    begin = order.index(at_row)
    for count, cells in enumerate(block):
        if name_place is None:
            row = order[begin + count] if begin + count < len(order) else None
        else:
            row = _row_named(cells[name_place] if name_place < len(cells) else "", rows)
        if row is None:
            pasted.notes.append(f"No recording for “{' '.join(cells)}”: left out.")
            continue
        for name, cell in zip(header, cells, strict=False):
            if name and name != "trial":
                column = _shown(name, columns)
                pasted.cells.append((row, column, _in_unit(cell, name, column, decimal)))
    return pasted


def _header_column(word: str, columns: Sequence[str]) -> str:
    """The column that a word of a header names, in its unit; `trial` for names of recordings, blank for none."""
    plain = re.sub(r"[^a-z0-9%]+", "_", word.lower().replace("µ", "u").replace("μ", "u")).strip("_")
    if plain in NAME_WORDS:
        return "trial"
    names = {name.lower(): name for name in (*columns, *COLUMNS)}
    if plain in names:
        return names[plain]
    quantities = {split_unit(name)[0].lower(): name for name in (*COLUMNS, *columns)}
    if plain in quantities:
        return quantities[plain]
    for unit in UNITS:
        quantity = plain.removesuffix(f"_{unit.lower()}")
        if quantity != plain and quantity in quantities:
            own = split_unit(quantities[quantity])[1]
            if own in UNITS and UNITS[own].si == UNITS[unit].si:
                return f"{split_unit(quantities[quantity])[0]}_{unit}"
    return ""


def _shown(name: str, columns: Sequence[str]) -> str:
    """The column of the table that holds the quantity of a column."""
    quantity = split_unit(name)[0]
    return next((column for column in columns if split_unit(column)[0] == quantity), name)


def _in_unit(cell: str, name: str, column: str, decimal: str) -> str:
    """A cell in the unit of the table's column and with the decimal mark of the sheet."""
    if not _NUMBER.fullmatch(cell):
        return cell
    number = cell.replace(",", ".")
    if name != column:
        number = f"{convert(float(number), split_unit(name)[1], split_unit(column)[1]):.6g}"
    return number.replace(".", decimal)


def _place_of_names(block: Sequence[Sequence[str]], rows: Sequence[Mapping[str, str]]) -> int | None:
    """The column of a block without a header that has most names of recordings; None if none has any."""
    wide = max(map(len, block), default=0)
    found = [sum(i < len(cells) and _row_named(cells[i], rows) is not None for cells in block) for i in range(wide)]
    return found.index(max(found)) if found and max(found) > 0 else None


def _row_named(name: str, rows: Sequence[Mapping[str, str]]) -> int | None:
    """The one row whose trial or recording has this name, with or without folder and ending."""
    wanted = _plain(name)
    matches = [
        i
        for i, row in enumerate(rows)
        if wanted
        and wanted
        in {
            _plain(text)
            for given in (row.get("trial", ""), row.get("video", ""), row.get("track", ""))
            for path in [PurePosixPath(given)]
            for text in (given, path.name, path.stem, str(path.with_suffix("")) if given else "")
        }
    ]
    return matches[0] if len(matches) == 1 else None


def _plain(name: str) -> str:
    return re.sub(r"[^a-z0-9./-]+", "_", name.lower()).strip("_")
