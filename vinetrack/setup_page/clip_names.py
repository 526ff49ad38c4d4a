"""Recordings in a folder, and what their names say of the trials: `d12_24kPa_1` is a vine of 12 mm at 24 kPa."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path, PurePosixPath

from vinetrack.core.units import UNITS, convert, split_unit
from vinetrack.experiment.provenance import PROVENANCE
from vinetrack.experiment.schema import COLUMNS

FEWEST_PICTURES = 5
"""Pictures that make a folder a recording; chosen: a track needs as many frames. With half, a folder of two photographs
would be one; with twice, a short burst would be missed."""

DEEPEST = 4
"""Folders below the experiment's that are looked into; chosen: vine, day, pressure and a folder of pictures. At half
such an order is missed; twice changes nothing but how long a disk is searched."""

_NUMBER = r"(?P<number>\d+(?:[.p]\d+)?)"
_BY_UNIT: dict[str, str] = {
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
"""What a number with a unit says, by the unit in small letters."""

_BY_LETTER = {
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
"""What a letter or word before a number says; a unit behind the number overrides that of the column."""

_WORD = re.compile(rf"(?P<letter>[a-z]*?){_NUMBER}(?P<unit>[a-zµ]*)", re.IGNORECASE)


def list_recordings(folder: Path) -> list[str]:
    """Recordings below a folder, as paths relative to it, in the order of their names and numbers.

    Parameters
    ----------
    folder : of an experiment, with or without a sheet.

    Returns
    -------
    paths with slashes
        Films, folders of at least `FEWEST_PICTURES` pictures and stacks of pictures; results, the calibration and
        hidden files are left out.
    """
    names = [path.relative_to(folder).as_posix() for path in _recordings(folder, DEEPEST)]
    return sorted(names, key=_natural)


def list_pictures(folder: Path) -> list[str]:
    """Single pictures and films that may show a ruler or a board, as paths relative to the folder.

    Parameters
    ----------
    folder : of the experiment.

    Returns
    -------
    paths with slashes : pictures in the folder itself and everything in `calibration`.
    """
    kinds = _suffixes("IMAGES")
    films = _suffixes("CONTAINERS")
    there = [path for path in _entries(folder) if path.is_file() and path.suffix.lower() in kinds]
    there = there if len(there) < FEWEST_PICTURES else []
    for sub in _entries(folder):
        if sub.is_dir() and _is_calibration(sub):
            there += [path for path in _entries(sub) if path.suffix.lower() in kinds | films]
    return sorted((path.relative_to(folder).as_posix() for path in there), key=_natural)


def list_tables(folder: Path) -> list[str]:
    """Tables that may be pressure traces, as paths relative to the folder.

    Parameters
    ----------
    folder : of the experiment.

    Returns
    -------
    paths with slashes : CSV files in the folder and in those directly in it, but for sheet and corrections.
    """
    folders = [folder, *(path for path in _entries(folder) if path.is_dir() and not (path / PROVENANCE).exists())]
    tables = [path for place in folders for path in _entries(place) if path.suffix.lower() == ".csv"]
    names = (path.relative_to(folder).as_posix() for path in tables)
    return sorted((name for name in names if name not in ("trials.csv", "corrections.csv")), key=_natural)


def trial_names(recordings: Sequence[str], taken: Iterable[str] = ()) -> list[str]:
    """A name for the trial of each recording: that of its file, with its folder's where two are called alike.

    Parameters
    ----------
    recordings : relative paths.
    taken : names that trials have already.

    Returns
    -------
    one name each: letters, digits, _ and -.

    >>> trial_names(["videos/d12 24kPa.mp4", "monday/1.mp4", "tuesday/1.mp4"])
    ['d12_24kPa', 'monday_1', 'tuesday_1']
    """
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


def guess_columns(recordings: Sequence[str]) -> list[dict[str, str]]:
    """What the names of recordings say, as cells of a trial sheet.

    Only what carries a letter or a unit is read: a bare number counts replicates. A quantity that all names give in one
    other unit keeps it (`pressure_psi`); names in several units come out in that of the sheet.

    Parameters
    ----------
    recordings : relative paths; their folders are read too, the file's own name counting more.

    Returns
    -------
    one mapping each, column to cell.

    >>> guess_columns(["videos/d12_24kPa_1.mp4", "d24-20g-2p5psi.mp4"])
    [{'diameter_mm': '12', 'pressure_kPa': '24'}, {'diameter_mm': '24', 'payload_g': '20', 'pressure_kPa': '17.2369'}]
    >>> guess_columns(["tuesday 12 mm 24 kPa 20 g a.mp4"])
    [{'diameter_mm': '12', 'pressure_kPa': '24', 'payload_g': '20'}]
    """
    read = [_guess(recording) for recording in recordings]
    units: dict[str, set[str]] = {}
    for cells in read:
        for name in cells:
            units.setdefault(split_unit(name)[0], set()).add(name)
    out = []
    for cells in read:
        row = {}
        for name, cell in cells.items():
            column = _sheet_column(name)
            several = len(units[split_unit(name)[0]]) > 1 and name != column
            row[column if several else name] = _in_unit(cell, name, column) if several else cell
        out.append(row)
    return out


_UNITS = "|".join(sorted(_BY_UNIT, key=len, reverse=True))
_APART = re.compile(rf"(?<![A-Za-z0-9])(\d+(?:[.p]\d+)?)[_\s]+({_UNITS})(?![A-Za-z0-9])", re.IGNORECASE)
"""A number and its unit with a blank between, `24 kPa`."""


def _guess(recording: str) -> dict[str, str]:
    """Cells by column, or by quantity in another unit."""
    cells: dict[str, str] = {}
    parts = [*PurePosixPath(recording).parts[:-1], _stem(recording)]
    for part in parts:
        of_part: dict[str, str] = {}
        for word in re.split(r"[_\s,;+-]+", _APART.sub(r"\1\2", part)):
            match = _WORD.fullmatch(word)
            column = _column_of(match, of_part) if match else ""
            if match and column:
                of_part[column] = match["number"].lower().replace("p", ".")
        quantities = {split_unit(name)[0] for name in of_part}
        cells = {name: cell for name, cell in cells.items() if split_unit(name)[0] not in quantities} | of_part
    return {name: f"{float(cell):g}" if _is_number(name) else cell for name, cell in cells.items()}


def _column_of(match: re.Match[str], earlier: dict[str, str]) -> str:
    """The column that a word speaks of; blank where it speaks of none."""
    letter, unit = match["letter"].lower(), match["unit"].lower()
    if letter in _BY_LETTER:
        column = _BY_LETTER[letter]
        quantity = split_unit(column)[0]
        if not unit:
            return column
        same = [name for name in _BY_UNIT.values() if split_unit(name)[1].lower() == unit.replace("µ", "u")]
        sizes = {"um", "mm", "cm", "in", "m"}
        if unit.replace("µ", "u") in sizes and split_unit(column)[1] in sizes:
            return f"{quantity}_{unit.replace('µ', 'u')}"
        return next((name for name in same if split_unit(name)[0] == quantity), "")
    if letter or not unit:
        return ""
    column = _BY_UNIT.get(unit, "")
    # As vines are named here, 12mm-100um-140mm: the second length is how long it grows.
    if column == "diameter_mm" and column in earlier:
        return "length_mm"
    return column


def _is_number(name: str) -> bool:
    column = COLUMNS.get(_sheet_column(name))
    return column is not None and column.kind == "number"


def _sheet_column(name: str) -> str:
    """The sheet's own column of a quantity, whatever unit a name gives it in."""
    quantity = split_unit(name)[0]
    return name if name in COLUMNS else next(column for column in COLUMNS if split_unit(column)[0] == quantity)


def _in_unit(cell: str, name: str, column: str) -> str:
    return f"{convert(float(cell), split_unit(name)[1], split_unit(column)[1]):.6g}"


def units_of(column: str) -> list[str]:
    """Units in which a column may be written, its own first; none where it has no unit.

    Parameters
    ----------
    column : its name in the sheet.

    Returns
    -------
    keys of `UNITS`.

    >>> units_of("payload_g"), units_of("bends")
    (['g', 'mg', 'oz', 'lb', 'kg'], [])
    """
    unit_of_column = split_unit(column)[1]
    if unit_of_column not in UNITS or COLUMNS[column].kind != "number":
        return []
    return [
        unit_of_column,
        *(key for key, unit in UNITS.items() if unit.si == UNITS[unit_of_column].si and key != unit_of_column),
    ]


def _recordings(folder: Path, depth: int) -> Iterator[Path]:
    films, kinds = _suffixes("CONTAINERS"), _suffixes("IMAGES")
    for path in _entries(folder):
        if path.is_file() and (path.suffix.lower() in films or _is_stack(path)):
            yield path
        elif path.is_dir() and not (path / PROVENANCE).exists() and not _is_calibration(path):
            inside = [entry for entry in _entries(path) if entry.suffix.lower() in kinds]
            if len(inside) >= FEWEST_PICTURES:
                yield path
            elif depth > 0:
                yield from _recordings(path, depth - 1)


def _entries(folder: Path) -> list[Path]:
    try:
        return [path for path in folder.iterdir() if not path.name.startswith(".")]
    except OSError:
        return []


def _is_calibration(folder: Path) -> bool:
    return folder.name.lower().startswith("calib")


def _is_stack(path: Path) -> bool:
    """Whether a TIFF holds as many pictures as a recording needs."""
    from PIL import Image, UnidentifiedImageError

    if path.suffix.lower() not in (".tif", ".tiff"):
        return False
    try:
        with Image.open(path) as image:
            return getattr(image, "n_frames", 1) >= FEWEST_PICTURES
    except (OSError, UnidentifiedImageError):
        return False


def _suffixes(which: str) -> frozenset[str]:
    # The decoder is heavy: it is loaded where recordings are looked for, not with the command line.
    from vinetrack.video import frames

    return frozenset(getattr(frames, which))


def _stem(recording: str) -> str:
    path = PurePosixPath(recording)
    return path.stem if path.suffix.lower() in _suffixes("CONTAINERS") | _suffixes("IMAGES") else path.name


def _clean(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9_-]+", "_", name).strip("_") or "trial"


def _natural(text: str) -> list[tuple[int, int, str]]:
    """Numbers in a name by their size: 2 before 10."""
    return [(0, int(part), "") if part.isdigit() else (1, 0, part.lower()) for part in re.findall(r"\d+|\D+", text)]
