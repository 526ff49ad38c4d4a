"""Reading of CSV files in any dialect that Excel writes, and atomic writing of files.

Reading accepts comma, semicolon or tab; decimal points or commas; UTF-8 with or without BOM, UTF-16 (Excel's "Unicode
text") and cp1252; any line ends. Cells stay text, so that messages can quote them; `parse_number` and `Table.numbers`
convert strictly. A file is written under a temporary name and renamed, so that it is complete or absent.
"""

from __future__ import annotations

import codecs
import contextlib
import csv
import errno
import io
import json
import math
import os
import posixpath
import re
import unicodedata
import uuid
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter
from pydantic_core import to_jsonable_python

from vinetrack.core.problems import ExperimentError, InputError, Problem

if TYPE_CHECKING:
    import pandas as pd


# ------------------------------------------------------------------------------
# Checks of files before they are opened: only regular files are, since reading a pipe would block.

# Message for a folder, a FIFO, a socket, a terminal or a device such as `/dev/zero`
NOT_A_FILE = "it is a folder, a pipe or a device, not a file; put the file itself there, or a link to it"


def missing_file_message(path: Path) -> tuple[str, str]:
    """Return message and remedy for a missing file; a broken link, as to an unmounted disk, is named as such."""
    if path.is_symlink():
        remedy = "connect the disk it points to, or copy the file itself there"
        return "is a link to something that does not exist", remedy
    return "does not exist", "check the path and its upper and lower case"


def file_size(path: Path) -> int:
    """Return the size of a readable regular file."""
    size = path.stat().st_size
    if not path.is_file():
        raise OSError(errno.EINVAL, NOT_A_FILE, str(path))
    if not os.access(path, os.R_OK):
        raise PermissionError(errno.EACCES, "permission denied; allow it to be read", str(path))
    return size


def is_disk_full(error: BaseException) -> bool:
    """Whether an error means that the disk is full, or a quota exhausted."""
    return isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT)


# ------------------------------------------------------------------------------
# Reading and writing of tables and text.

PROVENANCE = "provenance.json"  # Its presence marks a results folder

STANDARD_OUTPUT = Path("-")  # convention of commands: this name means standard output

_NUMBER = re.compile(r"[+-]?(?:\d+(?:[.,]\d*)?|[.,]\d+)(?:[eE][+-]?\d+)?", re.ASCII)
_AMBIGUOUS_NUMBER = re.compile(r"[+-]?[1-9]\d{0,2}[.,]\d{3}", re.ASCII)  # Such as 1,069 or 1.069


@dataclass(frozen=True)
class Table:
    """Cells of a CSV file as stripped text. `rows[i]` maps each column to its cell ("" if blank, or if the line is
    short); `lines[i]` is its line in the file, from 1; `extra[i]`: cells beyond the last column, blank ones only where
    a row has none; `nameless`: a column without a name has content; `units`: of columns in another unit.
    """

    columns: tuple[str, ...]
    rows: tuple[dict[str, str], ...]
    lines: tuple[int, ...]
    extra: tuple[tuple[str, ...], ...]
    delimiter: str
    decimal: str
    nameless: bool = False
    units: Mapping[str, str] = field(default_factory=dict)

    def numbers(self, column: str, *, blank_is_nan: bool = False) -> NDArray[np.float64]:
        """Return a column as numbers; blank cells are NaN if `blank_is_nan`, else an error. Shape (n_rows,)."""
        values = np.full(len(self.rows), np.nan)
        for i, cell in enumerate(row[column] for row in self.rows):
            if cell or not blank_is_nan:
                try:
                    values[i] = parse_number(cell, self.decimal)
                except InputError as error:
                    message = f"line {self.lines[i]}, column {column}: {cell[:40]!r} {error.message}"
                    raise InputError(message, error.remedy) from None
        return values


def parse_number(text: str, decimal: str = ".") -> float:
    """Read one number strictly: ASCII digits, at most one decimal mark (point or comma), an exponent, nothing else."""
    text = text.strip()
    if text == "":
        raise InputError("is blank", "write a number", code="blank")
    if not _NUMBER.fullmatch(text):
        raise InputError("is not a number", "write digits only, without separators", code="not_a_number")
    if _AMBIGUOUS_NUMBER.fullmatch(text) and ("," if "," in text else ".") != decimal:
        remedy = f"write {text.replace(',', '.')}0 or {re.sub('[.,]', '', text)}, whichever is meant"
        raise InputError("may be thousands or decimals", remedy, code="ambiguous_number")
    value = float(text.replace(",", "."))
    if not math.isfinite(value):
        raise InputError("is too large a number", code="above_bounds")
    return value


def read_bytes(path: Path, most: int = 200_000_000) -> bytes:
    """Read a file that is no recording, of so many bytes at most (chosen)."""
    try:
        if file_size(path) <= most:
            return path.read_bytes()
    except FileNotFoundError:
        raise InputError(*missing_file_message(path)) from None
    except (OSError, ValueError) as error:
        raise InputError("cannot be read", getattr(error, "strerror", None) or "it cannot be opened") from None
    raise InputError("is too large to be a table", "is it a recording?")


def read_text(path: Path) -> str:
    r"""Read a text file in UTF-8 or UTF-16 with BOM, UTF-8 without, or else cp1252; line ends become `\n`."""
    data = read_bytes(path)
    is_wide = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    for encoding in ("utf-16",) if is_wide else ("utf-8-sig", "cp1252"):
        with contextlib.suppress(UnicodeDecodeError):
            if "\x00" not in (text := data.decode(encoding)):
                return text.replace("\r\n", "\n").replace("\r", "\n")
    raise InputError("is not text", "save the table as CSV in UTF-8")


def read_table(path: Path) -> Table:
    """Read a CSV file whose first line (after blank ones) is the header."""
    return parse_table(read_text(path))


def parse_table(text: str, skip_lines: int = 0) -> Table:
    r"""Read the text of a CSV file."""
    lines = text.split("\n")[skip_lines:]
    if lines and (match := re.fullmatch(r'"?sep=(.)"?[;,\t]*', lines[0].strip("\ufeff "))):
        delimiter, lines, skip_lines = match[1], lines[1:], skip_lines + 1
    else:
        # The separator that splits the header into most cells; headers contain no decimal commas.
        header = re.sub(r'"[^"]*"', "", next((line for line in lines if line.strip()), ""))
        delimiter = max("\t;,", key=header.count) if re.search("[\t;,]", header) else ","
    content = io.StringIO("\n".join(lines), newline="")
    reader = csv.reader(content, delimiter=delimiter, skipinitialspace=True, strict=True)
    records, start = [], 1
    try:
        for read in reader:
            if any(cells := [cell.strip() for cell in read]):
                records.append((start, cells))
            start = reader.line_num + 1
    except csv.Error as error:
        raise InputError(f"is not a table (line {start}: {error})", "remove or close quotation marks") from None
    if not records:
        raise InputError("is empty", "its first line must name the columns")
    (_, columns), *body = records
    named, width = tuple(filter(None, columns)), len(columns)
    if repeated := sorted({column for column in named if named.count(column) > 1}):
        raise InputError(f"names the column {repeated[0]!r} twice", "keep one of them")
    every = max(width, min((len(cells) for _, cells in body), default=width))  # a separator at the end of each line
    pairs = [list(zip_longest(columns, cells[:width], fillvalue="")) for _, cells in body]
    return Table(
        columns=named,
        rows=tuple({name: cell for name, cell in row if name} for row in pairs),
        lines=tuple(line + skip_lines for line, _ in body),
        extra=tuple(tuple(cells[width:]) if len(cells) > every or any(cells[width:]) else () for _, cells in body),
        delimiter=delimiter,
        decimal=_find_decimal([cell for _, cells in body for cell in cells], delimiter),
        nameless=any(cell and not name for row in pairs for name, cell in row),
    )


def _find_decimal(cells: list[str], delimiter: str) -> str:
    """Return the decimal mark: that of the unambiguous numbers; without any, that which the separator suggests."""
    if not any("," in cell for cell in cells):
        return "."
    numbers = [cell for cell in cells if ("," in cell or "." in cell) and _NUMBER.fullmatch(cell)]
    clear = [cell for cell in numbers if not _AMBIGUOUS_NUMBER.fullmatch(cell)]
    marks = {"," if "," in cell else "." for cell in clear or (numbers if delimiter == ";" else ())}
    return "" if len(marks) == 2 else marks.pop() if marks else "."


def safe_join(folder: Path, relative: str) -> Path:
    """Path of a file inside `folder`, backslashes as slashes; its text is checked: a link may lead outside."""
    text = relative.strip().replace("\\", "/")
    inside = posixpath.normpath(text)
    # Control characters, surrogates, line and paragraph separators; unusual spaces are allowed: macOS writes them.
    is_forged = any(unicodedata.category(char) in ("Cc", "Cs", "Zl", "Zp") for char in text)
    if is_forged or re.match(r"/|[A-Za-z]:", text) or inside.split("/")[0] in ("..", "."):
        remedy = "write it relative to the folder; a file outside is reached by a link in it"
        raise InputError("is no path inside the experiment folder", remedy)
    return folder / inside


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; on success it is renamed to `path`, otherwise deleted."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".tmp-{uuid.uuid4().hex}{path.suffix}")
    try:
        yield temporary
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def write_bytes(path: Path, data: bytes) -> None:
    """Write a file atomically."""
    with replacing(path) as temporary:
        temporary.write_bytes(data)


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically, in UTF-8, without changing line ends."""
    write_bytes(path, text.encode("utf-8"))


def write_csv(path: Path, frame: pd.DataFrame) -> None:
    """Write a table atomically as CSV: all digits, `NaN` for missing numbers, blank for missing text."""
    text_columns = frame.columns[[dtype.kind not in "fiub" for dtype in frame.dtypes]]
    filled = frame.astype(dict.fromkeys(text_columns, object)).fillna(dict.fromkeys(text_columns, ""))
    write_text(path, filled.to_csv(index=False, na_rep="NaN", lineterminator="\n"))


def write_json(path: Path, content: Any) -> None:
    """Write JSON with NaN and infinities as `null`, arrays as lists and paths as text."""
    plain = to_jsonable_python(content, inf_nan_mode="null", fallback=lambda array: array.tolist())
    text = json.dumps(plain, indent=2, ensure_ascii=False, allow_nan=False)
    print(text) if path == STANDARD_OUTPUT else write_text(path, text + "\n")


_adapter: Any = cache(TypeAdapter)


class JsonRecord:
    """A dataclass that a JSON file holds, each field under its name or its alias; absent keys take their defaults."""

    def to_json(self) -> dict[str, Any]:
        """As the file holds it."""
        return dict(_adapter(type(self)).dump_python(self, by_alias=True, warnings=False))

    @classmethod
    def from_json(cls, entry: Mapping[str, Any]) -> Self:
        """Read what `to_json` wrote."""
        return cast(Self, _adapter(cls).validate_python(entry))


# ------------------------------------------------------------------------------
# Reading YAML: repeated keys are errors, 10:20 is text.


@dataclass
class YamlDocument:
    """Content of a YAML file and its text."""

    content: Any
    text: str = ""

    def line(self, path: Sequence[Any]) -> int:
        """The line, from 1, of the last key of a path that begins a line; 0 if none does."""
        lines, found = self.text.split("\n"), 0
        for key in path:
            pattern = re.compile(rf"""\s*["']?{re.escape(str(key))}["']?\s*:""")
            found = next((n for n in range(found, len(lines)) if pattern.match(lines[n])), found - 1) + 1
        return found


def read_yaml(path: Path) -> YamlDocument:
    """Read a YAML file that holds one mapping; an empty file is an empty mapping."""
    try:
        return parse_yaml(read_text(path), path.name)
    except InputError as error:
        raise ExperimentError([Problem.from_error(error, path.name)]) from None


def parse_yaml(text: str, file: str) -> YamlDocument:
    """Parse YAML text; see `read_yaml`."""
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    try:
        content = YAML(typ="safe", pure=True).load(text)
    except (YAMLError, RecursionError, ValueError, ArithmeticError, TypeError, LookupError, AttributeError) as error:
        reason = getattr(error, "problem", None) or "it cannot be understood"
        mark = getattr(error, "problem_mark", None)
        place: dict[str, Any] = {"file": file, "line": mark.line + 1 if mark is not None else 0}
        if twice := re.match('found duplicate key "(.*?)"', reason):
            raise ExperimentError([Problem("", "is set twice", twice[1], remedy="keep one", **place)]) from None
        remedy = "use spaces (no tabs) to indent, a space after each colon, and quotes around text that contains : or #"
        raise ExperimentError([Problem(message=f"is not YAML ({reason})", remedy=remedy, **place)]) from None
    if not isinstance(content, dict | None):
        remedy = "write lines such as 'key: value'"
        raise ExperimentError([Problem(message="holds no settings", file=file, remedy=remedy)])
    return YamlDocument(content or {}, text)
