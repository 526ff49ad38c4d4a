"""The files of a draft: read, checked in a copy of the folder, and written atomically."""

from __future__ import annotations

import csv
import hashlib
import io
import os
import re
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any

from vinetrack.core.problems import ExperimentError, Problem
from vinetrack.core.records import CONTAINERS, IMAGES, Correction
from vinetrack.core.tables import (
    MIN_PICTURES,
    PROVENANCE,
    TableError,
    entries,
    is_calibration,
    list_recordings,
    natural_order,
    parse_yaml,
    read_table,
    read_text,
    with_value,
    write_text,
)
from vinetrack.core.units import UNITS, convert, other_units, split_unit
from vinetrack.experiment.folder import CORRECTIONS_FILE, SETTINGS, corrections_text, read_corrections
from vinetrack.experiment.schema import COLUMNS, SHARED
from vinetrack.experiment.sheet import SHEET

# ------------------------------------------------------------------------------
# Editing of the trial sheet: cells as text, with those of an existing sheet preserved.

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


# ------------------------------------------------------------------------------
# Editing of `experiment.yaml` as text with its comments preserved, and a commented template for a new one.

# Keys of a new file: what all trials of most campaigns share
FIRST_KEYS = ("capture_fps", "exposure_us", "yield_pressure_kPa", "growth_angle_deg", "chamber_l")

_HEAD = """\
# What all trials share; a column of the same name in trials.csv overrides it. The unit of a value is in its name, and
# a name may end in another one (yield_pressure_psi). `vinetrack settings` lists every key.
"""
_SCALE = """\
# The scale: two marks on a ruler in the plane of growth (kind: two_points, from_px, to_px, length_mm), a printed board
# (kind: charuco, image, squares, square_mm, marker_mm, dictionary), or the scale itself (kind: mm_per_px, mm_per_px).
calibration:
# The growth axis in the picture (from_px, to_px, width_mm); found from the motion if blank.
axis:
"""


def read_settings_text(folder: Path) -> str:
    """Return the text of `experiment.yaml`; if there is none, that of a template with blanks to fill."""
    path = folder / SETTINGS
    if not path.exists():
        return first_settings()
    try:
        text = read_text(path)
    except TableError as error:
        raise ExperimentError([Problem.from_error(error, SETTINGS)]) from None
    parse_yaml(text, SETTINGS)
    return text


def first_settings() -> str:
    """Return a template of `experiment.yaml`: keys without values, each with its meaning and how to measure it."""
    width = max(len(key) for key in FIRST_KEYS) + 3
    lines = [f"{f'{key}:':{width}}# {_comment(key)}\n" for key in FIRST_KEYS]
    return _HEAD + "".join(lines) + _SCALE


def _comment(key: str) -> str:
    column = COLUMNS[key]
    unit = f" [{column.unit}]" if column.unit and column.unit.lower() not in column.meaning.lower() else ""
    how = f" {column.measured}" if column.measured else ""
    blank = "" if column.default.startswith("required") else f" Blank: {column.default or 'unknown'}."
    return f"{column.meaning.rstrip('.')}{unit}.{how}{blank}"


def shared_values(text: str) -> dict[str, Any]:
    """Return the columns that the settings set for all trials, under the names (and units) used there."""
    quantities = {split_unit(name)[0] for name in SHARED}
    content = parse_yaml(text, SETTINGS).content
    return {
        key: value
        for key, value in content.items()
        if value is not None and (key in SHARED or split_unit(str(key))[0] in quantities)
    }


def with_shared(text: str, values: Mapping[str, str]) -> str:
    """Return the settings with columns set or cleared for all trials; other keys and all comments are kept."""
    content = parse_yaml(text, SETTINGS).content
    for key, cell in values.items():
        for other in [name for name in content if name != key and _same_quantity(str(name), key)]:
            text = _renamed(text, str(other), "" if key in content else key)
            if key not in content:
                content[key] = content[other]
        value = _value(cell)
        if value is None and content.get(key) is None:
            continue
        if value is not None and content.get(key) is not None and str(content[key]) == str(value):
            continue
        text = with_value(text, key, value, SETTINGS)
    return text


def _renamed(text: str, key: str, to: str) -> str:
    """The settings with a top-level key under another name, or without its line: a blank key beside the same quantity
    in another unit would be refused.
    """
    line = re.compile(rf"^{re.escape(key)}(\s*:)(.*\n?)", re.MULTILINE)
    return line.sub(rf"{to}\1\2" if to else "", text, count=1)


def _same_quantity(name: str, other: str) -> bool:
    return split_unit(name)[0] == split_unit(other)[0] and bool(split_unit(name)[1])


def _value(cell: str) -> Any:
    """A cell as YAML would read it, so that a number is not quoted; None if it is blank."""
    cell = cell.strip()
    if not cell:
        return None
    try:
        read = parse_yaml(f"v: {cell}\n", SETTINGS).content["v"]
    except ExperimentError:
        return cell
    return read if isinstance(read, int | float | bool | str) else cell


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


# ------------------------------------------------------------------------------
# A block of text pasted into the table: split into cells, its header read, its rows matched by the names of the clips.
#
# Whatever matches nothing is named and changes nothing, so that no number stands beside another film than its own.

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


# ------------------------------------------------------------------------------
# What a folder holds, and the columns that names of recordings give: `d12_24kPa_1` is a vine of 12 mm at 24 kPa.

_NUMBER_IN_NAME = r"(?P<number>\d+(?:[.p]\d+)?)"
# Column of a number with a unit, by the unit in lower case
_COLUMN_BY_UNIT: dict[str, str] = {
    "kpa": "pressure_kPa",
    "psi": "pressure_psi",
    "mbar": "pressure_mbar",
    "bar": "pressure_bar",
    "g": "payload_g",
    "kg": "payload_kg",
    "um": "thickness_um",
    "µm": "thickness_um",
    "fps": "capture_fps",
    "deg": "growth_angle_deg",
    "mm": "diameter_mm",
    "cm": "length_cm",
    "in": "diameter_in",
}

# Column of a number after a letter or word; a unit after the number overrides that of the column
_COLUMN_BY_LETTER = {
    "d": "diameter_mm",
    "dia": "diameter_mm",
    "diam": "diameter_mm",
    "t": "thickness_um",
    "l": "length_mm",
    "len": "length_mm",
    "p": "pressure_kPa",
    "m": "payload_g",
    "day": "day",
    "specimen": "specimen",
    "tube": "specimen",
}

_WORD = re.compile(rf"(?P<letter>[a-z]*?){_NUMBER_IN_NAME}(?P<unit>[a-zµ]*)", re.IGNORECASE)


def list_pictures(folder: Path) -> list[str]:
    """Return single pictures and films that may show a ruler or a board, as paths relative to the folder."""
    pictures = [path for path in entries(folder) if path.is_file() and path.suffix.lower() in IMAGES]
    pictures = pictures if len(pictures) < MIN_PICTURES else []
    for sub in entries(folder):
        if sub.is_dir() and is_calibration(sub):
            pictures += [path for path in entries(sub) if path.suffix.lower() in IMAGES | CONTAINERS]
    return sorted((path.relative_to(folder).as_posix() for path in pictures), key=natural_order)


def list_tables(folder: Path) -> list[str]:
    """Return tables that may be pressure traces, as paths relative to the folder."""
    folders = [folder, *(path for path in entries(folder) if path.is_dir() and not (path / PROVENANCE).exists())]
    tables = [path for place in folders for path in entries(place) if path.suffix.lower() == ".csv"]
    names = (path.relative_to(folder).as_posix() for path in tables)
    return sorted((name for name in names if name not in ("trials.csv", "corrections.csv")), key=natural_order)


def trial_names(recordings: Sequence[str], taken: Iterable[str] = ()) -> list[str]:
    """Return a trial name for each recording: that of its file, with those of its folders if two are the same."""
    stems = [_clean(_stem(recording)) for recording in recordings]
    used = {name.lower() for name in taken}
    names = []
    for recording, stem in zip(recordings, stems, strict=True):
        name = stem
        if sum(other.lower() == stem.lower() for other in stems) > 1:
            name = _clean("_".join([*PurePosixPath(recording).parts[:-1], stem]))
        count, first = 2, name
        while name.lower() in used:
            name, count = f"{first}_{count}", count + 1
        used.add(name.lower())
        names.append(name)
    return names


def columns_from_names(recordings: Sequence[str]) -> list[dict[str, str]]:
    """Return the cells of a trial sheet given by the names of recordings. Only numbers with a letter or a unit are
    read: a bare number counts replicates. A quantity that all names give in the same other unit keeps it
    (`pressure_psi`); a mixture of units is converted to that of the sheet.
    """
    rows = [_columns_from_name(recording) for recording in recordings]
    units: dict[str, set[str]] = {}
    for cells in rows:
        for name in cells:
            units.setdefault(split_unit(name)[0], set()).add(name)
    out = []
    for cells in rows:
        row = {}
        for name, cell in cells.items():
            column = _sheet_column(name)
            convert_unit = len(units[split_unit(name)[0]]) > 1 and name != column
            row[column if convert_unit else name] = _converted(cell, name, column) if convert_unit else cell
        out.append(row)
    return out


_UNITS = "|".join(sorted(_COLUMN_BY_UNIT, key=len, reverse=True))
# A number and its unit separated by a blank, `24 kPa`
_SPACED_UNIT = re.compile(rf"(?<![A-Za-z0-9])(\d+(?:[.p]\d+)?)[_\s]+({_UNITS})(?![A-Za-z0-9])", re.IGNORECASE)


def _columns_from_name(recording: str) -> dict[str, str]:
    """Cells of one name, by column, whose name may be in another unit."""
    cells: dict[str, str] = {}
    parts = [*PurePosixPath(recording).parts[:-1], _stem(recording)]
    for part in parts:
        of_part: dict[str, str] = {}
        for word in re.split(r"[_\s,;+-]+", _SPACED_UNIT.sub(r"\1\2", part)):
            match = _WORD.fullmatch(word)
            column = _column_of(match, of_part) if match else ""
            if match and column:
                of_part[column] = match["number"].lower().replace("p", ".")
        quantities = {split_unit(name)[0] for name in of_part}
        cells = {name: cell for name, cell in cells.items() if split_unit(name)[0] not in quantities} | of_part
    return {name: f"{float(cell):g}" if _is_number(name) else cell for name, cell in cells.items()}


def _column_of(match: re.Match[str], earlier: dict[str, str]) -> str:
    """The column of a word; blank if there is none."""
    letter, unit = match["letter"].lower(), match["unit"].lower()
    if letter in _COLUMN_BY_LETTER:
        column = _COLUMN_BY_LETTER[letter]
        quantity = split_unit(column)[0]
        if not unit:
            return column
        same = [name for name in _COLUMN_BY_UNIT.values() if split_unit(name)[1].lower() == unit.replace("µ", "u")]
        sizes = {"um", "mm", "cm", "in", "m"}
        if unit.replace("µ", "u") in sizes and split_unit(column)[1] in sizes:
            return f"{quantity}_{unit.replace('µ', 'u')}"
        return next((name for name in same if split_unit(name)[0] == quantity), "")
    if letter or not unit:
        return ""
    column = _COLUMN_BY_UNIT.get(unit, "")
    # In names of vines such as 12mm-100um-140mm the second length is that of the vine.
    if column == "diameter_mm" and column in earlier:
        return "length_mm"
    return column


def _is_number(name: str) -> bool:
    column = COLUMNS.get(_sheet_column(name))
    return column is not None and column.kind == "number"


def _sheet_column(name: str) -> str:
    """The sheet's column of a quantity, whatever the unit in the name."""
    quantity = split_unit(name)[0]
    return name if name in COLUMNS else next(column for column in COLUMNS if split_unit(column)[0] == quantity)


def _converted(cell: str, name: str, column: str) -> str:
    return f"{convert(float(cell), split_unit(name)[1], split_unit(column)[1]):.6g}"


def units_of(column: str) -> list[str]:
    """Return the units in which a column may be written, its own first; none if it has no unit."""
    others = other_units(column)
    return [split_unit(column)[1], *others.values()] if others else []


def _stem(recording: str) -> str:
    path = PurePosixPath(recording)
    return path.stem if path.suffix.lower() in CONTAINERS | IMAGES else path.name


def _clean(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9_-]+", "_", name).strip("_") or "trial"
