"""Declarations of all columns of the trial sheet: name, unit, bounds, meaning, and field of `Trial`.

These declarations define the reading of `trials.csv` (`vinetrack.experiment.sheet`), the settings of the same name in
`experiment.yaml` and its `limits` (`settings`), the options of `vinetrack predict` and `design`
(`vinetrack.cli.design_options`), the inputs that an effect may require (`vinetrack.dynamics.model`), and the
output of `vinetrack settings`. `vinetrack.experiment.schema` reads values.

Imports stay light: the command line loads this module at every start.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

from vinetrack.core.problems import InputError
from vinetrack.core.records import Bend, PictureAxis, Trial
from vinetrack.core.tables import TableError, parse_number
from vinetrack.core.units import UNITS, Unit, convert, split_unit

# ------------------------------------------------------------------------------
# Declaration of one column of the trial sheet, and conversion of its numbers to and from SI.
#
# Imports stay light: the command line loads this module at every start.


@dataclass(frozen=True, kw_only=True)
class Column:
    """A column of the trial sheet. `field` is the field of `Trial` that holds the value, in SI where it is a number;
    `meaning` describes it, `measured` says how to measure it, `default` what a blank cell stands for.
    """

    name: str
    field: str
    meaning: str
    measured: str = ""
    default: str = ""
    kind: str = "number"
    low: float = -math.inf
    high: float = math.inf
    above_low: bool = False
    unit_key: str = ""
    slips: tuple[str, ...] = ()
    usual: tuple[float, float] = (-math.inf, math.inf)
    unusual_hint: str = ""
    shared: bool = True
    limit: str = ""
    condition_part: str = ""

    @property
    def scale(self) -> Unit | None:
        """The unit; None for text and for numbers without one."""
        return UNITS.get(self.unit_key or split_unit(self.name)[1])

    @property
    def unit(self) -> str:
        """The unit as it is printed; blank if there is none."""
        return self.scale.text if self.scale else ""

    @property
    def allowed(self) -> str:
        """The bounds, in words."""
        unit = f" {self.unit}" if self.unit else ""
        if math.isinf(self.high):
            return ("above " if self.above_low else "at least ") + f"{self.low:g}{unit}"
        return f"{'above ' if self.above_low else ''}{self.low:g} to {self.high:g}{unit}"

    def in_words(self, value: float) -> str:
        """Return a value as a phrase for a sentence: `a chamber of 3.7 litres`."""
        quantity = split_unit(self.name)[0].replace("_", " ")
        article = "an" if quantity[0] in "aeiou" else "a"
        return f"{article} {quantity} of {value:.3g} {self.unit}".rstrip()

    def to_si(self, value: float) -> float:
        """Convert a value of this column to SI."""
        return self.scale.to_si(value) if self.scale else value

    def of_trial(self, trial: Trial) -> float:
        """Return a trial's value of this column."""
        value = float(getattr(trial, self.field))
        return self.scale.from_si(value) if self.scale else value


_BAR = "looks like bar: 1 bar is 100 kPa"

# Every column of `trials.csv`, in the order of the documentation
COLUMNS: dict[str, Column] = {
    column.name: column
    for column in (
        Column(
            name="trial",
            field="name",
            kind="text",
            shared=False,
            meaning="Name of the trial, unique in the sheet; it names files.",
            default="required",
        ),
        Column(
            name="video",
            field="video",
            kind="path",
            shared=False,
            meaning="The recording: mp4, mov, avi, mkv, Phantom cine, Photron mraw, or a folder or stack of pictures.",
        ),
        Column(
            name="track",
            field="track",
            kind="path",
            shared=False,
            meaning="Positions measured elsewhere: a CSV with time_s, position_m, or a file of Physics Tracker.",
        ),
        Column(
            name="pressure_trace",
            field="pressure_trace",
            kind="path",
            meaning="The gauge pressure measured during the trial: a CSV with time_s, pressure_kPa, or a TDMS file.",
            measured="A gauge at the chamber, logged on the clock of the recording.",
        ),
        Column(
            name="capture_fps",
            field="capture_fps",
            low=0,
            above_low=True,
            high=1e7,
            usual=(60, math.inf),
            unusual_hint="write the capture rate, not the playback rate",
            meaning="Capture rate, frames per second; never the rate at which the file plays.",
            measured="The camera's setting; the rate stored in the file is that of playback.",
            default="required with a video that does not state it (DNG, cine, mraw do)",
        ),
        Column(
            name="capture_fps_is_playback",
            field="capture_fps_is_playback",
            kind="yes_no",
            meaning="yes: the film plays as fast as it was captured, so that capture_fps may equal its playback rate.",
            measured="yes for an ordinary film of a phone, no for a high-speed camera.",
            default="no: a capture_fps equal to the playback rate is refused",
        ),
        Column(
            name="exposure_us",
            field="exposure_s",
            low=0,
            above_low=True,
            high=1e6,
            slips=("ns",),
            usual=(1, math.inf),
            unusual_hint="looks like milliseconds: 1 ms is 1000 µs",
            meaning="Exposure of one frame.",
            measured="The camera's setting.",
        ),
        Column(
            name="diameter_mm",
            field="diameter_m",
            low=0.5,
            high=300,
            slips=("m", "um"),
            limit="choice",
            meaning="Diameter of the inflated vine.",
            measured="Calliper on the inflated tube, or lay-flat width times 2/π.",
            default="required",
        ),
        Column(
            name="thickness_um",
            field="thickness_m",
            low=0,
            above_low=True,
            high=75_000,
            slips=("nm",),
            usual=(2, math.inf),
            unusual_hint="looks like millimetres: 1 mm is 1000 µm",
            limit="choice",
            meaning="Thickness of the wall.",
            measured="Micrometer over ten layers, divided by ten.",
            default="required",
        ),
        Column(
            name="length_mm",
            field="length_m",
            low=0,
            above_low=True,
            high=100_000,
            slips=("um",),
            usual=(5, math.inf),
            unusual_hint="looks like metres: 0.28 m is 280 mm",
            limit="choice",
            meaning="Length of the grown vine.",
            measured="Ruler along the everted tube.",
            default="required",
        ),
        Column(
            name="pressure_kPa",
            field="pressure_Pa",
            low=0,
            high=1000,
            slips=("Pa", "mbar"),
            usual=(1, math.inf),
            unusual_hint=_BAR,
            limit="range",
            meaning="Gauge pressure.",
            measured="Gauge at the chamber, before the release.",
            default="required without a trace",
        ),
        Column(
            name="pressure_sigma_kPa",
            field="pressure_sigma_Pa",
            low=0,
            high=1000,
            slips=("Pa", "mbar"),
            meaning="Scatter of the gauge pressure from trial to trial.",
            measured="Standard deviation of the gauge reading over repeated fillings.",
            default="1 % of the pressure",
        ),
        Column(
            name="yield_pressure_kPa",
            field="yield_pressure_Pa",
            low=0,
            high=1000,
            slips=("Pa", "mbar"),
            meaning="Yield pressure: the lowest gauge pressure at which the vine grows.",
            measured="Raise the pressure slowly from zero until the tip starts to move; mean reading of five starts.",
            default="required",
        ),
        Column(
            name="yield_pressure_sigma_kPa",
            field="yield_pressure_sigma_Pa",
            low=0,
            high=1000,
            slips=("Pa", "mbar"),
            meaning="Standard error of the yield pressure.",
            measured="Standard deviation over those starts, divided by the square root of their number.",
            default="0.2 kPa",
        ),
        Column(
            name="payload_g",
            field="payload_kg",
            low=0,
            high=100_000,
            slips=("mg",),
            usual=(0.1, math.inf),
            unusual_hint="looks like kilograms: 0.0356 kg is 35.6 g",
            limit="range",
            meaning="Mass that rides on the tail.",
            measured="Balance.",
            default="0",
        ),
        Column(
            name="growth_angle_deg",
            field="growth_angle_rad",
            low=-180,
            high=180,
            limit="choice",
            condition_part="{}deg",
            meaning="Direction of growth: 0 straight down, 90 level, 180 straight up.",
            measured="Protractor, or a plumb line in the picture.",
            default="0: straight down",
        ),
        Column(
            name="chamber_l",
            field="chamber_m3",
            low=0,
            above_low=True,
            high=10_000,
            slips=("cm3",),
            limit="choice",
            condition_part="chamber{}l",
            meaning="Volume of the pressure chamber.",
            measured="Mass of the water that fills it.",
            default="unknown",
        ),
        Column(
            name="inlet_mm",
            field="inlet_m",
            low=0,
            above_low=True,
            high=300,
            slips=("um",),
            limit="choice",
            condition_part="inlet{}mm",
            meaning="Diameter of the inlet between chamber and vine.",
            measured="Drawing of the connector, or calliper.",
            default="unknown",
        ),
        Column(
            name="bends",
            field="bends",
            kind="bends",
            condition_part="bends{}",
            meaning="Bends of the path: start_mm:arc_mm:radius_mm, several joined by ;.",
            measured="Drawing of the guide, or a string laid along it.",
            default="none",
        ),
        Column(
            name="film_density_kg_m3",
            field="film_density_kg_m3",
            low=100,
            high=25_000,
            slips=("g_cm3",),
            condition_part="film{}",
            meaning="Density of the film.",
            measured="Data sheet, or the mass of a piece over its volume.",
            default="1200 kg/m³",
        ),
        Column(
            name="mm_per_px",
            field="m_per_px",
            low=0,
            above_low=True,
            high=1000,
            unit_key="mm",
            meaning="Scale of the picture; overrides the calibration.",
            measured="Length of a ruler in the plane of growth over its pixels.",
        ),
        Column(
            name="compare_sizes",
            field="compare_sizes",
            kind="yes_no",
            meaning="no: width and growth of the tube in the picture are not compared with diameter_mm and length_mm.",
            measured="no if only part of the tube's width is visible.",
            default="yes",
        ),
        Column(
            name="travel_ratio",
            field="travel_ratio",
            kind="choice",
            low=1,
            high=2,
            condition_part="ratio{}",
            meaning="Travel of the tail over that of the lead: 2 for eversion, 1 for a body that moves as a whole.",
            default="2",
        ),
        Column(
            name="steady",
            field="steady_window_s",
            kind="window",
            meaning="A steady window chosen by hand: from_s:to_s.",
            default="found by rules",
        ),
        Column(
            name="use",
            field="use",
            kind="yes_no",
            meaning="no: the trial stays in the sheet and is left out of the analysis.",
            default="yes",
        ),
        Column(
            name="specimen",
            field="specimen",
            kind="text",
            meaning="Which physical tube of that vine was used.",
            measured="Label every tube.",
            default="unknown",
        ),
        Column(
            name="day",
            field="day",
            kind="text",
            meaning="Day or batch in which the trial was run.",
            default="unknown",
        ),
        Column(
            name="order",
            field="order",
            low=1,
            high=1_000_000,
            shared=False,
            meaning="Position of the trial in the order in which trials were run: 1, 2, …",
            measured="Count trials as they are run.",
            default="the order of the rows",
        ),
        Column(
            name="axis",
            field="axis",
            kind="axis",
            shared=False,
            meaning="Growth axis in the picture for this trial only: x,y:x,y[:width_mm], px; more points for a bend.",
            default="the axis of all trials, or found from the motion",
        ),
        Column(
            name="frames_used",
            field="frames_used",
            kind="frames",
            shared=False,
            meaning="First and last frame of this trial to use: from:to, counted from 0 (rows of a track file).",
            default="all",
        ),
        Column(
            name="point_mass",
            field="point_mass",
            kind="text",
            shared=False,
            meaning="Name of the point mass in a Physics Tracker file that is this trial.",
            default="the one with the most points",
        ),
    )
}

# Columns that `experiment.yaml` may set for all trials
SHARED = tuple(name for name, column in COLUMNS.items() if column.shared)

# Columns that `limits` of `experiment.yaml` may constrain for further trials, by the form of the constraint
LIMITED = {kind: tuple(name for name in COLUMNS if COLUMNS[name].limit == kind) for kind in ("range", "choice")}


def option(column: str) -> str:
    """Return the command-line option for a column of the sheet."""
    return "--" + column.replace("_", "-")


# ------------------------------------------------------------------------------
# Reading and checking of single values of the trial sheet.
#
# A cell of `trials.csv` and a value of `experiment.yaml` pass the same checks and get the same remedies. Values stay
# in the unit of their column until `vinetrack.experiment.sheet.make_trial` converts them to SI.

Value = float | bool | str | tuple[float, float] | tuple[Bend, ...] | PictureAxis

SHORTEST_AXIS_PX = 10  # Chosen: the direction of a shorter axis is too uncertain
SMALLEST_POINT_SPACING_PX = 2  # Smallest distance between neighbouring points of a curved path (chosen)

TRUTH_WORDS = {"yes": True, "y": True, "true": True, "1": True, "no": False, "n": False, "false": False, "0": False}


class CellError(InputError, ValueError):
    """A value that its column does not allow; pydantic reports it as an error of its key."""


def read_cell(column: Column, text: str, decimal: str = ".") -> Value:
    """Return the value of a non-blank cell, in the unit of its column."""
    if column.kind == "yes_no":
        if text.lower() not in TRUTH_WORDS:
            raise CellError("is neither yes nor no", allowed="yes or no")
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
        raise CellError("is not a range", "write low:high, such as 7:40")
    low, high = (read_limit(column, part) for part in parts)
    if low > high:
        raise CellError("ends below its start", "write the lower value first")
    return low, high


def interior_values(low: float, high: float) -> list[float]:
    """Return three values between two others, in geometric steps where `low` is positive, else in equal steps."""
    parts = (0.25, 0.5, 0.75)
    return [low ** (1 - part) * high**part if low > 0 else low + (high - low) * part for part in parts]


def read_limit(column: Column, value: Any) -> float:
    """Read one number of `limits`, checked like a cell of the column."""
    if isinstance(value, bool | list | tuple | dict):
        raise CellError("holds something that is not a number", "write numbers only")
    return float(str(read_value(column, value)))


def read_value(column: Column, value: Any) -> Any:
    """Read a value of the settings like a cell of the sheet's column of the same name."""
    return read_cell(column, str(value).strip())


def _check_number(column: Column, value: float) -> float:
    """Return the value unchanged if its column allows it; raise a CellError otherwise."""
    if column.kind == "choice":
        if value not in (column.low, column.high):
            raise CellError("is not a travel ratio", allowed="2 for eversion, 1 for a body that moves as a whole")
    elif value > column.high:
        raise CellError(f"is above {column.high:g} {column.unit}", _likely_unit(column, value), column.allowed)
    elif value < column.low or (column.above_low and value == column.low):
        relation = "is not above" if column.above_low else "is below"
        raise CellError(f"{relation} {column.low:g} {column.unit}".strip(), _likely_unit(column, value), column.allowed)
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
        raise CellError(error.message, error.remedy, allowed) from None


def _read_window(text: str, decimal: str) -> tuple[float, float]:
    """Read a time window `from_s:to_s`."""
    allowed = "from_s:to_s, such as 0.05:0.20"
    parts = text.split(":")
    if len(parts) != 2:
        raise CellError("is not a window", allowed=allowed)
    start, end = (_number(part, decimal, allowed) for part in parts)
    if start >= end:
        raise CellError("ends before it starts", allowed=allowed)
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
        raise CellError("is not an axis", allowed=allowed)
    points = [(_number(x, ".", allowed), _number(y, ".", allowed)) for x, y in (point.split(",") for point in written)]
    if sum(math.dist(*pair) for pair in pairwise(points)) < SHORTEST_AXIS_PX:
        raise CellError(f"is shorter than {SHORTEST_AXIS_PX} pixels", "give two points far apart", allowed)
    if len(points) > 2 and min(math.dist(*pair) for pair in pairwise(points)) < SMALLEST_POINT_SPACING_PX:
        message = f"has neighbouring points less than {SMALLEST_POINT_SPACING_PX} pixels apart"
        raise CellError(message, "leave out the second of the two", allowed)
    if len(parts) > len(written):
        width = _number(parts[-1], ".", allowed) / 1000
        if width <= 0:
            raise CellError("has a width that is not positive", allowed=allowed)
    return PictureAxis(points[0], points[-1], width, tuple(points[1:-1]))


def _read_frames(text: str) -> tuple[int, int]:
    """Read a range of frames `from:to`, counted from 0, both ends included."""
    allowed = "from:to, such as 12:80"
    parts = [part.strip() for part in text.split(":")]
    if len(parts) != 2 or not all(part.isascii() and part.isdigit() for part in parts):
        raise CellError("is not a range of frames", allowed=allowed)
    first, last = int(parts[0]), int(parts[1])
    if first >= last:
        raise CellError("ends before it starts", allowed=allowed)
    return first, last


def _read_bends(text: str, decimal: str) -> tuple[Bend, ...]:
    """Read bends `start_mm:arc_mm:radius_mm;…`; the result is in metres."""
    allowed = "start_mm:arc_mm:radius_mm, several joined by ;"
    bends = []
    for piece in filter(None, (piece.strip() for piece in text.split(";"))):
        parts = piece.split(":")
        if len(parts) != 3:
            raise CellError(f"has a bend {piece!r} that is not three numbers", allowed=allowed)
        start, arc, radius = (_number(part, decimal, allowed) / 1000 for part in parts)
        if start < 0 or arc <= 0 or radius <= 0:
            raise CellError(f"has a bend {piece!r} with a length that is not positive", allowed=allowed)
        bends.append(Bend(start, arc, radius))
    return tuple(bends)


# ------------------------------------------------------------------------------
# Names of vines and conditions, unique for each set of nominal settings.
#
# Names list the settings and are valid file names: `24mm-200um-280mm` is a vine, `24mm-200um-280mm_28kPa_35.6g` a
# condition.


def with_names(trials: Sequence[Trial]) -> tuple[Trial, ...]:
    """Return the trials with `vine` and `condition` filled in. The name of a condition always contains pressure and
    payload, and other physical settings only if they differ within the experiment (the yield pressure only if it
    differs within one vine). Returns the trials, in the same order.
    """
    shown = [column for column in _OPTIONAL_PARTS if len({_part(column, trial) for trial in trials}) > 1]
    yields: dict[str, set[str]] = {}
    for trial in trials:
        yields.setdefault(_vine(trial), set()).add(_yield_pressure(trial))
    named = []
    for trial in trials:
        vine = _vine(trial)
        parts = [vine, f"{_digits(trial.pressure_Pa / 1000)}kPa", f"{_digits(trial.payload_kg * 1000)}g"]
        if len(yields[vine]) > 1:
            parts.append(_yield_pressure(trial))
        parts += filter(None, (_part(column, trial) for column in shown))
        named.append(replace(trial, vine=vine, condition="_".join(parts)))
    return tuple(named)


def _digits(value: float) -> str:
    """Return a value to six digits, without exponent or trailing zeros.

    >>> _digits(28.000000004), _digits(0.5), _digits(100000.0)
    ('28', '0.5', '100000')
    """
    text = f"{float(f'{value:.6g}'):.12f}".rstrip("0").rstrip(".")
    return "0" if text == "-0" else text


def _vine(trial: Trial) -> str:
    """Name of a trial's vine: diameter, thickness and length, unknown ones left out."""
    sizes = ((trial.diameter_m * 1e3, "mm"), (trial.thickness_m * 1e6, "um"), (trial.length_m * 1e3, "mm"))
    return "-".join(f"{_digits(size)}{unit}" for size, unit in sizes if math.isfinite(size))


def _yield_pressure(trial: Trial) -> str:
    return f"yield{_digits(trial.yield_pressure_Pa / 1000)}kPa"


def _part(column: Column, trial: Trial) -> str:
    """Return the part of a condition's name that shows a column; blank where the trial has no value."""
    if column.kind == "bends":
        value = "-".join("x".join(_digits(1000 * m) for m in (b.start_m, b.arc_m, b.radius_m)) for b in trial.bends)
    else:
        number = column.of_trial(trial)
        value = _digits(number) if math.isfinite(number) else ""
    return column.condition_part.format(value) if value else ""


# Columns that a condition's name shows only if they differ within the experiment; bends, the longest part, last
_OPTIONAL_PARTS = sorted(
    (column for column in COLUMNS.values() if column.condition_part), key=lambda column: column.kind == "bends"
)
