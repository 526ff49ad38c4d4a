"""The files of a draft: read, checked in a copy of the folder, and written atomically."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import os
import re
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any

from vinetrack.core import tables
from vinetrack.core.problems import ExperimentError, InputError, Problem
from vinetrack.core.records import CONTAINERS, IMAGES, Correction
from vinetrack.core.units import UNITS, convert, other_units, split_unit
from vinetrack.experiment.folder import CORRECTIONS_FILE, SETTINGS, SHEET, corrections_text, read_corrections
from vinetrack.experiment.schema import COLUMNS, SHARED, did_you_mean, value_and_unit
from vinetrack.experiment.settings import read_experiment_settings
from vinetrack.pipeline.workflow import SHARED_FILES
from vinetrack.tracks.importers import FEWEST_POINTS, read_track
from vinetrack.video.survey import entries, is_calibration, list_recordings, natural_order

# ------------------------------------------------------------------------------
# A quantity has one column in a table, in whichever unit.


def quantity(name: str) -> str:
    """The name of a column without its unit."""
    return split_unit(name)[0]


def column_of(name: str, columns: Iterable[str]) -> str:
    """The column that holds the quantity of a name, whatever its unit; the name itself if there is none."""
    return next((column for column in columns if quantity(column) == quantity(name)), name)


def in_unit_of(column: str, name: str, cell: str, decimal: str = ".") -> str:
    """A cell of the column `name`, or with its own unit, in the unit of `column`; numbers get the decimal mark."""
    number, unit = value_and_unit(cell, name)
    unit, wanted, number = unit or split_unit(name)[1], split_unit(column)[1], number.replace(",", ".")
    try:
        value = tables.parse_number(number)
    except InputError:
        return cell
    return (number if unit == wanted else f"{convert(value, unit, wanted):.6g}").replace(".", decimal)


# ------------------------------------------------------------------------------
# Editing of the trial sheet: cells as text, with those of an existing sheet preserved.


def read_sheet(folder: Path) -> tables.Table:
    """Read the sheet of a folder; without rows if there is none."""
    path = folder / SHEET
    if not path.exists():
        # The names, and what differs between trials in most campaigns
        columns = ("trial", "video", "diameter_mm", "thickness_um", "length_mm", "pressure_kPa", "payload_g")
        return tables.Table(columns, (), (), (), ",", ".")
    try:
        table = tables.read_table(path)
    except InputError as error:
        raise ExperimentError([Problem.from_error(error, SHEET)]) from None
    loose = [line for line, extra in zip(table.lines, table.extra, strict=True) if extra]
    if loose or table.nameless:
        message = "has cells without a column, which would be lost"
        remedy = "name their columns in the first line, remove them, or put decimal commas in quotes"
        raise _refusal(message, SHEET, remedy, line=loose[0] if loose else 1)
    return table


def _refusal(message: str, file: str, remedy: str, **more: Any) -> ExperimentError:
    return ExperimentError([Problem(message=message, file=file, remedy=remedy, **more)])


def cells_of(sheet: tables.Table) -> list[list[str]]:
    """The header and the cells of a sheet."""
    return [list(sheet.columns), *([row.get(column, "") for column in sheet.columns] for row in sheet.rows)]


def with_recordings(sheet: tables.Table, recordings: Sequence[str], shared: Mapping[str, object]) -> tables.Table:
    """Return the sheet with a row added for each recording, or track, that has none, filled in from their names."""
    named = {_path(row.get(column, "")) for row in sheet.rows for column in ("video", "track")}
    new = [recording for recording in recordings if _path(recording) not in named]
    if not new:
        return sheet
    names = trial_names(new, [row.get("trial", "") for row in sheet.rows])
    source = "track" if PurePosixPath(new[0]).suffix.lower() in TABLES else "video"
    columns = [source if name == "video" and not sheet.rows else name for name in sheet.columns]
    rows = list(sheet.rows)
    for recording, name, guess in zip(new, names, columns_from_names(new), strict=True):
        row = {"trial": name, source: recording}
        for column, cell in guess.items():
            present = column_of(column, columns)
            # Cells of an existing sheet keep their units.
            if str(shared.get(column, "")) == cell or (present != column and sheet.rows):
                continue
            if present != column:
                columns[columns.index(present)] = column
            elif column not in columns:
                columns.append(column)
            row[column] = cell.replace(".", sheet.decimal or ".")
        rows.append(row)
    missing = [column for column in ("trial", source) if column not in columns]
    return replace(sheet, columns=(*missing, *columns), rows=tuple(rows))


def _path(text: str) -> PurePosixPath:
    return PurePosixPath(text.strip().replace("\\", "/"))


# ------------------------------------------------------------------------------
# Editing of `experiment.yaml` as text with its comments preserved, and a commented template for a new one.


def read_settings_text(folder: Path) -> str:
    """Return the text of `experiment.yaml`; if there is none, that of a template with blanks to fill."""
    path = folder / SETTINGS
    if not path.exists():
        read_experiment_settings(path)  # refuses one under another name
        return first_settings()
    tables.read_yaml(path)  # refuses what cannot be edited
    return tables.read_text(path)


def first_settings() -> str:
    """Return a template of `experiment.yaml`: keys without values, each with its meaning and how to measure it."""
    # What all trials of most campaigns share
    keys = ("capture_fps", "exposure_us", "yield_pressure_kPa", "growth_angle_deg", "film_density_kg_m3", "chamber_l")
    width, lines = max(map(len, keys)) + 3, []
    for key in keys:
        column = COLUMNS[key]
        how = f" {column.measured}" if column.measured else ""
        blank = "" if column.default.startswith("required") else f" Blank: {column.default or 'unknown'}."
        lines.append(f"{f'{key}:':{width}}# {column.meaning}{how}{blank}\n")
    return f"""\
# What all trials share; a column of the same name in trials.csv overrides it. The unit of a value is in its name, and
# a name may end in another one (yield_pressure_psi). `vinetrack settings` lists every key.
{"".join(lines)}\
# The scale: two marks on a ruler in the plane of growth (kind: two_points, from_px, to_px, length_mm), a printed board
# (kind: charuco, image, squares, square_mm, marker_mm, dictionary), or the scale itself (kind: mm_per_px, mm_per_px).
calibration:
# The growth axis in the picture (from_px, where growth begins, to_px, width_mm); found from the motion if blank.
axis:
"""


def shared_values(text: str) -> dict[str, Any]:
    """Return the columns that the settings set for all trials, under the names (and units) used there."""
    quantities = set(map(quantity, SHARED))
    content = tables.parse_yaml(text, SETTINGS).content
    return {key: value for key, value in content.items() if value is not None and quantity(str(key)) in quantities}


def with_shared(text: str, values: Mapping[str, str]) -> str:
    """Return the settings with columns set or cleared for all trials; other keys and all comments are kept. A key of
    the same quantity in another unit is renamed, or goes, since it would be refused even if it were blank.
    """
    content = tables.parse_yaml(text, SETTINGS).content
    for key, cell in values.items():
        for other in [name for name in map(str, content) if name != key and quantity(name) == quantity(key)]:
            if split_unit(other)[1]:
                line = re.compile(rf"^{re.escape(other)}(\s*:)(.*\n?)", re.MULTILINE)
                text = line.sub("" if key in content else rf"{key}\1\2", text, count=1)
                content.setdefault(key, content[other])
        with suppress(InputError):  # no unit stands below a name with another
            cell = in_unit_of(key, key, cell.strip())
        value, present = _value(cell), content.get(key)
        if value != present and (None in (value, present) or str(value) != str(present)):
            text = with_value(text, key, value, SETTINGS)
    return text


def _value(cell: str) -> Any:
    """A cell as YAML would read it, so that a number is not quoted; None if it is blank."""
    cell = cell.strip()
    if not cell:
        return None
    try:
        read = tables.parse_yaml(f"v: {cell}\n", SETTINGS).content["v"]
    except ExperimentError:
        return cell
    return read if isinstance(read, int | float | bool | str) else cell


# ------------------------------------------------------------------------------
# A draft: sheet, settings and corrections not yet written.


@dataclass(frozen=True)
class Draft:
    """A sheet, settings and corrections not yet written; `stamp` is the fingerprint of the files that were read."""

    sheet: tables.Table
    settings: str
    stamp: str
    corrections: Mapping[str, tuple[Correction, ...]] = field(default_factory=dict)

    def texts(self) -> dict[str, str]:
        """The content of each of `SHARED_FILES`."""
        out = io.StringIO()
        csv.writer(out, delimiter=self.sheet.delimiter, lineterminator="\n").writerows(cells_of(self.sheet))
        return dict(zip(SHARED_FILES, (out.getvalue(), self.settings, corrections_text(self.corrections)), strict=True))


def open_draft(folder: Path) -> Draft:
    """Read the files of a folder, and add a row for every recording that has none."""
    if not folder.is_dir():
        message = "is a file, not a folder" if folder.exists() else "does not exist"
        raise _refusal(message, str(folder), "name the folder that holds the recordings")
    settings = read_settings_text(folder)
    recordings = list_recordings(folder) or list_tracks(folder)
    sheet = read_sheet(folder)
    if not recordings and not sheet.rows:
        remedy = (
            "put films (mp4, mov, avi, mkv), folders of pictures, or tables of positions (time_s, position_m) in it"
        )
        raise _refusal("holds no recording", str(folder), remedy)
    corrections, problems = read_corrections(folder)
    if problems:
        raise ExperimentError(problems)
    rows = with_recordings(sheet, recordings, shared_values(settings))
    return Draft(rows, settings, files_stamp(folder), corrections)


def files_stamp(folder: Path) -> str:
    """Return a fingerprint of the present files."""
    paths = [folder / name for name in SHARED_FILES]
    return hashlib.sha256(repr([path.is_file() and path.read_bytes() for path in paths]).encode()).hexdigest()


def write_draft(folder: Path, draft: Draft) -> list[str]:
    """Write the files that differ from the present ones; nothing else in the folder is changed."""
    if files_stamp(folder) != draft.stamp:
        name = SHEET if (folder / SHEET).exists() else SETTINGS
        message = "has changed since it was read, and is left as it is"
        raise _refusal(message, name, "reload the page, and enter it again")
    texts = draft.texts()
    changed = {
        SHEET: not (folder / SHEET).exists() or cells_of(read_sheet(folder)) != cells_of(draft.sheet),
        SETTINGS: not (folder / SETTINGS).exists() or read_settings_text(folder) != texts[SETTINGS],
        CORRECTIONS_FILE: corrections_text(read_corrections(folder)[0]) != texts[CORRECTIONS_FILE],
    }
    written = [name for name in SHARED_FILES if changed[name]]
    for name in written:
        tables.write_text(folder / name, texts[name])
    return written


@contextmanager
def draft_folder(folder: Path, draft: Draft) -> Iterator[Path]:
    """Make a temporary folder with this draft and links to everything else, for `check` and the tracker."""
    with tempfile.TemporaryDirectory(prefix="vinetrack-setup-") as temporary:
        copy = Path(temporary) / (folder.resolve().name or "experiment")
        copy.mkdir()
        for path in folder.iterdir():
            if path.name not in SHARED_FILES:
                (copy / path.name).symlink_to(os.path.realpath(path), target_is_directory=path.is_dir())
        for name, text in draft.texts().items():
            tables.write_text(copy / name, text)
        yield copy


# ------------------------------------------------------------------------------
# A block of text pasted into the table: split into cells, its header read, its rows matched by the names of the clips.
#
# Whatever matches nothing is named and changes nothing, so that no number stands beside another film than its own.

SHARED_ROW = "shared"  # The row of the table that applies to all trials


def read_block(text: str) -> list[list[str]]:
    """Split pasted text into rows of cells, at tabs, semicolons, commas or blanks, whichever it has first."""
    lines, decimal_comma = [line for line in text.splitlines() if line.strip()], re.compile(r"[+-]?\d+,\d+")
    if any("\t" in line for line in lines):
        delimiter = "\t"
    elif 2 * sum(";" in line for line in lines) > len(lines):  # one may stand in a remark
        delimiter = ";"
    elif any("," in decimal_comma.sub("", line) or line.count(",") > 1 for line in lines) or (
        # One comma in each line separates cells where blanks do not, and not all lines are numbers.
        all(line.count(",") == 1 for line in lines) and not all(decimal_comma.fullmatch(line.strip()) for line in lines)
    ):
        delimiter = ","
    else:
        wide = any(re.search(r"\S {2,}\S", line) for line in lines)
        lines = [re.sub(rf"(\d) ((?:{'|'.join(UNITS)})\b)", r"\1\2", line.strip()) for line in lines]
        rows = [re.split(r" {2,}" if wide else r"\s+", line) for line in lines]
        # A cell as long as its column has one blank behind it.
        words = map(str.split, lines)
        return [one if len(one) == len(rows[0]) else row for row, one in zip(rows, words, strict=True)]
    return [[cell.strip() for cell in row] for row in csv.reader(lines, delimiter=delimiter, skipinitialspace=True)]


def place_block(
    text: str,
    columns: Sequence[str],
    rows: Sequence[Mapping[str, str]],
    at_row: int | str,
    at_column: str,
    decimal: str = ".",
) -> tuple[list[tuple[int | str, str, str]], list[str]]:
    """Say which cells of a table with these columns (as shown, without the trial) and rows a pasted block changes, as
    (row of the sheet or `SHARED_ROW`, column, text), and what was left out, in sentences. Without a header its columns
    follow the one pasted into (none if that is blank), and without names its rows the row pasted into.
    """
    placed: list[tuple[int | str, str, str]] = []
    given: dict[str, list[tuple[int | str, str, str]]] = {}
    notes: list[str] = []
    words, row_named = _header_words(columns), _rows_by_name(rows)

    def column_named(word: str) -> str:
        plain = re.sub(r"[^a-z0-9%]+", "_", _in_ascii(word)).strip("_")
        inside = (known for known in words if len(known) > 2 and f"_{known}_" in f"_{plain}_")
        return words.get(plain) or words.get(max(inside, key=len, default=""), "")

    # Notes may have sentences above their table, which begins with its header or the line of the first recording: with
    # its name in a cell, for a sentence may have one too.
    lines = [line for line in text.splitlines() if line.strip()]
    named = [i for i, line in enumerate(lines) if any(f"_{name}_" in f"_{_plain(line)}_" for name in row_named)]
    cells_from = ((i, read_block("\n".join(lines[i:]))[0]) for i in named)
    in_cell = (i for i, cells in cells_from if any(_plain(cell) in row_named for cell in cells))
    table = next(in_cell, min(named, default=0))
    known = [sum(bool(column_named(word)) for word in re.split(r"[\s,;|]+", line)) for line in lines[:table]]
    # A header is the last line with two known words at least: a sentence above it may have more.
    table = max((i for i, count in enumerate(known) if count > 1), default=table)
    if table:
        notes.append(f"Left out, above the table: {' / '.join(lines[:table])}")
    block = read_block("\n".join(lines[table:]))
    first = block[0] if block else []
    header = [column_named(word) for word in first]
    if any(header) and not any(re.match(r"[-+]?\d", word) for word in first):
        if header.count("trial") > 1:  # beside another word for the recording, film is that of the vine
            film = words["thickness"]
            header = [film if word.lower() == "film" else name for word, name in zip(first, header, strict=True)]
        unknown = [word for word, name in zip(first, header, strict=True) if word and not name]
        notes += [f"No column is named “{word}”: left out; {did_you_mean(word, COLUMNS)}" for word in unknown]
        block = block[1:]
        name_place = header.index("trial") if "trial" in header else None
    else:
        # The column with most names of recordings
        wide = max(map(len, block), default=0)
        found = [sum(_plain(cells[i]) in row_named for cells in block if i < len(cells)) for i in range(wide)]
        name_place = found.index(max(found)) if any(found) else None
        if not at_column or (at_column not in columns and name_place is None):
            notes.append("No line of headings, such as “clip, pressure_psi, payload_g”: write one above the rows.")
            return placed, notes
        start = columns.index(at_column) if at_column in columns else 0
        places = [i for i in range(wide) if i != name_place]
        targets = dict(zip(places, columns[start:], strict=False))
        header = ["trial" if i == name_place else targets.get(i, "") for i in range(wide)]
        if len(places) > len(targets):
            notes.append(f"{len(places) - len(targets)} columns of this block lie beyond the table: left out.")
    following = iter([SHARED_ROW, *range(len(rows))][0 if at_row == SHARED_ROW else int(at_row) + 1 :])
    for cells in block:
        if name_place is None:
            row = next(following, None)
        else:
            row = row_named.get(_plain(cells[name_place])) if name_place < len(cells) else None
        if row is None:
            notes.append(f"No recording for “{' '.join(cells)}”: left out.")
            continue
        for name, cell in zip(header, cells, strict=False):
            if cell.strip("-–—") and name and name != "trial":  # a dash: none
                try:
                    given.setdefault(name, []).append((row, cell, value_and_unit(cell, name)[1]))
                except InputError as error:
                    notes.append(f"“{cell}” {error}: left out.")
    for name, of_name in given.items():
        # A number without a unit has that of the others; a column in which nothing stands takes it over.
        column, said = column_of(name, columns), {unit for _, _, unit in of_name if unit}
        name = f"{quantity(name)}_{said.pop()}" if len(said) == 1 else name
        column = column if any(row.get(column) for row in rows) else name
        placed += [(row, column, in_unit_of(column, name, cell, decimal)) for row, cell, _ in of_name]
    without = [row.get("trial", "") for i, row in enumerate(rows) if i not in {at for at, _, _ in placed}]
    if name_place is not None and placed and without:
        notes.append(f"No line for {', '.join(without)}: left as they are.")
    return [one for one in placed if one[0] == SHARED_ROW or rows[int(one[0])].get(one[1]) != one[2]], notes


def _header_words(columns: Sequence[str]) -> dict[str, str]:
    """The column that a word of a header names, in its unit if it has one; `trial` for names of recordings."""
    words: dict[str, str] = {}
    for name in (*COLUMNS, *columns):
        words |= {written.lower(): written for written in (*other_units(name), name)} | {quantity(name).lower(): name}
    short = {"film": "thickness", "wall": "thickness", "p": "pressure", "dia": "diameter", "l": "length"}
    short |= {"d": "diameter", "load": "payload"}
    words |= {
        word.replace(name, other, 1): column
        for other, name in short.items()
        for word, column in list(words.items())
        if word == name or word.startswith(f"{name}_")
    }
    words |= {unit: column for unit in ("psi", "kpa", "bar") if (column := words.get(f"pressure_{unit}"))}
    names = "trial video clip film recording file file_name filename name movie"
    return words | dict.fromkeys(names.split(), "trial")


def _rows_by_name(rows: Sequence[Mapping[str, str]]) -> dict[str, int]:
    """The row of each name of a trial or recording, with or without folder and ending; none for a name of two."""
    places: dict[str, set[int]] = {}
    for i, row in enumerate(rows):
        for given in filter(None, (row.get("trial"), row.get("video"), row.get("track"))):
            path = PurePosixPath(given)
            for text in (given, path.name, path.stem, str(path.parent / path.stem)):
                places.setdefault(_plain(text), set()).add(i)
    return {name: of_name.pop() for name, of_name in places.items() if name and len(of_name) == 1}


def _plain(name: str) -> str:
    return re.sub(r"[^a-z0-9./-]+", "_", name.lower()).strip("_")


def _in_ascii(word: str) -> str:
    """A word in lower case, with a u for either of the two characters for micro."""
    return word.lower().replace("µ", "u").replace("μ", "u")


# ------------------------------------------------------------------------------
# What a folder holds, and the columns that names of recordings give: `d12_24kPa_1` is a vine of 12 mm at 24 kPa.

# By quantity, the letters that may stand before its number, and the units that name it without them
_IN_NAMES = {
    "pressure": ("p", "kPa psi mbar bar"),
    "payload": ("m", "g kg"),
    "diameter": ("d dia diam", "mm in"),
    "thickness": ("t", "um"),
    "length": ("l len", "cm"),
    "capture": ("", "fps"),
    "growth_angle": ("", "deg"),
    "day": ("day", ""),
    "specimen": ("specimen tube", ""),
}
_UNITS = {unit.lower(): name for name, (_, units) in _IN_NAMES.items() for unit in units.split()}


def list_pictures(folder: Path) -> list[str]:
    """Return single pictures and films that may show a ruler or a board, as paths relative to the folder."""
    pictures = [path for path in entries(folder) if path.is_file() and path.suffix.lower() in IMAGES]
    pictures = pictures if len(pictures) < FEWEST_POINTS else []
    for sub in entries(folder):
        if sub.is_dir() and is_calibration(sub):
            pictures += [path for path in entries(sub) if path.suffix.lower() in IMAGES | CONTAINERS]
    return sorted((path.relative_to(folder).as_posix() for path in pictures), key=natural_order)


TABLES = (".csv", ".txt", ".tsv", ".trk")  # Endings of files that may be tracks


def list_tables(folder: Path, suffixes: Sequence[str] = (".csv",)) -> list[str]:
    """Return files with these endings, such as pressure traces, as paths relative to the folder."""
    folders = [folder, *(path for path in entries(folder) if path.is_dir() and not (path / tables.PROVENANCE).exists())]
    found = [path for place in folders for path in entries(place) if path.suffix.lower() in suffixes]
    names = (path.relative_to(folder).as_posix() for path in found)
    return sorted((name for name in names if name not in SHARED_FILES), key=natural_order)


def list_tracks(folder: Path) -> list[str]:
    """Return files of positions measured elsewhere, whatever rate and scale they leave open."""
    found = []
    for name in list_tables(folder, TABLES):
        with suppress(InputError):
            read_track(folder / name, capture_fps=1.0, m_per_px=1e-3)
            found.append(name)
    return found


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
    """The cells of a trial sheet by the names of recordings. Only numbers with a letter or a unit are read: a bare one
    counts replicates. A unit that all names give a quantity is kept; a mixture is converted to that of the sheet.
    """
    found = [_cells_of_name(recording) for recording in recordings]
    columns: dict[str, str] = {}
    for cells in found:
        for name, (column, _) in cells.items():
            columns[name] = column if columns.get(name, column) == column else column_of(name, COLUMNS)
    return [
        {columns[name]: in_unit_of(columns[name], column, cell) for name, (column, cell) in cells.items()}
        for cells in found
    ]


def _cells_of_name(recording: str) -> dict[str, tuple[str, str]]:
    """The column, in whichever unit, and the cell of each quantity in a name; a file overrides its folders."""
    cells: dict[str, tuple[str, str]] = {}
    of_letters = {letter: name for name, (letters, _) in _IN_NAMES.items() for letter in letters.split()}
    number_form = r"\d+(?:[.p]\d+)?"
    spaced_unit = rf"(?<![a-z0-9])({number_form})[_\s]+({'|'.join(_UNITS)})(?![a-z0-9])"  # such as `24 kPa`
    for part in (*PurePosixPath(recording).parts[:-1], _stem(recording)):
        of_part: dict[str, tuple[str, str]] = {}
        for word in re.split(r"[_\s,;+-]+", re.sub(spaced_unit, r"\1\2", _in_ascii(part))):
            if match := re.fullmatch(rf"([a-z]*?)({number_form})([a-z]*)", word):
                letters, number, unit = match.groups()
                name = of_letters.get(letters, "") if letters else _UNITS.get(unit, "")
                # In names of vines such as 12mm-100um-140mm the second length is that of the vine.
                name = "length" if name == "diameter" and not letters and name in of_part else name
                own = column_of(name, COLUMNS)
                column = next((other for other in (own, *other_units(own)) if other.lower() == f"{name}_{unit}"), "")
                # After a letter, one digit counts trials or takes: `t1` is no thickness.
                if name and (column or not unit) and (unit or len(letters) != 1 or len(number) > 1):
                    cell = number.replace("p", ".")
                    of_part[name] = column or own, f"{float(cell):g}" if COLUMNS[own].kind == "number" else cell
        cells |= of_part
    return cells


def _stem(recording: str) -> str:
    path = PurePosixPath(recording)
    return path.stem if path.suffix.lower() in {*CONTAINERS, *IMAGES, *TABLES} else path.name


def _clean(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9_-]+", "_", name).strip("_") or "trial"


# ------------------------------------------------------------------------------
# Edits of `experiment.yaml` that keep everything else as it is, comments included.


def save_model(folder: Path, names: Sequence[str], files: Sequence[str] = ()) -> Path:
    """Set `model:` in `experiment.yaml`, byte-order mark and line ends kept, and extend `effects:`; return the path."""
    path, mark = folder / SETTINGS, b"\xef\xbb\xbf"
    before = path.read_bytes() if path.exists() else b""
    text = tables.read_text(path) if before else ""
    listed = list(read_experiment_settings(path).effects)
    if new := [name for name in files if name not in listed]:
        text = with_value(text, "effects", [*listed, *new], path.name)
    text = with_value(text, "model", names, path.name)
    if b"\r\n" in before:
        text = text.replace("\n", "\r\n")
    tables.write_bytes(path, (mark if before.startswith(mark) else b"") + text.encode("utf-8"))
    return path


def with_value(text: str, key: str, value: Any, file: str = SETTINGS) -> str:
    """Return the text with a top-level key set to a value; everything else is kept, comments included."""
    from ruamel.yaml import YAML
    from ruamel.yaml.util import load_yaml_guess_indent

    before, value = tables.parse_yaml(text, file).content, json.loads(json.dumps(value))
    if key in before and before[key] == value:
        return text
    document, out = YAML(), io.StringIO()
    document.preserve_quotes, document.width = True, 10_000
    if before:
        tree, indent, offset = load_yaml_guess_indent(text)
        tree[key] = _edited(tree.get(key), value)
        if indent is not None and offset is not None:
            document.indent(mapping=2, sequence=indent, offset=offset)
        document.dump(tree, out)
        comments = [line for line in text.splitlines() if line.strip().startswith("#")]
        lost = [line for line in comments if line.strip() not in out.getvalue()]
        changed = out.getvalue() + "".join(f"{line}\n" for line in lost)  # comments below a block that is gone
    else:
        document.dump({key: _edited(None, value)}, out)
        changed = text + ("\n" if text and not text.endswith("\n") else "") + out.getvalue()
    with suppress(ExperimentError):
        if tables.parse_yaml(changed, file).content == {**before, key: value}:
            return changed
    message, remedy = "cannot be changed without altering other settings", f"set it by hand: {key}: {value}"
    raise ExperimentError([Problem(message=message, file=file, column=key, remedy=remedy)])


def _edited(old: Any, value: Any) -> Any:
    """Return a value in the form of the one it replaces, so that comments stay at what is kept."""
    from ruamel.yaml.comments import CommentedMap, CommentedSeq

    if isinstance(value, dict):
        tree = old if isinstance(old, CommentedMap) else CommentedMap()
        for name in tree.keys() - value.keys():
            del tree[name]
        for name, inner in value.items():
            if name not in tree or tree[name] != inner:
                tree[name] = _edited(tree.get(name), inner)
        return tree
    if isinstance(value, list):
        elements = old if isinstance(old, CommentedSeq) else CommentedSeq()
        if elements is not old:
            elements.fa.set_flow_style()
        for i in reversed(range(len(elements))):
            if elements[i] not in value:
                del elements[i]
        if elements != value[: len(elements)]:
            elements.clear()
        elements.extend(_edited(None, element) for element in value[len(elements) :])
        return elements
    return value
