"""Rows of the trial sheet: reading their cells, checking them, and making trials of them.

This module never opens recordings; `vinetrack.experiment.folder` combines rows, settings and files.
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Sequence, Set
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from vinetrack.core.problems import ExperimentError, InputError, Problem
from vinetrack.core.records import CAMERA_FILES, SIDE_FILES, Trial
from vinetrack.core.tables import Table, parse_number, read_table, safe_join
from vinetrack.core.units import UNITS, convert, pressure_text
from vinetrack.experiment.schema import COLUMNS, SHARED, did_you_mean
from vinetrack.experiment.settings import Board, ExperimentSettings, in_sheet_units

SHEET = "trials.csv"

# Columns that a trial of an everting vine requires; a body that moves as a whole requires the diameter only
REQUIRED_COLUMNS = ("diameter_mm", "thickness_um", "length_mm", "pressure_kPa", "yield_pressure_kPa")

YIELD_SIGMA_KPA = 0.2  # Default standard error of a yield pressure (chosen)


@dataclass
class Row:
    """A row while it is checked: values by column, in the unit of the column, without blank ones, and problems."""

    name: str
    line: int
    pressure_unit: str = "kPa"
    values: dict[str, Any] = field(default_factory=dict)
    problems: list[Problem] = field(default_factory=list)

    @property
    def faulty(self) -> set[str]:
        """Columns that have an error; a blank for one of the row as a whole."""
        return {problem.column for problem in self.problems if problem.severity == "error"}

    @property
    def given(self) -> set[str]:
        """Columns that have a value, or an error."""
        return {*self.values, *self.faulty}

    @property
    def in_use(self) -> bool:
        """Whether the trial is to be analysed; False for `use: no`."""
        return bool(self.values.get("use", True))

    @property
    def travel_ratio(self) -> float:
        """Travel ratio of row or settings; 2 by default."""
        return self.number("travel_ratio", 2.0)

    def number(self, column: str, blank: float = math.nan) -> float:
        """Return the number of a column."""
        return float(self.values.get(column, blank))

    def add(self, code: str, message: str, column: str = "", severity: str = "error", **details: Any) -> None:
        """Record a problem of this row."""
        place: dict[str, Any] = {"file": SHEET, "trial": self.name, "line": self.line}
        self.problems.append(Problem(code, message, column, severity=severity, **place, **details))

    def add_error(self, error: InputError, column: str, value: str | None = None) -> None:
        """Record why the value of a column cannot be used."""
        self.add(error.code, error.message, column, value=value, allowed=error.allowed, remedy=error.remedy)

    def add_blank(self, columns: Sequence[str], remedy: str = "fill it in", severity: str = "error") -> None:
        """Report required columns that have no value, unless another problem already concerns them."""
        code = "blank" if self.line else "missing"  # a row that stands in no file has no blank cells
        for name in columns:
            if name not in self.given:
                told = f"{COLUMNS[name].if_blank}; {remedy}".lstrip("; ")
                self.add(code, f"is {code}", name, severity, value="", allowed=COLUMNS[name].allowed, remedy=told)

    def check(self) -> None:
        """Check the row as a whole: one recording or track, values that agree."""
        given = self.given
        if {"video", "track"} <= given:
            message, remedy = "has both a video and a track", "keep one of the two"
            self.add("two_recordings", message, "track", value=self.values.get("track"), remedy=remedy)
        elif not {"video", "track"} & given:
            remedy = "name a recording under video, or a file of positions under track"
            self.add("no_recording", "has neither a video nor a track", remedy=remedy)
        self.check_wall()
        fps, exposure = self.number("capture_fps"), self.number("exposure_us")
        # An exposure cannot exceed the frame interval. 2 % allows for rounding of both numbers; above 1.5 intervals
        # rounding cannot be the reason.
        if exposure > 1.02e6 / fps:
            intervals = exposure * fps / 1e6
            message = f"is {intervals:.3g} times the frame interval at {fps:g} frames per second ({1e6 / fps:.4g} µs)"
            severity, remedy = ("error", "check its unit and capture_fps") if intervals > 1.5 else ("warning", "")
            self.add("longer_than_a_frame", message, "exposure_us", severity, value=f"{exposure:g}", remedy=remedy)

    def find_missing(self, folder: Path, columns: tuple[str, ...]) -> set[str]:
        """Report required cells that are blank; return required columns that neither sheet nor settings have."""
        if "travel_ratio" in self.faulty:
            return set()
        required = list(REQUIRED_COLUMNS if self.travel_ratio == 2 else REQUIRED_COLUMNS[:1])
        if "pressure_kPa" in required and {"pressure_trace", "track"} & self.given:
            required.remove("pressure_kPa")
        self.add_blank([name for name in required if name in columns])
        if "video" in self.values and "track" not in self.values and not _may_state_rate(folder, self.values["video"]):
            required.append("capture_fps")
            remedy = "write the capture rate; the rate stored in the file is that of playback"
            self.add_blank(["capture_fps"] if "capture_fps" in columns else [], remedy)
        return set(required) - set(columns) - set(self.values)

    def check_wall(self) -> None:
        """Report a wall thickness above a quarter of the diameter, which no tube can have."""
        diameter, thickness = self.number("diameter_mm"), self.number("thickness_um")
        if thickness / 1000 > diameter / 4:
            message = f"is more than a quarter of the diameter ({diameter:g} mm)"
            allowed, remedy = f"at most {250 * diameter:g} µm", "check the units: thickness in µm, diameter in mm"
            self.add("wall", message, "thickness_um", value=f"{thickness:g}", allowed=allowed, remedy=remedy)

    def check_pressures(self) -> None:
        """Warn of pressures that are allowed but implausible."""
        pressure, yield_pressure = self.number("pressure_kPa"), self.number("yield_pressure_kPa")
        if self.travel_ratio == 1:
            message = "is above 0 although the body moves as a whole (travel_ratio 1): is it a vine?"
            if pressure > 0:
                self.add("pressure_of_a_body", message, "pressure_kPa", "warning", value=f"{pressure:g}")
            return
        if yield_pressure >= pressure:
            message = "is not below the pressure, nothing would grow: check both units (1 bar is 100 kPa, 1 psi 6.895)"
            value = pressure_text(1e3 * yield_pressure, self.pressure_unit)
            self.add("no_growth", message, "yield_pressure_kPa", "warning", value=value)
        if pressure > 0 and yield_pressure == 0 and not self.values.get("yield_pressure_sigma_kPa"):
            message = "states that the vine grows at any pressure, which no vine does, with an error of 0.2 kPa"
            remedy = "measure it (raise the pressure until the tip moves), or state yield_pressure_sigma_kPa"
            self.add("no_yield_pressure", message, "yield_pressure_kPa", "warning", value="0", remedy=remedy)


def read_row(table: Table, index: int, settings: ExperimentSettings) -> Row:
    """Read and check the cells of one row; shared settings fill blank cells. An invalid name gives way to the line."""
    cells, line = table.rows[index], table.lines[index]
    name, unit = cells.get("trial", f"line-{line}"), table.units.get("pressure_kPa", "kPa")
    if re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_-]{0,99}", name, re.ASCII):
        row = Row(name, line, unit)
    else:
        row = Row(f"line-{line}", line, unit)
        code, message = ("name", "is not a valid trial name") if name else ("blank", "is blank")
        remedy = "at most 100 characters, no spaces or dots, no hyphen first: files are named after it"
        row.add(code, message, "trial", value=name, allowed=COLUMNS["trial"].allowed, remedy=remedy)
    for name, column in COLUMNS.items():
        typed = text = cells.get(name, "")
        if text and (of_column := table.units.get(name)):
            with suppress(InputError):  # as it stands in the sheet, in the unit of its column
                value = convert(parse_number(text, table.decimal), column.unit_key, of_column)
                typed = f"{value:.6g} {UNITS[of_column].text}"
        try:
            if text:
                row.values[name] = column.read(text, table.decimal, table.units.get(name, ""))
                if said := column.unusual(row.values[name], table.units.get(name, "")):
                    row.add("unusual", said, name, "warning", value=typed)
            elif name in SHARED and (shared := getattr(settings, name)) is not None:
                row.values[name] = shared
        except InputError as error:
            row.add_error(error, name, typed)
    if table.extra[index]:
        remedy = "put text that contains separators, and decimal commas, in quotes, or remove separators at its end"
        row.add("more_cells", f"has {len(table.extra[index])} cells more than the header", remedy=remedy)
    if not row.in_use:
        row.problems = [replace(problem, severity="warning") for problem in row.problems]
    return row


def read_sheet(path: Path) -> tuple[Table, list[Problem]]:
    """Read a sheet in the units of its columns, and what is wrong with its columns; unknown ones are ignored."""
    try:
        table, problems = in_sheet_units(read_table(path), path.name)
    except InputError as error:
        raise ExperimentError([Problem.from_error(error, path.name)]) from None
    warning = partial(Problem, file=path.name, severity="warning")
    message = "is not a column of the trial sheet and is ignored"
    left = [column for column in COLUMNS if column not in table.columns]
    told = {problem.column for problem in problems}  # of the same quantity in two units one is ignored
    unknown = [name for name in table.columns if name not in COLUMNS and name not in told]
    if not any(difflib.get_close_matches(name, COLUMNS, 1) for name in table.columns):
        remedy = "name them as vinetrack settings does, and delete what stands above their names"
        raise ExperimentError([Problem("no_columns", "names no known column", file=path.name, line=1, remedy=remedy)])
    problems += [warning("unknown_column", message, name, line=1, remedy=did_you_mean(name, left)) for name in unknown]
    if table.nameless:
        problems.append(warning("nameless_column", "has a column without a name, which is ignored"))
    if not table.rows:
        problems.append(Problem("no_rows", "has no rows", file=path.name, remedy="write one row per trial"))
    return table, problems


def closest_entry(path: Path, taken: Set[Path] = frozenset()) -> str:
    """Entry beside a missing file most like it, whatever its case, and not `taken`; blank if there is none."""
    try:
        names = {entry.name.lower(): entry.name for entry in sorted(path.parent.iterdir()) if entry not in taken}
    except (OSError, ValueError):
        return ""
    close = difflib.get_close_matches(path.name.lower(), names, 1)
    return names[close[0]] if close else ""


def _may_state_rate(folder: Path, video: str) -> bool:
    """Whether a recording is of a kind that can carry its capture rate; whether it does, only opening it shows."""
    try:
        path = safe_join(folder, video)
        files = path.iterdir() if path.is_dir() else [path, *map(path.with_suffix, SIDE_FILES)]
        return any(file.suffix.lower() in {".dng", *CAMERA_FILES} and file.exists() for file in files)
    except (OSError, ValueError):
        return False


def make_trial(row: Row, folder: Path, settings: ExperimentSettings) -> Trial:
    """Make the trial of a row without errors, in SI units, with the documented defaults."""
    defaults = {
        "pressure_kPa": 0.0,
        "pressure_sigma_kPa": 0.01 * row.values.get("pressure_kPa", 0.0),  # 1 %: default standard error (chosen)
        "yield_pressure_kPa": 0.0,
        "yield_pressure_sigma_kPa": YIELD_SIGMA_KPA if row.travel_ratio == 2 else 0.0,
    }
    scale = getattr(settings.calibration, "mm_per_px", None)  # of a recording its picture is asked, as for its lens
    defaults |= {"mm_per_px": scale} if scale and "track" in row.values else {}
    values: dict[str, Any] = {**defaults, **row.values, "trial": row.name}
    return Trial(
        **{COLUMNS[name].field: COLUMNS[name].in_trial(value, folder) for name, value in values.items()},
        pressure_unit=row.pressure_unit,
        ambient_pressure_Pa=settings.ambient_pressure_kPa * 1000,
        mass_loss=settings.mass_loss,
        tail_slack=settings.tail_slack,
        tail_store=settings.tail_store,
        position_systematic_m=math.nan if (mm := settings.position_systematic_mm) is None else mm / 1e3,
        # Without a recording the trial is planned, and what will limit its positions is not known.
        systematic_of_travel=systematic_of_travel(settings, "video" not in values or "mm_per_px" in values),
    )


def systematic_of_travel(settings: ExperimentSettings, scaled_elsewhere: bool = False) -> float:
    """Standard deviation of smooth position errors as a part of the longest travel. Two points, a scale, a scale of the
    trial's own and positions measured elsewhere (`scaled_elsewhere`) do not show whether the distortion was corrected;
    the many corners of a target do.
    """
    # 5e-5: that by a target, of which 0.67 is beside a constant and a scale, on sixteen pictures (measured)
    known = isinstance(settings.calibration, Board) and not scaled_elsewhere
    return 5e-5 if known else Trial.systematic_of_travel
