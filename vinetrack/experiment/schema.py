"""What each column of a trial sheet, and the setting of the same name, may hold.

One specification serves both: a cell of `trials.csv` and a value of `experiment.yaml` pass the same checks and get
the same remedies. Values stay in the column's own unit here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from vinetrack.core.records import Bend
from vinetrack.core.tables import TableError, parse_number

Value = float | bool | str | tuple[float, float] | tuple[Bend, ...]

YES_NO = {"yes": True, "y": True, "true": True, "1": True, "no": False, "n": False, "false": False, "0": False}


class CellError(ValueError):
    """A value that its column does not allow: what is wrong, what is allowed, what to do."""

    def __init__(self, message: str, allowed: str = "", remedy: str = "") -> None:
        super().__init__(message)
        self.message, self.allowed, self.remedy = message, allowed, remedy


@dataclass(frozen=True)
class Column:
    """A column of the sheet.

    `low` and `high` bound the value (`low` itself is refused where `above_low`). `slips` are units people write by
    mistake, each with the factor that turns it into the column's own. A legal value outside `usual` gets a warning.
    """

    name: str
    kind: str = "number"
    low: float = -math.inf
    high: float = math.inf
    above_low: bool = False
    unit: str = ""
    slips: tuple[tuple[str, float], ...] = ()
    usual: tuple[float, float] = (-math.inf, math.inf)
    unusual_hint: str = ""

    @property
    def allowed(self) -> str:
        """The bounds in words."""
        unit = f" {self.unit}" if self.unit else ""
        if math.isinf(self.high):
            return ("above " if self.above_low else "at least ") + f"{self.low:g}{unit}"
        return f"{'above ' if self.above_low else ''}{self.low:g} to {self.high:g}{unit}"


_PRESSURE_SLIPS = (("Pa", 1e-3), ("mbar", 0.1))
_BAR = "looks like bar: 1 bar is 100 kPa"

COLUMNS: dict[str, Column] = {
    column.name: column
    for column in (
        Column("trial", "text"),
        Column("video", "path"),
        Column("track", "path"),
        Column("pressure_trace", "path"),
        Column(
            "capture_fps",
            low=0,
            above_low=True,
            high=1e7,
            unit="frames a second",
            usual=(60, math.inf),
            unusual_hint="write the rate of capture, not that of playback",
        ),
        Column("exposure_us", low=0, above_low=True, high=1e6, unit="µs", slips=(("ns", 1e-3),)),
        Column("diameter_mm", low=0.5, high=300, unit="mm", slips=(("metres", 1e3), ("µm", 1e-3))),
        Column(
            "thickness_um",
            low=0,
            above_low=True,
            high=75_000,
            unit="µm",
            slips=(("nm", 1e-3),),
            usual=(2, math.inf),
            unusual_hint="looks like millimetres: 0.2 mm is 200 µm",
        ),
        Column(
            "length_mm",
            low=0,
            above_low=True,
            high=100_000,
            unit="mm",
            slips=(("µm", 1e-3),),
            usual=(5, math.inf),
            unusual_hint="looks like metres: 0.28 m is 280 mm",
        ),
        Column(
            "pressure_kPa",
            low=0,
            high=1000,
            unit="kPa",
            slips=_PRESSURE_SLIPS,
            usual=(1, math.inf),
            unusual_hint=_BAR,
        ),
        Column("pressure_sigma_kPa", low=0, high=1000, unit="kPa", slips=_PRESSURE_SLIPS),
        Column("yield_pressure_kPa", low=0, high=1000, unit="kPa", slips=_PRESSURE_SLIPS),
        Column("yield_pressure_sigma_kPa", low=0, high=1000, unit="kPa", slips=_PRESSURE_SLIPS),
        Column(
            "payload_g",
            low=0,
            high=100_000,
            unit="g",
            slips=(("mg", 1e-3),),
            usual=(0.1, math.inf),
            unusual_hint="looks like kilograms: 0.0356 kg is 35.6 g",
        ),
        Column("growth_angle_deg", low=-180, high=180, unit="degrees"),
        Column("chamber_l", low=0, above_low=True, high=10_000, unit="litres", slips=(("cm³", 1e-3),)),
        Column("inlet_mm", low=0, above_low=True, high=300, unit="mm", slips=(("µm", 1e-3),)),
        Column("bends", "bends"),
        Column("film_density_kg_m3", low=100, high=25_000, unit="kg/m³", slips=(("g/cm³", 1e3),)),
        Column("mm_per_px", low=0, above_low=True, high=1000, unit="mm"),
        Column("travel_ratio", "choice", low=1, high=2),
        Column("steady", "window"),
        Column("use", "yes_no"),
    )
}
"""Every column of `trials.csv`, in the order of the documentation."""

SHARED = tuple(name for name in COLUMNS if name not in ("trial", "video", "track"))
"""Columns that `experiment.yaml` may set for all trials."""


def read_cell(column: Column, text: str, decimal: str = ".") -> Value:
    """Value of a cell that is not blank, in the unit of its column.

    Raises
    ------
    CellError
        If the column does not allow it.

    Examples
    --------
    >>> read_cell(COLUMNS["pressure_kPa"], "28"), read_cell(COLUMNS["steady"], "0.05:0.2")
    (28.0, (0.05, 0.2))
    >>> try:
    ...     read_cell(COLUMNS["pressure_kPa"], "24000")
    ... except CellError as error:
    ...     print(error.message, "|", error.remedy)
    is above 1000 kPa | looks like Pa: 24000 Pa is 24 kPa
    """
    if column.kind == "yes_no":
        if text.lower() not in YES_NO:
            raise CellError("is neither yes nor no", "yes or no")
        return YES_NO[text.lower()]
    if column.kind == "window":
        return _read_window(text, decimal)
    if column.kind == "bends":
        return _read_bends(text, decimal)
    if column.kind in ("text", "path"):
        return text
    return check_number(column, _number(text, decimal, column.allowed))


def check_number(column: Column, value: float) -> float:
    """The value itself, if its column allows it; see `read_cell`."""
    if column.kind == "choice":
        if value not in (column.low, column.high):
            raise CellError("is not a travel ratio", "2 for eversion, 1 for a body that moves as a whole")
    elif value > column.high:
        raise CellError(f"is above {column.high:g} {column.unit}", column.allowed, _slip(column, value))
    elif value < column.low or (column.above_low and value == column.low):
        relation = "is not above" if column.above_low else "is below"
        raise CellError(f"{relation} {column.low:g} {column.unit}".strip(), column.allowed, _slip(column, value))
    return value


def oddity(column: Column, value: float) -> str:
    """Why a legal value is suspicious, or blank. Zero never is: it is written on purpose."""
    return "" if value == 0 or column.usual[0] <= value <= column.usual[1] else column.unusual_hint


def _slip(column: Column, value: float) -> str:
    """The unit that was probably meant, where the value is allowed in it."""
    for unit, factor in column.slips:
        meant = value * factor
        # A slip enlarges numbers that are too small and shrinks those that are too large, never the other way round.
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
    """`from_s:to_s`, in seconds."""
    allowed = "from_s:to_s, such as 0.05:0.20"
    parts = text.split(":")
    if len(parts) != 2:
        raise CellError("is not a window", allowed)
    start, end = (_number(part, decimal, allowed) for part in parts)
    if start >= end:
        raise CellError("ends before it starts", allowed)
    return start, end


def _read_bends(text: str, decimal: str) -> tuple[Bend, ...]:
    """`start_mm:arc_mm:radius_mm;…`, as bends in metres."""
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
