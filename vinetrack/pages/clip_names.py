"""Recordings in a folder, and the columns that their names give: `d12_24kPa_1` is a vine of 12 mm at 24 kPa."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path, PurePosixPath

from vinetrack.core.records import CONTAINERS, IMAGES
from vinetrack.core.tables import MIN_PICTURES, PROVENANCE, entries, is_calibration, natural_order
from vinetrack.core.units import convert, other_units, split_unit
from vinetrack.experiment.schema import COLUMNS

_NUMBER = r"(?P<number>\d+(?:[.p]\d+)?)"
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

_WORD = re.compile(rf"(?P<letter>[a-z]*?){_NUMBER}(?P<unit>[a-zµ]*)", re.IGNORECASE)


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
