"""Reading and checking of single values of the trial sheet.

A cell of `trials.csv` and a value of `experiment.yaml` pass the same checks and get the same remedies. Values stay in
the unit of their column until `vinetrack.experiment.sheet.make_trial` converts them to SI.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

from vinetrack.core.records import Bend, PictureAxis
from vinetrack.core.tables import TableError, parse_number
from vinetrack.core.units import UNITS, convert, split_unit
from vinetrack.experiment.column import Column

Value = float | bool | str | tuple[float, float] | tuple[Bend, ...] | PictureAxis

SHORTEST_AXIS_PX = 10  # Chosen: the direction of a shorter axis is too uncertain
SMALLEST_POINT_SPACING_PX = 2  # Smallest distance between neighbouring points of a curved path (chosen)

TRUTH_WORDS = {"yes": True, "y": True, "true": True, "1": True, "no": False, "n": False, "false": False, "0": False}


class CellError(ValueError):
    """A value that its column does not allow: what is wrong (`message`), what is allowed, and the remedy."""

    def __init__(self, message: str, allowed: str = "", remedy: str = "") -> None:
        super().__init__(message)
        self.message, self.allowed, self.remedy = message, allowed, remedy


def read_cell(column: Column, text: str, decimal: str = ".") -> Value:
    """Return the value of a non-blank cell, in the unit of its column."""
    if column.kind == "yes_no":
        if text.lower() not in TRUTH_WORDS:
            raise CellError("is neither yes nor no", "yes or no")
        return TRUTH_WORDS[text.lower()]
    if column.kind == "window":
        return _read_window(text, decimal)
    if column.kind == "bends":
        return _read_bends(text, decimal)
    if column.kind == "axis":
        return _read_axis(text)
    if column.kind == "frames":
        return _read_frames(text)
    if column.kind in ("text", "path"):
        return text
    return _check_number(column, _number(text, decimal, column.allowed))


def read_range(column: Column, value: Any) -> tuple[float, float]:
    """Read the two ends of a range, `low:high` or two numbers, each checked like a cell of the column. Returns low and
    high, in the unit of the column.
    """
    parts = value.split(":") if isinstance(value, str) else value
    if not isinstance(parts, list | tuple) or len(parts) != 2:
        raise ValueError("is not a range: write low:high, such as 7:40")
    low, high = (read_limit(column, part) for part in parts)
    if low > high:
        raise ValueError("ends below its start: write the lower value first")
    return low, high


def interior_values(low: float, high: float) -> list[float]:
    """Return three values between two others, in geometric steps where `low` is positive, else in equal steps."""
    parts = (0.25, 0.5, 0.75)
    return [low ** (1 - part) * high**part if low > 0 else low + (high - low) * part for part in parts]


def read_limit(column: Column, value: Any) -> float:
    """Read one number of `limits`, checked like a cell of the column."""
    if isinstance(value, bool | list | tuple | dict):
        raise ValueError("holds something that is not a number: write numbers only")
    return float(str(read_value(column, value)))


def read_value(column: Column, value: Any) -> Any:
    """Read a value of the settings like a cell of the sheet's column of the same name."""
    try:
        return read_cell(column, str(value).strip())
    except CellError as error:
        remedy = error.remedy or (f"allowed is {error.allowed}" if error.allowed else "")
        raise ValueError(f"{error.message}: {remedy}") from None


def _check_number(column: Column, value: float) -> float:
    """Return the value unchanged if its column allows it; raise a CellError otherwise."""
    if column.kind == "choice":
        if value not in (column.low, column.high):
            raise CellError("is not a travel ratio", "2 for eversion, 1 for a body that moves as a whole")
    elif value > column.high:
        raise CellError(f"is above {column.high:g} {column.unit}", column.allowed, _likely_unit(column, value))
    elif value < column.low or (column.above_low and value == column.low):
        relation = "is not above" if column.above_low else "is below"
        raise CellError(f"{relation} {column.low:g} {column.unit}".strip(), column.allowed, _likely_unit(column, value))
    return value


def unusual_value_hint(column: Column, value: float) -> str:
    """Return the column's hint if an allowed value lies outside the usual range; zero is deliberate, hence usual."""
    return "" if value == 0 or column.usual[0] <= value <= column.usual[1] else column.unusual_hint


def _likely_unit(column: Column, value: float) -> str:
    """Name the unit in which the value was probably written, if the column would allow it in that unit."""
    unit_of_column = column.unit_key or split_unit(column.name)[1]
    for key in column.slips:
        unit, factor = UNITS[key].text, convert(1.0, key, unit_of_column)
        meant = value * factor
        # The intended unit must bring the value into range: enlarge one that is too small, shrink one that is too
        # large.
        if (factor > 1) == (value < column.high) and max(column.low, 1e-9) <= meant <= column.high:
            return f"looks like {unit}: {value:g} {unit} is {meant:g} {column.unit}"
    return ""


def _number(text: str, decimal: str, allowed: str = "") -> float:
    try:
        return parse_number(text, decimal)
    except TableError as error:
        message, _, remedy = str(error).partition(": ")
        raise CellError(message, allowed, remedy) from None


def _read_window(text: str, decimal: str) -> tuple[float, float]:
    """Read a time window `from_s:to_s`."""
    allowed = "from_s:to_s, such as 0.05:0.20"
    parts = text.split(":")
    if len(parts) != 2:
        raise CellError("is not a window", allowed)
    start, end = (_number(part, decimal, allowed) for part in parts)
    if start >= end:
        raise CellError("ends before it starts", allowed)
    return start, end


def _read_axis(text: str) -> PictureAxis:
    """Read an axis `x,y:x,y…[:width_mm]`: two or more points in the picture, and the width of the strip along them."""
    allowed = (
        "x,y:x,y or x,y:x,y:width_mm, such as 161,40:151,799:20, with more points where the path bends; "
        "in a comma-separated sheet the cell must be in quotes"
    )
    parts, width = text.split(":"), math.nan
    written = parts if "," in parts[-1] else parts[:-1]
    if len(written) < 2 or any(point.count(",") != 1 for point in written):
        raise CellError("is not an axis", allowed)
    points = [(_number(x, ".", allowed), _number(y, ".", allowed)) for x, y in (point.split(",") for point in written)]
    if sum(math.dist(*pair) for pair in pairwise(points)) < SHORTEST_AXIS_PX:
        raise CellError(f"is shorter than {SHORTEST_AXIS_PX} pixels", allowed, "give two points far apart")
    if len(points) > 2 and min(math.dist(*pair) for pair in pairwise(points)) < SMALLEST_POINT_SPACING_PX:
        message = f"has neighbouring points less than {SMALLEST_POINT_SPACING_PX} pixels apart"
        raise CellError(message, allowed, "leave out the second of the two")
    if len(parts) > len(written):
        width = _number(parts[-1], ".", allowed) / 1000
        if width <= 0:
            raise CellError("has a width that is not positive", allowed)
    return PictureAxis(points[0], points[-1], width, tuple(points[1:-1]))


def _read_frames(text: str) -> tuple[int, int]:
    """Read a range of frames `from:to`, counted from 0, both ends included."""
    allowed = "from:to, such as 12:80"
    parts = [part.strip() for part in text.split(":")]
    if len(parts) != 2 or not all(part.isascii() and part.isdigit() for part in parts):
        raise CellError("is not a range of frames", allowed)
    first, last = int(parts[0]), int(parts[1])
    if first >= last:
        raise CellError("ends before it starts", allowed)
    return first, last


def _read_bends(text: str, decimal: str) -> tuple[Bend, ...]:
    """Read bends `start_mm:arc_mm:radius_mm;…`; the result is in metres."""
    allowed = "start_mm:arc_mm:radius_mm, several joined by ;"
    bends = []
    for piece in filter(None, (piece.strip() for piece in text.split(";"))):
        parts = piece.split(":")
        if len(parts) != 3:
            raise CellError(f"has a bend {piece!r} that is not three numbers", allowed)
        start, arc, radius = (_number(part, decimal, allowed) / 1000 for part in parts)
        if start < 0 or arc <= 0 or radius <= 0:
            raise CellError(f"has a bend {piece!r} with a length that is not positive", allowed)
        bends.append(Bend(start, arc, radius))
    return tuple(bends)
