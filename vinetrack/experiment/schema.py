"""Columns of the trial sheet: their table, the reading of single values, and the names of vines and conditions.

`columns.csv` beside this file declares every column, a line each: the field of `Trial` that holds it, its kind, unit,
bounds, meaning. It rules the reading of `trials.csv` (`folder`), the settings of the same name in `experiment.yaml` and
its `limits` (`settings`), the options of `vinetrack predict` and `design`, the inputs that an effect may require, and
the output of `vinetrack settings`.

Imports stay light: the command line loads this module at every start.
"""

from __future__ import annotations

import csv
import difflib
import math
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from vinetrack.core.problems import InputError, joined
from vinetrack.core.records import Bend, PictureAxis, Trial
from vinetrack.core.tables import parse_number, safe_join
from vinetrack.core.units import UNITS, Unit, convert, split_unit


@dataclass(frozen=True, kw_only=True)
class Column:
    """A column of the trial sheet. `field` is the field of `Trial` that holds the value, in SI where it is a number;
    `measured` says how to measure it, `default` what a blank cell stands for, `if_blank` what that does to results,
    `slips` the units in which it may have been written by mistake. `limit` is the form of a constraint on further
    trials; `condition_part` shows the value in the name of a condition.
    """

    name: str
    field: str
    kind: str
    unit_key: str
    scale: Unit
    low: float
    high: float
    above_low: bool
    slips: tuple[str, ...]
    usual_from: float
    allowed_text: str
    shared: bool
    limit: str
    condition_part: str
    default: str
    if_blank: str
    meaning: str
    measured: str

    @property
    def unit(self) -> str:
        """The unit as it is printed; blank if there is none."""
        return self.scale.text

    @property
    def bounds(self) -> str:
        """The allowed values, in words, without the unit."""
        above = "above " if self.above_low else "at least " if math.isinf(self.high) else ""
        return self.allowed_text or f"{above}{self.low:g}" + ("" if math.isinf(self.high) else f" to {self.high:g}")

    @property
    def allowed(self) -> str:
        """The allowed values, in words."""
        return f"{self.bounds} {self.unit}".rstrip()

    @property
    def quantity(self) -> str:
        """The name without its unit, in words."""
        return split_unit(self.name)[0].replace("_", " ")

    def in_words(self, value: float) -> str:
        """Return a value as a phrase for a sentence: `a chamber of 3.7 litres`."""
        return f"{'an' if self.quantity[0] in 'aeiou' else 'a'} {self.quantity} of {value:.3g} {self.unit}".rstrip()

    def in_trial(self, value: Any, folder: Path) -> Any:
        """Return a value as a trial holds it: numbers in SI, files in their folder."""
        if self.kind in ("number", "choice"):
            return self.scale.to_si(float(value))
        return safe_join(folder, value) if self.kind == "path" else value

    def of_trial(self, trial: Trial) -> float:
        """Return a trial's value of this column."""
        return self.scale.from_si(float(getattr(trial, self.field)))

    def read(self, text: str, decimal: str = ".", written_in: str = "") -> Any:
        """Return the value of a non-blank cell, in the unit of its column; it was written in another, or in its own."""
        try:
            match self.kind:
                case "text":
                    return text
                case "path":
                    safe_join(Path(), text)
                    return text
                case "yes_no":
                    if text.lower() not in ("yes", "y", "true", "1", "no", "n", "false", "0"):
                        raise InputError("is neither yes nor no", code="not_yes_or_no")
                    return text.lower() in ("yes", "y", "true", "1")
                case "window" | "frames":
                    return _read_span(text, decimal, of_frames=self.kind == "frames")
                case "bends":
                    return _read_bends(text, decimal)
                case "axis":
                    return _read_axis(text)
            number, unit = value_and_unit(text, self.name)
            value = parse_number(number, decimal)
            value = convert(value, unit, self.unit_key) if unit else value
            if self.kind == "choice" and value not in (1, 2):
                raise InputError("is not a travel ratio", code="not_a_choice")
            if (above := value > self.high) or value < self.low or (self.above_low and value == self.low):
                code, bound = ("above", self.high) if above else ("below", self.low)
                message = f"is {'not above' if self.above_low and not above else code} {bound:g} {self.unit}".rstrip()
                raise InputError(message, self._likely_units(value, unit or written_in), code=f"{code}_bounds")
            return value
        except InputError as error:
            error.allowed = self.allowed
            raise

    def read_key(self, value: Any) -> Any:
        """Read a value of a settings file like a cell of the column."""
        if isinstance(value, bool | list | tuple | dict):
            raise InputError("is not a single value", "write one, as in the sheet", code="not_a_value")
        return self.read(str(value).strip())

    def unusual(self, value: Any, written_in: str = "") -> str:
        """Say so if an allowed number lies below the usual range; zero is deliberate, hence usual."""
        if self.kind != "number" or not value or value >= self.usual_from:
            return ""
        return f"is unusual, below {self.usual_from:g}: {self._likely_units(value, written_in) or self.meaning}"

    def _likely_units(self, value: float, written_in: str) -> str:
        """Ask for the units in which the number as it was written would be a usual one of this column."""
        told, least, written_in = [], max(self.low, self.usual_from, 1e-9), written_in or self.unit_key
        for key in self.slips:
            typed = convert(value, self.unit_key, written_in)
            if key != written_in and least <= convert(typed, key, self.unit_key) <= self.high:
                meant = f"{convert(typed, key, written_in):.4g} {UNITS[written_in].text}"
                told.append(f"{typed:g} {UNITS[key].text} ({meant})")
        return f"is it {joined(told, 'or')}?" if told else ""


def _read_columns() -> dict[str, Column]:
    with Path(__file__).with_name("columns.csv").open(encoding="utf-8", newline="") as file:
        rows: list[dict[str, Any]] = list(csv.DictReader(file))
    for row in rows:
        row |= {"scale": UNITS.get(row["unit_key"], Unit("", "")), "slips": tuple(row["slips"].split())}
        row |= {"shared": row["shared"] == "yes", "above_low": row["low"].startswith(">")}
        row |= {"low": float(row["low"].lstrip(">") or -math.inf), "high": float(row["high"] or math.inf)}
        row["usual_from"] = float(row["usual_from"] or -math.inf)
    return {row["name"]: Column(**row) for row in rows}


COLUMNS = _read_columns()  # Every column of `trials.csv` by name, in the order of the documentation

# Columns that `experiment.yaml` may set for all trials
SHARED = tuple(name for name, column in COLUMNS.items() if column.shared)

# Columns that `limits` of `experiment.yaml` may constrain for further trials, by the form of the constraint
LIMITED = {kind: tuple(name for name in COLUMNS if COLUMNS[name].limit == kind) for kind in ("range", "choice")}

# Columns of the rig, in which a further trial of the same vine may differ, with their fields of a trial
RIG = {name: column.field for name, column in COLUMNS.items() if column.limit and column.condition_part}

# Columns that sort trials into groups: specimens, days
GROUPINGS = tuple(name for name, column in COLUMNS.items() if column.kind == "text" and column.shared)


def option(column: str) -> str:
    """Return the command-line option for a column of the sheet."""
    return "--" + column.replace("_", "-")


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Suggest the known name that an unknown one may misspell."""
    close = difflib.get_close_matches(name, list(known), 1)
    return f"did you mean {close[0]}?" if close else "vinetrack settings lists all names"


def value_and_unit(cell: str, name: str) -> tuple[str, str]:
    """Split `150 um` into its number and the key of its unit, one of a column's quantity; blank where it has none."""
    own, form = split_unit(name)[1], r"([-+]?[\d.,]*\d[\d.,]*(?:[eE][-+]?\d+)?)\s*([^\W\d_].*)"
    if not (own and (found := re.fullmatch(form, cell))):
        return cell, ""
    word = found[2].replace("μ", "µ").lower()
    for key, unit in UNITS.items():
        if unit.si == UNITS[own].si and word in (key.lower(), unit.text.lower()):
            return found[1], key
    message = f"has a unit, {found[2]}, that is none of this column"
    raise InputError(message, f"write the number alone, in {UNITS[own].text}", code="not_a_unit")


# ------------------------------------------------------------------------------
# Reading and checking of single values, in cells of `trials.csv` and in `experiment.yaml` alike, in the unit of their
# column.

SHORTEST_AXIS_PX = 10  # Chosen: the direction of a shorter axis is too uncertain
SMALLEST_POINT_SPACING_PX = 2  # Smallest distance between neighbouring points of a curved path (chosen)


def read_range(column: Column, value: Any) -> tuple[float, float]:
    """Read `low:high` or two numbers, each checked like a cell of the column and in its unit."""
    parts = value.split(":") if isinstance(value, str) else value
    if not isinstance(parts, list | tuple) or len(parts) != 2:
        raise InputError("is not a range", "write low:high, such as 7:40", code="not_a_range")
    low, high = map(column.read_key, parts)
    if low > high:
        raise InputError("ends below its start", "write the lower value first", code="reversed")
    return low, high


def _read_span(text: str, decimal: str, of_frames: bool) -> tuple[float, float]:
    """Read a time window `from_s:to_s`, or a range of frames `from:to`, counted from 0, both ends included."""
    parts = [part.strip() for part in text.split(":")]
    if len(parts) != 2 or (of_frames and not all(part.isascii() and part.isdigit() for part in parts)):
        kind, code = ("range of frames", "not_a_range") if of_frames else ("window", "not_a_window")
        raise InputError(f"is not a {kind}", code=code)
    first, last = (int(part) if of_frames else parse_number(part, decimal) for part in parts)
    if first >= last:
        raise InputError("ends before it starts", code="reversed")
    return first, last


def check_path(points: Sequence[tuple[float, float]]) -> None:
    """Refuse a path in the picture, px, that is too short, or a curve with points too close."""
    spacings = [math.dist(*pair) for pair in pairwise(points)]
    if sum(spacings) < SHORTEST_AXIS_PX:
        message = f"is shorter than {SHORTEST_AXIS_PX} pixels"
        raise InputError(message, "give two points far apart", code="too_short")
    if min(spacings) < SMALLEST_POINT_SPACING_PX:
        message = f"has neighbouring points less than {SMALLEST_POINT_SPACING_PX} pixels apart"
        raise InputError(message, "leave out the second of the two", code="too_close")


def _read_axis(text: str) -> PictureAxis:
    """Read an axis `x,y:x,y…[:width_mm]`: two or more points in the picture, and the width of the strip along them."""
    parts, width = text.split(":"), math.nan
    written = parts if "," in parts[-1] else parts[:-1]
    if len(written) < 2 or any(point.count(",") != 1 for point in written):
        raise InputError("is not an axis", code="not_an_axis")
    points = [(parse_number(x), parse_number(y)) for x, y in (point.split(",") for point in written)]
    check_path(points)
    if len(parts) > len(written):
        width = parse_number(parts[-1]) / 1000
        if width <= 0:
            raise InputError("has a width that is not positive", code="not_positive")
    return PictureAxis(points[0], points[-1], width, tuple(points[1:-1]))


def _read_bends(text: str, decimal: str) -> tuple[Bend, ...]:
    """Read bends `start_mm:arc_mm:radius_mm;…`; the result is in metres."""
    bends = []
    for piece in filter(None, (piece.strip() for piece in text.split(";"))):
        parts = piece.split(":")
        if len(parts) != 3:
            raise InputError(f"has a bend {piece!r} that is not three numbers", code="not_bends")
        start, arc, radius = (parse_number(part, decimal) / 1000 for part in parts)
        if start < 0 or arc <= 0 or radius <= 0:
            raise InputError(f"has a bend {piece!r} with a length that is not positive", code="not_positive")
        bends.append(Bend(start, arc, radius))
    return tuple(bends)


# ------------------------------------------------------------------------------
# Names of vines and conditions list their settings: `24mm-200um-280mm` is a vine, `24mm-200um-280mm_28kPa_35.6g` a
# condition.


def with_names(trials: Sequence[Trial]) -> tuple[Trial, ...]:
    """Return the trials with `vine` and `condition` filled in. The name of a condition always contains pressure and
    payload, and other physical settings only if they differ within the experiment (the yield pressure only if it
    differs within one vine).
    """
    # Columns that a condition's name shows only if they differ within the experiment; bends, the longest part, last
    optional = sorted((c for c in COLUMNS.values() if c.condition_part), key=lambda column: column.kind == "bends")
    shown = [column for column in optional if len({_part(column, trial) for trial in trials}) > 1]
    yields = Counter(
        vine for vine, _ in {(_vine(trial), _pressure(trial.yield_pressure_Pa, trial)) for trial in trials}
    )
    named = []
    for trial in trials:
        vine = _vine(trial)
        parts = [vine, _pressure(trial.pressure_Pa, trial), f"{_digits(trial.payload_kg * 1000)}g"]
        parts += [f"yield{_pressure(trial.yield_pressure_Pa, trial)}"] if yields[vine] > 1 else []
        parts += filter(None, (_part(column, trial) for column in shown))
        named.append(replace(trial, vine=vine, condition="_".join(parts)))
    return tuple(named)


def _digits(value: float) -> str:
    """Return a value to six digits, without exponent or trailing zeros.

    >>> _digits(28.000000004), _digits(0.5), _digits(100000.0)
    ('28', '0.5', '100000')
    """
    return np.format_float_positional(float(f"{value:.6g}") + 0.0, trim="-")


def _vine(trial: Trial) -> str:
    """Name of a trial's vine: diameter, thickness and length, unknown ones left out."""
    sizes = ((trial.diameter_m * 1e3, "mm"), (trial.thickness_m * 1e6, "um"), (trial.length_m * 1e3, "mm"))
    return "-".join(f"{_digits(size)}{unit}" for size, unit in sizes if math.isfinite(size))


def _pressure(pressure_Pa: float, trial: Trial) -> str:
    """Return a pressure in the unit of the sheet."""
    return f"{_digits(UNITS[trial.pressure_unit].from_si(pressure_Pa))}{trial.pressure_unit}"


def _part(column: Column, trial: Trial) -> str:
    """Return the part of a condition's name that shows a column; blank where the trial has no value."""
    if column.kind == "bends":
        value = "-".join("x".join(_digits(1000 * m) for m in (b.start_m, b.arc_m, b.radius_m)) for b in trial.bends)
    else:
        value = _digits(number) if math.isfinite(number := column.of_trial(trial)) else ""
    return column.condition_part.format(value) if value else ""
